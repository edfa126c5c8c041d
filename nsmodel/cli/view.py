"""``nsmodel view``: a saved run as a page."""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.settings import Commands, output_path
from nsmodel.cli.status import EXIT_DONE
from nsmodel.errors import UnverifiedWarning, UsageError
from nsmodel.modeling import model_files
from nsmodel.simulation.trajectory import Trajectory

RUN_FILE = "trajectory.npz"  # In the folder of a run.


def add(commands: Commands) -> None:
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
