"""Stretches by time stepping: where no mode goes on, steps take over, and pieces come back; both visible."""

import math
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from nsmodel import FrictionOscillator, LureSystem, StepError, SweepingProcess, Trajectory, complementarity, relay, simulate
from nsmodel.event_driven import fallback_steps
from nsmodel.simulation import loop
from nsmodel.simulation.event_driven import event_driven_problem
from nsmodel.simulation.simulate import explain
from tests import event_scenes as scenes

x, t, s, q = ca.SX.sym("x"), ca.SX.sym("t"), ca.SX.sym("s"), ca.SX.sym("q")


def fallen(end=5.0):
    """A mass falls from 1 to a floor at t = sqrt 2, and is lifted with acceleration 1 from t = 3 on."""
    lift = 2 * ca.if_else(t > 3, 1, 0)
    return LureSystem(
        t=t, A=[[0, 1], [0, 0]], B=[0, 1], C=[[1, 0]], f=[0, -1 + lift], law=complementarity(1), x0=[1, 0], t_end=end,
        switch_times=[3],
    )  # fmt: skip


def of_fallen(at):
    high = np.where(at < math.sqrt(2), 1 - at**2 / 2, np.where(at < 3, 0, (at - 3) ** 2 / 2))
    return np.stack([high, np.where(at < math.sqrt(2), -at, np.where(at < 3, 0, at - 3))], axis=1)


def beside(rate=4.0):
    """The same mass, and an oscillator that does not feel it: all of it is stepped while the mass rests."""
    return LureSystem(
        A=[[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, -rate, 0]], B=[0, 1, 0, 0], C=[[1, 0, 0, 0]], f=[0, -1, 0, 0],
        law=complementarity(1), x0=[1, 0, 1, 0], t_end=4,
    )  # fmt: skip


def about(run):
    return run.metadata["totals"]["stretches"]


def told(run, text):
    return any(text in warning for warning in run.metadata["warnings"])


@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-6, 1e-9])
def test_an_impact_a_rest_and_a_return(rtol):
    run = simulate(fallen(), rtol=rtol)
    assert run.is_event_driven
    assert not run.stepped[run.t <= 1.414].any()
    assert run.stepped[(run.t > 1.5) & (run.t < 3)].all()
    assert not run.stepped[-1]
    away = np.abs(run.t - math.sqrt(2)) > 1e-6  # the impact takes a few steps
    error = np.abs(run.x - of_fallen(run.t))[away].max() / 2
    assert error <= rtol * max(10, sum(one["estimate"] for one in about(run)))
    assert told(run, "no mode of l_0 is valid")
    assert len(about(run)) <= 17


def test_alone_it_refuses():
    with pytest.raises(StepError, match="no mode of l_0 is valid") as failed:
        simulate(fallen(), rtol=1e-6, method="event-driven")
    assert failed.value.trajectory.t[-1] == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
def test_a_stretch_errs_by_no_more_than_it_says(rtol):
    """The oscillator beside is cos 2t; it is stepped from t = sqrt 2 to the end."""
    run = simulate(beside(), rtol=rtol)
    error = np.abs(run.x[-1, 2:] - [math.cos(8), -2 * math.sin(8)]) / [1, 2]
    estimate = sum(one["estimate"] for one in about(run))
    assert error.max() <= 10 * rtol * max(1, estimate)
    assert told(run, "rtol is missed") == (estimate > 1)


def test_the_budget_holds_and_a_miss_is_told(monkeypatch):
    """With less budget the same stretch errs by more, says so, and ends."""
    monkeypatch.setattr(fallback_steps, "STRICT", 200)
    monkeypatch.setattr(fallback_steps, "TENFOLD", 50)
    monkeypatch.setattr(fallback_steps, "STEP_BUDGET", 1000)
    run = simulate(beside(), rtol=1e-8)
    assert sum(one["steps"] for one in about(run)) <= 1000
    estimate = sum(one["estimate"] for one in about(run))
    assert estimate > 1
    assert told(run, "rtol is missed")
    error = np.abs(run.x[-1, 2:] - [math.cos(8), -2 * math.sin(8)]) / [1, 2]
    assert 1e-8 < error.max() <= 10e-8 * estimate


def test_twisting_comes_to_rest_for_good():
    run = simulate(scenes.twisting(), rtol=1e-8, t_end=30)
    assert (run.at([5.0, 12.0, 30.0]).x == 0).all()


