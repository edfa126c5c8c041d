"""What users call to run a model many times."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from nsmodel._utils import former_names
from nsmodel.errors import UsageError
from nsmodel.modeling.fingerprint import content_digest, fingerprint, versions
from nsmodel.modeling.parameters import Values
from nsmodel.modeling.time_grid import EVENT_DRIVEN_GRID, check_times
from nsmodel.simulation import run_folder
from nsmodel.simulation.loop import PendingSignals, deferred_signals
from nsmodel.simulation.options import Options, SweepKeywords, option_names, takes_options
from nsmodel.simulation.propagator import model_metadata
from nsmodel.simulation.simulate import simulate
from nsmodel.solvers.plan import STEP_SOLVERS
from nsmodel.sweep import result as dataset
from nsmodel.sweep import store as same
from nsmodel.sweep.cells import BackendChoice, choose_backend, missing_value
from nsmodel.sweep.design import INPUTS, STEP, SweepDesign, check_memory, make_design
from nsmodel.sweep.executor import check_workers, make_engine, run_chunks
from nsmodel.sweep.groups import ModelGroups, ModelSource
from nsmodel.sweep.request import ALONE_BACKEND, CELL_BACKENDS, CellResults, Reduction, SweepRequest, read_outputs
from nsmodel.sweep.result import Sweep, make_sweep
from nsmodel.sweep.store import (
    DIM_PREFIX,
    VALUE_PREFIX,
    CellsInMemory,
    SweepStore,
    missing_cells,
    read_sweep_manifest,
    unrun_results,
)
from nsmodel.sweep.variable import CELL_NOT_RUN

WORKING_BYTES = 64 << 20  # Bytes that the rows of a chunk take while its cells are run, 64 MB in each process.
EXPORT_WRITERS = {".nc": Sweep.to_netcdf, ".zarr": Sweep.to_zarr}


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM during a sweep; ``result`` holds the cells that were run, ``signal`` is which of them came."""

    def __init__(self, result: Sweep, signal: int = signal.SIGINT) -> None:
        ran = int((result.cells["status"] != CELL_NOT_RUN).sum())
        super().__init__(f"interrupted after {ran} of {result.size} cells")
        self.result, self.signal = result, signal


