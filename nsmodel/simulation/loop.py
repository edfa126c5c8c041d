"""The loop of every run: what advances it goes on, rows are written, signals wait; whatever happens, what there is is kept.

Signals that wait for the end of a step, and the bar that shows how far a run is.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel._utils import has_live_display, in_notebook
from nsmodel.errors import StepError, StorageError, UsageError
from nsmodel.files.metadata import CHECKPOINT_FIELDS, check_field_types, settings_digest
from nsmodel.modeling.fingerprint import BACKEND_SETTING, settings_difference
from nsmodel.simulation import propagator as told
from nsmodel.simulation.options import Options
from nsmodel.simulation.propagator import CHUNK_SECONDS, Propagator
from nsmodel.simulation.run_data import Contents, deferred_run
from nsmodel.simulation.run_folder import JOINED_FILE, ChunkStore, unfinished_manifest
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers import impacts
from nsmodel.solvers.step import is_numerical_error, unsolvable_step_error
from nsmodel.version import VERSION


class PendingSignals(list[float]):
    """The times at which signals came, and the number of the last; once ``patient`` no signal raises."""

    number = signal.SIGINT
    patient = False


@contextlib.contextmanager
def deferred_signals() -> Iterator[PendingSignals]:
    """Ctrl-C and SIGTERM inside put their time into the list instead of cutting a step in two; one more a second later raises.

    Outside the main thread signals are not for us. Whatever was to be done with them before is so again afterwards.
    """
    signals = PendingSignals()
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return

    def record_signal(number: int, frame: Any) -> None:
        signals.append(time.monotonic())
        signals.number = signal.Signals(number)
        if signals[-1] - signals[0] > 1 and not signals.patient:
            raise KeyboardInterrupt

    taken = [signal.SIGINT] if signal.getsignal(signal.SIGTERM) is signal.SIG_IGN else [signal.SIGINT, signal.SIGTERM]
    usual = {number: signal.signal(number, record_signal) for number in taken}
    try:
        yield signals
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler or signal.SIG_DFL)


def progress_bar(**options: Any) -> Any:
    """A bar on standard error that leaves nothing behind; None where that is neither a terminal nor a notebook's.

    In a notebook it is a widget where ipywidgets is installed, else text.
    """
    if not has_live_display():
        return None
    widgets = in_notebook() and find_spec("ipywidgets") is not None
    tqdm: Any = import_module("tqdm.notebook" if widgets else "tqdm").tqdm
    return tqdm(delay=1.0, leave=False, dynamic_ncols=True, **options)


# So late comes Ctrl-C; the clock costs nothing beside.
MAX_STEPS_PER_CALL, QUICK_CALL_SECONDS = 64, 0.01  # Steps between looks at the clock: twice as many after less than this.


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM during a run; ``trajectory`` holds what was computed, ``signal`` is which of them came."""

    def __init__(self, trajectory: Trajectory, signal: int = signal.SIGINT) -> None:
        super().__init__(trajectory.metadata["message"])
        self.trajectory, self.signal = trajectory, signal

    def __reduce__(self) -> tuple[type[RunInterrupted], tuple[Trajectory]]:
        """Pickle with the trajectory, of which the message is a part."""
        return type(self), (self.trajectory,)


