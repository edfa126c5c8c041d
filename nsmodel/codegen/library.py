"""A generated library in Python: built with the machine's C compiler, loaded with ctypes.

A solver of a generated library in Python.

Compiled steps in the user's cache folder: one file each, named by what it was made from and by its own content.

What is loaded runs with the user's rights, so nothing is loaded that another user may have put there: the folder and the file
belong to this user, nobody else may write them, and neither is a link. At most MAX_LIBRARIES files are kept, those used last.
"""

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
import stat
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.codegen.source import write_source
from nsmodel.codegen.step_spec import StepSpec, make_step_spec, spec_for_all_values
from nsmodel.errors import CodegenError
from nsmodel.files.cache_folder import LIBRARY_SUFFIX, cache_folder
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import fingerprint, versions
from nsmodel.modeling.time_grid import TimeGrid

DOUBLES = ctypes.POINTER(ctypes.c_double)


class Solver:
    """One solver of a library: the C interface with arrays.

    ``step`` and the setters return a status as in C: 0 done; else see ``library.status_text``, and nothing has changed. Arrays
    of a wrong size, and functions that the library does not have, raise CodegenError. Solvers are independent: threads may
    step different ones at the same time.
    """

    def __init__(self, library: Library) -> None:
        """Allocate and initialise: the start, step and parameters of the model."""
        self.library, sizes = library, library.about["sizes"]
        self._nx, self._nl, self._m = sizes["NX"], sizes["NL"], sizes["M"]
        self._np, self._nu = sizes["NP"], sizes.get("NU", 0)
        self._nz, self._nw = sizes.get("NZ", 0), sizes.get("NW", 0)
        self._address: ctypes.c_void_p | None = ctypes.c_void_p(library.function("create", ctypes.c_void_p)())
        if not self._address.value:
            raise CodegenError(f"{library.about['name']}: no memory for a solver")

    def __del__(self) -> None:
        """Free the memory."""
        if getattr(self, "_address", None) and not self.library.mapped.closed:  # garbage goes in any order
            self.library.function("free", None, ctypes.c_void_p)(self._address)
            self._address = None

    def _call(self, name: str, *values: Any) -> int:
        kinds = [DOUBLES if isinstance(value, np.ndarray) else ctypes.c_double for value in values]
        given = [value.ctypes.data_as(DOUBLES) if isinstance(value, np.ndarray) else value for value in values]
        return self.library.function(name, ctypes.c_int, ctypes.c_void_p, *kinds)(self._address, *given)

    def _set(self, name: str, value: Any, size: int) -> int:
        array = np.ascontiguousarray(value, float).ravel()
        if array.size != size:
            raise CodegenError(f"{name}: {array.size} numbers given; expected {size}")
        return self._call(f"set_{name}", array)

    def set_time(self, t: float) -> int:
        """Put the time of the state; return the status."""
        return self._call("set_time", float(t))

    def set_step(self, h: float) -> int:
        """Put the time step; return the status."""
        return self._call("set_step", float(h))

    def set_state(self, x: Any) -> int:
        """Put the state (n,); return the status."""
        return self._set("state", x, self._nx)

    def set_velocity(self, v: Any) -> int:
        """Put an oscillator's velocity (n,); return the status."""
        return self._set("velocity", v, self._nx)

    def set_force(self, r: Any) -> int:
        """Put the reaction (n,) at the state, which a step with gamma < 1 starts from; return the status."""
        return self._set("force", r, self._nx)

    def set_parameters(self, p: Any) -> int:
        """Put the parameters, in the order of ``about['parameters']``; return the status. The state stays."""
        return self._set("parameters", p, self._np)

    def set_inputs(self, u: Any) -> int:
        """Put the inputs (nu,) from now on; return the status."""
        return self._set("inputs", u, self._nu)

    def set_inputs_between(self, begin: Any, end: Any) -> int:
        """Put the inputs (nu,) at the begin and at the end of the next step; those after it have its end. Return the status."""
        both = [np.ascontiguousarray(value, float).ravel() for value in (begin, end)]
        for array in both:
            if array.size != self._nu:
                raise CodegenError(f"inputs: {array.size} numbers given; expected {self._nu}")
        return self._call("set_inputs_between", *both)

    def set_memory(self, z: Any) -> int:
        """Put the memory of blocks (nz,); return the status."""
        return self._set("memory", z, self._nz)

    def set_held(self, w: Any) -> int:
        """Put what blocks hold (nw,), outputs and duties in force; return the status."""
        return self._set("held", w, self._nw)

    def sample(self) -> int:
        """Let the blocks act that are due at the time of the state, before the step from there; return the status."""
        return self._call("sample")

    def set_budget(self, work: int) -> int:
        """Put the most work of a step, beyond which it is not solved; return the status."""
        return self.library.function("set_budget", ctypes.c_int, ctypes.c_void_p, ctypes.c_long)(self._address, work)

    def set_present(self, body: int, present: bool) -> int:
        """Let one of many bodies, at its state, take part or not; return the status."""
        function = self.library.function("set_present", ctypes.c_int, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)
        return function(self._address, body, bool(present))

    def reset(self) -> int:
        """Go back to the start; return the status."""
        return self._call("reset")

    def step(self) -> int:
        """Go from t to t + h; return the status."""
        return self._call("step")

    def _get(self, name: str, size: int, kind: Any = ctypes.c_double) -> np.ndarray:
        out = np.zeros(size, kind)
        if size:
            pointer = ctypes.POINTER(kind)
            self.library.function(f"get_{name}", None, ctypes.c_void_p, pointer)(self._address, out.ctypes.data_as(pointer))
        return out

    @property
    def t(self) -> float:
        """Time of the state."""
        return self.library.function("get_time", ctypes.c_double, ctypes.c_void_p)(self._address)

    @property
    def x(self) -> np.ndarray:
        """The state (n,)."""
        return self._get("state", self._nx)

    @property
    def v(self) -> np.ndarray:
        """The velocity (n,) of an oscillator: the last difference of positions over the step in use."""
        return self._get("velocity", self._nx)

    @property
    def force(self) -> np.ndarray:
        """The reaction (n,) at the state, which a step with gamma < 1 starts from."""
        return self._get("force", self._nx)

    @property
    def inputs(self) -> np.ndarray:
        """The inputs (nu,) that the next step begins with; after a step those of its end."""
        return self._get("inputs", self._nu)

    @property
    def next_tick(self) -> float:
        """The first time after that of the state at which a block ticks or a pulse begins or ends."""
        return self.library.function("next_tick", ctypes.c_double, ctypes.c_void_p)(self._address)

    @property
    def memory(self) -> np.ndarray:
        """The memory of blocks (nz,)."""
        return self._get("memory", self._nz)

    @property
    def held(self) -> np.ndarray:
        """What blocks hold (nw,): outputs and duties in force."""
        return self._get("held", self._nw)

    @property
    def multipliers(self) -> np.ndarray:
        """The multipliers of the last step, as the model declares them."""
        return self._get("multipliers", self._nl)

    @property
    def y(self) -> np.ndarray:
        """The outputs of the last step."""
        return self._get("outputs", self._nl)

    @property
    def index_set(self) -> np.ndarray:
        """The index set of the last step (m,): 0 where y = 0; -1, 1 where l is at its lower, upper end."""
        return self._get("index_set", self._m, ctypes.c_byte)

    @property
    def residual(self) -> float:
        """The residual of the last step: certified, or of the last answer that a step that failed had tried, infinite if none."""
        return self.library.function("get_residual", ctypes.c_double, ctypes.c_void_p)(self._address)

    @property
    def iterations(self) -> int:
        """Linearisations of the last step, or rounds of its projection."""
        return self.library.function("get_iterations", ctypes.c_int, ctypes.c_void_p)(self._address)

    @property
    def work(self) -> int:
        """Linear systems solved, index sets tried and sweeps of the last step; for many bodies systems factored or solved."""
        return self.library.function("get_work", ctypes.c_long, ctypes.c_void_p)(self._address)

    @property
    def status(self) -> int:
        """The status of the last step."""
        return self.library.function("get_status", ctypes.c_int, ctypes.c_void_p)(self._address)


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
# Seconds that a compiler may take: far more than for the largest sources that are made; one that hangs is stopped.
TIMEOUT = 600.0


