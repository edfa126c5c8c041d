"""Event-driven integration: errors within rtol, no switch missed, and clear words where it does not apply."""

import itertools
import math
import shutil
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    StepError,
    SweepingProcess,
    UsageError,
    ball,
    complementarity,
    plot,
    product,
    relay,
    simulate,
)
from nsmodel.event_driven import modes
from nsmodel.event_driven.event_location import EventLocator
from nsmodel.event_driven.fallback_steps import HybridIntegrator
from nsmodel.hypotheses.region import region_of
from nsmodel.simulation import event_driven_rows
from nsmodel.simulation.options import Options
from nsmodel.simulation.simulate import make_run
from tests import event_scenes as scenes

DATA = Path(__file__).parents[3] / "shared" / "data" / "event_driven"
RTOLS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
MANY = COUNT
HAS_CC = any(map(shutil.which, ("gcc", "cc", "clang")))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the references are not here")


def judged(model, rtol, at, reference, events, compiled="auto"):
    """Assert that states err by at most 10 rtol of their largest values, and events by 10 rtol of the time."""
    run = simulate(model, rtol=rtol, times=at, method="event-driven", compiled=compiled)
    largest = np.abs(reference).max(axis=0)
    error = np.abs(run.x - reference) / np.where(largest > 0, largest, 1)
    assert error.max() <= 10 * rtol
    if events is not None:
        found = [event.t for event in run.events]
        assert len(found) == len(events)
        assert np.abs(np.array(found) - events).max(initial=0) <= 10 * rtol * at[-1]
    return run


@needs_data
@pytest.mark.parametrize("rtol", RTOLS)
@pytest.mark.parametrize(
    "name",
    [
        "friction_oscillator", "friction_oscillator_relay", "sliding_relay", "diode_bridge", "relay_oscillator", "gene_network",
        "point_past_disc",
    ],
)  # fmt: skip
def test_cases_against_113_bits(name, rtol):
    reference = np.load(DATA / f"{name}_ref.npz")
    model = nsmodel.load(name)
    judged(model, rtol, np.linspace(0, model.t_end, 241), reference["rows"][:, : len(model.names)], reference["events"])


@needs_data
@pytest.mark.skipif(not HAS_CC, reason="no C compiler")
@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-12])
def test_runs_in_c_against_113_bits(rtol):
    for name in ("friction_oscillator", "sliding_relay", "diode_bridge", "relay_oscillator", "gene_network", "point_past_disc"):
        reference, model = np.load(DATA / f"{name}_ref.npz"), nsmodel.load(name)
        at, states = np.linspace(0, model.t_end, 241), reference["rows"][:, : len(model.names)]
        run = judged(model, rtol, at, states, reference["events"], True)
        assert any("pieces in C" in line for line in run.metadata["used"])


@needs_data
@pytest.mark.parametrize("rtol", [1e-2, 1e-6, 1e-10])
def test_chain_pendulums_and_stiff_relay_against_113_bits(rtol):
    for name, model in (
        ("friction_chain_10", nsmodel.load("friction_chain")),
        ("pendulums", scenes.pendulums()),
        ("stiff_relay_3", scenes.stiff_relay(1e3)),
    ):
        reference = np.load(DATA / f"{name}_ref.npz")
        judged(model, rtol, np.linspace(0, model.t_end, 241), reference["rows"], reference["events"])


@needs_data
@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-6, 1e-8])
def test_mains_bridge(rtol):
    """The reference, good to 1e-11, has the switches of the current alone; the diodes' voltages switch besides."""
    reference, model = np.load(DATA / "mains_bridge_ref.npz"), scenes.mains_bridge()
    run = judged(model, rtol, np.linspace(0, model.t_end, 241), reference["rows"], None)
    found = np.array([event.t for event in run.events])
    assert all(np.abs(found - event).min() <= 10 * rtol * model.t_end for event in reference["events"])


@pytest.mark.parametrize("rtol", RTOLS)
def test_closed_forms(rtol):
    for model, exact, events in (*map(scenes.release, (0.77, 1.0, 1.3)), scenes.play(), scenes.diode()):
        at = np.linspace(0, model.t_end, 241)
        judged(model, rtol, at, exact(at), events)


