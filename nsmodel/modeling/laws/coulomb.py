"""Coulomb friction of one contact: l = (P_N, P_T) in K_mu = {|P_T| <= mu P_N}, with unilateral contact, one law.

    0 <= y_N ⟂ P_N >= 0,    |P_T| <= mu P_N,    P_T = -mu P_N y_T/|y_T| where y_T != 0

is -ŷ(y) ∈ N_K(l) with ŷ(y) = (y_N + mu |y_T|, y_T) (de Saxcé and Feng, Mathematical and Computer Modelling 28, 1998). As a map of
y it is no normal cone and not monotone: nothing that rests on either holds of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.laws.base import (
    STATE_NOTHING,
    STATE_UPPER,
    STATE_ZERO,
    CurvedSet,
    LatexNumberWriter,
    Law,
    LawEnds,
    LawFactor,
    RewrittenLaw,
    StateNames,
    interval_length,
    product_set,
    read_entries,
    safe_norm,
)

SLIP_ROWS = (1, 2)  # Of a contact in the plane, and in space.
MIN_DRAG = 1e-12  # |y_T|/|P_T| in slip, beside the largest entry of W: the least, slower slip being rounding,
DRAG_DECADES = 30  # and how many factors of ten it is looked for above.
MAX_CANCELLATION = 1e12  # Terms of W l beside b from which on W seems singular: four digits of 16 are left.
# Of that interval, until its ends are neighbours: 56 are enough for a decade; where it begins at 0, 100 leave 2^-100 of it.
DRAG_BISECTIONS = 100


@dataclass(frozen=True)
class CoulombSet(CurvedSet):
    """K_mu with its number, and ŷ; where it is not ``shifts``, the associated law -y ∈ N_K(l), a convex problem of psd W."""

    mu: float
    shifts: bool = True
    radius: float = np.inf  # pyrefly: ignore[bad-override]
    kind: ClassVar[str] = "coulomb"
    is_cone: ClassVar[bool] = True

    @property
    def plural(self) -> str:
        """What messages call several of them."""
        return "contacts with friction"

    @property
    def is_normal_cone(self) -> bool:
        """Whether it is the associated law."""
        return not self.shifts

    def shifted(self, y: np.ndarray) -> np.ndarray:
        """(y_N + mu |y_T|, y_T)."""
        return np.concatenate(([y[0] + self.mu * safe_norm(y[1:])], y[1:])) if self.shifts else y

    def shift_jacobian(self, y: np.ndarray) -> np.ndarray:
        """The identity, with mu y_T/|y_T| beside the entry of y_N; 0 where y_T = 0."""
        J, size = np.eye(y.size), safe_norm(y[1:])
        if size > 0 and self.shifts:
            J[0, 1:] = self.mu * (y[1:] / size)
        return J

    def project(self, u: np.ndarray) -> np.ndarray:
        """u inside, 0 in the polar cone, else k (1, mu e), k = (u_N + mu |u_T|)/(1 + mu^2), e = u_T/|u_T|."""
        head, size = u[0], safe_norm(u[1:])
        if self._contains(head, size):
            return u
        if self.mu * size <= -head:
            return np.zeros_like(u)
        k = self._nearest_normal(head, size)
        return np.concatenate(([k], u[1:] * (self.mu * k / size if size > 0 else 0.0)))

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Of the three branches of P_K."""
        mu, head, size = self.mu, u[0], safe_norm(u[1:])
        if self._contains(head, size):
            return np.eye(u.size)
        J = np.zeros((u.size, u.size))
        if mu * size <= -head:
            return J
        if size == 0:  # mu = 0: the half line
            J[0, 0] = 1.0
            return J
        e, k = u[1:] / size, self._nearest_normal(head, size)
        ray = np.concatenate(([1.0], mu * e)) / math.hypot(1, mu)
        J[1:, 1:] = mu * k / size * (np.eye(e.size) - np.outer(e, e))
        return J + np.outer(ray, ray)

    def code(self, u: np.ndarray) -> int:
        """Stick, open or slip; contact without friction is slip."""
        head, size = u[0], safe_norm(u[1:])
        if self._contains(head, size):
            return 0
        return -1 if self.mu * size <= -head else 1

    def _contains(self, head: float, size: float) -> bool:
        """Whether the cone has an interior, and u with u_N = head, |u_T| = size is in it; without friction it is a half line."""
        return self.mu > 0 and 0 <= head and size <= self.mu * head

    def _nearest_normal(self, head: float, size: float) -> float:
        """(u_N + mu |u_T|)/(1 + mu^2), for any mu."""
        mu = self.mu
        return (head + mu * size) / (1 + mu * mu) if mu <= 1 else (head / mu + size) / (1 / mu + mu)

    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """Scale P_T, so that P_N stays."""
        size = safe_norm(l[1:])
        return np.concatenate(([l[0]], l[1:] * (self.mu * l[0] / size if size > 0 else 0.0)))

    def boundary_ray(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(1, -mu y_T/|y_T|), or along P_T where that is 0: slip keeps l on it, and y_N = 0."""
        size, own = safe_norm(y[1:]), safe_norm(l[1:])
        e = -y[1:] / size if size > 0 else l[1:] / own if own > 0 else np.zeros(l.size - 1)
        return np.concatenate(([1.0], self.mu * e))

    def block_solution(self, W: np.ndarray, b: np.ndarray) -> np.ndarray | None:
        """Open, stick or slip, tried in this order; W (m, m) of this contact alone, 0 where none of them is possible."""
        if not self.shifts:
            return None
        if b[0] >= 0:
            return np.zeros_like(b)
        stuck = _solve_regular(W, -b)
        if stuck is not None and stuck[0] >= 0 and safe_norm(stuck[1:]) <= self.mu * stuck[0]:
            return stuck
        if W[0, 0] <= 0:
            return np.zeros_like(b)
        return _slip_in_plane(W, b, self.mu) if b.size == 2 else _slip_in_space(W, b, self.mu)

    def support_point(self, y: np.ndarray) -> np.ndarray:
        """0: nothing pushes where the contact opens."""
        return np.zeros_like(y)

    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """<l, ŷ>; l in K and ŷ in its dual, which is y_N >= 0."""
        slip = ca.sqrt(ca.sumsqr(y[1:]) + tiny)
        return ca.dot(l, y) + self.mu * l[0] * slip, [l[0], self.mu * self.mu * l[0] ** 2 - ca.sumsqr(l[1:]), y[0]]

    def quadric(self, m: int) -> tuple[np.ndarray, float]:
        """mu^2 P_N^2 - |P_T|^2."""
        return np.diag(np.r_[-(self.mu * self.mu), np.ones(m - 1)]), 0.0


def _solve_regular(W: np.ndarray, rhs: np.ndarray) -> np.ndarray | None:
    """W^-1 rhs; None where W seems singular."""
    try:
        found = np.linalg.solve(W, rhs)
    except np.linalg.LinAlgError:
        return None
    terms = np.abs(W) @ np.abs(found)
    return found if (terms <= MAX_CANCELLATION * np.abs(rhs).max()).all() else None


def _slip_in_plane(W: np.ndarray, b: np.ndarray, mu: float) -> np.ndarray:
    """P_T = -mu P_N e with e = +-1 the sign of y_T: the one whose y_T has that sign, else the one that pushes."""
    found = np.zeros(2)
    for e in (1.0, -1.0) if b[1] >= 0 else (-1.0, 1.0):
        across = W[0, 0] - e * mu * W[0, 1]
        if across <= 0:
            continue
        l = -b[0] / across * np.array([1.0, -mu * e])
        if e * (W[1] @ l + b[1]) >= 0:
            return l
        found = l if not found.any() else found
    return found


def _slip_in_space(W: np.ndarray, b: np.ndarray, mu: float) -> np.ndarray:
    """P(a) = -(W + diag(0, a, a))^-1 b with |P_T(a)| = mu P_N(a), a > 0, by bisection: y_T = -a P_T there."""
    S = (W[1:, 1:] - np.outer(W[1:, 0], W[0, 1:]) / W[0, 0]).tolist()
    c = (b[1:] - W[1:, 0] * (b[0] / W[0, 0])).tolist()
    (s11, s12), (s21, s22) = S
    w1, w2, w0, b0 = float(W[0, 1]), float(W[0, 2]), float(W[0, 0]), float(b[0])

    def at(a: float) -> tuple[float, float, float]:
        d11, d22 = s11 + a, s22 + a
        det = d11 * d22 - s12 * s21
        if det == 0:
            return np.inf, np.inf, np.inf
        p1, p2 = (s12 * c[1] - d22 * c[0]) / det, (s21 * c[0] - d11 * c[1]) / det
        return -(b0 + w1 * p1 + w2 * p2) / w0, p1, p2

    def is_outside(a: float) -> bool:
        n, p1, p2 = at(a)
        return not math.hypot(p1, p2) <= mu * n

    low, high = 0.0, MIN_DRAG * float(np.abs(W).max())
    for _ in range(DRAG_DECADES):
        if not is_outside(high):
            break
        low, high = high, 10 * high
    else:
        return np.array([-b0 / w0, 0.0, 0.0]) if mu == 0 else np.zeros(3)
    for _ in range(DRAG_BISECTIONS):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        low, high = (middle, high) if is_outside(middle) else (low, middle)
    return np.array(at(high))


@dataclass(frozen=True, eq=False)
class Coulomb(LawFactor):
    """A contact with friction: ``mu`` >= 0, a number or an expression of parameters, t and inputs; 1 or 2 slip rows."""

    kind: ClassVar[str] = "coulomb"
    is_normal_cone: ClassVar[bool] = False
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {
        "Coulomb friction": {
            -1: (STATE_NOTHING, "open (l = 0)"), 0: (STATE_ZERO, "stick (y = 0)"), 1: (STATE_UPPER, "slip (l on the cone)"),
        }
    }  # fmt: skip
    mu: ca.SX

    __repr__ = short_repr

    @property
    def numbers(self) -> dict[str, ca.SX]:
        """The coefficient of friction."""
        return {"mu": self.mu}

    def scaled(self, u: float) -> Coulomb:
        """A cone stays what it is."""
        return self

    def invalidity_reason(self, given: str) -> str:
        """A negative or infinite coefficient."""
        if not self.mu.is_constant():
            return ""
        mu = float(self.mu)
        return "" if 0 <= mu < np.inf else f"Coulomb friction has mu = {mu:g}{given}; expected a finite number >= 0"

    def curved(self) -> CoulombSet:
        """With its number."""
        return CoulombSet(float(self.mu))

    def rewritten(self, y: ca.SX, names: tuple[str, ...], moving: ca.SX, *, guarded: bool = True) -> RewrittenLaw | None:
        """A mu that moves by l = (P_N, mu P'_T), y' = (y_N, mu y_T) and the coefficient 1: ŷ'_N = y_N + |mu y_T|."""
        if not ca.depends_on(self.mu, moving):
            return None
        l, ends = ca.SX.sym("l", self.size), LawEnds(names[0], ca.SX(0), self.mu)
        mu = interval_length(ends.lower, ends.upper, guarded=guarded)
        by = ca.vertcat(1, ca.repmat(mu, self.size - 1, 1))
        return RewrittenLaw(Law((replace(self, mu=ca.SX(1)),)), l, by * l, names, by * y, (ends,), by)

    def c_numbers(self) -> ca.SX:
        """The coefficient."""
        return self.mu

    def shape(self) -> None:
        """None: what is proved of normal cones is not proved of it."""
        return None

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """The half space P_N >= 0."""
        return np.r_[0.0, np.full(self.size - 1, -np.inf)], np.full(self.size, np.inf)

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond the cone."""
        return excess_at_rows(l, float(self.mu))

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Points for <l' - l, ŷ> >= 0: 0, twice l, and l + (1, -mu e) with e the direction of y_T."""
        return rivals_at_rows(l, y, float(self.mu))

    def shifted(self, y: np.ndarray) -> np.ndarray:
        """(y_N + mu |y_T|, y_T)."""
        return shifted_at_rows(y, float(self.mu))

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """|lambda_T| <= mu lambda_N."""
        across = r"\left\Vert \lambda_{\mathrm{T}} \right\Vert"
        return [product_set(write, self.size, rf"{across} \leq {write.number(self.mu)} \, \lambda_{{\mathrm{{N}}}}")]

    def latex_relation(self) -> str:
        """De Saxcé's form."""
        shifted = r"\left(y_{\mathrm{N}} + \mu \left\Vert y_{\mathrm{T}} \right\Vert, y_{\mathrm{T}}\right)"
        return rf"-{shifted} \in \mathcal{{N}}_K(\lambda)"

    def data(self) -> dict[str, Any]:
        """The coefficient."""
        return {"mu": float(self.mu)}


def excess_at_rows(l: np.ndarray, mu: Any) -> np.ndarray:
    """How far rows l (N, m) are outside the cone of mu, one number or (N, 1): (N, 1) >= 0."""
    return np.maximum(np.linalg.norm(l[:, 1:], axis=1, keepdims=True) - mu * np.maximum(l[:, :1], 0), np.maximum(-l[:, :1], 0))


def rivals_at_rows(l: np.ndarray, y: np.ndarray, mu: Any) -> np.ndarray:
    """Points (3, N, m) of the cone: one has <l' - l, y> < 0 where l does not solve <l' - l, y> >= 0."""
    across = np.linalg.norm(y[:, 1:], axis=1, keepdims=True)
    edge = np.hstack([np.ones((len(y), 1)), -mu * y[:, 1:] / np.where(across > 0, across, 1)])
    size = np.abs(l).max(axis=1, keepdims=True)
    return np.stack([np.zeros_like(l), 2 * l, l + edge * np.where(size > 0, size, 1)])


def shifted_at_rows(y: np.ndarray, mu: Any) -> np.ndarray:
    """ŷ of rows y (N, m)."""
    return np.hstack([y[:, :1] + mu * np.linalg.norm(y[:, 1:], axis=1, keepdims=True), y[:, 1:]])


@checks_keywords
def coulomb(mu: Any, slip: int = 1) -> Law:
    """Unilateral contact with Coulomb friction: l = (P_N, P_T), y = (y_N, y_T), 1 + ``slip`` rows each.

    0 <= y_N ⟂ P_N >= 0, |P_T| <= mu P_N, and P_T = -mu P_N y_T/|y_T| where y_T != 0; -ŷ ∈ N_K(l) with K = {|l_T| <= mu l_N} and
    ŷ = (y_N + mu |y_T|, y_T) (de Saxcé and Feng 1998). l is in the user's unit. For several contacts: `product`.

    Args:
        mu: the coefficient of friction of this contact, >= 0: a number or an expression of parameters, t and inputs.
        slip: 1 in the plane, 2 in space.

    Raises:
        ModelError: mu that is negative, not finite or a list; ``slip`` other than 1 and 2.
    """
    if isinstance(slip, bool) or not isinstance(slip, int | np.integer) or slip not in SLIP_ROWS:
        raise ModelError(f"coulomb: slip = {slip!r}; a contact has 1 row of slip in the plane and 2 in space")
    found = read_entries("coulomb", "mu", mu)
    if found.numel() != 1:
        raise ModelError(f"coulomb: mu has {found.numel()} values; expected one, and a law for each contact: product(...)")
    if found.is_constant() and not 0 <= float(found) < np.inf:
        raise ModelError(f"coulomb: mu = {float(found):g} must be finite and not negative")
    return Law((Coulomb("Coulomb friction", 1 + int(slip), found),))
