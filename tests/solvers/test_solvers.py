"""Solvers of y = W l + b, -y ∈ N_K(l) against brute force and SciPy, on random problems whose solution is known."""

from __future__ import annotations

import itertools
import warnings

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq, linprog, lsq_linear, nnls

from nsmodel.modeling.laws import ball, box, product, second_order_cone
from nsmodel.modeling.laws.ball import BallSet
from nsmodel.solvers import active_set, diagnosis, mlcp
from nsmodel.solvers import mlcp as curved
from nsmodel.solvers import mlcp as qp
from nsmodel.solvers.fallbacks import NonlinearProgramme
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import NumericLaw, numeric_law

INF = np.inf
RELIABLE = ("qpoases", mlcp.LEMKE, mlcp.ENUMERATION)  # The other QP solvers may fail, but not with a residual that passes.
SYMMETRIC = ("spd", "psd", "corank 1", "duplicate rows", "zero row")
PSD = (*SYMMETRIC, "nonsymmetric", "skew")
DEGENERATE = (219, 407, 426)  # Seeds whose path ends in degenerate pivots with the covering variable basic at 0.
LAWS = {
    "complementarity": "c", "relay": "r", "equality": "e", "equality and complementarity": "ec", "upper": "u", "mixed": "ecrup",
}  # fmt: skip


# ---------------------------------------------------------------------------------------------- random problems


