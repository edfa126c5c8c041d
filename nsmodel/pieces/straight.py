"""The sums of a system with constant slopes as straight Python, written for it: order k of y, and of x from the order before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

SeriesRows = Sequence[list[float]]
RowTerms = Sequence[Sequence[tuple[int, float]]]  # (j, a_j) of each row.
MAX_WRITTEN_TERMS = 2000  # Terms and rows of a sum that is written out; longer ones are loops.


def compile_sums(
    out: SeriesRows, parts: Sequence[SeriesRows], terms: RowTerms, inner: SeriesRows, scaled: bool
) -> Callable[..., None]:
    """``of(k)``: out_i[k] = parts_i[k] + ... + sum_j a_j inner_j[k]; ``scaled``: ``of(k, c)``: out_i[k + 1] = c times that.

    Rows are lists that stay where they are, and hold what order k is made of.
    """
    if len(out) + sum(map(len, terms)) > MAX_WRITTEN_TERMS:
        return _loop_sums(out, parts, terms, inner, scaled)
    known = {f"o{i}": row for i, row in enumerate(out)} | {f"n{j}": row for j, row in enumerate(inner)}
    known |= {f"p{which}_{i}": row for which, rows in enumerate(parts) for i, row in enumerate(rows)}
    used = sorted({j for own in terms for j, _ in own})
    body = [f"u{j} = n{j}[k]" for j in used]
    for i, own in enumerate(terms):
        value, more = " + ".join(f"p{which}_{i}[k]" for which in range(len(parts))), " + ".join(f"{a!r}*u{j}" for j, a in own)
        value += f" + {more if scaled else f'({more})'}" if own else ""
        body.append(f"o{i}[k + 1] = c*({value})" if scaled else f"o{i}[k] = {value}")
    head = f"def make({', '.join(known)}):\n    def of(k{', c' if scaled else ''}):\n"
    made: dict[str, Any] = {}
    exec(compile(head + "".join(f"        {line}\n" for line in body or ["pass"]) + "    return of\n", "<sums>", "exec"), made)
    return made["make"](**known)


def nonzero_terms(matrix: np.ndarray | None, rows: int) -> list[list[tuple[int, float]]]:
    """Of each row of a matrix, what is not 0; of none nothing."""
    return [[]] * rows if matrix is None else [[(j, a) for j, a in enumerate(row) if a] for row in matrix.tolist()]


def _loop_sums(
    out: SeriesRows, parts: Sequence[SeriesRows], terms: RowTerms, inner: SeriesRows, scaled: bool
) -> Callable[..., None]:
    together = list(zip(out, zip(*parts, strict=True), terms, strict=True))

    def sum_rows(k: int, c: float = 1.0) -> None:
        for row, own, entries in together:
            total = sum([row[k] for row in own])
            more = [a * inner[j][k] for j, a in entries]
            row[k + scaled] = c * sum(more, total) if scaled else total + sum(more)

    return sum_rows
