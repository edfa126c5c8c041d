"""Is an expression of time defined and finite on an interval: roots, poles and logarithms, decided by bounds and exact roots.

Each operation with a limited domain asks something of an argument u(t): u != 0 of a division, u > 0 of a logarithm, u >= 0 of a
root. Where u is a polynomial its roots are isolated exactly; else its sign is bounded by intervals on ever smaller parts.

Is an expression defined on a box of states.

Is a continuous function of time absolutely continuous: its graph is tame, so that it has finitely many monotone pieces.

What is made of arithmetic, powers, roots, exp and log, of moduli, maxima, signs and cases, and of sines and other analytic
functions on bounded arguments is definable in the o-minimal structure R_an,exp (van den Dries and Miller 1994). By its theorem on
monotonicity a compact interval falls into finitely many pieces on each of which it is C1 and monotone or constant; where it is
continuous, each piece is the integral of its derivative. t sin(1/t) is continuous, but sin has an unbounded argument.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import extremum, interval_bounds, polynomial
from nsmodel.proof.expression_graph import apply_operation, fold_graph, is_same_expression, operation_codes, symbol_hashes
from nsmodel.proof.verdict import HOLDS, UNKNOWN, VIOLATED

MAX_TIME_PARTS = 20_000  # Parts of the interval looked at: the middles of those that are left are then tried as singular times.
MIN_TIME_PART = 2.0**-46  # How small they get beside the interval: some 100 doubles of the size of its length are in one.
# Distances from a singular time, beside the interval, at which growth is looked at: the nearest are 32 times what is too near.
GROWTH_DISTANCES = 2.0 ** -np.arange(6.0, 40.0)
NONZERO, POSITIVE, NONNEGATIVE = "!= 0", "> 0", ">= 0"


class DomainCondition(NamedTuple):
    """What an operation asks of its argument; ``guards``: only where these conditions may be true."""

    u: ca.SX
    relation: str
    name: str
    guards: tuple[ca.SX, ...] = ()


class DefinednessResult(NamedTuple):
    """Whether all conditions hold on the interval; ``at``: the time where one fails, ``how`` in words."""

    verdict: str
    how: str
    at: float | None = None


class _ConditionNode(NamedTuple):
    expr: ca.SX
    conditions: tuple[DomainCondition, ...]


def domain_conditions(expr: ca.SX) -> list[DomainCondition]:
    """What the operations of an expression ask of their arguments."""

    def apply(op: int, args: list[_ConditionNode]) -> _ConditionNode:
        own = [arg.expr for arg in args]
        if op == ca.OP_IF_ELSE_ZERO:
            inner = tuple(condition._replace(guards=(*condition.guards, own[0])) for condition in args[1].conditions)
            return _ConditionNode(apply_operation(op, own), _merge_conditions(args[0].conditions, inner))
        return _ConditionNode(
            apply_operation(op, own), _merge_conditions(*(arg.conditions for arg in args), tuple(_operation_conditions(op, own)))
        )

    nodes = fold_graph(expr, lambda symbol: _ConditionNode(symbol, ()), lambda number: _ConditionNode(ca.SX(number), ()), apply)
    return list(_merge_conditions(*(node.conditions for node in nodes)))


def _merge_conditions(*several: tuple[DomainCondition, ...]) -> tuple[DomainCondition, ...]:
    kept: dict[tuple, DomainCondition] = {}
    for condition in (one for part in several for one in part):
        key = (condition.u.element_hash(), condition.relation, tuple(guard.element_hash() for guard in condition.guards))
        kept.setdefault(key, condition)
    return tuple(kept.values())


def _operation_conditions(op: int, args: list[ca.SX]) -> list[DomainCondition]:
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
        ca.OP_POW: lambda: _power_conditions(u, args[1]),
        ca.OP_CONSTPOW: lambda: _power_conditions(u, args[1]),
    }
    if op not in rules:
        return []
    required = [(*_innermost_argument(u, relation), name) for u, relation, name in rules[op]()]
    known = (one[0].is_constant() and satisfies_relation(float(one[0]), one[1]) for one in required)
    return [DomainCondition(*one) for one, met in zip(required, known, strict=True) if not met and not _is_either_order(one[0])]


def _is_either_order(u: ca.SX) -> bool:
    """Whether u = (a <= b) + (b <= a), which is not 0: derivatives of fmax and fmin divide by it."""
    if u.is_constant() or u.is_symbolic() or u.op() != ca.OP_ADD:
        return False
    left, right = u.dep(0), u.dep(1)
    if any(part.is_constant() or part.is_symbolic() or part.op() != ca.OP_LE for part in (left, right)):
        return False
    return is_same_expression(left.dep(0), right.dep(1)) and is_same_expression(left.dep(1), right.dep(0))


def _innermost_argument(u: ca.SX, relation: str) -> tuple[ca.SX, str]:
    """The same asked of what |v|, v^2 and sqrt(v) are made of: where they are not 0, v is not."""
    even = ca.OP_FABS, ca.OP_SQ, ca.OP_SQRT
    while relation != NONNEGATIVE and not (u.is_constant() or u.is_symbolic()) and u.op() in even:
        u, relation = u.dep(0), POSITIVE if u.op() == ca.OP_SQRT else NONZERO
    return u, relation


def _power_conditions(base: ca.SX, exponent: ca.SX) -> list[tuple[ca.SX, str, str]]:
    if not exponent.is_constant():
        return [(base, POSITIVE, "a power")]
    power = float(exponent)
    if power == round(power):
        return [(base, NONZERO, "a power")] if power < 0 else []
    return [(base, NONNEGATIVE if power > 0 else POSITIVE, "a power")]


def satisfies_relation(value: float | Fraction, relation: str) -> bool:
    """Whether a number is what a condition asks for."""
    return value != 0 if relation == NONZERO else value > 0 if relation == POSITIVE else value >= 0


def is_defined_on_box(
    expr: ca.SX, x: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, *, where: ca.SX | None = None,
    bounded: ca.SX | None = None,
) -> bool:  # fmt: skip
    """Whether an expression is proved to have a value at each x of a box of z, as far as that is for x to decide.

    Derivatives do not tell: that of x (1/x + 1) is 1, and at 0 there is no value. What an operation asks of other symbols
    alone, of time, is not looked at.

    Args:
        expr: of any shape, in the symbols z.
        x: some of z; lower, upper: the box of z, with ends that may be infinite.
        where: rows that are >= 0 where a value is asked for; None: everywhere in the box.
        bounded: an expression that is bounded on the box, a derivative: what it asks for too is not looked at.
    """
    if ca.OP_CALL in operation_codes(expr):  # nothing is known of what cannot be looked into
        return False
    own, known = symbol_hashes(x), [] if bounded is None else [one.u for one in domain_conditions(ca.densify(ca.vec(bounded)))]
    conditions = [condition for condition in domain_conditions(ca.densify(ca.vec(expr))) if symbol_hashes(condition.u) & own]
    conditions = [condition for condition in conditions if not any(is_same_expression(condition.u, u) for u in known)]
    return all(_is_met_on_box(condition, z, lower, upper, where) for condition in conditions)


def _is_met_on_box(condition: DomainCondition, z: ca.SX, lower: np.ndarray, upper: np.ndarray, where: ca.SX | None) -> bool:
    """By bounds of what is asked for, its guards left aside."""
    low, high = (float(np.ravel(end)[0]) for end in interval_bounds.enclose(condition.u, z, lower, upper))
    if (low > 0) or (low >= 0 and condition.relation == NONNEGATIVE) or (high < 0 and condition.relation == NONZERO):
        return True
    signs = (1, -1) if condition.relation == NONZERO else (1,)
    bounds = [extremum.supremum(-sign * condition.u, z, lower, upper, where=where, bound_to=0.0).bound for sign in signs]
    return any(bound <= 0 if condition.relation == NONNEGATIVE else bound < 0 for bound in bounds)


def check_defined_in_time(
    expr: ca.SX, t: ca.SX, low: float, high: float, others: ca.SX | None = None, at: np.ndarray | None = None
) -> DefinednessResult:
    """Decide whether the operations on t alone leave ``expr`` defined and bounded for low <= t <= high.

    A condition that fails is a violation where ``expr``, the other symbols at ``at``, is seen to have no value from there on or
    to grow without bound towards it; where that is not seen it is undecided.

    Args:
        expr: any shape, in t and ``others``.
        t: the time symbol.
        low, high: the interval.
        others, at: symbols (n, 1) and their values (n,).
    """
    if ca.OP_CALL in operation_codes(expr):
        return DefinednessResult(UNKNOWN, "a Function that cannot be looked into may be undefined at some time")
    rest, here = (ca.SX(0, 1), np.zeros(0)) if others is None or at is None else (others, at)
    f = ca.Function("f", [t, rest], [ca.densify(ca.vec(expr))])
    undecided: DefinednessResult | None = None
    for condition in domain_conditions(expr):
        if any(symbol.element_hash() != t.element_hash() for symbol in ca.symvar(condition.u)):
            continue
        failure = _first_failure(condition, t, low, high)
        if failure is None:
            continue
        how = f"{condition.name} asks for {_shorten_expression(condition.u)} {condition.relation}"
        if failure.proved and (_is_undefined(f, failure, here) or _grows_without_bound(f, failure.at, low, high, here)):
            return DefinednessResult(VIOLATED, f"{how}, which fails at t = {failure.at:.9g}", failure.at)
        undecided = DefinednessResult(UNKNOWN, f"{how}, which is not decided near t = {failure.at:.6g}", failure.at)
    return undecided or DefinednessResult(HOLDS, "")


class _DomainFailure(NamedTuple):
    """A condition fails from or at a time: proved (``sure``) or not excluded; ``wrong``: a time where u has the wrong sign."""

    at: float
    proved: bool
    wrong: float | None = None


def _first_failure(condition: DomainCondition, t: ca.SX, low: float, high: float) -> _DomainFailure | None:
    """The first failure; None where the condition is proved."""
    p = polynomial.read_polynomials(condition.u, t)[0] if ca.symvar(condition.u) else None
    if p is not None and any(_guard_implies(guard, p, t, condition.relation) for guard in condition.guards):
        return None
    if p is not None and not condition.guards:
        return _polynomial_failure(polynomial.univariate_coefficients(p), condition.relation, Fraction(low), Fraction(high))
    return _failure_by_parts(condition, t, low, high)


def _guard_implies(guard: ca.SX, p: polynomial.Polynomial, t: ca.SX, relation: str) -> bool:
    """Whether a guard a < b, a <= b or its negation says what is asked of p, a multiple > 0 of the difference."""
    negated = guard.op() == ca.OP_NOT
    inner = guard.dep(0) if negated else guard
    strict = (inner.op() == ca.OP_LT) != negated
    if inner.op() not in (ca.OP_LT, ca.OP_LE) or not (strict or relation == NONNEGATIVE):
        return False
    v = polynomial.read_polynomials((inner.dep(0) - inner.dep(1)) * (1 if negated else -1), t)[0]
    if not v or set(v) != set(p):
        return False
    ratios = {p[monomial] / v[monomial] for monomial in v}
    return len(ratios) == 1 and ratios.pop() > 0


def _polynomial_failure(c: list[Fraction], relation: str, low: Fraction, high: Fraction) -> _DomainFailure | None:
    """Exactly: the first root in the interval, or the first time after which the sign is wrong."""
    if not any(c):
        return None if relation == NONNEGATIVE else _DomainFailure(float(low), True)
    roots = polynomial.real_roots(c, low, high)
    wrong = None if relation == NONZERO else polynomial.negative_point(c, low, high)
    if relation == NONNEGATIVE and wrong is None:
        return None
    if roots:
        at = low if wrong is not None and wrong < roots[0][0] else sum(roots[0]) / 2
        return _DomainFailure(float(at), True, None if wrong is None else float(wrong))
    return None if wrong is None else _DomainFailure(float(low), True, float(wrong))


def _failure_by_parts(condition: DomainCondition, t: ca.SX, low: float, high: float) -> _DomainFailure | None:
    """By bounds of u on parts of the interval, cut where its sign is open."""
    parts = np.array([[low, high]])
    signs: list[tuple[float, int]] = []
    left: list[float] = []
    least, looked = MIN_TIME_PART * (high - low), 0
    while len(parts):
        looked += len(parts)
        a, b = (np.ravel(end) for end in _time_bounds(condition.u, t, parts[:, 0], parts[:, 1]))
        good = (a > 0) | ((a >= 0) & (condition.relation == NONNEGATIVE)) | ((b < 0) & (condition.relation == NONZERO))
        for guard in condition.guards:
            may = _time_bounds(guard, t, parts[:, 0], parts[:, 1])
            good |= (np.ravel(may[0]) == 0) & (np.ravel(may[1]) == 0)
        clear = (a > 0) | (b < 0)
        signs += [(float(x), 1 if lo > 0 else -1) for x, lo in zip(parts[clear].mean(axis=1), a[clear], strict=True)]
        if condition.relation != NONZERO and (b < 0).any() and not condition.guards:
            wrong = float(parts[b < 0].mean(axis=1).min())
            before = [x for x, sign in signs if sign > 0 and x < wrong]
            return _DomainFailure(_bisect_crossing(condition.u, t, max(before), wrong) if before else low, True, wrong)
        parts = parts[~good]
        small = (parts[:, 1] - parts[:, 0]) <= least
        left += list(parts[small].mean(axis=1))
        parts = parts[~small]
        if looked > MAX_TIME_PARTS:
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
    known = interval_bounds.is_continuous(condition.u, t, np.array([low]), np.array([high]))
    exact = any(_vanishes_at_time(condition.u, t, x) for x in (at, round(at, 12), round(at, 9), low, high))
    return _DomainFailure(at, not condition.guards and (exact or (changes and known)))


def _time_bounds(u: ca.SX, t: ca.SX, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    code = interval_bounds.program(u, t)
    found = interval_bounds.mean_value_form(code, low[:, None], high[:, None])
    return np.broadcast_to(found.lo[0], low.shape), np.broadcast_to(found.hi[0], low.shape)


def _vanishes_at_time(u: ca.SX, t: ca.SX, x: float) -> bool:
    a, b = interval_bounds.enclose(u, t, np.array([x]), np.array([x]))
    return float(np.ravel(a)[0]) == 0 == float(np.ravel(b)[0])


def _bisect_crossing(u: ca.SX, t: ca.SX, good: float, wrong: float) -> float:
    """Where u leaves what is asked, by bisection in doubles."""
    f = ca.Function("u", [t], [u])
    for _ in range(100):
        middle = (good + wrong) / 2
        good, wrong = (middle, wrong) if float(f(middle)) > 0 else (good, middle)
    return wrong


def _is_undefined(f: ca.Function, failure: _DomainFailure, here: np.ndarray) -> bool:
    """Whether the expression has no value where u has the wrong sign."""
    return failure.wrong is not None and bool(np.isnan(np.array(f(failure.wrong, here))).any())


def _grows_without_bound(f: ca.Function, at: float, low: float, high: float, here: np.ndarray) -> bool:
    """Whether the expression grows without end towards a time, seen from one side: no halving adds less than the one before."""
    for side in (-1.0, 1.0):
        times = at + side * GROWTH_DISTANCES * (high - low or 1.0)
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


def _shorten_expression(u: ca.SX) -> str:
    text = str(u)
    return text if len(text) <= 60 else text[:57] + "..."


TAME_OPERATIONS = frozenset({
    ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_INV, ca.OP_NEG, ca.OP_SQ, ca.OP_TWICE, ca.OP_SQRT, ca.OP_POW,
    ca.OP_CONSTPOW, ca.OP_EXP, ca.OP_EXPM1, ca.OP_LOG, ca.OP_LOG1P, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH,
    ca.OP_ATANH, ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN, ca.OP_SIGN, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR,
    ca.OP_NOT, ca.OP_IF_ELSE_ZERO, ca.OP_ASIN, ca.OP_ACOS, ca.OP_HYPOT,
})  # fmt: skip
TAME_ON_COMPACT_SETS = frozenset(
    {ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ATAN, ca.OP_ERF, ca.OP_FLOOR, ca.OP_CEIL}
)  # tame on compact intervals


def is_absolutely_continuous(expr: ca.SX, t: ca.SX, low: float, high: float) -> bool:
    """Whether each entry of an expression of t is proved to be absolutely continuous on [low, high].

    >>> t = ca.SX.sym("t")
    >>> [is_absolutely_continuous(f, t, 0.0, 1.0) for f in (ca.sqrt(t), t**0.3 * ca.sin(t), ca.sign(t - 0.5), t * ca.sin(1 / t))]
    [True, True, False, False]
    """
    ends = np.array([low]), np.array([high])
    arguments: list[ca.SX] = []
    tame = True

    def apply(op: int, args: list[ca.SX]) -> ca.SX:
        nonlocal tame
        tame = tame and op in TAME_OPERATIONS | TAME_ON_COMPACT_SETS
        if op in TAME_ON_COMPACT_SETS:
            arguments.append(args[0])
        return apply_operation(op, args)

    fold_graph(ca.densify(ca.vec(expr)), lambda symbol: symbol, ca.SX, apply)
    if not tame or not np.isfinite(interval_bounds.enclose(expr, t, *ends)).all():
        return False
    if arguments and not np.isfinite(interval_bounds.enclose(ca.vertcat(*arguments), t, *ends)).all():
        return False
    return interval_bounds.is_continuous(expr, t, *ends)
