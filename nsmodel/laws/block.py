"""What a factor of K says of itself: to solvers, to checks, to readers. One file a kind holds the answers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self

import casadi as ca
import numpy as np

from nsmodel.laws.moving import LawEnds
from nsmodel.pickled import Picklable

if TYPE_CHECKING:
    from nsmodel.laws.curved import CurvedSet
    from nsmodel.laws.law import Law

# What an index set shows, by code: -1 and +1 at ends, 0 where y = 0.
STATE_LOWER, STATE_ZERO, STATE_UPPER, STATE_NOTHING = "lower", "zero", "upper", "nothing"
StateNames = Mapping[int, tuple[str, str]]  # code: (one of the names above, words)


class Intervals(NamedTuple):
    """{lower <= l <= upper}, row by row."""

    lower: np.ndarray
    upper: np.ndarray


class RoundSet(NamedTuple):
    """{A w : |w| <= radius}, bounded, 0 inside; A (m, m) of fractions, None where it has none."""

    A: Any
    radius: Any


class SecondOrder(NamedTuple):
    """{|(l_2, ..., l_m)| <= l_1}."""

    size: int


class Halfspaces(NamedTuple):
    """{H l >= K}."""

    H: np.ndarray
    K: np.ndarray


ExactSet = Intervals | RoundSet | SecondOrder | Halfspaces


class RewrittenLaw(NamedTuple):
    """A set in terms of others: l = ``multipliers`` of the symbols ``l``, rows ``y`` of ``law`` with names.

    ``ends`` are those that move; ``scale`` (m, 1) is s of l = c + s l', None where no row has one.
    """

    law: Law
    l: ca.SX
    multipliers: ca.SX
    rows: tuple[str, ...]
    y: ca.SX
    ends: tuple[LawEnds, ...] = ()
    scale: ca.SX | None = None

    @property
    def differs(self) -> bool:
        """Whether the multipliers are others than l."""
        return self.multipliers.shape != self.l.shape or not ca.is_equal(self.multipliers, self.l)


class LatexNumberWriter(Protocol):
    """Writes numbers and matrices in LaTeX."""

    def number(self, expression: ca.SX) -> str:
        """A scalar."""
        ...

    def matrix(self, matrix: Any) -> str:
        """A matrix."""
        ...

    def column(self, numbers: Sequence[float] | np.ndarray) -> str:
        """A column of numbers."""
        ...

    def space(self, m: int) -> str:
        """R^m."""
        ...


@dataclass(frozen=True, eq=False)
class LawFactor(Picklable, ABC):
    """One closed convex factor of K in R^m, with the relation -y ∈ N_K(l).

    Attributes:
        kind: its name in files.
        separable: whether each row is a law of its own.
        strict: whether K is bounded and strictly convex, so that one l' in K has the least <l', y> for y != 0.
        label: what the user called for: "relay", "complementarity", ...
        size: number of components m.
    """

    kind: ClassVar[str]
    separable: ClassVar[bool] = False
    strict: ClassVar[bool] = False
    STATE_NAMES: ClassVar[Mapping[str, StateNames]]
    label: str
    size: int

    # -- data

    @property
    def numbers(self) -> dict[str, ca.SX]:
        """What may be an expression of parameters, t and inputs, by name."""
        return {}

    def moves(self, moving: ca.SX) -> list[bool]:
        """Of each component whether its set depends on ``moving``."""
        return [any(ca.depends_on(value, moving) for value in self.numbers.values())] * self.size

    def with_numbers(self, **numbers: ca.SX) -> Self:
        """The same with other numbers."""
        return replace(self, **numbers)

    @property
    def ends(self) -> tuple[ca.SX, ca.SX]:
        """(lower, upper), (m, 1) each: of the rows of a box, else infinite."""
        return -ca.SX.inf(self.size), ca.SX.inf(self.size)

    @abstractmethod
    def scaled(self, u: float) -> Self:
        """{u l : l ∈ K}, u > 0."""

    def invalidity_reason(self, given: str) -> str:
        """Why numbers that are constants make no set; else ''. ``given`` says of which parameters they are."""
        return ""

    # -- what solvers ask

    def curved(self) -> CurvedSet | None:
        """The set with its numbers, constants; None where it is a box."""
        return None

    def rewritten(self, y: ca.SX, names: tuple[str, ...], moving: ca.SX, *, guarded: bool = True) -> RewrittenLaw | None:
        """The same law in terms of basic ones, whose numbers do not depend on ``moving``; None where it is one.

        ``guarded``: the multipliers are NaN where a set that moves is none.
        """
        return None

    def c_numbers(self) -> ca.SX:
        """What the file of C of a curved set reads: constants, but for what parameters give."""
        return ca.SX(0, 1)

    # -- what checks ask; numbers are constants

    @abstractmethod
    def shape(self) -> ExactSet | None:
        """The set in exact terms; None where these cannot say it."""

    @property
    def width(self) -> float:
        """The narrowest width of a bounded set."""
        return np.inf

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """A box around K, rounded outwards."""
        return np.full(self.size, -np.inf), np.full(self.size, np.inf)

    # -- what an independent judge asks: the definition, and points to compare with

    @abstractmethod
    def excess(self, l: np.ndarray) -> np.ndarray:
        """How far rows l (N, m) are outside K, (N, k) >= 0 in the unit of l: 0 inside."""

    @abstractmethod
    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Points (k, N, m) of K, one of which has the least <l', y> at each row, or falls without end from l along it."""

    @property
    def extent(self) -> float:
        """The size of K where it is bounded, or of its finite ends: what an l on its boundary is measured beside."""
        return 0.0

    # -- what readers see

    @abstractmethod
    def latex(self, write: LatexNumberWriter) -> list[str]:
        """The sets whose product it is."""

    def latex_relation(self) -> str:
        """-y ∈ N_K(l) in the usual words, in LaTeX; '' where there are none."""
        return ""

    @abstractmethod
    def data(self) -> dict[str, Any]:
        """Its numbers by name, for certificates."""


def product_set(write: LatexNumberWriter, m: int, condition: str) -> str:
    """{lambda ∈ R^m : condition}."""
    return rf"\left\{{ \lambda \in {write.space(m)} : {condition} \right\}}"
