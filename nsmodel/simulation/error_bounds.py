"""The certificate of an event-driven run: from its pieces, and as arrays and metadata.

A proved bound of the global error of an event-driven run, where the model is monotone in a metric |.|_P.

For x' = f(t, x) + B l, y = C x + D l + e(t), -y in N_K(l), with P B = C', D + D' >= 0 and

    <f(t, x) - f(t, z), x - z>_P <= omega |x - z|_P^2,

two solutions part by d/dt |x - z|_P <= omega |x - z|_P (Brogliato and Goeleven 2013, (40); Gronwall). The polynomials x~, l~ are
moved by little, to x^ = x~ + z and l^, l~ cut off at the ends of K, which are in the law exactly: C_i z = -h_i on held rows, and
C_i z lifts rows whose sign is not proved. So

    d/dt |x^ - x|_P <= omega |x^ - x|_P + |delta|_P,  |delta| <= |x~' - f - g| + |z'| + |f_x| |z| + |B| |l^ - l~|,

with the jumps of x~ and of z where pieces, or their halves, meet. f_x is bounded on a tube around x~; the bound holds as long as
it stays inside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.event_driven.integrator import Integrator
from nsmodel.event_driven.interval_proof import (
    MAX_REPORTED_FAILURES,
    AllowedErrors,
    IntervalProof,
    PieceBounds,
    ProofFailure,
    StoredPieces,
    certify_pieces,
    piece_ranges,
    state_enclosures,
)
from nsmodel.event_driven.modes import describe_undecided
from nsmodel.event_driven.piece import Piece
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.recurrences import taylor_decompose
from nsmodel.proof import dissipation, exact, interval_bounds
from nsmodel.proof.dissipation import ZERO_RATE_TOLERANCE, least_rate
from nsmodel.proof.expression_graph import rewrite_nodes
from nsmodel.proof.interval_arithmetic import next_up
from nsmodel.proof.interval_functions import Interval, interval_function, point_intervals
from nsmodel.proof.storage_matrix import find_storage_matrix, well_conditioned_block

BOXES_PER_PIECE = 8  # Boxes that each piece is covered by: bounds of f_x are over boxes, and cost as many. (+)
METRIC_SAMPLES = 8  # Jacobians for which P is chosen; whatever it is, the bound holds, and may be worse. (+)
# TUBE_HALF_WIDTHS: a bound that leaves one is sought in the next, on which f_x is larger.
TUBE_HALF_WIDTHS = (1e-6, 1e-3, 1e-1)  # Half widths of tubes that are tried, beside the largest of each state. (+)
# SUM_ROUNDING_SHARE: every bound is raised by this share: 4500 EPS, sums have as many terms as a model has states.
SUM_ROUNDING_SHARE = 1e-12  # What sums in doubles may err by.


class NoErrorBound(ValueError):
    """Why there is no bound; the message says it."""


@dataclass(frozen=True)
class GlobalError:
    """|x(t) - x~(t)| <= ``states`` (K, n) on each piece, inf from where that leaves the tube; P in doubles, the largest omega."""

    states: np.ndarray
    P: np.ndarray
    omega: float


class _LawMatrices(NamedTuple):
    """B (n, m), C (m, n), D (m, m): numbers of g = B l and h = C x + D l + e(t)."""

    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


class _FieldBounds(NamedTuple):
    """omega (K,) and |f_x| (K, n, n) on a tube around the pieces."""

    omega: np.ndarray
    size: np.ndarray


class _LawCorrections(NamedTuple):
    """On the halves of pieces (K, 2, n): |z|, |z'|, |B| |l^ - l~|; whether z may jump where halves meet (K,)."""

    z: np.ndarray
    rate: np.ndarray
    clipped: np.ndarray
    jumps: np.ndarray


