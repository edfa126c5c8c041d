"""What makes the pieces of an event-driven run: the course, or C with the course for what C leaves to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from nsmodel.errors import StepError
from nsmodel.pieces.course import NEW, Course
from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.modes import AGREE, PROVED, UNDECIDED
from nsmodel.pieces.names import undecided
from nsmodel.pieces.piece import Piece
from nsmodel.run.piece_block import Block, Layout
from nsmodel.scheme.continuous import ContinuousProblem

VERDICTS = (PROVED, AGREE, UNDECIDED)  # In the order of `unique` in C.
STIFF = ("length", "failed", "wait", "pieces")  # Of `stiff.Stiff`, as C has it.
AT_ONCE, MOST, BYTES = 256, 1024, 8 << 20  # Pieces of a call, for each asked for and at most, and the memory that they may take.


class Maker(Protocol):
    """Pieces one after the other.

    Attributes:
        t: where the next one starts; tau: its unit of time; x: its state; order: of the series.
        integrator: the interpreted one, at the same place; behind: of how many pieces "before" is, see ``standing``.
    """

    behind: int

    @property
    def t(self) -> float: ...  # noqa: D102
    @property
    def tau(self) -> float: ...  # noqa: D102
    @property
    def x(self) -> np.ndarray: ...  # noqa: D102
    @property
    def order(self) -> int: ...  # noqa: D102
    @property
    def integrator(self) -> Integrator: ...  # noqa: D102

    def make(self, until: float, room: int) -> Block:
        """The next pieces, about so many, up to a time; none that has no length."""
        ...

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """What was counted so far; ``before``: before the last pieces, ``behind`` of them."""
        ...

    def standing(self, *, before: bool = False) -> dict[str, Any]:
        """What the next pieces depend on; ``before``: the last ones, ``behind`` of them, and those after."""
        ...

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        ...


class Interpreted:
    """The course itself: the integrator, and stretches of steps where these are let."""

    behind: int = 1

    def __init__(self, course: Course, *, kept: bool) -> None:
        """``kept``: whether the place before the last pieces may be asked for; then they are made one by one."""
        self.course, self.integrator, self._kept = course, course.integrator, kept
        system = self.integrator.system
        self._feeds = [system.feedthrough[i] or system.blocks.is_curved(i) for i in range(system.m)]
        self._before: tuple[dict[str, Any], dict[str, Any]] | None = None
        self._error: StepError | None = None  # After pieces that were made in the same call.

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self.course.t

    @property
    def tau(self) -> float:
        """Its unit of time."""
        return self.integrator.place.tau

    @property
    def x(self) -> np.ndarray:
        """Its state."""
        return np.array(self.course.x)

    @property
    def order(self) -> int:
        """Of the series."""
        return self.integrator.order

    def make(self, until: float, room: int) -> Block:
        """So many pieces, one where places are kept; of a step those that begin before ``until``."""
        if self._error is not None:
            raise self._error
        pieces: list[Piece] = []
        sizes: list[tuple[list[float], list[float]]] = []
        while not pieces or (len(pieces) < room and not self._kept and self.t < until):
            if self._kept:
                self._before = self.standing(), self.counts()
            try:
                made = self.course.advance()
            except StepError as error:
                if not pieces:
                    raise
                self._error = error
                break
            for piece in made:
                if piece.end > piece.t and not (pieces and pieces[-1].end >= until):
                    pieces.append(piece)
                    sizes.append(self._sizes())
        self.behind = len(pieces)
        return Block.of(pieces, *zip(*sizes, strict=True))

    def _sizes(self) -> tuple[list[float], list[float]]:
        """What y and l are measured beside at the end of a piece that was just made."""
        system, feeds = self.integrator.system, self._feeds
        of_y = [system.size_y(i) if feeds[i] else 1.0 for i in range(system.m)]
        return of_y, [system.size_l(i) if feeds[i] else 1.0 for i in range(system.m)]

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """Touches, verdicts about modes, pieces with redundant rows or by collocation; stretches."""
        if before and self._before is not None:
            return self._before[1]
        made = self.integrator
        return {
            "touches": made.touches, "unique": dict(made.unique), "redundant": made.redundant,
            "undecided": undecided(made.undecided, made.problem.rows, [part for part, _ in made.system.branches]),
            "collocated": made.stiff.pieces, "stretches": [dict(one) for one in self.course.past],
        }  # fmt: skip

    def standing(self, *, before: bool = False) -> dict[str, Any]:
        """The course's."""
        return self._before[0] if before and self._before is not None else self.course.standing()

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self._error = None
        self.course.stand(saved)


