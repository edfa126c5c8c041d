"""Signals: known functions of time that drive a model, with the times at which they jump or bend."""

from nsmodel.modeling.signals.base import Signal, Within, within
from nsmodel.modeling.signals.function import signal
from nsmodel.modeling.signals.pwm import pwm
from nsmodel.modeling.signals.table import steps, table

__all__ = ["Signal", "Within", "pwm", "signal", "steps", "table", "within"]
