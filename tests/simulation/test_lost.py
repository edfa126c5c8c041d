"""Nothing that was computed is lost: not to a signal, a full disk, a lack of memory, numbers that overflow, an odd name."""

import errno
import importlib
import json
import os
import signal
import sys
import threading

import casadi as ca
import numpy as np
import pytest
from processes import before_step, fail

import nsmodel
from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    MonotoneInclusion,
    RunInterrupted,
    StepError,
    StorageError,
    SweepingProcess,
    Trajectory,
    ball,
    complementarity,
    relay,
    simulate,
)
from nsmodel.cli import main
from nsmodel.files.archive import read_npz
from nsmodel.files.storage import read_json

loop, walk = (importlib.import_module(f"nsmodel.simulation.{name}") for name in ("loop", "propagator"))
RELAY = """
from nsmodel import LureSystem, relay
model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=10, step=0.05)
"""


def lure(**other):
    return LureSystem(**({"A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "law": relay(1), "x0": [3, 0], "t_end": 10,
                          "step": 0.05} | other))  # fmt: skip


def bodies(f):
    """Four discs with the velocity f(i)."""
    discs = Bodies([[-1.5, 0.0], [1.5, 0.1], [0, 3.0], [0, -3.0]], r=[0.5] * 4)
    i, j = discs.member("i"), discs.member("j")
    pair = Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)
    return ManyBodies(bodies=discs, f=f(i), constraints={"pair": pair}, t_end=100, step=0.1)


def deliver(number):
    return lambda: os.kill(os.getpid(), number)


@pytest.fixture(name="full_disk")
def make_full_disk(monkeypatch):
    """Return full_disk(n): from the n-th file on nothing can be synced."""

    def full_disk(n):
        sync, calls = os.fsync, []

        def full(descriptor):
            calls.append(1)
            if len(calls) >= n:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            sync(descriptor)

        monkeypatch.setattr(os, "fsync", full)

    return full_disk


@pytest.fixture(name="in_folder")
def make_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.py").write_text(RELAY)
    return tmp_path


# signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_noted_between_steps(tmp_path, monkeypatch, number):
    mine = []
    usual = signal.signal(signal.SIGTERM, lambda *given: mine.append(given))
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    try:
        with monkeypatch.context() as patch:
            before_step(patch, 50, deliver(number))
            with pytest.raises(RunInterrupted, match=r"^interrupted at t = 2\.5$") as caught:
                simulate(lure(), out=tmp_path / "run")
        assert caught.value.signal == number
        assert len(caught.value.trajectory) == 50
        assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
        assert not mine
    finally:
        signal.signal(signal.SIGTERM, usual)
    simulate(lure(), out=tmp_path / "run", resume=True)
    simulate(lure(), out=tmp_path / "whole")
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == (tmp_path / "whole" / "trajectory.npz").read_bytes()


def test_a_run_under_error_control_ends_at_a_signal(monkeypatch):
    before_step(monkeypatch, 40, deliver(signal.SIGTERM))
    with pytest.raises(RunInterrupted) as caught:
        simulate(lure(), method="time-stepping", rtol=1e-4)
    assert len(caught.value.trajectory) > 10


def test_who_ignores_sigterm_goes_on_ignoring_it(monkeypatch):
    usual = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        before_step(monkeypatch, 50, deliver(signal.SIGTERM))
        assert simulate(lure()).status == "done"
    finally:
        signal.signal(signal.SIGTERM, usual)


def test_outside_the_main_thread_no_handler_is_touched(monkeypatch):
    seen, done = [], []
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    before_step(monkeypatch, 5, lambda: seen.append([signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]))
    thread = threading.Thread(target=lambda: done.append(simulate(lure())))
    thread.start()
    thread.join()
    assert done[0].status == "done"
    assert seen == [handlers]


@pytest.mark.parametrize("out", [True, False])
def test_sigterm_ends_a_command_with_143(in_folder, monkeypatch, capfd, out):
    before_step(monkeypatch, 50, deliver(signal.SIGTERM))
    usual = signal.getsignal(signal.SIGTERM)
    assert main(["run", "m.py", "--quiet", *(["--out", "results"] if out else [])]) == 143
    assert signal.getsignal(signal.SIGTERM) is usual
    folder = "results" if out else "m-run"
    saved = Trajectory.load(in_folder / folder / "trajectory.npz")
    assert (saved.status, len(saved)) == ("interrupted", 50)
    told = capfd.readouterr().err.splitlines()
    assert told[0] == "nsmodel: interrupted at t = 2.5"
    assert told[1].startswith(f"nsmodel: 50 verified steps are saved in {folder}/trajectory.npz")
    assert ("go on with --resume" in told[1]) is out


