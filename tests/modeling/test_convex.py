"""The split of Phi against brute force: its value, and the subgradient inequality at points on and off the kinks."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

from nsmodel.errors import ModelError
from nsmodel.modeling.convex_split import ConvexTerm, split_convex, split_discontinuities

INF = np.inf


class Case(NamedTuple):
    """Phi written twice, the kinds of terms and the number of tau expected, points where it is not differentiable."""

    n: int
    symbolic: Callable
    numeric: Callable
    kinds: str
    levels: int = 0
    kinks: tuple = ()


def clip_huber(y):
    m = ca.fmin(ca.fabs(y), 1)
    return m**2 / 2 + ca.fabs(y) - m


def interval(y):
    return ca.logic_and(y >= -1, y <= 1)


A, c = np.array([[1.0, 2.0], [-1.0, 1.0], [2.0, 4.0]]), np.array([1.0, -1.0, 2.0])
ON_A = tuple(np.linalg.solve(A[:2], -c[:2]))

CASES = {
    "smooth": Case(2, lambda y: ca.sumsqr(y) + ca.exp(y[0]), lambda y: y @ y + np.exp(y[0]), ""),
    "number": Case(1, lambda y: ca.SX(3), lambda y: 3.0, ""),
    "abs": Case(1, ca.fabs, lambda y: abs(y[0]), "abs", 0, ((0,),)),
    "two abs": Case(
        1,
        lambda y: 3 * ca.fabs(y - 1) + 2 * ca.fabs(y + 1),
        lambda y: 3 * abs(y[0] - 1) + 2 * abs(y[0] + 1),
        "abs abs",
        0,
        ((1,), (-1,)),
    ),
    "same abs twice": Case(1, lambda y: 2 * ca.fabs(y - 1) + ca.fabs(y - 1), lambda y: 3 * abs(y[0] - 1), "abs", 0, ((1,),)),
    "root of a square": Case(
        2, lambda y: ca.sqrt(y[0] ** 2 - 2 * y[0] * y[1] + y[1] ** 2), lambda y: abs(y[0] - y[1]), "abs", 0, ((1, 1),)
    ),
    "positive part": Case(1, lambda y: ca.fmax(0, y), lambda y: max(y[0], 0), "max", 0, ((0,),)),
    "minus a minimum": Case(2, lambda y: -2 * ca.fmin(y[0], y[1]), lambda y: -2 * min(y), "max", 0, ((0, 0), (1, 1))),
    "max of curves": Case(
        1, lambda y: ca.fmax(y**2, 2 * y**2 - 1), lambda y: max(y[0] ** 2, 2 * y[0] ** 2 - 1), "max", 0, ((1,), (-1,))
    ),
    "max of three": Case(
        2,
        lambda y: ca.fmax(ca.fmax(y[0], 2 * y[1]), 3),
        lambda y: max(y[0], 2 * y[1], 3),
        "",
        1,
        ((3, 1.5), (2, 1.5), (4, 2), (3, 0)),
    ),
    "norm_2": Case(2, ca.norm_2, np.linalg.norm, "norm", 0, ((0, 0),)),
    "hypot": Case(2, lambda y: ca.hypot(y[0], 2 * y[1]), lambda y: np.hypot(y[0], 2 * y[1]), "norm", 0, ((0, 0),)),
    "norm_2 affine": Case(
        2,
        lambda y: 0.5 * ca.norm_2(ca.DM(A[:2]) @ y + ca.DM(c[:2])),
        lambda y: 0.5 * np.linalg.norm(A[:2] @ y + c[:2]),
        "norm",
        0,
        (ON_A,),
    ),
    "norm_2 tall": Case(2, lambda y: ca.norm_2(ca.DM(A) @ y + ca.DM(c)), lambda y: np.linalg.norm(A @ y + c), "norm", 0, (ON_A,)),
    "norm_2 that never vanishes": Case(
        1, lambda y: ca.norm_2(ca.vertcat(y - 1, y + 1)), lambda y: np.hypot(y[0] - 1, y[0] + 1), ""
    ),
    "root of a quadratic form": Case(
        2,
        lambda y: ca.sqrt(2 * y[0] ** 2 + 2 * y[0] * y[1] + y[1] ** 2),
        lambda y: np.sqrt(2 * y[0] ** 2 + 2 * y[0] * y[1] + y[1] ** 2),
        "norm",
        0,
        ((0, 0),),
    ),
    "pseudo-Huber": Case(1, lambda y: ca.sqrt(1 + y**2), lambda y: np.hypot(1, y[0]), ""),
    "norm_1": Case(3, ca.norm_1, lambda y: np.abs(y).sum(), "abs abs abs", 0, ((0, 0, 0), (0, 1, -1))),
    "norm_inf": Case(3, ca.norm_inf, lambda y: np.abs(y).max(), "", 1, ((0, 0, 0), (1, -1, 0), (1, 1, 1))),
    "norm_inf and abs": Case(
        2,
        lambda y: ca.fmax(ca.fabs(y[0]), ca.fabs(y[1])) + 2 * ca.fabs(y[0]),
        lambda y: np.abs(y).max() + 2 * abs(y[0]),
        "abs",
        1,
        ((0, 0), (1, 1), (0, 1)),
    ),
    "max of sums": Case(
        2,
        lambda y: ca.fmax(ca.fabs(y[0]) + ca.fabs(y[1]), 1),
        lambda y: max(np.abs(y).sum(), 1),
        "",
        3,
        ((0, 1), (1, 0), (0.5, -0.5), (0, 2)),
    ),
    "max with a norm": Case(
        2,
        lambda y: ca.fmax(ca.norm_2(y), y[0] + 1),
        lambda y: max(np.linalg.norm(y), y[0] + 1),
        "cone",
        2,
        ((0, 1), (4, 3)),
    ),
    "norm of kinks": Case(
        2,
        lambda y: ca.norm_2(ca.vertcat(ca.fabs(y[0]) + 1, ca.fmax(y[1], 0))),
        lambda y: np.hypot(abs(y[0]) + 1, max(y[1], 0)),
        "cone",
        3,
        ((0, 0), (0, 1)),
    ),
    "abs of a positive part": Case(1, lambda y: ca.fabs(ca.fmax(y, 0)), lambda y: max(y[0], 0), "", 2, ((0,),)),
    "exp of abs": Case(1, lambda y: ca.exp(ca.fabs(y)), lambda y: np.exp(abs(y[0])), "", 1, ((0,),)),
    "square of abs plus 1": Case(1, lambda y: (ca.fabs(y) + 1) ** 2, lambda y: (abs(y[0]) + 1) ** 2, "", 1, ((0,),)),
    "square of a large part": Case(1, lambda y: ca.fmax(y, 1) ** 2, lambda y: max(y[0], 1) ** 2, "", 1, ((1,),)),
    "Huber by fmin": Case(
        1, clip_huber, lambda y: y[0] ** 2 / 2 if abs(y[0]) < 1 else abs(y[0]) - 0.5, "", 2, ((0,), (1,), (-1,))
    ),
    "power 3/2 of abs": Case(1, lambda y: ca.fabs(y) ** 1.5, lambda y: abs(y[0]) ** 1.5, "", 0, ((0,),)),
    "cube of abs": Case(1, lambda y: ca.fabs(y) ** 3, lambda y: abs(y[0]) ** 3, "", 0, ((0,),)),
    "square of abs": Case(1, lambda y: ca.fabs(y) * ca.fabs(y), lambda y: y[0] ** 2, "", 0, ((0,),)),
    "square of the positive part": Case(1, lambda y: ca.fmax(y - 1, 0) ** 2, lambda y: max(y[0] - 1, 0) ** 2, "", 0, ((1,),)),
    "power 3/2 of the norm": Case(2, lambda y: ca.norm_2(y) ** 1.5, lambda y: np.linalg.norm(y) ** 1.5, "cone", 1, ((0, 0),)),
    "power 3/4 of the square": Case(2, lambda y: ca.sumsqr(y) ** 0.75, lambda y: (y @ y) ** 0.75, "cone", 1, ((0, 0),)),
    "interval": Case(
        1,
        lambda y: ca.if_else(interval(y), 0, ca.inf),
        lambda y: 0.0 if abs(y[0]) <= 1 else INF,
        "indicator indicator",
        0,
        ((1,), (-1,), (0.2,)),
    ),
    "interval and quadratic": Case(
        1,
        lambda y: ca.if_else(interval(y), (y - 3) ** 2, ca.inf),
        lambda y: (y[0] - 3) ** 2 if abs(y[0]) <= 1 else INF,
        "indicator indicator",
        0,
        ((1,), (-1,), (0.2,)),
    ),
    "interval the other way": Case(
        1,
        lambda y: ca.if_else(ca.logic_or(y < -1, y > 1), ca.inf, ca.fabs(y)),
        lambda y: abs(y[0]) if abs(y[0]) <= 1 else INF,
        "abs indicator indicator",
        0,
        ((1,), (-1,), (0,)),
    ),
    "interval by abs": Case(
        1,
        lambda y: ca.if_else(ca.fabs(y) <= 1, y, ca.inf),
        lambda y: y[0] if abs(y[0]) <= 1 else INF,
        "indicator indicator",
        0,
        ((1,), (-1,)),
    ),
    "half plane": Case(
        2,
        lambda y: ca.norm_1(y) + ca.if_else(y[0] + y[1] >= 1, 0, ca.inf),
        lambda y: np.abs(y).sum() if y.sum() >= 1 else INF,
        "abs abs indicator",
        0,
        ((1, 0), (0, 1), (0.5, 0.5), (2, 0)),
    ),
    "nested conditions": Case(
        2,
        lambda y: ca.if_else(y[0] >= 0, ca.if_else(y[1] >= 0, y[0] - y[1], ca.inf), ca.inf),
        lambda y: y[0] - y[1] if min(y) >= 0 else INF,
        "indicator indicator",
        0,
        ((0, 0), (1, 0), (1, 1)),
    ),
    "line": Case(
        2,
        lambda y: ca.fabs(y[1]) + ca.if_else(y[0] == 1, 0, ca.inf),
        lambda y: abs(y[1]) if y[0] == 1 else INF,
        "abs equality",
        0,
        ((1, 0), (1, 2)),
    ),
    "ball": Case(
        2,
        lambda y: ca.if_else(ca.norm_2(y) <= 5, y[0], ca.inf),
        lambda y: y[0] if np.linalg.norm(y) <= 5 else INF,
        "cone",
        0,
        ((3, 4), (-5, 0), (1, 1)),
    ),
    "ball by its square": Case(
        2,
        lambda y: ca.if_else(ca.sumsqr(y) <= 25, y[0], ca.inf),
        lambda y: y[0] if y @ y <= 25 else INF,
        "indicator",
        0,
        ((3, 4), (-5, 0), (1, 1)),
    ),
    "second-order cone": Case(
        3,
        lambda y: ca.if_else(ca.norm_2(y[1:]) <= y[0], y[1], ca.inf),
        lambda y: y[1] if np.hypot(y[1], y[2]) <= y[0] else INF,
        "cone",
        0,
        ((5, 3, 4), (0, 0, 0), (2, 1, 0)),
    ),
    "cross-polytope": Case(
        2,
        lambda y: ca.if_else(ca.norm_1(y) <= 1, y[0], ca.inf),
        lambda y: y[0] if np.abs(y).sum() <= 1 else INF,
        "indicator",
        2,
        ((1, 0), (0, -1), (0.5, 0.5), (0.1, 0)),
    ),
    "cube": Case(
        2,
        lambda y: ca.if_else(ca.norm_inf(y) <= 1, y[0], ca.inf),
        lambda y: y[0] if np.abs(y).max() <= 1 else INF,
        "indicator indicator indicator indicator",
        0,
        ((1, 0), (1, -1), (0.1, 0)),
    ),
    "max with an indicator": Case(
        2,
        lambda y: ca.fmax(ca.if_else(y[0] >= 0, 0, ca.inf), y[1]),
        lambda y: max(y[1], 0) if y[0] >= 0 else INF,
        "indicator",
        1,
        ((0, 0), (1, 0), (0, 1), (1, 1)),
    ),
}


# -- the split, evaluated ----------------------------------------------------------------------------------------------


def number(expr, y, y0, tau=None, tau0=None):
    symbols = ca.vertcat(y) if tau is None else ca.vertcat(y, tau)
    point = y0 if tau0 is None else np.r_[y0, tau0]
    return np.array(ca.Function("n", [symbols], [ca.densify(ca.SX(expr))])(point))


def least_tau(parts, y, y0):
    """The least tau that satisfies the rows and the cones; a row holds earlier tau only."""
    tau0 = np.zeros(parts.tau.numel())
    rows = [(j, parts.epigraph[i]) for i, j in enumerate(parts.epigraph_of)]
    heads = [str(t.u[0]) if t.kind == "cone" else None for t in parts.terms]
    for j in range(tau0.size):
        bounds = [number(row, y, y0, parts.tau, tau0).item() for k, row in rows if k == j]
        for term, head in zip(parts.terms, heads, strict=True):
            if head == str(parts.tau[j]):
                bounds.append(np.linalg.norm(number(term.u[1:], y, y0, parts.tau, tau0)))
        tau0[j] = max(bounds)
    return tau0


def term_value(term, u):
    w = float(term.weight)
    if term.kind == "indicator":
        return 0.0 if u[0] >= -1e-12 else INF
    if term.kind == "equality":
        return 0.0 if abs(u[0]) <= 1e-12 else INF
    if term.kind == "cone":
        return 0.0 if np.linalg.norm(u[1:]) <= u[0] + 1e-12 else INF
    return w * {"abs": abs(u[0]), "max": max(u[0], 0), "norm": np.linalg.norm(u)}[term.kind]


def split_value(parts, y, y0):
    tau0 = least_tau(parts, y, y0)
    terms = [term_value(t, number(t.u, y, y0, parts.tau, tau0).ravel()) for t in parts.terms]
    return number(parts.smooth, y, y0, parts.tau, tau0).item() + sum(terms)


def generators(term, u, rng):
    """Write the multipliers allowed by -u ∈ N_K(l') as fixed + G s, lower <= s <= upper."""
    w, m, zero = float(term.weight), u.size, np.linalg.norm(u) <= 1e-9
    none = np.zeros((m, 0)), [], []
    if term.kind in ("abs", "max"):
        low, high = (-w, w) if term.kind == "abs" else (-w, 0)
        if zero:
            return np.zeros(1), np.eye(1), [low], [high]
        return np.array([low if u[0] > 0 else high]), *none
    if term.kind == "norm":
        if not zero:
            return -w * u / np.linalg.norm(u), *none
        direction = rng.normal(size=m)
        return np.zeros(m), direction[:, None] / np.linalg.norm(direction), [-w], [w]
    if term.kind == "equality":
        return np.zeros(1), np.eye(1), [-50], [50]
    if term.kind == "indicator":
        return (np.zeros(1), np.eye(1), [0], [50]) if zero else (np.zeros(1), *none)
    size = np.linalg.norm(u[1:])
    if zero:
        rays = rng.normal(size=(m - 1, 40))
        rays = np.vstack([np.ones(40), rays / np.linalg.norm(rays, axis=0)])
        return np.zeros(m), rays, [0] * 40, [50] * 40
    if size < u[0] - 1e-9:
        return np.zeros(m), *none
    return np.zeros(m), np.r_[size, -u[1:]][:, None] / size, [0], [50]


def random_multiplier(parts, y, y0, rng):
    """One l ∈ -dPhi(y0), by the laws of the terms and the rows; the stationarity in tau is a linear program."""
    tau0 = least_tau(parts, y, y0)
    z = ca.vertcat(y, parts.tau)
    constant = -number(ca.gradient(parts.smooth, z), y, y0, parts.tau, tau0).ravel()
    columns, low, high = [np.zeros((z.numel(), 0))], [], []
    for term in parts.terms:
        J = number(ca.jacobian(term.u, z), y, y0, parts.tau, tau0)
        fixed, G, lo, up = generators(term, number(term.u, y, y0, parts.tau, tau0).ravel(), rng)
        constant += J.T @ fixed
        columns.append(J.T @ G)
        low, high = low + list(lo), high + list(up)
    for i, j in enumerate(parts.epigraph_of):
        gap = parts.tau[j] - parts.epigraph[i]
        if abs(number(gap, y, y0, parts.tau, tau0).item()) <= 1e-9:
            columns.append(number(ca.jacobian(gap, z), y, y0, parts.tau, tau0).T)
            low, high = [*low, 0], [*high, INF]
    G, n = np.hstack(columns), y.numel()
    if G.shape[1] == 0:
        assert np.abs(constant[n:]).max(initial=0) < 1e-12
        return constant[:n]
    cost = rng.normal(size=G.shape[1]) + np.array(np.isinf(high), float) * 5
    equal = {"A_eq": G[n:], "b_eq": -constant[n:]} if z.numel() > n else {}
    found = linprog(cost, bounds=list(zip(low, high, strict=True)), **equal)
    assert found.success, found.message
    return constant[:n] + G[:n] @ found.x


def points(case, rng):
    sampled = [p for p in rng.normal(size=(30, case.n)) * 1.5 if np.isfinite(case.numeric(p))][:6]
    return [np.array(p, float) for p in case.kinks] + sampled


@pytest.mark.parametrize("name", CASES)
def test_split_has_the_value_and_the_subgradients_of_phi(name):
    case, rng = CASES[name], np.random.default_rng(3)
    y = ca.SX.sym("y", case.n)
    parts = split_convex(ca.SX(case.symbolic(y)), y, "phi")
    assert (" ".join(t.kind for t in parts.terms), parts.tau.numel()) == (case.kinds, case.levels)
    assert parts.epigraph.shape == (len(parts.epigraph_of), 1)
    others = [*(rng.normal(size=(300, case.n)) * 3), *points(case, rng)]
    values = np.array([case.numeric(p) for p in others])
    for p in points(case, rng):
        phi = case.numeric(p)
        assert np.isfinite(phi)
        assert split_value(parts, y, p) == pytest.approx(phi, abs=1e-7)
        for _ in range(4):
            multiplier = random_multiplier(parts, y, p, rng)
            for other, value in zip(others, values, strict=True):
                assert value >= phi - multiplier @ (other - p) - 1e-7 * (1 + abs(phi) + np.linalg.norm(multiplier))


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.levels and "cone" not in case.kinds])
def test_minimum_over_tau_is_phi(name):
    """Brute force: tau from a grid above its least value never does better than Phi; the least value gives Phi."""
    case, rng = CASES[name], np.random.default_rng(5)
    y = ca.SX.sym("y", case.n)
    parts = split_convex(case.symbolic(y), y, "phi")
    gaps = ca.vertcat(*(parts.tau[j] for j in parts.epigraph_of)) - parts.epigraph
    domain = ca.vertcat(ca.SX(0, 1), *(t.u for t in parts.terms if t.kind == "indicator"))
    simple = sum((t.weight * ca.fabs(t.u) for t in parts.terms if t.kind == "abs"), ca.SX(0))
    f = ca.Function("f", [y, parts.tau], [parts.smooth + simple, ca.vertcat(gaps, domain)])
    for p in points(case, rng):
        least = least_tau(parts, y, p)
        for _ in range(300):
            value, slack = f(p, least + rng.normal(size=least.size) * 10 ** rng.uniform(-3, 1))
            if np.min(np.array(slack)) >= 0:
                assert float(value) >= case.numeric(p) - 1e-9


