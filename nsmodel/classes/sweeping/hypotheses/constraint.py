"""One constraint of a sweeping process, and what it answers to one hypothesis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.forms import ConstraintShape
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.krawczyk import enclose_zero

SUP_ROUNDING_FACTOR = 1 + 1e-14  # More than what a root and a few products lose.
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

    def rate(self, expression: ca.SX) -> ca.SX:
        """The derivative of a column by time, along the inputs."""
        return self.motion.velocity(expression, self.t[0])

    @property
    def z(self) -> ca.SX:
        """(t, q)."""
        return ca.vertcat(self.t, self.q)

    @property
    def slow(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of t, or of (t, p)."""
        return self.lower[: self.t.numel()], self.upper[: self.t.numel()]

    def point(self, z: np.ndarray) -> dict[str, Any]:
        """The witness of a point (t, q)."""
        return {"constraint": self.name} | ({"t": z[0]} if self.shape.time else {}) | dict(zip(self.names, z[1:], strict=True))


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