def test_sigterm_outside_a_run_ends_a_command_too(in_folder, capfd):
    (in_folder / "m.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\n" + RELAY)
    for command in ("run", "check", "study"):
        assert main([command, "m.py"]) == 143
        assert capfd.readouterr().err == "nsmodel: interrupted\n"


def test_sigterm_keeps_what_a_study_has_measured(in_folder, monkeypatch, capfd):
    before_step(monkeypatch, 500, deliver(signal.SIGTERM))
    assert main(["study", "m.py", "--steps", "0.1,0.05", "--solvers", "", "--budget", "5"]) == 143
    assert "nsmodel: interrupted; what was measured before is above" in capfd.readouterr().err


# disks


def test_rows_that_a_full_disk_does_not_take_are_given_to_the_caller(tmp_path, monkeypatch, full_disk):
    whole = simulate(lure())
    monkeypatch.setattr(walk, "CHUNK_BYTES", 1)
    full_disk(5)  # two chunks with their manifests, then no more
    with pytest.raises(StorageError, match=r"cannot write .*chunk-000003\.npz: .*No space left") as caught:
        simulate(lure(), out=tmp_path)
    run = caught.value.trajectory
    assert run.status == "failed"
    assert len(run.t) == 3 * 64
    for name, array in run.arrays.items():
        np.testing.assert_array_equal(array, whole.arrays[name][: 3 * 64], err_msg=name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chunk-000001.npz", "chunk-000002.npz", "manifest.json"]


@pytest.mark.parametrize("files", [1, 2, 3, 4])
def test_a_disk_that_is_full_at_the_end_costs_nothing(tmp_path, full_disk, monkeypatch, files):
    """The chunk, its manifest, the whole, the manifest of the whole."""
    whole = simulate(lure())
    with monkeypatch.context() as patch:
        sync = os.fsync
        full_disk(files)
        with pytest.raises(StorageError, match=r"No space left") as caught:
            simulate(lure(), out=tmp_path)
        patch.setattr(os, "fsync", sync)
    assert caught.value.trajectory.metadata == whole.metadata
    for name, array in caught.value.trajectory.arrays.items():
        np.testing.assert_array_equal(array, whole.arrays[name], err_msg=name)
    if files > 2:  # the rows are there
        monkeypatch.undo()
        assert simulate(lure(), out=tmp_path, resume=True).status == "done"


def test_many_bodies_and_error_control_give_their_rows_too(tmp_path, full_disk):
    for given in ({}, {"rtol": 1e-3}):
        model = lure() if given else bodies(lambda i: -i.q)
        full_disk(1)
        with pytest.raises(StorageError, match=r"No space left") as caught:
            simulate(model, out=tmp_path / f"{len(given)}", t_end=1, **given)
        assert caught.value.trajectory.t[-1] == pytest.approx(1)


def test_a_command_saves_elsewhere_what_its_folder_does_not_take(in_folder, monkeypatch, capfd):
    append = nsmodel.simulation.run_folder.ChunkStore.append

    def full(*arguments):
        raise StorageError("cannot write far/chunk-000001.npz: No space left on device")

    monkeypatch.setattr(nsmodel.simulation.run_folder.ChunkStore, "append", full)
    assert main(["run", "m.py", "--out", "far", "--quiet"]) == 5
    first, second = capfd.readouterr().err.splitlines()
    assert first == "nsmodel: storage error: cannot write far/chunk-000001.npz: No space left on device"
    assert second == "nsmodel: 200 verified steps are saved in m-run/trajectory.npz"
    assert len(Trajectory.load("m-run/trajectory.npz")) == 200
    assert append


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux")
def test_a_full_device_is_no_place_for_output(in_folder, capfd):
    """It is written to, not replaced; and the run, which nobody has seen, is saved."""
    assert main(["run", "m.py", "--csv", "/dev/full", "--quiet"]) == 5
    first, second = capfd.readouterr().err.splitlines()
    assert first == "nsmodel: the run is saved in m-run/trajectory.npz"
    assert second.startswith("nsmodel: storage error: cannot write /dev/full: ")
    assert len(Trajectory.load("m-run/trajectory.npz")) == 200
    assert os.stat("/dev/full").st_rdev == os.makedev(1, 7)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux")
@pytest.mark.parametrize("options", [[], ["--json"], ["m2.py"]])
def test_a_full_standard_output_is_told(in_folder, monkeypatch, capfd, options):
    (in_folder / "m2.py").write_text(RELAY)
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["run", "m.py", *options]) == 5
    told = capfd.readouterr().err.splitlines()
    assert "nsmodel: the run is saved in m-run/trajectory.npz" in told
    assert told[-1] == "nsmodel: error: cannot write the output: [Errno 28] No space left on device"
    assert len(Trajectory.load("m-run/trajectory.npz")) == 200


