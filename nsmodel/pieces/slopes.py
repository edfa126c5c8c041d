"""The derivatives g_l, h_l and h_x of a problem: numbers where they are constant, else at a point of it."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.proof.buffered import attach_buffers


def constant_matrix(matrix: ca.SX, moving: ca.SX) -> np.ndarray | None:
    """The matrix, where it depends on nothing that moves."""
    return None if ca.depends_on(matrix, moving) else np.array(ca.DM(ca.densify(ca.cse(matrix)))).reshape(matrix.shape)


class SlopesAtPoint:
    """A function of a point with three outputs, the arrays ``out``: the next call overwrites them."""

    def __init__(self, slopes: ca.Function) -> None:
        self._given = np.zeros(slopes.numel_in(0))
        self.out = tuple(np.zeros(slopes.size_out(i), order="F") for i in range(3))
        self._buffer, self._call = attach_buffers(slopes, [self._given], self.out)

    def __call__(self, point: Sequence[float]) -> None:
        """Put them to ``out``."""
        self._given[:] = point
        self._call()
