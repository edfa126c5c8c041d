"""When a mode is stiff: pieces by Radau IIA, where they are many times as long as a series goes.

How far a series goes its own last coefficients say, at each piece. Where stability and not accuracy limits it, the states hardly
move on it by their first coefficients, and a piece of collocation that is STIFF_START times as long is tried. Where its error is
accepted, the next one is longer, then each as long as the error before lets it be; as soon as pieces are less than STIFF_STAY
times a series, series go on. After k trials in a row that failed, or that no second piece followed, 2^k series pass before the
next one: a mode that is not stiff pays next to nothing, and x that leaves an unstable state, to which collocation goes back, does
leave it. What decides is in the coefficients alone.

One piece of a stiff mode: the collocation polynomial of Radau IIA, and what it errs by.

In a mode with the held rows a, x' = f + g and y_a = 0 are asked for at the stages, whatever the index: with Z = X - x_0,

    A^-1 Z - h (f + g)(X, L) = 0,    y_a(X, L) = 0,

l_a at the stages is part of the solution. Newton's method takes the Jacobian at the start, made diagonal in the stages by the
eigenvectors of A^-1 (Hairer and Wanner II, IV.8): matrices of the size of (x, l_a) are inverted, once a piece. Where h_x is
constant, y_a = 0 and y_a' = 0 at the stages are one condition (C x' is a polynomial of degree s - 1 with s zeros), and l is as
good as x; where rows of index 2 have another h_x, l has the order s, one less than x inside (Hairer, Lubich and Roche 1989).

The error. The defect d = x' - f - g of the polynomial is 0 at the nodes, so near d(0) M(c)/M(0), M(c) = (c - c_1) ... (c - c_s).
The error e' = J e - d of one component with the rate z = h J is then at most h |d(0)| times kappa = max |int_0^c M|/|M(0)|, and
about 1/|z| times that: a stiff component forgets. 1/(1/kappa + |z|) is between their minimum and half of it. With l_a,

    (1/kappa - h f_x) e - h g_l dl = -h d,    h_x e + h_l dl = -y_a,

solved for d and y_a at 0 and between each two nodes, there with the weight |M(0)/M|. What that solution P^-1 (-h d, -y_a) has of
rounding is, as that of the stages, of the size |P^-1| |P| (x, l) (Skeel 1979), which of what rests beside others that move is
many times its own: it is no error. y, and what branches look at, are held against the polynomials through their values at the
nodes. It is an estimate, to a factor of a few.

A problem on one side of each of its switches, as graphs again: f + g, h and what the switches look at, analytic everywhere.

In the dialect `SYMBOL_DIALECT`: order 0 of the recurrences over CasADi's symbols, with the choices of the branches as inputs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.event_driven.bernstein import poly_slope, poly_value
from nsmodel.event_driven.collocation import (
    Collocation,
    PieceTolerances,
    max_error_ratio,
    piece_error_bound,
    piece_polynomials,
    radau_collocation,
)
from nsmodel.event_driven.disc_arithmetic import EquationsOnDisc
from nsmodel.event_driven.event_location import NO_NOISE, EventLocator, current_condition
from nsmodel.event_driven.modes import PieceStart, SwitchCondition, condition_scale, germ_rounding
from nsmodel.event_driven.multipliers import NOTHING, TIE, MultiplierSolver
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.recurrence_code import SYMBOL_DIALECT, compile_recurrences
from nsmodel.event_driven.recurrences import ORDER_0_FUNCTIONS, TaylorRecurrences
from nsmodel.event_driven.step_size import MULTIPLIERS, SMALL, power_of_two_unit
from nsmodel.event_driven.system import ModeSystem
from nsmodel.proof.verdict import BufferedFunction

_SYMBOLIC_FUNCTIONS = {name: getattr(ca, name if name != "pow" else "power") for name in ORDER_0_FUNCTIONS} | {
    "where": ca.if_else, "both": ca.logic_and, "one": ca.logic_or
}  # fmt: skip


SlopeMatrix = np.ndarray | ca.SX  # Of numbers, or of expressions of the parameters.


class FixedBranches(NamedTuple):
    """Columns of choices of the branches, one part after the other, f + g, h and what each branch looks at; and the slopes."""

    choices: ca.SX
    values: list[ca.SX]
    slopes: list[ca.SX]


def fixed_branches(
    p: ContinuousProblem, recurrences: Mapping[str, TaylorRecurrences], B: SlopeMatrix | None, D: SlopeMatrix | None
) -> FixedBranches:
    """The graphs of (t, x, l, p) and choices; ``jets`` are of f, of h without D l, and of g where it is not B l.

    The slopes are f_x + g_x, g_l, h_x and h_l.
    """
    given, choices, outputs, watched = {}, [], {}, []
    for which, symbols in enumerate((p.t, p.x, p.l, p.p)):
        given |= {(which, i): symbol for i, symbol in enumerate(ca.vertsplit(ca.vec(symbols)))}
    for name, of in recurrences.items():
        own = [ca.SX.sym(f"side_{name}_{i}") for i in range(len(of.branches))]
        outputs[name], looked = replay_recurrences(of, given, own)
        choices += own
        watched += looked
    rate = outputs["f"] + (outputs["g"] if B is None else ca.mtimes(ca.SX(B), p.l))
    y = outputs["h"] if D is None else outputs["h"] + ca.mtimes(ca.SX(D), p.l)
    slopes = [ca.jacobian(a, b) for a in (rate, y) for b in (p.x, p.l)]
    return FixedBranches(ca.vertcat(ca.SX(0, 1), *choices), [rate, y, ca.vertcat(ca.SX(0, 1), *watched)], slopes)


def replay_recurrences(
    recurrences: TaylorRecurrences, given: dict[tuple[int, int], ca.SX], choices: list[ca.SX]
) -> tuple[ca.SX, list[ca.SX]]:
    """The outputs, and the rows that branches look at."""
    rows = [[ca.SX(0)] for _ in range(recurrences.count)]
    for place, row in recurrences.inputs.items():
        rows[row] = [given[place]]
    for row, number in recurrences.numbers.items():
        rows[row] = [ca.SX(number)]
    start, _ = compile_recurrences(recurrences, rows, choices, SYMBOL_DIALECT, _SYMBOLIC_FUNCTIONS)
    start()
    return ca.vertcat(ca.SX(0, 1), *(rows[row][0] for row in recurrences.outputs)), [rows[b.row][0] for b in recurrences.branches]


# STAGE_ITERATIONS: each has to be SLOW or better, so that 20 come to 1e-6 at least; 1e-15 is 4.5 EPS.
STAGE_ITERATIONS, STAGE_CONVERGED = 20, 1e-15  # Of Newton's method for the stages: how many; the next one that is rounding. (~)
ORDERS_OF_TWO = 4  # Of a series, for each two stages beyond the first: s stages have the order 2 s - 1.
SLOW = 0.5  # By how much each of them has to come nearer: else a shorter piece is cheaper, or rounding is all.
# STAGE_NEAR: more lets errors of the stages count, less refuses pieces for their rounding.
STAGE_NEAR = 0.1  # Of what is allowed: what is as near as rounding lets iterations come has to be nearer. (+)
# BETWEEN_NODES: the Lebesgue constant of 0 and the nodes is 2.3 of 5 nodes, 2.8 of 11, 3.0 of 15.
BETWEEN_NODES = 4.0  # By which a polynomial may err more than its values at 0 and at the nodes.
STAGE_ROUNDING = 1e-14  # Of a size, or of what the terms of a solution add up to: an error below it, 45 EPS, is none. (~)


class CollocationFit(NamedTuple):
    """The polynomials on t + h [0, 1], by their values at 0 and at the nodes, (s, q) and (q,), and what they err by.

    ``estimate``: of the largest of what x errs by beside rtol of its size, and of what l and y do beside 100 rtol; ``error``: a
    bound of it, where the estimate is at most 1.
    """

    h: float
    x: np.ndarray
    l: np.ndarray
    y: np.ndarray
    watched: np.ndarray
    at_0: tuple[np.ndarray, ...]  # x, l, y and watched
    estimate: float = 0.0
    error: float = 0.0
    noise: Mapping[str, np.ndarray] = NO_NOISE  # Of l and y (m,): what rounding leaves of the polynomials; {}: nothing is said.

    @property
    def at_nodes(self) -> tuple[np.ndarray, ...]:
        """X, l, y and watched."""
        return self.x, self.l, self.y, self.watched

    @property
    def last(self) -> list[float]:
        """The state at the end of the step."""
        return self.x[-1].tolist()


class CollocationStart(NamedTuple):
    """A place: x, l, y and what branches look at there, the rows that are held, and (f_x, g_l, h_x, h_l).

    ``rounding``: what l and y (m,) are known to.
    """

    t: float
    x: np.ndarray
    l: np.ndarray
    y: np.ndarray
    watched: np.ndarray
    choices: np.ndarray
    held: list[int]
    slopes: list[np.ndarray]
    rounding: dict[str, np.ndarray]


def stage_count(order: int) -> int:
    """Half as many as a series has orders, an odd number."""
    return 2 * (order // ORDERS_OF_TWO) + 1


class RadauMethod:
    """Pieces of a system by Radau IIA; ``on``: its equations on discs.

    ``residuals``: whether x' - f - g itself is to be within what is allowed, and not only what it does to the state.
    """

    def __init__(self, system: ModeSystem, on: EquationsOnDisc, order: int, *, residuals: bool) -> None:
        self.system, self._on, self.stages, self.residuals = system, on, stage_count(order), residuals

    @cached_property
    def table(self) -> Collocation:
        """The matrices of the collocation method."""
        return radau_collocation(self.stages)

    @cached_property
    def _compiled_functions(self) -> tuple[BufferedFunction, BufferedFunction]:
        system, p = self.system, self.system.problem
        of = fixed_branches(p, system.jets, system.B, system.D)
        values, slopes = (
            ca.Function(name, [p.t, p.x, p.l, of.choices], [ca.densify(e) for e in part])
            for name, part in (("sides", of.values), ("slopes_on_sides", of.slopes))
        )
        return BufferedFunction(values.map(self.stages)), BufferedFunction(slopes)

    def start(self, place: PieceStart, how: MultiplierSolver) -> CollocationStart:
        """Where a series of the mode has just been made."""
        system = self.system
        watched = np.array([row[0] for row in self._branch_rows()])
        x, l, y = (np.array([row[0] for row in rows]) for rows in (system.x, system.l, system.y))
        rounding = {acts: np.array([row[0] for row in rows]) for acts, rows in germ_rounding(system, 0).items()}
        choices = np.array([side for part in system.parts.values() for side in part.choice])
        slopes = [a.copy() for a in self._compiled_functions[1](place.t, x, l, choices)]
        return CollocationStart(place.t, x, l, y, watched, choices, list(how.active), slopes, rounding)

    def _branch_rows(self) -> list[list[float]]:
        """The rows that branches look at."""
        return [part.rows[b.row] for part in self.system.parts.values() for b in part.jets.branches]

    def fit(self, start: CollocationStart, h: float, rtol: float, atol: list[float]) -> CollocationFit | None:
        """The piece of length h; None where Newton's method does not settle."""
        of, held, n = self.table, start.held, len(start.x)
        size = np.maximum(np.maximum(self.system.sizes.x, np.abs(start.x)) + atol, NOTHING)
        try:
            inverses = np.linalg.inv(_stage_matrices(start, h, of.rates))
        except np.linalg.LinAlgError:
            return None
        Z, L = np.zeros((of.stages, n)), np.tile(start.l, (of.stages, 1))
        moved = np.full(2, np.inf)  # X beside its size, l beside itself.
        for iteration in range(STAGE_ITERATIONS):
            rate, y, watched = self._evaluate(start, start.t + h * of.nodes, start.x + Z, L)
            missed = np.hstack([h * rate - of.inverse @ Z, -y[:, held]])
            step = (of.right @ np.einsum("kij,kj->ki", inverses, of.left @ missed)).real
            Z, L[:, held] = Z + step[:, :n], L[:, held] + step[:, n:]
            share = np.abs(step) / np.hstack([np.maximum(size, np.abs(Z)), np.abs(L[:, held]) + NOTHING])
            before, moved = moved, np.array([share[:, :n].max(initial=0.0), share[:, n:].max(initial=0.0)])
            foretold = moved * np.minimum(moved / (before + NOTHING), 1.0) if iteration else moved
            l_comes_nearer = not iteration or bool(moved[1] < SLOW * before[1])  # x = -D l may be rounding of its size before.
            if foretold.max() <= STAGE_CONVERGED or (moved[0] <= STAGE_CONVERGED and not l_comes_nearer):
                break
            if iteration > 1 and not (
                moved[0] <= SLOW * before[0] or l_comes_nearer
            ):  # The second mends rounding of the inverse.
                if moved[0] <= max(STAGE_NEAR * rtol, STAGE_ROUNDING):
                    break
                if (np.abs(step) <= self._rounding(start, h, np.maximum(size, np.abs(start.x + Z).max(axis=0)), L)[1]).all():
                    break
                return None
        else:
            return None
        _, y, watched = (a.copy() for a in self._evaluate(start, start.t + h * of.nodes, start.x + Z, L))
        y[:, held] = 0.0
        try:
            return self._with_error(start, CollocationFit(h, start.x + Z, L, y, watched, self._at_0(start, L, y)), rtol, atol)
        except np.linalg.LinAlgError:  # So short that h is lost beside singular h_l.
            return None

    def write(self, start: CollocationStart, fit: CollocationFit) -> tuple[float, float]:
        """Put the polynomials into the rows of the system, and return (tau, s): the unit of time and their length in it."""
        system, tau = self.system, power_of_two_unit(fit.h)
        system.t[:2] = start.t, tau
        scale = (tau / fit.h) ** np.arange(self.stages + 1)
        lists = (self._branch_rows(), system.y, system.l, system.x)
        for rows, values, at_0 in zip(lists, reversed(fit.at_nodes), reversed(fit.at_0), strict=True):
            for row, c in zip(rows, self.table.coefficients(values, at_0) * scale, strict=True):
                row[:] = [*c.tolist(), *[0.0] * (len(row) - len(c))]
        return tau, fit.h / tau

    def _at_0(self, start: CollocationStart, l: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """X, l, y and watched where the piece begins; the polynomials of l and y through the nodes know them better where D is
        small: l = -y/D there, and at nodes what holds x' on the slow motion.
        """
        given = {"l": start.l, "y": np.where(np.isin(np.arange(self.system.m), start.held), 0.0, start.y)}
        for acts, values in (("l", l), ("y", y)):
            if acts in start.rounding:
                by_nodes = self.table.at_0 @ values
                given[acts] = np.where(np.abs(by_nodes - given[acts]) <= start.rounding[acts], by_nodes, given[acts])
        return start.x, given["l"], given["y"], start.watched

    def _evaluate(self, start: CollocationStart, t: np.ndarray, x: np.ndarray, l: np.ndarray) -> list[np.ndarray]:
        """F + g, y and what branches look at, a row a point."""
        return [a.T for a in self._compiled_functions[0](t[None], x.T, l.T, start.choices[:, None])]

    def _with_error(self, start: CollocationStart, fit: CollocationFit, rtol: float, atol: list[float]) -> CollocationFit:
        scales = self._piece_tolerances(start, fit, rtol, atol)
        estimate = error = self._estimate(start, fit, scales)
        if estimate <= 1:
            of = piece_polynomials(self.table, start.t, fit.h, start.held, fit.at_0, fit.at_nodes)
            error = max(estimate, piece_error_bound(self._on, of, scales))
        return fit._replace(estimate=estimate, error=error, noise=self._noise(start, scales) if start.rounding else NO_NOISE)

    def _noise(self, start: CollocationStart, scales: PieceTolerances) -> dict[str, np.ndarray]:
        """At least TIE of the sizes, below which a condition is 0."""
        n, of_l, least = len(start.x), np.zeros(len(start.l)), TIE / STAGE_ROUNDING
        of_l[start.held] = scales.rounding[n:]
        of_y = np.abs(start.slopes[2]) @ scales.rounding[:n] + np.abs(start.slopes[3]) @ of_l
        sizes = {"l": scales.rounding_l, "y": scales.rounding_y}
        return {acts: np.maximum(BETWEEN_NODES * of, least * sizes[acts]) for acts, of in (("l", of_l), ("y", of_y))}

    def _piece_tolerances(self, start: CollocationStart, fit: CollocationFit, rtol: float, atol: list[float]) -> PieceTolerances:
        """Of y, and of what branches look at, not by what they come to on the piece: that may be beyond where they are 0."""
        sizes, held = self.system.sizes, start.held
        size, size_l = (
            np.maximum(so_far, np.abs(values).max(axis=0, initial=0.0)) for so_far, values in ((sizes.x, fit.x), (sizes.l, fit.l))
        )
        terms = [self.system.terms(i, size.tolist(), size_l.tolist()) for i in range(len(start.l))]
        size_y = np.maximum(np.maximum(sizes.y, np.abs(start.y)), terms)
        size_w = np.maximum(sizes.switches, np.abs(start.watched))
        inverse, rounding = self._rounding(start, fit.h, size, size_l[None])
        free = [i for i in range(len(start.l)) if i not in held]
        for own, of in ((size_l, held), (size_y, free), (size_w, slice(None))):
            own[:] = np.maximum(own, SMALL * own[of].max(initial=0.0))
        allowed = [MULTIPLIERS * rtol * own for own in (size_l, size_y, size_w)]
        of_l, of_y, of_watched = (STAGE_ROUNDING * own for own in (size_l, size_y, size_w))
        return PieceTolerances(
            inverse, rounding, rtol * size + atol, size, allowed[0], of_l, allowed[1], of_y, allowed[2], of_watched
        )

    def _rounding(self, start: CollocationStart, h: float, size: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse that takes what is missed to (x, l of held rows), and what rounding leaves; ``l``: rows of values."""
        matrix = _stage_matrices(start, h, np.array([1 / self.table.share]))[0]
        inverse, size_l = np.linalg.inv(matrix), np.maximum(self.system.sizes.l, np.abs(l).max(axis=0))[start.held]
        return inverse, STAGE_ROUNDING * np.abs(inverse) @ (np.abs(matrix) @ np.append(size, size_l))

    def _estimate(self, start: CollocationStart, fit: CollocationFit, scales: PieceTolerances) -> float:
        """From what is missed at 0 and between the nodes."""
        of, held, n = self.table, start.held, len(start.x)
        x, l, y, watched = (at_0 + of.values @ (values - at_0) for values, at_0 in zip(fit.at_nodes, fit.at_0, strict=True))
        rate, h, looked = self._evaluate(start, start.t + fit.h * of.between, x, l)
        missed = np.hstack([fit.h * rate - of.slopes @ (fit.x - start.x), -h[:, held]])
        off = np.maximum(np.abs(missed @ scales.inverse.T) - scales.rounding, 0.0)
        errors = [max_error_ratio(off[:, :n] * of.weights[:, None], scales.x), max_error_ratio(off[:, n:], scales.l[held])]
        if self.residuals:
            errors.append(max_error_ratio(np.abs(missed[:, :n]) * of.weights[:, None] - STAGE_ROUNDING * scales.size, scales.x))
        free = [i for i in range(len(start.l)) if i not in held]
        errors.append(max_error_ratio(np.abs(y - h)[:, free] - scales.rounding_y[free], scales.y[free]))
        errors.append(max_error_ratio(np.abs(watched - looked) - scales.rounding_watched, scales.watched))
        return max(errors)


def _stage_matrices(start: CollocationStart, h: float, rates: np.ndarray) -> np.ndarray:
    """(r, n + a, n + a) rate E - h J, of (x, l_a), for each rate."""
    f_x, g_l, h_x, h_l = start.slopes
    n, held = len(start.x), start.held
    matrix = np.block([[-h * f_x, -h * g_l[:, held]], [h_x[held], h_l[np.ix_(held, held)]]])
    out = np.repeat(matrix[None].astype(rates.dtype), len(rates), axis=0)
    out[:, np.arange(n), np.arange(n)] += rates[:, None]
    return out


STIFF_START = 8.0  # In lengths of a series: as long a first piece of collocation has to be to pay for its matrices,
STIFF_STAY = 4.0  # and as long those that go on; with 40 a damped chain has 61 592 pieces, by series, in place of 26.
LOW_ORDERS = 2  # First coefficients of the states, by which they must hardly move on such a piece: rate and bend.
# INNER_SHARE: less makes shorter pieces; more is seen between the rows, by `run.at`.
INNER_SHARE = 0.1  # Of rtol: what a piece may err by inside; at its end it errs by a power of that.
OCTAVES_MORE = 2  # By which the next piece may be longer: its error is foretold from this one's alone.
SAFE = 0.5  # The share of what is allowed that its error is foretold to be: more has to make pieces anew, less shorter ones.
ENDINGS = 8  # How often a piece is made anew to end at an event; then it ends where its polynomial has the event. (+)
ENDED = 1e-4  # Of its length: so near its end what it errs by inside counts by the square of that. (+)
MOVED = 0.1  # By which share of its length a piece may have to be longer than its polynomial told, for that; or it is none.
# MAX_WAIT_OCTAVES: a trial costs little beside 64 series.
MAX_WAIT_OCTAVES = 6  # After trials that failed, 2^k series pass before the next one, with k up to this. (+)


class StiffPiece(NamedTuple):
    """A piece that is in the rows of the system: unit of time, length, error in units of rtol, x at the end; what ends it."""

    tau: float
    s: float
    error: float
    last: list[float]
    hit: SwitchCondition | None


class StiffIntegrator:
    """What is known of the stiffness of the mode; ``pieces``: how many were by collocation.

    ``rtol``, ``atol``: what a run may err by; ``residuals``: see `RadauMethod`.
    """

    def __init__(
        self, system: ModeSystem, on: EquationsOnDisc, roots: EventLocator, order: int, rtol: float, atol: list[float], *,
        residuals: bool
    ) -> None:  # fmt: skip
        self.system, self.roots, self.order = system, roots, order
        self.rtol, self.atol = INNER_SHARE * rtol, [INNER_SHARE * a for a in atol]
        self.radau = RadauMethod(system, on, order, residuals=residuals)
        self.pieces = 0
        self.restart()

    def restart(self) -> None:
        """Forget what was known: another mode."""
        self.length, self.failed, self.wait = 0.0, 0, 0

    def piece(self, place: PieceStart, how: MultiplierSolver, s: float, most: float = math.inf) -> StiffPiece | None:
        """The piece by collocation, where that is worth while; else None, and the series in the rows are as they were.

        ``s`` is how far the series go, in the unit of the place; ``most`` how long the piece may be.
        """
        series, first = place.tau * s, not self.length
        length = self._trial_length(place, how, s) if first else self.length
        least, length = series * (STIFF_START if first else STIFF_STAY), min(length, most)
        if not length or length < least:
            self._record_failure(failed=not first)
            return None
        start = self.radau.start(place, how)
        fit, longest = self.radau.fit(start, length, self.rtol, self.atol), OCTAVES_MORE
        while fit is None or not fit.error <= 1:
            if fit is not None and fit.estimate <= 1:
                longest = 0  # What bounds a longer one is too large, whatever its estimate says.
            length = math.ldexp(length, min(-1 if fit is None else self._allowed_octaves(fit.error), -1))
            if length < least or place.t + length == place.t:
                self._record_failure(failed=True)
                return None
            fit = self.radau.fit(start, length, self.rtol, self.atol)
        self.length = math.ldexp(length, longest if first else min(self._allowed_octaves(fit.estimate), longest))
        self.failed, self.wait = self.failed if first else 0, 0
        self.pieces += 1
        return self._end_at_event(place, how, start, fit, most)

    def _trial_length(self, place: PieceStart, how: MultiplierSolver, s: float) -> float:
        """The length of a first piece; 0 where none is tried: a series that fills its unit of time becomes longer by itself.

        None is tried where l of blocks that slip follows from y: the equations of `radau` do not have that.
        """
        if self.wait or s >= 1 or place.open or self.system.blocks.all or (how.null is not None and how.null.size):
            return 0.0
        for row, largest in zip(self.system.x, self.system.sizes.x, strict=True):
            if sum_in_order(abs(row[k]) * (STIFF_START * s) ** k for k in range(1, LOW_ORDERS + 1)) > largest:
                return 0.0
        return power_of_two_unit(STIFF_START * place.tau * s)

    def _record_failure(self, failed: bool) -> None:
        self.length, self.wait = 0.0, max(self.wait - 1, 0)
        if failed:
            self.failed = min(self.failed + 1, MAX_WAIT_OCTAVES)
            self.wait = 2**self.failed

    def _allowed_octaves(self, error: float) -> int:
        """By how many octaves a piece may be longer: its error has the order s + 1."""
        if not math.isfinite(error):
            return -1
        return math.floor(math.log2(SAFE / max(error, NOTHING)) / (self.radau.stages + 1))

    def _end_at_event(
        self, place: PieceStart, how: MultiplierSolver, start: CollocationStart, fit: CollocationFit, most: float
    ) -> StiffPiece:
        """The piece up to its first event, made anew to end near it: inside it has the order s + 1, at its end 2 s - 1."""
        tau, s = self.radau.write(start, fit)
        hit, end = self.roots.first(place, how, self.order, s, noise=fit.noise)
        if hit is None and end < s:  # Beyond that a root may hide.
            return StiffPiece(tau, end, INNER_SHARE * fit.error, [poly_value(row, end) for row in self.system.x], None)
        for _ in range(ENDINGS):
            if hit is None:
                break
            shorter = self.radau.fit(start, min(tau * end, most), self.rtol, self.atol) if end > 0 else None
            if shorter is None or not shorter.error <= 1:
                break
            fit = shorter
            tau, s = self.radau.write(start, fit)
            again, end = self.roots.first(place, how, self.order, s, noise=fit.noise)
            hit, end = (again, end) if again else self._condition_beyond_end(place, how, hit, s)
            if abs(end - s) <= ENDED * s and tau * end <= most:
                break
            if end > s and tau * s >= most:
                hit = None
        if hit is None or end == s or end > (1 + ENDED) * s:
            return StiffPiece(tau, s, INNER_SHARE * fit.error, fit.last, hit)
        return StiffPiece(tau, end, INNER_SHARE * fit.error, [poly_value(row, end) for row in self.system.x], hit)

    def _condition_beyond_end(
        self, place: PieceStart, how: MultiplierSolver, hit: SwitchCondition, s: float
    ) -> tuple[SwitchCondition | None, float]:
        """The condition that was 0 before, and where it is now, just beyond the end; None where it is no more."""
        own = current_condition(self.system, place, how, hit, self.order) or hit
        c = own.coefficients()
        v, rate = poly_value(c, s), poly_slope(c, s)
        if v <= TIE * condition_scale(self.system, own):
            return own, s
        return (own, s - v / rate) if rate < 0 and v <= MOVED * s * -rate else (None, s)

    # -- for files

    def checkpoint(self) -> dict[str, Any]:
        """What the next pieces depend on."""
        return {"length": self.length, "failed": self.failed, "wait": self.wait, "pieces": self.pieces}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.length, self.failed, self.wait, self.pieces = (saved[name] for name in ("length", "failed", "wait", "pieces"))
