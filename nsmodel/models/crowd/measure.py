"""What is measured on a finished run of people in the plane: who left when, flow through a door, maps of density and pressure.

Each function takes a run with two states a body, x (N+1, 2n), NaN where a body is absent. Between two rows people are taken to
move straight on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import ModelError, UsageError
from nsmodel.models.crowd.geometry import LEAF_SIZE, checked_array, checked_number, cross, crossed_segments
from nsmodel.models.crowd.room import Room

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

CUT_OFF = 1.0  # Nobody takes up more room than a disc of this radius, m: at the edge of a crowd Voronoi cells have no end.


def positions(run: Trajectory) -> np.ndarray:
    """The places (N+1, n, 2); NaN where a body is absent."""
    if run.x.shape[1] % 2:
        raise UsageError(f"people have two states each; this run has {run.x.shape[1]}")
    return run.x.reshape(len(run.t), -1, 2)


def present(run: Trajectory) -> np.ndarray:
    """Whether each person (N+1, n) is there."""
    return np.isfinite(positions(run)[..., 0])


def evacuation_times(run: Trajectory) -> np.ndarray:
    """The time (n,) of the first row without a person who was there before; NaN for those who are still there, or never were."""
    here = present(run)
    last = len(here) - 1 - here[::-1].argmax(axis=0)
    left = here.any(axis=0) & (last < len(here) - 1)
    return np.where(left, run.t[np.minimum(last + 1, len(here) - 1)], np.nan)


@dataclass(frozen=True, eq=False)
class Flow:
    """Who crossed a segment from a to b, or one of several, and when.

    Attributes:
        segments: (E, 2, 2) the end points a, b of each part.
        time: (K,) when, in order.
        person: (K,) who.
        forward: (K,) whether from the left of the way from a to b to its right (seen from a, looking to b).
    """

    segments: np.ndarray
    time: np.ndarray
    person: np.ndarray
    forward: np.ndarray

    __repr__ = short_repr

    @property
    def width(self) -> float:
        """Length of the segment, of all its parts."""
        return float(np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=1).sum())

    def times(self, forward: bool = True) -> np.ndarray:
        """The times of the crossings in one direction."""
        return self.time[self.forward == forward]

    def count(self, t: Any, forward: bool = True) -> np.ndarray:
        """How many crossings in one direction there were until each time t: the cumulative curve."""
        return np.searchsorted(self.times(forward), t, side="right")

    def net(self, t: Any) -> np.ndarray:
        """How many more went forward than back until each time t."""
        return self.count(t) - self.count(t, forward=False)

    def specific(self, start: float | None = None, end: float | None = None) -> float:
        """The specific flow, people a unit of time and width: net crossings in start < t <= end over (end - start) width.

        Left out, start and end are the first and the last crossing forward, and the flow is that of the gaps between them,
        (K - 1)/((t_K - t_1) width); NaN without a gap.
        """
        if start is None and end is None:
            times = self.times()
            gaps = float(times[-1] - times[0]) if len(times) else 0.0
            return (len(times) - 1) / gaps / self.width if gaps > 0 else float("nan")
        if start is None or end is None or not start < end:
            raise UsageError(f"specific flow from {start} to {end}: expected two times, the first one smaller")
        return float(self.net(end) - self.net(start)) / (end - start) / self.width


def flow(run: Trajectory, segments: Any) -> Flow:
    """All crossings of a segment (2, 2), or of several (E, 2, 2), the times between rows interpolated.

    For an exit of a room give ``room.way_out(name)``: then forward is out. Who is on the line itself counts as on its right, so
    that a passage counts once, however rows fall. Who comes in by `arrivals` appears inside: that is no passage.

    Raises:
        UsageError: another shape, end points that are equal; people who were last seen in the room left between two rows.
    """
    expected = "(2, 2) or (E, 2, 2), two different end points each"
    parts = checked_array(segments, "segments", expected, UsageError)
    parts = parts[None] if parts.shape == (2, 2) else parts
    if parts.ndim != 3 or parts.shape[1:] != (2, 2) or (parts[:, 0] == parts[:, 1]).all(axis=1).any():
        raise UsageError(f"segments: shape {parts.shape}; expected {expected}")
    unseen = _count_unseen_departures(run)
    if unseen:
        raise UsageError(
            f"{unseen} people left between two rows, and no row shows by which exit: run again and keep more rows (save_every)"
        )
    found = [_crossings(run.t, positions(run), a, b) for a, b in parts]
    time, person, forward = (np.concatenate(values) for values in zip(*found, strict=True))
    order = np.argsort(time, kind="stable")
    return Flow(parts, time[order], person[order], forward[order])


def _count_unseen_departures(run: Trajectory) -> int:
    """How many people left whose last place is in the room: none where all steps are kept."""
    if run.metadata.get("save_every", 1) == 1:
        return 0
    try:
        room = room_of(run)
        grid = room.grid(0.1)
        inside = room.inside(grid)
    except (ModelError, UsageError):  # No room to be in.
        return 0
    q = positions(run)
    row, person = np.nonzero(np.isfinite(q[:-1, :, 0]) & np.isnan(q[1:, :, 0]))
    return int(inside[grid.nearest(q[row, person])].sum()) if len(row) else 0


def _crossings(t: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """When and who crossed the segment from a to b, and whether forward."""
    with np.errstate(invalid="ignore"):
        side = cross(b - a, q - a)
        step = (side[:-1] > 0) != (side[1:] > 0)
    row, person = np.nonzero(step & np.isfinite(side[:-1]) & np.isfinite(side[1:]))
    hit = crossed_segments(q[row, person], q[row + 1, person], np.stack([a, b])[None])[:, 0]
    row, person = row[hit], person[hit]
    before, after = side[row, person], side[row + 1, person]
    return t[row] + before / (before - after) * (t[row + 1] - t[row]), person, before > 0


@dataclass(frozen=True, eq=False)
class Maps:
    """Means over time on a grid of square cells; NaN outside the room.

    Attributes:
        x: (nx + 1,) edges of the cells, m.
        y: (ny + 1,) edges of the cells, m.
        density: (ny, nx) people a unit of area.
        velocity: (ny, nx, 2) while somebody is there; NaN where nobody ever is.
        pressure: (ny, nx) sum of reactions on a person, while somebody is there; None where the run has none.
        rows: rows of the run that went into the means.
    """

    x: np.ndarray
    y: np.ndarray
    density: np.ndarray
    velocity: np.ndarray
    pressure: np.ndarray | None
    rows: np.ndarray

    __repr__ = short_repr


def maps(
    run: Trajectory, room: Room | None = None, *, spacing: float = 0.1, start: float = -np.inf, end: float = np.inf,
    most_rows: int = 200, cut_off: float = CUT_OFF,
) -> Maps:  # fmt: skip
    """Maps of density, velocity and pressure by Voronoi cells, the mean over time.

    At each place they are those of the nearest person: density 1/A with A the area that is nearest to this person, the person's
    velocity, the person's pressure (Steffen and Seyfried, Methods for measuring pedestrian density, flow, speed and direction
    with minimal scatter, Physica A 389, 2010). Areas end at the walls and ``cut_off`` metres from the person; beyond, the
    density is 0. A thin wall in between is not seen.

    Args:
        run: the run.
        room: which cells there are; left out: the walls and exits that the run knows.
        spacing: of the cells, m.
        start: first time.
        end: last time.
        most_rows: of the run's rows in between, so many are looked at, evenly spread.
        cut_off: m.

    Raises:
        UsageError: no row in between; the run knows no exits and no room is given; a wrong spacing, cut-off or number of rows.
    """
    from scipy.spatial import KDTree

    spacing, cut_off = (
        checked_number(value, name, kind=UsageError) for name, value in (("spacing", spacing), ("cut_off", cut_off))
    )
    if not isinstance(most_rows, int) or most_rows < 1:
        raise UsageError(f"most_rows: {most_rows!r}; expected a whole number >= 1")
    room = room or room_of(run)
    rows = np.flatnonzero((run.t >= start) & (run.t <= end))
    if not rows.size:
        raise UsageError(f"no row is between {start:g} and {end:g}; the run goes from {run.t[0]:g} to {run.t[-1]:g}")
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), most_rows)).round().astype(int))]
    x, y, inside = cells(room, spacing)
    everywhere = np.stack(np.meshgrid((x[:-1] + x[1:]) / 2, (y[:-1] + y[1:]) / 2), axis=2)
    counted = inside | _behind_doors(room, everywhere, cut_off)  # Who stands in a door takes up room on both of its sides.
    centres = everywhere[counted]
    pressure = run.arrays.get("pressure")
    total, visits, pushed = np.zeros((len(centres), 4)), np.zeros(len(centres)), np.zeros(len(centres))
    for q, velocity, push in _row_snapshots(run, rows, pressure):
        if not len(q):
            continue
        away, owner = map(np.asarray, KDTree(q, LEAF_SIZE).query(centres, distance_upper_bound=cut_off))
        near = np.isfinite(away)
        owner = owner[near]
        area = np.bincount(owner, minlength=len(q)) * spacing**2
        total[near] += np.column_stack([1 / area[owner], velocity[owner], np.nan_to_num(push[owner])])
        visits[near] += 1
        pushed[near] += np.isfinite(push[owner])  # Who has just come in, and all at the start, have no step behind.
    count = np.column_stack([visits, visits, pushed])
    mean = total[:, 1:] / np.where(count > 0, count, np.nan)
    field = np.full((*inside.shape, 4), np.nan)
    field[counted] = np.column_stack([total[:, 0] / len(rows), mean])
    field[~inside] = np.nan
    return Maps(x, y, field[..., 0], field[..., 1:3], None if pressure is None else field[..., 3], rows)


def _row_snapshots(
    run: Trajectory, rows: np.ndarray, pressure: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Places, velocities (of the step to the row; of the next one at the start) and pressures of who is there, at each row."""
    q = positions(run)
    for row in rows:
        here = np.isfinite(q[row, :, 0])
        velocity = _step_velocities(run.t, q, max(row, 1))
        if row + 1 < len(q):  # Who just came in has no step behind.
            velocity = np.where(np.isfinite(velocity), velocity, _step_velocities(run.t, q, row + 1))
        push = np.zeros(q.shape[1]) if pressure is None else pressure[row]
        yield q[row, here], np.nan_to_num(velocity[here]), push[here]


