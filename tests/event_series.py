"""Taylor coefficients of CasADi expressions in decimals: each operation is a recurrence, order by order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal
from functools import lru_cache
from operator import mul
from typing import Any

import casadi as ca

from tests.search.digits import by_mpmath, exact

Series = list[Decimal]
Rule = Callable[[int], Decimal]
ZERO, ONE = Decimal(0), Decimal(1)
STARTS = {name: lru_cache(10000)(by_mpmath(name)) for name in ("sin", "cos", "tanh", "atan")}


def product(a: Series, b: Series) -> Rule:
    return lambda k: sum(map(mul, a[: k + 1], b[k::-1]), ZERO)


def square(a: Series) -> Rule:
    def rule(k: int) -> Decimal:
        half = (k + 1) // 2
        twice = 2 * sum(map(mul, a[:half], a[k - half + 1 : k + 1][::-1]), ZERO)
        return twice if k % 2 else twice + a[half] * a[half]

    return rule


def quotient(a: Series, b: Series, q: Series) -> Rule:
    return lambda k: (a[k] - (sum(map(mul, q[:k], b[1 : k + 1][::-1]), ZERO) if k else 0)) / b[0]


def exponential(a: Series, slope: Series, e: Series) -> Rule:
    """e' = a' e, with ``slope`` k a_k."""
    return lambda k: sum(map(mul, slope[1 : k + 1], e[k - 1 :: -1]), ZERO) / k if k else a[0].exp()


def logarithm(a: Series, v: Series) -> Rule:
    """a v' = a'."""
    return lambda k: (a[k] - convolved(v, a, k)) / a[0] if k else a[0].ln()


def root(a: Series, r: Series) -> Rule:
    """r r = a."""
    return lambda k: (a[k] - sum(map(mul, r[1:k], r[1:k][::-1]), ZERO)) / (2 * r[0]) if k else a[0].sqrt()


def along(a: Series, slope: Series, d: Series, start: str) -> Rule:
    """v' = a' d, with v = start(a) at first."""
    return lambda k: sum(map(mul, slope[1 : k + 1], d[k - 1 :: -1]), ZERO) / k if k else STARTS[start](a[0])


def along_line(a: Series, d: Series, start: str) -> Rule:
    """The same where a' is a number."""
    return lambda k: a[1] * d[k - 1] / k if k else STARTS[start](a[0])


def against(a: Series, q: Series, v: Series) -> Rule:
    """q v' = a', with v = atan(a) at first."""
    return lambda k: (a[k] - convolved(v, q, k)) / q[0] if k else STARTS["atan"](a[0])


def convolved(v: Series, q: Series, k: int) -> Decimal:
    """The sum of j v_j q_{k - j}/k over 0 < j < k."""
    return sum(map(mul, [j * c for j, c in enumerate(v[1:k], 1)], q[1:k][::-1]), ZERO) / k


