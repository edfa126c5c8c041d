"""Models advanced step by step: the bits of `simulate`, checkpoints, what is refused."""

import copy
import pickle

import casadi as ca
import input_scenes as scenes
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    StepError,
    UsageError,
    complementarity,
    load,
    pwm,
    relay,
    simulate,
    stepper,
    steps,
    table,
)
from nsmodel.simulation.stepper import ModelStepper

T = scenes.T
WAYS = pytest.mark.parametrize("compiled", [False, True])


def walked(s: ModelStepper, values, **options):
    return np.array([s.step(u, **options).x for u in values])


@WAYS
def test_the_bits_are_those_of_simulate(compiled):
    values = np.where(np.arange(100) % 20 < 8, 1.0, 0.0)
    model = scenes.buck(t_end=5 * T)
    run = simulate(model, inputs={"u": steps(values)}, compiled=compiled)
    s = stepper(model, inputs={"u": None}, compiled=compiled, record=True)
    assert s.free == ("u",)
    np.testing.assert_array_equal(walked(s, values), run.x[1:])
    kept = s.trajectory
    for name in ("t", "x", "multipliers", "index_set", "inputs", "inputs_begin", "residual"):
        np.testing.assert_array_equal(kept.arrays[name], run.arrays[name])
    np.testing.assert_array_equal(kept.u, run.u)


@WAYS
@pytest.mark.parametrize("case", ["friction_oscillator", "sliding_relay", "diode_bridge", "gene_network", "point_past_disc"])
def test_models_without_inputs(case, compiled, request):
    model = load(case)
    run = simulate(model, t_end=20 * model.step, compiled=compiled)
    s = stepper(model, compiled=compiled)
    np.testing.assert_array_equal([s.step().x for _ in range(20)], run.x[1:])


@WAYS
def test_steps_of_several_lengths(compiled):
    model = scenes.follower(None, t_end=1, step=0.1)
    h = [0.1, 0.1, 0.05, 0.05, 0.2]
    run = simulate(model, steps=h, inputs={"u": 2.0}, compiled=compiled)
    s = stepper(model, compiled=compiled)
    rows = [s.step(2.0, h=one) for one in h]
    np.testing.assert_allclose([row.x for row in rows], run.x[1:], rtol=1e-14)
    np.testing.assert_allclose([row.t for row in rows], run.t[1:], rtol=1e-15)


def test_both_limits_of_a_step():
    model = scenes.follower(None, t_end=1, step=0.1)
    run = simulate(model, inputs={"u": table([0, 1], [0, 2], "linear")}, compiled=False)
    s = stepper(model, compiled=False)
    rows = [s.step(a, b) for a, b in zip(run.inputs_begin[1:], run.inputs[1:], strict=True)]
    np.testing.assert_array_equal([row.x for row in rows], run.x[1:])
    assert rows[-1].inputs.tolist() == [2]


def test_signals_that_the_stepper_has():
    model = scenes.buck()
    s = stepper(model, step=T / 20)
    assert s.free == ()
    run = simulate(model, t_end=3 * T)
    np.testing.assert_allclose(walked(s, [None] * 60), run.x[1:], rtol=1e-12)
    s = stepper(model, step=0.3 * T)
    s.step()
    before = s.checkpoint()
    with pytest.raises(
        UsageError, match=r"an input jumps or bends, or a block ticks, at t = 4e-06: step at most 1e-06, or give split=True"
    ):
        s.step()
    assert s.checkpoint() == before
    row = s.step(split=True)
    assert row.t == pytest.approx(0.6 * T, rel=1e-14)
    assert s.k == 3