@pytest.mark.parametrize("name", ["max of three", "norm_inf", "norm_inf and abs", "max of sums", "cross-polytope"])
def test_linear_epigraph_by_linear_programming(name):
    case, rng = CASES[name], np.random.default_rng(7)
    y = ca.SX.sym("y", case.n)
    parts = split_convex(case.symbolic(y), y, "phi")
    zero = np.zeros(parts.tau.numel())
    rows = parts.epigraph - ca.vertcat(*(parts.tau[j] for j in parts.epigraph_of))
    domain = [-t.u for t in parts.terms if t.kind == "indicator"]
    rows = ca.vertcat(rows, *domain)
    for p in rng.normal(size=(20, case.n)):
        found = linprog(
            number(ca.jacobian(parts.smooth, parts.tau), y, p, parts.tau, zero).ravel(),
            A_ub=number(ca.jacobian(rows, parts.tau), y, p, parts.tau, zero),
            b_ub=-number(rows, y, p, parts.tau, zero).ravel(),
            bounds=(None, None),
        )
        rest = number(parts.smooth, y, p, parts.tau, zero).item()
        rest += sum(float(t.weight) * abs(number(t.u, y, p).item()) for t in parts.terms if t.kind == "abs")
        value = found.fun + rest if found.status == 0 else INF
        assert value == pytest.approx(case.numeric(p), abs=1e-9)


