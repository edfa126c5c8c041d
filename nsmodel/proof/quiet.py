"""Silence for solvers that print from C."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

_OUTPUT_LOCK = threading.RLock()  # The descriptors are the process's.


@contextlib.contextmanager
def suppress_output() -> Iterator[None]:
    """Solvers print banners from C: send file descriptors 1 and 2 to nowhere while one runs; other threads wait to do so."""
    with _OUTPUT_LOCK:
        yield from _redirect_output()


def _redirect_output() -> Iterator[None]:
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    saved, null = [(fd, os.dup(fd)) for fd in (1, 2)], os.open(os.devnull, os.O_WRONLY)
    try:
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            for fd, _ in saved:
                os.dup2(null, fd)
            yield
    finally:
        for fd, copy in saved:
            os.dup2(copy, fd)
            os.close(copy)
        os.close(null)
