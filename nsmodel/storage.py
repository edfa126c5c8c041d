"""Result files: npz with JSON metadata, JSON, CSV, and numbered chunks with a manifest for long runs.

Every file is written beside its target, synced and renamed: a reader finds the old file or the new one, never half a
file. Equal content gives equal bytes. Each reader and writer raises StorageError, naming the file and what to do.

Files carry STAMP. One without it is of format 1 (nsmodel 0.1); one of a later format is refused.
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
import secrets
import threading
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from nsmodel.errors import StorageError
from nsmodel.version import VERSION

# CPython's parser, which reads an array's header, may fail where two threads of a program parse at once (SystemError).
_ONE_AT_A_TIME = threading.RLock()

Metadata = Mapping[str, Any]
Layout = dict[str, tuple[np.dtype, tuple[int, ...]]]

FORMAT = 2  # Rises with every change of what files hold.
STAMP = {"format": FORMAT, "version": VERSION}
LIST = "contact_"  # Arrays whose names begin so are lists: their length is not the number of rows, but one of their own.
MANIFEST = "manifest.json"
PART = ".part-"  # Names of files not yet whole begin so.
_METADATA = "metadata.json"
_AFRESH = "remove the folder, or give another, to start afresh"
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
        stream.write(_utf8(f"{text}\n"))


def read_json(path: str | Path) -> Any:
    """Read what ``write_json`` wrote."""
    try:
        data = loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; check the path") from error
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{path} is not a readable JSON file ({error}); write it again") from error
    if isinstance(data, dict):
        _refuse_later(data, path)
    return data


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
    """Write ``arrays`` in their order, uncompressed, and ``metadata`` as JSON; ``numpy.load`` reads the file too.

    The file's own entries in the metadata are "format", "version" and "arrays", their names.
    """
    members = _members_of(arrays, path)
    with _beside(Path(path)) as stream:
        _write_archive(stream, members, metadata)


def read_npz(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read (arrays, metadata) as ``write_npz`` wrote them."""
    with _ONE_AT_A_TIME, _reading(Path(path)) as archive:
        metadata = _metadata(archive, path)
        return {name: _whole_array(member) for name, member in _members(archive)}, metadata


def refuse_unwritable(path: str | Path) -> None:
    """Make the folder of a file; StorageError where it cannot be written: now, and not when hours of work are to be saved."""
    _make_folder(Path(path).parent, path)


def _make_folder(folder: Path, what: Any) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {what}: {error}; take a folder that is writable") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StorageError(f"cannot write {what}: no permission; take a folder that is writable")


