"""A room: walls, obstacles and exits as line segments, and a grid that knows what is inside.

A floor plan read from a picture: outlines of wall pixels, and a segment for each patch of a door's colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.parameters import describe_argument
from nsmodel.modeling.time_grid import is_number
from nsmodel.models.crowd.geometry import checked_array, checked_number, contains, distances, nearest_points, polygon_sides

# Colours are the same where no channel differs by more, of 255: half of the least difference that two colours may have.
COLOUR_TOLERANCE = 60
MAX_BLUR_PIXELS = 2  # So many pixels between a wall and a door may have a colour in between, as smoothed edges of a drawing have.
# An outline is a straight line where it is this near to one, in pixels: the steps of a slanting line are within 1/2 of it.
STRAIGHT_TOLERANCE = 0.75


def read_floor_plan(image: Any, pixel: float, walls: Any, exits: Mapping[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Wall segments (W, 2, 2) and exits {name: (E, 2, 2)} of a picture, in metres; see `Room.from_picture`."""
    if not (is_number(pixel) and np.isfinite(pixel) and pixel > 0):
        raise ModelError(f"pixel: {describe_argument(pixel)}; expected the side of a pixel in metres, a number > 0")
    if not isinstance(exits, Mapping) or not exits:
        raise ModelError(f"exits: {describe_argument(exits)}; expected a dictionary {{name: colour}}")
    colours = {"walls": _parse_colour(walls, "walls")} | {
        name: _parse_colour(value, f"exit '{name}'") for name, value in exits.items()
    }
    names, table = list(colours), np.array(list(colours.values()))
    for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
        if np.abs(table[i] - table[j]).max() <= 2 * COLOUR_TOLERANCE:
            raise ModelError(
                f"the colours of {names[i]} and {names[j]}, {_format_rgb(table[i])} and {_format_rgb(table[j])}, are too alike"
            )
    array = _rgb_pixels(image)
    masks = {name: np.all(np.abs(array - colour) <= COLOUR_TOLERANCE, axis=2)[::-1] for name, colour in colours.items()}
    for name, mask in masks.items():
        if not mask.any():
            size, colour = "{1} x {0}".format(*array.shape), _format_rgb(colours[name])
            raise ModelError(f"no pixel of the picture ({size}) has the colour {colour} of {name}")
    loops = [simplify_outline(loop) for loop in outlines(masks["walls"])]
    found = [polygon_sides(loop)[: 1 if len(loop) == 2 else None] for loop in loops]  # A line one pixel thick is one wall.
    walls_found = np.concatenate(found)
    return pixel * walls_found, {name: pixel * _door_segments(masks[name], masks["walls"], walls_found) for name in exits}


def outlines(mask: np.ndarray) -> list[np.ndarray]:
    """The closed outlines (P, 2) of the true pixels of (ny, nx), row 0 lowest, through their corners where they turn."""
    inside = np.pad(mask, 1)
    following: dict[tuple[int, int], list[tuple[int, int]]] = {}
    # Sides of pixels with the wall on the left: below, right of, above and left of a wall pixel.
    for rows, columns, start, end in (
        (*np.nonzero(mask & ~inside[:-2, 1:-1]), (0, 0), (1, 0)),
        (*np.nonzero(mask & ~inside[1:-1, 2:]), (1, 0), (1, 1)),
        (*np.nonzero(mask & ~inside[2:, 1:-1]), (1, 1), (0, 1)),
        (*np.nonzero(mask & ~inside[1:-1, :-2]), (0, 1), (0, 0)),
    ):
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            following.setdefault((column + start[0], row + start[1]), []).append((column + end[0], row + end[1]))
    loops = []
    while following:
        loop = [next(iter(following))]
        while loop[-1] in following:
            x, y = loop[-1]
            onward = following[x, y]
            if len(onward) > 1:  # Pixels that touch at a corner belong together: turn right.
                u, v = x - loop[-2][0], y - loop[-2][1]
                onward.sort(key=lambda end: (end[0] - x) * v - (end[1] - y) * u)
            loop.append(onward.pop())
            if not onward:
                del following[x, y]
        points = np.array(loop[:-1], float)
        before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        loops.append(points[(before != after).any(axis=1)])
    return loops


