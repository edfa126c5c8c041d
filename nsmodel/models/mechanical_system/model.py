"""Mechanical systems with contacts, impacts, Coulomb friction and joints (Moreau 1988)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.conversion import Converter, declare
from nsmodel.modeling.laws import Law, complementarity, coulomb, equality, product
from nsmodel.modeling.parameters import describe_argument, numbered_row_names

ACTIVATIONS = ("free", 0, 0.5, 1, 1.5)
RESTITUTIONS = ("approach", "newton")
GEOMETRIES = ("begin", "middle", "end")
INERTIAS = ("derived", "given")


@dataclass(frozen=True)
class Contact:
    """A unilateral contact of a `MechanicalSystem`.

    Attributes:
        gap: g(t, q), kept >= 0.
        slip: the slip velocity in the plane of contact, 1 or 2 expressions of t, q and v, affine in v; left out: no friction.
        mu: the coefficient of friction, >= 0, a number or an expression of parameters, t and inputs.
        e: Newton's coefficient of restitution, in [0, 1].
        e_t: that of the slip, in [-1, 1].
    """

    gap: Any
    slip: Any = None
    mu: Any = 0.0
    e: Any = 0.0
    e_t: Any = 0.0


class ContactTerms(NamedTuple):
    """A contact as a system has it: expressions of t, q and v in the symbols of the model."""

    name: str
    gap: ca.SX
    slip: ca.SX
    mu: ca.SX
    e: ca.SX
    e_t: ca.SX

    @property
    def law(self) -> Law:
        """The law of (P_N, P_T)."""
        return coulomb(self.mu, slip=self.slip.numel()) if self.slip.numel() else complementarity(1)

    @property
    def rows(self) -> tuple[str, ...]:
        """The names of its impulses: of P_N its own, of P_T "name slip"."""
        return (self.name, *numbered_row_names(f"{self.name} slip", self.slip.numel())) if self.slip.numel() else (self.name,)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class MechanicalSystem(Model):
    """M(q) dv = F(t, q, v) dt + sum_a G_a' dP_a + J' dL, q' = v, with 0 <= g_a(t, q), c(t, q) = 0, in measures (Moreau 1988).

    Where g_a = 0: 0 <= u_N+ + e u_N- ⟂ P_N >= 0 (Newton), |P_T| <= mu P_N, P_T = -mu P_N u_T/|u_T| where u_T != 0 (Coulomb).

    Attributes:
        q, v: the symbols of positions (n) and velocities (nv).
        M: the mass matrix (nv, nv), of q, symmetric and positive definite.
        F: the forces, nv expressions of t, q and v; left out: 0.
        potential: V(t, q), the forces of which, -dV/dq, are added to F; it counts in the energy.
        contacts: {name: `Contact`}.
        joints: {name: c(t, q)}, each a scalar or a column kept at 0.
        q0, v0: positions and velocities at t = 0; v0 left out: 0.
        inertia: of a mass matrix that depends on q: "derived", its gyroscopic terms are derived and F is the forces alone;
            "given", F has them. Where F is quadratic in v, it must be said.
        kinematics: T(q) (n, nv) with q' = T(q) v, where velocities are no derivatives of positions.
        theta: weight of the forces at the end of a step, in [1/2, 1].
        project: whether positions are put back on the contacts and joints after each step.
        activation: which contacts act in a step: "free", those that a step free of them would close; or a number a:
            those with g(t + a h, q + a h v) <= tol_g.
        restitution: "approach", e acts on velocities of approach alone; "newton", on all.
        geometry: where M and the directions of contacts are taken: at the "begin", "middle" or "end" of a step; with "end" the
            velocity before an impact is that in the directions of the begin.
        tol_g: a gap up to which a contact counts as closed, in the unit of gaps; left out: 1e-10 of the largest gap so far.

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN, M that is not symmetric, slip that is not affine in v, e or mu out of
            their range.
    """

    q: Any
    v: Any
    M: Any
    F: Any = None
    potential: Any = 0
    contacts: Mapping[str, Contact] = field(default_factory=dict)
    joints: Mapping[str, Any] = field(default_factory=dict)
    q0: Any
    v0: Any = None
    inertia: str | None = None
    kinematics: Any = None
    theta: float = 0.5
    project: bool = True
    activation: Any = "free"
    restitution: str = "approach"
    geometry: str = "middle"
    tol_g: float | None = None

    x: ca.SX = field(init=False, repr=False)
    x0: ca.SX = field(init=False, repr=False)
    contact_rows: tuple[ContactTerms, ...] = field(init=False, repr=False)
    law: Law = field(init=False, repr=False)
    joint_names: tuple[str, ...] = field(init=False, repr=False)

    paper: ClassVar[str] = "Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988); Jean (1999)"
    schemes: ClassVar[tuple[str, ...]] = ("moreau-jean",)
    gaps: ClassVar[bool] = False
    has: ClassVar[Mapping[str, str]] = {
        "u_N": "the normal velocities", "u_T": "the slip velocities", "acting": "which contacts act",
        "missed": "which contacts close in a step in which they do not act",
        "impulse_work": "the work of each contact in a step", "penetration": "the penetration of each contact",
    }  # fmt: skip
    refuses: ClassVar[Mapping[str, str]] = {
        "study": "is a mechanical system, for which no second scheme is written down yet; compare runs of simulate(step=...)",
        "stress": "is a mechanical system, for which no second scheme is written down yet",
        "certificate": "is a mechanical system, whose hypotheses have no certificates yet",
        "--certificate": "is a mechanical system, whose hypotheses have no certificates yet",
        "rtol": "is a mechanical system, whose impacts are stepped over, not located; give step=, and halve it to see the error",
    }

    def _declare(self) -> None:
        n, nv = len(declare(self.q, "q").names), len(declare(self.v, "v").names)
        c = self._declare_symbols("x", x=[self.q, self.v])
        q, v = self.x[:n], self.x[n:]
        kinematics = None if self.kinematics is None else self._read_of_positions(c, "kinematics", self.kinematics, (n, nv), q)
        if kinematics is None and nv != n:
            raise ModelError(f"v: {nv} velocities for {n} positions; give kinematics=T(q), ({n}, {nv}), with q' = T(q) v")
        M = self._read_mass(c, q, nv)
        F = self._read_vector(c, 0 if self.F is None else self.F, "F", nv, [self.t, q, v])
        V = self._read_vector(c, self.potential, "potential", 1, [self.t, q])
        self._check_choices()
        contacts = self._read_contacts(c, q, v)
        joints, joint_names = self._named_constraints(c, self.joints, [self.t, q])
        rows = [*(one.name for one in contacts), *joint_names]
        if len(set(rows)) != len(rows) or set(rows) & set(self.names):
            twice = next(name for name in rows if rows.count(name) > 1 or name in self.names)
            raise ModelError(f"'{twice}' names two of the states, contacts and joints; give each its own name")
        self._set(
            q=q, v=v, M=M, F=F, potential=V, kinematics=kinematics, contact_rows=contacts,
            joints=MappingProxyType(joints), joint_names=tuple(joint_names),
            law=product(*(one.law for one in contacts), equality(len(joint_names))),
            inertia=self._chosen_inertia(M, F, q, v), stems=self._stems_of_parts(n, nv),
            x0=ca.vertcat(
                self._read_start(c, self.q0, "q0", n), self._read_start(c, 0 if self.v0 is None else self.v0, "v0", nv)
            ),
        )  # fmt: skip

    def _stems_of_parts(self, n: int, nv: int) -> Mapping[str, Any]:
        """The states by their own names, and all positions as q, all velocities as v."""
        parts = {"q": list(range(n)), "v": list(range(n, n + nv))}
        for name, own in parts.items():
            if name in self.stems and list(self.stems[name]) != own:
                raise ModelError(f"names: the state '{name}' clashes with run.{name}, which holds all of this kind; rename it")
        return MappingProxyType({**self.stems, **parts})

    def _check_choices(self) -> None:
        choices = (("activation", ACTIVATIONS), ("restitution", RESTITUTIONS), ("geometry", GEOMETRIES))
        for name, known in choices:
            if isinstance(getattr(self, name), bool) or getattr(self, name) not in known:
                raise ModelError(f"{name} = {getattr(self, name)!r}; expected one of {', '.join(map(repr, known))}")
        if isinstance(self.theta, bool) or not isinstance(self.theta, int | float) or not 0.5 <= self.theta <= 1:
            raise ModelError(f"theta = {self.theta!r}; expected a number in [1/2, 1]")
        if not isinstance(self.project, bool):
            raise ModelError(f"project = {self.project!r}; expected True or False")
        if self.tol_g is not None and not (isinstance(self.tol_g, int | float) and 0 <= self.tol_g < np.inf):
            raise ModelError(f"tol_g = {self.tol_g!r}; expected a number >= 0, in the unit of gaps")

    def _read_of_positions(self, c: Converter, label: str, value: Any, shape: tuple[int, int], q: ca.SX) -> ca.SX:
        matrix = ca.densify(ca.SX(c.convert(value, label)))
        if matrix.shape != shape:
            raise ModelError(f"{label}: shape {matrix.shape}; expected {shape}")
        self._check_symbols(matrix, label, [q])
        return matrix

    def _read_mass(self, c: Converter, q: ca.SX, nv: int) -> ca.SX:
        M = ca.SX(c.convert(self.M, "M"))
        M = M * ca.SX.eye(nv) if M.numel() == 1 else ca.diag(M) if 1 in M.shape and M.numel() == nv > 1 else M
        M = self._read_of_positions(c, "M", M, (nv, nv), q)
        for i in range(nv):
            for j in range(i):
                if not ca.simplify(M[i, j] - M[j, i]).is_zero() and not _is_equal_at_samples(M[i, j], M[j, i]):
                    raise ModelError(f"M: entry ({i}, {j}) is {M[i, j]}, and ({j}, {i}) is {M[j, i]}; a mass matrix is symmetric")
        return M

    def _chosen_inertia(self, M: ca.SX, F: ca.SX, q: ca.SX, v: ca.SX) -> str:
        if self.inertia is not None and self.inertia not in INERTIAS:
            raise ModelError(f"inertia = {self.inertia!r}; expected 'derived' or 'given'")
        moves, quadratic = ca.depends_on(M, q), ca.depends_on(ca.jacobian(F, v), v)
        if self.inertia is None and moves and quadratic:
            raise ModelError(
                "inertia: M depends on positions, and F on products of velocities; say inertia='given' where F has the "
                "gyroscopic terms of M, or 'derived' where F is the forces alone"
            )
        if self.inertia is None and moves and self.kinematics is not None:
            raise ModelError(
                "inertia: M depends on positions and q' = T(q) v; give F with its gyroscopic terms, and inertia='given'"
            )
        return self.inertia or ("derived" if moves else "given")

    def _read_contacts(self, c: Converter, q: ca.SX, v: ca.SX) -> tuple[ContactTerms, ...]:
        given = {} if self.contacts is None else self.contacts
        if not isinstance(given, Mapping):
            raise ModelError(f"contacts: {describe_argument(given)}; expected a dictionary {{name: Contact(gap, ...)}}")
        return tuple(self._read_contact(c, str(name), one, q, v) for name, one in given.items())

    def _read_contact(self, c: Converter, name: str, one: Any, q: ca.SX, v: ca.SX) -> ContactTerms:
        label = f"contact '{name}'"
        if not isinstance(one, Contact):
            raise ModelError(f"{label}: {describe_argument(one)}; expected Contact(gap, slip=, mu=, e=, e_t=)")
        gap = self._read_vector(c, one.gap, f"{label}: gap", 1, [self.t, q])
        slip = ca.SX(0, 1) if one.slip is None else ca.densify(ca.vec(ca.SX(c.convert(one.slip, f"{label}: slip"))))
        if slip.numel() > 2:
            raise ModelError(f"{label}: slip has {slip.numel()} rows; a contact has 1 in the plane and 2 in space")
        self._check_symbols(slip, f"{label}: slip", [self.t, q, v])
        if ca.depends_on(ca.jacobian(slip, v), v):
            raise ModelError(f"{label}: slip = {slip} is not affine in the velocities")
        mu, e, e_t = (
            self._read_number(c, f"{label}: {part}", getattr(one, part), [self.t] if part == "mu" else [], low, high)
            for part, low, high in (("mu", 0.0, np.inf), ("e", 0.0, 1.0), ("e_t", -1.0, 1.0))
        )
        if slip.numel() == 0 and not (mu.is_zero() and e_t.is_zero()):
            raise ModelError(f"{label}: mu or e_t is given without slip; give slip=, the velocity along the contact")
        return ContactTerms(name, gap, ca.SX(0, 1) if mu.is_zero() else slip, mu, e, e_t)

    def _read_number(self, c: Converter, label: str, value: Any, allow: list[ca.SX], low: float, high: float) -> ca.SX:
        """One number between two, or an expression."""
        found = ca.SX(c.convert(value, label))
        if found.numel() != 1:
            raise ModelError(f"{label}: {found.numel()} values; expected one, for this contact")
        self._check_symbols(found, label, allow)
        if found.is_constant() and not low <= float(found) <= high:
            raise ModelError(f"{label} = {float(found):g}; expected a number in [{low:g}, {high:g}]")
        return found

    @property
    def multiplier_names(self) -> tuple[str, ...]:
        """Those of the impulses of contacts, then of joints."""
        return (*(row for one in self.contact_rows for row in one.rows), *self.joint_names)


def applied_forces(model: MechanicalSystem) -> ca.SX:
    """F, and the forces of the potential."""
    pull = ca.gradient(model.potential, model.q)
    return model.F - (pull if model.kinematics is None else model.kinematics.T @ pull)


def _is_equal_at_samples(a: ca.SX, b: ca.SX) -> bool:
    """Whether two expressions have one value at a few points, up to rounding."""
    symbols = ca.veccat(*ca.symvar(ca.vertcat(a, b)))
    f = ca.Function("difference", [symbols], [a - b, ca.fabs(a) + ca.fabs(b)])
    points = np.random.default_rng(0).uniform(-1, 1, (symbols.numel(), 8))
    off, size = (np.array(part).ravel() for part in f.map(8)(points))
    return bool((np.abs(off) <= 1e-12 * size).all())
