"""What commands share: the parser, the model file and the options of a run, standard output, exit statuses, signals."""

from __future__ import annotations

import argparse
import contextlib
import csv
import difflib
import errno
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, TypeVar

import numpy as np

from nsmodel._utils import print_escaped as print
from nsmodel.errors import CodegenError, ModelError, NsmodelError, StorageError, UsageError
from nsmodel.files.storage import dumps, write_json, write_text
from nsmodel.modeling import model_files
from nsmodel.modeling.base import Model
from nsmodel.modeling.model_files import load_with_values
from nsmodel.modeling.signals import Signal, table
from nsmodel.simulation.options import flagged_options

T = TypeVar("T")
Commands: TypeAlias = "argparse._SubParsersAction[CommandParser]"

FILE_HELP = "a Python file that defines model = ... or def model(...), or the name of a case (see nsmodel cases)"

CHOICE_PATTERN = re.compile(r"invalid choice: '(.*?)' \(choose from")
INPUT_OPTIONS = ("kind", "after", "period")

# Exit statuses, see docs/guide.md.
EXIT_DONE, EXIT_AT_FAULT, EXIT_USAGE, EXIT_FAILED_STEP, EXIT_REFUSED, EXIT_STORAGE = range(6)
EXIT_INTERRUPTED, EXIT_TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM  # As a shell reports a signal.


# -- the parser --------------------------------------------------------------------------------------------------------


class CommandParser(argparse.ArgumentParser):
    """A parser of all its arguments; those of its commands are such parsers too."""

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> tuple[Any, list[str]]:  # pyrefly: ignore[bad-override]
        """Refuse here what the command does not take: its own usage is shown, and not that of all."""
        found, left = super().parse_known_args(args, namespace)
        if left:
            names = [one.partition("=")[0] for one in left if one.startswith("-")]
            self.error(f"unrecognized arguments: {' '.join(left)}{_suggestion(names, self._option_string_actions)}")
        return found, left

    def error(self, message: str) -> NoReturn:
        """Say what is near to a word that is none of those there are."""
        choices = [str(one) for action in self._actions for one in action.choices or ()]
        super().error(message + _suggestion(CHOICE_PATTERN.findall(message), choices))


def _suggestion(tokens: Sequence[str], known: Any) -> str:
    found = [near[0] for word in tokens if (near := difflib.get_close_matches(word, list(known), 1))]
    return f"; did you mean {' '.join(found)}?" if found else ""


def add_command(
    commands: Commands, name: str, run: Callable[[argparse.Namespace], int], *, help: str, about: str
) -> CommandParser:
    """Add a command, and return its parser; ``help``: in the list of commands, ``about``: in its own help."""
    parser = commands.add_parser(name, help=help, description=about)
    parser.set_defaults(command=run)
    return parser


# -- arguments ---------------------------------------------------------------------------------------------------------


def add_file(parser: argparse.ArgumentParser, **several: Any) -> None:
    """Add the model file; with ``nargs="+"`` the files, one at least."""
    parser.add_argument("files" if several else "file", metavar="FILE", type=_model_file, help=FILE_HELP, **several)


def output_path(text: str) -> str:
    """A path to write to, which is some text."""
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty; give a path, or leave the option out")
    return text


PATH_FLAG: dict[str, Any] = {"type": output_path, "metavar": "PATH"}
OUTPUT_FLAGS: dict[str, dict[str, Any]] = {  # What several commands write and print, as argparse is told of it.
    **{name: {"action": "store_true"} for name in ("plot", "json", "quiet", "force")},
    "csv": PATH_FLAG,
    "film": PATH_FLAG,
    "markdown": PATH_FLAG,
    "html": PATH_FLAG | {"metavar": "PAGE"},
    "out": PATH_FLAG | {"metavar": "DIR"},
    "certificate": PATH_FLAG | {"metavar": "DIR"},
}
FORCE_HELP = "replace the result that --out holds"


def add_outputs(parser: argparse.ArgumentParser, **help: str) -> None:
    """Add some of OUTPUT_FLAGS, each with what the help says of it."""
    for name, text in help.items():
        parser.add_argument(f"--{name}", help=text, **OUTPUT_FLAGS[name])


def check_free(folder: str | Path | None, result: str, arguments: argparse.Namespace) -> None:
    """Raise UsageError where the folder is a file, or holds a ``result``, which is written when all is done, without --force."""
    if folder is not None and Path(folder).is_file():
        raise UsageError(f"--out {folder} is a file; give a folder")
    if folder is not None and not arguments.force and (Path(folder) / result).is_file():
        raise UsageError(f"{folder} holds a result ({result}); give --force to replace it, or another folder")


def _model_file(text: str) -> str:
    """The file as it was given; that of a case where a case's name was given, and no file of that name is here."""
    if note := model_files.file_note(text):
        print(f"nsmodel: note: {note}", file=sys.stderr)
    return text if (path := model_files.case_or_file_path(text)) == Path(text) else str(path)


def add_options(parser: argparse.ArgumentParser, command: str) -> None:
    """Add the flags that a command has of the options of a run."""
    for option, flag, text in flagged_options(command):
        given: dict[str, Any] = {"default": option.default, **flag.arguments}
        if given.get("type") is Path:
            given["type"] = output_path
        parser.add_argument(flag.name, help=text, **given)


