"""CasADi expressions as C functions: one assignment for each shared value, what is used once stands where it is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import casadi as ca

from nsmodel.errors import CodegenError

MAX_OPERATIONS = 3000  # Operations from which on a function is cut into several: compilers take long over long ones.
SCALAR_NAMES = ("s->t", "s->h", "AT.h")
SOLVER_PREFIXES = ("s->", "AT.")  # How the names of what is read from the solver begin; AT: the matrices of the step's length.
MAX_EXPRESSION_WIDTH = 110  # Characters of an expression from which on it gets a name of its own.
MIN_CLEARED_ZEROS = 64  # Zeros from which on a sparse matrix is cleared before its other entries are set.
TARGETS_PER_LINE = 8  # Entries set to one constant in a line.
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
    given = ["s", *(key for key in inputs if not key.startswith(SOLVER_PREFIXES))]
    arguments = [f"const {'model_solver' if key == 's' else 'double'} *{key}" for key in given]
    arguments += [f"double *restrict {key}" for key in outputs]
    whole = _column_function(inputs, entries)
    head = f"/* {comment} */\n" if comment else ""
    if whole.n_instructions() <= MAX_OPERATIONS:
        body = _assignment_lines(whole, list(inputs), [target for target, _ in entries])
        return head + c_function_text(name, arguments, [*given, *outputs], [*cleared, *body])
    parts = -(-whole.n_instructions() // MAX_OPERATIONS)
    size = -(-len(entries) // parts)
    text, calls = "", []
    for k in range(0, len(entries), size):
        part = entries[k : k + size]
        body = _assignment_lines(_column_function(inputs, part), list(inputs), [target for target, _ in part])
        text += c_function_text(f"{name}_{k // size}", arguments, [*given, *outputs], body) + "\n"
        calls.append(f"{name}_{k // size}({', '.join([*given, *outputs])});")
    return text + head + c_function_text(name, arguments, [*given, *outputs], [*cleared, *calls])


def _column_function(inputs: Mapping[str, ca.SX], entries: list[tuple[str, ca.SX]]) -> ca.Function:
    column = ca.densify(ca.vertcat(ca.SX(0, 1), *(entry for _, entry in entries)))
    return ca.Function("f", list(inputs.values()), [column], {"cse": True})


def c_function_text(name: str, arguments: list[str], names: list[str], body: list[str]) -> str:
    """A function with this body; names that it does not use are marked."""
    text = "\n".join(f"    {line}" for line in body)
    used = {"s" if word == "AT" else word for word in _c_tokens(text)}
    unused = "".join(f"    (void){key};\n" for key in names if key not in used)
    return f"static void {name}({', '.join(arguments)})\n{{\n{unused}{text}\n}}\n"


def _c_tokens(text: str) -> list[str]:
    return "".join(c if c.isalnum() or c == "_" else " " for c in text).split()


def _assignment_lines(function: ca.Function, inputs: list[str], targets: list[str]) -> list[str]:
    """The assignments of a function's graph in single-assignment form."""
    nodes, stores, uses = expression_graph(function)
    lines: list[str] = []
    pieces: dict[int, CExpression] = {}
    for i, (op, args, extra) in enumerate(nodes):
        if not uses[i]:
            continue
        if op == ca.OP_INPUT:
            key = inputs[extra[0]]
            pieces[i] = CExpression(key if key in SCALAR_NAMES else f"{key}[{extra[1]}]")
            continue
        if op == ca.OP_CONST:
            pieces[i] = c_number(extra)
            continue
        pieces[i], line = assign_if_shared(apply_operation(op, [pieces[j] for j in args]), uses[i], f"a{len(lines) + 1}")
        lines += line
    return lines + _store_lines([(targets[entry], pieces[i].text, nodes[i][0] == ca.OP_CONST) for (_, entry), i in stores])


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
