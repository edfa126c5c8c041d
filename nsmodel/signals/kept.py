"""Values that blocks set as a run goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nsmodel.signals.signal import Held, Signal


@dataclass(frozen=True, eq=False)
class Kept(Held):
    """The entry of an input that the block ``by`` sets; until a run says what it is, 0."""

    name: str
    by: str
    few: int | None = None

    @property
    def values_taken(self) -> int | None:
        """Those that the block names."""
        return self.few

    def within(self, t_end: float) -> None:
        """Not known."""

    def holding(self, kept: Mapping[str, np.ndarray]) -> Signal:
        """What is held now."""
        return Held(kept[self.name])
