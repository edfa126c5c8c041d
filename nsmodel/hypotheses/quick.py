"""What a run says about hypotheses before it starts: cheap checks at the start, in words; a start outside the set is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.inclusion import set_valued
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import slope_at_zero
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.errors import UsageError
from nsmodel.model.base import Model
from nsmodel.solve.choose import Plan
from nsmodel.solve.structure import least_eigenvalue

UNIQUENESS = "uniqueness of the solution is not guaranteed"
DENSE = 1500  # Rows up to which a matrix is looked at with all its eigenvalues.
SPEEDS = np.concatenate([[0.0], np.logspace(-6, 3, 60)])  # Where theta' and theta'' are sampled.


def refuse_start(model: Model) -> None:
    """Refuse a start outside the set that the state must stay in (S-start), and laws that the parameters made empty.

    Raises:
        UsageError: names the constraint, its value and the start; the friction element; the term; the law's component.
    """
    _refuse_ends(model)
    if isinstance(model, SweepingProcess):
        _refuse(model.g, model.multiplier_names, model.t, model.q, model.q0, "q0")
    elif isinstance(model, MonotoneInclusion):
        c, names = set_valued.constraints(model)
        _refuse(c, names, model.t, model.x, model.x0, "x0")
    elif isinstance(model, FrictionOscillator):
        domain = [row for rows in model.potential_split.domain for row in ca.vertsplit(rows)]
        c = ca.vertcat(ca.SX(0, 1), *model.constraints.values(), *domain)
        names = (*model.constraint_names, *(f"potential: {row} >= 0" for row in domain))
        for label, start in (("x0", model.x0), ("x1", model.x1)):
            if start is not None:
                _refuse(c, names, model.t, model.x, start, label)


def _refuse_ends(model: Model) -> None:
    """Refuse lower > upper, a radius or weight < 0, theta'(0) < 0: with numbers for the parameters each has a sign."""
    values = getattr(model, "bound_parameters", {})
    given = " with " + ", ".join(f"{name} = {value:g}" for name, value in values.items()) if values else ""
    for element in getattr(model, "elements", ()):
        slope = float(ca.DM(slope_at_zero(element, model.s)))
        if not 0 <= slope < np.inf:
            raise UsageError(
                f"friction '{element.name}': theta = {element.theta} has theta'(0) = {slope:g}{given}; "
                "the friction force at rest must be a finite number >= 0"
            )
    split = getattr(model, "potential_split", getattr(model, "phi_split", None))
    for term in split.terms if split is not None else ():
        if term.weight.is_constant() and not 0 <= float(term.weight) < np.inf:
            raise UsageError(
                f"{'potential' if isinstance(model, FrictionOscillator) else 'phi'}: the term '{term.kind}' of {term.u} has the "
                f"weight {float(term.weight):g}{given}; a convex potential needs finite weights >= 0"
            )
    for block in model.law.blocks if getattr(model, "law", None) is not None else ():
        if why := block.refusal(given):
            raise UsageError(f"law: {why}")
    if isinstance(model, MonotoneInclusion):
        low, high = (np.array(ca.DM(ca.substitute(bound, model.t, 0))).ravel() for bound in (model.lower, model.upper))
        for i in np.flatnonzero(~(low < high)):
            raise UsageError(f"lower[{i}] = {low[i]:g}, upper[{i}] = {high[i]:g}{given}: C needs an interior, lower < upper")


