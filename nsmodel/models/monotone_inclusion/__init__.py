"""Monotone inclusions: what the class brings to the rest of the package."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nsmodel.hypotheses.framework import HypothesisChecks


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.monotone_inclusion import along_run, check, parameters

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along_run.class_findings_along_run,
        uniform=UniformChecks(
            special_values=parameters.special_values,
            findings=check.uniform_findings,
            consequences=check.uniform_consequences,
        ),
        driven=DrivenChecks(
            fields=check.DRIVEN_FIELDS,
            findings=check.driven_findings,
            consequences=check.driven_consequences,
            parametric_form=check.parametric_model_and_region,
        ),
        compares_solutions=True,
        speed_bound=check.speed_bound,
        stay_times=check.stay_times,
        refined_runs=along_run.refinement_consequences,
    )
