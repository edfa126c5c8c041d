"""Hypotheses of theta-gamma stepping against closed forms, brute-force minors, determinants and counted solutions."""

from __future__ import annotations

from itertools import combinations, product

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

import nsmodel
from nsmodel import FirstOrderSystem, ball, box, complementarity, polyhedron, relay, simulate
from nsmodel.hypotheses.region import region_of
from nsmodel.models.first_order_system import linearisation
from nsmodel.models.first_order_system.check import HYPOTHESES, check
from nsmodel.models.first_order_system.step_matrix import decide_p_matrix, regular_steps
from nsmodel.proof import exact

T = ca.SX.sym("t")


def linear(A, B=None, C=None, D=None, law=None, *, x0=None, step=0.1, theta=1.0, gamma=1.0, M=None):
    """x' = A x + B l, y = C x + D l."""
    n = len(A)
    x = ca.SX.sym("x", n)
    given = {}
    if law is not None:
        lam = ca.SX.sym("l", law.size)
        D = np.zeros((law.size, law.size)) if D is None else D
        given = {"lam": lam, "h": ca.DM(C) @ x + ca.DM(D) @ lam, "g": ca.DM(B) @ lam, "law": law}
    start = np.ones(n) if x0 is None else x0
    return FirstOrderSystem(x=x, f=ca.DM(A) @ x, x0=start, t_end=1, step=step, theta=theta, gamma=gamma, M=M, **given)


def report(model, runs=(), quick=False, region=None):
    """({id: finding}, {name: consequence})."""
    model = model.bind()
    findings, consequences = check(model, region_of(model, list(runs), region), list(runs), quick)
    assert [finding.id for finding in findings] == [hypothesis.id for hypothesis in HYPOTHESES]
    return {finding.id: finding for finding in findings}, {consequence.name: consequence for consequence in consequences}


def verdicts(*args, **named):
    return {id: finding.verdict for id, finding in report(*args, **named)[0].items()}


# -- matrices -------------------------------------------------------------------------------------------------------------


def test_principal_minors_by_brute_force():
    rng, seen = np.random.default_rng(0), set()
    for _ in range(400):
        n = rng.integers(1, 5)
        W = rng.integers(-2, 4, (n, n)) + 2.0 * np.eye(n)
        subsets = [list(rows) for k in range(1, n + 1) for rows in combinations(range(n), k)]
        minors = [round(np.linalg.det(W[np.ix_(rows, rows)])) for rows in subsets]
        is_p, minor = decide_p_matrix(exact.rational(W))
        assert is_p == (min(minors) > 0)
        if not is_p:
            assert minors[subsets.index(sorted(minor.rows))] <= 0
        seen.add(is_p)
    assert seen == {True, False}


def test_least_singular_step_against_the_determinant():
    rng, seen = np.random.default_rng(1), set()
    for _ in range(150):
        n, h = rng.integers(1, 6), rng.choice([0.1, 0.25, 0.5, 1.0])
        G = rng.integers(-3, 4, (n, n)) * 1.0
        M = np.diag(rng.integers(1, 4, n)) * 1.0
        steps = regular_steps(exact.rational(M), exact.rational(G), h)
        s = np.linspace(0, h, 4001)[1:]
        signs = np.sign(np.linalg.det(M - s[:, None, None] * G))
        if (signs < 0).any():
            assert steps.regular is False
            assert steps.least <= h
        if steps.regular:
            assert (signs > 0).all()
            assert steps.least > h
        seen.add(steps.regular)
    assert seen == {True, False}


def leading_minors(S):
    """The signs of the leading principal minors, by elimination in Fractions, as far as they are > 0."""
    S, signs = [list(row) for row in S], []
    for k in range(len(S)):
        signs.append(S[k][k] > 0)
        if not signs[-1]:
            break
        for i in range(k + 1, len(S)):
            factor = S[i][k] / S[k][k]
            S[i] = [a - factor * b for a, b in zip(S[i], S[k], strict=True)]
    return signs


