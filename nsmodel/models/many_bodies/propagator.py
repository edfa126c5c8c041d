"""The walk of many bodies: the step of `solvers.contact_solver` over a grid, bodies that leave and enter, contacts that acted.

The rows of a run of many bodies that are in memory.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import StepError, UsageError
from nsmodel.modeling.fingerprint import run_settings
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.models.many_bodies.arching import (
    MOVEMENT_ROUNDING,
    STANDSTILL_STEPS,
    StandstillState,
    find_arches,
    is_autonomous,
    is_held_by_contacts,
    is_state_repeated,
)
from nsmodel.models.many_bodies.contact_search import least_gap, near_contact_rows
from nsmodel.models.many_bodies.contact_solver import (
    COLD_BODIES_START,
    BodiesStepper,
    BodiesStepResult,
    BodiesWarmStart,
    bodies_plan_lines,
)
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.schemes import BodiesProblem, ContactRows
from nsmodel.simulation.options import Options
from nsmodel.simulation.propagator import (
    GridProgress,
    GridPropagator,
    ResumedBackend,
    buffered_row_count,
    check_exact_function,
    find_runaway_state,
    overrun_warnings,
    update_exact_error,
)
from nsmodel.simulation.step_backend import choose_step_backend
from nsmodel.solvers.contacts import NO_CONTACTS, Contacts, sort_contacts
from nsmodel.solvers.initial_checks import start_warnings
from nsmodel.solvers.plan import CompilationCost, Plan, bodies_cost

if TYPE_CHECKING:
    from nsmodel.models.many_bodies.step_library import CompiledBodiesStep


class BodiesRecord:
    """Rows in memory: ``capacity`` of them, then it is ``full`` and must be cleared; contacts are lists beside them."""

    def __init__(self, bodies: int, d: int, capacity: int) -> None:
        self.t, self.h, self.begin, self.residual, self.gap_min = (np.empty(capacity) for _ in range(5))
        self.x, self.pressure = np.empty((capacity, bodies * d)), np.empty((capacity, bodies))
        self.contacts: list[Contacts] = []
        self.first = 0  # Number of the first row in memory.
        self.filled, self.full = 0, False

    def add(
        self, begin: float, t: float, h: float, q: np.ndarray, gap: float, residual: float, pressure: np.ndarray | float,
        contacts: Contacts,
    ) -> None:  # fmt: skip
        """Add a row, of the step of length h from ``begin`` to t."""
        r = self.filled
        self.begin[r], self.t[r], self.h[r], self.x[r], self.gap_min[r], self.residual[r] = begin, t, h, q.ravel(), gap, residual
        self.pressure[r] = pressure
        self.contacts.append(contacts)
        self.filled = r + 1
        self.full = self.filled == len(self.t)

    def clear(self) -> None:
        """Forget the rows."""
        self.first += self.filled
        self.filled, self.full, self.contacts = 0, False, []

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory."""
        rows = slice(0, self.filled)
        names = ("t", "x", "residual", "h", "gap_min", "pressure")
        arrays = {"step" if name == "h" else name: getattr(self, name)[rows].copy() for name in names}
        counts = [len(one.first) for one in self.contacts]
        row = np.repeat(np.arange(self.first, self.first + self.filled), counts)
        parts = [np.concatenate(part) for part in zip(*self.contacts, strict=True)]
        return arrays | {"contact_row": row} | {f"contact_{k}": v for k, v in zip(Contacts._fields, parts, strict=True)}


# Contacts of a body for which memory is planned: discs that are packed in the plane touch 6 others, and two share a contact.
PLANNED_CONTACTS_PER_BODY = 3
# A gap is reported that is below 0 by more than so many times its rounding, some 2e-10 of positions: less is the solver's error.
OVERRUN_FACTOR = 1e5


