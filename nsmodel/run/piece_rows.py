"""The rows of an event-driven run in memory, and the pieces that they are read off."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel import dense, laws
from nsmodel.pieces.expansion import Expansion
from nsmodel.pieces.jets import jets_of
from nsmodel.pieces.known import SAME_TIME
from nsmodel.pieces.piece import Piece
from nsmodel.run.piece_block import Block, Layout
from nsmodel.run.row_facts import columns_of, facts
from nsmodel.run.walk import CHUNK_BYTES
from nsmodel.scheme.continuous import ContinuousProblem

Columns = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Carried:
    """What the rows that are written leave for the next: how many, the last one's time and integral of the multipliers.

    ``until``: that integral up to the next piece; ``worst``: the largest estimate of the pieces since the last row.
    """

    rows: int
    t: float
    integral: np.ndarray
    until: np.ndarray
    worst: float = 0.0


class _Rows(NamedTuple):
    """Rows: times, pieces among those in memory, the largest estimate since the row before; integrals of l where asked."""

    t: np.ndarray
    piece: np.ndarray
    worst: np.ndarray
    integral: np.ndarray | None

    @classmethod
    def joined(cls, rows: Sequence[_Rows]) -> _Rows:
        """One after the other."""
        if len(rows) == 1:
            return rows[0]
        t, piece, worst, integral = zip(*rows, strict=True)
        whole = None if integral[0] is None else np.concatenate(integral)
        return cls(np.concatenate(t), np.concatenate(piece), np.concatenate(worst), whole)


class PieceRows:
    """Rows in memory: every n-th of those that ``take`` is given, of pieces that are all kept; see `walk.RowBuffer`."""

    def __init__(
        self, problem: ContinuousProblem, orders: int, every: int, until: float, times: list[float] | None,
        columns: Columns | None,
    ) -> None:  # fmt: skip
        """``until``: the end of the run, and the last of the ``times`` of its rows; None: the ends of pieces.

        ``columns``: (h, y, records) side by side of rows (t, x, l), where these are computed elsewhere.
        """
        self.problem, self.orders, self.every, self.until, self.times = problem, orders, every, until, times
        self._out = _outputs(problem, orders)
        self._facts = facts(problem)
        self._curved = [(at, part) for at, part in problem.law.parts() if part.curved() is not None]
        self._tell = columns or columns_of(problem)
        nothing = np.zeros(self._facts.shown)
        self._carried = Carried(0, 0.0, nothing, nothing)
        self.starts = True  # Whether the row of the start is among those in memory.
        self._blocks: list[Block] = []
        self._new: list[Block] = []  # Of which the rows are not known yet.
        self.clear()

    def clear(self) -> None:
        """Forget the rows."""
        if self._blocks:
            self.starts = False
        self._blocks, self._rows, self._shown = [], [], []
        self.count = self._settled = self._count_rows = 0
        self._before = self._carried
        self._columns: dict[str, np.ndarray] | None = None

    @property
    def carried(self) -> Carried:
        """What the rows so far leave for the next."""
        self._settle()
        return self._carried

    @property
    def pieces(self) -> list[Piece]:
        """The pieces in memory, one by one."""
        self._settle()
        return [piece for block in self._blocks for piece in block.pieces()]

    @property
    def filled(self) -> int:
        """Rows in memory."""
        self._settle()
        return self._count_rows + self.starts

    @property
    def numbers(self) -> np.ndarray:
        """The piece of each row, among those in memory."""
        self._settle()
        return np.concatenate([np.zeros(int(self.starts), int), *(rows.piece for rows in self._rows)])

    @property
    def full(self) -> bool:
        """Whether they fill a chunk."""
        n, m = self._facts.n, self._facts.m
        return self.count * (n + 2 * m) * 8 * (self.orders + 1) > CHUNK_BYTES

    def take(self, block: Block) -> None:
        """Keep pieces, and of the rows in them every n-th, and the last one of the run."""
        self._new.append(block)
        self.count += block.count

    def _settle(self) -> None:
        """Find the rows of the pieces that were taken."""
        if not self._new:
            return
        block, before = Block.joined(self._new), self._carried
        end, shown = block.end, _shown(block) if self._out is None else _expanded(self._out, block, self._facts.shown)
        times, last = self._times(end)
        t = times
        if self.every > 1:
            keep = (before.rows + np.arange(1, len(times) + 1)) % self.every == 0
            if last and len(times):
                keep[-1] = True
            t = times[keep]
        piece = np.minimum(np.searchsorted(end, t, side="left"), len(end) - 1)
        until, integral = self._integrals(block, shown[0], t, piece) if self.problem.impulses else (before.until, None)
        worst, rest = _worst(before.worst, block.defect, piece)
        rows, now = _Rows(t, piece + self._settled, worst, integral), float(t[-1]) if len(t) else before.t
        own = integral[-1] if integral is not None and len(t) else before.integral
        self._carried = Carried(before.rows + len(times), now, own, until, rest)
        self._new, self._columns = [], None
        self._blocks.append(block)
        self._shown.append(shown)
        self._rows.append(rows)
        self._settled += block.count
        self._count_rows += len(t)

    def _times(self, end: np.ndarray) -> tuple[np.ndarray, bool]:
        """The rows of pieces with these ends, and whether the last one of the run is among them."""
        if self.times is None:
            return np.minimum(end, self.until), bool(end[-1] >= self.until)
        stop = bisect_right(self.times, end[-1])
        return np.array(self.times[self._carried.rows : stop]), stop == len(self.times)

    def _integrals(self, block: Block, l: np.ndarray, t: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The integral of the multipliers up to the end of the pieces, and up to times (k,) in them."""
        tau = block.tau
        whole = block.impulse + tau[:, None] * dense.integrals(l, np.arange(len(l)), (block.end - block.t) / tau)
        until = np.cumsum(np.vstack([self._carried.until[None], whole]), axis=0)
        part = tau[piece, None] * dense.integrals(l, piece, (t - block.t[piece]) / tau[piece])
        return until[-1], until[piece] + (block.impulse[piece] + part)

    # -- columns

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory, and the pieces as lists."""
        self._settle()
        if self._columns is None:
            self._columns = self._read()
        return dict(self._columns)

    def _read(self) -> dict[str, np.ndarray]:
        states, first, own = self.problem.states, int(self.starts), self._facts
        if not self._blocks:
            return self._start_alone() | self._lists(_nothing(self.problem, self.orders))
        block, rows = Block.joined(self._blocks), _Rows.joined(self._rows)
        lists = self._lists(block)
        t, number = np.concatenate([np.zeros(first), rows.t]), np.concatenate([np.zeros(first, int), rows.piece])
        s = dense.local(lists, number, t)
        both = dense.polynomials(block.series[:, : own.n + own.m], number, s)
        full, l = both[:, : own.n], both[:, own.n :]
        multipliers = l.copy() if self._out is None else dense.polynomials(lists["piece_multipliers"], number, s)
        full[:first] = own.x0
        ends = np.flatnonzero(rows.t == block.end[rows.piece])
        free = own.n - self.problem.held  # What is held has jumped at an edge.
        full[ends + first, :free] = block.last[rows.piece[ends], :free]
        arrays: dict[str, np.ndarray] = {
            "t": t, "x": full[:, :states], "multipliers": multipliers, "index_set": lists["piece_codes"][number],
            "step": t - np.concatenate([[math.nan if first else self._before.t], t[:-1]]),
            "stepped": lists["piece_stepped"][number], "error_estimate": np.concatenate([np.zeros(first), rows.worst]),
        }  # fmt: skip
        h, records = self._records(t, both)
        residual = self._residuals(l[first:], h[first:], block, rows.piece)
        arrays |= {"residual": np.concatenate([np.zeros(first), residual]), **records}
        if rows.integral is not None:
            arrays["reactions"] = multipliers
            integrals = np.concatenate([np.repeat(self._before.integral[None], first + 1, axis=0), rows.integral])
            arrays["multipliers"] = np.diff(integrals, axis=0)
        if first:
            for name in ("multipliers", "y", "residual", "error_estimate", "reactions"):
                if name in arrays:
                    arrays[name][0] = np.nan
            arrays["index_set"][0], arrays["stepped"][0] = dense.UNKNOWN, False
        return arrays | lists

    def _start_alone(self) -> dict[str, np.ndarray]:
        """The one row of a run that has no piece yet."""
        p, own = self.problem, self._facts
        unknown = {name: np.full(1, np.nan) for name in ("residual", "step", "error_estimate")}
        return {
            "t": np.zeros(1), "x": own.x0[None, : p.states].copy(),
            **{name: np.full((1, own.shown), np.nan) for name in ("multipliers", "y")},
            "index_set": np.full((1, own.m), dense.UNKNOWN, np.int8), "stepped": np.zeros(1, bool), **unknown,
        }  # fmt: skip

    def _lists(self, block: Block) -> dict[str, np.ndarray]:
        none = (np.zeros((0, self._facts.shown, self.orders + 1)),) * 2
        l, y = self._shown[0] if len(self._shown) == 1 else map(np.concatenate, zip(*(self._shown or [none]), strict=True))
        return {
            "piece_start": block.t, "piece_unit": block.tau, "piece_x": np.ascontiguousarray(block.series[:, : self._facts.n]),
            "piece_multipliers": l, "piece_y": y, "piece_codes": block.codes, "piece_event": block.event,
            "piece_event_width": block.event_width, "piece_impulse": block.impulse, "piece_stepped": block.stepped,
        }  # fmt: skip

    def _residuals(self, l: np.ndarray, y: np.ndarray, block: Block, number: np.ndarray) -> np.ndarray:
        """How far each row is from its law where that is algebraic (y depends on l) or curved, beside the sizes of y and l.

        Of a row by a time step it is the residual of that.
        """
        own, of_law = self._facts, np.zeros(len(number))
        if own.direct.any():
            codes = block.codes[number]
            off = np.where(codes == 0, np.abs(y), np.maximum(codes * y, 0)) / np.maximum(block.size_y[number], 1e-300)
            out = np.maximum(np.maximum(own.lower - l, l - own.upper), 0) / np.maximum(block.size_l[number], 1e-300)
            of_law = (np.maximum(off, out) * own.direct).max(axis=1)
        for at, part in self._curved:
            of_law = np.maximum(of_law, _missed(part, l[:, at], y[:, at], block.size_y[number][:, at]))
        return np.where(block.stepped[number], block.residual[number], of_law)

    def _records(self, t: np.ndarray, both: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Rows of h, and the columns that are expressions of t, x and l: y, and those of the class; ``both``: x and l."""
        before = t * (1 - SAME_TIME)  # At an edge a row has the values before it.
        values, at, found = self._tell(np.column_stack([before, both])), self._facts.m, {}
        for name, size in self._facts.columns.items():
            found[name] = values[:, at] if name == "energy" else values[:, at : at + size]
            at += size
        return values[:, : self._facts.m], found

    # -- for files

    def standing(self) -> dict[str, Any]:
        """What is carried on to the next rows."""
        c = self.carried
        return {"rows": c.rows, "t": c.t, "integral": c.integral.tolist(), "until": c.until.tolist(), "worst": c.worst}

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        integral, until = (np.array(saved[name], float) for name in ("integral", "until"))
        self._carried = self._before = Carried(saved["rows"], saved["t"], integral, until, saved["worst"])
        self.starts = False


