"""How fast an expression of several states can grow: |e(x)| <= sum C (alpha |x| + gamma)^p on a box with infinite ends.

Each value e of the graph is kept between sums of monomials in *atoms*, the sizes |a'x + c| of the affine values met:

    sum_i l_i <= |e| <= sum_j u_j / (D_j1 D_j2 ...),   l, u, D with coefficients > 0,

so that common factors of numerators and denominators still meet when the bound is evaluated. The rules:

- |a + b| <= |a| + |b|, and where both have one sign |a + b| = |a| + |b|; |a b| = |a| |b|; |a / b| = |a| / |b|.
- (m_1 + ... + m_N)^q lies between sum m_i^q and N^(q-1) sum m_i^q, whichever is the larger (q >= 1: the second).
- e^(-u) <= 1 / (1 + u + u^2/2 + u^3/6) for u >= 0; |log u| <= |log a| + sqrt(u) for u >= a > 0; log(1 + u) <= sqrt(u) for u >= 0;
  log(c + e^u) <= |u| + |log c| + log 2 for c > 0. What is bounded on the box is bounded by its largest value there.

A quotient m / D with D = sum c_k m_k is bounded by the inequality between weighted means, D >= prod (c_k m_k / w_k)^(w_k) for
weights w >= 0 with sum 1: a linear program takes the weights that leave the least power, with no exponent below 0.

Sums of monomials in sizes, below and above the size of a value; each is rounded to its side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval_bounds, polynomial
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import Instruction, Program, program

# Terms of a bound; where there are more nothing is proved. A product has the terms of one factor times those of the other.
MAX_BOUND_TERMS = 60
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
    return tuple((size * number / ROUND_UP_FACTOR, monomial) for size, monomial in a)


def multiply_lower_sums(a: MonomialSum, b: MonomialSum) -> MonomialSum:
    """The product, rounded down; empty where it is too long."""
    return (
        tuple((x * y / ROUND_UP_FACTOR, _multiply_monomials(m, k)) for x, m in a for y, k in b)
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
    """The sum of two quotients as a list of terms."""
    return None if a is None or b is None else a + b


def multiply_terms(a: tuple[QuotientTerm, ...] | None, b: tuple[QuotientTerm, ...] | None) -> tuple[QuotientTerm, ...] | None:
    """The product, rounded up; None where it is too long."""
    if a is None or b is None or len(a) * len(b) > MAX_BOUND_TERMS:
        return None
    return tuple(
        QuotientTerm(x.size * y.size * ROUND_UP_FACTOR, _multiply_monomials(x.monomial, y.monomial), x.below + y.below)
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


LOG_2 = 0.6931471805599454  # log 2, rounded up in its last digit: log(a + b) <= log 2 + max(log a, log b).


class PowerBound(NamedTuple):
    """size (alpha |x| + gamma)^p, p >= 0."""

    size: float
    alpha: float
    gamma: float
    p: Fraction


class SizeBounds(NamedTuple):
    """low <= e <= high, lower <= |e| <= sum of upper (None: no bound); ``number``: e has a value all over the box."""

    low: float
    high: float
    lower: MonomialSum
    upper: tuple[QuotientTerm, ...] | None
    number: bool


@dataclass(frozen=True)
class AffineAtom:
    """|a'x + c| <= alpha |x| + gamma, and <= most on the box."""

    alpha: float
    gamma: float
    most: float


def growth_bound(expr: ca.SX, x: ca.SX, low: np.ndarray, high: np.ndarray, n: int | None = None) -> tuple[PowerBound, ...] | None:
    """Bounds of a scalar on the box, in |(x_0, ..., x_(n-1))|; the other symbols must be bounded. None: no bound was found."""
    code = program(ca.densify(expr), x)
    calculus = _GrowthCalculus(code, low, high, x.numel() if n is None else n)
    with np.errstate(all="ignore"):
        upper = calculus.sizes()[code.outputs[0]].upper
        if upper is None:
            return None
        powers = [calculus.resolved(term) for term in upper]
    return None if any(power is None for power in powers) else tuple(power for power in powers if power is not None)


def linear_growth_bound(powers: Sequence[PowerBound], scale: float) -> tuple[float, float] | None:
    """(a, b) with sum of the powers <= a + b |x|: t^p <= p s^(p-1) t + (1 - p) s^p at s = ``scale``; None where some p > 1."""
    a = b = 0.0
    for size, alpha, gamma, p in powers:
        if p > 1:
            return None
        slope = float(p) * scale ** float(p - 1) if p else 0.0
        a += size * (slope * gamma + float(1 - p) * scale ** float(p)) * (1 + 1e-9)
        b += size * slope * alpha * (1 + 1e-9)
    return a, b


