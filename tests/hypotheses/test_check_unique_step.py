"""F-unique against solutions that are counted, and witnesses against the residual of the step, written out here."""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import FirstOrderSystem, ball, box, check, complementarity, polyhedron, relay, second_order_cone
from nsmodel import product as side_by_side

X, L = ca.SX.sym("x", 2), ca.SX.sym("l", 2)


def unique(model):
    return check(model, runs=[])["F-unique"]


def system(f, g, h, law, x=X, l=L, **given):
    return FirstOrderSystem(x=x, lam=l, f=f, g=g, h=h, law=law, **{"x0": np.zeros(x.numel()), "t_end": 1, "step": 0.1, **given})


def off_the_law(law, l, y):
    """How far l is from the projection of l - y on K: 0 where -y ∈ N_K(l)."""
    place, worst = 0, 0.0
    for block in law.blocks:
        own = slice(place, place + block.size)
        p, place = l[own] - y[own], place + block.size
        if block.kind == "box":
            q = np.clip(p, np.array(ca.DM(block.lower)).ravel(), np.array(ca.DM(block.upper)).ravel())
        elif block.kind == "ball":
            q = p * min(1.0, float(block.radius) / max(np.linalg.norm(p), 1e-300))
        elif block.kind == "cone":
            size = np.linalg.norm(p[1:])
            part = max((p[0] + size) / 2, 0.0)
            q = p if size <= p[0] else 0 * p if size <= -p[0] else part * np.r_[1.0, p[1:] / size]
        else:
            q = _on_polyhedron(block.H, block.K, p)
        worst = max(worst, np.abs(q - l[own]).max())
    return worst


def _on_polyhedron(H, K, p):
    """The nearest point of {H l >= K}, by all subsets of its faces."""
    best = None
    for chosen in product((False, True), repeat=len(K)):
        A, c = H[list(chosen)], K[list(chosen)]
        q = p + np.linalg.lstsq(A, c - A @ p, rcond=None)[0] if len(c) else p
        if (H @ q >= K - 1e-9).all() and (best is None or np.linalg.norm(q - p) < np.linalg.norm(best - p)):
            best = q
    return best


def assert_two_steps(model, witness):
    """Both solve E = 0 and the law, from the same state, and their x differ."""
    f, g, h = (ca.Function("value", [model.t, model.x, model.lam], [e]) for e in (model.f, model.g, model.h))
    step, theta, gamma = witness["h"], model.theta, model.gamma
    x_k, t = np.array(witness["x_k"]), witness["t"]
    r_k = np.array(witness["r_k"]) if "r_k" in witness else 0 * x_k
    zero = np.zeros(model.law.size)
    assert np.abs(np.array(witness["x"]) - witness["other x"]).max() > 1e-9 * np.abs(x_k).max()
    for x, l in ((witness["x"], witness["l"]), (witness["other x"], witness["other l"])):
        x, l = np.array(x), np.array(l)
        smooth = theta * f(t + step, x, l) + (1 - theta) * f(t, x_k, zero)
        E = (
            np.array(ca.DM(model.M)) @ (x - x_k)
            - step * np.array(smooth + gamma * g(t + step, x, l)).ravel()
            - step * (1 - gamma) * r_k
        )
        y = np.array(h(t + step, x, l)).ravel()
        assert np.abs(E).max() < 1e-9 * (1 + np.abs(x_k).max())
        assert off_the_law(model.law, l, y) < 1e-8 * (1 + np.abs(y).max() + np.abs(l).max())


SKEWED = ca.DM([[1.0, -6.0], [0.0, 1.0]])  # a P-matrix with v'Dv < 0
LAWS = [
    ball(2),
    ball(2, 0.7),
    second_order_cone(2),
    polyhedron([[1, 0], [0, 1], [-1, -1]], [0, 0, -1]),
    relay(2),
    complementarity(2),
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.blocks[0].label)
def test_a_p_matrix_is_enough_for_boxes_only(law):
    model = system(-X, 0.01 * L, X + SKEWED @ L, law)
    finding = unique(model)
    if law.blocks[0].kind in ("box", "polyhedron"):  # The edge (1, -1) of the triangle has v'Dv > 0, as the others.
        assert finding.verdict == "holds"
        return
    # Between the sphere with normal u and the inside two solutions exist where u'W^-1 u < 0.
    assert finding.verdict == "violated"
    assert_two_steps(model, finding.witness)