def test_digits_of_closed_forms():
    """At rtol = 1e-13 errors are rounding."""
    for model, exact, _ in (scenes.release(0.77), scenes.play()):
        at = np.linspace(0, model.t_end, 241)
        assert np.abs(simulate(model, rtol=1e-13, times=at).x - exact(at)).max() <= 1e-13
    model = nsmodel.load("friction_oscillator")
    run = simulate(model, rtol=1e-13)
    assert np.abs(run.x - model.exact(run.t)).max() <= 1e-13 * 5.3
    np.testing.assert_allclose([event.t for event in run.events], np.pi * np.arange(1, 4), rtol=1e-14)


def test_simultaneous_switches():
    A, B, C = np.zeros((8, 8)), np.zeros((8, 4)), np.zeros((4, 8))
    for i in range(4):
        A[2 * i, 2 * i + 1], A[2 * i + 1, 2 * i], B[2 * i + 1, i], C[i, 2 * i + 1] = 1, -1, 1, 1
    model = LureSystem(A=A, B=B, C=C, law=relay(4), x0=[5.3, 0, 5.3, 0, 5.3, 0, 4.3, 0], t_end=12)
    run = simulate(model, rtol=1e-10, method="event-driven")
    np.testing.assert_allclose(run.x[-1, ::2], [0.7, 0.7, 0.7, 0.3], atol=1e-10)
    np.testing.assert_allclose([event.t for event in run.events], np.pi * np.arange(1, 4), rtol=1e-12)


@pytest.mark.parametrize("depth", [1e-10, 1e-13, 1e-15, 0.0, -1e-15, -1e-13, -1e-6])
def test_grazing(depth):
    """A touch no deeper than rounding changes nothing; one of 1e-10 is a contact, felt to its square root at most."""
    run = simulate(scenes.grazing(depth), rtol=1e-13, method="event-driven")
    assert np.abs(run.x[-1] - [math.sin(6), math.cos(6)]).max() <= (2e-12 if depth == 1e-10 else 2e-15)
    assert len(run.events) == (2 if depth == 1e-10 else 0)


