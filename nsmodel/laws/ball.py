"""The ball {|l| <= r}: isotropic friction, l = -r y/|y| where y != 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import casadi as ca
import numpy as np

from nsmodel.laws.curved import Curved, norm


@dataclass(frozen=True)
class Ball(Curved):
    """{|l| <= radius}."""

    radius: float
    kind: ClassVar[str] = "ball"

    @classmethod
    def of(cls, size: int, upper: ca.SX) -> Self:
        """The radius is in each row of ``upper``."""
        return cls(float(upper[0]))

    def project(self, u: np.ndarray) -> np.ndarray:
        """r u / |u| outside."""
        size = norm(u)
        return u if size <= self.radius else u * (self.radius / size)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """(r/|u|) (I - e e'), e = u/|u|, outside."""
        size = norm(u)
        if size <= self.radius:
            return np.eye(u.size)
        e = u / size
        return (self.radius / size) * (np.eye(u.size) - np.outer(e, e))

    def code(self, u: np.ndarray) -> int:
        """Stick or slip."""
        return 1 if norm(u) > self.radius else 0

    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """Along the ray."""
        return self.project(l * 2)

    def selected(self, y: np.ndarray) -> np.ndarray:
        """-r y/|y|."""
        return -self.radius * y / norm(y)

    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """<l, y> + r |y|, r^2 - |l|^2."""
        return ca.dot(l, y) + self.radius * ca.sqrt(ca.sumsqr(y) + tiny), [self.radius**2 - ca.sumsqr(l)]
