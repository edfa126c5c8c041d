"""A generated library in Python: built with the machine's C compiler, loaded with ctypes."""

from __future__ import annotations

import _ctypes
import contextlib
import ctypes
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import Any

from nsmodel.cache_folder import LIBRARY_SUFFIX
from nsmodel.codegen.solver import Solver
from nsmodel.errors import CodegenError

SHARED_FLAGS = (
    ("-shared", "-static-libgcc") if LIBRARY_SUFFIX == ".dll" else ("-fPIC", "-shared")
)  # MinGW's code can lie anywhere.
COMPILER_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-Werror=implicit-function-declaration", *SHARED_FLAGS)
# For this processor alone; not on Windows, where gcc does not align the stack for its longest vectors.
NATIVE_FLAGS = (
    () if LIBRARY_SUFFIX == ".dll" else ("-mcpu=native" if platform.machine() in ("arm64", "aarch64") else "-march=native",)
)
MATH_LIBRARIES = () if LIBRARY_SUFFIX == ".dll" else ("-lm",)  # Where functions like exp are.
FAST_BUILD_FLAGS = ("-fno-gcse", "-fno-inline-functions", "-fno-partial-inlining", "-fno-schedule-insns2")  # Slow to build.
LANES_FLAGS = (
    *COMPILER_FLAGS,
    "-ftree-vectorize",
    "-fopenmp-simd",
    "-fno-trapping-math",
    *FAST_BUILD_FLAGS,
)  # None of these changes a bit.
COMPILERS = ("cc", "gcc", "clang")
TIMEOUT = 600.0  # Seconds that a compiler may take.


def compiler() -> str | None:
    """The C compiler: the one that CC names, else cc, gcc or clang, whichever is there; None where there is none."""
    named = os.environ.get("CC", "").strip()
    for name in [named] if named else COMPILERS:
        if shutil.which(name.split()[0]):
            return name
    return None


def no_compiler_error() -> CodegenError:
    """The error where ``compiler`` gives None."""
    named = os.environ.get("CC", "").strip()
    missing = f"CC names {named}, which is not there" if named else f"none of {', '.join(COMPILERS)}"
    return CodegenError(
        f"no C compiler was found ({missing}); install one (apt install gcc; xcode-select --install; on Windows MinGW-w64)"
    )


def compile_library(source: Path, target: Path, flags: tuple[str, ...] = COMPILER_FLAGS) -> None:
    """Compile one C file into a shared library; ``target`` appears whole or not at all.

    Raises:
        CodegenError: there is no compiler, or it fails.
    """
    name = compiler()
    if name is None:
        raise no_compiler_error()
    try:
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            built = Path(folder) / target.name
            command = [*name.split(), *flags, "-o", str(built), str(source), *MATH_LIBRARIES]
            status, errors = _run_compiler(command)
            if status:
                raise CodegenError(f"{name} could not compile {source.name}: {_first_error(status, errors)}")
            built.replace(target)
    except OSError as error:
        raise CodegenError(f"{target} could not be built with {name} ({error}); its folder must be writable") from error


def _run_compiler(command: list[str]) -> tuple[int, str]:
    """Exit status and errors of a compiler; it and all that it has started end with this call.

    Raises:
        CodegenError: it takes longer than TIMEOUT.
    """
    silenced = subprocess.DEVNULL
    with subprocess.Popen(
        command, text=True, errors="replace", start_new_session=True, stdin=silenced, stdout=silenced, stderr=subprocess.PIPE
    ) as process:
        try:
            errors = process.communicate(timeout=TIMEOUT)[1]
            return process.returncode, errors
        except BaseException as error:  # Ctrl-C too: a group of its own does not hear it.
            with contextlib.suppress(OSError, AttributeError):
                os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            if isinstance(error, subprocess.TimeoutExpired):
                raise CodegenError(
                    f"the compiler did not end within {TIMEOUT:g} s and was stopped: {' '.join(command)}"
                ) from error
            raise


def _first_error(status: int, errors: str) -> str:
    """What the compiler complains of first."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[0] if lines else f"exit status {status}")


class MappedLibrary(ctypes.CDLL):
    """A library in memory, which goes when nothing refers to it; each of its functions, asked for by ``[name]``, does.

    Systems know libraries by their paths, and some let no file be changed that is loaded: the path must name the content.
    """

    def __init__(self, path: Path) -> None:
        """Load the library at ``path``; OSError where that fails."""
        self.path, self.closed = path, True
        super().__init__(str(path.resolve()))
        self.closed = False
        _LOADED_LIBRARIES.add(self)

    def __del__(self) -> None:
        """Unload it, but not while Python ends and others may still call it."""
        close = getattr(_ctypes, "dlclose", None) or getattr(_ctypes, "FreeLibrary", None)
        if not self.closed and close is not None and not sys.is_finalizing():
            self.closed = True
            close(self._handle)


_LOADED_LIBRARIES: weakref.WeakSet[MappedLibrary] = weakref.WeakSet()


def loaded_library_paths() -> set[Path]:
    """The files of the libraries that are loaded."""
    return {library.path for library in _LOADED_LIBRARIES}


def load(folder: str | Path) -> Library:
    """Build (where it is not built yet) and load the library that ``nsmodel codegen`` wrote into ``folder``.

    It is built there, under a name that has a hash of its code; what was built from other code goes, unless it is loaded.

    Raises:
        CodegenError: no library there, no compiler, or it fails.
    """
    folder = Path(folder)
    found = [path for path in sorted(folder.glob("*.json")) if is_library(path) and path.with_suffix(".c").exists()]
    if len(found) != 1:
        raise CodegenError(
            f"{folder} has {len(found) or 'no'} libraries; expected one NAME.json beside NAME.c, as nsmodel codegen writes them"
        )
    about = json.loads(found[0].read_bytes())
    name, source = about["name"], found[0].with_suffix(".c")
    code = b"\0".join(path.read_bytes() for path in sorted(folder.glob(f"{name}.[ch]")))
    built = folder / f"lib{name}-{hashlib.sha256(code).hexdigest()[:24]}{LIBRARY_SUFFIX}"
    if not built.exists():
        compile_library(source, built)
        for old in set(folder.glob(f"lib{name}-*{LIBRARY_SUFFIX}")) - {built} - loaded_library_paths():
            with contextlib.suppress(OSError):
                old.unlink()
    return Library(built, about)


def is_library(path: Path) -> bool:
    """Whether ``path`` is the NAME.json of a library that ``nsmodel codegen`` wrote."""
    try:
        about = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(about, dict) and about.get("name") == path.stem and {"sizes", "model_hash"} <= about.keys()


class Library:
    """A loaded library; ``solver()`` makes a solver."""

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        """Load the library at ``path``; ``about`` is its NAME.json."""
        self.path, self.about = path, about
        try:
            self.mapped = MappedLibrary(path)
        except OSError as error:
            raise CodegenError(f"{path} could not be loaded ({error}); remove it, and it is built again") from error

    def function(self, name: str, result: Any, *arguments: Any) -> Any:
        """An exported function by its name without prefix.

        Raises:
            CodegenError: the library has no such function.
        """
        try:
            found = self.mapped[f"{self.about['name']}_{name}"]
        except AttributeError:
            raise CodegenError(f"the library {self.about['name']} has no function {name}: its model has no use for it") from None
        found.restype, found.argtypes = result, list(arguments)
        return found

    def solver(self) -> Solver:
        """Return a new solver at the model's start."""
        return Solver(self)

    def status_text(self, status: int) -> str:
        """What a status means."""
        return self.function("status_text", ctypes.c_char_p, ctypes.c_int)(status).decode()
