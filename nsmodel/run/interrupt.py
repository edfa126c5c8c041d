"""Signals that wait for the end of a step, and the bar that shows how far a run is."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from nsmodel.notebook import has_live_display, in_notebook


class PendingSignals(list[float]):
    """The times at which signals came, and the number of the last; once ``patient`` no signal raises."""

    number = signal.SIGINT
    patient = False


@contextlib.contextmanager
def deferred_signals() -> Iterator[PendingSignals]:
    """Ctrl-C and SIGTERM inside put their time into the list instead of cutting a step in two; one more a second later raises.

    Outside the main thread signals are not for us. Whatever was to be done with them before is so again afterwards.
    """
    signals = PendingSignals()
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return

    def record_signal(number: int, frame: Any) -> None:
        signals.append(time.monotonic())
        signals.number = signal.Signals(number)
        if signals[-1] - signals[0] > 1 and not signals.patient:
            raise KeyboardInterrupt

    taken = [signal.SIGINT] if signal.getsignal(signal.SIGTERM) is signal.SIG_IGN else [signal.SIGINT, signal.SIGTERM]
    usual = {number: signal.signal(number, record_signal) for number in taken}
    try:
        yield signals
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler or signal.SIG_DFL)


def progress_bar(**options: Any) -> Any:
    """A bar on standard error that leaves nothing behind; None where that is neither a terminal nor a notebook's.

    In a notebook it is a widget where ipywidgets is installed, else text.
    """
    if not has_live_display():
        return None
    widgets = in_notebook() and find_spec("ipywidgets") is not None
    tqdm: Any = import_module("tqdm.notebook" if widgets else "tqdm").tqdm
    return tqdm(delay=1.0, leave=False, dynamic_ncols=True, **options)
