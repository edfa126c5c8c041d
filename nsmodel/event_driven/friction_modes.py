"""Blocks of the law whose l moves while they slip, balls and ellipsoids {c - l'S l >= 0}, or that push more the faster they slip.

Stick is y = 0 with l inside, slip is y != 0 with l on the boundary: y + sigma S l = 0, l'S l = c, sigma = size/sqrt(c) with
size^2 = y'S^-1 y. While size > 0 l is a function of y, and its series follows from that of y; see `release` for size = 0.

The series of a slip that begins at y = 0, where y/|y| is 0/0.

With y + sigma S l = 0 and l'S l = c (see `sliding`), sigma(0) = 0, order j of both leaves, for l_(j-1) of the slipping and the
held rows and for sigma_j,

    [ tau/j W + sigma_1 S    S l_0 ] [ l_(j-1) ]
    [ (S l_0)'               0     ] [ sigma_j ]  =  known,

which is regular where W is definite. Where |l| grows beyond its bound steadily, sigma_1 = 0 and y ~ s^2 (or a higher power), l_0
is that of stick; where l of stick would be outside at once, as in a turn, sigma_1 > 0, and l_0 solves y_1 + sigma_1 S l_0 = 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.event_driven.bernstein import poly_value
from nsmodel.event_driven.multipliers import TIE, generalised_inverse
from nsmodel.event_driven.problem import ContinuousProblem, NotEventDriven, SlipGrowth
from nsmodel.event_driven.recurrence_code import TaylorExpansion
from nsmodel.event_driven.recurrences import taylor_decompose
from nsmodel.modeling.laws import CurvedSet, Law, box, product
from nsmodel.solvers.mlcp import projected_gauss_seidel, semismooth_newton
from nsmodel.solvers.residuals import NumericLaw

# STOPS: in units of LOCAL, as a piece is asked for: 0.1 of the run's rtol.
STOPS = 10.0  # A block stands as soon as its speed is below this share of rtol of its largest: y is then put to 0.
ABOVE = 4.0  # A slip that becomes slower ends so many times above what is 0: nearer its direction is rounding.


@dataclass(frozen=True, eq=False)
class FrictionBlock:
    """The rows ``at`` of a law with what they slip by.

    Attributes:
        at: numbers of the rows.
        l, y, push: their rows of coefficients; ``push`` is what stands for l in f and g.
        size: coefficients of |y| (sqrt(y'S^-1 y)) in slip.
        inner: coefficients of l'S l in stick.
        curved: the set; None for a row of a box.
    """

    at: tuple[int, ...]
    l: list[list[float]]
    y: list[list[float]]
    push: list[list[float]]
    size: list[float]
    inner: list[float]
    curved: CurvedSet | None
    growth: SlipGrowth | None

    @property
    def first(self) -> int:
        """The row that it is named by."""
        return self.at[0]

    @cached_property
    def quadric(self) -> tuple[np.ndarray, float]:
        """The matrix S and the bound c of the set l'S l <= c."""
        return self.curved.quadric(len(self.at)) if self.curved else (np.eye(1), 1.0)

    @cached_property
    def unit(self) -> float:
        """The largest size of a y with |y| = 1."""
        return 1 / math.sqrt(np.linalg.eigvalsh(self.quadric[0])[0])

    @cached_property
    def is_singular_at_onset(self) -> bool:
        """Whether the factor has no series where the slip begins."""
        if self._push_expansion is None:
            return False
        orders = len(self.size)
        self.size[:], before = [0.0, 1.0, *[0.0] * (orders - 2)], list(self.size)
        found = [self._push_expansion.order(k) for k in range(orders)]
        self.size[:] = before
        return not all(math.isfinite(v) for values in found for v in values)

    @cached_property
    def _slip_expansion(self) -> TaylorExpansion | None:
        """(l, size) of y."""
        if self.curved is None:
            return None
        y = ca.SX.sym("y", len(self.at))
        slip = self.curved.slip(y)
        recurrences = taylor_decompose(ca.vertcat(*(slip or ())), [y], "l in slip")
        return TaylorExpansion(recurrences, len(self.size) - 1, {(0, i): row for i, row in enumerate(self.y)})

    @cached_property
    def _stick_expansion(self) -> TaylorExpansion:
        """The function l'S l of l with its first derivatives."""
        l = ca.SX.sym("l", len(self.at))
        recurrences = taylor_decompose(ca.dot(l, ca.DM(self.quadric[0]) @ l), [l], "l'S l")
        return TaylorExpansion(recurrences, len(self.size) - 1, {(0, i): row for i, row in enumerate(self.l)})

    @cached_property
    def _push_expansion(self) -> TaylorExpansion | None:
        """factor(size) l."""
        if self.growth is None:
            return None
        l = ca.SX.sym("l", len(self.at))
        recurrences = taylor_decompose(self.growth.factor * l, [self.growth.s, l], "the growth of friction")
        given = {(0, 0): self.size} | {(1, i): row for i, row in enumerate(self.l)}
        return TaylorExpansion(recurrences, len(self.size) - 1, given)

    @property
    def left(self) -> float:
        """The time in which it would stop at this rate, in the unit of time; inf where it does not become slower."""
        return -self.size[0] / self.size[1] if self.size[1] < 0 else math.inf

    def is_at_rest(self, least: float) -> bool:
        """Whether y is 0 at the start of the piece, or below ``least`` of a size."""
        return math.hypot(*(row[0] for row in self.y)) <= least

    def compute_slip_order(self, code: int, k: int) -> None:
        """Order k of l and of |y|, from those of y; y is not 0."""
        if self._slip_expansion is None:
            self.size[k] = -code * self.y[0][k]
        else:
            *l, self.size[k] = self._slip_expansion.order(k)
            for row, v in zip(self.l, l, strict=True):
                row[k] = v
        self.pushed(code, k)

    def pushed(self, code: int, k: int) -> None:
        """Order k of what pushes, from those of l and |y|."""
        if self._push_expansion is not None:
            smooth = code and (self.size[0] or not (self.is_singular_at_onset or self.size[1] < 0))
            for row, v in zip(self.push, self._push_expansion.order(k) if smooth else [row[k] for row in self.l], strict=True):
                row[k] = v

    def push_at(self, s: float) -> list[float]:
        """What pushes in slip at a point of the piece, with the factor itself."""
        l, growth = [poly_value(row, s) for row in self.l], self.growth
        if growth is None:
            return l
        factor = float(self._factor_function(max(poly_value(self.size, s), 0.0)))
        return [factor * v for v in l]

    @cached_property
    def _factor_function(self) -> ca.Function:
        return ca.Function("factor", [self.growth.s], [self.growth.factor]) if self.growth else ca.Function()

    def law_residual(self, s: float, y: Sequence[float], rounding: float) -> float:
        """How far l in slip is from the law at a point of the piece where the model's y (all rows) are these, beside the set.

        Less what a ``rounding`` of y moves l by, |dl| <= 2 sqrt(c) |S^-1 dy|/size.
        """
        own = np.array([y[i] for i in self.at])
        if self.curved is None or not own.any():
            return 0.0
        off = np.array([poly_value(row, s) for row in self.l]) - self.curved.support_point(own)
        return float(np.abs(off).max() / self.curved.radius) - 2 * self.unit * rounding / abs(poly_value(self.size, s))

    def watch(self, orders: int) -> None:
        """The coefficients of l'S l up to this order."""
        if self.curved is not None:
            for k in range(orders + 1):
                self.inner[k] = self._stick_expansion.order(k)[0]

    def stop_threshold(self, sizes: Sequence[float], rtol: float) -> float:
        """The size at which a slip ends: y is then put to 0, which no row feels by more than a share of rtol, or of rounding.

        One that begins below it is let grow.
        """
        now = math.hypot(*(row[0] for row in self.y))
        if not now or (self.curved is None and not self.is_singular_at_onset):
            return 0.0
        share = min(sizes[i] / abs(row[0]) for i, row in zip(self.at, self.y, strict=True) if row[0])
        least = max(STOPS * rtol * share, ABOVE * TIE * max(sizes[i] for i in self.at) / now)
        return self.size[0] * least if least < 1 or self.size[1] < 0 else 0.0


class FrictionBlocks:
    """The blocks of a law that are no boxes, or that grow.

    Attributes:
        all: these; of: those that are at rows, by row.
        push: what stands for l in f, g and h: l itself but where a block grows.
        released: curved ones that slip, and begin the piece with y = 0: see `release`.
    """

    def __init__(self, problem: ContinuousProblem, l: list[list[float]], y: list[list[float]]) -> None:
        growths, width = {growth.first: growth for growth in problem.growths}, len(l[0]) if l else 0
        self.all: list[FrictionBlock] = []
        self.onset_blocks: list[FrictionBlock] = []
        self.push = list(l)
        for rows, block in problem.law.parts():
            at, curved = tuple(range(rows.start, rows.stop)), block.curved()
            for own in [at] if curved is not None else [(i,) for i in at if i in growths]:
                growth = growths.get(own[0])
                push = [l[i] if growth is None else [0.0] * width for i in own]
                self.push[own[0] : own[-1] + 1] = push
                series = [l[i] for i in own], [y[i] for i in own], push
                self.all.append(FrictionBlock(own, *series, [0.0] * width, [0.0] * width, curved, growth))
        self.of = {i: block for block in self.all for i in block.at}

    def rows_of(self, i: int) -> tuple[int, ...]:
        """The rows that have one code with row i."""
        return self.of[i].at if i in self.of else (i,)

    def is_curved(self, i: int) -> bool:
        """Whether row i is one of a curved block."""
        return i in self.of and self.of[i].curved is not None

    def slipping_blocks(self, codes: Sequence[int]) -> list[FrictionBlock]:
        """Those that slip."""
        return [block for block in self.all if codes[block.first]]

    def begin(self, codes: Sequence[int], size_y: Callable[[int], float]) -> None:
        """Order 0, with who slips from y = 0."""
        self.onset_blocks = []
        for block in self.slipping_blocks(codes):
            block.size[:] = [0.0] * len(block.size)
            rests = block.is_at_rest(TIE * max(map(size_y, block.at)))
            if rests and block.curved is not None:
                self.onset_blocks.append(block)
                continue
            block.compute_slip_order(codes[block.first], 0)
            if rests:
                block.size[0] = 0.0
        self.pushed(codes, 0)

    def compute_slip_order(self, codes: Sequence[int], k: int) -> None:
        """Order k of what follows from y."""
        for block in self.slipping_blocks(codes):
            if block not in self.onset_blocks:
                block.compute_slip_order(codes[block.first], k)
        self.pushed(codes, k)

    def pushed(self, codes: Sequence[int], k: int) -> None:
        """Order k of what pushes."""
        for block in self.all:
            block.pushed(codes[block.first], k)

    def watch(self, codes: Sequence[int], orders: int) -> None:
        """What is looked at in stick, 0 in slip."""
        for block in self.all:
            block.inner[:] = [0.0] * len(block.inner)
            if not codes[block.first]:
                block.watch(orders)


def with_stick_slip_modes(problem: ContinuousProblem) -> ContinuousProblem:
    """Return the problem, where all of its curved blocks have stick and slip as modes; a ball of radius 0 as the box that it is.

    Raises:
        NotEventDriven: a cone, or another curved set; a row of a curved block that depends on a multiplier.
    """
    laws, l = [], problem.l
    for rows, block in problem.law.parts():
        K, here = block.curved(), slice(rows.start, rows.stop)
        if not block.separable and (K is None or K.slip(ca.SX.sym("y", block.size)) is None):
            raise NotEventDriven(f"the law '{block.label}' has other modes than stick and slip; its sets are for time stepping")
        if K is not None and block.extent == 0:
            zero = ca.SX.zeros(block.size)
            laws.append(box(zero, zero))
            continue
        laws.append(Law((block,)))
        if K is None:
            continue
        name = f"{problem.rows[rows.start]}, in the law '{block.label}'"
        if ca.depends_on(problem.h[here], l) or ca.depends_on(problem.h, l[here]):
            raise NotEventDriven(f"{name}: its y depends on l directly, or another y on its l; that is for time stepping")
        if ca.depends_on(ca.jacobian(problem.g, l), l):
            raise NotEventDriven(f"{name}: x' is not linear in l; that is for time stepping")
    for growth in problem.growths:
        if taylor_decompose(growth.factor, [growth.s], "friction").branches:
            raise NotEventDriven(f"{problem.rows[growth.first]}: theta has a kink; that is for time stepping")
    return replace(problem, law=product(*laws))


ONSET_ITERATIONS = 20  # Iterations of l and sigma at the first order, at most; they end where l moves by 1e-15 of itself.
# INSIDE_MARGIN: less takes what Newton's method leaves for stick, more a block that sticks for one that slips.
INSIDE_MARGIN = 1e-6  # Of c: where l'S l is less than c by more, the block does not slip. (+)
NOT_SLIPPING = -1e100  # Sigma_1 of such a block: so large that no rounding is beside it.


class SlipOnset:
    """Blocks that begin to slip, with the rows ``active`` that are held through y', at the point that order 0 is."""

    def __init__(
        self, active: tuple[int, ...], blocks: list[FrictionBlock], slopes: tuple[np.ndarray, np.ndarray, np.ndarray], tau: float
    ) -> None:
        B, D, C = slopes
        self.tau, self.held = tau, len(active)
        self.rows = [*active, *(i for block in blocks for i in block.at)]
        _, U, V, *_ = generalised_inverse(D[np.ix_(active, active)])
        self.free = U.shape[1]
        own = np.eye(len(self.rows) - self.held)  # Each row of a block is one of its own.
        self.U, self.V = (np.block([[A, np.zeros((len(A), len(own)))], [np.zeros((len(own), A.shape[1])), own]]) for A in (U, V))
        self.W = self.U.T @ (C[self.rows] @ B[:, self.rows]) @ self.V
        self.blocks, self.still, self.at = blocks, list[FrictionBlock](), dict[FrictionBlock, slice]()
        start = self.free
        for block in blocks:
            self.at[block] = slice(start, start + len(block.at))
            start += len(block.at)
        self.sigma = {block: [0.0] * len(block.size) for block in blocks}

    def begin(self, rate: np.ndarray, l: np.ndarray) -> np.ndarray | None:
        """l_0 of the rows, and sigma_1, from y' (all rows) with this l; None: there is none."""
        start = np.concatenate([np.zeros(self.free), l[self.held :]])
        b = self.U.T @ rate - self.W @ start
        ends = np.full(len(b), np.inf)
        law = NumericLaw(-ends, ends, tuple((self.at[block], block.curved) for block in self.blocks if block.curved))
        guess = semismooth_newton(self.W, b, law, start)
        if guess is None and (guess := semismooth_newton(self.W, b, law, projected_gauss_seidel(self.W, b, law, start))) is None:
            return None
        z = guess
        for block in self.blocks:
            S, c = block.quadric
            own = z[self.at[block]]
            if own @ S @ own < c * (1 - INSIDE_MARGIN):
                self.still.append(block)
                self.sigma[block][1] = NOT_SLIPPING
            else:
                self.sigma[block][1] = float(max(-own @ (self.W @ z + b)[self.at[block]] / c, 0.0))
        self.blocks = [block for block in self.blocks if block not in self.still]
        for _ in range(ONSET_ITERATIONS):
            move = self._solve_linear_system(
                z, 1.0, self.W @ z + b + self._slip_terms(z), [self._boundary_excess(z, block) for block in self.blocks]
            )
            z = z + move[: len(z)]
            for block, d in zip(self.blocks, move[len(z) :], strict=True):
                self.sigma[block][1] += float(d)
            if not np.isfinite(z).all():
                return None
            if np.abs(move[: len(z)]).max(initial=0.0) <= 1e-15 * np.abs(z).max(initial=0.0):
                break
        self.first = z
        for block in self.blocks:
            self.sigma[block][1] *= self.tau
            block.size[1] = float(self.sigma[block][1] * np.sqrt(block.quadric[1]))
        for block in self.still:
            block.size[1] = NOT_SLIPPING
        return np.where(np.arange(len(l)) < self.held, l, 0.0) + self.V @ z

    def step(self, k: int, y: np.ndarray) -> np.ndarray:
        """l_k of the rows and sigma_(k+1), from y_(k+1) (all rows) as it is with l_k = 0."""
        z = self.first
        rest, norms = self.U.T @ y, []
        for block in self.blocks:
            S, _ = block.quadric
            sigma, l = self.sigma[block], np.array([row[:k] for row in block.l])
            rest[self.at[block]] += S @ sum((sigma[k + 1 - i] * l[:, i] for i in range(1, k)), np.zeros(len(block.at)))
            norms.append(sum_in_order(float(l[:, i] @ S @ l[:, k - i]) for i in range(1, k)) / 2)
        found = self._solve_linear_system(z, self.tau / (k + 1), rest, norms)
        for block, v in zip(self.blocks, found[len(z) :], strict=True):
            self.sigma[block][k + 1] = float(v)
            block.size[k + 1] = float(v * np.sqrt(block.quadric[1]))
        return self.V @ found[: len(z)]

    def _solve_linear_system(self, z: np.ndarray, share: float, rest: np.ndarray, norms: list[float]) -> np.ndarray:
        """The system of order j, share = tau/j."""
        n, count = len(z), len(self.blocks)
        A = np.zeros((n + count, n + count))
        A[:n, :n] = share * self.W
        for j, block in enumerate(self.blocks):
            own, S = self.at[block], block.quadric[0]
            A[own, own] += self.sigma[block][1] * S
            A[own, n + j] = A[n + j, own] = S @ z[own]
        r, c = np.abs(A).max(axis=1), np.abs(A).max(axis=0)
        r, c = (1 / np.sqrt(np.where(size > 0, size, 1)) for size in (r, c))
        scaled = A * r[:, None] * c
        right = -np.concatenate([rest, norms]) * r
        with np.errstate(all="ignore"):
            if not np.isfinite(scaled).all() or not np.isfinite(right).all():
                return np.full(n + count, np.nan)
            return c * np.linalg.lstsq(scaled, right, rcond=1e-13)[0]

    def _slip_terms(self, z: np.ndarray) -> np.ndarray:
        total = np.zeros(len(z))
        for block in self.blocks:
            total[self.at[block]] = self.sigma[block][1] * (block.quadric[0] @ z[self.at[block]])
        return total

    def _boundary_excess(self, z: np.ndarray, block: FrictionBlock) -> float:
        S, c = block.quadric
        return float(z[self.at[block]] @ S @ z[self.at[block]] - c) / 2
