"""Polynomials with rational coefficients, read off an expression without any rounding: its doubles are taken as what they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.exact import zeros
from nsmodel.proof.graph import fold_graph, rewrite_nodes, stack_column

Monomial = tuple[tuple[int, int], ...]  # ((variable, power), ...), variables increasing, powers > 0
Polynomial = dict[Monomial, Fraction]  # without zeros
MAX_POLYNOMIAL_TERMS, MAX_POLYNOMIAL_DEGREE = 4000, 30  # Beyond these nothing is read: None.


class Quadratic(NamedTuple):
    """x'Hx/2 + q'x + c with H (n, n) symmetric, q (n, 1) and c rational."""

    H: np.ndarray
    q: np.ndarray
    c: Fraction


def read_polynomials(expr: ca.SX, z: ca.SX) -> list[Polynomial | None]:
    """Return each entry of ``expr`` as a polynomial in z (n, 1), None where it is not one.

    >>> x = ca.SX.sym("x", 2)
    >>> read_polynomials((x[0] - 0.5) ** 2 * x[1], x)
    [{((0, 2), (1, 1)): Fraction(1, 1), ((0, 1), (1, 1)): Fraction(-1, 1), ((1, 1),): Fraction(1, 4)}]
    """
    place = {symbol.element_hash(): i for i, symbol in enumerate(ca.vertsplit(z))} if z.numel() else {}

    def variable(symbol: ca.SX) -> Polynomial | None:
        index = place.get(symbol.element_hash())
        return None if index is None else {((index, 1),): Fraction(1)}

    def result(op: int, args: list[Polynomial | None]) -> Polynomial | None:
        known = [arg for arg in args if arg is not None]
        return apply_to_polynomials(op, known) if known and len(known) == len(args) else None

    return fold_graph(expr, variable, constant_polynomial, result)


def read_quotient(expr: ca.SX, z: ca.SX) -> tuple[Polynomial, Polynomial] | None:
    """Return a scalar as a quotient of polynomials in z, None where it is not one.

    >>> s = ca.SX.sym("s")
    >>> read_quotient(s + 2 / (1 + s), s)
    ({((0, 1),): Fraction(1, 1), ((0, 2),): Fraction(1, 1), (): Fraction(2, 1)}, {(): Fraction(1, 1), ((0, 1),): Fraction(1, 1)})
    """
    divisors: list[tuple[ca.SX, ca.SX, ca.SX]] = []  # symbol for 1/u, u, symbols before it

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        divisors.append((ca.SX.sym("inverse"), args[-1], stack_column(symbol for symbol, _, _ in divisors)))
        return (args[0] if op == ca.OP_DIV else 1) * divisors[-1][0]

    flat = rewrite_nodes(expr, rule, (ca.OP_DIV, ca.OP_INV), z, "expression")
    fractions: list[tuple[Polynomial, Polynomial]] = []
    for u, before in [*((u, before) for _, u, before in divisors), (flat, stack_column(symbol for symbol, _, _ in divisors))]:
        (p,) = read_polynomials(u, ca.vertcat(z, before))
        found = None if p is None else _clear_denominators(p, z.numel(), fractions)
        if found is None or (u is not flat and not found[0]):
            return None
        fractions.append(found if u is flat else (found[1], found[0]))
    return fractions[-1]


def cancel_common_factors(top: Polynomial, bottom: Polynomial, n: int) -> tuple[Polynomial, Polynomial]:
    """A quotient of polynomials in n variables without common factors.

    >>> cancel_common_factors({((0, 2),): Fraction(2), ((0, 1),): Fraction(2)}, {((0, 1),): Fraction(1)}, 1)
    ({((0, 1),): Fraction(2, 1), (): Fraction(2, 1)}, {(): Fraction(1, 1)})
    """
    from flint import Ordering, fmpq, fmpq_mpoly_ctx

    if is_constant(bottom):
        return top, bottom
    ring = fmpq_mpoly_ctx.get([f"x{i}" for i in range(n)], Ordering.lex)

    def to_flint(p: Polynomial) -> Any:
        return ring.from_dict(
            {tuple(dict(monomial).get(i, 0) for i in range(n)): fmpq(c.numerator, c.denominator) for monomial, c in p.items()}
        )

    def from_flint(p: Any) -> Polynomial:
        return {
            tuple((i, int(power)) for i, power in enumerate(powers) if power): Fraction(int(c.p), int(c.q))
            for powers, c in p.to_dict().items()
        }

    a, b = to_flint(top), to_flint(bottom)
    common = a.gcd(b)
    return from_flint(a // common), from_flint(b // common)


def _clear_denominators(
    p: Polynomial, n: int, inverses: Sequence[tuple[Polynomial, Polynomial]]
) -> tuple[Polynomial, Polynomial] | None:
    """p(z, y) with y_j = num_j / den_j as one quotient."""
    most = [max((dict(monomial).get(n + j, 0) for monomial in p), default=0) for j in range(len(inverses))]
    top: Polynomial | None = {}
    bottom = _multiply_all([inverses[j][1] for j, power in enumerate(most) for _ in range(power)])
    for monomial, number in p.items():
        powers = dict(monomial)
        own = tuple((variable, power) for variable, power in monomial if variable < n)
        factors = [{own: number}]
        for j, (num, den) in enumerate(inverses):
            power = powers.get(n + j, 0)
            factors += [num] * power + [den] * (most[j] - power)
        term = _multiply_all(factors)
        top = None if top is None or term is None else add_multiple(top, term)
    return None if top is None or bottom is None else (top, bottom)


def _multiply_all(factors: Sequence[Polynomial]) -> Polynomial | None:
    total: Polynomial | None = {(): Fraction(1)}
    for factor in factors:
        total = None if total is None else multiply(total, factor)
    return total


def constant_polynomial(value: float) -> Polynomial | None:
    """The constant as a polynomial; None where it is not finite."""
    return None if not np.isfinite(value) else {(): Fraction(value)} if value else {}


def apply_to_polynomials(op: int, args: Sequence[Polynomial]) -> Polynomial | None:
    """Apply an operation of CasADi to polynomials; None where the result is none, or too long."""
    a, b = args[0], args[-1]
    if op == ca.OP_ADD:
        return add_multiple(a, b)
    if op == ca.OP_SUB:
        return add_multiple(a, b, Fraction(-1))
    if op in (ca.OP_NEG, ca.OP_TWICE, ca.OP_ASSIGN):
        return scale_polynomial(a, Fraction({ca.OP_NEG: -1, ca.OP_TWICE: 2, ca.OP_ASSIGN: 1}[op]))
    if op in (ca.OP_MUL, ca.OP_SQ):
        return multiply(a, b)
    if op == ca.OP_DIV and is_constant(b) and b:
        return scale_polynomial(a, 1 / b[()])
    if op == ca.OP_INV and is_constant(a) and a:
        return {(): 1 / a[()]}
    if op in (ca.OP_POW, ca.OP_CONSTPOW) and is_constant(b):
        return _polynomial_power(a, b.get((), Fraction(0)))
    return None


def is_constant(p: Polynomial) -> bool:
    """Whether the polynomial is a number."""
    return not p or set(p) == {()}


def degree(p: Polynomial) -> int:
    """The degree, 0 for numbers."""
    return max((sum(power for _, power in monomial) for monomial in p), default=0)


def variables(p: Polynomial) -> list[int]:
    """Indices of the variables in the polynomial."""
    return sorted({variable for monomial in p for variable, _ in monomial})


def add_multiple(a: Polynomial, b: Polynomial, factor: Fraction = Fraction(1)) -> Polynomial:
    """a + factor b."""
    total = dict(a)
    for monomial, number in b.items():
        value = total.pop(monomial, Fraction(0)) + factor * number
        if value:
            total[monomial] = value
    return total


def scale_polynomial(p: Polynomial, factor: Fraction) -> Polynomial:
    """Factor times p."""
    return {monomial: factor * number for monomial, number in p.items()} if factor else {}


def multiply(a: Polynomial, b: Polynomial) -> Polynomial | None:
    """A times b; None where it has too many terms or too high a degree."""
    if len(a) * len(b) > MAX_POLYNOMIAL_TERMS or degree(a) + degree(b) > MAX_POLYNOMIAL_DEGREE:
        return None
    total: Polynomial = {}
    for left, x in a.items():
        for right, y in b.items():
            monomial = _monomial_product(left, right)
            total[monomial] = total.get(monomial, Fraction(0)) + x * y
    return {monomial: number for monomial, number in total.items() if number}


def evaluate_polynomial(p: Polynomial, x: Sequence[Fraction] | Mapping[int, Fraction] | np.ndarray) -> Fraction:
    """The exact value at rational x."""
    total = Fraction(0)
    for monomial, number in p.items():
        for variable, power in monomial:
            number *= x[variable] ** power
        total += number
    return total


def as_quadratic(p: Polynomial | None, n: int) -> Quadratic | None:
    """The polynomial in n variables as x'Hx/2 + q'x + c; None where its degree is above 2."""
    if p is None or degree(p) > 2:
        return None
    H, q, c = zeros(n, n), zeros(n, 1), Fraction(0)
    for monomial, number in p.items():
        where = [variable for variable, power in monomial for _ in range(power)]
        if len(where) == 2:
            H[where[0], where[1]] += number
            H[where[1], where[0]] += number
        elif where:
            q[where[0], 0] += number
        else:
            c = number
    return Quadratic(H, q, c)


def univariate_coefficients(p: Polynomial) -> list[Fraction]:
    """Coefficients c_0, c_1, ... of a polynomial in one variable (whichever)."""
    powers = {sum(power for _, power in monomial): number for monomial, number in p.items()}
    return [powers.get(k, Fraction(0)) for k in range(max(powers, default=0) + 1)]


def partial_derivative(p: Polynomial, variable: int) -> Polynomial:
    """Partial derivative."""
    total: Polynomial = {}
    for monomial, number in p.items():
        powers = dict(monomial)
        power = powers.pop(variable, 0)
        if power:
            if power > 1:
                powers[variable] = power - 1
            total[tuple(sorted(powers.items()))] = number * power
    return total


def _monomial_product(left: Monomial, right: Monomial) -> Monomial:
    powers = dict(left)
    for variable, power in right:
        powers[variable] = powers.get(variable, 0) + power
    return tuple(sorted(powers.items()))


def _polynomial_power(a: Polynomial, exponent: Fraction) -> Polynomial | None:
    if exponent.denominator != 1 or not 0 <= exponent <= MAX_POLYNOMIAL_DEGREE:
        return None
    result: Polynomial | None = {(): Fraction(1)}
    for _ in range(int(exponent)):
        result = None if result is None else multiply(result, a)
    return result
