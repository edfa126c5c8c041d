"""Hypotheses for all values of parameters in a box: proofs, the values where one fails, and what is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share
from scipy.optimize import linprog

from nsmodel import FirstOrderSystem, LureSystem, check, complementarity, relay
from nsmodel.cli import main
from nsmodel.errors import UsageError
from nsmodel.proof import exact
from nsmodel.proof.parameter_hull import matrix_corners

p = ca.SX.sym("p")


def lure(**parts):
    n = np.shape(parts["x0"])[0]
    given = {"A": -np.eye(n), "law": relay(1), "t_end": 1, "step": 0.1, "parameters": {p: 1.0}}
    return LureSystem(**(given | parts))


def rlc():
    R, L, C = (ca.SX.sym(name) for name in ("R", "L", "C"))
    A = ca.vertcat(ca.horzcat(-R / L, -1 / L), ca.horzcat(1 / C, 0))
    return lure(A=A, B=ca.vertcat(1 / L, 0), C=ca.horzcat(1, 0), law=complementarity(1), x0=[1.0, 0.5],
                parameters={R: 1.0, L: 1.0, C: 1.0})  # fmt: skip


def test_the_energy_of_a_circuit_serves_for_all_values():
    report = check(rlc(), parameters={"R": (0.5, 2), "L": (0.1, 1), "C": (1, 2)}, quick=True)
    assert [report[id].verdict for id in ("4.1", "5.1", "5.2")] == ["holds"] * 3
    assert report["5.2"].value["omega"] == 0
    assert "diag(L, C)" in report["5.1"].how
    assert dict(report["5.2"].scope.parameters) == {"R": (0.5, 2), "L": (0.1, 1), "C": (1, 2)}
    assert report["4.1"].scope is None  # D = 0 is the same for all values
    well = next(item for item in report.consequences if item.name == "well posed")
    assert well.verdict == "holds"
    assert dict(well.scope.parameters) == {"R": (0.5, 2), "L": (0.1, 1), "C": (1, 2)}


def test_a_negative_resistance_costs_what_it_does_at_the_worst_value():
    report = check(rlc(), parameters={"R": (-1, 1), "L": (0.5, 1)}, quick=True)
    worst = max(  # omega of P = diag(L, 1): L x1^2 + x2^2 grows by -2 R x1^2
        -r / at for r in (-1.0, 1.0) for at in (0.5, 1.0)
    )
    assert worst <= report["5.2"].value["omega"] <= worst * (1 + 1e-9)


@pytest.mark.parametrize(
    ("B", "C", "box", "verdict"),
    [
        (p, p, (-1, 1), "holds"),  # P = 1, at p = 0 too, where the rank falls
        (p, 1, (0.5, 2), "holds"),  # P = 1/p
        (p, 1, (0, 2), "violated"),  # at p = 0: B = 0, C' is not
        (p, 1, (-0.9, 2), "violated"),
        (p - 0.3, (p - 0.3) ** 3, (-1, 1), "sampled"),  # P = (p - 0.3)^2, and any P at 0.3
        (ca.exp(p), ca.exp(p), (-1, 1), "holds"),
        (1 / p, p, (0.5, 2), "holds"),
    ],
)
def test_one_pairing(B, C, box, verdict):
    report = check(lure(B=ca.SX(B), C=ca.SX(C), x0=[0.5]), parameters={"p": box}, quick=True)
    assert report["5.1"].verdict == verdict
    if verdict == "violated":
        at = report["5.1"].witness["p"]
        assert box[0] <= at <= 0  # C B = p


def test_a_value_where_the_rank_falls_inside_the_box_is_found():
    B = ca.vertcat(p - 0.375, 0)
    report = check(lure(B=B, C=ca.horzcat(1, 0), x0=[0.5, 0.0]), parameters={"p": (0.375, 2)}, quick=True)
    assert report["5.1"].verdict == "violated"
    assert report["5.1"].witness["p"] == 0.375


@pytest.mark.parametrize(("box", "verdict"), [((0, 1), "holds"), ((0.25, 1), "holds"), ((-0.125, 1), "violated")])
def test_resistance_with_a_gyrator(box, verdict):
    D = ca.vertcat(ca.horzcat(p, 7), ca.horzcat(-7, p**3))
    report = check(lure(B=np.eye(2), C=np.eye(2), D=D, law=relay(2), x0=[0.5, 0.0]), parameters={"p": box}, quick=True)
    assert report["4.1"].verdict == verdict
    if verdict == "violated":
        assert report["4.1"].witness["p"] < 0


def test_a_force_that_depends_on_the_parameter():
    t = ca.SX.sym("t")
    model = LureSystem(t=t, A=ca.sin(p) * 0 - 1, B=1, C=1, f=[1 / (t - p)], law=relay(1), x0=[0.5], t_end=1, step=0.1,
                       parameters={p: 2.0})  # fmt: skip
    well = {box: check(model, parameters={"p": box}, quick=True).consequences[0] for box in ((1.125, 2), (0.75, 2))}
    assert [item.verdict for item in well.values()] == ["holds", "unknown"]
    assert dict(well[1.125, 2].scope.parameters) == {"p": (1.125, 2)}


def test_a_rest_point_for_all_values():
    x = ca.SX.sym("x")
    model = lure(x=x, A=-ca.sin(p * x), B=1, C=1, x0=[0.5])
    assert check(model, parameters={"p": (0.5, 2)}, quick=True)["7.1"].verdict == "holds"
    moved = check(lure(x=x, A=p - ca.cosh(x), B=1, C=1, x0=[0.5]), parameters={"p": (1, 2)}, quick=True)
    assert moved["7.1"].verdict == "violated"


def test_random_systems_are_judged_as_at_dense_values():
    rng = np.random.default_rng(3)
    seen = set()
    for _ in range(share(40, 10)):
        M, N = (rng.integers(-3, 4, (2, 2)).astype(float) for _ in range(2))
        M += 4 * np.eye(2)
        D = ca.DM(M) + p * ca.DM(N)
        report = check(lure(B=np.eye(2), C=np.eye(2), D=D, law=relay(2), x0=[0.5, 0.0]), parameters={"p": (-1, 2)}, quick=True)
        least = min(np.linalg.eigvalsh((S + S.T) / 2)[0] for S in (M + at * N for at in np.linspace(-1, 2, 301)))
        verdict = report["4.1"].verdict
        seen.add(verdict)
        assert (verdict == "holds" and least > -1e-12) or (verdict == "violated" and least < 0), (M, N, verdict, least)
    assert seen == {"holds", "violated"}


def test_other_classes_are_looked_at_at_values():
    report = check(lure(B=1, C=1, A=ca.SX(p), x0=[0.5]), parameters={"p": (-1.0, 1.0)}, quick=True)
    assert report["5.2"].verdict == "holds"
    assert report["5.2"].value["omega"] == 1


x, lam = ca.SX.sym("x", 2), ca.SX.sym("lam", 2)


def first_order(A, B, C, D, h=0.1):
    return FirstOrderSystem(
        x=x, lam=lam, f=A @ x, g=B @ lam, h=C @ x + D @ lam, law=complementarity(2), x0=[1.0, 0.5], t_end=1, step=h,
        parameters={p: 1.0},
    )  # fmt: skip


def test_first_order_systems_over_a_box():
    A = ca.vertcat(ca.horzcat(-p, 3), ca.horzcat(-3, -1 / p))
    model = first_order(A, ca.SX.eye(2), ca.SX.eye(2), p * ca.SX.eye(2))
    report = check(model, parameters={"p": (0.5, 2)}, quick=True)
    assert [report[id].verdict for id in ("F-jacobians", "F-W", "F-mlcp", "F-unique", "F-step")] == ["holds"] * 5
    assert all(item.verdict == "holds" and item.scope.parameters for item in report.consequences)
    growing = check(first_order(p * ca.SX.eye(2), ca.SX.eye(2), ca.SX.eye(2), ca.SX(2, 2)), parameters={"p": (0, 20)}, quick=True)
    assert growing["F-step"].verdict == "violated"  # W = (1 - p / 10) I
    assert growing["F-step"].witness["p"] >= 10


def test_a_matrix_that_is_a_p_matrix_though_not_definite():
    D = ca.vertcat(ca.horzcat(1, p), ca.horzcat(0, 1))
    model = first_order(-ca.SX.eye(2), ca.SX(2, 2), ca.SX.eye(2), D)
    report = check(model, parameters={"p": (2.5, 9)}, quick=True)
    assert report["F-mlcp"].verdict == report["F-unique"].verdict == "holds"
    assert "P-matrix" in report["F-unique"].how


def test_random_first_order_systems_are_judged_as_at_dense_values():
    rng = np.random.default_rng(5)
    held = 0
    count = share(30, 8)
    for _ in range(count):
        A, N, B, C, D = (rng.integers(-2, 3, (2, 2)).astype(float) for _ in range(5))
        D += 2 * np.eye(2)
        model = first_order(ca.DM(A) + p * ca.DM(N), ca.DM(B) * (1 + p), ca.DM(C), ca.DM(D), h=0.05)
        report = check(model, parameters={"p": (-0.5, 1.5)}, quick=True)
        verdicts = {finding.id: finding.verdict for finding in report.findings}

        for at in np.linspace(-0.5, 1.5, 41):
            regular = all(np.linalg.det(np.eye(2) - s * (A + at * N)) > 0 for s in np.linspace(0, 0.05, 11))
            W = 0.05 * C @ np.linalg.solve(np.eye(2) - 0.05 * (A + at * N), B * (1 + at)) + D
            least = min(W[0, 0], W[1, 1], np.linalg.det(W))
            assert regular or verdicts["F-step"] != "holds"
            assert least > 0 or np.linalg.eigvalsh(W + W.T)[0] > -1e-12 or verdicts["F-mlcp"] != "holds"
            assert least > 0 or verdicts["F-unique"] != "holds"
        held += verdicts["F-unique"] == "holds"
        if verdicts["F-unique"] == "violated":
            at = report["F-unique"].witness["p"]
            W = 0.05 * C @ np.linalg.solve(np.eye(2) - 0.05 * (A + at * N), B * (1 + at)) + D
            assert min(W[0, 0], W[1, 1], np.linalg.det(W)) <= 1e-12
    assert held > count / 6


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"p": (1, 1)}, "low < high"),
        ({"p": (2, 1)}, "parameter p = (2, 1)"),
        ({"p": (0, float("inf"))}, "finite"),
        ({"q": (0, 1)}, "'q' is not declared"),
        ({"p": (0, 1, 2)}, "3 values"),
    ],
)
def test_boxes_that_are_none_are_refused(given, words):
    with pytest.raises(UsageError, match="parameter") as caught:
        check(lure(B=1, C=1, x0=[0.5]), parameters=given, quick=True)
    assert words in str(caught.value)


FILE = """
import casadi as ca
from nsmodel import LureSystem, relay
p = ca.SX.sym("p")
model = LureSystem(A=-1, B=p, C=1, law=relay(1), x0=[0.5], t_end=1, step=0.1, parameters={p: 1.0})
"""


def test_the_command_line(tmp_path, capsys):
    path = tmp_path / "one.py"
    path.write_text(FILE)
    assert main(["check", str(path), "--parameters", "p=0.5:2", "--strict"]) == 0
    assert "p in [0.5, 2]" in capsys.readouterr().out
    assert main(["check", str(path), "--parameters", "p=-1:2", "--strict"]) == 1
    for wrong, words in (
        (["--parameters", "p=2"], "expected NAME=LOW:HIGH"),
        (["--parameters", "p=1:2", "--set", "p=1"], "given with --set and with --parameters"),
        (["--parameters", "r=1:2"], "'r'"),
    ):
        assert main(["check", str(path), *wrong]) == 2
        assert words in capsys.readouterr().err


def test_the_values_lie_in_the_hull_of_the_corners():
    z = ca.SX.sym("z", 3)
    M = ca.vertcat(ca.horzcat(-1 / (z[0] * z[1]), z[2] ** 2), ca.horzcat(ca.sqrt(z[0]) * z[2], (z[0] ** 2 - 1) / (z[0] + 1)))
    low, high = np.array([0.5, 1, -1]), np.array([2.0, 3, 2])
    found = matrix_corners([M, z[0]], z, low, high)
    points = np.array([np.concatenate([exact.doubles(part).ravel() for part in own]) for own in found])
    f, rng = ca.Function("f", [z], [M, z[0]]), np.random.default_rng(0)
    for at in rng.uniform(low, high, (50, 3)):
        value = np.concatenate([np.array(part).ravel() for part in f(at)])
        columns = np.vstack([points.T, np.ones(len(points))])
        assert linprog(np.zeros(len(points)), A_eq=columns, b_eq=np.append(value, 1)).status == 0
    assert all(own[0][1, 1] == own[1][0, 0] - 1 for own in found)  # (z^2 - 1)/(z + 1) is read as z - 1
    assert matrix_corners([1 / z[2]], z, low, high) is None
