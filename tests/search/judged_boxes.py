"""False sentences of ``nsmodel.check`` over boxes of parameters, looked for at values of these.

    python -m tests.search.judged_boxes                                  # 60 models of each class
    python -m tests.search.judged_boxes --class lure --models 100 --first 200

A part of a random model of ``checked`` is multiplied by a parameter (see ``boxes``), whose box is drawn, too. What is said of all
its values is put to the oracle of ``oracle`` at the ends, in the middle and at random values, with the numbers that are claimed,
and is compared with what the check says of the model at that value: what holds over the box and is violated there contradicts.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from nsmodel import check

from .boxes import Varied, drawn
from .checked import MAKERS
from .consequences import try_consequences
from .oracle import ORACLES
from .trial import HOLDS, VIOLATED, Trial

RANDOM_VALUES = 2


def values_of(one: Varied, rng: np.random.Generator) -> Iterator[float]:
    """The ends, the middle, 0 where it is inside, and random values."""
    yield from (one.low, one.high, one.low + (one.high - one.low) / 2)
    yield from [0.0] * (one.low < 0 < one.high)
    yield from rng.uniform(one.low, one.high, RANDOM_VALUES).tolist()


def judged(name: str, seed: int) -> dict[str, Any]:
    """What contradicts what is said of one model over its box, or the crash."""
    row: dict[str, Any] = {"model": f"{name}:{seed}", "held": 0, "contradictions": []}
    started, one = time.perf_counter(), drawn(name, seed)
    if one is None:
        return {**row, "seconds": 0.0}
    row["model"] += f" {one.name} in [{one.low:.6g}, {one.high:.6g}]"
    try:
        over = check(one.model, [], parameters={one.parameter: (one.low, one.high)}, quick=True)
    except Exception as error:  # whatever it is, the others are looked at
        return {**row, "seconds": time.perf_counter() - started, "crash": f"{type(error).__name__}: {error}"}
    row["held"] = sum(finding.verdict == HOLDS for finding in over.findings)
    rng = np.random.default_rng([seed, 77])
    for value in values_of(one, rng):
        try:
            row["contradictions"] += [{"value": value, **item} for item in at_value(name, seed, one, over, value, rng)]
        except Exception as error:
            row["fault"] = f"at {value:.6g}: {type(error).__name__}: {error}"
    return {**row, "seconds": time.perf_counter() - started}


def at_value(name: str, seed: int, one: Varied, over: Any, value: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """What contradicts at one value of the parameter."""
    single = check(one.model, [], parameters={one.parameter: value}, quick=True)
    found = [
        {
            "id": finding.id,
            "over": HOLDS,
            "there": VIOLATED,
            "how": single[finding.id].how,
            "witness": dict(single[finding.id].witness),
        }
        for finding in over.findings
        if finding.verdict == HOLDS and single[finding.id].verdict == VIOLATED and _in_scope(finding, single[finding.id])
    ]
    if name not in ORACLES:
        return found
    told = tuple(finding for finding in over.findings if _is_told_of(finding, one.parameter, value))
    ids = {finding.id for finding in told}
    follows = tuple(item for item in over.consequences if set(item.rests_on) <= ids)
    bound = one.model.bind({one.parameter: value})
    trial = Trial(name, seed, replace(over, findings=told, consequences=follows, model=bound), rng)
    with np.errstate(all="ignore"):
        ORACLES[name](trial)
        try_consequences(trial)
    return [*found, *trial.bad]


def _is_told_of(finding: Any, parameter: str, value: float) -> bool:
    """Whether a finding speaks of this value, and has what the oracle needs: the P of 5.2 is none where it moves with p."""
    if finding.id == "5.2" and finding.verdict == HOLDS and "P_omega" not in finding.witness:
        return False
    return finding.verdict != VIOLATED or finding.witness.get(parameter, value) == value


def _in_scope(finding: Any, there: Any) -> bool:
    """Whether a violation lies in the box of states and times of what holds, as far as its witness tells."""
    if finding.scope is None:
        return True
    inside = [
        low <= float(there.witness[name]) <= high for name, (low, high) in finding.scope.states.items() if name in there.witness
    ]
    return all(inside) and len(inside) == len(finding.scope.states)


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge the models asked for; 1 where something contradicts."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.judged_boxes", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--class", dest="classes", action="append", choices=list(MAKERS), help="one class; may be repeated")
    parser.add_argument("--models", type=int, default=60, help="models of each class")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    rows: list[dict[str, Any]] = []
    for name in given.classes or MAKERS:
        own = [_printed(judged(name, seed)) for seed in range(given.first, given.first + given.models)]
        print(f"{name}: {_counts(own)}", flush=True)
        rows += own
    print(f"all: {_counts(rows)}")
    return int(any(row["contradictions"] for row in rows))


def _printed(row: dict[str, Any]) -> dict[str, Any]:
    """The row, what is wrong with it printed."""
    lines = [str(item) for item in row["contradictions"]] + [f"{key}: {row[key]}" for key in ("crash", "fault") if key in row]
    for line in lines:
        print(f"{row['model']} {line}", flush=True)
    return row


def _counts(rows: Sequence[dict[str, Any]]) -> str:
    """What came out of some models, in words."""
    held, seconds = (sum(row[key] for row in rows) for key in ("held", "seconds"))
    wrong, crashed, faults = (sum(bool(row.get(key)) for row in rows) for key in ("contradictions", "crash", "fault"))
    return (
        f"{len(rows)} models, {held} hypotheses hold over their boxes, {wrong} models contradict, {crashed} crashes, "
        f"{faults} faults of the search, {seconds:.0f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