class ChunkStore:
    """A long run on disk, in constant memory: ``chunk-000001.npz``, ... and a ``manifest.json`` that lists them.

    ``ChunkStore(directory)`` starts afresh: its first ``append`` replaces the run found there. ``ChunkStore.open``
    goes on with that run. The manifest is written last: killed at any moment, the directory holds the state after some
    whole ``append`` or ``join``. Chunks that the manifest does not list are ignored, and overwritten. It has a hash of each:
    what was changed or exchanged since is found before anything is added.

    A store is for one program at a time (see `lock`).
    """

    def __init__(self, directory: str | Path) -> None:
        """Start a new, empty store; no file is written before the first ``append``.

        StorageError where the directory cannot be made or written: now, and not when hours of work are to be saved.
        """
        self.directory = Path(directory)
        self._manifest = _manifest([], {}, {})
        _make_folder(self.directory, f"into {directory}")

    @classmethod
    def open(cls, directory: str | Path) -> ChunkStore:
        """Open the run in ``directory``, and check that each chunk is the one its manifest lists, byte for byte."""
        path = Path(directory) / MANIFEST
        if not path.exists():
            raise StorageError(f"nothing to resume in {directory}: no {MANIFEST}; start the run without resuming")
        store = cls(directory)
        manifest = read_json(path)
        if not (isinstance(manifest, dict) and isinstance(manifest.get("format"), int) and manifest.get("chunks")):
            raise StorageError(f"{path} is not a manifest; {_AFRESH}")
        if manifest.pop("checksum", None) != _checksum(manifest):
            raise StorageError(f"{path} was changed after it was written; {_AFRESH}")
        if manifest["format"] < FORMAT:
            by = manifest["metadata"]["versions"]["nsmodel"]
            raise StorageError(
                f"{path} is of format {manifest['format']}, written by nsmodel {by}: its files can be read, but nsmodel "
                f"{VERSION} does not continue the run; go on with nsmodel {by}, or {_AFRESH}"
            )
        store._manifest = manifest
        store._verify()
        return store

    @property
    def manifest(self) -> dict[str, Any]:
        """A copy of {format, version, chunks: [{file, rows, sha256}], rows, checkpoint, metadata, status}, as it is on disk.

        Where there are lists (see LIST), each chunk and the whole have ``listed``, their length. While chunks are being joined,
        ``joined`` is what the one chunk will be.
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
        path = self.directory / f"chunk-{len(chunks) + 1:06d}.npz"
        members = _members_of(data, path)
        with _beside(path) as stream:
            _write_archive(stream, members, {})
            digest = _digest(stream)
        self._commit([*chunks, {"file": path.name, **lengths, "sha256": digest}], checkpoint, metadata)

    def read(self) -> dict[str, np.ndarray]:
        """The arrays of all chunks, joined in memory."""
        parts = [read_npz(file)[0] for file in self._files()]
        return {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}

    def join(self, path: str | Path, metadata: Metadata) -> None:
        """Make one file of all chunks at ``path``, with the bytes that ``write_npz`` would give; then it is chunk one.

        Memory does not depend on the length of the run, and ``append`` and ``join`` may follow.
        """
        path = Path(path)
        if _CHUNK.fullmatch(path.name):
            raise StorageError(f"cannot join into {path}: names like this are the chunks' own; take trajectory.npz")
        if not self._manifest["chunks"]:
            raise StorageError(f"nothing to join in {self.directory}: no chunk was appended")
        layout, files, total = self._layout(), self._files(), _total(self._manifest["chunks"])
        members = {name: _Member(dtype, shape, _blocks(files, name)) for name, (dtype, shape) in layout.items()}
        inside = path.resolve().parent == self.directory.resolve()
        whole = {"file": path.name if inside else str(path.resolve()), **total}
        with _beside(path) as stream:
            _write_archive(stream, members, metadata)
            whole["sha256"] = _digest(stream)
            # The file may take the place of a chunk: whoever is killed from here on must know both.
            self._commit(self._manifest["chunks"], self._manifest["checkpoint"], metadata, whole)
        self._manifest["chunks"] = [whole]
        self._commit([whole], self._manifest["checkpoint"], metadata)
        for stale in self.directory.iterdir():
            if _CHUNK.fullmatch(stale.name):
                stale.unlink()

    def _files(self) -> list[Path]:
        return [self.directory / chunk["file"] for chunk in self._manifest["chunks"]]

    def _commit(
        self, chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata, joined: Metadata | None = None
    ) -> None:  # fmt: skip
        manifest = loads(dumps(_manifest(chunks, checkpoint, metadata) | ({} if joined is None else {"joined": joined})))
        write_json(self.directory / MANIFEST, manifest | {"checksum": _checksum(manifest)})
        self._manifest = manifest

    def _verify(self) -> None:
        """Compare each chunk with its hash; where a join was cut off after its file took its place, finish it."""
        whole = self._manifest.pop("joined", None)
        if whole is not None and (file := self.directory / whole["file"]).is_file() and _digest_of(file) == whole["sha256"]:
            self._manifest["chunks"] = [whole]
            return
        for file, chunk in zip(self._files(), self._manifest["chunks"], strict=True):
            if _digest_of(file) != chunk["sha256"]:
                raise StorageError(
                    f"{file} is not the file that {MANIFEST} lists: it was changed, or exchanged for another, after it was "
                    f"written; put it back from a copy, or {_AFRESH}"
                )

    def _layout(self) -> Layout:
        """Data type and shape of each array of the whole run."""
        total = _total(self._manifest["chunks"])
        return {name: (dtype, (total[_length(name)], *shape[1:])) for name, (dtype, shape) in self._first().items()}

    def _first(self) -> Layout:
        """Read the header of the first chunk."""
        return _header(self._files()[0])


def unfinished(directory: str | Path) -> dict[str, Any] | None:
    """The manifest in ``directory`` if it is that of a run that can be continued, by this version or the one that wrote it.

    None where there is none, or it is damaged; StorageError where a later version wrote it.
    """
    path = Path(directory) / MANIFEST
    try:
        manifest = loads(path.read_text(encoding="utf-8"))
        whole = manifest.pop("checksum") == _checksum(manifest)
    except (OSError, ValueError, RecursionError, AttributeError, LookupError, StorageError):
        return None
    _refuse_later(manifest, path)
    return manifest if whole and manifest["status"] in ("running", "interrupted") else None


@dataclass(frozen=True)
class _Member:
    """One array to write: its data type, its shape, its bytes in C order, block after block."""

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Iterable[bytes | memoryview]


def _members_of(arrays: Mapping[str, np.ndarray], path: str | Path) -> dict[str, _Member]:
    """The arrays as they are written."""
    members = {}
    for name, value in arrays.items():
        array = np.asarray(value, order="C")
        if array.dtype.hasobject:
            raise StorageError(f"cannot write {path}: array '{name}' holds Python objects; make it an array of numbers")
        members[name] = _Member(array.dtype, array.shape, [array.reshape(-1).view(np.uint8).data])
    return members


def _write_archive(stream: IO[bytes], members: Mapping[str, _Member], metadata: Metadata) -> None:
    text = dumps({**metadata, **STAMP, "arrays": list(members)}, indent=1)
    with zipfile.ZipFile(stream, "w") as archive:
        for name, member in members.items():
            with archive.open(_entry(f"{name}.npy"), "w", force_zip64=True) as file:
                descr = npy.dtype_to_descr(member.dtype)
                npy.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": member.shape})
                for block in member.blocks:
                    file.write(block)
        archive.writestr(_entry(_METADATA), _utf8(text))


def _entry(name: str) -> zipfile.ZipInfo:
    """Describe a member, with nothing of the clock or the platform."""
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.create_system, entry.external_attr = 3, 0o644 << 16
    return entry


def _metadata(archive: zipfile.ZipFile, path: str | Path) -> dict[str, Any]:
    """The metadata without the file's own entries; the archive must hold the arrays that these name, and nothing else."""
    files = archive.namelist()
    if _METADATA not in files:
        raise StorageError(f"{path} has no {_METADATA}: nsmodel did not write it; read it with numpy.load")
    metadata = loads(archive.read(_METADATA).decode())
    if not isinstance(metadata, dict):
        raise ValueError(f"{_METADATA} is no dictionary")
    _refuse_later(metadata, path)
    arrays = metadata.pop("arrays", None) if "format" in metadata else [f.removesuffix(".npy") for f in files if f != _METADATA]
    if files != [*(f"{name}.npy" for name in arrays), _METADATA]:
        raise ValueError(f"it holds {', '.join(files)}, not what was written")
    return {key: value for key, value in metadata.items() if key not in STAMP}


