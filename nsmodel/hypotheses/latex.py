"""Expressions as LaTeX: a CasADi graph is gone through once, each node becomes a piece of a formula.

Names, numbers and brackets in LaTeX.

The operations of CasADi in SymPy, which is imported only where it is used.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from fractions import Fraction
from math import inf, isfinite, isnan, pi, sqrt
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.proof.expression_graph import fold_graph

DECIMAL_DIGITS = 6  # Of longer decimals, with dots behind: users write fewer, and 0.333333... is told from 0.333.
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
    """A decimal cut after DECIMAL_DIGITS significant digits, with dots where something was cut."""
    head, _, tail = text.partition(".")
    if tail in ("", "0"):
        return head
    leading = len(head.lstrip("0")) or -(len(tail) - len(tail.lstrip("0")))
    keep = max(DECIMAL_DIGITS - leading, 1)
    return text if len(tail) <= keep else rf"{head}.{tail[:keep]}\ldots"


T = TypeVar("T")
# Formulas of more nodes are named, not written out: each node is some characters of a line that a page does not break.
MAX_FORMULA_SIZE = 250
_FUNCTIONS = {
    ca.OP_EXP: r"\exp", ca.OP_LOG: r"\log", ca.OP_SIN: r"\sin", ca.OP_COS: r"\cos", ca.OP_TAN: r"\tan",
    ca.OP_ASIN: r"\arcsin", ca.OP_ACOS: r"\arccos", ca.OP_ATAN: r"\arctan", ca.OP_SINH: r"\sinh", ca.OP_COSH: r"\cosh",
    ca.OP_TANH: r"\tanh", ca.OP_ASINH: r"\mathrm{arsinh}", ca.OP_ACOSH: r"\mathrm{arcosh}", ca.OP_ATANH: r"\mathrm{artanh}",
    ca.OP_ATAN2: r"\mathrm{atan2}", ca.OP_ERF: r"\mathrm{erf}", ca.OP_ERFINV: r"\mathrm{erf}^{-1}", ca.OP_SIGN: r"\mathrm{sign}",
    ca.OP_FMAX: r"\max", ca.OP_FMIN: r"\min", ca.OP_FMOD: r"\mathrm{fmod}", ca.OP_REMAINDER: r"\mathrm{remainder}",
    ca.OP_COPYSIGN: r"\mathrm{copysign}",
}  # fmt: skip
_COMPARISONS = {ca.OP_LT: "<", ca.OP_LE: r"\leq", ca.OP_EQ: "=", ca.OP_NE: r"\neq"}
_NEGATED = {ca.OP_LT: r"\geq", ca.OP_LE: ">", ca.OP_EQ: r"\neq", ca.OP_NE: "="}
_IDENTITIES = (ca.OP_ASSIGN, ca.OP_LIFT, ca.OP_PRINTME)
INPUT, CONST = ca.OP_INPUT, ca.OP_CONST


def translate_expression(
    expr: ca.SX, symbol: Callable[[str], T], number: Callable[[float], T], apply: Callable[[int, list[T]], T]
) -> list[T]:
    """Write the entries of ``expr`` in another language, column by column: a symbol by its name, the rest as in ``fold_graph``.

    Raises:
        ModelError: ``expr`` calls a Function that cannot be looked into.
    """

    def apply_known(op: int, args: list[T]) -> T:
        if op == ca.OP_CALL:
            raise ModelError("the expression calls a Function whose code cannot be read; write it with elementary operations")
        return args[0] if op in _IDENTITIES else apply(op, args)

    return fold_graph(expr, lambda node: symbol(node.name()), number, apply_known)


@dataclass(frozen=True)
class SymbolNames:
    """How symbols are written: {symbol: LaTeX} where not by their own name, and {stem: its n symbols} of the vectors."""

    latex: Mapping[str, str]
    vectors: Mapping[str, Sequence[str]]


def formulas(expr: ca.SX, names: SymbolNames) -> list[str]:
    """LaTeX of each entry, column by column; formulas too long to be read are given by their number of operations."""

    def symbol(name: str) -> FormulaPart:
        return FormulaPart(names.latex.get(name) or symbol_latex(name), ATOM_LEVEL, op=INPUT, name=name)

    def apply(op: int, args: list[FormulaPart]) -> FormulaPart:
        size = 1 + sum(arg.size for arg in args)
        if size > MAX_FORMULA_SIZE:
            return FormulaPart(rf"\left[\text{{{size} operations}}\right]", ATOM_LEVEL, op=INPUT, size=size)
        return replace(_format_operation(op, args, names), op=op, args=tuple(args), size=size)

    return [piece.text for piece in translate_expression(expr, symbol, number_formula, apply)]


# -- the operations ----------------------------------------------------------------------------------------------------


def _format_operation(op: int, args: list[FormulaPart], names: SymbolNames) -> FormulaPart:
    if op in (ca.OP_ADD, ca.OP_SUB):
        return _format_sum(args[0], args[1], op == ca.OP_SUB)
    if op in (ca.OP_MUL, ca.OP_TWICE):
        return _format_product(*((number_formula(2.0), args[0]) if op == ca.OP_TWICE else args))
    if op in (ca.OP_DIV, ca.OP_INV):
        a, b = args if op == ca.OP_DIV else (number_formula(1.0), args[0])
        return FormulaPart(rf"\frac{{{a.body}}}{{{b.body}}}", PRODUCT_LEVEL, a.negative != b.negative)
    if op == ca.OP_NEG:
        return (
            FormulaPart(args[0].factor(), PRODUCT_LEVEL, not args[0].negative)
            if not args[0].negative
            else replace(args[0], negative=False)
        )
    if op in (ca.OP_SQ, ca.OP_POW, ca.OP_CONSTPOW):
        return _format_power(args[0], number_formula(2.0) if op == ca.OP_SQ else args[1])
    if op in (ca.OP_SQRT, ca.OP_HYPOT):
        squares = _squared_entries(args[0]) if op == ca.OP_SQRT else args
        if squares is None:
            return FormulaPart(rf"\sqrt{{{args[0].text}}}", ATOM_LEVEL)
        return FormulaPart(rf"\left\Vert {_format_vector(squares, names)} \right\Vert", ATOM_LEVEL)
    return _format_function(op, args)


def _format_function(op: int, args: list[FormulaPart]) -> FormulaPart:
    if op == ca.OP_FABS:
        return FormulaPart(rf"\left|{args[0].body}\right|", ATOM_LEVEL)
    if op in (ca.OP_FMAX, ca.OP_FMIN):
        flat = [part for arg in args for part in (arg.args if arg.op == op and not arg.negative else (arg,))]
        return FormulaPart(_FUNCTIONS[op] + bracketed(r",\ ".join(part.text for part in flat)), POWER_LEVEL)
    if op in (ca.OP_FLOOR, ca.OP_CEIL):
        side = "floor" if op == ca.OP_FLOOR else "ceil"
        return FormulaPart(rf"\left\l{side} {args[0].text} \right\r{side}", ATOM_LEVEL)
    if op in (ca.OP_LOG1P, ca.OP_EXPM1):
        if op == ca.OP_LOG1P:
            return FormulaPart(r"\log" + bracketed(_format_sum(number_formula(1.0), args[0], False).text), POWER_LEVEL)
        return FormulaPart(rf"\exp{bracketed(args[0].text)} - 1", SUM_LEVEL)
    if op in _COMPARISONS or op in (ca.OP_NOT, ca.OP_AND, ca.OP_OR):
        return FormulaPart(_format_condition(op, args), RELATION_LEVEL)
    if op == ca.OP_IF_ELSE_ZERO:
        return FormulaPart(_format_cases([(args[1].text, args[0].text), ("0", "")]), ATOM_LEVEL)
    if op in _FUNCTIONS:
        return FormulaPart(_FUNCTIONS[op] + bracketed(r",\ ".join(arg.text for arg in args)), POWER_LEVEL)
    return FormulaPart(r"\mathrm{op}" + f"_{{{op}}}" + bracketed(r",\ ".join(arg.text for arg in args)), POWER_LEVEL)


def _format_sum(a: FormulaPart, b: FormulaPart, minus: bool) -> FormulaPart:
    if not minus and (merged := _merge_if_else(a, b)) is not None:
        return merged
    minus = minus != b.negative
    if a.negative and not minus:
        a, b, minus = replace(b, negative=False), replace(a, negative=False), True
    left = bracketed(a.text) if a.level < SUM_LEVEL else a.text
    if b.level == SUM_LEVEL and not minus:  # a + (-b + c) is a - b + c
        return FormulaPart(f"{left} - {b.body[1:]}" if b.body.startswith("-") else f"{left} + {b.body}", SUM_LEVEL)
    return FormulaPart(f"{left} {'-' if minus else '+'} {b.factor()}", SUM_LEVEL)


def _format_product(a: FormulaPart, b: FormulaPart) -> FormulaPart:
    if b.op == CONST and a.op != CONST:
        a, b = b, a
    (base, m), (other, n) = _split_power(a), _split_power(b)
    if base == other and a.op != CONST:
        return FormulaPart(f"{base}^{{{m + n}}}", POWER_LEVEL, a.negative != b.negative)
    left, right = a.factor(), b.factor()
    sign = r" \cdot " if right[0].isdigit() or (right.startswith(r"\frac{1") and a.op == CONST) else r"\,"
    return FormulaPart(f"{left}{sign}{right}", PRODUCT_LEVEL, a.negative != b.negative)


def _format_power(base: FormulaPart, exponent: FormulaPart) -> FormulaPart:
    root, n = _split_power(base)
    if n > 1 and exponent.text.isdigit():  # x * x^2 and (x^2)^2 are how the graph holds x^3 and x^4.
        return FormulaPart(f"{root}^{{{n * int(exponent.text)}}}", POWER_LEVEL)
    return FormulaPart(f"{base.at(ATOM_LEVEL)}^{{{exponent.text}}}", POWER_LEVEL)


def _split_power(piece: FormulaPart) -> tuple[str, int]:
    """(base, n) of a power base^n with a whole number n; n = 1 of anything else."""
    found = re.fullmatch(r"(.*)\^\{(\d+)\}", piece.body) if piece.level == POWER_LEVEL else None
    return (found[1], int(found[2])) if found else (piece.factor(), 1)


def _squared_entries(piece: FormulaPart) -> list[FormulaPart] | None:
    """The entries u_i where a piece is a sum of squares u_i^2."""
    if piece.negative:
        return None
    if piece.op == ca.OP_SQ:
        return list(piece.args)
    if piece.op != ca.OP_ADD:
        return None
    left, right = (_squared_entries(arg) for arg in piece.args)
    return None if left is None or right is None else left + right


def _format_vector(entries: Sequence[FormulaPart], names: SymbolNames) -> str:
    """The vector with these entries: q - (1, 2) where they are those of a whole vector q, else one by one."""
    heads = [piece.args[0] if piece.op == ca.OP_SUB and piece.args else piece for piece in entries]
    for stem, symbols in names.vectors.items():
        if len(entries) > 1 and [head.name for head in heads] == list(symbols):
            rest = [piece.args[1].text if piece is not head else "0" for piece, head in zip(entries, heads, strict=True)]
            away = "" if set(rest) == {"0"} else f" - {vector_latex(rest)}"
            return symbol_latex(stem) + away
    return vector_latex([piece.text for piece in entries])


# -- conditions --------------------------------------------------------------------------------------------------------


def _format_condition(op: int, args: Sequence[FormulaPart]) -> str:
    if op in _COMPARISONS:
        return f"{args[0].text} {_COMPARISONS[op]} {args[1].text}"
    if op == ca.OP_NOT:
        inner = args[0]
        if inner.op in _NEGATED:
            return f"{inner.args[0].text} {_NEGATED[inner.op]} {inner.args[1].text}"
        return rf"\neg {bracketed(inner.text)}"
    joint = r"\ \wedge\ " if op == ca.OP_AND else r"\ \vee\ "
    return joint.join(bracketed(arg.text) if arg.op in (ca.OP_AND, ca.OP_OR) and arg.op != op else arg.text for arg in args)


def _merge_if_else(a: FormulaPart, b: FormulaPart) -> FormulaPart | None:
    """The two halves of an if_else put together, where a + b is one."""
    if a.op != ca.OP_IF_ELSE_ZERO or b.op != ca.OP_IF_ELSE_ZERO or not (a.args and b.args) or a.negative or b.negative:
        return None
    first, second = a.args[0], b.args[0]
    if second.op != ca.OP_NOT or second.args[0] is not first:
        return None
    condition = first.text if first.op in (*_COMPARISONS, ca.OP_NOT, ca.OP_AND, ca.OP_OR) else rf"{first.text} \neq 0"
    return FormulaPart(_format_cases([(a.args[1].text, condition), (b.args[1].text, "")]), ATOM_LEVEL)


def _format_cases(rows: Sequence[tuple[str, str]]) -> str:
    lines = [
        rf"{value} & \text{{where }} {condition}" if condition else rf"{value} & \text{{elsewhere}}" for value, condition in rows
    ]
    return r"\begin{cases} " + r" \\ ".join(lines) + r" \end{cases}"


def sympy_number(value: float) -> Any:
    """The number that the user wrote: the shortest decimal of the double, or a simple multiple of pi, sqrt(2), sqrt(3)."""
    import sympy as sp

    if not np.isfinite(value):
        return sp.nan if np.isnan(value) else sp.oo if value > 0 else -sp.oo
    known = named_constant(abs(value))
    if known is None:
        return sp.Rational(repr(value))
    root: Any = {"": sp.Integer(1), r"\pi": sp.pi, r"\sqrt{2}": sp.sqrt(2), r"\sqrt{3}": sp.sqrt(3)}[known[1]]
    return (1 if value > 0 else -1) * sp.Rational(known[0].numerator, known[0].denominator) * root  # pyrefly: ignore[unsupported-operation]


def condition_as_number(a: Any) -> Any:
    """A condition as a number: 1 where it holds."""
    import sympy as sp

    return a if isinstance(a, sp.Expr) else sp.Piecewise((1, a), (0, True))


def make_sympy_apply() -> Any:
    """apply(op, args) for :func:`.formula.written`; a condition used as a number counts 1 where it holds, a number != 0 holds."""
    import sympy as sp

    def holds(a: Any) -> Any:
        return sp.Ne(a, 0) if isinstance(a, sp.Expr) else a

    def add(a: Any, b: Any) -> Any:
        halves = [isinstance(part, sp.Piecewise) and len(part.args) == 2 and part.args[1] == (0, True) for part in (a, b)]
        if all(halves) and sp.Not(a.args[0][1]) == b.args[0][1]:
            return sp.Piecewise(a.args[0], (b.args[0][0], True))
        return a + b

    numbers = {
        ca.OP_ADD: add, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b, ca.OP_DIV: lambda a, b: a / b,
        ca.OP_NEG: lambda a: -a, ca.OP_EXP: sp.exp, ca.OP_LOG: sp.log, ca.OP_POW: sp.Pow, ca.OP_CONSTPOW: sp.Pow,
        ca.OP_SQRT: sp.sqrt, ca.OP_SQ: lambda a: a**2, ca.OP_TWICE: lambda a: 2 * a, ca.OP_SIN: sp.sin, ca.OP_COS: sp.cos,
        ca.OP_TAN: sp.tan, ca.OP_ASIN: sp.asin, ca.OP_ACOS: sp.acos, ca.OP_ATAN: sp.atan, ca.OP_FLOOR: sp.floor,
        ca.OP_CEIL: sp.ceiling, ca.OP_FMOD: lambda a, b: sp.Mul(sp.sign(a), sp.Mod(sp.Abs(a), sp.Abs(b))), ca.OP_FABS: sp.Abs,
        ca.OP_SIGN: sp.sign, ca.OP_COPYSIGN: lambda a, b: sp.Abs(a) * sp.Piecewise((1, b >= 0), (-1, True)), ca.OP_ERF: sp.erf,  # pyrefly: ignore[unsupported-operation]
        ca.OP_FMIN: sp.Min, ca.OP_FMAX: sp.Max, ca.OP_INV: lambda a: 1 / a, ca.OP_SINH: sp.sinh, ca.OP_COSH: sp.cosh,
        ca.OP_TANH: sp.tanh, ca.OP_ASINH: sp.asinh, ca.OP_ACOSH: sp.acosh, ca.OP_ATANH: sp.atanh, ca.OP_ATAN2: sp.atan2,
        ca.OP_ERFINV: sp.erfinv, ca.OP_LOG1P: lambda a: sp.log(1 + a), ca.OP_EXPM1: lambda a: sp.exp(a) - 1,  # pyrefly: ignore[unsupported-operation]
        ca.OP_HYPOT: lambda a, b: sp.sqrt(a**2 + b**2), ca.OP_LT: sp.Lt, ca.OP_LE: sp.Le, ca.OP_EQ: sp.Eq, ca.OP_NE: sp.Ne,
    }  # fmt: skip
    conditions = {ca.OP_NOT: sp.Not, ca.OP_AND: sp.And, ca.OP_OR: sp.Or}

    def apply(op: int, args: list[Any]) -> Any:
        if op in conditions:
            return conditions[op](*map(holds, args))
        if op == ca.OP_IF_ELSE_ZERO:
            return sp.Piecewise((condition_as_number(args[1]), holds(args[0])), (0, True))
        if op not in numbers:
            raise ModelError(f"operation {op} of CasADi has no counterpart in SymPy; write it with elementary operations")
        return numbers[op](*map(condition_as_number, args))

    return apply
