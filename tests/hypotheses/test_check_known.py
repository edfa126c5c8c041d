"""Known answers, from the model to the report: closed forms that can be derived on paper."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    check,
    complementarity,
    relay,
    simulate,
)


def consequence(report, name):
    return next(item for item in report.consequences if item.name == name)


# ---------------------------------------------------------------------------------------------- sweeping processes


def discs(centres, r, **given):
    """Discs of one radius that may not overlap."""
    n = len(centres)
    q = ca.SX.sym("q", 2 * n)
    p = ca.vertsplit(q, 2)
    pairs = {f"pair {i}-{j}": ca.norm_2(p[j] - p[i]) - 2 * r for i in range(n) for j in range(i + 1, n)}
    return SweepingProcess(q=q, constraints=pairs, q0=np.ravel(centres), t_end=1, step=0.1, **given)


@pytest.mark.parametrize("r", [1e-3, 0.3, 40.0])
def test_two_discs(r):
    report = check(discs([(-r, 0), (r, 0)], r))
    assert report["A5'"].verdict == report["A1"].verdict == report["A4"].verdict == "holds"
    assert report["A5'"].value["gamma"] == pytest.approx(1, rel=1e-12)
    assert report["A1"].value["a"] == pytest.approx(np.sqrt(2), rel=1e-12)
    assert report["A1"].value["b"] == pytest.approx(np.sqrt(2), rel=1e-12)
    assert report["A4"].value["M_contact"] == pytest.approx(1 / r, rel=1e-12)
    assert consequence(report, "prox-regular").value["eta"] == pytest.approx(np.sqrt(2) * r, rel=1e-12)


@pytest.mark.parametrize("k", [3, 4])
def test_discs_in_a_row(k):
    """Normals of neighbouring contacts have the product -1/2; inverting tridiag(-1/2, 1, -1/2) gives gamma^2 = (k^3 - k)/6."""
    finding = check(discs([(2 * i, 0) for i in range(k)], 1.0), quick=True)["A5'"]
    row = np.sqrt((k**3 - k) / 6)
    assert finding.verdict in ("holds", "sampled")
    assert finding.value["gamma"] >= row * (1 - 1e-12)
    assert finding.value["attained"] == pytest.approx(row, rel=1e-9)
    assert finding.value["gamma"] <= 1.001 * row


@pytest.mark.parametrize("psi", [0.3, np.pi / 2, 2.5])
def test_two_planes_whose_normals_make_an_angle(psi):
    q = ca.SX.sym("q", 2)
    walls = {"left": q[0], "right": np.cos(psi) * q[0] + np.sin(psi) * q[1]}
    report = check(SweepingProcess(q=q, constraints=walls, q0=[1, 1], t_end=1, step=0.1))
    for id in ("A5", "A5'"):
        assert report[id].verdict == "holds"
        assert report[id].value["gamma"] == pytest.approx(1 / np.cos(psi / 2), rel=1e-9)


def test_opposite_walls_that_touch():
    q = ca.SX.sym("q", 2)
    model = SweepingProcess(q=q, constraints={"floor": q[1], "ceiling": -q[1]}, q0=[0, 0], t_end=1, step=0.1)
    for report in (check(model), check(model, quick=True)):
        finding = report["A5'"]
        assert finding.verdict == "violated"
        assert finding.value["gamma"] == np.inf
        assert dict(zip(finding.witness["constraints"], finding.witness["weights"], strict=True)) == {
            "floor": 0.5,
            "ceiling": 0.5,
        }
        assert consequence(report, "well posed").verdict == "unknown"


def test_the_error_constant_is_never_violated_by_the_error(load_case, run_case):
    for stem in ("moving_disc", "point_past_disc", "two_discs", "moving_half_line"):
        model, run = load_case(stem), run_case(stem)
        value = consequence(check(model, [run]), "order 1/2").value
        assert value["order"] == 0.5
        error = np.linalg.norm(run.x - model.exact(run.t), axis=1).max()
        assert np.log10(max(error, 1e-300)) <= value["log10 C_0"] + np.log10(model.step) / 2


# ---------------------------------------------------------------------------------------------- Lur'e systems


def lure(B, C, D=None, law=None, A=None, **given):
    B = np.atleast_2d(np.asarray(B, float))
    n, m = B.shape
    return LureSystem(
        A=np.zeros((n, n)) if A is None else A, B=B, C=C, D=D, law=law or relay(m), x0=np.ones(n), t_end=1, step=0.1, **given
    )


def test_diode_bridge(load_case, run_case):
    report = check(load_case("diode_bridge"), [run_case("diode_bridge")])
    C, L = 1e-6, 1e-2
    P = np.array(report["5.1"].witness["P"])
    assert P[0] == pytest.approx([C, 0], rel=1e-12)  # the other block is free
    assert P[1, 1] > 0
    best = np.array(report["5.2"].witness["P_omega"])
    assert best / best[0, 0] == pytest.approx(np.diag([1, L / C]), rel=1e-9)
    assert report["5.2"].value["omega"] == 0
    assert report["4.1"].verdict == "holds"
    assert "rank of D + D' = 1" in report["4.1"].how
    assert consequence(report, "Lyapunov stable").verdict == "holds"
    assert consequence(report, "globally asymptotically stable").verdict == "unknown"


@pytest.mark.parametrize("values", [{}, {"m1": 3, "mu1": 0.2, "m2": 0.5, "mu2": 7}])
def test_two_masses_have_the_P_of_example_6_2(values, load_case):
    report = check(load_case("two_masses"), parameters=values, quick=True)
    m1, mu1, m2, mu2 = (values.get(name, 1) for name in ("m1", "mu1", "m2", "mu2"))
    P = np.array(report["5.1"].witness["P"])
    assert np.diag(P)[[1, 3]] == pytest.approx([m1 / mu1, m2 / mu2], rel=1e-12)
    assert np.abs(P[[1, 3]]).sum() == pytest.approx(m1 / mu1 + m2 / mu2, rel=1e-12)
    assert np.linalg.eigvalsh(P).min() > 0


def test_a_stiff_rectifier_is_judged_relatively():
    """C = 1 nF beside L = 1 H: x = (v, i), P = diag(C, L) has the condition number 1e9, and P B = C' holds."""
    C, L, R = 1e-9, 1.0, 1.0
    model = lure([[-1 / C], [0]], [[-1, 0]], [[R]], complementarity(1), A=[[0, -1 / C], [1 / L, 0]])
    report = check(model)
    assert report["5.1"].verdict == "holds"
    assert report["5.2"].verdict == "holds"
    assert report["5.2"].value["omega"] == 0
    assert report["5.2"].value["cond P"] == pytest.approx(1e9, rel=1e-6)


