"""CasADi expressions as C functions: one assignment for each shared value, what is used once stands where it is used.

Expressions whose rows have few forms as C loops; the numbers and indices of a form are affine in the counter, or a table.

Numbers as C tables.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import CodegenError
from nsmodel.solvers.structure import StepStructure

# Operations from which on a function is cut into several: the time of compilers grows faster than the length of a function.
MAX_OPERATIONS = 3000
SCALAR_NAMES = ("s->t", "s->h", "AT.h")
SOLVER_PREFIXES = ("s->", "AT.")  # How the names of what is read from the solver begin; AT: the matrices of the step's length.
MAX_EXPRESSION_WIDTH = 110  # Characters of an expression from which on it gets a name of its own: a line of C that can be read.
# Zeros from which on a sparse matrix is cleared before its other entries are set: one call for so many lines.
MIN_CLEARED_ZEROS = 64
TARGETS_PER_LINE = 8  # Entries set to one constant in a line, of about a hundred characters.
ATOM, UNARY, PRODUCT, SUM, COMPARISON, LOGICAL, CHOICE = range(7)  # How tightly a piece of C binds.


class CExpression(NamedTuple):
    """A piece of C and how it binds; ``truth``: it is an int, 0 or 1."""

    text: str
    precedence: int = ATOM
    truth: bool = False

    def within(self, loosest: int) -> str:
        """The text as an operand that may bind no looser than ``loosest``."""
        return self.text if self.precedence <= loosest else f"({self.text})"

    @property
    def number(self) -> CExpression:
        """The piece as a double."""
        return CExpression(f"(double)({self.text})", UNARY) if self.truth else self

    @property
    def condition(self) -> CExpression:
        """The piece as a condition: true where it is not 0, NaN included."""
        return self if self.truth else CExpression(f"{self.within(SUM)} != 0.0", COMPARISON, True)


_INFIX = {ca.OP_ADD: ("+", SUM, SUM, PRODUCT), ca.OP_SUB: ("-", SUM, SUM, PRODUCT),
          ca.OP_MUL: ("*", PRODUCT, PRODUCT, UNARY), ca.OP_DIV: ("/", PRODUCT, PRODUCT, UNARY)}  # fmt: skip
_COMPARISON_SIGNS = {ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!="}
_C_FUNCTIONS = {
    getattr(ca, f"OP_{name.upper()}"): name
    for name in (
        "acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh erf exp expm1 fabs floor fmod hypot log log1p pow "
        "remainder sin sinh sqrt tan tanh"
    ).split()
} | {ca.OP_CONSTPOW: "pow", ca.OP_FMAX: "max_of", ca.OP_FMIN: "min_of", ca.OP_SIGN: "sign_of"}
_TWICE_USED = {ca.OP_SQ}  # The argument appears twice in the text.
_NAMES = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}


def c_function(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX], comment: str = "") -> str:
    """Return a static C function ``void name(const model_solver *s, const double *a, ..., double *restrict out, ...)``.

    Args:
        name: of the C function.
        inputs: symbols by the name of the argument; what begins as in READ is read from the solver: SCALARS are scalars, all
            others arrays.
        outputs: expressions; matrices are written row by row.
        comment: what it computes.

    Raises:
        CodegenError: an operation that has no C counterpart.
    """
    entries = [(f"{key}[{i}]", entry) for key, e in outputs.items() for i, entry in enumerate(ca.vertsplit(ca.vec(e.T)))]
    sparse = {
        key: e.numel() for key, e in outputs.items() if e.numel() - e.nnz() >= MIN_CLEARED_ZEROS and 2 * e.nnz() < e.numel()
    }
    entries = [(target, entry) for target, entry in entries if entry.nnz() or target.partition("[")[0] not in sparse]
    cleared = [f"memset({key}, 0, {size}*sizeof *{key});" for key, size in sparse.items()]
    whole = _column_function(inputs, entries)
    if whole.n_instructions() <= MAX_OPERATIONS:
        body = _assignment_lines(whole, list(inputs), [target for target, _ in entries])
        return c_function_text(name, inputs, outputs, [*cleared, *body], comment)
    parts = -(-whole.n_instructions() // MAX_OPERATIONS)
    size = -(-len(entries) // parts)
    text, calls = "", []
    for k in range(0, len(entries), size):
        part = entries[k : k + size]
        body = _assignment_lines(_column_function(inputs, part), list(inputs), [target for target, _ in part])
        text += c_function_text(f"{name}_{k // size}", inputs, outputs, body) + "\n"
        calls.append(f"{name}_{k // size}({', '.join([*_arguments_of(inputs), *outputs])});")
    return text + c_function_text(name, inputs, outputs, [*cleared, *calls], comment)


def _column_function(inputs: Mapping[str, ca.SX], entries: list[tuple[str, ca.SX]]) -> ca.Function:
    column = ca.densify(ca.vertcat(ca.SX(0, 1), *(entry for _, entry in entries)))
    return ca.Function("f", list(inputs.values()), [column], {"cse": True})


def _arguments_of(inputs: Iterable[str]) -> list[str]:
    """The arguments of a C function for these inputs: the solver, and what is not read from it."""
    return ["s", *(key for key in inputs if not key.startswith(SOLVER_PREFIXES))]


def c_function_text(name: str, inputs: Iterable[str], outputs: Iterable[str], body: list[str], comment: str = "") -> str:
    """A function with this body; names that it does not use are marked."""
    given, text = _arguments_of(inputs), "\n".join(f"    {line}" for line in body)
    arguments = [f"const {'model_solver' if key == 's' else 'double'} *{key}" for key in given]
    arguments += [f"double *restrict {key}" for key in outputs]
    used = {"s" if word == "AT" else word for word in re.findall(r"\w+", text)}
    unused = "".join(f"    (void){key};\n" for key in [*given, *outputs] if key not in used)
    head = f"/* {comment} */\n" if comment else ""
    return f"{head}static void {name}({', '.join(arguments)})\n{{\n{unused}{text}\n}}\n"


def _assignment_lines(function: ca.Function, inputs: list[str], targets: list[str]) -> list[str]:
    """The assignments of a function's graph in single-assignment form."""
    lines: list[str] = []
    stores = add_graph_lines(function, lambda which, entry: _input_text(inputs[which], entry), lines)
    return lines + _store_lines([(targets[entry], piece.text, is_number) for entry, piece, is_number in stores])