def _refuse_later(data: Metadata, path: str | Path) -> None:
    """Refuse a file of a format that this version does not know."""
    number = data.get("format", 1)
    if isinstance(number, int | float) and number > FORMAT:
        by = f"nsmodel {data['version']}" if "version" in data else "a later nsmodel"
        raise StorageError(
            f"{path} is of format {number}, written by {by}; nsmodel {VERSION} knows formats up to {FORMAT}: read it with {by}"
        )


def _whole_array(member: IO[bytes]) -> np.ndarray:
    """The array of a member, read to its end, where its checksum is compared."""
    array = npy.read_array(member, allow_pickle=False)
    if member.read(1):
        raise ValueError("an array is longer than its header says")
    return array


def _digest(stream: IO[bytes]) -> str:
    """SHA-256 of all that was written to a stream, in hexadecimal."""
    stream.seek(0)
    return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore[reportArgumentType]


def _digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    try:
        with path.open("rb") as stream:
            return _digest(stream)
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; put it back from a copy, or {_AFRESH}") from error
    except OSError as error:
        raise StorageError(f"{path} cannot be read ({error}); put it back from a copy, or {_AFRESH}") from error


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


def _lengths(layout: Layout) -> dict[str, int] | None:
    """The number of rows, and the length of the lists where there are any; None where arrays do not agree."""
    found: dict[str, set[int]] = {"rows": set()}
    for name, (_, shape) in layout.items():
        found.setdefault(_length(name), set()).add(shape[0] if shape else -1)
    agree = all(len(numbers) == 1 and min(numbers) >= 0 for numbers in found.values())
    return {key: numbers.pop() for key, numbers in found.items()} if agree else None


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
    return hashlib.sha256(_utf8(dumps(manifest))).hexdigest()[:16]


def _manifest(chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata) -> dict[str, Any]:
    state = {"checkpoint": checkpoint, "metadata": metadata, "status": metadata.get("status", "running")}
    return {**STAMP, "chunks": chunks, **({"rows": 0} | _total(chunks)), **state}


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
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to that becomes ``path``; after an error nothing remains, and an OSError is a StorageError.

    Several programs may write one file: each has its own beside it, the last one stays. A pipe or a device is written itself.
    """
    part = path.with_name(f"{PART}{secrets.token_hex(4)}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not (path.is_file() or path.is_dir()):
            yield path
            return
        try:
            yield part
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error}; take a folder that is writable and has room") from error


@contextmanager
def _beside(path: Path) -> Iterator[IO[bytes]]:
    """Give a stream that becomes the file ``path`` once all is written and synced."""
    with replacing(path) as part, part.open("wb" if part == path else "xb+") as stream:
        yield stream
        stream.flush()
        if part != path:
            os.fsync(stream.fileno())


def _csv_lines(rows: Iterable[Iterable[Any]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return _utf8(text.getvalue())


def _utf8(text: str) -> bytes:
    """Text as UTF-8; what has none, such as a file's name in another encoding, is escaped as JSON does it."""
    return text.encode(errors="backslashreplace")


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
