"""What counts as rounding: running error bounds, what unknowns err by, scenes far from 0, and rows whose true value is 0."""

from __future__ import annotations

import casadi as ca
import mpmath
import numpy as np
import pytest
import scipy.sparse as sp
from fuzz_models import COUNT, FULL, share, some

from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    complementarity,
    relay,
    simulate,
)
from nsmodel.codegen.library import compiler
from nsmodel.modeling.expressions import derivatives
from nsmodel.proof.expression_graph import fold_graph
from nsmodel.solvers import mlcp
from nsmodel.solvers.newton import NewtonSolver
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.residuals import ROUNDING, NumericLaw
from nsmodel.solvers.rounding_errors import (
    PROBES,
    UNIT_ROUND_OFF,
    dense_solution_errors,
    probe_signs,
    rounding_error_bound,
    row_maxima,
)
from nsmodel.solvers.time_stepper import Stepper

WAYS = [False, pytest.param(True, marks=pytest.mark.skipif(compiler() is None, reason="no C compiler"))]


# ---------------------------------------------------------------------------------------------- running error bounds


def exactly(expression, symbols, values):
    """The value of a scalar expression at doubles, in 60 digits."""
    named = {s.element_hash(): mpmath.mpf(float(v)) for s, v in zip(ca.vertsplit(symbols), values, strict=True)}
    operations = {
        ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b,
        ca.OP_DIV: lambda a, b: a / b, ca.OP_SQ: lambda a: a * a, ca.OP_TWICE: lambda a: 2 * a, ca.OP_NEG: lambda a: -a,
        ca.OP_INV: lambda a: 1 / a, ca.OP_SQRT: mpmath.sqrt, ca.OP_SIN: mpmath.sin, ca.OP_COS: mpmath.cos,
        ca.OP_EXP: mpmath.exp, ca.OP_FABS: abs,
    }  # fmt: skip
    with mpmath.workdps(60):
        return fold_graph(expression, lambda s: named[s.element_hash()], mpmath.mpf, lambda op, args: operations[op](*args))[0]


def random_row(rng, x, k):
    """A sum of terms of all sizes in the unknowns x and the given k, some of which cancel."""
    leaves = [*ca.vertsplit(x), *ca.vertsplit(k)]
    terms = []
    for _ in range(rng.integers(2, 6)):
        a, b = (leaves[i] for i in rng.integers(len(leaves), size=2))
        form = rng.integers(6)
        term = [a * b, a - b, ca.sqrt(a * a + b * b), a / (2 + ca.sin(b)), ca.exp(-a * a) * b, a**2 - b**2][form]
        terms.append(float(10.0 ** rng.integers(-6, 7)) * term)
    return sum(terms[1:], terms[0])


def test_the_bound_is_one():
    """fl(row) at the given doubles is within u E of its value in 60 digits; and E is no more than what the terms can lose."""
    rng, x, k = np.random.default_rng(0), ca.SX.sym("x", 3), ca.SX.sym("k", 3)
    both = ca.vertcat(x, k)
    for _ in range(share(300, 60)):
        row, values = random_row(rng, x, k), rng.normal(size=6) * 10.0 ** rng.uniform(-3, 3, 6)
        values[3:] = np.where(rng.random(3) < 0.5, values[:3] * (1 + 1e-13 * rng.normal(size=3)), values[3:])
        found, bound = (float(v) for v in ca.Function("f", [both], [row, rounding_error_bound(row, x)])(values))
        with mpmath.workdps(60):
            error = float(abs(mpmath.mpf(found) - exactly(row, both, values)))
        assert error <= 1.01 * UNIT_ROUND_OFF * bound + 1e-300
        assert bound >= abs(found)


def test_what_is_given_errs_by_nothing_and_an_unknown_by_itself():
    x, k = ca.SX.sym("x"), ca.SX.sym("k")
    bound = ca.Function("bound", [x, k], [rounding_error_bound(ca.vertcat(x - k, k * 1.0, ca.fabs(-x)), x)])
    np.testing.assert_array_equal(np.array(bound(1e9 + 0.5, 1e9)).ravel(), [1e9 + 0.5 + 0.5, 0, 1e9 + 0.5])


def test_a_function_that_cannot_be_looked_into_has_its_terms():
    x = ca.SX.sym("x")
    inner = ca.Function("inner", [x], [x * x], {"never_inline": True})
    assert float(ca.Function("bound", [x], [rounding_error_bound(inner(x) - 4, x)])(2.0)) == pytest.approx(8 + 8)


