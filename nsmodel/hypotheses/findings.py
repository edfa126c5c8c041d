"""What a check finds: one finding a hypothesis, and what follows from them.

Where a statement was decided: a box of states, an interval of time, boxes of parameters; None where it is everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from nsmodel._utils import short_repr
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof.verdict import HOLDS, SAMPLED, UNKNOWN, VERDICTS, VIOLATED

IntervalBox = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Scope(Picklable):
    """The set that a verdict speaks of; what is not named is not restricted.

    Attributes:
        states: {name: (low, high)} of states, and of multipliers where their box enters.
        time: (t0, t1); None: all times.
        parameters: {name: (low, high)}.
    """

    states: IntervalBox = field(default_factory=lambda: MappingProxyType({}))
    time: tuple[float, float] | None = None
    parameters: IntervalBox = field(default_factory=lambda: MappingProxyType({}))

    __repr__ = short_repr

    @property
    def text(self) -> str:
        """In words: "everywhere", "t in [0, 2]", "on the box", "on the box, t in [0, 2]"."""
        parts = ["on the box"] if self.states else []
        parts += [f"t in [{self.time[0]:.5g}, {self.time[1]:.5g}]"] if self.time is not None else []
        parts += [f"{name} in [{low:.5g}, {high:.5g}]" for name, (low, high) in self.parameters.items()]
        return ", ".join(parts) or "everywhere"

    def document(self) -> dict[str, object]:
        """As data; an entry is None where nothing is restricted."""
        return {
            "states": {name: list(ends) for name, ends in self.states.items()} or None,
            "time": None if self.time is None else list(self.time),
            "parameters": {name: list(ends) for name, ends in self.parameters.items()} or None,
        }


def intersect_scopes(*scopes: Scope | None) -> Scope | None:
    """The intersection.

    >>> intersect_scopes(Scope(time=(0.0, 2.0)), None, Scope({"x": (0.0, 1.0)}, (0.0, 1.0))).text
    'on the box, t in [0, 1]'
    """
    states: dict[str, tuple[float, float]] = {}
    parameters: dict[str, tuple[float, float]] = {}
    time = None
    for scope in scopes:
        if scope is None:
            continue
        for boxes, own in ((states, scope.states), (parameters, scope.parameters)):
            for name, ends in own.items():
                boxes[name] = _intersect_intervals(boxes.get(name), ends)
        time = _intersect_intervals(time, scope.time) if scope.time is not None else time
    return Scope(states, time, parameters) if states or parameters or time is not None else None


def _intersect_intervals(one: tuple[float, float] | None, other: tuple[float, float]) -> tuple[float, float]:
    return other if one is None else (max(one[0], other[0]), min(one[1], other[1]))


def scope_text(scope: Scope | None) -> str:
    """Where, in words."""
    return "everywhere" if scope is None else scope.text


INSIDE_BOX_CLAUSE = "as long as the solution and the scheme's iterates and predictors stay inside the box"
UNLIMITED_NUMBERS = frozenset(
    {"width", "margin", "interior margin", "c", "rho", "min g", "h*", "h* is at least", "condition", "cond P"}
)
RUN_FINDING_PREFIX = "run-"  # Ids of findings about a run begin with it.


class Hypothesis(NamedTuple):
    """What a paper asks for: its id, what it says in words, where it stands."""

    id: str
    statement: str
    source: str


@dataclass(frozen=True)
class Finding(Picklable):
    """What was found out about one hypothesis.

    Attributes:
        id: of the hypothesis: "A5", "5.1", "O-dry", ...
        statement: what it says, in words.
        verdict: "holds" (proved: exactly, or by a bound over the whole region), "sampled" (no violation at the points looked
            at), "violated" (``witness`` says where) or "unknown" (``how`` says why).
        value: {name: number}, the numbers that the theory asks for.
        witness: {name: number, list or text}: the point, vector or index set of the worst value found.
        source: paper and number.
        how: how it was decided.
        scope: the region of states, times and parameters that the verdict speaks of (where a finding is "sampled", the region
            that was looked at); None: everywhere.
        outside: of a finding that holds on its scope, {name: number, list or text}: a point outside where it is known to fail.
    """

    id: str
    statement: str
    verdict: str
    value: Mapping[str, float]
    witness: Mapping[str, Any]
    source: str
    how: str
    scope: Scope | None = None
    outside: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    __repr__ = short_repr


def make_finding(
    hypothesis: Hypothesis,
    verdict: str,
    how: str,
    value: Mapping[str, float] | None = None,
    witness: Mapping[str, Any] | None = None,
    scope: Scope | None = None,
) -> Finding:
    """Return the finding; a verdict without its number, witness or reason is a defect and refused.

    What double precision makes NaN of (0 log 0, where exact arithmetic decides) is not a number, and left out; so is an infinity
    under "holds" of what nothing limits (a width, a margin). Any other infinity there is no proof, and refused.

    Raises:
        ValueError: an unknown verdict, no reason, no number (but for "unknown"), no witness of a violation.
    """
    if verdict not in VERDICTS:
        raise ValueError(f"{hypothesis.id}: verdict {verdict!r}; expected one of {', '.join(VERDICTS)}")
    given = {name: float(number) for name, number in (value or {}).items() if number == number}
    value = {name: number for name, number in given.items() if not (name in UNLIMITED_NUMBERS and number == float("inf"))}
    value = value if verdict == HOLDS else given
    if not how or (verdict != UNKNOWN and not given) or (verdict == VIOLATED and not witness):
        raise ValueError(f"{hypothesis.id}: '{verdict}' needs a reason, a number, and where violated a witness")
    if verdict == HOLDS and (infinite := [name for name, number in value.items() if abs(number) == float("inf")]):
        raise ValueError(f"{hypothesis.id}: '{HOLDS}' with {', '.join(infinite)} infinite; a proof has finite numbers")
    numbers = MappingProxyType(value)
    return Finding(hypothesis.id, hypothesis.statement, verdict, numbers, plain_witness(witness), hypothesis.source, how, scope)


def plain_witness(witness: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """A witness as numbers, text and nested lists of them."""
    return MappingProxyType({name: _plain_item(item) for name, item in (witness or {}).items()})


@dataclass(frozen=True)
class Consequence(Picklable):
    """What follows from hypotheses.

    Attributes:
        name: "well posed", "step bound", "K_L", ...
        statement: in words or as a formula.
        rests_on: ids of the findings that it needs.
        verdict: "holds" where all of them are proved, "sampled" where one is sampled only, "violated" where its number
            contradicts the claim, "unknown" where a hypothesis is violated or undecided: then nothing follows.
        value: {name: number}.
        source: paper and number.
        scope: the intersection of the scopes of what it rests on; None: everywhere.
        clause: of a statement about solutions or runs on a box of states, the condition that they stay inside it, and how long
            that is proved; "" where there is none.
        until: the time up to which it is proved that the solution from the start stays inside, and where the clause does not
            say otherwise iterates and predictors, too; None where there is no such clause, or no proof.
    """

    name: str
    statement: str
    rests_on: tuple[str, ...]
    verdict: str
    value: Mapping[str, float]
    source: str
    scope: Scope | None = None
    clause: str = ""
    until: float | None = None

    __repr__ = short_repr


def measured_consequence(name: str, statement: str, value: Mapping[str, float]) -> Consequence:
    """Return what runs show beside the theory."""
    return Consequence(name, statement, (), SAMPLED, {key: float(number) for key, number in value.items()}, "measured on runs")


def make_consequence(
    name: str, statement: str, findings: Sequence[Finding], rests_on: Sequence[str], source: str,
    value: Mapping[str, float] | None = None, moving: bool = True,
) -> Consequence:  # fmt: skip
    """Return the consequence; its verdict is the weakest of those that it rests on, its scope their intersection.

    ``moving``: whether it speaks of solutions or runs, which may leave a box, not of the sets and functions there.
    """
    verdicts = {finding.id: finding.verdict for finding in findings}
    own = [verdicts[id] for id in rests_on]
    verdict = UNKNOWN if {VIOLATED, UNKNOWN} & set(own) else SAMPLED if SAMPLED in own else HOLDS
    numbers = {key: float(number) for key, number in (value or {}).items()}
    if verdict == HOLDS:
        numbers = {key: number for key, number in numbers.items() if abs(number) < float("inf")}
    scope = common_scope(findings, rests_on)
    clause = INSIDE_BOX_CLAUSE if moving and scope is not None and scope.states else ""
    return Consequence(name, statement, tuple(rests_on), verdict, MappingProxyType(numbers), source, scope, clause)


def common_scope(findings: Sequence[Finding], ids: Sequence[str]) -> Scope | None:
    """The intersection of the scopes of some findings."""
    return intersect_scopes(*(finding.scope for finding in findings if finding.id in ids))


def _plain_item(item: Any) -> Any:
    """Numbers, text and nested lists of them, so that a witness can be written as JSON."""
    if hasattr(item, "tolist"):
        item = item.tolist()
    if isinstance(item, list | tuple):
        return [_plain_item(part) for part in item]
    if isinstance(item, bool | int | str) or item is None:
        return item
    return float(item)
