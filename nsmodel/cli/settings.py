"""Arguments that several commands read: the model file, NAME=VALUE, the tolerance."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from nsmodel._utils import DEFAULT_TOLERANCE
from nsmodel._utils import print_escaped as print
from nsmodel.errors import UsageError
from nsmodel.modeling import model_files
from nsmodel.modeling.base import Model
from nsmodel.modeling.model_files import load_with_values

T = TypeVar("T")
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

FILE_HELP = "a Python file that defines model = ... or def model(...), or the name of a case (see nsmodel cases)"
TOLERANCE_HELP = f"largest accepted residual (default {DEFAULT_TOLERANCE:g})".replace("e-0", "e-")


def add_file(parser: argparse.ArgumentParser) -> None:
    """Add the model file."""
    parser.add_argument("file", metavar="FILE", type=_model_file, help=FILE_HELP)


def output_path(text: str) -> str:
    """A path to write to, which is some text."""
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty; give a path, or leave the option out")
    return text


def add_files(parser: argparse.ArgumentParser) -> None:
    """Add the model files, one at least."""
    parser.add_argument("files", metavar="FILE", nargs="+", type=_model_file, help=FILE_HELP)


def _model_file(text: str) -> str:
    """The file as it was given; where a case lies if it has moved, or its name was given and no file of that name is here."""
    if note := model_files.file_note(text):
        print(f"nsmodel: note: {note}", file=sys.stderr)
    return text if (path := model_files.case_or_file_path(text)) == Path(text) else str(path)


def add_set(parser: argparse.ArgumentParser) -> None:
    """Add the option --set."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="value of a parameter or of an argument of model(): a number, V1,V2,... or rows with ; between; repeatable",
    )  # fmt: skip


def load_model(file: str, settings: Sequence[str]) -> tuple[Model, dict[str, Any]]:
    """The model and the values of its parameters; settings that the file's model() takes go there."""
    return load_with_values(file, unique_by_name(map(parse_setting, settings), "--set"))


def unique_by_name(pairs: Iterable[tuple[str, T]], option: str) -> dict[str, T]:
    """The values by name; a name that is given twice is refused."""
    found: dict[str, T] = {}
    for name, value in pairs:
        if name in found:
            raise UsageError(f"{option} gives '{name}' twice; keep one")
        found[name] = value
    return found


def parse_setting(setting: str) -> tuple[str, Any]:
    """The name and its number, list of numbers or list of rows."""
    name, equals, text = setting.partition("=")
    if not equals or not name.strip():
        raise UsageError(f"--set {setting}: expected NAME=VALUE, for example --set mu=0.3")
    try:
        rows = [[parse_number(one) for one in row.split(",")] for row in text.split(";")]
    except ValueError:
        raise UsageError(f"--set {setting}: '{text}' is not a number, nor numbers with commas between") from None
    return name.strip(), rows if len(rows) > 1 else rows[0] if len(rows[0]) > 1 else rows[0][0]


def parse_number(text: str) -> int | float:
    """The number that a text spells."""
    return int(text) if text.strip().lstrip("+-").isdigit() else float(text)
