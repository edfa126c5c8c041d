"""What a run of an oscillator looks at before it starts: its laws and where it starts, the convexity of theta and of g."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.oscillator.model import Friction, FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import at_end, slope_at_zero
from nsmodel.errors import UsageError
from nsmodel.hypotheses.quick import concave, inside, not_psd, refuse_outside, refuse_weights, weights, with_values

SPEEDS = np.concatenate([[0.0], np.logspace(-6, 3, 60)])  # Where theta' and theta'' are sampled.


def refuse_start(model: FrictionOscillator) -> None:
    """Refuse theta'(0) < 0, weights < 0, and positions outside dom g."""
    for element in _at_start(model):
        slope = float(ca.DM(slope_at_zero(element, model.s)))
        if not 0 <= slope < np.inf:
            raise UsageError(
                f"friction '{element.name}': theta = {element.theta} has theta'(0) = {slope:g}{with_values(model)}; "
                "the friction force at rest must be a finite number >= 0"
            )
    refuse_weights(model.potential_split, "potential", model)
    c, domain = _kept(model)
    names = (*model.constraint_names, *(f"potential: {row} >= 0" for row in domain))
    for label in _starts(model):
        refuse_outside(c, names, model, label)


def admitted(model: FrictionOscillator) -> list[ca.SX]:
    """That, of all values of the parameters."""
    slopes = [slope_at_zero(element, model.s) for element in model.elements]
    return [*slopes, weights(model.potential_split), *(inside(_kept(model)[0], model, label) for label in _starts(model))]


def _kept(model: FrictionOscillator) -> tuple[ca.SX, list[ca.SX]]:
    """What positions keep >= 0: constraints, then the domain of the potential; and the latter."""
    domain = [row for rows in model.potential_split.domain for row in ca.vertsplit(rows)]
    return ca.vertcat(ca.SX(0, 1), *model.constraints.values(), *domain), domain


def _starts(model: FrictionOscillator) -> tuple[str, ...]:
    return ("x0", "x1") if model.x1 is not None else ("x0",)


def warnings(model: FrictionOscillator) -> list[str]:
    """Where theta, the damping or g is not what the theory asks for."""
    found = []
    for element in _at_start(model):
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
        found += not_psd("damping", model.damping)
    return found + concave(model.potential_split.smooth, model.x, x0, "the potential is not convex at x0")


def _at_start(model: FrictionOscillator) -> tuple[Friction, ...]:
    return at_end(model, ca.SX(0), model.u)
