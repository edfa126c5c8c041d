"""Hypotheses for all values of parameters in a box: what is proved there, and the value at which one fails."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from fractions import Fraction
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, plain_witness
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import IntervalBox, Scope, intersect_scopes
from nsmodel.modeling.base import Model
from nsmodel.proof import polynomial
from nsmodel.proof import polynomial as polynomial_signs
from nsmodel.proof.extremum import samples
from nsmodel.proof.verdict import HypothesisPart

MAX_CORNER_PARAMETERS, INNER_POINTS = 3, 6  # Corners of the box are looked at for so many parameters, and so many points inside.
SPECIAL_VALUES = (0.0, 1.0, -1.0)  # Values at which ranks and signs of models tend to change.

ParameterValues = dict[str, float]


def sample_values(box: IntervalBox, more: Sequence[ParameterValues] = ()) -> list[ParameterValues]:
    """Values of the parameters to look at: the middle, corners, special numbers, points inside, and ``more``."""
    names, ends, middle = list(box), np.array(list(box.values()), float), box_middle(box)
    lower, upper = ends.T
    corners = (
        [dict(zip(names, corner, strict=True)) for corner in product(*ends.tolist())]
        if len(names) <= MAX_CORNER_PARAMETERS
        else []
    )
    special = [{**middle, name: x} for name, (low, high) in box.items() for x in SPECIAL_VALUES if low < x < high]
    ends_alone = [{**middle, name: x} for name, own in box.items() for x in own] if len(names) > 1 else []
    inside = [dict(zip(names, point, strict=True)) for point in samples(lower, upper, INNER_POINTS).tolist()[1:]]
    found: list[ParameterValues] = []
    for values in [middle, *corners, *special, *ends_alone, *more, *inside]:
        own = {name: float(x) for name, x in values.items()}
        if own not in found:
            found.append(own)
    return found


def box_middle(box: IntervalBox) -> ParameterValues:
    """The middle of the box."""
    return {name: low + (high - low) / 2 for name, (low, high) in box.items()}


def depends_on_symbol(item: Any, p: ca.SX) -> bool:
    """Whether a part of a model, an expression or what holds some, depends on p."""
    if isinstance(item, ca.SX):
        return bool(item.numel() and ca.depends_on(item, p))
    if is_dataclass(item) and not isinstance(item, type):
        return any(depends_on_symbol(getattr(item, f.name), p) for f in fields(item))
    if isinstance(item, Mapping):
        return any(depends_on_symbol(part, p) for part in item.values())
    return any(depends_on_symbol(part, p) for part in item) if isinstance(item, tuple | list) else False


def parameter_roots(entries: Iterable[ca.SX], model: Model, box: IntervalBox) -> list[ParameterValues]:
    """Values of a single parameter at which an entry, a quotient of polynomials in it, vanishes."""
    if len(box) != 1:
        return []
    ((name, (low, high)),) = box.items()
    found: list[float] = []
    for entry in entries:
        ratio = polynomial.read_quotient(entry, model.p)
        line = polynomial.univariate_coefficients(ratio[0]) if ratio is not None and ratio[0] else [Fraction(1)]
        found += [float(a) for a, _ in polynomial_signs.real_roots(line, Fraction(low), Fraction(high))]
    return [{name: x} for x in dict.fromkeys(found) if low <= x <= high]


def unaffected_findings(
    check: Callable[..., tuple[list[Finding], list[Consequence]]], model: Model, region: Region, quick: bool,
    parts: Mapping[str, Sequence[str]],
) -> list[Finding]:  # fmt: skip
    """The findings that are the same for all values: of hypotheses whose parts of the model do not depend on the parameters."""
    same = {id for id, names in parts.items() if not any(depends_on_symbol(getattr(model, name), model.p) for name in names)}
    if not same:
        return []
    middle = model.bind(box_middle(region.parameters))
    return [finding for finding in check(middle, replace(region, parameters={}), (), quick)[0] if finding.id in same]


def findings_for_box(own: Iterable[Finding | None], same: Sequence[Finding], region: Region) -> list[Finding]:
    """The findings that are the same for all values, and those of the others, for the box of the parameters."""
    scope, known = Scope(parameters=region.parameters), {finding.id for finding in same}
    return [
        *same,
        *(replace(item, scope=intersect_scopes(item.scope, scope)) for item in own if item is not None and item.id not in known),
    ]


def combine_proofs(parts: Iterable[HypothesisPart], ends: Mapping[str, Callable[..., float]]) -> HypothesisPart | None:
    """What holds for functions of which those of all values are convex combinations; None where it does not hold for each.

    Args:
        parts: of the functions; after one that fails no other is asked for.
        ends: {name of a number: min or max}, whichever is a bound for convex combinations.
    """
    own: list[HypothesisPart] = []
    for part in parts:
        if part.verdict != HOLDS:
            return None
        own.append(part)
    if not own:
        return None
    value = {
        name: float(end(part.value[name] for part in own)) for name, end in ends.items() if all(name in p.value for p in own)
    }
    how = "; ".join(dict.fromkeys(part.how for part in own))
    if len(own) > 1:
        how += f"; at {len(own)} corners, of which that of each value is a convex combination"
    return HypothesisPart(HOLDS, how, value or {"corners": len(own)}, {}, any(part.local for part in own))


def join_findings(
    box: IntervalBox, at: Sequence[tuple[ParameterValues, Mapping[str, Finding]]], proofs: Mapping[str, Finding]
) -> list[Finding]:
    """One finding a hypothesis, for the whole box.

    Args:
        box: of the parameters.
        at: values, and what was found at each, by id.
        proofs: what was found for all values of the box at once.
    """
    return [_join_finding(box, [(values, found[id]) for values, found in at], proofs.get(id)) for id in at[0][1]]


def is_same_for_all_values(proof: Finding) -> bool:
    """Whether all values give what one of them gives: it holds for all, or does not depend on them."""
    return proof.verdict == HOLDS or not (proof.scope is not None and proof.scope.parameters)


def _join_finding(box: IntervalBox, at: Sequence[tuple[ParameterValues, Finding]], proof: Finding | None) -> Finding:
    scope = Scope(parameters=box)
    if proof is not None and proof.verdict == VIOLATED and not (proof.scope is not None and proof.scope.parameters):
        return proof  # what does not depend on the parameters
    for values, finding in at:
        if finding.verdict == VIOLATED:
            how = f"at {', '.join(f'{name} = {value:.6g}' for name, value in values.items())}: {finding.how}"
            where = Scope(parameters={name: (x, x) for name, x in values.items()})
            return replace(
                finding,
                how=how,
                witness=plain_witness({**values, **finding.witness}),
                scope=intersect_scopes(where, finding.scope),
            )
    if proof is not None and proof.verdict != UNKNOWN:
        return proof
    count = {"values looked at": float(len(at))}
    states = intersect_scopes(*(finding.scope for _, finding in at), scope)
    worst = next((finding for _, finding in at if finding.verdict == UNKNOWN), None)
    if worst is not None:
        return replace(worst, how=worst.how if proof is None else proof.how, value=plain_witness({}), scope=scope)
    seen = sum(finding.verdict == SAMPLED for _, finding in at)
    looked = f"{len(at)} value{'s' * (len(at) > 1)} of {', '.join(box)}"
    how = f"no violation at {looked}" + (f" (at {seen} of them by samples)" if seen else "")
    how += "; between them it is not proved" + ("" if proof is None else f": {proof.how}")
    return replace(at[0][1], verdict=SAMPLED, how=how, value=plain_witness(count), witness=plain_witness({}), scope=states)


def common_consequences(at: Sequence[Sequence[Consequence]], box: IntervalBox) -> list[Consequence]:
    """The consequences that read the same at all values, of which nothing was proved between those."""
    found = []
    for first in at[0]:
        others = [next((item for item in own if item.name == first.name), None) for own in at]
        if any(item is None or item.statement != first.statement for item in others):
            continue
        met = all(item is not None and item.verdict in (HOLDS, SAMPLED) for item in others)
        scope = intersect_scopes(first.scope, Scope(parameters=box))
        found.append(
            replace(first, verdict=SAMPLED if met else UNKNOWN, value=plain_witness({}), scope=scope, until=None, clause="")
        )
    return found
