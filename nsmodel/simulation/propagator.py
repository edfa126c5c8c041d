"""The contract between the loop of a run and what advances it; and what all of these share.

Where a step has led.

What a trajectory tells of its model and of its scheme, however it was made.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object, usable_memory
from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import versions
from nsmodel.modeling.outputs import Quantity
from nsmodel.modeling.parts import Part
from nsmodel.modeling.signals.pwm import HeldSignal
from nsmodel.modeling.signals.schedule import InputSchedule
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.simulation.options import Options
from nsmodel.solvers import impacts
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.plan import Plan
from nsmodel.solvers.step import RUNAWAY_LIMIT, RowLayout

PERCENT_PROGRESS = {"total": 100, "unit": "%", "bar_format": "{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"}  # Of the time.
# CHUNK_BYTES: a crash loses no more.
CHUNK_BYTES, CHUNK_SECONDS = 64 << 20, 10.0  # Rows go to the folder when they fill the one or have waited for the other.


ResumedBackend = Callable[[], str | None]  # Tells how the run that is resumed was stepped; None for a new one.


class Propagator(Protocol):
    """A run as it goes: the place where it stands, how it goes on from there, and what has been counted on the way.

    Attributes:
        model: bound; plan: what is used for a step, and left out.
        settings: all that the numbers depend on (see `identity`).
        N: steps in all, as far as that is known; k: steps taken; record: the rows not yet written.
        counts: steps by solver; totals: what is known of all steps; warnings: about the run as a whole.
        bar: options of a progress bar; progress: how far the run is, in its unit.
        finished: whether nothing is left to do; time, h: where the next step starts, and its length.
        runaway: name and value of the largest state, where that has left the range of numbers to compute with.
        rows_lost: whether it stands behind rows that it has not: no place to go on from.
        defers_reading: whether ``note`` and ``columns`` may wait until somebody looks at the run.
    """

    model: Any
    plan: Plan
    settings: dict[str, Any]
    N: int
    k: int
    rows_lost: bool
    defers_reading: bool
    record: Any  # Rows
    counts: Counter[str]
    totals: dict[str, Any]
    warnings: list[str]

    @property
    def bar(self) -> dict[str, Any]: ...  # noqa: D102
    @property
    def progress(self) -> float: ...  # noqa: D102
    @property
    def finished(self) -> bool: ...  # noqa: D102
    @property
    def time(self) -> float: ...  # noqa: D102
    @property
    def h(self) -> float: ...  # noqa: D102
    @property
    def runaway(self) -> tuple[str, float] | None: ...  # noqa: D102

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Take about so many steps, fewer where the rows are full, the run has ended or ``stop`` is no longer empty.

        Raises:
            StepError: a step could not be verified; the place is that before it.
        """
        ...

    def warm_up(self) -> None:
        """Take a step and forget it: what is built at its first use is built."""
        ...

    def note(self) -> None:
        """Keep of the rows in memory what the end will ask for."""
        ...

    def columns(self) -> dict[str, np.ndarray]:
        """The rows in memory as the arrays of a trajectory."""
        ...

    def checkpoint(self) -> dict[str, Any]:
        """What to continue from, for the checkpoint."""
        ...

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        ...

    def metadata(self) -> dict[str, Any]:
        """What a trajectory tells beside that of every run."""
        ...


GridPropagator: TypeAlias = Callable[[Any, Options, TimeGrid, Callable[[], str | None]], Propagator]
# Of a class whose steps are not those of a one-step problem.
GRID_PROPAGATOR = Part[GridPropagator]("propagator.GRID_PROPAGATOR")


