"""A run may stop anywhere: what was computed is on disk, and the rest gives the bytes of a run that was never stopped."""

import errno
import functools
import importlib
import json
import os
import re
import signal
import textwrap
import time

import casadi as ca
import numpy as np
import processes
import pytest
from fuzz_models import COUNT, FULL, share
from processes import before_step, fail, kill_when_there

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    RunInterrupted,
    StepError,
    StorageError,
    SweepingProcess,
    Trajectory,
    complementarity,
    product,
    relay,
)

simulate = functools.partial(nsmodel.simulate, compiled=False)  # whatever other tests have left in the cache
loop, schemes, walk = (importlib.import_module(f"nsmodel.simulation.{name}") for name in ("loop", "fixed_grid", "propagator"))
FEW_ROWS = 1  # Chunks of the least number of rows, 64.


def sweeping(**other):
    """Return a point that goes round a disc into a moving corner, with steps that vary."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    walls = {"disc": ca.norm_2(q) - 1, "wall": 2 - ca.sin(3 * t) / 4 - q[0], "floor": q[1] + 0.2 * ca.cos(2 * t)}
    given = {"f": [1 + 0.3 * ca.sin(5 * t), -0.3], "constraints": walls, "q0": [-2, 0.4]}
    return SweepingProcess(t=t, q=q, steps=0.02 + 0.01 * np.sin(np.arange(200)), **(given | other))


def oscillator(**other):
    """Return two masses that slip and stick, one against a kink of the potential and a wall."""
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    given = {
        "potential": 4 * ca.sumsqr(x) / 2 + 0.1 * ca.fabs(x[1]),
        "friction": {"a": ([1, 0], 0.5 * s), "b": ([0, 1], 0.2 * s + 0.1 * s**2)},
        "constraints": {"wall": x[0] + 0.5},
        "x0": [2, 1], "v0": [0, 1], "t_end": 8, "step": 0.04,
    }  # fmt: skip
    return FrictionOscillator(x=x, s=s, **(given | other))


def first_order(**other):
    """Return a nonlinear relation, a shaken relay and a diode, theta and gamma below 1."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    given = {
        "f": [x[1] + ca.sin(3 * t), -2 * x[0]], "h": [x[1] + 0.1 * l[0], x[0] + 0.2 * l[1]],
        "g": [0.5 * l[1], 0.7 * l[0] + 0.1 * l[1] ** 2], "law": product(relay(1), complementarity(1)),
        "x0": [1, 0], "t_end": 6, "step": 0.03, "theta": 0.6, "gamma": 0.7,
    }  # fmt: skip
    return FirstOrderSystem(t=t, x=x, lam=l, **(given | other))


def lure(**other):
    """Return an oscillator with a relay, shaken, theta and gamma below 1."""
    t = ca.SX.sym("t")
    given = {
        "A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "f": [0, 1.5 * ca.sin(2 * t)], "law": relay(1), "x0": [3, 0],
        "t_end": 10, "step": 0.05, "theta": 0.5, "gamma": 0.8,
    }  # fmt: skip
    return LureSystem(t=t, **(given | other))


def inclusion(**other):
    """Return an outward spiral with friction inside a disc, projected with a tolerance that falls with the step."""
    x = ca.SX.sym("x", 2)
    given = {
        "field": [0.3 * x[0] - 2 * (x[1] - 0.5), 2 * x[0] + 0.3 * (x[1] - 0.5)],
        "phi": 0.02 * ca.fabs(x[0]) + 0.01 * ca.norm_2(x),
        "constraints": {"disc": 0.5 - ca.sumsqr(x)}, "x0": [0.5, 0.3], "t_end": 6, "step": 0.03, "tolerances": lambda h: h**3,
    }  # fmt: skip
    return MonotoneInclusion(x=x, **(given | other))


def inclusion_in_a_box(**other):
    """Return the same in a box, with a tolerance for each step."""
    given = {"constraints": None, "lower": -0.45, "upper": 0.9, "tolerances": 1e-4 / (1 + np.arange(200.0)) ** 2}
    return inclusion(**(given | other))


MODELS = [sweeping, oscillator, first_order, lure, inclusion, inclusion_in_a_box]
every_model = pytest.mark.parametrize("build", MODELS, ids=lambda build: build.__name__)


