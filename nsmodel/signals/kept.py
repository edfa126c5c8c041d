"""Values that blocks set as a run goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nsmodel.brief import short_repr
from nsmodel.later import former_names
from nsmodel.signals.bounds import Within
from nsmodel.signals.signal import ConstantSignal, Signal


@dataclass(frozen=True, eq=False)
class HeldSignal(ConstantSignal):
    """The entry of an input that the block ``by`` sets; until a run says what it is, 0."""

    name: str
    by: str
    few: tuple[float, ...] | None = None

    __repr__ = short_repr

    @property
    def values_taken(self) -> int | None:
        """How many values the block says that it takes."""
        return None if self.few is None else len(self.few)

    def within(self, t_end: float) -> Within | None:
        """Between the least and the largest of these, which ticks keep to; jumps are not known."""
        return None if self.few is None else Within(np.full(1, min(self.few)), np.full(1, max(self.few)), None, None)

    def holding(self, kept: Mapping[str, np.ndarray]) -> Signal:
        """What is held now."""
        return ConstantSignal(kept[self.name])


__getattr__ = former_names(__name__, Kept="HeldSignal")
