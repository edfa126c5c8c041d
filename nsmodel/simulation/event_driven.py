"""The walk of event-driven integration: its rows are the ends of pieces, or the times asked for, read off the polynomials.

Who makes the pieces of an event-driven run: C or the integrator, with the known times; and what is told of it.

A checkpoint is the integrator between two pieces; before a piece that goes beyond ``t_end`` it is kept, and the rows of that
piece are taken away when the run goes on. Nothing is read of pieces while the run goes on; rows are read off polynomials when
they are asked for, and so no number of a piece depends on ``t_end``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nsmodel._utils import cached_per_object, sum_in_order
from nsmodel.errors import CodegenError, StepError, StorageError
from nsmodel.event_driven.fallback_steps import STEP_BUDGET, FallbackSteps, HybridIntegrator, checkpoint_time
from nsmodel.event_driven.friction_modes import with_stick_slip_modes
from nsmodel.event_driven.integrator import MAX_EVENT_DRIVEN_OPERATIONS, Integrator, checked_row_times, checked_tolerances
from nsmodel.event_driven.problem import (
    CONTINUOUS_PROBLEM,
    ContinuousProblem,
    NotEventDriven,
    SwitchTimes,
    block_set_entries,
    inputs_between_rows,
    switch_table,
    switch_times_of,
    with_input_states,
)
from nsmodel.event_driven.radau import stage_count
from nsmodel.event_driven.stable_exponentials import without_overflow
from nsmodel.event_driven.step_size import MULTIPLIERS, taylor_order
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import BACKEND_SETTING, INTERPRETED_BACKEND, run_settings
from nsmodel.modeling.output_columns import OutputColumns
from nsmodel.modeling.signals.pwm import HeldSignal
from nsmodel.modeling.time_grid import EVENT_DRIVEN_GRID, check_times, input_schedule
from nsmodel.modeling.variants import with_initial_inputs
from nsmodel.simulation.event_driven_rows import ColumnFunction, PieceRows, row_properties
from nsmodel.simulation.options import METHODS, Options
from nsmodel.simulation.piece_sources import CompiledPieces, InterpretedPieces, PieceBuffer, PieceSource
from nsmodel.simulation.propagator import (
    PERCENT_PROGRESS,
    ResumedBackend,
    check_exact_function,
    find_runaway_state,
    scene_metadata,
    update_exact_error,
)
from nsmodel.simulation.step_backend import choose_step_backend
from nsmodel.solvers import impacts
from nsmodel.solvers import plan as cost
from nsmodel.solvers.initial_checks import check_start, warnings
from nsmodel.solvers.plan import CompilationCost, Plan

if TYPE_CHECKING:
    from nsmodel.simulation.error_bounds import CertifiedRun

PIECES_IN_C = "pieces in C, compiled for this model; one that C cannot make is interpreted"
MAX_RUN_PIECES = 10_000_000  # Pieces after which a run stops: an hour of a small model, interpreted.


class PieceBackend(NamedTuple):
    """Who makes the pieces, by which way; how columns are told, where that is not CasADi's; the plan, and a warning."""

    maker: PieceSource
    way: str
    columns: ColumnFunction | None
    plan: Plan
    warnings: list[str]


