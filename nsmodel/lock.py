"""One run at a time in a folder: a lock file that names its holder.

The file is locked for as long as its holder lives (``flock``, on Windows ``locking``): the system frees it when that ends,
however it ends. So on one machine a file that can be locked was left behind, and is taken over, whatever number its holder had.
Of a holder on another machine nothing is known: that is for the user to judge. Where the file system knows no such locks, every
holder is one of those.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nsmodel.errors import StorageError
from nsmodel.storage import PART_PREFIX

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
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
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
