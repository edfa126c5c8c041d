"""Until when solutions provably stay in a box: closed forms, and fine runs of random models, which never leave before."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import mpmath
import numpy as np
import pytest
from fuzz_models import COUNT, FULL
from search.checked import draw

from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, MonotoneInclusion, StepError, check, relay, simulate
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.hypotheses.moving_law import freeze_law
from nsmodel.hypotheses.region import region_of
from nsmodel.hypotheses.staying import stay_by_rates, stay_in_ball
from nsmodel.models.lure_system.inputs_and_parameters import unit_ball_box
from nsmodel.proof import exact

x, t, p, s = (ca.SX.sym(name) for name in ("x", "t", "p", "s"))
q = ca.SX.sym("q", 2)
CLASSES = ("first_order", "lure", "oscillator", "inclusion")


def until(model, **options):
    """Return the time of the first consequence that has one."""
    report = check(model, [], quick=True, **options)
    return next((item.until for item in report.consequences if item.until is not None), None)


@pytest.mark.parametrize(
    ("distance", "omega", "drive", "radius"), [(0.2, 1.5, 0.3, 2), (0.2, 0, 0.3, 2), (0.5, -1, 3, 2), (0, 1e-9, 1, 1)]
)
def test_the_ball_grows_as_its_equation_says(distance, omega, drive, radius):
    T = stay_in_ball(distance, omega, drive, radius)
    h = T / 2_000
    r = distance
    for _ in range(2_000):  # the middle rule, of order 2
        k = omega * r + drive
        r += h * (omega * (r + h * k / 2) + drive)
    assert r == pytest.approx(radius, rel=1e-5)


def test_a_ball_that_stays_small_or_begins_outside():
    assert stay_in_ball(1, -1, 1, 1.5) == np.inf  # r -> 1
    assert stay_in_ball(1, 0, 0, 1.5) == np.inf
    assert stay_in_ball(2, -1, 0, 1.5) == 0


def test_the_time_of_a_ball_is_rounded_down_where_it_nearly_rests():
    """At the radius the speed is some last digits of its terms, and the time its logarithm."""
    rng = np.random.default_rng(0)
    assert stay_in_ball(0.0, 0.0, 1.0, np.inf) == stay_in_ball(0.0, 1.0, 1.0, np.inf) == np.inf
    for _ in range(200):
        omega, radius = -rng.uniform(0.1, 3.0), rng.uniform(0.5, 2.0)
        distance, drive = rng.uniform(0.0, 0.9) * radius, -omega * radius * (1 + 10.0 ** rng.uniform(-16, -9))
        speed, end = (Fraction(omega) * Fraction(r) + Fraction(drive) for r in (distance, radius))
        found = stay_in_ball(distance, omega, drive, radius)
        if end <= 0:
            assert found == np.inf
        else:
            quotient = speed / end
            with mpmath.workdps(40):
                exact = mpmath.log(mpmath.mpf(quotient.numerator) / quotient.denominator) / -mpmath.mpf(omega)
                assert exact * (1 - 1e-8) <= found <= exact


def test_rates_between_boxes_find_the_growth_of_an_exponential():
    """x' = x from 0.1 comes to 1 after log 10; sixteen boxes prove more than half of it, one would prove 0.9."""
    model = FirstOrderSystem(x=q, f=[q[0] + 0 * q[1], -q[1]], x0=[0.1, 0], t_end=1, step=0.1)
    region = region_of(model, [], {"q": (-1, 1)})
    start = np.array([0.1, 0.0])
    T = stay_by_rates(model.f, model.x, ca.SX(0, 1), (np.zeros(0), np.zeros(0)), region, (start, start))
    assert 0.6 * np.log(10) < T < np.log(10)


@pytest.mark.parametrize("box", [None, (0.5, 2)])
def test_times_of_first_order_systems(box):
    """x' = p x^2 with a relay against it: from 1/2 to 1 in 1/p at least; where all rates point inwards, for ever."""
    more = {"region": {"x": (-1, 1)}} | ({} if box is None else {"parameters": {"p": box}})
    l = ca.SX.sym("l")
    grown = FirstOrderSystem(x=x, f=[p * x**2], x0=[0.5], t_end=1, step=0.01, parameters={p: 1.0})
    T = until(grown, **more)
    assert 0.4 < T * (2 if box else 1) < 1
    still = FirstOrderSystem(
        x=x, lam=l, f=[-p * x**3 - 2 * x], g=[l / 4], h=[x], law=relay(1), x0=[0.5], t_end=1, step=0.01, parameters={p: 1.0}
    )
    assert until(still, **more) == np.inf


