"""The mode that a state goes on in: principal pivoting on germs, and the solvers of a step where that does not settle.

Where a condition is 0 its germ decides: the sign of its first coefficient that is not 0 (Heemels, Schumacher and Weiland, SIAM J.
Appl. Math. 60, 2000: the rational complementarity problem). A mode is taken only if all germs are valid in it.

What a mode is made of, and what watches that it goes on: codes of rows, choices of branches, and their sign conditions.

A **condition** is a polynomial that is >= 0 as long as its switch stays as it is; ``after`` is what the switch becomes where it
is not. A row i of a box has -1 or +1 with l_i at its end and y_i of a sign, or 0 with y_i = 0 and l_i between its ends.

What switches are called in messages.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import EPS, remember
from nsmodel.event_driven.bernstein import (
    HALF_ORDERS,
    ORDERS,
    germs_differ,
    leading_order,
    poly_values,
    shrink_time_share,
    without_rounding,
)
from nsmodel.event_driven.disc_arithmetic import DiscBall, DiscValues
from nsmodel.event_driven.friction_modes import FrictionBlock
from nsmodel.event_driven.multipliers import TERM_ROUNDING, TIE, MultiplierSolver, multiplier_solver
from nsmodel.event_driven.system import MAX_CACHED_MODES, RESTS, ModeSystem
from nsmodel.solvers import mlcp
from nsmodel.solvers.residuals import NumericLaw, numeric_law

ROW = "row"
GermRounding = dict[str, list[list[float]]]  # {"x", "l" or "y": its rows}; {} where nothing is said.
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


def is_same_condition(one: SwitchCondition, other: SwitchCondition) -> bool:
    """Whether two conditions watch the same end of the same switch."""
    return one.of == other.of and one.after == other.after


def all_switches(system: ModeSystem) -> set[Switch]:
    """The switches of all rows and branches."""
    return {(ROW, system.blocks.rows_of(i)[0]) for i in range(system.m)} | set(system.branches)


def has_own_row(system: ModeSystem, condition: SwitchCondition) -> bool:
    """Whether a condition's row is made of l, or of a block, and is not a row of h or of a branch."""
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
    if condition.acts == "l":
        return system.size_l(i)
    return max(abs(condition.shift), system.sizes.switches[system.branches.index(condition.of)])


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
    rounding = [TERM_ROUNDING * length / system.t[1] * v for v in system.pushed()]  # What is left of x that held rows let rest.
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
    return remember(system.conditions, mode, lambda: list(_generate_conditions(system, codes, how, orders)), MAX_CACHED_MODES)


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


# PIVOTS: after them guesses are tried, then all modes of FEW rows.
PIVOTS, TOGETHER = 60, 12  # Changes of the mode, and how many of them of all wrong rows at once.
PROVED, AGREE, UNDECIDED, SPLIT = "proved", "all valid modes agree", "not decided", "go apart"
TINY_STEP = 1e-6  # In units of time: a step whose affine problem has the modes just after now: D counts a million times C B. (+)
P_ROUNDING = 1e-9  # Of the largest impulse: by so much one may be outside its bounds; less would refuse a jump for rounding. (+)
NONZERO_SHARE = 1e-4  # Of its size: a larger y is 0 in no mode; less may rule out the right one, more costs modes to try. (+)
MAX_NUDGES = 6  # Places, each by rounding, twice as much as the last, by 63 roundings in all, beside one that has no number.
MAX_NUDGE = 2.0**12  # Roundings of the time, that a state may need to be another double; more would be motion.
FEW = 9  # Rows up to which all modes are tried one by one: 512, each in some 2 ms, or 3^9 where l has two ends. (+)
# LAPLACE_SHARES: a guess that is wrong costs time alone, as germs judge it.
LAPLACE_SHARES = (1e-2, 1e-3, 1e-4, 1e-6)  # 1/s in units of time, of the Laplace transforms whose index sets are guesses.
GUESS_RESIDUAL = 1e-9  # Of an index set of transforms: no others are looked for; germs judge it all the same. (+)
FACTORIALS = np.array([float(math.factorial(k)) for k in range(ORDERS + 1)])  # k!, of Laplace transforms of t^k.


