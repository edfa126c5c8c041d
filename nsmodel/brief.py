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

WIDTH, LINES = 100, 10
FEW = 4  # Entries of a list, and of a dictionary, that are shown.
NUMBERS = 6  # Of an array.
LONG = 60  # Characters of one value.


def brief(self: Any) -> str:
    """Return class and fields, those left out that are None or empty: at most ten lines of 100 columns.

    Long values are cut, arrays and matrices given by their shape.

    >>> from types import SimpleNamespace
    >>> made = SimpleNamespace(name="wall", at=np.zeros((300, 2)), over=None)
    >>> brief(made)
    "SimpleNamespace(name='wall', at=array 300 x 2)"
    """
    parts = [f"{name}={in_short(value)}" for name, value in _fields(self) if not _is_nothing(value)]
    return "\n".join(wrapped(f"{type(self).__name__}({', '.join(parts)})"))


def in_short(value: Any) -> str:
    """A value in at most 60 characters."""
    if isinstance(value, str):
        return repr(cut(value, LONG - 2))
    if isinstance(value, bool | int) or value is None:
        return cut(str(value))
    if isinstance(value, float | np.number):
        return f"{value:.6g}"
    if isinstance(value, ca.SX | ca.MX | ca.DM):
        return _expression(value)
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Mapping):
        return cut(f"{{{_few((f'{key}: {in_short(one)}' for key, one in value.items()), len(value))}}}")
    if isinstance(value, tuple | list):
        return cut(f"({_few(map(in_short, value), len(value))})")
    if callable(value) and hasattr(value, "__name__"):
        return cut(value.__name__)
    return cut(repr(value))


def cut(text: str, width: int = LONG) -> str:
    """The text on one line, its end left out where it is longer."""
    text = " ".join(one_line(text).split())
    return text if len(text) <= width else f"{text[: width - 4].rstrip()} ..."


def listed(items: Iterable[str], width: int = WIDTH) -> str:
    """Items with commas, as many as have room, and how many more there are.

    >>> listed(["one", "two", "three", "four"], 16)
    'one, ... 3 more'
    """
    items = list(items)
    room, kept = width - len(f", ... {len(items)} more"), 0
    if len(", ".join(items)) <= width:
        return ", ".join(items)
    while kept < len(items) and len(", ".join(items[: kept + 1])) <= room:
        kept += 1
    return ", ".join([*items[:kept], f"... {len(items) - kept} more"]) if kept or len(items) > 1 else cut(items[0], width)


def wrapped(text: str) -> list[str]:
    """The text in lines of 100 columns, ten at most."""
    lines = textwrap.wrap(text, WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    return lines if len(lines) <= LINES else [*lines[: LINES - 1], "    ..."]


def _fields(made: Any) -> list[tuple[str, Any]]:
    if is_dataclass(made):
        return [(field.name, getattr(made, field.name)) for field in fields(made) if field.repr]
    if hasattr(made, "_asdict"):
        return list(made._asdict().items())
    return list(getattr(made, "made_of", vars(made)).items())


def _is_nothing(value: Any) -> bool:
    return value is None or (isinstance(value, str | tuple | list | Mapping) and not len(value))


def _expression(value: Any) -> str:
    """One expression as it stands; of a matrix its shape, where it does not fit."""
    text = str(value)
    return text if len(text) <= LONG else cut(text) if value.numel() == 1 else f"{type(value).__name__} {_shape(value.shape)}"


def _array(value: np.ndarray) -> str:
    if (value.ndim > 1 and value.size > 1) or value.size > NUMBERS:
        return f"array {_shape(value.shape)}"
    return f"[{', '.join(map(in_short, value.ravel().tolist()))}]"


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _few(items: Iterable[str], count: int) -> str:
    shown = [item for item, _ in zip(items, range(FEW), strict=False)]
    return ", ".join([*shown, *([f"... {count} in all"] if count > FEW else [])])


def number(value: float) -> str:
    """A number with six digits, zero without a sign."""
    return f"{value + 0.0:.6g}" if isfinite(value) else str(value)
