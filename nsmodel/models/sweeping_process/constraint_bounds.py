"""S-convex and A0 to A4 of a constraint of no known shape, by bounds over the box and U_i = {g_i > -delta}.

One constraint of a sweeping process, and what it answers to one hypothesis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds
from nsmodel.models.sweeping_process.constraint_shapes import ConstraintShape
from nsmodel.proof import extremum, interval_bounds, polynomial, sum_of_squares
from nsmodel.proof.convex import rules
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.proof.jumps import jump_nodes, prove_jump
from nsmodel.proof.krawczyk import enclose_zero

SUP_ROUNDING_FACTOR = 1 + 1e-14  # 45 EPS: more than what a root and a few products lose.
EVERYWHERE, ON_THE_BOX = "everywhere", "on the box"


@dataclass(frozen=True, eq=False)
class Constraint:
    """One constraint in its own states.

    Attributes:
        name: the user's.
        g: SX, a function of t and q.
        shape: what it is made of.
        t: SX symbol, or (t, p) with parameters of which all values in a box are meant, and (t, p, u') where some are inputs;
            q: SX (k, 1), its own states.
        names: of these states.
        lower, upper: (1 + k,) bounds of (t, q).
        motion: the inputs among p.
        scale: bounds of what the user's constraint is divided by to be this one, a function of parameters, > 0.
    """

    name: str
    g: ca.SX
    shape: ConstraintShape
    t: ca.SX
    q: ca.SX
    names: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    motion: InputBounds = NO_INPUT_BOUNDS
    scale: tuple[float, float] = (1.0, 1.0)

    def rate(self, expression: ca.SX) -> ca.SX:
        """The derivative of a column by time, along the inputs."""
        return self.motion.velocity(expression, self.t[0])

    @property
    def z(self) -> ca.SX:
        """The symbols (t, q) in one column."""
        return ca.vertcat(self.t, self.q)

    @property
    def slow(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of t, or of (t, p)."""
        return self.lower[: self.t.numel()], self.upper[: self.t.numel()]

    @property
    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """The part of the box that is of the states q."""
        return self.lower[self.t.numel() :], self.upper[self.t.numel() :]

    @property
    def has_parameters(self) -> bool:
        """Whether all values of parameters in a box are meant."""
        return self.t.numel() > 1

    def point(self, z: np.ndarray) -> dict[str, Any]:
        """The witness of a point (t, q)."""
        states = dict(zip(self.names, z[self.t.numel() :], strict=True))
        return {"constraint": self.name} | ({"t": z[0]} if self.shape.time else {}) | states


@dataclass(frozen=True)
class HypothesisAnswer:
    """What one constraint says to one hypothesis: a verdict, numbers, where they are true, how that was found, a witness."""

    verdict: str
    value: Mapping[str, float] = field(default_factory=dict)
    where: str = EVERYWHERE
    how: str = ""
    witness: Mapping[str, Any] = field(default_factory=dict)


AnswersById = dict[str, HypothesisAnswer]


@dataclass(frozen=True)
class TimeSupremum:
    """A supremum in the shape of :class:`extremum.Supremum`: a number, or the root of one."""

    value: float
    bound: float
    at: np.ndarray | None = None
    count: int = 1


def supremum_over_time(c: Constraint, expr: ca.SX) -> TimeSupremum:
    """Return the supremum over [t0, t1] of an expression of time alone, or of time and parameters over their box."""
    start, end = c.slow
    if expr.is_constant():
        return TimeSupremum(float(expr), float(expr), start)
    if not ca.depends_on(expr, c.t):
        low, high = (float(end.item()) for end in interval_bounds.enclose(expr, c.t, start, start))
        return TimeSupremum(low, high, start)
    top = extremum.supremum(expr, c.t, start, end)
    return TimeSupremum(top.value, top.bound, top.at, top.count)


def root_of_supremum(top: Any) -> TimeSupremum:
    """Return the supremum of the root."""
    return TimeSupremum(np.sqrt(max(top.value, 0.0)), np.sqrt(max(top.bound, 0.0)) * SUP_ROUNDING_FACTOR, top.at, top.count)


def bound_answer(name: str, top: Any, factor: float = 1.0) -> HypothesisAnswer:
    """Return ``factor`` times a supremum over time as an answer: 0 and proved where the factor is 0."""
    if factor == 0 or top.bound == 0:
        return time_invariant_answer(name)
    if np.isfinite(top.bound):
        return HypothesisAnswer(
            HOLDS, {name: factor * top.bound * SUP_ROUNDING_FACTOR}, EVERYWHERE, "bounded over the interval of time"
        )
    t = {"t": float(np.ravel(top.at)[0])} if top.at is not None else {}
    return HypothesisAnswer(
        SAMPLED, {name: factor * top.value}, EVERYWHERE, f"no bound over time was found; {top.count} points", t
    )


def time_invariant_answer(name: str) -> HypothesisAnswer:
    """The answer of what does not change with time."""
    return HypothesisAnswer(HOLDS, {name: 0.0}, EVERYWHERE, "it does not change with time")


def stationary_point(c: Constraint, z: np.ndarray) -> tuple[np.ndarray, str] | None:
    """Return a point (t, q) near z where the gradient by q is 0 and g >= 0, both proved, with how; None where there is none."""
    if c.has_parameters:
        return None
    gradient = ca.gradient(c.g, c.q)
    both = ca.vertcat(c.g, gradient)
    for digits in (17, 12, 9, 6, 4, 2, 1):
        point = np.array([z[0], *(round(float(x), digits) for x in z[1:])])
        low, high = (end.ravel() for end in interval_bounds.enclose(both, c.z, point, point))
        if low[0] >= 0 and not (low[1:].any() or high[1:].any()):
            return point, "by interval arithmetic"
    width = np.where(c.upper[1:] > c.lower[1:], (c.upper - c.lower)[1:], 1.0)
    zero = enclose_zero(ca.substitute(gradient, c.t, float(z[0])), c.q, np.asarray(z[1:], float), width)
    if zero is None:
        return None
    lower, upper = np.append(z[0], zero.lower), np.append(z[0], zero.upper)
    admissible = float(interval_bounds.enclose(c.g, c.z, lower, upper)[0].item()) >= 0
    return ((lower + upper) / 2, "an interval Newton step proves it near the one shown") if admissible else None


def vanishing_gradient_answers(c: Constraint, z: np.ndarray, how: str) -> AnswersById:
    """The answers where the gradient vanishes at an admissible point."""
    witness = c.point(z)
    return {
        "A0": HypothesisAnswer(VIOLATED, {"c": 0.0}, EVERYWHERE, f"no U_i has A1: {how}", witness),
        "A1": HypothesisAnswer(VIOLATED, {"a": 0.0}, EVERYWHERE, how, witness),
    }


def constraint_values(c: Constraint, points: np.ndarray) -> np.ndarray:
    """Return g at points (count, 1 + k), or at one."""
    rows = np.atleast_2d(points)
    g = np.array(ca.Function("g", [c.z], [c.g])(rows.T)).ravel()
    return g if np.ndim(points) > 1 else g[0]


# Sums of squares are looked for in Hessians of polynomials up to this degree: their Gram matrices grow with it.
MAX_SOS_DEGREE = 8
# Where a gradient is this much shorter than the longest one a point is looked for where it vanishes, which is proved or not.
FLAT_GRADIENT_RATIO = 1e-6


def decide_on_box(c: Constraint, missing: set[str], known: AnswersById, quick: bool) -> AnswersById:
    """Decide what is missing by bounds over the box, intersected with U_i = {g_i > -delta}."""
    found: AnswersById = {}
    gradient = ca.gradient(c.g, c.q)
    H = ca.jacobian(gradient, c.q)
    if "S-convex" in missing:
        found["S-convex"] = _convexity_answer(c, H, quick)
    if "A2" in missing:
        speed = ca.fabs(c.rate(c.g))
        found["A2"] = _box_bound_answer("b", extremum.supremum(speed, c.z, c.lower, c.upper, quick=quick))
    if not {"A0", "A1", "A3", "A4"} & missing:
        return found
    lowest = extremum.supremum(-c.g, c.z, c.lower, c.upper, quick=True)
    delta = known["A0"].value.get("delta") if "A0" in known else None
    if delta is None:
        delta = _choose_delta(c, gradient, lowest)
    where = c.g + delta if np.isfinite(delta) else None
    smooth, broken = _find_gradient_jump(c, gradient, delta)
    if broken is not None:
        return found | {id: broken for id in ("A0", "A1", "A3", "A4") if id in missing}
    turn = c.rate(gradient)
    if "A3" in missing:
        found["A3"] = _box_bound_answer("M", root_of_supremum(_sup(c, ca.sumsqr(turn), where, quick)))
    if "A4" in missing:
        found["A4"] = _curvature_answer(c, H, where, quick, smooth)
    if {"A0", "A1"} & missing:
        found |= _gradient_bound_answers(c, gradient, where, delta, lowest, quick, found.get("S-convex", known.get("S-convex")))
    return {id: answer for id, answer in found.items() if id in missing}


def _choose_delta(c: Constraint, gradient: ca.SX, lowest: Any) -> float:
    """delta: half the depth of g on the box, less where the gradient vanishes nearer to 0; inf where g > 0 on the whole box."""
    delta = lowest.value / 2 if lowest.value > 0 else np.inf
    size = ca.sumsqr(gradient)
    largest = extremum.supremum(size, c.z, c.lower, c.upper, quick=True)
    for _ in range(3 if np.isfinite(delta) and not c.shape.convex else 0):
        least = extremum.supremum(-size, c.z, c.lower, c.upper, where=c.g + delta)
        if least.at is None or -least.value > FLAT_GRADIENT_RATIO**2 * largest.value or constraint_values(c, least.at) >= 0:
            break
        delta = -0.5 * float(constraint_values(c, least.at))
    return delta


def _sup(c: Constraint, expr: ca.SX, where: ca.SX | None, quick: bool, bound_to: float | None = None) -> Any:
    return extremum.supremum(expr, c.z, c.lower, c.upper, where=where, quick=quick, bound_to=bound_to)


def _curvature_answer(c: Constraint, H: ca.SX, where: ca.SX | None, quick: bool, smooth: bool) -> HypothesisAnswer:
    wide = extremum.spectral_norm(H, c.z, c.lower, c.upper, where=where, quick=quick)
    near = extremum.spectral_norm(H, c.z, c.lower, c.upper, where=c.g, quick=quick)
    proved = smooth and wide.bound < np.inf
    value = {name: max(top.bound if top.bound < np.inf else top.value, 0.0) for name, top in (("M", wide), ("M_contact", near))}
    how = _bound_description(proved, wide) if smooth else f"the gradient was not proved continuous; {wide.count} points"
    return HypothesisAnswer(HOLDS if proved else SAMPLED, value, ON_THE_BOX, how, c.point(wide.at) if wide.at is not None else {})


def _gradient_bound_answers(
    c: Constraint, gradient: ca.SX, where: ca.SX | None, delta: float, lowest: Any, quick: bool, convex: HypothesisAnswer | None
) -> AnswersById:
    """A1 and A0: the least and the largest gradient on U_i."""
    size = ca.sumsqr(gradient)
    largest, least = _sup(c, size, where, quick), _sup(c, -size, where, quick)
    b = np.sqrt(largest.bound if np.isfinite(largest.bound) else max(largest.value, 0.0)) * SUP_ROUNDING_FACTOR
    attained = np.sqrt(max(-least.value, 0.0)) if np.isfinite(least.value) else np.inf
    proved_a = np.sqrt(max(-least.bound, 0.0)) / SUP_ROUNDING_FACTOR
    if convex is not None and convex.verdict == HOLDS and np.isfinite(delta):
        proved_a = max(proved_a, _gradient_bound_by_convexity(c, lowest, delta))
    if attained <= FLAT_GRADIENT_RATIO * b and least.at is not None and (still := stationary_point(c, least.at)) is not None:
        return vanishing_gradient_answers(c, still[0], f"the gradient vanishes at an admissible point: {still[1]}")
    proved = proved_a > 0 and np.isfinite(largest.bound)
    verdict, a = (HOLDS, proved_a) if proved else (SAMPLED, attained)
    how = _bound_description(proved, least)
    if np.isfinite(delta):
        A0 = HypothesisAnswer(
            verdict,
            {"c": delta / b / SUP_ROUNDING_FACTOR, "delta": delta},
            ON_THE_BOX,
            f"U_i = {{g_i > -{delta:.6g}}}, half the depth of g_i; " + how,
        )
    else:
        A0 = HypothesisAnswer(verdict, {"c": np.inf}, ON_THE_BOX, "g_i > 0 on the whole box: U_i is all of it")
    witness = c.point(least.at) if least.at is not None else {"constraint": c.name}
    return {"A1": HypothesisAnswer(verdict, {"a": a, "b": b}, ON_THE_BOX, how, witness), "A0": A0}


def _gradient_bound_by_convexity(c: Constraint, lowest: Any, delta: float) -> float:
    """For convex g and a point q* with g(t, q*) <= -m, m > delta: |grad g| >= (m - delta) / |q - q*| on U_i."""
    q, (low, high) = np.asarray(lowest.at)[c.t.numel() :], c.states
    over = supremum_over_time(c, ca.substitute(c.g, c.q, ca.DM(q)))
    reach = float(np.linalg.norm(np.maximum(np.abs(low - q), np.abs(high - q))))
    return max((-over.bound - delta) / reach / SUP_ROUNDING_FACTOR - 1e-15 * delta / reach, 0.0)


def _find_gradient_jump(c: Constraint, gradient: ca.SX, delta: float) -> tuple[bool, HypothesisAnswer | None]:
    """(whether g is proved C1 on the box as far as its operations can jump, an answer where it is seen not to be on U_i)."""
    both = ca.vertcat(c.g, gradient)
    if not jump_nodes(both, c.q) or interval_bounds.is_continuous(both, c.z, c.lower, c.upper):
        return True, None
    floor = -delta if np.isfinite(delta) else -np.inf
    jump = prove_jump(both, c.z, c.lower, c.upper, c.g)
    if jump is None:
        jump = prove_jump(both, c.z, c.lower, c.upper, c.g - floor if np.isfinite(floor) else None)
    if jump is None:
        return False, None
    inside = "at an admissible point" if constraint_values(c, jump.at) >= 0 else "in U_i"
    how = f"g_i or its gradient jumps by at least {jump.size:.3g} {inside}: g_i is not C^2 there"
    return False, HypothesisAnswer(VIOLATED, {"jump": jump.size}, ON_THE_BOX, how, c.point(jump.at))


def _convexity_answer(c: Constraint, H: ca.SX, quick: bool) -> HypothesisAnswer:
    """Convex in q: by the rules of convex functions, else by the least eigenvalue of the Hessian over the box."""
    if c.shape.convex:
        return HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, "a sum of convex terms")
    if not ca.depends_on(c.g, c.t):
        if rules.global_curvatures(c.g, c.q)[0].convex:
            return HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, "by the rules of convex functions")
        if rules.curvatures(c.g, c.q, *c.states)[0].convex:
            return HypothesisAnswer(HOLDS, {"least": 0.0}, ON_THE_BOX, "by the rules of convex functions")
    elif rules.curvatures(c.g, c.z, c.lower, c.upper)[0].convex:
        return HypothesisAnswer(HOLDS, {"least": 0.0}, ON_THE_BOX, "by the rules of convex functions")
    if _hessian_is_sos(c):
        how = "D2g is a sum of squares (exact)" + ("" if not c.shape.time else ", at every time")
        return HypothesisAnswer(HOLDS, {"least": 0.0}, EVERYWHERE, how)
    bent = None if c.has_parameters else _chord_violation(c)
    top = extremum.largest_eigenvalue(-H, c.z, c.lower, c.upper, quick=quick, bound_to=0.0)
    if top.at is not None and np.isfinite(top.value) and not jump_nodes(c.g, c.q):
        matrix = np.array(ca.Function("H", [c.z], [ca.densify(H)])(top.at))
        v = np.linalg.eigh((matrix + matrix.T) / 2)[1][:, 0]
        high = float(interval_bounds.enclose(ca.bilin(H, ca.DM(v), ca.DM(v)), c.z, top.at, top.at)[1].item())
        if high < 0:
            witness = c.point(top.at) | {"states": list(c.names), "eigenvector": v}
            how = "the Hessian has a negative eigenvalue (by interval arithmetic)"
            return HypothesisAnswer(VIOLATED, {"least": high / float(v @ v) * (1 - 1e-14)}, ON_THE_BOX, how, witness)
    if bent is not None:
        return bent
    both = ca.vertcat(c.g, ca.gradient(c.g, c.q))
    smooth = not jump_nodes(both, c.q) or interval_bounds.is_continuous(both, c.z, c.lower, c.upper)
    if top.bound <= 0 and smooth and is_defined_on_box(c.g, c.q, c.z, c.lower, c.upper, bounded=H):
        return HypothesisAnswer(
            HOLDS, {"least": -top.bound}, ON_THE_BOX, "the least eigenvalue of the Hessian is bounded below by 0"
        )
    return HypothesisAnswer(
        SAMPLED, {"least": -top.value}, ON_THE_BOX, f"{top.count} points, 1024 chords", {"constraint": c.name}
    )


