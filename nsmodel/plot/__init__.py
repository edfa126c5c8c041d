"""Pictures of a run: each function takes a run, an optional `ax` to draw on, and returns the `ax` it drew on.

Matplotlib is imported inside the functions only, and figures are built without pyplot: nothing global is left behind
and no display is needed. Long runs are thinned so that no extremum and no event is lost. Row k of the multipliers and
of the index set belongs to the step that *ends* at t_k, and is drawn from t_{k-1} to t_k.
"""

from typing import TYPE_CHECKING

from nsmodel._utils import lazy_attributes as _later

if TYPE_CHECKING:
    from nsmodel.plot.chain import space_time
    from nsmodel.plot.figures import overview, save, save_all
    from nsmodel.plot.film import animate
    from nsmodel.plot.plane import configuration, phase
    from nsmodel.plot.stress import stress
    from nsmodel.plot.strip import index_map, index_strip
    from nsmodel.plot.study import work_precision
    from nsmodel.plot.sweep import sweep_histogram, sweep_line, sweep_overview
    from nsmodel.plot.sweep_map import sweep_map
    from nsmodel.plot.time import energy, inputs, multipliers, outputs, residual, states
    from nsmodel.plot.window import window

__all__ = [
    "animate",
    "configuration",
    "energy",
    "index_map",
    "index_strip",
    "inputs",
    "multipliers",
    "outputs",
    "overview",
    "phase",
    "residual",
    "save",
    "save_all",
    "space_time",
    "states",
    "stress",
    "sweep_histogram",
    "sweep_line",
    "sweep_map",
    "sweep_overview",
    "window",
    "work_precision",
]

_later(
    __name__,
    {
        "nsmodel.plot.film": ["animate"],
        "nsmodel.plot.chain": ["space_time"],
        "nsmodel.plot.figures": ["overview", "save", "save_all"],
        "nsmodel.plot.plane": ["configuration", "phase"],
        "nsmodel.plot.stress": ["stress"],
        "nsmodel.plot.strip": ["index_map", "index_strip"],
        "nsmodel.plot.study": ["work_precision"],
        "nsmodel.plot.sweep": ["sweep_histogram", "sweep_line", "sweep_overview"],
        "nsmodel.plot.sweep_map": ["sweep_map"],
        "nsmodel.plot.time": ["energy", "inputs", "multipliers", "outputs", "residual", "states"],
        "nsmodel.plot.window": ["window"],
    },
)
