"""The graphs of f, g and h as tables, which C runs on balls and on forms: `pieces.discs`, `c/pieces_discs.c`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from nsmodel.codegen.expression import number
from nsmodel.pieces.jets import Jets, Line

if TYPE_CHECKING:
    from nsmodel.codegen.piece_jets import Printer

KINDS = (
    "sum difference scaled shifted product quotient exp expm1 sin cos tan sinh cosh tanh sqrt hypot log log1p power pow atan "
    "asin acos asinh acosh atanh erf atan2 chosen equal guarded whole not positive both either"
).split()  # fmt: skip


def kinds() -> str:
    """The operations, as an enum of C."""
    return f"enum {{ {', '.join(f'OF_{name.upper()}' for name in KINDS)} }};\n"


def interpreter(text: str, printers: Iterable[Printer]) -> str:
    """The interpreter without the operations that no graph has: a line of its switch each."""
    used = {_operation(printer.jets, line)[0].upper() for printer in printers for line in printer.jets.lines}
    return re.sub(r"^    case OF_(\w+): .*\n", lambda case: case[0] if case[1] in used else "", text, flags=re.MULTILINE)


def graph(printer: Printer) -> str:
    """``PART_graph``, of one part."""
    jets, name = printer.jets, printer.part
    lines = ", ".join(_line(jets, line) for line in jets.lines)
    given = [value for (which, entry), row in jets.inputs.items() for value in (row, which, entry)]
    text = f"static const disc_line {name}_lines[] = {{{lines or '{0, -1, 0, 0, 0, 0}'}}};\n"
    text += _table(f"{name}_inputs", given) + _table(f"{name}_outputs", jets.outputs)
    text += _table(f"{name}_looked", [branch.row for branch in jets.branches])
    text += _table(f"{name}_number_rows", list(jets.numbers))
    text += _table(f"{name}_disc_numbers", [number(value).text for value in jets.numbers.values()], "double")
    counts = (len(jets.lines), len(jets.inputs), len(jets.outputs), len(jets.branches), len(jets.numbers), printer.offset)
    tables = ", ".join(f"{name}_{of}" for of in ("lines", "inputs", "outputs", "looked", "number_rows", "disc_numbers"))
    return text + f"static const disc_graph {name}_graph = {{{tables}, {', '.join(map(str, counts))}}};\n"


def _table(name: str, values: Sequence[Any], kind: str = "int") -> str:
    return f"static const {kind} {name}[] = {{{', '.join(map(str, values)) or '0'}}};\n"


def _line(jets: Jets, line: Line) -> str:
    kind, (a, b), value = _operation(jets, line)
    return f"{{OF_{kind.upper()}, {line.branch}, {line.y}, {a}, {b}, {number(value).text}}}"


def _operation(jets: Jets, line: Line) -> tuple[str, list[int], float]:
    """Its name among KINDS, two rows, a number."""
    kind, rows, value = line.start or line.kind, list(line.of if line.start else line.args), line.number
    match kind:
        case "minus":
            kind, value = "scaled", -1.0
        case "over":
            kind, value = "scaled", 1 / line.number
        case "square":
            kind, rows = "product", [rows[0], rows[0]]
        case "pow" if rows[1] in jets.numbers:
            kind, value = "power", jets.numbers[rows[1]]
    return kind, [*rows, 0, 0][:2], value
