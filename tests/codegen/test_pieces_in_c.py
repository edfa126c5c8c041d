"""Event-driven integration in C beside the integrator, piece by piece, and beside references; the library that users compile."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from conftest import optimised

import nsmodel
from nsmodel import FirstOrderSystem, LureSystem, SweepingProcess, codegen, complementarity, relay, simulate
from nsmodel.codegen.event_driven_spec import piece_spec_of
from nsmodel.errors import CodegenError
from nsmodel.simulation.event_driven import EventDrivenPropagator, event_driven_problem
from nsmodel.simulation.options import Options
from tests import event_scenes as scenes
from tests import stiff_scenes
from tests.event_driven.test_events_resume import files

CC = next((name for name in ("gcc", "cc", "clang") if shutil.which(name)), None)
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wno-unused-function")
SANITIZED = ("-g", optimised("-O1"), "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def case(name):
    return nsmodel.load(name)


def switches():
    """Operations that are not analytic, in f and in h, and a table's edge."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("l")
    f = [x[1], -ca.fabs(x[0]) + ca.if_else(t < 1.5, 1, -0.5) + 0.1 * ca.fmax(x[0], x[1]) - 0.2 * ca.floor(2 * x[0])]
    h = x[1] - 0.1 * ca.sin(t)
    return FirstOrderSystem(t=t, x=x, lam=l, f=f, g=[0, 0.3 * l], h=[h], law=relay(1), x0=[0.7, -0.2], t_end=4)


def edges():
    """Known times, two of them edges, one just after a touch that the first piece does not have."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("l")
    f = [x[1], -4 * x[0] + ca.if_else(t < 1, 0, ca.if_else(t < 2.5, 3, -1))]
    h, times = x[1] - ca.fmod(t, 2.5) / 5, [0.3, 1, 2.5, 2.5 + 1e-9, 3.7]
    return FirstOrderSystem(t=t, x=x, lam=l, f=f, g=[0, l], h=[h], law=relay(1), x0=[1, 0], t_end=5, switch_times=times)


def functions():
    """A recurrence of every kind."""
    t, x = ca.SX.sym("t"), ca.SX.sym("x", 3)
    f = [
        ca.exp(-x[0]) * ca.tanh(x[1]) + ca.sqrt(2 + x[2]) / (1 + x[0] ** 2), ca.log(3 + x[1]) - ca.atan(x[0] * t) + ca.erf(x[2]),
        ca.atan2(x[0], 2 + x[1]) - (1.5 + x[2]) ** 0.7 + ca.sinh(0.1 * x[0]) * ca.cos(2 * t),
    ]  # fmt: skip
    return FirstOrderSystem(t=t, x=x, f=f, x0=[0.3, 0.1, -0.2], t_end=2)


def nonlinear():
    """A law that is not linear in l."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    return FirstOrderSystem(
        x=x, lam=l, f=[x[1], -x[0]], g=[0, -l - 0.1 * l**3], h=[0.8 - x[0] + 0.05 * l + 0.01 * l**3], law=complementarity(1),
        x0=[0, 1], t_end=6,
    )  # fmt: skip


MODELS = {
    **{
        name: (lambda name=name: case(name))
        for name in (
            "friction_oscillator", "friction_oscillator_relay", "sliding_relay", "diode_bridge", "relay_oscillator",
            "gene_network", "point_past_disc", "two_discs", "two_masses", "inclusion_8_1", "inclusion_8_2", "moving_disc",
        )
    },
    "release": lambda: scenes.release(1.3)[0], "play": lambda: scenes.play()[0], "diode": lambda: scenes.diode()[0],
    "mains": scenes.mains_bridge, "pendulums": scenes.pendulums, "twisting": scenes.twisting, "filter": scenes.capacitor_filter,
    "stiff": lambda: scenes.stiff_relay(1e2), "degree 2": lambda: scenes.relay_of_degree_2(0, 100),
    "grazing": lambda: scenes.grazing(1e-6), "switches": switches, "edges": edges, "functions": functions, "nonlinear": nonlinear,
}  # fmt: skip


