"""Arrays of an archive where they lie in the file, not read into memory."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from nsmodel.archive import members_in, metadata_of, read_npz, reading

_LOCAL = struct.Struct("<26xHH")  # Of a local header of a zip file: the lengths of the name and of what is beside it.


def mapped(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """(arrays, metadata) as ``archive.read_npz`` has them, the arrays read when they are used; they are not to be changed.

    On Windows they are read now: a file that is mapped could not be written again.

    Raises:
        StorageError: it is missing, damaged or foreign.
    """
    if sys.platform == "win32":
        return read_npz(path)
    arrays: dict[str, np.ndarray] = {}
    with reading(path) as archive, path.open("rb") as file:
        metadata = metadata_of(archive, path)
        for name, member in members_in(archive):
            npy.read_magic(member)
            shape, _, dtype = npy.read_array_header_1_0(member)
            entry = archive.getinfo(f"{name}.npy")
            file.seek(entry.header_offset)
            begin = entry.header_offset + _LOCAL.size + sum(_LOCAL.unpack(file.read(_LOCAL.size))) + member.tell()
            arrays[name] = np.memmap(path, dtype, "r", begin, shape) if np.prod(shape) else np.zeros(shape, dtype)
    return arrays, metadata
