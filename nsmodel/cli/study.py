"""``nsmodel study``: errors and times of a model."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.inputs import add_input, parse_inputs
from nsmodel.cli.output import print_json
from nsmodel.cli.settings import Commands, add_file, add_set, load_model, output_path
from nsmodel.cli.signals import ignore_signals, signal_exit_status
from nsmodel.cli.status import EXIT_DONE
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_json, write_text


def add(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Measure how accurate the schemes and solvers that apply to a model are for what they cost."
    parser = commands.add_parser("study", help="measure errors and times: a work-precision study", description=about)
    add_file(parser)
    parser.add_argument("--steps", metavar="H1,H2,...", help="time steps (default: 16 h, 8 h, ... h/8 around the model's own)")
    parser.add_argument("--target", type=float, metavar="ERROR", help="say what this relative error costs")
    parser.add_argument("--t-end", type=float, metavar="T", help="end of the runs (default: the model's)")
    add_set(parser)
    add_input(parser)
    parser.add_argument("--solvers", metavar="A,B,...", help="solvers to time alone (default: all that apply; '' for none)")
    parser.add_argument("--budget", type=float, default=60.0, metavar="SECONDS", help="wall time of the study (default 60)")
    parser.add_argument("--json", action="store_true", help="print the study as JSON")
    parser.add_argument("--csv", type=output_path, metavar="PATH", help="also write one row a point as CSV")
    parser.add_argument("--html", type=output_path, metavar="PAGE", help="also write the study as a page for a browser")
    parser.add_argument(
        "--out", type=output_path, metavar="DIR", help="folder for study.txt, study.json, study.csv and study.png"
    )
    parser.set_defaults(command=_run_study)


def _run_study(arguments: argparse.Namespace) -> int:
    """Measure a file's model; Ctrl-C keeps what was measured."""
    from nsmodel.study import StudyInterrupted, study

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
