"""What the functions of every C library return and whose answer a step is: each number means one thing, whatever the model."""

from __future__ import annotations

from typing import NamedTuple


class Status(NamedTuple):
    """A status: its name in C, what it means, and what to do."""

    name: str
    meaning: str
    advice: str = ""

    @property
    def text(self) -> str:
        """In words."""
        return ": ".join(filter(None, self[1:]))


STATUSES = (
    Status("OK", "done"),
    Status(
        "NOT_SOLVED",
        "no answer passed the certificate within the work allowed",
        "the step may have no solution (closing walls? an empty set?): try a smaller one",
    ),
    Status("NOT_FINITE", "a state, time, step, parameter, velocity or constraint is NaN or infinite, or the step overflows"),
    Status("BAD_STEP", "the time step is not one that this code takes, goes over a tick, or is so small that t + h is t"),
    Status("BAD_PARAMETER", "the parameters give the law empty bounds or other infinite ones, or no finite start"),
    Status("NO_ROOM", "more constraints act at once than there is room for", "compile with a larger MODEL_MEMORY"),
    Status("NOT_INITIALISED", "the solver was not initialised", "call model_init first"),
    Status("BAD_INDEX", "an index is out of bounds"),
    Status(
        "BAD_ARITHMETIC", "the compiler was let to change sums or to leave out NaN", "compile without -ffast-math and its parts"
    ),
    Status(
        "NO_MODE",
        "no mode is found in which a solution goes on, or there are several",
        "step over it in time, or set another state",
    ),
    Status("TOO_SHORT", "the equations are missed by more than rtol, however short a piece is"),
)
NO_ROOM, BAD_ARITHMETIC, BAD_PARAMETER, NOT_SOLVED, NO_MODE = (
    [status.name for status in STATUSES].index(name)
    for name in ("NO_ROOM", "BAD_ARITHMETIC", "BAD_PARAMETER", "NOT_SOLVED", "NO_MODE")
)

READY = 0x6E736D64  # What marks a solver that was initialised.
SOLVER_NAMES = (
    "none", "last index set", "index set", "lemke", "enumeration", "semismooth", "newton on the index set", "clip",
    "outer approximation", "none needed",
)  # fmt: skip


def solver_enum() -> str:
    """Whose answer a step is, as an enum of C."""
    return f"enum {{ {', '.join(name.upper().replace(' ', '_') for name in SOLVER_NAMES)} }};"


def status_enum() -> str:
    """The statuses as an enum of C, for a model called "model"."""
    lines = [
        f"    MODEL_{status.name} = {i}{',' if i + 1 < len(STATUSES) else ''} /* {status.meaning} */"
        for i, status in enumerate(STATUSES)
    ]
    return "\n".join(["enum {", *lines, "};"])


def status_cases() -> str:
    """The cases of a switch that returns the text of a status."""
    return "\n".join(f'    case MODEL_{status.name}:\n        return "{status.text}";' for status in STATUSES)
