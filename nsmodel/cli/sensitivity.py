"""``nsmodel sensitivity``: exact derivatives of a run by parameters, starts and numbers of signals."""

from __future__ import annotations

import argparse
import sys

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_DONE,
    EXIT_FAILED_STEP,
    FORCE_HELP,
    Commands,
    add_command,
    add_file,
    add_options,
    add_outputs,
    check_free,
    load_model,
    parse_inputs,
    parse_numbers,
    report_result,
    save_picture,
)
from nsmodel.derivatives.sensitivity import DERIVATIVE_METHODS, sensitivity
from nsmodel.errors import StepError


def add_sensitivity_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Differentiate a run by parameters, starts and numbers of signals, exactly through all of its switches."
    parser = add_command(commands, "sensitivity", _run_sensitivity, help="differentiate a run", about=about)
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
    add_outputs(parser, json="print all as JSON", out="folder for sensitivity.txt, .json, .csv and .png", force=FORCE_HELP)


def _run_sensitivity(arguments: argparse.Namespace) -> int:
    check_free(arguments.out, "sensitivity.json", arguments)
    model, values = load_model(arguments.file, arguments.set)
    at = arguments.at
    try:
        found = sensitivity(
            model, by=_parse_names(arguments.by), at=None if at is None else parse_numbers(at, f"--at {at}", "--at 1,2.5"),
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
    more = {"csv": found.to_csv, "png": lambda path: save_picture(found.plot(), path)}
    report_result(arguments, "sensitivity", text, document, more)
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