def compiler() -> str | None:
    """The C compiler: the one that CC names, else cc, gcc or clang, whichever is there; None where there is none."""
    at = named, _ = os.environ.get("CC", "").strip(), os.environ.get("PATH")
    if at not in _FOUND_COMPILERS:
        found = next((name for name in ([named] if named else COMPILERS) if shutil.which(name.split()[0])), None)
        if found is None:
            return None
        _FOUND_COMPILERS[at] = found
    return _FOUND_COMPILERS[at]


_FOUND_COMPILERS: dict[tuple[str, str | None], str] = {}  # Where CC and PATH are these.


def required_compiler() -> str:
    """What ``compiler`` finds.

    Raises:
        CodegenError: there is none.
    """
    if (found := compiler()) is not None:
        return found
    named = os.environ.get("CC", "").strip()
    missing = f"CC names {named}, which is not there" if named else f"none of {', '.join(COMPILERS)}"
    raise CodegenError(
        f"no C compiler was found ({missing}); install one (apt install gcc; xcode-select --install; on Windows MinGW-w64)"
    )


def compile_library(source: Path, target: Path, flags: tuple[str, ...] = COMPILER_FLAGS) -> None:
    """Compile one C file into a shared library; ``target`` appears whole or not at all.

    Raises:
        CodegenError: there is no compiler, or it fails.
    """
    name = required_compiler()
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


STEP_NAME = "step"
MAX_LIBRARIES = 64  # Libraries that are kept, some 100 KB each; those that this process has loaded are kept besides.
BUILD_PREFIX = "building-"  # Folders of builds; one older than two builds can last was left behind by a process that was killed.
WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH  # Bits of the mode of a file.


def cached_steps(
    model: Model, grid: TimeGrid, tolerance: float, compiler: str, *, for_all: bool = False, in_lanes: bool = False
) -> Path:
    """The compiled steps of a model on a grid, built where they are not there, or not whole.

    ``for_all``: for all values of its parameters, else it is bound; ``in_lanes``: of these, with many runs in step (see
    `simd_batch`).

    Raises:
        CodegenError: the model has no C counterpart, the compiler fails, or the folder cannot be used; for all values also where
            the code would depend on them (see `spec_for_all_values`).
    """

    def files() -> dict[str, str]:
        spec = spec_for_all_values(model, grid, tolerance) if for_all else make_step_spec(model, None, grid, tolerance)
        return step_source_texts(spec, in_lanes=in_lanes)

    key = (steps_key_for_all if for_all else steps_key)(model, grid, tolerance, compiler)
    if in_lanes:
        return cached_library(library_key([key, LANES_FLAGS]), files, LANES_FLAGS)
    return cached_library(key, files, COMPILER_FLAGS)


def step_source_texts(spec: StepSpec, *, in_lanes: bool = False) -> dict[str, str]:
    """The files that compiled steps are built from, the one to be compiled first."""
    source = write_source(spec, STEP_NAME, "", in_lanes=in_lanes)
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
