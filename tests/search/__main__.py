"""``python -m tests.search --models 2000 --classes lure,first --seed 0``; ``--one lure:123`` reruns one model."""

from __future__ import annotations

import argparse
import collections
import json
import math
import sys
import time
import traceback
from pathlib import Path

import numpy as np

from .judge import COPY, ERROR, REFUSED, THREW, UNFOUNDED, VIOLATED, WELL, WRONG_L, WRONG_X, Finding, Verdict, judge
from .models import KINDS, case

BINS = ((1, 1e4), (1e4, 1e8), (1e8, 1e12), (1e12, math.inf), (math.inf, math.inf))
WHATS = (REFUSED, WRONG_X, WRONG_L, VIOLATED, THREW, COPY, UNFOUNDED, ERROR)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.search", description=__doc__)
    parser.add_argument("--models", type=int, default=2000, help="models of each class")
    parser.add_argument("--classes", default=",".join(KINDS), help="classes, with commas between")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first model")
    parser.add_argument("--checks", type=int, default=6, help="steps of each run that are judged by their truth")
    parser.add_argument("--compiled", type=int, default=10, help="each so many'th model is run in C too; 0: none")
    parser.add_argument("--one", help="CLASS:SEED, one model, told in full")
    parser.add_argument("--in-c", action="store_true", help="--one in C")
    parser.add_argument("--json", type=Path, help="write all findings to this file")
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop drawing models of a class after so long")
    parser.add_argument("--worst", type=int, default=6, help="findings shown of each kind")
    chosen = parser.parse_args(arguments)
    if chosen.one:
        name, seed = chosen.one.split(":")
        verdict = attempt(name, int(seed), chosen.in_c, 10**6 if chosen.checks == 6 else chosen.checks)
        print(f"{chosen.one}: {verdict.case.scene if verdict.case else ''}, {verdict.steps} steps, {len(verdict.judged)} judged, "
              f"condition up to {max(verdict.judged, default=math.nan):.3g}, {verdict.unknown} of unknown truth")  # fmt: skip
        print(
            *map(line, verdict.findings),
            *(f"no solution known: {text}" for text in verdict.unsolvable),
            *verdict.beyond,
            sep="\n",
        )
        return bool(verdict.findings)
    everything, ended = {}, 0
    for name in chosen.classes.split(","):
        verdicts, start = [], time.monotonic()
        for seed in range(chosen.seed, chosen.seed + chosen.models):
            verdicts.append(attempt(name, seed, False, chosen.checks))
            if chosen.compiled and seed % chosen.compiled == 0:
                verdicts.append(attempt(name, seed, True, chosen.checks))
            if time.monotonic() - start > chosen.seconds:
                break
        everything[name] = verdicts
        print(table(name, verdicts, chosen.worst), flush=True)
        ended |= any(f.what == ERROR or not f.condition > WELL for v in verdicts for f in v.findings)
        if chosen.json:
            chosen.json.write_text(json.dumps([
                vars(f) for found in everything.values() for v in found for f in v.findings
            ], indent=1))  # fmt: skip
    return ended


def attempt(name: str, seed: int, compiled: bool, checks: int) -> Verdict:
    """The verdict on a model; an exception that no model should cause is a finding."""
    one = None
    try:
        one = case(name, seed)
        return judge(one, compiled=compiled, checks=checks)
    except Exception as error:
        verdict = Verdict(one)
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({where.filename.rsplit('/', 1)[-1]}:{where.lineno})"
        verdict.findings.append(Finding(f"{name}:{seed}", one.scene if one else "", ERROR, 0, math.inf, math.nan, text, compiled))
        return verdict


def table(name: str, verdicts: list[Verdict], worst: int) -> str:
    """The class's counts by condition, and the worst of each kind."""
    findings = [f for v in verdicts for f in v.findings]
    judged = np.array([c for v in verdicts for c in v.judged])
    lines = [
        f"\n{name}: {len(verdicts)} runs, {sum(v.steps for v in verdicts)} steps, {judged.size} judged, "
        f"{sum(len(v.beyond) for v in verdicts)} refused beyond a linearisation, "
        f"{sum(v.unknown for v in verdicts)} of unknown truth, {sum(len(v.unsolvable) for v in verdicts)} stopped where no "
        f"solution was found, {sum(v.seconds for v in verdicts):.0f} s",
        f"  {'condition':>16} {'judged':>7}" + "".join(f"{what:>10}" for what in WHATS[:3]),
    ]
    for low, high in BINS:

        def inside(c, low=low, high=high):
            return low <= c < high or (c == low == math.inf)

        counts = collections.Counter(f.what for f in findings if inside(f.condition))
        label = "singular" if low == math.inf else f"{low:.0e}..{high:.0e}"
        lines.append(f"  {label:>16} {sum(map(inside, judged)):>7}" + "".join(f"{counts[what]:>10}" for what in WHATS[:3]))
    counts = collections.Counter(f.what for f in findings)
    lines.append("  in all: " + ", ".join(f"{what} {counts[what]}" for what in WHATS))
    models = {what: len({f.id for f in findings if f.what == what}) for what in WHATS}
    lines.append("  models: " + ", ".join(f"{what} {models[what]}" for what in WHATS))
    for what in WHATS:
        seen: set[str] = set()
        few = sorted(
            (f for f in findings if f.what == what), key=lambda f: (f.condition if f.condition == f.condition else 0, -f.excess)
        )
        for f in few:
            if f.id in seen or len(seen) >= worst:
                continue
            seen.add(f.id)
            lines.append("    " + line(f))
    stops = collections.Counter(text.split(":", 2)[-1][:110] for v in verdicts for text in v.unsolvable)
    lines += [f"    no solution found, {n} times: {text.strip()}" for text, n in stops.most_common(worst)]
    return "\n".join(lines)


def line(f: Finding) -> str:
    return (f"{f.id:<16} {f.what:<9} {'C ' if f.compiled else ''}{f.scene}, step {f.step}, condition {f.condition:.2g}, "
            f"excess {f.excess:.2g}: {f.text[:230]}")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
