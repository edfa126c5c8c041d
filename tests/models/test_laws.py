"""Every law and every kind of potential in every class that takes one: each step against its definition and SciPy."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from scipy.optimize import brentq, minimize, nnls

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ModelError,
    MonotoneInclusion,
    SweepingProcess,
    UsageError,
    ball,
    box,
    complementarity,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
    simulate,
)

INF = np.inf
TIGHT = {"xatol": 1e-11, "fatol": 1e-15, "maxiter": 4000, "maxfev": 4000}


# ---------------------------------------------------------------------------------------------- laws by their definition


def project_cone(u):
    size = np.linalg.norm(u[1:])
    if size <= abs(u[0]):
        return u if u[0] >= 0 else np.zeros_like(u)
    return (u[0] + size) / 2 * np.concatenate([[1], u[1:] / size])


def project_ball(u, radius):
    return u * min(1, radius / max(np.linalg.norm(u), 1e-300))


def project_polyhedron(u, H, K):
    """The nearest point of {H l >= K}: the best one over all sets of active rows."""
    best, distance = None, INF
    for count in range(len(K) + 1):
        for rows in map(list, itertools.combinations(range(len(K)), count)):
            A = H[rows]
            l = u + A.T @ np.linalg.lstsq(A @ A.T, K[rows] - A @ u, rcond=None)[0] if rows else u
            if np.all(H @ l >= K - 1e-12) and np.linalg.norm(l - u) < distance:
                best, distance = l, np.linalg.norm(l - u)
    return best


SIMPLEX = np.vstack([np.eye(2), -np.ones((1, 2))]), np.array([0.0, 0.0, -1.0])  # l >= 0, l_0 + l_1 <= 1
LAWS = {
    "equality": (equality(2), lambda u: u),
    "complementarity": (complementarity(2), lambda u: np.maximum(u, 0)),
    "relay": (relay(2), lambda u: np.clip(u, -1, 1)),
    "uneven relay": (relay(2, [-0.5, 0], 0.2), lambda u: np.clip(u, [-0.5, 0], 0.2)),
    "box": (box([-INF, -0.3], [0.1, INF]), lambda u: np.clip(u, [-INF, -0.3], [0.1, INF])),
    "point": (box([0.3, -1], [0.3, 1]), lambda u: np.clip(u, [0.3, -1], [0.3, 1])),
    "ball": (ball(2, 2.0), lambda u: project_ball(u, 2.0)),
    "ball of radius 0": (ball(2, 0), lambda u: 0 * u),
    "cone": (second_order_cone(2), project_cone),
    "cone in space": (second_order_cone(3), project_cone),
    "polyhedron": (polyhedron(*SIMPLEX), lambda u: project_polyhedron(u, *SIMPLEX)),
    "product": (
        product(relay(1), complementarity(1), ball(2, 0.5), second_order_cone(3), polyhedron(*SIMPLEX), equality(1)),
        lambda u: np.concatenate([
            np.clip(u[:1], -1, 1), np.maximum(u[1:2], 0), project_ball(u[2:4], 0.5), project_cone(u[4:7]),
            project_polyhedron(u[7:9], *SIMPLEX), u[9:],
        ]),
    ),
}  # fmt: skip


def lure(law, B=None, C=None, D=None, steps=40, h=0.05, n=None):
    """x' = -0.5 x + f(t) + B l, y = C x + D l, with forces that take y through 0 again and again."""
    m = law.size
    n = n or m
    t = ca.SX.sym("t")
    B, C = (np.eye(m) if B is None else B), (np.eye(m) if C is None else C)
    f = ca.vertcat(*(2 * ca.cos((3 + i) * t + i) - 0.7 * (-1) ** i for i in range(n)))
    return LureSystem(
        t=t, A=-0.5 * np.eye(n), B=B, C=C, D=D, f=f, law=law, x0=0.2 * np.cos(np.arange(n)), t_end=steps * h, step=h
    )


def forces(t, n):
    return np.array([2 * np.cos((3 + i) * t + i) - 0.7 * (-1) ** i for i in range(n)])


def first_order(model):
    """The same Lur'e system as a first-order system."""
    l = ca.SX.sym("l", model.law.size)
    return FirstOrderSystem(
        t=model.t, x=model.x, lam=l, f=model.A + model.f, h=model.C @ model.x + model.D @ l, g=model.B @ l, law=model.law,
        x0=model.x0, t_end=model.t_end, step=model.step,
    )  # fmt: skip


