"""A system's f, g and h, and what its branches look at, on a disc: of t, x and l as balls or forms (see `discs`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nsmodel.pieces.discs import DiscBall, DiscEvaluator, TaylorForm

if TYPE_CHECKING:
    from nsmodel.pieces.system import ModeSystem


class DiscValues(NamedTuple):
    """``rate``: f + g; ``free``: f alone where g = B l, else f + g; ``y``: h; ``looked``: of each branch of the system."""

    rate: list[Any]
    free: list[Any]
    y: list[Any]
    looked: list[Any]


class EquationsOnDisc:
    """The equations of a system, on the sides of its branches that it stands on."""

    def __init__(self, system: ModeSystem, *, rounded: bool = False) -> None:
        """``rounded``: see `DiscEvaluator`."""
        self._system = system
        self._parts = {
            name: DiscEvaluator(system.jets[name], part.choice, rounded=rounded) for name, part in system.parts.items()
        }

    def __call__(self, t: Any, x: Sequence[Any], l: Sequence[Any]) -> DiscValues:
        """All of them."""
        system, given = self._system, _input_table(t, x, l)
        found = {name: part(given) for name, part in self._parts.items()}
        free = found["f"][0]
        rate = (
            [a + b for a, b in zip(free, found["g"][0], strict=True)] if "g" in found else add_multiplier_terms(free, system.B, l)
        )
        y = found["h"][0] if system.D is None else add_multiplier_terms(found["h"][0], system.D, l)
        looked = [found[name][1][i] for name, i in system.branches]
        return DiscValues(rate, rate if "g" in found else free, y, looked)

    def f(self, t: Any, x: Sequence[Any], l: Sequence[Any]) -> list[Any]:
        """F alone."""
        return self._parts["f"](_input_table(t, x, l))[0]

    def watched(self) -> list[list[float]]:
        """The rows of the system that branches look at."""
        system = self._system
        return [system.parts[name].rows[system.jets[name].branches[i].row] for name, i in system.branches]


def _input_table(t: Any, x: Sequence[Any], l: Sequence[Any]) -> dict[tuple[int, int], Any]:
    given: dict[tuple[int, int], Any] = {(0, 0): t}
    return given | {(1, i): one for i, one in enumerate(x)} | {(2, i): one for i, one in enumerate(l)}


def add_multiplier_terms(of: list[Any], B: Any, l: Sequence[Any]) -> list[Any]:
    """What multipliers make of it: of + B l."""
    out = list(of)
    for i, j in zip(*np.nonzero(B), strict=True):
        out[i] = l[j] * float(B[i, j]) + out[i]
    return out


def linear_combination(row: np.ndarray, of: Sequence[Any]) -> Any:
    """The sum of so much of each."""
    total: Any = 0.0
    for a, one in zip(row.tolist(), of, strict=True):
        if a:
            total = one * a + total
    return total


def remainder_radius(of: Any) -> float:
    """What of a disc is not a coefficient; of a number, which depends on nothing, 0."""
    return of.r if isinstance(of, DiscBall | TaylorForm) else 0.0 if of == of else math.inf


def error_ratio(bound: float, most: float) -> float:
    """How much of what it may be a bound is."""
    return 0.0 if bound == 0 else bound / most if most > 0 and bound == bound else math.inf
