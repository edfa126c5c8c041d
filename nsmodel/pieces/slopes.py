"""The derivatives g_l, h_l and h_x of a problem: numbers where they are constant, else at a point of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from nsmodel.proof.buffered import attached


def numbers(matrix: ca.SX, moving: ca.SX) -> np.ndarray | None:
    """The matrix, where it depends on nothing that moves."""
    return None if ca.depends_on(matrix, moving) else np.array(ca.DM(ca.densify(ca.cse(matrix)))).reshape(matrix.shape)


def at_points(slopes: ca.Function) -> Callable[[Sequence[float]], None]:
    """``at(point)`` of a function with three outputs, which are the arrays ``at.out``: the next call overwrites them."""
    given = np.zeros(slopes.numel_in(0))
    out = [np.zeros(slopes.size_out(i), order="F") for i in range(3)]
    buffer, call = attached(slopes, [given], out)

    def at(point: Sequence[float]) -> None:
        given[:] = point
        call()

    at.buffer, at.out = buffer, tuple(out)  # pyright: ignore[reportFunctionMemberAccess]
    return at
