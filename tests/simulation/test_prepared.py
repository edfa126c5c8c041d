"""Runs of a prepared model: the bits, the words and the refusals of `simulate`, whatever was run before."""

import copy
import dataclasses
import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ModelError,
    SweepingProcess,
    UsageError,
    prepare,
    pwm,
    relay,
    simulate,
)
from nsmodel.codegen import event_driven_runs
from nsmodel.codegen.event_driven_runs import CompiledPieceIntegrator
from nsmodel.modeling.variants import with_start
from nsmodel.simulation import prepared

K, W, T = ca.SX.sym("k"), ca.SX.sym("w"), ca.SX.sym("t")
X, L, U = ca.SX.sym("x", 2), ca.SX.sym("l"), ca.SX.sym("u")
Q = ca.SX.sym("q")
needs_compiler = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
HOW = {"rtol": 1e-8, "method": "event-driven"}


def oscillator(x0=(1.0, 0.0), **more):
    A = [[0, 1], [-K, -0.1]]
    given = {"B": [0, 1], "C": [0, 1], "law": relay(1, -W, W), "parameters": {K: 2.0, W: 0.1}, "t_end": 6.0, "step": 0.01}
    return LureSystem(x=X, A=A, x0=list(x0), **given | more)


def driven():
    return LureSystem(A=[[-K]], B=[1], C=[1], f=[U], law=relay(1, -0.1, 0.1), x0=[0.3], parameters={K: 1.0},
                      inputs={U: pwm(duty=0.4, period=0.5)}, t_end=2.0, step=0.01)  # fmt: skip


def chopped():
    signal = pwm(1 / W, K / (1 + K), phase=W / 10, low=-K / 5, high=K)
    return LureSystem(A=[[-K]], B=[1], C=[1], f=[U], law=relay(1, -0.1, 0.1), x0=[0.3], parameters={K: 1.0, W: 2.0},
                      inputs={U: signal}, t_end=2.0, step=0.01)  # fmt: skip


def friction():
    s = ca.SX.sym("s")
    force = {"friction": 0.2 * ca.fabs(s), "s": s, "potential": K * Q**2 / 2}
    return FrictionOscillator(x=Q, x0=[1.0], v0=[0.0], parameters={K: 1.0}, t_end=5.0, step=0.01, **force)


def same(one, other):
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in other.arrays.items():
        np.testing.assert_array_equal(one.arrays[name], array, err_msg=name)
    assert one.metadata == other.metadata


@needs_compiler
@pytest.mark.parametrize("make", [oscillator, driven])
@pytest.mark.parametrize("options", [HOW, HOW | {"times": [0.0, 0.5, 1.25]}, HOW | {"save_every": 3}, {}])
def test_runs_are_those_of_simulate(make, options):
    model, compiled, rng = make(), {"compiled": True, **options}, np.random.default_rng(7)
    ready = prepare(model, **compiled)
    same(ready.run(), simulate(model, **compiled))
    for _ in range(4):
        values = {str(p): float(v) for p, v in zip(model.parameters, rng.uniform(0.5, 4, model.p.numel()), strict=True)}
        start = rng.normal(size=len(model.names))
        end = {} if "times" in options else {"t_end": float(rng.uniform(1, 3))}
        moved = with_start(model, dict(zip(model.names, start, strict=True)))
        same(ready.run(parameters=values, x0=start, **end), simulate(moved, parameters=values, **compiled, **end))
        same(ready.run(parameters=values), simulate(model, parameters=values, **compiled))
    same(ready.run(), simulate(model, **compiled))


