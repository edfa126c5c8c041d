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
PEERS = "NSMODEL_PEERS_PYTHON"  # names the Python that has the programs from PyPI
LIMIT = 240  # s for one program on one scene
RELAYS = ("friction_oscillator", "sliding_relay")
ALL = (*RELAYS, "diode_bridge", "point_past_disc")
FROM_PYPI = {
    "nosnoc": RELAYS,
    "solve_nivp": ALL,
    "heyoka": (*ALL, "buck"),
    "pulsim": ("diode_bridge", "buck"),
}  # and their scenes


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


def from_pypi(module: str) -> str | None:
    """The first Python that has a program from PyPI, the one named in NSMODEL_PEERS_PYTHON before this one."""
    return _that_has(module, [os.environ.get(PEERS), sys.executable])


def crowd_steps(scene: Path) -> tuple[dict[str, float] | None, str]:
    """Milliseconds of the parts of cromosim's step from the state in a file; None where it is not installed, or failed: why."""
    lines, stopped = _ask(from_pypi("cromosim"), "in_cromosim.py", str(scene))
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

    nosnoc 0.2 takes piecewise smooth fields: relays, but neither complementarity with a D nor constraints on the state. Pulsim
    takes circuits.
    """
    from peers import in_events, in_scipy

    if scene in in_scipy.SCENES:
        yield from in_scipy.runs(scene)
    yield from in_events.runs(scene)
    if scene in ALL:
        yield from _parsed("Siconos", _ask(siconos(), "in_siconos.py", "runs", scene))
    for program, scenes in FROM_PYPI.items():
        if scene in scenes:
            yield from _parsed(program, _ask(from_pypi(program), f"in_{program}.py", scene))


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
