"""Inclusions with time, and the two schemes of an inclusion, against closed forms, an ODE in 50 digits and brute force."""

import itertools

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from nsmodel import MonotoneInclusion, StepError, Trajectory, check, explain, relay, simulate, stress
from nsmodel.models.monotone_inclusion.reference_steps import residuals

T = ca.SX.sym("t")
X, Y = ca.SX.sym("x"), ca.SX.sym("x", 2)
SCHEMES = ("catching-up", "implicit")
WAYS = [(scheme, compiled) for scheme in SCHEMES for compiled in (False, True)]
each_way = pytest.mark.parametrize(("scheme", "compiled"), WAYS)


# -- exact at the rows -------------------------------------------------------------------------------------------------


@each_way
def test_play_is_exact_where_its_input_is_monotone_between_rows(scheme, compiled):
    """w = the point of [u - r, u + r] next to the last w: exact at extremes of u = a sin t that are rows."""
    a, r, rows = 2.0, 0.5, 40
    model = MonotoneInclusion(
        t=T, x=X, field=0, lower=a * ca.sin(T) - r, upper=a * ca.sin(T) + r, x0=0, step=2 * np.pi / rows, t_end=6 * np.pi,
        scheme=scheme,
    )  # fmt: skip
    run = simulate(model, compiled=compiled)
    exact = [0.0]
    for u in a * np.sin(run.t[1:]):
        exact.append(float(np.clip(exact[-1], u - r, u + r)))
    np.testing.assert_allclose(run.x[:, 0], exact, atol=1e-13 * a)
    period = run.x[rows : 2 * rows + 1, 0]
    assert period.max() == pytest.approx(a - r, abs=1e-13)  # the hysteresis loop of the literature
    assert period.min() == pytest.approx(r - a, abs=1e-13)


@each_way
def test_a_wall_of_fixed_normal_is_exact_at_rows(scheme, compiled):
    """n'x >= a(t), a growing: n'x = max(n'x0, a), the part along the wall is what F says."""
    n, tangent = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    a = 2 - 2 * ca.exp(-T) + 0.1 * T
    model = MonotoneInclusion(
        t=T,
        x=Y,
        field=0.7 * tangent - 0.2 * n,
        constraints={"wall": ca.dot(n, Y) - a},
        x0=1.3 * n,
        t_end=4,
        step=0.05,
        scheme=scheme,
    )
    run = simulate(model, compiled=compiled)
    wall = 2 - 2 * np.exp(-run.t) + 0.1 * run.t
    free = 1.3 - 0.2 * run.t
    meets = np.flatnonzero(wall >= free)[0]
    normal = np.where(np.arange(len(run.t)) < meets, free, wall)
    np.testing.assert_allclose(run.x @ n, normal, atol=1e-12)
    np.testing.assert_allclose(run.x @ tangent, 0.7 * run.t, atol=1e-12)


def test_a_state_rides_on_a_switching_surface_that_moves():
    """x' ∈ -3 Sgn(x - a(t)) from x = a(0): the solution is a(t), |a'| < 3. The resolvent has it exactly."""
    a = ca.sin(2 * T)
    given = {"t": T, "x": X, "field": 0, "operator": 3 * ca.sign(X - a), "x0": 0, "t_end": 3, "step": 0.01}
    run = simulate(MonotoneInclusion(**given, scheme="implicit"))
    np.testing.assert_allclose(run.x[:, 0], np.sin(2 * run.t), atol=1e-13)
    first = simulate(MonotoneInclusion(**given), t_end=0.01)
    assert first.v[1, 0] == pytest.approx(2.0, rel=1e-12)  # at the tie v = a', not the least |v|
    errors = [np.abs(simulate(MonotoneInclusion(**given), step=h).x[:, 0] - np.sin(2 * np.arange(round(3 / h) + 1) * h)).max()
              for h in (0.01, 0.005)]  # fmt: skip
    assert errors[1] < 0.6 * errors[0] < 0.6 * 0.05


# -- order one ---------------------------------------------------------------------------------------------------------


