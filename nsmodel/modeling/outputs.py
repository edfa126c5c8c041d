"""``outputs=`` of a model: quantities that its runs have as further columns.

A quantity of a run: an expression whose symbols are columns, by their names, as a function of the values of these.

The exact state of a model, where its user knows it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError, NsmodelError, StorageError
from nsmodel.modeling.conversion import to_sx
from nsmodel.modeling.parameters import RESERVED_RUN_NAMES
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof.expression_graph import stack_column


class SymbolsByName(dict[str, ca.SX]):
    """{name: symbol} of all names that are ``known``, made when they are first asked for; to begin with those given."""

    def __init__(self, given: Mapping[str, ca.SX], known: Callable[[str], bool] = lambda name: True) -> None:
        super().__init__(given)
        self._known = known

    def __contains__(self, name: object) -> bool:
        """Whether there is, or may be, a symbol of this name."""
        return super().__contains__(name) or (isinstance(name, str) and self._known(name))

    def __missing__(self, name: str) -> ca.SX:
        """Make the symbol."""
        self[name] = ca.SX.sym(name)
        return self[name]


def read_column(value: Any, label: str, symbols: SymbolsByName, error: type[NsmodelError] = ModelError) -> ca.SX:
    """What a user wrote as a column of expressions; ``error`` for what is none."""
    try:
        expression = ca.densify(to_sx(value, symbols, label))
    except ModelError as found:
        raise error(str(found)) from None
    if 1 not in expression.shape:
        raise error(f"{label}: shape {expression.shape}; expected one expression or a column of them")
    return ca.vec(expression)


def _casadi_encoding(word: str) -> str:
    """A word as CasADi writes it: two letters from a to p a byte, the lower half first."""
    return "".join(chr(97 + half) for byte in word.encode() for half in (byte & 15, byte >> 4))


# Letters within which the kind of a function stands in CasADi's text of it, behind a version and a name of the file's kind.
_HEAD_LETTERS = 128
_EXPRESSION_KIND = _casadi_encoding("SXFunction")
_EXTERNAL_KINDS = tuple(map(_casadi_encoding, ("External", "Importer", "Library")))  # Kinds that load code from a path.


@dataclass(frozen=True)
class Quantity:
    """A function of the columns ``of`` (their names), of ``size`` entries; ``code``: it as text, which files hold."""

    of: tuple[str, ...]
    size: int
    code: str

    @classmethod
    def made(cls, expression: ca.SX) -> Self:
        """Of an expression (size, 1) whose symbols have the names of columns."""
        symbols = ca.symvar(expression)
        function = ca.Function("quantity", [stack_column(symbols)], [expression])
        return cls(tuple(symbol.name() for symbol in symbols), expression.numel(), function.serialize())

    @classmethod
    def named(cls, names: tuple[str, ...]) -> Self:
        """These columns themselves."""
        return cls.made(stack_column(ca.SX.sym(name) for name in names))

    @classmethod
    def from_text(cls, text: Mapping[str, Any]) -> Self:
        """What ``text`` gave; StorageError where it is not an expression, but code that CasADi would load from elsewhere."""
        code = text["code"]
        if _EXPRESSION_KIND not in code[:_HEAD_LETTERS] or any(word in code for word in _EXTERNAL_KINDS):
            raise StorageError(
                f"the quantity of {', '.join(text['of']) or 'no column'} is not a CasADi expression: it was changed"
            )
        return cls(tuple(text["of"]), int(text["size"]), code)

    @property
    def text(self) -> dict[str, Any]:
        """The quantity as JSON can hold it."""
        return {"of": list(self.of), "size": self.size, "code": self.code}

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Its values (K,), of several entries (K, size), where the columns have these values (K, columns)."""
        count = len(values)
        found = np.empty((count, self.size))
        if count:
            try:
                function = ca.Function.deserialize(self.code)
                found[:] = np.array(function.map(count)(values.T)).T
            except (RuntimeError, ValueError) as error:
                raise StorageError(f"the quantity of {', '.join(self.of)} cannot be evaluated: it was changed") from error
        return found[:, 0] if self.size == 1 else found


def parse_entry_name(name: str) -> tuple[str, int] | None:
    """(stem, i) of a name such as stem_0 or stem[0], the entries of a vector; else None."""
    found = re.fullmatch(r"(.+?)(?:_(\d+)|\[(\d+)\])", name)
    return None if found is None else (found[1], int(found[2] or found[3]))


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
    """Refuse what is not a name, or one that a run has already; ModelError."""
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


@dataclass(frozen=True, eq=False)
class SampledExactState(Picklable):
    """Expressions of t (n, 1) as a function of times: (N,) -> (N, n)."""

    t: ca.SX
    column: ca.SX

    def __call__(self, t: Any) -> np.ndarray:
        """Return the values at the times."""
        times = np.atleast_1d(np.asarray(t, float))
        values = ca.Function("exact", [self.t], [self.column]).map(len(times))(times[None, :])
        return np.array(values).reshape(self.column.numel(), -1).T
