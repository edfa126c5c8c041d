"""Steps under error control on second-order cones: closed forms, a judge that integrates the projected field, long runs, C."""

import casadi as ca
import numpy as np
import pytest
from closed_forms import turning_on_a_cone
from fuzz_models import some
from scipy.integrate import solve_ivp

from nsmodel import FirstOrderSystem, LureSystem, second_order_cone, simulate

T, X, L = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("l", 3)
DRIFT = 0.2


def turning(t_end, push=0.3):
    """X turns about the axis of the cone and is pushed through its surface, out and in: see ``turning_on_a_cone``."""
    p, e = push * (ca.cos(T) + DRIFT), X[1:] / ca.norm_2(X[1:])
    f = ca.vertcat(-p, p * e[0] - X[2], p * e[1] + X[1])
    return FirstOrderSystem(t=T, x=X, lam=L, f=f, g=L, h=X, law=second_order_cone(3), x0=[1, 1, 0], t_end=t_end)


def run_of(model, rtol, compiled=True):
    return simulate(model, rtol=rtol, method="time-stepping", compiled=compiled)


def control(run):
    return run.summary()["error_control"]


def gap(y):
    """How far y (N, m) is inside the cone."""
    return y[:, 0] - np.linalg.norm(y[:, 1:], axis=1)


@pytest.mark.c
def test_the_tolerance_is_met_on_a_cone_with_steps_of_second_order():
    steps = []
    for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        run = run_of(turning(10), rtol)
        assert np.abs(run.x - turning_on_a_cone(run.t, 0.3, DRIFT)).max() <= 2 * rtol
        assert run.residual[1:].max() <= 1e-9
        assert control(run)["at_least_step"] == 0
        assert control(run)["extrapolated"] >= 0.97 * control(run)["accepted"]
        steps.append(control(run)["accepted"])
    assert 5 <= steps[2] / steps[0] <= 14
    assert 5 <= steps[4] / steps[2] <= 14


@pytest.mark.c
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("push", "rtol", "t_end"), [(0.1, 1e-2, 40), (0.15, 1e-2, 40), (0.3, 1e-3, 20)])
def test_extrapolation_goes_through_no_surface_of_a_cone(push, rtol, t_end, compiled):
    """The push is at most push (1 + DRIFT), and so is l; in contact x leaves the cone by the curvature of its surface alone."""
    run = run_of(turning(t_end, push), rtol, compiled)
    assert run.multipliers[1:].max() <= push * (1 + DRIFT)
    assert gap(run.x).min() >= -(rtol**2)


@pytest.mark.c
@pytest.mark.long
def test_a_long_run_on_a_cone_ends():
    run = run_of(turning(2000), 1e-4)
    error = np.abs(run.x - turning_on_a_cone(run.t, 0.3, DRIFT)).max()
    assert error <= 1e-4 * control(run)["estimate"]
    assert control(run)["at_least_step"] == 0
    assert run.multipliers[1:].max() <= 0.3 * (1 + DRIFT)


def scene(seed):
    """(model, judge): x' = A x + f + P C'l, y = C x, l and y in the cone of R^m; P symmetric and definite."""
    r = np.random.default_rng(seed)
    n = int(r.integers(2, 5))
    m = int(r.integers(2, n + 1))
    C, A, root = r.normal(size=(m, n)), r.normal(size=(n, n)), r.normal(size=(n, n)) * (seed % 2)
    A -= (np.linalg.eigvalsh(A + A.T).max() / 2 + 0.3) * np.eye(n)
    B = (root @ root.T + np.eye(n)) @ C.T
    a, w, up = r.uniform(0.5, 2, n), r.uniform(0.5, 3, n), np.linalg.pinv(C)[:, 0]
    f = ca.DM(a) * ca.sin(ca.DM(w) * T + ca.DM(range(n))) + ca.DM(up)
    model = LureSystem(t=T, A=A, B=B, C=C, f=f, law=second_order_cone(m), x0=up, t_end=2)
    return model, lambda t: judge(lambda t, x: A @ x + a * np.sin(w * t + np.arange(n)) + up, B, C, up, t)


def judge(field, B, C, x0, t):
    """X (N, n) by DOP853, phase by phase: free, or held on the surface by l = s (1, -e) while s >= 0; far from the apex."""

    def normal(x):
        y = C @ x
        return np.r_[-1.0, y[1:] / np.linalg.norm(y[1:])]

    def push(t, x):
        n = normal(x)
        return n @ C @ field(t, x) / (n @ C @ B @ n)

    def held(t, x):
        return field(t, x) - B @ normal(x) * push(t, x)

    def distance(_, x):
        return (C @ x)[0] - np.linalg.norm((C @ x)[1:])

    distance.terminal, distance.direction = True, -1
    push.terminal, push.direction = True, -1
    now, x, on, out = t[0], np.array(x0), False, [x0]
    while now < t[-1]:
        rest = t[t > now]
        found = solve_ivp(
            held if on else field, (now, t[-1]), x, method="DOP853", rtol=1e-11, atol=1e-13, events=push if on else distance,
            t_eval=rest,
        )  # fmt: skip
        out += list(found.y.T)
        if found.status == 0:
            break
        now, x, on = float(found.t_events[0][0]), found.y_events[0][0], not on
    assert (np.array(out) @ C.T)[:, 0].min() > 0.05
    return np.array(out)


@pytest.mark.c
@pytest.mark.parametrize(("seed", "rtol"), [*((s, 1e-6) for s in some(range(22))), (0, 1e-8), (5, 1e-8), (9, 1e-8), (10, 1e-4)])
def test_random_scenes_agree_with_the_projected_field(seed, rtol):
    model, reference = scene(seed)
    run = run_of(model, rtol)
    exact = reference(run.t)
    assert np.abs(run.x - exact).max() <= 2 * rtol * np.abs(exact).max()
    assert run.residual[1:].max() <= 1e-9


@pytest.mark.c
@pytest.mark.parametrize("model", [turning(10), scene(5)[0], scene(9)[0]])
def test_a_run_on_a_cone_in_c_is_the_same_run(model):
    plain, compiled = (run_of(model, 1e-3, how) for how in (False, True))
    np.testing.assert_array_equal(plain.t, compiled.t)
    np.testing.assert_array_equal(plain.index_set, compiled.index_set)
    np.testing.assert_allclose(plain.x, compiled.x, rtol=1e-11, atol=1e-12)
