"""Forms of constraints in exact rational arithmetic: sums of squares, an affine function, norms.

    sum_k w_k a_k^2  +  a_0  +  sum_j v_j |(a_j1, a_j2, ...)|,      a affine in q and in the clipped parts tau

with rational coefficients; only the offsets of the a's may depend on time. A clipped part tau = min(max(a(q), lo), hi) is what
the distance to a segment or a box is written with.

What a constraint g(t, q) is made of, read off its graph: planes, quadratics, distances.

Every node of the graph becomes a `Form`. A clipped part tau is found to minimise the
distance that it occurs in: g is then a minimum over tau of a jointly convex function, hence convex.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction

import casadi as ca
import numpy as np

from nsmodel.proof.exact import definiteness
from nsmodel.proof.expression_graph import apply_operation, fold_graph, is_same_expression, symbol_hashes
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
        factor: a function of parameters; all else is then said of g / factor, where that is > 0.
    """

    kind: str
    convex: bool
    own: tuple[int, ...]
    time: bool
    form: ConstraintForm | None
    clips: Mapping[int, Clip] = field(default_factory=dict)
    rounded: bool = False
    factor: ca.SX | None = None

    @property
    def written(self) -> ConstraintForm:
        """The form, of a kind that has one."""
        return not_none(self.form)


def add_offsets(a: Offset, b: Offset) -> Offset:
    """The sum of two offsets."""
    return a + b if isinstance(a, Fraction) and isinstance(b, Fraction) else offset_expression(a) + offset_expression(b)


def scale_offset(c: Fraction, a: Offset) -> Offset:
    """The offset times an exact number."""
    return c * a if isinstance(a, Fraction) else float(c) * a


def square_offset(a: Offset) -> Offset:
    """The square of an offset."""
    return a * a if isinstance(a, Fraction) else a**2


def offset_expression(a: Offset) -> ca.SX:
    """The offset as an expression."""
    return ca.SX(float(a)) if isinstance(a, Fraction) else a


def combine_affine(a: AffineForm, c: Fraction, b: AffineForm) -> AffineForm:
    """The affine form a + c b."""
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
    return definiteness(form_hessian(form)).psd


def form_hessian(form: ConstraintForm) -> np.ndarray:
    """The constant Hessian of a form without norms in the states that it depends on: Fractions (k, k)."""
    indices = sorted({i for a in affine_parts(form) for i in a.row})
    place = {i: k for k, i in enumerate(indices)}
    H = np.full((len(indices), len(indices)), _ZERO_FRACTION, dtype=object)
    for w, a in form.squares:
        for i, x in a.row.items():
            for j, y in a.row.items():
                H[place[i], place[j]] += 2 * w * x * y
    return H


ROUNDED_CONSTANT_TOLERANCE = Fraction(1, 2**46)  # 64 eps: what the user's own constants (1/|e|^2, say) are rounded to.
_ZERO, _ONE = Fraction(0), Fraction(1)


@dataclass(frozen=True, eq=False)
class GraphNodeShape:
    """One node: its form (None where it has none), and what is known of it for all q and t.

    ``own``: the states that it depends on; ``time``: it depends on t; ``value`` is the expression itself where it does not depend
    on q. Where there is a ``factor``, a node of parameters alone, all but ``own`` is said of the node divided by it.
    """

    form: ConstraintForm | None
    convex: bool
    concave: bool
    nonnegative: bool
    own: frozenset[int] = frozenset()
    time: bool = False
    value: ca.SX | None = None
    factor: GraphNodeShape | None = None

    @property
    def affine(self) -> AffineForm | None:
        """The affine function that the node is, tau included; None where it is not one."""
        return self.form.affine if self.form is not None and not self.form.squares and not self.form.norms else None

    @property
    def number(self) -> Fraction | None:
        """The number that the node is."""
        a = self.affine
        return a.offset if a is not None and not a.row and isinstance(a.offset, Fraction) else None


def read_shapes(g: ca.SX, q: ca.SX, scales: ca.SX | None = None) -> list[ConstraintShape]:
    """Return the shape of each entry of ``g`` (p, 1) in the states q, for all values of its other symbols (time, parameters).

    ``scales``: the parameters of which a function may be taken out of g as its factor.
    """
    reader = _ShapeReader(q, ca.SX(0, 1) if scales is None else scales)
    return [reader.shape(part) for part in reader.parts(g)]


_UNKNOWN_SHAPE = GraphNodeShape(None, False, False, False)


