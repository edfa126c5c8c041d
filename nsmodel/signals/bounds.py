"""What is known of a signal: between which values it stays, how fast it moves at most, and where it jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nsmodel.brief import short_repr
from nsmodel.later import former_names
from nsmodel.pickled import Picklable


@dataclass(frozen=True, eq=False)
class Within(Picklable):
    """What `within` makes: bounds of an input, each a number for all of its values, or one for each (nu,).

    Attributes:
        low, high: between which its values stay.
        rate: of which its slope is at most; None: not known, it may jump.
        start: its values at t = 0; None: not known.
    """

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray | None
    start: np.ndarray | None

    __repr__ = short_repr

    @property
    def sizes(self) -> set[int]:
        """The numbers of values that are given."""
        given = (getattr(self, end) for end in SizedBounds._fields)
        return {part.size for part in given if part is not None and part.ndim}

    def of_size(self, size: int) -> SizedBounds:
        """As (size,) of each."""
        rate, start = (missing if part is None else part for part, missing in ((self.rate, np.inf), (self.start, np.nan)))
        return SizedBounds(*(np.broadcast_to(np.asarray(part, float), (size,)) for part in (self.low, self.high, rate, start)))


class SizedBounds(NamedTuple):
    """Bounds of each of the values of an input (nu,): a rate that is not known is inf, a start NaN."""

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray
    start: np.ndarray


class SignalJump(NamedTuple):
    """u(t-) and u(t+), (nu,) each."""

    t: float
    before: np.ndarray
    after: np.ndarray


__getattr__ = former_names(__name__, Ends="SizedBounds", Jump="SignalJump")
