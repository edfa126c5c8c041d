"""Where compiled steps are kept, without the generator of C: a first run, which finds none there, does not load it."""

from __future__ import annotations

import os
from pathlib import Path

from nsmodel.errors import CodegenError


def cache_folder() -> Path:
    """Where compiled steps are kept, and may be deleted at any time: $XDG_CACHE_HOME/nsmodel, else ~/.cache/nsmodel.

    Raises:
        CodegenError: there is no home.
    """
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (named if named.is_absolute() else Path.home() / ".cache") / "nsmodel"
    except RuntimeError as error:
        raise CodegenError(f"no folder to keep compiled steps in ({error}); name one with XDG_CACHE_HOME") from error


def is_empty() -> bool:
    """Whether no compiled steps are kept."""
    try:
        return not any(cache_folder().glob("*.so"))
    except (OSError, CodegenError):
        return True