def _hessian_is_sos(c: Constraint) -> bool:
    """Whether g is a polynomial in q and y'D2g y a sum of squares; t and parameters enter terms that are affine in q alone."""
    (p,) = polynomial.read_polynomials(c.g, c.z)
    n = c.q.numel()
    if p is None:
        return False
    slow = c.t.numel()
    bending = {monomial: number for monomial, number in p.items() if sum(power for v, power in monomial if v >= slow) > 1}
    if any(v < slow for monomial in bending for v, _ in monomial):
        return False
    shifted = {tuple((v - slow, power) for v, power in monomial): number for monomial, number in bending.items()}
    return polynomial.degree(shifted) <= MAX_SOS_DEGREE and sum_of_squares.is_sos_convex(shifted, n)


def _chord_violation(c: Constraint) -> HypothesisAnswer | None:
    """A violation where g in the middle of a chord lies above the mean of its ends, rounding included."""
    points = extremum.samples(np.tile(c.lower, 2), np.tile(c.upper, 2), 1024)
    x, y = np.split(points, 2, axis=1)
    y[:, 0] = x[:, 0]  # At one time.
    ends, middle = [constraint_values(c, part) for part in (x, y)], constraint_values(c, (x + y) / 2)
    with np.errstate(all="ignore"):
        rise = middle - (ends[0] + ends[1]) / 2
        order = np.argsort(-np.where(np.isfinite(rise), rise, -np.inf), kind="stable")[:4]
    for k in order[rise[order] > 0]:
        half = (x[k] + y[k]) / 2
        below, above = np.nextafter(half, -np.inf), np.nextafter(half, np.inf)
        below[0] = above[0] = x[k, 0]
        low = float(interval_bounds.enclose(c.g, c.z, below, above)[0].item())
        high = [float(interval_bounds.enclose(c.g, c.z, end, end)[1].item()) for end in (x[k], y[k])]
        over = low - (high[0] + high[1]) / 2 - 1e-15 * (abs(low) + abs(high[0]) + abs(high[1]))
        if np.isfinite(over) and over > 0:
            witness = c.point(half) | {"states": list(c.names), "from": x[k, 1:], "to": y[k, 1:]}
            how = f"in the middle of a chord g_i is at least {over:.3g} above the mean of its ends"
            return HypothesisAnswer(
                VIOLATED, {"least": -8 * over / float(np.sum((x[k, 1:] - y[k, 1:]) ** 2))}, ON_THE_BOX, how, witness
            )
    return None


def _box_bound_answer(name: str, top: Any) -> HypothesisAnswer:
    proved = np.isfinite(top.bound)
    return HypothesisAnswer(
        HOLDS if proved else SAMPLED, {name: top.bound if proved else top.value}, ON_THE_BOX, _bound_description(proved, top)
    )


def _bound_description(proved: bool, top: Any) -> str:
    return "a bound over the whole box" if proved else f"no bound was found; {top.count} points"
