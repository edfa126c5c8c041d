"""First-order systems: what the class brings to the rest of the package."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nsmodel.hypotheses.framework import HypothesisChecks


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.first_order_system import check, inputs_and_parameters

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        stay_times=inputs_and_parameters.stay_times,
        uniform=UniformChecks(
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
