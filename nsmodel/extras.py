"""Packages that not everybody needs, imported when something asks for them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from nsmodel.errors import MissingExtraError


def import_extra(package: str) -> Any:
    """Return the package, which has an extra of its name; MissingExtraError where it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingExtraError(f"{package} is not installed; pip install 'nsmodel[{package}]'") from error
