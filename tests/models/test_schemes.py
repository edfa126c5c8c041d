"""Schemes: the same model by two routes, exact Jacobians, Cabot's energy inequality, tolerances, conventions of rows."""

from __future__ import annotations

import casadi as ca
import closed_forms as exact
import numpy as np
import pytest
from fuzz_models import COUNT, FULL

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    MonotoneInclusion,
    SweepingProcess,
    UsageError,
    complementarity,
    relay,
    simulate,
)
from nsmodel.solvers.one_step_problem import one_step_problem

# ---------------------------------------------------------------------------------------------- one model, two routes


def coulomb_oscillator(**options):
    """Return x'' + x + Sgn(x') ∋ 0 for the inertial proximal method."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=x**2 / 2, friction=s, s=s, **options)


@pytest.mark.parametrize(("x0", "v0"), [(12, 6), (5.3, 0), (1.5, -3), (0.5, 0)])
def test_friction_oscillator_by_a_relay_and_by_the_proximal_method(x0, v0):
    proximal = simulate(coulomb_oscillator(x0=x0, v0=v0, t_end=50, step=1e-2))
    euler = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[x0, v0], t_end=50, step=1e-2)
    by_relay = simulate(euler)
    assert np.column_stack([proximal.x, proximal.v]) == pytest.approx(by_relay.x, abs=1e-10)
    assert (by_relay.x[:, 1] == 0).sum() == (proximal.v == 0).sum() > 1000
    assert proximal.multipliers[1:] == pytest.approx(by_relay.multipliers[1:], abs=1e-9)  # W = h: ten times less digits


def inputs_of(model):
    """{symbol: signal} of a model whose inputs are numbers."""
    return dict(zip(ca.vertsplit(model.u), model.inputs.values(), strict=True)) if model.inputs else {}


def as_first_order(model):
    """Return a bound Lur'e system as M x' = f + r, r = B l, y = C x + D l."""
    l = ca.SX.sym("l", model.law.size)
    return FirstOrderSystem(
        t=model.t, x=model.x, lam=l, f=model.A + model.f, h=model.C @ model.x + model.D @ l + model.e, g=model.B @ l,
        law=model.law, x0=model.x0, theta=model.theta, gamma=model.gamma, t_end=model.t_end, step=model.step,
        inputs=inputs_of(model),
    )  # fmt: skip


def with_potential(model):
    """Return a bound Lur'e system with Phi(y) instead of its law: sum F |y_i| for relays, an indicator for complementarity."""
    y = ca.SX.sym("y", model.law.size)
    term = {"relay": lambda u, F: F * ca.fabs(u), "complementarity": lambda u, _: ca.if_else(u >= 0, 0, ca.inf)}
    rows = zip(model.law.labels, ca.vertsplit(y), ca.vertsplit(ca.DM(model.law.upper)), strict=True)
    phi = sum(term[label](u, F) for label, u, F in rows)
    A = model.A if ca.depends_on(model.A, model.x) else np.zeros(2 * [model.x.numel()])
    return LureSystem(
        t=model.t, x=model.x, A=A, B=model.B, C=model.C, D=model.D, f=model.f, e=model.e, phi=phi, y=y,
        x0=model.x0, theta=model.theta, gamma=model.gamma, t_end=model.t_end, step=model.step, inputs=inputs_of(model),
    )  # fmt: skip


@pytest.mark.parametrize("route", [as_first_order, with_potential])
def test_every_lure_case_by_another_route(route, cases_of, run_case):
    for stem, model in cases_of(LureSystem).items():
        if model.blocks or (route is with_potential and "box" in model.law.labels):  # of the same model, or of a law, alone
            continue
        run, other = run_case(stem), simulate(route(model.bind()))
        assert (np.abs(other.x - run.x).max(axis=0) <= 1e-10 * np.abs(run.x).max(axis=0)).all(), stem
        size = np.abs(run.multipliers[1:]).max(axis=0)
        assert (np.abs(other.multipliers - run.multipliers)[1:].max(axis=0) <= 1e-9 * size).all(), stem


# ---------------------------------------------------------------------------------------------- the multiplier at the start


