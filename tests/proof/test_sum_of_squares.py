"""Sums of squares: the identity and the matrix of each certificate exactly, and brute force against what they prove."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

from nsmodel.proof import exact, polynomial, sum_of_squares

X = ca.SX.sym("x", 3)
A, B, C = ca.vertsplit(X)


def read(expr):
    (p,) = polynomial.read_polynomials(expr, X)
    return p


def expanded(found):
    total = {}
    for i, left in enumerate(found.monomials):
        for j, right in enumerate(found.monomials):
            power = tuple((v, k + l) for v, (k, l) in enumerate(zip(left, right, strict=True)) if k + l)
            total = polynomial.add_multiple(total, {power: found.G[i, j]})
    return total


SQUARES = {
    "definite": A**4 + A**2 * B**2 + B**4 + C**2 + 1,
    "with a line of zeros": A**4 + 4 * A**3 * B + 6 * A**2 * B**2 + 4 * A * B**3 + B**4,
    "with two points of zeros": (A**2 - 1) ** 2 + (B - A) ** 2,
    "of degree 6": (A**3 - B * C) ** 2 + (A - C) ** 2,
    "in small units": 1e-6 * ((A / 0.001) ** 4 + 6 * (A / 0.001) ** 2 * (B / 0.001) ** 2 + (B / 0.001) ** 4),
    "of mixed units": (1e3 * A - 1e-3 * B**2) ** 2 + 1e-9 * C**2,
}


@pytest.mark.parametrize("name", SQUARES)
def test_a_certificate_is_exact(name):
    p = read(SQUARES[name])
    found = sum_of_squares.sos_decomposition(p, 3)
    assert found is not None
    assert expanded(found) == p
    assert exact.definiteness(found.G).psd


@pytest.mark.parametrize(
    "expr",
    [
        A**4 * B**2 + A**2 * B**4 - 3 * A**2 * B**2 + 1,  # Motzkin: >= 0, and no sum of squares
        A**4 - A**2 * B**2 + B**4 - 3 * A**2 * B**2, A**3 + B**2, A**2 - B**2, -1 + 0 * A, A * B,
    ],
)  # fmt: skip
def test_what_is_no_sum_of_squares_has_no_certificate(expr):
    assert sum_of_squares.sos_decomposition(read(expr), 3) is None


def test_zero_and_numbers():
    assert sum_of_squares.sos_decomposition({}, 3) is not None
    assert sum_of_squares.sos_decomposition({(): Fraction(2)}, 3) is not None
    assert sum_of_squares.sos_decomposition({(): Fraction(-2)}, 3) is None
    assert sum_of_squares.sos_lower_bound({(): Fraction(-2)}, 3) == -2


@pytest.mark.parametrize(
    ("expr", "least"),
    [
        (A**4 / 4 + B**4 / 4 - A * B, -0.5), ((A**2 - 1) ** 2 + B**2 + C**2, 0), (A**4 + B**2 - A, -3 / 4 * 4 ** (-1 / 3)),
        (1e4 * ((A / 100) ** 4 / 4 + (B / 100) ** 4 / 4 - A * B / 1e4), -5000.0), ((A * B - 1) ** 2 + A**2 + 3, 3),
    ],
)  # fmt: skip
def test_a_lower_bound_is_below_and_close(expr, least):
    found = float(sum_of_squares.sos_lower_bound(read(expr), 3))
    assert found <= least + 1e-15 * abs(least)
    assert found == pytest.approx(least, abs=1e-4 * (1 + abs(least)))


@pytest.mark.parametrize(
    ("expr", "convex"),
    [
        ((A**2 + B**2) ** 2, True), (A**4 + B**4 + A**2 * B**2, True), (A**4 + B**4 + 6 * A**2 * B**2, True),
        (A**4 + B**4 + 6.5 * A**2 * B**2, False), ((A - B) ** 4 + (B - C) ** 4 + A - C, True), (A**4 - A**2 + B**2, False),
        ((A - B**2) ** 2 + A**2 + 3 * B**2, False), (A**2 * B**2 + A**2 + B**2, False), (A**4 + A * B + B**2 / 4, False),
        (A**6 + B**6 + A**2 + C, True), (A**3 + A**2, False), (A + 2 * B, True),
    ],
)  # fmt: skip
def test_convexity_by_sums_of_squares(expr, convex):
    assert sum_of_squares.is_sos_convex(read(expr), 3) == convex


def test_nothing_that_is_proved_is_contradicted_by_points():
    rng, proved = np.random.default_rng(0), 0
    points = np.vstack([rng.normal(size=(400, 3)) * size for size in (0.1, 1, 10)])
    for _ in range(share(150, 110)):
        forms = [sum(float(k) * v for k, v in zip(rng.integers(-2, 3, 3), (A, B, C), strict=True)) for _ in range(3)]
        expr = sum(float(rng.choice([1, 1, 0.5, -0.2])) * form ** int(rng.choice([2, 4])) for form in forms)
        expr += float(rng.choice([0, 0, 1, -1])) * A * B + float(rng.choice([0, 0.3, -0.3])) * A**2 * B**2
        p = read(expr)
        if not p:
            continue
        if sum_of_squares.is_sos_convex(p, 3):
            proved += 1
            H = np.array(ca.Function("H", [X], [ca.hessian(expr, X)[0]])(points.T)).reshape(3, -1, 3).transpose(1, 0, 2)
            values = np.linalg.eigvalsh(H)
            assert (values[:, 0] >= -1e-9 * (1 + values[:, -1])).all(), expr
        bound = sum_of_squares.sos_lower_bound(p, 3)
        if bound is not None:
            values = np.array(ca.Function("p", [X], [expr])(points.T)).ravel()
            assert values.min() >= float(bound) - 1e-9 * (1 + np.abs(values).max() * 1e-6), expr
    assert proved > 8
