"""One and only one step where g = g_0(t, x) + beta(t, x) B l and h = B's(t, x) + d(t) + D l, with D psd.

Two solutions from one state have, with e = M x - h theta f - h gamma g_0 - c and c what the state gives,

    <dl, dy> = <B dl, ds> + <dl, D dl> <= 0,     d(e / beta) = h gamma B dl,

so that x is the same where <ds, d(e / beta)> > 0 for dx != 0. Its matrix is the mean of (s_x)'(e_x - e grad(beta)'/beta) / beta
over pairs of points between the two, and e there is h gamma beta B l at one of them and a little more. Where beta depends on time
alone it may be 0, and the same holds beyond the box for f, g_0 and s continued by constants and their linear part: then e and
s are homeomorphisms, and e o s^-1 is strongly monotone.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.modeling.laws.base import Halfspaces, Intervals, RoundSet
from nsmodel.models.first_order_system.linearisation import SystemLinearisation
from nsmodel.models.first_order_system.monotone_step import (
    MonotoneForm,
    UniquenessProof,
    is_form_definite,
    is_law_bounded,
    tidy_matrix,
    uniqueness_proof,
)
from nsmodel.proof import conic, exact, interval_bounds, polynomial
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.expression_graph import (
    CONTINUOUS_OPERATIONS,
    POLYNOMIAL_OPERATIONS,
    is_same_expression,
    operation_codes,
    rewrite_nodes,
)
from nsmodel.proof.polynomial import Monomial

MAX_PAIRED_STATES = 6  # States of a model that is looked at: the box of all of them is cut,
MAX_PAIRED_STEPS = 3  # and step sizes, for each of which it is; more are left open.
# Terms of a sum beside the sum: rounding is then some 1e-12 of the sum, far below FORM_ROOM, by which the form is above 0.
MAX_TERM_RATIO = 1e4


class PairedForm(NamedTuple):
    """The parts: beta and s (n, 1) as expressions of t and x, B (n, m) of Fractions, D as a sum of expressions times Fractions.

    ``terms`` (n, n) are the absolute values of the terms of s_x, which is rounded by a few eps of them.
    d is (m, 1) of Fractions, None where it changes with t.
    """

    beta: ca.SX
    B: np.ndarray
    s: ca.SX
    terms: ca.SX
    D: tuple[tuple[ca.SX, np.ndarray], ...]
    d: np.ndarray | None


def read_paired_form(at: SystemLinearisation) -> PairedForm | None:
    """Read g and h in this form, exactly; None where they do not have it."""
    model, n, m = at.model, len(at.model.names), at.model.law.size
    read = _read_polynomial_rows(at)
    parted = None if read is None else _split_by_multipliers(read.rows, n, m)
    if read is None or parted is None:
        return None
    linear, smooth = parted
    factored = _factor_inputs(read, linear, n)
    if factored is None:
        return None
    beta, B, D = factored
    own = [monomial for monomial in smooth if ca.depends_on(read.expression(monomial), model.x)]
    H = np.hstack([exact.zeros(m, 0), *(smooth[monomial][n:] for monomial in own)])
    weights = _feature_weights(B, H, [read.expression(monomial) for monomial in own], model.x)
    if weights is None:
        return None
    features = ca.vertcat(ca.SX(0, 1), *(read.expression(monomial) for monomial in own), model.x)
    timed = any(monomial and monomial not in own and smooth[monomial][n:].any() for monomial in smooth)
    d = None if timed else smooth.get((), exact.zeros(n + m, 1))[n:]
    near = exact.doubles(weights)
    s, terms = ca.DM(near) @ features, ca.DM(np.abs(near)) @ ca.fabs(ca.jacobian(features, model.x))
    return PairedForm(beta, B, s, terms, tuple(D), d)


class _PolynomialRows(NamedTuple):
    """The rows of (g, h), as polynomials of t, x, l and of what is no polynomial of these, and what the variables stand for."""

    rows: Sequence[polynomial.Polynomial]
    values: list[ca.SX]

    def expression(self, monomial: Monomial) -> ca.SX:
        out = ca.SX(1)
        for j, power in monomial:
            out = out * self.values[j] ** power
        return out


def _read_polynomial_rows(at: SystemLinearisation) -> _PolynomialRows | None:
    """The rows of (g, h), where what is not a polynomial is free of l."""
    atoms: list[tuple[ca.SX, ca.SX]] = []

    def atom(expression: ca.SX) -> ca.SX:
        symbols, values = ([pair[k] for pair in atoms] for k in (0, 1))
        expression = ca.substitute([expression], symbols, values)[0] if atoms else expression
        for symbol, value in atoms:
            if is_same_expression(value, expression):
                return symbol
        atoms.append((ca.SX.sym("atom"), expression))
        return atoms[-1][0]

    def rule(op: int, new: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op == ca.OP_DIV:
            return None if new[1].is_constant() else new[0] * atom(1 / new[1])
        if op in (ca.OP_POW, ca.OP_CONSTPOW) and new[1].is_constant() and float(new[1]) in range(2, 9):
            return None
        return atom(old)

    stacked = ca.densify(ca.vertcat(at.model.g, at.model.h))
    flat = rewrite_nodes(stacked, rule, tuple(operation_codes(stacked) - POLYNOMIAL_OPERATIONS), at.z, "the model")
    if any(ca.depends_on(old, at.model.lam) for _, old in atoms):
        return None
    rows = polynomial.read_polynomials(flat, ca.vertcat(at.z, *(symbol for symbol, _ in atoms)))
    known = [row for row in rows if row is not None]
    return _PolynomialRows(known, [*ca.vertsplit(at.z), *(old for _, old in atoms)]) if len(known) == len(rows) else None


def _split_by_multipliers(
    rows: Sequence[polynomial.Polynomial], n: int, m: int
) -> tuple[dict[Monomial, np.ndarray], dict[Monomial, np.ndarray]] | None:
    """By monomials in t, x: the matrices (n + m, m) of l, and the columns (n + m, 1) without; None where l enters otherwise."""
    multipliers = range(1 + n, 1 + n + m)
    linear: dict[Monomial, np.ndarray] = {}
    smooth: dict[Monomial, np.ndarray] = {}
    for i, row in enumerate(rows):
        for monomial, number in row.items():
            own = [(j, power) for j, power in monomial if j in multipliers]
            rest = tuple((j, power) for j, power in monomial if j not in multipliers)
            if sum(power for _, power in own) > 1:
                return None
            part = linear if own else smooth
            entries = part.setdefault(rest, exact.zeros(n + m, m if own else 1))
            entries[i, own[0][0] - 1 - n if own else 0] += number
    return linear, smooth


def _factor_inputs(
    read: _PolynomialRows, linear: dict[Monomial, np.ndarray], n: int
) -> tuple[ca.SX, np.ndarray, list[tuple[ca.SX, np.ndarray]]] | None:
    """beta, B and D; None where the matrix of l in g is not beta B, or 0."""
    B = next((matrix[:n] for matrix in linear.values() if matrix[:n].any()), None)
    if B is None:
        return None
    i, j = (int(k[0]) for k in np.nonzero(B))
    beta, D = ca.SX(0), []
    for monomial, matrix in linear.items():
        factor = matrix[i, j] / B[i, j]
        if (matrix[:n] != factor * B).any():
            return None
        beta += float(factor) * read.expression(monomial)
        if matrix[n:].any():
            D.append((read.expression(monomial), matrix[n:]))
    return beta, B, D


def prove_unique_paired(at: SystemLinearisation, regular: bool) -> UniquenessProof | None:
    """At most one, or exactly one step, for each length that occurs; None where neither is proved.

    ``regular``: x is a function of l, also beyond the box.
    """
    stacked = ca.vertcat(at.model.f, at.model.h, at.model.g)
    if len(at.model.names) > MAX_PAIRED_STATES or not (
        operation_codes(stacked) <= CONTINUOUS_OPERATIONS or interval_bounds.is_continuous(stacked, at.z, at.lower, at.upper)
    ):
        return None
    parts = read_paired_form(at)
    if parts is None or not _is_D_psd(at, parts):
        return None
    answers = [_prove_at_step(at, parts, float(h), regular) for h in at.steps] if len(at.steps) <= MAX_PAIRED_STEPS else [None]
    proved = [answer for answer in answers if answer is not None]
    return min(proved, key=lambda one: one.exists) if len(proved) == len(answers) else None


def _is_D_psd(at: SystemLinearisation, parts: PairedForm) -> bool:
    """Whether D is psd on the box: each of its terms is."""
    for factor, matrix in parts.D:
        low, _ = interval_bounds.enclose(factor, at.z, at.lower, at.upper)
        if ca.depends_on(factor, at.model.x) or low.item() < 0 or not exact.definiteness(matrix).psd:
            return False
    return True


def _prove_at_step(at: SystemLinearisation, parts: PairedForm, h: float, regular: bool) -> UniquenessProof | None:
    model, n, m = at.model, len(at.model.names), at.model.law.size
    lower, upper = at.lower.copy(), at.upper.copy()
    lower[0] = min(lower[0] + h, upper[0])
    low, high = (float(end.item()) for end in interval_bounds.enclose(parts.beta, at.z, lower, upper))
    timed, signed = not ca.depends_on(parts.beta, model.x), low > 0 or high < 0
    if not signed and not (timed and low >= 0):
        return None
    turn = -1.0 if high < 0 else 1.0
    g_0 = ca.substitute([model.g], [model.lam], [ca.DM.zeros(m)])[0]
    W = model.M - h * ca.jacobian(model.theta * model.f + model.gamma * g_0, model.x)
    S, bounded = turn * ca.jacobian(parts.s, model.x), is_law_bounded(at)
    if not _has_no_cancellation(at, parts, W, S, lower, upper):
        return None
    local = bool(ca.depends_on(ca.vertcat(ca.vec(W), ca.vec(S)), model.x)) or not timed
    if timed:
        for extended in (True, False):
            form = _product_form(at, W, S, lower, upper, extended=extended)
            if form is None or not is_form_definite(
                form, np.eye(n), np.zeros((n, m)), np.zeros(m), of_x=True, rounding=64 * MACHINE_EPSILON
            ):
                continue
            how = "g = beta B l and h = B's + D l with D psd, and <ds, W dx> > 0"
            exists = extended and (bounded or (signed and _is_maximal_monotone(at, parts)))
            return uniqueness_proof(
                how,
                form._replace(local=local),
                exists or (bounded and regular),
                "K is bounded" if bounded else "the law is maximal monotone in s",
            )
        return None
    if not bounded:
        return None
    q = _force_bounds(at, parts, W, h, lower, upper)
    if q is None:
        return None
    symbols = ca.SX.sym("e", n)
    E = W - symbols @ ca.gradient(ca.log(ca.fabs(parts.beta)), model.x).T
    form = _product_form(at, E, S, lower, upper, extended=False, more=(symbols, *q))
    if form is None or not is_form_definite(
        form, np.eye(n), np.zeros((n, m)), np.zeros(m), of_x=True, rounding=64 * MACHINE_EPSILON
    ):
        return None
    how = "g = beta(x) B l and h = B's + D l with D psd, and <ds, d(e / beta)> > 0 with e what the step asks of g"
    return uniqueness_proof(how, form._replace(local=True), regular, "K is bounded, and x a function of l")


def _has_no_cancellation(
    at: SystemLinearisation, parts: PairedForm, W: ca.SX, S: ca.SX, lower: np.ndarray, upper: np.ndarray
) -> bool:
    """Whether the terms of S'W are at most MAX_TERM_RATIO times their sum: far from what the room of the form leaves."""
    _, terms = interval_bounds.enclose(parts.terms, at.z, lower, upper)
    low, high = interval_bounds.enclose(ca.densify(W), at.z, lower, upper)
    ends = np.where(np.isfinite(lower) & np.isfinite(upper), [lower, upper], 0.0)
    middle = ca.Function("middle", [at.z], [S.T @ W])(ends.sum(axis=0) / 2)
    size = np.abs(np.array(middle)).max()
    if not all(np.isfinite(end).all() for end in (terms, low, high)):
        return False
    return bool((terms.T @ np.maximum(np.abs(low), np.abs(high))).max() <= MAX_TERM_RATIO * size)


