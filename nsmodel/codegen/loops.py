"""Expressions whose rows have few forms as C loops; the numbers and indices of a form are affine in the counter, or a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi as ca

from nsmodel.codegen import expression
from nsmodel.codegen.expression import (
    MAX_OPERATIONS,
    SCALAR_NAMES,
    SOLVER_PREFIXES,
    CExpression,
    apply_operation,
    assign_if_shared,
    c_function_text,
    c_number,
    expression_graph,
)
from nsmodel.codegen.tables import c_table

MIN_ROWS_PER_FORM = 8  # Rows to a form, on average, from which on loops are written.


def looped_c_function(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX], comment: str = "") -> str:
    """As `expression.c_function`; where the function is long and its rows have few forms, each form is a loop."""
    column = ca.densify(ca.vertcat(ca.SX(0, 1), *(ca.vec(e.T) for e in outputs.values())))
    whole = ca.Function("f", list(inputs.values()), [column])
    if whole.n_instructions() <= MAX_OPERATIONS:
        return expression.c_function(name, inputs, outputs, comment)
    found = loop_forms(expression_graph(whole), [(key, i) for key, e in outputs.items() for i in range(e.numel())])
    if len(found) * MIN_ROWS_PER_FORM > column.numel():
        return expression.c_function(name, inputs, outputs, comment)
    tables, body = LoopTables(name), []
    for form in found:
        body += _form_loop(form, list(inputs), tables)
    given = ["s", *(key for key in inputs if not key.startswith(SOLVER_PREFIXES))]
    arguments = [f"const {'model_solver' if key == 's' else 'double'} *{key}" for key in given]
    arguments += [f"double *restrict {key}" for key in outputs]
    head = f"/* {comment} */\n" if comment else ""
    return tables.text() + head + c_function_text(name, arguments, [*given, *outputs], body)


def _form_loop(form: LoopForm, inputs: list[str], tables: LoopTables) -> list[str]:
    """The loop of a form; the statement alone where it has one row."""
    leaves, pieces, lines = list(zip(*form.leaves, strict=True)), [], []
    uses = [0] * len(form.nodes)
    for op, *args in form.nodes:
        for j in args if op != ca.OP_INPUT else ():
            uses[j] += 2 if op == ca.OP_SQ and form.nodes[j][0] not in (ca.OP_INPUT, ca.OP_CONST) else 1
    leaf = iter(leaves)
    for k, (op, *args) in enumerate(form.nodes):
        if op == ca.OP_CONST:
            values = next(leaf)
            own = c_number(values[0])
            piece = own if all(value == values[0] for value in values) else CExpression(tables.entry(values, "is"))
        elif op == ca.OP_INPUT:
            key, entries = inputs[args[0]], next(leaf)
            piece = CExpression(key if key in SCALAR_NAMES else f"{key}[{tables.index(entries)}]")
        else:
            piece, line = assign_if_shared(apply_operation(op, [pieces[j] for j in args]), uses[k], f"a{len(lines) + 1}")
            lines += line
        pieces.append(piece)
    lines.append(f"{form.output}[{tables.index(form.places)}] = {pieces[-1].text};")
    if len(form.places) == 1:
        return ["{", *(f"    {line}" for line in lines), "}"] if len(lines) > 1 else lines
    return [f"for (int i = 0; i < {len(form.places)}; i++) {{", *(f"    {line}" for line in lines), "}"]


class LoopForm(NamedTuple):
    """Rows that do the same: the output, the nodes, and each row's place in the output and what its leaves are.

    The leaf of an input is (which, entry), that of a number its value.
    """

    output: str
    nodes: tuple[tuple, ...]
    places: list[int]
    leaves: list[list]


def loop_forms(whole: tuple, targets: Sequence[tuple[str, int]]) -> list[LoopForm]:
    """The rows of a graph (see `expression.graph`) by their form; ``targets``: output and place of each."""
    nodes, stores, _ = whole
    found: dict[tuple, LoopForm] = {}
    for (_, entry), root in stores:
        output, place = targets[entry]
        own, leaves = _row_form(nodes, root)
        key = (output, own)
        if key not in found:
            found[key] = LoopForm(output, own, [], [])
        found[key].places.append(place)
        found[key].leaves.append(leaves)
    return list(found.values())


def _row_form(nodes: list[tuple], root: int) -> tuple[tuple[tuple, ...], list]:
    """The nodes below ``root`` in their own numbers, leaves without what they hold, and what these hold."""
    own: list[tuple] = []
    leaves: list = []
    number: dict[int, int] = {}
    stack = [(root, False)]
    results: list[int] = []
    while stack:
        node, ready = stack.pop()
        op, args, extra = nodes[node]
        if op == ca.OP_CONST:  # each use is its own
            own.append((op,))
            leaves.append(extra)
            results.append(len(own) - 1)
        elif node in number:
            results.append(number[node])
        elif op == ca.OP_INPUT:
            own.append((op, extra[0]))
            leaves.append(extra[1])
            results.append(len(own) - 1)
            number[node] = len(own) - 1
        elif ready:
            taken = tuple(results[len(results) - len(args) :])
            del results[len(results) - len(args) :]
            own.append((op, *taken))
            results.append(len(own) - 1)
            number[node] = len(own) - 1
        else:
            stack.append((node, True))
            stack.extend((arg, False) for arg in reversed(args))
    return tuple(own), leaves


class LoopTables:
    """Tables of numbers ("is") and indices ("at"), each written once; ``prefix`` begins their names."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self._names: dict[tuple, str] = {}

    def entry(self, values: Sequence[float], kind: str) -> str:
        """C for the value that row i has."""
        return f"{self._names.setdefault((kind, tuple(values)), f'{self.prefix}_{kind}_{len(self._names)}')}[i]"

    def index(self, values: Sequence[int]) -> str:
        """C for the index that row i has."""
        first, step = values[0], values[1] - values[0] if len(values) > 1 else 0
        if step < 0 or any(value != first + step * i for i, value in enumerate(values)):
            return self.entry(values, "at")
        counter = "i" if step == 1 else f"{step}*i"
        return str(first) if step == 0 else counter if first == 0 else f"{counter} + {first}"

    def text(self) -> str:
        """The C of the tables."""
        kinds = {"at": "int", "is": "double"}
        return "".join(c_table(name, values, str(len(values)), kind=kinds[kind]) for (kind, values), name in self._names.items())
