"""Factors of constraints, families with parameters, inclusions that move: over boxes of parameters, against closed forms."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, LureSystem, MonotoneInclusion, SweepingProcess, box, check, complementarity, relay

p, t = ca.SX.sym("p"), ca.SX.sym("t")
q = ca.SX.sym("q", 2)
SHAPES = ("S-convex", "A0", "A1", "A2", "A3", "A4")


def sweeping(constraints, q0=(3.0, 0.0), f=(0, 0)):
    return SweepingProcess(t=t, q=q, f=ca.vertcat(*f), constraints=constraints, q0=q0, t_end=1, step=0.01, parameters={p: 1.0})


def over(model, ends, **more):
    return check(model, parameters={"p": ends}, quick=True, **more)


@pytest.mark.parametrize(
    "written", [lambda d: p * d, lambda d: d * p**2 / p, lambda d: -(-d * p), lambda d: d / (1 / p), lambda d: (2 * d * p) / 2]
)
def test_a_factor_of_a_distance_scales_gradients_and_leaves_distances(written):
    """g = p (|q - (t, 0)| - 1): |grad g| = p, |d_t g| <= p, |D^2 g| <= p, and the sets are those of p = 1."""
    report = over(sweeping({"disc": written(ca.norm_2(q - ca.vertcat(t, 0)) - 1)}, q0=(3.0, 1.0)), (0.5, 3))
    assert {report[id].verdict for id in SHAPES} == {"holds"}
    assert report["A1"].value["a"] == pytest.approx(0.5, rel=1e-12)
    assert report["A1"].value["a"] <= 0.5
    assert 3 <= report["A1"].value["b"] <= 3 * (1 + 1e-9)
    assert 3 <= report["A2"].value["b"] <= 3 * (1 + 1e-9)
    assert 3 <= report["A4"].value["M_contact"] <= 3 * (1 + 1e-9)
    assert report["A0"].value["c"] == pytest.approx(0.5)


def test_a_factor_of_one_term_alone_is_divided_out_of_the_others():
    """p |q| - 1 = p (|q| - 1/p): outside of a disc of radius 1/p, with |grad| = p and |D^2| = p / |q| <= p^2 in contact."""
    report = over(sweeping({"disc": p * ca.norm_2(q) - 1}), (0.5, 2))
    assert {report[id].verdict for id in SHAPES} == {"holds"}
    assert report["A0"].value["c"] == pytest.approx(0.25)  # half of the least radius
    assert 4 <= report["A4"].value["M_contact"] <= 4 * (1 + 1e-9)


def test_a_factor_that_may_be_0_or_below_is_none():
    for ends in ((0, 1), (-1, 1)):
        assert over(sweeping({"disc": p * (ca.norm_2(q) - 1)}), ends)["A1"].verdict != "holds"
    assert over(sweeping({"disc": p * (ca.norm_2(q) - 1)}), (-2, -1))["S-convex"].verdict == "violated"


@pytest.mark.parametrize("low", [Fraction(1, 2), Fraction(9, 10)])
def test_quadratics_with_a_parameter_are_bounded_on_the_box(low):
    """p q_0^2 + q_1^2 - 1: convex, and |grad|^2 = 4 p^2 q_0^2 + 4 q_1^2 is least in contact at q_1 = 0, where it is 4 p."""
    model = sweeping({"ellipse": p * q[0] ** 2 + q[1] ** 2 - 1})
    report = over(model, (float(low), 1), region={"q": (-3, 3)})
    assert {report[id].verdict for id in SHAPES} == {"holds"}
    assert report["A1"].value["a"] ** 2 <= 4 * low
    assert report["A4"].value["M"] >= 2
    for at in np.linspace(float(low), 1, 5):
        single = check(model, parameters={"p": at}, quick=True, region={"q": (-3, 3)})
        assert single["A1"].value["b"] <= report["A1"].value["b"] * (1 + 1e-9)


def test_gamma_within_rho_of_constraints_with_factors():
    """Two discs times p: g_i <= rho is p g <= rho; where they meet the normals have the gamma of p = 1."""
    discs = {"left": p * (ca.norm_2(q + ca.vertcat(0.5, 0)) - 1), "right": p * (ca.norm_2(q - ca.vertcat(0.5, 0)) - 1)}
    report = over(sweeping(discs, q0=(0.0, 3.0)), (0.25, 2))
    worst = 1 / np.sqrt(1 - 0.5**2)
    assert report["A5'"].verdict == report["A5"].verdict == "holds"
    assert worst <= report["A5'"].value["gamma"] * (1 + 1e-12)
    for at in (0.25, 1.0, 2.0):
        single = check(sweeping(discs, q0=(0.0, 3.0)), parameters={"p": at}, quick=True)
        assert single["A5"].value["attained"] <= report["A5"].value["gamma"] * (1 + 1e-12)


def test_what_has_no_value_at_some_parameter_is_not_proved():
    """sqrt((p - 1.3)^2 - 1e-12) is undefined within 1e-6 of p = 1.3, where no value is tried."""
    hole = ca.sqrt((p - 1.3) ** 2 - 1e-12)
    for g in (q[0] + hole, ca.norm_2(q) - 1 - hole, (1 + hole) * q[0]):
        report = over(sweeping({"g": g}), (1, 2))
        assert not {report[id].verdict for id in ("A0", "A1", "A2", "A4", "S-start")} & {"holds"}
    switched = ca.if_else(t < 0.5, hole, 0)
    assert over(sweeping({"g": q[0] + 1}, f=(switched, 0)), (1, 2))["S-f"].verdict != "holds"


def test_a_velocity_that_switches_with_time_alone_is_lipschitz_for_all_values():
    """f = (p 1_{t < 1/2} - q_0, 0): K_f = 1, |f(t, 0)| <= 2, and no L_t."""
    report = over(sweeping({"g": q[0] + 1}, f=(ca.if_else(t < 0.5, p, 0) - q[0], 0)), (1, 2))
    assert report["S-f"].verdict == "holds"
    assert report["S-f"].value["K_f"] == pytest.approx(1)
    assert report["S-f"].value["L_f"] >= 2
    assert "L_t" not in report["S-f"].value


def test_an_inclusion_that_moves_is_decided_for_all_times_and_values():
    """x' in p cos t - x - N(C(t)), C(t) = [sin(p t), inf): |C'| <= p, the field is contracting."""
    x = ca.SX.sym("x")
    model = MonotoneInclusion(
        t=t, x=x, field=[p * ca.cos(t) - x], lower=[ca.sin(p * t)], x0=[1], t_end=1, step=0.01, parameters={p: 1.0}
    )
    report = over(model, (0.5, 2))
    assert {report[id].verdict for id in ("M-T", "M-C", "M-A1", "M-A2", "M-24", "M-H")} == {"holds"}
    assert 2 <= report["M-H"].value["kappa"] <= 2 * (1 + 1e-9)
    assert report["M-24"].value["L"] == -1
    assert dict(report["M-H"].scope.parameters) == {"p": (0.5, 2)}
    outside = MonotoneInclusion(t=t, x=x, field=[-x], lower=[p - 1 + t], x0=[0.5], t_end=1, step=0.01, parameters={p: 1.0})
    made = {item.name: item.verdict for item in over(outside, (0, 2)).consequences}
    assert made["convergence of the scheme"] == "unknown"  # x0 is outside of C(0) for p > 1.5


def lure(given=(0.5, 1), A=None, C=(1, 0), law=None, **more):
    x = ca.SX.sym("x", 2)
    A = [-x[0], -x[1]] if A is None else A(x)
    model = LureSystem(
        x=x, A=A, B=[1, 0], C=list(C), law=law or complementarity(1), x0=[1, 0], t_end=1, step=0.1, parameters={p: 1.0}, **more
    )
    return over(model, given)


def test_rest_points_of_lure_systems_for_all_values():
    assert lure(law=relay(1))["7.1"].verdict == "holds"
    assert lure((1, 2), law=box([p - 2.5], [1]))["7.1"].verdict == "holds"
    assert lure((1, 2), law=box([p - 1.5], [1]))["7.1"].verdict == "violated"  # 0 < the lower end for p > 1.5
    hole = ca.sqrt((p - 1.3) ** 2 - 1e-12)
    assert lure((1, 2), A=lambda x: [-x[0] * hole, -x[1]], law=relay(1))["7.1"].verdict != "holds"  # A(0) is undefined there


def test_ranges_of_lure_systems_where_C_and_D_move():
    assert {lure(C=(p, 0))[id].verdict for id in ("5.1", "5.2", "5.4a", "5.x0")} == {"holds"}
    assert lure((-1, 1), C=(p, 0))["5.x0"].verdict == "violated"  # C x0 = p < 0
    assert lure((0, 1), C=(p, 0))["5.4a"].verdict == "violated"  # at p = 0 R(C) = {0}
    x = ca.SX.sym("x", 2)
    D = ca.vertcat(ca.horzcat(p, 1), ca.horzcat(-1, p / 4))
    model = LureSystem(
        x=x, A=[-x[0], -x[1]], B=ca.SX.eye(2), C=ca.SX.eye(2), D=D, x0=[1, 1], law=complementarity(2), t_end=1, step=0.1,
        parameters={p: 1.0},
    )  # fmt: skip
    report = over(model, (0, 1))
    assert {report[id].verdict for id in ("4.1", "5.4a", "5.4b", "5.4c", "5.x0")} == {"holds"}
    for at in np.linspace(0, 1, 5):
        single = check(model, parameters={"p": at}, quick=True)
        assert {single[id].verdict for id in ("4.1", "5.4a", "5.4b", "5.4c", "5.x0")} == {"holds"}


def test_energies_up_to_a_factor():
    """x1' = l, x0' = x1, y = p (x0 + x1): P = p P_1, and the least omega is that of p = 1."""
    rates = []
    for C in (ca.horzcat(p, p), ca.horzcat(1, 1)):
        x = ca.SX.sym("x", 2)
        model = LureSystem(x=x, A=[x[1], 0], B=[0, 2], C=C, law=relay(1), x0=[1, 0], t_end=1, step=0.1, parameters={p: 1.0})
        report = over(model, (0.5, 3))
        assert report["5.1"].verdict == report["5.2"].verdict == "holds"
        rates.append(report["5.2"].value["omega"])
    assert rates[0] == pytest.approx(rates[1], rel=1e-6)


def test_steps_of_a_system_that_is_not_affine_where_only_the_law_reads_p():
    """x' = -x^3 + l^2 l_0, |l| <= p: h |W'| <= h 3 x^2 on the box."""
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    model = FirstOrderSystem(
        x=x, lam=l, f=[-(x**3)], g=[l * x], h=[x], law=box([-p], [p]), x0=[0.1], t_end=1, step=0.01, parameters={p: 1.0}
    )
    report = over(model, (0.5, 2), region={"x": (-1, 1)})
    assert {report[id].verdict for id in ("F-jacobians", "F-W", "F-step")} == {"holds"}
    assert report["F-step"].value["h* is at least"] <= 1 / 2 * (1 + 1e-9)  # g_x = l, |l| <= 2
    assert over(model, (-0.5, 2))["F-unique"].verdict == "violated"  # K is empty for p < 0
