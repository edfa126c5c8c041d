"""Who computes: this process, its threads, processes of its own, or whatever has ``submit``.

The work of a sweep: chunks of cells go out, come back, and are kept; what is lost is done again.

Threads run C (which runs without Python's lock), forked processes the rest: they have functions without names by inheritance,
and end with their parent. A user's engine gets pickled groups and arrays, no file. The coordinator is the only writer. A chunk
whose worker is gone goes out once more, alone; then its cells one by one; a cell that is lost then is a failed cell. Chunks are
as long as 0.3 s; nothing of them shows in the end. Signals are noted by the coordinator; C calls look at them every 0.05 s,
other cells are waited for.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.errors import UsageError
from nsmodel.modeling.time_grid import format_value, is_number
from nsmodel.simulation.loop import PendingSignals, RunInterrupted, progress_bar
from nsmodel.sweep.cells import CellTask, StopCheck, failed_cells, never_stop, run_chunk
from nsmodel.sweep.request import CellResults, SweepRequest
from nsmodel.sweep.variable import CELL_FAILED

MAX_PROCESSES = 61 if sys.platform == "win32" else 1 << 20  # Processes in a pool: Windows waits for no more at once.
PARENT_CHECK_SECONDS = 1.0  # Seconds between two looks of a worker at whether its parent is alive: so long it may outlive it.
_forked_requests: dict[
    int, SweepRequest
] = {}  # What sweeps ask for, for workers that are forked: functions without names go no other way.


def run_timed_chunk(
    request: SweepRequest | int, tasks: Sequence[CellTask], attempt: int = 0, stop: StopCheck | None = None
) -> tuple[CellResults, float]:
    """A chunk and the seconds it took; ``request`` may be the number under which a forked worker has it."""
    del attempt  # tells engines that keep results by their arguments that this is another one
    began = time.perf_counter()
    whole = _forked_requests[request] if isinstance(request, int) else request
    found = run_chunk(whole, tasks, stop or never_stop)
    return found, time.perf_counter() - began


class InlineExecutor(Executor):
    """One call after the other, here."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future:
        """Compute it now."""
        future: Future = Future()
        try:
            future.set_result(function(*arguments, **options))
        except (Exception, RunInterrupted) as error:
            future.set_exception(error)
        return future


@dataclass
class Engine:
    """Who computes.

    Attributes:
        pool: what has ``submit``, as executors have it.
        request: what chunks are of, or the number under which a forked worker has it.
        workers: how many chunks are computed at once; window: how many are out.
        description: in words.
        stop: told to chunks that are computed in this process.
        owned: whether the pool ends with the engine; a user's does not.
    """

    pool: Any
    request: SweepRequest | int
    workers: int
    window: int
    description: str
    stop: StopCheck | None = None
    owned: bool = True

    def submit(self, tasks: Sequence[CellTask], attempt: int) -> Any:
        """Begin a chunk of cells, a future of (found, seconds); ``attempt`` is another number each time that it is begun."""
        return self.pool.submit(run_timed_chunk, self.request, list(tasks), attempt, self.stop)

    def close(self, *, wait: bool) -> None:
        """End; what has begun is waited for, or left."""
        if self.owned:
            self.pool.shutdown(wait=wait, cancel_futures=True)


class ProcessEngine(Engine):
    """Processes of this machine. Ctrl-C is this process's own: they end what they do, and go when it is gone."""

    def __init__(self, request: SweepRequest, workers: int) -> None:
        forks = can_fork()
        if forks:
            _forked_requests[id(request)] = request
        else:
            check_picklable(request)
        context, given = multiprocessing.get_context("fork" if forks else "spawn"), (os.getpid(), forks)
        self._make_pool = lambda: ProcessPoolExecutor(workers, context, initializer=_init_worker, initargs=given)
        sent = id(request) if forks else request
        super().__init__(self._make_pool(), sent, workers, workers + 1, f"{workers} processes")

    def submit(self, tasks: Sequence[CellTask], attempt: int) -> Any:
        """Begin a chunk; in new processes where one of the old has died."""
        try:
            return super().submit(tasks, attempt)
        except BrokenExecutor:
            self.pool.shutdown(wait=False)
            self.pool = self._make_pool()
            return super().submit(tasks, attempt)

    def close(self, *, wait: bool) -> None:
        """End the processes."""
        super().close(wait=wait)
        if isinstance(self.request, int):
            _forked_requests.pop(self.request, None)


