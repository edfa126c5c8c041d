"""The ball {|l| <= r}: isotropic friction, l = -r y/|y| where y != 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.laws.base import (
    STATE_UPPER,
    STATE_ZERO,
    CurvedSet,
    LatexNumberWriter,
    Law,
    LawEnds,
    LawFactor,
    RewrittenLaw,
    RoundSet,
    StateNames,
    check_count,
    interval_length,
    product_set,
    read_law_column,
    safe_norm,
)
from nsmodel.modeling.laws.box import make_box_law


@dataclass(frozen=True)
class BallSet(CurvedSet):
    """{|l| <= radius}, numbers."""

    radius: float  # pyrefly: ignore[bad-override]
    kind: ClassVar[str] = "ball"

    def project(self, u: np.ndarray) -> np.ndarray:
        """r u / |u| outside."""
        size = safe_norm(u)
        return u if size <= self.radius else u * (self.radius / size)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """(r/|u|) (I - e e'), e = u/|u|, outside."""
        size = safe_norm(u)
        if size <= self.radius:
            return np.eye(u.size)
        e = u / size
        return (self.radius / size) * (np.eye(u.size) - np.outer(e, e))

    def code(self, u: np.ndarray) -> int:
        """The code 0 of stick, 1 of slip."""
        return 1 if safe_norm(u) > self.radius else 0

    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """The point of the boundary on the ray through l."""
        return self.project(l * 2)

    def support_point(self, y: np.ndarray) -> np.ndarray:
        """The point -r y/|y| of the set in which -y is normal."""
        return -self.radius * y / safe_norm(y)

    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """<l, y> + r |y|, r^2 - |l|^2."""
        return ca.dot(l, y) + self.radius * ca.sqrt(ca.sumsqr(y) + tiny), [self.radius**2 - ca.sumsqr(l)]

    def slip(self, y: ca.SX) -> tuple[ca.SX, ca.SX]:
        """The multiplier -r y/|y| of slip, and |y|."""
        size = ca.sqrt(ca.sumsqr(y))
        return -self.radius * y / size, size

    def quadric(self, m: int) -> tuple[np.ndarray, float]:
        """The identity and r^2, of the set |l|^2 <= r^2."""
        return np.eye(m), self.radius**2


@dataclass(frozen=True, eq=False)
class Ball(LawFactor):
    """{|l| <= radius}; ``radius`` a number or an expression of parameters, t and inputs."""

    kind: ClassVar[str] = "ball"
    strict: ClassVar[bool] = True
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {
        "ball": {0: (STATE_ZERO, "l inside the ball (y = 0)"), 1: (STATE_UPPER, "l on the sphere")}
    }
    radius: ca.SX

    __repr__ = short_repr

    @property
    def numbers(self) -> dict[str, ca.SX]:
        """The radius by its name."""
        return {"radius": self.radius}

    def scaled(self, u: float) -> Ball:
        """The radius times u."""
        return replace(self, radius=u * self.radius)

    def invalidity_reason(self, given: str) -> str:
        """A negative or infinite radius."""
        if not self.radius.is_constant():
            return ""
        r = float(self.radius)
        return "" if 0 <= r < np.inf else f"the ball has the radius {r:g}{given}; expected a finite number >= 0"

    def curved(self) -> BallSet:
        """With its number."""
        return BallSet(float(self.radius))

    def rewritten(self, y: ca.SX, names: tuple[str, ...], moving: ca.SX, *, guarded: bool = True) -> RewrittenLaw | None:
        """A radius that moves by l = r l' with l' in the unit ball; y as it is."""
        if not ca.depends_on(self.radius, moving):
            return None
        l, ends = ca.SX.sym("l", self.size), LawEnds(names[0], ca.SX(0), self.radius)
        law, r = Law((replace(self, radius=ca.SX(1)),)), interval_length(ends.lower, ends.upper, guarded=guarded)
        return RewrittenLaw(law, l, r * l, names, y, (ends,), ca.repmat(r, self.size, 1))

    def c_numbers(self) -> ca.SX:
        """The radius as a column for generated C."""
        return self.radius

    def shape(self) -> RoundSet:
        """The ball as an exact set."""
        return RoundSet(
            [[Fraction(int(i == j)) for j in range(self.size)] for i in range(self.size)], Fraction(float(self.radius))
        )

    @property
    def width(self) -> float:
        """The diameter of the ball."""
        return 2 * float(self.radius)

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """The ends of the cube around the ball."""
        return np.full(self.size, -float(self.radius)), np.full(self.size, float(self.radius))

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond the sphere."""
        return np.maximum(np.linalg.norm(l, axis=1, keepdims=True) - float(self.radius), 0)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The points -r y/|y| with the least product with y."""
        size = np.linalg.norm(y, axis=1, keepdims=True)
        return (-float(self.radius) * y / np.where(size > 0, size, 1))[None]

    @property
    def extent(self) -> float:
        """The radius of the ball."""
        return float(self.radius)

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """The set |lambda| <= r in LaTeX."""
        return [product_set(write, self.size, rf"\left\Vert \lambda \right\Vert \leq {write.number(self.radius)}")]

    def data(self) -> dict[str, Any]:
        """The radius for reports."""
        return {"radius": float(self.radius)}


@checks_keywords
def ball(m: int, radius: Any = 1) -> Law:
    """-y ∈ N(l) for {|l| <= radius} in R^m: isotropic Coulomb friction; l = -radius y/|y| where y != 0.

    Raises:
        ModelError: m < 1, a radius that is negative or not finite.
    """
    m, r = check_count("ball", m), read_law_column("ball", "radius", radius, 1)
    if r.is_constant() and not 0 <= float(r) < np.inf:
        raise ModelError(f"ball: radius = {float(r):g} must be finite and not negative")
    if m == 1:
        return make_box_law("relay", 1, -r, r)
    return Law((Ball("ball", m, r),))
