"""The recurrences of `pieces.jets` as C: a function that computes order k of all rows."""

from __future__ import annotations

from pathlib import Path

from nsmodel import pieces
from nsmodel.codegen.expression import c_number
from nsmodel.pieces.jets import TaylorRecurrences
from nsmodel.pieces.printed import Dialect, higher_order_statements, order_0_statements

C_DIALECT = Dialect(
    row="N[{}]".format,
    number=lambda value: c_number(value).text,
    either="{0} ? {1} : {2}".format,
    both="{0} != 0 && {1} != 0",
    one="{0} != 0 || {1} != 0",
    positive="{0} > 0",
    ratio="{0}/{1}",
    end=";",
    kept="{0}",
    choose="if (choice[{i}] != choice[{i}]) choice[{i}] = {value};",
    choices={
        "side": "{0} < 0 ? -1 : 1",
        "equal": "({0} > 0) - ({0} < 0)",
        "floor": "floor({0})",
        "ceil": "ceil({0})",
        "toward zero": "trunc({0})",
        "nearest": "nearbyint({0})",
    },
)


def recurrence_kernels(stride: str = "1") -> str:
    """The recurrences themselves, once for all functions; ``stride``: how far apart the orders of a row are."""
    return f"#define STRIDE {stride}\n" + Path(pieces.__file__).with_name("series.c").read_text(encoding="utf-8")


def recurrence_function(jets: TaylorRecurrences, name: str, width: int) -> str:
    """``static void name(double (*N)[width], double *choice, int k)``; rows of inputs are the caller's, as are the choices.

    A choice that is not a number is made at order 0.
    """
    numbers = [f"N[{row}][0] = {c_number(value).text};" for row, value in jets.numbers.items()]
    lines = [
        "if (k == 0) {",
        *(f"    {line}" for line in numbers + order_0_statements(jets, C_DIALECT)),
        "    return;",
        "}",
        *higher_order_statements(jets, C_DIALECT),
    ]
    unused = "" if jets.branches else "    (void)choice;\n"
    body = "\n".join(f"    {line}" for line in lines)
    return f"static void {name}(double (*N)[{width}], double *choice, int k)\n{{\n{unused}{body}\n}}\n"