class _GrowthCalculus:
    def __init__(self, code: Program, low: np.ndarray, high: np.ndarray, n: int) -> None:
        self.code, self.n = code, n
        with np.errstate(all="ignore"):
            values, numbers = interval_bounds.run_with_numbers(code, low[None, :], high[None, :])
        self.numbers = [bool(own.all()) for own in numbers]
        self.ends = [(float(np.min(lo)), float(np.max(hi))) for lo, hi in values]
        self.atoms: list[AffineAtom] = []
        self.known: dict[tuple, int] = {}
        self.found: list[SizeBounds] = []

    def sizes(self) -> list[SizeBounds]:
        """The bounds of every value."""
        affine: list[polynomial.Polynomial | None] = []
        out: list[SizeBounds] = []
        self.found = out
        for i, step in enumerate(self.code.steps):
            p: polynomial.Polynomial | None
            if step.op == ca.OP_INPUT:
                p = {((step.slot, 1),): Fraction(1)}
            elif step.op == ca.OP_CONST:
                p = polynomial.constant_polynomial(step.number)
            else:
                p = polynomial.apply_to_polynomials(step.op, [affine[j] for j in step.sources])
            p = p if p is not None and polynomial.degree(p) <= 1 else None
            affine.append(p)
            out.append(self._bounds_of_value(i, step, out, p))
        return out

    def _bounds_of_value(self, i: int, step: Instruction, out: list[SizeBounds], p: polynomial.Polynomial | None) -> SizeBounds:
        low, high = self.ends[i]
        if p is not None and not polynomial.is_constant(p):
            number, atom = self._affine_atom(p, max(abs(low), abs(high)))
            lower, upper = (
                ((number / ROUND_UP_FACTOR, ((atom, Fraction(1)),)),),
                (QuotientTerm(number * ROUND_UP_FACTOR, ((atom, Fraction(1)),)),),
            )
        else:
            lower, upper = self._operation_bounds(step, [out[j] for j in step.sources])
        sign = low > 0 or high < 0
        most = max(abs(low), abs(high))
        plain = upper is None or not all(term.below for term in upper)
        if np.isfinite(most) and plain and (p is None or polynomial.is_constant(p)):
            upper = (QuotientTerm(most, ()),) if most else ()
        if not lower and sign:
            lower = ((min(abs(low), abs(high)), ()),)
        return SizeBounds(
            low, high, lower[:MAX_BOUND_TERMS],
            upper if upper is not None and len(upper) <= MAX_BOUND_TERMS else None, self.numbers[i],
        )  # fmt: skip

    def _affine_atom(self, p: polynomial.Polynomial, most: float) -> tuple[float, int]:
        """The factor and the atom of an affine value."""
        linear_part = sorted((monomial[0][0], number) for monomial, number in p.items() if monomial)
        first, offset = linear_part[0][1], p.get((), Fraction(0))
        key = (tuple((j, number / first) for j, number in linear_part), offset / first)
        if key not in self.known:
            self.known[key] = len(self.atoms)
            size = abs(float(first))
            alpha = float(np.linalg.norm([float(number / first) for j, number in linear_part if j < self.n])) * ROUND_UP_FACTOR
            self.atoms.append(AffineAtom(alpha, abs(float(offset / first)) * ROUND_UP_FACTOR, most / size * ROUND_UP_FACTOR))
            if any(j >= self.n for j, _ in linear_part):  # other symbols, bounded ones
                own = math.fsum(self._symbol_bound(j) * abs(float(number / first)) for j, number in linear_part if j >= self.n)
                self.atoms[-1] = AffineAtom(alpha, self.atoms[-1].gamma + own * ROUND_UP_FACTOR, most / size * ROUND_UP_FACTOR)
        return abs(float(first)), self.known[key]

    def _symbol_bound(self, slot: int) -> float:
        return next((max(abs(a) for a in self.ends[i]) for i, s in enumerate(self.code.steps) if s.slot == slot), np.inf)

    def _operation_bounds(self, step: Instruction, args: list[SizeBounds]) -> tuple[MonomialSum, tuple[QuotientTerm, ...] | None]:
        if step.op == ca.OP_CONST:
            number = abs(step.number)
            return (((number, ()),) if number else ()), ((QuotientTerm(number, ()),) if number else ())
        if not args:
            return (), None
        if step.op in (ca.OP_LOG, ca.OP_LOG1P):
            return (), self._log_bound(step.op, step, args[0])
        return _operation_size_bounds(step.op, args[0], args[-1])

    def _log_bound(self, op: int, step: Instruction, a: SizeBounds) -> tuple[QuotientTerm, ...] | None:
        inner = self.code.steps[step.sources[0]]
        parts = [step.sources[0]] if op == ca.OP_LOG1P else list(inner.sources) if inner.op == ca.OP_ADD else []
        exponents = [j for j in parts if self.code.steps[j].op == ca.OP_EXP]
        numbers = [self.code.steps[j].number for j in parts if self.code.steps[j].op == ca.OP_CONST]
        numbers = [1.0] if op == ca.OP_LOG1P else numbers
        if len(exponents) == 1 and len(numbers) == 1 and numbers[0] > 0:
            u = self.found[self.code.steps[exponents[0]].sources[0]].upper
            return add_terms(u, (QuotientTerm((abs(float(np.log(numbers[0]))) + LOG_2) * ROUND_UP_FACTOR, ()),))
        if op == ca.OP_LOG1P:
            return raise_terms(a.upper, Fraction(1, 2)) if a.low >= 0 else None
        if not a.low > 0:
            return None
        return add_terms(
            raise_terms(a.upper, Fraction(1, 2)), (QuotientTerm(max(-float(np.log(a.low)), 0.0) * ROUND_UP_FACTOR, ()),)
        )

    def resolved(self, term: QuotientTerm) -> PowerBound | None:
        """The bound of a term as a power of |x|."""
        weights = self._mean_weights(term)
        if weights is None:
            return None
        size, left = term.size, dict(term.monomial)
        for below, own in zip(term.below, weights, strict=True):
            for (number, monomial), w in zip(below, own, strict=True):
                if w:
                    size *= (float(w) / number) ** float(w) * (1 + 1e-10)
                    for atom, power in monomial:
                        left[atom] = left.get(atom, Fraction(0)) - w * power
        if any(power < 0 for power in left.values()):
            return None
        alpha = gamma = 0.0
        p = Fraction(0)
        for atom, power in left.items():
            most = self.atoms[atom].most
            if np.isfinite(most):
                size *= most ** float(power) * (1 + 1e-10)
            elif power:
                alpha, gamma, p = max(alpha, self.atoms[atom].alpha), max(gamma, self.atoms[atom].gamma), p + power
        return PowerBound(size * (1 + 1e-9), alpha, gamma, p) if np.isfinite(size) else None

    def _mean_weights(self, term: QuotientTerm) -> list[list[Fraction]] | None:
        """Weights of the monomials of each denominator that leave the least power."""
        if not term.below:
            return []
        from scipy.optimize import linprog

        atoms = sorted({atom for atom, _ in term.monomial} | {atom for below in term.below for _, m in below for atom, _ in m})
        columns = [(j, dict(monomial)) for j, below in enumerate(term.below) for _, monomial in below]
        taken = np.array([[float(m.get(atom, 0)) for _, m in columns] for atom in atoms]).reshape(len(atoms), len(columns))
        have = np.array([float(dict(term.monomial).get(atom, 0)) for atom in atoms])
        free = np.array([0.0 if np.isfinite(self.atoms[atom].most) else 1.0 for atom in atoms])
        sums = np.array([[float(j == i) for j, _ in columns] for i in range(len(term.below))])
        found = linprog(
            -(free + 1e-3) @ taken, A_ub=taken, b_ub=have, A_eq=sums, b_eq=np.ones(len(term.below)), bounds=(0, 1), method="highs"
        )
        if found.status != 0:
            return None
        for most in (12, 1000, 10**6):
            weights, place = [], 0
            for below in term.below:
                own = [Fraction(float(w)).limit_denominator(most) for w in found.x[place : place + len(below)]]
                largest = max(range(len(own)), key=lambda k: own[k])
                own[largest] += 1 - sum(own)
                weights.append(own)
                place += len(below)
            if all(w >= 0 for own in weights for w in own) and self._has_no_negative_power(term, weights):
                return weights
        return None

    @staticmethod
    def _has_no_negative_power(term: QuotientTerm, weights: list[list[Fraction]]) -> bool:
        left = dict(term.monomial)
        for below, own in zip(term.below, weights, strict=True):
            for (_, monomial), w in zip(below, own, strict=True):
                for atom, power in monomial:
                    left[atom] = left.get(atom, Fraction(0)) - w * power
        return all(power >= 0 for power in left.values())