def make_engine(workers: Any, request: SweepRequest, stop: StopCheck, *, threads: bool, chunks: int) -> Engine:
    """Return who computes: ``workers`` None: as many as there are cores, threads or processes; a number; an engine.

    Raises:
        UsageError: none of these.
    """
    check_workers(workers)
    if hasattr(workers, "submit"):  # A Dask Client, an Executor.
        if isinstance(workers, ProcessPoolExecutor):
            check_picklable(request)
        capacity, kind = _engine_capacity(workers), type(workers)
        name = f"{kind.__module__.partition('.')[0]}.{kind.__name__}, {capacity} at once"
        return Engine(workers, request, capacity, 2 * capacity, name, owned=False)
    count = min(available_cores() if workers is None else int(workers), max(chunks, 1))
    if count == 1:
        return Engine(InlineExecutor(), request, 1, 1, "in this process", stop)
    if threads:
        return Engine(ThreadPoolExecutor(count), request, count, count + 1, f"{count} threads", stop)
    return ProcessEngine(request, min(count, MAX_PROCESSES))


def check_workers(workers: Any) -> None:
    """Raise UsageError for what cannot compute."""
    if not (
        workers is None or hasattr(workers, "submit") or (is_number(workers) and workers >= 1 and float(workers).is_integer())
    ):
        raise UsageError(
            f"workers = {format_value(workers)}; expected a whole number >= 1, or an engine with submit(), such as a Dask Client "
            "or an Executor"
        )


def can_fork() -> bool:
    """Whether workers are copies of this process: not on Windows, nor on macOS, whose libraries do not survive it."""
    return sys.platform != "darwin" and "fork" in multiprocessing.get_all_start_methods()


def available_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_picklable(request: SweepRequest) -> None:
    """Refuse what cannot go to another process."""
    for name, function in request.outputs.items():
        try:
            pickle.dumps(function)
        except Exception as error:
            raise UsageError(
                f"output '{name}' cannot go to other processes ({error}); define it with def at the top level of a module, give "
                "a string such as 'x1[-1]', or take workers=1"
            ) from error


def is_worker_lost(error: BaseException) -> bool:
    """Whether a chunk failed because who computed it is gone, not because of what it is."""
    gone = isinstance(error, BrokenExecutor | CancelledError | ConnectionError | EOFError)
    return gone or type(error).__name__ in ("KilledWorker", "CommClosedError", "TerminatedWorkerError", "FutureCancelledError")


def _engine_capacity(engine: Any) -> int:
    """How many chunks an engine computes at once."""
    for name in ("_max_workers", "nthreads"):
        number: Any = getattr(engine, name, None)
        if is_number(number):
            return int(number)
        if callable(number):
            found: Any = number()
            return max(1, sum(found.values()) if hasattr(found, "values") else int(found))
    return available_cores()


