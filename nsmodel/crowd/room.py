"""A room: walls, obstacles and exits as line segments, and a grid that knows what is inside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import former_names, short_repr
from nsmodel.crowd import picture
from nsmodel.crowd.geometry import contains, distances, nearest_points, polygon_sides
from nsmodel.crowd.given import checked_array, checked_number
from nsmodel.errors import ModelError
from nsmodel.modeling.parameters import describe_argument

GRID_MARGIN = 1.0  # What a grid shows of the outside, m.
TOUCH_DISTANCE = 1e-3  # An exit ends at a wall that is as near as this, m.
PROBE_FRACTIONS = np.arange(1, 8) / 8  # Where along an exit both of its sides are looked at.


@dataclass(frozen=True, eq=False)
class Room:
    """A room in metres, y upwards: ``Room(walls=[[(0, 0), (4, 0)], ...], exits={"door": [(4, 1), (4, 2.2)]})``.

    Walls and exits together must enclose it: an exit fills the gap that its door leaves in the walls.

    Attributes:
        walls: (W, 2, 2) line segments.
        exits: {name: (E, 2, 2)}; a single segment (2, 2) will do.
        obstacles: polygons, each (P, 2) corners; `disc` makes one of a pillar.

    Raises:
        ModelError: a wrong shape, a number that is not finite, a segment without length, no exit; when it is used, an exit
            that leaves a gap to the walls, lies on one, or has the same room on both of its sides.
    """

    walls: Any = ()
    exits: Any = ()
    obstacles: Any = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if not isinstance(self.exits, Mapping) or not self.exits:
            raise ModelError(
                f"exits: {describe_argument(self.exits)}; expected a dictionary of at least one, {{name: [(x, y), (x, y)]}}"
            )
        none = isinstance(self.walls, list | tuple | np.ndarray) and not len(self.walls)
        object.__setattr__(self, "walls", np.zeros((0, 2, 2)) if none else _checked_segments(self.walls, "walls"))
        for name in self.exits:
            if not isinstance(name, str):
                raise ModelError(f"exits: {describe_argument(name)} names one; expected a text")
        named = {name: _checked_segments(value, f"exit '{name}'") for name, value in self.exits.items()}
        object.__setattr__(self, "exits", MappingProxyType(named))
        if not isinstance(self.obstacles, list | tuple | np.ndarray):
            raise ModelError(f"obstacles: {describe_argument(self.obstacles)}; expected a list of polygons, each (P, 2)")
        polygons = tuple(checked_polygon(value, f"obstacles[{k}]") for k, value in enumerate(self.obstacles))
        object.__setattr__(self, "obstacles", polygons)

    @classmethod
    def from_picture(
        cls, image: str | Path | np.ndarray, pixel: float = 0.05, walls: Any = "black", exits: Mapping[str, Any] | None = None
    ) -> Room:
        """Read a floor plan: the outlines of wall pixels become line segments, each patch of a door's colour an exit.

        Args:
            image: a PNG file, or an array (H, W, 3 or 4) of numbers 0 to 255, or 0 to 1; row 0 is the top.
            pixel: the side of a pixel, m.
            walls: their colour: a name as in CSS and Matplotlib, "#rrggbb", or (red, green, blue) from 0 to 255.
            exits: {name: colour}; {"exit": "red"} if left out. An exit's segment runs along the middle of its patch.

        Outlines are drawn straight within 3/4 of a pixel, so that a slanting wall is no staircase.

        Raises:
            ModelError: a file that is no picture, a wrong shape, a colour that is unknown, not in the picture, or too
                like another one.
        """
        found, doors = picture.read_floor_plan(image, pixel, walls, {"exit": "red"} if exits is None else exits)
        return cls(walls=found, exits=doors)

    @cached_property
    def segments(self) -> np.ndarray:
        """Walls and the sides of obstacles (W', 2, 2)."""
        return np.concatenate([self.walls, *(polygon_sides(polygon) for polygon in self.obstacles)])

    @cached_property
    def doors(self) -> np.ndarray:
        """The segments of all exits (E, 2, 2)."""
        return np.concatenate(list(self.exits.values()))

    @cached_property
    def door_names(self) -> np.ndarray:
        """The exit (E,) that each of `doors` belongs to."""
        return np.array([name for name, value in self.exits.items() for _ in value])

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """The lower left and the upper right corner (2,) of all there is."""
        points = np.concatenate([self.segments, self.doors]).reshape(-1, 2)
        return points.min(axis=0), points.max(axis=0)

    @cached_property
    def outward(self) -> np.ndarray:
        """The unit normal (E, 2) that leads out through each of `doors`."""
        along = self.doors[:, 1] - self.doors[:, 0]
        normals = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
        for k in range(len(normals)):
            self._check_door(k)
        grid = self.grid(0.1)
        for k, (probes, normal) in enumerate(zip(self._exit_probes, normals, strict=True)):
            step = 2 * grid.spacing * normal
            sides = [grid.outside[grid.nearest(probes + sign * step)].mean() > 0.5 for sign in (1, -1)]
            if sides[0] == sides[1]:
                what, middle = "outside" if sides[0] else "inside", self.doors[k].mean(axis=0)
                raise ModelError(
                    f"exit '{self.door_names[k]}' at {_format_point(middle)} is {what} on both sides: walls and exits must "
                    "enclose the room"
                )
            normals[k] = normal if sides[0] else -normal
        return normals

    def _check_door(self, k: int) -> None:
        """Refuse an exit that lies on a wall, or ends beside one."""
        (a, b), others = self.doors[k], np.concatenate([self.segments, np.delete(self.doors, k, axis=0)])
        name, along = self.door_names[k], a + np.array([[0.25], [0.5], [0.75]]) * (b - a)
        wall_distances = np.linalg.norm(nearest_points(along, self.walls) - along[:, None], axis=2)
        on = np.flatnonzero((wall_distances < 1e-9 * np.abs(self.box).max()).all(axis=0))
        if on.size:
            wall = self.walls[on[0]]
            raise ModelError(
                f"exit '{name}' lies on the wall from {_format_point(wall[0])} to {_format_point(wall[1])}: leave a gap there"
            )
        away = distances(np.array([a, b]), others)
        if away.max() > TOUCH_DISTANCE:
            end = (a, b)[away.argmax()]
            raise ModelError(
                f"exit '{name}' ends at {_format_point(end)}, {away.max():.3g} m from the nearest wall: walls and exits must "
                "enclose the room"
            )

    @cached_property
    def _exit_probes(self) -> list[np.ndarray]:
        """Places along each of `doors`, but for those that obstacles cover."""
        found = []
        for a, b in self.doors:
            along = a + PROBE_FRACTIONS[:, None] * (b - a)
            free = ~self.in_obstacle(along)
            found.append(along[free] if free.any() else along)
        return found

    def way_out(self, name: str) -> np.ndarray:
        """The segments (E, 2, 2) of an exit, each with the inside on its left and the outside on its right."""
        if name not in self.exits:
            raise ModelError(f"the room has no exit '{name}'; it has {', '.join(self.exits)}")
        mine = self.door_names == name
        doors, outward = self.doors[mine], self.outward[mine]
        along = doors[:, 1] - doors[:, 0]
        right = along[:, 1] * outward[:, 0] - along[:, 0] * outward[:, 1] > 0
        return np.where(right[:, None, None], doors, doors[:, ::-1])

    def in_obstacle(self, q: np.ndarray) -> np.ndarray:
        """Whether each q (N, 2) is inside an obstacle."""
        return np.any([np.zeros(len(q), bool), *(contains(corners, q) for corners in self.obstacles)], axis=0)

    def grid(self, spacing: float) -> RoomGrid:
        """The nodes of a square grid over the room and a margin, cut by walls and exits."""
        return _build_grid(self, float(spacing))

    def inside(self, grid: RoomGrid) -> np.ndarray:
        """The nodes (ny, nx) of the parts that an exit leads out of.

        Raises:
            ModelError: walls and exits leave a gap that shows at this spacing.
        """
        step = 2 * grid.spacing * self.outward
        probes = np.concatenate([places - own for places, own in zip(self._exit_probes, step, strict=True)])
        free = ~self.in_obstacle(probes)
        labels = grid.label[grid.nearest(probes[free] if free.any() else probes)]
        if (labels == grid.label[0, 0]).all():
            raise ModelError(
                f"at a spacing of {grid.spacing:.3g} m the room is open: there is a gap as small in its walls; walls and exits "
                "must enclose it"
            )
        return np.isin(grid.label, labels) & ~grid.outside


class RoomGrid(NamedTuple):
    """Nodes (ny, nx) of a square grid, and where walls and exits part neighbours."""

    origin: np.ndarray
    spacing: float
    right: np.ndarray  # (ny, nx - 1) whether a node and the next one across are joined
    up: np.ndarray  # (ny - 1, nx) the same upwards
    label: np.ndarray  # (ny, nx) the number of the part of the plane that a node is in

    @property
    def outside(self) -> np.ndarray:
        """Whether each node (ny, nx) is in the part of the plane that has no end."""
        return self.label == self.label[0, 0]

    @property
    def nodes(self) -> np.ndarray:
        """Their places (ny, nx, 2)."""
        ny, nx = self.label.shape
        across, up = np.meshgrid(np.arange(nx), np.arange(ny))
        return self.origin + self.spacing * np.stack([across, up], axis=2)

    def nearest(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of the node nearest to each q (N, 2)."""
        ny, nx = self.label.shape
        column, row = np.rint((q - self.origin) / self.spacing).astype(int).T
        return np.clip(row, 0, ny - 1), np.clip(column, 0, nx - 1)


def disc(centre: Any, radius: float, corners: int = 24) -> np.ndarray:
    """A pillar as a polygon (corners, 2) around the disc, touching it."""
    radius, middle = checked_number(radius, "disc: radius"), checked_array(centre, "disc: centre", "two numbers (x, y)")
    if middle.shape != (2,) or not isinstance(corners, int) or corners < 3:
        raise ModelError(f"disc: centre {describe_argument(centre)}, {corners} corners; expected (x, y), and at least 3 corners")
    angle = 2 * np.pi * (np.arange(corners) + 0.5) / corners
    return middle + radius / np.cos(np.pi / corners) * np.column_stack([np.cos(angle), np.sin(angle)])


def box(low: Any, high: Any) -> np.ndarray:
    """A rectangle as a polygon (4, 2), from its lower left and its upper right corner."""
    corners = [checked_array(corner, "box", "two corners (x, y)") for corner in (low, high)]
    if corners[0].shape != (2,) or corners[1].shape != (2,):
        raise ModelError(f"box: {describe_argument(low)}, {describe_argument(high)}; expected two corners (x, y)")
    (x, y), (right, top) = corners
    return np.array([(x, y), (right, y), (right, top), (x, top)], float)


@lru_cache(maxsize=16)
def _build_grid(room: Room, spacing: float) -> RoomGrid:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    low, high = room.box
    origin = low - GRID_MARGIN - np.array([0.3719, 0.4357]) * spacing  # No wall at round numbers runs through nodes.
    nx, ny = (np.ceil((high + GRID_MARGIN - origin) / spacing).astype(int) + 1).tolist()
    right, up = np.ones((ny, nx - 1), bool), np.ones((ny - 1, nx), bool)
    for ends in (np.concatenate([room.segments, room.doors]) - origin) / spacing:
        _cut_grid_links(right, ends)
        _cut_grid_links(up.T, ends[:, ::-1])
    number = np.arange(ny * nx).reshape(ny, nx)
    first = np.concatenate([number[:, :-1][right], number[:-1][up]])
    second = np.concatenate([number[:, 1:][right], number[1:][up]])
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(ny * nx, ny * nx))
    return RoomGrid(origin, spacing, right, up, connected_components(graph, directed=False)[1].reshape(ny, nx))


def _cut_grid_links(joined: np.ndarray, ends: np.ndarray) -> None:
    """Part the neighbours in each row that a segment, in units of the grid, runs between.

    A point on a line of nodes counts as below it, on a node as before it: no two segments that meet leave a gap.
    """
    (x0, y0), (x1, y1) = ends[np.argsort(ends[:, 1], kind="stable")]
    rows = np.arange(max(int(np.ceil(y0)), 0), min(int(np.ceil(y1)), len(joined)))
    if rows.size:
        x = x0 + (rows - y0) / (y1 - y0) * (x1 - x0)
        joined[rows, np.clip(np.ceil(x).astype(int) - 1, 0, joined.shape[1] - 1)] = False


def _checked_segments(value: Any, label: str) -> np.ndarray:
    array = checked_array(value, label, "end points (x, y), (2, 2) or (W, 2, 2)")
    array = array[None] if array.shape == (2, 2) else array
    if array.ndim != 3 or array.shape[1:] != (2, 2) or not len(array):
        raise ModelError(f"{label}: shape {np.shape(value)}; expected (2, 2), two end points, or (W, 2, 2)")
    short = np.flatnonzero((array[:, 0] == array[:, 1]).all(axis=1))
    if short.size:
        raise ModelError(
            f"{label}[{short[0]}] begins and ends at {_format_point(array[short[0], 0])}; expected two different points"
        )
    return array


def checked_polygon(value: Any, label: str) -> np.ndarray:
    """The corners (P, 2) of a polygon, the first one not repeated."""
    array = checked_array(value, label, "corners (x, y), (P, 2)")
    if array.ndim != 2 or array.shape[1:] != (2,) or len(array) < 3:
        raise ModelError(f"{label}: shape {array.shape}; expected (P, 2), at least three corners")
    return array[:-1] if (array[0] == array[-1]).all() else array


def _format_point(point: np.ndarray) -> str:
    return "({:.4g}, {:.4g})".format(*point)


__getattr__ = former_names(__name__, Grid="RoomGrid")
