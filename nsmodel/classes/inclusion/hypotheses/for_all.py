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
from nsmodel.classes.inclusion.hypotheses.autonomous import A3, HYPOTHESES, check, consequences_of
from nsmodel.classes.inclusion.hypotheses.continuity import continuous
from nsmodel.classes.inclusion.hypotheses.growth import linear_growth
from nsmodel.classes.inclusion.hypotheses.one_sided import one_sided
from nsmodel.classes.inclusion.hypotheses.over_parameters import LEAST, Grounds, Switching, over_parameters, switching_part
from nsmodel.classes.inclusion.hypotheses.selected_field import field_of, set_of
from nsmodel.classes.inclusion.hypotheses.tangent import dissipativity
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import constraints, selection
from nsmodel.errors import NsmodelError
from nsmodel.hypotheses.domain import without_domain
from nsmodel.hypotheses.findings import UNKNOWN, VIOLATED, Consequence, Finding, found
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import Box, Scope
from nsmodel.hypotheses.uniform import Values, agreed, for_the_box, middle_of, reads, roots, untouched, values_in
from nsmodel.model.convex import split
from nsmodel.proof import interval
from nsmodel.proof.convex.moving_sets import MovingSet, has_interior_for_all, is_convex_for_all, outer
from nsmodel.proof.mixtures import mixture
from nsmodel.proof.verdict import Part

ADMISSIBLE = ("lower", "upper", "constraints")
OF_T = ("operator", "sign_arguments", "phi", "potential_split", *ADMISSIBLE)
ALL = ("field", *OF_T)
READS = {
    "M-T": OF_T, "M-C": ADMISSIBLE, "M-A1": ("field", *ADMISSIBLE), "M-A2": ALL, "M-A3": ALL, "M-24": ALL,
}  # fmt: skip


def values(model: MonotoneInclusion, box: Box) -> list[Values]:
    """Values of a single parameter at which the width of C in some state vanishes."""
    return roots(ca.vertsplit(model.upper - model.lower), model, box)


