"""Events at roots of high order, in clusters and in shallow dips are known to rounding, or it is told that they are not."""

from __future__ import annotations

import math

import casadi as ca
import pytest

from nsmodel import FirstOrderSystem, LureSystem, SweepingProcess, relay, simulate
from nsmodel.codegen import library
from nsmodel.event_driven.event_location import MAX_MULTIPLICITY
from nsmodel.event_driven.recurrences import independent_branches, taylor_decompose

t, x, l, q = (ca.SX.sym(name) for name in "txlq")
X = ca.SX.sym("x", 2)
compilers = [False, pytest.param(True, marks=pytest.mark.skipif(library.compiler() is None, reason="no C compiler"))]
ways = pytest.mark.parametrize("compiled", compilers, ids=lambda one: "in C" if one else "interpreted")


def each(name, values, in_c):
    """All of the values interpreted, some of them in C."""
    compiler = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
    given = [(value, False) for value in values] + [pytest.param(value, True, marks=compiler) for value in in_c]
    return pytest.mark.parametrize((name, "compiled"), given)


def run_of(h, rtol, compiled, t_end=3.0, f=0, **more):
    """x' = f + l, -h in the normal cone of [-1, 1] at l."""
    model = FirstOrderSystem(t=t, x=x, lam=l, f=[f], g=[l], h=[h], law=relay(1), x0=[0], t_end=t_end, step=1e-2)
    return simulate(model, rtol=rtol, method="event-driven", compiled=compiled, **more)


def times(run):
    return [event.t for event in run.events]


def told(run):
    return [line for line in run.metadata["warnings"] if "is not known" in line]


@each("k", [3, 5, 7, 9, 11], [5, 9])
def test_roots_of_high_order_are_known_to_rounding(k, compiled):
    for rtol in (1e-3, 1e-6, 1e-10):
        run = run_of((t - 1) ** k, rtol, compiled)
        assert times(run) == pytest.approx([1.0], abs=1e-15)
        assert run.x[-1, 0] == pytest.approx(-1.0, abs=1e-14)
        assert run.events[0].width <= 2e-14
        assert not told(run)


@each("k", [2, 4, 6], [4])
def test_a_touch_is_no_event(k, compiled):
    run = run_of((t - 1) ** k, 1e-10, compiled)
    assert times(run) == []
    assert run.x[-1, 0] == pytest.approx(-3.0, abs=1e-14)


@each("d", [1e-10, 1e-12, 1e-13, 1e-14, 1e-15, 1e-16], [1e-16])
def test_shallow_dips_are_seen(d, compiled):
    half, run = math.sqrt(d), run_of((t - 1) ** 2 - d, 1e-8, compiled)
    assert times(run) == pytest.approx([1 - half, 1 + half], abs=1e-15)
    assert run.x[-1, 0] == pytest.approx(4 * half - 3, abs=1e-14)
    above = run_of((t - 1) ** 2 + d, 1e-8, compiled)
    assert times(above) == []


@each("d", [1e-6, 1e-10, 1e-12, 1e-14], [1e-12])
def test_dips_of_a_wave_are_seen_or_told(d, compiled):
    """1 - d - sin t is rounding of 1 where it dips: its roots are known to eps/sqrt(2 d)."""
    half, run = math.acos(1 - d), run_of(1 - d - ca.sin(t), 1e-8, compiled)
    exact = 2 * math.asin(math.sqrt(d / 2))
    assert half == pytest.approx(exact, rel=1e-2)
    assert times(run) == pytest.approx([math.pi / 2 - exact, math.pi / 2 + exact], abs=4e-16 / math.sqrt(2 * d))
    assert bool(told(run)) == (d < 1e-13)


@ways
def test_what_rounding_hides_is_told(compiled):
    """(t - 1)^7 multiplied out is known to 1e-16: its root to 1e-16^(1/7)."""
    h, powers = 0, [-1, 7, -21, 35, -35, 21, -7, 1]
    for a in reversed(powers):
        h = h * t + a
    run = run_of(h, 1e-8, compiled)
    assert times(run) == pytest.approx([1.0], abs=0.03)
    assert len(told(run)) == 1
    assert "when it switches" in told(run)[0]
    assert abs(run.events[0].t - 1) <= run.events[0].width <= 0.1
    assert run.events[0].width == pytest.approx(run.metadata["totals"]["undecided"]["width"])
    deep = run_of(1 - 1e-17 - ca.sin(t), 1e-8, compiled)
    assert times(deep) == []
    assert "switches twice" in told(deep)[0]


def test_no_certificate_where_an_event_is_not_known():
    h, powers = 0, [-1, 7, -21, 35, -35, 21, -7, 1]
    for a in reversed(powers):
        h = h * t + a
    for y, proved in ((h, False), ((t - 1) ** 7, True)):
        about = run_of(y, 1e-8, False, certify="interval").metadata["certificate"]
        assert (about["proved"] == about["pieces"]) == proved
        assert proved or "'l' switches" in about["failures"][0]


