"""Arguments that all classes share: units, names of the states, the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nsmodel.errors import ModelError, NsmodelError
from nsmodel.model.convert import DeclaredSymbols
from nsmodel.model.parameters import finite_number

# Attributes of every Trajectory: a state may not take these names.
RESERVED_RUN_NAMES = frozenset(
    "t multipliers y inputs inputs_begin "
    "index_set residual step active status title arrays metadata multiplier contacts save load to_csv to_pandas to_xarray "
    "plot view summary summary_text energy reactions newton gap residual_R residual_Ry residual_Rr defect selection "
    "evaluate integral mean rms spectrum "
    "predictor_distance excess tolerance at events is_event_driven smooth error_estimate "
    "piece_start piece_unit piece_x piece_multipliers piece_y piece_codes piece_event piece_stepped stepped".split()
)


def read_units(units: Any) -> dict[str, str]:
    """``units`` as a dictionary."""
    given = {} if units is None else units
    if not isinstance(given, Mapping) or not all(isinstance(part, str) for pair in given.items() for part in pair):
        raise ModelError(f"units: {given!r}; expected a dictionary {{name: unit}} of strings, such as {{'t': 's', 'q': 'm'}}")
    return dict(given)


def state_names_and_stems(
    names: Sequence[str] | None, state: DeclaredSymbols, label: str, has: Mapping[str, str]
) -> tuple[list[str], dict[str, list[int]]]:
    """The names of the states, and the columns of each symbol."""
    n = len(state.names)
    if names is not None:
        row = isinstance(names, list | tuple) or (isinstance(names, np.ndarray) and names.ndim == 1)
        listed = row and all(isinstance(name, str) and name for name in names)
        if not listed or len(names) != n:
            raise ModelError(f"names: {names!r}; expected a list of {n} names, one for each of {', '.join(state.names)}")
        chosen, stems = list(map(str, names)), {str(name): [i] for i, name in enumerate(names)}
    elif state.stem is not None:
        chosen, stems = list(state.names), {state.stem: list(range(n))}
    else:
        chosen, stems = list(state.names), {name: [i] for i, name in enumerate(state.names)}
    if len(set(chosen)) != n:
        raise ModelError(f"names: {chosen} repeats a name; give each state its own")
    for name in stems:
        whole = name == "x" and n > 1 and len(stems) > 1
        if name in RESERVED_RUN_NAMES or name in has or whole:
            what = has.get(name, "which holds all states" if whole else "an attribute of runs")
            where = f"names: '{name}'" if names is not None else f"{label}: the state '{name}'"
            fix = f"take another name, such as '{name}1'" if names is not None else "rename it, or give names=[...], one for each"
            raise ModelError(f"{where} clashes with run.{name}, {what}; {fix}")
    return chosen, stems


def numbered_row_names(name: str, size: int) -> list[str]:
    """The names of the rows of what the user gave one name: name, or name[0], name[1], ..."""
    return [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]


def check_grid_arguments(t_end: Any, step: Any, steps: Any) -> dict[str, Any]:
    """``t_end``, ``step`` and ``steps``, of which two are given."""
    if steps is not None:
        if step is not None:
            raise ModelError("step and steps are both given; keep one")
        array = step_array(steps, ModelError)
        total = float(array.sum())
        if t_end is not None and abs(finite_number(t_end, "t_end") - total) > 1e-9 * total:
            raise ModelError(f"t_end = {t_end:g} but the steps sum to {total:g}; leave t_end out")
        return {"steps": array, "t_end": total, "step": None}
    if t_end is None:
        raise ModelError("t_end is missing; give the end of the run, a number > 0")
    found = {"t_end": finite_number(t_end, "t_end"), "step": None if step is None else finite_number(step, "step")}
    for name, value in found.items():
        if value is not None and value <= 0:
            raise ModelError(f"{name} = {value:g}; expected a number > 0")
    return found


def step_array(steps: Any, error: type[NsmodelError]) -> np.ndarray:
    """The steps h_0, h_1, ... as an array; ``error`` where they are no finite numbers > 0."""
    try:
        array = np.asarray(steps, float)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        array = None
    if array is None or array.ndim != 1:
        raise error(f"steps: expected a list or 1-D array of numbers > 0, not {describe_argument(steps)}")
    bad = np.flatnonzero(~(np.isfinite(array) & (array > 0)))
    if bad.size or not array.size:
        where = f"steps[{bad[0]}] = {array[bad[0]]:g}" if bad.size else "steps is empty"
        raise error(f"{where}; expected finite numbers > 0")
    return array


def check_switch_times(given: Any) -> tuple[float, ...]:
    """``switch_times`` as a tuple; ModelError where they are no increasing finite numbers >= 0."""
    given = () if given is None else given
    if not (isinstance(given, list | tuple) or (isinstance(given, np.ndarray) and given.ndim == 1)):
        raise ModelError(f"switch_times: expected a list or 1-D array of times, not {describe_argument(given)}")
    times = tuple(finite_number(value, f"switch_times[{i}]") for i, value in enumerate(given))
    for i, time in enumerate(times):
        if time < 0:
            raise ModelError(f"switch_times[{i}] = {time:.10g}; expected times >= 0: a run begins at 0")
        if i and time <= times[i - 1]:
            raise ModelError(
                f"switch_times[{i}] = {time:.10g} is not after switch_times[{i - 1}] = {times[i - 1]:.10g}; give them in order"
            )
    return times


def describe_argument(value: Any) -> str:
    """A value as a message shows it: short, with its type."""
    text = " ".join(repr(value).split())
    return f"{text if len(text) <= 60 else text[:57] + '...'} (a {type(value).__name__})"