@pytest.mark.parametrize("route", [lambda model: model, lambda model: as_first_order(model.bind())], ids=["L", "F"])
def test_gamma_below_one_starts_from_the_multiplier_of_the_law(route):
    """x' = -x + l, 0 <= x - 3 + 2 l ⟂ l >= 0 at x0 = 1: l_0 = 1. The first step by hand, theta = gamma = 1/2."""
    h = 0.1
    model = LureSystem(A=-1, B=1, C=1, D=2, law=complementarity(1), x0=1, t_end=1, step=h, theta=0.5, gamma=0.5)
    shifted = LureSystem(  # the same with the 3 as a constant second state
        A=[[-1, 0], [0, 0]], B=[1, 0], C=[1, -1], D=2, law=complementarity(1), x0=[1, 3], t_end=1, step=h, theta=0.5, gamma=0.5
    )
    run = simulate(route(shifted))
    # x+ = x + h/2 (-x - x+) + h/2 (l_0 + l+), l+ = (3 - x+)/2 while it is positive.
    by_hand = (1 - h / 2 + h / 2 * (1 + 3 / 2)) / (1 + h / 2 + h / 4)
    assert run.x[1, 0] == pytest.approx(by_hand, abs=1e-14)
    assert run.multipliers[1, 0] == pytest.approx((3 - by_hand) / 2, abs=1e-14)
    assert np.isnan(run.multipliers[0]).all()
    assert run.x.shape == (11, 2)
    # Without the 3 the law at the start, 0 <= 1 + 2 l ⟂ l >= 0, is solved by l_0 = 0.
    assert simulate(route(model)).x[1, 0] == pytest.approx((1 - h / 2) / (1 + h / 2), abs=1e-14)


def test_gamma_below_one_starts_a_relay_from_the_sign_of_its_output():
    """x0' = x1, x1' = -x0 + l, l in -Sgn(x1) at (0, 1): y_0 = 1 does not depend on l_0, which is -1."""
    h = 0.1
    model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[0, 1], t_end=h, step=h, gamma=0.5)
    run = simulate(model)
    assert run.multipliers[1, 0] == -1
    assert run.x[1, 1] == pytest.approx((1 - h) / (1 + h**2), abs=1e-14)  # v+ = 1 - h (h v+) - h/2 - h/2


def test_gamma_below_one_starts_a_bilinear_relation(load_case):
    """The gene network starts at (1, 6) with l = (0, 1, 0, 0), so that r_0 = (40, 0)."""
    model, h = load_case("gene_network"), 1e-3
    half = FirstOrderSystem(
        x=model.x, lam=model.lam, f=model.f, h=model.h, g=model.g, law=model.law, x0=[1, 6], t_end=h, step=h, theta=0.5, gamma=0.5
    )
    a, b = 4.5 * h / 2, 1.5 * h / 2
    assert simulate(half).x[1] == pytest.approx([(1 * (1 - a) + 40 * h) / (1 + a), 6 * (1 - b) / (1 + b)], abs=1e-13)


def test_gamma_below_one_is_refused_where_the_law_has_no_multiplier_at_the_start():
    model = LureSystem(A=0, B=1, C=1, law=complementarity(1), x0=-1, t_end=1, step=0.1, gamma=0.5)
    with pytest.raises(UsageError, match="gamma < 1 needs a multiplier at the start"):
        simulate(model)


def test_an_output_without_its_multiplier_decides_the_multiplier():
    """A switch in time, l in -Sgn(t - 0.55): the output does not depend on l at all."""
    t, x, l = (ca.SX.sym(name) for name in ("t", "x", "l"))
    run = simulate(FirstOrderSystem(t=t, x=x, lam=l, f=0, h=t - 0.55, g=l, law=relay(1), x0=0, t_end=1, step=0.1))
    assert (run.multipliers[1:, 0] == np.where(run.t[1:] < 0.55, 1, -1)).all()
    assert run.y[1:, 0] == pytest.approx(run.t[1:] - 0.55, abs=1e-15)
    assert run.x[-1, 0] == pytest.approx(0.0, abs=1e-14)
    assert run.x[5, 0] == pytest.approx(0.5, abs=1e-14)


# ---------------------------------------------------------------------------------------------- Jacobians