@WAYS
def test_checkpoint_restore_and_reset(compiled):
    rng = np.random.default_rng(1)
    values = rng.uniform(0, 1, 40)
    s = stepper(scenes.buck(), inputs={"u": None}, compiled=compiled, record=True)
    first = walked(s, values[:15])
    kept = s.checkpoint()
    rest = walked(s, values[15:])
    s.restore(kept)
    assert len(s.trajectory) == 15
    np.testing.assert_array_equal(walked(s, values[15:]), rest)
    s.reset()
    np.testing.assert_array_equal(walked(s, values[:15]), first)
    s.reset(x0=[1, 2], t=0.5)
    assert (s.t, s.x.tolist()) == (0.5, [1, 2])
    other = stepper(scenes.buck(), inputs={"u": None}, compiled=compiled)
    other.restore(kept)
    np.testing.assert_array_equal(walked(other, values[15:]), rest)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"u": [1, 2]}, r"u: 2 values; expected 1 \(u\)"),
        ({}, r"u: 0 values; expected 1 \(u\)"),
        ({"u": np.nan}, r"u = \[nan\]; expected finite numbers"),
        ({"u": "high"}, "u = 'high'; expected numbers"),
        ({"u": {"v": 1}}, "input 'v' is not declared; the model has u"),
        ({"u": {}}, "input 'u' has no value in this step; give it, or a signal to the stepper"),
        ({"u": 1, "h": -1}, "h = -1; expected a finite number > 0"),
        ({"u": 1, "u_end": np.inf}, r"u = \[inf\]; expected finite numbers"),
    ],
)
def test_what_is_refused_changes_nothing(given, words):
    s = stepper(scenes.buck(), inputs={"u": None})
    s.step(1)
    before = s.checkpoint()
    with pytest.raises(UsageError, match=words):
        s.step(**given)
    assert s.checkpoint() == before


def test_a_step_that_fails_changes_nothing():
    """x' = -x/(1 - u) has no number at u = 1."""
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    model = FirstOrderSystem(
        x=x, lam=l, f=[-x / (1 - u)], g=[l], h=[x], law=complementarity(1), x0=[1], t_end=1, step=0.1, inputs={u: None}
    )
    s = stepper(model)
    s.step(0.5)
    before = s.checkpoint()
    with pytest.raises(StepError):
        s.step(1.0)
    assert s.checkpoint() == before
    assert np.isfinite(s.step(0.5).x).all()


def test_what_has_no_stepper():
    with pytest.raises(UsageError, match="stepper: no time step: give the model step=, or step=H here"):
        stepper(scenes.follower(1.0, t_end=1))
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    oscillator = FrictionOscillator(x=x, potential=x**2 / 2, friction=s / 2, s=s, x0=1, v0=0, t_end=1, step=0.01)
    assert stepper(oscillator).step().x.size == 1
    with pytest.raises(UsageError, match="stepper: no rows are kept; give record=True"):
        stepper(oscillator).trajectory  # noqa: B018
    assert relay(1).size == 1


def test_signals_are_refused_where_they_end():
    for signal, words in (
        (steps([1, 2]), r"input 'u': steps\(...\) has 2 rows, but this would be step 3"),
        (table([0, 0.2], [1, 2], after="error"), "input 'u': its table ends at t = 0.2, before the run does at 0.3"),
        (pwm(0.2, table([0, 0.3], [0.5, 1.5])), "input 'u': its duty is 1.5 at t = 0.4"),
    ):
        s = stepper(scenes.follower(None, t_end=1, step=0.1), inputs={"u": signal})
        with pytest.raises(UsageError, match=words):
            walked(s, [None] * 5, split=True)
        assert s.k >= 2


def test_an_oscillator_has_its_energy_and_its_two_positions():
    x, z = ca.SX.sym("x"), ca.SX.sym("s")
    given = {"x": x, "potential": x**2 / 2, "friction": z / 2, "s": z, "x0": 1, "t_end": 1, "step": 0.1}
    h = [0.1, 0.05, 0.05, 0.2]
    model, s = FrictionOscillator(v0=0, **given), stepper(FrictionOscillator(v0=0, **given), record=True, compiled=False)
    for length in h:
        s.step(h=length)
    np.testing.assert_array_equal(s.trajectory.energy, simulate(model, steps=h, compiled=False).energy)
    model = FrictionOscillator(x1=0.99, **given)
    s, run = stepper(model, record=True, compiled=False), simulate(model, compiled=False)
    for _ in range(9):
        s.step()
    np.testing.assert_array_equal(s.trajectory.t, run.t)
    np.testing.assert_array_equal(s.trajectory.x, run.x)


