"""``nsmodel stress``: a model pushed."""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.inputs import add_input, parse_inputs
from nsmodel.cli.output import print_json
from nsmodel.cli.settings import Commands, add_file, add_set, output_path, parse_number, parse_setting, unique_by_name
from nsmodel.cli.status import EXIT_AT_FAULT, EXIT_DONE
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_json, write_text
from nsmodel.modeling.model_files import load_with_values
from nsmodel.modeling.variants import with_inputs


def add(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Push a model: its step, its units, its parameters; say of each short run whether it is right, stopped or wrong."
    parser = commands.add_parser("stress", help="push a model's step, units and parameters", description=about)
    add_file(parser)
    add_set(parser)
    add_input(parser)
    parser.add_argument(
        "--vary", action="append", default=[], metavar="NAME=V1,V2,...",
        help="values of a parameter or of an argument of model(); repeatable: all combinations are run",
    )  # fmt: skip
    parser.add_argument("--step", type=float, metavar="H", help="the step that is taken for 1 (default: the model's)")
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help="wall time; cells beyond it are left out (default: none is)"
    )
    parser.add_argument("--json", action="store_true", help="print all cells as JSON")
    parser.add_argument("--out", type=output_path, metavar="DIR", help="folder for stress.txt, stress.json and stress.png")
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
