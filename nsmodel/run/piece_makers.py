"""What makes the pieces of an event-driven run: the integrator, or C with the integrator for what C leaves to it."""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.modes import AGREE, PROVED, UNDECIDED
from nsmodel.run.piece_rows import Block
from nsmodel.scheme.continuous import ContinuousProblem

VERDICTS = (PROVED, AGREE, UNDECIDED)  # In the order of `unique` in C.
STIFF = ("length", "failed", "wait")  # Of `stiff.Stiff`, as C has it.
MOST, BYTES = 1024, 8 << 20  # Pieces of a call, and the memory that they may take.


class Maker(Protocol):
    """Pieces one after the other.

    Attributes:
        t: where the next one starts; tau: its unit of time; x: its state; order: of the series.
        integrator: the interpreted one, at the same place.
    """

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
        """What was counted so far; ``before``: before the last piece."""
        ...

    def standing(self, *, before: bool = False) -> dict[str, Any]:
        """What the next pieces depend on; ``before``: the last one and those after it."""
        ...

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        ...


class Interpreted:
    """The integrator itself."""

    def __init__(self, problem: ContinuousProblem, rtol: float, atol: list[float]) -> None:
        self.integrator = Integrator(problem, rtol, atol)
        self._feeds = self.integrator.system.feedthrough
        self._before: tuple[dict[str, Any], dict[str, Any]] | None = None

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self.integrator.t

    @property
    def tau(self) -> float:
        """Its unit of time."""
        return self.integrator.place.tau

    @property
    def x(self) -> np.ndarray:
        """Its state."""
        return np.array(self.integrator.place.x)

    @property
    def order(self) -> int:
        """Of the series."""
        return self.integrator.order

    def make(self, until: float, room: int) -> Block:
        """One piece."""
        del until, room
        while True:
            self._before = self.standing(), self.counts()
            piece = self.integrator.advance()
            if piece.end > piece.t:
                return self.block(piece)

    def block(self, piece: Any) -> Block:
        """A piece that was just made, with the sizes at its end."""
        system, feeds = self.integrator.system, self._feeds
        of_y = [system.size_y(i) if feeds[i] else 1.0 for i in range(system.m)]
        return Block.of(piece, of_y, [system.size_l(i) if feeds[i] else 1.0 for i in range(system.m)])

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """Touches, verdicts about modes, pieces with redundant rows."""
        if before and self._before is not None:
            return self._before[1]
        made = self.integrator
        return {
            "touches": made.touches, "unique": dict(made.unique), "redundant": made.redundant,
            "collocated": made.stiff.pieces,
        }  # fmt: skip

    def standing(self, *, before: bool = False) -> dict[str, Any]:
        """The integrator's."""
        return self._before[0] if before and self._before is not None else self.integrator.standing()

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.integrator.stand(saved)


