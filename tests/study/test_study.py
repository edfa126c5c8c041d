"""Work-precision studies: orders, floors and costs of made-up lines, errors against closed forms, what is kept when runs fail."""

import csv
import json
import signal
import sys
from dataclasses import replace

import casadi as ca
import closed_forms as exact
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import nsmodel
from nsmodel import FirstOrderSystem, LureSystem, SweepingProcess, UsageError, complementarity, relay
from nsmodel.cli import main
from nsmodel.files.storage import dumps
from nsmodel.plot import work_precision
from nsmodel.simulation.simulate import prepared_loop, simulate
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.study import Line, Point, Study, StudyInterrupted, methods, study
from nsmodel.study import work_precision as measure
from nsmodel.study.lines import PEER_LINE, POINT_LEFT_OUT, least_cost, observed_order
from nsmodel.study.reference import (
    InterpolatedRun,
    Reference,
    ReferenceRows,
    closed_form_reference,
    event_driven_reference,
    make_row_stepper,
    nonuniqueness_reason,
    refined_run_reference,
    state_scales,
)

H = 0.1 / 2.0 ** np.arange(8)
FILE = """
from nsmodel import LureSystem, relay
model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=2, step=0.05, title="Relay")
"""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """One run a point, and nothing is compiled: what is measured is not looked at."""
    monkeypatch.setattr(methods, "LONG_RUN_SECONDS", 0.0)
    monkeypatch.setattr(methods, "STUDY_RTOLS", (1e-2, 1e-3))
    words = ("interpreted", "compiled")
    monkeypatch.setattr(methods, "backend_methods", lambda scheme: [scheme.with_options(word, compiled=False) for word in words])


def line(errors, seconds=None, steps=H, **fields):
    """A line with these errors; the seconds are 1/h where none are given."""
    steps = list(steps)[: len(errors)]
    seconds = [1 / h for h in steps] if seconds is None else seconds
    points = [Point(f"h = {h:g}", s, {"max": e}, step=h) for h, e, s in zip(steps, errors, seconds, strict=True)]
    return Line("made up", tuple(points), **fields)


def decay(theta=1.0, **arguments):
    """x' = -x: the theta scheme gives x_k = ((1 - (1 - theta) h)/(1 + theta h))^k."""
    x, t = ca.SX.sym("x"), ca.SX.sym("t")
    return FirstOrderSystem(
        **({"t": t, "x": x, "f": -x, "x0": 1, "t_end": 1, "step": 0.05, "theta": theta, "exact": [ca.exp(-t)]} | arguments)
    )


# ---------------------------------------------------------------------------------------------- orders, floors


@pytest.mark.parametrize("p", [0.5, 1.0, 2.0])
def test_the_order_of_a_power_law_is_its_exponent(p):
    order = observed_order(H, 3 * H**p)
    assert (order.fit, order.least, order.greatest) == pytest.approx((p, p, p), abs=1e-12)
    assert order.points == len(H)
    assert order.floor is None


def test_the_band_spans_the_slopes_between_neighbours():
    order = observed_order([0.4, 0.2, 0.1], [1.0, 0.5, 0.125])
    assert (order.least, order.greatest, order.fit) == pytest.approx((1, 2, 1.5))


def test_the_floor_is_where_the_error_no_longer_falls():
    order = observed_order(H, np.maximum(H**2, 1e-4))
    assert order.floor == pytest.approx(H[4])  # h^2 falls below 1e-4 from h = 0.01 on: 0.00625
    assert order.fit == pytest.approx(2, abs=1e-12)
    assert order.points == 4


def test_one_stalled_point_at_the_end_is_no_floor():
    assert observed_order(H[:4], [1.0, 0.5, 0.25, 0.25]).floor is None


def test_rounding_and_unresolved_points_have_no_order():
    errors = np.where(H > 0.01, H, 3e-16)
    assert observed_order(H, errors).points == 4
    assert observed_order(H, errors).fit == pytest.approx(1)
    assert observed_order(H, H, [True, True, False, False, False, False, False, False]).points == 2
    rounding = observed_order(H, np.full(8, 2e-16))
    assert rounding.exact
    assert rounding.fit is None


