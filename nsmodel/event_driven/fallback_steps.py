"""A stretch by time stepping: verified steps of backward Euler under error control, from where no mode goes on.

    x1 = x + h (f + g)(t + h, x1, l),   y = h(t + h, x1, l),   -y ∈ N_K(l)

is the continuous problem itself, under step doubling (`solvers.step_doubling`). Between switches (one index set from the step
before to the end) the step goes on from x_fine + d where that keeps the law, else from x_fine. Steps are powers of two, and end
at known times. At the least step, where a velocity may jump, d is compared a step later.

The course of a run: pieces of the integrator, and where it stops a stretch of steps, until a mode goes on again.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import StepError, UnrecoverableStepError
from nsmodel.event_driven.integrator import Integrator
from nsmodel.event_driven.piece import Piece, StartEvent
from nsmodel.event_driven.problem import ContinuousProblem, SwitchTimes
from nsmodel.event_driven.step_size import ModelEquations, power_of_two_unit
from nsmodel.modeling.laws.base import LawEnds
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.step import StepResult, WarmStart, verified_step
from nsmodel.solvers.step_doubling import (
    STEP_DOUBLING_LIMIT,
    BothWays,
    ErrorNorm,
    ErrorScale,
    controlled_step,
    extrapolation_error,
)
from nsmodel.solvers.time_stepper import Stepper

STEP_BUDGET = 100_000  # Steps of a run, over all of its stretches: of a small model 1 ms each, two minutes in all.
STRICT = 20_000  # Steps from which on more error is allowed,
TENFOLD = 5_000  # ten times as much after so many more: 10^16 times, which is any, at the end of the budget.
SMOOTH_SHARE = 0.1  # Of rtol: a smooth step may err by this share times h/t, in all of it by 0.1 ln(t/t_0),
SWITCH_SHARE = 0.1  # and one across a switch by this: ten of them by rtol.
# Steps are 2^-j of the time so far, of these j: the first one, the least, 4096 roundings of it, and the largest, 1/64 of it.
FIRST_STEP_OCTAVES, MIN_STEP_OCTAVES, MAX_STEP_OCTAVES = 20, 40, 6
IMPACT = 22  # The j of the least step where walls call for impulses: v behind one is known to eps |y|/h, its time to h.
REACHED = 5e-7  # Relative: what such steps cannot err by less than, twice the least of them; a smaller rtol is raised to it.
# VELOCITY_ROUNDING: less takes it for an error, and has the least steps; more lets errors of v pass.
VELOCITY_ROUNDING = 64 * EPS  # There v differs by so much of t/h from step to step: no error of a step, it does not add up. (+)
MIN_RESIDUAL_TOLERANCE = 1e-11  # Tolerance of a step's residual, at the least: less is nothing beside what steps err by. (+)
PREPARED = 2.0**-10  # The step that the stepper is built for; it takes others all the same: any does.


def error_relaxation(steps: int) -> float:
    """How many times the error that a step may have grows after so many steps of a run."""
    return 10.0 ** max(0.0, (steps - STRICT) / TENFOLD)


@dataclass
class FallbackState:
    """Where a stretch stands, as lists and numbers: time, state, multipliers, index set; the next step, and the time so far as a
    power of two; where the stretch began; the rate of x in the last half step; d and h of the last step where it was smooth; the
    steps of the stretch; the sum of the errors of its steps, in units of rtol.
    """

    t: float
    x: list[float]
    l: list[float]
    index: list[int]
    h: float
    scale: float
    begin: float
    rate: list[float] | None = None
    d: list[float] | None = None
    of_h: float = 0.0
    own: int = 0
    error: float = 0.0


class FallbackTrial(NamedTuple):
    """A step ``both`` ways: where it is in the middle and ends, its error in units of rtol, whether it is smooth, d."""

    both: BothWays
    middle: np.ndarray
    end: np.ndarray
    error: float
    smooth: bool
    d: np.ndarray


class FallbackSteps:
    """The steps of a problem: ``begin`` a stretch, ``advance`` it; ``stand`` is where, None between stretches."""

    def __init__(
        self, problem: ContinuousProblem, rtol: float, atol: list[float], tolerance: float, known: SwitchTimes,
        sizes: list[float], width: int, *, impulsive: bool,
    ) -> None:  # fmt: skip
        """``sizes``: the largest of each x so far, brought up to date; ``width``: coefficients of a row of a piece.

        ``impulsive``: whether walls call for impulses.
        """
        self._least, self._more, self._rounded = MIN_STEP_OCTAVES, 1.0, 0.0
        if impulsive:
            self._least, self._more, self._rounded = IMPACT, max(1.0, REACHED / rtol), VELOCITY_ROUNDING / rtol
        self.problem, self.rtol, self.known = problem, rtol, known
        every = np.arange(problem.x.numel())
        scales = [ErrorScale(every, np.ones(every.size))] if every.size else []
        self._norm = ErrorNorm(rtol, np.array(atol), scales)
        self.tolerance = max(MIN_RESIDUAL_TOLERANCE, min(tolerance, rtol / 10))
        self.sizes, self.width, self.steps = sizes, width, 0
        self.state: FallbackState | None = None

    @cached_property
    def _stepper(self) -> Stepper:
        x0 = np.array(ca.DM(self.problem.x0)).ravel()
        return Stepper(backward_euler(self.problem), "auto", self.tolerance, h=PREPARED, state=x0, few_steps=False)

    @cached_property
    def _box_rows(self) -> np.ndarray:
        """Which rows are those of boxes (m,)."""
        return np.concatenate(
            [np.zeros(0, bool), *(np.full(block.size, block.separable) for _, block in self.problem.law.parts())]
        )

    @cached_property
    def _equations(self) -> ModelEquations:
        return ModelEquations(self.problem)

    def begin(self, t: float, x: list[float], l: list[float], codes: list[int], tau: float) -> FallbackState:
        """Begin a stretch at a state."""
        scale = power_of_two_unit(max(t, tau))
        inside = np.clip(l, self._stepper.law.lower, self._stepper.law.upper).tolist()
        self.state = FallbackState(t, list(x), inside, list(codes), math.ldexp(scale, -FIRST_STEP_OCTAVES), scale, t)
        return self.state

    def checkpoint(self) -> dict[str, Any]:
        """What the next steps depend on."""
        return {"steps": self.steps, "stand": None if self.state is None else asdict(self.state)}

    def take_up(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.steps, stand = saved["steps"], saved["stand"]
        self.state = None if stand is None else FallbackState(**stand)

    def advance(self, at: FallbackState) -> list[Piece]:
        """Take one step, as two pieces: a parabola of x where nothing switches, else straight lines; constant l and y.

        Raises:
            StepError: a step has no verified answer however short, or the budget is used up.
        """
        if self.steps >= STEP_BUDGET:
            raise StepError(
                f"t = {at.t:.10g}: the {STEP_BUDGET:,} time steps that a run may take where no mode can continue are used up"
            )
        return controlled_step(at, self._try_step, self._accept_step, self._shorten_step)

    def _solve_step(self, t: float, h: float, x: np.ndarray, warm: WarmStart) -> StepResult:
        with np.errstate(all="ignore"):
            return verified_step(self._stepper, t, h, x, warm)

    def _step_length(self, at: FallbackState) -> tuple[float, bool]:
        """The length of the step that is tried, and whether none is shorter."""
        h = min(at.h, math.ldexp(at.scale, -MAX_STEP_OCTAVES), self.known.next(at.t, at.x) - at.t)
        return h, h <= math.ldexp(at.scale, -self._least)

    def _shorten_step(self, at: FallbackState, trial: FallbackTrial | None) -> tuple[FallbackState, StepResult | None]:
        """A power of two below the step, at most half of it where it is one itself: then that half is known."""
        h, _ = self._step_length(at)
        at.h = power_of_two_unit(h) / 2
        return at, trial.both.half if trial is not None and at.h == h / 2 else None

    def _try_step(self, at: FallbackState, coarse: StepResult | None) -> FallbackTrial | None:
        """The step both ways; None where a step has no answer."""
        state, x, (h, least) = self._stepper.layout.state, np.array(at.x), self._step_length(at)
        warm = WarmStart(np.array(at.l), np.array(at.index, np.int8))
        try:
            starts = x, x, lambda half: half.row[state]
            both = BothWays.take(self._solve_step, (at.t, at.t + h / 2), h, starts, warm, coarse)
            smooth = all(np.array_equal(one.warm.index, at.index) for one in both) and at.own > 0
            d = both.difference(state, 1)
            if not smooth and least:
                d = self._difference_after_next_step(at.t + h, h, both.coarse, both.fine)
        except StepError as error:
            if not least:
                return None
            if isinstance(error, UnrecoverableStepError):
                raise
            raise StepError(f"t = {at.t:.10g}: no verified step is found from here") from error
        middle, end, off = both.half.row[state], both.fine.row[state], np.abs(d)
        if smooth and (better := self._extrapolated(at.t + h, end + d, both.fine)) is not None:
            end, midway = better, self._extrapolated(at.t + h / 2, middle + d / 2, both.half)
            middle = middle if midway is None else midway
            if at.d is not None:
                off = extrapolation_error(d, np.array(at.d), h / at.of_h, 1)
        elif not least:
            off = np.fmax(off, both.bend(state, x, np.nan if at.rate is None else h / 2 * np.array(at.rate)))
        return FallbackTrial(both, middle, end, self._norm(off, end, np.array(self.sizes)), smooth, d)

    def _difference_after_next_step(self, t: float, h: float, coarse: StepResult, fine: StepResult) -> np.ndarray:
        """X_fine - x_coarse after one more step."""
        state = self._stepper.layout.state
        coarse = self._solve_step(t, h, coarse.row[state], coarse.warm)
        half = self._solve_step(t, h / 2, fine.row[state], fine.warm)
        return self._solve_step(t + h / 2, h / 2, half.row[state], half.warm).row[state] - coarse.row[state]

    def _extrapolated(self, t: float, x: np.ndarray, fine: StepResult) -> np.ndarray | None:
        """X where every y of a box that is let go keeps its sign."""
        y = self._equations(t, x.tolist(), fine.row[self._stepper.layout.l].tolist())[1]
        return x if (fine.warm.index * y * self._box_rows <= 0).all() else None

    def _accept_step(self, at: FallbackState, trial: FallbackTrial) -> list[Piece] | None:
        """Move on, and the two pieces; None where the error is too large."""
        (h, least), both = self._step_length(at), trial.both
        smooth_share = max(SMOOTH_SHARE * h / (at.t + h), self._rounded * (at.t + h) / h)
        allowed = self._more * error_relaxation(self.steps) * (smooth_share if trial.smooth else SWITCH_SHARE)
        if trial.error > allowed and not least:
            return None
        state, middle, x, end = self._stepper.layout.state, trial.middle, np.array(at.x), at.t + h
        known = self.known.next(at.t, at.x)
        if h == known - at.t:
            end = known
        bend = 2 * (trial.end + x - 2 * middle) if trial.smooth else np.zeros(x.size)  # Of the parabola through all three.
        pieces = [
            self._half_step_piece(at.t, at.t + h / 2, x, middle, bend, both.half, 0.0),
            self._half_step_piece(at.t + h / 2, end, middle, trial.end, bend, both.fine, trial.error),
        ]
        at.rate, at.of_h = both.rate(state, h).tolist(), h
        at.d = trial.d.tolist() if trial.smooth and end != known else None
        at.t, at.x, at.l = end, self.known.after(end, trial.end.tolist()), both.fine.row[self._stepper.layout.l].tolist()
        at.index, at.error, at.own = both.fine.warm.index.tolist(), at.error + trial.error, at.own + 1
        self.sizes[:] = np.maximum(self.sizes, np.abs(trial.end)).tolist()
        self.steps += 1
        at.scale = max(at.scale, power_of_two_unit(end))
        if 8 * trial.error <= STEP_DOUBLING_LIMIT * allowed:
            at.h = min(2 * at.h, math.ldexp(at.scale, -MAX_STEP_OCTAVES))
        return pieces

    def _half_step_piece(
        self, t: float, end: float, x: np.ndarray, z: np.ndarray, bend: np.ndarray, result: StepResult, error: float
    ) -> Piece:  # fmt: skip
        """Half a step: x + (z - x) u + bend (u^2 - u)/4 with u from 0 to 1."""
        layout, row = self._stepper.layout, result.row
        tau = power_of_two_unit(end - t)
        s = (end - t) / tau
        line, l, y = (np.zeros((count, self.width)) for count in (x.size, row[layout.l].size, row[layout.y].size))
        line[:, 0], line[:, 1], line[:, 2] = x, (z - x - bend / 4) / s, bend / (4 * s * s)
        l[:, 0], y[:, 0] = row[layout.l], row[layout.y]
        codes = tuple(result.warm.index.tolist())
        return Piece(t, tau, s, line, l, y, codes, error, z.tolist(), None, float(row[layout.residual]))


def backward_euler(p: ContinuousProblem) -> OneStepProblem:
    """One implicit step of the continuous problem."""
    h, state, x = ca.SX.sym("h"), ca.SX.sym("x_k", p.x.numel()), ca.SX.sym("x", p.x.numel())
    rate, y = ca.substitute([p.rate, p.h], [p.t, p.x], [p.t + h, x])
    ends = tuple(LawEnds(end.name, *ca.substitute([end.lower, end.upper], [p.t, p.x], [p.t + h, x])) for end in p.ends)
    return OneStepProblem(
        scheme="backward Euler", t=p.t, h=h, state=state, p=p.p, z=x, l=p.l, y=ca.SX.sym("y", p.l.numel()),
        E=x - state - h * rate, Y=y, law=p.law, rows=p.rows, guess=state, next_state=x, ends=ends,
    )  # fmt: skip


RETURNS = 16  # How often a run comes back from a stretch; from then on it is stepped to its end.
EVERY = 8  # Steps of a stretch after which a mode, at the cost of a piece, is looked for first,
RARER = 1.25  # and the factor in the number of steps after which it is looked for again: 28 times in 20 000 steps.
MIN_PIECE_GAIN = 4  # A piece must go so many times as far as a step: less comes back for pieces that stop at once.
# SOON: so that RETURNS are not used up at once.
SOON = 1e-4  # Of the time so far: where pieces stop again so soon, the next stretch lasts longer, by powers of two. (+)


# As `HybridIntegrator.checkpoint`, before any stretch.
INITIAL_CHECKPOINT: dict[str, Any] = {"stretches": None, "past": [], "look": EVERY, "hold": 0.0}


class HybridIntegrator:
    """What goes on: ``advance`` gives the next pieces, ``past`` tells of the stretches so far.

    A stretch ends where a mode is valid, the only one, and its first piece goes MIN_PIECE_GAIN times as far as a step; see
    RETURNS and SOON.
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
        if integrator.stopped is not None or piece.end - piece.t < MIN_PIECE_GAIN * at.h:
            integrator.restore(before)
            return None
        return piece

    # -- for files

    def checkpoint(self) -> dict[str, Any]:
        """What to continue from."""
        steps = None if self.fallback is None else self.fallback.checkpoint()
        past = [dict(one) for one in self.past]
        place = {"integrator": self.integrator.checkpoint(), "stretches": steps}
        return place | {"past": past, "look": self._look, "hold": self._hold}

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
