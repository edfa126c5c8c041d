"""Shortest ways out of a room, as a velocity that everybody wants.

A body's centre keeps its clearance from all walls, so the way bends round a corner on an arc of that radius. The arc is replaced
by tangents (one each 30 degrees, so that it is at most 3 % longer), and the shortest way is one through their corners: Dijkstra's
algorithm on the graph of free sight, then for each node of a grid the best first corner in sight. Corners are up to 3.5 % farther
from the wall than the clearance; nodes nearer than that could not see the next one, so they take over what their neighbours do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import ModelError, UsageError
from nsmodel.modeling.parameters import describe_argument
from nsmodel.models.crowd.geometry import (
    MAX_CHUNK_NUMBERS,
    checked_array,
    checked_number,
    distances,
    has_free_path,
    nearest_points,
    per_person_values,
)
from nsmodel.models.crowd.room import Room, RoomGrid

MAX_ARC_PIECE = np.pi / 6  # The arc round a corner that one tangent stands for, at most: the way keeps 1 to 1.035 clearances.
CORNER_DISTANCE = 1 / np.cos(MAX_ARC_PIECE / 2)  # Distance of the corners of the tangents, in clearances.


@dataclass(frozen=True, eq=False)
class DesiredVelocity:
    """The velocity v_i e(q_i): speed v_i of each person, direction e of the shortest way to the exits of the person's group.

    Called as ``(t, q (N, 2)) -> (N, 2)``. Directions are tabulated and interpolated (bilinear, then made a unit vector again);
    past a door they lead on outwards; beyond the table its rim goes on. They are finite everywhere.

    Attributes:
        origin: (2,) place of the first node, m.
        spacing: of the nodes, m.
        values: (G, ny, nx, 2) unit vectors at the nodes, one table for each group; y goes with the second axis.
        distances: (G, ny, nx) length of the way, m; nan outside and where no exit can be reached.
        group: (N,) the table of each person.
        speed: (N,) m/s.
        exits: for each group the names of the exits it may take.
        clearance: m.
    """

    origin: np.ndarray
    spacing: float
    values: np.ndarray
    distances: np.ndarray
    group: np.ndarray
    speed: np.ndarray
    exits: tuple[tuple[str, ...], ...]
    clearance: float

    autonomous: ClassVar[bool] = True  # It does not depend on t.

    __repr__ = short_repr

    def __call__(self, t: float, q: np.ndarray) -> np.ndarray:
        """The velocities (N, 2) of people at q (N, 2); rows of absent people are any finite numbers."""
        return self.speed[:, None] * self.directions(q, self.group)

    def directions(self, q: np.ndarray, group: Any = 0) -> np.ndarray:
        """The unit vectors (N, 2) at places q (N, 2), for one group or one a place."""
        _, ny, nx, _ = self.values.shape
        column, row, x, y = self._locate_cell(q)
        start = (group * ny + row) * nx + column
        table = self.values.reshape(-1, 2)
        x, y = x[:, None], y[:, None]
        low = table[start] * (1 - x) + table[start + 1] * x
        high = table[start + nx] * (1 - x) + table[start + nx + 1] * x
        found = low * (1 - y) + high * y
        length = np.sqrt(found[:, 0] * found[:, 0] + found[:, 1] * found[:, 1])
        undefined = np.flatnonzero(length < 1e-3)  # Halfway between two ways: take one of them.
        if undefined.size:
            found[undefined], length[undefined] = table[start[undefined]], 1.0
        return found / length[:, None]

    def distance(self, q: Any, group: Any = 0) -> np.ndarray:
        """The length of the way (N,) from places q (N, 2) in metres; nan where a corner of the table's cell has none.

        Raises:
            UsageError: another shape, a group that there is not.
        """
        groups, ny, nx, _ = self.values.shape
        places = np.atleast_2d(checked_array(q, "q", "(N, 2), in metres", UsageError))
        if places.ndim != 2 or places.shape[1] != 2:
            raise UsageError(f"q: shape {places.shape}; expected (N, 2)")
        if np.shape(group) not in ((), (len(places),)) or not np.isin(group, np.arange(groups)).all():
            raise UsageError(f"group: {describe_argument(group)}; expected a number from 0 to {groups - 1}, or ({len(places)},)")
        column, row, x, y = self._locate_cell(places)
        start = (group * ny + row) * nx + column
        table = self.distances.ravel()
        low = table[start] * (1 - x) + table[start + 1] * x
        return low * (1 - y) + (table[start + nx] * (1 - x) + table[start + nx + 1] * x) * y

    def outside(self, q: np.ndarray) -> np.ndarray:
        """Whether no corner of the table's cell has a way to an exit (N,), for each person at q (N, 2): past a door."""
        _, ny, nx, _ = self.values.shape
        column, row, _, _ = self._locate_cell(q)
        start = (self.group * ny + row) * nx + column
        return np.all(np.isnan(self.distances.ravel()[start[:, None] + [0, 1, nx, nx + 1]]), axis=1)

    def _locate_cell(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Column and row of the cell of each place, and where in the cell it is (0 to 1); nan is anywhere."""
        _, ny, nx, _ = self.values.shape
        place = np.nan_to_num((q - self.origin) / self.spacing)
        x, y = np.clip(place[:, 0], 0, nx - 1), np.clip(place[:, 1], 0, ny - 1)
        column, row = np.minimum(x.astype(np.intp), nx - 2), np.minimum(y.astype(np.intp), ny - 2)
        return column, row, x - column, y - row


def desired_velocity(
    room: Room, count: int, *, to: Any = None, speed: Any = 1.0, clearance: float = 0.25, spacing: float = 0.1
) -> DesiredVelocity:
    """The velocity along the shortest way to an exit, for ``count`` people.

    Args:
        room: the room.
        count: how many people.
        to: the exit to take: None, the nearest one; a name; several names, the nearest of these; or a list of ``count`` of those.
            An exit that is not taken is a wall.
        speed: m/s, one number or (count,).
        clearance: how far the way keeps from walls, m: the largest radius, or more.
        spacing: of the table, m; at most two thirds of the least radius.

    Raises:
        ModelError: an exit that the room does not have, or too narrow for the clearance; a wrong wish, speed, clearance or
            spacing.
    """
    clearance, spacing = checked_number(clearance, "clearance"), checked_number(spacing, "spacing")
    speeds = per_person_values(speed, "speed", count, "m/s", zero=True)
    wishes = list(to) if isinstance(to, list | np.ndarray) else [to] * count
    if len(wishes) != count:
        raise ModelError(f"to: {len(wishes)} exits; expected one for each of {count} people")
    wanted = [_exit_names(room, wish) for wish in wishes]
    exits = tuple(dict.fromkeys(wanted)) or (tuple(room.exits),)
    table = {names: k for k, names in enumerate(exits)}
    grid = room.grid(spacing)
    tables = [_direction_table(room, grid, names, clearance) for names in exits]
    return DesiredVelocity(
        origin=grid.origin,
        spacing=grid.spacing,
        values=np.stack([directions for directions, _ in tables]),
        distances=np.stack([lengths for _, lengths in tables]),
        group=np.array([table[names] for names in wanted], np.intp),
        speed=speeds,
        exits=exits,
        clearance=float(clearance),
    )


def _exit_names(room: Room, to: Any) -> tuple[str, ...]:
    if not (to is None or isinstance(to, str) or (isinstance(to, tuple) and to)):
        raise ModelError(
            f"to: {describe_argument(to)}; expected the name of an exit, a tuple of names, or None for the nearest exit"
        )
    names = tuple(room.exits) if to is None else (to,) if isinstance(to, str) else to
    for name in names:
        if name not in room.exits:
            raise ModelError(f"to: the room has no exit '{name}'; it has {', '.join(room.exits)}")
    return tuple(name for name in room.exits if name in names)


def _direction_table(room: Room, grid: RoomGrid, names: Sequence[str], clearance: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions (ny, nx, 2) and lengths (ny, nx) of the shortest ways to these exits."""
    taken = np.isin(room.door_names, names)
    doors, outward = room.doors[taken], room.outward[taken]
    walls = np.concatenate([room.segments, room.doors[~taken]])
    width = np.linalg.norm(doors[:, 1] - doors[:, 0], axis=1)
    keep = CORNER_DISTANCE * clearance
    narrow = np.flatnonzero(width < 2 * keep)
    if narrow.size:
        name = room.door_names[taken][narrow[0]]
        raise ModelError(
            f"exit '{name}' is {width[narrow[0]]:.3g} m wide; a clearance of {clearance:.3g} m on both sides needs "
            f"{2 * keep:.3g} m: take smaller people or a smaller clearance=, or name the other exits in to="
        )
    shrink = (keep / width)[:, None] * (doors[:, 1] - doors[:, 0])
    goals = np.stack([doors[:, 0] + shrink, doors[:, 1] - shrink], axis=1)
    nodes, outside = grid.nodes.reshape(-1, 2), grid.outside.ravel()
    via, length, onward = _shortest_path_graph(walls, goals, clearance)
    directions, lengths = np.full((len(nodes), 2), np.nan), np.full(len(nodes), np.nan)
    free = np.flatnonzero(room.inside(grid))
    free = free[distances(nodes[free], walls) >= keep]
    for rows in np.array_split(free, 1 + len(free) * (len(via) + len(goals)) // MAX_CHUNK_NUMBERS):
        directions[rows], lengths[rows] = _first_directions(nodes[rows], walls, goals, outward, clearance, via, length, onward)
    shape = grid.label.shape
    directions, lengths = directions.reshape(*shape, 2), lengths.reshape(shape)
    nearest = np.linalg.norm(nearest_points(nodes[outside], room.doors) - nodes[outside][:, None], axis=2).argmin(axis=1)
    directions[grid.outside] = room.outward[nearest]
    _extend_to_walls(directions, lengths, grid, reach=int(2 * keep / grid.spacing) + 2)
    return directions, lengths


def _shortest_path_graph(walls: np.ndarray, goals: np.ndarray, clearance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners of shortest ways (V, 2), the length from each to the nearest goal (V,) and its direction there (V, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    via = _corner_points(walls, clearance)
    via = via[distances(via, walls) >= clearance * (1 - 1e-9)]
    count = len(via)
    i, j = np.triu_indices(count, 1)
    seen = has_free_path(via[i], via[j], walls, clearance)
    i, j = i[seen], j[seen]
    ends = nearest_points(via, goals)
    straight = np.linalg.norm(ends - via[:, None], axis=2)
    k, _ = np.indices(straight.shape)
    straight[~has_free_path(via[k.ravel()], ends.reshape(-1, 2), walls, clearance).reshape(straight.shape)] = np.inf
    last, goal = np.flatnonzero(straight.min(axis=1) < np.inf), straight.argmin(axis=1)
    first, second = np.concatenate([i, last]), np.concatenate([j, np.full(len(last), count)])
    edges = np.concatenate([np.linalg.norm(via[j] - via[i], axis=1), straight[last, goal[last]]])
    graph = coo_array((edges, (first, second)), shape=(count + 1, count + 1)).tocsr()
    length, following = dijkstra(graph, directed=False, indices=count, return_predecessors=True)
    length, following = length[:count], following[:count]
    next_place = np.where((following == count)[:, None], ends[np.arange(count), goal], via[np.clip(following, 0, count - 1)])
    known = np.isfinite(length)
    way = next_place[known] - via[known]
    size = np.linalg.norm(way, axis=1)[:, None]
    return via[known], length[known], way / np.where(size > 0, size, 1)


def _corner_points(walls: np.ndarray, clearance: float) -> np.ndarray:
    """The places (V, 2) where a way that keeps its clearance can turn: around ends of walls and corners that stand out.

    Between the walls that meet in a point, seen from there, a gap of more than 180 degrees is a corner that stands out; the
    normals of the walls on both its sides bound the arc.
    """
    ends = np.unique(walls.reshape(-1, 2), axis=0)
    places = []
    near = 1e-9 * (1 + float(np.abs(walls).max(initial=0)))
    for point in ends:
        touching = np.linalg.norm(nearest_points(point[None], walls)[0] - point, axis=1) < near
        towards = (walls[touching] - point).reshape(-1, 2)
        towards = towards[np.linalg.norm(towards, axis=1) > near]
        angles = np.sort(np.arctan2(towards[:, 1], towards[:, 0]))
        gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
        widest = int(gaps.argmax())
        arc = gaps[widest] - np.pi
        if arc > 1e-6:
            pieces = int(np.ceil(arc / MAX_ARC_PIECE - 1e-9))
            middle = angles[widest] + np.pi / 2 + arc * (np.arange(pieces) + 0.5) / pieces
            places.append(point + clearance / np.cos(arc / pieces / 2) * np.column_stack([np.cos(middle), np.sin(middle)]))
    return np.concatenate(places) if places else np.zeros((0, 2))


def _first_directions(
    nodes: np.ndarray, walls: np.ndarray, goals: np.ndarray, outward: np.ndarray, clearance: float,
    via: np.ndarray, length: np.ndarray, onward: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Direction (M, 2) and length (M,) of the shortest way from each node; nan where there is none.

    A way begins straight to a corner or to the nearest point of a goal; these are tried from the shortest way on.
    """
    doors = nearest_points(nodes, goals)
    cost = np.hypot(nodes[:, :1] - via[:, 0], nodes[:, 1:] - via[:, 1]) + length
    cost = np.column_stack([cost, np.linalg.norm(doors - nodes[:, None], axis=2)])
    direction, total = np.full(nodes.shape, np.nan), np.full(len(nodes), np.nan)
    left = np.arange(len(nodes))
    for _ in range(cost.shape[1]):
        best = cost[left].argmin(axis=1)
        door = best >= len(via)
        end = np.where(door[:, None], doors[left, np.maximum(best - len(via), 0)], 0.0)
        end[~door] = via[best[~door]]
        seen = has_free_path(nodes[left], end, walls, clearance)
        reached, choice, end = left[seen], best[seen], end[seen]
        way = end - nodes[reached]
        size = np.linalg.norm(way, axis=1)
        arrived = np.concatenate([onward, outward])[choice]
        direction[reached] = np.where(size[:, None] > 1e-9, way / np.maximum(size, 1e-300)[:, None], arrived)
        total[reached] = cost[reached, choice]
        cost[left, best] = np.inf
        left = left[~seen]
        if not left.size:
            break
    return direction, total


def _extend_to_walls(directions: np.ndarray, lengths: np.ndarray, grid: RoomGrid, reach: int) -> None:
    """Hand values on to nodes nearer to a wall than the clearance, in ``reach`` rounds and never through a wall; then directions
    to all that is left, which nobody sees who can reach an exit.
    """
    from scipy.ndimage import distance_transform_edt

    values = np.concatenate([directions, lengths[..., None]], axis=2)
    inside = ~grid.outside
    for _ in range(reach):
        known = np.isfinite(values[..., 2]) & inside
        total, count, one = np.zeros_like(values), np.zeros(known.shape), np.zeros_like(values)
        for axis, joined, low, high in (
            (0, grid.right, np.s_[:, :-1], np.s_[:, 1:]),
            (1, grid.up, np.s_[:-1], np.s_[1:]),
        ):
            for source, target, sign in ((low, high, -1), (high, low, 1)):
                use = joined & known[source]
                given = values[source].copy()
                given[..., 2] += sign * grid.spacing * given[..., axis]  # The length falls along the direction, by 1 a metre.
                total[target] += np.where(use[..., None], given, 0)
                count[target] += use
                one[target][use] = given[use]
        new = inside & ~known & (count > 0)
        if not new.any():
            break
        mean = total[new] / count[new][:, None]
        size = np.linalg.norm(mean[:, :2], axis=1)
        mean[:, :2] /= np.maximum(size, 1e-300)[:, None]
        values[new] = np.where((size > 1e-3)[:, None], mean, one[new])
    lengths[...] = values[..., 2]
    directions[...] = np.where(inside[..., None], values[..., :2], directions)
    unknown = ~np.isfinite(directions[..., 0])
    nearest: Any = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    directions[...] = directions[tuple(nearest)]
