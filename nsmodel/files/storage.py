"""Result files: JSON, CSV and text, and what all files have in common.

Every file is written beside its target, synced and renamed: a reader finds the old file or the new one, never half a
file. Equal content gives equal bytes. Each reader and writer raises StorageError, naming the file and what to do.

Files carry FORMAT_STAMP. One without it is of format 1 (nsmodel 0.1); one of a later format is refused. Of format 3 on they carry
digests of all that they hold, see `archive` and `manifest`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import secrets
import stat
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from nsmodel.errors import NewerFormatError, StorageError
from nsmodel.version import VERSION

Metadata = Mapping[str, Any]

FILE_FORMAT = 3  # Rises with every change of what files hold.
FORMAT_STAMP = {"format": FILE_FORMAT, "version": VERSION}
MAX_RENAME_TRIES = 50  # So often a file is given its name while somebody reads the one that had it, for a second: 0.02 s apart.
PART_PREFIX = ".part-"  # Names of files not yet whole begin so.
_NON_FINITE = re.compile(r"\\*(nan|inf|-inf)")


def dumps(data: Any, indent: int | None = None) -> str:
    """JSON text of ``data``: keys sorted, floats exact, NaN and infinities as the strings "nan", "inf", "-inf".

    Tuples and NumPy arrays become lists. A string that reads like one of those three gets a backslash in front, so that
    ``loads`` gives back what went in.
    """
    return json.dumps(_encode_json(data, "data"), sort_keys=True, ensure_ascii=False, allow_nan=False, indent=indent)


def loads(text: str) -> Any:
    """Inverse of ``dumps``; ValueError where ``text`` is not JSON."""
    return _decode_json(json.loads(text, parse_constant=_reject_constant))


def _reject_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")


def write_json(path: str | Path, data: Any) -> None:
    """Write ``data`` as ``dumps`` spells it, indented."""
    write_text(path, dumps(data, indent=1))


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` and a line end."""
    with atomic_stream(Path(path)) as stream:
        stream.write(encode_utf8(f"{text}\n"))


def read_json(path: str | Path) -> Any:
    """Read what ``write_json`` wrote."""
    try:
        check_regular_file(Path(path))
        data = loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StorageError(f"{path} does not exist; check the path") from error
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{path} is not a readable JSON file ({error}); write it again") from error
    if isinstance(data, dict):
        file_format(data, path)
    return data


def write_csv(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write 1-D ``columns`` of one length under a header line; floats in the shortest form that reads back exactly."""
    data = {name: np.asarray(column) for name, column in columns.items()}
    if len({column.shape for column in data.values()}) != 1 or any(column.ndim != 1 for column in data.values()):
        shapes = ", ".join(f"{name} {column.shape}" for name, column in data.items()) or "no column"
        raise StorageError(f"cannot write {path}: it needs 1-D columns of one length, got {shapes}")
    rows = len(next(iter(data.values())))
    with atomic_stream(Path(path)) as stream:
        stream.write(_csv_lines([list(data)]))
        for start in range(0, rows, 4096):
            block = [column[start : start + 4096].tolist() for column in data.values()]
            stream.write(_csv_lines(zip(*block, strict=True)))


def check_writable(path: str | Path) -> None:
    """Make the folder of a file; StorageError where it cannot be written: now, and not when hours of work are to be saved."""
    make_folder(Path(path).parent, path)


def make_folder(folder: Path, what: Any) -> None:
    """Make the folder that ``what`` is to be written into, likewise."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {what}: {error}; take a folder that is writable") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StorageError(f"cannot write {what}: no permission; take a folder that is writable")


def file_format(data: Metadata, path: str | Path) -> int:
    """The format of a file, 1 to FORMAT; StorageError where it is none, or one that this version does not know."""
    number = data.get("format", 1)
    if type(number) is not int or number < 1:
        raise StorageError(f"{path}: format is {number!r:.40}; expected a whole number, 1 to {FILE_FORMAT}: it was changed")
    if number > FILE_FORMAT:
        by = f"nsmodel {data['version']}" if "version" in data else "a later nsmodel"
        raise NewerFormatError(
            f"{path} is of format {number}, written by {by}; nsmodel {VERSION} knows formats up to {FILE_FORMAT}: read it with "
            f"{by}"
        )
    return number


def check_regular_file(path: Path) -> None:
    """Raise OSError for a pipe, a socket or a device, which would be waited for."""
    if stat.S_IFMT(path.stat().st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
        raise OSError("it is not a file")


def path_inside(folder: Path, name: str, by: str) -> Path:
    """The path of a file that is named ``by`` a file in a folder; StorageError unless it is a plain name, and no link."""
    if name in ("", ".", "..") or Path(name).name != name or set(name) & set("/\\:\0"):
        raise StorageError(f"{by} names the file {name!r:.80}; expected a plain name, of a file in {folder}: it was changed")
    path = folder / name
    if path.is_symlink():
        raise StorageError(f"{path} is a link, which is not allowed in a folder of results: put the file itself in its place")
    return path


@contextmanager
def replace_atomically(path: Path) -> Iterator[Path]:
    """Give a path to write to that becomes ``path``; after an error nothing remains, and an OSError is a StorageError.

    Several programs may write one file: each has its own beside it, the last one stays. A pipe or a device is written itself.
    """
    part = path.with_name(f"{PART_PREFIX}{secrets.token_hex(4)}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not (path.is_file() or path.is_dir()):
            yield path
            return
        try:
            yield part
            _rename_into_place(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error}; take a folder that is writable and has room") from error


def _rename_into_place(part: Path, path: Path) -> None:
    """Give the whole file its name; where files that are open keep theirs (Windows), wait a moment for who reads the old one."""
    for _ in range(MAX_RENAME_TRIES if sys.platform == "win32" else 0):
        try:
            part.replace(path)
            return
        except PermissionError:
            time.sleep(0.02)
    part.replace(path)


@contextmanager
def atomic_stream(path: Path) -> Iterator[IO[bytes]]:
    """Give a stream that becomes the file ``path`` once all is written and synced."""
    with replace_atomically(path) as part, part.open("wb" if part == path else "xb+") as stream:
        yield stream
        stream.flush()
        if part != path:
            os.fsync(stream.fileno())


def _csv_lines(rows: Iterable[Iterable[Any]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return encode_utf8(text.getvalue())


def encode_utf8(text: str) -> bytes:
    """Text as UTF-8; what has none, such as a file's name in another encoding, is escaped as JSON does it."""
    return text.encode(errors="backslashreplace")


def _encode_json(value: Any, where: str) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise StorageError(f"{where} has the key {key!r}; JSON keys are strings: use {str(key)!r}")
        return {str(key): _encode_json(entry, f"{where}[{key!r}]") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_encode_json(entry, f"{where}[{index}]") for index, entry in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    if isinstance(value, str):
        return f"\\{value}" if _NON_FINITE.fullmatch(value) else value
    if value is None or isinstance(value, bool | int | float):
        return value
    raise StorageError(f"{where} is a {type(value).__name__}; keep numbers, strings, lists, dictionaries or None there")


def _decode_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _decode_json(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_decode_json(entry) for entry in value]
    if isinstance(value, str) and _NON_FINITE.fullmatch(value):
        return value[1:] if value.startswith("\\") else float(value)
    return value
