"""Each kind of curved set by its definition: nearest points by SciPy, derivatives by differences, the graph by samples."""

from __future__ import annotations

import shutil
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    ModelError,
    MonotoneInclusion,
    ball,
    box,
    check,
    complementarity,
    coulomb,
    ellipsoid,
    polyhedron,
    product,
    second_order_cone,
    simulate,
)
from nsmodel.codegen import write
from nsmodel.errors import CodegenError
from nsmodel.hypotheses.equations import model_equations
from nsmodel.modeling.laws import FACTOR_KINDS, BallSet, ConeSet, EllipsoidSet, Law
from nsmodel.plot.strips import index_strip
from nsmodel.study.reference_steps import formula_residuals

RADIUS = 0.75


def sets(m):
    rng = np.random.default_rng(m)
    axes = np.linalg.qr(rng.normal(size=(m, m)))[0]
    return [
        BallSet(RADIUS),
        ConeSet(),
        EllipsoidSet(np.geomspace(0.2, 5, m), axes),
        EllipsoidSet(np.geomspace(1e-2, 1e2, m), axes),
    ]


def room(K, l):
    """At least 0 inside K, from the formulas of the sets."""
    if K.kind == "ball":
        return RADIUS**2 - l @ l
    if K.kind == "cone":
        return l[0] - np.sqrt(l[1:] @ l[1:] + 1e-18)
    return 1 - K.d @ (K.V.T @ l) ** 2


def inside(K, l):
    return room(K, l) > -1e-8


@pytest.mark.parametrize("m", [2, 3, 5])
def test_projections_are_nearest_points_with_their_derivative(m):
    rng = np.random.default_rng(m)
    for K in sets(m):
        for _ in range(40):
            u = rng.normal(size=m) * rng.choice([0.3, 2.0])
            p = K.project(u)
            assert inside(K, p)
            row = {"type": "ineq", "fun": lambda l, K=K: room(K, l)}
            best = minimize(lambda l, u=u: (l - u) @ (l - u), p + 1e-3, constraints=row, tol=1e-12)
            outside = max(0.0, -room(K, best.x))  # By which the other is nearer because it is not in K.
            assert np.linalg.norm(p - u) <= np.sqrt(best.fun) + outside + 1e-6
            d = 1e-6 * rng.normal(size=m)
            if K.code(u + d) == K.code(u - d):
                slope = (K.project(u + d) - K.project(u - d)) / 2
                assert np.abs(slope - K.jacobian(u) @ d).max() < 1e-11


@pytest.mark.parametrize("m", [2, 3])
def test_points_of_the_graph_have_no_gap_and_others_do(m):
    rng = np.random.default_rng(10 + m)
    for K in sets(m):
        l, y = ca.SX.sym("l", m), ca.SX.sym("y", m)
        gap, rows = K.complementarity(l, y, 0.0)
        f = ca.Function("f", [l, y], [gap, ca.vertcat(*rows)])
        for _ in range(40):
            u = 2 * rng.normal(size=m)
            p = K.project(u)  # by Minty (p, p - u) is on the graph
            value, held = (np.array(part).ravel() for part in f(p, p - u))
            assert abs(value[0]) < 1e-12
            assert held.min() > -1e-12
            other = p - u + 0.1 * rng.normal(size=m)
            value, held = (np.array(part).ravel() for part in f(p, other))
            on_graph = np.linalg.norm(p - K.project(p - other)) < 1e-9
            assert on_graph == (abs(value[0]) < 1e-12 and held.min() > -1e-12)
            code = K.code(u)
            assert np.abs(p - u).max() == 0 if code == 0 else not p.any() if code < 0 else np.allclose(K.onto_boundary(p), p)
            if K.is_bounded:
                y_away = rng.normal(size=m)
                chosen = K.support_point(y_away)
                samples = rng.normal(size=(200, m))
                samples = np.array([K.onto_boundary(l) for l in samples])
                assert all(inside(K, l) for l in samples)
                assert y_away @ chosen <= (samples @ y_away).min() + 1e-12


def test_an_unknown_kind_is_refused():
    with pytest.raises(ModelError, match="law: 'ellipse' is not a set of a known kind"):
        Law(("ellipse",))


# ------------------------------------------------------------------------------------------------ every kind, everywhere


EXAMPLES = {
    "box": box([-1, 0], [1, 0.3]),
    "ball": ball(2, 0.4),
    "cone": second_order_cone(2),
    "polyhedron": polyhedron([[1, 0], [0, 1], [-1, -1]], [-0.5, -0.5, -0.5]),
    "ellipsoid": ellipsoid([[25, 4], [4, 9]]),
    "coulomb": coulomb(0.6),
}


