"""``nsmodel check``: the hypotheses behind model files."""

from __future__ import annotations

import argparse
from pathlib import Path

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import (
    EXIT_AT_FAULT,
    EXIT_DONE,
    Commands,
    add_command,
    add_file,
    add_options,
    add_outputs,
    load_model,
    parse_setting,
    print_json,
    report_refusal,
    split_name,
    unique_by_name,
)
from nsmodel.errors import NsmodelError, UsageError
from nsmodel.files.storage import write_text
from nsmodel.hypotheses.findings import VIOLATED
from nsmodel.hypotheses.report import Report
from nsmodel.modeling.signals import Within, within

BOUND_OPTIONS = ("rate", "start")


def add_check_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Decide the hypotheses that the theory of the model's class rests on, and say what follows from them."
    parser = add_command(commands, "check", _run_check, help="check the hypotheses behind a model file", about=about)
    add_file(parser, nargs="+")
    add_options(parser, "check")
    parser.add_argument(
        "--parameters",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="decide for all values of a parameter between these; may be repeated",
    )
    parser.add_argument(
        "--region", action="append", default=[], metavar="NAME=LOW:HIGH",
        help="interval of a state, where no proof covers all states (default: around the run); repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--bound", action="append", default=[], metavar="NAME=LOW:HIGH",
        help="all signals of an input between these are meant (default: read off its signal); behind commas rate=R, the most "
        "that |u'| may be, start=U, its value at t = 0; repeatable",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="skip runs and global searches")
    parser.add_argument("--strict", action="store_true", help="exit with status 1 if a hypothesis is violated")
    add_outputs(
        parser, json="print the report as JSON", markdown="also write the report as Markdown, with the equations",
        html="also write the report as a page for a browser",
        certificate="also write what proves each hypothesis that holds, and a program that verifies it",
    )  # fmt: skip


def _run_check(arguments: argparse.Namespace) -> int:
    """Check each file; several end in a line a file. The status is that of the worst."""
    from nsmodel.hypotheses.check import check

    several = len(arguments.files) > 1
    for option in ("markdown", "html", "certificate"):
        if several and getattr(arguments, option):
            raise UsageError(f"--{option} takes one model file; check them one by one")
    region = unique_by_name((_parse_interval("--region", one, "q_0=-2:2") for one in arguments.region), "--region")
    boxes = unique_by_name((_parse_interval("--parameters", one, "mu=0.1:0.5") for one in arguments.parameters), "--parameters")
    bounds = unique_by_name(map(_parse_bound, arguments.bound), "--bound")
    if twice := set(boxes) & set(unique_by_name(map(parse_setting, arguments.set), "--set")):
        raise UsageError(f"'{min(twice)}' is given with --set and with --parameters; keep one")
    reports: list[tuple[str, Report | None, int]] = []
    documents = []
    for file in arguments.files:
        try:
            model, values = load_model(file, arguments.set)
            if arguments.certificate:
                model.check_allowed("--certificate")
            report = check(model, parameters={**values, **boxes}, region=region, bounds=bounds, quick=arguments.quick)
        except NsmodelError as error:
            reports.append((file, None, report_refusal(error)))
            documents.append({"file": file, "status": "refused", "message": str(error)})
            continue
        at_fault = arguments.strict and report.having(VIOLATED)
        reports.append((file, report, EXIT_AT_FAULT if at_fault else EXIT_DONE))
        documents.append({"file": file, **report.document()} if arguments.json else {})
        if not arguments.json:
            print(report.text(), end="\n\n" if several else "\n")
    if reports[0][1] is not None:
        _write_report(reports[0][1], arguments)
    if arguments.json:
        print_json(arguments, documents if several else documents[0])
    elif several:
        width = max(len(Path(file).stem) for file, _, _ in reports)
        for file, report, _ in reports:
            print(f"{Path(file).stem:{width}}  {'refused' if report is None else report.verdict}")
    return max(status for *_, status in reports)


def _write_report(report: Report, arguments: argparse.Namespace) -> None:
    """Write what was asked for of a report."""
    if arguments.markdown:
        write_text(Path(arguments.markdown), report.markdown())
    if arguments.html:
        report.view(arguments.html)
    if arguments.certificate:
        _save_certificate(report, arguments.certificate, silenced=arguments.json)
    if arguments.html and not arguments.json:
        print(f"\npage  {arguments.html}")


def _parse_interval(option: str, setting: str, example: str) -> tuple[str, tuple[float, float]]:
    name, text = split_name(option, setting, "NAME=LOW:HIGH", example)
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise UsageError(f"{option} {setting}: expected NAME=LOW:HIGH, for example {option} {example}") from None
    return name, (low, high)


def _parse_bound(setting: str) -> tuple[str, Within]:
    interval, *options = setting.split(",")
    name, (low, high) = _parse_interval("--bound", interval, "u=-1:1")
    given: dict[str, float] = {}
    for option in options:
        key, _, text = option.partition("=")
        if key not in BOUND_OPTIONS or key in given:
            raise UsageError(f"--bound {setting}: '{option}'; expected rate=... and start=..., each once at most")
        try:
            given[key] = float(text)
        except ValueError:
            raise UsageError(f"--bound {setting}: {key} = '{text}' is not a number") from None
    try:
        return name, within(low, high, **given)
    except UsageError as error:
        raise UsageError(f"--bound {setting}: {error}") from None


def _save_certificate(report: Report, folder: str, silenced: bool) -> None:
    from nsmodel.hypotheses.certificates.write import write_certificate

    path, proved, left = write_certificate(report, folder)
    if not silenced:
        more = f", {left} of them not checkable: each says why" if left else ""
        print(f"\ncertificate  {path}: {proved + left} statements{more}\n             python {path.parent / 'verify.py'} {path}")
