"""A compiled run is the interpreted one: the same rows, certificates and errors, however it is stopped, resumed or built.

The C is built without optimisation, to spend less time on it; some runs of the command line build it as users do.
"""

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import processes
import pytest
from conftest import QUICK
from fuzz_models import COUNT, FULL
from processes import kill_when_there

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    RunInterrupted,
    StepError,
    StorageError,
    SweepingProcess,
    UsageError,
    ball,
    complementarity,
    polyhedron,
    product,
    relay,
    second_order_cone,
    simulate,
)
from nsmodel.cli import main
from nsmodel.codegen import library
from nsmodel.codegen import library as cache
from nsmodel.codegen.rollout import Rollout
from nsmodel.errors import CodegenError
from nsmodel.modeling.model_files import case_files
from nsmodel.modeling.time_grid import make_grid
from nsmodel.models.many_bodies import step_library
from nsmodel.models.many_bodies.step_library import solver_source
from nsmodel.simulation.fixed_grid import SchemePropagator
from nsmodel.simulation.simulate import explain, prepared_loop
from nsmodel.simulation.step_backend import STEPS_IN_C, STEPS_IN_C_FOR_ALL
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.plan import LOADING_SECONDS, CompilationCost, build_seconds, interpreted_step_seconds
from tests.simulation.test_resume import (
    FEW_ROWS,
    MODELS,
    assert_equal_runs,
    first_order,
    inclusion,
    inclusion_in_a_box,
    lure,
    oscillator,
    sweeping,
    whole_runs,
)

IS_KEPT = cache.has_cached_library  # the true one
loop, walk = (importlib.import_module(f"nsmodel.simulation.{name}") for name in ("loop", "propagator"))
pytestmark = pytest.mark.usefixtures("own_cache")
NO_UNIQUE_MULTIPLIERS = {"zhuravlev_ivanov", "woodpecker"}
BRIDGE = str(case_files()["diode_bridge"])

compiles = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")