class ManyBodiesPropagator(GridProgress):
    """The walk of many bodies over a grid; see `simulation.propagator.Propagator`.

    It stands at (k, q, waiting, warm): ``q (N, d)`` is NaN where a body is not there, ``waiting (N,)`` who has not yet entered.
    It ends before the grid does where nobody is left, or where nothing will ever change again (see `standstill`).
    ``seconds``: run time of the interpreted steps by what they do.
    """

    def __init__(self, model: ManyBodies, options: Options, grid: TimeGrid, resumed_backend: ResumedBackend) -> None:
        self.model: Any = model
        self.grid, self.N, self.every, self.tolerance = grid, grid.N, options.save_every, options.tolerance
        check_exact_function(model)
        for name, signal in model.inputs.items():
            if signal is not None and signal.count is not None:
                raise UsageError(f"input '{name}': many bodies take no steps(...); give table(t, values)")
        self.problem = BodiesProblem(model)
        self.stepper = BodiesStepper(self.problem, options.solver, self.tolerance)
        used, left_out = map(tuple, bodies_plan_lines(self.problem, options.solver))
        plan = Plan("bodies", (), True, "never", True, 0.0, used, left_out)
        self.counts: Counter[str] = Counter()
        self.totals: dict[str, Any] = {
            "worst_residual": 0.0, "worst_residual_t": None, "index_set_changes": 0, "steps": 0, "left": 0, "entered": 0,
            "least_gap": np.inf, "least_gap_t": None, "largest_pressure": 0.0, "largest_pressure_t": None,
            "largest_pressure_body": None, "most_contacts": 0,
        }  # fmt: skip
        self._check_f()
        steps = choose_step_backend(options, plan, resumed_backend(), grid.N, self._estimate_cost, self._build_compiled_step)
        self.step: BodiesStepper | CompiledBodiesStep = self.stepper if steps.steps is None else steps.steps
        self.plan, self.warnings = steps.plan, [*start_warnings(model, plan), *steps.warnings]
        self.settings = run_settings(model, grid, options.solver, self.tolerance, self.every, steps.way)
        count, d = model.bodies.q0.shape
        row = 8 * (count * d + count + 4) + 25 * PLANNED_CONTACTS_PER_BODY * count
        self.record = BodiesRecord(count, d, buffered_row_count(grid.N, options, row, 1))
        self.k, self.warm, self.waiting = 0, COLD_BODIES_START, model.enter > 0
        self.q = np.where(self.waiting[:, None], np.nan, model.bodies.q0)
        self.still, self._steady = StandstillState(self.q, 0), is_autonomous(model)
        if not options.resume:
            gap = check_start_gap(self.problem, self.q)
            self._record_least_gap(gap, 0.0)
            self.record.add(0.0, 0.0, np.nan, self.q, gap, np.nan, np.nan, NO_CONTACTS)

    @property
    def finished(self) -> bool:
        """Whether the grid has, nobody is left, or nothing will ever change."""
        return super().finished or "ended" in self.totals

    @property
    def runaway(self) -> tuple[str, float] | None:
        """The body that is, or would be after this step without constraints, where numbers end."""
        after = self.q
        with contextlib.suppress(StepError):
            present = np.all(np.isfinite(self.q), axis=1)
            after = self.q + self.grid.step(self.k) * self.problem.f(self.grid.time(self.k), self.q, present)
        far = np.nan_to_num([self.q, after], nan=0.0).reshape(2, len(self.q), -1)
        return find_runaway_state([f"q of body {i}" for i in range(len(self.q))], np.abs(far).max(axis=(0, 2)))

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds that the steps have taken: {"search", "assembly", "solve"}."""
        return self.step.seconds

    def warm_up(self) -> None:
        """Take a step and forget it, and its run time."""
        with contextlib.suppress(StepError):
            self.step(0.0, self.grid.step(0), np.where(self._present_bodies()[:, None], self.q, np.nan), self.warm, 0)
        self.seconds.update(dict.fromkeys(self.seconds, 0.0))

    def _check_f(self) -> None:
        """Refuse a function f that fails at the start."""
        try:
            self.problem.f(0.0, self.model.bodies.q0, np.ones(self.problem.count, bool))
        except StepError as error:
            raise UsageError(str(error)) from error

    def _build_compiled_step(self) -> Any:
        from nsmodel.models.many_bodies.step_library import CompiledBodiesStep

        return CompiledBodiesStep(self.model, self.tolerance)

    def _estimate_cost(self) -> CompilationCost:
        from nsmodel.models.many_bodies import step_library

        model = self.model
        return bodies_cost(
            self.problem.count, lambda: step_library.is_solver_cached(model), lambda: step_library.is_model_code_cached(model)
        )

    def _present_bodies(self) -> np.ndarray:
        """Who takes part in the next step (N,): those that are there and do not leave."""
        present = np.all(np.isfinite(self.q), axis=1)
        return present & ~self.problem.leaves(self.grid.time(self.k), self.q, present)

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Go on step by step."""
        for _ in range(steps):
            if self.finished or stop or self.record.full:
                return
            self._advance_one_step()

    def _advance_one_step(self) -> None:
        grid = self.grid
        t, h = grid.time(self.k), grid.step(self.k)
        present = self._present_bodies()
        result = self._compute_step(t, h, np.where(present[:, None], self.q, np.nan))
        left = int(np.all(np.isfinite(self.q), axis=1).sum() - present.sum())
        # From here on nothing fails: the step has happened, or it has not.
        pressure = self._body_pressures(result.contacts, present)
        q = result.q
        entering = self._entering_bodies(t + h, q) if self.waiting.any() else np.zeros(0, int)
        q[entering] = self.model.bodies.q0[entering]
        self._update_totals(t + h, result, pressure, left, entering)
        before, self.k, self.q, self.warm = (self.q, self.warm), self.k + 1, q, result.warm
        self._detect_end(before)
        if self.k % self.every == 0 or self.finished:
            contacts = sort_contacts(result.contacts)
            self.record.add(t, grid.time(self.k), h, q, result.gap_min, result.residual, pressure, contacts)

    def _detect_end(self, before: tuple[np.ndarray, BodiesWarmStart]) -> None:
        """Note that nobody is left, or that nothing will ever change again."""
        self.still = self.still.after(self.k, self.q, self.warm)
        if self.waiting.any():
            return
        if np.isnan(self.q).all():
            self.totals["ended"] = "empty"
        elif self._steady and (stood := self.k - self.still.since) >= STANDSTILL_STEPS:
            if self.grid.steps is None and is_state_repeated(before, (self.q, self.warm)):
                self.totals["ended"] = "given back"
            elif stood % STANDSTILL_STEPS == 0 and is_held_by_contacts(
                self.problem, self.grid.time(self.k), before[0], self.q, self.warm.contacts
            ):
                self.totals["ended"] = "held"

    def _standstill_summary(self) -> dict[str, Any] | None:
        """Since when nobody has moved, and who holds whom; None where somebody moves, or nobody is there."""
        present = np.all(np.isfinite(self.q), axis=1)
        if self.k - self.still.since < STANDSTILL_STEPS or not present.any():
            return None
        return {
            "since": self.grid.time(self.still.since), "bodies": int(present.sum()), "for_good": self.totals.get("ended"),
            "arches": find_arches(self.problem, self.q, self.warm.contacts),
        }  # fmt: skip

    def _compute_step(self, t: float, h: float, q: np.ndarray) -> BodiesStepResult:
        """The step; a compiled one that fails is taken once more interpreted."""
        try:
            return self.step(t, h, q, self.warm, self.k)
        except StepError:
            if self.step is self.stepper:
                raise
        return self.stepper(t, h, q, self.warm, self.k)

    def _body_pressures(self, contacts: Contacts, present: np.ndarray) -> np.ndarray:
        """The sum of the reactions on each body (N,), NaN where none is there."""
        count = self.problem.count
        pairs = np.array([family.of_pairs for family in self.problem.families], bool)[contacts.family]
        total = np.bincount(contacts.first, contacts.reaction, count)
        total += np.bincount(contacts.second[pairs], contacts.reaction[pairs], count)
        return np.where(present, total, np.nan)

    def _entering_bodies(self, t: float, q: np.ndarray) -> np.ndarray:
        """Who enters at t: those whose time has come and whose start is free, in the order of their numbers."""
        due = self.waiting & (self.model.enter <= t + 1e-9 * self.grid.h)
        if not due.any():
            return np.zeros(0, int)
        placed = np.where(due[:, None], self.model.bodies.q0, q)
        rows = near_contact_rows(self.problem, t, placed, np.all(np.isfinite(placed), axis=1), 0.0)
        rows = rows.at(rows.g < -_gap_rounding(rows, placed))
        both = rows.pair & due[rows.first] & due[rows.other]
        refused = np.zeros(len(due), bool)
        for member in (rows.first[~both], rows.second[~both & rows.pair]):  # by bodies that are there, and by items
            refused[member] |= due[member]
        for first, second in sorted(zip(rows.first[both].tolist(), rows.second[both].tolist(), strict=True)):
            if not (refused[first] or refused[second]):
                refused[max(first, second)] = True
        return np.flatnonzero(due & ~refused)

    def _update_totals(self, t: float, result: BodiesStepResult, pressure: np.ndarray, left: int, entering: np.ndarray) -> None:
        """What is known of all steps, whichever rows are kept."""
        totals, contacts, last = self.totals, sort_contacts(result.contacts), sort_contacts(self.warm.contacts)
        self.counts[result.solver] += 1
        if result.residual > totals["worst_residual"]:
            totals["worst_residual"], totals["worst_residual_t"] = float(result.residual), t
        totals["index_set_changes"] += int(
            totals["steps"] > 0 and not all(np.array_equal(a, b) for a, b in zip(contacts[:3], last[:3], strict=True))
        )
        totals["steps"] += 1
        totals["left"] += left
        totals["entered"] += len(entering)
        totals["most_contacts"] = max(totals["most_contacts"], len(contacts.first))
        if len(contacts.first) and (most := np.nanmax(pressure)) > totals["largest_pressure"]:
            body = int(np.nanargmax(pressure))
            totals |= {"largest_pressure": float(most), "largest_pressure_t": t, "largest_pressure_body": body}
        self._record_least_gap(result.gap_min, t, result.q)
        self.waiting[entering] = False

    def _record_least_gap(self, gap: float, t: float, q: np.ndarray | None = None) -> None:
        """Keep the least gap; one below 0 beyond rounding is named: a linearised constraint can be overrun where not convex."""
        totals = self.totals
        if gap < totals["least_gap"]:
            totals["least_gap"], totals["least_gap_t"] = float(gap), t
        if q is None or gap >= totals.get("overrun", {"gap": 0.0})["gap"] or gap >= -MOVEMENT_ROUNDING * np.nanmax(np.abs(q)):
            return
        rows = near_contact_rows(self.problem, t, q, np.all(np.isfinite(q), axis=1), 0.0)
        over = rows.g + OVERRUN_FACTOR * _gap_rounding(rows, q)
        if over.size and over.min() < 0:
            i = int(over.argmin())
            name = self.problem.name(int(rows.family[i]), int(rows.first[i]), int(rows.second[i]))
            totals["overrun"] = {"gap": float(rows.g[i]), "constraint": name, "t": t}

    def note(self) -> None:
        """Keep the distance to the exact state."""
        if self.record.filled:
            rows = slice(0, self.record.filled)
            update_exact_error(self.model, self.totals, self.record.t[rows], self.record.x[rows])

    def columns(self) -> dict[str, np.ndarray]:
        """The rows in memory as the arrays of a trajectory."""
        arrays, drive = self.record.columns(), self.grid.drive
        if drive is not None:
            arrays |= drive.rows(arrays["t"], self.record.begin[: self.record.filled])
        return arrays

    def checkpoint(self) -> dict[str, Any]:
        """What to continue from."""
        contacts = {name: value.tolist() for name, value in self.warm.contacts._asdict().items()}
        return {
            "q": self.q.ravel(), "waiting": np.flatnonzero(self.waiting), "moved": self.warm.moved, "contacts": contacts,
            "rows": self.record.first + self.record.filled, "still": {"q": self.still.q.ravel(), "since": self.still.since},
        }  # fmt: skip

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.q = np.array(saved["q"], float).reshape(self.q.shape)
        self.waiting = np.isin(np.arange(self.problem.count), saved["waiting"])
        contacts = (np.array(saved["contacts"][name], kind.dtype) for name, kind in NO_CONTACTS._asdict().items())
        self.warm = BodiesWarmStart(Contacts(*contacts), saved["moved"])
        self.still = StandstillState(np.array(saved["still"]["q"], float).reshape(self.q.shape), saved["still"]["since"])
        self.record.first = saved["rows"]

    def metadata(self) -> dict[str, Any]:
        """The families, who is there, who stands still, warnings."""
        present = np.all(np.isfinite(self.q), axis=1)
        return {
            "scheme": self.problem.scheme,
            "tolerance": self.tolerance,
            "families": list(self.problem.names),
            "of_pairs": [family.of_pairs for family in self.problem.families],
            "body_numbers": {name: value.tolist() for name, value in self.model.bodies.numbers.items() if name != "q"},
            "bodies": {"count": self.problem.count, "d": self.problem.d, "there": int(present.sum()),
                       "waiting": int(self.waiting.sum()), "left": int(self.problem.count - present.sum() - self.waiting.sum()),
                       "empty_at": self.grid.time(self.k) if self.totals.get("ended") == "empty" else None,
                       "standstill": self._standstill_summary()},
            "warnings": [*self.warnings, *overrun_warnings(self.totals)],
        }  # fmt: skip


