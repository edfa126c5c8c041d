"""First-order systems: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.event_driven.problem import ContinuousProblem
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.solvers.impacts import ImpactStructure
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme
    from nsmodel.study.reference_steps import ReferenceStep


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.models.first_order_system.model import FirstOrderSystem

    return FirstOrderSystem


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.models.first_order_system import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "theta-gamma": Scheme(one_step_problem=schemes.one_step_problem, initial_rows=schemes.initial_rows),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.first_order_system import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=schemes.check_start, warnings=schemes.warnings)


def impact_structure() -> Callable[[Any], ImpactStructure | None]:
    """Return the system in which impacts are looked for."""
    from nsmodel.models.first_order_system.schemes import impact_system

    return impact_system


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.models.first_order_system import schemes

    return schemes.continuous_problem


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.first_order_system import check, inputs_and_parameters

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        stay_times=inputs_and_parameters.stay_times,
        uniform=UniformChecks(
            special_values=inputs_and_parameters.special_values,
            findings=inputs_and_parameters.uniform_findings,
            consequences=inputs_and_parameters.uniform_consequences,
        ),
        driven=DrivenChecks(
            fields=inputs_and_parameters.DRIVEN_FIELDS,
            findings=inputs_and_parameters.driven_findings,
            consequences=inputs_and_parameters.driven_consequences,
            freeze_law=inputs_and_parameters.freeze_law,
            run_of_frozen_law=inputs_and_parameters.run_of_frozen_law,
            parametric_form=inputs_and_parameters.parametric_model_and_region,
        ),
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.first_order_system import documents

    return documents.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.models.first_order_system import documents

    return CertificateParts(stated=documents.STATED, subject=documents.subject, proofs=documents.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.models.first_order_system import reference_steps
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(
        residuals=reference_steps.residuals,
        acting=reference_steps.acting,
        in_units=reference_steps.in_units,
        states_before_step=reference_steps.states,
    )
