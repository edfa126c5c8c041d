"""How far a series goes: the length of a piece from the last two coefficients (Jorba and Zou 2005).

Of x, y and l, and of what switches look at: x may be a line where that turns.

The defect of a piece: its polynomials put into the model's own equations, at a point inside it. An estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import accumulate, repeat
from operator import mul
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.event_driven.bernstein import poly_slope, poly_slopes, poly_values
from nsmodel.event_driven.modes import PieceStart
from nsmodel.event_driven.multipliers import NOTHING, TERM_ROUNDING, MultiplierSolver
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.system import LITTLE, ModeSystem
from nsmodel.proof.verdict import BufferedFunction
from nsmodel.solvers.rounding_errors import rounding_error_bound

LARGEST_ORDER = 30  # Of a series, for which C has memory; rtol = 1e-14 asks for 22.
BEYOND = 3  # Orders of a series beyond -ln(rtol)/2, see `taylor_order`. (~)
LOCAL, ROUGHEST = 0.01, 1e-1  # A piece errs by this share of rtol, so that 100 add up to rtol, and of no more than this.
LONGEST = 32.0  # In units of time: a piece that would be longer begins anew in another unit: s^30 is 2^150.
MULTIPLIERS = 100.0  # l and y are asked for to so many times rtol: of index 2 they have one order less than x. (~)
PASSES = 3  # In which sizes on the piece and its length settle; later ones change the length by little. (~)
FIRST = 0.1  # By which share of their size states may move in the first unit of time: pieces tell the next one. (~)
# SMALL: less asks for digits that rounding of the others takes, more forgives errors of small ones.
SMALL = 1e-3  # Rows of y and l below this share of the largest are measured beside that share. (~)


def taylor_order(rtol: float) -> int:
    """The order of the series: one more than where products cost least (Jorba and Zou 2005), as a piece has its own price."""
    return min(math.ceil(-math.log(LOCAL * min(rtol, ROUGHEST)) / 2) + BEYOND, LARGEST_ORDER)


def step_size(system: ModeSystem, codes: list[int], how: MultiplierSolver, p: int, rtol: float, atol: list[float]) -> float:
    """The length of the piece in tau; a row's size is that on the piece too."""
    sizes, known = system.sizes, p if how.index == 1 else p - 1
    y_floor, l_floor = (SMALL * max(of, default=0.0) for of in (sizes.y, sizes.l))
    pushed = (TERM_ROUNDING * v + NOTHING for v in system.pushed())
    rows = [_CoefficientRow(*given) for given in zip(system.x, repeat(p), repeat(rtol), sizes.x, atol, pushed)]
    for i, code in enumerate(codes):
        row, orders, size = system.l[i], known, max(sizes.l[i], l_floor)
        if code:
            if i in system.blocks.of:
                rows.append(_CoefficientRow(row, orders, MULTIPLIERS * rtol, size))
            row, orders, size = system.y[i], p, max(sizes.y[i], y_floor)
        rows.append(_CoefficientRow(row, orders, MULTIPLIERS * rtol, size))
    for (name, i), size in zip(system.branches, sizes.switches, strict=True):
        part = system.parts[name]
        rows.append(_CoefficientRow(part.rows[part.jets.branches[i].row], p - 1, MULTIPLIERS * rtol, size))
    return _common_length(rows)


def initial_time_unit(system: ModeSystem, t: float, x: list[float], tau: float, sizes: list[float] | None = None) -> float:
    """The time in which f changes the state by its own size, or by ``sizes``, where both are something; else tau."""
    system.t[0], system.t[1] = t, 1.0
    for row, v in zip(system.x, x, strict=True):
        row[0] = v
    rates = [abs(v) / abs(a) for v, a in zip(system.parts["f"].order(0), sizes or x, strict=True) if a and math.isfinite(v)]
    return power_of_two_unit(FIRST / max(rates)) if max(rates, default=0.0) > 0 else tau


def power_of_two_unit(tau: float) -> float:
    """The power of two that is not below tau: in this unit a piece is not longer than 1."""
    fraction, exponent = math.frexp(tau)
    return math.ldexp(1.0, exponent - (fraction == 0.5))


