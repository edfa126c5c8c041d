"""A report as a table for the terminal, and as data."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from nsmodel.hypotheses.findings import RUN_FINDING_PREFIX, Consequence, Finding
from nsmodel.hypotheses.scope import scope_text
from nsmodel.proof.verdict import HOLDS, SAMPLED, UNKNOWN, VIOLATED

if TYPE_CHECKING:
    from nsmodel.hypotheses.report.report import Report

MAX_VECTOR_ENTRIES = 6  # Entries of a vector that are shown.
MAX_WITNESS_ENTRIES = 12  # Entries of a witness that are shown.
START_FINDING_IDS = ("S-start", "5.x0", "O-steps")  # Said of one state, or of the steps: nowhere else.
MAX_LABEL_WIDTH = 14  # A label longer than this stands on its own line.


def report_text(report: Report, width: int = 100) -> str:
    """Return the report as lines of at most ``width`` (>= 60) characters: a block a finding, then what follows from them."""
    labels = [finding.id for finding in report.findings] + [consequence.name for consequence in report.consequences]
    page = _ReportPage(
        max([len(label) for label in labels if len(label) <= MAX_LABEL_WIDTH], default=4) + 2, width, _usual_source(report)
    )
    findings = [line for finding in report.findings for line in _finding_lines(finding, page)]
    follows = [line for consequence in report.consequences for line in _consequence_lines(consequence, report, page)]
    notes = [line for note in report.notes for line in _wrap_hanging("note  ", note, width)]
    blocks = [_head_lines(report, width), findings, ["What follows", "", *follows] if follows else [], notes]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def report_data(report: Report) -> dict[str, Any]:
    """Return all of the report as text, numbers, lists and dictionaries, as :func:`nsmodel.files.storage.dumps` writes them."""
    return {
        "title": report.title,
        "model_class": report.model_class,
        "paper": report.paper,
        "region": report.region,
        "quick": report.quick,
        "verdict": report.verdict,
        "parameters": dict(report.parameters),
        **({"inputs": list(report.inputs)} if report.inputs else {}),
        "findings": [
            {
                "id": finding.id,
                "statement": finding.statement,
                "verdict": finding.verdict,
                "value": dict(finding.value),
                "witness": dict(finding.witness),
                "how": finding.how,
                "scope": None if finding.scope is None else finding.scope.document(),
                "outside": dict(finding.outside) or None,
                "source": finding.source,
            }
            for finding in report.findings
        ],
        "consequences": [
            {
                "name": consequence.name,
                "statement": consequence.statement,
                "verdict": consequence.verdict,
                "rests_on": list(consequence.rests_on),
                "value": dict(consequence.value),
                "scope": None if consequence.scope is None else consequence.scope.document(),
                "clause": consequence.clause or None,
                "until": consequence.until,
                "source": consequence.source,
            }
            for consequence in report.consequences
        ],
        "notes": list(report.notes),
    }


def parameter_texts(report: Report) -> list[str]:
    """The parameters with their values, or between which ends all values were meant."""
    found = []
    for name, value in report.parameters.items():
        if isinstance(value, tuple):
            found.append(f"{name} in [{value[0]:.5g}, {value[1]:.5g}]")
        else:
            found.append(f"{name} = {'no value' if value is None else witness_value_text(value)}")
    return found


def witness_value_text(item: Any) -> str:
    """A number, text, or a list of them as a reader wants it: 5 digits, long lists abbreviated.

    >>> witness_value_text([1, 0.123456, float("inf")])
    '(1, 0.12346, inf)'
    """
    if isinstance(item, list | tuple):
        entries = [witness_value_text(part) for part in item]
        if len(entries) > MAX_VECTOR_ENTRIES:
            return f"({', '.join([*entries[: MAX_VECTOR_ENTRIES - 2], '...', entries[-1]])}; {len(entries)} entries)"
        return f"({', '.join(entries)})"
    return f"{item:.5g}" if isinstance(item, float) else str(item)


def name_value_pairs(numbers: Mapping[str, Any]) -> list[str]:
    """Name = value for each entry."""
    return [f"{name} = {witness_value_text(item)}" for name, item in numbers.items()]


def witness_texts(finding: Finding) -> list[str]:
    """The witness where a hypothesis fails or was only looked at, of a long one the first entries; of a proof the P it found."""
    stated = (
        finding.witness
        if finding.verdict in (VIOLATED, SAMPLED)
        else {k: v for k, v in finding.witness.items() if k in ("P", "P_omega")}
    )
    entries = name_value_pairs(stated)
    return (
        entries if len(entries) <= MAX_WITNESS_ENTRIES else [*entries[: MAX_WITNESS_ENTRIES - 2], f"... ({len(entries)} entries)"]
    )


def _head_lines(report: Report, width: int) -> list[str]:
    given = parameter_texts(report)
    rows = {"model": f"{report.model_class}; {report.paper}", "region": report.region}
    lines = [line for name, value in rows.items() for line in _wrap_hanging(f"  {name:<12}", value, width)]
    lines += _wrap_items("  parameters  ", given, width) if given else []
    for k, line in enumerate(report.inputs):
        lines += _wrap_hanging("  inputs      " if k == 0 else " " * 14, line, width)
    return [*textwrap.wrap(report.title, width), *lines, *_wrap_hanging("  findings    ", report.verdict, width)]


class _ReportPage(NamedTuple):
    """Where the second column begins, how wide the page is, and the source that need not be repeated."""

    column: int
    width: int
    source: str

    @property
    def margin(self) -> str:
        return " " * self.column

    def source_text(self, source: str) -> str:
        own = source.removeprefix(self.source)
        return own if own.startswith("(") else f"[{own}]"

    def label_lines(self, label: str, verdict: str, statement: str) -> list[str]:
        """The first lines of a block; a long label has a line of its own."""
        own_line = len(label) > MAX_LABEL_WIDTH
        lines = textwrap.wrap(label, self.width) if own_line else []
        first = f"{'' if own_line else label:<{self.column}}{verdict:<10}"
        return lines + _wrap_hanging(first, statement, self.width)


def _usual_source(report: Report) -> str:
    """The paper that most sources begin with, as the head of the page names it already."""
    papers = Counter(finding.source.rpartition(", ")[0] for finding in report.findings)
    paper, count = max(papers.items(), key=lambda item: item[1], default=("", 0))
    return f"{paper}, " if paper and count > 1 else ""


def _finding_lines(finding: Finding, page: _ReportPage) -> list[str]:
    lines = page.label_lines(finding.id, finding.verdict, finding.statement)
    lines += _wrap_items(page.margin, name_value_pairs(finding.value), page.width)
    lines += _wrap_items(f"{page.margin}{'with' if finding.verdict == HOLDS else 'at'} ", witness_texts(finding), page.width)
    if finding.outside:
        lines += _wrap_items(f"{page.margin}outside it fails at ", name_value_pairs(finding.outside), page.width)
    return lines + _wrap_hanging(page.margin, f"{decision_text(finding)} {page.source_text(finding.source)}", page.width)


def decision_text(finding: Finding) -> str:
    """Where and how it was decided: a violation has its place in the witness."""
    placed = (
        finding.verdict in (HOLDS, SAMPLED)
        and not finding.id.startswith(RUN_FINDING_PREFIX)
        and finding.id not in START_FINDING_IDS
    )
    return f"{scope_text(finding.scope)}: {finding.how}" if placed else finding.how


def validity_text(consequence: Consequence) -> str:
    """Where a consequence holds, and for how long; "" where nothing follows."""
    if consequence.verdict not in (HOLDS, SAMPLED) or not consequence.rests_on:
        return ""
    return "; ".join([scope_text(consequence.scope), *([consequence.clause] if consequence.clause else [])])


def premises_text(consequence: Consequence, report: Report) -> str:
    """The findings that a consequence needs; where nothing follows, first those that spoil it."""
    verdicts = {finding.id: finding.verdict for finding in report.findings}
    spoiled = [f"{id} ({verdicts[id]})" for id in consequence.rests_on if verdicts.get(id) in (VIOLATED, UNKNOWN)]
    needs = f"rests on {', '.join(consequence.rests_on)}" if consequence.rests_on else ""
    return f"does not follow without {', '.join(spoiled)}; {needs}" if spoiled else needs


def _consequence_lines(consequence: Consequence, report: Report, page: _ReportPage) -> list[str]:
    lines = page.label_lines(consequence.name, consequence.verdict, consequence.statement)
    lines += _wrap_items(page.margin, name_value_pairs(consequence.value), page.width)
    details = "; ".join(part for part in (validity_text(consequence), premises_text(consequence, report)) if part)
    return lines + _wrap_hanging(page.margin, f"{details} {page.source_text(consequence.source)}".strip(), page.width)


def _wrap_hanging(first: str, body: str, width: int) -> list[str]:
    """``body`` wrapped behind ``first``, its further lines below its beginning."""
    wrapped = textwrap.wrap(body, width - len(first), break_on_hyphens=False) or [""]
    return [f"{head}{line}".rstrip() for head, line in zip([first] + [" " * len(first)] * len(wrapped), wrapped, strict=False)]


def _wrap_items(first: str, items: Iterable[str], width: int) -> list[str]:
    """The items with commas between them, as many a line as fit; one that is too long by itself is wrapped."""
    lines: list[str] = []
    for item in items:
        if lines and len(lines[-1]) + len(item) + 2 <= width - len(first):
            lines[-1] += f", {item}"
        else:
            lines += [item]
    room = width - len(first)
    broken = [piece for line in lines for piece in textwrap.wrap(line, room, break_on_hyphens=False, subsequent_indent="  ")]
    return [f"{first if i == 0 else ' ' * len(first)}{line}" for i, line in enumerate(broken)]
