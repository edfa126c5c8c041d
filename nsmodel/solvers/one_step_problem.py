"""The one-step nonsmooth problem: what every scheme makes of a model.

The papers' schemes: each turns a model into the nonsmooth problem of one step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.modeling.base import Model
from nsmodel.modeling.convex_split import ConvexSplit
from nsmodel.modeling.expressions import derivatives, without_infinite_slopes
from nsmodel.modeling.laws import Law, ball, box, complementarity, equality, product, relay, second_order_cone
from nsmodel.modeling.laws.base import LawEnds, RewrittenLaw
from nsmodel.modeling.parts import Part
from nsmodel.modeling.variants import initial_inputs
from nsmodel.proof.expression_graph import operation_codes, stack_column


class SchemeOrder(NamedTuple):
    """Order of a scheme on one index set: ``most``, but 1 while a row of ``lowered_by`` (their numbers) is held, y_i = 0."""

    most: int
    lowered_by: tuple[int, ...] = ()

    @classmethod
    def from_weights(cls, theta: float, gamma: float, r: ca.SX, moving: ca.SX, law: Law, Y: ca.SX, through: ca.SX) -> SchemeOrder:
        """Of the theta-gamma scheme: 2 for theta = gamma = 1/2, and for theta = 1/2 where a constant r does for the whole step.

        That is where r is a function of l alone (``moving``: what else it might depend on), and each l_i stays at its end, or is
        what keeps y_i = 0 and so its own mean. Where y_i depends on the multipliers directly (on ``through``) l_i is that of the
        end of the step; on the edge of a ball or a cone it moves.
        """
        if theta != 0.5:
            return cls(1)
        if gamma == 0.5:
            return cls(2)
        if ca.depends_on(r, moving) or not law.is_box:
            return cls(1)
        return cls(2, feedthrough(Y, through))


@dataclass(frozen=True)
class Prediction:
    """The explicit half of a step: y = x + h v, v = velocity(t, x, l), -u(t, x) ∈ N_K(l); y is then the problem's ``state``.

    Attributes:
        x: symbols of the model's state.
        l, velocity, u, law: where u = 0 the element l of K is free.
        c: rows c(t, x) >= 0 of the set that the state is in.
        box: (lower, upper) of that set, expressions of t, where it is a box; else None.
        inputs: symbols of the inputs in velocity, u, c and box.
        tolerances: eps_k of projections that need not be exact: a number, one for each step, or a function of the step; or None.
    """

    x: ca.SX
    l: ca.SX
    velocity: ca.SX
    u: ca.SX
    law: Law
    c: ca.SX
    box: tuple[ca.SX, ca.SX] | None
    inputs: ca.SX
    tolerances: Any


@dataclass(frozen=True)
class OneStepProblem:
    """Find (z, l): E(z, l; k) = 0, y = Y(z, l; k), -y ∈ N_K(l), where k = (t, h, state, p).

    Attributes:
        scheme: name and source of the scheme.
        t, h: time t_k and step, t_{k+1} = t + h.
        state: what the scheme carries from step to step; its first n entries are the model's state.
        p: parameters still symbolic.
        z, l: the unknowns; y: a symbol for Y, for use in ``records``.
        E, Y: expressions of z, l and k.
        law: K, made of boxes and curved sets.
        rows: the user's name of each row of l and y.
        guess: first z, an expression of k: the value for which nothing moves.
        next_state: expression of z, l and k.
        multipliers, outputs: l and y as the user declared them, where they differ from l and y; else None.
        declared: the names of these multipliers.
        ends: of the rows whose law moves, the set at the end of the step, expressions of k; scale: s of l = c + s l' of each
            row, by which that of W is multiplied where its sign is looked at; None where nothing moves.
        records: further columns of the trajectory, expressions of z, l, y and k.
        axes: {"contact" or "slip": the names of what records of these have a column each}.
        overreach: of each row, how far Y is below the constraint that it linearises at z, beside what it changes by; else None.
        start: problem that turns (x0, 0) into the first state, where the scheme needs a multiplier at t = 0.
        order: of the scheme between switches.
        carried: what the state carries between the model's own and the inputs, in words; "" where nothing.
        velocity: the record that is the change of the state in a step over h, where the state carries that change; else "".
        difference: whether it carries the change itself, and not the velocity.
        gap: the record of how far next_state is inside what it is projected on, where it is; else "".
        prediction: how the state is made of the model's, where it is a predictor; else None.
        explicit: numbers of the unknowns that their own rows give: E_i = z_i - G_i of the others, E and Y linear in them.
        inputs: how many inputs the state carries behind its own: u(t_k+), then u(t_{k+1}-); see `with_carried_inputs`.
        ranges: expressions of the parameters that are >= 0 where each is in its range.
        assumed: expressions of the parameters that are > 0 where the problem is this one; elsewhere it has another form.
    """

    scheme: str
    t: ca.SX
    h: ca.SX
    state: ca.SX
    p: ca.SX
    z: ca.SX
    l: ca.SX
    y: ca.SX
    E: ca.SX
    Y: ca.SX
    law: Law
    rows: tuple[str, ...]
    guess: ca.SX
    next_state: ca.SX
    multipliers: ca.SX | None = None
    outputs: ca.SX | None = None
    declared: tuple[str, ...] = ()
    ends: tuple[LawEnds, ...] = ()
    scale: ca.SX | None = None
    records: dict[str, ca.SX] = field(default_factory=dict)
    axes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    overreach: ca.SX | None = None
    start: OneStepProblem | None = None
    order: SchemeOrder = field(default_factory=lambda: SchemeOrder(1))
    carried: str = ""
    velocity: str = ""
    difference: bool = True
    gap: str = ""
    prediction: Prediction | None = None
    explicit: tuple[int, ...] = ()
    inputs: int = 0
    ranges: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    assumed: ca.SX = field(default_factory=lambda: ca.SX(0, 1))

    @property
    def multiplier_names(self) -> tuple[str, ...]:
        """The names of the multipliers as the user declared them."""
        return self.rows if self.multipliers is None else self.declared

    @cached_property
    def jacobians(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """(E_z, E_l, Y_z, Y_l), sparse, exact but for infinite slopes, which are left out."""
        unknown = ca.vertcat(self.z, self.l)
        E_z, E_l, Y_z, Y_l = (without_infinite_slopes(J, unknown) for J in self._exact_jacobians)
        return E_z, E_l, Y_z, Y_l

    @cached_property
    def has_infinite_slopes(self) -> bool:
        """Whether an exact derivative has points where it is infinite, as that of sqrt|z|."""
        return any(J is not exact for J, exact in zip(self.jacobians, self._exact_jacobians, strict=True))

    @cached_property
    def _exact_jacobians(self) -> tuple[ca.SX, ...]:
        return tuple(derivatives(rows, v) for rows in (self.E, self.Y) for v in (self.z, self.l))

    @cached_property
    def explicit_eliminated(self) -> tuple[ca.SX, ca.SX]:
        """(z, E) with the explicit unknowns as their rows give them: E is 0 there."""
        rows = list(self.explicit)
        if not rows:
            return self.z, self.E
        given = -ca.substitute([self.E[rows]], [self.z[rows]], [ca.SX.zeros(len(rows))])[0]
        z, E = ca.substitute([self.z, self.E], [self.z[rows]], [given])
        E[rows] = 0
        return z, E


def with_carried_inputs(problem: OneStepProblem, begin: ca.SX, end: ca.SX) -> OneStepProblem:
    """The problem with the inputs u(t_k+) = begin and u(t_{k+1}-) = end behind its state: a step passes them on as they are.

    Whoever steps sets them before each step; so all that knows states knows inputs.
    """
    if not begin.numel():
        return problem
    both, start = ca.vertcat(begin, end), problem.start
    return replace(
        problem, state=ca.vertcat(problem.state, both), next_state=ca.vertcat(problem.next_state, both), inputs=begin.numel(),
        start=None if start is None else with_carried_inputs(start, begin, end),
    )  # fmt: skip


def feedthrough(Y: ca.SX, l: ca.SX) -> tuple[int, ...]:
    """Return the numbers of the rows of Y that depend on l directly, not only through the state."""
    return tuple(sorted(set(ca.jacobian_sparsity(Y, l).row())))


def rewrite_as_basic_law(
    law: Law, names: tuple[str, ...], y: ca.SX, driven: ca.SX, at: ca.SX | None = None
) -> RewrittenLaw:  # fmt: skip
    """Rewrite what is no basic law, such as a polyhedron, or moves, in terms of boxes and curved sets with numbers.

    The multipliers are NaN where a set that moves is none.

    Args:
        law, names: the law as declared, and the names of its rows.
        y: the output (m, 1) that it speaks of; it must not depend on the new symbols.
        driven: the symbols of time and inputs in the law; at: what stands in their place in the result, such as those of the
            end of a step.
    """
    parts, moving = [], driven
    if at is not None and any(law.moves(driven)):
        law, moving = law.put(driven, at), stack_column(ca.symvar(at))
    for rows, block in law.parts():
        l = ca.SX.sym("l", block.size)
        own = y[rows.start : rows.stop], tuple(names[rows])
        parts.append(block.rewritten(*own, moving) or RewrittenLaw(Law((block,)), l, l, own[1], own[0]))
    labels = tuple(name for part in parts for name in part.rows)
    ends = tuple(end for part in parts for end in part.ends)
    scale = stack_column([ca.SX.ones(part.l.numel()) if part.scale is None else part.scale for part in parts]) if ends else None
    return RewrittenLaw(
        product(*(part.law for part in parts)), stack_column([part.l for part in parts]),
        stack_column([part.multipliers for part in parts]), labels, stack_column([part.y for part in parts]), ends, scale,
    )  # fmt: skip


def moving_law_outputs(outputs: ca.SX, y: ca.SX, ends: tuple[LawEnds, ...]) -> ca.SX:
    """The declared outputs of a law that moves: y itself, which is exactly 0 where it is, where each row has one."""
    return y if ends and outputs.shape == y.shape else outputs


class StationaryParts(NamedTuple):
    """Parts of a problem in the symbols ``l`` of a law that stays; ``multipliers``: those declared, None where they are l."""

    law: Law
    l: ca.SX
    multipliers: ca.SX | None
    ends: tuple[LawEnds, ...]
    scale: ca.SX | None
    parts: list[ca.SX]


def stationary_parts(law: Law, names: tuple[str, ...], l: ca.SX, driven: ca.SX, parts: Sequence[ca.SX]) -> StationaryParts:
    """Write parts of a problem, expressions of the multipliers l of ``law``, in those of one that stays.

    See `rewrite_as_basic_law`.
    """
    if not any(law.moves(driven)):
        return StationaryParts(law, l, None, (), None, list(parts))
    basic = rewrite_as_basic_law(law, names, ca.SX.sym("y", l.numel()), driven)
    parts = ca.substitute(list(parts), [l], [basic.multipliers])
    return StationaryParts(basic.law, basic.l, basic.multipliers, basic.ends, basic.scale, parts)


DOMAIN_OPERATIONS = {ca.OP_LOG, ca.OP_LOG1P, ca.OP_ATANH}  # Their derivatives are numbers also where they are none.


class Subdifferential(NamedTuple):
    """l ∈ -dPhi(y) written with basic laws: l = gradient(l'), and rows of the law on (l', u)."""

    law: Law
    l: ca.SX
    force: ca.SX
    u: ca.SX
    rows: tuple[str, ...]


def subdifferential(phi: ConvexSplit, y: ca.SX, name: str, *, guarded: bool = True) -> Subdifferential:
    """Write -dPhi(y) as ``force``, an expression of y and new multipliers l' with -u ∈ N_K(l').

    |u| gives a relay, max(u, 0) a box, |u|_2 a ball, an indicator a complementarity or a cone; nested terms their epigraph:
    tau free with 0 = d/dtau, 0 <= l ⟂ tau_j - u_i(y, tau) >= 0. ``guarded``: the force is not a number where Phi has no value.
    """
    laws, symbols, us, rows = [], [], [], []
    lagrangian = phi.smooth
    for i, term in enumerate(phi.terms):
        m = term.u.numel()
        l = ca.SX.sym("l", m)
        laws.append(_LAW_OF_TERM[term.kind](m, term.weight))
        symbols.append(l)
        us.append(term.u)
        rows += [f"{name} term {i}"] * m
        lagrangian = lagrangian - ca.dot(l, term.u)
    if phi.tau.numel():
        n = ca.SX.sym("n", phi.epigraph.numel())
        gaps = ca.vertcat(*(phi.tau[j] for j in phi.epigraph_of)) - phi.epigraph
        lagrangian = lagrangian - ca.dot(n, gaps)
        laws += [equality(phi.tau.numel()), complementarity(n.numel())]
        symbols += [phi.tau, n]
        us += [ca.gradient(lagrangian, phi.tau), gaps]
        rows += [f"{name} level {j}" for j in range(phi.tau.numel())] + [f"{name} piece {i}" for i in range(n.numel())]
    force = -ca.gradient(lagrangian, y)
    if guarded and operation_codes(phi.smooth) & DOMAIN_OPERATIONS:
        force = ca.if_else(ca.fabs(phi.smooth) < np.inf, force, np.nan)
    return Subdifferential(product(*laws), stack_column(symbols), force, stack_column(us), tuple(rows))


_LAW_OF_TERM = {
    "abs": lambda m, w: relay(m, -w, w),
    "max": lambda m, w: box(ca.repmat(-w, m, 1), ca.SX.zeros(m)),
    "norm": ball,
    "indicator": lambda m, w: complementarity(m),
    "equality": lambda m, w: equality(m),
    "cone": lambda m, w: second_order_cone(m),
}


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """A time-stepping scheme of a class of models.

    Attributes:
        one_step_problem: (model), the problem of one step.
        initial_rows: (model, h), the rows (state, records) that are known before the first step.
        symbolic_initial_rows: (model, h), the same as expressions of h and the parameters; left out: the model's start.
        symbolic_start_state: (model, h), what the first step starts from, if that is not the model's start.
        derived_columns: (model, arrays, step that starts at each row), the columns that follow from others.
        kept_within: (model), rows c(t, state) >= 0 within which the state is kept; left out: the model's constraints.
        state_before_short_step: (model, state, ratio), where the state holds more than a position.
    """

    one_step_problem: Callable[[Any], OneStepProblem]
    initial_rows: Callable[[Any, float], list[tuple[np.ndarray, dict[str, np.ndarray]]]]
    symbolic_initial_rows: Callable[[Any, ca.SX], list[tuple[ca.SX, dict[str, ca.SX]]]] | None = None
    symbolic_start_state: Callable[[Any, ca.SX], ca.SX] | None = None
    derived_columns: Callable[[Any, dict[str, np.ndarray], np.ndarray], dict[str, np.ndarray]] | None = None
    kept_within: Callable[[Any], ca.SX] | None = None
    state_before_short_step: Callable[[Any, np.ndarray, float], np.ndarray] | None = None


SCHEMES = Part[Mapping[str, Scheme]]("schemes.SCHEMES")


def _scheme_of(model: Any) -> Scheme:
    return SCHEMES.of(model)[model.scheme]


@cached_per_object
def one_step_problem(model: Model) -> OneStepProblem:
    """Return the one-step problem of the model's scheme."""
    return _scheme_of(model).one_step_problem(model)


