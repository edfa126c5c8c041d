"""What the files of sweeps hold: the names in them, and what is refused in one that was changed."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.errors import StorageError
from nsmodel.fields import SWEEP_FIELDS, SWEEP_PART_FIELDS, check_field_types
from nsmodel.stored import Archive
from nsmodel.sweep.asked import CELL_BACKENDS, CELL_FACTS, EVENT_DRIVEN_FACTS
from nsmodel.sweep.variable import STATUS_NAMES

SWEEP_FILE, DESIGN_FILE, CELL_ARRAY = "sweep.npz", "design.npz", "cell"
DIM_PREFIX, VALUE_PREFIX = "dim:", "value:"  # What the arrays of the design are called.
LABELS_KEY = "labels"  # And in the metadata the coordinates that are texts.
FILE_METADATA_KEYS = ("messages", "shape", "dims", "along", LABELS_KEY)


def check_sweep_file(archive: Archive, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise StorageError for a file that holds no whole sweep; arrays are not read but for the times."""
    path, about, layout = archive.path, archive.metadata, archive.layout
    if "dims" not in about or "status" not in layout:
        raise StorageError(f"{path} holds no sweep; a run's file is read with Trajectory.load")
    check_field_types(about, SWEEP_FIELDS, path)
    dims, shape, labels = about["dims"], tuple(about["shape"]), about.get(LABELS_KEY, {})
    size, t = prod(shape), arrays.get("t", np.zeros((0, 0)))
    check_message_cells(about, size, path)
    if len(set(dims)) != len(dims) or len(dims) != len(shape):
        raise StorageError(f"{path}: dims is {dims}; expected a name for each of {len(shape)} dimensions, each once")
    if t.ndim != 1 or not len(t) or t.dtype.kind == "b" or not np.isfinite(t).all() or (np.diff(t) < 0).any():
        raise StorageError(f"{path}: array 't' is no list of finite times, one after the other")
    expected = {f"{DIM_PREFIX}{dim}": (length,) for dim, length in zip(dims, shape, strict=True) if dim not in labels}
    for dim, length in zip(dims, shape, strict=True):
        if len(labels.get(dim, range(length))) != length:
            raise StorageError(f"{path}: {LABELS_KEY}['{dim}'] has {len(labels[dim])} texts; expected {length}")
    for name, axes in about["along"].items():
        if any(axis >= len(shape) for axis in axes) or len(set(axes)) < len(axes):
            raise StorageError(f"{path}: along['{name}'] is {axes}; expected numbers of dimensions, 0 to {len(shape) - 1}")
        expected[f"{VALUE_PREFIX}{name}"] = tuple(shape[axis] for axis in axes)
    facts = {**CELL_FACTS, **(EVENT_DRIVEN_FACTS if "pieces" in layout else {})}
    for name in [*expected, *facts, *about["keep"], *about["outputs"]]:
        if name not in layout:
            raise StorageError(f"{path} holds no array '{name}', which its metadata names")
    for name, (dtype, found) in layout.items():
        if name == "t":
            continue
        if dtype.kind not in ("iuf" if name.startswith((DIM_PREFIX, VALUE_PREFIX)) else "if"):
            raise StorageError(f"{path}: array '{name}' is of type {dtype}; expected numbers")
        lead = expected.get(name, (size,) + ((len(t),) if name in about["keep"] else ()))
        if found[: len(lead)] != lead or (name.startswith(DIM_PREFIX) and len(found) > 1):
            raise StorageError(f"{path}: array '{name}' has shape {found}; expected {lead}, and what a cell has behind it")
        if name in facts and (dtype.str[1:], found) != (facts[name][0], (size,)):
            raise StorageError(
                f"{path}: array '{name}' is of type {dtype} and shape {found}; expected {facts[name][0]}, ({size},)"
            )
        if name.startswith((DIM_PREFIX, VALUE_PREFIX)) and name not in expected:
            raise StorageError(f"{path}: array '{name}' is of nothing that the metadata say varies")


def check_message_cells(about: Mapping[str, Any], size: int, path: Path) -> None:
    """Raise StorageError for messages of cells that are not there."""
    for cell in about["messages"]:
        if not (cell.isascii() and cell.isdigit() and len(cell) < 19 and int(cell) < size):
            raise StorageError(f"{path}: messages has the cell {cell!r:.40}; expected numbers, 0 to {size - 1}")


def _check_codes(known: frozenset[int], name: str, values: np.ndarray) -> None:
    unknown = set(np.unique(values).tolist()) - known
    if unknown:
        raise StorageError(
            f"array '{name}' of a sweep has the code {min(unknown)}; expected one of {sorted(known)}: it was changed"
        )


def check_part_file(archive: Archive, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise StorageError for a file that does not hold some cells of a sweep."""
    path, about = archive.path, archive.metadata
    check_field_types(about, SWEEP_PART_FIELDS, path)
    for name in (CELL_ARRAY, *CELL_FACTS):
        if name not in arrays:
            raise StorageError(f"{path} holds no array '{name}': it is no part of a sweep")
    cells, size = arrays[CELL_ARRAY], prod(about["shape"])
    inside = cells.ndim == 1 and len(cells) > 0 and cells.dtype.kind in "iu" and cells.min() >= 0 and cells.max() < size
    if not inside or len(np.unique(cells)) < len(cells):
        raise StorageError(f"{path}: array '{CELL_ARRAY}' is no list of different cells, 0 to {size - 1}")
    facts = {**CELL_FACTS, **EVENT_DRIVEN_FACTS}
    for name, values in arrays.items():
        kind = facts.get(name, (values.dtype.str[1:],))[0]
        shape = cells.shape if name in facts else (len(cells), *values.shape[1:])
        numbers = name == CELL_ARRAY or values.dtype.kind in "if"
        if values.shape != shape or values.dtype.str[1:] != kind or not numbers:
            raise StorageError(f"{path}: array '{name}' is {values.dtype}, {values.shape}; expected {kind}, {shape}")
    check_message_cells(about, len(cells), path)
    for name, check in CODE_CHECKS.items():
        check(arrays[name])


CODE_CHECKS = {
    "status": partial(_check_codes, frozenset(STATUS_NAMES), "status"),
    "way": partial(_check_codes, frozenset(range(-1, len(CELL_BACKENDS))), "way"),
}