def test_what_unknowns_err_by_is_told_from_below():
    rng, near = np.random.default_rng(1), []
    for n in (1, 2, 5, 20):
        for _ in range(20):
            J = rng.normal(size=(n, n)) + 3 * np.eye(n)
            rows, columns = 10.0 ** rng.uniform(-8, 8, (2, n))
            J, error = rows[:, None] * J * columns, rows * 10.0 ** rng.uniform(-3, 3, n)
            right = np.abs(np.linalg.inv(J / rows[:, None])) @ (error / rows)
            found = row_maxima(dense_solution_errors(J, error))
            assert (found <= right * (1 + 1e-8)).all()
            near += list(found >= right / (3 * np.sqrt(n)))
    assert np.mean(near) > 0.97


def test_a_matrix_that_is_ill_conditioned_excuses_nothing():
    """What is singular but for 1e-9 says nothing of the direction that it does not see; 1e-7 is seen."""
    nearly, well = (np.array([[1.0, 1.0], [1.0, 1.0 + gap]]) for gap in (1e-9, 1e-7))
    assert np.abs(dense_solution_errors(nearly, np.ones(2))).max() < 10
    assert np.abs(dense_solution_errors(well, np.ones(2))).max() > 1e6


def test_signs_look_random():
    S = probe_signs(400)
    assert S.shape == (PROBES, 400)
    assert set(np.unique(S)) == {-1.0, 1.0}
    assert np.abs(S @ S.T - 400 * np.eye(PROBES)).max() < 80


# ---------------------------------------------------------------------------------------------- far from 0


def past_a_disc(s):
    q = ca.SX.sym("q", 2)
    d = q - s
    return SweepingProcess(q=q, f=[1, 0], constraints={"disc": ca.norm_2(d) - 1}, q0=[s - 2, s + 0.1], t_end=3, step=0.02)


def relays(s):
    x = ca.SX.sym("x", 2)
    return LureSystem(
        x=x, A=[x[1], -4 * (x[0] - s) - 0.2 * x[1]], B=[[0], [1]], C=[[0, 1]], law=relay(1), x0=[s + 2, 0], t_end=6, step=0.01
    )


def affine_relays(s):
    A = np.array([[0, 1], [-4, -0.2]])
    return LureSystem(A=A, B=[[0], [1]], C=[[0, 1]], f=[0, 4 * s], law=relay(1), x0=[s + 2, 0], t_end=6, step=0.01)


