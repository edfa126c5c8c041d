"""What may be missing in general and is there where it is asked for."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def not_none(value: T | None) -> T:
    """Return the value; LookupError where it is missing, which is a defect of the caller."""
    if value is None:
        raise LookupError("a value that was to be there is missing")
    return value