@dataclass
class PieceStart:
    """Where a piece starts: time, state, unit of time, mode; ``open``: the switches that germs decide.

    ``crossed``: switches on which no l acts, and that are proved to be on another side, whatever their first coefficients are.
    ``late``: what rounding leaves of the time; hundreds of pieces come to a time as one does.
    """

    t: float
    x: list[float]
    tau: float
    codes: list[int]
    open: set[Switch] = field(default_factory=set)
    crossed: set[Switch] = field(default_factory=set)
    late: float = 0.0

    def pass_time(self, h: float) -> None:
        """Move the time by h; by nothing where rounding takes all of it: so no pole is crept over."""
        if self.t + h == self.t:
            return
        h += self.late
        t = self.t + h
        self.t, self.late = t, h - (t - self.t)

    def time_to(self, until: float) -> float:
        """How far a time is, infinite where it is."""
        return until - self.t - self.late


def select_mode(system: ModeSystem, place: PieceStart) -> MultiplierSolver | None:
    """Bring ``place.codes`` and the choices of branches to a mode in which all germs are valid; None: there is none.

    Where the mode that is taken up has no number at the place (exp(-1/u), where rounding has left u < 0), it is looked for a
    little later, as well as time is known.
    """
    before, t, x = _mode_state(system, place), place.t, list(place.x)
    for k in range(MAX_NUDGES):
        if (how := _find_valid_mode(system, place)) is not None:
            if place.t == t:
                return how
            extrapolate_start(system, place, t, x)
            return _expand_germs(system, place)
        _restore_mode(system, place, before)
        if not system.branches or _expand_germs(system, place) is not None:
            break
        nudge_start(system, place, 2.0**k)
    place.t, place.x = t, x
    return None


def nudge_start(system: ModeSystem, place: PieceStart, times: float) -> None:
    """Move the place, back where ``times`` < 0, by so many times what rounding leaves open of time, or of the fastest state."""
    rates = [row[1] / place.tau if math.isfinite(row[1]) else 0.0 for row in system.x]
    fastest = min((abs(x / rate) for x, rate in zip(place.x, rates, strict=True) if x and rate), default=0.0)
    time = times * EPS * abs(place.t) * min(max(fastest / abs(place.t), 1.0), MAX_NUDGE) if place.t else 0.0
    place.t += time
    place.x = [x + rate * time for x, rate in zip(place.x, rates, strict=True)]


def extrapolate_start(system: ModeSystem, place: PieceStart, t: float, x: list[float]) -> None:
    """Move x from (t, x) to the time of the place at the rates there, which stand: some may not have been known before."""
    place.x = [a + row[1] / place.tau * (place.t - t) for a, row in zip(x, system.x, strict=True)]


def _find_valid_mode(system: ModeSystem, place: PieceStart) -> MultiplierSolver | None:
    before = _mode_state(system, place)
    for begin in itertools.chain([None], _guess_modes(system, place)):
        _restore_mode(system, place, before)
        if begin is not None:
            place.open |= {(ROW, i) for i, code in enumerate(begin) if code != place.codes[i]}
            place.codes[:] = begin
        if (how := _pivot_to_valid_mode(system, place)) is not None:
            return how
    return next((how for how in _all_modes(system, place, before) if how is not None and _is_valid(system, place, how)), None)


def set_initial_codes(system: ModeSystem, place: PieceStart) -> None:
    """Codes to begin with: the end that the sign of y asks for, where no l acts on it and it is clear; else y = 0."""
    system.outputs(place.t, place.x)
    for i in range(system.m):
        codes = _possible_codes(system, (ROW, i))
        place.codes[i] = int(codes[0]) if len(codes) == 1 and i not in system.blocks.of else 0


def _all_modes(
    system: ModeSystem, place: PieceStart, before: tuple, own: list[float] | None = None
) -> Iterator[MultiplierSolver | None]:
    """Expand all modes of the open switches but ``own``, where these are few, one after the other; None: it has no series."""
    opened = sorted(before[2])
    if len(opened) > FEW:
        return
    possible = [[_switch_code(system, place, one)] if one in place.crossed else _possible_codes(system, one) for one in opened]
    for codes in itertools.product(*possible):
        if list(codes) == own:
            continue
        _restore_mode(system, place, before)
        for switch, code in zip(opened, codes, strict=True):
            set_switch(system, place, switch, code)
        yield _expand_germs(system, place)


