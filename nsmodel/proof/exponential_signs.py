"""Signs of an exponential sum on a whole interval, and its leading term at an end.

The sign of one term R E is that of R, which is decided exactly. A sum of m terms is divided by the E of one of them and
differentiated until that term, a polynomial by then, is gone: m - 1 terms are left, whose signs are known by induction. Going
back, each function is monotone between the places where its derivative changes its sign (Rolle), so that its own changes are
found from its signs there, in balls (Arb), and from its leading terms at the two ends of the interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

from nsmodel.proof import polynomial_signs
from nsmodel.proof.exponential_sums import (
    MAX_BISECTIONS,
    MAX_DERIVATIVES,
    Enclosure,
    ExponentialSum,
    GrowthRank,
    OpenInterval,
    UndecidedSign,
    add_sums,
    constant_sign,
    flint_coefficients,
    flint_polynomial,
    inner_roots,
    multiply_keys,
    reduce_quotient,
)


class SignPattern(NamedTuple):
    """A function changes its sign in each of the ``places`` (enclosures, in order) and has ``signs`` between them.

    ``touches``: it is 0 at some point where it does not change its sign.
    """

    places: list[Enclosure]
    signs: list[int]
    touches: bool = False


def sign_pattern(F: ExponentialSum, line: OpenInterval) -> SignPattern:
    """The signs of a sum on the line."""
    if not F:
        return SignPattern([], [0])
    if len(F) == 1:
        (((top, bottom)),) = F.values()
        return _polynomial_sign_pattern(flint_coefficients(top * bottom), line)
    common = flint_polynomial([Fraction(1)])
    for _, bottom in F.values():
        common = common * (bottom // common.gcd(bottom))
    negative = constant_sign(common, line) < 0
    F = {
        key: (-top * (common // bottom) if negative else top * (common // bottom), flint_polynomial([Fraction(1)]))
        for key, (top, bottom) in F.items()
    }
    last = min(F, key=lambda key: (any(not polynomial_signs.evaluate_at(u, line.low) for u, _ in key[0]), F[key][0].degree()))
    chain = [{}]
    for key, (top, bottom) in F.items():
        joined, more, less = multiply_keys(key, last, -1)
        chain[0] = add_sums(chain[0], {joined: reduce_quotient(top * more, bottom * less)})
    for _ in range(F[last][0].degree() + 1):
        chain.append(_sum_derivative(chain[-1]))
    if len(chain) > MAX_DERIVATIVES:
        raise UndecidedSign
    found = sign_pattern(chain[-1], line)
    for G, slope in zip(chain[-2::-1], chain[:0:-1], strict=True):
        found = _signs_from_derivative(G, slope, found, line)
    return found


def _sum_derivative(F: ExponentialSum) -> ExponentialSum:
    out: ExponentialSum = {}
    for key, (n, d) in F.items():
        out = add_sums(out, {key: reduce_quotient(n.derivative() * d - n * d.derivative(), d * d)})
        rates = [(p, u) for u, p in key[0] if len(u) > 1]
        for p, u in rates:
            base = flint_polynomial(u)
            out = add_sums(out, {key: reduce_quotient(n * base.derivative() * flint_polynomial([p]), d * base)})
        if len(key[1]) > 1:
            out = add_sums(out, {key: reduce_quotient(n * flint_polynomial(key[1]).derivative(), d)})
    return out


def _polynomial_sign_pattern(c: Sequence[Fraction], line: OpenInterval) -> SignPattern:
    """The signs of a polynomial."""
    roots = inner_roots(c, line)
    ends = [(line.low, line.low), *roots, (line.high, line.high)]
    found, touches = SignPattern([], []), False
    for k, (left, right) in enumerate(pairwise(ends)):
        middle = left[1] + 1 if right[0] is None else (left[1] + right[0]) / 2
        value = polynomial_signs.evaluate_at(c, middle)
        sign = (value > 0) - (value < 0)
        if k and sign == found.signs[-1]:
            touches = True
            continue
        if k:
            found.places.append(left)
        found.signs.append(sign)
    return found._replace(touches=touches)


def _signs_from_derivative(G: ExponentialSum, slope: ExponentialSum, known: SignPattern, line: OpenInterval) -> SignPattern:
    """The signs of a function from those of its derivative."""
    places = [_refine_zero(slope, place, known.signs[k], G) for k, place in enumerate(known.places)]
    values = [_sign_at_end(G, line.low, 1), *(_sign_on_enclosure(G, place) for place in places), _sign_at_end(G, line.high, -1)]
    bounds: list[Enclosure | None] = [None, *places, None]
    found = SignPattern([], [])
    for k, direction in enumerate(known.signs):
        left, right = values[k], values[k + 1]
        if direction == 0:
            parts: list[int] = [left if left is not None else right if right is not None else 0]
            if left is None and right is None:
                raise UndecidedSign
        elif left is not None and left * direction >= 0:
            parts = [direction]
        elif right is not None and right * direction <= 0:
            parts = [-direction]
        elif left is not None and right is not None:
            parts = [-direction, direction]
        else:
            raise UndecidedSign
        if found.signs and found.signs[-1] != parts[0]:
            found.places.append(places[k - 1])
        if not found.signs or found.signs[-1] != parts[0]:
            found.signs.append(parts[0])
        if len(parts) > 1:
            found.places.append(_bracket_sign_change(G, bounds[k], bounds[k + 1], parts[0], line))
            found.signs.append(parts[1])
    return found._replace(touches=0 in values[1:-1])


def _refine_zero(f: ExponentialSum, place: Enclosure, before: int, G: ExponentialSum) -> Enclosure:
    """The place where f changes its sign, narrow enough for the sign of G to be clear there."""
    low, high = place
    for _ in range(MAX_BISECTIONS):
        if low == high or _sign_on_enclosure(G, (low, high)) is not None:
            break
        middle = (low + high) / 2
        sign = _sign_on_enclosure(f, (middle, middle))
        if sign is None or sign == 0:
            break
        low, high = (middle, high) if sign == before else (low, middle)
    if _sign_on_enclosure(G, (low, high)) is None:
        raise UndecidedSign
    return low, high


def _bracket_sign_change(
    G: ExponentialSum, left: Enclosure | None, right: Enclosure | None, before: int, line: OpenInterval
) -> Enclosure:
    """Where a monotone function changes its sign."""
    low = line.low if left is None else left[1]
    high = line.high if right is None else right[0]
    if high is None:
        step = Fraction(1)
        while _sign_on_enclosure(G, (low + step, low + step)) != -before:
            step *= 2
            if step > 2**MAX_BISECTIONS:
                raise UndecidedSign
        high = low + step
    a, b = low, high
    for _ in range(64):
        middle = (a + b) / 2
        sign = _sign_on_enclosure(G, (middle, middle))
        if not sign:
            break
        a, b = (middle, b) if sign == before else (a, middle)
    return a, b


def _enclosing_ball(place: Enclosure) -> Any:
    from flint import arb, fmpq

    low, high = (arb(fmpq(end.numerator, end.denominator)) for end in place)
    return low.union(high) if place[0] != place[1] else low


def _evaluate_in_balls(p: Any, x: Any) -> Any:
    from flint import arb

    total = arb(0)
    for number in reversed(p.coeffs()):
        total = total * x + arb(number)
    return total


def _evaluate_sum(F: ExponentialSum, place: Enclosure) -> Any:
    from flint import arb, fmpq

    x, total = _enclosing_ball(place), arb(0)
    for (powers, q), (top, bottom) in F.items():
        term = _evaluate_in_balls(top, x) / _evaluate_in_balls(bottom, x)
        for u, p in powers:
            term *= _evaluate_in_balls(flint_polynomial(u), x) ** arb(fmpq(p.numerator, p.denominator))
        total += term * _evaluate_in_balls(flint_polynomial(q), x).exp()
    return total


def _sign_on_enclosure(F: ExponentialSum, place: Enclosure) -> int | None:
    """The sign of F on a place; None where it is not clear."""
    value = _evaluate_sum(F, place)
    return 1 if value > 0 else -1 if value < 0 else 0 if value.is_zero() else None


def _sign_at_end(F: ExponentialSum, end: Fraction | None, side: int) -> int | None:
    """The sign of F close to an end of the line, 0 where its limit is 0; None where it is not clear."""
    order, number = _term_at_infinity(F) if end is None else leading_term(F, end, side)
    if number > 0 or number < 0:
        return 1 if number > 0 else -1
    return 0 if number.is_zero() and order == 0 else None


def leading_term(F: ExponentialSum, at: Fraction, side: int) -> tuple[Fraction, Any]:
    """(k, c) of F = c |s - at|^k + smaller terms close to ``at``, on its right (side 1) or left (-1)."""
    from flint import arb, fmpq

    shift = flint_polynomial([at, Fraction(1)])
    parts: list[tuple[Fraction, Any]] = []
    for (powers, q), (top, bottom) in F.items():
        order, number = Fraction(0), _evaluate_in_balls(flint_polynomial(q), _enclosing_ball((at, at))).exp()
        for p, u in [(Fraction(1), top), (Fraction(-1), bottom), *((p, flint_polynomial(u)) for u, p in powers)]:
            c = u(shift).coeffs()
            k = next(i for i, entry in enumerate(c) if entry)
            order += k * p
            lead = arb(c[k]) * side**k
            number *= lead if p == 1 else 1 / lead if p == -1 else lead ** arb(fmpq(p.numerator, p.denominator))
        parts.append((order, number))
    return _dominant_term(parts, min)


def _dominant_term(parts: list[tuple[Any, Any]], which: Any) -> tuple[Any, Any]:
    from flint import arb

    if not parts:
        return Fraction(0), arb(0)
    order = which(order for order, _ in parts)
    return order, sum((number for own, number in parts if own == order), arb(0))


def _term_at_infinity(F: ExponentialSum) -> tuple[Any, Any]:
    """The leading term at infinity; its order is 0 where every term is bounded and the largest ones are numbers."""
    (rank, order), number = growth_at_infinity(F)
    return Fraction(1 if rank != (0, ()) or order else 0), number


def growth_at_infinity(F: ExponentialSum) -> tuple[tuple[GrowthRank, Fraction], Any]:
    """((rank of the exponential, power of s), coefficient) of the leading term at infinity."""
    from flint import arb, fmpq

    parts: list[tuple[Any, Any]] = []
    for (powers, q), (top, bottom) in F.items():
        order = Fraction(top.degree() - bottom.degree())
        number = arb(top[top.degree()]) / arb(bottom[bottom.degree()])
        for u, p in powers:
            order += p * (len(u) - 1)
            number *= arb(fmpq(u[-1].numerator, u[-1].denominator)) ** arb(fmpq(p.numerator, p.denominator))
        if q:
            number *= arb(fmpq(q[0].numerator, q[0].denominator)).exp()
        growth = tuple(reversed(q[1:]))
        parts.append(((_growth_rank(growth), order), number))
    return _dominant_term(parts, max) if parts else (((0, ()), Fraction(0)), arb(0))


def quotient_growth_rank(rank: GrowthRank, other: GrowthRank, power: int) -> GrowthRank:
    """The rank of e^q / e^(power r) from those of e^q and e^r."""
    size = max(len(rank[1]), len(other[1]))
    q, r = ((Fraction(0),) * (size - len(own[1])) + own[1] for own in (rank, other))
    return _growth_rank(tuple(a - power * b for a, b in zip(q, r, strict=True)))


def _growth_rank(growth: tuple[Fraction, ...]) -> GrowthRank:
    """A key that orders exponents q, given from the highest power down, by their size at infinity."""
    while growth and not growth[0]:
        growth = growth[1:]
    if not growth:
        return 0, ()
    return (len(growth), growth) if growth[0] > 0 else (-len(growth), growth)
