"""Why a step has no verified solution, in the user's words."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.errors import EmptyLawError
from nsmodel.modeling.laws import CoulombSet
from nsmodel.modeling.laws.base import find_invalid_row
from nsmodel.proof.expression_graph import OpaqueExpression
from nsmodel.solvers import mlcp
from nsmodel.solvers.active_set import enumerate_index_sets
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.plan import Plan
from nsmodel.solvers.residuals import REACH, NumericLaw
from nsmodel.solvers.rounding_errors import equilibrate_matrix
from nsmodel.solvers.step import RUNAWAY_LIMIT
from nsmodel.solvers.structure import StepStructure, is_eigenvalue_nonnegative, least_eigenvalue

JUMP_ADVICE = "a jump in the model (sign, floor, if_else) must be written as a law, such as relay or complementarity"
MIN_OPPOSING_ANGLE = 1e-7  # 1/gamma below which W, which has its square, holds too little of the angle between opposing rows.
# DEPENDENCE_LIMIT: 4500 EPS.
DEPENDENCE_LIMIT = 1e-12  # Least singular value of W, beside its largest, below which doubles do not tell multipliers apart.
# NEIGHBOURHOOD: it is looked for once in a run, where a step has failed.
NEIGHBOURHOOD, ROOT_SAMPLES = 10, 64  # Times the state: where jumps are looked for, between so many points.
MAX_NAMES = 12  # Contacts that a message names.
# MODERATE: they are solved to 1e-7.
MODERATE = 1e-4  # Of the largest: parts of W and friction beside which linear programmes tell what is infeasible.
MAX_ACTING = 4  # Contacts whose choices of modes, four each, are looked at one by one: 256 linear programmes.
OPEN, STICK, INFEASIBLE = "open", "stick", 2  # Modes of a contact, and the status of linprog where nothing is feasible.
LIFTED = 1e12  # So many times what is violated a row that is farther off says nothing: contacts that do not act.
FARKAS_TOLERANCE = 1e-14  # Largest positive entry of W'u, beside W's, in a proof that is believed: 45 EPS.


def describe_overreach(name: str, ratio: float) -> str:
    """Why a step is refused whose residual is small: the row's linearisation is off by ``ratio`` of the motion."""
    return (
        f"it leads where the linearisation of '{name}', by which it was taken, means nothing (off by {ratio:.2g} of the motion, "
        f"at most {REACH:.2g}); take smaller steps"
    )


def find_empty_law(problem: OneStepProblem, t: float, h: float, state: np.ndarray) -> EmptyLawError | None:
    """That a law that moves is no set at the end of the step, by the name of its row; None where each is one."""
    if not problem.ends:
        return None
    known, values = ca.vertcat(problem.t, problem.h, problem.state), np.concatenate([[t, h], state])
    found = find_invalid_row(problem.ends, known, values, t + h)
    return None if found is None else EmptyLawError(found.text, component=found.name)


def explain_step_failure(
    problem: OneStepProblem, structure: StepStructure, law: NumericLaw, plan: Plan, W: np.ndarray | None, b: np.ndarray | None,
    at: tuple[float, float, np.ndarray], finite: bool, least: float,
) -> str:  # fmt: skip
    """Return the most specific reason that can be proved, else what is known; ``at``: t, h and the state of the step."""
    state = at[2]
    if not np.isfinite(state).all():
        return "the state is not finite"
    if not finite:
        return (
            "the model's expressions are not finite at the present state and time (a root of a negative number, a division by 0?)"
        )
    if W is None or b is None:
        return "the linearised step is singular at this step size; change the step, or check M, A and K"
    bad = np.flatnonzero(~(np.isfinite(b) & np.isfinite(W).all(axis=1)))
    if bad.size:
        return (
            f"'{problem.rows[bad[0]]}' or its gradient is not a finite number at the present state "
            "(a square root or norm at 0, a division by 0?)"
        )
    if (size := max(np.abs(b).max(initial=0.0), np.abs(state).max(initial=0.0))) > RUNAWAY_LIMIT:
        return f"the state, or what it gives, has grown to {size:.3g}, beyond {RUNAWAY_LIMIT:g}"
    least = 0.0 if structure.gram else min(least_eigenvalue(W), least)
    monotone = is_eigenvalue_nonnegative(least, law.size)
    return (
        (_describe_opposing_rows(problem, law, W, b) if monotone or not law.is_normal_cone else "")
        or (_describe_nearly_opposite(problem, W) if structure.projection else "")
        or (_describe_exhausted_index_sets(structure, law, least) if not monotone and mlcp.ENUMERATION in plan.chain else "")
        or _describe_failing_modes(problem, structure, law, W, b)
        or _describe_unproved_failure(problem, structure, law, plan, W, at) + _describe_closing_contacts(problem, law, b)
    )