def test_an_enclosed_mlcp_is_called_definite_where_it_is(monkeypatch):
    monkeypatch.setattr(linearisation, "MIN_ENCLOSED_STATES", 0)
    rng, seen = np.random.default_rng(4), []
    for k in range(100):
        n, m = rng.integers(1, 5), rng.integers(1, 4)
        A, B = rng.normal(size=(n, n)).round(k % 3), rng.normal(size=(n, m)).round(1)
        C = B.T if k % 4 else rng.normal(size=(m, n))
        D = rng.choice([0.0, 1e-300, -1e-17, 1e-9, 0.1]) * np.eye(m)
        model = linear(A, B, C, D, complementarity(m), step=0.125).bind()
        at = linearisation.linearise_system(model, region_of(model, []), [])
        W, near = at.exact_mlcp(0.125), at.definite_mlcp(0.125)
        if near is None:
            seen.append(W is not None and all(leading_minors(W + W.T)))
            continue
        assert all(leading_minors(W + W.T)), (A, B, C, D)
        assert near == pytest.approx(exact.doubles(W), rel=1e-12, abs=1e-12)
        seen.append(near)
    lost = sum(one is True for one in seen)
    assert lost <= 10  # definite, by less than the width of the enclosure
    assert sum(one is False for one in seen) >= 20
    assert sum(isinstance(one, np.ndarray) for one in seen) >= 40


def test_root_that_touches_zero_is_found():
    # det(I - s G) = (1 - 2 s)^2: no change of sign.
    assert regular_steps(exact.eye(2), exact.rational(2 * np.eye(2)), 0.6).regular is False
    assert regular_steps(exact.eye(2), exact.rational(2 * np.eye(2)), 0.5).regular is False
    assert regular_steps(exact.eye(2), exact.rational(2 * np.eye(2)), 0.4999).regular is True


@pytest.mark.parametrize(("step", "verdict"), [(0.05, "holds"), (0.1, "sampled"), (0.2, "violated")])
def test_growing_mode_bounds_the_step(step, verdict):
    # x' = 10 x with theta = 1: W = 1 - 10 h, h* = 1/10; the double 0.1 is above 1/10.
    found = report(linear([[10.0]], step=step))[0]
    assert found["F-step"].verdict == verdict
    assert found["F-step"].value["h*"] == pytest.approx(0.1)
    # Past h* W is regular, but negative; at h*, by rounding only.
    assert found["F-W"].verdict == ("sampled" if verdict == "sampled" else "holds")
    assert verdicts(linear([[10.0]], step=step, theta=0.25))["F-step"] == ("holds")


def test_singular_step_matrix():
    found = report(linear([[0.0, 4.0], [4.0, 0.0]], step=0.25))[0]
    assert found["F-W"].verdict == "violated"
    null = np.array(found["F-W"].witness["null vector"])
    assert null.any()
    assert not ((np.eye(2) - 0.25 * np.array([[0, 4], [4, 0]])) @ null).any()
    assert found["F-unique"].verdict == "unknown"


def test_oscillation_has_no_least_singular_step():
    found = report(linear([[0.0, 50.0], [-50.0, 0.0]], step=1.0))[0]
    assert found["F-step"].verdict == "holds"
    assert "h*" not in found["F-step"].value


def test_singular_mass_matrix():
    # 0 = x_0 - x_1: W is regular for h > 0, h* cannot be counted from det M != 0.
    model = linear([[-1.0, 0.0], [1.0, -1.0]], M=[[1, 0], [0, 0]], step=0.1)
    found = verdicts(model)
    assert (found["F-step"], found["F-W"]) == ("sampled", "holds")


# -- the complementarity problem ------------------------------------------------------------------------------------------


def lcp_solutions(W, b):
    """All solutions l of 0 <= l _|_ W l + b >= 0, by index sets."""
    m, out = len(b), []
    for free in product((False, True), repeat=m):
        on = np.flatnonzero(free)
        l = np.zeros(m)
        if on.size:
            if abs(np.linalg.det(W[np.ix_(on, on)])) < 1e-12:
                continue
            l[on] = np.linalg.solve(W[np.ix_(on, on)], -b[on])
        y = W @ l + b
        if (l >= -1e-12).all() and (y >= -1e-9).all() and not any(np.abs(l - other).max() < 1e-9 for other in out):
            out.append(l)
    return out


