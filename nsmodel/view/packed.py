"""Numbers as a page holds them: all rows, or the least and the largest of each few rows; compressed, as text."""

from __future__ import annotations

import base64
import zlib
from typing import Any, NamedTuple

import numpy as np

MAX_BYTES = 12_000_000  # Bytes for the columns of a run: as text, a third more, and with all else they stay below 20 MB.
MAX_EXACT_BYTES = 2_000_000  # Bytes of columns that are kept in double precision.
LEVEL = 6  # Of the compression.


class PackedRows(NamedTuple):
    """How rows are held: ``width`` of them as two extremes (1: each as it is), in double precision or single."""

    width: int
    exact: bool


def packing_for(rows: int, columns: int) -> PackedRows:
    """How so many rows and columns find room.

    >>> packing_for(5_000, 10), packing_for(100_000, 10), packing_for(1_000_000, 10)
    (PackedRows(width=1, exact=True), PackedRows(width=1, exact=False), PackedRows(width=7, exact=False))
    """
    cells = rows * columns
    if 4 * cells <= MAX_BYTES:
        return PackedRows(1, 8 * cells <= MAX_EXACT_BYTES)
    return PackedRows(max(2, -(-8 * cells // MAX_BYTES)), False)


def bucket_extremes(values: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of each ``width`` values (n,), NaN left out; NaN where there is nothing else."""
    starts = np.arange(0, len(values), width)
    return np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)


def pack_column(values: np.ndarray, begin: np.ndarray | None, rows: PackedRows) -> dict[str, Any]:
    """A column (n,): its numbers, or extremes ``low`` and ``high``; ``begin`` (n,): its values where the step to a row begins."""
    if rows.width == 1:
        both = {"low": values} if begin is None else {"low": values, "begin": begin}
    else:
        low, high = bucket_extremes(values, rows.width)
        if begin is not None:
            other_low, other_high = bucket_extremes(begin, rows.width)
            low, high = np.fmin(low, other_low), np.fmax(high, other_high)
        both = {"low": low, "high": high}
    return {name: pack_numbers(array, exact=rows.exact) for name, array in both.items()}


def pack_numbers(values: np.ndarray, *, exact: bool = True) -> dict[str, Any]:
    """Numbers (n,) in double precision, or in single precision around an ``offset``, in parts of a ``scale``."""
    values = values.astype(float)
    if exact:
        return {"type": "f8", "length": len(values), "data": _compress_to_text(values)}
    some = values[np.isfinite(values)]
    low, high = (float(some.min()), float(some.max())) if some.size else (0.0, 0.0)
    # Where all values are near one number, single precision would make steps of what lies between them; a zero stays one.
    offset = (low + high) / 2 if high - low < 1e-2 * min(abs(low), abs(high)) else 0.0
    largest = max(abs(low - offset), abs(high - offset))
    scale = float(2.0 ** np.ceil(np.log2(largest))) if largest > 0 else 1.0
    scaled = ((values - offset) / scale).astype(np.float32)
    return {"type": "f4", "length": len(values), "offset": offset, "scale": scale, "data": _compress_to_text(scaled)}


def pack_codes(values: np.ndarray) -> dict[str, Any]:
    """Whole numbers (n,) from 0 to 255."""
    return {"type": "u1", "length": len(values), "data": _compress_to_text(values.astype(np.uint8))}


def _compress_to_text(values: np.ndarray) -> str:
    """Bytes of an array: words of 32 bits as differences, words and bytes of one place together, deflated, in base64."""
    raw = values.view(np.uint8)
    if values.itemsize > 1:
        whole = values.astype(values.dtype.newbyteorder("<")).view("<u4").reshape(len(values), values.itemsize // 4)
        integers = np.ascontiguousarray(whole.T)
        integers[:, 1:] = np.diff(integers, axis=1)
        raw = integers.view(np.uint8).reshape(*integers.shape, 4).transpose(0, 2, 1)
    packer = zlib.compressobj(LEVEL, zlib.DEFLATED, -15)
    return base64.b64encode(packer.compress(raw.tobytes()) + packer.flush()).decode()