def test_a_triangle_with_an_edge_of_the_wrong_sign():
    model = system(-X, 0.01 * L, X + ca.DM([[1.0, 6.0], [0.0, 1.0]]) @ L, LAWS[3])
    finding = unique(model)
    assert finding.verdict == "violated"
    assert_two_steps(model, finding.witness)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.blocks[0].label)
def test_a_definite_matrix_is_enough_for_every_law(law):
    assert unique(system(-X, 0.01 * L, X + ca.DM([[1.0, -1.0], [0.5, 1.0]]) @ L, law)).verdict == "holds"


@pytest.mark.parametrize("seed", range(6))
def test_witnesses_of_random_curved_and_nonlinear_steps(seed):
    rng, seen = np.random.default_rng(seed), set()
    for k in range(4):
        law = (*LAWS, side_by_side(relay(1), ball(2)))[rng.integers(7)]
        m = law.size
        l, x = ca.SX.sym("l", m), ca.SX.sym("x", m)
        B, C, D = (rng.integers(-2, 3, (m, m)) * 1.0 for _ in range(3))
        bend = (x[0] ** 2, ca.sin(x[1]), x[0] * x[1])[rng.integers(3)] if k % 2 else 0 * x[0]
        theta, gamma = ((1.0, 1.0), (0.5, 1.0), (0.5, 0.5))[rng.integers(3)]
        model = system(
            -x + bend, ca.DM(B) @ l * (1 + (k % 3 == 0) * x[0] ** 2), ca.DM(C) @ x + ca.DM(D) @ l, law, x, l,
            theta=theta, gamma=gamma, x0=rng.integers(-1, 2, m) * 0.3,
        )  # fmt: skip
        finding = unique(model)
        seen.add(finding.verdict)
        if finding.verdict == "violated" and "other x" in finding.witness:
            assert_two_steps(model.bind(), finding.witness)
    assert "violated" in seen


def test_rounding_alone_gives_no_second_solution():
    # D_11 = -1e-17 is rounding of 0: far away l = 1e17 x solves the step, too.
    model = system(-X, 0.1 * L, X + ca.DM([[-1e-17, 0.0], [0.0, 1.0]]) @ L, box([0, 0], [1, 1]), x0=[1.0, 1.0])
    assert unique(model).verdict == "holds"  # W_11 = 0.01 / 1.1 - 1e-17


# -- one multiplier after the other is a function of one state: solutions are counted on a grid -----------------------------


def counted(f, beta, s, B, C, D, law, x_k, h, low, high):
    """Sign changes of E(x), l_i = -y_i / D_ii cut at its bounds; a jump of l across 0 = y is filled by the law."""
    x = np.linspace(low, high, 200001)
    lower, upper = (np.array(ca.DM(end)).ravel() for end in (law.lower, law.upper))
    y = np.outer(C, np.array(s(x)).ravel())
    l = np.where(D[:, None] > 0, -y / np.where(D > 0, D, 1.0)[:, None], np.where(y > 0, -np.inf, np.inf))
    E = x - x_k - h * f(x) - h * np.array(beta(x)).ravel() * (B @ np.clip(l, lower[:, None], upper[:, None]))
    return int((np.sign(E[:-1]) * np.sign(E[1:]) < 0).sum())


SHAPES = [(lambda x: 1 + x**2), (lambda x: 2 + ca.tanh(x)), (lambda x: 1 + 0 * x)]
OUTPUTS = [(lambda x: x + x**3), (lambda x: x + 0 * x), (lambda x: ca.sin(2 * x) + x / 2)]


