"""Who computes: this process, its threads, processes of its own, or whatever has ``submit``."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any, Protocol

from nsmodel.errors import UsageError
from nsmodel.grid import is_number, written
from nsmodel.sweep.asked import Asked, Found
from nsmodel.sweep.cells import Stop, Task, run_chunk

MOST = 61 if sys.platform == "win32" else 1 << 20  # Processes in a pool: Windows waits for no more at once.
WATCH = 1.0  # Seconds between two looks of a worker at whether its parent is alive.
_inherited: dict[int, Asked] = {}  # What sweeps ask for, for workers that are forked: functions without names go no other way.


class Engine(Protocol):
    """``submit`` returns a future of (found, seconds).

    Attributes:
        workers: how many chunks are computed at once; window: how many are out.
        words: who computes.
    """

    workers: int
    window: int
    words: str

    def submit(self, tasks: Sequence[Task], attempt: int) -> Any:
        """Begin a chunk."""
        ...

    def close(self, *, wait: bool) -> None:
        """End; what has begun is waited for, or left."""
        ...


def timed(asked: Asked | int, tasks: Sequence[Task], attempt: int = 0, stop: Stop | None = None) -> tuple[Found, float]:
    """A chunk and the seconds it took; ``asked`` may be the number under which a forked worker has it."""
    del attempt  # tells engines that keep results by their arguments that this is another one
    began = time.perf_counter()
    found = run_chunk(_inherited[asked] if isinstance(asked, int) else asked, tasks, *([] if stop is None else [stop]))
    return found, time.perf_counter() - began


class InTurn:
    """One chunk after the other, here."""

    workers, window, words = 1, 1, "in this process"

    def __init__(self, asked: Asked, stop: Stop) -> None:
        self._asked, self._stop = asked, stop

    def submit(self, tasks: Sequence[Task], attempt: int) -> Future:
        """Compute it now."""
        future: Future = Future()
        try:
            future.set_result(timed(self._asked, tasks, attempt, self._stop))
        except Exception as error:
            future.set_exception(error)
        return future

    def close(self, *, wait: bool) -> None:
        """Nothing is left."""


class Threads:
    """Threads of this process: for C, which runs without Python's lock."""

    def __init__(self, asked: Asked, stop: Stop, workers: int) -> None:
        self._asked, self._stop, self.workers = asked, stop, workers
        self.words, self.window = f"{workers} threads", workers + 1
        self._pool = ThreadPoolExecutor(workers)

    def submit(self, tasks: Sequence[Task], attempt: int) -> Any:
        """Begin a chunk."""
        return self._pool.submit(timed, self._asked, tasks, attempt, self._stop)

    def close(self, *, wait: bool) -> None:
        """End the threads."""
        self._pool.shutdown(wait=True, cancel_futures=not wait)


class Processes:
    """Processes of this machine. Ctrl-C is this process's own: they end what they do, and go when it is gone."""

    def __init__(self, asked: Asked, workers: int) -> None:
        workers = min(workers, MOST)
        self.workers, self.window, self.words, self._asked = workers, workers + 1, f"{workers} processes", asked
        self._forks = forks()
        self._context = multiprocessing.get_context("fork" if self._forks else "spawn")
        self._given: Asked | int = asked
        if self._forks:
            self._given = id(asked)
            _inherited[id(asked)] = asked
        else:
            portable(asked)
        self._pool = self._made()

    def _made(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self.workers, self._context, initializer=_begin, initargs=(os.getpid(), self._forks))

    def submit(self, tasks: Sequence[Task], attempt: int) -> Any:
        """Begin a chunk; in new processes where one of the old has died."""
        try:
            return self._pool.submit(timed, self._given, tasks, attempt)
        except BrokenExecutor:
            self._pool.shutdown(wait=False)
            self._pool = self._made()
            return self._pool.submit(timed, self._given, tasks, attempt)

    def close(self, *, wait: bool) -> None:
        """End the processes."""
        self._pool.shutdown(wait=wait, cancel_futures=True)
        _inherited.pop(id(self._asked), None)


class Given:
    """An engine of the user's: a Dask ``Client``, an ``Executor``."""

    def __init__(self, asked: Asked, engine: Any) -> None:
        self._asked, self._engine = asked, engine
        self.workers = _size(engine)
        self.window = 2 * self.workers
        self.words = f"{type(engine).__module__.partition('.')[0]}.{type(engine).__name__}, {self.workers} at once"
        if isinstance(engine, ProcessPoolExecutor):
            portable(asked)

    def submit(self, tasks: Sequence[Task], attempt: int) -> Any:
        """Begin a chunk."""
        return self._engine.submit(timed, self._asked, list(tasks), attempt)

    def close(self, *, wait: bool) -> None:
        """It is the user's."""


def engine_of(workers: Any, asked: Asked, stop: Stop, *, threads: bool, chunks: int) -> Engine:
    """Return who computes: ``workers`` None: as many as there are cores, threads or processes; a number; an engine.

    Raises:
        UsageError: none of these.
    """
    refuse_workers(workers)
    if hasattr(workers, "submit"):
        return Given(asked, workers)
    count = min(cores() if workers is None else int(workers), max(chunks, 1))
    if count == 1:
        return InTurn(asked, stop)
    return Threads(asked, stop, count) if threads else Processes(asked, count)


def refuse_workers(workers: Any) -> None:
    """Raise UsageError for what cannot compute."""
    if not (
        workers is None or hasattr(workers, "submit") or (is_number(workers) and workers >= 1 and float(workers).is_integer())
    ):
        raise UsageError(
            f"workers = {written(workers)}; expected a whole number >= 1, or an engine with submit(), such as a Dask Client or "
            "an Executor"
        )


def forks() -> bool:
    """Whether workers are copies of this process: not on Windows, nor on macOS, whose libraries do not survive it."""
    return sys.platform != "darwin" and "fork" in multiprocessing.get_all_start_methods()


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def portable(asked: Asked) -> None:
    """Refuse what cannot go to another process."""
    for name, function in asked.outputs.items():
        try:
            pickle.dumps(function)
        except Exception as error:
            raise UsageError(
                f"output '{name}' cannot go to other processes ({error}); define it with def at the top level of a module, give "
                "a text such as 'x1[-1]', or take workers=1"
            ) from error


def lost(error: BaseException) -> bool:
    """Whether a chunk failed because who computed it is gone, not because of what it is."""
    gone = isinstance(error, BrokenExecutor | CancelledError | ConnectionError | EOFError)
    return gone or type(error).__name__ in ("KilledWorker", "CommClosedError", "TerminatedWorkerError", "FutureCancelledError")


def _size(engine: Any) -> int:
    """How many chunks an engine computes at once."""
    for name in ("_max_workers", "nthreads"):
        number: Any = getattr(engine, name, None)
        if is_number(number):
            return int(number)
        if callable(number):
            found: Any = number()
            return max(1, sum(found.values()) if hasattr(found, "values") else int(found))
    return cores()


def _begin(parent: int, forked: bool) -> None:
    """In a new worker: signals of the terminal are for its parent, with which it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if hasattr(os, "setpgrp"):
        os.setpgrp()

    def watch() -> None:
        above = multiprocessing.parent_process()
        while os.getppid() == parent and (forked or above is None or above.is_alive()):  # Windows keeps the number of the dead.
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
