"""Formulas drawn by KaTeX (0.19.1, in _static/katex with its licence): a part of the site, so that no network is needed."""

from __future__ import annotations

from html import escape
from typing import Any

from docutils import nodes
from sphinx.util.math import get_node_equation_number, wrap_displaymath

SCRIPTS = ("katex/katex.min.js", "katex/auto-render.min.js", "katex/draw.js")


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer, and what pages load."""
    app.add_html_math_renderer("katex", inline_renderers=(inline, None), block_renderers=(block, None))
    app.add_css_file("katex/katex.min.css")
    for script in SCRIPTS:
        app.add_js_file(script, loading_method="defer")
    return {"parallel_read_safe": True}


def inline(writer: Any, node: nodes.math) -> None:
    """A formula in a line."""
    writer.body.append(f'<span class="math notranslate">\\({escape(node.astext())}\\)</span>')
    raise nodes.SkipNode


def block(writer: Any, node: nodes.math_block) -> None:
    """A formula of its own, which scrolls where it is too wide."""
    writer.body.append(writer.starttag(node, "div", CLASS="math notranslate"))
    if node["number"]:
        writer.body.append(f'<span class="eqno">({get_node_equation_number(writer, node)})</span>')
    text = node.astext() if node.get("no-wrap", node.get("nowrap")) else wrap_displaymath(node.astext(), None, False).strip()
    writer.body.append(f"{escape(text)}</div>\n")
    raise nodes.SkipNode
