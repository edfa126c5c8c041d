"""The derivatives of a run over time, with the switches at which they jump."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nsmodel.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.derivatives.result import Sensitivity


SWITCH_COLOUR = "#C3C9D0"


def sensitivity(found: Sensitivity, *, ax: Axes | None = None) -> Axes:
    """Draw each derivative divided by its largest, which the legend says; switches are thin lines, known times dotted ones.

    Where the time of a switch moves derivatives jump: lines are cut there.
    """
    ax = style.get_axes(ax, 9.5, 5.0)
    jumps = np.unique([one.t for one in found.switches if one.dt.any()])
    t = np.insert(found.t, np.searchsorted(found.t, jumps, side="left"), jumps)
    for one in found.switches:
        known = not np.isfinite(one.transversality)
        ax.axvline(one.t, color=SWITCH_COLOUR, linewidth=0.7, linestyle=":" if known else "-", zorder=1)
    handles = []
    pairs = [(i, j) for i in range(len(found.outputs)) for j in range(len(found.by))]
    for k, (i, j) in enumerate(pairs):
        own = found.jacobian[:, i, j]
        largest = float(np.abs(own).max())
        if not largest:
            continue
        column = np.insert(own / largest, np.searchsorted(found.t, jumps, side="left"), np.nan)
        label = style.safe_text(f"d {found.outputs[i]}/d {found.by[j]}, at most {largest:.3g}")
        handles += ax.plot(t, column, color=style.LINES[k % len(style.LINES)], linewidth=1.4, label=label, zorder=3)
    style.dress_over_time(ax, found.run, found.run.title, "derivative / its largest")
    if handles:
        style.legend(ax, handles, column=True)
    return ax