def _input_text(key: str, index: int | str) -> str:
    return key if key in SCALAR_NAMES else f"{key}[{index}]"


def add_graph_lines(
    function: ca.Function, read: Callable[[int, int], str], lines: list[str]
) -> list[tuple[int, CExpression, bool]]:  # fmt: skip
    """Add to ``lines`` the constants that a function's graph names; its entries, what each is, and whether that is a number.

    ``read``: the C of an input, by its number and the entry.
    """
    nodes, stores, uses = expression_graph(function)
    pieces: dict[int, CExpression] = {}
    for i, (op, args, extra) in enumerate(nodes):
        if not uses[i]:
            continue
        if op == ca.OP_INPUT:
            pieces[i] = CExpression(read(*extra))
        elif op == ca.OP_CONST:
            pieces[i] = c_number(extra)
        else:
            pieces[i], line = assign_if_shared(apply_operation(op, [pieces[j] for j in args]), uses[i], f"a{len(lines) + 1}")
            lines += line
    return [(entry, pieces[i], nodes[i][0] == ca.OP_CONST) for (_, entry), i in stores]


def assign_if_shared(piece: CExpression, uses: int, name: str) -> tuple[CExpression, list[str]]:
    """A piece as it is used: by name where it is used often or is long, with the line that gives it the name."""
    if uses > 1 or len(piece.text) > MAX_EXPRESSION_WIDTH:
        return CExpression(name), [f"const double {name} = {piece.text};"]
    return piece, []


