"""A sweep on disk: what varies, parts as they come, and in the end one file.

``manifest.json`` says what sweep it is, ``design.npz`` holds what varies; ``part-N.npz`` are cells in the order in which they
came, each whole or not there. Once all cells are there, ``sweep.npz`` holds them in their order, and nothing of who computed
which when: equal sweeps are equal bytes. A part says of which shape the sweep was when it was written, so that points or seeds
may be added later; it has the digest of its sweep and of what varies at its cells, and is taken by no other sweep.

Whether a sweep goes on with one that is there: the same, or with more points or seeds.

What the files of sweeps hold: the names in them, and what is refused in one that was changed.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Iterator, Mapping
from functools import cached_property, partial
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.errors import StorageError
from nsmodel.files.archive import DIGEST_DIGITS, Archive, ArchiveMember, map_archive, read_archive, write_archive, write_npz
from nsmodel.files.archive import chunk_digest as digest_of_bytes
from nsmodel.files.metadata import (
    MANIFEST_FILE,
    SWEEP_FIELDS,
    SWEEP_MANIFEST_FIELDS,
    SWEEP_PART_FIELDS,
    check_field_types,
    read_manifest,
    settings_digest,
    with_checksum,
)
from nsmodel.files.storage import FORMAT_STAMP, atomic_stream, path_inside, read_json, write_json
from nsmodel.modeling.fingerprint import content_digest
from nsmodel.sweep.cells import check_same_shape, missing_value, put_cells, unrun_facts
from nsmodel.sweep.design import REPLICATE, SAMPLE, SEED, SweepDesign
from nsmodel.sweep.request import CELL_BACKENDS, CELL_FACTS, EVENT_DRIVEN_FACTS, CellResults
from nsmodel.sweep.variable import CELL_FAILED, CELL_NOT_RUN, STATUS_NAMES

EXTENDABLE_DIMS = (SAMPLE, SEED, REPLICATE)  # Dimensions that may become longer: what is there keeps its place in them.


def design_document(design: SweepDesign) -> dict[str, Any]:
    """What varies, for a manifest: names and, of what is not a number, texts that tell values apart."""
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
        """What varies as bytes: the dimensions of each column, and its values, or digests of what is not a number."""
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
        raise StorageError(f"{path}: array 't' is not a list of increasing finite times")
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
            raise StorageError(f"{path}: array '{name}' has shape {found}; expected {lead}, followed by the shape within a cell")
        if name in facts and (dtype.str[1:], found) != (facts[name][0], (size,)):
            raise StorageError(
                f"{path}: array '{name}' is of type {dtype} and shape {found}; expected {facts[name][0]}, ({size},)"
            )
        if name.startswith((DIM_PREFIX, VALUE_PREFIX)) and name not in expected:
            raise StorageError(f"{path}: array '{name}' belongs to nothing that varies according to the metadata")


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
            raise StorageError(f"{path} holds no array '{name}': it is not a part of a sweep")
    cells, size = arrays[CELL_ARRAY], prod(about["shape"])
    inside = cells.ndim == 1 and len(cells) > 0 and cells.dtype.kind in "iu" and cells.min() >= 0 and cells.max() < size
    if not inside or len(np.unique(cells)) < len(cells):
        raise StorageError(f"{path}: array '{CELL_ARRAY}' is not a list of different cells, 0 to {size - 1}")
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


_PART_NAME_PATTERN = re.compile(r"part-(\d+)\.npz")
# Bytes that are read or written at a time, those of one digest, 4 MB: what memory a file takes while it is made.
_BLOCK_BYTES = 1 << 22
_REMOVE_HINT = "take it out of the folder, or give another folder"
QuantityTypes = Mapping[str, tuple[str, tuple[int, ...]]]


class SweepStore:
    """The folder of a sweep of this design; no file is read, written or removed but in it, by its own name."""

    def __init__(self, folder: Path, design: SweepDesign, settings: Mapping[str, Any], binding: SweepBinding) -> None:
        self.folder, self.design, self.shape, self.size = folder, design, design.shape, design.size
        self._settings, self._binding = settings, binding
        self._next = 1 + max(
            (int(found[1]) for path in self._part_files() if (found := _PART_NAME_PATTERN.fullmatch(path.name))), default=0
        )

    @property
    def exists(self) -> bool:
        """Whether a sweep is there."""
        return (self.folder / MANIFEST_FILE).exists() or (self.folder / SWEEP_FILE).exists()

    def begin(self) -> None:
        """Say what sweep it is, before any cell of it is there."""
        write_npz(self._file(DESIGN_FILE), design_numbers(self.design), {"sweep": self._binding.sweep})
        about = {"sweep": self._binding.sweep, "settings": self._settings, "design": design_document(self.design)}
        write_json(self._file(MANIFEST_FILE), with_checksum({**FORMAT_STAMP, **about, "shape": list(self.shape)}))

    def check_same_sweep(self) -> None:
        """Raise StorageError where another sweep is there, or files that belong to another; nothing is written."""
        manifest = read_sweep_manifest(self.folder)
        for key, value in self._settings.items():
            if manifest["settings"].get(key) != value:
                what = "its model" if key == "model" else f"{key} ({manifest['settings'].get(key)} there, {value} now)"
                raise StorageError(f"{self.folder}: the sweep there differs in {what}; give another folder")
        archive, numbers = read_archive(self._file(DESIGN_FILE))
        if archive.metadata.get("sweep") != manifest["sweep"]:
            raise StorageError(
                f"{archive.path} does not belong to the sweep of {MANIFEST_FILE}; put it back from a copy, or give another folder"
            )
        other = design_difference(manifest["design"], numbers, self.design)
        if other is not None:
            raise StorageError(f"{self.folder}: the sweep there has {other}; give another folder")
        self.status()

    def put(self, cells: np.ndarray, found: CellResults) -> None:
        """Write cells (K,) that have been run."""
        ran = found.arrays["status"] != CELL_NOT_RUN
        if not ran.any():
            return
        arrays = {CELL_ARRAY: cells[ran], **{name: values[ran] for name, values in found.arrays.items()}}
        number = np.cumsum(ran) - 1
        messages = {str(int(number[i])): text for i, text in found.messages.items()}
        about = {"messages": messages, **self._binding.of(cells[ran], self.shape)}
        write_npz(self._file(f"part-{self._next:06d}.npz"), arrays, about)
        self._next += 1

    def _file(self, name: str) -> Path:
        return path_inside(self.folder, name, "nsmodel")

    def status(self) -> np.ndarray:
        """The status (size,) of each cell, CELL_NOT_RUN where it is not there."""
        status = np.full(self.size, CELL_NOT_RUN, np.int8)
        for cells, arrays, _ in self._read_parts():
            status[cells] = arrays["status"]
        return status

    def read(self) -> CellResults:
        """All cells, in memory."""
        found: dict[str, np.ndarray] = {}
        messages: dict[int, str] = {}
        for cells, arrays, own in self._read_parts():
            put_cells(found, self.size, cells, arrays)
            _merge_messages(messages, cells, own)
        return CellResults(found, messages)

    def join(self, metadata: Mapping[str, Any], design: Mapping[str, np.ndarray], order: QuantityTypes) -> None:
        """Make one file of all cells, and remove the parts.

        Args:
            metadata: of the file; its messages are added.
            design: arrays of what varies, which come first.
            order: the other arrays: {name: (data type, shape of a cell)}, as they are where no cell has it.

        Raises:
            UsageError: a quantity has another shape in another cell.
        """
        parts, messages, found = list(self._cell_files()), {}, {}
        for cells, arrays, own in self._read_parts():
            for name, values in arrays.items():
                kind = found.setdefault(name, (values.dtype, values.shape[1:]))
                check_same_shape(name, values.shape[1:], kind[1])
            _merge_messages(messages, cells, own)
        with tempfile.TemporaryDirectory(dir=self.folder, prefix="joining-") as place:
            whole = {}
            for i, (name, blank_kind) in enumerate(order.items()):
                kind, shape = found.get(name, blank_kind)
                whole[name] = _CellArrayOnDisk(Path(place) / str(i), name, np.dtype(kind), (self.size, *shape))
            for cells, arrays, _ in self._read_parts():
                for name, values in arrays.items():
                    if name in whole:
                        whole[name].put(cells, values)
            members = {name: _array_member(array) for name, array in design.items()}
            members |= {name: ArchiveMember(array.kind, array.shape, array.blocks()) for name, array in whole.items()}
            text = {str(cell): messages[cell] for cell in sorted(messages)}
            bound = self._binding.of(np.arange(self.size), self.shape)
            with atomic_stream(self._file(SWEEP_FILE)) as stream:
                write_archive(stream, members, {**metadata, **bound, "messages": text})
        for path in parts:
            if path.name != SWEEP_FILE:
                path.unlink(missing_ok=True)

    def _part_files(self) -> list[Path]:
        return sorted(self._file(path.name) for path in self.folder.glob("part-*.npz") if _PART_NAME_PATTERN.fullmatch(path.name))

    def _cell_files(self) -> Iterator[Path]:
        """The files that hold cells, later ones last."""
        if self._file(SWEEP_FILE).exists():
            yield self._file(SWEEP_FILE)
        yield from self._part_files()

    def _read_parts(self) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray], dict[int, str]]]:
        """Cells by their numbers in this sweep, their arrays, and messages by places."""
        for path in self._cell_files():
            whole = path.name == SWEEP_FILE
            archive, arrays = map_archive(path) if whole else read_archive(path)
            if not archive.has_digests:
                raise StorageError(f"{path} is of format {archive.format}, and cannot be continued; {_REMOVE_HINT}")
            (check_sweep_file if whole else check_part_file)(archive, arrays)
            shape = tuple(archive.metadata["shape"])
            cells = np.arange(prod(shape)) if whole else arrays[CELL_ARRAY]
            self._check_own_cells(archive, cells, shape)
            names = [
                name
                for name in arrays
                if name not in (CELL_ARRAY, "t") and not (whole and name.startswith((DIM_PREFIX, VALUE_PREFIX)))
            ]
            own = {name: arrays[name] for name in names}
            if shape != self.shape:
                cells = np.ravel_multi_index(np.unravel_index(cells, shape), self.shape)
            yield cells, own, {int(place): text for place, text in archive.metadata["messages"].items()}

    def _check_own_cells(self, archive: Archive, cells: np.ndarray, shape: tuple[int, ...]) -> None:
        """Raise StorageError for cells of another sweep."""
        about, path = archive.metadata, archive.path
        what = None
        if about.get("sweep") != self._binding.sweep:
            what = "belongs to another sweep, of another model or other settings"
        elif len(shape) != len(self.shape) or any(before > now for before, now in zip(shape, self.shape, strict=True)):
            what = f"belongs to another sweep, of shape {shape}"
        elif about != {**about, **self._binding.of(cells, shape)}:
            what = "belongs to another sweep, of other values"
        if what is not None:
            raise StorageError(f"{path} {what}; {_REMOVE_HINT}")


class CellsInMemory:
    """What cells found, where nothing is written."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.found = unrun_results(size)

    def status(self) -> np.ndarray:
        """The status (size,) of each cell."""
        return self.found.arrays["status"]

    def read(self) -> CellResults:
        """The results of all cells."""
        return self.found

    def put(self, cells: np.ndarray, found: CellResults) -> None:
        """Take up what a chunk found."""
        arrays, ran = dict(self.found.arrays), found.arrays["status"] != CELL_NOT_RUN
        put_cells(arrays, self._size, cells[ran], {name: values[ran] for name, values in found.arrays.items()})
        messages = {int(cells[i]): text for i, text in found.messages.items()}
        self.found = CellResults(arrays, {**self.found.messages, **messages})


