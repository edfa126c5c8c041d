"""A report as a page: each finding with its verdict, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsmodel.hypotheses.report import table
from nsmodel.view.page import page, written
from nsmodel.words import shown

if TYPE_CHECKING:
    from nsmodel.hypotheses.report.report import Report

SCRIPTS = ("elements", "report")


def view_report(report: Report, path: str | Path | None = None) -> Path:
    """Write the page of a report, and return its path; see `Report.view`."""
    return written(page(report.title, document(report), SCRIPTS), path, report.title)


def document(report: Report) -> dict[str, Any]:
    """All that the page shows of a report, as plain data."""
    facts = {
        "model": [f"{report.model_class}; {report.paper}"],
        "region": [report.region],
        "parameters": table.parameters(report),
        "inputs": report.inputs,
        "findings": [report.verdict],
    }
    findings = [
        _card(finding.id, finding, [_numbers(finding), *_witness(finding), table.told(finding)]) for finding in report.findings
    ]
    consequences = [
        _card(one.name, one, [_numbers(one), table.conditions(one), table.rests(one, report)]) for one in report.consequences
    ]
    return {
        "kind": "report",
        "title": shown(report.title),
        "facts": [[label, [shown(line) for line in lines]] for label, lines in facts.items() if lines],
        "findings": findings,
        "consequences": consequences,
        "notes": [shown(note) for note in report.notes],
    }


def _card(name: str, found: Any, lines: Sequence[str]) -> dict[str, Any]:
    words = {"name": shown(name), "verdict": found.verdict, "statement": shown(found.statement), "source": shown(found.source)}
    return words | {"lines": [shown(line) for line in lines if line]}


def _numbers(found: Any) -> str:
    return ", ".join(table.pairs(found.value))


def _witness(finding: Any) -> list[str]:
    told = table.witness(finding)
    lines = [f"{'with' if finding.verdict == 'holds' else 'at'} {', '.join(told)}"] if told else []
    return lines + ([f"outside it fails at {', '.join(table.pairs(finding.outside))}"] if finding.outside else [])
