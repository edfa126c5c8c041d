"""The recurrences of f, g and h as C that is fused: sums are expressions, and only what a recurrence reads is stored.

Order k of all rows that are stored lies together, in ``s->c[k]``: x, l and y first. What depends on t linearly has two terms,
what is a number one, and the recurrences know that.

The graphs of f, g and h as one table, which C runs on balls and on forms: `event_driven.disc_arithmetic`, `c/pieces_discs.c`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nsmodel import event_driven
from nsmodel.codegen.expressions import c_number
from nsmodel.event_driven.recurrence_code import Dialect, convolution_text, order_0_text, sum_text
from nsmodel.event_driven.recurrences import Recurrence, TaylorRecurrences, independent_branches

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
    return f"#define STRIDE {stride}\n" + Path(event_driven.__file__).with_name("series.c").read_text(encoding="utf-8")


LINEAR_KINDS = frozenset("sum difference minus scaled over shifted".split())
CHOSEN_KINDS = frozenset("guarded chosen equal".split())
ORDER_0_KINDS = frozenset("both either not positive whole".split())  # At order 0 alone.
ANY_DEGREE = 99  # The degree in t of what has terms of all orders: above that of any polynomial that a series holds.
ZERO_TEXT = "0.0"


@dataclass
class SeriesColumns:
    """Where rows are stored: ``inputs`` by (which input, its entry), what is added behind them, numbers among it.

    ``standing``: the columns of the rows of h that hold no l, by what they are; g reads them.
    """

    inputs: dict[tuple[int, int], int]
    count: int
    numbers: dict[int, float] = field(default_factory=dict)
    choices: int = 0
    branches: list[tuple[str, int, str]] = field(default_factory=list)  # (part, column watched, kind) of each.
    l_free: dict[int, int] = field(default_factory=dict)
    row_numbers: dict[tuple, int] = field(default_factory=dict)  # {what a row is made of: its number}, of all parts.

    def new(self) -> int:
        """A further column."""
        self.count += 1
        return self.count - 1


class RecurrencePrinter:
    """One part, f, g or h, as two functions of C: its order 0, and its order k > 0; of g once more for another l."""

    def __init__(self, jets: TaylorRecurrences, part: str, columns: SeriesColumns, degrees: Mapping[int, int]) -> None:
        """``degrees``: in t, of the inputs by which they are; see `_time_degrees`."""
        self.jets, self.part, self.columns = jets, part, columns
        self.degree = _time_degrees(jets, degrees)
        self.offset = columns.choices
        columns.choices += len(jets.branches)
        self.column = {row: columns.inputs[place] for place, row in jets.inputs.items()}
        self.free = _rows_without_l(jets, columns.row_numbers)
        self.computed_by_h: set[int] = set()  # Rows that h has computed.
        for row in sorted(_stored_rows(jets, self.degree) - set(self.column)):
            of = self.free.get(row, -1)
            if part == "g" and of in columns.l_free:
                self.column[row] = columns.l_free[of]
                self.computed_by_h.add(row)
                continue
            self.column[row] = columns.new()
            if part == "h" and row in self.free:
                columns.l_free[of] = self.column[row]
            if row in jets.numbers:
                columns.numbers[self.column[row]] = jets.numbers[row]
        columns.branches += [(part, self.column[branch.row], branch.kind) for branch in jets.branches]

    def text(self, targets: list[str], given: str = "") -> str:
        """``part_first(s)`` and ``part_later(s, k)``: statements ``targets`` of order 0 and k of the outputs, {} each.

        ``given``: further arguments of both.
        """
        made = [("", self.computed_by_h), *([("again_", self.computed_by_h | self.free.keys())] if self.part == "g" else [])]
        return "".join(
            self._function_text(f"{again}first", given, self._order_0_lines(known), targets)
            + self._function_text(f"{again}later", f", int k{given}", self._order_k_lines(known), targets)
            for again, known in made
        )

    def sizes(self) -> str:
        """``part_sizes(s)``: what switches look at is the sum of, see `event_driven.recurrence_code`; "" without switches."""
        if not self.jets.branches:
            return ""
        of = {0: ZERO_TEXT, 1: "s->at.size_x[{i}] + RESTS*s->pushed[{i}]", 2: "s->at.size_l[{i}]", 3: ZERO_TEXT}
        lines, value = self._order_0_lines(self.computed_by_h)
        lines = [line for line in lines if line.startswith("const double ")]
        made = {row: of[which].format(i=i) for (which, i), row in self.jets.inputs.items()} | dict.fromkeys(
            self.jets.numbers, "0.0"
        )
        for line in self.jets.lines:
            made[line.y] = sum_text(line, "b{}".format, f"s->at.choice[{line.branch + self.offset}]", C_DIALECT) or ZERO_TEXT
        lines += [f"const double b{row} = max_of(fabs({value[row]}), {text});" for row, text in made.items() if row in value]
        for i, branch in enumerate(self.jets.branches, self.offset):
            lines.append(f"s->at.size_switches[{i}] = max_of(s->at.size_switches[{i}], b{branch.row});")
        body = "".join(f"    {line}\n" for line in _prune_unused_names(["double *const c = s->c[0];", *lines]))
        return f"static void {self.part}_sizes(model_pieces *s)\n{{\n{body}    (void)c;\n}}\n\n"

    def _function_text(self, name: str, more: str, made: tuple[list[str], dict[int, str]], targets: list[str]) -> str:
        lines, value = made
        lines = lines + [target.format(value[row]) for target, row in zip(targets, self.jets.outputs, strict=True)]
        order = "k" if name.endswith("later") else "0"
        text = "".join(f"    {line}\n" for line in [f"double *const c = s->c[{order}];", *_prune_unused_names(lines)])
        body = text.split("\n", 1)[1]
        unused = "" if "c[" in body else "    (void)c;\n"
        unused += "".join(f"    (void){word};\n" for word in ("factor", "next") if word in more and word not in body)
        return f"static void {self.part}_{name}(model_pieces *s{more})\n{{\n{text}{unused}}}\n\n"

    def _stored_values(self) -> dict[int, str]:
        return {row: f"c[{column}]" for row, column in self.column.items()}

    def _store_line(self, line: Recurrence, text: str, value: dict[int, str], lines: list[str], known: Set[int]) -> None:
        if line.y in self.column and line.y in known:
            return
        if line.y in self.column:
            lines.append(f"c[{self.column[line.y]}] = {text};")
        else:
            name = f"a{line.y}"
            lines.append(f"const double {name} = {text};")
            value[line.y] = name

    def _order_0_lines(self, known: Set[int]) -> tuple[list[str], dict[int, str]]:
        value, lines = self._stored_values(), []
        value |= {row: c_number(v).within(0) for row, v in self.jets.numbers.items() if row not in self.column}
        for line in self.jets.lines:
            choice = f"s->at.choice[{self.offset + line.branch}]"
            if line.branch >= 0:
                branch = self.jets.branches[line.branch]
                made = C_DIALECT.choices[branch.kind].format(value[branch.row])
                lines.append(f"if ({choice} != {choice}) {choice} = {made};")
            self._store_line(line, order_0_text(line, value.__getitem__, choice, C_DIALECT), value, lines, known)
        return lines, value

    def _order_k_lines(self, known: Set[int]) -> tuple[list[str], dict[int, str]]:
        value, lines = self._stored_values(), []
        value |= dict.fromkeys(self.jets.numbers, ZERO_TEXT)
        for line in self.jets.lines:
            if self.degree[line.y] == 0:
                value[line.y] = ZERO_TEXT  # What is stored is 0 from order 1 on for good.
                continue
            by = constant_factor_index(line, self.degree)
            if by is not None:
                text = self._scaled_text(line, by, value)
            else:
                text = (
                    self._linear_text(line, value) if line.kind in LINEAR_KINDS | CHOSEN_KINDS else self._convolution_text(line)
                )
            if text == ZERO_TEXT or (line.y not in self.column and text.isidentifier()):
                value[line.y] = text
            else:
                self._store_line(line, text, value, lines, known)
        return lines, value

    def _linear_text(self, line: Recurrence, value: Mapping[int, str]) -> str:
        at = [value[row] for row in line.args]
        factor = c_number(line.number).within(1)
        match line.kind:
            case "shifted":
                return at[0]
            case "sum":
                return " + ".join(a for a in at if a != ZERO_TEXT) or ZERO_TEXT
            case "difference":
                return at[0] if at[1] == ZERO_TEXT else f"-{at[1]}" if at[0] == ZERO_TEXT else f"{at[0]} - {at[1]}"
            case "minus":
                return ZERO_TEXT if at[0] == ZERO_TEXT else f"-{at[0]}"
            case "scaled" | "over":
                sign = "*" if line.kind == "scaled" else "/"
                return ZERO_TEXT if at[0] == ZERO_TEXT else f"{factor}{sign}{at[0]}" if sign == "*" else f"{at[0]}/{factor}"
            case "guarded":
                return ZERO_TEXT if at[1] == ZERO_TEXT else f"s->c[0][{self.column[line.args[0]]}] != 0 ? {at[1]} : 0.0"
        if at[0] == at[1]:
            return at[0]
        side = f"s->at.choice[{self.offset + line.branch}]"
        return f"{side} {'== 0' if line.kind == 'equal' else '> 0'} ? {at[0]} : {at[1]}"

    def _scaled_text(self, line: Recurrence, by: int, value: Mapping[int, str]) -> str:
        of, factor = value[line.args[1 - by]], f"s->c[0][{self.column[line.args[by]]}]"
        if of == ZERO_TEXT:
            return ZERO_TEXT
        return f"{factor}*{_as_factor(of)}" if line.kind == "product" else f"{_as_factor(of)}/{factor}"

    def _convolution_text(self, line: Recurrence) -> str:
        rows, degree = [self._row_pointer(row) for row in line.args], [self.degree[row] for row in line.args]
        if line.kind == "product" and min(degree) <= 1:
            low, other = (0, 1) if degree[0] <= degree[1] else (1, 0)
            return f"product_{'line' if degree[low] else 'point'}({rows[low]}, {rows[other]}, k)"
        if line.kind == "along" and degree[1] <= 1:
            value = f"along_line({rows[0]}, {rows[1]}, k)"
            return f"-{value}" if line.number < 0 else value
        return convolution_text(line, self._row_pointer, C_DIALECT)

    def _row_pointer(self, row: int) -> str:
        return f"s->c[0] + {self.column[row]}"


def switch_scales_code(printers: Mapping[str, RecurrencePrinter]) -> str:
    """``sizes_of_switches(s)``, which calls those of the parts; "" without switches."""
    texts = {name: text for name, printer in printers.items() if (text := printer.sizes())}
    calls = "".join(f"    {name}_sizes(s);\n" for name in texts)
    return "".join(texts.values()) + (f"static void sizes_of_switches(model_pieces *s)\n{{\n{calls}}}\n" if texts else "")


def _time_degrees(jets: TaylorRecurrences, given: Mapping[int, int]) -> dict[int, int]:
    """The degree in t of each row: 0 for numbers, 1 for t; ANY_DEGREE where it may be any."""
    degree = dict.fromkeys(range(jets.count), ANY_DEGREE)
    degree |= {row: given[which] for (which, _), row in jets.inputs.items()} | dict.fromkeys(jets.numbers, 0)
    for line in jets.lines:
        of = [degree[row] for row in line.args if row != line.y]
        if line.kind in LINEAR_KINDS | CHOSEN_KINDS or not any(of):
            degree[line.y] = max(of, default=0)
        elif line.kind in ORDER_0_KINDS:
            degree[line.y] = 0
        elif line.kind in ("product", "square") and sum(of * (3 - len(of))) <= 1:
            degree[line.y] = sum(of)
    return degree


def constant_factor_index(line: Recurrence, degree: Mapping[int, int]) -> int | None:
    """Which argument of a product is a number of all orders, or of a quotient below; None where there is none, or both are."""
    if line.kind not in ("product", "quotient"):
        return None
    places = [place for place in ((0, 1) if line.kind == "product" else (1,)) if degree[line.args[place]] == 0]
    return places[0] if places and degree[line.args[1 - places[0]]] > 0 else None


def _as_factor(text: str) -> str:
    """The text in parentheses, unless a name or a number."""
    return text if text.replace("_", "").replace("[", "").replace("]", "").isalnum() else f"({text})"


def _stored_rows(jets: TaylorRecurrences, degree: Mapping[int, int]) -> set[int]:
    """The rows of which a recurrence, a condition or a later order reads other orders than its own."""
    read = {branch.row for branch in jets.branches}
    for line in jets.lines:
        by = constant_factor_index(line, degree)
        if by is not None:
            read.add(line.args[by])
        elif line.kind == "guarded":
            read.add(line.args[0])
        elif line.kind not in LINEAR_KINDS | CHOSEN_KINDS | ORDER_0_KINDS:
            read |= {line.y, *line.args}
    return read


def _rows_without_l(jets: TaylorRecurrences, alike: dict[tuple, int]) -> dict[int, int]:
    """The rows that no l, no switch and no row behind them enter, each with a number that says what it is."""
    found = {row: alike.setdefault(place, len(alike)) for place, row in jets.inputs.items() if place[0] != 2}
    found |= {row: alike.setdefault(("number", value), len(alike)) for row, value in jets.numbers.items()}
    for line in jets.lines:
        rows = [row for row in (*line.args, *line.of) if row != line.y]
        if line.branch < 0 and all(row in found for row in rows):
            made = (line.kind, line.number, line.start, tuple(found.get(row, -1) for row in (*line.args, *line.of)))
            found[line.y] = alike.setdefault(made, len(alike))
    return found


def _prune_unused_names(lines: list[str]) -> list[str]:
    """The lines without the names that nothing reads."""
    kept: list[str] = []
    tokens: set[str] = set()
    for line in reversed(lines):
        name = line.split()[2] if line.startswith("const double ") else None
        if name is None or name in tokens:
            kept.append(line)
            tokens |= set(re.findall(r"\w+", line))
    return kept[::-1]


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
        """The number of rows of the table."""
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
