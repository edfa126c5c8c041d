"""Who makes the pieces of an event-driven run: C or the integrator, with the known times; and what is told of it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

from nsmodel.errors import CodegenError, StepError
from nsmodel.hypotheses import impacts
from nsmodel.identity import INTERPRETED_BACKEND
from nsmodel.model.base import Model
from nsmodel.model.driven import with_initial_inputs
from nsmodel.pieces.course import HybridIntegrator
from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.known import SwitchTimes
from nsmodel.pieces.lengths import taylor_order
from nsmodel.pieces.radau import stage_count
from nsmodel.pieces.stretch import STEP_BUDGET, FallbackSteps
from nsmodel.run.in_c import choose_step_backend
from nsmodel.run.options import METHODS, Options
from nsmodel.run.piece_makers import CompiledPieces, InterpretedPieces, PieceSource
from nsmodel.run.piece_rows import ColumnFunction
from nsmodel.run.row_facts import row_properties
from nsmodel.scheme.continuous import ContinuousProblem
from nsmodel.signals.kept import HeldSignal
from nsmodel.solve import cost
from nsmodel.solve.choose import Plan
from nsmodel.solve.cost import CompilationCost

PIECES_IN_C = "pieces in C, compiled for this model; one that C cannot make is interpreted"
MAX_RUN_PIECES = 10_000_000  # Pieces after which a run stops.


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
    mark: str,
    known: SwitchTimes,
    symbolic_model: Model | None,
) -> PieceBackend:
    """In C where that is asked for, or pays, or the run that is resumed had it.

    ``whole``: the model with its parameters as symbols.
    """
    made: list[HybridIntegrator] = []
    of_all = (
        None
        if symbolic_model is None or options.compiled is False
        else _symbolic_parameter_problem(symbolic_model, problem, model)
    )
    own, mark = mark, mark if of_all is None else of_all[1]
    plan = _event_driven_plan(problem, options, tolerances[0], model)

    def build() -> Any:
        from nsmodel.codegen.piece_runs import CompiledPieceIntegrator, UnsupportedValuesError

        if model.blocks:
            raise CodegenError("pieces that blocks end have no C counterpart")
        fixed, held = () if problem.held else known.times, known.table
        if of_all is not None:
            with suppress(UnsupportedValuesError):
                return CompiledPieceIntegrator(*of_all[:2], *tolerances, fixed, held, of_all[2], residuals=options.certified)
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
    symbolic_model: Model, problem: ContinuousProblem, model: Model
) -> tuple[ContinuousProblem, str, list[float]] | None:
    """The model in continuous time with its parameters as symbols, the mark of its library, the values; None: it has none."""
    from nsmodel.codegen.piece_runs import symbolic_problem_hash
    from nsmodel.codegen.piece_scene import cached_symbolic_problem
    from nsmodel.codegen.piece_switches import has_same_switches

    try:
        found = cached_symbolic_problem(symbolic_model)
    except CodegenError:
        return None
    if found.rows != problem.rows or found.names != problem.names:
        return None
    values = [model.bound_parameters[name] for name in symbolic_model.parameters]
    if not has_same_switches(problem, found, values):
        return None
    return found, symbolic_problem_hash(found), values


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
    from nsmodel.codegen.piece_runs import is_piece_library_cached

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
