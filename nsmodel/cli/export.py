"""``nsmodel codegen`` and ``nsmodel view``: a model's step as a library in C, a saved run as a page."""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import EXIT_DONE, Commands, add_file, add_options, load_model, output_path
from nsmodel.errors import UnverifiedWarning, UsageError
from nsmodel.modeling import model_files
from nsmodel.simulation.trajectory import Trajectory


def add_codegen_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write the model's verified step as a C99 library: header, source, Makefile, example, description, README."
    parser = commands.add_parser("codegen", help="write a model's step as a C library", description=about)
    add_file(parser)
    parser.add_argument("--out", type=output_path, metavar="DIR", help="folder of the library (default: FILE-c)")
    parser.add_argument("--name", metavar="NAME", help="prefix of all names in C (default: the file's name)")
    parser.add_argument(
        "--step",
        type=_parse_step_sizes,
        metavar="H,...",
        help="time step of the code, or up to 8 lengths of steps (default: the model's)",
    )
    parser.add_argument("--any-step", action="store_true", help="let a linear scene take any step, not this one alone")
    add_options(parser, "codegen")
    parser.add_argument("--max-work", type=int, metavar="N", help="most linear systems, index sets and sweeps in a step")
    parser.add_argument(
        "--worst-case", action="store_true", help="form all inverses beforehand: a step of a small law solves no linear system"
    )
    parser.add_argument(
        "--event-driven", action="store_true", help="write NAME_pieces too: NAME_advance goes from switch to switch"
    )
    parser.set_defaults(command=_write_library)


def _parse_step_sizes(text: str) -> list[float]:
    return [float(part) for part in text.split(",")]


def _write_library(arguments: argparse.Namespace) -> int:
    """Write the C library of a file; a parameter given with --set becomes a number in the code."""
    from nsmodel import codegen

    model, values = load_model(arguments.file, arguments.set)
    stem = Path(arguments.file).stem
    name = codegen.identifier(stem) if arguments.name is None else arguments.name
    written = codegen.write(
        model, arguments.out or f"{stem}-c", name=name, step=arguments.step, any_step=arguments.any_step, parameters=values,
        tolerance=arguments.tolerance, max_work=arguments.max_work, worst_case=arguments.worst_case,
        event_driven=arguments.event_driven,
    )  # fmt: skip
    print(written.text())
    return EXIT_DONE


RUN_FILE = "trajectory.npz"  # In the folder of a run.


def add_view_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write one HTML file in which a saved run can be looked at: zoomed, played, column by column; no network, no server."
    parser = commands.add_parser("view", help="look at a saved run in a browser", description=about)
    parser.add_argument("run", metavar="RUN", help=f"a folder that 'nsmodel run --out' wrote, or the {RUN_FILE} in it")
    parser.add_argument(
        "--out", type=output_path, metavar="PAGE", help="the HTML file (default: view.html beside the run's file)"
    )
    parser.add_argument("--open", action="store_true", help="show it in the browser")
    parser.set_defaults(command=_write_view)


def _no_run_hint(given: Path) -> str:
    """What to do where no run was kept."""
    if model_files.case_or_file_path(given).suffix == ".py":
        return f"{given} is a model file: run it first, nsmodel run {given} --out DIR, and then nsmodel view DIR"
    return f"there is no run in '{given}': runs are kept by nsmodel run FILE --out DIR, or with --plot in FILE-run"


def _load_run(file: Path) -> Trajectory:
    """The run; that it could not be verified is said in a line."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnverifiedWarning)
        run = Trajectory.load(file)
    for one in caught:
        print(f"nsmodel: note: {one.message}", file=sys.stderr)
    return run


def _write_view(arguments: argparse.Namespace) -> int:
    """Write the page of a saved run, and say where it is."""
    given = Path(arguments.run)
    file = given / RUN_FILE if given.is_dir() else given
    if not file.is_file() or given.suffix == ".py":
        raise UsageError(_no_run_hint(given))
    path = _load_run(file).view(arguments.out or file.parent / "view.html")
    print(f"page  {path}")
    if arguments.open:
        from nsmodel.plot.html.page import open_in_browser

        open_in_browser(path)
    return EXIT_DONE
