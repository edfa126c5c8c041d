"""What follows from parameters alone is computed when these are set: the recurrences of event-driven integration read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca

from nsmodel.proof.graph import applied, fold, keys, operations


class Derived(NamedTuple):
    """Expressions with symbols in place of their parts that follow from parameters alone; the symbols, and these parts."""

    expressions: Mapping[str, ca.SX]
    symbols: ca.SX
    parts: ca.SX

    def back(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """With the parts where the symbols stand."""
        return ca.substitute(list(expressions), [self.symbols], [self.parts]) if self.symbols.numel() else list(expressions)


@dataclass(eq=False)
class _Node:
    """``kind``: a number, a parameter, an operation on these alone, or anything else."""

    new: ca.SX
    kind: str
    symbol: ca.SX | None = None


NUMBER, PARAMETER, ALONE, MIXED = "number", "parameter", "alone", "mixed"


def derived(expressions: Mapping[str, ca.SX], p: ca.SX) -> Derived:
    """Look for the largest such parts."""
    whole, own, parts, symbols = ca.cse(ca.veccat(*expressions.values())), keys(p), [], []
    if not (own & keys(whole)) or ca.OP_CALL in operations(whole):
        return Derived(expressions, ca.SX(0, 1), ca.SX(0, 1))

    def put(node: _Node) -> ca.SX:
        if node.kind != ALONE:
            return node.new
        if node.symbol is None:
            node.symbol = ca.SX.sym(f"of_parameters_{len(symbols)}")
            symbols.append(node.symbol)
            parts.append(node.new)
        return node.symbol

    def symbol(given: ca.SX) -> _Node:
        return _Node(given, PARAMETER if given.element_hash() in own else MIXED)

    def number(value: float) -> _Node:
        return _Node(ca.SX(value), NUMBER)

    def apply(op: int, args: list[_Node]) -> _Node:
        alone = all(arg.kind != MIXED for arg in args)
        return _Node(applied(op, [arg.new if alone else put(arg) for arg in args]), ALONE if alone else MIXED)

    found = [put(node) for node in fold(whole, symbol, number, apply)]
    made, at = {}, 0
    for name, expression in expressions.items():
        made[name] = ca.reshape(ca.vertcat(ca.SX(0, 1), *found[at : at + expression.numel()]), expression.shape)
        at += expression.numel()
    return Derived(made, ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *parts))
