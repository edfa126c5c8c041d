"""The graph of an expression as recurrences of Taylor coefficients: read by `expansion`, printed as C by `codegen.recurrences`.

Operations that are not analytic (fabs, fmax, sign, if_else, floor, ...) are analytic on each side of a switch: a `Branch` says
on which side a piece is by its ``choice``, and what it watches stays >= 0 as long as that holds.

Recurrences of Taylor coefficients: order k of an operation from orders 0, ..., k of what it is applied to.

A row holds the coefficients c_0, c_1, ... of one scalar function of time about the start of a piece. The recurrences are those
of automatic differentiation (Jorba and Zou, Experimental Mathematics 14, 2005, Proposition 2.1): with D = t d/dt, (D c)_k = k
c_k, a differential equation of the function, such as D exp(u) = exp(u) D u, gives c_k by a convolution. The same stand in
`series.c`. A composed operation is written with these (asin: a square, a root, D y = D a / root), its value at order 0 by the
function itself; a branch that is not taken may be no number. Each operation that the C printer knows has its line in
UNARY_RECURRENCES or BINARY_RECURRENCES.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import mul
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.proof.expression_graph import OpaqueExpression, apply_operation, fold_graph, operation_codes

SeriesRow = list[float]
TWO_OVER_ROOT_PI = 2 / math.sqrt(math.pi)  # The slope of erf at 0.


def product(a: SeriesRow, b: SeriesRow, k: int) -> float:
    """Coefficient k of the product of two series."""
    return sum_in_order(map(mul, a[: k + 1], b[k::-1]))


def square(a: SeriesRow, k: int) -> float:
    """Coefficient k of the square of a series."""
    return sum_in_order(map(mul, a[: k + 1], a[k::-1]))


def quotient(y: SeriesRow, a: SeriesRow, b: SeriesRow, k: int) -> float:
    """y = a / b, from y b = a."""
    return (a[k] - sum_in_order(map(mul, y[:k], b[k:0:-1]))) / b[0]


def _quotient_or_zero(above: float, below: float) -> float:
    """A quotient of rows; 0 over 0 is 0: what is 0 throughout stays so. Of symbols and intervals it is any other."""
    return 0.0 if isinstance(above, float) and above == 0 and isinstance(below, float) and below == 0 else above / below


def root(y: SeriesRow, a: SeriesRow, k: int) -> float:
    """y = sqrt(a), from y^2 = a; y_0 is given."""
    above = a[k] - sum_in_order(map(mul, y[1:k], y[k - 1 : 0 : -1]))
    return _quotient_or_zero(above, 2 * y[0])


def power(y: SeriesRow, a: SeriesRow, p: float, k: int) -> float:
    """y = a^p, from a D y = p y D a; y_0 is given."""
    if all(isinstance(v, float) and v == 0 for v in a[: k + 1]) and p > 0:
        return 0.0
    return sum_in_order((p * (k - j) - j) * a[k - j] * y[j] for j in range(k)) / (k * a[0])


def along(factor: SeriesRow, a: SeriesRow, k: int) -> float:
    """D y = factor D a: exp, sin and cos, sinh and cosh, tan, tanh, erf with their own factors; y_0 is given.

    A factor that is 0 in doubles (exp(-1/u) near u = 0) makes 0 of what overflows.
    """
    if k > 1 and not a[2] and not any(a[3 : k + 1]):  # a is linear in time
        total = a[1] * factor[k - 1]
    else:
        total = sum_in_order(map(mul, map(mul, range(1, k + 1), a[1 : k + 1]), factor[k - 1 :: -1]))
    if isinstance(total, float) and total != total:
        total = sum_in_order(j * a[j] * factor[k - j] for j in range(1, k + 1) if factor[k - j])
    return total / k


def against(y: SeriesRow, divisor: SeriesRow, sign: float, a: SeriesRow, k: int) -> float:
    """divisor D y = sign D a: log and the inverse functions; y_0 is given."""
    above = sign * a[k] - sum_in_order(j * y[j] * divisor[k - j] for j in range(1, k)) / k
    return _quotient_or_zero(above, divisor[0])


def angle(y: SeriesRow, a: SeriesRow, b: SeriesRow, size: SeriesRow, k: int) -> float:
    """y = atan2(a, b), from (a^2 + b^2) D y = b D a - a D b; ``size`` is a^2 + b^2, y_0 is given."""
    rotation = sum_in_order(j * (a[j] * b[k - j] - b[j] * a[k - j]) for j in range(1, k + 1))
    return (rotation - sum_in_order(j * y[j] * size[k - j] for j in range(1, k))) / k / size[0]


def divided(a: float, b: float) -> float:
    """a / b, infinite where b = 0 alone."""
    try:
        return a / b
    except ZeroDivisionError:
        return math.copysign(math.inf, a) * math.copysign(1.0, b) if a else math.nan


def _nan_outside_domain(function: Callable[..., float]) -> Callable[..., float]:
    """The function, NaN where it has no value: in a branch that is not taken that is no harm."""

    def evaluate(*args: float) -> float:
        try:
            return function(*args)
        except (ValueError, OverflowError, ZeroDivisionError):
            return math.nan

    return evaluate


RECURRENCES: dict[str, Callable[..., float]] = {
    **{f.__name__: f for f in (product, square, along)},
    **{f.__name__: _nan_outside_domain(f) for f in (divided, quotient, root, power, against, angle)},
}
# What a function is at order 0.
ORDER_0_FUNCTIONS: dict[str, Callable[..., float]] = {
    name: _nan_outside_domain(getattr(math, name))
    for name in "acos acosh asin asinh atan atan2 atanh cos cosh erf exp expm1 hypot log log1p pow sin sinh sqrt tan tanh".split()
}


SMALLEST_DOUBLE = math.ulp(0.0)  # The least positive double.
INTEGER_POWERS = 16  # Larger whole exponents are powers of a base that is not 0: up to here they are products, six at most.


class Recurrence(NamedTuple):
    """Row ``y`` by a recurrence of rows ``args``: a function of `series`, or one of those in `expansion`.

    ``start`` is the function that gives order 0, of the rows ``of``; none where the recurrence gives that too.
    """

    kind: str
    y: int
    args: tuple[int, ...]
    number: float = 1.0
    start: str = ""
    of: tuple[int, ...] = ()
    branch: int = -1


class Branch(NamedTuple):
    """A switch: how its side is chosen (see `printed.PYTHON`), and the row that it looks at."""

    kind: str
    row: int


@dataclass(frozen=True)
class TaylorRecurrences:
    """Recurrences of an expression.

    Attributes:
        count: rows in all.
        inputs: {(which input, its entry): row} of the entries that occur.
        numbers: {row: number} of rows that are constant.
        lines: in the order in which they are computed.
        branches: the switches that occur.
        outputs: the row of each entry of the expression, column by column.
    """

    count: int
    inputs: dict[tuple[int, int], int]
    numbers: dict[int, float]
    lines: tuple[Recurrence, ...]
    branches: tuple[Branch, ...]
    outputs: tuple[int, ...]


def independent_branches(recurrences: TaylorRecurrences) -> list[bool]:
    """Of each branch whether what it looks at is the same on all sides of the others, and moves with no l."""
    moved = {row for (which, _), row in recurrences.inputs.items() if which == 2}
    for line in recurrences.lines:
        if line.branch >= 0 or any(row in moved for row in (*line.args, *line.of)):
            moved.add(line.y)
    return [branch.row not in moved for branch in recurrences.branches]


def taylor_decompose(expr: ca.SX, inputs: Sequence[ca.SX], label: str, *, rounded: bool = True) -> TaylorRecurrences:
    """Return the recurrences of an expression in the entries of ``inputs``; ``rounded``: operations on numbers become numbers.

    Raises:
        OpaqueExpression: it calls a Function that cannot be looked into, or holds an operation without a recurrence; ``label``
            is its name.
    """
    place = {
        s.element_hash(): (which, i) for which, given in enumerate(inputs) for i, s in enumerate(ca.vertsplit(ca.vec(given)))
    }
    tape = _RecurrenceTape(label, rounded)
    outputs = fold_graph(ca.cse(ca.SX(expr)), lambda s: tape.input(*place[s.element_hash()]), tape.constant, tape.operation)
    return TaylorRecurrences(tape.count, tape.inputs, tape.numbers, tuple(tape.lines), tuple(tape.branches), tuple(outputs))


class _RecurrenceTape:
    """Rows as they are written down."""

    def __init__(self, label: str, rounded: bool) -> None:
        self.label, self.rounded, self.count = label, rounded, 0
        self.inputs: dict[tuple[int, int], int] = {}
        self.numbers: dict[int, float] = {}
        self.lines: list[Recurrence] = []
        self.branches: list[Branch] = []
        self._known: dict[float, int] = {}
        self._truths: set[int] = set()
        self._pairs: dict[tuple[str, int], tuple[int, int]] = {}

    def input(self, which: int, entry: int) -> int:
        if (which, entry) not in self.inputs:
            self.inputs[which, entry] = self._new_row()
        return self.inputs[which, entry]

    def constant(self, value: float) -> int:
        if value not in self._known:
            self._known[value] = self._new_row()
            self.numbers[self._known[value]] = float(value)
        return self._known[value]

    def operation(self, op: int, args: list[int]) -> int:
        if op == ca.OP_ASSIGN:
            return args[0]
        if op == ca.OP_CALL or (op not in UNARY_RECURRENCES and op not in BINARY_RECURRENCES):
            name = next((name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == op), str(op))
            raise OpaqueExpression(
                f"{self.label} holds {name.removeprefix('OP_').lower()}, which has no known Taylor series at this point"
            )
        if self.rounded and all(row in self.numbers for row in args):
            return self.constant(float(apply_operation(op, [ca.SX(self.numbers[row]) for row in args])))
        return UNARY_RECURRENCES[op](self, *args) if op in UNARY_RECURRENCES else BINARY_RECURRENCES[op](self, *args)

    def _new_row(self) -> int:
        self.count += 1
        return self.count - 1

    def line(
        self, kind: str, *args: int, number: float = 1.0, start: str = "", of: tuple[int, ...] = (), branch: int = -1
    ) -> int:
        """A new row by a recurrence; -1 among ``args`` stands for the row itself."""
        y = self._new_row()
        self.lines.append(Recurrence(kind, y, tuple(y if row < 0 else row for row in args), number, start, of, branch))
        return y

    def sum(self, a: int, b: int) -> int:
        for one, other in ((a, b), (b, a)):
            if one in self.numbers:
                return self.line("shifted", other, number=self.numbers[one])
        return self.line("sum", a, b)

    def difference(self, a: int, b: int) -> int:
        if b in self.numbers:
            return self.line("shifted", a, number=-self.numbers[b])
        return self.sum(self.minus(b), a) if a in self.numbers else self.line("difference", a, b)

    def minus(self, a: int) -> int:
        return self.line("minus", a)

    def product(self, a: int, b: int) -> int:
        for one, other in ((a, b), (b, a)):
            if one in self.numbers:
                return self.scaled(other, self.numbers[one])
        return self.square(a) if a == b else self.line("product", a, b)

    def scaled(self, a: int, number: float) -> int:
        return self.line("scaled", a, number=number)

    def square(self, a: int) -> int:
        return self.line("square", a)

    def shifted(self, a: int, number: float) -> int:
        return self.line("shifted", a, number=number)

    def quotient(self, a: int, b: int) -> int:
        return self.line("over", a, number=self.numbers[b]) if b in self.numbers else self.line("quotient", a, b)

    def root(self, a: int) -> int:
        return self.line("root", a, start="sqrt", of=(a,))

    def exp(self, a: int) -> int:
        return self.line("along", -1, a, start="exp", of=(a,))

    def log(self, a: int) -> int:
        return self.line("against", a, a, start="log", of=(a,))

    def pair(self, a: int, first: str, second: str, sign: float) -> tuple[int, int]:
        """Sin and cos, sinh and cosh: each is the other's derivative, but for the sign of the second's."""
        if (first, a) not in self._pairs:
            one, two = self._pairs[first, a] = self._new_row(), self._new_row()
            self.lines.append(Recurrence("along", one, (two, a), 1.0, first, (a,)))
            self.lines.append(Recurrence("along", two, (one, a), sign, second, (a,)))
        return self._pairs[first, a]

    def tangent(self, a: int, name: str, sign: float) -> int:
        """Tan and tanh: D y = (1 + sign y^2) D a."""
        y, squared, factor = self._new_row(), self._new_row(), self._new_row()
        self.lines.append(Recurrence("along", y, (factor, a), 1.0, name, (a,)))
        self.lines.append(Recurrence("square", squared, (y,)))
        scaled = squared if sign > 0 else self.minus(squared)
        self.lines.append(Recurrence("shifted", factor, (scaled,), 1.0))
        return y

    def inverse(self, a: int, name: str, of_square: float, constant: float, *, rooted: bool, sign: float = 1.0) -> int:
        """An inverse function: D y = sign D a / d, d = of_square a^2 + constant or its root."""
        squared = self.square(a)
        d = self.shifted(squared if of_square > 0 else self.minus(squared), constant)
        return self.line("against", self.root(d) if rooted else d, a, number=sign, start=name, of=(a,))

    def error_function(self, a: int) -> int:
        density = self.scaled(self.exp(self.minus(self.square(a))), TWO_OVER_ROOT_PI)
        return self.line("along", density, a, start="erf", of=(a,))

    def power(self, a: int, b: int) -> int:
        if b not in self.numbers:
            log = self.log(a) if a not in self.numbers or not self.rounded else self.constant(float(np.log(self.numbers[a])))
            return self.line("along", -1, self.product(b, log), start="pow", of=(a, b))
        p = self.numbers[b]
        if p == int(p) and abs(p) <= INTEGER_POWERS:
            y = self.integer_power(a, int(abs(p)))
            return y if p >= 0 else self.quotient(self.constant(1.0), y)
        return self.root(a) if p == 0.5 else self.line("power", a, number=p, start="pow", of=(a, b))

    def integer_power(self, a: int, p: int) -> int:
        if p < 2:
            return a if p else self.constant(1.0)
        half = self.square(self.integer_power(a, p // 2))
        return self.product(half, a) if p % 2 else half

    # Switches.

    def branch(self, kind: str, row: int) -> int:
        self.branches.append(Branch(kind, row))
        return len(self.branches) - 1

    def side(self, a: int, one: int, other: int) -> int:
        """``one`` where a >= 0, else ``other``."""
        return self.line("chosen", one, other, branch=self.branch("side", a))

    def angle(self, a: int, b: int) -> int:
        """atan2(a, b), and where b < 0 pi or -pi, by the side of a, + atan2(-a, -b): its cut, a = 0 where b < 0, is a switch."""
        behind = self.branch("side", b)
        u = self.line("chosen", a, self.minus(a), branch=behind)
        v = self.line("chosen", b, self.minus(b), branch=behind)
        half = self.side(a, self.constant(math.pi), self.constant(-math.pi))
        rotation = self.line("chosen", self.constant(0.0), half, branch=behind)
        return self.sum(rotation, self.line("angle", u, v, self.sum(self.square(a), self.square(b)), start="atan2", of=(u, v)))

    def absolute(self, a: int) -> int:
        return self.side(a, a, self.minus(a))

    def is_at_most(self, a: int, b: int) -> int:
        """1 where a <= b, else 0; SMALLEST_DOUBLE <= b is what is written, and no switch (see `exponentials`)."""
        if self.numbers.get(a) == SMALLEST_DOUBLE:
            return self.true(self.line("positive", b))
        return self.true(self.side(self.difference(b, a), self.constant(1.0), self.constant(0.0)))

    def is_equal(self, a: int, b: int) -> int:
        """1 where a = b all along, else 0."""
        branch = self.branch("equal", self.difference(a, b))
        return self.true(self.line("equal", self.constant(1.0), self.constant(0.0), branch=branch))

    def true(self, row: int) -> int:
        """Note that a row is 0 or 1."""
        self._truths.add(row)
        return row

    def logic(self, kind: str, *rows: int) -> int:
        return self.true(self.line(kind, *(self.truth(row) for row in rows)))

    def truth(self, row: int) -> int:
        """1 where a row is not 0, else 0."""
        if row in self._truths or row in self.numbers:
            return row
        return self.logic("not", self.is_equal(row, self.constant(0.0)))

    def whole(self, a: int, kind: str) -> int:
        """The whole number that a branch has chosen."""
        return self.line("whole", branch=self.branch(kind, a))

    def remainder(self, a: int, b: int, kind: str) -> int:
        return self.difference(a, self.product(self.whole(self.quotient(a, b), kind), b))

    def if_else_zero(self, condition: int, a: int) -> int:
        """``a`` where the condition is not 0, else 0, whatever ``a`` is."""
        return self.line("guarded", self.truth(condition), a)


UNARY_RECURRENCES: dict[int, Callable[[_RecurrenceTape, int], int]] = {
    ca.OP_NEG: _RecurrenceTape.minus,
    ca.OP_TWICE: lambda t, a: t.scaled(a, 2.0),
    ca.OP_SQ: _RecurrenceTape.square,
    ca.OP_INV: lambda t, a: t.quotient(t.constant(1.0), a),
    ca.OP_SQRT: _RecurrenceTape.root,
    ca.OP_EXP: _RecurrenceTape.exp,
    ca.OP_LOG: _RecurrenceTape.log,
    ca.OP_EXPM1: lambda t, a: t.line("along", t.exp(a), a, start="expm1", of=(a,)),
    ca.OP_LOG1P: lambda t, a: t.line("against", t.shifted(a, 1.0), a, start="log1p", of=(a,)),
    ca.OP_SIN: lambda t, a: t.pair(a, "sin", "cos", -1.0)[0],
    ca.OP_COS: lambda t, a: t.pair(a, "sin", "cos", -1.0)[1],
    ca.OP_SINH: lambda t, a: t.pair(a, "sinh", "cosh", 1.0)[0],
    ca.OP_COSH: lambda t, a: t.pair(a, "sinh", "cosh", 1.0)[1],
    ca.OP_TAN: lambda t, a: t.tangent(a, "tan", 1.0),
    ca.OP_TANH: lambda t, a: t.tangent(a, "tanh", -1.0),
    ca.OP_ASIN: lambda t, a: t.inverse(a, "asin", -1.0, 1.0, rooted=True),
    ca.OP_ACOS: lambda t, a: t.inverse(a, "acos", -1.0, 1.0, rooted=True, sign=-1.0),
    ca.OP_ATAN: lambda t, a: t.inverse(a, "atan", 1.0, 1.0, rooted=False),
    ca.OP_ASINH: lambda t, a: t.inverse(a, "asinh", 1.0, 1.0, rooted=True),
    ca.OP_ACOSH: lambda t, a: t.inverse(a, "acosh", 1.0, -1.0, rooted=True),
    ca.OP_ATANH: lambda t, a: t.inverse(a, "atanh", -1.0, 1.0, rooted=False),
    ca.OP_ERF: _RecurrenceTape.error_function,
    ca.OP_FABS: _RecurrenceTape.absolute,
    ca.OP_SIGN: lambda t, a: t.side(a, t.constant(1.0), t.constant(-1.0)),
    ca.OP_FLOOR: lambda t, a: t.whole(a, "floor"),
    ca.OP_CEIL: lambda t, a: t.whole(a, "ceil"),
    ca.OP_NOT: lambda t, a: t.logic("not", a),
}
BINARY_RECURRENCES: dict[int, Callable[[_RecurrenceTape, int, int], int]] = {
    ca.OP_ADD: _RecurrenceTape.sum,
    ca.OP_SUB: _RecurrenceTape.difference,
    ca.OP_MUL: _RecurrenceTape.product,
    ca.OP_DIV: _RecurrenceTape.quotient,
    ca.OP_POW: _RecurrenceTape.power,
    ca.OP_CONSTPOW: _RecurrenceTape.power,
    ca.OP_HYPOT: lambda t, a, b: t.line("root", t.sum(t.square(a), t.square(b)), start="hypot", of=(a, b)),
    ca.OP_ATAN2: _RecurrenceTape.angle,
    ca.OP_FMAX: lambda t, a, b: t.side(t.difference(a, b), a, b),
    ca.OP_FMIN: lambda t, a, b: t.side(t.difference(b, a), a, b),
    ca.OP_COPYSIGN: lambda t, a, b: t.side(b, t.absolute(a), t.minus(t.absolute(a))),
    ca.OP_FMOD: lambda t, a, b: t.remainder(a, b, "toward zero"),
    ca.OP_REMAINDER: lambda t, a, b: t.remainder(a, b, "nearest"),
    ca.OP_LT: lambda t, a, b: t.logic("not", t.is_at_most(b, a)),
    ca.OP_LE: _RecurrenceTape.is_at_most,
    ca.OP_EQ: _RecurrenceTape.is_equal,
    ca.OP_NE: lambda t, a, b: t.logic("not", t.is_equal(a, b)),
    ca.OP_AND: lambda t, a, b: t.logic("both", a, b),
    ca.OP_OR: lambda t, a, b: t.logic("either", a, b),
    ca.OP_IF_ELSE_ZERO: _RecurrenceTape.if_else_zero,
}
SWITCHING = frozenset(
    getattr(ca, f"OP_{name}")
    for name in "ATAN2 FABS SIGN FLOOR CEIL NOT FMAX FMIN COPYSIGN FMOD REMAINDER LT LE EQ NE AND OR IF_ELSE_ZERO".split()
)


def is_switched(expr: ca.SX) -> bool:
    """Whether an expression holds operations that are not analytic, or what no Taylor series is known of."""
    if not operation_codes(expr) & SWITCHING:
        return False
    try:
        return bool(taylor_decompose(expr, ca.symvar(expr), "").branches)
    except OpaqueExpression:
        return True
