"""What follows from a model alone is computed once, and forgotten with it."""

import gc
import weakref
from copy import copy

import numpy as np
import pytest

from nsmodel import LureSystem, relay, simulate
from nsmodel._utils import cached_per_object
from nsmodel.modeling.fingerprint import fingerprint
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.solvers.one_step_problem import one_step_problem

pytestmark = pytest.mark.fast


class Thing:
    """An object with an identity."""


def relay_model():
    return LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=1, step=0.1)


def test_each_object_has_its_own_value_computed_once():
    calls = []

    @cached_per_object
    def value(thing):
        calls.append(thing)
        return len(calls)

    one, other = Thing(), Thing()
    assert [value(one), value(other), value(one), value(other)] == [1, 2, 1, 2]
    assert calls == [one, other]


def test_an_object_that_has_gone_leaves_nothing_to_the_next():
    @cached_per_object
    def value(thing):
        return thing.number

    for number in range(50):  # new objects get the place of old ones
        thing = Thing()
        thing.number = number
        assert value(thing) == number
        del thing


def test_a_failure_is_not_kept():
    tried = []

    @cached_per_object
    def value(thing):
        tried.append(thing)
        raise LookupError("none")

    thing = Thing()
    for _ in range(2):
        with pytest.raises(LookupError, match="none"):
            value(thing)
    assert len(tried) == 2


def test_runs_do_not_keep_their_model():
    model = relay_model()
    simulate(model)
    there = weakref.ref(model)
    del model
    gc.collect()
    assert there() is None


def test_a_second_run_of_a_model_is_the_first_to_the_bit():
    model = relay_model()
    first, second, fresh = simulate(model), simulate(model), simulate(relay_model())
    assert one_step_problem(model) is one_step_problem(model)
    for name, values in first.arrays.items():
        assert np.array_equal(values, second.arrays[name], equal_nan=True), name
        assert np.array_equal(values, fresh.arrays[name], equal_nan=True), name


def test_models_that_differ_have_other_fingerprints():
    model, grid = relay_model(), TimeGrid(10, 0.1, 0.1)
    other = copy(model)
    other._set(x0=2 * model.x0)
    assert fingerprint(model, grid) == fingerprint(model, grid) == fingerprint(relay_model(), grid)
    assert fingerprint(other, grid) != fingerprint(model, grid)
