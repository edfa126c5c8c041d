"""A generated library in Python: built with the machine's C compiler, loaded with ctypes."""

from __future__ import annotations

import _ctypes
import contextlib
import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.errors import CodegenError

FLAGS = ("-std=c99", "-O2", "-Werror=implicit-function-declaration", "-fPIC", "-shared")
COMPILERS = ("cc", "gcc", "clang")
DOUBLES = ctypes.POINTER(ctypes.c_double)
TIMEOUT = 600.0  # Seconds that a compiler may take.


def compiler() -> str | None:
    """The C compiler: the one that CC names, else cc, gcc or clang, whichever is there; None where there is none."""
    named = os.environ.get("CC", "").strip()
    for name in [named] if named else COMPILERS:
        if shutil.which(name.split()[0]):
            return name
    return None


def no_compiler() -> CodegenError:
    """The error where ``compiler`` gives None."""
    named = os.environ.get("CC", "").strip()
    missing = f"CC names {named}, which is not there" if named else f"none of {', '.join(COMPILERS)}"
    return CodegenError(f"no C compiler was found ({missing}); install one (apt install gcc, xcode-select --install)")


def compile_library(source: Path, target: Path, flags: tuple[str, ...] = FLAGS) -> None:
    """Compile one C file into a shared library; ``target`` appears whole or not at all.

    Raises:
        CodegenError: there is no compiler, or it fails.
    """
    name = compiler()
    if name is None:
        raise no_compiler()
    try:
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            built = Path(folder) / target.name
            command = [*name.split(), *flags, "-o", str(built), str(source), "-lm"]
            status, errors = _called(command)
            if status:
                raise CodegenError(f"{name} could not compile {source.name}: {_first_error(status, errors)}")
            built.replace(target)
    except OSError as error:
        raise CodegenError(f"{target} could not be built with {name} ({error}); its folder must be writable") from error


def _called(command: list[str]) -> tuple[int, str]:
    """Exit status and errors of a compiler; it and all that it has started end with this call.

    Raises:
        CodegenError: it takes longer than TIMEOUT.
    """
    quiet = subprocess.DEVNULL
    with subprocess.Popen(
        command, text=True, errors="replace", start_new_session=True, stdin=quiet, stdout=quiet, stderr=subprocess.PIPE
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


class Mapped(ctypes.CDLL):
    """A library in memory, which goes when nothing refers to it; each of its functions, asked for by ``[name]``, does."""

    def __init__(self, path: Path) -> None:
        """Load the library at ``path``; OSError where that fails."""
        self.path, self.closed = path, True
        with tempfile.TemporaryDirectory() as folder:
            # Libraries are known by their paths: under one that is new, a file built again is not taken for the old one.
            link = Path(folder) / path.name
            link.symlink_to(path.resolve())
            super().__init__(str(link))
        self.closed = False
        _MAPPED.add(self)

    def __del__(self) -> None:
        """Unload it, but not while Python ends and others may still call it."""
        close = getattr(_ctypes, "dlclose", None)
        if not self.closed and close is not None and not sys.is_finalizing():
            self.closed = True
            close(self._handle)


_MAPPED: weakref.WeakSet[Mapped] = weakref.WeakSet()


def in_use() -> set[Path]:
    """The files of the libraries that are loaded."""
    return {library.path for library in _MAPPED}


def load(folder: str | Path) -> Library:
    """Build (where it is not built yet) and load the library that ``nsmodel codegen`` wrote into ``folder``.

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
    source, built = found[0].with_suffix(".c"), folder / f"lib{about['name']}.so"
    newest = max(path.stat().st_mtime_ns for path in folder.glob(f"{about['name']}.[ch]"))
    if not built.exists() or built.stat().st_mtime_ns <= newest:
        compile_library(source, built)
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
            self.mapped = Mapped(path)
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
        self._address = ctypes.c_void_p(library.function("create", ctypes.c_void_p)())
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
