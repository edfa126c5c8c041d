"""The step of many bodies as C: the model's functions for a pair, and the parts in ``c/`` that search, group and solve.

For runs it is built once for a model, with the contract of the interpreted step.

In `codegen/c/group.c` a group is min |w|^2/2, G w + b >= 0. Small changes: primal-dual active set from the last step. Else
Mehrotra's interior point on I + G' Theta G until the index set shows (mean of m s below 1e-6), then the active set; where that
does not settle, an augmented Lagrangian with Newton's method and an exact line search, which converges from anywhere. Every way
ends on an index set solved to 1e-13 of the largest speed. One factorisation serves all (`codegen/c/block_ldl.c`): blocks of d x
d, multifrontal, in an order that the positions give: minimum degree for the loose ends, then nested dissection by the fewest
bodies that separate two sides within a band (as many as paths between the sides that do not meet: a maximal flow). The memory
of a step is one arena given from outside: a step is a pure function, and a library without allocation is the same code.
"""

from __future__ import annotations

import ctypes
import json
import platform
import time
from collections.abc import Sequence, Set
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.codegen import library, structs
from nsmodel.codegen.export import WORST_CASE_NEEDS, LibraryRequest
from nsmodel.codegen.expressions import c_function, c_table
from nsmodel.codegen.features import MAX_COUNT
from nsmodel.codegen.fragments import comment_text, compiler_guard, define_lines, prefix_names, prune_unused, read_fragment
from nsmodel.codegen.library import COMPILER_FLAGS as PORTABLE
from nsmodel.codegen.library import NATIVE_FLAGS, MappedLibrary, cached_library, compiler, library_key, required_compiler
from nsmodel.codegen.structs import BAD_ARITHMETIC, NO_ROOM, STATUSES
from nsmodel.errors import CodegenError, StepError
from nsmodel.modeling.fingerprint import versions
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.models.many_bodies.contact_search import least_gap
from nsmodel.models.many_bodies.contact_solver import COLD_BODIES_START, BodiesStepResult, BodiesWarmStart, Contacts
from nsmodel.models.many_bodies.families import Family
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.schemes import BODIES_SCHEME, BodiesProblem, uses_neighbour_search

BODIES_CONSTANTS: Sequence[tuple[str, str]] = (
    ("solvers.residuals", "REACH"),
    ("models.many_bodies.contact_search", "FARTHER"),
    ("codegen.structs", "READY"),
)
BODIES_FRAGMENTS = ("block_ldl.c", "group.c", "bodies.c")
MAX_BODIES = 20_000  # Bodies whose numbers are written into a library: lists in its source; more are refused.
CONTACTS_PER_BODY = 6  # Room for contacts of each body in a library, twice as many as discs packed in the plane have,
MEMORY_PER_BODY = 16_384  # and bytes to work in, 16 KB, and
BASE_MEMORY = 65_536  # for all of them.
HEADERS = "".join(f"#include <{name}.h>\n" for name in ("float", "math", "stddef", "stdlib", "string"))


def _bodies_fragments(flags: Set[str] = frozenset(), report: structs.CStruct = structs.BODIES_REPORT) -> list[str]:
    """The step, whatever the model."""
    return [read_fragment(part, flags, {"REPORT": report.c(), "MOTION": structs.BODIES_MOTION.c()}) for part in BODIES_FRAGMENTS]


def solver_source(d: int) -> str:
    """The C that moves bodies of d states, whatever the model, for runs; times are taken."""
    parts = _bodies_fragments(frozenset({"TIMES", "EXPORTED"}), structs.TIMED_BODIES_REPORT)
    return "\n".join(
        [
            HEADERS,
            "#include <time.h>\n",
            compiler_guard().replace("static int", "int"),
            f"#define DIM {d}\n{define_lines(BODIES_CONSTANTS)}",
            structs.status_enum(),
            *parts,
        ]
    )


def model_source(model: ManyBodies) -> str:
    """The C of a bound model's own functions, for runs: ``own_functions`` is visible."""
    declared = _bodies_fragments()[-1].partition("/* Rows in use")[0]
    own = _model_functions(model).replace("static const model_functions own", "const model_functions own")
    return "\n".join([HEADERS, "typedef struct model_solver model_solver;\n", declared, own])


