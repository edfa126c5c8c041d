"""Pickling and deep-copying of what holds CasADi expressions and frozen mappings: models, laws, families, reports.

An object and its parts are pickled in a stream of their own, in which a number stands for each expression; the expressions go
beside it, serialised together by CasADi: exactly, and symbols that are shared stay shared. Functions go by name.
"""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from functools import reduce
from types import FunctionType, MappingProxyType
from typing import Any, Self

import casadi as ca

from nsmodel.errors import UsageError
from nsmodel.model_files import MODULE_PREFIX, defined_in


class Picklable:
    """What can be pickled and deep-copied although it holds expressions and frozen mappings.

    A function in it must have a name to be found by in another process: that of a module, or of a model file, which is run there.
    """

    @property
    def made_of(self) -> Mapping[str, Any]:
        """Its parts by name: what tells it from others."""
        return vars(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle; UsageError for a function without such a name."""
        stream, serializer = io.BytesIO(), ca.StringSerializer()
        pickler = _ExpressionPickler(stream, protocol=pickle.HIGHEST_PROTOCOL)
        try:
            pickler.dump(self)
        except _UnnamedFunctionError as error:
            raise UsageError(_unnamed_function_message(self, error.function)) from None
        serializer.pack(pickler.expressions)
        return _unpickled, (stream.getvalue(), serializer.encode())

    def __copy__(self) -> Self:
        """Copy the object, not its parts."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the object and its parts, but for functions and symbols."""
        memo[id(self)] = other = copy(self)
        for name, value in vars(self).items():
            frozen = isinstance(value, MappingProxyType)
            part = deepcopy(dict(value) if frozen else value, memo)
            vars(other)[name] = MappingProxyType(part) if frozen else part
        return other


class _UnnamedFunctionError(Exception):
    def __init__(self, function: FunctionType) -> None:
        super().__init__(function.__qualname__)
        self.function = function


class _ExpressionPickler(pickle.Pickler):
    """Writes numbers in place of expressions, and keeps these."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.expressions: list[ca.SX] = []
        self._numbers: dict[int, int] = {}

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, ca.SX):
            return None
        number = self._numbers.setdefault(id(obj), len(self.expressions))
        if number == len(self.expressions):
            self.expressions.append(obj)
        return number

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, MappingProxyType):
            return _frozen, (dict(obj),)
        if isinstance(obj, Picklable):
            new = copyreg.__newobj__  # pyright: ignore[reportAttributeAccessIssue]
            return new, (type(obj),), vars(obj)
        return _reduce_by_file(obj) if isinstance(obj, FunctionType | type) else NotImplemented


class _ExpressionUnpickler(pickle.Unpickler):
    """Reads what `_ExpressionPickler` wrote."""

    def __init__(self, stream: io.BytesIO, expressions: Sequence[ca.SX]) -> None:
        super().__init__(stream)
        self._expressions = expressions

    def persistent_load(self, pid: int) -> ca.SX:
        return self._expressions[pid]


def _unpickled(stream: bytes, expressions: str) -> Any:
    return _ExpressionUnpickler(io.BytesIO(stream), ca.StringDeserializer(expressions).unpack()).load()


def _frozen(items: dict[Any, Any]) -> MappingProxyType:
    return MappingProxyType(items)


def _reduce_by_file(item: Any) -> Any:
    """How to find a function or class again that no import finds: one of a model file, or of a neighbour that it imported."""
    module = sys.modules.get(item.__module__)
    if module is not None and not item.__module__.startswith(MODULE_PREFIX) and _is_found_by_name(vars(module), item):
        return NotImplemented
    namespace = item.__globals__ if isinstance(item, FunctionType) else {} if module is None else vars(module)
    if "__file__" in namespace and _is_found_by_name(namespace, item):
        return defined_in, (namespace["__file__"], item.__qualname__)
    if isinstance(item, FunctionType):
        raise _UnnamedFunctionError(item)
    return NotImplemented


def _is_found_by_name(names: dict[str, Any], item: Any) -> bool:
    """Whether the item is what these names call by its own name."""
    first, *rest = item.__qualname__.split(".")
    return reduce(lambda found, name: getattr(found, name, None), rest, names.get(first)) is item


def _unnamed_function_message(owner: Picklable, function: FunctionType) -> str:
    parts = {name: [value, *getattr(value, "__dict__", {}).values()] for name, value in vars(owner).items()}
    label = next((name for name, held in parts.items() if any(part is function for part in held)), type(owner).__name__)
    code = function.__code__
    return (
        f"{label}: the function {function.__qualname__} ({code.co_filename}, line {code.co_firstlineno}) cannot be pickled: no "
        "other process finds it by its name; define it with def at the top level of a module or model file"
    )
