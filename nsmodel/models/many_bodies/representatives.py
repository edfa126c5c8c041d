"""A family of constraints as a few of them: the worst members stand for all that differ from them by a constant only.

g = G(t, q, c) + o(s): of the numbers that g uses, s enter as a constant added and c do not. Members with the same c differ by
o alone, and the one with the largest o forbids the least: its U_i = {g_i > -delta} is the largest, its delta the least, so that
no member has a worse a, b, c or M, and each admits whatever the others admit.
"""

from __future__ import annotations

from itertools import zip_longest
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.region import Region
from nsmodel.models.many_bodies.families import Family
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.sweeping_process.constraint_bounds import Constraint
from nsmodel.models.sweeping_process.constraint_shapes import read_shapes
from nsmodel.proof import extremum
from nsmodel.proof.expression_graph import apply_operation, fold_graph, operation_codes, stack_column, symbol_hashes
from nsmodel.proof.interval_bounds import enclose
from nsmodel.proof.jumps import jump_nodes

# Members whose numbers are looked at one by one, 2^17; of more, the ranges of their numbers, which prove less.
MAX_LISTED_MEMBERS = 1 << 17
MAX_TIED_MEMBERS = 16  # Members of one kind between which rounding does not decide, at most: each is proved by itself.
# Values of o that differ by less than this part of them are not told apart: 450 EPS, more than a formula loses.
OFFSET_ROUNDING = 1e-13
MAX_COMBINATIONS = 400  # Combinations of the numbers c that are looked at, a proof each; of more the finding is sampled.
MAX_COMBINATIONS_QUICK = 100  # The same of a quick check.

MemberNumbers = tuple[np.ndarray, float, tuple[int, int]]  # The numbers of both, what is added to g, their indices.


class RepresentativeConstraints(NamedTuple):
    """Members of one family with the same c.

    Attributes:
        family: its name.
        worst: the constraint with the largest o.
        deepest: the one with the least o.
        actual: the constraint of a member with nearly the largest o; ``worst`` itself where that is one.
    """

    family: str
    worst: Constraint
    deepest: Constraint
    actual: Constraint


class ModelRepresentatives(NamedTuple):
    """What stands for all constraints of a model, and in words which combinations of numbers were left out ("": none)."""

    kinds: list[RepresentativeConstraints]
    left_out: str


def member_name(family: str, first: int, second: int) -> str:
    """The constraint of a member as `ManyBodies.written_out` calls it: "pair 3-7", "floor 3"."""
    return f"{family} {first}" if second < 0 else f"{family} {first}-{second}"


def representatives_of(model: ManyBodies, region: Region, quick: bool) -> ModelRepresentatives:
    """Return the constraints that stand for all of a bound model; ``region`` is the box of one body."""
    found, left = [], []
    for name, family in model.constraints.items():
        own, combinations = _family_representatives(
            model, name, family, region, MAX_COMBINATIONS_QUICK if quick else MAX_COMBINATIONS
        )
        found += own
        if len(own) < combinations:
            left.append(f"'{name}' at {len(own)} of its {combinations} combinations of numbers")
    return ModelRepresentatives(found, ", ".join(left))


def number_symbols(family: Family) -> ca.SX:
    """The symbols of the numbers of both members: of bodies what follows the state."""
    d = family.first.q.numel()
    second = ca.SX(0, 1) if family.second is None else family.second.symbols
    return ca.vertcat(family.first.symbols[d:], second[d:] if family.of_pairs else second)


def state_symbols(family: Family) -> ca.SX:
    """The states of one body, or of both."""
    return ca.vertcat(*(member.q for member in family.moving))


def number_tables(family: Family) -> tuple[np.ndarray, np.ndarray]:
    """The numbers (count, k) of all first and of all second members, as in `number_symbols`."""
    d = family.first.q.numel()
    first = family.first.group.table[:, d:]
    if family.second is None:
        return first, np.zeros((1, 0))
    return first, family.second.group.table[:, d:] if family.of_pairs else family.second.group.table


def additive_numbers(family: Family, numbers: ca.SX, parameters: ca.SX | None = None) -> list[int]:
    """The indices of those numbers that g has as a constant added: dg/ds is a function of such numbers alone.

    ``parameters``: without values yet, of which it may be a function too.
    """
    g = family.g
    own = [k for k in range(numbers.numel()) if ca.depends_on(g, numbers[k]) and not jump_nodes(g, numbers[k])]
    while own:
        known = symbol_hashes(ca.vertcat(numbers[own], ca.SX(0, 1) if parameters is None else parameters))
        kept = [k for k in own if all(s.element_hash() in known for s in ca.symvar(ca.jacobian(g, numbers[k])))]
        if kept == own:
            break
        own = kept
    if not own or parameters is not None:
        return own
    one = np.hstack([table[:1] for table in number_tables(family)])
    return own if np.isfinite(float(_offset_function(family, own)(one[0, own]))) else []


