"""Event-driven runs beside the prototype in C++, CVODE with roots, LSODA on smoothed laws, and SciPy's events written by hand.

Each at its cheapest setting that reaches the error: of each state at 241 times, beside its largest value. CPU microseconds of a
run that writes these rows, the least of several. Programs that are not installed are skipped.

    event_driven.py             all scenes
    event_driven.py NAME...     these alone

The table goes to results/event_driven.json too.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from events import by_hand
from events.programs import ROWS, Programs, compiler, least, with_cvode
from events.scenes import ROOT, Scene, scenes
from events.smooth import smoothed
from peers import in_scipy

from nsmodel import UsageError, codegen
from nsmodel.codegen.event_driven_runs import PIECE_FLAGS
from nsmodel.codegen.library import MATH_LIBRARIES, SHARED_FLAGS
from nsmodel.codegen.library import compiler as c_compiler
from nsmodel.simulation.event_driven import event_driven_problem
from nsmodel.simulation.simulate import prepared_loop

SHORT = bool(os.environ.get("NSMODEL_SHORT"))
TARGETS = (1e-4,) if SHORT else (1e-4, 1e-8, 1e-12)
TOLERANCES = (1e-4, 1e-6) if SHORT else tuple(10 ** (-k / 2) for k in range(2, 31))
ALSO = 2  # Finer settings that are timed once the error is reached: the cheapest is not always the coarsest.
SLOW = 3.0  # CPU seconds: a method that takes this long at one setting is not asked for finer ones.
SMALL = 20  # States up to which interpreted runs and time steps are timed.
BLAS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")

Timed = tuple[float, np.ndarray]  # CPU seconds, x (241, n)

LOOP = """
#include "NAME_pieces.h"
#include <stdio.h>
#include <time.h>

static NAME_pieces s;
static double out[ROWS][NAME_PIECES_N], times[ROWS];

static int run(double rtol, int estimated)
{
    NAME_pieces_init(&s, rtol);
    s.estimated = estimated;
    return NAME_advance_through(&s, ROWS, times, out[0]);
}

int main(int argc, char **argv)
{
    double rtol, least = 1e30;
    sscanf(argv[1], "%lf", &rtol);
    const int estimated = argv[2][0] == '1';
    long repeat = 1;
    for (int row = 0; row < ROWS; row++)
        times[row] = row*(T_END/(ROWS - 1));
    for (int k = 0; k < 5;) {
        const clock_t start = clock();
        for (long i = 0; i < repeat; i++)
            if (run(rtol, estimated) != 0)
                return 1;
        const double spent = (double)(clock() - start)/CLOCKS_PER_SEC;
        if (spent < 5e-3) {
            repeat *= 4;
            continue;
        }
        if (spent/repeat < least)
            least = spent/repeat;
        k++;
    }
    printf("%.17g\\n", least);
    for (int row = 0; row < ROWS; row++)
        for (int i = 0; i < NAME_PIECES_N; i++)
            printf("%.17g\\n", out[row][i]);
    return argc > 3;
}
"""


@dataclass
class Bench:
    """A scene with its times, its reference (241, n), and what its errors are measured beside."""

    scene: Scene
    folder: Path
    reference: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        scene = self.scene
        self.problem = event_driven_problem(scene.model)
        self.t_end = float(scene.model.t_end)
        self.times = np.linspace(0, self.t_end, ROWS)
        self.x0 = np.array([float(v) for v in self.problem.x0.elements()])
        self.programs = (
            Programs(self.problem, self.t_end, self.folder, cvode=with_cvode(), radau=scene.stiff) if compiler() else None
        )
        known = scene.reference()
        if known is None:
            tight = self.programs.taylor(1e-15) if self.programs else None
            known = self.own({"compiled": False}, 1e-13)[1] if tight is None else tight.x
        self.reference = known

    def error(self, x: np.ndarray) -> float:
        """Of x (241, n) or more, at the times."""
        n = min(x.shape[1], self.reference.shape[1])
        right = self.reference[:, :n]
        return float((np.abs(x[:, :n] - right) / np.abs(right).max(axis=0)).max())

    def own(self, options: dict[str, Any], rtol: float) -> Timed:
        """nsmodel's event-driven run, as it is prepared."""
        found: list[float] = []
        while len(found) < 2 or (len(found) < 6 and sum(found) < 1):
            run = prepared_loop(self.scene.model, rtol=rtol, method="event-driven", times=self.times, **options)
            trajectory = run.go()
            found.append(run.cpu_seconds)
        return min(found), np.hstack([trajectory.x, trajectory.v]) if "v" in trajectory.arrays else trajectory.x

    def stepped(self, rtol: float) -> Timed:
        """nsmodel's time stepping under error control; x linear between its rows."""
        run = prepared_loop(self.scene.model, rtol=rtol, method="time-stepping", compiled=c_compiler() is not None)
        trajectory = run.go()
        x = np.column_stack([np.interp(self.times, trajectory.t, column) for column in trajectory.x.T])
        return run.cpu_seconds, x


