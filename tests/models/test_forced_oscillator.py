"""Oscillators with dry friction and a force that moves with time: against closed forms, by every way of stepping."""

import casadi as ca
import closed_forms as exact
import numpy as np
import pytest

from nsmodel import FrictionOscillator, LureSystem, ModelError, check, relay, simulate, stepper, stress, table
from nsmodel.models.friction_oscillator.documents import equations
from nsmodel.study.units import in_units

t, x, s, u = (ca.SX.sym(name) for name in "txsu")
F, W = 2.0, 0.7


def swing(**fields):
    """x'' + x + Sgn(x') ∋ 2 cos 0.7 t: it slips, sticks and turns (Den Hartog 1931)."""
    given = {"force": F * ca.cos(W * t), "t": t, "x0": 1.0, "v0": 0.0, "t_end": 10, "step": 0.01} | fields
    return FrictionOscillator(x=x, s=s, potential=x**2 / 2, friction=s, **given)


def off(run):
    """The largest errors of position and velocity."""
    return np.abs(np.hstack([run.x, run.v]) - exact.friction_forced(run.t, run.x[0, 0], F=F, W=W))[1:].max(axis=0)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_scheme_keeps_its_order(compiled, own_cache):
    coarse, fine = (simulate(swing(step=h), compiled=compiled) for h in (0.01, 0.005))
    assert (off(fine) < 0.03).all()
    assert np.log2(off(coarse) / off(fine)) == pytest.approx(1, abs=0.05)
    stuck = (fine.t > 6.0) & (exact.friction_forced(fine.t, 1.0, F=F, W=W)[:, 1] == 0)
    assert (fine.v[stuck][5:-5] == 0).all()  # stick is exactly 0


