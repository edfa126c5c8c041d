"""What follows from a model alone is computed once: models, and problems made of them, do not change."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

T = TypeVar("T", bound=Callable[..., Any])


def cached_per_object(function: T) -> T:
    """The function of an object that does not change, computed once for each object and forgotten with it.

    What it returns is shared: it must not be changed, nor hold on to the object.
    """
    known: dict[int, tuple[weakref.ref[Any], Any]] = {}

    @wraps(function)
    def cached(made: Any) -> Any:
        at = id(made)
        if at not in known or known[at][0]() is not made:
            value = function(made)
            known[at] = weakref.ref(made, lambda _: known.pop(at, None)), value
        return known[at][1]

    return cached  # pyright: ignore[reportReturnType]
