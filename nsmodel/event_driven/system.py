"""A continuous problem with its numbers: Taylor coefficients of x, l and y in a mode, order by order.

A **mode** is a code a row: -1, +1: l_i is at that end, 0: y_i = 0. On the rows a with code 0, with D = h_l, W = h_x g_l at the
start of the piece, l_a is found order by order,

    l_k  -= D_aa^+ y_k                                (what y depends on directly: index 1)
    l_k  -= (k + 1)/tau N y_{k+1},  N = V (U' W_aa V)^+ U'  (what only y' depends on: index 2)

with U, V the left and the right null space of D_aa: mixed rows need both, regular D_aa the first, D_aa = 0 the second alone. The
coefficients are those of s = (t - t_0)/tau, so that they are of one size where tau is a time of the motion's own.

Whether a mode is solved: how far l still moves, and whether rows that no multiplier acts on stay at 0 by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, remember, sum_in_order
from nsmodel.event_driven.disc_arithmetic import EquationsOnDisc
from nsmodel.event_driven.friction_modes import SlipOnset
from nsmodel.event_driven.mode_series import ModeSeries, UnrolledOrders, nonzero_terms
from nsmodel.event_driven.multipliers import (
    NOTHING,
    TERM_ROUNDING,
    TIE,
    ErrorPropagation,
    MultiplierSolver,
    RowScales,
    StateScales,
    ZeroTest,
    constant_matrix,
    error_propagation,
    is_monotone,
    is_p_matrix,
    multiplier_solver,
)
from nsmodel.event_driven.problem import ContinuousProblem, NotEventDriven
from nsmodel.event_driven.recurrence_code import rescale_time
from nsmodel.event_driven.recurrences import independent_branches, taylor_decompose
from nsmodel.modeling.expressions import derivatives
from nsmodel.proof.verdict import BufferedFunction, not_none

TIME_ROUNDING = EPS / TERM_ROUNDING  # What time is known to, in the rounding of an operation.
STAYS = 1e-9  # Of what moves: a row that nothing acts on moves by less. More takes a slow row for one at rest. (+)


def relative_change(system: ModeSystem, how: MultiplierSolver, direct: list[float], through: list[float]) -> float:
    """The largest share by which l moved of what it is the sum of: of itself, and of the inverse times the terms of h."""
    l, moved = [abs(row[0]) for row in system.l], 0.0
    for inverse, step, k, time in ((how.direct, direct, 0, 1.0), (how.through, through, 1, system.t[1])):
        if inverse is not None:
            x = [abs(row[k]) / time for row in system.x]
            sizes = [system.sum_y_terms(i, x, l) for i in how.active]
            terms = (sum_in_order([abs(a) * size for a, size in zip(row, sizes, strict=True)]) for row in inverse)
            shares = (abs(d) / (NOTHING + l[i] + v) for i, d, v in zip(how.active, step, terms, strict=True))
            moved = max([moved, *shares])
    return moved


def remains_zero(system: ModeSystem, how: MultiplierSolver, orders: Iterable[int]) -> bool:
    """Whether the rows that no multiplier acts on stay at 0 by themselves, as redundant ones do; 1: once x has its rate.

    Where x rests its coefficients are rounding of what multipliers push it by, or exactly 0, and y of curved rows is what their
    products are: what is below that rounding in the unit of time is no motion.
    """
    if how.null is None or not how.null.size:
        return True
    pushed, none = system.pushed(), [0.0] * system.m
    rounding = TERM_ROUNDING * np.abs(how.null.T) @ [system.sum_y_terms(i, pushed, none) for i in how.active]
    for k in orders:
        y = np.array([system.y[i][k] for i in how.active])
        size = max([float(np.abs(y).max()), *(abs(row[k]) for row in system.x)])
        if not (np.abs(how.null.T @ y) <= np.maximum(STAYS * size, rounding)).all():
            return False
    return True


NEWTON = 30  # Iterations of l at order 0, at most, where f, g or h are not linear in it; then the next start, or no mode.
NEWTON_CONVERGED = 1e-14  # Relative, for each iteration allowed: a change of l below NEWTON times this, 3e-13, is rounding. (+)
MAX_CACHED_MODES = 1000  # Modes with their slopes whose matrices are kept; one more, and all are made anew.
HELD_ORDERS = 4  # Orders of a row that nothing acts on, and that must be 0; of later ones products leave more rounding. (+)
SOLVED = TERM_ROUNDING / TIE  # Of what l of a held row is the sum of: TIE of this is the rounding of its solve.
# LITTLE: less asks for digits that rounding of the others takes, more forgives errors of small ones.
LITTLE = 1e-6  # Of the largest multiplier, or y, of rows that are tied: a smaller one is measured beside that. (+)
# RESTS: less takes the rounding of forces at rest for motion, more slow motion for rest.
RESTS = 1e-3  # Of what l pushes by in the unit of time: where x rests all the same, TIE of it is rounding. (+)
AT_ONCE = 2.0**-40  # Of the time, 4096 EPS: what comes to 0 so soon is at 0, in the words of an error.
AT_ZERO = 1e-9  # Of the terms of y_i: a row that is held is not further from 0; less refuses what pieces leave of rtol. (+)


def _first_orders(rows: Sequence[Sequence[float]], number: int) -> np.ndarray:
    """The first coefficients (rows, number), 0 beyond those that there are."""
    out = np.zeros((len(rows), number))
    if rows:
        out[:, : len(rows[0])] = [row[:number] for row in rows]
    return out


class ModeSystem(ModeSeries):
    """A problem with its numbers; ``rtol``: see `sliding.Block.stop_threshold`."""

    def __init__(self, problem: ContinuousProblem, orders: int, rtol: float = 0.0) -> None:
        self.rtol = rtol
        p, inputs = problem, [problem.t, problem.x, problem.l]
        B, D, C = p.slopes
        self.linear_in_l, self.coupled = not ca.depends_on(ca.veccat(B, D), p.l), p.coupled
        constant_B, of_l, self.C = (constant_matrix(matrix, ca.veccat(*inputs)) for matrix in (B, D, C))
        self.constant = None if constant_B is None or of_l is None or self.C is None else (constant_B, of_l, self.C)
        h = p.h if of_l is None else ca.substitute(p.h, p.l, ca.SX.zeros(p.l.shape)) if p.l.numel() else p.h
        jets = {"f": taylor_decompose(p.f, inputs, "f"), "h": taylor_decompose(h, inputs, "h")}
        jets |= {"g": taylor_decompose(p.g, inputs, "g")} if constant_B is None else {}
        jets |= {name: taylor_decompose(p.updates[rows], inputs, f"the update of {name}") for name, rows in p.block_parts.items()}
        for name, rows in p.block_parts.items():
            others = p.x[[i for k, i in enumerate(p.updated) if k not in rows]]
            if not jets[name].branches and ca.depends_on(p.updates[rows], others):
                raise NotEventDriven(f"{name} sets what other blocks hold, at no switch; let the block that sets it do so")
        super().__init__(problem, jets, constant_B, of_l, orders)
        self.lower, self.upper = (
            [float(v) for v in np.array(ca.DM(end)).ravel()] for end in (problem.law.lower, problem.law.upper)
        )
        widths = [b - a if np.isfinite(b - a) else 0.0 for a, b in zip(self.lower, self.upper, strict=True)]
        self.sizes = StateScales([0.0] * self.n, [0.0] * self.m, widths, [0.0] * len(self.branches))
        self.zero_test = ZeroTest(problem)
        self._slopes = ca.Function("slopes", [ca.vertcat(p.t, p.x, p.l)], [ca.densify(e) for e in (B, D, C)])
        self.conditions: dict[tuple, list[Any]] = {}  # Of modes; see `switches.conditions`.
        self._solvers: dict[tuple, MultiplierSolver] = {}
        self._p_matrices: dict[tuple, bool] = {}
        self._point: list[float] | None = None  # Where the slopes were computed last, and what was made of them there.
        self._point_cache: dict[Any, Any] = {}
        always: dict[Any, Any] = {}  # What was made of those that are constant.
        moves = {"B": self.B is None, "D": of_l is None, "C": self.C is None}
        self._slope_caches = {
            of: self._point_cache if any(moves[name] for name in of) else always for of in ("BDC", "DC", "B", "D", "C")
        }
        self._propagations: dict[tuple[int, ...], ErrorPropagation] = {}
        # Else no l is what rounding leaves: neither of other rows nor of a small D.
        self.analyses_rounding = bool(self.m and (self.feedthrough.any() or any(len(group) > 1 for group in p.row_groups)))
        self.is_linear = (
            self.constant is not None and not self.blocks.all and not ca.depends_on(derivatives(p.f, p.x), ca.veccat(*inputs))
        )
        self._slip_onset: SlipOnset | None = None
        self.how: MultiplierSolver | None = None  # Of the mode that stands, and what its l are the sums of.
        self._solved: list[float] | None = None
        self._rounding: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}  # Of the orders that stand.
        self._has_all_orders = False  # Whether all orders stand, whatever was asked for.
        self._unrolled = None if self.blocks.all or self.updates else UnrolledOrders(self, linear=self.linear_in_l)

    @cached_property
    def middle(self) -> list[float]:
        """Of each l its middle, or the end that there is, or 0."""
        return [
            (a + b) / 2 if math.isfinite(a + b) else a if math.isfinite(a) else b if math.isfinite(b) else 0.0
            for a, b in zip(self.lower, self.upper, strict=True)
        ]

    @cached_property
    def rounded(self) -> EquationsOnDisc:
        """F, g, h and branches with balls, which grow by the rounding of each operation."""
        return EquationsOnDisc(self, rounded=True)

    @cached_property
    def plain(self) -> dict[tuple[str, int], bool]:
        """Of each switch in f, g and h whether neither l nor another switch moves what it looks at."""
        return {
            (name, i): own for name, recurrences in self.jets.items() for i, own in enumerate(independent_branches(recurrences))
        }

    @cached_property
    def nested(self) -> list[tuple[str, int]]:
        """The switches, in blocks too, that look at what others choose, or a multiplier."""
        return [switch for switch, own in self.plain.items() if not own]

    @cached_property
    def feedthrough(self) -> np.ndarray:
        """Whether each y (m,) depends on l directly."""
        rows = set(ca.jacobian_sparsity(self.problem.h, self.problem.l).row()) if self.m else set()
        return np.array([i in rows for i in range(self.m)], bool)

    def why_no_mode(self, t: float, x: list[float], rate: Sequence[float], of: str, when: str) -> str:
        """Why no mode ``of`` the open switches goes on; ``when``: at the start, after a switch; ``rate``: x' for some l."""
        if parts := self._parts_with_root_at_zero(t, x, rate):
            at = f"a root, or another power without a Taylor series at 0, is at 0 in {' and '.join(parts)}"
            return f"{at}; time steps go over that: method='auto' or 'time-stepping' (--method auto)"
        if not self.m and not self.branches:
            return f"f has no number, or no Taylor series, {when}: no smooth piece goes on from here"
        return f"no mode {of}is valid {when}: no smooth piece goes on from here"

    def _parts_with_root_at_zero(self, t: float, x: list[float], rate: Sequence[float]) -> list[str]:
        """Of f, g and h those with a root, or a power, whose base comes to 0 within rounding of the time."""
        own = {name: [line.of[0] for line in jet.lines if line.kind in ("root", "power")] for name, jet in self.jets.items()}
        if not any(own.values()):
            return []
        soon = AT_ONCE * max(abs(t), self.t[1])

        def bases(t: float, x: list[float]) -> dict[str, np.ndarray]:
            self.outputs(t, x)
            for part in self.parts.values():
                part.compute(0)
            return {name: np.array([self.parts[name].rows[base][0] for base in rows]) for name, rows in own.items()}

        next_, now = bases(t + soon, [a + soon * b for a, b in zip(x, rate, strict=True)]), bases(t, x)
        return [name for name, base in now.items() if (np.abs(base) <= np.abs(next_[name] - base)).any()]

    def slopes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(B, D, C) at order 0."""
        if self.constant is not None:
            return self.constant
        point = [self.t[0], *[row[0] for row in self.x], *[row[0] for row in self.push]]
        if point != self._point:
            self._point = point
            self._point_cache.clear()
            self._slope_evaluator(point)
        B, D, C = self._slope_evaluator.outputs
        return B, D, C

    def rounding(self, orders: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What orders 0, ..., ``orders`` of x, l and y (n or m, orders + 1) of the mode that stands are known to.

        A running error analysis: x begins with its own rounding, each order is rounded as what it is the sum of, and takes on the
        errors of those before, to first order at the place. Matrices are multiplied before their sizes are taken, as held rows
        take errors back.
        """
        if orders not in self._rounding:
            self._rounding[orders] = self._analyse_rounding(orders)
        return self._rounding[orders]

    def _analyse_rounding(self, orders: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        how, tau = not_none(self.how), abs(self.t[1])
        B, D, C = self.cached_from_slopes("sizes", lambda *slopes: tuple(map(np.abs, slopes)))
        a, of, early = list(how.active), self._error_propagation(how), TIME_ROUNDING * abs(self.t[0]) / tau
        x, l, y = (np.abs(_first_orders(rows, orders + 3)) for rows in (self.x, self.l, self.y))
        f, h = (x[:, 1:] * np.arange(1, orders + 3)) / tau + B @ l[:, :-1], y + D @ l
        f, h = (part[:, :-1] + early * part[:, 1:] * np.arange(1, part.shape[1]) for part in (f, h))  # At t, rounded.
        part, f, after = np.arange(1, orders + 2) / tau, f[:, : orders + 1], h[:, 1 : orders + 2]
        x, l, h = (given[:, : orders + 1] for given in (x, l, h))
        terms, first = C @ x + h, l.copy()
        if a:
            first[a] += of.l_of_y @ terms[a]  # What l is by y alone, before y' moves it.
        rate = f + B @ first
        given = np.vstack([terms[a], rate, (C @ rate + part * after)[a]])
        own_x = of.x_of_rounding @ given
        of_x, of_l = np.zeros((self.n, orders + 2)), np.zeros((self.m, orders + 1))
        of_x[:, 0] = x[:, 0]
        for k in range(orders + 1):
            of_x[:, k + 1] = (of.x_of_x @ of_x[:, k] + own_x[:, k] + rate[:, k]) / part[k]
        if a:
            of_l[a] = of.l_of_x @ of_x[:, :-1] + of.l_of_rounding @ given + l[a]
        of_y = terms + C @ of_x[:, :-1] + D @ of_l
        u = TERM_ROUNDING * (1 + (self.n + self.m) / 4)  # Of sums of so many terms.
        return u * of_x[:, :-1], u * of_l, u * of_y

    def _error_propagation(self, how: MultiplierSolver) -> ErrorPropagation:
        def make() -> ErrorPropagation:
            return error_propagation(how, self.rate_slopes(), *self.slopes())

        return remember(self._propagations, how.active, make, MAX_CACHED_MODES) if self.is_linear else make()

    def rate_slopes(self) -> np.ndarray:
        """(f + g)_x (n, n) at order 0."""
        point = [self.t[0], *[row[0] for row in self.x], *[row[0] for row in self.push]]
        return np.array(self._rate_slopes(point))

    @cached_property
    def _rate_slopes(self) -> ca.Function:
        p = self.problem
        return ca.Function("A", [ca.vertcat(p.t, p.x, p.l)], [ca.densify(derivatives(p.f + p.g, p.x))])

    @cached_property
    def _slope_evaluator(self) -> BufferedFunction:
        return BufferedFunction(self._slopes)

    def cached_from_slopes(self, what: Any, make: Callable[..., Any], of: str = "BDC") -> Any:
        """What ``make`` makes of (B, D, C) at order 0, or ``of`` some of them: kept while these stay what they are."""
        kept = self._slope_caches[of]
        if kept is self._point_cache:
            self.slopes()
        if what not in kept:
            if len(kept) >= MAX_CACHED_MODES:
                kept.clear()
            kept[what] = make(*self.slopes())
        return kept[what]

    def solve(self, codes: list[int]) -> MultiplierSolver:
        """What finds the multipliers of a mode, at the point that order 0 is."""
        active = tuple([i for i, code in enumerate(codes) if code == 0])
        return self.cached_from_slopes(active, lambda *slopes: self._cached_solver(active, slopes))

    def _cached_solver(self, active: tuple[int, ...], slopes: tuple[np.ndarray, np.ndarray, np.ndarray]) -> MultiplierSolver:
        def make() -> MultiplierSolver:
            found = multiplier_solver(active, *slopes, lifts=bool(self.blocks.all))
            return replace(found, entries=self._unrolled.entries(found)) if self._unrolled else found

        key = (active, *(() if self.constant else (a.tobytes() for a in slopes)))
        return remember(self._solvers, key, make, MAX_CACHED_MODES)

    def expand(self, t: float, x: list[float], codes: list[int], tau: float, orders: int) -> MultiplierSolver | None:
        """Compute orders 0, ..., ``orders`` of x and y, and of l as far as its index lets; None: the mode has no solution.

        ``l`` at order 0 is the first guess of what is not linear in it.
        """
        self.how = self._solved = None
        self._rounding.clear()
        self.how = how = self._expand_mode(t, x, codes, tau, orders)
        return how

    def _expand_mode(self, t: float, x: list[float], codes: list[int], tau: float, orders: int) -> MultiplierSolver | None:
        self.t[0], self.t[1] = t, tau
        for row, start in zip(self.x, x, strict=True):
            row[0] = start
        for row, code, lower, upper in zip(self.l, codes, self.lower, self.upper, strict=True):
            if code and math.isfinite(end := upper if code > 0 else lower):
                row[0] = end
            elif not code and self.linear_in_l:
                row[0] = 0.0
        linear = self.linear_in_l or 0 not in codes
        if linear and self._try_all_orders(known := self.solve(codes)):
            return known if self._held_rows_rest(known, range(1, min(orders, HELD_ORDERS) + 1)) else None
        for row in self.l:
            row[1:] = [0.0] * self.orders
        if (how := self._solve_order_0(codes)) is None or (
            self.blocks.onset_blocks and (how := self._solve_slip_onset(how)) is None
        ):
            return None
        if not linear and self._try_all_orders(how):
            return how if self._held_rows_rest(how, range(2, min(orders, HELD_ORDERS) + 1)) else None
        return how if self.extend(how, codes, 0, orders) else None

    def scale(self, times: float) -> None:
        """Let the unit of time be so many times as long, a power of two, in all rows that stand."""
        self._rounding.clear()
        parts = (part for part in self.parts.values() if part.jets.branches or not self._has_all_orders)
        rescale_time([self.t, *self.x, *self.l, *self.y, *(row for part in parts for row in part.rows)], times)

    def _try_all_orders(self, how: MultiplierSolver) -> bool:
        """Whether all orders could be computed at once: where no rows are held that nothing acts on, nor sides to be chosen."""
        self._has_all_orders = False
        if self._unrolled is None or (how.direct is not None and how.null is not None and how.null.size):
            return False
        if self.branches and any(side != side for part in self.parts.values() for side in part.choice):
            return False
        start = [row[0] for row in self.l]
        if not (self._unrolled.run(how) and math.isfinite(sum_in_order([row[-1] for rows in (self.x, self.l) for row in rows]))):
            for row, l in zip(self.l, start, strict=True):
                row[:] = [l, *[0.0] * self.orders]
            return False
        self._has_all_orders = True
        return True

    def _held_rows_rest(self, how: MultiplierSolver, orders: Iterable[int]) -> bool:
        """Whether held rows stay at 0; their y is put to 0 then: all orders but the first of one that only y' holds."""
        if not remains_zero(self, how, orders):
            return False
        first = 1 if how.through is not None else 0
        for i in how.active:
            self.y[i][first:] = [0.0] * (self.orders + 1 - first)
        return True

    def extend(self, how: MultiplierSolver, codes: list[int], known: int, orders: int) -> bool:
        """Compute orders ``known``, ..., ``orders`` in the same mode; whether it has them all."""
        if known and self._has_all_orders:
            return True
        self._rounding.clear()
        self.compute_orders(how, codes, known, orders)
        if not self._held_rows_rest(how, () if known else range(2, min(orders, HELD_ORDERS) + 1)):
            return False
        self.blocks.watch(codes, orders if how.index == 1 else orders - 1)
        return True

    def outputs(self, t: float, x: list[float]) -> None:
        """Order 0 of y, with l as it stands."""
        self.t[0] = t
        for row, start in zip(self.x, x, strict=True):
            row[0] = start
        self._compute_y(0)

    def _solve_order_0(self, codes: list[int]) -> MultiplierSolver | None:
        """What solves order 0, once l has it: from the guess that l is, then from the middle of K; None: l is the guess again."""
        guess = [row[0] for row in self.l]
        middle = [l if code else self.middle[i] for i, (l, code) in enumerate(zip(guess, codes, strict=True))]
        for start in (guess,) if self.linear_in_l else (guess, middle):
            for row, l in zip(self.l, start, strict=True):
                row[0] = l
            self._compute_y(0)
            how, self._slip_onset = self.solve(codes), None
            self.blocks.begin(codes, self.size_y)
            if (solved := self._converge_order_0(how, codes)) is not None:
                return solved
        for row, l in zip(self.l, guess, strict=True):
            row[0] = l
        return None

    def rows_off_zero(self, how: MultiplierSolver) -> list[int]:
        """The rows that only their rate can hold at 0, and that are not there: beside their size, and how far x moves them."""
        if how.through is None or not any(self.y[i][0] for i in how.active):
            return []
        motion = np.abs(self.slopes()[2]) @ [abs(row[1]) for row in self.x]
        x, l = ([row[0] for row in rows] for rows in (self.x, self.l))
        off = [i for i in how.active if abs(self.y[i][0]) > AT_ZERO * max(self.size_y(i), motion[i], self.terms(i, x, l))]
        if not off or self.blocks.all:
            return off
        known = self.rounding(0)[2][:, 0]
        return [i for i in off if abs(self.y[i][0]) > known[i]]

    def size_y(self, i: int) -> float:
        """What y_i is measured beside: the largest so far, a part of those it is tied to, its terms, rounding of l."""
        terms = self.terms(i) + RESTS * abs(self.t[1]) * self._push_scale(i)
        own = max(self.sizes.y[i], LITTLE * max(self.sizes.y[j] for j in self.problem.row_groups[i]), terms)
        return (
            max(own, sum_in_order(a * self._solved_terms(j) for j, a in self._feedthrough_terms[i]))
            if self.feedthrough[i]
            else own
        )

    def row_scales(self) -> RowScales:
        """What y and l of all rows are measured beside at the place."""
        measured = self._measured_rows
        of_y, of_l = ([of(i) if measured[i] else 1.0 for i in range(self.m)] for of in (self.size_y, self.size_l))
        return RowScales(of_y, of_l)

    @cached_property
    def _measured_rows(self) -> list[bool]:
        """Whether y of a row depends on l directly, or the row is one of a ball or an ellipsoid."""
        return [self.feedthrough[i] or self.blocks.is_curved(i) for i in range(self.m)]

    def _push_scale(self, i: int) -> float:
        """|C_i| |B| |l|, with what l moves by in the unit of time."""
        rows = self.cached_from_slopes("push of y", lambda B, _, C: nonzero_terms(np.abs(C) @ np.abs(B), self.m))
        return sum_in_order([a * (abs(self.push[j][0]) + abs(self.push[j][1])) for j, a in rows[i]])

    def pushed(self) -> list[float]:
        """By what multipliers push each x in the unit of time, in size: in stick f takes that back."""
        l, tau = [abs(row[0]) + abs(row[1]) for row in self.push], abs(self.t[1])
        of_x = self.cached_from_slopes("push of x", lambda B, _, __: nonzero_terms(np.abs(B), self.n), "B")
        return [tau * sum_in_order([a * l[j] for j, a in own]) for own in of_x]

    @property
    def _feedthrough_terms(self) -> list[list[tuple[int, float]]]:
        """|D|, of each row what is not 0."""
        return self.cached_from_slopes("y of l", lambda _, D, __: nonzero_terms(np.abs(D), self.m), "D")

    def size_l(self, i: int) -> float:
        """What l_i is measured beside: the largest so far, a part of those it is tied to, and what rounding leaves of it."""
        return max(self.sizes.l[i], LITTLE * max(self.sizes.l[j] for j in self.problem.row_groups[i]), self._solved_terms(i))

    def _solved_terms(self, i: int) -> float:
        """What l_i is the sum of, the rounding of its solve taken for TIE of it."""
        how = self.how
        if not self.analyses_rounding or how is None or i not in how.active:
            return 0.0
        if self._solved is None:
            self._solved = self._all_solved_terms(how)
        return self._solved[how.active.index(i)]

    def _all_solved_terms(self, how: MultiplierSolver) -> list[float]:
        a, (B, D, C) = list(how.active), map(np.abs, self.slopes())
        x, l, y = (np.abs(_first_orders(rows, 2)) for rows in (self.x, self.l, self.y))
        h, total, (direct, through) = y + D @ l, np.zeros(len(a)), how.sizes
        if direct is not None:
            total += direct @ (h[:, 0] + C @ x[:, 0])[a]
        if through is not None:
            total += through @ ((h[:, 1] + C @ x[:, 1]) / abs(self.t[1]) + C @ (B @ l[:, 0]))[a]
        return (SOLVED * np.where(np.isfinite(total), total, 0.0)).tolist()

    def terms(self, i: int, x: Sequence[float] = (), l: Sequence[float] = ()) -> float:
        """The size of what y_i is the sum of, with the largest states and multipliers so far, and these."""
        of_x, of_l = self.sizes.x, self.sizes.l
        if x or l:
            of_x, of_l = (list(map(max, of, map(abs, now))) for of, now in ((of_x, x), (of_l, l)))
        return self.sum_y_terms(i, of_x, of_l)

    def sum_y_terms(self, i: int, x: Sequence[float], l: Sequence[float]) -> float:
        """|C_i| x + |D_i| l."""
        by_x = self.cached_from_slopes("y of x", lambda _, __, C: nonzero_terms(np.abs(C), self.m), "C")
        return sum_in_order([a * x[j] for j, a in by_x[i]] + [a * l[j] for j, a in self._feedthrough_terms[i]])

    @cached_property
    def is_monotone(self) -> bool:
        """Whether x is unique in all modes; see `multipliers.is_monotone`."""
        return not self.blocks.all and is_monotone(self.B, self.D, self.C)

    def are_coupled(self, rows: list[int]) -> bool:
        """Whether g or h has a product of two l of these rows: held together, their l may be several, or be missed by Newton."""
        return not self.linear_in_l and bool(self.coupled[np.ix_(rows, rows)].any())

    def is_p_matrix(self, opened: list[int], codes: list[int]) -> bool:
        """Whether the rows ``opened`` have a P-matrix, D with W where D is nothing, the other rows with code 0 held.

        Where some are those of a curved block: whether it is definite. Not where g or h has a product of two of these l. Of a D
        that moves it is that of D alone: nothing at a point, it is something after it, and y' has l by more than W.
        """
        key = (tuple(opened), tuple(i for i, code in enumerate(codes) if code == 0 and i not in opened))
        if self.are_coupled([*key[0], *key[1]]):
            return False
        if key not in self._p_matrices or self.constant is None:
            B, D, C = self.slopes()
            W = np.zeros_like(D) if self.D is None else C @ B
            self._p_matrices[key] = is_p_matrix(
                D, W, *map(list, key), definite=any(len(self.blocks.rows_of(i)) > 1 for i in opened)
            )
        return self._p_matrices[key]

    def _solve_slip_onset(self, how: MultiplierSolver) -> MultiplierSolver | None:
        """Order 0 of l, and order 1 of x, where blocks begin to slip."""
        tau, active = self.t[1], how.active if how.through is not None else ()
        self._slip_onset = release = SlipOnset(active, self.blocks.onset_blocks, self.slopes(), tau)
        self._compute_y(1)
        rate, l = (np.array([row[k] for row in (rows[i] for i in release.rows)]) for rows, k in ((self.y, 1), (self.l, 0)))
        found = release.begin(rate / tau, l)
        if found is None:
            return None
        for i, v in zip(release.rows, found, strict=True):
            self.l[i][0] = float(v)
        self.blocks.pushed([0] * self.m, 0)
        if how.feeds:
            self._recompute_y(0)
        self.parts["f"].compute(0)
        self._compute_rate(0)
        return how if how.through is not None else replace(how, through=[])

    def _index_2_updates(self, how: MultiplierSolver, k: int) -> Iterator[tuple[int, float]]:
        if self._slip_onset is None:
            return super()._index_2_updates(how, k)
        rows = self._slip_onset.rows
        return zip(rows, self._slip_onset.step(k, np.array([self.y[i][k + 1] for i in rows])).tolist(), strict=True)

    def _converge_order_0(self, how: MultiplierSolver, codes: list[int]) -> MultiplierSolver | None:
        """Order 0 of l, and order 1 of x; Newton's method where f, g or h are not linear in l."""
        self.parts["f"].compute(0)
        for iteration in range(NEWTON):
            direct, through = self.begin(how, codes)
            if self.linear_in_l:
                return how if self._is_solved(how, sum_in_order(through)) else None
            moved = relative_change(self, how, direct, through)
            if not math.isfinite(moved):
                return None
            if iteration and moved <= NEWTON_CONVERGED * NEWTON:
                return self.solve(codes) if self._is_solved(how, moved) else None
            how = self.solve(codes)
            self._compute_y(0)
        return None

    def _is_solved(self, how: MultiplierSolver, moved: float) -> bool:
        if how.through is not None and not math.isfinite(moved):
            return False
        if how.null is None or not how.null.size:
            return True
        self._compute_y(1)
        return remains_zero(self, how, (1,))
