"""Taylor coefficients by the recurrences of `jets`, interpreted."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from nsmodel.pieces import series
from nsmodel.pieces.jets import Jets
from nsmodel.pieces.printed import PYTHON, Dialect, first, later, summed

KNOWN = series.RECURRENCES | series.STARTS | {name: getattr(np, name) for name in ("floor", "ceil", "trunc", "rint")}


class Expansion:
    """The rows of some jets with numbers: ``order(k)`` computes order k of all of them, once the inputs have it.

    Attributes:
        rows: ``count`` lists of orders + 1 coefficients; those of the inputs are the caller's.
        choice: for each branch the side or the whole number; NaN: chosen at order 0, by the value there.
        outputs: the rows of the expression's entries.
    """

    def __init__(
        self, jets: Jets, orders: int, inputs: Mapping[tuple[int, int], list[Any]] | None = None, language: Dialect = PYTHON,
        known: Mapping[str, Any] = KNOWN,
    ) -> None:  # fmt: skip
        """``inputs``: lists that stand for rows of inputs, by (which input, its entry); for the others see `compiled`."""
        self.jets = jets
        self.rows: list[list[Any]] = [[0.0] * (orders + 1) for _ in range(jets.count)]
        for place, row in jets.inputs.items():
            if inputs is not None:
                self.rows[row] = inputs[place]
        for row, value in jets.numbers.items():
            self.rows[row][0] = value
        self.choice: list[Any] = [math.nan] * len(jets.branches)
        self.outputs = [self.rows[row] for row in jets.outputs]
        self._first, self._later = compiled(jets, self.rows, self.choice, language, known)
        self._summed = _summed(jets)

    def compute(self, k: int) -> None:
        """Compute order k of all rows."""
        if k:
            self._later(k)
        else:
            self._first()

    def order(self, k: int) -> list[float]:
        """Compute order k of all rows, and return that of the outputs; NaN where they have none."""
        self.compute(k)
        return [row[k] for row in self.outputs]

    def terms(self, inputs: Mapping[tuple[int, int], float]) -> list[float]:
        """What the branches' arguments are the sums of at order 0, in size; inputs are of the sizes given."""
        size = [abs(row[0]) for row in self.rows]
        for place, row in self.jets.inputs.items():
            size[row] = max(size[row], inputs[place])
        self._summed(size)
        return [size[branch.row] for branch in self.jets.branches]


def scale(rows: Sequence[list[float]], times: float) -> None:
    """Let the unit of time be so many times as long, a power of two; a row that is there twice is one."""
    powers = list(itertools.accumulate([times] * (max(map(len, rows)) - 1), operator.mul, initial=1.0))
    for row in {id(row): row for row in rows}.values():
        row[:] = map(operator.mul, row, powers)


def compiled(jets: Jets, rows: list[list[Any]], choice: list[Any], language: Dialect, known: Mapping[str, Any]):
    """The functions of order 0 and of order k > 0, with the rows as their variables; ``known``: what the language calls."""
    names = [f"r{row}" for row in range(jets.count)]
    bodies = [
        f"    def {name}:\n" + "\n".join(f"        {line}" for line in lines or ["pass"])
        for name, lines in (("first()", first(jets, language)), ("later(k)", later(jets, language)))
    ]
    made: dict = {}
    text = f"def make(rows, choice):\n    [{', '.join(names)}] = rows\n" + "\n".join(bodies) + "\n    return first, later\n"
    exec(compile(text, "<series>", "exec"), dict(known), made)
    return made["make"](rows, choice)


def _summed(jets: Jets) -> Callable[[list[float]], None]:
    """What makes the sizes of rows those of the sums that they are."""
    texts = ((line.y, summed(line, "size[{}]".format, PYTHON)) for line in jets.lines if jets.branches)
    lines = [f"    size[{y}] = max(size[{y}], {text})\n" for y, text in texts if text]
    made: dict = {}
    exec(compile("def sizes(size):\n" + ("".join(lines) or "    pass\n"), "<sizes>", "exec"), made)
    return made["sizes"]
