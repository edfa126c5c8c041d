"""The second-order cone {|(l_2, ..., l_m)| <= l_1}, self-dual: K ∋ l ⟂ y ∈ K."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.modeling.laws.base import (
    STATE_NOTHING,
    STATE_UPPER,
    STATE_ZERO,
    CurvedSet,
    LatexNumberWriter,
    Law,
    LawFactor,
    SecondOrder,
    StateNames,
    check_count,
    product_set,
    safe_norm,
)
from nsmodel.modeling.laws.box import complementarity


@dataclass(frozen=True)
class ConeSet(CurvedSet):
    """{|(l_2, ..., l_m)| <= l_1}."""

    radius: float = np.inf  # pyrefly: ignore[bad-override]
    kind: ClassVar[str] = "cone"
    is_cone: ClassVar[bool] = True

    def project(self, u: np.ndarray) -> np.ndarray:
        """u inside, 0 in the polar cone, else (t, t e), t = (u_1 + |(u_2, ...)|)/2."""
        head, size = u[0], safe_norm(u[1:])
        if size <= head:
            return u
        if size <= -head:
            return np.zeros_like(u)
        t = (head + size) / 2
        return np.concatenate(([t], u[1:] * (t / size)))

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Of the three branches of P_K."""
        size = safe_norm(u[1:])
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
        head, size = u[0], safe_norm(u[1:])
        return 0 if size <= head else (-1 if size <= -head else 1)

    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """The first entry follows from the others."""
        return np.concatenate(([safe_norm(l[1:])], l[1:]))

    def support_point(self, y: np.ndarray) -> np.ndarray:
        """0: -y is a normal there for y in K."""
        return np.zeros_like(y)

    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """<l, y>, l and y in K."""
        return ca.dot(l, y), [row for v in (l, y) for row in (v[0], v[0] ** 2 - ca.sumsqr(v[1:]))]

    def quadric(self, m: int) -> tuple[np.ndarray, float]:
        """l_1^2 - |(l_2, ...)|^2."""
        return np.diag(np.r_[-1.0, np.ones(m - 1)]), 0.0


@dataclass(frozen=True, eq=False)
class Cone(LawFactor):
    """{|(l_2, ..., l_m)| <= l_1}."""

    kind: ClassVar[str] = "cone"
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {
        "second-order cone": {
            -1: (STATE_NOTHING, "open (l = 0)"), 0: (STATE_ZERO, "l inside the cone (y = 0)"), 1: (STATE_UPPER, "l on the cone"),
        }
    }  # fmt: skip

    __repr__ = short_repr

    def scaled(self, u: float) -> Cone:
        """A cone is the same in all units."""
        return self

    def curved(self) -> ConeSet:
        """It has no numbers."""
        return ConeSet()

    def shape(self) -> SecondOrder:
        """The second-order cone as an exact set."""
        return SecondOrder(self.size)

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond the boundary."""
        return np.maximum(np.linalg.norm(l[:, 1:], axis=1) - l[:, 0], 0)[:, None]

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """0, twice l, and l + (1, -e) with e the direction of (y_2, ...)."""
        across = np.linalg.norm(y[:, 1:], axis=1, keepdims=True)
        edge = np.hstack([np.ones((len(y), 1)), -y[:, 1:] / np.where(across > 0, across, 1)])
        inside = l + np.pad(self.excess(l), ((0, 0), (0, self.size - 1)))
        return np.stack([np.zeros_like(l), 2 * inside, inside + edge * (np.abs(l).max(axis=1, keepdims=True) + 1e-300)])

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """|(lambda_2, ...)| <= lambda_1."""
        across = r"\left\Vert \left(\lambda_2, \ldots, \lambda_m\right) \right\Vert"
        return [product_set(write, self.size, rf"{across} \leq \lambda_1")]

    def latex_relation(self) -> str:
        """Complementarity of cones."""
        return r"K \ni \lambda \perp y \in K"

    def data(self) -> dict[str, Any]:
        """It has no numbers."""
        return {}


@checks_keywords
def second_order_cone(m: int) -> Law:
    """K = {l : |(l_2, ..., l_m)| <= l_1}, self-dual: K ∋ l ⟂ y ∈ K. For m = 1 this is complementarity."""
    m = check_count("second_order_cone", m)
    if m == 1:
        return complementarity(1)
    return Law((Cone("second-order cone", m),))
