"""``outputs=`` of a model: quantities that its runs have as further columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.model.arguments import RESERVED_RUN_NAMES
from nsmodel.model.quantity import SymbolsByName, parse_entry_name, read_column

RUN_LIST_PREFIXES = ("contact_", "piece_")  # What the names of lists in a run begin with.
RUN_COLUMNS = frozenset("l y multipliers reactions energy v step residual gap defect selection".split())  # That runs may have.


def declare_outputs(given: Any, model: Any) -> dict[str, ca.SX]:
    """{name: column of expressions} of what was given: their symbols are parameters, and columns of runs by their names.

    Raises:
        ModelError: no dictionary, an unknown symbol, a name that runs have already, no column.
    """
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise ModelError(f"outputs: expected a dictionary {{name: expression}}, not a {type(given).__name__}")
    if given and model.outputless:
        raise ModelError(f"outputs: {model.outputless}")
    symbols = _OutputNames(model)
    for name in given:
        check_output_name(name, {*symbols, *RUN_COLUMNS, *model.has, *model.stems, *model.input_groups, *model.row_names})
    return {name: read_column(value, f"output '{name}'", symbols) for name, value in given.items()}


def check_output_name(name: Any, taken: set[str]) -> None:
    """Refuse what is no name, or one that a run has already; ModelError."""
    if not isinstance(name, str) or not name:
        raise ModelError(f"outputs: {name!r}; expected a name")
    if name in RESERVED_RUN_NAMES | {"x"} | taken or name.startswith(RUN_LIST_PREFIXES):
        raise ModelError(f"output '{name}': runs of this model have '{name}' already; take another name")


class _OutputNames(SymbolsByName):
    """What may stand in the outputs of a model: its symbols, under their own names and those of its states; columns of runs."""

    def __init__(self, model: Any) -> None:
        states = {name: ca.SX.sym(name) for name in model.names}
        symbols = dict(zip(map(str, ca.vertsplit(model.state)), states.values(), strict=True))
        own = {str(symbol): symbol for symbol in ca.vertsplit(ca.vertcat(model.p, model.u))}
        rows = {name: ca.SX.sym(name) for name in model.row_names}
        columns = {*RUN_COLUMNS, *model.has, *(name.partition("[")[0] for name in rows)}
        super().__init__(
            {**rows, **symbols, **states, **own, str(model.t): ca.SX.sym("t")},
            lambda name: name in columns or ((entry := parse_entry_name(name)) is not None and entry[0] in columns),
        )

    def __iter__(self) -> Iterator[str]:
        """The names that a message lists."""
        return iter([*super().__iter__(), "l", "y"])
