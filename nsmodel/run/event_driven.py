"""The walk of event-driven integration: its rows are the ends of pieces, or the times asked for, read off the polynomials."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import dense
from nsmodel.classes.registry import class_of
from nsmodel.errors import StepError
from nsmodel.grid import Grid, check_times
from nsmodel.hypotheses.quick import refuse_start, warnings_of
from nsmodel.identity import settings
from nsmodel.model.base import Model
from nsmodel.pieces.expansion import Expansion
from nsmodel.pieces.integrator import Integrator, Piece
from nsmodel.pieces.jets import jets_of
from nsmodel.run.asked import times, tolerances
from nsmodel.run.options import METHODS, Options
from nsmodel.run.walk import check_exact, note_distance_to_exact, runaway
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.solve.choose import Plan

METHOD = METHODS[1]
MOST = 10_000_000  # Pieces after which a run stops.
LARGE = 10_000  # Operations of f, g and h up to which "auto" is event-driven.


def problem_of(model: Model) -> ContinuousProblem:
    """Return the model in continuous time, as this method takes it.

    Raises:
        NotEventDriven: what it cannot take, by name.
    """
    module = class_of(model).optional("continuous")
    if module is None:
        raise NotEventDriven("many bodies change their contacts at nearly every step; they are for time stepping")
    problem = module.continuous_problem(model)
    curved = [block.label for _, block in problem.law.parts() if not block.separable]
    if curved:
        raise NotEventDriven(f"the law '{curved[0]}' is no box; its sets are for time stepping")
    return problem


class EventDriven:
    """The walk of event-driven integration; see `walk.Walk`. Rows and pieces stay in memory."""

    N: int = MOST

    def __init__(self, model: Model, options: Options, problem: ContinuousProblem) -> None:
        check_times(t_end=options.t_end)
        self.model: Any = model
        self.options, self.problem = options, problem
        self.T = float(model.t_end if options.t_end is None else options.t_end)
        rtol, atol = tolerances(problem, options.rtol, options.atol)
        self.times = None if options.times is None else times(options.times, self.T)
        refuse_start(model)
        check_exact(model)
        _refuse_large(problem, options)
        self.integrator = Integrator(problem, rtol, atol)
        self._out = _outputs(self.integrator)
        self.pieces: list[Piece] = []
        self._shown: list[tuple[np.ndarray, np.ndarray]] = []
        self.rows: list[tuple[float, int]] = []  # (time, number of the piece)
        self.record, self.k = self, 0
        self.plan = _plan(self.integrator)
        self.warnings = warnings_of(model, self.plan)
        self.counts: Counter[str] = Counter()
        self.totals: dict[str, Any] = {
            "worst_residual": 0.0, "worst_residual_t": None, "index_set_changes": 0, "steps": 0, "rtol": rtol,
            "order": self.integrator.order, "pieces": 0, "events": 0, "worst_estimate": 0.0, "worst_estimate_t": None,
        }  # fmt: skip
        grid = Grid(1, self.T, self.T)
        self.settings = settings(model, grid, METHOD, options.tolerance, options.save_every, "interpreted") | {"rtol": rtol}

    # -- as the loop sees it

    @property
    def bar(self) -> dict[str, Any]:
        """Per cent."""
        return {"total": 100, "unit": "%", "bar_format": "{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"}

    @property
    def passed(self) -> float:
        """Per cent of the time."""
        return 100 * min(self.time / self.T, 1.0)

    @property
    def ended(self) -> bool:
        """Whether the pieces reach the end of the time."""
        return self.time >= self.T

    @property
    def time(self) -> float:
        """Where the next piece starts."""
        return self.integrator.t

    @property
    def h(self) -> float:
        """The unit of time of the next piece."""
        return self.integrator.place.tau

    @property
    def runaway(self) -> tuple[str, float] | None:
        """Name and value of the largest state, where it is beyond what can be computed with."""
        return runaway(self.problem.names, np.array(self.integrator.place.x))

    @property
    def filled(self) -> int:
        """Rows in memory."""
        return len(self.rows) + 1

    full = False

    def clear(self) -> None:
        """Rows stay."""

    def warm_up(self) -> None:
        """Everything is built."""

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Integrate so many pieces."""
        for _ in range(steps):
            if self.ended or stop:
                return
            piece = self.integrator.advance()
            if piece.end > piece.t:
                self._take(piece)
            if len(self.pieces) > MOST:
                raise StepError(f"{MOST:,} pieces, and more are needed: ask for less accuracy (rtol)")

    def _take(self, piece: Piece) -> None:
        number, totals, end = len(self.pieces), self.totals, min(piece.end, self.T)
        self.pieces.append(piece)
        self._shown.append((piece.l, piece.y) if self._out is None else _expanded(self._out, piece, self.problem.l.numel()))
        if self.times is None:
            self.rows.append((end, number))
        else:
            reached = len(self.rows)
            while reached < len(self.times) and self.times[reached] <= end:
                self.rows.append((self.times[reached], number))
                reached += 1
        self.k = len(self.rows)
        if piece.defect > totals["worst_estimate"]:
            totals["worst_estimate"], totals["worst_estimate_t"] = piece.defect, piece.t
        events = sum(event.t <= self.T for event in self.integrator.events[-2:])
        totals |= {"steps": self.k, "pieces": number + 1, "touches": self.integrator.touches}
        totals |= {"unique": dict(self.integrator.unique), "redundant": self.integrator.redundant}
        totals["events"] = totals["index_set_changes"] = len(self.integrator.events) - (len(self.integrator.events[-2:]) - events)

    def note(self) -> None:
        """The distance to the exact state, and the worst residual."""
        arrays = self.columns()
        note_distance_to_exact(self.model, self.totals, arrays["t"], arrays["x"])
        residual = np.nan_to_num(arrays["residual"])
        row = int(residual.argmax())
        self.totals |= {"worst_residual": float(residual[row]), "worst_residual_t": float(arrays["t"][row]) if row else None}

    # -- rows

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory, and the pieces as lists."""
        lists, (n, m) = self._lists(), (self.problem.states, self.problem.l.numel())
        if not self.pieces:
            return self._start_alone() | lists
        kept = [*range(0, len(self.rows) + 1, self.options.save_every)]
        kept += [len(self.rows)] * (kept[-1] != len(self.rows))
        x0 = np.array(ca.DM(self.problem.x0)).ravel()
        t = np.array([0.0, *(time for time, _ in self.rows)])[kept]
        number = np.array([0, *(number for _, number in self.rows)], int)[kept]
        start = {"t": t, "x": np.empty((len(t), n))} | lists
        found = dense.at(start, t, number)
        full = np.hstack([found.x, found.v])
        full[0] = x0
        for i, (time, k) in enumerate(zip(t[1:], number[1:], strict=True), 1):
            if time == self.pieces[k].end:
                full[i] = self.pieces[k].last
        arrays: dict[str, np.ndarray] = {
            "t": t, "x": full[:, :n], "multipliers": found.multipliers,
            "index_set": lists["piece_codes"][number] if len(self.pieces) else np.zeros((len(t), m), np.int8),
            "y": np.empty(0), "residual": np.empty(0), "step": np.diff(t, prepend=np.nan),
            "error_estimate": self._worst_of(number),
        }  # fmt: skip
        arrays |= self._records(t, full, number)
        arrays["residual"] = self._residuals(number, arrays.pop("l"), arrays.pop("h"))
        if self.problem.impulses:
            arrays["reactions"] = arrays["multipliers"].copy()
            arrays["multipliers"] = self._impulses(t, number, lists)
        for name in ("multipliers", "y", "residual", "error_estimate", "reactions"):
            if name in arrays:
                arrays[name][0] = np.nan
        arrays["index_set"][0] = dense.UNKNOWN
        return arrays | lists

    def _start_alone(self) -> dict[str, np.ndarray]:
        """The one row of a run that has no piece yet."""
        p = self.problem
        shown = p.l.numel() if p.multipliers is None else p.multipliers.numel()
        unknown = {name: np.full(1, np.nan) for name in ("residual", "step", "error_estimate")}
        return {
            "t": np.zeros(1), "x": np.array(ca.DM(p.x0))[: p.states].T,
            **{name: np.full((1, shown), np.nan) for name in ("multipliers", "y")},
            "index_set": np.full((1, p.l.numel()), dense.UNKNOWN, np.int8), **unknown,
        }  # fmt: skip

    def _lists(self) -> dict[str, np.ndarray]:
        pieces, begun = self.pieces, {event.t for event in self.integrator.events}
        order, n, m = self.integrator.order + 1, len(self.problem.names), self.problem.l.numel()
        shown = self.problem.multipliers.numel() if self.problem.multipliers is not None else m
        return {
            "piece_start": np.array([p.t for p in pieces]), "piece_unit": np.array([p.tau for p in pieces]),
            "piece_x": np.array([p.x[:, :order] for p in pieces]).reshape(len(pieces), n, order),
            "piece_multipliers": np.array([l[:, :order] for l, _ in self._shown]).reshape(len(pieces), shown, order),
            "piece_y": np.array([y[:, :order] for _, y in self._shown]).reshape(len(pieces), shown, order),
            "piece_codes": np.array([p.codes for p in pieces], np.int8).reshape(len(pieces), m),
            "piece_event": np.array([p.t in begun for p in pieces], bool),
        }  # fmt: skip

    def _worst_of(self, number: np.ndarray) -> np.ndarray:
        """The largest estimate of the pieces that each row ends or lies in, since the row before."""
        defects = np.array([p.defect for p in self.pieces])
        return np.array(
            [defects[a : b + 1].max() if len(defects) else np.nan for a, b in zip([0, *number], number, strict=False)]
        )

    def _residuals(self, number: np.ndarray, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How far each row is from its law where that is algebraic (y depends on l directly), beside the sizes of y and l."""
        system, sizes = self.integrator.system, self.integrator.sizes
        codes = np.array([self.pieces[k].codes for k in number])
        off = np.where(codes == 0, np.abs(y), np.maximum(codes * y, 0)) / np.maximum(sizes.y, 1e-300)
        out = np.maximum(np.maximum(system.lower - l, l - system.upper), 0) / np.maximum(sizes.l, 1e-300)
        return (np.maximum(off, out) * system.feedthrough).max(axis=1, initial=0.0)

    def _records(self, t: np.ndarray, x: np.ndarray, number: np.ndarray) -> dict[str, np.ndarray]:
        """Columns that are expressions of t, x and l: y, those of the class, and (as ``l``, ``h``) what the law speaks of."""
        p, pieces = self.problem, self.pieces
        l = np.array([
            dense.polynomials(pieces[k].l[None], np.array([(at - pieces[k].t) / pieces[k].tau]))[0]
            for k, at in zip(number, t, strict=True)
        ])  # fmt: skip
        columns = {"l": p.l, "h": p.h, "y": p.h if p.outputs is None else p.outputs, **p.records}
        function = ca.Function("records", [p.t, p.x, p.l], [ca.densify(e) for e in columns.values()]).map(len(t))
        values = function.call([ca.DM(t[None]), ca.DM(x.T), ca.DM(l.T) if p.l.numel() else ca.DM(0, len(t))])
        arrays = {name: np.array(v).T for name, v in zip(columns, values, strict=True)}
        return {name: v[:, 0] if name == "energy" else v for name, v in arrays.items()}

    def _impulses(self, t: np.ndarray, number: np.ndarray, lists: dict[str, np.ndarray]) -> np.ndarray:
        """The integrals of the multipliers since the row before."""
        c, unit = lists["piece_multipliers"], lists["piece_unit"]
        ends = np.append(lists["piece_start"][1:], self.pieces[-1].end if self.pieces else 0.0)
        whole = unit[:, None] * dense.integrals(c, (ends - lists["piece_start"]) / unit)
        until = np.vstack([np.zeros((1, c.shape[1])), np.cumsum(whole, axis=0)])[number]
        until += unit[number, None] * dense.integrals(c[number], dense.local(lists, number, t))
        return np.diff(until, axis=0, prepend=0.0)

    # -- for files

    def standing(self) -> dict[str, Any]:
        """Runs of this kind are kept whole."""
        raise NotImplementedError

    def stand(self, saved: dict[str, Any]) -> None:
        """Runs of this kind are kept whole."""
        raise NotImplementedError

    def metadata(self) -> dict[str, Any]:
        """What was integrated, and how."""
        p = self.problem
        return {
            "scheme": f"event-driven: Taylor series of order {self.integrator.order}",
            "multiplier_names": list(p.rows if p.multipliers is None else p.declared),
            "index_names": list(p.rows),
            "law_kinds": p.law.labels,
            "tolerance": self.options.tolerance,
        }


