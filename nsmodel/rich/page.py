"""The few elements of which the HTML of all results is made. Text goes in, and is escaped here and nowhere else.

Verdicts are told by a colour, a mark and a word. Colours are of the result's own where they carry a meaning, and else those of
the page around it, light or dark. Formulas are MathML, which browsers show without a script.
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType

from nsmodel._utils import escape_invisible, one_line, truncate_text
from nsmodel.rich.mathml import mathml

MAX_TEXT_LENGTH = 200  # Characters of one text.
GOOD, FAIR, BAD, OPEN = "good", "fair", "bad", "open"
LEVELS = {
    "holds": GOOD, "done": GOOD, "right": GOOD, "finished": GOOD,
    "sampled": FAIR, "stopped": FAIR, "interrupted": FAIR, "warned": FAIR,
    "violated": BAD, "wrong": BAD, "failed": BAD,
}  # fmt: skip
VERDICT_MARKS = {GOOD: "✓", FAIR: "!", BAD: "✗", OPEN: "?", "sampled": "≈"}
# Blue, amber, vermilion and grey: told apart by who sees no red, no green or no blue, and by their lightness.
# What notebooks say of all tables is overruled.
STYLE = """
.nsm{font-size:13px;line-height:1.45;max-width:64em;text-align:left}
.nsm .head{margin:.2em 0 .5em;font-size:1.15em;font-weight:600}.nsm p{margin:.4em 0}
.nsm table{border-collapse:collapse;border:0!important;margin:.4em 0!important;font-size:1em!important;width:auto!important;
display:table!important;table-layout:auto!important;color:inherit}
.nsm table tr,.nsm table td,.nsm table th{background:none!important;color:inherit!important}
.nsm table td,.nsm table th{border:0!important;border-top:1px solid rgba(128,128,128,.35)!important;vertical-align:top!important;
padding:.2em .7em .2em 0!important;text-align:left!important;white-space:normal!important;max-width:34em!important}
.nsm table th{font-weight:600}.nsm table th,.nsm table td:first-child{white-space:nowrap!important}
.nsm pre{background:none;color:inherit;overflow-x:auto;white-space:pre;margin:.4em 0}
.nsm .kind,.nsm .aside{opacity:.75;font-weight:400}
.nsm .st{display:inline-block;border-radius:.7em;padding:0 .6em;white-space:nowrap;font-weight:600}
.nsm .good{background:#0060a0;color:#fff}.nsm .fair{background:#f0b429;color:#000}
.nsm .bad{background:#a83200;color:#fff}.nsm .open{background:#6b7280;color:#fff}
.nsm .eq{overflow-x:auto;overflow-y:hidden;padding:.25em 0 .25em .1em}.nsm math{font-size:1.15em}
.nsm math{font-family:"Latin Modern Math","STIX Two Math","Cambria Math","DejaVu Math TeX Gyre",math}
.nsm mtable{padding:0 .3em}.nsm mtable.pmatrix{border:solid;border-width:0 1px;border-radius:.7em}
.nsm mtable.cases{border-left:1px solid;text-align:left}.nsm mtable.cases mtd{text-align:left}
.nsm summary{cursor:pointer;margin:.3em 0}.nsm td details,.nsm td summary{margin:0}
@media(max-width:600px){.nsm table td:first-child{white-space:normal!important}}
.nsm .wide{overflow-x:auto}
.nsm img{max-width:100%;height:auto;background:#fff;border-radius:4px;margin:.3em 0}
"""


class Html(str):
    """What stands in a page as it is."""


def escape_text(text: str, width: int = MAX_TEXT_LENGTH) -> Html:
    """Text on one line, cut where it is too long; what would be markup, or a formula, is neither."""
    safe = html.escape(truncate_text(one_line(str(text)), width))
    return Html(re.sub(r"([$\\`])", r"<span>\1</span>", safe))


def as_html(content: str, width: int = MAX_TEXT_LENGTH) -> Html:
    """What is text, escaped; what is an element already, as it is."""
    return content if isinstance(content, Html) else escape_text(content, width)


def element(name: str, *content: str, cls: str = "") -> Html:
    """An element around others; text in it is escaped."""
    attribute = f' class="{cls}"' if cls else ""
    return Html(f"<{name}{attribute}>{''.join(map(as_html, content))}</{name}>")


def result_page(title: str, kind: str, *parts: str) -> str:
    """The whole: a title, and behind it what it is."""
    head = element("div", title, Html(" "), element("span", kind, cls="kind"), cls="head")
    body = "".join([head, *map(as_html, (part for part in parts if part))])
    return f'<div class="nsm tex2jax_ignore mathjax_ignore"><style>{STYLE}</style>{body}</div>'


def status_badge(text: str, verdict: str | None = None) -> Html:
    """Text with the mark and the colour of a verdict; left out, the text is one."""
    verdict = verdict or text
    level = LEVELS.get(verdict, OPEN)
    return element("span", f"{VERDICT_MARKS.get(verdict, VERDICT_MARKS[level])} {text}", cls=f"st {level}")


def verdict_counts(counts: Mapping[str, int], labels: Mapping[str, str] = MappingProxyType({})) -> Html:
    """How many have which verdict; of what there is none without a colour. ``words``: what stands for a verdict."""
    texts = [(f"{count} {labels.get(verdict, verdict)}", verdict if count else "") for verdict, count in counts.items()]
    return join_html([status_badge(text, verdict) if verdict else text for text, verdict in texts], " ")


def facts_table(rows: Iterable[tuple[str, str | Sequence[str]]]) -> Html:
    """A row for each label that has something to say; several entries stand below each other."""
    found = [(label, [content] if isinstance(content, str) else list(content)) for label, content in rows if content]
    lines = [element("tr", element("th", label), element("td", *_with_line_breaks(entries))) for label, entries in found]
    return element("table", element("tbody", *lines)) if lines else Html("")


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table."""
    head = element("thead", element("tr", *(element("th", one) for one in header)))
    body = [element("tr", *(element("td", one) for one in row)) for row in rows]
    return element("div", element("table", head, element("tbody", *body)), cls="wide")


def formula(latex: str) -> Html:
    """A line of LaTeX as MathML."""
    return element("div", Html(mathml(latex)), cls="eq")


def folded_section(summary: str, *content: str) -> Html:
    """What opens at a click."""
    return element("details", element("summary", summary), *content)


def first_rows_table(rows: Sequence[Sequence[str]], count: int, what: str, header: Sequence[str]) -> Html:
    """A table of the first rows; the others behind a click."""
    head_table = html_table(header, rows[:count])
    if len(rows) <= count:
        return head_table
    return join_html([head_table, folded_section(f"{len(rows) - count} more {what}", html_table(header, rows[count:]))], "")


def aside_paragraph(text: str) -> Html:
    """A paragraph that is less than the others."""
    return element("p", text, cls="aside")


def verbatim_text(text: str) -> Html:
    """Lines as they stand."""
    return Html(f"<pre>{html.escape(escape_invisible(text))}</pre>")


def join_html(items: Iterable[str], between: str = ", ") -> Html:
    """Elements and texts side by side."""
    return Html(between.join(map(as_html, items)))


def picture(draw: Callable[[], bytes], alt: str) -> Html:
    """A PNG picture in the page itself; where it cannot be drawn, a line that says why."""
    try:
        data = base64.b64encode(draw()).decode()
    except Exception as error:
        return aside_paragraph(f"no picture: {type(error).__name__}: {error}")
    return Html(f'<img alt="{html.escape(truncate_text(alt), quote=True)}" src="data:image/png;base64,{data}">')


def _with_line_breaks(entries: Sequence[str]) -> list[str]:
    between = Html("<br>")
    return [part for k, entry in enumerate(entries) for part in ([between, entry] if k else [entry])]
