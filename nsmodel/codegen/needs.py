"""What the code of a scene needs: the flags that choose its parts, the sizes of its arrays."""

from __future__ import annotations

import numpy as np

from nsmodel.codegen import fixed, inclusion, newton, sets
from nsmodel.codegen.scene import BANDED, FIXED, INCLUSION, NEWTON, Scene
from nsmodel.proof.sure import sure
from nsmodel.solve.active_set import MOST_INDEX_SETS
from nsmodel.solve.certificate import NumericLaw
from nsmodel.solve.choose import ENUMERATE_UP_TO
from nsmodel.solve.structure import is_monotone, least_eigenvalue

MAPS_BYTES = 16 << 10  # Memory for the inverses of index sets; between 2 and 8 are kept, of several lengths 4 times as many.


def flags_of(scene: Scene) -> frozenset[str]:
    """What the code of a scene has, as the flags of the fragments in ``c/``."""
    has = _implied(scene, _read_off(scene))
    return frozenset(name for name, holds in has.items() if holds)


def _read_off(scene: Scene) -> dict[str, bool]:
    """The flags that say what the scene is."""
    structure, law, problem, stepped = scene.structure, scene.law, scene.problem, _is_stepped(scene)
    return (
        {
            "LAW": structure.m > 0,
            "FIXED": scene.path == FIXED,
            "LENGTHS": _has_lengths(scene),
            "BANDED": scene.path == BANDED,
            "NEWTON": stepped,
            "INCLUSION": scene.path == INCLUSION,
            "AFFINE": structure.affine,
            "CONSTANT": structure.constant and stepped,
            "IDENTITY": structure.identity,
            "TERMS": stepped and newton.bounded_by_terms(scene),
            "EXPLICIT": stepped and bool(problem.explicit) and not structure.affine,
            "ROWS": scene.by_rows,
            "ENUMERATION": structure.m <= ENUMERATE_UP_TO or _has_few_sets(scene),
            "FEEDTHROUGH": scene.jacobians[3].nnz() > 0,
            "TRANSPOSED": stepped and newton.transposed(scene),
            "PROJECTION": structure.projection,
            "UNIT_ROWS": bool(structure.unit_rows),
            "OVERREACH": problem.overreach is not None,
            "FOLLOW_ROWS": bool(structure.follow_rows),
            "REST_ROWS": bool(structure.rest_rows),
            "EXACT_ROWS": bool(structure.unit_rows or structure.rest_rows),
            "PARAMETERS": bool(scene.parameters),
            "LAW_OF_PARAMETERS": scene.law_of_parameters,
            "CURVED_OF_PARAMETERS": scene.law_of_parameters and sets.numbers(problem.law).numel() > 0,
            "REWRITTEN": problem.multipliers is not None,
            "MULTIPLIERS": structure.m > 0 or problem.multipliers is not None,
            "VELOCITY": bool(problem.velocity),
            "DIFFERENCE": bool(problem.velocity) and problem.difference,
            "FORCE": problem.state.numel() - 2 * problem.inputs > len(scene.model.names) and not problem.velocity,
            "FIXED_MAPS": scene.path == FIXED and structure.m > 0 and not law.curved,
            "ONE_STEP": (scene.path in (FIXED, BANDED) and not _has_lengths(scene)) or inclusion.one_step(scene),
        }
        | _of_inputs(scene)
        | inclusion.flags(scene)
    )


def _of_inputs(scene: Scene) -> dict[str, bool]:
    """The flags that say what drives the scene."""
    return {
        "INPUTS": scene.problem.inputs > 0,
        "GIVEN": bool(scene.places.given),
        "BLOCKS": scene.ticking,
        "MEMORY": bool(scene.places.memory),
        "HELD": bool(scene.places.held),
        "PULSES": bool(scene.places.pulses),
        "RESTARTED": scene.restarted,
        "BEGUN": scene.begun,
        "RENEWED": scene.restarted or scene.begun,
    }


def _implied(scene: Scene, given: dict[str, bool]) -> dict[str, bool]:
    """The flags that follow: how the affine problems of the step are solved."""
    structure, law, stepped, few, has = scene.structure, scene.law, _is_stepped(scene), _has_few_sets(scene), dict(given)
    has["CURVED"] = bool(law.curved) or has.get("SELECTION_CURVED", False)
    has["ENUMERATED"] = has["FIXED_MAPS"] and few
    has["WORST_CASE"] = has["ENUMERATED"] and scene.worst_case
    has["KNOWN_LENGTHS"] = has["WORST_CASE"] and has["LENGTHS"]
    has["SETTLED"] = has["FIXED_MAPS"] and not has["ENUMERATED"]
    has["REGULAR_SETS"] = has["ENUMERATED"] and not has["LENGTHS"] and _regular_sets_suffice(scene)
    has["REFINED"] = stepped and has["LAW"] and structure.affine and not law.curved
    has["KEPT"] = stepped and (has["REFINED"] or not structure.affine)
    has["AFFINE_PROBLEM"] = (has["LAW"] and (stepped or scene.path == FIXED) and not has["ENUMERATED"]) or has.get("GRAM", False)
    has["BOX_PROBLEM"] = has["AFFINE_PROBLEM"] and not law.curved
    has["PIVOTING"] = has["BOX_PROBLEM"] and (has.get("GRAM", False) or not (few and structure.gram))
    has["NEARBY"] = stepped and has["LAW"] and not (few and structure.affine) and fixed.index_sets(law, MOST_INDEX_SETS) > 0
    has["INDEX_SETS"] = has["NEARBY"] or (has["BOX_PROBLEM"] and has["ENUMERATION"])
    has["INVERTED"] = has["FIXED_MAPS"] or has["LENGTHS"]
    has["INVERSE"] = has["INVERTED"] or has["PIVOTING"]
    return has


