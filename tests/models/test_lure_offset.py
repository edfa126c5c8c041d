"""Lur'e systems with an offset in y and names of the rows of the law: against closed forms, other classes, shifted states."""

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, LureSystem, ModelError, check, complementarity, product, pwm, relay, simulate, stress
from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.write import certificate_of
from nsmodel.models.lure_system.documents import equations
from nsmodel.study.units import in_units

t = ca.SX.sym("t")


def pushed(**fields):
    """x' = l, 0 <= l ⟂ x - sin 3t >= 0: x is the largest value that sin 3t has had."""
    given = {"law": complementarity(1), "t_end": 2, "step": 1e-3} | fields
    return LureSystem(A=[[0]], B=[1], C=[1], e=-ca.sin(3 * t), t=t, x0=[0.5], **given)


def largest(times):
    """max(1/2, max of sin 3s over s <= t)."""
    return np.where(times < np.pi / 6, np.maximum(0.5, np.sin(3 * np.minimum(times, np.pi / 6))), 1.0)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_wall_that_moves(compiled, own_cache):
    run = simulate(pushed(), compiled=compiled)
    assert run.x[:, 0] == pytest.approx(largest(run.t), abs=2e-6)  # the top of sin 3t lies between two rows
    assert run.y[1:, 0] == pytest.approx(run.x[1:, 0] - np.sin(3 * run.t[1:]), abs=1e-15)
    run = simulate(pushed(), rtol=1e-10, compiled=compiled)
    times = np.linspace(0, 2, 777)
    assert run.at(times).x[:, 0] == pytest.approx(largest(times), abs=1e-9)


@pytest.mark.parametrize(("theta", "gamma"), [(1, 1), (0.5, 1), (0.5, 0.5)])
def test_is_the_first_order_system_that_has_it_in_h(theta, gamma):
    u, x, l = ca.SX.sym("u"), ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    A, B, C, D = np.array([[-1, 2], [-3, -0.5]]), np.array([[1, 0], [0.5, 1]]), np.array([[1, 0.2], [0, 1]]), np.diag([0.3, 0])
    e, law = ca.vertcat(ca.cos(2 * t) - 0.4, u / 2), product(complementarity(1), relay(1))
    common = {"law": law, "x0": [1, -1], "t": t, "t_end": 3, "step": 0.01, "theta": theta, "gamma": gamma}
    common |= {"inputs": {u: pwm(0.7, 0.3)}}
    run = simulate(LureSystem(A=A, B=B, C=C, D=D, e=e, **common))
    other = simulate(FirstOrderSystem(x=x, lam=l, f=ca.DM(A) @ x, g=ca.DM(B) @ l, h=ca.DM(C) @ x + ca.DM(D) @ l + e, **common))
    assert run.x == pytest.approx(other.x, abs=1e-9)
    assert run.multipliers[1:] == pytest.approx(other.multipliers[1:], abs=1e-6)


def test_of_a_potential():
    """x' = -sign-like clutch: l ∈ -d(|y| + y^2/2), y = x + D l + e, solved for l in closed form."""
    y, h, D = ca.SX.sym("y"), 0.01, 0.5
    model = LureSystem(
        A=[[0]], B=[1], C=[1], D=D, e=ca.sin(t), t=t, y=y, phi=ca.fabs(y) + y**2 / 2, x0=[2], t_end=2, step=h,
    )  # fmt: skip
    run, x = simulate(model), 2.0
    for k in range(1, len(run) + 1):
        free = x + np.sin(h * k)  # y = free + (D + h) l, l = -(s + y), s in Sgn(y)
        size = max(abs(free) - (D + h), 0.0) / (1 + D + h)
        x += h * (np.sign(free) * size - free) / (D + h)
        assert run.x[k, 0] == pytest.approx(x, abs=1e-9)


@pytest.mark.long
def test_the_judge_and_other_units_know_it(own_cache):
    found = stress(pushed(), steps=3)
    assert {cell.verdict for cell in found.cells} == {"right"}
    run = simulate(in_units(pushed().bind(), 1e3, 10.0))
    assert run.x[:, 0] / 1e3 == pytest.approx(largest(run.t / 10), abs=2e-6)


# -- hypotheses ----------------------------------------------------------------------------------------------------------


def circuit(e=None, **fields):
    given = {"law": complementarity(1), "x0": [1.0, 0.5], "t_end": 1, "step": 0.01} | fields
    return LureSystem(A=[[-1, -1], [1, 0]], B=[1, 0], C=[1, 0], e=e, **given)


def verdicts(report):
    return {item.id: item.verdict for item in report.findings} | {item.name: item.verdict for item in report.consequences}


