"""Event-driven runs in C: many pieces a call, compiled once for a model (see `cache`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from nsmodel.codegen import cache, pieces
from nsmodel.codegen.cache import NAME, kept, key_for, made_by
from nsmodel.codegen.piece_scene import TIMES, piece_scene
from nsmodel.codegen.library import FLAGS, Library, compiler, no_compiler
from nsmodel.codegen.statuses import BAD_ARITHMETIC, STATUSES
from nsmodel.errors import CodegenError
from nsmodel.once import once
from nsmodel.pieces.lengths import order_of
from nsmodel.scheme.continuous import ContinuousProblem

FASTER = tuple("-O3" if flag == "-O2" else flag for flag in FLAGS)  # Loops over few rows are unrolled.
_POINTER, _NUMBER, _WHOLE = ctypes.c_void_p, ctypes.c_double, ctypes.c_long


def key_of(fingerprint: str, compiler: str) -> str:
    """What names the library of a model."""
    return key_for(["pieces", fingerprint, *made_by(compiler)])


def is_there(fingerprint: str) -> bool:
    """Whether nothing is to be built."""
    name = compiler()
    return name is not None and cache.is_kept(key_of(fingerprint, name))


class PiecesInC:
    """The pieces of one problem, which end at ``known`` times.

    Where it has held states these are known when it is compiled no more than what is ``held``: the times, 0 the first, and the
    states after each.

    ``way``: by what they are compiled; ``branches``: which choices belong to f, g and h; ``residuals``: see `Integrator`.

    Raises:
        CodegenError: the problem has no C counterpart, or there is no compiler, or it fails.
    """

    def __init__(
        self, problem: ContinuousProblem, fingerprint: str, rtol: float, atol: list[float], known: Sequence[float],
        held: tuple[np.ndarray, np.ndarray], *, residuals: bool,
    ) -> None:  # fmt: skip
        name = compiler()
        if name is None:
            raise no_compiler()
        key = key_of(fingerprint, name)
        self.way = f"compiled by {name}"
        loaded = _loaded(problem)
        if key not in loaded:
            loaded[key] = _load(problem, known, key)
        library, self.sizes, self.branches = loaded[key]
        self.residuals = residuals
        self.rtol, self.atol, self.order = rtol, np.array(atol, float), order_of(rtol)
        size = library.function("size", _WHOLE)()
        self._memory = np.zeros(size // 8 + 1)
        self._solver = self._memory.ctypes.data
        layout = _place(self.sizes)
        places = 2 * layout.itemsize
        self.at, self.before = self._memory.view(np.uint8)[:places].view(layout)
        self.times = self._memory[places // 8 :][: TIMES]
        self._t = self._memory[:1]
        self._held = tuple(np.ascontiguousarray(part) for part in held)
        self._begin = library.function(
            "begin", ctypes.c_int, _POINTER, _NUMBER, _POINTER, ctypes.c_int, _POINTER, _POINTER, _WHOLE
        )  # fmt: skip
        self._many = library.function("many", _WHOLE, _POINTER, _NUMBER, _WHOLE, _POINTER, _POINTER)
        self._told = library.function("told", None, _POINTER, _WHOLE, _POINTER, _POINTER)
        self.width = library.function("width", _WHOLE, ctypes.c_int)(self.order)
        self._status = ctypes.c_int()

    @property
    def t(self) -> float:
        """Where the next piece starts, ``at["t"]``."""
        return self._t.item()

    def begin(self) -> bool:
        """Choose the mode at the start; whether there is one that C finds."""
        known, data = self._held
        status = self._begin(
            self._solver, self.rtol, self.atol.ctypes.data, self.residuals, known.ctypes.data, data.ctypes.data, known.size
        )  # fmt: skip
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
def _loaded(problem: ContinuousProblem) -> dict[str, Any]:
    """The libraries that runs of the problem have loaded, by their keys; they go with the problem."""
    del problem
    return {}


def _load(problem: ContinuousProblem, known: Sequence[float], key: str) -> tuple[Library, dict[str, int], dict[str, slice]]:
    scene = piece_scene(problem, known)

    def files() -> dict[str, str]:
        return {
            f"{NAME}_pieces.c": pieces.code(scene, NAME, "a run", runs=True),
            f"{NAME}_pieces.h": pieces.header(scene, NAME, "a run", None),
        }

    return Library(kept(key, files, FASTER), {"name": NAME}), scene.sizes, scene.branches


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
    fields += [("begun", float), ("impulse", float, (m + 1,))]
    fields += [(name, float) for name in ("events", "touches", "redundant", "tiny")]
    fields += [("known", np.int32)]
    fields += [("stiff", float, (4,)), ("unique", float, (3,))]
    fields += [("codes", np.int8, (m + 1,)), ("open", np.int8, (m + choices + 1,))]
    return np.dtype(fields, align=True)
