"""A long run on disk in chunks, with a manifest that says what was committed."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.archive import LIST_PREFIXES, ArchiveMember, archive_members, stream_sha256, write_archive
from nsmodel.errors import NewerFormatError, StorageError
from nsmodel.fields import MANIFEST_FIELDS as FIELDS
from nsmodel.fields import UNFINISHED_FIELDS, check_field_types
from nsmodel.manifest import MANIFEST_FILE, has_valid_checksum, read_manifest, settings_digest, with_checksum
from nsmodel.storage import FORMAT_STAMP, Metadata, atomic_stream, dumps, loads, make_folder, path_inside, read_json, write_json
from nsmodel.stored import ArchiveLayout, array_blocks, open_archive, read_npz

JOINED_FILE = "trajectory.npz"
_START_AFRESH_HINT = "remove the folder, or give another, to start afresh"
_CHUNK_NAME_PATTERN = re.compile(r"chunk-\d{6,}\.npz")


class ChunkStore:
    """A long run on disk, in constant memory: ``chunk-000001.npz``, ... and a ``manifest.json`` that lists them.

    ``ChunkStore(directory)`` starts afresh: its first ``append`` replaces the run found there. ``ChunkStore.open``
    goes on with that run. The manifest is written last: killed at any moment, the directory holds the state after some
    whole ``append`` or ``join``. Chunks that the manifest does not list are ignored, and overwritten. It has a hash of each,
    and each has the digest of its run (see `manifest.bound_to`): what was changed or exchanged since, or belongs to another run,
    is found before anything is added. No file is read, written or removed but in the folder, by its own name.

    A store is for one program at a time (see `lock`).
    """

    def __init__(self, directory: str | Path) -> None:
        """Start a new, empty store; no file is written before the first ``append``.

        StorageError where the directory cannot be made or written: now, and not when hours of work are to be saved.
        """
        self.directory = Path(directory)
        self._manifest = _make_manifest([], {}, {})
        make_folder(self.directory, f"into {directory}")

    @classmethod
    def open(cls, directory: str | Path) -> ChunkStore:
        """Open the run in ``directory``, and check that each chunk is the one its manifest lists, byte for byte."""
        folder = Path(directory)
        if not (folder / MANIFEST_FILE).exists():
            raise StorageError(f"nothing to resume in {directory}: no {MANIFEST_FILE}; start the run without resuming")
        manifest = read_manifest(folder, FIELDS, what="run", afresh=_START_AFRESH_HINT)
        store = cls(directory)
        if not manifest["chunks"]:
            raise StorageError(f"{folder / MANIFEST_FILE} lists no chunk; {_START_AFRESH_HINT}")
        store._manifest = manifest
        store._verify()
        return store

    @property
    def manifest(self) -> dict[str, Any]:
        """A copy of {format, version, run, chunks: [{file, rows, sha256}], rows, checkpoint, metadata, status}, as on disk.

        Where there are lists (see LIST), each chunk and the whole have ``listed``, their length. While chunks are being joined,
        ``joined`` is what the one chunk will be.
        """
        return copy.deepcopy(self._manifest)

    def append(self, arrays: Mapping[str, np.ndarray], checkpoint: Metadata, metadata: Metadata) -> None:
        """Add the rows of ``arrays``, all of one and replace ``checkpoint``, ``metadata`` and its "status".

        Lists (see LIST) have another all the same.
        """
        data = {name: np.asarray(array) for name, array in arrays.items()}
        if _array_lengths(_array_layout(data)) is None:
            shapes = ", ".join(f"{name} {array.shape}" for name, array in data.items()) or "no array"
            raise StorageError(f"a chunk in {self.directory} needs arrays of one number of rows, got {shapes}")
        if self._manifest["chunks"]:
            _check_same_layout(self._first_layout(), _array_layout(data), self.directory)
        else:
            # An older run's manifest must not describe the chunks that are overwritten from here on.
            (self.directory / MANIFEST_FILE).unlink(missing_ok=True)
        chunks = self._manifest["chunks"]
        self._commit([*chunks, self._write_chunk(len(chunks) + 1, data, _run_digest(checkpoint))], checkpoint, metadata)

    def _write_chunk(self, number: int, data: Mapping[str, np.ndarray], run: str) -> dict[str, Any]:
        """Write a chunk; and what the manifest says of it."""
        path = path_inside(self.directory, f"chunk-{number:06d}.npz", "nsmodel")
        members = archive_members(data, path)
        with atomic_stream(path) as stream:
            write_archive(stream, members, {"run": run})
            return {"file": path.name, **(_array_lengths(_array_layout(data)) or {}), "sha256": stream_sha256(stream)}

    def read(self) -> dict[str, np.ndarray]:
        """The arrays of all chunks, joined in memory."""
        parts = [read_npz(file)[0] for file in self._chunk_paths()]
        return {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}

    def join(self, metadata: Metadata) -> None:
        """Make one file of all chunks, trajectory.npz, with the bytes that ``write_npz`` would give; then it is chunk one.

        Memory does not depend on the length of the run, and ``append`` and ``join`` may follow.
        """
        if not self._manifest["chunks"]:
            raise StorageError(f"nothing to join in {self.directory}: no chunk was appended")
        path = path_inside(self.directory, JOINED_FILE, "nsmodel")
        layout, files, total = self._whole_layout(), self._chunk_paths(), _total_lengths(self._manifest["chunks"])
        members = {name: ArchiveMember(dtype, shape, array_blocks(files, name)) for name, (dtype, shape) in layout.items()}
        whole: dict[str, Any] = {"file": JOINED_FILE, **total}
        with atomic_stream(path) as stream:
            write_archive(stream, members, metadata)
            whole["sha256"] = stream_sha256(stream)
            # The file may take the place of a chunk: whoever is killed from here on must know both.
            self._commit(self._manifest["chunks"], self._manifest["checkpoint"], metadata, whole)
        self._manifest["chunks"] = [whole]
        self._commit([whole], self._manifest["checkpoint"], metadata)
        for stale in self.directory.iterdir():
            if _CHUNK_NAME_PATTERN.fullmatch(stale.name):
                stale.unlink()

    def shorten(self, rows: int, listed: int) -> None:
        """Take the last rows of the whole run away, and the last of its lists: what was cut off at its end is made anew."""
        if len(self._manifest["chunks"]) > 1 or _CHUNK_NAME_PATTERN.fullmatch(self._manifest["chunks"][0]["file"]):
            self.join(self._manifest["metadata"])
        away = {"rows": rows, "listed": listed}
        arrays = {name: array[: len(array) - away[_length_key(name)]] for name, array in self.read().items()}
        metadata = {**self._manifest["metadata"], "status": "running", "message": ""}
        checkpoint = {**self._manifest["checkpoint"], "cut": None}
        self._commit([self._write_chunk(1, arrays, _run_digest(checkpoint))], checkpoint, metadata)

    def discard(self) -> None:
        """Forget the run: its manifest and its chunks are removed."""
        (self.directory / MANIFEST_FILE).unlink(missing_ok=True)
        for file in self._chunk_paths():
            file.unlink(missing_ok=True)
        self._manifest = _make_manifest([], {}, {})

    def _chunk_paths(self) -> list[Path]:
        return [self._chunk_path(chunk) for chunk in self._manifest["chunks"]]

    def _chunk_path(self, chunk: Mapping[str, Any]) -> Path:
        """A chunk's file, by a name that chunks have."""
        if chunk["file"] != JOINED_FILE and not _CHUNK_NAME_PATTERN.fullmatch(chunk["file"]):
            by = self.directory / MANIFEST_FILE
            raise StorageError(
                f"{by} lists the file {chunk['file']!r:.80}, which is no chunk of a run: it was changed; {_START_AFRESH_HINT}"
            )
        return path_inside(self.directory, chunk["file"], str(self.directory / MANIFEST_FILE))

    def _commit(
        self, chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata, joined: Metadata | None = None
    ) -> None:  # fmt: skip
        manifest = loads(dumps(_make_manifest(chunks, checkpoint, metadata) | ({} if joined is None else {"joined": joined})))
        write_json(path_inside(self.directory, MANIFEST_FILE, "nsmodel"), with_checksum(manifest))
        self._manifest = manifest

    def _verify(self) -> None:
        """Compare each chunk with its hash and its run; where a join was cut off after its file took its place, finish it."""
        whole = self._manifest.pop("joined", None)
        if whole is not None and (file := self._chunk_path(whole)).is_file() and _file_sha256(file) == whole["sha256"]:
            self._manifest["chunks"] = [whole]
        run = _run_digest(self._manifest["checkpoint"])
        if self._manifest["run"] != run:
            raise StorageError(f"{self.directory / MANIFEST_FILE} and its checkpoint belong to two runs; {_START_AFRESH_HINT}")
        for file, chunk in zip(self._chunk_paths(), self._manifest["chunks"], strict=True):
            if _file_sha256(file) != chunk["sha256"]:
                other = _run_digest_of_file(file)
                what = "it belongs to another run" if other not in (None, run) else "it was changed, or exchanged for another,"
                raise StorageError(
                    f"{file} is not the file that {MANIFEST_FILE} lists: {what} after it was "
                    f"written; put it back from a copy, or {_START_AFRESH_HINT}"
                )
            found = open_archive(file)
            if _array_lengths(found.layout) != {key: chunk[key] for key in ("rows", "listed") if key in chunk}:
                raise StorageError(f"{file} has other numbers of rows than {MANIFEST_FILE} says; {_START_AFRESH_HINT}")
        if self._manifest["rows"] != _total_lengths(self._manifest["chunks"])["rows"]:
            raise StorageError(
                f"{self.directory / MANIFEST_FILE} counts {self._manifest['rows']} rows, its chunks have others; "
                f"{_START_AFRESH_HINT}"
            )

    def _whole_layout(self) -> ArchiveLayout:
        """Data type and shape of each array of the whole run."""
        total = _total_lengths(self._manifest["chunks"])
        return {name: (dtype, (total[_length_key(name)], *shape[1:])) for name, (dtype, shape) in self._first_layout().items()}

    def _first_layout(self) -> ArchiveLayout:
        """Of the first chunk."""
        return open_archive(self._chunk_paths()[0]).layout


