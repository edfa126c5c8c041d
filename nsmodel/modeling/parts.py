r"""What the classes of models bring to the rest of the package: typed parts, each asked for by the module that needs it.

A module declares what it needs, ``EQUATIONS = Part[Callable[[Any], list[str]]]("documents.equations")``, and asks
``EQUATIONS.of(model)``: it is ``equations`` in the module ``documents`` of the package of the class. ``grep 'Part\['`` lists all
parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Generic, TypeVar

from nsmodel.errors import ModelError

MODEL_CLASSES = {  # Class of models: its package.
    "SweepingProcess": "nsmodel.models.sweeping_process",
    "FrictionOscillator": "nsmodel.models.friction_oscillator",
    "FirstOrderSystem": "nsmodel.models.first_order_system",
    "LureSystem": "nsmodel.models.lure_system",
    "MonotoneInclusion": "nsmodel.models.monotone_inclusion",
    "ManyBodies": "nsmodel.models.many_bodies",
    "MechanicalSystem": "nsmodel.models.mechanical_system",
}

T = TypeVar("T")


@dataclass(frozen=True)
class Part(Generic[T]):
    """What a module of the package needs of a class of models.

    Attributes:
        name: "module.name", in the package of the class; of a part made of several modules the name of the function in
            ``__init__.py`` that makes it.
    """

    name: str

    def of(self, model: Any) -> T:
        """Return the part of the class of a model, or of a class.

        Raises:
            ModelError: the type is none of a class of this package, or its class lacks the part.
        """
        found = self.optional(model)
        if found is None:
            raise ModelError(f"{_class_name(model)} has no part '{self.name}': define it in {_package_of(model)}")
        return found

    def optional(self, model: Any) -> T | None:
        """Return the part of the class of a model, or of a class; None where its class lacks it.

        Raises:
            ModelError: the type is none of a class of this package.
        """
        return _read_part(_package_of(model), self.name)


@cache
def _read_part(package: str, name: str) -> Any:
    module, _, own = f"{package}.{name}".rpartition(".")
    part: Any = getattr(import_module(module), own, None) if find_spec(module) else None
    return part() if module == package else part


def class_named(name: str | None) -> Any:
    """Return the class of models that a run names as its model's; None where no class here has the name."""
    return _read_part(MODEL_CLASSES[name], f"model.{name}") if name in MODEL_CLASSES else None


def _class_name(model: Any) -> str:
    return (model if isinstance(model, type) else type(model)).__name__


def _package_of(model: Any) -> str:
    kind = model if isinstance(model, type) else type(model)
    package = MODEL_CLASSES.get(kind.__name__, "")
    if not package or kind.__module__ != f"{package}.model":
        raise ModelError(f"{kind.__name__} is not a class of models; expected one of {', '.join(MODEL_CLASSES)}")
    return package
