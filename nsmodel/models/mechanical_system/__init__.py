"""Mechanical systems: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.models.mechanical_system.model import MechanicalSystem

    return MechanicalSystem


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its scheme."""
    from nsmodel.models.mechanical_system import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "moreau-jean": Scheme(
            one_step_problem=schemes.one_step_problem,
            initial_rows=schemes.initial_rows,
            symbolic_initial_rows=schemes.symbolic_initial_rows,
            symbolic_start_state=schemes.symbolic_start_state,
            derived_columns=schemes.derived_columns,
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.mechanical_system import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=schemes.check_start, warnings=schemes.warnings, admitted=schemes.admitted)


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.models.mechanical_system import check

    return HypothesisChecks(hypotheses=check.HYPOTHESES, decide=check.check)


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.mechanical_system import documents

    return documents.equations
