"""Parameters: numbers, vectors and matrices, declared and given by symbol or by name.

Numbers in place of symbols, wherever these stand in a model.

Arguments that all classes share: units, names of the states, the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from nsmodel._utils import did_you_mean
from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.modeling.conversion import DeclaredSymbols, common_stem, declare

Values = Mapping[Any, Any]  # {symbol or name: number, list, array or None}

try:  # CasADi means vectors of SX to be keys of dictionaries, as those of MX are, but the hash it falls back on is not theirs.
    hash(ca.SX.sym("x", 2))
except NotImplementedError:
    ca.SX.__hash__ = lambda self: self.element_hash() if self.is_scalar() else id(self)


def declare_parameters(given: Any) -> tuple[list[DeclaredSymbols], dict[str, float | None], dict[str, np.ndarray]]:
    """Read ``parameters=``: the symbols, {name: value} of each scalar, {name: names of its entries} of each vector and matrix.

    The entries of a vector or matrix th are th_0, th_1, ..., column by column, as those of ``ca.SX.sym("th", 2, 3)``.

    Raises:
        ModelError: no dictionary, a name that repeats, values of another shape than their symbol, what is not a finite number.
    """
    if not isinstance(given, Mapping):
        raise ModelError(f"parameters: expected a dictionary {{symbol or name: value}}, not a {type(given).__name__}")
    symbols: list[DeclaredSymbols] = []
    values: dict[str, float | None] = {}
    vectors: dict[str, np.ndarray] = {}
    for key, value in given.items():
        names = _numbered_names(key, np.shape(_object_array(value))) if isinstance(key, str) else _scalar_names(key)
        symbol = declare(names.ravel(order="F").tolist() if isinstance(key, str) else key, "parameters")
        whole = _common_name(names)
        for name in {*symbol.names, whole or symbol.names[0]}:
            if name in values or name in vectors:
                raise ModelError(f"parameters: '{name}' is declared twice; keep one")
        filled = _entry_values(names, value, _parameter_label(key, names), ModelError)
        values |= {name: filled[name] for name in symbol.names}
        if names.size > 1 and whole is not None:
            vectors[whole] = names
        symbols.append(symbol)
    return symbols, values, vectors


def scalar_values(values: Any, known: Mapping[str, Any], vectors: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    """Return {name: value} of each scalar in ``values``, which may speak of whole vectors and matrices, by name or symbol.

    Raises:
        UsageError: no dictionary, a name that is not among those ``known``, one that is given twice, values of another shape.
        ModelError: what is not a finite number.
    """
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise UsageError(f"parameters: expected a dictionary {{name: value}}, not a {type(values).__name__}")
    found: dict[str, float | None] = {}
    for key, value in values.items():
        names = _scalar_names(key) if not isinstance(key, str) else vectors.get(key, np.array(key))
        whole = None if isinstance(key, str | tuple) else vectors.get(_common_name(names) or "")
        if whole is not None and set(whole.flat) != set(names.flat):
            names = whole
        for name in names.ravel().tolist():
            if name not in known:
                raise UsageError(
                    f"parameter '{name}' is not declared; the model has {', '.join(gather_values(known, vectors)) or 'none'}"
                    + (
                        did_you_mean(name, [*vectors, *known])
                        or f"; an argument of a file's model() goes to load(FILE, {name}=...)"
                    )
                )
            if name in found:
                raise UsageError(f"parameter '{name}' is given twice; keep one")
        found |= _entry_values(names, value, _parameter_label(key, names), UsageError)
    return found


def split_boxes(values: Any, known: Mapping[str, Any]) -> tuple[Any, dict[str, tuple[float, float]]]:
    """Return the values that are numbers, and {name: (low, high)} of the parameters that are given as a pair: all between.

    Raises:
        UsageError: no interval low < high of finite numbers.
    """
    if not isinstance(values, Mapping):
        return values, {}
    numbers, boxes = {}, {}
    for key, value in values.items():
        names = np.array(key) if isinstance(key, str) else _scalar_names(key)
        name = str(names) if names.ndim == 0 else ""
        if name not in known or not isinstance(value, tuple | list) or len(value) != 2:
            numbers[key] = value
            continue
        boxes[name] = finite_interval(f"parameter {name}", value)
    return numbers, boxes


def finite_interval(label: str, value: Any) -> tuple[float, float]:
    """Return the ends of an interval that a user gave.

    Raises:
        UsageError: it is no pair low < high of finite numbers.
    """
    try:
        low, high = (float(end) for end in value)
    except (TypeError, ValueError):
        low = high = np.nan
    if not -np.inf < low < high < np.inf:
        raise UsageError(f"{label} = {value!r}; expected a pair (low, high) of finite numbers, low < high")
    return low, high


def gather_values(values: Mapping[str, Any], vectors: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return {name: value} of each parameter as it was declared: the inverse of `scalars`."""
    inside = {entry: name for name, names in vectors.items() for entry in names.ravel().tolist()}
    whole = {name: np.vectorize(values.get, otypes=[object])(names) for name, names in vectors.items()}
    return {inside.get(name, name): whole.get(inside.get(name, name), value) for name, value in values.items()}


