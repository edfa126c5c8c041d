"""Functions of one variable built from polynomials, roots, powers and exponentials.

They are sums of terms R(s) E(s), R rational and E = prod u_j(s)^p_j e^(q(s)) > 0 with polynomials u_j > 0 and q.

Signs of an exponential sum on a whole interval, and its leading term at an end.

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

from nsmodel.proof import polynomial
from nsmodel.proof.exact import round_down
from nsmodel.proof.leading_terms import GrowthRank, LeadingTerm, LocalTerm, find_leading_term

# Terms of a sum. Its sign follows from those of derivatives: after d + 1 of them a term with a factor of degree d is gone.
MAX_SUM_TERMS = 12
MAX_DERIVATIVES = 60  # Derivatives until one term is gone; beyond these three a sign is left open.
MAX_SUM_DEGREE = 80  # Degree of the rational factors, which rises with each derivative.
MAX_BISECTIONS = 160  # Of the place of a root; two roots that are nearer are not told apart. Three times the bits of a double.
FLINT_PRECISION = 320  # Bits of numbers: twice the bisections, so that their values keep as many bits again.
ExponentialKey = tuple[tuple[tuple[tuple[Fraction, ...], Fraction], ...], tuple[Fraction, ...]]  # ((u, p), ...), 0 < p < 1; q
ExponentialSum = dict[ExponentialKey, tuple[Any, Any]]  # R = numerator / denominator, polynomials of FLINT
Enclosure = tuple[Fraction, Fraction]
UNIT_KEY: ExponentialKey = ((), ())


class UndecidedSign(Exception):
    """The sign is not found this way."""


class OpenInterval(NamedTuple):
    """The open interval (low, high); high None: infinite."""

    low: Fraction
    high: Fraction | None = None


class flint_precision:
    """FLINT computes with so many bits inside."""

    def __enter__(self) -> None:
        from flint import ctx

        self._before, ctx.prec = ctx.prec, FLINT_PRECISION

    def __exit__(self, *_: object) -> None:
        from flint import ctx

        ctx.prec = self._before


def ball_lower_bound(number: Any) -> float:
    """The largest double that is below a ball."""
    mantissa, exponent = (int(part) for part in number.lower().man_exp())
    return round_down(Fraction(mantissa) * Fraction(2) ** exponent)


def flint_polynomial(c: Sequence[Fraction]) -> Any:
    """The polynomial of FLINT with these coefficients."""
    from flint import fmpq, fmpq_poly

    return fmpq_poly([fmpq(number.numerator, number.denominator) for number in c])


def flint_coefficients(p: Any) -> tuple[Fraction, ...]:
    """Its coefficients as Fractions."""
    return tuple(Fraction(int(number.p), int(number.q)) for number in p.coeffs())


def reduce_quotient(top: Any, bottom: Any) -> tuple[Any, Any]:
    """A quotient of polynomials without common factors."""
    common = top.gcd(bottom)
    if common.degree() > 0:
        top, bottom = top // common, bottom // common
    if max(top.degree(), bottom.degree()) > MAX_SUM_DEGREE:
        raise UndecidedSign
    lead = bottom[bottom.degree()]
    return top / lead, bottom / lead


def _drop_zero_terms(a: ExponentialSum) -> ExponentialSum:
    out = {key: ratio for key, ratio in a.items() if ratio[0]}
    if len(out) > MAX_SUM_TERMS:
        raise UndecidedSign
    return out


def add_sums(a: ExponentialSum, b: ExponentialSum, sign: int = 1) -> ExponentialSum:
    """The exponential sum a + sign b."""
    out = dict(a)
    for key, (top, bottom) in b.items():
        if key in out:
            n, d = out[key]
            out[key] = reduce_quotient(n * bottom + sign * top * d, d * bottom)
        else:
            out[key] = sign * top, bottom
    return _drop_zero_terms(out)


def multiply_keys(a: ExponentialKey, b: ExponentialKey, sign: int = 1) -> tuple[ExponentialKey, Any, Any]:
    """The product (quotient) of two E as an E times a rational function."""
    powers = dict(a[0])
    top = bottom = flint_polynomial([Fraction(1)])
    for u, p in b[0]:
        total = powers.pop(u, Fraction(0)) + sign * p
        whole = total.numerator // total.denominator
        if total - whole:
            powers[u] = total - whole
        if whole > 0:
            top *= flint_polynomial(u) ** whole
        elif whole < 0:
            bottom *= flint_polynomial(u) ** -whole
    q = flint_coefficients(flint_polynomial(a[1]) + sign * flint_polynomial(b[1]))
    return (tuple(sorted(powers.items())), q), top, bottom


def multiply_sums(a: ExponentialSum, b: ExponentialSum) -> ExponentialSum:
    """The product of two exponential sums."""
    out: ExponentialSum = {}
    for left, (n, d) in a.items():
        for right, (top, bottom) in b.items():
            key, more, less = multiply_keys(left, right)
            out = add_sums(out, {key: reduce_quotient(n * top * more, d * bottom * less)})
    return out


def constant_sum(number: Fraction) -> ExponentialSum:
    """A number as a sum."""
    return {UNIT_KEY: (flint_polynomial([number]), flint_polynomial([Fraction(1)]))} if number else {}


def power_of_term(a: ExponentialSum, exponent: Fraction, line: OpenInterval) -> ExponentialSum:
    """One term to a power; its rational part is to be > 0, or not 0 where the exponent is whole."""
    from flint import fmpq

    ((key, (top, bottom)),) = a.items()
    factors: dict[tuple[Fraction, ...], int] = {}
    number, sign = fmpq(1), 1
    for part, direction in ((top, 1), (bottom, -1)):
        content, parts = part.numer().factor()
        number *= fmpq(content) ** direction * fmpq(part.denom()) ** -direction
        for factor, multiple in parts:
            u = flint_polynomial([Fraction(int(c)) for c in factor.coeffs()])
            own = constant_sign(u, line)
            sign *= own**multiple
            u = flint_coefficients(u * own)
            factors[u] = factors.get(u, 0) + direction * multiple
    number *= sign
    rational = Fraction(int(number.p), int(number.q))
    if exponent.denominator != 1 and rational < 0:
        raise UndecidedSign
    out = constant_sum(Fraction(1))
    if exponent.denominator == 1:
        out = constant_sum(rational ** int(exponent))
    elif rational != 1:
        out = _power_term((rational,), exponent)
    for u, multiple in factors.items():
        out = multiply_sums(out, _power_term(u, multiple * exponent))
    for u, p in key[0]:
        out = multiply_sums(out, _power_term(u, p * exponent))
    q = tuple(number * exponent for number in key[1])
    return multiply_sums(out, {((), q): (flint_polynomial([Fraction(1)]),) * 2})


def _power_term(u: tuple[Fraction, ...], p: Fraction) -> ExponentialSum:
    """The power u^p of a polynomial, its whole part multiplied out."""
    whole = p.numerator // p.denominator
    if abs(whole) * len(u) > MAX_SUM_DEGREE:
        raise UndecidedSign
    key: ExponentialKey = (((u, p - whole),) if p - whole else (), ())
    base = flint_polynomial(u) ** abs(whole)
    return {
        key: (base, flint_polynomial([Fraction(1)])) if whole >= 0 else reduce_quotient(flint_polynomial([Fraction(1)]), base)
    }


def constant_sign(u: Any, line: OpenInterval) -> int:
    """The sign of a polynomial without roots on the line."""
    if not u:
        raise UndecidedSign
    c = flint_coefficients(u)
    if inner_roots(c, line):
        raise UndecidedSign
    return 1 if polynomial.evaluate_at(c, _interior_point(line)) > 0 else -1


def _interior_point(line: OpenInterval) -> Fraction:
    return line.low + 1 if line.high is None else (line.low + line.high) / 2


def inner_roots(c: Sequence[Fraction], line: OpenInterval) -> list[Enclosure]:
    """The roots of a polynomial within the open interval."""
    found = polynomial.real_roots(c, line.low, line.high)
    return [place for place in found if place != (line.low, line.low) and place != (line.high, line.high)]


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
    last = min(F, key=lambda key: (any(not polynomial.evaluate_at(u, line.low) for u, _ in key[0]), F[key][0].degree()))
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
    ends: list[Any] = [(line.low, line.low), *roots, (line.high, line.high)]
    found, touches = SignPattern([], []), False
    for k, (left, right) in enumerate(pairwise(ends)):
        middle = left[1] + 1 if right[0] is None else (left[1] + right[0]) / 2
        value = polynomial.evaluate_at(c, middle)
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
        if sign is None:
            break
        low, high = (middle, middle) if sign == 0 else (middle, high) if sign == before else (low, middle)
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
        if sign is None:
            break
        if sign == 0:
            return middle, middle
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
    lead = leading_term(F, end, side)
    if lead.number > 0 or lead.number < 0:
        return 1 if lead.number > 0 else -1
    return 0 if lead.number.is_zero() and lead.tends_to == "number" else None


def leading_term(F: ExponentialSum, end: Fraction | None, side: int) -> LeadingTerm:
    """Return that of F close to an end, on its right (side 1) or left (-1), in w = |s - end|; None: at infinity, w = 1/s."""
    terms, shift = [], None if end is None else flint_polynomial([end, Fraction(side)])
    for (powers, q), (top, bottom) in F.items():
        order, rank, factors = Fraction(0), _growth_rank(()), []
        for p, u in [(Fraction(1), top), (Fraction(-1), bottom), *((p, flint_polynomial(u)) for u, p in powers)]:
            c = flint_coefficients(u)[::-1] if shift is None else flint_coefficients(u(shift))
            k = next(i for i, entry in enumerate(c) if entry)
            order += p * (k if shift is not None else 1 - len(c))
            factors.append((c[k:], p))
        if shift is None:
            rank, q = _growth_rank(tuple(reversed(q[1:]))), q[:1]
        elif q:
            q = flint_coefficients(flint_polynomial(q)(shift))
        terms.append(LocalTerm(rank, order, factors, q))
    return find_leading_term(terms)


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
