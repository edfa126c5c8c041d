"""A report as a page: each finding with its verdict, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsmodel.hypotheses.report import (
    Report,
    decision_text,
    name_value_pairs,
    parameter_texts,
    premises_text,
    validity_text,
    witness_texts,
)
from nsmodel.plot.html.page import standalone_page, write_page

REPORT_SCRIPTS = ("elements", "report")


def write_report_page(report: Report, path: str | Path | None = None) -> Path:
    """Write the page of a report, and return its path; see `Report.view`."""
    return write_page(standalone_page(report.title, report_document(report), REPORT_SCRIPTS), path, report.title)


def report_document(report: Report) -> dict[str, Any]:
    """All that the page shows of a report, as plain data."""
    facts = {
        "model": [f"{report.model_class}; {report.paper}"],
        "region": [report.region],
        "parameters": parameter_texts(report),
        "inputs": report.inputs,
        "findings": [report.verdict],
    }
    findings = [
        _finding_card(finding.id, finding, [_value_text(finding), *_witness_lines(finding), decision_text(finding)])
        for finding in report.findings
    ]
    consequences = [
        _finding_card(one.name, one, [_value_text(one), validity_text(one), premises_text(one, report)])
        for one in report.consequences
    ]
    return {
        "kind": "report",
        "title": report.title,
        "facts": [[label, list(lines)] for label, lines in facts.items() if lines],
        "findings": findings,
        "consequences": consequences,
        "notes": list(report.notes),
    }


def _finding_card(name: str, found: Any, lines: Sequence[str]) -> dict[str, Any]:
    return {
        "name": name,
        "verdict": found.verdict,
        "statement": found.statement,
        "source": found.source,
        "lines": [line for line in lines if line],
    }


def _value_text(found: Any) -> str:
    return ", ".join(name_value_pairs(found.value))


def _witness_lines(finding: Any) -> list[str]:
    entries = witness_texts(finding)
    lines = [f"{'with' if finding.verdict == 'holds' else 'at'} {', '.join(entries)}"] if entries else []
    return lines + ([f"outside it fails at {', '.join(name_value_pairs(finding.outside))}"] if finding.outside else [])