class GridProgress:
    """Where a walk over a grid stands: at row k of N."""

    rows_lost: bool = False
    defers_reading: bool = False
    grid: TimeGrid
    N: int
    k: int

    @property
    def bar(self) -> dict[str, Any]:
        """Progress in steps."""
        return {"total": self.N, "initial": self.k, "unit": "step"}

    @property
    def progress(self) -> int:
        """The number of steps taken."""
        return self.k

    @property
    def finished(self) -> bool:
        """Whether the grid has."""
        return self.k >= self.N

    @property
    def time(self) -> float:
        """The time t_k reached."""
        return self.grid.time(self.k)

    @property
    def h(self) -> float:
        """The length h_k of the next step."""
        return self.grid.step(self.k)


def plan_with_known_times(plan: Plan, model: Model, *, ends: bool) -> Plan:
    """The plan with what steps do at ``switch_times``: whether one ends at each."""
    count = len(model.switch_times)
    if not count:
        return plan
    if ends:
        return replace(plan, used=(*plan.used, f"a step ends at each of {count} known times (switch_times)"))
    left = f"{count} known times (switch_times): the points of a grid are not moved to them; give rtol, or steps that end there"
    return replace(plan, left_out=(*plan.left_out, left))


def plan_with_inputs(plan: Plan, drive: InputSchedule | None) -> Plan:
    """The plan with what drives the steps, and where these end for it."""
    if drive is None:
        return plan
    given = {name: signal for name, signal in drive.signals.items() if not isinstance(signal, HeldSignal)}
    kinds = ", ".join(f"{name} ({type(signal).__name__.lower()})" for name, signal in given.items())
    ticking = ", ".join(dict.fromkeys(signal.by for signal in drive.signals.values() if isinstance(signal, HeldSignal)))
    ends = f": a step ends at each of {drive.points.size} times at which they jump, bend or tick" if drive.points.size else ""
    placed = f"; {drive.moving} edges between two of these lie where blocks place them" if drive.moving else ""
    what = " and ".join(text for text in (kinds and f"inputs {kinds}", ticking and f"blocks {ticking}") if text)
    return replace(plan, used=(*plan.used, what + ends + placed))


# -- failures ----------------------------------------------------------------------------------------------------------


def find_runaway_state(names: Sequence[str], x: np.ndarray) -> tuple[str, float] | None:
    """Name and value of the largest of x (n,), where it is beyond RUNAWAY_LIMIT or no number."""
    i = int(np.argmax(np.nan_to_num(np.abs(x), nan=np.inf)))
    return None if abs(x[i]) <= RUNAWAY_LIMIT else (names[i], float(x[i]))


def overrun_warnings(totals: dict[str, Any]) -> list[str]:
    """The warning about a constraint that was overrun."""
    if "overrun" not in totals:
        return []
    worst = totals["overrun"]
    return [
        f"constraint '{worst['constraint']}' was overrun, at worst by {-worst['gap']:.3g} at t = {worst['t']:.6g}: the "
        "scheme keeps a constraint >= 0 only where it is convex"
    ]


# -- memory ------------------------------------------------------------------------------------------------------------