def _is_valid(system: ModeSystem, place: PieceStart, how: MultiplierSolver) -> bool:
    return not (system.rows_off_zero(how) or list(_violated_conditions(system, place, how)))


def jump_impulse(system: ModeSystem, place: PieceStart) -> np.ndarray | None:
    """The impulse p (m,) after which x + g_l p can go on; None where there is none, or g_l or h_l, h_x move.

    x+ - x = g_l p, y+ = h(t, x+) with -y+ in the normal cone at p of what K recedes to: a step of length 0. The index set is that
    of a very short step, p its limit.
    """
    B, D, C = system.B, system.D, system.C
    if B is None or D is None or C is None:
        return None
    system.expand(place.t, place.x, place.codes, place.tau, 1)
    y = np.array(system.parts["h"].order(0))
    law = numeric_law(system.problem.law)
    box = np.array([not system.blocks.is_curved(i) for i in range(system.m)], bool)
    lower, upper = (np.where(np.isinf(end) & box, end, 0.0) for end in (law.lower, law.upper))
    cone = NumericLaw(lower, upper, ())
    W, start = D / (TINY_STEP * place.tau) + C @ B, np.zeros(system.m)
    found = mlcp.solve_mlcp(
        W, y, cone, start, np.array(place.codes, np.int8), (mlcp.INDEX_SET, mlcp.LEMKE, mlcp.ENUMERATION), False, 1e-6
    )
    if not np.isfinite(found.residual):
        return None
    active = [i for i in range(system.m) if found.index[i] == 0 and cone.lower[i] < cone.upper[i]]
    through = multiplier_solver(tuple(active), B, D, C).through
    p = np.zeros(system.m)
    if through is not None:
        p[active] = -np.array(through) @ y[active]
    return (
        p
        if p.any()
        and (p >= cone.lower - P_ROUNDING * np.abs(p).max()).all()
        and (p <= cone.upper + P_ROUNDING * np.abs(p).max()).all()
        else None
    )


def uniqueness_verdict(system: ModeSystem, place: PieceStart) -> tuple[str, str]:
    """(PROVED, AGREE, UNDECIDED or SPLIT, words for two valid modes that go apart).

    It is proved where the open rows' matrix, the others held or let go as they are, is a P-matrix (Cottle, Pang and Stone 1992,
    Theorem 3.3.7), of curved blocks a definite one, and g and h are affine in these multipliers together, or the model is
    monotone (`multipliers.is_monotone`), and nothing but rows is open; else all modes of the open switches are tried, where these
    are few. Their x is known to rounding of its size so far, and of what l pushes it by: in stick f takes that back. It is not
    decided where one of them holds coupled rows: Newton's method finds one of its l, or none, and another may be valid.
    The first orders of the mode at the place stand, before and after.
    """
    opened = [i for kind, i in sorted(place.open) if kind == ROW]
    rows = [row for i in opened for row in system.blocks.rows_of(i)]
    if len(opened) == len(place.open) and (system.is_p_matrix(rows, place.codes) or system.is_monotone):
        return PROVED, ""
    if len(place.open) > FEW:
        return UNDECIDED, ""
    before, codes = _mode_state(system, place), [_switch_code(system, place, switch) for switch in sorted(place.open)]
    own, pushed, share = [row[: ORDERS + 1] for row in system.x], system.pushed(), germ_time_share(system, germ_rounding(system))
    l, verdict = [row[0] for row in system.l], UNDECIDED if _holds_coupled_rows(system, place) else AGREE
    for how in _all_modes(system, place, before, codes):
        if _holds_coupled_rows(system, place):
            verdict = UNDECIDED
        if how is None or not _is_valid(system, place, how):
            continue
        its = min(share, germ_time_share(system, germ_rounding(system)))
        rounding = [TIE * (max(both) + size) for *both, size in zip(pushed, system.pushed(), system.sizes.x, strict=True)]
        other, valid = [row[: ORDERS + 1] for row in system.x], list(place.codes)
        differ = [i for i, (a, b) in enumerate(zip(own, other, strict=True)) if germs_differ(a, b, its, rounding[i])]
        if not differ:
            continue
        errors = _state_rounding(system)
        _take_up_mode(system, place, before, l)
        errors += _state_rounding(system)
        if any(germs_differ(own[i], other[i], its, rounding[i], errors[i]) for i in differ):
            return SPLIT, f"{before[0]} and {valid}"
    _take_up_mode(system, place, before, l)
    return verdict, ""


