"""The C library of a scene as text: ``<name>.h`` and ``<name>.c``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.codegen import banded, blocks, constants, fixed, inclusion, lanes, newton, residual, sets, statuses, structs
from nsmodel.codegen.bounds import MOST_WORK, work_bound
from nsmodel.codegen.expression import number
from nsmodel.codegen.fragments import CONSTANT, FOLDER, FUNCTION, comment, fragment, guard, prefixed, pruned, resolved
from nsmodel.codegen.loops import c_function
from nsmodel.codegen.needs import flags_of, sizes_of
from nsmodel.codegen.scene import BANDED, FIXED, INCLUSION, Scene
from nsmodel.codegen.tables import table
from nsmodel.model.driven import inputs_at_start
from nsmodel.proof.sure import sure
from nsmodel.scheme import constraints, initial_rows, start_of
from nsmodel.solve.build import start_state
from nsmodel.solve.layout import Layout
from nsmodel.solve.newton import WORKING_SET_ABOVE


@dataclass(frozen=True)
class Source:
    """The C of one scene: ``files`` by name; ``flags``: what the code has; ``sizes``: the constants of the header."""

    name: str
    header: str
    code: str
    rollout: str
    flags: frozenset[str]
    sizes: dict[str, int]
    bound: int


def write_source(scene: Scene, name: str, fingerprint: str, most: int = MOST_WORK, *, in_lanes: bool = False) -> Source:
    """Return the C library of a scene under the prefix ``name``; no step does more work than ``most``.

    ``in_lanes``: whether its batches have many runs in step (see `lanes`).
    """
    flags = flags_of(scene)
    sizes = sizes_of(scene, flags)
    bound = min(work_bound(scene.law, flags, sizes), most)
    words = _words(name, scene, flags, sizes, bound, fingerprint)

    def part(file: str) -> str:
        return fragment(file, flags, words)

    groups = ("fixed", "banded", "newton", "affine", "inclusion")
    struct = [f"members_{group}.h" for group in groups if _has_memory(group, flags, sizes)]
    words["MEMBERS"] = "".join(map(part, struct))
    own = prefixed(_tables(scene, flags) + "\n" + _functions(scene, flags), name)
    parts = [
        part("prelude.c"),
        part("common.c"),
        *([part("times.c")] if "BLOCKS" in flags else []),
        own,
        *(part(file) for file in _FRAGMENTS if _has(file.removesuffix(".c"), flags)),
    ]
    code = pruned("\n".join(parts))
    run_flags = flags | _run_flags(scene, flags)
    functions = _records(scene)
    has = {"batch": scene.of_all, "lanes": in_lanes, "adaptive": "ADAPTIVE" in run_flags and not in_lanes}
    loops = ["rollout.c", *(f"{name}.c" for name in ("adaptive", "batch", "lanes") if has[name])]
    if in_lanes:
        own, more = lanes.text(scene)
        functions, words = f"{functions}\n{own}", words | more
    rollout = prefixed(functions, name) + "\n" + "".join(fragment(file, run_flags, words) for file in loops)
    rollout = f'#include "{name}.c"\n\n{_missing(rollout, code)}{rollout}'
    words["SIZES"] = _inner_sizes(name, sizes, part("header.h") + code + rollout)
    return Source(name, part("header.h"), code, rollout, flags, sizes, bound)


def _has_memory(group: str, flags: frozenset[str], sizes: dict[str, int]) -> bool:
    """Whether the work arrays of a group of fragments are needed."""
    return sizes["LINEAR"] > 0 if group == "affine" else _has(group, flags)


def _missing(text: str, code: str) -> str:
    """The constants and the common functions that ``text`` uses and ``code`` does not have."""
    common = resolved((FOLDER / "common.c").read_text(encoding="utf-8"), frozenset())
    used = pruned(constants.of_steps() + common + "\n" + text)
    wanted = [match[0] for pattern in (CONSTANT, FUNCTION) for match in pattern.finditer(used) if match[0] not in text]
    return "".join(piece for piece in wanted if piece not in code)


_FRAGMENTS = [
    f"{name}.c"
    for name in "solvers rounding linear affine curved lemke fixed banded newton rows inclusion state blocks api".split()
]


def _has(part: str, flags: frozenset[str]) -> bool:
    """Whether a fragment belongs into the code."""
    return {
        "fixed": "FIXED" in flags,
        "banded": "BANDED" in flags,
        "newton": "NEWTON" in flags,
        "rows": "ROWS" in flags,
        "inclusion": "INCLUSION" in flags,
        "affine": "AFFINE_PROBLEM" in flags,
        "lemke": "PIVOTING" in flags,
        "curved": "CURVED" in flags,
        "blocks": "BLOCKS" in flags,
    }.get(part, True)


def _words(name: str, scene: Scene, flags: frozenset[str], sizes: dict[str, int], bound: int, fingerprint: str) -> dict[str, str]:
    model, problem = scene.model, scene.problem
    one = "MODEL_STEP to 1e-12: the matrices in the code belong to it" if scene.path in (FIXED, BANDED) else "MODEL_STEP"
    known = " or ".join(number(h).text for h in scene.known_lengths if h)
    moved = "last difference of positions" if problem.difference else "velocity"
    last = moved if problem.velocity else "reaction of the last step"
    layout = inclusion.layout(scene)
    behind = [f"the {last}"] if {"VELOCITY", "FORCE"} & flags else []
    behind += ["the inputs at the begin and at the end of a step"] if problem.inputs else []
    carried = "".join(f", then {what}" for what in behind)
    return {
        "NAME": name,
        "GUARD": guard(),
        "CONSTANTS": constants.of_steps(),
        "SOLVERS": statuses.solvers(),
        "STATUSES": prefixed(statuses.enumeration(), name),
        "STATUS_CASES": prefixed(statuses.cases(), name),
        "TITLE": comment(model.title) or type(model).__name__,
        "SCHEME": problem.scheme,
        "NAMES": "\n".join([" *", *(f" *   {head:12} {text}" for head, text in names(scene).items() if text)]),
        "CARRIED": carried,
        "STEP": number(scene.h).text,
        "TOLERANCE": number(scene.tolerance).text,
        "BOUND": str(bound),
        "HASH": fingerprint,
        "STEP_RULE": prefixed(one, name) if "ONE_STEP" in flags else known if "KNOWN_LENGTHS" in flags else "a finite number > 0",
        "UNIT_T": f", {comment(model.units['t'])}" if "t" in model.units else "",
        "SIZES": "",
        "MATRICES": "".join(f", s->newton.{key}" for key in newton.outputs(scene)),
        "COLUMNS": _columns(layout, problem.records),
        "WIDTH": str(layout.width),
        "ROW_RESIDUAL": residual.of_row(),
        "TOTALS": prefixed(structs.TOTALS.c(), name),
        "CONTROL": prefixed(structs.CONTROL.c(), name),
        "CELLS": prefixed(structs.CELLS.c(), name),
    } | {key: str(value) for key, value in sizes.items()}


_PUBLIC = {"NX", "NSTATE", "NP", "NU", "NZ", "NW", "NL", "N", "M"}


def _inner_sizes(name: str, sizes: dict[str, int], text: str) -> str:
    """The sizes of the work arrays that ``text`` has."""
    seen = set(re.findall(r"\w+", text))
    inner = {key: value for key, value in sizes.items() if key not in _PUBLIC and f"{name.upper()}_{key}" in seen}
    lines = "".join(f"#define MODEL_{key} {value}\n" for key, value in inner.items())
    return prefixed(f"\n/* Sizes of what a step works in. */\n{lines}", name) if lines else ""


def _columns(layout: Layout, records: Iterable[str]) -> str:
    """Where each quantity of a packed row begins, and where what the scheme records does, as an enum of C."""
    starts = {name: part.start for name, part in layout.slices.items()}
    starts["records"] = min((starts[name] for name in records), default=layout.width)
    return f"enum {{ {', '.join(f'AT_{name.upper()} = {start}' for name, start in starts.items())} }};"


def names(scene: Scene) -> dict[str, str]:
    """What stands where in the arrays, with units."""
    units = scene.model.units

    def listed(names: Iterable[str]) -> str:
        each = [comment(f"{name} [{units[name]}]" if name in units else name) for name in names]
        return ", ".join(each if len(each) <= 40 else [*each[:39], f"... ({len(each)} in all)"])

    multipliers = scene.problem.multiplier_names
    own = {"x": scene.model.names, "p": scene.parameters, **scene.places.names(scene.model), "multipliers": multipliers}
    return {head: listed(names) for head, names in own.items()}


def _tables(scene: Scene, flags: frozenset[str]) -> str:
    """The law, the start, the default parameters."""
    law, lines = scene.law, []
    if "LAW" in flags:
        if "LAW_OF_PARAMETERS" in flags:
            lines.append("#define LOWER s->lower\n#define UPPER s->upper\n")
            lines += [table("bounded_below", np.isfinite(law.lower), "MODEL_M", "sides that the law bounds", "int"),
                      table("bounded_above", np.isfinite(law.upper), "MODEL_M", kind="int")]  # fmt: skip
        else:
            lines += [table("lower", law.lower, "MODEL_M", "ends of the law"), table("upper", law.upper, "MODEL_M")]
            lines.append("#define LOWER lower\n#define UPPER upper\n")
    if "CURVED" in flags:
        lines.append(sets.text(inclusion.law_of_sets(scene), "CURVED_OF_PARAMETERS" in flags))
    if scene.parameters:
        lines.append(table("default_p", list(scene.parameters.values()), "MODEL_NP"))
    lines.append(f"#define START_STEPS {1 if scene.model.tied_to_step else 0}\n")
    return "".join(lines)


def _functions(scene: Scene, flags: frozenset[str]) -> str:
    """The model's own functions."""
    problem, h = scene.problem, scene.h
    known = _known(scene)
    given = {"s->h": problem.h} | ({"s->p": problem.p} if problem.p.numel() else {})
    parts = [c_function("start", given, {"x": _start(scene)}, "the start")]
    if "LAW_OF_PARAMETERS" in flags:
        parts.append(c_function("law_of_parameters", {"s->p": problem.p}, _bounds(scene), "the ends of the law"))
    if "FIXED" in flags:
        parts.append(fixed.text(problem, scene.structure, scene.law, sure(scene.matrices), scene.known_lengths, scene.several))
    if "BANDED" in flags:
        parts.append(banded.text(problem, scene.structure, h, sure(scene.band)))
    if "NEWTON" in flags:
        parts.append(newton.text(scene, known))
    if "INCLUSION" in flags:
        parts.append(inclusion.text(scene))
    if "BLOCKS" in flags:
        parts.append(blocks.text(scene.model, scene.places))
    out = {"x_next": problem.next_state}
    if "REWRITTEN" in flags:
        out |= {"multipliers": sure(problem.multipliers), "outputs": sure(problem.outputs)}
    one = {"FIXED", "BANDED"} & flags and "LENGTHS" not in flags
    values = {key: ca.substitute(e, problem.h, h) for key, e in out.items()} if one else out
    parts.append(
        c_function(
            "advance",
            _solved(scene),
            values,
            "the next state" + (", the multipliers as declared" if "REWRITTEN" in flags else ""),
        )
    )
    return "\n".join(parts)


