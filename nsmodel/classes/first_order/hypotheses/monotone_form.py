"""The quadratic form in the difference of two solutions of a step, and whether it is definite on a box."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation
from nsmodel.classes.lure.hypotheses.jacobian_hull import simplify_factors
from nsmodel.proof import interval_bounds

MAX_FORM_BOXES, MAX_PART_BOXES = 2000, 300  # in which the form is bounded, on the whole box and on a part of it
FORM_ROOM = 1e-9  # of the form's size, that its least eigenvalue is above 0 by: far more than constants in it are rounded by


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
