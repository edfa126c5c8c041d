"""Lur'e systems: what the class brings to the rest of the package."""

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
    from nsmodel.models.lure_system.model import LureSystem

    return LureSystem


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.models.lure_system import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "theta-gamma": Scheme(one_step_problem=schemes.one_step_problem, initial_rows=schemes.initial_rows),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.lure_system import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=schemes.check_start, warnings=schemes.warnings, admitted=schemes.admitted)


def impact_structure() -> Callable[[Any], ImpactStructure | None]:
    """Return the system in which impacts are looked for."""
    from nsmodel.models.lure_system.schemes import impact_system

    return impact_system


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.models.lure_system import schemes

    return schemes.continuous_problem


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.lure_system import check, inputs_and_parameters, symbolic
    from nsmodel.models.lure_system import check as twins

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
        ),
        symbolic=symbolic.symbolic_findings,
        compares_solutions=True,
        compare_runs=twins.compare_runs,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.lure_system import documents

    return documents.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.models.lure_system import documents

    return CertificateParts(stated=documents.STATED, subject=documents.subject, proofs=documents.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.models.lure_system import reference_steps
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(
        residuals=reference_steps.residuals,
        acting=reference_steps.acting,
        in_units=reference_steps.in_units,
        states_before_step=reference_steps.states,
    )
