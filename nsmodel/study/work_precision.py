"""The study itself: the steps, the reference, every method at every step within a budget of time.

The search for the reference: a probe, the refined runs that fit in their time, the best of them, the closed form if any.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from nsmodel._utils import DEFAULT_TOLERANCE, checks_keywords, has_live_display
from nsmodel.errors import NsmodelError, StepError, UsageError
from nsmodel.hypotheses.along_run import findings_along_run
from nsmodel.hypotheses.check import check
from nsmodel.hypotheses.findings import Finding
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.modeling.base import Model
from nsmodel.modeling.inputs import Signals
from nsmodel.modeling.parameters import Values, describe_argument
from nsmodel.modeling.time_grid import format_value, input_schedule, is_number
from nsmodel.modeling.variants import with_inputs_at_any_step
from nsmodel.proof.verdict import not_none
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.study import methods
from nsmodel.study.lines import POINT_DONE, POINT_LEFT_OUT, SCHEME_LINE, SOLVER_LINE, Line, Point
from nsmodel.study.methods import Method, TimedRun, not_compiled_reason
from nsmodel.study.reference import (
    Reference,
    ReferenceRows,
    closed_form_reference,
    event_driven_reference,
    make_row_stepper,
    nonuniqueness_reason,
    refined_run_reference,
)
from nsmodel.study.result import Study, StudyInterrupted, short_number

REFINEMENT = 8  # Steps of the reference for one of the finest run: at order 1 its error is then an eighth;
MIN_REFINEMENT = 2  # where there is no time for more.
# The rtol of a rougher run and of the reference: their difference is the error of the first, far above that of the second.
EVENT_DRIVEN_RTOLS = 1e-9, 1e-11
MIN_STEP_COUNTS = 3  # So many numbers of steps are measured whatever their reference costs: fewer show no order.
RUNS_WORK_RATIO = 1 + 1 / 2 + 1 / 4  # Steps of the three runs behind a reference, for one of the last.
MAX_REFERENCE_BYTES = 1 << 30  # Bytes that the three runs behind a reference may take, 1 GB; finer ones are not made.
MIN_PROBE_SECONDS = 0.02  # s: a run that takes so long tells what a step takes; shorter ones measure the clock and the set-up.


@dataclass(frozen=True)
class ProbeRun:
    """A first run: the method that made it, wall seconds of its preparation and of one of its steps."""

    method: Method
    run: Trajectory
    setup: float
    seconds_per_step: float


@dataclass(frozen=True)
class ReferenceSearch:
    """What the search needs: the model, its end, the tolerance, seconds of wall time; ``say`` tells what is done."""

    model: Model
    T: float
    tolerance: float
    seconds: float
    report_status: Callable[[str], None]
    notes: list[str]

    def prepare_run(self, method: Method, count: float) -> Any:
        """Return a run of so many steps, ready to go."""
        return prepared_loop(method.model, step=self.T / count, tolerance=self.tolerance, **method.options)

    def run_probe(self, method: Method, counts: Sequence[float]) -> ProbeRun:
        """Run a method with the first number of steps that tells.

        Raises:
            StepError: no run comes to its end.
        """
        found, failure = None, None
        for count in counts:
            self.report_status(f"{method.name}, {count:.0f} steps")
            start = time.perf_counter()
            run = self.prepare_run(method, count)
            setup, start = time.perf_counter() - start, time.perf_counter()
            try:
                done = run.go()
            except StepError as error:
                failure = error
                continue
            wall = time.perf_counter() - start
            found = ProbeRun(method, done, setup, wall / count)
            if wall > MIN_PROBE_SECONDS or setup > 10 * MIN_PROBE_SECONDS:
                break
        if found is None:
            raise failure or StepError("no steps were given")
        return found

    def find(
        self, exact: Any, ways: Sequence[Method], others: Sequence[Method], counts: list[float], may_drop: bool
    ) -> tuple[Reference, list[float], Trajectory]:
        """Return the reference, the numbers of steps left where one for the finest would take too long, and a first run.

        It is interpreted where there is time for that, else compiled.

        Raises:
            StepError: no refined run finishes, and there is no closed form.
        """
        interpreted, compiled = ways
        probe = self.run_probe(interpreted, counts)
        why = nonuniqueness_reason(self.model, one_step_problem(self.model), probe.run)
        if exact is not None and why:
            return closed_form_reference(exact, self.model, probe.run.t, None, why), counts, probe.run
        finer = [other for other in others if other.order > interpreted.order]
        most = self._max_steps(probe, 1 + len(finer))
        if counts[-1] * REFINEMENT > most:
            with_c = self.run_probe(compiled, counts)
            if not not_compiled_reason(with_c.run.metadata["warnings"]) and self._max_steps(with_c, 1 + len(finer)) > most:
                probe, most = with_c, self._max_steps(with_c, 1 + len(finer))
        kept, factor = list(counts), REFINEMENT
        while may_drop and exact is None and len(kept) > MIN_STEP_COUNTS and kept[-1] * factor > most:
            kept.pop()
        while factor > MIN_REFINEMENT and kept[-1] * factor > most:
            factor //= 2
        if len(kept) < len(counts):
            gone = ", ".join(f"h = {self.T / count:.4g}" for count in counts[len(kept) :])
            self.notes.append(f"{gone}: left out, their reference would take more than {self.seconds:.3g} s; see budget")
        quick = probe.method
        candidates = [quick, *(replace(quick, name=other.name, model=other.model, order=other.order) for other in finer)]
        refined = self._best_refined_run(candidates, kept[-1] * factor, why)
        if exact is not None:
            return closed_form_reference(exact, self.model, probe.run.t, refined, why), kept, probe.run
        if refined is None:
            raise StepError(f"no refined run finishes, so there is nothing to compare with: {self.notes[-1]}")
        return self._event_driven_if_better(refined), kept, probe.run

    def _event_driven_if_better(self, refined: Reference) -> Reference:
        """An event-driven run as reference, where that applies, comes to its end in time, and errs less."""
        runs: list[Trajectory] = []
        until = time.perf_counter() + self.seconds / 2
        for rtol in EVENT_DRIVEN_RTOLS:
            self.report_status(f"reference: event-driven, rtol = {rtol:g}")
            try:
                run = prepared_loop(self.model, rtol=rtol, method="event-driven")
                while not run.propagator.finished:
                    run.propagator.advance(1, ())
                    if time.perf_counter() > until:
                        return refined
                runs.append(run.go())
            except NsmodelError:
                return refined
        found, doubt = event_driven_reference(self.model, EVENT_DRIVEN_RTOLS[1], runs[0], runs[1], refined)
        if doubt:
            self.notes.append(doubt)
            return found
        return found if found.own["max"] < refined.own["max"] else refined

    def _max_steps(self, probe: ProbeRun, candidates: int) -> float:
        """The steps that a reference can have: there are three runs for each candidate."""
        left = self.seconds / candidates - 3 * probe.setup
        row = 8 * (len(self.model.names) + 3 * probe.run.multipliers.shape[1] + 8)
        return min(left / probe.seconds_per_step, MAX_REFERENCE_BYTES / row) / RUNS_WORK_RATIO

    def _best_refined_run(self, candidates: Sequence[Method], count: float, why: str) -> Reference | None:
        """The candidates that show the least error of their own, in states and in multipliers; None where none ends."""
        found: list[Reference] = []
        for method in candidates:
            runs = []
            try:
                for n in (count / 4, count / 2, count):
                    self.report_status(f"reference: {n:.0f} steps, {method.name}")
                    run = self.prepare_run(method, n)
                    start = run.propagator.state.copy()
                    made = run.go()
                    runs.append(ReferenceRows.of(made))
                step = make_row_stepper(run.propagator, start, made)
            except NsmodelError as error:
                self.notes.append(f"no reference by {method.name} with {count:.0f} steps: {error}")
            else:
                found.append(refined_run_reference(self.model, f"a run of {count:.0f} steps, {method.name}", runs, why, step))
        if not found:
            return None
        best = min(found, key=lambda reference: reference.own["max"])
        if "multipliers" not in best.own:
            return best
        # theta = gamma = 1/2 may have the better states, and multipliers that swing from step to step.
        calm = min(found, key=lambda reference: reference.own["multipliers"])
        rows = replace(not_none(best.rows), multipliers=not_none(calm.rows).multipliers)  # Both have the same times.
        return replace(best, run=calm.run, rows=rows, own={**best.own, "multipliers": calm.own["multipliers"]})


DEFAULT_BUDGET = 60.0  # Seconds for a whole study, where none are given: what a person waits for, once.
PHASE_DEADLINES = {"schemes": 0.7, "variable steps": 0.85}  # Parts of what the reference leaves, after which none is begun.
# s: a point that takes less is measured even where its line has used up its share: about a thousandth of the default budget.
ALWAYS_MEASURED_SECONDS = 0.05
COARSEST_FACTOR = 16  # The default steps: from 16 times the model's own,
FINEST_FACTOR = 8  # to an eighth of it, halved each time: eight points about the step that the model was written with.
MIN_COARSEST_STEPS = 8  # Steps of the coarsest run, at least, where the model's own has more: with fewer nothing is resolved.
TOLERANCE_WORK_RATIO = 10.0**0.5  # Steps that a tolerance ten times smaller takes for one, where order is two.
# Pieces that an rtol ten times smaller takes for one, at most, when time is planned: their order rises with it.
EVENT_DRIVEN_WORK_RATIO = 2.0
BUDGET_SHARES = {"reference": 1 / 3, SCHEME_LINE: 1 / 4, SOLVER_LINE: 1 / 16}  # Parts of the budget that one of these may take.


@checks_keywords
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
        pieces = methods.backend_methods(Method("event-driven", self.model, {"method": "event-driven"}))
        self._measure_error_controlled(pieces, (*methods.STUDY_RTOLS, *methods.FINE_RTOLS), EVENT_DRIVEN_WORK_RATIO)
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
        if HYPOTHESIS_CHECKS.of(self.model).along_run is None:
            return None
        try:
            return list(check(self.model, [run], quick=True).findings)
        except NsmodelError:
            return None

    def _run_inequality_values(self, run: Trajectory) -> dict[str, Any]:
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
