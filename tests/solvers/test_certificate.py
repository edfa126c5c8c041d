"""The residual against the definition of the law, and wrong answers that it must not let through."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    ball,
    complementarity,
    load,
    product,
    relay,
    second_order_cone,
    simulate,
)
from nsmodel.solvers import active_set, mlcp
from nsmodel.solvers import constant_matrices as kernel_module
from nsmodel.solvers import mlcp as curved
from nsmodel.solvers import mlcp as qp
from nsmodel.solvers.fallbacks import NonlinearProgramme
from nsmodel.solvers.newton import NewtonSolver
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem
from nsmodel.solvers.residuals import ROUNDING, NumericLaw, law_residual, numeric_law, output_scale, symbolic_box_residual
from nsmodel.solvers.rounding_errors import UNIT_ROUND_OFF
from nsmodel.solvers.step import WarmStart
from nsmodel.solvers.time_stepper import Stepper

INF = np.inf
TO_THE_END = {"xatol": 1e-10, "fatol": 1e-11, "maxiter": 3000, "maxfev": 3000}
BOXES = {
    "complementarity": (0.0, INF),
    "upper": (-INF, 0.5),
    "equality": (-INF, INF),
    "relay": (-1.0, 1.0),
    "switch": (0.0, 1.0),
    "point": (2.0, 2.0),
}


def numeric_box(lo, up):
    return NumericLaw(np.atleast_1d(np.array(lo, float)), np.atleast_1d(np.array(up, float)), ())


# ---------------------------------------------------------------------------------------------- distance to the graph


def distance_to_box_graph(l, y, lo, up, s_l, s_y):
    """min of max(|l - l^|/s_l, |y - y^|/s_y) over the three pieces of the graph, each a convex problem in one variable."""

    def cost(at_l, at_y):
        return max(abs(l - at_l) / s_l if l != at_l else 0.0, abs(y - at_y) / s_y)

    far, best = 10 * (abs(y) + s_y), INF
    pieces = []
    if np.isfinite(lo):
        pieces.append((lambda v: cost(lo, v), 0.0, far))
    if np.isfinite(up):
        pieces.append((lambda v: cost(up, v), -far, 0.0))
    a, b = max(lo, l - 10 * (abs(l) + s_l)), min(up, l + 10 * (abs(l) + s_l))
    a, b = (a, b) if a <= b else (np.clip(l, lo, up),) * 2
    pieces.append((lambda u: cost(u, 0.0), a, b))
    for function, a, b in pieces:
        grid = np.linspace(a, b, 401)
        values = [function(v) for v in grid]
        i = int(np.argmin(values))
        best = min(best, values[i])
        low, high = grid[max(i - 1, 0)], grid[min(i + 1, 400)]
        if low < high:
            best = min(best, minimize_scalar(function, bounds=(low, high), method="bounded", options={"xatol": 1e-13}).fun)
    return best


def own_size(l, *bounds):
    """The scale of a multiplier by itself: its size or that of its finite bounds."""
    return max(np.linalg.norm(l), *(abs(bound) for bound in bounds if np.isfinite(bound)), 0.0)


@pytest.mark.parametrize("kind", BOXES)
def test_residual_of_a_box_row_is_the_distance_to_the_graph(kind):
    lo, up = BOXES[kind]
    rng = np.random.default_rng(0)
    for _ in range(60):
        l, y = rng.normal(size=2) * 10.0 ** rng.uniform(-3, 1)
        l = rng.choice([l, lo + 1e-3 * l if np.isfinite(lo) else l, up + 1e-3 * l if np.isfinite(up) else l])
        s_y, s_l = rng.uniform(0.01, 2, 2)
        found = law_residual(numeric_box(lo, up), np.array([l]), np.array([y]), np.array([s_y]), np.array([s_y / s_l]))[0]
        expected = distance_to_box_graph(l, y, lo, up, min(s_l, own_size(l, lo, up)), s_y)
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-9)


def unit(v):
    return v / (np.linalg.norm(v) or 1)


def ball_pieces(dim, radius):
    """The graph of a ball, piece by piece: a map of parameters to (l, y), and parameters to start from, functions of (l, y)."""

    def inside(p):
        return p * min(1, radius / (np.linalg.norm(p) or 1)), np.zeros(dim)

    def sliding(p):
        e = unit(p[:dim])
        return radius * e, -abs(p[dim]) * e

    sides = (lambda l, y: l, lambda l, y: -y, lambda l, y: unit(l) - unit(y))
    return [
        (inside, [lambda l, y: l]),
        (sliding, [lambda l, y, side=side: np.append(side(l, y), np.linalg.norm(y)) for side in sides]),
    ]


def cone_pieces(dim, _):
    """The same for the second-order cone: l = 0, or y = 0, or both on the boundary and orthogonal."""

    def in_cone(p):
        return np.concatenate([[np.linalg.norm(p[1:]) + abs(p[0])], p[1:]])

    def boundary(p):
        e = unit(p[2:])
        return abs(p[0]) * np.concatenate([[1], e]), abs(p[1]) * np.concatenate([[1], -e])

    sides = (lambda l, y: l[1:], lambda l, y: -y[1:], lambda l, y: unit(l[1:]) - unit(y[1:]))
    return [
        (lambda p: (np.zeros(dim), in_cone(p)), [lambda l, y: y]),
        (lambda p: (in_cone(p), np.zeros(dim)), [lambda l, y: l]),
        (boundary, [lambda l, y, side=side: np.append([l[0], y[0]], side(l, y)) for side in sides]),
    ]


@pytest.mark.parametrize(("kind", "pieces"), [("ball", ball_pieces), ("cone", cone_pieces)])
@pytest.mark.parametrize("dim", [2, 3])
def test_residual_of_a_curved_block_is_the_distance_to_the_graph(kind, pieces, dim):
    """In norms of blocks the natural map is above the distance, and at most sqrt(2) times it (it is firmly nonexpansive)."""
    rng = np.random.default_rng(1)
    law = numeric_law(ball(dim, 0.7) if kind == "ball" else second_order_cone(dim))
    kinds = set()
    for _ in range(12):
        l, y = rng.normal(size=(2, dim)) * [[1.0], [10.0 ** rng.uniform(-2, 1)]]
        w, s_y = rng.uniform(0.2, 3), rng.uniform(0.1, 1)
        s = np.full(dim, s_y)
        found = law_residual(law, l, y, s, np.full(dim, w))
        scale_y = np.linalg.norm(s)
        scale_l = min(s_y / w, own_size(l, 0.7 if kind == "ball" else 0.0))
        assert np.all(found == found[0])
        best = INF
        for at, (graph, starts) in enumerate(pieces(dim, 0.7)):

            def cost(p, l=l, y=y, graph=graph, scale_l=scale_l, scale_y=scale_y):
                at_l, at_y = graph(p)
                return max(np.linalg.norm(l - at_l) / scale_l, np.linalg.norm(y - at_y) / scale_y)

            for start in starts:
                value = minimize(cost, start(l, y), method="Nelder-Mead", options=TO_THE_END).fun
                if value < best - 1e-7:
                    best, nearest = value, at
        kinds.add(nearest)
        assert best <= found[0] * (1 + 1e-6)
        assert found[0] <= np.sqrt(2) * best * (1 + 1e-6)
    assert len(kinds) >= 2


@pytest.mark.parametrize("kind", ["ball", "cone"])
def test_points_of_the_curved_graphs_have_residual_zero(kind):
    rng = np.random.default_rng(2)
    law = numeric_law(ball(3, 0.7) if kind == "ball" else second_order_cone(3))
    for graph, starts in (ball_pieces if kind == "ball" else cone_pieces)(3, 0.7):
        for _ in range(20):
            l, y = graph(starts[0](*rng.normal(size=(2, 3))))
            s = np.full(3, np.linalg.norm(y) + 1)
            assert law_residual(law, l, y, s, np.ones(3)).max() < 1e-14


# ---------------------------------------------------------------------------------------------- units


def problem(seed, m=4):
    """(W, b, law, l) with W positive definite and the solution l, all kinds of rows."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(m, m))
    W = A @ A.T + 0.3 * np.eye(m)
    lo, up = (np.array(side) for side in zip(*rng.permutation(list(BOXES.values()))[:m], strict=True))
    l, y = np.zeros(m), np.zeros(m)
    for i in range(m):
        where = rng.integers(3)
        if where == 1 and np.isfinite(lo[i]):
            l[i], y[i] = lo[i], rng.uniform(0.2, 2)
        elif where == 2 and np.isfinite(up[i]):
            l[i], y[i] = up[i], -rng.uniform(0.2, 2)
        else:
            a = lo[i] if np.isfinite(lo[i]) else up[i] - 2 if np.isfinite(up[i]) else -2
            l[i] = rng.uniform(a, up[i] if np.isfinite(up[i]) else a + 2)
    return W, y - W @ l, NumericLaw(lo, up, ()), l


