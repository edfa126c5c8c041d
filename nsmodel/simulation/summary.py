"""A run in short: its numbers, and the table of them that a terminal shows."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from nsmodel._utils import TEXT_WIDTH, sum_in_order
from nsmodel.simulation.run_data import RunData, model_type, multiplier_names, state_names, units_of
from nsmodel.solvers import impacts

_LABEL_WIDTH = 18  # The column of labels.
_MAX_STATES = 8  # States at the end that are written out,
_MAX_CONTACTS = 8  # contacts,
_MAX_ARCH_BODIES = 8  # bodies behind an arch,
_MAX_SPANS = 4  # and intervals of time.
STANDSTILL_REASONS = {  # How a run of many bodies knows that nothing will ever change again.
    "given back": "nothing will ever change, the step gives back its state bit for bit; the run ends",
    "held": "nothing will ever change, the contacts alone hold them in place; the run ends",
}
ANTI_FRICTION_MEANING = (
    ", below 0. A larger l lowers y, which the law needs it to raise; a step may have several solutions, or none"
)
NO_ERROR_KNOWN = "the error of these steps is not known; halve=True (--halve) estimates it, rtol (--rtol) controls it"
HALVING_HEAD = "an estimate of the error, no bound: with steps of half the length the states differ by at most"
ERROR_CONTROL_KEYS = ("rtol", "accepted", "rejected", "extrapolated", "at_least_step", "least_step", "estimate")
EVENT_DRIVEN_KEYS = ("rtol", "order", "pieces", "collocated", "events", "worst_estimate", "worst_estimate_t")


def run_summary(run: RunData) -> dict[str, Any]:
    """The numbers of a run; those of all steps come from metadata["totals"] where it is, since rows may be a sample."""
    arrays, about, units = run.arrays, run.metadata, units_of(run)
    totals = about.get("totals") or {}
    steps = arrays.get("step", np.diff(run.t, prepend=np.nan))
    computed = np.flatnonzero(np.isfinite(steps))
    energy = arrays.get("energy", np.zeros(0))
    energy = energy[np.isfinite(energy)] if energy.ndim == 1 else np.zeros(0)
    return {
        "title": run.title,
        "model_class": about.get("model_class"),
        "scheme": about.get("scheme"),
        "status": run.status,
        "message": about.get("message") or "",
        "anti_friction": dict(about.get("anti_friction") or {}),
        "steps": totals.get("steps", len(run)),
        "save_every": about.get("save_every", 1),
        "t": {"start": float(run.t[0]), "end": float(run.t[-1]), "unit": units.get("t", "")},
        "step": {"min": float(steps[computed].min()), "max": float(steps[computed].max())} if computed.size else None,
        "error_control": {key: totals[key] for key in ERROR_CONTROL_KEYS} if totals.keys() >= {*ERROR_CONTROL_KEYS} else None,
        "event_driven": {key: totals[key] for key in EVENT_DRIVEN_KEYS} if totals.keys() >= {*EVENT_DRIVEN_KEYS} else None,
        "stretches": list(totals.get("stretches", [])),
        "certificate": about.get("certificate"),
        "monotone": about.get("monotone"),
        "halving": _largest_halving(run, units),
        "residual": _worst_residual(run, totals, computed),
        "index_set_changes": _index_set_changes(run, totals, computed),
        "solver_counts": dict(about.get("solver_counts") or {}),
        "newton": _newton_iterations(run, totals, computed),
        **_smallest_gap(run),
        "bodies": _bodies_summary(run, totals),
        "by_contact": _contacts_summary(run),
        "largest_error": totals.get("largest_error"),
        "energy": {"start": float(energy[0]), "end": float(energy[-1])} if energy.size else None,
        "convergence": about.get("convergence"),
        "final_state": []
        if "contact_row" in arrays
        else [
            {"name": name, "value": float(value), "unit": units.get(name, "")}
            for name, value in zip(state_names(run), run.x[-1], strict=True)
        ],
        "warnings": list(about.get("warnings") or []),
    }


def _largest_halving(run: RunData, units: dict[str, str]) -> list[dict[str, Any]] | None:
    """Of each state, the largest first: how far the run with halved steps is from this one at most, and when."""
    if "halving" not in run.arrays:
        return None
    off = np.nan_to_num(np.abs(run.arrays["halving"]), nan=-1.0)
    rows, names = off.argmax(axis=0), state_names(run)
    found = [
        {"name": name, "largest": float(off[row, i]), "t": float(run.t[row]), "unit": units.get(name, "")}
        for i, (name, row) in enumerate(zip(names, rows, strict=True))
        if off[row, i] >= 0
    ]
    return sorted(found, key=lambda one: -one["largest"])


def _worst_residual(run: RunData, totals: dict[str, Any], computed: np.ndarray) -> dict[str, Any] | None:
    """The largest residual, its time and saved row; None where no step was computed."""
    if not computed.size or "residual" not in run.arrays:
        return None
    if "worst_residual" in totals:
        worst, t = totals["worst_residual"], totals.get("worst_residual_t")
        rows = np.flatnonzero(run.t == t) if t is not None else []
        return {"worst": worst, "t": t, "row": int(rows[0]) if len(rows) else None}
    # A residual that is not a number is as unknown as an infinite one.
    residual = np.nan_to_num(run.residual[computed], nan=np.inf, posinf=np.inf)
    row = int(computed[np.argmax(residual)])
    return {"worst": float(residual.max()), "t": float(run.t[row]), "row": row}


def _index_set_changes(run: RunData, totals: dict[str, Any], computed: np.ndarray) -> int | None:
    codes = run.arrays.get("index_set", np.zeros((0, 0)))
    if "contact_row" in run.arrays:
        return totals.get("index_set_changes")
    if not codes.size or not computed.size:
        return None
    codes = codes[computed]
    return totals.get("index_set_changes", int((codes[1:] != codes[:-1]).any(axis=1).sum()))


def _newton_iterations(run: RunData, totals: dict[str, Any], computed: np.ndarray) -> dict[str, Any] | None:
    if "newton" not in run.arrays or not computed.size:
        return None
    counts = sum((run.metadata.get("solver_counts") or {}).values())
    if "newton" in totals and counts:
        return {"mean": totals["newton"] / counts, "max": int(totals["newton_max"])}
    newton = run.arrays["newton"][computed]
    return {"mean": float(newton.mean()), "max": int(newton.max())}


def _smallest_gap(run: RunData) -> dict[str, Any]:
    """The smallest gap of the saved rows, the constraint and the time, where the class has gaps."""
    gap = run.arrays.get("gap", run.arrays.get("y", np.zeros((0, 0))))
    if not model_type(run).gaps or not np.isfinite(gap).any():
        return {"gap_min": None, "gap_min_name": None, "gap_min_t": None}
    row, column = np.unravel_index(np.nanargmin(gap), gap.shape)
    names = multiplier_names(run)
    name = names[column] if len(names) == gap.shape[1] else str(column)
    return {"gap_min": float(gap[row, column]), "gap_min_name": name, "gap_min_t": float(run.t[row])}


def _bodies_summary(run: RunData, totals: dict[str, Any]) -> dict[str, Any] | None:
    """Many bodies in short: who is there, what touches at the end, the least gap and the largest pressure of all steps."""
    if "contact_row" not in run.arrays or "bodies" not in run.metadata:
        return None
    keys = ("least_gap", "least_gap_t", "largest_pressure", "largest_pressure_t", "largest_pressure_body", "most_contacts")
    touching = run.contacts(-1)
    pressed = int(np.count_nonzero(np.nan_to_num(run.arrays["pressure"][-1]) > 0))
    found = {"contacts": len(touching.first), "in_contact": pressed, **{key: totals.get(key) for key in keys}}
    return {**run.metadata["bodies"], **found}


def _contacts_summary(run: RunData) -> list[dict[str, Any]]:
    """Of each contact of a mechanical system, in the saved rows: in how many steps it acts, how deep it is, the steps missed."""
    names = run.metadata.get("axes", {}).get("contact", [])
    if not names or not run.arrays.keys() >= {"acting", "missed", "penetration"}:
        return []
    acts, missed, penetration = (run.arrays[name].reshape(len(run.t), -1) for name in ("acting", "missed", "penetration"))
    columns = zip(names, np.nansum(acts, axis=0), np.nanmax(penetration, axis=0), np.nansum(missed, axis=0), strict=True)
    return [{"name": name, "acting": int(a), "penetration": float(deep), "missed": int(m)} for name, a, deep, m in columns]


def summary_lines(summary: dict[str, Any]) -> dict[str, list[str]]:
    """What `summary` returned in words: {label: lines}."""
    s, t, changes = summary, summary["t"], summary["index_set_changes"]
    unit = f" {t['unit']}" if t["unit"] else ""
    counts = sorted(s["solver_counts"].items(), key=lambda item: (-item[1], item[0]))
    # Adding 0 turns -0 into 0.
    final_states = [(one["name"], f"{one['value'] + 0.0: .6g} {one['unit']}") for one in s["final_state"]]
    if len(final_states) > _MAX_STATES:
        final_states = [
            *final_states[: _MAX_STATES - 2],
            (f"... {len(final_states) - _MAX_STATES + 1} more", ""),
            final_states[-1],
        ]
    sample = "" if s["save_every"] == 1 else f" (1 row saved of {s['save_every']})"
    found: dict[str, str | list[str] | None] = {
        "model class": s["model_class"],
        "scheme": s["scheme"] and str(s["scheme"]),
        "status": s["message"] if s["message"].startswith(s["status"]) else ": ".join(filter(None, (s["status"], s["message"]))),
        "anti-friction": s.get("anti_friction") and impacts.anti_friction_text(s["anti_friction"]) + ANTI_FRICTION_MEANING,
        "steps": f"{s['steps']}{sample}, t = {t['start']:.6g} to {t['end']:.6g}{unit}",
        "step size": s["step"] and _step_range_text(s["step"]["min"], s["step"]["max"], unit),
        "error control": s["error_control"] and _error_control_text(**s["error_control"]),
        "event-driven": s["event_driven"] and _event_driven_text(**s["event_driven"], unit=unit),
        "accuracy": NO_ERROR_KNOWN if s.get("monotone") is False and s.get("halving") is None else None,
        "halved steps": s.get("halving") and _halving_lines(s["halving"], unit),
        "time steps": s.get("stretches") and _fallback_text(s["stretches"], unit),
        "certificate": s["certificate"] and _proof_lines(s["certificate"], unit),
        "worst residual": s["residual"] and f"{s['residual']['worst']:.3g}{_format_time(s['residual']['t'], unit)}",
        "contacts" if s["bodies"] else "index set": (
            None if changes is None else f"changed at {changes} step{'' if changes == 1 else 's'}"
        ),
        "solver calls": _align_pairs([(name, f"{int(count):>8d}") for name, count in counts]),
        "newton": s["newton"] and _newton_text(s["newton"]["mean"], s["newton"]["max"]),
        "smallest gap": (
            None if s["gap_min"] is None else f"{s['gap_min']:.6g} of '{s['gap_min_name']}'{_format_time(s['gap_min_t'], unit)}"
        ),
        **_bodies_lines(s["bodies"], unit),
        "by contact": _contact_lines(s.get("by_contact", []), sample),
        "largest error": None if s["largest_error"] is None else f"{s['largest_error']:.3g} from the exact state",
        "energy": s["energy"] and f"{s['energy']['start']:.6g} at the start, {s['energy']['end']:.6g} at the end",
        "convergence": s["convergence"] and _convergence_lines(s["convergence"], unit),
        "final state": _align_pairs(final_states),
        "warnings": s["warnings"],
    }
    return {label: [entries] if isinstance(entries, str) else entries for label, entries in found.items() if entries}


def summary_text(summary: dict[str, Any]) -> str:
    """What `summary` returned as a table of at most 100 columns."""
    table = textwrap.wrap(summary["title"], TEXT_WIDTH)
    for label, texts in summary_lines(summary).items():
        for i, line in enumerate(texts):
            first, rest = f"  {label if i == 0 else '':{_LABEL_WIDTH - 2}}", " " * (_LABEL_WIDTH + 2)
            table += textwrap.wrap(line, TEXT_WIDTH, initial_indent=first, subsequent_indent=rest)
    return "\n".join(table)


def _bodies_lines(bodies: dict[str, Any] | None, unit: str) -> dict[str, str | list[str]]:
    """Many bodies as lines of the table."""
    if not bodies:
        return {}
    b, gap = bodies, bodies["least_gap"]
    lines: dict[str, str | list[str]] = {
        "bodies": f"{b['count']}: {b['there']} there at the end, {b['left']} left"
        + (f", {b['waiting']} waiting" if b["waiting"] else ""),
        "in contact": f"{b['in_contact']} bodies, {b['contacts']} contacts at the end; at most {b['most_contacts']} contacts",
    }
    if b.get("empty_at") is not None:
        lines["end"] = f"empty at t = {b['empty_at']:.6g}{unit}"
    if b.get("standstill"):
        lines["standstill"] = _standstill_lines(b["standstill"], unit)
    if gap is not None and np.isfinite(gap):
        lines["least gap"] = f"{gap:.6g}{_format_time(b['least_gap_t'], unit)}"
    if b["largest_pressure_t"] is not None:
        at = _format_time(b["largest_pressure_t"], unit)
        lines["pressure"] = f"at most {b['largest_pressure']:.6g}, on body {b['largest_pressure_body']}{at}"
    return lines


def _contact_lines(found: list[dict[str, Any]], sample: str) -> list[str]:
    """The contacts with the deepest penetration first, where there are many."""
    first = sorted(found, key=lambda one: (-one["missed"], -one["penetration"])) if len(found) > _MAX_CONTACTS else found
    rest = [f"... {len(found) - _MAX_CONTACTS} more, no deeper"] if len(found) > _MAX_CONTACTS else []
    of = " of the rows saved" if sample else ""
    texts = []
    for one in first[:_MAX_CONTACTS]:
        acts = f"acts in {one['acting']} step{'' if one['acting'] == 1 else 's'}{of}"
        texts.append((one["name"], f"{acts}, missed in {one['missed']}, penetration at most {one['penetration']:.2g}"))
    return [*_align_pairs(texts), *rest]


def _standstill_lines(found: dict[str, Any], unit: str) -> list[str]:
    """Since when nobody has moved, whether for good, and who holds whom."""
    end = STANDSTILL_REASONS.get(found["for_good"], "nobody has moved by more than rounding since")
    lines = [f"from t = {found['since']:.6g}{unit} on, {found['bodies']} bodies: {end}"]
    for arch in found["arches"]:
        places = [f"{body} at ({', '.join(f'{v:.4g}' for v in at)})" for body, at in zip(arch["bodies"], arch["at"], strict=True)]
        more = [f"{len(places) - _MAX_ARCH_BODIES} more"] if len(places) > _MAX_ARCH_BODIES else []
        where = "" if arch["exit"] is None else f"before exit '{arch['exit']}' "
        ends = " and ".join(f"'{name}'" for name in arch["ends"])
        lines.append(
            f"{where}{arch['pressed']} bodies stand behind {', '.join(places[:_MAX_ARCH_BODIES] + more)}; ends: {ends or 'none'}"
        )
    return lines


def _error_control_text(
    rtol: float | None, accepted: int, rejected: int, extrapolated: int, at_least_step: int, least_step: float,
    estimate: float | None,
) -> str:  # fmt: skip
    head = f"rtol {rtol or 0:g}: {accepted} steps accepted, {extrapolated} of them extrapolated, {rejected} refused"
    errors = "" if estimate is None else f"; errors estimated, in all {estimate:.2g} of what is allowed"
    tail = f"; {at_least_step} at the least step, whatever their error" if at_least_step else ""
    return head + errors + tail


def _event_driven_text(
    rtol: float, order: int, pieces: int, collocated: int, events: int, worst_estimate: float, worst_estimate_t: float | None,
    unit: str,
) -> str:  # fmt: skip
    switches = f"{events} event{'' if events == 1 else 's'}"
    stiff = f", {collocated} of them by collocation" if collocated else ""
    return (
        f"rtol {rtol:g}: {pieces} pieces of order {order}{stiff}, {switches}; local error estimated, at most "
        f"{worst_estimate:.2g} of rtol"
        f"{_format_time(worst_estimate_t, unit)}"
    )


def _halving_lines(found: list[dict[str, Any]], unit: str) -> list[str]:
    """The states that differ most between this run and the one with halved steps."""
    first = found if len(found) <= _MAX_STATES else found[: _MAX_STATES - 1]
    texts = [(one["name"], f"{one['largest']:.3g} {one['unit']}".rstrip() + _format_time(one["t"], unit)) for one in first]
    rest = [f"... {len(found) - len(first)} more, no larger"] if len(first) < len(found) else []
    return [HALVING_HEAD, *_align_pairs(texts), *rest]


def _fallback_text(intervals: list[dict[str, Any]], unit: str) -> str:
    """Where steps went on in place of pieces, and what they err by."""
    steps, error = (sum_in_order(one[key] for one in intervals) for key in ("steps", "estimate"))
    spans = ", ".join(f"{one['start']:.6g} to {one['until']:.6g}" for one in intervals[:_MAX_SPANS])
    more = f" and {len(intervals) - _MAX_SPANS} more" if len(intervals) > _MAX_SPANS else ""
    return f"{steps} where no piece went on, t = {spans}{unit}{more}; errors estimated, in all {error:.2g} of rtol"


def _proof_lines(about: dict[str, Any], unit: str) -> list[str]:
    """What interval arithmetic proves of the pieces, and what it does not."""
    verdict = "proved" if about["proved"] == about["pieces"] else "not proved"
    first = (
        f"{verdict} by intervals, {about['proved']} of {about['pieces']} pieces: defects add up to at most {about['share']:.2g} "
        f"of rtol on each, rows to {about['row_defect']:.2g}, signs to {about['depth']:.2g} of their size, and kept from "
        f"{about['reach']:.2g}{unit} off the ends of pieces"
    )
    more = about["not_proved"] - len(about["failures"])
    bound, why = about["error"], f"no bound of the global error: {about['no_error_bound']}"
    if bound is not None:
        near = f"every state is within {bound['bound']:.2g} of the solution until t = {bound['until']:.6g}{unit}"
        why = f"{near}, worst '{bound['state']}' (omega = {bound['omega']:.3g} in |.|_P)"
    return [first, why, *(f"not proved: {one}" for one in about["failures"]), *([f"and {more} more"] if more else [])]


def _format_time(t: float | None, unit: str) -> str:
    return "" if t is None else f" at t = {t:.6g}{unit}"


def _newton_text(mean: float, most: int) -> str:
    if mean == most:
        return f"{most} iteration{'s' if most > 1 else ''} at every step"
    return f"{mean:.3g} iterations a step, at most {most}"


def _align_pairs(pairs: Sequence[tuple[str, str]]) -> list[str]:
    width = min(max((len(name) for name, _ in pairs), default=0), 40)
    return [f"{name:{width}}  {value}".rstrip() for name, value in pairs]


def _step_range_text(low: float, high: float, unit: str) -> str:
    same = high - low <= 1e-9 * abs(high)
    return f"{high:.6g}{unit}" if same else f"{low:.6g} to {high:.6g}{unit}"


def _convergence_lines(found: dict[str, Any], unit: str) -> list[str]:
    head = "not shown to be finite"
    if found.get("finite"):
        head = f"in finite time: at rest from t = {found['t_0']:.6g}{unit} on, step {found['n_0']}"
    labels = {"theta_prime_0": "theta'(0)", "distance": "d(0, dg(x))", "margin": "margin"}
    numbers = ", ".join(f"{label} = {found[key]:.6g}" for key, label in labels.items() if found.get(key) is not None)
    return [line for line in (head, found.get("reason"), numbers) if line]
