"""What the judges share: expressions at rows, running error bounds, what is allowed, laws and potentials by their definition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.laws import Block, Law
from nsmodel.proof.graph import applied, column, fold
from nsmodel.stress.moving import BallAtRows, BoxAtRows
from nsmodel.trajectory import Trajectory

EQUATION = LAW = 1e-8
PROJECTION = 1e-6
ROUNDING = 64 * np.finfo(float).eps
LOST = 1e-290
PROBES = (1e-6, 1e-3, 1.0)  # lengths of the probes, beside the velocity

Misfits = dict[str, float]


def evaluated(symbols: Sequence[ca.SX], expressions: Sequence[ca.SX], *columns: np.ndarray) -> list[np.ndarray]:
    """Each expression (r, c) at N rows as an array (N, r, c); columns (N, k) in the order of the symbols."""
    f = ca.Function("f", list(symbols), [ca.densify(ca.SX(e)) for e in expressions])
    out = f.map(len(columns[0])).call([ca.DM(c.reshape(len(columns[0]), -1).T) for c in columns])
    return [
        np.array(v).reshape(e.shape[0], len(columns[0]), e.shape[1]).transpose(1, 0, 2)
        for v, e in zip(out, (ca.SX(e) for e in expressions), strict=True)
    ]


def begins(run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u(t+) where each step begins: (N,), (N, n), (N, nu)."""
    return run.t[:-1], run.x[:-1], inputs_of(run, "inputs_begin")[1:]