def difference(function, at, step=1e-3):
    """Return the Jacobian of ``function`` by fourth-order central differences, column by column."""
    columns = []
    for i in range(at.size):
        e = np.zeros(at.size)
        e[i] = step
        columns.append((8 * (function(at + e) - function(at - e)) - function(at + 2 * e) + function(at - 2 * e)) / (12 * step))
    return np.column_stack(columns) if columns else np.zeros((function(at).size, 0))


def test_jacobians_of_every_case(case_file, load_case):
    model = load_case(case_file.stem, **({"n": 8} if case_file.stem == "crowd_room" and COUNT < FULL else {})).bind()
    if isinstance(model, ManyBodies):
        with pytest.raises(UsageError, match="written_out"):
            one_step_problem(model)
        return
    problem = one_step_problem(model)
    unknowns, known = ca.vertcat(problem.z, problem.l), [problem.t, problem.h, problem.state]
    rows = ca.densify(ca.vertcat(problem.E, problem.Y))
    values = ca.Function("values", [unknowns, *known], [rows])
    E_z, E_l, Y_z, Y_l = problem.jacobians
    exact_ones = ca.Function("J", [unknowns, *known], [ca.densify(ca.blockcat([[E_z, E_l], [Y_z, Y_l]]))])
    rng = np.random.default_rng(1)
    for _ in range(3):
        state = rng.uniform(0.2, 1.0, problem.state.numel())
        here = [rng.uniform(0, 2), rng.uniform(0.1, 1), state]
        at = rng.uniform(0.2, 1.0, unknowns.numel())
        J = np.array(exact_ones(at, *here))
        by_differences = difference(lambda u, here=here: np.array(values(u, *here)).ravel(), at)
        # Round-off of the values over the step, 1e-16/1e-3, and the fifth derivative times step^4 = 1e-12.
        size = np.abs(np.array(values(at, *here))) + np.abs(J).sum(axis=1, keepdims=True)
        assert (np.abs(J - by_differences) <= 1e-9 * size).all()
        assert np.abs(J).max() > 0


# ---------------------------------------------------------------------------------------------- Cabot's energy inequality


def energy_excess(model, run, short_end=False):
    """E_{n+1} - E_n + l_n |v| theta'(|v|) (Proposition 4.1) of each step over its round-off bound, from the run's x and v alone.

    E at a row is |v l_before / l_next|^2/2 + g(x): the last difference over the step that comes next; at the end it is the last.
    A last step that only the end of the run shortens keeps the velocity.
    """
    model = model.bind()
    g = ca.Function("g", [model.x], [model.potential])
    first = 1 if model.x1 is not None else 0  # the row at which the recursion starts
    l = np.where(np.isfinite(run.step), run.step, run.t - np.roll(run.t, 1))[1:]
    ratio = np.ones(len(run.t)) if short_end else np.append(l[0], l) / np.append(l, l[-1])
    E = ((run.v * ratio[:, None]) ** 2).sum(axis=1) / 2 + np.array(g(run.x.T)).ravel()
    assert run.energy[first:] == pytest.approx(E[first:], rel=1e-12)
    power = np.zeros(len(run.t))
    for element in model.elements:
        s = np.linalg.norm(run.v @ np.array(ca.DM(element.H)).T, axis=1)
        slope = ca.Function("slope", [model.s], [ca.gradient(element.theta, model.s)])
        power += s * np.array(slope(s[None, :])).ravel()
    if model.damping is not None:
        power += np.einsum("ki,ij,kj->k", run.v, np.array(ca.DM(model.damping)), run.v)
    assert np.nanmax(power) > 0  # it moves
    round_off = 64 * np.finfo(float).eps * E[first:].max()
    return (np.diff(E[first:]) + l[first:] * power[first + 1 :]) / round_off


def test_energy_inequality_in_every_oscillator_case(cases_of, run_case):
    for stem, model in cases_of(FrictionOscillator).items():
        assert energy_excess(model, run_case(stem)).max() <= 1, stem


@pytest.mark.parametrize("growth", [0.001, 0.02, 0.3])
def test_energy_inequality_with_growing_steps(growth, cases_of):
    for stem, model in cases_of(FrictionOscillator).items():
        # Each step appears three times: equal steps are nondecreasing too.
        steps = np.repeat(0.1 * model.step * (1 + growth) ** np.arange(40), 3)
        run = simulate(model, steps=steps)
        assert run.t[1:] == pytest.approx(np.cumsum(steps), rel=1e-14)
        assert energy_excess(model, run).max() <= 1, stem


