"""What a run of a first-order system looks at before it starts: its law."""

from __future__ import annotations

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.hypotheses.quick import refuse_law


def refuse_start(model: FirstOrderSystem) -> None:
    """Refuse a law that the parameters made empty."""
    refuse_law(model.law, model)


def warnings(model: FirstOrderSystem) -> list[str]:
    """Nothing beside what the step shows."""
    return []
