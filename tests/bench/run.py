"""Time of a step, in one process and one run: nsmodel's interpreted stepper beside plain Python and the peers installed.

CPU time, one warm-up, the minimum over repeats; nsmodel's time includes its time loop and the recording of every row.
"""

import itertools
import os
import time
from collections.abc import Callable

import compiled
import gpu
import lanes
import numpy as np
from peers import programs

import nsmodel
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation.simulate import prepared_loop

SHORT = bool(os.environ.get("NSMODEL_SHORT"))  # Whether all of it runs, once, on a few scenes.
FILES = [case_files()["sliding_relay"], case_files()["crowd"]] if SHORT else [*case_files().values()]
REPEATS = 1 if SHORT else 7


def least(job: Callable[[], object]) -> float:
    """CPU seconds of the quickest of several runs, after a warm-up."""
    job()
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        job()
        times.append(time.process_time() - start)
    return min(times)


def timed(job: Callable[[], object]) -> float:
    """Wall seconds of one run."""
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def driver_loop(name: str) -> tuple[float, int]:
    """Seconds a run's time loop takes (set-up excluded), and its number of steps."""
    model, times, steps = nsmodel.load(name), [], 0
    for _ in range(1 if SHORT else REPEATS + 1):
        run = prepared_loop(model, compiled=False)
        steps = run.go().metadata["steps"]
        times.append(run.cpu_seconds)
    return min(times[-REPEATS:]), steps


def plain_bridge(steps: int) -> np.ndarray:
    """The diode bridge as one writes it with NumPy: last index set first, all sixteen otherwise; nothing verified."""
    L, C, R, h = 1e-2, 1e-6, 1e3, 1e-6
    A = np.array([[0, -1 / C], [1 / L, 0]])
    B = np.array([[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]])
    Cm = np.array([[0, 0], [0, 0], [-1, 0], [1, 0.0]])
    D = np.array([[1 / R, 1 / R, -1, 0], [1 / R, 1 / R, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]])
    inverse = np.linalg.inv(np.eye(2) - h / 2 * A)
    F, G = inverse @ (np.eye(2) + h / 2 * A), h * inverse @ B
    W, N = Cm @ G + D, Cm @ F
    maps = []
    for index in itertools.product((False, True), repeat=4):
        rows = np.flatnonzero(index)
        S = np.zeros((4, 4))
        try:
            S[np.ix_(rows, rows)] = -np.linalg.inv(W[np.ix_(rows, rows)])
        except np.linalg.LinAlgError:
            continue
        maps.append(S)
    x, last, out = np.array([10.0, 0.0]), 0, np.empty((steps, 2))
    for k in range(steps):
        b = N @ x
        for i in (last, *range(len(maps))):
            l = maps[i] @ b
            if (l >= -1e-12).all() and (W @ l + b >= -1e-12).all():
                last = i
                break
        x = F @ x + G @ l
        out[k] = x
    return out


def main() -> None:
    """Print the tables."""
    seconds, steps = driver_loop("diode_bridge")
    ours = 1e6 * seconds / steps
    plain = 1e6 * least(lambda: plain_bridge(steps)) / steps
    print(f"diode bridge, {steps} steps, us a step (CPU)                      ratio to nsmodel")
    print(f"  nsmodel, interpreted, verified, every row kept {ours:9.2f}")
    print(f"  plain NumPy loop, nothing verified             {plain:9.2f}          {plain / ours:6.2f}")
    peer = programs.speed(["diode_bridge"]).get("diode_bridge")
    print("  Siconos                                        not installed: skipped" if peer is None else
          f"  Siconos 4, its C++ step driven from Python     {peer:9.2f}          {peer / ours:6.2f}")  # fmt: skip
    print()
    compiled.main()
    print()
    lanes.main()
    gpu.main()
    print()
    print("every case, us a step of the time loop (CPU, set-up excluded)")
    for path in FILES:
        seconds, steps = driver_loop(path.stem)
        print(f"  {path.stem:30s} {1e6 * seconds / steps:9.2f}   {steps} steps")
    print()
    print("every case, seconds of a whole check (wall, its runs included; goal 5, crowd 20) and of a quick one, one run each")
    for path in FILES[:1] if SHORT else FILES:
        model = nsmodel.load(path)
        if model.blocks:  # A check must be told between which values what they set stays.
            continue
        full, quick = (timed(lambda quick=quick, model=model: nsmodel.check(model, quick=quick)) for quick in (False, True))
        late = "" if full < (20 if path.stem == "crowd_room" else 5) else "   above the goal"
        print(f"  {path.stem:30s} {full:9.2f} {quick:9.2f}{late}")


if __name__ == "__main__":
    main()
