"""A quantity of a run: an expression whose symbols are columns, by their names, as a function of the values of these."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError, NsmodelError, StorageError
from nsmodel.later import former_names
from nsmodel.model.convert import to_sx
from nsmodel.proof.graph import stack_column


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


_HEAD_LETTERS = 128  # Letters within which the kind of a function stands.
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
        """What ``text`` gave; StorageError where it is no expression, but code that CasADi would load from elsewhere."""
        code = text["code"]
        if _EXPRESSION_KIND not in code[:_HEAD_LETTERS] or any(word in code for word in _EXTERNAL_KINDS):
            raise StorageError(
                f"the quantity of {', '.join(text['of']) or 'no column'} is no expression of CasADi: it was changed"
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


__getattr__ = former_names(__name__, ByName="SymbolsByName")