@pytest.mark.parametrize("mild", [False, True])
def test_not_unique(mild):
    """x' in +Sgn x (+ sin t / 10): steps take one of the solutions, and it is one: |x'| <= 1 + ..., x = 0 or |x'| = 1."""
    push = 0.1 * ca.sin(t) if mild else 0
    model = LureSystem(t=t, A=[[0]], B=[[-1]], C=[[1]], f=[push], law=relay(1), x0=[0], t_end=2)
    run = simulate(model, rtol=1e-6)
    assert told(run, "not unique")
    assert "not unique" in about(run)[0]["why"]
    here = np.array([0.1 * np.sin(run.t) if mild else 0 * run.t]).T
    rate = np.diff(run.x, axis=0) / np.diff(run.t)[:, None] - here[1:]
    still = np.abs(run.x[1:]) < 1e-9
    assert np.abs(np.abs(rate[~still]) - 1).max(initial=0) < 1e-6
    assert (np.abs(rate[still]) < 1 + 1e-9).all()


def test_oscillators_hit_their_walls():
    """x'' = -x against x >= -1/2 with friction 0.15: the wall takes the velocity, then stick at 0.1 by arcs."""
    model = FrictionOscillator(
        x=x, potential=x**2 / 2, friction=0.15 * s, s=s, constraints={"floor": x + 0.5}, x0=2, v0=0, t_end=10
    )
    run = simulate(model, rtol=1e-6)
    assert run.x[-1, 0] == pytest.approx(0.1, abs=1e-6)  # from -0.5 about -0.15 to 0.2, then about 0.15 to 0.1
    assert run.v[-1, 0] == 0
    assert len(about(run)) == 1


def test_sweeping_processes_keep_their_impulses():
    """A wall q <= 1 - t^2 / 4 on a second-order free body is none of theirs; here the sum of multipliers is that of pieces."""
    model = SweepingProcess(t=t, q=q, f=[ca.cos(t)], constraints={"wall": 0.5 - q}, q0=[0], t_end=3)
    run = simulate(model, rtol=1e-8)
    assert not run.stepped.any()
    assert about(run) == []


def test_what_is_seen(tmp_path):
    run = simulate(fallen(), rtol=1e-4, times=np.linspace(0, 5, 51))
    found = run.summary()
    assert found["stretches"] == about(run)
    assert "where no piece went on" in run.summary_text()
    assert run.arrays["piece_stepped"].any()
    lines = run.arrays["piece_x"][run.arrays["piece_stepped"]]
    assert not lines[:, :, 3:].any()
    whole = [piece for piece in lines if piece[:, 2].any()]
    assert 0 < len(whole) < len(lines)  # parabolas where nothing switches
    begins = [event.t for event in run.events]
    assert all(any(abs(one["start"] - time) < 1e-12 for time in begins) for one in about(run))
    run.save(tmp_path / "run.npz")
    again = Trajectory.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(again.at([1.0, 2.0, 4.5]).x, run.at([1.0, 2.0, 4.5]).x)
    run.to_csv(tmp_path / "run.csv")
    assert "stepped" in (tmp_path / "run.csv").read_text().splitlines()[0]
    run.plot()


def test_explain_says_what_would_happen():
    assert "where no mode goes on: steps of backward Euler" in explain(fallen(), rtol=1e-6)
    assert "backward Euler" not in explain(fallen(), rtol=1e-6, method="event-driven")


# -- files -------------------------------------------------------------------------------------------------------------

KILLED = """
import os, sys
sys.path[:0] = sys.argv[1].split(os.pathsep)
from tests.event_driven.test_stretches import MODELS
from nsmodel import simulate
from nsmodel.event_driven.fallback_steps import HybridIntegrator
from nsmodel.simulation import loop

loop.CHUNK_SECONDS = 0.0
name, out, pieces, more = sys.argv[2:]
whole, left = HybridIntegrator.advance, [int(pieces)]

def advance(self):
    if not left[0]:
        os._exit(9)
    left[0] -= 1
    return whole(self)

HybridIntegrator.advance = advance
simulate(MODELS[name](), rtol=1e-4, out=out, resume=more == "more")
"""
MODELS = {"fallen": fallen, "beside": lambda: beside(0.25)}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.long
def test_a_later_end_gives_the_bytes_of_one_run(name, tmp_path):
    model = MODELS[name]()
    whole = simulate(model, rtol=1e-4, out=tmp_path / "one")
    inside = about(whole)[-1]
    ends = [0.7, 1.4142135640, (inside["start"] + inside["until"]) / 2, 0.9 * model.t_end, None]
    for i, end in enumerate(ends):
        part = simulate(model, rtol=1e-4, out=tmp_path / "parts", t_end=end, resume=i > 0)
        assert part.t[-1] == (end or model.t_end)
    assert (tmp_path / "one" / "trajectory.npz").read_bytes() == (tmp_path / "parts" / "trajectory.npz").read_bytes()