def choose_piece_backend(
    problem: ContinuousProblem,
    options: Options,
    resumed_backend: str | None,
    tolerances: tuple[float, list[float]],
    model: Model,
    known: SwitchTimes,
    symbolic_model: Model | None,
    t_end: float,
) -> PieceBackend:
    """In C where that is asked for, or pays, or the run that is resumed had it.

    ``whole``: the model with its parameters as symbols.
    """
    made: list[HybridIntegrator] = []
    of_all = (
        None
        if symbolic_model is None or options.compiled is False
        else _symbolic_parameter_problem(symbolic_model, problem, model, () if problem.held else known.times)
    )
    fixed = () if problem.held else known.times
    mark = of_all[1] if of_all is not None else "" if options.compiled is False else _piece_library_mark(problem, fixed)
    plan = _event_driven_plan(problem, options, tolerances[0], model)

    def build() -> Any:
        from nsmodel.codegen.event_driven_runs import CompiledPieceIntegrator, UnsupportedValuesError

        if model.blocks:
            raise CodegenError("pieces that end at blocks have no C counterpart")
        held = switch_table(model, t_end)
        if of_all is not None:
            with suppress(UnsupportedValuesError):
                return CompiledPieceIntegrator(*of_all[:2], *tolerances, fixed, held, of_all[2], residuals=options.certified)
        own = _piece_library_mark(problem, fixed)
        return CompiledPieceIntegrator(problem, own, *tolerances, fixed, held, residuals=options.certified)

    def hybrid_integrator() -> HybridIntegrator:
        made.extend([] if made else [_build_hybrid_integrator(model, problem, options, *tolerances, known)])
        return made[0]

    def piece_cost() -> CompilationCost:
        size = problem.x.numel() + problem.l.numel()
        return cost.pieces_cost(size, row_properties(problem).operations, lambda: is_piece_library_built(mark))

    count, auto = 1, options.compiled == "auto"
    if problem.sliding_law_names and auto:  # The reason is told, whatever it would cost.
        options = replace(options, compiled=True)
    elif auto and resumed_backend in (None, INTERPRETED_BACKEND) and not is_piece_library_built(mark):
        count = math.ceil(
            min(float(model.t_end) / hybrid_integrator().integrator.place.tau, MAX_RUN_PIECES)
        )  # whatever its end here
    found = choose_step_backend(options, plan, resumed_backend, count, piece_cost, build, PIECES_IN_C, "pieces")
    if found.steps is None:
        return PieceBackend(
            InterpretedPieces(hybrid_integrator(), kept=options.folder is not None),
            found.way,
            None,
            found.plan,
            [] if auto else found.warnings,
        )
    size = row_properties(problem).m + sum(row_properties(problem).columns.values())
    maker = CompiledPieces(problem, hybrid_integrator, found.steps)
    return PieceBackend(maker, found.way, lambda rows: found.steps.columns(rows, size), found.plan, found.warnings)


def _symbolic_parameter_problem(
    symbolic_model: Model, problem: ContinuousProblem, model: Model, known: Sequence[float]
) -> tuple[ContinuousProblem, str, list[float]] | None:
    """The model in continuous time with its parameters as symbols, the mark of its library, the values; None: it has none."""
    from nsmodel.codegen.event_driven_source import has_same_switches
    from nsmodel.codegen.event_driven_spec import cached_symbolic_problem

    try:
        found = cached_symbolic_problem(symbolic_model)
    except CodegenError:
        return None
    if found.rows != problem.rows or found.names != problem.names:
        return None
    values = [model.bound_parameters[name] for name in symbolic_model.parameters]
    if not has_same_switches(problem, found, values):
        return None
    return found, _piece_library_mark(found, known), values


def _piece_library_mark(problem: ContinuousProblem, known: Sequence[float]) -> str:
    from nsmodel.codegen.event_driven_runs import piece_library_mark

    return piece_library_mark(problem, known)


def _build_hybrid_integrator(
    model: Model, problem: ContinuousProblem, options: Options, rtol: float, atol: list[float], known: SwitchTimes
) -> HybridIntegrator:  # fmt: skip
    """What goes on, with stretches of steps where "auto" lets it; StepError where it cannot start."""
    integrator = Integrator(problem, rtol, atol, known, residuals=options.certified)
    if options.method == METHODS[1] or options.certified or problem.updaters:  # Steps do not see updates.
        if integrator.stopped is not None:
            raise integrator.final_error or StepError(integrator.stopped)
        return HybridIntegrator(integrator, None)
    width = integrator.system.orders + 1
    impulsive = any(watch.impulsive for watch in impacts.impact_rows(with_initial_inputs(model)))
    steps = FallbackSteps(problem, rtol, atol, options.tolerance, known, integrator.sizes.x, width, impulsive=impulsive)
    return HybridIntegrator(integrator, steps)


def is_piece_library_built(mark: str) -> bool:
    """Whether the pieces of a model are compiled already."""
    from nsmodel.codegen.event_driven_runs import is_piece_library_cached

    return is_piece_library_cached(mark)


