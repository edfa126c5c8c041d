"""Archives of arrays (npz) with JSON metadata; equal content gives equal bytes."""

from __future__ import annotations

import hashlib
import threading
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from nsmodel.errors import StorageError
from nsmodel.storage import STAMP, Metadata, dumps, loads, refuse_later, stream_beside, utf8

# CPython's parser, which reads an array's header, may fail where two threads of a program parse at once (SystemError).
_ONE_AT_A_TIME = threading.RLock()
Layout = dict[str, tuple[np.dtype, tuple[int, ...]]]
LIST = ("contact_", "piece_")  # Arrays whose names begin so are lists: their length is one of their own, not the number of rows.
_METADATA = "metadata.json"
_BLOCK = 1 << 20


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Metadata) -> None:
    """Write ``arrays`` in their order, uncompressed, and ``metadata`` as JSON; ``numpy.load`` reads the file too.

    The file's own entries in the metadata are "format", "version" and "arrays", their names.
    """
    members = members_of(arrays, path)
    with stream_beside(Path(path)) as stream:
        write_archive(stream, members, metadata)


def read_npz(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read (arrays, metadata) as ``write_npz`` wrote them."""
    with _ONE_AT_A_TIME, reading(Path(path)) as archive:
        metadata = metadata_of(archive, path)
        return {name: _whole_array(member) for name, member in members_in(archive)}, metadata


@dataclass(frozen=True)
class Member:
    """One array to write: its data type, its shape, its bytes in C order, block after block."""

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Iterable[bytes | memoryview]


def members_of(arrays: Mapping[str, np.ndarray], path: str | Path) -> dict[str, Member]:
    """The arrays as they are written."""
    members = {}
    for name, value in arrays.items():
        array = np.asarray(value, order="C")
        if array.dtype.hasobject:
            raise StorageError(f"cannot write {path}: array '{name}' holds Python objects; make it an array of numbers")
        members[name] = Member(array.dtype, array.shape, [array.reshape(-1).view(np.uint8).data])
    return members


def write_archive(stream: IO[bytes], members: Mapping[str, Member], metadata: Metadata) -> None:
    """Write members one after the other, and the metadata behind them."""
    text = dumps({**metadata, **STAMP, "arrays": list(members)}, indent=1)
    with zipfile.ZipFile(stream, "w") as archive:
        for name, member in members.items():
            with archive.open(_entry(f"{name}.npy"), "w", force_zip64=True) as file:
                descr = npy.dtype_to_descr(member.dtype)
                npy.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": member.shape})
                for block in member.blocks:
                    file.write(block)
        archive.writestr(_entry(_METADATA), utf8(text))


def _entry(name: str) -> zipfile.ZipInfo:
    """Describe a member, with nothing of the clock or the platform."""
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.create_system, entry.external_attr = 3, 0o644 << 16
    return entry


def metadata_of(archive: zipfile.ZipFile, path: str | Path) -> dict[str, Any]:
    """The metadata without the file's own entries; the archive must hold the arrays that these name, and nothing else."""
    files = archive.namelist()
    if _METADATA not in files:
        raise StorageError(f"{path} has no {_METADATA}: nsmodel did not write it; read it with numpy.load")
    metadata = loads(archive.read(_METADATA).decode())
    if not isinstance(metadata, dict):
        raise ValueError(f"{_METADATA} is no dictionary")
    refuse_later(metadata, path)
    arrays = metadata.pop("arrays", None) if "format" in metadata else [f.removesuffix(".npy") for f in files if f != _METADATA]
    if files != [*(f"{name}.npy" for name in arrays), _METADATA]:
        raise ValueError(f"it holds {', '.join(files)}, not what was written")
    return {key: value for key, value in metadata.items() if key not in STAMP}


def _whole_array(member: IO[bytes]) -> np.ndarray:
    """The array of a member, read to its end, where its checksum is compared."""
    array = npy.read_array(member, allow_pickle=False)
    if member.read(1):
        raise ValueError("an array is longer than its header says")
    return array


def digest_of_stream(stream: IO[bytes]) -> str:
    """SHA-256 of all that was written to a stream, in hexadecimal."""
    stream.seek(0)
    return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore[reportArgumentType]


def header_of(path: Path) -> Layout:
    """Read data type and shape of each array in a chunk, not the data."""
    header = {}
    with reading(path) as archive:
        for name, member in members_in(archive):
            npy.read_magic(member)
            shape, _, dtype = npy.read_array_header_1_0(member)
            header[name] = (dtype, shape)
    return header


@contextmanager
def reading(path: Path) -> Iterator[zipfile.ZipFile]:
    """An archive that is being read; StorageError where that fails."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except StorageError:
        raise
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; check the path, or run the model again") from error
    except IsADirectoryError as error:
        raise StorageError(f"{path} is a folder; give the file in it, {path / 'trajectory.npz'}") from error
    except MemoryError as error:
        raise StorageError(f"{path} does not fit in memory ({error}); read it with numpy.load, array by array") from error
    except Exception as error:  # damaged bytes make zipfile and numpy raise nearly anything
        fault = f"{path} is not a whole npz file ({error or type(error).__name__})"
        raise StorageError(f"{fault}: it was cut short or another program wrote it; run the model again") from error


def members_in(archive: zipfile.ZipFile) -> Iterator[tuple[str, IO[bytes]]]:
    """Yield the name and the bytes of each array."""
    for name in archive.namelist():
        if name.endswith(".npy"):
            with archive.open(name) as member:
                yield name.removesuffix(".npy"), member


def blocks(files: Iterable[Path], name: str) -> Iterator[bytes]:
    """Yield the bytes of array ``name``, file after file."""
    for file in files:
        with reading(file) as archive, archive.open(f"{name}.npy") as member:
            npy.read_magic(member)
            npy.read_array_header_1_0(member)
            while block := member.read(_BLOCK):
                yield block
