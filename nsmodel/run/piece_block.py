"""Pieces of an event-driven run as rows of numbers: the record that C writes and the course is written in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from nsmodel.pieces.piece import Piece, StartEvent

HEAD_NUMBERS = 7  # t, tau, s, defect, whether an event begins it, within what its time is known, residual.


class PieceLayout(NamedTuple):
    """Where a record, of n + 2m polynomials with so many coefficients, has what: as in `c/pieces.c`."""

    n: int
    m: int
    coefficients: int

    @property
    def width(self) -> int:
        """Numbers of a record."""
        return HEAD_NUMBERS + 4 * self.m + self.n + self.coefficients * (self.n + 2 * self.m)

    def of(self, k: int) -> slice:
        """The k-th list of m numbers: impulse, codes, sizes of y and of l."""
        return slice(HEAD_NUMBERS + k * self.m, HEAD_NUMBERS + (k + 1) * self.m)

    @property
    def last(self) -> slice:
        """The state at the end."""
        return slice(HEAD_NUMBERS + 4 * self.m, HEAD_NUMBERS + 4 * self.m + self.n)


@dataclass(frozen=True)
class PieceBuffer:
    """Pieces (K), see `pieces.piece`, one record (K, width) each; and what residuals of y and l are measured beside."""

    rows: np.ndarray
    layout: PieceLayout

    @classmethod
    def of(cls, pieces: Sequence[Piece], y_scales: Sequence[list[float]], l_scales: Sequence[list[float]]) -> Self:
        """Some pieces, and the sizes at their ends."""
        count, (n, coefficients), m = len(pieces), np.shape(pieces[0].x), len(pieces[0].codes)
        t, tau, s, x, l, y, codes, defect, last, event, residual = zip(*pieces, strict=True)
        of_events = [one or StartEvent((0.0,) * m) for one in event]
        impulse, widths = [one.impulse for one in of_events], [one.width for one in of_events]
        begins, of_steps = [one is not None for one in event], [math.nan if one is None else one for one in residual]
        head = np.array([t, tau, s, defect, begins, widths, of_steps], float).T
        lists = [np.array(part, float).reshape(count, m) for part in (impulse, codes, y_scales, l_scales)]
        series = [np.array(part, float).reshape(count, k, coefficients) for part, k in ((x, n), (l, m), (y, m))]
        whole = np.concatenate(series, axis=1).transpose(0, 2, 1).reshape(count, -1)
        return cls(np.concatenate([head, *lists, np.array(last, float), whole], axis=1), PieceLayout(n, m, coefficients))

    @classmethod
    def concatenate(cls, blocks: Sequence[Self]) -> Self:
        """One after the other."""
        first = blocks[0]
        return first if len(blocks) == 1 else cls(np.concatenate([block.rows for block in blocks]), first.layout)

    def cut(self, part: slice) -> Self:
        """Some of them."""
        return type(self)(self.rows[part], self.layout)

    @property
    def count(self) -> int:
        """K."""
        return len(self.rows)

    @property
    def t(self) -> np.ndarray:
        """Where they begin."""
        return self.rows[:, 0]

    @property
    def tau(self) -> np.ndarray:
        """Their units of time."""
        return self.rows[:, 1]

    @property
    def end(self) -> np.ndarray:
        """The last times."""
        return self.rows[:, 0] + self.rows[:, 1] * self.rows[:, 2]

    @property
    def until(self) -> float:
        """The end of the last one."""
        t, tau, s = self.rows[-1, :3].tolist()
        return t + tau * s

    @property
    def defect(self) -> np.ndarray:
        """The estimates, in units of rtol."""
        return self.rows[:, 3]

    @property
    def event(self) -> np.ndarray:
        """Which begin with an event."""
        return self.rows[:, 4] != 0

    @property
    def event_width(self) -> np.ndarray:
        """The time about that event in which the sign of what ends there is not known."""
        return self.rows[:, 5]

    @property
    def residual(self) -> np.ndarray:
        """Of time steps, else NaN."""
        return self.rows[:, 6]

    @property
    def stepped(self) -> np.ndarray:
        """Which are by time steps."""
        return ~np.isnan(self.residual)

    @property
    def impulse(self) -> np.ndarray:
        """Of the jump that each begins after (K, m)."""
        return self.rows[:, self.layout.of(0)]

    @property
    def codes(self) -> np.ndarray:
        """The modes (K, m)."""
        return self.rows[:, self.layout.of(1)].astype(np.int8)

    @property
    def size_y(self) -> np.ndarray:
        """What y is measured beside at the end (K, m)."""
        return self.rows[:, self.layout.of(2)]

    @property
    def size_l(self) -> np.ndarray:
        """What l is measured beside at the end (K, m)."""
        return self.rows[:, self.layout.of(3)]

    @property
    def last(self) -> np.ndarray:
        """x at the end (K, n)."""
        return self.rows[:, self.layout.last]

    @property
    def series(self) -> np.ndarray:
        """The polynomials of x, l and y (K, n + 2m, p + 1)."""
        n, m, coefficients = self.layout
        return self.rows[:, self.layout.last.stop :].reshape(self.count, coefficients, n + 2 * m).transpose(0, 2, 1)

    def pieces(self) -> list[Piece]:
        """One by one."""
        n, m, _ = self.layout
        found = []
        for row, codes, last, impulse, c in zip(
            self.rows, self.codes.tolist(), self.last.tolist(), self.impulse.tolist(), self.series, strict=True
        ):
            t, tau, s, defect, event, width, residual = row[:HEAD_NUMBERS].tolist()
            series, of = (c[:n], c[n : n + m], c[n + m :], tuple(codes)), StartEvent(tuple(impulse), width) if event else None
            found.append(Piece(t, tau, s, *series, defect, last, of, None if math.isnan(residual) else residual))
        return found
