"""The parts of the C library that are the same for all models: files in ``c/``, written for a model called "model"."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Set
from pathlib import Path

from nsmodel.words import one_line

C_FOLDER = Path(__file__).with_name("c")


def read_fragment(name: str, flags: Set[str], replacements: Mapping[str, str]) -> str:
    """Return the file ``name`` with its ``#if FLAG`` resolved, the model's name in its names and its ``@WORD@`` filled."""
    text = prefix_names(
        resolve_conditions((C_FOLDER / name).read_text(encoding="utf-8"), flags), replacements.get("NAME", "model")
    )
    return re.sub(r"@([A-Z_]+)@", lambda match: replacements[match[1]], text)


def compiler_guard() -> str:
    """C that refuses compiler options under which a certificate means nothing."""
    return (C_FOLDER / "guard.c").read_text(encoding="utf-8")


def resolve_conditions(text: str, flags: Set[str]) -> str:
    """Keep the lines of ``#if FLAG``, ``#if !FLAG``, ``#else``, ``#endif`` that hold for ``flags``; other conditions stay."""
    kept: list[str] = []
    conditions: list[tuple[bool, bool]] = []  # (is it one of ours, are its lines kept)
    for line in text.splitlines(keepends=True):
        word = line.split(maxsplit=1)[0] if line.strip() else ""
        ours = re.fullmatch(r"#if (!?)([A-Z_]+)", line.strip())
        if ours:
            conditions.append((True, (ours[2] in flags) != bool(ours[1])))
            continue
        if word in ("#if", "#ifdef", "#ifndef"):
            conditions.append((False, True))
        elif word == "#else" and conditions[-1][0]:
            conditions[-1] = (True, not conditions[-1][1])
            continue
        elif word == "#endif" and conditions.pop()[0]:
            continue
        if all(keep for _, keep in conditions):
            kept.append(line)
    return re.sub(r"\n{3,}", "\n\n", "".join(kept))


def prefix_names(text: str, prefix: str) -> str:
    """Put the model's name into names that begin with model_ or MODEL_."""
    return re.sub(r"\bMODEL_", prefix.upper() + "_", re.sub(r"\bmodel_", prefix + "_", text))


def comment_text(text: str) -> str:
    """The user's words as they may stand in a comment of C: on one line, and without its ends."""
    return one_line(text).replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ?/")


_COMMENT = r"(?:/\*(?:(?!\*/).)*\*/\n)?"
LONG_TABLE = re.compile(r"\{[-+.,e\d\s]{1000,}\};")  # Numbers alone: nothing to look for.
DEFINE_PATTERN = re.compile(r"^#define (\w+) [^\n]*\n", re.MULTILINE)
DECLARATION_PATTERN = re.compile(_COMMENT + r"^static [^;{}=\n]*?\b(\w+)\([^;{}]*\);\n", re.MULTILINE | re.DOTALL)
FUNCTION_PATTERN = re.compile(
    _COMMENT + r"^static [^;{}=]*?\b(\w+)\([^;{}]*\)(?:\n\{\n.*?^\}\n| \{[^\n]*\}\n)", re.MULTILINE | re.DOTALL
)


def prune_unused(text: str) -> str:
    """Leave out the static functions that nothing calls, their declarations, and the constants that nothing uses."""
    numbers: list[str] = []

    def put_aside(match: re.Match[str]) -> str:
        numbers.append(match[0])
        return f"{{@{len(numbers) - 1}@}};"

    text = _prune_definitions(re.sub(LONG_TABLE, put_aside, text))
    return re.sub(r"\{@(\d+)@\};", lambda match: numbers[int(match[1])], text)


def _prune_definitions(text: str) -> str:
    while True:
        token_counts = Counter(re.findall(r"\w+", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)))
        declared = Counter(match[1] for match in DECLARATION_PATTERN.finditer(text))
        unused = [match for match in FUNCTION_PATTERN.finditer(text) if token_counts[match[1]] == 1 + declared[match[1]]]
        names = {match[1] for match in unused}
        unused += [match for match in DECLARATION_PATTERN.finditer(text) if match[1] in names]
        unused += [match for match in DEFINE_PATTERN.finditer(text) if token_counts[match[1]] == 1]
        if not unused:
            return re.sub(r"\n{3,}", "\n\n", text)
        for match in sorted(unused, key=lambda match: -match.start()):
            text = text[: match.start()] + text[match.end() :]
