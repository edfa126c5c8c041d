"""Archives of arrays (npz) with JSON metadata; equal content gives equal bytes.

An archive is a zip file that compresses nothing: ``NAME.npy`` of each array, one after the other, and ``metadata.json``. That
lists type, shape and the digests of the chunks of each array, and carries a digest of itself: see `stored`, which reads it.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from nsmodel.errors import StorageError
from nsmodel.storage import STAMP, Metadata, dumps, stream_beside, utf8

LIST = ("contact_", "piece_")  # Arrays whose names begin so are lists: their length is one of their own, not the number of rows.
METADATA = "metadata.json"
CHUNK = 1 << 22  # Bytes of an array that have one digest: what is read at least to look at one number.
KINDS = {"b": (1,), "i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (2, 4, 8)}  # Bytes of the numbers and booleans that files hold.


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Metadata) -> None:
    """Write ``arrays`` in their order, uncompressed, and ``metadata`` as JSON; ``numpy.load`` reads the file too.

    The file's own entries in the metadata are "format", "version", "arrays" and "digest".
    """
    members = members_of(arrays, path)
    with stream_beside(Path(path)) as stream:
        write_archive(stream, members, metadata)


@dataclass(frozen=True)
class Member:
    """One array to write: its data type, its shape, its bytes in C order, block after block."""

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Iterable[bytes | memoryview]


def members_of(arrays: Mapping[str, np.ndarray], path: str | Path) -> dict[str, Member]:
    """The arrays as they are written; StorageError for one that is neither numbers nor booleans."""
    members = {}
    for name, value in arrays.items():
        array = np.asarray(value, order="C")
        if array.dtype.itemsize not in KINDS.get(array.dtype.kind, ()):
            what = "holds Python objects" if array.dtype.hasobject else f"is of type {array.dtype}"
            raise StorageError(f"cannot write {path}: array '{name}' {what}; make it an array of numbers")
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        members[name] = Member(array.dtype, array.shape, [array.reshape(-1).view(np.uint8).data])
    return members


def write_archive(stream: IO[bytes], members: Mapping[str, Member], metadata: Metadata) -> None:
    """Write members one after the other, and the metadata behind them."""
    listed = []
    with zipfile.ZipFile(stream, "w") as archive:
        for name, member in members.items():
            digests = _Digests()
            with archive.open(_entry(f"{name}.npy"), "w", force_zip64=True) as file:
                descr = npy.dtype_to_descr(member.dtype)
                npy.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": member.shape})
                for block in member.blocks:
                    file.write(block)
                    digests.add(block)
            listed.append({"name": name, "type": descr, "shape": list(member.shape), "sha256": digests.all()})
        document = {**metadata, **STAMP, "arrays": listed}
        text = dumps({**document, "digest": digest_of_document(document)}, indent=1)
        archive.writestr(_entry(METADATA), utf8(text))


@dataclass
class _Digests:
    """Of the chunks of what is written, as it comes."""

    done: list[str] = field(default_factory=list)
    open: Any = field(default_factory=hashlib.sha256)
    filled: int = 0

    def add(self, block: bytes | memoryview) -> None:
        """Take up some bytes."""
        rest = memoryview(block)
        while len(rest):
            part = rest[: CHUNK - self.filled]
            self.open.update(part)
            self.filled, rest = self.filled + len(part), rest[len(part) :]
            if self.filled == CHUNK:
                self._close()

    def all(self) -> list[str]:
        """The digests, when all is written."""
        if self.filled:
            self._close()
        return self.done

    def _close(self) -> None:
        self.done.append(self.open.hexdigest()[:DIGITS])
        self.open, self.filled = hashlib.sha256(), 0


DIGITS = 32  # Of a digest: 128 bits.


def digest_of(block: bytes | memoryview) -> str:
    """The digest of a chunk."""
    return hashlib.sha256(block).hexdigest()[:DIGITS]


def digest_of_document(document: Metadata) -> str:
    """The digest of what JSON holds, however it is spaced."""
    return digest_of(utf8(dumps(document)))


def _entry(name: str) -> zipfile.ZipInfo:
    """Describe a member, with nothing of the clock or the platform."""
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.create_system, entry.external_attr = 3, 0o644 << 16
    return entry


def digest_of_stream(stream: IO[bytes]) -> str:
    """SHA-256 of all that was written to a stream, in hexadecimal."""
    stream.seek(0)
    return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore[reportArgumentType]
