"""Zeros of systems of equations that provably exist: the operator of Krawczyk on slopes, in outward-rounded intervals.

With c the middle of a box X, Y any matrix and S slopes, F(x) - F(y) = S (x - y) on X, the map x - Y F(x) takes X into

    K(X) = c - Y F(c) + (I - Y S) (X - c);

if K(X) lies in X it has a fixed point there (Brouwer). If K(X) lies in the interior, Y S is regular for every such S, hence Y is,
and the fixed point is a zero of F.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import program
from nsmodel.proof.interval_arithmetic import interval_matrix_product, widen_sums
from nsmodel.proof.interval_bounds import MeanValueBounds, mean_value_form

# Of Newton's method for the middle of the box: it squares the error, so that a start from which it takes more is near no zero.
MAX_NEWTON_STEPS = 30
# Boxes that are tried: the last is 4^11 times or more as wide as the first, which is about as wide as rounding.
MAX_WIDENINGS = 12
WIDENING_GROWTH = 4.0  # Each has at least so many times the width of the last; it must hold its own image, and not be much wider.
MAX_EQUATIONS = 60  # Equations; more are left alone. 60 take 0.4 s where each holds a few unknowns, 3 s where each holds all.
# Pivots below this part of the largest belong to a matrix that is singular to rounding: few digits of its inverse would be right.
SINGULAR_PIVOT_RATIO = 1e-12


class ZeroEnclosure(NamedTuple):
    """A box (n,) in which F has a zero; coordinates that were not needed are numbers."""

    lower: np.ndarray
    upper: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """A point near the zero."""
        return (self.lower + self.upper) / 2


def enclose_zero(F: ca.SX, z: ca.SX, start: np.ndarray, size: np.ndarray) -> ZeroEnclosure | None:
    """Return a box around a zero of F near a point, or None where none was proved.

    Args:
        F: (m, 1) in the symbols z.
        z: (n, 1), n >= m; where n > m the coordinates that the equations feel least keep their values.
        start: (n,).
        size: (n,) how far each coordinate may go, > 0.
    """
    m, n = F.numel(), z.numel()
    if m > n or m > MAX_EQUATIONS or not np.isfinite(start).all():
        return None
    F = ca.densify(ca.vec(F))
    both = ca.Function("F", [z], [F, ca.densify(ca.jacobian(F, z))])
    at = np.array(start, float)
    for _ in range(MAX_NEWTON_STEPS):
        value, J = (np.array(part) for part in both(at))
        if not (np.isfinite(value).all() and np.isfinite(J).all()):
            return None
        step = np.linalg.lstsq(J * size, -value.ravel(), rcond=SINGULAR_PIVOT_RATIO)[0] * size
        if np.abs(step / size).max(initial=0.0) > 1:
            return None
        at = at + step
        if np.abs(step / size).max(initial=0.0) < 1e-15:
            break
    if np.abs((at - start) / size).max(initial=0.0) > 1:
        return None
    free = _regular_coordinates(np.array(both(at)[1]) * size, m)
    return None if free is None else _krawczyk_test(F, z, at, free, size, np.array(both(at)[1]))


def _regular_coordinates(J: np.ndarray, m: int) -> np.ndarray | None:
    """m coordinates by which the equations are regular."""
    from scipy.linalg import qr

    if not np.isfinite(J).all() or not m:
        return None
    rows = np.linalg.norm(J, axis=1)
    if not rows.all():
        return None
    R, order = cast("tuple[np.ndarray, np.ndarray]", qr(J / rows[:, None], mode="r", pivoting=True))
    pivots = np.abs(np.diag(R[:m, :m]))
    return np.sort(order[:m]) if pivots.min() > SINGULAR_PIVOT_RATIO * pivots.max() else None


def _krawczyk_test(F: ca.SX, z: ca.SX, at: np.ndarray, free: np.ndarray, size: np.ndarray, J: np.ndarray) -> ZeroEnclosure | None:
    code, Y = program(F, z), np.linalg.inv(J[:, free])
    point = mean_value_form(code, at[None], at[None])
    moved = interval_matrix_product(Y, point.lo[:, 0], point.hi[:, 0])
    radius = 2 * np.maximum(np.abs(moved[0]), np.abs(moved[1])) + 1e-15 * (size[free] + np.abs(at[free]))
    for _ in range(MAX_WIDENINGS):
        lower, upper = at.copy(), at.copy()
        lower[free], upper[free] = at[free] - radius, at[free] + radius
        if (upper - lower > size).any():
            return None
        reach = _contraction_bound(Y, mean_value_form(code, lower[None], upper[None]), free, lower, upper, at)
        if reach is None:
            return None
        low, high = np.nextafter(at[free] - moved[1] - reach, -np.inf), np.nextafter(at[free] - moved[0] + reach, np.inf)
        if (low > lower[free]).all() and (high < upper[free]).all():
            lower[free], upper[free] = low, high
            return ZeroEnclosure(lower, upper)
        radius = np.maximum(WIDENING_GROWTH * radius, 1.5 * np.maximum(at[free] - low, high - at[free]))
    return None


def _contraction_bound(
    Y: np.ndarray, bounds: MeanValueBounds, free: np.ndarray, lower: np.ndarray, upper: np.ndarray, at: np.ndarray
) -> np.ndarray | None:
    """Bounds (m,) of |(I - Y S) (x - c)| over the box."""
    lo, hi = bounds.slope_lo[:, 0][:, free], bounds.slope_hi[:, 0][:, free]
    if not (np.isfinite(lo).all() and np.isfinite(hi).all()):
        return None
    low, high = interval_matrix_product(Y, lo, hi)
    eye = np.eye(free.size)
    rest = np.nextafter(np.maximum(np.abs(eye - low), np.abs(eye - high)), np.inf)
    far = np.nextafter(np.maximum(upper[free] - at[free], at[free] - lower[free]), np.inf)
    return widen_sums(rest @ far, free.size)
