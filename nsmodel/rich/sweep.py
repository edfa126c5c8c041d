"""A sweep: what was varied, what came of the cells, why some failed, the picture of one quantity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nsmodel._utils import describe_shortly, join_within_width
from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.sweep.result import Sweep

UNFOLDED_FAILURES = 5  # More are folded, and of very many not all are there.
MAX_FAILURES = 40
SWEEP_DPI = 75


def html(sweep: Sweep) -> str:
    """The sweep as HTML."""
    found = sweep.summary()
    along = [f"{dim}: {_dim_values_text(sweep, dim)}" for dim in sweep.dims]
    worst = found["worst_residual"]
    rows = [
        ("cells", page.join_html([f"{found['cells']}:", page.verdict_counts(found["status"])], " ")),
        ("along", along),
        ("kept", join_within_width(found["keep"]) + f", {found['rows']} rows" if found["keep"] else ""),
        ("outputs", [f"{name}: {text}" for name, text in found["outputs"].items()]),
        ("steps", f"{found['steps']:,} in all" if found["pieces"] is None else f"{found['pieces']:,} pieces in all"),
        ("worst residual", "" if worst is None or found["pieces"] is not None else f"{worst:.2e}"),
        ("way", found["plan"]),
    ]
    parts: list[str] = [page.facts_table(rows)]
    if failures := found["failures"]:
        failure_rows = [[str(one["cell"]), _location_text(one["at"]), one["message"]] for one in failures[:MAX_FAILURES]]
        parts.append(
            page.first_rows_table(failure_rows, UNFOLDED_FAILURES, "of those that are not done", ("cell", "where", "why"))
        )
        if len(failures) > MAX_FAILURES:
            parts.append(page.aside_paragraph(f"and {len(failures) - MAX_FAILURES} more: sweep.failures has them all"))
    if (name := _drawn_quantity(sweep)) is not None:
        parts.append(page.picture(lambda: _png(sweep, name), f"{name} of {sweep.title}"))
    return page.result_page(sweep.title, f"sweep of a {found['model_class']}", *parts)


def _png(sweep: Sweep, name: str) -> bytes:
    from nsmodel.plot.shown import light_png

    return light_png(sweep.plot(name), SWEEP_DPI)


def _drawn_quantity(sweep: Sweep) -> str | None:
    """The quantity that is shown: the first output, or else the first that is kept."""
    named = (*sweep.metadata.get("outputs", {}), *sweep.metadata.get("keep", ()))
    return next((name for name in named if name in sweep.cells), None) if sweep.dims else None


def _dim_values_text(sweep: Sweep, dim: str) -> str:
    """How many values, and from where to where."""
    values = sweep.coords[dim]
    ends = (
        [describe_shortly(values[k].item() if hasattr(values[k], "item") else values[k]) for k in (0, -1)] if len(values) else []
    )
    return f"{len(values)}, {' to '.join(ends)}" if len(values) > 1 else ", ".join(ends[:1])


def _location_text(at: dict[str, Any]) -> str:
    return ", ".join(f"{name} = {describe_shortly(value)}" for name, value in at.items())
