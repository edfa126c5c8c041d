"""What the judges share: expressions at rows, running error bounds, what is allowed, laws and potentials by their definition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.laws import Law, LawFactor
from nsmodel.proof.graph import apply_operation, fold_graph, stack_column
from nsmodel.stress.moving import BallAtRows, BoxAtRows
from nsmodel.trajectory import Trajectory

EQUATION_TOLERANCE = LAW_TOLERANCE = 1e-8
PROJECTION_TOLERANCE = 1e-6
EVALUATION_ROUNDING = 64 * np.finfo(float).eps
UNDERFLOW_SIZE = 1e-290
PROBE_LENGTHS = (1e-6, 1e-3, 1.0)  # lengths of the probes, beside the velocity

StepResiduals = dict[str, float]


def evaluate_at_rows(symbols: Sequence[ca.SX], expressions: Sequence[ca.SX], *columns: np.ndarray) -> list[np.ndarray]:
    """Each expression (r, c) at N rows as an array (N, r, c); columns (N, k) in the order of the symbols."""
    f = ca.Function("f", list(symbols), [ca.densify(ca.SX(e)) for e in expressions])
    out = f.map(len(columns[0])).call([ca.DM(c.reshape(len(columns[0]), -1).T) for c in columns])
    return [
        np.array(v).reshape(e.shape[0], len(columns[0]), e.shape[1]).transpose(1, 0, 2)
        for v, e in zip(out, (ca.SX(e) for e in expressions), strict=True)
    ]


def step_begins(run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u(t+) where each step begins: (N,), (N, n), (N, nu)."""
    return run.t[:-1], run.x[:-1], run_inputs(run, "inputs_begin")[1:]


