"""States that rest and are moved from a known time on, by others and late: against closed forms, in C too, in any units."""

import math
import shutil

import casadi as ca
import numpy as np
import pytest
from scipy.special import gammainc

from nsmodel import FirstOrderSystem, LureSystem, relay, simulate

compilers = [
    False,
    pytest.param(True, marks=pytest.mark.skipif(not any(map(shutil.which, ("gcc", "cc", "clang"))), reason="no C compiler")),
]
START, END = 0.5, 4.0


def driven(of, n, units=None):
    """x' = of(push, x) from x = 0, push = 1 from START on, beside a relay; states in ``units``."""
    units = np.ones(n) if units is None else units
    x, l, t = ca.SX.sym("x", n + 1), ca.SX.sym("l"), ca.SX.sym("t")
    rate = [v / u for v, u in zip(of(ca.if_else(t < START, 0, 1), [x[i] * units[i] for i in range(n)]), units, strict=True)]
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=[*rate, 0.3 * ca.sin(t) - x[n]], g=[*[0] * n, l], h=[x[n]], law=relay(1), x0=[0] * (n + 1), t_end=END,
        switch_times=[START],
    )  # fmt: skip


def integrators(push, x):
    return [push, *x[:-1]]


def cascade(push, x):
    return [a - b for a, b in zip([push, *x[:-1]], x, strict=True)]


EXACT = {
    "integrators": (integrators, lambda i, t: t ** (i + 1) / math.factorial(i + 1)),
    "cascade": (cascade, lambda i, t: gammainc(i + 1, t)),
}


def chain(n, K, dry):
    """Masses on springs at rest, dry friction on each, the last one pushed from START on."""
    T, t = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1), ca.SX.sym("t")
    zero, one = np.zeros((n, n)), np.eye(n)
    f = ca.vertcat(ca.SX.zeros(2 * n - 1), ca.if_else(t < START, 0, 3 * ca.sin(7 * t)))
    A, B, C = np.block([[zero, one], [-K * T, zero]]), np.vstack([zero, dry * one]), np.hstack([zero, one])
    return LureSystem(t=t, A=A, B=B, C=C, f=f, law=relay(n), x0=[0] * 2 * n, t_end=2, step=1e-3, switch_times=[START])


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize(("name", "n"), [("integrators", 5), ("integrators", 12), ("cascade", 5), ("cascade", 20)])
def test_motion_that_begins_beyond_the_order(name, n, compiled):
    """Of n integrators the last one has an error up to 2^n times that of the first: rtol is asked of 12, not of 20."""
    of, exact = EXACT[name]
    at = np.linspace(0, END, 81)
    reference = np.array([exact(i, np.maximum(at - START, 0)) for i in range(n)]).T
    for rtol in (1e-2, 1e-5, 1e-8):
        run = simulate(driven(of, n), rtol=rtol, times=at, method="event-driven", compiled=compiled)
        assert (np.abs(run.x[:, :n] - reference) <= 10 * rtol * reference.max(axis=0)).all()


@pytest.mark.parametrize("compiled", compilers)
def test_units_of_states_at_rest_say_nothing(compiled):
    n = 12
    units = 2.0 ** np.random.default_rng(1).integers(-27, 28, n)
    one, other = (
        simulate(driven(cascade, n, u), rtol=1e-4, method="event-driven", compiled=compiled) for u in (np.ones(n), units)
    )
    assert np.allclose(one.piece_start, other.piece_start, rtol=1e-12, atol=0)
    assert np.allclose(one.x[:, :n], other.x[:, :n] * units, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("n", "K", "dry"), [(5, 1e2, 1.0), (20, 1e2, 0.001), (20, 1e4, 1.0)])
def test_a_chain_with_friction_that_is_pushed_at_its_end(n, K, dry):
    model, at = chain(n, K, dry), np.linspace(0, 2, 101)
    fine = simulate(model, rtol=1e-10, times=at, method="event-driven", compiled=False)
    largest = np.abs(fine.x).max(axis=0)
    for rtol in (1e-2, 1e-6):
        run = simulate(model, rtol=rtol, times=at, method="event-driven", compiled=False)
        assert len(run.events) == len(fine.events)
        assert (np.abs(run.x - fine.x) <= 10 * rtol * largest + 1e-15 * largest.max()).all()


def test_a_function_that_saturates_is_not_taken_for_a_motion_that_grows():
    """x_1 passes a threshold soon after it begins, and x_2 is at its end at once: the series of x_2 begins at order 9."""

    def threshold(push, x):
        return [push - x[0], x[0] ** 8 / (0.3**8 + x[0] ** 8) - x[1]]

    at = np.linspace(0, END, 81)
    fine = simulate(driven(threshold, 2), rtol=1e-11, times=at, method="event-driven", compiled=False)
    for rtol in (1e-2, 1e-4, 1e-8):
        run = simulate(driven(threshold, 2), rtol=rtol, times=at, method="event-driven", compiled=False)
        assert np.abs(run.x - fine.x).max() <= 10 * rtol


