"""The exact sign and gradient of a constraint at a point, in rational arithmetic on the given doubles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from nsmodel.classes.sweeping.hypotheses.constraint import Constraint
from nsmodel.classes.sweeping.hypotheses.forms import AffineForm, Clip, Offset
from nsmodel.proof.interval_bounds import enclose

ROUNDING_DEFICIT = 1e-12  # A deficit below this part of the terms of a constraint may be the rounding of the user's own numbers.


def start_sign(c: Constraint, q0: np.ndarray) -> int | None:
    """Return the sign of g(0, q0), exactly; None where its form does not tell."""
    return sign_at(c, 0.0, {i: Fraction(float(q0[i])) for i in c.shape.own})


def sign_at(c: Constraint, t: float, q: Mapping[int, Fraction]) -> int | None:
    """Return the sign of g(t, q), exactly; None where its form does not tell.

    A distance w |u| - r has the sign of w^2 |u|^2 - r^2 where r >= 0.
    """
    form = c.shape.form
    if form is None or len(form.norms) > 1:
        return None
    rest, squares = _exact_affine_value(form.affine, t, q, c), _exact_squares(form.squares, t, q, c)
    if rest is None or squares is None:
        return None
    total = rest + squares
    if form.norms:
        w, under = form.norms[0]
        u2 = _exact_squares(under, t, q, c)
        if u2 is None or w < 0:
            return None
        return 1 if total >= 0 else _fraction_sign(w * w * u2 - total * total)
    return _fraction_sign(total)


def gradient_direction_at(c: Constraint, t: float, q: Mapping[int, Fraction]) -> dict[int, Fraction] | None:
    """Return a positive multiple of the gradient of g(t, .) at q, {state: entry}, exactly; None where its form does not tell.

    A clipped part minimises the distance that it occurs in: it adds nothing to the gradient.
    """
    form = c.shape.form
    if form is None or c.shape.kind == "other":
        return None
    total: dict[int, Fraction] = {} if form.norms else {i: value for i, value in form.affine.row.items() if i >= 0}
    for w, a in form.norms[0][1] if form.norms else form.squares:
        value = _exact_affine_value(a, t, q, c)
        if value is None:
            return None
        for i, entry in a.row.items():
            if i >= 0:
                total[i] = total.get(i, Fraction(0)) + 2 * w * value * entry
    return total


def _fraction_sign(x: Fraction) -> int:
    return (x > 0) - (x < 0)


def _exact_squares(
    squares: Sequence[tuple[Fraction, AffineForm]], t: float, q: Mapping[int, Fraction], c: Constraint
) -> Fraction | None:
    total = Fraction(0)
    for w, a in squares:
        value = _exact_affine_value(a, t, q, c)
        if value is None:
            return None
        total += w * value * value
    return total


def _exact_affine_value(a: AffineForm, t: float, q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    total = _exact_offset(a.offset, t, c)
    for i, coefficient in a.row.items():
        part = q[i] if i >= 0 else _exact_clip_value(c.shape.clips[i], t, q, c)
        if part is None or total is None:
            return None
        total += coefficient * part
    return total


def _exact_clip_value(clip: Clip, t: float, q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    value = _exact_affine_value(clip.a, t, q, c)
    if value is None:
        return None
    value = value if clip.low is None else max(value, clip.low)
    return value if clip.high is None else min(value, clip.high)


def _exact_offset(offset: Offset, t: float, c: Constraint) -> Fraction | None:
    """An offset where it folds to a number whose operations are exact: at t = 0 sin t, cos t, exp t."""
    if isinstance(offset, Fraction):
        return offset
    low, high = (float(np.ravel(end)[0]) for end in enclose(offset, c.t, np.full(1, t), np.full(1, t)))
    return Fraction(low) if low == high else None
