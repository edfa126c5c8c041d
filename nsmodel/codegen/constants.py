"""The numbers that Python and C share: each stands in the module whose algorithm it belongs to, and is printed from there."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from functools import cache
from importlib import import_module

from nsmodel.codegen.expression import c_number

STEP_CONSTANTS: Mapping[str, str] = {
    "grid": "SAME_STEP_TOLERANCE:SAME",
    "signals.signal": "NEAR_TOLERANCE:NEAR",
    "solve.certificate": "ROUNDING NEGLIGIBLE UNRESOLVED REACH GROWTH CLEAR STRICTER",
    "solve.rounding": "PROBES FRAGILE WORTH INSIDE SUM_ERROR SPREAD MIXED STIRRED",
    "solve.active_set": "MAX_INDEX_SETS:MOST_INDEX_SETS PRIMAL_DUAL_SWEEPS CANCELLED EQUILIBRATIONS NOUGHT REGULARISED "
    "PIVOTS_EACH PIVOTS_MORE GONE PREFERRED PIVOT_ERROR MIN_PIVOT:LEAST_PIVOT TIED RANK POLISHED",
    "solve.curved": "SEMISMOOTH_ITERATIONS GAUSS_SEIDEL_SWEEPS SWEPT CONVERGED ACCEPTED ARMIJO MIN_DAMPED_STEP:LEAST_STEP",
    "solve.kernel": "ILL_CONDITIONED",
    "solve.whole_system": "NEWTON_ITERATIONS REFINEMENTS HALVINGS EARLY",
    "solve.linearised": "ENOUGH",
    "solve.newton": "GAIN EXTRA_ROW_OPERATIONS:BESIDE",
    "solve.build": "NEARBY_SETS",
    "solve.sparse": "PIVOTED_SETS PATIENCE SHIFT",
    "solve.band": "SINGULAR_PIVOT",
    "solve.structure": "MONOTONE_ERROR",
    "solve.projection": "USED CUT_ITERATIONS CUT_TOLERANCE ACTS BISECTIONS",
    "laws.ellipsoid": "MULTIPLIER_ITERATIONS",
    "codegen.bounds": "AFFINE_ITERATIONS FRAGILE_REFINEMENTS",
    "codegen.statuses": "READY",
}
BODIES_CONSTANTS: Mapping[str, str] = {"solve.certificate": "REACH", "solve.near": "FARTHER", "codegen.statuses": "READY"}
PIECE_CONSTANTS: Mapping[str, str] = {
    "pieces.integrator": "MIN_RTOL:LEAST_RTOL ROOM UNITS OCTAVES LONGER STUMP AROUND STARTS TOO_SHORT "
    "MAX_UNDECIDED_MOTION:TOLD HARDLY",
    "pieces.ending": "SHORTENINGS CAUTION",
    "pieces.known": "SAME_TIME",
    "pieces.accumulation": "TINY_PIECES TINY MANY FASTER SPACINGS",
    "pieces.modes": "GERM ORDERS CLEAR HALF PACES HALVED PIVOTS TOGETHER MAX_NUDGES:LATER ULP MAX_NUDGE:MOST_CREEP FEW "
    "GERM_DIFFERENCE:APART",
    "pieces.moves": "PROJECTIONS",
    "pieces.switches": "TIE",
    "pieces.bernstein": "NONE NARROW ITERATIONS EXACT",
    "pieces.roots": "POLISHING POLISHED ON_ONE TAIL LOST DIP STEEP INSTANT MIN_PART:LEAST_PART",
    "pieces.isolation": "ALMOST CLOSER WIDER MAX_DISCS:MOST_DISCS MAX_MULTIPLICITY:MOST_MULTIPLE DEGREE NEAR",
    "pieces.lengths": "BEYOND LOCAL ROUGHEST LONGEST MULTIPLIERS PASSES FIRST SMALL",
    "pieces.defect": "POINT SEEN SEEN_ROW",
    "pieces.discs": "MAX_EXPONENT:MOST_EXPONENT PRODUCT_ROUNDINGS FUNCTION_ROUNDINGS",
    "pieces.series": "TWO_OVER_ROOT_PI",
    "pieces.schwarz": "RADIUS_OF_BALL WIDE_RADIUS CLOSE_RADIUS PROVED NEARLY SHRINKINGS SLOWLY QUICKLY AT_REST "
    "CANCELLED AS_NOW MAX_STILL_PIECES:MOST_STILL CAPS CAP_OCTAVES FAR GROWS",
    "pieces.lines": "NEAR_0 STEEPER",
    "pieces.cover": "SMALLEST COVER_RADIUS COVER_DEGREE",
    "pieces.sizes": "ROUNDING NEGLIGIBLE",
    "pieces.multipliers": "SINGULAR MAX_MINOR_ROWS:MOST_MINORS BALANCING NOTHING SHORT",
    "pieces.system": "NEWTON NEWTON_CONVERGED:SETTLED HELD_ORDERS LITTLE RESTS AT_ZERO",
    "pieces.settled": "STAYS",
    "pieces.stiff": "WORTH STAY SMOOTH INSIDE OCTAVES_MORE SAFE ENDINGS ENDED MOVED MAX_WAIT_OCTAVES:MOST_WAIT",
    "pieces.radau": "STAGE_ITERATIONS STAGE_CONVERGED:STAGE_SETTLED SLOW STAGE_NEAR STAGE_ROUNDING ORDERS_OF_TWO",
    "codegen.statuses": "READY",
}


def step_defines() -> str:
    """What a step uses, as lines of C; ``fragments.prune_unused`` leaves out what a scene does not."""
    return _define_lines(STEP_CONSTANTS)


def bodies_defines() -> str:
    """What the step of many bodies uses."""
    return _define_lines(BODIES_CONSTANTS)


def piece_defines() -> str:
    """What event-driven integration uses."""
    return _define_lines(PIECE_CONSTANTS)


def _define_lines(table: Mapping[str, str]) -> str:
    return "".join(define_line(module, name) for module, names in table.items() for name in names.split())


@cache
def define_line(module: str, constant: str) -> str:
    """``#define name value``, with the comment that the constant has in its module; ``constant`` is NAME, or NAME:NAME_IN_C."""
    name, _, in_c = constant.partition(":")
    owner = import_module(f"nsmodel.{module}")
    value = getattr(owner, name)
    text = _short_float(value) if isinstance(value, float) else str(value) if value < 2**31 else f"{value}UL"
    comment = re.search(rf"^(?:\w+, )*{name}\b[^#\n]*(?:# (.*))?$", inspect.getsource(owner), re.MULTILINE)
    about = f" /* {comment[1]} */" if comment and comment[1] else ""
    return f"#define {in_c or name} {text}{about}\n"


def _short_float(value: float) -> str:
    short = f"{value:g}"
    return short if "e" in short and float(short) == value else c_number(value).text