def circle():
    """A point that is drawn along a wall that is round: stiff, index 2, h_x turns."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    f = 1e4 * (2 * ca.vertcat(ca.cos(t), ca.sin(t)) - q)
    return SweepingProcess(t=t, q=q, f=f, constraints={"disc": 1 - ca.sumsqr(q)}, q0=[1, 0], t_end=5)


def corners():
    """A stiff decay to what has kinks in t and x."""
    t, x = ca.SX.sym("t"), ca.SX.sym("x", 2)
    f = [-1e4 * (x[0] - ca.fabs(ca.sin(t))), ca.fmax(x[0], 0.5) - x[1]]
    return FirstOrderSystem(t=t, x=x, f=f, x0=[0.1, 0.2], t_end=10)


STIFF = {
    "relay 1e3": lambda: scenes.stiff_relay(1e3), "circle": circle, "corners": corners, "kinetics": stiff_scenes.kinetics,
    "van der Pol": stiff_scenes.van_der_pol, "rectifier": lambda: stiff_scenes.rectifier(1e-6)[0],
    "chain": lambda: stiff_scenes.damped_chain(1e3)[0],
    **{f"Lur'e {seed}": (lambda seed=seed: stiff_scenes.stiff_lure(seed, 4.0 + seed % 3)[0]) for seed in range(7)},
}  # fmt: skip


def both(model, rtol, **more):
    return (simulate(model, rtol=rtol, method="event-driven", compiled=compiled, **more) for compiled in (False, True))


@pytest.mark.parametrize("name", MODELS)
def test_c_makes_the_pieces_of_the_integrator(name):
    """The same pieces, modes and notes; numbers to what rounding at an event becomes."""
    model = MODELS[name]()
    end = min(model.t_end, 5.0) if name == "twisting" else None
    for rtol in (1e-4, 1e-8):
        python, c = both(model, rtol, t_end=end)
        assert any("pieces in C" in line for line in c.metadata["used"])
        assert not c.metadata["warnings"] or c.metadata["warnings"] == python.metadata["warnings"]
        np.testing.assert_array_equal(c.arrays["piece_codes"], python.arrays["piece_codes"])
        np.testing.assert_array_equal(c.arrays["piece_event"], python.arrays["piece_event"])
        for key in ("unique", "touches", "redundant", "events", "pieces", "collocated"):
            assert c.metadata["totals"][key] == python.metadata["totals"][key]
        size, at_events = np.abs(python.x).max(axis=0), python.arrays["piece_event"] != 0
        starts = np.abs(c.arrays["piece_start"] - python.arrays["piece_start"])
        assert starts[at_events].max(initial=0.0) <= 1e-11 * model.t_end
        if name == "stiff":  # How long its pieces are is decided by coefficients of what has decayed to rounding.
            c, python = (run.at(np.linspace(0, python.t[-1], 101)) for run in (c, python))
        assert (np.abs(c.x - python.x) <= 1e-10 * np.maximum(size, 1e-6 * size.max())).all()
        assert np.abs(c.t - python.t).max() <= 1e-11 * model.t_end
        for part in ("multipliers", "y"):
            a, b = (getattr(run, part)[1:] for run in (c, python))
            assert (np.abs(a - b) <= 1e-7 * np.abs(b).max(axis=0) + 1e-13 * size.max()).all()


@pytest.mark.parametrize("name", STIFF)
def test_stiff_modes_go_the_same_way(name):
    """Pieces by collocation at the same places and of the same modes: held rows and free ones, branches, slopes that move."""
    python, c = both(STIFF[name](), 1e-4)
    for key in ("events", "pieces", "collocated", "touches", "redundant"):
        assert c.metadata["totals"][key] == python.metadata["totals"][key]
    assert c.metadata["totals"]["collocated"] >= 10
    for key in ("piece_codes", "piece_event"):
        np.testing.assert_array_equal(c.arrays[key], python.arrays[key])
    end, size = python.arrays["t"][-1], np.abs(python.x).max(axis=0)
    assert np.abs(c.arrays["piece_start"] - python.arrays["piece_start"]).max() <= 1e-8 * end
    at = np.linspace(0, end, 101)
    assert (np.abs(c.at(at).x - python.at(at).x) <= 1e-10 * size).all()


def test_a_stiff_mode_that_rounding_decides_is_within_rtol():
    """Of a relay through an actuator of 1e5 1/s the fast part decays to rounding, or to 0: that says how long its pieces are."""
    for rtol in (1e-4, 1e-8):
        python, c = both(scenes.stiff_relay(1e5), rtol)
        assert c.metadata["totals"]["events"] == python.metadata["totals"]["events"]
        assert c.metadata["totals"]["collocated"] >= 40
        assert c.metadata["totals"]["pieces"] <= 240
        at = np.linspace(0, 20, 101)
        size = np.abs(python.x).max(axis=0)
        assert (np.abs(c.at(at).x - python.at(at).x) <= rtol * size).all()


@pytest.mark.parametrize("seed", range(12))
def test_random_systems_go_the_same_way(seed):
    """Lur'e systems with D of any rank: index 1, 2 and mixed."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    G = rng.standard_normal((n, m))
    half = rng.standard_normal((m, int(rng.integers(0, m + 1))))
    skew = rng.standard_normal((m, m)) * (rng.random() < 0.5)
    law = relay(m) if rng.random() < 0.5 else complementarity(m)
    t = ca.SX.sym("t")
    model = LureSystem(
        t=t, A=rng.standard_normal((n, n)) - np.eye(n), B=G, C=G.T, D=half @ half.T + skew - skew.T, law=law,
        f=rng.standard_normal(n) * ca.sin(2 * t), x0=G @ np.abs(rng.standard_normal(m)), t_end=5,
    )  # fmt: skip
    try:
        python = simulate(model, rtol=1e-8, method="event-driven", compiled=False)
    except nsmodel.NsmodelError as error:
        with pytest.raises(type(error)):
            simulate(model, rtol=1e-8, method="event-driven", compiled=True)
        return
    at = np.linspace(0, 5, 101)
    c = simulate(model, rtol=1e-8, method="event-driven", compiled=True)
    size = np.abs(python.x).max(axis=0)
    assert np.abs(c.at(at).x - python.at(at).x).max() <= 1e-8 * size.max()


