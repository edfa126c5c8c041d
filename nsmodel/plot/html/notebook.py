"""Results as HTML for notebooks, a function for each kind: no script, and text is escaped in `elements`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel._utils import describe_shortly, join_within_width, truncate_text
from nsmodel.hypotheses.equations import model_equations
from nsmodel.hypotheses.report import (
    Report,
    decision_text,
    name_value_pairs,
    parameter_texts,
    premises_text,
    validity_text,
    witness_texts,
)
from nsmodel.modeling.description import model_facts
from nsmodel.plot.html import elements
from nsmodel.proof.verdict import HOLDS, VERDICTS
from nsmodel.simulation import summary

if TYPE_CHECKING:
    from nsmodel.derivatives.result import Sensitivity
    from nsmodel.hypotheses.findings import Consequence, Finding
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.trajectory import Trajectory
    from nsmodel.study.lines import Line
    from nsmodel.study.result import Study
    from nsmodel.study.stress_result import Cell, Stress
    from nsmodel.sweep.result import Sweep
    from nsmodel.sweep.statistics import Share, Statistics

MAX_ROW_TEXT = 320  # Characters of a row; longer ones are cut: some three lines of a notebook.
MAX_FORMULA_LENGTH = 2500  # Characters of LaTeX in one formula; of a longer one it is said that it cannot be read.


def model_html(model: Model) -> str:
    """The model as HTML."""
    rows = []
    for label, entries in model_facts(model).items():
        count = f"{len(entries)}: " if len(entries) > 1 else ""
        rows.append(
            (label, elements.escape_text(count + join_within_width(map(truncate_text, entries), MAX_ROW_TEXT), MAX_ROW_TEXT + 20))
        )
    formulas = [
        elements.formula(line) if len(line) < MAX_FORMULA_LENGTH else elements.aside_paragraph("a formula too long to be read")
        for line in model_equations(model)
    ]
    return elements.result_page(model.title or "untitled", type(model).__name__, *formulas, elements.facts_table(rows))


REPORT_ROWS = 14  # More are folded: the hypotheses of each class are fewer, but for those of runs.
VERDICT_ORDER = {verdict: k for k, verdict in enumerate(("violated", "unknown", "sampled", "holds"))}
MAX_UNFOLDED_TEXT = 90  # Characters of what stands unfolded: a line of the last column.


def report_html(report: Report) -> str:
    """The report as HTML; violated findings come first."""
    findings = sorted(report.findings, key=lambda finding: VERDICT_ORDER.get(finding.verdict, 0))
    finding_rows = [_claim_cells(one.id, one, decision_text(one), *_witness_notes(one)) for one in findings]
    rows = [
        ("findings", elements.verdict_counts({word: len(report.having(word)) for word in VERDICTS}, {HOLDS: "proved"})),
        ("paper", report.paper),
        ("region", report.region),
        ("parameters", ", ".join(parameter_texts(report))),
        ("inputs", list(report.inputs)),
        ("notes", list(report.notes)),
    ]
    parts = [elements.facts_table(rows)]
    parts.append(
        elements.first_rows_table(
            finding_rows, REPORT_ROWS, "findings", ("id", "verdict", "hypothesis", "numbers", "where and how")
        )
    )
    if report.consequences:
        parts.append(elements.element("p", elements.element("b", "What follows")))
        header = ("", "verdict", "statement", "numbers", "where; rests on")
        parts.append(
            elements.first_rows_table(
                [_claim_cells(one.name, one, validity_text(one), premises_text(one, report)) for one in report.consequences],
                REPORT_ROWS,
                "consequences",
                header,
            )
        )
    parts.append(elements.folded_section("the model", *map(elements.formula, model_equations(report.model))))
    return elements.result_page(report.title, f"report on a {report.model_class}", *parts)


def _witness_notes(finding: Finding) -> list[str]:
    """Where it fails."""
    at = [f"at {text}" for text in witness_texts(finding)] if finding.verdict != "holds" else []
    return at + ([f"outside it fails at {', '.join(name_value_pairs(finding.outside))}"] if finding.outside else [])


def _claim_cells(name: str, one: Finding | Consequence, *how: str) -> list[str]:
    return [
        name,
        elements.status_badge(one.verdict),
        elements.escape_text(one.statement, 400),
        elements.join_html(name_value_pairs(one.value), "<br>"),
        _foldable_text("; ".join(part for part in how if part), one.source),
    ]


def _foldable_text(text: str, source: str) -> elements.Html:
    """What is long folds behind its beginning."""
    source = f" [{source}]" if source else ""
    if len(text) + len(source) <= MAX_UNFOLDED_TEXT:
        return elements.escape_text(text + source)
    return elements.folded_section(truncate_text(text, MAX_UNFOLDED_TEXT), elements.escape_text(text + source, 2000))


RUN_DPI = 90  # Dots per inch of the small picture of a run: its letters can just be read.
RESULT_DPI = 75  # Of that of a study or a sweep, which is larger.
RUN_WARNINGS = 4  # More are folded, so that the picture below stays in sight.


def run_html(run: Trajectory) -> str:
    """The run as HTML."""
    from nsmodel.plot.figures import thumbnail

    lines = summary.summary_lines(run.summary())
    (ended,), warnings = lines.pop("status", [run.status]), lines.pop("warnings", [])
    word, _, why = ended.partition(": ") if ended.startswith(run.status) else (run.status, "", ended)
    warned = f"{len(warnings)} warning{'s' if len(warnings) > 1 else ''}" if warnings else ""
    status_cell = elements.join_html(
        [elements.status_badge(word, "warned" if word == "done" and warnings else word), why or warned], " "
    )
    rows = [("status", status_cell), *lines.items(), ("warnings", warnings[:RUN_WARNINGS])]
    more = elements.folded_section(
        f"{len(warnings) - RUN_WARNINGS} more warnings", elements.facts_table([("", warnings[RUN_WARNINGS:])])
    )
    drawn = elements.picture(lambda: thumbnail(run), RUN_DPI, f"states of {run.title} over time")
    return elements.result_page(
        run.title, f"run, {len(run)} steps", elements.facts_table(rows), more if warnings[RUN_WARNINGS:] else "", drawn
    )


def statistics_html(found: Statistics | Share) -> str:
    """The table as HTML."""
    head, _, rest = found.text.partition("\n")
    return elements.result_page(head, type(found).__name__.lower(), elements.verbatim_text(rest))


STRESS_ROWS = 24  # More are folded: about a screen.


def stress_html(stress: Stress) -> str:
    """The result as HTML."""
    from nsmodel.study.stress_result import STOPPED, WRONG

    counts = elements.verdict_counts({verdict: stress.count(verdict) for verdict in stress.verdicts})
    unit = f" {stress.time_unit}" if stress.time_unit else ""
    badges = {(cell.row, cell.factor): elements.status_badge(cell.verdict) for cell in stress.cells}
    rows = [[row, *(badges.get((row, factor), "") for factor in stress.factors)] for row in stress.rows]
    header = ["", *(f"{factor:g}" for factor in stress.factors)]
    facts = elements.facts_table([("cells", counts), ("columns", f"step, in units of {stress.step:g}{unit}")])
    parts = [facts, elements.first_rows_table(rows, STRESS_ROWS, "rows", header)]
    for word, what in ((WRONG, "misfit"), (STOPPED, "why")):
        cells = [cell for cell in stress.cells if cell.verdict == word]
        if cells:
            cell_table = elements.html_table(("where", what), [_cell_row(cell) for cell in cells])
            parts.append(elements.folded_section(f"{len(cells)} {word}", cell_table) if word == STOPPED else cell_table)
    return elements.result_page(stress.title, f"stress of a {stress.model_class}", *parts)


def _cell_row(cell: Cell) -> list[str]:
    from nsmodel.study.stress_result import WRONG

    name, ratio = cell.worst
    what = f"{name}: {ratio:.3g} times what is allowed" if cell.verdict == WRONG else cell.message
    return [f"{cell.row}, step x {cell.factor:g}", what]


STUDY_HEADER = ("method", "points done", "order", "largest errors", "seconds")
STUDY_ROWS = 12  # More are folded: schemes and ways of running them are seldom more.


def sensitivity_html(found: Sensitivity) -> str:
    """Derivatives at the last time, and of the times of switches, as HTML."""
    rows = [
        [name, f"{value:.8g}", *(f"{v:.8g}" for v in own)]
        for name, value, own in zip(found.outputs, found.value[-1].tolist(), found.jacobian[-1].tolist(), strict=True)
    ]
    moved = [[one.name, f"{one.t:.8g}", *(f"{v:.6g}" for v in one.dt.tolist())] for one in found.switches]
    facts = [("t", f"{found.t[-1]:.8g}"), ("method", found.method), ("warnings", list(found.warnings))]
    parts = [elements.facts_table(facts), elements.html_table(["", "value", *(f"by {name}" for name in found.by)], rows)]
    if moved:
        header = ["switch", "t", *(f"dt/d {name}" for name in found.by)]
        parts.append(elements.folded_section(f"{len(moved)} switches", elements.html_table(header, moved)))
    return elements.result_page(found.run.title, "derivatives of a run", *parts)


def study_html(study: Study) -> str:
    """The study as HTML."""
    from nsmodel.study.lines import SOLVER_LINE
    from nsmodel.study.result import cost_text

    reference = None if study.reference is None else study.reference.text
    rows = [
        ("status", elements.status_badge(study.status)),
        ("reference", reference or ""),
        ("target", cost_text(study, study.target) if study.target is not None else ""),
        ("notes", list(study.notes)),
    ]
    lines = [_method_row(line) for line in study.lines if line.kind != SOLVER_LINE]
    alone = [_method_row(line) for line in study.lines if line.kind == SOLVER_LINE]
    parts = [elements.facts_table(rows), elements.first_rows_table(lines, STUDY_ROWS, "methods", STUDY_HEADER)]
    if alone:
        parts.append(elements.folded_section(f"{len(alone)} solvers alone", elements.html_table(STUDY_HEADER, alone)))
    drawn = elements.picture(study.plot, RESULT_DPI, f"error against run time of {study.title}")
    return elements.result_page(study.title, f"study of a {study.model_class}", *parts, drawn)


def _method_row(line: Line) -> list[str]:
    """A method: how many points, its order, the largest and least error and what they cost."""
    from nsmodel.study.lines import POINT_DONE

    done = [point for point in line.points if point.status == POINT_DONE and point.error == point.error]
    gone = len(line.points) - sum(point.status == POINT_DONE for point in line.points)
    fit = line.order().fit if any(point.step for point in done) else None
    errors, seconds = [point.error for point in done], [point.seconds for point in done if point.seconds]
    counted = f"{len(line.points) - gone} of {len(line.points)}" if gone else f"{len(line.points)}"
    return [line.name, counted, "" if fit is None else f"{fit:.2f}", _range_text(errors), _range_text(seconds)]


def _range_text(values: list[float]) -> str:
    from nsmodel.study.result import short_number

    if not values:
        return ""
    low, high = short_number(min(values)), short_number(max(values))
    return low if low == high else f"{low} to {high}"


UNFOLDED_FAILURES = 5  # More are folded, and of very many not all are there: the first ones show what is wrong.
MAX_FAILURES = 40  # Failures in the page, which is kept small; of more, how many there are.


def sweep_html(sweep: Sweep) -> str:
    """The sweep as HTML."""
    found = sweep.summary()
    along = [f"{dim}: {_dim_values_text(sweep, dim)}" for dim in sweep.dims]
    worst = found["worst_residual"]
    rows = [
        ("cells", elements.join_html([f"{found['cells']}:", elements.verdict_counts(found["status"])], " ")),
        ("along", along),
        ("kept", join_within_width(found["keep"]) + f", {found['rows']} rows" if found["keep"] else ""),
        ("outputs", [f"{name}: {text}" for name, text in found["outputs"].items()]),
        ("steps", f"{found['steps']:,} in all" if found["pieces"] is None else f"{found['pieces']:,} pieces in all"),
        ("worst residual", "" if worst is None or found["pieces"] is not None else f"{worst:.2e}"),
        ("way", found["plan"]),
    ]
    parts: list[str] = [elements.facts_table(rows)]
    if failures := found["failures"]:
        failure_rows = []
        for one in failures[:MAX_FAILURES]:
            where = ", ".join(f"{name} = {describe_shortly(value)}" for name, value in one["at"].items())
            failure_rows.append([str(one["cell"]), where, one["message"]])
        parts.append(
            elements.first_rows_table(failure_rows, UNFOLDED_FAILURES, "of those that are not done", ("cell", "where", "why"))
        )
        if len(failures) > MAX_FAILURES:
            parts.append(elements.aside_paragraph(f"and {len(failures) - MAX_FAILURES} more: sweep.failures has them all"))
    known = (name for name in (*found["outputs"], *found["keep"]) if name in sweep.cells)
    if sweep.dims and (name := next(known, None)) is not None:  # The first output, or else the first that is kept.
        parts.append(elements.picture(lambda: sweep.plot(name), RESULT_DPI, f"{name} of {sweep.title}"))
    return elements.result_page(sweep.title, f"sweep of a {found['model_class']}", *parts)


def _dim_values_text(sweep: Sweep, dim: str) -> str:
    """How many values, and from where to where."""
    values = sweep.coords[dim]
    ends = (
        [describe_shortly(values[k].item() if hasattr(values[k], "item") else values[k]) for k in (0, -1)] if len(values) else []
    )
    return f"{len(values)}, {' to '.join(ends)}" if len(values) > 1 else ", ".join(ends[:1])
