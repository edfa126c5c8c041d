"""Python files that define models, run as modules of their own: what lies beside one can be imported while it runs."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

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
    spec = module_spec(Path(path))
    found: Any = sys.modules.get(spec.name)
    if getattr(found, "__file__", None) != path:
        with folder_importable(Path(path)):
            found = execute_module(spec)
    for part in name.split("."):
        found = getattr(found, part)
    return found