@pytest.mark.parametrize(
    ("B", "C", "words", "witness"),
    [
        ([[-1], [0]], [[1, 0]], "C B is not psd", "v"),  # anti-relay
        ([[0, 0], [10, 3]], [[1, 0], [0, 1]], "C B", "skew part"),  # twisting controller
        ([[1], [0]], [[0, 1]], "rank C B < rank B", "B v"),
        ([[1, 1], [0, 0]], [[1, 0], [0, 1]], "ker B", "C'v"),
    ],
)
def test_where_no_P_exists_the_witness_shows_why(B, C, words, witness):
    finding = check(lure(B, C), quick=True)["5.1"]
    assert finding.verdict == "violated"
    assert words in finding.how
    assert any(witness in name for name in finding.witness)
    assert np.isfinite(list(finding.value.values())).all()


def test_painleve_rod_is_monotone_up_to_four_thirds():
    """m N = ... with D(mu) = 1 + 3 c^2 - 3 mu s c at tan = 2: 8/5 - 6/5 mu, so that psd means mu <= 4/3."""
    mu = ca.SX.sym("mu")
    D = (8 - 6 * mu) / 5
    for value, verdict in ((1.333, "holds"), (1.334, "violated"), (4, "violated")):
        report = check(lure([[1]], [[1]], D, complementarity(1), parameters={mu: value}), quick=True)
        assert report["4.1"].verdict == verdict
    finding = check(lure([[1]], [[1]], D, complementarity(1), parameters={mu: None}))["4.1"]
    assert finding.verdict == "unknown"
    assert "4/3" in finding.how


def test_painleve_rod_with_parameters_of_which_one_has_a_value():
    mu, scale = ca.SX.sym("mu"), ca.SX.sym("scale")
    model = lure([[1]], [[1]], scale * (8 - 6 * mu) / 5, complementarity(1), parameters={mu: None, scale: None})
    assert "4/3" in check(model, parameters={"scale": 2})["4.1"].how


