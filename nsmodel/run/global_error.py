"""A proved bound of the global error of an event-driven run, where the model is monotone in a metric |.|_P.

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

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses import least_omega
from nsmodel.classes.lure.hypotheses.dissipation import least_rate
from nsmodel.classes.lure.hypotheses.pairing import well_conditioned
from nsmodel.classes.lure.hypotheses.passivity import storage
from nsmodel.pieces.bounds import Bounds, Stored, ranges
from nsmodel.pieces.jets import jets_of
from nsmodel.proof import exact, interval
from nsmodel.proof.graph import replay
from nsmodel.proof.interval_arithmetic import up
from nsmodel.proof.interval_number import exactly, function
from nsmodel.scheme.continuous import ContinuousProblem

CUTS = 8  # Boxes that each piece is covered by.
SAMPLES = 8  # Jacobians for which P is chosen.
TUBES = (1e-6, 1e-3, 1e-1)  # Half widths of tubes that are tried, beside the largest of each state.
ZERO = 1e-9  # omega beside f_x below which omega = 0 is tried.
ROUND = 1e-12  # What sums in doubles may err by: every bound is raised by this share.


class NoBound(ValueError):
    """Why there is no bound; the message says it."""


@dataclass(frozen=True)
class GlobalError:
    """|x(t) - x~(t)| <= ``states`` (K, n) on each piece, inf from where that leaves the tube; P in doubles, the largest omega."""

    states: np.ndarray
    P: np.ndarray
    omega: float


class _Linear(NamedTuple):
    """B (n, m), C (m, n), D (m, m): numbers of g = B l and h = C x + D l + e(t)."""

    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


class _Field(NamedTuple):
    """omega (K,) and |f_x| (K, n, n) on a tube around the pieces."""

    omega: np.ndarray
    size: np.ndarray


class _Moves(NamedTuple):
    """On the halves of pieces (K, 2, n): |z|, |z'|, |B| |l^ - l~|; whether z may jump where halves meet (K,)."""

    z: np.ndarray
    rate: np.ndarray
    clipped: np.ndarray
    jumps: np.ndarray


class _Metric:
    """|.|_P of a rational P > 0, and bounds in it."""

    def __init__(self, P: np.ndarray) -> None:
        self.P, self.doubles = P, exact.doubles(P)
        self._sizes = np.vectorize(lambda p: exact.up(abs(p)), otypes=[float])(P)
        self._unit = 2.0 ** np.round(np.log2(np.diagonal(self.doubles)) / 2)
        scaled = P / exact.rational(np.outer(self._unit, self._unit))
        self._least = -exact.eigenvalue_above(-scaled)
        inverse = exact.inverse(P)
        if self._least <= 0 or inverse is None:
            raise NoBound("the P with P g_l = h_x' is singular up to rounding")
        self._entries = np.array([exact.up(inverse[i, i]) for i in range(len(P))]) ** 0.5 * (1 + ROUND)

    def norm(self, size: np.ndarray) -> np.ndarray:
        """A bound of |v|_P for |v_i| <= size_i, of (..., n)."""
        return np.sqrt(np.einsum("...i,ij,...j->...", size, self._sizes, size)) * (1 + ROUND) + 1e-150

    def states(self, norm: np.ndarray) -> np.ndarray:
        """Bounds (..., n) of the entries of a vector of this norm."""
        return norm[..., None] * self._entries

    def omega(self, low: np.ndarray, high: np.ndarray) -> float:
        """A bound of v'P J v / v'P v for low <= J <= high."""
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return np.inf
        middle = low / 2 + high / 2
        off = np.maximum(high - middle, middle - low) * (1 + ROUND)
        Q = self._sizes @ off / np.outer(self._unit, self._unit)
        more = float(((Q + Q.T) / 2).sum(axis=1).max(initial=0.0)) / self._least * (1 + ROUND)
        about, scale = least_omega.rate(self.doubles, middle), float(np.abs(middle).max(initial=0.0))
        PJ = exact.product(self.P, exact.rational(middle))
        for lift in (0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3):
            omega = about + lift * scale if abs(about) > ZERO * scale else lift * scale
            if exact.is_psd(Fraction(omega) * self.P - PJ):
                return up(np.array(omega + more)).item()
        return np.inf


