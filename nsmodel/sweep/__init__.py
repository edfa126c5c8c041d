"""Sweeps: a model run many times (`run`), what becomes of its cells (`result`, `variable`), statistics over them."""

from typing import TYPE_CHECKING

from nsmodel._utils import lazy_attributes as _later

if TYPE_CHECKING:
    from nsmodel.sweep.result import Sweep
    from nsmodel.sweep.run import SweepInterrupted, sweep
    from nsmodel.sweep.statistics import Quantile, Share, Statistics, difference, share, statistics
    from nsmodel.sweep.variable import Variable

__all__ = [
    "Quantile", "Share", "Statistics", "Sweep", "SweepInterrupted", "Variable", "difference", "share", "statistics", "sweep",
]  # fmt: skip

_later(
    __name__,
    {
        "nsmodel.sweep.result": ["Sweep"],
        "nsmodel.sweep.run": ["SweepInterrupted", "sweep"],
        "nsmodel.sweep.statistics": ["Quantile", "Share", "Statistics", "difference", "share", "statistics"],
        "nsmodel.sweep.variable": ["Variable"],
    },
)
