"""A page that stands alone: its frame, the policy that allows it nothing but itself, its data, and where it is written.

Numbers are all rows, or the least and the largest of each few rows; compressed, as text.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import tempfile
import webbrowser
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import escape_invisible
from nsmodel.files.storage import encode_utf8, write_text

VIEW_FOLDER = Path(__file__).parent
PAGE_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="nsmodel">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<noscript>This page draws its data by a script of its own; allow scripts to see it.</noscript>
<main id="page"></main>
<script type="application/json" id="data">{data}</script>
<script>{script}</script>
</body>
</html>"""


def standalone_page(title: str, document: Any, scripts: Sequence[str]) -> str:
    """The page of a document, drawn by scripts of these names.

    What is the user's stands in the title and in the data, both escaped: no text ends their element, none hides what it says.
    Scripts set it as text.
    """
    style = (VIEW_FOLDER / "view.css").read_text(encoding="utf-8")
    parts = [(VIEW_FOLDER / f"{name}.js").read_text(encoding="utf-8") for name in scripts]
    script = "\n".join(['"use strict";', "(() => {", *parts, "})();"])
    data = json.dumps(_with_visible_text(document), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    policy = (
        f"default-src 'none'; script-src '{_csp_hash(script)}'; style-src '{_csp_hash(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    return PAGE_TEMPLATE.format(policy=policy, title=html.escape(escape_invisible(title)), style=style, data=data, script=script)


def _with_visible_text(value: Any) -> Any:
    """The document with an escape for each character in its texts that is not seen."""
    if isinstance(value, str):
        return escape_invisible(value)
    if isinstance(value, dict):
        return {key: _with_visible_text(one) for key, one in value.items()}
    return [*map(_with_visible_text, value)] if isinstance(value, list | tuple) else value


def write_page(text: str, path: str | Path | None, title: str) -> Path:
    """Write a page, and return its path; where none is given, into a new temporary folder, and open it in the browser."""
    if path is not None:
        write_text(path, text)
        return Path(path)
    name = "".join(c if c.isalnum() else "-" for c in title)[:40].strip("-") or "view"
    made = Path(tempfile.mkdtemp(prefix="nsmodel-")) / f"{name}.html"
    write_text(made, text)
    open_in_browser(made)
    return made


def open_in_browser(path: Path) -> None:
    """Show a page in the user's browser, where there is one."""
    webbrowser.open(path.resolve().as_uri())


def _csp_hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(encode_utf8(text)).digest()).decode()}"


MAX_BYTES = 12_000_000  # Bytes for the columns of a run: as text, a third more, and with all else they stay below 20 MB.
# Bytes of columns that are kept in double precision: others have floats, of half the size, as exact as a picture shows.
MAX_EXACT_BYTES = 2_000_000
COMPRESSION_LEVEL = 6  # Of zlib, from 0 to 9: its own default.


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
    packer = zlib.compressobj(COMPRESSION_LEVEL, zlib.DEFLATED, -15)
    return base64.b64encode(packer.compress(raw.tobytes()) + packer.flush()).decode()