def test_a_file_that_cannot_be_written_is_found_before_the_run(in_folder, monkeypatch, capfd):
    before_step(monkeypatch, 1, fail(AssertionError("a step was taken")))
    assert main(["run", "m.py", "--csv", "m.py/run.csv"]) == 5
    assert capfd.readouterr().err.startswith("nsmodel: storage error: cannot write m.py/run.csv: ")


# memory, and faults


@pytest.mark.parametrize("out", [True, False])
def test_a_lack_of_memory_keeps_the_rows(in_folder, monkeypatch, capfd, out):
    before_step(monkeypatch, 50, fail(MemoryError("Unable to allocate 1 TiB")))
    assert main(["run", "m.py", "--quiet", *(["--out", "results"] if out else [])]) == 3
    first, second = capfd.readouterr().err.splitlines()
    assert first == (
        "nsmodel: error: step 49: no verified step from t = 2.45 to 2.5: not enough memory (Unable to allocate 1 TiB)"
    )
    folder = "results" if out else "m-run"
    assert second == f"nsmodel: 49 verified steps are saved in {folder}/trajectory.npz"
    assert len(Trajectory.load(f"{folder}/trajectory.npz")) == 49


def test_a_fault_of_the_program_stays_one_and_keeps_the_rows(tmp_path, monkeypatch):
    before_step(monkeypatch, 50, fail(TypeError("a fault")))
    with pytest.raises(TypeError, match=r"^a fault$"):
        simulate(lure(), out=tmp_path)
    run = Trajectory.load(tmp_path / "trajectory.npz")
    assert (len(run), run.status, run.metadata["message"]) == (49, "failed", "TypeError: a fault")


@pytest.mark.parametrize(
    "error",
    [np.linalg.LinAlgError("SVD did not converge"), OverflowError("too large"), RuntimeError("Factor is exactly singular")],
)
@pytest.mark.parametrize("options", [{}, {"rtol": 1e-3}])
def test_what_a_library_says_of_numbers_is_a_failed_step(monkeypatch, error, options):
    """Under error control a shorter step is tried first."""
    before_step(monkeypatch, 50, fail(error))
    if options:
        assert simulate(lure(), **options).status == "done"
        return
    with pytest.raises(StepError) as caught:
        simulate(lure())
    assert str(caught.value) == (
        f"step 49: no verified step from t = 2.45 to 2.5: its numbers cannot be computed with ({type(error).__name__}: {error})"
    )
    assert caught.value.__cause__ is error
    assert (caught.value.step, len(caught.value.trajectory)) == (49, 49)


# runs that diverge


def x(n):
    return ca.SX.sym("x", n)