def global_error(problem: ContinuousProblem, stored: Stored, found: Bounds, jump: np.ndarray) -> GlobalError:
    """Bound the distance of the polynomials from the solution that starts at x0; ``jump`` (K, n): of x~ where pieces begin.

    Raises:
        NoBound: the model is of another form, has no such P, or the bound leaves every tube at once.
    """
    linear, J = _linear(problem), ca.jacobian(_without_max(problem.f, problem.x), problem.x)
    z = ca.vertcat(problem.t, problem.x)
    free, sizes = not ca.depends_on(J, z), np.abs(stored.x[:, :, 0]).max(axis=0)
    metric, moves = _metric(problem, J, linear, stored), _moves(problem, linear, stored, found)
    t, x = ranges(stored, CUTS)
    bounds = []
    for share in (np.inf,) if free else TUBES:
        tube = np.full(len(sizes), np.inf) if free else share * np.maximum(sizes, sizes.max())
        box = [np.column_stack([t.lo, x.lo - tube]), np.column_stack([t.hi, x.hi + tube])]
        _refuse_jumps(problem, z, box)
        field = _field(metric, J, z, [np.nan_to_num(end) for end in box] if free else box)
        states = _integrated(field, metric, moves, stored, found, jump)
        out = ~(np.isfinite(states) & (states + moves.z.max(axis=1) < tube)).all(axis=1)
        states[int(out.argmax()) if out.any() else len(out) :] = np.inf
        bounds.append(GlobalError(states, metric.doubles, float(field.omega.max())))
    best = max(bounds, key=lambda bound: int(np.isfinite(bound.states[:, 0]).sum()))
    if np.isfinite(best.states[0]).all():
        return best
    raise NoBound("the bound grows beyond all tubes around the run in which f_x was bounded")


def _without_max(f: ca.SX, x: ca.SX) -> ca.SX:
    """The same with max(a, b) = (a + b + |a - b|)/2, and min: CasADi's derivative of max is 0/0 for intervals."""

    def rule(op: int, args: list[ca.SX], _: ca.SX) -> ca.SX:
        a, b = args
        return (a + b + (1 if op == ca.OP_FMAX else -1) * ca.fabs(a - b)) / 2

    return replay(f, rule, (ca.OP_FMAX, ca.OP_FMIN), x, "f")


def _linear(problem: ContinuousProblem) -> _Linear:
    p, moving = problem, ca.veccat(problem.t, problem.x, problem.l)
    parts = {"g_l": (p.g, p.l), "h_x": (p.h, p.x), "h_l": (p.h, p.l)}
    numbers = []
    for name, (of, by) in parts.items():
        matrix = ca.densify(ca.cse(ca.jacobian(of, by)))
        if ca.depends_on(matrix, moving):
            raise NoBound(f"{name} is not constant; there is a bound for constant g_l, h_x and h_l")
        low = high = np.zeros(matrix.shape)
        if matrix.numel():
            low, high = interval.enclose(matrix, ca.SX.sym("none"), np.zeros(1), np.zeros(1))
        if not (low == high).all():
            raise NoBound(f"{name} is made of rounded numbers; write each entry as one number")
        numbers.append(low)
    if not exact.psd(numbers[2]).psd:
        raise NoBound("h_l + h_l' is not positive semidefinite: the law is not monotone in l")
    return _Linear(*numbers)


def _metric(problem: ContinuousProblem, J: ca.SX, linear: _Linear, stored: Stored) -> _Metric:
    """The P with P B = C', exactly, with a small omega at some points of the run."""
    pairing = storage(linear.B, linear.C).pairing
    if pairing is None:
        raise NoBound("there is no P = P' > 0 with P g_l = h_x', in which the law would be monotone")
    at = ca.Function("at", [problem.t, problem.x], [ca.densify(J)])
    chosen = np.unique(np.linspace(0, len(stored.start) - 1, SAMPLES).astype(int))
    samples = [np.array(at(stored.start[k], stored.x[k, :, 0])) for k in chosen]
    rate = least_rate(pairing, [M for M in samples if np.isfinite(M).all()] or [np.zeros(J.shape)])
    P = pairing.storage(well_conditioned(pairing) if rate is None else rate.Y)
    if (exact.product(P, linear.B) != exact.rational(linear.C).T).any():
        raise NoBound("P g_l = h_x' holds up to rounding only; choose numbers with fewer digits")
    return _Metric(P)


def _refuse_jumps(problem: ContinuousProblem, z: ca.SX, box: list[np.ndarray]) -> None:
    """Refuse where f is not continuous: there f_x does not bound its differences."""
    if not jets_of(problem.f, [problem.t, problem.x, problem.l], "f").branches:
        return
    if not interval.is_continuous(problem.f, z, box[0].min(axis=0), box[1].max(axis=0)):
        raise NoBound("f is not known to be continuous around the run")


