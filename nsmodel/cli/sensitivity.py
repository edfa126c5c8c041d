"""``nsmodel sensitivity``: exact derivatives of a run by parameters, starts and numbers of signals."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_DONE,
    EXIT_FAILED_STEP,
    Commands,
    add_file,
    add_force,
    add_options,
    check_free,
    load_model,
    output_path,
    parse_inputs,
    print_json,
)
from nsmodel.derivatives.sensitivity import DERIVATIVE_METHODS, sensitivity
from nsmodel.errors import StepError, UsageError
from nsmodel.files.storage import write_json, write_text


def add_sensitivity_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Differentiate a run by parameters, starts and numbers of signals, exactly through all of its switches."
    parser = commands.add_parser("sensitivity", help="differentiate a run", description=about)
    add_file(parser)
    parser.add_argument(
        "--by", required=True, metavar="NAME,...", help="parameters (k), starts (x(0)), numbers of signals (u.duty, u[3], u.t[3])"
    )
    parser.add_argument("--at", metavar="T1,T2,...", help="times (default: the end of the run)")
    parser.add_argument("--outputs", metavar="NAME,...", help="states, multipliers, columns (default: all states)")
    add_options(parser, "sensitivity")
    parser.add_argument("--method", choices=DERIVATIVE_METHODS, default=DERIVATIVE_METHODS[0], help="how (default event-driven)")
    parser.add_argument("--step", type=float, metavar="H", help="with differences: the step of the time-stepping runs")
    parser.add_argument("--error", action="store_true", help="estimate the error too, by a second run")
    parser.add_argument("--json", action="store_true", help="print all as JSON")
    parser.add_argument("--out", type=output_path, metavar="DIR", help="folder for sensitivity.txt, .json, .csv and .png")
    add_force(parser)
    parser.set_defaults(command=_run_sensitivity)


def _run_sensitivity(arguments: argparse.Namespace) -> int:
    check_free(arguments.out, "sensitivity.json", arguments)
    model, values = load_model(arguments.file, arguments.set)
    try:
        found = sensitivity(
            model, by=_parse_names(arguments.by), at=None if arguments.at is None else _parse_times(arguments.at),
            outputs=None if arguments.outputs is None else _parse_names(arguments.outputs), rtol=arguments.rtol,
            atol=arguments.atol, parameters=values, inputs=parse_inputs(arguments.input, model.input_groups) or None,
            t_end=arguments.t_end, method=arguments.method, step=arguments.step,
        )  # fmt: skip
        error = found.error if arguments.error else None
    except StepError as failed:
        print(f"nsmodel: {failed}", file=sys.stderr)
        return EXIT_FAILED_STEP
    document = {"file": arguments.file, **found.document()} | ({} if error is None else {"error": error.tolist()})
    text = found.summary_text() + ("" if error is None else f"\n\nestimate of the largest error: {error.max():.2g}")
    if arguments.json:
        print_json(arguments, document)
    else:
        print(text)
    if arguments.out:
        from nsmodel.plot import save

        folder = Path(arguments.out)
        write_text(folder / "sensitivity.txt", text)
        write_json(folder / "sensitivity.json", document)
        found.to_csv(folder / "sensitivity.csv")
        save(found.plot().figure, folder / "sensitivity.png")
        if not arguments.json:
            print(f"\nsaved in {folder}: sensitivity.txt, sensitivity.json, sensitivity.csv, sensitivity.png")
    return EXIT_DONE


def _parse_names(text: str) -> list[str]:
    """Names with commas between; those in brackets, as of u[3,1], are part of a name."""
    names, depth = [""], 0
    for letter in text:
        depth += (letter in "[(") - (letter in "])")
        if letter == "," and not depth:
            names.append("")
        else:
            names[-1] += letter
    return [name.strip() for name in names if name.strip()]


def _parse_times(text: str) -> list[float]:
    try:
        return [float(time) for time in text.split(",")]
    except ValueError:
        raise UsageError(f"--at {text}: expected numbers with commas between, for example --at 1,2.5") from None
