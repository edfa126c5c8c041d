"""``nsmodel.check``: the hypotheses of a model's class, decided on its expressions and on runs made for the purpose.

What runs with steps 4h, 2h and h show together: the order that is seen, at the times that all of them have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords
from nsmodel.errors import ModelError, StepError, UsageError
from nsmodel.hypotheses import region as uniform
from nsmodel.hypotheses.along_run import findings_along_run, time_limit_clauses
from nsmodel.hypotheses.exact_roots import findings_at_roots
from nsmodel.hypotheses.findings import (
    HOLDS,
    RUN_FINDING_PREFIX,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    IntervalBox,
    Scope,
    intersect_scopes,
    measured_consequence,
    plain_witness,
)
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.hypotheses.inputs import (
    InputBounds,
    describe_inputs,
    input_bounds,
    mark_unknown_between_ticks,
    out_of_bounds_reason,
    unknown_consequence,
)
from nsmodel.hypotheses.moving_law import decide_with_law_bounds, freeze_law, runs_of_frozen_law
from nsmodel.hypotheses.region import Region, enclosing_region, region_of
from nsmodel.hypotheses.report import Report
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import Values, describe_argument, split_boxes
from nsmodel.modeling.signals import Within
from nsmodel.modeling.signals.base import ParametricSignal
from nsmodel.modeling.time_grid import SAME_TIME_SHARE
from nsmodel.modeling.variants import freeze_inputs, parametric_inputs, with_signals
from nsmodel.proof.expression_graph import OpaqueExpression
from nsmodel.proof.global_search import quick_searches
from nsmodel.simulation.simulate import simulate
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers import impacts
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.structure import read_step_structure

# Differences of runs below this part of the state are not told from rounding: 45 000 eps, what thousands of steps add up.
ORDER_ROUND_OFF = 1e-11
ASYMPTOTIC_ORDERS = 0.3, 2.5  # Orders seen outside of this range are chance: schemes have the orders 1 and 2, 1/2 at impacts.
# Rows of a run beside those with steps twice as long: 2, but for a last step; edges of inputs ask for other steps.
ROW_RATIO_RANGE = 1.8, 2.2


def refined_run_consequences(model: Model, run: Trajectory, effort: Any) -> list[Consequence]:
    """What runs with the steps 4h, 2h, h show together: the order, and what the class looks at; ``effort``: of a check of it."""
    h, N = model.step, len(run.t) - 1
    if h is None or N < 16 or run.status != "done" or model.tied_to_step:
        return []
    if effort and not effort.is_refined(model, N):
        return []
    try:
        runs = [run, *(simulate(model, step=factor * h, t_end=float(run.t[-1])) for factor in (2, 4))]
    except (StepError, UsageError):
        return []
    if model.u.numel() and not all(
        ROW_RATIO_RANGE[0] <= len(fine.t) / len(wide.t) <= ROW_RATIO_RANGE[1] for fine, wide in pairwise(runs)
    ):
        return []  # edges ask for steps of their own
    refined_runs = HYPOTHESIS_CHECKS.of(model).refined_runs
    return [_observed_order(h, runs), *([] if refined_runs is None else refined_runs(h, runs))]


def _states_at_common_times(runs: Sequence[Trajectory]) -> Iterator[np.ndarray]:
    """The states of runs with the steps h, 2h, 4h at the times that all have."""
    N = len(runs[0].t) - 1
    if "inputs" not in runs[0].arrays:
        rows = N // 4 - (1 if N % 4 else 0)  # the last row of a coarse run may be a shortened step
        return (other.x[: factor * rows + 1 : factor] for factor, other in zip((4, 2, 1), runs, strict=True))
    t, near = runs[-1].t, SAME_TIME_SHARE * float(runs[-1].t[-1])
    at = [np.abs(run.t[:, None] - t).argmin(axis=0) for run in runs]
    common = np.all([np.abs(run.t[rows] - t) <= near for run, rows in zip(runs, at, strict=True)], axis=0)
    return (run.x[rows[common]] for run, rows in zip(runs, at, strict=True))


def _observed_order(h: float, runs: Sequence[Trajectory]) -> Consequence:
    """log2 of the ratio of the differences between neighbouring runs, at common times."""
    fine, medium, wide = _states_at_common_times(runs)
    near, far = np.nanmax(np.abs(medium - fine)), np.nanmax(np.abs(wide - medium))  # NaN: bodies that are absent in one of two.
    value = {"difference h, 2h": near, "difference 2h, 4h": far, "h": h}
    error = runs[0].metadata["totals"].get("largest_error")
    if error is not None:
        value["largest error"] = error
    if near <= ORDER_ROUND_OFF * max(np.nanmax(np.abs(runs[0].x)), np.finfo(float).tiny):
        return measured_consequence(
            "observed order", "runs with steps 4h, 2h, h agree to rounding: no order is seen, and no error of the step", value
        )
    order = np.log2(far / near) if far else 0.0
    if not ASYMPTOTIC_ORDERS[0] <= order <= ASYMPTOTIC_ORDERS[1]:
        why = "no order is seen at steps 4h, 2h, h: they are too large, or switches fall between rows differently"
        return measured_consequence("observed order", why, value)
    return measured_consequence(
        "observed order", "the error shrinks like h^order, seen at steps 4h, 2h, h", {"order": order, **value}
    )


# Steps of a run that a check makes where each needs Newton's method: 4000 take 2 s for two states; longer runs are cut.
MAX_CHECK_STEPS = 4000
IMPACT_NOTE = f"where y closes with y' != 0 a state jumps, an impact; see {impacts.IMPACTS_GUIDE}"
WIDER_REGION_FACTOR = 10.0  # Of the box, where counterexamples outside of it are looked for, which are a note and no verdict.
MAX_THOROUGH_STATES = 4  # States up to which jumps are looked for there, too; with more the search is quick.
CONSTANT_INPUTS_NOTE = "seen for constant inputs alone"


def hypotheses_of(kind: type[Model]) -> tuple[Hypothesis, ...]:
    """Return the hypotheses that are decided for a model class, in the order of its report."""
    return HYPOTHESIS_CHECKS.of(kind).hypotheses


@checks_keywords
@np.errstate(all="ignore")  # A model is looked at where it overflows and where it has no value, too.
def check(
    model: Model,
    runs: Sequence[Trajectory] | None = None,
    *,
    parameters: Values | None = None,
    region: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[Any, Within] | None = None,
    quick: bool = False,
) -> Report:
    """Decide each hypothesis that the theory of this model class rests on, and say what follows.

    Args:
        model: any of the seven classes. Parameters may stay without value for a LureSystem: the conditions on them are found.
        runs: finished runs of this model; left out, the model is run (twice more with larger steps, for the observed order,
            and for two classes from another start, for the contraction).
        parameters: values of parameters, by name or symbol; a pair (low, high) stands for all values between: a hypothesis
            holds for all of them, or the value is shown where it fails.
        region: {state or symbol: (low, high)}, where hypotheses about all states are decided if no proof covers them
            everywhere; states left out have an interval around the runs.
        bounds: {input or its name: within(low, high, rate=None)}: all signals within these are meant, not only the model's own;
            inputs left out have bounds that are read off their signals (see `docs/inputs.md`).
        quick: skip runs, global searches and local maximisation.

    Returns:
        the report: ``report["A5"].verdict``, ``report.findings``, ``report.consequences``, ``report.text()``.

    Raises:
        UsageError: no model, an unknown parameter, state or input, a parameter without value where numbers are needed, an input
            of which neither signal nor bounds tell its values.
        ModelError: the model calls a Function that cannot be looked into.

    >>> from nsmodel import LureSystem, check, relay
    >>> report = check(LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[1, 0], t_end=1, step=0.1))
    >>> report["5.1"].verdict, report["5.2"].value["omega"]
    ('holds', 0.0)
    """
    if not isinstance(model, Model):
        raise UsageError(f"check: expected a model, such as LureSystem(...), not {describe_argument(model)}")
    model.check_allowed("check")
    parameters, boxes = split_boxes(parameters, model.parameters)
    values = {**model.parameters, **model.values_of(parameters)}
    t_end = max([float(model.t_end or 0.0), *(float(run.t[-1]) for run in runs or ())])
    looked_at = freeze_law(model)
    signals = model.bind({**values, **dict.fromkeys(boxes)}, partly=True).inputs if parametric_inputs(model) else {}
    motion = input_bounds(with_signals(looked_at, signals), bounds, t_end)
    if boxes or motion.names:
        return _check_for_all_values(model, looked_at, values, boxes, motion, runs, region, quick)
    missing = tuple(name for name, value in values.items() if value is None)
    if missing and (symbolic := HYPOTHESIS_CHECKS.of(model).symbolic):
        return _symbolic_report(symbolic, _with_constant_inputs(looked_at.bind(values, partly=True), motion), values, missing)
    driven, bound = model.bind(values), _with_constant_inputs(looked_at.bind(values), motion)
    notes: list[str] = []
    given = runs is not None or quick
    own = list(runs or ()) if given else _make_check_runs(driven, notes)
    box = region_of(bound, own, region)
    own, checks = _time_stepping_runs(own, notes), HYPOTHESIS_CHECKS.of(bound)
    seen_so_far = runs_of_frozen_law(driven, own)

    def decide() -> tuple[list[Finding], list[Consequence]]:
        found, made = checks.decide(bound, box, seen_so_far, quick)
        made = time_limit_clauses(bound, box, found, made)
        return found if quick else _with_violations_outside(bound, box, seen_so_far, found), list(made)

    try:
        findings, consequences = decide_with_law_bounds(
            _with_constant_inputs(driven, motion), box, motion, quick, checks.hypotheses, decide
        )
    except OpaqueExpression as error:
        raise ModelError(str(error)) from None
    if effort := checks.effort:
        notes += effort.effort_notes(bound, [] if given else own)
    if not own:
        notes += [f"{watch.acts}, not on y': {IMPACT_NOTE}" for watch in impacts.impact_rows(bound) if not watch.relay]
    seen = _findings_along_runs(driven, motion, own, findings, notes, given, quick)
    consequences, lines = mark_unknown_between_ticks(driven, consequences), _input_notes(driven, motion)
    return _make_report(
        driven, box.text, [*findings, *seen[0]], [*consequences, *seen[1]], driven.bound_parameters, notes, quick, lines
    )


def _with_constant_inputs(model: Model, motion: InputBounds) -> Model:
    """The model at constant values of its inputs, of those that move as parameters without value."""
    return freeze_inputs(model, motion.held) if model.u.numel() else model


def _findings_along_runs(
    model: Model, motion: InputBounds, runs: Sequence[Trajectory], findings: Sequence[Finding], notes: list[str], given: bool,
    quick: bool,
) -> tuple[list[Finding], list[Consequence]]:  # fmt: skip
    """What runs with the signals of the model show, where these are among those meant."""
    if not runs:
        return [], []
    if why := out_of_bounds_reason(model, motion, runs[0]):
        notes.append(f"{why}: nothing that is said of signals within them is said of the run, which is not looked at")
        return [], []
    twin = runs[1] if len(runs) > 1 and len(runs[1].t) == len(runs[0].t) else None
    span = Scope(time=(float(runs[0].t[0]), float(runs[0].t[-1])))
    checks = HYPOTHESIS_CHECKS.of(model)
    compare_runs = checks.compare_runs if motion.names else None  # else ``decide`` compares them
    made = [
        *(compare_runs(model, findings, runs) if compare_runs else []),
        *findings_along_run(model, runs[0], findings, twin, quick),
    ]
    made = [replace(item, scope=span) for item in made]
    return made, [] if given else refined_run_consequences(model, runs[0], checks.effort)


def _input_notes(model: Model, motion: InputBounds) -> tuple[str, ...]:
    """Where inputs stand, and which signals are meant."""
    driven = HYPOTHESIS_CHECKS.of(model).driven
    return describe_inputs(model, motion, None if driven is None else driven.fields)


def _time_stepping_runs(runs: Sequence[Trajectory], notes: list[str]) -> list[Trajectory]:
    """The runs by time stepping, whose rows the checks along a run are about; a note on the modes of each other one."""
    notes += [modes_note(run) for run in runs if run.is_event_driven]
    return [run for run in runs if not run.is_event_driven]


def modes_note(run: Trajectory) -> str:
    """What an event-driven run says of its modes: whether l was the only one, and the mode the only one that goes on."""
    totals = run.metadata["totals"]
    unique, redundant = totals.get("unique", {}), totals.get("redundant", 0)
    regular = (
        f"{redundant} of {totals['pieces']} pieces have redundant rows, their l is one of several" if redundant else "all regular"
    )
    decided = ", ".join(f"{verdict} at {count}" for verdict, count in sorted(unique.items())) or "no event"
    only = "whether the mode is the only one, at the start and the events"
    return f"event-driven run: {totals['pieces']} pieces, {regular}; {only}: {decided}"


def _check_for_all_values(
    model: Model, looked_at: Model, values: Mapping[str, float | None], boxes: IntervalBox, motion: InputBounds,
    runs: Sequence[Trajectory] | None, region: Mapping[str, tuple[float, float]] | None, quick: bool,
) -> Report:  # fmt: skip
    """Decide the hypotheses for all values of parameters and inputs in boxes: proofs of the class, and values where one fails.

    Of each hypothesis without such a proof the reports at many values are joined, of which one may show that it fails.
    ``looked_at``: the model in the form in which its hypotheses are looked at.
    """
    part = model.bind({**values, **dict.fromkeys(boxes)}, partly=True)
    if missing := set(part.parameters) - set(boxes):
        kinds = "boxes of parameters" if boxes else "inputs"
        raise UsageError(f"parameter '{min(missing)}' has no value; beside {kinds}, give it a number or a box")
    boxes = {name: boxes[name] for name in part.parameters}
    driven = part.bind(uniform.box_middle(boxes)) if boxes else part
    if any(isinstance(signal, ParametricSignal) for signal in part.inputs.values()):
        for one in uniform.sample_values(boxes):
            part.bind(one)  # Refuses values at which a signal has none.
    still, every = (
        _with_constant_inputs(looked_at.bind({**values, **dict.fromkeys(boxes)}, partly=True), motion),
        {**boxes, **motion.box},
    )
    notes: list[str] = []
    given = runs is not None or quick
    own = list(runs or ()) if given else _make_check_runs(driven, notes)
    proofs = HYPOTHESIS_CHECKS.of(model).uniform
    some = uniform.sample_values(every, proofs.special_values(still, every) if proofs else ())
    box = enclosing_region([region_of(still.bind(one), own, region) for one in some], every)
    own, count = _time_stepping_runs(own, notes), len(some)

    def decide() -> tuple[list[Finding], list[Consequence]]:
        nonlocal count
        found, made, count = _decide_for_all_values(still, box, motion, runs_of_frozen_law(driven, own), quick)
        return found, made

    declared = still if looked_at.u.numel() > model.u.numel() else _with_constant_inputs(part, motion)
    try:
        findings, made = decide_with_law_bounds(declared, box, motion, quick, hypotheses_of(type(model)), decide)
    except OpaqueExpression as error:
        raise ModelError(str(error)) from None
    if boxes:
        text = f"{', '.join(boxes)}: all values between the ends; looked at {count} of them, the run is that of the middle"
    else:
        text = f"{', '.join(motion.names)}: looked at {count} constant value{'s' * (count > 1)} between the ends"
    reported_values: dict[str, Any] = {**part.bound_parameters, **boxes}
    seen = ([], []) if boxes else _findings_along_runs(driven, motion, own, findings, notes, given, quick)
    findings, made, notes = [*findings, *seen[0]], [*mark_unknown_between_ticks(model, made), *seen[1]], [*notes, text]
    return _make_report(part, box.text, findings, made, reported_values, notes, quick, _input_notes(part, motion))


def _decide_for_all_values(
    model: Model, region: Region, motion: InputBounds, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence], int]:
    """What is found and follows for all values of the parameters, inputs among them, and how many values were looked at."""
    checks = HYPOTHESIS_CHECKS.of(model)
    proofs, driven = checks.uniform, checks.driven if motion.names else None
    parametric_form = driven.parametric_form if driven else None
    still, box = parametric_form(model, region, runs) if parametric_form else (model, region)
    special = proofs.special_values(still, box.parameters) if proofs else ()
    proved = {finding.id: finding for finding in (proofs.findings(still, box, quick) if proofs else ())}
    ids = [hypothesis.id for hypothesis in checks.hypotheses]
    alike = bool(driven or not motion.names) and all(id in proved and uniform.is_same_for_all_values(proved[id]) for id in ids)
    values = uniform.sample_values(box.parameters, special)[: 1 if alike else None]
    at = [(one, still.bind(one)) for one in values]
    reports = [(one, *_check_quickly(bound, replace(box, parameters={}), runs)) for one, bound in at]
    seen = [(one, {item.id: item for item in found}) for one, found, _ in reports]
    if not alike:
        flat = replace(box, parameters={})
        seen += findings_at_roots(still, box.parameters, lambda exact_model: _check_quickly(exact_model, flat, runs)[0])
    findings = uniform.join_findings(box.parameters, seen, proved)
    if driven:
        findings = driven.findings(model, region, motion, findings, runs, quick) if driven.findings else findings
        made = driven.consequences(model, region, motion, findings, runs)
    elif proofs and not motion.names:
        made = proofs.consequences(model, region, findings)
    else:
        made = uniform.common_consequences([item for *_, item in reports], region.parameters)
        made = [unknown_consequence(item, CONSTANT_INPUTS_NOTE) for item in made] if motion.names else made
    made = time_limit_clauses(model, region, findings, made)
    return (
        findings,
        [replace(item, scope=intersect_scopes(item.scope, Scope(parameters=region.parameters))) for item in made],
        len(at),
    )


def _check_quickly(model: Model, box: Region, runs: Sequence[Trajectory]) -> tuple[list[Finding], list[Consequence]]:
    with quick_searches():
        found, made = HYPOTHESIS_CHECKS.of(model).decide(model, box, runs, True)
        return [finding for finding in found if not finding.id.startswith(RUN_FINDING_PREFIX)], made


def _with_violations_outside(model: Model, box: Region, runs: Sequence[Trajectory], findings: Sequence[Finding]) -> list[Finding]:
    """The findings; those that hold on the box alone with what is known to fail in one ten times as wide."""
    if not any(_holds_locally(finding) for finding in findings):
        return list(findings)
    with quick_searches():
        found = HYPOTHESIS_CHECKS.of(model).decide(
            model, box.widened(WIDER_REGION_FACTOR), runs, len(box.names) > MAX_THOROUGH_STATES
        )[0]
    wide = {other.id: other for other in found}
    return [
        replace(finding, outside=plain_witness({**wide[finding.id].witness, "how": wide[finding.id].how}))
        if _holds_locally(finding) and wide[finding.id].verdict == VIOLATED
        else finding
        for finding in findings
    ]


def _holds_locally(finding: Finding) -> bool:
    return finding.verdict == HOLDS and finding.scope is not None and bool(finding.scope.states)


def _make_report(
    model: Model, region: str, findings: Sequence[Finding], consequences: Sequence[Consequence],
    parameters: Mapping[str, float | None], notes: Sequence[str], quick: bool, inputs: Sequence[str] = (),
) -> Report:  # fmt: skip
    return Report(
        title=model.title or "untitled", model_class=type(model).__name__, paper=model.paper, region=region, quick=quick,
        findings=tuple(findings), consequences=tuple(consequences), parameters=dict(parameters), notes=tuple(notes), model=model,
        inputs=tuple(inputs),
    )  # fmt: skip


def _symbolic_report(
    symbolic: Callable[[Model], list[Finding]], model: Model, values: Mapping[str, float | None], missing: Sequence[str]
) -> Report:
    """The conditions on parameters that have no value."""
    note = f"parameters without value: {', '.join(missing)}; give them with parameters={{...}} or --set to decide the rest"
    return _make_report(model, "no region: parameters are symbols", symbolic(model), [], values, [note], False)


def _make_check_runs(model: Model, notes: list[str]) -> list[Trajectory]:
    """The model's own run, and for two classes one more from half way to where the first one ends."""
    t_end = _check_run_end(model)
    if t_end is not None and model.step is not None:
        notes.append(f"the run was cut at t = {t_end:g}, after {t_end / model.step:.0f} steps; check(model, [run]) takes any run")
    try:
        run = simulate(model, t_end=t_end)
    except StepError as error:
        notes.append(f"the run stopped: {error}")
        return [error.trajectory] if error.trajectory is not None and len(error.trajectory.t) > 1 else []
    except UsageError as error:
        notes.append(f"the model was not run: {error}")
        return []
    if HYPOTHESIS_CHECKS.of(model).compares_solutions:
        start = (run.x[0] + run.x[-1]) / 2
        if np.abs(start - run.x[0]).max() > ORDER_ROUND_OFF * np.abs(run.x).max():
            try:
                return [run, simulate(with_start(model, start), t_end=t_end)]
            except (StepError, UsageError) as error:
                notes.append(f"a second run from {start} was not possible: {error}")
    return [run]


def _check_run_end(model: Model) -> float | None:
    """Where to cut a long run whose steps are dear; None where it is run as the model says."""
    effort = HYPOTHESIS_CHECKS.of(model).effort
    few = effort.most_steps(model) if effort else MAX_CHECK_STEPS
    if model.step is None or model.t_end is None or model.t_end <= few * model.step:
        return None
    return few * model.step if effort or not read_step_structure(one_step_problem(model)).affine else None


def with_start(model: Model, x0: np.ndarray) -> Model:
    """The model from another start."""
    other = copy(model)
    other._set(**{f"{model.letter}0": ca.SX(ca.DM(x0))}, exact=None)
    return other