def whole_runs(tmp_path_factory, **given):
    """Return whole(build) -> bytes of the trajectory of a run that nothing stopped; ``given`` are options of every run."""
    kept = {}

    def whole(build, **options):
        key = (build, *sorted(options.items()))
        if key not in kept:
            folder = tmp_path_factory.mktemp(build.__name__)
            assert simulate(build(), out=folder, **given, **options).status == "done"
            kept[key] = (folder / "trajectory.npz").read_bytes()
        return kept[key]

    return whole


@pytest.fixture(name="whole", scope="module")
def make_whole(tmp_path_factory):
    return whole_runs(tmp_path_factory)


@pytest.fixture(name="small_chunks")
def make_small_chunks(monkeypatch):
    monkeypatch.setattr(walk, "CHUNK_BYTES", FEW_ROWS)


def stop_at(monkeypatch, call, error):
    """Let the ``call``-th step of the next runs raise ``error``."""
    before_step(monkeypatch, call, fail(error))


def assert_equal_runs(one, two):
    assert list(one.arrays) == list(two.arrays)
    for name, array in one.arrays.items():
        assert array.dtype == two.arrays[name].dtype
        np.testing.assert_array_equal(array, two.arrays[name], err_msg=name)
    assert one.metadata == two.metadata


# the same run, however it is kept


@every_model
def test_a_run_in_memory_equals_a_run_on_disk(build, tmp_path, whole):
    in_memory, on_disk = simulate(build()), simulate(build(), out=tmp_path)
    assert_equal_runs(in_memory, on_disk)
    assert_equal_runs(on_disk, Trajectory.load(tmp_path / "trajectory.npz"))
    in_memory.save(tmp_path / "saved.npz")
    assert (tmp_path / "saved.npz").read_bytes() == (tmp_path / "trajectory.npz").read_bytes() == whole(build)


@every_model
def test_the_models_here_switch_their_index_sets(build):
    run = simulate(build())
    assert run.status == "done"
    codes = np.hstack([run.index_set[1:], np.sign(run.arrays.get("selection", run.index_set)[1:])])
    assert (codes[1:] != codes[:-1]).any(axis=1).sum() >= 4


@every_model
def test_the_size_of_the_chunks_does_not_show(build, tmp_path, whole, small_chunks):
    simulate(build(), out=tmp_path)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(build)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "trajectory.npz"]


# stopped and resumed


@every_model
@pytest.mark.parametrize("call", [1, 65, 100, 200])
def test_an_interrupted_run_is_resumed_to_the_same_bytes(build, call, tmp_path, monkeypatch, small_chunks, whole):
    with monkeypatch.context() as patch:
        stop_at(patch, call, KeyboardInterrupt())
        with pytest.raises(RunInterrupted, match=r"interrupted at t = ") as caught:
            simulate(build(), out=tmp_path)
    part = caught.value.trajectory
    assert part.status == "interrupted"
    assert len(part) == call - 1
    assert simulate(build(), out=tmp_path, resume=True).status == "done"
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(build)


def test_a_run_is_interrupted_and_resumed_many_times(tmp_path, monkeypatch, whole):
    resume, ends = False, []
    for _ in range(20):
        with monkeypatch.context() as patch:
            stop_at(patch, 13, KeyboardInterrupt())
            try:
                run = simulate(lure(), out=tmp_path, resume=resume)
                break
            except RunInterrupted as stopped:
                ends.append(len(stopped.trajectory))
        resume = True
    assert run.status == "done"
    assert ends == list(range(12, 200, 12))
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(lure)


@every_model
def test_a_step_that_failed_for_a_moment_is_repeated(build, tmp_path, monkeypatch, whole):
    with monkeypatch.context() as patch:
        stop_at(patch, 90, StepError("a disturbance", residual=0.5))
        with pytest.raises(StepError, match=r"^step 89: a disturbance$") as caught:
            simulate(build(), out=tmp_path)
    assert (caught.value.step, len(caught.value.trajectory), caught.value.trajectory.status) == (89, 89, "failed")
    simulate(build(), out=tmp_path, resume=True)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(build)