def finite_number(value: Any, label: str) -> float:
    """A finite number; else ModelError."""
    try:
        if isinstance(value, str | bool | np.bool_ | complex | np.complexfloating | ca.SX | ca.MX):
            raise TypeError
        found = float(value)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        raise ModelError(f"{label} = {value!r} is not a number") from None
    if not np.isfinite(found):
        raise ModelError(f"{label} = {found}; expected a finite number")
    return found


def _scalar_names(key: Any) -> np.ndarray:
    """The names of a symbol's scalars, in its shape: () for one, (n,) for a vector, (r, c) for a matrix."""
    names = np.array(declare(key, "parameters").names)
    shape = tuple(getattr(key, "shape", names.shape))
    if len(shape) != 2 or 1 in shape or names.size != np.prod(shape):
        return names if names.size > 1 else names.reshape(())
    return names.reshape(shape, order="C" if hasattr(key, "tolist") else "F")  # SymPy lists the entries of a matrix by rows


def _numbered_names(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The names of a parameter that is given by its own name, from the shape of its value."""
    size = int(np.prod(shape))
    if size < 2 or len(shape) > 2:
        return np.array(name)
    names = np.array([f"{name}_{i}" for i in range(size)])
    return names if 1 in shape else names.reshape(shape, order="F")


def _parameter_label(key: Any, names: np.ndarray) -> str:
    """What a message calls a parameter."""
    return key if isinstance(key, str) else _common_name(names) or ", ".join(names.ravel(order="F").tolist())


def _common_name(names: np.ndarray) -> str | None:
    """The name W of the entries W_0, W_1, ..., column by column or row by row; None where there is none."""
    return common_stem(names.ravel(order="F").tolist()) or common_stem(names.ravel().tolist())


def _object_array(value: Any) -> np.ndarray:
    """A value as an array of objects; what has no shape is one."""
    value = np.array(value) if isinstance(value, ca.DM) else value.toarray() if hasattr(value, "toarray") else value
    try:
        return np.array(value, dtype=object)
    except (TypeError, ValueError):  # symbols; blocks that do not fit together
        box = np.empty((), dtype=object)
        box[()] = value
        return box


def _entry_values(names: np.ndarray, value: Any, label: str, error: type[NsmodelError]) -> dict[str, float | None]:
    """{name: number} of the scalars of one parameter; None where the value is still to be given."""
    array = np.full(names.shape, None) if value is None else _object_array(value)
    flat = names.ndim < 2 and array.size == names.size and (array.ndim < 2 or 1 in array.shape)
    if not (flat or array.shape == names.shape):
        raise error(f"parameter '{label}': {_shape_text(array)}; expected {_expected_shape_text(names)}")
    pairs = zip(names.ravel().tolist(), array.ravel().tolist(), strict=True)
    return {name: None if one is None else finite_number(one, f"parameter '{name}'") for name, one in pairs}


def _shape_text(array: np.ndarray) -> str:
    return f"shape {array.shape}" if array.ndim > 1 else f"{array.size} value{'' if array.size == 1 else 's'}"


def _expected_shape_text(names: np.ndarray) -> str:
    entries = names.ravel(order="F").tolist()
    if names.ndim == 2:
        return f"a matrix of shape {names.shape}, a list of its rows ({entries[0]}, ..., {entries[-1]} column by column)"
    if names.size == 1:
        return "one number"
    return f"{names.size}, one for each of {', '.join(entries if names.size < 5 else [*entries[:2], '...', entries[-1]])}"


UNCHANGED_FIELDS = frozenset({"p", "t", "u", "parameters", "inputs"})  # What is left as it is.

T = TypeVar("T")


def substitute_in_model(model: T, symbols: ca.SX, values: ca.SX) -> T:
    """A copy of the model with values in place of symbols, in its signals too."""
    other = map_expressions(model, lambda expression: ca.substitute(expression, symbols, values))
    inputs: Mapping[str, Any] = getattr(model, "inputs", {})
    put = {name: None if signal is None else signal.with_values(symbols, values) for name, signal in inputs.items()}
    object.__setattr__(other, "inputs", MappingProxyType(put))
    return other


def time_as_parameter(model: Any) -> Any:
    """The model that stands still at t, the last of its parameters without value."""
    frozen, parameters = copy(model), MappingProxyType({**model.parameters, str(model.t): None})
    frozen._set(p=ca.vertcat(model.p, model.t), t=ca.SX.sym("t"), parameters=parameters)
    return frozen


def map_expressions(model: T, change: Callable[[ca.SX], ca.SX]) -> T:
    """A copy of the model with each of its expressions changed."""

    def put(expression: Any) -> Any:
        if isinstance(expression, ca.SX):
            return change(expression) if expression.numel() else expression
        if is_dataclass(expression) and not isinstance(expression, type):
            return replace(expression, **{f.name: put(getattr(expression, f.name)) for f in fields(expression)})
        if isinstance(expression, tuple):
            items = [put(item) for item in expression]
            return type(expression)(*items) if hasattr(expression, "_fields") else tuple(items)
        if isinstance(expression, Mapping):
            return MappingProxyType({key: put(item) for key, item in expression.items()})
        return expression

    other = copy(model)
    for name, value in vars(model).items():
        if name not in UNCHANGED_FIELDS:
            object.__setattr__(other, name, put(value))
    return other


def named_expressions(model: Any) -> Iterator[tuple[str, ca.SX]]:
    """The expressions of a model that are to be finite, with their places: bounds and ends of laws may be infinite."""

    def within(label: str, value: Any) -> Iterator[tuple[str, ca.SX]]:
        if isinstance(value, ca.SX):
            yield from [(label, value)] if value.numel() else []
        elif is_dataclass(value) and not isinstance(value, type):
            yield from (one for f in fields(value) for one in within(f"{label}.{f.name}", getattr(value, f.name)))
        elif isinstance(value, tuple):
            names = getattr(value, "_fields", range(len(value)))
            yield from (one for name, item in zip(names, value, strict=True) for one in within(f"{label}.{name}", item))
        elif isinstance(value, Mapping):
            yield from (one for key, item in value.items() for one in within(f"{label}['{key}']", item))

    for name, value in vars(model).items():
        if name not in UNCHANGED_FIELDS and name not in ("lower", "upper", "law", "exact"):
            yield from within(name, value)


# Attributes of every Trajectory: a state may not take these names.
RESERVED_RUN_NAMES = frozenset(
    "t multipliers y inputs inputs_begin "
    "index_set residual step active status title arrays metadata multiplier contacts save load to_csv to_pandas to_xarray "
    "plot film view summary summary_text energy reactions newton gap residual_R residual_Ry residual_Rr defect selection "
    "evaluate integral mean rms spectrum "
    "halving predictor_distance excess tolerance at events is_event_driven smooth error_estimate "
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
