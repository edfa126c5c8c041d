"""The equations of a piece linearised: by the state, the multipliers and what a run is differentiated by.

On a piece the mode and the sides of all switches are known. With S = dx/dp and L = dl/dp,

    S' = F_x S + F_l L + F_p,    F = f + g,

and L follows from S row by row: a row with code -1 or +1 has L_i = d(end_i)/dp; one with code 0 has y_i = 0, so that
y_x S + y_l L + y_p = 0 where y_i depends on the multipliers of held rows (index 1), and the same of its rate y_t + y_x F where it
does not (index 2); a block that slips has l = slip(y). Mixed rows are split by the left null space U of y_l: U'y' = 0, and y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.event_driven.multipliers import SINGULAR, generalised_inverse
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.radau import replay_recurrences
from nsmodel.event_driven.recurrences import Branch, taylor_decompose
from nsmodel.proof.verdict import BufferedFunction, not_none

BRANCH_CHOICES = {"floor": np.floor, "ceil": np.ceil, "toward zero": np.trunc, "nearest": np.rint, "equal": np.sign}


TRY_DIFFERENCES = "take method='differences' (--method differences)"
LARGEST_MAP = 256  # Points that are evaluated by one call; CasADi makes a function of each power of two up to it.


class Slopes(NamedTuple):
    """A quantity at K points (K, r), and its derivatives by t, x, l and p: (K, r), (K, r, n), (K, r, m), (K, r, q)."""

    value: np.ndarray
    by_t: np.ndarray
    by_x: np.ndarray
    by_l: np.ndarray
    by_p: np.ndarray


class LinearisedEquations(NamedTuple):
    """The quantities of a problem at K points.

    Attributes:
        rate: F (n). y: h (m). y_rate: h_t + h_x F (m). slip: l - slip(y) in the rows of curved blocks, 0 elsewhere (m).
        watched: what the branches look at. updates: what blocks that act after each step set.
    """

    rate: Slopes
    y: Slopes
    y_rate: Slopes
    slip: Slopes
    watched: Slopes
    updates: Slopes


class ModeRows(NamedTuple):
    """Which equations the multipliers of a mode solve: matrices (m, m) that take rows of y, its rate, slip, and L itself.

    Attributes:
        held: U' of the rows that are held through y' alone, and rows of 0.
        end: of each row -1 or +1 at that end of a box, else 0 (m,).

    Of many points each has an axis in front.
    """

    of_y: np.ndarray
    of_y_rate: np.ndarray
    of_slip: np.ndarray
    own: np.ndarray
    held: np.ndarray
    end: np.ndarray


class FunctionOfPoints:
    """A column of expressions at many points: of arrays (K, inputs), (K, size)."""

    def __init__(self, given: ca.SX, column: ca.SX) -> None:
        self._function = ca.Function("at_points", [given], [ca.densify(column)])
        self._of_many: dict[int, BufferedFunction] = {}

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Evaluate it: in calls of so many points at once that few functions are made, and kept."""
        count, out, first = len(points), [], 0
        while first < count:
            size = min(LARGEST_MAP, 1 << (count - first).bit_length() - 1)
            of_many = self._mapped(size)
            of_many.inputs[0].T[:] = points[first : first + size]
            of_many.run()
            out.append(of_many.outputs[0].T.copy())
            first += size
        return np.concatenate(out) if out else np.zeros((0, self._function.numel_out()))

    def _mapped(self, size: int) -> BufferedFunction:
        if size not in self._of_many:
            self._of_many[size] = BufferedFunction(self._function.map(size) if size > 1 else self._function)
        return self._of_many[size]


