"""A long run on disk in chunks, with a manifest that says what was committed.

One run at a time in a folder: a lock file that names its holder.

The file is locked for as long as its holder lives (``flock``, on Windows ``locking``): the system frees it when that ends,
however it ends. So on one machine a file that can be locked was left behind, and is taken over, whatever number its holder had.
Of a holder on another machine nothing is known: that is for the user to judge. Where the file system knows no such locks, every
holder is one of those.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import re
import socket
import stat
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.errors import NewerFormatError, StorageError
from nsmodel.files.archive import (
    LIST_PREFIXES,
    ArchiveLayout,
    ArchiveMember,
    archive_members,
    array_blocks,
    open_archive,
    read_npz,
    stream_sha256,
    write_archive,
)
from nsmodel.files.metadata import MANIFEST_FIELDS as FIELDS
from nsmodel.files.metadata import (
    MANIFEST_FILE,
    UNFINISHED_FIELDS,
    check_field_types,
    has_valid_checksum,
    read_manifest,
    settings_digest,
    with_checksum,
)
from nsmodel.files.storage import (
    FORMAT_STAMP,
    PART_PREFIX,
    Metadata,
    atomic_stream,
    dumps,
    loads,
    make_folder,
    path_inside,
    read_json,
    write_json,
)

JOINED_FILE = "trajectory.npz"
_START_AFRESH_HINT = "remove the folder, or give another, to start afresh"
_CHUNK_NAME_PATTERN = re.compile(r"chunk-\d{6,}\.npz")


class ChunkStore:
    """A long run on disk, in constant memory: ``chunk-000001.npz``, ... and a ``manifest.json`` that lists them.

    ``ChunkStore(directory)`` starts afresh: its first ``append`` replaces the run found there. ``ChunkStore.open``
    goes on with that run. The manifest is written last: killed at any moment, the directory holds the state after some
    whole ``append`` or ``join``. Chunks that the manifest does not list are ignored, and overwritten. It has a hash of each,
    and each has the digest of its run (`files.metadata.bound_to`): what was changed or exchanged since, or belongs to another
    run, is found before anything is added. No file is read, written or removed but in the folder, by its own name. A store is
    for one program at a time (see `lock`).
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
        files, total = self._chunk_paths(), _total_lengths(self._manifest["chunks"])
        members = {
            name: ArchiveMember(dtype, (total[_length_key(name)], *shape[1:]), array_blocks(files, name))
            for name, (dtype, shape) in self._first_layout().items()
        }
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
        self._replace_chunks(arrays, {**self._manifest["checkpoint"], "cut": None}, metadata)

    def rewrite(self, arrays: Mapping[str, np.ndarray], metadata: Metadata) -> None:
        """Write a whole run anew, with other columns."""
        self._replace_chunks(arrays, self._manifest["checkpoint"], metadata)
        self.join(metadata)

    def drop(self, name: str) -> None:
        """Take an array away that the rows to come do not have."""
        if name in self._first_layout():
            arrays = {own: array for own, array in self.read().items() if own != name}
            self._replace_chunks(arrays, self._manifest["checkpoint"], self._manifest["metadata"])

    def _replace_chunks(self, arrays: Mapping[str, np.ndarray], checkpoint: Metadata, metadata: Metadata) -> None:
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
                f"{by} lists the file {chunk['file']!r:.80}, which is not a chunk of a run: it was changed; {_START_AFRESH_HINT}"
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


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
try:
    import msvcrt
except ImportError:  # all others
    msvcrt = None

LOCK_FILE = "run.lock"
LOCKED_BYTE = (
    1 << 30
)  # The byte of the file that is locked on Windows: nobody else may read it, and what is written lies before it.
_OPEN_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)  # Nor waited for, where it is a pipe.
_held_folders: set[tuple[str, int]] = set()  # Folders and the threads that hold them.
_lock_descriptors: set[int] = set()  # Of the lock files that this process holds.


