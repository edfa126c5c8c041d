"""What a run is, for resuming it: a hash of the model, the settings, the versions."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.modeling.base import Model
from nsmodel.modeling.parts import Part
from nsmodel.modeling.pickling import Picklable
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.proof.expression_graph import stack_column
from nsmodel.version import VERSION

# What only names or describes a run does not change its numbers; the grid is a setting of its own, and so are inputs.
DESCRIPTIVE_FIELDS = frozenset("exact title units scene t_end step steps t p parameters vectors inputs".split())

# Models have not always had these: where they are 0 or empty the hash is what it was.
FIELDS_ADDED_SINCE = frozenset({"blocks", "e", "force", "outputs"})
PYTHON_VERSION = platform.python_version()
BACKEND_SETTING = "way of stepping"  # The setting that says whether steps are compiled, and by what: their last bits differ.
INTERPRETED_BACKEND = "interpreted"
ALL_VALUES_SUFFIX = "one library for all values"  # How the way of compiled steps ends whose parameters are set when they run.


def run_settings(model: Model, grid: TimeGrid, solver: str, tolerance: float, save_every: int, backend: str) -> dict[str, Any]:
    """All that a run's numbers depend on, t_end excepted: a run may be continued to a later end."""
    step = grid.h if grid.steps is None else grid.requested_step or f"{grid.N} given steps, {content_digest([grid.steps])}"
    driven = {"inputs": content_digest([dict(model.inputs)])} if model.inputs else {}
    return {
        "model": fingerprint(model, grid),
        "step": step,
        **driven,
        "solver": solver,
        "tolerance": tolerance,
        "save every": save_every,
        BACKEND_SETTING: backend,
        **{f"version of {name}": number for name, number in versions().items()},
    }


def settings_difference(saved: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """Name the first setting that differs: "another step (0.1 there, 0.2 now)"; None where all agree."""
    for key, value in now.items():
        if saved.get(key) != value:
            return "another model" if key == "model" else f"another {key} ({saved.get(key)} there, {value} now)"
    return None


# The values by which functions in Python are known.
FUNCTION_VALUES = Part[Callable[[Any, TimeGrid], Sequence[Any]]]("model.values_of_functions")


def fingerprint(model: Model, grid: TimeGrid) -> str:
    """A hash of the bound model's expressions, laws and numbers."""
    digest, own = _model_hash(model).copy(), FUNCTION_VALUES.optional(model)
    if own is not None:
        _update_digest(digest, list(own(model, grid)))
    return digest.hexdigest()[:16]


@cached_per_object
def _model_hash(model: Model) -> Any:
    """The hash so far of all that a model is but its grid."""
    digest = hashlib.sha256()
    left = DESCRIPTIVE_FIELDS if model.inputs else DESCRIPTIVE_FIELDS | {"u", "input_groups"}
    left |= {name for name in FIELDS_ADDED_SINCE if _is_zero_or_empty(vars(model).get(name))}
    _update_digest(digest, [type(model).__name__, {k: v for k, v in sorted(vars(model).items()) if k not in left}])
    return digest


def _is_zero_or_empty(value: Any) -> bool:
    return value.is_zero() if isinstance(value, ca.SX) else not value


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    casadi = ca.__version__  # pyrefly: ignore[missing-attribute]
    return {"nsmodel": VERSION, "casadi": casadi, "numpy": np.__version__, "python": PYTHON_VERSION}


def content_digest(items: list[Any]) -> str:
    """A hash of numbers, texts, expressions and what is made of them; functions have none."""
    digest = hashlib.sha256()
    _update_digest(digest, items)
    return digest.hexdigest()[:16]


def _update_digest(digest: Any, items: list[Any]) -> None:
    def add(item: Any) -> None:
        if isinstance(item, ca.SX):
            digest.update(ca.Function("e", [stack_column(ca.symvar(item))], [item]).serialize().encode())
        elif is_dataclass(item) and not isinstance(item, type):
            for field in fields(item):
                add(getattr(item, field.name))
        elif isinstance(item, Picklable):
            add(item.made_of)
        elif isinstance(item, Mapping):
            for key, value in item.items():
                digest.update(str(key).encode())
                add(value)
        elif isinstance(item, tuple | list):
            for value in item:
                add(value)
        elif isinstance(item, np.ndarray):
            digest.update(item.tobytes())
        elif not callable(item):
            digest.update(repr(item).encode())

    add(items)