def matrix(rng, kind, m):
    """A random matrix (m, m) of the kind; all but "P" and "row-scaled P" have W + W' psd."""
    A, S = rng.normal(size=(m, m)), rng.normal(size=(m, m))
    low = rng.normal(size=(m, max(1, m // 2)))
    if kind == "spd":
        return A @ A.T + 0.1 * np.eye(m)
    if kind == "psd":
        return low @ low.T
    if kind == "corank 1":
        return A[:, : m - 1] @ A[:, : m - 1].T
    if kind == "duplicate rows":
        A[m // 2 :] = A[: m - m // 2]
        return A @ A.T
    if kind == "zero row":
        A[rng.integers(m)] = 0
        return A @ A.T
    if kind == "nonsymmetric":
        return low @ low.T + S - S.T
    if kind == "skew":
        return S - S.T
    return p_matrix(rng, m)


def p_matrix(rng, m):
    """A P-matrix whose symmetric part has a negative eigenvalue: triangular with a large entry off the diagonal, permuted."""
    W = np.triu(rng.normal(size=(m, m)), 1) + np.diag(rng.uniform(0.5, 2, m))
    W[0, -1] = rng.choice([-6, 6])
    order = rng.permutation(m)
    return W[np.ix_(order, order)]


def random_law(rng, m, letters):
    """A product of m rows: c complementarity, e equality, r relay, u one-sided from above, p a point."""
    lo, up = np.zeros(m), np.full(m, INF)
    for i in range(m):
        kind = rng.choice(list(letters))
        if kind == "e":
            lo[i] = -INF
        elif kind == "r":
            lo[i], up[i] = -rng.uniform(0, 2), rng.uniform(0, 2)
        elif kind == "u":
            lo[i], up[i] = -INF, rng.normal()
        elif kind == "p":
            lo[i] = up[i] = rng.normal()
    return NumericLaw(lo, up, ())


def point_of_graph(rng, law, ties=0.1):
    """A random (l, y) with -y ∈ N(l); the part ``ties`` of the rows at a bound has y = 0."""
    l, y = np.zeros(law.size), np.zeros(law.size)
    for i, (lo, up) in enumerate(zip(law.lower, law.upper, strict=True)):
        where, tie = rng.integers(3), rng.random() < ties
        if where == 1 and np.isfinite(lo):
            l[i], y[i] = lo, 0 if tie else rng.exponential()
        elif where == 2 and np.isfinite(up):
            l[i], y[i] = up, 0 if tie else -rng.exponential()
        else:
            a = lo if np.isfinite(lo) else up - 3 if np.isfinite(up) else -2
            l[i] = rng.uniform(a, up if np.isfinite(up) else a + 3)
    return l, y


def problem(seed, kind, letters, low=2, high=8, ties=0.1):
    """(W, b, law, l, y) with a solution (l, y)."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(low, high))
    W, law = matrix(rng, kind, m), random_law(rng, m, letters)
    l, y = point_of_graph(rng, law, ties)
    return W, y - W @ l, law, l, y


# ---------------------------------------------------------------------------------------------- what a solution is


def defect(W, b, law, l):
    """max_i |l_i - mid(lo_i, up_i, l_i - c_i y_i)| over the size of what is subtracted: 0 exactly at a solution."""
    w = np.abs(W).max(axis=1)
    c = np.where(w > 0, 1 / np.where(w > 0, w, 1), 1)
    y, size = W @ l + b, np.abs(b) + np.abs(W) @ np.abs(l)
    distance = np.abs(l - np.clip(l - c * y, law.lower, law.upper))
    return float((distance / np.maximum(c * size + np.abs(l), 1e-300)).max())


def brute_force(W, b, law):
    """All solutions (one for each index set that has one) by trying every index set with least squares."""
    found, m = [], law.size
    for code in itertools.product((-1, 0, 1), repeat=m):
        code = np.array(code)
        l = np.where(code < 0, law.lower, np.where(code > 0, law.upper, 0.0))
        if not np.isfinite(l).all():
            continue
        free = code == 0
        if free.any():
            l[free] = np.linalg.lstsq(W[np.ix_(free, free)], -(b + W @ l)[free], rcond=None)[0]
        if defect(W, b, law, l) < 1e-10:
            found.append(l)
    return found


def no_index(law):
    return np.zeros(law.size, np.int8)


def solve_with(name, W, b, law, symmetric):
    start = np.zeros(law.size)
    return mlcp.solve_mlcp(W, b, law, start, no_index(law), (name,), symmetric, 1e-10)


# ---------------------------------------------------------------------------------------------- Lemke


@pytest.mark.parametrize("letters", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("kind", PSD)
def test_lemke_solves_every_solvable_psd_problem(kind, letters):
    failed = []
    for seed in (*range(60), *DEGENERATE):
        W, b, law, _, _ = problem(seed, kind, letters)
        l = active_set.lemke(W, b, law)
        if l is None or defect(W, b, law, l) > 1e-8:
            failed.append((seed, l))
    assert not failed


@pytest.mark.parametrize("seed", range(40))
def test_lemke_with_free_rows_and_a_singular_matrix(seed):
    """The free rows' own block is singular, and they are split into two: degenerate pivots all along."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 3))
    law = NumericLaw(np.where(rng.random(4) < 0.6, -INF, 0.0), np.full(4, INF), ())
    l, y = point_of_graph(rng, law)
    for W in (A @ A.T, A @ A.T + np.triu(np.ones((4, 4)), 1) - np.tril(np.ones((4, 4)), -1)):
        b = y - W @ l
        found = active_set.lemke(W, b, law)
        assert found is not None
        assert defect(W, b, law, found) < 1e-10


@pytest.mark.parametrize("size", [15, 40])
@pytest.mark.parametrize("kind", ["psd", "nonsymmetric", "skew"])
def test_lemke_solves_larger_problems(kind, size):
    for seed in range(6):
        W, b, law, _, _ = problem(seed, kind, "ecru", size, size + 1)
        l = active_set.lemke(W, b, law)
        assert l is not None
        assert defect(W, b, law, l) < 1e-8


def test_lemke_finds_the_one_solution_of_p_matrices():
    for seed in range(60):
        W, b, law, l, _ = problem(seed, "P", "c", 2, 6)
        assert np.linalg.eigvalsh(W + W.T)[0] < 0
        np.testing.assert_allclose(active_set.lemke(W, b, law), l, atol=1e-8)
        assert all(np.allclose(other, l, atol=1e-8) for other in brute_force(W, b, law))


def test_lemke_solves_linear_programmes():
    """The optimality conditions of min c'x, A x >= d, x >= 0 are a problem with a skew W."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        A, x, u = rng.normal(size=(4, 3)), rng.exponential(size=3), rng.exponential(size=4) * rng.integers(0, 2, 4)
        d, c = A @ x - rng.exponential(size=4) * (u == 0), A.T @ u + rng.exponential(size=3) * rng.integers(0, 2, 3)
        W = np.block([[np.zeros((3, 3)), -A.T], [A, np.zeros((4, 4))]])
        b, law = np.concatenate([c, -d]), NumericLaw(np.zeros(7), np.full(7, INF), ())
        expected = linprog(c, A_ub=-A, b_ub=-d)
        assert expected.status == 0
        found = active_set.lemke(W, b, law)
        assert found is not None
        assert c @ found[:3] == pytest.approx(expected.fun, abs=1e-8)
        assert defect(W, b, law, found) < 1e-9


@pytest.mark.parametrize("size", [1e-15, 1e-9, 1e9, 1e13])
def test_lemke_does_not_care_about_the_size_of_b(size):
    for seed in range(20):
        W, b, law, l, _ = problem(seed, "spd", "ec")
        np.testing.assert_allclose(active_set.lemke(W, b * size, law), l * size, rtol=1e-6, atol=1e-9 * size)


# ---------------------------------------------------------------------------------------------- index sets


@pytest.mark.parametrize("kind", PSD)
@pytest.mark.parametrize("letters", LAWS.values(), ids=LAWS)
def test_polish_on_the_right_index_set_is_the_solution(kind, letters):
    for seed in range(25):
        W, b, law, l, y = problem(seed, kind, letters)
        index = np.where(y > 0, -1, np.where(y < 0, 1, 0)).astype(np.int8)
        found = active_set.solve_on_index_set(W, b, law, index)
        assert found is not None
        fixed = index != 0
        np.testing.assert_array_equal(found[fixed], l[fixed])
        size = np.abs(b) + np.abs(W) @ np.abs(found)
        assert np.all(np.abs(W @ found + b)[~fixed] <= 1e-10 * size[~fixed])
        if kind == "spd":
            np.testing.assert_allclose(found, l, atol=1e-9)


def test_polish_has_no_answer_at_an_infinite_bound():
    law = NumericLaw(np.array([0.0, -INF]), np.array([INF, 1.0]), ())
    W, b = np.eye(2), np.ones(2)
    assert active_set.solve_on_index_set(W, b, law, np.array([1, 0], np.int8)) is None
    assert active_set.solve_on_index_set(W, b, law, np.array([0, -1], np.int8)) is None
    np.testing.assert_array_equal(active_set.solve_on_index_set(W, b, law, np.array([-1, 1], np.int8)), [0, 1])


@pytest.mark.parametrize("kind", PSD)
@pytest.mark.parametrize("letters", LAWS.values(), ids=LAWS)
def test_what_primal_dual_ends_with_is_a_solution_or_does_not_pass(kind, letters):
    """On a singular block it may end with a least-squares solution that is none: the residual must see that."""
    for seed in range(40):
        W, b, law, _, y = problem(seed, kind, letters, ties=0)
        right = np.where(y > 0, -1, np.where(y < 0, 1, 0)).astype(np.int8)
        for start in (no_index(law), right):
            found = active_set.primal_dual_active_set(W, b, law, start)
            if found is None:
                assert start is not right or kind != "spd" or "p" in letters
                continue
            l, index = found
            np.testing.assert_array_equal(l[index < 0], law.lower[index < 0])
            np.testing.assert_array_equal(l[index > 0], law.upper[index > 0])
            if kind == "spd" or mlcp.affine_law_residual(W, b, law, l).max() <= 1e-9:
                assert defect(W, b, law, l) < 1e-8


def test_primal_dual_always_solves_m_matrices_from_any_start():
    """Hintermueller, Ito and Kunisch (2002): for M-matrices it ends with the solution, whatever the start."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(2, 8))
        N = -rng.uniform(0, 1, (m, m))
        W = N + np.diag(np.abs(N).sum(axis=1) + 0.1 - np.diag(N))
        law = NumericLaw(np.zeros(m), np.full(m, INF), ())
        l, y = point_of_graph(rng, law)
        start = -rng.integers(0, 2, m).astype(np.int8)
        found = active_set.primal_dual_active_set(W, y - W @ l, law, start)
        assert found is not None
        np.testing.assert_allclose(found[0], l, atol=1e-12)


@pytest.mark.parametrize("letters", ["c", "r", "ecrup"])
def test_index_sets_are_all_of_them_nearest_first(letters):
    for seed in range(8):
        rng = np.random.default_rng(seed)
        law = random_law(rng, 4, letters)
        last = rng.integers(-1, 2, 4).astype(np.int8)
        sets = [tuple(code) for code in active_set.enumerate_index_sets(law, last)]
        usable = np.column_stack([np.isfinite(law.lower), np.ones(4, bool), np.isfinite(law.upper)])
        expected = {code for code in itertools.product((-1, 0, 1), repeat=4) if all(usable[i, c + 1] for i, c in enumerate(code))}
        assert len(sets) == len(set(sets))
        assert set(sets) == expected
        changes = [sum(a != b for a, b in zip(code, sets[0], strict=True)) for code in sets]
        assert changes == sorted(changes)
        if tuple(last) in expected:
            assert sets[0] == tuple(last)


def test_index_sets_of_a_large_law_are_not_enumerated():
    assert list(active_set.enumerate_index_sets(NumericLaw(np.zeros(40), np.full(40, INF), ()), np.zeros(40, np.int8))) == []


# ---------------------------------------------------------------------------------------------- quadratic programmes


@pytest.mark.parametrize("name", ["qpoases", "qrqp", "daqp", mlcp.LEMKE])
@pytest.mark.parametrize("kind", SYMMETRIC)
def test_solvers_agree_with_bounded_least_squares(name, kind):
    """W = A A', b = -A c: min |A'l - c|^2 over the box; A'l is unique where l is not."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(2, 7))
        A = root(matrix(rng, kind, m))
        c, law = rng.normal(size=A.shape[1]), random_law(rng, m, "cer" if kind == "spd" else "r")
        expected = lsq_linear(A.T, c, (law.lower, np.maximum(law.upper, law.lower + 1e-9)), method="bvls", tol=1e-14)
        found = solve_with(name, A @ A.T, -A @ c, law, True)
        if name in RELIABLE or found.residual <= 1e-9:
            assert found.residual <= 1e-9
            np.testing.assert_allclose(A.T @ found.l, A.T @ expected.x, atol=1e-6)
            assert np.sum((A.T @ found.l - c) ** 2) <= 2 * expected.cost + 1e-8


def root(W):
    values, vectors = np.linalg.eigh(W)
    keep = values > 1e-10
    return vectors[:, keep] * np.sqrt(values[keep])


@pytest.mark.parametrize("name", RELIABLE)
def test_solvers_agree_with_nonnegative_least_squares(name):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        A, c = rng.normal(size=(5, 3)), rng.normal(size=3)
        law = NumericLaw(np.zeros(5), np.full(5, INF), ())
        expected, distance = nnls(A.T, c)
        found = solve_with(name, A @ A.T, -A @ c, law, True)
        assert found.residual < 1e-10
        np.testing.assert_allclose(A.T @ found.l, A.T @ expected, atol=1e-10)
        assert np.linalg.norm(A.T @ found.l - c) == pytest.approx(distance, abs=1e-10)


@pytest.mark.parametrize("name", ["qpoases", "qrqp", "daqp"])
@pytest.mark.parametrize("kind", ["nonsymmetric", "skew"])
@pytest.mark.parametrize("letters", ["c", "r", "u", "ecru"])
def test_the_gap_programme_solves_nonsymmetric_problems(name, kind, letters):
    """(W + W') l is the same for all solutions."""
    for seed in range(10):
        W, b, law, l, _ = problem(seed, kind, letters, 2, 6, ties=0)
        found = solve_with(name, W, b, law, False)
        if name in RELIABLE or found.residual <= 1e-9:
            assert found.residual <= 1e-9
            assert defect(W, b, law, found.l) < 1e-8
            np.testing.assert_allclose((W + W.T) @ (found.l - l), 0, atol=1e-6)


def test_symmetric_and_gap_programmes_agree():
    for seed in range(15):
        W, b, law, l, _ = problem(seed, "spd", "ecru", 2, 6)
        one, two = (qp.solve_qp("qpoases", W, b, law, symmetric) for symmetric in (True, False))
        np.testing.assert_allclose(one, l, atol=1e-7)
        np.testing.assert_allclose(two, l, atol=1e-7)


# ---------------------------------------------------------------------------------------------- the chain


@pytest.mark.parametrize("kind", [*PSD, "P"])
def test_the_chain_agrees_with_brute_force(kind):
    for seed in range(12):
        W, b, law, _, _ = problem(seed, kind, "ecru" if kind != "P" else "c", 2, 5)
        symmetric = kind in SYMMETRIC
        chain = (mlcp.INDEX_SET, *(("qpoases",) if kind != "P" else ()), mlcp.LEMKE, mlcp.ENUMERATION)
        found = mlcp.solve_mlcp(W, b, law, np.zeros(law.size), no_index(law), chain, symmetric, 1e-10)
        assert found.residual <= 1e-10
        assert defect(W, b, law, found.l) < 1e-9
        every = brute_force(W, b, law)
        assert every
        if kind in ("spd", "P"):
            assert all(np.allclose(found.l, l, atol=1e-8) for l in every)
        elif symmetric:
            assert all(np.allclose(W @ found.l, W @ l, atol=1e-7) for l in every)


@pytest.mark.parametrize("kind", PSD)
@pytest.mark.parametrize("solver", ["qpoases", "lemke", "index set"])
def test_congruent_scaling_from_1e_minus_9_to_1e9_changes_nothing(kind, solver):
    """l_i in units of 1/d_i and y_i in units of d_i, W_ii from 1e-9 to 1e9: the answer is the scaled one."""
    for seed in range(12):
        W, b, law, l, y = problem(seed, kind, "ecru", 2, 6, ties=0)
        d = 10.0 ** np.random.default_rng(seed).uniform(-4.5, 4.5, law.size)
        scaled = NumericLaw(law.lower / d, law.upper / d, ())
        W_d, b_d = d[:, None] * W * d, d * b
        start = np.where(y > 0, -1, np.where(y < 0, 1, 0)).astype(np.int8) if solver == "index set" else no_index(law)
        found = mlcp.solve_mlcp(W_d, b_d, scaled, l / d, start, (solver,), kind in SYMMETRIC, 1e-9)
        if solver == "lemke" or kind == "spd":
            assert found.residual <= 1e-9
        if found.residual <= 1e-9:
            assert defect(W, b, law, found.l * d) < 1e-6
        if kind == "spd":
            np.testing.assert_allclose(found.l * d, l, atol=1e-6)


def test_badly_scaled_rows_alone():
    """diag(r) W with r from 1e-9 to 1e9 is not symmetric any more, and still a P-matrix with the same solution."""
    for seed in range(40):
        W, b, law, l, _ = problem(seed, "spd", "c", 2, 6)
        r = 10.0 ** np.random.default_rng(seed).uniform(-9, 9, law.size)
        chain = (mlcp.INDEX_SET, mlcp.LEMKE, mlcp.ENUMERATION)
        found = mlcp.solve_mlcp(r[:, None] * W, r * b, law, np.zeros(law.size), no_index(law), chain, False, 1e-10)
        assert found.residual <= 1e-10
        np.testing.assert_allclose(found.l, l, atol=1e-6)


def test_a_problem_that_no_solver_solves_has_residual_inf_or_above_the_tolerance():
    law = NumericLaw(np.zeros(2), np.full(2, INF), ())
    W, b = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([-1.0, -1.0])
    chain = (mlcp.INDEX_SET, "qpoases", mlcp.LEMKE, mlcp.ENUMERATION)
    found = mlcp.solve_mlcp(W, b, law, np.zeros(2), no_index(law), chain, True, 1e-10)
    assert not found.residual <= 1e-9


# ---------------------------------------------------------------------------------------------- no solution


def infeasible(seed, symmetric):
    """(W, b, u): W psd, u >= 0, W'u <= 0, b'u < 0, so that W l + b >= 0 has no l >= 0."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(2, 7))
    u = rng.exponential(size=m) * (rng.random(m) < 0.6)
    u[0] += 1
    A = rng.normal(size=(m, max(1, m // 2)))
    A -= np.outer(u, u @ A) / (u @ u)
    A[np.abs(A) < 1e-14] = 0
    W = A @ A.T
    if not symmetric:
        # S skew with S'u = -v <= 0, v'u = 0.
        v = rng.exponential(size=m) * (u == 0)
        W = W + (np.outer(v, u) - np.outer(u, v)) / (u @ u)
    b = rng.normal(size=m)
    b -= u * (b @ u + rng.uniform(0.1, 2)) / (u @ u)
    return W, b, u


@pytest.mark.parametrize("symmetric", [True, False])
def test_lemke_and_farkas_on_infeasible_problems(symmetric):
    for seed in range(40):
        W, b, u = infeasible(seed, symmetric)
        law = NumericLaw(np.zeros(b.size), np.full(b.size, INF), ())
        assert np.all(W.T @ u <= 1e-12)
        assert b @ u < 0
        assert linprog(np.zeros(b.size), A_ub=-W, b_ub=b).status == 2
        assert active_set.lemke(W, b, law) is None
        assert_farkas_proof(diagnosis.opposing_rows(W, b, law), W, b)


def assert_farkas_proof(proof, W, b):
    """u >= 0 with W'u <= 0 and b'u < 0: then l >= 0, W l + b >= 0 would give 0 <= u'(W l + b) <= b'u < 0."""
    assert proof is not None
    u = np.zeros(b.size)
    for row, weight in proof:
        u[row] = weight
    assert np.all(u >= 0)
    assert u.sum() == pytest.approx(1, abs=1e-4)
    assert (W.T @ u).max() <= 1e-6 * np.abs(W).max()
    assert b @ u < -1e-6 * np.abs(b).max()


@pytest.mark.parametrize("kind", PSD)
def test_no_farkas_proof_of_a_solvable_problem(kind):
    """A diagnosis that blames constraints must be true: these problems have a solution."""
    for seed in range(40):
        W, b, law, _, _ = problem(seed, kind, "c")
        assert diagnosis.opposing_rows(W, b, law) is None


@pytest.mark.parametrize("units", [np.ones(5), 10.0 ** np.array([-6, 4, 0, 8, -2])])
def test_rows_that_depend_on_one_another_are_named_in_any_units(units):
    rows = np.random.default_rng(3).normal(size=(5, 5))
    rows[4] = rows[0] - rows[2]
    part, named = diagnosis.dependent_rows((units * (rows @ rows.T)).T * units)
    assert part < 1e-14
    assert sorted(i for i, _ in named) == [0, 2, 4]
    part, _ = diagnosis.dependent_rows((units * (rows @ rows.T + np.eye(5))).T * units)
    assert part > 1e-3


@pytest.mark.parametrize(
    "W", [np.zeros((3, 3)), np.diag([1.0, 0.0, 0.0]), np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.0]])]
)
def test_rows_that_feel_nothing_depend_on_nothing(W):
    assert diagnosis.dependent_rows(W)[0] > 0.1


def test_no_farkas_proof_where_the_rows_are_nearly_opposite():
    """A wedge: its corner is far away, but it is there, at l = (1, 1)/(2 angle^2)."""
    law = NumericLaw(np.zeros(2), np.full(2, INF), ())
    for angle in (1e-2, 1e-3, 1e-5):
        n = np.array([[1.0, angle], [-1.0, angle]])
        W, b = n @ n.T, np.array([-1.0, -1.0])
        l = np.full(2, 1 / (2 * angle**2))
        assert np.all(np.abs(W @ l + b) < 1e-4)
        assert diagnosis.opposing_rows(W, b, law) is None


def test_proofs_do_not_depend_on_units():
    for scale in (1e-9, 1e9):
        for seed in range(10):
            W, b, _ = infeasible(seed, True)
            law = NumericLaw(np.zeros(b.size), np.full(b.size, INF), ())
            assert_farkas_proof(diagnosis.opposing_rows(W * scale, b, law), W, b)
            assert_farkas_proof(diagnosis.opposing_rows(W, b * scale, law), W, b)


# ---------------------------------------------------------------------------------------------- balls and cones


def spd(rng, m, smallest=0.1):
    A = rng.normal(size=(m, m))
    return A @ A.T + smallest * np.eye(m)


@pytest.mark.parametrize("m", [2, 3, 5])
def test_semismooth_newton_on_a_ball_solves_the_secular_equation(m):
    """min l'Wl/2 + b'l over |l| <= r: l = -W^{-1} b, or (W + mu I) l = -b with mu > 0, |l| = r."""
    law = NumericLaw(np.full(m, -INF), np.full(m, INF), ((slice(0, m), BallSet(1.3)),))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        W, b = spd(rng, m), rng.normal(size=m) * 10.0 ** rng.uniform(-2, 2)

        def on(mu, W=W, b=b):
            return -np.linalg.solve(W + mu * np.eye(m), b)

        expected = on(0)
        if np.linalg.norm(expected) > 1.3:
            expected = on(brentq(lambda mu, on=on: np.linalg.norm(on(mu)) - 1.3, 0, 1e6, xtol=1e-14, rtol=1e-14))
        found = curved.semismooth_newton(W, b, law, np.zeros(m))
        if found is None:
            found = curved.semismooth_newton(W, b, law, curved.projected_gauss_seidel(W, b, law, np.zeros(m)))
        np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize("m", [2, 3, 6])
def test_cone_solutions_are_complementary(m):
    law = numeric_law(second_order_cone(m))
    parts = set()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        W, b = spd(rng, m), rng.normal(size=m) * 10.0 ** rng.uniform(-2, 2) + np.eye(m)[0] * rng.normal() * 2
        found = mlcp.solve_mlcp(W, b, law, np.zeros(m), no_index(law), (mlcp.SEMISMOOTH,), True, 1e-10)
        assert found.residual <= 1e-10
        l, y = found.l, W @ found.l + b
        size = np.abs(b).max() + np.abs(W).max() * np.abs(l).max()
        assert np.linalg.norm(l[1:]) <= l[0] + 1e-10 * (1 + np.abs(l).max())
        assert np.linalg.norm(y[1:]) <= y[0] + 1e-9 * size
        assert abs(l @ y) <= 1e-9 * size * max(np.abs(l).max(), 1e-9)
        parts.add(int(found.index[0]))
    assert parts == {-1, 0, 1}


def test_cone_with_the_identity_is_the_projection():
    """W = I: l = P_K(-b), by Moreau's decomposition -b = l - y with l ∈ K, y ∈ K, l'y = 0."""
    law = numeric_law(second_order_cone(3))
    for b in ([-2, 1, 0], [2, 1, 1], [1, -3, 0], [-1, 3, 4], [0, 5, -12], [1, 0.6, 0.8], [-1, 0.6, 0.8]):
        b = np.array(b, float)
        size = np.linalg.norm(b[1:])
        if size <= -b[0]:
            expected = -b
        elif size <= b[0]:
            expected = np.zeros(3)
        else:
            expected = (size - b[0]) / 2 * np.concatenate([[1], -b[1:] / size])
        found = mlcp.solve_mlcp(np.eye(3), b, law, np.zeros(3), no_index(law), (mlcp.SEMISMOOTH,), True, 1e-12)
        np.testing.assert_allclose(found.l, expected, atol=1e-13)


@pytest.mark.parametrize("kind", ["spd", "corank 1", "duplicate rows", "nonsymmetric"])
def test_products_of_boxes_balls_and_cones(kind):
    """The solution is known: a point of the graph is chosen first."""
    law = numeric_law(product(box([-1, 0], [1, INF]), ball(2, 0.7), second_order_cone(3)))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        W = matrix(rng, kind, 7) + (0.05 * np.eye(7) if kind == "nonsymmetric" else 0)
        l, y = np.zeros(7), np.zeros(7)
        l[:2], y[:2] = point_of_graph(rng, NumericLaw(law.lower[:2], law.upper[:2], ()))
        side = rng.normal(size=2)
        side /= np.linalg.norm(side)
        if rng.random() < 0.6:
            l[2:4], y[2:4] = 0.7 * side, -rng.exponential() * side
        else:
            l[2:4] = 0.5 * side
        size, case = rng.exponential(), rng.integers(3)
        if case == 0:
            l[4:], y[4:] = size * np.array([1, *side]), rng.exponential() * np.array([1, *-side])
        else:
            inside = size * np.array([1.5, *side])
            l[4:], y[4:] = (inside, 0) if case == 1 else (0, inside)
        b = y - W @ l
        found = mlcp.solve_mlcp(W, b, law, np.zeros(7), no_index(law), (mlcp.SEMISMOOTH,), kind != "nonsymmetric", 1e-9)
        assert found.residual <= 1e-9
        np.testing.assert_allclose((W + W.T) @ found.l, (W + W.T) @ l, atol=1e-6)


def test_a_ball_of_radius_zero_holds_its_multiplier_at_zero():
    law = numeric_law(ball(2, 0))
    found = mlcp.solve_mlcp(np.eye(2), np.array([1.0, -2.0]), law, np.zeros(2), no_index(law), (mlcp.SEMISMOOTH,), True, 1e-10)
    np.testing.assert_array_equal(found.l, [0, 0])
    assert found.residual == 0


# ---------------------------------------------------------------------------------------------- the nonlinear programme


def affine_problem(W, b, law):
    """y = W l + b written as a one-step problem without z."""
    m, empty = law.size, ca.SX(0, 1)
    l = ca.SX.sym("l", m)
    return OneStepProblem(
        scheme="affine", t=ca.SX.sym("t"), h=ca.SX.sym("h"), state=empty, p=empty, z=empty, l=l, y=ca.SX.sym("y", m),
        E=empty, Y=ca.SX(ca.DM(W)) @ l + ca.DM(b), law=law, rows=tuple("abcdefgh"[:m]), guess=empty, next_state=empty,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["spd", "corank 1", "nonsymmetric", "skew", "P"])
def test_ipopt_finds_the_index_set(kind):
    """IPOPT's own accuracy is about 1e-8; on its index set the solution is exact."""
    for seed in range(5):
        W, b, numeric, exact, _ = problem(seed, kind, "ecru" if kind != "P" else "c", 2, 5, ties=0)
        law = box(numeric.lower, numeric.upper)
        programme = NonlinearProgramme(affine_problem(W, b, law), numeric)
        start = np.clip(np.zeros(numeric.size), numeric.lower, numeric.upper)
        found = programme.solve(0.0, 1.0, np.zeros(0), np.zeros(0), start)
        assert found is not None
        _, l, y = found
        np.testing.assert_allclose(y, W @ l + b, atol=1e-12 * (1 + np.abs(b).max()))
        assert defect(W, b, numeric, l) < 1e-3
        if kind in ("spd", "P"):
            polished = active_set.solve_on_index_set(
                W, b, numeric, active_set.estimate_index_set(l, y, numeric, active_set.row_scale(W))
            )
            np.testing.assert_allclose(polished, exact, atol=1e-9)


def test_ipopt_on_balls_and_cones_where_it_reports_success():
    """The boundary of a ball or cone at 0 has no constraint qualification: IPOPT may fail there, and then says so."""
    law = product(ball(2, 0.7), second_order_cone(3), box(-1, 1))
    numeric, solved = numeric_law(law), 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        W, b = spd(rng, 6, 0.5), rng.normal(size=6) * 2
        expected = mlcp.solve_mlcp(W, b, numeric, np.zeros(6), no_index(numeric), (mlcp.SEMISMOOTH,), True, 1e-11)
        assert expected.residual <= 1e-11
        programme = NonlinearProgramme(affine_problem(W, b, law), numeric)
        found = programme.solve(0.0, 1.0, np.zeros(0), np.zeros(0), np.full(6, 0.01))
        if programme._solver.stats()["return_status"] == "Solve_Succeeded":
            solved += 1
            np.testing.assert_allclose(found[1], expected.l, atol=1e-6)
    assert solved


# ---------------------------------------------------------------------------------------------- purity


@pytest.mark.parametrize("name", qp.QP_SOLVERS)
def test_conic_solvers_are_pure_functions(name, capfd):
    """The same question twice, with another one between: the same bits, and nothing printed."""
    first, other = problem(1, "spd", "cr", 4, 5), problem(2, "spd", "cr", 4, 5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = qp.solve_qp(name, *first[:3], True)
        qp.solve_qp(name, *other[:3], True)
        two = qp.solve_qp(name, *first[:3], True)
    assert (one is None) == (two is None)
    assert one is None or one.tobytes() == two.tobytes()
    assert capfd.readouterr() == ("", "")


def test_solvers_leave_their_arguments_alone():
    W, b, law, l, _ = problem(3, "spd", "ecru", 5, 6)
    index = no_index(law)
    before = [a.tobytes() for a in (W, b, law.lower, law.upper, l, index)]
    for name in (mlcp.INDEX_SET, "qpoases", mlcp.LEMKE, mlcp.ENUMERATION, mlcp.SEMISMOOTH):
        mlcp.solve_mlcp(W, b, law, l, index, (name,), True, 0.0)
    assert [a.tobytes() for a in (W, b, law.lower, law.upper, l, index)] == before