def _is_maximal_monotone(at: SystemLinearisation, parts: PairedForm) -> bool:
    """Whether -B (D + N_K)^{-1}(-B's - d) is maximal monotone for every d that occurs.

    It is where D is definite, or B'x takes every value, or D is symmetric and K of boxes and bounded sets, for then it is the
    subdifferential of a piecewise linear-quadratic function of s, or one that is finite, if it is finite anywhere.
    """
    shapes = [block.shape() for block in at.model.law.blocks]
    if any(shape is None or isinstance(shape, Halfspaces) for shape in shapes):
        return False
    definite = any(exact.definiteness(matrix).definite and factor.is_constant() for factor, matrix in parts.D)
    if definite or exact.rank(parts.B) == at.model.law.size:
        return True
    symmetric = all(exact.is_symmetric(matrix) for _, matrix in parts.D)
    return symmetric and all(isinstance(shape, Intervals | RoundSet) for shape in shapes) and _is_finite_somewhere(at, parts)


def _is_finite_somewhere(at: SystemLinearisation, parts: PairedForm) -> bool:
    """Whether some s has B's + d where -y may be in the range of N_K: inside it, for each d, or for the one that there is."""
    n, lower, upper = len(at.model.names), at.lower[1 + len(at.model.names) :], at.upper[1 + len(at.model.names) :]
    rows = []
    for i in range(at.model.law.size):
        low, up = np.isfinite(lower[i]), np.isfinite(upper[i])
        if not low and not up:
            return False
        if not (low and up):
            rows.append((i, Fraction(1 if low else -1)))
    A = exact.zeros(len(rows), n + 1 + len(rows))
    for place, (i, sign) in enumerate(rows):
        A[place, :n], A[place, n + 1 + place] = sign * parts.B[:, i], Fraction(-1)
        A[place, n] = sign * parts.d[i, 0] if parts.d is not None else Fraction(0)
    positive = tuple(range(n, A.shape[1]))
    return (
        not rows
        or (parts.d is not None and not parts.d.any())
        or conic.decide_feasibility(conic.ConicSystem(A, positive)).point is not None
    )