def order_of(model, exact, steps):
    errors = [np.linalg.norm(simulate(model, step=h).x[-1] - exact) for h in steps]
    return np.diff(np.log(errors)) / np.diff(np.log(steps)), errors


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_one_on_a_turning_half_plane(scheme):
    """{n(t)'x <= 1}, n = (cos t, sin t), F = 0: with tau = n', x = n + s tau slides with s' = -1 while it is pushed, s > 0."""
    n = ca.vertcat(ca.cos(T), ca.sin(T))
    model = MonotoneInclusion(
        t=T, x=Y, field=[0, 0], constraints={"plane": 1 - ca.dot(n, Y)}, x0=[1, 2], t_end=1.5, step=0.1, scheme=scheme
    )
    exact = np.array([np.cos(1.5), np.sin(1.5)]) + (2 - 1.5) * np.array([-np.sin(1.5), np.cos(1.5)])
    orders, errors = order_of(model, exact, [0.02, 0.01, 0.005, 0.0025])
    assert errors[-1] < 5e-3
    np.testing.assert_allclose(orders, 1, atol=0.05)


def sliding(t, x):
    """The velocity of a state that lies against {1 - (x_0 - 2 t)^2/4 - (x_1 - sin t)^2 >= 0} and is driven outwards."""
    dx, dy = x[0] - 2 * t, x[1] - np.sin(t)
    rate, slope, f = dx + 2 * dy * np.cos(t), np.array([-dx / 2, -2 * dy]), np.array([-1, 0.3])
    push = -(rate + slope @ f) / (slope @ slope)
    assert push > 0
    return f + push * slope


# The same ODE from (-2, 0) to t = 1, by mpmath.odefun in 50 digits.
ON_THE_ELLIPSE = "0.0036239172759688199789363969682274231524784540033770", "0.78129927981407857627507095286800838295164767723625"


