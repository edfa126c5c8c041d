"""What a run under error control is asked for, checked: tolerances and the times of rows; how large a model may be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.grid import format_value, is_number
from nsmodel.pieces.integrator import MIN_RTOL
from nsmodel.scheme.continuous import ContinuousProblem

MAX_EVENT_DRIVEN_OPERATIONS = 10_000  # Operations of f, g and h up to which "auto" is event-driven.


def operation_count(p: ContinuousProblem) -> int:
    """Of f, g and h."""
    return sum(ca.n_nodes(part) for part in (p.f, p.g, p.h))


def checked_tolerances(problem: ContinuousProblem, rtol: Any, atol: Any) -> tuple[float, list[float]]:
    """Rtol, and atol of each state; UsageError for what is none."""
    return checked_rtol(rtol), np.resize(checked_atol(atol, problem.names[: problem.states]), len(problem.names)).tolist()


def checked_rtol(rtol: Any) -> float:
    """Rtol; UsageError for what is none."""
    if not (is_number(rtol) and MIN_RTOL <= rtol < 1):
        raise UsageError(
            f"rtol = {format_value(rtol)}; expected a number between {MIN_RTOL:g} and 1: doubles hold no more than 16 digits"
        )
    return float(rtol)


def checked_atol(atol: Any, names: Sequence[str]) -> np.ndarray:
    """Atol (1,) or of each state (n,); UsageError for what is none."""
    try:
        array = np.asarray(0.0 if atol is None else atol, float)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.ndim > 1 or array.size not in (1, len(names)) or not (np.isfinite(array) & (array >= 0)).all():
        raise UsageError(f"atol = {atol!r}; expected a number >= 0, or one for each of {', '.join(names)}")
    return array


def checked_row_times(given: Any, T: float) -> list[float]:
    """The times of the rows after the start; UsageError for what is no increasing list from 0 to T."""
    try:
        found = np.asarray(given, float)
    except (TypeError, ValueError):
        found = np.full(1, np.nan)
    if found.ndim != 1 or not found.size or not np.isfinite(found).all():
        raise UsageError("times: expected a list of finite numbers, the times of the rows")
    wrong = np.flatnonzero(np.diff(found) <= 0)
    if wrong.size:
        i = int(wrong[0])
        raise UsageError(f"times[{i + 1}] = {found[i + 1]:.10g} is not after times[{i}] = {found[i]:.10g}; give them in order")
    outside = np.flatnonzero((found < 0) | (found > T))
    if outside.size:
        i = int(outside[0])
        raise UsageError(f"times[{i}] = {found[i]:.10g} is outside the run, from 0 to t_end = {T:.10g}")
    return found[found > 0].tolist()
