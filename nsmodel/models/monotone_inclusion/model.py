"""Differential inclusions with a maximal monotone operator, stepped by catching-up (2026) or by its resolvent.

What the functions of an inclusion give: they are known by that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.convex_split import ConvexSplit, split_convex, split_discontinuities
from nsmodel.modeling.laws import Law
from nsmodel.modeling.parameters import describe_argument
from nsmodel.modeling.pickling import Picklable
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.models.first_order_system.model import checked_law


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class MonotoneInclusion(Model):
    """x'(t) ∈ F(t, x(t)) - T(t, x(t)),   T = S + N_C, C(t) closed convex with interior,   x(0) = x0 in C(0).

    Attributes:
        x: the state symbols (n).
        field: F(t, x), n expressions of x and t.
        operator: the single-valued part S(t, x), n expressions of x and t, in which ca.sign(u) stands for Sgn(u); or a law of
            size n, T(x) = {-l : -x ∈ N_K(l)} (relay(n, -1, 1) gives Sgn); left out: 0.
        phi: instead of ``operator``: a convex potential Phi(x), T = dPhi; its indicators belong to C.
        lower, upper: bounds of C (n numbers or expressions of t, or one; infinite ends allowed).
        constraints: {name: c(t, x)}, kept >= 0, concave and smooth in x: C(t) = {x : c(t, x) >= 0, lower <= x <= upper}.
        x0: the start (n).
        tolerances: eps_k of the approximate projection: None (exact), a number, a sequence, or a function of the step mu_k.
        scheme: "catching-up" (project the explicit step on C), or "implicit" (the resolvent of T of the explicit step in F).

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN, lower > upper, bounds without interior.
    """

    x: Any
    field: Any
    operator: Any = None
    phi: Any = None
    lower: Any = None
    upper: Any = None
    constraints: Any = None
    x0: Any
    tolerances: float | Sequence[float] | Callable[[float], float] | None = None

    sign_symbols: ca.SX = dataclasses.field(init=False, repr=False)
    sign_arguments: ca.SX = dataclasses.field(init=False, repr=False)
    potential_split: ConvexSplit | None = dataclasses.field(init=False, repr=False)
    constraint_names: tuple[str, ...] = dataclasses.field(init=False, repr=False)

    paper: ClassVar[str] = "Convergence and stability of a catching-up algorithm with maximal monotone operators (2026)"
    schemes: ClassVar[tuple[str, ...]] = ("catching-up", "implicit")
    has: ClassVar[Mapping[str, str]] = {"v": "the velocity"}
    of_time: ClassVar[str] = (
        "field, operator, lower, upper and constraints may. Write phi as operator, its kinks with sign, or take a LureSystem, "
        "where x' = A(x) + f(t) + B l with a law or phi=, or a FirstOrderSystem, all terms of which may depend on t"
    )

    @property
    def row_names(self) -> tuple[str, ...]:
        """Those of the constraints."""
        return (*self.constraint_names, *self.constraints)

    @property
    def moves(self) -> bool:
        """Whether F, S or C depend on time, or on an input."""
        parts = self.field, self.operator, self.sign_arguments, self.lower, self.upper, *self.constraints.values()
        return any(part.numel() and ca.depends_on(part, ca.vertcat(self.t, self.u)) for part in parts)

    def _declare(self) -> None:
        c = self._declare_symbols("x", x=self.x)
        n = len(self.names)
        lower, upper = self._bound(c, self.lower, "lower", -np.inf), self._bound(c, self.upper, "upper", np.inf)
        operator, potential, lower, upper = self._operator(c, n, lower, upper)
        for i in range(n):
            a, b = lower[i], upper[i]
            if a.is_constant() and b.is_constant() and not float(a) < float(b):
                raise ModelError(f"lower[{i}] = {float(a):g}, upper[{i}] = {float(b):g}: C needs an interior, lower < upper")
        constraints, names = self._named_constraints(c, self.constraints, [self.t, self.x])
        if potential is not None:
            for i, rows in enumerate(potential.domain):
                constraints[f"domain {i}"] = rows
                names += [f"domain {i}"] if rows.numel() == 1 else [f"domain {i}[{j}]" for j in range(rows.numel())]
        smooth, symbols, arguments = split_discontinuities(operator, self.x, "operator")
        self._set(
            field=self._read_vector(c, self.field, "field", n, [self.t, self.x]),
            operator=smooth,
            sign_symbols=symbols,
            sign_arguments=arguments,
            potential_split=potential,
            lower=lower,
            upper=upper,
            constraints=constraints,
            constraint_names=tuple(names),
            x0=self._read_start(c, self.x0, "x0", n),
        )
        self._check_tolerances()

    def _bound(self, c: Any, value: Any, label: str, default: float) -> ca.SX:
        n = len(self.names)
        column = ca.vec(ca.SX(c.convert(default if value is None else value, label)))
        return self._read_vector(c, ca.repmat(column, n, 1) if column.numel() == 1 else column, label, n, [self.t], infinite=True)

    def _operator(self, c: Any, n: int, lower: ca.SX, upper: ca.SX) -> tuple[ca.SX, ConvexSplit | None, ca.SX, ca.SX]:
        if self.operator is not None and self.phi is not None:
            raise ModelError("operator and phi are both given; keep one")
        if self.phi is not None:
            potential = split_convex(self._read_vector(c, self.phi, "phi", 1, [self.x]), self.x, "phi")
            if potential.tau.numel():
                raise ModelError(
                    "phi: there is no explicit selection for nested nonsmooth terms; write a sum of fabs, fmax, norm_2"
                )
            if any(term.kind == "equality" for term in potential.terms):
                raise ModelError("phi: an equality leaves C without interior; eliminate a state instead")
            return ca.SX.zeros(n), potential, lower, upper
        if isinstance(self.operator, Law):
            return self._operator_from_law(checked_law(self, c, self.operator, "operator"), n, lower, upper)
        zero = self.operator is None
        return self._read_vector(c, 0 if zero else self.operator, "operator", n, [self.t, self.x]), None, lower, upper

    def _operator_from_law(self, law: Law, n: int, lower: ca.SX, upper: ca.SX) -> tuple[ca.SX, None, ca.SX, ca.SX]:
        """T(x) = {-l : -x ∈ N_[lo, up](l)}: -lo for x > 0, -up for x < 0, between at 0; an infinite end bounds C at 0."""
        if law.size != n or not law.is_box:
            raise ModelError(f"operator: a law of size {n} made of boxes is expected; for other convex potentials use phi=")
        S, lower, upper = ca.SX.zeros(n), ca.SX(lower), ca.SX(upper)
        for i in range(n):
            lo, up = law.lower[i], law.upper[i]
            if ca.depends_on(ca.vertcat(lo, up), ca.vertcat(self.t, self.u)):
                raise ModelError(
                    f"operator: the ends of component {i}, {lo} and {up}, move; a law here has numbers. Write the operator as an "
                    "expression, -(lower + upper)/2 + (upper - lower)/2*sign(x), with lower <= upper at all times"
                )
            no_lo, no_up = lo.is_constant() and np.isinf(float(lo)), up.is_constant() and np.isinf(float(up))
            if no_lo and no_up:
                raise ModelError(f"operator: component {i} is an equality; C would have no interior. Eliminate that state")
            if no_up:
                S[i], lower[i] = -lo, ca.fmax(lower[i], 0)
            elif no_lo:
                S[i], upper[i] = -up, ca.fmin(upper[i], 0)
            else:
                S[i] = -(lo + up) / 2 + (up - lo) / 2 * ca.sign(self.x[i])
        return S, None, lower, upper

    def _check_tolerances(self) -> None:
        if self.tolerances is None:
            return
        if self.scheme != "catching-up":
            raise ModelError(
                f"tolerances belong to the projections of catching-up, which scheme = {self.scheme!r} does not have; keep one"
            )
        if callable(self.tolerances):
            self._set(tolerances=Tolerance(self.tolerances))
            return
        try:
            if isinstance(self.tolerances, ca.SX | ca.MX):
                raise TypeError
            values = np.atleast_1d(np.asarray(self.tolerances, float))
        except (OverflowError, TypeError, ValueError, RuntimeError):
            values = np.zeros(0)
        if values.ndim != 1 or not values.size:
            raise ModelError(
                "tolerances: expected a number, a sequence of numbers or a function of the step, not "
                f"{describe_argument(self.tolerances)}"
            )
        bad = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
        if bad.size:
            raise ModelError(f"tolerances[{bad[0]}] = {values[bad[0]]:g}; expected finite numbers >= 0")
        if self.steps is not None and values.size not in (1, len(self.steps)):
            raise ModelError(f"tolerances: {values.size} values for {len(self.steps)} steps; give one for each")


@dataclass(frozen=True, eq=False)
class Tolerance(Picklable):
    """The user's function of the step, its values checked."""

    function: Callable[[float], float]

    def __call__(self, h: float) -> float:
        """Return eps(h); ModelError where the function fails or gives no finite number >= 0."""
        try:
            value = self.function(h)
        except Exception as error:
            raise ModelError(f"tolerances: called with the step {h:g}, the function fails: {error}") from error
        if not isinstance(value, Real) or not 0 <= value < np.inf:
            raise ModelError(f"tolerances({h:g}) = {value!r}; expected a finite number >= 0")
        return float(value)


def values_of_functions(model: MonotoneInclusion, grid: TimeGrid) -> list[list[float]]:
    """The tolerances at the steps of the run, where they are a function."""
    if not callable(model.tolerances):
        return []
    return [[float(model.tolerances(h)) for h in ([grid.h, grid.last] if grid.steps is None else grid.steps.tolist())]]
