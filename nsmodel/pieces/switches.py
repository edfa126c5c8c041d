"""What a mode is made of, and what watches that it goes on: codes of rows, choices of branches, and their sign conditions.

A **condition** is a polynomial that is >= 0 as long as its switch stays as it is; ``after`` is what the switch becomes where it
is not. A row i of a box has -1 or +1 with l_i at its end and y_i of a sign, or 0 with y_i = 0 and l_i between its ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from nsmodel.pieces.bernstein import poly_values
from nsmodel.pieces.disc_equations import DiscValues
from nsmodel.pieces.discs import EPS, DiscBall
from nsmodel.pieces.multipliers import MultiplierSolver
from nsmodel.pieces.sizes import ROUNDING
from nsmodel.pieces.sliding import FrictionBlock
from nsmodel.pieces.system import MAX_CACHED_MODES, RESTS, ModeSystem

ROW = "row"
Switch = tuple[str, int]  # (ROW, i), or (part, its branch)


class SwitchCondition(NamedTuple):
    """``sign`` * row + ``shift`` >= 0 for switch ``of``; its code is ``after`` beyond.

    ``of`` is (ROW, i) or (part, its branch), of a curved block the first of its rows; ``row`` has ``orders`` + 1 known
    coefficients; ``acts`` says whose size it has: "y", "l" or, of "inside" a curved block, its bound; "" is nobody's.
    """

    of: Switch
    row: list[float]
    sign: float
    shift: float
    orders: int
    after: float
    acts: str = ""

    @property
    def ends_at_stop(self) -> bool:
        """Whether it ends at the threshold below which a block stands."""
        return self.acts == "y" and self.shift != 0

    def coefficients(self) -> list[float]:
        """Of the polynomial, order 0 first."""
        c = self.row[: self.orders + 1] if self.sign > 0 else [-v for v in self.row[: self.orders + 1]]
        c[0] += self.shift
        return c


TIE = 1e-12  # What rounding has left in a state, of its size so far; a condition below this share of its own is 0.


def is_same_condition(one: SwitchCondition, other: SwitchCondition) -> bool:
    """Whether two conditions watch the same end of the same switch."""
    return one.of == other.of and one.after == other.after


def all_switches(system: ModeSystem) -> set[Switch]:
    """All of them."""
    return {(ROW, system.blocks.rows_of(i)[0]) for i in range(system.m)} | set(system.branches)


def has_own_row(system: ModeSystem, condition: SwitchCondition) -> bool:
    """Whether a condition's row is made of l, or of a block, and is no row of h or of a branch."""
    return condition.acts in ("l", "inside") or (condition.of[0] == ROW and condition.of[1] in system.blocks.of)


def condition_argument(system: ModeSystem, condition: SwitchCondition, found: DiscValues) -> Any:
    """What a condition of a row of h, or of a branch, looks at on a disc."""
    kind, i = condition.of
    return found.y[i] if kind == ROW else found.looked[system.branches.index((kind, i))]


def condition_uncertainty(system: ModeSystem, condition: SwitchCondition, share: float = TIE) -> float:
    """What a condition is known to where its rows begin, if states are known to this share of their size so far.

    With TIE it is rounding: that of its own operations, of the time, and what has been left in states.
    """
    largest = share * condition_scale(system, condition)
    if has_own_row(system, condition):
        return largest
    sizes = zip(system.sizes.x, system.pushed(), strict=True)
    x = [DiscBall(row[0], share * (so_far + RESTS * push)) for row, (so_far, push) in zip(system.x, sizes, strict=True)]
    l = [DiscBall(row[0], share * so_far) for row, so_far in zip(system.push, system.sizes.l, strict=True)]
    found = condition_argument(system, condition, system.rounded(DiscBall(system.t[0], EPS * abs(system.t[0])), x, l))
    return min(found.r if isinstance(found, DiscBall) else 0.0, largest)


def condition_scale(system: ModeSystem, condition: SwitchCondition) -> float:
    """What a condition is measured beside: what it is the sum of, and the largest of its y, l or argument so far."""
    i = condition.of[1]
    if condition.acts == "y":
        block = system.blocks.of.get(i)
        return system.size_y(i) if block is None else block.unit * max(map(system.size_y, block.at))
    if condition.acts == "inside":
        return abs(condition.shift)
    return system.size_l(i) if condition.acts == "l" else max(abs(condition.shift), _switch_scale(system, condition.of))


def _switch_scale(system: ModeSystem, switch: Switch) -> float:
    """What the argument of a switch is measured beside: the largest that it was the sum of so far."""
    return system.sizes.switches[system.branches.index(switch)]


