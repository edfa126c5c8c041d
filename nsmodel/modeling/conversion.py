"""What a user may write (numbers, lists, NumPy, CasADi DM, SX and MX, SymPy) turned into CasADi SX.

Symbols are matched by name, so that ``parameters={"k": 2.0}`` fits any expression with a symbol called k. A vector
symbol stands for its scalars q_0, q_1, ...: the names that ``SX.sym("q", 2)`` gives, and here ``MX.sym("q", 2)`` too.

Expressions of SymPy, which is never imported here, as SX.

Symbols that a user declares, of CasADi or SymPy, by their names.
"""

from __future__ import annotations

import numbers
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.modeling.expressions import expand_tables
from nsmodel.proof.expression_graph import numeric_constants, stack_column

_Named = tuple[str, ca.SX, Any]


def read_symbols(value: Any, label: str) -> list[_Named]:
    """List (scalar name, SX symbol, the user's object)."""
    if isinstance(value, str):
        return [(value, ca.SX.sym(value), value)]
    if isinstance(value, ca.SX) and value.is_dense() and value.is_valid_input():
        return [(s.name(), s, s) for s in ca.vertsplit(ca.vec(value))]
    if isinstance(value, ca.MX) and value.is_dense() and value.is_valid_input():
        return [(name, ca.SX.sym(name), mx) for mx in value.primitives() for name in entry_names(mx.name(), mx.numel())]
    if isinstance(value, np.ndarray) and value.dtype == object:
        return read_symbols(value.ravel().tolist(), label)
    if isinstance(value, list | tuple):
        return [pair for item in value for pair in read_symbols(item, label)]
    found = _sympy_symbols(value, label) if is_sympy(value) else None
    if found is not None:
        return found
    raise ModelError(
        f"{label}: {describe_value(value)} is not a symbol; expected symbols only, such as ca.SX.sym('{_example_name(label)}', "
        "2), a list of scalar symbols, or SymPy symbols"
    )


def _sympy_symbols(value: Any, label: str) -> list[_Named] | None:
    if type(value).__name__ == "MatrixSymbol":
        return [(name, ca.SX.sym(name), value) for name in entry_names(value.name, int(value.rows * value.cols))]
    if hasattr(value, "tolist"):
        return read_symbols(flatten_lists(value.tolist()), label)
    scalar = getattr(value, "is_Symbol", False) and not hasattr(value, "shape")
    return [(value.name, ca.SX.sym(value.name), value)] if scalar else None


def entry_names(name: str, size: int) -> list[str]:
    """Name the scalars of a symbol as SX.sym does, column by column."""
    return [name] if size == 1 else [f"{name}_{i}" for i in range(size)]


def common_stem(names: Sequence[str]) -> str | None:
    """The name q of q_0, q_1, ...; None where there is none."""
    if len(names) == 1:
        return names[0]
    stem = names[0].removesuffix("_0") if names else ""
    return stem if stem and list(names) == [f"{stem}_{i}" for i in range(len(names))] else None


