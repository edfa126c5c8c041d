"""Switches that other switches make jump, and switches of what the state does not follow: against sums over fine grids."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, LureSystem, complementarity, relay, simulate
from nsmodel.codegen.library import compiler

t, x, l = (ca.SX.sym(name) for name in "txl")
WAYS = [False, pytest.param(True, marks=pytest.mark.skipif(compiler() is None, reason="no C compiler"))]
pytestmark = pytest.mark.usefixtures("own_cache")


def integrated(rate, t_end, compiled, rtol=1e-8):
    """x(t_end) of x' = rate(t), x(0) = 0."""
    model = FirstOrderSystem(t=t, x=x, f=[rate], x0=[0], t_end=t_end, step=0.01)
    return simulate(model, rtol=rtol, method="event-driven", compiled=compiled).x[-1, 0]


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize(
    ("rate", "right"),
    [
        (ca.if_else(ca.fmod(t, 1) < 0.3, 1, 0), 6),
        (ca.if_else(t - ca.floor(t) < 0.3, 1, 0), 6),
        (ca.if_else(ca.fmod(t, 1) > 0.7, 1, 0), 6),
        (ca.fabs(ca.fmod(t, 1) - 0.3), 20 * (0.3**2 + 0.7**2) / 2),
        (ca.floor(2 * ca.fmod(t, 1)), 10),
        (ca.if_else(ca.sin(2 * ca.pi * t) > 0, 1, 0), 10),
        (ca.if_else(ca.sign(ca.sin(2 * ca.pi * t)) + 0.5 > 0, 1, 0), 10),
        (ca.if_else(ca.fabs(ca.sign(ca.sin(2 * ca.pi * t)) - 0.2) > 1, 1, 0), 10),
    ],
    ids=str,
)
def test_a_rate_that_time_switches(rate, right, compiled):
    assert integrated(rate, 20, compiled) == pytest.approx(right, abs=1e-6)


def nested(rng, depth):
    """A random expression of t of waves, fractions, signs and comparisons in each other."""
    a, b = rng.uniform(0.4, 2.5), rng.uniform(-1, 1)
    if depth == 0:
        return (ca.sin(3 * a * t + b), ca.fmod(a * t + 1 + b, 1) - 0.5, a * t / 6 - 0.5, ca.cos(a * t) * ca.sin(t))[
            rng.integers(4)
        ]
    one, other = nested(rng, depth - 1), nested(rng, depth - 1)
    made = (
        lambda: ca.if_else(one > b / 2, other, -one),
        lambda: ca.sign(one) + 0.7 * other,
        lambda: ca.fabs(one - b / 2) - 0.4,
        lambda: ca.fmax(one, other),
        lambda: ca.floor(2 * one) / 2 + 0.3 * other,
        lambda: ca.fmod(one + 3, 0.8) - 0.4,
    )
    return made[rng.integers(len(made))]()


@pytest.mark.parametrize("seed", range(200))
def test_random_switches_in_each_other(seed):
    rate = nested(np.random.default_rng(seed), 1 + seed % 3)
    cells = 400_000
    middles = (np.arange(cells) + 0.5) * 6 / cells
    values = np.array(ca.Function("rate", [t], [rate]).map(cells)(middles[None])).ravel()
    assert integrated(rate, 6, False, 1e-6) == pytest.approx(values.mean() * 6, abs=2e-3 * max(np.abs(values).max(), 1e-3))


@pytest.mark.parametrize("compiled", WAYS)
def test_rows_of_a_law_that_a_jump_of_time_moves(compiled):
    step = FirstOrderSystem(
        t=t, x=x, lam=l, f=[0 * x], g=[l], h=[x - ca.floor(t)], law=complementarity(1), x0=[0], t_end=2.5, step=0.01
    )
    run = simulate(step, rtol=1e-8, method="event-driven", compiled=compiled)
    np.testing.assert_allclose(run.at([0.5, 1.5, 2.4]).x[:, 0], [0, 1, 2], atol=1e-12)
    saw = LureSystem(t=t, A=[[-1]], B=[1], C=[1], law=relay(1), e=[-ca.fmod(t, 1)], x0=[0], t_end=2.5, step=1e-4)
    assert simulate(saw, rtol=1e-8, method="event-driven", compiled=compiled).x[-1] == pytest.approx(
        simulate(saw).x[-1], abs=1e-4
    )


LEVELS = (0.5, 1.25)


def comparisons(x):
    """{name: (rate of x, rates below, between and above the levels)}: comparisons of what comparisons choose."""
    one, two = (ca.if_else(x > level, 1, 0) for level in LEVELS)
    return {
        "equal": (ca.if_else(one == 1, 2, 1), (1, 2, 2)),
        "truth": (ca.if_else(one, 2, 1), (1, 2, 2)),
        "sum": (ca.if_else(one + two == 1, 3, 1), (1, 3, 1)),
        "not": (ca.if_else(ca.logic_not(one == 0), 0.5, 2), (2, 0.5, 0.5)),
        "and": (ca.if_else(ca.logic_and(one == 1, two == 0), 4, 1), (1, 4, 1)),
        "product": (1 + ca.if_else((2 * one - 1) * (2 * two - 1) > 0, 0, 2), (1, 3, 1)),
        "nested twice": (ca.if_else(ca.if_else(one == 1, 1, 0) + two == 2, 0.25, 1), (1, 1, 0.25)),
    }


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("name", comparisons(ca.SX.sym("x")))
def test_comparisons_of_comparisons(name, compiled):
    x, end = ca.SX.sym("x"), 2.0
    rate, rates = comparisons(x)[name]
    model = FirstOrderSystem(x=x, f=[rate], x0=[0.0], t_end=end, step=0.1)
    run = simulate(model, rtol=1e-9, method="event-driven", compiled=compiled)
    t, at = 0.0, 0.0
    for level, own in zip((*LEVELS, math.inf), rates, strict=True):
        moved = min((level - at) / own, end - t)
        t, at = t + moved, at + own * moved
    assert run.x[-1, 0] == pytest.approx(at, abs=1e-9)
    assert len(run.events) <= 3
