"""``nsmodel codegen``, ``view`` and ``report``: a step as a library in C, a saved run as a page, and as a report of a bug."""

from __future__ import annotations

import argparse
import contextlib
import getpass
import platform
import re
import socket
import subprocess
import sys
import warnings
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from nsmodel._utils import escape_invisible
from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_DONE,
    Commands,
    add_command,
    add_file,
    add_options,
    add_outputs,
    load_model,
    output_path,
    parse_numbers,
)
from nsmodel.codegen.library import compiler
from nsmodel.errors import StorageError, UnverifiedWarning, UsageError
from nsmodel.files.storage import read_json, write_text
from nsmodel.modeling import model_files
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.version import VERSION


def add_codegen_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write the model's verified step as a C99 library: header, source, Makefile, example, description, README."
    parser = add_command(commands, "codegen", _write_library, help="write a model's step as a C library", about=about)
    add_file(parser)
    add_outputs(parser, out="folder of the library (default: FILE-c)")
    parser.add_argument("--name", metavar="NAME", help="prefix of all names in C (default: the file's name)")
    parser.add_argument(
        "--step", metavar="H,...", help="time step of the code, or up to 8 lengths of steps (default: the model's)"
    )
    parser.add_argument("--any-step", action="store_true", help="let a linear scene take any step, not only this one")
    add_options(parser, "codegen")
    parser.add_argument("--max-work", type=int, metavar="N", help="most linear systems, index sets and sweeps in a step")
    parser.add_argument(
        "--worst-case", action="store_true", help="form all inverses beforehand: a step of a small law solves no linear system"
    )
    parser.add_argument(
        "--event-driven", action="store_true", help="write NAME_pieces too: NAME_advance goes from switch to switch"
    )


def _write_library(arguments: argparse.Namespace) -> int:
    """Write the C library of a file; a parameter given with --set becomes a number in the code."""
    from nsmodel import codegen

    text = arguments.step
    step = None if text is None else [float(one) for one in parse_numbers(text, f"--step {text}", "--step 1e-3,2e-3")]
    model, values = load_model(arguments.file, arguments.set)
    stem = Path(arguments.file).stem
    name = codegen.identifier(stem) if arguments.name is None else arguments.name
    written = codegen.write(
        model, arguments.out or f"{stem}-c", name=name, step=step, any_step=arguments.any_step, parameters=values,
        tolerance=arguments.tolerance, max_work=arguments.max_work, worst_case=arguments.worst_case,
        event_driven=arguments.event_driven,
    )  # fmt: skip
    print(written.text())
    return EXIT_DONE


RUN_FILE = "trajectory.npz"  # In the folder of a run.


def add_view_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write one HTML file in which a saved run can be looked at: zoomed, played, column by column; no network, no server."
    parser = add_command(commands, "view", _write_view, help="show a saved run in a browser", about=about)
    parser.add_argument("run", metavar="RUN", help=f"a folder that 'nsmodel run --out' wrote, or the {RUN_FILE} in it")
    parser.add_argument(
        "--out", type=output_path, metavar="PAGE", help="the HTML file (default: view.html next to the run's file)"
    )
    parser.add_argument("--open", action="store_true", help="open the page in the browser")


def _no_run_hint(given: Path) -> str:
    """What to do where no run was kept."""
    if model_files.case_or_file_path(given).suffix == ".py":
        return f"{given} is a model file: run it first, nsmodel run {given} --out DIR, and give DIR"
    return f"there is no run in '{given}': runs are saved by nsmodel run FILE --out DIR, or with --plot in FILE-run"


def _load_run(given: str) -> tuple[Path, Trajectory]:
    """The file of the run in a folder, or that is given, and the run; UsageError where there is none.

    That it could not be verified is said in a line.
    """
    path = Path(given)
    file = path / RUN_FILE if path.is_dir() else path
    if not file.is_file() or path.suffix == ".py":
        raise UsageError(_no_run_hint(path))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnverifiedWarning)
        run = Trajectory.load(file)
    for one in caught:
        print(f"nsmodel: note: {one.message}", file=sys.stderr)
    return file, run


def _write_view(arguments: argparse.Namespace) -> int:
    """Write the page of a saved run, and say where it is."""
    file, run = _load_run(arguments.run)
    path = run.view(arguments.out or file.parent / "view.html")
    print(f"page  {path}")
    if arguments.open:
        from nsmodel.plot.html.page import open_in_browser

        open_in_browser(path)
    return EXIT_DONE


# -- a report of a run -------------------------------------------------------------------------------------------------

