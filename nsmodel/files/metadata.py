"""What the metadata of files must be: one table of names and types for runs, one for sweeps, one for manifests.

A type is a `FieldType`, None, a list [type], a dictionary of any names (`MappingOf`), a dictionary of these names {name: type},
or one of several (type, type). Names that stand in no table are the user's own: they are read as they are.

The manifest of a folder of results: what is in the folder, with a checksum, and what binds files to their run or sweep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

from nsmodel.errors import StorageError
from nsmodel.files.archive import document_digest
from nsmodel.files.storage import FILE_FORMAT, Metadata, file_format, path_inside, read_json


@dataclass(frozen=True)
class FieldType:
    """Values of one kind, in words, and what tells them."""

    description: str
    holds: Callable[[Any], bool]


@dataclass(frozen=True)
class MappingOf:
    """A dictionary of any names, with values of one type."""

    of: Any


@dataclass(frozen=True)
class MappingWith:
    """A dictionary that has each of these names, and may have others."""

    of: Mapping[str, Any]
    optional: Mapping[str, Any] = field(default_factory=dict)


def _is_json_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


TEXT_TYPE = FieldType("a text", lambda value: isinstance(value, str))
COUNT_TYPE = FieldType("a whole number >= 0", lambda value: type(value) is int and 0 <= value < 1 << 63)
POSITIVE_TYPE = FieldType("a whole number >= 1", lambda value: type(value) is int and 1 <= value < 1 << 63)
NUMBER_TYPE = FieldType("a number", _is_json_number)
FINITE_TYPE = FieldType("a finite number", lambda value: _is_json_number(value) and isfinite(value))
FLAG_TYPE = FieldType("true or false", lambda value: isinstance(value, bool))
ANY_TYPE = FieldType("anything", lambda value: True)
_QUANTITY_FIELDS = MappingWith({"of": [TEXT_TYPE], "size": POSITIVE_TYPE, "code": TEXT_TYPE})
_LINES_TYPE = [[[NUMBER_TYPE]]]
_ARCH_FIELDS = MappingWith(
    {"bodies": [COUNT_TYPE], "at": [[NUMBER_TYPE]], "exit": (TEXT_TYPE, None), "pressed": COUNT_TYPE, "ends": [TEXT_TYPE]}
)
_STANDSTILL_FIELDS = MappingWith(
    {"since": NUMBER_TYPE, "bodies": COUNT_TYPE, "for_good": (TEXT_TYPE, None), "arches": [_ARCH_FIELDS]}
)

TOTALS_FIELDS = {
    **dict.fromkeys(
        "steps index_set_changes accepted rejected extrapolated at_least_step pieces collocated events order "
        "entered touches left most_contacts redundant".split(), (COUNT_TYPE, None),
    ),
    **dict.fromkeys(
        "worst_residual worst_residual_t newton newton_max largest_error least_step estimate worst_estimate worst_estimate_t "
        "rtol least_gap least_gap_t largest_pressure largest_pressure_t least_eigenvalue".split(), (NUMBER_TYPE, None),
    ),
    "largest_pressure_body": (COUNT_TYPE, None), "unique": MappingOf(COUNT_TYPE), "impacts": MappingOf(MappingOf(ANY_TYPE)),
    "ended": TEXT_TYPE, "last_x": [NUMBER_TYPE], "last_v": [[NUMBER_TYPE]], "rest_from": ([NUMBER_TYPE], None),
    "overrun": (None, MappingWith({"gap": NUMBER_TYPE, "t": NUMBER_TYPE})),
    "stretches": [MappingWith({"start": NUMBER_TYPE, "until": NUMBER_TYPE})],
    "undecided": MappingWith({"count": COUNT_TYPE, "t": NUMBER_TYPE, "width": NUMBER_TYPE, "of": TEXT_TYPE,
                              "crosses": FLAG_TYPE}),
}  # fmt: skip
RUN_FIELDS = {
    "status": TEXT_TYPE, "message": TEXT_TYPE,
    **dict.fromkeys("title model_class paper scheme model_hash run".split(), (TEXT_TYPE, None)),
    **{
        name: [TEXT_TYPE]
        for name in "state_names multiplier_names index_names input_names law_kinds used left_out warnings families".split()
    },
    "stems": MappingOf([COUNT_TYPE]), "axes": MappingOf([TEXT_TYPE]),
    "units": MappingOf(TEXT_TYPE), "input_groups": MappingOf([TEXT_TYPE]),
    "versions": MappingOf(TEXT_TYPE), "parameters": MappingOf(NUMBER_TYPE), "weights": [NUMBER_TYPE],
    "anti_friction": MappingOf(NUMBER_TYPE),
    "outputs": MappingOf(_QUANTITY_FIELDS), "between_rows": MappingOf((COUNT_TYPE, _QUANTITY_FIELDS)),
    "save_every": POSITIVE_TYPE, "steps": COUNT_TYPE, "tolerance": NUMBER_TYPE, "solver_counts": MappingOf(COUNT_TYPE),
    "totals": (TOTALS_FIELDS, None), "of_pairs": [FLAG_TYPE], "constraint_bodies": [[COUNT_TYPE]],
    "body_numbers": MappingOf([ANY_TYPE]),
    "scene": (None, {"radii": [FINITE_TYPE], "walls": _LINES_TYPE, "exits": _LINES_TYPE, "exit_names": [TEXT_TYPE]}),
    "bodies": MappingWith({"count": COUNT_TYPE, "d": COUNT_TYPE, "there": COUNT_TYPE, "waiting": COUNT_TYPE, "left": COUNT_TYPE},
                  {"empty_at": (NUMBER_TYPE, None), "standstill": (_STANDSTILL_FIELDS, None)}),
    "convergence": (None, {"element": TEXT_TYPE, "finite": (FLAG_TYPE, None), "reason": (TEXT_TYPE, None),
                           "margin": (NUMBER_TYPE, None), "distance": (NUMBER_TYPE, None), "n_0": (COUNT_TYPE, None),
                           "t_0": (NUMBER_TYPE, None)}),
    "certificate": (None, {"kind": TEXT_TYPE, "pieces": COUNT_TYPE, "proved": COUNT_TYPE, "not_proved": COUNT_TYPE,
                           "conditions": [TEXT_TYPE], "failures": [TEXT_TYPE],
                           "error": (None, MappingWith({"state": TEXT_TYPE, "bound": NUMBER_TYPE, "until": NUMBER_TYPE})),
                           "no_error_bound": (TEXT_TYPE, None), "share": NUMBER_TYPE, "depth": NUMBER_TYPE,
                           "reach": NUMBER_TYPE}),
}  # fmt: skip
SWEEP_FIELDS = MappingWith(
    {
        "dims": [TEXT_TYPE], "along": MappingOf([COUNT_TYPE]), "shape": [POSITIVE_TYPE], "keep": [TEXT_TYPE],
        "outputs": MappingOf(TEXT_TYPE), "units": MappingOf(TEXT_TYPE),
        "plan": TEXT_TYPE, "title": (TEXT_TYPE, None), "model_class": (TEXT_TYPE, None), "messages": MappingOf(TEXT_TYPE),
        "settings": MappingOf(ANY_TYPE), "entropy": (COUNT_TYPE, None), "low_discrepancy": (FLAG_TYPE, None), "ways": [TEXT_TYPE],
    },
    {"labels": MappingOf([TEXT_TYPE]), "sweep": TEXT_TYPE, "values": TEXT_TYPE},
)  # fmt: skip
SWEEP_PART_FIELDS = MappingWith(
    {"shape": [POSITIVE_TYPE], "messages": MappingOf(TEXT_TYPE), "sweep": TEXT_TYPE, "values": TEXT_TYPE}
)
_CHUNK_FIELDS = MappingWith({"file": TEXT_TYPE, "rows": COUNT_TYPE, "sha256": TEXT_TYPE}, {"listed": COUNT_TYPE})
MANIFEST_FIELDS = MappingWith({
    "version": TEXT_TYPE, "chunks": [_CHUNK_FIELDS], "rows": COUNT_TYPE, "checkpoint": MappingOf(ANY_TYPE),
    "metadata": RUN_FIELDS, "status": TEXT_TYPE, "run": TEXT_TYPE,
})  # fmt: skip
CHECKPOINT_FIELDS = MappingWith(
    {
        "k": COUNT_TYPE,
        "t": NUMBER_TYPE,
        "totals": TOTALS_FIELDS,
        "counts": MappingOf(COUNT_TYPE),
        "settings": MappingOf(ANY_TYPE),
    },
    {"cut": (None, MappingWith({"rows": COUNT_TYPE, "listed": COUNT_TYPE}))},
)
UNFINISHED_FIELDS = MappingWith(
    {
        "checkpoint": MappingWith({"t": NUMBER_TYPE}),
        "metadata": MappingWith({"versions": MappingWith({"nsmodel": TEXT_TYPE})}),
        "status": TEXT_TYPE,
    }
)
SWEEP_MANIFEST_FIELDS = MappingWith({
    "version": TEXT_TYPE, "shape": [POSITIVE_TYPE], "settings": MappingOf(ANY_TYPE), "sweep": TEXT_TYPE,
    "design": MappingWith({"dims": [TEXT_TYPE], "sizes": [POSITIVE_TYPE], "columns": [[ANY_TYPE]],
                          "items": MappingOf([TEXT_TYPE]), "entropy": COUNT_TYPE}),
})  # fmt: skip


def check_field_types(data: Any, of: Any, path: str | Path) -> None:
    """Raise StorageError, with the field's name, where metadata are not of their type."""
    fault = next(type_faults(data, of), None)
    if fault is not None:
        field, value, expected = fault
        raise StorageError(
            f"{path}: {field or 'metadata'} is {value!r:.60}; expected {expected}: it was changed, or is a file of another kind"
        )


