"""S-convex and A0 to A4 of a constraint of no known shape, by bounds over the box and U_i = {g_i > -delta}."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.constraint import (
    EVERYWHERE,
    ON_THE_BOX,
    UP,
    Answer,
    Answers,
    Constraint,
    flat,
    over_time,
    root,
    stationary,
    values,
)
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED
from nsmodel.proof import extremum, interval, polynomial, sum_of_squares
from nsmodel.proof.convex import convexity
from nsmodel.proof.discontinuity import proved_jump
from nsmodel.proof.jumps import jumps_in

DEGREE = 8  # Sums of squares are looked for in Hessians of polynomials up to this degree.
FLAT = 1e-6  # Where a gradient is this much shorter than the longest one a point is looked for where it vanishes.


def on_the_box(c: Constraint, missing: set[str], known: Answers, quick: bool) -> Answers:
    """Decide what is missing by bounds over the box, intersected with U_i = {g_i > -delta}."""
    found: Answers = {}
    gradient = ca.gradient(c.g, c.q)
    H = ca.jacobian(gradient, c.q)
    if "S-convex" in missing:
        found["S-convex"] = _convex(c, H, quick)
    if "A2" in missing:
        speed = ca.fabs(ca.jacobian(c.g, c.t))
        found["A2"] = _on_box("b", extremum.supremum(speed, c.z, c.lower, c.upper, quick=quick))
    if not {"A0", "A1", "A3", "A4"} & missing:
        return found
    lowest = extremum.supremum(-c.g, c.z, c.lower, c.upper, quick=True)
    delta = known["A0"].value.get("delta") if "A0" in known else None
    if delta is None:
        delta = _depth(c, gradient, lowest)
    where = c.g + delta if np.isfinite(delta) else None
    smooth, broken = _kink(c, gradient, delta)
    if broken is not None:
        return found | {id: broken for id in ("A0", "A1", "A3", "A4") if id in missing}
    turn = ca.jacobian(gradient, c.t)
    if "A3" in missing:
        found["A3"] = _on_box("M", root(_sup(c, ca.sumsqr(turn), where, quick)))
    if "A4" in missing:
        found["A4"] = _curvature(c, H, where, quick, smooth)
    if {"A0", "A1"} & missing:
        found |= _slope(c, gradient, where, delta, lowest, quick, found.get("S-convex", known.get("S-convex")))
    return {id: answer for id, answer in found.items() if id in missing}


def _depth(c: Constraint, gradient: ca.SX, lowest: Any) -> float:
    """delta: half the depth of g on the box, less where the gradient vanishes nearer to 0; inf where g > 0 on the whole box."""
    delta = lowest.value / 2 if lowest.value > 0 else np.inf
    size = ca.sumsqr(gradient)
    largest = extremum.supremum(size, c.z, c.lower, c.upper, quick=True)
    for _ in range(3 if np.isfinite(delta) and not c.shape.convex else 0):
        least = extremum.supremum(-size, c.z, c.lower, c.upper, where=c.g + delta)
        if least.at is None or -least.value > FLAT**2 * largest.value or values(c, least.at) >= 0:
            break
        delta = -0.5 * float(values(c, least.at))
    return delta


def _sup(c: Constraint, expr: ca.SX, where: ca.SX | None, quick: bool, bound_to: float | None = None) -> Any:
    return extremum.supremum(expr, c.z, c.lower, c.upper, where=where, quick=quick, bound_to=bound_to)


def _curvature(c: Constraint, H: ca.SX, where: ca.SX | None, quick: bool, smooth: bool) -> Answer:
    wide = extremum.spectral_norm(H, c.z, c.lower, c.upper, where=where, quick=quick)
    near = extremum.spectral_norm(H, c.z, c.lower, c.upper, where=c.g, quick=quick)
    proved = smooth and wide.bound < np.inf
    value = {name: max(top.bound if top.bound < np.inf else top.value, 0.0) for name, top in (("M", wide), ("M_contact", near))}
    how = _found(proved, wide) if smooth else f"the gradient was not proved continuous; {wide.count} points"
    return Answer(HOLDS if proved else SAMPLED, value, ON_THE_BOX, how, c.point(wide.at) if wide.at is not None else {})


def _slope(
    c: Constraint, gradient: ca.SX, where: ca.SX | None, delta: float, lowest: Any, quick: bool, convex: Answer | None
) -> Answers:
    """A1 and A0: the least and the largest gradient on U_i."""
    size = ca.sumsqr(gradient)
    largest, least = _sup(c, size, where, quick), _sup(c, -size, where, quick)
    b = np.sqrt(largest.bound if np.isfinite(largest.bound) else max(largest.value, 0.0)) * UP
    attained = np.sqrt(max(-least.value, 0.0)) if np.isfinite(least.value) else np.inf
    proved_a = np.sqrt(max(-least.bound, 0.0)) / UP
    if convex is not None and convex.verdict == HOLDS and np.isfinite(delta):
        proved_a = max(proved_a, _by_convexity(c, lowest, delta))
    if attained <= FLAT * b and least.at is not None and (still := stationary(c, least.at)) is not None:
        return flat(c, still[0], f"the gradient vanishes at an admissible point: {still[1]}")
    proved = proved_a > 0 and np.isfinite(largest.bound)
    verdict, a = (HOLDS, proved_a) if proved else (SAMPLED, attained)
    how = _found(proved, least)
    if np.isfinite(delta):
        A0 = Answer(
            verdict,
            {"c": delta / b / UP, "delta": delta},
            ON_THE_BOX,
            f"U_i = {{g_i > -{delta:.6g}}}, half the depth of g_i; " + how,
        )
    else:
        A0 = Answer(verdict, {"c": np.inf}, ON_THE_BOX, "g_i > 0 on the whole box: U_i is all of it")
    witness = c.point(least.at) if least.at is not None else {"constraint": c.name}
    return {"A1": Answer(verdict, {"a": a, "b": b}, ON_THE_BOX, how, witness), "A0": A0}


def _by_convexity(c: Constraint, lowest: Any, delta: float) -> float:
    """For convex g and a point q* with g(t, q*) <= -m, m > delta: |grad g| >= (m - delta) / |q - q*| on U_i."""
    q = np.asarray(lowest.at)[1:]
    over = over_time(c, ca.substitute(c.g, c.q, ca.DM(q)))
    reach = float(np.linalg.norm(np.maximum(np.abs(c.lower[1:] - q), np.abs(c.upper[1:] - q))))
    return max((-over.bound - delta) / reach / UP - 1e-15 * delta / reach, 0.0)


def _kink(c: Constraint, gradient: ca.SX, delta: float) -> tuple[bool, Answer | None]:
    """(whether g is proved C1 on the box as far as its operations can jump, an answer where it is seen not to be on U_i)."""
    both = ca.vertcat(c.g, gradient)
    if not jumps_in(both, c.q) or interval.is_continuous(both, c.z, c.lower, c.upper):
        return True, None
    floor = -delta if np.isfinite(delta) else -np.inf
    jump = proved_jump(both, c.z, c.lower, c.upper, c.g)
    if jump is None:
        jump = proved_jump(both, c.z, c.lower, c.upper, c.g - floor if np.isfinite(floor) else None)
    if jump is None:
        return False, None
    inside = "at an admissible point" if values(c, jump.at) >= 0 else "in U_i"
    how = f"g_i or its gradient jumps by at least {jump.size:.3g} {inside}: g_i is not C^2 there"
    return False, Answer(VIOLATED, {"jump": jump.size}, ON_THE_BOX, how, c.point(jump.at))


def _convex(c: Constraint, H: ca.SX, quick: bool) -> Answer:
    """Convex in q: by the rules of convex functions, else by the least eigenvalue of the Hessian over the box."""
    if c.shape.convex:
        return Answer(HOLDS, {"least": 0.0}, EVERYWHERE, "a sum of convex terms")
    if not c.shape.time:
        if convexity.everywhere(c.g, c.q)[0].convex:
            return Answer(HOLDS, {"least": 0.0}, EVERYWHERE, "by the rules of convex functions")
        if convexity.shapes(c.g, c.q, c.lower[1:], c.upper[1:])[0].convex:
            return Answer(HOLDS, {"least": 0.0}, ON_THE_BOX, "by the rules of convex functions")
    elif convexity.shapes(c.g, c.z, c.lower, c.upper)[0].convex:
        return Answer(HOLDS, {"least": 0.0}, ON_THE_BOX, "by the rules of convex functions")
    if _squares(c):
        how = "D2g is a sum of squares (exact)" + ("" if not c.shape.time else ", at every time")
        return Answer(HOLDS, {"least": 0.0}, EVERYWHERE, how)
    bent = _chord(c)
    top = extremum.largest_eigenvalue(-H, c.z, c.lower, c.upper, quick=quick, bound_to=0.0)
    if top.at is not None and np.isfinite(top.value) and not jumps_in(c.g, c.q):
        matrix = np.array(ca.Function("H", [c.z], [ca.densify(H)])(top.at))
        v = np.linalg.eigh((matrix + matrix.T) / 2)[1][:, 0]
        high = float(interval.enclose(ca.bilin(H, ca.DM(v), ca.DM(v)), c.z, top.at, top.at)[1].item())
        if high < 0:
            witness = c.point(top.at) | {"states": list(c.names), "eigenvector": v}
            how = "the Hessian has a negative eigenvalue (by interval arithmetic)"
            return Answer(VIOLATED, {"least": high / float(v @ v) * (1 - 1e-14)}, ON_THE_BOX, how, witness)
    if bent is not None:
        return bent
    both = ca.vertcat(c.g, ca.gradient(c.g, c.q))
    if top.bound <= 0 and (not jumps_in(both, c.q) or interval.is_continuous(both, c.z, c.lower, c.upper)):
        return Answer(HOLDS, {"least": -top.bound}, ON_THE_BOX, "the least eigenvalue of the Hessian is bounded below by 0")
    return Answer(SAMPLED, {"least": -top.value}, ON_THE_BOX, f"{top.count} points, 1024 chords", {"constraint": c.name})


def _squares(c: Constraint) -> bool:
    """Whether g is a polynomial in q and y'D2g y a sum of squares, where t enters terms that are affine in q alone."""
    (p,) = polynomial.read(c.g, c.z)
    n = c.q.numel()
    if p is None:
        return False
    bending = {monomial: number for monomial, number in p.items() if sum(power for v, power in monomial if v) > 1}
    if any(v == 0 for monomial in bending for v, _ in monomial):
        return False
    shifted = {tuple((v - 1, power) for v, power in monomial): number for monomial, number in bending.items()}
    return polynomial.degree(shifted) <= DEGREE and sum_of_squares.is_sos_convex(shifted, n)


