"""Event-driven runs in C: many pieces a call, compiled once for a model (see `cache`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import casadi as ca
import numpy as np

from nsmodel.codegen import cache, pieces
from nsmodel.codegen.cache import NAME, kept, key_for, made_by
from nsmodel.codegen.library import FLAGS, Library, compiler, no_compiler
from nsmodel.codegen.piece_scene import TIMES, is_unique, piece_scene
from nsmodel.codegen.statuses import BAD_ARITHMETIC, STATUSES
from nsmodel.codegen.structs import ASKED
from nsmodel.errors import CodegenError
from nsmodel.identity import digest_of
from nsmodel.once import once
from nsmodel.pieces.lengths import order_of
from nsmodel.pieces.names import UNDECIDED
from nsmodel.scheme.continuous import ContinuousProblem

# Loops over few rows are unrolled; in vectors these short ones would wait for the numbers that they have just written.
FASTER = (*("-O3" if flag == "-O2" else flag for flag in FLAGS), "-fno-tree-vectorize")
_Asked = ASKED.in_python()
_POINTER, _NUMBER, _WHOLE = ctypes.c_void_p, ctypes.c_double, ctypes.c_long


def key_of(fingerprint: str, compiler: str) -> str:
    """What names the library of a model."""
    return key_for(["pieces", fingerprint, *made_by(compiler)])


def is_there(fingerprint: str) -> bool:
    """Whether nothing is to be built."""
    name = compiler()
    return name is not None and cache.is_kept(key_of(fingerprint, name))


@once
def mark_of_all(problem: ContinuousProblem) -> str:
    """A hash of a problem in continuous time whose parameters are symbols, for `key_of`: of all that its code is written of."""
    p = problem
    parts = [p.f, p.g, p.h, p.law.lower, p.law.upper, p.x0, *p.columns.values()]
    parts += [] if p.multipliers is None else [p.multipliers]
    whole = ca.Function("all", [p.t, p.x, p.l, p.p], [ca.densify(ca.SX(part)) for part in parts])
    return digest_of(["all values", whole.serialize(), p.held, p.impulses, list(p.columns)])


class NotForTheseError(CodegenError):
    """The library of all values of the parameters is not for some: a matrix has no inverse."""


class Compiled(NamedTuple):
    """A library of pieces; the constants of its header, which choices belong to f, g and h, by what it is compiled."""

    library: Library
    sizes: dict[str, int]
    branches: dict[str, slice]
    judged: bool  # Whether parameters decide if x is the only one.
    way: str

    @staticmethod
    def of(problem: ContinuousProblem, mark: str, known: Sequence[float]) -> Compiled:
        """That of a problem, built where it is not there; CodegenError where there is no compiler, or it fails."""
        name = compiler()
        if name is None:
            raise no_compiler()
        key = key_of(mark, name)
        loaded = _loaded(problem)
        if key not in loaded:
            loaded[key] = _load(problem, known, key, f"compiled by {name}")
        return loaded[key]


@dataclass(frozen=True)
class Asked:
    """What a run in C is asked for, as ``of`` in C; see `PiecesInC`."""

    rtol: float
    atol: np.ndarray
    known: np.ndarray
    data: np.ndarray
    residuals: bool

    @classmethod
    def made(cls, rtol: float, atol: Sequence[float], held: tuple[np.ndarray, np.ndarray], *, residuals: bool) -> Self:
        """Of lists."""
        times, data = (np.ascontiguousarray(part) for part in held)
        return cls(rtol, np.array(atol, float), times, data, residuals)

    @cached_property
    def of(self) -> ctypes.Structure:
        """The same for C, of which the arrays here are the memory."""
        atol, known, data = (array.ctypes.data for array in (self.atol, self.known, self.data))
        return _Asked(self.rtol, atol, known, data, self.known.size, self.residuals)


class PiecesInC:
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
        compiled = Compiled.of(problem, mark, known)
        library, self.sizes, self.branches, _, self.way = compiled
        self.order, self._asked = order_of(rtol), Asked.made(rtol, atol, held, residuals=residuals)
        self._memory = np.zeros(library.function("size", _WHOLE)() // 8 + 1)
        self._solver = self._memory.ctypes.data
        layout = _place(self.sizes)
        places = 2 * layout.itemsize
        self.at, self.before = self._memory.view(np.uint8)[:places].view(layout)
        self.times = self._memory[places // 8 :][:TIMES]
        self._t = self._memory[:1]
        self._begin = library.function("begin", ctypes.c_int, _POINTER, _POINTER, _POINTER, ctypes.c_int)
        self._many = library.function("many", _WHOLE, _POINTER, _NUMBER, _WHOLE, _POINTER, _POINTER)
        self._told = library.function("told", None, _POINTER, _WHOLE, _POINTER, _POINTER)
        self.width = library.function("width", _WHOLE, ctypes.c_int)(self.order)
        self._status, self._values, self._unique = ctypes.c_int(), np.array(values, float), False
        if self._values.size:
            status = library.function("takes", ctypes.c_int, _POINTER, _POINTER)(self._solver, self._values.ctypes.data)
            if status:
                raise NotForTheseError(f"the library of all values is not for these: {STATUSES[status].meaning}")
            self._unique = compiled.judged and is_unique(problem, self._values)

    @property
    def t(self) -> float:
        """Where the next piece starts, ``at["t"]``."""
        return self._t.item()

    def begin(self) -> bool:
        """Choose the mode at the start; whether there is one that C finds."""
        status = self._begin(self._solver, ctypes.byref(self._asked.of), self._values.ctypes.data, self._unique)
        if status == BAD_ARITHMETIC:
            raise CodegenError(f"{self.way}: {STATUSES[status].text}")
        return status == 0

    def many(self, until: float, room: int) -> tuple[np.ndarray, bool]:
        """Pieces up to a time, ``room`` at most, as records (K, width), see `c/pieces.c`; whether C cannot make the next."""
        out = np.empty((room, self.width))
        count = self._many(self._solver, until, room, out.ctypes.data, ctypes.byref(self._status))
        return (out if count == room else out[:count].copy()), self._status.value != 0

    def columns(self, given: np.ndarray, count: int) -> np.ndarray:
        """The columns of a trajectory that are expressions of t, x and l; ``given``: these, a row each."""
        given, out = np.ascontiguousarray(given), np.empty((len(given), count))
        self._told(self._solver, len(given), given.ctypes.data, out.ctypes.data)
        return out


@once
def _loaded(problem: ContinuousProblem) -> dict[str, Compiled]:
    """The libraries that runs of the problem have loaded, by their keys; they go with the problem."""
    del problem
    return {}


def _load(problem: ContinuousProblem, known: Sequence[float], key: str, way: str) -> Compiled:
    scene = piece_scene(problem, known, {str(symbol): 0.0 for symbol in ca.vertsplit(problem.p)})

    def files() -> dict[str, str]:
        return {
            f"{NAME}_pieces.c": pieces.code(scene, NAME, "a run", runs=True),
            f"{NAME}_pieces.h": pieces.header(scene, NAME, "a run", None),
        }

    library = Library(kept(key, files, FASTER), {"name": NAME})
    return Compiled(library, scene.sizes, scene.branches, "JUDGED" in scene.flags, way)


def _place(sizes: dict[str, int]) -> np.dtype:
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
    fields: list[Any] = [("t", float), ("tau", float), *((name, float, (size,)) for name, size in lists.items())]
    fields += [("begun", float), ("event_width", float), ("impulse", float, (m + 1,))]
    fields += [(name, float) for name in ("events", "touches", "redundant", "tiny", "still")]
    fields += [("undecided", float, (len(UNDECIDED),)), ("known", np.int32)]
    fields += [("stiff", float, (4,)), ("unique", float, (3,))]
    fields += [("codes", np.int8, (m + 1,)), ("open", np.int8, (m + choices + 1,))]
    return np.dtype(fields, align=True)