@WAYS
def test_a_reaction_that_is_carried_is_of_the_values_of_its_step(compiled):
    values = np.random.default_rng(4).normal(size=20)
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    model = FirstOrderSystem(
        x=x, lam=l, f=[u - x], g=[-l], h=[l - 2 * u], law=relay(1, -1e9, 1e9), x0=[0.5], theta=0.5, gamma=0.5, step=0.05,
        t_end=1, inputs={u: None},
    )  # fmt: skip
    run, s = simulate(model, inputs={"u": steps(values)}, compiled=compiled), stepper(model, compiled=compiled)
    np.testing.assert_array_equal(walked(s, values), run.x[1:])
    right = [0.5]
    for value in values:  # l = 2 u: x' = -u - x, by the trapezoidal rule
        right.append(((1 - 0.025) * right[-1] - 0.05 * value) / (1 + 0.025))
    np.testing.assert_allclose(run.x[:, 0], right, rtol=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
def test_rows_stay_what_they_were(compiled):
    s = stepper(scenes.buck(), inputs={"u": None}, compiled=compiled)
    rows = [s.step(u) for u in (0.25, 1.0, 0.5)]
    assert [row.inputs.item() for row in rows] == [0.25, 1.0, 0.5]
    assert [row.t for row in rows] == [s.h, 2 * s.h, 3 * s.h]
    kept = rows[1].x.copy()
    s.step(0.0)
    np.testing.assert_array_equal(rows[1].x, kept)


def test_a_number_a_list_and_a_dictionary_are_one():
    model = scenes.buck()
    walked_ = [
        [s.step(given).x for _ in range(3)]
        for s, given in ((stepper(model, inputs={"u": None}), u) for u in (0.5, [0.5], {"u": 0.5}))
    ]
    np.testing.assert_array_equal(walked_[0], walked_[1])
    np.testing.assert_array_equal(walked_[0], walked_[2])


# ---------------------------------------------------------------------------------------------- copies

COPIES = {
    "copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda s: pickle.loads(pickle.dumps(s)),
}  # fmt: skip


@WAYS
@pytest.mark.parametrize("how", COPIES)
def test_a_copy_goes_on_alone_with_the_same_bits(how, compiled):
    values = np.where(np.arange(60) % 20 < 8, 1.0, 0.0)
    expected = walked(stepper(scenes.buck(t_end=5 * T), inputs={"u": None}, compiled=compiled), values)
    s = stepper(scenes.buck(t_end=5 * T), inputs={"u": None}, compiled=compiled, record=True)
    walked(s, values[:25])
    other = COPIES[how](s)
    assert (other.t, other.k, other.x.tolist()) == (s.t, s.k, s.x.tolist())
    walked(other, 1 - values[25:40])  # By other inputs, and further.
    np.testing.assert_array_equal(s.x, expected[24])
    assert (s.k, len(s.trajectory), len(other.trajectory)) == (25, 25, 40)
    again = COPIES[how](s)
    for mine, theirs, row in zip(values[25:], values[25:], expected[25:], strict=True):  # By turns.
        np.testing.assert_array_equal(s.step(mine).x, row)
        np.testing.assert_array_equal(again.step(theirs).x, row)
    np.testing.assert_array_equal(again.trajectory.x, s.trajectory.x)
    assert again.trajectory.arrays.keys() == s.trajectory.arrays.keys()


@WAYS
@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("case", ["friction_oscillator", "gene_network", "point_past_disc", "thermostat", "bouncing_ball"])
def test_copies_of_each_kind_of_step(case, how, compiled):
    """Kept matrices, Newton's method, rows that are linearised, blocks, contacts; a copy made before any step too."""
    model = load(case)
    run = simulate(model, t_end=30 * model.step, compiled=compiled)
    s = stepper(model, compiled=compiled)
    first = COPIES[how](s)
    for _ in range(10):
        s.step()
    other = COPIES[how](s)
    np.testing.assert_array_equal([other.step(split=True).x for _ in range(20)], run.x[11:])
    np.testing.assert_array_equal([s.step(split=True).x for _ in range(20)], run.x[11:])
    np.testing.assert_array_equal([first.step(split=True).x for _ in range(30)], run.x[1:])


def test_a_stepper_whose_model_has_a_nameless_function_is_not_pickled():
    x = ca.SX.sym("x")
    s = stepper(FirstOrderSystem(x=x, f=-x, x0=[1], t_end=1, step=0.1, exact=lambda t: np.exp(-t)[:, None]))
    with pytest.raises(UsageError, match="cannot be pickled"):
        pickle.dumps(s)
    np.testing.assert_array_equal(copy.deepcopy(s).step().x, s.step().x)