# ---------------------------------------------------------------------------------------------- oscillators


def oscillator(theta, **given):
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=x**2 / 2, friction=theta(s), s=s, t_end=5, step=0.1, **({"x0": 2} | given))


def test_friction_that_falls_with_speed_is_refuted_at_a_speed():
    finding = check(oscillator(lambda s: s - s**2))["O-theta"]
    assert finding.verdict == "violated"
    assert finding.value["min theta''"] == -2
    assert 1 - 2 * finding.witness["s"] < 0


def test_example_4_3_has_all_hypotheses_and_no_finite_convergence(load_case, run_case):
    report = check(load_case("cabot_4_3"), [run_case("cabot_4_3")])
    assert {report[id].verdict for id in ("O-theta", "O-g", "O-dry", "O-steps")} == {"holds"}
    finite = consequence(report, "finite convergence")
    assert finite.verdict == "unknown"
    assert abs(finite.value["margin"]) < 1e-10


@pytest.mark.parametrize(("a", "w"), [(1.0, 1.0), (0.25, 2.0)])
def test_the_predicted_rest_interval(a, w):
    """d(0, dg(x)) = w^2 |x| <= a."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = FrictionOscillator(x=x, potential=w**2 * x**2 / 2, friction=a * s, s=s, x0=3, t_end=60, step=0.01)
    run = simulate(model)
    value = consequence(check(model, [run]), "rest points").value
    assert [value["least x_inf"], value["largest x_inf"]] == pytest.approx([-a / w**2, a / w**2], rel=1e-9)
    assert -a / w**2 <= run.x[-1, 0] <= a / w**2


# ---------------------------------------------------------------------------------------------- inclusions


@pytest.mark.parametrize(("a", "b"), [(1.0, -1.0), (0.5, 3.0), (0.0, 1.0)])
def test_example_8_1(a, b):
    x = ca.SX.sym("x")
    report = check(MonotoneInclusion(x=x, field=b - a * x, operator=x, lower=0, x0=2, t_end=1, step=0.01), quick=True)
    assert report["M-A3"].value["alpha"] == pytest.approx((1 + a) / 2, rel=1e-12)
    assert report["M-A3"].value["beta"] == pytest.approx(b**2 / (2 * (1 + a)), rel=1e-12)
    assert report["M-24"].value["L"] == pytest.approx(-(1 + a), rel=1e-12)
    assert all(finding.verdict == "holds" for finding in report.findings)


def test_the_margin_of_a_cone_is_left_out_and_not_printed_as_nan():
    """The margin is that of half-lines; a second-order cone has none."""
    model = nsmodel.LureSystem(
        A=-np.eye(3), B=np.eye(3), C=np.eye(3), law=nsmodel.second_order_cone(3), x0=[2, 1, 0], t_end=1, step=0.1
    )
    report = nsmodel.check(model, quick=True)
    assert report["5.x0"].verdict == "holds"
    assert all(not np.isnan(number) for finding in report.findings for number in finding.value.values())
    assert "nan" not in report.text()


def test_runs_that_agree_are_not_called_exact():
    """x' in -Sgn x from 0 stays there with any step: runs agree, which proves nothing about another solution."""
    model = nsmodel.LureSystem(A=0, B=-1, C=1, law=nsmodel.relay(1), x0=0, t_end=1, step=0.05)
    report = nsmodel.check(model)
    (order,) = (item for item in report.consequences if item.name == "observed order")
    assert "agree to rounding" in order.statement
    assert "exact" not in order.statement


# -- parts without a value ---------------------------------------------------------------------------------------------

X, L = ca.SX.sym("q"), ca.SX.sym("l")
HOLE = X * (1 / X + 1)  # 1 + x off 0, with the derivative 1; at 0 there is no value
U = 1 / X
CANCELLED = (U + X**2 + X) - (U + X**2)  # x off 0


@pytest.mark.parametrize(
    "drift", [-HOLE, -CANCELLED, -X - X * ca.log(X**2) / 99, -X * (1 + ca.sqrt(X - 1)), -X * ca.acos(X + 2)], ids=str
)
def test_zero_times_undefined_is_no_rest_point(drift):
    z = ca.SX.sym("z")
    model = LureSystem(x=ca.vertcat(X, z), A=[drift, -z], B=[0.5, 0], C=[1, 0], law=relay(1), x0=[0.5, 0.5], t_end=1, step=0.1)
    report = check(model, quick=True)
    assert report["7.1"].verdict == "violated"
    assert report["7.1"].how == "A(0) = 0 fails: A has no value at 0."
    assert report["5.2"].verdict != "holds" or report["5.2"].scope.states["q"][0] > 0
    stable = {item.name: item.verdict for item in report.consequences}
    assert stable["globally asymptotically stable"] == stable["Lyapunov stable"] == "unknown"


