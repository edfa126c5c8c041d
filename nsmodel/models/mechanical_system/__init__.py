"""Mechanical systems: what the class brings to the rest of the package."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nsmodel.hypotheses.framework import HypothesisChecks


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.models.mechanical_system import check

    return HypothesisChecks(hypotheses=check.HYPOTHESES, decide=check.check)
