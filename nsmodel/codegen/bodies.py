"""The step of many bodies as C: the model's functions for a pair, and the parts in ``c/`` that search, group and solve.

In `c/group.c` a group is min |w|^2/2, G w + b >= 0. Small changes: primal-dual active set from the last step. Else Mehrotra's
interior point on I + G' Theta G until the index set shows (mean of m s below 1e-6), then the active set; where that does not
settle, an augmented Lagrangian with Newton's method and an exact line search, which converges from anywhere. Every way ends on
an index set solved to 1e-13 of the largest speed. One factorisation serves all (`c/block_ldl.c`): blocks of d x d,
multifrontal, in an order that the positions give: minimum degree for the loose ends, then nested dissection by the fewest
bodies that separate two sides within a band (as many as paths between the sides that do not meet: a maximal flow). The memory
of a step is one arena given from outside: a step is a pure function, and a library without allocation is the same code.
"""

from __future__ import annotations

import json
from collections.abc import Set
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.groups import Family
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BODIES_SCHEME, BodiesProblem, uses_neighbour_search
from nsmodel.codegen import fragments, structs
from nsmodel.codegen import structs as statuses
from nsmodel.codegen.expressions import c_function, c_table
from nsmodel.codegen.features import MAX_WORK
from nsmodel.codegen.fragments import comment_text, compiler_guard, prefix_names, prune_unused, read_fragment
from nsmodel.errors import CodegenError
from nsmodel.modeling.fingerprint import versions
from nsmodel.modeling.time_grid import TimeGrid

BODIES_FRAGMENTS = ("block_ldl.c", "group.c", "bodies.c")
MAX_BODIES = 20_000  # Bodies whose numbers are written into a library.
CONTACTS_PER_BODY = 6  # Room for contacts of each body in a library,
MEMORY_PER_BODY = 16_384  # and bytes to work in, and
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
            f"#define DIM {d}\n{fragments.bodies_defines()}",
            statuses.status_enum(),
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
        fragments.bodies_defines(), *_bodies_fragments(), _model_functions(model), _model_tables(model),
        read_fragment("bodies_api.c", frozenset(), {"STATUS_CASES": statuses.status_cases()}),
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


def bodies_library_files(
    model: ManyBodies, name: str, grid: TimeGrid, tolerance: float, fingerprint: str, most: int = MAX_WORK
) -> tuple[dict[str, str], dict[str, Any]]:
    """Every file of the library by name, and what it is, for programs; no step does more work than ``most``.

    Raises:
        CodegenError: f is a function of numbers, there are more than MOST bodies, a reach depends on t.
    """
    n, d = model.bodies.q0.shape
    if model.is_driven:
        raise CodegenError(
            f"many bodies with inputs ({', '.join(model.input_groups)}) have no C counterpart: put numbers in their place"
        )
    if not isinstance(model.f, ca.SX):
        raise CodegenError("f is a Python function; for C it must be an expression of one body's symbols (and t)")
    if n > MAX_BODIES:
        raise CodegenError(f"{n} bodies: their numbers are written into the source, which is made for up to {MAX_BODIES}")
    memory, contacts = BASE_MEMORY + MEMORY_PER_BODY * n, 64 + CONTACTS_PER_BODY * n
    replacements = {
        "NAME": name, "UPPER": name.upper(), "TITLE": comment_text(" ".join(model.title.split()) or name),
        "SCHEME": BODIES_SCHEME,
        "BODIES": str(n), "DIM": str(d), "NX": str(n * d), "STEP": repr(grid.step(0)), "TOLERANCE": repr(tolerance),
        "CONTACTS": str(contacts), "MEMORY": str(memory), "HASH": fingerprint, "LAST": str(grid.N),
        "FAMILIES": comment_text(", ".join(model.constraints) or "none"),
        "STATES": f"{d} of each of {n} bodies, one after the other",
        "UNIT_T": f" ({comment_text(model.units['t'])})" if "t" in model.units else "",
        "STATUSES": prefix_names(statuses.status_enum(), name), "WORK": str(most),
        "SIZE": f"{(memory + 41 * contacts) / 1e6:.3g} MB",
    }  # fmt: skip
    about = {
        "name": name, "title": model.title, "model_class": type(model).__name__, "scheme": BODIES_SCHEME, "paper": model.paper,
        "sizes": {"NX": n * d, "NSTATE": n * d, "NP": 0, "NL": 0, "N": n * d, "M": 0, "BODIES": n, "DIM": d},
        "states": list(model.names), "families": list(model.constraints), "parameters": {}, "multipliers": [], "rows": [],
        "units": dict(model.units), "step": grid.step(0), "any_step": True, "tolerance": tolerance, "memory": memory,
        "max_work": most,
        "used": ["cells for neighbours, groups of bodies that touch, active set and interior point on a sparse L D L'"],
        "left_out": ["pairs that cannot meet in a step, with a check; rows that the solution satisfies"],
        "velocity": False, "force": False, "model_hash": fingerprint, "versions": versions(),
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
