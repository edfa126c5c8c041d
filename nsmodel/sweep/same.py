"""Whether a sweep goes on with one that is there: the same, or with more points or seeds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from nsmodel.archive import DIGITS
from nsmodel.archive import digest_of as digest_of_bytes
from nsmodel.identity import digest_of
from nsmodel.manifest import bound_to
from nsmodel.sweep.design import REPLICATE, SAMPLE, SEED, Design

MORE = (SAMPLE, SEED, REPLICATE)  # Dimensions that may become longer: what is there keeps its place in them.


def document(design: Design) -> dict[str, Any]:
    """What varies, for a manifest: names and, of what is no number, texts that tell values apart."""
    return {
        "dims": list(design.dims),
        "sizes": list(design.shape),
        "columns": [[one.kind, one.name, list(one.along)] for one in design.columns],
        "items": {one.name: _texts(one.values) for one in design.columns if not one.numeric},
        "entropy": design.entropy,
    }


def arrays(design: Design) -> dict[str, np.ndarray]:
    """What varies as numbers."""
    return {f"{one.kind}:{one.name}": one.values for one in design.columns if one.numeric}


class Binding:
    """What binds files to a sweep, whose cells may become more.

    Attributes:
        sweep: the digest of all that its numbers depend on but the values of cells.
    """

    def __init__(self, settings: Mapping[str, Any], design: Design) -> None:
        about = document(design)
        self.sweep = bound_to(settings, about["dims"], about["columns"], about["entropy"])
        self._design = design

    @cached_property
    def _numbers(self) -> list[tuple[tuple[int, ...], np.ndarray]]:
        """What varies as bytes: the dimensions of each column, and its values, or digests of what is no number."""
        return [
            (one.along, one.values.astype(one.values.dtype.newbyteorder("<")) if one.numeric else _digests(one.values))
            for one in self._design.columns
        ]

    def of(self, cells: np.ndarray, shape: tuple[int, ...]) -> dict[str, Any]:
        """What binds numbers to cells (K,) of the sweep, counted in a shape that it had: metadata of a file."""
        places, found = np.unravel_index(cells, shape), hashlib.sha256()
        for place in places:
            found.update(np.ascontiguousarray(place, "<i8").data)
        for along, values in self._numbers:
            found.update(np.ascontiguousarray(values[tuple(places[axis] for axis in along)]).data)
        return {"sweep": self.sweep, "values": found.hexdigest()[:DIGITS], "shape": list(shape)}


def _digests(values: np.ndarray) -> np.ndarray:
    texts = [digest_of_bytes(text.encode(errors="backslashreplace")) for text in _texts(values)]
    return np.array(texts, f"S{DIGITS}").reshape(values.shape)


def difference(there: dict[str, Any], numbers: dict[str, np.ndarray], design: Design) -> str | None:
    """Name the first thing in which the sweep that is there is another; None where this one goes on with it."""
    now, names = document(design), arrays(design)
    for key in ("dims", "columns", "entropy"):
        if there[key] != now[key]:
            return f"other {key} ({there[key]} there, {now[key]} now)"
    for dim, before, after in zip(there["dims"], there["sizes"], now["sizes"], strict=True):
        if after < before:
            return f"{before} values of {dim}, {after} now"
        if after > before and dim not in MORE:
            return f"{before} values of {dim}, {after} now; only samples and seeds may be added to"
    for column in design.columns:
        lead = tuple(there["sizes"][axis] for axis in column.along)
        part = tuple(slice(0, size) for size in lead)
        if not column.numeric:
            if there["items"].get(column.name) != _texts(column.values[part]):
                return f"other values of {column.name}"
            continue
        old, new = numbers.get(f"{column.kind}:{column.name}", np.zeros(())), names[f"{column.kind}:{column.name}"][part]
        if old.shape != new.shape:
            return f"values of {column.name} of shape {old.shape}, {new.shape} now"
        where = np.argwhere(old != new)
        if len(where):
            at = tuple(where[0])
            return f"{column.name}[{', '.join(map(str, at))}] = {old[at]!s}, {new[at]!s} now"
    return None


def _texts(values: np.ndarray) -> list[str]:
    return [one if isinstance(one, str) else f"{one}"[:40] + digest_of([one]) for one in values.ravel().tolist()]
