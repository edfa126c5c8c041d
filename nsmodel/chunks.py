"""A long run on disk in chunks, with a manifest that says what was committed."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.archive import LIST, Member, digest_of_stream, members_of, write_archive
from nsmodel.errors import LaterFormatError, StorageError
from nsmodel.fields import MANIFEST as FIELDS
from nsmodel.fields import UNFINISHED, refuse_other_types
from nsmodel.manifest import MANIFEST, bound_to, is_signed, read_manifest, signed
from nsmodel.storage import STAMP, Metadata, dumps, inside, loads, make_folder, read_json, stream_beside, write_json
from nsmodel.stored import Layout, blocks, opened, read_npz

WHOLE = "trajectory.npz"
_AFRESH = "remove the folder, or give another, to start afresh"
_CHUNK = re.compile(r"chunk-\d{6,}\.npz")


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
        self._manifest = _manifest([], {}, {})
        make_folder(self.directory, f"into {directory}")

    @classmethod
    def open(cls, directory: str | Path) -> ChunkStore:
        """Open the run in ``directory``, and check that each chunk is the one its manifest lists, byte for byte."""
        folder = Path(directory)
        if not (folder / MANIFEST).exists():
            raise StorageError(f"nothing to resume in {directory}: no {MANIFEST}; start the run without resuming")
        manifest = read_manifest(folder, FIELDS, what="run", afresh=_AFRESH)
        store = cls(directory)
        if not manifest["chunks"]:
            raise StorageError(f"{folder / MANIFEST} lists no chunk; {_AFRESH}")
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
        if _lengths(_layout(data)) is None:
            shapes = ", ".join(f"{name} {array.shape}" for name, array in data.items()) or "no array"
            raise StorageError(f"a chunk in {self.directory} needs arrays of one number of rows, got {shapes}")
        if self._manifest["chunks"]:
            _same_layout(self._first(), _layout(data), self.directory)
        else:
            # An older run's manifest must not describe the chunks that are overwritten from here on.
            (self.directory / MANIFEST).unlink(missing_ok=True)
        chunks = self._manifest["chunks"]
        self._commit([*chunks, self._written(len(chunks) + 1, data, _run_of(checkpoint))], checkpoint, metadata)

    def _written(self, number: int, data: Mapping[str, np.ndarray], run: str) -> dict[str, Any]:
        """Write a chunk; and what the manifest says of it."""
        path = inside(self.directory, f"chunk-{number:06d}.npz", "nsmodel")
        members = members_of(data, path)
        with stream_beside(path) as stream:
            write_archive(stream, members, {"run": run})
            return {"file": path.name, **(_lengths(_layout(data)) or {}), "sha256": digest_of_stream(stream)}

    def read(self) -> dict[str, np.ndarray]:
        """The arrays of all chunks, joined in memory."""
        parts = [read_npz(file)[0] for file in self._files()]
        return {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}

    def join(self, metadata: Metadata) -> None:
        """Make one file of all chunks, trajectory.npz, with the bytes that ``write_npz`` would give; then it is chunk one.

        Memory does not depend on the length of the run, and ``append`` and ``join`` may follow.
        """
        if not self._manifest["chunks"]:
            raise StorageError(f"nothing to join in {self.directory}: no chunk was appended")
        path = inside(self.directory, WHOLE, "nsmodel")
        layout, files, total = self._layout(), self._files(), _total(self._manifest["chunks"])
        members = {name: Member(dtype, shape, blocks(files, name)) for name, (dtype, shape) in layout.items()}
        whole: dict[str, Any] = {"file": WHOLE, **total}
        with stream_beside(path) as stream:
            write_archive(stream, members, metadata)
            whole["sha256"] = digest_of_stream(stream)
            # The file may take the place of a chunk: whoever is killed from here on must know both.
            self._commit(self._manifest["chunks"], self._manifest["checkpoint"], metadata, whole)
        self._manifest["chunks"] = [whole]
        self._commit([whole], self._manifest["checkpoint"], metadata)
        for stale in self.directory.iterdir():
            if _CHUNK.fullmatch(stale.name):
                stale.unlink()

    def shorten(self, rows: int, listed: int) -> None:
        """Take the last rows of the whole run away, and the last of its lists: what was cut off at its end is made anew."""
        if len(self._manifest["chunks"]) > 1 or _CHUNK.fullmatch(self._manifest["chunks"][0]["file"]):
            self.join(self._manifest["metadata"])
        away = {"rows": rows, "listed": listed}
        arrays = {name: array[: len(array) - away[_length(name)]] for name, array in self.read().items()}
        metadata = {**self._manifest["metadata"], "status": "running", "message": ""}
        checkpoint = {**self._manifest["checkpoint"], "cut": None}
        self._commit([self._written(1, arrays, _run_of(checkpoint))], checkpoint, metadata)

    def discard(self) -> None:
        """Forget the run: its manifest and its chunks are removed."""
        (self.directory / MANIFEST).unlink(missing_ok=True)
        for file in self._files():
            file.unlink(missing_ok=True)
        self._manifest = _manifest([], {}, {})

    def _files(self) -> list[Path]:
        return [self._file(chunk) for chunk in self._manifest["chunks"]]

    def _file(self, chunk: Mapping[str, Any]) -> Path:
        """A chunk's file, by a name that chunks have."""
        if chunk["file"] != WHOLE and not _CHUNK.fullmatch(chunk["file"]):
            by = self.directory / MANIFEST
            raise StorageError(
                f"{by} lists the file {chunk['file']!r:.80}, which is no chunk of a run: it was changed; {_AFRESH}"
            )
        return inside(self.directory, chunk["file"], str(self.directory / MANIFEST))

    def _commit(
        self, chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata, joined: Metadata | None = None
    ) -> None:  # fmt: skip
        manifest = loads(dumps(_manifest(chunks, checkpoint, metadata) | ({} if joined is None else {"joined": joined})))
        write_json(inside(self.directory, MANIFEST, "nsmodel"), signed(manifest))
        self._manifest = manifest

    def _verify(self) -> None:
        """Compare each chunk with its hash and its run; where a join was cut off after its file took its place, finish it."""
        whole = self._manifest.pop("joined", None)
        if whole is not None and (file := self._file(whole)).is_file() and _digest_of(file) == whole["sha256"]:
            self._manifest["chunks"] = [whole]
        run = _run_of(self._manifest["checkpoint"])
        if self._manifest["run"] != run:
            raise StorageError(f"{self.directory / MANIFEST} and its checkpoint belong to two runs; {_AFRESH}")
        for file, chunk in zip(self._files(), self._manifest["chunks"], strict=True):
            if _digest_of(file) != chunk["sha256"]:
                other = _belongs_to(file)
                what = "it belongs to another run" if other not in (None, run) else "it was changed, or exchanged for another,"
                raise StorageError(
                    f"{file} is not the file that {MANIFEST} lists: {what} after it was "
                    f"written; put it back from a copy, or {_AFRESH}"
                )
            found = opened(file)
            if _lengths(found.layout) != {key: chunk[key] for key in ("rows", "listed") if key in chunk}:
                raise StorageError(f"{file} has other numbers of rows than {MANIFEST} says; {_AFRESH}")
        if self._manifest["rows"] != _total(self._manifest["chunks"])["rows"]:
            raise StorageError(
                f"{self.directory / MANIFEST} counts {self._manifest['rows']} rows, its chunks have others; {_AFRESH}"
            )

    def _layout(self) -> Layout:
        """Data type and shape of each array of the whole run."""
        total = _total(self._manifest["chunks"])
        return {name: (dtype, (total[_length(name)], *shape[1:])) for name, (dtype, shape) in self._first().items()}

    def _first(self) -> Layout:
        """Of the first chunk."""
        return opened(self._files()[0]).layout


