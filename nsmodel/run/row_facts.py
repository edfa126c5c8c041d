"""What rows of an event-driven run need to know of their problem, as numbers: read off its expressions once."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.once import once
from nsmodel.pieces.asked import operations
from nsmodel.pieces.jets import is_switched
from nsmodel.scheme.continuous import ContinuousProblem


@dataclass(frozen=True)
class Facts:
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
    shown: int
    x0: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    direct: np.ndarray
    columns: dict[str, int]
    operations: int
    is_switched: bool


@once
def facts(p: ContinuousProblem) -> Facts:
    """Return them."""
    m = p.l.numel()
    direct = set(ca.jacobian_sparsity(p.h, p.l).row()) if m else set()
    x0, lower, upper = (np.array(ca.DM(column)).ravel() for column in (p.x0, p.law.lower, p.law.upper))
    return Facts(
        p.x.numel(), m, len(p.rows if p.multipliers is None else p.declared), x0, lower, upper,
        np.array([i in direct for i in range(m)], bool), {name: e.numel() for name, e in p.columns.items()},
        operations(p), is_switched(ca.veccat(p.f, p.g, p.h)),
    )  # fmt: skip
