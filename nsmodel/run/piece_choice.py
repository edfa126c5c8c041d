"""Who makes the pieces of an event-driven run: C or the integrator, with the known times; and what is told of it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

from nsmodel.errors import CodegenError, StepError
from nsmodel.hypotheses import impacts
from nsmodel.identity import INTERPRETED
from nsmodel.model.base import Model
from nsmodel.model.driven import at_start
from nsmodel.pieces.course import Course
from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.known import Known
from nsmodel.pieces.lengths import order_of
from nsmodel.pieces.radau import stages_of
from nsmodel.pieces.stretch import BUDGET, Stretches
from nsmodel.run.in_c import chosen
from nsmodel.run.options import METHODS, Options
from nsmodel.run.piece_makers import InC, Interpreted, Maker
from nsmodel.run.piece_rows import Columns
from nsmodel.run.row_facts import facts
from nsmodel.scheme.continuous import ContinuousProblem
from nsmodel.signals.kept import Kept
from nsmodel.solve import cost
from nsmodel.solve.choose import Plan
from nsmodel.solve.cost import Cost

IN_C = "pieces in C, compiled for this model; one that C cannot make is interpreted"
MOST = 10_000_000  # Pieces after which a run stops.


class Chosen(NamedTuple):
    """Who makes the pieces, by which way; how columns are told, where that is not CasADi's; the plan, and a warning."""

    maker: Maker
    way: str
    columns: Columns | None
    plan: Plan
    warnings: list[str]


def chosen_maker(
    problem: ContinuousProblem,
    options: Options,
    there: str | None,
    tolerances: tuple[float, list[float]],
    model: Model,
    mark: str,
    known: Known,
    whole: Model | None,
) -> Chosen:
    """In C where that is asked for, or pays, or the run that is resumed had it.

    ``whole``: the model with its parameters as symbols.
    """
    made: list[Course] = []
    of_all = None if whole is None or options.compiled is False else _of_all_values(whole, problem, model)
    own, mark = mark, mark if of_all is None else of_all[1]
    plan = _plan(problem, options, tolerances[0], model)

    def build() -> Any:
        from nsmodel.codegen.piece_runs import NotForTheseError, PiecesInC

        if model.blocks:
            raise CodegenError("pieces that blocks end have no C counterpart")
        fixed, held = () if problem.held else known.times, known.table
        if of_all is not None:
            with suppress(NotForTheseError):
                return PiecesInC(*of_all[:2], *tolerances, fixed, held, of_all[2], residuals=options.certified)
        return PiecesInC(problem, own, *tolerances, fixed, held, residuals=options.certified)

    def course() -> Course:
        made.extend([] if made else [_course(model, problem, options, *tolerances, known)])
        return made[0]

    def costs() -> Cost:
        size = problem.x.numel() + problem.l.numel()
        return cost.of_pieces(size, facts(problem).operations, lambda: is_built(mark))

    count, auto = 1, options.compiled == "auto"
    if problem.sliding and auto:  # The reason is told, whatever it would cost.
        options = replace(options, compiled=True)
    elif auto and there in (None, INTERPRETED) and not is_built(mark):
        count = math.ceil(min(float(model.t_end) / course().integrator.place.tau, MOST))  # whatever its end here
    found = chosen(options, plan, there, count, costs, build, IN_C, "pieces")
    if found.steps is None:
        return Chosen(
            Interpreted(course(), kept=options.folder is not None), found.way, None, found.plan, [] if auto else found.warnings
        )
    size = facts(problem).m + sum(facts(problem).columns.values())
    maker = InC(problem, course, found.steps)
    return Chosen(maker, found.way, lambda rows: found.steps.columns(rows, size), found.plan, found.warnings)


def _of_all_values(whole: Model, problem: ContinuousProblem, model: Model) -> tuple[ContinuousProblem, str, list[float]] | None:
    """The model in continuous time with its parameters as symbols, the mark of its library, the values; None: it has none."""
    from nsmodel.codegen.piece_runs import mark_of_all
    from nsmodel.codegen.piece_scene import free_problem
    from nsmodel.codegen.piece_switches import has_switches_of

    try:
        found = free_problem(whole)
    except CodegenError:
        return None
    if found.rows != problem.rows or found.names != problem.names:
        return None
    values = [model.bound_parameters[name] for name in whole.parameters]
    if not has_switches_of(problem, found, values):
        return None
    return found, mark_of_all(found), values


def _course(
    model: Model, problem: ContinuousProblem, options: Options, rtol: float, atol: list[float], known: Known
) -> Course:  # fmt: skip
    """What goes on, with stretches of steps where "auto" lets it; StepError where it cannot start."""
    integrator = Integrator(problem, rtol, atol, known, residuals=options.certified)
    if options.method == METHODS[1] or options.certified or problem.updaters:  # Steps do not see updates.
        if integrator.stopped is not None:
            raise integrator.final or StepError(integrator.stopped)
        return Course(integrator, None)
    width = integrator.system.orders + 1
    impulsive = any(watch.impulsive for watch in impacts.watched(at_start(model)))
    steps = Stretches(problem, rtol, atol, options.tolerance, known, integrator.sizes.x, width, impulsive=impulsive)
    return Course(integrator, steps)


def is_built(mark: str) -> bool:
    """Whether the pieces of a model are compiled already."""
    from nsmodel.codegen.piece_runs import is_there

    return is_there(mark)


def _plan(problem: ContinuousProblem, options: Options, rtol: float, model: Model) -> Plan:
    used = [
        f"event-driven: Taylor series of order {order_of(rtol)} in each mode, "
        f"{problem.x.numel()} states, {problem.l.numel()} rows",
        "each switch is a root of its sign condition, found by Bernstein's test",
        f"pieces by Radau IIA, {stages_of(order_of(rtol))} stages, where a mode turns out to be stiff",
    ]
    if facts(problem).is_switched:
        used.append("switches of operations that are not analytic (fabs, fmax, if_else, ...), watched")
    if known := model.switch_times:
        used.append(f"{len(known)} known times (switch_times): each ends a piece, the mode is chosen anew")
    if given := [name for name, signal in model.inputs.items() if not isinstance(signal, Kept)]:
        used.append(f"inputs {', '.join(given)}: polynomials of time between known times, each of which ends a piece")
    for block in model.blocks:
        when = "when a condition of its update changes" if block.period is None else "at its ticks, each of which ends a piece"
        used.append(f"block {block.name}: acts {when}")
    if problem.sliding:
        used.append(f"stick and slip are modes of {', '.join(problem.sliding)}: in slip, l is a series of y")
    if options.certified:
        used.append("after the run each piece is proved by interval arithmetic: defect, rows, signs of conditions")
    elif options.method != METHODS[1]:
        used.append(f"where no mode goes on: steps of backward Euler under error control, {BUDGET:,} at most, until one does")
    left = [f"time steps and their solvers (step, solver): {METHODS[1]} pieces are as long as rtol lets them be"]
    return Plan("pieces", (), False, "never", True, math.inf, tuple(used), tuple(left))