def _product_form(
    at: SystemLinearisation,
    W: ca.SX,
    S: ca.SX,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    extended: bool,
    more: tuple[ca.SX, np.ndarray, np.ndarray] | None = None,
) -> MonotoneForm | None:
    """S(x_1)'W(x_2) on the box of both; ``extended``: their columns also between their middle and these values."""
    model, n, m = at.model, len(at.model.names), at.model.law.size
    x_1 = ca.SX.sym("x_1", n)
    S = ca.substitute([ca.densify(S)], [model.x], [x_1])[0]
    z = ca.vertcat(model.t, model.x, x_1)
    ends = [np.concatenate([end[: n + 1], end[1 : n + 1]]) for end in (lower, upper)]
    if more is not None:
        z, ends = ca.vertcat(z, more[0]), [np.concatenate(pair) for pair in zip(ends, more[1:], strict=True)]
    matrices = []
    for matrix in (S, ca.densify(W)):
        middle = ca.Function("middle", [z], [matrix])((ends[0] + ends[1]) / 2) if np.isfinite(ends).all() else None
        columns = []
        for j in range(n):
            column = matrix[:, j]
            if extended and ca.depends_on(column, ca.vertcat(model.x, x_1)):
                if middle is None or not np.isfinite(np.array(middle)).all():
                    return None
                factor = ca.SX.sym("factor")
                column = middle[:, j] + factor * (column - middle[:, j])
                z, ends = ca.vertcat(z, factor), [np.append(ends[0], 0.0), np.append(ends[1], 1.0)]
            columns.append(column)
        matrices.append(ca.horzcat(*columns))
    product = tidy_matrix(matrices[0].T @ matrices[1], z)
    uses = np.array([bool(ca.depends_on(product, symbol)) for symbol in ca.vertsplit(z)])
    ends = [np.where(uses, end, 0.0) for end in ends]
    if not np.isfinite(ends).all():
        return None
    span = (at.upper - at.lower)[1 : n + 1] / 2
    sizes = np.where(np.isfinite(span) & (span > 0), span, 1.0)
    return MonotoneForm(
        product, ca.SX.zeros(n, m), ca.SX.zeros(m, n), ca.SX.zeros(m, m), z, ends[0], ends[1], sizes, extended, True
    )


