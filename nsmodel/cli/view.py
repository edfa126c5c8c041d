"""``nsmodel view``: a saved run as a page."""

from __future__ import annotations

import argparse
from pathlib import Path

from nsmodel.cli.settings import Commands
from nsmodel.cli.status import DONE
from nsmodel.trajectory import Trajectory
from nsmodel.words import print_shown as print

SAVED = "trajectory.npz"  # In the folder of a run.


def add(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write one HTML file in which a saved run can be looked at: zoomed, played, column by column; no network, no server."
    parser = commands.add_parser("view", help="look at a saved run in a browser", description=about)
    parser.add_argument("run", metavar="RUN", help=f"a folder that 'nsmodel run --out' wrote, or the {SAVED} in it")
    parser.add_argument("--out", metavar="FILE", help="the HTML file (default: view.html beside the run's file)")
    parser.add_argument("--open", action="store_true", help="show it in the browser")
    parser.set_defaults(command=_view)


def _view(arguments: argparse.Namespace) -> int:
    """Write the page of a saved run, and say where it is."""
    given = Path(arguments.run)
    file = given / SAVED if given.is_dir() else given
    path = Trajectory.load(file).view(arguments.out or file.parent / "view.html")
    print(f"page  {path}")
    if arguments.open:
        from nsmodel.view.page import opened

        opened(path)
    return DONE
