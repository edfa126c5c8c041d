"""Scenes without, or with more than one, solution or multiplier: the right answer, or an error that names the cause."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from conftest import QUICK
from fuzz_models import share
from scipy.optimize import nnls

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    check,
    complementarity,
    relay,
    simulate,
)
from nsmodel.codegen import library
from nsmodel.codegen import library as cache
from nsmodel.models.sweeping_process.mfcq_constant import mfcq_constant

T, X, LAM, S = (ca.SX.sym(name) for name in ("t", "x", "l", "s"))
Q2 = ca.SX.sym("q", 2)
NOT_UNIQUE = "uniqueness of the solution is not guaranteed"


def failing(model, **options):
    """The error of a run that must stop, and what it has computed."""
    with pytest.raises(StepError) as caught:
        simulate(model, **options)
    return caught.value


# ---------------------------------------------------------------------------------------------- 1. Painleve's rod


def rod_b(theta, mu):
    """b of g'' = A + b l for a sliding rod, m = l = 1: b < 0 iff mu > (4 + tan^2)/(3 tan)."""
    return 1 + 3 * np.cos(theta) ** 2 - 3 * mu * np.sin(theta) * np.cos(theta)


WORST = np.arctan(2)  # The angle at which the least friction makes b negative.


def rod(A, mu, theta=WORST, h=1e-3):
    """The rod, by default at its worst angle, in contact at rest: x is the speed of its tip away from the table."""
    b = rod_b(theta, mu)
    return FirstOrderSystem(x=X, lam=LAM, f=A, h=X, g=b * LAM, law=complementarity(1), x0=0, t_end=10 * h, step=h)


def test_rod_below_the_critical_friction_stays_on_the_table():
    assert rod_b(WORST, 4 / 3) == pytest.approx(0, abs=1e-15)
    b = rod_b(WORST, 1.2)
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
    b = rod_b(WORST, 2.0)
    run = simulate(rod(9.81, 2.0))
    assert any(NOT_UNIQUE in text for text in run.metadata["warnings"])
    speeds = np.diff(run.x[:, 0])
    for k, l in enumerate(run.multipliers[1:, 0]):
        assert l == 0 or l == pytest.approx((run.x[k, 0] + 9.81e-3) / (1e-3 * -b))
        assert speeds[k] == pytest.approx(1e-3 * (9.81 + b * l), abs=1e-14)


@pytest.mark.parametrize("seed", range(share(3)))
def test_rod_at_any_angle_is_judged_by_the_sign_of_b(seed):
    """b < 0 iff mu > (4 + tan^2)/(3 tan), however close: then no solution where A < 0, and two where A > 0."""
    rng = np.random.default_rng(seed)
    for margin in (-0.5, -1e-3, -1e-6, 1e-6, 1e-3, 0.5):
        theta = rng.uniform(0.1, 1.4)
        mu = (4 + np.tan(theta) ** 2) / (3 * np.tan(theta)) * (1 + margin)
        pressed, lifted = rod(-9.81, mu, theta=theta), rod(9.81, mu, theta=theta)
        assert check(pressed, quick=True)["F-mlcp"].verdict == ("violated" if margin > 0 else "holds")
        if margin > 0:
            assert "no solution" in str(failing(pressed))
            assert any(NOT_UNIQUE in text for text in simulate(lifted).metadata["warnings"])
        else:
            np.testing.assert_array_equal(simulate(pressed).x, 0)
            run = simulate(lifted)
            assert run.metadata["warnings"] == []
            np.testing.assert_allclose(run.x[:, 0], 9.81 * run.t)


@pytest.mark.parametrize("A", [-9.81, 9.81])
def test_the_check_of_the_rod_has_a_witness_for_each_thing_that_fails(A):
    """Two forms of one rod: its speed held by a multiplier, and its acceleration y = A + b l as the output of a law."""
    b = rod_b(WORST, 2.0)
    accelerated = LureSystem(A=0, B=0, C=1, D=b, law=complementarity(1), x0=A, t_end=1, step=0.1)
    psd = check(accelerated)["4.1"]
    assert psd.verdict == "violated"
    v = np.array(psd.witness["v"])
    assert psd.witness["v'Dv"] == pytest.approx(v @ v * b, rel=1e-12)
    report = check(rod(A, 2.0))
    assert report["F-mlcp"].verdict == report["F-unique"].verdict == "violated"
    witness = report["F-unique"].witness
    solutions = {(witness["x"][0], witness["l"][0]), (witness["other x"][0], witness["other l"][0])}
    assert len(solutions) == 2
    for x, l in solutions:
        assert x == pytest.approx(witness["x_k"][0] + witness["h"] * (A + b * l), abs=1e-15)
        assert min(x, l) == pytest.approx(0, abs=1e-15)
    if A < 0:
        assert "no solution" in str(failing(accelerated))
        assert any("no solution" in note for note in report.notes)
    else:
        run = simulate(accelerated)
        assert any(NOT_UNIQUE in text for text in run.metadata["warnings"])
        assert set(run.multipliers[1:, 0]) <= {0.0, -A / b}


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


@pytest.mark.parametrize("copies", [2, 5, 50])
def test_a_constraint_given_several_times_counts_once(copies):
    run = simulate(
        SweepingProcess(q=Q2, f=[-1, 0.3], constraints={f"g{i}": Q2[0] + 1 for i in range(copies)}, q0=[0, 0], t_end=2, step=0.1)
    )
    np.testing.assert_allclose(run.x, np.column_stack([np.maximum(-run.t, -1), 0.3 * run.t]), atol=1e-14)
    np.testing.assert_allclose(run.multipliers[12:].sum(axis=1), 0.1, atol=1e-13)
    assert np.all(run.multipliers[1:] >= 0)


def copied(k):
    """Each class with k equal rows: (model, what the shares of the rows add up to by)."""
    many, one, wall = ca.SX.sym("m", k), np.ones(k), {f"g{i}": Q2[0] + 1 for i in range(k)}
    scaled = {f"g{i}": 10.0 ** (i % 9 - 4) * (Q2[0] + 1) for i in range(k)}
    shares, grid = 10.0 ** (np.arange(k) % 9 - 4), {"t_end": 4, "step": 0.1}
    rubbing = {f"e{i}": ([1], 0.5 / k * S) for i in range(k)}
    falling = {"x": X, "f": -1, "x0": 0} | grid
    shaken = {"A": -1, "f": 2 * ca.sin(3 * T), "t": T, "x0": 1} | grid
    return {
        "sweeping": (SweepingProcess(q=Q2, f=[-1, 0.3], constraints=wall, q0=[0, 0], **grid), one),
        "sweeping, rows of any size": (SweepingProcess(q=Q2, f=[-1, 0.3], constraints=scaled, q0=[0, 0], **grid), shares),
        "first order": (FirstOrderSystem(lam=many, h=[X + 1] * k, g=ca.sum1(many), law=complementarity(k), **falling), one),
        "diodes": (LureSystem(B=[one], C=one, law=complementarity(k), **shaken), one),
        "relays": (LureSystem(B=[one / k], C=one, law=relay(k), **shaken), one / k),
        "friction": (FrictionOscillator(x=X, potential=X**2 / 2, friction=rubbing, s=S, x0=2, v0=0, **grid), None),
        "inclusion": (MonotoneInclusion(x=Q2, field=[-1, 0.3], constraints=wall, x0=[0, 0], **grid), one),
    }  # fmt: skip


@pytest.mark.parametrize("name", copied(1))
def test_copies_of_a_row_change_nothing_in_any_class(name):
    alone, share = copied(1)[name]
    once = simulate(alone)
    for k in (2, 10, 50):
        model, shares = copied(k)[name]
        run = simulate(model)
        np.testing.assert_allclose(run.x, once.x, atol=1e-13)
        if shares is not None:
            np.testing.assert_allclose(run.multipliers[1:] @ shares, once.multipliers[1:] @ share, atol=1e-12)


def parallel(angle):
    """Two walls that cross at (-1, 0); the point comes from above and slides to the corner."""
    walls = {"a": Q2[0] + 1 + angle * Q2[1], "b": Q2[0] + 1 - angle * Q2[1]}
    return SweepingProcess(q=Q2, f=[-1, -0.5], constraints=walls, q0=[0, 1], t_end=3, step=0.1)


@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-9, 1e-12, 1e-15])
def test_nearly_parallel_constraints(angle):
    run = simulate(parallel(angle))
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
        p, m = run.x[k] + 0.05 * f, run.multipliers[k + 1]
        np.testing.assert_allclose(run.x[k + 1], nearest(p, G, -np.ones(20)), atol=1e-10)
        np.testing.assert_allclose(m @ G, run.x[k + 1] - p, atol=1e-12)  # the sum of the forces, not its shares, is unique
        assert m.min() >= 0
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


@pytest.mark.parametrize("rho", [0.0, 0.03, 0.3])
@pytest.mark.parametrize("a", [1.2, 1.02, 1 + 1e-9, 1.0, 0.9, 0.3])
def test_the_constant_of_the_door(a, rho):
    """gamma(rho) = sqrt(a^2 + y^2)/|y| at (0, y) while both gaps are <= rho: inf at y = 0 as soon as a - 1 <= rho."""
    for y in (0.0, 1e-12, 0.01, 0.5, np.sqrt(max(1 - a**2, 0)), 2.0):
        length = np.hypot(a, y)
        gradients = np.array([[-a, y], [a, y]]) / length
        near = length - 1 <= rho
        gamma, weights = mfcq_constant(gradients if near else gradients[:0])
        expected = 1.0 if not near else np.inf if y == 0 else length / y
        assert gamma == pytest.approx(expected, rel=1e-9)
        if gamma == np.inf:
            np.testing.assert_allclose(weights, 0.5)
    corner = np.sqrt(max(1 - a**2, 0))
    if corner:
        assert mfcq_constant(np.array([[-a, corner], [a, corner]]))[0] == pytest.approx(1 / np.sqrt(1 - a**2))


@pytest.mark.long
def test_the_check_sees_the_closing_door_before_the_step_fails():
    """While it is open, gamma(rho) is finite only for rho < a - 1; from a = 1 on it is inf, with both discs as the witness."""
    for t_end in (0.0, 0.02, 0.04, 0.049):
        near = check(door([0, 0], [0, 0], t_end or 1e-3))["A5"]
        assert near.value["gamma"] == np.inf or near.value["rho"] < 0.05 - t_end
    for t_end, gamma in ((0.03, 1.0), (0.04, np.inf), (1, np.inf)):  # a step of 0.01 closes a gap of 0.01
        along = check(door([0, 0], [0, 0], t_end))["run-mfcq"]
        assert along.value["gamma"] == gamma
        assert along.verdict == "holds" or along.witness["t"] == pytest.approx(0.04)
    # In the doubles 1.05 and 0.05 the discs are still 4e-17 apart at t = 0.05: no contact can be proved there.
    for t_end, verdict in ((0.05, "unknown"), (0.0501, "violated"), (1, "violated")):
        finding = check(door([0, 0], [0, 0], t_end))["A5'"]
        assert (finding.verdict, finding.value["gamma"]) == (verdict, np.inf)
        if verdict == "unknown":
            continue
        assert sorted(finding.witness["constraints"]) == ["left", "right"]
        np.testing.assert_allclose(finding.witness["weights"], 0.5)
        assert [finding.witness[name] for name in ("t", "q_0", "q_1")] == pytest.approx([0.05, 0, 0], abs=1e-6)


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


def test_anti_relay_is_refused_by_the_check():
    lure = check(LureSystem(A=0, B=-1, C=1, law=relay(1), x0=0, t_end=1, step=0.1))
    assert lure["5.1"].verdict == "violated"
    assert lure["5.1"].witness["v'CBv"] < 0
    assert next(item for item in lure.consequences if item.name == "well posed").verdict == "unknown"
    first = check(FirstOrderSystem(x=X, lam=LAM, f=0, h=X, g=-LAM, law=relay(1), x0=0, t_end=1, step=0.1))["F-unique"]
    assert (first.verdict, first.value["solutions"]) == ("violated", 3)


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
        swings = run.metadata["convergence"]["t_0"] / np.pi
        assert min(abs(swings - 2), abs(swings - 3)) < 0.01


# ---------------------------------------------------------------------------------------------- the same in C


def closing(start):
    walls = {"left": Q2[0] + 0.5 - T, "right": 0.5 - T - Q2[0]}
    return SweepingProcess(t=T, q=Q2, constraints=walls, q0=[start, 0.1], t_end=1, step=0.0625)


COMPILED = {
    "pressed rod": lambda: rod(-9.81, 2.0),
    "lifted rod": lambda: rod(9.81, 2.0),
    "turning rod": lambda: turning_rod(-9.81),
    "turning rod, lifted": lambda: turning_rod(9.81),
    "closing walls": lambda: closing(0.3),
    "parallel walls": lambda: parallel(1e-9),
    "copied wall": lambda: copied(10)["sweeping, rows of any size"][0],
    "copied diodes": lambda: copied(10)["diodes"][0],
    "copied relays": lambda: copied(10)["relays"][0],
    "copied friction": lambda: copied(10)["friction"][0],
    "closing door": lambda: door([0, 0], [0, 0], 1),
    "corner of the door": lambda: door([0, 1.2], [0, -1], 1),
    "anti-relay": lambda: LureSystem(A=0, B=-1, C=1, law=relay(1), x0=0.5, t_end=1, step=0.1),
}


def outcome(model, **options):
    """(the run as far as it came, the message it stopped with)."""
    try:
        return simulate(model, **options), ""
    except StepError as error:
        return error.trajectory, str(error)


@pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", COMPILED)
def test_compiled_steps_give_the_same_states_warnings_and_errors(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "COMPILER_FLAGS", QUICK)
    (run, message), (compiled, compiled_message) = (outcome(COMPILED[name](), compiled=way) for way in (False, True))
    assert compiled.metadata["used"][-1].startswith("steps in C")
    np.testing.assert_allclose(compiled.x, run.x, atol=1e-12)
    assert compiled.metadata["warnings"] == run.metadata["warnings"]
    assert compiled_message == message
