"""What is lost over a box of parameters: hypotheses that hold at each value tried, and are not decided for all of them.

    python -m tests.search.boxes                          # each factor of each case; the triples that are lost
    python -m tests.search.boxes --case leash --case buck

One number of a case at a time becomes a parameter within 1 % of its value: a parameter of its own, or a factor of a part of it
(a matrix, f, a constraint, a potential, the ends of a law, the start). A triple (case, factor, hypothesis) that holds at the
ends, in the middle and at a value between, but not over the box, is lost.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

import nsmodel
from nsmodel import check, within
from nsmodel.errors import ModelError, UsageError
from nsmodel.modeling.convex_split import split_convex
from nsmodel.modeling.laws import Law
from nsmodel.modeling.model_files import case_files

from .checked import draw

WIDTH = 0.01  # Of a box, beside the value in its middle.
MOST_ROWS = 3  # Constraints of a case that are multiplied one by one.
DEAR = {"crowd_room", "running_track", "evacuation", "leash"}  # Cases whose quick check takes a second or more.
FACTOR = "factor_p"
FACTOR_BOXES = ((0.99, 1.01), (0.9, 1.2), (0.5, 2.0), (0.0, 1.0), (-1.0, 1.0), (0.25, 4.0))  # Of random models.
BOUNDS = {  # Between which values what blocks set stays.
    "sampled_pi": {"w": within(-10, 10)},
    "integrate_and_fire": {"z": within(0, 9)},
    "schmitt_trigger": {"s": within(-1, 1)},
    "sliding_mode": {"w": within(-1, 1)},
    "thermostat": {"u": within(0, 1)},
    "thyristor": {"q": within(0, 1)},
}  # fmt: skip
PARTS = {  # The parts of a model that are multiplied.
    "FirstOrderSystem": ("f", "h", "g", "M", "x0"),
    "LureSystem": ("A", "B", "C", "D", "f", "e", "x0"),
    "SweepingProcess": ("f", "q0"),
    "MonotoneInclusion": ("field", "operator", "x0"),
    "FrictionOscillator": ("force", "damping", "x0", "v0"),
    "ManyBodies": ("f",),
}


class Varied(NamedTuple):
    """A model with one number that is free: its parameter, and the ends of its box."""

    name: str
    model: Any
    parameter: str
    low: float
    high: float


def varied(model: Any) -> Iterator[Varied]:
    """The model with each of its numbers free, one at a time."""
    for name, value in model.parameters.items():
        if value:
            low, high = sorted((value * (1 - WIDTH), value * (1 + WIDTH)))
            yield Varied(name, model, name, low, high)
    p = ca.SX.sym(FACTOR)
    for name, fields in _multiplied(model, p):
        other = copy(model)
        other._set(p=ca.vertcat(model.p, p), parameters={**model.parameters, FACTOR: 1.0}, exact=None, **fields)
        yield Varied(name, other, FACTOR, 1 - WIDTH, 1 + WIDTH)


def drawn(name: str, seed: int) -> Varied | None:
    """A random model of ``checked``, a part of it and a box; None where it has no part that may be multiplied."""
    rng = np.random.default_rng([seed, 4242])
    parts = list(varied(draw(name, seed)))
    if not parts:
        return None
    one = parts[int(rng.integers(len(parts)))]
    low, high = FACTOR_BOXES[int(rng.integers(len(FACTOR_BOXES)))]
    size = (one.low + one.high) / 2
    return one._replace(low=min(low * size, high * size), high=max(low * size, high * size))


def _multiplied(model: Any, p: ca.SX) -> Iterator[tuple[str, dict[str, Any]]]:
    """(what is multiplied by p, fields of the model with p)."""
    for name in PARTS[type(model).__name__]:
        part = getattr(model, name)
        if isinstance(part, ca.SX) and part.numel() and not part.is_zero():
            yield name, {name: p * part}
    law = getattr(model, "law", None)
    if isinstance(law, Law) and (scaled := _scaled_law(law, p)) is not None:
        yield "law", {"law": scaled}
    if getattr(model, "phi", None) is not None and isinstance(model, nsmodel.LureSystem):
        yield "phi", {"phi": p * model.phi, "phi_split": split_convex(p * model.phi, model.y, "phi")}
    if isinstance(model, nsmodel.FrictionOscillator):
        potential = p * model.potential
        if not potential.is_zero():
            yield "potential", {"potential": potential, "potential_split": split_convex(potential, model.x, "potential")}
        for i, element in enumerate(model.elements[:MOST_ROWS]):
            others = (*model.elements[:i], element._replace(theta=p * element.theta), *model.elements[i + 1 :])
            yield f"friction {element.name}", {"elements": others}
    for end in ("lower", "upper") if isinstance(model, nsmodel.MonotoneInclusion) else ():
        rows = [
            row if row.is_constant() and not np.isfinite(float(row)) else p * row for row in ca.vertsplit(getattr(model, end))
        ]
        if ca.depends_on(ca.vertcat(*rows), p):
            yield end, {end: ca.vertcat(*rows)}
    yield from _constraints(model, p)


def _scaled_law(law: Law, p: ca.SX) -> Law | None:
    """The law with its finite numbers times p; None where there are none but 0."""

    def times(column: ca.SX) -> ca.SX:
        rows = [row if row.is_constant() and not np.isfinite(float(row)) else p * row for row in ca.vertsplit(column)]
        return ca.vertcat(*rows)

    boxes = [block for block in law.blocks if block.kind in ("box", "ball")]
    other = Law(tuple(
        block.with_numbers(**{name: times(value) for name, value in block.numbers.items()}) if block in boxes else block
        for block in law.blocks
    ))  # fmt: skip
    numbers = ca.vertcat(*(value for block in other.blocks for value in block.numbers.values()))
    return other if numbers.numel() and ca.depends_on(numbers, p) else None


def _constraints(model: Any, p: ca.SX) -> Iterator[tuple[str, dict[str, Any]]]:
    """Constraints times p, and with p times what is free of states: a gap, a radius, a level."""
    given = getattr(model, "constraints", None) or {}
    state = getattr(model, model.letter)
    for name, own in list(given.items())[:MOST_ROWS]:
        family = not isinstance(own, ca.SX)
        g = own.g if family else own
        symbols = ca.vertcat(*(member.q for member in own.moving)) if family else state
        at_rest = ca.substitute(g, symbols, ca.DM.zeros(symbols.numel()))
        for what, changed in (("", p * g), ("gap of ", g + (p - 1) * at_rest)):
            if what and (at_rest.is_zero() or not np.isfinite(_size(at_rest))):
                continue
            yield f"{what}{name}", {"constraints": {**given, name: replace(own, g=changed) if family else changed}}


def _size(expression: ca.SX) -> float:
    """What it is where all symbols are 1."""
    f = ca.Function("f", [ca.vertcat(*ca.symvar(expression))], [expression])
    return float(np.abs(np.array(f(np.ones(f.size1_in(0))))).max(initial=0.0))


def held_and_lost(one: Varied, **options: Any) -> tuple[list[str], dict[str, str]]:
    """The ids of the hypotheses that hold at each value tried, and {id: why} of those that do not over the box."""
    tried = (one.low, one.low + (one.high - one.low) / 2, one.high, one.low + (one.high - one.low) * 0.3141)
    reports = [check(one.model, parameters={one.parameter: value}, quick=True, **options) for value in tried]
    ids = [finding.id for finding in reports[0].findings]
    held = [id for id in ids if all(report[id].verdict == "holds" for report in reports)]
    over = check(one.model, parameters={one.parameter: (one.low, one.high)}, quick=True, **options)
    return held, {id: f"{over[id].verdict}: {over[id].how}" for id in held if over[id].verdict != "holds"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the triples that are lost, and count them by class."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.boxes", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--case", dest="cases", action="append", help="one case; may be repeated")
    parser.add_argument("--times", action="store_true", help="print what each factor takes")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    counts: dict[str, list[int]] = {}
    for stem in given.cases or [stem for stem in case_files() if stem not in DEAR]:
        model = nsmodel.load(stem)
        own = counts.setdefault(type(model).__name__, [0, 0])
        for one in varied(model):
            started = time.perf_counter()
            try:
                held, lost = held_and_lost(one, bounds=BOUNDS.get(stem))
            except (ModelError, UsageError) as error:
                print(f"{stem}, {one.name}: {error}")
                continue
            own[0] += len(held)
            own[1] += len(lost)
            print(
                *(f"{stem}, {one.name}: {id} {why[:200]}" for id, why in lost.items()),
                sep="\n",
                end="\n" * bool(lost),
                flush=True,
            )
            if given.times:
                print(f"  {stem}, {one.name}: {time.perf_counter() - started:.2f} s", flush=True)
    for name, (held, lost) in counts.items():
        print(f"{name}: {held} hold at each value tried, {lost} of them are lost over the box")
    print(f"all: {sum(held for held, _ in counts.values())}, lost {sum(lost for _, lost in counts.values())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
