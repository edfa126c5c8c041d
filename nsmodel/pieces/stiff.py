"""When a mode is stiff: pieces by Radau IIA, where they are many times as long as a series goes.

How far a series goes its own last coefficients say, at each piece. Where stability and not accuracy limits it, the states hardly
move on it by their first coefficients, and a piece of collocation that is WORTH times as long is tried. Where its error is
accepted, the next one is longer, then each as long as the error before lets it be; as soon as pieces are less than STAY times a
series, series go on. After k trials in a row that failed, or that no second piece followed, 2^k series pass before the next one:
a mode that is not stiff pays next to nothing, and x that leaves an unstable state, to which collocation goes back, does leave it.
What decides is in the coefficients alone.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from nsmodel.pieces.bernstein import poly_slope, poly_value
from nsmodel.pieces.disc_equations import EquationsOnDisc
from nsmodel.pieces.lengths import power_of_two_unit
from nsmodel.pieces.modes import PieceStart
from nsmodel.pieces.multipliers import NOTHING, MultiplierSolver
from nsmodel.pieces.radau import CollocationFit, CollocationStart, RadauMethod
from nsmodel.pieces.roots import EventLocator, current_condition
from nsmodel.pieces.switches import TIE, SwitchCondition, condition_scale
from nsmodel.pieces.system import ModeSystem

WORTH = 8.0  # Series that a first piece of collocation has to be worth.
STAY = 4.0  # The same of those that go on.
SMOOTH = 2  # Coefficients of the states that say whether these move.
INSIDE = 0.1  # Of rtol: what a piece may err by inside; at its end it errs by a power of that.
OCTAVES_MORE = 2  # By which the next piece may be longer.
SAFE = 0.5  # The share of what is allowed that its error is foretold to be.
ENDINGS = 8  # How often a piece is made anew to end at an event.
ENDED = 1e-4  # Of its length: so near its end what it errs by inside counts by the square of that.
MOVED = 0.1  # By which share of its length a piece may have to be longer than its polynomial told, for that.
MAX_WAIT_OCTAVES = 6  # Octaves.


class StiffPiece(NamedTuple):
    """A piece that is in the rows of the system: unit of time, length, error in units of rtol, x at the end; what ends it."""

    tau: float
    s: float
    error: float
    last: list[float]
    hit: SwitchCondition | None


class StiffIntegrator:
    """What is known of the stiffness of the mode; ``pieces``: how many were by collocation.

    ``rtol``, ``atol``: what a run may err by; ``residuals``: see `RadauMethod`.
    """

    def __init__(
        self, system: ModeSystem, on: EquationsOnDisc, roots: EventLocator, order: int, rtol: float, atol: list[float], *,
        residuals: bool
    ) -> None:  # fmt: skip
        self.system, self.roots, self.order = system, roots, order
        self.rtol, self.atol = INSIDE * rtol, [INSIDE * a for a in atol]
        self.radau = RadauMethod(system, on, order, residuals=residuals)
        self.pieces = 0
        self.restart()

    def restart(self) -> None:
        """Forget what was known: another mode."""
        self.length, self.failed, self.wait = 0.0, 0, 0

    def piece(self, place: PieceStart, how: MultiplierSolver, s: float, most: float = math.inf) -> StiffPiece | None:
        """The piece by collocation, where that is worth while; else None, and the series in the rows are as they were.

        ``s`` is how far the series go, in the unit of the place; ``most`` how long the piece may be.
        """
        series, first = place.tau * s, not self.length
        length = self._trial_length(place, how, s) if first else self.length
        least, length = series * (WORTH if first else STAY), min(length, most)
        if not length or length < least:
            self._record_failure(failed=not first)
            return None
        start = self.radau.start(place, how)
        fit, longest = self.radau.fit(start, length, self.rtol, self.atol), OCTAVES_MORE
        while fit is None or not fit.error <= 1:
            if fit is not None and fit.estimate <= 1:
                longest = 0  # What bounds a longer one is too large, whatever its estimate says.
            length = math.ldexp(length, min(-1 if fit is None else self._allowed_octaves(fit.error), -1))
            if length < least or place.t + length == place.t:
                self._record_failure(failed=True)
                return None
            fit = self.radau.fit(start, length, self.rtol, self.atol)
        self.length = math.ldexp(length, longest if first else min(self._allowed_octaves(fit.estimate), longest))
        self.failed, self.wait = self.failed if first else 0, 0
        self.pieces += 1
        return self._end_at_event(place, how, start, fit, most)

    def _trial_length(self, place: PieceStart, how: MultiplierSolver, s: float) -> float:
        """The length of a first piece; 0 where none is tried: a series that fills its unit of time becomes longer by itself.

        None is tried where l of blocks that slip follows from y: the equations of `radau` do not have that.
        """
        if self.wait or s >= 1 or place.open or self.system.blocks.all or (how.null is not None and how.null.size):
            return 0.0
        for row, largest in zip(self.system.x, self.system.sizes.x, strict=True):
            if sum(abs(row[k]) * (WORTH * s) ** k for k in range(1, SMOOTH + 1)) > largest:
                return 0.0
        return power_of_two_unit(WORTH * place.tau * s)

    def _record_failure(self, failed: bool) -> None:
        self.length, self.wait = 0.0, max(self.wait - 1, 0)
        if failed:
            self.failed = min(self.failed + 1, MAX_WAIT_OCTAVES)
            self.wait = 2**self.failed

    def _allowed_octaves(self, error: float) -> int:
        """By how many octaves a piece may be longer: its error has the order s + 1."""
        if not math.isfinite(error):
            return -1
        return math.floor(math.log2(SAFE / max(error, NOTHING)) / (self.radau.stages + 1))

    def _end_at_event(
        self, place: PieceStart, how: MultiplierSolver, start: CollocationStart, fit: CollocationFit, most: float
    ) -> StiffPiece:
        """The piece up to its first event, made anew to end near it: inside it has the order s + 1, at its end 2 s - 1."""
        tau, s = self.radau.write(start, fit)
        hit, end = self.roots.first(place, how, self.order, s)
        if hit is None and end < s:  # Beyond that a root may hide.
            return StiffPiece(tau, end, INSIDE * fit.error, [poly_value(row, end) for row in self.system.x], None)
        for _ in range(ENDINGS):
            if hit is None:
                break
            shorter = self.radau.fit(start, min(tau * end, most), self.rtol, self.atol) if end > 0 else None
            if shorter is None or not shorter.error <= 1:
                break
            fit = shorter
            tau, s = self.radau.write(start, fit)
            again, end = self.roots.first(place, how, self.order, s)
            hit, end = (again, end) if again else self._condition_beyond_end(place, how, hit, s)
            if abs(end - s) <= ENDED * s and tau * end <= most:
                break
            if end > s and tau * s >= most:
                hit = None
        if hit is None or end == s or end > (1 + ENDED) * s:
            return StiffPiece(tau, s, INSIDE * fit.error, fit.last, hit)
        return StiffPiece(tau, end, INSIDE * fit.error, [poly_value(row, end) for row in self.system.x], hit)

    def _condition_beyond_end(
        self, place: PieceStart, how: MultiplierSolver, hit: SwitchCondition, s: float
    ) -> tuple[SwitchCondition | None, float]:
        """The condition that was 0 before, and where it is now, just beyond the end; None where it is no more."""
        own = current_condition(self.system, place, how, hit, self.order) or hit
        c = own.coefficients()
        v, rate = poly_value(c, s), poly_slope(c, s)
        if v <= TIE * condition_scale(self.system, own):
            return own, s
        return (own, s - v / rate) if rate < 0 and v <= MOVED * s * -rate else (None, s)

    # -- for files

    def checkpoint(self) -> dict[str, Any]:
        """What the next pieces depend on."""
        return {"length": self.length, "failed": self.failed, "wait": self.wait, "pieces": self.pieces}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.length, self.failed, self.wait, self.pieces = (saved[name] for name in ("length", "failed", "wait", "pieces"))
