"""What switches are called in messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from nsmodel.pieces.switches import ROW, Switch

NAMED = 4  # Switches that an error names.


def switch_name(of: Switch, rows: Sequence[str]) -> str:
    """A row's own name, or where the branch is."""
    return rows[of[1]] if of[0] == ROW else f"a switch in {of[0]}"


UNDECIDED_FIELDS = ("count", "t", "width", "of", "crosses")  # See `undecided`.


def describe_undecided(record: Sequence[float], rows: Sequence[str], parts: Sequence[str]) -> dict[str, Any]:
    """Events and dips that are not known to rtol: how many, and of the first its time, for how long, of what, whether an event.

    Args:
        record: as numbers; of what: a row, or behind the rows a branch.
        rows: the names of rows.
        parts: of each branch the part that has it.
    """
    found = dict(zip(UNDECIDED_FIELDS, record, strict=True))
    i = int(found["of"])
    of = rows[i] if i < len(rows) else f"a switch in {parts[i - len(rows)]}" if parts else ""
    return found | {"count": int(found["count"]), "of": of, "crosses": bool(found["crosses"])}


def list_switch_names(switches: Iterable[Switch], rows: Sequence[str]) -> str:
    """The names of switches, a few of many; "" of none."""
    names = list(dict.fromkeys(switch_name(of, rows) for of in sorted(switches, key=lambda of: (of[0] != ROW, of))))
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