def _chord(c: Constraint) -> Answer | None:
    """A violation where g in the middle of a chord lies above the mean of its ends, rounding included."""
    points = extremum.samples(np.tile(c.lower, 2), np.tile(c.upper, 2), 1024)
    x, y = np.split(points, 2, axis=1)
    y[:, 0] = x[:, 0]  # At one time.
    ends, middle = [values(c, part) for part in (x, y)], values(c, (x + y) / 2)
    with np.errstate(all="ignore"):
        rise = middle - (ends[0] + ends[1]) / 2
        order = np.argsort(-np.where(np.isfinite(rise), rise, -np.inf), kind="stable")[:4]
    for k in order[rise[order] > 0]:
        half = (x[k] + y[k]) / 2
        below, above = np.nextafter(half, -np.inf), np.nextafter(half, np.inf)
        below[0] = above[0] = x[k, 0]
        low = float(interval.enclose(c.g, c.z, below, above)[0].item())
        high = [float(interval.enclose(c.g, c.z, end, end)[1].item()) for end in (x[k], y[k])]
        over = low - (high[0] + high[1]) / 2 - 1e-15 * (abs(low) + abs(high[0]) + abs(high[1]))
        if np.isfinite(over) and over > 0:
            witness = c.point(half) | {"states": list(c.names), "from": x[k, 1:], "to": y[k, 1:]}
            how = f"in the middle of a chord g_i is at least {over:.3g} above the mean of its ends"
            return Answer(VIOLATED, {"least": -8 * over / float(np.sum((x[k, 1:] - y[k, 1:]) ** 2))}, ON_THE_BOX, how, witness)
    return None


def _on_box(name: str, top: Any) -> Answer:
    proved = np.isfinite(top.bound)
    return Answer(HOLDS if proved else SAMPLED, {name: top.bound if proved else top.value}, ON_THE_BOX, _found(proved, top))


def _found(proved: bool, top: Any) -> str:
    return "a bound over the whole box" if proved else f"no bound was found; {top.count} points"
