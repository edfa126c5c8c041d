"""The rows of an event-driven run in memory, and the pieces that they are read off.

What rows of an event-driven run need to know of their problem, as numbers: read off its expressions once.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import get_ident
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object, cached_per_object_and_key
from nsmodel.event_driven import dense_output
from nsmodel.event_driven.integrator import operation_count
from nsmodel.event_driven.piece import Piece
from nsmodel.event_driven.problem import SAME_TIME, ContinuousProblem
from nsmodel.event_driven.recurrence_code import TaylorExpansion
from nsmodel.event_driven.recurrences import is_switched, taylor_decompose
from nsmodel.event_driven.step_size import SMALL
from nsmodel.modeling import laws
from nsmodel.proof.verdict import attach_buffers
from nsmodel.simulation.piece_sources import PieceBuffer, PieceLayout
from nsmodel.simulation.propagator import CHUNK_BYTES
from nsmodel.solvers.step import UNKNOWN_INDEX


@dataclass(frozen=True)
class RowProperties:
    """Of a problem with n states of the motion and m rows of the law.

    Attributes:
        n, m: numbers of x and l.
        shown: of the multipliers that a user sees.
        x0: the start (n,).
        lower, upper: the ends of the law (m,).
        direct: which y depend on l directly (m,).
        columns: {name: entries} of the columns that are expressions of t, x and l, behind the m of h.
        operations: of f, g and h; is_switched: whether some of them are not analytic.
    """

    n: int
    m: int
    visible_multipliers: int
    x0: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    direct: np.ndarray
    columns: dict[str, int]
    operations: int
    is_switched: bool


@cached_per_object
def row_properties(p: ContinuousProblem) -> RowProperties:
    """Return what rows of runs of the problem hold."""
    m = p.l.numel()
    direct = set(ca.jacobian_sparsity(p.h, p.l).row()) if m else set()
    x0, lower, upper = (np.array(ca.DM(column)).ravel() for column in (p.x0, p.law.lower, p.law.upper))
    return RowProperties(
        p.x.numel(), m, len(p.rows if p.multipliers is None else p.declared), x0, lower, upper,
        np.array([i in direct for i in range(m)], bool), {name: e.numel() for name, e in p.columns.items()},
        operation_count(p), is_switched(ca.veccat(p.f, p.g, p.h)),
    )  # fmt: skip


def row_columns_function(p: ContinuousProblem) -> Callable[[np.ndarray], np.ndarray]:
    """(h, y, records) of rows (t, x, l), evaluated by CasADi."""
    function, of_many = _row_record_functions(p)

    def evaluate_columns(rows: np.ndarray) -> np.ndarray:
        if not (count := len(rows)):
            return np.zeros((0, function.numel_out()))
        if count not in of_many:
            of_many.clear()
            of_many[count] = function.map(count)
        given, found = np.asfortranarray(rows.T, float), np.zeros((function.numel_out(), count), order="F")
        _buffer, call = attach_buffers(of_many[count], [given], [found])  # as long as these three live
        call()
        return found.T

    return evaluate_columns


@cached_per_object
def _row_record_functions(p: ContinuousProblem) -> tuple[ca.Function, dict[int, ca.Function]]:
    """The function of (t, x, l), and the same of the last number of rows."""
    return ca.Function("records", [ca.vertcat(p.t, p.x, p.l)], [ca.densify(ca.veccat(p.h, *p.columns.values()))]), {}


ColumnFunction = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class CarriedState:
    """What the rows that are written leave for the next: how many, the last one's time and integral of the multipliers.

    ``until``: that integral up to the next piece; ``worst``: the largest estimate of the pieces since the last row; ``held``: the
    states that blocks and signals hold just after the last row, None where that is known by the next piece.
    """

    rows: int
    t: float
    integral: np.ndarray
    until: np.ndarray
    worst: float = 0.0
    held: np.ndarray | None = None


class _EventDrivenRows(NamedTuple):
    """Rows: times, pieces among those in memory, the largest estimate since the row before; integrals of l where asked."""

    t: np.ndarray
    piece: np.ndarray
    worst: np.ndarray
    integral: np.ndarray | None

    @classmethod
    def concatenate(cls, rows: Sequence[_EventDrivenRows]) -> _EventDrivenRows:
        """One after the other."""
        if len(rows) == 1:
            return rows[0]
        t, piece, worst, integral = zip(*rows, strict=True)
        whole = None if integral[0] is None else np.concatenate(integral)
        return cls(np.concatenate(t), np.concatenate(piece), np.concatenate(worst), whole)


class PieceRows:
    """Rows in memory: every n-th of those that ``take`` is given, of pieces that are all kept."""

    def __init__(
        self, problem: ContinuousProblem, orders: int, every: int, until: float, times: list[float] | None,
        columns: ColumnFunction | None,
    ) -> None:  # fmt: skip
        """``until``: the end of the run, and the last of the ``times`` of its rows; None: the ends of pieces.

        ``columns``: (h, y, records) side by side of rows (t, x, l), where these are computed elsewhere.
        """
        self.problem, self.orders, self.every, self.until, self.times = problem, orders, every, until, times
        self._facts = row_properties(problem)
        self._curved = [(at, part) for at, part in problem.law.parts() if part.curved() is not None]
        self._evaluate_columns = columns or row_columns_function(problem)
        nothing = np.zeros(self._facts.visible_multipliers)
        self._carried = CarriedState(0, 0.0, nothing, nothing)
        self.starts = True  # Whether the row of the start is among those in memory.
        self._blocks: list[PieceBuffer] = []
        self._new: list[PieceBuffer] = []  # Of which the rows are not known yet.
        self.clear()

    @property
    def _out(self) -> TaylorExpansion | None:
        return _output_expansion(self.problem, (self.orders, get_ident()))

    def clear(self) -> None:
        """Forget the rows."""
        if self._blocks:
            self.starts = False
        self._blocks, self._rows, self._user_series = [], [], []
        self.count = self._counted_pieces = self._count_rows = 0
        self._before = self._carried
        self._columns: dict[str, np.ndarray] | None = None

    @property
    def carried(self) -> CarriedState:
        """What the rows so far leave for the next."""
        self._process_new_pieces()
        return self._carried

    def held_at_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The states that are held just before each row, and just after the row before it: (k, held) each."""
        self._process_new_pieces()
        block = PieceBuffer.concatenate(self._blocks)
        held, t = self._held(block), np.concatenate([[self._before.t], *(rows.t for rows in self._rows)])
        after = held[np.minimum(np.searchsorted(block.end, t[:-1], side="right"), len(held) - 1)]
        if len(after) and self._before.held is not None:
            after[0] = self._before.held
        first = held[:1] if self.starts else held[:0]
        return np.vstack([first, held[self.numbers[int(self.starts) :]]]), np.vstack([first, after])

    @property
    def pieces(self) -> list[Piece]:
        """The pieces in memory, one by one."""
        self._process_new_pieces()
        return [piece for block in self._blocks for piece in block.pieces()]

    @property
    def buffer(self) -> PieceBuffer:
        """The pieces in memory as they were recorded."""
        self._process_new_pieces()
        return PieceBuffer.concatenate(self._blocks)

    @property
    def filled(self) -> int:
        """Rows in memory."""
        self._process_new_pieces()
        return self._count_rows + self.starts

    @property
    def numbers(self) -> np.ndarray:
        """The piece of each row, among those in memory."""
        self._process_new_pieces()
        return np.concatenate([np.zeros(int(self.starts), int), *(rows.piece for rows in self._rows)])

    @property
    def full(self) -> bool:
        """Whether they fill a chunk."""
        n, m = self._facts.n, self._facts.m
        return self.count * (n + 2 * m) * 8 * (self.orders + 1) > CHUNK_BYTES

    def take(self, block: PieceBuffer) -> None:
        """Keep pieces, and of the rows in them every n-th, and the last one of the run."""
        self._new.append(block)
        self.count += block.count

    def _process_new_pieces(self) -> None:
        """Find the rows of the pieces that were taken."""
        if not self._new:
            return
        block, before = PieceBuffer.concatenate(self._new), self._carried
        end, series = (
            block.end,
            _multiplier_output_series(block)
            if self._out is None
            else _expand_outputs(self._out, block, self._facts.visible_multipliers),
        )
        times, last = self._row_times(end)
        t = times
        if self.every > 1:
            keep = (before.rows + np.arange(1, len(times) + 1)) % self.every == 0
            if last and len(times):
                keep[-1] = True
            t = times[keep]
        piece = np.minimum(np.searchsorted(end, t, side="left"), len(end) - 1)
        until, integral = (
            self._multiplier_integrals(block, series[0], t, piece) if self.problem.impulses else (before.until, None)
        )
        worst, rest = _largest_estimates(before.worst, block.defect, piece)
        rows, now = _EventDrivenRows(t, piece + self._counted_pieces, worst, integral), float(t[-1]) if len(t) else before.t
        own = integral[-1] if integral is not None and len(t) else before.integral
        self._carried = CarriedState(before.rows + len(times), now, own, until, rest, self._held_after(block, t))
        self._new, self._columns = [], None
        self._blocks.append(block)
        self._user_series.append(series)
        self._rows.append(rows)
        self._counted_pieces += block.count
        self._count_rows += len(t)

    def _held_after(self, block: PieceBuffer, t: np.ndarray) -> np.ndarray | None:
        """What is held just after the last row, of times t in these pieces or before them; None: in the next piece."""
        if not len(t) and self._carried.held is not None:
            return self._carried.held
        piece = np.searchsorted(block.end, t[-1], side="right") if len(t) else 0
        return self._held(block)[piece].copy() if piece < block.count else None

    def _held(self, block: PieceBuffer) -> np.ndarray:
        n = self.problem.x.numel()
        return block.series[:, n - self.problem.held : n, 0]

    def _row_times(self, end: np.ndarray) -> tuple[np.ndarray, bool]:
        """The rows of pieces with these ends, and whether the last one of the run is among them."""
        if self.times is None:
            return np.minimum(end, self.until), bool(end[-1] >= self.until)
        stop = bisect_right(self.times, end[-1])
        return np.array(self.times[self._carried.rows : stop]), stop == len(self.times)

    def _multiplier_integrals(
        self, block: PieceBuffer, l: np.ndarray, t: np.ndarray, piece: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The integral of the multipliers up to the end of the pieces, and up to times (k,) in them."""
        tau = block.tau
        whole = block.impulse + tau[:, None] * dense_output.integrate_polynomials(
            l, np.arange(len(l)), (block.end - block.t) / tau
        )
        until = np.cumsum(np.vstack([self._carried.until[None], whole]), axis=0)
        part = tau[piece, None] * dense_output.integrate_polynomials(l, piece, (t - block.t[piece]) / tau[piece])
        return until[-1], until[piece] + (block.impulse[piece] + part)

    # -- columns

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory, and the pieces as lists."""
        self._process_new_pieces()
        if self._columns is None:
            self._columns = self._build_columns()
        return dict(self._columns)

    def _build_columns(self) -> dict[str, np.ndarray]:
        states, first, own = self.problem.states, int(self.starts), self._facts
        if not self._blocks:
            return self._start_row() | self._piece_lists(_empty_buffer(self.problem, self.orders))
        block, rows = PieceBuffer.concatenate(self._blocks), _EventDrivenRows.concatenate(self._rows)
        lists = self._piece_lists(block)
        t, number = np.concatenate([np.zeros(first), rows.t]), np.concatenate([np.zeros(first, int), rows.piece])
        s = dense_output.local_times(lists, number, t)
        both = dense_output.evaluate_polynomials(block.series[:, : own.n + own.m], number, s)
        full, l = both[:, : own.n], both[:, own.n :]
        multipliers = l.copy() if self._out is None else dense_output.evaluate_polynomials(lists["piece_multipliers"], number, s)
        full[:first] = own.x0
        ends = np.flatnonzero(rows.t == block.end[rows.piece])
        free = own.n - self.problem.held  # What is held has jumped at an edge.
        full[ends + first, :free] = block.last[rows.piece[ends], :free]
        arrays: dict[str, np.ndarray] = {
            "t": t, "x": full[:, :states], "multipliers": multipliers, "index_set": lists["piece_codes"][number],
            "step": t - np.concatenate([[math.nan if first else self._before.t], t[:-1]]),
            "stepped": lists["piece_stepped"][number], "error_estimate": np.concatenate([np.zeros(first), rows.worst]),
        }  # fmt: skip
        h, records = self._evaluate_records(t, both)
        residual = self._row_residuals(l[first:], h[first:], block, rows.piece)
        arrays |= {"residual": np.concatenate([np.zeros(first), residual]), **records}
        if rows.integral is not None:
            arrays["reactions"] = multipliers
            integrals = np.concatenate([np.repeat(self._before.integral[None], first + 1, axis=0), rows.integral])
            arrays["multipliers"] = np.diff(integrals, axis=0)
        if first:
            for name in ("multipliers", "y", "residual", "error_estimate", "reactions"):
                if name in arrays:
                    arrays[name][0] = np.nan
            arrays["index_set"][0], arrays["stepped"][0] = UNKNOWN_INDEX, False
        return arrays | lists

    def _start_row(self) -> dict[str, np.ndarray]:
        """The one row of a run that has no piece yet."""
        p, own = self.problem, self._facts
        _, records = self._evaluate_records(np.zeros(1), np.concatenate([own.x0, np.full(own.m, np.nan)])[None])
        unknown = {name: np.full(1, np.nan) for name in ("residual", "step", "error_estimate")}
        of_law = ("multipliers", "y", "reactions") if p.impulses else ("multipliers", "y")
        return {
            "t": np.zeros(1), "x": own.x0[None, : p.states].copy(), **records,
            **{name: np.full((1, own.visible_multipliers), np.nan) for name in of_law},
            "index_set": np.full((1, own.m), UNKNOWN_INDEX, np.int8), "stepped": np.zeros(1, bool), **unknown,
        }  # fmt: skip

    def _piece_lists(self, block: PieceBuffer) -> dict[str, np.ndarray]:
        none = (np.zeros((0, self._facts.visible_multipliers, self.orders + 1)),) * 2
        l, y = (
            self._user_series[0]
            if len(self._user_series) == 1
            else map(np.concatenate, zip(*(self._user_series or [none]), strict=True))
        )
        return {
            "piece_start": block.t, "piece_unit": block.tau, "piece_x": np.ascontiguousarray(block.series[:, : self._facts.n]),
            "piece_multipliers": l, "piece_y": y, "piece_codes": block.codes, "piece_event": block.event,
            "piece_event_width": block.event_width, "piece_impulse": block.impulse, "piece_stepped": block.stepped,
        }  # fmt: skip

    def _row_residuals(self, l: np.ndarray, y: np.ndarray, block: PieceBuffer, number: np.ndarray) -> np.ndarray:
        """How far each row is from its law where that is algebraic (y depends on l) or curved, beside the sizes of y and l.

        Of a row by a time step it is the residual of that.
        """
        own, of_law = self._facts, np.zeros(len(number))
        if own.direct.any():
            codes = block.codes[number]
            size_y, size_l = (self._sizes_of_tied_rows(size)[number] for size in (block.size_y, block.size_l))
            off = np.where(codes == 0, np.abs(y), np.maximum(codes * y, 0)) / size_y
            out = np.maximum(np.maximum(own.lower - l, l - own.upper), 0) / size_l
            of_law = (np.maximum(off, out) * own.direct).max(axis=1)
        for at, part in self._curved:
            of_law = np.maximum(of_law, _curved_law_residual(part, l[:, at], y[:, at], block.size_y[number][:, at]))
        return np.where(block.stepped[number], block.residual[number], of_law)

    def _sizes_of_tied_rows(self, sizes: np.ndarray) -> np.ndarray:
        """Sizes (k, m), of each row SMALL of the largest of those that it is tied to, at least."""
        direct = sizes * self._facts.direct
        largest = np.stack([direct[:, group].max(axis=1) for group in self.problem.row_groups], axis=1)
        return np.maximum(sizes, SMALL * largest + 1e-300)

    def _evaluate_records(self, t: np.ndarray, both: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Rows of h, and the columns that are expressions of t, x and l: y, and those of the class; ``both``: x and l."""
        before = t * (1 - SAME_TIME)  # At an edge a row has the values before it.
        values, at, found = self._evaluate_columns(np.column_stack([before, both])), self._facts.m, {}
        for name, size in self._facts.columns.items():
            found[name] = values[:, at] if name == "energy" else values[:, at : at + size]
            at += size
        return values[:, : self._facts.m], found

    # -- for files

    def checkpoint(self) -> dict[str, Any]:
        """What is carried on to the next rows."""
        c = self.carried
        held = None if c.held is None else c.held.tolist()
        lists = {"integral": c.integral.tolist(), "until": c.until.tolist(), "held": held}
        return {"rows": c.rows, "t": c.t, "worst": c.worst, **lists}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        integral, until = (np.array(saved[name], float) for name in ("integral", "until"))
        held = None if saved.get("held") is None else np.array(saved["held"], float)
        self._carried = self._before = CarriedState(saved["rows"], saved["t"], integral, until, saved["worst"], held)
        self.starts = False


def _curved_law_residual(part: laws.LawFactor, l: np.ndarray, y: np.ndarray, size: np.ndarray) -> np.ndarray:
    """How far rows are from -y ∈ N_K(l): l outside K, beside K, and the largest <l - l', y>, l' ∈ K, beside K and y."""
    outside = part.excess(l).max(axis=1) / part.extent
    least = np.einsum("kni,ni->kn", part.rivals(l, y), y).min(axis=0)
    return np.maximum(outside, ((l * y).sum(axis=1) - least) / (part.extent * np.maximum(size.max(axis=1), 1e-300)))


def _largest_estimates(before: float, defects: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, float]:
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


def _empty_buffer(p: ContinuousProblem, orders: int) -> PieceBuffer:
    layout = PieceLayout(p.x.numel(), p.l.numel(), orders + 1)
    return PieceBuffer(np.zeros((0, layout.width)), layout)


def _multiplier_output_series(block: PieceBuffer) -> tuple[np.ndarray, np.ndarray]:
    """The series of l and y."""
    n, m, _ = block.layout
    series = block.series
    return np.ascontiguousarray(series[:, n : n + m]), np.ascontiguousarray(series[:, n + m :])


@cached_per_object_and_key(most=8)
def _output_expansion(p: ContinuousProblem, of: tuple[int, int]) -> TaylorExpansion | None:
    """The series of the user's own multipliers and outputs, where they are not those of the rows; ``of``: orders, and a thread.

    Threads share none: each expansion of a piece writes to its rows.
    """
    if p.multipliers is None or p.outputs is None:
        return None
    orders, _ = of
    jets = taylor_decompose(ca.vertcat(p.multipliers, p.outputs), [p.t, p.x, p.l], "multipliers and outputs")
    return TaylorExpansion(jets, orders, None)


def _expand_outputs(out: TaylorExpansion, block: PieceBuffer, count: int) -> tuple[np.ndarray, np.ndarray]:
    rows = np.stack([_expanded_series(out, piece) for piece in block.pieces()])
    return rows[:, :count], rows[:, count:]


def _expanded_series(out: TaylorExpansion, piece: Piece) -> np.ndarray:
    count = piece.x.shape[1]
    given = {(0, 0): [piece.t, piece.tau, *[0.0] * (count - 2)]}
    given |= {(1, i): row for i, row in enumerate(piece.x.tolist())} | {(2, i): row for i, row in enumerate(piece.l.tolist())}
    for place, row in out.jets.inputs.items():
        out.rows[row][:] = given[place]
    out.choice[:] = [math.nan] * len(out.choice)
    for k in range(count):
        out.order(k)
    return np.array(out.outputs)
