"""``nsmodel.check``: the hypotheses of a model's class, decided on its expressions and on runs made for the purpose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from importlib import import_module

import casadi as ca
import numpy as np

from nsmodel.errors import StepError, UsageError
from nsmodel.hypotheses.along import along
from nsmodel.hypotheses.findings import SAMPLED, Consequence, Finding, Hypothesis, Report
from nsmodel.hypotheses.region import region_of
from nsmodel.model.base import Model, shown
from nsmodel.model.first_order import FirstOrderSystem
from nsmodel.model.inclusion import MonotoneInclusion
from nsmodel.model.lure import LureSystem
from nsmodel.model.oscillator import FrictionOscillator
from nsmodel.model.sweeping import SweepingProcess
from nsmodel.scheme import one_step_problem
from nsmodel.simulate import simulate
from nsmodel.solve.structure import read
from nsmodel.trajectory import Trajectory

CLASSES: Mapping[type[Model], str] = {
    SweepingProcess: "sweeping",
    FrictionOscillator: "oscillator",
    FirstOrderSystem: "first_order",
    LureSystem: "lure",
    MonotoneInclusion: "inclusion",
}
ROUND_OFF = 1e-11  # Differences of runs below this part of the state are not told from rounding.
FEW_STEPS = 4000  # Steps looked at where each needs Newton's method.
ASYMPTOTIC = 0.3, 2.5  # Orders seen outside of this range are chance.


def hypotheses_of(kind: type[Model]) -> tuple[Hypothesis, ...]:
    """Return the hypotheses that are decided for a model class, in the order of its report."""
    return import_module(f"nsmodel.hypotheses.{CLASSES[kind]}.check").HYPOTHESES


def check(
    model: Model,
    runs: Sequence[Trajectory] | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    region: Mapping[str, tuple[float, float]] | None = None,
    quick: bool = False,
) -> Report:
    """Decide each hypothesis that the theory of this model class rests on, and say what follows.

    Args:
        model: any of the five classes. Parameters may stay without value for a LureSystem: the conditions on them are found.
        runs: finished runs of this model; left out, the model is run (twice more with larger steps, for the observed order,
            and for two classes from another start, for the contraction).
        parameters: values of parameters by name.
        region: {state or symbol: (low, high)}, where hypotheses about all states are decided if no proof covers them
            everywhere; states left out have an interval around the runs.
        quick: skip runs, global searches and local maximisation.

    Returns:
        the report: ``report["A5"].verdict``, ``report.findings``, ``report.consequences``, ``report.text()``.

    Raises:
        UsageError: no model, an unknown parameter or state, a parameter without value where numbers are needed.

    >>> from nsmodel import LureSystem, check, relay
    >>> report = check(LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[1, 0], t_end=1, step=0.1))
    >>> report["5.1"].verdict, report["5.2"].value["omega"]
    ('holds', 0.0)
    """
    if not isinstance(model, Model):
        raise UsageError(f"check: expected a model, such as LureSystem(...), not {shown(model)}")
    values = {**model.parameters, **(parameters or {})}
    missing = tuple(name for name, value in values.items() if value is None)
    if missing and isinstance(model, LureSystem):
        return _symbolic(model.bind(parameters, partly=True), values, missing)
    bound = model.bind(parameters)
    notes: list[str] = []
    given = runs is not None or quick
    own = list(runs or ()) if given else _runs(bound, notes)
    box = region_of(bound, own, region)
    module = import_module(f"nsmodel.hypotheses.{CLASSES[type(bound)]}.check")
    findings, consequences = module.check(bound, box, own, quick)
    if own:
        twin = own[1] if len(own) > 1 and len(own[1].t) == len(own[0].t) else None
        findings += along(bound, own[0], findings, twin)
        if not given:
            consequences += _observed_order(bound, own[0])
    return _report(bound, box.text, findings, consequences, getattr(bound, "bound_parameters", {}), notes, quick)


def _report(
    model: Model, region: str, findings: Sequence[Finding], consequences: Sequence[Consequence],
    parameters: Mapping[str, float | None], notes: Sequence[str], quick: bool,
) -> Report:  # fmt: skip
    return Report(
        title=model.title or "untitled", model_class=type(model).__name__, paper=model.paper, region=region, quick=quick,
        findings=tuple(findings), consequences=tuple(consequences), parameters=dict(parameters), notes=tuple(notes), model=model,
    )  # fmt: skip


def _symbolic(model: LureSystem, values: Mapping[str, float | None], missing: Sequence[str]) -> Report:
    """The conditions on parameters that have no value."""
    from nsmodel.hypotheses.lure.check import symbolic_findings

    note = f"parameters without value: {', '.join(missing)}; give them with parameters={{...}} or --set to decide the rest"
    return _report(model, "no region: parameters are symbols", symbolic_findings(model), [], values, [note], False)


def _runs(model: Model, notes: list[str]) -> list[Trajectory]:
    """The model's own run, and for two classes one more from half way to where the first one ends."""
    t_end = _end(model)
    if t_end is not None:
        notes.append(f"the run was cut at t = {t_end:g}, after {FEW_STEPS} steps; check(model, [run]) takes any run")
    try:
        run = simulate(model, t_end=t_end)
    except StepError as error:
        notes.append(f"the run stopped: {error}")
        return [error.trajectory] if error.trajectory is not None and len(error.trajectory.t) > 1 else []
    except UsageError as error:
        notes.append(f"the model was not run: {error}")
        return []
    if isinstance(model, LureSystem | MonotoneInclusion):
        start = (run.x[0] + run.x[-1]) / 2
        if np.abs(start - run.x[0]).max() > ROUND_OFF * np.abs(run.x).max():
            try:
                return [run, simulate(_started_at(model, start), t_end=t_end)]
            except (StepError, UsageError) as error:
                notes.append(f"a second run from {start} was not possible: {error}")
    return [run]


