"""Result files: npz with JSON metadata, JSON, CSV, and numbered chunks with a manifest for long runs.

Every file is written beside its target, synced and renamed: a reader finds the old file or the new one, never half a
file. Equal content gives equal bytes. Each reader and writer raises StorageError, naming the file and what to do.
"""

from __future__ import annotations

import copy
import csv
import hashlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from nsmodel.errors import StorageError

Metadata = Mapping[str, Any]
Layout = dict[str, tuple[np.dtype, tuple[int, ...]]]

FORMAT = 1
LIST = "contact_"  # Arrays whose names begin so are lists: their length is not the number of rows, but one of their own.
MANIFEST = "manifest.json"
_METADATA = "metadata.json"
_BLOCK = 1 << 20
_CHUNK = re.compile(r"chunk-\d{6,}\.npz")
_NON_FINITE = re.compile(r"\\*(nan|inf|-inf)")


def dumps(data: Any, indent: int | None = None) -> str:
    """JSON text of ``data``: keys sorted, floats exact, NaN and infinities as the strings "nan", "inf", "-inf".

    Tuples and NumPy arrays become lists. A string that reads like one of those three gets a backslash in front, so that
    ``loads`` gives back what went in.
    """
    return json.dumps(_encode(data, "data"), sort_keys=True, ensure_ascii=False, allow_nan=False, indent=indent)


def loads(text: str) -> Any:
    """Inverse of ``dumps``; ValueError where ``text`` is not JSON."""
    return _decode(json.loads(text))


