"""Pictures of the runs of model files that stand on pages: blocks marked ``python model-file NAME.py picture``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from as_markdown import relative
from runs import Job, made, package_hash

BLOCK = re.compile(
    r"^```python model-file (?P<name>\S+)(?P<words>[^\n]*)\n(?P<code>.*?)^```$(?P<output>\n+```text\n.*?^```$)?", re.M | re.S
)


def setup(app: Any) -> dict[str, bool]:
    """Put the pictures into pages as they are read."""
    app.add_config_value("snippet_pages", [], "env", list)  # those alone; none: all
    app.add_config_value("package", package_hash(), "env", str)  # all pages are read anew where it changes
    app.connect("source-read", add_pictures)
    return {"parallel_read_safe": True}


def add_pictures(app: Any, name: str, source: list[str]) -> None:
    """After each such block, and the output that follows it, the picture of its run."""
    chosen = app.config.snippet_pages
    found = [match for match in BLOCK.finditer(source[0]) if "picture" in match["words"].split()]
    if found and (not chosen or name in chosen):
        jobs = [Job(match["name"], match["code"]) for match in found]
        pictures = made(jobs, Path(app.config.made_in) / "snippets")
        folder = Path(app.env.doc2path(name)).parent
        text, at = "", 0
        for match, one in zip(found, pictures, strict=True):
            text += source[0][at : match.end()] + figure(relative(one.picture, folder), one.facts["title"])
            at = match.end()
        source[0] = text + source[0][at:]


def figure(picture: str, title: str) -> str:
    """The picture in Markdown."""
    return f"\n\n```{{figure}} {picture}\n:alt: {' '.join(title.split())}: overview of the run\n:figclass: overview\n```\n"