def _describe_opposing_rows(problem: OneStepProblem, law: NumericLaw, W: np.ndarray, b: np.ndarray) -> str:
    """That constraints oppose each other, '' where none are proved to."""
    names = _weighted_row_names(problem, opposing_rows(W, b, law) or [])
    if not names:
        return ""
    if len(names) == 1:
        return f"no multiplier can keep {names[0]} from being violated"
    no_point = "the constraints leave no point: " + " and ".join(names) + " oppose each other"
    if problem.overreach is None:
        return no_point
    return f"linearised at the step's start, {no_point} (with curved ones smaller steps, or rtol, may find one)"


def _describe_nearly_opposite(problem: OneStepProblem, W: np.ndarray) -> str:
    """That constraints are nearly opposite, '' where none are."""
    inverse_gamma, rows = nearly_opposite_rows(W)
    if not inverse_gamma < MIN_OPPOSING_ANGLE:
        return ""
    return (
        f"{' and '.join(_weighted_row_names(problem, rows))} are nearly opposite (gamma > {1 / MIN_OPPOSING_ANGLE:.0e}): double "
        "precision cannot resolve where between them the state is; leave more room between them, or write them as one equality"
    )


def _describe_exhausted_index_sets(structure: StepStructure, law: NumericLaw, least: float) -> str:
    """That all index sets were tried, '' where there are too many."""
    count = sum(1 for _ in enumerate_index_sets(law, np.zeros(law.size, np.int8)))
    if not count:
        return ""
    which = "has no solution" if structure.affine else "seems to have no solution"
    none = f"none of the {count} index sets satisfies the law"
    return f"the step {which}: W is not psd (least eigenvalue {least:.3g}) and {none}"


def _describe_unproved_failure(
    problem: OneStepProblem, structure: StepStructure, law: NumericLaw, plan: Plan, W: np.ndarray,
    at: tuple[float, float, np.ndarray],
) -> str:  # fmt: skip
    """What is known where nothing is proved."""
    if not plan.use_last and plan.chain:
        return "the forced solver did not find it"
    if not (structure.affine and law.size):
        return "Newton's method did not converge" + (f"; {JUMP_ADVICE}" if _jumps(problem, *at) else "")
    if _jumps(problem, *at):
        return f"no solver reached the tolerance; {JUMP_ADVICE}"
    part, dependent = dependent_rows(W)
    if part < DEPENDENCE_LIMIT and len(dependent) > 1:
        return (
            f"no solver reached the tolerance; {' and '.join(_weighted_row_names(problem, dependent))} depend on one another to "
            f"a part of {part:.1g}: where they are held together, double precision cannot resolve their multipliers"
        )
    return "no solver reached the tolerance"


def _describe_closing_contacts(problem: OneStepProblem, law: NumericLaw, b: np.ndarray) -> str:
    """The contacts that close where nothing pushes, '' of laws without friction."""
    if law.is_normal_cone:
        return ""
    contacts = _contact_rows(law)[0] | np.isin(problem.rows, problem.axes.get("contact", ()))
    names = [f"'{problem.rows[i]}'" for i in np.flatnonzero(contacts & (b < 0))]
    more = f", and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return f", with the contacts {', '.join(names[:MAX_NAMES])}{more} closing" if names else ""


def _describe_failing_modes(
    problem: OneStepProblem, structure: StepStructure, law: NumericLaw, W: np.ndarray, b: np.ndarray
) -> str:
    """That the contacts that act have an answer in no choice of modes; '' where that is not shown."""
    failing = contacts_without_answer(law, W, b)
    if not failing:
        return ""
    names, where = ", ".join(f"'{problem.rows[i]}'" for i in failing), "" if structure.affine else " in the linearised step"
    modes = f"none of the {4 ** len(failing)} choices of modes (open, stick, slip either way) of the contacts that act"
    return f"{modes}, {names}, has an answer{where}"


