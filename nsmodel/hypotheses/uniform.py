"""Hypotheses for all values of parameters in a box: what is proved there, and the value at which one fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, plain
from nsmodel.hypotheses.scope import Box, Scope, meet
from nsmodel.proof.extremum import samples

CORNERS, INSIDE = 3, 6  # Corners of the box are looked at for so many parameters, and so many points inside.
SPECIAL = (0.0, 1.0, -1.0)  # Values at which ranks and signs of models tend to change.

Values = dict[str, float]


def values_in(box: Box, more: Sequence[Values] = ()) -> list[Values]:
    """Values of the parameters to look at: the middle, corners, special numbers, points inside, and ``more``."""
    names, ends = list(box), np.array(list(box.values()), float)
    lower, upper = ends.T
    middle = dict(zip(names, lower + (upper - lower) / 2, strict=True))
    corners = [dict(zip(names, corner, strict=True)) for corner in product(*ends.tolist())] if len(names) <= CORNERS else []
    special = [{**middle, name: x} for name, (low, high) in box.items() for x in SPECIAL if low < x < high]
    ends_alone = [{**middle, name: x} for name, own in box.items() for x in own] if len(names) > 1 else []
    inside = [dict(zip(names, point, strict=True)) for point in samples(lower, upper, INSIDE).tolist()[1:]]
    found: list[Values] = []
    for values in [middle, *corners, *special, *ends_alone, *more, *inside]:
        own = {name: float(x) for name, x in values.items()}
        if own not in found:
            found.append(own)
    return found


def reads(item: Any, p: ca.SX) -> bool:
    """Whether a part of a model, an expression or what holds some, depends on p."""
    if isinstance(item, ca.SX):
        return bool(item.numel() and ca.depends_on(item, p))
    if is_dataclass(item) and not isinstance(item, type):
        return any(reads(getattr(item, f.name), p) for f in fields(item))
    return any(reads(part, p) for part in item) if isinstance(item, tuple | list) else False


def joined(box: Box, at: Sequence[tuple[Values, Mapping[str, Finding]]], proofs: Mapping[str, Finding]) -> list[Finding]:
    """One finding a hypothesis, for the whole box.

    Args:
        box: of the parameters.
        at: values, and what was found at each, by id.
        proofs: what was found for all values of the box at once.
    """
    return [_joined(box, [(values, found[id]) for values, found in at], proofs.get(id)) for id in at[0][1]]


def _joined(box: Box, at: Sequence[tuple[Values, Finding]], proof: Finding | None) -> Finding:
    scope = Scope(parameters=box)
    for values, finding in at:
        if finding.verdict == VIOLATED:
            how = f"at {', '.join(f'{name} = {value:.6g}' for name, value in values.items())}: {finding.how}"
            where = Scope(parameters={name: (x, x) for name, x in values.items()})
            return replace(finding, how=how, witness=plain({**values, **finding.witness}), scope=meet(where, finding.scope))
    if proof is not None and proof.verdict != UNKNOWN:
        return proof
    count = {"values looked at": float(len(at))}
    states = meet(*(finding.scope for _, finding in at), scope)
    worst = next((finding for _, finding in at if finding.verdict == UNKNOWN), None)
    if worst is not None:
        return replace(worst, how=worst.how if proof is None else f"{proof.how}; {worst.how}", value=plain({}), scope=scope)
    seen = sum(finding.verdict == SAMPLED for _, finding in at)
    how = f"no violation at {len(at)} values of {', '.join(box)}" + (f" (at {seen} of them by samples)" if seen else "")
    how += "; between them it is not proved" + ("" if proof is None else f": {proof.how}")
    return replace(at[0][1], verdict=SAMPLED, how=how, value=plain(count), witness=plain({}), scope=states)


def seen_alike(at: Sequence[Sequence[Consequence]], box: Box) -> list[Consequence]:
    """The consequences that read the same at all values, of which nothing was proved between those."""
    found = []
    for first in at[0]:
        others = [next((item for item in own if item.name == first.name), None) for own in at]
        if any(item is None or item.statement != first.statement for item in others):
            continue
        met = all(item is not None and item.verdict in (HOLDS, SAMPLED) for item in others)
        scope = meet(first.scope, Scope(parameters=box))
        found.append(replace(first, verdict=SAMPLED if met else UNKNOWN, value=plain({}), scope=scope, until=None, clause=""))
    return found
