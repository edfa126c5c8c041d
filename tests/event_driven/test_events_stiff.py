"""Stiff modes: few pieces, errors within rtol, events at the end of a piece; and modes that are not stiff do not notice."""

import math

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT
from scipy.integrate import solve_ivp
from scipy.special import roots_jacobi

from nsmodel import FirstOrderSystem, SweepingProcess, relay, simulate
from nsmodel.event_driven.collocation import radau_collocation
from tests import event_scenes, stiff_scenes
from tests.event_driven.test_events import DATA, HAS_CC, RTOLS, judged, needs_data

MANY = COUNT
t = ca.SX.sym("t")


@pytest.fixture(
    params=[False, pytest.param(True, marks=pytest.mark.skipif(not HAS_CC, reason="no C compiler"))], ids=["interpreted", "in C"]
)
def compiled(request):
    return request.param


def collocated(run):
    return run.metadata["totals"]["collocated"]


@pytest.mark.parametrize("s", [1, 3, 5, 7, 9, 11])
def test_order_conditions(s):
    """B(2s - 1), C(s) and D(s - 1) of Butcher's simplifying assumptions, and the nodes of SciPy."""
    of = radau_collocation(s)
    A, c = np.linalg.inv(of.inverse), of.nodes
    b = A[-1]
    np.testing.assert_allclose(c[:-1], (1 + roots_jacobi(s - 1, 1, 0)[0]) / 2 if s > 1 else [], rtol=1e-13)
    for k in range(1, 2 * s):
        assert abs(b @ c ** (k - 1) - 1 / k) <= 1e-14
    for k in range(1, s + 1):
        np.testing.assert_allclose(A @ c ** (k - 1), c**k / k, atol=1e-13)
    for k in range(1, s):
        np.testing.assert_allclose((b * c ** (k - 1)) @ A, b * (1 - c**k) / k, atol=1e-13)


@pytest.mark.parametrize("s", [5, 7, 9, 11])
def test_tables_of_polynomials(s):
    """Values, slopes and coefficients of polynomials of degree s; the eigenvectors; the integral of M."""
    of, rng = radau_collocation(s), np.random.default_rng(s)
    p = np.polynomial.Polynomial(rng.normal(size=s + 1))
    start, values = p(0), p(of.nodes)[:, None]
    np.testing.assert_allclose(start + of.values @ (values[:, 0] - start), p(of.between), atol=1e-12)
    np.testing.assert_allclose(of.slopes @ (values[:, 0] - start), p.deriv()(of.between), atol=1e-10)
    np.testing.assert_allclose(of.inverse @ (values[:, 0] - start), p.deriv()(of.nodes), atol=1e-10)
    grid = np.linspace(0, 1, 101)
    found = of.coefficients(values, np.array([start]))[0]
    np.testing.assert_allclose(np.polynomial.polynomial.polyval(grid, found), p(grid), atol=1e-13)
    assert (of.coefficients(np.full((s, 1), 0.1), np.array([0.1]))[0, 1:] == 0).all()
    scale = np.abs(of.inverse).max()
    np.testing.assert_allclose((of.right * of.rates @ of.left).real, of.inverse, atol=1e-10 * scale)
    M = np.polynomial.Polynomial.fromroots(of.nodes)
    fine = np.linspace(0, 1, 20_001)
    assert of.share == pytest.approx(np.abs(M.integ()(fine)).max() / abs(M(0)), rel=1e-6)
    products = np.abs(of.between[:, None] - of.nodes).prod(axis=1)
    np.testing.assert_allclose(of.weights, products[0] / products, rtol=1e-12)


@needs_data
@pytest.mark.parametrize("rtol", [1e-1, *RTOLS])
@pytest.mark.parametrize(("name", "mu"), [("stiff_relay_3", 1e3), ("stiff_relay_5", 1e5)])
def test_relay_through_an_actuator_against_113_bits(name, mu, rtol, compiled):
    reference = np.load(DATA / f"{name}_ref.npz")
    run = judged(event_scenes.stiff_relay(mu), rtol, np.linspace(0, 20, 241), reference["rows"], reference["events"], compiled)
    assert run.metadata["totals"]["pieces"] <= 300
    assert collocated(run) >= 20


