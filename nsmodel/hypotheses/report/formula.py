"""Expressions as LaTeX: a CasADi graph is gone through once, each node becomes a piece of a formula."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.hypotheses.report.notation import (
    ATOM,
    POWER,
    PRODUCT,
    RELATION,
    SUM,
    FormulaPart,
    bracketed,
    listed,
    number_piece,
    symbol_latex,
)
from nsmodel.proof.graph import fold

T = TypeVar("T")
LARGEST = 250  # Formulas of more nodes are named, not written out.
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


def written(expr: ca.SX, symbol: Callable[[str], T], number: Callable[[float], T], apply: Callable[[int, list[T]], T]) -> list[T]:
    """Write the entries of ``expr`` in another language, column by column: a symbol by its name, the rest as in ``fold``.

    Raises:
        ModelError: ``expr`` calls a Function that cannot be looked into.
    """

    def apply_known(op: int, args: list[T]) -> T:
        if op == ca.OP_CALL:
            raise ModelError("the expression calls a Function that cannot be looked into; write it with elementary operations")
        return args[0] if op in _IDENTITIES else apply(op, args)

    return fold(expr, lambda node: symbol(node.name()), number, apply_known)


@dataclass(frozen=True)
class Names:
    """How symbols are written: {symbol: LaTeX} where not by their own name, and {stem: its n symbols} of the vectors."""

    shown: Mapping[str, str]
    vectors: Mapping[str, Sequence[str]]


def formulas(expr: ca.SX, names: Names) -> list[str]:
    """LaTeX of each entry, column by column; formulas too long to be read are given by their number of operations."""

    def symbol(name: str) -> FormulaPart:
        return FormulaPart(names.shown.get(name) or symbol_latex(name), ATOM, op=INPUT, name=name)

    def apply(op: int, args: list[FormulaPart]) -> FormulaPart:
        size = 1 + sum(arg.size for arg in args)
        if size > LARGEST:
            return FormulaPart(rf"\left[\text{{{size} operations}}\right]", ATOM, op=INPUT, size=size)
        return replace(_applied(op, args, names), op=op, args=tuple(args), size=size)

    return [piece.text for piece in written(expr, symbol, number_piece, apply)]


# -- the operations ----------------------------------------------------------------------------------------------------


def _applied(op: int, args: list[FormulaPart], names: Names) -> FormulaPart:
    if op in (ca.OP_ADD, ca.OP_SUB):
        return _sum(args[0], args[1], op == ca.OP_SUB)
    if op in (ca.OP_MUL, ca.OP_TWICE):
        return _product(*((number_piece(2.0), args[0]) if op == ca.OP_TWICE else args))
    if op in (ca.OP_DIV, ca.OP_INV):
        a, b = args if op == ca.OP_DIV else (number_piece(1.0), args[0])
        return FormulaPart(rf"\frac{{{a.body}}}{{{b.body}}}", PRODUCT, a.negative != b.negative)
    if op == ca.OP_NEG:
        return (
            FormulaPart(args[0].factor(), PRODUCT, not args[0].negative)
            if not args[0].negative
            else replace(args[0], negative=False)
        )
    if op in (ca.OP_SQ, ca.OP_POW, ca.OP_CONSTPOW):
        return _power(args[0], number_piece(2.0) if op == ca.OP_SQ else args[1])
    if op in (ca.OP_SQRT, ca.OP_HYPOT):
        squares = _squares(args[0]) if op == ca.OP_SQRT else args
        if squares is None:
            return FormulaPart(rf"\sqrt{{{args[0].text}}}", ATOM)
        return FormulaPart(rf"\left\Vert {_vector(squares, names)} \right\Vert", ATOM)
    return _special(op, args)


def _special(op: int, args: list[FormulaPart]) -> FormulaPart:
    if op == ca.OP_FABS:
        return FormulaPart(rf"\left|{args[0].body}\right|", ATOM)
    if op in (ca.OP_FMAX, ca.OP_FMIN):
        flat = [part for arg in args for part in (arg.args if arg.op == op and not arg.negative else (arg,))]
        return FormulaPart(_FUNCTIONS[op] + bracketed(r",\ ".join(part.text for part in flat)), POWER)
    if op in (ca.OP_FLOOR, ca.OP_CEIL):
        side = "floor" if op == ca.OP_FLOOR else "ceil"
        return FormulaPart(rf"\left\l{side} {args[0].text} \right\r{side}", ATOM)
    if op in (ca.OP_LOG1P, ca.OP_EXPM1):
        if op == ca.OP_LOG1P:
            return FormulaPart(r"\log" + bracketed(_sum(number_piece(1.0), args[0], False).text), POWER)
        return FormulaPart(rf"\exp{bracketed(args[0].text)} - 1", SUM)
    if op in _COMPARISONS or op in (ca.OP_NOT, ca.OP_AND, ca.OP_OR):
        return FormulaPart(_condition(op, args), RELATION)
    if op == ca.OP_IF_ELSE_ZERO:
        return FormulaPart(_cases([(args[1].text, args[0].text), ("0", "")]), ATOM)
    if op in _FUNCTIONS:
        return FormulaPart(_FUNCTIONS[op] + bracketed(r",\ ".join(arg.text for arg in args)), POWER)
    return FormulaPart(r"\mathrm{op}" + f"_{{{op}}}" + bracketed(r",\ ".join(arg.text for arg in args)), POWER)


def _sum(a: FormulaPart, b: FormulaPart, minus: bool) -> FormulaPart:
    if not minus and (merged := _branches(a, b)) is not None:
        return merged
    minus = minus != b.negative
    if a.negative and not minus:
        a, b, minus = replace(b, negative=False), replace(a, negative=False), True
    left = bracketed(a.text) if a.level < SUM else a.text
    if b.level == SUM and not minus:  # a + (-b + c) is a - b + c
        return FormulaPart(f"{left} - {b.body[1:]}" if b.body.startswith("-") else f"{left} + {b.body}", SUM)
    return FormulaPart(f"{left} {'-' if minus else '+'} {b.factor()}", SUM)


def _product(a: FormulaPart, b: FormulaPart) -> FormulaPart:
    if b.op == CONST and a.op != CONST:
        a, b = b, a
    (base, m), (other, n) = _base(a), _base(b)
    if base == other and a.op != CONST:
        return FormulaPart(f"{base}^{{{m + n}}}", POWER, a.negative != b.negative)
    left, right = a.factor(), b.factor()
    sign = r" \cdot " if right[0].isdigit() or (right.startswith(r"\frac{1") and a.op == CONST) else r"\,"
    return FormulaPart(f"{left}{sign}{right}", PRODUCT, a.negative != b.negative)


def _power(base: FormulaPart, exponent: FormulaPart) -> FormulaPart:
    root, n = _base(base)
    if n > 1 and exponent.text.isdigit():  # x * x^2 and (x^2)^2 are how the graph holds x^3 and x^4.
        return FormulaPart(f"{root}^{{{n * int(exponent.text)}}}", POWER)
    return FormulaPart(f"{base.at(ATOM)}^{{{exponent.text}}}", POWER)


def _base(piece: FormulaPart) -> tuple[str, int]:
    """(base, n) of a power base^n with a whole number n; n = 1 of anything else."""
    found = re.fullmatch(r"(.*)\^\{(\d+)\}", piece.body) if piece.level == POWER else None
    return (found[1], int(found[2])) if found else (piece.factor(), 1)


def _squares(piece: FormulaPart) -> list[FormulaPart] | None:
    """The entries u_i where a piece is a sum of squares u_i^2."""
    if piece.negative:
        return None
    if piece.op == ca.OP_SQ:
        return list(piece.args)
    if piece.op != ca.OP_ADD:
        return None
    left, right = (_squares(arg) for arg in piece.args)
    return None if left is None or right is None else left + right


def _vector(entries: Sequence[FormulaPart], names: Names) -> str:
    """The vector with these entries: q - (1, 2) where they are those of a whole vector q, else one by one."""
    heads = [piece.args[0] if piece.op == ca.OP_SUB and piece.args else piece for piece in entries]
    for stem, symbols in names.vectors.items():
        if len(entries) > 1 and [head.name for head in heads] == list(symbols):
            rest = [piece.args[1].text if piece is not head else "0" for piece, head in zip(entries, heads, strict=True)]
            away = "" if set(rest) == {"0"} else f" - {listed(rest)}"
            return symbol_latex(stem) + away
    return listed([piece.text for piece in entries])


# -- conditions --------------------------------------------------------------------------------------------------------


def _condition(op: int, args: Sequence[FormulaPart]) -> str:
    if op in _COMPARISONS:
        return f"{args[0].text} {_COMPARISONS[op]} {args[1].text}"
    if op == ca.OP_NOT:
        inner = args[0]
        if inner.op in _NEGATED:
            return f"{inner.args[0].text} {_NEGATED[inner.op]} {inner.args[1].text}"
        return rf"\neg {bracketed(inner.text)}"
    joint = r"\ \wedge\ " if op == ca.OP_AND else r"\ \vee\ "
    return joint.join(bracketed(arg.text) if arg.op in (ca.OP_AND, ca.OP_OR) and arg.op != op else arg.text for arg in args)


def _branches(a: FormulaPart, b: FormulaPart) -> FormulaPart | None:
    """The two halves of an if_else put together, where a + b is one."""
    if a.op != ca.OP_IF_ELSE_ZERO or b.op != ca.OP_IF_ELSE_ZERO or not (a.args and b.args) or a.negative or b.negative:
        return None
    first, second = a.args[0], b.args[0]
    if second.op != ca.OP_NOT or second.args[0] is not first:
        return None
    condition = first.text if first.op in (*_COMPARISONS, ca.OP_NOT, ca.OP_AND, ca.OP_OR) else rf"{first.text} \neq 0"
    return FormulaPart(_cases([(a.args[1].text, condition), (b.args[1].text, "")]), ATOM)


def _cases(rows: Sequence[tuple[str, str]]) -> str:
    lines = [
        rf"{value} & \text{{where }} {condition}" if condition else rf"{value} & \text{{elsewhere}}" for value, condition in rows
    ]
    return r"\begin{cases} " + r" \\ ".join(lines) + r" \end{cases}"
