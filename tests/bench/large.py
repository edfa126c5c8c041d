"""Large scenes: a room left by 10 ... 20 000 people through one door, and a chain of 10 ... 10 000 masses with friction.

Each crowd runs in its own process from the start into the jam (t = L/5 at 1 m/s; soon after, 20 000 push somebody around the
jamb by three quarters of a radius in a step, which is refused: smaller steps go on) and is timed there: CPU milliseconds of a
whole step, records included, split into search, assembly, solve and time loop. cromosim's whole step, with cvxopt, is timed on
people who stand where ours stand. Peers are skipped where they are not installed.

    large.py            all
    large.py N...       crowds of these sizes alone
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from peers import programs

import nsmodel
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation.simulate import prepared_loop

CASE = case_files()["crowd"]
SHORT = bool(os.environ.get("NSMODEL_SHORT"))
SIZES = (10,) if SHORT else (10, 50, 200, 1000, 5000, 20_000)
GOALS = {50: 4, 200: 3, 1000: 2}  # how many times faster than cromosim
TIMED = {20_000: 10, 5000: 20}  # steps in the jam; of other crowds 100
PITCH, DOOR, STEP, CUTOFF = 0.6, 1.2, 0.02, 0.1


def crowd(n: int, place: Path) -> dict[str, float]:
    """Run a crowd into the jam and time its steps; the state there goes into a file."""
    side = max(PITCH * np.ceil(np.sqrt(n)), 2.4)
    jam = round(max(0.3, 0.2 * side) / STEP)
    steps = TIMED.get(n, 100)
    model = nsmodel.load(CASE, n=n)
    start = time.perf_counter()
    run = prepared_loop(model, t_end=(jam + steps) * STEP, compiled=True, save_every=jam + steps)
    prepared = time.perf_counter() - start
    clock, take = Clock(run.propagator.step, jam, place, model.bodies.numbers["r"][:, 0], side), run.propagator.step
    run.propagator.step = clock
    run.go()
    parts = {key: 1e3 * (take.seconds[key] - clock.seconds[key]) / steps for key in clock.seconds}
    total = time.process_time() - clock.start
    totals = run.propagator.totals
    return {
        "N": n, "set_up": prepared, "step": 1e3 * total / steps, **parts, "contacts": totals["most_contacts"],
        "overlap": max(0.0, -totals["least_gap"]), "residual": totals["worst_residual"],
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "steps": totals["steps"],
    }  # fmt: skip


class Clock:
    """A step that notes when the jam begins, and writes down who stands where."""

    def __init__(self, step: Any, jam: int, place: Path, radii: np.ndarray, side: float) -> None:
        self.step, self.jam, self.place, self.radii, self.side = step, jam, place, radii, side

    def __call__(self, t: float, h: float, q: np.ndarray, warm: Any, k: int) -> Any:
        if k == self.jam:
            scene = {"side": self.side, "door": DOOR, "cutoff": CUTOFF, "step": STEP}
            there = np.isfinite(q).all(axis=1)
            np.savez(self.place, q=q[there], r=self.radii[there], **scene)
            self.seconds, self.start = dict(self.step.seconds), time.process_time()
        return self.step(t, h, q, warm, k)


def exponent(found: list[dict[str, float]], least: int) -> str:
    """The slope of log time over log N from ``least`` on."""
    used = [row for row in found if row["N"] >= least]
    if len(used) < 2:
        return "-"
    slope = np.polyfit(np.log([row["N"] for row in used]), np.log([row["step"] for row in used]), 1)[0]
    return f"{slope:.2f}"


def main(sizes: list[int]) -> int:
    """Print the tables; return how many crowds failed."""
    print("evacuation of a square room, jammed: CPU ms a step")
    print("     N      step   search  assembly     solve    loop  contacts  overlap m     MB  cromosim  overlap m  ratio  goal")
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for n in sizes:
            state = Path(folder) / f"{n}.npz"
            command = [sys.executable, __file__, "--one", str(n), str(state)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                print(f"{n:>6} failed: {done.stderr.strip().splitlines()[-1]}")
                continue
            row = json.loads(done.stdout)
            found.append(row)
            peer, why = programs.crowd_steps(state) if n <= 5000 else (None, "")
            loop = row["step"] - row["search"] - row["assembly"] - row["solve"]
            line = (f"{n:>6} {row['step']:>9.3f} {row['search']:>8.3f} {row['assembly']:>9.3f} {row['solve']:>9.3f} {loop:>7.3f} "
                    f"{row['contacts']:>9} {row['overlap']:>10.1e} {row['memory']:>6.0f}")  # fmt: skip
            if peer is not None:
                whole = peer["velocity"] + peer["contacts"] + peer["projection"]
                line += f" {whole:>9.2f} {peer['overlap']:>10.1e} {whole / row['step']:>6.1f} {GOALS.get(n, '-'):>5}"
            print(line + (f"   cromosim: {why}" if why else ""), flush=True)
    print(f"growth from N = 1000 on: N^{exponent(found, 1000)} (goal 1.4)")
    if programs.from_pypi("cromosim") is None:
        print(f"cromosim is not installed: skipped ({programs.CROMOSIM} names a Python that has it)")
    return len(sizes) - len(found)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(crowd(int(sys.argv[2]), Path(sys.argv[3]))))
    else:
        failed = main([int(n) for n in sys.argv[1:]] or list(SIZES))
        if not sys.argv[1:]:
            import chain

            print()
            print(chain.table())
        sys.exit(min(failed, 1))