def _store_lines(stores: list[tuple[str, str, bool]]) -> list[str]:
    """``target = value;`` for each store; constants that are equal share a line."""
    lines, constants = [], {}
    for target, value, constant in stores:
        if constant:
            constants.setdefault(value, []).append(target)
        else:
            lines.append(f"{target} = {value};")
    for value, targets in constants.items():
        for i in range(0, len(targets), TARGETS_PER_LINE):
            lines.append(" = ".join(targets[i : i + TARGETS_PER_LINE]) + f" = {value};")
    return lines


def expression_graph(function: ca.Function) -> tuple[list[tuple], list[tuple[tuple[int, int], int]], list[int]]:
    """(nodes, stores, uses): each operation once, with the nodes it takes; what is stored where; how often a node is needed."""
    nodes: list[tuple] = []
    stores, uses, at = [], [], {}
    for i in range(function.n_instructions()):
        op, source, target = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            stores.append(((target[0], target[1]), at[source[0]]))
            uses[at[source[0]]] += 1
            continue
        args = [] if op in (ca.OP_INPUT, ca.OP_CONST) else [at[j] for j in source]
        extra = source if op == ca.OP_INPUT else function.instruction_constant(i) if op == ca.OP_CONST else None
        for j in args:
            uses[j] += 2 if op in _TWICE_USED and nodes[j][0] not in (ca.OP_INPUT, ca.OP_CONST) else 1
        nodes.append((op, args, extra))
        uses.append(0)
        for j in target:
            at[j] = len(nodes) - 1
    return nodes, stores, uses


def apply_operation(op: int, args: list[CExpression]) -> CExpression:
    """The C of one operation."""
    if op in _INFIX:
        sign, binds, left, right = _INFIX[op]
        a, b = (arg.number for arg in args)
        return CExpression(
            f"{a.within(left)} {sign} {b.within(right)}" if binds == SUM else f"{a.within(left)}{sign}{b.within(right)}", binds
        )
    if op in _COMPARISON_SIGNS:
        a, b = (arg.number for arg in args)
        return CExpression(f"{a.within(SUM)} {_COMPARISON_SIGNS[op]} {b.within(SUM)}", COMPARISON, True)
    if op in (ca.OP_AND, ca.OP_OR):
        sign = "&&" if op == ca.OP_AND else "||"
        return CExpression(f"{args[0].condition.within(ATOM)} {sign} {args[1].condition.within(ATOM)}", LOGICAL, True)
    if op == ca.OP_NOT:
        return CExpression(f"!{args[0].condition.within(ATOM)}", UNARY, True)
    if op == ca.OP_IF_ELSE_ZERO:
        return CExpression(f"{args[0].condition.within(ATOM)} ? {args[1].number.within(SUM)} : 0.0", CHOICE)
    numbers = [arg.number for arg in args]
    if op == ca.OP_ASSIGN:
        return numbers[0]
    if op == ca.OP_NEG:
        return CExpression(f"-{numbers[0].within(ATOM)}", UNARY)
    if op == ca.OP_SQ:
        return CExpression(f"{numbers[0].within(ATOM)}*{numbers[0].within(ATOM)}", PRODUCT)
    if op == ca.OP_TWICE:
        return CExpression(f"2.0*{numbers[0].within(UNARY)}", PRODUCT)
    if op == ca.OP_INV:
        return CExpression(f"1.0/{numbers[0].within(ATOM)}", PRODUCT)
    if op in _C_FUNCTIONS:
        return CExpression(f"{_C_FUNCTIONS[op]}({', '.join(arg.text for arg in numbers)})")
    if op == ca.OP_CALL:
        raise CodegenError("an expression calls a CasADi Function that is not inlined; build it with never_inline=False")
    raise CodegenError(f"the operation '{_NAMES.get(op, op)}' of an expression has no counterpart in C99")


