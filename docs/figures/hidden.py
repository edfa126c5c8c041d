"""Count the runs that are silently wrong on scenes that hide motion, for docs/events.md: nsmodel beside SciPy, CVODE and heyoka.

Run it from anywhere; it rewrites the table between the marks of docs/events.md and docs/images/events_hidden.png. The scenes and
the verdicts are those of tests/bench/hidden.py. Ten minutes of a core; NSMODEL_SHORT=1 takes one scene of a kind. Where a tool
is not installed the page stays as it is, and the picture goes to results/.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from page import put, save

import nsmodel
from nsmodel.plot.style import ALERT, INK, LOWER, PALE, UPPER, blank, dress

ROOT = Path(nsmodel.__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from bench import hidden  # noqa: E402  # pyright: ignore[reportMissingImports]

IMAGES, RESULTS = Path(__file__).resolve().parents[1] / "images", ROOT / "results"
COLOURS = {hidden.WRONG: ALERT, hidden.RIGHT: LOWER, hidden.SAID: UPPER, hidden.LONG: PALE}
WORDS = {hidden.WRONG: "silently wrong", hidden.RIGHT: "right", hidden.SAID: "said", hidden.LONG: "too long"}
SHADES = LinearSegmentedColormap.from_list("wrong", ["#FFFFFF", ALERT])


def bars(ax: Axes, shares: dict[str, dict[str, float]]) -> None:
    """A bar a tool, of its verdicts."""
    names = [name.replace(", max_step", ",\nmax_step") for name in shares]
    left = np.zeros(len(shares))
    for part in hidden.PARTS:
        widths = np.array([share[part] for share in shares.values()])
        ax.barh(names, widths, left=left, color=COLOURS[part], height=0.7, label=WORDS[part])
        left += widths
    dress(ax, "Runs by verdict", "share of the runs [%]", "")
    ax.set_xlim(0, 100)
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)


def kinds(ax: Axes, runs: list[dict[str, Any]], tools: list[str]) -> None:
    """The share of silently wrong runs of each tool and kind."""
    names = list(dict.fromkeys(one["kind"] for one in runs))
    of_kind = [hidden.shares([one for one in runs if one["kind"] == kind]) for kind in names]
    wrong = np.array([[share[tool][hidden.WRONG] for share in of_kind] for tool in tools])
    ax.imshow(wrong, cmap=SHADES, vmin=0, vmax=130, aspect="auto")
    for (i, j), value in np.ndenumerate(wrong):
        words = f"{value:.0f}" if value == 0 or value >= 0.95 else f"{value:.1f}"
        ax.text(j, i, words, ha="center", va="center", fontsize=8, color=INK)
    dress(ax, "Silently wrong, by kind of scene [%]", "", "", grid=False)
    ax.set_xticks(range(len(names)), [name.replace(" condition", "\ncondition") for name in names])
    ax.tick_params(length=0, labelleft=False)
    ax.spines[:].set_visible(False)


def picture(runs: list[dict[str, Any]]) -> Figure:
    """Verdicts on the left, kinds on the right."""
    shares = hidden.shares(runs)
    figure = blank(10.5, 4.3)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1, 1.25])
    bars(left, shares)
    kinds(right, runs, list(shares))
    left.legend(loc="upper center", bbox_to_anchor=(0.4, -0.16), ncols=4, fontsize=8, frameon=False, labelcolor=INK)
    return figure


def main() -> None:
    """Run all, draw the picture and write the table."""
    missing = hidden.missing()
    runs = hidden.measured(jobs=os.cpu_count() or 1)
    if missing:
        print(f"{' and '.join(missing)}: not installed, skipped; docs/events.md stays as it is, the picture goes to {RESULTS}\n")
        print(f"hidden\n\n{hidden.table(runs)}\n", flush=True)
    else:
        put("events.md", "hidden", hidden.table(runs))
    save(picture(runs), (RESULTS if missing else IMAGES) / "events_hidden.png", 64)


if __name__ == "__main__":
    main()
