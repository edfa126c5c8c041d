"""Event-driven runs of random models beside their solutions in 64 digits: states, events and their modes, multipliers.

    python -m tests.search.events --models 300 --json FILE   each scene is a line of JSON, as soon as it is judged

What is counted is how far a run is from the solution, in units of what it may be; above 1 it is wrong.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import linear_sum_assignment

from nsmodel import StepError, Trajectory, simulate
from tests import event_models, event_ties
from tests.event_digits import Judged, NotJudged, judged
from tests.event_models import Scene

EPS, ROUNDING, POINTS = float(np.finfo(float).eps), 1e-12, 240  # Events within so much of the time are one in doubles.
CLASSES = event_models.CLASSES | event_ties.CLASSES
RTOLS = (1e-2, 1e-4, 1e-8, 1e-10)


def apart(scene: Scene, right: Judged, run: Trajectory, rtol: float, together: float = 0.0) -> dict[str, float]:
    """How far a run is from the solution, each in units of what it may be: 10 rtol of states and of the time, 100 rtol of l.

    States are asked to so much of their sizes, and to what rounding leaves where all that pushes a state keeps it at rest. Of l
    and of modes nothing is asked where l is not unique.
    """
    T = float(run.t[-1])
    t = np.linspace(0, T, POINTS + 1)[1:]
    x, l, y = right.at(t)
    found = run.at(t)
    size = np.maximum(np.abs(x).max(axis=0), 1e-3 * np.abs(x).max())
    rounding = 4 * EPS * T * _pushes(scene, t, x)
    missed = {"x": _largest(np.abs(np.hstack([found.x, found.v]) - x) / (10 * rtol * size + rounding))}
    if not right.alone:
        return missed
    near = 10 * rtol * T
    mine, other = (_merged(events, together, near, T - near) for events in (run.events, right.events))
    missed["events"] = float(abs(len(mine) - len(other)))
    if missed["events"]:
        return missed
    order = _order(np.hstack([found.y.T, found.multipliers.T]), np.hstack([y.T, l.T]))
    times = np.array([event[0] for event in other])
    missed["times"] = _largest(np.abs(np.array([event[0] for event in mine]) - times) / near)
    missed["modes"] = float(
        sum((a[order] != b).any() for one, two in zip(mine, other, strict=True) for a, b in zip(one[1:], two[1:], strict=True))
    )
    away = np.array([np.abs(times - moment).min(initial=np.inf) > near for moment in t])
    scale = 100 * rtol * np.maximum(1, np.abs(l).max(axis=0, initial=0))
    missed["l"] = _largest((np.abs(found.multipliers[:, order] - l) / scale)[away])
    return missed


def _merged(events: Any, together: float, first: float, last: float) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Times and both modes of events between two times, those that are together as one."""
    found: list[tuple[float, np.ndarray, np.ndarray]] = []
    for event in events:
        at, before, after = float(event.t), *(np.array(getattr(mode, "codes", mode)) for mode in (event.before, event.after))
        if found and at - found[-1][0] <= together:
            found[-1] = (found[-1][0], found[-1][1], after)
        else:
            found.append((at, before, after))
    return [event for event in found if first < event[0] < last]


def _largest(values: np.ndarray) -> float:
    return float(np.max(values, initial=0.0)) if not np.isnan(values).any() else np.inf


def _pushes(scene: Scene, t: np.ndarray, x: np.ndarray) -> float:
    f = ca.Function("f", [scene.t, scene.x], [ca.densify(ca.substitute(scene.rate, scene.l, 0))])
    return float(np.abs(np.array(f.map(t.size)(t[None], x.T))).max()) + EPS


