"""Intervals of the library's functions: exp, log, waves, their inverses, erf; outward by what a library may err."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nsmodel.proof.interval_arithmetic import (
    HALF_PI,
    LIBRARY,
    PI_ABOVE,
    PI_BELOW,
    UNBOUNDED,
    Array,
    Pair,
    above,
    below,
    choose,
    div,
    down,
    excludes,
    in_domain,
    magnitude,
    meet,
    pair,
    up,
)


def _monotone(
    f: Callable[[Array], Array],
    anchor: tuple[float, float],
    domain: tuple[float, float] = (-np.inf, np.inf),
    values: tuple[float, float] = (-np.inf, np.inf),
    error: float = LIBRARY,
) -> Callable[[Pair], Pair]:
    """Return the bounds of an increasing f, sharp at the anchor (p, f(p))."""

    def bounds(x: Pair) -> Pair:
        a, b = (np.clip(end, *domain) for end in x)
        lo, hi = f(a), f(b)
        lo, hi = below(lo, error), above(hi, error)
        lo = np.where(a >= anchor[0], np.maximum(lo, anchor[1]), lo)
        hi = np.where(b <= anchor[0], np.minimum(hi, anchor[1]), hi)
        inner = pair(np.clip(lo, *values), np.clip(hi, *values))
        return choose(in_domain(x, *domain), inner, UNBOUNDED)

    return bounds


def _erf(x: Array) -> Array:
    from scipy.special import erf

    return erf(x)


def _erfinv(x: Array) -> Array:
    from scipy.special import erfinv

    return erfinv(x)


exp = _monotone(np.exp, (0, 1), values=(0, np.inf))
log = _monotone(np.log, (1, 0), (0, np.inf))
expm1 = _monotone(np.expm1, (0, 0), values=(-1, np.inf))
log1p = _monotone(np.log1p, (0, 0), (-1, np.inf))
asin = _monotone(np.arcsin, (0, 0), (-1, 1), (-HALF_PI, HALF_PI))
atan = _monotone(np.arctan, (0, 0), values=(-HALF_PI, HALF_PI))
sinh = _monotone(np.sinh, (0, 0))
tanh = _monotone(np.tanh, (0, 0), values=(-1, 1))
asinh = _monotone(np.arcsinh, (0, 0))
acosh = _monotone(np.arccosh, (1, 0), (1, np.inf))
atanh = _monotone(np.arctanh, (0, 0), (-1, 1))
erf_bounds = _monotone(_erf, (0, 0), values=(-1, 1), error=1e-14)
erfinv_bounds = _monotone(_erfinv, (0, 0), (-1, 1), error=1e-4)  # CasADi's own is not exact: its values lie inside too.
_cosh_half = _monotone(np.cosh, (0, 1), values=(1, np.inf))


def cosh(x: Pair) -> Pair:
    """Return the hyperbolic cosine."""
    return _cosh_half(magnitude(x))


def acos(x: Pair) -> Pair:
    """Return the inverse cosine."""
    a, b = np.arccos(np.clip(x[1], -1, 1)), np.arccos(np.clip(x[0], -1, 1))
    lo = np.clip(down(a - 1e-15), 0, PI_ABOVE)
    hi = np.where(x[0] >= 1, 0, np.clip(up(b + 1e-15), 0, PI_ABOVE))
    return choose(in_domain(x, -1, 1), pair(lo, hi), UNBOUNDED)


def _holds_multiple(x: Pair, period: float, phase: float) -> Array:
    """Whether the interval may hold (k + phase) period for a whole k: never a false no."""
    a, b = x[0] / period - phase, x[1] / period - phase
    slack = 1e-14
    first, last = np.ceil(a - slack * (1 + np.abs(a))), np.floor(b + slack * (1 + np.abs(b)))
    return ~(last < first) | ~np.isfinite(a) | ~np.isfinite(b)


def sin(x: Pair) -> Pair:
    """Return the sine."""
    return _wave(x, np.sin, 0.25)


def cos(x: Pair) -> Pair:
    """Return the cosine."""
    return _wave(x, np.cos, 0.0)


def _wave(x: Pair, f: Callable[[Array], Array], phase: float) -> Pair:
    """Bounds of a wave with its crests at (k + phase) 2 pi."""
    a, b = f(np.where(np.isfinite(x[0]), x[0], 0.0)), f(np.where(np.isfinite(x[1]), x[1], 0.0))
    lo, hi = np.clip(np.minimum(a, b) - 1e-15, -1, 1), np.clip(np.maximum(a, b) + 1e-15, -1, 1)
    lo = np.where(_holds_multiple(x, 2 * np.pi, phase + 0.5), -1.0, lo)
    hi = np.where(_holds_multiple(x, 2 * np.pi, phase), 1.0, hi)
    if f is np.sin:  # sin x lies between 0 and x for |x| <= pi: sharp at 0
        lo = np.where((x[0] >= 0) & (x[1] <= PI_BELOW), np.maximum(lo, 0), lo)
        hi = np.where((x[1] <= 0) & (x[0] >= -PI_BELOW), np.minimum(hi, 0), hi)
        small = (x[0] >= -PI_BELOW) & (x[1] <= PI_BELOW)
        lo = np.where(small & (x[0] <= 0), np.maximum(lo, x[0]), lo)
        hi = np.where(small & (x[1] >= 0), np.minimum(hi, x[1]), hi)
    return lo, hi


def has_pole(x: Pair) -> Array:
    """Whether the interval may hold a pole of the tangent."""
    return _holds_multiple(x, np.pi, 0.5)


_tan_between = _monotone(np.tan, (0, 0))


def tan(x: Pair) -> Pair:
    """Return the tangent."""
    pole = has_pole(x)
    lo, hi = _tan_between((np.where(pole, 0.0, x[0]), np.where(pole, 0.0, x[1])))
    near = np.maximum(np.abs(x[0]), np.abs(x[1])) < 1.5  # the anchor at 0 holds in this branch alone
    far = pair(below(np.tan(np.where(pole, 0.0, x[0]))), above(np.tan(np.where(pole, 0.0, x[1]))))
    return choose(pole, UNBOUNDED, choose(near, (lo, hi), far))


def atan2(y: Pair, x: Pair) -> Pair:
    """Angle of (x, y): the corners bound it away from the cut along the negative axis."""
    corners = np.broadcast_arrays(*(np.arctan2(b, a) for a in x for b in y))
    lo, hi = below(np.minimum.reduce(corners)), above(np.maximum.reduce(corners))
    lo, hi = np.where(y[0] >= 0, np.maximum(lo, 0), lo), np.where(y[1] <= 0, np.minimum(hi, 0), hi)
    lo, hi = np.maximum(lo, -PI_ABOVE), np.minimum(hi, PI_ABOVE)
    return choose(off_cut(y, x), pair(lo, hi), (np.full(1, -PI_ABOVE), np.full(1, PI_ABOVE)))


def off_cut(y: Pair, x: Pair) -> Array:
    """Whether (x, y) keeps away from the cut of the angle."""
    return (x[0] > 0) | excludes(y)


def hypot(x: Pair, y: Pair) -> Pair:
    """Return the length of (x, y)."""
    a, b = magnitude(x), magnitude(y)
    exact = [(a[i] == 0) | (b[i] == 0) for i in (0, 1)]
    lo, hi = np.hypot(a[0], b[0]), np.hypot(a[1], b[1])
    return pair(np.where(exact[0], lo, np.maximum(below(lo), 0)), np.where(exact[1], hi, above(hi)))


def hypot_slopes(r: Pair, x: Pair, y: Pair) -> tuple[Pair, ...]:
    """Return its slopes."""
    within = np.full(1, -1.0), np.full(1, 1.0)
    return tuple(meet(within, choose(r[0] > 0, div(a, r), within)) for a in (x, y))
