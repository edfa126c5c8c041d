"""``nsmodel study`` and ``nsmodel stress``: errors and times of a model; a model pushed."""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_AT_FAULT,
    EXIT_DONE,
    Commands,
    add_file,
    add_force,
    add_options,
    check_free,
    ignore_signals,
    load_model,
    output_path,
    parse_inputs,
    parse_number,
    parse_setting,
    print_json,
    signal_exit_status,
    unique_by_name,
)
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_json, write_text
from nsmodel.modeling.model_files import load_with_values
from nsmodel.modeling.variants import with_inputs


def add_study_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Measure how accurate the schemes and solvers that apply to a model are for what they cost."
    parser = commands.add_parser("study", help="measure errors and times: a work-precision study", description=about)
    add_file(parser)
    parser.add_argument("--steps", metavar="H1,H2,...", help="time steps (default: 16 h, 8 h, ... h/8 around the model's own)")
    parser.add_argument("--target", type=float, metavar="ERROR", help="say what this relative error costs")
    add_options(parser, "study")
    parser.add_argument("--solvers", metavar="A,B,...", help="solvers to time separately (default: all that apply; '' for none)")
    parser.add_argument("--budget", type=float, default=60.0, metavar="SECONDS", help="wall time of the study (default 60)")
    parser.add_argument("--json", action="store_true", help="print the study as JSON")
    parser.add_argument("--csv", type=output_path, metavar="PATH", help="also write one row for each point as CSV")
    parser.add_argument("--html", type=output_path, metavar="PAGE", help="also write the study as a page for a browser")
    parser.add_argument(
        "--out", type=output_path, metavar="DIR", help="folder for study.txt, study.json, study.csv and study.png"
    )
    add_force(parser)
    parser.set_defaults(command=_run_study)


def _run_study(arguments: argparse.Namespace) -> int:
    """Measure a file's model; Ctrl-C keeps what was measured."""
    from nsmodel.study import StudyInterrupted, study

    check_free(arguments.out, "study.json", arguments)
    model, values = load_model(arguments.file, arguments.set)
    status, given = EXIT_DONE, arguments.solvers
    try:
        found = study(
            model, steps=None if arguments.steps is None else _parse_steps(arguments.steps), target=arguments.target,
            t_end=arguments.t_end, parameters=values, budget=arguments.budget, progress=not arguments.json,
            inputs=parse_inputs(arguments.input, model.input_groups),
            solvers=None if given is None else [name for name in map(str.strip, given.split(",")) if name],
        )  # fmt: skip
    except StudyInterrupted as stop:
        ignore_signals()
        found, status = stop.study, signal_exit_status(stop)
    document = {"file": arguments.file, **found.document()}
    if arguments.json:
        print_json(arguments, document)
    else:
        print(found.text())
    if arguments.csv:
        found.to_csv(arguments.csv)
    if arguments.html:
        found.view(arguments.html)
    if arguments.out:
        folder = Path(arguments.out)
        write_text(folder / "study.txt", found.text())
        write_json(folder / "study.json", document)
        found.to_csv(folder / "study.csv")
        names = ["study.txt", "study.json", "study.csv"]
        if any(point.drawn for line in found.lines for point in line.points):
            from nsmodel.plot import save

            save(found.plot().figure, folder / "study.png")
            names.append("study.png")
        if not arguments.json:
            print(f"\nsaved in {folder}: {', '.join(names)}")
    if arguments.html and not arguments.json:
        print(f"\npage  {arguments.html}")
    if status != EXIT_DONE:
        print("nsmodel: interrupted; what was measured before is above", file=sys.stderr)
    return status


def _parse_steps(text: str) -> list[float]:
    try:
        return [float(step) for step in text.split(",")]
    except ValueError:
        raise UsageError(f"--steps {text}: expected numbers with commas between, for example --steps 1e-2,5e-3") from None


def add_stress_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Push a model: its step, its units, its parameters; say of each short run whether it is right, stopped or wrong."
    parser = commands.add_parser("stress", help="stress test: vary a model's step, units and parameters", description=about)
    add_file(parser)
    add_options(parser, "stress")
    parser.add_argument(
        "--vary", action="append", default=[], metavar="NAME=V1,V2,...",
        help="values of a parameter or of an argument of model(); repeatable: all combinations are run",
    )  # fmt: skip
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help="wall time; cells beyond it are left out (default: no limit)"
    )
    parser.add_argument("--json", action="store_true", help="print all cells as JSON")
    parser.add_argument("--out", type=output_path, metavar="DIR", help="folder for stress.txt, stress.json and stress.png")
    add_force(parser)
    parser.set_defaults(command=_run_stress)


def _run_stress(arguments: argparse.Namespace) -> int:
    """Push a file's model, for each combination of the values given with --vary; the status says whether a cell is wrong."""
    from nsmodel.study.stress import stress_variants

    given, vary = (
        unique_by_name(map(parse_setting, arguments.set), "--set"),
        unique_by_name(map(_parse_varied, arguments.vary), "--vary"),
    )
    twice = next((name for name in vary if name in given), None)
    if twice is not None:
        raise UsageError(f"'{twice}' is given with --set and with --vary; keep one")
    check_free(arguments.out, "stress.json", arguments)
    variants = []
    for values in product(*vary.values()):
        varied = dict(zip(vary, values, strict=True))
        model, own = load_with_values(arguments.file, given | varied)
        inputs = parse_inputs(arguments.input, model.input_groups)
        variants.append((varied, with_inputs(model, inputs).bind(own)))
    found = stress_variants(variants, step=arguments.step, budget=arguments.budget, progress=not arguments.json)
    document = {"file": arguments.file, **found.document()}
    if arguments.json:
        print_json(arguments, document)
    else:
        print(found.text())
    if arguments.out:
        folder = Path(arguments.out)
        write_text(folder / "stress.txt", found.text())
        write_json(folder / "stress.json", document)
        from nsmodel.plot import save

        save(found.plot().figure, folder / "stress.png")
        if not arguments.json:
            print(f"\nsaved in {folder}: stress.txt, stress.json, stress.png")
    return EXIT_AT_FAULT if found.wrong else EXIT_DONE


def _parse_varied(setting: str) -> tuple[str, list[int | float]]:
    name, equals, text = setting.partition("=")
    try:
        if not equals or not name.strip():
            raise ValueError
        return name.strip(), [parse_number(one) for one in text.split(",")]
    except ValueError:
        raise UsageError(f"--vary {setting}: expected NAME=V1,V2,..., for example --vary mu=0.1,0.5,1") from None