def check_distinct_names(names: Sequence[str], label: str) -> None:
    """Refuse names that stand there twice."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise ModelError(f"{label}: the symbol '{repeated[0]}' is declared twice; give each symbol its own name")


def names_read(value: Any) -> set[str]:
    """The names of the scalar symbols that an expression of CasADi or of SymPy reads."""
    if isinstance(value, ca.SX | ca.MX):
        return {name for symbol in ca.symvar(value) for name in entry_names(symbol.name(), symbol.numel())}
    return {name for symbol in value.free_symbols for name, *_ in _sympy_symbols(symbol, "") or ()}


def check_declared(names: Any, symbols: Mapping[str, ca.SX], label: str) -> None:
    """Refuse a symbol that was not declared."""
    for name in names:
        if name not in symbols:
            whole = name.rpartition("_")[0]
            fix = (
                f"'{whole}' is declared as one number; give parameters={{'{whole}': [...]}} as many as it has entries"
                if whole in symbols
                else "add it to parameters={...}, to inputs={...} if it is a signal, or declare it as x=, t="
            )
            raise ModelError(
                f"{label} uses the symbol '{name}', which is not declared: {fix}; declared are {', '.join(symbols) or 'none'}"
            )


def is_sympy(value: Any) -> bool:
    """Whether a value is of SymPy."""
    return any(str(base.__module__).partition(".")[0] == "sympy" for base in type(value).__mro__)


def is_casadi(value: Any) -> bool:
    """Whether a value is an expression of CasADi or of SymPy."""
    return isinstance(value, ca.SX | ca.MX | ca.DM) or is_sympy(value)


def flatten_lists(rows: Any) -> list[Any]:
    """The entries of nested lists."""
    return [item for row in rows for item in flatten_lists(row)] if isinstance(rows, list) else [rows]


def describe_value(value: Any) -> str:
    """A value in a message, cut short."""
    text = str(value)
    return f"{text if len(text) <= 60 else text[:57] + '...'} (a {type(value).__name__})"


def _example_name(label: str) -> str:
    return label if label.isidentifier() else "x"


def _equals(value: ca.SX, number: float) -> bool:
    return value.is_constant() and float(value) == number


def _heaviside(u: ca.SX, at_zero: ca.SX) -> ca.SX:
    """(1 + sign u)/2, so that split_discontinuities sees the jump."""
    step = (1 + ca.sign(u)) / 2
    return step if _equals(at_zero, 0.5) else ca.if_else(u == 0, at_zero, step)


_SYMPY: dict[str, Callable[..., ca.SX]] = {
    "Add": lambda *args: reduce(lambda a, b: a + b, args),
    "Mul": lambda *args: reduce(lambda a, b: a * b, args),
    "Max": lambda *args: reduce(ca.fmax, args),
    "Min": lambda *args: reduce(ca.fmin, args),
    "Pow": lambda base, exponent: ca.sqrt(base) if _equals(exponent, 0.5) else base**exponent,
    "Abs": ca.fabs,
    "Heaviside": _heaviside,
    "ceiling": ca.ceil,
    "LessThan": lambda a, b: a <= b,
    "StrictLessThan": lambda a, b: a < b,
    "GreaterThan": lambda a, b: a >= b,
    "StrictGreaterThan": lambda a, b: a > b,
    "Equality": lambda a, b: a == b,
    "Unequality": lambda a, b: a != b,
    "And": lambda *args: reduce(ca.logic_and, args),
    "Or": lambda *args: reduce(ca.logic_or, args),
    "Not": ca.logic_not,
    "BooleanTrue": lambda: ca.SX(1),
    "BooleanFalse": lambda: ca.SX(0),
    **{
        name: getattr(ca, name)
        for name in "exp log sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh sign floor erf".split()
    },
}


def from_sympy(expr: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    """The expression in the declared symbols."""
    name = type(expr).__name__
    if name in ("Symbol", "Dummy"):
        check_declared([expr.name], symbols, label)
        return symbols[expr.name]
    if name == "MatrixElement":
        matrix, i, j = expr.args
        entries = entry_names(matrix.name, int(matrix.rows * matrix.cols))
        check_declared([entry := entries[int(i + j * matrix.rows)]], symbols, label)
        return symbols[entry]
    if expr.is_Number or getattr(expr, "is_NumberSymbol", False):
        return ca.SX(float(expr))
    if name == "Piecewise":
        return _from_piecewise(expr, symbols, label)
    if name not in _SYMPY:
        raise ModelError(
            f"{label}: '{name}' in {expr} has no CasADi counterpart; write it with elementary functions, "
            "sqrt, Abs, Max, Min, sign or Piecewise, or call .doit() first"
        )
    return _SYMPY[name](*(from_sympy(arg, symbols, label) for arg in expr.args))


def _from_piecewise(expr: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    pieces = [(from_sympy(piece, symbols, label), from_sympy(cond, symbols, label)) for piece, cond in expr.args]
    if not pieces[-1][1].is_one():
        raise ModelError(f"{label}: {expr} has no value where none of its conditions holds; end it with (expression, True)")
    result = pieces[-1][0]
    for piece, condition in reversed(pieces[:-1]):
        result = ca.if_else(condition, piece, result)
    return result


@dataclass(frozen=True, eq=False)
class DeclaredSymbols:
    """Symbols that the user declared under one label (x=, t=, a key of parameters).

    Attributes:
        names: the n scalar names, in order.
        stem: the name of the whole: q for q_0, q_1, ...; the name itself for one scalar; None where there is none.
        sx: SX (n, 1) of scalar symbols, the user's own where they are SX.
        source: the user's objects: SX scalars, MX symbols, SymPy symbols or names.
    """

    names: tuple[str, ...]
    stem: str | None
    sx: ca.SX
    source: tuple[Any, ...]


def declare(value: Any, label: str) -> DeclaredSymbols:
    """Read ``value`` as symbols: SX or MX (vertcat allowed), SymPy Symbol or Matrix of them, a name, a list of these.

    Raises:
        ModelError: something else than symbols, or a name that repeats.

    >>> declare([ca.SX.sym("q_0"), ca.SX.sym("q_1")], "q").stem
    'q'
    """
    pairs = read_symbols(value, label)
    names = tuple(name for name, _, _ in pairs)
    check_distinct_names(names, label)
    source = tuple(item for i, (_, _, item) in enumerate(pairs) if i == 0 or item is not pairs[i - 1][2])
    return DeclaredSymbols(names, common_stem(names), stack_column([symbol for _, symbol, _ in pairs]), source)


@dataclass(frozen=True, eq=False)
class Converter:
    """Turns expressions of the declared symbols into SX.

    Raises:
        ModelError: on construction, when two declarations share a name.

    >>> Converter([declare(ca.SX.sym("x"), "x")]).convert([1, 2], "x0")
    SX([1, 2])
    """

    declared: Sequence[DeclaredSymbols]

    def __post_init__(self) -> None:
        """Refuse a name declared twice."""
        check_distinct_names([name for item in self.declared for name in item.names], "the declared symbols")

    @cached_property
    def symbols(self) -> dict[str, ca.SX]:
        """{scalar name: SX symbol} of everything declared."""
        return {name: symbol for d in self.declared for name, symbol in zip(d.names, ca.vertsplit(d.sx), strict=False)}

    def convert(self, value: Any, label: str) -> ca.SX:
        """See :func:`to_sx`."""
        return to_sx(value, self.symbols, label)


def to_sx(value: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    """Convert ``value`` to an SX matrix in the given symbols.

    Args:
        value: a number, a list (a column; its entries numbers, scalar expressions of any kind, or columns), a nested
            list (rows of a matrix), a NumPy or SciPy array, DM, SX, MX, a SymPy expression or Matrix.
        symbols: {scalar name: SX symbol}.
        label: the user's name of ``value``, for messages.

    Raises:
        ModelError: an undeclared symbol, a NaN, rows of unequal length, an unknown function or type.
    """
    result = expand_tables(_convert(value, symbols, label))
    used = ca.symvar(result)
    known = {symbol.element_hash() for symbol in symbols.values()} if used else set()
    check_declared((symbol.name() for symbol in used), symbols, label)
    strange = [symbol for symbol in used if symbol.element_hash() not in known]
    if strange:
        result = ca.substitute(result, stack_column(strange), stack_column([symbols[symbol.name()] for symbol in strange]))
    _check_no_nan(result, label)
    return result


def expand_mx(exprs: Sequence[ca.MX], mx_symbols: Sequence[ca.MX], sx_symbols: Sequence[ca.SX], label: str) -> list[ca.SX]:
    """Write MX expressions with SX operations, ``sx_symbols[i]`` (of the same shape) in place of ``mx_symbols[i]``.

    Raises:
        ModelError: an operation that has no SX form.
    """
    try:
        return [ca.SX(e) for e in ca.Function("expand", list(mx_symbols), list(exprs)).expand().call(list(sx_symbols), True)]
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise ModelError(
            f"{label} cannot be written with scalar operations ({reason}); build it from SX symbols and elementary "
            "functions: ca.pw_lin in place of a table or interpolant, ca.solve(A, b) with A, b of SX for a linear solve"
        ) from None


def _convert(value: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    if isinstance(value, ca.SX):
        return value
    if isinstance(value, ca.DM):
        return ca.SX(value)
    if isinstance(value, ca.MX):
        return _from_mx(value, symbols, label)
    if isinstance(value, np.ndarray | np.generic):
        return _from_array(value, symbols, label)
    if isinstance(value, numbers.Real):
        try:
            return ca.SX(float(value))
        except OverflowError:
            raise ModelError(f"{label}: a whole number beyond 1.8e308; expected one that a double can hold") from None
    if isinstance(value, list | tuple):
        return _from_list(value, symbols, label)
    if is_sympy(value):
        value = value.as_explicit() if hasattr(value, "as_explicit") else value
        matrix = hasattr(value, "tolist")
        return _from_list(value.tolist(), symbols, label) if matrix else from_sympy(value, symbols, label)
    if hasattr(value, "tocsc"):
        return _from_sparse(value, label)
    hint = "; call it with your symbols" if callable(value) else ""
    raise ModelError(
        f"{label}: {describe_value(value)} is not an expression{hint}; expected a number, a list, an array, CasADi SX or MX, or "
        "SymPy"
    )


def _from_mx(value: ca.MX, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    own = ca.symvar(value)
    check_declared((name for mx in own for name in entry_names(mx.name(), mx.numel())), symbols, label)
    columns = [ca.reshape(stack_column([symbols[name] for name in entry_names(mx.name(), mx.numel())]), *mx.shape) for mx in own]
    return expand_mx([value], own, columns, label)[0]


def _from_array(value: Any, symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    if value.ndim > 2:
        raise ModelError(f"{label}: shape {value.shape}; expected a scalar, a vector or a matrix")
    if value.dtype.kind in "biuf":
        return ca.SX(ca.DM(value.astype(float))) if value.size else ca.SX(*value.shape, *([1] * (2 - value.ndim)))
    if value.ndim == 2:
        return _read_matrix_rows([[_convert(entry, symbols, label) for entry in row] for row in value.tolist()], label)
    return _convert(value.tolist() if value.ndim else value.item(), symbols, label)


def _from_sparse(value: Any, label: str) -> ca.SX:
    """A sparse array of SciPy, entries given twice added up."""
    if value.ndim != 2 or value.dtype.kind not in "biuf":
        raise ModelError(f"{label}: a sparse array of shape {value.shape} and type {value.dtype}; expected a real matrix")
    matrix = value.tocsc().astype(float)
    matrix.sum_duplicates()
    return ca.SX(ca.DM(matrix))


def _from_list(value: Sequence[Any], symbols: Mapping[str, ca.SX], label: str) -> ca.SX:
    """Read a list of rows where any entry is a list or 1-D array, else a column of scalars and columns."""
    if any(isinstance(item, list | tuple) or np.ndim(item) == 1 for item in value if not is_casadi(item)):
        return _read_matrix_rows([[_convert(entry, symbols, label) for entry in _row_entries(row)] for row in value], label)
    pieces = [_convert(item, symbols, label) for item in value]
    for i, piece in enumerate(pieces):
        if piece.shape[1] != 1:
            raise ModelError(f"{label}[{i}]: shape {piece.shape}; expected a scalar or a column; stack matrices with ca.vertcat")
    return stack_column(pieces)


def _read_matrix_rows(rows: list[list[ca.SX]], label: str) -> ca.SX:
    lengths = [len(row) for row in rows]
    if len(set(lengths)) > 1:
        raise ModelError(f"{label}: the rows have {', '.join(map(str, lengths))} entries; expected rows of one length")
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            if entry.numel() != 1:
                raise ModelError(
                    f"{label}[{i}][{j}]: shape {entry.shape}; a nested list holds scalars; for blocks use ca.blockcat"
                )
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) if rows and lengths[0] else ca.SX(len(rows), 0)


def _row_entries(row: Any) -> list[Any]:
    return list(row) if isinstance(row, list | tuple) or (isinstance(row, np.ndarray) and row.ndim) else [row]


def _check_no_nan(value: ca.SX, label: str) -> None:
    numbers = np.array(ca.DM(value).nonzeros()) if value.is_constant() else numeric_constants(value)
    if not np.isnan(numbers).any():
        return
    where = next(
        (i, j) for i, j in zip(*value.sparsity().get_triplet(), strict=True) if np.isnan(numeric_constants(value[i, j])).any()
    )
    index = "" if value.numel() == 1 else f"[{where[0]}]" if value.shape[1] == 1 else f"[{where[0]}, {where[1]}]"
    raise ModelError(f"{label}{index} holds a NaN; give a number (inf is allowed) or an expression")
