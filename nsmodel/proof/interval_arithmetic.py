"""Interval arithmetic on arrays: sums, products, quotients, squares and roots, rounded outwards.

An interval is a pair (lo, hi) of arrays; ends may be infinite, they are never NaN, and lo < inf, hi > -inf. An operation returns
bounds of its values wherever it is defined; where arguments may leave its domain by more than rounding the result is
(-inf, inf). Results that are exact are not widened, so that bounds at whole numbers are sharp. The double that a computer finds
lies inside too, since rounding is monotone.

Intervals of the library's functions: exp, log, waves, their inverses, erf; outward by what a library may err.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Array = np.ndarray
IntervalPair = tuple[Array, Array]

LARGEST_DOUBLE = np.finfo(float).max  # Some 1.8e308.
LIBRARY_ERROR = 2e-15  # Relative error allowed to a library function: 9 ulps or more, where C libraries promise a few.
# An argument outside a domain by less, beside its other end or 1, counts as rounded: a few operations lose as much.
DOMAIN_ROUNDING = 4 * np.finfo(float).eps
PI_BELOW, PI_ABOVE = np.nextafter(np.pi, 0), np.nextafter(np.pi, 4)  # Doubles below and above pi.
HALF_PI = PI_ABOVE / 2  # Above pi/2: halving is exact.
ONE, ZERO = (np.ones(1), np.ones(1)), (np.zeros(1), np.zeros(1))
MINUS_ONE = (-np.ones(1), -np.ones(1))
UNBOUNDED = (np.full(1, -np.inf), np.full(1, np.inf))


# -- rounding ----------------------------------------------------------------------------------------------------------


def make_interval(lo: Array, hi: Array) -> IntervalPair:
    """Return the interval: no bound in place of NaN, and no end beyond all numbers."""
    return np.where(np.isnan(lo), -np.inf, np.minimum(lo, LARGEST_DOUBLE)), np.where(
        np.isnan(hi), np.inf, np.maximum(hi, -LARGEST_DOUBLE)
    )


def point_interval(number: float) -> IntervalPair:
    """Return the interval that holds one number."""
    return make_interval(np.array([number]), np.array([number]))


def next_down(x: Array) -> Array:
    """Return the next double below."""
    return np.nextafter(x, -np.inf)


def next_up(x: Array) -> Array:
    """Return the next double above."""
    return np.nextafter(x, np.inf)


def widen_down(x: Array, error: float = LIBRARY_ERROR) -> Array:
    """Return a lower bound of a number known with a relative error."""
    return np.where(np.isinf(x), x, next_down(x - error * np.abs(x)))


def widen_up(x: Array, error: float = LIBRARY_ERROR) -> Array:
    """Return an upper bound of a number known with a relative error."""
    return np.where(np.isinf(x), x, next_up(x + error * np.abs(x)))


def has_short_significands(*numbers: Array) -> Array:
    """Whether all numbers have at most 24 significant bits: their products are exact doubles."""
    mask = np.ones(1, bool)
    for x in numbers:
        mask = mask & (x.astype(np.float32) == x)
        if not mask.any():
            break
    return mask


def select_interval(mask: Array, a: IntervalPair, b: IntervalPair) -> IntervalPair:
    """Return a where the mask holds, else b."""
    return np.where(mask, a[0], b[0]), np.where(mask, a[1], b[1])


def intersect(a: IntervalPair, b: IntervalPair) -> IntervalPair:
    """Return the intersection of two intervals that are known to meet; the first where rounding parts them."""
    lo, hi = np.maximum(a[0], b[0]), np.minimum(a[1], b[1])
    return select_interval(lo <= hi, (lo, hi), a)


def hull(*pairs: IntervalPair) -> IntervalPair:
    """Return the least interval around several."""
    lo, hi = pairs[0]
    for other in pairs[1:]:
        lo, hi = np.minimum(lo, other[0]), np.maximum(hi, other[1])
    return lo, hi


def magnitude(x: IntervalPair) -> IntervalPair:
    """Return the interval of |x|."""
    a, b = np.abs(x[0]), np.abs(x[1])
    return np.where((x[0] <= 0) & (x[1] >= 0), 0.0, np.minimum(a, b)), np.maximum(a, b)


def excludes(x: IntervalPair, number: float = 0.0) -> Array:
    """Whether the interval does not hold the number."""
    return (x[0] > number) | (x[1] < number)


def is_point(x: IntervalPair) -> Array:
    """Whether the interval holds one number only."""
    return x[0] == x[1]


# -- rational operations -----------------------------------------------------------------------------------------------


def _two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the rounded sum and its error (Knuth); NaN error where it overflows."""
    s = a + b
    part = s - a
    return s, (a - (s - part)) + (b - part)


