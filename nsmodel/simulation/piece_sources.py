"""What makes the pieces of an event-driven run: the course, or C with the course for what C leaves to it.

Pieces of an event-driven run as rows of numbers: the record that C writes and the course is written in.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import casadi as ca
import numpy as np

from nsmodel.errors import StepError
from nsmodel.event_driven.fallback_steps import INITIAL_CHECKPOINT, HybridIntegrator
from nsmodel.event_driven.integrator import Integrator
from nsmodel.event_driven.modes import AGREE, PROVED, UNDECIDED, describe_undecided
from nsmodel.event_driven.multipliers import RowScales
from nsmodel.event_driven.piece import Piece, StartEvent
from nsmodel.event_driven.problem import ContinuousProblem

HEAD_NUMBERS = 7  # Their count: t, tau, s, defect, whether an event begins it, within what its time is known, residual.


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
    """Pieces (K), see `event_driven.piece`, one record (K, width) each; and what residuals of y and l are measured beside."""

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
        """The pieces of a slice."""
        return type(self)(self.rows[part], self.layout)

    @property
    def count(self) -> int:
        """The number of pieces."""
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
        """The pieces as objects, one by one."""
        n, m, _ = self.layout
        found = []
        for row, codes, last, impulse, c in zip(
            self.rows, self.codes.tolist(), self.last.tolist(), self.impulse.tolist(), self.series, strict=True
        ):
            t, tau, s, defect, event, width, residual = row[:HEAD_NUMBERS].tolist()
            series, of = (c[:n], c[n : n + m], c[n + m :], tuple(codes)), StartEvent(tuple(impulse), width) if event else None
            found.append(Piece(t, tau, s, *series, defect, last, of, None if math.isnan(residual) else residual))
        return found


UNIQUENESS_VERDICTS = (PROVED, AGREE, UNDECIDED)  # In the order of `unique` in C.
STIFF_FIELDS = ("length", "failed", "wait", "pieces")  # Of `stiff.StiffIntegrator`, as C has it.
# Pieces of a call, and the memory that they may take: few calls, each short enough for Ctrl-C.
PIECES_PER_REQUEST, MAX_PIECES_PER_CALL, MAX_CALL_BYTES = 256, 1024, 8 << 20  # For each asked for; at most; in all.


class InterpretedPieces:
    """Pieces one after the other, by the course itself: the integrator, and stretches of steps where these are let.

    Attributes:
        t: where the next piece starts; tau: its unit of time; x: its state; order: of the series.
        integrator: the interpreted one, at the same place; behind: of how many pieces "before" is, see ``checkpoint``.
    """

    behind: int = 1

    def __init__(self, hybrid: HybridIntegrator, *, kept: bool) -> None:
        """``kept``: whether the place before the last pieces may be asked for; then they are made one by one."""
        self.hybrid, self.integrator, self._kept = hybrid, hybrid.integrator, kept
        self._before: tuple[dict[str, Any], dict[str, Any]] | None = None
        self._error: StepError | None = None  # After pieces that were made in the same call.

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self.hybrid.t

    @property
    def tau(self) -> float:
        """Its unit of time."""
        return self.integrator.place.tau

    @property
    def x(self) -> np.ndarray:
        """The state where the next piece starts."""
        return np.array(self.hybrid.x)

    @property
    def order(self) -> int:
        """The order of the Taylor series."""
        return self.integrator.order

    def make_pieces(self, until: float, room: int) -> PieceBuffer:
        """So many pieces, one where places are kept; of a step those that begin before ``until``."""
        if self._error is not None:
            raise self._error
        pieces: list[Piece] = []
        sizes: list[RowScales] = []
        while not pieces or (len(pieces) < room and not self._kept and self.t < until):
            if self._kept:
                self._before = self.checkpoint(), self.counts()
            try:
                made = self.hybrid.advance()
            except StepError as error:
                if not pieces:
                    raise
                self._error = error
                break
            for piece in made:
                if piece.end > piece.t and not (pieces and pieces[-1].end >= until):
                    pieces.append(piece)
                    sizes.append(self._scales())
        self.behind = len(pieces)
        return PieceBuffer.of(pieces, *zip(*sizes, strict=True))

    def choose_mode_again(self, saved: dict[str, Any]) -> bool:
        """Go on from a place whose mode others chose by one that is chosen here; whether there is one, and it is another."""
        self.restore(saved)
        place, l = self.integrator.place, [row[0] for row in self.integrator.system.l]
        try:
            self.integrator.take_up(place.t, place.x, l, place.codes, place.tau)
        except StepError:
            return False
        return self.integrator.place.codes != place.codes

    def _scales(self) -> RowScales:
        """What y and l of a piece that was just made are measured beside: along it, or after what ends it."""
        along, after = self.integrator.piece_scales, self.integrator.system.row_scales()
        return after if along is None else RowScales(*([*map(max, *both)] for both in zip(along, after, strict=True)))

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """What was counted so far, or before the last pieces: touches, verdicts about modes, pieces with redundant rows or by
        collocation; stretches.
        """
        if before and self._before is not None:
            return self._before[1]
        made = self.integrator
        return {
            "touches": made.touches, "unique": dict(made.unique), "redundant": made.redundant,
            "undecided": describe_undecided(made.undecided, made.problem.rows, [part for part, _ in made.system.branches]),
            "collocated": made.stiff.pieces, "stretches": [dict(one) for one in self.hybrid.past],
        }  # fmt: skip

    def checkpoint(self, *, before: bool = False) -> dict[str, Any]:
        """The checkpoint of the integrator, now or before the last pieces."""
        return self._before[0] if before and self._before is not None else self.hybrid.checkpoint()

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self._error = None
        self.hybrid.restore(saved)


class CompiledPieces:
    """C, and the course for what C leaves to it: a start that jumps, a mode not found, stiff pieces, stretches, errors."""

    behind: int = 1

    def __init__(self, problem: ContinuousProblem, build_hybrid: Callable[[], HybridIntegrator], steps: Any) -> None:
        """``steps``: `codegen.event_driven_runs.CompiledPieceIntegrator`."""
        self.problem, self._build_hybrid, self.steps = problem, build_hybrid, steps
        self._layout = PieceLayout(problem.x.numel(), problem.l.numel(), steps.order + 1)
        self._stopped: str | None = None  # Of the integrator.
        self._fallback_state = INITIAL_CHECKPOINT  # Of the course.
        self._behind: tuple[dict[str, Any], dict[str, Any]] | None = None  # Before a piece that was interpreted.
        if not steps.begin(np.array(ca.DM(problem.x0)).ravel()):
            self.restore(self._interpreted_pieces.checkpoint())

    def take_over(self, steps: Any) -> None:
        """Go on from where other steps in C of the same problem stand."""
        self.steps, self._stopped, self._fallback_state, self._behind = steps, None, INITIAL_CHECKPOINT, None

    @cached_property
    def _interpreted_pieces(self) -> InterpretedPieces:
        return InterpretedPieces(self._build_hybrid(), kept=True)

    @property
    def integrator(self) -> Integrator:
        """The interpreted one, at the same place."""
        self._interpreted_pieces.restore(self.checkpoint())
        return self._interpreted_pieces.integrator

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self.steps.t if self._fallback_step is None else float(self._fallback_step["t"])

    @property
    def tau(self) -> float:
        """Its unit of time."""
        return float(self.steps.at["tau"])

    @property
    def x(self) -> np.ndarray:
        """The state where the next piece starts."""
        return self.steps.at["x"].copy() if self._fallback_step is None else np.array(self._fallback_step["x"])

    @property
    def _fallback_step(self) -> dict[str, Any] | None:
        """Where the next step of a stretch begins, see `stretch.FallbackState`; None between stretches."""
        steps = self._fallback_state["stretches"]
        return None if steps is None else steps["stand"]

    @property
    def order(self) -> int:
        """The order of the Taylor series."""
        return self.steps.order

    def make_pieces(self, until: float, room: int) -> PieceBuffer:
        """As many pieces as there is room for; what C cannot make is interpreted, and all from a stop until pieces go on."""
        in_c = self._behind is None and self._stopped is None  # Who made the last piece, and chose the mode after it.
        self.behind, self._behind = 1, None
        if self._stopped is None and self._fallback_step is None:
            rows, stuck = self.steps.advance(
                until, max(1, min(PIECES_PER_REQUEST * room, MAX_PIECES_PER_CALL, MAX_CALL_BYTES // (8 * self.steps.width)))
            )
            if len(rows) or not stuck:
                return PieceBuffer(rows, self._layout)
        own = self._interpreted_pieces
        own.restore(self.checkpoint())
        try:
            block = own.make_pieces(until, 1)
        except StepError:
            if not (in_c and own.choose_mode_again(self.checkpoint())):
                raise
            block = own.make_pieces(until, 1)
        self.behind, self._behind = own.behind, (own.checkpoint(before=True), own.counts(before=True))
        self.restore(own.checkpoint())
        return block

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """Touches, verdicts about modes, pieces with redundant rows or by collocation; stretches."""
        if before and self._behind is not None:
            return self._behind[1]
        place = self.steps.before if before else self.steps.at
        unique = {verdict: int(count) for verdict, count in zip(UNIQUENESS_VERDICTS, place["unique"], strict=True) if count}
        notes = {"touches": int(place["touches"]), "unique": unique, "redundant": int(place["redundant"])}
        past = [dict(one) for one in self._fallback_state["past"]]
        parts = [part for part, at in self.steps.branches.items() for _ in range(at.start, at.stop)]
        notes["undecided"] = describe_undecided(place["undecided"].tolist(), self.problem.rows, parts)
        return notes | {"collocated": int(place["stiff"][-1]), "stretches": past}

    def checkpoint(self, *, before: bool = False) -> dict[str, Any]:
        """As the course's."""
        if before and self._behind is not None:
            return self._behind[0]
        place, m = self.steps.before if before else self.steps.at, self.problem.l.numel()
        choices = {part: place["choice"][:-1][at].tolist() for part, at in self.steps.branches.items()}
        n = int(place["events"]).bit_length()
        counts = self.counts(before=before)
        integrator = {
            "t": float(place["t"]), "late": float(place["late"]), "x": place["x"].tolist(), "tau": float(place["tau"]),
            "codes": place["codes"][:m].tolist(), "open": self._open_switches(place["open"]),
            "choice": choices, "l": place["l"][:m].tolist(),
            "sizes": {
                name: place[f"size_{name}"][:count].tolist()
                for name, count in (("x", None), ("y", m), ("l", m), ("switches", len(place["choice"]) - 1))
            },
            "begun": [place["impulse"][:m].tolist(), float(place["event_width"])] if place["begun"] else None,
            "accumulation": {"events": int(place["events"]), "times": self.steps.times[:n].tolist(), "tiny": int(place["tiny"])},
            "unique": counts["unique"], "touches": counts["touches"], "redundant": counts["redundant"], "stopped": self._stopped,
            "undecided": place["undecided"].tolist(), "still": int(place["still"]),
            "stiff": dict(zip(STIFF_FIELDS, [place["stiff"][0].item(), *place["stiff"][1:].astype(int).tolist()], strict=True)),
        }  # fmt: skip
        return {"integrator": integrator, **deepcopy(self._fallback_state)}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self._fallback_state = {name: deepcopy(saved[name]) for name in INITIAL_CHECKPOINT}
        saved = saved["integrator"]
        place, m = self.steps.at, self.problem.l.numel()
        for name in ("t", "late", "tau", "x"):
            place[name] = saved[name]
        place["begun"] = saved["begun"] is not None
        place["codes"][:m], place["l"][:m] = saved["codes"], saved["l"]
        place["impulse"][:m], place["event_width"] = saved["begun"] or (0.0, 0.0)
        for name, sizes in saved["sizes"].items():
            place[f"size_{name}"][: len(sizes)] = sizes
        for part, choice in saved["choice"].items():
            place["choice"][:-1][self.steps.branches[part]] = choice
        place["open"] = 0
        for kind, i in saved["open"]:
            place["open"][i if kind == "row" else m + self.steps.branches[kind].start + i] = 1
        counted = saved["accumulation"]
        self.steps.times[: len(counted["times"])] = counted["times"]
        place["events"], place["tiny"] = counted["events"], counted["tiny"]
        place["stiff"] = [saved["stiff"][name] for name in STIFF_FIELDS]
        self._stopped, place["undecided"], place["still"] = saved["stopped"], saved["undecided"], saved["still"]
        unique = Counter(saved["unique"])
        place["unique"] = [unique[verdict] for verdict in UNIQUENESS_VERDICTS]
        place["touches"], place["redundant"], place["known"] = saved["touches"], saved["redundant"], 0

    def _open_switches(self, opened: np.ndarray) -> list[tuple[str, int]]:
        m = self.problem.l.numel()
        rows = [("row", i) for i in range(m) if opened[i]]
        branches = [(p, i) for p, at in self.steps.branches.items() for i, one in enumerate(opened[m:-1][at]) if one]
        return sorted([*branches, *rows])


PieceSource = InterpretedPieces | CompiledPieces