REPORT_FILE = "report.md"  # Beside the run's file.
REPORTED_PACKAGES = ("casadi", "numpy", "scipy", "sympy", "matplotlib", "xarray", "pandas", "dask")
_PATH_PATTERN = re.compile(r"(?<![\w./~:)\]-])(?:file://|~|[A-Za-z]:)?(?:[\\/][\w.@+~-]+){2,}[\\/]?")
_HOME_PATTERN = re.compile(  # Home folders, of any user.
    r"(?:file://|(?<![A-Za-z])[A-Za-z]:)?[\\/]+(?:home|Users)[\\/]+[\w.@+-]+|(?<![\w~])~[A-Za-z][\w.-]*(?=[\\/])"
)
_MODEL_ENDS = "the run's folder does not say which file its model is in: give --model FILE"


def add_report_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = (
        "Write one text file about a saved run, to attach to a report of a bug: versions, system, model, parameters, summary, "
        "message. Names of the user and of the machine, and paths, are left out; read it before you send it."
    )
    parser = add_command(
        commands, "report", _write_report, help="write a run's model, versions and summary in one file", about=about
    )
    parser.add_argument("run", metavar="RUN", help=f"a folder that 'nsmodel run --out' wrote, or the {RUN_FILE} in it")
    parser.add_argument("--model", metavar="FILE", help="the model file (default: the one that the folder's summary.json names)")
    parser.add_argument(
        "--out", type=output_path, metavar="PATH", help=f"the text file (default: {REPORT_FILE} next to the run's file)"
    )


def _write_report(arguments: argparse.Namespace) -> int:
    """Write the report of a saved run, and say where it is."""
    file, run = _load_run(arguments.run)
    path = Path(arguments.out or file.parent / REPORT_FILE)
    write_text(path, without_machine(_report_text(run, _model_text(file.parent, arguments.model))))
    print(f"report  {path}")
    return EXIT_DONE


def _model_text(folder: Path, given: str | None) -> str:
    """The text of the model file; why there is none."""
    if given is None:
        try:
            given = str(read_json(folder / "summary.json")["file"])
        except (StorageError, KeyError, TypeError):
            return f"({_MODEL_ENDS})"
        if not model_files.case_or_file_path(given).is_file():
            return "(the model file is not found from this folder: give --model FILE)"
    try:
        return model_files.case_or_file_path(given).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--model {given}: it cannot be read ({error})") from None


def _report_text(run: Trajectory, model: str) -> str:
    """The report in Markdown."""
    about = run.metadata
    here = {"nsmodel": VERSION, "Python": f"{platform.python_implementation()} {platform.python_version()}"}
    here |= {name: found for name in REPORTED_PACKAGES if (found := _package_version(name))}
    here |= {"C compiler": _compiler_version(), "system": f"{platform.system()}, {platform.machine()}"}
    sections = {
        "Versions here": _lines(here),
        "Versions of the run": _lines(about.get("versions", {})),
        "Parameters": _lines({name: repr(value) for name, value in about.get("parameters", {}).items()}),
        "Summary": _fenced(run.summary_text()),
        "Used": "\n".join(f"- {text}" for text in about.get("used", [])),
        "Left out": "\n".join(f"- {text}" for text in about.get("left_out", [])),
        "Message": about.get("message") or "none",
        "Model": _fenced(model, "python"),
    }
    body = "\n\n".join(f"## {title}\n\n{text or 'none'}" for title, text in sections.items())
    return escape_invisible(f"# nsmodel report: {run.title}\n\n{body}\n")


def _lines(named: Mapping[str, str]) -> str:
    return "\n".join(f"- {name}: {value}" for name, value in named.items())


def _fenced(text: str, kind: str = "text") -> str:
    """A block of text as it is, between fences longer than any in it."""
    fence = "`" * max(3, 1 + max(map(len, re.findall(r"`+", text)), default=0))
    return f"{fence}{kind}\n{text.rstrip()}\n{fence}"


def _package_version(name: str) -> str | None:
    with contextlib.suppress(metadata.PackageNotFoundError):
        return metadata.version(name)
    return None


def _compiler_version() -> str:
    """What the C compiler says of itself in its first line."""
    if (found := compiler()) is None:
        return "none"
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run([*found.split(), "--version"], capture_output=True, text=True, timeout=10, check=True).stdout
        return next(iter(said.splitlines()), found)
    return found


def without_machine(text: str) -> str:
    """The text without what tells whose machine it was made on: paths but for their last part, names of user and host."""
    folders = [(str(path), sign) for path, sign in ((Path.cwd(), "."), (Path.home(), "~")) if len(path.parts) > 1]
    for folder, _ in folders:  # Whose names may have blanks.
        text = re.sub(rf"{re.escape(folder)}(?=[\\/])", "/-/-", text)
    for folder, sign in folders:
        text = re.sub(rf"{re.escape(folder)}(?!\w)", sign, text)
    text = _HOME_PATTERN.sub("~", text)
    text = _PATH_PATTERN.sub(lambda found: ".../" + re.split(r"[\\/]", found[0].rstrip("\\/"))[-1], text)
    for name, instead in ((_user_name(), "USER"), (socket.gethostname(), "HOST")):
        if name:
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", instead, text)
    return text


def _user_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""