def _event_driven_plan(problem: ContinuousProblem, options: Options, rtol: float, model: Model) -> Plan:
    used = [
        f"event-driven: Taylor series of order {taylor_order(rtol)} in each mode, "
        f"{problem.x.numel()} states, {problem.l.numel()} rows",
        "each switch is a root of its sign condition, found by Bernstein's test",
        f"pieces by Radau IIA, {stage_count(taylor_order(rtol))} stages, where a mode turns out to be stiff",
    ]
    if row_properties(problem).is_switched:
        used.append("switches of operations that are not analytic (fabs, fmax, if_else, ...), watched")
    if known := model.switch_times:
        used.append(f"{len(known)} known times (switch_times): each ends a piece, the mode is chosen anew")
    if given := [name for name, signal in model.inputs.items() if not isinstance(signal, HeldSignal)]:
        used.append(f"inputs {', '.join(given)}: polynomials of time between known times, each of which ends a piece")
    for block in model.blocks:
        when = "when a condition of its update changes" if block.period is None else "at its ticks, each of which ends a piece"
        used.append(f"block {block.name}: acts {when}")
    if problem.sliding_law_names:
        used.append(f"stick and slip are modes of {', '.join(problem.sliding_law_names)}: in slip, l is a series of y")
    if options.certified:
        used.append("after the run each piece is proved by interval arithmetic: defect, rows, signs of conditions")
    elif options.method != METHODS[1]:
        used.append(
            f"where no mode goes on: steps of backward Euler under error control, {STEP_BUDGET:,} at most, until one does"
        )
    left = [f"time steps and their solvers (step, solver): {METHODS[1]} pieces are as long as rtol lets them be"]
    return Plan("pieces", (), False, "never", True, math.inf, tuple(used), tuple(left))


EVENT_DRIVEN_METHOD = METHODS[1]


@cached_per_object
def event_driven_problem(model: Model) -> ContinuousProblem:
    """Return the model in continuous time, as this method takes it.

    Raises:
        NotEventDriven: what it cannot take, by name.
    """
    return _event_driven_problem(model)


def symbolic_event_driven_problem(model: Model, bound: ContinuousProblem) -> ContinuousProblem:
    """The same of a model with symbols for parameters, whose inputs start as those of ``bound``, of it at some values."""
    return _event_driven_problem(model, row_properties(bound).x0[bound.x.numel() - bound.held :].tolist())


def _event_driven_problem(model: Model, start: Sequence[float] | None = None) -> ContinuousProblem:
    continuous_problem = CONTINUOUS_PROBLEM.optional(model)
    if continuous_problem is None:
        raise NotEventDriven("many bodies change their contacts at nearly every step; they are for time stepping")
    return with_stick_slip_modes(without_overflow(with_input_states(continuous_problem(model), model, start)))


