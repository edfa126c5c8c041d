"""What the code of a scene needs: the flags that choose its parts, the sizes of its arrays."""

from __future__ import annotations

import numpy as np

from nsmodel.codegen import fixed, inclusion, newton, sets
from nsmodel.codegen.scene import BANDED, FIXED, INCLUSION, NEWTON, StepSpec
from nsmodel.proof.sure import not_none
from nsmodel.solve.active_set import MAX_INDEX_SETS
from nsmodel.solve.certificate import NumericLaw
from nsmodel.solve.choose import MAX_ENUMERATED_ROWS
from nsmodel.solve.structure import is_eigenvalue_nonnegative, least_eigenvalue

MAPS_BYTES = 16 << 10  # Memory for the inverses of index sets; between 2 and 8 are kept, of several lengths 4 times as many.


def flags_of(spec: StepSpec) -> frozenset[str]:
    """What the code of a scene has, as the flags of the fragments in ``c/``."""
    has = _implied_flags(spec, _property_flags(spec))
    return frozenset(name for name, holds in has.items() if holds)


def _property_flags(spec: StepSpec) -> dict[str, bool]:
    """The flags that say what the scene is."""
    structure, law, problem, stepped = spec.structure, spec.law, spec.problem, _uses_newton(spec)
    return (
        {
            "LAW": structure.m > 0,
            "FIXED": spec.path == FIXED,
            "LENGTHS": _has_lengths(spec),
            "BANDED": spec.path == BANDED,
            "NEWTON": stepped,
            "INCLUSION": spec.path == INCLUSION,
            "AFFINE": structure.affine,
            "CONSTANT": structure.constant and stepped,
            "IDENTITY": structure.identity,
            "TERMS": stepped and newton.is_rounding_bounded_by_terms(spec),
            "EXPLICIT": stepped and bool(problem.explicit) and not structure.affine,
            "ROWS": spec.uses_working_set,
            "ENUMERATION": structure.m <= MAX_ENUMERATED_ROWS or _enumerates_index_sets(spec),
            "FEEDTHROUGH": spec.jacobians[3].nnz() > 0,
            "TRANSPOSED": stepped and newton.is_jacobian_transposed(spec),
            "PROJECTION": structure.projection,
            "UNIT_ROWS": bool(structure.unit_rows),
            "OVERREACH": problem.overreach is not None,
            "FOLLOW_ROWS": bool(structure.follow_rows),
            "REST_ROWS": bool(structure.rest_rows),
            "EXACT_ROWS": bool(structure.unit_rows or structure.rest_rows),
            "PARAMETERS": bool(spec.parameters),
            "LAW_OF_PARAMETERS": spec.law_of_parameters,
            "CURVED_OF_PARAMETERS": spec.law_of_parameters and sets.curved_block_numbers(problem.law).numel() > 0,
            "REWRITTEN": problem.multipliers is not None,
            "MULTIPLIERS": structure.m > 0 or problem.multipliers is not None,
            "VELOCITY": bool(problem.velocity),
            "DIFFERENCE": bool(problem.velocity) and problem.difference,
            "FORCE": problem.state.numel() - 2 * problem.inputs > len(spec.model.names) and not problem.velocity,
            "FIXED_MAPS": spec.path == FIXED and structure.m > 0 and not law.curved,
            "ONE_STEP": (spec.path in (FIXED, BANDED) and not _has_lengths(spec)) or inclusion.is_step_fixed_by_tolerance(spec),
        }
        | _input_flags(spec)
        | inclusion.inclusion_flags(spec)
    )


def _input_flags(spec: StepSpec) -> dict[str, bool]:
    """The flags that say what drives the scene."""
    return {
        "INPUTS": spec.problem.inputs > 0,
        "GIVEN": bool(spec.places.given),
        "BLOCKS": spec.ticking,
        "MEMORY": bool(spec.places.memory),
        "HELD": bool(spec.places.held),
        "PULSES": bool(spec.places.pulses),
        "RESTARTED": spec.finds_restart_reaction,
        "BEGUN": spec.finds_start_reaction,
        "RENEWED": spec.finds_restart_reaction or spec.finds_start_reaction,
    }


def _implied_flags(spec: StepSpec, given: dict[str, bool]) -> dict[str, bool]:
    """The flags that follow: how the affine problems of the step are solved."""
    structure, law, stepped, few, has = spec.structure, spec.law, _uses_newton(spec), _enumerates_index_sets(spec), dict(given)
    has["CURVED"] = bool(law.curved) or has.get("SELECTION_CURVED", False)
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
    has["NEARBY"] = stepped and has["LAW"] and not (few and structure.affine) and fixed.index_set_count(law, MAX_INDEX_SETS) > 0
    has["INDEX_SETS"] = has["NEARBY"] or (has["BOX_PROBLEM"] and has["ENUMERATION"])
    has["INVERTED"] = has["FIXED_MAPS"] or has["LENGTHS"]
    has["INVERSE"] = has["INVERTED"] or has["PIVOTING"]
    return has


def _has_lengths(spec: StepSpec) -> bool:
    """Whether matrices of several lengths are kept."""
    return spec.path == FIXED and spec.has_several_lengths


def _uses_newton(spec: StepSpec) -> bool:
    return spec.path == NEWTON or inclusion.solves_projection(spec)


def _enumerates_index_sets(spec: StepSpec) -> bool:
    """Whether every index set is tried: then a psd W needs no pivoting."""
    return fixed.index_set_count(spec.law) > 0


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
        "SETS": fixed.index_set_count(law) if m and spec.path == FIXED else 0,
        "LINEAR": 0,
        "MAPS": int(np.clip(MAPS_BYTES // (8 * m * (m + 2) + 1), 2, 8)) * (4 if "LENGTHS" in flags else 1),
        "LENGTHS": len(spec.known_lengths) if "KNOWN_LENGTHS" in flags else fixed.MAX_LENGTHS,
    }
    if "WORST_CASE" in flags:
        sizes["MAPS"] = sizes["SETS"] * (sizes["LENGTHS"] if "LENGTHS" in flags else 1)
    if spec.uses_working_set:
        sizes |= {"Y_Z": spec.jacobians[2].nnz(), "E_L": spec.jacobians[1].nnz()}
    sizes |= inclusion.inclusion_sizes(spec, sizes)
    if "CURVED" in flags:
        own = inclusion.curved_set_law(spec)
        sizes |= {
            "BLOCK": max(block.size for _, block in sets.curved_blocks(own)),
            "NUMBERS": max(1, sets.curved_block_numbers(own).numel()),
        }
    if spec.path == BANDED:
        sizes |= not_none(spec.band).sizes
    systems = {"AFFINE_PROBLEM": sizes["ROWS"], "FIXED_MAPS": m, "PIVOTING": sizes["LEMKE"], "NEARBY": n + m, "LENGTHS": n + m}
    return sizes | {"LINEAR": max((size for flag, size in systems.items() if flag in flags), default=0)}


def _lemke_size(law: NumericLaw, rows: int, by_rows: bool) -> int:
    """Rows of the standard form: each row once, free rows twice, one more for two finite ends."""
    if by_rows:
        return rows
    lower, upper = np.isfinite(law.lower), np.isfinite(law.upper)
    return rows + int((~lower & ~upper).sum() + (lower & upper).sum())
