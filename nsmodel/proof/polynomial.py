"""Polynomials with rational coefficients, read off an expression without any rounding: its doubles are taken as what they are.

The sign of a polynomial in one variable on an interval, decided exactly: its real roots are isolated by FLINT.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from itertools import pairwise
from math import lcm
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.exact import round_down, zeros
from nsmodel.proof.expression_graph import apply_operation, fold_graph, rewrite_nodes, stack_column

Monomial = tuple[tuple[int, int], ...]  # ((variable, power), ...), variables increasing, powers > 0
Polynomial = dict[Monomial, Fraction]  # without zeros
# Terms of one factor times those of the other; longer products are not read: None. 63 by 63 take some 0.03 s, in Fractions.
MAX_POLYNOMIAL_TERMS = 4000
MAX_POLYNOMIAL_DEGREE = 30  # Degree of a product, likewise: powers are multiplied out one by one.


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

    return fold_graph(expr, variable, constant_polynomial, apply_to_polynomials)


def rewrite_parts(
    expr: ca.SX, variable: Callable[[ca.SX], Polynomial | None], write: Callable[[Polynomial], ca.SX], most: int = 1
) -> ca.SX:
    """Return a scalar in which each largest part that is a polynomial of degree 1 to ``most`` is written by ``write``.

    ``variable`` gives the polynomial of a symbol, None for a symbol that is no variable.
    """

    def rewrite(node: ca.SX, p: Polynomial | None) -> ca.SX:
        return node if p is None or is_constant(p) else write(p)

    def apply(op: int, args: list[tuple[ca.SX, Polynomial | None]]) -> tuple[ca.SX, Polynomial | None]:
        p = apply_to_polynomials(op, [q for _, q in args])
        if p is not None and degree(p) <= most:
            return apply_operation(op, [node for node, _ in args]), p
        return apply_operation(op, [rewrite(node, q) for node, q in args]), None

    (last,) = fold_graph(
        expr, lambda symbol: (symbol, variable(symbol)), lambda number: (ca.SX(number), constant_polynomial(number)), apply
    )
    return rewrite(*last)


def read_quotient(expr: ca.SX, z: ca.SX) -> tuple[Polynomial, Polynomial] | None:
    """Return a scalar as a quotient of polynomials in z, None where it is not one.

    What is divided by anywhere in it is a factor of the denominator, also where it cancels: 1 / (1 / s) has no value at 0.

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
        found = None if p is None else _clear_denominators(p, z.numel(), fractions, least=int(u is flat))
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
    p: Polynomial, n: int, inverses: Sequence[tuple[Polynomial, Polynomial]], least: int = 0
) -> tuple[Polynomial, Polynomial] | None:
    """p(z, y) with y_j = num_j / den_j as one quotient, each den_j to a power of ``least`` at least."""
    most = [max((dict(monomial).get(n + j, 0) for monomial in p), default=0) for j in range(len(inverses))]
    most = [power if is_constant(inverses[j][1]) else max(power, least) for j, power in enumerate(most)]
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


def apply_to_polynomials(op: int, args: Sequence[Polynomial | None]) -> Polynomial | None:
    """Apply an operation of CasADi to polynomials; None where an argument or the result is none, or it is too long."""
    known = [arg for arg in args if arg is not None]
    if not known or len(known) < len(args):
        return None
    a, b = known[0], known[-1]
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
    """The polynomial a + factor b."""
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


PolynomialCoefficients = Sequence[Fraction]  # c_0, c_1, ...
INITIAL_PRECISION = 64  # Bits to begin with, a word of the machine; doubled until every question about a root is decided.


def negative_point(
    p: PolynomialCoefficients, low: Fraction | None = Fraction(0), high: Fraction | None = None
) -> Fraction | None:
    """Return a point of [low, high] (None: infinite) where p < 0, or None: then p >= 0 on the whole interval.

    >>> negative_point([Fraction(1), Fraction(-2)])  # 1 - 2 s on [0, inf)
    Fraction(3, 2)
    >>> negative_point([Fraction(1), Fraction(-2), Fraction(1)]) is None  # (s - 1)^2
    True
    """
    p = _trim_zeros(p)
    if not p:
        return None
    reach = 1 + max((abs(number / p[-1]) for number in p[:-1]), default=Fraction(0))  # Cauchy: all roots lie within.
    a = -reach if low is None else low
    b = max(reach, a + 1) if high is None else high
    for point in (a, *_points_between_roots(p, a, b), b):
        if evaluate_at(p, point) < 0:
            return point
    return None