@pytest.mark.parametrize("name", ["diode_bridge", "relay_oscillator", "two_discs", "relay 1e3", "circle", "corners"])
def test_runs_in_c_go_on_byte_for_byte(name, tmp_path):
    model = (MODELS | STIFF)[name]()
    run = lambda out, **more: simulate(model, rtol=1e-8, method="event-driven", compiled=True, out=out, **more)  # noqa: E731
    run(tmp_path / "one")
    for i, end in enumerate([0.21, 0.5, 0.83, 1.0]):
        run(tmp_path / "parts", t_end=end * model.t_end, resume=i > 0)
    run(tmp_path / "again")
    assert files(tmp_path / "one") == files(tmp_path / "parts") == files(tmp_path / "again")


def test_places_go_to_the_integrator_and_back():
    """At any piece, with switches, the integrator goes on from where C is, and C from there."""
    model = switches()
    walk = EventDrivenPropagator(model, Options(rtol=1e-8, compiled=True), event_driven_problem(model), lambda: None)
    for _ in range(6):
        walk.maker.make_pieces(4.0, 0)
        place = walk.maker.checkpoint()
        assert walk.maker.integrator.checkpoint() == place["integrator"]
        walk.maker.restore(place)
        assert walk.maker.checkpoint() == place


# -- the library