# -- rules -------------------------------------------------------------------------------------------------------------


def _operation_size_bounds(op: int, a: SizeBounds, b: SizeBounds) -> tuple[MonomialSum, tuple[QuotientTerm, ...] | None]:
    """Lower and upper bounds of the size of an operation's value, from those of its first and its last argument."""
    if op in (ca.OP_NEG, ca.OP_FABS, ca.OP_ASSIGN):
        return a.lower, a.upper
    if op == ca.OP_TWICE:
        return multiply_lower_sums(a.lower, ((2.0, ()),)), multiply_terms(a.upper, (QuotientTerm(2.0, ()),))
    if op in (ca.OP_ADD, ca.OP_SUB):
        b_low, b_high = (b.low, b.high) if op == ca.OP_ADD else (-b.high, -b.low)
        alike = (a.low >= 0 and b_low >= 0) or (a.high <= 0 and b_high <= 0)
        return (a.lower + b.lower if alike else ()), add_terms(a.upper, b.upper)
    if op == ca.OP_MUL:
        return multiply_lower_sums(a.lower, b.lower), multiply_terms(a.upper, b.upper)
    if op == ca.OP_SQ:
        return power_of_sum(a.lower, Fraction(2), below=True), multiply_terms(a.upper, a.upper)
    if op in (ca.OP_DIV, ca.OP_INV):
        top = a.upper if op == ca.OP_DIV else (QuotientTerm(1.0, ()),)
        return (), divide_terms(top, b.lower)
    if op == ca.OP_SQRT:
        return (
            (power_of_sum(a.lower, Fraction(1, 2), below=True), raise_terms(a.upper, Fraction(1, 2)))
            if a.low >= 0
            else ((), None)
        )
    if op in (ca.OP_POW, ca.OP_CONSTPOW) and b.low == b.high:
        return _power_size_bounds(a, Fraction(b.low))
    if op == ca.OP_HYPOT:
        return multiply_lower_sums(a.lower + b.lower, ((0.7071067811865, ()),)), add_terms(a.upper, b.upper)
    return _function_size_bounds(op, a, b)


