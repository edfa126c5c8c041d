"""The defect of a piece: its polynomials put into the model's own equations, at points inside it. An estimate."""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import numpy as np

from nsmodel.pieces.bernstein import slope, value
from nsmodel.pieces.lengths import MULTIPLIERS
from nsmodel.pieces.modes import Place
from nsmodel.pieces.multipliers import NOTHING
from nsmodel.pieces.system import System
from nsmodel.proof.buffered import attached
from nsmodel.scheme.continuous import ContinuousProblem

POINTS = (0.6, 0.95)  # Of a piece.
SEEN, SEEN_ROW = 1e-14, 1e-12  # Shares of what a residual is made of that are rounding.

Equations = Callable[[float, list[float], list[float]], tuple[np.ndarray, np.ndarray]]


def equations(problem: ContinuousProblem) -> Equations:
    """(f + g, h) at (t, x, l), as declared."""
    n, m = problem.x.numel(), problem.l.numel()
    out = [ca.densify(problem.f + problem.g), ca.densify(problem.h)]
    function = ca.Function("equations", [problem.t, problem.x, problem.l], out)
    t, x, l, rate, y = np.zeros(1), np.zeros(n), np.zeros(m), np.zeros(n), np.zeros(m)
    buffer, call = attached(function, [t, x, l], [rate, y])

    def at(time: float, state: list[float], multipliers: list[float]) -> tuple[np.ndarray, np.ndarray]:
        t[0], x[:], l[:] = time, state, multipliers
        call()
        return rate, y

    at.buffer = buffer  # pyright: ignore[reportFunctionMemberAccess]
    return at


def defect(system: System, place: Place, of: Equations, s: float, p: int, rtol: float, atol: list[float]) -> float:
    """An estimate of the local error in units of rtol, from |x' - f - g| and |y_a| at points of the piece.

    A series cut after order p has the defect r s^p, which integrates to r(s) s/(p + 1).
    """
    tau, sizes, worst = place.tau, system.sizes, 0.0
    held = [i for i, code in enumerate(place.codes) if code == 0]
    for share in POINTS:
        at = share * s
        rows = [row[: p + 1] for row in system.x]
        x, rate = [value(row, at) for row in rows], [slope(row, at) for row in rows]
        l = [row[0] if code else value(row, at) for row, code in zip(system.l, place.codes, strict=True)]
        velocity, y = of(place.t + tau * at, x, l)
        for i, (v, w) in enumerate(zip(rate, velocity, strict=True)):
            goal = rtol * max(sizes.x[i], abs(x[i]), abs(v * s)) + atol[i]
            seen = abs(v - tau * w) - SEEN * (slope([abs(c) for c in rows[i]], at) + abs(tau * w))
            if not seen <= 0:
                worst = max(worst, seen * s / (p + 1) / share**p / goal if goal and seen == seen else math.inf)
        for i in held:
            if y[i]:
                size = max(sizes.y[i], system.terms(i, x, l))
                worst = max(worst, (abs(y[i]) - SEEN_ROW * size) / (MULTIPLIERS * rtol * size + NOTHING))
    return float(worst)
