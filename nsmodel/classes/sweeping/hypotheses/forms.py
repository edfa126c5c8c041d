"""Forms of constraints in exact rational arithmetic: sums of squares, an affine function, norms.

    sum_k w_k a_k^2  +  a_0  +  sum_j v_j |(a_j1, a_j2, ...)|,      a affine in q and in the clipped parts tau

with rational coefficients; only the offsets of the a's may depend on time. A clipped part tau = min(max(a(q), lo), hi) is what
the distance to a segment or a box is written with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

import casadi as ca
import numpy as np

from nsmodel.proof.exact import definiteness
from nsmodel.proof.verdict import not_none

Offset = Fraction | ca.SX  # A number, or an expression of time.
_ZERO_FRACTION = Fraction(0)


@dataclass(frozen=True, eq=False)
class AffineForm:
    """row . (q, tau) + offset; ``row`` is {index: coefficient}, indices < 0 are clipped parts."""

    row: Mapping[int, Fraction]
    offset: Offset


@dataclass(frozen=True, eq=False)
class Clip:
    """tau = min(max(a(q), low), high); an end may be None."""

    a: AffineForm
    low: Fraction | None
    high: Fraction | None


Squares = tuple[tuple[Fraction, AffineForm], ...]  # sum of w a^2


@dataclass(frozen=True, eq=False)
class ConstraintForm:
    """sum of squares + affine + norms, with the clipped parts that occur in them."""

    squares: Squares
    affine: AffineForm
    norms: tuple[tuple[Fraction, Squares], ...]


@dataclass(frozen=True, eq=False)
class ConstraintShape:
    """A constraint g(t, q) in its own states.

    Attributes:
        kind: "plane" row q + o(t); "quadratic" sum w_k a_k^2 + a_0; "distance" w |u| - r, u affine in q and in clipped
            parts that minimise |u|; "other".
        convex: proved for all q and t.
        own: indices of the states it depends on.
        time: whether it depends on t.
        form: its form; None for some of kind "other".
        clips: {index: Clip} of the clipped parts in it.
        rounded: whether these are the nearest points up to the rounding of the user's constants only.
    """

    kind: str
    convex: bool
    own: tuple[int, ...]
    time: bool
    form: ConstraintForm | None
    clips: Mapping[int, Clip] = field(default_factory=dict)
    rounded: bool = False

    @property
    def written(self) -> ConstraintForm:
        """The form, of a kind that has one."""
        return not_none(self.form)


def add_offsets(a: Offset, b: Offset) -> Offset:
    """a + b."""
    return a + b if isinstance(a, Fraction) and isinstance(b, Fraction) else offset_expression(a) + offset_expression(b)


def scale_offset(c: Fraction, a: Offset) -> Offset:
    """c a."""
    return c * a if isinstance(a, Fraction) else float(c) * a


def square_offset(a: Offset) -> Offset:
    """a a."""
    return a * a if isinstance(a, Fraction) else a**2


def offset_expression(a: Offset) -> ca.SX:
    """The offset as an expression."""
    return ca.SX(float(a)) if isinstance(a, Fraction) else a


def combine_affine(a: AffineForm, c: Fraction, b: AffineForm) -> AffineForm:
    """a + c b."""
    row = dict(a.row)
    for i, value in b.row.items():
        row[i] = row.get(i, _ZERO_FRACTION) + c * value
    return AffineForm({i: value for i, value in row.items() if value}, add_offsets(a.offset, scale_offset(c, b.offset)))


def scale_form(part: ConstraintForm, c: Fraction) -> ConstraintForm:
    """c times a form."""
    if not c:
        return ConstraintForm((), AffineForm({}, _ZERO_FRACTION), ())
    squares = tuple((c * w, item) for w, item in part.squares)
    norms = tuple((c * w, item) for w, item in part.norms)
    return ConstraintForm(squares, combine_affine(AffineForm({}, _ZERO_FRACTION), c, part.affine), norms)


def is_zero_affine(a: AffineForm) -> bool:
    """Whether an affine function is 0."""
    return not a.row and isinstance(a.offset, Fraction) and not a.offset


def affine_parts(form: ConstraintForm) -> list[AffineForm]:
    """The affine functions in a form."""
    return [form.affine, *(a for _, a in form.squares), *(a for _, squares in form.norms for _, a in squares)]


def is_convex_form(form: ConstraintForm) -> bool:
    """Whether a form without clipped parts is convex: norms with weights >= 0, and squares whose Hessian is psd."""
    if any(i < 0 for a in affine_parts(form) for i in a.row) or any(w < 0 for w, _ in form.norms):
        return False
    if all(w >= 0 for w, _ in form.squares):
        return True
    return definiteness(form_hessian(form)[0]).psd


def form_hessian(form: ConstraintForm) -> tuple[np.ndarray, list[int]]:
    """The constant Hessian of a form without norms: Fractions (k, k), and the indices of its rows."""
    indices = sorted({i for a in affine_parts(form) for i in a.row})
    place = {i: k for k, i in enumerate(indices)}
    H = np.full((len(indices), len(indices)), _ZERO_FRACTION, dtype=object)
    for w, a in form.squares:
        for i, x in a.row.items():
            for j, y in a.row.items():
                H[place[i], place[j]] += 2 * w * x * y
    return H, indices
