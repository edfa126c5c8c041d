"""One and only one step where W and W_mlcp vary: a quadratic form that is definite all over the region.

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

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation, constant_matrix_values
from nsmodel.classes.first_order.hypotheses.monotone_form import (
    MAX_FORM_BOXES,
    MAX_PART_BOXES,
    MonotoneForm,
    is_form_definite,
    is_law_bounded,
    monotone_form_on_box,
)
from nsmodel.classes.first_order.hypotheses.monotone_multipliers import suggest_multipliers
from nsmodel.classes.lure.hypotheses.pairing import well_conditioned_block
from nsmodel.classes.lure.hypotheses.passivity import decide_storage
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.expression_graph import operation_codes

MAX_REGION_PARTS = 10  # of the box that are looked at
MAX_FORM_UNKNOWNS = 9  # states and multipliers
EVERYWHERE_CONTINUOUS = {
    ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_PARAMETER, ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_NEG, ca.OP_SQ,
    ca.OP_TWICE, ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX, ca.OP_SIN, ca.OP_COS, ca.OP_ATAN, ca.OP_TANH, ca.OP_SINH, ca.OP_COSH,
    ca.OP_ASINH, ca.OP_EXP, ca.OP_EXPM1, ca.OP_ERF,
}  # Operations that are continuous everywhere.  # fmt: skip


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
        operation_codes(stacked) <= EVERYWHERE_CONTINUOUS or interval_bounds.is_continuous(stacked, at.z, at.lower, at.upper)
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
