"""Polyhedra {H l >= K}."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.laws.base import (
    Halfspaces,
    LatexNumberWriter,
    Law,
    LawFactor,
    RewrittenLaw,
    StateNames,
    product,
    product_set,
    read_array,
)
from nsmodel.modeling.laws.box import complementarity, equality


@dataclass(frozen=True, eq=False)
class Polyhedron(LawFactor):
    """{H l >= K}; arrays H (r, m) and K (r,)."""

    kind: ClassVar[str] = "polyhedron"
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {}
    H: np.ndarray
    K: np.ndarray

    __repr__ = short_repr

    def scaled(self, u: float) -> Polyhedron:
        """The polyhedron with u K in place of K."""
        return replace(self, K=u * self.K)

    def rewritten(self, y: ca.SX, names: tuple[str, ...], moving: ca.SX, *, guarded: bool = True) -> RewrittenLaw:
        """l free with y - H'n = 0, and 0 <= n ⟂ H l - K >= 0."""
        l, n = ca.SX.sym("l", self.size), ca.SX.sym("n", len(self.K))
        rows = (*names, *(f"{names[0]} face {i}" for i in range(len(self.K))))
        outputs = ca.vertcat(y - ca.DM(self.H.T) @ n, ca.DM(self.H) @ l - ca.DM(self.K))
        return RewrittenLaw(product(equality(self.size), complementarity(len(self.K))), ca.vertcat(l, n), l, rows, outputs)

    def shape(self) -> Halfspaces:
        """The half-spaces as an exact set."""
        return Halfspaces(np.asarray(self.H, float), np.asarray(self.K, float))

    def excess(self, l: np.ndarray) -> np.ndarray:
        """How far l lies beyond each face."""
        return np.maximum(self.K - l @ self.H.T, 0)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The point of least <l', y>, by a linear program; far out from l where there is none."""
        from scipy.optimize import linprog

        found = np.array(l, float)
        for row, (own, direction) in enumerate(zip(l, y, strict=True)):
            size = np.linalg.norm(direction)
            if not size:
                continue
            best = linprog(direction / size, A_ub=-self.H, b_ub=-self.K, bounds=(None, None))
            if not best.success:  # along some H d >= 0
                best = linprog(direction / size, A_ub=-self.H, b_ub=np.zeros(len(self.K)), bounds=(-1, 1))
                best.x = own + best.x * (1 + np.abs(own).max())
            found[row] = best.x
        return found[None]

    @property
    def extent(self) -> float:
        """The largest of K."""
        return float(np.abs(self.K).max(initial=0.0))

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """The set H lambda >= K in LaTeX."""
        return [product_set(write, self.size, rf"{write.matrix(self.H)} \lambda \geq {write.column(self.K)}")]

    def data(self) -> dict[str, Any]:
        """The matrices H and K for reports."""
        return {"H": self.H, "K": self.K}


@checks_keywords
def polyhedron(H: Any, K: Any) -> Law:
    """-y ∈ N(l) for {l : H l >= K}; H (r, m), K (r,), numbers.

    Raises:
        ModelError: no numbers, other shapes.
    """
    try:
        h, k = np.atleast_2d(read_array("polyhedron", "H", H)), np.ravel(read_array("polyhedron", "K", K))
    except ModelError:
        raise ModelError(f"polyhedron: H = {H!r}, K = {K!r}; expected numbers") from None
    if h.ndim != 2 or k.shape != (h.shape[0],):
        raise ModelError(f"polyhedron: H has shape {h.shape} and K {k.shape}; expected (r, m) and (r,) with the same r")
    if not (np.isfinite(h).all() and np.isfinite(k).all()):
        raise ModelError("polyhedron: H and K must be finite; leave the row out instead of making it infinite")
    return Law((Polyhedron("polyhedron", h.shape[1], h, k),))
