"""Functions of one variable built from polynomials, roots, powers and exponentials.

They are sums of terms R(s) E(s), R rational and E = prod u_j(s)^p_j e^(q(s)) > 0 with polynomials u_j > 0 and q.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from nsmodel.proof import polynomial_signs
from nsmodel.proof.exact import down

MOST_TERMS, MOST_DERIVATIVES, MOST_DEGREE = 12, 60, 80
BISECTIONS, PRECISION = 160, 320
Key = tuple[tuple[tuple[tuple[Fraction, ...], Fraction], ...], tuple[Fraction, ...]]  # ((u, p), ...), 0 < p < 1; q
Sum = dict[Key, tuple[Any, Any]]  # R = numerator / denominator, polynomials of FLINT
Place = tuple[Fraction, Fraction]
Rank = tuple[int, tuple[Fraction, ...]]  # orders exponentials e^q by their size at infinity; q from its highest power down
ONE: Key = ((), ())


class Undecided(Exception):
    """The sign is not found this way."""


class OpenInterval(NamedTuple):
    """The open interval (low, high); high None: infinite."""

    low: Fraction
    high: Fraction | None = None


class precision:
    """FLINT computes with so many bits inside."""

    def __enter__(self) -> None:
        from flint import ctx

        self._before, ctx.prec = ctx.prec, PRECISION

    def __exit__(self, *_: object) -> None:
        from flint import ctx

        ctx.prec = self._before


def lower_end(number: Any) -> float:
    """The largest double that is below a ball."""
    mantissa, exponent = (int(part) for part in number.lower().man_exp())
    return down(Fraction(mantissa) * Fraction(2) ** exponent)


def poly(c: Sequence[Fraction]) -> Any:
    """The polynomial of FLINT with these coefficients."""
    from flint import fmpq, fmpq_poly

    return fmpq_poly([fmpq(number.numerator, number.denominator) for number in c])


def coefficients(p: Any) -> tuple[Fraction, ...]:
    """Its coefficients as Fractions."""
    return tuple(Fraction(int(number.p), int(number.q)) for number in p.coeffs())


def reduced(top: Any, bottom: Any) -> tuple[Any, Any]:
    """A quotient of polynomials without common factors."""
    common = top.gcd(bottom)
    if common.degree() > 0:
        top, bottom = top // common, bottom // common
    if max(top.degree(), bottom.degree()) > MOST_DEGREE:
        raise Undecided
    lead = bottom[bottom.degree()]
    return top / lead, bottom / lead


def _cleaned(a: Sum) -> Sum:
    out = {key: ratio for key, ratio in a.items() if ratio[0]}
    if len(out) > MOST_TERMS:
        raise Undecided
    return out


def added(a: Sum, b: Sum, sign: int = 1) -> Sum:
    """A + sign B."""
    out = dict(a)
    for key, (top, bottom) in b.items():
        if key in out:
            n, d = out[key]
            out[key] = reduced(n * bottom + sign * top * d, d * bottom)
        else:
            out[key] = sign * top, bottom
    return _cleaned(out)


def product_of(a: Key, b: Key, sign: int = 1) -> tuple[Key, Any, Any]:
    """The product (quotient) of two E as an E times a rational function."""
    powers = dict(a[0])
    top = bottom = poly([Fraction(1)])
    for u, p in b[0]:
        total = powers.pop(u, Fraction(0)) + sign * p
        whole = total.numerator // total.denominator
        if total - whole:
            powers[u] = total - whole
        if whole > 0:
            top *= poly(u) ** whole
        elif whole < 0:
            bottom *= poly(u) ** -whole
    q = coefficients(poly(a[1]) + sign * poly(b[1]))
    return (tuple(sorted(powers.items())), q), top, bottom


def times(a: Sum, b: Sum) -> Sum:
    """A B."""
    out: Sum = {}
    for left, (n, d) in a.items():
        for right, (top, bottom) in b.items():
            key, more, less = product_of(left, right)
            out = added(out, {key: reduced(n * top * more, d * bottom * less)})
    return out


def constant(number: Fraction) -> Sum:
    """A number as a sum."""
    return {ONE: (poly([number]), poly([Fraction(1)]))} if number else {}


def power_of(a: Sum, exponent: Fraction, line: OpenInterval) -> Sum:
    """One term to a power; its rational part is to be > 0, or not 0 where the exponent is whole."""
    from flint import fmpq

    ((key, (top, bottom)),) = a.items()
    factors: dict[tuple[Fraction, ...], int] = {}
    number, sign = fmpq(1), 1
    for part, direction in ((top, 1), (bottom, -1)):
        content, parts = part.numer().factor()
        number *= fmpq(content) ** direction * fmpq(part.denom()) ** -direction
        for factor, multiple in parts:
            u = poly([Fraction(int(c)) for c in factor.coeffs()])
            own = constant_sign(u, line)
            sign *= own**multiple
            u = coefficients(u * own)
            factors[u] = factors.get(u, 0) + direction * multiple
    number *= sign
    rational = Fraction(int(number.p), int(number.q))
    if exponent.denominator != 1 and rational < 0:
        raise Undecided
    out = constant(Fraction(1))
    if exponent.denominator == 1:
        out = constant(rational ** int(exponent))
    elif rational != 1:
        out = _term((rational,), exponent)
    for u, multiple in factors.items():
        out = times(out, _term(u, multiple * exponent))
    for u, p in key[0]:
        out = times(out, _term(u, p * exponent))
    q = tuple(number * exponent for number in key[1])
    return times(out, {((), q): (poly([Fraction(1)]),) * 2})


def _term(u: tuple[Fraction, ...], p: Fraction) -> Sum:
    """u^p."""
    whole = p.numerator // p.denominator
    if abs(whole) * len(u) > MOST_DEGREE:
        raise Undecided
    key: Key = (((u, p - whole),) if p - whole else (), ())
    base = poly(u) ** abs(whole)
    return {key: (base, poly([Fraction(1)])) if whole >= 0 else reduced(poly([Fraction(1)]), base)}


def constant_sign(u: Any, line: OpenInterval) -> int:
    """The sign of a polynomial without roots on the line."""
    if not u:
        raise Undecided
    c = coefficients(u)
    if inner_roots(c, line):
        raise Undecided
    return 1 if polynomial_signs.at(c, _inside(line)) > 0 else -1


def _inside(line: OpenInterval) -> Fraction:
    return line.low + 1 if line.high is None else (line.low + line.high) / 2


def inner_roots(c: Sequence[Fraction], line: OpenInterval) -> list[Place]:
    """The roots of a polynomial within the open interval."""
    found = polynomial_signs.real_roots(c, line.low, line.high)
    return [place for place in found if place != (line.low, line.low) and place != (line.high, line.high)]
