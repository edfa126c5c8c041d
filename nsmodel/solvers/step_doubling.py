"""Error control by step doubling, over any step: it is taken once with h, and again as two steps of h/2.

A route brings its own step, its norm, and what it accepts; what is the same for all is here: both ways (`BothWays`), the
size of an error (`ErrorNorm`), and the loop that takes a step, accepts or halves it (`controlled_step`). Where both ways differ
by d = (x_fine - x_coarse)/(2^p - 1), p the order of the step, x_fine errs by about |d|, and x_fine + d by what of d does not
fall like h^(p+1) from step to step. Across a switch d may be small by chance: there the bends of the path count as well.

What a small state is measured beside: states of one symbol, or those that one cone pushes. A cone that acts on accelerations
alone holds v by positions, in the mean of a step: along its surface, of curvature k, v is off by the part theta = k |v| h of
|v|, and by tolerance/theta, as y is by the tolerance. A v_i that begins at 0 is off by all of itself in a first step of any
length: what it is measured beside is the part sqrt(tolerance)/(2 rtol) of |v|, which asks for steps of about
theta = sqrt(tolerance), where both are least. |v| is the largest v_i/unit_i, unit_i how far an impulse moves v_i.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from nsmodel.solvers.impacts import ImpactRow
from nsmodel.solvers.step import StepResult, WarmStart

# NEGLIGIBLE_STATE_SHARE: less asks for digits of what may be rounding.
NEGLIGIBLE_STATE_SHARE = 1e-6  # A state that stays below this part of the largest of its symbol is measured beside that. (+)

# STEP_DOUBLING_LIMIT: more makes steps that are refused, less shorter ones.
STEP_DOUBLING_LIMIT = 0.5  # A step is doubled where the error expected of it stays below this part of what is allowed.


class ErrorScale(NamedTuple):
    """States ``at`` (k,), which are measured beside ``part`` of the largest of them, in ``unit`` (k,)."""

    at: np.ndarray
    unit: np.ndarray
    part: float = NEGLIGIBLE_STATE_SHARE


def error_scale_groups(
    symbols: Sequence[np.ndarray], cones: Sequence[ImpactRow], tolerance: float, rtol: float
) -> list[ErrorScale]:
    """Return the groups of states, each state in one at most.

    Args:
        symbols: the states of each symbol.
        cones: those that call for impulses.
        tolerance: of a step; rtol: of the run.
    """
    part = max(NEGLIGIBLE_STATE_SHARE, min(1.0, math.sqrt(tolerance) / (2 * rtol)) if rtol else 1.0)
    found, taken = [], np.zeros(0, int)
    for cone in cones:
        at = np.setdiff1d(np.flatnonzero(cone.pushed), taken)
        found.append(ErrorScale(at, cone.pushed[at], part))
        taken = np.append(taken, at)
    rest = [np.setdiff1d(symbol, taken) for symbol in symbols]
    return [scale for scale in (*found, *(ErrorScale(at, np.ones(at.size)) for at in rest)) if scale.at.size]


TakeStep: TypeAlias = Callable[[float, float, np.ndarray, WarmStart], StepResult]  # (t, h, state, warm), or StepError.
AfterHalf: TypeAlias = Callable[[StepResult], np.ndarray]


class BothWays(NamedTuple):
    """A step taken once, ``coarse``, and as two halves, ``half`` and ``fine``; ``of``: the entries of rows that are compared."""

    coarse: StepResult
    half: StepResult
    fine: StepResult

    @classmethod
    def take(
        cls, step: TakeStep, times: tuple[float, float], h: float, starts: tuple[np.ndarray, np.ndarray, AfterHalf],
        warm: WarmStart, coarse: StepResult | None,
    ) -> BothWays:  # fmt: skip
        """Take the steps; ``coarse`` is given where it is known.

        ``times``: start and middle; ``starts``: of the whole step, of its first half, and of the second one given the first.
        """
        (t, middle), (whole, first, second) = times, starts
        coarse = step(t, h, whole, warm) if coarse is None else coarse
        half = step(t, h / 2, first, warm)
        return cls(coarse, half, step(middle, h / 2, second(half), half.warm))

    def difference(self, of: Any, order: int) -> np.ndarray:
        """d = (x_fine - x_coarse)/(2^p - 1)."""
        return (self.fine.row[of] - self.coarse.row[of]) / (2**order - 1)

    def bend(self, of: Any, x: np.ndarray, before: np.ndarray | float) -> np.ndarray:
        """How far the path bends in the middle, or at the start x, where ``before`` is what the last rate gives; NaN: unknown."""
        moved = self.half.row[of] - x
        return np.fmax(np.abs(self.fine.row[of] - self.half.row[of] - moved), np.abs(moved - before))

    def rate(self, of: Any, h: float) -> np.ndarray:
        """The change per time in the second half."""
        return (self.fine.row[of] - self.half.row[of]) / (h / 2)


def extrapolation_error(d: np.ndarray, before: np.ndarray, ratio: float, order: int) -> np.ndarray:
    """What x_fine + d errs by: what of d does not follow from that of a step before, ``ratio`` times shorter, NaN: unknown."""
    return np.abs(d - np.nan_to_num(before) * ratio ** (order + 1))


@dataclass(frozen=True)
class ErrorNorm:
    """The errors e in units of what is allowed: max_i |e_i| / (atol_i + rtol s_i), s_i the largest |x_i| so far."""

    rtol: float
    atol: np.ndarray
    scales: Sequence[ErrorScale]

    def allowed(self, size: np.ndarray) -> np.ndarray:
        """The error allowed of each x_i, where ``size`` (..., n) holds the largest |x_i| so far."""
        size = size.copy()
        for at, unit, part in self.scales:
            floor = part * unit * (size[..., at] / unit).max(axis=-1, keepdims=True)
            size[..., at] = np.maximum(size[..., at], floor)
        return self.atol + self.rtol * size

    def __call__(self, error: np.ndarray, x: np.ndarray, size: np.ndarray) -> float:
        """The largest of the errors at x, with the largest |x_i| before; infinite where one is not a number."""
        allowed = self.allowed(np.maximum(size, np.abs(x)))
        units = np.divide(error, allowed, out=np.where(error > 0, np.inf, 0.0), where=allowed > 0)
        return float(np.nan_to_num(units, nan=np.inf).max(initial=0.0))


Place = TypeVar("Place")
Trial = TypeVar("Trial")
Accepted = TypeVar("Accepted")


def controlled_step(
    at: Place,
    attempt: Callable[[Place, StepResult | None], Trial | None],
    accept: Callable[[Place, Trial], Accepted | None],
    shorten: Callable[[Place, Trial | None], tuple[Place, StepResult | None]],
) -> Accepted:
    """Take a step from a place, at whatever length it is accepted.

    ``attempt`` takes it both ways, given the whole step where that is known; None where it has no answer. ``accept`` returns what
    is kept of it, None where the error is too large. ``shorten`` returns the place with a shorter step, and that step where it
    is known: the first half of one that was refused. They raise StepError where there is nothing to go on with.
    """
    coarse = None
    while True:
        trial = attempt(at, coarse)
        if trial is not None and (accepted := accept(at, trial)) is not None:
            return accepted
        at, coarse = shorten(at, trial)
