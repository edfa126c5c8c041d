"""Leading terms of sums that cancel, and infima of functions of one variable, against 60 digits and closed forms."""

from fractions import Fraction

import casadi as ca
import mpmath
import numpy as np
import pytest
from fuzz_models import share

from nsmodel.proof import univariate
from nsmodel.proof.convex.directions import infimum_by_directions, is_convex_by_directions
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.expression_graph import additive_terms, fold_graph

S = ca.SX.sym("s")
X = ca.SX.sym("x", 2)
ZERO = Fraction(0)
GRID = [mpmath.mpf(10) ** k for k in np.linspace(-9, 9, 120)]
MP = {
    ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b, ca.OP_DIV: lambda a, b: a / b,
    ca.OP_NEG: lambda a: -a, ca.OP_TWICE: lambda a: 2 * a, ca.OP_SQ: lambda a: a * a, ca.OP_SQRT: mpmath.sqrt,
    ca.OP_EXP: mpmath.exp, ca.OP_LOG: mpmath.log, ca.OP_INV: lambda a: 1 / a, ca.OP_LOG1P: mpmath.log1p,
}  # fmt: skip
WHOLE = ConvexSet(X, ca.SX(0, 1), [])


def value(expr, at):
    return fold_graph(expr, lambda _: at, mpmath.mpf, lambda op, args: MP[op](*args))[0]


def infimum(expr):
    terms = additive_terms(expr)
    return univariate.infimum_bound(terms, S, ZERO, None, [{}] * len(terms))


@pytest.mark.parametrize(
    ("expr", "infimum_is"),
    [
        (S - ca.log(S), 1), (2 * S - 3 * ca.log(S), 3 - 3 * mpmath.log(1.5)), (S + 1 / S, 2), (ca.sqrt(1 + S**2) - S, 0),
        (ca.sqrt(S**2 + 2 * S + 5) - S, 1), (ca.sqrt(S**2 + 4 * S) - S, 0), (S - ca.sqrt(S**2 + 4 * S), -2),
        (ca.sqrt(2 * S**2 + 1) - ca.sqrt(2 * S**2 + 3), 1 - mpmath.sqrt(3)), (ca.log(1 + ca.exp(S)) - S, 0),
        (ca.log(ca.exp(S) + 3 * ca.exp(-S)) - S, 0), (ca.log(1 + S) - ca.log(3 + 2 * S), -mpmath.log(3)),
        (ca.log(3 + 2 * S) - ca.log(1 + S), mpmath.log(2)), (S**2 - S * ca.sqrt(S**2 + 1), -0.5),
        (-S * ca.exp(-S), -mpmath.exp(-1)),
        (ca.sqrt(S + 1) - ca.sqrt(S), 0), (ca.log(S) - S, -mpmath.inf), (-ca.log(1 + S), -mpmath.inf), (S - ca.sqrt(S), -0.25),
        (ca.sqrt(8 * S + 1) - 2 * ca.sqrt(2 * S + 3), 1 - 2 * mpmath.sqrt(3)), (ca.sin(S), None), (ca.log(S - 1), None),
    ],
)  # fmt: skip
def test_known_infima(expr, infimum_is):
    found = infimum(expr)
    if infimum_is is None or not mpmath.isfinite(infimum_is):
        assert found == (None if infimum_is is None else -np.inf)
    else:
        assert infimum_is - 1e-13 <= found <= infimum_is + 1e-30


def test_what_is_multiplied_by_0_is_looked_at():
    terms = [(Fraction(1), (S - ca.fabs(S)) * ca.log(S - 1)), (Fraction(1), S)]
    case = {0: ((1,), ZERO)}  # |s| = s, so that the factor is 0; the logarithm has no value below 1
    assert univariate.infimum_bound(terms, S, ZERO, None, [case, {}]) is None
    assert univariate.infimum_bound(terms[1:], S, ZERO, None, [{}]) == 0


