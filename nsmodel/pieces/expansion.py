"""Taylor coefficients by the recurrences of `jets`, interpreted."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from nsmodel.pieces import series
from nsmodel.pieces.jets import Jets, Line

LINEAR: dict[str, Callable[..., float]] = {
    "sum": lambda a, b: a + b,
    "difference": lambda a, b: a - b,
    "minus": lambda a: -a,
}
LOGIC: dict[str, Callable[..., bool]] = {  # Of rows that are 0 or 1 all along a piece.
    "both": lambda a, b: a != 0 and b != 0,
    "either": lambda a, b: a != 0 or b != 0,
    "not": lambda a: a == 0,
}
# What a branch is chosen by at order 0: a side, or a whole number.
CHOICES: dict[str, Callable[..., float]] = {
    "side": lambda a: -1.0 if a < 0 else 1.0,
    "equal": lambda a: float(np.sign(a)),
    "floor": np.floor,
    "ceil": np.ceil,
    "toward zero": lambda a: np.trunc(a),
    "nearest": np.rint,
}


class Expansion:
    """The rows of some jets with numbers: ``order(k)`` computes order k of all of them, once the inputs have it.

    Attributes:
        rows: (count, orders + 1) coefficients; those of the inputs are the caller's.
        choice: (branches,) the side or the whole number of each; NaN: chosen at order 0, by the value there.
    """

    def __init__(self, jets: Jets, orders: int) -> None:
        self.jets, self.rows = jets, np.zeros((jets.count, orders + 1))
        for row, value in jets.numbers.items():
            self.rows[row, 0] = value
        self.choice = np.full(len(jets.branches), np.nan)
        self._steps = [self._step(line) for line in jets.lines]
        self._outputs = np.array(jets.outputs, int)

    def order(self, k: int) -> np.ndarray:
        """Compute order k of all rows, and return that of the outputs."""
        for step in self._steps:
            step(k)
        return self.rows[self._outputs, k]

    def _step(self, line: Line) -> Callable[[int], None]:
        y, args = self.rows[line.y], [self.rows[row] for row in line.args]
        if line.branch >= 0:
            return partial(self._switched, line, y, args)
        recurrence = _recurrence(line, y, args)
        if not line.start:
            return recurrence
        function, of = series.STARTS[line.start], [self.rows[row] for row in line.of]

        def step(k: int) -> None:
            if k:
                recurrence(k)
                return
            try:
                y[0] = function(*(float(row[0]) for row in of))
            except (ValueError, OverflowError):
                y[0] = np.nan

        return step

    def _switched(self, line: Line, y: np.ndarray, args: list[np.ndarray], k: int) -> None:
        branch = self.jets.branches[line.branch]
        if k == 0 and np.isnan(self.choice[line.branch]):
            self.choice[line.branch] = CHOICES[branch.kind](self.rows[branch.row, 0])
        choice = self.choice[line.branch]
        if line.kind == "whole":
            y[k] = choice if k == 0 else 0.0
        else:
            first = choice == 0 if line.kind == "equal" else choice > 0
            y[k] = args[0 if first else 1][k]


def _recurrence(line: Line, y: np.ndarray, args: list[np.ndarray]) -> Callable[[int], None]:
    """Order k of a line without switches."""
    number = line.number

    def put(value: Callable[[int], float]) -> Callable[[int], None]:
        def step(k: int) -> None:
            y[k] = value(k)

        return step

    if line.kind in LINEAR:
        function = LINEAR[line.kind]
        return put(lambda k: function(*(row[k] for row in args)))
    if line.kind in LOGIC:
        holds = LOGIC[line.kind]
        return put(lambda k: float(holds(*(row[0] for row in args))) if k == 0 else 0.0)
    if line.kind == "guarded":
        return put(lambda k: args[1][k] if args[0][0] else 0.0)
    if line.kind == "scaled":
        return put(lambda k: number * args[0][k])
    if line.kind == "over":
        return put(lambda k: args[0][k] / number)
    if line.kind == "shifted":
        return put(lambda k: args[0][k] if k else args[0][0] + number)
    if line.kind == "power":
        return lambda k: series.power(y, args[0], number, k)
    if line.kind in ("along", "against"):
        function = getattr(series, line.kind)
        return lambda k: function(y, *args, k, number)
    function = getattr(series, line.kind)
    return lambda k: function(y, *args, k)
