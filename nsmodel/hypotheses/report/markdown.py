"""A report as a page of GitHub-flavoured Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.report.table import conditions, pairs, parameters, rests, told, witness
from nsmodel.hypotheses.report.typeset import equations
from nsmodel.model.base import Model

if TYPE_CHECKING:
    from nsmodel.hypotheses.report.report import Report

# Markdown takes away the backslash before punctuation, also in formulas: \, \{ \\ and the like are spelled with letters.
_SPELLED = {r"\\": r"\cr ", r"\,": r"\thinspace ", r"\{": r"\lbrace ", r"\}": r"\rbrace ", r"\_": "_"}


def markdown(report: Report, model: Model) -> str:
    """Return the report as a page: equations, findings, what follows, notes; ``model`` gives the equations."""
    parts = [f"# {_escaped(report.title or report.model_class)}", _head(report)]
    parts += ["## The model", *(f"$$\n{_spelled(line)}\n$$" for line in equations(model))]
    header = ("id", "hypothesis", "verdict", "numbers", "witness", "where and how it was decided", "source")
    parts += ["## Hypotheses", _table(header, [_finding_row(finding) for finding in report.findings])]
    if report.consequences:
        header = ("", "what follows", "verdict", "numbers", "where", "rests on", "source")
        parts += ["## Consequences", _table(header, [_consequence_row(item, report) for item in report.consequences])]
    if report.notes:
        parts += ["## Notes", "\n".join(f"- {_escaped(note)}" for note in report.notes)]
    return "\n\n".join(parts) + "\n"


def _head(report: Report) -> str:
    lines = [f"- Class: {report.model_class}; {_escaped(report.paper)}", f"- Region: {_escaped(report.region)}"]
    if report.parameters:
        lines.append(f"- Parameters: {_escaped(', '.join(parameters(report)))}")
    lines += [f"- Input {_escaped(line)}" for line in report.inputs]
    return "\n".join([*lines, f"- Findings: {_escaped(report.verdict)}"])


def _finding_row(finding: Finding) -> list[str]:
    return [
        f"**{_escaped(finding.id)}**",
        _escaped(finding.statement),
        finding.verdict,
        _stacked(pairs(finding.value)),
        _stacked(witness(finding)),
        _stacked([told(finding), *(["outside it fails at " + ", ".join(pairs(finding.outside))] if finding.outside else [])]),
        _escaped(finding.source),
    ]


def _consequence_row(item: Consequence, report: Report) -> list[str]:
    return [
        f"**{_escaped(item.name)}**",
        _escaped(item.statement),
        item.verdict,
        _stacked(pairs(item.value)),
        _escaped(conditions(item)),
        _escaped(rests(item, report).replace("rests on ", "")),
        _escaped(item.source),
    ]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _stacked(items: Sequence[str]) -> str:
    return "<br>".join(map(_escaped, items))


def _escaped(text: str) -> str:
    """The text with what Markdown would read as markup made plain, on one line."""
    return re.sub(r"([\\`*_{}\[\]<>|$~#])", r"\\\1", " ".join(text.split()))


def _spelled(formula: str) -> str:
    return re.sub(r"\\[^A-Za-z0-9\s]", lambda found: _SPELLED.get(found[0]) or rf"\unicode{{{ord(found[0][1])}}}", formula)
