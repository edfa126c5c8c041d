"""Orders of convergence of every scheme, against closed forms, each in a band on both sides and above round-off.

The order is the slope of the least-squares line through (log2 h, log2 error). Where the error's constant depends on chance (on
where an event falls in its step) and stays within a factor 2^(2c) from grid to grid, the slope of m points with distances
x_i = log2 h_i - mean is wrong by at most c sum|x_i| / sum x_i^2: that is the band, named where it is wider than 0.1.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import casadi as ca
import closed_forms as exact
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    MechanicalSystem,
    SweepingProcess,
    complementarity,
    simulate,
)
from nsmodel.modeling.parts import MODEL_CLASSES

GRIDS = (50, 100, 200, 400, 800, 1600)


def order(h, errors):
    """Return the slope of log(error) over log(h)."""
    assert np.min(errors) > 1e-13, "below round-off there is no order"
    return np.polyfit(np.log(h), np.log(errors), 1)[0]


def chance(grids, factor):
    """Return how far the slope can be wrong if the constants differ by ``factor`` at most (see the module's docstring)."""
    x = np.log2(grids) - np.log2(grids).mean()
    return np.log2(factor) / 2 * np.abs(x).sum() / (x**2).sum()


def sup(run, closed):
    """Return the largest error of a state at a grid point; ``closed`` (N+1, n)."""
    return np.abs(run.x - closed).max()


@pytest.fixture(scope="module")
def runs_of(load_case):
    """Return runs_of(stem, t_end, grids, parameters) -> the runs of a case on grids of so many steps, each made once."""

    @cache
    def runs(stem, t_end, grids, parameters):
        model = load_case(stem, **dict(parameters))
        made = [simulate(model, step=t_end / n, t_end=t_end) for n in grids]
        assert [len(run) for run in made] == list(grids)
        return made

    return lambda stem, t_end, grids=GRIDS, parameters=(): runs(stem, t_end, grids, parameters)


# ---------------------------------------------------------------------------------------------- the orders of all schemes

FULL = {
    "K": np.array([[2.0, -1.0, -0.5], [-1.0, 2.0, -1.0], [-0.5, -1.0, 2.0]]),
    "b": np.array([4.0, -0.3, 0.5]),
    "mu": np.array([0.5, 1.0, 0.5]),
    "lower": -1.0,
    "upper": 1.5,
}
DIAGONAL = {"K": np.array([1.0, 2.0, 4.0]), "b": np.array([3.0, 0.5, -4.0]), "mu": np.ones(3), "lower": -2.0, "upper": 1.5}


@dataclass(frozen=True)
class Observed:
    """An order seen on a case: its parameters, closed form, end and grids (numbers of steps), and half the band's width."""

    stem: str
    closed: object
    t_end: float
    order: float = 1.0
    band: float = 0.1
    grids: tuple[int, ...] = GRIDS
    parameters: tuple[tuple[str, float], ...] = ()


# Where a state of 8.2 sticks, the scheme (explicit in the friction) jumps over 0 by a part of its step that is chance.
STICKS = chance(GRIDS, 2)

ORDERS = [
    Observed("moving_half_line", exact.half_line, 3),
    Observed("point_past_disc", exact.point_past_disc, 4.5),
    Observed("moving_disc", exact.moving_disc, 4),
    Observed("friction_oscillator", lambda t: exact.friction_free(t, 5.3)[:, :1], 12, grids=(3000, 6000, 12000, 24000, 48000)),
    Observed("sliding_relay", exact.sliding_relay, 5, grids=(250, 500, 1000, 2000, 4000)),
    # Up to its highest point, at t = 5/G, the ball meets no event.
    Observed("zhuravlev_ivanov", exact.zhuravlev_ivanov, 0.5),
    Observed("inclusion_8_1", exact.inclusion_8_1, 2),
    Observed("inclusion_8_1", lambda t: exact.inclusion_8_1(t, 0, -1, 1), 2, parameters=(("a", 0), ("x0", 1))),
    Observed("inclusion_8_1", lambda t: exact.inclusion_8_1(t, 1, 1, 0), 2, parameters=(("b", 1), ("x0", 0))),
    Observed("inclusion_8_2", lambda t: exact.inclusion_8_2_diagonal(t, **DIAGONAL, x0=[-1, 1.5, 1]), 4, band=STICKS),
    Observed("inclusion_8_2_full", lambda t: exact.inclusion_8_2_reference(t, **FULL, x0=[-1, 0.5, -0.5]), 6, band=STICKS),
]


@pytest.mark.parametrize("seen", ORDERS, ids=lambda seen: "-".join([seen.stem, *(f"{k}={v}" for k, v in seen.parameters)]))
def test_observed_order(seen, runs_of):
    runs = runs_of(seen.stem, seen.t_end, seen.grids, seen.parameters)
    errors = [sup(run, seen.closed(run.t)) for run in runs]
    assert abs(order(seen.t_end / np.array(seen.grids), errors) - seen.order) <= seen.band


def test_every_scheme_has_an_observed_order(load_case):
    without = {
        ManyBodies,
        MechanicalSystem,
    }  # the scheme of SweepingProcess; one whose velocities jump, in `test_mechanical_scenes`
    assert {type(load_case(seen.stem)) for seen in ORDERS} == {getattr(nsmodel, name) for name in MODEL_CLASSES} - without


# ---------------------------------------------------------------------------------------------- sweeping processes


def test_half_plane_is_exact_in_contact_and_second_order_where_it_lets_go():
    """f has no normal part: in contact x = sin 2t at grid points; the wall's last advance is missed by sup|x''| h^2/2 at most."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    model = SweepingProcess(t=t, q=q, f=[0, 1], constraints={"wall": q[0] - ca.sin(2 * t)}, q0=[0, 0], t_end=2, step=0.1)
    for n in GRIDS:
        run = simulate(model, step=2 / n)
        error = np.abs(run.q - exact.half_plane(run.t)).max(axis=1)
        assert error[run.t <= np.pi / 4].max() <= 1e-13
        assert error.max() <= 2 * (2 / n) ** 2


@pytest.mark.parametrize(
    ("stem", "closed", "t_end", "contact"),
    [
        ("moving_half_line", exact.half_line_multiplier, 3, None),
        # Where a disc is met the reaction jumps, and the step of the contact has a part of it that is chance.
        ("point_past_disc", exact.point_past_disc_multiplier, 4.5, (0.5460607985830543, 2.419881041110468)),
        ("moving_disc", exact.moving_disc_multiplier, 4, (0.5460607985830543, 2.419881041110468)),
    ],
)
def test_reactions_converge_with_order_one(stem, closed, t_end, contact, runs_of):
    errors = []
    for run in runs_of(stem, t_end):
        inside = run.t > 0 if contact is None else (run.t > contact[0] + 0.2) & (run.t < contact[1] - 0.2)
        errors.append(np.abs(run.reactions[inside, 0] - closed(run.t[inside])).max())
    assert abs(order(t_end / np.array(GRIDS), errors) - 1) <= 0.1


@pytest.mark.parametrize("n", [*GRIDS, 60, 137])
def test_two_discs_are_exact(n, load_case):
    """Positions, and reactions as means of the closed form over each step, also where the contact falls inside a step."""
    run = simulate(load_case("two_discs"), step=2.5 / n)
    assert sup(run, exact.two_discs(run.t)) <= 1e-12
    in_contact = np.clip((run.t[1:] - 1.0) / run.step[1:], 0, 1)  # the discs touch at t = 1
    assert run.reactions[1:, 0] == pytest.approx(exact.two_discs_multiplier(2.0) * in_contact, abs=1e-11)


# ---------------------------------------------------------------------------------------------- dry friction

STARTS = [  # x0, v0, w, a, zeta
    (5.3, 0.0, 1.0, 1.0, 0.0),
    (-7.7, 2.0, 1.0, 1.0, 0.0),
    (3.4, -3.0, 2.0, 1.5, 0.0),
    (5.3, 0.0, 1.0, 1.0, 0.05),
    (6.1, -2.0, 1.5, 1.0, 0.2),
    (-8.2, 0.0, 1.0, 0.5, 0.1),
]


@pytest.mark.parametrize("start", STARTS, ids=str)
def test_friction_oscillator_converges_with_its_stopping_point(start):
    x0, v0, w, a, zeta = start
    stop, rest = exact.friction_stop(*start)
    swings = np.ceil(stop * w * np.sqrt(1 - zeta**2) / np.pi)
    x, s, T = ca.SX.sym("x"), ca.SX.sym("s"), np.ceil(stop + 1)
    model = FrictionOscillator(
        x=x, potential=w**2 * x**2 / 2, friction=a * s, s=s, damping=[[2 * zeta * w]] if zeta else None, x0=x0, v0=v0, t_end=T
    )
    steps, states, stops = [4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4], [], []
    for h in steps:
        run = simulate(model, step=h)
        states.append(np.abs(np.column_stack([run.x, run.v]) - exact.friction_free(run.t, *start)).max(axis=0))
        stops.append(abs(run.x[-1, 0] - rest))
        assert run.v[-1, 0] == 0.0
        assert abs(run.metadata["convergence"]["t_0"] - stop) <= (swings + 1) * h  # one step for each turn, and the last
    position, velocity = np.transpose(states)
    assert abs(order(steps, position) - 1) <= 0.1
    assert abs(order(steps, velocity) - 1) <= 0.1
    assert abs(order(steps, stops) - 1) <= 0.1


# ---------------------------------------------------------------------------------------------- relays


def test_sliding_relay_multiplier_has_order_one(load_case):
    """Before the line is reached l = -1 exactly; on it l is inside (-1, 1) and converges as the states do."""
    reach, steps, errors = exact.sliding_relay_reach(), [2e-2, 1e-2, 5e-3, 2.5e-3, 1.25e-3], []
    for h in steps:
        run = simulate(load_case("sliding_relay"), step=h)
        before, sliding = (run.t > 0) & (run.t < reach - 2 * h), run.t > reach + 0.1
        assert (run.multipliers[before] == -1).all()
        assert (np.abs(run.multipliers[sliding]) < 1).all()
        assert (run.y[sliding] == 0).all()
        assert (run.index_set[sliding] == 0).all()
        errors.append(np.abs(run.multipliers[sliding, 0] - exact.sliding_relay_multiplier(run.t[sliding])).max())
    assert abs(order(steps, errors) - 1) <= 0.1


def test_bouncing_ball_converges_with_order_one_through_its_impacts(load_case):
    """The error of the height lies between 2.5 h and 7 h, so that the slope is within 0.45 of 1: 1/2 and 3/2 are excluded.

    Implicit Euler's height lags by G t h/2: 2.5 h at the apex, t = 5/G, for certain. At the apex up to G h of velocity is lost to
    the step that ends at rest, and the fall of 0.68 s then adds between -3.3 h and 3.3 h: at most 5.8 h at the impact, at 6.7 m/s
    0.9 h in time; with the step in which the impact falls, 1.9 h, which the flight that follows, at 2.2 m/s, shows as 4.2 h,
    and its own lag is 2.2 h.
    """
    steps = np.array([4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4])
    runs = [simulate(load_case("zhuravlev_ivanov"), step=h, t_end=2) for h in steps]
    errors = np.array([np.abs(run.x[:, 0] - exact.zhuravlev_ivanov(run.t)[:, 0]).max() for run in runs])
    assert (errors >= 2.4 * steps).all()
    assert (errors <= 7 * steps).all()
    assert abs(order(steps, errors) - 1) <= chance(steps, 2.8) < 0.5
    for run in runs:  # at rest after all impacts
        late = run.t > exact.ball_rest()[2] + 20 * run.step[1]
        assert np.abs(run.x[late, 0]).max() <= 1e-9


# ---------------------------------------------------------------------------------------------- theta and gamma


def pendulum(theta):
    """Return a forced pendulum with a mass matrix and no law, and its state at t = 2 to 1e-12."""
    t, z = ca.SX.sym("t"), ca.SX.sym("z", 2)
    M, force = np.array([[2.0, 0.5], [0.5, 3.0]]), lambda t, z, sin: [z[1] + sin(3 * t), -4 * sin(z[0])]
    model = FirstOrderSystem(t=t, x=z, M=M, f=force(t, z, ca.sin), x0=[1, 0.5], t_end=2, theta=theta)
    rate = lambda t, z: np.linalg.solve(M, force(t, z, np.sin))  # noqa: E731
    return model, solve_ivp(rate, (0, 2), [1, 0.5], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.mark.parametrize(("theta", "expected"), [(0.0, 1), (0.5, 2), (1.0, 1)])
def test_order_of_the_theta_scheme_without_a_law(theta, expected):
    model, end = pendulum(theta)
    grids = np.array([80, 160, 320, 640])
    errors = [np.abs(simulate(model, step=2 / n).x[-1] - end).max() for n in grids]
    assert abs(order(2 / grids, errors) - expected) <= 0.1


def rlc(theta, gamma, as_first_order):
    """Return the circuit with one diode on (0, 1e-4), where the diode conducts: l = v/R, so that the system is linear."""
    L, C, R = 1e-2, 1e-6, 1e3
    A, B = np.array([[0, -1 / C], [1 / L, 0]]), np.array([-1 / C, 0])
    common = {"law": complementarity(1), "x0": [10, 0], "t_end": 1e-4, "theta": theta, "gamma": gamma}
    conducting = A + np.outer(B, [1 / R, 0])
    if not as_first_order:
        return LureSystem(A=A, B=B, C=[-1, 0], D=R, **common), conducting, R
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    return FirstOrderSystem(x=x, lam=l, f=A @ x, h=R * l - x[0], g=B * l, **common), conducting, R


@pytest.mark.parametrize("as_first_order", [False, True], ids=["LureSystem", "FirstOrderSystem"])
@pytest.mark.parametrize(
    ("theta", "gamma", "expected"), [(1.0, 1.0, 1), (0.5, 0.5, 2), (0.5, 1.0, 1), (1.0, 0.5, 1), (0.5, 0.0, 1), (1.0, 0.0, 1)]
)
def test_order_while_the_diode_conducts(theta, gamma, expected, as_first_order):
    """Two only where both weights are one half: with gamma = 1 the input r = B l, which varies, is first order."""
    model, conducting, R = rlc(theta, gamma, as_first_order)
    grids, states, multipliers = np.array([80, 160, 320, 640]), [], []
    for n in grids:
        run = simulate(model, step=1e-4 / n)
        closed = np.array([expm(conducting * t) @ [10, 0] for t in run.t[::20]])
        states.append((np.abs(run.x[::20] - closed) / np.abs(closed).max(axis=0)).max())
        multipliers.append(np.abs(run.multipliers[20::20, 0] * R - closed[1:, 0]).max())
        assert (run.multipliers[1:] > 0).all()
    assert abs(order(1 / grids, states) - expected) <= 0.1
    assert abs(order(1 / grids, multipliers) - expected) <= 0.1


# ---------------------------------------------------------------------------------------------- monotone inclusions


def test_8_1_reaches_zero_and_stays(runs_of):
    """x' = -1 - 2 x from 2 arrives at t = log(5)/2; the scheme follows within a few steps, at exactly 0."""
    for run in runs_of("inclusion_8_1", 2):
        late = run.t >= np.log(5) / 2 + 3 * run.step[1]
        assert (run.x[late] == 0).all()
        assert (run.x[run.t < np.log(5) / 2 - 3 * run.step[1]] > 0).all()


@pytest.mark.parametrize(("b", "x0"), [(1, 2), (1, 0), (0.3, 1)])
def test_8_1_tends_to_its_equilibrium(b, x0, load_case):
    run = simulate(load_case("inclusion_8_1", b=b, x0=x0), t_end=15)
    assert run.x[-1, 0] == pytest.approx(b / 2, abs=1e-11)


def test_8_2_tends_to_the_minimiser_of_its_energy(load_case):
    found = exact.inclusion_8_2_equilibrium(**FULL)
    assert found == pytest.approx([1.5, 23 / 60, 17 / 30], abs=1e-14)
    run = simulate(load_case("inclusion_8_2_full"), t_end=40)
    assert run.x[-1] == pytest.approx(found, abs=1e-10)


def test_8_2_sticks_within_a_steps_motion(load_case):
    """The second state of the diagonal case sticks at 0 (|b| = 0.5 <= mu = 1) and gets no further than h (|b| + mu) from it."""
    found = exact.inclusion_8_2_equilibrium(**(DIAGONAL | {"K": np.diag(DIAGONAL["K"])}))
    run = simulate(load_case("inclusion_8_2"), t_end=10)
    stuck = run.t > 1
    assert found[1] == 0
    assert np.abs(run.x[stuck, 1]).max() <= 1.5 * run.step[1]
    assert run.x[-1, [0, 2]] == pytest.approx(found[[0, 2]], abs=1e-10)


@pytest.mark.parametrize(("stem", "t_end"), [("inclusion_8_1", 2), ("inclusion_8_2", 4), ("inclusion_8_2_full", 6)])
def test_projection_defects_are_square_summable_of_the_order_of_the_mesh(stem, t_end, runs_of):
    steps, squares, distances = t_end / np.array(GRIDS), [], []
    for run in runs_of(stem, t_end):
        squares.append((run.defect[1:] ** 2).sum())
        distances.append((run.predictor_distance[1:] * run.step[1:]).sum() / t_end)
        assert run.predictor_distance[1:] == pytest.approx(np.linalg.norm(run.defect[1:], axis=1), abs=1e-15)
    assert abs(order(steps, squares) - 1) <= 0.1
    assert abs(order(steps, distances) - 1) <= 0.1
    assert all(fine < coarse for coarse, fine in pairwise(distances))


def test_8_1_defects_are_what_the_bound_pushes_back(runs_of):
    """At rest at 0 each step predicts -h and is pushed back: sum |e|^2 = h (T - t_0), mean distance h (T - t_0)/T, to O(h^2)."""
    rest = 2 - np.log(5) / 2
    for run in runs_of("inclusion_8_1", 2):
        h = run.step[1]
        assert abs((run.defect[1:] ** 2).sum() - h * rest) <= 3 * h**2
        assert abs(run.predictor_distance[1:].mean() - h * rest / 2) <= 2 * h**2


# ---------------------------------------------------------------------------------------------- docs/orders.md


@pytest.fixture(scope="module")
def page():
    """The script that writes the tables of docs/orders.md, as a module."""
    path = Path(__file__).resolve().parents[2] / "docs" / "figures" / "orders.py"
    spec = importlib.util.spec_from_file_location("orders_page", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)  # as for a script, beside which page.py lies
        spec.loader.exec_module(module)
    return module


WEDGES = [exact.Wedge(count=4), exact.Wedge(beta=1 / 3, count=4), exact.Wedge(beta=0.1, coarsest=5, count=3)]


@pytest.mark.parametrize("scene", WEDGES, ids=str)
def test_wedge_solves_its_inclusion(scene):
    """q' = sum l n with l >= 0 on planes that are touched, by differences; heights and slope continuous, |d_t g| <= 3/2."""
    rng = np.random.default_rng(0)
    t, d = rng.uniform(1e-6, scene.start[-1] - 1e-6, 4000), 1e-9
    A, C, alpha = scene.planes(t)
    q, rate = scene.path(t), (scene.path(t + d) - scene.path(t - d)) / (2 * d)
    gaps = np.column_stack([q[:, 1] - A - alpha * q[:, 0], q[:, 1] - C + alpha * q[:, 0]])
    assert gaps.min() >= -1e-15
    normals = np.stack([np.column_stack([-alpha, 1 + 0 * t]), np.column_stack([alpha, 1 + 0 * t])], axis=1)
    push = np.linalg.solve(normals.transpose(0, 2, 1), rate[..., None])[..., 0]  # rate = push_A n_A + push_C n_C
    assert push.min() >= -1e-6
    assert np.abs(push[gaps > 1e-8]).max() <= 1e-6
    fine = np.linspace(0, scene.start[-1], 200_001)
    for heights in scene.planes(fine):
        assert np.abs(np.diff(heights)).max() <= 1.51 * fine[1]


@pytest.mark.parametrize(("beta", "expected"), [(0.0, 1 / 2), (1 / 3, 2 / 3)])
def test_a_sweeping_scene_within_the_theory_has_order_one_half(beta, expected, page):
    """The error is the derived one to rounding, h^((1 + beta)/2) up to 1 + a^2; extrapolation does not change its order."""
    scene = exact.Wedge(beta=beta, count=4)
    seen = page.wedge("", scene, coarsest=4, finest=7)
    assert seen.errors == pytest.approx(scene.drift(np.arange(4)), rel=1e-9)
    assert abs(seen.order - expected) <= 0.02
    assert abs(seen.order_extrapolated - expected) <= 0.05


def test_the_same_shaking_with_a_fixed_slope_has_order_one(page):
    """The drift ends where the other plane is met: h/(8 a)."""
    seen = page.wedge("", exact.Wedge(count=3, slope=0.5), coarsest=4, finest=6)
    assert seen.errors == pytest.approx(seen.h / 4, rel=1e-9)


@pytest.mark.parametrize("theta", [0.25, 0.5])
def test_a_hoelder_f_gives_its_exponent(theta, page):
    closed = lambda t: exact.lacunary(t, theta)[1][:, None]  # noqa: E731
    seen = page.line("", closed, lambda t: page.lacunary(t, theta), lambda t: 0 * t - 9)
    assert abs(seen.order - theta) <= 0.01


@pytest.mark.parametrize(("kind", "start", "expected"), [("w", 0.3, 1), ("w", 0, 2 / 3), ("u", 0.3, 1), ("u", 0, 1 / 4)])
def test_lure_order_from_the_interior_and_from_the_edge_of_a_cone(kind, start, expected, page):
    closed = lambda t: exact.cone_start(t, kind, start)  # noqa: E731
    seen = page.measure("", [(page.cone(kind, start), closed)], page.halved(0.2, 100, 3), 0.2)
    assert abs(seen.order - expected) <= 0.07


@pytest.mark.parametrize(("theta", "gamma", "expected"), [(1.0, 1.0, 1), (0.5, 0.5, 2), (0.5, 1.0, 1)])
def test_switches_of_a_continuous_multiplier_cost_nothing(theta, gamma, expected, page):
    """A diode switches on and off: the orders of a smooth phase, and 2 for extrapolated runs."""
    models = [(page.case("rlc_diode", theta=theta, gamma=gamma), exact.rlc_diode)]
    seen = page.measure("", models, page.halved(2e-3, 800, 4), 2e-3, scale=np.array([10, 0.1]))
    assert abs(seen.order - expected) <= 0.1
    assert abs(seen.order_extrapolated - 2) <= 0.1


def test_order_two_where_a_relay_starts_to_slide_and_one_where_it_jumps(page):
    models = [(page.sliding(a, 0.5, 0.5), lambda t, a=a: page.sliding_exact(t, a)) for a in np.linspace(1, 1.4, 4)]
    steps = page.halved(3, 100, 4)
    assert abs(page.measure("", models, steps, 3).order - 2) <= chance(steps, 2)
    models = [(page.relay_oscillator(v, 0.5, 0.5), lambda t, v=v: exact.friction_free(t, 12, v)) for v in page.SPEEDS]
    steps = page.halved(9, 225, 4)
    seen = page.measure("", models, steps, 9)
    assert abs(seen.order - 1) <= chance(steps, 2)
    assert abs(seen.order_extrapolated - 1) <= chance(steps[:-1], 3)


@pytest.mark.long
@pytest.mark.parametrize(("power", "expected"), [(None, 1), (2, 0), (3, 1 / 2), (4, 1)])
def test_catching_up_with_tolerances_that_are_used_up(power, expected, page):
    """min(1, p/2 - 1) on a half-line, 8.1."""
    eps = None if power is None else (lambda mu: mu**power)
    seen = page.measure("", [(page.case("inclusion_8_1", tolerances=eps), exact.inclusion_8_1)], page.halved(2, 400, 3), 2)
    assert abs(seen.order - expected) <= 0.1


@pytest.mark.parametrize("power", [None, 2])
def test_catching_up_on_a_disc_does_not_use_its_tolerance(power, page):
    """The first iterate that is certified is far better than eps."""
    eps = None if power is None else (lambda mu: mu**power)
    seen = page.measure("", [(page.disc(eps), exact.inside_disc)], page.halved(3, 40, 3), 3)
    assert abs(seen.order - 1) <= 0.1