def findings(model: MonotoneInclusion, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = untouched(check, model, region, quick, READS)
    moving = MovingSet(model.x, model.p, constraints(model)[0], *region.of_parameters())
    C = outer(moving)
    start, box = np.array(ca.DM(model.bind(middle_of(region.parameters)).x0)).ravel(), C.part(region.lower, region.upper)
    convex, interior = is_convex_for_all(moving, *box, quick=quick), has_interior_for_all(moving, start)
    if interior is None:
        return for_the_box([], same, region)
    reach = interior.reach if interior.reach and not _holds_zero(moving) else 0.0
    parts = _decided(Grounds(model, moving, C, box, reach, quick))
    if convex is not None:
        parts["M-C"] = interior.part._replace(how=f"{convex.how}; {interior.part.how}", local=convex.local)
    own = [
        found(which, part.verdict, part.how, part.value or {"constraints": 0}, part.witness, region.scope(part.local))
        for which in HYPOTHESES
        if (part := parts.get(which.id)) is not None
    ]
    return for_the_box(own if "M-A3" in parts else [*own, _not_drawn_back(model, region)], same, region)


def _holds_zero(C: MovingSet) -> bool:
    """Whether 0 lies in C(p) for all p."""
    zero = np.zeros(C.x.numel())
    low, _ = interval.enclose(C.rows, ca.vertcat(C.x, C.p), np.append(zero, C.lower), np.append(zero, C.upper))
    return float(np.min(low)) >= 0


def consequences(model: MonotoneInclusion, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    low, high = region.of_parameters()
    ends = interval.enclose(model.x0, model.p, low, high)
    return consequences_of(model, own, np.max(np.abs(ends), axis=0).ravel(), ())


def _not_drawn_back(model: MonotoneInclusion, region: Region) -> Finding:
    """A value at the middle or an end of the box at which (A3) fails."""
    for at in values_in(region.parameters)[: 1 + 2 ** len(region.parameters)]:
        bound = model.bind(at)
        C = set_of(bound)
        field = field_of(bound, C)
        part = dissipativity(field, linear_growth(field, C.part(region.lower, region.upper), quick=True), quick=True)
        if part.verdict == VIOLATED:
            how = f"at {', '.join(f'{name} = {value:.6g}' for name, value in at.items())}: {part.how}"
            where = Scope(parameters={name: (value, value) for name, value in at.items()})
            return found(A3, VIOLATED, how, part.value, {**at, **part.witness}, where)
    return found(A3, UNKNOWN, "not proved for all values, and no value was found at which it fails")


def _decided(grounds: Grounds) -> dict[str, Part]:
    """(5), (A1)-(A3), (24), where proved."""
    parts = {id: part for id, part in _at_corners(grounds).items() if part is not None}
    return parts if len(parts) == len(HYPOTHESES) - 1 else {**over_parameters(grounds, _switching(grounds)), **parts}


def _switching(grounds: Grounds) -> Switching:
    """What the signs of S are proved to be, and the kinks of phi (nothing is said of these)."""
    if not selection(grounds.model).l.numel():
        return Switching(monotone=True, size=0.0)
    signs = None if grounds.model.phi is not None else switching_part(grounds.model)
    models = [] if signs is None else _models(grounds, ca.vertcat(ca.SX.zeros(grounds.C.n), signs))
    T = agreed((inclusion.operator(one, grounds.C, grounds.box, grounds.quick) for one in models), {})
    a = agreed(
        (linear_growth(field_of(one, grounds.C), grounds.box, quick=grounds.quick) for one in models), {"a_1": max, "a_2": max}
    )
    size = a.value["a_1"] if a is not None and not a.value["a_2"] else np.inf
    return Switching(monotone=T is not None and not T.local, size=size)


# -- corners -----------------------------------------------------------------------------------------------------------


def _at_corners(grounds: Grounds) -> dict[str, Part | None]:
    """(5), (A1)-(A3), (24), of convex combinations."""
    n, model, quick = grounds.C.n, grounds.model, grounds.quick
    rows = model.operator if model.phi is None else without_domain(model.phi, model.x, "phi")
    whole = _models(grounds, ca.vertcat(model.field, rows))
    operators = whole or _models(grounds, ca.vertcat(ca.SX.zeros(n), rows))
    fields = whole or _models(grounds, ca.vertcat(model.field, ca.SX.zeros(rows.numel())))
    T = agreed((inclusion.operator(one, grounds.C, grounds.box, quick) for one in operators), {LEAST: min, "terms": max})
    F = agreed((continuous(one, grounds.C, grounds.box) for one in fields), {"kinks": max})
    made = [field_of(one, grounds.C) for one in whole]
    growth = [linear_growth(field, grounds.box, quick=quick) for field in made]
    reach = grounds.reach if grounds.moving.moving else 0.0
    drawn = (dissipativity(field, a, quick=quick, reach=reach) for field, a in zip(made, growth, strict=True))
    alone = [one.field if T is not None and not T.local else None for one in whole]
    slopes = (one_sided(field, grounds.box, quick=quick, alone=own) for field, own in zip(made, alone, strict=True))
    return {
        "M-T": T, "M-A1": F, "M-A2": agreed(growth, {"a_1": max, "a_2": max}),
        "M-A3": agreed(drawn, {"alpha": min, "beta": max}), "M-24": agreed(slopes, {"L": max}),
    }  # fmt: skip


def _models(grounds: Grounds, rows: ca.SX) -> list[MonotoneInclusion]:
    """Models without parameters of whose F and S (or phi), stacked in ``rows``, those of all values are convex combinations."""
    model, n = grounds.model, grounds.C.n
    at = mixture(rows, model.p, grounds.moving.lower, grounds.moving.upper)
    if at is None or reads(model.sign_arguments, model.p):
        return []
    made = []
    for one in at:
        own = copy(model)
        own._set(field=one[:n], x0=ca.SX.zeros(n))
        if model.phi is None:
            own._set(operator=one[n:])
        else:
            try:
                own._set(phi=one[n:], potential_split=split(one[n:], model.x, "phi"))
            except NsmodelError:
                return []
        made.append(own)
    return made
