"""Monotone inclusions: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.event_driven.problem import ContinuousProblem
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme
    from nsmodel.study.reference_steps import ReferenceStep


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.models.monotone_inclusion.model import MonotoneInclusion

    return MonotoneInclusion


def function_values() -> Callable[..., Sequence[Any]]:
    """Return the values by which its functions in Python are known."""
    from nsmodel.models.monotone_inclusion.model import values_of_functions

    return values_of_functions


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.models.monotone_inclusion import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "catching-up": Scheme(
            one_step_problem=schemes.catching_up_problem,
            initial_rows=schemes.initial_rows,
            kept_within=schemes.kept_within,
        ),
        "implicit": Scheme(
            one_step_problem=schemes.implicit_problem, initial_rows=schemes.initial_rows, kept_within=schemes.kept_within
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.monotone_inclusion import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=schemes.check_start, warnings=schemes.warnings, admitted=schemes.admitted)


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.models.monotone_inclusion import schemes

    return schemes.continuous_problem


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.monotone_inclusion import along_run, check, parameters
    from nsmodel.models.monotone_inclusion import check as driven
    from nsmodel.models.monotone_inclusion import check as pace

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along_run.class_findings_along_run,
        run_hypotheses=along_run.RUN_HYPOTHESES,
        uniform=UniformChecks(
            special_values=parameters.special_values,
            findings=check.uniform_findings,
            consequences=check.uniform_consequences,
        ),
        driven=DrivenChecks(
            fields=driven.DRIVEN_FIELDS,
            findings=driven.driven_findings,
            consequences=driven.driven_consequences,
            parametric_form=driven.parametric_model_and_region,
        ),
        compares_solutions=True,
        speed_bound=pace.speed_bound,
        stay_times=pace.stay_times,
        refined_runs=along_run.refinement_consequences,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.monotone_inclusion import documents

    return documents.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.models.monotone_inclusion import documents

    return CertificateParts(stated=documents.STATED, subject=documents.subject, proofs=documents.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.models.monotone_inclusion import reference_steps
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(residuals=reference_steps.residuals, acting=reference_steps.acting, in_units=reference_steps.in_units)