def _family_representatives(
    model: ManyBodies, name: str, family: Family, region: Region, most: int
) -> tuple[list[RepresentativeConstraints], int]:
    """Some of the kinds of one family, and how many there are."""
    numbers = number_symbols(family)
    s = additive_numbers(family, numbers)
    c = [k for k in range(numbers.numel()) if k not in s and ca.depends_on(family.g, numbers[k])]
    listing = _range_representatives if family.over is None and family.count > MAX_LISTED_MEMBERS else _listed_representatives
    members, count = listing(family, c, s, most)
    flat = list({id(member): member for kind in members for member in kind}.values())
    lower, upper = (
        np.concatenate([[time], np.tile(end, 1 + family.of_pairs)])
        for time, end in ((region.t0, region.lower), (region.t1, region.upper))
    )
    of = dict(zip(map(id, flat), _member_constraints(model, name, family, flat, lower, upper), strict=True))
    return [RepresentativeConstraints(name, *(of[id(member)] for member in kind)) for kind in members], count


def member_constraint(
    model: ManyBodies, name: str, family: Family, pair: tuple[int, int], folded: bool
) -> tuple[Constraint, np.ndarray]:
    """Return the constraint of one member, with no box around it, and its numbers (K,): put in, or states after its own."""
    first, second = number_tables(family)
    numbers = np.concatenate([first[pair[0]], second[pair[1] if family.second is not None else 0]])
    z = state_symbols(family) if folded else ca.vertcat(state_symbols(family), number_symbols(family))
    g = ca.SX(family.g)
    g = ca.substitute(g, number_symbols(family), ca.DM(numbers)) if folded else g
    (shape,) = read_shapes(g, z)
    own, wide = list(shape.own), np.full(1 + len(shape.own), np.inf)
    names = tuple(z[k].name() for k in own)
    return Constraint(member_name(name, *pair), g, shape, model.t, z[own], names, -wide, wide), numbers


def is_folded_exactly(family: Family, numbers: np.ndarray) -> bool:
    """Whether what g makes of the members' numbers alone is not rounded."""
    own, nodes = symbol_hashes(number_symbols(family)), []
    if ca.OP_CALL in operation_codes(family.g):
        return False

    def apply(op: int, parts: list[tuple[bool, ca.SX]]) -> tuple[bool, ca.SX]:
        alone, node = all(part[0] for part in parts), apply_operation(op, [part[1] for part in parts])
        if alone:
            nodes.append(node)
        return alone, node

    fold_graph(ca.SX(family.g), lambda s: (s.element_hash() in own, s), lambda value: (True, ca.SX(value)), apply)
    low, high = enclose(stack_column(nodes), number_symbols(family), numbers, numbers)
    return bool((low == high).all())


def _member_constraints(
    model: ManyBodies, name: str, family: Family, members: list[MemberNumbers], lower: np.ndarray, upper: np.ndarray
) -> list[Constraint]:
    """The constraints of members in the states of the family's own symbols, on a box of (t, states)."""
    numbers, q = number_symbols(family), state_symbols(family)
    names = [symbol.name() for symbol in ca.vertsplit(q)]
    function = ca.Function("g", [model.t, q, numbers], [family.g])
    rows = [function(model.t, q, ca.SX(ca.DM(values))) + slack for values, slack, _ in members]
    found = []
    for g, (*_, pair), shape in zip(rows, members, read_shapes(ca.vertcat(*rows), q) if rows else (), strict=True):
        ends, own = [0, *(1 + k for k in shape.own)], list(shape.own)
        states = tuple(names[k] for k in own)
        found.append(Constraint(member_name(name, *pair), g, shape, model.t, q[own], states, lower[ends], upper[ends]))
    return found


def _listed_representatives(
    family: Family, c: list[int], s: list[int], most: int
) -> tuple[list[tuple[MemberNumbers, MemberNumbers, MemberNumbers]], int]:
    """(worst, deepest, worst) of each combination of the numbers c, among all members."""
    first, second = number_tables(family)
    pairs = family.pairs
    if not len(pairs):
        return [], 0
    table = np.hstack([first[pairs[:, 0]], second[pairs[:, 1]]])
    if c:
        combinations, which = np.unique(table[:, c], axis=0, return_inverse=True)
        count, which = len(combinations), which.ravel()
    else:
        count, which = 1, np.zeros(len(table), int)
    o = np.array(_offset_function(family, s)(table[:, s].T)).ravel() if s else np.zeros(len(table))
    order = np.lexsort((o, which))
    ends = np.flatnonzero(np.diff(which[order], append=count))
    starts = np.append(0, ends[:-1] + 1)
    unsure = 0.0 if _is_offset_linear(family, s) else OFFSET_ROUNDING * (1 + float(np.abs(o).max(initial=0.0)))

    def member(k: int) -> MemberNumbers:
        return table[k], 0.0, (int(pairs[k, 0]), int(pairs[k, 1]))

    def alike(rows: np.ndarray) -> list[MemberNumbers]:
        return [member(k) for k in rows[np.unique(table[rows][:, s], axis=0, return_index=True)[1]]]

    some, found = np.unique(np.linspace(0, count - 1, min(count, most), dtype=int)), []
    for k in some:
        rows = order[starts[k] : ends[k] + 1]
        if unsure:
            own = o[rows]
            largest, least = alike(rows[own >= own[-1] - unsure]), alike(rows[own <= own[0] + unsure])
        else:
            largest, least = [member(rows[-1])], [member(rows[0])]
        count += max(len(largest), len(least)) - 1
        for worst, deepest in zip_longest(largest[:MAX_TIED_MEMBERS], least[:MAX_TIED_MEMBERS]):
            worst = largest[0] if worst is None else worst
            found.append((worst, least[0] if deepest is None else deepest, worst))
    return found, count


