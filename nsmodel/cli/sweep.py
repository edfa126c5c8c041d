"""``nsmodel sweep``: a model run many times."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import align_columns
from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_DONE,
    EXIT_FAILED_STEP,
    Commands,
    add_command,
    add_file,
    add_options,
    add_outputs,
    given_options,
    ignore_signals,
    parse_inputs,
    parse_number,
    parse_setting,
    print_json,
    read_csv_rows,
    save_picture,
    split_name,
    unique_by_name,
)
from nsmodel.errors import UsageError
from nsmodel.files.storage import check_writable
from nsmodel.modeling.model_files import load_with_values
from nsmodel.sweep.design import MIN_CELL_BYTES, check_memory

if TYPE_CHECKING:
    from nsmodel.sweep.result import Sweep

# Cells whose numbers are printed where they are kept nowhere: half a screen; the last line says how to keep all.
MAX_PRINTED_CELLS = 12
OPTION_SPELLINGS = {  # What messages say of arguments, and the options for it.
    "keep=['x1']": "--keep x1",
    "outputs={'end': 'x1[-1]'}": '--output "end=x1[-1]"',
    "outputs= in place of keep=": "--output in place of --keep",
    "grid={name: values}": "--grid NAME=LOW:HIGH:COUNT",
    "samples={name: array}": "--samples TABLE.csv",
    "start={state: values}": "--start STATE=V1,V2",
    "seeds=range(20)": "--seeds 20",
    "several steps or inputs": "--step H1,H2",
    "nsmodel.simulate": "nsmodel run",
    "is varied, but parameters= also gives": "is varied, but --set also gives",
    "give times=, the times of the rows": "leave --every out",
}
VALUES_FORMAT = "NAME=LOW:HIGH:COUNT or NAME=V1,V2,..."


def add_sweep_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Run a model for many values of its parameters, starts, seeds or steps, on all cores."
    parser = add_command(commands, "sweep", _run_sweep, help="run a model file many times", about=about)
    add_file(parser)
    parser.add_argument(
        "--grid", action="append", default=[], metavar=VALUES_FORMAT, help="values of a parameter, a dimension; repeatable"
    )
    parser.add_argument(
        "--samples", metavar="TABLE.csv", help="points in parameter space: a column for each name, names in the first row"
    )
    parser.add_argument(
        "--start", action="append", default=[], metavar=VALUES_FORMAT, help="initial values of a state; repeatable"
    )
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds 0 ... N-1 for def model(seed=...)")
    parser.add_argument("--step", metavar="H or H1,H2,...", help="time step; several are a dimension")
    add_options(parser, "sweep")
    parser.add_argument("--keep", default="", metavar="A,B,...", help="columns to keep over time")
    parser.add_argument("--every", type=int, metavar="N", help="keep every N-th row (default: about 200 rows)")
    parser.add_argument(
        "--output",
        action="append",
        default=[],
        metavar="NAME=TEXT",
        help="number of a run: x[-1], max(x), mean(x), ...; repeatable",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="how many cells run at once (default: the number of cores)")
    parser.add_argument("--entropy", type=int, metavar="E", help="of random starts (default 0)")
    add_outputs(parser, out="folder of the sweep; NAME.nc or NAME.zarr: written in that format when it is done")
    parser.add_argument("--resume", action="store_true", help="go on with the sweep in --out")
    parser.add_argument("--retry", action="store_true", help="with --resume: run failed cells again")
    add_outputs(
        parser, csv="also write one row for each cell as CSV",
        plot="write a picture of each quantity into --out (default: FILE-sweep)", json="print the summary as JSON",
        quiet="print errors only",
    )  # fmt: skip


def _run_sweep(arguments: argparse.Namespace) -> int:
    """Sweep a file; what fails is a status of its cell, and 3 of the command."""
    from nsmodel.sweep.run import SweepInterrupted, sweep

    if arguments.resume and arguments.out is None:
        raise UsageError("--resume needs --out DIR, the folder of the sweep to go on with")
    if arguments.csv:
        check_writable(arguments.csv)
    fixed = unique_by_name(map(parse_setting, arguments.set), "--set")
    grid, samples = _parse_grid(arguments.grid, "--grid"), _read_samples(arguments.samples)
    first = fixed | {name: values.tolist()[0] for name, values in (grid or samples or {}).items()}
    nothing_kept = not (arguments.keep or arguments.output) and arguments.seeds is None
    model = load_with_values(arguments.file, first)[0] if arguments.input or nothing_kept else None  # A wrong name is told first.
    inputs = parse_inputs(arguments.input, model.input_groups) if arguments.input and model else None
    steps: Any = [None] if arguments.step is None else _parse_values(arguments.step, f"--step {arguments.step}").tolist()
    try:
        found = sweep(
            arguments.file, grid=grid, samples=samples, start=_parse_grid(arguments.start, "--start"), seeds=arguments.seeds,
            step=steps[0] if len(steps) == 1 else steps, inputs=inputs, parameters=fixed,
            keep=[name for name in map(str.strip, arguments.keep.split(",")) if name], every=arguments.every,
            outputs=unique_by_name(
                (split_name("--output", text, "NAME=...", "rest=x[-1]") for text in arguments.output), "--output"
            ),
            workers=arguments.workers,
            out=arguments.out, resume=arguments.resume, retry=arguments.retry, entropy=arguments.entropy,
            progress=not (arguments.quiet or arguments.json), **given_options(arguments, "sweep"),
        )  # fmt: skip
    except SweepInterrupted as stop:
        ignore_signals()
        return _keep_interrupted(arguments, stop)
    except UsageError as error:
        text = str(error)
        for python, option in OPTION_SPELLINGS.items():
            text = text.replace(python, option)
        raise UsageError(text) from error
    _report_sweep(arguments, found)
    return EXIT_FAILED_STEP if found.failures else EXIT_DONE


def _keep_interrupted(arguments: argparse.Namespace, stop: Any) -> int:
    """Keep what was run, and say where."""
    where = arguments.out
    if where is None:
        where = _pictures_folder(arguments) / "sweep.npz"
        stop.result.save(where)
    how = "; go on with --resume" if arguments.out is not None else ""
    print(f"nsmodel: {stop}; they are saved in {where}{how}", file=sys.stderr)
    return 128 + stop.signal


def _report_sweep(arguments: argparse.Namespace, found: Sweep) -> None:
    """Print the summary, write what was asked for."""
    if arguments.csv:
        found.to_csv(arguments.csv)
    pictures = _save_pictures(arguments, found) if arguments.plot else []
    if arguments.json:
        print_json(arguments, {"file": arguments.file, **found.summary(), "pictures": pictures})
        return
    if not arguments.quiet:
        print(found.summary_text())
        if not (arguments.out or arguments.csv):
            print(_cell_rows(found), end="")
        if arguments.out:
            print(f"  saved           {arguments.out}")
        for path in pictures:
            print(f"  picture         {path}")
    if found.failures:
        print(f"nsmodel: {len(found.failures)} of {found.size} cells are not done; the others are", file=sys.stderr)


def _cell_rows(found: Sweep) -> str:
    """What varies and the outputs of the first cells, a row each; "" where an output is not a number."""
    from nsmodel.sweep import result
    from nsmodel.sweep.request import CELL_FACTS, EVENT_DRIVEN_FACTS

    if not found.metadata["outputs"] or any(found.cells[name].ndim > 1 for name in found.metadata["outputs"]):
        return ""
    hidden = {"cell", "message", "way", *CELL_FACTS, *EVENT_DRIVEN_FACTS} - ({"status"} if found.failures else set())
    table = result.cell_table(found).items()
    columns = [[name, *map(_format_entry, values[:MAX_PRINTED_CELLS])] for name, values in table if name not in hidden]
    lines = align_columns([*zip(*columns, strict=True)])
    if (more := found.size - MAX_PRINTED_CELLS) > 0:
        lines.append(f"... {more} more; --out DIR or --csv FILE keeps them all")
    return "\n" + "\n".join(lines) + "\n"


def _format_entry(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)


def _save_pictures(arguments: argparse.Namespace, found: Sweep) -> list[str]:
    paths = []
    for name in (*found.metadata["keep"], *found.metadata["outputs"]):
        paths.append(str(_pictures_folder(arguments) / f"{name}.png"))
        save_picture(found.plot(name), Path(paths[-1]))
    return paths


def _pictures_folder(arguments: argparse.Namespace) -> Path:
    """Where pictures go."""
    if arguments.out is None:
        return Path(f"{Path(arguments.file).stem}-sweep")
    out = Path(arguments.out)
    return out.with_name(f"{out.name}.parts") if out.suffix in (".nc", ".zarr") else out


def _parse_grid(texts: Sequence[str], option: str) -> dict[str, Any] | None:
    """{name: values} of LOW:HIGH:COUNT or numbers with commas between."""
    pairs = (split_name(option, text, "NAME=...", "mu=0:1:11") for text in texts)
    return unique_by_name(((name, _parse_values(values, f"{option} {name}={values}")) for name, values in pairs), option) or None


def _parse_values(text: str, label: str) -> np.ndarray:
    """The numbers that a text lists, or spaces evenly."""
    try:
        if ":" not in text:
            return np.array([parse_number(one) for one in text.split(",")])
        begin, end, number = text.split(":")
        low, high, count = float(begin), float(end), int(number)
        if count < 1:
            raise ValueError
    except ValueError:
        raise UsageError(f"{label}: expected LOW:HIGH:COUNT, such as 0:1:11, or numbers with commas between") from None
    check_memory([label.partition("=")[0]], [count], MIN_CELL_BYTES)
    return np.linspace(low, high, count)


def _read_samples(path: str | None) -> dict[str, np.ndarray] | None:
    """The columns of a table by the names in its first row."""
    if path is None:
        return None
    try:
        rows = read_csv_rows(Path(path))
        names = [cell.strip() for cell in rows[0]]
        values = np.array([[float(cell) for cell in row] for row in rows[1:]], float)
        if len(values) == 0 or values.shape[1] != len(names) or len(set(names)) < len(names):
            raise ValueError("rows of another length than the first, or names that come twice, or no rows")
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise UsageError(f"--samples {path}: {error}; expected a first row of names, and a number of each below") from None
    return dict(zip(names, values.T, strict=True))
