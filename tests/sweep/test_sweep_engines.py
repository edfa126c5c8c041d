"""Who computes a sweep has no influence on it, and what a worker takes with it is computed again."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from conftest import REPOSITORY
from sweep_models import friction, with_stop

from nsmodel import UsageError, sweep
from nsmodel.sweep import executor

GRID = {"k": np.linspace(0.8, 1.2, 24)}


def end_of(run):
    return float(run.x[-1, 0])


def deadly(run):
    if run.metadata["parameters"]["k"] > 1.19:
        os._exit(9)
    return end_of(run)


def once_deadly(run):
    path = os.environ["NSMODEL_TEST_MARK"]
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return end_of(run)
    os.kill(os.getpid(), signal.SIGKILL)
    return None


def swept(**options):
    return sweep(friction(t_end=1.0), **({"grid": GRID, "outputs": {"end": end_of}} | options))


@pytest.fixture(scope="module")
def alone():
    return swept(workers=1)


@pytest.mark.parametrize("workers", [2, "threads", "processes"])
def test_engines_agree_to_the_bit(workers, alone):
    if workers == "threads":
        with ThreadPoolExecutor(2) as engine:
            found = swept(workers=engine, outputs={"end": "x_1[-1]"})
    elif workers == "processes":
        with ProcessPoolExecutor(2) as engine:
            found = swept(workers=engine)
    else:
        found = swept(workers=workers)
    np.testing.assert_array_equal(found["end"].values, alone["end"].values)
    assert ("2 processes" if workers == 2 else "Executor, 2 at once") in found.plan


def test_a_function_without_a_name_needs_a_process_that_has_it(alone):
    found = swept(workers=2, outputs={"end": lambda run: run.x[-1, 0]})
    np.testing.assert_array_equal(found["end"].values, alone["end"].values)
    with ProcessPoolExecutor(1) as engine, pytest.raises(UsageError, match="output 'end' cannot go to other processes"):
        swept(workers=engine, outputs={"end": lambda run: run.x[-1, 0]})


def test_a_worker_that_dies_costs_nothing(tmp_path, monkeypatch, alone):
    monkeypatch.setenv("NSMODEL_TEST_MARK", str(tmp_path / "mark"))
    found = swept(workers=2, outputs={"end": once_deadly}, out=tmp_path / "a")
    np.testing.assert_array_equal(found["end"].values, alone["end"].values)
    assert (tmp_path / "mark").exists()


def test_a_cell_that_kills_its_workers_is_a_failed_cell(monkeypatch, alone):
    monkeypatch.setattr(executor, "TARGET_CHUNK_SECONDS", 1.0)
    found = swept(workers=2, outputs={"end": deadly})
    np.testing.assert_array_equal(found.status, [0] * 23 + [1])
    np.testing.assert_array_equal(found["end"].values[:23], alone["end"].values[:23])
    assert "the process that ran it died 3 times" in found.messages[23]


def test_workers_end_with_who_made_them(tmp_path):
    script = tmp_path / "go.py"
    script.write_text(textwrap.dedent(f"""
        import os, sys, time; sys.path.insert(0, {str(REPOSITORY / "tests")!r})
        from sweep_models import friction
        import nsmodel
        def slow(run):
            open(os.path.join({str(tmp_path)!r}, f"{{os.getpid()}}.pid"), "w").close()
            time.sleep(0.2)
            return 1.0
        nsmodel.sweep(friction(t_end=0.1), grid={{"k": list(range(1, 400))}}, outputs={{"end": slow}}, workers=2)
    """))  # fmt: skip
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen([sys.executable, script], env=environment) as process:
        while process.poll() is None and len(list(tmp_path.glob("*.pid"))) < 2:
            threading.Event().wait(0.05)
        process.kill()
    pids = [int(path.stem) for path in tmp_path.glob("*.pid")]
    assert len(pids) == 2
    for _ in range(100):
        threading.Event().wait(0.1)
        if not any(os.path.exists(f"/proc/{pid}/cmdline") and state(pid) != "Z" for pid in pids):
            return
    raise AssertionError(f"workers are still there: {pids}")


def state(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


class Lossy:
    """An engine that loses every third chunk once, and gives the others back in another order."""

    def __init__(self):
        self.sent, self.waiting, self._max_workers = 0, [], 3

    def submit(self, function, *arguments):
        self.sent += 1
        future, (_, _, attempt, *_) = Future(), arguments
        self.waiting.append((future, function, arguments, self.sent % 3 == 0 and not attempt))
        if len(self.waiting) == 3:
            threading.Thread(target=self.give_back).start()
        else:
            threading.Timer(0.1, self.give_back).start()
        return future

    def give_back(self):
        while self.waiting:
            try:
                future, function, arguments, lost = self.waiting.pop()
            except IndexError:
                return
            if lost:
                future.set_exception(ConnectionError("the cable was pulled"))
            else:
                future.set_result(function(*arguments))


def test_what_an_engine_loses_is_sent_again(alone):
    engine = Lossy()
    found = swept(workers=engine)
    assert (found.status == 0).all()
    np.testing.assert_array_equal(found["end"].values, alone["end"].values)
    assert engine.sent > 3


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster(tmp_path, alone):
    distributed = pytest.importorskip("distributed")
    monitored = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        silence_logs=50,
        local_directory=tmp_path / "dask",
    )
    with monitored as cluster, distributed.Client(cluster) as client:
        assert client.scheduler_info()["address"].startswith("tcp://")
        found = swept(workers=client, outputs={"end": lambda run: run.x[-1, 0]}, out=tmp_path / "a")
        np.testing.assert_array_equal(found["end"].values, alone["end"].values)
        assert "distributed.Client, 2 at once" in found.plan


def test_failures_come_home_from_processes():
    found = sweep(with_stop(), grid={"a": [0.5, 0.8]}, outputs={"end": end_of}, workers=2)
    np.testing.assert_array_equal(found.status, [0, 1])
    assert "leave no point" in found.messages[1]
