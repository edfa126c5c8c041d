"""Archives of arrays (npz) with JSON metadata; equal content gives equal bytes.

An archive is a zip file that compresses nothing: ``NAME.npy`` of each array, one after the other, and ``metadata.json``. That
lists type, shape and the digests of the chunks of each array, and carries a digest of itself: see `stored`, which reads it.

Arrays that come from a disk: the one reader of archives, which trusts nothing that it reads.

Before a value is used the reader has seen that the archive is as `archive` writes it (members one behind the other, none
compressed, none twice), that each array is of numbers or booleans, in little-endian and C order, and fills its member, and that
its bytes have the digests that the metadata lists, which has a digest of its own. Arrays that are mapped are compared chunk by
chunk, when their values are asked for. Files of formats 1 and 2 have no digests: of them the checksums of the zip file are
compared, and a warning says that they are not verified.
"""

from __future__ import annotations

import hashlib
import re
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from nsmodel.errors import StorageError, UnverifiedWarning
from nsmodel.files.storage import (
    FORMAT_STAMP,
    Metadata,
    atomic_stream,
    check_regular_file,
    dumps,
    encode_utf8,
    file_format,
    loads,
)

LIST_PREFIXES = (
    "contact_",
    "piece_",
)  # Arrays whose names begin so are lists: their length is one of their own, not the number of rows.
METADATA_MEMBER = "metadata.json"
DIGEST_CHUNK_BYTES = 1 << 22  # Bytes of an array that have one digest: what is read at least to look at one number, 4 MB.
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


DIGEST_DIGITS = 32  # Of a digest, the first half of SHA-256: 128 bits, which no two chunks share by chance.


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
    return hashlib.file_digest(stream, "sha256").hexdigest()  # pyrefly: ignore[no-matching-overload]


FIRST_DIGEST_FORMAT = 3  # The first format with digests.
RERUN_HINT = "run the model again, or put back a copy"
ArchiveLayout = dict[str, tuple[np.dtype, tuple[int, ...]]]
_LOCAL_HEADER = struct.Struct(
    "<4s22xHH"
)  # Of a local header of a zip file: its mark, the lengths of the name and of what is beside it.
_NPY_MAGIC = b"\x93NUMPY\x01\x00"
_NPY_HEADER = re.compile(
    rb"\{'descr': '([<|>=]?)([a-zA-Z])(\d{1,9})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,18}, ?)*(?:\d{1,18})?)\), \} *\n"
)
_MAX_AXES = 32  # Of an array, in any NumPy: 32 before 2.0, 64 since.


@dataclass(frozen=True)
class ArchivedArray:
    """An array in a file.

    Attributes:
        path: of the file; name: of the array.
        dtype, shape: as its header and the metadata say.
        begin: its first byte.
        digests: of its chunks; None in files of older formats.
        crc: of its header, and of header and bytes, as the zip file has it.
    """

    path: Path
    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    begin: int
    digests: tuple[str, ...] | None
    crc: tuple[int, int]

    @property
    def size(self) -> int:
        """The number of bytes of the array."""
        return prod(self.shape) * self.dtype.itemsize

    def blocks(self, stream: IO[bytes]) -> Iterator[bytes]:
        """Its bytes, chunk after chunk, each verified; of older formats verified at the end."""
        stream.seek(self.begin)
        found = self.crc[0]
        for k, at in enumerate(range(0, self.size, DIGEST_CHUNK_BYTES)):
            block = stream.read(min(DIGEST_CHUNK_BYTES, self.size - at))
            if self.digests is None:
                found = zlib.crc32(block, found)
            else:
                self.check_chunk(k, block)
            yield block
        if self.digests is None and found != self.crc[1]:
            raise self._changed_error("")

    def check_chunk(self, k: int, block: Any) -> None:
        """Raise StorageError unless this is chunk k."""
        if self.digests is not None and chunk_digest(block) != self.digests[k]:
            raise self._changed_error(f", bytes {k * DIGEST_CHUNK_BYTES} to {k * DIGEST_CHUNK_BYTES + len(block)}")

    def check_whole(self, raw: Any) -> None:
        """Raise StorageError unless these are its bytes, of a file that has no digests."""
        if zlib.crc32(raw, self.crc[0]) != self.crc[1]:
            raise self._changed_error("")

    def read(self, stream: IO[bytes]) -> np.ndarray:
        """The array, in memory."""
        raw, at = np.empty(self.size, np.uint8), 0
        for block in self.blocks(stream):
            raw[at : at + len(block)] = np.frombuffer(block, np.uint8)
            at += len(block)
        return self.made_of(raw)

    def made_of(self, raw: np.ndarray) -> np.ndarray:
        """The array that has these bytes."""
        array = raw.view(self.dtype).reshape(self.shape) if raw.size else np.zeros(self.shape, self.dtype)
        if self.dtype.kind == "U" and (raw.view("<u4") > sys.maxunicode).any():
            raise self._changed_error(", which holds no text,")
        return array

    def _changed_error(self, where: str) -> StorageError:
        return StorageError(f"{self.path}: array '{self.name}'{where} was changed after it was written; {RERUN_HINT}")


