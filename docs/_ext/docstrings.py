"""Docstrings are plain text: paragraphs, sections (Args:, Attributes:, Raises:), `names` and ``code`` between backticks.

Here they become reStructuredText that shows them so, names of the package being links. What annotations call by the module that
defines it (nsmodel.simulation.trajectory.Trajectory) is found under its public name.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from typing import Any

import nsmodel

SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields):$")
ENTRY = re.compile(r"(?P<names>[^:`]+): +(?P<text>.*)", re.DOTALL)
MARKED = re.compile(r"(``.+?``|`.+?`)")
SIGNS = re.compile(r"([*|\\]|(?<=\w)_(?!\w))")
FACTORY = re.compile(r"<(factory|dataclasses\._HAS_DEFAULT_FACTORY_CLASS object[^>]*)>")


def setup(app: Any) -> dict[str, bool]:
    """Change docstrings and signatures as autodoc reads them; resolve references that were not found."""
    app.connect("autodoc-process-docstring", as_text)
    app.connect("autodoc-process-signature", without_factories)
    app.connect("autodoc-skip-member", without_aliases)
    app.connect("missing-reference", public, priority=400)  # before other projects are asked
    return {"parallel_read_safe": True}


def as_text(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """The docstring in reStructuredText."""
    lines[:] = list(converted(lines))


def without_factories(
    app: Any, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Defaults that are made anew for each object have no value to show."""
    return (FACTORY.sub("...", signature) if signature else signature), (None if returns == "None" else returns)


def without_aliases(app: Any, what: str, name: str, value: Any, skip: bool, options: Any) -> bool | None:
    """The fields of a named tuple are told in its own docstring."""
    return True if str(getattr(value, "__doc__", "")).startswith("Alias for field number") else None


ELSEWHERE = {  # What annotations say, and what it is called where it is described.
    "Axes": "matplotlib.axes.Axes",
    "Figure": "matplotlib.figure.Figure",
    "Path": "pathlib.Path",
    "np.ndarray": "numpy.ndarray",
    "numpy.random._generator.Generator": "numpy.random.Generator",
}


def public(app: Any, env: Any, node: Any, content: Any) -> Any:
    """The documented name of what is called by another: by the module that defines it, or alone."""
    node["reftarget"] = ELSEWHERE.get(node.get("reftarget"), node.get("reftarget"))
    domain, last = env.get_domain("py"), str(node["reftarget"]).rpartition(".")[2]
    if node.get("refdomain") != "py":
        return None
    kinds = ("class", "exception", "function")
    found = [name for name, entry in domain.objects.items() if name.rpartition(".")[2] == last and entry.objtype in kinds]
    if not found:
        return None
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", min(found, key=len), node, content)


def converted(lines: list[str]) -> Iterator[str]:
    """Line by line; an indented block is a list of entries (``name: text``), or shown as it stands."""
    at = 0
    while at < len(lines):
        line, at = lines[at], at + 1
        section = SECTION.match(line)
        if line[:1].isspace() or section:
            start = at - (not section)
            while at < len(lines) and (not lines[at].strip() or lines[at][:1].isspace()):
                at += 1
            if section:
                yield from ("", f".. rubric:: {section[1]}", "")
            yield from block(lines[start:at])
        else:
            yield escaped(line)


def block(lines: list[str]) -> Iterator[str]:
    """An indented block."""
    text = textwrap.dedent("\n".join(lines)).strip("\n")
    matches = [ENTRY.fullmatch(entry.strip()) for entry in re.split(r"\n(?=\S)", text)]
    if text.startswith(">>>") or not any(matches):
        yield from ("", *(["::", ""] if not text.startswith(">>>") else []), *textwrap.indent(text, "    ").splitlines(), "")
        return
    for entry, match in zip(re.split(r"\n(?=\S)", text), matches, strict=True):
        if match:
            names = ", ".join(linked(one.strip()) for one in match["names"].split(","))
            yield from (names, "    " + escaped(" ".join(match["text"].split())), "")
        else:
            yield from (escaped(" ".join(entry.split())), "")


def linked(name: str) -> str:
    """A name as code, with a link where it is one of the package's."""
    own = name.removeprefix("nsmodel.")
    return f":py:obj:`~nsmodel.{own}`" if own.partition(".")[0] in nsmodel.__all__ else f"``{name}``"


def escaped(text: str) -> str:
    """A line in which only backticks mean anything."""
    parts = MARKED.split(text)
    return "".join(marked(part) if k % 2 else SIGNS.sub(r"\\\1", part) for k, part in enumerate(parts))


def marked(text: str) -> str:
    """What stands between backticks: one of them marks a name."""
    return text if text.startswith("``") else linked(text.strip("`"))