def _missed(part: laws.Block, l: np.ndarray, y: np.ndarray, size: np.ndarray) -> np.ndarray:
    """How far rows are from -y ∈ N_K(l): l outside K, beside K, and the largest <l - l', y>, l' ∈ K, beside K and y."""
    outside = part.excess(l).max(axis=1) / part.extent
    least = np.einsum("kni,ni->kn", part.rivals(l, y), y).min(axis=0)
    return np.maximum(outside, ((l * y).sum(axis=1) - least) / (part.extent * np.maximum(size.max(axis=1), 1e-300)))


def _worst(before: float, defects: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, float]:
    """The largest estimate from the piece of the row before to that of each row; and since the last row."""
    all_of = np.zeros(len(defects) + 2)
    all_of[0], all_of[1:-1] = before, defects
    if len(piece) == len(defects) and (piece == np.arange(len(piece))).all():  # the rows are the ends of the pieces
        return np.maximum(all_of[:-2], all_of[1:-1]), float(all_of[-2])
    if not len(piece):
        return np.zeros(0), float(all_of.max())
    pairs = np.zeros((len(piece), 2), int)
    pairs[1:, 0], pairs[:, 1] = piece[:-1] + 1, piece + 2
    return np.maximum.reduceat(all_of, pairs.ravel())[::2], float(all_of[piece[-1] + 1 :].max())


