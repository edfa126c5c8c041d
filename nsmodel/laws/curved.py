"""What solvers ask of a closed convex set K with one curved boundary, its numbers given."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import casadi as ca
import numpy as np


class CurvedSet(ABC):
    """A closed convex set in R^m with one curved boundary: {c - l'S l >= 0}, with l_1 >= 0 where it is a cone.

    Attributes:
        kind: its name, and that of its file of C.
        is_cone: whether it is pointed at 0 and unbounded.
        radius: max |l| over K; inf where K is not bounded.
    """

    kind: ClassVar[str]
    is_cone: ClassVar[bool] = False
    radius: float

    @property
    def is_bounded(self) -> bool:
        """Whether K is bounded."""
        return math.isfinite(self.radius)

    @abstractmethod
    def project(self, u: np.ndarray) -> np.ndarray:
        """P_K(u), (m,)."""

    @abstractmethod
    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """An element of the generalised Jacobian of P_K at u, (m, m)."""

    @abstractmethod
    def code(self, u: np.ndarray) -> int:
        """Where P_K(u) lies, u = l - c y: 0 where y = 0, -1 where l = 0, +1 on the curved boundary."""

    @abstractmethod
    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """The l near this one that lies on the curved boundary."""

    @abstractmethod
    def support_point(self, y: np.ndarray) -> np.ndarray:
        """The l in K with -y ∈ N_K(l), y != 0; 0 where K is not bounded."""

    @abstractmethod
    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """(gap, rows): -y ∈ N_K(l) if and only if gap = 0 and rows >= 0; roots are smoothed by ``tiny``."""

    def slip(self, y: ca.SX) -> tuple[ca.SX, ca.SX] | None:
        """(l, sqrt(y'S^-1 y)) with -y ∈ N_K(l), y != 0, as expressions of y; None: its modes are not these and y = 0."""
        return None

    @abstractmethod
    def quadric(self, m: int) -> tuple[np.ndarray, float]:
        """(S, c), S (m, m)."""


def safe_norm(u: np.ndarray) -> float:
    """|u|, whose squares may overflow."""
    return math.hypot(*u)
