"""What rows of an event-driven run need to know of their problem, as numbers: read off its expressions once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.once import cached_per_object
from nsmodel.pieces.asked import operation_count
from nsmodel.pieces.jets import is_switched
from nsmodel.proof.buffered import attach_buffers
from nsmodel.scheme.continuous import ContinuousProblem


@dataclass(frozen=True)
class RowProperties:
    """Of a problem with n states of the motion and m rows of the law.

    Attributes:
        n, m: numbers of x and l.
        shown: of the multipliers that a user sees.
        x0: the start (n,).
        lower, upper: the ends of the law (m,).
        direct: which y depend on l directly (m,).
        columns: {name: entries} of the columns that are expressions of t, x and l, behind the m of h.
        operations: of f, g and h; is_switched: whether some of them are not analytic.
    """

    n: int
    m: int
    visible_multipliers: int
    x0: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    direct: np.ndarray
    columns: dict[str, int]
    operations: int
    is_switched: bool


@cached_per_object
def row_properties(p: ContinuousProblem) -> RowProperties:
    """Return them."""
    m = p.l.numel()
    direct = set(ca.jacobian_sparsity(p.h, p.l).row()) if m else set()
    x0, lower, upper = (np.array(ca.DM(column)).ravel() for column in (p.x0, p.law.lower, p.law.upper))
    return RowProperties(
        p.x.numel(), m, len(p.rows if p.multipliers is None else p.declared), x0, lower, upper,
        np.array([i in direct for i in range(m)], bool), {name: e.numel() for name, e in p.columns.items()},
        operation_count(p), is_switched(ca.veccat(p.f, p.g, p.h)),
    )  # fmt: skip


def row_columns_function(p: ContinuousProblem) -> Callable[[np.ndarray], np.ndarray]:
    """(h, y, records) of rows (t, x, l), evaluated by CasADi."""
    function, of_many = _row_record_functions(p)

    def evaluate_columns(rows: np.ndarray) -> np.ndarray:
        if not (count := len(rows)):
            return np.zeros((0, function.numel_out()))
        if count not in of_many:
            of_many.clear()
            of_many[count] = function.map(count)
        given, found = np.asfortranarray(rows.T, float), np.zeros((function.numel_out(), count), order="F")
        _buffer, call = attach_buffers(of_many[count], [given], [found])  # as long as these three live
        call()
        return found.T

    return evaluate_columns


@cached_per_object
def _row_record_functions(p: ContinuousProblem) -> tuple[ca.Function, dict[int, ca.Function]]:
    """The function of (t, x, l), and the same of the last number of rows."""
    return ca.Function("records", [ca.vertcat(p.t, p.x, p.l)], [ca.densify(ca.veccat(p.h, *p.columns.values()))]), {}
