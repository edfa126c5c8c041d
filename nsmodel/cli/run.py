"""``nsmodel run``: simulations, and what is written of them."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from nsmodel._utils import align_columns, labelled_lines
from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_DONE,
    EXIT_FAILED_STEP,
    EXIT_INTERRUPTED,
    EXIT_STORAGE,
    EXIT_TERMINATED,
    FORCE_HELP,
    Commands,
    add_command,
    add_file,
    add_options,
    add_outputs,
    check_free,
    close_stdout,
    given_options,
    ignore_signals,
    load_model,
    parse_inputs,
    print_json,
    report_refusal,
)
from nsmodel.errors import NsmodelError, PlotError, StepError, StorageError, UsageError
from nsmodel.files.storage import FORMAT_STAMP, check_writable, write_json
from nsmodel.modeling.base import Model
from nsmodel.simulation.loop import RunInterrupted
from nsmodel.simulation.options import ExplainKeywords, option_names
from nsmodel.simulation.run_folder import JOINED_FILE, hold_folder, unfinished_manifest
from nsmodel.simulation.simulate import explain, simulate
from nsmodel.simulation.trajectory import Trajectory


def add_run_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Simulate a model file and print a summary."
    parser = add_command(commands, "run", _run_files, help="simulate a model file", about=about)
    add_file(parser, nargs="+")
    add_options(parser, "run")
    add_outputs(
        parser, force=FORCE_HELP, csv="also write the trajectory as CSV", plot="write pictures into --out (default: FILE-run)"
    )
    parser.add_argument(
        "--window", metavar="T0:T1", help="with --plot: pictures from T0 to T1 only; either may be left out, as in 0.9:"
    )
    add_outputs(
        parser, html="also write a page that shows the run in a browser",
        film="write a film of bodies in the plane: .gif, or .mp4 with ffmpeg",
    )  # fmt: skip
    parser.add_argument("--explain", action="store_true", help="say which methods are used, which are not, and why; then run")
    add_outputs(parser, json="print the summary as JSON", quiet="print warnings and errors only")


ONE_FILE_OPTIONS = {  # And what serves for several.
    "csv": "for several give --out DIR and read the trajectory.npz in it",
    "html": "for several give --out DIR and look at each with 'nsmodel view'",
    "film": "run them one by one",
}


def _run_files(arguments: argparse.Namespace) -> int:
    """Run each file; several files end in a table. The status is that of the worst run."""
    if arguments.resume and arguments.out is None:
        raise UsageError("--resume needs --out DIR, the folder of the run to continue")
    several = len(arguments.files) > 1
    stems = [Path(file).stem for file in arguments.files]
    if (arguments.out or arguments.plot) and len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise UsageError(f"two files are called '{twice}': their results would go to one folder; run them one by one")
    for option, instead in ONE_FILE_OPTIONS.items():
        if several and getattr(arguments, option):
            raise UsageError(f"--{option} takes one model file; {instead}")
    if arguments.window is not None and not arguments.plot:
        raise UsageError("--window is a window of pictures: give --plot as well")
    arguments.window = _parse_window(arguments.window)
    if arguments.film:
        from nsmodel.plot.film import check_film

        check_film(arguments.film)
    for path in filter(None, (arguments.csv, arguments.html)):
        check_writable(path)
    results: list[FileResult] = []
    for file in arguments.files:
        results.append(_run_file(arguments, file, _result_folder(arguments, file)))
        if results[-1].status in (EXIT_INTERRUPTED, EXIT_TERMINATED):
            break
    with contextlib.ExitStack() as kept:
        for result in results:
            if result.run is not None and result.folder is None:
                kept.enter_context(_save_unreported_run(result.file, result.run))
        if arguments.json:
            documents = [result.document for result in results]
            print_json(arguments, documents if several else documents[0])
        elif several and not arguments.quiet:
            print(_results_table(results))
        arguments.stdout.flush()
    return max(result.status for result in results)


class FileResult(NamedTuple):
    """What became of one file; ``document`` is what --json prints."""

    status: int
    file: str
    run: Trajectory | None
    seconds: float
    folder: Path | None
    document: dict[str, Any]


def _run_file(arguments: argparse.Namespace, file: str, folder: Path | None) -> FileResult:
    """Run a file; its folder is held until everything is written there."""
    try:
        with contextlib.nullcontext() if folder is None else hold_folder(folder):
            return _run_in_folder(arguments, file, folder)
    except NsmodelError as error:
        document = {"file": file, "status": "refused", "message": str(error)}
        return FileResult(report_refusal(error), file, None, 0.0, None, document)


def _run_in_folder(arguments: argparse.Namespace, file: str, folder: Path | None) -> FileResult:
    start = time.perf_counter()
    bound: Model | None = None
    if folder is not None and arguments.out and not arguments.resume and unfinished_manifest(folder) is None:
        check_free(folder, JOINED_FILE, arguments)
    try:
        model, values = load_model(file, arguments.set)
        bound = model.bind(values)
        _check_film_possible(arguments.film, model)
        _check_window_start(arguments.window, arguments.t_end or model.t_end)
        options = given_options(arguments, "run") | {
            "parameters": values, "inputs": parse_inputs(arguments.input, model.input_groups), "out": folder,
            "progress": not (arguments.quiet or arguments.json),
        }  # fmt: skip
        if arguments.explain and not arguments.json:
            names = option_names(ExplainKeywords)
            print(explain(model, **{name: value for name, value in options.items() if name in names}), end="\n\n")
        run = simulate(model, **options)
    except StepError as error:
        return _report_stopped_run(arguments, file, folder, error.trajectory, f"error: {error}", EXIT_FAILED_STEP, start, bound)
    except RunInterrupted as stop:
        return _report_stopped_run(arguments, file, folder, stop.trajectory, str(stop), 128 + stop.signal, start)
    except StorageError as error:
        if error.trajectory is None:
            raise
        return _report_stopped_run(arguments, file, None, error.trajectory, f"storage error: {error}", EXIT_STORAGE, start)
    with contextlib.nullcontext() if folder is not None else _save_unreported_run(file, run):
        return _report_run(arguments, file, run, time.perf_counter() - start, bound, folder)


@contextlib.contextmanager
def _save_unreported_run(file: str, run: Trajectory) -> Iterator[None]:
    """Save a run that nobody asked to be saved where it cannot be reported in the way that was asked for."""
    try:
        yield
    except BrokenPipeError:
        raise
    except Exception:
        path = _default_folder(file) / "trajectory.npz"
        run.save(path)
        print(f"nsmodel: the run is saved in {path}", file=sys.stderr)
        raise


def _result_folder(arguments: argparse.Namespace, file: str) -> Path | None:
    """Where a file's results go: --out, with a folder for each of several files; FILE-run where --plot needs one."""
    if arguments.out is None:
        return _default_folder(file) if arguments.plot else None
    return Path(arguments.out) / Path(file).stem if len(arguments.files) > 1 else Path(arguments.out)