class Tape:
    """A graph as recurrences: ``run(k)`` appends coefficients of order k to all series, from those of ``inputs``.

    Args:
        inputs, outputs: columns of the graph; its outputs are series or numbers in ``outputs``.
        given: further symbols and their numbers: what depends on them alone is a number, what is multiplied by 0 is left out.
    """

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX], given: Sequence[tuple[ca.SX, Decimal]] = ()) -> None:
        symbols = ca.vertcat(ca.SX(0, 1), *(symbol for symbol, _ in given))
        f = ca.Function("f", [*inputs, symbols], [ca.densify(ca.vec(e)) for e in outputs], {"cse": True})
        self.inputs: list[list[Series]] = [[[] for _ in range(e.numel())] for e in inputs]
        numbers = [number for _, number in given]
        self._parts: list[tuple[Series, Rule, tuple[int, ...]]] = []  # Of each operation its series, rule and arguments.
        self._lines = {id(self.inputs[0][0])} if len(inputs) > 1 else set()  # Of the first input what is affine in it.
        self._slopes: dict[int, Series] = {}  # Of a series k times its coefficients.
        self._waves: dict[int, tuple[Series, Series]] = {}  # The sine and the cosine of a series.
        self.outputs: list[list[Any]] = [[ZERO] * e.numel() for e in outputs]
        work: dict[int, Any] = {}
        for i in range(f.n_instructions()):
            op, source, target = f.instruction_id(i), f.instruction_input(i), f.instruction_output(i)
            if op == ca.OP_INPUT:
                column, row = source
                work[target[0]] = self.inputs[column][row] if column < len(inputs) else numbers[row]
            elif op == ca.OP_CONST:
                work[target[0]] = exact(f.instruction_constant(i))
            elif op == ca.OP_OUTPUT:
                self.outputs[target[0]][target[1]] = work[source[0]]
            else:
                work[target[0]] = self._operation(op, [work[j] for j in source])
        moving = {id(s) for s in self.inputs[-1]}  # What depends on the last input, and what outputs but the first need.
        for series, _, arguments in self._parts:
            if moving.intersection(arguments):
                moving.add(id(series))
        needed = [self._needed(outputs) for outputs in (self.outputs, self.outputs[1:])]
        of = [(s, rule) for s, rule, _ in self._parts]
        self._all = [(s, rule) for s, rule in of if id(s) in needed[0]]
        self._moving = [(s, rule) for s, rule in self._all if id(s) in moving]
        self._rows = [(s, rule) for s, rule in of if id(s) in needed[1]]

    def _needed(self, outputs: list[list[Any]]) -> set[int]:
        found, size = {id(s) for column in outputs for s in column}, -1
        while len(found) > size:
            size = len(found)
            for series, _, arguments in reversed(self._parts):
                if id(series) in found:
                    found.update(arguments)
        return found

    def run(self, k: int, which: str = "all") -> None:
        """Coefficients of order k: of "all", of what depends on the last input ("moving"), or of all that "rows" need."""
        for series, rule in {"all": self._all, "moving": self._moving, "rows": self._rows}[which]:
            series[k:] = [rule(k)]

    def order(self, output: int, k: int) -> Series:
        return [(s[k] if isinstance(s, list) else s if k == 0 else ZERO) for s in self.outputs[output]]

    def _add(self, make: Callable[[Series], Rule], *arguments: Any) -> Series:
        series: Series = []
        self._parts.append((series, make(series), tuple(id(a) for a in arguments if isinstance(a, list))))
        return series

    def _operation(self, op: int, args: list[Any]) -> Any:
        if all(isinstance(a, Decimal) for a in args):
            return self._number(op, args)
        a, b = args[0], args[-1]
        if op in (ca.OP_ADD, ca.OP_SUB):
            sign = ONE if op == ca.OP_ADD else -ONE
            if isinstance(b, Decimal):
                b = sign * b
                return a if b == 0 else self._shifted(b, a)
            if isinstance(a, Decimal):
                return self._shifted(a, self._scaled(sign, b))
            if op == ca.OP_ADD:
                return self._add(lambda _: lambda k: a[k] + b[k], a, b)
            return self._add(lambda _: lambda k: a[k] - b[k], a, b)
        if op == ca.OP_MUL:
            if isinstance(a, Decimal) or isinstance(b, Decimal):
                number, series = (a, b) if isinstance(a, Decimal) else (b, a)
                return self._scaled(number, series)
            return self._square(a) if a is b else self._add(lambda _: product(a, b), a, b)
        if op in (ca.OP_DIV, ca.OP_INV):
            if op == ca.OP_DIV and isinstance(b, Decimal):
                return self._scaled(ONE / b, a)
            a = self._constant(ONE) if op == ca.OP_INV else self._constant(a) if isinstance(a, Decimal) else a
            return self._add(lambda q: quotient(a, b, q), a, b)
        if op in (ca.OP_POW, ca.OP_CONSTPOW):
            return self._power(a, int(b)) if b == int(b) else self._missing(op)
        return self._unary(op, a)

    def _unary(self, op: int, a: Series) -> Series:
        if op == ca.OP_ASSIGN:
            return a
        if op in (ca.OP_NEG, ca.OP_TWICE):
            return self._scaled(-ONE if op == ca.OP_NEG else 2 * ONE, a)
        if op == ca.OP_SQ:
            return self._square(a)
        if op in (ca.OP_EXP, ca.OP_LOG, ca.OP_SQRT):
            slope = self._slope(a) if op == ca.OP_EXP else a
            make = {ca.OP_EXP: lambda v: exponential(a, slope, v), ca.OP_LOG: lambda v: logarithm(a, v)}
            return self._add(make.get(op, lambda v: root(a, v)), a, slope)
        if op in (ca.OP_SIN, ca.OP_COS):
            if id(a) not in self._waves:
                s: Series = []
                c: Series = []
                minus: Series = []
                minus_s = lambda k: -s[k]  # noqa: E731
                if id(a) in self._lines:
                    arguments, rules = (id(a),), (along_line(a, c, "sin"), along_line(a, minus, "cos"), minus_s)
                else:
                    slope = self._slope(a)
                    arguments, rules = (id(a), id(slope)), (along(a, slope, c, "sin"), along(a, slope, minus, "cos"), minus_s)
                arguments += (id(s), id(c), id(minus))
                self._parts += [(v, rule, arguments) for v, rule in zip((s, c, minus), rules, strict=True)]
                self._waves[id(a)] = s, c
            return self._waves[id(a)][op == ca.OP_COS]
        if op == ca.OP_ATAN:
            q = self._shifted(ONE, self._square(a))
            return self._add(lambda v: against(a, q, v), a, q)
        if op == ca.OP_TANH:
            v: Series = []
            q: Series = []
            slope = self._slope(a)
            arguments = (id(a), id(slope), id(v), id(q))
            squares = square(v)
            self._parts += [(v, along(a, slope, q, "tanh"), arguments), (q, lambda k: (k == 0) - squares(k), arguments)]
            return v
        return self._missing(op)

    def _slope(self, a: Series) -> Series:
        if id(a) not in self._slopes:
            self._slopes[id(a)] = self._add(lambda _: lambda k: k * a[k], a)
        return self._slopes[id(a)]

    def _missing(self, op: int) -> Any:
        raise NotImplementedError(f"CasADi operation {op}")

    def _constant(self, value: Decimal) -> Series:
        return self._add(lambda _: lambda k: value if k == 0 else ZERO)

    def _shifted(self, value: Decimal, a: Series) -> Series:
        return self._line(a, self._add(lambda _: lambda k: a[k] + value if k == 0 else a[k], a))

    def _line(self, a: Series, of: Series) -> Series:
        if id(a) in self._lines:
            self._lines.add(id(of))
        return of

    def _scaled(self, number: Decimal, a: Series) -> Any:
        if number == 0:
            return ZERO
        return a if number == 1 else self._line(a, self._add(lambda _: lambda k: number * a[k], a))

    def _square(self, a: Series) -> Series:
        return self._add(lambda _: square(a), a)

    def _power(self, a: Series, n: int) -> Series:
        if n < 1:
            return self._missing(ca.OP_POW)
        half = self._power(a, n // 2) if n > 1 else a
        whole = self._square(half) if n > 1 else a
        if n > 1 and n % 2:
            even = whole
            return self._add(lambda _: product(even, a), even, a)
        return whole

    def _number(self, op: int, args: list[Decimal]) -> Decimal:
        """Of numbers, by the recurrence at order 0."""
        scratch = Tape([ca.SX(0, 1)], [])
        found = scratch._operation(op, [[a] for a in args])
        for series, rule, _ in scratch._parts:
            series[:] = [rule(0)]
        return found[0]
