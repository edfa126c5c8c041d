"""A run as a page: its facts, panels over time, index set, events, phase plane and configuration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import escape_invisible
from nsmodel.plot import continuous
from nsmodel.simulation import summary
from nsmodel.simulation.run_data import model_type, units_of
from nsmodel.view.columns import TimePanel, further_panels, index_set_bands, run_panels
from nsmodel.view.packed import pack_numbers, packing_for
from nsmodel.view.page import standalone_page, write_page
from nsmodel.view.scene import disc_scene_data, forbidden_set_data

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

CURVE_POINTS = 20_000  # Read off the polynomials of an event-driven run.
MAX_EVENTS = 100_000  # The most that are marked,
MAX_EVENT_TEXTS = 2_000  # and that say what changes.
LAW_PANELS = ("Multipliers", "Reactions")  # Before these stands the index set.
RUN_SCRIPTS = ("data", "elements", "axes", "curves", "panels", "plane", "pictures", "view")


def view_run(run: Trajectory, path: str | Path | None = None, model: Any = None) -> Path:
    """Write the page of a run, and return its path; see `Trajectory.view`."""
    return write_page(standalone_page(run.title, run_document(run, model), RUN_SCRIPTS), path, run.title)


def run_document(run: Trajectory, model: Any = None) -> dict[str, Any]:
    """All that the page shows of a run, as plain data.

    Panels name one of the ``clocks``, the times that their rows have. An event-driven run has two: points that are read off its
    polynomials, and the rows that were saved.
    """
    drawn, lines = continuous.smooth_with_energy(run, model, CURVE_POINTS)
    own, rest = run_panels(drawn, {"energy": continuous.ENERGY_ON_LINES} if lines else {}), further_panels(run)
    if drawn is run:
        clocks = [_panels_with_clock(run, [*own, *rest], run)]
    else:
        clocks = [_panels_with_clock(drawn, own, drawn), _panels_with_clock(run, rest, None)]
    return {
        "kind": "run",
        "title": escape_invisible(run.title),
        "status": escape_invisible(run.status),
        "facts": _summary_facts(run),
        "time": {"unit": escape_invisible(units_of(run).get("t", ""))},
        "rows": len(drawn.t),
        "note": _rows_note(run, drawn, clocks[0]["width"]),
        "clocks": [{key: clock[key] for key in ("width", "times")} for clock in clocks],
        "panels": [panel for clock in clocks for panel in clock["panels"]],
        "events": _events(run),
        "stretches": [
            [one["start"], min(one["until"], float(run.t[-1]))] for one in (run.metadata.get("totals") or {}).get("stretches", ())
        ],
        "phase": _phase_columns(run, clocks[0]["panels"]),
        "scene": disc_scene_data(run),
        "forbidden": forbidden_set_data(run, model),
    }


def _panels_with_clock(rows: Trajectory, own: list[TimePanel], strip: Trajectory | None) -> dict[str, Any]:
    """Panels over the rows of one run, with their times: where the rows begin that are held as one, and the last."""
    held = packing_for(len(rows.t), sum(len(panel.names) * (1 + bool(panel.begins)) for panel in own))
    found = [panel.document(held, int(strip is None)) for panel in own]
    if strip is not None and (codes := index_set_bands(rows, held, 0)) is not None:
        found.insert(next((k for k, panel in enumerate(own) if panel.title.startswith(LAW_PANELS)), len(own)), codes)
    times = np.append(rows.t[:: held.width], rows.t[-1])
    return {"width": held.width, "times": pack_numbers(times), "panels": found}


def _summary_facts(run: Trajectory) -> list[list[Any]]:
    """The summary as labels and lines."""
    return [
        [label, [escape_invisible(line) for line in lines]]
        for label, lines in summary.summary_lines(summary.run_summary(run)).items()
    ]


def _rows_note(run: Trajectory, drawn: Trajectory, width: int) -> str:
    """What the page does not have: rows."""
    every = run.metadata.get("save_every", 1)
    saved = f" (1 saved of {every})" if every > 1 else ""
    if drawn is not run:
        return f"{len(drawn.t):,} points read off the polynomials between events; {len(run.t):,} rows saved{saved}."
    if width == 1:
        return f"{len(run.t):,} rows{saved}, each of them on this page."
    return (
        f"{len(run.t):,} rows{saved}: too many for one page. It holds the least and the largest value of each {width} rows that "
        "follow one another; zoomed in to these, boxes are drawn and no line. The rows are in the run's own file."
    )


def _events(run: Trajectory) -> dict[str, Any] | None:
    """The switches of an event-driven run: when, and what changes; None of other runs."""
    if not run.is_event_driven:
        return None
    starts, codes = run.arrays["piece_start"], run.arrays["piece_codes"]
    at = np.flatnonzero(run.arrays["piece_event"] & (starts <= run.t[-1]))
    names = run.metadata.get("index_names") or [f"row {k}" for k in range(codes.shape[1])]
    texts = []
    for k in at[:MAX_EVENT_TEXTS]:
        changed = np.flatnonzero(codes[k] != codes[k - 1])[:6] if k else []
        texts.append(", ".join(f"{escape_invisible(names[i])}: {codes[k - 1, i]} to {codes[k, i]}" for i in changed))
    return {"count": len(at), "times": pack_numbers(starts[at[:MAX_EVENTS]]), "words": texts}


def _phase_columns(run: Trajectory, found: list[dict[str, Any]]) -> list[list[int]] | None:
    """Which columns the phase plane opens with, as (panel, column): over a state a velocity, another state, or what there is."""
    places = [(panel["title"], [p, c]) for p, panel in enumerate(found) for c in range(len(panel.get("columns", ())))]
    states, fast = ([place for title, place in places if title.startswith(kind)] for kind in ("States", "Velocities"))
    if run.metadata.get("scene") or len(places) < 2:
        return None
    if model_type(run).second_order and fast:
        return [states[0], fast[0]]
    others = [place for place in states if place[0] != states[0][0]] or states[1:]
    return [states[0], (others or [place for _, place in places[1:]])[0]]