def _take_up_mode(system: ModeSystem, place: PieceStart, before: tuple, l: list[float]) -> None:
    """Go back to a mode whose l begin with these."""
    _restore_mode(system, place, before)
    for row, guess in zip(system.l, l, strict=True):
        row[0] = guess
    _expand_germs(system, place)


def _state_rounding(system: ModeSystem) -> np.ndarray:
    """What rounding leaves open of the coefficients of x (n, ORDERS + 1), to first order at the place; balls say nothing."""
    if system.blocks.all or system.how is None:
        return np.zeros((system.n, ORDERS + 1))
    return np.nan_to_num(system.rounding(ORDERS)[0], nan=0.0, posinf=0.0)


def _holds_coupled_rows(system: ModeSystem, place: PieceStart) -> bool:
    return system.are_coupled([i for i, code in enumerate(place.codes) if code == 0])


def germ_time_share(system: ModeSystem, known: GermRounding) -> float:
    """The share of the unit of time in which coefficients of x, l and l'S l do not grow from order to order: that of germs.

    What is ``known`` to be rounding is none.

    In a unit that is longer than a mode's own time the first coefficients would seem rounding beside the last. Where they are, a
    row begins beyond them, and tells no time.
    """
    share, watched = 1.0, [block for block in system.blocks.all if block.curved is not None]
    inner = [block.inner for block in watched], [block.quadric[1] for block in watched]
    for acts, rows, sizes in (("x", system.x, system.sizes.x), ("l", system.l, system.sizes.l), ("inside", *inner)):
        for i, (row, so_far) in enumerate(zip(rows, sizes, strict=True)):
            if acts in known and not any((row := without_rounding(row, known[acts][i]))[1 : HALF_ORDERS + 1]):
                continue
            last = row[HALF_ORDERS + 1 : ORDERS + 1]
            if share == 1 and max(last) <= so_far and min(last) >= -so_far:
                continue
            own = list(map(abs, row[1 : ORDERS + 1]))
            first = max(so_far, *own[:HALF_ORDERS])
            if (share == 1 and max(own[HALF_ORDERS:]) <= first) or (acts == "x" and first <= TERM_ROUNDING * system.pushed()[i]):
                continue
            share = shrink_time_share(row, so_far, share)
    return share


def _pivot_to_valid_mode(system: ModeSystem, place: PieceStart) -> MultiplierSolver | None:
    seen, one_at_a_time = set(), False
    for iteration in range(PIVOTS):
        how = _expand_germs(system, place)
        if how is None:
            if not _leave_singular_mode(system, place):
                return None
            continue
        off_zero = system.rows_off_zero(how)
        for i in off_zero:
            own = system.blocks.rows_of(i)
            place.open.add((ROW, own[0]))
            if len(own) > 1:
                set_switch(system, place, (ROW, own[0]), 1)
                continue
            place.codes[i] = -1 if system.y[i][0] > 0 else 1
            if not np.isfinite(system.lower[i] if place.codes[i] < 0 else system.upper[i]):
                return None
        if off_zero:
            continue
        wrong = list(_violated_conditions(system, place, how))
        if not wrong:
            return how
        mode = (tuple(place.codes), *(tuple(part.choice) for part in system.parts.values()))
        one_at_a_time |= mode in seen or iteration >= TOGETHER
        seen.add(mode)
        for condition in wrong[:1] if one_at_a_time else wrong:
            place.open.add(condition.of)
            set_switch(system, place, condition.of, condition.after)
    return None


def _expand_germs(system: ModeSystem, place: PieceStart) -> MultiplierSolver | None:
    how = system.expand(place.t, place.x, place.codes, place.tau, ORDERS)
    for _ in system.nested:
        if how is None or not _follow_other_switches(system):
            break
        how = system.expand(place.t, place.x, place.codes, place.tau, ORDERS)
    return None if how is None or any(any(map(math.isnan, row[: ORDERS + 1])) for row in (*system.x, *system.y)) else how