def test_energy_inequality_needs_nondecreasing_steps():
    """A halved step takes the older difference for a doubled velocity: O-steps is no empty hypothesis."""
    model = coulomb_oscillator(x0=3, v0=-1, t_end=1, step=0.1)
    assert energy_excess(model, simulate(model, steps=[0.1, 0.1, 0.05, 0.05])).max() > 1e6


def test_energy_inequality_in_the_plane():
    """Isotropic friction with a curved theta, one more along an axis, a skew part of the damping, and a kink of the potential."""
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    model = FrictionOscillator(
        x=x,
        potential=x[0] ** 2 + x[0] * x[1] + 3 * x[1] ** 2 + 0.5 * ca.fabs(x[0] - 0.1),
        friction={"all": ([[1, 0], [0, 1]], 0.1 * s + 0.2 * s**2 + 0.1 * s**3), "along": ([1, 1], 0.05 * s)},
        s=s,
        damping=[[0.1, 1], [-1, 0.2]],
        x0=[1, -1],
        v0=[0, 3],
        t_end=4,
        step=1e-2,
    )
    assert energy_excess(model, simulate(model)).max() <= 1
    assert energy_excess(model, simulate(model, steps=1e-2 * 1.01 ** np.arange(150))).max() <= 1


# ---------------------------------------------------------------------------------------------- tolerances of catching-up


def example_8_1(h, tolerances, b=-1.0):
    """Return Example 8.1 with a = 1 from 2, to t = 4."""
    x = ca.SX.sym("x")
    return MonotoneInclusion(x=x, field=b - x, operator=x, lower=0, x0=2, t_end=4, step=h, tolerances=tolerances)


def check_tolerances(run, distance):
    """Every point is as close to its predictor as eps says; ``distance`` (N,) is d_C of the predictors, by hand."""
    excess, eps = run.excess[1:], run.tolerance[1:]
    by_hand = (run.defect[1:] ** 2).sum(axis=1) - distance**2
    assert (eps > 0).all()
    assert (excess < eps).all()
    assert (excess > 0).any()
    assert (by_hand <= excess + 1e-15).all()
    assert (run.predictor_distance[1:] <= distance + 1e-12).all()
    return by_hand


def test_tolerances_on_a_box_are_used_and_kept():
    for power in (2, 3):
        run = simulate(example_8_1(1e-2, lambda mu, power=power: mu**power))
        assert (run.tolerance[1:] == 1e-2**power).all()
        assert (run.x >= 0).all()
        predictors = run.x[1:, 0] - run.defect[1:, 0]
        distance = np.maximum(-predictors, 0)
        assert check_tolerances(run, distance) == pytest.approx(run.excess[1:], abs=1e-15)
        assert run.predictor_distance[1:] == pytest.approx(distance, abs=1e-15)


def test_tolerances_on_a_smooth_set_are_used_and_kept():
    """A point driven out of the unit disc: d_C is |y| - 1; what is recorded is a bound below it, an excess above the true one.

    It slides to the point of the disc that is furthest along the field; sqrt(eps)/mu is the velocity that the tolerance may add.
    """
    x = ca.SX.sym("x", 2)
    disc = {"disc": 1 - ca.sumsqr(x)}
    outwards = {"field": [1, 0.5], "x0": [-0.5, 0.6], "t_end": 6, "step": 4e-2}
    run = simulate(MonotoneInclusion(x=x, constraints=disc, tolerances=lambda mu: mu**3, **outwards))
    assert (np.linalg.norm(run.x, axis=1) <= 1).all()
    predictors = run.x[1:] - run.defect[1:]
    by_hand = check_tolerances(run, np.maximum(np.linalg.norm(predictors, axis=1) - 1, 0))
    assert (by_hand < 4e-2**3).all()
    assert run.x[-1] == pytest.approx(np.array([1, 0.5]) / np.hypot(1, 0.5), abs=np.sqrt(4e-2))