def contacts_without_answer(law: NumericLaw, W: np.ndarray, b: np.ndarray) -> list[int]:
    """The normal rows of contacts on lines that act, where linear programmes show that no modes have an answer; else none.

    It is none too where other rows push these contacts, frictionless ones that act or joints, and where there are too many.
    """
    near = b <= LIFTED * (-b).max(initial=0.0)
    acts = [(rows, K) for rows, K in law.curved if isinstance(K, CoulombSet) and near[rows.start]]
    kept = [i for rows, _ in acts for i in range(rows.start, rows.stop)]
    strange = any(not isinstance(K, CoulombSet) for _, K in law.curved) or len(kept) != 2 * len(acts)
    if not acts or strange or len(acts) > MAX_ACTING or W[kept][:, near & _contact_rows(law)[1]].any():
        return []
    W, b, mu = W[np.ix_(kept, kept)], b[kept], [float(K.mu) for _, K in acts]
    size = np.abs(W).max()
    if not np.diag(W).min() > MODERATE * size or max(mu) * MODERATE > 1:  # Numbers of many sizes prove nothing.
        return []
    W, b = W / size, b / max(np.abs(b).max(), 1e-300)
    if any(_has_answer_in_modes(W, b, mu, modes) for modes in product((OPEN, STICK, 1.0, -1.0), repeat=len(acts))):
        return []
    return [rows.start for rows, _ in acts]


def _has_answer_in_modes(W: np.ndarray, b: np.ndarray, mu: Sequence[float], modes: Sequence[Any]) -> bool:
    """Whether some l solves y = W l + b in these modes: open, stick, or slip, P_T = -+ mu P_N against +- y_T >= 0."""
    from scipy.optimize import linprog

    unit, zero, held, kept = np.eye(len(W)), np.zeros(len(W)), [], []  # Rows (of l, of 1) of a l = c, and of a l >= c.
    for k, (own, mode) in enumerate(zip(mu, modes, strict=True)):
        n, t = 2 * k, 2 * k + 1
        kept.append((unit[n], 0.0))
        if mode == OPEN:
            held += [(unit[n], 0.0), (unit[t], 0.0)]
            kept.append((W[n], -b[n]))
        elif mode == STICK:
            held += [(W[n], -b[n]), (W[t], -b[t])]
            kept += [(own * unit[n] + side * unit[t], 0.0) for side in (1, -1)]
        else:
            held += [(W[n], -b[n]), (unit[t] + mode * own * unit[n], 0.0)]
            kept.append((mode * W[t], -mode * b[t]))
    A, c, G, d = (np.array(part) for rows in (held, kept) for part in zip(*rows, strict=True))
    return bool(linprog(zero, A_ub=-G, b_ub=-d, A_eq=A, b_eq=c, bounds=(None, None)).status != INFEASIBLE)


def _jumps(problem: OneStepProblem, t: float, h: float, state: np.ndarray) -> bool:
    """Whether the equations of a step jump somewhere: two points next to each other were found with different values.

    Looked for once, where a step fails first.
    """
    found = _jumps_found(problem)
    if not found:
        found.append(_find_jump(problem, t, h, state))
    return found[0]


@cached_per_object
def _jumps_found(problem: OneStepProblem) -> list[bool]:
    """Where the answer is put: none yet, or one."""
    del problem
    return []


def _find_jump(problem: OneStepProblem, t: float, h: float, state: np.ndarray) -> bool:
    h = max(h, 1.0)  # In a short step h times the jump of a rate is lost beside z.
    unknown = ca.vertcat(problem.z, problem.l)
    known, values = [problem.t, problem.h, problem.state], [t, h, ca.DM(state)]
    equations = ca.substitute([ca.vertcat(problem.E, problem.Y)], known, list(map(ca.SX, values)))[0]
    reach = np.full(unknown.numel(), NEIGHBOURHOOD * max(1.0, np.abs(state).max(initial=0.0)))
    from nsmodel.proof.jumps import find_jump  # Runs that do not fail need not load it.

    try:
        return find_jump(equations, unknown, -reach, reach, lambda points: np.ones(len(points), bool), ROOT_SAMPLES) is not None
    except OpaqueExpression:
        return False


def _weighted_row_names(problem: OneStepProblem, rows: Sequence[tuple[int, float]]) -> list[str]:
    """The rows by name, with their weights."""
    return [f"'{problem.rows[i]}' (weight {u:.3g})" for i, u in rows]