def _has_lengths(scene: Scene) -> bool:
    """Whether matrices of several lengths are kept."""
    return scene.path == FIXED and scene.several


def _is_stepped(scene: Scene) -> bool:
    return scene.path == NEWTON or inclusion.projects(scene)


def _has_few_sets(scene: Scene) -> bool:
    """Whether every index set is tried: then a psd W needs no pivoting."""
    return fixed.index_sets(scene.law) > 0


def _regular_sets_suffice(scene: Scene) -> bool:
    """Whether a solvable step has a solution on an index set whose block of W is regular: W psd and each row with an end, by
    Lemke's method, which ends in such a set (Cottle, Pang and Stone, Theorem 4.4.12).
    """
    W, law = sure(scene.matrices).W, scene.law
    has_end = np.isfinite(law.lower) | np.isfinite(law.upper)
    return bool(has_end.all()) and is_monotone(least_eigenvalue(W), law.size)


def sizes_of(scene: Scene, flags: frozenset[str]) -> dict[str, int]:
    """The constants of the header by name, without prefix."""
    n, m, law, problem = scene.structure.n, scene.structure.m, scene.law, scene.problem
    rows = min(m, 4 * n) if scene.by_rows else m
    sizes = {
        "NX": len(scene.model.names),
        "NSTATE": len(scene.model.names) if scene.path == INCLUSION else problem.state.numel(),
        "NU": len(scene.places.given),
        "NZ": len(scene.places.memory),
        "NW": len(scene.places.held),
        "INPUTS": problem.inputs,
        "PULSES": len(scene.places.pulses),
        "NP": len(scene.parameters),
        "NL": m if problem.multipliers is None else problem.multipliers.numel(),
        "N": n,
        "M": m,
        "ROWS": rows,
        "LEMKE": _lemke_size(law, rows, scene.by_rows),
        "CURVED": len(law.curved),
        "BLOCK": 0,
        "NUMBERS": 0,
        "UNIT": len(scene.structure.unit_rows),
        "FOLLOW": len(scene.structure.follow_rows),
        "REST": len(scene.structure.rest_rows),
        "EXPLICIT": len(problem.explicit),
        "SETS": fixed.index_sets(law) if m and scene.path == FIXED else 0,
        "LINEAR": 0,
        "MAPS": int(np.clip(MAPS_BYTES // (8 * m * (m + 2) + 1), 2, 8)) * (4 if "LENGTHS" in flags else 1),
        "LENGTHS": len(scene.known_lengths) if "KNOWN_LENGTHS" in flags else fixed.MOST_LENGTHS,
    }
    if "WORST_CASE" in flags:
        sizes["MAPS"] = sizes["SETS"] * (sizes["LENGTHS"] if "LENGTHS" in flags else 1)
    if scene.by_rows:
        sizes |= {"Y_Z": scene.jacobians[2].nnz(), "E_L": scene.jacobians[1].nnz()}
    sizes |= inclusion.sizes(scene, sizes)
    if "CURVED" in flags:
        own = inclusion.law_of_sets(scene)
        sizes |= {"BLOCK": max(block.size for _, block in sets.curved(own)), "NUMBERS": max(1, sets.numbers(own).numel())}
    if scene.path == BANDED:
        sizes |= sure(scene.band).sizes
    systems = {"AFFINE_PROBLEM": sizes["ROWS"], "FIXED_MAPS": m, "PIVOTING": sizes["LEMKE"], "NEARBY": n + m, "LENGTHS": n + m}
    return sizes | {"LINEAR": max((size for flag, size in systems.items() if flag in flags), default=0)}


def _lemke_size(law: NumericLaw, rows: int, by_rows: bool) -> int:
    """Rows of the standard form: each row once, free rows twice, one more for two finite ends."""
    if by_rows:
        return rows
    lower, upper = np.isfinite(law.lower), np.isfinite(law.upper)
    return rows + int((~lower & ~upper).sum() + (lower & upper).sum())
