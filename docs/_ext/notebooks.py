"""Notebooks are Markdown with cells; each can be taken as .ipynb, with what its cells have shown."""

from __future__ import annotations

import re
from typing import Any


def setup(app: Any) -> dict[str, bool]:
    """Say where they are kept, and add the link as pages are read."""
    app.connect("builder-inited", keep_beside, priority=600)  # after myst-nb has its own
    app.connect("source-read", add_download)
    return {"parallel_read_safe": True}


def keep_beside(app: Any) -> None:
    """What cells show is written where all that is made by running is, not beside the site."""
    app.env.mystnb_config = app.env.mystnb_config.copy(output_folder=f"{app.config.made_in}/jupyter")


def add_download(app: Any, name: str, source: list[str]) -> None:
    """After the title of a notebook a link to take it."""
    if name.startswith("notebooks/") and "{code-cell}" in source[0]:
        own = name.rpartition("/")[2]
        source[0] = re.sub(
            r"^(# .+)$", rf"\1\n\nTake this notebook: {{nb-download}}`{own}.ipynb`.", source[0], count=1, flags=re.M
        )
