"""The rows of an event-driven run in memory, and the pieces that they are read off."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel import dense
from nsmodel.pieces.expansion import Expansion
from nsmodel.pieces.jets import jets_of
from nsmodel.pieces.piece import Piece
from nsmodel.pieces.system import System
from nsmodel.run.walk import CHUNK_BYTES
from nsmodel.scheme.continuous import ContinuousProblem


class Row(NamedTuple):
    """A time, the number of its piece among those in memory, the largest estimate since the row before; and the sizes of y and l.

    ``integral``: of the multipliers, from the start of the run.
    """

    t: float
    piece: int
    worst: float
    sizes: tuple[list[float], list[float]]
    integral: np.ndarray


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


class PieceRows:
    """Rows in memory: every n-th of those that ``take`` is given, of pieces that are all kept; see `walk.RowBuffer`."""

    def __init__(self, problem: ContinuousProblem, system: System, every: int) -> None:
        self.problem, self.system, self.every = problem, system, every
        self._out = _outputs(problem, system.orders)
        self._names = len(problem.rows if problem.multipliers is None else problem.declared)
        nothing = np.zeros(self._names)
        self.carried = Carried(0, 0.0, nothing, nothing)
        self.starts = True  # Whether the row of the start is among those in memory.
        self.clear()

    def clear(self) -> None:
        """Forget the rows."""
        if self.__dict__.get("pieces"):
            self.starts = False
        self.pieces: list[Piece] = []
        self.rows: list[Row] = []
        self._before = self.carried
        self._shown: list[tuple[np.ndarray, np.ndarray]] = []
        self._columns: dict[str, np.ndarray] | None = None

    @property
    def filled(self) -> int:
        """Rows in memory."""
        return len(self.rows) + self.starts

    @property
    def numbers(self) -> np.ndarray:
        """The piece of each row, among those in memory."""
        return np.array([*[0] * self.starts, *(row.piece for row in self.rows)], int)

    @property
    def full(self) -> bool:
        """Whether they fill a chunk."""
        return len(self.pieces) * (self.system.n + 2 * self.system.m) * 8 * (self.system.orders + 1) > CHUNK_BYTES

    def take(self, piece: Piece, times: list[float], last: bool) -> None:
        """Keep a piece, and of the rows at these times in it every n-th, and the ``last`` one."""
        self.pieces.append(piece)
        self._columns = None
        l, y = (piece.l, piece.y) if self._out is None else _expanded(self._out, piece, self._names)
        self._shown.append((l, y))
        until = self.carried.until
        if piece.event is not None and self.problem.impulses:
            until = until + np.array(piece.event)
        self.carried = now = replace(self.carried, until=until, worst=max(self.carried.worst, piece.defect))
        sizes = self._sizes()
        for i, t in enumerate(times):
            now = replace(now, rows=now.rows + 1)
            if now.rows % self.every == 0 or (last and i == len(times) - 1):
                integral = now.until + self._integral(l, piece, t)
                self.rows.append(Row(t, len(self.pieces) - 1, now.worst, sizes, integral))
                now = replace(now, t=t, integral=integral, worst=piece.defect)
        self.carried = replace(now, until=now.until + self._integral(l, piece, piece.end))

    def _sizes(self) -> tuple[list[float], list[float]]:
        """What residuals of y and of l are measured beside."""
        system, direct = self.system, self.system.feedthrough
        of_y = [system.size_y(i) if direct[i] else 1.0 for i in range(system.m)]
        return of_y, [system.size_l(i) if direct[i] else 1.0 for i in range(system.m)]

    def _integral(self, l: np.ndarray, piece: Piece, t: float) -> np.ndarray:
        """Of the multipliers from the start of the piece to t."""
        if not self.problem.impulses:
            return self.carried.until
        return piece.tau * dense.integrals(l[None], np.array([(t - piece.t) / piece.tau]))[0]

    # -- columns

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory, and the pieces as lists."""
        if self._columns is None:
            self._columns = self._read()
        return dict(self._columns)

    def _read(self) -> dict[str, np.ndarray]:
        lists, n, first = self._lists(), self.problem.states, int(self.starts)
        if not self.pieces:
            return self._start_alone() | lists
        t = np.array([*[0.0] * first, *(row.t for row in self.rows)])
        number = self.numbers
        found = dense.at({"t": t, "x": np.empty((len(t), n))} | lists, t, number)
        full = np.hstack([found.x, found.v])
        full[:first] = np.array(ca.DM(self.problem.x0)).T
        for i, row in enumerate(self.rows, first):
            if row.t == self.pieces[row.piece].end:
                full[i] = self.pieces[row.piece].last
        before = math.nan if first else self._before.t
        arrays: dict[str, np.ndarray] = {
            "t": t, "x": full[:, :n], "multipliers": found.multipliers, "index_set": lists["piece_codes"][number],
            "step": np.diff(t, prepend=before), "stepped": lists["piece_stepped"][number],
            "error_estimate": np.array([*[0.0] * first, *(row.worst for row in self.rows)]),
        }  # fmt: skip
        l, h, records = self._records(t, full, number, dense.local(lists, number, t))
        arrays |= {"residual": np.r_[[0.0] * first, self._residuals(l[first:], h[first:])], **records}
        if self.problem.impulses:
            arrays["reactions"] = arrays["multipliers"].copy()
            integrals = np.array([*[self._before.integral] * (first + 1), *(row.integral for row in self.rows)])
            arrays["multipliers"] = np.diff(integrals, axis=0)
        for name in ("multipliers", "y", "residual", "error_estimate", "reactions"):
            if name in arrays:
                arrays[name][:first] = np.nan
        arrays["index_set"][:first] = dense.UNKNOWN
        arrays["stepped"][:first] = False
        return arrays | lists

    def _start_alone(self) -> dict[str, np.ndarray]:
        """The one row of a run that has no piece yet."""
        p, shown = self.problem, self._names
        unknown = {name: np.full(1, np.nan) for name in ("residual", "step", "error_estimate")}
        return {
            "t": np.zeros(1), "x": np.array(ca.DM(p.x0))[: p.states].T,
            **{name: np.full((1, shown), np.nan) for name in ("multipliers", "y")},
            "index_set": np.full((1, p.l.numel()), dense.UNKNOWN, np.int8), "stepped": np.zeros(1, bool), **unknown,
        }  # fmt: skip

    def _lists(self) -> dict[str, np.ndarray]:
        pieces, m, none = self.pieces, self.system.m, (0.0,) * self.system.m
        order, n, shown = self.system.orders + 1, len(self.problem.names), self._names
        return {
            "piece_start": np.array([p.t for p in pieces]), "piece_unit": np.array([p.tau for p in pieces]),
            "piece_x": np.array([p.x for p in pieces]).reshape(len(pieces), n, order),
            "piece_multipliers": np.array([l for l, _ in self._shown]).reshape(len(pieces), shown, order),
            "piece_y": np.array([y for _, y in self._shown]).reshape(len(pieces), shown, order),
            "piece_codes": np.array([p.codes for p in pieces], np.int8).reshape(len(pieces), m),
            "piece_event": np.array([p.event is not None for p in pieces], bool),
            "piece_stepped": np.array([p.residual is not None for p in pieces], bool),
            "piece_impulse": np.array([none if p.event is None else p.event for p in pieces], float).reshape(len(pieces), m),
        }  # fmt: skip

    def _residuals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How far each row is from its law where that is algebraic (y depends on l directly), beside the sizes of y and l."""
        system, rows = self.system, self.rows
        codes = np.array([self.pieces[row.piece].codes for row in rows]).reshape(len(rows), system.m)
        of_y, of_l = (np.array([row.sizes[k] for row in rows]).reshape(len(rows), system.m) for k in (0, 1))
        off = np.where(codes == 0, np.abs(y), np.maximum(codes * y, 0)) / np.maximum(of_y, 1e-300)
        out = np.maximum(np.maximum(system.lower - l, l - system.upper), 0) / np.maximum(of_l, 1e-300)
        of_law = (np.maximum(off, out) * system.feedthrough).max(axis=1, initial=0.0)
        of_step = (self.pieces[row.piece].residual for row in rows)
        return np.array([law if step is None else step for law, step in zip(of_law, of_step, strict=True)])

    def _records(
        self, t: np.ndarray, x: np.ndarray, number: np.ndarray, s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """What the law speaks of, l and h, and the columns that are expressions of t, x and l: y, and those of the class."""
        p = self.problem
        l = dense.polynomials(np.array([piece.l for piece in self.pieces])[number], s)
        columns = {"y": p.h if p.outputs is None else p.outputs, **p.records}
        function = ca.Function("records", [p.t, p.x, p.l], [ca.densify(e) for e in (p.h, *columns.values())]).map(len(t))
        values = function.call([ca.DM(t[None]), ca.DM(x.T), ca.DM(l.T) if p.l.numel() else ca.DM(0, len(t))])
        h, *found = (np.array(v).T for v in values)
        return l, h, {name: v[:, 0] if name == "energy" else v for name, v in zip(columns, found, strict=True)}

    # -- for files

    def standing(self) -> dict[str, Any]:
        """What is carried on to the next rows."""
        c = self.carried
        return {"rows": c.rows, "t": c.t, "integral": c.integral.tolist(), "until": c.until.tolist(), "worst": c.worst}

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        integral, until = (np.array(saved[name], float) for name in ("integral", "until"))
        self.carried = self._before = Carried(saved["rows"], saved["t"], integral, until, saved["worst"])
        self.starts = False


def _outputs(p: ContinuousProblem, orders: int) -> Expansion | None:
    """The series of the user's own multipliers and outputs, where they are not those of the rows."""
    if p.multipliers is None or p.outputs is None:
        return None
    jets = jets_of(ca.vertcat(p.multipliers, p.outputs), [p.t, p.x, p.l], "multipliers and outputs")
    return Expansion(jets, orders, None)


def _expanded(out: Expansion, piece: Piece, count: int) -> tuple[np.ndarray, np.ndarray]:
    given = {(0, 0): [piece.t, piece.tau, *[0.0] * (piece.x.shape[1] - 2)]}
    given |= {(1, i): row for i, row in enumerate(piece.x.tolist())} | {(2, i): row for i, row in enumerate(piece.l.tolist())}
    for place, row in out.jets.inputs.items():
        out.rows[row][:] = given[place]
    out.choice[:] = [math.nan] * len(out.choice)
    for k in range(piece.x.shape[1]):
        out.order(k)
    rows = np.array(out.outputs)
    return rows[:count], rows[count:]
