"""Laws: the relation -y ∈ N_K(l) between a multiplier l and its output y, for a closed convex set K."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.model.pickled import Pickled


@dataclass(frozen=True, eq=False)
class Block(Pickled):
    """One factor of K, of one kind.

    Attributes:
        kind: "box" {lower <= l <= upper}, "ball" {|l| <= upper[0]}, "cone" {|l[1:]| <= l[0]} or "polyhedron" {H l >= K}.
        label: what the user called for: "relay", "complementarity", ...
        size: number of components m.
        lower, upper: SX (m, 1), numbers or expressions of parameters; for a ball upper[0] is the radius.
        H, K: arrays (r, m) and (r,) of a polyhedron.
    """

    kind: str
    label: str
    size: int
    lower: ca.SX
    upper: ca.SX
    H: Any = None
    K: Any = None


@dataclass(frozen=True, eq=False)
class Law(Pickled):
    """A product of blocks: l and y are stacked in their order. Build it with the functions of this module."""

    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Number of components of l and y."""
        return sum(block.size for block in self.blocks)

    @property
    def lower(self) -> ca.SX:
        """Lower ends (m, 1); -inf on the components of balls, cones and polyhedra."""
        return ca.vertcat(ca.SX(0, 1), *(block.lower for block in self.blocks))

    @property
    def upper(self) -> ca.SX:
        """Upper ends (m, 1); +inf on cones and polyhedra, the radius on balls."""
        return ca.vertcat(ca.SX(0, 1), *(block.upper for block in self.blocks))

    @property
    def labels(self) -> list[str]:
        """The label of each component (m entries)."""
        return [block.label for block in self.blocks for _ in range(block.size)]


def equality(m: int) -> Law:
    """y = 0 with l free, m components."""
    return _boxes("equality", m, -np.inf, np.inf)


def complementarity(m: int) -> Law:
    """0 <= y ⟂ l >= 0, m components."""
    return _boxes("complementarity", m, 0, np.inf)


def relay(m: int, lower: Any = -1, upper: Any = 1) -> Law:
    """Relay: l = upper where y < 0, l = lower where y > 0, anything between where y = 0 (l ∈ -Sgn(y) for [-1, 1]).

    ``lower`` and ``upper`` are scalars or m values, numbers or expressions of parameters.
    """
    return _boxes("relay", m, lower, upper)


def box(lower: Any, upper: Any) -> Law:
    """-y ∈ N_[lower, upper](l); an infinite end is allowed on one or both sides. The longer argument gives m."""
    ends = {"lower": lower, "upper": upper}
    m = max(_entries("box", name, end).numel() for name, end in ends.items())
    return _boxes("box", m, lower, upper)


def ball(m: int, radius: Any = 1) -> Law:
    """-y ∈ N(l) for {|l| <= radius} in R^m: isotropic Coulomb friction; l = -radius y/|y| where y != 0."""
    m, r = _count("ball", m), _column("ball", "radius", radius, 1)
    if r.is_constant() and not 0 <= float(r) < np.inf:
        raise ModelError(f"ball: radius = {float(r):g} must be finite and not negative")
    if m == 1:
        return _boxes("relay", 1, -r, r)
    return Law((Block("ball", "ball", m, -ca.SX.inf(m), ca.repmat(r, m, 1)),))


def second_order_cone(m: int) -> Law:
    """K = {l : |(l_2, ..., l_m)| <= l_1}, self-dual: K ∋ l ⟂ y ∈ K. For m = 1 this is complementarity."""
    m = _count("second_order_cone", m)
    if m == 1:
        return complementarity(1)
    return Law((Block("cone", "second-order cone", m, -ca.SX.inf(m), ca.SX.inf(m)),))


def polyhedron(H: Any, K: Any) -> Law:
    """-y ∈ N(l) for {l : H l >= K}; H (r, m), K (r,), numbers."""
    try:
        if isinstance(H, ca.SX | ca.MX) or isinstance(K, ca.SX | ca.MX):
            raise TypeError
        h, k = np.atleast_2d(np.asarray(H)), np.ravel(np.asarray(K))
        if not {h.dtype.kind, k.dtype.kind} <= set("biuf"):
            raise TypeError
        h, k = h.astype(float), k.astype(float)
    except (TypeError, ValueError, RuntimeError):
        raise ModelError(f"polyhedron: H = {H!r}, K = {K!r}; expected numbers") from None
    if h.ndim != 2 or k.shape != (h.shape[0],):
        raise ModelError(f"polyhedron: H has shape {h.shape} and K {k.shape}; expected (r, m) and (r,) with the same r")
    if not (np.isfinite(h).all() and np.isfinite(k).all()):
        raise ModelError("polyhedron: H and K must be finite; leave a row out instead of making it infinite")
    m = h.shape[1]
    return Law((Block("polyhedron", "polyhedron", m, -ca.SX.inf(m), ca.SX.inf(m), h, k),))


def product(*laws: Law) -> Law:
    """Several laws side by side: l and y are stacked in the order given."""
    for position, law in enumerate(laws):
        if not isinstance(law, Law):
            raise ModelError(f"product: argument {position} is a {type(law).__name__}; expected a law such as relay(2)")
    return Law(tuple(block for law in laws for block in law.blocks))


def _boxes(label: str, m: int, lower: Any, upper: Any) -> Law:
    m = _count(label, m)
    lo, up = _column(label, "lower", lower, m), _column(label, "upper", upper, m)
    for i in range(m):
        a, b = lo[i], up[i]
        if not (a.is_constant() and b.is_constant()):
            continue
        a, b = float(a), float(b)
        if a > b:
            raise ModelError(f"{label}: lower[{i}] = {a:g} is above upper[{i}] = {b:g}; exchange them")
        if a == np.inf or b == -np.inf:
            raise ModelError(f"{label}: component {i} has the empty interval [{a:g}, {b:g}]; give lower < inf, upper > -inf")
    return Law((Block("box", label, m, lo, up),)) if m else Law(())


def _count(label: str, m: Any) -> int:
    if isinstance(m, bool) or not isinstance(m, int | np.integer) or m < 0:
        raise ModelError(f"{label}: the number of components must be a whole number >= 0, not {m!r}")
    return int(m)


def _entries(label: str, name: str, value: Any) -> ca.SX:
    """The numbers or expressions in ``value`` as a column."""
    try:
        if isinstance(value, ca.MX):
            raise TypeError
        column = ca.SX(value) if isinstance(value, ca.SX | ca.DM) else ca.vertcat(ca.SX(0, 1), *map(ca.SX, np.ravel(value)))
    except (NotImplementedError, OverflowError, TypeError, ValueError, RuntimeError):
        raise ModelError(f"{label}: {name} = {value!r}; expected a number, a list of numbers or a CasADi SX") from None
    return ca.densify(ca.vec(column))


def _column(label: str, name: str, value: Any, m: int) -> ca.SX:
    column = _entries(label, name, value)
    if column.numel() == 1 and m != 1:
        column = ca.repmat(column, m, 1)
    if column.numel() != m:
        raise ModelError(f"{label}: {name} has {column.numel()} values; expected {'1' if m == 1 else f'1 or {m}'}")
    for i in range(m):
        if column[i].is_constant() and np.isnan(float(column[i])):
            raise ModelError(f"{label}: {name}[{i}] is NaN; give a number or +-inf")
    return column
