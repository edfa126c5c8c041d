"""CasADi functions called on the memory of arrays: many times as fast as with CasADi's own matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np


def attach_buffers(
    function: ca.Function, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
) -> tuple[Any, Callable[[], None]]:
    """Return (buffer, call): the call reads and writes these arrays, columns first, as long as the buffer lives."""
    buffer, call = function.buffer()
    for i, array in enumerate(inputs):
        buffer.set_arg(i, memoryview(array.reshape(-1, order="F")))  # pyright: ignore[reportCallIssue, reportArgumentType]
    for i, array in enumerate(outputs):
        buffer.set_res(i, memoryview(array.reshape(-1, order="F")))  # pyright: ignore[reportCallIssue, reportArgumentType]
    return buffer, call
