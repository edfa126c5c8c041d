"""Each kind of curved set by its definition: nearest points by SciPy, derivatives by differences, the graph by samples."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from nsmodel import ModelError
from nsmodel.laws import BallSet, ConeSet, Law

RADIUS = 0.75


def sets(m):
    return [BallSet(RADIUS), ConeSet()]


def inside(K, l):
    """Whether l is in K, from the formulas of the two sets."""
    return np.linalg.norm(l) <= RADIUS + 1e-9 if K.kind == "ball" else np.linalg.norm(l[1:]) <= l[0] + 1e-9


@pytest.mark.parametrize("m", [2, 3, 5])
def test_projections_are_nearest_points_with_their_derivative(m):
    rng = np.random.default_rng(m)
    for K in sets(m):
        for _ in range(40):
            u = rng.normal(size=m) * rng.choice([0.3, 2.0])
            p = K.project(u)
            assert inside(K, p)
            row = (lambda l: RADIUS**2 - l @ l) if K.kind == "ball" else (lambda l: l[0] - np.sqrt(l[1:] @ l[1:] + 1e-18))
            best = minimize(lambda l, u=u: (l - u) @ (l - u), p + 1e-3, constraints={"type": "ineq", "fun": row}, tol=1e-12)
            assert np.linalg.norm(p - u) <= np.sqrt(best.fun) + 1e-6
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
                chosen = K.selected(y_away)
                samples = rng.normal(size=(200, m))
                samples *= RADIUS / np.linalg.norm(samples, axis=1)[:, None]
                assert y_away @ chosen <= (samples @ y_away).min() + 1e-12


def test_an_unknown_kind_is_refused():
    with pytest.raises(ModelError, match="law: 'ellipse' is no set of a known kind"):
        Law(("ellipse",))