def test_zero_times_what_has_a_value_is_zero():
    """x sin(x + 1), x/(3 + cos x), x^2 atan(exp(x)): 0 at 0, exactly, though the other factor is irrational there."""
    for drift in (-X * ca.sin(X + 1), -X / (3 + ca.cos(X + 1)), -(X**2) * ca.atan(ca.exp(X) + 1), -X * ca.sqrt(X + 2)):
        model = LureSystem(x=X, A=drift, B=[1], C=[1], law=relay(1), x0=[0.5], t_end=1, step=0.1)
        assert check(model, quick=True)["7.1"].verdict == "holds", drift


def test_a_function_with_a_hole_is_not_affine():
    """Everything whose derivatives are constant, but that has no value at 0: nothing is said of all states."""
    shared = {"x0": [-0.5], "t_end": 1, "step": 0.1}
    models = {
        "f": FirstOrderSystem(x=X, lam=L, f=-HOLE, g=L, h=X, law=relay(1), **shared),
        "h": FirstOrderSystem(x=X, lam=L, f=-X, g=L, h=HOLE + L, law=relay(1), **shared),
        "A": LureSystem(x=X, A=-HOLE, B=[1], C=[1], law=relay(1), **shared),
        "wall": SweepingProcess(q=X, f=[0], constraints={"wall": 2 + HOLE}, q0=[-0.5], t_end=1, step=0.1),
        "field": MonotoneInclusion(x=X, field=-HOLE, **shared),
    }
    asked = {"f": ("F-jacobians", "F-unique", "F-W", "F-step"), "h": ("F-jacobians", "F-unique"), "A": ("5.2",),
             "wall": ("S-convex", "A0", "A1", "A4"), "field": ("M-A1", "M-A2", "M-A3", "M-24")}  # fmt: skip
    for name, model in models.items():
        report = check(model, quick=True)
        wide = check(model, quick=True, region={"q": (-1, 1)})
        for id in asked[name]:
            assert report[id].verdict != "holds" or report[id].scope.states["q"][1] < 0, (name, id)
            assert wide[id].verdict != "holds" or id in ("F-W", "F-step", "A1", "A4"), (name, id)
    g = FirstOrderSystem(x=X, lam=L, f=-X, g=L * (1 / L + 1), h=X, law=relay(1), **shared)
    assert {check(g, quick=True)[id].verdict for id in ("F-jacobians", "F-unique")} == {"unknown"}


def test_a_start_without_a_value_is_not_admissible():
    model = SweepingProcess(q=X, f=[0], constraints={"wall": 1 + X * ca.log(X)}, q0=[0], t_end=1, step=0.1)
    finding = check(model, quick=True)["S-start"]
    assert (finding.verdict, finding.how) == ("violated", "g_i(0, q_0) has no value")


@pytest.mark.parametrize(
    ("field", "grows"),
    [
        (ca.fmin(X**2, ca.cos(ca.acos(X))), True),  # x^2 beyond 1, where acos has no value
        (ca.fmax(ca.sin(ca.sqrt(X)), -(X**2)), True),
        (ca.if_else(ca.cos(ca.acos(X)) < 2, 1, X**3), True),
        (ca.fmin(X**2, 5 + ca.fabs(X)), False),
        (ca.fmin(ca.sqrt(X**2 + 1), X**4), False),
    ],
    ids=str,
)
def test_growth_of_what_is_chosen_beside_an_undefined_part(field, grows):
    found = check(MonotoneInclusion(x=X, field=-field, x0=[0.5], t_end=1, step=0.1), quick=True)["M-A2"]
    assert (found.verdict == "holds") == (not grows)
    if not grows:
        x = np.linspace(-1e3, 1e3, 20_001)
        values = np.abs(np.array(ca.Function("F", [X], [field])(x[None, :])).ravel())
        assert (values <= found.value["a_1"] + found.value["a_2"] * np.abs(x)).all()
