"""The quadratic form in the difference of two solutions of a step, and whether it is definite on a box.

L, N and Theta of the quadratic form, suggested by a semidefinite program.

One and only one step where W and W_mlcp vary: a quadratic form that is definite all over the region.

Two solutions of a step from one state differ by dx, dl with W dx = h gamma B dl and dy = C dx + D dl, the matrices being means
of the Jacobians between the two, and <dl, Theta dy> <= 0 for Theta = diag(theta_i) > 0, constant on each block of the law. So for
any constant matrices L and N

    <dl, Theta (C dx + D dl)> + <L dx + N dl, W dx - h gamma B dl> <= 0.

This form is linear in the Jacobians: where it is positive definite at all points of the region it is so for their means, and
there is at most one solution in the region. L, N and Theta are suggested by a semidefinite program, the form bounded on boxes.

That there is one: take constants off the varying Jacobians, continue what is left of f, g and h beyond the box by its values at
the boundary, and put the linear part back: the varying entries become c + s_j (J - c), s_j in [0, 1]. Where the form is definite
for all of these too, x is a function of l by a strongly monotone equation, Theta y is a strongly monotone function of l, and the
step has exactly one solution, which is that of the given functions as long as it stays in the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.models.first_order_system.linearisation import SystemLinearisation, constant_matrix_values
from nsmodel.models.lure_system.hypomonotone import simplify_factors
from nsmodel.models.lure_system.passivity import decide_storage
from nsmodel.proof import conic, exact, extremum, interval_bounds
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.expression_graph import CONTINUOUS_OPERATIONS, operation_codes
from nsmodel.proof.storage_matrix import well_conditioned_block

MAX_FORM_BOXES = 2000  # Boxes in which the form is bounded, on the whole box
MAX_PART_BOXES = 300  # and on a part of it, of which there are MAX_REGION_PARTS; more leave it open.
FORM_ROOM = 1e-9  # Of the form's size, that its least eigenvalue is above 0 by: far more than constants in it are rounded by.


class MonotoneForm(NamedTuple):
    """The Jacobians as expressions of z and of the factors s (their varying columns times s_j), and the box of both."""

    W: ca.SX
    B: ca.SX
    C: ca.SX
    D: ca.SX
    z: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
    extended: bool
    local: bool


def is_law_bounded(at: SystemLinearisation) -> bool:
    """Whether K is seen to be bounded."""
    n = len(at.model.names)
    return not at.boxed and bool(np.isfinite([at.lower[1 + n :], at.upper[1 + n :]]).all())


def monotone_form_on_box(at: SystemLinearisation, h: float, *, extended: bool) -> MonotoneForm | None:
    """The Jacobians, ``extended`` beyond the box where they vary; None where they are not bounded.

    An entry D_kk of a box whose values are not bounded above is replaced by its infimum, which makes the form smaller.
    """
    n, m = len(at.model.names), at.model.law.size
    J = {name: tidy_matrix(getattr(at.jacobians, name), at.z) for name in "ACDKB"}
    for rows in rows_of_blocks(at):
        for k in rows if len(rows) == 1 else ():
            low, high = (float(end.item()) for end in interval_bounds.enclose(J["D"][k, k], at.z, at.lower, at.upper))
            if np.isfinite(low) and not np.isfinite(high):
                J["D"][k, k] = low
    uses = [any(ca.depends_on(matrix, symbol) for matrix in J.values() if matrix.numel()) for symbol in ca.vertsplit(at.z)]
    lower, upper = (np.where(uses, end, 0.0) for end in (at.lower, at.upper))
    if not np.isfinite([lower, upper]).all():
        return None
    factors, local = ca.SX(0, 1), any(uses[1:])
    for names, first, columns in (("ACK", 1, n), ("BD", 1 + n, m)) if extended else ():
        for j in range(columns):
            varying = [(k, i) for k in names for i in range(J[k].shape[0]) if ca.depends_on(J[k][i, j], at.z[1:])]
            if varying and (names == "ACK" or at.names[first + j] in at.boxed):
                factors = ca.vertcat(factors, ca.SX.sym(f"s_{names}{j}"))
                for k, i in varying:
                    middle = float(ca.Function("middle", [at.z], [J[k][i, j]])((lower + upper) / 2))
                    middle = middle if np.isfinite(middle) else 0.0
                    J[k][i, j] = middle + (J[k][i, j] - middle) * factors[-1]
    if extended and not factors.numel() and local and any(uses[1 + n :]) and at.boxed:
        return None
    G = at.model.theta * J["A"] + at.model.gamma * J["K"]
    extra = factors.numel()
    span = (at.upper - at.lower)[1:] / 2
    return MonotoneForm(
        at.model.M - h * G, h * at.model.gamma * J["B"], J["C"], J["D"], ca.vertcat(at.z, factors),
        np.concatenate([lower, np.zeros(extra)]), np.concatenate([upper, np.ones(extra)]),
        np.where(np.isfinite(span) & (span > 0), span, 1.0), extended, local,
    )  # fmt: skip


def tidy_matrix(matrix: ca.SX, z: ca.SX) -> ca.SX:
    """Dense, its entries with fewer repeated factors."""
    dense = ca.densify(ca.SX(matrix))
    return ca.reshape(
        ca.vertcat(ca.SX(0, 1), *(simplify_factors(entry, z) for entry in ca.vertsplit(ca.vec(dense)))), *dense.shape
    )


def is_form_definite(
    form: MonotoneForm,
    L: np.ndarray,
    N: np.ndarray,
    theta: np.ndarray,
    *,
    of_x: bool = False,
    rounding: float = 0.0,
    most: int = MAX_FORM_BOXES,
) -> bool:
    """Whether the form (of_x: its part dx'L'W dx) is definite on the box, beyond rounding; in units of the box.

    It is linear in the Jacobians, whose interval bounds on parts of the box give a middle and a radius of the form.
    """
    stacked = ca.densify(ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in form[:4])))
    whole = np.where([ca.depends_on(stacked, symbol) for symbol in ca.vertsplit(form.z)], form.upper - form.lower, 0.0)
    boxes, count = (form.lower[None], form.upper[None]), 0
    while len(boxes[0]):
        count += len(boxes[0])
        if count > most:
            return False
        low, high = (end.reshape(len(boxes[0]), -1) for end in interval_bounds.enclose(stacked, form.z, *boxes))
        if not np.isfinite([low, high]).all():
            return False
        size = _form_matrices(form, np.maximum(abs(low), abs(high)), abs(L), abs(N), abs(theta), 1.0, of_x)
        radius = _form_matrices(form, (high - low) / 2, abs(L), abs(N), abs(theta), 1.0, of_x)
        room = (FORM_ROOM + rounding) * np.linalg.norm(size, axis=(1, 2))
        least = np.linalg.eigvalsh(_form_matrices(form, (low + high) / 2, L, N, theta, -1.0, of_x))[:, 0] - room
        bad = least <= np.minimum(np.linalg.norm(radius, axis=(1, 2)), radius.sum(axis=2).max(axis=1))
        if (bad & (least < 0) & (len(boxes[0]) > 64)).any() or (bad.any() and not whole.any()):
            return False
        boxes = _bisect_boxes(boxes[0][bad], boxes[1][bad], whole)
    return True


def _form_matrices(
    form: MonotoneForm, entries: np.ndarray, L: np.ndarray, N: np.ndarray, theta: np.ndarray, minus: float, of_x: bool
) -> np.ndarray:
    """The symmetric matrices of the form where its Jacobians have these entries, one row a box; ``minus`` stands for -1."""
    pieces = form[:4]
    ends = np.cumsum([0, *(piece.numel() for piece in pieces)])
    W, B, C, D = (
        entries[:, a:b].reshape(len(entries), piece.shape[1], piece.shape[0]).transpose(0, 2, 1)
        for a, b, piece in zip(ends, ends[1:], pieces, strict=False)
    )
    Q, scale = L.T @ W, form.scale[: form.W.shape[0]] if of_x else form.scale
    if not of_x:
        bottom = np.concatenate([theta[:, None] * C + N.T @ W, theta[:, None] * D + minus * (N.T @ B)], axis=2)
        Q = np.concatenate([np.concatenate([Q, minus * (L.T @ B)], axis=2), bottom], axis=1)
    Q = Q * scale[:, None] * scale
    return (Q + Q.transpose(0, 2, 1)) / 2


def _bisect_boxes(lower: np.ndarray, upper: np.ndarray, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes, one a row, cut in two where they are longest in parts of the ``whole``."""
    j = np.argmax((upper - lower) / np.where(whole > 0, whole, np.inf), axis=1)
    row = np.arange(len(lower))
    left, right = upper.copy(), lower.copy()
    left[row, j] = right[row, j] = (lower[row, j] + upper[row, j]) / 2
    return np.vstack([lower, right]), np.vstack([left, upper])