@dataclass(frozen=True)
class Archive:
    """What a file says of itself: its format, its metadata without the file's own entries, its arrays where they lie."""

    path: Path
    format: int
    metadata: dict[str, Any]
    arrays: dict[str, ArchivedArray]

    @property
    def layout(self) -> ArchiveLayout:
        """Data type and shape of each array."""
        return {name: (one.dtype, one.shape) for name, one in self.arrays.items()}

    @property
    def has_digests(self) -> bool:
        """Whether it has digests."""
        return self.format >= FIRST_DIGEST_FORMAT

    def warn_unverified(self, stacklevel: int) -> None:
        """Say where it cannot be verified."""
        if not self.has_digests:
            text = f"{self.path} is of format {self.format}, which has no digests: what it holds is read, not verified"
            warnings.warn(text, UnverifiedWarning, stacklevel + 1)


def open_archive(path: str | Path) -> Archive:
    """Read what an archive says of itself, and no array.

    Raises:
        StorageError: it is missing, damaged, foreign, or of a later format.
    """
    with _open_for_reading(Path(path)) as stream:
        return _read_archive_header(Path(path), stream)


def read_npz(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read (arrays, metadata) as ``files.archive.write_npz`` wrote them; StorageError as of ``opened``."""
    archive, arrays = read_archive(path)
    return arrays, archive.metadata


def read_archive(path: str | Path) -> tuple[Archive, dict[str, np.ndarray]]:
    """Read an archive, and its arrays into memory; StorageError as of ``opened``."""
    with _open_for_reading(Path(path)) as stream:
        archive = _read_archive_header(Path(path), stream)
        return archive, {name: one.read(stream) for name, one in archive.arrays.items()}


def array_blocks(files: list[Path], name: str) -> Iterator[bytes]:
    """Yield the bytes of array ``name``, verified, file after file."""
    for path in files:
        with _open_for_reading(path) as stream:
            yield from _read_archive_header(path, stream).arrays[name].blocks(stream)


class ArrayPartOnDisk:
    """A part of an array in a file: compared with its digests, and read, when its values are asked for."""

    def __init__(self, view: np.ndarray, check: Callable[[int, int], None], begin: int) -> None:
        self._view, self._check, self._begin = view, check, begin
        self.shape, self.dtype, self.ndim = view.shape, view.dtype, view.ndim

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the values, not where they lie."""
        return np.array, (np.array(self.values),)

    def reshape(self, *shape: Any) -> ArrayPartOnDisk:
        """The same in another shape."""
        return ArrayPartOnDisk(self._view.reshape(*shape), self._check, self._begin)

    def take(self, index: int, axis: int) -> ArrayPartOnDisk:
        """The part at one index of an axis."""
        return ArrayPartOnDisk(self._view[(*(slice(None),) * axis, index, ...)], self._check, self._begin)

    @property
    def values(self) -> np.ndarray:
        """The values, verified; not to be written to. StorageError where they were changed."""
        for low, high in _address_spans(self._view):
            self._check(low - self._begin, high - self._begin)
        return self._view


def _address_spans(view: np.ndarray) -> Iterator[tuple[int, int]]:
    """The addresses between which a view lies, in parts where it leaves out whole chunks."""
    if not view.size:
        return
    axis = max(range(view.ndim), key=lambda k: view.strides[k] if view.shape[k] > 1 else 0, default=None)
    if axis is None or view.strides[axis] <= DIGEST_CHUNK_BYTES or view.shape[axis] == 1:
        yield np.lib.array_utils.byte_bounds(view)
        return
    for k in range(view.shape[axis]):
        yield from _address_spans(view[(*(slice(None),) * axis, slice(k, k + 1))])


class StoredArrays(Mapping[str, np.ndarray]):
    """The arrays of a file, mapped: an array is verified when it is asked for, a part of one (see `part`) when its values are."""

    def __init__(self, parts: Mapping[str, ArrayPartOnDisk], checks: Mapping[str, Callable[[np.ndarray], None]]) -> None:
        """``refuse``: {name: what raises StorageError for values that its array cannot have}."""
        self._parts, self._checks = parts, dict(checks)

    @classmethod
    def of(cls, archive: Archive, stream: IO[bytes]) -> StoredArrays:
        """Those of an archive that is open."""
        raw = np.memmap(stream, np.uint8, "r")
        parts = {name: _map_array(one, raw[one.begin : one.begin + one.size]) for name, one in archive.arrays.items()}
        return cls(parts, {})

    def only(self, names: Iterable[str], checks: Mapping[str, Callable[[np.ndarray], None]]) -> StoredArrays:
        """The arrays of these names, with checks of their own."""
        return StoredArrays({name: self._parts[name] for name in names}, checks)

    def part(self, name: str) -> ArrayPartOnDisk:
        """An array of which parts may be taken before values are asked for."""
        return self._parts[name]

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an array, verified; StorageError where it was changed."""
        values = self._parts[name].values
        if name in self._checks:
            self._checks[name](values)
            self._checks.pop(name, None)
        return values

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the values, not where they lie."""
        return dict, ({name: np.array(values) for name, values in self.items()},)

    def __contains__(self, name: object) -> bool:
        """Whether there is such an array; it is not read."""
        return name in self._parts

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)


