"""Pictures of a run: each function takes a run, an optional `ax` to draw on, and returns the `ax` it drew on.

Matplotlib is imported inside the functions only, and figures are built without pyplot: nothing global is left behind
and no display is needed. Long runs are thinned so that no extremum and no event is lost. Row k of the multipliers and
of the index set belongs to the step that *ends* at t_k, and is drawn from t_{k-1} to t_k.
"""

from typing import TYPE_CHECKING

from nsmodel._utils import lazy_attributes as _later

if TYPE_CHECKING:
    from nsmodel.plot.class_pictures import configuration
    from nsmodel.plot.figures import overview, save, save_all, window
    from nsmodel.plot.film import animate
    from nsmodel.plot.plane import phase
    from nsmodel.plot.sensitivity import sensitivity
    from nsmodel.plot.strips import index_map, index_strip, profile, space_time
    from nsmodel.plot.study import stress, work_precision
    from nsmodel.plot.sweep import sweep_histogram, sweep_line, sweep_map, sweep_overview
    from nsmodel.plot.time import energy, inputs, multipliers, outputs, residual, states

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
    "profile",
    "residual",
    "save",
    "save_all",
    "sensitivity",
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
        "nsmodel.plot.figures": ["overview", "save", "save_all", "window"],
        "nsmodel.plot.film": ["animate"],
        "nsmodel.plot.class_pictures": ["configuration"],
        "nsmodel.plot.plane": ["phase"],
        "nsmodel.plot.sensitivity": ["sensitivity"],
        "nsmodel.plot.strips": ["index_map", "index_strip", "profile", "space_time"],
        "nsmodel.plot.study": ["stress", "work_precision"],
        "nsmodel.plot.sweep": ["sweep_histogram", "sweep_line", "sweep_map", "sweep_overview"],
        "nsmodel.plot.time": ["energy", "inputs", "multipliers", "outputs", "residual", "states"],
    },
)
