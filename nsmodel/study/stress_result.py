"""What came of pushing a model: cells, their verdicts, a table, JSON."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel._utils import TEXT_WIDTH, display, escape_invisible, html_repr, labelled_lines, one_line, short_repr, wrap_lines

RIGHT, STOPPED, WRONG, LEFT_OUT = "right", "stopped", "wrong", "left out"
_MAX_LISTED_CELLS = 12  # Wrong runs, and runs that stopped, that the table names: half a screen; the result holds them all.
_CELL_LABELS = {RIGHT: "ok", STOPPED: "stop", WRONG: "WRONG", LEFT_OUT: "-"}


@dataclass(frozen=True)
class Cell:
    """One run.

    Attributes:
        values: the varied parameters.
        factor, step: the step beside the one that is taken for 1, and itself (in the model's own unit of time).
        u, tau: how many times as large the numbers of states and times were.
        verdict: "right", "stopped" (the run refused to go on, and what it had computed is right), "wrong", or "left out" for want
            of time.
        checks: {what: misfit beside what is allowed}; above 1 is wrong.
        message: why it stopped.
        steps: how many steps were taken.
    """

    values: Mapping[str, float]
    factor: float
    step: float
    u: float
    tau: float
    verdict: str
    checks: Mapping[str, float]
    message: str
    steps: int

    __repr__ = short_repr

    @property
    def worst(self) -> tuple[str, float]:
        """The check that came nearest to what is allowed, or passed it most, and its ratio; ("", 0) without checks."""
        return max(self.checks.items(), key=lambda item: item[1], default=("", 0.0))

    @property
    def row(self) -> str:
        """Where the cell stands, but for its step: values and units."""
        values = [f"{name} = {value:g}" for name, value in self.values.items()]
        units = [f"{what} x {size:g}" for what, size in (("state", self.u), ("time", self.tau)) if size != 1]
        return ", ".join([*values, *(units or ["own units"])])


@dataclass(frozen=True, repr=False)
class Stress:
    """All cells of a model.

    Attributes:
        title, model_class, names: of the model and its states.
        time_unit: the user's word for it, or "".
        step: the step that is taken for 1.
        cells: in the order in which they ran.
    """

    title: str
    model_class: str
    names: tuple[str, ...]
    time_unit: str
    step: float
    cells: tuple[Cell, ...]

    _repr_html_ = html_repr("stress_html")

    def __repr__(self) -> str:
        """Return a few lines: title, class, what came of the cells."""
        counts = f"{len(self.cells)} cells, {', '.join(f'{self.count(one)} {one}' for one in self.verdicts)}"
        return "\n".join(wrap_lines(f"Stress({one_line(self.title)!r}, {self.model_class}: {counts})"))

    @property
    def verdicts(self) -> tuple[str, ...]:
        """The verdicts that are counted: of cells left out only where there are some."""
        return (RIGHT, STOPPED, WRONG, *([LEFT_OUT] if self.count(LEFT_OUT) else []))

    def count(self, verdict: str) -> int:
        """How many cells have a verdict: "right", "stopped", "wrong" or "left out"."""
        return sum(cell.verdict == verdict for cell in self.cells)

    @property
    def wrong(self) -> tuple[Cell, ...]:
        """The cells that are wrong."""
        return tuple(cell for cell in self.cells if cell.verdict == WRONG)

    @property
    def rows(self) -> list[str]:
        """Labels of the rows of the table: values and units."""
        return list(dict.fromkeys(cell.row for cell in self.cells))

    @property
    def factors(self) -> list[float]:
        """Step sizes of the columns of the table, beside ``step``."""
        return sorted({cell.factor for cell in self.cells})

    def text(self) -> str:
        """Return the table, the reasons of the cells that stopped, and what is wrong."""
        unit = f" {self.time_unit}" if self.time_unit else ""
        counts = ", ".join(f"{self.count(verdict)} {verdict}" for verdict in self.verdicts)
        lines = [self.title, f"  model class  {self.model_class}", f"  cells        {len(self.cells)}: {counts}"]
        lines += labelled_lines("judged by", ", ".join(_check_kinds(self.cells)), 13)
        lines += ["", *self._table(f"step, in units of {self.step:g}{unit}"), ""]
        wrong = [
            [f"  {cell.row}, step x {cell.factor:g}: {cell.worst[0]}, {_ratio_text(cell.worst[1])}"]
            for cell in sorted(self.wrong, key=lambda cell: -cell.worst[1])
        ]
        lines += _list_entries("Wrong (misfit beside what is allowed)", wrong)
        if self.count(LEFT_OUT):
            lines += [f"{self.count(LEFT_OUT)} cells were left out for the time budget: raise it to run them", ""]
        stopped = [cell for cell in self.cells if cell.verdict == STOPPED]
        texts = [f"{cell.row}, step x {cell.factor:g}, after {cell.steps} steps: {cell.message}" for cell in stopped]
        wrapped = [textwrap.wrap(text, TEXT_WIDTH, initial_indent="  ", subsequent_indent="    ") for text in texts]
        lines += _list_entries("Stopped", wrapped)
        return escape_invisible("\n".join(lines).rstrip())

    def _table(self, head: str) -> list[str]:
        rows, factors = self.rows, self.factors
        verdicts = {(cell.row, cell.factor): cell.verdict for cell in self.cells}
        width = max(len(row) for row in rows)
        lines = [f"  {'':{width}}  {head}", f"  {'':{width}} " + "".join(f"{factor:>7g}" for factor in factors)]
        for row in rows:
            labels = (_CELL_LABELS[verdicts[row, f]] if (row, f) in verdicts else "" for f in factors)
            lines.append(f"  {row:{width}} " + "".join(f"{word:>7}" for word in labels))
        return lines

    def document(self) -> dict[str, Any]:
        """Return all as dictionaries, lists, numbers and strings, for JSON."""
        return {
            "title": self.title, "model_class": self.model_class, "step": self.step,
            **{verdict: self.count(verdict) for verdict in (RIGHT, STOPPED, WRONG, LEFT_OUT)},
            "cells": [{**vars(cell), "values": dict(cell.values), "checks": dict(cell.checks)} for cell in self.cells],
        }  # fmt: skip

    def plot(self, ax: Any = None) -> Any:
        """Draw the table as a heat map, on ``ax`` or a new figure; return the axes (see `nsmodel.plot.stress`)."""
        return display("stress", self, ax=ax)


def _list_entries(title: str, entries: Sequence[Sequence[str]]) -> list[str]:
    """The lines of the first entries below a title, and how many more there are; nothing where there is none."""
    more = [f"  ... {len(entries) - _MAX_LISTED_CELLS} more"] if len(entries) > _MAX_LISTED_CELLS else []
    return [title, *(line for entry in entries[:_MAX_LISTED_CELLS] for line in entry), *more, ""] if entries else []


def _check_kinds(cells: Iterable[Cell]) -> list[str]:
    """What the cells were judged by, each kind once, formulas and promises gathered."""
    names = list(dict.fromkeys(name for cell in cells for name in cell.checks))
    gathered = []
    for kind, label in (("formula: ", "formulas"), ("along: ", "along the run")):
        parts = [name.removeprefix(kind) for name in names if name.startswith(kind)]
        gathered += [f"{label} ({', '.join(parts)})"] if parts else []
    return gathered + [name for name in names if ": " not in name]


def _ratio_text(value: float) -> str:
    return "broken" if not np.isfinite(value) else f"{value:.3g} times"
