"""The structs that Python and C both read: each is a table, which prints the C and makes the ``ctypes.Structure``."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from nsmodel.codegen.statuses import SOLVER_NAMES

CTYPES: dict[str, Any] = {"double": ctypes.c_double, "int": ctypes.c_int, "long": ctypes.c_long}  # All others are pointers.


class StructMembers(NamedTuple):
    """Members of one kind, as a line of C: their names, each with its ``[size]`` where it is an array, and what they are."""

    kind: str
    names: str
    about: str = ""

    def c(self) -> str:
        """The declaration."""
        base, stars = re.fullmatch(r"(.*?)\s*(\*.*)?", self.kind).groups("")  # pyright: ignore[reportOptionalMemberAccess]
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
        StructMembers("const double *", "times values", "(rows) increasing; (cells, NP)"),
        StructMembers("double *", "kept", "(cells, rows, ROW_WIDTH)"),
        StructMembers("signed char *", "index", "(cells, rows, M)"),
        StructMembers("signed char *", "status", "(cells) -1: to do; what is something else is left as it is"),
        StructMembers("double *", "taken pieces events estimate worst failed_at", "(cells) of each"),
        StructMembers(
            "long", "cell row made begun", "where the batch stands: in a cell with so many rows and pieces, if it has begun"
        ),
        StructMembers("double", "defect", "the largest since the last row"),
        StructMembers("double *", "until told", "(M) integrals of l: to the end of the pieces, to the last row"),
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