def stop(s):
    """A mass on a spring meets a stop."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    return FirstOrderSystem(
        x=x,
        lam=l,
        f=[x[1], -(x[0] - s)],
        h=x[1] + 0.5,
        g=ca.vertcat(0, l),
        law=complementarity(1),
        x0=[s + 1, 0],
        t_end=6,
        step=0.01,
    )


def oscillator(s):
    x, v = ca.SX.sym("x"), ca.SX.sym("v")
    return FrictionOscillator(x=x, potential=2 * (x - s) ** 2, friction=0.3 * v, s=v, x0=s + 1.5, v0=0, t_end=6, step=0.01)


def in_a_box(s):
    x = ca.SX.sym("x", 2)
    return MonotoneInclusion(x=x, field=[1, -(x[1] - s)], upper=[s + 1, s + 5], x0=[s, s + 1], t_end=3, step=0.01)


SCENES = {f.__name__: f for f in (past_a_disc, relays, affine_relays, stop, oscillator, in_a_box)}
MOVED = {"relays": [0], "affine_relays": [0], "stop": [0]}


def positions(name):
    return MOVED.get(name, slice(None))


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("shift", some([1e3, 1e6, 1e9]))
@pytest.mark.parametrize("name", SCENES)
def test_scenes_far_from_0_are_as_right_as_before(name, shift, compiled):
    """Each position is known to u shift, each force to that times the stiffness; a switch moves by a step where that decides."""
    at_0, there = (simulate(SCENES[name](s), compiled=compiled) for s in (0.0, shift))
    x = there.x.copy()
    x[:, positions(name)] -= shift
    assert there.status == "done"
    error = np.abs(x - at_0.x).max()
    assert error <= 1e-9 + 200 * UNIT_ROUND_OFF * shift * len(at_0.t)


@pytest.mark.parametrize("shift", some([0.0, 1e3, 1e6, 1e9], 3))
@pytest.mark.parametrize("name", [n for n in SCENES if n != "in_a_box"])
def test_errors_of_a_ten_millionth_of_the_motion_are_refused_wherever_it_happens(name, shift):
    model = SCENES[name](shift)
    run, problem = simulate(model, compiled=False), one_step_problem(model)
    h, seen = float(model.step), 0
    for k in (7, len(run.t) // 2):
        state = run.x[k - 1] if problem.state.numel() == run.x.shape[1] else np.concatenate([run.x[k - 1], h * run.v[k - 1]])
        stepper = Stepper(problem, "auto", 1e-9, h=h, state=state)
        newton: NewtonSolver = stepper._newton
        step = stepper(run.t[k - 1], h, state, stepper.cold_start())
        known, l = newton.known(run.t[k - 1], h, state), step.row[stepper.layout.l]
        right = newton.polish_on_index_set(run.t[k - 1], h, state, l, step.warm.index)
        assert right.residual <= 1e-9
        motion = np.abs(right.z - known.guess).max()
        for i in range(right.z.size):
            for error in (1e-7 * motion, -1e-7 * motion):
                z = right.z.copy()
                z[i] += error
                if not abs(z[i] - right.z[i]) > 2 * ROUNDING * UNIT_ROUND_OFF * max(abs(z[i]), shift):
                    continue
                at = newton.linearise(run.t[k - 1], h, state, z, right.l)
                assert newton.evaluate_residual(known, at, right.l, right.index, "wrong", 1).residual > 1e-9
                seen += 1
    assert seen or shift >= 1e6


# ---------------------------------------------------------------------------------------------- rows whose true value is 0


def blocks(n, seed=0, t_end=0.5):
    """Blocks between springs, relay friction of random size, all at rest until the pull is larger."""
    t, mu = ca.SX.sym("t"), np.random.default_rng(seed).uniform(0.5, 1.5, n)
    I, Z = sp.eye(n), sp.csc_matrix((n, n))
    K = 40 * (2 * I - sp.eye(n, k=1) - sp.eye(n, k=-1)) + 5 * I
    return LureSystem(
        t=t, A=sp.bmat([[Z, I], [-K, -0.05 * I]]), B=sp.vstack([Z, sp.diags(mu)]), C=sp.hstack([Z, I]),
        f=ca.vertcat(ca.DM.zeros(n), 0.5 * t * ca.DM.ones(n)), law=relay(n), x0=np.zeros(2 * n), t_end=t_end, step=5e-3,
        theta=0.5,
    )  # fmt: skip


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("n", [39, 40, 60])
def test_blocks_at_rest_rest_exactly(n, compiled):
    run = simulate(blocks(n), compiled=compiled)
    assert run.status == "done"
    assert (run.x == 0).all()
    carried = run.multipliers[1:] * np.random.default_rng(0).uniform(0.5, 1.5, n)
    np.testing.assert_allclose(carried, np.tile(-0.5 * (run.t[1:, None] - 2.5e-3), n), rtol=1e-9)


def bridges(copies, h=1e-5, steps=100):
    """Uncoupled copies of a diode bridge with a capacitor behind it, each with a start of its own."""
    k = len(copies)
    L, C, R, Cf = 1e-2, 1e-6, 1e3, 3e-7
    A = [[0, -1 / C, 0], [1 / L, 0, 0], [0, 0, -1 / (R * Cf)]]
    B = [[0, 0, -1 / C, 1 / C], [0, 0, 0, 0], [1 / Cf, 0, 1 / Cf, 0]]
    D = [[0, -1, 0, 0], [1, 0, 1, -1], [0, -1, 0, 0], [0, 1, 0, 0]]
    parts = [np.kron(np.eye(k), M) for M in (A, B, [[0, 0, 1], [0, 0, 0], [-1, 0, 1], [1, 0, 0]], D)]
    x0 = np.concatenate([[10 * (1 + 0.1 * i), 1e-3 * i, 0] for i in copies])
    A, B, C, D = parts
    return LureSystem(A=A, B=B, C=C, D=D, law=complementarity(4 * k), x0=x0, t_end=steps * h, step=h)


@pytest.fixture(scope="module")
def alone():
    return [simulate(bridges([i]), compiled=False).x for i in range(25)]


@pytest.mark.parametrize("compiled", WAYS)
def test_copies_move_as_each_does_alone(alone, compiled):
    run = simulate(bridges(range(25)), compiled=compiled)
    assert run.status == "done"
    for i, x in enumerate(alone):
        assert (np.abs(run.x[:, 3 * i : 3 * i + 3] - x) <= 1e-9 * np.abs(x).max(axis=0)).all()


def test_a_forced_solver_may_end_on_a_degenerate_vertex():
    """Lemke's answer is right but for a multiplier of 6e-18 where 0 is right."""
    run = simulate(bridges([0], 4e-6), solver="lemke", compiled=False)
    np.testing.assert_allclose(run.x, simulate(bridges([0], 4e-6), compiled=False).x, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("compiled", WAYS)
def test_states_that_decay_to_nothing(compiled):
    """g cancels where the state is 0: l = (1/2, -1), also beside |x| = 1e-71."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    g = ca.vertcat(-l[0] * l[1] * x[1] / 2, (2 * l[0] + l[1]) / (1 - l[0] * l[1] / 2))
    for size in some((1e-60, 1e-71, 1e-79)):
        model = FirstOrderSystem(
            x=x, lam=l, f=[x[1], 0], h=x, g=g, law=relay(2), x0=[0, 3e0 * size], t_end=0.05, step=1e-3, theta=0.5
        )
        run = simulate(model, compiled=compiled)
        assert run.status == "done"
        assert np.abs(run.x).max() <= 3.1 * size
        assert (run.x[:, 0] == 0).all()


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("M", [1e7, 1e8, 1e10, 1e12, 1e14])
def test_a_light_mass_under_a_heavy_one(M, compiled):
    """v' = g + forces: the floor carries (1 + M) g, the light mass M g."""
    model = LureSystem(
        A=np.zeros((2, 2)), B=[[1, -1], [0, 1 / M]], C=[[1, 0], [-1, 1]], f=[-9.81, -9.81], law=complementarity(2), x0=[0, 0],
        t_end=0.1, step=1e-2,
    )  # fmt: skip
    run = simulate(model, compiled=compiled)
    np.testing.assert_allclose(run.multipliers[1:], np.tile([9.81 * (1 + M), 9.81 * M], (10, 1)), rtol=2e-9)
    assert (run.x == 0).all()


# ---------------------------------------------------------------------------------------------- beyond the linearisation


def door(y, h=1e-3, t_end=0.6):
    """Two discs close on a point between them, a little off the middle: it leaves along y = -sqrt(1 - a^2)."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    a = 1.1 - t
    sides = {name: ca.norm_2(q - ca.vertcat(side * a, 0)) - 1 for name, side in (("left", -1), ("right", 1))}
    return SweepingProcess(t=t, q=q, f=[0, 0], constraints=sides, q0=[0, y], t_end=t_end, step=h)


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("y", [-1e-6, 1e-3])
def test_a_step_that_leads_beyond_its_linearisation_is_refused_by_name(y, compiled):
    words = r"linearisation of '(left|right)', by which it was taken, means nothing.*smaller steps, or rtol"
    with pytest.raises(StepError, match=words) as e:
        simulate(door(y), compiled=compiled)
    assert e.value.trajectory.t[-1] == pytest.approx(0.1)


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("y", [-1e-6, 1e-3, *([1e-9] if COUNT == FULL else [])])
def test_error_control_passes_the_door(y, compiled):
    run = simulate(door(y), rtol=1e-4, compiled=compiled)
    assert run.x[-1] == pytest.approx([0, np.sign(y) * np.sqrt(1 - 0.25)], abs=1e-5)


@pytest.mark.parametrize("compiled", WAYS)
def test_small_steps_pass_the_door(compiled):
    steps = np.concatenate([np.full(99, 1e-3), np.full(2000, 1e-6), np.full(499, 1e-3)])
    run = simulate(door(-1e-4), steps=steps, compiled=compiled)
    assert run.x[-1, 1] == pytest.approx(-np.sqrt(0.75), abs=1e-6)


@pytest.mark.parametrize("compiled", WAYS)
def test_before_the_discs_meet_the_point_rests(compiled):
    run = simulate(door(-1e-6, t_end=0.05), compiled=compiled)
    assert np.abs(run.x[:, 1] + 1e-6).max() <= 1e-15


def door_of_bodies(y, t_end=0.6):
    """The same for many bodies."""
    t, bodies = ca.SX.sym("t"), Bodies([[0.0, y]])
    i, a = bodies.member("i"), 1.1 - t
    sides = {name: Family(ca.norm_2(i.q - ca.vertcat(side * a, 0)) - 1, i) for name, side in (("left", -1), ("right", 1))}
    return ManyBodies(t=t, bodies=bodies, f=0, constraints=sides, t_end=t_end, step=1e-3)


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("y", [-1e-4, 1e-3])
def test_a_step_of_bodies_that_leads_beyond_its_linearisation_is_refused_by_name(y, compiled):
    with pytest.raises(StepError, match=r"linearisation of '(left|right) 0', by which it was taken, means nothing") as e:
        simulate(door_of_bodies(y), compiled=compiled)
    assert e.value.trajectory.t[-1] == pytest.approx(0.1)


@pytest.mark.long
@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("y", [-1e-4, -0.05])
def test_bodies_pass_the_door_in_small_steps(y, compiled):
    steps = np.concatenate([np.full(99, 1e-3), np.full(2000, 1e-6), np.full(499, 1e-3)])
    run = simulate(door_of_bodies(y), steps=steps, compiled=compiled)
    assert run.x[-1, 1] == pytest.approx(-np.sqrt(0.75), abs=1e-6)


@pytest.mark.parametrize("compiled", WAYS)
def test_a_step_of_bodies_to_where_their_constraint_is_no_number_is_refused(compiled):
    """The constraint -x + 0.1 sqrt(1 - y) acts, and the body moves along it to y > 1."""
    bodies = Bodies([[0.0, 0.9]])
    i = bodies.member("i")
    wall = Family(0.1 * ca.sqrt(1 - i.q[1]) - i.q[0] - 0.1 * np.sqrt(0.1), i)
    with pytest.raises(StepError, match=r"no verified step"):
        simulate(ManyBodies(bodies=bodies, f=ca.DM([1, 5]), constraints={"wall": wall}, t_end=1, step=0.1), compiled=compiled)


def test_linearisations_of_bodies_that_leave_no_point_are_not_said_to_be_the_constraints():
    with pytest.raises(StepError, match=r"linearised at the step's start, the constraints leave no point: .* smaller steps"):
        simulate(door_of_bodies(1e-9))


def test_linearisations_that_leave_no_point_are_not_said_to_be_the_constraints():
    with pytest.raises(StepError, match=r"linearised at the step's start, the constraints leave no point: .* smaller steps"):
        simulate(door(1e-9))


# ---------------------------------------------------------------------------------------------- what elimination loses


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-6, 1e-7])
def test_a_corner_of_nearly_opposite_walls_is_where_they_meet(angle, compiled):
    """Two lines at an angle; one recedes by 1e-3 t: the point is where they meet, 1e-3 t / sin(angle) along the other."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    along, up = np.array([0.8, 0.6]), np.array([-0.6, 0.8])
    roof = np.sin(angle) * along - np.cos(angle) * up
    walls = {"floor": 1e3 * ca.dot(up, q), "roof": ca.dot(roof, q) - 1e-3 * t}
    run = simulate(
        SweepingProcess(t=t, q=q, f=-up - 0.3 * along, constraints=walls, q0=[0, 0], t_end=0.1, step=0.01), compiled=compiled
    )
    parallel = up[0] * roof[1] - up[1] * roof[0]  # of the normals as they are rounded
    assert run.x[1:] @ along == pytest.approx(1e-3 * run.t[1:] / abs(parallel), rel=1e-15 / angle + 1e-9)


def test_derivatives_are_not_collected():
    q = ca.SX.sym("q", 2)
    J = derivatives(ca.sumsqr(3 * (q - 1e6)) + 2 * q[0], q)
    exact = [18 * (2.0**-20) + 2, 18 * (2.0**-21)]
    at = ca.Function("J", [q], [J])([1e6 + 2.0**-20, 1e6 + 2.0**-21])
    assert np.array(at).ravel() == pytest.approx(exact, rel=1e-15)
    assert derivatives(2 * q[0] + q[1] - q[1], q).is_constant()


@pytest.mark.parametrize("seed", range(20))
def test_units_of_rows_and_of_multipliers_are_two_things(seed):
    """y = W l + b with W psd: (a W c, a b) has the solution l / c, whatever the units a and c of the rows."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(2, 30))
    root = rng.normal(size=(m, m))
    W, b = root @ root.T / m + 0.1 * np.eye(m) + np.triu(np.ones((m, m)), 1) - np.tril(np.ones((m, m)), -1), rng.normal(size=m)
    a, c = 10.0 ** rng.uniform(-8, 8, (2, m))
    law, chain = NumericLaw(np.zeros(m), np.full(m, np.inf), ()), (mlcp.INDEX_SET, mlcp.LEMKE)
    cold = np.zeros(m), np.full(m, -1, np.int8)
    plain = mlcp.solve_mlcp(W, b, law, *cold, chain, False, 1e-12)
    scaled = mlcp.solve_mlcp(a[:, None] * W * c, a * b, law, *cold, chain, False, 1e-12)
    assert plain.residual <= 1e-12
    assert scaled.l * c == pytest.approx(plain.l, rel=1e-9, abs=1e-11)