@pytest.mark.parametrize("e", [0.25, -0.25, -1.0, -3.0])
def test_a_constant_offset_is_a_shifted_state(e):
    """y = x_0 + e is y = z_0 of z = x + (e, 0): the ranges and the start are those of the shifted model."""
    here = verdicts(check(circuit(e), [], quick=True))
    there = verdicts(check(circuit(x0=[1.0 + e, 0.5]), [], quick=True))
    names = "3.1", "4.1", "5.1", "5.2", "5.4a", "5.4b", "5.4c", "5.x0", "well posed", "contraction"
    assert {name: here[name] for name in names} == {name: there[name] for name in names}
    assert here["7.1"] == ("holds" if e > 0 else "violated")  # 0 is at rest where the diode is open there


def test_a_law_that_cannot_have_it_at_rest():
    assert verdicts(check(circuit(0.5, law=relay(1)), [], quick=True))["7.1"] == "violated"


def test_nothing_is_said_of_solutions_where_it_moves():
    for law in (complementarity(1), relay(1)):
        report = check(circuit(ca.sin(t), t=t, law=law), [], quick=True)
        found = verdicts(report)
        assert [found[name] for name in ("3.1", "4.1", "5.1", "5.2", "5.4b", "5.4c")] == ["holds"] * 6
        assert {found[name] for name in ("7.1", "well posed", "contraction", "Lyapunov stable")} == {"unknown"}
        assert "moves with time" in next(item for item in report.consequences if item.name == "well posed").statement


def test_an_input_in_it_moves():
    u = ca.SX.sym("u")
    for inputs in ({u: ca.sin(t)}, {u: pwm(0.7, 0.3)}):
        found = verdicts(check(circuit(u, law=relay(1), inputs=inputs, t=t), [], quick=True))
        assert found["well posed"] == found["contraction"] == "unknown"
        assert found["5.1"] == "holds"


def test_certificates_know_it():
    report = check(circuit(0.25), [], quick=True)
    certificate = certificate_of(report)
    answers = {s["id"]: verify.answer(certificate["model"], s)[0] for s in certificate["statements"]}
    assert answers["5.4a"] == answers["5.x0"] == "yes"
    assert certificate["model"]["e"] == ["1/4"]
    other = certificate["model"] | {"e": ["-5"]}
    assert verify.answer(other, next(s for s in certificate["statements"] if s["id"] == "5.x0"))[0].startswith("no")
    plain = certificate_of(check(circuit(law=relay(1)), [], quick=True))
    rest = next(s for s in plain["statements"] if s["id"] == "7.1")
    assert verify.answer(plain["model"] | {"e": ["1/4"]}, rest)[0].startswith("no")


def test_for_all_values_of_a_parameter():
    p = ca.SX.sym("p")
    report = check(circuit(p, parameters={p: None}), [], parameters={"p": (-2.0, 1.0)}, quick=True)
    assert verdicts(report)["5.x0"] == "violated"  # at p <= -1
    assert verdicts(report)["5.1"] == "holds"


def test_written_out():
    assert r"y = C\,x + e(t)" in equations(circuit(ca.sin(t), t=t))[0]
    with pytest.raises(ModelError, match="e: shape"):
        circuit([1, 2])
    with pytest.raises(ModelError, match="may depend only"):
        LureSystem(x=(x := ca.SX.sym("x", 1)), A=-x, B=[1], C=[1], e=x, law=relay(1), x0=[1], t_end=1)


# -- names of rows -------------------------------------------------------------------------------------------------------


def named(**fields):
    given = {"law": {"diode": complementarity(1), "clutch": relay(2)}} | fields
    return LureSystem(
        A=-np.eye(3), B=np.eye(3), C=np.eye(3), f=[-1, 0, 0], x0=[1, 2, -1], t_end=1, step=0.1,
        **{"units": {"diode": "A", "clutch": "N"}} | given,
    )  # fmt: skip


def test_rows_have_the_names_of_their_laws(tmp_path):
    run, plain = simulate(named()), simulate(named(law=product(complementarity(1), relay(2)), units={}))
    assert (run.x == plain.x).all()
    assert (run.multipliers[1:] == plain.multipliers[1:]).all()
    assert run.metadata["multiplier_names"] == ["diode", "clutch[0]", "clutch[1]"]
    assert plain.metadata["multiplier_names"] == ["l_0", "l_1", "l_2"]
    assert (run.multiplier("clutch")[1:] == run.multipliers[1:, 1:]).all()
    run.to_csv(tmp_path / "run.csv")
    header = (tmp_path / "run.csv").read_text().splitlines()[0]
    assert "multiplier:diode" in header
    assert "y:clutch[1]" in header
    assert in_units(named().bind(), 2.0, 1.0).multiplier_names == ("diode", "clutch[0]", "clutch[1]")


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ({}, "empty"), ({"a": 1}, "expected {name: law}"), ({"x_0": relay(3)}, "also the name of a state"),
        ({"a": relay(1), "b": 2}, "'b': 2"), ({"t": relay(3)}, "time"),
    ],
)  # fmt: skip
def test_bad_names_are_refused(law, words):
    with pytest.raises(ModelError, match=words):
        named(law=law, units={})
