"""What a check returns: all findings about a model, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nsmodel._utils import display, escape_invisible, html_repr, one_line, wrap_lines
from nsmodel.hypotheses.findings import RUN_FINDING_PREFIX, Consequence, Finding
from nsmodel.hypotheses.report import table
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof.verdict import HOLDS, VERDICTS


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
        return escape_invisible(table.report_text(self))

    def document(self) -> dict[str, Any]:
        """The report as a dictionary that JSON can hold."""
        return table.report_data(self)

    def markdown(self) -> str:
        """The report as a Markdown page, with the model's equations in LaTeX."""
        from nsmodel.hypotheses.report.markdown import markdown

        return escape_invisible(markdown(self, self.model))

    def view(self, path: str | Path | None = None) -> Path:
        """Write the report as one HTML file, and return its path; without a path a temporary file, opened in the browser.

        StorageError where it cannot be written.
        """
        return display("view_report", self, path)

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
