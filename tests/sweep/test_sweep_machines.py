"""A scheduler and workers that are started by hand, as on many machines: they talk by TCP, and one is killed in mid-sweep."""

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from conftest import REPOSITORY
from sweep_models import stopped

from nsmodel import Sweep, sweep

pytest.importorskip("distributed")
PAGE = (REPOSITORY / "docs" / "sweeps.md").read_text()
WAIT = 120.0  # Seconds, for a busy machine.


def fenced(words):
    """The block of the page whose fence begins with these words, and that speaks to a cluster or is a file."""
    found = re.findall(rf"^```{words}\n((?:.*\n)*?)```$", PAGE, re.MULTILINE)
    return next(block for block in found if "jobqueue" not in block)


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@contextmanager
def started(arguments, folder, name):
    """A process in a group of its own, with its log in a file; the group is ended in the end."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "DASK_DISTRIBUTED__DASHBOARD__LINK": ""}
    with (folder / f"{name}.log").open("w") as log:
        command = [sys.executable, *map(str, arguments)]
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            yield process
        finally:
            end(process)


def end(process):
    """Kill a process with what it has started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()


def until(condition, process, what):
    for _ in range(int(WAIT / 0.05)):
        if condition():
            return
        assert process.poll() is None, f"{what}: it ended"
        threading.Event().wait(0.05)
    raise AssertionError(what)


def test_a_sweep_on_workers_of_which_one_is_killed(tmp_path):
    address = f"tcp://127.0.0.1:{free_port()}"
    (tmp_path / "friction.py").write_text(fenced(r"python model-file friction\.py"))
    text = fenced("py").replace("tcp://head:8786", address)
    assert "1.5, 40)" in text
    (tmp_path / "script.py").write_text(text.replace("1.5, 40)", "1.5, 160)"))  # It lasts until the worker is killed.
    (tmp_path / "scratch").mkdir()
    with ExitStack() as stack:
        begun = ["-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2], "--no-dashboard"]
        stack.enter_context(started(begun, tmp_path, "scheduler"))
        one = ["-m", "dask", "worker", address, "--nworkers", "1", "--nthreads", "1", "--no-dashboard", "--local-directory"]
        workers = [stack.enter_context(started([*one, tmp_path / "scratch"], tmp_path, f"worker{i}")) for i in range(2)]
        for i, worker in enumerate(workers):
            log = tmp_path / f"worker{i}.log"
            until(lambda log=log: "Registered to" in log.read_text(), worker, f"worker {i}: {log.read_text()}")
        script = stack.enter_context(started(["script.py"], tmp_path, "script"))
        until(lambda: len(list(tmp_path.glob("springs/part-*.npz"))) >= 2, script, "the first cells")
        end(workers[0])
        assert not (tmp_path / "springs" / "sweep.npz").exists()
        assert script.wait(WAIT) == 0, (tmp_path / "script.log").read_text()
    found = Sweep.load(tmp_path / "springs")
    assert (found.status == 0).all()
    a, k = (axis.ravel() for axis in np.meshgrid(found.coords["a"], found.coords["k"], indexing="ij"))
    error = np.abs(found["rest"].values.ravel() - stopped(a, k, 5.3)[0])
    assert np.median(error) < 1e-3
    assert "done            480 of 480" in (tmp_path / "script.log").read_text()
    grid = {"a": np.linspace(0.5, 1.5, 160), "k": [0.8, 1.0, 1.2]}
    sweep(tmp_path / "friction.py", grid=grid, outputs={"rest": "x1[-1]"}, workers=1, out=tmp_path / "here")
    assert (tmp_path / "here" / "sweep.npz").read_bytes() == (tmp_path / "springs" / "sweep.npz").read_bytes()
