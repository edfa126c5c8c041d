"""The course of a run: pieces of the integrator, and where it stops a stretch of steps, until a mode goes on again."""

from __future__ import annotations

import math
from typing import Any

from nsmodel.errors import StepError, UnrecoverableStepError
from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.piece import Piece, StartEvent
from nsmodel.pieces.stretch import FallbackState, FallbackSteps

RETURNS = 16  # How often a run comes back from a stretch.
EVERY, RARER = 8, 1.25  # Steps of a stretch after which a mode is looked for first, and by which factor later again.
GAIN = 4  # A piece must go so many times as far as a step.
SOON = 1e-4  # Of the time so far: where pieces stop again so soon, the next stretch lasts longer, by powers of two.


INITIAL_CHECKPOINT: dict[str, Any] = {
    "stretches": None,
    "past": [],
    "look": EVERY,
    "hold": 0.0,
}  # As `HybridIntegrator.standing`, before any stretch.


class HybridIntegrator:
    """What goes on: ``advance`` gives the next pieces, ``past`` tells of the stretches so far.

    A stretch ends where a mode is valid, the only one, and its first piece goes GAIN times as far as a step; see RETURNS, SOON.
    """

    def __init__(self, integrator: Integrator, fallback: FallbackSteps | None) -> None:
        """``fallback``: None where the integrator alone must go on."""
        self.integrator, self.fallback = integrator, fallback
        self.past: list[dict[str, Any]] = []
        self._look, self._hold = EVERY, 0.0

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self.integrator.t if self._fallback_state is None else self._fallback_state.t

    @property
    def x(self) -> list[float]:
        """The state there."""
        return self.integrator.place.x if self._fallback_state is None else self._fallback_state.x

    @property
    def _fallback_state(self) -> FallbackState | None:
        return None if self.fallback is None else self.fallback.state

    def advance(self) -> list[Piece]:
        """The next piece, or the two of a step.

        Raises:
            StepError: the integrator has stopped and there are no steps, or these cannot go on either.
        """
        steps, integrator = self.fallback, self.integrator
        if steps is None or (steps.state is None and (integrator.stopped is None or integrator.final_error is not None)):
            try:
                return [integrator.advance()]
            except StepError as error:
                if steps is None or isinstance(error, UnrecoverableStepError):
                    raise
                integrator.stopped = str(error)
        at, begins = steps.state, False
        if at is None:
            at, begins = self._begin_fallback(steps), True
        elif (piece := self._try_return_to_pieces(at)) is not None:
            steps.state = None
            return [piece]
        pieces = steps.advance(at)
        self.past[-1] |= {"until": at.t, "steps": at.own, "estimate": at.error}
        return [pieces[0]._replace(event=StartEvent((0.0,) * integrator.system.m)), *pieces[1:]] if begins else pieces

    def _begin_fallback(self, steps: FallbackSteps) -> FallbackState:
        place, l = self.integrator.place, [row[0] for row in self.integrator.system.l]
        at = steps.begin(place.t, place.x, l, place.codes, place.tau)
        last = self.past[-1] if self.past else None
        since = math.inf if last is None else at.t - last["until"]
        self._hold = max(2 * self._hold, 4 * since) if since < SOON * at.t else 0.0
        self._look = EVERY
        self.past.append({"start": at.t, "until": at.t, "steps": 0, "estimate": 0.0, "why": self.integrator.stopped or ""})
        return at

    def _try_return_to_pieces(self, at: FallbackState) -> Piece | None:
        """The first piece of the integrator again; None where the stretch goes on."""
        if at.own < self._look or at.t - at.begin < self._hold or len(self.past) > RETURNS:
            return None
        self._look = int(RARER * at.own) + EVERY
        integrator = self.integrator
        before = integrator.checkpoint()
        try:
            integrator.take_up(at.t, at.x, at.l, at.index, at.h)
            piece = integrator.advance()
        except StepError:
            integrator.restore(before)
            return None
        if integrator.stopped is not None or piece.end - piece.t < GAIN * at.h:
            integrator.restore(before)
            return None
        return piece

    # -- for files

    def checkpoint(self) -> dict[str, Any]:
        """What to continue from."""
        steps = None if self.fallback is None else self.fallback.checkpoint()
        past = [dict(one) for one in self.past]
        return {
            "integrator": self.integrator.checkpoint(),
            "stretches": steps,
            "past": past,
            "look": self._look,
            "hold": self._hold,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.integrator.restore(saved["integrator"])
        if self.fallback is not None and saved["stretches"] is not None:
            self.fallback.take_up(saved["stretches"])
        self.past, self._look, self._hold = [dict(one) for one in saved["past"]], saved["look"], saved["hold"]


def checkpoint_time(checkpoint: dict[str, Any]) -> float:
    """Where the next piece starts after ``HybridIntegrator.standing``."""
    steps = checkpoint["stretches"]
    return checkpoint["integrator"]["t"] if steps is None or steps["stand"] is None else steps["stand"]["t"]