def filtered(rates, gain, damping, push):
    """Stiff filters that drive a mass on a spring with dry friction, from START on."""
    n, k, t = len(rates), rates[0], ca.SX.sym("t")
    A = np.zeros((n + 2, n + 2))
    A[:n, :n] = np.diag(rates[1:], -1) - np.diag(rates)
    A[n, n - 1 :] = [gain, -damping, -1]
    A[n + 1, n] = 1
    B, C = np.zeros((n + 2, 1)), np.eye(n + 2)[[n]]
    B[n] = 0.5
    f = ca.vertcat(k * ca.if_else(t < START, 0, ca.sin(push * t)), ca.SX.zeros(n + 1))
    return LureSystem(t=t, A=A, B=B, C=C, f=f, law=relay(1), x0=[0] * (n + 2), t_end=6, step=1e-3, switch_times=[START])


@pytest.mark.parametrize("compiled", compilers)
def test_what_sticks_behind_stiff_filters_hinders_no_long_piece(compiled):
    """Its state and position are of the size of rounding: the stages are right once their second iteration has mended that."""
    model, at = filtered(1e4 * np.arange(1, 5), 3, 0.1, 6), np.linspace(0, 6, 201)
    fine = simulate(model, rtol=1e-11, times=at, method="event-driven", compiled=False)
    for rtol in (1e-1, 1e-3, 1e-6):
        run = simulate(model, rtol=rtol, times=at, method="event-driven", compiled=compiled)
        assert len(run.events) == len(fine.events) == 12
        assert (np.abs(run.x - fine.x) <= rtol * np.abs(fine.x).max(axis=0)).all()
        assert len(run.piece_start) <= 200


def first_filter(k, push, t):
    """x' = k (sin(push t) - x) from x = 0 at START."""

    def steady(t):
        return k * (k * np.sin(push * t) - push * np.cos(push * t)) / (k**2 + push**2)

    return np.where(t < START, 0, steady(t) - steady(START) * np.exp(-k * np.maximum(t - START, 0)))


@pytest.mark.c
@pytest.mark.parametrize("seed", [None, *range(3)])
def test_rounding_of_what_sticks_is_no_error_of_a_fit(seed):
    """It is that of the filters by the inverse, many times the own of what is stuck; the inverse in C has another."""
    r = np.random.default_rng(seed)
    drawn = (1e4 * np.sort(r.uniform(1, 4, 4)), r.uniform(2, 4), r.uniform(0.05, 0.5), r.uniform(4, 8))
    rates, gain, damping, push = (1e4 * np.arange(1, 5), 3, 0.1, 6) if seed is None else drawn
    model, at, pieces = filtered(rates, gain, damping, push), np.linspace(0, 6, 201), []
    for compiled in (False, True):
        run = simulate(model, rtol=1e-9, times=at, method="event-driven", compiled=compiled)
        exact = first_filter(rates[0], push, at)
        assert np.abs(run.x[:, 0] - exact).max() <= 1e-8 * np.abs(exact).max()
        pieces.append(len(run.piece_start))
    assert max(pieces) <= 200
    assert abs(pieces[0] - pieces[1]) <= 0.05 * pieces[0]


def held_by_curved_rows(bend, seed):
    """x' = waves + a rotation of x + g l, two states and three rows bend(C x), each pushed along its gradient, from near 0."""
    r = np.random.default_rng(seed)
    x, l, t = ca.SX.sym("x", 2), ca.SX.sym("l", 3), ca.SX.sym("t")
    waves = sum(r.normal(size=2) * ca.sin(r.uniform(1, 4) * t + r.uniform(0, 6)) for _ in range(2))
    h, turn = bend(r.normal(size=(3, 2)) @ x), ca.DM([[0, 1], [-1, 0]])
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=waves + turn @ x, g=ca.jtimes(h, x, l, True), h=h, law=relay(3, [-10] * 3, [10] * 3),
        x0=0.1 * r.normal(size=2), t_end=12,
    )  # fmt: skip


BENDS = {"exp": lambda z: ca.exp(z) - 1, "atan": lambda z: z + ca.atan(z) / 2}


@pytest.mark.parametrize("compiled", compilers)
@pytest.mark.parametrize("bend", BENDS)
def test_curved_rows_beyond_the_states_that_they_hold_at_rest(bend, compiled):
    """The coefficients of x are rounding, or exactly 0: y is what their products are. No mode is to be refused for that."""
    model, at = held_by_curved_rows(BENDS[bend], 1), np.linspace(6, 12, 61)
    f = ca.Function("f", [model.t], [ca.substitute(model.f, model.x, 0)])
    g = ca.Function("g", [model.lam], [ca.substitute(model.g, model.x, 0)])
    for rtol in 10.0 ** -np.arange(2, 11):
        run = simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
        found = run.at(at)
        assert not run.index_set[-1].any()
        assert np.abs(found.x).max() <= 1e-13
        pushed, held = (np.array(of.map(at.size)(given)).T for of, given in ((f, at[None]), (g, found.multipliers.T)))
        assert np.abs(pushed + held).max() <= 10 * rtol * np.abs(pushed).max()
