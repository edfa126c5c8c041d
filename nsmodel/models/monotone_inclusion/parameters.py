"""Hypotheses of an inclusion for all values of parameters in a box.

Monotone operators and bounds |G(x)| <= a_1 + a_2 |x|, <x, G(x)> <= -alpha |x|^2 + beta, <G(x) - G(y), x - y> <= L |x - y|^2 pass
to convex combinations: where F and S are affine in functions of the parameters, they are decided at corners, on a set that holds
C for all values. Else the Jacobian is bounded over states and parameters together.

(5), (A1)-(A3), (24) from bounds of Jacobians over states and parameters together: F - S = G(x, p) - B(p) Sgn(u(x)).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from itertools import chain
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import NsmodelError
from nsmodel.hypotheses.exact_roots import models_at_roots
from nsmodel.hypotheses.findings import UNKNOWN, VIOLATED, Consequence, Finding, IntervalBox, Scope, make_finding
from nsmodel.hypotheses.region import (
    ParameterValues,
    Region,
    box_middle,
    combine_proofs,
    depends_on_symbol,
    findings_for_box,
    parameter_roots,
    potential_without_domain,
    sample_values,
    unaffected_findings,
)
from nsmodel.modeling.convex_split import split_convex
from nsmodel.models.monotone_inclusion import autonomous as inclusion
from nsmodel.models.monotone_inclusion.autonomous import (
    HYPOTHESES,
    M_24,
    M_A1,
    M_A2,
    M_A3,
    M_T,
    autonomous_consequences,
    check_autonomous,
)
from nsmodel.models.monotone_inclusion.field import constraint_set, decompose_field
from nsmodel.models.monotone_inclusion.growth import linear_growth
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.models.monotone_inclusion.one_sided_lipschitz import field_continuity, one_sided_lipschitz
from nsmodel.models.monotone_inclusion.schemes import set_constraints, velocity_selection
from nsmodel.models.monotone_inclusion.tangent import dissipativity
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.convex import rules
from nsmodel.proof.convex.sets import ConvexSet, MovingSet, has_interior_for_all, is_convex_for_all, outer_set
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.jumps import jump_nodes
from nsmodel.proof.parameter_hull import mixture_corners
from nsmodel.proof.verdict import HOLDS, HypothesisPart

EIGENVALUE_LABEL, JACOBIAN_BOUNDS_TEXT = "least eigenvalue of sym S'", "bounds over states and parameters together"


class InclusionCheckContext(NamedTuple):
    """What all decisions rest on: C(p), a set that holds them all, the part of it that is looked at.

    Each C(p) has a point no farther than ``reach`` from 0.
    """

    model: MonotoneInclusion
    moving: MovingSet
    C: ConvexSet
    box: tuple[np.ndarray, np.ndarray]
    reach: float
    quick: bool


class SwitchingBounds(NamedTuple):
    """What is known of B(p) Sgn(u(x)): whether it is monotone for all p, and a bound of its size."""

    monotone: bool
    size: float


def switching_part(model: MonotoneInclusion) -> ca.SX | None:
    """B(p) times the symbols of the signs, where S is affine in these with factors of p alone."""
    symbols = model.sign_symbols
    B = ca.jacobian(model.operator, symbols)
    return None if ca.depends_on(B, ca.vertcat(model.x, symbols)) or jump_nodes(model.operator, symbols) else B @ symbols


class _JacobianDomain(NamedTuple):
    """F = (F - S) + S, S the gradient of phi where there is one, over the states of a box and all parameters."""

    grounds: InclusionCheckContext
    phi: ca.SX | None
    S: ca.SX
    states: tuple[np.ndarray, np.ndarray]

    @property
    def box(self) -> tuple[ca.SX, np.ndarray, np.ndarray]:
        """(x, p) and its bounds."""
        (low, high), moving = self.states, self.grounds.moving
        return ca.vertcat(self.grounds.C.x, self.grounds.model.p), np.append(low, moving.lower), np.append(high, moving.upper)


def prove_over_parameters(grounds: InclusionCheckContext, switching: SwitchingBounds) -> dict[str, HypothesisPart]:
    """What is proved, first on a box that holds C for all p, then on the box looked at."""
    model, C, found = grounds.model, grounds.C, dict[str, HypothesisPart]()
    phi = None if model.phi is None else potential_without_domain(model.phi, model.x, "phi")
    S = ca.gradient(phi, C.x) if phi is not None else ca.substitute(model.operator, model.sign_symbols, 0 * model.sign_symbols)
    for states, local in ((C.bounding_box, False), (grounds.box, True)):
        for id, how, value in _proved_parts(_JacobianDomain(grounds, phi, S, states), switching, "M-T" in found, local):
            found.setdefault(id, HypothesisPart(HOLDS, f"{how}: {JACOBIAN_BOUNDS_TEXT}", value, {}, local))
    return found


def _proved_parts(
    on: _JacobianDomain, switching: SwitchingBounds, monotone: bool, local: bool
) -> Iterator[tuple[str, str, dict[str, float]]]:
    """(id, how, values) of what is proved there; ``monotone``: S is known to be."""
    model, C, phi, S, quick = on.grounds.model, on.grounds.C, on.phi, on.S, on.grounds.quick
    z, low, high = on.box
    if interval_bounds.is_continuous(model.field, z, low, high):
        yield "M-A1", "no operation of F jumps or has a pole", {"kinks": 0}
    if phi is not None and rules.curvatures(phi, z, low, high, of=C.x)[0].convex:
        monotone = True
        yield "M-T", "T = dphi, phi convex by the rules of convex functions", {EIGENVALUE_LABEL: 0.0}
    if not interval_bounds.is_continuous(ca.vertcat(model.field, S), z, low, high):
        return
    J, slope = ca.jacobian(model.field - S, C.x), ca.jacobian(S, C.x)
    if switching.monotone and not monotone:
        top = extremum.largest_eigenvalue(-(slope + slope.T) / 2, z, low, high, bound_to=0.0, quick=quick).bound
        if top <= 0:
            yield "M-T", "the symmetric Jacobian of S is psd", {EIGENVALUE_LABEL: max(-top, 0.0)}
    L = extremum.largest_eigenvalue((J + J.T) / 2, z, low, high, quick=quick).bound
    if switching.monotone and np.isfinite(L):
        yield "M-24", "eigenvalues of the symmetric Jacobian", {"L": L + 0.0}
    if not local:
        yield from _proved_growth(on, J, L, switching.size)


def _proved_growth(on: _JacobianDomain, J: ca.SX, L: float, jump: float) -> Iterator[tuple[str, str, dict[str, float]]]:
    """(A2) and (A3), where J = (F - S)', L bounds the eigenvalues of sym J, ``jump`` the size of what jumps."""
    model, C, reach, moving = on.grounds.model, on.grounds.C, on.grounds.reach, on.grounds.moving
    z, low, high = on.box
    steep = extremum.spectral_norm(J, z, low, high, quick=True).bound
    base = np.clip(np.zeros(C.n), *on.states)
    ends = np.append(base, moving.lower), np.append(base, moving.upper)
    at = np.max(np.abs(interval_bounds.enclose(model.field - on.S, z, *ends)), axis=0)
    M = float(np.linalg.norm(at)) * ROUND_UP_FACTOR + jump
    if not np.isfinite(M + L):
        return
    a = {"a_1": M + steep * _vector_norm(base), "a_2": steep} if np.isfinite(steep) else None
    if a is not None:
        yield "M-A2", "|F - S| <= |F - S|(c) + |(F - S)'| |x - c|", a
    elif reach:
        return
    # <x, w> <= <x, v> + reach |v|, |v| <= a_1 + a_2 |x|
    p, q = (M + reach * a["a_2"], reach * a["a_1"]) if a is not None and reach else (M, 0.0)
    if L < 0 and not base.any():
        beta = (p**2 / (-2 * L) + q) * ROUND_UP_FACTOR
        yield "M-A3", "<x, F - S> <= L |x|^2 + |F - S|(0) |x|, L < 0", {"alpha": -L / 2, "beta": beta}
    elif C.bounded and a is not None:
        R = _vector_norm(np.maximum(*np.abs(on.states)))
        beta = ((R + reach) * (a["a_1"] + a["a_2"] * R) + R**2) * ROUND_UP_FACTOR
        yield "M-A3", f"C is bounded (|x| <= {R:.4g}): any alpha will do, here 1", {"alpha": 1.0, "beta": beta}


