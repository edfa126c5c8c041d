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
from nsmodel.storage import FORMAT_STAMP, Metadata, atomic_stream, dumps, encode_utf8

LIST_PREFIXES = (
    "contact_",
    "piece_",
)  # Arrays whose names begin so are lists: their length is one of their own, not the number of rows.
METADATA_MEMBER = "metadata.json"
DIGEST_CHUNK_BYTES = 1 << 22  # Bytes of an array that have one digest: what is read at least to look at one number.
DTYPE_ITEMSIZES = {
    "b": (1,),
    "i": (1, 2, 4, 8),
    "u": (1, 2, 4, 8),
    "f": (2, 4, 8),
}  # Bytes of the numbers and booleans that files hold.


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Metadata) -> None:
    """Write ``arrays`` in their order, uncompressed, and ``metadata`` as JSON; ``numpy.load`` reads the file too.

    The file's own entries in the metadata are "format", "version", "arrays" and "digest".
    """
    members = archive_members(arrays, path)
    with atomic_stream(Path(path)) as stream:
        write_archive(stream, members, metadata)


@dataclass(frozen=True)
class ArchiveMember:
    """One array to write: its data type, its shape, its bytes in C order, block after block."""

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Iterable[bytes | memoryview]


def archive_members(arrays: Mapping[str, np.ndarray], path: str | Path) -> dict[str, ArchiveMember]:
    """The arrays as they are written; StorageError for one that is neither numbers nor booleans."""
    members = {}
    for name, value in arrays.items():
        array = np.asarray(value, order="C")
        if array.dtype.itemsize not in DTYPE_ITEMSIZES.get(array.dtype.kind, ()):
            what = "holds Python objects" if array.dtype.hasobject else f"is of type {array.dtype}"
            raise StorageError(f"cannot write {path}: array '{name}' {what}; make it an array of numbers")
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        members[name] = ArchiveMember(array.dtype, array.shape, [array.reshape(-1).view(np.uint8).data])
    return members


def write_archive(stream: IO[bytes], members: Mapping[str, ArchiveMember], metadata: Metadata) -> None:
    """Write members one after the other, and the metadata behind them."""
    listed = []
    with zipfile.ZipFile(stream, "w") as archive:
        for name, member in members.items():
            digests = _ChunkDigests()
            with archive.open(_zip_entry(f"{name}.npy"), "w", force_zip64=True) as file:
                descr = npy.dtype_to_descr(member.dtype)
                npy.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": member.shape})
                for block in member.blocks:
                    file.write(block)
                    digests.add(block)
            listed.append({"name": name, "type": descr, "shape": list(member.shape), "sha256": digests.all()})
        document = {**metadata, **FORMAT_STAMP, "arrays": listed}
        text = dumps({**document, "digest": document_digest(document)}, indent=1)
        archive.writestr(_zip_entry(METADATA_MEMBER), encode_utf8(text))


@dataclass
class _ChunkDigests:
    """Of the chunks of what is written, as it comes."""

    done: list[str] = field(default_factory=list)
    open: Any = field(default_factory=hashlib.sha256)
    filled: int = 0

    def add(self, block: bytes | memoryview) -> None:
        """Take up some bytes."""
        rest = memoryview(block)
        while len(rest):
            part = rest[: DIGEST_CHUNK_BYTES - self.filled]
            self.open.update(part)
            self.filled, rest = self.filled + len(part), rest[len(part) :]
            if self.filled == DIGEST_CHUNK_BYTES:
                self._close_chunk()

    def all(self) -> list[str]:
        """The digests, when all is written."""
        if self.filled:
            self._close_chunk()
        return self.done

    def _close_chunk(self) -> None:
        self.done.append(self.open.hexdigest()[:DIGEST_DIGITS])
        self.open, self.filled = hashlib.sha256(), 0


DIGEST_DIGITS = 32  # Of a digest: 128 bits.


def chunk_digest(block: bytes | memoryview) -> str:
    """The digest of a chunk."""
    return hashlib.sha256(block).hexdigest()[:DIGEST_DIGITS]


def document_digest(document: Metadata) -> str:
    """The digest of what JSON holds, however it is spaced."""
    return chunk_digest(encode_utf8(dumps(document)))


def _zip_entry(name: str) -> zipfile.ZipInfo:
    """Describe a member, with nothing of the clock or the platform."""
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.create_system, entry.external_attr = 3, 0o644 << 16
    return entry


def stream_sha256(stream: IO[bytes]) -> str:
    """SHA-256 of all that was written to a stream, in hexadecimal."""
    stream.seek(0)
    return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore[reportArgumentType]
