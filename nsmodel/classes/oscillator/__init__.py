"""Oscillators with friction: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.event_driven.problem import ContinuousProblem
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.fixed_grid import EndOfRun
    from nsmodel.solvers.impacts import ImpactStructure
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme
    from nsmodel.study.reference_steps import ReferenceStep


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.classes.oscillator.model import FrictionOscillator

    return FrictionOscillator


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.classes.oscillator.schemes import inertial_proximal
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "inertial proximal": Scheme(
            one_step_problem=inertial_proximal.one_step_problem,
            initial_rows=inertial_proximal.initial_rows,
            symbolic_initial_rows=inertial_proximal.start_rows,
            symbolic_start_state=inertial_proximal.start_of,
            derived_columns=inertial_proximal.derived_columns,
            state_before_short_step=inertial_proximal.shortened,
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.classes.oscillator.hypotheses import quick
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=quick.check_start, warnings=quick.warnings, admitted=quick.admitted)


def impact_structure() -> Callable[[Any], ImpactStructure | None]:
    """Return the system in which impacts are looked for."""
    from nsmodel.classes.oscillator.hypotheses.impacts import impact_system

    return impact_system


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.classes.oscillator import continuous

    return continuous.continuous_problem


def end_of_run() -> EndOfRun:
    """Return what says whether a run has come to rest."""
    from nsmodel.simulation.finite_convergence import finite_convergence

    return finite_convergence


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.classes.oscillator.hypotheses import along, check, driven, for_all
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along.class_findings_along_run,
        run_hypotheses=along.RUN_HYPOTHESES,
        uniform=UniformChecks(
            special_values=for_all.special_values, findings=for_all.uniform_findings, consequences=for_all.uniform_consequences
        ),
        driven=DrivenChecks(
            fields=driven.DRIVEN_FIELDS,
            findings=driven.driven_findings,
            consequences=driven.driven_consequences,
            freeze_law=driven.freeze_law,
        ),
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.classes.oscillator import equations

    return equations.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.classes.oscillator import certificate

    return CertificateParts(stated=certificate.STATED, subject=certificate.subject, proofs=certificate.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.classes.oscillator import judge, study, units
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(residuals=judge.residuals, acting=judge.acting, in_units=units.in_units, states_before_step=study.states)
