"""Signals: known functions of time that drive a model, with the times at which they jump or bend."""

from nsmodel.signals.bounds import Within
from nsmodel.signals.function import signal
from nsmodel.signals.pwm import pwm
from nsmodel.signals.signal import Signal
from nsmodel.signals.steps import steps
from nsmodel.signals.table import table
from nsmodel.signals.within import within

__all__ = ["Signal", "Within", "pwm", "signal", "steps", "table", "within"]
