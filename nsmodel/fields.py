"""What the metadata of files must be: one table of names and types for runs, one for sweeps, one for manifests.

A type is a `Kind`, None, a list [type], a dictionary of any names (`Each`), a dictionary of these names {name: type}, or one of
several (type, type). Names that stand in no table are the user's own: they are read as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

from nsmodel.errors import StorageError


@dataclass(frozen=True)
class Kind:
    """Values of one kind, in words, and what tells them."""

    words: str
    holds: Callable[[Any], bool]


@dataclass(frozen=True)
class Each:
    """A dictionary of any names, with values of one type."""

    of: Any


@dataclass(frozen=True)
class All:
    """A dictionary that has each of these names, and may have others."""

    of: Mapping[str, Any]
    may: Mapping[str, Any] = field(default_factory=dict)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


TEXT = Kind("a text", lambda value: isinstance(value, str))
COUNT = Kind("a whole number >= 0", lambda value: type(value) is int and 0 <= value < 1 << 63)
POSITIVE = Kind("a whole number >= 1", lambda value: type(value) is int and 1 <= value < 1 << 63)
NUMBER = Kind("a number", _is_number)
FINITE = Kind("a finite number", lambda value: _is_number(value) and isfinite(value))
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
ANY = Kind("anything", lambda value: True)
_QUANTITY = All({"of": [TEXT], "size": POSITIVE, "code": TEXT})
_LINES = [[[NUMBER]]]
_ARCH = All({"bodies": [COUNT], "at": [[NUMBER]], "exit": (TEXT, None), "pressed": COUNT, "ends": [TEXT]})
_STANDSTILL = All({"since": NUMBER, "bodies": COUNT, "for_good": (TEXT, None), "arches": [_ARCH]})

TOTALS = {
    **dict.fromkeys(
        "steps index_set_changes accepted rejected extrapolated at_least_step pieces collocated events order "
        "entered touches left most_contacts redundant".split(), (COUNT, None),
    ),
    **dict.fromkeys(
        "worst_residual worst_residual_t newton newton_max largest_error least_step estimate worst_estimate worst_estimate_t "
        "rtol least_gap least_gap_t largest_pressure largest_pressure_t least_eigenvalue".split(), (NUMBER, None),
    ),
    "largest_pressure_body": (COUNT, None), "unique": Each(COUNT), "impacts": Each(Each(ANY)), "ended": TEXT,
    "last_x": [NUMBER], "last_v": [[NUMBER]], "rest_from": ([NUMBER], None), "overrun": (None, All({"gap": NUMBER, "t": NUMBER})),
    "stretches": [All({"start": NUMBER, "until": NUMBER})],
    "undecided": All({"count": COUNT, "t": NUMBER, "width": NUMBER, "of": TEXT, "crosses": FLAG}),
}  # fmt: skip
RUN = {
    "status": TEXT, "message": TEXT, **dict.fromkeys("title model_class paper scheme model_hash run".split(), (TEXT, None)),
    **{
        name: [TEXT]
        for name in "state_names multiplier_names index_names input_names law_kinds used left_out warnings families".split()
    },
    "stems": Each([COUNT]), "units": Each(TEXT), "input_groups": Each([TEXT]), "versions": Each(TEXT),
    "parameters": Each(NUMBER), "weights": [NUMBER], "outputs": Each(_QUANTITY), "between_rows": Each((COUNT, _QUANTITY)),
    "save_every": POSITIVE, "steps": COUNT, "tolerance": NUMBER, "solver_counts": Each(COUNT), "totals": (TOTALS, None),
    "of_pairs": [FLAG], "constraint_bodies": [[COUNT]], "body_numbers": Each([ANY]),
    "scene": (None, {"radii": [FINITE], "walls": _LINES, "exits": _LINES, "exit_names": [TEXT]}),
    "bodies": All({"count": COUNT, "d": COUNT, "there": COUNT, "waiting": COUNT, "left": COUNT},
                  {"empty_at": (NUMBER, None), "standstill": (_STANDSTILL, None)}),
    "convergence": (None, {"element": TEXT, "finite": (FLAG, None), "reason": (TEXT, None), "margin": (NUMBER, None),
                           "distance": (NUMBER, None), "n_0": (COUNT, None), "t_0": (NUMBER, None)}),
    "certificate": (None, {"kind": TEXT, "pieces": COUNT, "proved": COUNT, "not_proved": COUNT, "conditions": [TEXT],
                           "failures": [TEXT], "error": (None, All({"state": TEXT, "bound": NUMBER, "until": NUMBER})),
                           "no_error_bound": (TEXT, None), "share": NUMBER, "depth": NUMBER, "reach": NUMBER}),
}  # fmt: skip
SWEEP = All(
    {
        "dims": [TEXT], "along": Each([COUNT]), "shape": [POSITIVE], "keep": [TEXT], "outputs": Each(TEXT), "units": Each(TEXT),
        "plan": TEXT, "title": (TEXT, None), "model_class": (TEXT, None), "messages": Each(TEXT), "settings": Each(ANY),
        "entropy": (COUNT, None), "low_discrepancy": (FLAG, None), "ways": [TEXT],
    },
    {"labels": Each([TEXT]), "sweep": TEXT, "values": TEXT},
)  # fmt: skip
PART = All({"shape": [POSITIVE], "messages": Each(TEXT), "sweep": TEXT, "values": TEXT})
_CHUNK = All({"file": TEXT, "rows": COUNT, "sha256": TEXT}, {"listed": COUNT})
MANIFEST = All({
    "version": TEXT, "chunks": [_CHUNK], "rows": COUNT, "checkpoint": Each(ANY), "metadata": RUN, "status": TEXT, "run": TEXT,
})  # fmt: skip
CHECKPOINT = All(
    {"k": COUNT, "t": NUMBER, "totals": TOTALS, "counts": Each(COUNT), "settings": Each(ANY)},
    {"cut": (None, All({"rows": COUNT, "listed": COUNT}))},
)
UNFINISHED = All({"checkpoint": All({"t": NUMBER}), "metadata": All({"versions": All({"nsmodel": TEXT})}), "status": TEXT})
SWEEP_MANIFEST = All({
    "version": TEXT, "shape": [POSITIVE], "settings": Each(ANY), "sweep": TEXT,
    "design": All({"dims": [TEXT], "sizes": [POSITIVE], "columns": [[ANY]], "items": Each([TEXT]), "entropy": COUNT}),
})  # fmt: skip


def refuse_other_types(data: Any, of: Any, path: str | Path) -> None:
    """Raise StorageError, with the field's name, where metadata are not of their type."""
    fault = next(faults(data, of), None)
    if fault is not None:
        field, value, expected = fault
        raise StorageError(
            f"{path}: {field or 'metadata'} is {value!r:.60}; expected {expected}: it was changed, or is no such file"
        )