# -- form of the answer ------------------------------------------------------------------------------------------------

Y = ca.SX.sym("y", 2)
MU = ca.SX.sym("mu")


def test_weights_and_arguments_may_hold_parameters():
    parts = split_convex(MU * ca.fabs(Y[0] - MU) + MU**2 * ca.norm_2(MU * Y) + 0 * ca.fabs(Y[1]), Y, "phi")
    first, second = parts.terms
    assert (first.kind, str(first.weight), str(first.u)) == ("abs", "mu", "(y_0-mu)")
    assert (second.kind, str(second.weight), str(second.u)) == ("norm", "sq(mu)", "[(mu*y_0), (mu*y_1)]")


def test_norms_with_parameters_inside_the_root():
    (term,) = split_convex(ca.sqrt(MU * Y[0] ** 2 + Y[1] ** 2 / MU), Y, "phi").terms
    assert str(term.u) == "[(sqrt(mu)*y_0), (sqrt((1./mu))*y_1)]"
    (moved,) = split_convex(ca.sqrt(Y[0] ** 2 - 2 * MU * Y[0] + MU**2 + 2 * Y[1] ** 2), Y, "phi").terms
    f = ca.Function("f", [Y, MU], [ca.norm_2(moved.u)])
    assert float(f([1, 2], 3)) == pytest.approx(np.sqrt(12))
    assert split_convex(ca.sqrt(Y[0] ** 2 + MU), Y, "phi").terms == ()
    assert split_convex(ca.norm_2(ca.vertcat(Y[0] - MU, Y[0] + MU)), Y, "phi").terms == ()
    assert split_convex(ca.norm_2(ca.vertcat(Y[0] ** 2, MU)), Y, "phi").terms == ()


