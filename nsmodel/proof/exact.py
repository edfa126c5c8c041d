"""Linear algebra in exact rational arithmetic, on doubles taken as the rational numbers that they are.

Matrices are NumPy arrays of dtype object that hold :class:`~fractions.Fraction`; ``+``, ``-`` and ``.T`` are NumPy's own, ranks,
solutions and products FLINT's. Signs of quadratic forms are found by elimination with diagonal pivots, on rows of whole numbers
without common factor, which keeps them short and leaves zeros alone.
"""

from __future__ import annotations

from fractions import Fraction
from math import gcd, lcm, log2
from typing import Any, NamedTuple

import numpy as np

from nsmodel.proof.verdict import connected_components

MACHINE_EPSILON = float(np.finfo(float).eps)  # 2^-52, relative: from 1 to the next double.
ROUND_UP_FACTOR = 1 + 1e-12  # Bounds formed of a few doubles are raised by it: it is more than a thousand operations lose.
ZERO = Fraction(0)
# Rows from which on a Cholesky factorisation in doubles with a rounding bound is tried first. Where it proves a matrix definite
# it takes 0.4 of the time of exact elimination for 12 rows, 0.1 for 30.
MIN_CHOLESKY_SIZE = 12


class Definiteness(NamedTuple):
    """Sign of the quadratic form v'Sv of a symmetric part S = (M + M')/2.

    Attributes:
        psd: v'Sv >= 0 for all v.
        definite: v'Sv > 0 for all v != 0.
        rank: of S where it is psd; otherwise the number of pivots > 0 met before the sign was clear.
        vector: (n,) doubles with v'Sv < 0 where S is not psd, None where it is.
    """

    psd: bool
    definite: bool
    rank: int
    vector: np.ndarray | None


def rational(matrix: Any) -> np.ndarray:
    """Return the matrix (or vector) with each entry as a Fraction, exactly.

    Raises:
        ValueError: an entry is not finite.

    >>> rational([[0.5, 0.1]])[0, 0]
    Fraction(1, 2)
    """
    entries = np.asarray(matrix)
    if entries.dtype == object and all(type(entry) is Fraction for entry in entries.flat):
        return entries
    if entries.dtype != object:
        entries = entries.astype(float)
        if not np.isfinite(entries).all():
            raise ValueError("exact arithmetic: an entry is not a finite number")
    out = np.empty(entries.shape, dtype=object)
    out.ravel()[:] = [
        entry if isinstance(entry, Fraction) else Fraction(entry) if entry else ZERO for entry in entries.ravel().tolist()
    ]
    return out


def doubles(matrix: np.ndarray) -> np.ndarray:
    """Return the doubles nearest to rational entries."""
    return np.array([float(entry) if entry else 0.0 for entry in matrix.ravel().tolist()]).reshape(matrix.shape)


def round_down(number: Fraction) -> float:
    """The largest double that is not above a number.

    >>> round_down(Fraction(1, 10)) < round_up(Fraction(1, 10)), round_down(Fraction(1, 2))
    (True, 0.5)
    """
    near = float(number)
    return near if Fraction(near) <= number else float(np.nextafter(near, -np.inf))


def round_up(number: Fraction) -> float:
    """The least double that is not below a number."""
    near = float(number)
    return near if Fraction(near) >= number else float(np.nextafter(near, np.inf))


def root_rounded_up(number: Fraction) -> float:
    """The least double that is not below the root of a number >= 0.

    >>> root_rounded_up(Fraction(4)), root_rounded_up(Fraction(2)) ** 2 > 2
    (2.0, True)
    """
    root = float(np.sqrt(round_up(number)))
    while root > 0 and Fraction(float(np.nextafter(root, 0.0))) ** 2 >= number:
        root = float(np.nextafter(root, 0.0))
    while Fraction(root) ** 2 < number:
        root = float(np.nextafter(root, np.inf))
    return root


