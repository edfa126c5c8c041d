"""The nearest point of a polyhedron: against brute force over all sets of rows, and where there is none."""

from itertools import combinations

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, MonotoneInclusion, SweepingProcess, relay, simulate
from nsmodel.solvers.fallbacks import connected_parts, nearest_point_of_polyhedron, part_problem
from nsmodel.solvers.newton import NewtonSolver
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.structure import read_step_structure
from nsmodel.solvers.time_stepper import Stepper


def by_brute_force(p, N, c):
    """The feasible one of the points that sets of rows hold, with multipliers >= 0; None where no set has one."""
    for k in range(min(N.shape) + 1):
        for rows in combinations(range(len(N)), k):
            A = N[list(rows)]
            u = np.linalg.lstsq(A @ A.T, c[list(rows)] - A @ p, rcond=None)[0] if k else np.zeros(0)
            z = p + A.T @ u
            if (u >= -1e-9).all() and (N @ z >= c - 1e-9).all():
                return z
    return None


@pytest.mark.parametrize("seed", range(40))
def test_the_nearest_point_is_that_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 5), rng.integers(1, 8)
    N, p = rng.normal(size=(m, n)), 3 * rng.normal(size=n)
    c = rng.normal(size=m) if seed % 2 else -np.abs(rng.normal(size=m)) * rng.integers(0, 2, m)
    true, found = by_brute_force(p, N, c), nearest_point_of_polyhedron(p, N, c)
    assert (true is None) == (found is None)
    if found is not None:
        np.testing.assert_allclose(found[0], true, atol=1e-8)
        assert np.linalg.matrix_rank(N[found[1]]) == len(found[1])


@pytest.mark.parametrize("angle", [1e-2, 1e-5, 1e-7])
def test_a_corner_is_found_at_any_angle(angle):
    """Two lines that meet at (1/tan(angle), 1): a hair's breadth for W = N N', whose condition is the square of that."""
    N = np.array([[0.0, 1.0], [np.sin(angle), -np.cos(angle)]])
    c = np.array([1.0, 0.0])
    z, held = nearest_point_of_polyhedron(np.zeros(2), N, c)
    assert sorted(held) == [0, 1]
    np.testing.assert_allclose(z, [1 / np.tan(angle), 1.0], rtol=1e-15 / angle)


def test_rows_in_any_unit_are_the_same_rows():
    rng = np.random.default_rng(5)
    N, c, p = rng.normal(size=(9, 4)), -np.ones(9), 10 * rng.normal(size=4)
    units = 10.0 ** rng.uniform(-8, 8, 9)
    np.testing.assert_allclose(
        nearest_point_of_polyhedron(p, units[:, None] * N, units * c)[0], nearest_point_of_polyhedron(p, N, c)[0], rtol=1e-12
    )


def test_rows_that_leave_no_point_have_none():
    assert nearest_point_of_polyhedron(np.zeros(2), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([1.0, 0.0])) is None
    assert nearest_point_of_polyhedron(np.zeros(1), np.array([[0.0]]), np.array([1.0])) is None


# ---------------------------------------------------------------------------------------------- which steps are nearest points


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_a_projection_is_seen_in_any_unit(unit):
    """exp(q / 1e-6) overflows at q = 1: no sample of points tells what the expressions do."""
    q = ca.SX.sym("q", 2)
    model = SweepingProcess(q=q, f=[unit, 0], constraints={"hill": 3 - ca.exp(q[0] / unit)}, q0=[0, 0], t_end=1, step=0.1)
    structure = read_step_structure(one_step_problem(model))
    assert structure.projection
    assert structure.nearest
    assert simulate(model).x[-1, 0] == pytest.approx(unit, rel=1e-12)


