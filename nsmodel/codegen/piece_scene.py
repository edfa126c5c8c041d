"""What the C of event-driven integration is written of: a problem, its matrices, and what the code has for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.codegen.piece_collocation import MOST_UNKNOWN, kept_in, memory
from nsmodel.codegen.piece_discs import Discs
from nsmodel.codegen.piece_jets import CURVED, Columns, Printer, scaled_by
from nsmodel.codegen.piece_parameters import Derived, derived
from nsmodel.errors import CodegenError
from nsmodel.model.base import Model
from nsmodel.model.driven import as_parameters, inputs_at_start
from nsmodel.once import once
from nsmodel.pieces.exponentials import without_overflow
from nsmodel.pieces.jets import jets_of
from nsmodel.pieces.lengths import LARGEST_ORDER
from nsmodel.pieces.modes import ORDERS
from nsmodel.pieces.multipliers import SHORT, SINGULAR, is_monotone
from nsmodel.pieces.sides import Matrix
from nsmodel.pieces.sliding import with_modes
from nsmodel.proof.graph import constants
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.scheme.driven import driven

MOST_ROWS = 64  # Of a law whose matrices are kept dense.
TIMES = 64  # Events 1, 2, 4, ... whose times are kept.


@dataclass(frozen=True)
class PieceScene:
    """A problem of which code is written; ``values`` of p, the last of which are ``inputs``; ``known`` times that end a piece."""

    problem: ContinuousProblem
    values: Mapping[str, float]
    known: tuple[float, ...] = ()
    inputs: int = 0

    @cached_property
    def ends(self) -> tuple[Matrix, Matrix]:
        """The lower and the upper ends of the law (m,)."""
        return tuple(_numbers(ca.SX(ends)) for ends in (self.problem.law.lower, self.problem.law.upper))  # pyright: ignore[reportReturnType]

    @cached_property
    def slopes(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """g_l, h_l, h_x."""
        return self.problem.slopes

    @cached_property
    def matrices(self) -> tuple[Matrix | None, Matrix | None, Matrix | None]:
        """The same as numbers, or of parameters, None where they move."""
        p = self.problem
        moving = ca.veccat(p.t, p.x, p.l)
        return tuple(None if ca.depends_on(J, moving) else _numbers(ca.cse(J)) for J in self.slopes)  # pyright: ignore[reportReturnType]

    @cached_property
    def flags(self) -> frozenset[str]:
        """What the code has."""
        p, (B, D, C) = self.problem, self.matrices
        law = p.l.numel() > 0
        feed = law and self.slopes[1].nnz() > 0 and not (D is not None and not pattern(D).any())
        known = B is not None and D is not None and C is not None
        orthogonal = law and not feed and B is not None and D is not None and C is not None and is_diagonal(product(C, C.T))
        diagonal = orthogonal and B is not None and C is not None and is_diagonal(product(C, B))
        numbers = [A for A in (B, D, C) if isinstance(A, np.ndarray)]
        of_numbers = len(numbers) == 3
        has = {
            "LAW": law, "FEED": feed, "B_NUMBERS": B is not None, "D_NUMBERS": D is not None,
            "LINEAR": not ca.depends_on(ca.veccat(*self.slopes[:2]), p.l),
            "SLOPES": law and not known, "DIAGONAL": diagonal, "MATRICES": law and not diagonal, "ORTHOGONAL": orthogonal,
            "GENERAL": law and not orthogonal, "STILL": diagonal and not self.curved_rows,
            "UNIQUE": law and of_numbers and _has_one(*numbers),
            "JUDGED": law and known and not of_numbers, "ENDS_SET": law and any(isinstance(e, ca.SX) for e in self.ends),
            "SWITCHED": bool(self.columns.branches), "PARAMETERS": bool(self.values), "INPUTS": self.inputs > 0,
            "OWN_PARAMETERS": len(self.values) > self.inputs, "KNOWN": bool(self.known),
            "HELD": p.held > 0, "IMPULSES": p.impulses, "REWRITTEN": p.multipliers is not None and p.multipliers.numel() > 0,
            "TIMED": bool(self.known or self.problem.held),
            "STIFF": 0 < p.x.numel() <= MOST_UNKNOWN - p.l.numel(),
        }  # fmt: skip
        return frozenset(name for name, holds in has.items() if holds)

    @cached_property
    def curved_rows(self) -> bool:
        """Whether h is made of more than sums of x, l and functions of t."""
        h = self.printers["h"]
        scaled = {line.y for line in h.jets.lines if scaled_by(line, h.degree) is not None}
        return any(h.degree[row] > 1 and row not in h.jets.inputs.values() and row not in scaled for row in h.column) or any(
            which == 1
            for which, _ in h.jets.inputs
            if any(line.kind not in _SUMS and line.y not in scaled for line in h.jets.lines)
        )

    @cached_property
    def columns(self) -> Columns:
        """Where series are stored."""
        return self._made[0]

    @cached_property
    def printers(self) -> dict[str, Printer]:
        """The parts f, g and h; g where it is not B l."""
        return self._made[1]

    @cached_property
    def _made(self) -> tuple[Columns, dict[str, Printer]]:
        p = self.problem
        n, m = p.x.numel(), p.l.numel()
        inputs = {(1, i): i for i in range(n)} | {(2, i): n + i for i in range(m)} | {(0, 0): n + 2 * m}
        count = n + 2 * m + 1
        given = ca.veccat(p.p, self.derived.symbols)
        inputs |= {(3, i): count + i for i in range(given.numel())}
        count += given.numel()
        columns = Columns(inputs, count)
        degrees = {0: 1, 1: CURVED, 2: CURVED, 3: 0}
        made = {
            name: Printer(jets_of(expr, [p.t, p.x, p.l, given], name), name, columns, degrees)
            for name, expr in self.derived.expressions.items()
        }
        return columns, made

    @cached_property
    def derived(self) -> Derived:
        """f, h without D l, and g where it is not B l."""
        p, (B, D, _) = self.problem, self.matrices
        m = p.l.numel()
        h = p.h if D is None or not m else ca.substitute(p.h, p.l, ca.SX.zeros(m))
        return derived({"f": p.f, "h": h} if B is not None else {"f": p.f, "h": h, "g": p.g}, p.p)

    @cached_property
    def discs(self) -> Discs:
        """The table of the parts that there are."""
        n, m = self.problem.x.numel(), self.problem.l.numel()
        return Discs((printer for name, printer in self.printers.items() if m or name == "f"), n, m)

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
        kept = 1 if not {"MATRICES"} <= self.flags or "SLOPES" in self.flags else kept_in(24 * m * m, 2, 16)
        return {
            "N": n, "M": m, "NP": len(self.values), "NU": self.inputs, "NOWN": len(self.values) - self.inputs,
            "DISCS": self.discs.rows + n + m,
            "CHOICES": columns.choices, "ORDERS": LARGEST_ORDER, "KEPT": kept, "GERM": ORDERS + 1, "TIMES": TIMES,
            "COLUMNS": columns.count + outputs, "T": n + 2 * m, "HELD": self.problem.held,
            "H": columns.count if outputs else n + m,
        } | memory(n + m)  # fmt: skip


_SUMS = frozenset("sum difference minus scaled over shifted".split())


def piece_scene(problem: ContinuousProblem, known: Sequence[float], values: Mapping[str, float] | None = None) -> PieceScene:
    """Return what code is written of; ``known`` times are increasing.

    Raises:
        CodegenError: l in slip is a series, or the law has too many rows that depend on each other.
    """
    if problem.sliding:
        raise CodegenError(_series_in_slip(problem))
    scene = PieceScene(problem, dict(values or {}), tuple(known))
    m = problem.l.numel()
    if m > MOST_ROWS and "MATRICES" in scene.flags:
        raise CodegenError(f"{m} rows that depend on each other are more than the {MOST_ROWS} that pieces in C have room for")
    return scene


def _series_in_slip(problem: ContinuousProblem) -> str:
    return f"while '{problem.sliding[0]}' slips, its l is a series of y, which only interpreted pieces have"


def is_unique(problem: ContinuousProblem, values: np.ndarray) -> bool:
    """Whether g_l, h_l and h_x at these values of the parameters, which do not move, let x be the only one in all modes."""
    matrices = _slopes(problem)(values)
    return _has_one(*(np.array(A).reshape(A.shape) for A in matrices))


def free_problem(model: Model) -> ContinuousProblem:
    """The same, once for a model; CodegenError too where it has no parameters, or blocks."""
    found = _free(model)
    if isinstance(found, str):
        raise CodegenError(found)
    return found


@once
def _free(model: Model) -> ContinuousProblem | str:
    if not model.p.numel():
        return "the model has no parameters: declare the numbers that change, parameters={a: 1.0}"
    if model.blocks:
        return "pieces that blocks end have no C counterpart"
    try:
        return problem_for_all(model)
    except CodegenError as error:
        return str(error)


@once
def _slopes(problem: ContinuousProblem) -> ca.Function:
    return ca.Function("slopes", [problem.p], [ca.densify(A) for A in problem.slopes])


def problem_for_all(model: Model) -> ContinuousProblem:
    """A model in continuous time whose parameters stay symbols: what it is of all their values.

    Raises:
        CodegenError: it has no event-driven form, or one that only values of the parameters decide.
    """
    module = class_of(model).optional("continuous")
    if module is None:
        raise CodegenError("event-driven integration in C does not take many bodies, whose contacts change at nearly every step")
    try:
        problem = driven(module.continuous_problem(model), model)
        _refuse_moving(problem)
        if not np.isfinite(constants(ca.veccat(problem.f, problem.g, problem.h))).all():
            raise CodegenError("there is an infinite number in f, g or h beside a parameter; write the model without that row")
        if problem.growths:
            raise CodegenError(_series_in_slip(problem))
        for _, block in problem.law.parts():
            if not block.separable and not all(ca.SX(value).is_constant() for value in block.numbers.values()):
                raise CodegenError(
                    f"the law '{block.label}' is curved, and of a size that depends on parameters; give these values"
                )
        return with_modes(without_overflow(problem))
    except NotEventDriven as error:
        raise CodegenError(f"event-driven integration does not take this model: {error}") from error


def _refuse_moving(problem: ContinuousProblem) -> None:
    """Refuse a law whose ends move: whether it is empty is looked at by runs of given values alone."""
    if problem.ends:
        raise CodegenError(
            f"event-driven libraries have laws that stay; that of '{problem.ends[0].name}' moves: no --event-driven"
        )


def scene_of(model: Model, values: Mapping[str, float]) -> PieceScene:
    """The same of a model, whose parameters that stay symbols have ``values`` at first; its inputs are parameters too.

    Raises:
        CodegenError: the model has no event-driven form, or as above.
    """
    names, module = model.input_names, class_of(model).optional("continuous")
    if module is not None:
        with suppress(NotEventDriven):
            _refuse_moving(module.continuous_problem(model))
    u, model = inputs_at_start(model), as_parameters(model)
    values = {**values, **dict(zip(names, u.tolist(), strict=True))}
    return replace(piece_scene(problem_for_all(model), model.switch_times, values), inputs=u.size)


def _numbers(A: ca.SX) -> Matrix:
    """A without the symbols that cancel: numbers where it has none; a column is (m,)."""
    A = ca.densify(A)
    if not A.is_constant():
        return A
    return np.array(ca.DM(A), float).reshape(A.shape)


def pattern(A: Matrix) -> np.ndarray:
    """Which entries are not 0, for some values of the parameters."""
    if isinstance(A, np.ndarray):
        return A != 0
    return np.array([[not A[i, j].is_zero() for j in range(A.shape[1])] for i in range(A.shape[0])]).reshape(A.shape)


def product(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    if isinstance(A, np.ndarray) and isinstance(B, np.ndarray):
        return A @ B
    return _numbers(ca.mtimes(ca.SX(A), ca.SX(B)))


def is_diagonal(A: Matrix) -> bool:
    """Whether A has entries on its diagonal, none of them always 0, and 0 elsewhere."""
    there = pattern(A)
    return bool(np.diag(there).all() and not (there & ~np.eye(len(there), dtype=bool)).any())


def _has_one(B: np.ndarray, D: np.ndarray, C: np.ndarray) -> bool:
    return _is_always_p(D, C @ B) or is_monotone(B, D, C)


def _is_always_p(D: np.ndarray, W: np.ndarray) -> bool:
    """Whether D + a little W is so far from having a negative direction that all its Schur complements pass `is_p`."""
    d, w = np.abs(D).max(initial=0.0), np.abs(W).max(initial=0.0)
    K = D + W * (SHORT * d / w if d and w else 1.0)
    least, most = np.linalg.eigvalsh((K + K.T) / 2).min(initial=1.0), np.linalg.norm(K, 2) if K.size else 1.0
    return bool(least > 1e3 * np.sqrt(SINGULAR) * most)