def _nothing(p: ContinuousProblem, orders: int) -> Block:
    layout = Layout(p.x.numel(), p.l.numel(), orders + 1)
    return Block(np.zeros((0, layout.width)), layout)


def _shown(block: Block) -> tuple[np.ndarray, np.ndarray]:
    """The series of l and y."""
    n, m, _ = block.layout
    series = block.series
    return np.ascontiguousarray(series[:, n : n + m]), np.ascontiguousarray(series[:, n + m :])


def _outputs(p: ContinuousProblem, orders: int) -> Expansion | None:
    """The series of the user's own multipliers and outputs, where they are not those of the rows."""
    if p.multipliers is None or p.outputs is None:
        return None
    jets = jets_of(ca.vertcat(p.multipliers, p.outputs), [p.t, p.x, p.l], "multipliers and outputs")
    return Expansion(jets, orders, None)


def _expanded(out: Expansion, block: Block, count: int) -> tuple[np.ndarray, np.ndarray]:
    rows = np.stack([_series(out, piece) for piece in block.pieces()])
    return rows[:, :count], rows[:, count:]


def _series(out: Expansion, piece: Piece) -> np.ndarray:
    count = piece.x.shape[1]
    given = {(0, 0): [piece.t, piece.tau, *[0.0] * (count - 2)]}
    given |= {(1, i): row for i, row in enumerate(piece.x.tolist())} | {(2, i): row for i, row in enumerate(piece.l.tolist())}
    for place, row in out.jets.inputs.items():
        out.rows[row][:] = given[place]
    out.choice[:] = [math.nan] * len(out.choice)
    for k in range(count):
        out.order(k)
    return np.array(out.outputs)