def test_random_infima_are_below_all_values_and_near_the_least():
    rng, decided = np.random.default_rng(5), 0
    with mpmath.workdps(60):
        for _ in range(share(60)):
            a, b, c, d = (float(k) for k in rng.integers(1, 12, 4) / 4)
            whole = float(rng.integers(1, 5))
            atoms = [
                ca.sqrt(whole**2 * S**2 + a * S + b) - whole * S, ca.sqrt(a * S + b) - ca.sqrt(a * S + c),
                ca.log(1 + a * ca.exp(b * S)) - b * S, c * S - d * ca.log(a * S), a / (S + b), ca.exp(-a * S) * (S - b),
                ca.log(a + S) - ca.log(b + c * S), a * S**2 - b * S, d * S - ca.sqrt(S),
                ca.sqrt(whole**2 * S**4 + a * S**3) - whole * S**2,
            ]  # fmt: skip
            expr = sum(atoms[k] for k in rng.choice(len(atoms), int(rng.integers(1, 3)), replace=False))
            found = infimum(expr)
            if found is None:
                continue
            decided += 1
            values = [value(expr, at) for at in GRID]
            least = min(values)
            if found == -np.inf:
                assert values[-1] < -5 or values[0] < -5
                continue
            assert least >= found
            k = values.index(least)
            left, right = GRID[max(k - 1, 0)], GRID[min(k + 1, len(GRID) - 1)]
            for _ in range(80):  # the function falls, then rises: by thirds
                one, other = left + (right - left) / 3, right - (right - left) / 3
                left, right = (left, other) if value(expr, one) < value(expr, other) else (one, right)
            assert min(least, value(expr, left)) - found < 1e-3, (expr, found)
    assert decided > 0.8 * share(60)


@pytest.mark.parametrize(
    ("g", "bound", "tight"),
    [
        (ca.sqrt(1 + (X[0] + X[1]) ** 2) - X[0] - X[1], 0, True), (ca.exp(X[0]) - X[0] + ca.sqrt(4 + X[1] ** 2) - X[1], 1, True),
        (ca.exp(X[0] - X[1]) + ca.exp(X[0] + X[1]) - 2 * X[0], 2, True), (ca.fabs(X[0] - 3) + X[1] ** 2 - X[1], -0.25, True),
        (ca.exp(X[0]) + ca.exp(X[1]) + ca.exp(X[0] + X[1]) - X[0] - X[1], 2, False), (ca.sqrt(1 + X[0] ** 2) - X[1], None, None),
        (X[0] * X[1] + X[0] ** 2, None, None),
    ],
)  # fmt: skip
def test_sums_over_directions(g, bound, tight):
    found = infimum_by_directions(g, WHOLE)
    if bound is None:
        assert found is None
    elif tight:
        assert found.tight
        assert bound - 1e-12 <= found.bound <= bound
    else:
        assert not found.tight


@pytest.mark.parametrize(
    ("g", "low", "high", "convex"),
    [
        (S - ca.log(S), 0, np.inf, True), (S**1.5, 0, np.inf, True), (-ca.log(1 - S**2), -1, 1, True),
        (S * ca.log(S), 0, np.inf, False),
        (ca.sqrt(S), 0, np.inf, False), (-ca.sqrt(S), 0, np.inf, True), (ca.sqrt(1 + S**2), -np.inf, np.inf, True),
        (S**3, -1, 1, False),
        (1 / S, 0, np.inf, True), (1 / S, -1, np.inf, False), (ca.log(S), 0, np.inf, False),
        (ca.exp(S) - ca.log(2 - S), -np.inf, 2, True),
    ],
)  # fmt: skip
def test_convexity_up_to_open_ends(g, low, high, convex):
    rows = [S - low] * bool(np.isfinite(low)) + [high - S] * bool(np.isfinite(high))
    assert is_convex_by_directions(g, ConvexSet(S, ca.vertcat(ca.SX(0, 1), *rows), [str(row) for row in rows])) == convex
