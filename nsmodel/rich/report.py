"""A report: its verdict, findings and what follows as tables; what is not short is folded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from nsmodel.brief import cut
from nsmodel.hypotheses.report import table
from nsmodel.hypotheses.report.typeset import equations
from nsmodel.proof.verdict import HOLDS, VERDICTS
from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.hypotheses.findings import Consequence, Finding
    from nsmodel.hypotheses.report.report import Report

ROWS = 14  # More are folded.
FIRST = {verdict: k for k, verdict in enumerate(("violated", "unknown", "sampled", "holds"))}
SHORT = 90  # Characters of what stands unfolded.


def html(report: Report) -> str:
    """The report as HTML; violated findings come first."""
    findings = sorted(report.findings, key=lambda finding: FIRST.get(finding.verdict, 0))
    shown = [_finding(finding) for finding in findings]
    rows = [
        ("findings", page.counted({word: len(report.having(word)) for word in VERDICTS}, {HOLDS: "proved"})),
        ("paper", report.paper),
        ("region", report.region),
        ("parameters", ", ".join(table.parameters(report))),
        ("inputs", list(report.inputs)),
        ("notes", list(report.notes)),
    ]
    parts = [page.facts(rows)]
    parts.append(page.first(shown, ROWS, "findings", ("id", "verdict", "hypothesis", "numbers", "where and how")))
    if report.consequences:
        parts.append(page.element("p", page.element("b", "What follows")))
        header = ("", "verdict", "statement", "numbers", "where; rests on")
        parts.append(page.first([_consequence(one, report) for one in report.consequences], ROWS, "consequences", header))
    parts.append(page.folded("the model", *map(page.formula, equations(report.model))))
    return page.page(report.title, f"report on a {report.model_class}", *parts)


def _finding(finding: Finding) -> list[str]:
    at = [f"at {text}" for text in table.witness(finding)] if finding.verdict != "holds" else []
    outside = [f"outside it fails at {', '.join(table.pairs(finding.outside))}"] if finding.outside else []
    how = _short("; ".join([table.told(finding), *at, *outside]), finding.source)
    return [finding.id, page.status(finding.verdict), page.escaped(finding.statement, 400), _numbers(finding.value), how]


def _consequence(one: Consequence, report: Report) -> list[str]:
    told = "; ".join(part for part in (table.conditions(one), table.rests(one, report)) if part)
    return [one.name, page.status(one.verdict), page.escaped(one.statement, 400), _numbers(one.value), _short(told, one.source)]


def _numbers(value: Mapping[str, float]) -> page.Html:
    return page.joined(table.pairs(value), "<br>")


def _short(text: str, source: str) -> page.Html:
    """What is long folds behind its beginning."""
    source = f" [{source}]" if source else ""
    if len(text) + len(source) <= SHORT:
        return page.escaped(text + source)
    return page.folded(cut(text, SHORT), page.escaped(text + source, 2000))
