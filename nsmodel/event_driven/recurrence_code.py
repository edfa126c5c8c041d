"""Taylor coefficients by the recurrences of `jets`, interpreted.

The recurrences of `jets` as statements: in Python, for `expansion`, and in C, for `codegen.recurrences`. One text, two dialects.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nsmodel.event_driven.recurrences import ORDER_0_FUNCTIONS, RECURRENCES, Branch, Recurrence, TaylorRecurrences


class Dialect(NamedTuple):
    """How a language writes a row by its number, a number, a choice, and what its operators are called.

    ``kept`` is what is stored of a value at order 0; ``either(condition, a, b)`` is a if the condition holds, else b;
    ``choose`` is a statement that makes choice i by ``choices``.
    """

    row: Callable[[int], str]
    number: Callable[[float], str]
    either: Callable[[str, str, str], str]
    both: str
    one: str
    positive: str
    ratio: str
    end: str
    kept: str
    choose: str
    choices: dict[str, str]


PYTHON_DIALECT = Dialect(
    row="r{}".format,
    number=lambda value: f"float('{value!r}')" if value != value or value in (float("inf"), -float("inf")) else repr(value),
    either="({1} if {0} else {2})".format,
    both="{0} != 0.0 and {1} != 0.0",
    one="{0} != 0.0 or {1} != 0.0",
    positive="{0} > 0",
    ratio="divided({0}, {1})",
    end="",
    kept="{0}",
    choose="if choice[{i}] != choice[{i}]: choice[{i}] = {value}",
    choices={
        "side": "-1.0 if {0} < 0 else 1.0",
        "equal": "float({0} > 0) - float({0} < 0)",
        "floor": "floor({0})",
        "ceil": "ceil({0})",
        "toward zero": "trunc({0})",
        "nearest": "rint({0})",
    },
)
# Of symbols: what they are is known later, and the sides of branches are given.
SYMBOL_DIALECT = PYTHON_DIALECT._replace(
    either="where({0}, {1}, {2})".format,
    both="both({0} != 0.0, {1} != 0.0)",
    one="one({0} != 0.0, {1} != 0.0)",
    ratio="{0} / {1}",
    choose="pass",
)
_LINEAR_TEXTS = {"sum": "{0} + {1}", "difference": "{0} - {1}", "minus": "-{0}", "scaled": "{number}*{0}", "over": "{0}/{number}"}
# What a row is the sum of, in size, where its arguments may cancel.
_SUM_TEXTS = {
    "sum": "{0} + {1}", "difference": "{0} + {1}", "shifted": "{0} + {number}", "minus": "{0}", "scaled": "{number}*{0}",
    "over": "{0}/{number}", "product": "{0}*{1}", "square": "{0}*{0}", "guarded": "{1}",
}  # fmt: skip


def sum_text(line: Recurrence, size: Callable[[int], str], choice: str, language: Dialect) -> str | None:
    """What order 0 of a line is the sum of, in size; None: itself. ``size``: that of a row, ``choice``: of its branch."""
    if line.kind in ("chosen", "equal"):
        return _chosen_text(line, [*map(size, line.args)], choice, language)
    if line.kind not in _SUM_TEXTS:
        return None
    return _SUM_TEXTS[line.kind].format(*map(size, line.args), number=language.number(abs(line.number)))


def order_0_statements(recurrences: TaylorRecurrences, language: Dialect) -> list[str]:
    """The statements of order 0; a choice that is not a number is made here."""
    lines = []
    for line in recurrences.lines:
        if line.branch >= 0:
            lines.append(_choice_statement(line.branch, recurrences.branches[line.branch], language))
        at_0 = f"{language.row(line.y)}[0]"
        value = order_0_text(line, lambda row: f"{language.row(row)}[0]", f"choice[{line.branch}]", language)
        lines.append(f"{at_0} = {language.kept.format(value)}{language.end}")
    return lines


def higher_order_statements(recurrences: TaylorRecurrences, language: Dialect) -> list[str]:
    """The statements of order k > 0."""
    return [
        f"{language.row(line.y)}[k] = {value}{language.end}"
        for line in recurrences.lines
        if (value := _higher_order_text(line, language)) is not None
    ]


def _choice_statement(i: int, branch: Branch, language: Dialect) -> str:
    value = language.choices[branch.kind].format(f"{language.row(branch.row)}[0]")
    return language.choose.format(i=i, value=value)


def order_0_text(line: Recurrence, value: Callable[[int], str], choice: str, language: Dialect) -> str:
    """Order 0 of a line; ``value``: of a row, ``choice``: of its branch."""
    at = [value(row) for row in line.args]
    if line.start:
        return f"{line.start}({', '.join(map(value, line.of))})"
    match line.kind:
        case "both" | "either":
            return language.either((language.both if line.kind == "both" else language.one).format(*at), "1.0", "0.0")
        case "not":
            return language.either(f"{at[0]} == 0", "1.0", "0.0")
        case "positive":
            return language.either(language.positive.format(*at), "1.0", "0.0")
        case "whole":
            return choice
        case "shifted":
            return f"{at[0]} + {language.number(line.number)}"
        case "product":
            return f"{at[0]}*{at[1]}"
        case "square":
            return f"{at[0]}*{at[0]}"
        case "quotient":
            return language.ratio.format(*at)
    return _any_order_text(line, at, at, choice, language)


def _higher_order_text(line: Recurrence, language: Dialect) -> str | None:
    if line.kind in ("both", "either", "not", "positive", "whole"):
        return None  # They stay 0.
    rows = [language.row(row) for row in line.args]
    at_k, at_0 = ([f"{row}[{order}]" for row in rows] for order in ("k", "0"))
    if line.kind == "shifted":
        return at_k[0]
    if line.kind in _LINEAR_TEXTS or line.kind in ("guarded", "chosen", "equal"):
        return _any_order_text(line, at_k, at_0, f"choice[{line.branch}]", language)
    return convolution_text(line, language.row, language)


def convolution_text(line: Recurrence, row: Callable[[int], str], language: Dialect) -> str:
    """Order k > 0 of a line by a function of series; ``row``: where a row is."""
    own, rows, factor = row(line.y), [row(of) for of in line.args], language.number(line.number)
    given = {
        "product": rows, "square": rows, "along": rows,
        "against": [own, rows[0], factor, rows[-1]], "power": [own, rows[0], factor],
    }.get(line.kind, [own, *rows])  # fmt: skip
    value = f"{line.kind}({', '.join(given)}, k)"
    return f"-{value}" if line.kind == "along" and line.number < 0 else value


def _any_order_text(line: Recurrence, at: list[str], at_0: list[str], choice: str, language: Dialect) -> str:
    if line.kind == "guarded":
        return language.either(f"{at_0[0]} != 0", at[1], "0.0")
    if line.kind in ("chosen", "equal"):
        return _chosen_text(line, at, choice, language)
    return _LINEAR_TEXTS[line.kind].format(*at, number=language.number(line.number))


def _chosen_text(line: Recurrence, at: list[str], choice: str, language: Dialect) -> str:
    return language.either(f"{choice} == 0" if line.kind == "equal" else f"{choice} > 0", at[0], at[1])


NUMERIC_FUNCTIONS = RECURRENCES | ORDER_0_FUNCTIONS | {name: getattr(np, name) for name in ("floor", "ceil", "trunc", "rint")}


class TaylorExpansion:
    """The rows of some jets with numbers: ``order(k)`` computes order k of all of them, once the inputs have it.

    Attributes:
        rows: ``count`` lists of orders + 1 coefficients; those of the inputs are the caller's.
        choice: for each branch the side or the whole number; NaN: chosen at order 0, by the value there.
        outputs: the rows of the expression's entries.
    """

    def __init__(
        self, recurrences: TaylorRecurrences, orders: int, inputs: Mapping[tuple[int, int], list[Any]] | None = None,
        language: Dialect = PYTHON_DIALECT, known: Mapping[str, Any] = NUMERIC_FUNCTIONS,
    ) -> None:  # fmt: skip
        """``inputs``: lists that stand for rows of inputs, by (which input, its entry); for the others see `compiled`."""
        self.jets = recurrences
        self.rows: list[list[Any]] = [[0.0] * (orders + 1) for _ in range(recurrences.count)]
        for place, row in recurrences.inputs.items():
            if inputs is not None:
                self.rows[row] = inputs[place]
        for row, value in recurrences.numbers.items():
            self.rows[row][0] = value
        self.choice: list[Any] = [math.nan] * len(recurrences.branches)
        self.outputs = [self.rows[row] for row in recurrences.outputs]
        self._run_order_0, self._run_order_k = compile_recurrences(recurrences, self.rows, self.choice, language, known)
        self._sum_sizes = _compile_size_sums(recurrences)

    def compute(self, k: int) -> None:
        """Compute order k of all rows."""
        if k:
            self._run_order_k(k)
        else:
            self._run_order_0()

    def order(self, k: int) -> list[float]:
        """Compute order k of all rows, and return that of the outputs; NaN where they have none."""
        self.compute(k)
        return [row[k] for row in self.outputs]

    def terms(self, inputs: Mapping[tuple[int, int], float]) -> list[float]:
        """What the branches' arguments are the sums of at order 0, in size; inputs are of the sizes given."""
        size = [abs(row[0]) for row in self.rows]
        for place, row in self.jets.inputs.items():
            size[row] = max(size[row], inputs[place])
        self._sum_sizes(size, self.choice)
        return [size[branch.row] for branch in self.jets.branches]