@takes_options(SweepKeywords, before="workers")
def sweep(
    model: Any,
    *,
    grid: Mapping[Any, Any] | None = None,
    samples: Mapping[Any, Any] | None = None,
    start: Mapping[Any, Any] | Callable[[np.random.Generator], Mapping[str, float]] | None = None,
    seeds: Sequence[int] | int | None = None,
    step: float | Sequence[float] | None = None,
    inputs: Any = None,
    parameters: Values | None = None,
    keep: Sequence[str] | str = (),
    every: int | None = None,
    outputs: Mapping[str, Any] | None = None,
    workers: Any = None,
    out: str | Path | None = None,
    resume: bool = False,
    retry: bool = False,
    entropy: int | None = None,
    replicates: bool = False,
    low_discrepancy: bool = False,
    progress: bool = False,
    **options: Unpack[SweepKeywords],
) -> Sweep:
    """Run a model for many values of its parameters, starts, seeds, steps or inputs; each step of each run is verified.

    A run that fails is data: its rows end there, its ``status`` is 1 and its message that of the StepError.

    Args:
        model: a model, the path of a model file, or a function that returns a model.
        grid: {name: values}, a product: a dimension for each. A name is that of a parameter (then one library serves all
            values) or of an argument of the model's function (then each value is another model).
        samples: {name: array (N,)}, points that belong together, along the dimension "sample"; {(names): array (N, k)} as SALib
            and scipy.stats.qmc make them.
        start: {state: values}, where runs begin: along the samples, or a dimension of its own; or a function that gets a
            ``numpy.random.Generator`` of each cell and returns {state: value}.
        seeds: for ``def model(seed=...)``, or for the random numbers of ``start``; a number N stands for range(N).
        step: the time step; several: a dimension. inputs: signals as in `simulate`; a list of such dictionaries, or
            {label: dictionary}: a dimension.
        parameters: values that all cells share, of parameters and arguments.
        keep: columns to keep over time, by the names that a Trajectory has; every: each how many steps, and the last (left
            out: about 200 rows); of event-driven runs the rows are at ``times``.
        outputs: numbers of each run: texts such as "x1[-1]", "max(x1)", "mean(x1)", or functions of a Trajectory, which
            raise StepError where a run has no result: such a cell is a failed one.
        {names}: as in `simulate`; compiled "auto": where a library for all cells takes less time than the runs without.
        workers: how many at once; left out: as many as there are cores, threads for C and processes else; or anything with
            ``submit``: a Dask Client, a concurrent.futures Executor.
        out: folder of the sweep, written as it goes; ".nc" or ".zarr" at the end of its name: written so when all is done.
        resume: go on with the sweep in ``out``: cells that are there are not run again; samples and seeds may have been added.
        retry: with ``resume``, run failed cells again.
        entropy: of the random numbers of ``start`` (default 0), which depend on it and on a cell's place alone.
        replicates: arrays of samples are (R, N) and (R, N, k): R sets of points, along the dimension "replicate".
        low_discrepancy: samples are a net (Sobol, Halton, Latin hypercube): their means have no standard error.
        progress: show a bar at a terminal, or in a notebook.

    Raises:
        UsageError: a wrong argument, an unknown name, nothing to vary, a sweep that is there already.
        ModelError: the first model cannot be made.
        StorageError: ``resume`` without that sweep, or files that cannot be read or written.
        SweepInterrupted: Ctrl-C or SIGTERM; ``error.result`` has what was run.
    """
    design = make_design(grid, samples, start, seeds, step, inputs, entropy, replicates)
    several = STEP in design.dims
    given: Any = step
    requested = Options(step=None if several else given, out=out, resume=resume, **options)
    check_times(step=None if several else step, t_end=requested.t_end)
    one_step = None if several or step is None else float(given)
    check_workers(workers)
    _check_solver_and_retry(requested.solver, resume=resume, retry=retry)
    of_runs = {name: getattr(requested, name) for name in option_names(SweepKeywords)}
    request = SweepRequest(_kept_columns(keep), every, read_outputs(outputs), of_runs)
    fixed = {key if isinstance(key, str) else str(key): value for key, value in (parameters or {}).items()}
    check_varied_names(design, request, fixed)
    shared = None if INPUTS in design.dims else inputs
    groups = ModelGroups(
        ModelSource(model), design, request, fixed, one_step, shared, start if callable(start) else None
    )  # fmt: skip
    groups.check_columns()
    if out is None:
        check_memory(design.dims, design.shape, request.bytes_kept(len(groups.first.rows.times)))
        choice = choose_backend(request, groups.first, design.size, groups.count)
        return _SweepRun(design, groups, choice, low_discrepancy).go(None, workers, progress=progress)
    place = Path(out)
    export = EXPORT_WRITERS.get(place.suffix)
    folder = place.with_name(f"{place.name}.parts") if export else place
    resumed_backend = read_sweep_manifest(folder)["settings"].get("way") if resume else None
    of = _SweepRun(
        design, groups, choose_backend(request, groups.first, design.size, groups.count, resumed_backend), low_discrepancy
    )
    with run_folder.hold_folder(folder):
        store = of.open_folder(folder, resume=resume)
        found = of.go(store, workers, progress=progress, retry=retry)
        if export:
            export(found, place)
    return found


def _check_solver_and_retry(solver: str, *, resume: bool, retry: bool) -> None:
    if solver not in STEP_SOLVERS:
        raise UsageError(f"solver '{solver}' is unknown; there are {', '.join(STEP_SOLVERS)}")
    if retry and not resume:
        raise UsageError("retry runs the failed cells of an existing sweep again: give resume=True and out= with it")


def _kept_columns(keep: Any) -> tuple[str, ...]:
    if not isinstance(keep, str | Sequence):
        raise UsageError(f"keep = {keep!r:.60}; expected names of columns, such as ['x1']")
    return (keep,) if isinstance(keep, str) else tuple(keep)


