"""Multivalued Lur'e dynamical systems (Brogliato and Goeleven 2013)."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.conversion import Converter
from nsmodel.modeling.convex_split import ConvexSplit, split_convex
from nsmodel.modeling.laws import Law, product
from nsmodel.modeling.parameters import declare_parameters, describe_argument, numbered_row_names
from nsmodel.models.first_order_system.model import check_weights, checked_law


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LureSystem(Model):
    """x' = A(x) + B l + f(t),   y = C x + D l + e(t),   -y ∈ N_K(l) or l ∈ -dPhi(y),   x(0) = x0.

    Attributes:
        A: matrix (n, n), or n expressions of ``x``.
        B, C, D: (n, m), (m, n), (m, m); D left out: 0. Matrices may be sparse (SciPy, CasADi), and stay so.
        f: n expressions of t; left out: 0.
        e: m expressions of t, an offset of the output; left out: 0, as in the paper.
        law: the relation between l and y, of size m, or {name: law} of its parts, one after the other: then their multipliers
            have these names (of several name[0], name[1], ...), and not l_0, l_1, ...; or
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
    e: Any = None
    law: Any = None
    phi: Any = None
    y: Any = None
    x0: Any
    theta: float = 1.0
    gamma: float = 1.0

    multiplier_names: tuple[str, ...] = field(init=False, repr=False)
    phi_split: ConvexSplit = field(init=False, repr=False)  # Of phi, where it is given.

    paper: ClassVar[str] = (
        "Brogliato and Goeleven, Existence, uniqueness of solutions and stability of nonsmooth multivalued Lur'e systems (2013)"
    )
    schemes: ClassVar[tuple[str, ...]] = ("theta-gamma",)

    def _declare(self) -> None:
        c = self._declare_symbols("x", x=ca.SX.sym("x", self._count_states()) if self.x is None else self.x, y=self.y)
        n = len(self.names)
        if (self.law is None) == (self.phi is None):
            raise ModelError("law and phi: give exactly one of them (phi with its symbols y=)")
        if self.phi is not None and self.y is None:
            raise ModelError("phi: declare its argument with y=")
        law, rows = _combine_named_laws(self.law)
        law = None if law is None else checked_law(self, c, law)
        if law is not None and not law.is_normal_cone:
            raise ModelError(
                "law: Coulomb friction is no normal cone, and what is known of Lur'e systems holds of those; "
                "write a FirstOrderSystem: -ŷ(y) ∈ N_K(l) has the same steps there"
            )
        m = self.y.numel() if law is None else law.size
        what = f"{m} components of the law" if law is not None else f"{m} symbols of y"
        square = f"a row and a column for each of {what}"
        self._set(
            A=self._rate(c, n),
            B=self._read_matrix(c, self.B, "B", (n, m), f"a row for each of {n} states, a column for each of {what}"),
            C=self._read_matrix(c, self.C, "C", (m, n), f"a row for each of {what}, a column for each of {n} states"),
            D=ca.SX(m, m) if self.D is None else self._read_matrix(c, self.D, "D", (m, m), square),
            f=self._read_vector(c, 0 if self.f is None else self.f, "f", n, [self.t]),
            e=self._read_vector(c, 0 if self.e is None else self.e, "e", m, [self.t]),
            law=law,
            x0=self._read_start(c, self.x0, "x0", n),
            multiplier_names=self._multiplier_names(rows, m),
        )
        if law is None:
            phi = self._read_vector(c, self.phi, "phi", 1, [self.y])
            self._set(phi=phi, phi_split=split_convex(phi, self.y, "phi"))
        check_weights(self.theta, self.gamma)

    def _multiplier_names(self, rows: dict[str, int] | None, m: int) -> tuple[str, ...]:
        if rows is None:
            return tuple(f"l_{i}" for i in range(m))
        for name in rows:
            if name in {"t", *self.names, *self.stems, *self.input_groups}:
                raise ModelError(f"law: '{name}' is also the name of a state, an input or the time; take another name")
        return tuple(entry for name, size in rows.items() for entry in numbered_row_names(name, size))

    @property
    def weights(self) -> tuple[float, float]:
        """theta and gamma."""
        return self.theta, self.gamma

    def output(self, x: ca.SX, l: ca.SX) -> ca.SX:
        """y = C x + D l + e at the time ``t`` (m, 1)."""
        return ca.densify(self.C @ x + self.D @ l + self.e)

    def _count_states(self) -> int:
        """The number of entries of x0, where no state symbols are given."""
        c = Converter(declare_parameters(self.parameters)[0])
        x0 = c.convert(self.x0, "x0")
        if not x0.numel() or 1 not in x0.shape:
            raise ModelError(f"x0: shape {x0.shape}; expected a column, one number for each state")
        n, wrong, A = x0.numel(), False, (0, 0)
        with contextlib.suppress(ModelError):  # what is wrong with a matrix is said where it is read
            A, B, C = (c.convert(getattr(self, name), name).shape for name in "ABC")
            wrong = A[0] == A[1] not in (1, n) and A[0] in (B[0], C[1])
        if wrong:
            raise ModelError(f"x0: {n} number{'s' * (n > 1)}; expected {A[0]}, one for each state, as A has the shape {A}")
        return n

    def _rate(self, c: Converter, n: int) -> ca.SX:
        """A x for a matrix of numbers, else the n expressions."""
        A = ca.SX(c.convert(self.A, "A"))
        if ca.depends_on(A, self.x):
            if A.shape == (n, n) and n > 1:
                raise ModelError(f"A: a matrix {A.shape} with entries of x; write the product with x, as {n} expressions")
            return self._read_vector(c, A, "A", n, [self.x])
        if A.is_zero() and A.numel() == 1:
            return ca.SX.zeros(n)
        states = f"{n} state{'s' if n > 1 else ''} {', '.join(self.names[:3])}{', ...' if n > 3 else ''}"
        why = f"a row and a column for each of {states}; or give {n} expression{'s' if n > 1 else ''} of the state"
        return ca.densify(ca.mtimes(self._read_matrix(c, A, "A", (n, n), why), self.x))


def _combine_named_laws(given: Any) -> tuple[Any, dict[str, int] | None]:
    """The law as one, and {name: number of its rows} where its parts have names."""
    if not isinstance(given, Mapping):
        return given, None
    for name, part in given.items():
        if not isinstance(part, Law) or not isinstance(name, str) or not name:
            raise ModelError(
                f"law: {name!r}: {describe_argument(part)}; expected {{name: law}} such as {{'diode': complementarity(1)}}"
            )
    if not given:
        raise ModelError("law: an empty dictionary; give {name: law} of each part")
    return product(*given.values()), {name: part.size for name, part in given.items()}
