"""Where the models of a sweep come from: one model, a file, or a function of what varies."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.later import former_names
from nsmodel.loader import load, load_with_values, model_arguments
from nsmodel.model.arguments import describe_argument
from nsmodel.model.base import Model


class ModelSource:
    """A model, the path of a model file, or a function that returns a model.

    Raises:
        UsageError: it is none of them, or a file that is not there.
    """

    def __init__(self, given: Any) -> None:
        self._given = Path(given) if isinstance(given, str) else given
        if isinstance(self._given, Model):
            self._takes: tuple[str, ...] | None = ()
        elif isinstance(self._given, Path):
            self._takes = model_arguments(self._given)
        elif callable(given) and not isinstance(given, type):
            kinds = inspect.signature(given).parameters
            self._takes = None if any(p.kind is p.VAR_KEYWORD for p in kinds.values()) else tuple(kinds)
        else:
            raise UsageError(
                f"expected a model, the path of a model file, or a function that returns a model, not {describe_argument(given)}"
            )

    def has_argument(self, name: str) -> bool:
        """Whether its function has an argument of this name."""
        return self._takes is None or name in self._takes

    def model(self, arguments: Mapping[str, Any]) -> Model:
        """The model for values of arguments.

        Raises:
            ModelError, UsageError: there is none for these.
        """
        if isinstance(self._given, Model):
            return self._given
        if isinstance(self._given, Path):
            return load(self._given, **arguments)
        name = getattr(self._given, "__name__", "model")
        try:
            found = self._given(**arguments)
        except NsmodelError:
            raise
        except Exception as error:
            raise ModelError(f"{name}() raised {type(error).__name__}: {error}") from error
        if not isinstance(found, Model):
            raise ModelError(f"{name}() returned {describe_argument(found)}; expected one of nsmodel's models")
        return found

    def raise_unknown_name(self, name: str, model: Model) -> None:
        """Raise UsageError for a name that is neither an argument nor a parameter, and say how to make it one."""
        if isinstance(self._given, Path):
            load_with_values(self._given, {name: 0.0})
        model.values_of({name: 0.0})
        raise UsageError(f"'{name}' cannot be varied")


__getattr__ = former_names(__name__, Source="ModelSource")
