"""The C library of a scene as text: ``<name>.h`` and ``<name>.c``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.codegen import blocks, constant_steps, laws, simd_batch, structs, varying_steps
from nsmodel.codegen.expressions import c_number, c_table, looped_c_function
from nsmodel.codegen.features import MAX_COUNT, flags_of, sizes_of, work_bound
from nsmodel.codegen.fragments import (
    C_FOLDER,
    DEFINE_PATTERN,
    FUNCTION_PATTERN,
    STEP_CONSTANTS,
    comment_text,
    compiler_guard,
    define_lines,
    prefix_names,
    prune_unused,
    read_fragment,
    resolve_conditions,
)
from nsmodel.codegen.step_spec import BANDED, FIXED, INCLUSION, StepSpec
from nsmodel.modeling.variants import initial_inputs
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.newton import WORKING_SET_ABOVE
from nsmodel.solvers.one_step_problem import initial_rows, state_constraints, symbolic_start_state
from nsmodel.solvers.step import RowLayout
from nsmodel.solvers.time_stepper import completed_start_state


@dataclass(frozen=True)
class LibrarySource:
    """The C of one scene: ``files`` by name; ``flags``: what the code has; ``sizes``: the constants of the header."""

    name: str
    header: str
    code: str
    rollout: str
    flags: frozenset[str]
    sizes: dict[str, int]
    bound: int


def write_source(spec: StepSpec, name: str, fingerprint: str, most: int = MAX_COUNT, *, in_lanes: bool = False) -> LibrarySource:
    """Return the C library of a scene under the prefix ``name``; no step does more work than ``most``.

    ``in_lanes``: whether its batches have many runs in step (see `lanes`).
    """
    flags = flags_of(spec)
    sizes = sizes_of(spec, flags)
    bound = min(work_bound(spec.law, flags, sizes), most)
    replacements = _step_replacements(name, spec, flags, sizes, bound, fingerprint)

    def part(file: str) -> str:
        return read_fragment(file, flags, replacements)

    groups = ("fixed", "banded", "newton", "affine", "inclusion")
    struct = [f"members_{group}.h" for group in groups if (sizes["LINEAR"] if group == "affine" else _has_part(group, flags))]
    replacements["MEMBERS"] = "".join(map(part, struct))
    own = prefix_names(_step_tables(spec, flags) + "\n" + _step_functions(spec, flags), name)
    parts = [
        part("prelude.c"),
        part("common.c"),
        *([part("times.c")] if "BLOCKS" in flags else []),
        own,
        *(part(f"{name}.c") for name in _STEP_FRAGMENTS if _has_part(name, flags)),
    ]
    code = prune_unused("\n".join(parts))
    run_flags = flags | _run_flags(spec, flags)
    functions = _record_function(spec)
    has = {"batch": spec.for_all_values, "lanes": in_lanes, "adaptive": "ADAPTIVE" in run_flags and not in_lanes}
    loops = ["rollout.c", *(f"{name}.c" for name in ("adaptive", "batch", "lanes") if has[name])]
    if in_lanes:
        own, more = simd_batch.lanes_code(spec)
        functions, replacements = f"{functions}\n{own}", replacements | more
    rollout = prefix_names(functions, name) + "\n" + "".join(read_fragment(file, run_flags, replacements) for file in loops)
    rollout = f'#include "{name}.c"\n\n{_missing_definitions(rollout, code)}{rollout}'
    replacements["SIZES"] = _inner_sizes(name, sizes, part("header.h") + code + rollout)
    return LibrarySource(name, part("header.h"), code, rollout, flags, sizes, bound)


def _missing_definitions(text: str, code: str) -> str:
    """The constants and the common functions that ``text`` uses and ``code`` does not have."""
    common = resolve_conditions((C_FOLDER / "common.c").read_text(encoding="utf-8"), frozenset())
    used = prune_unused(define_lines(STEP_CONSTANTS) + common + "\n" + text)
    wanted = [
        match[0] for pattern in (DEFINE_PATTERN, FUNCTION_PATTERN) for match in pattern.finditer(used) if match[0] not in text
    ]
    return "".join(piece for piece in wanted if piece not in code)


_STEP_FRAGMENTS = "solvers rounding linear affine curved lemke fixed banded newton rows inclusion state blocks api".split()


def _has_part(part: str, flags: frozenset[str]) -> bool:
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


def _step_replacements(
    name: str, spec: StepSpec, flags: frozenset[str], sizes: dict[str, int], bound: int, fingerprint: str
) -> dict[str, str]:
    model, problem = spec.model, spec.problem
    one = "MODEL_STEP to 1e-12: the matrices in the code belong to it" if spec.path in (FIXED, BANDED) else "MODEL_STEP"
    known = " or ".join(c_number(h).text for h in spec.known_lengths if h)
    layout = varying_steps.packed_layout(spec)
    behind = [problem.carried] if problem.carried else []
    behind += ["the inputs at the begin and at the end of a step"] if problem.inputs else []
    carried = "".join(f", then {what}" for what in behind)
    return {
        "NAME": name,
        "GUARD": compiler_guard(),
        "CONSTANTS": define_lines(STEP_CONSTANTS),
        "SOLVERS": structs.solver_enum(),
        "STATUSES": prefix_names(structs.status_enum(), name),
        "STATUS_CASES": prefix_names(structs.status_cases(), name),
        "TITLE": comment_text(model.title) or type(model).__name__,
        "SCHEME": problem.scheme,
        "NAMES": "\n".join([" *", *(f" *   {head:12} {text}" for head, text in array_names(spec).items() if text)]),
        "CARRIED": carried,
        "STEP": c_number(spec.h).text,
        "TOLERANCE": c_number(spec.tolerance).text,
        "BOUND": str(bound),
        "HASH": fingerprint,
        "STEP_RULE": prefix_names(one, name)
        if "ONE_STEP" in flags
        else known
        if "KNOWN_LENGTHS" in flags
        else "a finite number > 0",
        "UNIT_T": f", {comment_text(model.units['t'])}" if "t" in model.units else "",
        "SIZES": "",
        "MATRICES": "".join(f", s->newton.{key}" for key in varying_steps.evaluated_outputs(spec)),
        "COLUMNS": _column_enum(layout, problem.records),
        "WIDTH": str(layout.width),
        "ROW_RESIDUAL": laws.row_residual_code(),
        "TOTALS": prefix_names(structs.STEP_TOTALS.c(), name),
        "CONTROL": prefix_names(structs.ADAPTIVE_CONTROL.c(), name),
        "CELLS": prefix_names(structs.BATCH_CELLS.c(), name),
    } | {key: str(value) for key, value in sizes.items()}


_PUBLIC_SIZES = {"NX", "NSTATE", "NP", "NU", "NZ", "NW", "NL", "N", "M"}


def _inner_sizes(name: str, sizes: dict[str, int], text: str) -> str:
    """The sizes of the work arrays that ``text`` has."""
    seen = set(re.findall(r"\w+", text))
    inner = {key: value for key, value in sizes.items() if key not in _PUBLIC_SIZES and f"{name.upper()}_{key}" in seen}
    lines = "".join(f"#define MODEL_{key} {value}\n" for key, value in inner.items())
    return prefix_names(f"\n/* Sizes of what a step works in. */\n{lines}", name) if lines else ""


def _column_enum(layout: RowLayout, records: Iterable[str]) -> str:
    """Where each quantity of a packed row begins, and where what the scheme records does, as an enum of C."""
    starts = {name: part.start for name, part in layout.slices.items()}
    starts["records"] = min((starts[name] for name in records), default=layout.width)
    return f"enum {{ {', '.join(f'AT_{name.upper()} = {start}' for name, start in starts.items())} }};"


def array_names(spec: StepSpec) -> dict[str, str]:
    """What stands where in the arrays, with units."""
    units = spec.model.units

    def listed(names: Iterable[str]) -> str:
        each = [comment_text(f"{name} [{units[name]}]" if name in units else name) for name in names]
        return ", ".join(each if len(each) <= 40 else [*each[:39], f"... ({len(each)} in all)"])

    multipliers = spec.problem.multiplier_names
    own = {"x": spec.model.names, "p": spec.parameters, **spec.places.names(spec.model), "multipliers": multipliers}
    return {head: listed(names) for head, names in own.items()}


def _step_tables(spec: StepSpec, flags: frozenset[str]) -> str:
    """The law, the start, the default parameters."""
    law, lines = spec.law, []
    if "LAW" in flags:
        if "LAW_OF_PARAMETERS" in flags:
            lines.append("#define LOWER s->lower\n#define UPPER s->upper\n")
            lines += [c_table("bounded_below", np.isfinite(law.lower), "MODEL_M", "sides that the law bounds", "int"),
                      c_table("bounded_above", np.isfinite(law.upper), "MODEL_M", kind="int")]  # fmt: skip
        else:
            lines += [c_table("lower", law.lower, "MODEL_M", "ends of the law"), c_table("upper", law.upper, "MODEL_M")]
            lines.append("#define LOWER lower\n#define UPPER upper\n")
    if "CURVED" in flags:
        lines.append(laws.curved_sets_code(varying_steps.curved_set_law(spec), "CURVED_OF_PARAMETERS" in flags))
    if spec.parameters:
        lines.append(c_table("default_p", list(spec.parameters.values()), "MODEL_NP"))
    if "RANGES" in flags:
        lines.append(f"#define RANGE_COUNT {spec.problem.ranges.numel()}\n")
    lines.append(f"#define START_STEPS {1 if spec.model.tied_to_step else 0}\n")
    return "".join(lines)


def _step_functions(spec: StepSpec, flags: frozenset[str]) -> str:
    """The model's own functions."""
    problem, h = spec.problem, spec.h
    known = _known_symbols(spec)
    given = {"s->h": problem.h} | ({"s->p": problem.p} if problem.p.numel() else {})
    parts = [looped_c_function("start", given, {"x": _start_expression(spec)}, "the start")]
    if "LAW_OF_PARAMETERS" in flags:
        parts.append(looped_c_function("law_of_parameters", {"s->p": problem.p}, _law_bounds(spec), "the ends of the law"))
    if "RANGES" in flags:
        ranges = {"ranges": ca.densify(problem.ranges)}
        parts.append(looped_c_function("ranges_of_parameters", {"s->p": problem.p}, ranges, ">= 0 where each is in its range"))
    if "FIXED" in flags:
        parts.append(
            constant_steps.fixed_code(
                problem, spec.structure, spec.law, not_none(spec.matrices), spec.known_lengths, spec.has_several_lengths
            )
        )
    if "BANDED" in flags:
        parts.append(constant_steps.banded_code(problem, spec.structure, h, not_none(spec.band)))
    if "NEWTON" in flags:
        parts.append(varying_steps.newton_code(spec, known))
    if "INCLUSION" in flags:
        parts.append(varying_steps.inclusion_code(spec))
    if "BLOCKS" in flags:
        parts.append(blocks.blocks_code(spec.model, spec.places))
    out = {"x_next": problem.next_state}
    if "REWRITTEN" in flags:
        out |= {"multipliers": not_none(problem.multipliers), "outputs": not_none(problem.outputs)}
    one = {"FIXED", "BANDED"} & flags and "LENGTHS" not in flags
    values = {key: ca.substitute(e, problem.h, h) for key, e in out.items()} if one else out
    parts.append(
        looped_c_function(
            "advance",
            _solution_symbols(spec),
            values,
            "the next state" + (", the multipliers as declared" if "REWRITTEN" in flags else ""),
        )
    )
    return "\n".join(parts)