def test_what_does_not_depend_on_y_stays():
    parts = split_convex(ca.fabs(MU) * Y[0] + ca.if_else(MU > 0, Y[1], 2 * Y[1]) + ca.fmax(MU, 0), Y, "phi")
    assert parts.terms == ()
    assert not parts.tau.numel()


def test_large_norms():
    y = ca.SX.sym("y", 50)
    assert len(split_convex(ca.norm_1(y), y, "phi").terms) == 50
    parts = split_convex(ca.norm_inf(y), y, "phi")
    assert parts.tau.numel() == 1
    assert {str(piece) for piece in ca.vertsplit(parts.epigraph)} >= {str(piece) for piece in ca.vertsplit(ca.vertcat(y, -y))}


def test_a_branch_may_hang_on_the_domain_and_stand_in_a_condition():
    nonnegative = Y[0] >= 0
    inner = ca.if_else(nonnegative, Y[1], 2 * Y[1])
    parts = split_convex(ca.if_else(ca.logic_and(nonnegative, inner <= 1), Y[0], ca.inf), Y, "phi")
    assert [str(term.u) for term in parts.terms] == ["y_0", "(1-y_1)"]


def test_a_condition_that_always_holds_gives_no_term():
    assert split_convex(ca.if_else(ca.fmax(ca.fabs(Y[0]), 1) <= 2, 0, ca.inf), Y, "phi").terms[0].kind == "indicator"
    assert len(split_convex(ca.if_else(ca.fmax(ca.fabs(Y[0]), 1) <= 2, 0, ca.inf), Y, "phi").terms) == 2