def moved_by(law, **given):
    """Two masses that the law brakes; a law that is no normal cone in the class that takes it."""
    t = ca.SX.sym("t")
    eye = np.eye(2)
    if not law.is_normal_cone:
        x, l = ca.SX.sym("v", 2), ca.SX.sym("l", 2)
        f = ca.vertcat(0.6 * ca.sin(3 * t), 0.2) - 0.3 * x
        return FirstOrderSystem(t=t, x=x, lam=l, f=f, g=l, h=x + 0.1 * l, law=law, x0=[1.0, 0.7], t_end=3, step=0.02)
    arguments = {"t": t, "A": -0.3 * eye, "B": eye, "C": eye, "D": 0.1 * eye, "law": law, "x0": [1.0, 0.7],
                 "f": ca.vertcat(0.6 * ca.sin(3 * t), 0.2), "t_end": 3, "step": 0.02}  # fmt: skip
    return LureSystem(**(arguments | given))


def test_each_kind_has_an_example():
    assert set(EXAMPLES) == set(FACTOR_KINDS)


@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_kind_is_run_checked_judged_drawn_and_written(kind):
    law = EXAMPLES[kind]
    model = moved_by(law)
    run = simulate(model)
    assert formula_residuals(model, run)["law"] < 1
    off = replace(run, arrays={**run.arrays, "multipliers": run.arrays["multipliers"] + [1e-3, -2e-3]})
    assert formula_residuals(model, off)["law"] > 1
    report = check(model, runs=[run])
    if law.is_normal_cone:
        assert [finding.verdict for finding in report.findings if finding.id in ("3.1", "5.4a", "5.x0")] == ["holds"] * 3
    assert "lambda" in str(model_equations(model))
    if kind != "polyhedron":
        assert index_strip(run).get_legend() is not None


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_kind_in_c_is_the_interpreted_one(kind):
    model = moved_by(EXAMPLES[kind])
    here, there = simulate(model), simulate(model, compiled=True)
    np.testing.assert_allclose(there.x, here.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(there.multipliers[1:], here.multipliers[1:], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(there.index_set[1:], here.index_set[1:])


# ------------------------------------------------------------------------------------------------ ellipsoids


def friction(v, Q):
    """-Q^-1 v / sqrt(v'Q^-1 v)."""
    w = np.linalg.solve(Q, v)
    return -w / np.sqrt(v @ w)


def test_a_puck_slides_as_the_ode_does():
    """v' = f - Q^-1 v / sqrt(v'Q^-1 v) until it stops, by an ODE solver; the scheme has order one."""
    Q = np.array([[25.0, 4.0], [4.0, 9.0]])
    puck = {"A": np.zeros((2, 2)), "D": np.zeros((2, 2)), "f": np.array([0.05, 0.0]), "law": ellipsoid(Q), "x0": [1.0, 0.7],
            "t": None, "t_end": 1.0}  # fmt: skip
    true = solve_ivp(lambda _, v: np.array([0.05, 0]) + friction(v, Q), (0, 1), [1.0, 0.7], "DOP853", rtol=1e-12, atol=1e-13).y[
        :, -1
    ]
    errors = [np.abs(simulate(moved_by(**puck, step=h)).x[-1] - true).max() for h in (0.02, 0.01, 0.005)]
    assert errors[0] < 5e-3
    assert 1.8 < errors[0] / errors[1] < 2.2
    assert 1.8 < errors[1] / errors[2] < 2.2


def test_a_puck_sticks_inside_the_ellipse_and_slips_outside():
    Q = np.diag([1 / 0.2**2, 1 / 0.6**2])
    still = {"A": np.zeros((2, 2)), "D": np.zeros((2, 2)), "law": ellipsoid(Q), "x0": [0.0, 0.0], "t": None, "t_end": 1.0}
    for force in ([0.19, 0.0], [0.0, 0.59], [0.14, 0.41]):
        run = simulate(moved_by(**still, f=np.array(force)))
        assert not run.x.any()
        np.testing.assert_allclose(run.multipliers[-1], [-f for f in force], atol=1e-15)
    for force in ([0.21, 0.0], [0.0, 0.61], [0.15, 0.43]):
        run = simulate(moved_by(**still, f=np.array(force)))
        assert np.abs(run.x[-1]).max() > 1e-3
        assert run.multipliers[-1] @ Q @ run.multipliers[-1] == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("condition", [1.0, 1e4, 1e8])
def test_random_ellipsoids_are_solved_to_rounding(condition, compiled):
    """-y ∈ N(l) at each row by its formula, with Q of the condition number, in random directions.

    The entries of Q are rounded, which moves its least eigenvalue by EPS times the condition.
    """
    if compiled and shutil.which("gcc") is None:
        pytest.skip("no C compiler")
    rng = np.random.default_rng(int(np.log10(condition)))
    for m in (2, 3, 5):
        axes, d = np.linalg.qr(rng.normal(size=(m, m)))[0], np.geomspace(condition**-0.5, condition**0.5, m)
        Q = axes @ np.diag(d) @ axes.T
        t, A = ca.SX.sym("t"), rng.normal(size=(m, m))
        f = ca.DM(rng.normal(size=m)) * ca.sin(2 * t) * 3
        model = LureSystem(t=t, A=A - A.T - np.eye(m), B=np.eye(m), C=np.eye(m), f=f, law=ellipsoid(Q), x0=rng.normal(size=m),
                           t_end=2, step=0.02)  # fmt: skip
        run = simulate(model, compiled=compiled)
        assert (run.index_set[1:] == 1).any()
        for l, y in zip(run.multipliers[1:], run.y[1:], strict=True):
            size = np.linalg.norm(np.sqrt(d) * (axes.T @ l))
            assert abs(size - 1) <= 1e-12 + np.finfo(float).eps * condition or size < 1
            if size < 1 - 1e-7:
                assert not y.any()
            elif np.linalg.norm(y) > 1e-6:
                v = axes.T @ y / np.sqrt(d)
                np.testing.assert_allclose(np.sqrt(d) * (axes.T @ l), -v / np.linalg.norm(v), atol=1e-7 * condition**0.25)


def test_an_ellipse_of_equal_axes_is_a_ball():
    one, other = simulate(moved_by(ball(2, 0.4))), simulate(moved_by(ellipsoid(np.eye(2) / 0.16)))
    np.testing.assert_allclose(one.x, other.x, atol=1e-13)
    np.testing.assert_array_equal(one.index_set, other.index_set)


def test_an_ellipsoid_of_one_component_is_a_relay():
    law = ellipsoid(4)
    assert [block.label for block in law.blocks] == ["relay"]
    assert float(law.upper) == 0.5


def test_a_product_with_complementarity_couples_through_D():
    """Rows that D couples need the exact shape: pivots with rational roots have it, others leave the question open."""
    D = np.array([[1.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    for Q, known in ((np.diag([4.0, 0.25]), True), (np.diag([2.0, 3.0]), False)):
        law = product(ellipsoid(Q), complementarity(1))
        model = LureSystem(A=-np.eye(3), B=np.eye(3), C=np.eye(3), D=D, law=law, x0=[0.1, 0.1, 1], t_end=1, step=0.1)
        verdicts = {finding.id: finding.verdict for finding in check(model, ()).findings}
        assert (verdicts["5.4a"] == "holds") == known or verdicts["5.4a"] == "unknown"


@pytest.mark.parametrize(
    ("Q", "why"),
    [
        ([[1, 2], [0, 1]], r"not symmetric: Q\[0, 1\] = 2, Q\[1, 0\] = 0"),
        ([[1, 2], [2, 1]], "not positive definite: its least eigenvalue is -1"),
        ([[1, 0]], r"Q has the shape \(1, 2\); expected \(m, m\)"),
        ([[np.inf, 0], [0, 1]], "Q must be finite"),
        ("a", "Q = 'a'; expected numbers"),
        (ca.SX.sym("q", 2, 2), "expected numbers"),
    ],
)
def test_what_is_no_ellipsoid_is_refused(Q, why):
    with pytest.raises(ModelError, match=why):
        ellipsoid(Q)


def test_a_parameter_that_is_the_radius_of_a_selection_is_refused_in_c(tmp_path):
    """phi = mu |x|: its ball is written down as a number, so that setting mu later would change half of the model."""
    x, mu = ca.SX.sym("x", 2), ca.SX.sym("mu")
    model = MonotoneInclusion(x=x, field=1 - x, phi=mu * ca.norm_2(x), x0=[0, 0], t_end=1, step=0.1, parameters={mu: 0.5})
    with pytest.raises(CodegenError, match="parameter 'mu' bounds the set or the operator"):
        write(model, tmp_path)
    write(model, tmp_path, parameters={"mu": 0.3})
