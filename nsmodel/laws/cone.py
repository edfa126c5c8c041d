"""The second-order cone {|(l_2, ..., l_m)| <= l_1}, self-dual: K ∋ l ⟂ y ∈ K."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import casadi as ca
import numpy as np

from nsmodel.laws.curved import Curved, norm


@dataclass(frozen=True)
class Cone(Curved):
    """{|(l_2, ..., l_m)| <= l_1}."""

    radius: float = np.inf
    kind: ClassVar[str] = "cone"

    @classmethod
    def of(cls, size: int, upper: ca.SX) -> Self:
        """It has no numbers."""
        return cls()

    def project(self, u: np.ndarray) -> np.ndarray:
        """u inside, 0 in the polar cone, else (t, t e), t = (u_1 + |(u_2, ...)|)/2."""
        head, size = u[0], norm(u[1:])
        if size <= head:
            return u
        if size <= -head:
            return np.zeros_like(u)
        t = (head + size) / 2
        return np.concatenate(([t], u[1:] * (t / size)))

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Of the three branches of P_K."""
        size = norm(u[1:])
        if size <= u[0]:
            return np.eye(u.size)
        if size <= -u[0]:
            return np.zeros((u.size, u.size))
        e, J = u[1:] / size, np.empty((u.size, u.size))
        J[0, 0], J[0, 1:], J[1:, 0] = 0.5, e / 2, e / 2
        J[1:, 1:] = ((1 + u[0] / size) * np.eye(e.size) - (u[0] / size) * np.outer(e, e)) / 2
        return J

    def code(self, u: np.ndarray) -> int:
        """Inside, apex or boundary."""
        head, size = u[0], norm(u[1:])
        return 0 if size <= head else (-1 if size <= -head else 1)

    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """The first entry follows from the others."""
        return np.concatenate(([norm(l[1:])], l[1:]))

    def selected(self, y: np.ndarray) -> np.ndarray:
        """0: -y is a normal there for y in K."""
        return np.zeros_like(y)

    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """<l, y>, l and y in K."""
        return ca.dot(l, y), [row for v in (l, y) for row in (v[0], v[0] ** 2 - ca.sumsqr(v[1:]))]
