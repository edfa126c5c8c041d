"""The structs that Python and C both read: each is a table, which prints the C and makes the ``ctypes.Structure``.

What the functions of every C library return and whose answer a step is: each number means one thing, whatever the model.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple


class Status(NamedTuple):
    """A status: its name in C, what it means, and what to do."""

    name: str
    meaning: str
    advice: str = ""

    @property
    def text(self) -> str:
        """The status in words."""
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
    Status(
        "BAD_PARAMETER",
        "a parameter is out of its range, or gives the law empty bounds or other infinite ones, or no finite start",
    ),
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
# Statuses by their numbers in C.
NO_ROOM, BAD_ARITHMETIC, BAD_PARAMETER, NOT_SOLVED, NO_MODE = (
    [status.name for status in STATUSES].index(name)
    for name in ("NO_ROOM", "BAD_ARITHMETIC", "BAD_PARAMETER", "NOT_SOLVED", "NO_MODE")
)

READY = 0x6E736D64  # What marks a solver that was initialised: the letters 'nsmd', which memory seldom holds by chance.
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


CTYPES: dict[str, Any] = {"double": ctypes.c_double, "int": ctypes.c_int, "long": ctypes.c_long}  # All others are pointers.


class StructMembers(NamedTuple):
    """Members of one kind, as a line of C: their names, each with its ``[size]`` where it is an array, and what they are."""

    kind: str
    names: str
    about: str = ""

    def c(self) -> str:
        """The declaration."""
        base, stars = re.fullmatch(r"(.*?)\s*(\*.*)?", self.kind).groups("")  # pyrefly: ignore[missing-attribute]
        listed = ", ".join(stars + name for name in self.names.split())
        return f"    {base} {listed};{f' /* {self.about} */' if self.about else ''}\n"

    def members(self, sizes: Mapping[str, int]) -> Iterator[tuple[str, Any]]:
        """Name and type of each member; ``sizes``: what the sizes that are no numbers are."""
        kind = CTYPES.get(self.kind, ctypes.c_void_p)
        for name, size in re.findall(r"(\w+)(?:\[(\S+)\])?", self.names):
            yield name, kind * (int(size) if size.isdigit() else sizes[size]) if size else kind


class CStruct(NamedTuple):
    """A struct of C: its name and its lines."""

    name: str
    lines: tuple[StructMembers, ...]

    def c(self) -> str:
        """The definition, for a model called "model"."""
        return f"typedef struct {{\n{''.join(line.c() for line in self.lines)}}} {self.name};"

    def ctypes_structure(self, **sizes: int) -> Any:
        """The same for ctypes."""
        fields = [member for line in self.lines for member in line.members(sizes)]
        return type(self.name, (ctypes.Structure,), {"_fields_": fields})


STEP_TOTALS = CStruct(
    "model_totals",
    (
        StructMembers("double", "worst newton newton_max", "residual, Newton iterations in all and in one step"),
        StructMembers(
            "double", "worst_step changes", "the step with the worst residual, from 1; how often the index set changed"
        ),
        StructMembers("double", "least", "eigenvalue of W + W' so far, scaled as in Python; -inf: not looked at"),
        StructMembers("double", f"counts[{len(SOLVER_NAMES)}]", "steps by solver"),
        StructMembers("double", "status", "of the step that ended the block; MODEL_OK: all steps are taken, or the time is over"),
    ),
)
ADAPTIVE_CONTROL = CStruct(
    "model_control",
    (
        StructMembers("double", "T start length rtol largest least crossing grow",
             "the end of the run, a span between known times, the constants of controlled.py; j between largest and least"),
        StructMembers("double", "order", "of the scheme on one index set, but for rows that are held and lower it to 1"),
        StructMembers("double", "t j fresh", "time in length/2^(least + 1), the step length/2^j; fresh: no step has been taken"),
        StructMembers("double", "looser no_jump", "how many times what is allowed a step may err by; whether the least one too"),
        StructMembers("double", "accepted rejected extrapolated at_least_step least_step"),
        StructMembers("double", "estimate of_j", "the sum of errors; j of the last d"),
        StructMembers("double", "x[STATES] l[ROWS] index[ROWS] lowering[ROWS] wall[ROWS]"),
        StructMembers("double", "atol[WATCHED] size[WATCHED] group[WATCHED] part[WATCHED] unit[WATCHED]"),
        StructMembers("double", "watched[WATCHED] rate[WATCHED] d[WATCHED]"),
    ),
)  # fmt: skip
BATCH_CELLS = CStruct(
    "model_cells",
    (
        StructMembers("long", "cells steps every", "runs, steps of each, every how many one is kept"),
        StructMembers("long", "rows first width", "kept of a run, of which some are known before a step; columns of each"),
        StructMembers("double", "last", "length of the last step, where times are multiples of the step"),
        StructMembers("const double *", "times lengths", "of all steps, or NULL"),
        StructMembers("const double *", "values", "(cells, NP)"),
        StructMembers("const double *", "inputs", "(steps, 2 INPUTS) at both ends of each step"),
        StructMembers("const long *", "jumps", "the steps that begin with a jump of an input"),
        StructMembers("long", "jumping", "how many"),
        StructMembers("const long *", "columns", "(width) of a packed row, which are kept"),
        StructMembers("double *", "whole kept", "a packed row; (cells, rows, width)"),
        StructMembers("signed char *", "index", "(cells, rows, M), or NULL"),
        StructMembers("signed char *", "status", "(cells) -1: to do; what is something else is left as it is"),
        StructMembers("double *", "taken worst changes newton failed_at", "(cells) of each"),
        StructMembers("long", "cell step row next jump", "where the batch stands: step -1 is before the start of a cell"),
    ),
)
RUN_REQUEST = CStruct(
    "model_asked",
    (
        StructMembers("double", "rtol"),
        StructMembers("const double *", "atol", "(N)"),
        StructMembers("const double *", "known data", "known times, 0 the first, and what is held after each"),
        StructMembers("long", "knowns residuals", "how many; see the struct of a solver"),
    ),
)
PIECE_BATCH_CELLS = CStruct(
    "model_piece_cells",
    (
        StructMembers(
            "long", "cells rows more most", "runs; rows of each; if these have more than x and l; pieces of a run, at most"
        ),
        StructMembers("double", "t_end"),
        StructMembers("const double *", "times values starts", "(rows) increasing; (cells, NP); (cells, N)"),
        StructMembers("double *", "kept", "(cells, rows, ROW_WIDTH)"),
        StructMembers("signed char *", "index", "(cells, rows, M)"),
        StructMembers("signed char *", "status", "(cells) -1: to do; what is something else is left as it is"),
        StructMembers("double *", "taken pieces events estimate worst failed_at", "(cells) of each"),
        StructMembers(
            "long", "cell row made begun", "where the batch stands: in a cell with so many rows and pieces, if it has begun"
        ),
        StructMembers("double", "defect", "the largest since the last row"),
        StructMembers("double *", "until told", "(M) integrals of l: to the end of the pieces, to the last row"),
        StructMembers("double *", "slopes tangents", "(cells, rows, N + M, BY) dx/dp and dl/dp; memory for these; or NULL"),
    ),
)
BODIES_MOTION = CStruct(
    "model_motion",
    (
        StructMembers("const model_functions *", "model"),
        StructMembers("double", "t h tolerance"),
        StructMembers("int", "n"),
        StructMembers("const double *", "q", "(n, DIM)"),
        StructMembers("const unsigned char *", "present", "(n)"),
        StructMembers("const double *", "velocity", "(n, DIM) f, where it is given from outside; else NULL"),
        StructMembers("const double *", "numbers", "(n, NUMBERS)"),
        StructMembers("const double *const *", "items", "for each family, its items' numbers"),
        StructMembers("const int *", "item_count"),
        StructMembers("const int *const *", "over", "for each family, the pairs it runs over (2 each), or NULL: all"),
        StructMembers("const int *", "over_count"),
        StructMembers("const double *", "farthest",
             "for each family the largest c of g = |q_i - q_j| - c; negative: another kind"),
        StructMembers("const double *const *", "halves",
             "for each such family (n) numbers with c_ij <= half_i + half_j, which serve for the largest c; NULL: half of it"),
        StructMembers("const double *", "p"),
        StructMembers("long", "budget", "the most work"),
        StructMembers("double", "motion", "the largest |d_i| of the last step; 0: unknown"),
        StructMembers("int", "contacts", "of the last step: rows with m > 0"),
        StructMembers("const int *", "family first second"),
        StructMembers("const double *", "multiplier"),
        StructMembers("double *", "q_next", "from here on what the step gives"),
        StructMembers("unsigned char *", "leaves", "(n) who leaves after the step; NULL: not asked"),
        StructMembers("int", "contacts_out", "as those of the last step; they lie in the memory given"),
        StructMembers("int *", "family_out first_out second_out"),
        StructMembers("double *", "multiplier_out"),
    ),
)  # fmt: skip
BODIES_REPORT = CStruct(
    "model_report",
    (
        StructMembers("double", "residual gap motion cutoff"),
        StructMembers("int", "worst_family worst_first worst_second"),
        StructMembers("int", "rows groups largest factorisations repeats"),
        StructMembers("int", "by_active_set by_interior unsettled"),
        StructMembers("long", "work", "linear systems factored or solved"),
    ),
)
TIMED_BODIES_REPORT = BODIES_REPORT._replace(
    lines=(*BODIES_REPORT.lines, StructMembers("double", "search assembly solve", "CPU seconds"))
)
