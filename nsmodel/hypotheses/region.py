"""The region over which hypotheses about all states are decided: a box of states and an interval of time.

A potential and its domain apart: where it is finite, and a function that is finite elsewhere too.

Hypotheses for all values of parameters in a box: what is proved there, and the value at which one fails.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from fractions import Fraction
from itertools import product
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import UsageError
from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    IntervalBox,
    Scope,
    intersect_scopes,
    plain_witness,
)
from nsmodel.modeling.base import Model
from nsmodel.modeling.convex_split import read_potential_parts
from nsmodel.modeling.parameters import finite_interval
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof import polynomial
from nsmodel.proof.expression_graph import rewrite_nodes
from nsmodel.proof.extremum import samples
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

# The box is this much wider than the runs, so that hypotheses are decided near them, too; in a wider box fewer hold.
BOX_GROWTH = 1.5


@dataclass(frozen=True)
class Region(Picklable):
    """A box: lower (n,), upper (n,) of the states, t0 <= t <= t1; ``origin`` says where it comes from.

    ``parameters`` are the boxes of parameters that stayed symbols, in the order of the model's ``p``.
    """

    lower: np.ndarray
    upper: np.ndarray
    t0: float
    t1: float
    names: tuple[str, ...]
    origin: str
    parameters: IntervalBox = field(default_factory=lambda: MappingProxyType({}))

    __repr__ = short_repr

    def bounds_with_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (n + 1,) of (t, x)."""
        return np.concatenate([[self.t0], self.lower]), np.concatenate([[self.t1], self.upper])

    def parameter_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (k,) of the parameters that stayed symbols."""
        ends = np.array(list(self.parameters.values()), float).reshape(-1, 2)
        return ends[:, 0], ends[:, 1]

    def widened(self, factor: float) -> Region:
        """The box with the same middle, that many times as wide."""
        middle, half = (self.lower + self.upper) / 2, factor * (self.upper - self.lower) / 2
        return replace(self, lower=middle - half, upper=middle + half, origin=f"{factor:g} times {self.origin}")

    def scope(self, local: bool | Iterable[str] = False, timed: bool = False) -> Scope | None:
        """The scope of what was decided on the box (of these states, where they are named), or in its interval of time."""
        own = set(self.names if local is True else local or ())
        ends = zip(self.names, self.lower.tolist(), self.upper.tolist(), strict=True)
        states = {name: (low, high) for name, low, high in ends if name in own}
        return Scope(states, (self.t0, self.t1)) if timed else Scope(states) if states else None

    @property
    def text(self) -> str:
        """One line, for reports."""
        n = len(self.names)
        intervals = [f"{name} in [{a:.4g}, {b:.4g}]" for name, a, b in zip(self.names, self.lower, self.upper, strict=True)]
        states = ", ".join(intervals if n <= 6 else [*intervals[:4], f"... ({n} states)"])
        return f"{states}, t in [{self.t0:.4g}, {self.t1:.4g}] ({self.origin})"


def region_of(model: Model, runs: Sequence[Trajectory], given: Mapping[str, Any] | None = None) -> Region:
    """Return the box around the runs, wider by half; states named in ``given`` have their own interval.

    Of many bodies it is the box of one body, around all of them: its states are ``i.q_0``, ``i.q_1``, ..., its stem is ``i.q``.

    Args:
        model: bound.
        runs: trajectories; without any, the box lies around the start.
        given: {state or stem: (low, high)}.

    Raises:
        UsageError: an unknown name, or no interval low < high of finite numbers.
    """
    (names, stems), (low, high) = model.axes, _state_ranges(model, runs)
    centre, half = (high + low) / 2, (high - low) / 2
    widest = half.max(initial=0.0) or np.abs(centre).max(initial=0.0) or 1.0
    half = np.maximum(BOX_GROWTH * half, np.maximum(0.1 * np.abs(centre), 0.25 * widest))
    lower, upper = centre - half, centre + half
    origin = f"{BOX_GROWTH:g} times the box around the run" if runs else "a box around the start"
    for name, interval in (given or {}).items():
        rows = [names.index(name)] if name in names else stems.get(name)
        if rows is None:
            raise UsageError(f"region: '{name}' is not a state; the model has {', '.join(names)}")
        lower[rows], upper[rows] = finite_interval(f"region: {name}", interval)
        origin = "as given"
    t1 = max([float(model.t_end or 0.0), *(float(run.t[-1]) for run in runs)])
    return Region(lower, upper, 0.0, t1, names, origin)


def enclosing_region(regions: Sequence[Region], parameters: IntervalBox) -> Region:
    """The box around boxes of the same states, for boxes of parameters."""
    lower, upper = (by([getattr(r, end) for r in regions], axis=0) for end, by in (("lower", np.min), ("upper", np.max)))
    t1 = max(region.t1 for region in regions)
    return replace(regions[0], lower=lower, upper=upper, t1=t1, parameters=MappingProxyType(dict(parameters)))


def _state_ranges(model: Model, runs: Sequence[Trajectory]) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of what the start and the runs go through; rows that are not finite do not count."""
    start = np.array(ca.DM(model.start)).ravel()
    parts = [model.points(rows) for rows in (start[None, :], *(run.smooth().x for run in runs))]
    known = [np.all(np.isfinite(part), axis=1)[:, None] for part in parts]
    low = [np.min(part, axis=0, where=finite, initial=np.inf) for part, finite in zip(parts, known, strict=True)]
    high = [np.max(part, axis=0, where=finite, initial=-np.inf) for part, finite in zip(parts, known, strict=True)]
    return np.min(low, axis=0), np.max(high, axis=0)


def potential_without_domain(phi: ca.SX, x: ca.SX, label: str) -> ca.SX:
    """The potential without the conditions that make it +inf: a function that is finite where they fail, too."""
    finite = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if args[1].is_constant() and np.isinf(float(args[1])):
            return ca.SX(0)
        finite.append(old)
        return None

    direct = rewrite_nodes(phi, rule, (ca.OP_IF_ELSE_ZERO,), x, label)
    if not finite:
        return direct
    parts = read_potential_parts(phi, x, label)
    return ca.substitute(parts.value, parts.symbols, parts.meanings({})) if parts.nodes else parts.value


def domain_rows(phi: ca.SX, x: ca.SX, label: str) -> tuple[list[ca.SX], list[ca.SX]]:
    """The domain of a potential as expressions that are >= 0, and those that are 0, in terms of x alone."""
    parts = read_potential_parts(phi, x, label)
    meanings = parts.meanings({})
    rows, equalities = [], []
    for bound in parts.bounds:
        u = ca.substitute(bound.u, parts.symbols, meanings) if parts.nodes else bound.u
        (equalities if bound.kind == "equality" else rows).append(u)
    return rows, equalities


# Parameters up to which all 2^3 corners of their box are looked at, each by a check of the model; of more, each end by itself.
MAX_CORNER_PARAMETERS = 3
INNER_POINTS = 6  # Points inside the box, its middle among them, at each of which a model is checked.
SPECIAL_VALUES = (0.0, 1.0, -1.0)  # Values at which ranks and signs of models tend to change: a term vanishes, or two cancel.

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
        found += [float(a) for a, _ in polynomial.real_roots(line, Fraction(low), Fraction(high))]
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