@needs_compiler
@pytest.mark.parametrize("options", [HOW, HOW | {"times": [0.0, 0.5, 1.25]}, {}])
def test_signals_of_parameters_have_the_edges_of_each_run(options):
    model, compiled, rng = chopped(), {"compiled": True, **options}, np.random.default_rng(3)
    ready = prepare(model, **compiled)
    assert ("pieces in C" in repr(ready)) == ("rtol" in options)
    for _ in range(3):
        k, w = (float(v) for v in rng.uniform(0.5, 4, 2))
        end = {} if "times" in options else {"t_end": float(rng.uniform(1, 3))}
        same(
            ready.run(parameters={"k": k, "w": w}, x0=[k - 1], **end),
            simulate(with_start(model, {"x": k - 1}), parameters={"k": k, "w": w}, **compiled, **end),
        )
        same(ready.run(), simulate(model, **compiled))
    with pytest.raises(UsageError, match=r"input 'u': period = -0.5; expected a time > 0; it is \(1./w\) with w = -2"):
        ready.run(parameters={"w": -2.0})


@needs_compiler
def test_a_run_is_read_when_it_is_looked_at_whatever_ran_since(monkeypatch):
    model = oscillator()
    ready, made = prepare(model, compiled=True, **HOW), []
    original = prepared.make_run
    monkeypatch.setattr(prepared, "make_run", lambda *given: made.append(given) or original(*given))
    runs = {k: ready.run(parameters={"k": k}, x0={"x_0": k}) for k in (1.0, 2.0, 3.0)}
    assert not made
    for k, run in reversed(runs.items()):
        same(run, simulate(oscillator((k, 0.0)), parameters={"k": k}, compiled=True, **HOW))
    assert len(made) == 3


@needs_compiler
def test_runs_that_nobody_looked_at_are_copied_pickled_and_shared():
    ready = prepare(oscillator(), compiled=True, **HOW)
    whole = ready.run()
    assert len(whole) > 3
    for other in (pickle.loads(pickle.dumps(ready.run())), copy.copy(ready.run()), copy.deepcopy(ready.run()),
                  dataclasses.replace(ready.run(), metadata=whole.metadata)):  # fmt: skip
        same(other, whole)
    run = ready.run()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: run.arrays, range(64)))
    assert all(one is found[0] for one in found)


@needs_compiler
def test_starts_by_name_by_symbol_and_as_numbers():
    model = friction()
    ready = prepare(model, compiled=True, rtol=1e-8)
    moved = simulate(with_start(model, {"q": 2.0, "v": -0.5}), compiled=True, rtol=1e-8)
    same(ready.run(x0={"q": 2.0, "v": -0.5}), moved)
    same(ready.run(x0={Q: 2.0, "v": -0.5}), moved)
    same(ready.run(x0=[2.0]), simulate(with_start(model, {"q": 2.0}), compiled=True, rtol=1e-8))
    of_vector = prepare(oscillator(), compiled=True, **HOW)
    expected = simulate(oscillator((0.3, 0.4)), compiled=True, **HOW)
    for x0 in ([0.3, 0.4], np.array([0.3, 0.4]), ca.DM([0.3, 0.4]), {X: [0.3, 0.4]}, {"x": [0.3, 0.4]}, {"x_0": 0.3, "x_1": 0.4}):
        same(of_vector.run(x0=x0), expected)


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize(("given", "message"), [
    ({"x0": {"z": 1.0}}, "'z' is not a state"), ({"x0": [1.0]}, "expected 2 numbers, of x_0, x_1"),
    ({"x0": {X: [1.0, 2.0, 3.0]}}, "has 2 entries, x_0, x_1"), ({"x0": [np.nan, 0.0]}, "the start of 'x_0' = nan"),
    ({"x0": {"x_0": "a"}}, "the start of 'x_0' = 'a' is not"), ({"parameters": {"m": 1.0}}, "'m' is not declared"),
    ({"parameters": {"k": np.inf}}, "expected a finite number"), ({"parameters": {"w": -1.0}}, "law"),
    ({"t_end": -1.0}, "t_end"), ({"t_end": np.nan}, "t_end"), ({"t_end": "1"}, "t_end"),
])  # fmt: skip
def test_what_simulate_refuses_is_refused_by_the_run(compiled, given, message):
    ready = prepare(oscillator(), compiled=compiled, **HOW)
    with pytest.raises((UsageError, ModelError), match=message):
        ready.run(**given)


