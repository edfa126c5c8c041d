"""S-convex and A0 to A4 of one constraint: proved from its shape for all states where it has one, else bounded on the box."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.models.sweeping_process.constraint_bounds import (
    EVERYWHERE,
    ON_THE_BOX,
    SUP_ROUNDING_FACTOR,
    AnswersById,
    Constraint,
    HypothesisAnswer,
    bound_answer,
    decide_on_box,
    root_of_supremum,
    stationary_point,
    supremum_over_time,
    time_invariant_answer,
    vanishing_gradient_answers,
)
from nsmodel.models.sweeping_process.constraint_shapes import (
    AffineForm,
    Offset,
    Squares,
    affine_parts,
    form_hessian,
    offset_expression,
)
from nsmodel.models.sweeping_process.mfcq_constant import sqrt_above, sqrt_below
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.domain import DefinednessResult, check_defined_in_time, is_defined_on_box
from nsmodel.proof.expression_graph import numeric_constants
from nsmodel.proof.jumps import jump_nodes, prove_jump
from nsmodel.proof.ray_expansion import growth_exponent
from nsmodel.proof.verdict import not_none

# How far from a time, beside the interval or 1, a rate is looked at that grows without bound towards it,
RATE_PROBE_LENGTH = 1e-6
MAX_RATE_STATES = 16  # and at how many states, and times: one that is proved is enough.


def decide_constraint(constraint: Constraint, quick: bool) -> AnswersById:
    """Return the answer of a constraint to each of S-convex, A0, A1, A2, A3, A4.

    delta, with U_i = {g_i > -delta}, is infinite for planes, half the reach r for a distance minus r, and half the depth
    -min g_i otherwise: deeper sets come near to where the gradient vanishes.
    """
    known = _shape_answers(constraint) | _time_jump_answer(constraint) | _gradient_jump_answer(constraint)
    missing = {"S-convex", "A0", "A1", "A2", "A3", "A4"} - set(known)
    known |= decide_on_box(constraint, missing, known, quick) if missing else {}
    if known["A0"].verdict == HOLDS and known["A0"].where == ON_THE_BOX and not _has_no_hole(constraint):
        how = "g_i is not seen to have a value everywhere on the box: U_i may end there"
        known["A0"] = HypothesisAnswer(UNKNOWN, {}, ON_THE_BOX, how, {"constraint": constraint.name})
    if known["A2"].verdict == SAMPLED and (steep := _unbounded_rate_answer(constraint)) is not None:
        known["A2"] = steep
    return _require_finite_in_time(constraint, known)


def _shape_answers(c: Constraint) -> AnswersById:
    """What the shape alone tells."""
    by_shape: dict[str, Callable[[Constraint], AnswersById | None]] = {
        "plane": _plane_answers, "distance": _distance_answers, "quadratic": _quadratic_answers,
    }  # fmt: skip
    return dict(by_shape.get(c.shape.kind, _rotating_plane_answers)(c) or {})


def uniform_answers(c: Constraint, quick: bool) -> AnswersById:
    """What is proved for all times and parameters, by the shape where it has one, else by bounds over the box; no violations.

    What is proved of g is said of c g, c a function of parameters with 0 < c_0 <= c <= c_1: the sets {g >= 0} and
    {g > -delta} = {c g > -c delta} are the same, gradients and what moves are c times as large.
    """
    both = ca.vertcat(c.g, ca.gradient(c.g, c.q))
    if jump_nodes(both, c.t) and not interval_bounds.is_continuous(both, c.z, c.lower, c.upper):
        return {}  # derivatives would not tell
    if not _is_defined_for_all(c):
        return {}
    known = {id: answer for id, answer in _shape_answers(c).items() if answer.verdict == HOLDS}
    missing = {"S-convex", "A0", "A1", "A2", "A3", "A4"} - set(known)
    found = decide_on_box(c, missing, known, quick) if missing else {}
    known |= {id: answer for id, answer in found.items() if answer.verdict == HOLDS}
    if "A0" in known and known["A0"].where == ON_THE_BOX and not _has_no_hole(c):
        known.pop("A0")
    return {id: scaled_answer(answer, *c.scale) for id, answer in known.items()}


def _is_defined_for_all(c: Constraint) -> bool:
    """Whether no time and value of the parameters leaves g without a value."""
    form = c.shape.form
    if form is None:
        return is_defined_on_box(c.g, c.t, c.z, c.lower, c.upper)
    offsets = [offset_expression(a.offset) for a in (*affine_parts(form), *(clip.a for clip in c.shape.clips.values()))]
    return is_defined_on_box(ca.vertcat(*offsets), c.t, c.t, *c.slow)


SCALED_DOWN, SCALED_UP = ("a", "least"), ("b", "M", "M_contact")  # With c_0, and with c_1.


def scaled_answer(answer: HypothesisAnswer, low: float, high: float) -> HypothesisAnswer:
    """The answer of c g, low <= c <= high; what stays as it is are distances, and delta, which is that of g."""
    if low == high == 1.0:
        return answer
    value = {
        name: number * (low if name in SCALED_DOWN else high if name in SCALED_UP else 1.0)
        for name, number in answer.value.items()
    }
    value = {
        name: number / SUP_ROUNDING_FACTOR
        if name in SCALED_DOWN
        else number * SUP_ROUNDING_FACTOR
        if name in SCALED_UP
        else number
        for name, number in value.items()
    }
    return replace(answer, value=value)


def _unbounded_rate_answer(c: Constraint) -> HypothesisAnswer | None:
    """A2 where d_t g grows without bound towards a time: as powers of the distance from it, at an admissible state."""
    rate = ca.jacobian(c.g, c.t)
    t0, t1 = float(c.lower[0]), float(c.upper[0])
    inner = {float(value) for value in numeric_constants(c.g) if t0 < value < t1}
    h = RATE_PROBE_LENGTH * min(t1 - t0, 1.0)
    states = extremum.samples(c.lower[1:], c.upper[1:], MAX_RATE_STATES)
    for time, forward in [(t0, 1.0), (t1, -1.0), *((time, 1.0) for time in sorted(inner)[:MAX_RATE_STATES])]:
        for q in states:
            ends = np.append(time, q), np.append(time + forward * h, q)
            if not (interval_bounds.enclose(c.g, c.z, np.minimum(*ends), np.maximum(*ends))[0] >= 0).all():
                continue
            direction = np.append(forward, np.zeros(q.size))
            power = growth_exponent(rate, c.z, ends[0], direction, h)
            if power is not None:
                how = f"d_t g_i grows without bound at an admissible state, as |t - {time:.6g}|^({power}) does"
                return HypothesisAnswer(VIOLATED, {"b": np.inf}, EVERYWHERE, how, c.point(ends[0]))
    return None


def _require_finite_in_time(c: Constraint, known: AnswersById) -> AnswersById:
    """The answers; A2 does not hold of a constraint that has no finite value at some time."""
    middle = (c.lower[1:] + c.upper[1:]) / 2
    defined = (
        check_defined_in_time(c.g, c.t, float(c.lower[0]), float(c.upper[0]), c.q, middle)
        if c.shape.time
        else DefinednessResult(HOLDS, "")
    )
    if defined.verdict == HOLDS or (defined.verdict == UNKNOWN and known["A2"].verdict != HOLDS):
        return known
    value = {"b": np.inf} if defined.verdict == VIOLATED else {}
    how = f"g_i is not finite at all times: {defined.how}"
    return known | {"A2": HypothesisAnswer(defined.verdict, value, EVERYWHERE, how, {"constraint": c.name, "t": defined.at})}


def _time_jump_answer(c: Constraint) -> AnswersById:
    """A2 of a constraint that jumps in time, where d_t g says nothing."""
    if not c.shape.time or not jump_nodes(c.g, c.t) or interval_bounds.is_continuous(c.g, c.z, c.lower, c.upper):
        return {}
    jump = prove_jump(c.g, c.z, c.lower, c.upper)
    if jump is None:
        return {"A2": HypothesisAnswer(UNKNOWN, {}, ON_THE_BOX, "g_i was not proved continuous", {"constraint": c.name})}
    how = f"g_i jumps by at least {jump.size:.3g}: Q(t) is not Lipschitz in t"
    return {"A2": HypothesisAnswer(VIOLATED, {"b": np.inf}, ON_THE_BOX, how, c.point(jump.at))}


def _gradient_jump_answer(c: Constraint) -> AnswersById:
    """A3 of a constraint whose gradient may jump in time, where d_t grad g says nothing."""
    gradient = ca.gradient(c.g, c.q)
    nodes = [node for node in jump_nodes(gradient, c.t) if not ca.depends_on(node, c.q)] if c.shape.time else []
    if not nodes or interval_bounds.is_continuous(ca.vertcat(*nodes), c.t, c.lower[:1], c.upper[:1]):
        return {}
    jump = prove_jump(gradient, c.z, c.lower, c.upper, c.g)
    if jump is None:
        return {
            "A3": HypothesisAnswer(UNKNOWN, {}, ON_THE_BOX, "the gradient was not proved continuous in t", {"constraint": c.name})
        }
    how = f"the gradient jumps by at least {jump.size:.3g} at an admissible point"
    return {"A3": HypothesisAnswer(VIOLATED, {"M": np.inf}, ON_THE_BOX, how, c.point(jump.at))}


# -- planes ------------------------------------------------------------------------------------------------------------


def _plane_answers(c: Constraint) -> AnswersById:
    a: AffineForm = c.shape.written.affine
    size = sum((x * x for x in a.row.values()), Fraction(0))
    speed = supremum_over_time(c, ca.fabs(_offset_rate(c, a.offset)))
    text = "affine with a constant gradient: U_i is the whole space"
    if not size:
        A1 = HypothesisAnswer(VIOLATED, {"a": 0.0, "b": 0.0}, EVERYWHERE, "does not depend on the state", {"constraint": c.name})
    else:
        A1 = HypothesisAnswer(HOLDS, {"a": sqrt_below(size), "b": sqrt_above(size)}, EVERYWHERE, text)
    return {
        "S-convex": HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, "affine"),
        "A0": HypothesisAnswer(HOLDS, {"c": np.inf}, EVERYWHERE, text),
        "A1": A1,
        "A2": bound_answer("b", speed),
        "A3": HypothesisAnswer(HOLDS, {"M": 0.0}, EVERYWHERE, text),
        "A4": HypothesisAnswer(HOLDS, {"M": 0.0, "M_contact": 0.0}, EVERYWHERE, text),
    }


def _rotating_plane_answers(c: Constraint) -> AnswersById | None:
    """An affine function of the state whose gradient depends on time."""
    gradient = ca.gradient(c.g, c.q)
    if ca.depends_on(gradient, c.q) or jump_nodes(c.g, c.q) or not _is_defined_everywhere(c):
        return None
    size = ca.sumsqr(gradient)
    largest, least = supremum_over_time(c, size), supremum_over_time(c, -size)
    text = "affine, with a gradient that turns in time: U_i is the whole space"
    known = {
        "S-convex": HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, "affine"),
        "A0": HypothesisAnswer(HOLDS, {"c": np.inf}, EVERYWHERE, text),
        "A3": bound_answer("M", root_of_supremum(supremum_over_time(c, ca.sumsqr(c.rate(gradient))))),
        "A4": HypothesisAnswer(HOLDS, {"M": 0.0, "M_contact": 0.0}, EVERYWHERE, text),
    }
    if -least.bound > 0 and np.isfinite(largest.bound):
        known["A1"] = HypothesisAnswer(
            HOLDS,
            {"a": np.sqrt(-least.bound) / SUP_ROUNDING_FACTOR, "b": np.sqrt(largest.bound) * SUP_ROUNDING_FACTOR},
            EVERYWHERE,
            text,
        )
    return known


def _is_defined_everywhere(c: Constraint) -> bool:
    """Whether no state leaves g without a value; a constant gradient does not tell."""
    own = np.arange(c.lower.size) < c.t.numel()
    ends = np.where(own, c.lower, -np.inf), np.where(own, c.upper, np.inf)
    return is_defined_on_box(c.g, c.q, c.z, *ends)


def _has_no_hole(c: Constraint) -> bool:
    """Whether no point of the box leaves g without a value that the bounds of its gradient do not show."""
    return is_defined_on_box(c.g, c.q, c.z, c.lower, c.upper, bounded=ca.gradient(c.g, c.q))


# -- distances ---------------------------------------------------------------------------------------------------------


def _distance_answers(c: Constraint) -> AnswersById | None:
    """w |u| - r(t): u = A q - c(t), or the distance to a segment or a box, whose gradient is A'n with |n| = 1 too."""
    (weight, squares), moving = c.shape.written.norms[0], c.shape.written.affine.offset
    w, A = float(weight), _norm_matrix(c, squares)
    gram = A @ A.T
    diagonal = not (gram - np.diag(np.diag(gram))).any()
    sigma = np.sqrt(np.sort(np.diag(gram))[::-1]) if diagonal else np.linalg.svd(A, compute_uv=False)
    if len(A) > A.shape[1] or not sigma.size or sigma[-1] <= 1e-9 * sigma[0]:
        return {"S-convex": HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, "the norm of an affine function")}
    least_reach = supremum_over_time(c, offset_expression(moving))  # sup of -r
    reach = -least_reach.bound
    text = "distance" if c.shape.clips else "the norm of an affine function"
    taken = "; the rounded constants of its nearest point are taken as exact" if c.shape.rounded else ""
    known = {"S-convex": HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, f"{text} less a number{taken}")}
    if least_reach.value >= 0 and not c.has_parameters:
        t = float(np.ravel(not_none(least_reach.at))[0])
        return known | _zero_radius_answers(c, squares, t, -least_reach.value)
    if not reach > 0:
        return known
    a, b = _singular_value_bounds(weight, squares, None if diagonal else sigma)
    delta = reach / 2
    rates = [np.sqrt(float(v)) * _offset_rate(c, a.offset) for v, a in squares]
    speed = ca.norm_2(ca.vertcat(*rates)) if any(not r.is_zero() for r in rates) else ca.SX(0)
    centre = supremum_over_time(c, speed)
    # |u| >= (r - delta)/w on U_i, r/w on Q_i; the second derivative is w A'(I - nn')A / |u|. For one row it is 0, but Q_i has two
    # sides: from one to the other |v| - |u| - n(v - u) <= |v - u|^2 / (2 |u|), as for more rows.
    M, M_contact = (b * b / (reach - part) * (1 if diagonal else SUP_ROUNDING_FACTOR) for part in (delta, 0.0))
    turning = w * b / (reach - delta)
    how = f"{text}: the gradient is A'n with |n| = 1{taken}"
    clipped = ", a Lipschitz constant of the gradient (the Hessian jumps beyond the end points)" if c.shape.clips else ""
    return known | {
        "A0": HypothesisAnswer(HOLDS, {"c": delta / b, "delta": delta}, EVERYWHERE, "U_i = {g_i > -r/2}"),
        "A1": HypothesisAnswer(HOLDS, {"a": a, "b": b}, EVERYWHERE, how),
        "A2": bound_answer("b", supremum_over_time(c, w * speed + ca.fabs(_offset_rate(c, moving)))),
        "A3": bound_answer("M", centre, turning),
        "A4": HypothesisAnswer(HOLDS, {"M": M, "M_contact": M_contact}, EVERYWHERE, f"{text}: |A|^2 / distance{clipped}{taken}"),
    }


