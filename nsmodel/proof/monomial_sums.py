"""Sums of monomials in sizes, below and above the size of a value; each is rounded to its side."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

MOST = 60  # Terms of a bound.
UP = 1 + 1e-12  # One operation on coefficients is rounded by less.
Monomial = tuple[tuple[int, Fraction], ...]  # ((atom, power), ...), atoms increasing, powers not 0
Sum = tuple[tuple[float, Monomial], ...]


class Term(NamedTuple):
    """A monomial over the product of ``below``."""

    size: float
    monomial: Monomial
    below: tuple[Sum, ...] = ()


def _joined(a: Monomial, b: Monomial) -> Monomial:
    total = dict(a)
    for atom, power in b:
        total[atom] = total.get(atom, Fraction(0)) + power
    return tuple(sorted((atom, power) for atom, power in total.items() if power))


def scaled(a: Sum, number: float) -> Sum:
    """number times the sum, rounded down."""
    return tuple((size * number / UP, monomial) for size, monomial in a)


def product(a: Sum, b: Sum) -> Sum:
    """The product, rounded down; empty where it is too long."""
    return tuple((x * y / UP, _joined(m, k)) for x, m in a for y, k in b) if len(a) * len(b) <= MOST else ()


def _to(m: Monomial, q: Fraction) -> Monomial:
    return tuple((atom, power * q) for atom, power in m)


def power_of_sum(a: Sum, q: Fraction, *, below: bool) -> Sum:
    """A bound of (sum)^q, from below or from above."""
    flat = (q < 1) == below  # where N^(q-1) stands before the sum
    factor = len(a) ** float(q - 1) if flat and a else 1.0
    rounding = 1 / (1 + 1e-10) if below else 1 + 1e-10
    return tuple((size ** float(q) * factor * rounding, _to(m, q)) for size, m in a)


def plus(a: tuple[Term, ...] | None, b: tuple[Term, ...] | None) -> tuple[Term, ...] | None:
    """The sum."""
    return None if a is None or b is None else a + b


def times(a: tuple[Term, ...] | None, b: tuple[Term, ...] | None) -> tuple[Term, ...] | None:
    """The product, rounded up; None where it is too long."""
    if a is None or b is None or len(a) * len(b) > MOST:
        return None
    return tuple(Term(x.size * y.size * UP, _joined(x.monomial, y.monomial), x.below + y.below) for x in a for y in b)


def over(a: tuple[Term, ...] | None, below: Sum) -> tuple[Term, ...] | None:
    """The terms over one more sum."""
    if a is None or not below:
        return None
    return tuple(term._replace(below=(*term.below, below)) for term in a)


def raised(a: tuple[Term, ...] | None, q: Fraction) -> tuple[Term, ...] | None:
    """The sum to the power q > 0: at most the sum of the powers for q <= 1, N^(q-1) times it for q >= 1."""
    if a is None:
        return None
    factor = len(a) ** float(q - 1) if q > 1 and a else 1.0
    return tuple(
        Term(
            term.size ** float(q) * factor * (1 + 1e-10), _to(term.monomial, q),
            tuple(power_of_sum(below, q, below=True) for below in term.below),
        )
        for term in a
    )  # fmt: skip
