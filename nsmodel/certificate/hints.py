"""What helps to verify a finding: its numbers with a little room, and matrices, vectors and covers of boxes.

A cover is grown by asking ``verify`` itself: a part on which its inequality fails is halved, until all parts pass or there are
too many.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import block_diag

from nsmodel.certificate import verify
from nsmodel.certificate.graph import matrix, text
from nsmodel.hypotheses.findings import Finding
from nsmodel.proof import sum_of_squares

# Numbers are stated with so much room, relative: they were rounded to doubles; more where a cover of the box would take too
# many parts, as a bound that is attained is told from its violation only by small ones.
ROOMS = ROOM, *_ = Fraction(1, 2**40), Fraction(1, 2**10), Fraction(1, 2**5)
MOST_PARTS, DEEP = 1000, 40  # Parts of a cover.
AT_LEAST, EXACTLY, AT_MOST = -1, 0, 1


class Unproved(Exception):
    """No proof of a finding is known that ``verify`` can check; says why."""


class TooManyParts(Unproved):
    """A cover would take too many parts."""


class Stated(NamedTuple):
    """A number of a finding that its statement needs: its key, where it says less, its name there."""

    key: str
    sense: int = AT_MOST
    name: str = ""


def value_of(finding: Finding, stated: Sequence[Stated], room: Fraction = ROOM) -> dict[str, str]:
    """The numbers of a finding as the certificate states them: rounded in the direction in which they say less."""
    found = {}
    for key, sense, name in stated:
        if key in finding.value and np.isfinite(finding.value[key]):
            number = Fraction(finding.value[key])
            found[name or key] = text(number + sense * room * abs(number))
    return found


# -- covers ------------------------------------------------------------------------------------------------------------


class Grown:
    """A cover that is found while ``verify`` asks for it; ``hint`` says what shows a part, ``only`` which inputs are halved."""

    def __init__(self, hint: Callable[[list[Any]], Any] = lambda box: None, only: Sequence[int] | None = None) -> None:
        self.hint, self.only, self.tree = hint, only, None


def covered(model: dict[str, Any], statement: dict[str, Any]) -> str:
    """The verdict of ``verify``, with covers grown where the hints ask for them; they are then part of the statement."""
    plain = verify.cover

    def growing(tree: Any, box: list[Any], leaf: Callable[[list[Any], Any], bool]) -> bool:
        if isinstance(tree, Grown):
            tree.tree = _grow(tree, box, leaf)
            return True
        return plain(tree, box, leaf)

    try:
        verify.cover = growing
        answer = verify.verdict(model, statement)
    finally:
        verify.cover = plain
    statement["proof"] = _settled(statement["proof"])
    return answer


def _settled(item: Any) -> Any:
    if isinstance(item, Grown):
        return item.tree
    if isinstance(item, dict):
        return {name: _settled(part) for name, part in item.items()}
    return [_settled(part) for part in item] if isinstance(item, list) else item


def _grow(grown: Grown, box: list[Any], leaf: Callable[[list[Any], Any], bool]) -> Any:
    """The tree of a cover whose parts all pass."""
    count, most = 0, MOST_PARTS // (1 if all(np.isfinite(float(x.hi - x.lo)) for x in box) else 4)

    def passes(part: list[Any], hint: Any) -> bool:
        try:
            return bool(leaf(part, hint))
        except (verify.Undefined, AssertionError):
            return False

    def grow(part: list[Any], depth: int) -> Any:
        nonlocal count
        count += 1
        if count > most or depth > DEEP:
            raise TooManyParts(f"a cover takes more than {most} parts")
        hint = grown.hint(part)
        if passes(part, hint):
            return hint
        widths = [
            _width(x) / (_width(y) or 1.0) if grown.only is None or i in grown.only else 0.0
            for i, (x, y) in enumerate(zip(part, box, strict=True))
        ]
        if not any(widths):
            raise TooManyParts("a bound fails at a point")
        k = int(np.argmax(widths))
        middle = part[k].middle()
        sides = verify.Interval(part[k].lo, middle), verify.Interval(middle, part[k].hi)
        return [k, *(grow([*part[:k], side, *part[k + 1 :]], depth + 1) for side in sides)]

    return grow(list(box), 0)


def _width(x: verify.Interval) -> float:
    """The width; of an infinite interval that of its angles."""
    if np.isfinite([float(x.lo), float(x.hi)]).all():
        return float(x.hi - x.lo)
    return float(np.arctan(float(x.hi)) - np.arctan(float(x.lo)))


def cover(expr: ca.SX, inputs: ca.SX) -> dict[str, Grown]:
    """A cover that halves the inputs that the Jacobian of an expression depends on; none where it is constant."""
    J = ca.jacobian(expr, inputs)
    curved = [k for k, symbol in enumerate(ca.vertsplit(inputs)) if ca.depends_on(J, symbol)]
    return {"cover": Grown(only=curved)} if curved else {}


# -- sums of squares -----------------------------------------------------------------------------------------------------


def _renamed(p: verify.Poly) -> tuple[dict[Any, Fraction], list[int]]:
    """A polynomial in the variables 0, 1, ..., and their names in ``p``."""
    names = sorted({v for monomial in p for v, _ in monomial})
    return {tuple((names.index(v), n) for v, n in monomial): number for monomial, number in p.items()}, names


def _hint(found: sum_of_squares.Certificate, names: Sequence[int]) -> dict[str, Any]:
    monomials = [[[v, n] for v, n in zip(names, power, strict=True) if n] for power in found.monomials]
    return {"monomials": monomials, "G": matrix(found.G) if monomials else []}


def squares(p: verify.Poly) -> dict[str, Any] | None:
    """A Gram matrix of p; None where none is found."""
    q, names = _renamed(p)
    found = sum_of_squares.certificate(q, len(names))
    return None if found is None else _hint(found, names)


def nowhere_negative(p: verify.Poly, atoms: verify.Atoms) -> dict[str, Any] | None:
    """A Gram matrix of p less terms that are >= 0 and no polynomials."""

    def of_atoms(m: Any, a: Fraction) -> bool:
        return bool(set(dict(m)) & set(atoms.meaning)) and verify.positive(verify.Poly({m: a}), atoms)

    return squares(verify.Poly({m: a for m, a in p.items() if not of_atoms(m, a)}))


def convexity(p: verify.Poly, own: Sequence[int], atoms: verify.Atoms) -> dict[str, Any]:
    """What shows that p is convex: nothing, by the rules; a Gram matrix of y'D2p y; else a cover."""
    if verify.convex(p, own, atoms):
        return {}
    q = {m: a for m, a in p.items() if m and all(v in own for v, _ in m)}
    found = sum_of_squares.convexity(q)
    if found is None:
        return {"cover": Grown()}
    parts = [_hint(part, [*names, *(-1 - v for v in names)]) for names, part in found]
    G = block_diag(*(part.G for _, part in found)) if parts else []
    rows = [[text(Fraction(x)) for x in row] for row in np.asarray(G, dtype=object)]
    one = {"monomials": [m for part in parts for m in part["monomials"]], "G": rows}
    return {"squares": one} if verify.convex(p, own, atoms, one) else {"cover": Grown()}


def inside(model: Any, finding: Finding) -> dict[str, Any]:
    """A point inside a set of states."""
    point = finding.witness.get("interior point", np.array(ca.DM(model.x0)).ravel())
    return {"interior": [text(entry) for entry in np.ravel(point)]}
