"""What the range conditions rest on: matrices in Fractions, the domains of the law, a line in them."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses import domains, potential_domains
from nsmodel.classes.lure.hypotheses.domains import Domains, EmptyDomain, UndecidedDomain
from nsmodel.classes.lure.hypotheses.passivity import decide_input_output
from nsmodel.classes.lure.hypotheses.potential_domains import ConvexPotential
from nsmodel.classes.lure.hypotheses.storage import PASSIVITY_ROUNDING
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import SAMPLED
from nsmodel.proof import exact


@dataclass(frozen=True)
class RangeSetting:
    """What the findings share: matrices in Fractions, the domains, or why they are not known; e (m, 1) None where it moves."""

    model: LureSystem
    C: np.ndarray
    D: np.ndarray
    e: np.ndarray | None
    psd: bool
    rounded: bool
    kernel: int
    potential: ConvexPotential | None
    domains: Domains | None
    reason: str
    broken: bool
    line: np.ndarray | None

    @property
    def m(self) -> int:
        """Number of multipliers."""
        return len(self.D)

    @property
    def bounded(self) -> bool:
        """Whether the law's K is a product of bounded intervals and balls."""
        return self.model.law is not None and self.domains is not None and bool(self.domains.loose.all())

    @property
    def whole_space_reason(self) -> str:
        """Why int dom Upsilon* is the whole space; empty where that is not seen at once."""
        if self.broken:
            return ""
        if not self.kernel:
            return "ker(D + D') = {0} (exact), so that int dom Upsilon* is the whole space"
        if self.domains is not None and self.domains.loose.all():
            what = "K is bounded" if self.model.law is not None else "Phi is finite everywhere"
            return f"{what}, so that int dom Upsilon* is the whole space"
        return ""


def read_range_setting(model: LureSystem) -> RangeSetting:
    """Read the model."""
    C, D = (np.array(ca.DM(matrix)).reshape(matrix.shape) for matrix in (model.C, model.D))
    e = exact.rational(np.array(ca.DM(model.e))) if model.e.is_constant() else None
    S = exact.rational(D) + exact.rational(D).T
    kernel = len(S) - exact.rank(S)
    potential, own, reason, broken = None, None, "", False
    try:
        if model.law is not None:
            own = domains.domains_of_law(model.law, D)
        else:
            broken = True
            potential = potential_domains.read_potential(model.phi, model.phi_split, model.y)
            broken = False
            own = potential_domains.domains_of_potential(potential, len(D), bool(D.any()))
    except EmptyDomain as empty:
        reason, broken = f"{'K' if model.law is not None else 'the domain of phi'}: {empty}", True
    except UndecidedDomain as undecided:
        reason = str(undecided)
    line = None if own is None or own.loose.all() or not kernel else linearity_direction(own, exact.rational(D))
    psd = exact.definiteness(D).psd
    rounded = decide_input_output(D).verdict == SAMPLED or (psd and _floating_rank(D) < len(S) - kernel)
    return RangeSetting(
        model, exact.rational(C), exact.rational(D), e, psd or rounded, rounded, kernel, potential, own, reason, broken, line
    )


def _floating_rank(D: np.ndarray) -> int:
    """Rank of D + D', D psd, scaled to a unit diagonal, where eigenvalues of the size of rounding count as 0."""
    root = np.sqrt(np.diagonal(D)[np.diagonal(D) > 0])
    S = (D + D.T)[np.ix_(np.diagonal(D) > 0, np.diagonal(D) > 0)] / 2 / root[:, None] / root
    return int((np.linalg.eigvalsh(S) > len(D) * PASSIVITY_ROUNDING).sum()) if len(S) else 0


def linearity_direction(own: Domains, D: np.ndarray) -> np.ndarray | None:
    """A direction v so that Upsilon is linear along v and -v; None where there is none."""
    rows = np.vstack([own.stack_matrices(own.across), D + D.T, exact.matrix_product(own.stack_matrices(own.flat), D)])
    lines = exact.nullspace(rows)
    return exact.doubles(lines[:, 0]) if lines.shape[1] else None
