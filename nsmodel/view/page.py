"""A page that stands alone: its frame, the policy that allows it nothing but itself, its data, and where it is written."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsmodel._utils import escape_invisible
from nsmodel.files.storage import encode_utf8, write_text

VIEW_FOLDER = Path(__file__).parent
PAGE_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="nsmodel">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<noscript>This page draws its data by a script of its own; allow scripts to see it.</noscript>
<main id="page"></main>
<script type="application/json" id="data">{data}</script>
<script>{script}</script>
</body>
</html>"""


def standalone_page(title: str, document: Any, scripts: Sequence[str]) -> str:
    """The page of a document, drawn by scripts of these names.

    What is the user's stands in the title, escaped, and in the data, whose ``<`` are escaped: no text ends their element.
    Scripts set it as text.
    """
    style = (VIEW_FOLDER / "view.css").read_text(encoding="utf-8")
    parts = [(VIEW_FOLDER / f"{name}.js").read_text(encoding="utf-8") for name in scripts]
    script = "\n".join(['"use strict";', "(() => {", *parts, "})();"])
    data = json.dumps(document, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    policy = (
        f"default-src 'none'; script-src '{_csp_hash(script)}'; style-src '{_csp_hash(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    return PAGE_TEMPLATE.format(policy=policy, title=html.escape(escape_invisible(title)), style=style, data=data, script=script)


def write_page(text: str, path: str | Path | None, title: str) -> Path:
    """Write a page, and return its path; where none is given, into a new temporary folder, and open it in the browser."""
    if path is not None:
        write_text(path, text)
        return Path(path)
    name = "".join(c if c.isalnum() else "-" for c in title)[:40].strip("-") or "view"
    made = Path(tempfile.mkdtemp(prefix="nsmodel-")) / f"{name}.html"
    write_text(made, text)
    open_in_browser(made)
    return made


def open_in_browser(path: Path) -> None:
    """Show a page in the user's browser, where there is one."""
    webbrowser.open(path.resolve().as_uri())


def _csp_hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(encode_utf8(text)).digest()).decode()}"
