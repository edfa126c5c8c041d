"""A package whose names are imported when they are first asked for."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any


def later(package: str, names: Mapping[str, Sequence[str]]) -> None:
    """Let a package have names that are taken from its modules at their first use.

    A name may be that of a module too, as with the function ``simulate`` of the module ``simulate``: the function has it.

    Args:
        package: its ``__name__``.
        names: {module: names that are taken from it}.
    """
    module_of = {name: module for module, listed in names.items() for name in listed}

    class Package(ModuleType):
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

    sys.modules[package].__class__ = Package
