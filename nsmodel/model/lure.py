"""Multivalued Lur'e dynamical systems (Brogliato and Goeleven 2013)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.model.base import Model
from nsmodel.model.convex import split
from nsmodel.model.first_order import check_weights, checked_law
from nsmodel.model.laws import Law


@dataclass(frozen=True, kw_only=True, eq=False)
class LureSystem(Model):
    """x' = A(x) + B l + f(t),   y = C x + D l,   -y ∈ N_K(l) or l ∈ -dPhi(y),   x(0) = x0.

    Attributes:
        A: matrix (n, n), or n expressions of ``x``.
        B, C, D: (n, m), (m, n), (m, m); D left out: 0.
        f: n expressions of t; left out: 0.
        law: the relation between l and y, of size m; or
        phi, y: a convex potential Phi as an expression of the m symbols ``y``.
        x: the state symbols, needed where A is an expression; left out: x_0, ..., x_{n-1}.
        x0: the start (n).
        theta, gamma: weights in [0, 1] of A(x) + f and of B l at the end of the step; 1, 1 is the paper's implicit Euler.

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN, law and phi both given or both missing.
    """

    x: Any = None
    A: Any
    B: Any
    C: Any
    D: Any = None
    f: Any = None
    law: Law | None = None
    phi: Any = None
    y: Any = None
    x0: Any
    theta: float = 1.0
    gamma: float = 1.0

    paper: ClassVar[str] = "Brogliato and Goeleven, Existence, uniqueness of solutions and stability of nonsmooth multivalued Lur'e systems (2013)"

    def __post_init__(self) -> None:
        anonymous = self.x is None
        n_start = 1 if isinstance(self.x0, int | float) else len(self.x0) if hasattr(self.x0, "__len__") else self.x0.numel()
        c = self._settle("x", x=ca.SX.sym("x", n_start) if anonymous else self.x, y=self.y)
        n = len(self.names)
        if (self.law is None) == (self.phi is None):
            raise ModelError("law and phi: give exactly one of them (phi with its symbols y=)")
        if self.phi is not None and self.y is None:
            raise ModelError("phi: declare its argument with y=")
        law = None if self.law is None else checked_law(self.law)
        m = self.y.numel() if law is None else law.size
        A = ca.densify(ca.SX(c.convert(self.A, "A")))
        linear = A.shape == (n, n) and not ca.depends_on(A, self.x)
        if linear:
            self._only(A, "A", [])
        A = ca.mtimes(A, self.x) if linear else self._vector(c, self.A, "A", n, [self.x])
        self._set(
            A=A,
            B=self._matrix(c, self.B, "B", (n, m)),
            C=self._matrix(c, self.C, "C", (m, n)),
            D=ca.SX.zeros(m, m) if self.D is None else self._matrix(c, self.D, "D", (m, m)),
            f=self._vector(c, 0 if self.f is None else self.f, "f", n, [self.t]),
            law=law,
            x0=self._numbers(c, self.x0, "x0", n),
            multiplier_names=tuple(f"l_{i}" for i in range(m)),
        )
        for name in "BCD":
            self._only(getattr(self, name), name, [])
        if law is None:
            phi = self._vector(c, self.phi, "phi", 1, [self.y])
            self._set(phi=phi, phi_split=split(phi, self.y, "phi"))
        check_weights(self.theta, self.gamma)
