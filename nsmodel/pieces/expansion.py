"""Taylor coefficients by the recurrences of `jets`, interpreted."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from nsmodel.pieces import series
from nsmodel.pieces.jets import TaylorRecurrences
from nsmodel.pieces.printed import PYTHON_DIALECT, Dialect, higher_order_statements, order_0_statements, sum_text

NUMERIC_FUNCTIONS = (
    series.RECURRENCES | series.ORDER_0_FUNCTIONS | {name: getattr(np, name) for name in ("floor", "ceil", "trunc", "rint")}
)


class TaylorExpansion:
    """The rows of some jets with numbers: ``order(k)`` computes order k of all of them, once the inputs have it.

    Attributes:
        rows: ``count`` lists of orders + 1 coefficients; those of the inputs are the caller's.
        choice: for each branch the side or the whole number; NaN: chosen at order 0, by the value there.
        outputs: the rows of the expression's entries.
    """

    def __init__(
        self, recurrences: TaylorRecurrences, orders: int, inputs: Mapping[tuple[int, int], list[Any]] | None = None,
        language: Dialect = PYTHON_DIALECT, known: Mapping[str, Any] = NUMERIC_FUNCTIONS,
    ) -> None:  # fmt: skip
        """``inputs``: lists that stand for rows of inputs, by (which input, its entry); for the others see `compiled`."""
        self.jets = recurrences
        self.rows: list[list[Any]] = [[0.0] * (orders + 1) for _ in range(recurrences.count)]
        for place, row in recurrences.inputs.items():
            if inputs is not None:
                self.rows[row] = inputs[place]
        for row, value in recurrences.numbers.items():
            self.rows[row][0] = value
        self.choice: list[Any] = [math.nan] * len(recurrences.branches)
        self.outputs = [self.rows[row] for row in recurrences.outputs]
        self._run_order_0, self._run_order_k = compile_recurrences(recurrences, self.rows, self.choice, language, known)
        self._sum_sizes = _compile_size_sums(recurrences)

    def compute(self, k: int) -> None:
        """Compute order k of all rows."""
        if k:
            self._run_order_k(k)
        else:
            self._run_order_0()

    def order(self, k: int) -> list[float]:
        """Compute order k of all rows, and return that of the outputs; NaN where they have none."""
        self.compute(k)
        return [row[k] for row in self.outputs]

    def terms(self, inputs: Mapping[tuple[int, int], float]) -> list[float]:
        """What the branches' arguments are the sums of at order 0, in size; inputs are of the sizes given."""
        size = [abs(row[0]) for row in self.rows]
        for place, row in self.jets.inputs.items():
            size[row] = max(size[row], inputs[place])
        self._sum_sizes(size, self.choice)
        return [size[branch.row] for branch in self.jets.branches]


def rescale_time(rows: Sequence[list[float]], times: float) -> None:
    """Let the unit of time be so many times as long, a power of two; a row that is there twice is one."""
    powers = list(itertools.accumulate([times] * (max(map(len, rows)) - 1), operator.mul, initial=1.0))
    for row in {id(row): row for row in rows}.values():
        row[:] = map(operator.mul, row, powers)


def compile_recurrences(
    recurrences: TaylorRecurrences, rows: list[list[Any]], choice: list[Any], language: Dialect, known: Mapping[str, Any]
):
    """The functions of order 0 and of order k > 0, with the rows as their variables; ``known``: what the language calls."""
    names = [f"r{row}" for row in range(recurrences.count)]
    bodies = [
        f"    def {name}:\n" + "\n".join(f"        {line}" for line in lines or ["pass"])
        for name, lines in (
            ("first()", order_0_statements(recurrences, language)),
            ("later(k)", higher_order_statements(recurrences, language)),
        )
    ]
    made: dict = {}
    text = f"def make(rows, choice):\n    [{', '.join(names)}] = rows\n" + "\n".join(bodies) + "\n    return first, later\n"
    exec(compile(text, "<series>", "exec"), dict(known), made)
    return made["make"](rows, choice)


def _compile_size_sums(recurrences: TaylorRecurrences) -> Callable[[list[float], list[float]], None]:
    """What makes the sizes of rows those of the sums that they are, of the side that is chosen."""
    given = recurrences.lines if recurrences.branches else []
    texts = ((line.y, sum_text(line, "size[{}]".format, f"choice[{line.branch}]", PYTHON_DIALECT)) for line in given)
    lines = [f"    size[{y}] = max(size[{y}], {text})\n" for y, text in texts if text]
    made: dict = {}
    exec(compile("def sizes(size, choice):\n" + ("".join(lines) or "    pass\n"), "<sizes>", "exec"), made)
    return made["sizes"]
