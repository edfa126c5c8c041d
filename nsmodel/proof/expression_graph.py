"""The graph of a CasADi expression: what it holds, and the one walk through it.

The instructions of a CasADi expression as a list of values, with powers of one value recognised as such.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple, TypeVar

import casadi as ca
import numpy as np

T = TypeVar("T")
RewriteRule = Callable[[int, list[ca.SX], ca.SX], ca.SX | None]
# Operations that are defined and continuous everywhere.
CONTINUOUS_OPERATIONS = {
    ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_PARAMETER, ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_NEG, ca.OP_SQ,
    ca.OP_TWICE, ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX, ca.OP_SIN, ca.OP_COS, ca.OP_ATAN, ca.OP_TANH, ca.OP_SINH, ca.OP_COSH,
    ca.OP_ASINH, ca.OP_EXP, ca.OP_EXPM1, ca.OP_ERF,
}  # fmt: skip
# Operations of which polynomials are made.
POLYNOMIAL_OPERATIONS = {
    ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_PARAMETER, ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_NEG, ca.OP_SQ,
    ca.OP_TWICE,
}  # fmt: skip
KINK_OPERATIONS = (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN)  # Continuous, with a slope that jumps.
TRUTH_VALUED_OPERATIONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT)


class OpaqueExpression(ValueError):
    """An expression calls a Function that cannot be looked into."""


def stack_column(items: Iterable[ca.SX]) -> ca.SX:
    """Stack the items; (0, 1) where there are none."""
    return ca.vertcat(ca.SX(0, 1), *items)


def stored_entries(matrix: ca.SX) -> list[ca.SX]:
    """The entries that are stored, each an expression; their type in CasADi's stubs is another."""
    return [ca.SX(entry) for entry in matrix.nonzeros()]  # pyrefly: ignore[no-matching-overload]


def numeric_constants(expr: ca.SX) -> np.ndarray:
    """Return the numbers in an expression."""
    function = ca.Function("constants", [stack_column(ca.symvar(expr))], [expr])
    where = [i for i in range(function.n_instructions()) if function.instruction_id(i) == ca.OP_CONST]
    return np.array([function.instruction_constant(i) for i in where])


def operation_codes(expr: ca.SX) -> set[int]:
    """Return the codes of the operations in an expression."""
    function = ca.Function("operations", [stack_column(ca.symvar(expr))], [expr])
    return {function.instruction_id(i) for i in range(function.n_instructions())}


def fold_graph(
    expr: ca.SX, symbol: Callable[[ca.SX], T], number: Callable[[float], T], apply: Callable[[int, list[T]], T]
) -> list[T]:
    """Go through the graph of ``expr`` in another algebra; one result for each entry, column by column.

    Args:
        expr: SX of any shape.
        symbol, number: what a symbol and a constant become.
        apply: what an operation (its code) on results becomes. OP_CALL is the call of a Function that cannot be looked into.
    """
    symbols = ca.symvar(expr)
    function = ca.Function("fold", [stack_column(symbols)], [ca.densify(ca.vec(expr))])
    work: dict[int, T] = {}
    results: dict[int, T] = {}
    for i in range(function.n_instructions()):
        op, source, target = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            results[target[1]] = work[source[0]]
        elif op == ca.OP_INPUT:
            work[target[0]] = symbol(symbols[source[1]])
        elif op == ca.OP_CONST:
            work[target[0]] = number(function.instruction_constant(i))
        else:
            work |= dict.fromkeys(target, apply(op, [work[j] for j in source]))
    return [results[i] for i in range(expr.numel())]


def apply_operation(op: int, args: Sequence[ca.SX]) -> ca.SX:
    """Return the expression of an operation on one or two arguments.

    Raises:
        ValueError: the operation calls a Function (CasADi itself would give 0).
    """
    if op == ca.OP_CALL:
        raise ValueError("a call cannot be built from its code")
    return ca.SX.unary(op, *args) if len(args) == 1 else ca.SX.binary(op, *args)


def additive_terms(expr: ca.SX) -> list[tuple[Fraction, ca.SX]]:
    """The expression as a sum of factor times term, as far as its graph shows one."""
    out, left = [], [(Fraction(1), expr)]
    while left:
        factor, term = left.pop()
        op = term.op() if not term.is_constant() and not term.is_symbolic() else None
        if op in (ca.OP_ADD, ca.OP_SUB):
            left += [(factor if op == ca.OP_ADD else -factor, term.dep(1)), (factor, term.dep(0))]
        elif op in (ca.OP_NEG, ca.OP_TWICE):
            left.append((factor * (-1 if op == ca.OP_NEG else 2), term.dep(0)))
        elif op == ca.OP_MUL and term.dep(0).is_constant():
            left.append((factor * Fraction(float(term.dep(0))), term.dep(1)))
        elif op in (ca.OP_MUL, ca.OP_DIV) and term.dep(1).is_constant() and float(term.dep(1)):
            number = Fraction(float(term.dep(1)))
            left.append((factor * (number if op == ca.OP_MUL else 1 / number), term.dep(0)))
        else:
            out.append((factor, term))
    return out


