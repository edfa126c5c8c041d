"""Scenes of event-driven runs against 64 digits of the test's own, and degenerate ones: each within ten times rtol."""

import decimal
from decimal import Decimal

import casadi as ca
import event_models as models
import numpy as np
import pytest
from fuzz_models import COUNT, FULL

from nsmodel import FirstOrderSystem, StepError, simulate
from nsmodel.codegen import library
from nsmodel.modeling.laws import relay
from tests import event_scenes as scenes
from tests.event_digits import judged
from tests.event_ties import loops
from tests.search.digits import CONTEXT, exact

RTOLS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)


def capacitor_filter():
    """The start jumps: C and C_f share their charge, exactly 10 C/(C + C_f)."""
    model = scenes.capacitor_filter()
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("l", 4)
    rate, y = model.A if model.A.is_column() else model.A @ x, model.C @ x + model.D @ l
    rate = ca.substitute(rate, model.x, x) + model.B @ l
    with decimal.localcontext(CONTEXT):
        shared = Decimal(10) * exact(1e-6) / (exact(1e-6) + exact(3e-7))
    scene = models.Scene(model, t, x, l, rate, y, np.zeros(4), np.full(4, np.inf), rate, models.Sides())
    return scene, [shared, Decimal(0), shared]


def mixed():
    """D of rank 1 on two rows that are active together; M full; fabs, fmax and if_else in f; an input with an edge in time."""
    t, x, l, sides = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("l", 2), models.Sides()
    M = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.25], [0.0, 0.25, 1.5]])
    D, C = np.array([[1.0, 0.5], [0.5, 0.25]]), np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.5]])
    edge = 1.375
    plain = ca.vertcat(-x[0] + 3 * ca.sin(2 * t), x[2] - x[1] / 2, -x[1] - x[2] + 2 * ca.cos(3 * t))
    drive = ca.if_else(t < edge, 1, -0.5)
    real = plain + ca.vertcat(ca.fabs(x[1]) / 2, drive, ca.fmax(x[0], x[2] / 2) + ca.if_else(x[2] > 0, ca.sin(x[2]), 0))
    z = x[0] - x[2] / 2
    fixed = plain + ca.vertcat(
        sides.chosen(x[1], x[1], -x[1]) / 2, sides.chosen(edge - t, 1, -0.5),
        sides.chosen(z, x[0], x[2] / 2) + sides.chosen(x[2], ca.sin(x[2]), 0),
    )  # fmt: skip
    push, y = C.T @ l, C @ x + D @ l
    # C x0 = (2, 1) is in the range of D: the combination that no l acts on is 0
    model = FirstOrderSystem(t=t, x=x, lam=l, M=M, f=real, g=push, h=y, law=relay(2, -2, 2), x0=[1.5, 1, 0], t_end=3)
    inverse = ca.inv(ca.SX(ca.DM(M)))
    low, high = np.full(2, -2.0), np.full(2, 2.0)
    return models.Scene(model, t, x, l, inverse @ (real + push), y, low, high, inverse @ (fixed + push), sides), None


@pytest.mark.parametrize("make", [capacitor_filter, mixed])
def test_scenes_against_64_digits(make):
    scene, start = make()
    T = float(scene.model.t_end)
    t = np.linspace(0, T, 41 if COUNT >= FULL else 9)[1:]
    reference = judged(scene, T, x0=start)
    right = reference.at(t)[0]
    times = np.array([float(event.t) for event in reference.events])
    assert len(times) >= 4
    for rtol in RTOLS:
        run = simulate(scene.model, rtol=rtol, method="event-driven")
        assert (np.abs(run.at(t).x - right) / np.abs(right).max(axis=0)).max() <= 10 * rtol
        found = [event.t for event in run.events if event.t > 0]
        assert len(found) == len(times)
        assert np.abs(np.array(found) - times).max() <= 10 * rtol * T


@pytest.mark.parametrize("rtol", RTOLS)
def test_a_switch_of_what_a_switch_chooses_is_rounding_where_that_is(rtol):
    """A sliding speed is held at 0, and f has fmax(fabs(speed), 1e-150): known to what speeds are, not to 1e-150."""
    own = models.CLASSES["oscillator"](1018)
    run, right = simulate(own.model, rtol=rtol, method="event-driven", t_end=1), judged(own, 1)
    t = np.linspace(0, 1, 11)[1:]
    n = own.model.x.numel()
    assert np.abs(run.at(t).x - right.at(t)[0][:, :n]).max() <= 10 * rtol
    assert len(run.events) == len(right.events)


