"""Signals whose numbers are expressions of a model's parameters: runs are those of a model with the numbers themselves."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    ModelError,
    UsageError,
    check,
    complementarity,
    each_step,
    explain,
    prepare,
    pwm,
    relay,
    simulate,
    stepper,
    table,
)
from nsmodel.codegen import write
from nsmodel.errors import CodegenError
from nsmodel.modeling.fingerprint import content_digest
from nsmodel.modeling.signals.schedule import InputSchedule
from nsmodel.simulation.simulate import bound_model
from nsmodel.study.units import in_units

F, D, G, U = (ca.SX.sym(name) for name in ("f", "D", "g", "u"))
T = 1e-5
KINDS = ("trailing", "leading", "centre")


def buck(signal, parameters, **more):
    """A buck converter whose switch has losses: u multiplies the current."""
    x = ca.SX.sym("x", 2)
    given = {"t_end": 10 * T, "step": T / 20, "theta": 0.5} | more
    f = [(24 * U - x[1] - 0.1 * U * x[0]) / 1e-4, (x[0] - x[1] / 5) / 47e-6]
    return FirstOrderSystem(x=x, f=f, x0=[0, 0], inputs={U: signal}, parameters=parameters, **given)


def random_pair(seed):
    """A model with expressions for all numbers of a PWM, values, and the same model with the numbers."""
    rng = np.random.default_rng(seed)
    a, b, c = (ca.SX.sym(name) for name in "abc")
    x, kind = ca.SX.sym("x", 2), KINDS[seed % 3]
    values = {"a": float(rng.uniform(0.5, 2)), "b": float(rng.uniform(0.05, 0.9)), "c": float(rng.normal())}
    written = {"period": 1 / a, "duty": b**2, "phase": b / a, "low": -c, "high": a * c + 2}
    symbols, at = ca.vertcat(a, b, c), [values[name] for name in "abc"]
    numbers = {name: float(ca.substitute(one, symbols, ca.SX(at))) for name, one in written.items()}
    M = rng.normal(size=(2, 2)) - 2 * np.eye(2)
    f = ca.DM(M) @ x * a + ca.vertcat(U, 0.3 * U * x[0])

    def made(signal, f, parameters):
        own = {"law": relay(1, -b, b) if parameters else relay(1, -values["b"], values["b"]), "lam": ca.SX.sym("l")}
        own |= {"g": ca.vertcat(0, own["lam"]), "h": [x[1]]}
        return FirstOrderSystem(
            x=x, f=f, x0=[1.0, -0.5], inputs={U: signal}, parameters=parameters, t_end=4.0, step=0.05, theta=0.5, gamma=1, **own
        )

    other = dict.fromkeys((a, b, c), 0.5)  # Other values than those of the run.
    return (
        made(pwm(**written, kind=kind), f, other), values,
        made(pwm(**numbers, kind=kind), ca.substitute(f, symbols, ca.SX(at)), {}),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(9))
def test_runs_are_those_of_numbers(seed):
    model, values, same = random_pair(seed)
    for options in ({}, {"rtol": 1e-8}, {"rtol": 1e-3, "method": "time-stepping"}):
        one, two = (simulate(m, parameters=p, compiled=False, **options) for m, p in ((model, values), (same, None)))
        for name in ("t", "x", "multipliers", "inputs", "inputs_begin"):
            np.testing.assert_array_equal(one.arrays[name], two.arrays[name])
    again = prepare(model, compiled=False, rtol=1e-8).run(parameters=values)
    np.testing.assert_array_equal(again.x, simulate(same, compiled=False, rtol=1e-8).x)


def test_a_duty_that_is_a_parameter_costs_what_a_number_does():
    model, number = buck(pwm(T, D), {D: 0.4}), buck(pwm(T, 0.4), {})
    assert model.values_taken == [2]
    assert not model.blocks
    assert model.input_names == ("u",)
    assert explain(model, compiled=False) == explain(number, compiled=False)
    run = simulate(model, compiled=False)
    np.testing.assert_array_equal(run.x, simulate(number, compiled=False).x)
    assert (run.t <= 0.4 * T * (1 + 1e-12)).sum() == 1 + 8  # The start, and 8 steps of T/20.
    assert simulate(model, parameters={"D": 0.5}, compiled=False).inputs.shape == (201, 1)


def test_a_duty_of_what_blocks_hold_is_read_as_ever():
    z = ca.SX.sym("z")
    blocks = [each_step("b", memory={z: 0.4}, update={z: z})]
    held = buck(pwm(T, D * z), {D: 1.0}, blocks=blocks)
    assert held.input_names == ("u", "z", "u.duty")
    one, two = (simulate(model, rtol=1e-10, compiled=False).x[-1] for model in (held, buck(pwm(T, 0.4), {})))
    np.testing.assert_allclose(one, two, rtol=1e-9)
    for number, given in (("period", {"period": 1 / F, "duty": z}), ("high", {"period": T, "duty": z, "high": F})):
        with pytest.raises(ModelError, match=f"'u': its duty changes in the run, and its {number} is an expression"):
            buck(pwm(**given), {F: 1e5}, blocks=blocks)


def test_symbols_of_any_kind_by_name():
    sympy = pytest.importorskip("sympy")
    f, wanted = sympy.Symbol("f"), simulate(buck(pwm(T, 0.4, high=2.0), {}), compiled=False).x
    th = ca.SX.sym("th", 2)
    for signal, parameters in [
        (pwm(1 / f, sympy.Symbol("D"), high=5 * sympy.Symbol("D")), {"f": 1e5, "D": 0.4}),
        (pwm(1 / ca.MX.sym("f"), 0.4, high=2), {"f": 1e5}),
        (pwm(1 / th[0], th[1], high=2), {th: [1e5, 0.4]}),
        (pwm(ca.SX(T), sympy.Rational(2, 5), high=2), {}),
    ]:
        np.testing.assert_array_equal(simulate(buck(signal, parameters), compiled=False).x, wanted)


def test_a_signal_of_a_run_has_expressions_too():
    wanted = simulate(buck(pwm(T, 0.4), {}), compiled=False).x
    for declared in (None, pwm(2 * T, D)):
        model = buck(declared, {F: 1e5, D: 0.1})
        run = simulate(model, inputs={"u": pwm(1 / F, 4 * D)}, compiled=False)
        np.testing.assert_array_equal(run.x, wanted)
    with pytest.raises(UsageError, match=r"'u': its period depends on 'g', but may depend only on parameters \(f\)"):
        simulate(buck(None, {F: 1e5}), inputs={U: pwm(1 / G, 0.4)})


@pytest.mark.parametrize(("signal", "values", "message"), [
    (pwm(1 / F, D), {"f": -2}, r"input 'u': period = -0.5; expected a time > 0; it is \(1./f\) with f = -2"),
    (pwm(1 / F, D), {"f": 0}, r"'u': period = inf; expected a finite number; it is \(1./f\) with f = 0"),
    (pwm(1 / F, D), {"D": 1.2}, "'u': duty = 1.2; expected a number from 0 to 1; it is D with D = 1.2"),
    (pwm(T, D - F / 1e6), {"D": 0.05}, r"duty = -0.05; .* it is \(D-\(f/1e\+06\)\) with D = 0.05, f = 100000"),
    (pwm(T, 0.4, phase=ca.log(D)), {"D": 0}, r"phase = -inf; expected a finite number; it is log\(D\) with D = 0"),
])  # fmt: skip
def test_a_number_that_is_none_is_told_with_its_expression(signal, values, message):
    model = buck(signal, {F: 1e5, D: 0.4})
    with pytest.raises(UsageError, match=message):
        simulate(model, parameters=values, compiled=False)
    with pytest.raises(UsageError, match=message.partition(";")[0]):
        model.bind(dict.fromkeys(values), partly=True).bind(values)


@pytest.mark.parametrize(("made", "message"), [
    (lambda: buck(pwm(1 / G, 0.4), {F: 1}), r"'u': its period depends on 'g', but may depend only on parameters \(f\)"),
    (lambda: buck(pwm(1 / ca.SX.sym("t"), 0.4), {}), r"depends on 't', but may depend only on parameters \(there are none\)"),
    (lambda: buck(pwm(ca.vertcat(F, F), 0.4), {F: 1}), r"its period has the shape \(2, 1\); expected one number"),
    (lambda: pwm(T, pwm(1 / F, 0.5)), "duty is a signal in which a number is an expression"),
    (lambda: pwm(-1, F), "period = -1; expected a time > 0"),
])  # fmt: skip
def test_what_is_no_expression_of_parameters_is_refused(made, message):
    with pytest.raises(ModelError, match=message):
        made()


def test_a_model_without_values_is_described_copied_and_known_by_its_expressions():
    def digest(model):
        return content_digest([dict(model.inputs)])

    model = buck(pwm(1 / F, D, high=G), {F: None, D: 0.4, G: 1.0})
    assert "period=(1./f), duty=D" in repr(model)
    for other in (copy.copy(model), copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert digest(other) == digest(model)
        np.testing.assert_array_equal(
            simulate(other, parameters={"f": 1e5}, compiled=False).x, simulate(buck(pwm(T, 0.4), {}), compiled=False).x
        )
    signals = (pwm(1 / F, D, high=G), pwm(1 / G, D, high=F), pwm(1 / F, D), pwm(1 / F, D / 2, high=G), pwm(T, 0.4))
    assert len({digest(buck(signal, {F: 1e5, D: 0.4, G: 1.0})) for signal in signals}) == len(signals)
    with pytest.raises(UsageError, match="parameter 'f' has no value"):
        simulate(model)
    with pytest.raises(UsageError, match=r"input 'u': its period is \(1./f\): give the parameters f, D, g their values first"):
        InputSchedule.of(model.inputs, 1.0)


def test_other_units_of_time():
    model = buck(pwm(1 / F, D, phase=0.1 / F), {F: 1e5, D: 0.4})
    one = in_units(model.bind(), 1.0, 3.0).inputs["u"]
    two = model.inputs["u"].in_time(3.0).with_values(model.p, ca.SX([1e5, 0.4]))
    for signal in (one, two):
        np.testing.assert_allclose(signal.edges(6 * T), [0.3 * T, 1.5 * T, 3.3 * T, 4.5 * T], rtol=1e-14)


def test_checks_of_numbers_and_of_intervals():
    model = buck(pwm(1 / F, D, high=G), {F: 1e5, D: 0.4, G: 1.0})
    assert check(model, quick=True).inputs[0] == check(buck(pwm(T, 0.4), {}), quick=True).inputs[0]
    over = check(model, parameters={"f": (0.5e5, 2e5)}, quick=True)
    assert over.inputs[0] == "u: in f; within [0, 1], any measurable function (read off its pwm)"
    with pytest.raises(UsageError, match="the bounds of its signal are not known"):
        check(model, parameters={"g": (0.5, 2.0)}, quick=True)


def test_a_stepper_has_the_edges_of_its_values():
    model = LureSystem(
        A=[[-1]], B=[1], C=[1], f=[U], law=complementarity(1), x0=[0], inputs={U: pwm(1 / F, 0.4)}, parameters={F: 1.0}, t_end=4,
        step=0.1,
    )  # fmt: skip
    own = stepper(model, parameters={"f": 2.0})
    own.step()
    own.step()
    with pytest.raises(UsageError, match=r"at t = 0.5: step at most 0.3"):
        own.step(h=0.4)
    rows = simulate(model, parameters={"f": 2.0}, compiled=False)
    assert rows.x[2, 0] == own.x[0]
    assert rows.inputs[[2, 3, 5], 0].tolist() == [1, 0, 0]


def test_a_library_has_the_signals_of_its_own_values(tmp_path):
    model = LureSystem(
        A=[[-D]], B=[1], C=[1], f=[U], law=complementarity(1), x0=[0], inputs={U: pwm(1 / F, 0.4)}, parameters={F: 1.0, D: 1.0},
        t_end=4, step=0.1,
    )  # fmt: skip
    for event_driven in (False, True):
        with pytest.raises(CodegenError, match=r"signal of input 'u' moves with f, and code has no signals: give its value"):
            write(model, tmp_path, event_driven=event_driven)
        assert write(model, tmp_path, parameters={"f": 2.0}, event_driven=event_driven).files


def test_models_at_equal_numbers_are_one_object():
    """What is made of a model with symbols for its parameters is made once, its signals having numbers."""
    from nsmodel.modeling.variants import with_signals_of

    model = buck(pwm(1 / F, D), {F: 1e5, D: 0.4})
    first, again = (with_signals_of(model, bound_model(model, {"D": 0.3})) for _ in range(2))
    assert first is again
    assert first.p.numel() == 2
    assert not first.inputs["u"].parameters
    plain = buck(table([0, T], [0, 1]), {F: 1e5})
    assert with_signals_of(plain, bound_model(plain, None)) is plain


@pytest.mark.parametrize("ends", [(0.1, 1.5), (-0.2, 0.5), (0.0, 3.0)])
def test_a_box_of_parameters_ends_where_a_signal_has_its_numbers(ends):
    x = ca.SX.sym("x")
    model = FirstOrderSystem(x=x, f=[U - x], x0=[0], inputs={U: pwm(1.0, D)}, parameters={D: 0.4}, t_end=1.5, step=0.01)
    with pytest.raises(UsageError, match=r"input 'u': duty = .*; expected a number from 0 to 1; it is D with D = "):
        check(model, parameters={"D": ends}, quick=True)
    assert check(model, parameters={"D": (0.1, 0.9)}, quick=True).findings
