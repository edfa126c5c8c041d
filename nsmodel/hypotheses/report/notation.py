"""Names, numbers and brackets in LaTeX."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from math import inf, isfinite, isnan, pi, sqrt

import casadi as ca

DECIMAL_DIGITS = 6  # Of longer decimals, with dots behind.
RELATION_LEVEL, SUM_LEVEL, PRODUCT_LEVEL, POWER_LEVEL, ATOM_LEVEL = range(
    5
)  # How tightly the outermost operation of a piece binds.
_GREEK = set(
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi omega "
    "Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega".split()
)


@dataclass(frozen=True)
class FormulaPart:
    """A part of a formula: ``body`` without its sign, how tightly it binds, the operation and the parts it was made of."""

    body: str
    level: int
    negative: bool = False
    op: int = ca.OP_CONST
    args: tuple[FormulaPart, ...] = ()
    size: int = 1
    name: str = ""

    @property
    def text(self) -> str:
        """The formula with its sign."""
        return f"-{self.body}" if self.negative else self.body

    def at(self, level: int) -> str:
        """The formula, in brackets unless it binds at least as tightly as ``level``."""
        bare = self.level >= level and not (self.negative and level > SUM_LEVEL)
        return self.text if bare else bracketed(self.text)

    def factor(self) -> str:
        """The body as a factor of a product, where the sign is pulled out."""
        return self.body if self.level >= PRODUCT_LEVEL else bracketed(self.body)


def bracketed(text: str) -> str:
    """The text in round brackets that grow with it."""
    return rf"\left({text}\right)"


def vector_latex(entries: Sequence[str]) -> str:
    """A vector: its one entry, or the entries in brackets; long ones abbreviated."""
    if len(entries) == 1:
        return entries[0]
    return bracketed(r",\ ".join(entries if len(entries) <= 8 else [*entries[:6], r"\ldots", entries[-1]]))


def symbol_latex(name: str) -> str:
    r"""A name as LaTeX: mu1 and mu_1 become \mu_{1}, longer words italic; the user's own LaTeX is not read.

    >>> print(symbol_latex("mu1"), symbol_latex("q_0"), symbol_latex("heater"))
    \mu_{1} q_{0} \mathit{heater}
    """
    stem, _, rest = name.partition("_")
    digits = re.fullmatch(r"([A-Za-z]+)(\d+)", stem)
    subscripts = ([digits[2]] if digits else []) + [part for part in rest.split("_") if part]
    base = _word_latex(digits[1] if digits else stem or name, italic=True)
    return base + (f"_{{{','.join(_word_latex(part, italic=False) for part in subscripts)}}}" if subscripts else "")


def text_latex(text: str) -> str:
    """Free text (the name of a constraint) inside a formula."""
    special = {"\\": r"\backslash ", "{": r"\{", "}": r"\}", "_": r"\_", "%": r"\%", "#": r"\#", "&": r"\&", "$": r"\$"}
    return rf"\text{{{''.join(special.get(letter, letter) for letter in text)}}}"


def number_latex(value: float) -> str:
    r"""A number as the user wrote it; long decimals end in dots, exact doubles of sqrt(2), pi, 1/3 ... are named.

    >>> print(number_latex(0.1), number_latex(2.5e-7), number_latex(2 / 3), number_latex(0.12345678))
    0.1 2.5\cdot 10^{-7} \frac{2}{3} 0.123456\ldots
    """
    return number_formula(value).text


def number_formula(value: float) -> FormulaPart:
    """A constant as a piece of a formula; see :func:`number_latex`."""
    negative, size = value < 0, abs(float(value))
    if isfinite(size) and len(f"{float(f'{size:.13g}')!r}") <= 10:
        size = float(f"{size:.13g}")  # 3.9000000000000004 was meant to be 3.9.
    if isnan(value):
        return FormulaPart(r"\mathrm{nan}", ATOM_LEVEL)
    if size == inf:
        return FormulaPart(r"\infty", ATOM_LEVEL, negative)
    known = named_constant(size)
    if known is not None:
        ratio, root = known
        head = "" if ratio.numerator == 1 and root else str(ratio.numerator)
        body = rf"{head}{root}" if ratio.denominator == 1 else rf"\frac{{{head}{root}}}{{{ratio.denominator}}}"
        return FormulaPart(body, PRODUCT_LEVEL if head and root and ratio.denominator == 1 else ATOM_LEVEL, negative)
    if size == int(size) and size < 1e7 and size != 1e6:
        return FormulaPart(str(int(size)), ATOM_LEVEL, negative)
    power = Decimal(repr(size)).adjusted()
    if -4 <= power < 6:
        return FormulaPart(_shorten_decimal(repr(size)), ATOM_LEVEL, negative)
    mantissa = _shorten_decimal(_mantissa(size))
    if mantissa == "1":
        return FormulaPart(f"10^{{{power}}}", POWER_LEVEL, negative)
    return FormulaPart(rf"{mantissa}\cdot 10^{{{power}}}", PRODUCT_LEVEL, negative)


def named_constant(size: float) -> tuple[Fraction, str] | None:
    r"""(ratio, root), size = ratio * root with root "", "\pi", "\sqrt{2}" or "\sqrt{3}": exact doubles of 15 digits only."""
    if not isfinite(size) or len(repr(size).partition("e")[0].replace(".", "").strip("0")) < 15:
        return None
    for root, factor in (("", 1.0), (r"\pi", pi), (r"\sqrt{2}", sqrt(2)), (r"\sqrt{3}", sqrt(3))):
        ratio = Fraction(size / factor).limit_denominator(12)
        top, bottom = ratio.numerator, ratio.denominator
        if 0 < top < 1000 and size in (top / bottom * factor, top * factor / bottom, factor / bottom * top):
            return ratio, root
    return None


def _word_latex(word: str, italic: bool) -> str:
    if word in _GREEK:
        return rf"\{word}"
    if re.fullmatch(r"[A-Za-z]|\d+", word):
        return word
    if re.fullmatch(r"[A-Za-z0-9]+", word):
        return rf"\mathit{{{word}}}" if italic else rf"\mathrm{{{word}}}"
    return text_latex(word)


def _mantissa(size: float) -> str:
    """The digits of the double's shortest text, a point behind the first one."""
    digits = repr(size).partition("e")[0].replace(".", "").lstrip("0").rstrip("0")
    return f"{digits[0]}.{digits[1:] or '0'}"


def _shorten_decimal(text: str) -> str:
    """A decimal cut after DIGITS significant digits, with dots where something was cut."""
    head, _, tail = text.partition(".")
    if tail in ("", "0"):
        return head
    leading = len(head.lstrip("0")) or -(len(tail) - len(tail.lstrip("0")))
    keep = max(DECIMAL_DIGITS - leading, 1)
    return text if len(tail) <= keep else rf"{head}.{tail[:keep]}\ldots"