def eye(n: int) -> np.ndarray:
    """The unit matrix (n, n)."""
    matrix = zeros(n, n)
    np.fill_diagonal(matrix, Fraction(1))
    return matrix


def zeros(rows: int, columns: int) -> np.ndarray:
    """The zero matrix."""
    matrix = np.empty((rows, columns), dtype=object)
    matrix.fill(ZERO)
    return matrix


def matrix_product(*factors: Any) -> np.ndarray:
    """Return the product of matrices, exactly.

    >>> bool(matrix_product([[0.1]], [[10.0]])[0, 0] == 1)
    False
    """
    result = _flint_matrix(rational(factors[0]))
    for factor in factors[1:]:
        result = result * _flint_matrix(rational(factor))
    return _fractions_from_flint(result)


def scalar_minus(number: Any, matrix: Any) -> np.ndarray:
    """Return number I - M for a square matrix M, exactly."""
    M = rational(matrix)
    out, filled, diagonal = zeros(*M.shape), np.nonzero(M), np.arange(len(M))
    out[filled] = -M[filled]
    out[diagonal, diagonal] += Fraction(number)
    return out


def is_symmetric(matrix: Any) -> bool:
    """Whether M = M', to the last bit."""
    M = rational(matrix)
    return M.shape[0] == M.shape[1] and bool((M == M.T).all())


def rank(matrix: Any) -> int:
    """Rank of a matrix."""
    return _flint_matrix(rational(matrix)).rank()


def nullspace(matrix: Any) -> np.ndarray:
    """Return a basis (n, k) of {v : M v = 0}, in columns; the free entries of v are a unit matrix."""
    rows, pivots = _reduced_echelon_form(rational(matrix))
    n = rows.shape[1]
    free = [j for j in range(n) if j not in set(pivots)]
    basis = zeros(n, len(free))
    for k, j in enumerate(free):
        basis[j, k] = Fraction(1)
        basis[pivots, k] = -rows[: len(pivots), j]
    return basis


def independent_columns(matrix: Any) -> list[int]:
    """Indices of the first columns that span the range of a matrix."""
    return _reduced_echelon_form(rational(matrix))[1]


def solve_linear_system(matrix: Any, right: Any) -> np.ndarray | None:
    """Return one X with M X = right (free entries 0), or None where there is none; ``right`` is (n, k)."""
    M, b = rational(matrix), rational(right)
    n = M.shape[1]
    if len(M) == n and (found := solve_regular_system(M, b)) is not None:
        return found
    rows, pivots = _reduced_echelon_form(np.hstack([M, b]))
    if any(pivot >= n for pivot in pivots):
        return None
    X = zeros(n, b.shape[1])
    X[pivots] = rows[: len(pivots), n:]
    return X


def solve_regular_system(matrix: Any, right: Any) -> np.ndarray | None:
    """Return the X with M X = right, or None where the square matrix M is singular; ``right`` is (n, k)."""
    M = _flint_matrix(rational(matrix))
    return None if M.rank() < M.nrows() else _fractions_from_flint(M.solve(_flint_matrix(rational(right))))


def determinant(matrix: Any) -> Fraction:
    """The determinant of a square matrix."""
    return _fraction_from_flint(_flint_matrix(rational(matrix)).det())


def inverse_matrix(matrix: Any) -> np.ndarray | None:
    """Return the inverse of a square matrix, or None where it is singular; blocks that nothing couples are inverted apart."""
    M = rational(matrix)
    out = zeros(*M.shape)
    for block in connected_components((M != 0) | (M.T != 0)):
        part = _flint_matrix(M[np.ix_(block, block)])
        if part.rank() < len(block):
            return None
        out[np.ix_(block, block)] = _fractions_from_flint(part.inv())
    return out


