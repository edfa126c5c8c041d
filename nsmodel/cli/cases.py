"""``nsmodel cases``: what there is to run, read and copy."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from nsmodel._utils import print_escaped as print
from nsmodel.cli.output import print_json
from nsmodel.cli.settings import Commands
from nsmodel.cli.status import EXIT_DONE
from nsmodel.modeling import model_files
from nsmodel.modeling.model_files import TOPICS, Case


def add(commands: Commands) -> None:
    """Add the command and its options."""
    about = "List the cases that come with nsmodel, by topic; of one, say what it shows and where it lies."
    parser = commands.add_parser("cases", help="list the cases that come with nsmodel", description=about)
    parser.add_argument("name", metavar="CASE", nargs="?", help="the case to describe, or a topic to list (default: list all)")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.set_defaults(command=_print_cases)


def _print_cases(arguments: argparse.Namespace) -> int:
    """Print all cases, or one."""
    if arguments.name is None or arguments.name in TOPICS:
        found = [case for case in model_files.all_cases() if arguments.name in (None, case.topic)]
        document: Any = [_case_document(case) for case in found]
        text = _list_by_topic(found)
    else:
        case = model_files.find_case(arguments.name)
        document, text = _case_document(case), _describe_case(case)
    if arguments.json:
        print_json(arguments, document)
    else:
        print(text)
    return EXIT_DONE


def _case_document(case: Case) -> dict[str, str]:
    return asdict(case) | {"path": str(case.path)}


def _list_by_topic(cases: Sequence[Case]) -> str:
    """A line a case under its topic, cut to the terminal's width."""
    width = max(len(case.name) for case in cases) + 4
    room = max(20, _terminal_width() - width)
    blocks = []
    for topic in TOPICS:
        titles = {case.name: textwrap.shorten(case.title, room, placeholder=" ...") for case in cases if case.topic == topic}
        lines = [f"  {name}".ljust(width) + title for name, title in titles.items()]
        if lines:
            blocks.append("\n".join([topic, *lines]))
    return "\n\n".join([*blocks, "one of them: nsmodel cases CASE, nsmodel run CASE, nsmodel new NAME --like CASE"])


def _describe_case(case: Case) -> str:
    """The case's own words, its file, and what to type next."""
    labels = {"What to see": case.see, "A wrong answer": case.wrong, "Source": case.source, "Topic": case.topic}
    labelled = [f"{label}: {text}" for label, text in labels.items() if text]
    parts = [f"{case.name}: {case.title}", *case.story.split("\n\n"), *labelled]
    parts.append(f"    {case.path}\n\n    nsmodel run {case.name} --plot\n    nsmodel new my_{case.name} --like {case.name}")
    return "\n\n".join(_fill_paragraph(part) for part in parts if part)


def _fill_paragraph(text: str) -> str:
    """A paragraph in lines as long as the terminal's, 100 characters at most; one that is set in, a formula, as it stands."""
    return text if text.startswith("    ") else textwrap.fill(" ".join(text.split()), min(_terminal_width(), 100))


def _terminal_width() -> int:
    """The width of the terminal; 120 where there is none."""
    return shutil.get_terminal_size((120, 24)).columns