@pytest.mark.parametrize("d", [0.0, 0.4])
@pytest.mark.parametrize("name", LAWS)
def test_each_step_is_a_projection_where_the_matrix_is_the_identity(name, d):
    """B = C = 1, D = d: W = h/(1 + h/2) + d times the identity, and l = P_K(-b/W)."""
    law, project = LAWS[name]
    model, h = lure(law, D=d * np.eye(law.size)), 0.05
    W, x, met = h / (1 + h / 2) + d, 0.2 * np.cos(np.arange(law.size)), set()
    run = simulate(model)
    for k in range(40):
        b = (x + h * forces(run.t[k + 1], law.size)) / (1 + h / 2)
        l = project(-b / W)
        x = b + h / (1 + h / 2) * l
        np.testing.assert_allclose(run.multipliers[k + 1], l, atol=1e-10 * (1 + np.abs(l).max()))
        np.testing.assert_allclose(run.x[k + 1], x, atol=1e-11)
        np.testing.assert_allclose(run.y[k + 1], b + W * l, atol=1e-11)
        met.add(tuple(np.abs(run.y[k + 1]) < 1e-11))
    assert len(met) > 1 or name in ("equality", "ball of radius 0") or (name == "cone" and d)
    assert run.residual[1:].max() <= 1e-9


def is_normal(law, l, y):
    """-y ∈ N_K(l) for each block by its definition, to about 1e-9."""
    at = 0
    for block in law.blocks:
        u, v = l[at : at + block.size], y[at : at + block.size]
        at += block.size
        if block.kind == "box":
            lo, up = (np.array(ca.DM(side)).ravel() for side in (block.lower, block.upper))
            good = np.all((u >= lo - 1e-10) & (u <= up + 1e-10))
            good &= np.all((np.abs(v) < 1e-9) | ((v > 0) & (np.abs(u - lo) < 1e-12)) | ((v < 0) & (np.abs(u - up) < 1e-12)))
        elif block.kind == "ball":
            r = float(block.radius)
            good = np.linalg.norm(u) <= r + 1e-10 and u @ v + r * np.linalg.norm(v) < 1e-9
        elif block.kind == "cone":
            good = all(np.linalg.norm(w[1:]) <= w[0] + 1e-9 for w in (u, v)) and abs(u @ v) < 1e-9
        else:
            gap = block.H @ u - block.K
            tight = block.H[gap < 1e-9].T
            good = gap.min() >= -1e-10 and (nnls(tight, v)[1] if tight.size else np.abs(v).max()) < 1e-9
        if not good:
            return False
    return True


@pytest.mark.parametrize("form", [lambda model: model, first_order], ids=["Lur'e", "first order"])
@pytest.mark.parametrize("coupling", ["symmetric", "not symmetric", "D = 0"])
@pytest.mark.parametrize("name", LAWS)
def test_each_step_solves_the_coupled_inclusion(name, coupling, form):
    """Dynamics, output and law, each by its own formula; n > m, full matrices."""
    law, m, h = LAWS[name][0], LAWS[name][0].size, 0.05
    rng = np.random.default_rng(3)
    B = rng.normal(size=(m + 1, m)) / np.sqrt(m)
    S = rng.normal(size=(m, m)) / m
    D = {"symmetric": S @ S.T, "not symmetric": S @ S.T + S - S.T, "D = 0": np.zeros((m, m))}[coupling]
    run = simulate(form(lure(law, B, B.T, D, steps=25, n=m + 1)))
    for k in range(25):
        l, y, x = run.multipliers[k + 1], run.y[k + 1], run.x[k + 1]
        np.testing.assert_allclose(x - run.x[k], h * (-0.5 * x + forces(run.t[k + 1], m + 1) + B @ l), atol=1e-11)
        np.testing.assert_allclose(y, B.T @ x + D @ l, atol=1e-10)
        assert is_normal(law, l, y)


def test_lure_and_first_order_agree_on_a_product_of_everything():
    law = LAWS["product"][0]
    rng = np.random.default_rng(4)
    B, S = rng.normal(size=(law.size + 1, law.size)) / 3, rng.normal(size=(law.size, law.size)) / 6
    model = lure(law, B, B.T, S @ S.T + 0.1 * np.eye(law.size), n=law.size + 1)
    one, two = simulate(model), simulate(first_order(model))
    np.testing.assert_allclose(two.x, one.x, atol=1e-10)


# ---------------------------------------------------------------------------------------------- potentials


class Potential(NamedTuple):
    """Phi(y) for CasADi and for NumPy; +inf outside its domain."""

    symbolic: object
    numeric: object


Q = np.array([[2.0, 1.0], [1.0, 3.0]])
M = np.array([[1.0, 2.0], [-1.0, 1.0]])


def huber(u):
    small = ca.fmin(ca.fabs(u), 0.1)
    return small**2 / 2 + 0.1 * (ca.fabs(u) - small)


def on(condition, value=0.0):
    return np.where(condition, value, INF)