def _release_after_fork() -> None:
    """In a process that was forked: its parent holds the folders, and they are free when that ends."""
    for descriptor in _lock_descriptors:
        os.close(descriptor)
    _lock_descriptors.clear()
    _held_folders.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_release_after_fork)


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Hold a folder, which is made if need be, and removed if nothing was written into it; a thread may hold one twice.

    Raises:
        StorageError: another run holds it, or it cannot be written.
    """
    key = (os.path.realpath(folder), threading.get_ident())
    if key in _held_folders:
        yield
        return
    path, new = folder / LOCK_FILE, not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _acquire_lock(path)
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(f"cannot write into {folder}: {error}; take a folder that is writable") from error
    _held_folders.add(key)
    _lock_descriptors.add(descriptor)
    try:
        yield
    finally:
        _held_folders.discard(key)
        _lock_descriptors.discard(descriptor)
        _release_lock(path, descriptor)
        if new:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


def _release_lock(path: Path, descriptor: int) -> None:
    """Remove the lock file and let it go; where files that are open cannot be removed, nobody removes another's."""
    if fcntl is None:
        os.close(descriptor)
    with contextlib.suppress(OSError):
        path.unlink()
    if fcntl is not None:
        os.close(descriptor)


def _acquire_lock(path: Path) -> int:
    """Return the descriptor of the lock file, which is ours."""
    while True:
        try:
            descriptor, new = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666), True
        except FileExistsError:
            try:
                descriptor, new = os.open(path, os.O_RDWR | _OPEN_FLAGS), False
            except FileNotFoundError:
                continue
            except OSError as error:
                if path.is_symlink():
                    raise _not_a_lock_error(path) from error
                raise
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise _not_a_lock_error(path)
        free = None
        try:
            free, holder = _try_lock(descriptor), _read_holder(descriptor)
            if not (new if free is None else free and not _is_on_other_machine(holder)):
                raise _in_use_error(path, holder, free is False)
            if free is None or _is_still_at_path(path, descriptor):  # its last holder may have removed it meanwhile
                if not new:
                    _remove_unfinished_files(path.parent)
                os.truncate(descriptor, 0)
                os.lseek(descriptor, 0, os.SEEK_SET)
                os.write(descriptor, json.dumps(_own_identity()).encode())
                return descriptor
        except BaseException:
            os.close(descriptor)
            if new and free is not False:
                path.unlink(missing_ok=True)
            raise
        os.close(descriptor)


def _not_a_lock_error(path: Path) -> StorageError:
    return StorageError(f"{path} is a link, or no file, and so not the lock of a run: remove it")


def _try_lock(descriptor: int) -> bool | None:
    """Lock a file: False where another holds it, None where the file system cannot."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif msvcrt is not None:
            os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # pyrefly: ignore[missing-attribute]
        else:
            return None
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def _own_identity() -> dict[str, Any]:
    return {"host": socket.gethostname(), "pid": os.getpid(), "boot": _boot_id()}


def _boot_id() -> str:
    """What names the running system: containers on one machine have names of their own, and share this. "" where unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _read_holder(descriptor: int) -> dict[str, Any] | None:
    """Who wrote the file; None where it is new, or was cut short."""
    try:
        os.lseek(descriptor, 0, os.SEEK_SET)
        found = json.loads(os.read(descriptor, 4096))
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _is_on_other_machine(holder: dict[str, Any] | None) -> bool:
    """Whether the holder was on another machine, whose locks may not be seen here."""
    mine = _own_identity()
    return holder is not None and holder.get("host") != mine["host"] and (not mine["boot"] or holder.get("boot") != mine["boot"])


def _is_still_at_path(path: Path, descriptor: int) -> bool:
    """Whether the open file is still the one at the path; where files that are open cannot be removed, it is."""
    if fcntl is None:
        return True
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _remove_unfinished_files(folder: Path) -> None:
    """Remove what a killed holder had half written."""
    for part in folder.glob(f"{PART_PREFIX}*"):
        part.unlink(missing_ok=True)


def _in_use_error(path: Path, holder: dict[str, Any] | None, certain: bool) -> StorageError:
    who = "" if holder is None else f", process {holder.get('pid')} on {holder.get('host')}"
    fault, wait = f"{path.parent} is in use by another run{who}", "wait for its end, or give another folder"
    if certain:
        return StorageError(f"{fault}; {wait}")
    return StorageError(f"{fault}, as far as can be told from here; {wait}; if that run has ended, delete {path}")
