"""Who makes the pieces of an event-driven run: C or the integrator, with the known times; and what is told of it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from nsmodel.errors import CodegenError, StepError
from nsmodel.identity import INTERPRETED
from nsmodel.model.base import Model
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
from nsmodel.scheme.driven import data, moving
from nsmodel.signals.drive import as_one
from nsmodel.signals.kept import Kept
from nsmodel.signals.signal import Signal
from nsmodel.solve import cost
from nsmodel.solve.choose import Plan
from nsmodel.solve.cost import Cost

IN_C = "pieces in C, compiled for this model; one that C cannot make is interpreted"
AHEAD = 2.0  # Times of the run up to which times of signals are known.
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
) -> Chosen:
    """In C where that is asked for, or pays, or the run that is resumed had it."""
    made: list[Course] = []
    plan = _plan(problem, options, tolerances[0], model)

    def build() -> Any:
        from nsmodel.codegen.piece_runs import PiecesInC

        if model.blocks:
            raise CodegenError("pieces that blocks end have no C counterpart")
        fixed = () if problem.held else known.times
        return PiecesInC(problem, mark, *tolerances, fixed, known.table, residuals=options.certified)

    def course() -> Course:
        made.extend([] if made else [_course(problem, options, *tolerances, known)])
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


def known_of(model: Model, t_end: float) -> Known:
    """The known times of a model, and of the signals of a run also those beyond its end: pieces go beyond it."""
    if not model.inputs:
        return Known(model.switch_times)
    ahead = AHEAD * t_end
    joints = [signal.joints(ahead) for signal in model.inputs.values() if isinstance(signal, Signal)]
    ticks = [block.ticks(ahead) for block in model.blocks]
    times = as_one(np.concatenate([np.array(model.switch_times, float), *joints, *ticks]))
    moves = any(signal.moving for signal in model.inputs.values())
    return Known(tuple(times.tolist()), partial(data, model), partial(moving, model) if moves else None)


def _course(problem: ContinuousProblem, options: Options, rtol: float, atol: list[float], known: Known) -> Course:
    """What goes on, with stretches of steps where "auto" lets it; StepError where it cannot start."""
    integrator = Integrator(problem, rtol, atol, known, residuals=options.certified)
    if options.method == METHODS[1] or options.certified or problem.updaters:  # Steps do not see updates.
        if integrator.stopped is not None:
            raise integrator.empty or StepError(integrator.stopped)
        return Course(integrator, None)
    width = integrator.system.orders + 1
    return Course(integrator, Stretches(problem, rtol, atol, options.tolerance, known, integrator.sizes.x, width))


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
