"""A report as a page of GitHub-flavoured Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.report.table import (
    decision_text,
    name_value_pairs,
    parameter_texts,
    premises_text,
    validity_text,
    witness_texts,
)
from nsmodel.hypotheses.report.typeset import model_equations
from nsmodel.modeling.base import Model

if TYPE_CHECKING:
    from nsmodel.hypotheses.report.report import Report

# Markdown takes away the backslash before punctuation, also in formulas: \, \{ \\ and the like are spelled with letters.
_MARKDOWN_SAFE_LATEX = {r"\\": r"\cr ", r"\,": r"\thinspace ", r"\{": r"\lbrace ", r"\}": r"\rbrace ", r"\_": "_"}


def markdown(report: Report, model: Model) -> str:
    """Return the report as a page: equations, findings, what follows, notes; ``model`` gives the equations."""
    parts = [f"# {_escape_markdown(report.title or report.model_class)}", _report_summary(report)]
    parts += ["## The model", *(f"$$\n{_escape_formula(line)}\n$$" for line in model_equations(model))]
    header = ("id", "hypothesis", "verdict", "numbers", "witness", "where and how it was decided", "source")
    parts += ["## Hypotheses", _markdown_table(header, [_finding_row(finding) for finding in report.findings])]
    if report.consequences:
        header = ("", "what follows", "verdict", "numbers", "where", "rests on", "source")
        parts += ["## Consequences", _markdown_table(header, [_consequence_row(item, report) for item in report.consequences])]
    if report.notes:
        parts += ["## Notes", "\n".join(f"- {_escape_markdown(note)}" for note in report.notes)]
    return "\n\n".join(parts) + "\n"


def _report_summary(report: Report) -> str:
    lines = [f"- Class: {report.model_class}; {_escape_markdown(report.paper)}", f"- Region: {_escape_markdown(report.region)}"]
    if report.parameters:
        lines.append(f"- Parameters: {_escape_markdown(', '.join(parameter_texts(report)))}")
    lines += [f"- Input {_escape_markdown(line)}" for line in report.inputs]
    return "\n".join([*lines, f"- Findings: {_escape_markdown(report.verdict)}"])


def _finding_row(finding: Finding) -> list[str]:
    return [
        f"**{_escape_markdown(finding.id)}**",
        _escape_markdown(finding.statement),
        finding.verdict,
        _join_with_breaks(name_value_pairs(finding.value)),
        _join_with_breaks(witness_texts(finding)),
        _join_with_breaks(
            [
                decision_text(finding),
                *(["outside it fails at " + ", ".join(name_value_pairs(finding.outside))] if finding.outside else []),
            ]
        ),
        _escape_markdown(finding.source),
    ]


def _consequence_row(item: Consequence, report: Report) -> list[str]:
    return [
        f"**{_escape_markdown(item.name)}**",
        _escape_markdown(item.statement),
        item.verdict,
        _join_with_breaks(name_value_pairs(item.value)),
        _escape_markdown(validity_text(item)),
        _escape_markdown(premises_text(item, report).replace("rests on ", "")),
        _escape_markdown(item.source),
    ]


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _join_with_breaks(items: Sequence[str]) -> str:
    return "<br>".join(map(_escape_markdown, items))


def _escape_markdown(text: str) -> str:
    """The text with what Markdown would read as markup made plain, on one line."""
    return re.sub(r"([\\`*_{}\[\]<>|$~#])", r"\\\1", " ".join(text.split()))


def _escape_formula(formula: str) -> str:
    return re.sub(
        r"\\[^A-Za-z0-9\s]", lambda found: _MARKDOWN_SAFE_LATEX.get(found[0]) or rf"\unicode{{{ord(found[0][1])}}}", formula
    )
