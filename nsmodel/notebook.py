"""What a notebook asks of results: their HTML, and whether there is one at all."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def html_repr(name: str) -> Callable[[Any], str]:
    """The ``_repr_html_`` of a class: the function ``html`` of a module of `nsmodel.rich`, imported at first use."""

    def _repr_html_(self: Any) -> str:
        """Return it as HTML, for notebooks."""
        return import_module(f"nsmodel.rich.{name}").html(self)

    return _repr_html_


def has_live_display() -> bool:
    """Whether somebody sees what is written over itself on standard error: at a terminal, or in a notebook."""
    return sys.stderr.isatty() or in_notebook()


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None
