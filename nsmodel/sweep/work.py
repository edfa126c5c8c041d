"""The work of a sweep: chunks of cells go out, come back, and are kept; what is lost is done again."""

from __future__ import annotations

import queue
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.run.interrupt import PendingSignals, progress_bar
from nsmodel.run.loop import RunInterrupted
from nsmodel.sweep.asked import CELL_BACKENDS, CellResults
from nsmodel.sweep.cells import CellTask, unrun_facts
from nsmodel.sweep.engine import Engine, is_worker_lost
from nsmodel.sweep.variable import CELL_FAILED

TARGET_CHUNK_SECONDS = 0.3  # A chunk takes about so long: what it costs to send is little beside it, and so late comes Ctrl-C.
MAX_CHUNK_BYTES = 16 << 20  # And holds at most so much.
MAX_ATTEMPTS = 3  # So often a cell is sent whose worker dies: with others, with its chunk alone, by itself.
POLL_SECONDS = 0.2  # Seconds between two looks at signals.


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
    found = unrun_facts(1)
    found["status"][:], found["way"][:] = CELL_FAILED, len(CELL_BACKENDS) - 1
    text = f"the process that ran it died {MAX_ATTEMPTS} times ({type(error).__name__}: {error}); out of memory, or killed"
    return CellResults(found, {0: text})