class RunLoop:
    """A walk, and the folder that it is written to; ``store`` is None where its rows stay in memory."""

    def __init__(self, propagator: Propagator, options: Options, store: ChunkStore | None) -> None:
        self.propagator, self.options, self.store = propagator, options, store
        self.cpu_seconds = 0.0
        self._flushed, self._resumed = time.monotonic(), False
        if options.resume and store is not None:
            self._restore(store)

    def go(self) -> Trajectory:
        """Run to the end; where that fails, or is interrupted, save what there is and say so.

        Numbers that cannot be computed with end in a StepError, whatever library says so; a fault of the program stays what
        it is.
        """
        bar = progress_bar(**self.propagator.bar) if self.options.progress else None
        # What overflows is for the certificate to judge.
        with deferred_signals() as signals, np.errstate(all="ignore"):
            start = time.process_time()
            try:
                try:
                    self._advance(bar, signals)
                finally:
                    signals.patient = True
                    self.cpu_seconds = time.process_time() - start
                    if bar is not None:
                        bar.close()
            except StepError as error:
                self._step_failure(error)
                raise
            except StorageError as error:
                error.trajectory = self._partial_trajectory("failed", str(error))
                raise
            except MemoryError as error:
                raise self._step_failure(StepError(f"{self._span_text}: not enough memory ({error})")) from error
            except Exception as error:
                if is_numerical_error(error) or self.propagator.runaway is not None:
                    raise self._step_failure(unsolvable_step_error(self._span_text, error)) from error
                self._finish("failed", f"{type(error).__name__}: {error}")
                raise
            except KeyboardInterrupt:  # a second signal, in the middle of a step: the step did not happen
                pass
            if not self.propagator.finished:
                run = self._finish("interrupted", f"interrupted at t = {self.propagator.time:.10g}")
                raise RunInterrupted(run, signals.number)
            return self._finish("done", "")

    def _advance(self, bar: Any, signals: Sequence[float]) -> None:
        """Go on until the run has ended or is interrupted."""
        propagator, steps = self.propagator, 1
        while not (propagator.finished or signals):
            began, passed = time.monotonic(), propagator.progress
            with self._checkpoint_errors() if self._resumed else contextlib.nullcontext():
                propagator.advance(steps, signals)
            self._resumed = False
            now = time.monotonic()
            steps = min(2 * steps, MAX_STEPS_PER_CALL) if now - began < QUICK_CALL_SECONDS else max(steps // 2, 1)
            if self.store is not None and (
                propagator.record.full or (now - self._flushed >= CHUNK_SECONDS and propagator.record.filled)
            ):
                self._flush(self.store, "running", "")
            if bar is not None:
                bar.update(propagator.progress - passed)

    @property
    def _span_text(self) -> str:
        t = self.propagator.time
        return f"no verified step from t = {t:.10g} to {t + self.propagator.h:.10g}"

    def _step_failure(self, error: StepError) -> StepError:
        """Complete what is known of a failed step, and save the run before it."""
        propagator, runaway = self.propagator, self.propagator.runaway
        grown = "" if runaway is None else f". The run has diverged: {runaway[0]} = {runaway[1]:.3g}"
        error.step, error.time = propagator.k, propagator.time + propagator.h
        error.args = (f"step {propagator.k}: {error.args[0]}{grown}{impacts.anti_friction_hint(propagator.model)}",)
        with contextlib.suppress(MemoryError):  # of a run in a folder the chunks are there
            error.trajectory = self._finish("failed", str(error))
        return error

    def _flush(self, store: ChunkStore, status: str, message: str) -> None:
        """Write the rows in memory as a chunk, with the checkpoint to continue from."""
        propagator = self.propagator
        propagator.note()
        checkpoint = {
            "k": propagator.k, "t": propagator.time, "totals": propagator.totals, "counts": dict(propagator.counts),
            "settings": propagator.settings, **propagator.checkpoint(),
        }  # fmt: skip
        store.append(propagator.columns(), checkpoint, self._metadata(status, message))
        propagator.record.clear()
        self._flushed = time.monotonic()

    def _restore(self, store: ChunkStore) -> None:
        """Take up the checkpoint of the run in ``out``; refuse another model, other settings, other versions, another grid."""
        propagator, saved, out = self.propagator, store.manifest["checkpoint"], self.options.folder
        check_field_types(saved, CHECKPOINT_FIELDS, f"{out}: checkpoint")
        other = settings_difference(saved["settings"], propagator.settings)
        if other is not None:
            same_way = "leave compiled (--compiled) out to go on as it began, or " if BACKEND_SETTING in other else ""
            raise StorageError(f"{out}: the run there was made with {other}; {same_way}start afresh without resuming")
        if saved["k"] > propagator.N:
            raise StorageError(
                f"{out}: the run there has already reached t = {saved['t']:g}, past this run's end; give a later end"
            )
        missing = sorted(propagator.totals.keys() - saved["totals"].keys())
        if missing:
            raise StorageError(f"{out}: the checkpoint there has no totals['{missing[0]}']: it was changed")
        propagator.k, propagator.counts, propagator.totals = saved["k"], Counter(saved["counts"]), dict(saved["totals"])
        with self._checkpoint_errors():
            propagator.restore(saved)
        if abs(propagator.time - saved["t"]) > 1e-9 * saved["t"]:
            raise StorageError(
                f"{out}: the run there ended at t = {saved['t']:g} with a shortened step, which is no time of this run's "
                "grid; start afresh without resuming"
            )
        if saved.get("cut"):
            store.shorten(**saved["cut"])
        store.drop("halving")
        self._resumed = True

    @contextlib.contextmanager
    def _checkpoint_errors(self) -> Iterator[None]:
        """Whatever fails in here does so because a checkpoint is not what a walk of this kind has written."""
        try:
            yield
        except StorageError:
            raise
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            fault = f"{type(error).__name__}: {error}"
            where = self.options.folder
            raise StorageError(f"{where}: the checkpoint there cannot be continued ({fault}): it was changed") from error

    def _finish(self, status: str, message: str) -> Trajectory:
        """The run so far, in the folder where there is one; where that cannot be written, the StorageError has it."""
        propagator, store, folder = self.propagator, self.store, self.options.folder
        if store is None:
            if propagator.defers_reading and folder is None and status == "done":
                return deferred_run(Trajectory, partial(self.contents, status, message))
            run = Trajectory(*self.contents(status, message))
            if folder is not None:
                _save_trajectory(run, folder / JOINED_FILE)
            return run
        if propagator.rows_lost and (run := self._partial_trajectory(status, message)) is not None:
            if not store.manifest["chunks"]:
                _save_trajectory(run, store.directory / JOINED_FILE)
            return run  # What goes on goes on from where the folder was last written.
        try:
            if propagator.record.filled:
                self._flush(store, status, message)
            store.join(self._metadata(status, message))
        except StorageError as error:
            error.trajectory = self._partial_trajectory(status, message)
            raise
        return Trajectory.load(store.directory / JOINED_FILE)

    def contents(self, status: str, message: str) -> Contents:
        """What is told of a run that is whole in memory."""
        with np.errstate(all="ignore"):
            self.propagator.note()
            return self.propagator.columns(), self._metadata(status, message)

    def _partial_trajectory(self, status: str, message: str) -> Trajectory | None:
        """The run so far without writing: what is in the folder, if it can be read, and the rows not yet written."""
        parts = []
        with contextlib.suppress(StorageError, MemoryError):
            parts = [self.store.read()] if self.store and self.store.manifest["chunks"] else []
        if self.propagator.record.filled:
            parts.append(self.propagator.columns())
        if not parts:
            return None
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return Trajectory(arrays, self._metadata(status, message))

    def _metadata(self, status: str, message: str) -> dict[str, Any]:
        propagator, plan = self.propagator, self.propagator.plan
        data = {
            "save_every": self.options.save_every,
            "steps": propagator.totals["steps"],
            "used": list(plan.used),
            "left_out": list(plan.left_out),
            "solver_counts": dict(sorted(propagator.counts.items())),
            "totals": dict(propagator.totals),
            "warnings": list(propagator.warnings),
            "status": status,
            "message": message,
            "model_hash": propagator.settings["model"],
            "run": settings_digest(propagator.settings),
        }
        return told.model_metadata(propagator.model) | data | propagator.metadata()


def _save_trajectory(run: Trajectory, path: Path) -> None:
    try:
        run.save(path)
    except StorageError as error:
        error.trajectory = run
        raise


def check_not_unfinished(out: Path) -> None:
    """Refuse to overwrite a run that can be continued."""
    manifest = unfinished_manifest(out)
    if manifest is not None:
        by = manifest["metadata"]["versions"]["nsmodel"]
        of, how = ("", "resume=True (--resume)") if by == VERSION else (f" of nsmodel {by}", "that version")
        raise UsageError(
            f"{out} holds an unfinished run{of}, up to t = {manifest['checkpoint']['t']:g}; go on with {how}, "
            "or remove the folder"
        )
