"""Boxes {lower <= l <= upper}: complementarity, relays, equalities, saturations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.laws.base import (
    STATE_LOWER,
    STATE_NOTHING,
    STATE_UPPER,
    STATE_ZERO,
    Intervals,
    LatexNumberWriter,
    Law,
    LawEnds,
    LawFactor,
    RewrittenLaw,
    StateNames,
    check_count,
    fixed_ends,
    read_entries,
    read_law_column,
)


@dataclass(frozen=True, eq=False)
class Box(LawFactor):
    """{lower <= l <= upper}; ``lower`` and ``upper`` (m, 1), numbers or expressions of parameters, t and inputs."""

    kind: ClassVar[str] = "box"
    separable: ClassVar[bool] = True
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {
        "complementarity": {-1: (STATE_NOTHING, "open (l = 0)"), 0: (STATE_ZERO, "contact (y = 0)")},
        "relay": {
            -1: (STATE_LOWER, "l at lower"),
            0: (STATE_ZERO, "stick or sliding mode (y = 0)"),
            1: (STATE_UPPER, "l at upper"),
        },
        "box": {-1: (STATE_LOWER, "l at lower"), 0: (STATE_ZERO, "l between its bounds (y = 0)"), 1: (STATE_UPPER, "l at upper")},
        "equality": {0: (STATE_ZERO, "equality (y = 0)")},
    }
    lower: ca.SX
    upper: ca.SX

    __repr__ = short_repr

    @property
    def numbers(self) -> dict[str, ca.SX]:
        """Both ends by their names."""
        return {"lower": self.lower, "upper": self.upper}

    @property
    def ends(self) -> tuple[ca.SX, ca.SX]:
        """The ends as declared."""
        return self.lower, self.upper

    def moves(self, moving: ca.SX) -> list[bool]:
        """Whether an end moves, row by row."""
        if not ca.depends_on(ca.vertcat(*self.ends), moving):
            return [False] * self.size
        return [ca.depends_on(ca.vertcat(*ends), moving) for ends in zip(*map(ca.vertsplit, self.ends), strict=True)]

    def rows(self, own: Sequence[int]) -> Box:
        """Some of the rows."""
        return Box(self.label, len(own), self.lower[list(own)], self.upper[list(own)])

    def scaled(self, u: float) -> Box:
        """Both ends times u."""
        return Box(self.label, self.size, u * self.lower, u * self.upper)

    def invalidity_reason(self, given: str) -> str:
        """An empty interval."""
        for i, (a, b) in enumerate(zip(ca.vertsplit(self.lower), ca.vertsplit(self.upper), strict=True)):
            if a.is_constant() and b.is_constant() and not float(a) <= float(b):
                return f"{self.label} has lower[{i}] = {float(a):g} above upper[{i}] = {float(b):g}{given}"
        return ""

    def rewritten(self, y: ca.SX, names: tuple[str, ...], moving: ca.SX, *, guarded: bool = True) -> RewrittenLaw | None:
        """Rows whose ends move by l = c + s l' with l' in an interval that stays; y as it is."""
        own = [i for i, moves in enumerate(self.moves(moving)) if moves]
        if not own:
            return None
        l, lower, upper = ca.SX.sym("l", self.size), ca.SX(self.lower), ca.SX(self.upper)
        whole, scale, ends = ca.SX(l), ca.SX.ones(self.size), []
        for i in own:
            c, scale[i], lower[i], upper[i] = fixed_ends(self.lower[i], self.upper[i], moving, guarded=guarded)
            whole[i] = c + scale[i] * l[i]
            ends.append(LawEnds(names[i], self.lower[i], self.upper[i]))
        return RewrittenLaw(Law((replace(self, lower=lower, upper=upper),)), l, whole, names, y, tuple(ends), scale)

    def shape(self) -> Intervals:
        """The box as an exact set."""
        return Intervals(*self._end_numbers())

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """The box is its own bounding box."""
        return self._end_numbers()

    def excess(self, l: np.ndarray) -> np.ndarray:
        """How far l lies beyond an end, row by row."""
        lower, upper = self._end_numbers()
        return np.maximum(np.maximum(lower - l, l - upper), 0)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One row after the other at that of its ends where <l', y> is least; far out where there is none."""
        lower, upper = self._end_numbers()
        inside, far = np.clip(l, lower, upper), 1 + np.abs(l)
        low, high = np.where(np.isfinite(lower), lower, inside - far), np.where(np.isfinite(upper), upper, inside + far)
        end, found = np.where(y > 0, low, high), np.repeat(inside[None], self.size, axis=0)
        for i in range(self.size):
            found[i, :, i] = end[:, i]
        return found

    @property
    def extent(self) -> float:
        """The largest finite end."""
        both = np.concatenate(self._end_numbers())
        return float(np.abs(both[np.isfinite(both)]).max(initial=0.0))

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """An interval a row."""
        ends = zip(map(write.number, ca.vertsplit(self.lower)), map(write.number, ca.vertsplit(self.upper)), strict=True)
        return [_interval_latex(low, high) for low, high in ends]

    def latex_relation(self) -> str:
        """Where all rows are the same."""
        ends = {(str(low), str(high)) for low, high in zip(self.lower.nonzeros(), self.upper.nonzeros(), strict=True)}
        index = "" if self.size == 1 else "_i"
        simple = {
            ("0", "inf"): rf"0 \leq y{index} \perp \lambda{index} \geq 0",
            ("-inf", "inf"): rf"y{index} = 0",
            ("-1", "1"): rf"\lambda{index} \in -\mathrm{{Sgn}}\left(y{index}\right)",
        }
        return simple.get(ends.pop(), "") if len(ends) == 1 else ""

    def data(self) -> dict[str, Any]:
        """Both ends for reports."""
        return {"lower": self.lower, "upper": self.upper}

    def _end_numbers(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(ca.DM(self.lower)).ravel(), np.array(ca.DM(self.upper)).ravel()


def _interval_latex(low: str, high: str) -> str:
    if (low, high) == (r"-\infty", r"\infty"):
        return r"\mathbb{R}"
    left, right = ("(" if low == r"-\infty" else "["), (")" if high == r"\infty" else "]")
    return rf"\left{left}{low},\ {high}\right{right}"


@checks_keywords
def equality(m: int) -> Law:
    """y = 0 with l free, m components."""
    return make_box_law("equality", m, -np.inf, np.inf)


@checks_keywords
def complementarity(m: int) -> Law:
    """0 <= y ⟂ l >= 0, m components."""
    return make_box_law("complementarity", m, 0, np.inf)


@checks_keywords
def relay(m: int, lower: Any = -1, upper: Any = 1) -> Law:
    """Relay: l = upper where y < 0, l = lower where y > 0, anything between where y = 0 (l ∈ -Sgn(y) for [-1, 1]).

    ``lower`` and ``upper`` are scalars or m values, numbers or expressions of parameters, t and inputs.
    """
    return make_box_law("relay", m, lower, upper)


@checks_keywords
def box(lower: Any, upper: Any) -> Law:
    """-y ∈ N_[lower, upper](l); an infinite end is allowed on one or both sides. The longer argument gives m.

    Ends are numbers or expressions of parameters, t and inputs.
    """
    ends = {"lower": lower, "upper": upper}
    m = max(read_entries("box", name, end).numel() for name, end in ends.items())
    return make_box_law("box", m, lower, upper)


def make_box_law(label: str, m: int, lower: Any, upper: Any) -> Law:
    """A box with the label."""
    m = check_count(label, m)
    lo, up = read_law_column(label, "lower", lower, m), read_law_column(label, "upper", upper, m)
    for i in range(m):
        a, b = lo[i], up[i]
        if not (a.is_constant() and b.is_constant()):
            continue
        a, b = float(a), float(b)
        if a > b:
            raise ModelError(f"{label}: lower[{i}] = {a:g} is above upper[{i}] = {b:g}; {_correction_hint(label, m, a, b)}")
        if a == np.inf or b == -np.inf:
            raise ModelError(f"{label}: component {i} has the empty interval [{a:g}, {b:g}]; give lower < inf, upper > -inf")
    return Law((Box(label, m, lo, up),)) if m else Law(())


def _correction_hint(label: str, m: int, lower: float, upper: float) -> str:
    """What was meant: of a relay the one number F that was given, ``relay(m, F)``, is F to both sides."""
    return f"for -F <= l <= F write relay({m}, {-lower:g}, {lower:g})" if label == "relay" and upper == 1 else "exchange them"
