"""A solver of a generated library in Python."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import CodegenError

if TYPE_CHECKING:
    from nsmodel.codegen.library import Library

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
