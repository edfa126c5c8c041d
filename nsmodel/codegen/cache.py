"""Compiled steps in the user's cache folder: one file each, named by what it was made from and by its own content."""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from nsmodel.codegen.library import FLAGS, compile_library
from nsmodel.codegen.scene import make_scene
from nsmodel.codegen.source import write_source
from nsmodel.errors import CodegenError
from nsmodel.grid import Grid
from nsmodel.identity import fingerprint, versions
from nsmodel.model.base import Model

NAME = "step"


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


def cached(model: Model, grid: Grid, tolerance: float, compiler: str) -> Path:
    """The compiled steps of a bound model on a grid, built where they are not there, or not whole.

    Raises:
        CodegenError: the model has no C counterpart, the compiler fails, or the folder cannot be used.
    """

    def files() -> dict[str, str]:
        source = write_source(make_scene(model, None, grid, grid.steps is not None, tolerance), NAME, "")
        return {"rollout.c": source.rollout, f"{NAME}.h": source.header, f"{NAME}.c": source.code}

    return kept(key_of(model, grid, tolerance, compiler), files, FLAGS)


def kept(key: str, files: Callable[[], Mapping[str, str]], flags: tuple[str, ...]) -> Path:
    """The library of a key, whose content must be part of its name; where there is none the first of the files is compiled.

    Raises:
        CodegenError: the compiler fails, or the folder cannot be used.
    """
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(folder.glob(f"{key}-*.so")):
            if path.name == _name(key, path):
                return path
            path.unlink()  # cut short, or changed
        with tempfile.TemporaryDirectory(dir=folder, prefix="building-") as place:
            return _built(Path(place), files(), folder, key, flags)
    except OSError as error:
        raise CodegenError(f"the cache folder {folder} cannot be used ({error}); name another with XDG_CACHE_HOME") from error


def key_of(model: Model, grid: Grid, tolerance: float, compiler: str) -> str:
    """A hash of all that the compiled steps depend on; the end of the run is not part of it."""
    varies = grid.steps is not None
    endless = grid if varies else replace(grid, last=grid.h)
    made_by = [versions(), _own(), compiler, FLAGS, platform.machine(), platform.system()]
    return key_for([fingerprint(model, endless), grid.step(0), varies, tolerance, *made_by])


def key_for(parts: list[object]) -> str:
    """A hash of what a library is made from."""
    return _hash(repr(parts).encode())


def _built(place: Path, files: Mapping[str, str], folder: Path, key: str, flags: tuple[str, ...]) -> Path:
    """Compile in ``place``; the library appears in ``folder`` whole, whoever else builds the same one."""
    for name, text in files.items():
        (place / name).write_text(text, encoding="utf-8")
    library = place / "library.so"
    compile_library(place / next(iter(files)), library, flags)
    return library.replace(folder / _name(key, library))


def _name(key: str, path: Path) -> str:
    return f"{key}-{_hash(path.read_bytes())}.so"


@cache
def _own() -> str:
    """A hash of nsmodel itself: what a changed one writes does not meet what an older one has built."""
    package = Path(__file__).parents[1]
    return _hash(b"\0".join(path.read_bytes() for path in sorted([*package.rglob("*.py"), *package.rglob("*.[ch]")])))


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
