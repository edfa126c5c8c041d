"""Signs of functions of one variable against their values in 50 digits."""

from fractions import Fraction
from itertools import pairwise

import casadi as ca
import mpmath
import numpy as np
import pytest
from fuzz_models import share

from nsmodel.proof import univariate
from nsmodel.proof.expression_graph import fold_graph

S = ca.SX.sym("s")
ZERO = Fraction(0)
MP = {
    ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b, ca.OP_DIV: lambda a, b: a / b,
    ca.OP_NEG: lambda a: -a, ca.OP_TWICE: lambda a: 2 * a, ca.OP_SQ: lambda a: a * a, ca.OP_SQRT: mpmath.sqrt,
    ca.OP_EXP: mpmath.exp, ca.OP_LOG: mpmath.log, ca.OP_TANH: mpmath.tanh, ca.OP_SINH: mpmath.sinh, ca.OP_COSH: mpmath.cosh,
    ca.OP_POW: mpmath.power, ca.OP_CONSTPOW: mpmath.power, ca.OP_ATAN: mpmath.atan, ca.OP_INV: lambda a: 1 / a,
}  # fmt: skip


def value(expr, at):
    return fold_graph(expr, lambda _: at, mpmath.mpf, lambda op, args: MP[op](*args))[0]


def second(expr, at):
    h = at * mpmath.mpf(10) ** -16
    return (value(expr, at + h) - 2 * value(expr, at) + value(expr, at - h)) / h**2


@pytest.mark.parametrize(
    ("expr", "signs"),
    [
        (ca.exp(S) - S - 1, [1]), (ca.sinh(S) - S, [1]), (S - ca.tanh(S), [1]), (ca.exp(-S) - 1 + S / 2, [-1, 1]),
        (S * ca.exp(-S) - 0.25, [-1, 1, -1]), (ca.sqrt(1 + S**2) - S, [1]), (ca.sqrt(1 + S) - 1 - S / 2, [-1]),
        ((S - 1) ** 2, [1]), (ca.exp(2 * S) - 4 * ca.exp(S) + 4, None), (S**1.5 - S, [-1, 1]), (ca.sin(S), None), (0 * S, [0]),
        (ca.exp(S**2) - ca.exp(3 * S), [-1, 1]),
    ],
)  # fmt: skip
def test_signs_of_known_functions(expr, signs):
    found = univariate.decide_signs(expr, S)
    assert (None if found is None else found.signs) == signs


def test_signs_and_places_agree_with_50_digits():
    rng, decided = np.random.default_rng(1), 0
    with mpmath.workdps(50):
        for _ in range(share(80)):
            a, b, c, d = (float(k) for k in np.round(rng.uniform(0.1, 3, 4), 2))
            atoms = [
                S * ca.sqrt(a + S**2), S * ca.tanh(b * S), ca.log(1 + c * S), S * ca.log(1 + d * S), S**2 / (a + S**2),
                ca.exp(-b * S),
                ca.sqrt(S**3 + c * S**4), S**1.5, S * ca.exp(-d * S), ca.cosh(a * S / 3), S * ca.atan(S), S**3 / (b + S), S**3,
                ca.log(1 + ca.exp(c * S)), -(S**2), ca.sqrt(1 + S),
            ]  # fmt: skip
            chosen = rng.choice(len(atoms), int(rng.integers(1, 4)), replace=False)
            expr = sum(float(rng.choice([1, 1, -0.5])) * atoms[k] for k in chosen)
            found = univariate.second_derivative_signs([(Fraction(1), expr)], S, ZERO, None, [{}], ZERO)
            if found is None:
                continue
            decided += 1
            assert len(found.signs) == len(found.places) + 1
            assert all(left != right for left, right in pairwise(found.signs))
            ends = [float(end) for end, _ in found.places]
            for at in [*np.logspace(-5, 2, 60), *(end * (1 + off) for end in ends for off in (-1e-6, 1e-6))]:
                sign = found.signs[sum(end < at for end in ends)]
                assert second(expr, mpmath.mpf(at)) * sign > -1e-9, (expr, at)
    assert decided > 0.7 * share(80)


def test_the_slope_at_the_start():
    for expr, slope in [
        (S * ca.tanh(S), 0),
        (ca.sqrt(S**3 + S**4) + 2 * S, 2),
        (S**1.25, 0),
        (ca.exp(S) - S, 0),
        (ca.sinh(S), 1),
    ]:
        low, high = univariate.right_derivative_bounds(expr, S, ZERO, {})
        assert low <= slope <= high
        assert high - low <= 1e-15
    assert univariate.right_derivative_bounds(ca.sqrt(S), S, ZERO, {}) is None


@pytest.mark.parametrize(
    ("expr", "falls"),
    [
        (-ca.log(S + 2), True), (-ca.sqrt(S + 2), True), (-S, True), (ca.exp(-S), False), (-S / (1 + S), False),
        (ca.sqrt(1 + S**2) - S, False), (S - ca.exp(S), True), (ca.log(1 + ca.exp(S)) - 1.1 * S, True), (-ca.atan(S), False),
        (ca.log(1 + ca.exp(S)) - 0.9 * S, False), (ca.log(S + 1) - ca.sqrt(S), True),
    ],
)  # fmt: skip
def test_functions_that_fall_without_end(expr, falls):
    assert univariate.tends_to_minus_infinity([(Fraction(1), expr)], S, ZERO, [{}]) == falls
