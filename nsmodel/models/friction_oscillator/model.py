"""Nonlinear oscillators under dry friction (Cabot 2004)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import casadi as ca

from nsmodel._utils import cached_per_object
from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.convex_split import ConvexSplit, split_convex
from nsmodel.modeling.expressions import check_finite
from nsmodel.modeling.laws import StateNames
from nsmodel.modeling.parameters import describe_argument


class Friction(NamedTuple):
    """One friction element theta(|H v|): its name, H (m, n), and theta, an expression of s, t and inputs."""

    name: str
    H: ca.SX
    theta: ca.SX


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FrictionOscillator(Model):
    """x'' + dPhi(x') + M x' + dg(x) ∋ f(t) with Phi(v) = sum_j theta_j(|H_j v|), unit mass.

    Attributes:
        x: the position symbols (n).
        potential: g(x), convex; fabs, fmax, norm_2 and if_else(condition, g, inf) are understood as what they are.
        friction: theta(s) for isotropic friction theta(|v|), or {name: (H_j, theta_j(s))}; t and inputs may stand in it, as in
            mu N(t) s.
        s: the symbol of theta's argument.
        damping: M (n, n) with M + M' >= 0, a linear part of the friction operator; left out: none.
        force: f, n expressions of t; left out: 0, as in the paper. A constant one is made a part of g: g(x) - <f, x>.
        constraints: {name: c(x)}, kept >= 0, concave: the domain of g.
        x0, v0: position and velocity at t = 0 (v0 left out: 0): the older position is x0 - h v0; or
        x0, x1: the two positions that start the paper's recursion: rows 0 and 1 of the run.

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN, a constant theta, a term of g that is not convex by its sign.
    """

    x: Any
    potential: Any = 0
    friction: Any = None
    s: Any = None
    damping: Any = None
    force: Any = None
    constraints: Any = None
    x0: Any
    v0: Any = None
    x1: Any = None

    potential_split: ConvexSplit = field(init=False, repr=False)
    elements: tuple[Friction, ...] = field(init=False, repr=False)
    constraint_names: tuple[str, ...] = field(init=False, repr=False)

    paper: ClassVar[str] = "Cabot, Discretization of a nonlinear oscillator under dry friction (2004)"
    schemes: ClassVar[tuple[str, ...]] = ("inertial proximal",)
    has: ClassVar[Mapping[str, str]] = {"v": "the velocity"}
    second_order: ClassVar[bool] = True
    law_descriptions: ClassVar[Mapping[str, tuple[str, StateNames]]] = {
        "relay": ("friction", {-1: ("lower", "slip (y > 0)"), 0: ("zero", "stick (y = 0)"), 1: ("upper", "slip (y < 0)")}),
        "ball": ("isotropic friction", {0: ("zero", "stick (y = 0)"), 1: ("upper", "slip (l on the sphere)")}),
    }
    of_time: ClassVar[str] = (
        "time and inputs stand in force= and friction=, and there alone: section 2.2 of the guide. Where a spring or a wall "
        "moves with time, write a LureSystem or FirstOrderSystem of position and velocity"
    )

    def _declare(self) -> None:
        c = self._declare_symbols("x", x=self.x, s=self.s)
        n = len(self.names)
        if self.v0 is not None and self.x1 is not None:
            raise ModelError("v0 and x1 are both given; keep v0 (a velocity) or x1 (the second position)")
        potential = self._read_vector(c, self.potential, "potential", 1, [self.x])
        constraints, names = self._named_constraints(c, self.constraints, [self.x])
        damping = self.damping
        if damping is not None:
            damping = self._read_matrix(c, damping, "damping", (n, n), f"as there are {n} states")
        force = self._read_vector(c, 0 if self.force is None else self.force, "force", n, [self.t])
        if not force.is_zero() and not ca.depends_on(force, ca.vertcat(self.t, self.u)):
            potential, force = potential - ca.dot(force, self.x), ca.SX.zeros(n)
        self._set(
            potential=potential,
            force=force,
            potential_split=split_convex(potential, self.x, "potential"),
            elements=tuple(self._elements(c, n)),
            damping=damping,
            constraints=constraints,
            constraint_names=tuple(names),
            x0=self._read_start(c, self.x0, "x0", n),
            v0=None if self.x1 is not None else self._read_start(c, 0 if self.v0 is None else self.v0, "v0", n),
            x1=None if self.x1 is None else self._read_start(c, self.x1, "x1", n),
        )

    @property
    def is_forced(self) -> bool:
        """Whether a force or a friction that moves with time acts: the theorems are about oscillators left to themselves."""
        return not self.force.is_zero() or any(self.is_friction_moving(element) for element in self.elements)

    def is_friction_moving(self, element: Friction) -> bool:
        """Whether a friction element moves with time."""
        return ca.depends_on(element.theta, ca.vertcat(self.t, self.u))

    @property
    @cached_per_object
    def keeps_velocity(self) -> bool:
        """Whether the velocity goes on where steps change, as they do at edges and ticks, whatever reads them."""
        return self.is_forced or bool(self.u.numel())

    @property
    def row_names(self) -> tuple[str, ...]:
        """Those of the constraints and of the friction elements."""
        return (*self.constraint_names, *self.constraints, *(element.name for element in self.elements))

    @property
    def tied_to_step(self) -> bool:
        """Where x1 is given: a step after x0."""
        return self.x1 is not None

    def _elements(self, c: Any, n: int) -> list[Friction]:
        given = {} if self.friction is None else self.friction
        if not isinstance(given, Mapping):
            given = {"friction": (ca.SX.eye(n), given)}
        if given and (self.s is None or self.s.numel() != 1):
            raise ModelError("friction: theta is a function of one scalar symbol; declare it with s=")
        elements = []
        for name, item in given.items():
            label = f"friction '{name}'"
            if not isinstance(item, tuple | list) or len(item) != 2:
                raise ModelError(f"{label}: expected a pair (H, theta), H with {n} columns, not {describe_argument(item)}")
            H = ca.densify(ca.SX(c.convert(item[0], f"{label} H")))
            H = H.T if H.shape[1] == 1 and n != 1 else H
            if H.shape[1] != n or H.shape[0] == 0:
                raise ModelError(f"{label}: H has shape {H.shape}; expected (m, {n}), one column for each state")
            self._check_symbols(H, f"{label} H", [])
            check_finite(H, f"{label} H")
            theta = self._read_vector(c, item[1], f"{label} theta", 1, [self.s, self.t])
            if not ca.depends_on(theta, self.s):
                raise ModelError(f"{label}: theta = {theta} does not depend on s = {self.s}; for Coulomb friction write mu*s")
            elements.append(Friction(str(name), H, theta))
        return elements