def check_varied_names(design: SweepDesign, request: SweepRequest, fixed: Mapping[str, Any]) -> None:
    """Raise UsageError for a name that is given two meanings."""
    varied = {one.name for one in design.columns if one.kind == "value"}
    for name in sorted(varied & fixed.keys()):
        raise UsageError(f"'{name}' is varied, but parameters= also gives it {fixed[name]!r:.40}; keep one")
    for name in (*request.keep, *request.outputs):
        if name in {*varied, *design.dims}:
            raise UsageError(f"'{name}' is varied, so each cell has it already; leave it out, or give the output another name")


class _SweepRun:
    """A sweep that is about to be made."""

    def __init__(self, design: SweepDesign, groups: ModelGroups, choice: BackendChoice, low_discrepancy: bool) -> None:
        self.design, self.groups, self.choice, self.low = design, groups, choice, low_discrepancy

    @cached_property
    def _binding(self) -> same.SweepBinding:
        return same.SweepBinding(self.settings, self.design)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All that its numbers depend on but what varies."""
        first, request = self.groups.first, self.choice.request
        grid = EVENT_DRIVEN_GRID if request.is_event_driven else request.grid(first.model, first.step)
        names, steady = first.steady
        return {
            "model": fingerprint(first.model, grid),
            "step": first.step if request.is_event_driven or first.step is not None else grid.h,
            "columns": list(request.keep),
            "rows": f"{len(first.rows.times)} rows, {content_digest([first.rows.times])}",
            "outputs": {name: describe_output(one) for name, one in request.outputs.items()},
            "inputs": content_digest([dict(first.model.inputs)]) if first.model.inputs else "",
            **{name: _to_json_value(value) for name, value in request.options.items() if name not in ("compiled", "times")},
            "way": self.choice.way,
            "versions": versions(),
            **({"fixed values of what derivatives are by": content_digest([names, steady.serialize()])} if names else {}),
        }

    def open_folder(self, folder: Path, *, resume: bool) -> SweepStore:
        """The folder of the sweep: a new one, or the same that is there.

        Raises:
            UsageError: a sweep is there, and resume was not asked for.
            StorageError: none is there, or another.
        """
        store = SweepStore(folder, self.design, self.settings, self._binding)
        if resume:
            store.check_same_sweep()
        elif store.exists:
            read_sweep_manifest(folder)
            raise UsageError(f"{folder} holds a sweep; go on with it by resume=True (--resume), or give another folder")
        store.begin()
        return store

    def go(self, store: SweepStore | None, workers: Any, *, progress: bool, retry: bool = False) -> Sweep:
        """Run the cells that are missing."""
        kept = CellsInMemory(self.design.size) if store is None else store
        cells = missing_cells(kept.status(), retry=retry)
        with deferred_signals() as signals:
            description, left = self._run_cells(self.choice.request, cells, kept, workers, signals, progress=progress)
            if left.size and not signals:  # What C did not go on with.
                self._run_cells(replace(self.choice.request, way=ALONE_BACKEND), left, kept, workers, signals, progress=progress)
        if signals:
            raise SweepInterrupted(self._make_result(kept.read(), description), signals.number)
        if store is None:
            return self._make_result(kept.read(), description)
        empty = self._make_result(unrun_results(self.design.size), description)
        store.join(
            dataset.sweep_metadata(empty),
            dataset.design_arrays(empty),
            self.choice.request.quantity_types(len(self.groups.first.rows.times)),
        )
        return replace(Sweep.load(store.folder), engine=description, _again=self._simulate)

    def _run_cells(
        self, request: SweepRequest, cells: np.ndarray, kept: SweepStore | CellsInMemory, workers: Any, signals: PendingSignals,
        *, progress: bool
    ) -> tuple[str, np.ndarray]:  # fmt: skip
        """Run cells, and return who did, in words, and those that are left."""
        together, first, left = request.way != ALONE_BACKEND, self.groups.first, []

        def keep(chunk: np.ndarray, found: CellResults) -> None:
            kept.put(chunk, found)
            left.append(chunk[found.arrays["status"] == CELL_NOT_RUN])

        engine = make_engine(workers, request, lambda: bool(signals), threads=together, chunks=len(cells))
        try:
            run_chunks(
                cells, 64 if together else 1, self.groups.tasks, engine, keep, signals,
                most=max(1, WORKING_BYTES // request.row_bytes(first.model, first.step)), progress=progress,
            )  # fmt: skip
        finally:
            engine.close(wait=not signals)
        return engine.description, np.concatenate([*left, np.zeros(0, int)])

    def _make_result(self, found: CellResults, engine: str) -> Sweep:
        request, rows = self.choice.request, self.groups.first.rows
        without = {name: (np.dtype(kind), shape) for name, (kind, shape) in request.quantity_types(len(rows.times)).items()}
        unknown = {name: np.asarray(missing_value(name, kind), kind) for name, (kind, _) in without.items()}
        of = {name: np.broadcast_to(unknown[name], (self.design.size, *shape)) for name, (_, shape) in without.items()}
        of |= found.arrays
        arrays = {f"{DIM_PREFIX}{dim}": coords for dim, coords in self.design.coords.items()}
        own = [one for one in self.design.columns if one.numeric and one.kind in ("value", "start")]
        names = {one.name if one.kind == "value" else f"{one.name}(0)": one for one in own}
        names = {name: one for name, one in names.items() if name not in self.design.dims or one.values.ndim > len(one.along)}
        arrays |= {f"{VALUE_PREFIX}{name}": one.values for name, one in names.items()} | {"t": rows.times}
        metadata = self._metadata() | {"dims": list(self.design.dims), "along": {n: list(one.along) for n, one in names.items()}}
        metadata |= self._binding.of(np.arange(self.design.size), self.design.shape)
        metadata["messages"] = {str(cell): text for cell, text in sorted(found.messages.items())}
        sweep = make_sweep(arrays | {name: of[name] for name in request.names}, metadata, self._simulate)
        return replace(sweep, engine=engine)

    def _metadata(self) -> dict[str, Any]:
        request, about = self.choice.request, model_metadata(self.groups.first.model)
        units = dict(about["units"])
        for stem, at in about["stems"].items():
            if stem in units:
                units |= {about["state_names"][i]: units.get(about["state_names"][i], units[stem]) for i in at}
        units |= {
            name: units[one.name]
            for name, one in request.outputs.items()
            if isinstance(one, Reduction) and one.name in units and one.how in ("row", "max", "min", "mean", "rms")
        }
        units |= {f"{name}(0)": unit for name, unit in units.items()}
        return {
            "title": about["title"], "model_class": about["model_class"], "units": units, "keep": list(request.keep),
            "outputs": {name: describe_output(one) for name, one in request.outputs.items()}, "settings": self.settings,
            "plan": self.choice.description, "entropy": self.design.entropy, "low_discrepancy": self.low,
            "ways": list(CELL_BACKENDS),
        }  # fmt: skip

    def _simulate(self, cell: int, options: dict[str, Any]) -> Any:
        """One cell alone, as a whole run."""
        group, values = self.groups.of(cell)
        requested = {name: value for name, value in self.choice.request.options.items() if value is not None}
        if self.choice.request.is_event_driven and requested.get("times") is None:
            requested.pop("times", None)
        if group.step is not None:
            requested["step"] = group.step
        return simulate(
            group.model, parameters=dict(zip(group.names, values.tolist(), strict=True)) or None, **(requested | options)
        )


def describe_output(output: Any) -> str:
    """An output in words: its text; of a function its name and a hash of its code."""
    if isinstance(output, Reduction):
        return output.text
    code = getattr(output, "__code__", None)
    made_of = [] if code is None else [code.co_code.hex(), [repr(one) for one in code.co_consts if not hasattr(one, "co_code")]]
    return f"{getattr(output, '__qualname__', type(output).__name__)} {content_digest([*made_of])}"


def _to_json_value(value: Any) -> Any:
    return value if value is None or isinstance(value, bool | int | float | str) else np.asarray(value, float).tolist()


__getattr__ = former_names(__name__, _Sweeping="_SweepRun")