@pytest.mark.parametrize("build", [oscillator, first_order, lure, inclusion], ids=lambda build: build.__name__)
@pytest.mark.parametrize("steps", [1, 64, 150])
def test_a_run_is_continued_to_a_later_end(build, steps, tmp_path, whole):
    model = build()
    simulate(model, out=tmp_path, t_end=steps * model.step)
    simulate(build(), out=tmp_path, resume=True)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(build)


def test_resuming_a_finished_run_changes_nothing(tmp_path, whole):
    for build in MODELS:
        simulate(build(), out=tmp_path / build.__name__)
        simulate(build(), out=tmp_path / build.__name__, resume=True)
        assert (tmp_path / build.__name__ / "trajectory.npz").read_bytes() == whole(build)


def test_a_last_chunk_of_one_row_is_noted_once(tmp_path, small_chunks):
    """The verdict on finite convergence takes the last two rows, wherever the chunks end."""
    end = 64 * 0.04
    in_memory = simulate(oscillator(), t_end=end)
    simulate(oscillator(), t_end=end, out=tmp_path)
    assert_equal_runs(in_memory, simulate(oscillator(), t_end=end, out=tmp_path, resume=True))


def slow_down(seconds):
    """Make every step of this process take longer."""
    make = schemes.make_stepper

    def slow(*args, **options):
        stepper = make(*args, **options)

        class Slow(type(stepper)):
            def __call__(self, *args):
                time.sleep(seconds)
                return super().__call__(*args)

        stepper.__class__ = Slow
        return stepper

    schemes.make_stepper = slow


DRIVER = """
from tests.simulation import test_resume
test_resume.walk.CHUNK_BYTES = test_resume.FEW_ROWS
print("ready", flush=True)
nsmodel = test_resume.nsmodel
{body}
"""


def start(body, folder):
    """Start a program that imports this module and runs ``body`` in ``folder``; return it when it is ready."""
    process = processes.start(DRIVER.format(body=textwrap.dedent(body)), folder)
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("build", MODELS[:5], ids=lambda build: build.__name__)
def test_a_killed_run_is_resumed_to_the_same_bytes(build, tmp_path, whole):
    """Killed after its second chunk, wherever it is then; another process goes on."""
    body = f"test_resume.slow_down(1e-3); test_resume.simulate(test_resume.{build.__name__}(), out='run')"
    kill_when_there(start(body, tmp_path), tmp_path / "run" / "chunk-000002.npz")
    assert not (tmp_path / "run" / "trajectory.npz").exists()
    simulate(build(), out=tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == whole(build)
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "manifest.json",
        "trajectory.npz",
    ]


def test_ctrl_c_never_cuts_a_step_in_two(tmp_path, monkeypatch):
    """The signal comes at any instruction of the loop: no row may be lost, none counted twice."""

    def build():
        return lure(f=None, gamma=1, t_end=200, step=0.01)

    def interrupt(number, frame):
        os.kill(os.getpid(), signal.SIGINT)

    simulate(build(), out=tmp_path / "whole")
    expected = (tmp_path / "whole" / "trajectory.npz").read_bytes()
    make, rng, stopped = schemes.make_stepper, np.random.default_rng(0), 0

    def armed(*args, **options):
        stepper, calls = make(*args, **options), []

        class Armed(type(stepper)):
            def __call__(self, *args):
                if not calls:
                    calls.append(1)
                    signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-3, 0.04))
                return super().__call__(*args)

        stepper.__class__ = Armed
        return stepper

    old = signal.signal(signal.SIGALRM, interrupt)
    try:
        for i in range(share(20, 10)):
            with monkeypatch.context() as patch:
                patch.setattr(schemes, "make_stepper", armed)
                try:
                    simulate(build(), out=tmp_path / str(i))
                except RunInterrupted as error:
                    stopped += len(error.trajectory) < 20000
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0)
            simulate(build(), out=tmp_path / str(i), resume=True)
            assert (tmp_path / str(i) / "trajectory.npz").read_bytes() == expected
    finally:
        signal.signal(signal.SIGALRM, old)
    assert stopped > 5


# runs that must not be continued


