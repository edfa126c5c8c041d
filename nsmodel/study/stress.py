"""Pushing a model: its step, its units, its parameters; each cell one short run, judged by what the solvers do not know.

How a model behaves when pushed: its step, its units and its parameters, each run judged by what the solvers do not know.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from itertools import product

import numpy as np

from nsmodel._utils import checks_keywords
from nsmodel.errors import NsmodelError, StepError, UsageError
from nsmodel.hypotheses.along_run import CONTINUITY_HYPOTHESIS, QUALIFICATION_HYPOTHESIS
from nsmodel.hypotheses.check import check, with_start
from nsmodel.hypotheses.findings import RUN_FINDING_PREFIX, VIOLATED
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.modeling.base import Model
from nsmodel.modeling.inputs import Signals
from nsmodel.modeling.parameters import Values, describe_argument
from nsmodel.modeling.time_grid import format_value, is_number, make_grid
from nsmodel.modeling.variants import with_inputs, with_inputs_at_any_step
from nsmodel.proof.verdict import not_none
from nsmodel.simulation.loop import progress_bar
from nsmodel.simulation.simulate import simulate
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.initial_checks import UNIQUENESS_WARNING
from nsmodel.study.reference_steps import EVALUATION_ROUNDING, formula_residuals, state_term_sizes, worst_ratio
from nsmodel.study.stress_result import LEFT_OUT, RIGHT, STOPPED, WRONG, Cell, Stress
from nsmodel.study.units import in_units

STEPS_PER_CELL = 24  # Steps of a run of the stress test: enough for some switches; there are 56 cells for each set of values.
# Steps, in those of the model: from where rounding is all to where nothing is resolved.
STEP_FACTORS = (1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3)
# Units of states and of time, in those of the model: each alone and both against each other, nine orders either way.
UNIT_SCALES = ((1.0, 1.0), (1e-9, 1.0), (1e9, 1.0), (1.0, 1e-9), (1.0, 1e9), (1e-9, 1e9), (1e9, 1e-9))
# Largest difference of two runs that must be equal, beside the motion: a hundred times what a step is solved to by default.
AGREEMENT_TOLERANCE = 1e-7
PREMISES = ("S-convex", "O-theta", "O-g", "4.1", "5.1", "5.2", "M-T", "M-C")  # Where one is violated nothing is promised.
SINGLE_SOLVERS = ("daqp", "lemke", "ipopt")  # The first that applies is run alone.


@checks_keywords
def stress(
    model: Model,
    *,
    vary: Mapping[str, Sequence[float]] | None = None,
    parameters: Values | None = None,
    inputs: Signals | None = None,
    step: float | None = None,
    steps: int = STEPS_PER_CELL,
    budget: float | None = None,
    progress: bool = False,
) -> Stress:
    """Push a model and say of each cell whether what came out is right, stopped with a message, or wrong.

    A cell is a run of a few steps: one of 8 steps (1e-12 to 1e3 times the model's own) in one of 7 pairs of units (state and
    time 1e-9 to 1e9 times), for each combination of the values in ``vary``. Judged by the formulas of the scheme put into the
    model's expressions, by another solver alone, by the same run in the model's own units, and by the inequalities that its
    class promises along a run (energy, feasibility, contraction) where the hypotheses hold.

    Args:
        model: of any class but ManyBodies.
        vary: {name of a parameter: values}; all combinations are run.
        parameters: values of the other parameters.
        inputs: signals of inputs, in place of those declared; where steps end at edges, runs are as much shorter.
        step: the step that is taken for 1; left out: the model's own.
        steps: steps of each run.
        budget: wall time in seconds; cells that would exceed it are left out, and counted: first those of the steps that are
            farthest from the model's own. Left out: no limit.
        progress: show a progress bar at a terminal, or in a notebook.

    Raises:
        UsageError: no model, a model of many bodies, no step, an unknown parameter, a value that is not a number, an input that
            is `steps`.
    """
    if not isinstance(model, Model):
        raise UsageError(f"stress: expected a model, such as LureSystem(...), not {describe_argument(model)}")
    combinations = [dict(zip(vary or {}, values, strict=True)) for values in product(*_varied_values(vary))]
    model = with_inputs(model, inputs)
    variants = [(values, model.bind({**model.values_of(parameters), **model.values_of(values)})) for values in combinations]
    return stress_variants(variants, step=step, steps=steps, budget=budget, progress=progress)


def stress_variants(
    variants: Sequence[tuple[Mapping[str, float], Model]],
    *,
    step: float | None = None,
    steps: int = STEPS_PER_CELL,
    budget: float | None = None,
    progress: bool = False,
) -> Stress:
    """Push bound models that differ in the values named beside each; see `stress`."""
    for _, model in variants:
        model.check_allowed("stress")
        with_inputs_at_any_step(model, "stress")
    if not (is_number(steps) and steps >= 3 and float(steps).is_integer()):
        raise UsageError(f"steps = {format_value(steps)}; expected a whole number >= 3")
    if step is not None and not (is_number(step) and 0 < step < np.inf):
        raise UsageError(f"step = {format_value(step)}; expected a finite number > 0")
    if budget is not None and not (is_number(budget) and 0 < budget < np.inf):
        raise UsageError(f"budget = {format_value(budget)}; expected a finite number > 0")
    until = np.inf if budget is None else time.perf_counter() + budget
    cells: list[Cell] = []
    total = len(variants) * len(STEP_FACTORS) * len(UNIT_SCALES)
    bar = progress_bar(total=total, unit="cell") if progress else None
    for factor in sorted(STEP_FACTORS, key=lambda factor: abs(np.log10(factor))):
        for values, model in variants:
            h = _model_step_size(model) if step is None else float(step)
            for cell in _stress_step_size(model, values, factor, h, int(steps), until):
                cells.append(cell)
                if bar is not None:
                    bar.update()
    if bar is not None:
        bar.close()
    first = variants[0][1]
    return Stress(
        title=first.title or "untitled", model_class=type(first).__name__, names=tuple(first.names),
        time_unit=first.units.get("t", ""), step=_model_step_size(first) if step is None else float(step), cells=tuple(cells),
    )  # fmt: skip


def _varied_values(vary: Mapping[str, Sequence[float]] | None) -> list[list[float]]:
    if vary is not None and not isinstance(vary, Mapping):
        raise UsageError(f"vary: expected a dictionary {{name: values}}, not {describe_argument(vary)}")
    lists = []
    for name, values in (vary or {}).items():
        if isinstance(values, str) or np.ndim(values) != 1 or not len(values) or not all(map(is_number, values)):
            raise UsageError(f"vary: {name} = {values!r}; expected a list of numbers, such as [0.1, 1, 10]")
        lists.append([float(value) for value in values])
    return lists


def _model_step_size(model: Model) -> float:
    if model.step is None and model.steps is None:
        raise UsageError("no time step: give the model step=, or give stress step=H (--step H)")
    return float(not_none(model.step) if model.steps is None else np.mean(model.steps))


def _stress_step_size(
    model: Model, values: Mapping[str, float], factor: float, h: float, steps: int, until: float
) -> Iterator[Cell]:
    """The cells of one step size: the model as it is, judged by all means, then in other units, compared with it.

    A cell that would not end before ``until`` is left out, the time of the last one being what it would take.
    """
    own: Trajectory | None = None
    took, end = 0.0, _stress_end_time(model, factor * h, steps)
    for u, tau in UNIT_SCALES:
        begin = time.perf_counter()
        if begin + took > until:
            yield Cell(dict(values), factor, factor * h, u, tau, LEFT_OUT, {}, "the time budget", 0)
            continue
        rescaled = model if (u, tau) == (1.0, 1.0) else in_units(model, u, tau)
        run, message = _run_until_error(rescaled, factor * h * tau, end * tau)
        checks = {} if run is None else {f"formula: {name}": value for name, value in formula_residuals(rescaled, run).items()}
        if own is None:
            own = run
            if run is not None:
                checks |= _compare_single_solver(model, run, factor * h, end) | _check_run_inequalities(
                    model, run, factor * h, end
                )
        elif run is not None and own is not None:
            found = _run_difference("other units", model, own, run, run.x / u, own.x)
            checks |= found | (_input_difference(own, run, tau) if found and model.u.numel() else {})
        verdict = WRONG if any(not value <= 1 for value in checks.values()) else STOPPED if message else RIGHT
        took = time.perf_counter() - begin
        yield Cell(dict(values), factor, factor * h, u, tau, verdict, checks, message, 0 if run is None else len(run))


def _stress_end_time(model: Model, h: float, steps: int) -> float:
    """When so many steps, not longer than h, have been taken."""
    if not model.u.numel():
        return steps * h
    try:
        grid = make_grid(model, h, None, steps * h, driven=True)
    except NsmodelError:  # the run says why
        return steps * h
    return grid.time(min(steps, grid.N))


def _run_until_error(model: Model, h: float, end: float) -> tuple[Trajectory | None, str]:
    """A run as far as it came, and why it stopped."""
    try:
        return simulate(_without_exact_solution(model), step=h, t_end=end, compiled=False), ""
    except NsmodelError as error:
        return getattr(error, "trajectory", None), str(error)


def _without_exact_solution(model: Model) -> Model:
    """The model without its exact solution and its own steps, of which more or fewer are taken here."""
    plain = copy(model)
    plain._set(exact=None)
    return plain


def _compare_single_solver(model: Model, own: Trajectory, h: float, end: float) -> dict[str, float]:
    """The same run by another solver alone, as far as it comes."""
    for solver in SINGLE_SOLVERS:
        try:
            run = simulate(_without_exact_solution(model), step=h, t_end=end, compiled=False, solver=solver)
        except StepError as error:
            run = error.trajectory
        except UsageError:
            continue
        if run is not None and len(run) > 0:
            return _run_difference(f"solver {solver} alone", model, own, run, run.x, own.x)
    return {}


def _run_difference(
    what: str, model: Model, own: Trajectory, run: Trajectory, x: np.ndarray, known: np.ndarray
) -> dict[str, float]:
    """Two runs that must be the same, where the solution is unique: apart by no more than AGREEMENT_TOLERANCE allows."""
    if any(UNIQUENESS_WARNING in text for text in (*own.metadata["warnings"], *run.metadata["warnings"])):
        return {}
    rows = min(len(x), len(known))
    x, known = x[:rows], known[:rows]
    motion = np.maximum.accumulate(np.abs(known - known[0]).max(axis=1))
    size = np.maximum.accumulate(np.abs(known).max(axis=1))
    acted = np.zeros_like(x)
    acted[1:] = np.maximum.accumulate(np.nan_to_num(state_term_sizes(model, own)[: rows - 1], posinf=0.0), axis=0)
    allowed = AGREEMENT_TOLERANCE * (motion[:, None] + acted) + rows * EVALUATION_ROUNDING * size[:, None]
    if "predictor_distance" in own.arrays and own.arrays["selection"].shape[1]:
        # Explicit in a discontinuous operator: beside its jump rounding decides, and one step goes the other way.
        allowed = allowed + 2 * np.nanmax(np.abs(own.step[1:, None] * own.v[1:]))
    if "tolerance" in own.arrays:
        allowed = allowed + 2 * np.cumsum(np.sqrt(np.nan_to_num(own.tolerance[:rows])))[:, None]  # what projections may be off
    error = np.abs(x - known)
    with np.errstate(all="ignore"):
        ratio = np.where(error == 0, 0.0, error / allowed)
    return {what: float(np.max(np.where(np.isnan(ratio), np.inf, ratio)))}


@np.errstate(all="ignore")
def _input_difference(own: Trajectory, run: Trajectory, tau: float) -> dict[str, float]:
    """Edges and ticks of two runs in units of time that differ by tau, and their inputs: by AGREEMENT_TOLERANCE, at most."""
    rows = min(len(own.t), len(run.t))
    pairs = [(own.t[:rows, None], run.t[:rows, None] / tau)]
    pairs += [(own.arrays[side][:rows], run.arrays[side][:rows]) for side in ("inputs", "inputs_begin")]
    return {
        "inputs in other units": max(worst_ratio(np.abs(b - a), AGREEMENT_TOLERANCE * np.abs(a).max(axis=0)) for a, b in pairs)
    }


@np.errstate(all="ignore")
def _check_run_inequalities(model: Model, run: Trajectory, h: float, end: float) -> dict[str, float]:
    """Infinity for each inequality along the run that is broken, 0 for each that is met, where the hypotheses hold."""
    runs = [run]
    if len(run) < 3:
        return {}
    if HYPOTHESIS_CHECKS.of(model).compares_solutions:
        other, message = _run_until_error(with_start(model, (run.x[0] + run.x[-1]) / 2), h, end)
        if not message and other is not None and not np.array_equal(other.x[0], run.x[0]):
            runs.append(other)
    try:
        findings = check(model, runs, quick=True).findings
    except NsmodelError:
        return {}
    if any(finding.id in PREMISES and finding.verdict == VIOLATED for finding in findings):
        return {}
    premises = (QUALIFICATION_HYPOTHESIS.id, CONTINUITY_HYPOTHESIS.id)  # of the model: a run may break them
    along = [finding for finding in findings if finding.id.startswith(RUN_FINDING_PREFIX) and finding.id not in premises]
    return {f"along: {f.id.removeprefix(RUN_FINDING_PREFIX)}": np.inf if f.verdict == VIOLATED else 0.0 for f in along}


__all__ = ["LEFT_OUT", "RIGHT", "STOPPED", "WRONG", "Cell", "Stress", "stress", "stress_variants"]