def test_a_line_takes_points_in_any_order_and_each_error_by_itself():
    points = [Point(f"h = {h:g}", 1.0, {"max": h, "end": h**2}, step=h, unresolved=("end",) if h < 0.02 else ()) for h in H]
    made = Line("made up", tuple(points[::-1]))
    assert made.order().fit == pytest.approx(1)
    assert made.order("end").fit == pytest.approx(2)
    assert made.order("end").points == 3
    assert made.order("l2").fit is None


# ---------------------------------------------------------------------------------------------- costs


def test_a_cost_between_points_is_that_of_the_power_law():
    """error = h, seconds = 1/h: an error e needs h = e and takes 1/e."""
    cost = line(H).cost(0.003)
    assert (cost.step, cost.seconds) == pytest.approx((0.003, 1 / 0.003))
    assert cost.how == "between points"


def test_a_cost_beyond_the_points_is_said_to_be_extrapolated():
    cost = line(H**2).cost(1e-7)
    assert (cost.step, cost.seconds) == pytest.approx((10**-3.5, 10**3.5))
    assert cost.how == "extrapolated"
    assert line(H**2).cost(1e-7, own=1e-6) is None  # the reference's own error is above the target
    assert line(H).cost(H[-1] / 200) is None  # too far
    assert line([1.0, 0.5, 0.49, 0.485]).cost(0.1) is None  # it hardly falls
    assert replace(line(H), points=(*line(H).points[:-1], replace(line(H).points[-1], unresolved=("max",)))).cost(1e-4) is None


def test_a_coarse_run_may_be_good_enough():
    cost = line(H).cost(0.5)
    assert (cost.how, cost.step) == ("at the coarsest point", H[0])


def test_an_error_that_rises_again_is_not_reached_before():
    cost = line([0.1, 0.01, 0.05, 0.001]).cost(0.02)
    assert H[3] < cost.step < H[2]


def test_costs_without_steps_name_the_tolerance():
    points = [Point(f"rtol = {r:g}", 1 / r, {"max": r}) for r in (1e-2, 1e-3)]
    cost = Line("variable", tuple(points)).cost(3e-3)
    assert (cost.step, cost.label) == (None, "rtol = 0.001")
    assert cost.seconds == pytest.approx(1 / 3e-3)


def test_the_quickest_line_that_gets_there_wins_over_one_that_only_might():
    might, does = line(H[:4], [1e-3] * 4), replace(line(H), name="does")
    assert least_cost([might, does], 0.002).line == "does"
    assert least_cost([might], 0.002).how == "extrapolated"
    assert least_cost([might, does], 0.05).line == "made up"
    assert least_cost([Line("nothing", (Point.failed("h = 1", "no"),))], 0.1) is None


def test_lines_of_other_programs():
    made = Line.measured("other", [("h = 0.1", 1e-2, 0.5), Point.failed("h = 0.2", "it stopped")], note="version 4")
    assert made.kind == PEER_LINE
    assert made.points[0].error == 1e-2
    assert not made.points[1].drawn
    with pytest.raises(UsageError, match=r"line 'other', h = 1: error = nan; expected a number >= 0, or Point.failed"):
        Line.measured("other", [("h = 1", np.nan, 0.5)])


# ---------------------------------------------------------------------------------------------- errors and references


def scene(x):
    return decay(exact=None), ReferenceRows(np.linspace(0, 1, len(x)), np.array(x, float).reshape(len(x), -1))


def test_errors_are_those_one_finds_by_hand():
    """x(t) = t on [0, 1], largest value 1; the run is off by 0, 0.2, -0.4."""
    model, rows = scene([0, 0.7, 0.6])
    reference = closed_form_reference(lambda t: t[:, None], model, np.linspace(0, 1, 11), None)
    errors = reference.errors(rows)
    assert errors == pytest.approx({"max": 0.4, "end": 0.4, "l2": np.sqrt((0.2**2 + 0.4**2) / 2)})


def test_multiplier_errors_are_integrals():
    """l = 2 against 1 on the second half, equal before: the integral of the difference is 0.5, of the reference 1.5 + ... = 1."""
    t = np.linspace(0, 1, 5)
    right = ReferenceRows(t, np.zeros((5, 1)), np.array([[np.nan], [1], [1], [1], [1.0]]))
    run = ReferenceRows(t, np.zeros((5, 1)), np.array([[np.nan], [1], [1], [2], [2.0]]))
    reference = Reference("made up", "", lambda t: (np.zeros((len(t), 1)), 0.0), np.ones(1), right, {"max": 0.0})
    assert reference.errors(run)["multipliers"] == pytest.approx(0.5)
    assert "multipliers" not in replace(reference, without_multipliers="not unique").errors(run)