def _singular_value_bounds(weight: Fraction, squares: Squares, sigma: np.ndarray | None) -> tuple[float, float]:
    """Bounds of the singular values of w A: from those found, or from the rows, which are orthogonal where ``sigma`` is None."""
    if sigma is None:
        sizes = [
            w2 * sum((x * x for i, x in a.row.items() if i >= 0), Fraction(0))
            for w2, a in ((v * weight**2, a) for v, a in squares)
        ]
        return sqrt_below(min(sizes)), sqrt_above(max(sizes))
    margin = 1 + 64 * len(squares) * exact.MACHINE_EPSILON * float(sigma[0] / sigma[-1])  # More than an SVD errs by.
    return float(weight) * float(sigma[-1]) / margin, float(weight) * float(sigma[0]) * margin


def _zero_radius_answers(c: Constraint, squares: Squares, t: float, reach: float) -> AnswersById:
    """r <= 0: the point where u = 0, and g has no gradient, is admissible."""
    A = _norm_matrix(c, squares)
    offset = np.array([np.sqrt(float(v)) * _offset_value_at(c, a.offset, t) for v, a in squares])
    q = np.linalg.lstsq(A, -offset, rcond=None)[0]
    text = f"the distance need not be > 0 (r = {reach + 0.0:.6g}): where it is 0 g_i has no gradient, and that is admissible"
    found = not c.shape.clips and np.isclose(A @ q + offset, 0).all()
    witness: Mapping[str, Any] = c.point(np.append(t, q)) if found else {"constraint": c.name, "t": t, "reach": reach}
    return {
        id: HypothesisAnswer(VIOLATED, value, EVERYWHERE, text, witness)
        for id, value in (("A0", {"c": 0.0}), ("A1", {"a": 0.0}), ("A4", {"M": np.inf, "M_contact": np.inf}))
    } | {
        "A3": HypothesisAnswer(VIOLATED, {"M": np.inf}, EVERYWHERE, text, witness) if c.shape.time else time_invariant_answer("M")
    }