def given_options(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """Return the options of a run as the flags of a command give them; what --set and --input say is read elsewhere."""
    flags = {option.name: flag.dest for option, flag, _ in flagged_options(command)}
    return {name: getattr(arguments, dest) for name, dest in flags.items() if dest == name}


# -- values of parameters: --set NAME=VALUE ----------------------------------------------------------------------------


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
    name, text = split_name("--set", setting, "NAME=VALUE", "mu=0.3")
    try:
        rows = [[parse_number(one) for one in row.split(",")] for row in text.split(";")]
    except ValueError:
        raise UsageError(f"--set {setting}: '{text}' is not a number, nor numbers with commas between") from None
    return name, rows if len(rows) > 1 else rows[0] if len(rows[0]) > 1 else rows[0][0]


def split_name(option: str, text: str, form: str, example: str) -> tuple[str, str]:
    """The name and what is given for it, of NAME=...; ``form``: what is expected, in messages."""
    name, equals, rest = text.partition("=")
    if not equals or not name.strip():
        raise UsageError(f"{option} {text}: expected {form}, for example {option} {example}")
    return name.strip(), rest


def parse_number(text: str) -> int | float:
    """The number that a text spells."""
    return int(text) if text.strip().lstrip("+-").isdigit() else float(text)


def parse_numbers(text: str, label: str, example: str) -> list[int | float]:
    """The numbers of a list with commas; ``label`` and ``example`` are for messages."""
    try:
        return [parse_number(one) for one in text.split(",")]
    except ValueError:
        raise UsageError(f"{label}: expected numbers with commas between, for example {example}") from None


def read_csv_rows(path: Path) -> list[list[str]]:
    """The rows of a file that are not empty."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        return [row for row in csv.reader(file) if any(cell.strip() for cell in row)]


# -- inputs: --input NAME=FILE.csv[,kind=...][,after=...][,period=...], or NAME=NUMBER ---------------------------------


def parse_inputs(texts: Sequence[str], groups: Any) -> dict[str, float | Signal]:
    """The signals by the names of inputs; ``groups``: names of their entries, see `Model.input_groups`."""
    return unique_by_name([_parse_input(text, groups) for text in texts], "--input")


def _parse_input(text: str, groups: Any) -> tuple[str, float | Signal]:
    name, rest = split_name("--input", text, "NAME=FILE.csv or NAME=NUMBER", "u=cycle.csv,kind=linear")
    path, *options = rest.split(",")
    if _is_number_text(path):
        return name, float(path)
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
        rows = read_csv_rows(path)
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
            raise UsageError(f"--input {text}: {path}, row {number}: {', '.join(row)!r:.60} is not a row of numbers") from None
    values = np.array(found, float).reshape(len(found), len(at))
    return values[:, 0], values[:, 1:]


def _is_number_text(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


# -- standard output: a document of its own with --json ----------------------------------------------------------------


@contextlib.contextmanager
def reserve_stdout(arguments: argparse.Namespace) -> Iterator[None]:
    """Keep standard output for the document of --json: what a model file prints meanwhile goes to standard error."""
    arguments.stdout = sys.stdout
    with contextlib.redirect_stdout(sys.stderr if getattr(arguments, "json", False) else sys.stdout):
        yield


def print_json(arguments: argparse.Namespace, document: Any) -> None:
    """Print what --json asks for."""
    print(dumps(document, indent=2), file=arguments.stdout)


def report_result(
    arguments: argparse.Namespace, name: str, text: str, document: Any, more: Mapping[str, Callable[[Path], Any]]
) -> None:
    """Print a result, its document with --json, and write it into --out: NAME.txt, NAME.json, ``more`` files by their endings."""
    if arguments.json:
        print_json(arguments, document)
    else:
        print(text)
    if arguments.out:
        folder = Path(arguments.out)
        write_text(folder / f"{name}.txt", text)
        write_json(folder / f"{name}.json", document)
        for ending, write in more.items():
            write(folder / f"{name}.{ending}")
        if not arguments.json:
            print(f"\nsaved in {folder}: {', '.join(f'{name}.{ending}' for ending in ('txt', 'json', *more))}")


def save_picture(ax: Any, path: Path) -> None:
    """Write the figure of axes."""
    from nsmodel.plot import save

    save(ax.figure, path)


# -- what a command returns to the shell -------------------------------------------------------------------------------


REFUSALS: tuple[tuple[type[NsmodelError], str, int], ...] = (
    (ModelError, "model error", EXIT_USAGE),
    (StorageError, "storage error", EXIT_STORAGE),
    (CodegenError, "no C code", EXIT_REFUSED),
    (NsmodelError, "error", EXIT_USAGE),
)


def report_refusal(error: NsmodelError) -> int:
    """Say what was refused, and return the status of that."""
    what, status = next((what, status) for kind, what, status in REFUSALS if isinstance(error, kind))
    print(f"nsmodel: {what}: {error}", file=sys.stderr)
    return status


def close_stdout(error: OSError) -> int:
    """Give up standard output; no fault where its reader (head, less) has gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError) or (sys.platform == "win32" and error.errno == errno.EINVAL):
        return EXIT_DONE
    print(f"nsmodel: error: cannot write the output: {error}", file=sys.stderr)
    return EXIT_STORAGE


# -- Ctrl-C and SIGTERM ------------------------------------------------------------------------------------------------


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command as Ctrl-C does."""

    signal = signal.SIGTERM


@contextlib.contextmanager
def handled_signals() -> Iterator[None]:
    """SIGTERM raises Terminated; afterwards signals do what they did before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, frame: Any) -> None:
        raise Terminated

    if usual[signal.SIGTERM] is not signal.SIG_IGN:
        signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


def ignore_signals() -> None:
    """One more Ctrl-C would cost what is being saved."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def signal_exit_status(stop: BaseException | None) -> int:
    """The exit status of an interruption: that of the first signal among what led to it."""
    while stop is not None and not hasattr(stop, "signal"):
        stop = stop.__context__
    return 128 + getattr(stop, "signal", signal.SIGINT)
