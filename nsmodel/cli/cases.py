"""``nsmodel cases`` and ``nsmodel new``: what there is to run, read and copy; a model file to start from."""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nsmodel._utils import print_escaped as print
from nsmodel.cli.common import EXIT_DONE, Commands, add_command, add_outputs, print_json
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_text
from nsmodel.modeling import model_files
from nsmodel.modeling.model_files import TOPICS, Case


def add_cases_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "List the cases that come with nsmodel, by topic; of one, say what it shows and where it lies."
    parser = add_command(commands, "cases", _print_cases, help="list the cases that come with nsmodel", about=about)
    parser.add_argument("name", metavar="CASE", nargs="?", help="the case to describe, or a topic to list (default: list all)")
    add_outputs(parser, json="print as JSON")


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


def _case_document(case: Case) -> dict[str, Any]:
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


MODEL_TEMPLATE = '''
"""A mass on a spring with dry friction: one line that says what the model is.

What to see: what a reader should look at in the pictures. Here the mass swings a few
times, stops away from x = 0, and stays there.

A wrong answer: how it would show. Here the mass would creep back to x = 0, or its
velocity would tremble around 0 instead of being 0.
"""

from nsmodel import LureSystem, relay


def model(mu=0.1):
    """The model; nsmodel run NAME.py --set mu=0.2 gives it another mu."""
    m, k, g = 1.0, 4.0, 9.81  # kg, N/m, m/s^2
    return LureSystem(
        # x' = A x + B l: the states are position and velocity, l is the friction force
        A=[[0, 1], [-k / m, 0]],
        B=[0, 1 / m],
        # y = C x, the velocity: l = -mu m g where y > 0, mu m g where y < 0,
        # and what is needed between them where y = 0
        C=[0, 1],
        law=relay(1, -mu * m * g, mu * m * g),
        x0=[1, 0],
        t_end=10,
        step=1e-3,
        names=["position", "velocity"],
        units={"t": "s", "position": "m", "velocity": "m/s", "l_0": "N"},
        title="A mass on a spring with dry friction",
    )
'''.lstrip()
FORBIDDEN_NAMES = sys.stdlib_module_names | {"nsmodel", "casadi", "numpy", "scipy", "sympy", "matplotlib"}


def add_new_command(commands: Commands) -> None:
    """Add the command and its options."""
    about = "Write NAME.py: a model that runs, to start from; with --like a copy of a case."
    parser = add_command(commands, "new", _write_new_model, help="write a model file to start from", about=about)
    parser.add_argument("name", metavar="NAME", help="name of the file, which is NAME.py in this folder")
    parser.add_argument("--like", metavar="CASE", help="the case to copy (see nsmodel cases)")
    add_outputs(parser, force="replace NAME.py if it exists already")


def _write_new_model(arguments: argparse.Namespace) -> int:
    """Write the file and say what to do with it."""
    name = arguments.name.removesuffix(".py")
    if not re.fullmatch(r"[A-Za-z_][\w-]*", name, re.ASCII):
        raise UsageError(
            f"'{arguments.name}' is not a valid name for a model file: expected letters, digits, _ and -, a letter first, such "
            "as my_model; the file is written into this folder"
        )
    if name in FORBIDDEN_NAMES:
        raise UsageError(
            f"{name}.py would hide the Python module {name} from its neighbours; take another name, such as my_{name}"
        )
    path = Path(f"{name}.py")
    if path.exists() and not arguments.force:
        raise UsageError(f"{path} exists already; take another name, or give --force to replace it")
    if arguments.like is None:
        text, what = MODEL_TEMPLATE.replace("NAME", name), "a mass on a spring with dry friction"
    else:
        case = model_files.find_case(arguments.like)
        text, what = case.path.read_text(encoding="utf-8"), f"a copy of {case.name}"
    write_text(path, text.rstrip("\n"))
    print(f"{path}: {what}\n\n    nsmodel run {path} --plot\n    nsmodel check {path}")
    return EXIT_DONE