@pytest.mark.parametrize("seed", range(8))
def test_one_state_and_two_relays_by_counting(seed):
    rng, seen = np.random.default_rng(seed), []
    x, l = ca.SX.sym("x"), ca.SX.sym("l", 2)
    for _ in range(share(12, 4)):
        beta, s = SHAPES[rng.integers(3)], OUTPUTS[rng.integers(3)]
        B, D = rng.integers(-2, 3, 2) * 1.0, rng.choice([0.0, 0.0, 1.0], 2)
        C = (B, B, -B, rng.integers(-2, 3, 2) * 1.0)[rng.integers(4)]
        a, law, start = rng.normal(), relay(2), rng.choice([-1.0, 0.0, 0.1, 0.7])
        given = beta(x) * ca.dot(ca.DM(B), l), ca.DM(C) * s(x) + ca.DM(D) * l
        model = system(a * x + ca.sin(x), *given, law, x, l, x0=[start])
        finding = unique(model)
        seen.append(finding.verdict)
        if finding.verdict == "violated":
            assert_two_steps(model.bind(), finding.witness)
        if finding.verdict != "holds":
            continue
        low, high = (-2.0, 2.0) if finding.scope is None or not finding.scope.states else finding.scope.states["x"]
        for x_k in rng.uniform(low, high, 8):
            reach = 0.1 * (abs(a) * 3 + 1 + np.abs(B).sum() * (1 + max(low**2, high**2) * 2)) * 1.3
            assert counted(lambda z, a=a: a * z + np.sin(z), beta, s, B, C, D, law, x_k, 0.1, x_k - reach, x_k + reach) == 1
    assert "holds" in seen or len(seen) < 12


def test_units_that_spoil_the_last_digit_of_c():
    # C = 1000 B' but for rounding: exactly, on these doubles, W_mlcp is not psd, yet x is the same.
    x, l = ca.SX.sym("x"), ca.SX.sym("l", 2)
    f, g, h = -x, (0.73 * l[0] - 0.65 * l[1]) / 1000, ca.vertcat(0.73 * x, -0.65 * x)
    assert unique(system(f, g, h, complementarity(2), x, l)).verdict == "holds"
    assert unique(system(f, -g, h, complementarity(2), x, l)).verdict != "holds"


def test_one_sign_of_y_in_all_steps_from_the_region():
    # x' = -l with y = x: the wrong sign, but l = -1 as long as no step from the region comes near x = 0.
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    far, near = (unique(system(ca.sin(x), -l * (1 + 0.1 * x**2), x, relay(1), x, l, x0=[start])) for start in (3.0, 0.12))
    assert far.verdict == "holds"
    assert "one sign" in far.how
    assert near.verdict == "violated"


def test_a_law_that_asks_for_what_no_state_gives():
    # x >= 1 and -x >= 1: no step at all; x >= -1 and -x >= -1: x is pressed into the interval.
    x, l = ca.SX.sym("x"), ca.SX.sym("l", 2)
    for level, verdict in ((1.0, {"violated", "unknown"}), (-1.0, {"holds"})):
        h = ca.vertcat(x - level, -x - level)
        assert unique(system(ca.sin(x) - x, l[0] - l[1], h, complementarity(2), x, l)).verdict in verdict


def test_fewer_states_than_rows_by_counting():
    # b = N x_k lies on a line, so that W need not be a P-matrix.
    rng, seen = np.random.default_rng(0), set()
    x, l = ca.SX.sym("x"), ca.SX.sym("l", 2)
    for _ in range(share(40, 20)):
        B, C, e = rng.integers(-2, 3, (3, 2))
        D = rng.integers(-1, 2, (2, 2)) * (rng.random() < 0.5)
        model = system(-x, ca.dot(ca.DM(B), l), ca.DM(C) * x + ca.DM(D) @ l + ca.DM(e), relay(2), x, l)
        finding = unique(model)
        seen.add((finding.verdict, "linear programs" in finding.how))
        if finding.verdict != "holds":
            continue
        W = D + np.outer(C, B) * 0.1 / 1.1
        for x_k in rng.normal(size=30) * 3:
            b, ends = C * x_k / 1.1 + e, []
            for code in product((-1, 0, 1), repeat=2):
                at, free = np.array(code, float), np.flatnonzero(np.array(code) == 0)
                block = W[np.ix_(free, free)]
                if free.size and abs(np.linalg.det(block)) < 1e-9:
                    continue
                at[free] = np.linalg.solve(block, -(b + W @ at)[free])
                y = W @ at + b
                if (np.abs(at) <= 1 + 1e-9).all() and all(c == 0 or c * v <= 1e-9 for c, v in zip(code, y, strict=True)):
                    ends.append(x_k / 1.1 + B @ at * 0.1 / 1.1)
            assert not ends or max(ends) - min(ends) < 1e-7
    assert {("holds", True), ("holds", False)} <= seen
    assert any(verdict == "violated" for verdict, _ in seen)
