"""What lies between the points of a piece is bounded: pulses, powers, flat conditions, poles; and the bound itself, on discs."""

import cmath
import math
import random

import casadi as ca
import mpmath as mp
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, StepError, SweepingProcess, relay, signal, simulate
from nsmodel.codegen import library
from nsmodel.event_driven.collocation import max_error_ratio
from nsmodel.event_driven.disc_arithmetic import DiscBall, DiscEvaluator, TaylorForm
from nsmodel.event_driven.recurrence_code import TaylorExpansion
from nsmodel.event_driven.recurrences import taylor_decompose
from tests.search import hidden

t, x, l, s, q = (ca.SX.sym(name) for name in "txlsq")
X = ca.SX.sym("x", 2)
compilers = [False, pytest.param(True, marks=pytest.mark.skipif(library.compiler() is None, reason="no C compiler"))]
FUNCTIONS = {  # Of t, and what it is of a complex number.
    "exp": (ca.exp(t), mp.exp),
    "sin": (ca.sin(3 * t), lambda z: mp.sin(3 * z)),
    "cos": (ca.cos(t * t), lambda z: mp.cos(z * z)),
    "tan": (ca.tan(t), mp.tan),
    "tanh": (ca.tanh(5 * t), lambda z: mp.tanh(5 * z)),
    "sqrt": (ca.sqrt(2 + t), lambda z: mp.sqrt(2 + z)),
    "log": (ca.log(1.5 + t), lambda z: mp.log(1.5 + z)),
    "log1p": (ca.log1p(t), lambda z: mp.log(1 + z)),
    "expm1": (ca.expm1(t), lambda z: mp.exp(z) - 1),
    "atan": (ca.atan(2 * t), lambda z: mp.atan(2 * z)),
    "asin": (ca.asin(t), mp.asin),
    "acos": (ca.acos(t), mp.acos),
    "asinh": (ca.asinh(2 * t), lambda z: mp.asinh(2 * z)),
    "acosh": (ca.acosh(2 + t), lambda z: mp.acosh(2 + z)),
    "atanh": (ca.atanh(t), mp.atanh),
    "erf": (ca.erf(t), mp.erf),
    "power": ((1.5 + t) ** 1.7, lambda z: (1.5 + z) ** 1.7),
    "negative power": ((1.5 + t) ** -2.3, lambda z: (1.5 + z) ** -2.3),
    "logistic": (1 / (1 + ca.exp(30 * t)), lambda z: 1 / (1 + mp.exp(30 * z))),
    "atan2": (ca.atan2(t, 1 + t * t), lambda z: mp.atan(z / (1 + z * z))),
    "hypot": (ca.hypot(t, 1), lambda z: mp.sqrt(z * z + 1)),
    "polynomial": (t**3 - 2 * t + 1, lambda z: z**3 - 2 * z + 1),
    "power of powers": ((1.2 + t) ** t, lambda z: (1.2 + z) ** z),
    "hyperbolic": (ca.sinh(t) * ca.cosh(2 * t), lambda z: mp.sinh(z) * mp.cosh(2 * z)),
    "pulse": (ca.exp(-(((t - 0.3) / 0.3) ** 2)), lambda z: mp.exp(-(((z - 0.3) / 0.3) ** 2))),
    "branch": (ca.fabs(t + 2), lambda z: z + 2),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_value_on_a_disc_is_outside_the_bound(name):
    """Random points of random discs, in 15 digits beyond doubles; most discs that hold no singularity have a finite bound."""
    expression, exact = FUNCTIONS[name]
    rng, degree, finite = random.Random(name), 8, 0
    jets = taylor_decompose(expression, [t], "f")
    on = DiscEvaluator(jets, [1.0] * len(jets.branches))
    for _ in range(40):
        centre, radius = rng.uniform(-0.8, 0.8), 10 ** rng.uniform(-3, -0.2)
        (ball,), _ = on({(0, 0): DiscBall(centre, radius)})
        (form,), _ = on({(0, 0): TaylorForm(np.array([centre, radius, *[0.0] * (degree - 1)]))})
        finite += ball.r < math.inf and form.r < math.inf
        for _ in range(10):
            w = math.sqrt(rng.random()) * cmath.exp(2j * math.pi * rng.random())
            value = complex(exact(mp.mpc(centre + radius * w)))
            assert abs(value - ball.c) <= ball.r * (1 + 1e-9) + 1e-12
            assert abs(value - np.polyval(form.c[::-1], w)) <= form.r * (1 + 1e-9) + 1e-12
    assert finite >= 20


def test_balls_of_exp_do_not_overflow_where_its_values_do_not():
    """exp(-1e16 +- 1e15) is 0, and exp(-800 +- 750) is at most exp(-50)."""
    jets = taylor_decompose(ca.exp(t), [t], "f")
    for centre, radius in ((-1e16, 1e15), (-800.0, 750.0)):
        (ball,), _ = DiscEvaluator(jets, [])({(0, 0): DiscBall(centre, radius)})
        assert math.exp(centre + radius) <= ball.r <= 1.001 * math.exp(centre + radius)


def at_end(model, rtol, compiled, **options):
    return simulate(model, rtol=rtol, compiled=compiled, method="event-driven", **options)


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize("k", [9, 12, 49])
def test_powers_of_time_from_rest(k, compiled):
    """x' = (k + 1) t^k from 0: a motion that begins beyond the order of the series."""
    model = FirstOrderSystem(t=t, x=x, f=[(k + 1) * t**k], x0=[0], t_end=1.5, step=1e-2)
    for rtol in (1e-2, 1e-5, 1e-9):
        run = at_end(model, rtol, compiled)
        assert run.x[-1, 0] == pytest.approx(1.5 ** (k + 1), rel=10 * rtol)


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize("width", [1e-1, 1e-3])
def test_a_pulse_on_a_state_at_rest(width, compiled):
    """x' = a pulse, of Gauss and of a Lorentz curve: their integrals, at t of no round number."""
    u = (t - 5.437) / width
    for pulse, exact in (
        (ca.exp(-(u**2)), width * math.sqrt(math.pi)),
        (1 / (1 + u**2) ** 2, width * (math.pi / 2) - 2 * width**4 / 3 * (5.437**-3 + 6.563**-3) / 2),
    ):
        model = FirstOrderSystem(t=t, x=x, f=[pulse], x0=[0], t_end=12.0, step=1e-2)
        for rtol in (1e-3, 1e-8):
            assert at_end(model, rtol, compiled).x[-1, 0] == pytest.approx(exact, rel=20 * rtol)


@pytest.mark.parametrize("compiled", compilers)
def test_a_pulse_on_a_relay_at_rest(compiled):
    """5 exp(-((t - 5)/.3)^2) - Sgn x: it leaves 0 where the pulse is 1, and comes back: two events."""
    model = LureSystem(
        t=t, A=[[0]], B=[1], C=[1], f=[5 * ca.exp(-(((t - 5) / 0.3) ** 2))], law=relay(1), x0=[0], t_end=10, step=1e-2,
    )  # fmt: skip
    leaves = 5 - 0.3 * math.sqrt(math.log(5))
    for rtol in (1e-2, 1e-4, 1e-6, 1e-8, 1e-10):
        run = at_end(model, rtol, compiled)
        assert len(run.events) == 2
        assert run.events[0].t == pytest.approx(leaves, abs=10 * rtol)


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize("power", [3, 20, 60])
def test_a_condition_that_moves_beyond_the_order(power, compiled):
    """(t/5)^p - 1 under a relay: it switches at 5, x(8) = -5 + 3 as the multiplier is -1, then 1."""
    model = FirstOrderSystem(
        t=t, x=x, lam=l, f=[0], g=[l], h=[(t / 5) ** power - 1], law=relay(1), x0=[0], t_end=8, step=1e-2
    )  # fmt: skip
    for rtol in (1e-2, 1e-5, 1e-8):
        run = at_end(model, rtol, compiled)
        assert [event.t for event in run.events] == [pytest.approx(5, abs=50 * rtol)]
        assert abs(run.x[-1, 0]) == pytest.approx(2, abs=50 * rtol)


@pytest.mark.parametrize("compiled", compilers)
def test_a_hill_in_the_way(compiled):
    """A mass on its way through a potential hill: its energy is kept, and it comes late."""
    hill = 6.667 * (X[0] - 5) * ca.exp(-(((X[0] - 5) / 0.3) ** 2))
    model = FirstOrderSystem(x=X, f=[X[1], hill], x0=[0, 1], t_end=12, step=1e-2)
    for rtol in (1e-3, 1e-8):
        assert at_end(model, rtol, compiled).x[-1, 0] == pytest.approx(11.750191, abs=max(100 * rtol, 2e-6))


@pytest.mark.parametrize("compiled", compilers)
def test_a_wall_that_pulses_pushes(compiled):
    """q >= the pulse, from 0: q ends at its top."""
    wall = q - 1 / (1 + ((t - 6.3) / 0.05) ** 2) ** 4
    model = SweepingProcess(t=t, q=q, constraints={"wall": wall}, q0=[0.0], t_end=10, step=1e-2)
    for rtol in (1e-3, 1e-7):
        assert at_end(model, rtol, compiled).x[-1, 0] == pytest.approx(1, abs=20 * rtol)


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize(("f", "x0", "where"), [(ca.tan(t), 0, math.pi / 2), (x * x, 1, 1.0), (1 / (1.3 - t), 0, 1.3)])
def test_a_run_stops_at_a_pole_and_says_so(f, x0, where, compiled):
    model = FirstOrderSystem(t=t, x=x, f=[f], x0=[x0], t_end=2, step=1e-2)
    with pytest.raises(
        StepError, match=r"t = \d.*x' = .*grows without bound: f has a pole, or another singularity, near here"
    ) as stop:
        simulate(model, rtol=1e-4, compiled=compiled)
    assert stop.value.trajectory.t[-1] == pytest.approx(where, abs=1e-3)


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize("rtol", [1e-1, 1e-2])
@pytest.mark.parametrize("f", [-1 - 1e-6 / x, -1 - 1e-9 / x**2, -1 - 1e-8 / ca.sqrt(x)])
def test_a_singularity_in_a_state_that_is_nothing_beside_its_size_ends_the_run(f, rtol, compiled):
    """Collocation goes back from it, as from all that is unstable, within what x may err by: the run is not to go on for ever."""
    model = FirstOrderSystem(t=t, x=x, f=[f], x0=[1], t_end=3, step=1e-2)
    with pytest.raises(StepError, match=r"f has a pole|not analytic here: a division by 0|no Taylor series") as stop:
        simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
    assert stop.value.trajectory.t[-1] == pytest.approx(1, abs=2e-3)


def test_no_word_of_rows_where_a_model_has_none():
    model = FirstOrderSystem(t=t, x=x, f=[ca.sqrt(t - 1)], x0=[0], t_end=2, step=1e-2)
    with pytest.raises(StepError) as stop:
        at_end(model, 1e-6, False)
    assert "row" not in str(stop.value)


@pytest.mark.parametrize("seed", range(12))
def test_a_random_run_made_to_hide_something_is_not_silently_wrong(seed):
    """`tests.search.hidden` tries more of them."""
    assert hidden.trial(seed)["verdict"] != hidden.WRONG


@pytest.mark.parametrize("compiled", compilers)
def test_rounding_of_f_at_rest_is_no_motion(compiled):
    """1 + tanh is 0 to rounding at first, and x is exactly 0 there."""
    model = FirstOrderSystem(t=t, x=x, f=[1 + ca.tanh(100 * (t - 5))], x0=[0], t_end=10, step=1e-2)
    for rtol in (1e-3, 1e-8):
        assert at_end(model, rtol, compiled).x[-1, 0] == pytest.approx(10, rel=10 * rtol)


@pytest.mark.parametrize("compiled", compilers)
def test_a_pulse_on_a_stiff_state(compiled):
    """x' = -1e4 (x - a pulse), y' = x: the integral of x is that of the pulse, and 1e-4 of the start."""
    f = [-1e4 * (X[0] - ca.exp(-(((t - 5.437) / 0.01) ** 2))), X[0]]
    model = FirstOrderSystem(t=t, x=X, f=f, x0=[1, 0], t_end=10, step=1e-2)
    for rtol in (1e-3, 1e-6, 1e-9):
        run = at_end(model, rtol, compiled)
        assert run.x[-1, 1] == pytest.approx(0.01 * math.sqrt(math.pi) + 1e-4, rel=10 * rtol)
        assert run.metadata["totals"]["collocated"] > 0


@pytest.mark.parametrize("compiled", compilers)
def test_the_cut_of_atan2_is_a_switch(compiled):
    """The angle of a state that turns jumps from pi to -pi; small angles are as exact as they are."""
    state = ca.SX.sym("x", 3)
    f = [state[1], -state[0], ca.atan2(state[0], state[1])]
    model = FirstOrderSystem(t=t, x=state, f=f, x0=[0, 1, 0], t_end=10, step=1e-2)
    beyond = 10 - 2 * math.pi
    exact = math.pi**2 / 2 + (beyond**2 - math.pi**2) / 2 - 2 * math.pi * (beyond - math.pi)
    for rtol in (1e-3, 1e-8, 1e-10):
        run = at_end(model, rtol, compiled)
        assert run.x[-1, 2] == pytest.approx(exact, abs=30 * rtol)
        assert [event.t for event in run.events] == [pytest.approx(k * math.pi / 2, abs=10 * rtol) for k in range(1, 7)]


def test_atan2_on_all_sides():
    """Order 0 and the first derivative, in each quadrant and on the axes."""
    of_b = ca.SX.sym("b")
    jets = taylor_decompose(ca.atan2(t, of_b), [t, of_b], "f")
    for a, b in [(1, 2), (1, -2), (-1, 2), (-1, -2), (0, 1), (0, -1), (1, 0), (-1, 0), (1e-300, 1), (-1e-300, -1)]:
        expansion = TaylorExpansion(jets, 2)
        for (which, _), row in jets.inputs.items():
            expansion.rows[row][:2] = [(a, b)[which], (1.0, 0.0)[which]]
        expansion.compute(0)
        expansion.compute(1)
        value, rate = (expansion.rows[jets.outputs[0]][k] for k in (0, 1))
        assert value == math.atan2(a, b)
        assert rate == pytest.approx(b / (a * a + b * b))


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize(
    ("f", "exact"),
    [
        (ca.sqrt(t), 2 / 3 * 3**1.5), (t**1.5, 0.4 * 3**2.5), (ca.log(t), 3 * math.log(3) - 3), (t**-0.5, 2 * 3**0.5),
        ((t * t) ** 0.25, 2 / 3 * 3**1.5), (t - ca.sqrt(x), 2.25), (1 / t, None), (ca.sqrt(x), None),
    ],
)  # fmt: skip
def test_a_start_at_a_branch_point(f, exact, compiled):
    """Without a series the first piece is a straight line, so short that it is nothing; not at a pole, or where x may stay."""
    for rtol in (1e-3, 1e-8, 1e-12):
        model = FirstOrderSystem(t=t, x=x, f=[f], x0=[0], t_end=3, step=1e-2)
        if exact is None:
            with pytest.raises(StepError, match=r"t = 0: (f|the solution may)"):
                at_end(model, rtol, compiled)
            continue
        run = at_end(model, rtol, compiled)
        assert run.x[-1, 0] == pytest.approx(exact, rel=rtol)
        assert run.at(0).x[0, 0] == pytest.approx(0, abs=1e-15)
        assert not run.events
        assert not run.metadata["warnings"]


@pytest.mark.parametrize("compiled", compilers)
def test_a_start_at_a_branch_point_under_friction(compiled):
    """x' = 2 sqrt t - Sgn x leaves 0 at t = 1/4."""
    model = FirstOrderSystem(t=t, x=x, lam=l, f=[2 * ca.sqrt(t)], g=[l], h=[x], law=relay(1), x0=[0], t_end=3, step=1e-2)
    for rtol in (1e-3, 1e-8):
        run = at_end(model, rtol, compiled)
        assert [event.t for event in run.events] == pytest.approx([0.25])
        assert run.x[-1, 0] == pytest.approx(4 / 3 * (3**1.5 - 0.125) - 2.75, rel=rtol)


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize(
    ("f", "at_1"),
    [
        (-ca.sign(x) * ca.sqrt(ca.fabs(x)), 0.25),
        (-ca.sqrt(ca.fmax(x, 0)), 0.25),
        (-2 * ca.sign(x) * ca.fabs(x) ** 0.75, 0.0625),
    ],
)
def test_a_tank_runs_empty_and_stays_so(f, at_1, compiled):
    """Torricelli: x' = -sqrt x comes to 0 at t = 2, where it has no series."""
    model = FirstOrderSystem(x=x, f=[f], x0=[1], t_end=5, step=1e-2)
    for rtol in (1e-2, 1e-3, 1e-4, 1e-8):
        run = at_end(model, rtol, compiled)
        assert run.x[-1, 0] == 0
        assert run.at(1).x[0, 0] == pytest.approx(at_1, rel=10 * rtol)
        assert not run.metadata["warnings"]


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize(
    ("f", "end", "exact"),
    [
        (ca.asin(ca.sin(t)), 5, (2 * math.pi - 5) ** 2 / 2),
        (ca.acos(ca.fmin(t - 1, 1)), 4, math.pi),
        (ca.log((t - 1) ** 2), 3, 4 * math.log(2) - 6),
        (ca.sqrt(ca.fabs(t - 1.3)), 3, 2 / 3 * (1.7**1.5 + 1.3**1.5)),
    ],
)
def test_points_without_a_series_are_passed(f, end, exact, compiled):
    for rtol in (1e-3, 1e-8, 1e-11):
        run = at_end(FirstOrderSystem(t=t, x=x, f=[f], x0=[0], t_end=end, step=1e-2), rtol, compiled)
        assert run.x[-1, 0] == pytest.approx(exact, rel=rtol)
        assert not run.metadata["warnings"]


@pytest.mark.parametrize("compiled", compilers)
def test_a_line_passes_no_edge_and_no_change_of_l(compiled):
    """Near t = pi/2, where asin(sin t) has no series: an edge of an input, and friction that just gives way."""
    edge, F = math.pi / 2 + 1e-8, math.pi / 2 - 1e-7
    of_u = signal(ca.if_else(t >= edge, 1.0, 0), edges=[edge])
    driven = FirstOrderSystem(t=t, x=x, f=[ca.asin(ca.sin(t)) + s], inputs={s: of_u}, x0=[0], t_end=3, step=1e-2)
    slips = FirstOrderSystem(t=t, x=x, lam=l, f=[ca.asin(ca.sin(t))], g=[F * l], h=[x], law=relay(1), x0=[0], t_end=2, step=1e-2)
    for model, exact in ((driven, math.pi**2 / 4 - (math.pi - 3) ** 2 / 2 + 3 - edge), (slips, 0)):
        for rtol in (1e-3, 1e-10):
            words = ""
            try:
                run = at_end(model, rtol, compiled)
            except StepError as error:
                words = str(error)
            assert "pole" not in words
            assert words or run.x[-1, 0] == pytest.approx(exact, rel=rtol, abs=1e-12)


@pytest.mark.parametrize("compiled", compilers)
def test_a_state_that_rests_while_a_force_is_next_to_none(compiled):
    """What rounding leaves of a velocity that is held to 0 moves the position by no more than that."""
    force = [15.5 * ca.exp(-(((t - 4.24) / 0.166) ** 2))]
    model = FrictionOscillator(t=t, x=x, potential=0 * x, friction=s, s=s, force=force, x0=[0], t_end=4, step=1e-2)
    run = simulate(model, rtol=5e-3, method="event-driven", compiled=compiled)
    assert run.x[-1, 0] >= 0
    assert len(run) < 200


@pytest.mark.parametrize("kind", hidden.KINDS)
def test_a_run_of_each_kind_that_hides_something_is_not_silently_wrong(kind):
    assert hidden.trial(3, kind)["verdict"] != hidden.WRONG


def test_what_is_no_number_is_no_small_error():
    """A NaN among errors that are rounding."""
    assert max_error_ratio(np.array([-1.0, math.nan]), np.ones(2)) == math.inf
    assert max_error_ratio(np.array([-1.0, 0.5]), np.ones(2)) == 0.5
