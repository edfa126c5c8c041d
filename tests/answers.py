"""Answers of cases as digests, in a process of its own: ``python tests/answers.py [--compensated] CASE ...`` prints them as JSON.

With ``--compensated`` the ``sum`` of floats is that of Python 3.12 and later, in whatever Python this is, and the lines of
nsmodel that call it with two floats are printed too.
"""

from __future__ import annotations

import builtins
import hashlib
import itertools
import json
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

# Of six classes. The bits of the first two change with the first sum of floats that is compensated.
CASES = (
    "tumbler", "voltage_doubler", "bouncing_ball", "inclusion_8_2", "twisting", "friction_oscillator", "moving_disc",
    "repressilator", "two_masses", "zener_limiter",
)  # fmt: skip
T_END = {
    "bouncing_ball": 0.4, "friction_oscillator": 2.0, "repressilator": 2.0, "twisting": 0.5, "voltage_doubler": 3e-3,
    "zener_limiter": 0.01,
}  # fmt: skip
WITHOUT_EVENTS = ("bouncing_ball",)  # Whose impacts change the speed at once.


def compensated_sum(numbers: Iterable[Any], /, start: Any = 0) -> Any:
    """``sum`` as it is from Python 3.12 on: by Neumaier's method, as long as there are floats alone."""
    total, lost = start, 0.0
    for number in numbers:
        rounded = total + number
        if type(total) is float and type(number) is float:
            lost += (total - rounded) + number if abs(total) >= abs(number) else (number - rounded) + total
        elif lost and math.isfinite(lost):
            rounded, lost = total + lost + number, 0.0
        total = rounded
    return total + lost if lost and math.isfinite(lost) else total


class RecordedSum:
    """The compensated sum, and who calls it with floats."""

    def __init__(self) -> None:
        self.callers: set[str] = set()

    def __call__(self, numbers: Iterable[Any], /, start: Any = 0) -> Any:
        numbers = [*numbers]
        caller = sys._getframe(1)
        if [type(number) for number in (start, *numbers)].count(float) > 1 and "nsmodel" in Path(caller.f_code.co_filename).parts:
            self.callers.add(f"{caller.f_code.co_filename}:{caller.f_lineno}")
        return compensated_sum(numbers, start)


def answers(cases: Iterable[str]) -> dict[str, str]:
    """{"case, how": digest}: the bytes of all arrays of runs by steps and by events, the text of `check`."""
    import nsmodel
    from nsmodel.modeling.model_files import case_files

    found = {}
    for name in cases:
        model = nsmodel.load(case_files()[name])
        ways = {"steps": {}} if name in WITHOUT_EVENTS else {"steps": {}, "events": {"rtol": 1e-9}}
        for how, options in ways.items():
            run = nsmodel.simulate(model, t_end=T_END.get(name, model.t_end), compiled=False, **options)
            columns = ((key.encode(), run.arrays[key].tobytes()) for key in sorted(run.arrays))
            found[f"{name}, {how}"] = digest(*itertools.chain.from_iterable(columns))
        found[f"{name}, check"] = digest(json.dumps(nsmodel.check(model).document(), sort_keys=True).encode())
    return found


def digest(*parts: bytes) -> str:
    """One for all parts."""
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


if __name__ == "__main__":
    if recorded := RecordedSum() if "--compensated" in sys.argv else None:
        builtins.sum = recorded
    cases = [name for name in sys.argv[1:] if name in CASES]
    print(json.dumps({"answers": answers(cases), "callers": sorted(recorded.callers) if recorded else []}))
