"""A floor plan read from a picture: outlines of wall pixels, and a segment for each patch of a door's colour."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from nsmodel.crowd.geometry import nearest_points, polygon_sides
from nsmodel.errors import ModelError
from nsmodel.modeling.parameters import describe_argument
from nsmodel.modeling.time_grid import is_number

COLOUR_TOLERANCE = 60  # Colours are the same where no channel differs by more, of 255.
MAX_BLUR_PIXELS = 2  # So many pixels between a wall and a door may have a colour in between.
STRAIGHT_TOLERANCE = 0.75  # An outline is a straight line where it is this near to one, in pixels.


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
        from PIL import Image, UnidentifiedImageError

        try:
            with Image.open(image) as opened:
                array = np.asarray(opened.convert("RGBA"), float)
        except (OSError, UnidentifiedImageError) as error:
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
                f"the colour of {label}: '{value}' is no name of a colour; give a name or (red, green, blue)"
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
