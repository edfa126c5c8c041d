"""Count the runs that miss a brief contact, for docs/events.md: nsmodel beside SciPy's solve_ivp with its events.

Run it from anywhere; it rewrites the table between the marks of docs/events.md and docs/images/events_contacts.png. About ten
minutes; NSMODEL_SHORT=1 takes a few scenes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator
from page import put
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from nsmodel import FirstOrderSystem, complementarity, simulate
from nsmodel.plot.style import INK, LINES, blank, dress

IMAGES = Path(__file__).resolve().parents[1] / "images"
COUNT = 8 if os.environ.get("NSMODEL_SHORT") else 1000
TOLERANCES = 10.0 ** -np.arange(2, 10)
LAST = 20.0
METHODS = ("RK45", "DOP853", "LSODA")


@dataclass(frozen=True)
class Scene:
    """a cos(t + p) + b cos(w t + q), and a wall that it touches from ``first`` to ``leaves`` for the first time."""

    a: float
    b: float
    w: float
    p: float
    q: float
    wall: float
    rtol: float
    first: float
    leaves: float

    def start(self) -> np.ndarray:
        """Places and velocities of the two oscillators at t = 0."""
        a, b, w, p, q = self.a, self.b, self.w, self.p, self.q
        return np.array([a * np.cos(p), -a * np.sin(p), b * np.cos(q), -w * b * np.sin(q)])


def scene(rng: np.random.Generator, rtol: float) -> Scene:
    """A random scene whose wall is 10 to 10 000 rtol deep at most, and not touched at the start."""
    grid = np.linspace(0, LAST, 20_001)
    while True:
        a, b, w = rng.uniform(0.5, 1), rng.uniform(0.2, 0.6), rng.uniform(1.5, 12)
        p, q, depth = *rng.uniform(0, 2 * np.pi, 2), rtol * 10 ** rng.uniform(1, 4)

        def place(t: float, a: float = a, b: float = b, w: float = w, p: float = p, q: float = q) -> float:
            return a * np.cos(t + p) + b * np.cos(w * t + q)

        def speed(t: float, a: float = a, b: float = b, w: float = w, p: float = p, q: float = q) -> float:
            return -a * np.sin(t + p) - b * w * np.sin(w * t + q)

        turns = np.flatnonzero((speed(grid[:-1]) > 0) & (speed(grid[1:]) <= 0))
        tops = np.array([brentq(speed, grid[k], grid[k + 1], xtol=1e-15) for k in turns])
        heights = place(tops)
        wall = heights.max(initial=0.0) - depth
        if depth > 0.3 or place(0.0) > wall - depth or np.abs(heights - wall).min(initial=1.0) < depth / 100:
            continue
        top = tops[heights > wall][0]
        before = grid[(grid < top) & (place(grid) < wall)][-1]
        after = grid[(grid > top) & (place(grid) < wall)]
        if after.size:
            ends = [brentq(lambda t: place(t) - wall, one, top, xtol=1e-15) for one in (before, after[0])]  # noqa: B023
            return Scene(a, b, w, p, q, wall, rtol, *map(float, ends))


def by_nsmodel(s: Scene) -> bool:
    """Whether nsmodel misses the contact, a soft one."""
    x, l = ca.SX.sym("x", 4), ca.SX.sym("l")
    model = FirstOrderSystem(
        x=x, lam=l, f=[x[1], -x[0], x[3], -(s.w**2) * x[2]], g=[0, -l, 0, 0], h=[s.wall - x[0] - x[2] + 0.01 * l],
        law=complementarity(1), x0=s.start(), t_end=s.leaves + 0.5,
    )  # fmt: skip
    run = simulate(model, rtol=s.rtol, method="event-driven")
    return not (run.events and run.events[0].t < s.leaves)


def by_scipy(method: str) -> Callable[[Scene], bool]:
    """Whether solve_ivp misses it: an event that ends the free motion at the wall."""

    def misses(s: Scene) -> bool:
        def free(_: float, x: np.ndarray) -> tuple[float, ...]:
            return x[1], -x[0], x[3], -(s.w**2) * x[2]

        def gap(_: float, x: np.ndarray) -> float:
            return s.wall - x[0] - x[2]

        gap.terminal, gap.direction = True, -1  # pyright: ignore[reportFunctionMemberAccess]
        found = solve_ivp(free, (0, LAST), s.start(), method, rtol=s.rtol, atol=s.rtol, events=gap)
        return not (found.t_events[0].size and found.t_events[0][0] < s.leaves)

    return misses


def shares(ax: Axes, missed: dict[str, np.ndarray], bins: list[np.ndarray], at: list[float]) -> None:
    """The share of the runs of each bin that missed the contact, a line a method."""
    for i, (name, runs) in enumerate(missed.items()):
        own = name == "nsmodel"
        style = {
            "marker": "os^D"[i],
            "ms": 6 if own else 5,
            "lw": 2.4 if own else 1.4,
            "color": LINES[i],
            "zorder": 5 if own else 3,
        }
        ax.plot(at, [100 * runs[chosen].mean() for chosen in bins], label=name, clip_on=False, **style)
    ax.set_xscale("log")
    ax.set_ylim(0, 100)


def main() -> None:
    """Run all scenes by all methods, draw the picture and write the table."""
    rng = np.random.default_rng(2026)
    scenes = [scene(rng, float(rtol)) for rtol in np.resize(TOLERANCES, COUNT)]
    methods = {"nsmodel": by_nsmodel} | {f"solve_ivp, {method}": by_scipy(method) for method in METHODS}
    missed = {name: np.array([misses(s) for s in scenes]) for name, misses in methods.items()}
    rtol, lengths = np.array([s.rtol for s in scenes]), np.array([s.leaves - s.first for s in scenes])
    figure = blank(9.5, 3.9)
    left, right = figure.subplots(1, 2, sharey=True)
    shares(left, missed, [rtol == value for value in TOLERANCES], list(TOLERANCES))
    left.invert_xaxis()
    left.xaxis.set_minor_locator(NullLocator())
    dress(left, "Runs that miss the contact, by tolerance", "rtol", "missed [%]")
    edges = np.quantile(lengths, np.linspace(0, 1, 9 if len(scenes) >= 100 else 3))
    parts = [(lengths >= low) & (lengths <= high) for low, high in pairwise(edges)]
    shares(right, missed, parts, [float(np.median(lengths[part])) for part in parts])
    dress(right, "... and by the length of the contact", "length of the contact, in units of t", "")
    right.legend(loc="lower left", bbox_to_anchor=(0.02, 0.1), fontsize=8, frameon=False, labelcolor=INK)
    figure.savefig(IMAGES / "events_contacts.png", dpi=110)
    rows = [f"| {name} | {runs.sum()} | {len(runs)} | {100 * runs.mean():.1f} % |" for name, runs in missed.items()]
    put("events.md", "contacts", "\n".join(["| method | missed | runs | share |", "| --- | ---: | ---: | ---: |", *rows]))


if __name__ == "__main__":
    main()
