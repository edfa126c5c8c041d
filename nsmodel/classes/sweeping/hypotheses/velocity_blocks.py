"""The velocity field in blocks that share no states, each formula once."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.admissible import PartialSweepingProcess
from nsmodel.proof import interval_bounds
from nsmodel.proof.expression_graph import rewrite_nodes, stack_column, symbol_hashes
from nsmodel.proof.jumps import SWITCH_OPERATIONS
from nsmodel.proof.verdict import overlapping_groups


class FieldBlock(NamedTuple):
    """Components of f that share states with each other only; blocks of one formula share ``f`` and ``q``.

    Attributes:
        f: SX (r, 1) in t, q and s.
        q: SX (k, 1).
        s, s_lower, s_upper: switches that depend on time alone, as symbols within bounds.
        members: (rows, columns) of each block with this formula, in the model.
        lower, upper: (1 + k,) bounds of (t, q) around all members.
    """

    f: ca.SX
    q: ca.SX
    t: ca.SX
    s: ca.SX
    s_lower: np.ndarray
    s_upper: np.ndarray
    members: list[tuple[list[int], list[int]]]
    lower: np.ndarray
    upper: np.ndarray

    @property
    def z(self) -> ca.SX:
        """(t, q, s)."""
        return ca.vertcat(self.t, self.q, self.s)

    def box(self, everywhere: bool) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of z; of all states where ``everywhere``."""
        k = self.q.numel()
        lower = np.concatenate([self.lower[:1], np.full(k, -np.inf) if everywhere else self.lower[1:], self.s_lower])
        upper = np.concatenate([self.upper[:1], np.full(k, np.inf) if everywhere else self.upper[1:], self.s_upper])
        return lower, upper


def split_field_blocks(f: ca.SX, process: PartialSweepingProcess) -> list[FieldBlock]:
    """Split f where its components share no states, and put blocks of the same formula together."""
    rows, columns = _dependency_pattern(f, process.q)
    entries = sorted(set(rows))
    states = [{j for k, j in zip(rows, columns, strict=True) if k == i} for i in entries]
    found: dict[tuple, FieldBlock] = {}
    for group in overlapping_groups(states):
        r, j = [entries[k] for k in group], sorted(set().union(*(states[k] for k in group)))
        block = _field_block(f[r], process, r, j)
        first = found.setdefault(_formula_key(block), block)
        if first is not block:
            first.members.append((r, j))
            for least, other in ((first.lower, block.lower), (first.s_lower, block.s_lower)):
                np.minimum(least, other, out=least)
            for largest, other in ((first.upper, block.upper), (first.s_upper, block.s_upper)):
                np.maximum(largest, other, out=largest)
    return list(found.values())


def _formula_key(block: FieldBlock) -> tuple:
    """The operations of a block with all digits of their constants, whatever the symbols are called."""
    f = ca.Function("f", [block.t, block.q, block.s], [ca.densify(block.f)])
    steps = [(f.instruction_id(i), *f.instruction_input(i), -1, *f.instruction_output(i)) for i in range(f.n_instructions())]
    constants = [f.instruction_constant(i) for i, step in enumerate(steps) if step[0] == ca.OP_CONST]
    return tuple(steps), tuple(constants), block.q.numel(), block.s.numel()


def _dependency_pattern(f: ca.SX, q: ca.SX) -> tuple[list[int], list[int]]:
    """Which components depend on which states: a sign or a comparison counts, though its derivative is 0."""
    pattern = ca.Function("f", [q, stack_column(_other_symbols(f, q))], [ca.densify(f)]).jac_sparsity(0, 0)
    return pattern.get_triplet()


def _other_symbols(f: ca.SX, q: ca.SX) -> list[ca.SX]:
    own = symbol_hashes(q)
    return [symbol for symbol in ca.symvar(f) if symbol.element_hash() not in own]


def _field_block(f: ca.SX, process: PartialSweepingProcess, rows: list[int], columns: list[int]) -> FieldBlock:
    own = process.q[columns]
    plain = ca.SX.sym("q", len(columns))
    formula = ca.substitute(f, own, plain)
    nodes: list[tuple[ca.SX, ca.SX]] = []

    def replace_switch(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if ca.depends_on(old, plain):
            return None
        nodes.append((ca.SX.sym(f"s{len(nodes)}"), old))
        return nodes[-1][0]

    formula = rewrite_nodes(formula, replace_switch, SWITCH_OPERATIONS, process.t, "f")
    ends = [0, *(1 + j for j in columns)]
    lower, upper = process.lower[ends].copy(), process.upper[ends].copy()
    bounds = (
        interval_bounds.enclose(stack_column(old for _, old in nodes), process.t, lower[:1], upper[:1])
        if nodes
        else (np.zeros(0),) * 2
    )
    s = stack_column(symbol for symbol, _ in nodes)
    return FieldBlock(formula, plain, process.t, s, np.ravel(bounds[0]), np.ravel(bounds[1]), [(rows, columns)], lower, upper)