MAIN = """
#include "thing_pieces.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <math.h>

/* Whether one call through many times has the bits of as many calls, and stops at what is no time. */
static int goes_through(thing_pieces *s, double rtol, double end)
{
    static double times[1000], x[1000*THING_PIECES_N];
    double one[THING_PIECES_N];
    const double none[] = {0.1*end, 0.2*end, NAN, end}, back[] = {0.3*end, 0.25*end};
    int same = thing_advance_through(s, 0, times, x) == THING_NOT_INITIALISED;
    for (int k = 0; k < 1000; k++)
        times[k] = k < 990 ? end*k/990 : end;
    if (thing_pieces_init(s, rtol) || thing_advance_through(s, 1000, times, x) || thing_pieces_init(s, rtol))
        return 0;
    for (int k = 0; k < 1000; k++) {
        same &= thing_advance(s, times[k]) == THING_OK;
        thing_pieces_get_state(s, one);
        same &= memcmp(one, x + k*THING_PIECES_N, sizeof one) == 0;
    }
    thing_pieces_init(s, rtol);
    same &= thing_advance_through(s, 4, none, x) == THING_NOT_FINITE && thing_pieces_get_time(s) == none[1];
    same &= thing_advance_through(s, 2, back, x) == THING_BAD_STEP && thing_pieces_get_time(s) == back[0];
    return same && thing_advance_through(s, 0, back, x) == THING_OK;
}

int main(int argc, char **argv)
{
    static thing_pieces s;
    double x[THING_PIECES_N], end = atof(argv[2]);
    if (argc == 3 && !goes_through(&s, atof(argv[1]), end))
        return 51;
    int status = thing_pieces_init(&s, atof(argv[1]));
    for (int k = 0; status == THING_OK && k <= 40; k++) {
        status = thing_advance(&s, end*k/40);
        thing_pieces_get_state(&s, x);
        printf("%.17g", thing_pieces_get_time(&s));
        for (int i = 0; i < THING_PIECES_N; i++)
            printf(" %.17g", x[i]);
        printf("\\n");
    }
    if (thing_advance(&s, NAN) != THING_NOT_FINITE && status == THING_OK)
        return 50;
    return argc > 3 ? 0 : status;
}
"""


def built(model, folder, *flags):
    codegen.write(model, folder, name="thing", event_driven=True, step=model.step or 1e-3 * model.t_end)
    (folder / "use.c").write_text(MAIN)
    program = folder / "use"
    sources = [str(folder / file) for file in ("use.c", "thing_pieces.c")]
    subprocess.run([CC, *STRICT, *flags, "-o", str(program), *sources, "-lm"], check=True)
    return program


@pytest.mark.parametrize(
    "name",
    [
        "friction_oscillator",
        "diode_bridge",
        "gene_network",
        "point_past_disc",
        "mains",
        "switches",
        "edges",
        "nonlinear",
        "two_discs",
        *("functions", "relay 1e3", "circle", "corners", "kinetics", "chain"),
    ],
)
def test_the_library_is_sound_and_right(name, tmp_path):
    """Under AddressSanitizer and UndefinedBehaviorSanitizer, and as the run in Python has it."""
    model = (MODELS | STIFF)[name]()
    found = subprocess.run(
        [built(model, tmp_path, *SANITIZED), "1e-8", repr(model.t_end)], check=True, capture_output=True, text=True
    )
    assert not found.stderr
    assert not re.search(r"\b(malloc|calloc|realloc)\b", (tmp_path / "thing_pieces.c").read_text())
    rows = np.array([line.split() for line in found.stdout.splitlines()], float)
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=False)
    x = run.at(rows[:, 0])
    expected = np.hstack([x.x, x.v])
    assert np.abs(rows[:, 1:] - expected).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["relay_oscillator", "relay 1e3"])
def test_the_library_keeps_its_budget_and_says_what_it_cannot(name, tmp_path):
    model = (MODELS | STIFF)[name]()
    n = len(model.names)
    folder = built(model, tmp_path).parent
    library = folder / "thing.so"
    subprocess.run([CC, "-shared", "-fPIC", optimised("-O2"), "-o", library, folder / "thing_pieces.c", "-lm"], check=True)
    lib = ctypes.CDLL(str(library))
    lib.thing_pieces_get_time.restype = ctypes.c_double
    s = ctypes.create_string_buffer(1 << 20)
    number, names = ctypes.c_double, ["OK", "NOT_SOLVED", "NOT_FINITE", "BAD_STEP", "BAD_PARAMETER", "NO_ROOM", "NOT_INITIALISED"]
    assert lib.thing_advance(s, number(1.0)) == names.index("NOT_INITIALISED")
    assert lib.thing_pieces_init(s, number(1e-15)) == names.index("BAD_STEP")
    assert lib.thing_pieces_init(s, number(1e-8)) == 0
    lib.thing_pieces_set_most(s, ctypes.c_long(5))
    calls = 0
    while (status := lib.thing_advance(s, number(model.t_end))) == names.index("NOT_SOLVED"):
        calls += 1
    assert status == 0
    assert calls > 5
    x = (number * n)()
    lib.thing_pieces_get_state(s, x)
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=False)
    np.testing.assert_allclose(list(x), run.x[-1], rtol=1e-10)
    assert lib.thing_pieces_set_state(s, number(0.0), (number * n)(np.nan)) == names.index("NOT_FINITE")
    assert lib.thing_advance(s, number(0.5 * model.t_end)) == names.index("BAD_STEP")


