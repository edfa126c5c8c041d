"""One run at a time writes into a folder, and several programs may write one file."""

import json
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading

import numpy as np
import processes
import pytest
from conftest import REPOSITORY

from nsmodel import LureSystem, StepError, StorageError, UsageError, relay, simulate
from nsmodel.cli import main
from nsmodel.files.archive import read_npz, write_npz
from nsmodel.simulation import run_folder

HOST = socket.gethostname()
SLOW = """
import time, nsmodel
t0 = None
def build():
    return nsmodel.LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=nsmodel.relay(1), x0=[3, 0], t_end=1e4, step=1e-3)
print("ready", flush=True)
nsmodel.simulate(build(), out="run", compiled=False)
"""


def model(**other):
    return LureSystem(**({"A": [[-1]], "B": 1, "C": 1, "law": relay(1), "x0": 1, "t_end": 1, "step": 0.1} | other))


def write_lock(folder, **holder):
    folder.mkdir(exist_ok=True)
    (folder / run_folder.LOCK_FILE).write_text(json.dumps(holder))


def dead():
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def elsewhere(action):
    """Do something in another thread, and return what it raised."""
    raised = []

    def act():
        try:
            action()
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=act)
    thread.start()
    thread.join()
    return raised[0] if raised else None


def hold(folder):
    with run_folder.hold_folder(folder):
        pass


def test_a_folder_is_held_by_one(tmp_path):
    with run_folder.hold_folder(tmp_path):
        assert json.loads((tmp_path / run_folder.LOCK_FILE).read_text()).items() >= {"host": HOST, "pid": os.getpid()}.items()
        with run_folder.hold_folder(tmp_path):  # the same thread
            pass
        error = elsewhere(lambda: simulate(model(), out=tmp_path))
        assert isinstance(error, StorageError)
        assert str(error) == (
            f"{tmp_path} is in use by another run, process {os.getpid()} on {HOST}; wait for its end, or give another folder"
        )
    assert elsewhere(lambda: hold(tmp_path)) is None
    assert not list(tmp_path.iterdir())


def test_what_a_killed_run_left_is_taken_over(tmp_path):
    write_lock(tmp_path, host=HOST, pid=dead(), boot="")
    (tmp_path / ".part-12345678-chunk-000001.npz").write_bytes(b"half")
    assert simulate(model(), out=tmp_path).status == "done"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "trajectory.npz"]


def test_a_lock_cut_short_is_taken_over(tmp_path):
    (tmp_path / run_folder.LOCK_FILE).write_text('{"host')
    assert simulate(model(), out=tmp_path).status == "done"


def test_a_container_of_another_name_on_this_machine_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "_boot_id", lambda: "this one")
    write_lock(tmp_path, host="container", pid=1, boot="this one")
    assert simulate(model(), out=tmp_path).status == "done"


