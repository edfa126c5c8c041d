"""Is an expression of time defined and finite on an interval: roots, poles and logarithms, decided by bounds and exact roots.

Each operation with a limited domain asks something of an argument u(t): u != 0 of a division, u > 0 of a logarithm, u >= 0 of a
root. Where u is a polynomial its roots are isolated exactly; else its sign is bounded by intervals on ever smaller parts.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval, polynomial, polynomial_signs
from nsmodel.proof.graph import applied, fold, operations
from nsmodel.proof.verdict import HOLDS, UNKNOWN, VIOLATED

PARTS, LEAST = 20_000, 2.0**-46  # Parts of the interval looked at, and how small they get beside it.
NEAR = 2.0 ** -np.arange(6.0, 40.0)  # Distances from a singular time, beside the interval, at which growth is looked at.
NONZERO, POSITIVE, NONNEGATIVE = "!= 0", "> 0", ">= 0"


class Condition(NamedTuple):
    """What an operation asks of its argument; ``guards``: only where these conditions may be true."""

    u: ca.SX
    relation: str
    name: str
    guards: tuple[ca.SX, ...] = ()


class Defined(NamedTuple):
    """Whether all conditions hold on the interval; ``at``: the time where one fails, ``how`` in words."""

    verdict: str
    how: str
    at: float | None = None


class _Node(NamedTuple):
    expr: ca.SX
    asked: tuple[Condition, ...]


def conditions(expr: ca.SX) -> list[Condition]:
    """What the operations of an expression ask of their arguments."""

    def apply(op: int, args: list[_Node]) -> _Node:
        own = [arg.expr for arg in args]
        if op == ca.OP_IF_ELSE_ZERO:
            inner = tuple(asked._replace(guards=(*asked.guards, own[0])) for asked in args[1].asked)
            return _Node(applied(op, own), _joined(args[0].asked, inner))
        return _Node(applied(op, own), _joined(*(arg.asked for arg in args), tuple(_asked(op, own))))

    nodes = fold(expr, lambda symbol: _Node(symbol, ()), lambda number: _Node(ca.SX(number), ()), apply)
    return list(_joined(*(node.asked for node in nodes)))


def _joined(*several: tuple[Condition, ...]) -> tuple[Condition, ...]:
    kept: dict[tuple, Condition] = {}
    for asked in (one for part in several for one in part):
        key = (asked.u.element_hash(), asked.relation, tuple(guard.element_hash() for guard in asked.guards))
        kept.setdefault(key, asked)
    return tuple(kept.values())


def _asked(op: int, args: list[ca.SX]) -> list[Condition]:
    u = args[0]
    rules: dict[int, Callable[[], list[tuple[ca.SX, str, str]]]] = {
        ca.OP_DIV: lambda: [(args[1], NONZERO, "a division")],
        ca.OP_INV: lambda: [(u, NONZERO, "a division")],
        ca.OP_FMOD: lambda: [(args[1], NONZERO, "fmod")],
        ca.OP_REMAINDER: lambda: [(args[1], NONZERO, "a remainder")],
        ca.OP_LOG: lambda: [(u, POSITIVE, "a logarithm")],
        ca.OP_LOG1P: lambda: [(u + 1, POSITIVE, "a logarithm")],
        ca.OP_SQRT: lambda: [(u, NONNEGATIVE, "a root")],
        ca.OP_TAN: lambda: [(ca.cos(u), NONZERO, "a tangent")],
        ca.OP_ASIN: lambda: [(1 - u * u, NONNEGATIVE, "an arcsine")],
        ca.OP_ACOS: lambda: [(1 - u * u, NONNEGATIVE, "an arccosine")],
        ca.OP_ACOSH: lambda: [(u - 1, NONNEGATIVE, "acosh")],
        ca.OP_ATANH: lambda: [(1 - u * u, POSITIVE, "atanh")],
        ca.OP_POW: lambda: _power(u, args[1]),
        ca.OP_CONSTPOW: lambda: _power(u, args[1]),
    }
    if op not in rules:
        return []
    asked = [(*_inner(u, relation), name) for u, relation, name in rules[op]()]
    return [Condition(*one) for one in asked if not (one[0].is_constant() and _met(float(one[0]), one[1]))]


def _inner(u: ca.SX, relation: str) -> tuple[ca.SX, str]:
    """The same asked of what |v|, v^2 and sqrt(v) are made of: where they are not 0, v is not."""
    even = ca.OP_FABS, ca.OP_SQ, ca.OP_SQRT
    while relation != NONNEGATIVE and not (u.is_constant() or u.is_symbolic()) and u.op() in even:
        u, relation = u.dep(0), POSITIVE if u.op() == ca.OP_SQRT else NONZERO
    return u, relation


def _power(base: ca.SX, exponent: ca.SX) -> list[tuple[ca.SX, str, str]]:
    if not exponent.is_constant():
        return [(base, POSITIVE, "a power")]
    power = float(exponent)
    if power == round(power):
        return [(base, NONZERO, "a power")] if power < 0 else []
    return [(base, NONNEGATIVE if power > 0 else POSITIVE, "a power")]


def _met(value: float, relation: str) -> bool:
    return value != 0 if relation == NONZERO else value > 0 if relation == POSITIVE else value >= 0


def in_time(expr: ca.SX, t: ca.SX, low: float, high: float, others: ca.SX | None = None, at: np.ndarray | None = None) -> Defined:
    """Decide whether the operations on t alone leave ``expr`` defined and bounded for low <= t <= high.

    A condition that fails is a violation where ``expr``, the other symbols at ``at``, is seen to have no value from there on or
    to grow without bound towards it; where that is not seen it is undecided.

    Args:
        expr: any shape, in t and ``others``.
        t: the time symbol.
        low, high: the interval.
        others, at: symbols (n, 1) and their values (n,).
    """
    if ca.OP_CALL in operations(expr):
        return Defined(UNKNOWN, "a Function that cannot be looked into may be undefined at some time")
    rest, here = (ca.SX(0, 1), np.zeros(0)) if others is None or at is None else (others, at)
    f = ca.Function("f", [t, rest], [ca.densify(ca.vec(expr))])
    undecided: Defined | None = None
    for asked in conditions(expr):
        if any(symbol.element_hash() != t.element_hash() for symbol in ca.symvar(asked.u)):
            continue
        failure = _fails(asked, t, low, high)
        if failure is None:
            continue
        how = f"{asked.name} asks for {_short(asked.u)} {asked.relation}"
        if failure.sure and (_undefined(f, failure, here) or _grows(f, failure.at, low, high, here)):
            return Defined(VIOLATED, f"{how}, which fails at t = {failure.at:.9g}", failure.at)
        undecided = Defined(UNKNOWN, f"{how}, which is not decided near t = {failure.at:.6g}", failure.at)
    return undecided or Defined(HOLDS, "")


class _Failure(NamedTuple):
    """A condition fails from or at a time: proved (``sure``) or not excluded; ``wrong``: a time where u has the wrong sign."""

    at: float
    sure: bool
    wrong: float | None = None


def _fails(asked: Condition, t: ca.SX, low: float, high: float) -> _Failure | None:
    """The first failure; None where the condition is proved."""
    p = polynomial.read(asked.u, t)[0] if ca.symvar(asked.u) else None
    if p is not None and any(_implies(guard, p, t, asked.relation) for guard in asked.guards):
        return None
    if p is not None and not asked.guards:
        return _polynomial(polynomial.coefficients(p), asked.relation, Fraction(low), Fraction(high))
    return _by_parts(asked, t, low, high)


def _implies(guard: ca.SX, p: polynomial.Polynomial, t: ca.SX, relation: str) -> bool:
    """Whether a guard a < b, a <= b or its negation says what is asked of p, a multiple > 0 of the difference."""
    negated = guard.op() == ca.OP_NOT
    inner = guard.dep(0) if negated else guard
    strict = (inner.op() == ca.OP_LT) != negated
    if inner.op() not in (ca.OP_LT, ca.OP_LE) or not (strict or relation == NONNEGATIVE):
        return False
    v = polynomial.read((inner.dep(0) - inner.dep(1)) * (1 if negated else -1), t)[0]
    if not v or set(v) != set(p):
        return False
    ratios = {p[monomial] / v[monomial] for monomial in v}
    return len(ratios) == 1 and ratios.pop() > 0


def _polynomial(c: list[Fraction], relation: str, low: Fraction, high: Fraction) -> _Failure | None:
    """Exactly: the first root in the interval, or the first time after which the sign is wrong."""
    if not any(c):
        return None if relation == NONNEGATIVE else _Failure(float(low), True)
    roots = polynomial_signs.real_roots(c, low, high)
    wrong = None if relation == NONZERO else polynomial_signs.negative_point(c, low, high)
    if relation == NONNEGATIVE and wrong is None:
        return None
    if roots:
        at = low if wrong is not None and wrong < roots[0][0] else sum(roots[0]) / 2
        return _Failure(float(at), True, None if wrong is None else float(wrong))
    return None if wrong is None else _Failure(float(low), True, float(wrong))


def _by_parts(asked: Condition, t: ca.SX, low: float, high: float) -> _Failure | None:
    """By bounds of u on parts of the interval, cut where its sign is open."""
    parts = np.array([[low, high]])
    signs: list[tuple[float, int]] = []
    left: list[float] = []
    least, looked = LEAST * (high - low), 0
    while len(parts):
        looked += len(parts)
        a, b = (np.ravel(end) for end in _bounds(asked.u, t, parts[:, 0], parts[:, 1]))
        good = (a > 0) | ((a >= 0) & (asked.relation == NONNEGATIVE)) | ((b < 0) & (asked.relation == NONZERO))
        for guard in asked.guards:
            may = _bounds(guard, t, parts[:, 0], parts[:, 1])
            good |= (np.ravel(may[0]) == 0) & (np.ravel(may[1]) == 0)
        clear = (a > 0) | (b < 0)
        signs += [(float(x), 1 if lo > 0 else -1) for x, lo in zip(parts[clear].mean(axis=1), a[clear], strict=True)]
        if asked.relation != NONZERO and (b < 0).any() and not asked.guards:
            wrong = float(parts[b < 0].mean(axis=1).min())
            before = [x for x, sign in signs if sign > 0 and x < wrong]
            return _Failure(_crossing(asked.u, t, max(before), wrong) if before else low, True, wrong)
        parts = parts[~good]
        small = (parts[:, 1] - parts[:, 0]) <= least
        left += list(parts[small].mean(axis=1))
        parts = parts[~small]
        if looked > PARTS:
            left += list(parts.mean(axis=1))
            break
        middle = parts.mean(axis=1)
        parts = np.vstack([np.column_stack([parts[:, 0], middle]), np.column_stack([middle, parts[:, 1]])])
    if not left:
        return None
    at = min(left)
    around = [(x, sign) for x, sign in sorted(signs)]
    before = [sign for x, sign in around if x < at]
    after = [sign for x, sign in around if x > max(x_ for x_ in left if x_ - at <= 4 * least)]
    changes = bool(before and after and before[-1] != after[0])
    known = interval.is_continuous(asked.u, t, np.array([low]), np.array([high]))
    exact = any(_zero(asked.u, t, x) for x in (at, round(at, 12), round(at, 9), low, high))
    return _Failure(at, not asked.guards and (exact or (changes and known)))


def _bounds(u: ca.SX, t: ca.SX, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    code = interval.program(u, t)
    found = interval.mean_value(code, low[:, None], high[:, None])
    return np.broadcast_to(found.lo[0], low.shape), np.broadcast_to(found.hi[0], low.shape)


def _zero(u: ca.SX, t: ca.SX, x: float) -> bool:
    a, b = interval.enclose(u, t, np.array([x]), np.array([x]))
    return float(np.ravel(a)[0]) == 0 == float(np.ravel(b)[0])


def _crossing(u: ca.SX, t: ca.SX, good: float, wrong: float) -> float:
    """Where u leaves what is asked, by bisection in doubles."""
    f = ca.Function("u", [t], [u])
    for _ in range(100):
        middle = (good + wrong) / 2
        good, wrong = (middle, wrong) if float(f(middle)) > 0 else (good, middle)
    return wrong


def _undefined(f: ca.Function, failure: _Failure, here: np.ndarray) -> bool:
    """Whether the expression has no value where u has the wrong sign."""
    return failure.wrong is not None and bool(np.isnan(np.array(f(failure.wrong, here))).any())


def _grows(f: ca.Function, at: float, low: float, high: float, here: np.ndarray) -> bool:
    """Whether the expression grows without end towards a time, seen from one side: no halving adds less than the one before."""
    for side in (-1.0, 1.0):
        times = at + side * NEAR * (high - low or 1.0)
        times = times[(times >= low) & (times <= high) & (np.abs(times - at) > 2.0**-44 * (abs(at) + high - low))]
        if len(times) < 12:
            continue
        sizes = np.array([np.abs(np.array(f(time, here))).max() for time in times])
        with np.errstate(all="ignore"):
            rise = np.diff(sizes)
        last = rise[-min(12, len(rise)) :]
        if np.isinf(sizes[-1]) or (np.isfinite(sizes).all() and (last > 0).all() and (last[1:] >= 0.9 * last[:-1]).all()):
            return True
    return False


def _short(u: ca.SX) -> str:
    text = str(u)
    return text if len(text) <= 60 else text[:57] + "..."
