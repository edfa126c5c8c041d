"""The structs that Python and C both read: each is a table, which prints the C and makes the ``ctypes.Structure``."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from nsmodel.codegen.statuses import SOLVERS

KINDS: dict[str, Any] = {"double": ctypes.c_double, "int": ctypes.c_int, "long": ctypes.c_long}  # All others are pointers.


class Members(NamedTuple):
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
        kind = KINDS.get(self.kind, ctypes.c_void_p)
        for name, size in re.findall(r"(\w+)(?:\[(\S+)\])?", self.names):
            yield name, kind * (int(size) if size.isdigit() else sizes[size]) if size else kind


class Struct(NamedTuple):
    """A struct of C: its name and its lines."""

    name: str
    lines: tuple[Members, ...]

    def c(self) -> str:
        """The definition, for a model called "model"."""
        return f"typedef struct {{\n{''.join(line.c() for line in self.lines)}}} {self.name};"

    def in_python(self, **sizes: int) -> Any:
        """The same for ctypes."""
        fields = [member for line in self.lines for member in line.members(sizes)]
        return type(self.name, (ctypes.Structure,), {"_fields_": fields})


TOTALS = Struct(
    "model_totals",
    (
        Members("double", "worst newton newton_max", "residual, Newton iterations in all and in one step"),
        Members("double", "worst_step changes", "the step with the worst residual, from 1; how often the index set changed"),
        Members("double", "least", "eigenvalue of W + W' so far, scaled as in Python; -inf: not looked at"),
        Members("double", f"counts[{len(SOLVERS)}]", "steps by solver"),
        Members("double", "status", "of the step that ended the block; MODEL_OK: all steps are taken, or the time is over"),
    ),
)
CONTROL = Struct(
    "model_control",
    (
        Members("double", "T start length rtol largest least crossing grow",
             "the end of the run, a span between known times, the constants of controlled.py; j between largest and least"),
        Members("double", "order", "of the scheme on one index set, but for rows that are held and lower it to 1"),
        Members("double", "t j fresh", "time in length/2^(least + 1), the step length/2^j; fresh: no step has been taken"),
        Members("double", "looser no_jump", "how many times what is allowed a step may err by; whether the least one too"),
        Members("double", "accepted rejected extrapolated at_least_step least_step"),
        Members("double", "estimate of_j", "the sum of errors; j of the last d"),
        Members("double", "x[STATES] l[ROWS] index[ROWS] lowering[ROWS] wall[ROWS]"),
        Members("double", "atol[WATCHED] size[WATCHED] group[WATCHED] part[WATCHED] unit[WATCHED]"),
        Members("double", "watched[WATCHED] rate[WATCHED] d[WATCHED]"),
    ),
)  # fmt: skip
CELLS = Struct(
    "model_cells",
    (
        Members("long", "cells steps every", "runs, steps of each, every how many one is kept"),
        Members("long", "rows first width", "kept of a run, of which some are known before a step; columns of each"),
        Members("double", "last", "length of the last step, where times are multiples of the step"),
        Members("const double *", "times lengths", "of all steps, or NULL"),
        Members("const double *", "values", "(cells, NP)"),
        Members("const double *", "inputs", "(steps, 2 INPUTS) at both ends of each step"),
        Members("const long *", "jumps", "the steps that begin with a jump of an input"),
        Members("long", "jumping", "how many"),
        Members("const long *", "columns", "(width) of a packed row, which are kept"),
        Members("double *", "whole kept", "a packed row; (cells, rows, width)"),
        Members("signed char *", "index", "(cells, rows, M), or NULL"),
        Members("signed char *", "status", "(cells) -1: to do; what is something else is left as it is"),
        Members("double *", "taken worst changes newton failed_at", "(cells) of each"),
        Members("long", "cell step row next jump", "where the batch stands: step -1 is before the start of a cell"),
    ),
)
ASKED = Struct(
    "model_asked",
    (
        Members("double", "rtol"),
        Members("const double *", "atol", "(N)"),
        Members("const double *", "known data", "known times, 0 the first, and what is held after each"),
        Members("long", "knowns residuals", "how many; see the struct of a solver"),
    ),
)
PIECE_CELLS = Struct(
    "model_piece_cells",
    (
        Members("long", "cells rows more most", "runs; rows of each; if these have more than x and l; pieces of a run, at most"),
        Members("double", "t_end"),
        Members("const double *", "times values", "(rows) increasing; (cells, NP)"),
        Members("double *", "kept", "(cells, rows, ROW_WIDTH)"),
        Members("signed char *", "index", "(cells, rows, M)"),
        Members("signed char *", "status", "(cells) -1: to do; what is something else is left as it is"),
        Members("double *", "taken pieces events estimate worst failed_at", "(cells) of each"),
        Members("long", "cell row made begun", "where the batch stands: in a cell with so many rows and pieces, if it has begun"),
        Members("double", "defect", "the largest since the last row"),
        Members("double *", "until told", "(M) integrals of l: to the end of the pieces, to the last row"),
    ),
)
MOTION = Struct(
    "model_motion",
    (
        Members("const model_functions *", "model"),
        Members("double", "t h tolerance"),
        Members("int", "n"),
        Members("const double *", "q", "(n, DIM)"),
        Members("const unsigned char *", "present", "(n)"),
        Members("const double *", "velocity", "(n, DIM) f, where it is given from outside; else NULL"),
        Members("const double *", "numbers", "(n, NUMBERS)"),
        Members("const double *const *", "items", "for each family, its items' numbers"),
        Members("const int *", "item_count"),
        Members("const int *const *", "over", "for each family, the pairs it runs over (2 each), or NULL: all"),
        Members("const int *", "over_count"),
        Members("const double *", "farthest", "for each family the largest c of g = |q_i - q_j| - c; negative: another kind"),
        Members("const double *const *", "halves",
             "for each such family (n) numbers with c_ij <= half_i + half_j, which serve for the largest c; NULL: half of it"),
        Members("const double *", "p"),
        Members("long", "budget", "the most work"),
        Members("double", "motion", "the largest |d_i| of the last step; 0: unknown"),
        Members("int", "contacts", "of the last step: rows with m > 0"),
        Members("const int *", "family first second"),
        Members("const double *", "multiplier"),
        Members("double *", "q_next", "from here on what the step gives"),
        Members("unsigned char *", "leaves", "(n) who leaves after the step; NULL: not asked"),
        Members("int", "contacts_out", "as those of the last step; they lie in the memory given"),
        Members("int *", "family_out first_out second_out"),
        Members("double *", "multiplier_out"),
    ),
)  # fmt: skip
REPORT = Struct(
    "model_report",
    (
        Members("double", "residual gap motion cutoff"),
        Members("int", "worst_family worst_first worst_second"),
        Members("int", "rows groups largest factorisations repeats"),
        Members("int", "by_active_set by_interior unsettled"),
        Members("long", "work", "linear systems factored or solved"),
    ),
)
TIMED_REPORT = REPORT._replace(lines=(*REPORT.lines, Members("double", "search assembly solve", "CPU seconds")))