def _follow_other_switches(system: ModeSystem) -> bool:
    """Leave open the switches whose argument jumps with what others choose, and does not move, where their side is not its own.

    So it is with a comparison of comparisons, was == (command > 0); whether there is one.
    """
    stale = [
        (part, i)
        for name, i in system.nested
        if not any((row := (part := system.parts[name]).rows[part.jets.branches[i].row])[1 : ORDERS + 1])
        and not _is_chosen(part.jets.branches[i].kind, part.choice[i], row[0])
    ]
    for part, i in stale:
        part.choice[i] = math.nan
    return bool(stale)


def _is_chosen(kind: str, choice: float, argument: float) -> bool:
    """Whether a comparison has the side of its argument; a whole number is left as it is."""
    side = float(argument > 0) - float(argument < 0)
    return kind not in ("side", "equal") or choice == (side or (0.0 if kind == "equal" else 1.0))


def _violated_conditions(system: ModeSystem, place: PieceStart, how: MultiplierSolver) -> Iterator[SwitchCondition]:
    """The conditions that do not hold just after the start: of those that are open or whose multipliers may have moved.

    Where l or what a branch chooses jumps, y and arguments may jump too: of the others those that are clearly broken.
    """
    rounding = germ_rounding(system)
    share = germ_time_share(system, rounding)
    for condition in mode_conditions(system, place.codes, how, ORDERS):
        if condition.of in place.crossed:
            continue
        known = known_to(condition, rounding)
        if condition.of in place.open or condition.acts in ("l", "inside"):
            c = condition.coefficients()
            first = leading_order(c, TIE * condition_scale(system, condition), share, known)
            if first != 1 and condition.acts not in ("l", "inside"):
                first = leading_order(c, condition_uncertainty(system, condition), share, known)
            if first is not None and c[first] < 0:
                yield condition
        elif (v := condition.sign * condition.row[0] + condition.shift) < 0 and (
            v < -max([TIE * condition_scale(system, condition), *known[:1]])
        ):
            yield condition


def is_germ_zero(system: ModeSystem, place: PieceStart, how: MultiplierSolver, condition: SwitchCondition) -> bool:
    """Whether the orders that decide a condition are rounding, all of them: it holds in the germ, whatever comes later."""
    germs = (one for one in mode_conditions(system, place.codes, how, ORDERS) if is_same_condition(one, condition))
    return all(leading_order(one.coefficients(), TIE * condition_scale(system, one), 1.0) is None for one in germs)


def germ_rounding(system: ModeSystem, orders: int = ORDERS) -> GermRounding:
    """What the coefficients of x, l and y are known to, a row each, of linear models; of others nothing."""
    if not (system.is_linear and system.analyses_rounding) or system.how is None:
        return {}
    return {acts: part.tolist() for acts, part in zip("xly", system.rounding(orders), strict=True)}


def known_to(condition: SwitchCondition, rounding: GermRounding) -> Sequence[float]:
    """What the coefficients of a condition are known to, of `germ_rounding`; () where nothing is said."""
    return rounding[condition.acts][condition.of[1]] if condition.acts in rounding else ()


def _leave_singular_mode(system: ModeSystem, place: PieceStart) -> bool:
    """Leave a singular mode: one of its open rows goes to an end, the one that its rate leads to."""
    for kind, i in sorted(place.open):
        if kind == ROW and place.codes[i] == 0 and len(ends := _switch_codes(system, (ROW, i))[1:]) > 0:
            led = -1 if system.y[i][1] > 0 else 1 if system.y[i][1] < 0 else ends[0]
            set_switch(system, place, (ROW, i), led if led in ends and not system.blocks.is_curved(i) else ends[0])
            return True
    return False


def _switch_codes(system: ModeSystem, switch: Switch) -> list[float]:
    kind, i = switch
    if kind == ROW:
        if system.blocks.is_curved(i):
            return [0, 1]
        ends = ((-1, system.lower[i]), (1, system.upper[i]))
        return [0, *(code for code, end in ends if np.isfinite(end))]
    choice, branch = system.parts[kind].choice[i], system.parts[kind].jets.branches[i]
    return [-1.0, 1.0] if branch.kind in ("side", "equal") else [choice, choice - 1, choice + 1]


def _possible_codes(system: ModeSystem, switch: Switch) -> list[float]:
    """The codes of a switch but those that y_i refuses: where no l acts on it directly, it has its sign in all modes."""
    kind, i = switch
    if kind != ROW or system.feedthrough[i] or abs(system.y[i][0]) <= NONZERO_SHARE * system.size_y(i):
        return _switch_codes(system, switch)
    return [code for code in _switch_codes(system, switch) if code * system.y[i][0] < 0]


