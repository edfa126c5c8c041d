"""First-order nonsmooth systems with a nonlinear relation (the class of Siconos' EulerMoreau integrator)."""

from __future__ import annotations

from dataclasses import dataclass, field
from numbers import Real
from typing import Any, ClassVar

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.modeling.base import LEFT_OUT, Model
from nsmodel.modeling.conversion import Converter
from nsmodel.modeling.laws import Law
from nsmodel.modeling.parameters import describe_argument


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FirstOrderSystem(Model):
    """M x' = f(t, x) + r,   y = h(t, x, l),   r = g(t, x, l),   -y ∈ N_K(l),   x(0) = x0.

    Attributes:
        x: the state symbols (n).
        lam: the multiplier symbols l (m); left out with ``law``: a smooth system.
        f: n expressions of t and x.
        h: the output, m expressions of t, x and l.
        g: the input, n expressions of t, x and l.
        M: mass matrix (n, n), constant, also sparse (SciPy, CasADi); left out: the identity.
        law: the relation between l and y, of size m.
        x0: the start (n); lam0: first guess of l (m), only used by Newton's method and, where gamma < 1, replaced by the
            solution of the law at the start.
        theta, gamma: weights in [0, 1] of f and r at the end of the step.

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN, theta or gamma outside [0, 1].
    """

    x: Any
    lam: Any = None
    f: Any
    h: Any = None
    g: Any = None
    M: Any = None
    law: Law = LEFT_OUT
    x0: Any
    lam0: Any = None
    theta: float = 1.0
    gamma: float = 1.0

    multiplier_names: tuple[str, ...] = field(init=False, repr=False)

    paper: ClassVar[str] = "Acary and Perignon, Siconos developer's notes: theta-gamma scheme, Newton linearisation, MLCP"
    schemes: ClassVar[tuple[str, ...]] = ("theta-gamma",)

    def _declare(self) -> None:
        c = self._declare_symbols("x", x=self.x, lam=self.lam)
        n = len(self.names)
        given = {name: getattr(self, name) is not None for name in ("lam", "h", "g", "law")}
        if any(given.values()) and not all(given.values()):
            missing = [name for name, is_given in given.items() if not is_given]
            raise ModelError(f"{', '.join(missing)} missing: lam, h, g and law are given together, or none of them")
        law = Law(()) if self.law is None else checked_law(self, c, self.law)
        lam = ca.SX(0, 1) if self.lam is None else self.lam
        m = lam.numel()
        if law.size != m:
            raise ModelError(f"law: it has {law.size} components, but lam = {lam} has {m}; make them equal")
        self._set(
            lam=lam,
            f=self._read_vector(c, self.f, "f", n, [self.t, self.x]),
            h=self._read_vector(c, [] if self.h is None else self.h, "h", m, [self.t, self.x, lam]) if m else ca.SX(0, 1),
            g=self._read_vector(c, 0 if self.g is None else self.g, "g", n, [self.t, self.x, lam]),
            M=ca.SX.eye(n) if self.M is None else self._read_matrix(c, self.M, "M", (n, n), f"as there are {n} states"),
            law=law,
            x0=self._read_start(c, self.x0, "x0", n),
            lam0=self._read_start(c, 0 if self.lam0 is None else self.lam0, "lam0", m) if m else ca.SX(0, 1),
            multiplier_names=tuple(str(symbol) for symbol in ca.vertsplit(lam)) if m else (),
        )
        check_weights(self.theta, self.gamma)

    @property
    def weights(self) -> tuple[float, float]:
        """theta and gamma."""
        return self.theta, self.gamma


def checked_law(model: Model, converter: Converter, law: Any, label: str = "law") -> Law:
    """Return ``law`` with its numbers in the symbols of the model's parameters, t and inputs; refuse no law, other symbols."""
    if not isinstance(law, Law):
        raise ModelError(f"{label}: expected a law such as complementarity(2) or relay(1, -1, 1), not {describe_argument(law)}")

    def known(name: str, value: ca.SX) -> ca.SX:
        column = converter.convert(value, f"{label}: {name}")
        model._check_symbols(column, f"{label}: {name}", [model.t])
        return column

    return Law(tuple(b.with_numbers(**{name: known(name, value) for name, value in b.numbers.items()}) for b in law.blocks))


def check_weights(theta: Any, gamma: Any) -> None:
    """Refuse theta and gamma outside [0, 1]."""
    for name, value in (("theta", theta), ("gamma", gamma)):
        if isinstance(value, bool) or not isinstance(value, Real) or not 0 <= float(value) <= 1:
            raise ModelError(f"{name} = {value!r}; expected a number in [0, 1]")
