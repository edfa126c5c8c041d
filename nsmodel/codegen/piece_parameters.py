"""What follows from parameters alone is computed when these are set: the recurrences of event-driven integration read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca

from nsmodel.proof.graph import apply_operation, fold_graph, operation_codes, symbol_hashes


class ParameterSubstitution(NamedTuple):
    """Expressions with symbols in place of their parts that follow from parameters alone; the symbols, and these parts."""

    expressions: Mapping[str, ca.SX]
    symbols: ca.SX
    parts: ca.SX

    def back(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """With the parts where the symbols stand."""
        return ca.substitute(list(expressions), [self.symbols], [self.parts]) if self.symbols.numel() else list(expressions)


@dataclass(eq=False)
class _ParameterNode:
    """``kind``: a number, a parameter, an operation on these alone, or anything else."""

    new: ca.SX
    kind: str
    symbol: ca.SX | None = None


NUMBER, PARAMETER, OF_PARAMETERS, MIXED = "number", "parameter", "alone", "mixed"


def extract_parameter_parts(expressions: Mapping[str, ca.SX], p: ca.SX) -> ParameterSubstitution:
    """Look for the largest such parts."""
    whole, own, parts, symbols = ca.cse(ca.veccat(*expressions.values())), symbol_hashes(p), [], []
    if not (own & symbol_hashes(whole)) or ca.OP_CALL in operation_codes(whole):
        return ParameterSubstitution(expressions, ca.SX(0, 1), ca.SX(0, 1))

    def replace_by_symbol(node: _ParameterNode) -> ca.SX:
        if node.kind != OF_PARAMETERS:
            return node.new
        if node.symbol is None:
            node.symbol = ca.SX.sym(f"of_parameters_{len(symbols)}")
            symbols.append(node.symbol)
            parts.append(node.new)
        return node.symbol

    def symbol(given: ca.SX) -> _ParameterNode:
        return _ParameterNode(given, PARAMETER if given.element_hash() in own else MIXED)

    def number(value: float) -> _ParameterNode:
        return _ParameterNode(ca.SX(value), NUMBER)

    def apply(op: int, args: list[_ParameterNode]) -> _ParameterNode:
        alone = all(arg.kind != MIXED for arg in args)
        return _ParameterNode(
            apply_operation(op, [arg.new if alone else replace_by_symbol(arg) for arg in args]), OF_PARAMETERS if alone else MIXED
        )

    found = [replace_by_symbol(node) for node in fold_graph(whole, symbol, number, apply)]
    made, at = {}, 0
    for name, expression in expressions.items():
        made[name] = ca.reshape(ca.vertcat(ca.SX(0, 1), *found[at : at + expression.numel()]), expression.shape)
        at += expression.numel()
    return ParameterSubstitution(made, ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *parts))
