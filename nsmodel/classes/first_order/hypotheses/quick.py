"""What a run of a first-order system looks at before it starts: its law."""

from __future__ import annotations

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.solvers.initial_checks import check_law_sets


def check_start(model: FirstOrderSystem) -> None:
    """Refuse a law that the parameters made empty."""
    check_law_sets(model.law, model)


def warnings(model: FirstOrderSystem) -> list[str]:
    """Nothing beside what the step shows."""
    return []