def _map_array(one: ArchivedArray, raw: np.ndarray) -> ArrayPartOnDisk:
    known = bytearray(len(one.digests) if one.digests is not None else 1)

    def check_bytes(low: int, high: int) -> None:
        if one.digests is None:
            if not known[0]:
                one.check_whole(raw)
                known[0] = 1
            return
        for k in range(low // DIGEST_CHUNK_BYTES, -(-high // DIGEST_CHUNK_BYTES)):
            if not known[k]:
                one.check_chunk(k, raw[k * DIGEST_CHUNK_BYTES : (k + 1) * DIGEST_CHUNK_BYTES])
                known[k] = 1

    return ArrayPartOnDisk(one.made_of(raw), check_bytes, np.lib.array_utils.byte_bounds(raw)[0])


def map_archive(path: Path) -> tuple[Archive, Mapping[str, np.ndarray]]:
    """An archive and its arrays, which are read when they are used and are not to be changed; StorageError as of ``opened``.

    On Windows they are read now: a file that is mapped could not be written again.
    """
    if sys.platform == "win32":
        return read_archive(path)
    with _open_for_reading(path) as stream:
        archive = _read_archive_header(path, stream)
        return archive, StoredArrays.of(archive, stream)


@contextmanager
def _open_for_reading(path: Path) -> Iterator[IO[bytes]]:
    """A file that is being read; StorageError where that fails."""
    try:
        if path.is_dir():
            raise IsADirectoryError
        check_regular_file(path)
        with path.open("rb") as stream:
            yield stream
    except StorageError:
        raise
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; check the path, or run the model again") from error
    except IsADirectoryError as error:
        raise StorageError(f"{path} is a folder; give the file in it, {path / 'trajectory.npz'}") from error
    except MemoryError as error:
        raise StorageError(f"{path} does not fit in memory ({error}); read it with numpy.load, array by array") from error
    except Exception as error:  # damaged bytes make zipfile and json raise nearly anything
        fault = f"{path} is not a whole npz file ({error or type(error).__name__})"
        raise StorageError(f"{fault}: it was cut short, changed, or another program wrote it; {RERUN_HINT}") from error


def _read_archive_header(path: Path, stream: IO[bytes]) -> Archive:
    """What an archive says of itself, as far as it is true."""
    places = _member_places(stream)
    if METADATA_MEMBER not in places:
        raise StorageError(f"{path} has no {METADATA_MEMBER}: nsmodel did not write it; read it with numpy.load")
    document = _read_metadata(stream, *places.pop(METADATA_MEMBER))
    number = file_format(document, path)
    if number == 1 and {"version", "arrays", "digest"} & document.keys():
        raise ValueError(f"{METADATA_MEMBER} does not say its format")
    if number >= FIRST_DIGEST_FORMAT:
        _check_metadata_digest(path, document)
    listed: Any = document.pop("arrays", None) if "format" in document else [name.removesuffix(".npy") for name in places]
    described = listed if number >= FIRST_DIGEST_FORMAT else [{"name": name} for name in listed]
    if list(places) != [f"{one['name']}.npy" for one in described]:
        raise ValueError(f"it holds {', '.join([*places, METADATA_MEMBER])}, not what was written")
    arrays = {
        one["name"]: _read_array_header(path, stream, one, *place) for one, place in zip(described, places.values(), strict=True)
    }
    return Archive(path, number, {key: value for key, value in document.items() if key not in FORMAT_STAMP}, arrays)


def _member_places(stream: IO[bytes]) -> dict[str, tuple[int, int, int]]:
    """{name of a member: (its first byte, its length, its checksum)}, of members that lie one behind the other, as they are."""
    found: dict[str, tuple[int, int, int]] = {}
    with zipfile.ZipFile(stream) as archive:
        free = 0
        for entry in archive.infolist():
            if entry.filename in found:
                raise ValueError(f"it holds {entry.filename} twice")
            if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 or entry.file_size != entry.compress_size:
                raise ValueError(f"its member {entry.filename} is compressed or encrypted")
            stream.seek(entry.header_offset)
            mark, *lengths = _LOCAL_HEADER.unpack(stream.read(_LOCAL_HEADER.size))
            begin = entry.header_offset + _LOCAL_HEADER.size + sum(lengths)
            if mark != b"PK\3\4" or entry.header_offset < free or begin + entry.file_size > archive.start_dir:
                raise ValueError(f"its member {entry.filename} is not at the place that the file gives")
            free = begin + entry.file_size
            found[entry.filename] = begin, entry.file_size, entry.CRC
    return found


def _read_metadata(stream: IO[bytes], begin: int, size: int, crc: int) -> dict[str, Any]:
    """The metadata of a file, whose checksum is verified."""
    stream.seek(begin)
    text = stream.read(size)
    if zlib.crc32(text) != crc:
        raise ValueError(f"{METADATA_MEMBER} was changed")
    document = loads(text.decode())
    if not isinstance(document, dict):
        raise ValueError(f"{METADATA_MEMBER} is not a dictionary")
    return document


def _check_metadata_digest(path: Path, document: dict[str, Any]) -> None:
    digest = document.pop("digest", None)
    if digest != document_digest(document):
        what = "has no digest, as files of its format have" if digest is None else "has not the digest that it says"
        raise StorageError(f"{path}: {METADATA_MEMBER} {what}: it was changed after it was written; {RERUN_HINT}")


def _read_array_header(path: Path, stream: IO[bytes], one: dict[str, Any], begin: int, size: int, crc: int) -> ArchivedArray:
    """An array: its header, which must say what the metadata say, and which leaves the bytes that type and shape take."""
    name = one["name"]
    stream.seek(begin)
    head = stream.read(len(_NPY_MAGIC) + 2)
    head += stream.read(int.from_bytes(head[len(_NPY_MAGIC) :], "little"))
    said = _NPY_HEADER.fullmatch(head[len(_NPY_MAGIC) + 2 :])
    if not head.startswith(_NPY_MAGIC) or said is None:
        raise ValueError(f"array '{name}' has no header of one type and one shape")
    order, kind, bytes_each, fortran, sizes = (part.decode() for part in said.groups())
    texts = kind == "U" and one.keys() == {"name"}  # Labels of older sweeps.
    if int(bytes_each) not in DTYPE_ITEMSIZES.get(kind, ()) and not (texts and 0 < int(bytes_each) < size):
        raise ValueError(f"array '{name}' is of type {order}{kind}{bytes_each}; files hold numbers and booleans")
    if order != ("|" if (kind, bytes_each) in (("b", "1"), ("i", "1"), ("u", "1")) else "<"):
        raise ValueError(f"array '{name}' is of type {order}{kind}{bytes_each}, big-endian; expected little-endian, <")
    if fortran == "True":
        raise ValueError(f"array '{name}' is in Fortran order; expected C order")
    dtype, shape = np.dtype(f"{order}{kind}{bytes_each}"), tuple(int(one) for one in sizes.replace(",", " ").split())
    if len(shape) > _MAX_AXES or prod(max(one, 1) for one in shape) * dtype.itemsize >= 1 << 62:
        raise ValueError(f"array '{name}' has shape {shape}")
    if prod(shape) * dtype.itemsize != size - len(head):
        raise ValueError(f"array '{name}' of type {dtype} and shape {shape} has {size - len(head)} bytes")
    digests = None if one.keys() == {"name"} else tuple(map(str, one["sha256"]))
    if digests is not None:
        if (one["type"], one["shape"]) != (dtype.str, list(shape)):
            raise ValueError(f"array '{name}' is of type {dtype.str} and shape {shape}, not {one['type']} and {one['shape']}")
        if len(digests) != -(-(size - len(head)) // DIGEST_CHUNK_BYTES):
            raise ValueError(f"array '{name}' has {len(digests)} digests")
    return ArchivedArray(path, name, dtype, shape, begin + len(head), digests, (zlib.crc32(head), crc))
