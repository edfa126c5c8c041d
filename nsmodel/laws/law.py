"""A law: the relation -y ∈ N_K(l) between a multiplier l and its output y, for a product K of closed convex sets."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from nsmodel.brief import join_within_width
from nsmodel.errors import ModelError
from nsmodel.laws.block import LawFactor
from nsmodel.laws.moving import LawEnds
from nsmodel.pickled import Picklable


@dataclass(frozen=True, eq=False, repr=False)
class Law(Picklable):
    """A product of blocks: l and y are stacked in their order. Build it with the functions of this package."""

    blocks: tuple[LawFactor, ...]

    def __post_init__(self) -> None:
        """Refuse what is no kind of set.

        Raises:
            ModelError: a block that is none of a kind of this package.
        """
        for block in self.blocks:
            if not isinstance(block, LawFactor):
                raise ModelError(f"law: {block!r} is no set of a known kind")

    @property
    def description(self) -> str:
        """The kinds of its blocks with their sizes: "relay 2, ball 3"."""
        runs: list[tuple[str, int]] = []
        for block in self.blocks:
            before = runs.pop()[1] if runs and runs[-1][0] == block.label else 0
            runs.append((block.label, before + block.size))
        return join_within_width([f"{label} {size}" for label, size in runs], 80)

    def __repr__(self) -> str:
        """Return one line: the kinds of its blocks with their sizes."""
        return f"Law({self.description})"

    @property
    def size(self) -> int:
        """Number of components of l and y."""
        return sum(block.size for block in self.blocks)

    @property
    def lower(self) -> ca.SX:
        """Lower ends (m, 1); -inf on all components but those of boxes."""
        return ca.vertcat(ca.SX(0, 1), *(block.ends[0] for block in self.blocks))

    @property
    def upper(self) -> ca.SX:
        """Upper ends (m, 1); inf on all components but those of boxes."""
        return ca.vertcat(ca.SX(0, 1), *(block.ends[1] for block in self.blocks))

    @property
    def numbers(self) -> ca.SX:
        """All that may be an expression of parameters, as a column."""
        return ca.vertcat(ca.SX(0, 1), *(ca.vec(value) for block in self.blocks for value in block.numbers.values()))

    @property
    def labels(self) -> list[str]:
        """The label of each component (m entries)."""
        return [block.label for block in self.blocks for _ in range(block.size)]

    @property
    def is_box(self) -> bool:
        """Whether each component is a law of its own."""
        return all(block.separable for block in self.blocks)

    def put(self, symbols: ca.SX, values: ca.SX) -> Law:
        """The law with values in place of symbols."""

        def other(block: LawFactor) -> LawFactor:
            if not any(block.moves(symbols)):
                return block
            return block.with_numbers(**{name: ca.substitute(value, symbols, values) for name, value in block.numbers.items()})

        return Law(tuple(map(other, self.blocks)))

    def moves(self, moving: ca.SX) -> list[bool]:
        """Of each component (m entries) whether its set depends on ``moving``."""
        return [row for block in self.blocks for row in block.moves(moving)]

    def at_rest(self, moving: ca.SX) -> Law:
        """The law with numbers of the same kind, bounded or not, in place of what depends on ``moving``."""
        found = []
        for block in self.blocks:
            other = block.rewritten(ca.SX.sym("y", block.size), ("",) * block.size, moving) if any(block.moves(moving)) else None
            found += (block,) if other is None else other.law.blocks
        return Law(tuple(found))

    def ends(self, names: tuple[str, ...], moving: ca.SX) -> tuple[LawEnds, ...]:
        """The ends of each row, one of ``names`` each, that depend on ``moving``."""
        found: list[LawEnds] = []
        for rows, block in self.parts():
            other = block.rewritten(ca.SX.sym("y", block.size), tuple(names[rows]), moving) if any(block.moves(moving)) else None
            found += () if other is None else other.ends
        return tuple(found)

    def parts(self) -> list[tuple[slice, LawFactor]]:
        """The rows of each block."""
        found, at = [], 0
        for block in self.blocks:
            found.append((slice(at, at + block.size), block))
            at += block.size
        return found


def product(*laws: Law) -> Law:
    """Several laws side by side: l and y are stacked in the order given.

    Args:
        laws: what is stacked, `Law` each.

    Raises:
        ModelError: something that is no law.
    """
    for position, law in enumerate(laws):
        if not isinstance(law, Law):
            raise ModelError(f"product: argument {position} is a {type(law).__name__}; expected a law such as relay(2)")
    return Law(tuple(block for law in laws for block in law.blocks))
