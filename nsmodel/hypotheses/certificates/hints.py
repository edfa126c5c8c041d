"""What helps to verify a finding: its numbers with a little room, and matrices, vectors and covers of boxes.

A cover is grown by asking ``verify`` itself: a part on which its inequality fails is halved, until all parts pass or there are
too many.

A CasADi expression as a straight-line program of few operations, its numbers as exact fractions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.findings import Finding
from nsmodel.proof import sum_of_squares
from nsmodel.proof.expression_graph import fold_graph

ProgramGraph = dict[str, Any]


class UnsupportedOperation(ValueError):
    """An operation that the programs of certificates do not have."""


def exact_number_text(number: Any) -> str:
    """A number, exactly: "-3/4", "7", "inf"."""
    if isinstance(number, Fraction):
        return str(number)
    return str(Fraction(float(number))) if np.isfinite(float(number)) else "inf" if float(number) > 0 else "-inf"


def exact_matrix_text(entries: Any) -> list[list[str]]:
    """The rows of a matrix of numbers or Fractions."""
    return [[exact_number_text(entry) for entry in row] for row in np.atleast_2d(entries)]


def straight_line_program(
    expr: ca.SX, inputs: ca.SX, names: Sequence[str], values: Mapping[ca.SX, float] = MappingProxyType({})
) -> ProgramGraph:
    """The program of the entries of ``expr`` in the symbols ``inputs`` (n, 1), called ``names``; ``values`` of other symbols.

    Raises:
        NoProgram: an operation without counterpart, or another symbol.
    """
    writer = _ProgramWriter(
        {symbol.element_hash(): k for k, symbol in enumerate(ca.vertsplit(inputs))} if inputs.numel() else {},
        {symbol.element_hash(): value for symbol, value in values.items()},
    )
    outputs = fold_graph(ca.densify(ca.vec(ca.SX(expr))), writer.symbol, writer.number, writer.apply) if expr.numel() else []
    return {"inputs": list(names), "steps": writer.steps, "outputs": outputs}


class _ProgramWriter:
    """Steps, each written once."""

    def __init__(self, places: dict[int, int], values: dict[int, float]) -> None:
        self.places, self.values, self.steps, self.known = places, values, [], {}
        neg, sub, mul, add, power = self._neg, self._sub, self._mul, self._add, self._pow
        one, two = Fraction(1), Fraction(2)
        self.rules: dict[int, Callable[..., int]] = {
            ca.OP_ASSIGN: lambda u: u,
            ca.OP_NEG: neg,
            ca.OP_ADD: add,
            ca.OP_SUB: sub,
            ca.OP_MUL: mul,
            ca.OP_DIV: lambda u, w: mul(u, power(w, -one)),
            ca.OP_INV: lambda u: power(u, -one),
            ca.OP_SQ: lambda u: power(u, two),
            ca.OP_SQRT: lambda u: power(u, one / 2),
            ca.OP_TWICE: lambda u: mul(self.number(2.0), u),
            ca.OP_FMAX: self._max,
            ca.OP_FMIN: lambda u, w: neg(self._max(neg(u), neg(w))),
            ca.OP_FABS: lambda u: self._max(u, neg(u)),
            ca.OP_HYPOT: lambda u, w: power(add(power(u, two), power(w, two)), one / 2),
            ca.OP_EXP: lambda u: self._append_step("exp", u),
            ca.OP_SIN: lambda u: self._append_step("sin", u),
            ca.OP_COS: lambda u: self._append_step("cos", u),
            ca.OP_EXPM1: lambda u: sub(self._append_step("exp", u), self.number(1.0)),
            ca.OP_TAN: lambda u: mul(self._append_step("sin", u), power(self._append_step("cos", u), -one)),
            ca.OP_TANH: lambda u: self._append_step("tanh", u),
            ca.OP_SINH: lambda u: self._exponential_half_sum(u, sub),
            ca.OP_COSH: lambda u: self._exponential_half_sum(u, add),
            ca.OP_CONSTPOW: self._constant_power,
            ca.OP_POW: self._constant_power,
        }

    def symbol(self, symbol: ca.SX) -> int:
        if symbol.element_hash() in self.values:
            return self.number(self.values[symbol.element_hash()])
        if symbol.element_hash() not in self.places:
            raise UnsupportedOperation(f"the symbol {symbol} has no value")
        return self._append_step("in", self.places[symbol.element_hash()])

    def number(self, value: float) -> int:
        if not np.isfinite(value):
            raise UnsupportedOperation("an infinite number")
        return self._append_step("const", exact_number_text(value))

    def apply(self, op: int, args: list[int]) -> int:
        if op not in self.rules:
            raise UnsupportedOperation(f"operation {op} of CasADi")
        return self.rules[op](*args)

    def _append_step(self, *step: Any) -> int:
        if step not in self.known:
            self.known[step] = len(self.steps)
            self.steps.append(list(step))
        return self.known[step]

    def _add(self, u: int, w: int) -> int:
        return self._append_step("add", u, w)

    def _mul(self, u: int, w: int) -> int:
        return self._pow(u, Fraction(2)) if u == w else self._append_step("mul", u, w)

    def _neg(self, u: int) -> int:
        return self._mul(self.number(-1.0), u)

    def _sub(self, u: int, w: int) -> int:
        return self._add(u, self._neg(w))

    def _pow(self, u: int, n: Fraction) -> int:
        return self._append_step("pow", u, str(n))

    def _max(self, u: int, w: int) -> int:
        return self._append_step("fmax", u, w)

    def _exponential_half_sum(self, u: int, combine: Callable[[int, int], int]) -> int:
        return self._mul(self.number(0.5), combine(self._append_step("exp", u), self._append_step("exp", self._neg(u))))

    def _constant_power(self, u: int, w: int) -> int:
        kind, number, *_ = self.steps[w]
        if kind != "const":
            raise UnsupportedOperation("a power with a varying exponent")
        return self._pow(u, Fraction(number))


# Numbers are stated with so much room, relative: they were rounded to doubles; more where a cover of the box would take too
# many parts, as a bound that is attained is told from its violation only by small ones.
ROUNDING_ALLOWANCES = ROUNDING_ALLOWANCE, *_ = Fraction(1, 2**40), Fraction(1, 2**10), Fraction(1, 2**5)
# Parts of a cover of a box, all of which the file holds and the verifier looks at; of more the statement has no proof there.
MAX_COVER_PARTS = 1000
MAX_COVER_DEPTH = 40  # Cuts of one part: it is then 2^-40 of the box, and a bound that fails there fails everywhere near.
ROUND_DOWN, KEEP_EXACT, ROUND_UP = -1, 0, 1  # Which way a stated number may be off.


class UnprovedFinding(verify.Unproved):
    """No proof of a finding is known that ``verify`` can check; says why."""

    def __init__(self, why: str) -> None:
        super().__init__(why, verify.UNCHECKED)


class CoverTooLarge(UnprovedFinding):
    """A cover would take too many parts."""


class StatedNumber(NamedTuple):
    """A number of a finding that its statement needs: its key, where it says less, its name there."""

    key: str
    sense: int = ROUND_UP
    name: str = ""


def stated_values(finding: Finding, stated: Sequence[StatedNumber], room: Fraction = ROUNDING_ALLOWANCE) -> dict[str, str]:
    """The numbers of a finding as the certificate states them: rounded in the direction in which they say less."""
    found = {}
    for key, sense, name in stated:
        if key in finding.value and np.isfinite(finding.value[key]):
            number = Fraction(finding.value[key])
            found[name or key] = exact_number_text(number + sense * room * abs(number))
    return found


# -- covers ------------------------------------------------------------------------------------------------------------


class AdaptiveCover:
    """A cover that is found while ``verify`` asks for it; ``hint`` says what shows a part, ``only`` which inputs are halved."""

    def __init__(self, hint: Callable[[list[Any]], Any] = lambda box: None, only: Sequence[int] | None = None) -> None:
        self.hint, self.only, self.tree = hint, only, None


def verify_with_covers(model: dict[str, Any], statement: dict[str, Any]) -> tuple[str, str]:
    """The answer of ``verify``, with covers grown where the hints ask for them; they are then part of the statement."""
    plain = verify.cover

    def growing(tree: Any, box: list[Any], leaf: Callable[[list[Any], Any], bool]) -> bool:
        if isinstance(tree, AdaptiveCover):
            tree.tree = _grow_cover(tree, box, leaf)
            return True
        return plain(tree, box, leaf)

    try:
        verify.cover = growing
        answer = verify.answer(model, statement)
    finally:
        verify.cover = plain
    statement["proof"] = _replace_covers(statement["proof"])
    return answer


def _replace_covers(item: Any) -> Any:
    if isinstance(item, AdaptiveCover):
        return item.tree
    if isinstance(item, dict):
        return {name: _replace_covers(part) for name, part in item.items()}
    return [_replace_covers(part) for part in item] if isinstance(item, list) else item


def _grow_cover(grown: AdaptiveCover, box: list[Any], leaf: Callable[[list[Any], Any], bool]) -> Any:
    """The tree of a cover whose parts all pass."""
    count, most = 0, MAX_COVER_PARTS // (1 if all(np.isfinite(float(x.hi - x.lo)) for x in box) else 4)

    def passes(part: list[Any], hint: Any) -> bool:
        try:
            return leaf(part, hint)
        except verify.Unproved:
            return False

    def grow(part: list[Any], depth: int) -> Any:
        nonlocal count
        count += 1
        if count > most or depth > MAX_COVER_DEPTH:
            raise CoverTooLarge(f"a cover takes more than {most} parts")
        hint = grown.hint(part)
        if passes(part, hint):
            return hint
        widths = [
            _interval_width(x) / (_interval_width(y) or 1.0) if grown.only is None or i in grown.only else 0.0
            for i, (x, y) in enumerate(zip(part, box, strict=True))
        ]
        if not any(widths):
            raise CoverTooLarge("a bound fails at a point")
        k = int(np.argmax(widths))
        middle = part[k].middle()
        sides = verify.VerifierInterval(part[k].lo, middle), verify.VerifierInterval(middle, part[k].hi)
        return [k, *(grow([*part[:k], side, *part[k + 1 :]], depth + 1) for side in sides)]

    return grow(list(box), 0)


def _interval_width(x: verify.VerifierInterval) -> float:
    """The width; of an infinite interval that of its angles."""
    if np.isfinite([float(x.lo), float(x.hi)]).all():
        return float(x.hi - x.lo)
    return float(np.arctan(float(x.hi)) - np.arctan(float(x.lo)))


def cover_hint(expr: ca.SX, inputs: ca.SX) -> dict[str, AdaptiveCover]:
    """A cover that halves the inputs that the Jacobian of an expression depends on; none where it is constant."""
    J = ca.jacobian(expr, inputs)
    curved = [k for k, symbol in enumerate(ca.vertsplit(inputs)) if ca.depends_on(J, symbol)]
    return {"cover": AdaptiveCover(only=curved)} if curved else {}


# -- sums of squares -----------------------------------------------------------------------------------------------------


def _renumber_variables(p: verify.Poly) -> tuple[dict[Any, Fraction], list[int]]:
    """A polynomial in the variables 0, 1, ..., and their names in ``p``."""
    names = sorted({v for monomial in p for v, _ in monomial})
    return {tuple((names.index(v), n) for v, n in monomial): number for monomial, number in p.items()}, names


def _gram_hint(found: sum_of_squares.SosDecomposition, names: Sequence[int]) -> dict[str, Any]:
    monomials = [[[v, n] for v, n in zip(names, power, strict=True) if n] for power in found.monomials]
    return {"monomials": monomials, "G": exact_matrix_text(found.G) if monomials else []}


def gram_matrix_hint(p: verify.Poly) -> dict[str, Any] | None:
    """A Gram matrix of p; None where none is found."""
    q, names = _renumber_variables(p)
    found = sum_of_squares.sos_decomposition(q, len(names))
    return None if found is None else _gram_hint(found, names)


def corner_hints(hints: Sequence[Any]) -> Any:
    """The hints of all corners of the parameters; of one corner its own."""
    return hints[0] if len(hints) == 1 else {"corners": list(hints)}


def nonnegativity_hint(p: verify.Poly, atoms: verify.Atoms) -> dict[str, Any] | None:
    """A Gram matrix of p less terms that are >= 0 and no polynomials."""

    def is_nonnegative_term(m: Any, a: Fraction) -> bool:
        return bool(set(dict(m)) & set(atoms.meaning)) and verify.positive(verify.Poly({m: a}), atoms)

    found = [
        gram_matrix_hint(verify.Poly({m: a for m, a in q.items() if not is_nonnegative_term(m, a)})) for q in verify.at_corners(p)
    ]
    return None if None in found else corner_hints(found)


def convexity_hint(p: verify.Poly, own: Sequence[int], atoms: verify.Atoms) -> dict[str, Any]:
    """What shows that p is convex: nothing, by the rules; else a cover."""
    return {} if verify.convex(p, own, atoms) else {"cover": AdaptiveCover()}


def interior_point_hint(subject: Any, finding: Finding) -> dict[str, Any]:
    """A point inside a set of states: that of the finding, or the start for parameters in the middle."""
    point = finding.witness.get("interior point")
    if point is None:
        at = ca.DM([(low + high) / 2 for low, high in subject.ranges.values()])
        point = np.array(ca.Function("start", [subject.model.p], [ca.densify(subject.model.x0)])(at))
    return {"interior": [exact_number_text(entry) for entry in np.ravel(point)]}
