"""``nsmodel study`` and ``nsmodel stress``: errors and times of a model; a model pushed."""

from __future__ import annotations

import argparse
import sys
from itertools import product
from typing import Any

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_AT_FAULT,
    EXIT_DONE,
    FORCE_HELP,
    Commands,
    add_command,
    add_file,
    add_options,
    add_outputs,
    check_free,
    ignore_signals,
    load_model,
    parse_inputs,
    parse_numbers,
    parse_setting,
    report_result,
    save_picture,
    signal_exit_status,
    split_name,
    unique_by_name,
)
from nsmodel.errors import UsageError
from nsmodel.modeling.model_files import load_with_values
from nsmodel.modeling.variants import with_inputs


def add_study_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Measure how accurate the schemes and solvers that apply to a model are for what they cost."
    parser = add_command(commands, "study", _run_study, help="measure errors and times: a work-precision study", about=about)
    add_file(parser)
    parser.add_argument("--steps", metavar="H1,H2,...", help="time steps (default: 16 h, 8 h, ... h/8 around the model's own)")
    parser.add_argument("--target", type=float, metavar="ERROR", help="say what this relative error costs")
    add_options(parser, "study")
    parser.add_argument("--solvers", metavar="A,B,...", help="solvers to time separately (default: all that apply; '' for none)")
    parser.add_argument("--budget", type=float, default=60.0, metavar="SECONDS", help="wall time of the study (default 60)")
    add_outputs(
        parser, json="print the study as JSON", csv="also write one row for each point as CSV",
        html="also write the study as a page for a browser", out="folder for study.txt, study.json, study.csv and study.png",
        force=FORCE_HELP,
    )  # fmt: skip


def _run_study(arguments: argparse.Namespace) -> int:
    """Measure a file's model; Ctrl-C keeps what was measured."""
    from nsmodel.study import StudyInterrupted, study

    check_free(arguments.out, "study.json", arguments)
    model, values = load_model(arguments.file, arguments.set)
    status, steps, given = EXIT_DONE, arguments.steps, arguments.solvers
    try:
        found = study(
            model, steps=None if steps is None else parse_numbers(steps, f"--steps {steps}", "--steps 1e-2,5e-3"),
            target=arguments.target, t_end=arguments.t_end, parameters=values, budget=arguments.budget,
            progress=not arguments.json,
            inputs=parse_inputs(arguments.input, model.input_groups),
            solvers=None if given is None else [name for name in map(str.strip, given.split(",")) if name],
        )  # fmt: skip
    except StudyInterrupted as stop:
        ignore_signals()
        found, status = stop.study, signal_exit_status(stop)
    document = {"file": arguments.file, **found.document()}
    more: dict[str, Any] = {"csv": found.to_csv}
    if any(point.drawn for line in found.lines for point in line.points):
        more["png"] = lambda path: save_picture(found.plot(), path)
    report_result(arguments, "study", found.text(), document, more)
    if arguments.csv:
        found.to_csv(arguments.csv)
    if arguments.html:
        found.view(arguments.html)
        if not arguments.json:
            print(f"\npage  {arguments.html}")
    if status != EXIT_DONE:
        print("nsmodel: interrupted; what was measured before is above", file=sys.stderr)
    return status


def add_stress_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Push a model: its step, its units, its parameters; say of each short run whether it is right, stopped or wrong."
    parser = add_command(
        commands, "stress", _run_stress, help="stress test: vary a model's step, units and parameters", about=about
    )
    add_file(parser)
    add_options(parser, "stress")
    parser.add_argument(
        "--vary", action="append", default=[], metavar="NAME=V1,V2,...",
        help="values of a parameter or of an argument of model(); repeatable: all combinations are run",
    )  # fmt: skip
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help="wall time; cells beyond it are left out (default: no limit)"
    )
    add_outputs(parser, json="print all cells as JSON", out="folder for stress.txt, stress.json and stress.png", force=FORCE_HELP)


def _run_stress(arguments: argparse.Namespace) -> int:
    """Push a file's model, for each combination of the values given with --vary; the status says whether a cell is wrong."""
    from nsmodel.study.stress import stress_variants

    given = unique_by_name(map(parse_setting, arguments.set), "--set")
    vary = unique_by_name(map(_parse_varied, arguments.vary), "--vary")
    if twice := set(vary) & set(given):
        raise UsageError(f"'{min(twice)}' is given with --set and with --vary; keep one")
    check_free(arguments.out, "stress.json", arguments)
    variants = []
    for values in product(*vary.values()):
        varied = dict(zip(vary, values, strict=True))
        model, own = load_with_values(arguments.file, given | varied)
        inputs = parse_inputs(arguments.input, model.input_groups)
        variants.append((varied, with_inputs(model, inputs).bind(own)))
    found = stress_variants(variants, step=arguments.step, budget=arguments.budget, progress=not arguments.json)
    document = {"file": arguments.file, **found.document()}
    report_result(arguments, "stress", found.text(), document, {"png": lambda path: save_picture(found.plot(), path)})
    return EXIT_AT_FAULT if found.wrong else EXIT_DONE


def _parse_varied(setting: str) -> tuple[str, list[int | float]]:
    name, text = split_name("--vary", setting, "NAME=V1,V2,...", "mu=0.1,0.5,1")
    return name, parse_numbers(text, f"--vary {setting}", "--vary mu=0.1,0.5,1")
