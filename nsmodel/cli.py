"""The command line: ``nsmodel run FILE``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nsmodel.errors import ModelError, NsmodelError, StepError, StorageError, UsageError
from nsmodel.loader import load, takes
from nsmodel.model.base import Model
from nsmodel.simulate import RunInterrupted, explain, simulate
from nsmodel.solve.choose import SOLVERS
from nsmodel.storage import dumps, write_json
from nsmodel.trajectory import Trajectory

DONE, USAGE, FAILED_STEP, INTERRUPTED = 0, 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status: 0 done, 2 usage or model, 3 a step failed, 130 interrupted."""
    arguments = _parser().parse_args(argv)
    try:
        return arguments.command(arguments)
    except NsmodelError as error:
        return _refused(error)
    except KeyboardInterrupt:
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nsmodel", description="Nonsmooth dynamics: run a model file, every step verified.",
        epilog="exit status: 0 done; 2 usage, missing file or wrong model; 3 a step failed (what was computed is saved); 130 interrupted",
    )  # fmt: skip
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="simulate a model file", description="Simulate a model file and print a summary.")
    run.add_argument("files", metavar="FILE", nargs="+", help="a Python file that defines model = ... or def model(...)")
    run.add_argument("--step", type=float, metavar="H", help="time step (default: the model's)")
    run.add_argument("--t-end", type=float, metavar="T", help="end of the run (default: the model's)")
    run.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="value of a parameter or of an argument of model(); repeatable"
    )
    run.add_argument("--solver", default="auto", metavar="NAME", help=f"use this solver alone: {', '.join(SOLVERS[1:])}")
    run.add_argument("--tolerance", type=float, default=1e-9, metavar="TOL", help="largest accepted residual (default 1e-9)")
    run.add_argument("--save-every", type=int, default=1, metavar="N", help="keep every N-th row")
    run.add_argument("--resume", action="store_true", help="continue the run found in --out")
    run.add_argument("--out", metavar="DIR", help="folder for trajectory.npz, summary.json and pictures")
    run.add_argument("--csv", metavar="FILE", help="also write the trajectory as CSV")
    run.add_argument("--plot", action="store_true", help="write pictures into --out (default: FILE-run)")
    run.add_argument("--explain", action="store_true", help="say what is used and what is left out, and why; then run")
    run.add_argument("--json", action="store_true", help="print the summary as JSON")
    run.add_argument("--quiet", action="store_true", help="print errors only")
    run.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    """Run each file; several files end in a table. The status is that of the worst run."""
    if arguments.resume and arguments.out is None:
        raise UsageError("--resume needs --out DIR, the folder of the run to continue")
    results = [_run_file(arguments, file, _folder(arguments, file)) for file in arguments.files]
    if len(results) > 1 and not (arguments.json or arguments.quiet):
        print(_table([(Path(file).stem, *result[1:]) for file, result in zip(arguments.files, results, strict=True)]))
    return max(status for status, *_ in results)


class Result(NamedTuple):
    """What became of one file."""

    status: int
    run: Trajectory | None
    seconds: float
    folder: Path | None


def _run_file(arguments: argparse.Namespace, file: str, folder: Path | None) -> Result:
    start = time.perf_counter()
    try:
        model, values = _load(file, arguments.set)
        if arguments.explain and not arguments.json:
            print(explain(model, step=arguments.step, parameters=values, solver=arguments.solver), end="\n\n")
        run = simulate(
            model, step=arguments.step, t_end=arguments.t_end, parameters=values, solver=arguments.solver,
            tolerance=arguments.tolerance, save_every=arguments.save_every, out=folder, resume=arguments.resume,
            progress=not (arguments.quiet or arguments.json),
        )  # fmt: skip
    except StepError as error:
        return _stopped(arguments, file, folder, error.trajectory, f"error: {error}", FAILED_STEP)
    except RunInterrupted as stop:
        return _stopped(arguments, file, folder, stop.trajectory, str(stop), INTERRUPTED)
    except NsmodelError as error:
        return Result(_refused(error), None, 0.0, None)
    seconds = time.perf_counter() - start
    _report(arguments, run, seconds, model.bind(values), folder)
    return Result(DONE, run, seconds, folder)