def unfinished_manifest(directory: str | Path) -> dict[str, Any] | None:
    """The manifest in ``directory`` if it is that of a run that can be continued, by this version or the one that wrote it.

    None where there is none.

    Raises:
        StorageError: a later version wrote it, it is damaged beside chunks that nothing else lists, or it is that of a sweep.
    """
    folder = Path(directory)
    if not (folder / MANIFEST_FILE).exists():
        return None
    path = path_inside(folder, MANIFEST_FILE, "nsmodel")
    try:
        manifest = read_json(path)
        if not (isinstance(manifest, dict) and has_valid_checksum(manifest)):
            raise StorageError(f"{path} was changed after it was written; {_START_AFRESH_HINT}")
    except StorageError as error:
        if isinstance(error, NewerFormatError) or any(_CHUNK_NAME_PATTERN.fullmatch(file.name) for file in folder.iterdir()):
            raise
        return None
    if "design" in manifest:
        raise StorageError(f"{folder} holds a sweep; give another folder")
    check_field_types(manifest, UNFINISHED_FIELDS, path)
    return manifest if manifest["status"] in ("running", "interrupted") else None


def _run_digest(checkpoint: Metadata) -> str:
    """The digest of the run whose checkpoint this is."""
    return settings_digest(checkpoint.get("settings"))