def test_tolerances_by_number_and_by_step():
    constant, each = simulate(example_8_1(1e-2, 1e-7)), simulate(example_8_1(1e-2, [1e-6, 0.0, 1e-8] * 133 + [0.0]))
    assert (constant.tolerance[1:] == 1e-7).all()
    assert each.tolerance[1:4] == pytest.approx([1e-6, 0, 1e-8], abs=0)
    assert (each.excess[1:] <= each.tolerance[1:]).all()
    off = each.tolerance[1:] == 0
    assert (each.excess[1:][off] == 0).all()
    assert (each.excess[1:][~off] > 0).any()


def test_without_tolerances_projections_are_exact(cases_of, run_case):
    for stem, model in cases_of(MonotoneInclusion).items():
        if model.scheme != "catching-up":
            continue
        run = run_case(stem)
        assert (run.tolerance[1:] == 0).all(), stem
        assert run.excess[1:].max() <= 1e-15, stem


@pytest.mark.long
def test_tolerances_of_third_order_vanish_and_of_second_order_do_not():
    """Each step may drift by sqrt(eps): a velocity sqrt(eps)/mu, which vanishes with the mesh for mu^3, and is constant for mu^2.

    With mu^2 the run therefore tends to the solution for b + drift, with the drift that the run shows.
    """
    steps = np.array([4e-2, 2e-2, 1e-2, 5e-3, 2.5e-3, 1.25e-3])
    errors = {2: [], 3: []}
    for power, found in errors.items():
        for h in steps:
            run = simulate(example_8_1(h, lambda mu, power=power: mu**power))
            found.append(np.abs(run.x - exact.inclusion_8_1(run.t)).max())
            inside = run.predictor_distance[1:] == 0
            drift = np.sqrt(run.excess[1:][inside].max()) / h
            shifted = exact.inclusion_8_1(run.t, b=-1 + drift)
            assert np.abs(run.x - shifted).max() <= 3 * h
    assert min(errors[2]) > 0.3  # O(1), and it stays: the solution itself starts at 2
    assert abs(errors[2][-1] / errors[2][-3] - 1) < 0.05
    assert (np.diff(errors[3]) < 0).all()
    assert errors[3][-1] < errors[3][0] / 3
    # The error tends to sqrt(mu): the slope grows towards 1/2 from below.
    slopes = -np.diff(np.log2(errors[3]))
    assert (np.diff(slopes) > 0).all()
    assert 0.4 < slopes[-1] < 0.5


# ---------------------------------------------------------------------------------------------- rows


def test_rows_of_every_case(case_file, load_case, run_case):
    model, run = load_case(case_file.stem), run_case(case_file.stem)
    N, h = round(model.t_end / model.step), model.step
    if isinstance(model, ManyBodies) and (empty := run.metadata["bodies"]["empty_at"]) is not None:
        N = round(empty / h)
        assert N <= round(model.t_end / h)
        assert np.isnan(run.x[-1]).all()
        assert not np.isnan(run.x[-2]).all()
    elif isinstance(model, ManyBodies) and run.metadata["bodies"]["standstill"]:  # nothing would ever change
        N = round(run.t[-1] / h)
        assert N < round(model.t_end / h)
    driven = bool(model.inputs or model.blocks)  # steps end at edges and ticks
    assert len(run) == N or (driven and len(run) > N)
    assert {len(array) for name, array in run.arrays.items() if not name.startswith("contact_")} == {len(run) + 1}
    assert (run.t == np.arange(N + 1) * h).all() if not driven else run.t[-1] == model.t_end  # not accumulated
    known = 2 if getattr(model, "x1", None) is not None else 1
    many = isinstance(model, ManyBodies)
    for name in ("residual", "step", *(("pressure",) if many else ("multipliers", "y"))):
        assert np.isnan(run.arrays[name][:known]).all(), name
    if many:
        assert (run.step[known:] == h).all()
        assert (run.x[0] == model.q0).all()
        return
    assert (run.index_set[:known] == -2).all()
    assert np.isin(run.index_set[known:], (-1, 0, 1)).all()
    assert (run.step[known:] <= h * (1 + 1e-12)).all() if driven else (run.step[known:] == h).all()
    start = model.q0 if isinstance(model, SweepingProcess) else model.x0
    assert (run.x[0] == np.array(ca.DM(start)).ravel()).all()
    for i, name in enumerate(run.metadata["state_names"]):
        assert name == "x" or (getattr(run, name) == run.x[:, i]).all()  # run.x is the whole state


