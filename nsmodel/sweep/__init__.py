"""Sweeps: a quantity over many cells (`variable`), its statistics over them."""

from typing import TYPE_CHECKING

from nsmodel.later import later as _later

if TYPE_CHECKING:
    from nsmodel.sweep.shares import Share, share
    from nsmodel.sweep.statistics import Quantile, Statistics, difference, statistics
    from nsmodel.sweep.variable import Variable

__all__ = ["Quantile", "Share", "Statistics", "Variable", "difference", "share", "statistics"]

_later(
    __name__,
    {
        "nsmodel.sweep.shares": ["Share", "share"],
        "nsmodel.sweep.statistics": ["Quantile", "Statistics", "difference", "statistics"],
        "nsmodel.sweep.variable": ["Variable"],
    },
)