def test_the_reference_on_the_ellipse_is_that_of_another_integrator():
    found = solve_ivp(sliding, (0, 1), [-2, 0], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    np.testing.assert_allclose(found, np.array(ON_THE_ELLIPSE, float), atol=1e-11)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_one_on_a_moving_ellipse(scheme):
    c = 1 - (Y[0] - 2 * T) ** 2 / 4 - (Y[1] - ca.sin(T)) ** 2
    model = MonotoneInclusion(t=T, x=Y, field=[-1, 0.3], constraints={"ellipse": c}, x0=[-2, 0], t_end=1, step=0.1, scheme=scheme)
    orders, errors = order_of(model, np.array(ON_THE_ELLIPSE, float), [0.02, 0.01, 0.005, 0.0025])
    assert errors[-1] < 5e-3
    np.testing.assert_allclose(orders, 1, atol=0.05)


def test_interpreted_and_compiled_steps_agree_on_sets_that_move():
    c = 1 - (Y[0] - ca.sin(2 * T)) ** 2 / 4 - Y[1] ** 2
    given = {"t": T, "x": Y, "field": [-Y[1] + ca.cos(T), Y[0]], "x0": [0, 0], "t_end": 4, "step": 0.01}
    for scheme in SCHEMES:
        for bounds in ({"constraints": {"e": c}}, {"lower": [-1 - T / 9, -2], "upper": [1, 0.4 * ca.cos(T)]}):
            model = MonotoneInclusion(**given, **bounds, scheme=scheme)
            one, other = simulate(model, compiled=False), simulate(model, compiled=True)
            np.testing.assert_allclose(one.x, other.x, atol=1e-12)
            np.testing.assert_array_equal(one.index_set, other.index_set)


def test_projections_with_tolerances_on_a_set_that_moves():
    """eps_k is used up at most: |x+ - y|^2 < d^2 + eps, x+ in C(t + h)."""
    c = 1 - (Y[0] - 2 * T) ** 2 / 4 - (Y[1] - ca.sin(T)) ** 2
    given = {"t": T, "x": Y, "field": [-1, 0.3], "constraints": {"ellipse": c}, "x0": [-2, 0], "t_end": 1, "step": 0.01}
    run, exact = (simulate(MonotoneInclusion(**given, tolerances=eps)) for eps in (lambda mu: mu**3, None))
    dx, dy = run.x[:, 0] - 2 * run.t, run.x[:, 1] - np.sin(run.t)
    assert (1 - dx**2 / 4 - dy**2 >= -1e-12).all()
    assert 0 < run.excess[1:].max() <= 1e-6
    assert np.abs(run.x - exact.x).max() < 0.2


def test_a_box_that_becomes_empty_ends_the_run():
    model = MonotoneInclusion(t=T, x=X, field=0, lower=T, upper=1, x0=0.5, t_end=2, step=0.1)
    for compiled in (False, True):
        with pytest.raises(StepError, match=r"step 10: C is empty at t = 1\.1: lower\[0\] = 1\.1 > upper\[0\] = 1") as caught:
            simulate(model, compiled=compiled)
        assert caught.value.trajectory.t[-1] == pytest.approx(1)


# -- the resolvent -----------------------------------------------------------------------------------------------------


@each_way
@pytest.mark.parametrize("b", [-1.0, 2.0])
def test_the_resolvent_on_example_8_1(b, scheme, compiled):
    """x' = b - (1 + a) x inside; for b < 0 the state reaches 0 and stays there exactly."""
    a = 0.5
    model = MonotoneInclusion(x=X, field=b - a * X, operator=X, lower=0, x0=1, t_end=4, step=0.01, scheme=scheme)
    run = simulate(model, compiled=compiled)
    exact = np.maximum(b / (1 + a) + (1 - b / (1 + a)) * np.exp(-(1 + a) * run.t), 0)
    assert np.abs(run.x[:, 0] - exact).max() < 0.01
    assert b > 0 or (run.x[-100:, 0] == 0).all()


def equilibrium(K, b, mu, low, high):
    """The minimiser of x'Kx/2 - b'x + sum mu |x| on a box, by all patterns: at an end, at 0, or free of one sign."""
    n, best = len(b), (np.inf, None)
    for pattern in itertools.product(("low", "high", 0, 1, -1), repeat=n):
        x = np.array([low[i] if p == "low" else high[i] if p == "high" else 0.0 for i, p in enumerate(pattern)])
        free = [i for i, p in enumerate(pattern) if p in (1, -1)]
        signs = np.array([pattern[i] for i in free], float)
        if free:
            fixed = [i for i in range(n) if i not in free]
            x[free] = np.linalg.solve(K[np.ix_(free, free)], b[free] - mu[free] * signs - K[np.ix_(free, fixed)] @ x[fixed])
        if ((x >= low - 1e-12) & (x <= high + 1e-12)).all():
            best = min(best, (x @ K @ x / 2 - b @ x + mu @ np.abs(x), tuple(x)))
    return np.array(best[1])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_the_resolvent_sticks_exactly_on_example_8_2(seed, compiled):
    """x' ∈ b - Kx - sum mu_i Sgn(x_i) - N_[l,u](x): at rest what sticks is 0.0, and no bit changes; T as operator and as phi."""
    rng = np.random.default_rng(seed)
    n = 3
    A = rng.normal(size=(n, n))
    K, b, mu = A @ A.T + np.eye(n), 2 * rng.normal(size=n), rng.uniform(0.5, 2, n)
    low, high = -rng.uniform(0.2, 1, n), rng.uniform(0.2, 1, n)
    x = ca.SX.sym("x", n)
    given = {"x": x, "field": b - K @ x, "lower": low, "upper": high, "x0": (low + high) / 2, "t_end": 30, "step": 0.02}
    end = equilibrium(K, b, mu, low, high)
    for T in ({"operator": mu * ca.sign(x)}, {"phi": ca.dot(mu, ca.fabs(x))}):
        run = simulate(MonotoneInclusion(**given, **T, scheme="implicit"), compiled=compiled)
        np.testing.assert_allclose(run.x[-1], end, atol=1e-9)
        stuck = np.abs(end) < 1e-12
        assert (run.x[-1, stuck] == 0).all()
        assert run.metadata["warnings"] == []
        if stuck.all():
            assert (run.x[-100:] == 0).all()


@pytest.mark.long
def test_both_schemes_agree_to_first_order_and_pass_the_judge_of_stress():
    x = ca.SX.sym("x", 2)
    given = {
        "t": T, "x": x, "field": [ca.cos(3 * T), -x[0]], "operator": ca.vertcat(x[0] + 0.5 * ca.sign(x[0]), 2 * x[1]),
        "lower": [-1, -0.3 - 0.1 * ca.sin(T)], "x0": [0.2, 0.1], "t_end": 2, "step": 1e-3,
    }  # fmt: skip
    runs = [simulate(MonotoneInclusion(**given, scheme=scheme)) for scheme in SCHEMES]
    assert np.abs(runs[0].x - runs[1].x).max() < 5e-3
    pushed = MonotoneInclusion(**(given | {"step": 0.02, "t_end": 0.1}), scheme="implicit")
    assert not stress(pushed, steps=3).wrong


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_judge_finds_a_step_that_is_wrong(scheme):
    model = MonotoneInclusion(
        t=T, x=Y, field=[1, -Y[0]], operator=[ca.sign(Y[0]), 2 * Y[1]], lower=[-1, -ca.cos(T)], x0=[0.3, 0.4], t_end=1,
        step=0.05, scheme=scheme,
    )  # fmt: skip
    run = simulate(model)
    with np.errstate(all="ignore"):  # 0/0 where nothing acts, as in the cells of stress
        assert max(residuals(model, run).values()) <= 1
    wrong = Trajectory(run.arrays | {"x": run.x + 1e-5 * (np.arange(len(run.t)) == 12)[:, None]}, run.metadata)
    with np.errstate(all="ignore"):
        assert max(residuals(model, wrong).values()) > 100


def test_the_judge_knows_what_a_state_is_known_to():
    """A state that comes to rest at a jump of S is off it by a rounding of the step, on either side."""
    model = MonotoneInclusion(
        x=Y, field=[1 - Y[1], -Y[0]], operator=relay(2, -1, 1), lower=-1, upper=2, x0=[0, 0.1], t_end=1, step=0.02,
        scheme="implicit",
    )  # fmt: skip
    run = simulate(model, compiled=False)
    assert 0 < np.abs(run.x[5, 1]) < 1e-16
    with np.errstate(all="ignore"):
        assert max(residuals(model, run).values()) <= 1


def test_explain_names_the_scheme():
    model = MonotoneInclusion(x=X, field=-X, lower=0, x0=1, t_end=1, step=0.1)
    assert "catching-up with approximate projections" in explain(model)
    assert "implicit: the resolvent of T" in explain(
        MonotoneInclusion(x=X, field=-X, lower=0, x0=1, t_end=1, step=0.1, scheme="implicit")
    )


# -- check -------------------------------------------------------------------------------------------------------------


def named(report, name):
    return next(item for item in report.consequences if item.name == name)


def checked(**given):
    return check(MonotoneInclusion(**({"t": T, "x": X, "field": 0, "x0": 0, "t_end": 3, "step": 0.01} | given)), quick=True)


@pytest.mark.parametrize("seed", range(5))
def test_the_speed_of_a_box(seed):
    """kappa against the distances of random pairs of boxes: their corners move by as much."""
    rng = np.random.default_rng(seed)
    a, w, p = rng.normal(size=(3, 4))
    ends = [a[i] * ca.sin(w[i] * T + p[i]) for i in range(4)]
    report = checked(x=Y, field=[0, 0], lower=[ends[0] - 9, ends[1] - 9], upper=[ends[2] + 9, ends[3] + 9], x0=[0, 0])
    kappa = report["M-H"].value["kappa"]
    t = np.sort(rng.uniform(0, 3, (2000, 2)), axis=1)
    moved = np.abs(a * (np.sin(w * t[:, 1:] + p) - np.sin(w * t[:, :1] + p)))
    distance = np.hypot(np.maximum(moved[:, 0], moved[:, 2]), np.maximum(moved[:, 1], moved[:, 3]))
    seen = (distance / (t[:, 1] - t[:, 0])).max()
    assert seen <= kappa <= np.linalg.norm(np.maximum(*np.abs(a * w).reshape(2, 2))) * (1 + 1e-9)
    assert report["M-H"].verdict == report["M-C"].verdict == "holds"
    assert named(report, "well posed").verdict == "holds"


@pytest.mark.parametrize("several", [False, True])
@pytest.mark.long
def test_the_speed_of_an_ellipse_and_of_what_a_half_plane_cuts_off(several):
    """Distances of points of C(s) to C(t), by projecting on the boundary in polar coordinates: never beyond kappa |t - s|."""
    c = {"e": 1 - (Y[0] - 0.3 * ca.sin(2 * T)) ** 2 / 4 - Y[1] ** 2}
    if several:
        c["plane"] = 0.8 + 0.1 * ca.cos(T) - Y[1]
    model = MonotoneInclusion(t=T, x=Y, field=[0, 0], constraints=c, x0=[0, 0], t_end=3, step=0.01)
    report = check(model, region={"x": (-2.5, 2.5)})
    finding = report["M-H"]
    assert finding.verdict == "holds"
    speed = 0.6  # of the ellipse, which moves as a whole
    assert finding.value["kappa"] >= speed * (1 - 1e-9)
    assert finding.value["kappa"] <= (8 if several else 1.15) * speed
    rows = ca.Function("c", [T, Y], [ca.vertcat(*c.values())])
    rng = np.random.default_rng(0)
    for s, t in rng.uniform(0, 3, (20, 2)):
        points = rng.uniform(-2.5, 2.5, (4000, 2))
        of_s, of_t = (points[(np.array(rows(at, points.T)) >= 0).all(axis=0)] for at in (s, t))
        far = np.array([np.linalg.norm(of_t - point, axis=1).min() for point in of_s[:300]]).max()
        assert far <= finding.value["kappa"] * abs(t - s) + 0.12  # the grid of points


def test_a_bound_that_jumps_and_a_set_that_becomes_empty_are_shown():
    report = checked(lower=ca.floor(T), x0=1)
    assert report["M-H"].verdict == "violated"
    assert round(report["M-H"].witness["t"], 12) in (1, 2, 3)
    assert named(report, "well posed").verdict == "unknown"
    empty = checked(lower=T - 1, upper=1)
    assert empty["M-C"].verdict == "violated"
    assert empty["M-C"].witness["t"] >= 2
    assert empty["M-H"].verdict == "violated"


EMPTY_AT_TIMES = {  # C(t) as a box or by constraints, and a time from which on it is empty, at least for a while
    "sides that pass each other": ({"lower": T - 0.7, "upper": 0.7 - T}, 0.7),
    "for a moment": ({"lower": 1.1 - (T - 1.5) ** 2, "upper": 1.09}, 1.4),
    "one side of two": ({"x": Y, "field": [0, 0], "x0": [0, 0], "lower": [-1, T - 2], "upper": [1, 0.5]}, 2.5),
    "a disc that shrinks": ({"constraints": {"disc": 1 - T - X**2}}, 1.0),
    "walls": ({"constraints": {"left": X + 1 - T, "right": 1 - T - X}}, 1.0),
    "never a point": ({"constraints": {"disc": -1 - ca.sin(T) ** 2 - X**2}}, 0.0),
}


@pytest.mark.parametrize("name", EMPTY_AT_TIMES)
def test_a_set_that_is_empty_at_some_time_does_not_move_at_a_finite_speed(name):
    given, begins = EMPTY_AT_TIMES[name]
    report = checked(**given)
    assert report["M-H"].verdict in ("violated", "unknown")
    if name != "for a moment":
        assert report["M-H"].verdict == "violated"
        assert "empty" in report["M-H"].how
        assert report["M-H"].witness["t"] >= begins
    assert "holds" not in {item.verdict for item in report.findings}
    assert "holds" not in {item.verdict for item in report.consequences if item.name != "tolerances"}


def test_a_set_that_shrinks_to_a_point_moves_at_a_finite_speed():
    """[t - 0.75, 0.75 - t] up to t = 0.75, where it is {0}: in doubles exactly."""
    report = checked(lower=T - 0.75, upper=0.75 - T, t_end=0.75)
    assert report["M-H"].verdict == "holds"
    assert report["M-H"].value["kappa"] == pytest.approx(1)
    assert report["M-C"].verdict == "violated"  # no interior


@pytest.mark.parametrize("seed", range(12))
def test_whether_random_intervals_are_empty_at_some_time(seed):
    """lower and upper sums of waves and lines, against 20 000 times."""
    rng = np.random.default_rng([35, seed])
    a, w, b = rng.normal(size=(3, 2))
    low, up = (a[i] * ca.sin(3 * w[i] * T) + b[i] * T / 3 + shift for i, shift in ((0, -1.0), (1, 1.0)))
    width = np.array(ca.Function("width", [T], [up - low])(np.linspace(0, 3, 20_001))).min()
    verdict = checked(lower=low, upper=up)["M-H"].verdict
    if abs(width) > 1e-3:
        assert verdict == ("violated" if width < 0 else "holds")


def test_a_half_plane_that_turns_is_lipschitz_on_the_box_alone():
    n = ca.vertcat(ca.cos(T), ca.sin(T))
    report = check(MonotoneInclusion(t=T, x=Y, field=[0, 0], constraints={"p": 1 - ca.dot(n, Y)}, x0=[0, 0], t_end=1, step=0.01))
    assert report["M-H"].verdict == "holds"
    assert report["M-H"].scope.states


def test_growth_and_slopes_are_those_of_all_times():
    """F = (1 + t) x on [0, 3]: L = 4, |F| <= 4 |x|; along the run nothing is violated."""
    report = check(MonotoneInclusion(t=T, x=X, field=(1 + T) * X - 1, lower=-1, upper=1, x0=0, t_end=3, step=0.01))
    assert report["M-24"].value["L"] == pytest.approx(4)
    assert report["M-24"].scope.time == (0, 3)
    assert not [finding.id for finding in report.findings if finding.verdict == "violated"]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_along_a_run_nothing_false_is_said(scheme):
    u = 2 * ca.sin(T) * ca.exp(-T / 10)
    report = check(MonotoneInclusion(t=T, x=X, field=0, lower=u - 0.5, upper=u + 0.5, x0=0, t_end=20, step=0.01, scheme=scheme))
    assert not [finding.id for finding in report.findings if finding.verdict == "violated"]
    assert named(report, "convergence of the scheme").verdict == "holds"
