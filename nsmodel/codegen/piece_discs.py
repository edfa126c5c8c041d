"""The graphs of f, g and h as one table, which C runs on balls and on forms: `pieces.discs`, `c/pieces_discs.c`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from nsmodel.codegen.expression import c_number
from nsmodel.pieces.jets import Recurrence, TaylorRecurrences, independent_branches

if TYPE_CHECKING:
    from nsmodel.codegen.piece_jets import RecurrencePrinter

DISC_OPERATIONS = (
    "sum difference scaled shifted product quotient exp expm1 sin cos tan sinh cosh tanh sqrt hypot log log1p power pow atan "
    "asin acos asinh acosh atanh erf atan2 chosen equal guarded whole not positive both either"
).split()  # fmt: skip
CONSTANT_INPUT = 3  # Which input numbers are that stay on a piece.


class DiscTable:
    """The table: rows of t, x and l first; what parts have alike, and what no output needs, is left out."""

    def __init__(self, printers: Iterable[RecurrencePrinter], n: int, m: int) -> None:
        """``printers``: f first."""
        self.row = {(0, 0): 0} | {(1, i): 1 + i for i in range(n)} | {(2, i): 1 + n + i for i in range(m)}
        self.numbers: dict[float, int] = {}
        self.lines: dict[tuple[Any, ...], int] = {}  # {operation, choice, rows, number: row}
        self.looked: dict[int, int] = {}
        self.outputs: dict[str, list[int]] = {}
        self.counts: dict[str, int] = {}
        self.plain: dict[int, bool] = {}
        self.switches: dict[str, int] = {}
        for printer in printers:
            self._add(printer)

    @property
    def rows(self) -> int:
        """How many."""
        return len(self.row) + len(self.numbers) + len(self.lines)

    def _add(self, printer: RecurrencePrinter) -> None:
        jets, here = printer.jets, {}
        needed = _needed_rows(jets)
        for place, old in jets.inputs.items():
            here[old] = self.row.setdefault(place, self.rows)
        for old, value in jets.numbers.items():
            if old in needed:
                here[old] = self.numbers.setdefault(value, self.rows)
        for line in jets.lines:
            if line.y in needed:
                kind, of, value = _line_operation(jets, line)
                choice = line.branch + printer.offset if line.branch >= 0 else -1
                key = (kind, choice, *(here[row] for row in of), value)
                here[line.y] = self.lines.setdefault(key, self.rows)
        self.looked |= {i: here[branch.row] for i, branch in enumerate(jets.branches, printer.offset)}
        self.outputs[printer.part] = [here[row] for row in jets.outputs]
        self.counts[printer.part] = len(self.lines)
        self.switches[printer.part] = len(jets.branches)
        self.plain |= dict(enumerate(independent_branches(jets), printer.offset))

    def kinds(self) -> str:
        """The operations, as an enum of C."""
        return f"enum {{ {', '.join(f'OF_{name.upper()}' for name in DISC_OPERATIONS)} }};\n"

    def prune_interpreter(self, text: str) -> str:
        """The interpreter without the operations that no line has: a line of its switches each."""
        used = {key[0].upper() for key in self.lines}
        return re.sub(r"^    case OF_(\w+): .*\n", lambda case: case[0] if case[1] in used else "", text, flags=re.MULTILINE)

    def table(self) -> str:
        """The lines, numbers and rows of interest, in C."""
        given = [value for (which, entry), row in self.row.items() if which == CONSTANT_INPUT for value in (row, entry)]
        sizes = {
            "DISC_LINES": len(self.lines), "LINES_OF_F": self.counts["f"], "DISC_ROWS": self.rows,
            "SWITCHES_OF_H": self.switches.get("h", 0), "NUMBERS_ON_DISC": len(self.numbers), "GIVEN_ON_DISC": len(given) // 2,
        }  # fmt: skip
        text = f"enum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};\n"
        read = {row for _, _, *of, _ in self.lines for row in of}
        lines = [_disc_line(key, row, last=row not in read) for key, row in self.lines.items()]
        text += _disc_table("lines", lines or ["{0, 0, -1, 0, 0, 0, 0}"], "disc_line")
        text += _disc_table("number_rows", list(self.numbers.values())) + _disc_table("given", given)
        text += _disc_table("numbers", [c_number(value).text for value in self.numbers], "double")
        text += "".join(_disc_table(name, rows) for name, rows in self.outputs.items())
        if not self.looked:
            return text
        text += _disc_table("looked", [self.looked[i] for i in range(len(self.looked))])
        return text + _disc_table("plain", [int(self.plain[i]) for i in range(len(self.plain))])


def _disc_table(name: str, values: Sequence[Any], kind: str = "int") -> str:
    return f"static const {kind} disc_{name}[] = {{{', '.join(map(str, values)) or '0'}}};\n"


def _disc_line(key: tuple[Any, ...], row: int, *, last: bool) -> str:
    kind, choice, *of, value = key
    a, b = [*of, 0, 0][:2]
    return f"{{OF_{kind.upper()}, {last:d}, {choice}, {row}, {a}, {b}, {c_number(value).text}}}"


def _needed_rows(jets: TaylorRecurrences) -> set[int]:
    """The rows that outputs and switches are made of."""
    needed = {*jets.outputs, *(branch.row for branch in jets.branches)}
    for line in reversed(jets.lines):
        if line.y in needed:
            needed.update(_line_operation(jets, line)[1])
    return needed


def _line_operation(jets: TaylorRecurrences, line: Recurrence) -> tuple[str, list[int], float]:
    """Its name among KINDS, two rows at most, a number."""
    kind, rows, value = line.start or line.kind, list(line.of if line.start else line.args), line.number
    match kind:
        case "minus":
            kind, value = "scaled", -1.0
        case "over":
            kind, value = "scaled", 1 / line.number
        case "square":
            kind, rows = "product", [rows[0], rows[0]]
        case "pow" if rows[1] in jets.numbers:
            kind, rows, value = "power", rows[:1], jets.numbers[rows[1]]
    return kind, rows[:2], value