def write_json(path: str | Path, data: Any) -> None:
    """Write ``data`` as ``dumps`` spells it, indented."""
    write_text(path, dumps(data, indent=1))


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` and a line end."""
    with _beside(Path(path)) as stream:
        stream.write(f"{text}\n".encode())


def read_json(path: str | Path) -> Any:
    """Read what ``write_json`` wrote."""
    try:
        return loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; check the path") from error
    except (OSError, ValueError) as error:
        raise StorageError(f"{path} is not a readable JSON file ({error}); write it again") from error


def write_csv(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write 1-D ``columns`` of one length under a header line; floats in the shortest form that reads back exactly."""
    data = {name: np.asarray(column) for name, column in columns.items()}
    if len({column.shape for column in data.values()}) != 1 or any(column.ndim != 1 for column in data.values()):
        shapes = ", ".join(f"{name} {column.shape}" for name, column in data.items()) or "no column"
        raise StorageError(f"cannot write {path}: it needs 1-D columns of one length, got {shapes}")
    rows = len(next(iter(data.values())))
    with _beside(Path(path)) as stream:
        stream.write(_csv_lines([list(data)]))
        for start in range(0, rows, 4096):
            block = [column[start : start + 4096].tolist() for column in data.values()]
            stream.write(_csv_lines(zip(*block, strict=True)))


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Metadata) -> None:
    """Write ``arrays`` in their order, uncompressed, and ``metadata`` as JSON; ``numpy.load`` reads the file too."""
    members = {}
    for name, value in arrays.items():
        array = np.asarray(value, order="C")
        if array.dtype.hasobject:
            raise StorageError(f"cannot write {path}: array '{name}' holds Python objects; make it an array of numbers")
        members[name] = _Member(array.dtype, array.shape, [array.reshape(-1).view(np.uint8).data])
    _write_archive(Path(path), members, metadata)


def read_npz(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read (arrays, metadata) as ``write_npz`` wrote them."""
    with _reading(Path(path)) as archive:
        if _METADATA not in archive.namelist():
            raise StorageError(f"{path} has no {_METADATA}: nsmodel did not write it; read it with numpy.load")
        metadata = loads(archive.read(_METADATA).decode())
        return {name: npy.read_array(member, allow_pickle=False) for name, member in _members(archive)}, metadata


class ChunkStore:
    """A long run on disk, in constant memory: ``chunk-000001.npz``, ... and a ``manifest.json`` that lists them.

    ``ChunkStore(directory)`` starts afresh: its first ``append`` replaces the run found there. ``ChunkStore.open``
    goes on with that run. The manifest is written last: killed at any moment, the directory holds the state after some
    whole ``append`` or ``join``. Chunks that the manifest does not list are ignored, and overwritten.
    """

    def __init__(self, directory: str | Path) -> None:
        """Start a new, empty store; no file is written before the first ``append``.

        StorageError where the directory cannot be made or written: now, and not when hours of work are to be saved.
        """
        self.directory = Path(directory)
        self._manifest = _manifest([], {}, {})
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot write into {directory}: {error}; take a folder that is writable") from error
        if not os.access(self.directory, os.W_OK | os.X_OK):
            raise StorageError(f"cannot write into {directory}: no permission; take a folder that is writable")

    @classmethod
    def open(cls, directory: str | Path) -> ChunkStore:
        """Open the run in ``directory``, and check that each chunk its manifest lists is whole."""
        path = Path(directory) / MANIFEST
        if not path.exists():
            raise StorageError(f"nothing to resume in {directory}: no {MANIFEST}; start the run without resuming")
        store = cls(directory)
        manifest = read_json(path)
        if not (isinstance(manifest, dict) and manifest.get("format") == FORMAT and manifest.get("chunks")):
            raise StorageError(f"{path} is not a manifest of format {FORMAT}; start the run without resuming")
        if manifest.pop("checksum", None) != _checksum(manifest):
            raise StorageError(f"{path} was changed after it was written; start the run without resuming")
        store._manifest = manifest
        store._layout()
        return store

    @property
    def manifest(self) -> dict[str, Any]:
        """A copy of {format, chunks: [{file, rows}], rows, checkpoint, metadata, status}, as it is on disk.

        Where there are lists (see LIST), each chunk and the whole have ``listed``, their length.
        """
        return copy.deepcopy(self._manifest)

    def append(self, arrays: Mapping[str, np.ndarray], checkpoint: Metadata, metadata: Metadata) -> None:
        """Add the rows of ``arrays``, all of one length, and replace ``checkpoint``, ``metadata`` and its "status".

        Lists (see LIST) have another length, all the same.
        """
        data = {name: np.asarray(array) for name, array in arrays.items()}
        lengths = _lengths({name: (array.dtype, array.shape) for name, array in data.items()})
        if lengths is None:
            shapes = ", ".join(f"{name} {array.shape}" for name, array in data.items()) or "no array"
            raise StorageError(f"a chunk in {self.directory} needs arrays of one number of rows, got {shapes}")
        if self._manifest["chunks"]:
            layout = {name: (array.dtype, array.shape) for name, array in data.items()}
            _same_layout(self._first(), layout, self.directory)
        else:
            # An older run's manifest must not describe the chunks that are overwritten from here on.
            (self.directory / MANIFEST).unlink(missing_ok=True)
        chunks = self._manifest["chunks"]
        name = f"chunk-{len(chunks) + 1:06d}.npz"
        write_npz(self.directory / name, data, {})
        self._commit([*chunks, {"file": name, **lengths}], checkpoint, metadata)

    def join(self, path: str | Path, metadata: Metadata) -> None:
        """Make one file of all chunks at ``path``, with the bytes that ``write_npz`` would give; then it is chunk one.

        Memory does not depend on the length of the run, and ``append`` and ``join`` may follow.
        """
        path = Path(path)
        if _CHUNK.fullmatch(path.name):
            raise StorageError(f"cannot join into {path}: names like this are the chunks' own; take trajectory.npz")
        if not self._manifest["chunks"]:
            raise StorageError(f"nothing to join in {self.directory}: no chunk was appended")
        layout, files = self._layout(), self._files()
        members = {name: _Member(dtype, shape, _blocks(files, name)) for name, (dtype, shape) in layout.items()}
        _write_archive(path, members, metadata)
        inside = path.resolve().parent == self.directory.resolve()
        whole = {"file": path.name if inside else str(path.resolve()), **_total(self._manifest["chunks"])}
        self._commit([whole], self._manifest["checkpoint"], metadata)
        for stale in self.directory.iterdir():
            if _CHUNK.fullmatch(stale.name):
                stale.unlink()

    def _files(self) -> list[Path]:
        return [self.directory / chunk["file"] for chunk in self._manifest["chunks"]]

    def _commit(self, chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata) -> None:
        manifest = loads(dumps(_manifest(chunks, checkpoint, metadata)))
        write_json(self.directory / MANIFEST, manifest | {"checksum": _checksum(manifest)})
        self._manifest = manifest

    def _layout(self) -> Layout:
        """Check the chunks by their headers; return data type and shape of each array of the whole run."""
        first = self._first()
        for file, chunk in zip(self._files(), self._manifest["chunks"], strict=True):
            header = _header(file)
            for key, numbers in _found(header).items():
                if numbers != [chunk.get(key)]:
                    fault = f"{file} holds {numbers} {key} where {MANIFEST} says {chunk.get(key)}"
                    raise StorageError(f"{fault}: it was changed after it was written; start the run without resuming")
            _same_layout(first, header, file)
        total = _total(self._manifest["chunks"])
        return {name: (dtype, (total[_length(name)], *shape[1:])) for name, (dtype, shape) in first.items()}

    def _first(self) -> Layout:
        """Read the header of the first chunk.

        Where it holds all rows, a join was cut off after its file was renamed, before the manifest was: finish it.
        """
        chunk, total = self._manifest["chunks"][0], _total(self._manifest["chunks"])
        header = _header(self.directory / chunk["file"])
        if _lengths(header) == total:
            self._manifest["chunks"] = [chunk | total]
        return header


@dataclass(frozen=True)
class _Member:
    """One array to write: its data type, its shape, its bytes in C order, block after block."""

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Iterable[bytes | memoryview]


def _write_archive(path: Path, members: Mapping[str, _Member], metadata: Metadata) -> None:
    text = dumps(metadata, indent=1)
    with _beside(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, member in members.items():
            with archive.open(_entry(f"{name}.npy"), "w", force_zip64=True) as file:
                descr = npy.dtype_to_descr(member.dtype)
                npy.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": member.shape})
                for block in member.blocks:
                    file.write(block)
        archive.writestr(_entry(_METADATA), text.encode())


def _entry(name: str) -> zipfile.ZipInfo:
    """Describe a member, with nothing of the clock or the platform."""
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.create_system, entry.external_attr = 3, 0o644 << 16
    return entry


def _header(path: Path) -> Layout:
    """Read data type and shape of each array in a chunk, not the data."""
    header = {}
    with _reading(path) as archive:
        for name, member in _members(archive):
            npy.read_magic(member)
            shape, _, dtype = npy.read_array_header_1_0(member)
            header[name] = (dtype, shape)
    return header


def _members(archive: zipfile.ZipFile) -> Iterator[tuple[str, IO[bytes]]]:
    for name in archive.namelist():
        if name.endswith(".npy"):
            with archive.open(name) as member:
                yield name.removesuffix(".npy"), member


def _blocks(files: Iterable[Path], name: str) -> Iterator[bytes]:
    """Yield the bytes of array ``name``, file after file."""
    for file in files:
        with _reading(file) as archive, archive.open(f"{name}.npy") as member:
            npy.read_magic(member)
            npy.read_array_header_1_0(member)
            while block := member.read(_BLOCK):
                yield block


def _length(name: str) -> str:
    """What the length of an array is called in the manifest."""
    return "listed" if name.startswith(LIST) else "rows"


def _found(layout: Layout) -> dict[str, list[int]]:
    """The numbers of rows, and the lengths of lists where there are any: one of each if the arrays agree."""
    found: dict[str, set[int]] = {"rows": set()}
    for name, (_, shape) in layout.items():
        found.setdefault(_length(name), set()).add(shape[0] if shape else -1)
    return {key: sorted(numbers) for key, numbers in found.items()}


def _lengths(layout: Layout) -> dict[str, int] | None:
    """The number of rows, and the length of the lists where there are any; None where arrays do not agree."""
    found = _found(layout)
    agree = all(len(numbers) == 1 and numbers[0] >= 0 for numbers in found.values())
    return {key: numbers[0] for key, numbers in found.items()} if agree else None


def _total(chunks: list[dict[str, Any]]) -> dict[str, int]:
    """The lengths of the whole run."""
    keys = [key for key in ("rows", "listed") if all(key in chunk for chunk in chunks)]
    return {key: sum(chunk[key] for chunk in chunks) for key in keys}


def _same_layout(first: Layout, other: Layout, where: Path) -> None:
    one, two = ({name: (dtype, shape[1:]) for name, (dtype, shape) in header.items()} for header in (first, other))
    for name in sorted(one.keys() | two.keys()):
        if one.get(name) != two.get(name):
            expected, got = (f"{h[name][0]} rows of shape {h[name][1]}" if name in h else "none" for h in (one, two))
            raise StorageError(f"array '{name}' in {where} differs from chunk one: expected {expected}, got {got}")


def _checksum(manifest: Metadata) -> str:
    return hashlib.sha256(dumps(manifest).encode()).hexdigest()[:16]


def _manifest(chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata) -> dict[str, Any]:
    state = {"checkpoint": checkpoint, "metadata": metadata, "status": metadata.get("status", "running")}
    return {"format": FORMAT, "chunks": chunks, **({"rows": 0} | _total(chunks)), **state}


@contextmanager
def _reading(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except StorageError:
        raise
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; check the path, or run the model again") from error
    except IsADirectoryError as error:
        raise StorageError(f"{path} is a folder; give the file in it, {path / 'trajectory.npz'}") from error
    except MemoryError as error:
        raise StorageError(f"{path} does not fit in memory ({error}); read it with numpy.load, array by array") from error
    except Exception as error:  # damaged bytes make zipfile and numpy raise nearly anything
        fault = f"{path} is not a whole npz file ({error or type(error).__name__})"
        raise StorageError(f"{fault}: it was cut short or another program wrote it; run the model again") from error


@contextmanager
def _beside(path: Path) -> Iterator[IO[bytes]]:
    """Give a stream that becomes the file ``path`` once all is written and synced; after an error nothing remains."""
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error}; take a folder that is writable and has room") from error


def _csv_lines(rows: Iterable[Iterable[Any]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _encode(value: Any, where: str) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise StorageError(f"{where} has the key {key!r}; JSON keys are strings: use {str(key)!r}")
        return {str(key): _encode(entry, f"{where}[{key!r}]") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_encode(entry, f"{where}[{index}]") for index, entry in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    if isinstance(value, str):
        return f"\\{value}" if _NON_FINITE.fullmatch(value) else value
    if value is None or isinstance(value, bool | int | float):
        return value
    raise StorageError(f"{where} is a {type(value).__name__}; keep numbers, strings, lists, dictionaries or None there")


def _decode(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _decode(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_decode(entry) for entry in value]
    if isinstance(value, str) and _NON_FINITE.fullmatch(value):
        return value[1:] if value.startswith("\\") else float(value)
    return value
