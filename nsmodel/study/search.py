"""The search for the reference: a probe, the refined runs that fit in their time, the best of them, the closed form if any."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from nsmodel.errors import NsmodelError, StepError
from nsmodel.model.base import Model
from nsmodel.proof.sure import not_none
from nsmodel.scheme import one_step_problem
from nsmodel.simulate import prepare
from nsmodel.study.between import make_row_stepper
from nsmodel.study.methods import Method, not_compiled_reason
from nsmodel.study.reference import (
    Reference,
    ReferenceRows,
    closed_form_reference,
    event_driven_reference,
    nonuniqueness_reason,
    refined_run_reference,
)
from nsmodel.trajectory import Trajectory

REFINEMENT, MIN_REFINEMENT = (
    8,
    2,
)  # The reference has REFINED steps for one of the finest run; LEAST where there is no time for more.
EVENT_DRIVEN_RTOLS = 1e-9, 1e-11  # The rtol of a rougher run and of the reference.
MIN_STEP_COUNTS = 3  # So many numbers of steps are measured whatever their reference costs.
RUNS_WORK_RATIO = 1 + 1 / 2 + 1 / 4  # Steps of the three runs behind a reference, for one of the last.
MAX_REFERENCE_BYTES = 1 << 30  # Bytes that they may take.
MIN_PROBE_SECONDS = 0.02  # s: a run that takes so long tells what a step takes.


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
        return prepare(method.model, step=self.T / count, tolerance=self.tolerance, **method.options)

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
                done = run.go(progress=False)
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
            StepError: no refined run comes to its end, and there is no closed form.
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
            raise StepError(f"no refined run comes to its end, so there is nothing to compare with: {self.notes[-1]}")
        return self._event_driven_if_better(refined), kept, probe.run

    def _event_driven_if_better(self, refined: Reference) -> Reference:
        """An event-driven run as reference, where that applies, comes to its end in time, and errs less."""
        runs: list[Trajectory] = []
        until = time.perf_counter() + self.seconds / 2
        for rtol in EVENT_DRIVEN_RTOLS:
            self.report_status(f"reference: event-driven, rtol = {rtol:g}")
            try:
                run = prepare(self.model, rtol=rtol, method="event-driven")
                while not run.propagator.finished:
                    run.propagator.advance(1, ())
                    if time.perf_counter() > until:
                        return refined
                runs.append(run.go(progress=False))
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
                    made = run.go(progress=False)
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