class _QuadraticMetric:
    """|.|_P of a rational P > 0, and bounds in it."""

    def __init__(self, P: np.ndarray) -> None:
        self.P, self.doubles = P, exact.doubles(P)
        self._sizes = np.vectorize(lambda p: exact.round_up(abs(p)), otypes=[float])(P)
        self._unit = 2.0 ** np.round(np.log2(np.diagonal(self.doubles)) / 2)
        scaled = P / exact.rational(np.outer(self._unit, self._unit))
        self._least = -exact.eigenvalue_upper_bound(-scaled)
        inverse = exact.inverse_matrix(P)
        if self._least <= 0 or inverse is None:
            raise NoErrorBound("the P with P g_l = h_x' is singular up to rounding")
        self._entries = np.array([exact.round_up(inverse[i, i]) for i in range(len(P))]) ** 0.5 * (1 + SUM_ROUNDING_SHARE)

    def norm(self, size: np.ndarray) -> np.ndarray:
        """A bound of |v|_P for |v_i| <= size_i, of (..., n)."""
        return np.sqrt(np.einsum("...i,ij,...j->...", size, self._sizes, size)) * (1 + SUM_ROUNDING_SHARE) + 1e-150

    def states(self, norm: np.ndarray) -> np.ndarray:
        """Bounds (..., n) of the entries of a vector of this norm."""
        return norm[..., None] * self._entries

    def omega(self, low: np.ndarray, high: np.ndarray) -> float:
        """A bound of v'P J v / v'P v for low <= J <= high."""
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return np.inf
        middle = low / 2 + high / 2
        off = np.maximum(high - middle, middle - low) * (1 + SUM_ROUNDING_SHARE)
        Q = self._sizes @ off / np.outer(self._unit, self._unit)
        more = float(((Q + Q.T) / 2).sum(axis=1).max(initial=0.0)) / self._least * (1 + SUM_ROUNDING_SHARE)
        about, scale = dissipation.growth_rate(self.doubles, middle), float(np.abs(middle).max(initial=0.0))
        PJ = exact.matrix_product(self.P, exact.rational(middle))
        for lift in (0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3):
            omega = about + lift * scale if abs(about) > ZERO_RATE_TOLERANCE * scale else lift * scale
            if exact.is_psd(Fraction(omega) * self.P - PJ):
                return next_up(np.array(omega + more)).item()
        return np.inf


def global_error(problem: ContinuousProblem, stored: StoredPieces, found: PieceBounds, jump: np.ndarray) -> GlobalError:
    """Bound the distance of the polynomials from the solution that starts at x0; ``jump`` (K, n): of x~ where pieces begin.

    Raises:
        NoBound: the model is of another form, has no such P, or the bound leaves every tube at once.
    """
    linear, J = _law_matrices(problem), ca.jacobian(_replace_max(problem.f, problem.x), problem.x)
    z = ca.vertcat(problem.t, problem.x)
    free, sizes = not ca.depends_on(J, z), np.abs(stored.x[:, :, 0]).max(axis=0)
    metric, moves = _choose_metric(problem, J, linear, stored), _law_corrections(problem, linear, stored, found)
    t, x = piece_ranges(stored, BOXES_PER_PIECE)
    bounds = []
    for share in (np.inf,) if free else TUBE_HALF_WIDTHS:
        tube = np.full(len(sizes), np.inf) if free else share * np.maximum(sizes, sizes.max())
        box = [np.column_stack([t.lo, x.lo - tube]), np.column_stack([t.hi, x.hi + tube])]
        _check_continuous(problem, z, box)
        field = _field_bounds(metric, J, z, [np.nan_to_num(end) for end in box] if free else box)
        states = _integrate_bound(field, metric, moves, stored, found, jump)
        out = ~(np.isfinite(states) & (states + moves.z.max(axis=1) < tube)).all(axis=1)
        states[int(out.argmax()) if out.any() else len(out) :] = np.inf
        bounds.append(GlobalError(states, metric.doubles, float(field.omega.max())))
    best = max(bounds, key=lambda bound: int(np.isfinite(bound.states[:, 0]).sum()))
    if np.isfinite(best.states[0]).all():
        return best
    raise NoErrorBound("the bound grows beyond all tubes around the run in which f_x was bounded")


def _replace_max(f: ca.SX, x: ca.SX) -> ca.SX:
    """The same with max(a, b) = (a + b + |a - b|)/2, and min: CasADi's derivative of max is 0/0 for intervals."""

    def replacement(op: int, args: list[ca.SX], _: ca.SX) -> ca.SX:
        a, b = args
        return (a + b + (1 if op == ca.OP_FMAX else -1) * ca.fabs(a - b)) / 2

    return rewrite_nodes(f, replacement, (ca.OP_FMAX, ca.OP_FMIN), x, "f")


