"""How often the checker leaves a hypothesis undecided on the random models of ``checked``.

    python -m tests.search.rates                                  # 500 models of each class, 100 of many bodies
    python -m tests.search.rates --class inclusion --models 50
    python -m tests.search.rates --json rates.json                # with every verdict and how it was found
    python -m tests.search.rates --show inclusion:7               # one model and its report

No run is made: a hypothesis is decided on the expressions and on the box around the start.
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

from nsmodel import check
from nsmodel.hypotheses.findings import RUN_FINDING_PREFIX, SAMPLED, UNKNOWN, VERDICTS

from .checked import MAKERS, draw, text

FEWER = {"bodies": 5}  # So many times fewer models of a class that is dear.

Row = dict[str, Any]


def decided(class_name: str, seed: int) -> Row:
    """The verdicts on one model, or what went wrong; and the seconds that it took."""
    started = time.perf_counter()
    row: Row = {"class": class_name, "seed": seed}
    try:
        model = draw(class_name, seed)
        row["kind"] = model.title
        findings = check(model, runs=[], quick=False).findings
        row["findings"] = {
            finding.id: {"verdict": finding.verdict, "how": finding.how}
            for finding in findings
            if not finding.id.startswith(RUN_FINDING_PREFIX)
        }
    except Exception as error:  # whatever it is, the others are looked at
        row["crash"] = f"{type(error).__name__}: {error}"
    return {**row, "seconds": round(time.perf_counter() - started, 3)}


def table(rows: Sequence[Row]) -> str:
    """Counts and parts of each verdict, the crashes and the slowest check, class by class."""
    lines = []
    for name in dict.fromkeys(row["class"] for row in rows):
        own = [row for row in rows if row["class"] == name]
        slowest = max(own, key=lambda row: row["seconds"])
        seconds = sum(row["seconds"] for row in own)
        lines += [
            f"{name}: {len(own)} models, {seconds / len(own):.2f} s a check, the slowest {slowest['seconds']:.1f} s "
            f"({name}:{slowest['seed']}, {slowest.get('kind', '')})",
            f"  {'':12}" + "".join(f"{verdict:>17}" for verdict in VERDICTS) + f"{'undecided':>12}",
        ]
        counts: dict[str, Counter[str]] = {}
        for row in own:
            for id, finding in row.get("findings", {}).items():
                counts.setdefault(id, Counter())[finding["verdict"]] += 1
        for id, count in counts.items():
            total = count.total()
            parts = "".join(f"{count[verdict]:9d} {100 * count[verdict] / total:5.1f} %" for verdict in VERDICTS)
            lines.append(f"  {id:12}{parts}{100 * (count[UNKNOWN] + count[SAMPLED]) / total:10.1f} %")
        crashes = [f"  crash {name}:{row['seed']}: {row['crash']}" for row in own if "crash" in row]
        lines += [*(crashes or ["  no crash"]), ""]
    every = [finding["verdict"] for row in rows for finding in row.get("findings", {}).values()]
    open_ones = sum(verdict in (SAMPLED, UNKNOWN) for verdict in every)
    lines.append(f"all: {len(every)} verdicts, {100 * open_ones / max(len(every), 1):.2f} % undecided")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Decide the models asked for and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.rates", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--class", dest="classes", action="append", choices=list(MAKERS), help="one class; may be repeated")
    parser.add_argument("--models", type=int, default=500, help="models of each class (of many bodies a fifth of them)")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--json", type=Path, help="where every verdict goes")
    parser.add_argument("--show", metavar="CLASS:SEED", help="one model and its report")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    if given.show:
        name, seed = given.show.split(":")
        model = draw(name, int(seed))
        print(text(model), check(model, runs=[], quick=False).text(), sep="\n\n")
        return 0
    jobs = [
        (name, seed)
        for name in given.classes or MAKERS
        for seed in range(given.first, given.first + max(given.models // FEWER.get(name, 1), 1))
    ]
    rows = [decided(*job) for job in tqdm(jobs, leave=False, disable=not sys.stderr.isatty())]
    print(table(rows))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
