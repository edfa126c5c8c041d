"""What a user asks of derivatives: names, times, sides, gradients, functions for optimisers, files, what is refused."""

from __future__ import annotations

import json
import re
import shutil

import casadi as ca
import numpy as np
import pytest
from derivative_models import extrapolated
from event_scenes import relay_of_degree_2
from fuzz_models import COUNT, FULL

import nsmodel
from nsmodel import FirstOrderSystem, LureSystem, StepError, UsageError, pwm, relay, sensitivity, table
from nsmodel.cli import main
from nsmodel.modeling.variants import start_entries

HAS_COMPILER = shutil.which("gcc") is not None
A, K, U, T = (ca.SX.sym(name) for name in ("a", "k", "u", "t"))


def oscillator(signal=1.0, t_end=5.0, **more):
    given = {
        "A": ca.blockcat([[0, 1], [-K, -0.1]]),
        "B": [0, 1],
        "C": [0, 1],
        "f": [0, U],
        "law": relay(1, -A, A),
        "x0": [0.3, 0.2],
    }
    return LureSystem(names=["z", "v"], **given | more, parameters={A: 0.3, K: 2.0}, inputs={U: signal}, t_end=t_end, step=0.01)


SIGNALS = {
    "pwm": (pwm(1.3, 0.4, phase=0.2, low=-1, high=1.5), ["u.duty", "u.period", "u.phase", "u.low", "u.high"]),
    "leading": (pwm(1.3, 0.4, phase=0.2, kind="leading"), ["u.duty", "u.period", "u.phase"]),
    "centre": (pwm(1.3, 0.4, phase=0.2, kind="centre"), ["u.duty", "u.period", "u.phase"]),
    "constant": (1.2, ["u"]),
    "held": (table([0, 1, 2.5, 4], [1, -1, 0.5, 2.0]), ["u[0]", "u[1]", "u[3]", "u.t[1]", "u.t[3]"]),
    "lines": (table([0, 1, 2.5, 4], [1, -1, 0.5, 2.0], "linear"), ["u[0]", "u[1]", "u[3]", "u.t[1]", "u.t[3]"]),
    "spline": (table([0, 1, 2.5, 4], [1, -1, 0.5, 2.0], "cubic"), ["u[0]", "u[1]", "u[3]"]),
    "repeated": (table([0.1, 1, 1.6], [1, -1, 0.5], after="periodic", period=2.0), ["u[0]", "u[2]", "u.t[1]", "u.period"]),
    "repeated lines": (table([0.1, 1, 1.6], [1, -1, 1], "linear", after="periodic"), ["u[1]", "u.t[1]"]),
}


@pytest.mark.parametrize("name", SIGNALS)
def test_by_the_numbers_of_signals(name):
    signal, by = SIGNALS[name]
    found = sensitivity(oscillator(signal), by=[*by, "a"], at=[1.7, 4.9], rtol=1e-11, compiled=False)
    np.testing.assert_allclose(found.jacobian, extrapolated(oscillator(signal), [*by, "a"], at=[1.7, 4.9]), rtol=1e-7, atol=1e-9)


