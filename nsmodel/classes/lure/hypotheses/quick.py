"""What a run of a Lur'e system looks at before it starts: its law, D and Phi."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.lure.model import LureSystem
from nsmodel.solvers.initial_checks import (
    check_law_sets,
    check_term_weights,
    convexity_warning,
    psd_warning,
    symbolic_term_weights,
)


def check_start(model: LureSystem) -> None:
    """Refuse weights < 0 of Phi, and a law that the parameters made empty."""
    if model.law is None:
        check_term_weights(model.phi_split, "phi", model)
    else:
        check_law_sets(model.law, model)


def admitted(model: LureSystem) -> list[ca.SX]:
    """The weights, of all values of the parameters; the law says itself whether it is empty."""
    return [symbolic_term_weights(model.phi_split)] if model.law is None else []


def warnings(model: LureSystem) -> list[str]:
    """Where D is not psd, or Phi not convex."""
    found = psd_warning("D", model.D) if model.D.numel() else []
    if model.law is None:
        found += convexity_warning(model.phi_split.smooth, model.y, np.zeros(model.y.numel()), "phi is not convex at y = 0")
    return found
