"""Exact linear algebra: against products written out in Fractions, planted inertia and floating-point eigenvalues."""

from fractions import Fraction

import numpy as np
import pytest

from nsmodel.proof import exact


def quadratic(v, M):
    """v'Mv of doubles, without rounding."""
    v = [Fraction(entry) for entry in v]
    return sum(v[i] * Fraction(M[i][j]) * v[j] for i in range(len(v)) for j in range(len(v)))


def times(A, B):
    """The product, one Fraction at a time."""
    rows, middle, columns = len(A), len(B), len(B[0])
    return [[sum((Fraction(A[i][k]) * Fraction(B[k][j]) for k in range(middle)), Fraction(0)) for j in range(columns)]
            for i in range(rows)]  # fmt: skip


def planted(rng, n):
    """A symmetric matrix of whole numbers with a known inertia: V diag(d) V', V unimodular; and d."""
    V = np.eye(n)
    for _ in range(3 * n):
        i, j = rng.choice(n, 2, replace=False) if n > 1 else (0, 0)
        if i != j:
            V[i] += rng.integers(-2, 3) * V[j]
    d = rng.integers(1, 4, n)
    if rng.random() < 0.6:
        d[rng.integers(0, n, 2)] = 0
    if rng.random() < 0.3:
        d[rng.integers(n)] = -1
    return V @ np.diag(d) @ V.T, d


def test_psd_finds_the_planted_inertia():
    rng = np.random.default_rng(0)
    seen = {"definite": 0, "singular": 0, "indefinite": 0}
    for _ in range(600):
        n = int(rng.integers(1, 9))
        S, d = planted(rng, n)
        units = 2.0 ** rng.integers(-30, 31, n)
        skew = np.triu(rng.integers(-5, 6, (n, n)), 1)
        M = (S + skew - skew.T) * np.outer(units, units)
        decided = exact.definiteness(M)
        assert decided.psd == (d >= 0).all()
        assert exact.is_psd(M) == decided.psd
        assert decided.definite == (d > 0).all()
        if decided.psd:
            assert decided.rank == (d > 0).sum()
            assert decided.vector is None
        else:
            assert quadratic(decided.vector, M) < 0
        seen["definite" if decided.definite else "singular" if decided.psd else "indefinite"] += 1
    assert min(seen.values()) > 100


def test_psd_agrees_with_clear_eigenvalues_in_larger_sizes():
    rng = np.random.default_rng(1)
    for n in (12, 20, 30):
        for shift in (0.1, -0.1):
            M = rng.normal(size=(n, n))
            S = M @ M.T
            S += (shift - np.linalg.eigvalsh(S)[0]) * np.eye(n)
            decided = exact.definiteness(S)
            assert decided.psd == (shift > 0)
            assert (decided.vector is None) == decided.psd
            if decided.vector is not None:
                assert quadratic(decided.vector, S) < 0


@pytest.mark.parametrize("n", [3, 14])
def test_psd_sees_a_rank_one_matrix_that_eigenvalues_get_wrong(n):
    v = np.arange(1, n + 1)
    exactly = np.outer(v, v) / 1024.0
    assert exact.definiteness(exactly)[:3] == (True, False, 1)
    off = exactly.copy()
    off[-1, -1] = np.nextafter(off[-1, -1], 0)
    decided = exact.definiteness(off)
    assert not decided.psd
    assert decided.vector is not None
    assert quadratic(decided.vector, off) < 0
    off[-1, -1] = np.nextafter(exactly[-1, -1], np.inf)
    assert exact.definiteness(off)[:3] == (True, False, 2)


def test_a_definite_matrix_within_rounding_of_a_singular_one_is_not_certified_by_floating_point():
    n = 16
    rng = np.random.default_rng(2)
    L = rng.integers(-3, 4, (n, n - 1)).astype(float)
    S = L @ L.T
    assert exact.definiteness(S)[:3] == (True, False, exact.rank(L))
    S[0, 0] -= 2.0**-40
    assert not exact.definiteness(S).psd


def test_a_skew_matrix_and_none_at_all():
    assert exact.definiteness([[0.0, 3.0], [-3.0, 0.0]])[:3] == (True, False, 0)
    assert exact.definiteness(np.zeros((0, 0)))[:3] == (True, True, 0)
    zero_diagonal = exact.definiteness([[0.0, 1.0], [1.0, 5.0]])
    assert zero_diagonal.vector is not None
    assert quadratic(zero_diagonal.vector, [[0.0, 1.0], [1.0, 5.0]]) < 0


