"""What rounding is told beside: how large everything has been so far."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.model.expressions import derivatives
from nsmodel.proof.buffered import attach_buffers
from nsmodel.scheme.continuous import ContinuousProblem

NEGLIGIBLE = 1e-6  # Of what moves a state on a piece.
ROUNDING = 8 * 2.0**-53  # c u, of the bound of running error analysis: of what a number is the sum of, that much is rounding.


@dataclass
class StateScales:
    """The largest of each x, y, l and argument of a switch so far; of l in an interval at least its width."""

    x: list[float]
    y: list[float]
    l: list[float]
    switches: list[float]


class ZeroTest:
    """``of(t, x, l, sizes, time)``: a part of what x of these sizes move each x by in this time, to first order at a point.

    What moves by less is measured beside it: the same in all units of each x. What multipliers move it by says nothing: where
    walls push against each other they are as large as they like.
    """

    def __init__(self, problem: ContinuousProblem) -> None:
        self._problem = problem

    @cached_property
    def _compiled_motion(self) -> tuple[np.ndarray, np.ndarray, Any, Callable[[], None]]:
        symbols, moved = state_motion(self._problem)
        given = ca.vertcat(*symbols.values())
        array, found = np.zeros(given.numel()), np.zeros(moved.numel())
        return array, found, *attach_buffers(ca.Function("moves", [given], [ca.densify(moved)]), [array], [found])

    def __call__(self, t: float, x: list[float], l: list[float], sizes: list[float], time: float) -> list[float]:
        """0 where there is no number."""
        given, found, _, call = self._compiled_motion
        given[:] = [t, *x, *l, *sizes]
        call()
        part = NEGLIGIBLE * time
        return [part * v if math.isfinite(v) else 0.0 for v in found.tolist()]


def state_motion(problem: ContinuousProblem) -> tuple[dict[str, ca.SX], ca.SX]:
    """t, x, l and sizes of x; by what states of these sizes move each x in the unit of time."""
    p = problem
    of_x = ca.SX.sym("of_x", p.x.numel())
    return {"t": p.t, "x": p.x, "l": p.l, "of_x": of_x}, ca.fabs(derivatives(p.f + p.g, p.x)) @ of_x
