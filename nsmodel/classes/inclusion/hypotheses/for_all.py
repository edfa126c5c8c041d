"""Hypotheses of an inclusion for all values of parameters in a box.

Monotone operators and bounds |G(x)| <= a_1 + a_2 |x|, <x, G(x)> <= -alpha |x|^2 + beta, <G(x) - G(y), x - y> <= L |x - y|^2 pass
to convex combinations: where F and S are affine in functions of the parameters, they are decided at corners, on a set that holds
C for all values. Else the Jacobian is bounded over states and parameters together.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses import autonomous as inclusion
from nsmodel.classes.inclusion.hypotheses.autonomous import HYPOTHESES, M_A3, autonomous_consequences, check_autonomous
from nsmodel.classes.inclusion.hypotheses.continuity import field_continuity
from nsmodel.classes.inclusion.hypotheses.growth import linear_growth
from nsmodel.classes.inclusion.hypotheses.one_sided import one_sided_lipschitz
from nsmodel.classes.inclusion.hypotheses.over_parameters import (
    EIGENVALUE_LABEL,
    InclusionCheckContext,
    SwitchingBounds,
    prove_over_parameters,
    switching_part,
)
from nsmodel.classes.inclusion.hypotheses.selected_field import constraint_set, decompose_field
from nsmodel.classes.inclusion.hypotheses.tangent import dissipativity
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints, velocity_selection
from nsmodel.errors import NsmodelError
from nsmodel.hypotheses.domain import potential_without_domain
from nsmodel.hypotheses.findings import UNKNOWN, VIOLATED, Consequence, Finding, make_finding
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import IntervalBox, Scope
from nsmodel.hypotheses.uniform import (
    ParameterValues,
    box_middle,
    combine_proofs,
    depends_on_symbol,
    findings_for_box,
    parameter_roots,
    sample_values,
    unaffected_findings,
)
from nsmodel.modeling.convex_split import split_convex
from nsmodel.proof import interval_bounds
from nsmodel.proof.convex.sets import MovingSet, has_interior_for_all, is_convex_for_all, outer_set
from nsmodel.proof.parameter_hull import mixture_corners
from nsmodel.proof.verdict import HypothesisPart

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
    """A value at the middle or an end of the box at which (A3) fails."""
    for at in sample_values(region.parameters)[: 1 + 2 ** len(region.parameters)]:
        bound = model.bind(at)
        C = constraint_set(bound)
        field = decompose_field(bound, C)
        part = dissipativity(field, linear_growth(field, C.part(region.lower, region.upper), quick=True), quick=True)
        if part.verdict == VIOLATED:
            how = f"at {', '.join(f'{name} = {value:.6g}' for name, value in at.items())}: {part.how}"
            where = Scope(parameters={name: (value, value) for name, value in at.items()})
            return make_finding(M_A3, VIOLATED, how, part.value, {**at, **part.witness}, where)
    return make_finding(M_A3, UNKNOWN, "not proved for all values, and no value was found at which it fails")


def _decide_parts(grounds: InclusionCheckContext) -> dict[str, HypothesisPart]:
    """(5), (A1)-(A3), (24), where proved."""
    parts = {id: part for id, part in _decide_at_corners(grounds).items() if part is not None}
    return parts if len(parts) == len(HYPOTHESES) - 1 else {**prove_over_parameters(grounds, _switching_bounds(grounds)), **parts}


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
