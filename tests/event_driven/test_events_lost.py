"""Nothing of an event-driven run is lost to a signal or a full disk; bad input is told in clear words on the command line."""

import errno
import os
import signal
from pathlib import Path

import numpy as np
import pytest

import nsmodel
from nsmodel import RunInterrupted, StorageError, Trajectory, simulate
from nsmodel.cli import main
from nsmodel.event_driven.integrator import Integrator
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation import loop

CASE = str(case_files()["diode_bridge"])


@pytest.fixture(name="model")
def make_model():
    return nsmodel.load(CASE)


def before_piece(monkeypatch, count, act):
    """``act`` before piece number ``count`` of the next run."""
    whole, calls = Integrator.advance, []

    def advance(self):
        calls.append(1)
        if len(calls) == count:
            act()
        return whole(self)

    monkeypatch.setattr(Integrator, "advance", advance)


def run(model, out=None, **more):
    return simulate(model, rtol=1e-8, method="event-driven", out=out, **more)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("at", [2, 13, 31])
def test_a_signal_is_noted_between_pieces_and_the_run_goes_on_to_the_same_bytes(model, tmp_path, monkeypatch, number, at):
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patch:
        before_piece(patch, at, lambda: os.kill(os.getpid(), number))
        with pytest.raises(RunInterrupted, match=r"^interrupted at t = ") as caught:
            run(model, tmp_path / "parts")
    assert caught.value.signal == number
    assert caught.value.trajectory.is_event_driven
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    whole = run(model, tmp_path / "one")
    assert 0 < len(caught.value.trajectory) < len(whole)
    rows = caught.value.trajectory.x
    np.testing.assert_array_equal(rows, whole.x[: len(rows)])
    run(model, tmp_path / "parts", resume=True)
    assert (tmp_path / "parts" / "trajectory.npz").read_bytes() == (tmp_path / "one" / "trajectory.npz").read_bytes()


@pytest.mark.parametrize("files", [1, 2, 5, 8])
def test_a_full_disk_leaves_whole_files_and_a_run_to_resume(model, tmp_path, monkeypatch, files):
    sync, calls = os.fsync, []

    def full(descriptor):
        calls.append(1)
        if len(calls) >= files:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    whole = run(model, tmp_path / "one")
    monkeypatch.setattr(loop, "CHUNK_SECONDS", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StorageError, match="No space left") as caught:
            run(model, tmp_path / "parts")
    rows = caught.value.trajectory.x
    np.testing.assert_array_equal(rows, whole.x[: len(rows)])
    there = (tmp_path / "parts" / "manifest.json").exists()
    run(model, tmp_path / "parts", resume=there)
    assert (tmp_path / "parts" / "trajectory.npz").read_bytes() == (tmp_path / "one" / "trajectory.npz").read_bytes()


def test_sigterm_ends_a_command_with_143_and_saves_the_rows(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    before_piece(monkeypatch, 20, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert main(["run", CASE, "--rtol", "1e-8", "--quiet", "--out", "results"]) == 143
    saved = Trajectory.load(tmp_path / "results" / "trajectory.npz")
    assert saved.status == "interrupted"
    assert saved.is_event_driven
    assert "go on with --resume" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rtol", "1e-15"], "rtol = 1e-15; expected a number between 1e-14 and 1: doubles hold no more than 16 digits"),
        (["--rtol", "0"], "expected a number between 1e-14 and 1"),
        (["--rtol", "nan"], "expected a number between 1e-14 and 1"),
        (["--rtol", "1e-6", "--method", "events"], "auto, event-driven, time-stepping|'auto', 'event-driven', 'time-stepping'"),
        (["--method", "event-driven"], "needs rtol"),
        (["--rtol", "1e-6", "--step", "1e-3"], "step and rtol are both given"),
        (["--rtol", "1e-6", "--solver", "lemke"], "solver 'lemke' and rtol are both given"),
        (["--rtol", "1e-6", "--atol=-1"], "atol"),
        (["--rtol", "1e-6", "--certify", "proof"], "estimate, interval|'estimate', 'interval'"),
        (["--rtol", "1e-6", "--certify", "interval", "--method", "time-stepping"], "proves the pieces of an event-driven run"),
    ],
)
def test_bad_input_on_the_command_line(tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(["run", CASE, "--quiet", *arguments])
    except SystemExit as stop:  # of argparse
        status = stop.code
    told = capfd.readouterr().err
    assert status == 2
    assert any(part in told for part in words.split("|")), told
    assert "Traceback" not in told


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ball(2)", "in the law 'ball': its y depends on l directly"),
        ("second_order_cone(2)", "has other modes than stick and slip; its sets are for time stepping"),
    ],
)
def test_laws_that_it_cannot_take_are_named_on_the_command_line(tmp_path, monkeypatch, capfd, text, words):
    monkeypatch.chdir(tmp_path)
    lines = (
        "from nsmodel import *", f"law = {text}",
        "model = LureSystem(A=[[-1, 0], [0, -1]], B=[[1, 0], [0, 1]], C=[[1, 0], [0, 1]], D=[[1, 0], [0, 1]], law=law,",
        "    x0=[1, 1], t_end=1, step=0.1)",
    )  # fmt: skip
    Path("m.py").write_text("\n".join(lines))
    assert main(["run", "m.py", "--rtol", "1e-4", "--method", "event-driven", "--quiet"]) == 2
    told = capfd.readouterr().err
    assert "not event-driven" in told
    assert words in told
    assert main(["run", "m.py", "--rtol", "1e-4", "--quiet"]) == 0