@needs_compiler
def test_starts_outside_the_set_and_numbers_without_value_are_refused_before_anybody_reads():
    q, a = ca.SX.sym("q", 2), ca.SX.sym("a")
    walls = SweepingProcess(q=q, f=[1, 0], constraints={"disc": ca.norm_2(q) - a}, q0=[-3.0, 0.1], parameters={a: 1.0},
                            t_end=6.0, step=0.01)  # fmt: skip
    ready = prepare(walls, rtol=1e-8, compiled=True)
    same(ready.run(x0=[-2.0, 0.5]), simulate(with_start(walls, {"q_0": -2.0, "q_1": 0.5}), rtol=1e-8, compiled=True))
    for given in ({"x0": [0.5, 0.1]}, {"parameters": {"a": 4.0}}):
        with pytest.raises(UsageError, match="outside the set"):
            ready.run(**given)
    inverse = LureSystem(A=[[-1]], B=[1], C=[1], law=relay(1), x0=[1 / K], parameters={K: 1.0}, t_end=1.0, step=0.1)
    with pytest.raises(UsageError, match="with k = 0"):
        prepare(inverse, rtol=1e-8, compiled=True).run(parameters={K: 0.0})


@needs_compiler
def test_values_that_take_switches_away_and_runs_that_leave_c():
    x = ca.SX.sym("x")
    bent = FirstOrderSystem(x=x, lam=L, f=[-x + K * ca.fabs(x - 0.5)], g=[L], h=[x], law=relay(1, -0.1, 0.1), x0=[1.0],
                            parameters={K: 0.5}, t_end=3.0, step=0.01)  # fmt: skip
    ready = prepare(bent, compiled=True, rtol=1e-8)
    for k in (0.5, 0.0, -0.25):
        same(ready.run(parameters={K: k}), simulate(bent, parameters={K: k}, compiled=True, rtol=1e-8))
    many = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[1, 0], law=relay(1, -5, 5), x0=[1, 0], t_end=4000.0, step=1.0)
    long = prepare(many, compiled=True, rtol=1e-6)
    for _ in range(2):
        same(long.run(), simulate(many, compiled=True, rtol=1e-6))
    assert long.run().metadata["totals"]["pieces"] > 1024


def test_interpreted_models_and_those_without_a_start_to_change_are_run_too():
    same(
        prepare(oscillator(), step=0.05, compiled=False).run(x0=[0.5, 0.5]),
        simulate(oscillator((0.5, 0.5)), step=0.05, compiled=False),
    )
    pile = nsmodel.load("crowd")
    ready = prepare(pile, compiled=False, t_end=2 * pile.step)
    assert len(ready.run()) == 2
    with pytest.raises(UsageError, match="has its start in its own arguments"):
        ready.run(x0={"q_0": 1.0})
    with pytest.raises(TypeError, match="unexpected keyword argument 'out'"):
        prepare(oscillator(), out="here")


@needs_compiler
def test_left_to_itself_a_prepared_model_is_in_c_where_it_can_be():
    assert "pieces in C" in repr(prepare(oscillator(), rtol=1e-8))
    same(prepare(oscillator(), rtol=1e-8).run(), simulate(oscillator(), rtol=1e-8, compiled=True))
    assert "as simulate" in repr(prepare(oscillator(), rtol=1e-8, compiled=False))
    assert "as simulate" in repr(prepare(oscillator(), step=0.1))


@pytest.fixture
def compiled_libraries(monkeypatch):
    """The keys of the libraries that are asked for."""
    found = []

    def counted(key, files, flags):
        found.append(key)
        return cached_library(key, files, flags)

    cached_library = event_driven_runs.cached_library
    monkeypatch.setattr(event_driven_runs, "cached_library", counted)
    return found