def _default_folder(file: str) -> Path:
    return Path(f"{Path(file).stem}-run")


def _report_run(
    arguments: argparse.Namespace, file: str, run: Trajectory, seconds: float, model: Model, folder: Path | None
) -> FileResult:
    """Write what was asked for; print the summary of a single run."""
    pictures = _write_requested_files(arguments, run, model, folder)
    printed = not (arguments.json or arguments.quiet or len(arguments.files) > 1)
    document = _json_document(file, run, seconds, folder, pictures)
    if printed or arguments.json or folder is not None:
        document["hypotheses"] = _quick_verdict(model, run)
    if folder is not None:
        write_json(folder / "summary.json", document)
    where = f"{file}: " if len(arguments.files) > 1 else ""
    for warning in run.metadata["warnings"]:
        print(f"nsmodel: {where}warning: {warning}", file=sys.stderr)
    if printed:
        _print_summary(run, seconds)
        print("\n".join(labelled_lines("hypotheses", document["hypotheses"])))
        if folder is not None:
            print(f"  saved           {folder / 'trajectory.npz'}")
        _print_paths(arguments, pictures)
        sys.stdout.flush()
    return FileResult(EXIT_DONE, file, run, seconds, folder, document)


def _quick_verdict(model: Model, run: Trajectory) -> str:
    """What the quick check says, in one line; a run that is done is not refused for what cannot be checked."""
    from nsmodel.hypotheses.check import check

    try:
        return check(model, [run], quick=True).verdict
    except NsmodelError as error:
        return f"not checked: {error}"


def _report_stopped_run(
    arguments: argparse.Namespace, file: str, folder: Path | None, run: Trajectory | None, message: str, status: int,
    start: float, model: Model | None = None,
) -> FileResult:  # fmt: skip
    """Save what a stopped run has computed, and say where; ``model``: of a run that failed, whose files are written as well."""
    seconds = time.perf_counter() - start
    where = f"{file}: " if len(arguments.files) > 1 else ""
    if run is None:
        print(f"nsmodel: {where}{message}", file=sys.stderr)
        return FileResult(status, file, None, seconds, None, {"file": file, "status": "failed", "message": message})
    ignore_signals()
    resumable = folder is not None
    if folder is None:
        folder = _default_folder(file)
        try:
            run.save(folder / "trajectory.npz")
        except StorageError:
            print(f"nsmodel: {where}{message}", file=sys.stderr)
            raise
    pictures, why = _write_files_of_failed_run(arguments, run, model, folder)
    document = _json_document(file, run, seconds, folder, pictures)
    write_json(folder / "summary.json", document)
    if not (arguments.json or arguments.quiet or len(arguments.files) > 1):
        try:
            _print_summary(run, seconds)
            _print_paths(arguments, pictures)
            sys.stdout.flush()
        except OSError as error:
            close_stdout(error)
    steps = len(run) if run.is_event_driven else sum(run.metadata["solver_counts"].values())
    how = "; go on with --resume" if resumable and status in (EXIT_INTERRUPTED, EXIT_TERMINATED) else ""
    print(f"nsmodel: {where}{message}", file=sys.stderr)
    print(f"nsmodel: {where}{steps} verified steps are saved in {folder / 'trajectory.npz'}{how}", file=sys.stderr)
    if why:
        print(f"nsmodel: {where}{why}; nsmodel view {folder} shows what there is", file=sys.stderr)
    return FileResult(status, file, run, seconds, folder, document)


