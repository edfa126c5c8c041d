"""What `nsmodel.check` says of all cases and of random models, at points and over boxes, kept in files for review.

    python -m tests.search.golden                       # what differs from the files
    python -m tests.search.golden --class lure --write  # the file of a class anew; then see `git diff`

A file a class, in ``tests/fixtures/checks``: of each finding verdict, scope, numbers and witness, of each consequence what it
rests on, too; of quick checks over boxes of a parameter (``boxes.drawn``) verdicts and numbers alone. Of findings about a run,
and of what is sampled, the verdict and the scope alone: the run of a crowd is another one with other kernels. Each check that is
written is made twice, the second time with other kernels of linear algebra. What then differs beyond 1e-6 comes from searches
in floating point, and is kept and compared by its kind alone: "~number", "~text", "~list of 3". So are lists that are long.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import nsmodel
from nsmodel.hypotheses.findings import RUN_FINDING_PREFIX, SAMPLED, Finding
from nsmodel.hypotheses.report import Report
from nsmodel.modeling.model_files import case_files

from .boxes import BOUNDS, drawn
from .checked import MAKERS, draw

FILES = Path(__file__).resolve().parents[1] / "fixtures" / "checks"
MODELS = 50  # Of each class.
DEAR = {"crowd_room", "running_track"}  # Cases whose full check takes 5 s of CPU or more.
DEAR_MODELS = {  # Models of which it does: they are checked with quick=True.
    "inclusion": {19},
    "bodies": {4, 8, 20, 32, 36, 45, 47, 48},
}
TOLERANCE, NOTHING = 1e-6, 1e-12  # Relative; what is below the second is 0.
MAX_ENTRIES = 12  # Of a list that is written out.
OVER_A_BOX = " over a box"  # What the names of checks over boxes of parameters end with.
OTHER_KERNELS = {"OPENBLAS_CORETYPE": "Nehalem", "PYTHONHASHSEED": "1"}

Document = dict[str, Any]


# -- what is kept ------------------------------------------------------------------------------------------------------


def checks_of(class_name: str) -> Iterator[tuple[str, Report]]:
    """All checks of a class: (name, report) of its cases and of its random models, at points and over boxes of parameters."""
    yield from (item for stem in cases_of(class_name) for item in case_checks(stem))
    yield from ((f"model {seed}", model_check(class_name, seed)) for seed in range(MODELS))
    yield from box_checks(class_name)


def cases_of(class_name: str) -> list[str]:
    """The names of the cases of a class."""
    return [stem for stem in case_files() if type(nsmodel.load(stem)) is MAKERS[class_name][0]]


def case_checks(stem: str) -> Iterator[tuple[str, Report]]:
    """The quick check of a case, and the full one where it is not dear."""
    for quick in (True,) if stem in DEAR else (True, False):
        yield f"{stem}{' quick' * quick}", nsmodel.check(nsmodel.load(stem), bounds=BOUNDS.get(stem), quick=quick)


def model_check(class_name: str, seed: int) -> Report:
    """The check of a random model, without runs."""
    return nsmodel.check(draw(class_name, seed), runs=[], quick=seed in DEAR_MODELS.get(class_name, ()))


def box_checks(class_name: str) -> Iterator[tuple[str, Report]]:
    """The quick checks of random models over boxes of a parameter, of those that have one and are not dear."""
    for seed in range(MODELS):
        one = None if seed in DEAR_MODELS.get(class_name, ()) else drawn(class_name, seed)
        if one is not None:
            box = {one.parameter: (one.low, one.high)}
            yield f"model {seed}{OVER_A_BOX}", nsmodel.check(one.model, runs=[], parameters=box, quick=True)


def kept_of(name: str, report: Report) -> Document:
    """What is kept of a check with this name."""
    return brief_document(report) if name.endswith(OVER_A_BOX) else document(report)


def brief_document(report: Report) -> Document:
    """Verdicts and numbers, and of a violation its witness: what is kept of checks over boxes."""
    findings = {
        finding.id: _kept(
            verdict=finding.verdict, value=finding.value, witness=finding.witness if finding.verdict == "violated" else None
        )
        for finding in report.findings
    }
    consequences = {item.name: _kept(verdict=item.verdict, value=item.value, until=item.until) for item in report.consequences}
    return {"findings": findings, "consequences": consequences}


def document(report: Report) -> Document:
    """What is kept of a report."""
    findings = {
        finding.id: _kept(verdict=finding.verdict, scope=_scope(finding), **_numbers(finding)) for finding in report.findings
    }
    consequences = {
        item.name: _kept(verdict=item.verdict, on=" ".join(item.rests_on), scope=_scope(item), value=item.value, until=item.until)
        for item in report.consequences
    }
    return {"findings": findings, "consequences": consequences}


def _numbers(finding: Finding) -> Document:
    if finding.verdict == SAMPLED or finding.id.startswith(RUN_FINDING_PREFIX):
        return {}
    return {"value": finding.value, "witness": finding.witness}


def _kept(**parts: Any) -> Document:
    return {name: _plain(part) for name, part in parts.items() if part not in (None, "", {}) and part}


def _scope(item: Any) -> Document | None:
    return None if item.scope is None else {name: part for name, part in item.scope.document().items() if part is not None}


def _plain(item: Any) -> Any:
    """As JSON can hold it: numbers of 9 digits, and no list that is long."""
    if isinstance(item, Mapping):
        return {str(name): _plain(part) for name, part in item.items()}
    if isinstance(item, list | tuple):
        return [_plain(part) for part in item] if len(item) <= MAX_ENTRIES else kind(item)
    if isinstance(item, bool | str) or item is None:
        return item
    return float(f"{item:.9g}") if math.isfinite(item) else f"{item}"


def kind(item: Any) -> str:
    """What an entry is, without its numbers; of a kind itself that."""
    if isinstance(item, str):
        return item if item.startswith("~") else "~number" if item in ("inf", "-inf", "nan") else "~text"
    if isinstance(item, Mapping):
        return "~table"
    return f"~list of {len(item)}" if isinstance(item, list | tuple) else "~number"


# -- comparisons -------------------------------------------------------------------------------------------------------


def agree(kept: Any, now: Any) -> bool:
    """Whether two entries are the same up to rounding, or of one kind where the first is but a kind."""
    if isinstance(kept, str) and kept.startswith("~"):
        return kind(now) == kept
    if isinstance(kept, Mapping) and isinstance(now, Mapping):
        return kept.keys() == now.keys() and all(agree(kept[name], now[name]) for name in kept)
    if isinstance(kept, list) and isinstance(now, list):
        return len(kept) == len(now) and all(map(agree, kept, now))
    if isinstance(kept, float | int) and isinstance(now, float | int):
        return math.isclose(kept, now, rel_tol=TOLERANCE, abs_tol=NOTHING)
    return kept == now


def stable(one: Any, other: Any) -> Any:
    """An entry as two computations agree on it: its kind where they do not."""
    if agree(one, other):
        return one
    if isinstance(one, Mapping) and isinstance(other, Mapping) and one.keys() == other.keys():
        return {name: stable(one[name], other[name]) for name in one}
    return kind(one)


def differences(kept: Document, now: Document) -> list[str]:
    """A line for each finding and consequence of a report that is not as it was kept."""
    lines = []
    for part in ("findings", "consequences"):
        for name in {**kept[part], **now[part]}:
            was, new = kept[part].get(name), now[part].get(name)
            if was is None or new is None or not agree(was, new):
                lines.append(f"{name}: {_changes(was, new)}")
    return lines


def _changes(was: Document | None, new: Document | None) -> str:
    if was is None or new is None:
        return "new" if was is None else "gone"
    changed = (name for name in {**was, **new} if not agree(was.get(name), new.get(name)))
    return "; ".join(f"{name} {json.dumps(was.get(name))} -> {json.dumps(new.get(name))}" for name in changed)


# -- files -------------------------------------------------------------------------------------------------------------


def read(class_name: str) -> dict[str, Document]:
    """The file of a class: {name of a check: what is kept of it}."""
    return json.loads((FILES / f"{class_name}.json").read_text())


def written(kept: Mapping[str, Document]) -> str:
    """The text of a file: a line for each finding and consequence."""
    checks = []
    for name, parts in kept.items():
        tables = (
            f' "{part}": {{\n' + ",\n".join(f"  {_line(id)}: {_line(item)}" for id, item in own.items()) + "\n }"
            for part, own in parts.items()
        )
        checks.append(f"{_line(name)}: {{\n" + ",\n".join(tables) + "\n}")
    return "{\n" + ",\n".join(checks) + "\n}\n"


def _line(item: Any) -> str:
    return json.dumps(item, separators=(",", ":"), ensure_ascii=False)


def documents(class_name: str) -> dict[str, Document]:
    """What is kept of all checks of a class, computed here."""
    return {name: kept_of(name, report) for name, report in checks_of(class_name)}


def documents_elsewhere(class_name: str, environment: Mapping[str, str]) -> dict[str, Document]:
    """The same, computed by another process."""
    command = [sys.executable, "-m", "tests.search.golden", "--class", class_name, "--print"]
    done = subprocess.run(command, env={**os.environ, **environment}, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def write(class_name: str) -> None:
    """Write the file of a class; LookupError where the verdict of a check depends on rounding."""
    one, other = documents(class_name), documents_elsewhere(class_name, OTHER_KERNELS)
    kept = {name: {part: stable(own, other[name][part]) for part, own in parts.items()} for name, parts in one.items()}
    loose = [name for name, parts in kept.items() if any('"verdict": "~' in json.dumps(own) for own in parts.values())]
    if loose or any(isinstance(own, str) for parts in kept.values() for own in parts.values()):
        raise LookupError(f"{class_name}: verdicts depend on rounding: {loose}")
    (FILES / f"{class_name}.json").write_text(written(kept))


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare with the files, or write them."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.golden", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--class", dest="classes", action="append", choices=list(MAKERS), help="one class; may be repeated")
    parser.add_argument("--write", action="store_true", help="write the files")
    parser.add_argument("--print", action="store_true", help="print what would be kept, and compare nothing")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    changed = 0
    for class_name in given.classes or MAKERS:
        if given.write:
            write(class_name)
        elif given.print:
            print(json.dumps(documents(class_name)))
        else:
            kept = read(class_name)
            for name, now in documents(class_name).items():
                lines = differences(kept[name], now) if name in kept else ["new"]
                changed += bool(lines)
                print(*(f"{class_name}, {name}: {line}" for line in lines), sep="\n", end="\n" * bool(lines))
    return int(changed > 0)


if __name__ == "__main__":
    sys.exit(main())
