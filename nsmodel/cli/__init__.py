"""The command line: ``nsmodel run FILE``, and ``view``, ``check``, ``sensitivity``, ``study``, ``stress``, ``cases``, ... ."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence

from nsmodel._utils import print_escaped as print
from nsmodel.cli.cases import add_cases_command, add_new_command
from nsmodel.cli.check import add_check_command
from nsmodel.cli.common import (
    EXIT_DONE,
    CommandParser,
    close_stdout,
    handled_signals,
    report_refusal,
    reserve_stdout,
    signal_exit_status,
)
from nsmodel.cli.completion import add_completion_command
from nsmodel.cli.export import add_codegen_command, add_report_command, add_view_command
from nsmodel.cli.run import add_run_command
from nsmodel.cli.sensitivity import add_sensitivity_command
from nsmodel.cli.study import add_stress_command, add_study_command
from nsmodel.cli.sweep import add_sweep_command
from nsmodel.errors import NsmodelError
from nsmodel.version import VERSION

ADD_COMMANDS = (
    add_cases_command,
    add_new_command,
    add_run_command,
    add_view_command,
    add_report_command,
    add_sweep_command,
    add_check_command,
    add_sensitivity_command,
    add_study_command,
    add_stress_command,
    add_codegen_command,
    add_completion_command,
)  # In the order of the help.


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    0 done; 1 a hypothesis is violated (``check --strict``) or a cell is wrong (``stress``); 2 usage or model; 3 a step failed;
    4 no C code; 5 files cannot be read or written; 130 interrupted by Ctrl-C, 143 by SIGTERM.
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
        "4 the model has no C counterpart; "
        "5 files cannot be read or written: no space, no permission, in use, damaged",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"nsmodel {VERSION}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add_command in ADD_COMMANDS:
        add_command(commands)
    return parser
