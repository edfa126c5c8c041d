"""What a check returns: all findings about a model, and what follows from them; as a table, as data and as Markdown."""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from nsmodel._utils import display, escape_invisible, html_repr, one_line, wrap_lines
from nsmodel.hypotheses.equations import model_equations
from nsmodel.hypotheses.findings import RUN_FINDING_PREFIX, Consequence, Finding, scope_text
from nsmodel.modeling.base import Model
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof.verdict import HOLDS, SAMPLED, UNKNOWN, VERDICTS, VIOLATED

MAX_VECTOR_ENTRIES = 6  # Entries of a vector that are shown: six numbers of five digits take half a line of the terminal.
MAX_WITNESS_ENTRIES = 12  # Entries of a witness that are shown: as many names and values as fit on some three lines.
START_FINDING_IDS = ("S-start", "5.x0", "O-steps")  # Said of one state, or of the steps: nowhere else.
MAX_LABEL_WIDTH = 14  # A label longer than this stands on its own line: ids fit, names of consequences need not.


@dataclass(frozen=True, repr=False)
class Report(Picklable):
    """All findings about one model.

    Attributes:
        title, model_class, paper: of the model.
        region: where hypotheses about a region were decided, in words.
        quick: whether global searches were skipped.
        findings: one for each hypothesis of the class, then those about the runs.
        consequences: what follows.
        parameters: values by name; None where a parameter stayed a symbol.
        notes: what the reader should know beside (a run that stopped, parameters without value).
        model: the model with its parameters bound.
        inputs: of each input where it stands, and which signals are meant.
    """

    title: str
    model_class: str
    paper: str
    region: str
    quick: bool
    findings: tuple[Finding, ...]
    consequences: tuple[Consequence, ...]
    parameters: Mapping[str, float | None]
    notes: tuple[str, ...]
    model: Any = field(repr=False, compare=False)
    inputs: tuple[str, ...] = ()

    _repr_html_ = html_repr("report_html")

    def __repr__(self) -> str:
        """Return a few lines: title, class, verdicts."""
        return "\n".join(wrap_lines(f"Report({one_line(self.title)!r}, {self.model_class}: {self.verdict})"))

    def text(self) -> str:
        """The report as a table for a terminal, 100 columns wide."""
        return escape_invisible(report_text(self))

    def document(self) -> dict[str, Any]:
        """The report as a dictionary that JSON can hold."""
        return report_data(self)

    def markdown(self) -> str:
        """The report as a Markdown page, with the model's equations in LaTeX."""
        return escape_invisible(markdown(self, self.model))

    def view(self, path: str | Path | None = None) -> Path:
        """Write the report as one HTML file, and return its path; without a path a temporary file, opened in the browser.

        StorageError where it cannot be written.
        """
        return display("write_report_page", self, path)

    def __getitem__(self, id: str) -> Finding:
        """Return the finding of a hypothesis: ``report["A5"]``."""
        for finding in self.findings:
            if finding.id == id:
                return finding
        raise KeyError(f"no finding '{id}'; the report has {', '.join(finding.id for finding in self.findings)}")

    def having(self, verdict: str) -> tuple[Finding, ...]:
        """The findings with this verdict."""
        return tuple(finding for finding in self.findings if finding.verdict == verdict)

    @property
    def verdict(self) -> str:
        """One line: how many hypotheses are proved, the ids of the others, and how many inequalities the run met."""
        hypotheses = [finding for finding in self.findings if not finding.id.startswith(RUN_FINDING_PREFIX)]
        along = [finding for finding in self.findings if finding.id.startswith(RUN_FINDING_PREFIX)]
        proved = [finding for finding in hypotheses if finding.verdict == HOLDS]
        local = sum(finding.scope is not None and bool(finding.scope.states) for finding in proved)
        parts = [
            f"{len(proved)} proved" + (f" ({local} of them on a box of states)" if local else ""),
            *_unproved_counts(hypotheses),
        ]
        text = ", ".join(parts) + (" (quick: global searches skipped)" if self.quick else "")
        if along:
            met = sum(finding.verdict == HOLDS for finding in along)
            text += f"; along the run: {', '.join([f'{met} of {len(along)} met', *_unproved_counts(along)])}"
        return text


def _unproved_counts(findings: Sequence[Finding]) -> list[str]:
    """How many findings are not "holds", and which."""
    ids = {verdict: [finding.id for finding in findings if finding.verdict == verdict] for verdict in VERDICTS[1:]}
    return [f"{len(own)} {verdict} ({', '.join(own)})" for verdict, own in ids.items() if own]


# -- text and data ------------------------------------------------------------------------------------------------------


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


# -- Markdown -----------------------------------------------------------------------------------------------------------

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
