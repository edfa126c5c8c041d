"""What interval arithmetic proves of the pieces of a run, beside what was asked: the certificate of `certify="interval"`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nsmodel.pieces.bounds import PieceBounds, StoredPieces, prove_piece_bounds
from nsmodel.pieces.lengths import MULTIPLIERS
from nsmodel.proof.interval_number import Interval, point_intervals
from nsmodel.scheme.continuous import ContinuousProblem

MAX_REPORTED_FAILURES = 10  # Failures that are told, of many.


@dataclass(frozen=True)
class AllowedErrors:
    """What bounds are measured beside, (n,) and (m,): a jump or the integral of a defect, and what is wrong with a row."""

    state: np.ndarray
    row: np.ndarray
    rtol: float

    @staticmethod
    def of(rtol: float, atol: np.ndarray, x: np.ndarray, y: np.ndarray) -> AllowedErrors:
        """Rtol of the largest x, and MULTIPLIERS rtol of the largest terms of y."""
        return AllowedErrors(rtol * x + atol, MULTIPLIERS * rtol * y, rtol)


@dataclass(frozen=True)
class ProofFailure:
    """What is not proved of piece ``piece``, from t to ``until``."""

    piece: int
    t: float
    until: float
    what: str


@dataclass(frozen=True)
class IntervalProof:
    """Proved bounds of K pieces; see `bounds.Bounds`.

    Attributes:
        bounds: of the pieces.
        jump: (K, n) how far x at the start of a piece is at most from the end of the piece before, of the first from x0. Of an
            impulse nothing is proved: a start that jumps is a failure.
        share: (K,) the integral of the defect over the piece, in units of what is allowed.
        proved: (K,) whether all is within what is allowed.
        failures: what is not.
        conditions: names of the sign conditions.
    """

    bounds: PieceBounds
    jump: np.ndarray
    share: np.ndarray
    proved: np.ndarray
    failures: tuple[ProofFailure, ...]
    conditions: tuple[str, ...]


def certify_pieces(problem: ContinuousProblem, stored: StoredPieces, x0: np.ndarray, allowed: AllowedErrors) -> IntervalProof:
    """Prove what can be proved of the pieces as they are stored."""
    found, jump = prove_piece_bounds(problem, stored), jump_bounds(stored, x0)
    with np.errstate(all="ignore"):
        share = np.nan_to_num(found.integral / allowed.state, nan=0.0, posinf=np.inf).max(axis=1, initial=0.0)
    conditions = (*problem.rows, *(f"switch {k} of f, g and h" for k in range(found.depth.shape[1] - len(problem.rows))))
    failures = tuple(_proof_failures(problem, stored, found, jump, allowed, conditions))
    proved = np.ones(len(stored.start), bool)
    proved[[failure.piece for failure in failures]] = False
    return IntervalProof(found, jump, share, proved, failures, conditions)


def state_enclosures(stored: StoredPieces, number: np.ndarray, t: np.ndarray) -> Interval:
    """X (k, n) at times t (k,) on the pieces of these numbers."""
    s = (point_intervals(t) - point_intervals(stored.start[number])) / point_intervals(stored.unit[number])
    s, x = Interval(s.lo[:, None], s.hi[:, None]), point_intervals(stored.x[number, :, -1])
    for k in reversed(range(stored.x.shape[2] - 1)):
        x = x * s + point_intervals(stored.x[number, :, k])
    return x


def jump_bounds(stored: StoredPieces, x0: np.ndarray) -> np.ndarray:
    """(K, n) bounds of |x at the start of a piece - x at the end of the one before|."""
    x = state_enclosures(stored, np.arange(len(stored.start) - 1), stored.end[:-1])
    before = Interval(np.concatenate([x0[None], x.lo]), np.concatenate([x0[None], x.hi]))
    return (point_intervals(stored.x[:, :, 0]) - before).magnitude


def _proof_failures(
    problem: ContinuousProblem,
    stored: StoredPieces,
    found: PieceBounds,
    jump: np.ndarray,
    allowed: AllowedErrors,
    conditions: tuple[str, ...],
) -> Iterator[ProofFailure]:
    """What is beyond what is allowed, in the order of time."""
    low = MULTIPLIERS * allowed.rtol * found.size
    checks = [
        (found.integral, allowed.state, problem.names, "x' = f + g of '{}' is missed by up to {:.3g} in all over the piece"),
        (jump, allowed.state, problem.names, "'{}' jumps by up to {:.3g} where the piece begins"),
        (found.rows, allowed.row, problem.rows, "y = h of '{}' (or l at its end) is missed by up to {:.3g}"),
        (found.depth, low, conditions, "the sign condition of '{}' is only known to be above -{:.3g}"),
    ]
    failed = [
        (k, i, number)
        for number, (bound, limit, *_) in enumerate(checks)
        for k, i in zip(*np.nonzero(~(bound <= limit)), strict=True)
    ]
    for k, i, number in sorted(failed):
        bound, limit, names, template = checks[number]
        what = template.format(names[i], bound[k, i]) + f"; allowed: {limit[i]:.3g}"
        yield ProofFailure(int(k), float(stored.start[k]), float(stored.end[k]), what)