class InC:
    """C, and the integrator for a start that jumps, a mode that C does not find, stiff pieces, and all that ends in an error."""

    def __init__(self, problem: ContinuousProblem, rtol: float, atol: list[float], steps: Any) -> None:
        """``steps``: `codegen.piece_runs.PiecesInC`."""
        self.problem, self.rtol, self.atol, self._c = problem, rtol, atol, steps
        self._collocated = 0  # Pieces by collocation, which C leaves to the integrator.
        self._behind: tuple[dict[str, Any], dict[str, Any]] | None = None  # Before a piece that was interpreted.
        if not steps.begin():
            self.stand(self._interpreted.standing())

    @cached_property
    def _interpreted(self) -> Interpreted:
        return Interpreted(self.problem, self.rtol, self.atol)

    @property
    def integrator(self) -> Integrator:
        """The interpreted one, at the same place."""
        self._interpreted.stand(self.standing())
        return self._interpreted.integrator

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return float(self._c.at["t"])

    @property
    def tau(self) -> float:
        """Its unit of time."""
        return float(self._c.at["tau"])

    @property
    def x(self) -> np.ndarray:
        """Its state."""
        return self._c.at["x"].copy()

    @property
    def order(self) -> int:
        """Of the series."""
        return self._c.order

    def make(self, until: float, room: int) -> Block:
        """As many pieces as there is room for; the one that C cannot make is interpreted."""
        room = max(1, min(16 * room, MOST, BYTES // (8 * self._c.width)))
        rows, stuck = self._c.many(until, room)
        self._behind = None
        if len(rows) or not stuck:
            return self._block(rows)
        self._interpreted.stand(self.standing())
        block = self._interpreted.make(until, 1)
        self._behind = self._interpreted.standing(before=True), self._interpreted.counts(before=True)
        self.stand(self._interpreted.standing())
        return block

    def _block(self, rows: np.ndarray) -> Block:
        """Records of C as pieces; see `c/pieces.c`."""
        n, m, order, count = self.problem.x.numel(), self.problem.l.numel(), self.order, len(rows)
        t, tau, s, defect, event = rows[:, :5].T
        impulse, codes, size_y, size_l = (rows[:, 5 + k * m : 5 + (k + 1) * m] for k in range(4))
        last = rows[:, 5 + 4 * m : 5 + 4 * m + n]
        c = rows[:, 5 + 4 * m + n :].reshape(count, order + 1, n + 2 * m).transpose(0, 2, 1)
        l, y = (np.ascontiguousarray(c[:, start : start + m]) for start in (n, n + m))
        return Block(
            t, tau, s, c[:, :n], l, y, codes.astype(np.int8), defect, last, event != 0, impulse, size_y, size_l
        )  # fmt: skip

    def counts(self, *, before: bool = False) -> dict[str, Any]:
        """Touches, verdicts about modes, pieces with redundant rows."""
        if before and self._behind is not None:
            return self._behind[1]
        place = self._c.before if before else self._c.at
        unique = {verdict: int(count) for verdict, count in zip(VERDICTS, place["unique"], strict=True) if count}
        notes = {"touches": int(place["touches"]), "unique": unique, "redundant": int(place["redundant"])}
        return notes | {"collocated": self._collocated}

    def standing(self, *, before: bool = False) -> dict[str, Any]:
        """As the integrator's."""
        if before and self._behind is not None:
            return self._behind[0]
        place, m = self._c.before if before else self._c.at, self.problem.l.numel()
        choices = [place["choice"][:-1][self._of(part)].tolist() for part in self._parts]
        n = int(place["events"]).bit_length()
        notes = self.counts(before=before)
        del notes["collocated"]
        return {
            "t": float(place["t"]), "x": place["x"].tolist(), "tau": float(place["tau"]), "codes": place["codes"][:m].tolist(),
            "open": self._opened(place["open"]), "choice": dict(zip(self._parts, choices, strict=True)),
            "l": place["l"][:m].tolist(),
            "sizes": {
                name: place[f"size_{name}"][:count].tolist()
                for name, count in (("x", None), ("y", m), ("l", m), ("switches", len(place["choice"]) - 1))
            },
            "begun": tuple(place["impulse"][:m].tolist()) if place["begun"] else None, "times": place["times"][:n].tolist(),
            "events": int(place["events"]), **notes, "tiny": int(place["tiny"]),
            "stiff": dict(zip(STIFF, place["stiff"].tolist(), strict=True)) | {"pieces": self._collocated},
        }  # fmt: skip

    def stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        place, m = self._c.at, self.problem.l.numel()
        place["t"], place["tau"], place["x"], place["begun"] = saved["t"], saved["tau"], saved["x"], saved["begun"] is not None
        place["codes"][:m], place["l"][:m] = saved["codes"], saved["l"]
        place["impulse"][:m] = saved["begun"] or 0.0
        for name, sizes in saved["sizes"].items():
            place[f"size_{name}"][: len(sizes)] = sizes
        for part, choice in saved["choice"].items():
            place["choice"][:-1][self._of(part)] = choice
        place["open"] = 0
        for kind, i in saved["open"]:
            place["open"][i if kind == "row" else m + self._of(kind).start + i] = 1
        place["times"][: len(saved["times"])] = saved["times"]
        place["stiff"], self._collocated = [saved["stiff"][name] for name in STIFF], saved["stiff"]["pieces"]
        unique = Counter(saved["unique"])
        place["unique"] = [unique[verdict] for verdict in VERDICTS]
        for name in ("events", "touches", "redundant", "tiny"):
            place[name] = saved[name]

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