def _norm_matrix(c: Constraint, squares: Squares) -> np.ndarray:
    """A (m, k) in the constraint's own states."""
    place = {i: k for k, i in enumerate(c.shape.own)}
    A = np.zeros((len(squares), len(place)))
    for row, (w, a) in enumerate(squares):
        for i, value in a.row.items():
            if i >= 0:
                A[row, place[i]] = np.sqrt(float(w)) * float(value)
    return A


# -- quadratics --------------------------------------------------------------------------------------------------------


def _quadratic_answers(c: Constraint) -> AnswersById:
    """q'Hq/2 + b(t)'q + c(t) with a constant H, rational."""
    H_exact = form_hessian(c.shape.written)
    sign, H = exact.definiteness(H_exact), exact.doubles(H_exact)
    values = np.linalg.eigvalsh(H)
    slack = 16 * len(H) * exact.MACHINE_EPSILON * float(np.linalg.norm(H))  # More than eigenvalues in doubles err by.
    spectral = float(np.abs(values).max()) + slack
    known = {"A4": HypothesisAnswer(HOLDS, {"M": spectral, "M_contact": spectral}, EVERYWHERE, "the Hessian is constant")}
    if sign.vector is not None:
        v = np.linalg.eigh(H)[1][:, 0] if values[0] < 0 else sign.vector / np.linalg.norm(sign.vector)
        witness = {"constraint": c.name, "states": list(c.names), "eigenvector": v}
        how = "the constant Hessian has a negative eigenvalue (exact)"
        return (
            known
            | {"S-convex": HypothesisAnswer(VIOLATED, {"least": min(float(values[0]), 0.0)}, EVERYWHERE, how, witness)}
            | _stationary_point_answers(c, H)
        )
    values = np.maximum(values - slack, 0.0)
    least = float(values[0]) if sign.definite else 0.0
    known["S-convex"] = HypothesisAnswer(HOLDS, {"least": max(least, 0.0)}, EVERYWHERE, "the constant Hessian is psd (exact)")
    gradient = ca.gradient(c.g, c.q)
    turn = c.rate(gradient)
    if not ca.depends_on(turn, c.q):
        known["A3"] = bound_answer("M", root_of_supremum(supremum_over_time(c, ca.sumsqr(turn))))
    if sign.definite and values[0] > 1e-9 * spectral:
        known |= _definite_quadratic_answers(c, H, np.append(values[:-1], spectral), gradient)
    return known


