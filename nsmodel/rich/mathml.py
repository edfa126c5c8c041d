r"""Formulas as MathML, which browsers show without a script: of the LaTeX that this package writes itself, and no more.

A notebook may or may not look for dollar signs in HTML (some do not), a page may be read offline. MathML Core is shown by all
browsers of today.

>>> mathml(r"\dot{x} = \frac{1}{2}")[-85:]
'<mo>=</mo><mfrac><mrow><mn>1</mn></mrow><mrow><mn>2</mn></mrow></mfrac></mrow></math>'
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable

from nsmodel._utils import one_line

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
        if name in LETTERS:
            return f"<mi>{LETTERS[name]}</mi>"
        if name in SIGNS:
            return _operator(name)
        if name in SPACES:
            return f'<mspace width="{SPACES[name]}"></mspace>'
        if name == "left":
            return self._read_fenced()
        if name == "text":
            return f"<mtext>{html.escape(self._read_text()).replace(' ', chr(0xA0))}</mtext>"
        if name == "frac":
            return f"<mfrac>{self._argument()}{self._argument()}</mfrac>"
        if name == "sqrt":
            return f"<msqrt>{self._argument()}</msqrt>"
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
