"""Numbers of a run: functions of it, and reductions of a column that a text names, such as ``x1[-1]`` or ``max(x1)``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.errors import UsageError

_ROW_PATTERN = re.compile(r"\s*(?P<name>[^\[\]()]+(?:\[\d+\])?)\s*\[\s*(?P<row>[+-]?\d+)\s*\]\s*")
_REDUCTION_PATTERN = re.compile(r"\s*(?P<how>\w+)\s*\(\s*(?P<name>.+?)\s*\)\s*")
ROW_REDUCTIONS = {"max": np.fmax, "min": np.fmin}  # Of all rows that have a value: multipliers have none at the start.
WINDOW_REDUCTIONS = ("mean", "rms", "integral")  # Of the whole run, as `Trajectory.mean` has them.


@dataclass(frozen=True)
class Reduction:
    """A number of one column: at a row, or its max, min, mean, rms or integral over the run."""

    text: str
    name: str
    how: str
    row: int = 0

    @property
    def needed_rows(self) -> tuple[int, ...] | None:
        """The rows that it reads, 0 or -1; None: all."""
        return (self.row,) if self.how == "row" and self.row in (0, -1) else None

    @property
    def needs_rows_alone(self) -> bool:
        """Whether it is of rows, not of what a whole run knows."""
        return self.how not in WINDOW_REDUCTIONS

    def reduce_rows(self, values: np.ndarray) -> np.ndarray:
        """Of columns (K, R) or (K, R, n): (K,) or (K, n); NaN where a failed run has no such row."""
        if self.how != "row":
            found = ROW_REDUCTIONS[self.how].reduce(values, axis=1)
        elif -values.shape[1] <= self.row < values.shape[1]:
            found = values[:, self.row]
        else:
            raise UsageError(f"output '{self.text}': there is no row {self.row}; a run of this sweep has {values.shape[1]} rows")
        return found[:, 0] if found.ndim == 2 and found.shape[1] == 1 else found

    def __call__(self, run: Any) -> np.ndarray:
        """Of a run."""
        if self.how in WINDOW_REDUCTIONS:
            found = np.asarray(getattr(run, self.how)(self.name))
            return found[0] if found.shape == (1,) else found
        with np.errstate(invalid="ignore"):
            return self.reduce_rows(run_column(run, self.name)[None])[0]


def run_column(run: Any, name: str) -> np.ndarray:
    """A column of a run by its name: a state or a symbol of several, a multiplier, an input, an array, an output."""
    try:
        return np.asarray(getattr(run, name))
    except AttributeError:
        pass
    try:
        return np.asarray(run.multiplier(name))
    except (UsageError, AttributeError):
        return np.asarray(run.evaluate(name))


def read_outputs(given: Mapping[str, Any] | None) -> dict[str, Callable[[Any], Any]]:
    """Read ``outputs=``: functions of a run, texts as reductions.

    Raises:
        UsageError: no dictionary, what is neither, a text that is no reduction.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise UsageError(f"outputs = {given!r:.60}; expected {{name: function of a run, or a text such as 'x1[-1]'}}")
    return {str(name): _read_reduction(str(name), what) for name, what in given.items()}


def _read_reduction(name: str, what: Any) -> Callable[[Any], Any]:
    if not isinstance(what, str):
        if not callable(what):
            raise UsageError(f"output '{name}': {what!r:.60}; expected a function of a run, or a text such as 'x1[-1]'")
        return what
    if found := _REDUCTION_PATTERN.fullmatch(what):
        how = found["how"]
        if how not in (*ROW_REDUCTIONS, *WINDOW_REDUCTIONS):
            raise UsageError(
                f"output '{name}': '{how}' is unknown; there are {', '.join((*ROW_REDUCTIONS, *WINDOW_REDUCTIONS))}, and "
                "NAME[ROW]"
            )
        return Reduction(what, found["name"], how)
    if found := _ROW_PATTERN.fullmatch(what):
        return Reduction(what, found["name"].strip(), "row", int(found["row"]))
    raise UsageError(f"output '{name}': '{what}'; expected NAME[ROW], such as x1[-1] for the end, or max(NAME), mean(NAME), ...")
