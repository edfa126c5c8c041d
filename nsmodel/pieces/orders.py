"""Taylor coefficients of x, l and y in a mode, order by order: the recurrences of f, g and h with the multipliers of held rows.

The rows hold numbers, or what stands for numbers where the orders of all modes are written out (`unrolled`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from nsmodel.pieces.expansion import NUMERIC_FUNCTIONS, TaylorExpansion
from nsmodel.pieces.jets import TaylorRecurrences
from nsmodel.pieces.multipliers import MultiplierSolver, clear_rounding, matrix_times_vector
from nsmodel.pieces.printed import PYTHON_DIALECT, Dialect
from nsmodel.pieces.sliding import FrictionBlocks
from nsmodel.pieces.straight import compile_sums, nonzero_terms
from nsmodel.scheme.continuous import ContinuousProblem


class ModeSeries:
    """The rows of coefficients ``t``, ``x``, ``l``, ``y`` up to ``orders``, and what computes them.

    ``push`` is what stands for l in f, g and h: l itself but where a block grows; ``parts``: the recurrences by name.
    """

    def __init__(
        self, problem: ContinuousProblem, recurrences: Mapping[str, TaylorRecurrences], B: np.ndarray | None,
        D: np.ndarray | None, orders: int, language: Dialect = PYTHON_DIALECT, known: Mapping[str, Any] = NUMERIC_FUNCTIONS,
    ) -> None:  # fmt: skip
        """``B``, ``D``: where these are numbers, and g and h without them; ``language``, ``known``: see `expansion.compiled`."""
        self.n, self.m, self.orders, self.D = problem.x.numel(), problem.l.numel(), orders, D
        width = orders + 1
        self.t: list[Any] = [0.0] * width
        rows: list[list[list[Any]]] = [[[0.0] * width for _ in range(size)] for size in (self.n, self.m, self.m)]
        self.x, self.l, self.y = rows
        self.blocks = FrictionBlocks(problem, self.l, self.y)
        self.push = self.blocks.push
        given = {(0, 0): self.t} | {(1, i): row for i, row in enumerate(self.x)}
        self.inputs = given | {(2, i): row for i, row in enumerate(self.push)}
        self.parts = {name: TaylorExpansion(own, orders, self.inputs, language, known) for name, own in recurrences.items()}
        self.updates = [part for name, part in self.parts.items() if name == "blocks"]
        rates = [self.parts[name].outputs for name in ("f", "g") if name in self.parts]
        self._sum_y = compile_sums(self.y, [self.parts["h"].outputs], nonzero_terms(D, self.m), self.l, scaled=False)
        self._sum_rate = compile_sums(self.x, rates, nonzero_terms(B, self.n), self.push, scaled=True)

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
