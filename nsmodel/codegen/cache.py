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

from nsmodel.cache_folder import SUFFIX, cache_folder
from nsmodel.codegen.all_values import all_values
from nsmodel.codegen.library import FLAGS, IN_LANES, TIMEOUT, compile_library, in_use
from nsmodel.codegen.scene import Scene, make_scene
from nsmodel.codegen.source import Source, write_source
from nsmodel.errors import CodegenError
from nsmodel.grid import Grid
from nsmodel.identity import fingerprint, versions
from nsmodel.model.base import Model

NAME = "step"
MOST = 64  # Libraries that are kept; those that this process has loaded are kept besides.
BUILDING = "building-"  # Folders of builds; one older than two builds can last was left behind by a process that was killed.
OTHERS = stat.S_IWGRP | stat.S_IWOTH


def cached(model: Model, grid: Grid, tolerance: float, compiler: str) -> Path:
    """The compiled steps of a bound model on a grid, built where they are not there, or not whole.

    Raises:
        CodegenError: the model has no C counterpart, the compiler fails, or the folder cannot be used.
    """

    def files() -> dict[str, str]:
        return _files(make_scene(model, None, grid, tolerance))

    return kept(key_of(model, grid, tolerance, compiler), files, FLAGS)


def cached_for_all(model: Model, grid: Grid, tolerance: float, compiler: str) -> Path:
    """The same for all values of the parameters of a model.

    Raises:
        CodegenError: besides, where the code would depend on values (see `all_values`).
    """

    def files() -> dict[str, str]:
        return _files(all_values(model, grid, tolerance))

    return kept(key_for_all(model, grid, tolerance, compiler), files, FLAGS)


def cached_in_lanes(model: Model, grid: Grid, tolerance: float, compiler: str) -> Path:
    """The same with many runs in step (see `lanes`).

    Raises:
        CodegenError: as above; not asked for models that lanes refuse.
    """

    def files() -> dict[str, str]:
        return _texts(write_source(all_values(model, grid, tolerance), NAME, "", in_lanes=True))

    return kept(key_for([key_for_all(model, grid, tolerance, compiler), IN_LANES]), files, IN_LANES)


def _files(scene: Scene) -> dict[str, str]:
    return _texts(write_source(scene, NAME, ""))


def _texts(source: Source) -> dict[str, str]:
    return {"rollout.c": source.rollout, f"{NAME}.h": source.header, f"{NAME}.c": source.code}


def kept(key: str, files: Callable[[], Mapping[str, str]], flags: tuple[str, ...]) -> Path:
    """The library of a key, whose content must be part of its name; where there is none the first of the files is compiled.

    Raises:
        CodegenError: the compiler fails, or the folder cannot be used.
    """
    folder = cache_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_untrusted(folder)
        for path in sorted(folder.glob(f"{key}-*{SUFFIX}")):
            with contextlib.suppress(FileNotFoundError):  # another process has just removed it
                if _own_file(path) and path.name == _name(key, path):
                    os.utime(path)  # used last
                    return path
                path.unlink()  # cut short, changed, or put there by somebody else
        _tidy(folder)
        with tempfile.TemporaryDirectory(dir=folder, prefix=BUILDING) as place:
            return _built(Path(place), files(), folder, key, flags)
    except OSError as error:
        raise CodegenError(f"the cache folder {folder} cannot be used ({error}); name another with XDG_CACHE_HOME") from error


def is_cached(model: Model, grid: Grid, tolerance: float, compiler: str) -> bool:
    """Whether ``cached`` finds the compiled steps; nothing is built or changed."""
    return is_kept(key_of(model, grid, tolerance, compiler))


def is_cached_for_all(model: Model, grid: Grid, tolerance: float, compiler: str) -> bool:
    """The same of ``cached_for_all``."""
    return is_kept(key_for_all(model, grid, tolerance, compiler))


def is_kept(key: str) -> bool:
    """Whether ``kept`` finds the library of a key, to the look of it."""
    try:
        return any(map(_own_file, cache_folder().glob(f"{key}-*{SUFFIX}")))
    except (OSError, CodegenError):
        return False


def _refuse_untrusted(folder: Path) -> None:
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
    elif here.st_mode & OTHERS:
        wrong = f"others may write to it (mode {stat.S_IMODE(here.st_mode):o}); empty it and chmod 700 {folder}, or {another}"
    elif above.st_uid not in (0, os.geteuid()) or (above.st_mode & stat.S_IWOTH and not above.st_mode & stat.S_ISVTX):
        wrong = f"others may exchange it, as {folder.parent} is theirs to write; {another}"
    if wrong:
        raise CodegenError(f"the cache folder {folder} is not used, as what is loaded from it runs with your rights: {wrong}")


def _own_file(path: Path) -> bool:
    """Whether a library is a file of this user that nobody else may write, and no link."""
    found = path.lstat()
    own = not hasattr(os, "geteuid") or (found.st_uid == os.geteuid() and not found.st_mode & OTHERS)
    return stat.S_ISREG(found.st_mode) and own


def _tidy(folder: Path) -> None:
    """Make room for one more library, and remove what killed builds have left; other processes may do the same."""
    loaded = in_use()
    with contextlib.suppress(OSError):
        for path in folder.glob(f"{BUILDING}*"):
            if time.time() - path.lstat().st_mtime > 2 * TIMEOUT:
                shutil.rmtree(path, ignore_errors=True)
        libraries = sorted(folder.glob(f"*{SUFFIX}"), key=lambda path: path.lstat().st_mtime_ns, reverse=True)
        for path in [path for path in libraries if path not in loaded][MOST - 1 :]:
            with contextlib.suppress(OSError):  # another process has removed it, or has it loaded
                path.unlink()


def key_of(model: Model, grid: Grid, tolerance: float, compiler: str) -> str:
    """A hash of all that the compiled steps depend on; the end of the run is not part of it."""
    endless = grid if grid.steps is not None else replace(grid, last=grid.h)
    return key_for([fingerprint(model, endless), grid.step(0), grid.varies, tolerance, *made_by(compiler)])


def key_for_all(model: Model, grid: Grid, tolerance: float, compiler: str) -> str:
    """The same of a model whose parameters are symbols: their names and order count, no value does."""
    return key_for([key_of(model, grid, tolerance, compiler), "all values", *map(str, ca.symvar(model.p))])


def made_by(compiler: str) -> list[object]:
    """What a library depends on beside the model."""
    return [versions(), _own(), compiler, FLAGS, platform.machine(), platform.system()]


def key_for(parts: list[object]) -> str:
    """A hash of what a library is made from."""
    return _hash(repr(parts).encode())


def _built(place: Path, files: Mapping[str, str], folder: Path, key: str, flags: tuple[str, ...]) -> Path:
    """Compile in ``place``; the library appears in ``folder`` whole, whoever else builds the same one."""
    for name, text in files.items():
        (place / name).write_text(text, encoding="utf-8")
    library = place / f"library{SUFFIX}"
    compile_library(place / next(iter(files)), library, flags)
    library.chmod(0o700)
    named = folder / _name(key, library)
    try:
        return library.replace(named)
    except PermissionError:
        if not named.exists():
            raise
        return named  # the same, built by another process, which has it loaded


def _name(key: str, path: Path) -> str:
    return f"{key}-{_hash(path.read_bytes())}{SUFFIX}"


@cache
def _own() -> str:
    """A hash of nsmodel itself: what a changed one writes does not meet what an older one has built."""
    package = Path(__file__).parents[1]
    return _hash(b"\0".join(path.read_bytes() for path in sorted([*package.rglob("*.py"), *package.rglob("*.[ch]")])))


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