@pytest.mark.parametrize("name", ["fallen", pytest.param("beside", marks=pytest.mark.long)])
@pytest.mark.long
def test_killed_in_a_stretch_it_goes_on_to_the_same_bytes(name, tmp_path):
    whole = simulate(MODELS[name](), rtol=1e-4, out=tmp_path / "one")
    first = int(np.flatnonzero(whole.stepped)[0])
    more = "new"
    steps = int(whole.arrays["piece_stepped"].sum()) // 2
    for part in (first + 2, 5, steps // 2):
        killed = [sys.executable, "-c", KILLED, ":".join(sys.path), name, str(tmp_path / "parts"), str(part), more]
        assert subprocess.run(killed, check=False, capture_output=True).returncode == 9
        more = "more"
    simulate(MODELS[name](), rtol=1e-4, out=tmp_path / "parts", resume=True)
    assert (tmp_path / "one" / "trajectory.npz").read_bytes() == (tmp_path / "parts" / "trajectory.npz").read_bytes()


def test_chunks_are_those_of_one_run(tmp_path, monkeypatch):
    simulate(fallen(), rtol=1e-4, out=tmp_path / "one")
    monkeypatch.setattr(loop, "CHUNK_SECONDS", 0.0)
    simulate(fallen(), rtol=1e-4, out=tmp_path / "parts")
    assert (tmp_path / "one" / "trajectory.npz").read_bytes() == (tmp_path / "parts" / "trajectory.npz").read_bytes()


def test_its_step_is_backward_euler():
    """One step of x' = -x by hand."""
    model = LureSystem(A=[[-1]], B=[[0]], C=[[1]], law=relay(1), x0=[1], t_end=1)
    p = fallback_steps.backward_euler(event_driven_problem(model))
    E = ca.Function("E", [p.t, p.h, p.state, p.z, p.l], [p.E])
    assert float(E(0, 0.1, 1, 1 / 1.1, 0)) == pytest.approx(0, abs=1e-15)


def falling(n, **options):
    """A point that falls onto the wall 1 + n'x >= 0 and slides there: its exact places, and the run's model."""
    n = np.array(n) / np.linalg.norm(n)
    A, B, C = np.zeros((4, 4)), np.zeros((4, 1)), np.zeros((1, 4))
    A[:2, 2:], B[2:, 0], C[0, :2] = np.eye(2), n, n
    g, v0 = np.array([0.3, -1.0]), np.array([0.2, 0.0])
    model = LureSystem(
        names=["x1", "x2", "v1", "v2"], A=A, B=B, C=C, D=0, e=[1.0], f=[0, 0, *g], law=complementarity(1), x0=[0, 0, *v0],
        t_end=3, step=1e-2, theta=1, **options,
    )  # fmt: skip
    hits = min(t.real for t in np.roots([g @ n / 2, v0 @ n, 1]) if abs(t.imag) < 1e-12 and t.real > 0)

    def exact(t):
        free, after = np.minimum(t, hits)[:, None], np.maximum(t - hits, 0)[:, None]
        v = v0 + g * hits
        return v0 * free + g * free**2 / 2 + (v - n * (n @ v)) * after + (g - n * (n @ g)) * after**2 / 2

    return model, exact


@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-8])
@pytest.mark.parametrize("method", ["auto", "time-stepping"])
@pytest.mark.parametrize("n", [(0, 1), (0.6, 0.8), (1, 2), (-3, 1)])
def test_impacts_at_walls_of_any_direction_are_run_through(n, method, rtol):
    model, exact = falling(n)
    run = simulate(model, rtol=rtol, method=method, compiled=method == "time-stepping")
    error = np.abs(run.x[:, :2] - exact(run.t)).max() / np.abs(run.x[:, :2]).max()
    assert error <= 10 * max(rtol, 5e-7 if method == "auto" else rtol)
    assert len(run) < 200_000


def test_rows_in_the_middle_of_steps_are_as_good_as_others():
    model, exact = falling((0, 1))
    run = simulate(model, rtol=1e-6, compiled=False)
    assert run.stepped.sum() > 20
    np.testing.assert_allclose(run.x[:, 0], exact(run.t)[:, 0], atol=1e-6)
    times = np.linspace(0, 3, 1001)
    np.testing.assert_allclose(run.at(times).x[:, :2], exact(times), atol=1e-5)