def _force_bounds(
    at: SystemLinearisation, parts: PairedForm, W: ca.SX, h: float, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Bounds (n,) of e between two solutions: h gamma beta B l at one of them, and |W| times how far they are apart."""
    model, n, inverse = at.model, len(at.model.names), exact.inverse_matrix(at.M)
    if inverse is None:
        return None
    force = h * model.gamma * parts.beta * (ca.DM(exact.doubles(parts.B)) @ model.lam)
    low, high = (end.ravel() for end in interval_bounds.enclose(force, at.z, lower, upper))
    f_low, f_high = interval_bounds.enclose(h * (model.theta * model.f + model.gamma * model.g), at.z, lower, upper)
    W_low, W_high = interval_bounds.enclose(ca.densify(W), at.z, lower, upper)
    if not all(np.isfinite(end).all() for end in (low, high, f_low, f_high, W_low, W_high)):
        return None
    distance = 1.001 * np.abs(exact.doubles(inverse)) @ (f_high - f_low).ravel()
    more = 1.001 * np.maximum(np.abs(W_low), np.abs(W_high)) @ np.minimum(distance, (upper - lower)[1 : n + 1])
    return low - more, high + more


def _feature_weights(B: np.ndarray, H: np.ndarray, features: Sequence[ca.SX], x: ca.SX) -> np.ndarray | None:
    """Weights (n, k + n) of features and of x, with B'S = H: least on the range of B, and a multiple of x beyond it."""
    columns = exact.independent_columns(B)
    R = B[:, columns]
    gram = exact.matrix_product(R.T, R)
    own = exact.matrix_product(R, exact.solve_linear_system(gram, H[columns]))
    if (exact.matrix_product(B.T, own) != H).any():
        return None
    project = exact.matrix_product(R, exact.solve_linear_system(gram, R.T))
    slopes = [own[i, k] for k, feature in enumerate(features) for i in range(len(B)) if is_same_expression(feature, x[i])]
    trace = sum(slopes, Fraction(0)) / len(columns)
    across = (exact.eye(len(B)) - project) * (trace if trace > 0 else Fraction(1))
    return np.hstack([own, across])