def _step_velocities(t: np.ndarray, q: np.ndarray, row: int) -> np.ndarray:
    """The velocities (n, 2) of the step that ended at a row."""
    return (q[row] - q[row - 1]) / (t[row] - t[row - 1]) if 0 < row < len(q) else np.zeros_like(q[0])


def cells(room: Room, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges x (nx + 1,), y (ny + 1,) of square cells over a room, and which (ny, nx) have their centre inside."""
    grid = room.grid(spacing)
    ny, nx = grid.label.shape
    x, y = (grid.origin[k] + spacing * (np.arange(n + 1) - 0.5) for k, n in enumerate((nx, ny)))
    return x, y, room.inside(grid)


def _behind_doors(room: Room, places: np.ndarray, depth: float) -> np.ndarray:
    """Which places (ny, nx, 2) are behind a door, as wide as it and so deep."""
    found = np.zeros(places.shape[:2], bool)
    for (a, b), normal in zip(room.doors, room.outward, strict=True):
        out, part = (places - a) @ normal, (places - a) @ (b - a) / ((b - a) ** 2).sum()
        found |= (out >= 0) & (out <= depth) & (part >= 0) & (part <= 1)
    return found


def room_of(run: Trajectory) -> Room:
    """The room that a run knows from its model's scene, obstacles as walls; UsageError where it knows no exits."""
    scene = run.metadata.get("scene") or {}
    if not len(scene.get("exits", ())):
        raise UsageError("the run has no exits: give the room")
    names = scene.get("exit_names", [f"exit {k}" for k in range(len(scene["exits"]))])
    exits = {name: [door for door, its in zip(scene["exits"], names, strict=True) if its == name] for name in names}
    return Room(walls=scene.get("walls", ()), exits=exits)
