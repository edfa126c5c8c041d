"""The recurrences of `pieces.jets` as C: a function that computes order k of all rows."""

from __future__ import annotations

from pathlib import Path

from nsmodel import pieces
from nsmodel.codegen.expression import number
from nsmodel.pieces.jets import Branch, Jets, Line

_CHOICES = {
    "side": "{row} < 0 ? -1 : 1",
    "equal": "({row} > 0) - ({row} < 0)",
    "floor": "floor({row})",
    "ceil": "ceil({row})",
    "toward zero": "trunc({row})",
    "nearest": "nearbyint({row})",
}
_LINEAR = {"sum": "{0} + {1}", "difference": "{0} - {1}", "minus": "-{0}", "scaled": "{number}*{0}", "over": "{0}/{number}"}
_LOGIC = {"both": "{0} != 0 && {1} != 0", "either": "{0} != 0 || {1} != 0", "not": "{0} == 0"}


def kernels() -> str:
    """The recurrences themselves, once for all functions."""
    return Path(pieces.__file__).with_name("series.c").read_text(encoding="utf-8")


def text(jets: Jets, name: str, width: int) -> str:
    """``static void name(double (*N)[width], double *choice, int k)``; rows of inputs are the caller's, as are the choices.

    A choice that is not a number is made at order 0.
    """
    lines: list[str] = []
    if jets.numbers:
        lines.append("if (k == 0) {")
        lines += [f"    N[{row}][0] = {number(value).text};" for row, value in jets.numbers.items()]
        lines.append("}")
    for line in jets.lines:
        if line.branch >= 0:
            lines.append(_chosen(line.branch, jets.branches[line.branch]))
        lines.append(f"N[{line.y}][k] = {_value(line)};")
    body = "\n".join(f"    {line}" for line in lines)
    unused = "" if jets.branches else "    (void)choice;\n"
    return f"static void {name}(double (*N)[{width}], double *choice, int k)\n{{\n{unused}{body}\n}}\n"


def _chosen(i: int, branch: Branch) -> str:
    value = _CHOICES[branch.kind].format(row=f"N[{branch.row}][0]")
    return f"if (k == 0 && isnan(choice[{i}])) choice[{i}] = {value};"


def _value(line: Line) -> str:
    """Order k of a row."""
    at_k, at_0 = ([f"N[{row}][{order}]" for row in line.args] for order in ("k", "0"))
    rows, factor = [f"N[{row}]" for row in line.args], number(line.number).text
    if line.kind in _LINEAR:
        return _LINEAR[line.kind].format(*at_k, number=factor)
    if line.kind in _LOGIC:
        return f"k == 0 && ({_LOGIC[line.kind].format(*at_0)})"
    if line.kind == "shifted":
        return f"k == 0 ? {at_k[0]} + {factor} : {at_k[0]}"
    if line.kind == "guarded":
        return f"{at_0[0]} != 0 ? {at_k[1]} : 0"
    if line.branch >= 0:
        return _switched(line, at_k)
    return _recurrence(line, rows, factor)


def _switched(line: Line, at_k: list[str]) -> str:
    choice = f"choice[{line.branch}]"
    if line.kind == "whole":
        return f"k == 0 ? {choice} : 0"
    first = f"{choice} == 0" if line.kind == "equal" else f"{choice} > 0"
    return f"{first} ? {at_k[0]} : {at_k[1]}"


def _recurrence(line: Line, rows: list[str], factor: str) -> str:
    own = f"N[{line.y}]"
    given = {
        "product": rows,
        "square": rows,
        "along": rows,
        "against": [own, rows[0], factor, rows[-1]],
        "power": [own, rows[0], factor],
    }.get(line.kind, [own, *rows])
    later = f"{line.kind}({', '.join(given)}, k)"
    later = f"-{later}" if line.kind == "along" and line.number < 0 else later
    if not line.start:
        return later
    return f"k == 0 ? {line.start}({', '.join(f'N[{row}][0]' for row in line.of)}) : {later}"