def faults(value: Any, of: Any, field: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield (field, value, what is expected) where ``value`` is not of the type ``of``."""
    if isinstance(of, tuple):
        inner = [one for one in of if isinstance(one, dict | All | Each)]
        if isinstance(value, dict) and len(inner) == 1:
            yield from faults(value, inner[0], field)
        elif not any(next(faults(value, one), None) is None for one in of):
            yield field, value, _words(of)
    elif isinstance(of, Kind) or of is None:
        if not (value is None if of is None else of.holds(value)):
            yield field, value, _words(of)
    elif isinstance(of, list):
        if not isinstance(value, list):
            yield field, value, _words(of)
            return
        for i, one in enumerate(value):
            yield from faults(one, of[0], f"{field}[{i}]")
    elif not isinstance(value, dict):
        yield field, value, _words(of)
    elif isinstance(of, Each):
        for name, one in value.items():
            yield from faults(one, of.of, f"{field}['{name}']")
    else:
        names = {**of.of, **of.may} if isinstance(of, All) else of
        for name, one in names.items():
            inner = f"{field}['{name}']" if field else name
            if name in value:
                yield from faults(value[name], one, inner)
            elif isinstance(of, All) and name in of.of:
                yield inner, "missing", _words(one)


def _words(of: Any) -> str:
    if isinstance(of, tuple):
        return " or ".join(map(_words, of))
    if isinstance(of, list):
        return f"a list, each {_words(of[0])}" if of[0] is not ANY else "a list"
    return "none" if of is None else of.words if isinstance(of, Kind) else "a dictionary"
