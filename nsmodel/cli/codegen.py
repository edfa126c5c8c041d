"""``nsmodel codegen``: a model's step in C."""

from __future__ import annotations

import argparse
from pathlib import Path

from nsmodel._utils import DEFAULT_TOLERANCE
from nsmodel._utils import print_escaped as print
from nsmodel.cli.settings import TOLERANCE_HELP, Commands, add_file, add_set, load_model, output_path
from nsmodel.cli.status import EXIT_DONE


def add(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write the model's verified step as a C99 library: header, source, Makefile, example, description, README."
    parser = commands.add_parser("codegen", help="write a model's step as a C library", description=about)
    add_file(parser)
    parser.add_argument("--out", type=output_path, metavar="DIR", help="folder of the library (default: FILE-c)")
    parser.add_argument("--name", metavar="NAME", help="prefix of all names in C (default: the file's name)")
    parser.add_argument(
        "--step",
        type=_parse_step_sizes,
        metavar="H,...",
        help="time step of the code, or up to 8 lengths of steps (default: the model's)",
    )
    parser.add_argument("--any-step", action="store_true", help="let a linear scene take any step, not this one alone")
    parser.add_argument("--tolerance", type=float, default=DEFAULT_TOLERANCE, metavar="TOL", help=TOLERANCE_HELP)
    parser.add_argument("--max-work", type=int, metavar="N", help="most linear systems, index sets and sweeps in a step")
    parser.add_argument(
        "--worst-case", action="store_true", help="form all inverses beforehand: a step of a small law solves no linear system"
    )
    parser.add_argument(
        "--event-driven", action="store_true", help="write NAME_pieces too: NAME_advance goes from switch to switch"
    )
    add_set(parser)
    parser.set_defaults(command=_write_library)


def _parse_step_sizes(text: str) -> list[float]:
    return [float(part) for part in text.split(",")]


def _write_library(arguments: argparse.Namespace) -> int:
    """Write the C library of a file; a parameter given with --set becomes a number in the code."""
    from nsmodel import codegen

    model, values = load_model(arguments.file, arguments.set)
    stem = Path(arguments.file).stem
    name = codegen.identifier(stem) if arguments.name is None else arguments.name
    written = codegen.write(
        model, arguments.out or f"{stem}-c", name=name, step=arguments.step, any_step=arguments.any_step, parameters=values,
        tolerance=arguments.tolerance, max_work=arguments.max_work, worst_case=arguments.worst_case,
        event_driven=arguments.event_driven,
    )  # fmt: skip
    print(written.text())
    return EXIT_DONE