def _switch_term_scales(system: ModeSystem) -> list[float]:
    """What the arguments of switches are the sums of, with the largest states and multipliers so far."""
    states = [size + RESTS * push for size, push in zip(system.sizes.x, system.pushed(), strict=True)]
    both = ((1, states), (2, system.sizes.l))
    given = {(0, 0): abs(system.t[0])} | {(which, i): size for which, sizes in both for i, size in enumerate(sizes)}
    return [size for part in system.parts.values() for size in part.terms(given)]


def update_scales(system: ModeSystem, s: float, length: float) -> None:
    """Note what the rows come to at s of a piece, and what moves x in the time ``length`` of a series."""
    sizes = system.sizes
    for rows, largest in ((system.x, sizes.x), (system.y, sizes.y), (system.l, sizes.l)):
        largest[:] = [
            max(so_far, abs(v), abs(row[0])) for so_far, v, row in zip(largest, poly_values(rows, s), rows, strict=True)
        ]
    rounding = [ROUNDING * length / system.t[1] * v for v in system.pushed()]  # What is left of x that held rows let rest.
    of_x = list(map(max, sizes.x, rounding))
    least = system.zero_test(system.t[0], [row[0] for row in system.x], [row[0] for row in system.push], of_x, length)
    sizes.x[:] = map(max, sizes.x, least)
    if system.branches:
        sizes.switches[:] = [max(both) for both in zip(sizes.switches, _switch_term_scales(system), strict=True)]


def is_condition_zero(system: ModeSystem, condition: SwitchCondition) -> bool:
    """Whether a condition is 0, to rounding, or does not hold."""
    c = condition.coefficients()
    return not c[0] > TIE * max(condition_scale(system, condition), *map(abs, c[1:]))


# (below, above) of what a whole number w is chosen for.
INTEGER_RANGES = {
    "floor": lambda w: (w, w + 1),
    "ceil": lambda w: (w - 1, w),
    "toward zero": lambda w: (w - (w <= 0), w + (w >= 0)),
    "nearest": lambda w: (w - 0.5, w + 0.5),
}


def mode_conditions(system: ModeSystem, codes: list[int], how: MultiplierSolver, orders: int) -> Sequence[SwitchCondition]:
    """All conditions of a mode, of rows first: those of one without blocks are made once."""
    if system.blocks.all:
        return list(_generate_conditions(system, codes, how, orders))
    mode = (orders, how.index, how.feeds, *codes, *(side for part in system.parts.values() for side in part.choice))
    found = system.conditions.get(mode)
    if found is None:
        if len(system.conditions) >= MAX_CACHED_MODES:
            system.conditions.clear()
        found = system.conditions[mode] = list(_generate_conditions(system, codes, how, orders))
    return found


def _generate_conditions(system: ModeSystem, codes: list[int], how: MultiplierSolver, orders: int) -> Iterator[SwitchCondition]:
    known = orders if how.index == 1 else orders - 1
    for block in system.blocks.all:
        yield from _block_conditions(system, block, codes[block.first], known)
    for i, code in enumerate(codes):
        if system.blocks.is_curved(i) or (code and i in system.blocks.of):
            continue
        if code:
            if system.lower[i] < system.upper[i]:
                yield SwitchCondition((ROW, i), system.y[i], -code, 0.0, known if how.feeds else orders, 0, "y")
            continue
        if math.isfinite(system.lower[i]):
            yield SwitchCondition((ROW, i), system.l[i], 1.0, -system.lower[i], known, -1, "l")
        if math.isfinite(system.upper[i]):
            yield SwitchCondition((ROW, i), system.l[i], -1.0, system.upper[i], known, 1, "l")
    for name, i in system.branches:
        part = system.parts[name]
        branch, choice = part.jets.branches[i], part.choice[i]
        row = part.rows[branch.row]
        if branch.kind in ("side", "equal"):
            if choice:
                yield SwitchCondition((name, i), row, choice, 0.0, orders, -choice)
            continue
        low, high = INTEGER_RANGES[branch.kind](choice)
        yield SwitchCondition((name, i), row, 1.0, -low, orders, choice - 1)
        yield SwitchCondition((name, i), row, -1.0, high, orders, choice + 1)


def _block_conditions(system: ModeSystem, block: FrictionBlock, code: int, known: int) -> Iterator[SwitchCondition]:
    """Of a block that slips, |y| above the threshold at which it stands; of a curved one that sticks, l inside."""
    if code:
        yield SwitchCondition(
            (ROW, block.first), block.size, 1.0, -block.stop_threshold(system.sizes.y, system.rtol), known, 0, "y"
        )
    elif block.curved is not None:
        yield SwitchCondition((ROW, block.first), block.inner, -1.0, block.quadric[1], known, 1, "inside")
