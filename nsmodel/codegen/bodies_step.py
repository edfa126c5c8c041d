"""The step of many bodies in C, for runs: built once for a model, with the contract of the interpreted step."""

from __future__ import annotations

import ctypes
import platform
import time

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, uses_neighbour_search
from nsmodel.codegen import library, structs
from nsmodel.codegen.bodies import item_size, model_source, solver_source
from nsmodel.codegen.features import MAX_WORK
from nsmodel.codegen.library import COMPILER_FLAGS as PORTABLE
from nsmodel.codegen.library import NATIVE_FLAGS, MappedLibrary, cached_library, compiler, library_key, no_compiler_error
from nsmodel.codegen.structs import BAD_ARITHMETIC, NO_ROOM, STATUSES
from nsmodel.errors import CodegenError, StepError
from nsmodel.solvers.contact_search import least_gap
from nsmodel.solvers.contact_solver import COLD_BODIES_START, BodiesStepResult, BodiesWarmStart, Contacts

BODIES_FLAGS = (*("-O3" if flag == "-O2" else flag for flag in PORTABLE), *NATIVE_FLAGS)


def load_cached_library(text: str, name: str) -> MappedLibrary:
    """The compiled ``text``, built once for this processor and kept in the user's cache folder.

    Raises:
        CodegenError: there is no compiler or it fails, or the folder cannot be used.
    """
    by = compiler()
    if by is None:
        raise no_compiler_error()
    path = cached_library(_source_key(text, by), lambda: {f"{name}.c": text}, BODIES_FLAGS)
    try:
        return MappedLibrary(path)
    except OSError as error:
        raise CodegenError(f"the compiled step {path} cannot be loaded ({error})") from error


def _source_key(text: str, by: str) -> str:
    return library_key([text, BODIES_FLAGS, by, platform.machine(), platform.node()])


def is_solver_cached(model: ManyBodies) -> bool:
    """Whether the library that all models with bodies like these share is in the cache."""
    return _is_source_cached(solver_source(model.bodies.d))


def is_model_code_cached(model: ManyBodies) -> bool:
    """Whether the library of the model's own functions is in the cache."""
    return _is_source_cached(model_source(model))


def _is_source_cached(text: str) -> bool:
    by = compiler()
    return by is not None and library.has_cached_library(_source_key(text, by))


MotionStruct, ReportStruct = structs.BODIES_MOTION.ctypes_structure(), structs.TIMED_BODIES_REPORT.ctypes_structure()