def _refuse_large(problem: ContinuousProblem, options: Options) -> None:
    """Refuse what would take longer than steps, unless it is asked for."""
    size = sum(ca.n_nodes(part) for part in (problem.f, problem.g, problem.h))
    if options.method != METHOD and size > LARGE:
        raise NotEventDriven(f"f, g and h have {size} operations, and each event ends a piece of all of them; steps cost less")


def _outputs(integrator: Integrator) -> Expansion | None:
    """The series of the user's own multipliers and outputs, where they are not those of the rows."""
    p = integrator.problem
    if p.multipliers is None or p.outputs is None:
        return None
    jets = jets_of(ca.vertcat(p.multipliers, p.outputs), [p.t, p.x, p.l], "multipliers and outputs")
    return Expansion(jets, integrator.system.orders, None)


def _expanded(out: Expansion, piece: Piece, m: int) -> tuple[np.ndarray, np.ndarray]:
    given = {(0, 0): [piece.t, piece.tau, *[0.0] * (piece.x.shape[1] - 2)]}
    given |= {(1, i): row for i, row in enumerate(piece.x.tolist())} | {(2, i): row for i, row in enumerate(piece.l.tolist())}
    for place, row in out.jets.inputs.items():
        out.rows[row][:] = given[place]
    out.choice[:] = [math.nan] * len(out.choice)
    for k in range(piece.x.shape[1]):
        out.order(k)
    rows = np.array(out.outputs)
    return rows[: len(rows) // 2], rows[len(rows) // 2 :]


def _plan(integrator: Integrator) -> Plan:
    system, p = integrator.system, integrator.problem
    used = [
        f"event-driven: Taylor series of order {integrator.order} in each mode, {system.n} states, {system.m} rows",
        "each switch is a root of its sign condition, found by Bernstein's test",
    ]
    if system.branches:
        used.append(f"{len(system.branches)} switches of operations that are not analytic (fabs, fmax, if_else, ...), watched")
    left = [f"time steps and their solvers (step, solver): {METHOD} pieces are as long as rtol lets them be"]
    if system.B is not None and system.D is not None and system.C is not None:
        left.append("linearisations: g_l, h_x and h_l are constant")
    del p
    return Plan("pieces", (), False, "never", True, math.inf, tuple(used), tuple(left))


def with_reason(plan: Plan, reason: str) -> Plan:
    """A plan of time stepping that says why event-driven integration was left out."""
    return replace(plan, left_out=(*plan.left_out, f"{METHOD} integration: {reason}"))
