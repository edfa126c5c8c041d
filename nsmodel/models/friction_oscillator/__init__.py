"""Oscillators with friction: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.event_driven.problem import ContinuousProblem
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.fixed_grid import EndOfRun
    from nsmodel.solvers.impacts import ImpactStructure
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme
    from nsmodel.study.reference_steps import ReferenceStep


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.models.friction_oscillator.model import FrictionOscillator

    return FrictionOscillator


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.models.friction_oscillator import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "inertial proximal": Scheme(
            one_step_problem=schemes.one_step_problem,
            initial_rows=schemes.initial_rows,
            symbolic_initial_rows=schemes.start_rows,
            symbolic_start_state=schemes.start_of,
            derived_columns=schemes.derived_columns,
            state_before_short_step=schemes.shortened,
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.friction_oscillator import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=schemes.check_start, warnings=schemes.warnings, admitted=schemes.admitted)


def impact_structure() -> Callable[[Any], ImpactStructure | None]:
    """Return the system in which impacts are looked for."""
    from nsmodel.models.friction_oscillator.schemes import impact_system

    return impact_system


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.models.friction_oscillator import schemes

    return schemes.continuous_problem


def end_of_run() -> EndOfRun:
    """Return what says whether a run has come to rest."""
    from nsmodel.models.friction_oscillator.finite_convergence import finite_convergence

    return finite_convergence


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.friction_oscillator import along_run, check, inputs_and_parameters

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along_run.class_findings_along_run,
        run_hypotheses=along_run.RUN_HYPOTHESES,
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
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.friction_oscillator import documents

    return documents.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.models.friction_oscillator import documents

    return CertificateParts(stated=documents.STATED, subject=documents.subject, proofs=documents.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.models.friction_oscillator import reference_steps
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(
        residuals=reference_steps.residuals,
        acting=reference_steps.acting,
        in_units=reference_steps.in_units,
        states_before_step=reference_steps.states,
    )
