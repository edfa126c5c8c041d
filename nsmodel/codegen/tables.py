"""Numbers as C tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate

import numpy as np

from nsmodel.codegen.expression import c_number
from nsmodel.solve.structure import StepStructure

TABLE_WIDTH = 120  # Characters of a line.


def c_table(name: str, values: Sequence[float] | np.ndarray, size: str, comment: str = "", kind: str = "double") -> str:
    """Return ``static const kind name[size] = {...};``."""
    numbers = [c_number(float(v)).text if kind == "double" else str(int(v)) for v in values]
    about = f" /* {comment} */" if comment else ""
    listed = "\n".join(_wrapped_lines(numbers))
    line = f"static const {kind} {name}[{size}] = {{{listed.strip()}}};{about}\n"
    return line if len(line) <= 130 else f"static const {kind} {name}[{size}] = {{{about}\n{listed}\n}};\n"


def _wrapped_lines(numbers: Sequence[str]) -> Iterator[str]:
    """The numbers in lines that are indented and up to WIDTH long."""
    line = "   "
    for i, text in enumerate(numbers):
        item = f" {text}," if i + 1 < len(numbers) else f" {text}"
        if len(line) + len(item) > TABLE_WIDTH and len(line) > 3:
            yield line
            line = "   "
        line += item
    yield line


def exact_tables(structure: StepStructure, *, by_rows: bool = False) -> str:
    """Rows where unknowns are known exactly: y_i = factor z_j + offset, those that follow, and those that rest together.

    ``by_rows``: the code has the rows of E, and finds the columns of those that follow there.
    """
    rest = c_table("rest_row", structure.rest_rows, "MODEL_REST", "z = 0 where all are coded 0", "int")
    if not structure.unit_rows:
        return rest if structure.rest_rows else ""
    i, j, factors = zip(*structure.unit_rows, strict=True)
    return (
        c_table("unit_row", i, "MODEL_UNIT", "y_i = factor z_j + offset", "int")
        + c_table("unit_column", j, "MODEL_UNIT", kind="int")
        + c_table("unit_factor", factors, "MODEL_UNIT")
        + _following_row_tables(structure, by_rows)
        + (rest if structure.rest_rows else "")
    )


def _following_row_tables(structure: StepStructure, by_rows: bool) -> str:
    rows = structure.follow_rows
    if not rows:
        return ""
    own = c_table("follow_row", [i for i, _ in rows], "MODEL_FOLLOW", "z_i is exact where all others of row i of E are", "int")
    if by_rows:
        return own
    starts = [0, *accumulate(len(needed) for _, needed in rows)]
    return (
        own
        + c_table("follow_start", starts, "MODEL_FOLLOW + 1", kind="int")
        + c_table("follow_column", [j for _, needed in rows for j, _ in needed], "", kind="int")
    )