class _CoefficientRow(NamedTuple):
    """A row's coefficients, how many are known, what it is asked for, its size so far, and rounding."""

    c: list[float]
    known: int
    rtol: float
    so_far: float
    more: float = 0.0
    rounding: float = 0.0

    def max_length(self, size: float) -> float:
        """How far it goes with this size: |c_p| s^p and |c_(p-1)| s^(p-1) are at most rtol of it.

        Of size 0 it is its first term, and where that is none of the first half later terms are at most that.
        """
        c, p, rtol, _, more, rounding = self
        first, s, goal = 0, LONGEST, rtol * size + more
        if not goal:
            first = next((k for k in range(p) if c[k]), p)
            goal = (rtol if first < p // 2 else 1.0) * abs(c[first]) if first else 0.0
        if goal < rounding:
            goal = rounding
        for k in (p, p - 1):
            if (a := abs(c[k])) and k > first and (most := (goal / a) ** (1 / (k - first))) < s:
                s = most
        return s


def _common_length(rows: list[_CoefficientRow]) -> float:
    """The longest s that all rows let, with the sizes that they have on it.

    With its size so far and at the start a row goes no further than with that on the piece: most need no look at the latter.
    """
    least, given = [], LONGEST
    for number, row in enumerate(rows):
        size, start = row.so_far, abs(row.c[0])
        s = row.max_length(size if size > start else start)
        least.append((s if size or start or row.more else 0.0, number))
        if s < given:
            given = s
    least.sort()
    half = max((row.known for row in rows), default=0) // 2
    for _ in range(PASSES - 1):
        powers, before, given = list(accumulate([given] * half, mul, initial=1.0)), given, LONGEST
        for s, number in least:
            if s >= given:
                break
            row = rows[number]
            size = max(row.so_far, *map(mul, map(abs, row.c[: row.known // 2]), powers))
            given = min(given, row.max_length(size))
        if given == before:
            break
    return given


POINT = 0.95  # Of a piece: near its end, where the defect of a series, like s^p, is largest.
SEEN, SEEN_ROW = 1e-14, 1e-12  # Shares of what a residual is made of that are rounding: 45 EPS of x', 4500 of rows, as TIE. (+)


class ModelEquations:
    """(f + g, h) at (t, x, l), as declared; and what rounding does to f + g there."""

    def __init__(self, problem: ContinuousProblem) -> None:
        self._problem, self._symbols = problem, ca.vertcat(problem.t, problem.x, problem.l)
        out = ca.vertcat(ca.densify(problem.f + problem.g), ca.densify(problem.h))
        self._function, self._n = BufferedFunction(ca.Function("equations", [self._symbols], [out])), problem.x.numel()
        (self._given,), self._found = self._function.inputs, self._function.outputs[0].ravel("K")

    def __call__(self, time: float, state: Sequence[float], multipliers: Sequence[float]) -> tuple[list[float], list[float]]:
        """The derivatives x' and the values y of the model at a point."""
        self._given[:] = [time, *state, *multipliers]
        self._function.run()
        found = self._found.tolist()
        return found[: self._n], found[self._n :]

    @cached_property
    def _rounding_bound(self) -> ca.Function:
        rate = ca.densify(self._problem.f + self._problem.g)
        return ca.Function("bound", [self._symbols], [rounding_error_bound(rate, self._symbols)])

    def rounding(self) -> np.ndarray:
        """What f + g may err by (n,) where it was evaluated last, its arguments known to the nearest double."""
        return TERM_ROUNDING * np.array(self._rounding_bound(self._given)).ravel()


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
        missed = max(shares) if sum_in_order(shares) <= LOCAL else _max_residual_ratio(system, off, most, at, tau, of, velocity)
    if not missed <= 1:
        off, of_l = _split_along_held_rows(system, place, off)
        missed = _max_residual_ratio(
            system, off, most, at, tau, of, (np.abs(velocity) + _multiplier_contribution(system, l)).tolist()
        )
        for i, d in of_l:
            if size := max(system.size_l(i), LITTLE * max(abs(l[j]) for j in system.problem.row_groups[i]), abs(l[i])):
                worst = max(worst, (abs(d) / tau - SEEN_ROW * size) / (MULTIPLIERS * rtol * size))
    worst = max(worst, missed / LOCAL)
    for i in held:
        if abs(y[i]) > SEEN_ROW * sizes.y[i]:
            size = max(sizes.y[i], system.terms(i, x, l))
            beyond, goal = abs(y[i]) - SEEN_ROW * size, MULTIPLIERS * rtol * size
            if beyond > goal / LOCAL:
                moved = tau * at * np.abs(system.slopes()[2][i])
                size = max(size, float(moved @ _multiplier_contribution(system, l)))
                size = max(size, system.size_y(i), LITTLE * max(system.terms(k, x, l) for k in system.problem.row_groups[i]))
                beyond = abs(y[i]) - SEEN_ROW * size - float(moved @ of.rounding())
                goal = MULTIPLIERS * rtol * size
            worst = max(worst, beyond / (goal + NOTHING))
    for block in slipping:
        rounding = TERM_ROUNDING * max(map(system.size_y, block.at))
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
