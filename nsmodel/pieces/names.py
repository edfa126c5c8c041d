"""What switches are called in messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from nsmodel.pieces.switches import ROW, Switch

NAMED = 4  # Switches that an error names.


def name(of: Switch, rows: Sequence[str]) -> str:
    """A row's own name, or where the branch is."""
    return rows[of[1]] if of[0] == ROW else f"a switch in {of[0]}"


def few(switches: Iterable[Switch], rows: Sequence[str]) -> str:
    """The names of switches, a few of many."""
    names = list(dict.fromkeys(name(of, rows) for of in sorted(switches, key=lambda of: (of[0] != ROW, of))))
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return (", ".join(names[:NAMED]) or "the rows") + more
