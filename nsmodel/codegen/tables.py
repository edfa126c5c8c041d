"""Numbers as C tables."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from nsmodel.codegen.expression import number


def table(name: str, values: Sequence[float] | np.ndarray, size: str, comment: str = "", kind: str = "double") -> str:
    """Return ``static const kind name[size] = {...};``."""
    numbers = [number(float(v)).text if kind == "double" else str(int(v)) for v in values]
    about = f" /* {comment} */" if comment else ""
    listed = textwrap.fill(", ".join(numbers), 120, initial_indent="    ", subsequent_indent="    ")
    line = f"static const {kind} {name}[{size}] = {{{listed.strip()}}};{about}\n"
    return line if len(line) <= 130 else f"static const {kind} {name}[{size}] = {{{about}\n{listed}\n}};\n"


def unit_tables(rows: Sequence[tuple[int, int, float]]) -> str:
    """Rows y_i = factor z_j + offset (see `solve.structure`)."""
    if not rows:
        return ""
    i, j, factors = zip(*rows, strict=True)
    return (
        table("unit_row", i, "MODEL_UNIT", "y_i = factor z_j + offset", "int")
        + table("unit_column", j, "MODEL_UNIT", kind="int")
        + table("unit_factor", factors, "MODEL_UNIT")
    )