def _refuse(g: ca.SX, names: tuple[str, ...], t: ca.SX, q: ca.SX, start: ca.SX, label: str) -> None:
    if not g.numel():
        return
    f = ca.Function("g", [t, q], [ca.densify(g), ca.densify(ca.jacobian(g, q))])
    q0 = np.array(ca.DM(start)).ravel()
    value, gradient = (np.array(v) for v in f(0, q0))
    value = value.ravel()
    size = np.linalg.norm(gradient, axis=1)
    for i in range(value.size):
        if not (np.isfinite(value[i]) and np.isfinite(size[i])):
            what = "value" if not np.isfinite(value[i]) else "gradient"
            raise UsageError(
                f"constraint '{names[i]}': its {what} at the start {label} = {_short(q0)} is not a finite number "
                "(a norm at 0, a root or division by 0?); move the start or rewrite the constraint"
            )
        if value[i] < -1e-10 * size[i] * np.linalg.norm(q0) - 1e-14:
            raise UsageError(
                f"constraint '{names[i]}' = {value[i]:.6g} < 0 at the start {label} = {_short(q0)}: the start is outside the "
                "set; move it to where every constraint is >= 0"
            )


def warnings_of(model: Model, plan: Plan) -> list[str]:
    """Return what the user should know before trusting uniqueness or convergence; an empty list where nothing was found."""
    found = []
    if isinstance(model, ManyBodies):
        return _of_families(model)
    if isinstance(model, SweepingProcess):
        found += _flat(model) + _not_convex(model)
    elif isinstance(model, FrictionOscillator):
        found += _friction(model)
    elif isinstance(model, LureSystem) and model.D.numel():
        found += _not_psd("D", model.D)
    if isinstance(model, LureSystem) and model.law is None:
        found += _concave(model.phi_split.smooth, model.y, np.zeros(model.y.numel()), "phi is not convex at y = 0")
    if not plan.monotone:
        found.append(
            f"the one-step problem is not monotone (least eigenvalue of W + W', scaled to 1: {plan.least_eigenvalue:.3g}): "
            + UNIQUENESS
        )
    return found


def _not_psd(name: str, matrix: ca.SX) -> list[str]:
    """A warning where a matrix is not psd: decided without unit, told in the user's own."""
    if matrix.is_zero():
        return []
    if matrix.shape[0] > DENSE:
        import scipy.sparse as sp
        from scipy.sparse.linalg import aslinearoperator

        M = ca.DM(matrix).sparse().tocsr()
        seen = np.flatnonzero(abs(M + M.T).sum(axis=1))
        M = M[seen][:, seen]
        d = 1 / np.sqrt(abs(M + M.T).max(axis=1).toarray().ravel() / 2)
        least = least_eigenvalue(aslinearoperator(sp.diags(d) @ M @ sp.diags(d)))
        return [f"{name} is not positive semidefinite (an eigenvalue, scaled, is at most {least:.3g})"] if least < 0 else []
    M = np.array(ca.DM(matrix))
    if least_eigenvalue(M) >= -1e-12:
        return []
    return [
        f"{name} is not positive semidefinite (least eigenvalue of its symmetric part {np.linalg.eigvalsh((M + M.T) / 2)[0]:.3g})"
    ]


def _flat(model: SweepingProcess) -> list[str]:
    """Constraints without gradient at q0: their linearisation is a number, and the scheme cannot use them."""
    gradient = ca.Function("G", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q))])
    G = np.array(gradient(0, np.array(ca.DM(model.q0)).ravel())).reshape(len(model.multiplier_names), len(model.names))
    flat = [name for name, row in zip(model.multiplier_names, G, strict=True) if not row.any()]
    return [f"constraint '{name}' has a zero gradient at q0: near there it acts on nothing" for name in flat[:5]]


def _of_families(model: ManyBodies) -> list[str]:
    """Of each family one member where the bodies start: has its constraint a gradient, and is it convex there."""
    found = []
    for name, family in model.constraints.items():
        others = [] if family.second is None else [family.second.symbols]
        q = ca.vertcat(family.first.q, family.second.q) if family.of_pairs else family.first.q
        H, slope = ca.hessian(family.g, q)
        f = ca.Function("H", [model.t, family.first.symbols, *others], [ca.densify(H), ca.densify(slope)])
        i, j = (0, int(family.of_pairs)) if family.over is None else family.over[0] if len(family.over) else (0, -1)
        if family.of_pairs and j >= model.bodies.count:
            continue
        given = [family.second.group.table[j]] if others else []
        H, slope = (np.array(value) for value in f(0, model.bodies.table[i], *given))
        label = f"constraint '{name} {i}'" if not others else f"constraint '{name} {i}-{j}'"
        if not slope.any():
            found.append(f"{label} has a zero gradient at q0: near there it acts on nothing")
        if np.isfinite(H).all() and (least := np.linalg.eigvalsh(H)[0]) < -1e-9 * np.abs(H).max():
            found.append(f"{label} is not convex at q0 (least eigenvalue of its Hessian {least:.3g}): feasibility may be lost")
    return found