def _power_size_bounds(a: SizeBounds, c: Fraction) -> tuple[MonomialSum, tuple[QuotientTerm, ...] | None]:
    if c > 0 and (a.low >= 0 or c.denominator == 1):
        return power_of_sum(a.lower, c, below=True), raise_terms(a.upper, c)
    if c < 0 and (a.low >= 0 or c.denominator == 1):
        return (), divide_terms((QuotientTerm(1.0, ()),), power_of_sum(a.lower, -c, below=True))
    return (), None


def _function_size_bounds(op: int, a: SizeBounds, b: SizeBounds) -> tuple[MonomialSum, tuple[QuotientTerm, ...] | None]:
    """The same of what is no arithmetic."""
    if op in (ca.OP_FMAX, ca.OP_FMIN):
        numbers = a.number and b.number  # else it may be the other one, whichever is smaller
        if op == ca.OP_FMIN and numbers and a.low >= 0 and b.low >= 0:
            return (), a.upper if a.upper is not None and (b.upper is None or len(a.upper) <= len(b.upper)) else b.upper
        lower = a.lower if a.low >= 0 else b.lower if b.low >= 0 else ()
        return (lower if op == ca.OP_FMAX and numbers else ()), add_terms(a.upper, b.upper)
    if op in (ca.OP_FLOOR, ca.OP_CEIL):
        return (), add_terms(a.upper, (QuotientTerm(1.0, ()),))
    if op == ca.OP_IF_ELSE_ZERO:
        return (), b.upper
    if op in (ca.OP_SIN, ca.OP_TANH, ca.OP_ATAN, ca.OP_ASINH):
        return (), a.upper
    if op == ca.OP_EXP and a.high <= 0:
        square, cube = multiply_lower_sums(a.lower, a.lower), power_of_sum(a.lower, Fraction(3), below=True)
        u = ((1.0, ()), *a.lower, *scale_sum(square, 0.5), *scale_sum(cube, 1 / 6))
        return (), divide_terms((QuotientTerm(1.0, ()),), u)
    return (), None
