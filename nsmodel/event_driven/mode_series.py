"""Taylor coefficients of x, l and y in a mode, order by order: the recurrences of f, g and h with the multipliers of held rows.

The rows hold numbers, or what stands for numbers where the orders of all modes are written out (`unrolled`).

All orders of a mode at once, written out as straight Python: `ModeSeries` run once on symbols.

What a mode is made of comes in as numbers: the matrices that find multipliers, and the sides of branches. So there is one such
text for all modes in which multipliers are found in the same way; it is kept with the problem, for all runs.

The sums of a system with constant slopes as straight Python, written for it: order k of y, and of x from the order before.

What code does to numbers, as straight Python: it runs once, on symbols that note each operation.

An operation on numbers alone is done and not noted, one with 0 or 1 is none: what is 0 in all runs costs nothing. Operations are
those of the code, in its order: the numbers are the same bits. But for the sign of 0, for 0 times what is no number, which is 0,
and for ``sum``, which is a chain of additions: of floats it makes up for their rounding from Python 3.12 on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from types import CodeType
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object, sum_in_order
from nsmodel.event_driven.friction_modes import FrictionBlocks
from nsmodel.event_driven.multipliers import MatrixRows, MultiplierSolver, clear_rounding, matrix_times_vector
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.recurrence_code import NUMERIC_FUNCTIONS, PYTHON_DIALECT, SYMBOL_DIALECT, Dialect, TaylorExpansion
from nsmodel.event_driven.recurrences import ORDER_0_FUNCTIONS, RECURRENCES, TaylorRecurrences

SeriesRows = Sequence[list[float]]
RowTerms = Sequence[Sequence[tuple[int, float]]]  # (j, a_j) of each row.
MAX_WRITTEN_TERMS = 2000  # Terms and rows of a sum that is written out, in 6 ms; longer ones are loops.


def compile_sums(
    out: SeriesRows, parts: Sequence[SeriesRows], terms: RowTerms, inner: SeriesRows, scaled: bool
) -> Callable[..., None]:
    """``of(k)``: out_i[k] = parts_i[k] + ... + sum_j a_j inner_j[k]; ``scaled``: ``of(k, c)``: out_i[k + 1] = c times that.

    Rows are lists that stay where they are, and hold what order k is made of.
    """
    if len(out) + sum(map(len, terms)) > MAX_WRITTEN_TERMS:
        return _loop_sums(out, parts, terms, inner, scaled)
    known = {f"o{i}": row for i, row in enumerate(out)} | {f"n{j}": row for j, row in enumerate(inner)}
    known |= {f"p{which}_{i}": row for which, rows in enumerate(parts) for i, row in enumerate(rows)}
    used = sorted({j for own in terms for j, _ in own})
    body = [f"u{j} = n{j}[k]" for j in used]
    for i, own in enumerate(terms):
        value, more = " + ".join(f"p{which}_{i}[k]" for which in range(len(parts))), " + ".join(f"{a!r}*u{j}" for j, a in own)
        value += f" + {more if scaled else f'({more})'}" if own else ""
        body.append(f"o{i}[k + 1] = c*({value})" if scaled else f"o{i}[k] = {value}")
    head = f"def make({', '.join(known)}):\n    def of(k{', c' if scaled else ''}):\n"
    made: dict[str, Any] = {}
    exec(compile(head + "".join(f"        {line}\n" for line in body or ["pass"]) + "    return of\n", "<sums>", "exec"), made)
    return made["make"](**known)


def nonzero_terms(matrix: np.ndarray | None, rows: int) -> list[list[tuple[int, float]]]:
    """Of each row of a matrix, what is not 0; of none nothing."""
    return [[]] * rows if matrix is None else [[(j, a) for j, a in enumerate(row) if a] for row in matrix.tolist()]


def _loop_sums(
    out: SeriesRows, parts: Sequence[SeriesRows], terms: RowTerms, inner: SeriesRows, scaled: bool
) -> Callable[..., None]:
    together = list(zip(out, zip(*parts, strict=True), terms, strict=True))

    def sum_rows(k: int, c: float = 1.0) -> None:
        for row, own, entries in together:
            total = sum_in_order([row[k] for row in own])
            more = [a * inner[j][k] for j, a in entries]
            row[k + scaled] = c * sum_in_order(more, total) if scaled else total + sum_in_order(more)

    return sum_rows


class ModeSeries:
    """The rows of coefficients ``t``, ``x``, ``l``, ``y`` up to ``orders``, and what computes them.

    ``push`` is what stands for l in f, g and h: l itself but where a block grows; ``parts``: the recurrences by name.
    """

    def __init__(
        self, problem: ContinuousProblem, recurrences: Mapping[str, TaylorRecurrences], B: np.ndarray | None,
        D: np.ndarray | None, orders: int, language: Dialect = PYTHON_DIALECT, known: Mapping[str, Any] = NUMERIC_FUNCTIONS,
    ) -> None:  # fmt: skip
        """``B``, ``D``: where these are numbers, and g and h without them; ``language``, ``known``: see `expansion.compiled`."""
        self.problem, self.jets, self.B, self.D = problem, recurrences, B, D
        self.n, self.m, self.orders = problem.x.numel(), problem.l.numel(), orders
        width = orders + 1
        self.t: list[Any] = [0.0] * width
        rows: list[list[list[Any]]] = [[[0.0] * width for _ in range(size)] for size in (self.n, self.m, self.m)]
        self.x, self.l, self.y = rows
        self.blocks = FrictionBlocks(problem, self.l, self.y)
        self.push = self.blocks.push
        given = {(0, 0): self.t} | {(1, i): row for i, row in enumerate(self.x)}
        self.inputs = given | {(2, i): row for i, row in enumerate(self.push)}
        self.parts = {name: TaylorExpansion(own, orders, self.inputs, language, known) for name, own in recurrences.items()}
        self.updates = [self.parts[name] for name in problem.block_parts]
        rates = [self.parts[name].outputs for name in ("f", "g") if name in self.parts]
        self._sum_y = compile_sums(self.y, [self.parts["h"].outputs], nonzero_terms(D, self.m), self.l, scaled=False)
        self._sum_rate = compile_sums(self.x, rates, nonzero_terms(B, self.n), self.push, scaled=True)

    @cached_property
    def branches(self) -> list[tuple[str, int]]:
        """(part, its branch) of every switch in f, g and h."""
        return [(name, i) for name, recurrences in self.jets.items() for i in range(len(recurrences.branches))]

    def begin(self, how: MultiplierSolver, codes: list[int]) -> tuple[list[float], list[float]]:
        """Order 0 of l, once that of y is there, and order 1 of x: exact where y is linear in l, else a step of Newton's method.

        Returns what l of held rows moved by, through y and through y'.
        """
        direct, through = self._solve_index_1(how, 0), []
        self._compute_rate(0)
        if how.through is not None:
            self._compute_y(1)
            slope = [self.y[i][1] / self.t[1] for i in how.active]
            through = [-v for v in matrix_times_vector(how.through, slope)]
            for i, d in zip(how.active, through, strict=True):
                self.l[i][0] += d
            self.blocks.pushed(codes, 0)
            if how.feeds:
                self._recompute_y(0)
            self._compute_rate(0)
        return direct, through

    def start(self, how: MultiplierSolver, codes: list[int], *, linear: bool) -> None:
        """Orders 0 of y and l, and 1 of x, in one step; where that is none, l is there."""
        self._compute_y(0)
        self.parts["f"].compute(0)
        if linear:
            self.begin(how, codes)
        else:
            self._compute_rate(0)

    def compute_orders(self, how: MultiplierSolver, codes: list[int], known: int, orders: int) -> None:
        """Compute orders ``known``, ..., ``orders`` in the same mode."""
        for k in range(known, orders + 1):
            for part in self.updates:
                part.compute(k)
            if k:
                self._solve_index_1(how, k)
                self.blocks.compute_slip_order(codes, k)
            if k == orders:
                break
            if k:
                self.parts["f"].compute(k)
                self._compute_rate(k)
            self._compute_y(k + 1)
            if k == 0 or how.through is None:
                continue
            for i, d in self._index_2_updates(how, k):
                self.l[i][k] += d
            self.blocks.pushed(codes, k)
            if how.feeds:
                self._recompute_y(k)
            self._compute_rate(k)
            self._compute_y(k + 1)
            clear_rounding(how, self.x, self.y, k + 1)

    def _solve_index_1(self, how: MultiplierSolver, k: int) -> list[float]:
        """l_k from y_k, of index 1; y_k with it. Returns what l moved by."""
        if how.direct is None:
            return []
        step = matrix_times_vector(how.direct, [self.y[i][k] for i in how.active])
        for i, d in zip(how.active, step, strict=True):
            self.l[i][k] -= d
        self._recompute_y(k)
        return step

    def _index_2_updates(self, how: MultiplierSolver, k: int) -> Iterator[tuple[int, float]]:
        """What order k of the multipliers of held rows is to be moved by, (row, motion)."""
        step = [-(k + 1) / self.t[1] * v for v in matrix_times_vector(how.through or [], [self.y[i][k + 1] for i in how.active])]
        return zip(how.active, step, strict=True)

    def _compute_y(self, k: int) -> None:
        """Order k of y, of x and l."""
        self.parts["h"].compute(k)
        self._sum_y(k)

    def _recompute_y(self, k: int) -> None:
        """Order k of y once more: l has moved."""
        if self.D is None:
            self.parts["h"].compute(k)
        self._sum_y(k)

    def _compute_rate(self, k: int) -> None:
        """Order k + 1 of x, once order k of f and l is computed."""
        if "g" in self.parts:
            self.parts["g"].compute(k)
        self._sum_rate(k, self.t[1] / (k + 1))


NESTED = 24  # Operations within one another in an expression; Python's parser takes 200 parentheses.


class TooManyOperations(Exception):
    """More operations than were allowed."""


class TracedNumber:
    """A number that is not known yet; true where it is asked: it may be other than 0."""

    __slots__ = ("place", "tape")

    def __init__(self, tape: TracingTape, place: int) -> None:
        self.tape, self.place = tape, place

    def __add__(self, other: Any) -> Any:
        """Note a sum, unless the other is 0."""
        return self if _equals_constant(other, 0) else self.tape.note("({} + {})", self, other)

    def __radd__(self, other: Any) -> Any:
        """Note a sum, unless the other is 0."""
        return self if _equals_constant(other, 0) else self.tape.note("({} + {})", other, self)

    def __sub__(self, other: Any) -> Any:
        """Note a difference, unless the other is 0."""
        return self if _equals_constant(other, 0) else self.tape.note("({} - {})", self, other)

    def __rsub__(self, other: Any) -> Any:
        """Note the difference of a constant and this number."""
        return self.tape.note("({} - {})", other, self)

    def __mul__(self, other: Any) -> Any:
        """Note a product, unless the other is 0 or 1."""
        return (
            0.0
            if _equals_constant(other, 0)
            else self
            if _equals_constant(other, 1)
            else self.tape.note("({} * {})", self, other)
        )

    def __rmul__(self, other: Any) -> Any:
        """Note a product, unless the other is 0 or 1."""
        return (
            0.0
            if _equals_constant(other, 0)
            else self
            if _equals_constant(other, 1)
            else self.tape.note("({} * {})", other, self)
        )

    def __truediv__(self, other: Any) -> Any:
        """Note a quotient, unless the divisor is 1."""
        return self if _equals_constant(other, 1) else self.tape.note("({} / {})", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        """Note the quotient of a constant and this number, unless the constant is 0."""
        return 0.0 if _equals_constant(other, 0) else self.tape.note("({} / {})", other, self)

    def __neg__(self) -> TracedNumber:
        """Note the number with the other sign."""
        return self.tape.note("(-{})", self)

    def __gt__(self, other: Any) -> Any:
        """Noted, as are the others."""
        return self.tape.note("({} > {})", self, other)

    def __eq__(self, other: object) -> Any:
        """Note a comparison."""
        return self.tape.note("({} == {})", self, other)

    def __ne__(self, other: object) -> Any:
        """Note a comparison."""
        return self.tape.note("({} != {})", self, other)

    __hash__ = None


def _equals_constant(value: Any, number: int) -> bool:
    return not isinstance(value, TracedNumber) and value == number


class TracingTape:
    """Operations, each once: its text with places for what it is applied to; ``most``: how many are allowed."""

    def __init__(self, most: int) -> None:
        self.most = most
        self._ops: list[tuple[str, tuple[Any, ...]]] = []
        self._known: dict[tuple, int] = {}

    def note(self, text: str, *args: Any) -> TracedNumber:
        """The symbol of an operation."""
        key = (text, *(("", arg.place) if isinstance(arg, TracedNumber) else arg for arg in args))
        if key not in self._known:
            if len(self._ops) >= self.most:
                raise TooManyOperations
            self._known[key] = len(self._ops)
            self._ops.append((text, args))
        return TracedNumber(self, self._known[key])

    def known(self, functions: Mapping[str, Callable[..., float]]) -> dict[str, Callable[..., Any]]:
        """The functions, and ``where``, ``both`` and ``one`` of `SYMBOL_DIALECT`: noted where they see a symbol."""
        found = {
            name: self._traced(f"{name}({{}}{', {}' * (name in ('atan2', 'hypot', 'pow'))})", f) for name, f in functions.items()
        }
        found["where"] = self._traced("({1} if {0} else {2})", lambda condition, a, b: a if condition else b)
        found["both"] = self._traced("({} and {})", lambda a, b: a and b)
        found["one"] = self._traced("({} or {})", lambda a, b: a or b)
        return found

    def _traced(self, text: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def traced_call(*args: Any) -> Any:
            return self.note(text, *args) if any(isinstance(arg, TracedNumber) for arg in args) else function(*args)

        return traced_call

    def written(self, names: Sequence[str], parameters: str, outputs: Sequence[tuple[str, Any]]) -> CodeType:
        """``make(names)``, which returns ``of(parameters)``: it computes what it puts to ``outputs``, (where, symbol or list)."""
        uses = [0] * len(self._ops)
        flat = [one for _, value in outputs for one in (value if isinstance(value, list) else [value])]
        for one in flat:
            if isinstance(one, TracedNumber):
                uses[one.place] += 1
        for place in range(len(uses) - 1, -1, -1):
            for arg in self._ops[place][1] if uses[place] else ():
                if isinstance(arg, TracedNumber):
                    uses[arg.place] += 1
        texts, depth, lines = [""] * len(uses), [0] * len(uses), []
        for place, (text, args) in enumerate(self._ops):
            if not uses[place]:
                continue
            inner = [arg.place for arg in args if isinstance(arg, TracedNumber)]
            value = text.format(*(texts[arg.place] if isinstance(arg, TracedNumber) else _number_text(arg) for arg in args))
            depth[place] = 1 + max((depth[arg] for arg in inner), default=0)
            if args and uses[place] == 1 and depth[place] < NESTED:
                texts[place] = value
            else:
                texts[place], depth[place] = f"v{place}", 0
                lines.append(f"        v{place} = {value}\n")

        def operand_text(one: Any) -> str:
            return texts[one.place] if isinstance(one, TracedNumber) else _number_text(one)

        lines += [
            f"        {where} = "
            f"{f'[{chr(44).join(map(operand_text, value))}]' if isinstance(value, list) else operand_text(value)}\n"
            for where, value in outputs
        ]
        text = f"def make({', '.join(names)}):\n    def of({parameters}):\n{''.join(lines)}    return of\n"
        return compile(text, "<noted>", "exec")


def _number_text(value: float) -> str:
    return repr(value) if math.isfinite(value) else f"float('{value!r}')"


MAX_UNROLLED_OPERATIONS = 6000  # Operations that are written out: it takes 50 ms to compile them; others are looped over.
SolverKind = tuple[bool, bool, bool]  # Whether multipliers are found through y, through y', and whether these feed into y.


class UnrolledOrders:
    """The orders of a system without blocks of stick and slip; ``run`` puts all of them to its rows."""

    def __init__(self, system: ModeSeries, *, linear: bool) -> None:
        """``linear``: whether f, g and h are linear in l."""
        p = system.problem
        self._system, self._linear, self._kept = system, linear, _code_cache(p)
        B, D, C = (_sparsity_pattern(matrix) for matrix in p.slopes)
        self._direct, self._through = _coupled_entries(D), _coupled_entries(D | (C.astype(int) @ B.astype(int) > 0))
        self._made: dict[SolverKind, Callable[..., None] | None] = {}

    def entries(self, how: MultiplierSolver) -> tuple[float, ...]:
        """The numbers of a mode, as ``run`` takes them."""
        at = {i: k for k, i in enumerate(how.active)}
        return tuple(
            matrix[at[i]][at[j]] if i in at and j in at else 0.0
            for matrix, places in ((how.direct, self._direct), (how.through, self._through)) if matrix is not None
            for i, j in places
        )  # fmt: skip

    def run(self, how: MultiplierSolver) -> bool:
        """Compute all orders; whether it could: not where f, g or h have no number, or a text would be too long."""
        kind = (how.direct is not None, how.through is not None, how.feeds)
        if kind not in self._made:
            self._made[kind] = self._make_function(kind)
        of = self._made[kind]
        if of is None:
            return False
        try:
            of(how.entries)
        except (ZeroDivisionError, OverflowError, ValueError):
            return False
        return True

    def _make_function(self, kind: SolverKind) -> Callable[..., None] | None:
        system = self._system
        key = (system.orders, *kind)
        if key not in self._kept:
            try:
                self._kept[key] = self._write_code(kind)
            except TooManyOperations:
                self._kept[key] = None
        code = self._kept[key]
        if code is None:
            return None
        made: dict[str, Any] = dict(ORDER_0_FUNCTIONS)
        exec(code, made)
        rows = _named_rows(system) | {f"{name}_choice": part.choice for name, part in system.parts.items()}
        return made["make"](**rows)

    def _write_code(self, kind: SolverKind) -> CodeType:
        system, tape = self._system, TracingTape(MAX_UNROLLED_OPERATIONS)
        own = ModeSeries(
            system.problem,
            system.jets,
            system.B,
            system.D,
            system.orders,
            SYMBOL_DIALECT,
            RECURRENCES | tape.known(ORDER_0_FUNCTIONS),
        )
        own.t[:2] = tape.note("t[0]"), tape.note("t[1]")
        for name, rows in (("x", own.x), ("l", own.l)):
            for i, row in enumerate(rows):
                row[0] = tape.note(f"{name}{i}[0]")
        for name, part in own.parts.items():
            part.choice[:] = [tape.note(f"{name}_choice[{i}]") for i in range(len(part.choice))]
        numbers = iter([tape.note(f"d[{k}]") for k in range(len(self._direct) * kind[0] + len(self._through) * kind[1])])
        direct = _fill_matrix(self._direct, own.m, numbers) if kind[0] else None
        through = _fill_matrix(self._through, own.m, numbers) if kind[1] else None
        how, codes = MultiplierSolver(tuple(range(own.m)), direct, through, None, kind[2]), [0] * own.m
        own.start(how, codes, linear=self._linear)
        own.compute_orders(how, codes, 0, own.orders)
        found = _named_rows(own)
        names = [*found, *(f"{name}_choice" for name in own.parts)]
        watched = {f"{name}{b.row}" for name, part in own.parts.items() for b in part.jets.branches}
        outputs = []
        for name, row in found.items():
            if name[0] in "xly" or name in watched:
                outputs.append((f"{name}[:]", row))
            elif name != "t":
                outputs.append((f"{name}[0]", row[0]))
        return tape.written(names, "d", outputs)


@cached_per_object
def _code_cache(p: ContinuousProblem) -> dict[tuple, CodeType | None]:
    """What has been written for a problem, by order and kind."""
    return {}


def _named_rows(of: ModeSeries) -> dict[str, list[Any]]:
    """The rows by name; of parts with branches those that are computed, of which these look at some, and sizes are told."""
    found = {"t": of.t}
    found |= {f"{name}{i}": row for name, rows in (("x", of.x), ("l", of.l), ("y", of.y)) for i, row in enumerate(rows)}
    for name, part in of.parts.items():
        if part.jets.branches:
            given = {*part.jets.inputs.values(), *part.jets.numbers}
            found |= {f"{name}{i}": row for i, row in enumerate(part.rows) if i not in given}
    return found


def _fill_matrix(places: list[tuple[int, int]], m: int, numbers: Iterator[Any]) -> MatrixRows:
    matrix: MatrixRows = [[0.0] * m for _ in range(m)]
    for i, j in places:
        matrix[i][j] = next(numbers)
    return matrix


def _sparsity_pattern(matrix: ca.SX) -> np.ndarray:
    """Which entries may be other than 0."""
    found = np.zeros(matrix.shape, bool)
    found[matrix.sparsity().row(), matrix.sparsity().get_col()] = True
    return found


def _coupled_entries(matrix: np.ndarray) -> list[tuple[int, int]]:
    """The places in which generalised inverses of principal parts of a matrix may have entries: of rows that belong together."""
    near = np.eye(len(matrix), dtype=int) + matrix + matrix.T
    for _ in range(len(matrix).bit_length()):
        near = (near @ near > 0).astype(int)
    alone = ~(matrix.any(axis=0) | matrix.any(axis=1))
    near[alone] = near[:, alone] = 0
    return [(int(i), int(j)) for i, j in np.argwhere(near)]