@pytest.fixture(name="fresh_cache")
def make_fresh_cache(tmp_path, monkeypatch):
    """Return the folder of a cache that is empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "nsmodel"


@pytest.fixture(name="small_chunks")
def make_small_chunks(monkeypatch):
    monkeypatch.setattr(walk, "CHUNK_BYTES", FEW_ROWS)


@pytest.fixture(name="whole", scope="module")
def make_whole(tmp_path_factory):
    return whole_runs(tmp_path_factory, compiled=True)


@pytest.fixture(name="calls")
def make_calls(monkeypatch):
    """Return the list of (first step, steps asked for, steps taken) of all calls into C."""
    calls, advance = [], Rollout.advance

    def noted(self, k, steps, *args):
        block = advance(self, k, steps, *args)
        calls.append((k, steps, block.steps))
        return block

    monkeypatch.setattr(Rollout, "advance", noted)
    return calls


def failing(monkeypatch, condition):
    """Let steps fail in C where ``condition``, in terms of the number ``k``, holds; the library has a cache of its own."""
    write = cache.write_source

    def changed(*args, **options):
        source = write(*args, **options)
        head = re.search(r"^static int attempt\([^;]*?\)\n\{\n", source.code, re.MULTILINE)[0]
        failure = f"    const long k = (long)s->steps;\n    if ({condition})\n        return 1;\n"
        code = source.code.replace(head, head + failure)
        return replace(source, code=code)

    monkeypatch.setattr(cache, "write_source", changed)


def assert_same(compiled, interpreted, unique=True):
    """The rows of both ways, states to 1e-10 of their size; what is not about how the steps were found is equal."""
    assert list(compiled.arrays) == list(interpreted.arrays)
    for name, array in interpreted.arrays.items():
        other = compiled.arrays[name]
        assert (other.dtype, other.shape) == (array.dtype, array.shape), name
        np.testing.assert_array_equal(np.isnan(other), np.isnan(array), err_msg=name)
        if name in ("x", "multipliers", "y"):
            assert not np.signbit(other[other == 0]).any(), f"-0 in {name}"
        if name == "index_set":
            if unique:
                np.testing.assert_array_equal(other, array)
        elif name in ("t", "step", "tolerance"):
            np.testing.assert_array_equal(other, array, err_msg=name)
        elif name == "residual" or name.startswith("residual_"):
            assert np.nanmax(other, initial=0) <= 1e-9
        elif name != "newton" and (unique or name != "multipliers"):
            size = np.nanmax(np.abs(array), axis=0, initial=1e-12 if name == "x" else 1e-3)
            felt = moved_apart(compiled, interpreted) if STEPS_IN_C_FOR_ALL in compiled.metadata["used"] and name != "x" else 0
            assert np.nanmax((np.abs(other - array) - felt) / size, initial=0) <= 1e-10, name
    one, two = compiled.metadata, interpreted.metadata
    assert one.keys() == two.keys()
    apart = {"used", "run", "solver_counts", "totals", "convergence", *(["message"] if one["status"] == "failed" else [])}
    assert one.get("convergence", {}) == pytest.approx(two.get("convergence", {}))
    assert {key: one[key] for key in one.keys() - apart} == {key: two[key] for key in two.keys() - apart}
    assert sorted(one["used"]) == sorted([*two["used"], STEPS_IN_C_FOR_ALL if STEPS_IN_C_FOR_ALL in one["used"] else STEPS_IN_C])
    assert one["totals"].keys() == two["totals"].keys()
    kept = ["steps", "rest_from", "last_x", "last_v", *(["index_set_changes"] if unique else [])]
    for key in kept:
        if two["totals"].get(key) is not None:
            np.testing.assert_allclose(one["totals"][key], two["totals"][key], rtol=1e-10, atol=1e-13, err_msg=key)
    assert sum(one["solver_counts"].values()) == sum(two["solver_counts"].values())
    assert_totals_are_those_of_the_rows(compiled)


def moved_apart(compiled, interpreted):
    """What states, 1e-10 of their size apart, make of a multiplier that holds y = 0 for a step: velocities over its length.

    Code of all values takes other sums than that of numbers, and the interpreted kernel: its states differ by rounding.
    """
    names = [name for name in ("x", "v") if name in interpreted.arrays]
    return sum(np.nanmax(np.abs(compiled.arrays[k] - interpreted.arrays[k])) for k in names) / np.nanmin(interpreted.step)


def assert_totals_are_those_of_the_rows(run):
    totals, codes = run.metadata["totals"], run.index_set[run.index_set[:, 0] > -2 if run.index_set.size else slice(0)]
    assert totals["index_set_changes"] == (codes[1:] != codes[:-1]).any(axis=1).sum()
    assert totals["worst_residual"] == np.nanmax(run.residual, initial=0)
    assert totals["worst_residual"] == 0 or totals["worst_residual_t"] == run.t[np.nanargmax(run.residual)]
    if "newton" in run.arrays:
        assert (totals["newton"], totals["newton_max"]) == (np.nansum(run.newton), np.nanmax(run.newton))


# ---------------------------------------------------------------------------------------------- the same run


SMALLER = {"crowd_room": {"n": 8 if COUNT == FULL else 5}}
PART = {"zhuravlev_ivanov": 0.2, "gene_network": 0.3}  # of the time, where the interpreted run takes seconds


@compiles
def test_every_case(case_file, load_case, run_case):
    stem = case_file.stem
    model = load_case(stem, **SMALLER.get(stem, {}))
    if isinstance(model, ManyBodies):
        return  # another step, with tests of its own
    t_end = PART[stem] * model.t_end if stem in PART else None
    whole = not (stem in SMALLER or stem in PART)
    interpreted = run_case(stem) if whole else simulate(model, t_end=t_end, compiled=False)
    assert_same(simulate(model, t_end=t_end, compiled=True), interpreted, stem not in NO_UNIQUE_MULTIPLIERS)


def varied(steps):
    """The arguments of a model that is given its steps."""
    return {"steps": steps, "step": None, "t_end": None}


def with_law(law, **other):
    """Return forces that take y through 0 again and again."""
    t, m = ca.SX.sym("t"), 2 if law is None else law.size
    f = ca.vertcat(*(2 * ca.cos((3 + i) * t + i) - 0.7 * (-1) ** i for i in range(m)))
    given = {"A": -0.5 * np.eye(m), "B": np.eye(m), "C": np.eye(m), "x0": 0.2 * np.cos(np.arange(m)), "t_end": 4, "step": 0.05}
    return LureSystem(t=t, f=f, law=law, **(given | other))


def with_phi(phi, **other):
    """Return the same under a convex potential."""
    y = ca.SX.sym("y", 2)
    return with_law(None, y=y, phi=phi(y), **other)


def kinks(y):
    """A potential with a kink in each direction and a smooth part."""
    return ca.fabs(y[0]) + ca.fmax(y[1], 0) + y[1] ** 2 / 2


def bent(**other):
    """Return a mass on a spring that stiffens, with friction that grows with speed."""
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    given = {"potential": ca.sumsqr(x) ** 2 / 4 + ca.sumsqr(x), "friction": 0.3 * s + 0.1 * s**2, "x0": [1, 0.5], "v0": [0, 1]}
    return FrictionOscillator(x=x, s=s, **(given | {"t_end": 4, "step": 0.03} | other))


def without_law(**other):
    """Return a pendulum: no multiplier at all."""
    x = ca.SX.sym("x", 2)
    return FirstOrderSystem(x=x, f=[x[1], -ca.sin(x[0])], x0=[1, 0], t_end=2, step=0.01, **other)


def bilinear(**other):
    """Return a step that is monotone up to x = 0.5."""
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    given = {"f": [1], "h": [2 + (0.5 - x) * l], "g": [0 * l], "law": complementarity(1), "x0": [0], "t_end": 3, "step": 0.01}
    return FirstOrderSystem(x=x, lam=l, **(given | other))


def blow_up():
    """Return a state whose derivative is infinite at t = 1."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("l")
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=[1e-3 / ca.sqrt(0.995 - t)], h=[x], g=[l], law=relay(1), x0=[1], t_end=2, step=0.01
    )  # fmt: skip