def buffered_row_count(N: int, options: Options, row: int, known: int) -> int:
    """Rows of so many bytes kept in memory: all of them, or a chunk where they go to a folder."""
    total = N // options.save_every + 1 + known
    if options.folder is not None:
        return int(min(total, max(64, CHUNK_BYTES // row)))
    if total * row > 0.8 * (usable_memory() or 10 * 2**30):
        raise UsageError(
            f"{N} steps do not fit in memory ({total * row / 2**30:.3g} GiB); give out=DIR (--out DIR), "
            "and save_every=N (--save-every N) to keep fewer rows"
        )
    return int(total)


# -- the exact state ---------------------------------------------------------------------------------------------------


@cached_per_object
def check_exact_function(model: Model) -> None:
    """Refuse a function for the exact state that fails, or returns another shape."""
    if model.exact is not None:
        try:
            got, expected = np.shape(model.exact(np.zeros(2))), (2, len(model.names or ()))
        except Exception as error:
            raise UsageError(f"exact: it raised {type(error).__name__} at t = 0: {error}") from error
        if got != expected:
            raise UsageError(f"exact: it returned shape {got} for 2 times; expected {expected}")


def update_exact_error(model: Model, totals: dict[str, Any], t: np.ndarray, x: np.ndarray) -> None:
    """Keep max |x - exact(t)|; inf where the user's function fails or gives NaN: no reason to lose the run."""
    if model.exact is None:
        return
    try:
        distance = float(np.abs(x - np.asarray(model.exact(t), float)).max())
    except Exception:
        distance = np.inf
    totals["largest_error"] = max(totals.get("largest_error", 0.0), distance if np.isfinite(distance) else np.inf)


class Row:
    """Where a step has led: its time, and what is read off the row that it has made."""

    __slots__ = ("_layout", "_packed", "_states", "index_set", "t")

    def __init__(self, t: float, packed: np.ndarray, index_set: np.ndarray, layout: RowLayout, states: int) -> None:
        self.t, self.index_set = t, index_set
        self._packed, self._layout, self._states = packed, layout, states

    @property
    def x(self) -> np.ndarray:
        """The state (n,)."""
        return self._packed[: self._states]

    @property
    def multipliers(self) -> np.ndarray:
        """The multipliers (m,), as they are declared."""
        return self._quantity("multipliers", "l")

    @property
    def y(self) -> np.ndarray:
        """The outputs of the law (m,)."""
        return self._quantity("outputs", "y")

    @property
    def residual(self) -> float:
        """That of the step."""
        return float(self._packed[self._layout.residual])

    @property
    def inputs(self) -> np.ndarray:
        """The inputs (nu,) at the end of the step."""
        both = self._packed[self._layout.inputs]
        return both[both.size // 2 :]

    def _quantity(self, name: str, else_of: str) -> np.ndarray:
        slices = self._layout.slices
        return self._packed[slices.get(name, slices[else_of])]

    def __repr__(self) -> str:
        """The time, the state, the residual."""
        return f"Row(t={self.t:.10g}, x={self.x}, residual={self.residual:.2g})"


def model_metadata(model: Model) -> dict[str, Any]:
    """Names, units, numbers, and the versions of what they were made with."""
    data: dict[str, Any] = {
        "title": model.title,
        "model_class": type(model).__name__,
        "paper": model.paper,
        "state_names": list(model.names),
        "stems": {stem: list(at) for stem, at in model.stems.items()},
        "units": dict(model.units),
        "parameters": dict(model.bound_parameters),
        "versions": versions(),
    }
    if model.input_groups:
        data["input_names"] = list(model.input_names)  # In order: of a dictionary files keep none.
        data["input_groups"] = {name: list(names) for name, names in model.input_groups.items()}
    if model.outputs:
        data["outputs"] = {name: Quantity.made(expression).text for name, expression in model.outputs.items()}
    if against := impacts.anti_friction(model):
        data["anti_friction"] = against
    if model.weights is not None:
        data["weights"] = list(map(float, model.weights))
    scene: Any = getattr(model, "scene", None)
    return data | ({"scene": {key: value.tolist() for key, value in scene.items()}} if scene else {})


def scheme_metadata(problem: OneStepProblem, tolerance: float) -> dict[str, Any]:
    """Its name, the names of its rows, what was accepted."""
    return {
        "scheme": problem.scheme,
        "multiplier_names": list(problem.multiplier_names),
        "index_names": list(problem.rows),
        "law_kinds": problem.law.labels,
        "tolerance": tolerance,
        **({"axes": {name: list(names) for name, names in problem.axes.items()}} if problem.axes else {}),
    }


def scene_metadata(model: Any) -> dict[str, Any]:
    """Of a planar scene of discs: for each constraint those whose coordinates it contains; nothing of other models."""
    if not getattr(model, "scene", None):
        return {}
    bodies: list[set[int]] = [set() for _ in range(model.g.numel())]
    for row, column in zip(*ca.jacobian(model.g, model.q).sparsity().get_triplet(), strict=True):
        bodies[row].add(column // 2)
    return {"constraint_bodies": [sorted(found) for found in bodies]}