@pytest.mark.parametrize(
    ("model", "options", "what"),
    [
        ({"A": [[0, 1], [-2, 0]]}, {}, "another model"),
        ({"x0": [3, 0.1]}, {}, "another model"),
        ({"law": relay(1, -2, 2)}, {}, "another model"),
        ({"theta": 0.6}, {}, "another model"),
        ({"names": ["a", "b"]}, {}, "another model"),
        ({}, {"parameters": {"k": 2}}, "another model"),
        ({}, {"step": 0.025}, r"another step \(0\.05 there, 0\.025 now\)"),
        ({}, {"solver": "lemke"}, r"another solver \(auto there, lemke now\)"),
        ({}, {"tolerance": 1e-8}, r"another tolerance \(1e-09 there, 1e-08 now\)"),
        ({}, {"save_every": 2}, r"another save every \(1 there, 2 now\)"),
    ],
)
def test_another_run_is_not_continued(model, options, what, tmp_path):
    k = ca.SX.sym("k")
    declared = {"parameters": {k: 1}, "law": relay(1, -k, k)}
    simulate(lure(**declared), out=tmp_path, t_end=1)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(StorageError, match=f"{re.escape(str(tmp_path))}: the run there was made with {what}.*start afresh"):
        simulate(lure(**(declared | model)), out=tmp_path, resume=True, **options)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_other_versions_do_not_continue_a_run(tmp_path, monkeypatch):
    simulate(lure(), out=tmp_path, t_end=1)
    monkeypatch.setattr(ca, "__version__", "3.0.0")
    with pytest.raises(StorageError, match=r"made with another version of casadi \(3\.\d+\.\d+ there, 3\.0\.0 now\)"):
        simulate(lure(), out=tmp_path, resume=True)


def test_another_tolerance_function_is_another_model(tmp_path):
    simulate(inclusion(), out=tmp_path, t_end=3)
    with pytest.raises(StorageError, match=r"the run there was made with another model"):
        simulate(inclusion(tolerances=lambda h: h**2), out=tmp_path, resume=True)


def test_what_only_describes_a_run_may_change(tmp_path):
    simulate(lure(), out=tmp_path, t_end=1)
    run = simulate(lure(title="A new title", units={"t": "s"}), out=tmp_path, resume=True)
    assert (run.title, len(run)) == ("A new title", 200)


def test_a_shortened_step_is_no_time_of_a_longer_grid(tmp_path):
    """Once the run went on from t = 1 as if it were t = 1.2."""
    simulate(lure(step=0.3, t_end=1), out=tmp_path)
    with pytest.raises(StorageError, match=r"ended at t = 1 with a shortened step, which is no time of this run's grid"):
        simulate(lure(step=0.3, t_end=2), out=tmp_path, resume=True)
    same = simulate(lure(step=0.3, t_end=1), out=tmp_path, resume=True)
    np.testing.assert_allclose(same.t, [0, 0.3, 0.6, 0.9, 1.0])


def test_a_run_is_not_continued_to_an_earlier_end(tmp_path):
    simulate(lure(), out=tmp_path, t_end=2)
    with pytest.raises(StorageError, match=r"the run there has already reached t = 2, past this run's end; give a later end"):
        simulate(lure(), out=tmp_path, resume=True, t_end=1)


def test_nothing_to_resume(tmp_path):
    with pytest.raises(StorageError, match=r"nothing to resume in .*empty: no manifest\.json; start the run without resuming"):
        simulate(lure(), out=tmp_path / "empty", resume=True)
    assert not (tmp_path / "empty").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda manifest: "{", "is not a readable JSON file"),
        (lambda manifest: "[]", "is not a manifest; remove the folder, or give another, to start afresh"),
        (lambda manifest: json.dumps(manifest | {"format": "2"}), ": format is '2'; expected a whole number"),
        (lambda manifest: json.dumps(manifest | {"format": 1}), "is of format 1, written by nsmodel"),
        (lambda manifest: json.dumps(manifest | {"rows": 5}), "was changed after it was written; remove the folder"),
        (lambda manifest: json.dumps(manifest | {"chunks": [5]}), "was changed after it was written"),
        (lambda manifest: json.dumps({**manifest, "checkpoint": {}}), "was changed after it was written"),
        (lambda manifest: json.dumps({key: value for key, value in manifest.items() if key != "checkpoint"}), "was changed"),
    ],
)
def test_a_damaged_manifest_is_refused(damage, message, tmp_path):
    simulate(lure(), out=tmp_path, t_end=1)
    path = tmp_path / "manifest.json"
    path.write_text(damage(json.loads(path.read_text())))
    with pytest.raises(StorageError, match=rf"manifest\.json ?{message}"):
        simulate(lure(), out=tmp_path, resume=True)


