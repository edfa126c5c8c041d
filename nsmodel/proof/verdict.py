"""The four verdicts, and an answer to a question with its reason.

What may be missing in general and is there where it is asked for.

Silence for solvers that print from C.

CasADi functions called on the memory of arrays: many times as fast as with CasADi's own matrices.

What falls apart: connected parts of a graph, sets that share no members.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

HOLDS, SAMPLED, VIOLATED, UNKNOWN = "holds", "sampled", "violated", "unknown"
VERDICTS = (HOLDS, SAMPLED, VIOLATED, UNKNOWN)  # from proved to undecided


class HypothesisPart(NamedTuple):
    """One part of a hypothesis: verdict, reason, numbers, witness; ``local``: decided on the box looked at alone."""

    verdict: str
    how: str
    value: dict[str, float]
    witness: dict[str, Any]
    local: bool = False


T = TypeVar("T")


def not_none(value: T | None) -> T:
    """Return the value; LookupError where it is missing, which is a defect of the caller."""
    if value is None:
        raise LookupError("a value that was to be there is missing")
    return value


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


def attach_buffers(
    function: ca.Function, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
) -> tuple[Any, Callable[[], None]]:
    """Return (buffer, call): the call reads and writes these arrays, columns first, as long as the buffer lives."""
    buffer, call = function.buffer()
    for i, array in enumerate(inputs):
        buffer.set_arg(i, memoryview(array.reshape(-1, order="F")))  # pyrefly: ignore[bad-argument-type, missing-argument]
    for i, array in enumerate(outputs):
        buffer.set_res(i, memoryview(array.reshape(-1, order="F")))  # pyrefly: ignore[bad-argument-type, missing-argument]
    return buffer, call


class BufferedFunction:
    """A function with arrays of its own: ``run()`` reads ``inputs``, columns as 1-D, and writes ``outputs``, all 2-D."""

    def __init__(self, function: ca.Function) -> None:
        sizes = [function.size_in(i) for i in range(function.n_in())]
        self.inputs = [np.zeros(size[0] if size[1] == 1 else size, order="F") for size in sizes]
        self.outputs = [np.zeros(function.size_out(i), order="F") for i in range(function.n_out())]
        self._buffer, self.run = attach_buffers(function, self.inputs, self.outputs)

    def __call__(self, *values: Any) -> list[np.ndarray]:
        """The outputs at these inputs; the next call overwrites them."""
        for array, value in zip(self.inputs, values, strict=True):
            array[:] = value
        self.run()
        return self.outputs


def connected_components(pattern: np.ndarray) -> list[list[int]]:
    """Return the connected parts of a graph, given by its symmetric pattern (n, n) of edges.

    >>> connected_components(np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]]))
    [[0, 2], [1]]
    """
    pattern = np.asarray(pattern, bool)
    left, parts = set(range(len(pattern))), []
    while left:
        part, front = set(), {min(left)}
        while front:
            part |= front
            front = {int(j) for i in front for j in np.flatnonzero(pattern[i])} - part
        parts.append(sorted(part))
        left -= part
    return parts


def overlapping_groups(sets: Sequence[set[int]]) -> list[list[int]]:
    """Return groups of indices of sets that share members, directly or through others.

    >>> overlapping_groups([{1, 2}, {3}, {2, 4}])
    [[1], [0, 2]]
    """
    groups: list[tuple[set[int], list[int]]] = []
    for k, own in enumerate(sets):
        members, rows, separate = set(own), [k], []
        for others, indices in groups:
            if others & own:
                members, rows = members | others, indices + rows
            else:
                separate.append((others, indices))
        groups = [*separate, (members, rows)]
    return [sorted(rows) for _, rows in groups]