def check_start_gap(problem: BodiesProblem, q: np.ndarray) -> float:
    """Refuse a start outside the set; return its least gap. Bodies that enter later have q = NaN.

    Raises:
        UsageError: names the constraint, its value, the bodies and where they are.
    """
    present = np.all(np.isfinite(q), axis=1)
    rows = near_contact_rows(problem, 0.0, q, present, 0.0)
    bad = np.flatnonzero(~(rows.g >= -_gap_rounding(rows, q)))
    if bad.size:
        i = int(bad[np.argmin(np.nan_to_num(rows.g[bad], nan=-np.inf))])
        first, second, pair = int(rows.first[i]), int(rows.second[i]), bool(rows.pair[i])
        name = problem.name(int(rows.family[i]), first, second)
        where = f"body {first} at {_format_position(q[first])}" + (
            f" and body {second} at {_format_position(q[second])}" if pair else ""
        )
        if not np.isfinite(rows.g[i]):
            raise UsageError(f"constraint '{name}' is not a finite number at the start, {where}: a root or division by 0?")
        raise UsageError(
            f"constraint '{name}' = {rows.g[i]:.6g} < 0 at the start, {where}: the start is outside the set; move it to where "
            f"every constraint is >= 0{f' ({bad.size} constraints are < 0)' if bad.size > 1 else ''}"
        )
    return least_gap(problem, 0.0, q, present)


def _gap_rounding(rows: ContactRows, q: np.ndarray) -> np.ndarray:
    """How far g may be below 0 by the rounding of positions (R,)."""
    return 8 * EPS * rows.size * (np.abs(q[np.isfinite(q)]).max(initial=0.0) + np.abs(rows.g))


def _format_position(values: np.ndarray) -> str:
    return f"({', '.join(f'{v:.6g}' for v in values)})"


GRID_PROPAGATOR: GridPropagator = ManyBodiesPropagator