def _order(mine: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Which of the run's rows (m, k) each row is: of an inclusion they may have another order."""
    return linear_sum_assignment(np.abs(other[:, None] - mine[None]).max(axis=2))[1]


def row(
    name: str, seed: int, t_end: float = np.inf, rtols: Sequence[float] = RTOLS, compiled: Sequence[float] = ()
) -> dict[str, Any]:
    """What became of a scene: why it is not judged, or how far each run is from its solution."""
    scene, begin = CLASSES[name](seed), time.process_time()
    T = min(t_end, float(scene.model.t_end))
    line: dict[str, Any] = {"class": name, "seed": seed, "T": T}
    try:
        right = judged(scene, T)
    except NotJudged as reason:
        line |= {"not judged": str(reason), "seconds": time.process_time() - begin}
        try:
            return line | {"events of the run": len(simulate(scene.model, rtol=1e-8, method="event-driven", t_end=T).events)}
        except StepError as error:
            return line | {"refused": str(error)[:300]}
    line |= {"seconds": time.process_time() - begin, "events": len(right.events), "alone": right.alone, "apart": {}}
    for rtol, in_c in [*((rtol, False) for rtol in rtols), *((rtol, True) for rtol in compiled)]:
        key = f"{rtol:g}{' C' * in_c}"
        try:
            run = simulate(scene.model, rtol=rtol, method="event-driven", t_end=T, compiled=in_c)
        except StepError as error:
            line["apart"][key] = {"refused": str(error)[:300]}
            continue
        line["apart"][key] = apart(scene, right, run, rtol, (10 * rtol if name in event_ties.CLASSES else ROUNDING) * T)
    return line


def wrong(line: dict[str, Any]) -> list[str]:
    """Of a row, the runs that are not what they should be."""
    return [
        f"{line['class']}:{line['seed']} {key}: {found}"
        for key, found in line.get("apart", {}).items()
        if "refused" in found
        or max(found["x"], found.get("times", 0), found.get("l", 0)) > 1
        or found.get("events")
        or found.get("modes")
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Of each class and tolerance the largest numbers, then what is wrong."""
    titles = ("models", "not judged", "l unique", "events", "seconds")
    lines = [f"{'class':12}" + "".join(f"{title:>12}" for title in titles)]
    for name in dict.fromkeys(line["class"] for line in rows):
        own = [line for line in rows if line["class"] == name]
        done = [line for line in own if "apart" in line]
        counts = [len(own), len(own) - len(done), sum(line["alone"] for line in done), sum(line["events"] for line in done)]
        lines.append(f"{name:12}" + "".join(f"{count:12d}" for count in [*counts, round(sum(line["seconds"] for line in own))]))
        for key in dict.fromkeys(key for line in done for key in line["apart"]):
            runs = [line["apart"][key] for line in done if key in line["apart"]]
            most = {k: max((run.get(k, 0.0) for run in runs), default=0.0) for k in ("x", "events", "times", "modes", "l")}
            refused = sum("refused" in run for run in runs)
            lines.append(
                f"    {key:8} {len(runs)} runs, {refused} refused; at most " + ", ".join(f"{k} {v:.1e}" for k, v in most.items())
            )
    reasons = Counter(line["not judged"] for line in rows if "not judged" in line)
    lines += [f"not judged, {reason}: {count}" for reason, count in reasons.items()]
    return "\n".join(lines + [one for line in rows for one in wrong(line)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge the models asked for, in turn of each class, and print the table; 1 where a run is wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.events", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--class", dest="classes", action="append", choices=list(CLASSES), help="one class; may be repeated")
    parser.add_argument("--models", type=int, default=100, help="models of each class")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--t-end", type=float, default=np.inf, help="no longer than this")
    parser.add_argument("--rtol", type=float, nargs="*", default=RTOLS)
    parser.add_argument("--compiled", type=int, default=10, help="each so many-th model in C, too")
    parser.add_argument("--json", type=Path, help="where everything goes")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    rows = []
    for seed, name in product(range(given.first, given.first + given.models), given.classes or CLASSES):
        rows.append(row(name, seed, given.t_end, given.rtol, (1e-8,) if seed % given.compiled == 0 else ()))
        if given.json:
            with given.json.open("a") as out:
                out.write(json.dumps(rows[-1]) + "\n")
        print(*wrong(rows[-1]), sep="\n", end="", file=sys.stderr, flush=True)
    print(table(rows))
    return int(any(wrong(line) for line in rows))


if __name__ == "__main__":
    sys.exit(main())