def _not_convex(model: SweepingProcess) -> list[str]:
    """Constraints whose Hessian at q0 has a negative eigenvalue: the scheme's feasibility rests on convexity (S-convex)."""
    found, q0 = [], np.array(ca.DM(model.q0)).ravel()
    for name, g in zip(model.multiplier_names, ca.vertsplit(model.g), strict=True) if model.multiplier_names else ():
        own = [i for i, symbol in enumerate(ca.vertsplit(model.q)) if ca.depends_on(g, symbol)]
        gradient = ca.gradient(g, model.q[own]) if own else ca.SX(0, 1)
        if not own or not ca.depends_on(gradient, model.q[own]):
            continue
        f = ca.Function("H", [model.t, model.q], [ca.densify(ca.jacobian(gradient, model.q[own])), gradient])
        H, slope = (np.array(v) for v in f(0, q0))
        if not np.isfinite(H).all():
            continue
        least, distance = np.linalg.eigvalsh(H)[0], np.linalg.norm(q0)
        # A radius of curvature of 1e9 |q0| and more is round-off: a plane.
        if least < -1e-9 * max(np.abs(H).max(), np.linalg.norm(slope) / distance if distance else 0.0):
            found.append(
                f"constraint '{name}' is not convex at q0 (least eigenvalue of its Hessian {least:.3g}): feasibility may be lost"
            )
        if len(found) == 5:
            break
    return found


def _friction(model: FrictionOscillator) -> list[str]:
    found = []
    for element in model.elements:
        slope = ca.gradient(element.theta, model.s)
        f = ca.Function("theta", [model.s], [slope, ca.gradient(slope, model.s)])
        first, second = (np.array(v).ravel() for v in f.map(SPEEDS.size)(SPEEDS[None, :]))
        if np.nanmin(first) < 0:
            s = SPEEDS[int(np.nanargmin(first))]
            found.append(f"theta of '{element.name}' decreases: theta'({s:.3g}) = {np.nanmin(first):.3g} < 0")
        if np.nanmin(second) < -1e-12 * np.nanmax(np.abs(first)):
            s = SPEEDS[int(np.nanargmin(second))]
            found.append(f"theta of '{element.name}' is not convex: theta''({s:.3g}) = {np.nanmin(second):.3g} < 0")
    x0 = np.array(ca.DM(model.x0)).ravel()
    if model.damping is not None:
        found += _not_psd("damping", model.damping)
    return found + _concave(model.potential_split.smooth, model.x, x0, "the potential is not convex at x0")


def _concave(smooth: ca.SX, x: ca.SX, at: np.ndarray, what: str) -> list[str]:
    """A warning where the Hessian of ``smooth`` at a point has a negative eigenvalue."""
    if any(not ca.depends_on(x, symbol) for symbol in ca.symvar(smooth)):
        return []  # It contains the levels of nested terms: not a function of x alone.
    H = np.array(ca.Function("H", [x], [ca.hessian(smooth, x)[0]])(at))
    least = np.linalg.eigvalsh(H)[0] if np.isfinite(H).all() else 0.0
    return [f"{what} (least eigenvalue of its Hessian {least:.3g})"] if least < -1e-12 * np.abs(H).max() else []


def _short(values: np.ndarray) -> str:
    text = ", ".join(f"{v:.6g}" for v in values[:6])
    return f"({text}{', ...' if values.size > 6 else ''})"
