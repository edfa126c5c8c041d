"""Moreau-Jean time stepping (Moreau 1988; Jean, CMAME 177, 1999), velocities and positions in one problem.

With t_m, q_m where M and the directions of contacts are taken (geometry), q+ = q + h T(q_m) ((1 - th) v + th v+),

    M(q_m) (v+ - v) - h ((1 - th) F(t, q, v) + th F(t + h, q+, v+)) = sum_a G_a(q_m)' P_a + J(q_m)' L
    of contacts that act:  -ŷ ∈ N_K(P_a),  y = (u_N+ + e u_N-, u_T+ + e_t u_T-);  of others  P_a = 0;    J(q+) v+ + d_t c = 0

and where positions are put back (``project``), in the metric of M (Acary, CMAME 256, 2013),

    M(q_m) d = sum_a G_N,a(q_m)' tau_a + J(q_m)' s,    0 <= g_a(t + h, q+ + d) ⟂ tau_a >= 0 of all contacts,  c(t + h, q+ + d) = 0

A contact that does not act has its y_N moved by OPEN, beyond any speed: the matrices do not change with the contacts that act.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.errors import UsageError
from nsmodel.modeling.laws import Law, complementarity, equality, product
from nsmodel.modeling.variants import initial_inputs
from nsmodel.models.mechanical_system.model import ContactTerms, MechanicalSystem, applied_forces
from nsmodel.models.mechanical_system.several_answers import uniqueness_doubt
from nsmodel.solvers.initial_checks import InitialChecks, parameter_values_text
from nsmodel.solvers.one_step_problem import OneStepProblem, Scheme, SchemeOrder, rewrite_as_basic_law, with_carried_inputs

OPEN = 1e30  # What is added to the normal velocity of a contact that does not act: beyond any speed, and far from overflow.
# Part of the largest gap so far up to which a contact counts as closed, where
# tol_g is left out: far more than rounding leaves of a gap that is 0.
TOL_G = 1e-10


class Place(NamedTuple):
    """t, q, v and u at which an expression is evaluated."""

    t: ca.SX
    q: ca.SX
    v: ca.SX
    u: ca.SX


@dataclass(frozen=True)
class StepSymbols:
    """The places of a step, and what is taken at them.

    Attributes:
        here, middle, end: the start, where M and the directions of contacts are taken, and (t + h, q+, v+).
        h, v_next: the step, the unknown velocity; size: the largest gap so far, which the state carries.
        T: q' = T v, at the middle of the step.
    """

    model: MechanicalSystem
    here: Place
    middle: Place
    end: Place
    h: ca.SX
    v_next: ca.SX
    size: ca.SX
    T: ca.SX

    def at(self, place: Place, expression: ca.SX) -> ca.SX:
        """The expression at a place."""
        return ca.substitute(expression, ca.vertcat(*self.here), ca.vertcat(*place)) if expression.numel() else expression


class ActiveContact(NamedTuple):
    """A contact in a step: y of its law, impulses P, rows G, velocities u at the end, and whether it acts."""

    y: ca.SX
    P: ca.SX
    G: ca.SX
    u: ca.SX
    acts: ca.SX


def forces(model: MechanicalSystem) -> ca.SX:
    """F, less the gyroscopic terms of M where these are derived: dM/dt v - d(v'M v)/dq / 2."""
    if model.inertia == "given":
        return applied_forces(model)
    Mv = model.M @ model.v
    return applied_forces(model) - ca.jacobian(Mv, model.q) @ model.v + ca.gradient(ca.dot(model.v, Mv), model.q) / 2


def one_step_problem(model: MechanicalSystem) -> OneStepProblem:
    """Return the step as a nonsmooth problem in (v+, d)."""
    u = ca.SX.sym("u_next", model.u.numel())
    step = _symbols_of_step(model, u)
    q, v, h, th = model.q, model.v, step.h, model.theta
    contacts = [_contact_in_step(step, one) for one in model.contact_rows]
    joints = _column(model.joints.values())
    L, J, J_t = ca.SX.sym("L", joints.numel()), ca.jacobian(joints, q), ca.jacobian(joints, model.t)
    M, F = step.at(step.middle, model.M), forces(model)
    E = M @ (step.v_next - v) - h * ((1 - th) * F + th * step.at(step.end, F))
    E -= sum((one.G.T @ one.P for one in contacts), ca.SX(E.shape[0], 1)) + (step.at(step.middle, J) @ step.T).T @ L
    held = step.at(step.end, J) @ (step.T @ step.v_next) + step.at(step.end, J_t)

    driven, ended = ca.vertcat(model.t, model.u), ca.vertcat(model.t + h, u)
    impulses, y_user = _column([*(one.P for one in contacts), L]), ca.SX.sym("y", model.law.size)
    basic = rewrite_as_basic_law(model.law, model.multiplier_names, y_user, driven, ended)
    Y = ca.substitute(basic.y, y_user, _column([*(one.y for one in contacts), held]))
    work = _column(ca.dot(one.P, one.G @ ((1 - th) * v + th * step.v_next)) for one in contacts)
    E, Y, work = ca.substitute([E, Y, work], [impulses], [basic.multipliers])
    z, l, law, rows, guess, q_end = step.v_next, basic.l, basic.law, basic.rows, v, step.end.q
    if model.project and basic.l.numel():
        put = _position_problem(step, M)
        z, E, l, Y = ca.vertcat(z, put.d), ca.vertcat(E, put.E), ca.vertcat(l, put.l), ca.vertcat(Y, put.Y)
        law, rows, guess, q_end = product(law, put.law), rows + put.rows, ca.vertcat(v, 0 * put.d), q_end + put.d
    gaps = step.at(step.end._replace(q=q_end), _gaps(model))
    records = _contact_records(contacts, gaps, step.at(step.end, _gaps(model)), work) if contacts else {}
    largest = ca.fmax(step.size, ca.norm_inf(gaps)) if contacts else step.size
    problem = OneStepProblem(
        scheme=f"Moreau-Jean, theta = {th:g}", t=model.t, h=h, state=ca.vertcat(q, v, step.size), p=model.p,
        z=z, l=l, y=ca.SX.sym("y", l.numel()), E=E, Y=Y, law=law, rows=rows, guess=guess,
        next_state=ca.vertcat(q_end, step.v_next, largest), order=SchemeOrder(1),
        carried="the largest gap so far",
        multipliers=basic.multipliers, outputs=_column([*(one.u for one in contacts), held]), declared=model.multiplier_names,
        ends=basic.ends, records=records, axes=_contact_axes(model),
        ranges=_column(one.margin for one in restitution_conditions(model) if not one.margin.is_constant()),
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u)


def _symbols_of_step(model: MechanicalSystem, u: ca.SX) -> StepSymbols:
    t, q, v, h, th = model.t, model.q, model.v, ca.SX.sym("h"), model.theta
    v_next, here = ca.SX.sym("v_next", v.numel()), Place(t, q, v, model.u)
    T = position_rates(model)
    half = q + h / 2 * (T @ v)
    T = ca.substitute(T, q, half)
    end = Place(t + h, q + h * (T @ ((1 - th) * v + th * v_next)), v_next, u)
    middle = {"begin": here, "middle": Place(t + h / 2, half, v, u), "end": end._replace(v=v)}[model.geometry]
    return StepSymbols(model, here, middle, end, h, v_next, ca.SX.sym("size"), T)


def _contact_in_step(step: StepSymbols, one: ContactTerms) -> ActiveContact:
    """Its rows where directions are taken, but for "end", u_N- and u_T- at the start; y_N moved by OPEN where it does not act."""
    model = step.model
    G, w = _contact_rows(step, one, step.middle)
    u, before = G @ step.v_next + w, G @ model.v + w
    if model.geometry == "end":
        G_0, w_0 = _contact_rows(step, one, step.here)
        before = G_0 @ model.v + w_0
    back = one.e * (ca.fmin(before[0], 0) if model.restitution == "approach" else before[0])
    tolerance = ca.SX(model.tol_g) if model.tol_g is not None else TOL_G * step.size
    acts = _gap_ahead(step, one) <= tolerance
    y = u + (ca.vertcat(back, one.e_t * before[1:]) if one.slip.numel() else back)
    y[0] += ca.if_else(acts, 0, OPEN)
    return ActiveContact(y, ca.SX.sym(f"P_{one.name}", u.numel()), G, u, acts)


def _contact_rows(step: StepSymbols, one: ContactTerms, place: Place) -> tuple[ca.SX, ca.SX]:
    """G and w of u = G v + w at a place."""
    model = step.model
    G, w = step.at(place, ca.jacobian(one.gap, model.q)) @ step.T, step.at(place, ca.jacobian(one.gap, model.t))
    if one.slip.numel():
        moved = ca.substitute(one.slip, model.v, ca.SX.zeros(model.v.numel()))
        G = ca.vertcat(G, step.at(place, ca.jacobian(one.slip, model.v)))
        w = ca.vertcat(w, step.at(place, moved))
    return G, w


def _gap_ahead(step: StepSymbols, one: ContactTerms) -> ca.SX:
    """The gap at the end of a step free of all contacts, or at t + a h with the velocity that there is."""
    model, (t, q, v, u), h = step.model, step.here, step.h
    T = position_rates(model)
    if model.activation == "free":
        free = T @ (h * v + h**2 / 2 * ca.solve(model.M, forces(model)))
        return step.at(Place(t + h, q + free, v, u), one.gap)
    a = float(model.activation)
    return step.at(Place(t + a * h, q + a * h * (T @ v), v, u), one.gap)


class PositionProblem(NamedTuple):
    """What puts positions back: unknowns d with rows E, multipliers l with rows Y of a law."""

    d: ca.SX
    E: ca.SX
    l: ca.SX
    Y: ca.SX
    law: Law
    rows: tuple[str, ...]


def _position_problem(step: StepSymbols, M: ca.SX) -> PositionProblem:
    """d in the metric of M, where velocities are derivatives of positions, else in that of positions."""
    model, gaps, joints = step.model, _gaps(step.model), _column(step.model.joints.values())
    d, tau, s = (ca.SX.sym(name, part.numel()) for name, part in (("d", model.q), ("tau", gaps), ("s", joints)))
    put = step.end._replace(q=step.end.q + d)
    where = put if model.geometry == "end" else step.middle
    metric = M if model.kinematics is None else ca.SX.eye(d.numel())
    E = metric @ d - step.at(where, ca.jacobian(gaps, model.q)).T @ tau - step.at(where, ca.jacobian(joints, model.q)).T @ s
    rows = tuple(f"{name} position" for name in (*(one.name for one in model.contact_rows), *model.joint_names))
    law = product(complementarity(gaps.numel()), equality(joints.numel()))
    return PositionProblem(d, E, ca.vertcat(tau, s), ca.vertcat(step.at(put, gaps), step.at(put, joints)), law, rows)


def _contact_records(contacts: Sequence[ActiveContact], gaps: ca.SX, free_gaps: ca.SX, work: ca.SX) -> dict[str, ca.SX]:
    """Columns by contact; it is missed where it does not act and the velocities of the step close it, before it is put back."""
    acts = _column(one.acts for one in contacts)
    return {
        "u_N": _column(one.u[0] for one in contacts),
        "u_T": _column(one.u[1:] for one in contacts if one.u.numel() > 1),
        "gap": gaps,
        "acting": acts,
        "missed": ca.logic_and(ca.logic_not(acts), free_gaps < 0),
        "impulse_work": work,
    }


def _contact_axes(model: MechanicalSystem) -> dict[str, tuple[str, ...]]:
    names = tuple(one.name for one in model.contact_rows)
    slips = tuple(row for one in model.contact_rows for row in one.rows[1:])
    return {axis: found for axis, found in (("contact", names), ("slip", slips)) if found}


def position_rates(model: MechanicalSystem) -> ca.SX:
    """The T(q) of q' = T(q) v."""
    return ca.SX.eye(model.q.numel()) if model.kinematics is None else model.kinematics


def _gaps(model: MechanicalSystem) -> ca.SX:
    return _column(one.gap for one in model.contact_rows)


def _column(parts: Iterable[ca.SX]) -> ca.SX:
    return ca.vertcat(ca.SX(0, 1), *parts)


def initial_rows(model: MechanicalSystem, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """(q_0, v_0) and the largest gap; the velocities and gaps of contacts there, of which no step has seen one act."""
    gaps, u_N, u_T = (np.array(ca.DM(part)).ravel() for part in start_values(model))
    state = np.append(np.array(ca.DM(model.x0)).ravel(), np.abs(gaps).max(initial=0.0))
    none = np.zeros(gaps.size)
    return [(state, {"u_N": u_N, "u_T": u_T, "gap": gaps, "acting": none, "missed": none} if gaps.size else {})]


def symbolic_start_state(model: MechanicalSystem, h: ca.SX) -> ca.SX:
    """The same as an expression of the parameters."""
    gaps = start_values(model)[0]
    return ca.vertcat(model.x0, ca.norm_inf(gaps) if gaps.numel() else 0)


def symbolic_initial_rows(model: MechanicalSystem, h: ca.SX) -> list[tuple[ca.SX, dict[str, ca.SX]]]:
    """The row 0 of a sweep: the model's own states, and the records."""
    gaps, u_N, u_T = start_values(model)
    none = ca.SX.zeros(gaps.numel())
    return [(model.start, {"u_N": u_N, "u_T": u_T, "gap": gaps, "acting": none, "missed": none} if gaps.numel() else {})]


def start_values(model: MechanicalSystem) -> list[ca.SX]:
    """Gaps, normal and slip velocities of all contacts at the start."""
    gaps, slips = _gaps(model), _column(one.slip for one in model.contact_rows)
    u_N = ca.jacobian(gaps, model.q) @ (position_rates(model) @ model.v) + ca.jacobian(gaps, model.t)
    here, start = ca.vertcat(model.t, model.x, model.u), ca.vertcat(0, model.x0, ca.SX(list(initial_inputs(model))))
    return ca.substitute([gaps, u_N, slips], [here], [start])


def derived_columns(model: MechanicalSystem, arrays: dict[str, np.ndarray], h_next: np.ndarray) -> dict[str, np.ndarray]:
    """Reactions P/h, the energy v'M v/2 + V, and by how much each contact is penetrated."""
    energy = energy_function(model)
    found = {"energy": np.array(energy.map(len(arrays["t"]))(arrays["t"], arrays["x"].T)).ravel()}
    if arrays["multipliers"].shape[1]:
        found["reactions"] = arrays["multipliers"] / arrays["step"][:, None]
    if "gap" in arrays:
        found["penetration"] = np.maximum(-arrays["gap"], 0.0)
    return found


@cached_per_object
def energy_function(model: MechanicalSystem) -> ca.Function:
    """(t, x) -> v'M v/2 + V."""
    return ca.Function("energy", [model.t, model.x], [ca.dot(model.v, model.M @ model.v) / 2 + model.potential])


GAP_SLACK = 1e-5  # Parts of the size of positions by which a start may overlap, as its numbers are written with some five digits,
JOINT_SLACK = 1e-8  # and by which a joint may be open: a joint that is open stays so.


class StartCondition(NamedTuple):
    """What a model asks of its start and its parameters: ``margin`` >= 0; else "what value; expected"."""

    margin: ca.SX
    value: ca.SX
    what: str
    expected: str


def start_conditions(model: MechanicalSystem) -> list[StartCondition]:
    """No contact overlaps, no joint is open or moves apart, coefficients of restitution are in their ranges."""
    at = ca.vertcat(model.t, model.x), ca.vertcat(0, model.x0)
    gaps, q0, v0 = start_values(model)[0], model.x0[: model.q.numel()], model.x0[model.q.numel() :]
    joints = _column(model.joints.values())
    rate = ca.jacobian(joints, model.q) @ (position_rates(model) @ model.v) + ca.jacobian(joints, model.t)
    values, rates = ca.substitute([joints, rate], *([part] for part in at))
    size = ca.fmax(1e-300, ca.norm_inf(ca.vertcat(0, q0, gaps)))
    open_slack = JOINT_SLACK * ca.fmax(size, size**2)
    rate_slack = JOINT_SLACK * ca.norm_inf(ca.vertcat(1, v0)) * ca.fmax(size, 1)
    found = []
    for one, gap in zip(model.contact_rows, ca.vertsplit(gaps), strict=True):
        what, fix = f"contact '{one.name}' overlaps at the start: its gap is", "move q0 until it is >= 0"
        found.append(StartCondition(gap + GAP_SLACK * size, gap, what, fix))
    for name, c, moves in zip(model.joint_names, ca.vertsplit(values), ca.vertsplit(rates), strict=True):
        what, fix = f"joint '{name}' is open at the start: c =", "choose q0 with c = 0"
        found.append(StartCondition(open_slack - ca.fabs(c), c, what, fix))
        what, fix = f"joint '{name}' moves apart at the start: dc/dt =", "choose v0 with dc/dt = 0"
        found.append(StartCondition(rate_slack - ca.fabs(moves), moves, what, fix))
    return found + restitution_conditions(model)


def restitution_conditions(model: MechanicalSystem) -> list[StartCondition]:
    """Of each contact 0 <= e <= 1 and -1 <= e_t <= 1."""
    found = []
    for one in model.contact_rows:
        for letter, value, low in (("e", ca.SX(one.e), 0), ("e_t", ca.SX(one.e_t), -1)):
            what = f"contact '{one.name}': {letter} ="
            found.append(StartCondition(ca.fmin(value - low, 1 - value), value, what, f"expected a number in [{low}, 1]"))
    return found


def check_start(model: MechanicalSystem) -> None:
    """Refuse M that is not positive definite at the start, `start_conditions` that do not hold, and laws that are none.

    Raises:
        UsageError: names the contact or the joint, its value, and what is expected.
    """
    M = np.array(ca.DM(_mass_at_start(model)))
    least = np.linalg.eigvalsh(M) if M.size else np.ones(1)
    given = parameter_values_text(model)
    if not least[0] > 0:
        raise UsageError(f"M: its least eigenvalue at the start is {least[0]:g}{given}; a mass matrix is positive definite")
    for condition in start_conditions(model):
        if not float(condition.margin) >= 0:
            raise UsageError(f"{condition.what} {float(condition.value):g}{given}; {condition.expected}")
    for block, one in zip(model.law.blocks, model.contact_rows, strict=False):
        if why := block.invalidity_reason(given):
            raise UsageError(f"contact '{one.name}': {why}")


def admitted(model: MechanicalSystem) -> list[ca.SX]:
    """What `check_start` asks, as expressions >= 0 of the parameters; of M = L D L', the 1/D_ii, infinite where M is singular."""
    D, *_ = ca.ldl(_mass_at_start(model))
    return [1 / D, *(one.margin for one in start_conditions(model))]


def _mass_at_start(model: MechanicalSystem) -> ca.SX:
    return ca.substitute(model.M, ca.vertcat(model.t, model.x), ca.vertcat(0, model.x0))


def warnings(model: MechanicalSystem) -> list[str]:
    """That a step may have several answers, where nothing shows that it has one."""
    why = uniqueness_doubt(model)
    return [f"unique: not guaranteed ({why})"] if why else []


SCHEMES = {
    "moreau-jean": Scheme(
        one_step_problem=one_step_problem,
        initial_rows=initial_rows,
        symbolic_initial_rows=symbolic_initial_rows,
        symbolic_start_state=symbolic_start_state,
        derived_columns=derived_columns,
    ),
}
INITIAL_CHECKS = InitialChecks(check_start=check_start, warnings=warnings, admitted=admitted)