def _flint_matrix(M: np.ndarray) -> Any:
    """The matrix (m, n) as one of FLINT's."""
    from flint import fmpq, fmpq_mat

    zero = fmpq(0)
    entries = [fmpq(entry.numerator, entry.denominator) if entry else zero for entry in M.ravel().tolist()]
    return fmpq_mat(M.shape[0], M.shape[1], entries)


def _fraction_from_flint(number: Any) -> Fraction:
    return Fraction(int(number.p), int(number.q))


def _fractions_from_flint(matrix: Any) -> np.ndarray:
    out = np.empty((matrix.nrows(), matrix.ncols()), dtype=object)
    out.ravel()[:] = [_fraction_from_flint(entry) if entry else ZERO for entry in matrix.entries()]
    return out


def _reduced_echelon_form(M: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """The reduced echelon form, and its pivot columns."""
    rows = _fractions_from_flint(_flint_matrix(M).rref()[0])
    pivots = [int(np.flatnonzero(row)[0]) for row in rows if row.any()]
    return rows, pivots


def definiteness(matrix: Any) -> Definiteness:
    """Decide whether v'Mv >= 0 for all v, exactly on the given doubles or Fractions; M (n, n) need not be symmetric.

    The symmetric part is eliminated with diagonal pivots, one connected block of its nonzeros after the other.
    """
    S = _symmetric_part(matrix)
    total, definite = 0, True
    for block in connected_components(S != 0):
        part = _block_definiteness(S[np.ix_(block, block)])
        total, definite = total + part.rank, definite and part.definite
        if part.vector is not None:
            vector = np.zeros(len(S))
            vector[block] = part.vector
            return Definiteness(False, False, total, vector)
    return Definiteness(True, definite, total, None)


def eigenvalue_upper_bound(matrix: Any) -> float:
    """A double that no eigenvalue of the symmetric part exceeds, proved exactly; within some rounding of the largest one.

    >>> eigenvalue_upper_bound([[2.0, 1.0], [1.0, 2.0]])
    3.0
    """
    M = rational(matrix)
    if len(M) == 1:
        return round_up(M[0, 0])
    values = np.linalg.eigvalsh(doubles((M + M.T) / 2))
    top, size = float(values[-1]), float(np.abs(values).max(initial=0.0))
    for more in (0.0, 1e-16, 1e-15, 1e-14, 1e-12, 1e-9):
        bound = top + more * size
        if is_psd(scalar_minus(bound, M)):
            return bound
    return round_up(max(sum((abs(entry) for entry in row), Fraction(0)) for row in (M + M.T) / 2))  # Gershgorin


def is_psd(matrix: Any) -> bool:
    """Whether v'Mv >= 0 for all v, as ``psd`` but without a witness."""
    S = _symmetric_part(matrix)
    return all(_diagonal_pivots(S[np.ix_(block, block)])[1] is None for block in connected_components(S != 0))


def _symmetric_part(matrix: Any) -> np.ndarray:
    """The sum M + M' in exact numbers."""
    M = rational(matrix)
    S = M.copy()
    for i, j in zip(*np.nonzero(M.T), strict=True):
        S[i, j] = S[i, j] + M[j, i]
    return S


class _IntegerRows(NamedTuple):
    """Rows of whole numbers; row i is ``factors[i]`` times the rational one."""

    rows: np.ndarray
    factors: list[int]


def _integer_rows(M: np.ndarray) -> _IntegerRows:
    rows, factors = np.empty(M.shape, dtype=object), []
    for i, row in enumerate(M):
        factor = lcm(*(entry.denominator for entry in row))
        rows[i] = [entry.numerator * (factor // entry.denominator) for entry in row]
        factors.append(factor)
    return _IntegerRows(rows, factors)


def _primitive_row(row: np.ndarray) -> np.ndarray:
    """The row divided by the common factor of its entries."""
    common = gcd(*row)
    return row // common if common > 1 else row


def _eliminate_entry(row: np.ndarray, pivot_row: np.ndarray, j: int) -> np.ndarray:
    """Make row[j] = 0 with a multiple of a row whose entry j is > 0; the row is multiplied by a number > 0."""
    a, p = row[j], pivot_row[j]
    common = gcd(a, p)
    return _primitive_row((p // common) * row - (a // common) * pivot_row)


def _block_definiteness(S: np.ndarray) -> Definiteness:
    """Decide one block of rational entries."""
    chosen, direction = _diagonal_pivots(S)
    if direction is None:
        return Definiteness(True, len(chosen) == len(S), len(chosen), None)
    return Definiteness(False, False, len(chosen), _negative_vector(S, chosen, direction))


def _diagonal_pivots(S: np.ndarray) -> tuple[list[int], dict[int, int] | None]:
    """Rows with a pivot > 0, and a direction in which their Schur complement falls, None where there is none."""
    n = len(S)
    if n >= MIN_CHOLESKY_SIZE and _passes_verified_cholesky(S):
        return list(range(n)), None
    rows, chosen, left = _integer_rows(S).rows, [], list(range(n))
    while left:
        diagonal = {i: rows[i, i] for i in left}
        negative = [i for i in left if diagonal[i] < 0]
        if negative:
            return chosen, {negative[0]: 1}
        positive = [i for i in left if diagonal[i] > 0]
        if not positive:
            coupled = [(i, j) for i in left for j in left if rows[i, j]]
            if not coupled:
                break
            i, j = coupled[0]
            return chosen, {i: 1, j: -1 if rows[i, j] > 0 else 1}
        pivot = min(positive, key=lambda i: (np.count_nonzero(rows[i]), diagonal[i]))
        left.remove(pivot)
        chosen.append(pivot)
        for i in left:
            if rows[i, pivot]:
                rows[i] = _eliminate_entry(rows[i], rows[pivot], pivot)
    return chosen, None


def _negative_vector(S: np.ndarray, chosen: list[int], direction: dict[int, int]) -> np.ndarray:
    """Doubles v with v'Sv < 0: ``direction`` in the Schur complement of the rows ``chosen``, least in those rows."""
    v = zeros(len(S), 1)
    for i, entry in direction.items():
        v[i, 0] = Fraction(entry)
    if chosen:
        least = solve_linear_system(S[np.ix_(chosen, chosen)], -matrix_product(S[chosen], v))
        if least is not None:
            v[chosen] = least
    exact = v.ravel() / max(abs(entry) for entry in v.ravel())
    candidates = [doubles(exact)]
    scale = max(abs(entry) for entry in S.ravel())
    candidates.append(np.linalg.eigh(doubles(S / scale))[1][:, 0])
    for candidate in candidates:
        if matrix_product(candidate[None, :], S, candidate[:, None])[0, 0] < 0:
            return candidate
    return candidates[0]  # The sign is lost when v is rounded to doubles; the decision itself is exact.


def _scaled_double(number: Any, power: int) -> float:
    """The double nearest to a number divided by a power of 2."""
    return (number.numerator << max(-power, 0)) / (number.denominator << max(power, 0))


def _passes_verified_cholesky(S: np.ndarray) -> bool:
    """Whether a floating-point Cholesky factorisation of S - c I ends, c above all rounding (Rump 2006): a proof of S > 0."""
    n, diagonal = len(S), [entry for entry in np.diagonal(S)]
    if min(diagonal) <= 0:
        return False
    scale = [round((log2(s.numerator) - log2(s.denominator)) / 2) for s in diagonal]
    near = np.zeros((n, n))
    for i, j in zip(*np.nonzero(S), strict=True):
        near[i, j] = _scaled_double(S[i, j], scale[i] + scale[j])
    rounding = 8 * (n + 2) * MACHINE_EPSILON * (np.trace(near) + 2 * np.abs(near).sum(axis=1).max())
    try:
        np.linalg.cholesky(near - rounding * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    return True
