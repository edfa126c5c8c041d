"""Polynomials that are sums of squares, p = m'G m with a vector m of monomials and G psd: found in doubles, proved in fractions.

An interior-point method finds a G that is as positive definite as it can be. Rounded to fractions and projected onto the affine
space {G : m'G m = p} (Peyrl and Parrilo 2008) it is still psd if it was so by more than the rounding. If no G is definite, all of
them have a common kernel, which a solution shows: p is then written in the monomials' combinations that vanish on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from nsmodel.proof import conic, exact, polynomial
from nsmodel.proof.polynomial import Polynomial

# Rows of the Gram matrix of a semidefinite program, those of degree 4 in 8 variables: 45 take 2 s; more are not tried.
MAX_GRAM_MONOMIALS = 45
# Times that the kernel of a Gram matrix, known in doubles, is taken out of it: each leaves a smaller one.
MAX_KERNEL_REDUCTIONS = 4
# Of the rational numbers that a Gram matrix in doubles is rounded to, where 20 are too few: 2^-40 is below the solver's error.
ROUNDING_BITS = 40
MonomialPowers = tuple[int, ...]


class SosDecomposition(NamedTuple):
    """P = m'G m with the monomials m, given by their powers, and a psd G of Fractions."""

    monomials: list[MonomialPowers]
    G: np.ndarray


def sos_decomposition(p: Polynomial, n: int, monomials: Sequence[MonomialPowers] | None = None) -> SosDecomposition | None:
    """Return p, in n variables, as a sum of squares, proved in rational arithmetic; None where that is not found.

    >>> p = {((0, 4),): Fraction(1), ((0, 2), (1, 2)): Fraction(-2), ((1, 4),): Fraction(1)}  # (x^2 - y^2)^2
    >>> sos_decomposition(p, 2).monomials
    [(2, 0), (1, 1), (0, 2)]
    """
    target = {_monomial_powers(monomial, n): number for monomial, number in p.items()}
    if not target:
        return SosDecomposition([], exact.zeros(0, 0))
    m = _prune_monomials(list(_half_degree_monomials(target, n)) if monomials is None else list(monomials), target)
    if not m or len(m) > MAX_GRAM_MONOMIALS or not _covers_target(m, target):
        return None
    unit, size, scaled = _scaled_target(target, n)
    G = _gram_matrix(m, scaled)
    if G is None:
        return None
    back = exact.rational([[1 / _unit_scale(power, unit)] for power in m])
    return SosDecomposition(m, G * back * back.T * size)


def is_sos_convex(p: Polynomial, n: int) -> bool:
    """Whether p is proved convex: y'D2p(x) y is a sum of squares of forms that are linear in y.

    >>> is_sos_convex({((0, 4),): Fraction(1), ((0, 2), (1, 2)): Fraction(2), ((1, 4),): Fraction(1)}, 2)  # (x^2 + y^2)^2
    True
    """
    return all(_sos_convexity_decomposition(part) is not None for part in _coupled_parts(p))


def sos_lower_bound(p: Polynomial, n: int) -> Fraction | None:
    """A number c with p - c proved to be a sum of squares, close to the largest one; None where none is found."""
    target = {_monomial_powers(monomial, n): number for monomial, number in p.items()}
    zero = (0,) * n
    offset = target.pop(zero, Fraction(0))
    if not target:
        return offset
    m = _prune_monomials(list(_half_degree_monomials({**target, zero: Fraction(1)}, n)), {**target, zero: Fraction(1)})
    if not m or len(m) > MAX_GRAM_MONOMIALS or zero not in m or not _covers_target(m, target):
        return None
    _, size, scaled = _scaled_target(target, n)
    best = _largest_constant(m, scaled)
    if best is None:
        return None
    step = 1 + abs(best)
    for level in (
        (Fraction(best) * size).limit_denominator(1000) / size,
        *(Fraction(best - less * step) for less in (1e-7, 1e-5, 1e-3)),
    ):
        if float(level) <= best + 1e-6 * step:
            wanted = {**scaled, zero: -level} if level else scaled
            if _gram_matrix(_prune_monomials(m, wanted), wanted) is not None:
                return offset + level * size
    return None


