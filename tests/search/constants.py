"""What hangs on each number at the top of a module: ten times it, a tenth of it, and a battery of short runs.

    python -m tests.search.constants nsmodel/event_driven                      # every number of a package
    python -m tests.search.constants nsmodel/solvers/mlcp.py --only CONVERGED --cases lure

A number of the source is changed before a process imports it, so that all that is made of it or holds a copy follows; whole
numbers become twice and half as large. Told of a change is in how many runs a bit differs, by how much states (or derivatives) do
at most, beside their size, which runs stop, and the time of CPU beside that before. A difference of more than WRONG times what a
run is asked for, without a stop, has a "!": it may be a wrong answer.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import resource
import signal
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import casadi  # noqa: F401 - what is large, and no part of nsmodel, is imported once
import numpy as np
import scipy.integrate
import scipy.optimize
import scipy.sparse.linalg  # noqa: F401

from .changed import Changed, numbers

SCENE_SECONDS, BATTERY_SECONDS = 10, 120  # Of CPU: a run that takes longer has stopped, and so has a battery; most take 0.1 s.
WRONG = 1e3  # Errors of right runs are up to 10 times what is asked for, and their states may go apart from there.


class Outcome(NamedTuple):
    """Of a run: the bits of its numbers, states at some times, or why it stopped; and what it was asked for."""

    asked: float
    bits: str = ""
    states: Any = None
    stop: str = ""


Outcomes = dict[str, Outcome]


def outcomes(package: str, cases: str, changed: Changed | None = None) -> tuple[Outcomes, float]:
    """What becomes of the battery of a package in a process of its own, and its seconds of CPU; nothing where it does not end."""
    here, its = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_answer, args=(its, package, cases, changed))
    process.start()
    its.close()
    try:
        return here.recv()
    except EOFError:
        return {}, BATTERY_SECONDS
    finally:
        process.join()


class TooLong(BaseException):
    """What no run is to catch."""


def _stop_run(*_: Any) -> None:
    raise TooLong(f"longer than {SCENE_SECONDS} s")


def _answer(its: Any, package: str, cases: str, changed: Changed | None) -> None:
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_CPU, (BATTERY_SECONDS, BATTERY_SECONDS))
    signal.signal(signal.SIGPROF, _stop_run)
    sys.meta_path[:0] = [] if changed is None else [changed]
    found, begin = Outcomes(), time.process_time()
    try:
        from . import batteries

        for name, asked, run in batteries.runs(package):
            if cases not in name:
                continue
            signal.setitimer(signal.ITIMER_PROF, SCENE_SECONDS)
            try:
                states, arrays = batteries.values(run())
                found[name] = Outcome(asked, hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest(), states)
            except (Exception, TooLong) as error:
                found[name] = Outcome(asked, stop=f"{type(error).__name__}: {error}".splitlines()[0][:100])
            signal.setitimer(signal.ITIMER_PROF, 0)
    except Exception as error:
        found = {"import": Outcome(0.0, stop=f"{type(error).__name__}: {error}")}
    its.send((found, time.process_time() - begin))


def difference(before: Outcomes, after: Outcomes) -> str:
    """What a change does, in a line."""
    if before.keys() != after.keys():
        return after["import"].stop if "import" in after else f"! it crashes, or takes more than {BATTERY_SECONDS} s"
    pairs = {name: (before[name], after[name]) for name in before if before[name][1::2] != after[name][1::2]}
    off = {name: distance(a.states, b.states) for name, (a, b) in pairs.items() if not (a.stop or b.stop)}
    parts = [f"{name} {f'stops: {b.stop}' if b.stop else 'goes on'}" for name, (_, b) in pairs.items() if name not in off]
    if off:
        worst = max(off, key=lambda name: off[name] / before[name].asked)
        mark = "! " * (off[worst] > WRONG * before[worst].asked)
        parts = [
            f"{mark}{len(off)} of {len(before)} differ, by up to {off[worst]:.0e} of {before[worst].asked:g} ({worst})",
            *parts,
        ]
    return "; ".join(parts) or "same bits"


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """The largest difference, beside the largest number of its column, or 1e-3 of that of all."""
    size = np.abs(one).max(axis=0, initial=0.0)
    size = np.maximum(size, 1e-3 * size.max(initial=0.0)) + 1e-300
    return float(np.max(np.abs(one - other) / size, initial=0.0)) if one.shape == other.shape else np.inf


def main(arguments: Sequence[str] | None = None) -> int:
    """Change the numbers one after the other, and print what each does; 1 where a battery has other bits without a change."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.constants", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("paths", nargs="+", type=Path, help="modules or packages, as nsmodel/solvers")
    parser.add_argument("--only", default="", help="numbers with this in their names")
    parser.add_argument("--cases", default="", help="runs with this in their names")
    given, steady = parser.parse_args(arguments), True
    for path in given.paths:
        if path.parts[:1] != ("nsmodel",) or len(path.parts) < 2 or not path.exists():
            parser.error(f"{path} is no module or package that is here; expected one as nsmodel/solvers")
        if not any(given.only in one.name for one in numbers(path)):
            parser.error(f"{path} has no number with {given.only!r} in its name at the top of a module")
    for path in given.paths:
        package = path.parts[1]
        (before, seconds), (again, _) = (outcomes(package, given.cases) for _ in range(2))
        if not before:
            parser.error(f"no run of {path} with {given.cases!r} in its name came to an end: nothing can be compared")
        steady &= (text := difference(before, again)) == "same bits"
        print(f"{path}: {len(before)} runs, {seconds:.1f} s; once more: {text}", flush=True)
        for number in (one for one in numbers(path) if given.only in one.name):
            for up in (True, False):
                after, took = outcomes(package, given.cases, Changed(number, up))
                how = f"{difference(before, after)}; {took / seconds:.2f} of the time"
                print(f"{number.name} {'up' if up else 'down'}: {how}", flush=True)
    return not steady


if __name__ == "__main__":
    sys.exit(main())
