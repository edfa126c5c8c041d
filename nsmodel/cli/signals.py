"""What Ctrl-C and SIGTERM do to a command."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

EXIT_INTERRUPTED, EXIT_TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command as Ctrl-C does."""

    signal = signal.SIGTERM


@contextlib.contextmanager
def handled_signals() -> Iterator[None]:
    """SIGTERM raises Terminated; afterwards signals do what they did before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, frame: Any) -> None:
        raise Terminated

    if usual[signal.SIGTERM] is not signal.SIG_IGN:
        signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


def ignore_signals() -> None:
    """One more Ctrl-C would cost what is being saved."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def signal_exit_status(stop: BaseException | None) -> int:
    """The exit status of an interruption: that of the first signal among what led to it."""
    while stop is not None and not hasattr(stop, "signal"):
        stop = stop.__context__
    return 128 + getattr(stop, "signal", signal.SIGINT)
