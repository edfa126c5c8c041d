"""The judge of event-driven runs: closed forms to 40 digits, its own other orders, and whether it sees what is wrong."""

from decimal import Decimal, localcontext
from types import SimpleNamespace

import casadi as ca
import mpmath as mp
import numpy as np
import pytest

from nsmodel import LureSystem, relay, simulate
from nsmodel.codegen import library
from tests import event_digits as digits
from tests import event_models as models
from tests.event_roots import first_root
from tests.search.digits import CONTEXT
from tests.search.events import apart

x, l, t = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("t")
z = ca.SX.sym("z", 2)
CLOSE = 1e-40


def scene(states, rate, y, lower, upper, x0, multipliers=l, sides=None, fixed=None):
    rate, y = ca.vertcat(*rate), ca.vertcat(ca.SX(0, 1), *y)
    start = SimpleNamespace(x0=ca.DM(x0))
    lower, upper = np.array(lower, float), np.array(upper, float)
    fixed = rate if fixed is None else ca.vertcat(*fixed)
    return models.Scene(start, t, states, multipliers, rate, y, lower, upper, fixed, sides or models.Sides())


def friction():
    """x'' = -4x - sgn x': half periods about 1/4 and -1/4, until at rest within them."""

    def closed(s):
        left, side, at = s, 1, mp.mpf(1.3)
        while left > mp.pi / 2 and abs(at) > 0.25:
            left, at, side = left - mp.pi / 2, mp.mpf(side) / 2 - at, -side
        return [side / mp.mpf(4) + (at - side / mp.mpf(4)) * mp.cos(2 * left) if abs(at) > 0.25 else at]

    return scene(z, [z[1], -4 * z[0] + l], [z[1]], [-1], [1], [1.3, 0]), closed, 3


def release():
    """x' = 2t + l, l in -Sgn x."""
    return scene(x, [2 * t + l], [x], [-1], [1], [0]), lambda s: [max(s - 0.5, mp.mpf(0)) ** 2], 1


def play():
    """u - 1/2 <= q <= u + 1/2 with u = 2 sin t exp(-t/4): q is clipped between extremes."""
    rows, u = ca.SX.sym("l", 2), 2 * ca.sin(t) * ca.exp(-t / 4)

    def closed(s):
        v = lambda r: 2 * mp.sin(r) * mp.exp(-r / 4)  # noqa: E731
        q = mp.mpf(0)
        for end in [*(mp.atan(4) + k * mp.pi for k in range(9) if mp.atan(4) + k * mp.pi < s), s]:
            q = min(max(q, v(end) - 0.5), v(end) + 0.5)
        return [q]

    return scene(x, [rows[0] - rows[1]], [x - u + 0.5, u + 0.5 - x], [0, 0], [np.inf] * 2, [0], rows), closed, 4


def diode():
    """An oscillator v' = -i + l, i' = v; where v < 0 no current, else l = -v/2: arcs joined where v = 0."""

    def closed(s):
        w = mp.sqrt(mp.mpf(15)) / 4
        damped = lambda r: mp.exp(-r / 4) * (mp.cos(w * r) - mp.sin(w * r) / (4 * w))  # noqa: E731
        current = lambda r: mp.exp(-r / 4) * mp.sin(w * r) / w  # noqa: E731
        end = mp.findroot(damped, 1.9 / w / 1.4)
        return [damped(s), current(s)] if s < end else [-current(end) * mp.sin(s - end), current(end) * mp.cos(s - end)]

    return scene(z, [-z[1] - l, z[0]], [2 * l - z[0]], [0], [np.inf], [1, 0]), closed, 1


def exponential():
    """x' = -x - sgn x from 1: 0 at ln 2, and stays."""
    return scene(x, [-x + l], [x], [-1], [1], [1]), lambda s: [max(2 * mp.exp(-s) - 1, mp.mpf(0))], 1


def tangent():
    """x' = 1 + x^2, twice as fast after t = 1/2, by the side of a branch."""
    sides = models.Sides()
    factor = sides.chosen(0.5 - t, 1, 2)
    empty = ca.SX.sym("l", 0)
    own = scene(x, [1 + x**2], [], [], [], [0], empty, sides, [factor * (1 + x**2)])
    return own, lambda s: [mp.tan(s if s < 0.5 else 2 * s - 0.5)], 1


def jump():
    """From -1 beside a wall x >= 0 at once onto it, off it where t > 1."""
    own = scene(x, [t - 1 + l], [x], [0], [np.inf], [-1])
    return own, lambda s: [max(s - 1, mp.mpf(0)) ** 2 / 2], 1


@pytest.mark.parametrize(
    ("make", "end"), [(friction, 8), (release, 2), (play, 9), (diode, 4), (exponential, 3), (tangent, 1), (jump, 3)]
)
def test_closed_forms_to_40_digits(make, end):
    own, closed, events = make()
    found = digits.judged(own, end)
    assert len(found.events) == events
    for s in np.linspace(0, end, 33)[1:]:
        for have, want in zip(found.states(Decimal(float(s))), closed(mp.mpf(float(s))), strict=False):
            assert abs(mp.mpf(str(have)) - want) < CLOSE