@ways
def test_where_states_are_known_to_rtol_so_is_the_event(compiled):
    """x_0 = (t - 1)^3 by integration: a root is known to rtol^(1/3)."""
    model = FirstOrderSystem(
        t=t, x=X, lam=l, f=[3 * (t - 1) ** 2, 0], g=[0, l], h=[X[0]], law=relay(1), x0=[-1, 0], t_end=3, step=1e-2
    )
    run = simulate(model, rtol=1e-6, method="event-driven", compiled=compiled)
    assert times(run) == pytest.approx([1.0], abs=2e-2)
    assert len(told(run)) == 1
    assert abs(run.events[0].t - 1) <= run.events[0].width <= 2 * (10 * 1e-6) ** (1 / 3)
    simple = FirstOrderSystem(t=t, x=X, lam=l, f=[1, 0], g=[0, l], h=[X[0]], law=relay(1), x0=[-1, 0], t_end=3, step=1e-2)
    clear = simulate(simple, rtol=1e-6, method="event-driven", compiled=compiled)
    assert not told(clear)
    assert clear.events[0].width == 0


@each("near", [1e-2, 1e-4, 1e-6], [1e-4])
def test_clusters_of_roots(near, compiled):
    roots = [1.3, 1.3 + near, 1.3 + 1.7 * near]
    run = run_of((t - roots[0]) * (t - roots[1]) * (t - roots[2]), 1e-9, compiled)
    assert times(run) == pytest.approx(roots, abs=1e-14)


@ways
def test_a_dip_of_one_row_does_not_hide_the_event_of_another(compiled):
    """Rows 0 comes near to 0 at t = 1 for long; row 1 crosses in the middle of that."""
    both = ca.SX.sym("l", 2)
    h = [(t - 1) ** 4 + 1e-13, t - 1.001]
    model = FirstOrderSystem(t=t, x=X, lam=both, f=[0, 0], g=[both[0], both[1]], h=h, law=relay(2), x0=[0, 0], t_end=2, step=1e-2)
    run = simulate(model, rtol=1e-6, method="event-driven", compiled=compiled)
    assert times(run) == pytest.approx([1.001], abs=1e-12)
    assert run.x[-1] == pytest.approx([-2, 1.001 - 0.999], abs=1e-9)


@each("centre", [2.0, 2.1, 2.9, 3.0], [2.1])
def test_edges_of_a_smooth_pulse(centre, compiled):
    """exp(1 - 1/(1 - u^2)) is flat at u = -1 and 1, and has no series there."""
    v = 1 - (t - centre) ** 2
    model = FirstOrderSystem(t=t, x=x, f=[ca.if_else(v > 0, ca.exp(1 - 1 / v), 0)], x0=[0], t_end=6, step=1e-2)
    for rtol in (1e-4, 1e-8):
        run = simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
        assert run.x[-1, 0] == pytest.approx(1.2069003224378755, rel=rtol)
        assert times(run) == pytest.approx([centre - 1, centre + 1], abs=1e-12)


@each("compact", [True, False], [True])
def test_a_smooth_hill_in_space_is_passed(compact, compiled):
    """s' = 1, x' = a pulse of s: its edges are where a state is, known to rounding."""
    v = 1 - ((X[0] - 2.3) / 0.7) ** 2
    f = ca.if_else(v > 0, ca.exp(1 - 1 / v), 0) if compact else ca.exp(-(((X[0] - 2.3) / 0.7) ** 2))
    model = FirstOrderSystem(x=X, f=[1, f], x0=[0.1, 0], t_end=4, step=1e-2)
    exact = 0.7 * (1.2069003224378755 if compact else math.sqrt(math.pi) / 2 * (math.erf(1.8 / 0.7) + math.erf(2.2 / 0.7)))
    for rtol in (1e-4, 1e-8):
        run = simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
        assert run.x[-1, 1] == pytest.approx(exact, rel=rtol)


@ways
def test_a_wall_that_is_just_touched(compiled):
    """q >= w(t), w'' = -1 at its top, which q rests on: q does not leave when w has a root of order 4 on top."""
    wall = q + (t - 1) ** 4
    model = SweepingProcess(t=t, q=q, constraints={"wall": wall}, q0=[-1], t_end=2, step=1e-2)
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=compiled)
    assert run.x[-1, 0] == pytest.approx(0, abs=1e-8)


@ways
def test_an_impact_is_not_run_through(compiled):
    """A row on which no l acts at once and whose l has one end does not change its side."""
    from nsmodel import StepError, complementarity

    model = LureSystem(A=[[0, 1], [0, 0]], B=[0, 1], C=[[1, 0]], f=[0, -1], law=complementarity(1), x0=[1, 0], t_end=3, step=1e-2)
    with pytest.raises(StepError, match="no mode"):
        simulate(model, rtol=1e-6, method="event-driven", compiled=compiled)


@pytest.mark.fast
def test_which_switches_nothing_else_moves():
    lam = ca.SX.sym("lam")
    f = ca.vertcat(ca.floor(2 * ca.fmod(t, 1)), ca.fabs(x), ca.fabs(x + lam))
    jets = taylor_decompose(f, [t, x, lam], "f")
    assert sum(independent_branches(jets)) == 2
    assert len(jets.branches) == 4
    assert MAX_MULTIPLICITY % 2 == 0