def _definite_quadratic_answers(c: Constraint, H: np.ndarray, values: np.ndarray, gradient: ca.SX) -> AnswersById:
    """H > 0: with m(t) = min g, 2 lambda_1 (g - m) <= |grad g|^2 <= 2 lambda_n (g - m), so -m/2 is a good delta.

    m(t) = g(t, y) - b'H^-1 b / 2 with b the gradient at any y; far from the minimum these two cancel, so y is near to it.
    """
    slope = ca.Function("slope", [c.t, c.q], [gradient])

    def minimum(t: np.ndarray) -> np.ndarray:
        q = np.zeros(len(H))
        for _ in range(3):
            q = q - np.linalg.solve(H, np.array(slope(t, q)).ravel())
        return q

    low, high = c.slow
    y = ca.DM(minimum((low + high) / 2))
    b, c0 = (ca.substitute(expr, c.q, y) for expr in (gradient, c.g))
    # The inverse is rounded by less than 1e-6, as H is not worse conditioned than 1e9.
    bottom, lowest = (c0 - factor * ca.dot(b, ca.DM(np.linalg.inv(H)) @ b) / 2 for factor in (1 - 1e-6, 1 + 1e-6))
    above = supremum_over_time(c, bottom)  # sup of m
    if above.value >= 0:
        t = np.ravel(not_none(above.at))
        if float(interval_bounds.enclose(lowest, c.t, t, t)[0].item()) >= 0:
            return vanishing_gradient_answers(
                c, np.append(t, minimum(t)), "the gradient vanishes at its minimum, which is admissible"
            )
        return {}
    if not above.bound < 0:
        return {}
    deepest = supremum_over_time(c, -lowest)
    delta = -above.bound / 2
    a = np.sqrt(2 * values[0] * delta) / SUP_ROUNDING_FACTOR
    known = {"A0": HypothesisAnswer(UNKNOWN)} if not np.isfinite(deepest.bound) else {
        "A0": HypothesisAnswer(
            HOLDS, {"c": delta / np.sqrt(2 * values[-1] * deepest.bound) / SUP_ROUNDING_FACTOR, "delta": delta}, EVERYWHERE,
            "|grad g|^2 <= 2 lambda_n (g - min g) between Q_i and the boundary of U_i = {g_i > min g_i / 2}",
        ),
    }  # fmt: skip
    largest = extremum.supremum(ca.sumsqr(gradient), c.z, c.lower, c.upper)
    if np.isfinite(largest.bound):
        how = "|grad g|^2 >= 2 lambda_1 (g - min g) everywhere; b on the box: it grows with the distance"
        known["A1"] = HypothesisAnswer(HOLDS, {"a": a, "b": np.sqrt(largest.bound) * SUP_ROUNDING_FACTOR}, ON_THE_BOX, how)
    return known


