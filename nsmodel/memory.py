"""How much memory this process may take."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

_GROUP = Path("/sys/fs/cgroup/memory.max")  # Of a container, on Linux.


def available() -> int | None:
    """Bytes of memory of this machine, or of the container; None where the system does not say."""
    found = []
    with contextlib.suppress(OSError, ValueError):
        found.append(int(_GROUP.read_text(encoding="ascii")))
    if sys.platform == "win32":
        with contextlib.suppress(OSError, AttributeError):
            found.append(_of_windows())
    else:
        with contextlib.suppress(OSError, ValueError):
            found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min((one for one in found if one > 0), default=None)


def _of_windows() -> int:
    import ctypes

    class Status(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ulong), ("load", ctypes.c_ulong), *((f"of_{i}", ctypes.c_ulonglong) for i in range(7))]

    status = Status(length=ctypes.sizeof(Status))
    ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # pyright: ignore[reportAttributeAccessIssue]
    return int(status.of_0)


def in_words(size: float) -> str:
    """A number of bytes, such as "8.1 GB"."""
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            return f"{size:,.0f} {unit}" if unit == "bytes" or size >= 100 else f"{size:.2g} {unit}"
        size /= 1000
    raise AssertionError