def library_source(model: ManyBodies, name: str) -> str:
    """All of the C of a bound model's library."""
    text = [
        f'#include "{name}.h"\n\n{HEADERS}', compiler_guard(), f"#define DIM {model.bodies.d} /* states of a body */\n",
        define_lines(BODIES_CONSTANTS), *_bodies_fragments(), _model_functions(model), _model_tables(model),
        read_fragment("bodies_api.c", frozenset(), {"STATUS_CASES": structs.status_cases()}),
    ]  # fmt: skip
    return prefix_names(prune_unused("\n".join(text)), name)


def _model_functions(model: ManyBodies) -> str:
    """The model's functions and the table of them."""
    families = list(model.constraints.values())
    f = model.f if isinstance(model.f, ca.SX) and not model.is_driven else ca.SX.zeros(model.bodies.d)
    inputs = {"t": model.t, "p": model.p}
    text = [read_fragment("common.c", frozenset(), {}), c_function("velocity", inputs | {"a": model.me.symbols}, {"out": f}, "f")]
    if model.leave is not None:
        text.append(c_function("leave", inputs | {"a": model.me.symbols}, {"out": model.leave}, "> 0: a body leaves"))
    for k, (label, family) in enumerate(model.constraints.items()):
        g = ca.SX(family.g)
        slopes = [ca.gradient(g, family.first.q), *([ca.gradient(g, family.second.q)] if family.of_pairs else [])]
        members = {"a": family.first.symbols, "b": ca.SX(0, 1) if family.second is None else family.second.symbols}
        about = f"{comment_text(label)}: g and its gradients"
        text.append(c_function(f"row_{k}", inputs | members, {"out": ca.vertcat(g, *slopes)}, about))
    text.append(
        f"static const int of_bodies[] = {{{_c_list(int(family.of_pairs) for family in families)}}};\n"
        f"static const int item_size[] = {{{_c_list(item_size(family) for family in families)}}};\n"
        f"static model_function *const rows[] = {{{_c_list(f'row_{k}' for k in range(len(families)))}}};\n"
        f"static const model_functions own_functions = {{{len(families)}, {model.bodies.table.shape[1]}, of_bodies, item_size, "
        f"rows, velocity, {'leave' if model.leave is not None else '0'}}};\n"
    )
    return prune_unused("\n".join(text))


def item_size(family: Family) -> int:
    """Numbers of each of the items that a family's second member is one of; 0 where it is none."""
    return 0 if family.second is None or family.of_pairs else family.second.group.table.shape[1]


def _c_list(items: Any) -> str:
    return ", ".join(map(str, items)) or "0"


def _model_tables(model: ManyBodies) -> str:
    """The model's numbers as tables."""
    problem, families = BodiesProblem(model), list(model.constraints.values())
    for name, family in model.constraints.items():
        if uses_neighbour_search(family) and ca.depends_on(family.reach, model.t):
            raise CodegenError(f"constraint '{name}': its reach {family.reach} depends on t, which has no C counterpart yet")
    reach = [max(problem.reach(k, 0.0), 0.0) if uses_neighbour_search(family) else -1.0 for k, family in enumerate(families)]
    text = [
        _flat_table("body_starts", model.bodies.q0),
        _flat_table("body_numbers", problem.numbers),
        _flat_table("family_farthest", reach),
    ]
    for k, family in enumerate(families):
        text += [_flat_table(f"items_{k}", family.second.group.table)] if item_size(family) else []
        text += [_flat_table(f"over_{k}", family.over, "int")] if family.over is not None else []
    items = [f"items_{k}" if item_size(family) else "0" for k, family in enumerate(families)]
    over = ["0" if family.over is None else f"over_{k}" for k, family in enumerate(families)]
    counts = [family.second.group.count if item_size(family) else 0 for family in families]
    lengths = [0 if family.over is None else len(family.over) for family in families]
    return "\n".join(text) + (
        f"\nstatic const double *const family_items[] = {{{_c_list(items)}}};\n"
        f"static const int family_item_count[] = {{{_c_list(counts)}}};\n"
        f"static const int *const family_over[] = {{{_c_list(over)}}};\n"
        f"static const int family_over_count[] = {{{_c_list(lengths)}}};\n"
    )


