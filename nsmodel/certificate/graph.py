"""A CasADi expression as a straight-line program of few operations, its numbers as exact fractions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import fold_graph

ProgramGraph = dict[str, Any]


class UnsupportedOperation(ValueError):
    """An operation that the programs of certificates do not have."""


def exact_number_text(number: Any) -> str:
    """A number, exactly: "-3/4", "7", "inf"."""
    if isinstance(number, Fraction):
        return str(number)
    return str(Fraction(float(number))) if np.isfinite(float(number)) else "inf" if float(number) > 0 else "-inf"


def exact_matrix_text(entries: Any) -> list[list[str]]:
    """The rows of a matrix of numbers or Fractions."""
    return [[exact_number_text(entry) for entry in row] for row in np.atleast_2d(entries)]


def straight_line_program(expr: ca.SX, inputs: ca.SX, names: Sequence[str]) -> ProgramGraph:
    """The program of the entries of ``expr`` in the symbols ``inputs`` (n, 1), called ``names``.

    Raises:
        NoProgram: an operation without counterpart, or another symbol.
    """
    writer = _ProgramWriter({symbol.element_hash(): k for k, symbol in enumerate(ca.vertsplit(inputs))} if inputs.numel() else {})
    outputs = fold_graph(ca.densify(ca.vec(ca.SX(expr))), writer.symbol, writer.number, writer.apply) if expr.numel() else []
    return {"inputs": list(names), "steps": writer.steps, "outputs": outputs}


class _ProgramWriter:
    """Steps, each written once."""

    def __init__(self, places: dict[int, int]) -> None:
        self.places, self.steps, self.known = places, [], {}
        neg, sub, mul, add, power = self._neg, self._sub, self._mul, self._add, self._pow
        one, two = Fraction(1), Fraction(2)
        self.rules: dict[int, Callable[..., int]] = {
            ca.OP_ASSIGN: lambda u: u,
            ca.OP_NEG: neg,
            ca.OP_ADD: add,
            ca.OP_SUB: sub,
            ca.OP_MUL: mul,
            ca.OP_DIV: lambda u, w: mul(u, power(w, -one)),
            ca.OP_INV: lambda u: power(u, -one),
            ca.OP_SQ: lambda u: power(u, two),
            ca.OP_SQRT: lambda u: power(u, one / 2),
            ca.OP_TWICE: lambda u: mul(self.number(2.0), u),
            ca.OP_FMAX: self._max,
            ca.OP_FMIN: lambda u, w: neg(self._max(neg(u), neg(w))),
            ca.OP_FABS: lambda u: self._max(u, neg(u)),
            ca.OP_HYPOT: lambda u, w: power(add(power(u, two), power(w, two)), one / 2),
            ca.OP_EXP: lambda u: self._append_step("exp", u),
            ca.OP_SIN: lambda u: self._append_step("sin", u),
            ca.OP_COS: lambda u: self._append_step("cos", u),
            ca.OP_EXPM1: lambda u: sub(self._append_step("exp", u), self.number(1.0)),
            ca.OP_TAN: lambda u: mul(self._append_step("sin", u), power(self._append_step("cos", u), -one)),
            ca.OP_TANH: lambda u: self._append_step("tanh", u),
            ca.OP_LOG: lambda u: self._append_step("log", u),
            ca.OP_LOG1P: lambda u: self._append_step("log", add(self.number(1.0), u)),
            ca.OP_ATAN: lambda u: self._append_step("atan", u),
            ca.OP_SINH: lambda u: self._exponential_half_sum(u, sub),
            ca.OP_COSH: lambda u: self._exponential_half_sum(u, add),
            ca.OP_CONSTPOW: self._constant_power,
            ca.OP_POW: self._constant_power,
        }

    def symbol(self, symbol: ca.SX) -> int:
        if symbol.element_hash() not in self.places:
            raise UnsupportedOperation(f"the symbol {symbol} has no value")
        return self._append_step("in", self.places[symbol.element_hash()])

    def number(self, value: float) -> int:
        if not np.isfinite(value):
            raise UnsupportedOperation("an infinite number")
        return self._append_step("const", exact_number_text(value))

    def apply(self, op: int, args: list[int]) -> int:
        if op not in self.rules:
            raise UnsupportedOperation(f"operation {op} of CasADi")
        return self.rules[op](*args)

    def _append_step(self, *step: Any) -> int:
        if step not in self.known:
            self.known[step] = len(self.steps)
            self.steps.append(list(step))
        return self.known[step]

    def _add(self, u: int, w: int) -> int:
        return self._append_step("add", u, w)

    def _mul(self, u: int, w: int) -> int:
        return self._pow(u, Fraction(2)) if u == w else self._append_step("mul", u, w)

    def _neg(self, u: int) -> int:
        return self._mul(self.number(-1.0), u)

    def _sub(self, u: int, w: int) -> int:
        return self._add(u, self._neg(w))

    def _pow(self, u: int, n: Fraction) -> int:
        return self._append_step("pow", u, str(n))

    def _max(self, u: int, w: int) -> int:
        return self._append_step("fmax", u, w)

    def _exponential_half_sum(self, u: int, combine: Callable[[int, int], int]) -> int:
        return self._mul(self.number(0.5), combine(self._append_step("exp", u), self._append_step("exp", self._neg(u))))

    def _constant_power(self, u: int, w: int) -> int:
        kind, number, *_ = self.steps[w]
        if kind != "const":
            raise UnsupportedOperation("a power with a varying exponent")
        return self._pow(u, Fraction(number))
