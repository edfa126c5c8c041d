"""What the code of a scene needs: the flags that choose its parts, the sizes of its arrays.

Four ways to step: banded (large, sparse, numbers for one h: tables of the nonzeros, one band factored where the index set
changes), fixed (matrices as numbers for one h; the last index set first, its inverse kept; for several h the same code reads
arrays that `form_matrices` fills once a length, a function of h alone), newton (E and Y linearised; matrices kept where they are
constant, one linearisation where the problem is affine), inclusion (select, predict, project). WORST_CASE forms all inverses in
`init` and picks an index set by its signs, all of them each time.

What the code of a scene uses and what it leaves out, in words.

How much work a step takes at most: linear systems solved, index sets tried, sweeps.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from nsmodel.codegen import constant_steps, laws, varying_steps
from nsmodel.codegen.step_spec import BANDED, FIXED, INCLUSION, NEWTON, StepSpec
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.active_set import MAX_INDEX_SETS, PIVOTS_EACH, PIVOTS_MORE, PRIMAL_DUAL_SWEEPS
from nsmodel.solvers.catching_up import CUT_ITERATIONS
from nsmodel.solvers.friction_contacts import MAX_MODES, is_in_the_plane, mode_count
from nsmodel.solvers.linearisation import NEWTON_ITERATIONS, REFINEMENTS
from nsmodel.solvers.mlcp import GAUSS_SEIDEL_SWEEPS, REGULARISATIONS, SEMISMOOTH_ITERATIONS
from nsmodel.solvers.plan import MAX_ENUMERATED_ROWS
from nsmodel.solvers.residuals import NumericLaw
from nsmodel.solvers.rounding_errors import PROBES
from nsmodel.solvers.sparse import PIVOTED_SETS
from nsmodel.solvers.structure import MAX_STEP_SIZES, is_eigenvalue_nonnegative, least_eigenvalue
from nsmodel.solvers.time_stepper import NEARBY_SETS

# Memory for the inverses of index sets, 16 KB: half of the first cache.
# Between 2 and 8 are kept, of several lengths 4 times as many.
MAPS_BYTES = 16 << 10


def flags_of(spec: StepSpec) -> frozenset[str]:
    """What the code of a scene has, as the flags of the fragments in ``c/``."""
    has = _implied_flags(spec, _property_flags(spec))
    return frozenset(name for name, holds in has.items() if holds)


def _property_flags(spec: StepSpec) -> dict[str, bool]:
    """The flags that say what the scene is."""
    structure, law, problem, stepped = spec.structure, spec.law, spec.problem, _uses_newton(spec)
    return {
        "LAW": structure.m > 0,
        "FIXED": spec.path == FIXED,
        "LENGTHS": _has_lengths(spec),
        "BANDED": spec.path == BANDED,
        "NEWTON": stepped,
        "INCLUSION": spec.path == INCLUSION,
        "AFFINE": structure.affine,
        "CONSTANT": structure.constant and stepped,
        "IDENTITY": structure.identity,
        "TERMS": stepped and varying_steps.is_rounding_bounded_by_terms(spec),
        "EXPLICIT": stepped and bool(problem.explicit) and not structure.affine,
        "ROWS": spec.uses_working_set,
        "ENUMERATION": structure.m <= MAX_ENUMERATED_ROWS or _enumerates_index_sets(spec),
        "FEEDTHROUGH": spec.jacobians[3].nnz() > 0,
        "TRANSPOSED": stepped and varying_steps.is_jacobian_transposed(spec),
        "PROJECTION": structure.projection,
        "UNIT_ROWS": bool(structure.unit_rows),
        "OVERREACH": problem.overreach is not None,
        "FOLLOW_ROWS": bool(structure.follow_rows),
        "REST_ROWS": bool(structure.rest_rows),
        "EXACT_ROWS": bool(structure.unit_rows or structure.rest_rows),
        "PARAMETERS": bool(spec.parameters),
        "LAW_OF_PARAMETERS": spec.law_of_parameters,
        "RANGES": problem.ranges.numel() > 0,
        "CHECKED_PARAMETERS": spec.law_of_parameters or problem.ranges.numel() > 0,
        "CURVED_OF_PARAMETERS": spec.law_of_parameters and laws.curved_block_numbers(problem.law).numel() > 0,
        "REWRITTEN": problem.multipliers is not None,
        "MULTIPLIERS": structure.m > 0 or problem.multipliers is not None,
        "VELOCITY": bool(problem.velocity),
        "DIFFERENCE": bool(problem.velocity) and problem.difference,
        "FORCE": problem.start is not None,
        "FIXED_MAPS": spec.path == FIXED and structure.m > 0 and not law.curved,
        "ONE_STEP": (spec.path in (FIXED, BANDED) and not _has_lengths(spec)) or varying_steps.is_step_fixed_by_tolerance(spec),
        "INPUTS": spec.problem.inputs > 0,
        "GIVEN": bool(spec.places.given),
        "BLOCKS": spec.ticking,
        "MEMORY": bool(spec.places.memory),
        "HELD": bool(spec.places.held),
        "PULSES": bool(spec.places.pulses),
        "RESTARTED": spec.finds_restart_reaction,
        "BEGUN": spec.finds_start_reaction,
        "RENEWED": spec.finds_restart_reaction or spec.finds_start_reaction,
    } | varying_steps.inclusion_flags(spec)


def _implied_flags(spec: StepSpec, given: dict[str, bool]) -> dict[str, bool]:
    """The flags that follow: how the affine problems of the step are solved."""
    structure, law, stepped, few, has = spec.structure, spec.law, _uses_newton(spec), _enumerates_index_sets(spec), dict(given)
    has["CURVED"] = bool(law.curved) or has.get("SELECTION_CURVED", False)
    has["FRICTION"] = not law.is_normal_cone
    has["CONTACTS_IN_PLANE"] = has["FRICTION"] and is_in_the_plane(law) and mode_count(law) <= MAX_MODES
    has["ENUMERATED"] = has["FIXED_MAPS"] and few
    has["WORST_CASE"] = has["ENUMERATED"] and spec.worst_case
    has["KNOWN_LENGTHS"] = has["WORST_CASE"] and has["LENGTHS"]
    has["SETTLED"] = has["FIXED_MAPS"] and not has["ENUMERATED"]
    has["REGULAR_SETS"] = has["ENUMERATED"] and not has["LENGTHS"] and _regular_sets_suffice(spec)
    has["REFINED"] = stepped and has["LAW"] and structure.affine and not law.curved
    has["KEPT"] = stepped and (has["REFINED"] or not structure.affine)
    has["AFFINE_PROBLEM"] = (has["LAW"] and (stepped or spec.path == FIXED) and not has["ENUMERATED"]) or has.get("GRAM", False)
    has["BOX_PROBLEM"] = has["AFFINE_PROBLEM"] and not law.curved
    has["PIVOTING"] = has["BOX_PROBLEM"] and (has.get("GRAM", False) or not (few and structure.gram))
    has["NEARBY"] = (
        stepped and has["LAW"] and not (few and structure.affine) and constant_steps.index_set_count(law, MAX_INDEX_SETS) > 0
    )
    has["SIDES"] = has["NEARBY"] and spec.problem.has_infinite_slopes
    has["INDEX_SETS"] = has["NEARBY"] or (has["BOX_PROBLEM"] and has["ENUMERATION"])
    has["INVERTED"] = has["FIXED_MAPS"] or has["LENGTHS"]
    has["INVERSE"] = has["INVERTED"] or has["PIVOTING"]
    return has


def _has_lengths(spec: StepSpec) -> bool:
    """Whether matrices of several lengths are kept."""
    return spec.path == FIXED and spec.has_several_lengths


def _uses_newton(spec: StepSpec) -> bool:
    return spec.path == NEWTON or varying_steps.solves_projection(spec)


def _enumerates_index_sets(spec: StepSpec) -> bool:
    """Whether every index set is tried: then a psd W needs no pivoting."""
    return constant_steps.index_set_count(spec.law) > 0


def _regular_sets_suffice(spec: StepSpec) -> bool:
    """Whether a solvable step has a solution on an index set whose block of W is regular: W psd and each row with an end, by
    Lemke's method, which ends in such a set (Cottle, Pang and Stone, Theorem 4.4.12).
    """
    W, law = not_none(spec.matrices).W, spec.law
    has_end = np.isfinite(law.lower) | np.isfinite(law.upper)
    return bool(has_end.all()) and is_eigenvalue_nonnegative(least_eigenvalue(W), law.size)


def sizes_of(spec: StepSpec, flags: frozenset[str]) -> dict[str, int]:
    """The constants of the header by name, without prefix."""
    n, m, law, problem = spec.structure.n, spec.structure.m, spec.law, spec.problem
    rows = min(m, 4 * n) if spec.uses_working_set else m
    sizes = {
        "NX": len(spec.model.names),
        "NSTATE": len(spec.model.names) if spec.path == INCLUSION else problem.state.numel(),
        "NU": len(spec.places.given),
        "NZ": len(spec.places.memory),
        "NW": len(spec.places.held),
        "INPUTS": problem.inputs,
        "PULSES": len(spec.places.pulses),
        "NP": len(spec.parameters),
        "NL": m if problem.multipliers is None else problem.multipliers.numel(),
        "N": n,
        "M": m,
        "ROWS": rows,
        "LEMKE": _lemke_size(law, rows, spec.uses_working_set),
        "CURVED": len(law.curved),
        "BLOCK": 0,
        "NUMBERS": 0,
        "UNIT": len(spec.structure.unit_rows),
        "FOLLOW": len(spec.structure.follow_rows),
        "REST": len(spec.structure.rest_rows),
        "EXPLICIT": len(problem.explicit),
        "SETS": constant_steps.index_set_count(law) if m and spec.path == FIXED else 0,
        "LINEAR": 0,
        "MAPS": int(np.clip(MAPS_BYTES // (8 * m * (m + 2) + 1), 2, 8)) * (4 if "LENGTHS" in flags else 1),
        "LENGTHS": len(spec.known_lengths) if "KNOWN_LENGTHS" in flags else MAX_STEP_SIZES,
    }
    if "WORST_CASE" in flags:
        sizes["MAPS"] = sizes["SETS"] * (sizes["LENGTHS"] if "LENGTHS" in flags else 1)
    if spec.uses_working_set:
        sizes |= {"Y_Z": spec.jacobians[2].nnz(), "E_L": spec.jacobians[1].nnz()}
    sizes |= varying_steps.inclusion_sizes(spec, sizes)
    if "CURVED" in flags:
        own = varying_steps.curved_set_law(spec)
        sizes |= {
            "BLOCK": max(block.size for _, block in laws.curved_blocks(own)),
            "NUMBERS": max(1, laws.curved_block_numbers(own).numel()),
        }
    if spec.path == BANDED:
        sizes |= constant_steps.band_sizes(not_none(spec.band))
    systems = {"AFFINE_PROBLEM": sizes["ROWS"], "FIXED_MAPS": m, "PIVOTING": sizes["LEMKE"], "NEARBY": n + m, "LENGTHS": n + m}
    return sizes | {"LINEAR": max((size for flag, size in systems.items() if flag in flags), default=0)}


def _lemke_size(law: NumericLaw, rows: int, by_rows: bool) -> int:
    """Rows of the standard form: each row once, free rows twice, one more for two finite ends."""
    if by_rows:
        return rows
    lower, upper = np.isfinite(law.lower), np.isfinite(law.upper)
    return rows + int((~lower & ~upper).sum() + (lower & upper).sum())


def describe_used(flags: Set[str], sizes: dict[str, int]) -> list[str]:
    """What a step does, a line for each part."""
    kept = "formed when a solver is initialised" if "WORST_CASE" in flags else "kept"
    box = "a primal-dual active set method" + ", then Lemke's pivoting" * ("PIVOTING" in flags)
    friction = "contacts with friction: the last modes first" + ", all modes last" * ("CONTACTS_IN_PLANE" in flags)
    lines = {
        "matrices formed once for a length of steps; those of the {LENGTHS} lengths used last are kept": "LENGTHS" in flags,
        "matrices written down as numbers for one time step": "FIXED" in flags and "LENGTHS" not in flags,
        "sparse matrices written down for one time step: a band of {BELOW} + 1 + {ABOVE} diagonals, factored again where the "
        "index set changes": "BANDED" in flags,
        "index sets: the last one, then block principal pivoting from it": {"BANDED", "LAW"} <= flags,
        "matrices factored when the step or a parameter is set, not in each step": {"NEWTON", "CONSTANT"} <= flags,
        "one linearisation a step: E and Y are affine in the unknowns": {"NEWTON", "AFFINE"} <= flags and "CONSTANT" not in flags,
        "Newton's method with exact Jacobians": "NEWTON" in flags and "AFFINE" not in flags,
        f"the last index set first; the inverses of {{FEW}} index sets are {kept}": "FIXED_MAPS" in flags,
        "then that of {SETS} index sets which is least violated": "WORST_CASE" in flags,
        "then all {SETS} index sets, the nearest first": "ENUMERATED" in flags and "WORST_CASE" not in flags,
        box + ", then every index set" * ("ENUMERATION" in flags): "BOX_PROBLEM" in flags and "ENUMERATED" not in flags,
        "semismooth Newton for curved sets, block Gauss-Seidel behind it": bool({"CURVED", "SELECTION_CURVED"} & flags),
        friction: "FRICTION" in flags,
        "where Newton's method does not settle, the index sets around the last one": "NEARBY" in flags,
        "projection on bounds: a clip": {"INCLUSION", "BOX_C"} <= flags,
        "approximate projection by an outer polyhedron": "CUTS" in flags,
    }
    few = sizes["MAPS"] if "LENGTHS" in flags else min(sizes["MAPS"], sizes["SETS"])
    numbers = sizes | {"FEW": few, "ABOVE": sizes.get("UPPER", 0) - sizes.get("BELOW", 0)}
    return [line.format_map(numbers) for line, holds in lines.items() if holds]


def describe_left_out(flags: Set[str]) -> list[str]:
    """What the scene does not need, and why."""
    few_sets = "ENUMERATED" in flags or ("BOX_PROBLEM" in flags and "PIVOTING" not in flags)
    lines = {
        "multipliers and every solver of a law: the model has none": "LAW" not in flags,
        "Newton's method, Jacobians, dense matrices: the matrices are constant and sparse": "BANDED" in flags,
        "Newton's method, Jacobians, linear systems in the state: the matrices are constant": "FIXED" in flags,
        "linear systems in the state: E_z is the identity": {"NEWTON", "IDENTITY"} <= flags,
        "pivoting and quadratic programming: the index sets are few": few_sets,
        "rows that the prediction satisfies: they enter only if the solution violates them": "ROWS" in flags,
        "a solver for the projection: C is a box": {"INCLUSION", "BOX_C"} <= flags,
        "parameters: all are numbers in the code": "PARAMETERS" not in flags,
    }
    return [line for line, holds in lines.items() if holds]


MAX_COUNT = 2**31 - 1  # The largest number that an int of 32 bits in C holds: what a step may count to.
AFFINE_ITERATIONS = 3  # Of Newton's method where the problem is affine: one solves it, more remove rounding.
FRAGILE_REFINEMENTS = 2  # Where elimination keeps too little of the system: each adds as many digits as elimination keeps.
PROBE_SOLVES = 2 * PROBES  # Two for each probe: of what the unknowns err by, and of how ill-conditioned their system is.
REFINEMENT_SOLVES = REFINEMENTS + PROBE_SOLVES  # Linear systems for one refined answer, at most.


def work_bound(law: NumericLaw, flags: Set[str], sizes: dict[str, int]) -> int:
    """Most work of a step, by what each of its methods may do when all of them fail in turn."""
    sets = constant_steps.index_set_count(law, MAX_INDEX_SETS)
    bound = 0
    if "FIXED" in flags:
        bound += 1 if "LENGTHS" in flags else 0  # the matrices of a new one
        if "WORST_CASE" in flags:  # the last one, all, the least violated, refined
            bound += 2 * (1 + FRAGILE_REFINEMENTS) + sizes["SETS"] + REFINEMENT_SOLVES
        elif "ENUMERATED" in flags:  # strictly, certified, refined
            bound += 1 + FRAGILE_REFINEMENTS + sizes["SETS"] * (3 * (1 + FRAGILE_REFINEMENTS) + REFINEMENT_SOLVES)
        else:
            bound += (
                (2 + _affine_work(flags, sizes, sets) if "LAW" in flags else 0) + 2 * REFINEMENT_SOLVES + 3 * FRAGILE_REFINEMENTS
            )
    if "BANDED" in flags:
        bound += PIVOTED_SETS * (1 + REFINEMENT_SOLVES)  # the solution on each, its refinements and probes
    if "NEWTON" in flags:
        iterations = AFFINE_ITERATIONS if "AFFINE" in flags else NEWTON_ITERATIONS
        solved = (sizes["M"] + 1 if "ROWS" in flags else 1) * _affine_work(flags, sizes, sets) if "LAW" in flags else 0
        starts = 2 if "LAW" in flags else 1  # from the last multiplier, then from 0
        bound += starts * (iterations * (solved + 1 + PROBE_SOLVES) + 1 + PROBE_SOLVES)  # and the certificate's last one
        bound += (NEWTON_ITERATIONS * (1 + PROBE_SOLVES) + 1) * min(NEARBY_SETS, sets) if "NEARBY" in flags else 0
    if "SELECTION" in flags:  # with the active constraints
        bound += _affine_work(flags, sizes, 3 ** sizes["SELECTION"] * 2 ** sizes["M"])
    if "CUTS" in flags:  # where all cuts cannot be projected on, the new ones alone
        bound += CUT_ITERATIONS * (2 * _affine_work(flags, sizes, 2 ** sizes["CUTS"]) + 1)
    return max(bound, 1) * (2 if "RESTARTED" in flags else 1)


def _affine_work(flags: Set[str], sizes: dict[str, int], sets: int) -> int:
    """Most work in an affine problem with at most ``sets`` index sets."""
    bound = 0
    if "BOX_PROBLEM" in flags:  # primal-dual; Lemke twice and its polish; every index set
        bound += PRIMAL_DUAL_SWEEPS + (2 * (PIVOTS_EACH * sizes["LEMKE"] + PIVOTS_MORE) + 2 if "PIVOTING" in flags else 0)
        bound += min(sets, MAX_INDEX_SETS) if "ENUMERATION" in flags else 0
    if "CURVED" in flags or "SELECTION_CURVED" in flags:  # from two starts, each once more after Gauss-Seidel sweeps
        bound += 2 * (2 * (SEMISMOOTH_ITERATIONS + 1) + GAUSS_SEIDEL_SWEEPS)
    if "FRICTION" in flags:  # the last modes, those that stick; all modes, each polished
        bound += (
            3
            + (4 + REGULARISATIONS) * (SEMISMOOTH_ITERATIONS + 1)
            + GAUSS_SEIDEL_SWEEPS
            + (2 * MAX_MODES if "CONTACTS_IN_PLANE" in flags else 0)
        )
    return bound