@pytest.mark.parametrize("seed", range(share(4)))
def test_unique_steps_by_counting_solutions(seed):
    rng, seen = np.random.default_rng(seed), set()
    for _ in range(30):
        m = 2
        D = rng.integers(-2, 3, (m, m)) * 1.0
        B, C = np.eye(m), rng.integers(-1, 2, (m, m)) * 1.0
        model = linear(-np.eye(m), B, C, D, complementarity(m), step=0.5)
        found = report(model)[0]
        W = D + 0.5 / 1.5 * C @ B
        counts = [len(lcp_solutions(W, C @ x / 1.5)) for x in rng.normal(size=(60, m))]
        if found["F-unique"].verdict == "holds":
            assert set(counts) == {1}
        if found["F-unique"].verdict == "violated":
            w = found["F-unique"].witness
            b = C @ np.array(w["x_k"]) / 1.5
            for l in (np.array(w[name]) for name in ("l", "other l") if name in w):
                assert (l >= 0).all()
                np.testing.assert_allclose(np.minimum(l, W @ l + b), 0, atol=1e-9 * (1 + np.abs(b).max()))
            if "l" in w:
                assert np.abs(np.array(w["x"]) - w["other x"]).max() > 1e-6
            else:
                assert not lcp_solutions(W, b)
        minors = [W[0, 0], W[1, 1], np.linalg.det(W)]
        eigenvalues = np.linalg.eigvalsh(W + W.T)
        if min(minors) > 1e-9 or eigenvalues[0] > 1e-9:
            assert found["F-mlcp"].verdict == found["F-unique"].verdict == "holds"
        if min(minors) < -1e-9:
            assert found["F-mlcp"].verdict == "violated"
        seen.add(found["F-unique"].verdict)
    assert {"holds", "violated"} <= seen


def test_anti_relay_has_three_solutions():
    # x' = Sgn(x): from |x| < h there are three next states.
    found = report(linear([[0.0]], [[-1.0]], [[1.0]], law=relay(1), x0=[0.05]))[0]
    assert found["F-unique"].verdict == "violated"
    assert found["F-unique"].value["solutions"] == 3
    w = found["F-unique"].witness
    for x, l in ((w["x"], w["l"]), (w["other x"], w["other l"])):
        assert x[0] == pytest.approx(w["x_k"][0] - 0.1 * l[0])
        assert l[0] == pytest.approx(-np.sign(x[0])) or x[0] == pytest.approx(0, abs=1e-12)
    assert found["F-mlcp"].verdict == "violated"
    assert found["F-mlcp"].witness["rows"] == ["l"] or len(found["F-mlcp"].witness["rows"]) == 1


def test_box_from_above_with_the_wrong_sign_has_two_solutions():
    # y = x_k - 0.1 l: from x_k < 0 both l = 0, y = x_k and l = 10 x_k, y = 0.
    found = report(linear([[0.0]], [[-1.0]], [[1.0]], law=box(-np.inf, 0), x0=[-0.05]))[0]["F-unique"]
    assert found.verdict == "violated"
    (x_k,) = found.witness["x_k"]
    assert x_k < 0
    assert sorted([found.witness["l"], found.witness["other l"]]) == [[pytest.approx(10 * x_k)], [0]]


def test_relay_has_one_solution_even_where_rows_repeat():
    repeated = linear([[0.0]], [[1.0, 1.0]], [[1.0], [1.0]], law=relay(2), x0=[0.05])
    found = report(repeated)[0]
    assert (found["F-mlcp"].verdict, found["F-unique"].verdict) == ("holds", "holds")
    assert "l may not be unique" in found["F-unique"].how


def test_complementarity_that_may_have_no_solution():
    # x >= 0 and -x >= 0: psd and feasible, x = 0 from every state.
    model = linear([[0.0]], [[1.0, -1.0]], [[1.0], [-1.0]], law=complementarity(2), x0=[0.0])
    found = report(model, [simulate(model)])[0]
    assert found["F-mlcp"].verdict == found["F-unique"].verdict == "holds"
    assert "one exists" in found["F-unique"].how
    # y = x_0 is not moved by l: no step from x_0 < 0.
    model = linear(np.zeros((2, 2)), [[0.0], [1.0]], [[1.0, 0.0]], law=complementarity(1), x0=[1.0, 0.0])
    found = report(model)[0]["F-unique"]
    assert (found.verdict, found.value["solutions"]) == ("violated", 0)
    assert found.witness["x_k"][0] < 0


