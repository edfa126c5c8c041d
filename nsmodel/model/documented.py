"""What ``help`` says of a class of models: its own arguments and those of all classes, in its docstring and its signature."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

ATTRIBUTES_HEADING = "Attributes:\n"


def add_common_arguments(own: str | None, common: str | None) -> str | None:
    """The docstring of a class with the arguments of all classes behind its own; None where docstrings are left out."""
    if not own or not common or ATTRIBUTES_HEADING not in own or ATTRIBUTES_HEADING not in common:
        return own
    shared = common.partition(ATTRIBUTES_HEADING)[2].partition("\n\n")[0].rstrip()
    before, _, rest = own.partition(ATTRIBUTES_HEADING)
    attributes, gap, after = rest.partition("\n\n")
    return f"{before}{ATTRIBUTES_HEADING}{attributes.rstrip()}\n{shared}\n{gap[1:]}{after}"


class OwnArgumentsFirst:
    """The signature of a dataclass: the arguments of its own before those that it inherits, without defaults that say nothing."""

    def __get__(self, made: Any, owner: type) -> inspect.Signature:
        """Return it for ``inspect.signature``, which asks the class."""
        given = inspect.signature(owner.__init__)
        fields = {field.name: field for field in dataclasses.fields(owner)}
        own = {name for name in vars(owner).get("__annotations__", {}) if name in given.parameters}
        parameters = []
        for name, parameter in list(given.parameters.items())[1:]:
            made_new = fields[name].default_factory if name in fields else dataclasses.MISSING
            parameters.append(parameter if made_new is dataclasses.MISSING else parameter.replace(default=made_new()))
        parameters.sort(key=lambda parameter: parameter.name not in own)
        return given.replace(parameters=parameters)
