"""Monotone inclusions: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.event_driven.problem import ContinuousProblem
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme
    from nsmodel.study.reference_steps import ReferenceStep


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.classes.inclusion.model import MonotoneInclusion

    return MonotoneInclusion


def function_values() -> Callable[..., Sequence[Any]]:
    """Return the values by which its functions in Python are known."""
    from nsmodel.classes.inclusion.identity import values_of_functions

    return values_of_functions


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.classes.inclusion.schemes import catching_up, implicit
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "catching-up": Scheme(
            one_step_problem=catching_up.catching_up_problem,
            initial_rows=catching_up.initial_rows,
            kept_within=catching_up.kept_within,
        ),
        "implicit": Scheme(
            one_step_problem=implicit.implicit_problem, initial_rows=catching_up.initial_rows, kept_within=catching_up.kept_within
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.classes.inclusion.hypotheses import quick
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=quick.check_start, warnings=quick.warnings, admitted=quick.admitted)


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.classes.inclusion import continuous

    return continuous.continuous_problem


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.classes.inclusion.hypotheses import along, check, driven, for_all, pace, refined
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
            parametric_form=driven.parametric_model_and_region,
        ),
        compares_solutions=True,
        speed_bound=pace.speed_bound,
        refined_runs=refined.refinement_consequences,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.classes.inclusion import equations

    return equations.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.classes.inclusion import certificate

    return CertificateParts(stated=certificate.STATED, subject=certificate.subject, proofs=certificate.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.classes.inclusion import judge, units
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(residuals=judge.residuals, acting=judge.acting, in_units=units.in_units)