class CompiledBodiesStep:
    """A step of many bodies in C: what `solvers.contact_solver.BodiesStepper` is in Python.

    Attributes:
        way: by what it was compiled.
        report: what the last step met.
        seconds: CPU seconds so far of search, assembly (with the certificate) and solve.
    """

    def __init__(self, model: ManyBodies, tolerance: float) -> None:
        """Build or find the library; CodegenError where there is none."""
        self.model, self.problem, self.way = model, BodiesProblem(model), f"compiled by {compiler()}"
        steps = load_cached_library(solver_source(model.bodies.d), "bodies")
        if not steps["is_sound"]():
            raise CodegenError(f"{compiler()}: {STATUSES[BAD_ARITHMETIC].text}")
        self._run = steps["move_bodies"]
        self._own = load_cached_library(model_source(model), "families")
        self._run.restype = ctypes.c_int
        n, d = model.bodies.q0.shape
        families = list(model.constraints.values())
        tables = [family.second.group.table if item_size(family) else np.zeros((0, 1)) for family in families]
        over = [np.zeros(0) if family.over is None else family.over for family in families]
        self._tables = [np.ascontiguousarray(table) for table in tables]
        self._over = [np.ascontiguousarray(pairs, np.intc) for pairs in over]
        self._counts = np.array([[len(table) for table in tables], [len(pairs) for pairs in over]], np.intc)
        self._pointers = np.array([
            [_address_of(table) for table in self._tables],
            [0 if family.over is None else _address_of(pairs) for family, pairs in zip(families, self._over, strict=True)],
        ], np.uintp)  # fmt: skip
        self._fixed_reach = all(not ca.depends_on(family.reach, model.t) for family in families if uses_neighbour_search(family))
        self._q, self._present, self._velocity = np.zeros((n, d)), np.zeros(n, np.uint8), np.zeros((n, d))
        self._next = np.zeros((n, d))
        self._numbers = np.ascontiguousarray(model.bodies.table[:, d:])
        self._farthest = np.array([*(0.0 if uses_neighbour_search(family) else -1.0 for family in families), -1.0])
        self._halves = np.zeros((len(families), n))
        self._shares = np.array([_address_of(row) for row in self._halves], np.uintp)
        self._memory = np.empty(4096 * (n + 64), np.uint8)
        self._missing, self.report = ctypes.c_size_t(0), ReportStruct()
        self.seconds = {"search": 0.0, "assembly": 0.0, "solve": 0.0}
        s = self._motion = MotionStruct()
        s.model = ctypes.addressof(ctypes.c_char.in_dll(self._own, "own_functions"))
        s.n, s.tolerance, s.budget = n, tolerance, MAX_WORK
        s.q, s.present, s.numbers, s.farthest = map(_address_of, (self._q, self._present, self._numbers, self._farthest))
        s.velocity = None if isinstance(model.f, ca.SX) and not model.is_driven else _address_of(self._velocity)
        s.items, s.over, s.item_count, s.over_count = map(_address_of, (*self._pointers, *self._counts))
        s.q_next, s.halves = _address_of(self._next), _address_of(self._shares)
        self._update_reach(0.0)

    def _update_reach(self, t: float) -> None:
        for k, family in enumerate(self.problem.families):
            if uses_neighbour_search(family):
                self._halves[k] = np.maximum(self.problem.halves(k, t), 0.0)

    def __call__(
        self, t: float, h: float, state: np.ndarray, warm: BodiesWarmStart = COLD_BODIES_START, k: int = 0
    ) -> BodiesStepResult:
        """Advance the bodies that are there, q = ``state`` (N, d), from t to t + h.

        Raises:
            StepError: the step could not be verified; f or a constraint is not finite.
        """
        s, report, present = self._motion, self.report, np.all(np.isfinite(state), axis=1)
        self._q[:], self._present[:] = state, present
        if s.velocity:
            self._velocity[:] = self.problem.f(t, state, present)
        if not self._fixed_reach:
            self._update_reach(t + h)
        contacts = warm.contacts
        order = np.argsort(contacts.first, kind="stable")
        given = [contacts.family[order].astype(np.intc), contacts.first[order].astype(np.intc),
                 contacts.second[order].astype(np.intc), contacts.reaction[order] * h]  # fmt: skip
        s.t, s.h, s.motion, s.contacts = t, h, warm.moved / 2, len(order)
        s.family, s.first, s.second, s.multiplier = map(_address_of, given)
        while True:
            status = self._run(
                ctypes.byref(s), ctypes.c_void_p(_address_of(self._memory)), ctypes.c_size_t(self._memory.size),
                ctypes.byref(self._missing), ctypes.byref(report),
            )  # fmt: skip
            if status != NO_ROOM:
                break
            self._memory = np.empty(2 * (self._memory.size + self._missing.value), np.uint8)
        for part in self.seconds:
            self.seconds[part] += getattr(report, part)
        if status:
            raise StepError(f"no verified step in C from t = {t:.10g}: residual {report.residual:.3g}", residual=report.residual)
        after = np.where(present[:, None], self._next, np.nan)
        found = Contacts(
            self._contact_array(s.family_out, np.intc).astype(np.int8), self._contact_array(s.first_out, np.intc).copy(),
            self._contact_array(s.second_out, np.intc).copy(), self._contact_array(s.multiplier_out, np.float64) / h,
        )  # fmt: skip
        gap = report.gap
        if not gap <= report.cutoff - report.motion:
            start = time.process_time()
            gap = least_gap(self.problem, t + h, after, present)
            self.seconds["search"] += time.process_time() - start
        solver = "none needed" if not s.contacts_out else "interior point" if report.by_interior else "active set"
        return BodiesStepResult(
            after, found, gap, report.residual, BodiesWarmStart(found, 2 * report.motion), solver, report.groups
        )

    def _contact_array(self, address: int, kind: type) -> np.ndarray:
        """The contacts' numbers at an address in the memory of the step."""
        start = address - _address_of(self._memory)
        return self._memory[start : start + self._motion.contacts_out * np.dtype(kind).itemsize].view(kind)


def _address_of(array: np.ndarray) -> int:
    """Where an array begins."""
    return array.__array_interface__["data"][0]