def step_ends(run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u(t-) where each step ends."""
    return run.t[1:], run.x[1:], run_inputs(run)[1:]


def run_inputs(run: Trajectory, side: str = "inputs") -> np.ndarray:
    """The inputs of all rows (N + 1, nu): u(t-), or "inputs_begin"."""
    return run.arrays.get(side, np.zeros((len(run.t), 0)))


def majorant(expression: ca.SX) -> ca.SX:
    """The running error bound of evaluating ``expression``, in units of the rounding: the sizes of all its terms.

    Symbols and numbers are known to their last digit; an operation passes on what its arguments are not known to, times its
    slopes, and rounds its result. What cannot be looked into counts as its value alone.
    """

    def propagate_error(op: int, terms: list[tuple[ca.SX, ca.SX]]) -> tuple[ca.SX, ca.SX]:
        fresh = [ca.SX.sym("a") for _ in terms]
        here, old = apply_operation(op, fresh), stack_column(fresh)
        value, *slopes = ca.substitute([here, *(ca.gradient(here, a) for a in fresh)], [old], [stack_column(v for v, _ in terms)])
        return value, ca.fabs(value) + sum((ca.fabs(d) * size for d, (_, size) in zip(slopes, terms, strict=True)), ca.SX(0))

    expression = ca.SX(expression)
    try:
        found = fold_graph(
            expression, lambda symbol: (symbol, ca.fabs(symbol)), lambda c: (ca.SX(c), ca.SX(abs(c))), propagate_error
        )
    except ValueError:
        return ca.fabs(expression)
    return ca.reshape(stack_column(size for _, size in found), *expression.shape)


def apply_matrices(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each matrix (N, r, n) times its vector (N, n)."""
    return np.einsum("kij,kj->ki", matrices, vectors)


def worst_ratio(misfit: np.ndarray, allowed: np.ndarray) -> float:
    """Largest misfit/allowed, 0/0 = 0; what is not a number is infinitely wrong."""
    if not misfit.size:
        return 0.0
    ratio = ratio_to_allowed(misfit, allowed)
    return float(np.max(np.where(np.isnan(ratio), np.inf, ratio)))


def rounding_allowance(*sizes: np.ndarray) -> np.ndarray:
    """ROUNDING times sizes (N, k, 1); where a slope is infinite (a norm at 0) nothing is allowed."""
    return EVALUATION_ROUNDING * np.sum([np.where(np.isfinite(size), size, 0.0)[:, :, 0] for size in sizes], axis=0)


def ratio_to_allowed(misfit: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """misfit/allowed; what is lost among the smallest doubles counts as 0."""
    return np.where(misfit <= UNDERFLOW_SIZE, 0.0, misfit / allowed)


class StepMagnitudes(NamedTuple):
    """Of each step (N, n): what acts on the states in it, and what they are known to."""

    acting: np.ndarray
    known: np.ndarray


def output_law_residual(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, law: Law, sizes: StepMagnitudes) -> StepResiduals:
    """-y ∈ N_K(l) with y computed afresh; y's scale is what moves it or acts on it in the step, and what is not known of it."""
    y, s_y = output_with_error(model, run, output, l, sizes)
    given, worst = run.multipliers[1:], 0.0
    for rows, block in law.parts():
        own = block_at_rows(block, model, run) if any(block.moves(ca.vertcat(model.t, model.u))) else block
        worst = max(worst, block_residual(own, given[:, rows], y[:, rows], s_y[:, rows]))
    return {"law": worst}


def moving_bound_sizes(model: Any, run: Trajectory) -> np.ndarray:
    """The largest end of each row of the law that moves, where each step ends (N + 1, m), the start first; 0 of the others."""
    law, own = getattr(model, "law", None), np.zeros((len(run.t), run.multipliers.shape[1] if "multipliers" in run.arrays else 0))
    if law is not None:
        for rows, block in law.parts():
            if any(moves := block.moves(ca.vertcat(model.t, model.u))):
                own[1:, rows] = block_at_rows(block, model, run).extent[:, None] * np.array(moves)
    return own


def block_at_rows(block: LawFactor, model: Any, run: Trajectory) -> BoxAtRows | BallAtRows:
    """The set of each step's end, of a block whose numbers move."""
    t, _, u = step_ends(run)
    numbers = evaluate_at_rows([model.t, model.u], list(block.numbers.values()), t, u)
    return BoxAtRows(*(rows[:, :, 0] for rows in numbers)) if block.separable else BallAtRows(numbers[0][:, 0])


def output_with_error(
    model: Any, run: Trajectory, output: ca.SX, l: ca.SX, sizes: StepMagnitudes
) -> tuple[np.ndarray, np.ndarray]:
    """y (N, m), and what it may be off by."""
    given, h = run.multipliers[1:], run.step[1:, None]
    slopes = [ca.jacobian(output, symbol) for symbol in (model.x, l, model.t, model.u)]
    expressions = [output, *slopes, majorant(output)]
    y, C, D, drift, driven, size_y = evaluate_at_rows([model.t, model.x, model.u, l], expressions, *step_ends(run), given)
    moves = np.abs(run.x[1:] - run.x[:-1]) + sizes.acting
    begin, end = run_inputs(run, "inputs_begin")[1:], run_inputs(run)
    input_changes = np.abs(end[1:] - begin) + np.abs(begin - end[:-1])
    s_y = LAW_TOLERANCE * (
        apply_matrices(np.abs(C), moves) + apply_matrices(np.abs(D), np.abs(given)) + h * np.abs(drift[:, :, 0])
    )
    s_y += LAW_TOLERANCE * apply_matrices(np.abs(driven), input_changes)
    return y[:, :, 0], s_y + apply_matrices(np.abs(C), sizes.known) + rounding_allowance(size_y)


def block_residual(block: LawFactor | BoxAtRows | BallAtRows, l: np.ndarray, y: np.ndarray, s_y: np.ndarray) -> float:
    """How far rows are from l ∈ K with <l' - l, y> >= 0 for the l' ∈ K that the block samples, beside what both may be off by.

    Where K is strictly convex one l' has the least <l', y>: l is measured by its distance from that, unless y is 0.
    """
    s_l = LAW_TOLERANCE * np.maximum(np.abs(l).max(axis=1), block.extent)
    worst = ratio_to_allowed(block.excess(l).max(axis=1, initial=0.0), s_l)
    size_y, rivals = np.linalg.norm(y, axis=1), block.rivals(l, y)
    if block.strict:
        away = ratio_to_allowed(np.linalg.norm(l - rivals[0], axis=1), s_l)
        return float(np.max(np.maximum(worst, np.fmin(ratio_to_allowed(size_y, s_y.max(axis=1)), away)), initial=0.0))
    for other in rivals:
        gap = np.maximum(((l - other) * y).sum(axis=1), 0)
        worst = np.maximum(worst, ratio_to_allowed(gap, (np.abs(l - other) * s_y).sum(axis=1) + size_y * s_l))
    return float(np.max(worst, initial=0.0))


def subgradient_residual(
    phi: ca.SX, symbol: ca.SX, y: np.ndarray, slope: np.ndarray, size: np.ndarray, unknown: np.ndarray | float = 0.0
) -> float:
    """Largest Phi(y) + <slope, z - y> - Phi(z) beside what is allowed; y is known to ``unknown``."""
    here, worst, sizes = evaluate_at_rows([symbol], [phi], y)[0][:, 0, 0], 0.0, majorant(phi)
    inside = rounding_allowance(*evaluate_at_rows([symbol], [sizes], y))[:, 0] + (np.abs(slope) * unknown).sum(axis=1)
    probes = [np.zeros_like(y), *(y + s * p * size * e for e in np.eye(y.shape[1]) for p in PROBE_LENGTHS for s in (1, -1))]
    for probe in probes:
        at_probe, along = evaluate_at_rows([symbol], [phi], probe)[0][:, 0, 0], (slope * (probe - y)).sum(axis=1)
        allowed = (
            EVALUATION_ROUNDING * (np.abs(here) + np.where(np.isfinite(at_probe), np.abs(at_probe), 0))
            + LAW_TOLERANCE * np.abs(along)
            + inside
        )
        worst = max(worst, worst_ratio(np.maximum(here + along - at_probe, 0), allowed))
    return worst