def initial_rows(model: Any, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return (state, records) of the rows that are known before the first step; h is the first step."""
    rows = _scheme_of(model).initial_rows(model, h)
    u = initial_inputs(model, rows[0][0][: len(model.names)])
    return [(np.concatenate([state, u, u]), records) for state, records in rows]


def symbolic_initial_rows(model: Any, h: ca.SX) -> list[tuple[ca.SX, dict[str, ca.SX]]]:
    """The same as `initial_rows` as expressions of h and the parameters, the state as far as the model's own names go."""
    own = _scheme_of(model).symbolic_initial_rows
    return [(model.start, {})] if own is None else own(model, h)


def symbolic_start_state(model: Any, h: ca.SX) -> ca.SX | None:
    """Return the state that the first step starts from as an expression of h, where the scheme has one of its own."""
    own = _scheme_of(model).symbolic_start_state
    return None if own is None else ca.vertcat(own(model, h), np.tile(initial_inputs(model), 2))


def derived_columns(model: Any, arrays: dict[str, np.ndarray], h_next: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns that follow from others: reactions, energy. ``h_next`` is the step that starts at each row."""
    derive = _scheme_of(model).derived_columns
    return {} if derive is None else derive(model, arrays, h_next)


def state_constraints(model: Any) -> ca.SX:
    """Return what the state is kept within, as rows c(t, state) >= 0."""
    kept = _scheme_of(model).kept_within
    return ca.vertcat(ca.SX(0, 1), *getattr(model, "constraints", {}).values()) if kept is None else kept(model)


def state_before_short_step(model: Any, state: np.ndarray, ratio: float) -> np.ndarray:
    """Return the state before a last step that is shorter than the others by ``ratio``."""
    shorten, own = _scheme_of(model).state_before_short_step, state.size - 2 * model.u.numel()
    return state if shorten is None else np.concatenate([shorten(model, state[:own], ratio), state[own:]])