SIMPLEX = polyhedron(np.vstack([np.eye(2), -np.ones((1, 2))]), [0.0, 0.0, -1.0])
VARIED = varied(0.02 + 0.01 * np.sin(np.arange(150)))
TWO_SIZES = varied(np.tile([0.02, 0.02, 0.05], 50))
SCENES = {
    **{build.__name__: build for build in [*MODELS, bent, without_law]},
    "two positions, last step shortened": lambda: oscillator(v0=None, x1=[2.01, 1.02], t_end=7.99),
    "last step shortened, oscillator": lambda: oscillator(t_end=8.03),
    "last step shortened, lure": lambda: lure(t_end=10.02),
    "last step shortened, first order": lambda: first_order(t_end=5.99),
    "last step shortened, inclusion": lambda: inclusion(t_end=5.99),
    "one step": lambda: lure(t_end=0.05),
    "less than one step": lambda: lure(t_end=0.03),
    "varied steps, lure": lambda: lure(**VARIED),
    "two sizes of steps, lure": lambda: lure(**TWO_SIZES),
    "varied steps, first order": lambda: first_order(**VARIED),
    "varied steps, oscillator": lambda: oscillator(**VARIED),
    "varied steps, inclusion": lambda: inclusion(**VARIED),
    "varied steps, tolerance of each": lambda: inclusion_in_a_box(tolerances=1e-4 / (1 + np.arange(150.0)), **VARIED),
    "tolerances of each step": lambda: inclusion(tolerances=1e-4 / (1 + np.arange(300.0)) ** 2),
    "exact projections": lambda: inclusion(tolerances=None),
    "all laws": lambda: with_law(product(relay(1), complementarity(1), ball(2, 0.5), second_order_cone(3), SIMPLEX)),
    "phi with kinks": lambda: with_phi(kinks),
    "phi with kinks, varied steps": lambda: with_phi(kinks, **VARIED),
    "phi a norm": lambda: with_phi(ca.norm_2),
    "not monotone later": bilinear,
}  # fmt: skip


@compiles
@pytest.mark.parametrize("name", SCENES)
def test_every_kind_of_model(name):
    interpreted = simulate(SCENES[name](), compiled=False)
    assert_same(simulate(SCENES[name](), compiled=True), interpreted)
    assert interpreted.status == "done"


@compiles
def test_monotonicity_that_is_lost_on_the_way_is_told():
    for compiled in (False, True):
        warnings = simulate(bilinear(), compiled=compiled).metadata["warnings"]
        assert len(warnings) == 1
        assert warnings[0].startswith("the one-step problem was not monotone all the time (least eigenvalue -1): uniqueness")


@compiles
@pytest.mark.parametrize("build", [first_order, lambda: first_order(g=[0.5, 0.7]), lambda: with_law(relay(3), **VARIED)])
def test_the_least_eigenvalue_is_that_of_the_interpreted_run_where_it_is_negative(build):
    least = [simulate(build(), compiled=way).metadata["totals"]["least_eigenvalue"] for way in (False, True)]
    assert min(least[0], 0) == pytest.approx(min(least[1], 0), rel=1e-2, abs=1e-12)


# ---------------------------------------------------------------------------------------------- steps that C does not take


@compiles
@pytest.mark.parametrize("where", ["k % 7 == 3", "k == 0", "k == 63", "k == 199", "1", "k >= 100 && k < 110"])
def test_a_step_that_fails_in_c_is_interpreted_and_the_run_goes_on_in_c(
    where, monkeypatch, fresh_cache, calls, tmp_path, small_chunks
):
    """Also at the first row of a chunk, 64."""
    expected = simulate(lure(), compiled=False)
    failing(monkeypatch, where)
    run = simulate(lure(), compiled=True, out=tmp_path / "run")
    assert_same(run, expected)
    fails = [k for k in range(200) if eval(where.replace("&&", "and"), {"k": k})]
    assert sum(taken for *_, taken in calls) == 200 - len(fails)
    assert [k + taken for k, asked, taken in calls if taken < asked] == fails


