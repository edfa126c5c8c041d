"""Whether a sweep goes on with one that is there: the same, or with more points or seeds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from nsmodel.archive import DIGEST_DIGITS
from nsmodel.archive import chunk_digest as digest_of_bytes
from nsmodel.identity import content_digest
from nsmodel.later import former_names
from nsmodel.manifest import settings_digest
from nsmodel.sweep.design import REPLICATE, SAMPLE, SEED, SweepDesign

EXTENDABLE_DIMS = (SAMPLE, SEED, REPLICATE)  # Dimensions that may become longer: what is there keeps its place in them.


def design_document(design: SweepDesign) -> dict[str, Any]:
    """What varies, for a manifest: names and, of what is no number, texts that tell values apart."""
    return {
        "dims": list(design.dims),
        "sizes": list(design.shape),
        "columns": [[one.kind, one.name, list(one.along)] for one in design.columns],
        "items": {one.name: _value_texts(one.values) for one in design.columns if not one.numeric},
        "entropy": design.entropy,
    }


def design_numbers(design: SweepDesign) -> dict[str, np.ndarray]:
    """What varies as numbers."""
    return {f"{one.kind}:{one.name}": one.values for one in design.columns if one.numeric}


class SweepBinding:
    """What binds files to a sweep, whose cells may become more.

    Attributes:
        sweep: the digest of all that its numbers depend on but the values of cells.
    """

    def __init__(self, settings: Mapping[str, Any], design: SweepDesign) -> None:
        about = design_document(design)
        self.sweep = settings_digest(settings, about["dims"], about["columns"], about["entropy"])
        self._design = design

    @cached_property
    def _varied_bytes(self) -> list[tuple[tuple[int, ...], np.ndarray]]:
        """What varies as bytes: the dimensions of each column, and its values, or digests of what is no number."""
        return [
            (one.along, one.values.astype(one.values.dtype.newbyteorder("<")) if one.numeric else _value_digests(one.values))
            for one in self._design.columns
        ]

    def of(self, cells: np.ndarray, shape: tuple[int, ...]) -> dict[str, Any]:
        """What binds numbers to cells (K,) of the sweep, counted in a shape that it had: metadata of a file."""
        places, found = np.unravel_index(cells, shape), hashlib.sha256()
        for place in places:
            found.update(np.ascontiguousarray(place, "<i8").data)
        for along, values in self._varied_bytes:
            found.update(np.ascontiguousarray(values[tuple(places[axis] for axis in along)]).data)
        return {"sweep": self.sweep, "values": found.hexdigest()[:DIGEST_DIGITS], "shape": list(shape)}


def _value_digests(values: np.ndarray) -> np.ndarray:
    texts = [digest_of_bytes(text.encode(errors="backslashreplace")) for text in _value_texts(values)]
    return np.array(texts, f"S{DIGEST_DIGITS}").reshape(values.shape)


def design_difference(saved: dict[str, Any], numbers: dict[str, np.ndarray], design: SweepDesign) -> str | None:
    """Name the first thing in which the sweep that is there is another; None where this one goes on with it."""
    now, names = design_document(design), design_numbers(design)
    for key in ("dims", "columns", "entropy"):
        if saved[key] != now[key]:
            return f"other {key} ({saved[key]} there, {now[key]} now)"
    for dim, before, after in zip(saved["dims"], saved["sizes"], now["sizes"], strict=True):
        if after < before:
            return f"{before} values of {dim}, {after} now"
        if after > before and dim not in EXTENDABLE_DIMS:
            return f"{before} values of {dim}, {after} now; only samples and seeds may be added to"
    for column in design.columns:
        lead = tuple(saved["sizes"][axis] for axis in column.along)
        part = tuple(slice(0, size) for size in lead)
        if not column.numeric:
            if saved["items"].get(column.name) != _value_texts(column.values[part]):
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


def _value_texts(values: np.ndarray) -> list[str]:
    return [one if isinstance(one, str) else f"{one}"[:40] + content_digest([one]) for one in values.ravel().tolist()]


__getattr__ = former_names(__name__, Binding="SweepBinding")