# -- monomials ---------------------------------------------------------------------------------------------------------


def _monomial_powers(monomial: polynomial.Monomial, n: int) -> MonomialPowers:
    powers = dict(monomial)
    return tuple(powers.get(i, 0) for i in range(n))


def _add_powers(a: MonomialPowers, b: MonomialPowers) -> MonomialPowers:
    return tuple(i + j for i, j in zip(a, b, strict=True))


def _half_degree_monomials(target: dict[MonomialPowers, Fraction], n: int) -> list[MonomialPowers]:
    """Monomials whose squares have powers between those of p, altogether and in each variable."""
    most = [max(power[i] for power in target) // 2 for i in range(n)]
    degrees = [sum(power) for power in target]
    least, largest = -(-min(degrees) // 2), max(degrees) // 2
    if np.prod([k + 1.0 for k in most]) > 50_000:
        return []
    return [power for power in product(*(range(k, -1, -1) for k in most)) if least <= sum(power) <= largest]


def _prune_monomials(m: list[MonomialPowers], target: dict[MonomialPowers, Fraction]) -> list[MonomialPowers]:
    """Without monomials whose square is in no other product and not in p: their rows of G are 0."""
    while True:
        others = {_add_powers(a, b) for i, a in enumerate(m) for b in m[:i]}
        kept = [a for a in m if (double := _add_powers(a, a)) in others or target.get(double, Fraction(0)) > 0]
        if len(kept) == len(m) or len(kept) > 4 * MAX_GRAM_MONOMIALS:
            return kept
        m = kept


def _covers_target(m: list[MonomialPowers], target: dict[MonomialPowers, Fraction]) -> bool:
    return set(target) <= {_add_powers(a, b) for a in m for b in m}


def _variable_units(target: dict[MonomialPowers, Fraction], n: int) -> list[int]:
    """Powers of 2 as units of the variables in which the coefficients are of one size."""
    A = np.array([[*power, 1.0] for power in target])
    b = np.array([float(_approximate_log2(abs(number))) for number in target.values()])
    return [-round(k) for k in np.linalg.lstsq(A, b, rcond=None)[0][:n]]


def _unit_scale(power: MonomialPowers, unit: Sequence[int]) -> Fraction:
    return Fraction(2) ** sum(k * u for k, u in zip(power, unit, strict=True))


def _scaled_target(target: dict[MonomialPowers, Fraction], n: int) -> tuple[list[int], Fraction, dict[MonomialPowers, Fraction]]:
    """These units, the size of the largest coefficient in them, and the coefficients as parts of that size."""
    unit = _variable_units(target, n)
    size = Fraction(2) ** _approximate_log2(max(abs(number) * _unit_scale(power, unit) for power, number in target.items()))
    return unit, size, {power: number * _unit_scale(power, unit) / size for power, number in target.items()}


def _approximate_log2(number: Fraction) -> int:
    return number.numerator.bit_length() - number.denominator.bit_length()


# -- Gram matrices -----------------------------------------------------------------------------------------------------


class _GramSpace(NamedTuple):
    """{Y : w'Y w = p} with w = W'm: rows of ``A`` on the entries i <= j of Y give the coefficients ``b``."""

    A: np.ndarray
    b: np.ndarray


def _gram_matrix(m: list[MonomialPowers], target: dict[MonomialPowers, Fraction]) -> np.ndarray | None:
    """A psd G of Fractions with m'G m = p."""
    if not m or not _covers_target(m, target):
        return None
    W = exact.eye(len(m))
    for _ in range(MAX_KERNEL_REDUCTIONS):
        space = _gram_space(m, W, target)
        found = _most_definite_gram(space, W.shape[1])
        if found is None:
            return None
        Y, least = found
        for bits in (20, ROUNDING_BITS):
            fixed = _project_on_space(space, Y, bits) if least > -1e-5 else None
            if fixed is not None and exact.is_psd(fixed):
                G = exact.matrix_product(W, fixed, W.T)
                return G if _gram_coefficients(m, G) == {power: number for power, number in target.items() if number} else None
        kernel = _approximate_kernel(Y)
        if kernel is None or least < -1e-4:
            return None
        W = exact.matrix_product(W, exact.nullspace(kernel.T))
        if not W.shape[1]:
            return None
    return None


def _gram_coefficients(m: list[MonomialPowers], G: np.ndarray) -> dict[MonomialPowers, Fraction]:
    """The coefficients of m'G m."""
    total: dict[MonomialPowers, Fraction] = {}
    for i, a in enumerate(m):
        for j, b in enumerate(m):
            power = _add_powers(a, b)
            total[power] = total.get(power, Fraction(0)) + G[i, j]
    return {power: number for power, number in total.items() if number}


def _gram_space(m: list[MonomialPowers], W: np.ndarray, target: dict[MonomialPowers, Fraction]) -> _GramSpace:
    r = W.shape[1]
    rows = {power: i for i, power in enumerate(dict.fromkeys(_add_powers(a, b) for a in m for b in m))}
    A, b = exact.zeros(len(rows), r * (r + 1) // 2), exact.zeros(len(rows), 1)
    for power, number in target.items():
        b[rows[power], 0] = number
    used = [[k for k in range(len(m)) if W[k, j]] for j in range(r)]
    for column, (i, j) in enumerate(_upper_triangle_pairs(r)):
        for k in used[i]:
            for l in used[j]:
                row = rows[_add_powers(m[k], m[l])]
                A[row, column] += W[k, i] * W[l, j] * (1 if i == j else 2)
    return _GramSpace(A, b)


@lru_cache
def _upper_triangle_pairs(r: int) -> list[tuple[int, int]]:
    """Entries of the upper triangle, column by column, as Clarabel has them."""
    return [(i, j) for j in range(r) for i in range(j + 1)]


def _most_definite_gram(space: _GramSpace, r: int) -> tuple[np.ndarray, float] | None:
    """Y and its least eigenvalue, as large as possible up to 1, in doubles."""
    pairs = _upper_triangle_pairs(r)
    A, b = exact.doubles(space.A), exact.doubles(space.b).ravel()
    weight = np.array([1.0 if i == j else np.sqrt(2.0) for i, j in pairs])
    unit = np.array([float(i == j) for i, j in pairs])
    rows = np.vstack([
        np.column_stack([A, np.zeros(len(A))]), np.append(np.zeros(len(pairs)), 1.0)[None],
        np.column_stack([-np.diag(weight), unit]),
    ])  # fmt: skip
    right = np.concatenate([b, [1.0], np.zeros(len(pairs))])
    cones = [conic.zero_cone(len(A)), conic.nonnegative_cone(1), conic.semidefinite_cone(r)]
    solution = conic.solve_conic_program(np.append(np.zeros(len(pairs)), -1.0), rows, right, cones)
    x = np.array(solution.x)
    if not np.isfinite(x).all() or str(solution.status) not in ("Solved", "AlmostSolved", "InsufficientProgress"):
        return None
    return _symmetric_from_entries(x[:-1], r), float(x[-1])


def _symmetric_from_entries(entries: np.ndarray, r: int) -> np.ndarray:
    Y = np.zeros((r, r), dtype=entries.dtype) if entries.dtype != object else exact.zeros(r, r)
    for entry, (i, j) in zip(entries, _upper_triangle_pairs(r), strict=True):
        Y[i, j] = Y[j, i] = entry
    return Y


def _project_on_space(space: _GramSpace, Y: np.ndarray, bits: int) -> np.ndarray | None:
    """The nearest point of the affine space to Y, rounded, in fractions."""
    y = exact.rational([[Fraction(round(Y[i, j] * 2.0**bits), 2**bits)] for i, j in _upper_triangle_pairs(len(Y))])
    residual = space.b - exact.matrix_product(space.A, y)
    solved = exact.solve_linear_system(exact.matrix_product(space.A, space.A.T), residual)
    return None if solved is None else _symmetric_from_entries((y + exact.matrix_product(space.A.T, solved)).ravel(), len(Y))


def _approximate_kernel(Y: np.ndarray) -> np.ndarray | None:
    """A basis of small fractions of what looks like the kernel of Y."""
    values, vectors = np.linalg.eigh(Y)
    count = int(np.count_nonzero(values < 1e-4 * max(values[-1], 1e-3)))
    if not count:
        return None
    N = vectors[:, :count].T.copy()
    pivots: list[int] = []
    for row in range(count):  # reduced echelon form, the largest pivots first
        free = [j for j in range(N.shape[1]) if j not in pivots]
        j = free[int(np.argmax(np.abs(N[row, free])))]
        N[row] /= N[row, j]
        for other in range(count):
            if other != row:
                N[other] -= N[other, j] * N[row]
        pivots.append(j)
    return np.array([[Fraction(float(entry)).limit_denominator(64) for entry in row] for row in N], dtype=object).T


def _largest_constant(m: list[MonomialPowers], target: dict[MonomialPowers, Fraction]) -> float | None:
    """The largest c for which p - c is a sum of squares, in doubles."""
    r, zero = len(m), (0,) * len(m[0])
    space = _gram_space(m, exact.eye(r), target)
    rows = {power: i for i, power in enumerate(dict.fromkeys(_add_powers(a, b) for a in m for b in m))}
    pairs = _upper_triangle_pairs(r)
    A, b = exact.doubles(space.A), exact.doubles(space.b).ravel()
    level = np.zeros(len(A))
    level[rows[zero]] = 1.0
    weight = np.array([1.0 if i == j else np.sqrt(2.0) for i, j in pairs])
    whole = np.vstack([np.column_stack([A, level]), np.column_stack([-np.diag(weight), np.zeros(len(pairs))])])
    cones = [conic.zero_cone(len(A)), conic.semidefinite_cone(r)]
    solution = conic.solve_conic_program(
        np.append(np.zeros(len(pairs)), -1.0), whole, np.concatenate([b, np.zeros(len(pairs))]), cones
    )
    best = float(solution.x[-1])
    solved = str(solution.status) in ("Solved", "AlmostSolved", "InsufficientProgress")
    return best if solved and np.isfinite(best) and abs(best) < 1e12 else None


# -- convexity ---------------------------------------------------------------------------------------------------------


def _coupled_parts(p: Polynomial) -> list[Polynomial]:
    """The parts of p that share no variable, without its affine terms' own ones."""
    from nsmodel.proof.verdict import overlapping_groups

    terms = [(monomial, number) for monomial, number in p.items() if sum(power for _, power in monomial) > 1]
    groups = overlapping_groups([{variable for variable, _ in monomial} for monomial, _ in terms])
    return [dict(terms[i] for i in group) for group in groups]


def _sos_convexity_decomposition(p: Polynomial) -> SosDecomposition | None:
    used = polynomial.variables(p)
    n, place = len(used), {variable: i for i, variable in enumerate(used)}
    form: Polynomial = {}
    for i in used:
        for j in used:
            second = polynomial.partial_derivative(polynomial.partial_derivative(p, i), j)
            both = [(n + place[i], 1), (n + place[j], 1)] if i != j else [(n + place[i], 2)]
            for monomial, number in second.items():
                key = tuple(sorted([*((place[v], power) for v, power in monomial), *both]))
                form = polynomial.add_multiple(form, {key: number})
    if not form:
        return SosDecomposition([], exact.zeros(0, 0))
    most = [max(dict(monomial).get(i, 0) for monomial in form) // 2 for i in range(n)]
    degrees = [sum(power for variable, power in monomial if variable < n) for monomial in form]
    least, largest = -(-min(degrees) // 2), max(degrees) // 2
    if max(degrees) % 2 or np.prod([k + 1.0 for k in most]) > 5000:
        return None
    inner = [power for power in product(*(range(k, -1, -1) for k in most)) if least <= sum(power) <= largest]
    rows = [(*power, *(int(k == i) for k in range(n))) for i in range(n) for power in inner]
    return sos_decomposition(form, 2 * n, rows)