class _ShapeReader:
    """Runs through the instructions of a constraint's graph once, with :class:`Part` in place of numbers."""

    def __init__(self, q: ca.SX, scales: ca.SX) -> None:
        self.scales = symbol_hashes(scales)
        self.place = {symbol.element_hash(): i for i, symbol in enumerate(ca.vertsplit(q))}
        self.clips: dict[int, Clip] = {}
        self.rounded: set[int] = set()
        self.unary = {
            ca.OP_ASSIGN: lambda a: a,
            ca.OP_NEG: lambda a: self._scale(a, Fraction(-1)),
            ca.OP_TWICE: lambda a: self._scale(a, Fraction(2)),
            ca.OP_SQ: lambda a: self._product(a, a),
            ca.OP_SQRT: self._root,
            ca.OP_FABS: self._absolute,
            ca.OP_EXP: lambda a: GraphNodeShape(None, a.convex, False, True),
        }
        self.binary = {
            ca.OP_ADD: lambda a, b: self._sum(a, b, _ONE),
            ca.OP_SUB: lambda a, b: self._sum(a, b, -_ONE),
            ca.OP_MUL: self._product,
            ca.OP_DIV: lambda a, b: self._scale(a, 1 / b.number) if b.number else _UNKNOWN_SHAPE,
            ca.OP_FMAX: lambda a, b: self._extreme(a, b, True),
            ca.OP_FMIN: lambda a, b: self._extreme(a, b, False),
            ca.OP_CONSTPOW: self._power,
            ca.OP_POW: self._power,
            ca.OP_HYPOT: lambda a, b: self._root(self._sum(self._product(a, a), self._product(b, b), _ONE)),
        }

    def parts(self, g: ca.SX) -> list[GraphNodeShape]:
        """Return the part of each entry."""
        return fold_graph(g, self._symbol, _number_shape, self._apply)

    def shape(self, part: GraphNodeShape) -> ConstraintShape:
        """Say what a constraint is."""
        factor = None if part.factor is None else part.factor.value
        return replace(self._plain_shape(part), factor=factor)

    def _plain_shape(self, part: GraphNodeShape) -> ConstraintShape:
        own, form = tuple(sorted(part.own)), part.form
        if form is None:
            return ConstraintShape("other", part.convex, own, part.time, None)
        used = {i for a in affine_parts(form) for i in a.row if i < 0}
        clips = {i: self.clips[i] for i in used}
        convex = part.convex or is_convex_form(form)
        if not form.norms and not used:
            kind = "quadratic" if form.squares else "plane"
            return ConstraintShape(kind, convex or kind == "plane", own, part.time, form)
        if len(form.norms) == 1 and not form.squares and not form.affine.row and form.norms[0][0] > 0 and convex:
            return ConstraintShape("distance", True, own, part.time, form, clips, not self.rounded.isdisjoint(used))
        return ConstraintShape("other", convex, own, part.time, form, clips)

    def _symbol(self, symbol: ca.SX) -> GraphNodeShape:
        index = self.place.get(symbol.element_hash())
        if index is None:
            return _time_shape(symbol, False)
        return GraphNodeShape(ConstraintForm((), AffineForm({index: _ONE}, _ZERO), ()), True, True, False, frozenset([index]))

    def _apply(self, op: int, parts: list[GraphNodeShape]) -> GraphNodeShape:
        own, time = frozenset().union(*(part.own for part in parts)), any(part.time for part in parts)
        values = [part.value for part in parts if part.value is not None]
        if not own and op != ca.OP_CALL and len(values) == len(parts):
            value = apply_operation(op, values)
            nonnegative = op in (ca.OP_SQ, ca.OP_FABS, ca.OP_EXP, ca.OP_SQRT) or (
                op in (ca.OP_ADD, ca.OP_MUL) and all(part.nonnegative for part in parts)
            )
            return _time_shape(value, nonnegative) if time else _number_shape(float(value))
        parts, factor = self._factored(op, parts)
        rule = (self.unary if len(parts) == 1 else self.binary).get(op)
        part = _UNKNOWN_SHAPE if rule is None else rule(*parts)
        return GraphNodeShape(part.form, part.convex, part.concave, part.nonnegative, own, time, None, factor)

    def _factored(self, op: int, parts: list[GraphNodeShape]) -> tuple[list[GraphNodeShape], GraphNodeShape | None]:
        """The parts without a common factor, which the operation keeps, and that factor; what is added is divided by it."""
        if op in (ca.OP_MUL, ca.OP_DIV):
            for place, other in ((0, 1), (1, 0)) if op == ca.OP_MUL else ((1, 0),):
                if self._is_scale(parts[place]) and parts[other].own:
                    inner = parts[other].factor or _number_shape(1.0)
                    rest = [_number_shape(1.0) if k == place else replace(part, factor=None) for k, part in enumerate(parts)]
                    return rest, _scale_shape(op, inner, parts[place])
        factor = next((part.factor for part in parts if part.factor is not None), None)
        if factor is None:
            return parts, None
        if op in (ca.OP_NEG, ca.OP_TWICE, ca.OP_ASSIGN) or (op in (ca.OP_MUL, ca.OP_DIV) and any(part.number for part in parts)):
            return [replace(part, factor=None) for part in parts], factor
        divided = [_without_factor(part, factor) for part in parts] if op in (ca.OP_ADD, ca.OP_SUB) else [None]
        if all(part is not None for part in divided):
            return [part for part in divided if part is not None], factor
        return [_times_factor(part) for part in parts], None

    def _is_scale(self, part: GraphNodeShape) -> bool:
        return part.value is not None and part.number is None and symbol_hashes(part.value) <= self.scales

    def _scale(self, a: GraphNodeShape, c: Fraction) -> GraphNodeShape:
        convex, concave = (a.convex, a.concave) if c >= 0 else (a.concave, a.convex)
        return GraphNodeShape(None if a.form is None else scale_form(a.form, c), convex, concave, a.nonnegative and c >= 0)

    def _sum(self, a: GraphNodeShape, b: GraphNodeShape, sign: Fraction) -> GraphNodeShape:
        b = self._scale(b, sign) if sign != 1 else b
        form = None
        if a.form is not None and b.form is not None:
            form = ConstraintForm(
                a.form.squares + b.form.squares, combine_affine(a.form.affine, _ONE, b.form.affine), a.form.norms + b.form.norms
            )
        return GraphNodeShape(form, a.convex and b.convex, a.concave and b.concave, a.nonnegative and b.nonnegative)

    def _product(self, a: GraphNodeShape, b: GraphNodeShape) -> GraphNodeShape:
        for x, y in ((a, b), (b, a)):
            if x.number is not None:
                return self._scale(y, x.number)
        u, v = a.affine, b.affine
        if a is b:
            plain = u is not None and all(i >= 0 for i in u.row)
            convex = plain or (a.convex and a.nonnegative)
            if u is not None:
                return GraphNodeShape(ConstraintForm(((_ONE, u),), AffineForm({}, _ZERO), ()), convex, False, True)
            inside = a.form.norms if a.form is not None and not a.form.squares and is_zero_affine(a.form.affine) else ()
            if len(inside) == 1:  # (w |u|)^2
                (w, squares) = inside[0]
                return GraphNodeShape(
                    ConstraintForm(tuple((w * w * c, item) for c, item in squares), AffineForm({}, _ZERO), ()),
                    convex,
                    False,
                    True,
                )
            return GraphNodeShape(None, convex, False, True)
        if u is not None and v is not None and a.own and b.own:
            squares = ((Fraction(1, 4), combine_affine(u, _ONE, v)), (Fraction(-1, 4), combine_affine(u, -_ONE, v)))
            return GraphNodeShape(
                ConstraintForm(squares, AffineForm({}, _ZERO), ()), False, False, a.nonnegative and b.nonnegative
            )
        for x, y in ((a, b), (b, a)):
            if not x.own and x.nonnegative:
                return GraphNodeShape(None, y.convex, y.concave, y.nonnegative)
        return _UNKNOWN_SHAPE

    def _root(self, a: GraphNodeShape) -> GraphNodeShape:
        squares = _as_squares(a)
        if squares is None:
            return GraphNodeShape(None, False, a.concave and a.nonnegative, True)
        clipped = {i for _, item in squares for i in item.row if i < 0}
        convex = not clipped or self._is_projection(squares, clipped)
        return GraphNodeShape(ConstraintForm((), AffineForm({}, _ZERO), ((_ONE, squares),)), convex, False, True)

    def _absolute(self, a: GraphNodeShape) -> GraphNodeShape:
        if a.affine is None:
            return GraphNodeShape(None, a.convex and a.nonnegative, False, True)
        return self._root(self._product(a, a))

    def _power(self, a: GraphNodeShape, b: GraphNodeShape) -> GraphNodeShape:
        exponent = b.number
        if exponent == 2:
            return self._product(a, a)
        if exponent == Fraction(1, 2):
            return self._root(a)
        if exponent is None:
            return _UNKNOWN_SHAPE
        return GraphNodeShape(None, a.convex and a.nonnegative and exponent >= 1, False, a.nonnegative)

    def _extreme(self, a: GraphNodeShape, b: GraphNodeShape, largest: bool) -> GraphNodeShape:
        convex, concave = (a.convex and b.convex and largest), (a.concave and b.concave and not largest)
        nonnegative = (a.nonnegative or b.nonnegative) if largest else (a.nonnegative and b.nonnegative)
        x, bound = (a, b.number) if b.number is not None else (b, a.number)
        form = None
        if bound is not None and x.affine is not None and isinstance(x.affine.offset, Fraction):
            form = ConstraintForm((), AffineForm({self._clip(x.affine, bound, largest): _ONE}, _ZERO), ())
        return GraphNodeShape(form, convex, concave, nonnegative)

    def _clip(self, a: AffineForm, bound: Fraction, largest: bool) -> int:
        """Return the index of the clipped part; a bound on what is one already, from the other side, extends it."""
        inner = self.clips.get(next(iter(a.row))) if len(a.row) == 1 and not a.offset else None
        clip = Clip(a, bound if largest else None, None if largest else bound)
        if inner is not None and next(iter(a.row.values())) == 1:
            if largest and inner.low is None and inner.high is not None and bound <= inner.high:
                clip = Clip(inner.a, bound, inner.high)
            elif not largest and inner.high is None and inner.low is not None and bound >= inner.low:
                clip = Clip(inner.a, inner.low, bound)
        index = -1 - len(self.clips)
        self.clips[index] = clip
        return index

    def _is_projection(self, squares: Squares, clipped: set[int]) -> bool:
        """Whether each tau minimises |u(q, tau)|^2 over its interval, up to the rounding of the user's constants.

        |u|^2 must have no mixed term of two tau's; then each is the clipped stationary point -<u(q, 0), b> / |b|^2, with b
        the derivative of u by tau.
        """
        b = {i: [(w, a, a.row[i]) for w, a in squares if i in a.row] for i in clipped}
        for i, terms in b.items():
            if any(j != i and j in a.row for _, a, _ in terms for j in clipped):
                return False
            size = sum(w * c * c for w, _, c in terms)
            best = AffineForm({}, _ZERO)
            for w, a, c in terms:
                free = AffineForm({j: value for j, value in a.row.items() if j != i}, a.offset)
                best = combine_affine(best, -w * c / size, free)
            clip = self.clips[i].a
            offsets = [o for o in (clip.offset, best.offset, *(a.offset for _, a, _ in terms)) if isinstance(o, Fraction)]
            if any(j < 0 for j in clip.row) or len(offsets) < 2 + len(terms):
                return False
            own, middle, *others = offsets
            reach = max((abs(value) for value in best.row.values()), default=_ZERO)
            offset = max([abs(own), *(abs(w * c * o / size) for (w, _, c), o in zip(terms, others, strict=True))])
            rest = combine_affine(clip, -_ONE, best)
            if any(abs(value) > ROUNDED_CONSTANT_TOLERANCE * reach for value in rest.row.values()):
                return False
            if abs(own - middle) > ROUNDED_CONSTANT_TOLERANCE * offset:
                return False
            if rest.row or rest.offset:
                self.rounded.add(i)
        return True