@pytest.mark.parametrize("boot", ["another", ""])
def test_of_another_host_nothing_is_known(tmp_path, boot):
    write_lock(tmp_path, host="far.example", pid=dead(), boot=boot)
    before = (tmp_path / run_folder.LOCK_FILE).read_bytes()
    with pytest.raises(StorageError, match=r"process \d+ on far\.example, as far as can be told .* has ended, delete .*lock"):
        simulate(model(), out=tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {run_folder.LOCK_FILE: before}


@pytest.mark.parametrize("known", [None, "no locks here"])
def test_where_files_cannot_be_locked_a_lock_is_never_taken_over(tmp_path, monkeypatch, known):
    def refuse(*arguments):
        raise OSError(95, known)

    monkeypatch.setattr(run_folder, "fcntl", known and type("Module", (), {"flock": refuse, "LOCK_EX": 2, "LOCK_NB": 4}))
    assert simulate(model(), out=tmp_path).status == "done"
    with run_folder.hold_folder(tmp_path):
        assert "as far as can be told" in str(elsewhere(lambda: hold(tmp_path)))
    write_lock(tmp_path, host=HOST, pid=dead(), boot="")
    with pytest.raises(StorageError, match=r"if that run has ended, delete .*run\.lock"):
        simulate(model(), out=tmp_path)


def test_of_many_that_find_a_stale_lock_one_takes_it(tmp_path):
    inside, most, taken = [], [], []
    rounds, gone = 40, dead()

    def contend(barrier):
        barrier.wait()
        try:
            with run_folder.hold_folder(tmp_path):
                inside.append(1)
                most.append(len(inside))
                taken.append(1)
                inside.pop()
        except StorageError:
            pass

    for _ in range(rounds):
        write_lock(tmp_path, host=HOST, pid=gone, boot="")
        barrier = threading.Barrier(6)
        threads = [threading.Thread(target=contend, args=(barrier,)) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert max(most) == 1
    assert len(taken) >= rounds
    assert not list(tmp_path.iterdir())


def test_a_run_of_another_process_is_not_disturbed(tmp_path, monkeypatch, capfd):
    """Refused while it lives; killed, it is taken over, and resumed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.py").write_text(
        "from nsmodel import LureSystem, relay\nmodel = LureSystem(A=[[-1]], B=1, C=1, law=relay(1), x0=1, t_end=1, step=0.1)\n"
    )
    process = processes.start(SLOW, tmp_path)
    try:
        assert process.stdout.readline() == "ready\n"
        while not (
            (tmp_path / "run" / run_folder.LOCK_FILE).exists() and (tmp_path / "run" / run_folder.LOCK_FILE).stat().st_size
        ):
            assert process.poll() is None
        assert main(["run", "m.py", "--out", "run"]) == 5
        captured = capfd.readouterr()
        assert captured.err.startswith(f"nsmodel: storage error: run is in use by another run, process {process.pid} on {HOST}")
        assert captured.err.count("\n") == 1
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert (tmp_path / "run" / run_folder.LOCK_FILE).exists()
    assert main(["run", "m.py", "--out", "run", "--quiet"]) == 0
    assert not (tmp_path / "run" / run_folder.LOCK_FILE).exists()


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"solver": "none"}, UsageError),
        ({"resume": True}, StorageError),
        ({"tolerance": 2}, UsageError),
        ({"parameters": {"k": 1}}, UsageError),
    ],
)
def test_a_run_that_is_refused_leaves_nothing(tmp_path, wrong, error):
    with pytest.raises(error):
        simulate(model(), out=tmp_path / "run", **wrong)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("error", [StepError("a step"), KeyboardInterrupt(), SystemExit(), MemoryError(), TypeError("a fault")])
def test_the_lock_goes_however_the_run_ends(tmp_path, monkeypatch, error):
    make = sys.modules["nsmodel.simulation.fixed_grid"].make_stepper

    def broken(*args, **options):
        stepper = make(*args, **options)

        class Broken(type(stepper)):
            def __call__(self, *args):
                raise error

        stepper.__class__ = Broken
        return stepper

    monkeypatch.setattr(sys.modules["nsmodel.simulation.fixed_grid"], "make_stepper", broken)
    with pytest.raises((StepError, KeyboardInterrupt, SystemExit, TypeError)):
        simulate(model(), out=tmp_path)
    assert not (tmp_path / run_folder.LOCK_FILE).exists()


def test_many_write_one_file_and_it_is_always_whole(tmp_path):
    path, errors = tmp_path / "run.npz", []
    contents = [np.full(2000 * (k + 1), float(k)) for k in range(4)]
    write_npz(path, {"t": contents[0]}, {"k": 0})

    def write(k):
        try:
            for _ in range(15):
                write_npz(path, {"t": contents[k]}, {"k": k})
                arrays, metadata = read_npz(path)
                np.testing.assert_array_equal(arrays["t"], contents[metadata["k"]])
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert [file.name for file in tmp_path.iterdir()] == ["run.npz"]


def test_a_process_that_was_forked_holds_nothing(tmp_path):
    code = textwrap.dedent("""
        import os, signal, sys, time
        from pathlib import Path
        from nsmodel.simulation import run_folder as lock
        with lock.hold_folder(Path(sys.argv[1])):
            child = os.fork()
            if child == 0:
                os.close(1)
                time.sleep(60)
                os._exit(0)
            print(child, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
    """)
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a"], env=environment, stdout=subprocess.PIPE, text=True, check=False
    )
    child = int(done.stdout)
    try:
        with run_folder.hold_folder(tmp_path / "a"):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
