"""The exact sign of a constraint at the start, in rational arithmetic on the given doubles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

import casadi as ca
import numpy as np

from nsmodel.hypotheses.sweeping.constraint import Constraint
from nsmodel.hypotheses.sweeping.forms import Affine, Clip, Offset

ROUNDED = 1e-12  # A deficit below this part of the terms of a constraint may be the rounding of the user's own numbers.


def start_value(c: Constraint, q0: np.ndarray) -> int | None:
    """Return the sign of g(0, q0), exactly; None where its form does not tell.

    A distance w |u| - r has the sign of w^2 |u|^2 - r^2 where r >= 0.
    """
    form = c.shape.form
    if form is None or len(form.norms) > 1:
        return None
    q = {i: Fraction(float(q0[i])) for i in c.shape.own}
    rest, squares = _value(form.affine, q, c), _squares(form.squares, q, c)
    if rest is None or squares is None:
        return None
    total = rest + squares
    if form.norms:
        w, under = form.norms[0]
        u2 = _squares(under, q, c)
        if u2 is None or w < 0:
            return None
        return 1 if total >= 0 else _sign(w * w * u2 - total * total)
    return _sign(total)


def _sign(x: Fraction) -> int:
    return (x > 0) - (x < 0)


def _squares(squares: Sequence[tuple[Fraction, Affine]], q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    total = Fraction(0)
    for w, a in squares:
        value = _value(a, q, c)
        if value is None:
            return None
        total += w * value * value
    return total


def _value(a: Affine, q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    total = _offset(a.offset, c)
    for i, coefficient in a.row.items():
        part = q[i] if i >= 0 else _clipped(c.shape.clips[i], q, c)
        if part is None or total is None:
            return None
        total += coefficient * part
    return total


def _clipped(clip: Clip, q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    value = _value(clip.a, q, c)
    if value is None:
        return None
    value = value if clip.low is None else max(value, clip.low)
    return value if clip.high is None else min(value, clip.high)


def _offset(offset: Offset, c: Constraint) -> Fraction | None:
    """An offset at t = 0 where it folds to a number whose operations are exact there: sin 0, cos 0, exp 0."""
    if isinstance(offset, Fraction):
        return offset
    low, high = _at_zero(offset, c.t)
    return Fraction(low) if low == high else None


def _at_zero(offset: ca.SX, t: ca.SX) -> tuple[float, float]:
    from nsmodel.proof.interval import enclose

    low, high = enclose(offset, t, np.zeros(1), np.zeros(1))
    return float(np.ravel(low)[0]), float(np.ravel(high)[0])