def _known(scene: Scene) -> dict[str, ca.SX]:
    """What a step knows when it begins, by the C names; the problem of an inclusion begins at the predictor."""
    problem, state = scene.problem, "s->work.predictor" if scene.path == INCLUSION else "s->x"
    h = "AT.h" if scene.path == FIXED and scene.several else "s->h"
    known = {"s->t": problem.t, h: problem.h, state: problem.state, "s->p": problem.p}
    return {key: value for key, value in known.items() if value.numel()}


def _solved(scene: Scene) -> dict[str, ca.SX]:
    """What it knows when it is solved."""
    problem = scene.problem
    return _known(scene) | {"z": problem.z} | ({"l": problem.l, "y": problem.y} if problem.l.numel() else {})


def _bounds(scene: Scene) -> dict[str, ca.SX]:
    """The ends of the law as expressions of the parameters; the numbers of curved blocks."""
    law = scene.problem.law
    given = sets.numbers(law)
    return {"lower": ca.densify(law.lower), "upper": ca.densify(law.upper)} | ({"numbers": given} if given.numel() else {})


def _start(scene: Scene) -> ca.SX:
    """The state that a run starts from, as an expression of h and the parameters."""
    own = start_of(scene.model, scene.problem.h)
    if own is not None:
        return own
    x0 = scene.model.start
    if scene.of_all:  # room for what is carried, which the code finds
        inputs = np.tile(inputs_at_start(scene.model), 2)
        return ca.vertcat(x0, ca.SX.zeros(scene.problem.state.numel() - x0.numel() - inputs.size), inputs)
    numbers = initial_rows(scene.numbers, scene.h)[-1][0]
    carried = start_state(scene.problem_of_numbers, numbers, scene.h, scene.tolerance)
    return ca.vertcat(x0, ca.DM(carried[x0.numel() :]))


def _records(scene: Scene) -> str:
    """Further columns of a run, computed while the old state is still there."""
    problem = scene.problem
    if not problem.records:
        return ""
    return c_function("records", _solved(scene), {"columns": ca.vertcat(*(ca.vec(e) for e in problem.records.values()))})


def _run_flags(scene: Scene, flags: frozenset[str]) -> frozenset[str]:
    """What only whole runs have: further columns; a look at W where it may cease to be monotone; error control."""
    structure = scene.structure
    watched = {"NEWTON", "LAW"} <= flags and structure.m <= WORKING_SET_ABOVE and not (scene.by_rows or structure.gram)
    projected, kept = bool(scene.problem.gap), bool(constraints(scene.model).numel())
    has = {
        "RECORDS": bool(scene.problem.records),
        "MONOTONE": watched,
        "ADAPTIVE": not {"ONE_STEP", "INCLUSION"} & flags and (projected or not kept),
        "CLOSING": projected,
    }
    return frozenset(name for name, holds in has.items() if holds)
