"""The defect of a piece: its polynomials put into the model's own equations, at points inside it. An estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from nsmodel.pieces.bernstein import slope, value
from nsmodel.pieces.lengths import LOCAL, MULTIPLIERS
from nsmodel.pieces.modes import Place
from nsmodel.pieces.multipliers import NOTHING
from nsmodel.pieces.system import System
from nsmodel.proof.buffered import attached
from nsmodel.scheme.continuous import ContinuousProblem
from nsmodel.solve.rounding import error_bound

POINTS = (0.6, 0.95)  # Of a piece.
SEEN, SEEN_ROW = 1e-14, 1e-12  # Shares of what a residual is made of that are rounding.
ROUNDING = 8 * 2.0**-53  # c u, of the bound of running error analysis.


class Equations:
    """(f + g, h) at (t, x, l), as declared; and what rounding does to f + g there."""

    def __init__(self, problem: ContinuousProblem) -> None:
        self._problem, (n, m) = problem, (problem.x.numel(), problem.l.numel())
        out = [ca.densify(problem.f + problem.g), ca.densify(problem.h)]
        function = ca.Function("equations", [problem.t, problem.x, problem.l], out)
        self._given = [np.zeros(1), np.zeros(n), np.zeros(m)]
        self._found = np.zeros(n), np.zeros(m)
        self._buffer, self._call = attached(function, self._given, list(self._found))

    def __call__(self, time: float, state: Sequence[float], multipliers: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """The two; what they returned before is overwritten."""
        self._given[0][0], self._given[1][:], self._given[2][:] = time, state, multipliers
        self._call()
        return self._found

    @cached_property
    def _bound(self) -> ca.Function:
        p = self._problem
        given = [p.t, p.x, p.l]
        return ca.Function("bound", given, [error_bound(ca.densify(p.f + p.g), ca.veccat(*given))])

    def rounding(self) -> np.ndarray:
        """What f + g may err by (n,) where it was evaluated last, its arguments known to the nearest double."""
        return ROUNDING * np.array(self._bound(*self._given)).ravel()


def defect(system: System, place: Place, of: Equations, s: float, p: int, rtol: float, atol: list[float]) -> float:
    """An estimate of the local error in units of rtol, from |x' - f - g|, |y_a| and l in slip at points of the piece.

    A series cut after order p has the defect r s^p, which integrates to r(s) s/(p + 1). With blocks that slip, its part along g_l
    of held rows is one of l.
    """
    tau, sizes, worst = place.tau, system.sizes, 0.0
    held = [i for i, code in enumerate(place.codes) if code == 0]
    slipping = system.blocks.slipping(place.codes)
    for share in POINTS:
        at = share * s
        rows = [row[: p + 1] for row in system.x]
        x, rate = [value(row, at) for row in rows], [slope(row, at) for row in rows]
        l = [value(row, at) for row in system.push]
        for block in slipping:
            l[block.at[0] : block.at[-1] + 1] = block.pushing(at)
        velocity, y = of(place.t + tau * at, x, l)
        off, of_l, pushed = _split(system, place, np.array(rate) - tau * velocity, l)
        for i, d in of_l:
            if size := max(system.size_l(i), abs(l[i])):
                worst = max(worst, (abs(d) / tau - SEEN_ROW * size) / (MULTIPLIERS * rtol * size))
        for i, (v, w, missed) in enumerate(zip(rate, velocity, off, strict=True)):
            goal = rtol * max(sizes.x[i], abs(x[i]), abs(v * s)) + atol[i]
            seen, least = abs(missed), share**p * (p + 1) / s * goal / LOCAL if s else math.inf
            if not seen <= LOCAL * least:
                seen -= SEEN * (slope([abs(c) for c in rows[i]], at) + tau * (abs(w) + pushed[i]))
            if not seen <= least:
                seen -= tau * of.rounding()[i]
            if not seen <= 0:
                worst = max(worst, seen / (least * LOCAL) if least and seen == seen else math.inf)
        for i in held:
            if y[i]:
                size = max(sizes.y[i], system.terms(i, x, l))
                if system.blocks.all:
                    size = max(size, tau * at * float(np.abs(system.slopes()[2][i]) @ pushed))
                beyond, goal = abs(y[i]) - SEEN_ROW * size, MULTIPLIERS * rtol * size
                if beyond > goal / LOCAL:
                    beyond -= float(np.abs(system.slopes()[2][i]) @ (tau * at * of.rounding()))
                worst = max(worst, beyond / (goal + NOTHING))
        for block in slipping:
            rounding = ROUNDING * max(map(system.size_y, block.at))
            worst = max(worst, block.missed(at, y, rounding) / (MULTIPLIERS * rtol))
    return float(worst)


def _split(
    system: System, place: Place, off: np.ndarray, l: list[float]
) -> tuple[np.ndarray, list[tuple[int, float]], np.ndarray]:
    """What x' - f - g is beside the part along g_l of held rows; that part, of each l; the size of what multipliers add to x'.

    Without blocks that slip it is left as it is.
    """
    if not system.blocks.all:
        return off, [], np.zeros(system.n)
    how = system.solve(place.codes)
    B, _, C = system.slopes()
    pushed = np.abs(B) @ np.abs(l)
    if how.through is None:
        return off, [], pushed
    rows = list(how.active)
    moved = np.array(how.through) @ (C[rows] @ off)
    return off - B[:, rows] @ moved, list(zip(rows, moved.tolist(), strict=True)), pushed
