"""The certificate of an event-driven run: from its pieces, and as arrays and metadata."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.pieces.bounds import StoredPieces
from nsmodel.pieces.certificate import (
    MAX_REPORTED_FAILURES,
    AllowedErrors,
    IntervalProof,
    ProofFailure,
    certify_pieces,
    state_enclosures,
)
from nsmodel.pieces.integrator import Integrator
from nsmodel.pieces.names import describe_undecided
from nsmodel.pieces.piece import Piece
from nsmodel.proof.interval_number import Interval, point_intervals
from nsmodel.run.global_error import GlobalError, NoErrorBound, global_error


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
            raise NoErrorBound("the run starts with an impulse, of which nothing is proved")
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
