"""Links that lead somewhere on a host of repositories, and elsewhere on the site: to cases, to README.md; and marks of tables."""

from __future__ import annotations

import re
from typing import Any

CASE = re.compile(r"\]\((?:\.\./)+cases/\w+/(\w+)\.py\)")
SHELF = re.compile(r"\]\((?:\.\./)+cases/?\)")
MARK = re.compile(r"^<!-- (?:table: [\w ]+|end) -->$", re.MULTILINE)  # where docs/figures writes a table
README = re.compile(r"\]\((?:\.\./)+README\.md\)")


def setup(app: Any) -> dict[str, bool]:
    """Change them as pages are read."""
    app.connect("source-read", lead_to_pages)
    return {"parallel_read_safe": True}


def lead_to_pages(app: Any, name: str, source: list[str]) -> None:
    """A case is a page of the gallery, README.md the first page; marks of tables are left out."""

    def page(match: re.Match[str]) -> str:
        chosen = app.config.gallery_cases
        return f"](/gallery/{match[1] if not chosen or match[1] in chosen else 'index'}.md)"

    text = SHELF.sub("](/gallery/index.md)", CASE.sub(page, source[0]))
    source[0] = MARK.sub("", README.sub("](/index.md)", text))
