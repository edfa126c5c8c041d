"""Points and lines of a work-precision diagram, and what is read off a line: order, floor, what an error costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import UsageError
from nsmodel.proof.verdict import not_none

POINT_DONE, POINT_FAILED, POINT_LEFT_OUT = "done", "failed", "left out"
SCHEME_LINE, SOLVER_LINE, PEER_LINE = "scheme", "solver", "peer"
ERROR_MEASURES = ("max", "end", "l2", "multipliers", "outputs")
ROUNDING_ERROR = 1e-13  # Relative errors below this, 450 EPS, are rounding and have no order.
# An error is extrapolated to this part of the least one: further, an order seen on a few points says little.
EXTRAPOLATION_LIMIT = 100.0
# An error that falls more slowly than h^STALLED_ORDER from some step on has met its floor; the lowest order of a scheme is 1/2.
STALLED_ORDER = 0.25


@dataclass(frozen=True)
class Point:
    """One run: what it was asked, how far it is from the reference, what it cost.

    Attributes:
        label: what tells it from the other points of its line: "h = 0.01", "rtol = 1e-3".
        seconds: CPU time of the steps alone; None where they were not timed.
        errors: {"max": largest over the grid, "end": at the end, "l2": root mean square in time, "multipliers": mean over
            time, "outputs": of the mean over the run of each declared output, beside its largest value}, without unit; what is
            not known is left out.
        step: the constant step, None where steps vary; steps: their number.
        setup: wall time of the preparation, in seconds.
        residual, violation, energy: worst residual of a step, deepest violated constraint, largest gain of energy.
        status: "done", "failed" or "left out"; message: why.
        unresolved: the errors that are too near to the reference's own to say anything.
    """

    label: str
    seconds: float | None = None
    errors: Mapping[str, float] = field(default_factory=dict)
    step: float | None = None
    steps: int | None = None
    setup: float | None = None
    residual: float | None = None
    violation: float | None = None
    energy: float | None = None
    status: str = POINT_DONE
    message: str = ""
    unresolved: tuple[str, ...] = ()

    __repr__ = short_repr

    @property
    def resolved(self) -> bool:
        """Whether the largest error over the grid says something."""
        return "max" not in self.unresolved

    @property
    def error(self) -> float:
        """The largest error over the grid; NaN where it is not known."""
        return self.errors.get("max", np.nan)

    @property
    def drawn(self) -> bool:
        """Whether the point has a place in the figure: error and time are numbers > 0."""
        return self.status == POINT_DONE and (self.seconds or 0) > 0 and bool(np.isfinite(self.error) and self.error > 0)

    @classmethod
    def failed(cls, label: str, message: str, **known: Any) -> Point:
        """Return a point whose run failed; ``known`` are further fields."""
        return cls(label, status=POINT_FAILED, message=message, **known)

    @classmethod
    def left_out(cls, label: str, message: str, **known: Any) -> Point:
        """Return a point that was not run."""
        return cls(label, status=POINT_LEFT_OUT, message=message, **known)


@dataclass(frozen=True)
class Order:
    """The slope of log error over log h: the least-squares fit, and the least and greatest between neighbours.

    ``points`` took part. ``floor`` is the step from which on the error no longer falls, None where it falls to the end.
    ``exact`` says that all errors are rounding.
    """

    fit: float | None
    least: float | None
    greatest: float | None
    points: int
    floor: float | None
    exact: bool = False


@dataclass(frozen=True)
class Cost:
    """What an error costs on a line; ``how`` it is known: "between points", "at the coarsest point" or "extrapolated"."""

    line: str
    step: float | None
    label: str
    seconds: float
    how: str


@dataclass(frozen=True)
class Line:
    """One method: its points from coarse to fine.

    ``kind`` is "scheme", "solver" (one solver alone: the steps are those of its scheme) or "peer" (another program).
    """

    name: str
    points: tuple[Point, ...]
    note: str = ""
    kind: str = SCHEME_LINE

    __repr__ = short_repr

    @classmethod
    def measured(cls, name: str, points: Sequence[Point | tuple[str, float, float]], note: str = "") -> Line:
        """Return the line of another program: points, or triples (label, largest relative error, CPU seconds).

        ``Study.point`` makes points from a foreign run with the study's own reference and errors.
        """
        made = []
        for point in points:
            if not isinstance(point, Point):
                label, error, seconds = point
                for what, value in (("error", error), ("seconds", seconds)):
                    if not (np.isfinite(value) and value >= 0):
                        raise UsageError(
                            f"line '{name}', {label}: {what} = {value}; expected a number >= 0, or Point.failed(...)"
                        )
                point = Point(str(label), float(seconds), {"max": float(error)})
            made.append(point)
        return cls(name, tuple(made), note, PEER_LINE)

    @property
    def missing_text(self) -> str:
        """How many points have which status but done; "" where none has."""
        gone = {status: sum(point.status == status for point in self.points) for status in (POINT_FAILED, POINT_LEFT_OUT)}
        return ", ".join(f"{count} {status}" for status, count in gone.items() if count)

    def order(self, measure: str = "max") -> Order:
        """Return the observed order of one of the errors."""
        known = [(p.step, p.errors[measure], measure not in p.unresolved) for p in self.points if p.step and measure in p.errors]
        return observed_order(*zip(*sorted(known, reverse=True), strict=True)) if known else observed_order([], [])

    def cost(self, target: float, own: float = 0.0) -> Cost | None:
        """Return what the error ``target`` costs here, by interpolation of the logarithms; None where it is not reached.

        ``own``, the reference's own error, is added to the errors: they are at most that. Errors beyond the last point are
        extrapolated, to 1/EXTRAPOLATION_LIMIT of it at most, where it is resolved and the error still falls.
        """
        points = [p for p in self.points if p.drawn]
        errors, seconds = np.array([p.error + own for p in points]), np.array([p.seconds for p in points])
        above = np.flatnonzero(errors > target)
        if not points or target <= own:
            return None
        if not above.size:
            return Cost(self.name, points[0].step, points[0].label, not_none(points[0].seconds), "at the coarsest point")
        i, how = int(above[-1]), "between points"
        if i == len(points) - 1:
            if len(points) < 2 or not points[i].resolved or target < errors[i] / EXTRAPOLATION_LIMIT:
                return None
            if errors[i] > errors[i - 1] * 0.5**STALLED_ORDER or self.order().floor is not None:
                return None
            i, how = i - 1, "extrapolated"
        weight = float(np.log(errors[i] / target) / np.log(errors[i] / errors[i + 1]))
        wide, near = points[i : i + 2]
        step = wide.step * (near.step / wide.step) ** weight if wide.step and near.step else None
        label = near.label if step is None else f"h = {step:.3g}"
        return Cost(self.name, step, label, float(seconds[i] * (seconds[i + 1] / seconds[i]) ** weight), how)


def observed_order(steps: Sequence[float], errors: Sequence[float], resolved: Sequence[bool] | None = None) -> Order:
    """Return the order seen in errors at falling steps.

    Unresolved points, errors at the level of rounding and what lies on the floor take no part in the fit.
    """
    h, e = np.asarray(steps, float), np.asarray(errors, float)
    good = e > ROUNDING_ERROR if resolved is None else (e > ROUNDING_ERROR) & np.asarray(resolved, bool)
    at = find_error_floor(h, e)
    if at is not None:
        good &= np.arange(h.size) < at
    floor = None if at is None else float(h[at])
    x, y = np.log(h[good]), np.log(e[good])
    if x.size < 2:
        return Order(None, None, None, int(x.size), floor, bool(h.size and (e <= ROUNDING_ERROR).all()))
    slopes = [float((b - a) / (d - c)) for (a, b), (c, d) in zip(pairwise(y), pairwise(x), strict=True)]
    return Order(float(np.polyfit(x, y, 1)[0]), min(slopes), max(slopes), int(x.size), floor)


def find_error_floor(h: np.ndarray, e: np.ndarray) -> int | None:
    """The first point from which on errors fall more slowly than h^STALLED_ORDER, seen at two finer ones at least; else None."""
    for i in range(h.size - 2):
        if (e[i + 1 :] > e[i] * (h[i + 1 :] / h[i]) ** STALLED_ORDER).all() or (e[i:] <= ROUNDING_ERROR).all():
            return i
    return None


def least_cost(lines: Sequence[Line], target: float, own: float = 0.0) -> Cost | None:
    """Return the least cost of the error ``target``: extrapolated only where no line reaches it; None where none would."""
    costs = [cost for line in lines if (cost := line.cost(target, own)) is not None]
    reached = [cost for cost in costs if cost.how != "extrapolated"]
    return min(reached or costs, key=lambda cost: cost.seconds, default=None)