def unrun_results(size: int) -> CellResults:
    """So many cells that were not run."""
    return CellResults(unrun_facts(size), {})


def _merge_messages(messages: dict[int, str], cells: np.ndarray, own: Mapping[int, str]) -> None:
    """Take the messages of cells, in place of those that they had before."""
    if messages:
        for cell in cells.tolist():
            messages.pop(cell, None)
    messages |= {int(cells[place]): text for place, text in own.items()}


class _CellArrayOnDisk:
    """An array of all cells in a file, of which no more is in memory than is written."""

    def __init__(self, path: Path, name: str, kind: np.dtype, shape: tuple[int, ...]) -> None:
        self._path, self.kind, self.shape = path, kind, shape
        self._each = kind.itemsize * prod(shape[1:])
        rows = max(1, _BLOCK_BYTES // max(self._each, 1))
        blank = np.full((rows, *shape[1:]), missing_value(name, kind), kind).tobytes()
        with path.open("wb") as file:
            for at in range(0, shape[0], rows):
                file.write(blank[: self._each * min(rows, shape[0] - at)])

    def put(self, cells: np.ndarray, values: np.ndarray) -> None:
        """Write the values (K, ...) of cells."""
        ends = [0, *(np.flatnonzero(np.diff(cells) != 1) + 1).tolist(), len(cells)]
        given = np.ascontiguousarray(values, self.kind)
        with self._path.open("rb+") as file:
            for first, last in pairwise(ends):
                file.seek(int(cells[first]) * self._each)
                file.write(given[first:last].tobytes())

    def blocks(self) -> Iterator[bytes]:
        """The bytes of the array, block by block."""
        with self._path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                yield block


def _array_member(array: np.ndarray) -> ArchiveMember:
    rows = max(1, _BLOCK_BYTES // max(array[:1].nbytes, 1))
    blocks = (np.ascontiguousarray(array[i : i + rows]).reshape(-1).view(np.uint8).data for i in range(0, len(array), rows))
    return ArchiveMember(array.dtype, array.shape, blocks)


def missing_cells(status: np.ndarray, *, retry: bool) -> np.ndarray:
    """The cells that are to be run: those that were not, and with ``retry`` those that failed."""
    return np.flatnonzero((status == CELL_NOT_RUN) | (retry & (status == CELL_FAILED)))


def read_sweep_manifest(folder: Path) -> dict[str, Any]:
    """What sweep is there.

    Raises:
        StorageError: none, or not to be read.
    """
    path = path_inside(folder, MANIFEST_FILE, "nsmodel")
    if not path.exists():
        raise StorageError(f"{folder} holds no sweep: there is no {MANIFEST_FILE}; check the path, or leave resume out")
    document = read_json(path)
    if isinstance(document, dict) and "chunks" in document:
        raise StorageError(f"{folder} holds no sweep: its {MANIFEST_FILE} is that of a run; give another folder")
    return read_manifest(folder, SWEEP_MANIFEST_FIELDS, what="sweep", afresh="give another folder")
