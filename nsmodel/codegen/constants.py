"""The numbers that Python and C share: each stands in the module whose algorithm it belongs to, and is printed from there."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from functools import cache
from importlib import import_module

from nsmodel.codegen.expression import number

OF_STEPS: Mapping[str, str] = {
    "grid": "SAME",
    "signals.signal": "NEAR",
    "solve.certificate": "ROUNDING NEGLIGIBLE UNRESOLVED REACH GROWTH CLEAR STRICTER",
    "solve.rounding": "PROBES FRAGILE WORTH INSIDE SUM_ERROR SPREAD MIXED STIRRED",
    "solve.active_set": "MOST_INDEX_SETS PRIMAL_DUAL_SWEEPS CANCELLED EQUILIBRATIONS NOUGHT REGULARISED PIVOTS_EACH PIVOTS_MORE "
    "GONE PREFERRED PIVOT_ERROR LEAST_PIVOT TIED RANK POLISHED",
    "solve.curved": "SEMISMOOTH_ITERATIONS GAUSS_SEIDEL_SWEEPS SWEPT CONVERGED ACCEPTED ARMIJO LEAST_STEP",
    "solve.kernel": "ILL_CONDITIONED",
    "solve.whole_system": "NEWTON_ITERATIONS REFINEMENTS HALVINGS EARLY",
    "solve.linearised": "ENOUGH",
    "solve.newton": "GAIN BESIDE",
    "solve.build": "NEARBY_SETS",
    "solve.sparse": "PIVOTED_SETS PATIENCE SHIFT",
    "solve.band": "SINGULAR_PIVOT",
    "solve.structure": "MONOTONE_ERROR",
    "solve.projection": "USED CUT_ITERATIONS CUT_TOLERANCE ACTS BISECTIONS",
    "laws.ellipsoid": "MULTIPLIER_ITERATIONS",
    "codegen.bounds": "AFFINE_ITERATIONS FRAGILE_REFINEMENTS",
    "codegen.statuses": "READY",
}
OF_BODIES: Mapping[str, str] = {"solve.certificate": "REACH", "solve.near": "FARTHER", "codegen.statuses": "READY"}
OF_PIECES: Mapping[str, str] = {
    "pieces.integrator": "LEAST_RTOL ROOM UNITS OCTAVES LONGER STUMP AROUND STARTS TOO_SHORT TOLD HARDLY",
    "pieces.ending": "SHORTENINGS CAUTION",
    "pieces.known": "SAME_TIME",
    "pieces.accumulation": "TINY_PIECES TINY MANY FASTER SPACINGS",
    "pieces.modes": "GERM ORDERS CLEAR HALF PACES HALVED PIVOTS TOGETHER LATER ULP MOST_CREEP FEW APART",
    "pieces.moves": "PROJECTIONS",
    "pieces.switches": "TIE",
    "pieces.bernstein": "NONE NARROW ITERATIONS EXACT",
    "pieces.roots": "POLISHING POLISHED ON_ONE TAIL LOST DIP STEEP INSTANT LEAST_PART",
    "pieces.isolation": "ALMOST CLOSER WIDER MOST_DISCS MOST_MULTIPLE DEGREE NEAR",
    "pieces.lengths": "BEYOND LOCAL ROUGHEST LONGEST MULTIPLIERS PASSES FIRST SMALL",
    "pieces.defect": "POINT SEEN SEEN_ROW",
    "pieces.discs": "MOST_EXPONENT PRODUCT_ROUNDINGS FUNCTION_ROUNDINGS",
    "pieces.series": "TWO_OVER_ROOT_PI",
    "pieces.schwarz": "RADIUS_OF_BALL WIDE_RADIUS CLOSE_RADIUS PROVED NEARLY SHRINKINGS SLOWLY QUICKLY AT_REST "
    "CANCELLED AS_NOW MOST_STILL CAPS CAP_OCTAVES FAR GROWS",
    "pieces.lines": "NEAR_0 STEEPER",
    "pieces.cover": "SMALLEST COVER_RADIUS COVER_DEGREE",
    "pieces.sizes": "ROUNDING NEGLIGIBLE",
    "pieces.multipliers": "SINGULAR MOST_MINORS BALANCING NOTHING SHORT",
    "pieces.system": "NEWTON SETTLED HELD_ORDERS LITTLE RESTS AT_ZERO",
    "pieces.settled": "STAYS",
    "pieces.stiff": "WORTH STAY SMOOTH INSIDE OCTAVES_MORE SAFE ENDINGS ENDED MOVED MOST_WAIT",
    "pieces.radau": "STAGE_ITERATIONS STAGE_SETTLED SLOW STAGE_NEAR STAGE_ROUNDING ORDERS_OF_TWO",
    "codegen.statuses": "READY",
}


def of_steps() -> str:
    """What a step uses, as lines of C; ``fragments.pruned`` leaves out what a scene does not."""
    return _all(OF_STEPS)


def of_bodies() -> str:
    """What the step of many bodies uses."""
    return _all(OF_BODIES)


def of_pieces() -> str:
    """What event-driven integration uses."""
    return _all(OF_PIECES)


def _all(table: Mapping[str, str]) -> str:
    return "".join(defined(module, name) for module, names in table.items() for name in names.split())


@cache
def defined(module: str, name: str) -> str:
    """``#define name value``, with the comment that the constant has in its module."""
    owner = import_module(f"nsmodel.{module}")
    value = getattr(owner, name)
    text = _float(value) if isinstance(value, float) else str(value) if value < 2**31 else f"{value}UL"
    comment = re.search(rf"^(?:\w+, )*{name}\b[^#\n]*(?:# (.*))?$", inspect.getsource(owner), re.MULTILINE)
    about = f" /* {comment[1]} */" if comment and comment[1] else ""
    return f"#define {name} {text}{about}\n"


def _float(value: float) -> str:
    short = f"{value:g}"
    return short if "e" in short and float(short) == value else number(value).text