def rescale_time(rows: Sequence[list[float]], times: float) -> None:
    """Let the unit of time be so many times as long, a power of two; a row that is there twice is one."""
    powers = list(itertools.accumulate([times] * (max(map(len, rows)) - 1), operator.mul, initial=1.0))
    for row in {id(row): row for row in rows}.values():
        row[:] = map(operator.mul, row, powers)


def compile_recurrences(
    recurrences: TaylorRecurrences, rows: list[list[Any]], choice: list[Any], language: Dialect, known: Mapping[str, Any]
):
    """The functions of order 0 and of order k > 0, with the rows as their variables; ``known``: what the language calls."""
    names = [f"r{row}" for row in range(recurrences.count)]
    bodies = [
        f"    def {name}:\n" + "\n".join(f"        {line}" for line in lines or ["pass"])
        for name, lines in (
            ("first()", order_0_statements(recurrences, language)),
            ("later(k)", higher_order_statements(recurrences, language)),
        )
    ]
    made: dict = {}
    text = f"def make(rows, choice):\n    [{', '.join(names)}] = rows\n" + "\n".join(bodies) + "\n    return first, later\n"
    exec(compile(text, "<series>", "exec"), dict(known), made)
    return made["make"](rows, choice)


def _compile_size_sums(recurrences: TaylorRecurrences) -> Callable[[list[float], list[float]], None]:
    """What makes the sizes of rows those of the sums that they are, of the side that is chosen."""
    given = recurrences.lines if recurrences.branches else []
    texts = ((line.y, sum_text(line, "size[{}]".format, f"choice[{line.branch}]", PYTHON_DIALECT)) for line in given)
    lines = [f"    size[{y}] = max(size[{y}], {text})\n" for y, text in texts if text]
    made: dict = {}
    exec(compile("def sizes(size, choice):\n" + ("".join(lines) or "    pass\n"), "<sizes>", "exec"), made)
    return made["sizes"]
