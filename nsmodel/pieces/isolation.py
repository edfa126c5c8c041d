"""Roots that Newton's method does not settle: of high multiplicity, in clusters, and dips that may or may not come to 0.

A condition c >= 0 is known about a place as a form (see `discs`), |c(s) - sum c_k s^k| <= e on [0, R]: e holds what is cut off,
the rounding of its operations, and what rounding has left in the states. Up to the first s with c(s) - e = 0 it is proved to be
positive; expanded anew from there, on a shorter disc, it is the sum of less, and e is smaller. Where that stands still, the other
side is looked for: the first R with c(R) + e < 0 is beyond a crossing, one with c(R) - e > 0 beyond a touch, or beyond a dip that
is not decided.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nsmodel.pieces.bernstein import first_root, poly_value, poly_values, taylor_shift
from nsmodel.pieces.disc_equations import EquationsOnDisc
from nsmodel.pieces.discs import EPS, TaylorForm, form_of_polynomial
from nsmodel.pieces.modes import ULP, PieceStart
from nsmodel.pieces.multipliers import MultiplierSolver
from nsmodel.pieces.switches import (
    SwitchCondition,
    condition_argument,
    condition_uncertainty,
    has_own_row,
    is_same_condition,
    mode_conditions,
)
from nsmodel.pieces.system import ModeSystem

ALMOST = 0.999  # Of the way to where a sign is no longer proved.
CLOSER, WIDER = 8.0, 1.5  # By which discs shrink towards a root, and grow beyond it.
MAX_DISCS, MAX_MULTIPLICITY = 400, 8
DEGREE = 16  # Of forms at least: a root of high order in t alone is seen so at coarse tolerances, too.
NEAR = 0.1  # In units of time: an event is not sought further from where the piece's polynomials have it.


class IsolatedRoot(NamedTuple):
    """Where the place stands now: how it is expanded there, the condition, and whether that ends there.

    ``width``: of the time in which its sign is not known, at the crossing or in the longest dip, which is ``at`` that time;
    ``touches``: dips that were passed.
    """

    how: MultiplierSolver
    own: SwitchCondition | None
    width: float
    touches: int
    crosses: bool
    at: float


class RootIsolation:
    """Of the conditions of a system."""

    def __init__(self, system: ModeSystem, on: EquationsOnDisc) -> None:
        self._system, self._on = system, on

    def width(self, place: PieceStart, own: SwitchCondition, share: float) -> float:
        """The time about a crossing, whose expansion stands, in which the sign is not known where states are known to a share."""
        system = self._system
        of_disc, _ = self._condition_on_disc(place, own, own.orders, NEAR * place.tau)
        c, e = [a / NEAR**k for k, a in enumerate(of_disc.tolist())], condition_uncertainty(system, own, share)
        before = [-a if k % 2 else a for k, a in enumerate(c)]
        return (_distance_to_level([-a for a in c], e) + _distance_to_level(before, e)) * place.tau

    def isolate(
        self, place: PieceStart, hit: SwitchCondition, orders: int, expand: Callable[[int], MultiplierSolver], end: float,
        others: Callable[[MultiplierSolver, float], float],
    ) -> IsolatedRoot:  # fmt: skip
        """Move the place over what is proved to be positive, and over dips, to the first crossing, or to the time ``end``.

        ``others(how, s)``: where another condition ends, in s from the place and not beyond s; there the way ends too.
        """
        system, R, width, touches, at = self._system, end - place.t, 0.0, 0, place.t
        how = expand(orders)
        for _ in range(MAX_DISCS):
            R = min(R, end - place.t)
            own = current_condition(system, place, how, hit, orders)
            if own is None or not R > 0:
                break
            c, e = self._condition_on_disc(place, own, orders, R)
            s = _positive_until(c, e)
            if s is not None and (s == 0 or place.t + ALMOST * s * R == place.t):
                if R > ULP * abs(place.t):
                    R /= CLOSER
                    continue
                found = self._sign_beyond(place, own, orders, end)
                wide = end - place.t if found is None else found[0]
                width, at = max((width, at), (wide, place.t))
                R, root = (end - place.t, None) if found is None else found
                touches += root is None
                step = R if root is None else root
            else:
                root, step = None, R if s is None else ALMOST * s * R
                R = 2 * R if s is None else max(R / 4, 2 * step) if s < 0.5 else R / 2
            clear = others(how, step / place.tau) * place.tau
            how = self._advance_start(place, min(step, clear), orders, expand)
            if clear < step:
                break
            if root is not None:
                return IsolatedRoot(how, current_condition(system, place, how, hit, orders), R, touches, True, place.t)
        return IsolatedRoot(how, None, width, touches, False, at)

    def _sign_beyond(self, place: PieceStart, own: SwitchCondition, orders: int, end: float) -> tuple[float, float | None] | None:
        """How far on the sign is known again, and where on the way it changes, None where it does not.

        None: not up to the end.
        """
        R = ULP * abs(place.t) or ULP * place.tau
        while R < end - place.t:
            c, e = self._condition_on_disc(place, own, orders, R)
            if abs(v := float(c.sum())) > e:
                return R, None if v > 0 else R * _crossing_point(c.tolist(), e)
            R *= WIDER
        return None

    def _advance_start(
        self, place: PieceStart, time: float, orders: int, expand: Callable[[int], MultiplierSolver]
    ) -> MultiplierSolver:
        s = time / place.tau
        place.x = poly_values([row[: orders + 1] for row in self._system.x], s)
        place.t += time
        return expand(orders)

    def _condition_on_disc(self, place: PieceStart, own: SwitchCondition, orders: int, R: float) -> tuple[np.ndarray, float]:
        """The coefficients on the disc |s| <= R, R a time, of the condition, in s/R, and e."""
        system, R, degree = self._system, R / place.tau, max(orders, DEGREE)
        if has_own_row(system, own):
            f = form_of_polynomial(own.row[: own.orders + 1], R, own.orders)
        else:
            x, l = ([form_of_polynomial(row[: orders + 1], R, degree) for row in rows] for rows in (system.x, system.push))
            f = condition_argument(system, own, self._on(form_of_polynomial([place.t, place.tau], R, degree), x, l))
        if not isinstance(f, TaylorForm):
            f = form_of_polynomial([float(f)], R, orders)
        c = own.sign * f.c
        c[0] += own.shift
        return c, f.r + condition_uncertainty(system, own) + EPS * float(np.abs(c).sum())


def current_condition(
    system: ModeSystem, place: PieceStart, how: MultiplierSolver, hit: SwitchCondition, orders: int
) -> SwitchCondition | None:
    """The condition that watches the same end as ``hit``, as it stands now."""
    return next((c for c in mode_conditions(system, place.codes, how, orders) if is_same_condition(c, hit)), None)


def _crossing_point(c: list[float], e: float) -> float:
    """Where in [0, 1] a condition known to e, c(1) < -e, is 0.

    A root of order 3, 5, ... of one that is known to e alone is told best by the derivative that has a simple root there.
    """
    for order in range(min(len(c) - 2, MAX_MULTIPLICITY) // 2 * 2, 0, -2):
        d = [math.perm(k, order) * a for k, a in enumerate(c)][order:]
        if d[0] * sum(d) < 0:
            root = first_root(d if d[0] > 0 else [-a for a in d])
            if max(map(abs, taylor_shift(c, root)[:order])) <= e:
                return root
    return min(first_root(c), 1.0) if c[0] > 0 else 0.0


def _distance_to_level(c: list[float], level: float) -> float:
    """How far c goes until it is above a level, in doubling steps; NEAR where that is further."""
    s = ULP
    while s < NEAR and poly_value(c, s) <= level:
        s *= 2
    return min(s, NEAR)


def _positive_until(c: np.ndarray, e: float) -> float | None:
    """The first s in [0, 1] with sum c_k s^k = e; None where it is more on all of it."""
    row = c.tolist()
    row[0] -= e
    if not row[0] > 0:
        return 0.0
    s = first_root(row)
    return s if s <= 1 else None
