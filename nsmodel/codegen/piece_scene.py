"""What the C of event-driven integration is written of: a problem, its matrices, and what the code has for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.codegen.piece_collocation import MAX_UNKNOWNS, collocation_sizes, kept_matrix_count
from nsmodel.codegen.piece_discs import DiscTable
from nsmodel.codegen.piece_jets import ANY_DEGREE, RecurrencePrinter, SeriesColumns, constant_factor_index
from nsmodel.codegen.piece_parameters import ParameterSubstitution, extract_parameter_parts
from nsmodel.errors import CodegenError
from nsmodel.model.base import Model
from nsmodel.model.driven import initial_inputs, inputs_as_parameters
from nsmodel.once import cached_per_object
from nsmodel.pieces.exponentials import without_overflow
from nsmodel.pieces.jets import taylor_decompose
from nsmodel.pieces.lengths import LARGEST_ORDER
from nsmodel.pieces.modes import ORDERS
from nsmodel.pieces.multipliers import SHORT, SINGULAR, is_monotone
from nsmodel.pieces.sides import SlopeMatrix
from nsmodel.pieces.sliding import with_stick_slip_modes
from nsmodel.proof.graph import numeric_constants
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.scheme.driven import with_input_states

MAX_DENSE_ROWS = 64  # Of a law whose matrices are kept dense.
EVENT_TIMES = 64  # Events 1, 2, 4, ... whose times are kept.


@dataclass(frozen=True)
class PieceSpec:
    """A problem of which code is written; ``values`` of p, the last of which are ``inputs``; ``known`` times that end a piece."""

    problem: ContinuousProblem
    values: Mapping[str, float]
    known: tuple[float, ...] = ()
    inputs: int = 0

    @cached_property
    def ends(self) -> tuple[SlopeMatrix, SlopeMatrix]:
        """The lower and the upper ends of the law (m,)."""
        return tuple(_as_numbers(ca.SX(ends)) for ends in (self.problem.law.lower, self.problem.law.upper))  # pyright: ignore[reportReturnType]

    @cached_property
    def slopes(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """g_l, h_l, h_x."""
        return self.problem.slopes

    @cached_property
    def matrices(self) -> tuple[SlopeMatrix | None, SlopeMatrix | None, SlopeMatrix | None]:
        """The same as numbers, or of parameters, None where they move."""
        p = self.problem
        moving = ca.veccat(p.t, p.x, p.l)
        return tuple(None if ca.depends_on(J, moving) else _as_numbers(ca.cse(J)) for J in self.slopes)  # pyright: ignore[reportReturnType]

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
            "H": columns.count if outputs else n + m,
        } | collocation_sizes(n + m)  # fmt: skip


_SUM_KINDS = frozenset("sum difference minus scaled over shifted".split())


def make_piece_spec(problem: ContinuousProblem, known: Sequence[float], values: Mapping[str, float] | None = None) -> PieceSpec:
    """Return what code is written of; ``known`` times are increasing.

    Raises:
        CodegenError: l in slip is a series, or the law has too many rows that depend on each other.
    """
    if problem.sliding_law_names:
        raise CodegenError(_slip_series_message(problem))
    spec = PieceSpec(problem, dict(values or {}), tuple(known))
    m = problem.l.numel()
    if m > MAX_DENSE_ROWS and "MATRICES" in spec.flags:
        raise CodegenError(
            f"{m} rows that depend on each other are more than the {MAX_DENSE_ROWS} that pieces in C have room for"
        )
    return spec


def _slip_series_message(problem: ContinuousProblem) -> str:
    return f"while '{problem.sliding_law_names[0]}' slips, its l is a series of y, which only interpreted pieces have"


def is_state_unique(problem: ContinuousProblem, values: np.ndarray) -> bool:
    """Whether g_l, h_l and h_x at these values of the parameters, which do not move, let x be the only one in all modes."""
    matrices = _slopes_function(problem)(values)
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
        return "pieces that blocks end have no C counterpart"
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
    module = class_of(model).optional("continuous")
    if module is None:
        raise CodegenError("event-driven integration in C does not take many bodies, whose contacts change at nearly every step")
    try:
        problem = with_input_states(module.continuous_problem(model), model)
        _check_constant_ends(problem)
        if not np.isfinite(numeric_constants(ca.veccat(problem.f, problem.g, problem.h))).all():
            raise CodegenError("there is an infinite number in f, g or h beside a parameter; write the model without that row")
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
            f"event-driven libraries have laws that stay; that of '{problem.ends[0].name}' moves: no --event-driven"
        )


def piece_spec_of(model: Model, values: Mapping[str, float]) -> PieceSpec:
    """The same of a model, whose parameters that stay symbols have ``values`` at first; its inputs are parameters too.

    Raises:
        CodegenError: the model has no event-driven form, or as above.
    """
    names, module = model.input_names, class_of(model).optional("continuous")
    if module is not None:
        with suppress(NotEventDriven):
            _check_constant_ends(module.continuous_problem(model))
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
    """A B."""
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
