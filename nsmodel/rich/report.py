"""A report: its verdict, findings and what follows as tables; what is not short is folded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from nsmodel._utils import truncate_text
from nsmodel.hypotheses import report as table
from nsmodel.hypotheses.equations import model_equations
from nsmodel.proof.verdict import HOLDS, VERDICTS
from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.hypotheses.findings import Consequence, Finding
    from nsmodel.hypotheses.report import Report

REPORT_ROWS = 14  # More are folded.
VERDICT_ORDER = {verdict: k for k, verdict in enumerate(("violated", "unknown", "sampled", "holds"))}
MAX_UNFOLDED_TEXT = 90  # Characters of what stands unfolded.


def html(report: Report) -> str:
    """The report as HTML; violated findings come first."""
    findings = sorted(report.findings, key=lambda finding: VERDICT_ORDER.get(finding.verdict, 0))
    finding_rows = [_finding_cells(finding) for finding in findings]
    rows = [
        ("findings", page.verdict_counts({word: len(report.having(word)) for word in VERDICTS}, {HOLDS: "proved"})),
        ("paper", report.paper),
        ("region", report.region),
        ("parameters", ", ".join(table.parameter_texts(report))),
        ("inputs", list(report.inputs)),
        ("notes", list(report.notes)),
    ]
    parts = [page.facts_table(rows)]
    parts.append(
        page.first_rows_table(finding_rows, REPORT_ROWS, "findings", ("id", "verdict", "hypothesis", "numbers", "where and how"))
    )
    if report.consequences:
        parts.append(page.element("p", page.element("b", "What follows")))
        header = ("", "verdict", "statement", "numbers", "where; rests on")
        parts.append(
            page.first_rows_table(
                [_consequence_cells(one, report) for one in report.consequences], REPORT_ROWS, "consequences", header
            )
        )
    parts.append(page.folded_section("the model", *map(page.formula, model_equations(report.model))))
    return page.result_page(report.title, f"report on a {report.model_class}", *parts)


def _finding_cells(finding: Finding) -> list[str]:
    at = [f"at {text}" for text in table.witness_texts(finding)] if finding.verdict != "holds" else []
    outside = [f"outside it fails at {', '.join(table.name_value_pairs(finding.outside))}"] if finding.outside else []
    how = _foldable_text("; ".join([table.decision_text(finding), *at, *outside]), finding.source)
    return [
        finding.id,
        page.status_badge(finding.verdict),
        page.escape_text(finding.statement, 400),
        _value_cell(finding.value),
        how,
    ]


def _consequence_cells(one: Consequence, report: Report) -> list[str]:
    grounds = "; ".join(part for part in (table.validity_text(one), table.premises_text(one, report)) if part)
    return [
        one.name,
        page.status_badge(one.verdict),
        page.escape_text(one.statement, 400),
        _value_cell(one.value),
        _foldable_text(grounds, one.source),
    ]


def _value_cell(value: Mapping[str, float]) -> page.Html:
    return page.join_html(table.name_value_pairs(value), "<br>")


def _foldable_text(text: str, source: str) -> page.Html:
    """What is long folds behind its beginning."""
    source = f" [{source}]" if source else ""
    if len(text) + len(source) <= MAX_UNFOLDED_TEXT:
        return page.escape_text(text + source)
    return page.folded_section(truncate_text(text, MAX_UNFOLDED_TEXT), page.escape_text(text + source, 2000))
