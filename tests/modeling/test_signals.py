"""Signals against their definitions: limits at edges, exact edges, tables against SciPy and brute force."""

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from nsmodel import ModelError, pwm, signal, steps, table
from nsmodel.modeling.signals.schedule import InputSchedule


def before_and_after(found, t):
    t = np.array(t, float)
    return found.before(t)[:, 0].tolist(), found.after(t)[:, 0].tolist()


def test_a_held_table_jumps_where_its_value_changes():
    found = table([0.5, 1, 2, 3], [1, 4, 4, 2])
    assert found.edges(10).tolist() == [1, 3]
    assert before_and_after(found, [0.2, 0.5, 1, 1.5, 2, 3, 4]) == ([1, 1, 1, 4, 4, 4, 2], [1, 1, 4, 4, 4, 2, 2])


def test_a_time_that_stands_twice_is_a_jump_of_a_polyline():
    found = table([0, 1, 1, 2, 3.5], [0, 1, -1, -1, 2], "linear")
    assert found.edges(10).tolist() == [1]
    assert found.kinks(10).tolist() == [0, 1, 2, 3.5]
    left, right = before_and_after(found, [0, 0.5, 1, 1.5, 2.75, 3.5, 9])
    assert left == [0, 0.5, 1, -1, 0.5, 2, 2]
    assert right == [0, 0.5, -1, -1, 0.5, 2, 2]


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_curves_are_those_of_numpy_and_scipy(kind):
    rng = np.random.default_rng(3)
    t, values = np.sort(rng.uniform(0, 5, 12)), rng.normal(size=(12, 3))
    at = rng.uniform(t[0], t[-1], 200)
    line = np.stack([np.interp(at, t, column) for column in values.T], axis=1)
    right = line if kind == "linear" else CubicSpline(t, values, bc_type="natural")(at)
    found = table(t, values, kind)
    assert found.size == 3
    for side in (found.before(at), found.after(at)):
        np.testing.assert_allclose(side, right, rtol=1e-12, atol=1e-12)
    assert found.edges(9).size == 0


def test_the_natural_spline_is_the_one_of_the_name():
    found = table([0, 0.5, 1, 2, 3], [0, 1, 0.5, 2, 0], "cubic")
    np.testing.assert_allclose(
        found.after(np.array([0.25, 1.5, 2.5]))[:, 0], [0.677455357143, 1.136160714286, 1.475446428571], atol=1e-12
    )


@pytest.mark.parametrize("kind", ["hold", "linear"])
def test_a_periodic_table_repeats(kind):
    t, values = np.array([0.25, 1, 1.5, 2.25]), np.array([1.0, 3, 2, 5])
    found = table(t, values, kind, after="periodic", period=2.5 if kind == "hold" else None)
    period, rng = 2.5 if kind == "hold" else 2.0, np.random.default_rng(0)
    local = rng.uniform(0.25, 0.25 + period, 50)
    for k in (-1, 0, 1, 7):
        np.testing.assert_allclose(found.after(local + k * period), found.after(local), atol=1e-9)
    edges = found.edges(20)
    jumps = np.flatnonzero(np.abs(found.after(edges) - found.before(edges))[:, 0] > 0)
    assert jumps.size == edges.size > 0
    if kind == "linear":  # it ends at 5 and begins at 1
        np.testing.assert_allclose(edges, np.arange(0.25, 20, 2), atol=1e-12)


@pytest.mark.parametrize("kind", ["trailing", "leading", "centre"])
@pytest.mark.parametrize("duty", [0.0, 1e-7, 0.25, 0.4, 0.999999, 1.0])
def test_edges_of_pulses_are_products(kind, duty):
    T, end = 1e-5, 37.3e-5
    found = pwm(T, duty, kind=kind, low=-1, high=2)
    shift = {"trailing": 0, "leading": 1 - duty, "centre": (1 - duty) / 2}[kind]
    k = np.arange(-1, 40)
    right = np.sort(np.concatenate([(k + shift) * T, (k + shift + duty) * T])) if 0 < duty < 1 else np.zeros(0)
    right = right[(right >= 0) & (right <= end)]
    np.testing.assert_allclose(found.edges(end), right, rtol=1e-15, atol=1e-20)
    t = np.random.default_rng(1).uniform(0, end, 500)
    phase = (t / T) % 1
    high = (phase >= shift) & (phase < shift + duty)
    assert (found.after(t)[:, 0] == np.where(high, 2, -1)).all()
    edges = found.edges(end)[1:]
    assert (found.before(edges) != found.after(edges)).all()


def test_the_duty_of_a_period_is_that_when_it_begins():
    duty = table([0, 2, 4], [0.25, 0.75, 1.0])
    found = pwm(1.0, duty)
    np.testing.assert_allclose(found.edges(5.5), [0, 0.25, 1, 1.25, 2, 2.75, 3, 3.75, 4])
    with pytest.raises(ModelError, match=r"input 'd': its duty is 1.5 at t = 3; expected a number from 0 to 1"):
        pwm(1.0, table([0, 3], [0.5, 1.5])).check_valid("input 'd'", 5)


def test_a_function_is_seen_from_the_right_side_of_its_edges():
    found = signal(lambda t: np.floor(t), edges=[1, 2])
    assert before_and_after(found, [0.5, 1, 1.5, 2]) == ([0, 0, 1, 1], [0, 1, 1, 2])
    t = ca.SX.sym("t")
    same = signal(ca.floor(t), edges=lambda a, b: np.arange(np.ceil(a), b + 1))
    assert before_and_after(same, [0.5, 1, 1.5, 2]) == ([0, 0, 1, 1], [0, 1, 1, 2])