def _json_document(file: str, run: Trajectory, seconds: float, folder: Path | None, pictures: list[str]) -> dict[str, Any]:
    """What --json prints and summary.json holds: the summary with its plan, its files and its run time."""
    plan = {key: run.metadata[key] for key in ("scheme", "used", "left_out")}
    saved = None if folder is None else str(folder / "trajectory.npz")
    return {**FORMAT_STAMP, "file": file, **run.summary(), "seconds": seconds, "saved": saved, "pictures": pictures, "plan": plan}


def _print_summary(run: Trajectory, seconds: float) -> None:
    each = seconds / max(run.metadata["steps"], 1)
    text = f"{1e6 * each:.3g} us" if each < 1e-3 else f"{1e3 * each:.3g} ms" if each < 1 else f"{each:.3g} s"
    # Warnings and errors have their own stream.
    print(run.summary_text(messages=False))
    print(f"  run time        {seconds:.3g} s ({text} a step, loading and set-up included)")


def _results_table(results: Sequence[FileResult]) -> str:
    """One line a file: steps, time simulated and used, worst residual, index-set changes, the overview picture."""
    head = ("model", "status", "steps", "t", "worst residual", "index set changes", "run time", "picture")
    lines: list[Sequence[str]] = [head]
    for result in results:
        name, run, folder = Path(result.file).stem, result.run, result.folder
        if run is None:
            lines.append((name, result.document["status"], *[""] * 6))
            continue
        totals, picture = run.metadata["totals"], None if folder is None else folder / "overview.png"
        lines.append((
            name, run.status, str(totals["steps"]), f"{run.t[-1]:g}", f"{totals['worst_residual']:.2g}",
            str(totals["index_set_changes"]), f"{result.seconds:.2f} s", str(picture) if picture and picture.exists() else "",
        ))  # fmt: skip
    return "\n".join(align_columns(lines, str.ljust))


# -- the files that are asked for: pictures, a film, a page, a table ---------------------------------------------------


Window: TypeAlias = tuple[float | None, float | None]


def _parse_window(text: str | None) -> Window | None:
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


def _check_window_start(window: Window | None, t_end: float | None) -> None:
    """Refuse a window that begins where the run is over, before it is run."""
    if window is not None and window[0] is not None and t_end is not None and window[0] >= t_end:
        raise UsageError(f"--window begins at t = {window[0]:g}, after the run, which ends at t = {t_end:g}")


def _check_film_possible(path: str | None, model: Model) -> None:
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


def _write_requested_files(arguments: argparse.Namespace, run: Trajectory, model: Model, folder: Path | None) -> list[str]:
    """Write the files that were asked for; the paths of the pictures, and of the page."""
    pictures = []
    if arguments.csv:
        run.to_csv(arguments.csv)
    if arguments.plot and folder is not None:
        from nsmodel.plot import save_all

        pictures = [str(path) for path in save_all(run, model, folder, t=arguments.window)]
    if arguments.film:
        from nsmodel.plot import animate

        pictures.append(str(animate(run, arguments.film)))
    if arguments.html:
        pictures.append(str(run.view(arguments.html, model)))
    return pictures


def _print_paths(arguments: argparse.Namespace, paths: Sequence[str]) -> None:
    """Say where each lies."""
    page = None if arguments.html is None else Path(arguments.html)
    for path in paths:
        print(f"  {'page' if Path(path) == page else 'picture':15} {path}")


def _write_files_of_failed_run(
    arguments: argparse.Namespace, run: Trajectory, model: Model | None, folder: Path
) -> tuple[list[str], str]:
    """Write the files that were asked for of a run that failed; the paths, and why there are none."""
    requested = [f"--{name}" for name in ("csv", "plot", "film", "html") if getattr(arguments, name)]
    if not requested:
        return [], ""
    try:
        if model is not None and len(run):
            return _write_requested_files(arguments, run, model, folder), ""
        reason = ""
    except Exception as error:  # Where a run fails there may be numbers that no picture shows; it is told in any case.
        reason = f" ({error})"
    return [], f"{', '.join(requested)}: not all was written{reason}"
