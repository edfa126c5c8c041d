"""Names of a module that are imported at their first use, and names that it had."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any


def lazy_attributes(package: str, names: Mapping[str, Sequence[str]]) -> None:
    """Let a package have names that are taken from its modules at their first use.

    A name may be that of a module too, as with the function ``simulate`` of the module ``simulate``: the function has it.

    Args:
        package: its ``__name__``.
        names: {module: names that are taken from it}.
    """
    module_of = {name: module for module, listed in names.items() for name in listed}

    class LazyPackage(ModuleType):
        def __getattr__(self, name: str) -> Any:
            if name not in module_of:
                raise AttributeError(f"module {package!r} has no attribute {name!r}")
            value = vars(self)[name] = getattr(import_module(module_of[name]), name)
            return value

        def __setattr__(self, name: str, value: Any) -> None:
            if not (name in module_of and isinstance(value, ModuleType)):  # the import of a module puts it into its package
                super().__setattr__(name, value)

        def __dir__(self) -> list[str]:
            return sorted({*vars(self), *module_of})

    sys.modules[package].__class__ = LazyPackage


def former_names(module: str, **names: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a module for names that it had: pickles of earlier versions find what they name.

    Args:
        module: its ``__name__``.
        names: {former name: name}.
    """

    def __getattr__(name: str) -> Any:
        if name in names:
            return getattr(sys.modules[module], names[name])
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return __getattr__