def test_curved_and_polyhedral_laws():
    B = np.eye(2)
    assert verdicts(linear(-B, B, B, law=ball(2)))["F-unique"] == "holds"
    assert verdicts(linear(-B, B, B, law=polyhedron([[1.0, 0], [0, 1], [-1, -1]], [0, 0, -1])))["F-unique"] == "holds"
    assert verdicts(linear(-B, B, B, law=polyhedron([[1.0, 0], [-1, 0]], [1, 0])))["F-unique"] != "holds"  # K is empty


def test_p_matrix_that_is_not_monotone():
    W = np.array([[1.0, -9.0], [0.0, 1.0]])
    model = linear(np.zeros((2, 2)), np.zeros((2, 2)), np.eye(2), W, box([0, -1], [np.inf, 1]))
    found = report(model)[0]
    assert found["F-mlcp"].verdict == found["F-unique"].verdict == "holds"
    assert found["F-mlcp"].value["least eigenvalue"] < 0
    other = linear(np.zeros((2, 2)), np.zeros((2, 2)), np.eye(2), W, ball(2))
    assert verdicts(other)["F-unique"] != "holds"  # The theorem is about boxes.


def test_rounding_is_no_violation():
    v = np.array([[0.1], [0.2], [0.3]])
    D = v @ v.T  # psd of rank one but for rounding
    found = report(linear(np.zeros((3, 3)), np.zeros((3, 3)), np.eye(3), D, complementarity(3)))[0]
    assert found["F-mlcp"].verdict in ("holds", "sampled")


def test_variable_steps():
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    model = FirstOrderSystem(x=x, lam=l, f=-x, h=x, g=l, law=relay(1), x0=[1], steps=[0.1, 0.2, 0.3])
    found = report(model, [simulate(model)])[0]
    assert {finding.verdict for finding in found.values()} == {"holds"}
    assert found["F-step"].value["h"] == pytest.approx(0.3)


def test_no_step_is_said():
    x = ca.SX.sym("x")
    found = verdicts(FirstOrderSystem(x=x, f=-x, x0=[1], t_end=1))
    assert found == {"F-jacobians": "holds", **dict.fromkeys(("F-W", "F-mlcp", "F-unique", "F-step"), "unknown")}


# -- nonlinear systems ----------------------------------------------------------------------------------------------------


def pendulum(step, stiffness=1.0):
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    f = [x[1], -stiffness * ca.sin(x[0])]
    return FirstOrderSystem(x=x, lam=l, f=f, h=x[1], g=[0, l], law=relay(1), x0=[1, 0], t_end=1, step=step)


def test_nonlinear_system_with_small_steps_is_proved_over_the_region():
    model = pendulum(0.01)
    found, consequences = report(model, [simulate(model)])
    for id in ("F-jacobians", "F-W", "F-mlcp", "F-step"):
        assert found[id].verdict == "holds", found[id].how
    assert found["F-unique"].verdict == "holds"
    assert found["F-unique"].scope is not None
    assert consequences["Newton's method"].verdict == "holds"


def test_nonlinear_growth_past_its_least_step():
    x = ca.SX.sym("x")
    model = FirstOrderSystem(x=x, f=10 * ca.sin(x), x0=[0.0], t_end=1, step=0.2)
    found = report(model, region={"x": (-0.1, 0.1)})[0]
    assert found["F-step"].verdict == "violated"
    assert found["F-step"].value["h* at the points"] == pytest.approx(0.1, rel=0.02)
    assert found["F-W"].verdict == "holds"  # W = 1 - 2 cos x < 0 on this box
    wide = report(model, region={"x": (-3, 3)})[0]["F-W"]
    assert wide.verdict == "violated"
    assert 1 - 2 * np.cos(wide.witness["det > 0"][1]) > 0 > 1 - 2 * np.cos(wide.witness["det < 0"][1])


