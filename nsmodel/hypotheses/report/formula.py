"""Expressions as LaTeX: a CasADi graph is gone through once, each node becomes a piece of a formula."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.hypotheses.report.notation import (
    ATOM_LEVEL,
    POWER_LEVEL,
    PRODUCT_LEVEL,
    RELATION_LEVEL,
    SUM_LEVEL,
    FormulaPart,
    bracketed,
    number_formula,
    symbol_latex,
    vector_latex,
)
from nsmodel.proof.expression_graph import fold_graph

T = TypeVar("T")
MAX_FORMULA_SIZE = 250  # Formulas of more nodes are named, not written out.
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
            raise ModelError("the expression calls a Function that cannot be looked into; write it with elementary operations")
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
