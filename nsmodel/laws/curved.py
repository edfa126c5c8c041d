"""What solvers ask of a closed convex set K with one curved boundary."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, Self

import casadi as ca
import numpy as np


class Curved(ABC):
    """A closed convex set in R^m with one curved boundary.

    Attributes:
        kind: its name in a `Block`.
        radius: max |l| over K; inf where K is not bounded.
    """

    kind: ClassVar[str]
    radius: float

    @classmethod
    @abstractmethod
    def of(cls, size: int, upper: ca.SX) -> Self:
        """The set in R^size of a block with the upper ends ``upper`` (size, 1), constants."""

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
    def selected(self, y: np.ndarray) -> np.ndarray:
        """The l in K with -y ∈ N_K(l), y != 0; 0 where K is not bounded."""

    @abstractmethod
    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """(gap, rows): -y ∈ N_K(l) if and only if gap = 0 and rows >= 0; roots are smoothed by ``tiny``."""


def norm(u: np.ndarray) -> float:
    """|u|, whose squares may overflow."""
    return math.hypot(*u)