@pytest.mark.parametrize("w", [3.3, 5.7, 9.1])
def test_brief_contacts_are_not_missed(w):
    rng, at, checked = np.random.default_rng(int(10 * w)), np.linspace(0, 20, 200_001), 0
    for _ in range(max(3, MANY // 10)):
        a, b, p, q = rng.uniform(0.5, 1), rng.uniform(0.2, 0.6), *rng.uniform(0, 2 * np.pi, 2)
        place, depth = a * np.cos(at + p) + b * np.cos(w * at + q), 10 ** rng.uniform(-5, -1)
        wall = place.max() - depth
        if place[0] > wall - 1e-3:
            continue
        start = [a * np.cos(p), -a * np.sin(p), b * np.cos(q), -w * b * np.sin(q), wall]
        first = at[np.argmax(place > wall)]
        for rtol in (1e-2, 1e-3, 1e-6, 1e-9):
            if depth >= 10 * rtol:
                run = simulate(scenes.brief_contact(w, start), rtol=rtol, method="event-driven")
                assert run.events
                assert abs(run.events[0].t - first) <= max(2e-4, 200 * rtol)
                checked += 1
    assert checked


def test_accumulation_and_many_switches():
    run = simulate(scenes.twisting(), rtol=1e-10, method="event-driven")
    end = (math.sqrt(2) + math.sqrt(2) / 3) / (1 - 1 / math.sqrt(3))
    assert abs(run.events[-1].t - end) <= 1e-5  # the last ones are below rounding of the state
    assert np.abs(run.x[-1]).max() <= 1e-12
    run = simulate(scenes.relay_of_degree_2(0, 1000), rtol=1e-13, method="event-driven")
    k = len(run.events)
    assert k == 354
    assert abs(run.events[-1].t - math.sqrt(2) * (2 * k - 1)) <= 1e-13 * 1000


def test_what_never_ends_is_told():
    """x'' + x' = -sgn x has exponentially many switches: alone it stops and keeps the rows."""
    with pytest.raises(StepError, match="accumulate"):
        simulate(scenes.relay_of_degree_2(1, 50), rtol=1e-4, method="event-driven")


def test_no_uniqueness():
    """x' in +Sgn x has three solutions from 0: refused, or one of them by time steps, with a warning."""
    model = LureSystem(A=[[0]], B=[[-1]], C=[[1]], law=relay(1), x0=[0], t_end=1, step=0.1)
    with pytest.raises(StepError, match="not unique"):
        simulate(model, rtol=1e-6, method="event-driven")
    run = simulate(model, rtol=1e-6)
    assert run.stepped[1:].all()
    assert any("not unique" in text for text in run.metadata["warnings"])


@pytest.mark.parametrize("compiled", [False, True])
def test_no_uniqueness_where_the_law_is_not_affine_in_its_multiplier(compiled):
    """x' = g(l) rises with l at 0 and at both ends, and yet is 0.3 at the lower and -0.3 at the upper: three solutions from 0."""
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    model = FirstOrderSystem(x=x, lam=l, f=[0 * x], g=[1.5 * l**5 - 2 * l**3 + 0.2 * l], h=[x], law=relay(1), x0=[0], t_end=1)
    with pytest.raises(StepError, match="not unique"):
        simulate(model, rtol=1e-6, method="event-driven", compiled=compiled)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(
    ("g", "free"),
    [
        ([2, 2, 0, -1], 2.0),  # Newton's method for g(l) = 0 goes from 0 to -1 and back: it misses l = 1.769.
        ([0.25, 3.75, 0, -2.67], 0.25),  # It finds l = -0.067, which is outside of the law, and misses l = 1.217.
    ],
)
def test_a_mode_whose_l_newton_misses_is_not_decided(g, free, compiled):
    """x' = g(l), x >= 0, l >= 0: x = g(0) t, and x = 0 at a root of g: two solutions, of which the modes do not agree."""
    assert any(root.imag == 0 and root.real > 0 for root in np.roots(g[::-1]))
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    terms = [sum(c * l**k for k, c in enumerate(g))]
    model = FirstOrderSystem(x=x, lam=l, f=[0 * x], g=terms, h=[x], law=complementarity(1), x0=[0], t_end=1)
    run = simulate(model, rtol=1e-6, method="event-driven", compiled=compiled)
    np.testing.assert_allclose(run.x[-1], free, rtol=1e-9)
    assert run.metadata["totals"]["unique"] == {"not decided": 1}


@pytest.mark.parametrize("compiled", [False, True])
def test_modes_of_a_bilinear_model_are_proved_unique_where_their_rows_are_not_coupled(compiled):
    """Genes, of which l1 and l4, l2 and l3 are coupled: at (8, 8) l3 and l4 are held, which are not; at first all are open."""
    run = simulate(nsmodel.load("gene_network"), rtol=1e-6, method="event-driven", compiled=compiled)
    assert run.metadata["totals"]["unique"] == {"proved": 2, "all valid modes agree": 2}


@pytest.mark.parametrize("compiled", [False, True])
def test_no_mode_is_proved_unique_where_d_moves_and_is_nothing(compiled):
    """y = x1 + x2 l, x2 = -2t: l = 0 with x1 = t, and l = 1 with x1 = 2t, although C g_l = 1."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    model = FirstOrderSystem(
        x=x, lam=l, f=[1, -2], g=[l, 0], h=[x[0] + x[1] * l], law=complementarity(1), x0=[0, 0], t_end=1
    )  # fmt: skip
    run = simulate(model, rtol=1e-6, method="event-driven", compiled=compiled)
    assert "proved" not in run.metadata["totals"]["unique"]


def test_jump_at_the_start():
    """From the jump on the digits of a run that starts after it; x+ by hand: C and C_f share the charge."""
    model = scenes.capacitor_filter()
    run = simulate(model, rtol=1e-10, method="event-driven")
    shared = 10 * 1e-6 / (1e-6 + 3e-7)
    after = run.at(0.0)
    np.testing.assert_allclose(after.x[0], [shared, 0, shared], rtol=1e-14)
    np.testing.assert_allclose(run.events[0].x_before, [10, 0, 0])
    np.testing.assert_allclose(np.array(ca.DM(model.B)) @ run.events[0].impulse, after.x[0] - [10, 0, 0], atol=1e-14)
    fine = simulate(model, step=1e-7)
    assert np.abs(run.x[-1] - fine.x[-1]).max() <= 0.02 * np.abs(run.x).max()


def test_known_discontinuities_of_time_and_branches():
    """f with fmod, fabs, fmax and if_else: switches of what is not analytic, against arcs joined by hand."""
    x, time = ca.SX.sym("x"), scenes.t
    saw = simulate(FirstOrderSystem(t=time, x=x, f=[ca.fmod(time, 0.3)], x0=[0], t_end=2), rtol=1e-10, method="event-driven")
    assert abs(saw.x[-1, 0] - (6 * 0.045 + 0.2**2 / 2)) <= 1e-10
    steps = simulate(
        FirstOrderSystem(t=time, x=x, f=[ca.if_else(time < 0.7, 1, -ca.fabs(x) + ca.fmax(time, 1))], x0=[0], t_end=1), rtol=1e-10
    )
    # from 0.7 on x' = 1 - x: x = 1 - 0.3 exp(-(t - 0.7))
    assert abs(steps.x[-1, 0] - (1 - 0.3 * math.exp(-0.3))) <= 1e-10


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("rest", "end"), [(0.5, 1.0), (1.0, 2 / 3), (2.0, 2 / 3)])
def test_a_row_that_the_multiplier_of_another_makes_jump(rest, end, compiled):
    """A relay turns at t = 1/3 and y_1 falls by 2 with it: below 0, onto 0, or not as far; l_1 holds it at 0 from then on."""
    x, l = ca.SX.sym("x"), ca.SX.sym("l", 2)
    model = FirstOrderSystem(
        x=x, lam=l, f=[2], g=[l[0] + l[1]], h=[x, rest + l[0] + l[1]], law=product(relay(1), complementarity(1)), x0=[-1], t_end=1
    )
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=compiled)
    assert abs(run.x[-1, 0] - end) <= 1e-8
    assert (run.at(np.linspace(0.34, 1, 20)).y[:, 1] >= -1e-12).all()


def test_a_wrong_mode_is_told_by_the_residual(monkeypatch):
    """The same where closed rows are not asked: y_1 = -1/2 from 1/3 on, and the run says so."""
    asked = modes._violated_conditions

    def of_open(system, place, how):
        return (one for one in asked(system, place, how) if one.of in place.open or one.acts == "l")

    x, l = ca.SX.sym("x"), ca.SX.sym("l", 2)
    model = FirstOrderSystem(
        x=x, lam=l, f=[2], g=[l[0] + l[1]], h=[x, 0.5 + l[0] + l[1]], law=product(relay(1), complementarity(1)), x0=[-1], t_end=1
    )
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=False)
    assert not [text for text in run.metadata["warnings"] if "the law is missed" in text]
    monkeypatch.setattr(modes, "_violated_conditions", of_open)
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=False)
    assert abs(run.x[-1, 0] - 1) <= 1e-8, "a row that is wrong ends its piece at once"
    first = EventLocator.first
    monkeypatch.setattr(EventLocator, "first", lambda *given: found if (found := first(*given))[1] else (None, given[4]))
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=False)
    assert abs(run.x[-1, 0] - 2 / 3) <= 1e-8
    assert any("the law is missed by 0.2" in text and "the run is no solution there" in text for text in run.metadata["warnings"])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("rtol", [1e-2, 1e-6])
def test_rows_at_edges_have_the_values_before_them(rtol, compiled):
    """A diode behind a switch whose edges are rows: on the one side of each it blocks, on the other it leads."""
    run = simulate(nsmodel.load("boost"), rtol=rtol, method="event-driven", compiled=compiled)
    assert run.metadata["totals"]["worst_residual"] <= 1e-12
    held = np.nan_to_num(run.arrays["y"])[run.arrays["index_set"] == 0]
    assert np.abs(held).max() <= 1e-12 * 20


def test_mass_matrix_and_redundant_rows():
    """M full; two rows that say the same: l is the least, and their sum what one row has."""
    x, l, time = ca.SX.sym("x", 2), ca.SX.sym("l", 2), scenes.t
    M = np.array([[2.0, 0.5], [0.5, 1.0]])
    twice = FirstOrderSystem(
        t=time, x=x, lam=l, M=M, f=[3 * ca.sin(time), -x[1]], g=[l[0] + l[1], 0], h=[x[0], x[0]], law=relay(2), x0=[1, 1], t_end=6
    )
    once = FirstOrderSystem(
        t=time, x=x, lam=l[0], M=M, f=[3 * ca.sin(time), -x[1]], g=[l[0], 0], h=[x[0]], law=relay(1, -2, 2), x0=[1, 1], t_end=6
    )
    at = np.linspace(0, 6, 61)
    a, b = (simulate(model, rtol=1e-9, times=at, method="event-driven") for model in (twice, once))
    np.testing.assert_allclose(a.x, b.x, atol=1e-8)
    np.testing.assert_allclose(a.multipliers.sum(axis=1)[1:], b.multipliers[1:, 0], atol=1e-7)


@pytest.mark.parametrize("power", [2, 3, 4])
def test_rows_that_part_at_a_higher_order(power):
    """y = (x_0, x_0 + a x_1^power): at x = 0 nothing tells them apart, but x_1 moves: x_0 = 0 by l = (7/10, -1)."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    for a, compiled in itertools.product((1, 1e-12), (False, True)):
        h = ca.vertcat(x[0], x[0] + a * x[1] ** power)
        model = FirstOrderSystem(
            t=scenes.t, x=x, lam=l, f=[0.3, 1], g=ca.jtimes(h, x, l, True), h=h, law=relay(2), x0=[0, 0], t_end=1
        )
        run = simulate(model, rtol=1e-8, method="event-driven", compiled=compiled)
        assert (run.index_set[1:] == [0, -1]).all()
        np.testing.assert_allclose(run.multipliers[1:], np.tile([0.7, -1], (len(run.t) - 1, 1)), atol=1e-12)
        assert np.abs(run.x[:, 0]).max() <= 1e-15


# -- random models against time stepping -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(max(4, MANY // 8)))
def test_random_lure_systems(seed):
    """Passive Lur'e systems (B = C', D psd): the event-driven state is the limit of time stepping's."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    S, K = rng.normal(size=(n, n)), rng.normal(size=(n, n))
    A, C = K - K.T - 0.1 * S @ S.T, rng.normal(size=(m, n))
    E = rng.normal(size=(m, m))
    D = (np.zeros((m, m)), E @ E.T + 0.1 * np.eye(m), E @ E.T + E - E.T + 0.1 * np.eye(m))[seed % 3]
    law = relay(m) if seed % 2 or not D.any() else complementarity(m)
    drive = rng.normal(size=(n, 2)) @ ca.vertcat(ca.sin(1.7 * scenes.t), ca.cos(0.6 * scenes.t))
    model = LureSystem(t=scenes.t, A=A, B=C.T, C=C, D=D, f=drive, law=law, x0=rng.normal(size=n), t_end=4)
    run = simulate(model, rtol=1e-9, method="event-driven")
    coarse, fine = (simulate(model, step=h) for h in (2e-3, 1e-3))
    size, apart = np.abs(run.x).max(), np.abs(coarse.x[-1] - fine.x[-1]).max()
    assert np.abs(fine.x[-1] - run.x[-1]).max() <= 3 * apart + 1e-6 * size


# -- what a user sees ---------------------------------------------------------------------------------------------------


def test_rows_dense_output_and_files(tmp_path):
    model = nsmodel.load("diode_bridge")
    run = simulate(model, rtol=1e-8)
    assert run.is_event_driven
    assert (np.diff(run.t) > 0).all()
    assert run.t[-1] == model.t_end
    inside = np.linspace(0, model.t_end, 500)
    np.testing.assert_array_equal(run.at(run.t[1:-1]).x.shape, (len(run) - 1, 2))
    run.save(tmp_path / "run.npz")
    again = nsmodel.Trajectory.load(tmp_path / "run.npz")
    for one, other in zip(run.at(inside), again.at(inside), strict=True):
        np.testing.assert_array_equal(one, other)
    rows = simulate(model, rtol=1e-8, times=inside)
    np.testing.assert_array_equal(rows.t, inside)
    np.testing.assert_allclose(rows.x[1:], run.at(inside[1:]).x, rtol=0, atol=1e-12)
    third = simulate(model, rtol=1e-8, save_every=3)
    np.testing.assert_array_equal(third.t, run.t[np.unique([*range(0, len(run.t), 3), len(run.t) - 1])])
    run.to_csv(tmp_path / "run.csv")
    assert "piece" not in (tmp_path / "run.csv").read_text().splitlines()[0]


def test_runs_in_memory_are_not_in_chunks(monkeypatch):
    model = nsmodel.load("relay_oscillator")
    whole = simulate(model, rtol=1e-6, method="event-driven", compiled=False)
    monkeypatch.setattr(event_driven_rows, "CHUNK_BYTES", 1)
    walk = make_run(model, Options(rtol=1e-6, method="event-driven", compiled=False)).propagator
    for _ in range(100):
        walk.advance(64, [])
    assert walk.finished
    assert walk.record.filled == len(whole.t)


@pytest.mark.parametrize("compiled", [False, True])
def test_chunks_without_rows(tmp_path, monkeypatch, compiled):
    model = nsmodel.load("relay_oscillator")
    given = {"rtol": 1e-6, "method": "event-driven", "compiled": compiled, "times": [0.9 * model.t_end, model.t_end]}
    whole = simulate(model, **given)
    monkeypatch.setattr(event_driven_rows, "CHUNK_BYTES", 1)
    run = simulate(model, out=tmp_path / "run", **given)
    for name, array in whole.arrays.items():
        np.testing.assert_array_equal(array, run.arrays[name], err_msg=name)


def test_what_fails_between_rows_says_how_many_there_are(monkeypatch):
    made = []

    def advance(self):
        made.append(self)
        if len(made) > 20:
            raise MemoryError("Unable to allocate 1 TiB")
        return usual(self)

    usual = HybridIntegrator.advance
    monkeypatch.setattr(HybridIntegrator, "advance", advance)
    model = nsmodel.load("relay_oscillator")
    with pytest.raises(StepError, match=r"^step \d+: no verified step .* not enough memory") as caught:
        simulate(model, rtol=1e-6, method="event-driven", compiled=False)
    assert caught.value.step == len(caught.value.trajectory) == caught.value.trajectory.metadata["totals"]["pieces"] > 0


def test_events_tell_both_sides():
    run = simulate(nsmodel.load("point_past_disc"), rtol=1e-8)
    touch, leave = run.events
    assert (touch.before[0], touch.after[0], leave.before[0], leave.after[0]) == (-1, 0, 0, -1)
    assert run.t[touch.row] == touch.t
    assert touch.multipliers_before[0] == 0 < touch.multipliers_after[0]
    assert abs(touch.y_after[0]) <= 1e-15
    total = run.multipliers[1:, 0].sum()
    reaction = run.at(np.linspace(0, 4.5, 100_001)).multipliers[:, 0]
    assert abs(total - np.trapezoid(reaction, dx=4.5 / 100_000)) <= 1e-4


def test_pieces_do_not_depend_on_the_end():
    model = nsmodel.load("relay_oscillator")
    long, short = simulate(model, rtol=1e-6), simulate(model, rtol=1e-6, t_end=0.37 * model.t_end)
    k = len(short.arrays["piece_start"])
    for name in ("piece_start", "piece_unit", "piece_x"):
        np.testing.assert_array_equal(short.arrays[name], long.arrays[name][:k])
    assert short.t[-1] == 0.37 * model.t_end


def test_time_stepping_has_values_between_rows_but_no_events():
    run = simulate(nsmodel.load("friction_oscillator"), step=0.1)
    np.testing.assert_allclose(run.at(0.25).x[0], (run.x[2] + run.x[3]) / 2)
    np.testing.assert_array_equal(run.at(run.t).x, run.x)
    with pytest.raises(UsageError, match="rtol"):
        _ = run.events


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rtol": 1e-15}, "between 1e-14 and 1"),
        ({"rtol": "small"}, "rtol"),
        ({"rtol": 1e-6, "method": "events"}, "'events'; expected one of auto, event-driven, time-stepping"),
        ({"method": "event-driven"}, "needs rtol"),
        ({"rtol": 1e-6, "times": [0.2, 0.1]}, r"times\[1\] = 0.1 is not after times\[0\] = 0.2"),
        ({"rtol": 1e-6, "times": [0.0, 13.0]}, r"times\[1\] = 13 is outside the run, from 0 to t_end = 12"),
        ({"rtol": 1e-6, "times": ["soon"]}, "times: expected a list"),
        ({"times": [0.0, 1.0]}, "give rtol"),
        ({"rtol": 1e-6, "step": 1e-3}, "step and rtol"),
        ({"rtol": 1e-6, "steps": [1e-3]}, "steps and rtol"),
        ({"rtol": 1e-6, "solver": "lemke"}, "solver 'lemke' and rtol"),
        ({"rtol": 1e-6, "atol": [1, 2, 3]}, "atol"),
    ],
)
def test_wrong_options(options, words):
    with pytest.raises(UsageError, match=words):
        simulate(nsmodel.load("friction_oscillator"), **options)


def test_what_it_cannot_take():
    disc = LureSystem(A=-np.eye(2), B=np.eye(2), C=np.eye(2), D=np.eye(2), law=ball(2), x0=[1, 1], t_end=1, step=0.1)
    with pytest.raises(UsageError, match="'ball': its y depends on l directly"):
        simulate(disc, rtol=1e-6, method="event-driven")
    run = simulate(disc, rtol=1e-4)
    assert not run.is_event_driven
    assert any("event-driven" in line and "ball" in line for line in run.metadata["left_out"])
    x = ca.SX.sym("x", 2)
    singular = FirstOrderSystem(x=x, f=[-x[0], x[1] - 1], M=[[1, 0], [0, 0]], x0=[1, 1], t_end=1, step=0.1)
    with pytest.raises(UsageError, match="M is singular"):
        simulate(singular, rtol=1e-6, method="event-driven")
    with pytest.raises(UsageError, match="the run goes from"):
        simulate(nsmodel.load("friction_oscillator"), rtol=1e-3).at(13)


def test_pictures_and_the_box_of_check_see_the_polynomials():
    """x = sin: pieces end where they like, lines and the box reach the maxima."""
    x = ca.SX.sym("x", 2)
    model = FirstOrderSystem(x=x, f=[x[1], -x[0]], x0=[0, 1], t_end=6.5)
    run = simulate(model, rtol=1e-9)
    assert np.abs(run.x[:, 0]).max() < 0.9995
    (line,) = (line for line in plot.states(run, ["x_0"]).lines if len(line.get_xdata()) > 2)
    assert np.abs(line.get_ydata()).max() > 0.99999
    np.testing.assert_allclose(line.get_ydata(), np.sin(line.get_xdata()), atol=1e-7)
    assert f"piece {run.step[1:].min():.3g} to {run.step[1:].max():.3g}" in plot.overview(run).get_supxlabel()
    low, high = (np.array(ends) for ends in (region_of(model, [run]).lower, region_of(model, [run]).upper))
    assert np.minimum(high, -low).min() >= 1.24


@pytest.mark.parametrize("rtol", [10.0**-k for k in np.arange(2, 12, 0.37)])
def test_release_from_a_wall_that_is_no_polynomial(rtol):
    """Held rows drift by what the series leaves; the release is where l ends on the wall itself, at every rtol."""
    model = nsmodel.load("moving_half_line")
    run = simulate(model, rtol=rtol, method="event-driven")
    assert [event.t for event in run.events] == pytest.approx([3 * math.pi / 4], abs=1e-13)
    assert np.abs(run.at(t := np.linspace(0, 3, 500)).x - model.exact(t)).max() <= 10 * rtol


def test_a_start_at_zero_against_a_wall_in_other_units():
    """All states and sizes are 0 at the start; rows are 1e-7 of the states: q_0 and q_1 stay together and share the push."""
    q = ca.SX.sym("q", 2)
    model = SweepingProcess(
        t=scenes.t, q=q, f=[-1, 3 + ca.sin(scenes.t)], constraints={"g": 1e-7 * (q[0] - q[1])}, q0=[0, 0], t_end=1
    )
    run = simulate(model, rtol=1e-8, method="event-driven")
    np.testing.assert_allclose(run.x[-1], (2 + 1 - math.cos(1)) / 2, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("compiled", [True, False])
def test_masses_that_move_only_as_far_as_rounding(compiled):
    """Springs between equal masses pull nothing at the start, but rounding leaves a rest; steps in time know no such thing."""
    model = nsmodel.load("friction_chain", n=50)
    run = simulate(model, rtol=1e-6, t_end=0.2, method="event-driven", compiled=compiled)
    steps = simulate(model, step=1e-4, t_end=0.2, compiled=True)
    assert len(run.t) < 100
    assert np.abs(run.x[-1] - steps.x[-1]).max() < 1e-6
