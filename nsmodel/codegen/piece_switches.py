"""Whether a model with values switches as the code of all values does: C and the integrator take over from each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.codegen.piece_scene import PieceSpec
from nsmodel.once import cached_per_object
from nsmodel.pieces.sides import fixed_branches
from nsmodel.scheme.continuous import ContinuousProblem

COMPARED_POINTS = 3  # Of t, x, l and choices, at which what switches look at is compared.
SWITCH_TOLERANCE = 1e-8  # Part by which two such numbers may differ.


def has_same_switches(problem: ContinuousProblem, free: ContinuousProblem, values: Sequence[float]) -> bool:
    """Whether the switches of a problem are those of one whose parameters are symbols, one by one, and look at the same.

    An operation may be gone with values, or look at minus what it looked at: then a choice means something else.
    """
    kinds_of_all, watched_of_all = _switch_functions(free)
    if not kinds_of_all:
        return True
    kinds, watched = _switch_functions(problem)
    if kinds != kinds_of_all:
        return False
    rng = np.random.default_rng(0)
    for _ in range(COMPARED_POINTS):
        given = [rng.normal(size=watched.size1_in(i)) for i in range(3)] + [rng.choice([-1.0, 1.0], len(kinds))]
        one, other = (np.array(f(*given, p)).ravel() for f, p in ((watched, np.zeros(0)), (watched_of_all, np.array(values))))
        if not np.allclose(one, other, rtol=SWITCH_TOLERANCE, atol=0, equal_nan=True):
            return False
    return True


@cached_per_object
def _switch_functions(p: ContinuousProblem) -> tuple[list[tuple[str, str]], ca.Function]:
    """Part and kind of each switch; what it looks at, of t, x, l, choices and p."""
    spec = PieceSpec(p, {})
    whole = replace(p, p=ca.veccat(p.p, spec.parameter_parts.symbols))
    B, D, _ = spec.matrices
    of = fixed_branches(whole, {name: made.jets for name, made in spec.printers.items()}, B, D)
    (watched,) = spec.parameter_parts.back([of.values[2]])
    kinds = [(part, kind) for part, _, kind in spec.columns.branches]
    return kinds, ca.Function("watched", [p.t, p.x, p.l, of.choices, p.p], [ca.densify(watched)])