def test_damaged_rows_are_refused(tmp_path):
    simulate(lure(), out=tmp_path, t_end=1)
    path = tmp_path / "trajectory.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StorageError, match=r"trajectory\.npz is not the file that manifest\.json lists"):
        simulate(lure(), out=tmp_path, resume=True)
    at = whole.index(np.float64(3.0).tobytes())  # x0, in the middle of the rows
    path.write_bytes(whole[:at] + b"\x01" + whole[at + 1 :])
    with pytest.raises(StorageError, match=r"trajectory\.npz is not the file that manifest\.json lists"):
        simulate(lure(), out=tmp_path, resume=True)


def test_exchanged_chunks_are_found_before_any_step(tmp_path, monkeypatch, small_chunks):
    with monkeypatch.context() as patch:
        stop_at(patch, 150, SystemExit())  # as if killed
        with pytest.raises(SystemExit):
            simulate(lure(), out=tmp_path)
    one, two, kept = (tmp_path / name for name in ("chunk-000001.npz", "chunk-000002.npz", "kept"))
    one.rename(kept)
    two.rename(one)
    kept.rename(two)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    stop_at(monkeypatch, 1, AssertionError("a step was taken"))
    with pytest.raises(StorageError, match=r"chunk-000001\.npz is not the file that manifest\.json lists: .* exchanged"):
        simulate(lure(), out=tmp_path, resume=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


# a disk that is full


def test_a_full_disk_leaves_whole_files_and_a_run_to_resume(tmp_path, monkeypatch, small_chunks, whole):
    sync, calls = os.fsync, []

    def full(descriptor):
        calls.append(1)
        if len(calls) == 5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StorageError, match=r"cannot write .*chunk-000003\.npz: .*No space left .*has room"):
            simulate(lure(), out=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chunk-000001.npz", "chunk-000002.npz", "manifest.json"]
    simulate(lure(), out=tmp_path, resume=True)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(lure)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of file size are POSIX")
def test_a_limit_of_file_size_is_met_by_a_message(tmp_path):
    body = """
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        try:
            test_resume.simulate(test_resume.lure(t_end=100), out="run")
        except nsmodel.StorageError as error:
            print(error)
    """
    printed, _ = start(body, tmp_path).communicate(timeout=60)
    assert re.search(r"cannot write .*: .*File too large; take a folder that is writable and has room", printed)
    assert not list((tmp_path / "run").glob(".*"))
    for path in (tmp_path / "run").glob("*.npz"):
        nsmodel.files.archive.read_npz(path)


# every n-th row


@every_model
@pytest.mark.parametrize("every", [3, 1000])
def test_every_nth_row_and_the_last_are_kept(build, every, tmp_path, small_chunks):
    full = simulate(build())
    some = simulate(build(), save_every=every, out=tmp_path)
    rows = [0, *range(every, 201, every)]
    rows += [] if rows[-1] == 200 else [200]
    for name, array in full.arrays.items():
        np.testing.assert_array_equal(some.arrays[name], array[rows], err_msg=name)
    for key in ("solver_counts", "steps"):
        assert some.metadata[key] == full.metadata[key]
    kept = ("worst_residual", "worst_residual_t", "newton", "newton_max", "index_set_changes", "steps")
    assert [some.metadata["totals"][key] for key in kept] == [full.metadata["totals"][key] for key in kept]
    for key in ("residual", "newton", "index_set_changes"):
        one, two = (run.summary()[key] for run in (some, full))
        assert one == two or {**one, "row": 0} == {**two, "row": 0}


def test_every_nth_row_survives_an_interrupt(tmp_path, monkeypatch, small_chunks, whole):
    with monkeypatch.context() as patch:
        stop_at(patch, 101, KeyboardInterrupt())
        with pytest.raises(RunInterrupted, match=r"interrupted"):
            simulate(lure(), out=tmp_path, save_every=3)
    simulate(lure(), out=tmp_path, save_every=3, resume=True)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole(lure, save_every=3)


@every_model
def test_the_totals_are_those_of_the_rows(build):
    run = simulate(build())
    totals, codes = run.metadata["totals"], run.index_set[1:]
    assert totals["index_set_changes"] == (codes[1:] != codes[:-1]).any(axis=1).sum()
    assert totals["worst_residual"] == np.nanmax(run.residual)
    assert totals["worst_residual"] == 0 or totals["worst_residual_t"] == run.t[np.nanargmax(run.residual)]
    assert totals["steps"] == len(run) == sum(run.metadata["solver_counts"].values())
    if "newton" in run.arrays:
        assert totals["newton"] == run.newton[1:].sum()
        assert totals["newton_max"] == run.newton[1:].max()


# rows that wait


@every_model
@pytest.mark.parametrize("every", [1, 7])
def test_rows_do_not_wait_long_for_a_chunk_to_fill(build, every, tmp_path, monkeypatch):
    simulate(build(), out=tmp_path / "whole", save_every=every)
    with monkeypatch.context() as patch:
        patch.setattr(loop, "CHUNK_SECONDS", 0.0)
        patch.setattr(loop, "MAX_STEPS_PER_CALL", 1)
        stop_at(patch, 100, SystemExit())  # as if killed: nothing is written at the end
        with pytest.raises(SystemExit):
            simulate(build(), out=tmp_path / "run", save_every=every)
    assert len(list((tmp_path / "run").glob("chunk-*.npz"))) == 99 // every + (every > 1)  # the start is a row too
    simulate(build(), out=tmp_path / "run", save_every=every, resume=True)
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == (tmp_path / "whole" / "trajectory.npz").read_bytes()


# memory


@pytest.mark.long
def test_memory_does_not_grow_with_the_number_of_steps(tmp_path):
    """400 000 steps, or half as many, take no more memory than a tenth of them; reading the result is left out."""
    most = 400 if COUNT == FULL else 200
    body = f"""
        import resource, sys
        test_resume.walk.CHUNK_BYTES = 1 << 20
        test_resume.loop.Trajectory.load = lambda path: None
        for end in ({most // 10}, {most}):
            model = nsmodel.LureSystem(A=[[-1]], B=1, C=1, law=nsmodel.relay(1, -0.5, 0.5), x0=1, t_end=end, step=1e-3)
            nsmodel.simulate(model, out=f"run{{end:g}}", compiled=False)
            print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    """
    short, long = map(int, start(body, tmp_path).communicate(timeout=300)[0].split())
    assert (tmp_path / f"run{most}" / "trajectory.npz").stat().st_size > 19e6 * most / 400
    assert long - short < 4e3  # kB


def test_a_run_too_long_for_memory_is_told_to_go_to_disk():
    with pytest.raises(
        nsmodel.UsageError, match=r"100000000000 steps do not fit in memory \(.* GiB\); give out=DIR \(--out DIR\)"
    ):
        simulate(lure(gamma=1), t_end=1e8, step=1e-3)


def test_an_exact_solution_that_fails_does_not_lose_the_run():
    def late(t):
        if np.max(t) > 0.5:
            raise ZeroDivisionError
        return np.zeros((np.size(t), 2))

    for exact in (late, lambda t: np.full((np.size(t), 2), np.nan)):
        run = simulate(lure(exact=exact), t_end=1)
        assert run.status == "done"
        assert run.metadata["totals"]["largest_error"] == np.inf
    with pytest.raises(nsmodel.UsageError, match=r"exact: it raised ZeroDivisionError at t = 0"):
        simulate(lure(exact=lambda t: 1 / 0))


def test_a_list_of_tolerances_must_cover_the_run():
    with pytest.raises(nsmodel.UsageError, match=r"tolerances: 3 values for \d+ steps; give one for each, or one for all"):
        simulate(inclusion(tolerances=[1e-3, 1e-4, 1e-5]))


def test_an_unfinished_run_is_not_overwritten(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, 20, KeyboardInterrupt())
        with pytest.raises(RunInterrupted):
            simulate(lure(), out=tmp_path)
    with pytest.raises(nsmodel.UsageError, match=r"holds an unfinished run, up to t = 0\.95; go on with resume=True"):
        simulate(lure(), out=tmp_path)
    assert simulate(lure(), out=tmp_path, resume=True).status == "done"
    assert simulate(lure(), out=tmp_path).status == "done"
