"""The leading term of a sum of products of powers and exponentials at an end, exactly, however many terms cancel.

In the local variable w (the distance from a finite end; 1/s at infinity) each term is w^order e^q(w) prod u_j(w)^p_j with
polynomials u_j(0) != 0: a power series with rational coefficients, times a radical prod u_j(0)^p_j and e^q(0). Radicals made of
different powers of primes are linearly independent over the rationals (Besicovitch 1940), and exponentials of different rational
numbers over the algebraic ones (Lindemann and Weierstrass): a sum of such numbers is 0 only where each coefficient is.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

# Orders beyond the largest term in which a leading term is looked for: terms that cancel in so many are left open.
SERIES_TERMS = 24
# Longer numbers are not taken apart into primes, and the root stays a ball: two primes of 80 bits take 0.4 s.
MAX_RADICAND_BITS = 160
GrowthRank = tuple[int, tuple[Fraction, ...]]  # orders exponentials e^q by their size at infinity; q from its highest power down
RadicalKey = tuple[tuple[tuple[int, Fraction], ...], Fraction]  # ((prime, p), ...), 0 < p < 1; q(0)


class LocalTerm(NamedTuple):
    """number w^order e^q(w) prod u(w)^p, and an exponential of that rank; ``factors`` are (u from its lowest power up, p)."""

    rank: GrowthRank
    order: Fraction
    factors: Sequence[tuple[Sequence[Fraction], Fraction]]
    q: Sequence[Fraction] = ()


class LeadingTerm(NamedTuple):
    """``number`` (a ball) times w^order times an exponential of that rank."""

    rank: GrowthRank
    order: Fraction
    number: Any

    @property
    def tends_to(self) -> str:
        """What its size tends to at the end: "infinity", "number" or "zero"."""
        growth = self.rank[0] or -self.order
        return "infinity" if growth > 0 else "zero" if growth < 0 else "number"


def find_leading_term(terms: Sequence[LocalTerm]) -> LeadingTerm:
    """Return the leading term of a sum; its number is a ball around 0 where it is not found, or the sum is 0."""
    from flint import arb

    if not terms:
        return LeadingTerm((0, ()), Fraction(0), arb(0))
    rank = max(term.rank for term in terms)
    own = [term for term in terms if term.rank == rank]
    order = min(term.order for term in own)
    number = sum((_constant_ball(term) for term in own if term.order == order), arb(0))
    found = _exact_leading_term(own) if number.contains(0) else None
    return LeadingTerm(rank, order, number) if found is None else found


def _constant_ball(term: LocalTerm) -> Any:
    """The value of a term's series at 0."""
    number = _ball(term.q[0]).exp() if term.q else _ball(Fraction(1))
    for u, p in term.factors:
        number *= _ball(u[0]) if p == 1 else 1 / _ball(u[0]) if p == -1 else _ball(u[0]) ** _ball(p)
    return number


def _ball(number: Fraction) -> Any:
    from flint import arb, fmpq

    return arb(fmpq(number.numerator, number.denominator))


def _exact_leading_term(terms: Sequence[LocalTerm]) -> LeadingTerm | None:
    reach = min(term.order for term in terms) + SERIES_TERMS
    total: dict[Fraction, dict[RadicalKey, Fraction]] = {}
    for term in terms:
        split = [_split_radical(u[0], p) for u, p in term.factors]
        radical = None if None in split else _multiply_radicals([part for part in split if part is not None])
        if radical is None:
            return None
        number, powers = radical
        key = powers, term.q[0] if term.q else Fraction(0)
        for k, c in enumerate(_series(term)):
            if c and term.order + k < reach:
                own = total.setdefault(term.order + k, {})
                own[key] = own.get(key, Fraction(0)) + number * c
    for order in sorted(total):
        left = [
            LocalTerm((0, ()), Fraction(0), [([c], Fraction(1)), *(([Fraction(a)], p) for a, p in powers)], [q])
            for (powers, q), c in total[order].items()
            if c
        ]
        if left:
            return LeadingTerm(terms[0].rank, order, sum(_constant_ball(term) for term in left))
    return None


def _split_radical(a: Fraction, p: Fraction) -> tuple[Fraction, dict[int, Fraction]] | None:
    """a^p as a rational number times powers of primes between 0 and 1; None where a is too long."""
    from flint import fmpz

    if p.denominator == 1:
        return a ** int(p), {}
    if a < 0 or max(a.numerator.bit_length(), a.denominator.bit_length()) > MAX_RADICAND_BITS:
        return None
    number, powers = Fraction(1), dict[int, Fraction]()
    for whole, sign in ((a.numerator, 1), (a.denominator, -1)):
        for prime, multiple in fmpz(whole).factor():
            exponent = sign * int(multiple) * p
            floor = exponent.numerator // exponent.denominator
            number *= Fraction(int(prime)) ** floor
            powers[int(prime)] = exponent - floor
    return number, powers


def _multiply_radicals(
    parts: Sequence[tuple[Fraction, dict[int, Fraction]]],
) -> tuple[Fraction, tuple[tuple[int, Fraction], ...]]:
    number, total = Fraction(1), dict[int, Fraction]()
    for own, powers in parts:
        number *= own
        for prime, p in powers.items():
            exponent = total.get(prime, Fraction(0)) + p
            number *= prime ** (exponent.numerator // exponent.denominator)
            total[prime] = exponent - exponent.numerator // exponent.denominator
    return number, tuple(sorted((prime, p) for prime, p in total.items() if p))


def _series(term: LocalTerm) -> list[Fraction]:
    """The first coefficients of e^(q - q(0)) prod (u / u(0))^p."""
    out = [Fraction(1)] + [Fraction(0)] * (SERIES_TERMS - 1)
    for u, p in term.factors:
        out = _multiply_series(out, _power_series([c / u[0] for c in u], p))
    slopes = [k * c for k, c in enumerate(term.q)]
    exponential = [Fraction(1)]
    for n in range(1, SERIES_TERMS):  # g' = q' g
        exponential.append(sum((slopes[k] * exponential[n - k] for k in range(1, min(n, len(slopes) - 1) + 1)), Fraction(0)) / n)
    return _multiply_series(out, exponential)


def _power_series(f: Sequence[Fraction], p: Fraction) -> list[Fraction]:
    """f^p, f(0) = 1, by f g' = p f' g."""
    out = [Fraction(1)]
    for n in range(1, SERIES_TERMS):
        terms = ((k * p - (n - k)) * f[k] * out[n - k] for k in range(1, min(n, len(f) - 1) + 1))
        out.append(sum(terms, Fraction(0)) / n)
    return out


def _multiply_series(a: Sequence[Fraction], b: Sequence[Fraction]) -> list[Fraction]:
    return [sum((a[k] * b[n - k] for k in range(n + 1) if a[k] and b[n - k]), Fraction(0)) for n in range(SERIES_TERMS)]