def test_state_attributes_carry_the_users_names(run_case):
    run = run_case("diode_bridge")
    assert (np.column_stack([run.v_C, run.i_L]) == run.x).all()
    assert run_case("moving_disc").q.shape == (401, 2)
    assert run_case("moving_half_line").q.shape == (301,)
    assert run_case("crowd_room").q.shape == (36, 60)
    assert run_case("gene_network").xb[0] == 6
    with pytest.raises(AttributeError, match="this run has no 'voltage'; it has v_C, i_L"):
        _ = run.voltage


def test_a_shorter_last_step_ends_at_t_end():
    q = ca.SX.sym("q")
    run = simulate(SweepingProcess(q=q, f=-1, constraints={"wall": q - 0.5}, q0=1, t_end=1, step=0.3))
    assert len(run) == 4
    assert (run.t[:4] == np.arange(4) * 0.3).all()
    assert run.t[4] == 1
    assert run.step[1:] == pytest.approx([0.3, 0.3, 0.3, 0.1], abs=1e-15)
    assert run.q == pytest.approx([1, 0.7, 0.5, 0.5, 0.5], abs=1e-15)
    assert (run.reactions[1:] == run.multipliers[1:] / run.step[1:, None]).all()
    assert run.reactions[1:, 0] == pytest.approx([0, 1 / 3, 1, 1], abs=1e-13)  # means over each step


def test_a_whole_number_of_steps_within_rounding_has_no_stray_step(load_case):
    run = simulate(load_case("moving_disc"), t_end=0.7, step=0.1)  # 0.7/0.1 = 6.999999999999999
    assert len(run) == 7
    run = simulate(load_case("moving_disc"), t_end=0.7 + 1e-11, step=0.1)
    assert len(run) == 7


def test_a_shorter_last_step_keeps_an_oscillators_velocity():
    """At t = 2.005 = 200.5 steps the mass slides: x and x' are as close to the closed form as in the row before."""
    model = coulomb_oscillator(x0=5.3, v0=0, t_end=2.005, step=1e-2)
    run = simulate(model)
    error = np.abs(np.column_stack([run.x, run.v]) - exact.friction_free(run.t, 5.3)).max(axis=1)
    assert len(run) == 201
    assert run.t[-1] == pytest.approx(2.005, abs=1e-15)
    assert error[-2] <= 0.05
    assert error[-1] <= 2 * error[-2]
    assert energy_excess(model, run, short_end=True).max() <= 1


def test_a_run_of_one_step_starts_with_its_velocity():
    x0, v0, l = 3.0, 2.0, 0.05
    run = simulate(coulomb_oscillator(x0=x0, v0=v0, steps=[l]))
    assert run.t.tolist() == [0, l]
    assert run.v[0, 0] == v0
    assert run.v[1, 0] == pytest.approx((v0 - l * x0 - l) / (1 + l**2), abs=1e-14)


def test_oscillator_starts_from_a_velocity():
    """v_0 is the velocity at t = 0, the older position x_0 - l_0 v_0: v_1 is the soft threshold of v_0 - h x_0 over 1 + h^2."""
    h, x0, v0 = 0.1, 3.0, 2.0
    run = simulate(coulomb_oscillator(x0=x0, v0=v0, t_end=1, step=h))
    assert run.v[0, 0] == v0
    assert run.x[0, 0] == x0
    assert run.energy[0] == pytest.approx(v0**2 / 2 + x0**2 / 2, rel=1e-15)
    v1 = (v0 - h * x0 - h) / (1 + h**2)
    assert run.v[1, 0] == pytest.approx(v1, abs=1e-14)
    assert run.x[1, 0] == pytest.approx(x0 + h * v1, abs=1e-14)
    older = x0 - h * v0
    inertia = (run.x[1, 0] - 2 * x0 + older) / h**2
    assert inertia + 1 + run.x[1, 0] == pytest.approx(0, abs=1e-11)  # Sgn(v_1) = 1