def smallest(bench: Bench, settings: Iterable[Callable[[], Timed | None]]) -> dict[float, tuple[float, float]]:
    """{target: (CPU seconds, error) of the cheapest setting that reaches it}, of settings from coarse to fine."""
    best: dict[float, tuple[float, float]] = {}
    after = dict.fromkeys(TARGETS, 0)
    for setting in settings:
        found = setting()
        if found is None:
            continue
        seconds, error = found[0], bench.error(found[1])
        for target in TARGETS:
            if error <= target or target in best:
                after[target] += 1
            if error <= target and seconds < best.get(target, (np.inf,))[0] and after[target] <= 1 + ALSO:
                best[target] = seconds, error
        if seconds > SLOW or all(count > ALSO for count in after.values()):
            break
    return best


def methods(bench: Bench) -> Iterator[tuple[str, dict[float, tuple[float, float]]]]:
    """The methods that are there, each with what it takes."""
    scene, programs = bench.scene, bench.programs
    if programs is not None:
        for name in ("taylor", *(["radau"] if scene.stiff else [])):
            call = getattr(programs, name)
            label = "prototype" if name == "taylor" else "prototype, Radau IIA"
            yield label, smallest(bench, (partial(_program, call, tol) for tol in TOLERANCES))
    for label, estimated in (("nsmodel in C", 1), ("nsmodel in C, no estimate", 0)):
        loop = generated(bench)
        if loop is not None:
            yield label, smallest(bench, (partial(_loop, loop, tol, estimated, len(bench.x0)) for tol in TOLERANCES))
    for label, options in (("nsmodel, compiled, from Python", {"compiled": True}), ("nsmodel, interpreted", {"compiled": False})):
        if can(bench, options) and (options["compiled"] or len(bench.x0) <= SMALL):
            yield label, smallest(bench, (partial(bench.own, options, tol) for tol in TOLERANCES if tol >= 1e-14))
    if len(bench.x0) <= SMALL:
        settings = (partial(bench.stepped, tol) for tol in TOLERANCES if tol >= 1e-12)
        yield "nsmodel, time stepping, rtol", smallest(bench, settings)
    if programs is not None and with_cvode():
        yield (
            "CVODE with roots",
            cheapest(
                smallest(bench, (partial(_program, programs.cvode, tol, stiff, scene.h_max) for tol in TOLERANCES))
                for stiff in ((True,) if scene.stiff else (False, True))
            ),
        )
    if scene.smooth is not None:
        yield "LSODA, best eps", lsoda(bench)
    if scene.hand is not None:
        yield (
            "SciPy, events by hand",
            cheapest(
                smallest(bench, (partial(_hand, bench, method, tol) for tol in TOLERANCES if tol > 3e-14))
                for method in (("Radau",) if scene.stiff else ("RK45", "DOP853"))
            ),
        )


def can(bench: Bench, options: dict[str, Any]) -> bool:
    """Whether nsmodel takes the scene so, and has something to do it with."""
    try:
        prepared_loop(bench.scene.model, rtol=1e-3, method="event-driven", **options)
    except UsageError:
        return False
    return not options["compiled"] or c_compiler() is not None


def cheapest(found: Iterable[dict[float, tuple[float, float]]]) -> dict[float, tuple[float, float]]:
    """Of several methods."""
    best: dict[float, tuple[float, float]] = {}
    for one in found:
        for target, value in one.items():
            best[target] = min(value, best.get(target, value))
    return best


