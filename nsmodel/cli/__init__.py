"""The command line: ``nsmodel run FILE``, and ``view``, ``check``, ``study``, ``stress``, ``codegen``; ``cases``, ``new``."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence

from nsmodel.cli import cases, check, codegen, completion, new, run, stress, study, sweep, view
from nsmodel.cli.output import apart
from nsmodel.cli.parser import Parser
from nsmodel.cli.signals import by_signal, signals
from nsmodel.cli.status import DONE, refused, silenced
from nsmodel.errors import NsmodelError
from nsmodel.version import VERSION
from nsmodel.words import print_shown as print


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    0 done; 1 a hypothesis is violated (``check --strict``) or a cell is wrong (``stress``); 2 usage or model; 3 a step failed;
    4 no C code; 130 interrupted by Ctrl-C, 143 by SIGTERM.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be text
    arguments = _parser().parse_args(argv)
    status = DONE
    try:
        with signals(), apart(arguments):
            status = arguments.command(arguments)
            arguments.stdout.flush()
            return status
    except NsmodelError as error:
        return refused(error)
    except KeyboardInterrupt as stop:
        print("nsmodel: interrupted", file=sys.stderr)
        return by_signal(stop)
    except OSError as error:
        return max(status, silenced(error))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsmodel",
        description="Nonsmooth dynamics: run a model file, every step verified; check its hypotheses; write its step in C.",
        epilog="exit status: 0 done; 1 a hypothesis is violated (check --strict) or a cell is wrong (stress); "
        "2 usage, missing file or wrong model; 3 a step failed, or cells of a sweep, 130 interrupted by Ctrl-C, 143 by SIGTERM "
        "(what was computed is saved); "
        "4 the model has no C counterpart",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"nsmodel {VERSION}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in (cases, new, run, view, sweep, check, study, stress, codegen, completion):
        command.add(commands)
    return parser
