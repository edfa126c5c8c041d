"""Inputs on the command line: ``--input NAME=FILE.csv[,kind=...][,after=...][,period=...]`` or ``--input NAME=NUMBER``."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.cli.settings import unique_by_name
from nsmodel.errors import ModelError, UsageError
from nsmodel.modeling.signals import Signal, table

INPUT_OPTIONS = ("kind", "after", "period")


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add the option --input."""
    parser.add_argument(
        "--input", action="append", default=[], metavar="NAME=FILE.csv",
        help="signal of an input: a number, or a table of rows t, value, ...; behind commas kind=hold|linear|cubic, "
        "after=hold|error|periodic, period=T; repeatable",
    )  # fmt: skip


def parse_inputs(texts: Sequence[str], groups: Any) -> dict[str, float | Signal]:
    """The signals by the names of inputs; ``groups``: names of their entries, see `Model.input_groups`."""
    return unique_by_name([_parse_input(text, groups) for text in texts], "--input")


def _parse_input(text: str, groups: Any) -> tuple[str, float | Signal]:
    name, equals, rest = text.partition("=")
    if not equals or not name.strip():
        raise UsageError(f"--input {text}: expected NAME=FILE.csv or NAME=NUMBER, for example --input u=cycle.csv,kind=linear")
    name = name.strip()
    path, *options = rest.split(",")
    try:
        return name, float(path)
    except ValueError:
        pass
    given: dict[str, Any] = {}
    for option in options:
        key, equals, value = option.partition("=")
        if key not in INPUT_OPTIONS or not equals or key in given:
            raise UsageError(f"--input {text}: '{option}'; expected kind=..., after=..., period=..., each once at most")
        given[key] = float(value) if key == "period" and _is_number_text(value) else value
    t, values = _read_input_columns(Path(path), list(groups.get(name, (name,))), text)
    try:
        return name, table(t, values, **given)
    except ModelError as error:
        raise UsageError(f"--input {text}: {error}") from None


def _read_input_columns(path: Path, names: list[str], text: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of a file: under the names t and those of the input where it has them, else the first columns."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--input {text}: {path} cannot be read ({error})") from None
    if not rows:
        raise UsageError(f"--input {text}: {path} is empty; expected rows of a time and {len(names)} value(s)")
    head = [cell.strip() for cell in rows[0]]
    titled = not all(map(_is_number_text, head))
    named = titled and {"t", *names} <= set(head)
    at = [head.index(name) for name in ("t", *names)] if named else list(range(len(head)))
    if len(at) != len(names) + 1:
        raise UsageError(
            f"--input {text}: {path} has {len(at)} columns; expected t and {', '.join(names)}, or a first row with these names"
        )
    found = []
    for number, row in enumerate(rows[titled:], 1 + titled):
        try:
            found.append([float(row[column]) for column in at])
        except (ValueError, IndexError):
            raise UsageError(f"--input {text}: {path}, row {number}: {', '.join(row)!r:.60} is no row of numbers") from None
    values = np.array(found, float).reshape(len(found), len(at))
    return values[:, 0], values[:, 1:]


def _is_number_text(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
