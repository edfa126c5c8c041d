"""The nonlinear step on the last index set against the general way: the same states, index sets and counts."""

from functools import cached_property

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import FirstOrderSystem, SweepingProcess, complementarity, product, relay, simulate
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.solvers.time_stepper import Stepper


@pytest.fixture
def general(monkeypatch):
    """Runs without it."""

    def run(model, **options):
        with monkeypatch.context() as patch:
            patch.setattr(Stepper, "_last_index_set_step", None)
            return simulate(model, compiled=False, **options)

    return run


def assert_same(one, other):
    size = np.maximum(np.abs(other.x).max(axis=0), 1e-30)
    np.testing.assert_allclose(one.x / size, other.x / size, atol=1e-12)
    np.testing.assert_array_equal(one.index_set, other.index_set)
    np.testing.assert_array_equal(one.newton[1:], other.newton[1:])
    assert one.metadata["solver_counts"] == other.metadata["solver_counts"]
    assert one.metadata["warnings"] == other.metadata["warnings"]
    assert one.residual[1:].max() <= 1e-9


def first_order(seed):
    """x' = f(x, t) + C' l with a cubic, laws of all boxes, outputs that bend."""
    rng = np.random.default_rng(seed)
    n, kinds = rng.integers(1, 4), rng.integers(0, 3, rng.integers(0, 4))
    laws = [(relay(1, -2, 1), complementarity(1), relay(1, 0.5))[kind] for kind in kinds]
    m, x, t = len(laws), ca.SX.sym("x", n), ca.SX.sym("t")
    A, C = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    f = A @ x - 0.3 * x**3 + ca.vertcat(*(np.cos(i) * ca.sin(3 * t + i) for i in range(n)))
    given = {"t": t, "x": x, "f": f, "x0": rng.normal(size=n), "t_end": 2, "step": 0.01, "theta": rng.choice([1, 0.5])}
    if not m:
        return FirstOrderSystem(**given)
    lam = ca.SX.sym("l", m)
    h = C @ x + 0.1 * ca.sin(x[0]) + 0.5 * lam
    return FirstOrderSystem(**given, lam=lam, h=h, g=C.T @ lam * (1 + 0.1 * ca.cos(x[0])), law=product(*laws))


@pytest.mark.parametrize("seed", range(share(40, 10)))
def test_random_systems_go_the_same_way(seed, general):
    model = first_order(seed)
    assert_same(simulate(model, compiled=False), general(model))


@pytest.mark.parametrize("seed", range(share(10, 3)))
def test_discs_and_walls_go_the_same_way(seed, general):
    rng = np.random.default_rng(seed)
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 4)
    pair = ca.norm_2(q[:2] - q[2:]) - 1
    walls = {"pair": pair, "floor": q[1] + 2 + 0.2 * ca.sin(t), "round": 9 - ca.sumsqr(q[2:])}
    f = ca.vertcat(*(rng.normal() * 2 + ca.cos(3 * t + k) for k in range(4)))
    model = SweepingProcess(t=t, q=q, f=f, constraints=walls, q0=[-1, 0, 1, 0], t_end=2, step=0.01)
    assert_same(simulate(model, compiled=False), general(model))


@pytest.mark.long
@pytest.mark.parametrize("case", ["gene_network", "two_discs", "point_past_disc", "zhuravlev_ivanov", "friction_oscillator"])
def test_cases_go_the_same_way(case, general, load_case):
    model = load_case(case)
    assert_same(simulate(model, compiled=False), general(model))


def test_most_steps_of_a_smooth_phase_are_taken_so(monkeypatch):
    """The solvers are not asked while nothing switches."""
    run = prepared_loop(first_order(2), compiled=False)
    newton = run.propagator.stepper._newton
    calls = []
    solve = newton.solve
    monkeypatch.setattr(newton, "solve", lambda *args: (calls.append(1), solve(*args))[1])
    run.go()
    assert len(calls) < 0.2 * run.propagator.k


def test_many_unknowns_and_forced_solvers_go_the_general_way():
    assert isinstance(Stepper.__dict__["_last_index_set_step"], cached_property)
    assert prepared_loop(first_order(2), compiled=False, solver="lemke").propagator.stepper._last_index_set_step is None
    x = ca.SX.sym("x", 12)
    l = ca.SX.sym("l", 12)
    large = FirstOrderSystem(x=x, lam=l, f=-(x**3), h=x, g=l, law=relay(12), x0=np.ones(12), t_end=1, step=0.1)
    assert prepared_loop(large, compiled=False).propagator.stepper._last_index_set_step is None
