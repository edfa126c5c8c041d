"""The files that ``nsmodel run`` is asked for: pictures, a film, a page, a table."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.errors import PlotError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.simulation.trajectory import Trajectory


def parse_window(text: str | None) -> tuple[float | None, float | None] | None:
    """What --window says."""
    if text is None:
        return None
    ends = text.split(":")
    try:
        begin, end = (float(one) if one.strip() else None for one in ends)
    except ValueError:
        raise UsageError(f"--window {text}: expected T0:T1, two times, of which one may be left out") from None
    if begin is not None and end is not None and not begin < end:
        raise UsageError(f"--window {text}: expected T0 < T1")
    return begin, end


def check_window_start(text: str | None, t_end: float | None) -> None:
    """Refuse a window that begins where the run is over, before it is run."""
    window = parse_window(text)
    if window is not None and window[0] is not None and t_end is not None and window[0] >= t_end:
        raise UsageError(f"--window {text} begins after the run, which ends at t = {t_end:g}")


def check_film_possible(path: str | None, model: Model) -> None:
    """Refuse a film of what has no discs, before it is run."""
    if path:
        from nsmodel.plot.crowd import check_disc_scene

        try:
            check_disc_scene(getattr(model, "scene", None), len(model.names))
        except PlotError:
            raise UsageError(
                "--film shows bodies in the plane, and this model has no scene of discs; --plot writes pictures, --html a page "
                "on which the run is played"
            ) from None


def write_requested_files(arguments: argparse.Namespace, run: Trajectory, model: Model, folder: Path | None) -> list[str]:
    """Write the files that were asked for; the paths of the pictures, and of the page."""
    pictures = []
    if arguments.csv:
        run.to_csv(arguments.csv)
    if arguments.plot and folder is not None:
        from nsmodel.plot import save_all

        pictures = [str(path) for path in save_all(run, model, folder, t=parse_window(arguments.window))]
    if arguments.film:
        from nsmodel.plot import animate

        pictures.append(str(animate(run, arguments.film)))
    if arguments.html:
        pictures.append(str(run.view(arguments.html, model)))
    return pictures


def print_paths(arguments: argparse.Namespace, paths: Sequence[str]) -> None:
    """Say where each lies."""
    page = None if arguments.html is None else Path(arguments.html)
    for path in paths:
        print(f"  {'page' if Path(path) == page else 'picture':15} {path}")


def write_files_of_failed_run(
    arguments: argparse.Namespace, run: Trajectory, model: Model | None, folder: Path
) -> tuple[list[str], str]:
    """Write the files that were asked for of a run that failed; the paths, and why there are none."""
    requested = [f"--{name}" for name in ("csv", "plot", "film", "html") if getattr(arguments, name)]
    if not requested:
        return [], ""
    try:
        if model is not None and len(run):
            return write_requested_files(arguments, run, model, folder), ""
        reason = ""
    except Exception as error:  # Where a run fails there may be numbers that no picture shows; it is told in any case.
        reason = f" ({error})"
    return [], f"{', '.join(requested)}: not all was written{reason}"
