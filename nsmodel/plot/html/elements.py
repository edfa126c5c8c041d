r"""The few elements of which the HTML of all results is made. Text goes in, and is escaped here and nowhere else.

Verdicts are told by a colour, a mark and a word. Colours are of the result's own where they carry a meaning, and else those of
the page around it, light or dark. Formulas are MathML, of the LaTeX that this package writes itself, and no more: browsers show
it without a script.

A notebook may or may not look for dollar signs in HTML (some do not), a page may be read offline. MathML Core is shown by all
browsers of today.

>>> mathml(r"\dot{x} = \frac{1}{2}")[-85:]
'<mo>=</mo><mfrac><mrow><mn>1</mn></mrow><mrow><mn>2</mn></mrow></mfrac></mrow></math>'
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from nsmodel._utils import escape_invisible, one_line, truncate_text

TOKEN = re.compile(r"\\begin\{[a-z]+\}|\\end\{[a-z]+\}|\\[A-Za-z]+|\\.|\d+(?:\.\d+)?|\s+|.", re.DOTALL)
LETTERS = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ϵ", "zeta": "ζ", "eta": "η", "theta": "θ", "iota": "ι",
    "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "pi": "π", "rho": "ρ", "sigma": "σ", "tau": "τ",
    "upsilon": "υ", "phi": "ϕ", "chi": "χ", "psi": "ψ", "omega": "ω", "Gamma": "Γ", "Delta": "Δ", "Theta": "Θ", "Lambda": "Λ",
    "Xi": "Ξ", "Pi": "Π", "Sigma": "Σ", "Upsilon": "Υ", "Phi": "Φ", "Psi": "Ψ", "Omega": "Ω", "infty": "∞", "emptyset": "∅",
    "partial": "∂", "ldots": "…", "cdots": "⋯", "vdots": "⋮",
}  # fmt: skip
SIGNS = {
    "geq": "≥", "leq": "≤", "neq": "≠", "in": "∈", "ni": "∋", "cdot": "·", "times": "×", "perp": "⟂", "wedge": "∧", "vee": "∨",
    "neg": "¬", "Vert": "‖", "lfloor": "⌊", "rfloor": "⌋", "lceil": "⌈", "rceil": "⌉",
    "{": "{", "}": "}", "|": "‖", "-": "−",
}  # fmt: skip
FUNCTION_NAMES = frozenset("exp log sin cos tan sinh cosh tanh arcsin arccos arctan min max".split())
SPACES = {",": "0.17em", " ": "0.25em", "quad": "1em"}
ARGUMENT_COUNTS = {"frac": 2, "sqrt": 1}
ACCENTS = {"dot": "˙", "ddot": "¨"}
CLOSING_FENCES = (")</mo>", "]</mo>", "|</mo>", "‖</mo>")
LETTER_STYLES = {"mathit": "", "mathrm": ' mathvariant="normal"', "mathsf": ' mathvariant="normal"'}
NOT_LETTERS = "0123456789.,;:+-=<>()[]/|!'*"


def mathml(latex: str) -> str:
    """Return a line of LaTeX as an element of MathML; a command that is not known stands there by its name."""
    return f'<math displaystyle="true"><mrow>{_LatexReader(one_line(latex)).row()}</mrow></math>'


class _LatexReader:
    """Goes through the tokens once."""

    def __init__(self, latex: str) -> None:
        self.tokens = TOKEN.findall(latex)
        self.at = 0

    def row(self, until: Iterable[str] = ()) -> str:
        """All up to one of these tokens, which is read too."""
        found: list[str] = []
        while self.at < len(self.tokens):
            token = self._next()
            if token in until:
                self.last = token
                return "".join(found)
            if token in ("_", "^"):
                found.append(self._scripts(found.pop() if found else "<mrow></mrow>", token))
            elif token in "+-" and (
                not found or (found[-1].startswith(("<mo", "<ms")) and not found[-1].endswith(CLOSING_FENCES))
            ):
                found.append(f'<mo form="prefix">{SIGNS.get(token, token)}</mo>')
            elif not token.isspace():
                found.append(self._read_token(token))
        self.last = ""
        return "".join(found)

    def _next(self) -> str:
        self.at += 1
        return self.tokens[self.at - 1]

    def _peek(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def _argument(self) -> str:
        while self._peek().isspace():
            self.at += 1
        token = self._next() if self._peek() else "}"
        return f"<mrow>{self.row('}')}</mrow>" if token == "{" else self._read_token(token)

    def _scripts(self, base: str, token: str) -> str:
        first = self._argument()
        if self._peek() not in ("_", "^") or self._peek() == token:
            return f"<m{'sub' if token == '_' else 'sup'}>{base}{first}</m{'sub' if token == '_' else 'sup'}>"
        self._next()
        second = self._argument()
        low, high = (first, second) if token == "_" else (second, first)
        return f"<msubsup>{base}{low}{high}</msubsup>"

    def _read_token(self, token: str) -> str:
        if token == "{":
            return f"<mrow>{self.row('}')}</mrow>"
        if token.startswith(r"\begin"):
            return self._read_table(token[7:-1])
        if token.startswith("\\"):
            return self._command(token[1:])
        if token[0].isdigit():
            return f"<mn>{token}</mn>"
        if token in NOT_LETTERS:
            return f'<mo stretchy="false">{html.escape(SIGNS.get(token, token))}</mo>' if token in "()[]|" else _operator(token)
        return f"<mi>{html.escape(token)}</mi>"

    def _command(self, name: str) -> str:
        if name in SYMBOLS:
            return SYMBOLS[name]
        if name == "left":
            return self._read_fenced()
        if name == "text":
            return f"<mtext>{html.escape(self._read_text()).replace(' ', chr(0xA0))}</mtext>"
        if name in ARGUMENT_COUNTS:
            return f"<m{name}>{''.join(self._argument() for _ in range(ARGUMENT_COUNTS[name]))}</m{name}>"
        if name in ACCENTS:
            return f'<mover accent="true">{self._argument()}<mo stretchy="false">{ACCENTS[name]}</mo></mover>'
        if name in LETTER_STYLES:
            return f"<mi{LETTER_STYLES[name]}>{html.escape(self._read_text())}</mi>"
        if name == "mathbb":
            return f"<mi>{'ℝ' if (letter := self._read_text()) == 'R' else html.escape(letter)}</mi>"
        return f'<mi mathvariant="normal">{name}</mi>' if name in FUNCTION_NAMES else f"<mtext>{html.escape(name)}</mtext>"

    def _read_text(self) -> str:
        """Words in brackets, as `notation.words` wrote them."""
        depth, tokens = 0, []
        while self.at < len(self.tokens):
            token = self._next()
            depth += (token == "{") - (token == "}")
            if not depth:
                break
            tokens.append(token)
        text = "".join(tokens[1:])
        return re.sub(r"\\(backslash ?|.)", lambda found: "\\" if found[1].startswith("backslash") else found[1], text)

    def _read_fenced(self) -> str:
        left = _fence(self._next())
        inner = self.row((r"\right",))
        right = _fence(self._next()) if self._peek() else ""
        return f"<mrow>{left}{inner}{right}</mrow>"

    def _read_table(self, kind: str) -> str:
        rows: list[list[str]] = [[]]
        end = rf"\end{{{kind}}}"
        while True:
            rows[-1].append(f"<mtd><mrow>{self.row(('&', chr(92) * 2, end))}</mrow></mtd>")
            if self.last in (end, ""):
                break
            if self.last != "&":
                rows.append([])
        body = "".join(f"<mtr>{''.join(row)}</mtr>" for row in rows)
        return f'<mtable class="{html.escape(kind)}">{body}</mtable>'


def _operator(name: str) -> str:
    return f"<mo>{html.escape(SIGNS.get(name, name))}</mo>"


def _fence(token: str) -> str:
    sign = SIGNS.get(token.removeprefix("\\"), token.removeprefix("\\"))
    return f'<mo fence="true" stretchy="true">{html.escape(sign)}</mo>' if sign not in ("", ".") else ""


SYMBOLS = {  # Commands that stand for themselves.
    **{name: f"<mi>{letter}</mi>" for name, letter in LETTERS.items()},
    **{name: _operator(name) for name in SIGNS},
    **{name: f'<mspace width="{width}"></mspace>' for name, width in SPACES.items()},
}
MAX_TEXT_LENGTH = 200  # Characters of one text of a page; longer ones are cut: two lines of a page.
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


def as_html(content: str) -> Html:
    """What is text, escaped; what is an element already, as it is."""
    return content if isinstance(content, Html) else escape_text(content)


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
    lines = [element("tr", element("th", label), element("td", join_html(entries, "<br>"))) for label, entries in found]
    return element("table", element("tbody", *lines)) if lines else Html("")


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table in HTML, its header first."""
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


def picture(draw: Callable[[], Any], dpi: int, alt: str) -> Html:
    """A figure, or that of axes, in the page itself as PNG; where it cannot be drawn, a line that says why."""
    from nsmodel.plot.notebook_figures import light_png

    try:
        data = base64.b64encode(light_png(draw(), dpi)).decode()
    except Exception as error:
        return aside_paragraph(f"no picture: {type(error).__name__}: {error}")
    return Html(f'<img alt="{html.escape(truncate_text(alt), quote=True)}" src="data:image/png;base64,{data}">')
