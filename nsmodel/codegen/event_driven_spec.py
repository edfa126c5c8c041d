"""What the C of event-driven integration is written of: a problem, its matrices, and what the code has for them.

What pieces of stiff modes in C are made of: the matrices of Radau IIA; f, g and h on one side of each switch, and slopes.

What follows from parameters alone is computed when these are set: the recurrences of event-driven integration read it.

One library serves all values of the parameters: the problem is that of the model before it has values (`make_symbolic_problem`),
its structure that of all values: which entries of B, D, C can be other than 0, never which are. An operation that is a switch of
parameters alone is none. Whether x is unique in all modes is decided for the values; ends that cross are BAD_PARAMETER; a W_ii
that is 0 for some values, where all others let it be divided by, is NO_MODE. `simulate` takes that library for every model with
parameters, at 0.83 to 1.5 times (median 1.03) the time of one for the values alone; not where a switch looks at something else
than with its values, nor where rows are others. Known times, and what is held after each, are tables that a run brings: one
library serves all signals of a degree. In an exported one inputs are parameters, held between calls.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object, cached_per_object_and_key
from nsmodel.codegen.expressions import c_function, c_table
from nsmodel.codegen.recurrences import ANY_DEGREE, DiscTable, RecurrencePrinter, SeriesColumns, constant_factor_index
from nsmodel.codegen.step_spec import moving_signals_reason
from nsmodel.errors import CodegenError
from nsmodel.event_driven.bernstein import ORDERS
from nsmodel.event_driven.collocation import Collocation, radau_collocation
from nsmodel.event_driven.friction_modes import with_stick_slip_modes
from nsmodel.event_driven.integrator import MIN_RTOL
from nsmodel.event_driven.multipliers import SHORT, SINGULAR, is_monotone
from nsmodel.event_driven.problem import CONTINUOUS_PROBLEM, ContinuousProblem, NotEventDriven, with_input_states
from nsmodel.event_driven.radau import FixedBranches, SlopeMatrix, fixed_branches, stage_count
from nsmodel.event_driven.recurrences import taylor_decompose
from nsmodel.event_driven.stable_exponentials import without_overflow
from nsmodel.event_driven.step_size import LARGEST_ORDER, ROUGHEST, taylor_order
from nsmodel.modeling.base import Model
from nsmodel.modeling.variants import initial_inputs, inputs_as_parameters
from nsmodel.proof.expression_graph import apply_operation, fold_graph, numeric_constants, operation_codes, symbol_hashes

# Of Radau IIA, for the roughest and the strictest rtol.
MIN_STAGES, MAX_STAGES = (stage_count(taylor_order(rtol)) for rtol in (ROUGHEST, MIN_RTOL))
MATRICES_BYTES = 32 << 10  # Memory for the matrices of modes, or of lengths: 32 KB, about the first cache of a processor.
MAX_UNKNOWNS = 32  # Rows of x and l: matrices of the stages are dense, and kept; with more C has no stiff pieces.


def kept_matrix_count(size: int, least: int, most: int) -> int:
    """How many matrices of so many bytes are kept."""
    return max(least, min(MATRICES_BYTES // size, most))


def collocation_code(spec: PieceSpec, given: Mapping[str, ca.SX]) -> str:
    """The tables and functions; ``given``: t, x, l and parameters by their names."""
    of = _on_sides(spec)
    sided = dict(given) | ({"s->at.choice": of.choices} if of.choices.numel() else {})
    text = _radau_tables()
    if of.choices.numel():
        text += _piece_function("sides", sided, dict(zip(("rate", "y", "watched"), map(ca.densify, of.values), strict=True)))
    return (
        text + "\n" + _piece_function("slopes_on_sides", sided, dict(zip(("f_x", "g_l", "h_x", "h_l"), of.slopes, strict=True)))
    )


def _on_sides(spec: PieceSpec) -> FixedBranches:
    """F = f + g, y and what switches look at, on given sides of these, and slopes."""
    p, (B, D, _) = spec.problem, spec.matrices
    whole = replace(p, p=ca.veccat(p.p, spec.parameter_parts.symbols))
    of = fixed_branches(whole, {name: made.jets for name, made in spec.printers.items()}, B, D)
    return of._replace(values=spec.parameter_parts.back(of.values), slopes=spec.parameter_parts.back(of.slopes))


# Of steps of Radau IIA that derivatives take, of two orders for rough or strict tolerances: the order is 2 s - 1.
TANGENT_STAGES = (5, 6, 7, 8)
# Of rtol: what two answers for a part of a piece may differ by, beside the largest entry of a column of S; parts add up.
TANGENT_SHARE = 0.1
# What rounding leaves of that difference, 135 EPS: no rtol asks for less, as parts would be halved without end.
TANGENT_ROUNDING = 3e-14
# Of the time of the motion: guards that are nearer to 0 than that come at once, as their times are known no better.
TANGENT_AT_ONCE = 1e-9
# Relative: times of guards at once whose derivatives differ by less move together; else the derivative is one-sided.
TANGENT_SAME = 1e-6


def tangent_code(spec: PieceSpec, given: Mapping[str, ca.SX]) -> str:
    """The functions and tables of ``c/pieces_tangents.c``; ``given``: t, x, l and parameters by their names."""
    p, of = spec.problem, _on_sides(spec)
    (rate, y, watched), chosen = of.values, p.p[list(spec.by)]
    own = {name: symbol for name, symbol in given.items() if name.startswith("s->")}
    sided = {name: symbol for name, symbol in given.items() if name not in own} | {"sides": of.choices} | own
    y_rate = ca.jacobian(y, p.t) + ca.jacobian(y, p.x) @ rate
    slopes = {
        f"{name}_{letter}": ca.jacobian(part, symbol)
        for name, part in (("F", rate), ("y", y), ("rate", y_rate))
        for letter, symbol in (("x", p.x), ("l", p.l), ("p", chosen))
    }
    looked = {"looked": watched} | {
        f"by_{letter}": ca.jacobian(watched, symbol) for letter, symbol in (("t", p.t), ("x", p.x), ("l", p.l), ("p", chosen))
    }
    starts = {
        "x_p": ca.jacobian(ca.SX(p.x0), chosen),
        "lower_p": _end_slopes(p.law.lower, chosen),
        "upper_p": _end_slopes(p.law.upper, chosen),
    }
    parts = [("linearised_on_sides", sided, slopes), ("rate_on_sides", sided, {"rate": rate}), ("start_slopes", own, starts)]
    parts += [("watched_on_sides", sided, looked)] if of.choices.numel() else []
    affine = _is_affine_in_each_mode(spec)
    if affine:
        parts.append(("forcing_on_sides", sided, {name: slopes[name] for name in ("F_p", "y_p", "rate_p")}))
    return _tangent_tables(affine) + "\n".join(
        _piece_function(name, inputs, {key: ca.densify(e) for key, e in outputs.items()}) for name, inputs, outputs in parts
    )


def _is_affine_in_each_mode(spec: PieceSpec) -> bool:
    """Whether slopes by x and l are the same all along a piece."""
    p, of = spec.problem, _on_sides(spec)
    return not ca.depends_on(ca.veccat(*of.slopes), ca.veccat(p.t, p.x, p.l))


def _tangent_tables(affine: bool) -> str:
    """The nodes of each method, and the inverse of its matrix; where flows are ``affine`` what makes coefficients of Legendre's
    polynomials on [0, 1] of values at the nodes, and these as sums of j! c^j.
    """
    made = {count: radau_collocation(count) for count in TANGENT_STAGES}
    text = f"#define FEWEST_TANGENT_STAGES {TANGENT_STAGES[0]}\n#define MOST_TANGENT_STAGES {TANGENT_STAGES[-1]}\n"
    for count, of in made.items():
        own = np.concatenate([of.nodes, (_legendre_parts(of) if affine else of.inverse).ravel()])
        text += c_table(f"tangent_{count}", own, str(own.size))
    text += f"static const double *const tangent_tables[] = {{{', '.join(f'tangent_{count}' for count in made)}}};\n"
    if affine:
        most = TANGENT_STAGES[-1]
        table = [[c * math.factorial(j) for j, c in enumerate(_shifted_legendre(k, most))] for k in range(most)]
        text += c_table("legendre", np.ravel(table), str(most**2))
    return text


def _shifted_legendre(k: int, size: int) -> list[int]:
    """The coefficients of P_k(2 c - 1), 0 behind them."""
    return [(-1) ** (k + j) * math.comb(k, j) * math.comb(k + j, j) for j in range(size)]


def _legendre_parts(of: Collocation) -> np.ndarray:
    """(stages, stages): (2 k + 1) w_j P_k(2 c_j - 1), whose rule is exact for products of two of these polynomials."""
    stages, weights = len(of.nodes), np.linalg.inv(of.inverse)[-1]
    values = np.polynomial.legendre.legvander(2 * of.nodes - 1, stages - 1).T
    return (2 * np.arange(stages)[:, None] + 1) * values * weights


def _end_slopes(ends: Any, chosen: ca.SX) -> ca.SX:
    return ca.jacobian(ca.vec(ca.SX(ends)), chosen)


def _piece_function(name: str, given: Mapping[str, ca.SX], out: Mapping[str, ca.SX]) -> str:
    return c_function(name, given, out).replace("model_solver", "model_pieces")


def _radau_tables() -> str:
    """The matrices of all stages there are, one after the other in the order of ``collocation`` in c/pieces_radau.c."""
    stages = range(MIN_STAGES, MAX_STAGES + 1, 2)
    made = [np.concatenate([np.ravel(part) for part in _real_coefficients(radau_collocation(s))]) for s in stages]
    return (
        f"#define FEWEST_STAGES {MIN_STAGES}\n"
        + "".join(c_table(f"radau_{s}", all_of, str(len(all_of))) for s, all_of in zip(stages, made, strict=True))
        + (f"static const double *const radau_tables[] = {{{', '.join(f'radau_{s}' for s in stages)}}};\n")
    )


def _real_coefficients(of: Collocation) -> list[np.ndarray | float]:
    """Real blocks for complex pairs: w = (w_0, u, v, ...) with a w_0, and (a u - b v, b u + a v) of a pair a + b i."""
    order = np.argsort(np.imag(of.rates))
    rates, left, right = of.rates[order], of.left[order], of.right[:, order]
    return [
        of.share, of.nodes, of.between, of.weights,
        np.concatenate([np.real(rates[:1]), *([[z.real, z.imag] for z in rates[1:]])]),
        of.inverse, of.powers, of.middle, of.values, of.slopes,
        np.vstack([np.real(left[:1]), *(part for row in left[1:] for part in (np.real(row), np.imag(row)))]),
        np.column_stack([np.real(right[:, :1]), *(part for c in right[:, 1:].T for part in (np.real(c), -np.imag(c)))]),
    ]  # fmt: skip


class ParameterSubstitution(NamedTuple):
    """Expressions with symbols in place of their parts that follow from parameters alone; the symbols, and these parts."""

    expressions: Mapping[str, ca.SX]
    symbols: ca.SX
    parts: ca.SX

    def back(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """With the parts where the symbols stand."""
        return ca.substitute(list(expressions), [self.symbols], [self.parts]) if self.symbols.numel() else list(expressions)


@dataclass(eq=False)
class _ParameterNode:
    """``kind``: a number, a parameter, an operation on these alone, or anything else."""

    new: ca.SX
    kind: str
    symbol: ca.SX | None = None


NUMBER, PARAMETER, OF_PARAMETERS, MIXED = "number", "parameter", "alone", "mixed"


def extract_parameter_parts(expressions: Mapping[str, ca.SX], p: ca.SX) -> ParameterSubstitution:
    """Look for the largest such parts."""
    whole, own, parts, symbols = ca.cse(ca.veccat(*expressions.values())), symbol_hashes(p), [], []
    if not (own & symbol_hashes(whole)) or ca.OP_CALL in operation_codes(whole):
        return ParameterSubstitution(expressions, ca.SX(0, 1), ca.SX(0, 1))

    def replace_by_symbol(node: _ParameterNode) -> ca.SX:
        if node.kind != OF_PARAMETERS:
            return node.new
        if node.symbol is None:
            node.symbol = ca.SX.sym(f"of_parameters_{len(symbols)}")
            symbols.append(node.symbol)
            parts.append(node.new)
        return node.symbol

    def symbol(given: ca.SX) -> _ParameterNode:
        return _ParameterNode(given, PARAMETER if given.element_hash() in own else MIXED)

    def number(value: float) -> _ParameterNode:
        return _ParameterNode(ca.SX(value), NUMBER)

    def apply(op: int, args: list[_ParameterNode]) -> _ParameterNode:
        alone = all(arg.kind != MIXED for arg in args)
        return _ParameterNode(
            apply_operation(op, [arg.new if alone else replace_by_symbol(arg) for arg in args]), OF_PARAMETERS if alone else MIXED
        )

    found = [replace_by_symbol(node) for node in fold_graph(whole, symbol, number, apply)]
    made, at = {}, 0
    for name, expression in expressions.items():
        made[name] = ca.reshape(ca.vertcat(ca.SX(0, 1), *found[at : at + expression.numel()]), expression.shape)
        at += expression.numel()
    return ParameterSubstitution(made, ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *parts))


MAX_DENSE_ROWS = 64  # Of a law whose matrices are kept dense, 100 KB a mode; of more there are no pieces in C.
EVENT_TIMES = 64  # Events 1, 2, 4, ... whose times are kept: as many as whole numbers of 64 bits can count.


@dataclass(frozen=True)
class PieceSpec:
    """A problem of which code is written; ``values`` of p, the last of which are ``inputs``; ``known`` times that end a piece;
    ``by``: the entries of p that runs are differentiated by.
    """

    problem: ContinuousProblem
    values: Mapping[str, float]
    known: tuple[float, ...] = ()
    inputs: int = 0
    by: tuple[int, ...] = ()

    @cached_property
    def ends(self) -> tuple[SlopeMatrix, SlopeMatrix]:
        """The lower and the upper ends of the law (m,)."""
        return tuple(_as_numbers(ca.SX(ends)) for ends in (self.problem.law.lower, self.problem.law.upper))  # pyrefly: ignore[bad-return]

    @cached_property
    def slopes(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The slopes g_l, h_l and h_x of the problem."""
        return self.problem.slopes

    @cached_property
    def matrices(self) -> tuple[SlopeMatrix | None, SlopeMatrix | None, SlopeMatrix | None]:
        """The same as numbers, or of parameters, None where they move."""
        p = self.problem
        moving = ca.veccat(p.t, p.x, p.l)
        return tuple(None if ca.depends_on(J, moving) else _as_numbers(ca.cse(J)) for J in self.slopes)  # pyrefly: ignore[bad-return]

    @cached_property
    def flags(self) -> frozenset[str]:
        """What the code has."""
        p, (B, D, C) = self.problem, self.matrices
        law = p.l.numel() > 0
        feed = law and self.slopes[1].nnz() > 0 and not (D is not None and not nonzero_pattern(D).any())
        known = B is not None and D is not None and C is not None
        orthogonal = (
            law and not feed and B is not None and D is not None and C is not None and is_diagonal(matrix_product(C, C.T))
        )
        diagonal = orthogonal and B is not None and C is not None and is_diagonal(matrix_product(C, B))
        numbers = [A for A in (B, D, C) if isinstance(A, np.ndarray)]
        of_numbers = len(numbers) == 3
        has = {
            "LAW": law, "FEED": feed, "B_NUMBERS": B is not None, "D_NUMBERS": D is not None,
            "LINEAR": not ca.depends_on(ca.veccat(*self.slopes[:2]), p.l),
            "SLOPES": law and not known, "DIAGONAL": diagonal, "MATRICES": law and not diagonal, "ORTHOGONAL": orthogonal,
            "GENERAL": law and not orthogonal, "STILL": diagonal and not self.has_curved_rows,
            "UNIQUE": law and of_numbers and _is_unique_in_all_modes(*numbers),
            "JUDGED": law and known and not of_numbers, "ENDS_SET": law and any(isinstance(e, ca.SX) for e in self.ends),
            "SWITCHED": bool(self.columns.branches), "PARAMETERS": bool(self.values), "INPUTS": self.inputs > 0,
            "OWN_PARAMETERS": len(self.values) > self.inputs, "KNOWN": bool(self.known),
            "HELD": p.held > 0, "IMPULSES": p.impulses, "REWRITTEN": p.multipliers is not None and p.multipliers.numel() > 0,
            "TIMED": bool(self.known or self.problem.held),
            "STIFF": 0 < p.x.numel() <= MAX_UNKNOWNS - p.l.numel(),
            "TANGENTS": bool(self.by), "AFFINE_FLOW": bool(self.by) and _is_affine_in_each_mode(self),
            "GUESSED": law and not diagonal and 0 < p.x.numel() <= MAX_UNKNOWNS - p.l.numel(),
        }  # fmt: skip
        return frozenset(name for name, holds in has.items() if holds)

    @cached_property
    def has_curved_rows(self) -> bool:
        """Whether h is made of more than sums of x, l and functions of t."""
        h = self.printers["h"]
        scaled = {line.y for line in h.jets.lines if constant_factor_index(line, h.degree) is not None}
        return any(h.degree[row] > 1 and row not in h.jets.inputs.values() and row not in scaled for row in h.column) or any(
            which == 1
            for which, _ in h.jets.inputs
            if any(line.kind not in _SUM_KINDS and line.y not in scaled for line in h.jets.lines)
        )

    @cached_property
    def columns(self) -> SeriesColumns:
        """Where series are stored."""
        return self._columns_and_printers[0]

    @cached_property
    def printers(self) -> dict[str, RecurrencePrinter]:
        """The parts f, g and h; g where it is not B l."""
        return self._columns_and_printers[1]

    @cached_property
    def _columns_and_printers(self) -> tuple[SeriesColumns, dict[str, RecurrencePrinter]]:
        p = self.problem
        n, m = p.x.numel(), p.l.numel()
        inputs = {(1, i): i for i in range(n)} | {(2, i): n + i for i in range(m)} | {(0, 0): n + 2 * m}
        count = n + 2 * m + 1
        given = ca.veccat(p.p, self.parameter_parts.symbols)
        inputs |= {(3, i): count + i for i in range(given.numel())}
        count += given.numel()
        columns = SeriesColumns(inputs, count)
        degrees = {0: 1, 1: ANY_DEGREE, 2: ANY_DEGREE, 3: 0}
        made = {
            name: RecurrencePrinter(taylor_decompose(expr, [p.t, p.x, p.l, given], name), name, columns, degrees)
            for name, expr in self.parameter_parts.expressions.items()
        }
        return columns, made

    @cached_property
    def parameter_parts(self) -> ParameterSubstitution:
        """f, h without D l, and g where it is not B l."""
        p, (B, D, _) = self.problem, self.matrices
        m = p.l.numel()
        h = p.h if D is None or not m else ca.substitute(p.h, p.l, ca.SX.zeros(m))
        return extract_parameter_parts({"f": p.f, "h": h} if B is not None else {"f": p.f, "h": h, "g": p.g}, p.p)

    @cached_property
    def discs(self) -> DiscTable:
        """The table of the parts that there are."""
        n, m = self.problem.x.numel(), self.problem.l.numel()
        return DiscTable((printer for name, printer in self.printers.items() if m or name == "f"), n, m)

    @property
    def _slack_rows(self) -> int:
        """Of a linear complementarity problem with this law: one for each row with two ends or none."""
        lower, upper = self.ends
        if isinstance(lower, ca.SX) or isinstance(upper, ca.SX):
            return self.problem.l.numel()
        return int((np.isfinite(lower) == np.isfinite(upper)).sum())

    @property
    def branches(self) -> dict[str, slice]:
        """The choices of f, g and h."""
        return {name: slice(made.offset, made.offset + len(made.jets.branches)) for name, made in self.printers.items()}

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The constants of the header."""
        n, m = self.problem.x.numel(), self.problem.l.numel()
        columns = self.columns
        outputs = m if {"FEED", "D_NUMBERS"} <= self.flags else 0
        kept = 1 if not {"MATRICES"} <= self.flags or "SLOPES" in self.flags else kept_matrix_count(24 * m * m, 2, 16)
        return {
            "N": n, "M": m, "NP": len(self.values), "NU": self.inputs, "NOWN": len(self.values) - self.inputs,
            "DISCS": self.discs.rows + n + m,
            "CHOICES": columns.choices, "ORDERS": LARGEST_ORDER, "KEPT": kept, "GERM": ORDERS + 1, "TIMES": EVENT_TIMES,
            "COLUMNS": columns.count + outputs, "T": n + 2 * m, "HELD": self.problem.held,
            "H": columns.count if outputs else n + m, "LEMKE": m + self._slack_rows,
            "TANGENTS": len(self.by),
            "STAGES": MAX_STAGES, "OCTAVES": kept_matrix_count(16 * MAX_STAGES * max(n + m, 1) ** 2, 1, 16),
        }  # fmt: skip


_SUM_KINDS = frozenset("sum difference minus scaled over shifted".split())


def make_piece_spec(
    problem: ContinuousProblem, known: Sequence[float], values: Mapping[str, float] | None = None, by: Sequence[int] = ()
) -> PieceSpec:
    """Return what code is written of; ``known`` times are increasing; ``by``: see `PieceSpec`.

    Raises:
        CodegenError: l in slip is a series, or the law has too many rows that depend on each other.
    """
    if problem.sliding_law_names:
        raise CodegenError(_slip_series_message(problem))
    spec = PieceSpec(problem, dict(values or {}), tuple(known), by=tuple(by))
    m = problem.l.numel()
    if m > MAX_DENSE_ROWS and "MATRICES" in spec.flags:
        raise CodegenError(
            f"{m} rows that depend on each other are more than the {MAX_DENSE_ROWS} that pieces in C have room for"
        )
    return spec


def _slip_series_message(problem: ContinuousProblem) -> str:
    return f"while '{problem.sliding_law_names[0]}' slips, its l is a series of y, which only interpreted pieces have"


@cached_per_object_and_key(most=64)
def is_state_unique(problem: ContinuousProblem, values: bytes) -> bool:
    """Whether g_l, h_l and h_x at these values of the parameters, which do not move, let x be the only one in all modes."""
    matrices = _slopes_function(problem)(np.frombuffer(values))
    return _is_unique_in_all_modes(*(np.array(A).reshape(A.shape) for A in matrices))


def cached_symbolic_problem(model: Model) -> ContinuousProblem:
    """The same, once for a model; CodegenError too where it has no parameters, or blocks."""
    found = _symbolic_problem_or_reason(model)
    if isinstance(found, str):
        raise CodegenError(found)
    return found


@cached_per_object
def _symbolic_problem_or_reason(model: Model) -> ContinuousProblem | str:
    if not model.p.numel():
        return "the model has no parameters: declare the numbers that change, parameters={a: 1.0}"
    if model.blocks:
        return "pieces that end at blocks have no C counterpart"
    if reason := moving_signals_reason(model):
        return reason
    try:
        return make_symbolic_problem(model)
    except CodegenError as error:
        return str(error)


@cached_per_object
def _slopes_function(problem: ContinuousProblem) -> ca.Function:
    return ca.Function("slopes", [problem.p], [ca.densify(A) for A in problem.slopes])


def make_symbolic_problem(model: Model) -> ContinuousProblem:
    """A model in continuous time whose parameters stay symbols: what it is of all their values.

    Raises:
        CodegenError: it has no event-driven form, or one that only values of the parameters decide.
    """
    continuous_problem = CONTINUOUS_PROBLEM.optional(model)
    if continuous_problem is None:
        raise CodegenError("event-driven integration in C does not take many bodies, whose contacts change at nearly every step")
    try:
        problem = with_input_states(continuous_problem(model), model)
        _check_constant_ends(problem)
        if not np.isfinite(numeric_constants(ca.veccat(problem.f, problem.g, problem.h))).all():
            raise CodegenError(
                "f, g or h has an infinite number in an expression with a parameter; write the model without that row"
            )
        if problem.growths:
            raise CodegenError(_slip_series_message(problem))
        for _, block in problem.law.parts():
            if not block.separable and not all(ca.SX(value).is_constant() for value in block.numbers.values()):
                raise CodegenError(
                    f"the law '{block.label}' is curved, and of a size that depends on parameters; give these values"
                )
        return with_stick_slip_modes(without_overflow(problem))
    except NotEventDriven as error:
        raise CodegenError(f"event-driven integration does not take this model: {error}") from error


def _check_constant_ends(problem: ContinuousProblem) -> None:
    """Refuse a law whose ends move: whether it is empty is looked at by runs of given values alone."""
    if problem.ends:
        raise CodegenError(
            f"event-driven libraries need a constant law; that of '{problem.ends[0].name}' moves: no --event-driven"
        )


def piece_spec_of(model: Model, values: Mapping[str, float]) -> PieceSpec:
    """The same of a model, whose parameters that stay symbols have ``values`` at first; its inputs are parameters too.

    Raises:
        CodegenError: the model has no event-driven form, or as above.
    """
    names, continuous_problem = model.input_names, CONTINUOUS_PROBLEM.optional(model)
    if continuous_problem is not None:
        with suppress(NotEventDriven):
            _check_constant_ends(continuous_problem(model))
    u, model = initial_inputs(model), inputs_as_parameters(model)
    values = {**values, **dict(zip(names, u.tolist(), strict=True))}
    return replace(make_piece_spec(make_symbolic_problem(model), model.switch_times, values), inputs=u.size)


def _as_numbers(A: ca.SX) -> SlopeMatrix:
    """A without the symbols that cancel: numbers where it has none; a column is (m,)."""
    A = ca.densify(A)
    if not A.is_constant():
        return A
    return np.array(ca.DM(A), float).reshape(A.shape)


def nonzero_pattern(A: SlopeMatrix) -> np.ndarray:
    """Which entries are not 0, for some values of the parameters."""
    if isinstance(A, np.ndarray):
        return A != 0
    return np.array([[not A[i, j].is_zero() for j in range(A.shape[1])] for i in range(A.shape[0])]).reshape(A.shape)


def matrix_product(A: SlopeMatrix, B: SlopeMatrix) -> SlopeMatrix:
    """The product of two slope matrices, of numbers or of expressions."""
    if isinstance(A, np.ndarray) and isinstance(B, np.ndarray):
        return A @ B
    return _as_numbers(ca.mtimes(ca.SX(A), ca.SX(B)))


def is_diagonal(A: SlopeMatrix) -> bool:
    """Whether A has entries on its diagonal, none of them always 0, and 0 elsewhere."""
    nonzero = nonzero_pattern(A)
    return bool(np.diag(nonzero).all() and not (nonzero & ~np.eye(len(nonzero), dtype=bool)).any())


def _is_unique_in_all_modes(B: np.ndarray, D: np.ndarray, C: np.ndarray) -> bool:
    return _is_always_p(D, C @ B) or is_monotone(B, D, C)


def _is_always_p(D: np.ndarray, W: np.ndarray) -> bool:
    """Whether D + a little W is so far from having a negative direction that all its Schur complements pass `is_p`."""
    d, w = np.abs(D).max(initial=0.0), np.abs(W).max(initial=0.0)
    K = D + W * (SHORT * d / w if d and w else 1.0)
    least, most = np.linalg.eigvalsh((K + K.T) / 2).min(initial=1.0), np.linalg.norm(K, 2) if K.size else 1.0
    return bool(least > 1e3 * np.sqrt(SINGULAR) * most)
