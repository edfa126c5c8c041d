"""The command line: ``nsmodel run FILE``, and ``view``, ``check``, ``study``, ``stress``, ``codegen``; ``cases``, ``new``."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence

from nsmodel._utils import print_escaped as print
from nsmodel.cli import cases, check, codegen, completion, new, run, stress, study, sweep, view
from nsmodel.cli.output import reserve_stdout
from nsmodel.cli.parser import CommandParser
from nsmodel.cli.signals import handled_signals, signal_exit_status
from nsmodel.cli.status import EXIT_DONE, close_stdout, report_refusal
from nsmodel.errors import NsmodelError
from nsmodel.version import VERSION


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    0 done; 1 a hypothesis is violated (``check --strict``) or a cell is wrong (``stress``); 2 usage or model; 3 a step failed;
    4 no C code; 130 interrupted by Ctrl-C, 143 by SIGTERM.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be text
    arguments = _parser().parse_args(argv)
    status = EXIT_DONE
    try:
        with handled_signals(), reserve_stdout(arguments):
            status = arguments.command(arguments)
            arguments.stdout.flush()
            return status
    except NsmodelError as error:
        return report_refusal(error)
    except KeyboardInterrupt as stop:
        print("nsmodel: interrupted", file=sys.stderr)
        return signal_exit_status(stop)
    except OSError as error:
        return max(status, close_stdout(error))


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
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