def _run_digest_of_file(path: Path) -> Any:
    """The digest of the run that a file says it belongs to; None where it says none."""
    try:
        return open_archive(path).metadata.get("run")
    except StorageError:
        return None


def _array_layout(data: Mapping[str, np.ndarray]) -> ArchiveLayout:
    return {name: (array.dtype, array.shape) for name, array in data.items()}


def _file_sha256(path: Path) -> str:
    """SHA-256 of a file."""
    try:
        with path.open("rb") as stream:
            return stream_sha256(stream)
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; put it back from a copy, or {_START_AFRESH_HINT}") from error
    except OSError as error:
        raise StorageError(f"{path} cannot be read ({error}); put it back from a copy, or {_START_AFRESH_HINT}") from error


def _length_key(name: str) -> str:
    """What the length of an array is called in the manifest."""
    return "listed" if name.startswith(LIST_PREFIXES) else "rows"


def _array_lengths(layout: ArchiveLayout) -> dict[str, int] | None:
    """The number of rows, and the length of the lists where there are any; None where arrays do not agree."""
    found: dict[str, set[int]] = {"rows": set()}
    for name, (_, shape) in layout.items():
        found.setdefault(_length_key(name), set()).add(shape[0] if shape else -1)
    agree = all(len(numbers) == 1 and min(numbers) >= 0 for numbers in found.values())
    return {key: numbers.pop() for key, numbers in found.items()} if agree else None


def _total_lengths(chunks: list[dict[str, Any]]) -> dict[str, int]:
    """The lengths of the whole run."""
    keys = [key for key in ("rows", "listed") if all(key in chunk for chunk in chunks)]
    return {key: sum(chunk[key] for chunk in chunks) for key in keys}


def _check_same_layout(first: ArchiveLayout, other: ArchiveLayout, where: Path) -> None:
    one, two = ({name: (dtype, shape[1:]) for name, (dtype, shape) in header.items()} for header in (first, other))
    for name in sorted(one.keys() | two.keys()):
        if one.get(name) != two.get(name):
            expected, got = (f"{h[name][0]} rows of shape {h[name][1]}" if name in h else "none" for h in (one, two))
            raise StorageError(f"array '{name}' in {where} differs from chunk one: expected {expected}, got {got}")


def _make_manifest(chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata) -> dict[str, Any]:
    state = {"checkpoint": checkpoint, "metadata": metadata, "status": metadata.get("status", "running")}
    return {**FORMAT_STAMP, "run": _run_digest(checkpoint), "chunks": chunks, **({"rows": 0} | _total_lengths(chunks)), **state}