def symbol_hashes(expr: ca.SX) -> set[int]:
    """Return what tells the symbols in an expression apart."""
    return {symbol.element_hash() for symbol in ca.symvar(expr)}


def is_same_expression(a: ca.SX, b: ca.SX) -> bool:
    """Whether two expressions are the same node for node."""
    return a.shape == b.shape and ca.is_equal(a, b, 20)


def rewrite_nodes(expr: ca.SX, rule: RewriteRule, ops: Sequence[int], x: ca.SX, label: str) -> ca.SX:
    """Rebuild ``expr`` (n, 1); ``rule(op, new arguments, old node)`` is asked at the nodes of ``ops`` that hold x.

    Where the rule gives None, the node stays.
    """
    own, present = symbol_hashes(x), operation_codes(expr)
    if not present & set(ops):
        return expr
    if ca.OP_CALL in present:
        raise OpaqueExpression(f"{label} calls a Function whose code cannot be read; write it with elementary operations")

    def symbol(symbol: ca.SX) -> _RewrittenNode:
        return _RewrittenNode(symbol, symbol, symbol.element_hash() in own)

    def number(value: float) -> _RewrittenNode:
        return _RewrittenNode(ca.SX(value), ca.SX(value), False)

    def apply(op: int, args: list[_RewrittenNode]) -> _RewrittenNode:
        new, old = [arg.new for arg in args], apply_operation(op, [arg.old for arg in args])
        holds = any(arg.holds for arg in args)
        put = rule(op, new, old) if holds and op in ops else None
        return _RewrittenNode(apply_operation(op, new) if put is None else put, old, holds)

    return ca.reshape(stack_column(node.new for node in fold_graph(expr, symbol, number, apply)), *expr.shape)


class _RewrittenNode(NamedTuple):
    """A node as it is rebuilt, as it was, and whether it holds x."""

    new: ca.SX
    old: ca.SX
    holds: bool


MAX_NUMBERS_AT_ONCE = 4_000_000  # Numbers kept at once while a program runs, two for each value and box: 32 MB.
UNIT_FACTOR = Fraction(1)  # Of a power that is not multiplied by a number.
POWER_OPERATIONS = {ca.OP_SQ, ca.OP_NEG, ca.OP_TWICE, ca.OP_MUL, ca.OP_ADD, ca.OP_SUB}
# Highest power as which a product of one value is seen, whose bounds are narrower; higher ones are bounded as products.
MAX_POWER = 64


class Instruction(NamedTuple):
    """One instruction: values[target] = op(values[sources]); ``number`` of a constant; ``slot`` of an input."""

    op: int
    sources: tuple[int, ...]
    number: float
    slot: int