def against(model, exact, rtols, t_end, compiled):
    at = np.linspace(0, t_end, 241)
    rows = exact.at(at)[:, : len(model.names)]
    runs = [judged(model, rtol, at, rows, exact.events, compiled) for rtol in rtols]
    assert all(run.metadata["totals"]["pieces"] <= 60 * (len(exact.events) + 2) for run in runs)
    return min(map(collocated, runs))


@pytest.mark.parametrize("seed", range(15 if MANY >= 400 else 5))
def test_random_passive_systems(seed, compiled):
    """Rates from 1 to 1e6 in all directions; relays that slide, complementarity, one and two rows."""
    fastest = (1.0, 3.0, 4.5, 6.0)[seed // 5 % 4]
    model, exact = stiff_scenes.stiff_lure(seed, fastest)
    against(model, exact(), [RTOLS[seed % 5]], 4, compiled)


def test_rectifier_with_stray_capacitance(compiled):
    """Rates of 5e5 and 2e7 1/s in turns."""
    model, exact = stiff_scenes.rectifier(1e-6)
    assert against(model, exact(), RTOLS, 1, compiled) >= 50


def test_chain_with_stiff_dashpots(compiled):
    model, exact = stiff_scenes.damped_chain(1e3)
    assert against(model, exact(), RTOLS, 12, compiled) >= 5


def test_reactions_with_a_feed(compiled):
    """Robertson's reactions: the relay is held, index 2, from the event on."""
    at = np.linspace(0, 100, 241)
    rows, events = stiff_scenes.kinetics_reference(at)
    for rtol in RTOLS:
        run = judged(stiff_scenes.kinetics(), rtol, at, rows, events, compiled)
        assert collocated(run) >= 10
        assert np.abs(run.x[at > 50, 0] - 0.7).max() <= 1e-14


@pytest.mark.parametrize("rtol", RTOLS)
def test_relaxation_oscillator_with_dry_friction(rtol, compiled):
    """Events and states by SciPy's Radau at 1e-12; the velocity's largest value, where it is judged beside, is about 1300."""
    model, at = stiff_scenes.van_der_pol(), np.array([0.0, *stiff_scenes.VAN_DER_POL])
    run = simulate(model, rtol=rtol, times=[*at[1:], 3000], method="event-driven", compiled=compiled)
    events = [event.t for event in run.events]
    assert len(events) == len(stiff_scenes.VAN_DER_POL_EVENTS)
    np.testing.assert_allclose(events, stiff_scenes.VAN_DER_POL_EVENTS, atol=10 * rtol * 3000)
    np.testing.assert_allclose(run.at(at[1:]).x, list(stiff_scenes.VAN_DER_POL.values()), atol=10 * rtol * 2)
    assert collocated(run) >= 20


@pytest.mark.parametrize("rtol", RTOLS)
@pytest.mark.parametrize("rate", [1e3, 1e5])
def test_held_on_a_circle(rtol, rate, compiled):
    """Rows of index 2 with h_x that turns: a point is drawn along a wall that is round; its angle by SciPy's Radau."""
    q, at = ca.SX.sym("q", 2), np.linspace(0, 5, 101)
    model = SweepingProcess(
        t=t, q=q, f=rate * (2 * ca.vertcat(ca.cos(t), ca.sin(t)) - q), constraints={"disc": 1 - ca.sumsqr(q)}, q0=[1, 0], t_end=5
    )
    angle = solve_ivp(
        lambda s, p: 2 * rate * np.sin(s - p), (0, 5), [0], "Radau", rtol=1e-12, atol=1e-14, t_eval=at,
        jac=lambda s, p: [[-2 * rate * math.cos(s - p[0])]],
    ).y[0]  # fmt: skip
    run = simulate(model, rtol=rtol, times=at, method="event-driven", compiled=compiled)
    assert np.abs(run.x - np.stack([np.cos(angle), np.sin(angle)], axis=1)).max() <= rtol
    assert collocated(run) >= 20
    assert run.metadata["totals"]["pieces"] <= 200


@pytest.mark.parametrize("rtol", RTOLS)
@pytest.mark.parametrize("rate", [1e4, 1e6])
def test_branches_of_a_stiff_mode(rtol, rate, compiled):
    """x' = -k (x - |sin t|): on a piece |sin| stays on its side beyond the kink; arcs by hand."""
    x, at = ca.SX.sym("x"), np.linspace(0, 10, 201)
    model = FirstOrderSystem(t=t, x=x, f=[-rate * (x - ca.fabs(ca.sin(t)))], x0=[0], t_end=10)

    def slow(s):
        return rate * (rate * np.sin(s) - np.cos(s)) / (rate**2 + 1)

    turns, start = np.floor(at / np.pi), np.where(at < np.pi, 0.0, slow(np.pi))  # exp(-rate pi) is nothing
    exact = slow(at - turns * np.pi) + (start - slow(0.0)) * np.exp(-rate * (at - turns * np.pi))
    run = simulate(model, rtol=rtol, times=at, method="event-driven", compiled=compiled)
    assert np.abs(run.x[:, 0] - exact).max() <= rtol
    np.testing.assert_allclose([event.t for event in run.events], np.pi * np.arange(1, 4), rtol=1e-13)
    assert collocated(run) >= 20


def test_a_start_off_the_slow_motion(compiled):
    """A layer of 1e-4 is there in the rows, to the tolerance: x' = -1e4 (x - cos t)."""
    x, k = ca.SX.sym("x"), 1e4
    model = FirstOrderSystem(t=t, x=x, f=[-k * (x - ca.cos(t))], x0=[3], t_end=4)
    at = np.concatenate([[0], np.geomspace(1e-7, 4, 400)])
    slow = lambda s: k * (k * np.cos(s) + np.sin(s)) / (k**2 + 1)  # noqa: E731
    exact = slow(at) + (3 - slow(0)) * np.exp(-k * at)
    for rtol in RTOLS:
        run = simulate(model, rtol=rtol, times=at, method="event-driven", compiled=compiled)
        assert np.abs(run.x[:, 0] - exact).max() <= rtol
        assert collocated(run)


def test_pieces_do_not_depend_on_the_end_and_go_on(tmp_path, compiled):
    model = event_scenes.stiff_relay(1e4)
    long, short = simulate(model, rtol=1e-6, compiled=compiled), simulate(model, rtol=1e-6, compiled=compiled, t_end=7)
    k = len(short.arrays["piece_start"])
    for name in ("piece_start", "piece_unit", "piece_x"):
        np.testing.assert_array_equal(short.arrays[name], long.arrays[name][:k])
    simulate(model, rtol=1e-6, compiled=compiled, t_end=7, out=tmp_path / "run")
    again = simulate(model, rtol=1e-6, compiled=compiled, out=tmp_path / "run", resume=True)
    for name in ("piece_start", "piece_unit", "piece_x", "piece_multipliers", "piece_y"):
        np.testing.assert_array_equal(again.arrays[name], long.arrays[name])
    assert collocated(again) == collocated(long) > 0


def test_what_is_proved_of_them_is_true(compiled):
    """The defect of a stiff piece is many times its error: pieces that are not proved are told, and a bound is one."""
    k = 1e4
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    model = FirstOrderSystem(t=t, x=x, lam=l, f=[-k * (x - ca.cos(t))], g=[l], h=[x], law=relay(1), x0=[1], t_end=1)
    run = simulate(model, rtol=1e-6, certify="interval", compiled=compiled)
    about = run.summary()["certificate"]
    assert collocated(run)
    slow = lambda s: k * (k * np.cos(s) + np.sin(s)) / (k**2 + 1) - 1 / k  # noqa: E731
    exact = slow(run.t) + (1 - slow(0)) * np.exp(-k * run.t)
    assert (np.abs(run.x[:, 0] - exact) <= run.error_bound[:, 0] + 1e-15).all()
    assert about["proved"] + len(np.flatnonzero(~run.arrays["piece_proved"])) == about["pieces"]


def test_it_is_told():
    run = simulate(event_scenes.stiff_relay(1e3), rtol=1e-4)
    assert run.summary()["event_driven"]["collocated"] == collocated(run) > 0
    assert any("Radau IIA" in line for line in run.metadata["used"])


def test_the_finest_rtol(compiled):
    """Eleven stages: polynomials of a higher degree than discs have elsewhere."""
    k, x = 1e5, ca.SX.sym("x")
    model = FirstOrderSystem(t=t, x=x, f=[-k * (x - ca.cos(t))], x0=[0], t_end=3, step=1e-2)
    exact = k * (k * math.cos(3) + math.sin(3)) / (k**2 + 1)
    for rtol in (1e-12, 1e-14):
        run = simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
        assert collocated(run)
        assert run.x[-1, 0] == pytest.approx(exact, rel=max(rtol, 1e-15))