class EventDrivenPropagator:
    """The walk of event-driven integration; see `walk.Propagator`. Rows and pieces stay in memory."""

    N: int = MAX_RUN_PIECES
    rows_lost: bool = False

    def __init__(
        self,
        model: Model,
        options: Options,
        problem: ContinuousProblem,
        resumed_backend: ResumedBackend,
        symbolic_model: Model | None = None,
    ) -> None:
        """``whole``: the model with its parameters as symbols."""
        check_times(t_end=options.t_end)
        self.model: Any = model
        self.options, self.problem = options, problem
        self.T = float(model.t_end if options.t_end is None else options.t_end)
        rtol, atol = checked_tolerances(problem, options.rtol, options.atol)
        self.times = None if options.times is None else checked_row_times(options.times, self.T)
        found = _checked_start_warnings(model)
        check_exact_function(model)
        _check_size(problem, options)
        _check_provable(problem, options)
        same = run_settings(
            model, EVENT_DRIVEN_GRID, EVENT_DRIVEN_METHOD, options.tolerance, options.save_every, INTERPRETED_BACKEND
        )
        known = switch_times_of(model, self.T)
        self._drive = input_schedule(model, self.T) if model.inputs else None
        chosen = choose_piece_backend(problem, options, resumed_backend(), (rtol, atol), model, known, symbolic_model, self.T)
        self.maker, self.plan = chosen.maker, chosen.plan
        self.record = PieceRows(problem, self.maker.order, options.save_every, self.T, self.times, chosen.columns)
        self._in_chunks = options.folder is not None and not options.certified
        self.defers_reading = not options.certified
        self.k = self._made = 0  # Rows, and pieces.
        self._new: list[PieceBuffer] = []  # Pieces that are not counted yet.
        self._outputs = _checked_output_columns(model)
        self._cut: dict[str, Any] | None = None  # The checkpoint before a piece that goes beyond the end.
        self.certified: CertifiedRun | None = None
        self.warnings = [*found, *chosen.warnings]
        self.counts: Counter[str] = Counter()
        self.totals: dict[str, Any] = {
            "worst_residual": 0.0, "worst_residual_t": None, "index_set_changes": 0, "steps": 0, "rtol": rtol,
            "order": self.maker.order, "pieces": 0, "collocated": 0, "events": 0, "worst_estimate": 0.0, "worst_estimate_t": None,
            "stretches": [],
        }  # fmt: skip
        own = {"step": "pieces", "rtol": rtol, "atol": atol, "rows": "ends of pieces" if self.times is None else "times"}
        self.settings = same | {BACKEND_SETTING: chosen.way} | own

    # -- as the loop sees it

    @property
    def bar(self) -> dict[str, Any]:
        """Progress in per cent of the time."""
        return PERCENT_PROGRESS

    @property
    def progress(self) -> float:
        """Per cent of the time."""
        return 100 * min(self.time / self.T, 1.0)

    @property
    def finished(self) -> bool:
        """Whether the pieces reach the end of the time."""
        return self.time >= self.T

    @property
    def time(self) -> float:
        """Where the next piece starts."""
        return self.maker.t

    @property
    def h(self) -> float:
        """The unit of time of the next piece."""
        return self.maker.tau

    @property
    def runaway(self) -> tuple[str, float] | None:
        """Name and value of the largest state, where it is beyond what can be computed with."""
        return find_runaway_state(self.problem.names, self.maker.x)

    def warm_up(self) -> None:
        """Everything is built."""

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Integrate so many pieces."""
        try:
            self._advance(steps, stop)
        except Exception as error:
            self.rows_lost = self.rows_lost and not isinstance(error, StepError)
            self._update_totals(self.maker.counts())
            raise

    def _advance(self, left: int, stop: Sequence[float]) -> None:
        while left > 0 and not (self.finished or stop or (self._in_chunks and self.record.full)):
            self.rows_lost = True
            block = self.maker.make_pieces(self.T, left)
            left -= block.count
            behind = self.maker.behind
            cut = self.options.folder is not None and self.time > self.T
            if cut and block.count > behind:
                self._take_pieces(block.cut(slice(-behind)))
            if cut:
                self._update_totals(self.maker.counts(before=True))
                self._cut = self._build_checkpoint(before=True) | {"cut": {"rows": self.record.filled, "listed": behind}}
                block = block.cut(slice(-behind, None))
            self._take_pieces(block)
            if self._cut is not None:
                self._cut["cut"]["rows"] = self.record.filled - self._cut["cut"]["rows"]
            self.rows_lost = False

    def take_over(self, steps: Any, block: PieceBuffer) -> None:
        """Take pieces from the start on that ``steps`` in C of the same run have made, and what they counted."""
        maker: Any = self.maker
        maker.take_over(steps)
        self._take_pieces(block)

    def _take_pieces(self, block: PieceBuffer) -> None:
        self.record.take(block)
        self._new.append(block)
        self._made += block.count
        if self._made > MAX_RUN_PIECES:
            raise StepError(f"{MAX_RUN_PIECES:,} pieces, which are not enough: ask for less accuracy (rtol)")

    def _update_totals(self, counts: dict[str, Any]) -> None:
        """Bring the totals to the pieces that were taken."""
        totals, self.k = self.totals, self.record.carried.rows
        if self._new:
            block, self._new = PieceBuffer.concatenate(self._new), []
            estimates = np.where(block.stepped, 0.0, block.defect)
            worst = int(estimates.argmax())
            if estimates[worst] > totals["worst_estimate"]:
                totals["worst_estimate"], totals["worst_estimate_t"] = float(estimates[worst]), float(block.t[worst])
            totals["events"] += int(block.event.sum())
            totals |= {"steps": self.k, "pieces": totals["pieces"] + block.count, **counts}
            totals["index_set_changes"] = totals["events"]

    def note(self) -> None:
        """The totals: counts, the distance to the exact state, the worst residual; the certificate that was asked for."""
        self._update_totals(self.maker.counts())
        if self.options.certified and self.record.pieces:
            from nsmodel.simulation.error_bounds import certify_run

            self.certified = certify_run(self.maker.integrator, self.record.pieces, self.T, self.totals["rtol"])
        self._accumulate_rows(self.totals, self.record.filled)
        if self._cut is not None:
            self._accumulate_rows(self._cut["totals"], self.record.filled - self._cut["cut"]["rows"])

    def _accumulate_rows(self, totals: dict[str, Any], rows: int) -> None:
        if rows:
            arrays = self.columns()
            t, x, residual = (arrays[name][:rows] for name in ("t", "x", "residual"))
            update_exact_error(self.model, totals, t, x)
            larger = residual > totals["worst_residual"]
            if larger.any():
                row = int(np.where(larger, residual, 0.0).argmax())
                totals |= {"worst_residual": float(residual[row]), "worst_residual_t": float(t[row])}

    def columns(self) -> dict[str, np.ndarray]:
        """The rows in memory as the arrays of a trajectory, and the pieces as lists."""
        arrays = self.record.columns()
        if self._drive is not None:
            t = arrays["t"]
            before = np.concatenate([np.nan_to_num(t[:1] - arrays["step"][:1]), t[:-1]])
            arrays |= self._drive.rows(t, before)
            self._fill_block_inputs(arrays)
        arrays |= self._outputs(arrays)
        return arrays if self.certified is None else arrays | self.certified.arrays(self.record.numbers, arrays["t"], arrays["x"])

    def _fill_block_inputs(self, arrays: dict[str, np.ndarray]) -> None:
        """What blocks hold, in the columns of the inputs: as in the piece that ends at a row, and in that which begins before."""
        entries, places = block_set_entries(self.model)
        if not (entries.size and len(arrays["piece_start"])):
            return
        at_end, at_begin = self.record.held_at_rows()
        arrays["inputs"][:, entries], arrays["inputs_begin"][:, entries] = at_end[:, places], at_begin[:, places]

    # -- for files

    def checkpoint(self) -> dict[str, Any]:
        """What to continue from; ``cut``: how many rows and pieces before the end, where a piece goes beyond it."""
        return self._build_checkpoint() if self._cut is None else self._cut

    def _build_checkpoint(self, *, before: bool = False) -> dict[str, Any]:
        saved = self.maker.checkpoint(before=before)
        return {
            "k": self.k, "t": checkpoint_time(saved), "totals": dict(self.totals), "rows": self.record.checkpoint(),
            "course": saved, "cut": None,
        }  # fmt: skip

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.maker.restore(saved["course"])
        self.record.restore(saved["rows"])
        self._made = self.totals["pieces"]
        if self.time > self.T:
            raise StorageError(f"the run there has already reached t = {self.time:.10g}, past this run's end; give a later end")
        if self.times is not None and saved["rows"]["t"] not in [0.0, *self.times[: self.k]]:
            raise StorageError(f"times: the run there has a row at t = {saved['rows']['t']:.10g}; give its times, and later ones")

    def metadata(self) -> dict[str, Any]:
        """What was integrated, and how."""
        p = self.problem
        return {
            "scheme": f"event-driven: Taylor series of order {self.maker.order}",
            "multiplier_names": list(p.rows if p.multipliers is None else p.declared),
            "index_names": list(p.rows),
            "law_kinds": p.law.labels,
            "tolerance": self.options.tolerance,
            "warnings": [
                *self.warnings,
                *_fallback_warnings(self.totals["stretches"]),
                *self._residual_warnings(),
                *self._undecided_warnings(),
            ],
            **({"between_rows": inputs_between_rows(p, self.model)} if self.model.inputs else {}),
            **scene_metadata(self.model),
        } | ({} if self.certified is None else {"certificate": self.certified.metadata(p.names)})

    def _undecided_warnings(self) -> list[str]:
        """The events whose time is not known well enough for rtol, and the dips that are not decided."""
        one = self.totals.get("undecided")
        if not one or not one["count"]:
            return []
        what = "when it switches" if one["crosses"] else "whether it comes to 0 and goes back, or switches twice,"
        more = f"; {one['count'] - 1} more" if one["count"] > 1 else ""
        return [f"{one['of']}: {what} at t = {one['t']:.10g} is not known, within {one['width']:.2g} of time{more}"]

    def _residual_warnings(self) -> list[str]:
        """That rows are further from the law than a run of this rtol can be, where they are."""
        worst, rtol = self.totals["worst_residual"], self.totals["rtol"]
        if worst <= max(MULTIPLIERS * rtol, self.options.tolerance):
            return []
        at = f"t = {self.totals['worst_residual_t']:.10g}"
        return [f"the law is missed by {worst:.2g} of its size at {at}, {worst / rtol:.2g} rtol: the run is no solution there"]


def _fallback_warnings(intervals: list[dict[str, Any]]) -> list[str]:
    """What a user must know of the stretches: that there are some and why, and whether rtol is missed."""
    if not intervals:
        return []
    first, steps, error = intervals[0], sum(one["steps"] for one in intervals), sum_in_order(one["estimate"] for one in intervals)
    count = "once" if len(intervals) == 1 else f"{len(intervals)} times"
    found = [
        f"event-driven integration stopped {count}, first: {first['why']}; {steps} time steps, from t = {first['start']:.10g} to "
        f"{first['until']:.10g}{' and later' if len(intervals) > 1 else ''} (run.stepped)"
    ]
    return found + ([f"rtol is missed: the errors of these steps add up to about {error:.2g} rtol"] if error > 1 else [])


def _check_size(problem: ContinuousProblem, options: Options) -> None:
    """Refuse what would take longer than steps, unless it is asked for."""
    if options.method != EVENT_DRIVEN_METHOD and (size := row_properties(problem).operations) > MAX_EVENT_DRIVEN_OPERATIONS:
        raise NotEventDriven(f"f, g and h have {size} operations, and each event ends a piece of all of them; steps cost less")


def _check_provable(problem: ContinuousProblem, options: Options) -> None:
    """Refuse to prove what interval arithmetic has no form of."""
    if options.certified and problem.held:
        raise NotEventDriven("certify='interval' applies only to models without inputs")
    if options.certified and problem.sliding_law_names:
        raise NotEventDriven(
            f"certify='interval' applies only to boxes; while '{problem.sliding_law_names[0]}' slips, its l is a series of y"
        )


@cached_per_object
def _checked_output_columns(model: Model) -> OutputColumns:
    """The outputs of a model; UsageError for a name in them that its runs do not have."""
    problem = event_driven_problem(model)
    found = OutputColumns.of(model, problem.rows if problem.multipliers is None else problem.declared)
    own = row_properties(problem)
    sizes = {**own.columns, "multipliers": own.visible_multipliers, "x": problem.states}
    sizes |= {"inputs": model.u.numel()} if model.inputs else {}
    sizes |= {"reactions": own.visible_multipliers} if problem.impulses else {}
    lists = {name: np.zeros(1) for name in ("t", "step", "residual", "energy") if name != "energy" or name in sizes}
    found(lists | {name: np.zeros((1, size)) for name, size in sizes.items() if name != "energy"})
    return found


@cached_per_object
def _checked_start_warnings(model: Model) -> tuple[str, ...]:
    """The warnings of a model, whose start is not refused."""
    check_start(model)
    return tuple(warnings(model))


def plan_with_reason(plan: Plan, reason: str) -> Plan:
    """A plan of time stepping that says why event-driven integration was left out."""
    return replace(plan, left_out=(*plan.left_out, f"{EVENT_DRIVEN_METHOD} integration: {reason}"))