def _init_worker(parent: int, forked: bool) -> None:
    """In a new worker: signals of the terminal are for its parent, with which it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if hasattr(os, "setpgrp"):
        os.setpgrp()

    def exit_with_parent() -> None:
        above = multiprocessing.parent_process()
        while os.getppid() == parent and (forked or above is None or above.is_alive()):  # Windows keeps the number of the dead.
            time.sleep(PARENT_CHECK_SECONDS)
        os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()


TARGET_CHUNK_SECONDS = 0.3  # A chunk takes about so long: what it costs to send is little beside it, and so late comes Ctrl-C.
MAX_CHUNK_BYTES = 16 << 20  # Bytes of results that a chunk holds, at most, 16 MB: they are sent between processes in one go.
MAX_ATTEMPTS = 3  # So often a cell is sent whose worker dies: with others, with its chunk alone, by itself.
POLL_SECONDS = 0.2  # Seconds between two looks at signals: so late, at most, comes Ctrl-C where no chunk ends.


@dataclass
class ChunkSize:
    """How many cells the next chunk has."""

    cells: int
    most: int

    def update(self, found: CellResults, seconds: float) -> None:
        """Take the time and memory of a chunk into account."""
        bytes_each = sum(array.nbytes for array in found.arrays.values()) / max(found.cells, 1)
        by_time = found.cells * TARGET_CHUNK_SECONDS / max(seconds, 1e-6)
        self.cells = int(np.clip(min(by_time, 4 * self.cells, MAX_CHUNK_BYTES / max(bytes_each, 1.0)), 1, self.most))


@dataclass(frozen=True)
class Chunk:
    """Cells that are out, and how often they were."""

    cells: np.ndarray
    attempt: int


def run_chunks(
    cells: np.ndarray, first: int, tasks: Callable[[np.ndarray], Sequence[CellTask]], engine: Engine,
    keep: Callable[[np.ndarray, CellResults], None], signals: PendingSignals, *, most: int, progress: bool,
) -> None:  # fmt: skip
    """Run cells (K,) until all are done, or a signal came; ``keep`` gets what each chunk found.

    Args:
        cells: numbers of the cells; first: how many the first chunk has, at most.
        tasks: makes what is sent; engine: who computes.
        keep: is called here, with one chunk after the other.
        signals: that came.
        most: cells of a chunk, for what memory they take while they are run.
        progress: show a bar.

    Raises:
        Exception: what a function of the user's has raised; what was found before has been kept.
    """
    bar = progress_bar(total=len(cells), unit="cell") if progress else None
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    again: list[Chunk] = []
    out: dict[Any, Chunk] = {}
    most = max(1, min(most, -(-len(cells) // (2 * engine.workers))))
    size = ChunkSize(min(first, most), most)
    at = 0

    def send(chunk: Chunk) -> None:
        future = engine.submit(tasks(chunk.cells), chunk.attempt)
        out[_future_key(future)] = chunk
        future.add_done_callback(back.put)

    try:
        while (at < len(cells) or again or out) and not (signals and not out):
            while not signals and len(out) < engine.window and (again or at < len(cells)):
                if again and out:
                    break  # Who was lost goes alone: if it is lost again, it is its own doing.
                if again:
                    send(again.pop())
                    break
                send(Chunk(cells[at : at + size.cells], 0))
                at += size.cells
            try:
                future = back.get(timeout=POLL_SECONDS)
            except queue.Empty:
                continue
            chunk = out.pop(_future_key(future))
            found = _chunk_result(future, chunk, again, signals)
            if found is not None:
                keep(chunk.cells, found[0])
                size.update(*found)
                if bar is not None:
                    bar.update(len(chunk.cells))
    finally:
        if bar is not None:
            bar.close()


def _future_key(future: Any) -> Any:
    """What tells a future from others: those of some engines come back as other objects."""
    return getattr(future, "key", None) or id(future)


def _chunk_result(future: Any, chunk: Chunk, again: list[Chunk], signals: PendingSignals) -> tuple[CellResults, float] | None:
    """What a chunk found; None where it is to be done again, or was interrupted."""
    try:
        return future.result()
    except RunInterrupted as stop:
        signals.append(0.0)
        signals.number = signal.Signals(stop.signal)
    except BaseException as error:
        if not is_worker_lost(error):
            raise
        if chunk.attempt + 1 >= MAX_ATTEMPTS:
            return _dead_worker_result(error), 0.0
        parts = [chunk.cells] if chunk.attempt == 0 else chunk.cells[:, None]
        again.extend(Chunk(part, chunk.attempt + 1) for part in parts)
    return None


def _dead_worker_result(error: BaseException) -> CellResults:
    """A cell whose worker died each time."""
    text = f"the process that ran it died {MAX_ATTEMPTS} times ({type(error).__name__}: {error}); out of memory, or killed"
    return failed_cells(1, CELL_FAILED, text)
