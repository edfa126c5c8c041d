"""A model as mathematics: its expressions in SymPy, its equations in LaTeX."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.hypotheses import latex as sympy_algebra
from nsmodel.hypotheses.latex import (
    SymbolNames,
    bracketed,
    formulas,
    number_latex,
    symbol_latex,
    text_latex,
    translate_expression,
    vector_latex,
)
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law
from nsmodel.modeling.parts import Part

if TYPE_CHECKING:
    import sympy

# Long rows, and constraints, that are written out: a report shows what a model looks like; its file holds the rest.
MAX_LISTED_ROWS = 4
MAX_LINE_LENGTH = 240  # Characters of LaTeX in one line; entries that are longer together have a line each.
# Rows and columns of a matrix that are written out; of a larger one its shape and how many entries are not 0.
MAX_MATRIX_SIZE = 8


def to_sympy(expr: ca.SX) -> sympy.Matrix:
    """Return ``expr`` as a SymPy matrix of the same shape, its symbols real and under the same names.

    Numbers are exact: those that the user wrote, 0.1 as 1/10 (not the double next to it); doubles of 15 and more digits that
    are those of a simple p/q, p/q pi, p/q sqrt(2) or p/q sqrt(3) become these.

    Raises:
        ModelError: an operation that SymPy does not know, or a Function that cannot be looked into.

    >>> to_sympy(ca.SX.sym("k") * 0.1)
    Matrix([[k/10]])
    """
    import sympy as sp

    entries = translate_expression(
        ca.SX(expr), lambda name: sp.Symbol(name, real=True), sympy_algebra.sympy_number, sympy_algebra.make_sympy_apply()
    )
    rows, columns = expr.shape
    return sp.Matrix(rows, columns, lambda i, j: sympy_algebra.condition_as_number(entries[i + rows * j]))


EQUATIONS = Part[Callable[[Any], list[str]]]("documents.equations")


def model_equations(model: Model) -> list[str]:
    """Return the model in LaTeX, one formula a line (without dollar signs); long vectors and lists are abbreviated.

    Args:
        model: bound or not; parameters without a number stay symbols.
    """
    return EQUATIONS.of(model)(model)


def law_latex(law: Law) -> str:
    r"""Return the set K of a law, and what -y ∈ N_K(l) says where K is simple.

    >>> from nsmodel import relay
    >>> print(law_latex(relay(2)))
    K = \left[-1,\ 1\right]^{2} \quad \left(\lambda_i \in -\mathrm{Sgn}\left(y_i\right)\right)
    """
    factors = [factor for block in law.blocks for factor in block.latex(_LatexWriter())]
    runs: list[tuple[str, int]] = []
    for factor in factors:
        repeats = bool(runs) and runs[-1][0] == factor
        runs = [*runs[:-1], (factor, runs[-1][1] + 1)] if repeats else [*runs, (factor, 1)]
    powers = [factor if count == 1 else f"{factor}^{{{count}}}" for factor, count in runs]
    if len(powers) > MAX_LISTED_ROWS:
        powers = [*powers[: MAX_LISTED_ROWS - 1], rf"\cdots \ {text_latex(f'({law.size} components)')}"]
    says = {block.latex_relation() for block in law.blocks}
    word = says.pop() if len(says) == 1 else ""
    return "K = " + r" \times ".join(powers or [r"\emptyset"]) + (rf" \quad {bracketed(word)}" if word else "")


# -- parts of equations -------------------------------------------------------------------------------------------------------


def symbol_names(model: Model) -> SymbolNames:
    """The states under the user's names, where these are not the symbols' own."""
    symbols = [str(symbol) for symbol in ca.vertsplit(model.state)]
    latex = {symbol: symbol_latex(name) for symbol, name in zip(symbols, model.names, strict=True) if symbol != name}
    vectors = {stem: [symbols[i] for i in rows] for stem, rows in model.stems.items() if len(rows) > 1}
    return SymbolNames(latex, vectors)


def state_lines(model: Model) -> list[str]:
    """What the state is made of; nothing where its letter says it."""
    own = [symbol_latex(name) for name in model.names or ()]
    known = own == [model.letter] or list(model.stems) == [model.letter]
    return [] if known else [f"{model.letter} = {vector_latex(own)}"]


def entry_formulas(expr: ca.SX, names: SymbolNames) -> list[str]:
    """Its entries; in words where they cannot be looked into."""
    try:
        return formulas(expr, names)
    except ModelError:
        return [rf"\left[{text_latex('a function')}\right]"] * expr.numel()


def space_latex(n: int) -> str:
    """The space R^n in LaTeX."""
    return r"\mathbb{R}" if n == 1 else rf"\mathbb{{R}}^{{{n}}}"


def function_call_latex(name: str, expr: ca.SX, model: Model, names: SymbolNames, *arguments: str) -> str:
    """f(t, q), or f(q) where it does not depend on t."""
    written_arguments = [*(["t"] if ca.depends_on(expr, model.t) else []), *arguments]
    return f"{name}({', '.join(written_arguments)})" if written_arguments else name


def vector_lines(left: str, expr: ca.SX, names: SymbolNames) -> list[str]:
    """left = (its entries), or a line for each of the first entries that are not 0 where these are long or many."""
    n = expr.numel()
    if n <= MAX_MATRIX_SIZE and sum(map(len, entries := entry_formulas(expr, names))) <= MAX_LINE_LENGTH:
        return [f"{left} = {vector_latex(entries)}"]
    filled = [i for i in range(n) if not expr[i].is_zero()]
    head, bracket, arguments = left.partition("(")
    rows = [f"{head}_{{{i}}}{bracket}{arguments} = {entry_formulas(expr[i], names)[0]}" for i in filled[:MAX_LISTED_ROWS]]
    zeros = f", {n - len(filled)} of them 0" if len(filled) < n else ""
    return rows if len(rows) == n else [*rows, rf"\vdots \quad {text_latex(f'({n} components{zeros})')}"]


def constraint_lines(letter: str, constraints: Any, model: Model, names: SymbolNames, state: str) -> list[str]:
    """The first constraints by their names, and how many there are."""
    lines, count = [], sum(part.numel() for part in constraints.values())
    for name, part in constraints.items():
        for i in range(part.numel()):
            if len(lines) == MAX_LISTED_ROWS:
                return [*lines, rf"\vdots \quad {text_latex(f'({count} constraints)')}"]
            label = name if part.numel() == 1 else f"{name}[{i}]"
            left = function_call_latex(rf"{letter}_{{{text_latex(label)}}}", part[i], model, names, state)
            lines.append(rf"{left} = {entry_formulas(part[i], names)[0]} \geq 0")
    return lines


def start_line(left: str, expr: ca.SX, names: SymbolNames) -> str:
    """left = (its numbers)."""
    return f"{left} = {vector_latex(entry_formulas(expr, names))}"


def matrix_latex(matrix: ca.SX, names: SymbolNames) -> str:
    """A matrix; of a large one the shape, and the number of entries that are not 0."""
    rows, columns = matrix.shape
    if max(rows, columns) > MAX_MATRIX_SIZE:
        filled = ca.sparsify(matrix).nnz()
        return rf"{text_latex(f'({rows} x {columns} matrix, {filled} entries not 0)')}"
    if (rows, columns) == (1, 1):
        return entry_formulas(matrix, names)[0]
    entries = np.array(entry_formulas(ca.densify(matrix), names), dtype=object).reshape(columns, rows).T
    body = r" \\ ".join(" & ".join(row) for row in entries)
    return rf"\begin{{pmatrix}} {body} \end{{pmatrix}}"


class _LatexWriter:
    """What laws write their sets with."""

    def number(self, expression: ca.SX) -> str:
        """A scalar expression in LaTeX."""
        return entry_formulas(expression, SymbolNames({}, {}))[0]

    def matrix(self, matrix: Any) -> str:
        """A matrix in LaTeX."""
        return matrix_latex(ca.SX(matrix), SymbolNames({}, {}))

    def column(self, numbers: Sequence[float] | np.ndarray) -> str:
        """A column of numbers."""
        return vector_latex([number_latex(float(value)) for value in numbers])

    def space(self, m: int) -> str:
        """The space R^m in LaTeX."""
        return space_latex(m)