def _known_symbols(spec: StepSpec) -> dict[str, ca.SX]:
    """What a step knows when it begins, by the C names; the problem of an inclusion begins at the predictor."""
    problem, state = spec.problem, "s->work.predictor" if spec.path == INCLUSION else "s->x"
    h = "AT.h" if spec.path == FIXED and spec.has_several_lengths else "s->h"
    known = {"s->t": problem.t, h: problem.h, state: problem.state, "s->p": problem.p}
    return {key: value for key, value in known.items() if value.numel()}


def _solution_symbols(spec: StepSpec) -> dict[str, ca.SX]:
    """What it knows when it is solved."""
    problem = spec.problem
    return _known_symbols(spec) | {"z": problem.z} | ({"l": problem.l, "y": problem.y} if problem.l.numel() else {})


def _law_bounds(spec: StepSpec) -> dict[str, ca.SX]:
    """The ends of the law as expressions of the parameters; the numbers of curved blocks."""
    law = spec.problem.law
    given = laws.curved_block_numbers(law)
    return {"lower": ca.densify(law.lower), "upper": ca.densify(law.upper)} | ({"numbers": given} if given.numel() else {})


def _start_expression(spec: StepSpec) -> ca.SX:
    """The state that a run starts from, as an expression of h and the parameters."""
    own = symbolic_start_state(spec.model, spec.problem.h)
    if own is not None:
        return own
    x0 = spec.model.start
    if spec.for_all_values:  # room for what is carried, which the code finds
        inputs = np.tile(initial_inputs(spec.model), 2)
        return ca.vertcat(x0, ca.SX.zeros(spec.problem.state.numel() - x0.numel() - inputs.size), inputs)
    numbers = initial_rows(spec.numbers, spec.h)[-1][0]
    carried = completed_start_state(spec.numeric_problem, numbers, spec.h, spec.tolerance)
    return ca.vertcat(x0, ca.DM(carried[x0.numel() :]))


def _record_function(spec: StepSpec) -> str:
    """Further columns of a run, computed while the old state is still there."""
    problem = spec.problem
    if not problem.records:
        return ""
    return looped_c_function(
        "records", _solution_symbols(spec), {"columns": ca.vertcat(*(ca.vec(e) for e in problem.records.values()))}
    )


def _run_flags(spec: StepSpec, flags: frozenset[str]) -> frozenset[str]:
    """What only whole runs have: further columns; a look at W where it may cease to be monotone; error control."""
    structure = spec.structure
    watched = {"NEWTON", "LAW"} <= flags and structure.m <= WORKING_SET_ABOVE and not (spec.uses_working_set or structure.gram)
    projected, kept = bool(spec.problem.gap), bool(state_constraints(spec.model).numel())
    has = {
        "RECORDS": bool(spec.problem.records),
        "MONOTONE": watched,
        "ADAPTIVE": not {"ONE_STEP", "INCLUSION"} & flags and (projected or not kept),
        "CLOSING": projected,
    }
    return frozenset(name for name, holds in has.items() if holds)