@pytest.mark.parametrize("name", models.CLASSES)
def test_other_orders_agree_to_40_digits(name, monkeypatch):
    own = models.CLASSES[name](4)
    one = digits.judged(own, 1)
    monkeypatch.setattr(digits, "ORDER", 44)
    monkeypatch.setattr(digits, "NEAR", 1e-46)
    other = digits.judged(own, 1)
    assert len(other.pieces) != len(one.pieces)
    assert all(abs(a - b) < Decimal("1e-40") for a, b in zip(one.states(Decimal(1)), other.states(Decimal(1)), strict=True))
    assert [(e.before, e.after) for e in one.events] == [(e.before, e.after) for e in other.events]
    assert all(abs(a.t - b.t) < Decimal("1e-40") for a, b in zip(one.events, other.events, strict=True))


@pytest.mark.parametrize("depth", [1e-3, 1e-12, 0.0, -1e-12])
def test_the_first_of_two_roots_however_near(depth):
    """(s - 0.3)^2 - depth times a polynomial that is positive."""
    with localcontext(CONTEXT):
        d = Decimal(depth)
        dip = [Decimal("0.09") - d, Decimal("-0.6"), Decimal(1)]
        p = [sum((dip[i] * (k - i + 1) for i in range(3) if 0 <= k - i <= 5), Decimal(0)) for k in range(8)]
        found = first_root(p, Decimal(1))
        if depth < 0:
            assert found is None
        else:
            assert found is not None
            assert abs(found - (Decimal("0.3") - d.sqrt())) <= Decimal("1e-50" if depth else "1e-20")


# -- what is wrong is seen ----------------------------------------------------------------------------------------------


def test_the_mode_before_an_event_is_not_valid_after_it():
    for name, make in models.CLASSES.items():
        own = make(0)
        with localcontext(CONTEXT):
            found, modes = digits.judged(own, 2), digits.Modes(own)
            assert found.events, name
            for event in found.events:
                h = found.piece(event.t).h
                stays = modes.piece(event.before, event.t, found.states(event.t), digits.ORDER, h)
                assert stays is None or any(digits.germ(c, h) < 0 for c in stays.conditions)


def test_a_judge_that_asks_no_germ_is_wrong(monkeypatch):
    monkeypatch.setattr(digits, "germ", lambda series, h, zero=0: 0)
    for make, end in ((friction, 8), (release, 2)):
        own, closed, _ = make()
        found = digits.judged(own, end)
        assert abs(mp.mpf(str(found.states(Decimal(end))[0])) - closed(mp.mpf(end))[0]) > 1e-3


def test_two_solutions_are_not_judged():
    with pytest.raises(digits.NotJudged, match="more than one"):
        digits.judged(scene(x, [-l], [x], [-1], [1], [0]), 1)


def test_a_run_that_is_wrong_is_told():
    model = LureSystem(t=t, A=[[0, 1], [-4, 0]], B=[[0], [1]], C=[[0, 1]], law=relay(1), x0=[1.3, 0], t_end=8)
    rtol = 1e-8
    run = simulate(model, rtol=rtol, method="event-driven")

    def of(mu):
        own = scene(z, [z[1], -4 * z[0] + l], [z[1]], [-mu], [mu], [1.3, 0])
        return own, digits.judged(own, 8)

    own, right = of(1)
    assert max(apart(own, right, run, rtol).values()) < 0.1
    assert apart(*of(1 + 1e-6), run, rtol)["x"] > 1
    fewer = SimpleNamespace(t=run.t, at=run.at, events=run.events[:-1])
    assert apart(own, right, fewer, rtol)["events"] == 1
    late = SimpleNamespace(t=run.t, at=run.at, events=[event._replace(t=event.t + 1e-5) for event in run.events])
    assert apart(own, right, late, rtol)["times"] > 1
    turned = SimpleNamespace(t=run.t, at=run.at, events=[event._replace(after=-event.after) for event in run.events])
    assert apart(own, right, turned, rtol)["modes"] > 0
    pushed = SimpleNamespace(
        t=run.t, at=lambda s: run.at(s)._replace(multipliers=run.at(s).multipliers * 1.001), events=run.events
    )
    assert apart(own, right, pushed, rtol)["l"] > 1


@pytest.mark.parametrize("compiled", [False, True] if library.compiler() else [False])
def test_the_time_of_many_pieces_is_known_as_that_of_one(compiled):
    """x'' = -sgn x from (1, 0): 177 quarters of sqrt(2); times rounded one after the other would be off by 1.6e-12."""
    t_end = 354 * 2**0.5
    model = LureSystem(x0=[1, 0], t_end=t_end, step=0.01, law=relay(1), A=[[0, 1], [0, 0]], B=[0, 1], C=[1, 0])
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=compiled)
    assert np.abs(run.x[-1] - [-1, 0]).max() <= 3e-13
