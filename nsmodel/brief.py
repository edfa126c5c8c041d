"""What an object is, in ten lines at most: the ``repr`` of what would print all of its arrays and expressions."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.words import one_line

REPR_WIDTH, REPR_LINES = 100, 10
MAX_ENTRIES = 4  # Entries of a list, and of a dictionary, that are shown.
MAX_ARRAY_NUMBERS = 6  # Of an array.
MAX_VALUE_LENGTH = 60  # Characters of one value.


def short_repr(self: Any) -> str:
    """Return class and fields, those left out that are None or empty: at most ten lines of 100 columns.

    Long values are cut, arrays and matrices given by their shape.

    >>> from types import SimpleNamespace
    >>> made = SimpleNamespace(name="wall", at=np.zeros((300, 2)), over=None)
    >>> short_repr(made)
    "SimpleNamespace(name='wall', at=array 300 x 2)"
    """
    parts = [f"{name}={describe_shortly(value)}" for name, value in _repr_fields(self) if not _is_empty_value(value)]
    return "\n".join(wrap_lines(f"{type(self).__name__}({', '.join(parts)})"))


def describe_shortly(value: Any) -> str:
    """A value in at most 60 characters."""
    if isinstance(value, str):
        return repr(truncate_text(value, MAX_VALUE_LENGTH - 2))
    if isinstance(value, bool | int) or value is None:
        return truncate_text(str(value))
    if isinstance(value, float | np.number):
        return f"{value:.6g}"
    if isinstance(value, ca.SX | ca.MX | ca.DM):
        return _describe_expression(value)
    if isinstance(value, np.ndarray):
        return _describe_array(value)
    if isinstance(value, Mapping):
        return truncate_text(
            f"{{{_first_entries((f'{key}: {describe_shortly(one)}' for key, one in value.items()), len(value))}}}"
        )
    if isinstance(value, tuple | list):
        return truncate_text(f"({_first_entries(map(describe_shortly, value), len(value))})")
    if callable(value) and hasattr(value, "__name__"):
        return truncate_text(value.__name__)
    return truncate_text(repr(value))


def truncate_text(text: str, width: int = MAX_VALUE_LENGTH) -> str:
    """The text on one line, its end left out where it is longer."""
    text = " ".join(one_line(text).split())
    return text if len(text) <= width else f"{text[: width - 4].rstrip()} ..."


def join_within_width(items: Iterable[str], width: int = REPR_WIDTH) -> str:
    """Items with commas, as many as have room, and how many more there are.

    >>> join_within_width(["one", "two", "three", "four"], 16)
    'one, ... 3 more'
    """
    items = list(items)
    room, kept = width - len(f", ... {len(items)} more"), 0
    if len(", ".join(items)) <= width:
        return ", ".join(items)
    while kept < len(items) and len(", ".join(items[: kept + 1])) <= room:
        kept += 1
    return (
        ", ".join([*items[:kept], f"... {len(items) - kept} more"]) if kept or len(items) > 1 else truncate_text(items[0], width)
    )


def wrap_lines(text: str) -> list[str]:
    """The text in lines of 100 columns, ten at most."""
    lines = textwrap.wrap(text, REPR_WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    return lines if len(lines) <= REPR_LINES else [*lines[: REPR_LINES - 1], "    ..."]


def _repr_fields(made: Any) -> list[tuple[str, Any]]:
    if is_dataclass(made):
        return [(field.name, getattr(made, field.name)) for field in fields(made) if field.repr]
    if hasattr(made, "_asdict"):
        return list(made._asdict().items())
    return list(getattr(made, "made_of", vars(made)).items())


def _is_empty_value(value: Any) -> bool:
    return value is None or (isinstance(value, str | tuple | list | Mapping) and not len(value))


def _describe_expression(value: Any) -> str:
    """One expression as it stands; of a matrix its shape, where it does not fit."""
    text = str(value)
    return (
        text
        if len(text) <= MAX_VALUE_LENGTH
        else truncate_text(text)
        if value.numel() == 1
        else f"{type(value).__name__} {_format_shape(value.shape)}"
    )


def _describe_array(value: np.ndarray) -> str:
    if (value.ndim > 1 and value.size > 1) or value.size > MAX_ARRAY_NUMBERS:
        return f"array {_format_shape(value.shape)}"
    return f"[{', '.join(map(describe_shortly, value.ravel().tolist()))}]"


def _format_shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _first_entries(items: Iterable[str], count: int) -> str:
    kept = [item for item, _ in zip(items, range(MAX_ENTRIES), strict=False)]
    return ", ".join([*kept, *([f"... {count} in all"] if count > MAX_ENTRIES else [])])


def format_number(value: float) -> str:
    """A number with six digits, zero without a sign."""
    return f"{value + 0.0:.6g}" if isfinite(value) else str(value)