class TangentEquations:
    """The linearised equations of a problem whose parameters are symbols."""

    def __init__(self, problem: ContinuousProblem, by: Sequence[int]) -> None:
        """``by``: the entries of the problem's p that it is differentiated by; all are 0 to begin with."""
        p = problem
        self.problem, self.values, self.chosen = p, np.zeros(p.p.numel()), p.p[list(by)]
        self.n, self.m, self.q = p.x.numel(), p.l.numel(), self.chosen.numel()
        self.curved = {rows.start: rows for rows, block in p.law.parts() if not block.separable}
        inputs = [p.t, p.x, p.l, p.p]
        given = {(i, k): s for i, part in enumerate(inputs) for k, s in enumerate(ca.vertsplit(ca.vec(part)))}
        choices, outputs, watched, self.branches, self.branch_names = [], [], [], list[Branch](), list[str]()
        for name, part in (("f", p.rate), ("h", p.h), ("updates", p.updates)):
            made = taylor_decompose(part, inputs, name)
            own = [ca.SX.sym(f"side_{name}_{i}") for i in range(len(made.branches))]
            value, looked = replay_recurrences(made, given, own)
            choices, outputs, watched, self.branches = (
                choices + own,
                [*outputs, value],
                watched + looked,
                [*self.branches, *made.branches],
            )
            self.branch_names += [f"a switch in {name}"] * len(own)
            self.update_branches = len(own)
        rate, y, updates = outputs
        slip = ca.SX.zeros(self.m, 1)
        for rows, block in p.law.parts():
            if not block.separable:
                slip[rows] = p.l[rows] - _slip_expression(block, p.rows[rows.start], y[rows])
        y_rate = ca.jacobian(y, p.t) + ca.jacobian(y, p.x) @ rate
        quantities = (rate, y, y_rate, slip, ca.vertcat(ca.SX(0, 1), *watched), updates)
        self._sizes = [e.numel() for e in quantities]
        self._choices, columns = ca.vertcat(ca.SX(0, 1), *choices), []
        for e in quantities:
            columns += [e, *(ca.jacobian(e, symbol) for symbol in (p.t, p.x, p.l, self.chosen))]
        whole = ca.veccat(*(ca.vec(ca.densify(column)) for column in columns))
        given = ca.vertcat(*inputs, self._choices)
        self._all, self._watched = (FunctionOfPoints(given, column) for column in (whole, quantities[4]))

    def __call__(self, t: np.ndarray, x: np.ndarray, l: np.ndarray, choices: np.ndarray) -> LinearisedEquations:
        """All quantities at K points: t (K,), x (K, n), l (K, m), choices of the branches (K, b)."""
        count = len(t)
        found = self._all(np.column_stack([t, x, l, np.tile(self.values, (count, 1)), choices]))
        parts, at = [], 0
        for size in self._sizes:
            own = []
            for width in (0, 0, self.n, self.m, self.q):
                part = found[:, at : at + size * max(width, 1)] if (width or len(own) < 2) else found[:, at:at]
                at += part.shape[1]
                own.append(part if len(own) < 2 else part.reshape(count, width, size).transpose(0, 2, 1))
            parts.append(Slopes(*own))
        return LinearisedEquations(*parts)

    def at_values(self, values: Sequence[float]) -> TangentEquations:
        """The same equations at other values of p."""
        other = copy(self)
        other.values = np.array(values, float)
        return other

    def watched(self, t: np.ndarray, x: np.ndarray, l: np.ndarray, choices: np.ndarray) -> np.ndarray:
        """What the branches look at (K, b) at K points."""
        return self._watched(np.column_stack([t, x, l, np.tile(self.values, (len(t), 1)), choices]))

    def choices(self, t: np.ndarray, x: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The choices of the branches (K, b) at points inside of pieces; a branch may look at what others before it chose."""
        count, kinds = len(t), [branch.kind for branch in self.branches]
        chosen = np.ones((count, len(kinds)))
        for _ in kinds:
            watched = self.watched(t, x, l, chosen)
            found = np.column_stack([_choice(kind, column) for kind, column in zip(kinds, watched.T, strict=True)])
            if (found == chosen).all():
                break
            chosen = found
        return chosen

    @cached_property
    def end_slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (m, q) of the lower and the upper ends of the law."""
        law = self.problem.law
        lower, upper = (self._numbers(ca.jacobian(end, self.chosen)).reshape(self.m, self.q) for end in (law.lower, law.upper))
        return lower, upper

    @cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """The ends themselves (m,)."""
        lower, upper = (self._numbers(end).ravel() for end in (self.problem.law.lower, self.problem.law.upper))
        return lower, upper

    @cached_property
    def start_slopes(self) -> np.ndarray:
        """Derivatives of x(0) (n, q)."""
        return self._numbers(ca.jacobian(self.problem.x0, self.chosen)).reshape(self.n, self.q)

    def quadric(self, rows: slice) -> tuple[np.ndarray, float]:
        """(S, c) of the curved block of these rows, {l'S l <= c}."""
        curved = next(block.curved() for own, block in self.problem.law.parts() if own == rows)
        return not_none(curved).quadric(rows.stop - rows.start)

    def push_slopes(self, impulse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """g_l (n, m), of a problem in which it is constant, and the derivatives of g_l p (n, q)."""
        push = ca.jacobian(self.problem.g, self.problem.l)
        moved = self._numbers(ca.jacobian(push @ ca.DM(impulse), self.chosen))
        return self._numbers(push).reshape(self.n, self.m), moved.reshape(self.n, self.q)

    def _numbers(self, expression: ca.SX) -> np.ndarray:
        found = ca.Function("numbers", [self.problem.p], [ca.densify(expression)])(self.values)
        return np.array(found).reshape(expression.shape)

    def mode_rows(self, codes: np.ndarray, y_by_l: np.ndarray) -> ModeRows:
        """Which equations hold in a mode with these codes (m,), where h_l is ``y_by_l`` (m, m)."""
        m = self.m
        of_y, of_rate = np.zeros((m, m)), np.zeros((m, m))
        slips = {i for start, rows in self.curved.items() if codes[start] for i in range(rows.start, rows.stop)}
        curved = {i for rows in self.curved.values() for i in range(rows.start, rows.stop)}
        a = [i for i in range(m) if codes[i] == 0 and i not in slips]
        of_slip, own = (np.diag([float(i in rows) for i in range(m)]) for rows in (slips, {*range(m)} - slips - {*a}))
        found = generalised_inverse(y_by_l[np.ix_(a, a)])
        U = found.left
        if U.shape[1] == len(a):
            of_rate[a, a] = 1.0
        elif not U.shape[1]:
            of_y[a, a] = 1.0
        else:
            basis = np.linalg.svd(U, full_matrices=True)[0]
            rest = basis[:, U.shape[1] :]
            of_rate[np.ix_(a[: U.shape[1]], a)] = U.T
            of_y[np.ix_(a[U.shape[1] :], a)] = rest.T
        held = np.zeros((m, m))
        held[np.ix_(range(U.shape[1]), a)] = U.T
        end = np.array([0 if i in curved else codes[i] for i in range(m)])
        return ModeRows(of_y, of_rate, of_slip, own, held, end)


def _choice(kind: str, watched: np.ndarray) -> np.ndarray:
    return np.where(watched < 0, -1.0, 1.0) if kind == "side" else BRANCH_CHOICES[kind](watched)


def _slip_expression(block: object, row: str, y: ca.SX) -> ca.SX:
    curved = block.curved()  # pyrefly: ignore[missing-attribute]
    found = None if curved is None else curved.slip(y)
    if found is None:
        raise UsageError(f"the law of '{row}' has other modes than stick and slip; {TRY_DIFFERENCES}")
    return found[0]


def multiplier_slopes(
    at: LinearisedEquations, rows: ModeRows, ends: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """L = Λ S + λ at K points, whose modes have these ``rows``: (K, m, n), (K, m, q); least in norm where rows are redundant."""
    slips = np.diagonal(rows.of_slip, axis1=-2, axis2=-1)[..., None] != 0  # Where y = 0 the direction of slip is not a number.
    by_x, by_l, by_p = (np.where(slips, part, 0.0) for part in at.slip[2:])
    M = rows.of_y @ at.y.by_l + rows.of_y_rate @ at.y_rate.by_l + by_l + rows.own
    N = rows.of_y @ at.y.by_x + rows.of_y_rate @ at.y_rate.by_x + by_x
    lower, upper = ends
    end = rows.end[..., None]
    k = rows.of_y @ at.y.by_p + rows.of_y_rate @ at.y_rate.by_p + by_p
    k = k - np.where(end < 0, lower, np.where(end > 0, upper, 0.0))
    right = -np.concatenate([N, k], axis=2)
    size = np.abs(M).max(axis=2, keepdims=True, initial=0.0)
    size[size == 0] = 1.0
    M, right = M / size, right / size
    found = _solve(M, right)
    n = N.shape[2]
    return found[:, :, :n], found[:, :, n:]


def _solve(M: np.ndarray, right: np.ndarray) -> np.ndarray:
    """M^-1 right at K points; by pseudo-inverses where M is singular."""
    if not M.shape[1]:
        return right
    columns = np.abs(M).max(axis=1)
    columns[columns == 0] = 1.0
    scaled = M / columns[:, None, :]
    values = np.linalg.svd(scaled, compute_uv=False)
    if (values[:, -1] > SINGULAR * values[:, 0]).all():
        return np.linalg.solve(scaled, right) / columns[:, :, None]
    return (np.linalg.pinv(scaled, rcond=SINGULAR) @ right) / columns[:, :, None]
