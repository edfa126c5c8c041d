"""Prediction-correction for many bodies: `scheme.prediction_correction` with its expressions evaluated for many members at once.

    d = h f(t, q) + G' m,    0 <= m_i ⟂ y_i = g_i(t + h, q) + grad g_i(t + h, q) . d >= 0,    q_next = q + d

A row i is a family with two of its members; its gradient has d entries for the first body and, for a pair, d for the second.

What a run of many bodies looks at before it starts: of each family one member.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn

import casadi as ca
import numpy as np

from nsmodel.errors import StepError, UsageError
from nsmodel.models.many_bodies.families import Family
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.proof.verdict import attach_buffers, not_none
from nsmodel.solvers.initial_checks import InitialChecks
from nsmodel.solvers.one_step_problem import Scheme

BATCH_SIZE = 4096  # Members evaluated in one call: fewer at a time take more calls, more at a time more memory.
# Rows that a step evaluates at most, 160 MB for each number; larger families are refused, with what to do.
LARGEST_TABLE = 20_000_000
BODIES_SCHEME = "prediction-correction of many bodies (10)"
STEP_OPERATIONS = frozenset({  # Operations with derivative 0 somewhere though their value changes there.
    ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR,
    ca.OP_IF_ELSE_ZERO, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_COPYSIGN, ca.OP_FMIN, ca.OP_FMAX,
})  # fmt: skip


class BatchEvaluator:
    """An expression of t and of some columns, for many columns at once: (t, (M, k), ...) -> (M, width)."""

    def __init__(self, name: str, t: ca.SX, columns: list[ca.SX], expression: ca.SX) -> None:
        self._function = ca.Function(name, [t, *columns], [ca.densify(expression)], {"cse": True})
        self._sizes, self._width = [column.numel() for column in columns], expression.numel()
        self._calls: dict[int, tuple[Any, ...]] = {}

    def __call__(self, t: float, *tables: np.ndarray) -> np.ndarray:
        """The values (M, width), row by row."""
        count, out = len(tables[0]), np.empty((len(tables[0]), self._width))
        start = 0
        while start < count:
            size = min(BATCH_SIZE, 1 << max(5, (count - start - 1).bit_length()))
            stop = min(start + size, count)
            run, _, time, inputs, output = self._calls.get(size) or self._prepare(size)
            time[0] = t
            for given, table in zip(inputs, tables, strict=True):
                given[: stop - start] = table[start:stop]
            run()
            out[start:stop] = output[: stop - start]
            start = stop
        return out

    def _prepare(self, size: int) -> tuple[Any, ...]:
        """(run, buffer, t, inputs, output) of a call for so many columns, and their memory."""
        time, output = np.zeros(1), np.zeros((size, self._width))
        inputs = [np.zeros((size, k)) for k in self._sizes]
        many = self._function.map(f"{self._function.name()}_{size}", "serial", size, [0], [])
        buffer, run = attach_buffers(many, [array.reshape(-1) for array in (time, *inputs)], [output.reshape(-1)])
        self._calls[size] = run, buffer, time, inputs, output
        return self._calls[size]


@dataclass(frozen=True)
class ContactRows:
    """Constraints looked at in a step, sorted by family, first and second member.

    Attributes:
        family (R,), first (R,), second (R,): who; ``second`` is a body or an item, -1 where there is none.
        pair (R,): whether the second is a body.
        g (R,): the values; G (R, d), H (R, d): the gradients with respect to the first and the second body (0 where none).
    """

    family: np.ndarray
    first: np.ndarray
    second: np.ndarray
    pair: np.ndarray
    g: np.ndarray
    G: np.ndarray
    H: np.ndarray

    @property
    def other(self) -> np.ndarray:
        """The second body (R,), 0 where there is none."""
        return np.where(self.pair, self.second, 0)

    @property
    def size(self) -> np.ndarray:
        """n_i = |grad g_i| (R,)."""
        return np.sqrt((self.G**2).sum(axis=1) + (self.H**2).sum(axis=1))

    def at(self, rows: np.ndarray) -> ContactRows:
        """Some of the rows."""
        return ContactRows(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def one_step_problem(model: ManyBodies, *_: float) -> NoReturn:
    """Refuse: the rows of a step are not known beforehand.

    Raises:
        UsageError: says what there is for small scenes.
    """
    raise UsageError(
        f"'{model.title or 'ManyBodies'}' is a model of many bodies, which simulate() runs; for what needs every constraint "
        "written out, take model.written_out(), for small scenes"
    )


class BodiesProblem:
    """The expressions of a bound model as functions of many members at once; ``curved``: whose gradients depend on positions."""

    scheme = BODIES_SCHEME

    def __init__(self, model: ManyBodies) -> None:
        self.model, (self.count, self.d) = model, model.bodies.q0.shape
        d, t = self.d, model.t
        self.numbers = model.bodies.table[:, d:]
        self.names, self.families = tuple(model.constraints), tuple(model.constraints.values())
        self._f = BatchEvaluator("f", t, [ca.vertcat(model.me.symbols, model.u)], model.f) if isinstance(model.f, ca.SX) else None
        self._signals = tuple(model.inputs.values())
        self._leave = None if model.leave is None else BatchEvaluator("leave", t, [model.me.symbols], model.leave)
        self._gap, self._row, self.curved = [], [], []
        for family in self.families:
            members = [member.symbols for member in family.members]
            g, states = ca.SX(family.g), [member.q for member in family.moving]
            slopes = [ca.gradient(g, q) for q in states]
            self._gap.append(BatchEvaluator("gap", t, members, g))
            self._row.append(BatchEvaluator("row", t, members, ca.vertcat(g, *slopes)))
            self.curved.append(bool(ca.depends_on(ca.vertcat(*slopes), ca.vertcat(*states))))
        self._reach = [_PairReach(family, t, self.numbers, name) if uses_neighbour_search(family) else None
                       for name, family in zip(self.names, self.families, strict=True)]  # fmt: skip
        for name, family in zip(self.names, self.families, strict=True):
            if not uses_neighbour_search(family) and family.count > LARGEST_TABLE:
                raise UsageError(
                    f"constraint '{name}' runs over {family.count:,} members, all of which are evaluated in each step; at most "
                    f"{LARGEST_TABLE:,} can be. Give over=, the members that can meet, or write a pair as |q_i - q_j| - c"
                )

    def f(self, t: float, q: np.ndarray, present: np.ndarray) -> np.ndarray:
        """The velocities (N, d) just after t, 0 for bodies that are not there.

        Raises:
            StepError: f does not give (N, d) finite numbers.
        """
        out = np.zeros((self.count, self.d))
        if self._f is not None:
            u = [np.tile(signal.after(np.array([t])), (int(present.sum()), 1)) for signal in self._signals]
            out[present] = self._f(t, np.hstack([q[present], self.numbers[present], *u]))
        else:
            given = q.copy()
            try:
                value = np.asarray(self.model.f(t, given), float)
            except Exception as error:
                raise StepError(f"f raised {type(error).__name__} at t = {t:.10g}: {error}") from error
            if value.shape != out.shape:
                raise StepError(f"f gave an array of shape {value.shape} at t = {t:.10g}; expected {out.shape}, one row a body")
            out[present] = value[present]
        bad = np.flatnonzero(~np.isfinite(out).all(axis=1))
        if bad.size:
            raise StepError(f"f of body {bad[0]} is {out[bad[0]]} at t = {t:.10g}, q = {q[bad[0]]}; expected finite numbers")
        return out

    def leaves(self, t: float, q: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Which of the bodies leave (N,)."""
        out = np.zeros(self.count, bool)
        if self._leave is not None and present.any():
            out[present] = self._leave(t, np.hstack([q[present], self.numbers[present]]))[:, 0] > 0
        return out

    def gap(self, family: int, t: float, q: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """g of these members (M,)."""
        return self._gap[family](t, *self._members(family, q, first, second))[:, 0]

    def rows(self, family: int, t: float, q: np.ndarray, first: np.ndarray, second: np.ndarray) -> ContactRows:
        """g and its gradients for these members."""
        d, pair = self.d, self.families[family].of_pairs
        values = self._row[family](t, *self._members(family, q, first, second))
        H = values[:, 1 + d :] if pair else np.zeros((len(first), d))
        kind = np.full(len(first), family, np.int8)
        return ContactRows(kind, first, second, np.full(len(first), pair), values[:, 0], values[:, 1 : 1 + d], H)

    def _members(self, family: int, q: np.ndarray, first: np.ndarray, second: np.ndarray) -> list[np.ndarray]:
        """The numbers of the first members, and of the second where there are any."""
        about = self.families[family]
        members = [np.hstack([q[first], self.numbers[first]])]
        if about.second is not None:
            members.append(np.hstack([q[second], self.numbers[second]]) if about.of_pairs else about.second.group.table[second])
        return members

    def reach(self, family: int, t: float) -> float:
        """The largest c of g = |q_i - q_j| - c."""
        return not_none(self._reach[family]).largest(t)

    def halves(self, family: int, t: float) -> np.ndarray:
        """Numbers (N,) with c_ij <= half_i + half_j for each pair."""
        return not_none(self._reach[family]).halves(t)

    def name(self, family: int, first: int, second: int) -> str:
        """What the user calls a constraint: "pair 3-7", "wall 12-0"; as in ``ManyBodies.written_out``."""
        name = self.names[family]
        return f"{name} {first}" if second < 0 else f"{name} {first}-{second}"


def uses_neighbour_search(family: Family) -> bool:
    """Whether only near pairs of a family are looked at; of other families all members are."""
    return family.over is None and family.reach is not None


def _has_step_operations(expr: ca.SX, symbols: list[ca.SX]) -> bool:
    """Whether an expression has steps, whose derivatives do not show what they depend on."""
    whole = ca.Function("f", symbols, [expr])
    return any(whole.instruction_id(k) in STEP_OPERATIONS for k in range(whole.n_instructions()))


class _PairReach:
    """How far the pairs of a family reach: the largest c, and a share of it for each body."""

    def __init__(self, family: Family, t: ca.SX, numbers: np.ndarray, name: str) -> None:
        n, m = (member.symbols[member.q.numel() :] for member in family.moving)
        reach = not_none(family.reach)
        self._c = BatchEvaluator("reach", t, [n, m], reach)
        self._fixed = not ca.depends_on(reach, t)
        self._numbers, self._kind = np.unique(numbers, axis=0, return_inverse=True)
        self._additive = not n.numel() or (
            ca.jacobian(ca.gradient(reach, n), m).nnz() == 0 and not _has_step_operations(reach, [t, n, m])
        )
        if not self._additive and len(self._numbers) ** 2 > LARGEST_TABLE:
            raise UsageError(
                f"constraint '{name}': the reach {family.reach} is not a sum of a number of either body, and the numbers of "
                f"{len(self._numbers)} bodies differ: too many to compare all; round them, or write the reach as a sum"
            )
        self._values = self._compute(0.0) if self._fixed else None

    def largest(self, t: float) -> float:
        """The largest reach c of a pair at a time."""
        return (self._values or self._compute(t))[0]

    def halves(self, t: float) -> np.ndarray:
        """The shares (N,)."""
        return (self._values or self._compute(t))[1]

    def _compute(self, t: float) -> tuple[float, np.ndarray]:
        u = self._numbers
        if self._additive:  # c(a, b) = c(a, e) + c(e, b) - c(e, e)
            e = np.repeat(u[:1], len(u), axis=0)
            one, other = self._c(t, u, e)[:, 0], self._c(t, e, u)[:, 0]
            round_off = 1e-12 * float(np.abs(one).max() + np.abs(other).max())
            share = np.maximum(one, other) - one[0] / 2 + round_off / 2
            return float(one.max() + other.max() - one[0]) + round_off, share[self._kind.ravel()]
        largest = max(float(self._c(t, np.repeat(u[k : k + 1], len(u), axis=0), u).max()) for k in range(len(u)))
        return largest, np.full(len(self._kind), largest / 2)


def warnings(model: ManyBodies) -> list[str]:
    """Of each family one member where the bodies start: has its constraint a gradient, and is it convex there."""
    found = []
    for name, family in model.constraints.items():
        q = ca.vertcat(*(member.q for member in family.moving))
        H, slope = ca.hessian(family.g, q)
        f = ca.Function("H", [model.t, *(member.symbols for member in family.members)], [ca.densify(H), ca.densify(slope), q])
        i, j = (0, int(family.of_pairs)) if family.over is None else family.over[0] if len(family.over) else (0, -1)
        if family.of_pairs and j >= model.bodies.count:
            continue
        others = [] if family.second is None else [family.second.group.table[j]]
        H, slope, at = (np.array(value) for value in f(0, model.bodies.table[i], *others))
        label = f"constraint '{name} {i}'" if not others else f"constraint '{name} {i}-{j}'"
        if not slope.any():
            found.append(f"{label} has a zero gradient at q0: near there it acts on nothing")
        # A radius of curvature of 1e9 |q0| and more is round-off: a wall.
        bend = max(np.abs(H).max(), np.linalg.norm(slope) / np.linalg.norm(at) if at.any() else 0.0)
        if np.isfinite(H).all() and (least := np.linalg.eigvalsh(H)[0]) < -1e-9 * bend:
            found.append(f"{label} is not convex at q0 (least eigenvalue of its Hessian {least:.3g}): feasibility may be lost")
    return found


SCHEMES = {
    "prediction-correction": Scheme(one_step_problem=one_step_problem, initial_rows=one_step_problem),
}
INITIAL_CHECKS = InitialChecks(warnings=warnings)
