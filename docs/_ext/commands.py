"""The command line: what ``nsmodel COMMAND --help`` says of every command, from its own parser."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive

from nsmodel.cli import _parser


def setup(app: Any) -> dict[str, bool]:
    """Add the directive."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}


class Commands(Directive):
    """A section for each command."""

    def run(self) -> list[nodes.Node]:
        """The sections, then what exit statuses mean."""
        parser = _parser()
        sections = [self.section(name, command) for name, command in commands(parser).items()]
        return [*sections, nodes.paragraph("", sentence(parser.epilog or ""))]

    def section(self, name: str, parser: argparse.ArgumentParser) -> nodes.section:
        """A command: what it does, how it is called, its arguments."""
        section = nodes.section(ids=[f"nsmodel-{name}"], names=[f"nsmodel {name}"])
        section += nodes.title("", "", nodes.literal("", f"nsmodel {name}"))
        section += nodes.paragraph("", sentence(parser.description or ""))
        section += nodes.literal_block("", parser.format_usage().removeprefix("usage: ").rstrip(), language="text")
        section += nodes.definition_list("", *(item(call, text) for call, text in arguments(parser)), classes=["options"])
        if parser.epilog:
            section += nodes.paragraph("", sentence(parser.epilog))
        self.state.document.note_implicit_target(section, section)
        return section


def commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parser of each command."""
    return next(dict(action.choices) for action in parser._actions if isinstance(action, argparse._SubParsersAction))


def arguments(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """How each argument is written, and what it does."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        if action.help != argparse.SUPPRESS and not isinstance(action, argparse._HelpAction):
            yield formatter._format_action_invocation(action), formatter._expand_help(action) if action.help else ""


def item(call: str, text: str) -> nodes.definition_list_item:
    """An argument in a list of definitions."""
    term = nodes.term("", "", nodes.literal("", call))
    return nodes.definition_list_item("", term, nodes.definition("", nodes.paragraph("", sentence(text))))


def sentence(text: str) -> str:
    """The text with a capital letter and a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", ":")) or not text else ".")
