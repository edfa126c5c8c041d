"""How much work a step takes at most: linear systems solved, index sets tried, sweeps. The constants are those in ``c/``."""

from __future__ import annotations

from collections.abc import Set

from nsmodel.codegen import fixed
from nsmodel.solve.active_set import MOST_INDEX_SETS
from nsmodel.solve.certificate import NumericLaw

MOST_WORK = 2**31 - 1  # What a counter in C holds.
PRIMAL_DUAL_SWEEPS = 12
SEMISMOOTH_ITERATIONS = 60
GAUSS_SEIDEL_SWEEPS = 400
NEWTON_ITERATIONS = {"AFFINE": 3, "other": 30}
NEARBY_SETS = 400
SMOOTH_ITERATIONS = 30
CUT_ITERATIONS = 60
PROBED = 16  # Probes of what the unknowns err by.
REFINED = 5 + PROBED
FRAGILE_REFINED = 2
BANDED_SETS, BANDED_SOLVES = 200, 1 + REFINED  # index sets; the solution on one, its refinements and probes


def work_bound(law: NumericLaw, flags: Set[str], sizes: dict[str, int]) -> int:
    """Most work of a step, by what each of its methods may do when all of them fail in turn."""
    sets = fixed.index_sets(law, MOST_INDEX_SETS)
    bound = 0
    if "FIXED" in flags:
        if "ENUMERATED" in flags:  # strictly, certified, refined
            bound += 1 + FRAGILE_REFINED + sizes["SETS"] * (3 * (1 + FRAGILE_REFINED) + REFINED)
        else:
            bound += (2 + _affine(flags, sizes, sets) if "LAW" in flags else 0) + 2 * REFINED + 3 * FRAGILE_REFINED
    if "BANDED" in flags:
        bound += BANDED_SETS * BANDED_SOLVES
    if "NEWTON" in flags:
        iterations = NEWTON_ITERATIONS["AFFINE" if "AFFINE" in flags else "other"]
        solved = (sizes["M"] + 1 if "ROWS" in flags else 1) * _affine(flags, sizes, sets) if "LAW" in flags else 0
        starts = 2 if "LAW" in flags else 1  # from the last multiplier, then from 0
        bound += starts * (iterations * (solved + 1 + PROBED) + 1 + PROBED)  # and the certificate's last one
        bound += (SMOOTH_ITERATIONS * (1 + PROBED) + 1) * min(NEARBY_SETS, sets) if "NEARBY" in flags else 0
    if "SELECTION" in flags:  # with the active constraints
        bound += _affine(flags, sizes, 3 ** sizes["SELECTION"] * 2 ** sizes["M"])
    if "CUTS" in flags:  # where all cuts cannot be projected on, the new ones alone
        bound += CUT_ITERATIONS * (2 * _affine(flags, sizes, 2 ** sizes["CUTS"]) + 1)
    return max(bound, 1)


def _affine(flags: Set[str], sizes: dict[str, int], sets: int) -> int:
    """Most work in an affine problem with at most ``sets`` index sets."""
    bound = 0
    if "BOX_PROBLEM" in flags:  # primal-dual; Lemke twice (20 pivots a row, 50 more) and its polish; every index set
        bound += PRIMAL_DUAL_SWEEPS + (2 * (20 * sizes["LEMKE"] + 50) + 2 if "PIVOTING" in flags else 0)
        bound += min(sets, MOST_INDEX_SETS) if "ENUMERATION" in flags else 0
    if "CURVED" in flags or "SELECTION_CURVED" in flags:  # from two starts, each once more after Gauss-Seidel sweeps
        bound += 2 * (2 * (SEMISMOOTH_ITERATIONS + 1) + GAUSS_SEIDEL_SWEEPS)
    return bound
