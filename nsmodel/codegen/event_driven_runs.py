"""Event-driven runs in C: many pieces a call, compiled once for a model (see `cache`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.codegen import event_driven_source
from nsmodel.codegen import library as cache
from nsmodel.codegen.event_driven_spec import EVENT_TIMES, PieceSpec, is_state_unique, make_piece_spec
from nsmodel.codegen.library import (
    COMPILER_FLAGS,
    STEP_NAME,
    Library,
    build_identity,
    cached_library,
    compiler,
    library_key,
    required_compiler,
)
from nsmodel.codegen.structs import BAD_ARITHMETIC, RUN_REQUEST, STATUSES
from nsmodel.errors import CodegenError
from nsmodel.event_driven.modes import UNDECIDED_FIELDS
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.step_size import taylor_order
from nsmodel.modeling.fingerprint import content_digest

# Loops over few rows are unrolled; in vectors these short ones would wait for the numbers that they have just written.
PIECE_FLAGS = (*("-O3" if flag == "-O2" else flag for flag in COMPILER_FLAGS), "-fno-tree-vectorize")
_RunRequestStruct = RUN_REQUEST.ctypes_structure()
_POINTER, _NUMBER, _WHOLE = ctypes.c_void_p, ctypes.c_double, ctypes.c_long


def piece_library_key(fingerprint: str, compiler: str) -> str:
    """What names the library of a model."""
    return library_key(["pieces", fingerprint, *build_identity(compiler)])


def is_piece_library_cached(fingerprint: str) -> bool:
    """Whether nothing is to be built."""
    name = compiler()
    return name is not None and cache.has_cached_library(piece_library_key(fingerprint, name))


def piece_library_mark(problem: ContinuousProblem, known: Sequence[float], by: Sequence[int] = ()) -> str:
    """What names the library of a problem in continuous time with these known times, for `piece_library_key`: all that its code
    is written of but the start, which runs give. One that differentiates has the start's derivatives.
    """
    starts = ca.Function("starts", [problem.p], [ca.densify(ca.SX(problem.x0))]).serialize() if by else ""
    return content_digest([_problem_hash(problem), *map(float, known), *(["by", *by, starts] if by else [])])


@cached_per_object
def _problem_hash(problem: ContinuousProblem) -> str:
    p = problem
    parts = [p.f, p.g, p.h, p.law.lower, p.law.upper, *p.columns.values()]
    parts += [] if p.multipliers is None else [p.multipliers]
    whole = ca.Function("all", [p.t, p.x, p.l, p.p], [ca.densify(ca.SX(part)) for part in parts])
    return content_digest(["all values", whole.serialize(), p.held, p.impulses, list(p.columns)])


class UnsupportedValuesError(CodegenError):
    """The library of all values of the parameters is not for some: a matrix has no inverse."""


class PieceCalls(NamedTuple):
    """What a library of pieces is called for, see `c/pieces_rollout.c`; the numbers of a solver, and its place (a dtype)."""

    begin: Any
    many: Any
    columns: Any
    width: Any
    takes: Any
    size: int
    place: np.dtype

    @staticmethod
    def of(library: Library, spec: PieceSpec) -> PieceCalls:
        """Those of a library."""
        return PieceCalls(
            library.function("begin", ctypes.c_int, _POINTER, _POINTER, _POINTER, ctypes.c_int, _POINTER),
            library.function("many", _WHOLE, _POINTER, _NUMBER, _WHOLE, _POINTER, _POINTER),
            library.function("told", None, _POINTER, _WHOLE, _POINTER, _POINTER),
            library.function("width", _WHOLE, ctypes.c_int),
            library.function("takes", ctypes.c_int, _POINTER, _POINTER) if "PARAMETERS" in spec.flags else None,
            library.function("size", _WHOLE)() // 8 + 1,
            _piece_start_dtype(spec.sizes),
        )


class PieceLibrary(NamedTuple):
    """A library of pieces; the constants of its header, which choices belong to f, g and h, by what it is compiled."""

    library: Library
    calls: PieceCalls
    branches: dict[str, slice]
    judged: bool  # Whether parameters decide if x is the only one.
    way: str

    @staticmethod
    def of(problem: ContinuousProblem, mark: str, known: Sequence[float], by: Sequence[int] = ()) -> PieceLibrary:
        """That of a problem, built where it is not there; CodegenError where there is no compiler, or it fails.

        ``by``: the entries of p that it differentiates runs by.
        """
        name = required_compiler()
        key = piece_library_key(mark, name)
        loaded = _loaded_piece_libraries(problem)
        if key not in loaded:
            loaded[key] = _load_piece_library(problem, known, by, key, f"compiled by {name}")
        return loaded[key]


@dataclass(frozen=True)
class RunRequest:
    """What a run in C is asked for, as ``of`` in C; see `CompiledPieceIntegrator`."""

    rtol: float
    atol: np.ndarray
    known: np.ndarray
    data: np.ndarray
    residuals: bool

    @classmethod
    def made(
        cls, rtol: float, atol: Sequence[float] | np.ndarray, held: tuple[np.ndarray, np.ndarray], *, residuals: bool
    ) -> Self:
        """The request with its known times and their data as arrays that C can read."""
        times, data = (np.ascontiguousarray(part) for part in held)
        return cls(rtol, np.array(atol, float), times, data, residuals)

    @cached_property
    def of(self) -> ctypes.Structure:
        """The same for C, of which the arrays here are the memory."""
        atol, known, data = (array.ctypes.data for array in (self.atol, self.known, self.data))
        return _RunRequestStruct(self.rtol, atol, known, data, self.known.size, self.residuals)


class CompiledPieceIntegrator:
    """The pieces of one problem, which end at ``known`` times.

    Where it has held states these are known when it is compiled no more than what is ``held``: the times, 0 the first, and the
    states after each.

    ``way``: by what they are compiled; ``branches``: which choices belong to f, g and h; ``residuals``: see `Integrator`;
    ``values``: of the parameters that the problem has as symbols.

    Raises:
        CodegenError: the problem has no C counterpart, or there is no compiler, or it fails.
        NotForTheseError: it has none for these values.
    """

    def __init__(
        self, problem: ContinuousProblem, mark: str, rtol: float, atol: list[float], known: Sequence[float],
        held: tuple[np.ndarray, np.ndarray], values: Sequence[float] = (), *, residuals: bool,
    ) -> None:  # fmt: skip
        compiled = PieceLibrary.of(problem, mark, known)
        _, self._calls, self.branches, self._judged, self.way = compiled
        self._problem = problem
        self.order, self._request = taylor_order(rtol), RunRequest.made(rtol, atol, held, residuals=residuals)
        self.width = self._calls.width(self.order)
        self._allocate(np.array(values, float))
        if self.values.size and (status := self._calls.takes(self._solver, self.values.ctypes.data)):
            raise UnsupportedValuesError(
                f"the library for all parameter values does not apply to these: {STATUSES[status].meaning}"
            )

    def _allocate(self, values: np.ndarray) -> None:
        """Memory of a solver of its own, and the values of the parameters."""
        self._memory = np.zeros(self._calls.size)
        self._solver = self._memory.ctypes.data
        places = 2 * self._calls.place.itemsize
        self.at, self.before = self._memory.view(np.uint8)[:places].view(self._calls.place)
        self.times = self._memory[places // 8 :][:EVENT_TIMES]
        self._t, self._status, self.values = self._memory[:1], ctypes.c_int(), values

    def again(self, values: np.ndarray, held: tuple[np.ndarray, np.ndarray] | None) -> CompiledPieceIntegrator:
        """The pieces of the same library for other values, as many, and other known times where these are ``held``."""
        other = copy(self)
        other._allocate(values)
        if held is not None:
            other._request = RunRequest.made(self._request.rtol, self._request.atol, held, residuals=self._request.residuals)
        return other

    @property
    def t(self) -> float:
        """Where the next piece starts, ``at["t"]``."""
        return self._t.item()

    @property
    def is_unique(self) -> bool:
        """Whether parameters that are symbols in C are known to let x be the only one in all modes."""
        return self.values.size > 0 and self._judged and is_state_unique(self._problem, self.values.tobytes())

    @property
    def proved_unique(self) -> bool:
        """Whether C proved of the mode after each event so far that x is the only one."""
        return not self.at["unique"][1:].any()

    def begin(self, x0: np.ndarray, *, unique: bool | None = None) -> bool:
        """Choose the mode at the start (n,); whether C finds one. ``unique``: see ``is_unique``."""
        unique = self.is_unique if unique is None else unique
        status = self._calls.begin(self._solver, ctypes.byref(self._request.of), self.values.ctypes.data, unique, x0.ctypes.data)
        if status == BAD_ARITHMETIC:
            raise CodegenError(f"{self.way}: {STATUSES[status].text}")
        return status == 0

    def advance(self, until: float, room: int) -> tuple[np.ndarray, bool]:
        """Pieces up to a time, ``room`` at most, as records (K, width), see `c/pieces.c`; whether C cannot make the next."""
        out = np.empty((room, self.width))
        count = self._calls.many(self._solver, until, room, out.ctypes.data, ctypes.byref(self._status))
        return (out[:count] if 4 * count >= room else out[:count].copy()), self._status.value != 0

    def columns(self, given: np.ndarray, count: int) -> np.ndarray:
        """The columns of a trajectory that are expressions of t, x and l; ``given``: these, a row each."""
        given, out = np.ascontiguousarray(given), np.empty((len(given), count))
        self._calls.columns(self._solver, len(given), given.ctypes.data, out.ctypes.data)
        return out


@cached_per_object
def _loaded_piece_libraries(problem: ContinuousProblem) -> dict[str, PieceLibrary]:
    """The libraries that runs of the problem have loaded, by their keys; they go with the problem."""
    del problem
    return {}


def _load_piece_library(
    problem: ContinuousProblem, known: Sequence[float], by: Sequence[int], key: str, backend: str
) -> PieceLibrary:
    spec = make_piece_spec(problem, known, {str(symbol): 0.0 for symbol in ca.vertsplit(problem.p)}, by)

    def files() -> dict[str, str]:
        return {
            f"{STEP_NAME}_pieces.c": event_driven_source.piece_code(spec, STEP_NAME, "a run", runs=True),
            f"{STEP_NAME}_pieces.h": event_driven_source.piece_header(spec, STEP_NAME, "a run", None),
        }

    library = Library(cached_library(key, files, PIECE_FLAGS), {"name": STEP_NAME})
    return PieceLibrary(library, PieceCalls.of(library, spec), spec.branches, "JUDGED" in spec.flags, backend)


def _piece_start_dtype(sizes: dict[str, int]) -> np.dtype:
    """``model_place`` in C."""
    n, m, choices = sizes["N"], sizes["M"], sizes["CHOICES"]
    lists = {
        "x": n,
        "l": m + 1,
        "size_x": n,
        "size_y": m + 1,
        "size_l": m + 1,
        "choice": choices + 1,
        "size_switches": choices + 1,
    }
    fields: list[Any] = [("t", float), ("late", float), ("tau", float), *((name, float, (size,)) for name, size in lists.items())]
    fields += [("begun", float), ("event_width", float), ("impulse", float, (m + 1,))]
    fields += [(name, float) for name in ("events", "touches", "redundant", "tiny", "still")]
    fields += [("undecided", float, (len(UNDECIDED_FIELDS),)), ("known", np.int32)]
    fields += [("stiff", float, (4,)), ("unique", float, (3,))]
    fields += [("codes", np.int8, (m + 1,)), ("open", np.int8, (m + choices + 1,))]
    return np.dtype(fields, align=True)
