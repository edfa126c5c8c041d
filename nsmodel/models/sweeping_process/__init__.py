"""Sweeping processes: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    from nsmodel.models.sweeping_process.model import SweepingProcess

    return SweepingProcess


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.models.sweeping_process import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "prediction-correction": Scheme(
            one_step_problem=schemes.one_step_problem,
            initial_rows=schemes.initial_rows,
            symbolic_initial_rows=schemes.start_rows,
            derived_columns=schemes.derived_columns,
            kept_within=schemes.kept_within,
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.sweeping_process import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=schemes.check_start, warnings=schemes.warnings, admitted=schemes.admitted)


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.models.sweeping_process import schemes

    return schemes.continuous_problem


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.sweeping_process import check, inputs_and_parameters
    from nsmodel.models.sweeping_process import check as along

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along.class_findings_along_run,
        run_hypotheses=along.RUN_HYPOTHESES,
        uniform=UniformChecks(
            special_values=inputs_and_parameters.special_values,
            findings=inputs_and_parameters.uniform_findings,
            consequences=inputs_and_parameters.uniform_consequences,
        ),
        driven=DrivenChecks(
            fields=inputs_and_parameters.DRIVEN_FIELDS,
            findings=inputs_and_parameters.driven_findings,
            consequences=inputs_and_parameters.driven_consequences,
        ),
        speed_bound=inputs_and_parameters.speed_bound,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.sweeping_process import documents

    return documents.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.models.sweeping_process import documents

    return CertificateParts(stated=documents.STATED, subject=documents.subject, proofs=documents.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.models.sweeping_process import reference_steps
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(residuals=reference_steps.residuals, acting=reference_steps.acting, in_units=reference_steps.in_units)
