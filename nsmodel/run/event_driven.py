"""The walk of event-driven integration: its rows are the ends of pieces, or the times asked for, read off the polynomials."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.errors import StepError, StorageError
from nsmodel.grid import Grid, check_times
from nsmodel.hypotheses.quick import refuse_start, warnings_of
from nsmodel.identity import settings
from nsmodel.model.base import Model
from nsmodel.pieces.course import Course
from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.piece import Piece
from nsmodel.pieces.stretch import BUDGET, Stretches
from nsmodel.run.asked import times, tolerances
from nsmodel.run.options import METHODS, Options
from nsmodel.run.piece_rows import PieceRows
from nsmodel.run.walk import PER_CENT, check_exact, note_distance_to_exact, runaway
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.solve.choose import Plan

if TYPE_CHECKING:
    from nsmodel.run.certified import Certified

METHOD = METHODS[1]
MOST = 10_000_000  # Pieces after which a run stops.
LARGE = 10_000  # Operations of f, g and h up to which "auto" is event-driven.


def problem_of(model: Model) -> ContinuousProblem:
    """Return the model in continuous time, as this method takes it.

    Raises:
        NotEventDriven: what it cannot take, by name.
    """
    module = class_of(model).optional("continuous")
    if module is None:
        raise NotEventDriven("many bodies change their contacts at nearly every step; they are for time stepping")
    problem = module.continuous_problem(model)
    curved = [block.label for _, block in problem.law.parts() if not block.separable]
    if curved:
        raise NotEventDriven(f"the law '{curved[0]}' is no box; its sets are for time stepping")
    return problem


class EventDriven:
    """The walk of event-driven integration; see `walk.Walk`. Rows and pieces stay in memory."""

    N: int = MOST

    def __init__(self, model: Model, options: Options, problem: ContinuousProblem) -> None:
        check_times(t_end=options.t_end)
        self.model: Any = model
        self.options, self.problem = options, problem
        self.T = float(model.t_end if options.t_end is None else options.t_end)
        rtol, atol = tolerances(problem, options.rtol, options.atol)
        self.times = None if options.times is None else times(options.times, self.T)
        refuse_start(model)
        check_exact(model)
        _refuse_large(problem, options)
        self.integrator = Integrator(problem, rtol, atol, model.switch_times)
        self.course = self._course(rtol, atol)
        self.record, self.k = PieceRows(problem, self.integrator.system, options.save_every), 0
        self._cut: dict[str, Any] | None = None  # The checkpoint before a piece that goes beyond the end.
        self.plan = _plan(self.integrator, options)
        self.certified: Certified | None = None
        self.warnings = warnings_of(model, self.plan)
        self.counts: Counter[str] = Counter()
        self.totals: dict[str, Any] = {
            "worst_residual": 0.0, "worst_residual_t": None, "index_set_changes": 0, "steps": 0, "rtol": rtol,
            "order": self.integrator.order, "pieces": 0, "events": 0, "worst_estimate": 0.0, "worst_estimate_t": None,
            "stretches": [],
        }  # fmt: skip
        own = {"step": "pieces", "rtol": rtol, "atol": atol, "rows": "ends of pieces" if self.times is None else "times"}
        same = settings(model, Grid(1, 1.0, 1.0), METHOD, options.tolerance, options.save_every, "interpreted")
        self.settings = same | own

    def _course(self, rtol: float, atol: list[float]) -> Course:
        """What goes on, with stretches of steps where "auto" lets it; StepError where it cannot start."""
        integrator, options = self.integrator, self.options
        if options.method == METHOD or options.certified:
            if integrator.stopped is not None:
                raise StepError(integrator.stopped)
            return Course(integrator, None)
        sizes, width = integrator.sizes.x, integrator.system.orders + 1
        known = integrator.known_times
        return Course(integrator, Stretches(self.problem, rtol, atol, options.tolerance, known, sizes, width))

    # -- as the loop sees it

    @property
    def bar(self) -> dict[str, Any]:
        """Per cent."""
        return PER_CENT

    @property
    def passed(self) -> float:
        """Per cent of the time."""
        return 100 * min(self.time / self.T, 1.0)

    @property
    def ended(self) -> bool:
        """Whether the pieces reach the end of the time."""
        return self.time >= self.T

    @property
    def time(self) -> float:
        """Where the next piece starts."""
        return self.course.t

    @property
    def h(self) -> float:
        """The unit of time of the next piece."""
        return self.integrator.place.tau

    @property
    def runaway(self) -> tuple[str, float] | None:
        """Name and value of the largest state, where it is beyond what can be computed with."""
        return runaway(self.problem.names, np.array(self.course.x))

    def warm_up(self) -> None:
        """Everything is built."""

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Integrate so many pieces."""
        for _ in range(steps):
            if self.ended or stop:
                return
            before = None if self.options.folder is None else self._checkpoint()
            rows, listed = self.record.filled, len(self.record.pieces)
            for piece in self.course.advance():
                if piece.end > piece.t and piece.t < self.T:
                    self._take(piece)
            if before is not None and self.time > self.T:
                listed = len(self.record.pieces) - listed
                self._cut = before | {"cut": {"rows": self.record.filled - rows, "listed": listed}}
            if self.totals["pieces"] > MOST:
                raise StepError(f"{MOST:,} pieces, and more are needed: ask for less accuracy (rtol)")

    def _take(self, piece: Piece) -> None:
        totals, integrator, end = self.totals, self.integrator, min(piece.end, self.T)
        times, last = [end], end >= self.T
        if self.times is not None:
            stop = bisect_right(self.times, end)
            times, last = self.times[self.record.carried.rows : stop], stop == len(self.times)
        self.record.take(piece, times, last)
        self.k = self.record.carried.rows
        if piece.residual is None and piece.defect > totals["worst_estimate"]:
            totals["worst_estimate"], totals["worst_estimate_t"] = piece.defect, piece.t
        totals["events"] += piece.event is not None
        totals |= {"steps": self.k, "pieces": totals["pieces"] + 1, "touches": integrator.touches}
        totals |= {"unique": dict(integrator.unique), "redundant": integrator.redundant}
        totals["index_set_changes"] = totals["events"]
        totals["stretches"] = [dict(one) for one in self.course.past]

    def note(self) -> None:
        """The distance to the exact state, the worst residual, and the certificate that was asked for."""
        if self.options.certified and self.record.pieces:
            from nsmodel.run.certified import certified

            self.certified = certified(self.integrator, self.record.pieces, self.T, self.totals["rtol"])
        self._note(self.totals, self.record.filled)
        if self._cut is not None:
            self._note(self._cut["totals"], self.record.filled - self._cut["cut"]["rows"])

    def _note(self, totals: dict[str, Any], rows: int) -> None:
        if rows:
            t, x, residual = (self.columns()[name][:rows] for name in ("t", "x", "residual"))
            note_distance_to_exact(self.model, totals, t, x)
            row = int(np.nan_to_num(residual).argmax())
            if residual[row] > totals["worst_residual"]:
                totals |= {"worst_residual": float(residual[row]), "worst_residual_t": float(t[row])}

    def columns(self) -> dict[str, np.ndarray]:
        """The rows in memory as the arrays of a trajectory, and the pieces as lists."""
        arrays = self.record.columns()
        return arrays if self.certified is None else arrays | self.certified.arrays(self.record.numbers, arrays["t"], arrays["x"])

    # -- for files

    def standing(self) -> dict[str, Any]:
        """What to continue from; ``cut``: how many rows and pieces before the end, where a piece goes beyond it."""
        return self._checkpoint() if self._cut is None else self._cut

    def _checkpoint(self) -> dict[str, Any]:
        return {
            "k": self.k, "t": self.time, "totals": dict(self.totals), "rows": self.record.standing(),
            "course": self.course.standing(), "cut": None,
        }  # fmt: skip

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.course.stand(saved["course"])
        self.record.stand(saved["rows"])
        if self.time > self.T:
            raise StorageError(f"the run there has reached t = {self.time:.10g}, past this run's end; give a later end")
        if self.times is not None and saved["rows"]["t"] not in [0.0, *self.times[: self.k]]:
            raise StorageError(f"times: the run there has a row at t = {saved['rows']['t']:.10g}; give its times, and later ones")

    def metadata(self) -> dict[str, Any]:
        """What was integrated, and how."""
        p = self.problem
        return {
            "scheme": f"event-driven: Taylor series of order {self.integrator.order}",
            "multiplier_names": list(p.rows if p.multipliers is None else p.declared),
            "index_names": list(p.rows),
            "law_kinds": p.law.labels,
            "tolerance": self.options.tolerance,
            "warnings": [*self.warnings, *_of_stretches(self.totals["stretches"])],
        } | ({} if self.certified is None else {"certificate": self.certified.metadata(p.names)})