def type_faults(value: Any, of: Any, field: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield (field, value, what is expected) where ``value`` is not of the type ``of``."""
    if isinstance(of, tuple):
        inner = [one for one in of if isinstance(one, dict | MappingWith | MappingOf)]
        if isinstance(value, dict) and len(inner) == 1:
            yield from type_faults(value, inner[0], field)
        elif not any(next(type_faults(value, one), None) is None for one in of):
            yield field, value, _describe_type(of)
    elif isinstance(of, FieldType) or of is None:
        if not (value is None if of is None else of.holds(value)):
            yield field, value, _describe_type(of)
    elif isinstance(of, list):
        if not isinstance(value, list):
            yield field, value, _describe_type(of)
            return
        for i, one in enumerate(value):
            yield from type_faults(one, of[0], f"{field}[{i}]")
    elif not isinstance(value, dict):
        yield field, value, _describe_type(of)
    elif isinstance(of, MappingOf):
        for name, one in value.items():
            yield from type_faults(one, of.of, f"{field}['{name}']")
    else:
        names = {**of.of, **of.optional} if isinstance(of, MappingWith) else of
        for name, one in names.items():
            inner = f"{field}['{name}']" if field else name
            if name in value:
                yield from type_faults(value[name], one, inner)
            elif isinstance(of, MappingWith) and name in of.of:
                yield inner, "missing", _describe_type(one)


def _describe_type(of: Any) -> str:
    if isinstance(of, tuple):
        return " or ".join(map(_describe_type, of))
    if isinstance(of, list):
        return f"a list, each {_describe_type(of[0])}" if of[0] is not ANY_TYPE else "a list"
    return "none" if of is None else of.description if isinstance(of, FieldType) else "a dictionary"


MANIFEST_FILE = "manifest.json"


def settings_digest(*settings: Any) -> str:
    """The digest of a run or of a sweep: of this format and of all that its numbers depend on, as JSON holds it."""
    return document_digest({"format": FILE_FORMAT, "settings": list(settings)})


def with_checksum(manifest: Metadata) -> dict[str, Any]:
    """A manifest with its checksum."""
    return {**manifest, "checksum": document_digest(manifest)}


def has_valid_checksum(manifest: Any) -> bool:
    """Whether a manifest has the checksum that it should, which is taken away; that of older formats is shorter."""
    checksum = manifest.pop("checksum", None)
    return isinstance(checksum, str) and len(checksum) >= _MIN_CHECKSUM_LENGTH and document_digest(manifest).startswith(checksum)


_MIN_CHECKSUM_LENGTH = 16  # Hexadecimal digits, at least, 64 bits: older formats have fewer than today.


def read_manifest(folder: Path, fields: Any, *, what: str, afresh: str) -> dict[str, Any]:
    """The manifest of a run or sweep that is to go on.

    Args:
        folder: where it is.
        fields: its names and types.
        what: "run" or "sweep"; afresh: how to do without it, for messages.

    Raises:
        StorageError: it was changed, is another's, or of another format than this version writes.
    """
    path = path_inside(folder, MANIFEST_FILE, "nsmodel")
    manifest = read_json(path)
    if not isinstance(manifest, dict):
        raise StorageError(f"{path} is not a manifest; {afresh}")
    if file_format(manifest, path) < FILE_FORMAT:
        about = manifest.get("metadata") or manifest.get("settings")
        versions = about.get("versions") if isinstance(about, dict) else None
        by = versions.get("nsmodel") if isinstance(versions, dict) else None
        named = f"nsmodel {by}" if isinstance(by, str) else "an older nsmodel"
        raise StorageError(
            f"{path} is of format {file_format(manifest, path)}, written by {named}: its files can be read, but this version "
            f"does not continue the {what}; go on with {named}, or {afresh}"
        )
    if not has_valid_checksum(manifest):
        raise StorageError(f"{path} was changed after it was written; {afresh}")
    check_field_types(manifest, fields, path)
    return manifest