def test_a_table_of_a_thousand_entries():
    rng, entries = np.random.default_rng(1), 1000 if COUNT == FULL else 200
    t, values = np.linspace(0, 5, entries, endpoint=False), rng.normal(size=entries)
    model = oscillator(table(t, values))
    by = [f"u[{i}]" for i in range(entries)]
    found = sensitivity(model, by=by, rtol=1e-9)
    differences = extrapolated(model, [by[17], by[entries // 2]], compiled=HAS_COMPILER)
    np.testing.assert_allclose(found.of("z")[0, [17, entries // 2]], differences[0, 0], rtol=1e-6, atol=1e-10)
    w = rng.normal(size=2)
    np.testing.assert_allclose(found.gradient(w), w @ found.jacobian[0])


def test_a_run_that_ends_on_an_edge_says_which_side_it_gives():
    for t_end, count in ((1.5, 1), (1.6, 0)):
        model = oscillator(pwm(1.0, 0.5))
        found = sensitivity(model, by="u.duty", t_end=t_end, compiled=False)
        assert len([text for text in found.warnings if "the run ends on an edge of 'u' that moves" in text]) == count


def test_both_sides_of_an_event():
    """At an edge whose time moves x is what it was before, or what it is after."""
    model = oscillator(pwm(1.0, 0.5, low=-1.0), law=relay(1, -0.001, 0.001))
    found = sensitivity(model, by="u.duty", at=[1.5, 1.7], compiled=False, rtol=1e-10)
    assert np.abs(found.before[0] - found.jacobian[0]).max() > 1
    np.testing.assert_array_equal(found.before[1], found.jacobian[1])
    for side, sign in ((found.before[0], 1), (found.jacobian[0], -1)):
        near = sensitivity(model, by="u.duty", at=1.5 - sign * 1e-7, compiled=False, rtol=1e-10).jacobian[0]
        np.testing.assert_allclose(side, near, atol=1e-5)


def test_what_is_one_sided_is_said_with_numbers():
    on_surface = LureSystem(A=[[-1]], B=[1], C=[1], f=[2], law=relay(1), x0=[0.0], t_end=1.0, step=0.1)
    assert any("starts on the switch of 'l_0'" in text for text in sensitivity(on_surface, by="x(0)", compiled=False).warnings)


def two_at_once(first):
    """Rates 2.6 before; (1.8, 2.2) where row 0 comes first, (2.2, 1.8) where row 1 does; 1.4 after both."""
    return LureSystem(A=np.zeros((2, 2)), B=[[1, 0.5], [0.5, 1]], C=np.eye(2), f=[2, 2], law=relay(2, -0.4, 0.4),
                      x0=[first, -1.0], t_end=0.6, step=0.1)  # fmt: skip


def test_two_switches_at_once_are_said_with_both_numbers():
    found = sensitivity(two_at_once(-1.0), by="x_0(0)", compiled=False)
    (text,) = found.warnings
    assert re.search(r"'l_[01]' and 'l_[01]' switch at once", text)
    assert {float(one) for one in re.findall(r"\(([-.\d]+)\)", text)} == {0.0, float(f"{-1 / 2.6:.6g}")}
    later = 0.4 / (2.6 * 2.2)  # By which row 1 comes later where row 0 is first.
    sides = {-0.999: (1 - 0.8 / 2.6 + 0.4 * later, -0.4 / 2.6 + 0.8 * later), -1.001: (1 - 0.8 / 2.2, -0.4 / 2.2)}
    for first, exact in sides.items():
        side = sensitivity(two_at_once(first), by="x_0(0)", rtol=1e-12, compiled=False)
        np.testing.assert_allclose(side.jacobian[0, :, 0], exact, rtol=1e-10)
        assert not side.warnings


def two_inputs(rate, other):
    d = ca.SX.sym("d")
    return LureSystem(A=[[-A]], B=[1], C=[1], f=[rate(d)], law=relay(1, -0.1, 0.1), x0=[0.5], inputs={U: pwm(1.0, 0.5), d: other},
                      parameters={A: 1.0}, t_end=3.3, step=0.1)  # fmt: skip


def test_edges_of_two_inputs_at_one_time_move_apart():
    """What each does alone is added; where it does not add up there is a derivative for each order of the edges."""
    for other in (pwm(1.0, 0.5), pwm(1.0, 0.5, low=1, high=0), table([0, 0.5, 2], [0, 1, 0.3], "linear")):
        model = two_inputs(lambda d: U + 2 * d, other)
        by = ["u.duty", "u.period", "d.t[1]" if "d.t[1]" in {f"d{one}" for one in other.numbers} else "d.duty"]
        found = sensitivity(model, by=by, rtol=1e-11, compiled=False)
        np.testing.assert_allclose(found.jacobian, extrapolated(model, by, width=1e-5), rtol=1e-7, atol=1e-9)
        assert not found.warnings
    with pytest.raises(StepError, match=r"edges of u, d are at one time and move apart"):
        sensitivity(two_inputs(lambda d: U * d, pwm(1.0, 0.5)), by="u.duty", compiled=False)


def test_a_run_that_touches_a_switch_has_no_derivative_or_a_large_one():
    """x'' = 1 from x = a, x' = -1: its least value is a - 1/2; beyond, force is another."""
    x = ca.SX.sym("x", 2)
    model = FirstOrderSystem(x=x, f=[x[1], 1 + 5 * ca.if_else(x[0] < 0, 1, 0)], x0=[0.5, -1.0], t_end=2.0, step=0.1)
    near = FirstOrderSystem(x=x, f=[x[1], 1 + 5 * ca.if_else(x[0] < 0, 1, 0)], x0=[0.5 - 1e-11, -1.0], t_end=2.0, step=0.1)
    found = sensitivity(near, by="x_0(0)", rtol=1e-12, compiled=False)
    assert any("of its mean rate" in text for text in found.warnings)
    assert found.margins["transversality"] < 1e-4
    assert np.isfinite(sensitivity(model, by="x_0(0)", rtol=1e-12, compiled=False).jacobian).all()


def test_a_start_on_the_switch_of_a_branch_is_said_where_the_rate_jumps():
    """x' is 1 above p and 2 below, from x = p = 0.2: by p x(1) goes with 1/2 from below and 0 from above; not so over a kink."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    given = {"x": x, "x0": [0.2], "parameters": {p: 0.2}, "t_end": 1.0, "step": 0.01}
    jump = sensitivity(FirstOrderSystem(f=[ca.if_else(x >= p, 1, 2)], **given), by="p")
    (warning,) = jump.warnings
    assert "the run starts on the switch of 'a switch in f': the derivative is one-sided" in warning
    assert jump.jacobian.item() == pytest.approx(0.0, abs=1e-12)
    assert not sensitivity(FirstOrderSystem(f=[1 + ca.fabs(x - p)], **given), by="p").warnings
    away = sensitivity(FirstOrderSystem(f=[ca.if_else(x >= p, 1, 2)], **given | {"x0": [0.1]}), by="p")
    assert not away.warnings
    assert away.jacobian.item() == pytest.approx(0.5, abs=1e-12)


def test_how_near_a_condition_comes_to_a_switch_that_it_does_not_reach():
    """A parabola over the edge of |y|; a force that friction holds; none where conditions are 0 at their own switches alone."""
    x, gap, t = ca.SX.sym("x", 2), ca.SX.sym("gap"), ca.SX.sym("t")
    model = FirstOrderSystem(x=x, f=[1, ca.fabs((x[0] - 1) ** 2 + gap)], x0=[0, 0], parameters={gap: 1e-6}, t_end=3.0, step=0.01)
    near = sensitivity(model, by="gap")
    assert 2.4e-7 < near.margins["graze"] < 2.6e-7  # 1e-6 of 4
    (warning,) = near.warnings
    assert "'a switch in f' comes to 2" in warning
    far = sensitivity(model, by="gap", parameters={"gap": 0.1})
    np.testing.assert_allclose(far.margins["graze"], 0.1 / 4.1, rtol=0.02)
    assert not far.warnings
    held = LureSystem(A=[[0]], B=[1], C=[1], f=[A * ca.sin(t)], t=t, law=relay(1), x0=[0], parameters={A: 0.9}, t_end=9, step=0.1)
    np.testing.assert_allclose(sensitivity(held, by="a").margins["graze"], 0.1 / 1.9, rtol=0.02)
    decays = LureSystem(A=[[-3]], B=[1], C=[1], law=relay(1, -A, A), D=[1], x0=[2], parameters={A: 0.3}, t_end=20, step=0.1)
    assert sensitivity(decays, by="a").margins["graze"] > 1e-3
    crosses = LureSystem(A=[[0]], B=[1], C=[1], f=[2], law=relay(1), x0=[-1.0], t_end=2.0, step=0.1)
    assert sensitivity(crosses, by="x(0)").margins["graze"] == np.inf


def test_growth_is_warned_of():
    x = ca.SX.sym("x")
    model = FirstOrderSystem(x=x, f=[12 * (x - 1)], x0=[1.0], t_end=3.2, step=0.1)
    found = sensitivity(model, by="x(0)", compiled=False)
    np.testing.assert_allclose(found.jacobian[0, 0], np.exp(38.4), rtol=1e-7)
    assert any("rounding" in text for text in found.warnings)


def test_as_a_function_for_ipopt():
    """A parameter found through switches: the relay's end for which x is where it was."""
    model = oscillator(1.0)
    target = sensitivity(model, by="a", parameters={"a": 0.45}, compiled=False).value[0]
    run = sensitivity(model, by="a", compiled=False).as_function()
    a = ca.MX.sym("a")
    problem = {"x": a, "f": ca.sumsqr(run(a) - target)}
    options = {"ipopt": {"print_level": 0, "hessian_approximation": "limited-memory", "tol": 1e-12}, "print_time": False}
    found = ca.nlpsol("fit", "ipopt", problem, options)(x0=0.2, lbx=0.05, ubx=1.0)
    assert float(found["x"]) == pytest.approx(0.45, abs=1e-6)
    both = sensitivity(model, by=["k", "z(0)", "u"], at=[2.0, 5.0], compiled=False)
    function, numbers = both.as_function("two"), np.array([2.1, 0.2, 0.9])
    moved = ca.Function("J", [z := ca.MX.sym("z", 3)], [ca.jacobian(function(z), z)])
    step = 1e-6 * np.eye(3)
    for j in range(3):
        difference = (np.array(function(numbers + step[j])) - np.array(function(numbers - step[j]))).ravel() / 2e-6
        np.testing.assert_allclose(np.array(moved(numbers))[:, j], difference, atol=2e-5)


def test_the_error_is_estimated_by_another_run():
    found = sensitivity(oscillator(), by=["a", "k"], rtol=1e-5, compiled=False)
    exact = sensitivity(oscillator(), by=["a", "k"], rtol=1e-13, compiled=False).jacobian
    error = np.abs(found.jacobian - exact)
    assert (error <= 1.1 * found.error + 1e-13).all()
    assert found.error.max() < 1e-4


@pytest.mark.parametrize(("given", "message"), [
    ({"by": "m"}, "'m' is not a parameter, start or number of a signal.*becomes a parameter by a symbol"),
    ({"by": ["k", "k"]}, "'k' is given twice"), ({"by": []}, "expected names"), ({"by": "u.dty"}, "Did you mean 'u.duty'"),
    ({"by": ca.SX.sym("k") + 1}, "expected the name of a parameter"), ({"by": "z"}, r"Did you mean 'z\(0\)'"),
    ({"by": "k", "at": 7.0}, "expected times from 0 to t_end = 5"), ({"by": "k", "at": [2, 1]}, "increasing"),
    ({"by": "k", "at": "soon"}, "expected a time"), ({"by": "k", "outputs": "q"}, "'q' is not a column"),
    ({"by": "k", "outputs": ca.SX.sym("velocity")}, "'velocity' is not a column"),
    ({"by": "k", "method": "adjoint"}, "expected one of"),
    ({"by": "k", "integrals": {"z": A}}, "'z' is an output already"),
    ({"by": "k", "step": 0.1}, "step is of method='differences'"),
    ({"by": "k", "rtol": 2.0}, "rtol"),
])  # fmt: skip
def test_bad_input(given, message):
    with pytest.raises(UsageError, match=message):
        sensitivity(oscillator(pwm(1.3, 0.4)), compiled=False, **given)


def test_one_model_asked_many_questions_answers_as_each_does_alone():
    """Its equations are kept by what they depend on: names, their order, and the values of the other parameters."""
    a, k = ca.SX.sym("a"), ca.SX.sym("k")

    def model():
        law = relay(1, -a, a)
        return LureSystem(
            A=[[0, 1], [-k, 0]], B=[0, 1], C=[0, 1], law=law, x0=[5.3, 0.0], parameters={a: 1, k: 1}, t_end=5, step=0.01
        )

    questions = [
        {"by": ["a", "k"]}, {"by": ["k", "a"]}, {"by": ["a", "k"], "outputs": ["x_1"]}, {"by": "a", "parameters": {"k": 2.0}},
        {"by": "a", "parameters": {"k": 3.0}}, {"by": ["a", "x_0(0)"]}, {"by": "a", "outputs": ca.SX.sym("x_0") * 2},
    ]  # fmt: skip
    one = model()
    for asked in questions * 2:
        np.testing.assert_array_equal(sensitivity(one, **asked).jacobian, sensitivity(model(), **asked).jacobian)


def test_names_that_are_none_of_the_results():
    found = sensitivity(oscillator(), by="k", compiled=False)
    with pytest.raises(UsageError, match="output: 'q' is none of z, v"):
        found.of("q")
    with pytest.raises(UsageError, match="w has shape"):
        found.gradient([1.0, 2.0, 3.0])


def test_models_without_event_driven_runs_are_differenced():
    crowd = nsmodel.load("crowd")
    with pytest.raises(UsageError, match="no event-driven runs; take method"):
        sensitivity(crowd, by="q_0(0)")
    ball = nsmodel.load("bouncing_ball")
    name = next(iter(start_entries(ball)))
    with pytest.raises(UsageError, match="impacts are stepped over"):
        sensitivity(ball, by=f"{name}(0)", at=0.1)
    found = sensitivity(ball, by=f"{name}(0)", at=0.1, method="differences", step=1e-3)
    assert found.of(name)[0, 0] == pytest.approx(1.0, abs=1e-6)
    assert found.error.max() < 1e-6


def test_accumulating_switches_have_none():
    """x'' = -sgn x - 0.1 x' has infinitely many switches before any time after it rests."""
    with pytest.raises((UsageError, StepError), match=r"accumulate|time steps"):
        sensitivity(relay_of_degree_2(0.1, 200.0), by="x_0(0)", compiled=False)


def test_tables_and_pictures(tmp_path):
    found = sensitivity(oscillator(pwm(1.3, 0.4)), by=["k", "u.duty"], at=[1.0, 5.0], compiled=False)
    found.to_csv(tmp_path / "s.csv")
    assert (tmp_path / "s.csv").read_text().splitlines()[0] == "t,z,v,d z/d k,d z/d u.duty,d v/d k,d v/d u.duty"
    assert "by u.duty" in found.summary_text()
    assert "derivatives of a run" in found._repr_html_()
    xarray = pytest.importorskip("xarray")
    assert isinstance(found.to_xarray(), xarray.Dataset)
    ax = found.plot(points=50)
    assert len(ax.get_legend().get_texts()) == 4
    assert json.loads(json.dumps(found.document()))["by"] == ["k", "u.duty"]


def test_the_command_line(tmp_path, capsys):
    command = ["sensitivity", "two_masses", "--by"]
    assert main([*command, "k,x1(0)", "--at", "1,2", "--error", "--out", str(tmp_path)]) == 0
    assert "estimate of the largest error" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {f"sensitivity.{end}" for end in ("txt", "json", "csv", "png")}
    assert main([*command, "stiffness"]) == 2
    assert "'stiffness' is not a parameter" in capsys.readouterr().err