def test_times_of_lure_systems():
    """omega = 3 on the box: |x - x0|_P is at most g (e^(3 t) - 1) / 3; a relay keeps the box of a contracting one."""
    model = LureSystem(
        x=q, A=[q[0] + q[0] ** 2, -q[1] - q[1] ** 3], B=[1, 0], C=[1, 0], law=relay(1), x0=[0.2, 0.1], t_end=1, step=0.01
    )
    T = until(model, region={"q": (-1, 1)})
    assert 0.4 < T < np.log(1 / 0.2)  # x' <= x + x^2 - 1 < 0 there: it stays, which is not proved
    pull = [-2 * q[0] - q[0] ** 3, -q[1] + q[1] ** 2 / 2]
    inwards = LureSystem(x=q, A=pull, B=[0, 0.25], C=[0, 1], law=relay(1), x0=[0.2, 0.1], t_end=1, step=0.01)
    assert until(inwards, region={"q": (-1, 1)}) == np.inf


def test_times_of_oscillators():
    """g = x^4/4 - x^2/16, E(0) < g(1): the energy keeps x within the box; a force may drive it out."""
    given = {"x": x, "s": s, "potential": x**4 / 4 - x**2 / 16, "friction": 0.1 * s, "t_end": 1, "step": 0.01}
    region = region_of(FrictionOscillator(**given, x0=0.3), [], {"x": (-1, 1)})

    def times(model):
        own = model.bind()
        found = check(own, [], quick=True, region={"x": (-1, 1)}).findings
        start = np.array(ca.DM(own.x0)).ravel()
        return HYPOTHESIS_CHECKS.of(own).stay_times(own, region, found, (start, start))

    assert times(FrictionOscillator(**given, x0=0.3))[0].until == np.inf
    (fast,) = times(FrictionOscillator(**given, x0=0.3, v0=3.0))
    assert 0.2 < fast.until <= 0.7 / 3
    (driven,) = times(FrictionOscillator(**given, x0=0.0, t=t, force=ca.cos(t)))
    assert 0.9 < driven.until <= np.sqrt(2) * 1.01  # t^2 / 2 = 1 with the whole force


def test_times_of_inclusions_over_a_box():
    """x' in p x - Sgn x from 0.1: e^(2 t) / 10 is at 1 after 1.15; a set that moves at 1 pushes x from 1/2 to 1 by t = 1."""
    given = {"t": t, "x": x, "t_end": 2, "step": 0.01, "parameters": {p: 1.0}}
    model = MonotoneInclusion(field=[p * x + x**3 / 100], operator=[ca.sign(x)], x0=[0.1], **given)
    T = until(model, region={"x": (-1, 1)}, parameters={"p": (0.5, 2)})
    assert 0.25 < T < np.log(10) / 2
    pushed = MonotoneInclusion(field=[p * x**3 / 100], lower=[t], x0=[0.5], **given)
    assert 0.4 < until(pushed, region={"x": (-1, 1)}) <= 1


@pytest.mark.parametrize("gap", [0.5, 1e-4, 1e-8, 1e-10])
@pytest.mark.parametrize("size", [1.0, 1e6])
def test_the_box_of_a_nearly_singular_norm_holds_its_ball(gap, size):
    P = np.array([[1.0, (1 - gap) * size], [(1 - gap) * size, size**2]])
    reach, room = unit_ball_box(P)
    for off in (-1, 0, 1):  # A rational P that has these doubles: its entries are off by half of EPS, at most.
        one = exact.rational(P)
        one[0, 0] += off * one[0, 0] * Fraction(exact.MACHINE_EPSILON) / 2
        true = np.sqrt(exact.doubles(np.diagonal(exact.inverse_matrix(one))))
        assert (reach >= true).all()
        assert (reach <= true * room**2).all()
    assert room < 1 + 1e-8 / min(gap, 1)


@pytest.mark.parametrize("gap", [0.0, 1e-16, 2e-15])
def test_a_norm_that_is_singular_to_rounding_bounds_nothing(gap):
    reach, room = unit_ball_box(np.array([[1.0, 1 - gap], [1 - gap, 1.0]]))
    assert room == np.inf
    assert (reach == np.inf).all()


def left_before(name, seed):
    """Return (the time of a random model, what of its runs is outside of the box before); None where no time is known."""
    model = freeze_law(draw(name, seed)).bind()
    if model.u.numel() or model.p.numel():
        return None
    region = region_of(model, [])
    found = check(model, [], quick=True).findings
    start = np.array(ca.DM(model.start)).ravel()
    times = HYPOTHESIS_CHECKS.of(model).stay_times(model, region, found, (start, start))
    T = max((item.until for item in times), default=0.0)
    if not T > 0:
        return None
    end = min(T, 2 * float(model.t_end))
    try:
        run = simulate(model, t_end=end, step=end / 400)
    except StepError:
        return None
    half = (region.upper - region.lower) / 2
    return T, float(np.max((np.abs(run.x - (region.upper + region.lower) / 2) - half) / half))


@pytest.mark.parametrize("name", CLASSES)
def test_runs_of_random_models_do_not_leave_before(name):
    seeds = range(25 if COUNT == FULL else 1)
    known = [found for seed in seeds if (found := left_before(name, seed)) is not None]
    assert known or len(seeds) == 1
    assert all(beyond <= 1e-2 for _, beyond in known)  # a run is as near to the solution as its step
