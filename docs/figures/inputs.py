"""Draw the picture of docs/inputs.md, a sampled sliding mode that is explicit or implicit, and write its table.

Run it from anywhere; it writes docs/images/inputs_sliding.png. Seconds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from page import put, save

from nsmodel import Trajectory, load, simulate
from nsmodel.plot.style import FREE, LINES, blank, dress

IMAGES = Path(__file__).resolve().parents[1] / "images"
WAYS = {"explicit": False, "implicit": True}
BOUND = {"explicit": 1.5, "implicit": 0.5}  # of |x| once it slides, in h


def run(way: str, h: float) -> Trajectory:
    """The loop, exact: a row a sample."""
    return simulate(load("sliding_mode", h=h, implicit=WAYS[way]), rtol=1e-10)


def row(way: str, h: float) -> str:
    """The line of the table: what happens from t = 5 on."""
    loop = run(way, h)
    w = loop.w[loop.t > 5 + h / 2]
    largest = np.abs(loop.x[loop.t > 5 - h / 2]).max()
    return f"| {h:g} | {way} | {largest:.4g} | {BOUND[way] * h:g} | {np.abs(np.diff(w)).sum():.4g} |"


def main() -> None:
    """Run both ways, draw them and write the table."""
    h = 0.1
    figure = blank(9.0, 4.6)
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for (above, below), way, colour in zip(axes.T, WAYS, (LINES[1], LINES[0]), strict=True):
        loop = run(way, h)
        t = np.linspace(0, 10, 4001)
        above.plot(t, loop.at(t).x[:, 0], color=colour, linewidth=1.3)
        for side in (-1, 1):
            above.axhline(side * BOUND[way] * h, color=FREE, linewidth=0.9, linestyle=(0, (5, 4)))
        below.step(loop.t, np.append(loop.w[1:], loop.w[-1]), where="post", color=colour, linewidth=1.1)
        below.plot(t, -0.5 * np.sin(t), color=FREE, linewidth=0.9, linestyle=(0, (5, 4)))
        words = "w = -sgn(x)" if way == "explicit" else "w = -sat(x/h)"
        dress(above, f"{way.capitalize()}: {words}", "", "x" if way == "explicit" else "")
        dress(below, "", "t", "w" if way == "explicit" else "")
        above.set_ylim(-0.25, 0.45)
        below.set_xlim(0, 10)
    save(figure, IMAGES / "inputs_sliding.png", 64)
    lines = ["| h | control | largest \\|x\\| | bound | variation of w |", "| ---: | --- | ---: | ---: | ---: |"]
    put("inputs.md", "sliding", "\n".join([*lines, *(row(way, h) for h in (0.1, 0.05, 0.01) for way in WAYS)]))


if __name__ == "__main__":
    main()
