"""The programs that are installed, and their runs: every program is asked in its own process, or here where it is SciPy."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
NOSNOC = "NSMODEL_NOSNOC_PYTHON"  # names the Python that has nosnoc
CROMOSIM = "NSMODEL_CROMOSIM_PYTHON"  # and cromosim
LIMIT = 240  # s for one program on one scene


@dataclass(frozen=True)
class Run:
    """A run of another program: times (N,), states (N, n), CPU seconds of its steps; ``message`` says why where it failed."""

    method: str
    label: str
    seconds: float = np.nan
    t: np.ndarray = field(default_factory=lambda: np.empty(0))
    x: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    message: str = ""


def siconos() -> str | None:
    """The first Python that has Siconos."""
    return _that_has("siconos.kernel", [sys.executable, "/usr/bin/python3", shutil.which("python3")])


def nosnoc() -> str | None:
    """The Python named in NSMODEL_NOSNOC_PYTHON, where it has nosnoc."""
    return _that_has("nosnoc", [os.environ.get(NOSNOC)])


def cromosim() -> str | None:
    """The first Python that has cromosim, the one named in NSMODEL_CROMOSIM_PYTHON before this one."""
    return _that_has("cromosim", [os.environ.get(CROMOSIM), sys.executable])


def crowd_steps(scene: Path) -> tuple[dict[str, float] | None, str]:
    """Milliseconds of the parts of cromosim's step from the state in a file; None where it is not installed, or failed: why."""
    lines, stopped = _ask(cromosim(), "in_cromosim.py", str(scene))
    found = [json.loads(line) for line in lines if line.startswith("{")]
    return (found[0], "") if found else (None, stopped)


def _that_has(module: str, pythons: list[str | None]) -> str | None:
    for python in pythons:
        if python and shutil.which(python):
            probe = subprocess.run([python, "-c", f"import {module}"], capture_output=True, check=False)
            if probe.returncode == 0:
                return python
    return None


def speed(scenes: list[str]) -> dict[str, float]:
    """Microseconds a step in Siconos by scene; nothing where it is not installed."""
    lines = [line.split() for line in _ask(siconos(), "in_siconos.py", "speed", *scenes)[0]]
    return {line[0]: float(line[1]) for line in lines if len(line) == 2 and line[0] in scenes}


def runs(scene: str) -> Iterator[Run]:
    """The runs of all programs that are installed and take the scene of ``cases/``.

    nosnoc 0.2 takes piecewise smooth fields: relays, but neither complementarity with a D nor constraints on the state.
    """
    from peers import in_events, in_scipy

    yield from in_scipy.runs(scene)
    yield from in_events.runs(scene)
    yield from _parsed("Siconos", _ask(siconos(), "in_siconos.py", "runs", scene))
    if scene in ("friction_oscillator", "sliding_relay"):
        yield from _parsed("nosnoc", _ask(nosnoc(), "in_nosnoc.py", scene))


def _ask(python: str | None, script: str, *arguments: str) -> tuple[list[str], str]:
    """The lines that a script prints, and why it stopped early, empty where it did not."""
    if python is None:
        return [], ""
    alone = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [python, str(HERE / script), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT, env=os.environ | alone)
    except subprocess.TimeoutExpired as error:
        return (error.stdout or b"").decode().splitlines(), f"stopped after {LIMIT} s"
    last = done.stderr.strip().splitlines()[-1:]
    return done.stdout.splitlines(), " ".join(["exit status", str(done.returncode), *last]) if done.returncode else ""


def _parsed(program: str, answer: tuple[list[str], str]) -> Iterator[Run]:
    lines, stopped = answer
    for line in lines:
        if line.startswith("{") and line.endswith("}"):
            found = json.loads(line)
            t, x = np.array(found.pop("t", [])), np.array(found.pop("x", []))
            yield Run(**found, t=t, x=x)
    if stopped:
        yield Run(program, "the runs that follow", message=stopped)
