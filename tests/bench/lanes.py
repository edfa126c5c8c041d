"""Runs a second on one core: many runs in step, the same in C one by one, and NumPy arrays over the runs.

CPU time, the minimum over repeats; what is kept is the last row. The values of the parameters are drawn at random.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel import FrictionOscillator, LureSystem, complementarity, relay
from nsmodel.codegen.batch import BatchCells, StepBatch
from nsmodel.codegen.library import compiler
from nsmodel.modeling.base import Model
from nsmodel.modeling.time_grid import make_grid

SHORT = bool(os.environ.get("NSMODEL_SHORT"))
REPEATS = 1 if SHORT else 9
RUNS, ALONE = (40, 4) if SHORT else (1024, 64)
AT_ONCE = 40 if SHORT else 10_000  # Runs in an array of NumPy's.
LEVELS = {0: "no vectors asked for", 1: "AVX2", 2: "AVX-512"}
GOAL = 50_000  # Runs of the friction oscillator a second with AVX2.

A, K, X0 = (ca.SX.sym(name) for name in ("a", "k", "x0"))


class Scene(NamedTuple):
    """A model, its values, and the runs as NumPy arrays: x at the end of each."""

    model: Model
    values: np.ndarray
    arrays: Callable[[np.ndarray, float, int], np.ndarray] | None = None


def friction() -> Model:
    """x'' + a Sgn(x') + k x = 0 by the proximal scheme, 12 000 steps."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    return FrictionOscillator(
        x=x, potential=K * x**2 / 2, friction=A * s, s=s, x0=X0, v0=0, t_end=12, step=1e-3, parameters={A: 1.0, K: 1.0, X0: 5.3}
    )


def friction_in_arrays(values: np.ndarray, h: float, steps: int) -> np.ndarray:
    """The same recursion, nothing verified."""
    a, k, x = values.T.copy()
    d, stiff = np.zeros_like(x), h**2 * k
    for _ in range(steps):
        b = d - stiff * x
        want = -b / h**2
        l = np.clip(want, -a, a)
        d = np.where(want == l, 0.0, (b + h**2 * l) / (1 + stiff))
        x += d
    return x


def relay_form() -> Model:
    """The same oscillator as a Lur'e system, theta = 1/2, 1200 steps."""
    return LureSystem(
        A=[[0, 1], [-K, 0]], B=[0, A], C=[0, 1], law=relay(1), x0=[X0, 0], t_end=12, step=1e-2, theta=0.5,
        parameters={A: 1.0, K: 1.0, X0: 5.3},
    )  # fmt: skip


def relay_in_arrays(values: np.ndarray, h: float, steps: int) -> np.ndarray:
    """The same recursion, nothing verified."""
    a, k, x = values.T.copy()
    v, half = np.zeros_like(x), h**2 * k / 4
    for _ in range(steps):
        b = v - h * k * x - half * v
        want = -b / (h * a)
        l = np.clip(want, -1, 1)
        new = np.where(want == l, 0.0, (b + h * a * l) / (1 + half))
        x += h / 2 * (v + new)
        v = new
    return x


def bridge() -> Model:
    """The diode bridge, 5000 steps."""
    L, C, R = (ca.SX.sym(name) for name in "LCR")
    return LureSystem(
        A=[[0, -1 / C], [1 / L, 0]], B=[[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]], C=[[0, 0], [0, 0], [-1, 0], [1, 0]],
        D=[[1 / R, 1 / R, -1, 0], [1 / R, 1 / R, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]], law=complementarity(4), x0=[X0, 0],
        t_end=5e-3, step=1e-6, theta=0.5, parameters={L: 1e-2, C: 1e-6, R: 1e3, X0: 10},
    )  # fmt: skip


def relay_oscillator() -> Model:
    """A loop around a relay of strength a that oscillates, 10 000 steps."""
    return LureSystem(
        A=[[0, 1, 0], [0, 0, 1], [0, -K, -2]], B=[0, 0, A], C=[1, 0, 0], law=relay(1), x0=[0, X0, 0], t_end=100, step=1e-2,
        theta=0.5, parameters={A: 1.0, K: 3.0, X0: 0.7},
    )  # fmt: skip


def drawn(*ends: tuple[float, float]) -> np.ndarray:
    """Values between these ends (RUNS, parameters)."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(low, high, RUNS) for low, high in ends])


SCENES: dict[str, Callable[[], Scene]] = {
    "friction oscillator": lambda: Scene(friction(), drawn((0.5, 1.5), (0.8, 1.2), (3, 6)), friction_in_arrays),
    "its relay form": lambda: Scene(relay_form(), drawn((0.5, 1.5), (0.8, 1.2), (3, 6)), relay_in_arrays),
    "diode bridge": lambda: Scene(bridge(), drawn((5e-3, 2e-2), (5e-7, 2e-6), (500, 2000), (5, 10))),
    "relay oscillator": lambda: Scene(relay_oscillator(), drawn((0.5, 1.5), (2, 4), (0.3, 1))),
}


def least(job: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of the quickest of several calls, and what the last one gave."""
    times, found = [], None
    for _ in range(REPEATS):
        start = time.process_time()
        found = job()
        times.append(time.process_time() - start)
    return min(times), found


def line(name: str, seconds: float, scalar: float, found: BatchCells | None, x: np.ndarray, other: np.ndarray) -> str:
    """One way of a scene."""
    worst = f"{found.worst_residual.max():13.1e}" if found is not None else f"{'not known':>13s}"
    difference = np.abs(x[: len(other)] - other).max() / max(1.0, np.abs(other).max())
    return f"  {name:32s} {1e6 * seconds:10.2f} {1 / seconds:12.0f} {scalar / seconds:9.1f} {worst} {difference:13.1e}"


def compare(name: str, scene: Scene) -> None:
    """Print the ways of a scene."""
    model, values = scene.model, scene.values
    grid = make_grid(
        model.bind(dict(zip(model.parameters, values[0].tolist(), strict=True))), None, None, 12e-1 if SHORT else None
    )
    alone, own = StepBatch(model, grid, 1e-9, in_lanes=False), StepBatch(model, grid, 1e-9)
    scalar, one_by_one = least(lambda: alone.run(values[:ALONE], ["x"], grid.N))
    scalar, other = scalar / ALONE, one_by_one.arrays["x"][:, -1]
    print(f"{name}, {grid.N} steps    us a run       runs/s    ratio  worst residual  off scalar")
    print(line("C, one by one", scalar, scalar, one_by_one, other, other))
    for own.level, words in LEVELS.items():
        seconds, found = least(lambda: own.run(values, ["x"], grid.N))
        print(line(f"C, in lanes, {words}", seconds / RUNS, scalar, found, found.arrays["x"][:, -1], other))
    arrays = scene.arrays
    if arrays is not None:
        seconds, x = least(lambda: arrays(np.resize(values, (AT_ONCE, values.shape[1])), grid.h, grid.N))
        print(line("NumPy over runs, not verified", seconds / AT_ONCE, scalar, None, x[:, None], other[:, :1]))


def main() -> None:
    """Print the table."""
    if compiler() is None:
        print("many runs: no C compiler, skipped")
        return
    print(f"many runs on one core (CPU); the goal is {GOAL} runs/s of the friction oscillator with AVX2")
    for name, scene in SCENES.items():
        compare(name, scene())


if __name__ == "__main__":
    main()