def test_a_state_that_stays_zero_is_measured_beside_its_group():
    q = ca.SX.sym("q", 4)
    model = SweepingProcess(q=q, f=[0] * 4, q0=[0] * 4, t_end=1, step=0.1)
    assert state_scales(model, np.array([[0, 0, 2.0, 1e-12]])) == pytest.approx([2, 2, 2, 2])
    assert state_scales(model, np.zeros((1, 4))) == pytest.approx([1, 1, 1, 1])
    named = SweepingProcess(q=q, f=[0] * 4, q0=[0] * 4, t_end=1, step=0.1, names=list("abcd"))
    assert state_scales(named, np.array([[0, 0, 2.0, 1e-12]])) == pytest.approx([1, 1, 2, 1e-12])


def no_step(row, h):
    raise AssertionError("rows of nested grids need no step between")


@pytest.mark.parametrize("p", [1, 2])
def test_a_refined_run_knows_its_own_error(p):
    """x_h = (1 + h^p) t: the last of three runs is off by h^p, beside the largest value 1 + h^p."""
    grids = [np.linspace(0, 1, n + 1) for n in (10, 20, 40)]
    runs = [ReferenceRows(t, ((1 + t[1] ** p) * t)[:, None]) for t in grids]
    assert refined_run_reference(decay(exact=None), "a run", runs, "", no_step).own["max"] == pytest.approx(40.0**-p, rel=0.05)


def test_points_near_the_references_own_error_are_unresolved():
    reference = Reference(
        "made up", "", lambda t: (np.zeros((len(t), 1)), 0.0), np.ones(1), None, {"max": 1e-3, "end": 1e-5, "l2": 1e-9}
    )
    point = reference.point("h = 1", ReferenceRows(np.array([0, 1.0]), np.array([[0], [4e-3]])), 1.0)
    assert point.unresolved == ("max",)
    assert not point.resolved


def test_a_wrong_closed_form_is_refused():
    model = decay(exact=lambda t: np.zeros((len(t), 2)))
    with pytest.raises(UsageError, match=r"exact: it returned shape \(11, 2\) for 11 times; expected \(11, 1\)"):
        closed_form_reference(model.exact, model, np.linspace(0, 1, 11), None)


def test_redundant_constraints_have_no_unique_multipliers():
    q = ca.SX.sym("q")
    twice = SweepingProcess(q=q, f=-1, constraints={"a": q, "b": 2 * q}, q0=0.5, t_end=1, step=0.05)
    assert "the active rows (a, b) is singular" in nonuniqueness_reason(twice, one_step_problem(twice), nsmodel.simulate(twice))
    once = SweepingProcess(q=q, f=-1, constraints={"a": q}, q0=0.5, t_end=1, step=0.05)
    assert nonuniqueness_reason(once, one_step_problem(once), nsmodel.simulate(once)) == ""


# ---------------------------------------------------------------------------------------------- between the rows of a reference


def filtered_bridge(**given):
    """A diode bridge with a capacitor behind it: v_C = 10 and 0 at the start, and equal at once."""
    L, C, R, Cf = 1e-2, 1e-6, 1e3, 3e-7
    basis = {
        "A": [[0, -1 / C, 0], [1 / L, 0, 0], [0, 0, -1 / (R * Cf)]],
        "B": [[0, 0, -1 / C, 1 / C], [0] * 4, [1 / Cf, 0, 1 / Cf, 0]],
        "C": [[0, 0, 1], [0, 0, 0], [-1, 0, 1], [1, 0, 0]], "D": [[0, -1, 0, 0], [1, 0, 1, -1], [0, -1, 0, 0], [0, 1, 0, 0]],
        "law": complementarity(4), "x0": [10, 0, 0], "t_end": 1e-4, "step": 1e-5,
    }  # fmt: skip
    return LureSystem(**(basis | given))