def rows_of_blocks(at: SystemLinearisation) -> list[list[int]]:
    """Rows that share a theta: each row of a box, the rows of another block."""
    out: list[list[int]] = []
    for place, block in at.model.law.parts():
        rows = list(range(place.start, place.stop))
        out += [[i] for i in rows] if block.separable else [rows]
    return out


PROGRAM_POINTS = 24  # Points at which the program asks for a definite form, a block each; what it suggests is proved on boxes.


class _SampledForm(NamedTuple):
    """W, B, C, D at some points, in units of the box; the sizes of the rows of W, B, and of those of C, D that share a theta."""

    points: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    rows: np.ndarray
    blocks: list[list[int]]
    block_size: np.ndarray


def suggest_multipliers(at: SystemLinearisation, form: MonotoneForm) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """L, N and Theta with the form as definite as can be at some points, in units of the box; None where it is not."""
    n, m = form.W.shape[0], form.D.shape[0]
    x, l = form.scale[:n], form.scale[n:]
    seen = _sample_form(at, form)
    if seen is None:
        return None
    answer = _maximise_definiteness(seen, n, m)
    if answer is None:
        return None
    both = answer[: n * (n + m)].reshape(n, n + m) / seen.rows[:, None]
    theta = np.zeros(m)
    for own, weight, unit in zip(seen.blocks, answer[n * (n + m) :], seen.block_size, strict=True):
        theta[own] = weight / unit
    return both[:, :n] / x, both[:, n:] / l, theta