POTENTIALS = {
    "abs": Potential(lambda y: ca.fabs(y[0]) + 2 * ca.fabs(y[1] - 0.1), lambda a, b: abs(a) + 2 * abs(b - 0.1)),
    "weighted sums": Potential(
        lambda y: 0.5 * ca.fabs(y[0] + y[1]) + 0.7 * ca.fabs(y[0]) + 0.1 * ca.fabs(y[0] - y[1]),
        lambda a, b: 0.5 * abs(a + b) + 0.7 * abs(a) + 0.1 * abs(a - b),
    ),
    "fmax": Potential(
        lambda y: ca.fmax(y[0], 0) + ca.fmax(-2 * y[1], y[0]) - ca.fmin(y[1], 0.2),
        lambda a, b: np.maximum(a, 0) + np.maximum(-2 * b, a) - np.minimum(b, 0.2),
    ),
    "norm_1": Potential(ca.norm_1, lambda a, b: abs(a) + abs(b)),
    "norm_inf": Potential(ca.norm_inf, lambda a, b: np.maximum(abs(a), abs(b))),
    "norm_2": Potential(lambda y: 0.8 * ca.norm_2(y), lambda a, b: 0.8 * np.hypot(a, b)),
    "norm_2 affine": Potential(
        lambda y: ca.norm_2(ca.DM(M) @ y - ca.DM([0.1, 0])), lambda a, b: np.hypot(a + 2 * b - 0.1, b - a)
    ),
    "interval": Potential(
        lambda y: ca.if_else(ca.logic_and(y[0] >= -0.1, y[0] <= 0.2), ca.fabs(y[1]), INF),
        lambda a, b: on((a >= -0.1) & (a <= 0.2), abs(b)),
    ),
    "half-plane": Potential(lambda y: ca.if_else(y[0] + y[1] >= -0.1, y[0], INF), lambda a, b: on(a + b >= -0.1, a)),
    "line": Potential(lambda y: ca.if_else(y[0] == y[1], ca.fabs(y[0]), INF), None),
    "disc": Potential(lambda y: ca.if_else(ca.norm_2(y) <= 0.15, 0, INF), lambda a, b: on(np.hypot(a, b) <= 0.15)),
    "parabola": Potential(lambda y: ca.if_else(y[1] >= y[0] ** 2 - 0.1, 0, INF), lambda a, b: on(b >= a**2 - 0.1)),
    "smooth": Potential(
        lambda y: ca.bilin(ca.DM(Q), y, y) / 2 + ca.exp(y[0]), lambda a, b: a * a + a * b + 1.5 * b * b + np.exp(a)
    ),
    "smooth and nonsmooth": Potential(
        lambda y: ca.sumsqr(y) / 2 + ca.log(ca.exp(y[0]) + ca.exp(-y[1])) + ca.fabs(y[1]),
        lambda a, b: (a * a + b * b) / 2 + np.log(np.exp(a) + np.exp(-b)) + abs(b),
    ),
    "Huber": Potential(
        lambda y: huber(y[0]) + huber(y[1] - y[0]),
        lambda a, b: sum(np.where(abs(u) < 0.1, u * u / 2, 0.1 * (abs(u) - 0.05)) for u in (a, b - a)),
    ),
    "powers": Potential(
        lambda y: ca.fabs(y[0]) ** 1.5 + ca.fmax(y[1], 0) ** 2, lambda a, b: abs(a) ** 1.5 + np.maximum(b, 0) ** 2
    ),
    "nested": Potential(
        lambda y: ca.fmax(ca.fabs(y[0]) + y[1], ca.norm_2(y)) + 0.1 * ca.fabs(y[1]),
        lambda a, b: np.maximum(abs(a) + b, np.hypot(a, b)) + 0.1 * abs(b),
    ),
    "squared distance": Potential(
        lambda y: ca.fmax(ca.norm_2(y) - 0.1, 0) ** 2, lambda a, b: np.maximum(np.hypot(a, b) - 0.1, 0) ** 2
    ),
}  # fmt: skip
OUTPUTS = {"D = 0": np.zeros((2, 2)), "D > 0": np.array([[0.3, 0.1], [0.1, 0.2]]), "D psd": np.array([[0.2, 0], [0, 0]])}


def by_phi(phi, D, steps=30, x0=(0.1, 0.1)):
    y, t = ca.SX.sym("y", 2), ca.SX.sym("t")
    f = ca.vertcat(*(2 * ca.cos((3 + i) * t + i) - 0.7 * (-1) ** i for i in range(2)))
    return LureSystem(
        t=t, A=-0.5 * np.eye(2), B=np.eye(2), C=np.eye(2), D=D, f=f, phi=phi(y), y=y, x0=x0, t_end=0.05 * steps, step=0.05
    )


def nelder_mead(cost, start):
    with np.errstate(invalid="ignore"):  # inf - inf outside the domain
        return minimize(cost, start, method="Nelder-Mead", options=TIGHT)