def _end(model: Model) -> float | None:
    """Where to cut a long run whose steps are dear; None where it is run as the model says."""
    if model.step is None or model.t_end is None or model.t_end <= FEW_STEPS * model.step:
        return None
    return None if read(one_step_problem(model)).affine else FEW_STEPS * model.step


def _started_at(model: Model, x0: np.ndarray) -> Model:
    other = copy(model)
    other._set(x0=ca.SX(ca.DM(x0)), exact=None)
    return other


def _observed_order(model: Model, run: Trajectory) -> list[Consequence]:
    """log2 of the ratio of differences between runs with steps 4h, 2h, h, at common times."""
    h, N = model.step, len(run.t) - 1
    if h is None or N < 16 or run.status != "done":
        return []
    try:
        coarse = [simulate(model, step=factor * h, t_end=float(run.t[-1])).x for factor in (2, 4)]
    except (StepError, UsageError):
        return []
    rows = min(N // 4, (len(coarse[0]) - 1) // 2, len(coarse[1]) - 1)
    if N % 4:
        rows -= 1  # the last row of a coarse run may be a shortened step
    a, b, c = run.x[: 4 * rows + 1 : 4], coarse[0][: 2 * rows + 1 : 2], coarse[1][: rows + 1]
    start = 1 if getattr(model, "x1", None) is None else 2
    fine, wide = np.abs(b - a)[start:].max(initial=0.0), np.abs(c - b)[start:].max(initial=0.0)
    floor = ROUND_OFF * max(np.abs(run.x).max(), np.finfo(float).tiny)
    value = {"difference h, 2h": fine, "difference 2h, 4h": wide, "h": h}
    if fine <= floor:
        statement = "runs with steps 4h, 2h, h agree to rounding: the scheme is exact on this scene"
    elif not ASYMPTOTIC[0] <= (order := np.log2(wide / fine) if wide else 0.0) <= ASYMPTOTIC[1]:
        statement = "no order is seen at steps 4h, 2h, h: they are too large, or switches fall between rows differently"
    else:
        value = {"order": order, **value}
        statement = "the error shrinks like h^order, seen at steps 4h, 2h, h"
    error = run.metadata["totals"].get("largest_error")
    if error is not None:
        value["largest error"] = error
    return [Consequence("observed order", statement, (), SAMPLED, {k: float(v) for k, v in value.items()}, "measured on runs")]
