"""Where compiled steps are kept, without the generator of C: a first run, which finds none there, does not load it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import platformdirs

from nsmodel.errors import CodegenError

LIBRARY_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")  # Of shared libraries.


def cache_folder() -> Path:
    """Where compiled steps are kept, and may be deleted at any time: $XDG_CACHE_HOME/nsmodel, else what the system has for it.

    That is ~/.cache/nsmodel, on macOS ~/Library/Caches/nsmodel, on Windows the user's AppData/Local/nsmodel/Cache.

    Raises:
        CodegenError: there is no home.
    """
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        found = named / "nsmodel" if named.is_absolute() else platformdirs.user_cache_path("nsmodel", appauthor=False)
        return found if found.is_absolute() else Path.home() / ".cache" / "nsmodel"
    except RuntimeError as error:
        raise CodegenError(f"no folder to keep compiled steps in ({error}); name one with XDG_CACHE_HOME") from error


def is_cache_empty() -> bool:
    """Whether no compiled steps are kept."""
    try:
        return not any(cache_folder().glob(f"*{LIBRARY_SUFFIX}"))
    except (OSError, CodegenError):
        return True