def _number_shape(value: float) -> GraphNodeShape:
    if not np.isfinite(value):
        return GraphNodeShape(None, False, False, False, value=ca.SX(value))
    return GraphNodeShape(ConstraintForm((), AffineForm({}, Fraction(value)), ()), True, True, value >= 0, value=ca.SX(value))


def _time_shape(value: ca.SX, nonnegative: bool) -> GraphNodeShape:
    return GraphNodeShape(ConstraintForm((), AffineForm({}, value), ()), True, True, nonnegative, time=True, value=value)


def _scale_shape(op: int, a: GraphNodeShape, b: GraphNodeShape) -> GraphNodeShape:
    """A product or quotient of functions of parameters."""
    return _time_shape(apply_operation(op, [not_none(a.value), not_none(b.value)]), a.nonnegative and b.nonnegative)


def _without_factor(part: GraphNodeShape, factor: GraphNodeShape) -> GraphNodeShape | None:
    """A part divided by the factor: what has that factor, or is free of q; None of others."""
    scale = not_none(factor.value)
    if part.factor is not None and is_same_expression(not_none(part.factor.value), scale):
        return replace(part, factor=None)
    if part.own or part.value is None:
        return None
    return part if part.number == 0 else _time_shape(part.value / scale, part.nonnegative and factor.nonnegative)


def _times_factor(part: GraphNodeShape) -> GraphNodeShape:
    """What is known of a part with its factor."""
    if part.factor is None:
        return part
    if not part.factor.nonnegative:
        return replace(_UNKNOWN_SHAPE, own=part.own, time=part.time)
    return replace(part, form=None, factor=None)


def _as_squares(part: GraphNodeShape) -> Squares | None:
    """Read a part as a sum of squares with weights > 0; a number >= 0 beside them is the square of its root."""
    form = part.form
    if form is None or form.norms or form.affine.row or any(w < 0 for w, _ in form.squares):
        return None
    if is_zero_affine(form.affine):
        return form.squares
    offset = form.affine.offset
    if isinstance(offset, Fraction) and offset > 0:
        return (*form.squares, (offset, AffineForm({}, _ONE)))
    return None
