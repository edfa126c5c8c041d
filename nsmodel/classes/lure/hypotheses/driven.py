"""Lur'e systems with inputs, which stand in f, in the offset e of y or in the ends of the law; none but 7.1 asks for f.

x' + A(x) ∋ f(t) with A + omega maximal monotone has a solution for each integrable f, which in finite dimension is absolutely
continuous; two solutions of one f part as those without f do. Of an e that moves the theorems say nothing.

Where K(t) moves and stays bounded, B (D + N_K(t)^-1)^-1 is at each time maximal monotone (in the units of 5.1), defined
everywhere and bounded: a solution exists for ends that are measurable in t (Filippov 1988, Section 7), and two part as those
of one K do. An end of an interval [a(t), inf) adds B a to f and D a to e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses import for_all
from nsmodel.classes.lure.hypotheses.passivity import LURE_PAPER
from nsmodel.classes.lure.hypotheses.range_condition import MOVING_OFFSET_NOTE
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.inputs import InputBounds, unknown_consequence
from nsmodel.hypotheses.moving_law import law_time_as_input
from nsmodel.hypotheses.region import Region
from nsmodel.proof import interval_bounds
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"f": ("f",), "e": ("e",), "law": ("law",)}
INTEGRABLE_SOURCE = f"{LURE_PAPER}, Corollary 5.7; for integrable f Brezis 1973, Chapter III"
BOUNDED_SOURCE = f"{LURE_PAPER}, Section 5, at each time; for K(t) bounded and measurable Filippov 1988, Section 7"
STABILITY_NAMES = ("Lyapunov stable", "globally asymptotically stable")
SIGNAL_PHRASES = {
    "one and only one solution starts": "for each signal one and only one absolutely continuous solution starts",
    "any two solutions": "any two solutions of one signal",
}


def driven_findings(
    model: LureSystem, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those for constant inputs: none asks how f moves; see the inclusions' module of this name."""
    del model, region, motion, runs, quick
    return list(own)


def driven_consequences(
    model: LureSystem, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows for each signal; nothing is at rest that a signal drives."""
    del runs
    made = [item for item in for_all.uniform_consequences(model, region, own) if item.name not in STABILITY_NAMES]
    for few, whole in SIGNAL_PHRASES.items():
        made = [replace(item, statement=item.statement.replace(few, whole)) for item in made]
    made = [replace(item, source=INTEGRABLE_SOURCE) if item.name == "well posed" else item for item in made]
    if motion.indices_read_by(model.e) or _has_moving_half_line(model, motion):
        return [unknown_consequence(item, MOVING_OFFSET_NOTE) for item in made]
    if motion.indices_read_by(model.law):
        made = [replace(item, source=BOUNDED_SOURCE) if item.name == "well posed" else item for item in made]
    low, high = region.parameter_bounds()
    last = max(region.t1, float(model.t_end or 0.0))
    bounded = interval_bounds.enclose(model.f, ca.vertcat(model.t, model.p), np.append(region.t0, low), np.append(last, high))
    return made if np.isfinite(bounded).all() else [unknown_consequence(item, "f is not seen to be bounded") for item in made]


def freeze_law(model: LureSystem) -> LureSystem:
    """The system with time in its law as an input: at each time K has numbers."""
    return law_time_as_input(model)


def _has_moving_half_line(model: LureSystem, motion: InputBounds) -> bool:
    """Whether the finite end of an interval without end moves, and D hands it on to y."""
    if model.law is None:
        return False
    moves = model.law.moves(motion.u)
    ends = zip(ca.vertsplit(model.law.lower), ca.vertsplit(model.law.upper), strict=True)
    endless = [any(side.is_constant() and not np.isfinite(float(side)) for side in pair) for pair in ends]
    boxes = [block.separable for block in model.law.blocks for _ in range(block.size)]
    rows = [i for i, both in enumerate(zip(moves, endless, boxes, strict=True)) if all(both)]
    return any(not model.D[:, i].is_zero() for i in rows)
