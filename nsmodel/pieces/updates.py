"""What blocks that act after each step set when a condition of theirs changes; and what the new data leaves undecided."""

from __future__ import annotations

import math

from nsmodel.errors import StepError
from nsmodel.pieces.lengths import initial_time_unit
from nsmodel.pieces.modes import ORDERS, PieceStart
from nsmodel.pieces.switches import all_switches, is_condition_zero, mode_conditions
from nsmodel.pieces.system import ModeSystem

AROUND = 4  # Order of the expansions at an event.


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


def update_blocks(system: ModeSystem, place: PieceStart) -> bool:
    """Set what blocks hold to what they set it to in the mode just chosen; whether that was something else.

    Raises:
        StepError: what a block sets moves with time.
    """
    p, updates = system.problem, system.parts.get("blocks")
    if updates is None:
        return False
    before = [place.x[i] for i in p.updated]
    for i, row in zip(p.updated, updates.outputs, strict=True):
        place.x[i] = row[0]
    if [place.x[i] for i in p.updated] != before:
        # The unit of the motion before may be so long that beside its coefficients what is far from a switch seems rounding.
        place.tau = min(place.tau, initial_time_unit(system, place.t, place.x, place.tau))
        reinitialise(system, place)
        return True
    for k, row in enumerate(updates.outputs):
        if any(row[1 : ORDERS + 1]):
            raise StepError(
                f"t = {place.t:.10g}: block '{p.updaters[k]}' sets {p.names[p.updated[k]]} to what moves with time, not at "
                "switches alone; give it a period (sampled)"
            )
    return False
