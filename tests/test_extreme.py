"""Stiff, extreme and degenerate scenes: the right answer, or an error that names the cause."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import nnls
from test_agreement import MONOTONE, NOT_MONOTONE, Stretch

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ModelError,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    UsageError,
    box,
    complementarity,
    relay,
    simulate,
)
from nsmodel.model.laws import Law

T, Q, X, LAM, S = (ca.SX.sym(name) for name in ("t", "q", "x", "l", "s"))
Q2 = ca.SX.sym("q", 2)
NOT_UNIQUE = "uniqueness of the solution is not guaranteed"


def failing(model, **options):
    """The error of a run that must stop, and what it has computed."""
    with pytest.raises(StepError) as caught:
        simulate(model, **options)
    return caught.value


def soft(u, a):
    """The prox of a|.|."""
    return np.sign(u) * np.maximum(np.abs(u) - a, 0)


# ---------------------------------------------------------------------------------------------- 1. Painleve's rod


def rod_b(theta, mu):
    """b of g'' = A + b l for a sliding rod, m = l = 1: b < 0 iff mu > (4 + tan^2)/(3 tan)."""
    return 1 + 3 * np.cos(theta) ** 2 - 3 * mu * np.sin(theta) * np.cos(theta)


def rod(A, mu, h=1e-3):
    """The rod at its worst angle, in contact at rest: x is the speed of its tip away from the table."""
    b = rod_b(np.arctan(2), mu)
    return FirstOrderSystem(x=X, lam=LAM, f=A, h=X, g=b * LAM, law=complementarity(1), x0=0, t_end=10 * h, step=h)


def test_rod_below_the_critical_friction_stays_on_the_table():
    assert rod_b(np.arctan(2), 4 / 3) == pytest.approx(0, abs=1e-15)
    b = rod_b(np.arctan(2), 1.2)
    run = simulate(rod(-9.81, 1.2))
    assert run.metadata["warnings"] == []
    np.testing.assert_array_equal(run.x, 0)
    np.testing.assert_allclose(run.multipliers[1:], 9.81 / b)


def test_rod_pressed_on_the_table_beyond_the_critical_friction_has_no_solution():
    error = failing(rod(-9.81, 2.0))
    assert "no solution" in str(error)
    assert "not psd" in str(error)
    assert error.step == 0
    assert any(NOT_UNIQUE in text for text in error.trajectory.metadata["warnings"])


def test_rod_lifting_off_beyond_the_critical_friction_has_two_solutions():
    """A > 0, b < 0: l = 0 and l = A/|b| are both solutions; the run says that uniqueness is lost, and takes one of them."""
    b = rod_b(np.arctan(2), 2.0)
    run = simulate(rod(9.81, 2.0))
    assert any(NOT_UNIQUE in text for text in run.metadata["warnings"])
    speeds = np.diff(run.x[:, 0])
    for k, l in enumerate(run.multipliers[1:, 0]):
        assert l == 0 or l == pytest.approx((run.x[k, 0] + 9.81e-3) / (1e-3 * -b))
        assert speeds[k] == pytest.approx(1e-3 * (9.81 + b * l), abs=1e-14)


def turning_rod(A):
    """The rod turns at 2 rad/s from 0.2 rad into the region where b < 0, mu = 2."""
    state = ca.SX.sym("z", 2)
    b = 1 + 3 * ca.cos(state[1]) ** 2 - 6 * ca.sin(state[1]) * ca.cos(state[1])
    return FirstOrderSystem(
        x=state, lam=LAM, f=[A, 2], h=state[0], g=[b * LAM, 0], law=complementarity(1), x0=[0, 0.2], t_end=0.45, step=1e-2
    )


def test_rod_that_turns_into_the_region_without_solution_says_so():
    error = failing(turning_rod(-9.81))
    entered = 0.2 + 2 * error.time
    assert rod_b(entered, 2.0) < 0 < rod_b(entered - 0.02, 2.0)
    assert np.isfinite(error.trajectory.x).all()
    assert "no solution" in str(error)


def test_rod_that_turns_into_the_region_of_two_solutions_says_so():
    """W is positive at the start and negative later: the warning is due when it happens."""
    run = simulate(turning_rod(9.81))
    assert rod_b(0.2, 2.0) > 0 > rod_b(run.x[-1, 1], 2.0)
    assert any(NOT_UNIQUE in text for text in run.metadata["warnings"])


# ---------------------------------------------------------------------------------------------- 2. stiff rectifier


@pytest.mark.parametrize("h", [1e-10, 1e-6, 1e-3, 1e-1])
def test_stiff_rectifier(h):
    """Time constants 1e-9 and 1: each step is the better of two linear systems, one for each state of the diode."""
    C1, C2, R1, R2, r = 1e-9, 1.0, 1.0, 2.0, 1e-3
    A, B, C = np.array([[-1 / (R1 * C1), 0], [0, -1 / (R2 * C2)]]), np.array([[-1 / C1], [1 / C2]]), np.array([[-1.0, 1.0]])
    period = 40 * h
    source = ca.sin(2 * np.pi * T / period) / (R1 * C1)
    model = LureSystem(t=T, A=A, B=B, C=C, D=r, f=[source, 0], law=complementarity(1), x0=[0, 0], t_end=80 * h, step=h)
    run = simulate(model)
    assert run.metadata["warnings"] == []
    x, blocked = np.zeros(2), 0
    for k in range(80):
        f = np.array([np.sin(2 * np.pi * (k + 1) * h / period) / (R1 * C1), 0])
        scale = np.diag([C1 / (h + C1), 1.0])  # rows of size 1
        M = np.block([[scale @ (np.eye(2) - h * A), -h * scale @ B], [C, np.array([[r]])]])
        right = np.concatenate([scale @ (x + h * f), [0]])
        open_x = np.linalg.solve(M[:2, :2], right[:2])
        conducting = np.linalg.solve(M, right)
        is_open = (C @ open_x)[0] >= 0
        assert is_open or conducting[2] >= 0
        x, l = (open_x, 0.0) if is_open else (conducting[:2], conducting[2])
        blocked += is_open
        np.testing.assert_allclose(run.x[k + 1], x, rtol=1e-9, atol=1e-14)
        assert run.multipliers[k + 1, 0] == pytest.approx(l, rel=1e-8, abs=1e-14)
        if is_open:
            assert run.x[k + 1, 1] == pytest.approx(run.x[k, 1] / (1 + h / (R2 * C2)), rel=1e-12)
    assert 10 < blocked < 70


# ---------------------------------------------------------------------------------------------- 3. opposite walls


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("start", [0.3, -0.3, 0.0, 0.5])
def test_walls_that_close_hold_the_point_until_they_meet(start, order, dim):
    """w = 0.5 - t: q = clip(q0, -w, w), also at w = 0 exactly, where the multipliers are not unique; then no set is left."""
    q = ca.SX.sym("q", dim)
    walls = {"left": q[0] + 0.5 - T, "right": 0.5 - T - q[0]}
    model = SweepingProcess(
        t=T, q=q, constraints=dict(list(walls.items())[::order]), q0=[start, *[0.1] * (dim - 1)], t_end=1, step=0.0625
    )
    error = failing(model)
    run = error.trajectory
    np.testing.assert_allclose(run.x[:, 0], np.clip(start, run.t - 0.5, 0.5 - run.t), atol=1e-15)
    assert run.t[-1] == 0.5
    assert error.time == pytest.approx(0.5625)
    for name in ("'left'", "'right'", "0.5625", "oppose each other"):
        assert name in str(error)


@pytest.mark.parametrize("h", [0.03, 0.2, 0.7])
@pytest.mark.parametrize("solver", ["auto", "qpoases", "qrqp", "daqp", "osqp", "piqp", "lemke", "ipopt"])
def test_no_solver_gets_past_walls_that_overlap(solver, h):
    model = SweepingProcess(
        t=T, q=Q2, constraints={"left": Q2[0] + 0.5 - T, "right": 0.5 - T - Q2[0]}, q0=[0.1, 0], t_end=1.4, step=h
    )
    error = failing(model, solver=solver)
    assert error.trajectory.t[-1] <= 0.5
    assert "'left'" in str(error)
    assert "'right'" in str(error)


def test_a_wedge_of_three_walls_that_closes():
    """The centre of a triangle that shrinks to a point at t = 1."""
    angles = np.array([90, 210, 330]) * np.pi / 180
    walls = {f"wall {i}": 1 - T - ca.dot(Q2, ca.DM([np.cos(a), np.sin(a)])) for i, a in enumerate(angles)}
    error = failing(SweepingProcess(t=T, q=Q2, constraints=walls, q0=[0.1, 0.2], t_end=2, step=0.07))
    assert error.time == pytest.approx(1.05)
    np.testing.assert_allclose(error.trajectory.x[-1], 0, atol=0.05)
    for i in range(3):
        assert f"'wall {i}'" in str(error)


# ---------------------------------------------------------------------------------------------- 4. duplicated constraints


def nearest(p, G, h):
    """The point of {G x >= h} nearest to p (Lawson and Hanson's least distance programming)."""
    target = h - G @ p
    u, _ = nnls(np.vstack([G.T, target]), np.append(np.zeros(p.size), 1.0))
    r = np.vstack([G.T, target]) @ u - np.append(np.zeros(p.size), 1.0)
    return p - r[:-1] / r[-1]


@pytest.mark.parametrize("copies", [2, 5, 30])
def test_a_constraint_given_several_times_counts_once(copies):
    run = simulate(
        SweepingProcess(q=Q2, f=[-1, 0.3], constraints={f"g{i}": Q2[0] + 1 for i in range(copies)}, q0=[0, 0], t_end=2, step=0.1)
    )
    np.testing.assert_allclose(run.x, np.column_stack([np.maximum(-run.t, -1), 0.3 * run.t]), atol=1e-14)
    np.testing.assert_allclose(run.multipliers[12:].sum(axis=1), 0.1, atol=1e-13)
    assert np.all(run.multipliers[1:] >= 0)


@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-9, 1e-12, 1e-15])
def test_nearly_parallel_constraints(angle):
    """Two walls that cross at (-1, 0) at a tiny angle; the point comes from above and slides to the corner."""
    walls = {"a": Q2[0] + 1 + angle * Q2[1], "b": Q2[0] + 1 - angle * Q2[1]}
    run = simulate(SweepingProcess(q=Q2, f=[-1, -0.5], constraints=walls, q0=[0, 1], t_end=3, step=0.1))
    G = np.array([[1, angle], [1, -angle]])
    for k in range(30):
        p = run.x[k] + 0.1 * np.array([-1, -0.5])
        q = run.x[k + 1]
        assert (G @ q + 1).min() >= -1e-12
        np.testing.assert_allclose(q, nearest(p, G, -np.ones(2)), atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_many_random_rows(seed):
    rng = np.random.default_rng(seed)
    G, q = rng.normal(size=(20, 4)), ca.SX.sym("q", 4)
    G[10] = G[3]
    f = 10 * rng.normal(size=4)
    run = simulate(SweepingProcess(q=q, f=f, constraints={"rows": ca.DM(G) @ q + 1}, q0=np.zeros(4), t_end=1, step=0.05))
    for k in range(20):
        np.testing.assert_allclose(run.x[k + 1], nearest(run.x[k] + 0.05 * f, G, -np.ones(20)), atol=1e-10)
    assert (run.multipliers[-1] > 0).sum() >= 3


# ---------------------------------------------------------------------------------------------- 5. narrowing door


def door(q0, f, t_end, h=0.01):
    """Two discs of radius 1 whose centres (+-a, 0), a = 1.05 - t, come together."""
    a = 1.05 - T
    discs = {"right": ca.norm_2(Q2 - ca.vertcat(a, 0)) - 1, "left": ca.norm_2(Q2 + ca.vertcat(a, 0)) - 1}
    return SweepingProcess(t=T, q=Q2, f=f, constraints=discs, q0=q0, t_end=t_end, step=h)


def test_a_point_in_the_middle_of_a_closing_door_stays_until_there_is_no_room():
    error = failing(door([0, 0], [0, 0], 1))
    run = error.trajectory
    np.testing.assert_array_equal(run.x, 0)
    assert run.t[-1] == pytest.approx(0.05)
    assert "'right'" in str(error)
    assert "'left'" in str(error)


@pytest.mark.parametrize("h", [0.02, 0.005])
def test_a_point_above_a_closing_door_falls_on_the_corner_and_is_lifted(h):
    """y = max(1.2 - t, sqrt(1 - a^2)) on the axis of symmetry, from a symmetric start."""
    run = simulate(door([0, 1.2], [0, -1], 1, h))
    corner = np.sqrt(np.maximum(1 - (1.05 - run.t) ** 2, 0))
    assert np.all(np.abs(run.x[:, 0]) < 1e-14)
    assert np.all(run.gap >= -1e-14)
    np.testing.assert_allclose(run.x[:, 1], np.maximum(1.2 - run.t, corner), atol=4 * h)
    assert run.active[-1].all()


# ---------------------------------------------------------------------------------------------- 6. anti-relay, 7. tie


@pytest.mark.parametrize("x0", [0, 0.5, -0.5])
def test_anti_relay_warns_and_takes_a_solution(x0):
    """x' ∈ Sgn(x): from 0 the solutions are 0, t, -t and all that wait before they leave."""
    run = simulate(LureSystem(A=0, B=-1, C=1, law=relay(1), x0=x0, t_end=1, step=0.1))
    assert any(NOT_UNIQUE in text for text in run.metadata["warnings"])
    x, l = run.x[:, 0], run.multipliers[:, 0]
    np.testing.assert_allclose(np.diff(x), -0.1 * l[1:], atol=1e-15)
    assert np.all((l[1:] == -np.sign(x[1:])) | ((x[1:] == 0) & (np.abs(l[1:]) <= 1)))
    if x0:
        np.testing.assert_allclose(x, x0 + np.sign(x0) * run.t, atol=1e-14)


def test_threshold_tie_changes_the_time_of_rest_and_not_the_state():
    """|x_0| = 5 +- 1e-9: at rest after two or three half swings, at |x| = 1 within 1e-9 (and the scheme's own error)."""
    runs = [
        simulate(FrictionOscillator(x=X, potential=X**2 / 2, friction=S, s=S, x0=5 + d, v0=0, t_end=12, step=1e-3))
        for d in (-1e-9, 0, 1e-9)
    ]
    for run in runs:
        np.testing.assert_allclose(run.x, runs[0].x, atol=1e-8)
        assert abs(run.x[-1, 0]) == pytest.approx(1, abs=0.02)
        assert run.v[-1, 0] == 0


# ---------------------------------------------------------------------------------------------- 8. stiff oscillator


@pytest.mark.parametrize("friction", [0, 1e-12, 1.0, 1e12])
@pytest.mark.parametrize("periods", [1e-3, 1.0, 1000.0])
def test_stiff_oscillator_never_gains_energy(periods, friction):
    """w^2 = 1e8: E_{n+1} - E_n <= -h Phi(v); each step is a soft threshold."""
    h = periods * 2 * np.pi / 1e4
    options = {"friction": friction * S, "s": S} if friction else {}
    model = FrictionOscillator(x=X, potential=1e8 * X**2 / 2, **options, x0=1.0, v0=-3.0, t_end=200 * h, step=h)
    run = simulate(model)
    x, v, loss = 1.0, -3.0, np.diff(run.energy)
    for k in range(200):
        v = soft(v - h * 1e8 * x, h * friction) / (1 + h**2 * 1e8)
        x = x + h * v
        scale = max(abs(run.v[k, 0]), 1e-300)
        assert run.v[k + 1, 0] == pytest.approx(v, rel=1e-6, abs=1e-9 * scale)
        x, v = run.x[k + 1, 0], run.v[k + 1, 0]
    assert np.all(loss <= -h * friction * np.abs(run.v[1:, 0]) + 1e-12 * run.energy[:-1])
    if friction == 1e12:
        np.testing.assert_array_equal(run.v[1:], 0)
        np.testing.assert_array_equal(run.x, 1)


def decaying():
    """States that halve at each step, down to 0: through the smallest numbers that there are."""
    yield FirstOrderSystem(x=X, f=-X, x0=1, t_end=1200, step=1)
    yield LureSystem(A=-1, B=1, C=1, law=complementarity(1), x0=1, t_end=1200, step=1)
    yield FrictionOscillator(x=X, potential=X**2 / 2, friction=S**2, s=S, x0=1, v0=0, t_end=48000, step=10)
    yield MonotoneInclusion(x=X, field=-X / 2, lower=-1, x0=1, t_end=1200, step=1)
    yield SweepingProcess(q=Q, f=-Q / 2, constraints={"wall": Q}, q0=1, t_end=1200, step=1)


@pytest.mark.parametrize("at", range(5), ids=["first order", "Lur'e", "oscillator", "inclusion", "sweeping"])
def test_a_state_that_dies_out_ends_at_zero(at):
    """Below 1e-308 doubles lose their relative accuracy: no reason to stop."""
    run = simulate(list(decaying())[at])
    assert run.status == "done"
    assert abs(run.x[-1, 0]) < 1e-300
    assert run.x[0, 0] == 1


# ---------------------------------------------------------------------------------------------- 9. scales


def scaled_law(law, unit):
    return Law(tuple(type(b)(b.kind, b.label, b.size, b.lower * unit, b.upper * unit, b.H, b.K) for b in law.blocks))


def in_units(model, u, tau):
    """The same model with states u times and times tau times as large; multipliers and outputs of laws u times."""
    model = model.bind()

    def at(expression, *pairs):
        old, new = zip(*pairs, strict=True)
        return ca.substitute([ca.SX(expression)], list(old), list(new))[0]

    common = {"t": model.t, "t_end": model.t_end * tau, "step": model.step * tau, "names": model.names}
    kind, t = type(model), (model.t, model.t / tau)
    if kind is SweepingProcess:
        q = (model.q, model.q / u)
        constraints = {name: u * at(g, t, q) for name, g in model.constraints.items()}
        return kind(q=model.q, f=u / tau * at(model.f, t, q), constraints=constraints, q0=u * ca.DM(model.q0), **common)
    x = (model.x, model.x / u)
    start = {"x": model.x, "x0": u * ca.DM(model.x0)}
    if kind is FrictionOscillator:
        friction = {e.name: (e.H, u**2 / tau**3 * at(e.theta, (model.s, model.s * tau / u))) for e in model.elements}
        second = {"v0": u / tau * ca.DM(model.v0)} if model.x1 is None else {"x1": u * ca.DM(model.x1)}
        return kind(potential=(u / tau) ** 2 * at(model.potential, x), friction=friction, s=model.s, **start, **second, **common)
    if kind is FirstOrderSystem:
        l = (model.lam, model.lam / u)
        return kind(
            lam=model.lam, f=u / tau * at(model.f, t, x), h=u * at(model.h, t, x, l), g=u / tau * at(model.g, t, x, l), M=model.M,
            law=scaled_law(model.law, u), theta=model.theta, gamma=model.gamma, **start, **common,
        )  # fmt: skip
    if kind is LureSystem:
        return kind(
            A=u / tau * at(model.A, x), B=model.B / tau, C=model.C, D=model.D, f=u / tau * at(model.f, t),
            law=scaled_law(model.law, u), theta=model.theta, gamma=model.gamma, **start, **common,
        )  # fmt: skip
    potential = {"operator": u / tau * at(model.operator, x)}
    if model.phi is not None:
        potential = {"phi": u**2 / tau * at(model.phi, x)}
    bounds = {"lower": u * model.lower, "upper": u * model.upper}
    return kind(field=u / tau * at(model.field, x), **bounds, **potential, **start, **common)


@pytest.mark.parametrize("units", [(1e-9, 1.0), (1e9, 1.0), (1.0, 1e-9), (1.0, 1e9), (1e-9, 1e9), (1e9, 1e9)], ids=str)
@pytest.mark.parametrize("stem", MONOTONE | NOT_MONOTONE)
def test_units_do_not_matter(stem, units, load_case):
    """Every case in other units of state and time gives the scaled run, with the same index sets."""
    u, tau = units
    stretch: Stretch = (MONOTONE | NOT_MONOTONE)[stem]
    steps = min(stretch.steps, 60)
    model = load_case(stem, **stretch.arguments)
    reference = simulate(model, step=stretch.step, t_end=stretch.step * steps)
    run = simulate(in_units(model, u, tau), step=stretch.step * tau, t_end=stretch.step * steps * tau)
    size = np.abs(reference.x).max()
    np.testing.assert_allclose(run.x / u, reference.x, rtol=0, atol=1e-9 * size)
    np.testing.assert_allclose(run.t / tau, reference.t, rtol=1e-12)
    changed = (run.index_set != reference.index_set).any(axis=1)
    assert changed.sum() <= 0.05 * len(changed)  # a tie at a switch may fall to the other side
    assert run.metadata["warnings"] == reference.metadata["warnings"] or stem in NOT_MONOTONE


# ---------------------------------------------------------------------------------------------- 10. steps


def one_dimensional():
    """{class: (model with step 1, its exact step (x, v, h, t) -> (x, v))}."""
    yield (
        "sweeping",
        SweepingProcess(t=T, q=Q, f=-1, constraints={"wall": Q + 1}, q0=0.5, t_end=20, step=1),
        lambda x, v, h: (max(x - h, -1), 0),
    )

    def oscillate(x, v, h):
        v = soft(v - h * x, 0.3 * h) / (1 + h * h)
        return x + h * v, v

    yield (
        "oscillator",
        FrictionOscillator(x=X, potential=X**2 / 2, friction=0.3 * S, s=S, x0=2, v0=1, t_end=20, step=1),
        oscillate,
    )
    yield (
        "first order",
        FirstOrderSystem(x=X, lam=LAM, f=-1, h=X, g=LAM, law=complementarity(1), x0=0.5, t_end=20, step=1),
        lambda x, v, h: (max(x - h, 0), 0),
    )
    yield "Lur'e", LureSystem(A=-1, B=1, C=1, law=relay(1), x0=3, t_end=20, step=1), lambda x, v, h: (soft(x, h) / (1 + h), 0)
    yield (
        "inclusion",
        MonotoneInclusion(x=X, field=1 - X / 7, lower=-1, upper=2, x0=0.5, t_end=20, step=1),
        lambda x, v, h: (float(np.clip(x + h * (1 - x / 7), -1, 2)), 0),
    )


CLASSES = {name: (model, step) for name, model, step in one_dimensional()}


@pytest.mark.parametrize("h", [1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", CLASSES)
def test_steps_from_1e_minus_12_to_1e3_natural_times(name, h):
    model, step = CLASSES[name]
    run = simulate(model, step=h, t_end=20 * h)
    x, v = float(run.x[0, 0]), 1.0
    for k in range(20):
        x, v = step(x, v, h)
        assert run.x[k + 1, 0] == pytest.approx(x, rel=1e-12, abs=1e-14)
    assert run.residual[1:].max() <= 1e-9


@pytest.mark.parametrize("name", CLASSES)
def test_the_step_changes_by_a_factor_of_1e15_within_a_run(name):
    model, step = CLASSES[name]
    steps = np.tile([1e-12, 1e3, 1e-6, 1.0], 5) if name != "oscillator" else np.geomspace(1e-12, 1e3, 20)
    run = simulate(model, steps=steps)
    x, v, last = float(run.x[0, 0]), 1.0, None
    for k, h in enumerate(steps):
        if name == "oscillator":  # the older difference is divided by the new step
            v = v if last is None else v * last / h
            last = h
        x, v = step(x, v, h)
        assert run.x[k + 1, 0] == pytest.approx(x, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("bad", [0, -0.1, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", CLASSES)
def test_impossible_steps_are_refused_at_once(name, bad):
    model = CLASSES[name][0]
    for options, word in (({"step": bad}, "step"), ({"t_end": bad}, "t_end"), ({"steps": [0.1, bad]}, r"steps\[1\]")):
        with pytest.raises(UsageError, match=word):
            simulate(model, **options)


# ---------------------------------------------------------------------------------------------- 11. emptiness


def empty():
    """Scenes with nothing to solve: (name, model, exact state (n,) at the end)."""
    yield "no constraints", SweepingProcess(q=Q2, f=[1, -2], q0=[0, 1], t_end=1, step=0.1), [1, -1]
    yield "empty dictionary", SweepingProcess(q=Q2, f=[1, -2], constraints={}, q0=[0, 1], t_end=1, step=0.1), [1, -1]
    yield "empty column", SweepingProcess(q=Q2, f=[1, -2], constraints={"none": []}, q0=[0, 1], t_end=1, step=0.1), [1, -1]
    yield "nothing at all", SweepingProcess(q=Q, q0=3, t_end=1, step=0.1), [3]
    yield "no friction, no force", FrictionOscillator(x=X, x0=1, v0=2, t_end=1, step=0.1), [3]
    yield "no law", FirstOrderSystem(x=X, f=0.5, x0=1, t_end=1, step=0.1), [1.5]
    yield (
        "law of size 0",
        FirstOrderSystem(x=X, lam=ca.SX(0, 1), f=0.5, h=[], g=0, law=complementarity(0), x0=1, t_end=1, step=0.1),
        [1.5],
    )
    for law in (complementarity(0), box([], []), Law(())):
        yield (
            "Lur'e, law of size 0",
            LureSystem(
                A=np.zeros((2, 2)), B=np.zeros((2, 0)), C=np.zeros((0, 2)), f=[1, -2], law=law, x0=[0, 1], t_end=1, step=0.1
            ),
            [1, -1],
        )
    yield "no operator, no set", MonotoneInclusion(x=X, field=0.5, x0=1, t_end=1, step=0.1), [1.5]


@pytest.mark.parametrize("at", range(len(list(empty()))))
def test_nothing_to_solve_leaves_the_solver_out(at):
    name, model, end = list(empty())[at]
    run = simulate(model)
    assert run.status == "done", name
    np.testing.assert_allclose(run.x[-1], end, atol=1e-14)
    assert run.multipliers.shape == (11, 0)
    assert not set(run.metadata["solver_counts"]) & {"qpoases", "lemke", "enumeration", "ipopt", "index set"}
    assert any("solver" in line for line in run.metadata["left_out"])
    with pytest.raises(UsageError, match="does not apply"):
        simulate(model, solver="qpoases")


def test_a_constraint_that_never_acts_calls_no_solver():
    far = {"far": 100 - Q2[0], "disc": ca.norm_2(Q2 - 50) - 1}
    run = simulate(SweepingProcess(q=Q2, f=[1, 0], constraints=far, q0=[0, 0], t_end=1, step=0.1))
    np.testing.assert_allclose(run.x[:, 0], run.t, atol=1e-14)
    np.testing.assert_array_equal(run.multipliers[1:], 0)
    assert np.all(run.index_set[1:] == -1)


def test_a_law_that_is_a_point_is_a_known_force():
    """box(c, c): the multiplier is c whatever y is."""
    run = simulate(LureSystem(A=-1, B=1, C=1, law=box(0.25, 0.25), x0=1, t_end=1, step=0.1))
    np.testing.assert_array_equal(run.multipliers[1:], 0.25)
    np.testing.assert_allclose(run.x[1:, 0], (run.x[:-1, 0] + 0.025) / 1.1, atol=1e-15)


def test_zero_columns_and_rows_are_no_obstacle():
    """A multiplier that acts on nothing, and an output that nothing moves."""
    model = LureSystem(A=-1, B=[[1, 0]], C=[[1], [0]], D=np.zeros((2, 2)), law=relay(2), x0=0.5, t_end=1, step=0.1)
    run = simulate(model)
    x = 0.5
    for k in range(10):
        x = soft(x, 0.1) / 1.1
        assert run.x[k + 1, 0] == pytest.approx(x, abs=1e-15)


# ---------------------------------------------------------------------------------------------- 12. bad models


def test_starts_outside_the_set_are_refused():
    for model in (
        SweepingProcess(q=Q2, constraints={"disc": ca.norm_2(Q2) - 1}, q0=[0.5, 0], t_end=1, step=0.1),
        MonotoneInclusion(x=X, field=1, lower=0, x0=-1, t_end=1, step=0.1),
        MonotoneInclusion(x=Q2, field=[1, 1], constraints={"disc": 1 - ca.dot(Q2, Q2)}, x0=[2, 0], t_end=1, step=0.1),
        FrictionOscillator(x=X, constraints={"floor": X}, x0=-0.1, t_end=1, step=0.1),
    ):
        with pytest.raises(UsageError, match="outside the set"):
            simulate(model)


def test_models_that_break_a_hypothesis_load_and_warn():
    decreasing = FrictionOscillator(x=X, potential=X**2, friction=S - S**2, s=S, x0=0.1, t_end=0.2, step=0.1)
    saddle = FrictionOscillator(x=X, potential=-(X**2), friction=S, s=S, x0=0.1, t_end=0.2, step=0.1)
    lifted = LureSystem(A=-1, B=1, C=1, D=-0.01, law=relay(1), x0=1, t_end=0.2, step=0.1)
    said = ((decreasing, ["theta", "decreases"]), (saddle, ["not convex"]), (lifted, ["D is not positive semidefinite"]))
    for model, words in said:
        try:
            run = simulate(model)
        except StepError as error:
            run = error.trajectory
        assert any(all(word in text for word in words) for text in run.metadata["warnings"])


# ---------------------------------------------------------------------------------------------- 13. kinks and gradients


@pytest.mark.parametrize(
    ("constraint", "q0"),
    [(ca.dot(Q2, Q2), [0, 0]), (Q2[0] ** 3, [0, 0]), (ca.fabs(Q2[0]), [0, 0]), (ca.SX(1), [0, 0]), (Q2[0] * Q2[1], [0, 0])],
    ids=str,
)
def test_a_constraint_without_gradient_at_the_start_is_said(constraint, q0):
    """Its linearised set is everything or nothing, whatever the set is."""
    model = SweepingProcess(q=Q2, f=[1, 0], constraints={"flat": constraint, "wall": 5 - Q2[0]}, q0=q0, t_end=0.3, step=0.1)
    try:
        said = " ".join(simulate(model).metadata["warnings"])
    except (UsageError, ModelError) as error:
        said = str(error)
    assert "'flat'" in said
    assert "gradient" in said
    assert "'wall'" not in said


@pytest.mark.parametrize("constraint", [ca.norm_2(Q2), ca.sqrt(Q2[0]), Q2[1] / Q2[0], ca.log(Q2[0])], ids=str)
def test_a_constraint_that_is_not_a_number_at_the_start_is_refused(constraint):
    with pytest.raises(UsageError, match=r"constraint 'bad': its (value|gradient) at the start .* is not a finite number"):
        simulate(SweepingProcess(q=Q2, f=[1, 0], constraints={"bad": constraint}, q0=[0, 0], t_end=1, step=0.1))


def test_a_constraint_that_becomes_not_a_number_is_named():
    """A root whose argument becomes negative at t = 0.35."""
    walls = {"root": ca.sqrt(0.35 - T) + 1 - Q, "wall": 9 - Q}
    error = failing(SweepingProcess(t=T, q=Q, f=1, constraints=walls, q0=0, t_end=1, step=0.1))
    assert "'root'" in str(error)
    assert "not a finite number" in str(error)
    assert error.trajectory.t[-1] == pytest.approx(0.3)


def test_discontinuous_f():
    run = simulate(SweepingProcess(t=T, q=Q, f=ca.if_else(T < 0.45, 1, -1), constraints={"w": 0.3 - Q}, q0=0, t_end=1, step=0.1))
    np.testing.assert_allclose(run.x[:, 0], [0, 0.1, 0.2, 0.3, 0.3, 0.3, 0.2, 0.1, 0, -0.1, -0.2], atol=1e-15)
    run = simulate(SweepingProcess(q=Q, f=ca.sign(0.25 - Q), constraints={"w": 0.35 - Q}, q0=0, t_end=1, step=0.1))
    np.testing.assert_allclose(run.x[3:, 0], [0.3, 0.2] * 4, atol=1e-15)


def test_kinks_in_a_constraint():
    """A square obstacle |q|_inf >= 1: its face x = -1 stops the point, which glides up along it and goes over the corner."""
    square = ca.fmax(ca.fabs(Q2[0]), ca.fabs(Q2[1])) - 1
    run = simulate(SweepingProcess(q=Q2, f=[1, 0.5], constraints={"square": square}, q0=[-2, 0.3], t_end=4, step=0.01))
    assert run.gap.min() >= -1e-14
    x = run.x
    held = (run.t > 1.05) & (run.t < 1.35)
    np.testing.assert_allclose(x[held, 0], -1, atol=1e-14)
    np.testing.assert_allclose(x[:, 1], 0.3 + 0.5 * run.t, atol=0.02)
    assert x[-1, 0] == pytest.approx(-1 + (4 - 1.4), abs=0.02)


def test_a_root_of_a_square_is_a_distance():
    """Two intervals head-on, by the root of a square: they meet and stay together."""
    q = ca.SX.sym("q", 2)
    pair = {"pair": ca.sqrt((q[1] - q[0]) ** 2) - 0.2}
    run = simulate(SweepingProcess(q=q, f=[1, -1], constraints=pair, q0=[-1, 1], t_end=2, step=0.05))
    np.testing.assert_allclose(run.x[-1], [-0.1, 0.1], atol=1e-14)


# ---------------------------------------------------------------------------------------------- 14. long runs


def test_a_long_run_keeps_few_rows_and_does_not_drift():
    """100 000 steps along a wall that swings: every 1000th row is kept, and each is exact, as are contact and release."""
    model = SweepingProcess(t=T, q=Q2, f=[-1, 1], constraints={"wall": Q2[0] - ca.sin(T)}, q0=[0, 0], t_end=1000, step=1e-2)
    run = simulate(model, save_every=1000)
    assert len(run.t) == 101
    assert run.gap.min() >= -1e-13
    np.testing.assert_allclose(run.x[:, 0], np.sin(run.t), atol=1e-13)  # pressed on: the wall never moves back faster than 1
    np.testing.assert_allclose(run.x[:, 1], run.t, rtol=1e-11)


def test_a_resting_oscillator_stays_where_it_is_for_ever():
    model = FrictionOscillator(x=Q2, potential=ca.dot(Q2, Q2), friction=S + S**3, s=S, x0=[2, 1], v0=[0, 0], t_end=20, step=1e-2)
    run = simulate(model)
    still = np.flatnonzero((run.v[1:] == 0).all(axis=1))[0] + 1
    assert still < 1000
    assert len(np.unique(run.x[still:], axis=0)) == 1
