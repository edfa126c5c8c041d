"""How a place is moved where a piece has ended: back to y = 0, and on to where a block stands.

What blocks that act after each step set when a condition of theirs changes; and what the new data leaves undecided.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from nsmodel.errors import StepError
from nsmodel.event_driven.bernstein import ORDERS
from nsmodel.event_driven.modes import ROW, PieceStart, all_switches, is_condition_zero, mode_conditions, set_switch
from nsmodel.event_driven.multipliers import TERM_ROUNDING, TIE, generalised_inverse, least_motion
from nsmodel.event_driven.step_size import initial_time_unit
from nsmodel.event_driven.system import ModeSystem

PROJECTIONS = 3  # Iterations of the projection of x onto y = 0, at most: each squares what pieces have left of rtol. (~)


def project_to_held_rows(system: ModeSystem, place: PieceStart, rows: tuple[int, ...]) -> bool:
    """Move x so that what no l acts on directly is 0 in ``rows``, by Newton's method along the least motion; whether it moved.

    Where y is rounding x moves by no more: rows that are nearly parallel would move it by many times that. What stands then is
    order 1 of the expansion there.
    """
    a = list(rows)
    for iteration in range(PROJECTIONS):
        y = [system.y[i][0] for i in a]
        if not any(y):
            return iteration > 0
        free, slope, terms = system.cached_from_slopes(("held", rows), lambda _, D, C: _held_row_matrices(a, D, C), "DC")
        held = free @ y
        if not held.any():
            return iteration > 0
        motion = least_motion(slope, held)
        at = [abs(row[0]) for rows_of in (system.x, system.push) for row in rows_of]
        if (np.abs(y) <= TERM_ROUNDING * (terms @ at)).all():
            if any(abs(d) > TIE * max(both) for d, *both in zip(motion.tolist(), at, system.sizes.x, strict=False)):
                return iteration > 0
        place.x = [x - d for x, d in zip(place.x, motion.tolist(), strict=True)]
        system.expand(place.t, place.x, place.codes, place.tau, 1)
    return True


def coast_to_stop(system: ModeSystem, place: PieceStart, time: float) -> None:
    """Go on to where the speed of a block at its threshold would be 0: nothing but its first term means anything so near."""
    d = time / place.tau
    place.x = [row[0] + d * row[1] for row in system.x]
    place.pass_time(time)


def stick_released_blocks(system: ModeSystem, place: PieceStart) -> None:
    """Open the blocks that slip with y = 0, as their rows came to 0 with others, and let them begin with stick."""
    for block in system.blocks.onset_blocks:
        place.open.add((ROW, block.first))
        set_switch(system, place, (ROW, block.first), 0)


def _held_row_matrices(a: list[int], D: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of rows a: what takes of y what no l acts on directly, by what x moves that, and the sizes that y is the sum of.

    Of rows that are the same the difference is rounding, in y and in C, and their quotient would be any motion.
    """
    free = _left_null_space(D[np.ix_(a, a)].tobytes(), len(a)).T
    slope = free @ C[a]
    slope[np.abs(slope) <= TIE * (np.abs(free) @ np.abs(C[a]))] = 0.0
    return free, slope, np.abs(np.hstack([C[a], D[a]]))


@lru_cache(maxsize=64)
def _left_null_space(D: bytes, rows: int) -> np.ndarray:
    """The left null space of D."""
    return generalised_inverse(np.frombuffer(D).reshape(rows, rows)).left


AROUND = 4  # Order of the expansions at an event: what they leave of a distance NEAR is its fifth power.


def reset_branch_choices(system: ModeSystem) -> None:
    """Let the value at order 0 choose the sides of all branches."""
    for part in system.parts.values():
        part.choice[:] = [math.nan] * len(part.choice)


def reinitialise(system: ModeSystem, place: PieceStart) -> None:
    """Open the switches that the data at the place leaves undecided."""
    system.sizes.x[:] = [max(size, abs(x)) for size, x in zip(system.sizes.x, place.x, strict=True)]
    reset_branch_choices(system)
    how = system.expand(place.t, place.x, place.codes, place.tau, AROUND)
    if how is None:
        place.open = all_switches(system)
    else:
        place.open = {c.of for c in mode_conditions(system, place.codes, how, AROUND) if is_condition_zero(system, c)}


def update_blocks(system: ModeSystem, place: PieceStart, acting: Sequence[int]) -> bool:
    """Set what some blocks hold to what they set it to in the mode just chosen, from the old values; whether that is another."""
    p, before = system.problem, list(place.x)
    for k, rows in enumerate(p.block_parts.values()):
        for row, of in zip(system.updates[k].outputs, rows, strict=True):
            if k in acting:
                place.x[p.updated[of]] = row[0]
    if place.x == before:
        return False
    # The unit of the motion before may be so long that beside its coefficients what is far from a switch seems rounding.
    sizes = [max(size, abs(x)) for size, x in zip(system.sizes.x, place.x, strict=True)]
    place.tau = min(place.tau, initial_time_unit(system, place.t, place.x, place.tau, sizes))
    reinitialise(system, place)
    return True


def check_what_blocks_set(system: ModeSystem, t: float) -> None:
    """Refuse what moves between switches: StepError names the block."""
    p = system.problem
    for part, (name, rows) in zip(system.updates, p.block_parts.items(), strict=True):
        for row, of in zip(part.outputs, rows, strict=True):
            if any(row[1 : ORDERS + 1]):
                raise StepError(
                    f"t = {t:.10g}: {name} sets {p.names[p.updated[of]]} to what moves with time, not at switches alone; "
                    "give it a period (sampled)"
                )