class InC:
    """C, and the course for what C leaves to it: a start that jumps, a mode not found, stiff pieces, stretches, errors."""

    behind: int = 1

    def __init__(self, problem: ContinuousProblem, course: Callable[[], Course], steps: Any) -> None:
        """``steps``: `codegen.piece_runs.PiecesInC`."""
        self.problem, self._course, self._c = problem, course, steps
        self._layout = Layout(problem.x.numel(), problem.l.numel(), steps.order + 1)
        self._stopped: str | None = None  # Of the integrator.
        self._stretches = NEW  # Of the course.
        self._behind: tuple[dict[str, Any], dict[str, Any]] | None = None  # Before a piece that was interpreted.
        if not steps.begin():
            self.stand(self._interpreted.standing())

    @cached_property
    def _interpreted(self) -> Interpreted:
        return Interpreted(self._course(), kept=True)

    @property
    def integrator(self) -> Integrator:
        """The interpreted one, at the same place."""
        self._interpreted.stand(self.standing())
        return self._interpreted.integrator

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self._c.t if self._step is None else float(self._step["t"])

    @property
    def tau(self) -> float:
        """Its unit of time."""
        return float(self._c.at["tau"])

    @property
    def x(self) -> np.ndarray:
        """Its state."""
        return self._c.at["x"].copy() if self._step is None else np.array(self._step["x"])

    @property
    def _step(self) -> dict[str, Any] | None:
        """Where the next step of a stretch begins, see `stretch.Stand`; None between stretches."""
        steps = self._stretches["stretches"]
        return None if steps is None else steps["stand"]

    @property
    def order(self) -> int:
        """Of the series."""
        return self._c.order

    def make(self, until: float, room: int) -> Block:
        """As many pieces as there is room for; what C cannot make is interpreted, and all from a stop until pieces go on."""
        self.behind, self._behind = 1, None
        if self._stopped is None and self._step is None:
            rows, stuck = self._c.many(until, max(1, min(AT_ONCE * room, MOST, BYTES // (8 * self._c.width))))
            if len(rows) or not stuck:
                return Block(rows, self._layout)
        own = self._interpreted
        own.stand(self.standing())
        block = own.make(until, 1)
        self.behind, self._behind = own.behind, (own.standing(before=True), own.counts(before=True))
        self.stand(own.standing())
        return block

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """Touches, verdicts about modes, pieces with redundant rows or by collocation; stretches."""
        if before and self._behind is not None:
            return self._behind[1]
        place = self._c.before if before else self._c.at
        unique = {verdict: int(count) for verdict, count in zip(VERDICTS, place["unique"], strict=True) if count}
        notes = {"touches": int(place["touches"]), "unique": unique, "redundant": int(place["redundant"])}
        past = [dict(one) for one in self._stretches["past"]]
        parts = [part for part in self._parts for _ in range(self._of(part).start, self._of(part).stop)]
        notes["undecided"] = undecided(place["undecided"].tolist(), self.problem.rows, parts)
        return notes | {"collocated": int(place["stiff"][-1]), "stretches": past}

    def standing(self, *, before: bool = False) -> dict[str, Any]:
        """As the course's."""
        if before and self._behind is not None:
            return self._behind[0]
        place, m = self._c.before if before else self._c.at, self.problem.l.numel()
        choices = [place["choice"][:-1][self._of(part)].tolist() for part in self._parts]
        n = int(place["events"]).bit_length()
        counts = self.counts(before=before)
        integrator = {
            "t": float(place["t"]), "x": place["x"].tolist(), "tau": float(place["tau"]), "codes": place["codes"][:m].tolist(),
            "open": self._opened(place["open"]), "choice": dict(zip(self._parts, choices, strict=True)),
            "l": place["l"][:m].tolist(),
            "sizes": {
                name: place[f"size_{name}"][:count].tolist()
                for name, count in (("x", None), ("y", m), ("l", m), ("switches", len(place["choice"]) - 1))
            },
            "begun": [place["impulse"][:m].tolist(), float(place["event_width"])] if place["begun"] else None,
            "accumulation": {"events": int(place["events"]), "times": self._c.times[:n].tolist(), "tiny": int(place["tiny"])},
            "unique": counts["unique"], "touches": counts["touches"], "redundant": counts["redundant"], "stopped": self._stopped,
            "undecided": place["undecided"].tolist(), "still": int(place["still"]),
            "stiff": dict(zip(STIFF, place["stiff"].tolist(), strict=True)),
        }  # fmt: skip
        return {"integrator": integrator, **deepcopy(self._stretches)}

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self._stretches = {name: deepcopy(saved[name]) for name in NEW}
        saved = saved["integrator"]
        place, m = self._c.at, self.problem.l.numel()
        place["t"], place["tau"], place["x"], place["begun"] = saved["t"], saved["tau"], saved["x"], saved["begun"] is not None
        place["codes"][:m], place["l"][:m] = saved["codes"], saved["l"]
        place["impulse"][:m], place["event_width"] = saved["begun"] or (0.0, 0.0)
        for name, sizes in saved["sizes"].items():
            place[f"size_{name}"][: len(sizes)] = sizes
        for part, choice in saved["choice"].items():
            place["choice"][:-1][self._of(part)] = choice
        place["open"] = 0
        for kind, i in saved["open"]:
            place["open"][i if kind == "row" else m + self._of(kind).start + i] = 1
        counted = saved["accumulation"]
        self._c.times[: len(counted["times"])] = counted["times"]
        place["events"], place["tiny"] = counted["events"], counted["tiny"]
        place["stiff"] = [saved["stiff"][name] for name in STIFF]
        self._stopped, place["undecided"], place["still"] = saved["stopped"], saved["undecided"], saved["still"]
        unique = Counter(saved["unique"])
        place["unique"] = [unique[verdict] for verdict in VERDICTS]
        place["touches"], place["redundant"], place["known"] = saved["touches"], saved["redundant"], 0

    @property
    def _parts(self) -> list[str]:
        return list(self._c.branches)

    def _of(self, part: str) -> slice:
        return self._c.branches[part]

    def _opened(self, opened: np.ndarray) -> list[tuple[str, int]]:
        m = self.problem.l.numel()
        rows = [("row", i) for i in range(m) if opened[i]]
        branches = [(p, i) for p in self._parts for i, one in enumerate(opened[m:-1][self._of(p)]) if one]
        return sorted([*branches, *rows])