def dependent_rows(W: np.ndarray) -> tuple[float, list[tuple[int, float]]]:
    """The least singular value of W, beside its largest, in its best units, and the rows of its vector with their weights.

    Rows that feel no multiplier, or whose multiplier moves nothing, are left out: they depend on nothing.
    """
    acting = np.flatnonzero(W.any(axis=1) & W.any(axis=0))
    if not acting.size:
        return 1.0, []
    scaled, _, _ = equilibrate_matrix(W[np.ix_(acting, acting)])
    U, s, _ = np.linalg.svd(scaled)
    weights = np.abs(U[:, -1]) / np.abs(U[:, -1]).sum()
    order = np.argsort(-weights)
    return float(s[-1] / max(s[0], 1e-300)), [(int(acting[i]), float(weights[i])) for i in order if weights[i] > 1e-3][:6]


def nearly_opposite_rows(W: np.ndarray) -> tuple[float, list[tuple[int, float]]]:
    """1/gamma, the distance from 0 to the hull of the unit normals whose products are W, and the rows with their weights."""
    from scipy.optimize import nnls

    size = np.sqrt(np.diag(W))
    size[size == 0] = 1
    value, V = np.linalg.eigh(W / np.outer(size, size))
    root = np.sqrt(np.maximum(value, 0))[:, None] * V.T
    u, _ = nnls(np.vstack([root, np.ones(len(W))]), np.append(np.zeros(len(W)), 1.0))
    u = u / u.sum()
    return float(np.linalg.norm(root @ u)), [(int(i), float(u[i])) for i in np.argsort(-u) if u[i] > 1e-6][:6]


def opposing_rows(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> list[tuple[int, float]] | None:
    """Return [(row, weight), ...] of a proof that no multiplier keeps all constraints, u'y < 0 for each (Farkas).

    Kept are y_i >= 0 of complementarity and y_N >= 0 of contacts, whose l_i >= 0, and y_i = 0 of equalities; the l of these, and
    P_T, may have any value. u >= 0 where y_i >= 0 is kept, 0 of slips, W'u <= 0, and = 0 where l may have any value; b'u < 0.
    For W psd and complementarity alone there is a solution where there is no such u. None where rounding hides a proof.
    """
    if not law.size or any(K.is_normal_cone for _, K in law.curved):
        return None
    normals, others = _contact_rows(law)
    slips = ~normals & ~others
    held = others & np.isneginf(law.lower) & np.isposinf(law.upper)
    one_sided = normals | (others & (law.lower == 0) & np.isposinf(law.upper))
    if not (held | one_sided | slips).all():
        return None
    one_sided &= b <= LIFTED * np.maximum(-b, np.abs(b) * held).max()
    signs = np.concatenate([np.flatnonzero(one_sided), np.flatnonzero(held), np.flatnonzero(held)])
    sign = np.concatenate([np.ones(one_sided.sum() + held.sum()), -np.ones(held.sum())])
    root = np.sqrt(np.abs(np.diag(W)))
    root = np.where(root > 0, root, 1.0)
    for units in (np.ones(law.size), root):  # the user's units, else those in which W_ii = 1
        scaled = W / units[:, None] / units
        u = _farkas_multipliers(sign[:, None] * scaled[signs], sign * (b / units)[signs], held | slips) if signs.size else None
        if u is not None:
            weights = np.bincount(signs, u / units[signs], law.size)
            return [(int(i), float(weights[i] / weights.sum())) for i in np.argsort(-weights) if weights[i] > 0][:6]
    return None


def _contact_rows(law: NumericLaw) -> tuple[np.ndarray, np.ndarray]:
    """Which rows are the normal ones of contacts with friction, and which are in no curved block."""
    normals, others = np.zeros(law.size, bool), np.ones(law.size, bool)
    for rows, _ in law.curved:
        normals[rows.start], others[rows] = True, False
    return normals, others


def _farkas_multipliers(W: np.ndarray, b: np.ndarray, free: np.ndarray) -> np.ndarray | None:
    """u >= 0 with W'u <= 0 to round-off, = 0 in the columns ``free``, b'u < 0 above it, and sum 1; None where there is none."""
    from scipy.optimize import linprog

    scale = np.abs(W).max(axis=0)
    scale[scale == 0] = 1
    A, size = W.T / scale[:, None], np.abs(b).max() or 1.0
    A = np.vstack([A, -A[free]])
    found = linprog(
        b / size,
        A_ub=A,
        b_ub=np.zeros(len(A)),
        A_eq=np.ones((1, b.size)),
        b_eq=[1.0],
        bounds=(0, None),
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if not found.success:
        return None
    u = np.where(found.x > 1e-9, found.x, 0.0)
    return None if (A @ u).max() > FARKAS_TOLERANCE or b @ u / size > -1e-6 else u
