"""The derivatives g_l, h_l and h_x of a problem: numbers where they are constant, else at a point of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from nsmodel.proof.buffered import attached


def numbers(matrix: ca.SX, moving: ca.SX) -> np.ndarray | None:
    """The matrix, where it depends on nothing that moves."""
    return None if ca.depends_on(matrix, moving) else np.array(ca.DM(ca.densify(ca.cse(matrix)))).reshape(matrix.shape)


def at_points(slopes: ca.Function) -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """``at(t, x, l)`` of a function with three outputs: arrays that the next call overwrites."""
    arrays = [np.zeros(slopes.numel_in(i)) for i in range(3)]
    out = [np.zeros(slopes.size_out(i), order="F") for i in range(3)]
    buffer, call = attached(slopes, arrays, out)

    def at(*values: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for array, given in zip(arrays, values, strict=True):
            array[:] = given
        call()
        return out[0], out[1], out[2]

    at.buffer = buffer  # pyright: ignore[reportFunctionMemberAccess]
    return at