def unfinished(directory: str | Path) -> dict[str, Any] | None:
    """The manifest in ``directory`` if it is that of a run that can be continued, by this version or the one that wrote it.

    None where there is none.

    Raises:
        StorageError: a later version wrote it, it is damaged beside chunks that nothing else lists, or it is that of a sweep.
    """
    folder = Path(directory)
    if not (folder / MANIFEST).exists():
        return None
    path = inside(folder, MANIFEST, "nsmodel")
    try:
        manifest = read_json(path)
        if not (isinstance(manifest, dict) and is_signed(manifest)):
            raise StorageError(f"{path} was changed after it was written; {_AFRESH}")
    except StorageError as error:
        if isinstance(error, LaterFormatError) or any(_CHUNK.fullmatch(file.name) for file in folder.iterdir()):
            raise
        return None
    if "design" in manifest:
        raise StorageError(f"{folder} holds a sweep; give another folder")
    refuse_other_types(manifest, UNFINISHED, path)
    return manifest if manifest["status"] in ("running", "interrupted") else None


def _run_of(checkpoint: Metadata) -> str:
    """The digest of the run whose checkpoint this is."""
    return bound_to(checkpoint.get("settings"))


def _belongs_to(path: Path) -> Any:
    """The digest of the run that a file says it belongs to; None where it says none."""
    try:
        return opened(path).metadata.get("run")
    except StorageError:
        return None


def _layout(data: Mapping[str, np.ndarray]) -> Layout:
    return {name: (array.dtype, array.shape) for name, array in data.items()}


def _digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    try:
        with path.open("rb") as stream:
            return digest_of_stream(stream)
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; put it back from a copy, or {_AFRESH}") from error
    except OSError as error:
        raise StorageError(f"{path} cannot be read ({error}); put it back from a copy, or {_AFRESH}") from error


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


def _manifest(chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata) -> dict[str, Any]:
    state = {"checkpoint": checkpoint, "metadata": metadata, "status": metadata.get("status", "running")}
    return {**STAMP, "run": _run_of(checkpoint), "chunks": chunks, **({"rows": 0} | _total(chunks)), **state}