def test_with_terms_replaces_the_terms_only():
    parts = split_convex(ca.norm_1(Y) + Y[0] ** 2, Y, "phi")
    assert parts.with_terms(parts.terms[:1]).terms == parts.terms[:1]
    assert parts.with_terms([]).smooth is parts.smooth
    assert isinstance(parts.terms[0], ConvexTerm)


# -- errors ------------------------------------------------------------------------------------------------------------

TABLE = ca.interpolant("lut", "linear", [[0, 1, 2]], [0, 1, 4])
MX = ca.MX.sym("y", 2)
SAMPLED = ca.Function("f", [MX], [TABLE(MX[0])]).expand()(Y)


@pytest.mark.parametrize(
    ("phi", "message"),
    [
        (Y, r"phi: shape \(2, 1\); expected one scalar expression"),
        (Y[0] ** 2 - 2 * ca.fabs(Y[0]), r"phi is not convex: the term fabs\(y_0\) enters with the weight -2"),
        (ca.fmin(Y[0], 0), r"phi is not convex: the term .*fmin\(y_0,0\).* enters with the weight -1"),
        (ca.fabs(Y[0] ** 2 - 1), r"phi is not recognised as convex: fabs.* absolute value of a nonlinear expression"),
        (
            ca.fabs(ca.fmax(Y[0], -1)),
            r"phi is not recognised as convex: it does not grow with the nested term fmax\(y_0,-1\)",
        ),
        (Y[0] * ca.fabs(Y[1] - 1), "phi is not recognised as convex: it does not grow with the nested term"),
        (ca.sign(Y[0]), r"phi: sign in sign\(y_0\) has no subdifferential; write phi with fabs"),
        (ca.floor(Y[0]), "phi: floor in "),
        (ca.fmod(Y[0], 2), "phi: fmod in "),
        (
            ca.if_else(Y[0] <= 1, Y[0] ** 2, 2 * Y[0]),
            r"phi: .*y_0<=1.* switches between finite values; write it with fmax",
        ),
        (ca.pw_lin(Y[0], [0, 1, 2], [0, 1, 4]), r"phi uses the comparison \(1<=y_0\) as a number"),
        (ca.fabs(Y[0]) + SAMPLED, "phi calls a Function whose code cannot be read"),
        (ca.norm_2(ca.vertcat(Y[0] ** 2, Y[1])), "phi: sqrt.* is the norm of a nonlinear expression"),
        (
            ca.sqrt(MU * Y[0] ** 2 + 2 * Y[0] * Y[1] + Y[1] ** 2),
            "phi: the coefficients of sqrt.* hold mu; write it as norm_2",
        ),
        (ca.inf * Y[0], "phi holds inf outside of an if_else"),
        (ca.if_else(Y[0] > 0, -ca.inf, 0), r"phi takes the value -inf where \(0<y_0\)"),
        (-ca.if_else(Y[0] > 0, 0, ca.inf), r"phi takes the value -inf outside of \(0<y_0\)"),
        (ca.if_else(Y[0] != 0, 0, ca.inf), r"phi is not convex: its domain \(y_0!=0\) is not a conjunction"),
        (
            ca.if_else(ca.logic_or(Y[0] >= 0, Y[1] >= 0), 0, ca.inf),
            "phi is not convex: its domain .* is not a conjunction",
        ),
        (
            ca.if_else(ca.fabs(Y[0]) >= 1, 0, ca.inf),
            r"phi is not convex: its domain \(1<=fabs\(y_0\)\).* reverse the inequality",
        ),
        (ca.if_else(ca.sumsqr(Y) >= 1, 0, ca.inf), "phi is not convex: its domain .* write it as concave >= 0"),
        (ca.if_else(Y[0] ** 2 == Y[1], 0, ca.inf), "phi is not convex: the equality in its domain .* is not affine"),
        (ca.if_else(ca.fabs(Y[0]) == 1, 0, ca.inf), "phi is not convex: the equality in its domain .* is not affine"),
        (ca.if_else(ca.fmax(Y[0], 1) <= 0, 0, ca.inf), "phi is .inf everywhere: its domain .* is empty"),
        (ca.if_else(ca.norm_1(Y) >= 1, 0, ca.inf), "phi is not recognised as convex: it does not grow"),
    ],
)
def test_what_cannot_be_split_is_refused(phi, message):
    with pytest.raises(ModelError, match=message):
        split_convex(phi, Y, "phi")


