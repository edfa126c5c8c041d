"""The classes of models: a frozen descriptor each, by which the rest of the package finds what a class brings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
        schemes: the modules of ``schemes/`` by name; the first is used where none is asked for.
    """

    folder: str
    model: str
    schemes: Mapping[str, str]

    @property
    def type(self) -> Any:
        """The class itself."""
        return getattr(self.part("model"), self.model)

    def part(self, name: str) -> ModuleType:
        """A module of the folder: "model", "units", "judge", "hypotheses.check", ..."""
        return import_module(f"nsmodel.classes.{self.folder}.{name}")

    def optional(self, name: str) -> ModuleType | None:
        """A module that not every class has."""
        return self.part(name) if find_spec(f"nsmodel.classes.{self.folder}.{name}") else None

    def scheme(self, name: str | None = None) -> ModuleType:
        """The module of a scheme."""
        return self.part(f"schemes.{self.schemes[name or next(iter(self.schemes))]}")


CLASSES = (
    ModelClass("sweeping", "SweepingProcess", {"prediction-correction": "prediction_correction"}),
    ModelClass("oscillator", "FrictionOscillator", {"inertial proximal": "inertial_proximal"}),
    ModelClass("first_order", "FirstOrderSystem", {"theta-gamma": "theta_gamma"}),
    ModelClass("lure", "LureSystem", {"theta-gamma": "implicit_euler"}),
    ModelClass("inclusion", "MonotoneInclusion", {"catching-up": "catching_up"}),
    ModelClass("bodies", "ManyBodies", {"prediction-correction": "many_bodies"}),
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