def _stationary_point_answers(c: Constraint, H: np.ndarray) -> AnswersById:
    """Where a quadratic that is not convex is admissible at its stationary point, the gradient vanishes there."""
    f = ca.Function("g", [c.t, c.q], [ca.gradient(c.g, c.q), c.g])
    for t in () if c.has_parameters else np.linspace(c.lower[0], c.upper[0], 33):
        b = np.array(f(t, np.zeros(len(H)))[0]).ravel()
        q = np.linalg.lstsq(H, -b, rcond=None)[0]
        gradient, value = (np.array(item).ravel() for item in f(t, q))
        near = np.linalg.norm(gradient) <= 1e-9 * (np.linalg.norm(b) + np.linalg.norm(H)) and value[0] >= 0
        if near and (still := stationary_point(c, np.append(t, q))) is not None:
            return vanishing_gradient_answers(c, still[0], f"the gradient vanishes at an admissible point: {still[1]}")
    return {}


# -- small things ------------------------------------------------------------------------------------------------------


def _offset_rate(c: Constraint, offset: Offset) -> ca.SX:
    return ca.SX(0) if isinstance(offset, Fraction) else c.rate(offset)


def _offset_value_at(c: Constraint, offset: Offset, t: float) -> float:
    return float(offset) if isinstance(offset, Fraction) else float(ca.Function("o", [c.t], [offset])(t))