def _law_matrices(problem: ContinuousProblem) -> _LawMatrices:
    p, moving = problem, ca.veccat(problem.t, problem.x, problem.l)
    parts = {"g_l": (p.g, p.l), "h_x": (p.h, p.x), "h_l": (p.h, p.l)}
    numbers = []
    for name, (of, by) in parts.items():
        matrix = ca.densify(ca.cse(ca.jacobian(of, by)))
        if ca.depends_on(matrix, moving):
            raise NoErrorBound(f"{name} is not constant; there is a bound for constant g_l, h_x and h_l")
        low = high = np.zeros(matrix.shape)
        if matrix.numel():
            low, high = interval_bounds.enclose(matrix, ca.SX.sym("none"), np.zeros(1), np.zeros(1))
        if not (low == high).all():
            raise NoErrorBound(f"{name} is made of rounded numbers; write each entry as one number")
        numbers.append(low)
    if not exact.definiteness(numbers[2]).psd:
        raise NoErrorBound("h_l + h_l' is not positive semidefinite: the law is not monotone in l")
    return _LawMatrices(*numbers)


def _choose_metric(problem: ContinuousProblem, J: ca.SX, linear: _LawMatrices, stored: StoredPieces) -> _QuadraticMetric:
    """The P with P B = C', exactly, with a small omega at some points of the run."""
    pairing = find_storage_matrix(linear.B, linear.C).pairing
    if pairing is None:
        raise NoErrorBound("there is no P = P' > 0 with P g_l = h_x', with which the law would be monotone")
    at = ca.Function("at", [problem.t, problem.x], [ca.densify(J)])
    chosen = np.unique(np.linspace(0, len(stored.start) - 1, METRIC_SAMPLES).astype(int))
    samples = [np.array(at(stored.start[k], stored.x[k, :, 0])) for k in chosen]
    rate = least_rate(pairing, [M for M in samples if np.isfinite(M).all()] or [np.zeros(J.shape)])
    P = pairing.storage_matrix(well_conditioned_block(pairing) if rate is None else rate.Y)
    if (exact.matrix_product(P, linear.B) != exact.rational(linear.C).T).any():
        raise NoErrorBound("P g_l = h_x' holds up to rounding only; choose numbers with fewer digits")
    return _QuadraticMetric(P)


def _check_continuous(problem: ContinuousProblem, z: ca.SX, box: list[np.ndarray]) -> None:
    """Refuse where f is not continuous: there f_x does not bound its differences."""
    if not taylor_decompose(problem.f, [problem.t, problem.x, problem.l], "f").branches:
        return
    if not interval_bounds.is_continuous(problem.f, z, box[0].min(axis=0), box[1].max(axis=0)):
        raise NoErrorBound("f is not known to be continuous around the run")


def _field_bounds(metric: _QuadraticMetric, J: ca.SX, z: ca.SX, box: list[np.ndarray]) -> _FieldBounds:
    """Of pieces, each covered by CUTS boxes."""
    n, K = J.shape[0], len(box[0]) // BOXES_PER_PIECE
    low, high = (
        end.reshape(n, n, -1) for end in interval_bounds.natural_extension(interval_bounds.program(ca.densify(J), z), *box)
    )
    low, high = (np.broadcast_to(end, (n, n, K * BOXES_PER_PIECE)).T.reshape(K, BOXES_PER_PIECE, n, n) for end in (low, high))
    low, high = low.min(axis=1), high.max(axis=1)
    known: dict[bytes, float] = {}
    for a, b in zip(low, high, strict=True):
        if a.tobytes() + b.tobytes() not in known:
            known[a.tobytes() + b.tobytes()] = metric.omega(a, b)
    omega = np.array([known[a.tobytes() + b.tobytes()] for a, b in zip(low, high, strict=True)])
    return _FieldBounds(omega, np.maximum(np.abs(low), np.abs(high)))


def _law_corrections(
    problem: ContinuousProblem, linear: _LawMatrices, stored: StoredPieces, found: PieceBounds
) -> _LawCorrections:
    """What brings x~ and l~ into the law."""
    if np.isinf(found.rows).any():
        raise NoErrorBound("the rows of the law are not proved on every piece")
    K, m, n = *stored.codes.shape, stored.x.shape[1]
    z, rate, clipped = (np.zeros((K, 2, n)) for _ in range(3))
    jumps, known = np.zeros(K, bool), {}
    for k in range(K):
        held = np.flatnonzero(stored.codes[k] == 0)
        for half in (0, 1):
            least = found.least[k, half, :m]
            lift = np.maximum(-least, 0.0)
            off = lift * (stored.codes[k] == 0)
            crossed = (off > 0) & ((linear.D != 0) & ~np.eye(m, dtype=bool)).any(axis=0)
            if crossed.any():
                raise NoErrorBound(f"h_l is not diagonal: other rows of h depend on '{problem.rows[int(crossed.argmax())]}'")
            clipped[k, half] = np.abs(linear.B) @ off
            rows, G = _prescribed_rows(problem, linear, stored.codes[k], least, found.rows[k], known)
            w = np.where(stored.codes[k] == 0, found.rows[k], lift)[rows]
            z[k, half] = np.abs(G) @ w
            rate[k, half] = np.abs(G) @ np.where(stored.codes[k] == 0, found.slopes[k], 0.0)[rows]
            jumps[k] |= len(rows) > len(held)
    return _LawCorrections(
        z * (1 + SUM_ROUNDING_SHARE), rate * (1 + SUM_ROUNDING_SHARE), clipped * (1 + SUM_ROUNDING_SHARE), jumps
    )


