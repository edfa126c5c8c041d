"""Programs that tests start, and kill in the middle of a run; runs whose steps they interfere with."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import nsmodel

RUN = importlib.import_module("nsmodel.simulation.fixed_grid")

HERE = Path(__file__).resolve().parent


def environment(**more: str) -> dict[str, str]:
    """Variables with which a program finds nsmodel and the tests' modules."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(nsmodel.__file__).parents[1]), str(HERE)])} | more


def start(code: str, folder: Path, *arguments: str) -> subprocess.Popen:
    """Start a program in ``folder``."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.Popen(command, cwd=folder, env=environment(), stdout=subprocess.PIPE, text=True)


def kill_when_there(process: subprocess.Popen, path: Path, later: float = 0.0) -> None:
    """Kill a program as soon as a file is there, or some seconds later; it must be running then."""
    end = time.monotonic() + 60
    while not path.exists():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(1e-4)
    time.sleep(later)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL


def before_step(monkeypatch, call, act):
    """Let the steppers of the next runs ``act`` before their ``call``-th step."""
    make, calls = RUN.make_stepper, []

    def watched(*args, **options):
        stepper = make(*args, **options)

        class Watched(type(stepper)):
            def __call__(self, *args):
                calls.append(1)
                if len(calls) == call:
                    act()
                return super().__call__(*args)

        stepper.__class__ = Watched
        return stepper

    monkeypatch.setattr(RUN, "make_stepper", watched)


def fail(error):
    def act():
        raise error

    return act