def test_kinks_are_named():
    x = ca.SX.sym("x")
    at_kink = FirstOrderSystem(x=x, f=-ca.fabs(x), x0=[0.0], t_end=1, step=0.1)
    found = report(at_kink)[0]["F-jacobians"]
    assert found.verdict == "violated"
    assert "fabs" in found.how
    away = FirstOrderSystem(x=x, f=-ca.fabs(x), x0=[1.0], t_end=0.5, step=0.1)
    assert report(away, [simulate(away)])[0]["F-jacobians"].verdict == "sampled"


def test_time_varying_coefficients_are_affine_but_not_constant():
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    model = FirstOrderSystem(t=T, x=x, lam=l, f=-(2 + ca.sin(T)) * x, h=x, g=l, law=relay(1), x0=[1], t_end=1, step=0.1)
    found, consequences = report(model, [simulate(model)])
    assert found["F-jacobians"].verdict == found["F-W"].verdict == found["F-mlcp"].verdict == "holds"
    assert consequences["one Newton iteration"].verdict == "holds"


@pytest.mark.parametrize(("theta", "gamma", "order"), [(1, 1, 1), (0.5, 0.5, 2), (0.5, 1, 1), (0.7, 0.5, 1)])
def test_order_that_follows(theta, gamma, order):
    model = linear([[-1.0]], [[1.0]], [[1.0]], law=relay(1), theta=theta, gamma=gamma)
    found, consequences = report(model, [simulate(model)])
    assert consequences["order"].value["order"] == order
    assert consequences["order"].verdict == "holds"
    assert set(verdicts(model)) == set(found)


def test_without_multipliers():
    found = verdicts(linear([[0.0, 1.0], [-1.0, 0.0]]))
    assert set(found.values()) == {"holds"}


def test_quick_makes_no_search():
    found = verdicts(nsmodel.load("cases/biology/gene_network.py"), quick=True)
    assert found["F-unique"] == "unknown"
    assert found["F-W"] == "holds"


@pytest.mark.long
def test_cases(cases_of, run_case):
    expected = {"F-jacobians": "holds", "F-W": "holds", "F-mlcp": "violated", "F-unique": "sampled", "F-step": "holds"}
    cases = cases_of(FirstOrderSystem)
    for stem in ("gene_network", "zhuravlev_ivanov"):
        found = report(cases[stem], [run_case(stem)])[0]
        assert {id: finding.verdict for id, finding in found.items()} == expected, stem


# -- jumps and sizes ------------------------------------------------------------------------------------------------------


def test_a_jump_is_no_linear_function_though_its_derivative_is_zero():
    x, lam = ca.SX.sym("x"), ca.SX.sym("l")
    given = {"x": x, "x0": 0.05, "t_end": 1, "step": 0.1}
    box_around = {"x": (-1, 1)}
    for f in (ca.sign(x), ca.if_else(x > 0, 1, -1), x - ca.floor(x), ca.fmod(x, 0.5)):
        findings, made = report(FirstOrderSystem(f=f, **given), region=box_around)
        assert findings["F-jacobians"].verdict == "violated"
        assert findings["F-jacobians"].value["jump"] > 0.4
        assert findings["F-unique"].verdict == "unknown"  # x = x_k + h sign(x) has two solutions for |x_k| < h
        assert made["one trajectory"].verdict == "unknown"
        assert "one Newton iteration" not in made
    inside = {"h": x + lam, "g": ca.sign(x) + lam, "lam": lam, "law": complementarity(1)}
    findings, _ = report(FirstOrderSystem(f=-x, **inside, **given), region=box_around)
    assert findings["F-jacobians"].verdict == "violated"
    assert findings["F-unique"].verdict != "holds"
    forced = FirstOrderSystem(f=-x + ca.if_else(T > 0.5, 1, 0), t=T, **given)  # a jump in time alone leaves each step linear
    assert report(forced)[0]["F-unique"].verdict == "holds"


def test_a_slope_that_is_zero_by_chance_is_no_wrong_jacobian():
    x = ca.SX.sym("x")
    model = FirstOrderSystem(x=x, f=-(x**3), x0=0.5, t_end=1, step=0.1)
    run = simulate(FirstOrderSystem(x=x, f=-(x**3) - ca.if_else(x > 0, 3 * x, 0), x0=0.5, t_end=20, step=0.1))
    assert abs(run.x[-1, 0]) < 1e-9
    assert report(model, [run])[0]["F-jacobians"].verdict == "holds"


