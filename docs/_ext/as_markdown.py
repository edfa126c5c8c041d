"""Plain text as Markdown that shows it as it stands."""

from __future__ import annotations

import os
import re
import textwrap
from pathlib import Path

PUNCTUATION = re.compile(r"([!-/:-@\[-`{-~])")
CODE = re.compile(r"``(.+?)``|`(.+?)`", re.DOTALL)


def plain(text: str) -> str:
    """One line of text, in which nothing is a sign of Markdown."""
    return _kept(text.strip())


def prose(text: str) -> str:
    """Paragraphs of a docstring: what is indented is shown as it stands, what is between backticks as code, the rest as text."""
    return "\n\n".join(_paragraph(one) for one in text.split("\n\n") if one.strip())


def fenced(code: str, language: str = "text") -> str:
    """Code in a fence longer than any in it."""
    fence = "`" * max(3, 1 + max(map(len, re.findall(r"`+", code)), default=0))
    return f"{fence}{language}\n{code.rstrip()}\n{fence}"


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table of cells in Markdown."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *rows))


def relative(path: Path, start: Path) -> str:
    """The path from a folder, as links have it."""
    return os.path.relpath(path, start).replace(os.sep, "/")


def _paragraph(text: str) -> str:
    if all(line.startswith("    ") for line in text.splitlines() if line.strip()):
        return fenced(textwrap.dedent(text))
    if re.match(r"\s*[-*] ", text):
        items = re.split(r"\n\s*[-*] ", "\n" + text)[1:]
        return "\n".join(f"- {_inline(item)}" for item in items)
    return _inline(text)


def _inline(text: str) -> str:
    """Text with code between backticks."""
    parts, at = [], 0
    for match in CODE.finditer(text):
        parts += [_kept(text[at : match.start()]), f"``{match[1] or match[2]}``"]
        at = match.end()
    return "".join([*parts, _kept(text[at:])])


def _kept(text: str) -> str:
    """The same with spaces at both ends where there are."""
    return PUNCTUATION.sub(r"\\\1", re.sub(r"\s+", " ", text))
