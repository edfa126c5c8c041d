"""A model as mathematics: its expressions in SymPy, its equations in LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import Bodies, ManyBodies, Member
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.errors import ModelError
from nsmodel.hypotheses.report import sympy_algebra
from nsmodel.hypotheses.report.formula import Names, formulas, written
from nsmodel.hypotheses.report.notation import bracketed, decimal, listed, symbol_latex, words
from nsmodel.laws import Law
from nsmodel.model.base import Model
from nsmodel.model.convex import ConvexSplit
from nsmodel.proof.graph import column

if TYPE_CHECKING:
    import sympy

SHOWN = 4  # Long rows, and constraints, that are written out.
WIDE = 240  # Characters of LaTeX in one line.
JOIN = r",\ "
MATRIX = 8  # Rows and columns of a matrix that are written out.


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

    entries = written(ca.SX(expr), lambda name: sp.Symbol(name, real=True), sympy_algebra.number, sympy_algebra.operation())
    rows, columns = expr.shape
    return sp.Matrix(rows, columns, lambda i, j: sympy_algebra.counted(entries[i + rows * j]))


def equations(model: Model) -> list[str]:
    """Return the model in LaTeX, one formula a line (without dollar signs); long vectors and lists are abbreviated.

    Args:
        model: bound or not; parameters without a number stay symbols.
    """
    if isinstance(model, ManyBodies):
        return _many_bodies(model)
    names = _names(model)
    if isinstance(model, SweepingProcess):
        first, *rest = _sweeping(model, names)
    elif isinstance(model, FrictionOscillator):
        first, *rest = _oscillator(model, names)
    elif isinstance(model, FirstOrderSystem):
        first, *rest = _first_order(model, names)
    elif isinstance(model, LureSystem):
        first, *rest = _lure(model, names)
    elif isinstance(model, MonotoneInclusion):
        first, *rest = _inclusion(model, names)
    else:
        raise ModelError(f"{type(model).__name__}: no equations are known for this class")
    letter = "q" if isinstance(model, SweepingProcess) else "x"
    own = [symbol_latex(name) for name in model.names or ()]
    known = own == [letter] or list(model.stems) == [letter]
    return [first, *([] if known else [f"{letter} = {listed(own)}"]), *rest]


def law_latex(law: Law) -> str:
    r"""Return the set K of a law, and what -y ∈ N_K(l) says where K is simple.

    >>> from nsmodel import relay
    >>> print(law_latex(relay(2)))
    K = \left[-1,\ 1\right]^{2} \quad \left(\lambda_i \in -\mathrm{Sgn}\left(y_i\right)\right)
    """
    factors = [factor for block in law.blocks for factor in block.latex(_Writer())]
    runs: list[tuple[str, int]] = []
    for factor in factors:
        repeats = bool(runs) and runs[-1][0] == factor
        runs = [*runs[:-1], (factor, runs[-1][1] + 1)] if repeats else [*runs, (factor, 1)]
    powers = [factor if count == 1 else f"{factor}^{{{count}}}" for factor, count in runs]
    if len(powers) > SHOWN:
        powers = [*powers[: SHOWN - 1], rf"\cdots \ {words(f'({law.size} components)')}"]
    says = {block.says() for block in law.blocks}
    word = says.pop() if len(says) == 1 else ""
    return "K = " + r" \times ".join(powers or [r"\emptyset"]) + (rf" \quad {bracketed(word)}" if word else "")


# -- the six classes ---------------------------------------------------------------------------------------------------


def _sweeping(model: SweepingProcess, names: Names) -> list[str]:
    t = "t" if ca.depends_on(model.g, model.t) else ""
    Q, f = "Q(t)" if t else "Q", "" if model.f.is_zero() else _call("f", model.f, model, names, "q")
    p = model.g.numel()
    lines = [rf"\dot{{q}} + N_{{{Q}}}(q) \ni {f or '0'}"]
    if f:
        lines += _vector_lines(f, model.f, names)
    g = "g_i(t, q)" if t else "g_i(q)"
    rows = rf"{g} \geq 0,\ i = 1, \ldots, {p}" if p != 1 else rf"{g.replace('_i', '')} \geq 0"
    lines.append(
        rf"{Q} = \left\{{ q \in {_space(len(model.names))} : {rows} \right\}}" if p else f"Q = {_space(len(model.names))}"
    )
    return [*lines, *_constraint_lines("g", model.constraints, model, names, "q"), _start("q(0)", model.q0, names)]


def _many_bodies(model: ManyBodies) -> list[str]:
    """The equation of one body, and of each family the constraint of any of its members."""
    n, d = model.bodies.q0.shape
    timed = any(ca.depends_on(family.g, model.t) for family in model.constraints.values())
    Q, i = "Q(t)" if timed else "Q", model.me.name
    f = _call("f", model.f, model, _of_members(model.me), f"q_{i}") if isinstance(model.f, ca.SX) else f"f_{i}(t, q)"
    lines = [rf"\dot{{q}}_{i} + N_{{{Q}}}(q)_{i} \ni {f},\quad {i} = 0, \ldots, {n - 1},\quad q_{i} \in {_space(d)}"]
    lines += _vector_lines(f, model.f, _of_members(model.me)) if isinstance(model.f, ca.SX) else []
    rows = []
    for name, family in model.constraints.items():
        members = [member for member in (family.first, family.second) if member is not None]
        states = [f"q_{member.name}" for member in members if isinstance(member.group, Bodies)]
        left = _call(rf"g_{{{words(name)}}}", family.g, model, _of_members(*members), *states)
        text = _text(ca.SX(family.g), _of_members(*members))[0]
        rows.append(rf"{left} = {text} \geq 0 \quad {words(f'({family.count} constraints)')}")
    lines.append(rf"{Q} = \left\{{ q : g \geq 0 \right\}}" if rows else rf"{Q} = {_space(n * d)}")
    return [*lines, *rows]


def _of_members(*members: Member) -> Names:
    """The state and the numbers of each member with its name as an index."""
    shown = {}
    for member in members:
        for key in member.group.numbers:
            own = [symbol.name() for symbol in ca.vertsplit(getattr(member, key))]
            shown |= {name: symbol_latex("_".join([key, member.name, *name.split("_")[1:]])) for name in own}
    return Names(shown, {})


def _oscillator(model: FrictionOscillator, names: Names) -> list[str]:
    damping = r" + M \dot{x}" if model.damping is not None else ""
    dry = r" + \partial\Phi(\dot{x})" if model.elements else ""
    lines = [rf"\ddot{{x}}{dry}{damping} + \partial g(x) \ni 0", f"g(x) = {_text(model.potential, names)[0]}"]
    plain = len(model.elements) == 1 and model.elements[0].H.is_eye()
    if model.elements:
        labels = ["" if plain else f"_{{{words(element.name)}}}" for element in model.elements]
        s = _text(model.s, names)[0]
        H = [rf"\theta{a}\left(\left\Vert {'' if plain else f'H{a} '}v \right\Vert\right)" for a in labels[:SHOWN]]
        more = r" + \cdots" if len(labels) > SHOWN else ""
        lines.append(r"\Phi(v) = " + " + ".join(H) + more)
        for element, a in list(zip(model.elements, labels, strict=True))[:SHOWN]:
            matrix = "" if plain else rf",\quad H{a} = {_matrix(element.H, names)}"
            lines.append(rf"\theta{a}({s}) = {_text(element.theta, names)[0]}{matrix}")
    if model.damping is not None:
        lines.append(f"M = {_matrix(model.damping, names)}")
    if model.constraints:
        lines.append(r"\mathrm{dom}\ g = \left\{ x : c_i(x) \geq 0 \right\}")
        lines += _constraint_lines("c", model.constraints, model, names, "x")
    pair = [_start("x_0", model.x0, names), _start("x_1", model.x1, names)] if model.x1 is not None else None
    pair = pair or [_start("x(0)", model.x0, names), _start(r"\dot{x}(0)", model.v0, names)]
    return [*lines, r",\quad ".join(pair)]


def _first_order(model: FirstOrderSystem, names: Names) -> list[str]:
    left = r"\dot{x}" if model.M.is_eye() else r"M\,\dot{x}"
    f = _call("f", model.f, model, names, "x")
    start = _start("x(0)", model.x0, names)
    mass = [] if model.M.is_eye() else [f"M = {_matrix(model.M, names)}"]
    if not model.lam.numel():
        return [f"{left} = {f}", *_vector_lines(f, model.f, names), *mass, start]
    h, g = _call("h", model.h, model, names, "x", r"\lambda"), _call("g", model.g, model, names, "x", r"\lambda")
    symbols = listed(_text(model.lam, names))
    return [
        rf"{left} = {f} + r,\quad y = {h},\quad r = {g},\quad -y \in N_K(\lambda)",
        *_vector_lines(f, model.f, names),
        *_vector_lines(h, model.h, names),
        *_vector_lines(g, model.g, names),
        *([] if symbols == r"\lambda" else [rf"\lambda = {symbols}"]),
        *mass,
        law_latex(model.law),
        start,
    ]


def _lure(model: LureSystem, names: Names) -> list[str]:
    jacobian = ca.jacobian(model.A, model.x)
    linear = not ca.depends_on(jacobian, model.x)
    A = r"A\,x" if linear else "A(x)"
    f = "" if model.f.is_zero() else _call("f", model.f, model, names)
    D = "" if model.D.is_zero() else r" + D\,\lambda"
    relation = r"-y \in N_K(\lambda)" if model.law is not None else r"\lambda \in -\partial\Phi(y)"
    lines = [rf"\dot{{x}} = {A} + B\,\lambda{f' + {f}' if f else ''},\quad y = C\,x{D},\quad {relation}"]
    lines += [f"A = {_matrix(jacobian, names)}"] if linear else _vector_lines("A(x)", model.A, names)
    lines.append(rf"B = {_matrix(model.B, names)},\quad C = {_matrix(model.C, names)}")
    lines += [f"D = {_matrix(model.D, names)}"] if D else []
    lines += _vector_lines(f, model.f, names) if f else []
    lines.append(law_latex(model.law) if model.law is not None else rf"\Phi(y) = {_text(model.phi, names)[0]}")
    return [*lines, _start("x(0)", model.x0, names)]


def _inclusion(model: MonotoneInclusion, names: Names) -> list[str]:
    potential = model.potential_split
    single = potential is None and model.operator.is_zero()
    bounds = [_text(side, names) for side in (model.lower, model.upper)]
    box = set(bounds[0]) != {r"-\infty"} or set(bounds[1]) != {r"\infty"}
    jumps = ca.vertcat(model.operator, model.sign_arguments)
    F, Sx = _call("F", model.field, model, names, "x"), _call("S", jumps, model, names, "x")
    moving = ca.vertcat(model.lower, model.upper, *model.constraints.values())
    C = _call("C", moving, model, names) if box or model.constraints else ""
    S, N = ("" if single else f" - {Sx}"), (rf" - N_{{{C}}}(x)" if C else "")
    lines = [rf"\dot{{x}} \in {F}{S}{N}" if S or N else rf"\dot{{x}} = {F}", *_vector_lines(F, model.field, names)]
    if potential is not None:
        lines.append(rf"S = \partial\Phi,\quad \Phi(x) = {_text(_potential(potential), names)[0]}")
    elif not single:
        jumps = [rf"\mathrm{{Sgn}}\left({text}\right)" for text in _text(model.sign_arguments, names)]
        symbols = [str(symbol) for symbol in ca.vertsplit(model.sign_symbols)] if jumps else []
        marked = Names({**names.shown, **dict(zip(symbols, jumps, strict=True))}, names.vectors)
        lines += _vector_lines(Sx, model.operator, marked)
    if N:
        sides = [_box(*bounds)] if box else []
        sides += [r"c_i(x) \geq 0,\ i = 1, \ldots, " + str(len(model.constraint_names))] if model.constraints else []
        lines.append(rf"{C} = \left\{{ x : {JOIN.join(sides)} \right\}}")
    return [*lines, *_constraint_lines("c", model.constraints, model, names, "x"), _start("x(0)", model.x0, names)]


# -- their parts -------------------------------------------------------------------------------------------------------


def _names(model: Model) -> Names:
    """The states under the user's names, where these are not the symbols' own."""
    state = model.q if isinstance(model, SweepingProcess) else model.x
    symbols = [str(symbol) for symbol in ca.vertsplit(state)]
    shown = {symbol: symbol_latex(name) for symbol, name in zip(symbols, model.names, strict=True) if symbol != name}
    vectors = {stem: [symbols[i] for i in rows] for stem, rows in model.stems.items() if len(rows) > 1}
    return Names(shown, vectors)


def _text(expr: ca.SX, names: Names) -> list[str]:
    try:
        return formulas(expr, names)
    except ModelError:
        return [rf"\left[{words('a function')}\right]"] * expr.numel()


def _space(n: int) -> str:
    return r"\mathbb{R}" if n == 1 else rf"\mathbb{{R}}^{{{n}}}"


def _call(name: str, expr: ca.SX, model: Model, names: Names, *arguments: str) -> str:
    """f(t, q), or f(q) where it does not depend on t."""
    shown = [*(["t"] if ca.depends_on(expr, model.t) else []), *arguments]
    return f"{name}({', '.join(shown)})" if shown else name


def _vector_lines(left: str, expr: ca.SX, names: Names) -> list[str]:
    """left = (its entries), or a line for each of the first entries that are not 0 where these are long or many."""
    n = expr.numel()
    if n <= MATRIX and sum(map(len, entries := _text(expr, names))) <= WIDE:
        return [f"{left} = {listed(entries)}"]
    filled = [i for i in range(n) if not expr[i].is_zero()]
    head, bracket, arguments = left.partition("(")
    rows = [f"{head}_{{{i}}}{bracket}{arguments} = {_text(expr[i], names)[0]}" for i in filled[:SHOWN]]
    zeros = f", {n - len(filled)} of them 0" if len(filled) < n else ""
    return rows if len(rows) == n else [*rows, rf"\vdots \quad {words(f'({n} components{zeros})')}"]


def _constraint_lines(letter: str, constraints: Any, model: Model, names: Names, state: str) -> list[str]:
    """The first constraints by their names, and how many there are."""
    lines, count = [], sum(part.numel() for part in constraints.values())
    for name, part in constraints.items():
        for i in range(part.numel()):
            if len(lines) == SHOWN:
                return [*lines, rf"\vdots \quad {words(f'({count} constraints)')}"]
            label = name if part.numel() == 1 else f"{name}[{i}]"
            left = _call(rf"{letter}_{{{words(label)}}}", part[i], model, names, state)
            lines.append(rf"{left} = {_text(part[i], names)[0]} \geq 0")
    return lines


def _start(left: str, expr: ca.SX, names: Names) -> str:
    return f"{left} = {listed(_text(expr, names))}"


def _matrix(matrix: ca.SX, names: Names) -> str:
    """A matrix; of a large one the shape, and the number of entries that are not 0."""
    rows, columns = matrix.shape
    if max(rows, columns) > MATRIX:
        filled = ca.sparsify(matrix).nnz()
        return rf"{words(f'({rows} x {columns} matrix, {filled} entries not 0)')}"
    if (rows, columns) == (1, 1):
        return _text(matrix, names)[0]
    entries = np.array(_text(ca.densify(matrix), names), dtype=object).reshape(columns, rows).T
    body = r" \\ ".join(" & ".join(row) for row in entries)
    return rf"\begin{{pmatrix}} {body} \end{{pmatrix}}"


def _box(lower: Sequence[str], upper: Sequence[str]) -> str:
    """The conditions lower <= x <= upper, once where all components have the same."""
    pairs = list(zip(lower, upper, strict=True))
    if len(set(pairs)) == 1:
        return _between(*pairs[0], "x" if len(pairs) == 1 else "x_i")
    rows = [_between(a, b, f"x_{{{i}}}") for i, (a, b) in enumerate(pairs)]
    kept = [row for row in rows if row]
    return JOIN.join(kept if len(kept) <= SHOWN else [*kept[:SHOWN], r"\ldots"])


def _between(low: str, high: str, name: str) -> str:
    if low == r"-\infty":
        return rf"{name} \leq {high}" if high != r"\infty" else ""
    return rf"{low} \leq {name} \leq {high}" if high != r"\infty" else rf"{name} \geq {low}"


def _potential(split: ConvexSplit) -> ca.SX:
    """The potential put together again, without the indicators of its domain."""
    shape = {"abs": ca.fabs, "max": lambda u: ca.fmax(u, 0), "norm": ca.norm_2}
    terms = [term.weight * shape[term.kind](term.u) for term in split.terms if term.kind in shape]
    return split.smooth + ca.sum1(column(terms))


class _Writer:
    """What laws write their sets with."""

    def number(self, expression: ca.SX) -> str:
        """A scalar."""
        return _text(expression, Names({}, {}))[0]

    def matrix(self, matrix: Any) -> str:
        """A matrix."""
        return _matrix(ca.SX(matrix), Names({}, {}))

    def column(self, numbers: Sequence[float]) -> str:
        """A column of numbers."""
        return listed([decimal(float(value)) for value in numbers])

    def space(self, m: int) -> str:
        """R^m."""
        return _space(m)