def lsoda(bench: Bench) -> dict[float, tuple[float, float]]:
    """LSODA with the best width and tolerance."""
    rate, scene = bench.scene.smooth, bench.scene
    of = smoothed(bench.problem) if rate == "tanh" else rate
    sizes, best = np.maximum(np.abs(bench.x0), 1e-3), {}
    for eps in 10.0 ** -np.arange(0, 10):
        for tol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-12):
            job = partial(in_scipy.lsoda, of(eps), tuple(bench.x0), bench.times, tol, tol * sizes, scene.h_max)
            start = time.process_time()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    error = bench.error(job())
            except (in_scipy.TooMuch, ValueError, OverflowError, ZeroDivisionError):
                error = np.inf
            spent = time.process_time() - start
            for target in TARGETS:
                if error <= target and spent < 2 * best.get(target, (np.inf,))[0]:
                    seconds = spent if spent > 1 else least(lambda repeat, job=job: [job() for _ in range(repeat)])
                    best[target] = min((seconds, error), best.get(target, (np.inf, error)))
            if spent > SLOW:
                break
    return best


def generated(bench: Bench) -> Path | None:
    """A program that runs the generated C of the pieces in a loop; None where there is none."""
    name, model = "bench", bench.scene.model
    folder = bench.folder / "generated"
    if c_compiler() is None:
        return None
    if not folder.exists():
        try:
            codegen.write(model, folder, name=name, step=bench.t_end / ROWS, parameters={}, event_driven=True)
        except UsageError:
            return None
        text = LOOP.replace("NAME_PIECES", f"{name}_PIECES".upper()).replace("NAME", name)
        text = text.replace("ROWS", str(ROWS)).replace("T_END", repr(bench.t_end))
        (folder / "loop.c").write_text(text)
        flags = [flag for flag in PIECE_FLAGS if flag not in SHARED_FLAGS]
        command = [*str(c_compiler()).split(), *flags, "-o", "loop", "loop.c", f"{name}_pieces.c", *MATH_LIBRARIES]
        if not (folder / f"{name}_pieces.c").exists():
            return None
        subprocess.run(command, cwd=folder, check=True)
    return folder / "loop" if (folder / "loop").exists() else None


def _loop(path: Path, tol: float, estimated: int, n: int) -> Timed | None:
    done = subprocess.run([str(path), repr(tol), str(estimated)], capture_output=True, text=True, check=False)
    if done.returncode:
        return None
    values = np.array(done.stdout.split(), float)
    return float(values[0]), values[1:].reshape(ROWS, n)


def _program(call: Callable[..., Any], *options: Any) -> Timed | None:
    found = call(*options)
    return None if found is None else (found.seconds, found.x)


def _hand(bench: Bench, method: str, tol: float) -> Timed | None:
    start = time.process_time()
    x = by_hand.run(bench.scene.hand, bench.x0, bench.t_end, method, tol, bench.scene.h_max)
    spent = time.process_time() - start
    if x is None:
        return None
    for _ in range(4 if spent < 1 else 0):
        start = time.process_time()
        by_hand.run(bench.scene.hand, bench.x0, bench.t_end, method, tol, bench.scene.h_max)
        spent = min(spent, time.process_time() - start)
    return spent, x


def main(names: list[str]) -> None:
    """Print a table a scene, with ratios to nsmodel's own runs in C where there are any, else to the prototype."""
    for name in BLAS:
        os.environ.setdefault(name, "1")
    kept: dict[str, Any] = {}
    chosen = [scene for scene in scenes() if not names or scene.name in names]
    for scene in chosen[:1] if SHORT else chosen:
        with tempfile.TemporaryDirectory() as folder:
            bench = Bench(scene, Path(folder))
            errors = ", ".join(f"{target:.0e}" for target in TARGETS)
            print(f"{scene.name}: CPU us of a run with {ROWS} rows for an error of {errors}", flush=True)
            found = dict(methods(bench))
        rows = kept[scene.name] = {}
        base = found.get("nsmodel in C") or found.get("prototype") or {}
        for label, one in found.items():
            rows[label] = {f"{target:.0e}": {"us": 1e6 * seconds, "error": error} for target, (seconds, error) in one.items()}
            cells = [_cell(one.get(target), base.get(target)) for target in TARGETS]
            print(f"  {label:32s} " + " ".join(cells), flush=True)
    (ROOT / "results").mkdir(exist_ok=True)
    (ROOT / "results" / "event_driven.json").write_text(json.dumps(kept, indent=1))


def _cell(found: tuple[float, float] | None, base: tuple[float, float] | None) -> str:
    if found is None:
        return f"{'-':>22}"
    ratio = f"({found[0] / base[0]:.1f})" if base else ""
    return f"{1e6 * found[0]:>11.1f} {ratio:>10}"


if __name__ == "__main__":
    main(sys.argv[1:])
