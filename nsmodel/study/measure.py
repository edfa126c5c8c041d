"""The study itself: the steps, the reference, every method at every step within a budget of time."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from nsmodel.checking import check
from nsmodel.classes.registry import class_of
from nsmodel.defaults import DEFAULT_TOLERANCE
from nsmodel.errors import NsmodelError, UsageError
from nsmodel.grid import format_value, input_schedule, is_number
from nsmodel.hypotheses.along import findings_along_run
from nsmodel.hypotheses.findings import Finding
from nsmodel.model.arguments import describe_argument
from nsmodel.model.base import Model
from nsmodel.model.driven import with_inputs_at_any_step
from nsmodel.model.inputs import Signals
from nsmodel.model.parameters import Values
from nsmodel.notebook import has_live_display
from nsmodel.proof.sure import not_none
from nsmodel.study import methods
from nsmodel.study.lines import POINT_DONE, POINT_LEFT_OUT, SCHEME_LINE, SOLVER_LINE, Line, Point
from nsmodel.study.methods import Method, TimedRun
from nsmodel.study.reference import Reference, ReferenceRows
from nsmodel.study.result import Study, StudyInterrupted
from nsmodel.study.search import MIN_STEP_COUNTS, ReferenceSearch
from nsmodel.study.text import short_number
from nsmodel.trajectory import Trajectory

DEFAULT_BUDGET = 60.0  # s
PHASE_DEADLINES = {"schemes": 0.7, "variable steps": 0.85}  # Parts of what the reference leaves, after which none is begun.
ALWAYS_MEASURED_SECONDS = 0.05  # s: a point that takes less is measured even where its line has used up its share.
COARSEST_FACTOR, FINEST_FACTOR = 16, 8  # The default steps: from COARSEST h to h / FINEST, halved each time.
MIN_COARSEST_STEPS = 8  # Steps of the coarsest run, at least, where the model's own has more.
TOLERANCE_WORK_RATIO = 10.0**0.5  # Steps that a tolerance ten times smaller takes for one, where order is two.
EVENT_DRIVEN_WORK_RATIO = 2.0  # Of pieces.
BUDGET_SHARES = {"reference": 1 / 3, SCHEME_LINE: 1 / 4, SOLVER_LINE: 1 / 16}  # Parts of the budget that one of these may take.


def study(
    model: Model,
    *,
    steps: Sequence[float] | None = None,
    target: float | None = None,
    t_end: float | None = None,
    parameters: Values | None = None,
    inputs: Signals | None = None,
    solvers: Sequence[str] | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
    budget: float = DEFAULT_BUDGET,
    progress: bool = False,
) -> Study:
    """Measure how accurate a model's schemes are for what they cost, and return the lines of a work-precision diagram.

    Args:
        model: of any class but ManyBodies.
        steps: time steps; left out: 16 h, 8 h, ... h/8 around the model's own h, changed a little so that the grids nest.
        target: a relative error whose price is wanted.
        t_end, parameters, inputs: override the model's own.
        solvers: solvers to run alone beside the default chain; left out: all that are installed and apply; []: none.
        tolerance: largest accepted residual of a step.
        budget: wall time in seconds that the study may take, a third of it for the reference; runs that would exceed it are
            left out, and named.
        progress: say on standard error what is measured, at a terminal or in a notebook.

    Raises:
        UsageError: a wrong argument; a solver that is unknown; a model of many bodies; an input that is `steps`.
        StepError: no run with small steps comes to its end: there is nothing to compare with.
        StudyInterrupted: Ctrl-C; ``error.study`` holds what was measured.
    """
    if not isinstance(model, Model):
        raise UsageError(
            f"study: expected a model such as LureSystem(...), not {describe_argument(model)}; a file is read with nsmodel.load"
        )
    model.check_allowed("study")
    for name, value in (("target", target), ("budget", budget), ("t_end", t_end)):
        if value is not None and not (is_number(value) and np.isfinite(value) and value > 0):
            raise UsageError(f"{name} = {format_value(value)}; expected a finite number > 0")
    if isinstance(solvers, str):
        raise UsageError(f"solvers = {solvers!r}; expected a list of names")
    bound = copy(with_inputs_at_any_step(model, "study", inputs).bind(parameters))
    exact = bound.exact
    T = float(bound.t_end if t_end is None else t_end)
    bound._set(exact=None, steps=None, t_end=T, step=_default_step_size(bound, T))  # comparing is not part of what is timed
    counts = (
        _default_step_counts(T, not_none(bound.step), input_schedule(bound, T).points.size)
        if steps is None
        else _given_step_counts(steps, T)
    )
    session = _StudySession(bound, T, exact, tolerance, float(budget), progress)
    try:
        session.run(counts, steps is None, solvers)
    except KeyboardInterrupt:
        raise StudyInterrupted(session.result(target, "interrupted")) from None
    return session.result(target, POINT_DONE)


def _default_step_size(model: Model, T: float) -> float:
    if model.step is not None:
        return float(model.step)
    return T / (256 if model.steps is None else len(model.steps))


def _default_step_counts(T: float, h: float, points: int = 0) -> list[float]:
    """Numbers of steps, each twice the one before, from about T / (16 h) to 8 T / h.

    Where steps end at so many points, the coarsest that go beyond most of them are left out.
    """
    own = max(T / h, 1.0)
    first = max(round(own / COARSEST_FACTOR), min(MIN_COARSEST_STEPS, round(own)), 1)
    counts = [float(first << j) for j in range(1 + int(math.log2(1.01 * FINEST_FACTOR * own / first)))]
    return [count for count in counts[:-MIN_STEP_COUNTS] if count > points] + counts[-MIN_STEP_COUNTS:]


def _given_step_counts(steps: Any, T: float) -> list[float]:
    """Numbers of steps, not always whole, for the steps that the user wants."""
    if isinstance(steps, str | bytes) or np.ndim(steps) != 1 or not len(steps):
        raise UsageError(f"steps: expected a list of numbers > 0, such as [1e-2, 5e-3], not {describe_argument(steps)}")
    for k, step in enumerate(steps):
        if not (is_number(step) and np.isfinite(step) and 0 < step <= T):
            raise UsageError(f"steps[{k}] = {format_value(step)}; expected a number > 0 and at most t_end = {T:g}")
    return sorted({T / float(step) for step in steps})


class _StudySession:
    """What a study has measured so far."""

    def __init__(self, model: Model, T: float, exact: Any, tolerance: float, budget: float, progress: bool) -> None:
        self.model, self.T, self.exact, self.tolerance, self.budget = model, T, exact, tolerance, budget
        self.reports_status = progress and has_live_display()
        self.begin, self.until = time.perf_counter(), budget
        self.reference: Reference | None = None
        self.lines: dict[str, Line] = {}
        self.notes: list[str] = []
        self.findings: list[Finding] | None = None
        self.measuring_times: dict[str, tuple[float, float, float]] = {}  # last point: preparing, running; all points: in all
        self.kept: dict[str, list[tuple[Point, ReferenceRows]]] = {}

    def run(self, counts: list[float], may_drop: bool, solvers: Sequence[str] | None) -> None:
        """Find the reference, then measure: the schemes first, solvers alone last."""
        own, *others = methods.scheme_methods(self.model)
        alone = methods.single_solver_methods(own, solvers)
        search = ReferenceSearch(
            self.model, self.T, self.tolerance, self.budget * BUDGET_SHARES["reference"], self.report_status, self.notes
        )
        self.reference, counts, first = search.find(self.exact, methods.backend_methods(own), others, counts, may_drop)
        self.findings = self._check_hypotheses(first)
        now, rest = time.perf_counter() - self.begin, self.budget * (1 - BUDGET_SHARES["reference"])
        self.until = now + rest * PHASE_DEADLINES["schemes"]
        self._measure_constant_steps([way for scheme in (own, *others) for way in methods.backend_methods(scheme)], counts)
        self.until = now + rest * PHASE_DEADLINES["variable steps"]
        self._measure_error_controlled(
            methods.event_driven_methods(self.model), (*methods.STUDY_RTOLS, *methods.FINE_RTOLS), EVENT_DRIVEN_WORK_RATIO
        )
        variable = [way.with_options("variable steps", method="time-stepping") for way in methods.backend_methods(own)]
        self._measure_error_controlled(variable, methods.STUDY_RTOLS, TOLERANCE_WORK_RATIO)
        self._extrapolate_runs(methods.backend_methods(own))
        self.until = now + rest
        self._measure_constant_steps(alone, counts)

    def _measure_constant_steps(self, chosen: list[Method], counts: list[float]) -> None:
        """Constant steps, all methods at one before the next: what the budget cuts off is the finest."""
        self.lines |= {method.name: Line(method.name, (), kind=method.kind) for method in chosen}
        for i, count in enumerate(counts):
            for method in chosen:
                self._measure_point(
                    method, f"h = {self.T / count:.4g}", {"step": self.T / count}, count / counts[i - 1] if i else 1.0
                )

    def _measure_error_controlled(self, chosen: Sequence[Method], tolerances: Sequence[float], ratio: float) -> None:
        """Errors that are asked for."""
        self.lines |= {method.name: Line(method.name, ()) for method in chosen}
        for rtol in tolerances:
            for method in chosen:
                self._measure_point(method, f"rtol = {short_number(rtol)}", {"rtol": rtol}, ratio)

    def _extrapolate_runs(self, ways: Sequence[Method]) -> None:
        """Richardson's extrapolation of whole runs, at the cost of both: of compiled runs where there are some."""
        way = max(ways, key=lambda way: (len(self.kept.get(way.name, [])), way is ways[-1]))
        p, points = way.order, []
        for (wide, coarse), (near, fine) in pairwise(self.kept.get(way.name, [])):
            if len(fine.t) == 2 * len(coarse.t) - 1 and np.allclose(fine.t[::2], coarse.t, rtol=0, atol=1e-9 * self.T):
                rows = ReferenceRows(coarse.t, (2**p * fine.x[::2] - coarse.x) / (2**p - 1))
                seconds = not_none(wide.seconds) + not_none(near.seconds)
                point = not_none(self.reference).point(f"{wide.label} and h/2", rows, seconds, wide.step)
                points.append(replace(point, steps=not_none(wide.steps) + not_none(near.steps)))
        name = way.with_options("Richardson").name
        self.lines[name] = Line(name, tuple(points), f"(2^p x_h/2 - x_h)/(2^p - 1) with p = {p}, at the cost of both runs")

    def _measure_point(self, method: Method, label: str, options: dict[str, Any], ratio: float) -> None:
        """Measure one point, of ``ratio`` times the work of the last, or leave it out; a line that does not apply goes."""
        if method.name not in self.lines:
            return
        preparing, running, spent = self.measuring_times.get(method.name, (0.0, 0.0, 0.0))
        expected, gone = preparing + running * ratio, time.perf_counter() - self.begin
        share = self.budget * BUDGET_SHARES[method.kind]
        line, step = self.lines[method.name], options.get("step")
        cut = any(point.status == POINT_LEFT_OUT for point in line.points)
        if cut or gone + expected > self.until or (expected > ALWAYS_MEASURED_SECONDS and spent + expected > share):
            self._add_point(method, Point.left_out(label, "the time budget", step=step))
            return
        self.report_status(f"{method.name}, {label}")
        start = time.perf_counter()
        try:
            measured = methods.time_runs(method.model, {**options, **method.options, "tolerance": self.tolerance})
        except NsmodelError as error:
            if isinstance(error, UsageError) and not line.points:
                self._drop_method(method, str(error))
                return
            self._add_point(method, Point.failed(label, str(error), step=step))
            preparing, running = 0.0, time.perf_counter() - start
        else:
            why = methods.not_compiled_reason(measured.run.metadata["warnings"])
            if why and method.options.get("compiled"):
                self._drop_method(method, why)
                return
            preparing, running = measured.preparing, measured.running
            self._add_point(method, self._make_point(label, measured, step, method))
        self.measuring_times[method.name] = preparing, running, spent + time.perf_counter() - start

    def _drop_method(self, method: Method, why: str) -> None:
        del self.lines[method.name]
        self.notes.append(f"{method.name} is left out: {why}")

    def _add_point(self, method: Method, point: Point) -> None:
        line = self.lines[method.name]
        self.lines[method.name] = replace(line, points=(*line.points, point))

    def _make_point(self, label: str, measured: TimedRun, step: float | None, method: Method) -> Point:
        run, rows = measured.run, ReferenceRows.of(measured.run)
        totals = run.metadata["totals"]
        point = replace(
            not_none(self.reference).point(label, rows, measured.seconds, step),
            steps=int(totals["steps"]),
            setup=measured.setup,
            residual=float(totals["worst_residual"]),
            **self._run_inequality_values(run),
        )
        if step is not None and method.kind == SCHEME_LINE:
            self.kept.setdefault(method.name, []).append((point, ReferenceRows(rows.t, rows.x)))
        return point

    def _check_hypotheses(self, run: Trajectory) -> list[Finding] | None:
        """What the inequalities along a run rest on; None where the class promises none."""
        if class_of(self.model).optional("hypotheses.along") is None:
            return None
        try:
            return list(check(self.model, [run], quick=True).findings)
        except NsmodelError:
            return None

    def _run_inequality_values(self, run: Trajectory) -> dict[str, float]:
        """Deepest violation of a constraint, and largest gain of energy beside that at the start."""
        if self.findings is None:
            return {}
        found = {finding.id: finding.value for finding in findings_along_run(self.model, run, self.findings)}
        values = {}
        if "least value" in found.get("run-feasible", {}):
            values["violation"] = max(0.0, -found["run-feasible"]["least value"])
        if "largest excess" in found.get("run-energy", {}) and "rtol" not in run.metadata["totals"]:
            energy = run.energy[np.isfinite(run.energy)]
            size = abs(energy[0]) or np.abs(energy).max() or 1.0
            values["energy"] = float(max(0.0, found["run-energy"]["largest excess"]) / size)
        return values

    def result(self, target: float | None, status: str) -> Study:
        """Return what there is."""
        self.report_status("")
        return Study(
            title=self.model.title or "untitled",
            model_class=type(self.model).__name__,
            states=len(self.model.names),
            t_end=self.T,
            time_unit=self.model.units.get("t", ""),
            lines=tuple(line for line in self.lines.values() if line.points),
            reference=self.reference,
            target=target,
            status=status,
            notes=tuple(self.notes),
            seconds=time.perf_counter() - self.begin,
        )

    def report_status(self, message: str) -> None:
        """Show what is being done, in place of what was."""
        if self.reports_status:
            sys.stderr.write(f"\r\x1b[K{message[:90]}")
            sys.stderr.flush()
