"""The cases that come with the package: model files to run, read and copy, each described by its own docstring."""

from __future__ import annotations

import ast
import difflib
from dataclasses import dataclass
from pathlib import Path

from nsmodel.brief import short_repr
from nsmodel.errors import UsageError

TOPICS = ("circuits", "control", "mechanics", "crowds", "biology", "mathematics")
_PACKAGE = Path(__file__).parent
_CASE_FOLDERS = (_PACKAGE / "cases", _PACKAGE.parent / "cases")  # as installed; in a checkout


@dataclass(frozen=True)
class Case:
    """A case: its name, its file, and what the paragraphs of the file's docstring say.

    ``title`` is the first line, ``story`` what stands between it and the paragraphs that begin with a label, which are ``see``
    ("What to see:"), ``wrong`` ("A wrong answer:" and how it would show), ``source`` ("Source:") and ``topic``
    ("Topic:", one of TOPICS). A paragraph that is not there is "".
    """

    name: str
    path: Path
    title: str
    story: str
    see: str
    wrong: str
    source: str
    topic: str

    __repr__ = short_repr


def all_cases() -> tuple[Case, ...]:
    """All cases, by name.

    Raises:
        UsageError: this installation has none.
    """
    found = case_files()
    if not found:
        raise UsageError(f"no cases beside the package: expected the folder {_CASE_FOLDERS[0]}; install nsmodel anew")
    return tuple(map(read_case, found.values()))


def case_files() -> dict[str, Path]:
    """The files of the cases by name; empty where this installation has none."""
    folder = next((place for place in _CASE_FOLDERS if place.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted(folder.glob("*.py"))}


def case_or_file_path(given: str | Path) -> Path:
    """The file that is given; that of the case of this name where there is no such file."""
    path = Path(given)
    return path if path.is_file() else case_files().get(str(given), path)


def shadowed_case_note(given: str | Path) -> str:
    """What to know where a name is that of a case, and of a file NAME.py too; "" elsewhere."""
    path = Path(given)
    other = path.is_file() or str(given) not in case_files() or not Path(f"{given}.py").is_file()
    return "" if other else f"{given} is the case that comes with nsmodel; {given}.py here is another file"


def path_suggestion(path: Path) -> str:
    """What a path that is no file may be meant for, as a question; "" where nothing is near."""
    if (own := path.with_name(f"{path.name}.py")).is_file():
        return f"did you mean {own}?"
    here = {str(path.with_name(one.name)) for one in path.parent.glob("*.py")}
    near = difflib.get_close_matches(str(path), [*case_files(), *sorted(here)], 3, 0.7)
    return f"did you mean {' or '.join(near)}?" if near else ""


def find_case(name: str) -> Case:
    """The case of that name.

    Raises:
        UsageError: there is none; the message has the names that are near.
    """
    found = {case.name: case for case in all_cases()}
    if name not in found:
        near = difflib.get_close_matches(name, found, 3)
        what = f"did you mean {', '.join(near)}?" if near else f"nsmodel cases lists the {len(found)} that there are"
        raise UsageError(f"no case '{name}'; {what}")
    return found[name]


def read_case(path: Path) -> Case:
    """The case in a file, which is read and not run."""
    title, *paragraphs = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")
    labels = {"What to see:": "", "A wrong answer:": "", "Source:": "", "Topic:": ""}
    story = []
    for paragraph in paragraphs:
        label = next((label for label in labels if paragraph.startswith(label)), None)
        if label is None:
            story.append(paragraph)
        else:
            labels[label] = paragraph.removeprefix(label).strip()
    see, wrong, source, topic = labels.values()
    return Case(path.stem, path, " ".join(title.split()), "\n\n".join(story), see, wrong, source, topic.rstrip("."))