def simplify_outline(loop: np.ndarray, tolerance: float = STRAIGHT_TOLERANCE) -> np.ndarray:
    """An outline (P, 2) with few points: the middles of its sides one pixel long, which are the steps of a slanting line, and the
    corners between longer sides; of these as many as it takes to be within the tolerance (Ramer, Douglas and Peucker).
    """
    sides = np.roll(loop, -1, axis=0) - loop
    long = np.abs(sides).sum(axis=1) > 1
    corners, steps = np.flatnonzero(long & np.roll(long, 1)), np.flatnonzero(~long)
    order = np.argsort(np.concatenate([corners, steps + 0.5]))
    loop = np.concatenate([loop[corners], loop[steps] + sides[steps] / 2])[order]
    loop = np.roll(loop, -int(((loop - loop.mean(axis=0)) ** 2).sum(axis=1).argmax()), axis=0)
    far = int(((loop - loop[0]) ** 2).sum(axis=1).argmax())
    points = np.concatenate([loop, loop[:1]])
    kept, open_ = {0, far}, [(0, far), (far, len(loop))]
    while open_:
        i, j = open_.pop()
        if j - i < 2:
            continue
        chord, away = points[j] - points[i], points[i + 1 : j] - points[i]
        length2 = (chord**2).sum()
        part = np.clip(away @ chord / length2, 0, 1) if length2 > 0 else np.zeros(len(away))
        distance = np.linalg.norm(away - part[:, None] * chord, axis=1)
        worst = int(distance.argmax())
        if distance[worst] > tolerance:
            k = i + 1 + worst
            kept.add(k)
            open_ += [(i, k), (k, j)]
    return loop[sorted(kept)]


def _door_segments(mask: np.ndarray, wall: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """A segment (E, 2, 2) along the middle of each patch of pixels, from the wall on one of its sides to that on the other."""
    from scipy.ndimage import binary_dilation, label

    patches, _ = cast("tuple[np.ndarray, int]", label(mask, np.ones((3, 3))))
    near_wall = binary_dilation(wall, np.ones((3, 3)), iterations=MAX_BLUR_PIXELS)
    found = []
    for k in range(1, int(patches.max()) + 1):
        centres, touches = (np.argwhere(which)[:, ::-1] + 0.5 for which in (patches == k, (patches == k) & near_wall))
        middle = centres.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov(centres.T, bias=True).reshape(2, 2))
        reach = np.abs((centres - middle) @ axes).max(axis=0)
        # The wall touches the patch at its ends, as far out as the patch goes; beside it, here and there.
        far = np.abs((touches - middle) @ axes).mean(axis=0) / np.maximum(reach, 0.5) if len(touches) else np.zeros(2)
        along = axes[:, int(far[1] >= far[0])]
        half = np.abs((centres - middle) @ along).max() + 0.5 * np.abs(along).max()
        ends = np.array([middle - half * along, middle + half * along])
        near = nearest_points(ends, walls)
        away = np.linalg.norm(near - ends[:, None], axis=2)
        closest = near[np.arange(2), away.argmin(axis=1)]
        found.append(np.where((away.min(axis=1) <= MAX_BLUR_PIXELS + 0.5)[:, None], closest, ends))
    return np.array(found)


def _rgb_pixels(image: Any) -> np.ndarray:
    """The colours (H, W, 3) from 0 to 255, on white where the picture is transparent."""
    if isinstance(image, str | Path):
        from PIL import Image

        try:
            with Image.open(image) as opened:
                array = np.asarray(opened.convert("RGBA"), float)
        except OSError as error:
            raise ModelError(f"{image} cannot be read as a picture: {error}") from None
    else:
        array = np.asarray(image)
        if array.ndim != 3 or array.shape[2] not in (3, 4) or not array.size or array.dtype.kind not in "uif":
            raise ModelError(f"picture: shape {array.shape}, {array.dtype}; expected numbers (H, W, 3) or (H, W, 4)")
        array = array * (255.0 if array.dtype.kind == "f" and array.max() <= 1 else 1.0)
    if array.shape[2] == 3:
        return array
    opaque = array[..., 3:] / 255
    return array[..., :3] * opaque + 255 * (1 - opaque)


def _parse_colour(value: Any, label: str) -> np.ndarray:
    """Red, green and blue from 0 to 255."""
    from PIL import ImageColor

    if isinstance(value, str):
        try:
            return np.array(ImageColor.getrgb(value)[:3], float)
        except ValueError:
            raise ModelError(
                f"the colour of {label}: '{value}' is not the name of a colour; give a name or (red, green, blue)"
            ) from None
    try:
        array = np.array(value, float).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.size != 3 or not ((array >= 0) & (array <= 255)).all():
        raise ModelError(
            f"the colour of {label}: {describe_argument(value)}; expected a name or (red, green, blue) from 0 to 255"
        )
    return array


def _format_rgb(colour: np.ndarray) -> str:
    return "({:.0f}, {:.0f}, {:.0f})".format(*colour)


GRID_MARGIN = 1.0  # What a grid shows of the outside, m: ways out lead there.
# An exit ends at a wall that is as near as this, m: through a smaller gap nobody fits, and none is drawn so.
TOUCH_DISTANCE = 1e-3
# Where along an exit both of its sides are looked at: not at its ends, which lie on walls; obstacles may cover some.
PROBE_FRACTIONS = np.arange(1, 8) / 8


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
                raise ModelError(f"exits: {describe_argument(name)} is not a name; expected a string")
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
        found, doors = read_floor_plan(image, pixel, walls, {"exit": "red"} if exits is None else exits)
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
                f"at a spacing of {grid.spacing:.3g} m the room is open: its walls have a gap of about this size; walls and "
                "exits must enclose the room"
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