def test_a_curved_set_s_nearest_point_is_one():
    """Also a disc's, of which the multiplier is told by the whole step; not that of a first-order system."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 1)
    disc = MonotoneInclusion(x=x, field=[1, 0.5], constraints={"disc": 1 - ca.sumsqr(x)}, x0=[0, 0], t_end=2, step=0.1)
    assert read_step_structure(one_step_problem(disc)).nearest
    assert not read_step_structure(one_step_problem(disc)).projection
    other = FirstOrderSystem(x=x, lam=l, f=-x, g=ca.vertcat(l, 0), h=x[0], law=relay(1), x0=[1, 0], t_end=1, step=0.1)
    assert not read_step_structure(one_step_problem(other)).nearest


# ---------------------------------------------------------------------------------------------- parts that do not touch


def gene(k):
    """A pair of states that switch each other, bilinear in their relays."""
    x, l = ca.SX.sym(f"x{k}", 2), ca.SX.sym(f"l{k}", 2)
    g = ca.vertcat(-0.5 * l[0] * l[1] * x[1], (2 * l[0] + l[1]) / (1 - 0.5 * l[0] * l[1]))
    return x, l, ca.vertcat(x[1], 0), g


def copies(count, starts):
    models = [gene(k) for k in range(count)]
    x, l, f, g = (ca.vertcat(*(m[i] for m in models)) for i in range(4))
    return FirstOrderSystem(x=x, lam=l, f=f, g=g, h=x, law=relay(2 * count), x0=np.ravel(starts), t_end=1, step=0.1)


def test_what_does_not_touch_is_told_apart():
    problem = one_step_problem(copies(3, np.ones((3, 2))))
    parts = connected_parts(problem)
    assert sorted(tuple(l) for _, l in parts) == [(0, 1), (2, 3), (4, 5)]
    one = part_problem(problem, *parts[0])
    assert one.E.numel() == one.z.numel() == problem.z.numel() // 3
    assert [*one.rows] == [problem.rows[i] for i in parts[0][1]]
    assert not ca.depends_on(ca.vertcat(one.E, one.Y), problem.l[[int(i) for i in parts[1][1]]])


def test_a_ball_s_rows_are_one_part():
    from nsmodel import ball, product

    x, l = ca.SX.sym("x", 3), ca.SX.sym("l", 3)
    model = FirstOrderSystem(x=x, lam=l, f=-x, g=l, h=x, law=product(ball(2), relay(1)), x0=[1, 1, 1], t_end=1, step=0.1)
    assert sorted(tuple(rows) for _, rows in connected_parts(one_step_problem(model))) == [(0, 1), (2,)]


@pytest.fixture
def weak(monkeypatch):
    """Newton's method on more than one pair of rows is kept from its end."""
    honest = NewtonSolver.solve

    def solve(newton, *arguments):
        found = honest(newton, *arguments)
        if newton.law.size > 2:
            found.residual = 1.0
        return found

    def weaken():
        monkeypatch.setattr(NewtonSolver, "solve", solve)
        monkeypatch.setattr(Stepper, "_last_index_set_step", None)

    return weaken


def test_copies_move_as_one_alone(weak):
    """Where Newton's method on the whole is kept from its end, the parts are solved alone."""
    starts = np.array([[1.0, 10.0], [0.3, -2.0], [-1.0, 0.2]])
    alone = [simulate(copies(1, start)).x for start in starts]
    weak()
    run = simulate(copies(3, starts))
    np.testing.assert_allclose(run.x, np.hstack(alone), rtol=1e-9, atol=1e-12)
    assert set(run.metadata["solver_counts"]) == {"by parts"}


def test_a_step_by_parts_does_not_depend_on_the_steps_before_it(weak):
    """A resumed run meets its first hard step elsewhere: the parts are prepared where the whole was.

    W = h x is psd where x > 0, so that the plan of a part tells where it was prepared.
    """
    weak()
    x, l = ca.SX.sym("x", 3), ca.SX.sym("l", 3)
    problem = one_step_problem(FirstOrderSystem(x=x, lam=l, f=-x, g=x * l, h=x, law=relay(3), x0=[1, 1, 1], t_end=1, step=0.1))
    first, then = np.array([1.0, 2.0, 0.5]), np.array([-1.0, -0.5, -2.0])
    one, other, elsewhere = (Stepper(problem, "auto", 1e-9, h=0.1, state=state) for state in (first, first, then))
    one(0.0, 0.1, first, one.cold_start())
    results = [stepper(0.1, 0.1, then, one.cold_start()) for stepper in (one, other)]
    np.testing.assert_array_equal(results[0].row, results[1].row)
    assert results[0].solver == results[1].solver == "by parts"
    plans = [[part.plan for *_, part in stepper._independent_parts] for stepper in (one, other, elsewhere)]
    assert plans[0] == plans[1] != plans[2]