def diverging():
    q, s, l = x(2), ca.SX.sym("s"), ca.SX.sym("l")
    yield "sweeping", SweepingProcess(q=q, f=1e6 * q, constraints={"d": ca.norm_2(q) - 1}, q0=[2, 1], t_end=100, step=0.1), "x"
    yield "oscillator", FrictionOscillator(
        x=q, potential=-100 * ca.sumsqr(q), friction=0.5 * s, s=s, x0=[1e150, 1e150], v0=[0, 1], t_end=100, step=0.1
    ), "x"  # fmt: skip
    yield "first order", FirstOrderSystem(
        x=q, lam=l, f=[1e6 * q[0], q[0] * q[1]], h=q[0] - 1, g=[l, 0], law=relay(1), x0=[1, 2], t_end=100, step=0.1, theta=0
    ), "x"  # fmt: skip
    yield "lure", LureSystem(
        A=[[1e6, 0], [0, 1]], B=np.eye(2), C=np.eye(2), law=ball(2, 1), x0=[-3, 1], t_end=100, step=0.1, theta=0
    ), "x"  # fmt: skip
    yield "inclusion", MonotoneInclusion(
        x=q, field=[1e6 * q[0], 0], phi=0.5 * ca.fabs(q[1]), constraints={"p": q[0] - 1}, x0=[2, -1], t_end=100, step=0.1
    ), "x"  # fmt: skip
    yield "bodies", bodies(lambda i: 100 * i.q), "body"
    yield "bodies at once", bodies(lambda i: 1e200 * i.q), "body"
    yield "bodies as cubes", bodies(lambda i: i.q * ca.sumsqr(i.q)), "body"


@pytest.mark.parametrize(("model", "who"), [pytest.param(m, who, id=name) for name, m, who in diverging()])
def test_a_run_that_diverges_says_who_and_when_and_keeps_its_rows(tmp_path, model, who):
    with pytest.raises(StepError, match=rf"^step \d+: .*The run has diverged: .*{who}.* = -?\S+$") as caught:
        simulate(model, out=tmp_path, compiled=False)
    error = caught.value
    assert error.time == pytest.approx((error.step + 1) * model.step)
    run = Trajectory.load(tmp_path / "trajectory.npz")
    assert (len(run), run.status) == (error.step, "failed")
    assert np.isfinite(run.x).all()
    assert not (tmp_path / "run.lock").exists()


def test_a_step_from_a_state_whose_problem_overflows_says_how_large_it_is():
    q, l = x(2), ca.SX.sym("l", 2)
    model = FirstOrderSystem(x=q, lam=l, f=-q, g=l, h=q - 1, law=complementarity(2), x0=[1e308, -1e308], t_end=1, step=0.1)
    words = r"the state, or what it gives, has grown to 1e\+308, beyond 1e\+100\. Best residual"
    with np.errstate(all="ignore"), pytest.raises(StepError, match=words):
        simulate(model, compiled=False)


def test_a_run_that_diverges_ends_a_command_with_3(in_folder, capfd):
    (in_folder / "m.py").write_text(
        "import casadi as ca\nfrom nsmodel import Bodies, Family, ManyBodies\n"
        "discs = Bodies([[-1.5, 0.0], [1.5, 0.1], [0, 3.0], [0, -3.0]], r=[0.5] * 4)\n"
        "i, j = discs.member('i'), discs.member('j')\n"
        "pair = Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)\n"
        "model = ManyBodies(bodies=discs, f=100 * i.q, constraints={'pair': pair}, t_end=100, step=0.1)\n"
    )
    assert main(["run", "m.py", "--out", "results", "--quiet"]) == 3
    first, second = capfd.readouterr().err.splitlines()
    assert "The run has diverged: q of body" in first
    assert second.endswith("verified steps are saved in results/trajectory.npz")


# names that are no text


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes there")
def test_a_file_whose_name_is_no_text(in_folder, capfd):
    name = os.fsdecode(b"re\xfflay.py")
    (in_folder / name).write_text(RELAY)
    for options in (["--out", "results"], ["--json"], ["--csv", "run.csv"]):
        assert main(["run", name, *options]) == 0
        printed, errors = capfd.readouterr()
        assert not errors
        assert "re\ufffdlay" in printed
    assert read_json("results/summary.json")["file"] == name
    assert json.loads((in_folder / "results" / "summary.json").read_text(encoding="utf-8"))["file"] == name


def test_names_that_are_no_text_are_kept(tmp_path):
    """In a title, in units: escaped as JSON does it."""
    simulate(lure(title="a\udcff", units={"t": "\ud800s"}), t_end=1, out=tmp_path)
    _, metadata = read_npz(tmp_path / "trajectory.npz")
    assert (metadata["title"], metadata["units"]) == ("a\udcff", {"t": "\ud800s"})
    assert simulate(lure(title="a\udcff"), out=tmp_path, resume=True).status == "done"
