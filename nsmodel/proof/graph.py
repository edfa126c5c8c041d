"""The graph of a CasADi expression: what it holds, and the one walk through it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar

import casadi as ca
import numpy as np

T = TypeVar("T")
RewriteRule = Callable[[int, list[ca.SX], ca.SX], ca.SX | None]
TRUTH_VALUED_OPERATIONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT)


class OpaqueExpression(ValueError):
    """An expression calls a Function that cannot be looked into."""


def stack_column(items: Iterable[ca.SX]) -> ca.SX:
    """Stack the items; (0, 1) where there are none."""
    return ca.vertcat(ca.SX(0, 1), *items)


def stored_entries(matrix: ca.SX) -> list[ca.SX]:
    """The entries that are stored, each an expression; their type in CasADi's stubs is another."""
    return [ca.SX(entry) for entry in matrix.nonzeros()]  # pyright: ignore[reportCallIssue, reportArgumentType]


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
        raise OpaqueExpression(f"{label} calls a Function that cannot be looked into; write it with elementary operations")

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