def add(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return an enclosure of x + y."""
    (lo, below), (hi, above) = _two_sum(x[0], y[0]), _two_sum(x[1], y[1])
    return np.where(below >= 0, lo, next_down(lo)), np.where(above <= 0, hi, next_up(hi))


def neg(x: IntervalPair) -> IntervalPair:
    """Return the exact -x."""
    return -x[1], -x[0]


def sub(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return an enclosure of x - y."""
    return add(x, neg(y))


def _corner_hull(corners: list[Array], exact: Array, x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return the outward rounded hull of corner values of x y or x / y; NaN is 0 times infinity or inf / inf and counts 0."""
    lo = np.minimum(np.minimum(corners[0], corners[1]), np.minimum(corners[2], corners[3]))
    if np.isnan(lo).any():  # minima pass NaN on
        return _corner_hull([np.where(np.isnan(p), 0.0, p) for p in corners], exact, x, y)
    hi = np.maximum(np.maximum(corners[0], corners[1]), np.maximum(corners[2], corners[3]))
    lower, upper = next_down(lo), next_up(hi)
    if exact.any():
        lower, upper = np.where(exact, lo, lower), np.where(exact, hi, upper)
    if (lo == 0).any():  # an end that is 0 stays, unless another sign has come to nothing
        lower = np.where(((x[0] >= 0) & (y[0] >= 0)) | ((x[1] <= 0) & (y[1] <= 0)), np.maximum(lower, 0), lower)
    if (hi == 0).any():
        upper = np.where(((x[0] >= 0) & (y[1] <= 0)) | ((x[1] <= 0) & (y[0] >= 0)), np.minimum(upper, 0), upper)
    return lower, upper


def mul(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return x y, with 0 times anything 0."""
    return _corner_hull([x[0] * y[0], x[0] * y[1], x[1] * y[0], x[1] * y[1]], has_short_significands(*x, *y), x, y)


def div(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return x / y; no bound where y holds 0 inside."""
    lo, hi = y[0] + 0.0, np.where(y[1] == 0, -0.0, y[1])
    quotients = [x[0] / lo, x[0] / hi, x[1] / lo, x[1] / hi]
    exact = has_short_significands(lo, hi, *quotients)
    if exact.any():
        for q, a, b in zip(quotients, (x[0], x[0], x[1], x[1]), (lo, hi, lo, hi), strict=True):
            exact = exact & (q * b == a)
    inside = ((y[0] < 0) & (y[1] > 0)) | ((y[0] == 0) & (y[1] == 0))
    return select_interval(inside, UNBOUNDED, _corner_hull(quotients, exact, x, y))


def inv(x: IntervalPair) -> IntervalPair:
    """Return an enclosure of 1 / x."""
    return div(ONE, x)


def square(x: IntervalPair) -> IntervalPair:
    """Return an enclosure of x^2."""
    lo, hi = magnitude(x)
    exact = has_short_significands(*x)
    return make_interval(np.where(exact, lo * lo, np.maximum(next_down(lo * lo), 0)), np.where(exact, hi * hi, next_up(hi * hi)))


def in_domain(x: IntervalPair, low: float, high: float) -> Array:
    """Whether the interval lies in [low, high] but for rounding (and does not lie outside altogether)."""
    slack = DOMAIN_ROUNDING * np.minimum(np.maximum(np.abs(x[0]), np.abs(x[1])), 1.0)
    return (x[0] >= low - slack) & (x[1] <= high + slack) & (x[1] >= low) & (x[0] <= high)


def widen_sums(x: Array, terms: int) -> Array:
    """Return sums of non-negative terms, or roots of them, widened by more than their rounding."""
    return next_up(x * (1 + 4 * (terms + 8) * np.finfo(float).eps))


def interval_matrix_product(Y: Array, lo: Array, hi: Array) -> IntervalPair:
    """Return bounds of Y A, Y (m, n), for all A between lo and hi (n,) or (n, k), by the middle of A and its radius."""
    middle = lo + (hi - lo) / 2
    radius = next_up(np.maximum(hi - middle, middle - lo))
    product, size, terms = Y @ middle, np.abs(Y) @ np.abs(middle), Y.shape[1]
    rounding = 4 * (terms + 4) * np.finfo(float).eps * size
    error = widen_sums(np.abs(Y) @ radius + rounding, terms) + np.finfo(float).tiny
    return next_down(product - error), next_up(product + error)


def square_root(x: IntervalPair) -> IntervalPair:
    """Return sqrt(x)."""

    def ends(value: Array) -> tuple[Array, Array]:
        r = np.sqrt(np.maximum(value, 0))
        return r, has_short_significands(r) & (r * r == value)

    (lo, exact_lo), (hi, exact_hi) = ends(x[0]), ends(x[1])
    inner = make_interval(np.where(exact_lo, lo, np.maximum(next_down(lo), 0)), np.where(exact_hi, hi, next_up(hi)))
    return select_interval(in_domain(x, 0.0, np.inf), inner, UNBOUNDED)


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
    lo = np.clip(widen_down(a), 0, PI_ABOVE)
    hi = np.where(x[0] >= 1, 0, np.clip(widen_up(b), 0, PI_ABOVE))
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