def _prescribed_rows(
    problem: ContinuousProblem, linear: _LawMatrices, codes: np.ndarray, least: np.ndarray, held_to: np.ndarray, known: dict
) -> tuple[list[int], np.ndarray]:
    """The rows in which z is prescribed, and G (n, r) with C G = 1 there, rounded away from 0: z = G w."""
    free = [i for i in range(len(codes)) if codes[i] and np.isfinite(least[i])]
    rows = [i for i in range(len(codes)) if codes[i] == 0 or (i in free and least[i] < 0)]
    while True:
        if tuple(rows) not in known:
            known[tuple(rows)] = _right_inverse(problem, linear, rows)
        G = known[tuple(rows)]
        moved = (
            np.abs(linear.C)
            @ (np.abs(G) @ np.where(codes == 0, held_to, np.maximum(-least, 0.0))[rows])
            * (1 + SUM_ROUNDING_SHARE)
        )
        more = [i for i in free if i not in rows and moved[i] > least[i]]
        if not more:
            return rows, G
        rows = sorted([*rows, *more])


def _right_inverse(problem: ContinuousProblem, linear: _LawMatrices, rows: list[int]) -> np.ndarray:
    if not rows:
        return np.zeros((len(linear.B), 0))
    W = exact.matrix_product(exact.rational(linear.C[rows]), exact.rational(linear.B[:, rows]))
    inverse = exact.inverse_matrix(W)
    if inverse is None:
        names = ", ".join(problem.rows[i] for i in rows)
        raise NoErrorBound(f"h_x g_l is singular on the rows {names}, which are at 0 together")
    G = exact.matrix_product(exact.rational(linear.B[:, rows]), inverse)
    return np.vectorize(lambda p: exact.round_up(abs(p)), otypes=[float])(G)


def _integrate_bound(
    field: _FieldBounds,
    metric: _QuadraticMetric,
    moves: _LawCorrections,
    stored: StoredPieces,
    found: PieceBounds,
    jump: np.ndarray,
) -> np.ndarray:
    """The bounds of the states on each piece (K, n)."""
    raised, K = 1 + SUM_ROUNDING_SHARE, len(stored.start)
    pulled = np.einsum("kij,khj->khi", field.size, moves.z) if moves.z.any() else 0.0
    rate = metric.norm((moves.rate + moves.clipped + pulled) * raised)
    missed, moved, jumped = metric.norm(found.integral), metric.norm(moves.z), metric.norm(jump)
    half = (stored.end - stored.start) / 2 * raised
    growth = interval_function("exp")(point_intervals(next_up(field.omega * half))).hi
    bound, e, before = np.zeros(K), 0.0, 0.0
    for k in range(K):
        e += jumped[k]
        most = np.maximum(1.0, growth[k])
        for side in (0, 1):
            e += before + moved[k, side] if side == 0 or moves.jumps[k] else 0.0
            added = (rate[k, side] * half[k] + (missed[k] if side == 0 else 0.0)) * most  # What is missed in all, at once.
            bound[k] = np.maximum(bound[k], (e * most + added) * raised + moved[k, side])
            e = (e * growth[k] + added) * raised
            before = moved[k, side]
    return metric.states(np.where(np.isnan(bound), np.inf, bound * raised))


