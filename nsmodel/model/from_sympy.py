"""Expressions of SymPy, which is never imported here, as SX."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.model.symbols import check_declared, entry_names


def _equals(value: ca.SX, number: float) -> bool:
    return value.is_constant() and float(value) == number


def _heaviside(u: ca.SX, at_zero: ca.SX) -> ca.SX:
    """(1 + sign u)/2, so that split_discontinuities sees the jump."""
    step = (1 + ca.sign(u)) / 2
    return step if _equals(at_zero, 0.5) else ca.if_else(u == 0, at_zero, step)


_SYMPY: dict[str, Callable[..., ca.SX]] = {
    "Add": lambda *args: reduce(lambda a, b: a + b, args),
    "Mul": lambda *args: reduce(lambda a, b: a * b, args),
    "Max": lambda *args: reduce(ca.fmax, args),
    "Min": lambda *args: reduce(ca.fmin, args),
    "Pow": lambda base, exponent: ca.sqrt(base) if _equals(exponent, 0.5) else base**exponent,
    "Abs": ca.fabs,
    "Heaviside": _heaviside,
    "ceiling": ca.ceil,
    "LessThan": lambda a, b: a <= b,
    "StrictLessThan": lambda a, b: a < b,
    "GreaterThan": lambda a, b: a >= b,
    "StrictGreaterThan": lambda a, b: a > b,
    "Equality": lambda a, b: a == b,
    "Unequality": lambda a, b: a != b,
    "And": lambda *args: reduce(ca.logic_and, args),
    "Or": lambda *args: reduce(ca.logic_or, args),
    "Not": ca.logic_not,
    "BooleanTrue": lambda: ca.SX(1),
    "BooleanFalse": lambda: ca.SX(0),
    **{
        name: getattr(ca, name)
        for name in "exp log sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh sign floor erf".split()
    },
}


def from_sympy(expr: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    """The expression in the declared symbols."""
    name = type(expr).__name__
    if name in ("Symbol", "Dummy"):
        check_declared([expr.name], symbols, label)
        return symbols[expr.name]
    if name == "MatrixElement":
        matrix, i, j = expr.args
        entries = entry_names(matrix.name, int(matrix.rows * matrix.cols))
        check_declared([entry := entries[int(i + j * matrix.rows)]], symbols, label)
        return symbols[entry]
    if expr.is_Number or getattr(expr, "is_NumberSymbol", False):
        return ca.SX(float(expr))
    if name == "Piecewise":
        return _from_piecewise(expr, symbols, label)
    if name not in _SYMPY:
        raise ModelError(
            f"{label}: '{name}' in {expr} has no CasADi counterpart; write it with elementary functions, "
            "sqrt, Abs, Max, Min, sign or Piecewise, or call .doit() first"
        )
    return _SYMPY[name](*(from_sympy(arg, symbols, label) for arg in expr.args))


def _from_piecewise(expr: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    pieces = [(from_sympy(piece, symbols, label), from_sympy(cond, symbols, label)) for piece, cond in expr.args]
    if not pieces[-1][1].is_one():
        raise ModelError(f"{label}: {expr} has no value where none of its conditions holds; end it with (expression, True)")
    result = pieces[-1][0]
    for piece, condition in reversed(pieces[:-1]):
        result = ca.if_else(condition, piece, result)
    return result