def evaluate_at(p: PolynomialCoefficients, x: Fraction) -> Fraction:
    """The exact value at x."""
    total = Fraction(0)
    for number in reversed(p):
        total = total * x + number
    return total


def derivative_coefficients(p: PolynomialCoefficients) -> list[Fraction]:
    """The coefficients of p'."""
    return [k * number for k, number in enumerate(p)][1:]


def approximate_minimum(p: PolynomialCoefficients, low: Fraction | None, high: Fraction | None) -> float:
    """The least value on [low, high] (None: infinite), in doubles; -inf where p has no lower bound."""
    p = _trim_zeros(p)
    if len(p) > 1 and ((high is None and p[-1] < 0) or (low is None and (p[-1] > 0) == (len(p) % 2 == 0))):
        return -np.inf
    critical = np.roots([float(number) for number in reversed(derivative_coefficients(p))]) if len(p) > 2 else np.zeros(0)
    a, b = (-np.inf if low is None else float(low)), (np.inf if high is None else float(high))
    points = [float(root.real) for root in critical if a < root.real < b]
    points += [end for end in (a, b) if np.isfinite(end)] or [0.0]
    return min(float(evaluate_at(p, Fraction(point))) for point in points)


def polynomial_lower_bound(p: PolynomialCoefficients, low: Fraction | None, high: Fraction | None) -> float:
    """A double that p nowhere falls below on [low, high] (None: infinite), the largest one but for rounding; -inf: no bound."""
    p = _trim_zeros(p)
    if len(p) > 1 and ((high is None and p[-1] < 0) or (low is None and (p[-1] > 0) == (len(p) % 2 == 0))):
        return -np.inf
    values = [evaluate_at(p, end) for end in (low, high) if end is not None] + (
        [evaluate_at(p, Fraction(0))] if low is None and high is None else []
    )
    slope = derivative_coefficients(p)
    for a, b in real_roots(slope, low, high) if any(slope) else []:
        steepest = evaluate_at([abs(number) for number in slope], max(abs(a), abs(b)))
        values.append(evaluate_at(p, a) - steepest * (b - a))
    return round_down(min(values))


def real_roots(
    p: PolynomialCoefficients, low: Fraction | None = None, high: Fraction | None = None
) -> list[tuple[Fraction, Fraction]]:  # fmt: skip
    """Enclosures (from, to) of the distinct real roots of p != 0 in [low, high] (None: infinite), in order, none meeting another.

    A rational root is given as itself.

    >>> [float(a) for a, b in real_roots([Fraction(-1), Fraction(0), Fraction(4)])]
    [-0.5, 0.5]
    """
    from flint import ctx, fmpz_poly

    p = _trim_zeros(p)
    if len(p) < 2:
        return []
    common = lcm(*(number.denominator for number in p))
    whole, ends = fmpz_poly([int(number * common) for number in p]), [end for end in (low, high) if end is not None]
    linear = [factor for factor, _ in whole.factor()[1] if factor.degree() == 1]
    exact, bits, before = {Fraction(-int(factor[0]), int(factor[1])) for factor in linear}, INITIAL_PRECISION, ctx.prec
    try:
        while True:
            ctx.prec = bits
            roots: Any = whole.complex_roots()
            real = [root.real for root, _ in roots if root.imag.is_zero()]
            found = sorted((_fraction_from_ball(root.lower()), _fraction_from_ball(root.upper())) for root in real)
            found = [next(((end, end) for end in exact if a <= end <= b), (a, b)) for a, b in found]
            if all(a == b or not any(a <= end <= b for end in (*ends, *exact)) for a, b in found):
                return [(a, b) for a, b in found if (low is None or a >= low) and (high is None or b <= high)]
            bits *= 2
    finally:
        ctx.prec = before


def _fraction_from_ball(number: Any) -> Fraction:
    """An exact ball of FLINT."""
    mantissa, exponent = (int(part) for part in number.man_exp())
    return Fraction(mantissa) * Fraction(2) ** exponent


def _trim_zeros(p: PolynomialCoefficients) -> list[Fraction]:
    out = list(p)
    while out and not out[-1]:
        out.pop()
    return out


def _points_between_roots(p: list[Fraction], a: Fraction, b: Fraction) -> list[Fraction]:
    """Points of (a, b) that, with a and b, meet each gap between two distinct roots in [a, b]."""
    return [(left[1] + right[0]) / 2 for left, right in pairwise(real_roots(p, a, b))] if a < b else []