def _range_representatives(
    family: Family, c: list[int], s: list[int], most: int
) -> tuple[list[tuple[MemberNumbers, MemberNumbers, MemberNumbers]], int]:
    """The same where there are too many members: every combination of c, with o at its extremes over the ranges of s."""
    first, second = number_tables(family)
    split = first.shape[1]
    lists = [_distinct_rows(first, [k for k in c if k < split]), _distinct_rows(second, [k - split for k in c if k >= split])]
    count = len(lists[0]) * len(lists[1])
    symbol = ca.SX.sym("s", len(s))
    o = _offset_function(family, s)(symbol) if s else ca.SX(0)
    found, nobody = [], 0
    for which in np.unique(np.linspace(0, count - 1, min(count, most), dtype=int)):
        i, j = lists[0][which // len(lists[1])], lists[1][which % len(lists[1])]
        values = np.concatenate([first[i], second[j]])
        alike = _members_with_numbers(family, values, c)
        if not all(map(len, alike)):
            nobody += 1
            continue
        lower, upper = (
            np.concatenate([end(table[rows], axis=0) for table, rows in zip((first, second), alike, strict=True)])[s]
            for end in (np.min, np.max)
        )
        rows = []
        for sign in (1, -1):
            top = extremum.supremum(sign * o, symbol, lower, upper) if s else None
            numbers, slack = values.copy(), 0.0
            if top is not None and top.at is not None:
                numbers[s] = top.at
                slack = sign * max(top.bound - top.value, 0.0)
            one, other = _nearest_row(first, numbers[:split], alike[0]), -1
            if family.second is not None:
                left = alike[1][alike[1] != one] if family.of_pairs else alike[1]
                other = _nearest_row(second, numbers[split:], left)
            rows.append((numbers, slack, (min(one, other), max(one, other)) if family.of_pairs else (one, other)))
        actual = (np.concatenate([first[rows[0][2][0]], second[rows[0][2][1]]]), 0.0, rows[0][2])
        found.append((*rows, actual))
    return found, count - nobody


def _distinct_rows(table: np.ndarray, columns: list[int]) -> np.ndarray:
    """The first row with each combination of some columns; row 0 where there are none."""
    return np.unique(table[:, columns], axis=0, return_index=True)[1] if columns else np.zeros(1, int)


def _members_with_numbers(family: Family, values: np.ndarray, c: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The first and the second members with the numbers c of ``values``, but for those that would meet themselves alone."""
    first, second = number_tables(family)
    split = first.shape[1]
    own, others = [k for k in c if k < split], [k for k in c if k >= split]
    one = np.flatnonzero((first[:, own] == values[own]).all(axis=1))
    other = np.flatnonzero((second[:, [k - split for k in others]] == values[others]).all(axis=1))
    if not family.of_pairs:
        return one, other
    return (
        one[one != other[0]] if len(other) == 1 else one,
        other[other != one[0]] if len(one) == 1 else other,
    )


def _nearest_row(table: np.ndarray, values: np.ndarray, rows: np.ndarray) -> int:
    """The one of some rows that is nearest to ``values``."""
    return int(rows[np.argmin(np.abs(table[rows] - values).sum(axis=1))])


def _is_offset_linear(family: Family, s: list[int]) -> bool:
    """Whether o is a linear function of the numbers s."""
    return not ca.symvar(ca.jacobian(family.g, number_symbols(family)[s]))


def _offset_function(family: Family, s: list[int]) -> ca.Function:
    """s -> o(s), but for a constant: read off where o is linear, else g with all else at one generic point."""
    own = number_symbols(family)[s]
    if _is_offset_linear(family, s):
        return ca.Function("o", [own], [ca.densify(ca.jacobian(family.g, own)) @ own])
    known = {symbol.element_hash() for symbol in ca.vertsplit(own)}
    rest = ca.vertcat(ca.SX(0, 1), *(x for x in ca.symvar(family.g) if x.element_hash() not in known))
    at = ca.DM(np.random.default_rng(1).uniform(0.5, 1.5, rest.numel()))
    return ca.Function("o", [own], [ca.substitute(family.g, rest, at) if rest.numel() else family.g])
