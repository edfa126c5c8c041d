"""A run as a page: its facts, panels of columns over time, index set, events, phase plane and configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.files.archive import LIST_PREFIXES
from nsmodel.models.crowd.measure import present
from nsmodel.plot import crowd, rounding, style
from nsmodel.plot.class_pictures import pictures_of
from nsmodel.plot.html.page import PackedRows, pack_codes, pack_column, pack_numbers, packing_for, standalone_page, write_page
from nsmodel.plot.plane import body_pressures, margin_limits
from nsmodel.plot.strips import row_laws
from nsmodel.simulation import summary
from nsmodel.simulation.columns import quantity_at_step_ends, read_quantity
from nsmodel.simulation.run_data import input_names, model_type, multiplier_names, output_names, state_names, units_of

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

MAX_PANEL_COLUMNS = 24  # Columns of a panel, bands of an index set: as many as a legend has room for; of more some, and a note.
INITIAL_COLUMNS = 8  # Of them drawn when the page opens: colours that can be told apart; others are switched on.
# A few columns without units whose sizes are so far apart have a panel of their own, as the smaller would be a flat line,
SIZE_RATIO = 20
FEW_COLUMNS = 6  # where there are so few, so that each panel keeps some,
ROUNDING_SHARE = 1e-9  # but for what is this part of the others: rounding.
PANEL_ARRAYS = {
    "t",
    "x",
    "multipliers",
    "y",
    "index_set",
    "reactions",
    "inputs",
    "inputs_begin",
    "v",
    "energy",
    "residual",
    "pressure",
    "halving",
}


@dataclass(frozen=True, eq=False)
class TimePanel:
    """Columns over one axis.

    Attributes:
        title: what they are.
        names: of the columns.
        values: one array (N+1,) a column.
        unit: of all.
        begins: of columns that may jump at rows, their values where the step to each row begins.
        look: "line" from row to row; "step", a row's value over the step that ends there; "log", dots on a logarithmic axis.
        open: whether it is seen when the page opens.
        note: such as that not all columns are there.
        level: a value to mark, with its words.
    """

    title: str
    names: Sequence[str]
    values: Sequence[np.ndarray]
    unit: str = ""
    begins: Sequence[np.ndarray] = ()
    look: str = "line"
    open: bool = True
    note: str = ""
    level: tuple[float, str] | None = field(default=None)

    def document(self, rows: PackedRows, clock: int) -> dict[str, Any]:
        """The panel as plain data; ``clock``: which times its rows have."""
        first = set(style.evenly_spread(len(self.names), INITIAL_COLUMNS).tolist())
        columns = []
        for k, (name, values) in enumerate(zip(self.names, self.values, strict=True)):
            missing = int(np.count_nonzero(np.isnan(values[1:])))
            columns.append(
                {"name": name, "shown": k in first, "missing": missing}
                | pack_column(values, self.begins[k] if self.begins else None, rows)
            )
        own = {name: getattr(self, name) for name in ("title", "unit", "look", "open", "note", "level")}
        return own | {"clock": clock, "columns": columns}


def run_panels(run: Trajectory, notes: Mapping[str, str] = MappingProxyType({})) -> list[TimePanel]:
    """The panels of the rows of a run, those first that say most; ``notes``: on columns by name."""
    scene, found = bool(run.metadata.get("scene")), []
    units = units_of(run)
    if scene and run.x.shape[1] % 2 == 0:
        found += _crowd_panels(run)
    found += _panels_by_unit("States", "line", state_names(run), units, list(run.x.T), open=not scene)
    if "v" in run.arrays:
        found += _velocity_panels(run, units)
    found += _output_panels(run, units)
    if "inputs" in run.arrays:
        begin = run.arrays["inputs_begin"]
        found += _panels_by_unit("Inputs", "step", input_names(run), units, list(run.inputs.T), begins=list(begin.T))
    found += _law_panels(run, units)
    if "energy" in run.arrays:
        found.append(
            TimePanel("Energy", ["energy"], [run.arrays["energy"]], units.get("energy", ""), note=notes.get("energy", ""))
        )
    return found


def further_panels(run: Trajectory) -> list[TimePanel]:
    """The residual, and all arrays that no other panel has: of the rows that were saved."""
    found = []
    if "residual" in run.arrays:
        tolerance = run.metadata.get("tolerance")
        level = (float(tolerance), f"tolerance {tolerance:.3g}") if tolerance else None
        found.append(
            TimePanel("Residual", ["residual"], [run.residual], "", look="log", level=level, note=_off_scale_note(run.residual))
        )
    if "halving" in run.arrays:
        states, off = state_names(run), list(run.arrays["halving"].T)
        found += _panels_by_unit("Difference from halved steps", "line", states, units_of(run), off, largest=True)
    taken, units = PANEL_ARRAYS | {*run.metadata.get("outputs", ())}, units_of(run)
    for name, array in run.arrays.items():
        if name not in taken and not name.startswith(LIST_PREFIXES) and array.ndim <= 2 and array.dtype.kind in "biuf":
            flat = array.reshape(len(array), -1)
            names = [name] if flat.shape[1] == 1 else [f"{name}_{k}" for k in range(flat.shape[1])]
            given = {one: units.get(name, "") for one in names}
            found += _panels_by_unit(name, "step", names, given, list(flat.T), open=False, largest=True)
    return found


def index_set_bands(run: Trajectory, rows: PackedRows, clock: int) -> dict[str, Any] | None:
    """The index set as plain data: of each row the codes seen, 1 << (code + 2); None where there is none."""
    found = run.arrays.get("index_set")
    if found is None or not found.shape[1]:
        return None
    names = run.metadata.get("index_names") or [f"row {k}" for k in range(found.shape[1])]
    kinds, labels = row_laws(run, names), {}
    changes = np.array([np.count_nonzero(one[2:] != one[1:-1]) for one in found.T])
    picks = np.sort(np.argsort(-changes, kind="stable")[:MAX_PANEL_COLUMNS]).tolist()
    starts, bits = np.arange(0, len(found), rows.width), 1 << np.arange(8, dtype=np.uint8)
    entries = []
    for k in picks:
        kind, own = kinds[k]
        labels[kind] = [[1 << (code + 2), role, text] for code, (role, text) in own.items()]
        seen = np.bitwise_or.reduceat(bits[np.clip(found[:, k] + 2, 0, 7)], starts)
        entries.append({"name": names[k], "kind": kind, "seen": pack_codes(seen)})
    note = style.selection_note(len(picks), found.shape[1], "those that change most").strip()
    return {"title": "Index set", "look": "bands", "open": True, "note": note, "clock": clock, "bands": entries, "words": labels}


def _crowd_panels(run: Trajectory) -> list[TimePanel]:
    """How many bodies are there, and the pressure on them."""
    present_count = present(run).sum(axis=1).astype(float)
    found = [TimePanel("Bodies there", ["bodies"], [present_count])] if np.ptp(present_count) else []
    if "pressure" in run.arrays:
        unit = units_of(run).get("pressure", "")
        found.append(TimePanel("Pressure on a body", ["largest", "mean"], crowd.pressure_over_time(run), unit, look="step"))
    return found


def _velocity_panels(run: Trajectory, units: dict[str, str]) -> list[TimePanel]:
    length, time, names = [units.get(name, "") for name in state_names(run)], units.get("t", ""), state_names(run)
    given = {f"v of {name}": f"{one}/{time}" if one and time else "" for name, one in zip(names, length, strict=True)}
    return _panels_by_unit("Velocities", "line", list(given), given, list(run.arrays["v"].T))


def _output_panels(run: Trajectory, units: dict[str, str]) -> list[TimePanel]:
    """The declared outputs: by time stepping each step from its begin to its end."""
    names, values, begins = [], [], []
    for name, own in output_names(run).items():
        names += own
        end = run.arrays[name].reshape(len(run.t), -1)
        values += list(end.T)
        if not run.is_event_driven and len(run):
            begin = quantity_at_step_ends(run, *read_quantity(run, name), 0, len(run))[0].reshape(len(run), -1)
            begins += list(np.concatenate([end[:1], begin]).T)
    look = "step" if begins else "line"
    return _panels_by_unit("Outputs", look, names, units, values, begins=begins, largest=True) if names else []


def _law_panels(run: Trajectory, units: dict[str, str]) -> list[TimePanel]:
    """Multipliers, reactions and y."""
    names, found, look = multiplier_names(run), [], "line" if run.is_event_driven else "step"
    reactions = bool(names) and "reactions" in run.arrays
    if names and not (reactions and run.is_event_driven):
        found += _panels_by_unit("Multipliers", look, names, units, list(run.multipliers.T), largest=True)
    if reactions:
        title = "Reactions" if run.is_event_driven else "Reactions (multipliers / step)"
        given, values = dict.fromkeys(names, units.get("reactions", "")), list(run.arrays["reactions"].T)
        found += _panels_by_unit(title, look, names, given, values, largest=True, open=run.is_event_driven)
    if "y" in run.arrays and run.y.shape[1]:
        own = names if run.y.shape[1] == len(names) else [str(k) for k in range(run.y.shape[1])]
        y_units = {f"y of {name}": units.get(f"y_{k}", "") for k, name in enumerate(own)}
        found += _panels_by_unit("y of the law", "line", list(y_units), y_units, list(run.y.T), largest=True, open=False)
    return found


def _panels_by_unit(
    title: str, look: str, names: Sequence[str], units: dict[str, str], values: Sequence[np.ndarray], *,
    begins: Sequence[np.ndarray] = (), open: bool = True, largest: bool = False,
) -> list[TimePanel]:  # fmt: skip
    """A panel for each unit; without any, one for each of two very different sizes. Of many columns some, and a note."""
    given = [units.get(name, "") for name in names]
    size = np.array([_largest_magnitude(one) for one in values] if largest or len(names) <= FEW_COLUMNS else np.ones(len(names)))
    groups: dict[tuple[str, bool], list[int]] = {}
    top, separable = size.max(initial=0.0), not any(given) and len(names) <= FEW_COLUMNS
    for k, unit in enumerate(given):
        small = separable and ROUNDING_SHARE * top < size[k] <= top / SIZE_RATIO
        groups.setdefault((unit, bool(small)), []).append(k)
    found = []
    for (unit, small), members in groups.items():
        best = (
            np.sort(np.argsort(-size[members], kind="stable")[:MAX_PANEL_COLUMNS])
            if largest
            else style.evenly_spread(len(members), MAX_PANEL_COLUMNS)
        )
        picks: list[int] = np.array(members)[best].tolist()
        note = style.selection_note(len(picks), len(members), "the largest" if largest else "evenly spread").strip()
        name = f"{title}, the small ones" if small else title
        labels: list[str] = [names[k] for k in picks]
        own = [begins[k] for k in picks] if begins else []
        found.append(TimePanel(name, labels, [values[k] for k in picks], unit, own, look, open, note))
    return found


def _largest_magnitude(values: np.ndarray) -> float:
    """The largest absolute value, NaN left out; no copy is made."""
    return float(np.nan_to_num(max(abs(np.fmin.reduce(values)), abs(np.fmax.reduce(values)))))


def _off_scale_note(residual: np.ndarray) -> str:
    """How many residuals have no place on a logarithmic axis."""
    zero, unknown = int((residual[1:] == 0).sum()), int(np.isposinf(residual).sum())
    parts = [f"exactly 0: {zero} of {len(residual) - 1}, at the bottom"] if zero else []
    return "; ".join(parts + ([f"unknown: {unknown}, at the top"] if unknown else []))


MAX_PLACES_BYTES = 4_000_000  # Bytes for the places; of a longer run some rows are drawn. A third of what the columns may take.
FORBIDDEN_GRID = 100  # Points of the forbidden set along each axis: 10 KB a time, before they are deflated,
MAX_MOMENTS = 60  # at so many times at most; between them the nearest is shown.


def disc_scene_data(run: Trajectory) -> dict[str, Any] | None:
    """The configuration as plain data; None of a run whose scene has no discs."""
    about = run.metadata.get("scene") or {}
    if "radii" not in about or run.x.shape[1] != 2 * len(about["radii"]) or not len(about["radii"]):
        return None
    rows = style.evenly_spread(len(run.t), max(2, MAX_PLACES_BYTES // (4 * run.x.shape[1])))
    pressure = body_pressures(run, rows, len(about["radii"]))
    lines = {key: [np.ravel(one).tolist() for one in about.get(key) or []] for key in ("walls", "exits")}
    unit = units_of(run).get(state_names(run)[0], "")
    return {
        **lines,
        "radii": [float(radius) for radius in about["radii"]],
        "window": [float(end) for ends in zip(*crowd.scene_corners(run), strict=True) for end in ends],
        "unit": unit,
        "rows": [int(row) for row in rows],
        "of": len(run.t),
        "times": pack_numbers(run.t[rows]),
        "places": pack_numbers(run.x[rows].T.ravel(), exact=False),
        "pressure": None if pressure is None else pack_numbers(pressure.T.ravel(), exact=False),
        "top": crowd.pressure_scale(pressure),
        "pressure_unit": units_of(run).get("pressure" if "pressure" in run.arrays else "reactions", ""),
    }


def forbidden_set_data(run: Trajectory, model: Any) -> dict[str, Any] | None:
    """Where a state of one or two components may not be, on a grid and at some times; None where the class knows no such set.

    Of one component over the plane (t, q), of two over their plane. ``inside`` is 1 where some constraint is negative.
    """
    own, n = pictures_of(run), run.x.shape[1]
    if model is None or own is None or own.gap is None or run.metadata.get("scene") or n > 2 or len(run.t) < 2:
        return None
    gap, moving = own.gap(model, run)
    limits = [*([(run.t[0], run.t[-1])] if n == 1 else []), *margin_limits(*run.x.T, margin=0.3)]
    across, up = np.meshgrid(*(np.linspace(*limit, FORBIDDEN_GRID) for limit in limits))
    rows = style.evenly_spread(len(run.t), MAX_MOMENTS) if moving and n == 2 else np.zeros(1, int)
    shape = (len(rows), *up.shape)
    points = [np.broadcast_to(one, shape) for one in ((up,) if n == 1 else (across, up))]
    least = gap(across if n == 1 else run.t[rows][:, None, None], *points)
    return {
        "size": FORBIDDEN_GRID,
        "window": [float(end) for limit in limits for end in limit],
        "times": pack_numbers(run.t[rows]),
        "inside": pack_codes(np.ma.filled(least < 0, False).ravel()),
        "note": f"The set forbidden is drawn at {len(rows)} of {len(run.t)} rows." if 1 < len(rows) < len(run.t) else "",
    }


# Read off the polynomials of an event-driven run: ten for each pixel across, so that a part can be looked at closely.
CURVE_POINTS = 20_000
MAX_EVENTS = 100_000  # The most that are marked, of which the page holds the times, 800 KB,
MAX_EVENT_TEXTS = 2_000  # and that say what changes, in words, some 50 bytes each.
LAW_PANELS = ("Multipliers", "Reactions")  # Before these stands the index set.
RUN_SCRIPTS = ("data", "elements", "axes", "curves", "panels", "plane", "pictures", "view")


def write_run_page(run: Trajectory, path: str | Path | None = None, model: Any = None) -> Path:
    """Write the page of a run, and return its path; see `Trajectory.view`."""
    return write_page(standalone_page(run.title, run_document(run, model), RUN_SCRIPTS), path, run.title)


def run_document(run: Trajectory, model: Any = None) -> dict[str, Any]:
    """All that the page shows of a run, as plain data.

    Panels name one of the ``clocks``, the times that their rows have. An event-driven run has two: points that are read off its
    polynomials, and the rows that were saved.
    """
    drawn, lines = rounding.smooth_with_energy(run, model, CURVE_POINTS)
    own, rest = run_panels(drawn, {"energy": rounding.ENERGY_ON_LINES} if lines else {}), further_panels(run)
    if drawn is run:
        clocks = [_panels_with_clock(run, [*own, *rest], run)]
    else:
        clocks = [_panels_with_clock(drawn, own, drawn), _panels_with_clock(run, rest, None)]
    return {
        "kind": "run",
        "title": run.title,
        "status": run.status,
        "facts": [[label, list(lines)] for label, lines in summary.summary_lines(summary.run_summary(run)).items()],
        "time": {"unit": units_of(run).get("t", "")},
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
        texts.append(", ".join(f"{names[i]}: {codes[k - 1, i]} to {codes[k, i]}" for i in changed))
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
