"""How much work a step takes at most: linear systems solved, index sets tried, sweeps."""

from __future__ import annotations

from collections.abc import Set

from nsmodel.codegen import fixed
from nsmodel.solve.active_set import MAX_INDEX_SETS, PIVOTS_EACH, PIVOTS_MORE, PRIMAL_DUAL_SWEEPS
from nsmodel.solve.build import NEARBY_SETS
from nsmodel.solve.certificate import NumericLaw
from nsmodel.solve.curved import GAUSS_SEIDEL_SWEEPS, SEMISMOOTH_ITERATIONS
from nsmodel.solve.projection import CUT_ITERATIONS
from nsmodel.solve.rounding import PROBES
from nsmodel.solve.sparse import PIVOTED_SETS
from nsmodel.solve.whole_system import NEWTON_ITERATIONS, REFINEMENTS

MAX_WORK = 2**31 - 1  # What a counter in C holds.
AFFINE_ITERATIONS = 3  # Of Newton's method where the problem is affine: one solves it, more remove rounding.
FRAGILE_REFINEMENTS = 2  # Where elimination keeps too little of the system.
PROBE_SOLVES = 2 * PROBES  # Probes of what the unknowns err by, and of how ill-conditioned their system is.
REFINEMENT_SOLVES = REFINEMENTS + PROBE_SOLVES


def work_bound(law: NumericLaw, flags: Set[str], sizes: dict[str, int]) -> int:
    """Most work of a step, by what each of its methods may do when all of them fail in turn."""
    sets = fixed.index_set_count(law, MAX_INDEX_SETS)
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
    return bound