@needs_compiler
@pytest.mark.parametrize("parameters", [{K: 2.0, W: 0.1}, {}])
def test_starts_share_a_library(compiled_libraries, parameters):
    """Of prepared runs and of simulate; what is read of a run builds nothing either."""
    k, w = (K, W) if parameters else (2.0, 0.1)

    def model(x0):
        law = relay(1, -w, w)
        return LureSystem(A=[[0, 1], [-k, -0.1]], B=[0, 1], C=[0, 1], law=law, parameters=parameters, x0=x0, t_end=3.0, step=0.01)

    ready = prepare(model([1.0, 0.0]), compiled=True, **HOW)
    for x0 in ([0.3, 0.1], [0.4, -0.2]):
        same(ready.run(x0=x0), simulate(model(x0), compiled=True, **HOW))
    assert len(set(compiled_libraries)) == 1


@needs_compiler
def test_known_times_of_a_model_are_its_own(compiled_libraries):
    """The library of all values of one that differs in its known times alone ended no piece there."""
    for times in ([1.0], [2.0], [1.0, 2.0]):
        model = LureSystem(
            t=T, A=[[-K]], B=[1], C=[1], f=[ca.if_else(T < 1.0, 1.0, -1.0)], law=relay(1, -0.1, 0.1), x0=[0.3],
            parameters={K: 1.0}, switch_times=times, t_end=3.0, step=0.01,
        )  # fmt: skip
        starts = simulate(model, compiled=True, **HOW).arrays["piece_start"]
        assert [t for t in (1.0, 2.0) if t in starts] == sorted({1.0, *times})
    assert len(set(compiled_libraries)) == 3


@needs_compiler
@pytest.mark.long
def test_threads_share_what_is_prepared():
    ready = prepare(oscillator(), compiled=True, **HOW)
    given = [({"k": 1 + k / 16}, [1 + k / 8, -k / 8]) for k in range(32)]
    expected = [ready.run(parameters=values, x0=start).x for values, start in given]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(4):
            found = list(pool.map(lambda one: ready.run(parameters=one[0], x0=one[1]).x, given))
            assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))


@needs_compiler
def test_grids_by_their_steps_and_times_that_another_end_does_not_fit():
    model = oscillator()
    for options in ({"steps": [0.05] * 40, "compiled": False}, {"times": [0.0, 0.5, 1.25], "compiled": True, **HOW}):
        ready = prepare(model, **options)
        for _ in range(2):
            same(ready.run(x0=[0.5, 0.1]), simulate(oscillator((0.5, 0.1)), **options))
    with pytest.raises(UsageError, match="t_end"):
        ready.run(t_end=1.0)


@needs_compiler
def test_c_is_given_a_start_of_as_many_numbers_as_it_copies(monkeypatch):
    begin, sizes = CompiledPieceIntegrator.begin, []

    def counted(self, x0=None, **how):
        sizes.extend([] if x0 is None else [(x0.size, self.at["x"].shape[-1])])
        return begin(self, x0, **how)

    monkeypatch.setattr(CompiledPieceIntegrator, "begin", counted)
    held = LureSystem(A=[[0, 1], [-K, 0]], B=[0, 1], C=[0, 1], f=[0, U], law=relay(1, -W, W), x0=[1, 0],
                      parameters={K: 2.0, W: 0.1}, inputs={U: pwm(duty=0.4, period=0.5)}, t_end=2.0, step=0.01)  # fmt: skip
    for model in (oscillator(), held):
        prepare(model, compiled=True, **HOW).run(x0=[0.5, 0.1])
    assert len(sizes) == 4  # Each is prepared, and run.
    assert all(given == taken for given, taken in sizes)


def test_states_may_begin_with_an_underscore():
    x = ca.SX.sym("_q")
    model = FirstOrderSystem(x=x, lam=L, f=[-x], g=[L], h=[x], law=relay(1), x0=[1.0], t_end=0.5, step=0.1)
    np.testing.assert_array_equal(simulate(model)._q, simulate(model).x[:, 0])