def test_two_positions_start_it_too():
    """The paper's start x_0, x_1: x_1 from the closed form; the order stays."""
    errors = [off(simulate(swing(v0=None, x1=exact.friction_forced([h], 1.0, F=F, W=W)[0, 0], step=h))) for h in (0.01, 0.005)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("compiled", [False, True])
def test_pieces_are_exact(compiled, own_cache):
    run = simulate(swing(t_end=20), rtol=1e-10, compiled=compiled)
    assert (off(run) < 1e-9).all()
    assert run.energy[-1] == pytest.approx(run.v[-1, 0] ** 2 / 2 + run.x[-1, 0] ** 2 / 2)


def test_error_control_is_the_same_in_c(own_cache):
    runs = [simulate(swing(t_end=1, x0=0.2), rtol=1e-3, method="time-stepping", compiled=compiled) for compiled in (False, True)]
    assert (runs[0].t == runs[1].t).all()
    assert runs[0].x == pytest.approx(runs[1].x, abs=1e-13)
    assert off(runs[0])[0] < 5e-3


def test_is_the_lure_system_of_position_and_velocity():
    """Two masses, a rail and a clutch: implicit Euler of the same equations."""
    q, H = ca.SX.sym("q", 2), np.array([[1, 0], [1, -1]])
    f, K, M = ca.vertcat(3 * ca.sin(2 * t), 1), np.array([[3, -1], [-1, 2]]), np.diag([0.1, 0.2])
    common = {"t": t, "t_end": 4, "step": 0.01}
    model = FrictionOscillator(
        x=q, s=s, potential=q.T @ ca.DM(K) @ q / 2, damping=M, force=f, x0=[0.5, 0], v0=[0, 1],
        friction={"rail": (H[:1], 0.5 * s), "clutch": (H[1:], 0.3 * s)}, **common,
    )  # fmt: skip
    zero = np.zeros((2, 2))
    other = LureSystem(
        A=np.block([[zero, np.eye(2)], [-K, -M]]), f=ca.vertcat(0, 0, f), B=np.vstack([zero, H.T]), C=np.hstack([zero, H]),
        law=relay(2, [-0.5, -0.3], [0.5, 0.3]), x0=[0.5, 0, 0, 1], **common,
    )  # fmt: skip
    one, two = simulate(model), simulate(other)
    assert np.hstack([one.x, one.v]) == pytest.approx(two.x, abs=1e-10)


def test_a_constant_force_is_a_part_of_the_potential():
    p = ca.SX.sym("p")
    one = swing(force=0.3 * p, t=None, parameters={p: 2.0})
    two = FrictionOscillator(x=x, s=s, potential=x**2 / 2 - 0.6 * x, friction=s, x0=1.0, t_end=10, step=0.01)
    assert not one.is_forced
    assert (simulate(one).x == simulate(two).x).all()
    assert simulate(one).metadata["convergence"]["finite"]
    gone = swing(force=p * ca.sin(t), parameters={p: 0.0})  # with this value nothing moves
    assert (simulate(gone).x == simulate(swing(force=None)).x).all()


# -- inputs --------------------------------------------------------------------------------------------------------------

PEAK = np.sqrt(2 * 1.5 * 2.5 / 4)
TIMES = [0, PEAK / 1.5, PEAK / 1.5 + PEAK / 2.5]


def move(**fields):
    """A unit mass with friction 1/2 is pushed by 2, pulled by 2 and left at rest at x = 1; the edges are irrational."""
    given = {"inputs": {u: table(TIMES, [2, -2, 0])}, "t_end": 2, "step": 0.013} | fields
    return FrictionOscillator(x=x, s=s, friction=0.5 * s, force=u, x0=0.0, **given)


def speed(times):
    return np.interp(times, [*TIMES, 9], [0, PEAK, 0, 0])


@pytest.mark.parametrize("compiled", [False, True])
def test_the_velocity_goes_on_where_steps_change(compiled, own_cache):
    run = simulate(move(), compiled=compiled)
    assert np.unique(np.round(run.step[1:], 12)).size == 3
    assert run.v[:, 0] == pytest.approx(speed(run.t), abs=1e-12)
    assert (run.v[run.t > TIMES[2] + 1e-9] == 0).all()
    assert run.x[-1, 0] == pytest.approx(
        1 + np.sum(run.step[1:] * np.diff(run.v[:, 0])) / 2, abs=1e-12
    )  # h v at the end of steps
    assert (run.inputs[run.t == TIMES[1]] == 2).all()
    assert run.metadata["convergence"]["finite"] is False
    assert "may start again" in run.metadata["convergence"]["reason"]


def test_pieces_end_at_edges_of_the_force():
    run = simulate(move(), rtol=1e-9)
    assert run.x[-1, 0] == pytest.approx(1, abs=1e-13)
    assert set(TIMES) <= set(run.t)


def test_given_steps_and_error_control_keep_the_velocity():
    steps = np.diff(np.unique([*np.linspace(0, 2, 40), *TIMES]))
    run = simulate(move(step=None, t_end=None, steps=steps))
    assert run.v[:, 0] == pytest.approx(speed(run.t), abs=1e-12)
    run = simulate(move(), rtol=1e-2, method="time-stepping")
    assert run.v[:, 0] == pytest.approx(speed(run.t), abs=1e-6)


def test_a_force_of_time_alone_keeps_the_velocity_where_steps_change():
    steps = np.array([0.1, 0.2, 0.05, 0.3, 0.1])
    run = simulate(FrictionOscillator(x=x, t=t, force=2 * t, potential=0, x0=0.0, v0=1.0, steps=steps))
    np.testing.assert_allclose(run.v[1:, 0], 1 + np.cumsum(steps * 2 * np.cumsum(steps)), rtol=1e-12)


def test_step_by_step():
    loop, v = stepper(move(inputs={u: None}), step=0.1), 0.0
    for h, force in ((0.1, 1.0), (0.05, 1.0), (0.2, -0.25), (0.1, 0.4)):
        row = loop.step(force, h=h)
        v = max(v + h * (force - 0.5), 0.0)
        assert row.x[0] == pytest.approx(loop.x[0])
        assert loop.checkpoint()["state"][1] == pytest.approx(v, abs=1e-14)


# -- hypotheses, judge, units ----------------------------------------------------------------------------------------------


def test_nothing_is_said_of_rest():
    report = check(swing(t_end=2))
    found = {item.id: item.verdict for item in report.findings}
    assert [found[id] for id in ("O-theta", "O-g", "O-dry", "O-steps")] == ["holds"] * 4
    assert found["run-energy"] == found["run-dissipated"] == "unknown"
    made = {item.name: item for item in report.consequences}
    assert made["well posed"].verdict == "holds"
    assert made["energy decay"].verdict == made["convergence"].verdict == "unknown"
    assert "left to themselves" in made["convergence"].statement
    assert not {"rest points", "finite convergence", "finite from every start"} & set(made)
    free = {item.name for item in check(swing(t_end=2, force=0)).consequences}
    assert {"rest points", "finite convergence"} <= free
    assert r"\ni f(t)" in equations(swing())[0]
    report = check(move(t_end=1.2))
    assert next(item for item in report.findings if item.id == "O-steps").verdict == "holds"
    driven = {item.name: item.verdict for item in report.consequences}
    assert driven["well posed"] == "holds"
    assert "holds" not in {driven.get(name) for name in ("energy decay", "convergence", "finite convergence", "rest points")}


def test_for_all_values_of_a_parameter():
    p = ca.SX.sym("p")
    report = check(swing(force=p * ca.sin(t), parameters={p: None}), [], parameters={"p": (0.5, 1.0)}, quick=True)
    assert not {"rest points", "finite convergence"} & {item.name for item in report.consequences}
    assert {item.verdict for item in report.consequences if item.name == "convergence"} == {"unknown"}


def test_the_judge_and_other_units_know_it(own_cache):
    assert {cell.verdict for cell in stress(swing(), steps=3).cells} == {"right"}
    run, other = simulate(swing(t_end=3)), simulate(in_units(swing(t_end=3).bind(), 1e3, 10.0))
    assert other.x / 1e3 == pytest.approx(run.x, abs=1e-9)


def test_time_stands_in_the_force_alone():
    with pytest.raises(ModelError, match=r"potential depends on 't'.*force= and friction=, and there alone"):
        FrictionOscillator(x=x, potential=t * x**2, t=t, x0=1, t_end=1)
    with pytest.raises(ModelError, match="force depends on 'x'"):
        swing(force=x)
    with pytest.raises(ModelError, match="force: shape"):
        swing(force=[1, 2])
