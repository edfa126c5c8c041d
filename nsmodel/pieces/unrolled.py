"""All orders of a mode at once, written out as straight Python: `ModeSeries` run once on symbols.

What a mode is made of comes in as numbers: the matrices that find multipliers, and the sides of branches. So there is one such
text for all modes in which multipliers are found in the same way; it is kept with the problem, for all runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import CodeType
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel.once import cached_per_object
from nsmodel.pieces import series
from nsmodel.pieces.multipliers import MatrixRows, MultiplierSolver
from nsmodel.pieces.noted import TooManyOperations, TracingTape
from nsmodel.pieces.orders import ModeSeries
from nsmodel.pieces.printed import SYMBOL_DIALECT
from nsmodel.scheme.continuous import ContinuousProblem

if TYPE_CHECKING:
    from nsmodel.pieces.system import ModeSystem

MAX_UNROLLED_OPERATIONS = 6000  # Operations that are written out.
SolverKind = tuple[bool, bool, bool]  # Whether multipliers are found through y, through y', and whether these feed into y.


class UnrolledOrders:
    """The orders of a system without blocks of stick and slip; ``run`` puts all of them to its rows."""

    def __init__(self, system: ModeSystem) -> None:
        p = system.problem
        self._system, self._kept = system, _code_cache(p)
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
        made: dict[str, Any] = dict(series.ORDER_0_FUNCTIONS)
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
            series.RECURRENCES | tape.known(series.ORDER_0_FUNCTIONS),
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
        own.start(how, codes, linear=system.linear_in_l)
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