def test_what_is_near_is_one_point():
    one, other = table([0, 0.1, 0.5], [0, 1, 2]), table([0, 0.1 + 1e-17, 0.3, 0.5 * (1 + 1e-15)], [0, 1, 2, 3])
    drive = InputSchedule.of({"a": one, "b": other}, 1.0)
    assert drive.points.tolist() == [0.1, 0.3, 0.5]
    limits = drive.limits(np.array([0, 0.1, 0.3, 0.5, 1.0]))
    assert limits.tolist() == [[0, 0, 0, 0], [1, 1, 1, 1], [1, 2, 1, 2], [2, 3, 2, 3]]


def test_edges_at_the_ends_of_a_run_are_none_of_its_grid():
    drive = InputSchedule.of({"a": table([0, 1, 2, 3], [5, 6, 7, 8])}, 2.0)
    assert drive.points.tolist() == [1]
    assert drive.jumps.tolist() == [1]
    kinked = InputSchedule.of({"a": table([0, 1, 2, 3], [5, 6, 7, 8], "linear")}, 2.0)
    assert kinked.points.tolist() == [1]
    assert kinked.jumps.size == 0


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: table([0, 2, 1], [1, 2, 3]), r"table: t\[2\] = 1 is not after t\[1\] = 2; give them in order"),
        (lambda: table([0, 0], [1, 2]), r"table: t\[1\] = 0 is not after t\[0\] = 0"),
        (lambda: table([0, 1, 1, 1], [1, 2, 3, 4], "linear"), r"table: t\[1\] = 1 occurs three times; a jump has two rows"),
        (lambda: table([0, 1], [1, np.nan]), r"table: values\[1\] = nan; expected finite numbers"),
        (lambda: table([0, np.inf], [1, 2]), r"table: t\[1\] = inf; expected finite numbers"),
        (lambda: table([0, 1, 2], [1, 2]), "table: 3 times and 2 rows of values; expected a row for each time, one at least"),
        (lambda: table([], []), "table: 0 times and 0 rows"),
        (lambda: table([[0, 1]], [1, 2]), r"table: t has the shape \(1, 2\); expected a list \(N,\)"),
        (lambda: table([0, 1, 2], [1, 2, 3], "cubic"), "table: kind='cubic' and 3 rows; expected 4 or more, or kind='linear'"),
        (lambda: table([0, 1, 1, 2], [1, 2, 3, 4], "cubic"), r"table: t\[2\] = 1 is not after t\[1\] = 1"),
        (lambda: table([0, 1], [1, 2], "spline"), "table: kind = 'spline'; expected one of hold, linear, cubic"),
        (lambda: table([0, 1], [1, 2], after="stop"), "table: after = 'stop'; expected one of hold, error, periodic"),
        (
            lambda: table([0, 1], [1, 2], after="periodic"),
            "table: after='periodic' needs period=, since it is not known",
        ),
        (lambda: table([0, 1], [1, 2], after="periodic", period=0.5), "table: period = 0.5; expected more than 1, the time from"),
        (
            lambda: table([0, 1], [1, 2], period=2),
            "table: period = 2 and after='hold'; give after='periodic'",
        ),
        (lambda: table([0, "a"], [1, 2]), "table: t = .*; expected numbers"),
        (lambda: pwm(0, 0.5), "pwm: period = 0; expected a time > 0"),
        (lambda: pwm(1, 1.5), "pwm: duty = 1.5; expected a number from 0 to 1"),
        (lambda: pwm(1, 0.5, kind="middle"), "pwm: kind = 'middle'; expected one of trailing, leading, centre"),
        (lambda: pwm(1, table([0], [[1, 2]])), "pwm: duty has 2 values; expected one"),
        (lambda: pwm(1, np.nan), "pwm: duty = nan; expected finite numbers"),
        (lambda: steps([[1.0, np.nan]]), r"steps: values\[0, 1\] = nan; expected finite numbers"),
        (lambda: signal(3.0), "is neither a function of t nor an expression of it"),
        (lambda: signal(lambda t: np.nan, name="load"), r"signal 'load': its value at t = 0 = nan; expected finite numbers"),
        (lambda: signal(lambda t: 1 / 0, name="load"), "signal 'load': it raised ZeroDivisionError at t = 0: division by zero"),
        (lambda: signal(np.sin, edges=[1, np.nan]), r"signal 'sin': edges\[1\] = nan; expected finite numbers"),
        (lambda: signal(np.sin, edges=[2, 1]).edges(5), r"signal 'sin': edges\[1\] = 1 is not after edges\[0\] = 2"),
        (lambda: signal(ca.SX.sym("t") + ca.SX.sym("k")), "holds t, k; expected time alone"),
    ],
)
def test_bad_signals_are_refused(made, words):
    with pytest.raises(ModelError, match=words):
        made()


def test_a_table_that_must_reach_the_end():
    with pytest.raises(ModelError, match=r"input 'u': its table ends at t = 2, before the run does at 3; give more rows"):
        InputSchedule.of({"u": table([0, 2], [1, 2], after="error")}, 3.0)
    InputSchedule.of({"u": table([0, 3], [1, 2], after="error")}, 3.0)
