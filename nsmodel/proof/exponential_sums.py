"""Functions of one variable built from polynomials, roots, powers and exponentials.

They are sums of terms R(s) E(s), R rational and E = prod u_j(s)^p_j e^(q(s)) > 0 with polynomials u_j > 0 and q.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from nsmodel.proof import polynomial_signs
from nsmodel.proof.exact import round_down

MAX_SUM_TERMS, MAX_DERIVATIVES, MAX_SUM_DEGREE = 12, 60, 80
MAX_BISECTIONS, FLINT_PRECISION = 160, 320
ExponentialKey = tuple[tuple[tuple[tuple[Fraction, ...], Fraction], ...], tuple[Fraction, ...]]  # ((u, p), ...), 0 < p < 1; q
ExponentialSum = dict[ExponentialKey, tuple[Any, Any]]  # R = numerator / denominator, polynomials of FLINT
Enclosure = tuple[Fraction, Fraction]
GrowthRank = tuple[int, tuple[Fraction, ...]]  # orders exponentials e^q by their size at infinity; q from its highest power down
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
    """A + sign B."""
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
    """A B."""
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
    """u^p."""
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
    return 1 if polynomial_signs.evaluate_at(c, _interior_point(line)) > 0 else -1


def _interior_point(line: OpenInterval) -> Fraction:
    return line.low + 1 if line.high is None else (line.low + line.high) / 2


def inner_roots(c: Sequence[Fraction], line: OpenInterval) -> list[Enclosure]:
    """The roots of a polynomial within the open interval."""
    found = polynomial_signs.real_roots(c, line.low, line.high)
    return [place for place in found if place != (line.low, line.low) and place != (line.high, line.high)]
