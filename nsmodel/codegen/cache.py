"""Compiled steps in the user's cache folder: one file each, named by what it was made from and by its own content.

What is loaded runs with the user's rights, so nothing is loaded that another user may have put there: the folder and the file
belong to this user, nobody else may write them, and neither is a link. At most MOST files are kept, those used last.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca

from nsmodel.cache_folder import LIBRARY_SUFFIX, cache_folder
from nsmodel.codegen.all_values import spec_for_all_values
from nsmodel.codegen.library import COMPILER_FLAGS, LANES_FLAGS, TIMEOUT, compile_library, loaded_library_paths
from nsmodel.codegen.scene import StepSpec, make_step_spec
from nsmodel.codegen.source import LibrarySource, write_source
from nsmodel.errors import CodegenError
from nsmodel.grid import TimeGrid
from nsmodel.identity import fingerprint, versions
from nsmodel.model.base import Model

STEP_NAME = "step"
MAX_LIBRARIES = 64  # Libraries that are kept; those that this process has loaded are kept besides.
BUILD_PREFIX = "building-"  # Folders of builds; one older than two builds can last was left behind by a process that was killed.
WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def cached_steps(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> Path:
    """The compiled steps of a bound model on a grid, built where they are not there, or not whole.

    Raises:
        CodegenError: the model has no C counterpart, the compiler fails, or the folder cannot be used.
    """

    def files() -> dict[str, str]:
        return _spec_source_texts(make_step_spec(model, None, grid, tolerance))

    return cached_library(steps_key(model, grid, tolerance, compiler), files, COMPILER_FLAGS)


def cached_steps_for_all(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> Path:
    """The same for all values of the parameters of a model.

    Raises:
        CodegenError: besides, where the code would depend on values (see `all_values`).
    """

    def files() -> dict[str, str]:
        return _spec_source_texts(spec_for_all_values(model, grid, tolerance))

    return cached_library(steps_key_for_all(model, grid, tolerance, compiler), files, COMPILER_FLAGS)


def cached_steps_in_lanes(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> Path:
    """The same with many runs in step (see `lanes`).

    Raises:
        CodegenError: as above; not asked for models that lanes refuse.
    """

    def files() -> dict[str, str]:
        return _source_texts(write_source(spec_for_all_values(model, grid, tolerance), STEP_NAME, "", in_lanes=True))

    return cached_library(library_key([steps_key_for_all(model, grid, tolerance, compiler), LANES_FLAGS]), files, LANES_FLAGS)


def _spec_source_texts(spec: StepSpec) -> dict[str, str]:
    return _source_texts(write_source(spec, STEP_NAME, ""))


def _source_texts(source: LibrarySource) -> dict[str, str]:
    return {"rollout.c": source.rollout, f"{STEP_NAME}.h": source.header, f"{STEP_NAME}.c": source.code}


def cached_library(key: str, files: Callable[[], Mapping[str, str]], flags: tuple[str, ...]) -> Path:
    """The library of a key, whose content must be part of its name; where there is none the first of the files is compiled.

    Raises:
        CodegenError: the compiler fails, or the folder cannot be used.
    """
    folder = cache_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_trusted(folder)
        for path in sorted(folder.glob(f"{key}-*{LIBRARY_SUFFIX}")):
            with contextlib.suppress(FileNotFoundError):  # another process has just removed it
                if _is_private_file(path) and path.name == _library_name(key, path):
                    os.utime(path)  # used last
                    return path
                path.unlink()  # cut short, changed, or put there by somebody else
        _evict_old_libraries(folder)
        with tempfile.TemporaryDirectory(dir=folder, prefix=BUILD_PREFIX) as place:
            return _build_library(Path(place), files(), folder, key, flags)
    except OSError as error:
        raise CodegenError(f"the cache folder {folder} cannot be used ({error}); name another with XDG_CACHE_HOME") from error


def is_cached(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> bool:
    """Whether ``cached`` finds the compiled steps; nothing is built or changed."""
    return has_cached_library(steps_key(model, grid, tolerance, compiler))


def is_cached_for_all(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> bool:
    """The same of ``cached_steps_for_all``."""
    return has_cached_library(steps_key_for_all(model, grid, tolerance, compiler))


def has_cached_library(key: str) -> bool:
    """Whether ``kept`` finds the library of a key, to the look of it."""
    try:
        return any(map(_is_private_file, cache_folder().glob(f"{key}-*{LIBRARY_SUFFIX}")))
    except (OSError, CodegenError):
        return False


def _check_trusted(folder: Path) -> None:
    """Refuse a folder in which another user may have put libraries.

    Raises:
        CodegenError: names the folder, what is wrong, and how to mend it.
    """
    if not hasattr(os, "geteuid"):
        return
    above, here = folder.parent.stat(), folder.lstat()
    another = "name another with XDG_CACHE_HOME"
    wrong = None
    if not stat.S_ISDIR(here.st_mode):
        wrong = f"it is a link, which may lead anywhere; remove it, or {another}"
    elif here.st_uid != os.geteuid():
        wrong = f"it belongs to another user (number {here.st_uid}, you are {os.geteuid()}); {another}"
    elif here.st_mode & WRITABLE_BY_OTHERS:
        wrong = f"others may write to it (mode {stat.S_IMODE(here.st_mode):o}); empty it and chmod 700 {folder}, or {another}"
    elif above.st_uid not in (0, os.geteuid()) or (above.st_mode & stat.S_IWOTH and not above.st_mode & stat.S_ISVTX):
        wrong = f"others may exchange it, as {folder.parent} is theirs to write; {another}"
    if wrong:
        raise CodegenError(f"the cache folder {folder} is not used, as what is loaded from it runs with your rights: {wrong}")


def _is_private_file(path: Path) -> bool:
    """Whether a library is a file of this user that nobody else may write, and no link."""
    found = path.lstat()
    own = not hasattr(os, "geteuid") or (found.st_uid == os.geteuid() and not found.st_mode & WRITABLE_BY_OTHERS)
    return stat.S_ISREG(found.st_mode) and own


def _evict_old_libraries(folder: Path) -> None:
    """Make room for one more library, and remove what killed builds have left; other processes may do the same."""
    loaded = loaded_library_paths()
    with contextlib.suppress(OSError):
        for path in folder.glob(f"{BUILD_PREFIX}*"):
            if time.time() - path.lstat().st_mtime > 2 * TIMEOUT:
                shutil.rmtree(path, ignore_errors=True)
        libraries = sorted(folder.glob(f"*{LIBRARY_SUFFIX}"), key=lambda path: path.lstat().st_mtime_ns, reverse=True)
        for path in [path for path in libraries if path not in loaded][MAX_LIBRARIES - 1 :]:
            with contextlib.suppress(OSError):  # another process has removed it, or has it loaded
                path.unlink()


def steps_key(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> str:
    """A hash of all that the compiled steps depend on; the end of the run is not part of it."""
    endless = grid if grid.steps is not None else replace(grid, last=grid.h)
    return library_key([fingerprint(model, endless), grid.step(0), grid.has_varying_steps, tolerance, *build_identity(compiler)])


def steps_key_for_all(model: Model, grid: TimeGrid, tolerance: float, compiler: str) -> str:
    """The same of a model whose parameters are symbols: their names and order count, no value does."""
    return library_key([steps_key(model, grid, tolerance, compiler), "all values", *map(str, ca.symvar(model.p))])


def build_identity(compiler: str) -> list[object]:
    """What a library depends on beside the model."""
    return [versions(), _package_hash(), compiler, COMPILER_FLAGS, platform.machine(), platform.system()]


def library_key(parts: list[object]) -> str:
    """A hash of what a library is made from."""
    return _short_hash(repr(parts).encode())


def _build_library(place: Path, files: Mapping[str, str], folder: Path, key: str, flags: tuple[str, ...]) -> Path:
    """Compile in ``place``; the library appears in ``folder`` whole, whoever else builds the same one."""
    for name, text in files.items():
        (place / name).write_text(text, encoding="utf-8")
    library = place / f"library{LIBRARY_SUFFIX}"
    compile_library(place / next(iter(files)), library, flags)
    library.chmod(0o700)
    named = folder / _library_name(key, library)
    try:
        return library.replace(named)
    except PermissionError:
        if not named.exists():
            raise
        return named  # the same, built by another process, which has it loaded


def _library_name(key: str, path: Path) -> str:
    return f"{key}-{_short_hash(path.read_bytes())}{LIBRARY_SUFFIX}"


@cache
def _package_hash() -> str:
    """A hash of nsmodel itself: what a changed one writes does not meet what an older one has built."""
    package = Path(__file__).parents[1]
    return _short_hash(b"\0".join(path.read_bytes() for path in sorted([*package.rglob("*.py"), *package.rglob("*.[ch]")])))


def _short_hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
