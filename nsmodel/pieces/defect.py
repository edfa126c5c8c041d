"""The defect of a piece: its polynomials put into the model's own equations, at a point inside it. An estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from nsmodel.pieces.bernstein import poly_slope, poly_slopes, poly_values
from nsmodel.pieces.lengths import LOCAL, MULTIPLIERS
from nsmodel.pieces.modes import PieceStart
from nsmodel.pieces.multipliers import NOTHING
from nsmodel.pieces.sizes import ROUNDING
from nsmodel.pieces.system import ModeSystem
from nsmodel.proof.buffered import attach_buffers
from nsmodel.scheme.continuous import ContinuousProblem
from nsmodel.solve.rounding import rounding_error_bound

POINT = 0.95  # Of a piece.
SEEN, SEEN_ROW = 1e-14, 1e-12  # Shares of what a residual is made of that are rounding.


class ModelEquations:
    """(f + g, h) at (t, x, l), as declared; and what rounding does to f + g there."""

    def __init__(self, problem: ContinuousProblem) -> None:
        self._problem, (n, m) = problem, (problem.x.numel(), problem.l.numel())
        out = [ca.densify(problem.f + problem.g), ca.densify(problem.h)]
        self._symbols = ca.vertcat(problem.t, problem.x, problem.l)
        self._n, self._given, self._found = n, np.zeros(1 + n + m), np.zeros(n + m)
        function = ca.Function("equations", [self._symbols], [ca.vertcat(*out)])
        self._buffer, self._call = attach_buffers(function, [self._given], [self._found])

    def __call__(self, time: float, state: Sequence[float], multipliers: Sequence[float]) -> tuple[list[float], list[float]]:
        """The two."""
        self._given[:] = [time, *state, *multipliers]
        self._call()
        found = self._found.tolist()
        return found[: self._n], found[self._n :]

    @cached_property
    def _rounding_bound(self) -> ca.Function:
        rate = ca.densify(self._problem.f + self._problem.g)
        return ca.Function("bound", [self._symbols], [rounding_error_bound(rate, self._symbols)])

    def rounding(self) -> np.ndarray:
        """What f + g may err by (n,) where it was evaluated last, its arguments known to the nearest double."""
        return ROUNDING * np.array(self._rounding_bound(self._given)).ravel()


def zero_start_scales(system: ModeSystem, place: PieceStart, of: ModelEquations, s: float) -> list[float]:
    """What states that begin at 0 come to at s of their series, and what f moves them by there: others 0.

    A motion that begins beyond the order is nothing on the piece, which says nothing of how large it is to be: of a state that
    has none of the first half of the orders nothing is asked here: `schwarz` bounds it.
    """
    x, l = poly_values(system.x, s), poly_values(system.push, s)
    velocity, _ = of(place.t + place.tau * s, x, l)
    moved = [max(abs(v), abs(place.tau * s * w)) for v, w in zip(x, velocity, strict=True)]
    return [0.0 if row[0] else v if any(row[: len(row) // 2]) else math.inf for row, v in zip(system.x, moved, strict=True)]


def estimate_local_error(
    system: ModeSystem,
    place: PieceStart,
    of: ModelEquations,
    s: float,
    p: int,
    rtol: float,
    atol: list[float],
    start_scales: list[float],
) -> float:
    """An estimate of the local error in units of rtol, from |x' - f - g|, |y_a| and l at a point of the piece.

    A series cut after order p has the defect r s^p, which integrates to r(s) s/(p + 1). What lies along g_l of held rows is an
    error of l: where x rests it is all that the end of a series of l leaves. ``later``: see `zero_start_scales`.
    """
    tau, sizes, worst = place.tau, system.sizes, 0.0
    held = [i for i, code in enumerate(place.codes) if code == 0]
    slipping = system.blocks.slipping_blocks(place.codes)
    at = POINT * s
    x, rate, l = poly_values(system.x, at), poly_slopes(system.x, at), poly_values(system.push, at)
    for block in slipping:
        l[block.at[0] : block.at[-1] + 1] = block.push_at(at)
    velocity, y = of(place.t + tau * at, x, l)
    largest = map(max, sizes.x, start_scales, map(abs, x), [abs(v * s) for v in rate])
    factor = POINT**p * (p + 1) / s if s else math.inf
    most = [factor * (rtol * size + more + NOTHING) / LOCAL for size, more in zip(largest, atol, strict=True)]
    off = [moved - tau * v for moved, v in zip(rate, velocity, strict=True)]
    shares = [abs(d) / least for d, least in zip(off, most, strict=True)]
    if system.blocks.all:
        missed = math.inf
    else:
        missed = max(shares) if sum(shares) <= LOCAL else _max_residual_ratio(system, off, most, at, tau, of, velocity)
    if not missed <= 1:
        off, of_l = _split_along_held_rows(system, place, off)
        missed = _max_residual_ratio(
            system, off, most, at, tau, of, (np.abs(velocity) + _multiplier_contribution(system, l)).tolist()
        )
        for i, d in of_l:
            if size := max(system.size_l(i), abs(l[i])):
                worst = max(worst, (abs(d) / tau - SEEN_ROW * size) / (MULTIPLIERS * rtol * size))
    worst = max(worst, missed / LOCAL)
    for i in held:
        if abs(y[i]) > SEEN_ROW * sizes.y[i]:
            size = max(sizes.y[i], system.terms(i, x, l))
            beyond, goal = abs(y[i]) - SEEN_ROW * size, MULTIPLIERS * rtol * size
            if beyond > goal / LOCAL:
                moved = tau * at * np.abs(system.slopes()[2][i])
                size = max(size, float(moved @ _multiplier_contribution(system, l)))
                beyond = abs(y[i]) - SEEN_ROW * size - float(moved @ of.rounding())
                goal = MULTIPLIERS * rtol * size
            worst = max(worst, beyond / (goal + NOTHING))
    for block in slipping:
        rounding = ROUNDING * max(map(system.size_y, block.at))
        worst = max(worst, block.law_residual(at, y, rounding) / (MULTIPLIERS * rtol))
    return float(worst)


def _max_residual_ratio(
    system: ModeSystem, off: Sequence[float], most: list[float], at: float, tau: float, of: ModelEquations, rates: Sequence[float]
) -> float:
    """The largest share that ``off`` is of what it may be at ``most``, beyond rounding; ``rates``: what x' is the sum of."""
    worst = 0.0
    for i, (missed, least) in enumerate(zip(off, most, strict=True)):
        seen = abs(missed)
        if not seen <= LOCAL * least:
            seen -= SEEN * (poly_slope([abs(c) for c in system.x[i]], at) + tau * abs(rates[i]))
        if not seen <= least:
            seen -= tau * of.rounding()[i]
        if not seen <= 0:
            worst = max(worst, seen / least if least and seen == seen else math.inf)
    return worst


def _multiplier_contribution(system: ModeSystem, l: list[float]) -> np.ndarray:
    """The size of what multipliers add to x'."""
    return np.abs(system.slopes()[0]) @ np.abs(l)


def _split_along_held_rows(
    system: ModeSystem, place: PieceStart, off: list[float]
) -> tuple[list[float], list[tuple[int, float]]]:
    """What x' - f - g is beside the part along g_l of held rows; that part, of each l."""
    how = system.solve(place.codes)
    B, _, C = system.slopes()
    if how.through is None:
        return off, []
    rows = list(how.active)
    moved = np.array(how.through) @ (C[rows] @ off)
    return (off - B[:, rows] @ moved).tolist(), list(zip(rows, moved.tolist(), strict=True))