def _vector_norm(v: np.ndarray) -> float:
    return float(np.linalg.norm(v)) * ROUND_UP_FACTOR


SET_FIELDS = ("lower", "upper", "constraints")
OPERATOR_FIELDS = ("operator", "sign_arguments", "phi", "potential_split", *SET_FIELDS)
ALL_FIELDS = ("field", *OPERATOR_FIELDS)
FIELDS_OF_INCLUSION = {
    "M-T": OPERATOR_FIELDS, "M-C": SET_FIELDS, "M-A1": ("field", *SET_FIELDS), "M-A2": ALL_FIELDS, "M-A3": ALL_FIELDS,
    "M-24": ALL_FIELDS,
}  # fmt: skip


def special_values(model: MonotoneInclusion, box: IntervalBox) -> list[ParameterValues]:
    """Values of a single parameter at which the width of C in some state vanishes."""
    return parameter_roots(ca.vertsplit(model.upper - model.lower), model, box)


def uniform_findings(model: MonotoneInclusion, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = unaffected_findings(check_autonomous, model, region, quick, FIELDS_OF_INCLUSION)
    moving = MovingSet(model.x, model.p, set_constraints(model)[0], *region.parameter_bounds())
    C = outer_set(moving)
    start, box = np.array(ca.DM(model.bind(box_middle(region.parameters)).x0)).ravel(), C.part(region.lower, region.upper)
    convex, interior = is_convex_for_all(moving, *box, quick=quick), has_interior_for_all(moving, start)
    if interior is None:
        return findings_for_box([], same, region)
    reach = interior.reach if interior.reach and not _contains_zero(moving) else 0.0
    parts = _decide_parts(InclusionCheckContext(model, moving, C, box, reach, quick))
    if convex is not None:
        parts["M-C"] = interior.part._replace(how=f"{convex.how}; {interior.part.how}", local=convex.local)
    own = [
        make_finding(which, part.verdict, part.how, part.value or {"constraints": 0}, part.witness, region.scope(part.local))
        for which in HYPOTHESES
        if (part := parts.get(which.id)) is not None
    ]
    return findings_for_box(own if "M-A3" in parts else [*own, _nondissipative_value(model, region)], same, region)


def _contains_zero(C: MovingSet) -> bool:
    """Whether 0 lies in C(p) for all p."""
    zero = np.zeros(C.x.numel())
    low, _ = interval_bounds.enclose(C.rows, ca.vertcat(C.x, C.p), np.append(zero, C.lower), np.append(zero, C.upper))
    return float(np.min(low)) >= 0


def uniform_consequences(model: MonotoneInclusion, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    low, high = region.parameter_bounds()
    ends = interval_bounds.enclose(model.x0, model.p, low, high)
    return autonomous_consequences(model, own, np.max(np.abs(ends), axis=0).ravel(), ())


def _nondissipative_value(model: MonotoneInclusion, region: Region) -> Finding:
    """A value at the middle or an end of the box at which (A3) fails, or at a root of what the model is made of."""
    ends = ((at, "", model.bind(at)) for at in sample_values(region.parameters)[: 1 + 2 ** len(region.parameters)])
    roots = ((at, f"exactly where {text}: ", exact) for at, text, exact in models_at_roots(model, region.parameters))
    for at, exactly, bound in chain(ends, roots):
        C = constraint_set(bound)
        field = decompose_field(bound, C)
        part = dissipativity(field, linear_growth(field, C.part(region.lower, region.upper), quick=True), quick=True)
        if part.verdict == VIOLATED:
            how = f"at {', '.join(f'{name} = {value:.6g}' for name, value in at.items())}: {exactly}{part.how}"
            where = Scope(parameters={name: (value, value) for name, value in at.items()})
            return make_finding(M_A3, VIOLATED, how, part.value, {**at, **part.witness}, where)
    return make_finding(M_A3, UNKNOWN, "not proved for all values, and no value was found at which it fails")


def _decide_parts(grounds: InclusionCheckContext) -> dict[str, HypothesisPart]:
    """(5), (A1)-(A3), (24), where proved."""
    parts = {id: part for id, part in _decide_at_corners(grounds).items() if part is not None}
    every = {which.id for which in (M_T, M_A1, M_A2, M_A3, M_24)} <= parts.keys()
    return parts if every else {**prove_over_parameters(grounds, _switching_bounds(grounds)), **parts}


def _switching_bounds(grounds: InclusionCheckContext) -> SwitchingBounds:
    """What the signs of S are proved to be, and the kinks of phi (nothing is said of these)."""
    if not velocity_selection(grounds.model).l.numel():
        return SwitchingBounds(monotone=True, size=0.0)
    signs = None if grounds.model.phi is not None else switching_part(grounds.model)
    models = [] if signs is None else _corner_models(grounds, ca.vertcat(ca.SX.zeros(grounds.C.n), signs))
    T = combine_proofs((inclusion.operator_monotonicity(one, grounds.C, grounds.box, grounds.quick) for one in models), {})
    a = combine_proofs(
        (linear_growth(decompose_field(one, grounds.C), grounds.box, quick=grounds.quick) for one in models),
        {"a_1": max, "a_2": max},
    )
    size = a.value["a_1"] if a is not None and not a.value["a_2"] else np.inf
    return SwitchingBounds(monotone=T is not None and not T.local, size=size)


# -- corners -----------------------------------------------------------------------------------------------------------


def _decide_at_corners(grounds: InclusionCheckContext) -> dict[str, HypothesisPart | None]:
    """(5), (A1)-(A3), (24), of convex combinations."""
    n, model, quick = grounds.C.n, grounds.model, grounds.quick
    rows = model.operator if model.phi is None else potential_without_domain(model.phi, model.x, "phi")
    whole = _corner_models(grounds, ca.vertcat(model.field, rows))
    operators = whole or _corner_models(grounds, ca.vertcat(ca.SX.zeros(n), rows))
    fields = whole or _corner_models(grounds, ca.vertcat(model.field, ca.SX.zeros(rows.numel())))
    T = combine_proofs(
        (inclusion.operator_monotonicity(one, grounds.C, grounds.box, quick) for one in operators),
        {EIGENVALUE_LABEL: min, "terms": max},
    )
    F = combine_proofs((field_continuity(one, grounds.C, grounds.box) for one in fields), {"kinks": max})
    made = [decompose_field(one, grounds.C) for one in whole]
    growth = [linear_growth(field, grounds.box, quick=quick) for field in made]
    reach = grounds.reach if grounds.moving.moving else 0.0
    drawn = (dissipativity(field, a, quick=quick, reach=reach) for field, a in zip(made, growth, strict=True))
    alone = [one.field if T is not None and not T.local else None for one in whole]
    slopes = (one_sided_lipschitz(field, grounds.box, quick=quick, alone=own) for field, own in zip(made, alone, strict=True))
    return {
        "M-T": T, "M-A1": F, "M-A2": combine_proofs(growth, {"a_1": max, "a_2": max}),
        "M-A3": combine_proofs(drawn, {"alpha": min, "beta": max}), "M-24": combine_proofs(slopes, {"L": max}),
    }  # fmt: skip


def _corner_models(grounds: InclusionCheckContext, rows: ca.SX) -> list[MonotoneInclusion]:
    """Models without parameters of whose F and S (or phi), stacked in ``rows``, those of all values are convex combinations."""
    model, n = grounds.model, grounds.C.n
    at = mixture_corners(rows, model.p, grounds.moving.lower, grounds.moving.upper)
    if at is None or depends_on_symbol(model.sign_arguments, model.p):
        return []
    made = []
    for one in at:
        own = copy(model)
        own._set(field=one[:n], x0=ca.SX.zeros(n))
        if model.phi is None:
            own._set(operator=one[n:])
        else:
            try:
                own._set(phi=one[n:], potential_split=split_convex(one[n:], model.x, "phi"))
            except NsmodelError:
                return []
        made.append(own)
    return made
