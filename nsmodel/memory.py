"""How much memory this process may take."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

_CGROUP_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")  # Of a container, on Linux.


def usable_memory() -> int | None:
    """Bytes of memory of this machine, or of the container; None where the system does not say."""
    found = []
    with contextlib.suppress(OSError, ValueError):
        found.append(int(_CGROUP_LIMIT_FILE.read_text(encoding="ascii")))
    if sys.platform == "win32":
        with contextlib.suppress(OSError, AttributeError):
            found.append(_windows_memory())
    else:
        with contextlib.suppress(OSError, ValueError):
            found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min((one for one in found if one > 0), default=None)


def _windows_memory() -> int:
    import ctypes

    class MemoryStatus(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ulong), ("load", ctypes.c_ulong), *((f"of_{i}", ctypes.c_ulonglong) for i in range(7))]

    status = MemoryStatus(length=ctypes.sizeof(MemoryStatus))
    ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # pyright: ignore[reportAttributeAccessIssue]
    return int(status.of_0)


def format_bytes(size: float) -> str:
    """A number of bytes, such as "8.1 GB"."""
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            return f"{size:,.0f} {unit}" if unit == "bytes" or size >= 100 else f"{size:.2g} {unit}"
        size /= 1000
    raise AssertionError