def closing(**other):
    """Return a point between walls that meet at t = 0.4975."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q")
    given = {"f": [0.3], "constraints": {"left": q - t, "right": 0.995 - t - q}, "q0": [0.5], "t_end": 1, "step": 0.01}
    return SweepingProcess(t=t, q=q, **(given | other))


@compiles
@pytest.mark.parametrize(
    "build",
    [
        closing,
        lambda: closing(**VARIED),
        blow_up,
    ],
    ids=["walls", "walls, varied steps", "not finite"],
)
def test_a_step_without_solution_has_the_same_error(build, tmp_path, monkeypatch, small_chunks):
    errors = []
    for compiled in (False, True):
        with pytest.raises(StepError, match=r"^step \d+: ") as caught:
            simulate(build(), out=tmp_path / str(compiled), compiled=compiled)
        errors.append(caught.value)
    one, two = errors
    said = [re.sub(r"Best residual \S+", "Best residual ...", str(error)) for error in errors]
    assert said[0] == said[1]
    assert (one.step, one.time, one.component) == (two.step, two.time, two.component)
    assert one.residual == pytest.approx(two.residual, rel=0.1)
    assert one.trajectory.status == two.trajectory.status == "failed"
    assert_same(two.trajectory, one.trajectory)
    assert_equal_runs(two.trajectory, nsmodel.Trajectory.load(tmp_path / "True" / "trajectory.npz"))


# ---------------------------------------------------------------------------------------------- blocks, chunks, rows kept


@compiles
@pytest.mark.parametrize("build", MODELS, ids=lambda build: build.__name__)
@pytest.mark.parametrize("every", [1, 3])
def test_however_it_is_cut_a_run_is_the_same_to_the_last_bit(build, every, tmp_path, monkeypatch, small_chunks, whole):
    """Step by step, with small chunks on disk, or at once in memory: nothing that a solver keeps may matter."""
    advance = Rollout.advance
    at_once = simulate(build(), compiled=True, save_every=every)
    monkeypatch.setattr(Rollout, "advance", lambda self, k, steps, *args: advance(self, k, min(steps, 1), *args))
    assert_equal_runs(simulate(build(), compiled=True, save_every=every, out=tmp_path), at_once)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(build, save_every=every)
    rows = [0, *range(every, 201, every)]
    rows += [] if rows[-1] == 200 else [200]
    full = simulate(build(), compiled=True)
    for name, array in full.arrays.items():
        np.testing.assert_array_equal(at_once.arrays[name], array[rows], err_msg=name)
    assert at_once.metadata["totals"] == full.metadata["totals"] | {
        key: at_once.metadata["totals"][key] for key in ("rest_from", "last_v", "impacts") if key in full.metadata["totals"]
    }


@compiles
@pytest.mark.parametrize("steps", [189, 190, 191, 192])
def test_a_last_row_that_is_no_nth_one_has_room(steps, tmp_path, small_chunks):
    """A chunk has 64 rows: the start, and every third up to row 189."""
    run = simulate(lure(), compiled=True, save_every=3, out=tmp_path, t_end=0.05 * steps)
    np.testing.assert_array_equal(run.x, simulate(lure(), compiled=True).x[[*range(0, steps, 3), steps]])


@compiles
def test_a_run_on_disk_needs_no_more_memory_when_it_is_longer(tmp_path):
    body = """
        import resource
        loop.Trajectory.load, walk.CHUNK_BYTES = lambda path: None, 1 << 20
        for end in (5e2, 3e3):
            model = nsmodel.LureSystem(A=[[-1]], B=1, C=1, law=nsmodel.relay(1, -0.5, 0.5), x0=1, t_end=end, step=1e-3)
            nsmodel.simulate(model, out=f"run{end:g}", save_every=10, compiled=True)
            print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    """
    short, long = map(int, start(body, tmp_path).communicate(timeout=100)[0].split())
    assert long - short < 4e3  # kB


# ---------------------------------------------------------------------------------------------- stopped and resumed


def stop_after(monkeypatch, steps):
    """Send Ctrl-C after so many compiled steps."""
    advance = Rollout.advance

    def stopping(self, k, most, *args):
        block = advance(self, k, min(most, steps - k) if k < steps else most, *args)
        if k < steps == k + block.steps:
            os.kill(os.getpid(), signal.SIGINT)
        return block

    monkeypatch.setattr(Rollout, "advance", stopping)


@compiles
@pytest.mark.parametrize("build", MODELS, ids=lambda build: build.__name__)
@pytest.mark.parametrize(("steps", "way"), [(1, "auto"), (64, True), (100, "auto")])  # auto goes on in C
def test_an_interrupted_run_is_resumed_to_the_same_bytes(build, steps, way, tmp_path, monkeypatch, small_chunks, whole):
    with monkeypatch.context() as patch:
        stop_after(patch, steps)
        with pytest.raises(RunInterrupted, match=r"interrupted at t = ") as caught:
            simulate(build(), out=tmp_path, compiled=True)
    assert (len(caught.value.trajectory), caught.value.trajectory.status) == (steps, "interrupted")
    assert simulate(build(), out=tmp_path, resume=True, compiled=way).status == "done"
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(build)


@compiles
def test_a_run_is_continued_to_a_later_end_and_a_finished_one_as_it_is(tmp_path, whole):
    for end in (1, 5, None, None):
        run = simulate(lure(), out=tmp_path, t_end=end, resume=end != 1, compiled=True if end == 1 else "auto")
    assert run.metadata["used"][-1].startswith("steps in C")
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(lure)


DRIVER = """
import sys, time
from tests.simulation import test_resume
import nsmodel
from nsmodel.codegen import library as cache
from nsmodel.codegen.rollout import Rollout
from nsmodel.simulation import loop, propagator as walk
cache.COMPILER_FLAGS = {flags!r}
print("ready", flush=True)
{body}
"""


def start(body, folder):
    """Start a program that runs ``body`` in ``folder``; return it when it is ready."""
    process = processes.start(DRIVER.format(flags=QUICK, body=textwrap.dedent(body)), folder)
    assert process.stdout.readline() == "ready\n"
    return process


@compiles
@pytest.mark.parametrize("build", [sweeping, oscillator], ids=lambda build: build.__name__)
@pytest.mark.long
def test_a_killed_run_is_resumed_to_the_same_bytes(build, tmp_path, whole):
    body = f"""
        advance = Rollout.advance
        Rollout.advance = lambda self, k, steps, *args: (time.sleep(2e-3), advance(self, k, min(steps, 1), *args))[1]
        walk.CHUNK_BYTES = test_resume.FEW_ROWS
        nsmodel.simulate(test_resume.{build.__name__}(), out="run", compiled=True)
    """
    kill_when_there(start(body, tmp_path), tmp_path / "run" / "chunk-000002.npz")
    assert not (tmp_path / "run" / "trajectory.npz").exists()
    simulate(build(), out=tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == whole(build)


@compiles
def test_ctrl_c_at_any_moment_loses_no_row(tmp_path, monkeypatch):
    def build():
        return lure(f=None, gamma=1, t_end=2e4, step=0.01)

    options = {"compiled": True, "save_every": 1000}
    simulate(build(), out=tmp_path / "whole", **options)
    expected, rng, stopped = (tmp_path / "whole" / "trajectory.npz").read_bytes(), np.random.default_rng(0), 0
    advance, armed = Rollout.advance, []

    def arming(self, *args):
        if not armed:
            armed.append(1)
            signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-3, 0.1))
        return advance(self, *args)

    monkeypatch.setattr(Rollout, "advance", arming)
    old = signal.signal(signal.SIGALRM, lambda number, frame: os.kill(os.getpid(), signal.SIGINT))
    try:
        for i in range(6):
            armed.clear()
            try:
                simulate(build(), out=tmp_path / str(i), **options)
            except RunInterrupted as error:
                stopped += error.trajectory.metadata["steps"] < 2_000_000
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
            simulate(build(), out=tmp_path / str(i), resume=True, **options)
            assert (tmp_path / str(i) / "trajectory.npz").read_bytes() == expected
    finally:
        signal.signal(signal.SIGALRM, old)
    assert stopped >= 3


SLOW = "for (volatile long i = 0; i < 500000; i++);\n    if (0"  # about a millisecond


@compiles
def test_ctrl_c_is_heard_soon_and_the_bar_moves_however_slow_the_steps_are(monkeypatch, fresh_cache):
    """Fast steps first, in long blocks; then some that take milliseconds each."""
    failing(monkeypatch, f"k > 300000) {SLOW}")
    moves, sent = [], []

    def interrupt():
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(0.2, interrupt)

    class Bar:
        def update(self, steps):
            moves.append((time.monotonic(), steps))
            if sum(steps for _, steps in moves) > 300_050 and not timer.ident:
                timer.start()

        def close(self):
            pass

    monkeypatch.setattr(loop, "progress_bar", lambda **options: Bar())
    with pytest.raises(RunInterrupted) as caught:
        simulate(lure(t_end=5e4), compiled=True, progress=True, save_every=100)
    assert time.monotonic() - sent[0] < 1
    assert sum(steps for _, steps in moves) == caught.value.trajectory.metadata["steps"]
    assert np.diff([at for at, _ in moves]).max() < 1


@compiles
def test_the_bar_counts_each_step_once(monkeypatch, fresh_cache):
    failing(monkeypatch, "k % 64 == 63")
    counted = []

    class Bar:
        update = staticmethod(counted.append)
        close = staticmethod(lambda: None)

    monkeypatch.setattr(loop, "progress_bar", lambda **options: Bar())
    simulate(lure(t_end=10.02), compiled=True, progress=True)
    assert sum(counted) == 201


@compiles
def test_a_run_goes_on_as_it_began(tmp_path, monkeypatch):
    simulate(lure(), out=tmp_path / "c", t_end=1, compiled=True)
    simulate(lure(), out=tmp_path / "python", t_end=1)
    advice = r"; leave compiled \(--compiled\) out to go on as it began, or start afresh without resuming"
    with pytest.raises(StorageError, match=rf"another way of stepping \(interpreted there, compiled by \S+ now\){advice}"):
        simulate(lure(), out=tmp_path / "python", resume=True, compiled=True)
    with pytest.raises(StorageError, match=rf"another way of stepping \(compiled by \S+ there, interpreted now\){advice}"):
        simulate(lure(), out=tmp_path / "c", resume=True, compiled=False)
    with pytest.raises(StorageError, match=r"another solver \(auto there, lemke now\)"):
        simulate(lure(), out=tmp_path / "c", resume=True, solver="lemke")
    monkeypatch.setattr(CompilationCost, "pays", lambda *_: True)  # the way does not depend on the length any more
    assert not simulate(lure(), out=tmp_path / "python", resume=True).metadata["used"][-1].startswith("steps in C")
    assert simulate(lure(), out=tmp_path / "c", t_end=2, resume=True).metadata["used"][-1].startswith("steps in C")
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(StorageError, match=r"the run there is compiled by \S+, which it cannot be here: no C compiler"):
        simulate(lure(), out=tmp_path / "c", resume=True)
    assert simulate(lure(), out=tmp_path / "python", resume=True, compiled=True).status == "done"  # with a warning, as it began


# ---------------------------------------------------------------------------------------------- no compiler, no cache


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"PATH": "", "CC": ""}, r"no C compiler was found \(none of cc, gcc, clang\); install one \(apt install gcc; .*\)$"),
        (
            {"CC": "no-such-compiler"},
            r"no C compiler was found \(CC names no-such-compiler, which is not there\); install one .*",
        ),
        ({"CC": "false"}, r"false could not compile rollout\.c: exit status 1$"),
        ({"CC": "cat"}, r"cat could not compile rollout\.c: cat: .*"),
        ({"XDG_CACHE_HOME": "/proc"}, r"the cache folder /proc/nsmodel cannot be used \(.*\); name another with XDG_CACHE_HOME$"),
        ({"XDG_CACHE_HOME": __file__}, r"the cache folder \S+ cannot be used \(.*\); name another with XDG_CACHE_HOME$"),
    ],
)
def test_without_compiler_or_cache_a_run_is_interpreted_with_a_message(environment, message, monkeypatch, fresh_cache, capsys):
    compiler = environment.get("CC") if environment.get("CC") in ("false", "cat") else library.compiler()
    if "PATH" not in environment and (compiler is None or shutil.which(compiler.split()[0]) is None):
        pytest.skip("no C compiler")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    run = simulate(lure(), compiled=True)
    assert run.status == "done"
    assert len(run.metadata["warnings"]) == 1
    assert re.fullmatch(f"not compiled, the steps are interpreted: {message}", run.metadata["warnings"][0])
    assert re.fullmatch(f"steps in C: {message}", run.metadata["left_out"][-1])
    assert_equal_runs_but(run, simulate(lure(), compiled=False), "warnings", "left_out")
    assert main(["run", BRIDGE, "--compiled", "--t-end", "1e-4"]) == 0
    out, err = capsys.readouterr()
    assert "  status          done\n" in out
    assert re.fullmatch(rf"nsmodel: warning: not compiled, the steps are interpreted: {message}\n", err)


def assert_equal_runs_but(one, two, *keys):
    assert_equal_runs(one, nsmodel.Trajectory(two.arrays, two.metadata | {key: one.metadata[key] for key in keys}))


@compiles
def test_without_home_a_run_is_interpreted_with_a_message(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/is/ignored")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    [warning] = simulate(lure(), compiled=True).metadata["warnings"]
    assert re.search(
        r"no folder to keep compiled steps in \(could not determine .*home.*\); name one with XDG_CACHE_HOME", warning, re.I
    )


@compiles
def test_a_compiler_may_have_flags_and_what_it_refuses_is_told_in_a_line(monkeypatch, fresh_cache):
    name = library.compiler().split()[0]
    monkeypatch.setenv("CC", f"{name} -DANYTHING=1")
    assert simulate(lure(), compiled=True).metadata["warnings"] == []
    monkeypatch.setenv("CC", f"{name} -DMODEL_OK=")
    failing(monkeypatch, "undeclared_name")
    [warning] = simulate(lure(), compiled=True).metadata["warnings"]
    assert "undeclared_name" in warning
    assert "\n" not in warning
    assert len(warning) < 300


@compiles
def test_a_model_without_c_counterpart_is_interpreted_with_a_message():
    x = ca.SX.sym("x")
    outside = ca.Function("outside", [x], [ca.sin(x)], {"never_inline": True})
    model = FirstOrderSystem(x=x, f=[-outside(x)], x0=[1], t_end=1, step=0.01)
    run = simulate(model, compiled=True)
    assert run.status == "done"
    assert re.match(
        r"not compiled, the steps are interpreted: .* CasADi Function that is not inlined", run.metadata["warnings"][0]
    )


@compiles
def test_a_damaged_library_is_built_again(fresh_cache):
    expected = simulate(lure(), compiled=True)
    [path] = fresh_cache.glob("*")
    good = path.read_bytes()
    for damaged in (good[: len(good) // 2], b"", good[:5000] + b"\1" + good[5001:], good * 2):
        path.unlink()  # the process has the old file open: it must not change
        path.write_bytes(damaged)
        assert_equal_runs(simulate(lure(), compiled=True), expected)
        [path] = fresh_cache.glob("*")
        assert path.read_bytes() == good


@compiles
def test_two_processes_may_build_at_once(fresh_cache, tmp_path):
    body = "print(nsmodel.simulate(test_resume.lure(), compiled=True).metadata['warnings'])"
    both = [start(body, tmp_path) for _ in range(2)]
    assert [process.communicate(timeout=60)[0] for process in both] == ["[]\n"] * 2
    assert [process.returncode for process in both] == [0] * 2
    assert 1 <= len(list(fresh_cache.iterdir())) <= 2
    assert all(re.fullmatch(r"[0-9a-f]{24}-[0-9a-f]{24}\.so", path.name) for path in fresh_cache.iterdir())


def key(model=None, compiler="cc", tolerance=1e-9, step=None, steps=None, t_end=None, parameters=None):
    bound = (lure() if model is None else model).bind(parameters)
    return cache.steps_key(bound, make_grid(bound, step, steps, t_end), tolerance, compiler)


def test_the_key_is_that_of_the_code(monkeypatch):
    k = ca.SX.sym("k")
    with_parameter = {"parameters": {k: 1}, "law": relay(1, -k, k)}
    base = key()
    for same in (
        {"t_end": 3},
        {"t_end": 3.01},
        {"model": lure(**varied([0.05] * 3))},
        {"model": lure(title="T", units={"t": "s"}, exact=lambda t: np.zeros((np.size(t), 2)))},
    ):
        assert key(**same) == base, same
    assert key(inclusion(), t_end=5.99) == key(inclusion())
    assert key(lure(**with_parameter), parameters={"k": 2}) == key(lure(**(with_parameter | {"parameters": {k: 2}})))
    other = [
        key(lure(x0=[3, 0.1])), key(lure(law=relay(1, -2, 2))), key(lure(theta=0.6)), key(lure(**with_parameter)),
        key(lure(**with_parameter), parameters={"k": 2}), key(step=0.025), key(lure(**varied([0.05, 0.04]))), key(tolerance=1e-8),
        key(compiler="gcc"), key(compiler="cc -march=native"), key(inclusion()), key(inclusion(tolerances=lambda h: h**2)),
        key(inclusion(), step=0.02), key(inclusion(**varied([0.03] * 3))), key(inclusion(**varied([0.03, 0.02, 0.02]))),
    ]  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(ca, "__version__", "3.0.0")
        other.append(key())
    monkeypatch.setattr(cache, "COMPILER_FLAGS", ("-O3",))
    other.append(key())
    assert len({base, *other}) == 1 + len(other)


@compiles
def test_what_is_built_once_is_not_built_again(fresh_cache, monkeypatch):
    built, build = [], cache.compile_library
    monkeypatch.setattr(cache, "compile_library", lambda *args: (built.append(1), build(*args)))
    for options in (
        {},
        {"t_end": 3},
        {"t_end": 3.01},
        {"save_every": 7},
        {"tolerance": 1e-8},
        {"step": 0.02},
        {"tolerance": 1e-8},
    ):
        simulate(lure(), compiled=True, **options)
    assert len(built) == 3


# ---------------------------------------------------------------------------------------------- auto


def test_auto_builds_for_no_case_as_none_takes_seconds_and_for_a_long_one(case_file, load_case, monkeypatch):
    model = load_case(case_file.stem, **SMALLER.get(case_file.stem, {}))
    if isinstance(model, ManyBodies):
        return

    def refuse(run):
        raise CodegenError("chosen")

    monkeypatch.setattr(SchemePropagator, "_build", refuse)
    assert "steps in C: chosen" not in explain(model)
    if case_file.stem == "zhuravlev_ivanov":
        assert "steps in C: chosen" in explain(model, t_end=100)


@compiles
def test_auto_compiles_where_building_takes_less_than_it_saves(tmp_path, calls):
    line, left_out = STEPS_IN_C, "building them would take longer"
    for model in (lure(), first_order(), inclusion_in_a_box(tolerances=None)):
        cost = prepared_loop(model, compiled=False).propagator._cost()
        least = int((LOADING_SECONDS + cost.building()) / cost.step) + 1
        assert 1000 < least < 500_000
        few, many = (explain(model, t_end=N * model.step) for N in (least - 1, least))
        assert line not in few
        assert f"steps in C: {least - 1:,} interpreted steps take about" in few
        assert left_out in few
        assert line in many
        assert left_out not in many
        assert line not in (never := explain(model, t_end=least * model.step, compiled=False))
        assert left_out not in never
    assert line not in explain(lure(gamma=1), t_end=500_000 * 0.05, solver="lemke")
    model = first_order()
    cost = prepared_loop(model, compiled=False).propagator._cost()
    least = int((LOADING_SECONDS + cost.building()) / cost.step) + 1
    run = simulate(model, t_end=least * model.step, save_every=1000)
    assert run.metadata["used"][-1] == line
    assert sum(taken for *_, taken in calls) == least


@compiles
def test_auto_takes_what_was_built_before(calls, monkeypatch):
    monkeypatch.setattr(cache, "has_cached_library", IS_KEPT)
    model = first_order(theta=0.8)
    cost = prepared_loop(model, compiled=False).propagator._cost()
    assert cost.building() > 0
    few = int(LOADING_SECONDS / cost.step) + 1
    assert STEPS_IN_C not in explain(model, t_end=few * model.step)
    simulate(model, compiled=True)
    assert prepared_loop(model, compiled=False).propagator._cost().building() == 0
    assert STEPS_IN_C in explain(model, t_end=few * model.step)
    assert STEPS_IN_C not in explain(model, t_end=(few - 1) * model.step)  # loading takes longer than so few steps
    monkeypatch.setenv("CC", "no-such-compiler")
    assert STEPS_IN_C not in explain(model, t_end=few * model.step)


def test_costs_grow_with_what_they_stand_for():
    structure = prepared_loop(first_order(), compiled=False).propagator.stepper.structure
    sizes = [replace(structure, n=n, m=m) for n, m in ((1, 1), (4, 8), (40, 20), (200, 100))]
    problem = one_step_problem(first_order().bind(None))
    for path in ("kernel", "newton", "sparse"):
        steps = [interpreted_step_seconds(path, size, problem.law) for size in sizes]
        assert all(0 < a < b for a, b in pairwise(steps))
        builds = [build_seconds(path, size, problem) for size in sizes]
        assert all(0 < a <= b for a, b in pairwise(builds))


@compiles
def test_many_bodies_share_a_solver(load_case, monkeypatch):
    model, kept = load_case("crowd", n=50), []
    monkeypatch.setattr(cache, "has_cached_library", lambda key: kept and key == kept[0])
    cost = prepared_loop(model, compiled=False).propagator._estimate_cost()
    alone = int((LOADING_SECONDS + cost.building()) / cost.step) + 1
    kept.append(step_library._source_key(solver_source(2), library.compiler()))
    shared = int((LOADING_SECONDS + cost.building()) / cost.step) + 1
    assert 100 < shared < alone / 10
    monkeypatch.setattr(step_library, "CompiledBodiesStep", None)  # nothing is built where it does not pay
    assert STEPS_IN_C not in explain(model, t_end=(shared - 1) * model.step)
    with pytest.raises(TypeError):
        explain(model, t_end=shared * model.step)


def test_auto_without_compiler_says_so_only_where_it_is_asked(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setattr(CompilationCost, "pays", lambda *_: True)
    run = simulate(lure(gamma=1))
    assert run.metadata["warnings"] == []
    assert run.metadata["left_out"][-1].startswith("steps in C: no C compiler was found")
    assert "steps in C: no C compiler was found" in explain(lure(gamma=1))


@pytest.mark.parametrize("compiled", ["yes", 1, None, np.array([1, 2])])
def test_a_wrong_argument_is_refused(compiled):
    with pytest.raises(UsageError, match=r"compiled = .*; expected True, False or 'auto'"):
        simulate(lure(), compiled=compiled)


def test_a_solver_and_compiled_steps_are_not_given_together():
    with pytest.raises(UsageError, match=r"solver 'lemke' and compiled=True are both given: .* their own solvers; keep one"):
        simulate(lure(), compiled=True, solver="lemke")


# ---------------------------------------------------------------------------------------------- the command line


@compiles
def test_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def nsmodel_run(*arguments):
        status = main(["run", *map(str, arguments)])
        return status, *capsys.readouterr()

    status, text, err = nsmodel_run(BRIDGE, "--compiled", "--explain")
    assert (status, err) == (0, "")
    assert f"\n          {STEPS_IN_C}\n" in text
    assert re.search(r"  solver calls    last index set +4983\n +enumeration +17\n", text)
    status, text, err = nsmodel_run(BRIDGE, "--compiled", "--json", "--out", "bridge", "--t-end", "1e-3")
    document = json.loads(text)
    assert (status, err, document["status"], document["steps"]) == (0, "", "done", 1000)
    assert document["plan"]["used"][-1] == STEPS_IN_C
    assert nsmodel_run(BRIDGE, "--resume", "--compiled", "--out", "bridge", "--quiet") == (0, "", "")
    other, oscillator = case_files()["rlc_diode"], case_files()["sliding_relay"]
    status, text, err = nsmodel_run(BRIDGE, other, oscillator, "--compiled")
    assert (status, err) == (0, "")
    assert [line.split()[1] for line in text.splitlines()[1:]] == ["done"] * 3
    status, text, err = nsmodel_run(BRIDGE, other, "--compiled", "--solver", "lemke")
    assert (status, err.count("solver 'lemke' and compiled=True are both given")) == (2, 2)
    status, text, err = nsmodel_run(BRIDGE, "--resume", "--out", "bridge", "--solver", "lemke")
    assert status == 5
    assert "another solver (auto there, lemke now)" in err
    nsmodel_run(BRIDGE, "--out", "interpreted", "--t-end", "1e-3")
    status, text, err = nsmodel_run(BRIDGE, "--resume", "--compiled", "--out", "interpreted")
    assert status == 5
    assert "another way of stepping (interpreted there, compiled by" in err


@pytest.mark.long
@compiles
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_on_the_command_line(tmp_path, number, status):
    command = [
        sys.executable,
        "-m",
        "nsmodel",
        "run",
        BRIDGE,
        "--compiled",
        "--t-end",
        "1e4",
        "--out",
        "run",
        "--save-every",
        "10",
    ]
    process = subprocess.Popen(
        command, cwd=tmp_path, env=processes.environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 60
    while not (tmp_path / "run" / "chunk-000001.npz").exists():
        assert time.monotonic() < end
        time.sleep(0.01)
    process.send_signal(number)
    sent = time.monotonic()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == status
    assert time.monotonic() - sent < 3  # interpreter, pictures and all
    assert "go on with --resume" in errors


@pytest.mark.parametrize("rows", [24, 30])
def test_many_rows_that_depend_on_l_directly_compile(rows):
    """Diodes behind one resistor: more rows than those of which a working set is kept, and h_l is not 0."""
    x, t = ca.SX.sym("x", rows), ca.SX.sym("t")
    model = nsmodel.LureSystem(
        t=t, x=x, A=-x - x**3, B=np.eye(rows), C=np.eye(rows), D=0.1 * np.ones((rows, rows)),
        f=ca.sin(t + ca.DM(np.arange(rows))), law=nsmodel.complementarity(rows), x0=np.zeros(rows), t_end=1.0, step=0.02,
    )  # fmt: skip
    compiled, interpreted = (simulate(model, compiled=how, method="time-stepping") for how in (True, False))
    assert not [text for text in compiled.metadata["warnings"] if "not compiled" in text]
    np.testing.assert_allclose(compiled.x, interpreted.x, atol=1e-10)