def _of_stretches(stretches: list[dict[str, Any]]) -> list[str]:
    """What a user must know of the stretches: that there are some and why, and whether rtol is missed."""
    if not stretches:
        return []
    first, steps, error = stretches[0], sum(one["steps"] for one in stretches), sum(one["estimate"] for one in stretches)
    count = "once" if len(stretches) == 1 else f"{len(stretches)} times"
    found = [
        f"event-driven integration stopped {count}, first: {first['why']}; {steps} time steps, from t = {first['start']:.10g} to "
        f"{first['until']:.10g}{' and later' if len(stretches) > 1 else ''} (run.stepped)"
    ]
    return found + ([f"rtol is missed: the errors of these steps add up to about {error:.2g} rtol"] if error > 1 else [])


def _refuse_large(problem: ContinuousProblem, options: Options) -> None:
    """Refuse what would take longer than steps, unless it is asked for."""
    size = sum(ca.n_nodes(part) for part in (problem.f, problem.g, problem.h))
    if options.method != METHOD and size > LARGE:
        raise NotEventDriven(f"f, g and h have {size} operations, and each event ends a piece of all of them; steps cost less")


def _plan(integrator: Integrator, options: Options) -> Plan:
    system = integrator.system
    used = [
        f"event-driven: Taylor series of order {integrator.order} in each mode, {system.n} states, {system.m} rows",
        "each switch is a root of its sign condition, found by Bernstein's test",
    ]
    if integrator.known_times:
        used.append(f"{len(integrator.known_times)} known times (switch_times): each ends a piece, the mode is chosen anew")
    if system.branches:
        used.append(f"{len(system.branches)} switches of operations that are not analytic (fabs, fmax, if_else, ...), watched")
    if options.certified:
        used.append("after the run each piece is proved by interval arithmetic: defect, rows, signs of conditions")
    elif options.method != METHOD:
        used.append(f"where no mode goes on: steps of backward Euler under error control, {BUDGET:,} at most, until one does")
    left = [f"time steps and their solvers (step, solver): {METHOD} pieces are as long as rtol lets them be"]
    if system.B is not None and system.D is not None and system.C is not None:
        left.append("linearisations: g_l, h_x and h_l are constant")
    return Plan("pieces", (), False, "never", True, math.inf, tuple(used), tuple(left))


def with_reason(plan: Plan, reason: str) -> Plan:
    """A plan of time stepping that says why event-driven integration was left out."""
    return replace(plan, left_out=(*plan.left_out, f"{METHOD} integration: {reason}"))