def ends(run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u(t-) where each step ends."""
    return run.t[1:], run.x[1:], inputs_of(run)[1:]


def inputs_of(run: Trajectory, side: str = "inputs") -> np.ndarray:
    """The inputs of all rows (N + 1, nu): u(t-), or "inputs_begin"."""
    return run.arrays.get(side, np.zeros((len(run.t), 0)))


def majorant(expression: ca.SX) -> ca.SX:
    """The running error bound of evaluating ``expression``, in units of the rounding: the sizes of all its terms.

    Symbols and numbers are known to their last digit; an operation passes on what its arguments are not known to, times its
    slopes, and rounds its result. What cannot be looked into counts as its value alone.
    """

    def passed(op: int, terms: list[tuple[ca.SX, ca.SX]]) -> tuple[ca.SX, ca.SX]:
        fresh = [ca.SX.sym("a") for _ in terms]
        here, old = applied(op, fresh), column(fresh)
        value, *slopes = ca.substitute([here, *(ca.gradient(here, a) for a in fresh)], [old], [column(v for v, _ in terms)])
        return value, ca.fabs(value) + sum((ca.fabs(d) * size for d, (_, size) in zip(slopes, terms, strict=True)), ca.SX(0))

    expression = ca.SX(expression)
    try:
        found = fold(expression, lambda symbol: (symbol, ca.fabs(symbol)), lambda c: (ca.SX(c), ca.SX(abs(c))), passed)
    except ValueError:
        return ca.fabs(expression)
    return ca.reshape(column(size for _, size in found), *expression.shape)


def apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each matrix (N, r, n) times its vector (N, n)."""
    return np.einsum("kij,kj->ki", matrices, vectors)


def worst_of(misfit: np.ndarray, allowed: np.ndarray) -> float:
    """Largest misfit/allowed, 0/0 = 0; what is not a number is infinitely wrong."""
    if not misfit.size:
        return 0.0
    ratio = over(misfit, allowed)
    return float(np.max(np.where(np.isnan(ratio), np.inf, ratio)))


def known_to(*sizes: np.ndarray) -> np.ndarray:
    """ROUNDING times sizes (N, k, 1); where a slope is infinite (a norm at 0) nothing is allowed."""
    return ROUNDING * np.sum([np.where(np.isfinite(size), size, 0.0)[:, :, 0] for size in sizes], axis=0)


def over(misfit: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """misfit/allowed; what is lost among the smallest doubles counts as 0."""
    return np.where(misfit <= LOST, 0.0, misfit / allowed)


class Sizes(NamedTuple):
    """Of each step (N, n): what acts on the states in it, and what they are known to."""

    acting: np.ndarray
    known: np.ndarray


def outputs_misfit(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, law: Law, sizes: Sizes) -> Misfits:
    """-y ∈ N_K(l) with y computed afresh; y's scale is what moves it or acts on it in the step, and what is not known of it."""
    y, s_y = output_of(model, run, output, l, sizes)
    given, worst = run.multipliers[1:], 0.0
    for rows, block in law.parts():
        own = at_rows(block, model, run) if any(block.moves(ca.vertcat(model.t, model.u))) else block
        worst = max(worst, block_misfit(own, given[:, rows], y[:, rows], s_y[:, rows]))
    return {"law": worst}


def ends_of(model: Any, run: Trajectory) -> np.ndarray:
    """The largest end of each row of the law that moves, where each step ends (N + 1, m), the start first; 0 of the others."""
    law, own = getattr(model, "law", None), np.zeros((len(run.t), run.multipliers.shape[1] if "multipliers" in run.arrays else 0))
    if law is not None:
        for rows, block in law.parts():
            if any(moves := block.moves(ca.vertcat(model.t, model.u))):
                own[1:, rows] = at_rows(block, model, run).extent[:, None] * np.array(moves)
    return own


def at_rows(block: Block, model: Any, run: Trajectory) -> BoxAtRows | BallAtRows:
    """The set of each step's end, of a block whose numbers move."""
    t, _, u = ends(run)
    numbers = evaluated([model.t, model.u], list(block.numbers.values()), t, u)
    return BoxAtRows(*(rows[:, :, 0] for rows in numbers)) if block.separable else BallAtRows(numbers[0][:, 0])


def output_of(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, sizes: Sizes) -> tuple[np.ndarray, np.ndarray]:
    """y (N, m), and what it may be off by."""
    given, h = run.multipliers[1:], run.step[1:, None]
    slopes = [ca.jacobian(output, symbol) for symbol in (model.x, l, model.t, model.u)]
    asked = [output, *slopes, majorant(output)]
    y, C, D, drift, driven, size_y = evaluated([model.t, model.x, model.u, l], asked, *ends(run), given)
    moves = np.abs(run.x[1:] - run.x[:-1]) + sizes.acting
    begin, end = inputs_of(run, "inputs_begin")[1:], inputs_of(run)
    turns = np.abs(end[1:] - begin) + np.abs(begin - end[:-1])
    s_y = LAW * (apply(np.abs(C), moves) + apply(np.abs(D), np.abs(given)) + h * np.abs(drift[:, :, 0]))
    s_y += LAW * apply(np.abs(driven), turns)
    return y[:, :, 0], s_y + apply(np.abs(C), sizes.known) + known_to(size_y)


def block_misfit(block: Block | BoxAtRows | BallAtRows, l: np.ndarray, y: np.ndarray, s_y: np.ndarray) -> float:
    """How far rows are from l ∈ K with <l' - l, y> >= 0 for the l' ∈ K that the block samples, beside what both may be off by.

    Where K is strictly convex one l' has the least <l', y>: l is measured by its distance from that, unless y is 0.
    """
    s_l = LAW * np.maximum(np.abs(l).max(axis=1), block.extent)
    worst = over(block.excess(l).max(axis=1, initial=0.0), s_l)
    size_y, rivals = np.linalg.norm(y, axis=1), block.rivals(l, y)
    if block.strict:
        away = over(np.linalg.norm(l - rivals[0], axis=1), s_l)
        return float(np.max(np.maximum(worst, np.fmin(over(size_y, s_y.max(axis=1)), away)), initial=0.0))
    for other in rivals:
        gap = np.maximum(((l - other) * y).sum(axis=1), 0)
        worst = np.maximum(worst, over(gap, (np.abs(l - other) * s_y).sum(axis=1) + size_y * s_l))
    return float(np.max(worst, initial=0.0))


def subgradient_misfit(
    phi: ca.SX, symbol: ca.SX, y: np.ndarray, slope: np.ndarray, size: np.ndarray, unknown: np.ndarray | float = 0.0
) -> float:
    """Largest Phi(y) + <slope, z - y> - Phi(z) beside what is allowed; y is known to ``unknown``."""
    here, worst, sizes = evaluated([symbol], [phi], y)[0][:, 0, 0], 0.0, majorant(phi)
    inside = known_to(*evaluated([symbol], [sizes], y))[:, 0] + (np.abs(slope) * unknown).sum(axis=1)
    probes = [np.zeros_like(y), *(y + s * p * size * e for e in np.eye(y.shape[1]) for p in PROBES for s in (1, -1))]
    for probe in probes:
        there, along = evaluated([symbol], [phi], probe)[0][:, 0, 0], (slope * (probe - y)).sum(axis=1)
        allowed = ROUNDING * (np.abs(here) + np.where(np.isfinite(there), np.abs(there), 0)) + LAW * np.abs(along) + inside
        worst = max(worst, worst_of(np.maximum(here + along - there, 0), allowed))
    return worst
