"""The classes of models: a frozen descriptor each, by which the rest of the package finds what a class brings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from nsmodel.errors import ModelError


@dataclass(frozen=True)
class ModelClass:
    """A class of models.

    Attributes:
        folder: where it lives, beside this file.
        model: the name of its class, in ``model.py``.
    """

    folder: str
    model: str

    @property
    def type(self) -> Any:
        """The class itself."""
        return getattr(self.part("model"), self.model)

    def part(self, name: str) -> ModuleType:
        """A module of the folder: "model", "units", "judge", "hypotheses.check", ..."""
        return import_module(f"nsmodel.classes.{self.folder}.{name}")

    def optional(self, name: str) -> ModuleType | None:
        """A module that not every class has."""
        return self.part(name) if _module_exists(f"nsmodel.classes.{self.folder}.{name}") else None

    def scheme(self, name: str) -> ModuleType:
        """The module of a scheme, one of the type's ``schemes``."""
        return self.part(f"schemes.{name.replace(' ', '_').replace('-', '_')}")


@cache
def _module_exists(module: str) -> bool:
    return find_spec(module) is not None


CLASSES = (
    ModelClass("sweeping", "SweepingProcess"),
    ModelClass("oscillator", "FrictionOscillator"),
    ModelClass("first_order", "FirstOrderSystem"),
    ModelClass("lure", "LureSystem"),
    ModelClass("inclusion", "MonotoneInclusion"),
    ModelClass("bodies", "ManyBodies"),
)
_BY_NAME = {kind.model: kind for kind in CLASSES}


def class_named(name: str | None) -> ModelClass | None:
    """The descriptor of the class that a run names as its model's; None where that is none of this package."""
    return _BY_NAME.get(name or "")


def class_of(model: Any) -> ModelClass:
    """The descriptor of a model, or of its type.

    Raises:
        ModelError: the type is none of a class of this package.
    """
    kind = model if isinstance(model, type) else type(model)
    found = _BY_NAME.get(kind.__name__)
    if found is None or found.type is not kind:
        raise ModelError(f"{kind.__name__} is no class of models; expected one of {', '.join(_BY_NAME)}")
    return found