def set_switch(system: ModeSystem, place: PieceStart, switch: Switch, code: float) -> None:
    """Give a switch another code."""
    kind, i = switch
    if kind == ROW:
        for row in system.blocks.rows_of(i):
            place.codes[row] = int(code)
    else:
        system.parts[kind].choice[i] = code


def _switch_code(system: ModeSystem, place: PieceStart, switch: Switch) -> float:
    kind, i = switch
    return place.codes[i] if kind == ROW else system.parts[kind].choice[i]


def _mode_state(system: ModeSystem, place: PieceStart) -> tuple:
    return list(place.codes), {name: list(part.choice) for name, part in system.parts.items()}, set(place.open)


def _restore_mode(system: ModeSystem, place: PieceStart, before: tuple) -> None:
    place.codes[:] = before[0]
    for name, choices in before[1].items():
        system.parts[name].choice[:] = choices
    place.open = set(before[2])


def _guess_modes(system: ModeSystem, place: PieceStart) -> Iterator[list[int]]:
    """Index sets of the germs' Laplace transforms at some large s: y^ = q^ + M(s) l^, linear in l^ (Heemels et al., eq. 6).

    s times the transform of a germ has its sign for all s from some s on; M(s) = h_l + h_x (s - (f + g)_x)^-1 g_l is psd where
    the system is passive. q^ is made of the germs of a mode in which no row is held.
    """
    if not system.m:
        return
    law, m = numeric_law(system.problem.law), system.m
    chain = (mlcp.INDEX_SET, mlcp.LEMKE, mlcp.ENUMERATION) if m <= FEW else (mlcp.INDEX_SET, mlcp.LEMKE)
    if law.curved:
        chain = (mlcp.SEMISMOOTH,)
    free = [code or 1 for code in place.codes]
    if system.expand(place.t, place.x, free, place.tau, ORDERS) is None:
        return
    y, l = np.array(system.y)[:, : ORDERS + 1], np.array([row[0] for row in system.l])
    orders, (B, D, C), A = np.arange(ORDERS + 1), system.slopes(), system.rate_slopes()
    for share in LAPLACE_SHARES:
        h = share * place.tau
        W = D + h * (C @ np.linalg.solve(np.eye(system.n) - h * A, B))
        q = y @ (FACTORIALS * share**orders) - W @ l
        found = mlcp.solve_mlcp(W, q, law, l, np.array(place.codes, np.int8), chain, False, GUESS_RESIDUAL)
        if np.isfinite(found.residual):
            yield [int(code) for code in found.index]


MAX_NAMED_SWITCHES = 4  # Switches that an error names.


def switch_name(of: Switch, rows: Sequence[str]) -> str:
    """A row's own name, or where the branch is."""
    return rows[of[1]] if of[0] == ROW else f"a switch in {of[0]}"


UNDECIDED_FIELDS = ("count", "t", "width", "of", "crosses")  # See `undecided`.


def describe_undecided(record: Sequence[float], rows: Sequence[str], parts: Sequence[str]) -> dict[str, Any]:
    """Events and dips that are not known to rtol: how many, and of the first its time, for how long, of what, whether an event.

    Args:
        record: as numbers; of what: a row, or behind the rows a branch.
        rows: the names of rows.
        parts: of each branch the part that has it.
    """
    found = dict(zip(UNDECIDED_FIELDS, record, strict=True))
    i = int(found["of"])
    of = rows[i] if i < len(rows) else f"a switch in {parts[i - len(rows)]}" if parts else ""
    return found | {"count": int(found["count"]), "of": of, "crosses": bool(found["crosses"])}


def list_switch_names(switches: Iterable[Switch], rows: Sequence[str]) -> str:
    """The names of switches, a few of many; "" of none."""
    names = list(dict.fromkeys(switch_name(of, rows) for of in sorted(switches, key=lambda of: (of[0] != ROW, of))))
    more = f" and {len(names) - MAX_NAMED_SWITCHES} more" if len(names) > MAX_NAMED_SWITCHES else ""
    return ", ".join(names[:MAX_NAMED_SWITCHES]) + more