def test_products_solutions_null_spaces_and_inverses_are_exact():
    rng = np.random.default_rng(3)
    for _ in range(150):
        n, m, rank = (int(size) for size in rng.integers(1, 7, 3))
        M = rng.normal(size=(n, rank)).round(2) @ rng.integers(-3, 4, (rank, m)).astype(float)
        x = rng.normal(size=(m, 2))
        right = times(M, x)
        assert exact.matrix_product(M, x).tolist() == right
        found = exact.solve_linear_system(M, exact.rational(np.array(right, dtype=object)))
        assert found is not None
        assert times(M, found.tolist()) == right
        kernel = exact.nullspace(M)
        assert kernel.shape[1] == m - exact.rank(M)
        if kernel.shape[1]:
            assert not np.any(times(M, kernel.tolist()))
        columns = exact.independent_columns(M)
        assert len(columns) == exact.rank(M) == exact.rank(M[:, columns])
    square = rng.normal(size=(5, 5))
    inverse = exact.inverse_matrix(square)
    assert inverse is not None
    assert times(square, inverse.tolist()) == np.eye(5).tolist()


def test_rank_is_that_of_the_doubles():
    assert exact.rank([[0.1, 0.3], [0.2, 0.6]]) == (1 if Fraction(0.1) * Fraction(0.6) == Fraction(0.2) * Fraction(0.3) else 2)
    assert exact.rank([[0.25, 0.75], [0.5, 1.5]]) == 1


def test_what_has_no_solution():
    assert exact.solve_linear_system([[1.0, 2.0], [2.0, 4.0]], [[1.0], [2.5]]) is None
    assert exact.inverse_matrix([[1.0, 2.0], [2.0, 4.0]]) is None


def test_large_whole_numbers_do_not_lose_digits():
    A = np.array([[2.0**52 + 1, 1.0]])
    assert exact.matrix_product(A, A.T)[0, 0] == (2**52 + 1) ** 2 + 1


def test_symmetry_is_to_the_last_bit():
    assert exact.is_symmetric([[1.0, 0.3], [0.3, 1.0]])
    assert not exact.is_symmetric([[1.0, 0.3], [0.1 + 0.2, 1.0]])
    assert not exact.is_symmetric(np.zeros((2, 3)))


def test_what_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="not a finite number"):
        exact.rational([[np.inf]])


def test_a_bound_of_the_largest_eigenvalue_is_one():
    rng = np.random.default_rng(9)
    for _ in range(100):
        n = int(rng.integers(1, 5))
        M = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 3)
        bound = exact.eigenvalue_upper_bound(M)
        S = [[Fraction(M[i, j]) / 2 + Fraction(M[j, i]) / 2 for j in range(n)] for i in range(n)]
        assert exact.is_psd(np.array([[Fraction(bound) * (i == j) - S[i][j] for j in range(n)] for i in range(n)], dtype=object))
        assert bound <= np.linalg.eigvalsh((M + M.T) / 2)[-1] + 1e-9 * np.abs(M).max()


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_regular_systems_are_solved_and_singular_ones_are_not(n):
    rng = np.random.default_rng(n)
    for singular in (False, True):
        M = rng.integers(-3, 4, (n, n)) + 0.1 * np.eye(n)
        if singular and n:
            M[:, -1] = 2 * M[:, 0] if n > 1 else 0
        right = rng.normal(size=(n, 2))
        X = exact.solve_regular_system(M, right)
        assert (X is None) == (singular and n > 0)
        if X is not None and n:
            assert times(M, X) == [[Fraction(entry) for entry in row] for row in right]


def test_a_scalar_minus_a_matrix_and_its_signs():
    M = [[0.1, 0.0], [2.0, -3.0]]
    left = exact.scalar_minus(0.5, M).tolist()
    assert left == [[Fraction(0.5) - Fraction(0.1), 0], [-2, Fraction(7, 2)]]
    big = np.diag([10.0**k for k in range(-150, 151, 20)])  # scaled by powers of 2, each rounded once
    n = len(big)
    assert exact.definiteness(big + 1e-160 * np.eye(n, k=1)).definite
    big[3, 3] = -big[3, 3]
    assert not exact.definiteness(big).psd
