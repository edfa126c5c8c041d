"""Sums of monomials in sizes, below and above the size of a value; each is rounded to its side."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

MAX_BOUND_TERMS = 60  # Terms of a bound.
ROUNDING_FACTOR = 1 + 1e-12  # One operation on coefficients is rounded by less.
AtomMonomial = tuple[tuple[int, Fraction], ...]  # ((atom, power), ...), atoms increasing, powers not 0
MonomialSum = tuple[tuple[float, AtomMonomial], ...]


class QuotientTerm(NamedTuple):
    """A monomial over the product of ``below``."""

    size: float
    monomial: AtomMonomial
    below: tuple[MonomialSum, ...] = ()


def _multiply_monomials(a: AtomMonomial, b: AtomMonomial) -> AtomMonomial:
    total = dict(a)
    for atom, power in b:
        total[atom] = total.get(atom, Fraction(0)) + power
    return tuple(sorted((atom, power) for atom, power in total.items() if power))


def scale_sum(a: MonomialSum, number: float) -> MonomialSum:
    """number times the sum, rounded down."""
    return tuple((size * number / ROUNDING_FACTOR, monomial) for size, monomial in a)


def multiply_lower_sums(a: MonomialSum, b: MonomialSum) -> MonomialSum:
    """The product, rounded down; empty where it is too long."""
    return (
        tuple((x * y / ROUNDING_FACTOR, _multiply_monomials(m, k)) for x, m in a for y, k in b)
        if len(a) * len(b) <= MAX_BOUND_TERMS
        else ()
    )


def _monomial_power(m: AtomMonomial, q: Fraction) -> AtomMonomial:
    return tuple((atom, power * q) for atom, power in m)


def power_of_sum(a: MonomialSum, q: Fraction, *, below: bool) -> MonomialSum:
    """A bound of (sum)^q, from below or from above."""
    flat = (q < 1) == below  # where N^(q-1) stands before the sum
    factor = len(a) ** float(q - 1) if flat and a else 1.0
    rounding = 1 / (1 + 1e-10) if below else 1 + 1e-10
    return tuple((size ** float(q) * factor * rounding, _monomial_power(m, q)) for size, m in a)


def add_terms(a: tuple[QuotientTerm, ...] | None, b: tuple[QuotientTerm, ...] | None) -> tuple[QuotientTerm, ...] | None:
    """The sum."""
    return None if a is None or b is None else a + b


def multiply_terms(a: tuple[QuotientTerm, ...] | None, b: tuple[QuotientTerm, ...] | None) -> tuple[QuotientTerm, ...] | None:
    """The product, rounded up; None where it is too long."""
    if a is None or b is None or len(a) * len(b) > MAX_BOUND_TERMS:
        return None
    return tuple(
        QuotientTerm(x.size * y.size * ROUNDING_FACTOR, _multiply_monomials(x.monomial, y.monomial), x.below + y.below)
        for x in a
        for y in b
    )


def divide_terms(a: tuple[QuotientTerm, ...] | None, below: MonomialSum) -> tuple[QuotientTerm, ...] | None:
    """The terms over one more sum."""
    if a is None or not below:
        return None
    return tuple(term._replace(below=(*term.below, below)) for term in a)


def raise_terms(a: tuple[QuotientTerm, ...] | None, q: Fraction) -> tuple[QuotientTerm, ...] | None:
    """The sum to the power q > 0: at most the sum of the powers for q <= 1, N^(q-1) times it for q >= 1."""
    if a is None:
        return None
    factor = len(a) ** float(q - 1) if q > 1 and a else 1.0
    return tuple(
        QuotientTerm(
            term.size ** float(q) * factor * (1 + 1e-10), _monomial_power(term.monomial, q),
            tuple(power_of_sum(below, q, below=True) for below in term.below),
        )
        for term in a
    )  # fmt: skip