@pytest.mark.parametrize("unit_y", [1e-9, 1e9])
@pytest.mark.parametrize("unit_l", [1e-9, 1e9])
def test_residuals_do_not_depend_on_units(unit_l, unit_y):
    rng = np.random.default_rng(0)
    for seed in range(30):
        W, b, law, l = problem(seed)
        l = l + rng.normal(size=4) * 10.0 ** rng.uniform(-12, 0)
        scaled = NumericLaw(law.lower * unit_l, law.upper * unit_l, ())
        found = mlcp.affine_law_residual(W * (unit_y / unit_l), b * unit_y, scaled, l * unit_l)
        np.testing.assert_allclose(found, mlcp.affine_law_residual(W, b, law, l), rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("unit_y", [1e-9, 1e9])
@pytest.mark.parametrize("unit_l", [1e-9, 1e9])
def test_residuals_of_curved_laws_do_not_depend_on_units(unit_l, unit_y):
    law, scaled = (numeric_law(product(ball(2, 0.7 * u), second_order_cone(3))) for u in (1, unit_l))
    rng = np.random.default_rng(0)
    for _ in range(30):
        W, b, l = rng.normal(size=(5, 5)), rng.normal(size=5), rng.normal(size=5)
        found = mlcp.affine_law_residual(W * (unit_y / unit_l), b * unit_y, scaled, l * unit_l)
        np.testing.assert_allclose(found, mlcp.affine_law_residual(W, b, law, l), rtol=1e-9)


# ---------------------------------------------------------------------------------------------- perturbed solutions


def test_an_error_of_1e_minus_6_in_l_or_y_is_seen():
    for seed in range(60):
        W, b, law, l = problem(seed)
        assert mlcp.affine_law_residual(W, b, law, l).max() < 1e-14
        for i in range(4):
            for change in (1e-6, -1e-6):
                other = l.copy()
                other[i] += change * (abs(l[i]) or 1)
                assert mlcp.affine_law_residual(W, b, law, other).max() > 1e-9
            if W[i] @ l + b[i] == pytest.approx(0, abs=1e-9) and law.lower[i] < l[i] < law.upper[i]:
                moved = b.copy()
                moved[i] += 1e-6 * (np.abs(b[i]) + np.abs(W[i]) @ np.abs(l))
                assert mlcp.affine_law_residual(W, moved, law, l).max() > 1e-9


def test_an_error_of_1e_minus_6_in_a_curved_solution_is_seen():
    law = numeric_law(product(ball(2, 0.7), second_order_cone(3)))
    rng = np.random.default_rng(3)
    for _ in range(40):
        A = rng.normal(size=(5, 5))
        W, b = A @ A.T + 0.3 * np.eye(5), rng.normal(size=5) * 3
        found = mlcp.solve_mlcp(W, b, law, np.zeros(5), np.zeros(5, np.int8), (mlcp.SEMISMOOTH,), True, 1e-12)
        assert found.residual <= 1e-12
        for rows in (slice(0, 2), slice(2, 5)):
            direction = rng.normal(size=5)
            wrong = found.l.copy()
            wrong[rows] += 1e-6 * (np.linalg.norm(found.l[rows]) or 1) * direction[rows] / np.linalg.norm(direction[rows])
            assert mlcp.affine_law_residual(W, b, law, wrong).max() > 1e-9


def relay_oscillator_at(h, t=1.0):
    """(stepper, state, warm start) of the relay oscillator after the time t, in steps h."""
    model = load("relay_oscillator")
    run = simulate(model, step=h, t_end=t)
    problem = one_step_problem(model)
    stepper = Stepper(problem, "auto", 1e-9, h=h, state=run.x[-1])
    return stepper, run.x[-1], WarmStart(run.multipliers[-1], run.index_set[-1])


@pytest.mark.parametrize("h", [1e-2, 1e-3])
@pytest.mark.parametrize("error", [4e-3, 1e-6])
@pytest.mark.usefixtures("without_fallbacks")
def test_an_error_in_the_relays_output_is_seen_however_small_its_effect_on_y(h, error, monkeypatch):
    """W = h^3/4: y = x_0 hardly feels l in this step, but x_2 does, by h l. Such a step is wrong by h times the error."""
    stepper, state, warm = relay_oscillator_at(h)
    right = stepper(1.0, h, state, warm)
    l = right.row[stepper.layout.l]
    assert abs(l[0]) == 1

    def wrong(W, b, law, *_):
        assert np.abs(W).max() < 3e-7
        return mlcp.MlcpSolution(l * (1 - error), -right.warm.index, 0.0, "wrong")

    monkeypatch.setattr(mlcp, "solve_mlcp", wrong)
    monkeypatch.setattr(active_set, "primal_dual_active_set", lambda *_: (l * (1 - error), -right.warm.index))
    with pytest.raises(StepError):
        stepper(1.0, h, state, WarmStart(warm.l, -right.warm.index))


def test_a_force_at_a_distance_is_seen():
    """x'' = l with 0 <= x, x = 1: no contact, so l = 0. W = h^2 is small beside y = 1, and a force of 1e-3 is wrong."""
    for h in (1e-2, 1e-3, 1e-5):
        W, b, law = np.array([[h**2]]), np.array([1.0]), numeric_box(0, INF)
        assert mlcp.affine_law_residual(W, b, law, np.array([0.0]))[0] == 0
        assert mlcp.affine_law_residual(W, b, law, np.array([1e-3]))[0] > 1e-9


@pytest.mark.parametrize(("lo", "up"), [(-1, 1), (0, INF), (-INF, 0)])
def test_a_row_whose_output_does_not_feel_the_multiplier_is_judged_too(lo, up):
    """W = 0: y = b decides l alone; l between the bounds, or at the wrong one, is no point of the graph."""
    law, W = numeric_box(lo, up), np.zeros((1, 1))
    right = lo if np.isfinite(lo) else up
    b = np.array([0.3 if np.isfinite(lo) else -0.3])
    assert mlcp.affine_law_residual(W, b, law, np.array([float(right)]))[0] == 0
    for error in (1e-6, 0.5, 2.0):
        wrong = np.array([right + error if np.isfinite(lo) else right - error])
        assert mlcp.affine_law_residual(W, b, law, wrong)[0] > 1e-9


def test_a_relay_that_only_time_switches():
    """x' = l, l ∈ -Sgn(cos t): W = 0. x is the integral of -sgn(cos t)."""
    t, x, l = (ca.SX.sym(name) for name in "txl")
    model = FirstOrderSystem(t=t, x=x, lam=l, f=0, h=ca.cos(t), g=l, law=relay(1), x0=0, t_end=6, step=1e-2)
    run = simulate(model)
    np.testing.assert_array_equal(run.multipliers[1:, 0], -np.sign(np.cos(run.t[1:])))


def test_a_huge_multiplier_does_not_excuse_a_violated_row():
    """Opposite walls that overlap by 2: no l helps, but |W| |l| beside which y is judged can be made as large as one likes."""
    W, b, law = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([-1.0, -1.0]), numeric_box([0, 0], [INF, INF])
    for size in (1e3, 1e6, 1e9, 1e12, 1e15):
        assert mlcp.affine_law_residual(W, b, law, np.full(2, size)).max() > 1e-9


# ---------------------------------------------------------------------------------------------- NaN


@pytest.mark.parametrize("bad", [np.nan, INF, -INF])
def test_what_is_not_a_number_has_residual_inf(bad):
    law, one = numeric_box([-1, 0], [1, INF]), np.ones(2)
    for l, y in (([bad, 1], [0, 0]), ([0, 0], [bad, 0]), ([bad, bad], [bad, bad])):
        found = law_residual(law, np.array(l, float), np.array(y, float), one, one)
        assert found[0] == INF
        symbols = ca.SX.sym("l", 2), ca.SX.sym("y", 2)
        residual = ca.Function("r", list(symbols), [symbolic_box_residual(law, [0, 1], one, *symbols, ca.SX(one))])
        assert float(residual(l, y)) == INF
    for own in (ball(2, 1), second_order_cone(2)):
        assert law_residual(numeric_law(own), np.array([bad, 0.0]), np.zeros(2), one, one).max() == INF
        assert law_residual(numeric_law(own), np.zeros(2), np.array([0.0, bad]), one, one).max() == INF


@pytest.mark.parametrize("law", [relay(1), complementarity(1), ball(2, 1), second_order_cone(2)], ids=lambda law: law.labels[0])
def test_a_model_that_becomes_nan_stops(law):
    """f = sqrt(1 - t) ends at t = 1; also where no multiplier feels it."""
    t, m = ca.SX.sym("t"), law.size
    for C in (np.eye(m), np.zeros((m, m))):
        model = LureSystem(
            t=t, A=-np.eye(m), B=np.eye(m), C=C, D=np.eye(m), f=ca.vertcat(ca.sqrt(1 - t), *[0] * (m - 1)), law=law, x0=[0.5] * m,
            t_end=2, step=0.1,
        )  # fmt: skip
        with pytest.raises(StepError) as error:
            simulate(model)
        assert error.value.trajectory.t[-1] == pytest.approx(1)
        assert np.isfinite(error.value.trajectory.x).all()


def test_a_model_without_law_that_becomes_nan_stops():
    t, x = ca.SX.sym("t"), ca.SX.sym("x")
    with pytest.raises(StepError, match=r"not a finite|not finite"):
        simulate(FirstOrderSystem(t=t, x=x, f=ca.sqrt(1 - t), x0=0, t_end=2, step=0.1))


# ---------------------------------------------------------------------------------------------- kernel and NumPy


def kernels():
    """Models with constant matrices: (name, model)."""
    q, x, s, t = ca.SX.sym("q", 2), ca.SX.sym("x", 2), ca.SX.sym("s"), ca.SX.sym("t")
    yield "relay and box", LureSystem(
        t=t, A=[[-1, 2], [0, -3]], B=np.eye(2), C=np.eye(2), D=[[1, 0.5], [-0.5, 0]], f=[3 * ca.sin(5 * t), ca.cos(4 * t)],
        law=product(relay(1), complementarity(1)), x0=[0.3, -0.2], t_end=2, step=0.1,
    )  # fmt: skip
    yield (
        "walls",
        SweepingProcess(
            q=q, f=[1, -2], constraints={"a": q[0] + q[1] + 1, "b": 2 - q[0], "c": q[1] + 0.5}, q0=[0, 0], t_end=1, step=0.1
        ),
    )
    yield "friction", FrictionOscillator(
        x=x, potential=x[0] ** 2 + x[0] * x[1] + x[1] ** 2 + ca.fabs(x[0]), s=s,
        friction={"a": ([1, 0], 0.3 * s), "b": ([0, 1], s + s**2)}, x0=[1, 0.4], v0=[0, 1], t_end=1, step=0.1,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["relay and box", "walls", "friction"])
def test_the_kernels_residual_is_numpys(name):
    """Both at the same state and multiplier, of all sizes: the CasADi expression against Newton's judge."""
    model = dict(kernels())[name]
    problem = one_step_problem(model)
    start = initial_rows(model, 0.1)[-1][0]
    stepper = Stepper(problem, "auto", 1e-9, h=0.1, state=start)
    assert stepper.plan.path == "kernel"
    kernel, newton, where = stepper._build_kernel(0.0, 0.1), stepper._newton, stepper.layout
    rng = np.random.default_rng(0)
    small = 0
    for k in range(60):
        state, t = start + rng.normal(size=start.size) * 10.0 ** rng.uniform(-3, 1), rng.uniform(0, 3)
        l = rng.normal(size=stepper.law.size) * 10.0 ** rng.uniform(-3, 1)
        index = np.full(l.size, -1, np.int8)
        if k % 3 == 0:
            found = mlcp.solve_mlcp(
                kernel.W, kernel.b(t, state), stepper.law, l, index, (mlcp.INDEX_SET, mlcp.LEMKE), False, 1e-12
            )
            l = found.l * (1 + rng.normal() * 10.0 ** rng.uniform(-10, -2))
        kernel.load_multiplier(l, index)
        row = kernel.evaluate(t, state)
        small += row[where.residual] < 1e-3
        known = newton.known(t, 0.1, state)
        guess_0 = known.guess
        b = kernel.b(t, state)
        at_0 = newton.linearise(t, 0.1, state, guess_0, np.zeros(l.size))
        z = guess_0 - np.linalg.solve(at_0.J.E_z, at_0.E + at_0.J.E_l @ l)
        at = newton.linearise(t, 0.1, state, z, l)
        np.testing.assert_allclose(at.Y, kernel.W @ l + b, rtol=1e-9, atol=1e-12)
        judged = newton.evaluate_residual(known, at, l, index, "test", 1, thorough=False)
        unseen = ROUNDING * UNIT_ROUND_OFF / 1e-9 * (np.abs(at.J.Y_z) @ np.abs(z) + np.abs(at.J.Y_l) @ np.abs(l))
        w_max = np.abs(kernel.W).max(axis=1)
        moved = z - (guess_0 - np.linalg.solve(at_0.J.E_z, at_0.E))
        s_y = output_scale(b, np.abs(at.J.Y_z) @ np.abs(moved) + np.abs(at.J.Y_l) @ np.abs(l), w_max)
        by_hand = law_residual(stepper.law, l, kernel.W @ l + b, s_y, w_max, unseen).max()
        if name == "walls":  # a projection: <l, y> beside |q' - q|^2 + |h f|^2
            moved, y = z - state, kernel.W @ l + b
            gap = np.maximum(l, 0) @ np.maximum(y, 0)
            seen = gap > 1e-13 * (np.abs(l) @ (1 + np.abs(y)))
            by_hand = max(by_hand, gap / (moved @ moved + 0.1**2 * 5) if seen else 0.0)
        assert row[where.residual] == pytest.approx(judged.residual, rel=1e-6, abs=1e-13)
        assert row[where.residual] == pytest.approx(by_hand, rel=1e-6, abs=1e-11)
    assert small >= 10


# ---------------------------------------------------------------------------------------------- solvers that lie


def liars():
    """One model of each class and path: (name, model)."""
    q, x, s, t = ca.SX.sym("q", 2), ca.SX.sym("x", 2), ca.SX.sym("s"), ca.SX.sym("t")
    l = ca.SX.sym("l", 2)
    yield from kernels()
    yield "disc", SweepingProcess(q=q, f=[1, 0], constraints={"disc": ca.norm_2(q) - 1}, q0=[-1.2, 0.1], t_end=2, step=0.1)
    yield (
        "isotropic friction",
        FrictionOscillator(
            x=x, potential=x[0] ** 2 + x[1] ** 2 / 2, friction=s + s**3, s=s, x0=[1, 0.4], v0=[0, 1], t_end=2, step=0.1
        ),
    )
    yield "bilinear", FirstOrderSystem(
        x=x, lam=l, f=-x, h=[0.2 - x[0], 0.3 - x[1]], g=[2 * l[0] * (1 - l[1] / 2), l[1]], law=relay(2, 0, 1), x0=[0.5, 0.1],
        t_end=2, step=0.1,
    )  # fmt: skip
    yield (
        "first order",
        FirstOrderSystem(t=t, x=x, lam=l, f=-x, h=x + l / 2, g=l, law=complementarity(2), x0=[-0.5, 0.1], t_end=2, step=0.1),
    )
    yield (
        "nonlinear Lur'e",
        LureSystem(x=x, A=[x[1], -ca.sin(x[0])], B=np.eye(2), C=np.eye(2), law=ball(2, 0.2), x0=[1, 0], t_end=2, step=0.1),
    )
    yield (
        "cone",
        LureSystem(A=-np.eye(3), B=np.eye(3), C=np.eye(3), law=second_order_cone(3), x0=[-1, 0.5, 0.2], t_end=2, step=0.1),
    )
    yield (
        "inclusion, disc",
        MonotoneInclusion(x=x, field=[1, 0.5], constraints={"disc": 1 - ca.sumsqr(x)}, x0=[0, 0], t_end=2, step=0.1),
    )


def chooser():
    """An inclusion that starts on a kink: the velocity is chosen there by a solver of its own."""
    x = ca.SX.sym("x", 2)
    return MonotoneInclusion(x=x, field=[0.5, -0.2], phi=ca.fabs(x[0]) + ca.fabs(x[1]), x0=[0, 0], t_end=1, step=0.1)


LIARS = dict(liars())


@pytest.fixture
def without_fallbacks(monkeypatch):
    """Leave the lying solver alone: no IPOPT, no search among the index sets nearby, no solution of the whole system."""
    for whole in ("polish_on_index_set", "solve_whole_system", "solve_nearest_point"):
        monkeypatch.setattr(NewtonSolver, whole, lambda *_: None)
    monkeypatch.setattr(Stepper, "_solve_by_parts", lambda *_: iter(()))
    monkeypatch.setattr(NewtonSolver, "_refine_iterate", lambda _, known, found: found)
    monkeypatch.setattr(Stepper, "_ipopt_attempts", lambda *_: iter(()))
    monkeypatch.setattr(Stepper, "_nearby_index_set_attempts", lambda *_: iter(()))


def assert_right_or_stopped(model, truth):
    """The run of a lying solver: every row that comes out is right. Return whether it stopped."""
    try:
        run, stopped = simulate(model), False
    except StepError as error:
        run, stopped = error.trajectory, True
    rows = len(run.t)
    size = np.abs(truth.x).max()
    np.testing.assert_allclose(run.x, truth.x[:rows], rtol=0, atol=1e-8 * size)
    return stopped


@pytest.mark.parametrize("error", [1e-6, 1.0])
@pytest.mark.parametrize("name", LIARS)
@pytest.mark.usefixtures("without_fallbacks")
def test_a_solver_that_lies_about_its_residual_is_found_out(name, error, monkeypatch):
    """It changes l and the index set and reports residual 0."""
    model, honest, honest_set = LIARS[name], mlcp.solve_mlcp, active_set.primal_dual_active_set
    truth = simulate(model)

    def spoiled(l, index, law):
        opened = np.where(np.isfinite(law.lower), -1, 0)
        return l + error * np.where(l != 0, np.abs(l), 1.0), np.where(index == 0, opened, 0).astype(np.int8)

    def lying(W, b, law, *rest):
        found = honest(W, b, law, *rest)
        return mlcp.MlcpSolution(*spoiled(found.l, found.index, law), 0.0, "liar")

    def lying_set(W, b, law, index):
        found = honest_set(W, b, law, index)
        return None if found is None else spoiled(*found, law)

    monkeypatch.setattr(mlcp, "solve_mlcp", lying)
    monkeypatch.setattr(active_set, "primal_dual_active_set", lying_set)
    assert assert_right_or_stopped(model, truth)


@pytest.mark.parametrize("name", [*LIARS, "inclusion, kink"])
@pytest.mark.usefixtures("without_fallbacks")
def test_solvers_that_are_all_wrong_are_found_out(name, monkeypatch):
    """Every solver below the chain returns a wrong multiplier, and the polish too."""
    model = (LIARS | {"inclusion, kink": chooser()})[name]
    truth = simulate(model)

    def spoil(l):
        return None if l is None else l + 1e-6 * np.where(l != 0, np.abs(l), 1.0)

    def spoiled(function):
        return lambda *arguments: spoil(function(*arguments))

    def pair(function):
        def wrong(*arguments):
            found = function(*arguments)
            return None if found is None else (spoil(found[0]), found[1])

        return wrong

    monkeypatch.setattr(active_set, "solve_on_index_set", spoiled(active_set.solve_on_index_set))
    monkeypatch.setattr(active_set, "lemke", spoiled(active_set.lemke))
    monkeypatch.setattr(active_set, "primal_dual_active_set", pair(active_set.primal_dual_active_set))
    monkeypatch.setattr(qp, "solve_qp", spoiled(qp.solve_qp))
    monkeypatch.setattr(curved, "semismooth_newton", spoiled(curved.semismooth_newton))
    monkeypatch.setattr(curved, "polish_curved_solution", pair(curved.polish_curved_solution))
    monkeypatch.setattr(kernel_module, "_multiplier_map", spoil_map(kernel_module._multiplier_map))
    assert assert_right_or_stopped(model, truth)


def spoil_map(function):
    def wrong(*arguments):
        found = function(*arguments)
        return None if found is None else (found[0], found[1] + 1e-6 * np.where(found[1] != 0, np.abs(found[1]), 1.0), found[2])

    return wrong


@pytest.mark.parametrize("entry", [0, 1, 2, 3], ids=["E_z", "E_l", "Y_z", "Y_l"])
@pytest.mark.parametrize("name", ["relay and box", "walls", "friction"])
@pytest.mark.usefixtures("without_fallbacks")
def test_wrong_matrices_are_found_out(name, entry, monkeypatch):
    """The kernel is given matrices that are off by 1e-6: the step is judged by the model's own expressions."""
    model, honest = LIARS[name], kernel_module.step_matrices_at
    truth = simulate(model)

    def wrong(*arguments):
        matrices = [M.copy() for M in honest(*arguments)]
        matrices[entry] *= 1 + 1e-6
        return tuple(matrices)

    monkeypatch.setattr(kernel_module, "step_matrices_at", wrong)
    stopped = assert_right_or_stopped(model, truth)
    assert stopped or entry >= 2


@pytest.mark.parametrize("name", ["bilinear", "disc", "isotropic friction", "nonlinear Lur'e", "relay and box"])
def test_ipopt_that_lies_is_found_out(name, monkeypatch):
    model = LIARS[name]
    truth = simulate(model)
    honest = NonlinearProgramme.solve

    def wrong(*arguments):
        found = honest(*arguments)
        return None if found is None else tuple(part * (1 + 1e-3) + 1e-3 for part in found)

    monkeypatch.setattr(NonlinearProgramme, "solve", wrong)
    try:
        run = simulate(model, solver="ipopt")
    except StepError as error:
        run = error.trajectory
    np.testing.assert_allclose(run.x, truth.x[: len(run.t)], atol=1e-8)
