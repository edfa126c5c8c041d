"""Matrices of a step, decided exactly: P-matrices, and up to which step M - s G stays regular."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from nsmodel._utils import EPS
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import Halfspaces, Intervals
from nsmodel.proof import exact, polynomial
from nsmodel.proof.verdict import not_none

# Relative changes of the entries of M and G that are no more than rounding: the numbers of a model come from some operations.
MATRIX_ROUNDING = 64 * EPS
ROUNDING_LABEL = "change by rounding, 1 where singular"
# Rows up to which all principal minors are looked at: 2^12 take 0.6 s; of more only dominant diagonals are seen.
MAX_P_MATRIX_ROWS = 12
# States up to which the roots of det(M - s G) are counted exactly: its coefficients are long, 12 take 0.05 s.
MAX_ROOT_STATES = 12


class PrincipalMinor(NamedTuple):
    """The least principal minor found, in units in which the diagonal is 1 where it is not 0, and its rows."""

    value: float
    rows: list[int]


def decide_p_matrix(W: np.ndarray) -> tuple[bool | None, PrincipalMinor]:
    """Whether all principal minors of W (rational) are > 0; None where W is too large for that.

    Each minor is a product of pivots; one that is <= 0 ends the search (Tsatsomeros and Li's recursion on Schur complements).
    """
    diagonal = [W[i, i] for i in range(len(W))]
    if any(entry <= 0 for entry in diagonal):
        i = int(np.argmin(exact.doubles(np.array(diagonal, dtype=object))))
        return False, PrincipalMinor(float(diagonal[i]), [i])
    scaled = W / np.array(diagonal, dtype=object)[:, None]
    if len(W) > MAX_P_MATRIX_ROWS:
        dominant = all(2 > sum(abs(entry) for entry in row) for row in scaled)
        return (True if dominant else None), PrincipalMinor(np.nan, [])
    rows, least = _nonpositive_minor(scaled, list(range(len(W))))
    return rows is None, PrincipalMinor(float(least), rows or [])


def _nonpositive_minor(W: np.ndarray, rows: list[int]) -> tuple[list[int] | None, Fraction]:
    """Rows of a principal minor <= 0, or None; and that minor, else the least one."""
    least: Fraction | None = None
    stack = [(W, rows, [], Fraction(1))]
    while stack:
        part, left, chosen, minor = stack.pop()
        if not left:
            continue
        pivot = part[0, 0]
        value = minor * pivot
        least = value if least is None else min(least, value)
        if pivot <= 0:
            return [*chosen, left[0]], value
        rest = part[1:, 1:]
        stack.append((rest, left[1:], chosen, minor))
        schur = rest - np.outer(part[1:, 0] / pivot, part[0, 1:])
        stack.append((schur, left[1:], [*chosen, left[0]], value))
    return None, Fraction(1) if least is None else least


def is_coherently_oriented(law: Law, W: np.ndarray) -> bool:
    """Whether l -> -(W l + N_K(l)) is one to one and onto, for K of boxes and polyhedra (Robinson 1992); W rational.

    It is where det Z'W Z > 0 for every face of K with directions Z. All sets of active rows are tried, also those of no face.
    """
    parts, place, count = [], 0, 1
    for block in law.blocks:
        size, shape = block.size, block.shape()
        if isinstance(shape, Intervals):
            units = [(exact.eye(size)[:, [i]], exact.zeros(size, 0)) for i in range(size)]
            parts += [[_embed_rows(Z, place, len(W)) for Z in pair] for pair in units]
        elif isinstance(shape, Halfspaces):
            active = [list(rows) for k in range(len(shape.K) + 1) for rows in combinations(range(len(shape.K)), k)]
            own = [exact.nullspace(shape.H[rows]) if rows else exact.eye(size) for rows in active]
            parts.append([_embed_rows(Z, place, len(W)) for Z in own])
        else:
            return False
        place, count = place + size, count * len(parts[-1]) if isinstance(shape, Halfspaces) else count * 2**size
        if count > 2**MAX_P_MATRIX_ROWS:
            return False
    return all(
        exact.determinant(exact.matrix_product(Z.T, W, Z)) > 0 for choice in product(*parts) if (Z := np.hstack(choice)).shape[1]
    )


def _embed_rows(Z: np.ndarray, place: int, m: int) -> np.ndarray:
    """Directions of some rows as those of all m."""
    out = exact.zeros(m, Z.shape[1])
    out[place : place + len(Z)] = Z
    return out


class MlcpOfStep(NamedTuple):
    """W_mlcp(s) = D + s C (M - s G)^-1 B as a function of the step s, in Fractions; ``C`` is gamma times that of the model."""

    M: np.ndarray
    G: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    def mlcp(self, s: Fraction) -> np.ndarray:
        """W_mlcp at one step, where M - s G is regular."""
        return self.D + s * exact.matrix_product(self.C, exact.solve_linear_system(self.M - s * self.G, self.B))

    def restricted(self, left: np.ndarray, right: np.ndarray) -> MlcpOfStep:
        """Those of left' W_mlcp right."""
        product = exact.matrix_product
        return MlcpOfStep(
            self.M, self.G, product(self.B, right), product(left.T, self.C), product(left.T, product(self.D, right))
        )

    def kind_for_all(self, low: Fraction, high: Fraction) -> str:
        """What W_mlcp is for all low <= s <= high; '' where that is not proved, or M - s G singular at one.

        A matrix that is definite, or whose principal minors are > 0, at one step is so at all, where no determinant vanishes
        between; one whose kernel stays is looked at beside it.
        """
        if not is_regular_between(self.M, -self.G, low, high):
            return ""
        at_end = self.mlcp(high)
        definite = exact.definiteness(at_end)
        if definite.psd:
            kernel = exact.nullspace(at_end + at_end.T)
            if kernel.shape[1] and not self._is_kernel_for_all(kernel):
                return ""
            basis = np.hstack([kernel, exact.eye(len(self.D))])
            rest = basis[:, [k for k in exact.independent_columns(basis) if k >= kernel.shape[1]]]
            regular = self.restricted(rest, rest)._is_symmetric_part_regular(low, high)
            return ("positive definite" if definite.definite else "positive semidefinite") if regular else ""
        if len(self.D) > MAX_P_MATRIX_ROWS // 2 or not decide_p_matrix(at_end)[0]:
            return ""
        units = exact.eye(len(self.D))
        sets = [list(rows) for k in range(1, len(self.D) + 1) for rows in combinations(range(len(self.D)), k)]
        minors = (self.restricted(units[:, rows], units[:, rows]) for rows in sets)
        return "a P-matrix" if all(part._is_regular(low, high) for part in minors) else ""

    def _is_kernel_for_all(self, kernel: np.ndarray) -> bool:
        """Whether (W_mlcp + W_mlcp') v = 0 at all steps: det(M - s G) times that is a polynomial, of degree n."""
        n = len(self.M)
        steps = (Fraction(k) for k in range(1, 3 * n + 2))  # of which M - s G is singular at n at most
        regular = [s for s in steps if exact.determinant(self.M - s * self.G)][: n + 1]
        sums = ((S := self.mlcp(s)) + S.T for s in regular)
        return not any(exact.matrix_product(S, kernel).any() for S in sums)

    def _is_regular(self, low: Fraction, high: Fraction) -> bool:
        """Whether det W_mlcp vanishes at no step between: it is det [M - s G, B; -s C, D] / det(M - s G)."""
        constant = np.vstack([np.hstack([self.M, self.B]), np.hstack([0 * self.C, self.D])])
        slope = np.vstack([np.hstack([-self.G, 0 * self.B]), np.hstack([-self.C, 0 * self.D])])
        return is_regular_between(constant, slope, low, high)

    def _is_symmetric_part_regular(self, low: Fraction, high: Fraction) -> bool:
        """Whether det(W_mlcp + W_mlcp') vanishes at no step between, likewise."""
        none = 0 * self.M
        constant = np.vstack(
            [
                np.hstack([self.M, none, self.B]), np.hstack([none, self.M.T, 0 * self.C.T]),
                np.hstack([0 * self.C, -self.B.T, self.D + self.D.T]),
            ]
        )  # fmt: skip
        slope = np.vstack(
            [
                np.hstack([-self.G, none, 0 * self.B]), np.hstack([none, -self.G.T, self.C.T]),
                np.hstack([-self.C, 0 * self.B.T, 0 * self.D]),
            ]
        )  # fmt: skip
        return is_regular_between(constant, slope, low, high)


def is_regular_between(constant: np.ndarray, slope: np.ndarray, low: Fraction, high: Fraction) -> bool:
    """Whether constant + s slope (n, n; Fractions) is regular for all low <= s <= high: whether its determinant has no root."""
    nodes = [Fraction(k) for k in range(len(constant) + 1)]
    values = exact.rational([[exact.determinant(constant + s * slope)] for s in nodes])
    powers = exact.rational([[s**k for k in range(len(nodes))] for s in nodes])
    coefficients = list(not_none(exact.solve_linear_system(powers, values)).ravel())
    return any(coefficients) and not polynomial.real_roots(coefficients, low, high)


class RegularSteps(NamedTuple):
    """``regular``: whether M - s G is regular for 0 < s <= h (None: not decided exactly); ``least``: h*, in floating point."""

    regular: bool | None
    least: float
    vector: np.ndarray | None
    bound: float


def regular_steps(M: np.ndarray, G: np.ndarray, h: float) -> RegularSteps:
    """Decide M - s G for 0 < s <= h, M and G rational.

    h* = 1 / (largest real eigenvalue > 0 of M^{-1} G) is where it first becomes singular. ``bound`` = 1 / |M^{-1} G| is a lower
    bound of h*, 0 where M is singular.
    """
    X = exact.solve_regular_system(M, G)
    if X is None:
        least, vector = _singular_step(exact.doubles(M), exact.doubles(G))
        return RegularSteps(None, least, vector, 0.0)
    least, vector = least_singular_step(exact.doubles(X))
    norms = [max((sum(abs(entry) for entry in row if entry) for row in part), default=Fraction(0)) for part in (X, X.T)]
    bound = float(1 / min(norms)) if min(norms) else np.inf
    if Fraction(h) * min(norms) < 1:
        return RegularSteps(True, least, vector, bound)
    if len(X) > MAX_ROOT_STATES:
        return RegularSteps(None, least, vector, bound)
    return RegularSteps(not polynomial.real_roots(_determinant_coefficients(X), Fraction(0), Fraction(h)), least, vector, bound)


def change_by_rounding(M: np.ndarray, G: np.ndarray, h: float) -> float:
    """The largest spectral radius of |W^-1| 64 eps (|M| + s |G|), W = M - s G, for s = h and at the s < h where W is worst.

    W + E with |E| <= 64 eps (|M| + s |G|), entry by entry, is W (I + W^-1 E), regular where this is below 1. Between 0 and h,
    det(M - s G) = 0 is nearest at the real parts of 1/mu, mu the eigenvalues of M^-1 G.
    """
    from scipy.linalg import eigvals

    if not len(M):
        return 0.0
    with np.errstate(all="ignore"):
        near = 1 / np.asarray(eigvals(exact.doubles(G), exact.doubles(M)))
        steps = [h, *(float(s.real) for s in near if np.isfinite(s) and 0 < s.real < h)]
    return max(change_at_step(M, G, s) for s in steps)


def change_at_step(M: np.ndarray, G: np.ndarray, s: float) -> float:
    """The spectral radius at one s."""
    M, G = exact.doubles(M), exact.doubles(G)
    try:
        inverse = np.linalg.inv(M - s * G)
    except np.linalg.LinAlgError:
        return np.inf
    size = np.abs(inverse) @ (np.abs(M) + abs(s) * np.abs(G))
    return MATRIX_ROUNDING * float(np.abs(np.linalg.eigvals(size)).max()) if np.isfinite(size).all() else np.inf


def least_singular_step(X: np.ndarray) -> tuple[float, np.ndarray | None]:
    """The least s > 0 with det(I - s X) = 0 and a null vector, in floating point; (inf, None) where there is none."""
    return _singular_step(np.eye(len(X)), X)


def _singular_step(M: np.ndarray, G: np.ndarray) -> tuple[float, np.ndarray | None]:
    """The least s > 0 with det(M - s G) = 0 and a null vector, in floating point; (inf, None) where there is none."""
    from scipy.linalg import eig

    if not len(M):
        return np.inf, None
    values, vectors = eig(G, M)[:2]
    real = np.isfinite(values) & (np.abs(np.imag(values)) <= 1e-9 * np.abs(values)) & (np.real(values) > 0)
    if not real.any():
        return np.inf, None
    k = int(np.argmax(np.where(real, np.real(values), -np.inf)))
    return float(1 / np.real(values[k])), np.real(vectors[:, k])  # pyrefly: ignore[bad-index]


def _determinant_coefficients(X: np.ndarray) -> list[Fraction]:
    """Coefficients c_0 = 1, c_1, ... of det(I - s X), by Faddeev and LeVerrier."""
    n, coefficients, power = len(X), [Fraction(1)], exact.eye(len(X))
    for k in range(1, n + 1):
        power = exact.matrix_product(X, power)
        coefficients.append(-sum((power[i, i] for i in range(n)), Fraction(0)) / k)
        for i in range(n):
            power[i, i] += coefficients[-1]
    return coefficients
