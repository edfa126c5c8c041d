"""The operations of CasADi in SymPy, which is imported only where it is used."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.hypotheses.report.notation import named_constant


def sympy_number(value: float) -> Any:
    """The number that the user wrote: the shortest decimal of the double, or a simple multiple of pi, sqrt(2), sqrt(3)."""
    import sympy as sp

    if not np.isfinite(value):
        return sp.nan if np.isnan(value) else sp.oo if value > 0 else -sp.oo
    known = named_constant(abs(value))
    if known is None:
        return sp.Rational(repr(value))
    root = {"": sp.Integer(1), r"\pi": sp.pi, r"\sqrt{2}": sp.sqrt(2), r"\sqrt{3}": sp.sqrt(3)}[known[1]]
    return (1 if value > 0 else -1) * sp.Rational(known[0].numerator, known[0].denominator) * root


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
        ca.OP_CEIL: sp.ceiling, ca.OP_FMOD: lambda a, b: sp.sign(a) * sp.Mod(sp.Abs(a), sp.Abs(b)), ca.OP_FABS: sp.Abs,
        ca.OP_SIGN: sp.sign, ca.OP_COPYSIGN: lambda a, b: sp.Abs(a) * sp.Piecewise((1, b >= 0), (-1, True)), ca.OP_ERF: sp.erf,
        ca.OP_FMIN: sp.Min, ca.OP_FMAX: sp.Max, ca.OP_INV: lambda a: 1 / a, ca.OP_SINH: sp.sinh, ca.OP_COSH: sp.cosh,
        ca.OP_TANH: sp.tanh, ca.OP_ASINH: sp.asinh, ca.OP_ACOSH: sp.acosh, ca.OP_ATANH: sp.atanh, ca.OP_ATAN2: sp.atan2,
        ca.OP_ERFINV: sp.erfinv, ca.OP_LOG1P: lambda a: sp.log(1 + a), ca.OP_EXPM1: lambda a: sp.exp(a) - 1,
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