def test_matrices_near_the_end_of_the_range_of_doubles():
    assert verdicts(linear([[-1e200]], [[1e200]], [[1e200]], law=relay(1)), quick=True)["F-mlcp"] == "holds"


def test_iterates_that_run_away_on_a_wrong_index_set_are_left_out():
    x, lam = ca.SX.sym("x", 1), ca.SX.sym("l", 1)
    model = FirstOrderSystem(
        x=x, f=10 * x**3 - x, h=x + 1 + lam**3 - lam, g=10 * lam, lam=lam, law=complementarity(1), x0=1e60, t_end=1, step=0.5
    )
    assert verdicts(model)["F-unique"] in ("unknown", "sampled", "violated")


# -- uniqueness by exact decisions and by a definite form -------------------------------------------------------------------


def test_a_thin_loss_of_the_p_property_has_a_witness():
    # det W = -1e-4: two solutions for b in a narrow cone only (Samelson, Thrall and Wesler).
    W = np.array([[1.0, 1.0001], [1.0, 1.0]])
    D = W - 0.1 / 1.1 * np.eye(2)
    found = report(linear(-np.eye(2), np.eye(2), np.eye(2), D, complementarity(2), step=0.1))[0]["F-unique"]
    assert found.verdict == "violated"
    assert found.value["solutions"] >= 2


def test_a_law_that_moves_nothing_may_still_have_no_solution():
    model = linear([[0.0]], [[0.0]], [[1.0]], law=complementarity(1), x0=[1.0])
    assert report(model)[0]["F-unique"].verdict == "violated"  # y = x_k < 0
    bounded = linear([[0.0]], [[0.0]], [[1.0]], law=relay(1), x0=[1.0])
    assert report(bounded)[0]["F-unique"].verdict == "holds"


def test_a_step_whose_matrices_vary_is_unique_where_a_form_is_definite():
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    given = {"x": x, "lam": l, "law": relay(2), "x0": [1, 0], "t_end": 1, "step": 0.01}
    soft = FirstOrderSystem(f=[x[1], -ca.sin(x[0])], h=x + (2 + ca.cos(x[0])) * l, g=(1 + 0.1 * x[0] ** 2) * l, **given)
    found = report(soft)[0]["F-unique"]
    assert found.verdict == "holds"
    assert set(found.scope.states) >= {"x_0", "x_1"}
    wrong = FirstOrderSystem(f=[x[1], -ca.sin(x[0])], h=x - (2 + ca.cos(x[0])) * l, g=(1 + 0.1 * x[0] ** 2) * l, **given)
    assert report(wrong)[0]["F-unique"].verdict != "holds"


@pytest.mark.parametrize("seed", range(share(3)))
def test_no_state_has_two_solutions_where_one_is_proved(seed):
    rng = np.random.default_rng(seed)
    for _ in range(12):
        x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 1)
        a, b, c, d = rng.integers(-2, 3, 4).astype(float)
        f = ca.vertcat(x[1], a * ca.sin(x[0]))
        y = c * x[0] + b * ca.fabs(x[1]) + d * l
        model = FirstOrderSystem(
            x=x, lam=l, f=f, h=y, g=ca.vertcat(0, l * (1 + x[0] ** 2)), law=relay(1), x0=[1, 1], t_end=1, step=0.1
        )
        found = report(model)[0]["F-unique"]
        if found.verdict != "holds":
            continue
        lower, upper = np.array(list(found.scope.states.values())).T if found.scope and found.scope.states else (0.5, 1.5)
        grid = np.linspace(-1, 1, 801)
        for x_k in rng.uniform(lower, upper, (5, 2)):  # x(l) by iteration, then the zeros and ends of y(l)
            z = np.tile(x_k[:, None], (1, 801))
            for _ in range(60):
                z = x_k[:, None] + 0.1 * np.array([z[1], a * np.sin(z[0]) + grid * (1 + z[0] ** 2)])
            y = c * z[0] + b * np.abs(z[1]) + d * grid
            count = int(y[0] > 0) + int(y[-1] < 0) + int((np.sign(y[:-1]) * np.sign(y[1:]) < 0).sum())
            assert count == 1