@pytest.mark.parametrize("compiled", [False, True] if library.compiler() else [False])
@pytest.mark.parametrize("rtol", RTOLS)
def test_rows_that_are_the_same_move_nothing(rtol, compiled):
    """y_2 = y_3: their difference is rounding, and so is how x moves it. It moved x by 1.2 at an event, at every rtol."""
    own = loops(1232)
    run, right = simulate(own.model, rtol=rtol, method="event-driven", compiled=compiled), judged(own, 3)
    t = np.linspace(0, 3, 11)[1:]
    assert np.abs(run.at(t).x - right.at(t)[0]).max() <= 10 * rtol


@pytest.mark.parametrize("compiled", [False, True] if library.compiler() else [False])
@pytest.mark.parametrize("rtol", RTOLS)
def test_a_wall_is_left_with_a_speed_that_is_rounding(rtol, compiled):
    """y = -2e-16 s + 1.7 s^2: the mode is chosen by the second order, and does not end at once by the first."""
    own = loops(1188)
    T = float(own.model.t_end)
    run, right = simulate(own.model, rtol=rtol, method="event-driven", compiled=compiled), judged(own, T)
    t = np.linspace(0, T, 11)[1:]
    assert np.abs(run.at(t).x - right.at(t)[0]).max() <= 10 * rtol * max(1.0, np.abs(right.at(t)[0]).max())


@pytest.mark.parametrize("rtol", RTOLS)
def test_rows_that_rest_while_l_grows(rtol):
    """y_0 is 0 on all of [0, 5], and what holds it grows from 2 to 6, less what l takes: 0 is known to rounding of that."""
    own = loops(31)
    run, right = simulate(own.model, rtol=rtol, method="event-driven"), judged(own, 5)
    t = np.linspace(0, 5, 11)[1:]
    assert np.abs(run.at(t).x - right.at(t)[0]).max() <= 10 * rtol * max(1.0, np.abs(right.at(t)[0]).max())


@pytest.mark.parametrize("rtol", RTOLS)
@pytest.mark.parametrize("depth", [1e-6, 1e-10, 1e-13, 1e-15, 0.0, -1e-15, -1e-13, -1e-6])
def test_grazing_at_every_rtol(depth, rtol):
    """Deeper than 0 the wall pushes with 100 times the depth, for 2 sqrt(2 depth): 1e-6 deep that is 3e-7 of speed."""
    run = simulate(scenes.grazing(depth), rtol=rtol, method="event-driven")
    t = np.linspace(0, 6, 100)
    felt = 100 * max(depth, 0) * 2 * np.sqrt(2 * max(depth, 0)) * (1 + 10 * rtol)
    assert np.abs(run.at(t).x - np.stack([np.sin(t), np.cos(t)], 1)).max() <= 10 * rtol + felt
    if rtol <= abs(depth):  # else the touch is within what x may err by
        assert len(run.events) == (2 if depth > 0 else 0)


def test_not_unique_is_named_at_every_rtol():
    for rtol in RTOLS:
        model = models.LureSystem(A=[[0]], B=[[-1]], C=[[1]], law=relay(1), x0=[0], t_end=1, step=0.1)
        with pytest.raises(StepError, match="not unique"):
            simulate(model, rtol=rtol, method="event-driven")


@pytest.mark.parametrize("rtol", RTOLS)
def test_degree_2_and_twisting_at_every_rtol(rtol):
    T = 100
    run = simulate(scenes.relay_of_degree_2(0, T), rtol=rtol, method="event-driven")
    k = np.arange(1, len(run.events) + 1)
    assert len(k) == 35
    assert np.abs([event.t for event in run.events] - np.sqrt(2) * (2 * k - 1)).max() <= 10 * rtol * T
    run = simulate(scenes.twisting(), rtol=rtol, method="event-driven")
    end = (np.sqrt(2) + np.sqrt(2) / 3) / (1 - 1 / np.sqrt(3))
    assert abs(run.events[-1].t - end) <= max(10 * rtol * 10, 1e-5)
    assert np.abs(run.x[-1]).max() <= 10 * rtol