def spring(**given):
    """A mass on a spring with friction as a relay."""
    basis = {"A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "law": relay(1), "x0": [3, 0], "t_end": 2, "step": 0.05}
    return LureSystem(**(basis | given))


def general(**given):
    """A first-order system with a mass matrix, whose multiplier enters nonlinearly; time enters too."""
    x, l, t = ca.SX.sym("x", 2), ca.SX.sym("l"), ca.SX.sym("t")
    basis = {
        "t": t,
        "x": x,
        "lam": l,
        "f": [x[1], -x[0] + ca.sin(t)],
        "g": [0, (2 + x[0] / 9) * l],
        "h": x[1],
        "M": [[1, 0], [0, 2]],
    }
    return FirstOrderSystem(**(basis | {"law": relay(1), "x0": [3, 0], "t_end": 2, "step": 0.05} | given))


@pytest.mark.parametrize(
    "model",
    [
        spring(), spring(gamma=0.5, theta=0.5), general(), general(gamma=0.5), "friction_oscillator", "point_past_disc",
        "inclusion_8_2",
    ],
    ids=["Lur'e", "Lur'e, gamma", "first order", "first order, gamma", "oscillator", "sweeping", "inclusion"],
)  # fmt: skip
def test_a_step_from_a_row_of_a_run_leads_to_the_next_row(model, load_case):
    model = load_case(model) if isinstance(model, str) else model
    run = prepared_loop(model, t_end=20 * model.step, compiled=False)
    start = run.propagator.state.copy()
    made = run.go()
    step = make_row_stepper(run.propagator, start, made)
    for row in range(20):
        np.testing.assert_allclose(step(row, made.step[row + 1]), made.x[row + 1], rtol=1e-9, atol=1e-12)
    assert np.isfinite(step(3, 0.3 * model.step)).all()


def test_a_reference_that_jumps_or_bends_is_stepped_and_not_drawn_through():
    """x = 1 after a jump at 0, and from t = 1 on t: where a row falls between rows of the run the line is off by up to 1."""
    t = np.linspace(0, 2, 21)
    x = np.where(t > 0, np.maximum(t, 1.0), 0.0)[:, None]
    asked = []

    def step(row, h):
        asked.append((row, h))
        return np.array([np.maximum(t[row] + h, 1.0)])

    between = InterpolatedRun(t, x, step, np.ones(1), 1e-3)
    times = np.array([0, 1e-6, 0.04, 0.1, 0.55, 1.0, 1.03, 1.55, 2.0])
    found, left = between(times)
    np.testing.assert_allclose(found.ravel(), np.where(times > 0, np.maximum(times, 1.0), 0.0), rtol=1e-12)
    assert {row for row, _ in asked} == {0, 10}
    assert left < 1e-12
    assert replace(between, good=np.inf)(times)[1] > 0.1


def test_what_cannot_be_stepped_leaves_its_rows_unresolved(monkeypatch):
    monkeypatch.setattr(sys.modules["nsmodel.study.reference"], "MAX_SINGLE_STEPS", 1)
    t = np.linspace(0, 1, 11)
    x = np.where(t > 0, 1.0, 0.0)[:, None]
    between = InterpolatedRun(t, x, lambda row, h: np.ones(1), np.ones(1), 1e-3)
    reference = Reference("made up", "", between, np.ones(1), None, dict.fromkeys(("max", "end", "l2"), 1e-6))
    one, two = (
        ReferenceRows(np.array([0, *times, 1.0]), np.array([0, *np.ones(len(times)), 1.0])[:, None])
        for times in ([0.01], [0.01, 0.02])
    )
    assert reference.point("one", one, 1.0).errors["max"] == 0
    assert reference.point("one", one, 1.0).unresolved == ("max", "end", "l2")  # errors of 0 always are
    assert reference.point("two", two, 1.0).errors["max"] > 0.5
    assert "max" not in reference.point("two", replace(two, x=two.x + 20), 1.0).unresolved
    assert "max" in reference.point("two", two, 1.0).unresolved
    lost = InterpolatedRun(t, x, lambda row, h: np.full(1, np.nan), np.ones(1), 1e-3)
    assert lost(np.array([0.05]))[1] > 0.1


def test_variable_steps_over_a_jump_are_within_what_they_ask(monkeypatch):
    """The first row of error control lies far inside the reference's first step, over which a capacitor is charged at once."""
    monkeypatch.setattr(methods, "STUDY_RTOLS", (1e-4,))
    found = study(filtered_bridge(t_end=4e-5), steps=[1e-5], solvers=[], budget=300)
    variable = [line for line in found.lines if "variable" in line.name]
    assert len(variable) == 2
    for line in variable:
        for point in line.points:
            assert point.status == "done"
            assert point.error < 1e-4


# ---------------------------------------------------------------------------------------------- whole studies


@pytest.fixture(scope="module")
def half_line(load_case):
    """With all tolerances, and really compiled; each run is made once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "LONG_RUN_SECONDS", 0.0)
        return study(load_case("moving_half_line"), steps=[0.06, 0.03, 0.015], solvers=["lemke"], target=5e-3, budget=600)


@pytest.mark.long
def test_errors_of_a_study_are_those_of_its_runs(half_line, load_case):
    for point in half_line.line("interpreted").points:
        run = nsmodel.simulate(load_case("moving_half_line"), step=point.step)
        error = np.abs(run.x - exact.half_line(run.t))
        assert point.error == pytest.approx(error.max() / 1.0, rel=1e-3)  # sin t reaches 1 within 1e-3 on the grid
        assert point.errors["end"] == pytest.approx(error[-1].max(), rel=1e-3)
        l = np.abs(run.reactions[1:, 0] - exact.half_line_multiplier(run.t[1:])).mean() * 3
        size = 1 + np.sqrt(2)  # of cos t + sin t from 0 to 3 pi/4
        assert point.errors["multipliers"] == pytest.approx(l / size, abs=2 * half_line.reference.own["multipliers"])
        assert point.steps == len(run)
        assert point.residual <= 1e-9
        assert point.violation <= 1e-12
        assert point.seconds > 0
        assert point.setup > 0


@pytest.mark.long
def test_all_ways_of_a_scheme_have_its_errors_and_order_one(half_line):
    first = [point.error for point in half_line.line("interpreted").points]
    assert half_line.line("interpreted").order().fit == pytest.approx(1, abs=0.1)
    for name in ("compiled", "lemke"):
        assert [point.error for point in half_line.line(name).points] == pytest.approx(first, rel=1e-9)
    assert [point.status for point in half_line.line("interpreted, variable steps").points] == ["done"] * 6


def test_the_target_is_priced_with_the_quickest_line(half_line):
    cost, prices = half_line.cost(5e-3), [line.cost(5e-3, half_line.reference.own["max"]) for line in half_line.lines]
    assert cost.seconds == min(one.seconds for one in prices if one is not None and one.how != "extrapolated")
    where = cost.label if cost.step is None else f"step <= {cost.step:.2g}"
    assert f"error 0.005 needs {where} ({cost.line})" in half_line.text()
    assert half_line.document()["target"]["cost"]["seconds"] == cost.seconds
    with pytest.raises(UsageError, match="target = 0; expected a finite number > 0"):
        half_line.cost(0)


def test_a_refined_reference_agrees_with_the_closed_form(half_line, load_case):
    model = replace(load_case("moving_half_line"), exact=None)
    found = study(model, steps=[0.06, 0.03], solvers=[])
    assert found.reference.own["max"] < 2e-3
    for name in ("interpreted", "compiled"):
        for ours, theirs in zip(found.line(name).points, half_line.line(name).points, strict=False):
            assert ours.error == pytest.approx(theirs.error, rel=1e-5, abs=2 * found.reference.own["max"])  # scales are of rows
    blind = replace(found, target=found.reference.own["max"] / 1e3, lines=found.lines[:1])
    assert "cannot be told from the reference's own error" in blind.text()


@pytest.mark.parametrize(("theta", "expected"), [(1.0, 2), (0.5, 4)])
def test_richardson_gains_the_orders_that_theory_says(theta, expected):
    found = study(decay(theta), steps=[0.1, 0.05, 0.025], solvers=[], budget=20)
    richardson = found.lines[-1]
    assert richardson.name.endswith("Richardson")
    assert f"p = {expected // 2}" in richardson.note
    assert richardson.order().fit == pytest.approx(expected, abs=0.1)
    own = found.lines[0]
    assert richardson.points[0].seconds == pytest.approx(sum(point.seconds for point in found.lines[1].points[:2]))
    x = [(((1 - (1 - theta) * h) / (1 + theta * h)) ** np.arange(round(1 / h) + 1)) for h in (0.1, 0.05, 0.025)]
    errors = [np.abs(values - np.exp(-np.linspace(0, 1, len(values)))).max() for values in x]
    assert [point.error for point in own.points] == pytest.approx(errors, rel=1e-9)


def test_schemes_with_other_weights_are_measured_too(load_case):
    names = {method.name for method in methods.scheme_methods(load_case("rlc_diode"))}
    assert names == {"theta = 1/2, gamma = 1", "theta = 1, gamma = 1", "theta = 1/2, gamma = 1/2"}
    assert [method.name for method in methods.scheme_methods(load_case("friction_oscillator"))] == [""]


def test_default_steps_nest_around_the_models_own():
    counts = measure._default_step_counts(12, 1e-3)
    assert counts == [750 * 2**j for j in range(8)]
    assert measure._default_step_counts(0.7, 0.02) == [8, 16, 32, 64, 128, 256]
    assert measure._default_step_counts(3, 1.0) == [3, 6, 12, 24]


# ---------------------------------------------------------------------------------------------- failures, budget, Ctrl-C


def explosion():
    """x' = x^2: an implicit step h from x has no solution where 4 h x > 1."""
    x = ca.SX.sym("x")
    return FirstOrderSystem(x=x, f=x**2, x0=1, t_end=0.5, step=0.01, title="Growth")


def test_failed_runs_are_kept_and_shown():
    found = study(explosion(), steps=[0.5, 0.25, 0.05, 0.025], solvers=[])
    points = found.lines[0].points
    assert points[0].status == "failed"
    assert "no verified step from t = 0 to 0.5" in points[0].message
    assert points[-1].status == "done"
    assert "h = 0.5, h = 0.25: failed" in found.text() or "h = 0.5: failed" in found.text()
    assert any("failed" in text.get_text() for text in found.plot().texts)
    assert found.document()["lines"][0]["points"][0]["message"] == points[0].message


def test_what_the_budget_leaves_out_is_named():
    found = study(decay(), steps=[0.1, 0.05], solvers=[], budget=1e-9)
    assert {point.status for line in found.lines for point in line.points} == {POINT_LEFT_OUT}
    assert "h = 0.1, h = 0.05: left out for the time budget" in found.text()
    with pytest.raises(nsmodel.PlotError, match="no point with an error and a time"):
        found.plot()


def test_an_interrupted_study_keeps_what_it_has(monkeypatch, tmp_path, capsys):
    timed, count = methods.time_runs, iter(range(100))

    def stopping(*arguments):
        if next(count) == 3:
            signal.raise_signal(signal.SIGINT)
        return timed(*arguments)

    monkeypatch.setattr(methods, "time_runs", stopping)
    with pytest.raises(StudyInterrupted) as stop:
        study(decay(), steps=[0.1, 0.05, 0.025], solvers=[])
    assert stop.value.study.status == "interrupted"
    assert sum(len(line.points) for line in stop.value.study.lines) == 3
    count = iter(range(100))
    (tmp_path / "relay.py").write_text(FILE)
    assert main(["study", str(tmp_path / "relay.py"), "--solvers", "", "--out", str(tmp_path / "out")]) == 130
    out, err = capsys.readouterr()
    assert "interrupted: what follows was measured before" in out
    assert "nsmodel: interrupted" in err
    assert json.loads((tmp_path / "out" / "study.json").read_text())["status"] == "interrupted"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": []}, r"steps: expected a list of numbers > 0"),
        ({"steps": [0.1, -1]}, r"steps\[1\] = -1; expected a number > 0 and at most t_end = 1"),
        ({"steps": [2.0]}, r"steps\[0\] = 2; expected"),
        ({"target": 0}, "target = 0; expected a finite number > 0"),
        ({"budget": "long"}, "budget = 'long'; expected a finite number > 0"),
        ({"t_end": -1}, "t_end = -1; expected"),
        ({"solvers": "lemke"}, "solvers = 'lemke'; expected a list of names"),
        ({"solvers": ["gurobi"]}, "solver 'gurobi' is unknown; choose one of"),
        ({"parameters": {"mu": 1}}, "parameter 'mu' is not declared"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        study(decay(), **arguments)
    with pytest.raises(UsageError, match=r"expected a model such as LureSystem\(...\)"):
        study("decay.py")


def test_a_solver_that_does_not_apply_is_noted():
    found = study(decay(), steps=[0.1, 0.05], solvers=["lemke"])
    assert any(note.startswith("lemke is left out: solver 'lemke' does not apply") for note in found.notes)


# ---------------------------------------------------------------------------------------------- what comes out


def test_foreign_runs_are_measured_with_the_same_errors(half_line):
    t = np.linspace(0, 3, 400)
    point = half_line.point("tol = 1", t, exact.half_line(t) + 1e-3, 0.5)
    assert point.error == pytest.approx(1e-3, rel=1e-3)
    more = half_line.with_lines([Line.measured("other", [point, Point.failed("tol = 2", "it crashed")], "made up")])
    assert isinstance(more, Study)
    assert "other (measured elsewhere)\n  made up\n" in more.text()
    assert "tol = 2: failed: it crashed" in more.text()
    assert more.document()["lines"][-1]["kind"] == "peer"
    for wrong, message in [
        ((t[:-1], exact.half_line(t)), "expected \\(N\\+1,\\) and \\(N\\+1, 1\\)"),
        ((t / 2, exact.half_line(t)), "t goes from 0 to 1.5; expected 0 to 3"),
        ((t, exact.half_line(t) * np.nan), "take Point.failed"),
    ]:
        with pytest.raises(UsageError, match=message):
            half_line.point("h = 1", *wrong, 0.5)


def test_text_json_and_csv_say_the_same(half_line, tmp_path):
    text, document = half_line.text(), json.loads(dumps(half_line.document()))
    assert max(map(len, text.splitlines())) <= 100
    half_line.to_csv(tmp_path / "study.csv")
    with (tmp_path / "study.csv").open() as file:
        rows = list(csv.DictReader(file))
    points = [(line, point) for line in half_line.lines for point in line.points]
    assert len(rows) == len(points) == sum(len(line["points"]) for line in document["lines"])
    for row, (line, point) in zip(rows, points, strict=True):
        assert (row["line"], row["label"], float(row["error_max"])) == (line.name, point.label, point.error)
        assert float(row["seconds"]) == point.seconds
    order = document["lines"][0]["orders"]["max"]
    assert f"order {order['fit']:.2f} ({order['least']:.2f} to {order['greatest']:.2f} between neighbours" in text
    assert document["reference"]["text"] in text


def test_the_figure_has_a_line_a_method_and_its_steps(half_line):
    ax = half_line.plot()
    FigureCanvasAgg(ax.figure).draw()
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert names == [line.name for line in half_line.lines]
    curve = ax.lines[0]
    assert list(curve.get_xdata()) == [point.error for point in half_line.lines[0].points]
    assert list(curve.get_ydata()) == [point.seconds for point in half_line.lines[0].points]
    assert "0.06" in [text.get_text() for text in ax.texts]
    assert work_precision(half_line, ax=ax) is ax


def test_the_command_line(tmp_path, capsys):
    (tmp_path / "relay.py").write_text(FILE)
    file, out = str(tmp_path / "relay.py"), tmp_path / "out"
    arguments = [file, "--steps", "0.1,0.05", "--solvers", "", "--target", "0.01", "--budget", "30"]
    assert main(["study", *arguments, "--json", "--out", str(out), "--csv", str(tmp_path / "a.csv")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["lines"][0]["name"] == "theta = 1, gamma = 1, interpreted"
    assert document == json.loads((out / "study.json").read_text())
    assert {path.name for path in out.iterdir()} == {"study.txt", "study.json", "study.csv", "study.png"}
    assert (tmp_path / "a.csv").read_text() == (out / "study.csv").read_text()
    for wrong, message in [
        (["--steps", "a"], "--steps a: expected numbers with commas between"),
        (["--steps", "-1"], "steps[0] = -1; expected a number > 0"),
        (["--solvers", "gurobi"], "solver 'gurobi' is unknown"),
        (["--target", "0"], "target = 0"),
    ]:
        assert main(["study", file, *wrong]) == 2
        assert message in capsys.readouterr().err


def test_reactions_of_a_circuit_are_unique_and_compared(load_case):
    found = study(load_case("rlc_diode"), steps=[2e-5, 1e-5], solvers=[], t_end=1e-3)
    assert found.reference.without_multipliers == ""
    assert 0 < found.lines[0].points[-1].errors["multipliers"] < 0.1


def test_energy_of_an_oscillator_is_never_gained(load_case):
    found = study(load_case("friction_oscillator"), steps=[0.02, 0.01], solvers=[])
    assert all(point.energy <= 1e-13 for point in found.line("interpreted").points)


def test_means_of_declared_outputs_are_compared_too():
    p, v = ca.SX.sym("p_1"), ca.SX.sym("v_1")

    def made(theta):
        return LureSystem(
            x=[p, v], A=[[0, 1], [-1, 0]], B=[[0], [1]], C=[[0, 1]], D=0, law=relay(1), x0=[5.3, 0], t_end=3, step=1e-2,
            theta=theta, outputs={"speeds": ca.vertcat(v, v**2), "place": p},
        )  # fmt: skip

    found = study(made(0.5), steps=[0.1, 0.05, 0.025], solvers=[])
    # x = 1 + 4.3 cos t until t = pi
    means = {"v": 4.3 * (np.cos(3) - 1) / 3, "v^2": 4.3**2 * (3 - np.sin(6) / 2) / 6, "p": 1 + 4.3 * np.sin(3) / 3}
    sizes = {"v": 4.3, "v^2": 4.3**2, "p": 5.3}
    for line, order in ((found.lines[0], 2), (found.line("theta = 1, gamma = 1, interpreted"), 1)):
        assert line.order("outputs").fit == pytest.approx(order, abs=0.15)
        for point, h in zip(line.points, [0.1, 0.05, 0.025], strict=True):
            run = nsmodel.simulate(made(0.5 if order == 2 else 1.0), step=point.step, compiled=False)
            own = {"v": run.mean("speeds")[0], "v^2": run.mean("speeds")[1], "p": run.mean("place")}
            expected = max(abs(own[key] - means[key]) / sizes[key] for key in means)
            assert point.step == pytest.approx(h, rel=0.1)
            assert point.errors["outputs"] == pytest.approx(expected, rel=1e-2, abs=1e-9)
    assert "outputs: of their means" in " ".join(found.text().split())
    assert max(map(len, found.text().splitlines())) <= 100


# ---------------------------------------------------------------- steps and pieces that are to agree


def swinging(**options):
    """A mass on a spring with dry friction that stops at t = 3 pi; not the scheme of the best states has the best multipliers."""
    given = {"names": ["s", "v"], "A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "law": relay(1), "x0": [5.3, 0], "t_end": 12}
    return LureSystem(**given, step=0.1, **options)


@pytest.mark.parametrize("steps", [[0.4, 0.2], [0.1, 0.05]])
def test_an_event_driven_run_is_the_reference_of_few_steps_too(steps):
    found = study(swinging(), steps=steps, solvers=[], budget=20)
    assert found.reference.text == "an event-driven run, rtol = 1e-11"
    assert not [note for note in found.notes if "differ by" in note]


def test_what_steps_and_pieces_differ_by_counts_as_the_error_of_the_steps():
    model = swinging()
    rough, fine = (simulate(model, rtol=rtol) for rtol in (1e-9, 1e-11))
    run = simulate(model, step=0.01)
    rows = ReferenceRows(run.t, run.x + np.array([0.1, 0.0]))
    one = np.ones(2)
    own = {"max": 1e-4, "end": 1e-4}
    refined = Reference("a run of 1200 steps", "", InterpolatedRun(run.t, rows.x, None, one, np.inf), one, rows, own)
    found, doubt = event_driven_reference(model, 1e-11, rough, fine, refined)
    assert found.text == refined.text
    assert "an event-driven run and a run of 1200 steps differ by" in doubt
    errors = np.abs(rows.x - fine.at(run.t).x) / [5.3, 4.3]  # the mass starts 5.3 away, and is at most 4.3 fast
    assert found.own["max"] == pytest.approx(errors.max(), rel=1e-2)
    assert found.own["end"] == pytest.approx(errors[-1].max(), rel=1e-2)