# -- discontinuities ---------------------------------------------------------------------------------------------------


def test_split_discontinuities_replaces_each_sign_once():
    field = ca.vertcat(2 * Y[0] + 3 * ca.sign(Y[0] - 1), MU * ca.sign(Y[0] - 1) * ca.sign(Y[1]), ca.sign(MU) * ca.fabs(Y[1]))
    expr, symbols, arguments = split_discontinuities(field, Y, "operator")
    assert (symbols.shape, str(arguments)) == ((2, 1), "[(y_0-1), y_1]")
    f = ca.Function("f", [Y, MU, symbols], [expr])
    np.testing.assert_allclose(np.array(f([1, -2], 3, [0.5, -1])).ravel(), [3.5, -1.5, 2])
    assert expr.shape == (3, 1)


def test_split_discontinuities_leaves_a_continuous_field_alone():
    field = ca.vertcat(SAMPLED, Y[1])
    expr, symbols, arguments = split_discontinuities(field, Y, "operator")
    assert expr is field
    assert symbols.shape == arguments.shape == (0, 1)


def test_split_discontinuities_refuses_what_it_cannot_read():
    with pytest.raises(ModelError, match=r"operator: sign.* has a sign inside a sign"):
        split_discontinuities(ca.sign(Y[0] + ca.sign(Y[1])), Y, "operator")
    with pytest.raises(ModelError, match="operator calls a Function whose code cannot be read"):
        split_discontinuities(ca.sign(Y[0]) + SAMPLED, Y, "operator")
