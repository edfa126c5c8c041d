"""What the code of a scene uses and what it leaves out, in words."""

from __future__ import annotations

from collections.abc import Set


def describe_used(flags: Set[str], sizes: dict[str, int]) -> list[str]:
    """What a step does, a line for each part."""
    lines = []
    if "LENGTHS" in flags:
        lines.append(f"matrices formed once for a length of steps; those of the {sizes['LENGTHS']} lengths used last are kept")
    elif "FIXED" in flags:
        lines.append("matrices written down as numbers for one time step")
    elif "BANDED" in flags:
        lines.append(
            f"sparse matrices written down for one time step: a band of {sizes['BELOW']} + 1 + {sizes['UPPER'] - sizes['BELOW']} "
            "diagonals, factored again where the index set changes"
        )
        if "LAW" in flags:
            lines.append("index sets: the last one, then block principal pivoting from it")
    elif "NEWTON" in flags and "CONSTANT" in flags:
        lines.append("matrices factored when the step or a parameter is set, not in each step")
    elif "NEWTON" in flags and "AFFINE" in flags:
        lines.append("one linearisation a step: E and Y are affine in the unknowns")
    elif "NEWTON" in flags:
        lines.append("Newton's method with exact Jacobians")
    if "FIXED_MAPS" in flags:
        kept = "formed when a solver is initialised" if "WORST_CASE" in flags else "kept"
        few = sizes["MAPS"] if "LENGTHS" in flags else min(sizes["MAPS"], sizes["SETS"])
        lines.append(f"the last index set first; the inverses of {few} index sets are {kept}")
    if "WORST_CASE" in flags:
        lines.append(f"then that of {sizes['SETS']} index sets which is least violated")
    elif "ENUMERATED" in flags:
        lines.append(f"then all {sizes['SETS']} index sets, the nearest first")
    elif "BOX_PROBLEM" in flags:
        pivoting = ", then Lemke's pivoting" if "PIVOTING" in flags else ""
        more = ", then every index set" if "ENUMERATION" in flags else ""
        lines.append(f"a primal-dual active set method{pivoting}{more}")
    if "CURVED" in flags or "SELECTION_CURVED" in flags:
        lines.append("semismooth Newton for curved sets, block Gauss-Seidel behind it")
    if "NEARBY" in flags:
        lines.append("where Newton's method does not settle, the index sets around the last one")
    if "INCLUSION" in flags and "BOX_C" in flags:
        lines.append("projection on bounds: a clip")
    if "CUTS" in flags:
        lines.append("approximate projection by an outer polyhedron")
    return lines


def describe_left_out(flags: Set[str]) -> list[str]:
    """What the scene does not need, and why."""
    lines = []
    if "LAW" not in flags:
        lines.append("multipliers and every solver of a law: the model has none")
    if "BANDED" in flags:
        lines.append("Newton's method, Jacobians, dense matrices: the matrices are constant and sparse")
    if "FIXED" in flags:
        lines.append("Newton's method, Jacobians, linear systems in the state: the matrices are constant")
    elif "NEWTON" in flags and "IDENTITY" in flags:
        lines.append("linear systems in the state: E_z is the identity")
    if "ENUMERATED" in flags or ("BOX_PROBLEM" in flags and "PIVOTING" not in flags):
        lines.append("pivoting and quadratic programming: the index sets are few")
    if "ROWS" in flags:
        lines.append("rows that the prediction satisfies: they enter only if the solution violates them")
    if "INCLUSION" in flags and "BOX_C" in flags:
        lines.append("a solver for the projection: C is a box")
    if "PARAMETERS" not in flags:
        lines.append("parameters: all are numbers in the code")
    return lines