def _sample_form(at: SystemLinearisation, form: MonotoneForm) -> _SampledForm | None:
    """What multiplies the unknowns at corners of the box and at points inside; None where it is not finite."""
    n, m = form.W.shape[0], form.D.shape[0]
    rng = np.random.default_rng(0)
    corners = np.where(rng.random((PROGRAM_POINTS, len(form.lower))) < 0.5, form.lower, form.upper)
    corners[: PROGRAM_POINTS // 3] = rng.uniform(form.lower, form.upper, (PROGRAM_POINTS // 3, len(form.lower)))
    corners[-1, len(at.lower) :] = 1.0
    values = ca.Function("values", [form.z], [ca.densify(part) for part in form[:4]])
    x, l = form.scale[:n], form.scale[n:]
    points = []
    for point in corners:
        W, B, C, D = (
            np.array(part).reshape(shape) for part, shape in zip(values(point), ((n, n), (n, m), (m, n), (m, m)), strict=True)
        )
        if not all(np.isfinite(part).all() for part in (W, B, C, D)):
            return None
        points.append((W * x, B * l, l[:, None] * C * x, l[:, None] * D * l))
    rows = np.max([np.abs(np.hstack([W, B])).max(axis=1) for W, B, _, _ in points], axis=0)
    outs = np.max([np.abs(np.hstack([C, D])).max(axis=1) for _, _, C, D in points], axis=0) if m else np.zeros(0)
    rows, outs = np.where(rows > 0, rows, 1.0), np.where(outs > 0, outs, 1.0)
    blocks = rows_of_blocks(at)
    return _SampledForm(points, rows, blocks, np.array([max(outs[own]) for own in blocks]) if m else np.zeros(0))


def _maximise_definiteness(seen: _SampledForm, n: int, m: int) -> np.ndarray | None:
    """Maximise the least eigenvalue of the forms at all points over the entries of L and N, row by row, and Theta by blocks.

    |unknowns| <= 1e3, Theta >= 1e-3, and the eigenvalue is at most 1.
    """
    unknowns = n * n + n * m + len(seen.blocks)
    data, right, cones = [], [], []
    for point in seen.points:
        columns = _unknown_columns(seen, *point)
        data.append(np.column_stack([*(-column for column in columns), _stack_triangle(np.eye(n + m))]))
        right.append(np.zeros(len(columns[0])))
        cones.append(conic.semidefinite_cone(n + m))
    for sign in (1.0, -1.0):
        data.append(np.hstack([sign * np.eye(unknowns), np.zeros((unknowns, 1))]))
        bound = np.full(unknowns, 1e3)
        if sign < 0:
            bound[n * n + n * m :] = -1e-3
        right.append(bound)
        cones.append(conic.nonnegative_cone(unknowns))
    cost = np.zeros(unknowns + 1)
    cost[-1] = -1.0
    data.append(np.append(np.zeros(unknowns), 1.0)[None, :])
    right.append(np.array([1.0]))
    cones.append(conic.nonnegative_cone(1))
    solution = conic.solve_conic_program(cost, np.vstack(data), np.concatenate(right), cones)
    answer = np.array(solution.x)
    return answer[:-1] if str(solution.status) in ("Solved", "AlmostSolved") and answer[-1] > 1e-7 else None


def _unknown_columns(seen: _SampledForm, W: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> list[np.ndarray]:
    """The form at a point as the sum of these, times the unknowns."""
    n, size, columns = len(W), len(W) + len(D), []
    for i in range(n):  # L[i, j]: dx_j * (row i of W dx - B dl)
        row = np.concatenate([W[i], -B[i]]) / seen.rows[i]
        for j in range(size):
            Q = np.zeros((size, size))
            Q[j] = row
            columns.append(_stack_triangle((Q + Q.T) / 2))
    for own, unit in zip(seen.blocks, seen.block_size, strict=True):
        Q = np.zeros((size, size))
        Q[[n + i for i in own]] = np.hstack([C, D])[own] / unit
        columns.append(_stack_triangle((Q + Q.T) / 2))
    return columns


def _stack_triangle(S: np.ndarray) -> np.ndarray:
    """Upper triangle by columns, off-diagonal entries times sqrt 2."""
    j, i = np.tril_indices(len(S))
    return np.where(i == j, S[i, j], np.sqrt(2) * S[i, j])


MAX_REGION_PARTS = 10  # Parts of the box that are looked at, each with a semidefinite program; more are left open.
MAX_FORM_UNKNOWNS = 9  # States and multipliers together; of more a form is not looked for: boxes are cut in all of them.


class UniquenessProof(NamedTuple):
    """What is proved: at most one solution in the region (``exists`` False), or exactly one; ``local``: not for all states."""

    how: str
    exists: bool
    local: bool


def prove_unique_on_region(at: SystemLinearisation, regular: bool) -> UniquenessProof | None:
    """At most one, or exactly one step, for each length that occurs; None where neither is proved.

    ``regular``: W is constant and regular, or |W_0^{-1} W - I| < 1 on the region: x is a function of l, also beyond the box.
    """
    stacked = ca.vertcat(at.model.f, at.model.h, at.model.g)
    if at.model.law.size + len(at.model.names) > MAX_FORM_UNKNOWNS or len(at.steps) > 3:
        return None
    if not (
        operation_codes(stacked) <= CONTINUOUS_OPERATIONS or interval_bounds.is_continuous(stacked, at.z, at.lower, at.upper)
    ):
        return None
    found: list[UniquenessProof] = []
    for h in map(float, at.steps):
        forms = [form for extended in (True, False) if (form := monotone_form_on_box(at, h, extended=extended)) is not None]
        one = _prove_by_pairing(at, forms) or _prove_by_form(at, forms)
        if (one is None or not one.exists) and is_law_bounded(at):
            one = _prove_in_parts(at, h, regular) if one is None else _add_existence(one, regular)
        if one is None:
            return None
        found.append(one)
    return min(found, key=lambda one: one.exists)


# -- L = P with P B = C', N = 0 -------------------------------------------------------------------------------------------


def _prove_by_pairing(at: SystemLinearisation, forms: Sequence[MonotoneForm]) -> UniquenessProof | None:
    """P B = C' for constant B and C, D psd: the form is dx'P W dx + dl'D dl, where dl need not vanish.

    x is a function of l; one step exists where K is bounded, by Brouwer's theorem, and where C has independent rows: then
    x -> -C'(D + N_K)^{-1}(-C x - c) is maximal monotone, and strongly monotone together with P W.
    """
    J = at.jacobians
    if not at.model.law.size or ca.symvar(J.B) or ca.symvar(J.C):
        return None
    B, C = constant_matrix_values(J.B), constant_matrix_values(J.C)
    passivity = decide_storage(B, C)
    if passivity.pairing is None or passivity.finding.verdict != "holds":
        return None
    P = passivity.pairing.storage_matrix(well_conditioned_block(passivity.pairing))
    near = exact.doubles(P)
    constant = not ca.symvar(J.D)
    exists = is_law_bounded(at) or (constant and exact.rank(C) == len(C))
    for form in forms:
        if constant:
            psd = exact.definiteness(constant_matrix_values(J.D)).psd
        else:
            psd = extremum.largest_eigenvalue(-form.D, form.z, form.lower, form.upper, bound_to=0.0).bound <= 0
        if psd and is_form_definite(
            form, near, np.zeros((len(near), len(C))), np.zeros(len(C)), of_x=True, rounding=4 * MACHINE_EPSILON
        ):
            how = "dx'P W dx > 0 with the P of P B = C', and D is psd"
            why = "K is bounded" if is_law_bounded(at) else "C has independent rows"
            return uniqueness_proof(how, form, exists and form.extended, why)
    return None


def uniqueness_proof(how: str, form: MonotoneForm, exists: bool, why: str) -> UniquenessProof:
    """The answer, with why one exists where it does."""
    beyond = "f, g and h as continued beyond the box have a step for every state" if form.local else "one exists"
    return UniquenessProof(f"{how}; {why}: {beyond}" if exists else how, exists, form.local)


# -- suggested L, N and Theta --------------------------------------------------------------------------------------------


def _prove_by_form(at: SystemLinearisation, forms: Sequence[MonotoneForm], most: int = MAX_FORM_BOXES) -> UniquenessProof | None:
    """The form with multipliers that are suggested at some points."""
    for form in forms:
        chosen = suggest_multipliers(at, form)
        if chosen is None:
            continue
        L, N, theta = chosen
        if is_form_definite(form, L, N, theta, most=most):
            how = "a quadratic form in the difference of two solutions is definite"
            if form.extended:
                return uniqueness_proof(how, form, True, "the same beyond the box")
            return uniqueness_proof(how, form, False, "")
    return None


def _add_existence(one: UniquenessProof, regular: bool) -> UniquenessProof:
    """With a bounded K, and x a function of l, a step of what continues f, g and h exists."""
    how = f"{one.how}; K is bounded, and x a function of l: f, g and h as continued beyond the box have a step for every state"
    return UniquenessProof(how, True, one.local) if regular else one


def _prove_in_parts(at: SystemLinearisation, h: float, regular: bool) -> UniquenessProof | None:
    """The form with multipliers for each part of the box: two solutions of a step are not far from each other.

    M dx = h (theta df + gamma dg) with f and g in their ranges over the box and K: dx is at most ``reach``, so that any two
    solutions lie in one part widened by it.
    """
    n, inverse = len(at.model.names), exact.inverse_matrix(at.M)
    if inverse is None or not np.isfinite([at.lower, at.upper]).all():
        return None
    ranges = []
    for weight, expression in ((at.model.theta, at.model.f), (at.model.gamma, at.model.g)):
        low, high = interval_bounds.enclose(expression, at.z, at.lower, at.upper)
        ranges.append(weight * (high - low).ravel())
    reach = 1.001 * h * np.abs(exact.doubles(inverse)) @ sum(ranges)
    uses = [any(ca.depends_on(J, symbol) for J in at.jacobians if J.numel()) for symbol in ca.vertsplit(at.z[1 : n + 1])]
    if not np.isfinite(reach).all() or not any(uses):
        return None
    whole = at.upper - at.lower
    parts, count = [(at.lower, at.upper)], 0
    while parts:
        lower, upper = parts.pop()
        count += 1
        if count > MAX_REGION_PARTS:
            return None
        low, high = lower.copy(), upper.copy()
        low[1 : n + 1] = np.maximum(lower[1 : n + 1] - reach, at.lower[1 : n + 1])
        high[1 : n + 1] = np.minimum(upper[1 : n + 1] + reach, at.upper[1 : n + 1])
        form = monotone_form_on_box(replace(at, lower=low, upper=high), h, extended=False)
        if form is not None and count > 1 and _prove_by_form(at, [form], MAX_PART_BOXES) is not None:
            continue
        width = np.where(uses, (upper - lower)[1 : n + 1] / whole[1 : n + 1], 0.0)
        j = 1 + int(width.argmax())
        if upper[j] - lower[j] < 2 * reach[j - 1]:
            return None
        middle = (lower[j] + upper[j]) / 2
        for ends in ((lower[j], middle), (middle, upper[j])):
            part = lower.copy(), upper.copy()
            part[0][j], part[1][j] = ends
            parts.append(part)
    how = f"in each of {(count + 1) // 2} parts of the box, which overlap by more than two solutions can be apart, "
    how += "a quadratic form in their difference is definite"
    return _add_existence(UniquenessProof(how, False, True), regular)
