"""Points and line segments in the plane, many at once: distances, crossings, free sight.

What users give to the crowd tools, checked: numbers, points, radii, seeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nsmodel.errors import ModelError, NsmodelError
from nsmodel.modeling.parameters import describe_argument

MAX_CHUNK_NUMBERS = 2_000_000  # Numbers in the largest array of intermediate results, 16 MB: larger inputs are taken in parts.
# Places in a leaf of a k-d tree, fixed: the order of its pairs, and which of two equally near it names, depend on it.
LEAF_SIZE = 16


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The third component of u x v; positive where v is to the left of u."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def nearest_points(q: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """The point of each segment that is nearest to each q: (N, 2) and (W, 2, 2) give (N, W, 2)."""
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length2 = (along**2).sum(axis=1)
    part = ((q[:, None] - a) * along).sum(axis=2) / np.where(length2 > 0, length2, 1)
    return a + np.clip(part, 0, 1)[..., None] * along


def distances(q: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """The distance of each q (N, 2) from the nearest of the segments (W, 2, 2); inf where there is none."""
    if not len(segments):
        return np.full(len(q), np.inf)
    parts = np.array_split(q, 1 + 4 * len(q) * len(segments) // MAX_CHUNK_NUMBERS)
    return np.concatenate([np.linalg.norm(p[:, None] - nearest_points(p, segments), axis=2).min(axis=1) for p in parts])


def crossed_segments(p: np.ndarray, q: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Whether the way from p to q (N, 2) crosses each segment (N, W), and p is not on it.

    A point on the line of a segment counts as on its right, so that each passage counts once.
    """
    a, b = segments[:, 0], segments[:, 1]
    sides = (cross(b - a, p[:, None] - a) > 0) != (cross(b - a, q[:, None] - a) > 0)
    way = (q - p)[:, None]
    return sides & ((cross(way, a - p[:, None]) > 0) != (cross(way, b - p[:, None]) > 0))


def crosses_any(p: np.ndarray, q: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Whether the way from p to q (N, 2) crosses any of the segments."""
    parts = 1 + 4 * len(p) * len(segments) // MAX_CHUNK_NUMBERS
    pairs = zip(np.array_split(p, parts), np.array_split(q, parts), strict=True)
    return np.concatenate([crossed_segments(*pair, segments).any(axis=1) for pair in pairs])


def has_free_path(p: np.ndarray, q: np.ndarray, segments: np.ndarray, clearance: float) -> np.ndarray:
    """Whether a disc can go straight from p to q (N, 2), both at least ``clearance`` away from all segments."""
    ends, which = np.unique(segments.reshape(-1, 2), axis=0, return_inverse=True)
    first, last = which.reshape(-1, 2).T
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    offset = cross(along, a)
    free = np.empty(len(p), bool)
    for rows in np.array_split(np.arange(len(p)), 1 + len(p) * (len(ends) + len(segments)) // MAX_CHUNK_NUMBERS):
        start, way = p[rows], q[rows] - p[rows]
        length = np.linalg.norm(way, axis=1)
        way = way / np.where(length > 0, length, 1)[:, None]
        # Of the four distances between the ends of two segments and the other segment, two are known to be large enough.
        ahead = way @ ends.T - (way * start).sum(axis=1)[:, None]
        sideways = np.column_stack([-way[:, 1], way[:, 0]]) @ ends.T - cross(way, start)[:, None]
        past = ahead - np.clip(ahead, 0, length[:, None])
        near = (sideways**2 + past**2 < clearance**2 * (1 - 1e-9)).any(axis=1)
        normals = np.column_stack([-along[:, 1], along[:, 0]]).T
        sides = (start @ normals > offset) != (q[rows] @ normals > offset)
        free[rows] = ~near & ~(sides & ((sideways[:, first] > 0) != (sideways[:, last] > 0))).any(axis=1)
    return free


def contains(polygon: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Whether each q (N, 2) is inside a polygon (P, 2), by the parity of crossings."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = q[:, :1], q[:, 1:]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    slope = np.divide(b[:, 0] - a[:, 0], b[:, 1] - a[:, 1], out=np.zeros(len(a)), where=a[:, 1] != b[:, 1])
    return (spans & (x < a[:, 0] + (y - a[:, 1]) * slope)).sum(axis=1) % 2 == 1


def polygon_sides(corners: np.ndarray) -> np.ndarray:
    """The sides (P, 2, 2) of a polygon (P, 2)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def checked_array(value: Any, label: str, expected: str, kind: type[NsmodelError] = ModelError) -> np.ndarray:
    """An array of finite numbers, not to be written to."""
    try:
        array = None if value is None else np.array(value, float)
    except (TypeError, ValueError):
        array = None
    if array is None:
        raise kind(f"{label}: {describe_argument(value)}; expected {expected}")
    if not np.isfinite(array).all():
        raise kind(f"{label}: {array[~np.isfinite(array)].flat[0]} is not a finite number; expected {expected}")
    array.setflags(write=False)
    return array


def checked_number(
    value: Any, label: str, expected: str = "a number > 0, in metres", *, zero: bool = False,
    kind: type[NsmodelError] = ModelError,
) -> float:  # fmt: skip
    """One finite number > 0, or with ``zero`` >= 0."""
    array = checked_array(value, label, expected, kind)
    if array.ndim or not (array > 0 or (zero and array == 0)):
        raise kind(f"{label}: {describe_argument(value)}; expected {expected}")
    return float(array)


def per_person_values(value: Any, label: str, count: int, unit: str, *, zero: bool = False) -> np.ndarray:
    """Numbers (count,) > 0, or with ``zero`` >= 0, one for each person, from these or from one for all."""
    expected = f"one number {'>=' if zero else '>'} 0 or ({count},), one for each person, in {unit}"
    array = checked_array(value, label, expected)
    if array.shape not in ((), (count,)) or (array < 0).any() or (not zero and (array == 0).any()):
        raise ModelError(f"{label}: {describe_argument(value)}, shape {array.shape}; expected {expected}")
    return np.broadcast_to(array, count).copy()


def radius_range(radii: Any) -> tuple[float, float]:
    """The least and the largest radius."""
    expected = "one radius > 0, or (least, largest), in metres"
    array = checked_array(radii, "radii", expected)
    if array.shape not in ((), (2,)) or not (array > 0).all() or array.flat[0] > array.flat[-1]:
        raise ModelError(f"radii: {describe_argument(radii)}; expected {expected}")
    return float(array.flat[0]), float(array.flat[-1])


def random_generator(seed: Any) -> np.random.Generator:
    """Random numbers from a seed."""
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise ModelError(f"seed: {describe_argument(seed)}; expected a whole number >= 0") from None