def directions(count, dim, seed=0):
    """Displacements of sizes 1e-5 to 1, all ways."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, dim))
    return d / np.linalg.norm(d, axis=1)[:, None] * 10.0 ** rng.uniform(-5, 0, (count, 1))


AROUND = np.vstack([directions(300, 2), 1e-4 * np.eye(2), -1e-4 * np.eye(2)])


def assert_subgradient(phi, y, slope, error=1e-8):
    """phi(z) >= phi(y) + slope (z - y) for all z, up to ``error`` in the slope; 0 is inside the domain of phi."""
    value = phi(*y)
    if not np.isfinite(value):  # outside by rounding
        value = phi(*(y * (1 - 1e-9)))
    size = np.linalg.norm(AROUND, axis=1)
    gain = phi(*(y + AROUND).T) - value - AROUND @ slope
    assert np.all(gain >= -error * size * (1 + np.linalg.norm(slope)) - 1e-13)


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("name", POTENTIALS)
def test_each_step_by_a_potential_is_its_prox(name, output):
    """W^-1 (y - c) + dPhi(y) ∋ 0, W = h/(1 + h/2) + D: y = argmin |y - c|^2_{W^-1}/2 + Phi(y)."""
    phi, D, h = POTENTIALS[name], OUTPUTS[output], 0.05
    W = h / (1 + h / 2) * np.eye(2) + D
    run = simulate(by_phi(phi.symbolic, D))
    for k in range(30):
        c = (run.x[k] + h * forces(run.t[k + 1], 2)) / (1 + h / 2)
        y, l = run.y[k + 1], run.multipliers[k + 1]
        np.testing.assert_allclose(y, c + W @ l, atol=1e-11)
        np.testing.assert_allclose(y, run.x[k + 1] + D @ l, atol=1e-11)
        if name == "line":  # y = (s, s) with |s|: the normal is (1, -1), free
            assert abs(y[0] - y[1]) < 1e-11
            assert abs(l.sum()) <= 1 + 1e-9
            assert abs(y[0]) < 1e-11 or abs(l.sum() + np.sign(y[0])) < 1e-9
            continue
        assert_subgradient(phi.numeric, y, -l)
        if k % 10 == 0:
            V = np.linalg.inv(W)

            def energy(z, c=c, V=V):
                return (z - c) @ V @ (z - c) / 2 + float(phi.numeric(*z))

            found = nelder_mead(energy, 0.999 * y)
            distance = np.sum((found.x - y) ** 2) * np.linalg.eigvalsh(V)[0] / 2
            assert distance <= found.fun - energy(y * (1 - 1e-9)) + 1e-9  # strong convexity: y is the minimum, found is near
            assert distance < 1e-4


SAME = {
    "relay": (relay(2), ca.norm_1),
    "uneven weights": (relay(2, [-0.3, -2], [0.3, 2]), lambda y: 0.3 * ca.fabs(y[0]) + 2 * ca.fabs(y[1])),
    "box": (box([-1, -0.5], [0, 0]), lambda y: ca.fmax(y[0], 0) + 0.5 * ca.fmax(y[1], 0)),
    "complementarity": (complementarity(2), lambda y: ca.if_else(ca.logic_and(y[0] >= 0, y[1] >= 0), 0, INF)),
    "equality": (equality(2), lambda y: ca.if_else(ca.logic_and(y[0] == 0, y[1] == 0), 0, INF)),
    "ball": (ball(2, 2.0), lambda y: 2 * ca.norm_2(y)),
    "cone": (second_order_cone(2), lambda y: ca.if_else(ca.sqrt(y[1] ** 2) <= y[0], 0, INF)),
    "product": (
        product(relay(1, -0.5, 0.5), complementarity(1)), lambda y: 0.5 * ca.fabs(y[0]) + ca.if_else(y[1] >= 0, 0, INF)
    ),
}  # fmt: skip


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("name", SAME)
def test_the_same_model_by_a_law_and_by_a_potential(name, output):
    law, phi = SAME[name]
    D = OUTPUTS[output]
    one = simulate(lure(law, D=D, steps=60))
    two = simulate(by_phi(phi, D, steps=60, x0=0.2 * np.cos(np.arange(2))))
    np.testing.assert_allclose(two.x, one.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(two.multipliers[1:], one.multipliers[1:], rtol=0, atol=1e-10)
    assert len(np.unique(one.index_set[1:], axis=0)) > 1 or name == "equality"


# ---------------------------------------------------------------------------------------------- SX, MX and SymPy


def declared_by(kind):
    """(symbol, vector of symbols, functions) of a way to write expressions."""
    if kind == "SymPy":
        functions = {"sin": sp.sin, "abs": sp.Abs, "exp": sp.exp, "max": sp.Max, "sqrt": sp.sqrt}
        return sp.Symbol, lambda name, n: list(sp.symbols(f"{name}_0:{n}")), functions
    functions = {"sin": ca.sin, "abs": ca.fabs, "exp": ca.exp, "max": ca.fmax, "sqrt": ca.sqrt}
    cls = getattr(ca, kind)
    return cls.sym, lambda name, n: [cls.sym(f"{name}_{i}") for i in range(n)], functions


def models_of_all_classes(kind):
    symbol, vector, f = declared_by(kind)
    t, s = symbol("t"), symbol("s")
    q, l, y = vector("q", 2), vector("l", 2), vector("y", 1)
    yield SweepingProcess(
        t=t, q=q, f=[f["sin"](t), -q[1]], q0=[-1.1, 0.3], t_end=2, step=0.02,
        constraints={"disc": f["sqrt"](q[0] ** 2 + q[1] ** 2) - 1, "wall": 2 - q[0]},
    )  # fmt: skip
    yield FrictionOscillator(
        x=q, potential=q[0] ** 2 + q[1] ** 4 / 4 + f["abs"](q[0] - q[1]), friction=s + s**3 / 3, s=s, x0=[1, -0.5], v0=[0, 1],
        t_end=2, step=0.02,
    )  # fmt: skip
    yield FirstOrderSystem(
        t=t, x=q, lam=l, f=[-q[0] + f["sin"](3 * t), q[0] - q[1]], h=[q[0] - l[1] / 3, q[1] + l[0] / 3],
        g=[2 * l[0], l[1] * (1 + q[0] ** 2)], law=relay(2), x0=[0.5, -0.5], t_end=2, step=0.02,
    )  # fmt: skip
    yield LureSystem(
        t=t, x=q, A=[q[1], -f["sin"](q[0])], B=[0, 1], C=[0, 1], f=[0, f["exp"](-t)], y=y,
        phi=f["abs"](y[0]) / 2 + f["max"](y[0], 0), x0=[1, 1], t_end=2, step=0.02,
    )  # fmt: skip
    yield MonotoneInclusion(
        x=q, field=[1 - q[0], f["exp"](-q[1])], phi=f["abs"](q[0] - q[1]) / 2, constraints={"disc": 1 - q[0] ** 2 - q[1] ** 2},
        x0=[-0.5, 0.1], t_end=2, step=0.02,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["MX", "SymPy"])
@pytest.mark.parametrize("at", range(5), ids=["sweeping", "oscillator", "first order", "Lur'e", "inclusion"])
def test_the_way_of_writing_a_model_does_not_matter(at, kind):
    one, two = (simulate(list(models_of_all_classes(way))[at]) for way in ("SX", kind))
    np.testing.assert_allclose(two.x, one.x, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(two.index_set, one.index_set)
    assert len(np.unique(one.index_set[1:], axis=0)) > 1


# ---------------------------------------------------------------------------------------------- oscillators


def norm(v):
    return np.linalg.norm(v, axis=0)


class Oscillator(NamedTuple):
    """Arguments of a FrictionOscillator; Phi(v) and g(x) in NumPy on arrays (n, N); the skew part of the friction."""

    arguments: object
    phi: object
    g: object
    skew: object = None


S = ca.SX.sym("s")
X1, X = ca.SX.sym("x"), ca.SX.sym("x", 2)
BOWL = X[0] ** 2 + X[0] * X[1] + X[1] ** 2
OSCILLATORS = {
    "separable": Oscillator(
        {"x": X, "potential": BOWL, "friction": {"a": ([1, 0], 0.3 * S), "b": ([0, 1], 0.5 * S + S**2)}},
        lambda v: 0.3 * abs(v[0]) + 0.5 * abs(v[1]) + v[1] ** 2,
        lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
    ),
    "not square": Oscillator(
        {"x": X, "potential": BOWL, "friction": {"a": ([[1, 1]], 0.3 * S), "b": ([[1, 0], [0, 2], [1, 1]], 0.2 * S)}},
        lambda v: 0.3 * abs(v[0] + v[1]) + 0.2 * norm(np.array([v[0], 2 * v[1], v[0] + v[1]])),
        lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
    ),
    "isotropic": Oscillator(
        {"x": X, "potential": BOWL, "friction": 0.4 * S},
        lambda v: 0.4 * norm(v), lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
    ),
    "isotropic, cubic": Oscillator(
        {"x": X, "potential": BOWL, "friction": 0.3 * S + S**3},
        lambda v: 0.3 * norm(v) + norm(v) ** 3, lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
    ),
    "viscous": Oscillator(
        {"x": X, "potential": BOWL, "friction": S**2}, lambda v: norm(v) ** 2, lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
    ),
    "cosh": Oscillator(
        {"x": X1, "potential": 3 * X1**2, "friction": 0.3 * S + ca.cosh(S) - 1},
        lambda v: 0.3 * abs(v[0]) + np.cosh(v[0]) - 1, lambda x: 3 * x[0] ** 2,
    ),
    "power 3/2": Oscillator(
        {"x": X1, "potential": 3 * X1**2, "friction": 0.3 * S + S**1.5},
        lambda v: 0.3 * abs(v[0]) + abs(v[0]) ** 1.5, lambda x: 3 * x[0] ** 2,
    ),
    "quartic potential": Oscillator(
        {"x": X1, "potential": X1**4 + ca.cosh(X1), "friction": 0.3 * S},
        lambda v: 0.3 * abs(v[0]), lambda x: x[0] ** 4 + np.cosh(x[0]),
    ),
    "quartic and isotropic": Oscillator(
        {"x": X, "potential": ca.sumsqr(X) ** 2 + ca.exp(X[0] - X[1]), "friction": 0.3 * S},
        lambda v: 0.3 * norm(v), lambda x: norm(x) ** 4 + np.exp(x[0] - x[1]),
    ),
    "kinks": Oscillator(
        {"x": X1, "potential": 2 * ca.fabs(X1 - 0.2) + ca.fmax(X1, -0.1) + X1**2, "friction": 0.2 * S},
        lambda v: 0.2 * abs(v[0]), lambda x: 2 * abs(x[0] - 0.2) + np.maximum(x[0], -0.1) + x[0] ** 2,
    ),
    "a cone as potential": Oscillator(
        {"x": X, "potential": 2 * ca.norm_2(X), "friction": 0.3 * S}, lambda v: 0.3 * norm(v), lambda x: 2 * norm(x),
    ),
    "nested kinks": Oscillator(
        {"x": X, "potential": 2 * ca.norm_inf(X) + X[1] ** 2, "friction": 0.2 * S},
        lambda v: 0.2 * norm(v), lambda x: 2 * abs(x).max(axis=0) + x[1] ** 2,
    ),
    "floor by inf": Oscillator(
        {"x": X1, "potential": ca.if_else(X1 >= -0.3, 2 * X1, INF), "friction": 0.2 * S},
        lambda v: 0.2 * abs(v[0]), lambda x: np.where(x[0] >= -0.3, 2 * x[0], INF),
    ),
    "disc by inf": Oscillator(
        {"x": X, "potential": ca.if_else(ca.norm_2(X) <= 1.2, 2 * X[0], INF), "friction": 0.2 * S},
        lambda v: 0.2 * norm(v), lambda x: np.where(norm(x) <= 1.2, 2 * x[0], INF),
    ),
    "floor": Oscillator(
        {"x": X, "potential": X[0] ** 2 + 2 * X[1], "friction": 0.2 * S, "constraints": {"floor": X[1] + 0.3}},
        lambda v: 0.2 * norm(v), lambda x: np.where(x[1] >= -0.3, x[0] ** 2 + 2 * x[1], INF),
    ),
    "round wall": Oscillator(
        {"x": X, "potential": 2 * X[0], "friction": {"a": ([1, 0], 0.2 * S)}, "constraints": {"wall": 1.44 - ca.sumsqr(X)}},
        lambda v: 0.2 * abs(v[0]), lambda x: np.where(norm(x) <= 1.2, 2 * x[0], INF),
    ),
    "skew damping": Oscillator(
        {"x": X, "potential": BOWL, "friction": 0.3 * S, "damping": [[0.1, 3], [-3, 0]]},
        lambda v: 0.3 * norm(v), lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2, np.array([[0.1, 3], [-3, 0]]),
    ),
    "no friction": Oscillator({"x": X, "potential": BOWL}, lambda v: 0 * v[0], lambda x: x[0] ** 2 + x[0] * x[1] + x[1] ** 2),
}  # fmt: skip


def oscillator(name, steps=60, h=0.05, **options):
    arguments = dict(OSCILLATORS[name].arguments)
    n = arguments["x"].numel()
    if "friction" in arguments:
        arguments["s"] = S
    start = {"x0": [1.0, -0.2][:n], "v0": [0.5, 0.7][:n], "t_end": h * steps, "step": h}
    return FrictionOscillator(**arguments, **(start | options))


@pytest.mark.parametrize("name", OSCILLATORS)
def test_each_step_of_an_oscillator_minimises(name):
    """v = argmin |v - w|^2/2 + h Phi(v) + g(x + h v); with a damping matrix (w - v)/h - M v ∈ dPhi(v) + dg(x + h v)."""
    case, h = OSCILLATORS[name], 0.05
    run = simulate(oscillator(name))
    n = run.x.shape[1]
    around = directions(300, n, seed=1)
    size = np.linalg.norm(around, axis=1)
    for k in range(60):
        x, w, v = run.x[k], run.v[k], run.v[k + 1]
        np.testing.assert_allclose(run.x[k + 1], x + h * v, atol=1e-14 * (1 + np.abs(x).max()))
        slope = (w - v) / h - (0 if case.skew is None else case.skew @ v)

        def cost(z, x=x, case=case):
            """Phi(z) + g(x + h z)/h at velocities (n, N); a distance of rounding outside the domain of g is inside."""
            at = x[:, None] + h * z
            value = case.g(at)
            out = ~np.isfinite(value)
            if out.any():
                inner = np.zeros(n)
                value = np.where(out, case.g(inner[:, None] + (at - inner[:, None]) * (1 - 1e-13)), value)
            return case.phi(z) + value / h

        gain = cost((v + around).T) - cost(v[:, None])[0] - around @ slope
        assert np.all(gain >= -1e-8 * size * (1 + np.linalg.norm(slope)) - 1e-10)
        if case.skew is None and k % 20 == 5:

            def energy(z, w=w, cost=cost):
                return np.sum((z - w) ** 2) / 2 + h * cost(np.asarray(z)[:, None])[0]

            found = nelder_mead(energy, v + 1e-4)
            if np.isfinite(found.fun):
                distance = np.sum((found.x - v) ** 2) / 2
                assert distance <= found.fun - energy(v) + 1e-12  # strong convexity: v is the minimum, found is near
                assert distance < 1e-6


STICKING = (
    "separable", "not square", "isotropic", "isotropic, cubic", "cosh", "quartic potential", "quartic and isotropic", "kinks",
    "floor", "skew damping",
)  # fmt: skip


@pytest.mark.parametrize("name", STICKING)
def test_stick_is_a_velocity_of_exactly_zero(name):
    run = simulate(oscillator(name, steps=600))
    assert np.all(run.v[-1] == 0)
    assert np.all(run.x[-1] == run.x[-2])
    still = np.all(run.v == 0, axis=1)
    assert still.sum() > 10


def test_stick_in_the_plane_is_left_again_and_exact():
    """Isotropic friction holds the mass while the potential's slope is below theta'(0): compare with that test itself."""
    model = oscillator("isotropic", steps=300)
    run = simulate(model)
    for k in range(300):
        x, w, v = run.x[k], run.v[k], run.v[k + 1]
        push = w / 0.05 - np.array([2 * x[0] + x[1], x[0] + 2 * x[1]])
        if abs(np.linalg.norm(push) - 0.4) > 1e-9:
            assert np.all(v == 0) == (np.linalg.norm(push) <= 0.4)


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e6, 1e9])
@pytest.mark.parametrize("name", ["isotropic, cubic", "cosh", "power 3/2"])
def test_friction_laws_that_are_not_quadratic_do_not_depend_on_the_unit_of_length(name, unit):
    """x = unit x~, v = unit v~: theta(s) = unit^2 theta~(s / unit), g(x) = unit^2 g~(x / unit)."""
    reference = simulate(oscillator(name))
    arguments = dict(OSCILLATORS[name].arguments)
    x = arguments["x"]
    arguments["potential"] = unit**2 * ca.substitute(ca.SX(arguments["potential"]), x, x / unit)
    arguments["friction"] = unit**2 * ca.substitute(arguments["friction"], S, S / unit)
    n = x.numel()
    start = {"x0": unit * np.array([1.0, -0.2][:n]), "v0": unit * np.array([0.5, 0.7][:n]), "t_end": 3, "step": 0.05}
    run = simulate(FrictionOscillator(**arguments, s=S, **start))
    np.testing.assert_allclose(run.x / unit, reference.x, atol=1e-9)
    np.testing.assert_array_equal(run.v == 0, reference.v == 0)


def test_a_start_outside_the_domain_of_the_potential_is_refused():
    with pytest.raises(UsageError, match="outside"):
        simulate(oscillator("floor by inf", x0=[-0.4]))


def test_the_energy_is_finite_on_the_boundary_of_the_domain():
    run = simulate(oscillator("floor by inf", steps=200))
    assert np.any(run.index_set == 0)
    assert run.x[-1, 0] == pytest.approx(-0.3, abs=1e-14)
    assert np.isfinite(run.energy).all()


# ---------------------------------------------------------------------------------------------- projections on smooth sets


def two_discs_projection(u, centres=((-0.5, 0), (0.5, 0)), r=1.0):
    """The nearest point of the intersection of two discs: u, a foot on one circle inside the other disc, or a corner."""
    centres = np.array(centres)
    feet = [c + (u - c) * min(1, r / max(np.linalg.norm(u - c), 1e-300)) for c in centres]
    corners = [np.array([0, s * np.sqrt(r**2 - 0.25)]) for s in (1, -1)]
    candidates = [p for p in [u, *feet, *corners] if all(np.linalg.norm(p - c) <= r + 1e-12 for c in centres)]
    return min(candidates, key=lambda p: np.linalg.norm(p - u))


def ellipse_projection(u):
    """The nearest point of x^2/4 + y^2 <= 1."""
    if u[0] ** 2 / 4 + u[1] ** 2 <= 1:
        return u

    def at(mu):
        return u / (1 + mu * np.array([0.25, 1.0]))

    return at(brentq(lambda mu: at(mu)[0] ** 2 / 4 + at(mu)[1] ** 2 - 1, 0, 1e6, xtol=1e-15, rtol=1e-15))


SETS = {
    "disc": ({"disc": 1 - ca.sumsqr(X)}, lambda u: project_ball(u, 1.0), [0.3, 0.2]),
    "two discs": (
        {"a": 1 - ca.sumsqr(X + ca.DM([0.5, 0])), "b": 1 - ca.sumsqr(X - ca.DM([0.5, 0]))},
        two_discs_projection,
        [0.3, 0.2],
    ),
    "ellipse": ({"ellipse": 1 - X[0] ** 2 / 4 - X[1] ** 2}, ellipse_projection, [1.0, 0.2]),
}
FIELD = [2 * X[1] + 1, 1 - 2 * X[0] + ca.sin(3 * X[1])]


@pytest.mark.parametrize("tolerances", [None, 1e-4, lambda mu: mu**3, [1e-3 / (k + 1) for k in range(100)]])
@pytest.mark.parametrize("name", SETS)
def test_catching_up_on_smooth_sets(name, tolerances):
    constraints, project, x0 = SETS[name]
    model = MonotoneInclusion(
        x=X, field=FIELD, constraints=constraints, x0=x0, t_end=3, steps=[0.03] * 100, tolerances=tolerances
    )
    run = simulate(model)
    c = ca.vertcat(*constraints.values())
    inside, slopes = ca.Function("c", [X], [c]), ca.Function("J", [X], [ca.densify(ca.jacobian(c, X))])
    field = ca.Function("f", [X], [ca.vertcat(*FIELD)])
    eps = np.zeros(100) if tolerances is None else np.broadcast_to(tolerances(0.03) if callable(tolerances) else tolerances, 100)
    touched = used = 0
    for k in range(100):
        y = run.x[k] + 0.03 * np.array(field(run.x[k])).ravel()
        exact = project(y)
        d2 = np.sum((exact - y) ** 2)
        x = run.x[k + 1]
        assert float(ca.mmin(inside(x))) >= (-1e-12 if tolerances is None else 0)
        if tolerances is None:
            np.testing.assert_allclose(x, exact, atol=1e-12)
            np.testing.assert_allclose(x - y, np.array(slopes(x)).T @ run.multipliers[k + 1], atol=1e-12)
            assert run.multipliers[k + 1].min() >= 0
        else:
            assert np.sum((x - y) ** 2) < d2 + eps[k]
            assert run.excess[k + 1] < eps[k]
        used += not np.allclose(x, exact, rtol=0, atol=1e-9)
        touched += d2 > 0
        np.testing.assert_allclose(run.defect[k + 1], x - y, atol=1e-14)
        assert run.predictor_distance[k + 1] == pytest.approx(np.sqrt(d2), abs=1e-7 if tolerances is None else np.sqrt(eps[k]))
    assert touched > 20
    assert not used or tolerances is not None
    assert used or tolerances is None or name == "disc"  # a disc's cut is exact in the direction of its centre


@pytest.mark.parametrize("tolerances", [None, 1e-4])
def test_catching_up_on_a_box(tolerances):
    model = MonotoneInclusion(
        x=X, field=FIELD, lower=[-0.5, -INF], upper=[0.8, 0.6], x0=[0.3, 0.2], t_end=3, step=0.03, tolerances=tolerances
    )
    run = simulate(model)
    field = ca.Function("f", [X], [ca.vertcat(*FIELD)])
    for k in range(100):
        y = run.x[k] + 0.03 * np.array(field(run.x[k])).ravel()
        exact = np.clip(y, [-0.5, -INF], [0.8, 0.6])
        assert np.all((run.x[k + 1] >= [-0.5, -INF]) & (run.x[k + 1] <= [0.8, 0.6]))
        if tolerances is None:
            np.testing.assert_allclose(run.x[k + 1], exact, atol=1e-15)
        else:
            assert np.sum((run.x[k + 1] - y) ** 2) < np.sum((exact - y) ** 2) + tolerances


def test_domains_of_potentials_bound_an_inclusion():
    """phi = |x_0| + indicator of the unit disc, and of a half-plane: the same C as by constraints."""
    phi = ca.fabs(X[0]) + ca.if_else(ca.norm_2(X) <= 1, 0, INF)
    common = {"x": X, "field": FIELD, "x0": [0.3, 0.2], "t_end": 3, "step": 0.03}
    by_phi = simulate(MonotoneInclusion(phi=phi, **common))
    by_constraint = simulate(MonotoneInclusion(phi=ca.fabs(X[0]), constraints={"disc": 1 - ca.sumsqr(X)}, **common))
    np.testing.assert_allclose(by_phi.x, by_constraint.x, atol=1e-11)
    assert np.any(np.abs(np.linalg.norm(by_phi.x, axis=1) - 1) < 1e-12)
    with pytest.raises(ModelError, match="interior"):
        MonotoneInclusion(phi=ca.if_else(X[0] == 0, 0, INF), **common)
