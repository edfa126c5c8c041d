"""Every law of every class in C: whole runs beside the interpreter's, with numbers, with any step, with parameters."""

from __future__ import annotations

import shutil

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    SweepingProcess,
    ball,
    box,
    codegen,
    complementarity,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
    simulate,
)

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")

LAWS = {
    "complementarity": complementarity(3),
    "equality": equality(3),
    "relay": relay(3),
    "box": box([-0.5, -np.inf, 0.1], [np.inf, 0.3, 0.4]),
    "point": box([0.2, -1, -1], [0.2, 1, 1]),
    "ball": ball(3, 0.5),
    "cone": second_order_cone(3),
    "ball and relay": product(ball(2, 0.4), relay(1)),
    "cone and equality": product(second_order_cone(2), equality(1)),
    "polyhedron": polyhedron([[1, 0, 0], [-1, -1, -1], [0, 1, 2]], [-0.3, -0.6, -0.5]),
    "polyhedron and relay": product(polyhedron([[1, 0], [-1, -1]], [-0.3, -0.6]), relay(1)),
}
POTENTIALS = {
    "sum of |y|": lambda y: 0.5 * ca.sum1(ca.fabs(y)),
    "largest": lambda y: ca.fmax(ca.fmax(y[0], y[1]), 0.3 * y[2]),
    "norm": lambda y: 0.4 * ca.norm_2(y[:2]) + ca.fmax(y[2], 0),
    "smooth": lambda y: ca.sumsqr(y) / 2 + y[0] ** 4 + ca.fabs(y[1]),
    "nested": lambda y: ca.fmax(ca.fabs(y[0]) - 0.2, 0) + 0.3 * ca.fabs(y[1] - y[2]),
}
GRID = {"t_end": 2.0, "step": 0.01}
t = ca.SX.sym("t")
A = np.array([[-1, 0.5, 0], [-0.5, -1, 0.2], [0, -0.2, -2]])
D = np.array([[0.3, 0.1, 0], [-0.1, 0.2, 0], [0, 0, 0.1]])
FORCE = [2 * ca.sin(3 * t), ca.cos(5 * t), 1.5 * ca.sin(2 * t) + 0.5]


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def lure(law=None, **changes):
    return LureSystem(
        **({"t": t, "A": A, "B": np.eye(3), "C": np.eye(3), "D": D, "f": FORCE, "law": law, "x0": [1, 0.2, 0.4]} | GRID | changes)
    )


def assert_same_run(model, **options):
    """States and multipliers of the compiled run are those of the interpreted one."""
    interpreted, compiled = (simulate(model, compiled=compiled, **options) for compiled in (False, True))
    assert compiled.metadata["used"][-1].startswith("steps in C"), compiled.metadata["warnings"]
    scale = np.abs(interpreted.x).max() + 1e-300
    assert np.abs(compiled.x - interpreted.x).max() <= 1e-10 * scale
    assert compiled.metadata["totals"]["worst_residual"] <= 1e-9
    size = np.nanmax(np.abs(interpreted.multipliers), initial=0) + 1e-300
    assert np.nanmax(np.abs(compiled.multipliers - interpreted.multipliers), initial=0) <= 1e-7 * size
    assert list(compiled.arrays) == list(interpreted.arrays)
    return compiled


@pytest.mark.parametrize("name", LAWS)
def test_linear_system_with_constant_step(name):
    assert_same_run(lure(LAWS[name]))


@pytest.mark.parametrize("name", LAWS)
def test_linear_system_with_variable_steps(name):
    steps = 0.01 * (1 + 0.5 * np.sin(np.arange(150)))
    assert_same_run(lure(LAWS[name], step=None, t_end=None, steps=steps))


@pytest.mark.parametrize("name", POTENTIALS)
def test_linear_system_with_a_potential(name):
    y = ca.SX.sym("y", 3)
    for feedthrough in (D, np.zeros((3, 3))):
        assert_same_run(lure(phi=POTENTIALS[name](y), y=y, D=feedthrough))


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize(("theta", "gamma"), [(1, 1), (0.5, 0.5)])
def test_nonlinear_system(name, theta, gamma):
    x, l = ca.SX.sym("x", 3), ca.SX.sym("l", 3)
    f = A @ x + ca.vertcat(*FORCE) - 0.1 * x**3
    if gamma < 1 and name == "point":
        pytest.skip("no multiplier at the start")
    model = FirstOrderSystem(
        t=t,
        x=x,
        lam=l,
        f=f,
        h=x + D @ l,
        g=l + 0.1 * ca.sin(l),
        law=LAWS[name],
        x0=[1, 0.2, 0.4],
        theta=theta,
        gamma=gamma,
        **GRID,
    )
    assert_same_run(model)


