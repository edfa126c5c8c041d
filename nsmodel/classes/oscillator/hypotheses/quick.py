"""What a run of an oscillator looks at before it starts: its laws and where it starts, the convexity of theta and of g."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.oscillator.model import Friction, FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import elements_at_end, slope_at_zero
from nsmodel.errors import UsageError
from nsmodel.solvers.initial_checks import (
    check_start_inside,
    check_term_weights,
    convexity_warning,
    parameter_values_text,
    psd_warning,
    start_margin,
    symbolic_term_weights,
)

CHECK_SPEEDS = np.concatenate([[0.0], np.logspace(-6, 3, 60)])  # Where theta' and theta'' are sampled.


def check_start(model: FrictionOscillator) -> None:
    """Refuse theta'(0) < 0, weights < 0, and positions outside dom g."""
    for element in _elements_at_start(model):
        slope = float(ca.DM(slope_at_zero(element, model.s)))
        if not 0 <= slope < np.inf:
            raise UsageError(
                f"friction '{element.name}': theta = {element.theta} has theta'(0) = {slope:g}{parameter_values_text(model)}; "
                "the friction force at rest must be a finite number >= 0"
            )
    check_term_weights(model.potential_split, "potential", model)
    c, domain = _position_constraints(model)
    names = (*model.constraint_names, *(f"potential: {row} >= 0" for row in domain))
    for label in _start_labels(model):
        check_start_inside(c, names, model, label)


def admitted(model: FrictionOscillator) -> list[ca.SX]:
    """That, of all values of the parameters."""
    slopes = [slope_at_zero(element, model.s) for element in model.elements]
    return [
        *slopes,
        symbolic_term_weights(model.potential_split),
        *(start_margin(_position_constraints(model)[0], model, label) for label in _start_labels(model)),
    ]


def _position_constraints(model: FrictionOscillator) -> tuple[ca.SX, list[ca.SX]]:
    """What positions keep >= 0: constraints, then the domain of the potential; and the latter."""
    domain = [row for rows in model.potential_split.domain for row in ca.vertsplit(rows)]
    return ca.vertcat(ca.SX(0, 1), *model.constraints.values(), *domain), domain


def _start_labels(model: FrictionOscillator) -> tuple[str, ...]:
    return ("x0", "x1") if model.x1 is not None else ("x0",)


def warnings(model: FrictionOscillator) -> list[str]:
    """Where theta, the damping or g is not what the theory asks for."""
    found = []
    for element in _elements_at_start(model):
        slope = ca.gradient(element.theta, model.s)
        f = ca.Function("theta", [model.s], [slope, ca.gradient(slope, model.s)])
        first, second = (np.array(v).ravel() for v in f.map(CHECK_SPEEDS.size)(CHECK_SPEEDS[None, :]))
        if np.nanmin(first) < 0:
            s = CHECK_SPEEDS[int(np.nanargmin(first))]
            found.append(f"theta of '{element.name}' decreases: theta'({s:.3g}) = {np.nanmin(first):.3g} < 0")
        if np.nanmin(second) < -1e-12 * np.nanmax(np.abs(first)):
            s = CHECK_SPEEDS[int(np.nanargmin(second))]
            found.append(f"theta of '{element.name}' is not convex: theta''({s:.3g}) = {np.nanmin(second):.3g} < 0")
    x0 = np.array(ca.DM(model.x0)).ravel()
    if model.damping is not None:
        found += psd_warning("damping", model.damping)
    return found + convexity_warning(model.potential_split.smooth, model.x, x0, "the potential is not convex at x0")


def _elements_at_start(model: FrictionOscillator) -> tuple[Friction, ...]:
    return elements_at_end(model, ca.SX(0), model.u)