def c_number(value: float) -> CExpression:
    """A double, exactly."""
    if value != value:
        return CExpression("NAN")
    if value in (float("inf"), float("-inf")):
        return CExpression("INFINITY") if value > 0 else CExpression("-INFINITY", UNARY)
    text = repr(float(value)).removesuffix(".0") + ".0" if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))
    return CExpression(text, UNARY if text.startswith("-") else ATOM)


TABLE_WIDTH = 120  # Characters of a line of a table in C: some five numbers of 17 digits.


def c_table(name: str, values: Sequence[float] | np.ndarray, size: str, comment: str = "", kind: str = "double") -> str:
    """Return ``static const kind name[size] = {...};``."""
    numbers = [c_number(float(v)).text if kind == "double" else str(int(v)) for v in values]
    about = f" /* {comment} */" if comment else ""
    listed = "\n".join(_wrapped_lines(numbers))
    line = f"static const {kind} {name}[{size}] = {{{listed.strip()}}};{about}\n"
    return line if len(line) <= 130 else f"static const {kind} {name}[{size}] = {{{about}\n{listed}\n}};\n"


def _wrapped_lines(numbers: Sequence[str]) -> Iterator[str]:
    """The numbers in lines that are indented and up to TABLE_WIDTH long."""
    line = "   "
    for i, text in enumerate(numbers):
        item = f" {text}," if i + 1 < len(numbers) else f" {text}"
        if len(line) + len(item) > TABLE_WIDTH and len(line) > 3:
            yield line
            line = "   "
        line += item
    yield line


def exact_tables(structure: StepStructure, *, by_rows: bool = False) -> str:
    """Rows where unknowns are known exactly: y_i = factor z_j + offset, those that follow, and those that rest together.

    ``by_rows``: the code has the rows of E, and finds the columns of those that follow there.
    """
    rest = c_table("rest_row", structure.rest_rows, "MODEL_REST", "z = 0 where all are coded 0", "int")
    if not structure.unit_rows:
        return rest if structure.rest_rows else ""
    i, j, factors = zip(*structure.unit_rows, strict=True)
    return (
        c_table("unit_row", i, "MODEL_UNIT", "y_i = factor z_j + offset", "int")
        + c_table("unit_column", j, "MODEL_UNIT", kind="int")
        + c_table("unit_factor", factors, "MODEL_UNIT")
        + _following_row_tables(structure, by_rows)
        + (rest if structure.rest_rows else "")
    )


def _following_row_tables(structure: StepStructure, by_rows: bool) -> str:
    rows = structure.follow_rows
    if not rows:
        return ""
    own = c_table("follow_row", [i for i, _ in rows], "MODEL_FOLLOW", "z_i is exact where all others of row i of E are", "int")
    if by_rows:
        return own
    starts = [0, *accumulate(len(needed) for _, needed in rows)]
    return (
        own
        + c_table("follow_start", starts, "MODEL_FOLLOW + 1", kind="int")
        + c_table("follow_column", [j for _, needed in rows for j, _ in needed], "", kind="int")
    )


# Rows to a form, on average, from which on loops are written: with fewer the tables of a loop are as long as its rows.
MIN_ROWS_PER_FORM = 8


def looped_c_function(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX], comment: str = "") -> str:
    """As `c_function`; where the function is long and its rows have few forms, each form is a loop."""
    column = ca.densify(ca.vertcat(ca.SX(0, 1), *(ca.vec(e.T) for e in outputs.values())))
    whole = ca.Function("f", list(inputs.values()), [column])
    if whole.n_instructions() <= MAX_OPERATIONS:
        return c_function(name, inputs, outputs, comment)
    found = loop_forms(expression_graph(whole), [(key, i) for key, e in outputs.items() for i in range(e.numel())])
    if len(found) * MIN_ROWS_PER_FORM > column.numel():
        return c_function(name, inputs, outputs, comment)
    tables, body = LoopTables(name), []
    for form in found:
        body += _form_loop(form, list(inputs), tables)
    return tables.text() + c_function_text(name, inputs, outputs, body, comment)


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
            piece = CExpression(_input_text(inputs[args[0]], tables.index(next(leaf))))
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
