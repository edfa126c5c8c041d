"""The prototype and CVODE, built for a problem and called: states at equidistant times, events, CPU seconds of a run."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from events.printed import model_text
from nsmodel.event_driven.problem import ContinuousProblem

HERE = Path(__file__).resolve().parent
ROWS, ROOM, ORDERS = 241, 20_000, 32  # Rows of a run, room for events, the highest order of a series.
FLAGS = ["-O2", "-march=x86-64-v2", "-std=c++17", "-fPIC", "-shared", f"-DPM={ORDERS}"]
CVODE = ["-DWITH_CVODE", "-lsundials_cvode", "-lsundials_nvecserial"]
STAGES = 5
ENOUGH, REPEATS, LONG = 2e-3, 5, 1.0  # CPU seconds of one measurement, how many, and what is measured once.


@dataclass(frozen=True)
class Measured:
    """CPU seconds of a run, x (241, n) at equidistant times, how many events, steps or pieces."""

    seconds: float
    x: np.ndarray
    events: int = 0
    steps: int = 0


def compiler() -> str | None:
    """A C++ compiler, where there is one."""
    return next((path for path in map(shutil.which, ("g++", "clang++", "c++")) if path), None)


def with_cvode() -> bool:
    """Whether SUNDIALS CVODE can be built with."""
    text = "#include <cvode/cvode.h>\nint main() { SUNContext c; return SUNContext_Create(nullptr, &c); }"
    command = [str(compiler()), "-x", "c++", "-", "-o", "/dev/null", "-lsundials_cvode"]
    return (
        compiler() is not None and subprocess.run(command, input=text.encode(), capture_output=True, check=False).returncode == 0
    )


class Programs:
    """The programs of one problem, with t_end and x0 (n,)."""

    def __init__(self, problem: ContinuousProblem, t_end: float, folder: Path, *, cvode: bool, radau: bool = False) -> None:
        self.t_end, self.n = t_end, problem.x.numel()
        self.x0 = np.array([float(v) for v in np.ravel(problem.x0.elements())])
        (folder / "model.hpp").write_text(model_text(problem, STAGES if radau else 0))
        command = [str(compiler()), *FLAGS, '-DMODEL="model.hpp"', f"-I{folder}", "-o", str(folder / "programs.so")]
        command += [f"-DSTAGES={STAGES}"] if radau else []
        subprocess.run([*command, str(HERE / "main.cpp"), *(CVODE if cvode else [])], check=True)
        self._library = ctypes.CDLL(str(folder / "programs.so"))

    def taylor(self, tol: float) -> Measured | None:
        """A run of the prototype; None where it fails."""
        order = max(4, min(math.ceil(-math.log(tol) / 2) + 2, ORDERS - 2))
        return self._measured("taylor", ctypes.c_double(tol), ctypes.c_int(order))

    def radau(self, tol: float) -> Measured | None:
        """The same with pieces by Radau IIA."""
        return self._measured("radau", ctypes.c_double(tol))

    def cvode(self, rtol: float, stiff: bool, h_max: float = 0.0) -> Measured | None:
        """CVODE, stopped at roots: Adams's formulas, or BDF where ``stiff``; h_max 0: steps as long as it likes."""
        return self._measured("cvode", ctypes.c_double(rtol), ctypes.c_int(stiff), ctypes.c_double(h_max))

    def _measured(self, name: str, *options: Any) -> Measured | None:
        out, times, found = np.full((ROWS, self.n), np.nan), np.zeros(ROOM), np.zeros(2, np.int64)
        pointer = [ctypes.c_void_p(a.ctypes.data) for a in (self.x0, out, times, found)]
        call = getattr(self._library, name)

        def run(repeat: int) -> int:
            return call(
                ctypes.c_double(self.t_end), pointer[0], *options, ctypes.c_int(ROWS), pointer[1], pointer[2], ctypes.c_int(ROOM),
                ctypes.c_int(repeat), pointer[3],
            )  # fmt: skip

        if run(1) or not np.isfinite(out).all():
            return None
        return Measured(least(run), out, int(found[0]), int(found[1]))


def least(run: Callable[[int], object]) -> float:
    """CPU seconds of one of ``repeat`` runs, the least of several measurements."""
    repeat, best = 1, math.inf
    for _ in range(REPEATS):
        while True:
            start = time.process_time()
            run(repeat)
            spent = time.process_time() - start
            if spent >= ENOUGH:
                break
            repeat = max(2 * repeat, math.ceil(1.2 * repeat * ENOUGH / max(spent, 1e-6)))
        best = min(best, spent / repeat)
        if spent > LONG:
            break
    return best
