"""Pickling and deep-copying of what holds CasADi expressions and frozen mappings: models, laws, families, reports.

An object and its parts are pickled in a stream of their own, in which a number stands for each expression; the expressions go
beside it, serialised together by CasADi: exactly, and symbols that are shared stay shared. Functions go by name.

Python files that define models, run as modules of their own: what lies beside one can be imported while it runs.
"""

from __future__ import annotations

import contextlib
import copyreg
import importlib.util
import io
import pickle
import sys
from collections.abc import Iterator, Mapping, Sequence
from copy import copy, deepcopy
from functools import reduce
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FunctionType, MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, Self, cast

import casadi as ca

from nsmodel.errors import UsageError

if TYPE_CHECKING:
    from importlib.abc import Loader

MODULE_PREFIX = "nsmodel_file_"


def module_spec(path: Path, meant: str = "") -> ModuleSpec:
    """Where and under what name the file is run; UsageError where it is no Python file, which says what may be ``meant``."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        expected = meant or "give the path of a Python file that defines model = ... (nsmodel cases lists some)"
        raise UsageError(f"model file '{path}' {what}; {expected}")
    spec = importlib.util.spec_from_file_location(f"{MODULE_PREFIX}{path.stem}", path.absolute())
    if spec is None or spec.loader is None:
        raise UsageError(f"'{path}' is not a Python file (.py)")
    return spec


def current_path(path: Path) -> Path:
    """Return where a file lies now: each case of cases/ has moved into one of the folders there."""
    if path.is_file() or path.absolute().parent.name != "cases":
        return path
    return next((file for file in path.parent.glob("*/*.py") if file.name == path.name), path)


def execute_module(spec: ModuleSpec) -> ModuleType:
    """Run the file; whatever it raises comes out."""
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    with _without_bytecode():
        cast("Loader", spec.loader).exec_module(module)
    return module


@contextlib.contextmanager
def _without_bytecode() -> Iterator[None]:
    """Write no bytecode beside a user's files: it would outlive an edit within the second, and nobody asked for it."""
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = before


@contextlib.contextmanager
def folder_importable(path: Path) -> Iterator[None]:
    """Let the modules in the file's folder be imported inside; afterwards they are forgotten.

    So files in different folders may have neighbours of one name, each its own, and one that was edited is read again.
    """
    folder, before = path.absolute().parent, set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        with _without_bytecode():
            yield
    finally:
        sys.path.remove(str(folder))
        new = {name.partition(".")[0] for name in sys.modules} - before
        neighbours = {name for name in new if folder in _module_folders(sys.modules.get(name))}
        for name in [name for name in sys.modules if name.partition(".")[0] in neighbours]:
            del sys.modules[name]


def _module_folders(module: ModuleType | None) -> list[Path]:
    """The folders in which a module's file or a package's folder lies; none for a model file."""
    if module is None or module.__name__.startswith(MODULE_PREFIX):
        return []
    places = getattr(module, "__path__", None) or filter(None, [getattr(module, "__file__", None)])
    return [Path(place).absolute().parent for place in places]


def defined_in(path: str, name: str) -> Any:
    """What the file calls ``name`` ("f", or "Class.f"), from its last run in this process, else from a new one."""
    file = current_path(Path(path))
    spec = module_spec(file)
    found: Any = sys.modules.get(spec.name)
    if getattr(found, "__file__", None) != str(file):
        with folder_importable(file):
            found = execute_module(spec)
    for part in name.split("."):
        found = getattr(found, part)
    return found


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

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled of it."""
        return vars(self)

    def __copy__(self) -> Self:
        """Copy the object, not its parts."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the object and its parts, but for functions and symbols."""
        memo[id(self)] = other = copy(self)
        vars(other).update(deep_copies(vars(self), memo))
        return other


def deep_copies(parts: Mapping[str, Any], memo: dict[int, Any]) -> dict[str, Any]:
    """Deep copies of parts, by name, of which some may be frozen mappings."""
    copies = {name: deepcopy(dict(part) if isinstance(part, MappingProxyType) else part, memo) for name, part in parts.items()}
    return {
        name: MappingProxyType(copies[name]) if isinstance(part, MappingProxyType) else copies[name]
        for name, part in parts.items()
    }


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
            new = copyreg.__newobj__  # pyrefly: ignore[missing-attribute]
            return new, (type(obj),), obj.__getstate__()
        return _reduce_by_file(obj) if isinstance(obj, FunctionType | type) else NotImplemented


class _ExpressionUnpickler(pickle.Unpickler):
    """Reads what `_ExpressionPickler` wrote."""

    def __init__(self, stream: io.BytesIO, expressions: Sequence[ca.SX]) -> None:
        super().__init__(stream)
        self._expressions = expressions

    def persistent_load(self, pid: int) -> ca.SX:
        return self._expressions[pid]


PLAIN_PACKAGES = frozenset({"builtins", "casadi", "collections", "fractions", "nsmodel", "numpy", "scipy", "sympy", "types"})


class _PlainPickler(_ExpressionPickler):
    """Refuses objects of types that are neither of these packages nor of a model file: another process may have no such type."""

    def reducer_override(self, obj: Any) -> Any:
        of = obj if isinstance(obj, type) else type(obj)
        if of.__module__.partition(".")[0] not in PLAIN_PACKAGES and not of.__module__.startswith(MODULE_PREFIX):
            raise pickle.PicklingError(f"{of.__qualname__} is of {of.__module__}")
        return super().reducer_override(obj)


def is_plain(item: Any) -> bool:
    """Whether all that the item holds can be pickled, and read where only nsmodel is known."""
    try:
        _PlainPickler(io.BytesIO(), protocol=pickle.HIGHEST_PROTOCOL).dump(item)
    except Exception:  # Whatever an object of the user's raises: it stays here.
        return False
    return True


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
