"""Sweeping processes: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    from nsmodel.classes.sweeping.model import SweepingProcess

    return SweepingProcess


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.classes.sweeping.schemes import prediction_correction
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "prediction-correction": Scheme(
            one_step_problem=prediction_correction.one_step_problem,
            initial_rows=prediction_correction.initial_rows,
            symbolic_initial_rows=prediction_correction.start_rows,
            derived_columns=prediction_correction.derived_columns,
            kept_within=prediction_correction.kept_within,
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.classes.sweeping.hypotheses import quick
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(check_start=quick.check_start, warnings=quick.warnings, admitted=quick.admitted)


def continuous_problem() -> Callable[[Any], ContinuousProblem]:
    """Return what states it in continuous time."""
    from nsmodel.classes.sweeping import continuous

    return continuous.continuous_problem


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.classes.sweeping.hypotheses import along, check, driven, for_all, pace
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
            fields=driven.DRIVEN_FIELDS, findings=driven.driven_findings, consequences=driven.driven_consequences
        ),
        speed_bound=pace.speed_bound,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.classes.sweeping import equations

    return equations.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.classes.sweeping import certificate

    return CertificateParts(stated=certificate.STATED, subject=certificate.subject, proofs=certificate.proofs)


def reference_step() -> ReferenceStep:
    """Return its scheme a second time, and the class in other units."""
    from nsmodel.classes.sweeping import judge, units
    from nsmodel.study.reference_steps import ReferenceStep

    return ReferenceStep(residuals=judge.residuals, acting=judge.acting, in_units=units.in_units)
