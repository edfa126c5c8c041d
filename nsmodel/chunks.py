"""A long run on disk in chunks, with a manifest that says what was committed."""

from __future__ import annotations

import copy
import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.archive import LIST, Layout, Member, blocks, digest_of_stream, header_of, members_of, read_npz, write_archive
from nsmodel.errors import StorageError
from nsmodel.storage import (
    FORMAT,
    STAMP,
    Metadata,
    dumps,
    loads,
    make_folder,
    read_json,
    refuse_later,
    stream_beside,
    utf8,
    write_json,
)
from nsmodel.version import VERSION

MANIFEST = "manifest.json"
_AFRESH = "remove the folder, or give another, to start afresh"
_CHUNK = re.compile(r"chunk-\d{6,}\.npz")


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
        make_folder(self.directory, f"into {directory}")

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
        path = self.directory / f"chunk-{len(chunks) + 1:06d}.npz"
        self._commit([*chunks, self._written(path, data)], checkpoint, metadata)

    def _written(self, path: Path, data: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Write a chunk; and what the manifest says of it."""
        members = members_of(data, path)
        with stream_beside(path) as stream:
            write_archive(stream, members, {})
            return {"file": path.name, **(_lengths(_layout(data)) or {}), "sha256": digest_of_stream(stream)}

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
        members = {name: Member(dtype, shape, blocks(files, name)) for name, (dtype, shape) in layout.items()}
        inside = path.resolve().parent == self.directory.resolve()
        whole = {"file": path.name if inside else str(path.resolve()), **total}
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
            self.join(self.directory / "trajectory.npz", self._manifest["metadata"])
        away = {"rows": rows, "listed": listed}
        arrays = {name: array[: len(array) - away[_length(name)]] for name, array in self.read().items()}
        metadata = {**self._manifest["metadata"], "status": "running", "message": ""}
        path = self.directory / "chunk-000001.npz"
        self._commit([self._written(path, arrays)], {**self._manifest["checkpoint"], "cut": None}, metadata)

    def discard(self) -> None:
        """Forget the run: its manifest and its chunks are removed."""
        (self.directory / MANIFEST).unlink(missing_ok=True)
        for file in self._files():
            file.unlink(missing_ok=True)
        self._manifest = _manifest([], {}, {})

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
        return header_of(self._files()[0])


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
    refuse_later(manifest, path)
    return manifest if whole and manifest["status"] in ("running", "interrupted") else None


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


def _checksum(manifest: Metadata) -> str:
    return hashlib.sha256(utf8(dumps(manifest))).hexdigest()[:16]


def _manifest(chunks: list[dict[str, Any]], checkpoint: Metadata, metadata: Metadata) -> dict[str, Any]:
    state = {"checkpoint": checkpoint, "metadata": metadata, "status": metadata.get("status", "running")}
    return {**STAMP, "chunks": chunks, **({"rows": 0} | _total(chunks)), **state}