def _field(metric: _Metric, J: ca.SX, z: ca.SX, box: list[np.ndarray]) -> _Field:
    """Of pieces, each covered by CUTS boxes."""
    n, K = J.shape[0], len(box[0]) // CUTS
    low, high = (end.reshape(n, n, -1) for end in interval.natural(interval.program(ca.densify(J), z), *box))
    low, high = (np.broadcast_to(end, (n, n, K * CUTS)).T.reshape(K, CUTS, n, n) for end in (low, high))
    low, high = low.min(axis=1), high.max(axis=1)
    known: dict[bytes, float] = {}
    for a, b in zip(low, high, strict=True):
        if a.tobytes() + b.tobytes() not in known:
            known[a.tobytes() + b.tobytes()] = metric.omega(a, b)
    omega = np.array([known[a.tobytes() + b.tobytes()] for a, b in zip(low, high, strict=True)])
    return _Field(omega, np.maximum(np.abs(low), np.abs(high)))


def _moves(problem: ContinuousProblem, linear: _Linear, stored: Stored, found: Bounds) -> _Moves:
    """What brings x~ and l~ into the law."""
    if np.isinf(found.rows).any():
        raise NoBound("the rows of the law are not proved on every piece")
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
                raise NoBound(f"h_l is not diagonal: other rows of h depend on '{problem.rows[int(crossed.argmax())]}'")
            clipped[k, half] = np.abs(linear.B) @ off
            rows, G = _lifted(problem, linear, stored.codes[k], least, found.rows[k], known)
            w = np.where(stored.codes[k] == 0, found.rows[k], lift)[rows]
            z[k, half] = np.abs(G) @ w
            rate[k, half] = np.abs(G) @ np.where(stored.codes[k] == 0, found.slopes[k], 0.0)[rows]
            jumps[k] |= len(rows) > len(held)
    return _Moves(z * (1 + ROUND), rate * (1 + ROUND), clipped * (1 + ROUND), jumps)


def _lifted(
    problem: ContinuousProblem, linear: _Linear, codes: np.ndarray, least: np.ndarray, held_to: np.ndarray, known: dict
) -> tuple[list[int], np.ndarray]:
    """The rows in which z is prescribed, and G (n, r) with C G = 1 there, rounded away from 0: z = G w."""
    free = [i for i in range(len(codes)) if codes[i] and np.isfinite(least[i])]
    rows = [i for i in range(len(codes)) if codes[i] == 0 or (i in free and least[i] < 0)]
    while True:
        if tuple(rows) not in known:
            known[tuple(rows)] = _right_inverse(problem, linear, rows)
        G = known[tuple(rows)]
        moved = np.abs(linear.C) @ (np.abs(G) @ np.where(codes == 0, held_to, np.maximum(-least, 0.0))[rows]) * (1 + ROUND)
        more = [i for i in free if i not in rows and moved[i] > least[i]]
        if not more:
            return rows, G
        rows = sorted([*rows, *more])


def _right_inverse(problem: ContinuousProblem, linear: _Linear, rows: list[int]) -> np.ndarray:
    if not rows:
        return np.zeros((len(linear.B), 0))
    W = exact.product(exact.rational(linear.C[rows]), exact.rational(linear.B[:, rows]))
    inverse = exact.inverse(W)
    if inverse is None:
        names = ", ".join(problem.rows[i] for i in rows)
        raise NoBound(f"h_x g_l is singular on the rows {names}, which are at 0 together")
    G = exact.product(exact.rational(linear.B[:, rows]), inverse)
    return np.vectorize(lambda p: exact.up(abs(p)), otypes=[float])(G)


def _integrated(field: _Field, metric: _Metric, moves: _Moves, stored: Stored, found: Bounds, jump: np.ndarray) -> np.ndarray:
    """The bounds of the states on each piece (K, n)."""
    raised, K = 1 + ROUND, len(stored.start)
    pulled = np.einsum("kij,khj->khi", field.size, moves.z) if moves.z.any() else 0.0
    rate = metric.norm((moves.rate + moves.clipped + pulled) * raised)
    missed, moved, jumped = metric.norm(found.integral), metric.norm(moves.z), metric.norm(jump)
    half = (stored.end - stored.start) / 2 * raised
    growth = function("exp")(exactly(up(field.omega * half))).hi
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