def _load(file: str, settings: Sequence[str]) -> tuple[Model, dict[str, float]]:
    """The model and the values of its parameters; settings that the file's model() takes go there."""
    values: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or not name.strip():
            raise UsageError(f"--set {setting}: expected NAME=VALUE, for example --set mu=0.3")
        try:
            values[name.strip()] = int(text) if text.strip().lstrip("+-").isdigit() else float(text)
        except ValueError:
            raise UsageError(f"--set {setting}: '{text}' is not a number") from None
    model = load(file)
    own = {name: value for name, value in values.items() if name in takes(file) and name not in model.parameters}
    if own:
        model = load(file, **own)
    return model, {name: value for name, value in values.items() if name not in own}


def _folder(arguments: argparse.Namespace, file: str) -> Path | None:
    """Where a file's results go: --out, with a folder for each of several files; FILE-run where --plot needs one."""
    stem = Path(file).stem
    if arguments.out is None:
        return Path(f"{stem}-run") if arguments.plot else None
    return Path(arguments.out) / stem if len(arguments.files) > 1 else Path(arguments.out)


def _report(arguments: argparse.Namespace, run: Trajectory, seconds: float, model: Model, folder: Path | None) -> None:
    summary = {**run.summary(), "seconds": seconds}
    pictures = []
    if folder is not None:
        write_json(folder / "summary.json", summary)
    if arguments.csv:
        run.to_csv(arguments.csv)
    if arguments.plot and folder is not None:
        from nsmodel.plot import save_all

        pictures = [str(path) for path in save_all(run, model, folder)]
    if arguments.json:
        plan = {key: run.metadata[key] for key in ("scheme", "used", "left_out")}
        print(dumps({**summary, "pictures": pictures, "plan": plan}, indent=2))
        return
    for warning in run.metadata["warnings"]:
        print(f"nsmodel: warning: {warning}", file=sys.stderr)
    if arguments.quiet or len(arguments.files) > 1:
        return
    print(run.summary_text())
    steps = max(run.metadata["steps"], 1)
    print(f"  run time        {seconds:.3g} s ({1e6 * seconds / steps:.3g} us a step, loading and set-up included)")
    if folder is not None:
        print(f"  saved           {folder / 'trajectory.npz'}")
    for path in pictures:
        print(f"  picture         {path}")


def _stopped(
    arguments: argparse.Namespace, file: str, folder: Path | None, run: Trajectory | None, message: str, status: int
) -> Result:
    """Save what a stopped run has computed, and say where."""
    print(f"nsmodel: {message}", file=sys.stderr)
    if run is None:
        return Result(status, None, 0.0, folder)
    if folder is None:
        folder = Path(f"{Path(file).stem}-run")
        run.save(folder / "trajectory.npz")
    write_json(folder / "summary.json", run.summary())
    print(f"nsmodel: {run.metadata['steps']} verified steps are saved in {folder / 'trajectory.npz'}", file=sys.stderr)
    if arguments.json:
        print(dumps(run.summary(), indent=2))
    return Result(status, run, 0.0, folder)


def _refused(error: NsmodelError) -> int:
    kind = "model error" if isinstance(error, ModelError) else "storage error" if isinstance(error, StorageError) else "error"
    print(f"nsmodel: {kind}: {error}", file=sys.stderr)
    return USAGE


def _table(rows: Sequence[tuple[str, Trajectory | None, float, Path | None]]) -> str:
    """One line a file: steps, time simulated and used, worst residual, index-set changes, the overview picture."""
    head = ("model", "status", "steps", "t", "worst residual", "index set changes", "run time", "picture")
    lines = [head]
    for name, run, seconds, folder in rows:
        if run is None:
            lines.append((name, "refused", *[""] * 6))
            continue
        totals, picture = run.metadata["totals"], None if folder is None else folder / "overview.png"
        lines.append((
            name, run.status, str(totals["steps"]), f"{run.t[-1]:g}", f"{totals['worst_residual']:.2g}",
            str(totals["index_set_changes"]), f"{seconds:.2f} s", str(picture) if picture and picture.exists() else "",
        ))  # fmt: skip
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines)


if __name__ == "__main__":
    sys.exit(main())
