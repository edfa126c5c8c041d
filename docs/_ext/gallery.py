"""The gallery: a page for each case, with what its docstring says and what its run shows, and an overview by topic."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from as_markdown import fenced, plain, prose, relative, table
from runs import Job, Made, forget, made
from sphinx.util.display import status_iterator

from nsmodel.modeling.model_files import TOPICS, Case, all_cases

INTRODUCTION = """# Gallery

Every case that comes with nsmodel: what it is, what to see, its picture, its numbers, and what the check of its
hypotheses says. All of it was made by running the file when this site was built. A picture leads to its page, where the file
can be read and taken.
"""


def setup(app: Any) -> dict[str, bool]:
    """Write the pages before they are read."""
    app.add_config_value("made_in", "", "env", str)
    app.add_config_value("gallery_cases", [], "env", list)
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True}


def write_pages(app: Any) -> None:
    """Write gallery/*.md where they are other than before; remove those of cases that are gone."""
    chosen = [case for case in all_cases() if not app.config.gallery_cases or case.name in app.config.gallery_cases]
    folder, kept = Path(app.srcdir) / "gallery", Path(app.config.made_in) / "cases"
    jobs = [Job(case.path.name, case.path.read_text(encoding="utf-8"), case=True) for case in chosen]
    results = status_iterator(made(jobs, kept), "running cases... ", "brown", len(jobs), stringify_func=lambda one: one.file.stem)
    shelf = list(zip(chosen, results, strict=True))
    forget(kept, jobs)
    pages = {case.name: page(case, found, folder) for case, found in shelf} | {"index": overview(shelf, folder)}
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.md"):
        if path.stem not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def page(case: Case, found: Made, folder: Path) -> str:
    """The page of a case, in Markdown."""
    facts, picture = found.facts, relative(found.picture, folder)
    parts = [
        f"# {plain(facts['title'])}",
        plain(case.title),
        f"```{{figure}} {picture}\n:alt: {' '.join(facts['title'].split())}: overview of the run\n:figclass: overview\n```",
        prose(case.story),
        labelled("What to see", case.see),
        labelled("A wrong answer", case.wrong),
        labelled("Source", case.source),
        equations(facts["equations"]),
        f"## The file\n\nTake {{download}}`{found.file.name} <{relative(found.file, folder)}>`, "
        f"or copy it with `nsmodel new NAME --like {case.name}`.",
        fenced(case.path.read_text(encoding="utf-8"), "python"),
        f"## Its numbers\n\nWhat `nsmodel run {found.file.name}` prints:\n\n{fenced(facts['summary'])}",
        f"## Its hypotheses\n\nWhat `nsmodel check {found.file.name}` decides: {plain(facts['verdict'])}.",
        verdicts(facts["findings"]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def equations(lines: list[str]) -> str:
    """The equations of the model, as reports have them, one under the other."""
    rows = "\\\\[0.4em]\n".join(f"& {line}" for line in lines)
    return f"## Its equations\n\n```{{math}}\n\\begin{{aligned}}\n{rows}\n\\end{{aligned}}\n```"


def labelled(label: str, text: str) -> str:
    """A paragraph with its label; nothing where there is no text."""
    return f"**{label}:** {prose(text)}" if text else ""


def verdicts(findings: Iterable[dict[str, str]]) -> str:
    """The findings as a table."""
    rows = [
        [plain(one["id"]), f"[{one['verdict']}]{{.verdict .{one['verdict']}}}", plain(one["statement"]), plain(one["how"])]
        for one in findings
    ]
    return table(["", "verdict", "hypothesis", "how it was decided"], rows) if rows else ""


def overview(shelf: list[tuple[Case, Made]], folder: Path) -> str:
    """The page with all thumbnails, topic by topic."""
    parts = [INTRODUCTION]
    for topic in TOPICS:
        own = [(case, found) for case, found in shelf if case.topic == topic]
        if own:
            cards = "\n\n".join(card(case, found, folder) for case, found in own)
            names = "\n".join(case.name for case, _ in own)
            parts += [f"## {topic.capitalize()}", f":::{{container}} cards\n{cards}\n:::"]
            parts += [f"```{{toctree}}\n:hidden:\n\n{names}\n```"]
    return "\n\n".join(parts) + "\n"


def card(case: Case, found: Made, folder: Path) -> str:
    """A thumbnail and a title, which lead to the page."""
    title = plain(found.facts["title"])
    return f"[![{title}]({relative(found.thumbnail, folder)}) {title}]({case.name}.md)"
