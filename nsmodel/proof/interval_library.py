"""Intervals of the library's functions: exp, log, waves, their inverses, erf; outward by what a library may err."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nsmodel.proof.interval_arithmetic import (
    HALF_PI,
    LIBRARY_ERROR,
    PI_ABOVE,
    PI_BELOW,
    UNBOUNDED,
    Array,
    IntervalPair,
    div,
    excludes,
    in_domain,
    intersect,
    magnitude,
    make_interval,
    next_down,
    next_up,
    select_interval,
    widen_down,
    widen_up,
)


def _monotone_bounds(
    f: Callable[[Array], Array],
    anchor: tuple[float, float],
    domain: tuple[float, float] = (-np.inf, np.inf),
    values: tuple[float, float] = (-np.inf, np.inf),
    error: float = LIBRARY_ERROR,
) -> Callable[[IntervalPair], IntervalPair]:
    """Return the bounds of an increasing f, sharp at the anchor (p, f(p))."""

    def bounds(x: IntervalPair) -> IntervalPair:
        a, b = (np.clip(end, *domain) for end in x)
        lo, hi = f(a), f(b)
        lo, hi = widen_down(lo, error), widen_up(hi, error)
        lo = np.where(a >= anchor[0], np.maximum(lo, anchor[1]), lo)
        hi = np.where(b <= anchor[0], np.minimum(hi, anchor[1]), hi)
        inner = make_interval(np.clip(lo, *values), np.clip(hi, *values))
        return select_interval(in_domain(x, *domain), inner, UNBOUNDED)

    return bounds


def _scipy_erf(x: Array) -> Array:
    from scipy.special import erf

    return erf(x)


def _scipy_erfinv(x: Array) -> Array:
    from scipy.special import erfinv

    return erfinv(x)


exp = _monotone_bounds(np.exp, (0, 1), values=(0, np.inf))
log = _monotone_bounds(np.log, (1, 0), (0, np.inf))
expm1 = _monotone_bounds(np.expm1, (0, 0), values=(-1, np.inf))
log1p = _monotone_bounds(np.log1p, (0, 0), (-1, np.inf))
asin = _monotone_bounds(np.arcsin, (0, 0), (-1, 1), (-HALF_PI, HALF_PI))
atan = _monotone_bounds(np.arctan, (0, 0), values=(-HALF_PI, HALF_PI))
sinh = _monotone_bounds(np.sinh, (0, 0))
tanh = _monotone_bounds(np.tanh, (0, 0), values=(-1, 1))
asinh = _monotone_bounds(np.arcsinh, (0, 0))
acosh = _monotone_bounds(np.arccosh, (1, 0), (1, np.inf))
atanh = _monotone_bounds(np.arctanh, (0, 0), (-1, 1))
erf_bounds = _monotone_bounds(_scipy_erf, (0, 0), values=(-1, 1), error=1e-14)
erfinv_bounds = _monotone_bounds(
    _scipy_erfinv, (0, 0), (-1, 1), error=1e-4
)  # CasADi's own is not exact: its values lie inside too.
_cosh_of_nonnegative = _monotone_bounds(np.cosh, (0, 1), values=(1, np.inf))


def cosh(x: IntervalPair) -> IntervalPair:
    """Return the hyperbolic cosine."""
    return _cosh_of_nonnegative(magnitude(x))


def acos(x: IntervalPair) -> IntervalPair:
    """Return the inverse cosine."""
    a, b = np.arccos(np.clip(x[1], -1, 1)), np.arccos(np.clip(x[0], -1, 1))
    lo = np.clip(next_down(a - 1e-15), 0, PI_ABOVE)
    hi = np.where(x[0] >= 1, 0, np.clip(next_up(b + 1e-15), 0, PI_ABOVE))
    return select_interval(in_domain(x, -1, 1), make_interval(lo, hi), UNBOUNDED)


def _may_hold_multiple(x: IntervalPair, period: float, phase: float) -> Array:
    """Whether the interval may hold (k + phase) period for a whole k: never a false no."""
    a, b = x[0] / period - phase, x[1] / period - phase
    slack = 1e-14
    first, last = np.ceil(a - slack * (1 + np.abs(a))), np.floor(b + slack * (1 + np.abs(b)))
    return ~(last < first) | ~np.isfinite(a) | ~np.isfinite(b)


def sin(x: IntervalPair) -> IntervalPair:
    """Return the sine."""
    return _sinusoid_bounds(x, np.sin, 0.25)


def cos(x: IntervalPair) -> IntervalPair:
    """Return the cosine."""
    return _sinusoid_bounds(x, np.cos, 0.0)


def _sinusoid_bounds(x: IntervalPair, f: Callable[[Array], Array], phase: float) -> IntervalPair:
    """Bounds of a wave with its crests at (k + phase) 2 pi."""
    a, b = f(np.where(np.isfinite(x[0]), x[0], 0.0)), f(np.where(np.isfinite(x[1]), x[1], 0.0))
    lo, hi = np.clip(np.minimum(a, b) - 1e-15, -1, 1), np.clip(np.maximum(a, b) + 1e-15, -1, 1)
    lo = np.where(_may_hold_multiple(x, 2 * np.pi, phase + 0.5), -1.0, lo)
    hi = np.where(_may_hold_multiple(x, 2 * np.pi, phase), 1.0, hi)
    if f is np.sin:  # sin x lies between 0 and x for |x| <= pi: sharp at 0
        lo = np.where((x[0] >= 0) & (x[1] <= PI_BELOW), np.maximum(lo, 0), lo)
        hi = np.where((x[1] <= 0) & (x[0] >= -PI_BELOW), np.minimum(hi, 0), hi)
        small = (x[0] >= -PI_BELOW) & (x[1] <= PI_BELOW)
        lo = np.where(small & (x[0] <= 0), np.maximum(lo, x[0]), lo)
        hi = np.where(small & (x[1] >= 0), np.minimum(hi, x[1]), hi)
    return lo, hi


def has_tangent_pole(x: IntervalPair) -> Array:
    """Whether the interval may hold a pole of the tangent."""
    return _may_hold_multiple(x, np.pi, 0.5)


_tan_between_poles = _monotone_bounds(np.tan, (0, 0))


def tan(x: IntervalPair) -> IntervalPair:
    """Return the tangent."""
    pole = has_tangent_pole(x)
    lo, hi = _tan_between_poles((np.where(pole, 0.0, x[0]), np.where(pole, 0.0, x[1])))
    near = np.maximum(np.abs(x[0]), np.abs(x[1])) < 1.5  # the anchor at 0 holds in this branch alone
    far = make_interval(widen_down(np.tan(np.where(pole, 0.0, x[0]))), widen_up(np.tan(np.where(pole, 0.0, x[1]))))
    return select_interval(pole, UNBOUNDED, select_interval(near, (lo, hi), far))


def atan2(y: IntervalPair, x: IntervalPair) -> IntervalPair:
    """Angle of (x, y): the corners bound it away from the cut along the negative axis."""
    corners = np.broadcast_arrays(*(np.arctan2(b, a) for a in x for b in y))
    lo, hi = widen_down(np.minimum.reduce(corners)), widen_up(np.maximum.reduce(corners))
    lo, hi = np.where(y[0] >= 0, np.maximum(lo, 0), lo), np.where(y[1] <= 0, np.minimum(hi, 0), hi)
    lo, hi = np.maximum(lo, -PI_ABOVE), np.minimum(hi, PI_ABOVE)
    return select_interval(avoids_angle_cut(y, x), make_interval(lo, hi), (np.full(1, -PI_ABOVE), np.full(1, PI_ABOVE)))


def avoids_angle_cut(y: IntervalPair, x: IntervalPair) -> Array:
    """Whether (x, y) keeps away from the cut of the angle."""
    return (x[0] > 0) | excludes(y)


def hypot(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return the length of (x, y)."""
    a, b = magnitude(x), magnitude(y)
    exact = [(a[i] == 0) | (b[i] == 0) for i in (0, 1)]
    lo, hi = np.hypot(a[0], b[0]), np.hypot(a[1], b[1])
    return make_interval(np.where(exact[0], lo, np.maximum(widen_down(lo), 0)), np.where(exact[1], hi, widen_up(hi)))


def hypot_slopes(r: IntervalPair, x: IntervalPair, y: IntervalPair) -> tuple[IntervalPair, ...]:
    """Return its slopes."""
    within = np.full(1, -1.0), np.full(1, 1.0)
    return tuple(intersect(within, select_interval(r[0] > 0, div(a, r), within)) for a in (x, y))