def _flat_table(name: str, values: Any, kind: str = "double") -> str:
    flat = np.ravel(values)
    return c_table(name, flat if flat.size else np.zeros(1), str(max(flat.size, 1)), kind=kind)


def library_files(model: ManyBodies, name: str, grid: TimeGrid, request: LibraryRequest) -> tuple[dict[str, str], dict[str, Any]]:
    """Every file of the library by name, and what it is, for programs; no step does more work than ``request.max_work``.

    Raises:
        CodegenError: f is a function of numbers, there are more than MAX_BODIES bodies, a reach depends on t; event-driven
            integration or a bound of the worst case is asked for.
    """
    if request.event_driven:
        raise CodegenError("event-driven integration does not take many bodies; they are for time stepping")
    if request.worst_case:
        raise CodegenError(f"{WORST_CASE_NEEDS}; those of many bodies change as they meet")
    n, d = model.bodies.q0.shape
    if model.is_driven:
        raise CodegenError(
            f"many bodies with inputs ({', '.join(model.input_groups)}) have no C counterpart: replace them by numbers"
        )
    if not isinstance(model.f, ca.SX):
        raise CodegenError("f is a Python function; for C it must be an expression of one body's symbols (and t)")
    if n > MAX_BODIES:
        raise CodegenError(f"{n} bodies: their numbers are written into the source, which is made for up to {MAX_BODIES}")
    memory, contacts = BASE_MEMORY + MEMORY_PER_BODY * n, 64 + CONTACTS_PER_BODY * n
    replacements = {
        "NAME": name, "UPPER": name.upper(), "TITLE": comment_text(" ".join(model.title.split()) or name),
        "SCHEME": BODIES_SCHEME,
        "BODIES": str(n), "DIM": str(d), "NX": str(n * d), "STEP": repr(grid.step(0)), "TOLERANCE": repr(request.tolerance),
        "CONTACTS": str(contacts), "MEMORY": str(memory), "HASH": request.fingerprint, "LAST": str(grid.N),
        "FAMILIES": comment_text(", ".join(model.constraints) or "none"),
        "STATES": f"{d} of each of {n} bodies, one after the other",
        "UNIT_T": f" ({comment_text(model.units['t'])})" if "t" in model.units else "",
        "STATUSES": prefix_names(structs.status_enum(), name), "WORK": str(request.max_work),
        "SIZE": f"{(memory + 41 * contacts) / 1e6:.3g} MB",
    }  # fmt: skip
    about = {
        "name": name, "title": model.title, "model_class": type(model).__name__, "scheme": BODIES_SCHEME, "paper": model.paper,
        "sizes": {"NX": n * d, "NSTATE": n * d, "NP": 0, "NL": 0, "N": n * d, "M": 0, "BODIES": n, "DIM": d},
        "states": list(model.names), "families": list(model.constraints), "parameters": {}, "multipliers": [], "rows": [],
        "units": dict(model.units), "step": grid.step(0), "any_step": True, "tolerance": request.tolerance, "memory": memory,
        "max_work": request.max_work,
        "used": ["cells for neighbours, groups of bodies that touch, active set and interior point on a sparse L D L'"],
        "left_out": ["pairs that cannot meet in a step, with a check; rows that the solution satisfies"],
        "velocity": False, "force": False, "model_hash": request.fingerprint, "versions": versions(),
    }  # fmt: skip
    files = {
        f"{name}.h": read_fragment("bodies_header.h", frozenset(), replacements),
        f"{name}.c": library_source(model, name),
        "example_main.c": read_fragment("bodies_main.c", frozenset(), replacements),
        "Makefile": read_fragment("Makefile", frozenset(), {"NAME": name}),
        f"{name}.json": json.dumps(about, indent=2) + "\n",
        "README.md": read_fragment("bodies_README.md", frozenset(), replacements),
    }
    return files, about


BODIES_FLAGS = (*("-O3" if flag == "-O2" else flag for flag in PORTABLE), *NATIVE_FLAGS)


def load_cached_library(text: str, name: str) -> MappedLibrary:
    """The compiled ``text``, built once for this processor and kept in the user's cache folder.

    Raises:
        CodegenError: there is no compiler or it fails, or the folder cannot be used.
    """
    by = required_compiler()
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
        s.n, s.tolerance, s.budget = n, tolerance, MAX_COUNT
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