def test_what_runs_on_discs_is_there_once_and_needed():
    kinds = [key[0] for key in piece_spec_of(case("point_past_disc"), {}).discs.lines]
    assert kinds.count("sqrt") == 1  # Of h and of g.
    kinds = [key[0] for key in piece_spec_of(case("two_masses"), {}).discs.lines]
    assert "sin" in kinds
    assert "cos" not in kinds  # The recurrence of sin needs it, its value does not.


def test_what_has_no_pieces_in_c_is_named(tmp_path):
    with pytest.raises(CodegenError, match="many bodies"):
        codegen.write(case("evacuation"), tmp_path / "a", event_driven=True)
    ball = nsmodel.FrictionOscillator(
        x=(x := ca.SX.sym("x", 2)), s=(s := ca.SX.sym("s")), potential=ca.sumsqr(x), friction=s, x0=[1, 0], v0=[0, 1], t_end=1,
        step=0.01,
    )  # fmt: skip
    with pytest.raises(CodegenError, match="its l is a series of y"):
        codegen.write(ball, tmp_path / "b", event_driven=True)


def shared_library(model, folder):
    folder = built(model, folder).parent
    library = folder / "thing.so"
    subprocess.run([CC, "-shared", "-fPIC", optimised("-O2"), "-o", library, folder / "thing_pieces.c", "-lm"], check=True)
    lib = ctypes.CDLL(str(library))
    lib.thing_pieces_get_time.restype = ctypes.c_double
    return lib, ctypes.create_string_buffer(1 << 20)


def state_of(lib, s, n):
    x = (ctypes.c_double * n)()
    lib.thing_pieces_get_state(s, x)
    return lib.thing_pieces_get_time(s), list(x)


@pytest.mark.parametrize("t", [1e16, 1e18, 4e15])
def test_a_piece_that_does_not_move_time_ends_with_a_status(t, tmp_path):
    """Where t + s is t the call comes back, and says so; before it ran for ever."""
    lib, s = shared_library(case("zener_limiter"), tmp_path)
    assert lib.thing_pieces_init(s, ctypes.c_double(1e-8)) == 0
    lib.thing_pieces_set_most(s, ctypes.c_long(20))
    x = (ctypes.c_double * len(case("zener_limiter").names))(0.65060781287170633)
    lib.thing_pieces_set_state(s, ctypes.c_double(t), x)
    status = lib.thing_advance(s, ctypes.c_double(t * (1 + 1e-15) + 2))
    assert status in (1, 3, 9, 10)


def test_a_state_that_is_refused_changes_nothing(tmp_path):
    """Where no mode is found the library stands where it stood, and goes on to the same bits."""
    x = ca.SX.sym("x", 2)
    l = ca.SX.sym("l")
    model = nsmodel.FirstOrderSystem(x=x, lam=l, f=[x[1], -x[0] + ca.sqrt(4 - x[0])], g=[0, l], h=[x[1]], law=nsmodel.relay(1),
                                     x0=[3, 0], t_end=4, step=1e-2)  # fmt: skip
    lib, s = shared_library(model, tmp_path)
    number = ctypes.c_double
    assert lib.thing_pieces_init(s, number(1e-8)) == 0
    assert lib.thing_advance(s, number(1.0)) == 0
    before = state_of(lib, s, 2)
    assert lib.thing_pieces_set_state(s, number(0.5), (number * 2)(5.0, 0.0)) != 0
    assert state_of(lib, s, 2) == before
    assert lib.thing_advance(s, number(3.0)) == 0
    after = state_of(lib, s, 2)
    assert lib.thing_pieces_init(s, number(1e-8)) == 0
    assert lib.thing_advance(s, number(1.0)) == 0
    assert lib.thing_advance(s, number(3.0)) == 0
    np.testing.assert_allclose(after[1], state_of(lib, s, 2)[1], rtol=1e-14)
