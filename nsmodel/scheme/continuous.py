"""A model in continuous time: what event-driven integration takes, one form for the classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import EmptyLawError, UsageError
from nsmodel.laws import Law
from nsmodel.laws.moving import LawEnds, find_invalid_row
from nsmodel.model.expressions import derivatives

TINY_SPEED = 1e-150  # Beside a size, that its derivatives are numbers where it is 0.


class NotEventDriven(UsageError):
    """A model that event-driven integration cannot take; says what of it."""


class SlipGrowth(NamedTuple):
    """Where block ``first`` (its first row) slips, f + g has factor(s) l in place of its l, s = |y|; factor(0) = 1."""

    first: int
    s: ca.SX
    factor: ca.SX


@dataclass(frozen=True)
class ContinuousProblem:
    """x' = f(t, x) + g(t, x, l),   y = h(t, x, l),   -y ∈ N_K(l),   x(0) = x0.

    Attributes:
        t, x, l, p: symbols; ``p``: parameters still symbolic.
        f, g: (n, 1), with the mass matrix divided out; g is what depends on l, and 0 without it where that can be told.
        h: (m, 1).
        law: K, made of boxes and curved sets.
        rows: the user's name of each row of l and y; names: of the states in x.
        x0: the start (n, 1).
        states: number of the first entries of x that are the model's states; of an oscillator the others are velocities.
        multipliers, outputs: l and y as the user declared them, expressions of t, x and l, where they differ; else None.
        declared: the names of these multipliers.
        ends: of the rows whose law moves, the set, expressions of t and x.
        records: further columns of a trajectory, expressions of t, x and l.
        growths: of the blocks whose l pushes with another force the faster they slip.
        held: number of the last entries of x that are inputs (see `driven`), set at known times; nothing acts on them.
        updates: what blocks that act after each step set next, expressions of t and x; updated: numbers of the entries of x that
            they set; updaters: the names of these blocks.
        impulses: whether the class's multipliers are the integrals of l over steps; l itself is then called reactions.
    """

    scheme: ClassVar[str] = "event-driven integration"
    t: ca.SX
    x: ca.SX
    l: ca.SX
    p: ca.SX
    f: ca.SX
    g: ca.SX
    h: ca.SX
    law: Law
    rows: tuple[str, ...]
    names: tuple[str, ...]
    x0: ca.SX
    states: int
    multipliers: ca.SX | None = None
    outputs: ca.SX | None = None
    declared: tuple[str, ...] = ()
    ends: tuple[LawEnds, ...] = ()
    records: Mapping[str, ca.SX] = field(default_factory=dict)
    growths: tuple[SlipGrowth, ...] = ()
    impulses: bool = False
    held: int = 0
    updates: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    updated: tuple[int, ...] = ()
    updaters: tuple[str, ...] = ()

    @property
    def sliding_law_names(self) -> tuple[str, ...]:
        """The blocks whose l, or what stands for it, moves while they slip: by the names of their laws, or of their rows."""
        curved = tuple(block.label for _, block in self.law.parts() if not block.separable)
        return curved + tuple(self.rows[growth.first] for growth in self.growths)

    @property
    def slopes(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """g_l, h_l, and h_x by the states that can be moved."""
        C, free = derivatives(self.h, self.x), self.x.numel() - self.held
        if self.held:
            C = ca.horzcat(C[:, :free], ca.SX(C.shape[0], self.held))
        return derivatives(self.g, self.l), derivatives(self.h, self.l), C

    @property
    def coupled(self) -> np.ndarray:
        """Which pairs of multipliers are coupled (m, m): g and h are affine in those together of which no two are."""
        B, D, _ = self.slopes
        by_l, m = ca.vertcat(B, D), self.l.numel()
        if not m or not ca.depends_on(by_l, self.l):
            return np.zeros((m, m), bool)
        found = np.array([ca.which_depends(by_l[:, i], self.l, 1, False) for i in range(m)], bool)
        return found | found.T

    @property
    def rate(self) -> ca.SX:
        """F + g as expressions of t, x and l, with the factors of `growths` in."""
        whole, l = self.f + self.g, self.l
        starts = {rows.start: rows for rows, _ in self.law.parts()}
        for growth in self.growths:
            own = starts[growth.first]
            size = ca.sqrt(ca.sumsqr(self.h[own]) + TINY_SPEED**2)
            whole = ca.substitute(whole, l[own], ca.substitute(growth.factor, growth.s, size) * l[own])
        return whole

    def empty(self, t: float, x: Sequence[float], after: float) -> EmptyLawError | None:
        """That a law that moves is no set at t, or in a short time ``after``; None where each is one."""
        if not self.ends:
            return None
        known, here = ca.vertcat(self.t, self.x), np.array([t, *x])
        rate = ca.Function("rate", [known], [ca.vertcat(1, self.f)])  # of t and inputs, which alone move the ends
        ahead = here + after * np.array(rate(here)).ravel()
        for values in (here, ahead):
            if (found := find_invalid_row(self.ends, known, values, float(values[0]))) is not None:
                return EmptyLawError(found.text, component=found.name)
        return None

    @property
    def columns(self) -> dict[str, ca.SX]:
        """The columns of a trajectory that are expressions of t, x and l: y, and those of the class."""
        return {"y": self.h if self.outputs is None else self.outputs, **self.records}
