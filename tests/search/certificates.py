"""How much of what the checker says holds is verified by its certificates' program: the cases and random models of ``checked``.

    python -m tests.search.certificates                     # the cases, and 25 models of each class
    python -m tests.search.certificates --class lure --models 100 --json certificates.json
    python -m tests.search.certificates --class lure --boxes 0.02   # factors of the model between 0.98 and 1.02

A "no" is a defect of the certificate; the status is then 1.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

import nsmodel
from nsmodel import check
from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.write import certificate_of
from nsmodel.modeling.model_files import case_files
from tests.parametrised import with_parameters

from .checked import MAKERS, draw

ANSWERS = ("yes", "no", "not checkable")

Row = dict[str, Any]


def answered(class_name: str, which: str | int, width: float = 0.0) -> Row:
    """The answers to the statements of one model, read back from JSON; with factors within ``width`` of 1, if it is not 0."""
    started = time.perf_counter()
    model = nsmodel.load(which) if class_name == "cases" else draw(class_name, int(which))
    boxes = {}
    if width:
        model = with_parameters(model.bind(), step=model.step)
        boxes = dict.fromkeys(model.parameters, (1 - width, 1 + width))
    certificate = json.loads(json.dumps(certificate_of(check(model, runs=[], parameters=boxes, quick=bool(width)))))
    written = time.perf_counter()
    answers = [(s["id"], ": ".join(verify.answer(certificate["model"], s))) for s in certificate["statements"]]
    return {"class": class_name, "model": which, "answers": answers, "kind": model.title,
            "seconds": written - started, "verified": time.perf_counter() - written}  # fmt: skip


def table(rows: Sequence[Row]) -> str:
    """Counts by class, by hypothesis, and by reason."""
    lines = []
    for name in [*dict.fromkeys(row["class"] for row in rows), "all"]:
        own = [(row, id, answer) for row in rows for id, answer in row["answers"] if name in (row["class"], "all")]
        count = Counter(answer.partition(":")[0] for *_, answer in own)
        lines += [f"{name}: {len(own)} that hold, " + ", ".join(f"{count[answer]} {answer}" for answer in ANSWERS)]
        for id in dict.fromkeys(id for _, id, _ in own) if name != "all" else ():
            of_id = Counter(answer.partition(":")[0] for _, other, answer in own if other == id)
            lines.append(f"  {id:12}" + "".join(f"{of_id[answer]:6d} {answer}" for answer in ANSWERS))
        reasons: dict[tuple[str, str], list[str | int]] = {}
        for row, id, answer in own if name != "all" else ():
            if not answer.startswith("yes"):
                reasons.setdefault((id, answer), []).append(row["model"])
        for (id, answer), models in sorted(reasons.items(), key=lambda item: -len(item[1])):
            lines.append(f"  {len(models):4d}  {id:12} {answer}  {models[:6]}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer the models asked for and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.search.certificates", description=__doc__,
                                     formatter_class=argparse.RawTextHelpFormatter)  # fmt: skip
    parser.add_argument("--class", dest="classes", action="append", choices=["cases", *MAKERS], help="one class; may be repeated")
    parser.add_argument("--models", type=int, default=25, help="models of each class")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--boxes", type=float, default=0.0, metavar="WIDTH", help="numbers of random models times 1 +- WIDTH")
    parser.add_argument("--json", type=Path, help="where every answer goes")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    seeds = range(given.first, given.first + given.models)
    cases = {name: nsmodel.load(name) for name in case_files()}
    stems = [stem for stem, model in cases.items() if not (model.inputs or model.blocks)]  # which have no certificates
    jobs = [(name, which) for name in given.classes or ["cases", *MAKERS] for which in (stems if name == "cases" else seeds)]
    rows = [answered(*job, given.boxes) for job in tqdm(jobs, leave=False, disable=not sys.stderr.isatty())]
    print(table(rows))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))
    return int(any(answer.startswith("no:") for row in rows for _, answer in row["answers"]))


if __name__ == "__main__":
    sys.exit(main())