def test_oscillator_starts_from_two_positions(load_case):
    h = 0.5
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    run = simulate(FrictionOscillator(x=x, potential=x**2 / 2, friction=0.1 * s, s=s, x0=2, x1=1.75, t_end=5, step=h))
    assert (run.x[:2, 0] == [2, 1.75]).all()
    assert (run.t[:3] == [0, h, 2 * h]).all()
    assert np.isnan(run.v[0]).all()
    assert run.v[1, 0] == (1.75 - 2) / h
    assert run.energy[1] == pytest.approx(0.5**2 / 2 + 1.75**2 / 2, rel=1e-15)
    v2 = (-0.5 - h * 1.75 + h * 0.1) / (1 + h**2)
    assert run.v[2, 0] == pytest.approx(v2, abs=1e-14)
    assert run.x[2, 0] == pytest.approx(1.75 + h * v2, abs=1e-14)


def test_older_difference_is_divided_by_the_new_step():
    """(x_{n+2} - 2 x_{n+1} + x_n)/l_n^2 + A((x_{n+2} - x_{n+1})/l_n) + x_{n+2} = 0 with growing steps, while it slides."""
    l = np.array([0.1, 0.11, 0.15, 0.15, 0.2])
    run = simulate(coulomb_oscillator(x0=3, v0=-1, t_end=1, step=0.1), steps=l)
    x = np.append(3 + l[0] * 1, run.x[:, 0])
    assert (run.v < 0).all()
    assert (x[2:] - 2 * x[1:-1] + x[:-2]) / l**2 - 1 + x[2:] == pytest.approx(np.zeros(5), abs=1e-11)
    assert run.t == pytest.approx(np.append(0, np.cumsum(l)), abs=1e-15)
    assert run.v[1:, 0] == pytest.approx(np.diff(run.x[:, 0]) / l, abs=1e-13)


@pytest.mark.parametrize("kink", [ca.fabs, lambda s: ca.fmax(s, 0), lambda s: ca.if_else(s > 0, s, 0), lambda s: ca.sqrt(s**2)])
def test_friction_written_with_a_kink_at_zero_is_the_friction_beside_it(kink):
    """theta is a function on s >= 0: |s|, max(s, 0) and s are the same friction there."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = {"x": x, "potential": x**2 / 2, "s": s, "x0": 5.3, "t_end": 12, "step": 1e-2}
    plain, kinked = (simulate(FrictionOscillator(friction=theta, **model)) for theta in (0.9 * s + s**2, 0.9 * kink(s) + s**2))
    np.testing.assert_allclose(kinked.x, plain.x, rtol=0, atol=1e-12)
    assert kinked.metadata["convergence"]["theta_prime_0"] == pytest.approx(0.9, rel=1e-12)


def test_friction_without_dry_part_has_a_slope_of_exactly_zero():
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    for theta in (s**2, ca.log(ca.cosh(s)), s**1.5):
        run = simulate(FrictionOscillator(x=x, potential=x**2 / 2, friction=theta, s=s, x0=1, t_end=1, step=0.1))
        assert run.metadata["convergence"]["theta_prime_0"] == 0.0


def test_the_margin_is_that_of_the_element_nearest_to_sliding():
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    friction = {"weak": ([[1, 0]], 0.3 * s), "strong": ([[0, 1]], 0.6 * s)}
    run = simulate(FrictionOscillator(x=x, potential=ca.sumsqr(x) / 2, friction=friction, s=s, x0=[0.1, -0.5], t_end=1, step=0.1))
    found = run.metadata["convergence"]
    assert (found["element"], found["theta_prime_0"], found["distance"]) == ("strong", 0.6, 0.5)
    assert found["margin"] == pytest.approx(0.1, abs=1e-15)
    assert found["n_0"] == 0


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("cubic", [0.0, 0.1])
def test_rest_is_exact_where_friction_acts_on_combinations(cubic, compiled):
    """H_1 = (1, 1), H_2 = (1, -2): both stick together or the mass moves; then v = 0, not the rounding of a linear system."""
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    friction = {"a": ([[1, 1]], s + cubic * s**3), "b": ([[1, -2]], 0.7 * s)}
    potential = ca.dot(x, x) / 2 + 0.2 * x[0] * x[1]
    model = FrictionOscillator(x=x, potential=potential, friction=friction, s=s, x0=[3, 1.5], v0=[0, 1], t_end=6, step=0.01)
    run = simulate(model, compiled=compiled)
    still = np.flatnonzero((run.index_set == 0).all(axis=1))
    assert still.size > 100
    assert (run.v[still] == 0).all()
    assert run.metadata["convergence"]["finite"]
