"""A law: the relation -y ∈ N_K(l) between a multiplier l and its output y, for a product K of closed convex sets.

What a factor of K says of itself: to solvers, to checks, to readers. One file a kind holds the answers.

The arguments of laws: counts, columns, arrays of numbers.

What solvers ask of a closed convex set K with one curved boundary, its numbers given.

Ends of a law that move, by a law whose ends stay.

-y ∈ N_[a, b](l) with a < b is l = c + s l', -y ∈ N_[a', b'](l') with numbers a', b' and the s > 0 that makes one interval of the
other: the normal cone at a point is that at its image. y stays as it is, in its unit and with its sign, so that a row is judged
as it was declared, and what is 0 is exactly 0; where a = b, s = 0 and l = a exactly, whatever y is, of which l' then has the
sign. A ball of radius r is l = r l' with l' in the unit ball. W = W_0 diag(s), of which diag(s) W has the sign of W_0.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, join_within_width
from nsmodel.errors import ModelError
from nsmodel.modeling.pickling import Picklable


def check_count(label: str, m: Any) -> int:
    """A number of components."""
    if isinstance(m, bool) or not isinstance(m, int | np.integer) or m < 0:
        raise ModelError(f"{label}: the number of components must be a whole number >= 0, not {m!r}")
    return int(m)


def read_entries(label: str, name: str, value: Any) -> ca.SX:
    """The numbers or expressions in ``value`` as a column."""
    try:
        if isinstance(value, ca.MX):
            raise TypeError
        column = ca.SX(value) if isinstance(value, ca.SX | ca.DM) else ca.vertcat(ca.SX(0, 1), *map(ca.SX, np.ravel(value)))
    except (NotImplementedError, OverflowError, TypeError, ValueError, RuntimeError):
        raise ModelError(f"{label}: {name} = {value!r}; expected a number, a list of numbers or a CasADi SX") from None
    return ca.densify(ca.vec(column))


def read_law_column(label: str, name: str, value: Any, m: int) -> ca.SX:
    """The same, m of them, or one for all; no NaN."""
    found = read_entries(label, name, value)
    if found.numel() == 1 and m != 1:
        found = ca.repmat(found, m, 1)
    if found.numel() != m:
        raise ModelError(f"{label}: {name} has {found.numel()} values; expected {'1' if m == 1 else f'1 or {m}'}")
    for i in range(m):
        if found[i].is_constant() and np.isnan(float(found[i])):
            raise ModelError(f"{label}: {name}[{i}] is NaN; give a number or +-inf")
    return found


def read_array(label: str, name: str, value: Any) -> np.ndarray:
    """An array of real numbers, not of expressions."""
    try:
        if isinstance(value, ca.SX | ca.MX):
            raise TypeError
        found = np.asarray(value)
        if found.dtype.kind not in "biuf":
            raise TypeError
        return found.astype(float)
    except (TypeError, ValueError, RuntimeError):
        raise ModelError(f"{label}: {name} = {value!r}; expected numbers") from None


class CurvedSet(ABC):
    """A closed convex set in R^m with one curved boundary: {c - l'S l >= 0}, with l_1 >= 0 where it is a cone.

    Attributes:
        kind: its name, and that of its file of C.
        is_cone: whether it is pointed at 0 and unbounded.
        radius: max |l| over K; inf where K is not bounded.
    """

    kind: ClassVar[str]
    is_cone: ClassVar[bool] = False
    radius: float

    @property
    def is_bounded(self) -> bool:
        """Whether K is bounded."""
        return math.isfinite(self.radius)

    @property
    def plural(self) -> str:
        """What messages call several of them."""
        return f"{self.kind}s"

    @property
    def is_normal_cone(self) -> bool:
        """Whether the law is -y ∈ N_K(l); else it is -ŷ(y) ∈ N_K(l)."""
        return True

    def shifted(self, y: np.ndarray) -> np.ndarray:
        """The output that the normal cone is taken at, (m,)."""
        return y

    def shift_jacobian(self, y: np.ndarray) -> np.ndarray:
        """An element of the generalised Jacobian of ŷ at y, (m, m)."""
        return np.eye(y.size)

    def boundary_ray(self, l: np.ndarray, y: np.ndarray) -> np.ndarray | None:
        """The ray of the boundary that l keeps to there, its first entry 1, where y_1 = 0 then; None: l is known otherwise."""
        return None

    def block_solution(self, W: np.ndarray, b: np.ndarray) -> np.ndarray | None:
        """The l of y = W l + b, -ŷ ∈ N_K(l), of this block alone, W (m, m); None: there is no direct way to it."""
        return None

    @abstractmethod
    def project(self, u: np.ndarray) -> np.ndarray:
        """The projection P_K(u) (m,)."""

    @abstractmethod
    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """An element of the generalised Jacobian of P_K at u, (m, m)."""

    @abstractmethod
    def code(self, u: np.ndarray) -> int:
        """Where P_K(u) lies, u = l - c y: 0 where y = 0, -1 where l = 0, +1 on the curved boundary."""

    @abstractmethod
    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """The l near this one that lies on the curved boundary."""

    @abstractmethod
    def support_point(self, y: np.ndarray) -> np.ndarray:
        """The l in K with -y ∈ N_K(l), y != 0; 0 where K is not bounded."""

    @abstractmethod
    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """(gap, rows): -y ∈ N_K(l) if and only if gap = 0 and rows >= 0; roots are smoothed by ``tiny``."""

    def slip(self, y: ca.SX) -> tuple[ca.SX, ca.SX] | None:
        """(l, sqrt(y'S^-1 y)) with -y ∈ N_K(l), y != 0, as expressions of y; None: its modes are not these and y = 0."""
        return None

    @abstractmethod
    def quadric(self, m: int) -> tuple[np.ndarray, float]:
        """(S, c), S (m, m)."""


def safe_norm(u: np.ndarray) -> float:
    """|u|, whose squares may overflow."""
    return math.hypot(*u)


class LawEnds(NamedTuple):
    """The set of row ``name``: [lower, upper], expressions, none where lower > upper; of a ball [0, radius]."""

    name: str
    lower: ca.SX
    upper: ca.SX

    @property
    def has_infinite_end(self) -> bool:
        """Whether one of them is infinite."""
        return any(_is_constant_number(end, value) for end, value in ((self.lower, -np.inf), (self.upper, np.inf)))


class InvalidLawRow(NamedTuple):
    """A row whose law is no set, and why."""

    name: str
    text: str


# Of the graphs in which an end is seen to be the negative of the other; deeper ones are two ends, which only costs a length.
NEGATION_DEPTH = 32


def fixed_ends(a: ca.SX, b: ca.SX, moving: ca.SX, *, guarded: bool) -> tuple[ca.SX, ca.SX, float, float]:
    """(c, s, a', b') of the interval [a, b], one end at least an expression of ``moving``.

    l' = 0 where l is 0 if [a, b] is [-b, b] or one end is 0: what counts as small beside multipliers (see `solvers.residuals`)
    is then what it was. ``guarded``: where b < a for some values s is NaN, and no step passes.
    """
    zero, one = ca.SX(0), ca.SX(1)
    if _is_constant_number(b, np.inf):
        return a, one, 0.0, np.inf
    if _is_constant_number(a, -np.inf):
        return b, one, -np.inf, 0.0
    if ca.is_equal(a, -b, NEGATION_DEPTH) or ca.is_equal(-a, b, NEGATION_DEPTH):
        return zero, interval_length(zero, b, guarded=guarded), -1.0, 1.0
    s = interval_length(a, b, guarded=guarded)
    if not ca.depends_on(a, moving):
        return a, s, 0.0, 1.0
    if not ca.depends_on(b, moving):
        return b, s, -1.0, 0.0
    return (a + b) / 2, s / 2, -1.0, 1.0


def interval_length(a: ca.SX, b: ca.SX, *, guarded: bool) -> ca.SX:
    """B - a; where that is < 0, if ``guarded``, NaN."""
    return ca.if_else(a <= b, b - a, np.nan) if guarded else b - a


def find_invalid_row(ends: Sequence[LawEnds], symbols: ca.SX, values: np.ndarray, t: float) -> InvalidLawRow | None:
    """The first of the ``ends`` that make no set at time t; None where each makes one.

    ``values``: of the symbols that they are expressions of.
    """
    columns = ca.vertcat(ca.SX(0, 2), *(ca.horzcat(end.lower, end.upper) for end in ends))
    at = np.array(ca.Function("ends", [symbols], [ca.densify(columns)])(values)).reshape(-1, 2)
    for end, (low, high) in zip(ends, at, strict=True):
        where = f"the law of '{end.name}' at t = {t:.10g}"
        for value, own in ((low, end.lower), (high, end.upper)):
            if not (np.isfinite(value) or own.is_constant()):
                return InvalidLawRow(end.name, f"{where}: an end is {value:g}; an end that moves is a finite number")
        if low > high:
            text = f"its lower end, {low:.10g}, is above its upper end, {high:.10g}; keep lower <= upper at all times of the run"
            return InvalidLawRow(end.name, f"{where}: {text}")
    return None


def _is_constant_number(end: ca.SX, value: float) -> bool:
    return end.is_constant() and float(end) == value


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
    """The polyhedron {l: H l >= K}."""

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
        """A scalar expression in LaTeX."""
        ...

    def matrix(self, matrix: Any) -> str:
        """A matrix in LaTeX."""
        ...

    def column(self, numbers: Sequence[float] | np.ndarray) -> str:
        """A column of numbers."""
        ...

    def space(self, m: int) -> str:
        """The space R^m in LaTeX."""
        ...


@dataclass(frozen=True, eq=False)
class LawFactor(Picklable, ABC):
    """One closed convex factor of K in R^m, with the relation -y ∈ N_K(l).

    Attributes:
        kind: its name in files.
        separable: whether each row is a law of its own.
        strict: whether K is bounded and strictly convex, so that one l' in K has the least <l', y> for y != 0.
        is_normal_cone: whether the law is -y ∈ N_K(l), which is monotone; see `CurvedSet`.
        label: what the user called for: "relay", "complementarity", ...
        size: number of components m.
    """

    kind: ClassVar[str]
    separable: ClassVar[bool] = False
    strict: ClassVar[bool] = False
    is_normal_cone: ClassVar[bool] = True
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

    def shifted(self, y: np.ndarray) -> np.ndarray:
        """The ŷ (N, m) with -ŷ ∈ N_K(l): y itself where the law is a normal cone."""
        return y

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


@dataclass(frozen=True, eq=False, repr=False)
class Law(Picklable):
    """A product of blocks: l and y are stacked in their order. Build it with the functions of this package."""

    blocks: tuple[LawFactor, ...]

    def __post_init__(self) -> None:
        """Refuse what is no kind of set.

        Raises:
            ModelError: a block that is none of a kind of this package.
        """
        for block in self.blocks:
            if not isinstance(block, LawFactor):
                raise ModelError(f"law: {block!r} is not a set of a known kind")

    @property
    def description(self) -> str:
        """The kinds of its blocks with their sizes: "relay 2, ball 3"."""
        runs: list[tuple[str, int]] = []
        for block in self.blocks:
            before = runs.pop()[1] if runs and runs[-1][0] == block.label else 0
            runs.append((block.label, before + block.size))
        return join_within_width([f"{label} {size}" for label, size in runs], 80)

    def __repr__(self) -> str:
        """Return one line: the kinds of its blocks with their sizes."""
        return f"Law({self.description})"

    @property
    def size(self) -> int:
        """Number of components of l and y."""
        return sum(block.size for block in self.blocks)

    @property
    def lower(self) -> ca.SX:
        """Lower ends (m, 1); -inf on all components but those of boxes."""
        return ca.vertcat(ca.SX(0, 1), *(block.ends[0] for block in self.blocks))

    @property
    def upper(self) -> ca.SX:
        """Upper ends (m, 1); inf on all components but those of boxes."""
        return ca.vertcat(ca.SX(0, 1), *(block.ends[1] for block in self.blocks))

    @property
    def numbers(self) -> ca.SX:
        """All that may be an expression of parameters, as a column."""
        return ca.vertcat(ca.SX(0, 1), *(ca.vec(value) for block in self.blocks for value in block.numbers.values()))

    @property
    def labels(self) -> list[str]:
        """The label of each component (m entries)."""
        return [block.label for block in self.blocks for _ in range(block.size)]

    @property
    def is_normal_cone(self) -> bool:
        """Whether each block is -y ∈ N_K(l)."""
        return all(block.is_normal_cone for block in self.blocks)

    @property
    def is_box(self) -> bool:
        """Whether each component is a law of its own."""
        return all(block.separable for block in self.blocks)

    def put(self, symbols: ca.SX, values: ca.SX) -> Law:
        """The law with values in place of symbols."""

        def other(block: LawFactor) -> LawFactor:
            if not any(block.moves(symbols)):
                return block
            return block.with_numbers(**{name: ca.substitute(value, symbols, values) for name, value in block.numbers.items()})

        return Law(tuple(map(other, self.blocks)))

    def moves(self, moving: ca.SX) -> list[bool]:
        """Of each component (m entries) whether its set depends on ``moving``."""
        return [row for block in self.blocks for row in block.moves(moving)]

    def at_rest(self, moving: ca.SX) -> Law:
        """The law with numbers of the same kind, bounded or not, in place of what depends on ``moving``."""
        found = []
        for block in self.blocks:
            other = block.rewritten(ca.SX.sym("y", block.size), ("",) * block.size, moving) if any(block.moves(moving)) else None
            found += (block,) if other is None else other.law.blocks
        return Law(tuple(found))

    def ends(self, names: tuple[str, ...], moving: ca.SX) -> tuple[LawEnds, ...]:
        """The ends of each row, one of ``names`` each, that depend on ``moving``."""
        found: list[LawEnds] = []
        for rows, block in self.parts():
            other = block.rewritten(ca.SX.sym("y", block.size), tuple(names[rows]), moving) if any(block.moves(moving)) else None
            found += () if other is None else other.ends
        return tuple(found)

    def parts(self) -> list[tuple[slice, LawFactor]]:
        """The rows of each block."""
        found, at = [], 0
        for block in self.blocks:
            found.append((slice(at, at + block.size), block))
            at += block.size
        return found


@checks_keywords
def product(*laws: Law) -> Law:
    """Several laws side by side: l and y are stacked in the order given.

    Args:
        laws: what is stacked, `Law` each.

    Raises:
        ModelError: something that is no law.
    """
    for position, law in enumerate(laws):
        if not isinstance(law, Law):
            raise ModelError(f"product: argument {position} is a {type(law).__name__}; expected a law such as relay(2)")
    return Law(tuple(block for law in laws for block in law.blocks))