@dataclass(frozen=True)
class Program:
    """The instructions of an expression, each value written once.

    Attributes:
        steps: in order; value i is the result of step i.
        outputs: (numel,) the value of each entry of the expression, column by column.
        shape: of the expression.
        inputs: number of entries of z.
        uses: for each step the slots of z that it depends on.
    """

    steps: tuple[Instruction, ...]
    outputs: tuple[int, ...]
    shape: tuple[int, int]
    inputs: int
    uses: tuple[frozenset[int], ...]

    @property
    def boxes_per_run(self) -> int:
        """How many boxes are worth running together."""
        return max(16, MAX_NUMBERS_AT_ONCE // (2 * len(self.steps) + 1))


def program(expr: ca.SX, z: ca.SX) -> Program:
    """Return the instructions of ``expr`` in the symbols z (n, 1).

    CasADi writes 3 x^2, a derivative, as x^2 + (2 x) x, whose least value on an interval around 0 would be bounded by a
    negative number: such sums and products of powers of one value are written as one power.

    Raises:
        ValueError: the expression holds other symbols.
    """
    z, expr = ca.SX(z), ca.SX(expr)
    own = {symbol.element_hash() for symbol in ca.vertsplit(ca.vec(z))}
    strange = [str(symbol) for symbol in ca.symvar(expr) if symbol.element_hash() not in own]
    if strange:
        raise ValueError(f"the expression holds {', '.join(strange)}, which are not among the symbols of the box")
    function = ca.Function("program", [ca.vec(z)], [ca.densify(ca.vec(expr))], {"live_variables": False, "cse": True})
    outputs = [0] * expr.numel()
    list_ = _InstructionList()
    register: dict[int, int] = {}
    for i in range(function.n_instructions()):
        op, source, target = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            outputs[target[1]] = register[source[0]]
        elif op == ca.OP_INPUT:
            register[target[0]] = list_.put(Instruction(op, (), 0.0, source[1]))
        elif op == ca.OP_CONST:
            register[target[0]] = list_.constant(function.instruction_constant(i))
        else:
            sources = tuple(register[j] for j in source)
            for j in target:
                register[j] = list_.result(op, sources) if len(target) == 1 else list_.put(Instruction(-1, sources, 0.0, -1))
    return Program(tuple(list_.steps), tuple(outputs), expr.shape, z.numel(), tuple(list_.uses))


class _PowerOfValue(NamedTuple):
    """factor times the value ``base`` to a power."""

    base: int
    power: int
    factor: Fraction


class _InstructionList:
    """Values written so far, and which of them are known to be powers of another."""

    def __init__(self) -> None:
        self.steps: list[Instruction] = []
        self.uses: list[frozenset[int]] = []
        self._known: dict[Instruction, int] = {}
        self._powers: dict[int, _PowerOfValue] = {}

    def put(self, step: Instruction) -> int:
        """Return the index of a step; one that was written already is not written again."""
        if step.op >= 0 and step in self._known:
            return self._known[step]
        self._known[step] = len(self.steps)
        self.steps.append(step)
        self.uses.append(frozenset({step.slot}) if step.slot >= 0 else frozenset().union(*(self.uses[k] for k in step.sources)))
        return len(self.steps) - 1

    def constant(self, number: float) -> int:
        """Return the index of a constant."""
        return self.put(Instruction(ca.OP_CONST, (), number, -1))

    def result(self, op: int, sources: tuple[int, ...]) -> int:
        """Return the index of the result of an operation."""
        power = self._as_power(op, sources)
        several = op in (ca.OP_MUL, ca.OP_ADD, ca.OP_SUB) and all(self.uses[j] for j in sources)
        index = self._write_power(power) if power is not None and several else self.put(Instruction(op, sources, 0.0, -1))
        if power is not None:
            self._powers[index] = power
        return index

    def _as_power(self, op: int, sources: tuple[int, ...]) -> _PowerOfValue | None:
        """Return the result as a power of one value with a factor that is a double; None if it is not seen to be one."""
        if op not in POWER_OPERATIONS:
            return None
        first, last = (self._powers.get(j) or _PowerOfValue(j, 1, UNIT_FACTOR) for j in (sources[0], sources[-1]))
        if op == ca.OP_SQ:
            found = _PowerOfValue(first.base, 2 * first.power, first.factor**2)
        elif op in (ca.OP_NEG, ca.OP_TWICE):
            found = first._replace(factor=first.factor * (-1 if op == ca.OP_NEG else 2))
        elif op == ca.OP_MUL and not (self.uses[sources[0]] and self.uses[sources[1]]):
            number, other = (first, last) if self.uses[sources[1]] else (last, first)
            step = self.steps[number.base]
            if step.op != ca.OP_CONST or not np.isfinite(step.number):
                return None
            found = other._replace(factor=other.factor * Fraction(step.number))
        elif op == ca.OP_MUL and first.base == last.base:
            found = _PowerOfValue(first.base, first.power + last.power, first.factor * last.factor)
        elif op in (ca.OP_ADD, ca.OP_SUB) and first[:2] == last[:2]:
            found = first._replace(factor=first.factor + last.factor * (1 if op == ca.OP_ADD else -1))
        else:
            return None
        return found if found.factor and found.power <= MAX_POWER and is_double(found.factor) else None

    def _write_power(self, power: _PowerOfValue) -> int:
        """Return the index of a power."""
        index = power.base
        if power.power == 2:
            index = self.put(Instruction(ca.OP_SQ, (index,), 0.0, -1))
        elif power.power > 2:
            index = self.put(Instruction(ca.OP_CONSTPOW, (index, self.constant(float(power.power))), 0.0, -1))
        if power.factor == 1:
            return index
        return self.put(Instruction(ca.OP_MUL, (self.constant(float(power.factor)), index), 0.0, -1))


def is_double(number: Fraction) -> bool:
    """Whether a double is this number."""
    try:
        return Fraction(float(number)) == number
    except OverflowError:
        return False