def test_laws_whose_ends_are_parameters(tmp_path):
    """Ends and a radius set in C give the run of the model with these numbers; wrong ones are refused and change nothing."""
    a, r = ca.SX.sym("a"), ca.SX.sym("r")
    model = lure(product(ball(2, r), relay(1, -a, a)), parameters={a: 0.3, r: 0.5})
    codegen.write(model, tmp_path, name="law")
    solver = codegen.load(tmp_path).solver()
    for values in ([0.3, 0.5], [0.7, 0.2], [0.1, 1.5]):
        run = simulate(model, parameters=dict(zip("ar", values, strict=True)), compiled=False)
        assert solver.set_parameters(values) == 0
        assert solver.reset() == 0
        for k in range(1, 201):
            assert solver.step() == 0
            np.testing.assert_allclose(solver.x, run.x[k], rtol=0, atol=1e-10)
    before = solver.x
    for values, status in (([-0.1, 1], 4), ([1, -1], 4), ([np.nan, 1], 2), ([1, np.inf], 2)):
        assert solver.set_parameters(values) == status
    twin = codegen.load(tmp_path).solver()
    twin.set_parameters([0.1, 1.5])
    for _ in range(201):
        twin.step()
    assert solver.step() == 0
    np.testing.assert_array_equal(twin.x, solver.x)
    assert not np.array_equal(before, solver.x)


def oscillators():
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    quadratic, bent = x[0] ** 2 + x[0] * x[1] / 2 + x[1] ** 2, x[0] ** 4 + ca.cosh(x[1])

    def oscillator(potential, friction=None, **changes):
        return FrictionOscillator(
            x=x, potential=potential, friction=friction, s=s, **({"x0": [1, 0.4], "v0": [0, 1]} | GRID | changes)
        )

    walls = {"right": 1.1 - x[0], "disc": 3 - ca.sumsqr(x)}
    return {
        "Coulomb": oscillator(quadratic, {"a": ([1, 0], 0.3 * s), "b": ([1, 1], 0.1 * s)}),
        "isotropic": oscillator(quadratic, 0.4 * s),
        "isotropic, viscous": oscillator(bent, 0.4 * s + s**2),
        "nonsmooth potential": oscillator(quadratic + ca.fabs(x[0] - 0.2), 0.1 * s),
        "walls": oscillator(quadratic - 2 * x[0], {"a": ([1, 0], 0.1 * s)}, constraints=walls),
        "damped, no friction": oscillator(bent, damping=[[0.3, 0.1], [-0.1, 0.2]]),
        "two positions": oscillator(quadratic, 0.2 * s, v0=None, x1=[1.01, 0.39]),
    }


@pytest.mark.parametrize("name", oscillators())
def test_oscillators(name):
    run = assert_same_run(oscillators()[name])
    assert "v" in run.arrays


@pytest.mark.parametrize("mean", [False, True])
def test_sweeping_processes(mean):
    q = ca.SX.sym("q", 4)
    constraints = {
        "pair": ca.norm_2(q[:2] - q[2:]) - 1,
        "floor": ca.vertcat(q[1], q[3]),
        "wall": 2 + 0.5 * ca.sin(t) - q[0],
    }
    f = ca.vertcat(1 + ca.sin(7 * t), -1, -1 + 0.1 * q[0], -1)
    assert_same_run(SweepingProcess(t=t, q=q, f=f, constraints=constraints, q0=[0, 0.5, 1.5, 0.2], mean_forcing=mean, **GRID))


def test_a_model_without_law():
    x = ca.SX.sym("x", 2)
    assert_same_run(FirstOrderSystem(x=x, f=[x[1], -x[0]], x0=[1, 0], theta=0.5, **GRID))
    assert_same_run(FirstOrderSystem(x=x, f=[x[1], -ca.sin(x[0])], x0=[1, 0], theta=0.5, **GRID))
    assert_same_run(SweepingProcess(q=x, f=-x, constraints={}, q0=[1, 2], **GRID))