@dataclass(frozen=True)
class CertifiedRun:
    """Pieces with their certificate, and a bound of the global error, or why there is none."""

    stored: StoredPieces
    certificate: IntervalProof
    error: GlobalError | NoErrorBound

    def arrays(self, number: np.ndarray, t: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of the rows t (k,), x (k, states), by the piece that each ends or lies in, and lists of pieces."""
        certificate, bounds, share = self.certificate, self.certificate.bounds, self.certificate.share
        worst = [share[a : b + 1].max(initial=0.0) for a, b in zip([0, *number], number, strict=False)]
        arrays = {
            "defect_bound": np.array([np.nan, *worst[1:]]),
            "piece_proved": certificate.proved, "piece_defect": bounds.defect, "piece_missed": bounds.integral,
            "piece_row_defect": bounds.rows, "piece_jump": certificate.jump, "piece_depth": bounds.depth,
            "piece_reach": bounds.reach,
        }  # fmt: skip
        if isinstance(self.error, GlobalError):
            off = state_enclosures(self.stored, number, t)
            off = (Interval(off.lo[:, : x.shape[1]], off.hi[:, : x.shape[1]]) - point_intervals(x)).magnitude
            off = np.nextafter(self.error.states[number, : x.shape[1]] + off, np.inf)
            off[0] = 0.0
            arrays |= {"error_bound": off, "piece_error": self.error.states}
        return arrays

    def metadata(self, names: tuple[str, ...]) -> dict[str, Any]:
        """What is proved, in short; depth beside the largest value of each condition."""
        certificate, bounds, error = self.certificate, self.certificate.bounds, self.error
        with np.errstate(all="ignore"):
            deep = np.where(bounds.depth > 0, bounds.depth / bounds.size, 0.0)
        about: dict[str, Any] = {
            "kind": "interval", "pieces": len(certificate.proved), "proved": int(certificate.proved.sum()),
            "share": float(certificate.share.max(initial=0.0)), "row_defect": float(bounds.rows.max(initial=0.0)),
            "depth": float(deep.max(initial=0.0)), "reach": float(bounds.reach.max(initial=0.0)),
            "conditions": list(certificate.conditions), "not_proved": len(certificate.failures),
            "failures": [
                f"t = {f.t:.10g} to {f.until:.10g}, piece {f.piece}: {f.what}"
                for f in certificate.failures[:MAX_REPORTED_FAILURES]
            ],
        }  # fmt: skip
        if isinstance(error, NoErrorBound):
            return about | {"error": None, "no_error_bound": str(error)}
        known = np.isfinite(error.states).all(axis=1)
        largest = error.states[known].max(axis=0)
        until = float(self.stored.end[known][-1])
        worst = {"state": names[int(largest.argmax())], "bound": float(largest.max())}
        return about | {
            "error": {**worst, "omega": error.omega, "P": error.P.tolist(), "until": until}, "no_error_bound": None
        }  # fmt: skip


def certify_run(integrator: Integrator, pieces: list[Piece], T: float, rtol: float) -> CertifiedRun:
    """Certify the pieces, the last up to T at most."""
    problem, system, sizes = integrator.problem, integrator.system, integrator.sizes
    stored = _stored_pieces(pieces, T)
    terms = np.array([system.size_y(i) for i in range(system.m)])
    allowed = AllowedErrors.of(rtol, np.array(integrator.atol), np.array(sizes.x), terms)
    certificate = _mark_undecided_piece(
        certify_pieces(problem, stored, np.array(ca.DM(problem.x0)).ravel(), allowed), stored, integrator
    )
    try:
        if any(piece.event and any(piece.event.impulse) for piece in pieces):
            raise NoErrorBound("the run starts with an impulse, for which nothing is proved")
        error = global_error(problem, stored, certificate.bounds, certificate.jump)
    except NoErrorBound as reason:
        error = reason
    return CertifiedRun(stored, certificate, error)


def _mark_undecided_piece(certificate: IntervalProof, stored: StoredPieces, integrator: Integrator) -> IntervalProof:
    """Without the piece of the first event or dip that the run does not know well enough for rtol."""
    system, record = integrator.system, integrator.undecided
    about = describe_undecided(record, integrator.problem.rows, [part for part, _ in system.branches])
    if not about["count"]:
        return certificate
    piece = max(int(np.searchsorted(stored.start, about["t"])) - 1, 0)
    what = f"when '{about['of']}' switches, or whether it does, is known to {about['width']:.2g} of time alone"
    failure = ProofFailure(piece, float(stored.start[piece]), float(stored.end[piece]), what)
    proved = certificate.proved.copy()
    proved[piece] = False
    return replace(certificate, proved=proved, failures=(*certificate.failures, failure))


def _stored_pieces(pieces: list[Piece], T: float) -> StoredPieces:
    start = np.array([piece.t for piece in pieces])
    x, l, y = (np.array([getattr(piece, name) for piece in pieces]) for name in ("x", "l", "y"))
    codes = np.array([piece.codes for piece in pieces], int).reshape(len(pieces), l.shape[1])
    end = np.append(start[1:], min(pieces[-1].end, T))
    return StoredPieces(start, end, np.array([piece.tau for piece in pieces]), x, l, y, codes)
