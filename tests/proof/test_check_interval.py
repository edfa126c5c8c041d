"""Intervals and extrema: nothing lies outside a bound; known maxima are found; what cannot be proved is not."""

import itertools
from fractions import Fraction

import casadi as ca
import mpmath
import numpy as np
import pytest
from fuzz_models import share

from nsmodel.proof.affine_reduction import reduce_coordinates
from nsmodel.proof.extremum import (
    _eigenvalue_bound,
    _spectral_norm_bound,
    distance_to_inverse,
    largest_eigenvalue,
    samples,
    spectral_norm,
    spectral_norm_bounds,
    supremum,
)
from nsmodel.proof.interval_bounds import enclose, is_continuous, is_number, mean_value_form, program
from nsmodel.proof.interval_functions import OPERATIONS

INF = np.inf
UNARY = [
    ca.exp, ca.log, ca.sqrt, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.acosh,
    ca.atanh, ca.erf, ca.erfinv, ca.log1p, ca.expm1, ca.fabs, ca.sign, ca.floor, ca.ceil, ca.logic_not,
    lambda a: a**2, lambda a: 2 * a, lambda a: a**3, lambda a: a**-2, lambda a: a**-3, lambda a: a**2.5, lambda a: a**-1.5,
    lambda a: a**5, lambda a: ca.constpow(a, 5), lambda a: ca.constpow(a, -3), lambda a: ca.constpow(a, 4),
    lambda a: -a, lambda a: 1 / a,
]  # fmt: skip
BINARY = [
    lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / b, lambda a, b: a**b, ca.atan2, ca.hypot,
    ca.fmin, ca.fmax, ca.fmod, ca.remainder, ca.copysign, lambda a, b: a < b, lambda a, b: a <= b, lambda a, b: a == b,
    lambda a, b: a != b, lambda a, b: ca.if_else(a < b, a, 2 * b), lambda a, b: ca.logic_and(a < 0, b < 1),
    lambda a, b: ca.logic_or(a < 0, b < 1), lambda a, b: ca.if_else(a, b, 0),
]  # fmt: skip


def _tree(rng, symbols, depth, nodes):
    if depth == 0 or rng.random() < 0.1:
        numbers = [0, 1, -1, 2, 0.5, 0.1, -3, 1.7, np.pi]
        result = symbols[rng.integers(len(symbols))] if rng.random() < 0.8 else ca.SX(float(rng.choice(numbers)))
    elif rng.random() < 0.5:
        result = UNARY[rng.integers(len(UNARY))](_tree(rng, symbols, depth - 1, nodes))
    else:
        k = rng.integers(len(BINARY) + 8)
        a, b = (_tree(rng, symbols, depth - 1, nodes) for _ in range(2))
        result = BINARY[k if k < len(BINARY) else k % 4](a, b)
    nodes.append(ca.SX(result))
    return nodes[-1]


def _values(expr, x, points):
    """Values (numel, k), NaN where anything that ``expr`` is made of is not finite."""
    out = np.array(ca.Function("f", [x], [ca.densify(expr)])(points.T))
    return out if out.shape[1] == len(points) else np.tile(out, (1, len(points)))


def _fuzz(seed, count):
    """Random expressions with a box and points in it, corners included; the points where every part is finite."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        n = int(rng.integers(1, 4))
        x, nodes = ca.SX.sym("x", n), []
        expr = _tree(rng, ca.vertsplit(x), int(rng.integers(1, 5)), nodes)
        middle = rng.choice([0, 0, 1, -1, 0.5, 3, 10]) * rng.normal(size=n).round(rng.integers(0, 3))
        width = 10.0 ** rng.uniform(-3, 1, n) * (rng.random(n) < 0.9)
        lower, upper = middle - width * (rng.random(n) < 0.8) + 0.0, middle + width * (rng.random(n) < 0.8) + 0.0
        points = lower + (upper - lower) * rng.random((400, n))
        points[:60] = np.where(rng.random((60, n)) < 0.5, lower, upper)
        points[60:80] = points[60:80].round(1)
        points = np.clip(points, lower, upper)
        fine = np.isfinite(_values(ca.vertcat(*nodes), x, points)).all(axis=0)
        yield expr, x, lower, upper, points, fine


# -- bounds ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_no_value_of_a_random_expression_lies_outside(seed):
    """What is bounded is the exact value: as many ulps as rounding costs, beside the largest part, are allowed for."""
    seen = finite = 0
    for expr, x, lower, upper, points, fine in _fuzz(seed, 150):
        lo, hi = (end.item() for end in enclose(expr, x, lower, upper))
        assert lo <= hi
        values = _values(expr, x, points)[0, fine]
        seen, finite = seen + (values.size > 0), finite + np.isfinite([lo, hi]).all()
        assert ((lo <= values) & (values <= hi)).all(), (expr, lower, upper, lo, hi, values.min(), values.max())
    assert seen > 100
    assert finite > 90


@pytest.mark.parametrize("seed", range(4, 6))
def test_slopes_bound_every_difference(seed):
    checked = 0
    for expr, x, lower, upper, points, fine in _fuzz(seed, 150):
        bounds = mean_value_form(program(expr, x), lower[None], upper[None])
        slope_lo, slope_hi = bounds.slope_lo[0, 0], bounds.slope_hi[0, 0]
        if not (fine.all() and np.isfinite([slope_lo, slope_hi]).all()):
            continue
        values = _values(expr, x, points)[0]
        round_off = 1e-9 * (1 + np.abs(values).max())
        assert bounds.lo.item() - round_off <= values.min()
        assert values.max() <= bounds.hi.item() + round_off
        d, change = points[1:] - points[:-1], np.diff(values)
        assert (np.maximum(slope_lo * d, slope_hi * d).sum(axis=1) >= change - round_off).all(), expr
        assert (np.minimum(slope_lo * d, slope_hi * d).sum(axis=1) <= change + round_off).all(), expr
        checked += 1
    assert checked > 50


@pytest.mark.parametrize("seed", range(6, 9))
def test_what_has_a_value_beside_undefined_parts_lies_inside(seed):
    """fmin(NaN, a) is a, NaN < a is 0: of parts that are no numbers the value is that of CasADi; of overflow nothing is asked."""
    rng, mixed = np.random.default_rng(seed), 0
    for expr, x, lower, upper, points, _ in _fuzz(seed, 150):
        one, other = (INNER[k](x[0]) for k in rng.choice(len(INNER), 2, replace=False))
        swallowed = SWALLOWING[rng.integers(len(SWALLOWING))](one, expr if rng.random() < 0.5 else other)
        whole = swallowed + x[-1] * (rng.random() < 0.5)
        parts = _values(ca.vertcat(one, other, expr, whole), x, points)
        values = parts[3, np.isfinite(parts[3]) & ~np.isinf(parts).any(axis=0)]
        if not values.size:
            continue
        mixed += bool(np.isnan(parts[:3]).any())
        means = mean_value_form(program(whole, x), lower[None], upper[None])
        for lo, hi in ((end.item() for end in enclose(whole, x, lower, upper)), (means.lo.item(), means.hi.item())):
            assert lo <= values.min() + 1e-9 * (1 + abs(values.min())), (whole, lower, upper)
            assert hi >= values.max() - 1e-9 * (1 + abs(values.max())), (whole, lower, upper)
        assert not is_number(whole, x, lower, upper) or not np.isnan(parts[3]).any()
    assert mixed > 20


INNER = (
    lambda a: ca.cos(ca.acos(a)), lambda a: ca.tanh(ca.log(a)), lambda a: ca.sin(1 / a), lambda a: a**2,
    lambda a: ca.atan(ca.sqrt(a)), lambda a: ca.acos(a) * 0.5, lambda a: ca.sign(ca.log(a)), lambda a: 1 + ca.cos(ca.acosh(a)),
)  # fmt: skip
SWALLOWING = (
    ca.fmin, ca.fmax, ca.logic_and, ca.logic_or, ca.copysign, lambda a, b: a < b, lambda a, b: b <= a, lambda a, b: a == b,
    lambda a, b: a != b, lambda a, b: ca.logic_not(a) * 2, lambda a, b: ca.if_else(a < 2, b, 3),
    lambda a, b: ca.if_else(a, 2, 3) + b, lambda a, b: ca.fmin(b, ca.fmax(a, 0.5)),
)  # fmt: skip


def test_a_point_without_a_value_has_no_bound():
    x = ca.SX.sym("x")
    zero, both = np.zeros(1), np.array([[0.0], [1.0]])
    for expr in (x * ca.log(x), x * (1 / x + 1), 1 + x * ca.sqrt(x - 1), x / ca.sin(x), ca.cos(ca.acos(x + 2))):
        assert [end.item() for end in enclose(expr, x, zero, zero)] == [-INF, INF]
    lo, hi = enclose(1 + x * ca.log(x), x, both, both)
    assert lo.ravel().tolist() == [-INF, 1]
    assert hi.ravel().tolist() == [INF, 1]
    assert [end.item() for end in enclose(ca.fmin(x**2, ca.cos(ca.acos(x))), x, zero + 30, zero + 30)] == [-1, 900]


def test_a_batch_gives_what_each_box_gives():
    rng = np.random.default_rng(0)
    for expr, x, lower, upper, *_ in _fuzz(6, 60):
        low = lower + (upper - lower) * rng.random((5, lower.size)) / 2
        high = low + (upper - low) * rng.random((5, lower.size))
        lo, hi = enclose(ca.repmat(expr, 2, 3), x, low, high)
        assert lo.shape == (5, 2, 3)
        for i in range(5):
            one = enclose(ca.repmat(expr, 2, 3), x, low[i], high[i])
            assert one[0].shape == (2, 3)
            np.testing.assert_allclose(lo[i], one[0], rtol=1e-14, atol=1e-300)
            np.testing.assert_allclose(hi[i], one[1], rtol=1e-14, atol=1e-300)


EXACT = {
    "exp": mpmath.exp, "log": mpmath.log, "sqrt": mpmath.sqrt, "sin": mpmath.sin, "cos": mpmath.cos, "tan": mpmath.tan,
    "asin": mpmath.asin, "acos": mpmath.acos, "atan": mpmath.atan, "sinh": mpmath.sinh, "cosh": mpmath.cosh,
    "tanh": mpmath.tanh, "asinh": mpmath.asinh, "acosh": mpmath.acosh, "atanh": mpmath.atanh, "erf": mpmath.erf,
    "erfinv": mpmath.erfinv, "log1p": lambda x: mpmath.log(1 + x), "expm1": lambda x: mpmath.exp(x) - 1,
}  # fmt: skip


@pytest.mark.parametrize("name", EXACT)
def test_the_exact_value_lies_inside_and_the_bound_is_sharp(name):
    """A point as a box: 60 digits decide whether rounding goes outwards."""
    points = np.concatenate([10.0 ** np.arange(-12, 0), np.linspace(0.05, 0.95, 19)])
    points = {"acosh": 1 + 10 * points, "sin": 1000 * points, "cos": 1000 * points, "tan": 1000 * points}.get(name, points)
    x = ca.SX.sym("x")
    lo, hi = (end.ravel() for end in enclose(getattr(ca, name)(x), x, points[:, None], points[:, None]))
    with mpmath.workdps(60):
        exact = [EXACT[name](mpmath.mpf(float(point))) for point in points]
        assert all(mpmath.mpf(a) <= value <= mpmath.mpf(b) for a, value, b in zip(lo, exact, hi, strict=True))
    size = 1 if name in ("sin", "cos", "acos") else np.abs(hi)
    assert (hi - lo <= (3e-4 if name == "erfinv" else 3e-14) * size).all()


def test_values_that_a_library_errs_by_nine_ulps_lie_inside():
    points, x = np.linspace(-0.95, 0.95, 38), ca.SX.sym("x")
    for name in ("exp", "expm1", "sin", "cos", "asin", "acos", "atan", "sinh", "asinh", "atanh"):
        lo, hi = (end.ravel() for end in enclose(getattr(ca, name)(x), x, points[:, None], points[:, None]))
        with mpmath.workdps(60):
            exact = np.array([float(EXACT[name](mpmath.mpf(float(point)))) for point in points])
        assert (lo <= exact - 9 * np.spacing(np.abs(exact))).all(), name
        assert (hi >= exact + 9 * np.spacing(np.abs(exact))).all(), name


def test_rational_operations_round_outwards_and_keep_exact_results():
    rng = np.random.default_rng(1)
    x = ca.SX.sym("x", 2)
    boxes = np.concatenate([rng.normal(size=(100, 2)), rng.integers(1, 9, (50, 2)) / 4])
    expr = ca.vertcat(x[0] + x[1], x[0] - x[1], x[0] * x[1], x[0] / x[1], x[0] ** 2)
    lo, hi = (end[:, :, 0] for end in enclose(expr, x, boxes, boxes))
    with mpmath.workdps(60):
        for i, (a, b) in enumerate(boxes):
            p, q = mpmath.mpf(a), mpmath.mpf(b)
            for j, exact in enumerate([p + q, p - q, p * q, p / q, p * p]):
                assert lo[i, j] <= exact <= hi[i, j]
                assert hi[i, j] - lo[i, j] <= 4.5e-16 * abs(exact)
    assert (lo[100:, [0, 1, 2, 4]] == hi[100:, [0, 1, 2, 4]]).all()


@pytest.mark.parametrize(
    ("text", "box", "bounds"),
    [
        ("sin(x)", (0, 3), (0, 1)),
        ("sin(x)", (1, 2), (np.sin(1), 1)),
        ("sin(x)", (-1, 100), (-1, 1)),
        ("cos(x)", (3, 3.5), (-1, np.cos(3.5))),
        ("cos(x)", (6, 7), (np.cos(7), 1)),
        ("cos(x)", (1e5 + 0.1, 1e5 + 0.2), (np.cos(1e5 + 0.1), np.cos(1e5 + 0.2))),
        ("tan(x)", (-1, 1), (-np.tan(1), np.tan(1))),
        ("tan(x)", (2, 4), (np.tan(2), np.tan(4))),
        ("tan(x)", (1, 2), (-INF, INF)),
        ("x**2", (-1, 3), (0, 9)),
        ("constpow(x, 3)", (-2, 1), (-8, 1)),
        ("constpow(x, 4)", (-2, 1), (0, 16)),
        ("constpow(x, -1)", (2, 4), (0.25, 0.5)),
        ("sqrt(x)", (0, 4), (0, 2)),
        ("sqrt(x)", (-1e-17, 4), (0, 2)),
        ("sqrt(exp(x) - 5)", (-10, 50), (-INF, INF)),
        ("sqrt(0.01 - x**2)", (-0.1, 0.1), (0, 0.1)),
        ("sqrt(x)", (-1, 4), (-INF, INF)),
        ("log(x)", (0, 1), (-INF, 0)),
        ("log(x)", (-1, 1), (-INF, INF)),
        ("1/x", (0, 2), (0.5, INF)),
        ("1/x", (-2, 0), (-INF, -0.5)),
        ("1/x", (-1, 1), (-INF, INF)),
        ("acos(x)", (-1, 1), (0, np.pi)),
        ("asin(x)", (0.5, 1.5), (-INF, INF)),
        ("exp(x)", (-INF, 0), (0, 1)),
        ("exp(x)", (800, 900), (np.finfo(float).max, INF)),
        ("tanh(x)", (-INF, INF), (-1, 1)),
        ("1/(1 + x**2)", (-INF, INF), (0, 1)),
        ("2 + 3*x", (0, INF), (2, INF)),
        ("x - x**2", (0, INF), (-INF, INF)),
        ("floor(x)", (-0.5, 1.5), (-1, 1)),
        ("sign(x)", (0, 2), (0, 1)),
        ("fabs(x)", (-2, 1), (0, 2)),
        ("fmax(x, 0)", (-2, 1), (0, 1)),
        ("fmod(x, 3)", (4, 5), (1, 2)),
        ("fmod(x, 3)", (-7, 5), (-3, 3)),
        ("remainder(x, 4)", (3, 5), (-1, 1)),
        ("if_else(x > 2, 5, x)", (0, 1), (0, 1)),
        ("if_else(x > 2, 5, x)", (3, 4), (5, 5)),
        ("if_else(x > 2, 5, x)", (0, 4), (0, 9)),
        ("if_else(x > 0, sqrt(x), 0)", (-4, -1), (0, 0)),
        ("atan2(x, 1)", (-1, 1), (-np.pi / 4, np.pi / 4)),
        ("atan2(x, -1)", (-1, 1), (-np.pi, np.pi)),
        ("if_else(x <= 1, 0, inf)", (0, 1), (0, 0)),
        ("if_else(x <= 1, 0, inf)", (0, 2), (0, INF)),
    ],
)  # fmt: skip
def test_bounds_of_known_functions(text, box, bounds):
    x = ca.SX.sym("x")
    expr = eval(text, {**vars(ca), "x": x, "inf": INF})
    lo, hi = enclose(expr, x, *np.reshape(box, (2, 1)))
    np.testing.assert_allclose([lo.item(), hi.item()], bounds, rtol=1e-14, atol=1e-14)
    assert lo.item() <= bounds[0] or lo.item() == pytest.approx(bounds[0], abs=1e-14)


def test_every_operation_of_an_expression_is_known():
    names = "ADD SUB MUL DIV NEG EXP LOG POW CONSTPOW SQRT SQ TWICE SIN COS TAN ASIN ACOS ATAN LT LE EQ NE NOT AND OR FLOOR CEIL"
    names += " FMOD FABS SIGN COPYSIGN IF_ELSE_ZERO ERF FMIN FMAX INV SINH COSH TANH ASINH ACOSH ATANH ATAN2 ERFINV LOG1P EXPM1"
    names += " HYPOT REMAINDER ASSIGN"
    assert not [name for name in names.split() if getattr(ca, f"OP_{name}") not in OPERATIONS]


def test_shapes_sparse_and_empty_expressions():
    x = ca.SX.sym("x", 2)
    lo, hi = enclose(ca.diag(x), x, np.array([1, 2]), np.array([3, 4]))
    np.testing.assert_array_equal(lo, np.diag([1, 2]))
    np.testing.assert_array_equal(hi, np.diag([3, 4]))
    assert enclose(ca.SX(0, 1), x, np.zeros(2), np.ones(2))[0].shape == (0, 1)
    assert enclose(x, x, np.zeros((0, 2)), np.ones((0, 2)))[0].shape == (0, 2, 1)
    assert enclose(ca.SX(7), ca.SX(0, 1), np.zeros(0), np.zeros(0))[1].item() == 7
    assert enclose(ca.SX(np.nan), x, np.zeros(2), np.ones(2))[1].item() == INF


def test_a_box_is_refused():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("strange")
    with pytest.raises(ValueError, match="holds strange"):
        enclose(x[0] + y, x, np.zeros(2), np.ones(2))
    with pytest.raises(ValueError, match="lower <= upper"):
        enclose(x, x, np.ones(2), np.zeros(2))
    with pytest.raises(ValueError, match="lower <= upper"):
        supremum(x[0], x, np.array([np.nan, 0]), np.ones(2))
    with pytest.raises(ValueError, match=r"expected \(2,\)"):
        enclose(x, x, np.zeros((1, 2)), np.ones((3, 2)))


# -- continuity --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "box", "proved"),
    [
        ("x**2 + sin(x)", (-INF, INF), True),
        ("fabs(x) + fmax(x, 0.3)", (-1, 1), True),
        ("sqrt(x)", (0, 1), True),
        ("sqrt(x)", (-1, 1), False),
        ("sqrt(exp(x) - 5)", (-10, 50), False),
        ("acosh(expm1(x**2))", (0, 6), False),
        ("sqrt(x**2 - 2*x + 2)", (-3, 3), True),
        ("log(x)", (0, 1), False),
        ("log(x)", (0.1, 1), True),
        ("1/x", (-1, 1), False),
        ("1/x", (0.1, 1), True),
        ("1/(1 + x + x**2)", (-5, 5), True),
        ("sign(x)", (-1, 1), False),
        ("sign(x)", (1, 2), True),
        ("x*sign(x)", (-1, 1), False),
        ("floor(x)", (0.1, 0.9), True),
        ("floor(x)", (0.1, 1), False),
        ("if_else(x > 2, 1, 0)", (-1, 1), True),
        ("if_else(x > 0.3, 1, 0)", (-1, 1), False),
        ("if_else(x > 0.3, 1/(x - 0.2), 0)", (-1, 0.25), True),
        ("if_else(sin(x) > 1.5, 1, x)", (-9, 9), True),
        ("if_else(x**2 - x < -0.3, 1, x)", (-9, 9), True),
        ("tan(x)", (-1, 1), True),
        ("tan(x)", (1, 2), False),
        ("x**0.5", (0, 1), True),
        ("x**-0.5", (0, 1), False),
        ("atan2(x, 1)", (-1, 1), True),
        ("atan2(x, -1)", (-1, 1), False),
        ("fmod(x, 2)", (0.5, 1.5), True),
        ("fmod(x, 2)", (0.5, 2.5), False),
        ("(1/x) > 5", (1, 2), True),
        ("(1/x) > -5", (-0.1, 0.1), False),
        ("asin(2*x)", (-1, 1), False),
        ("hypot(x, 0)", (-1, 1), True),
        ("nan*x", (0, 1), False),
    ],
)  # fmt: skip
def test_continuity(text, box, proved):
    x = ca.SX.sym("x")
    expr = ca.SX(eval(text, {**vars(ca), "x": x, "nan": np.nan}))
    assert is_continuous(expr, x, *np.reshape(np.array(box, float), (2, 1))) is proved


def test_what_is_called_continuous_has_no_jump():
    """Bisection between any two points: where half of a change survives every halving there is a jump."""
    found, tries = 0, share(150, 50)
    for expr, x, lower, upper, points, fine in _fuzz(7, tries):
        if not is_continuous(expr, x, lower, upper):
            continue
        bad = points[~fine]
        assert np.isfinite(_values(expr, x, bad)).all() or np.abs(_values(expr, x, points)[0, fine]).max(initial=0) > 1e2, expr
        a, b = points[fine][:-1][:80], points[fine][1:][:80]
        if not len(a):
            continue
        va, vb = _values(expr, x, a)[0], _values(expr, x, b)[0]
        scale = 1 + np.abs(va).max()
        for _ in range(70):
            middle = (a + b) / 2
            vm = _values(expr, x, middle)[0]
            left = np.abs(vm - va) >= np.abs(vb - vm)
            a, va = np.where(left[:, None], a, middle), np.where(left, va, vm)
            b, vb = np.where(left[:, None], middle, b), np.where(left, vm, vb)
        assert (np.abs(va - vb) <= 1e-3 * scale).all(), expr
        found += 1
    assert found > tries / 3


# -- largest values ----------------------------------------------------------------------------------------------------

CASES = [
    ("-((1 - x)**2 + 100*(y - x**2)**2)", (-2, 2), None, 0.0),
    ("sin(3*x)*cos(2*y)", (-3, 3), None, 1.0),
    ("x*exp(-x) - y**2", (0, 9), None, np.exp(-1)),
    ("x + y", (-3, 3), "1 - x**2 - y**2", np.sqrt(2)),
    ("x*y", (-3, 3), "1 - x - y", 9.0),
    ("x*y", (0, 3), "1 - x - y", 0.25),
    ("-fabs(x - 0.3) - fabs(x + y)", (-3, 3), None, 0.0),
    ("fmin(x, 1 - x) + fmax(y, -y)", (-1, 2), None, 2.5),
    ("1/(1 + (x - 0.7)**2 + y**2)", (-INF, INF), None, 1.0),
    ("-(2 + 3*x) - y", (0, INF), None, -2.0),
    ("2*x - 3*y + 1", (-1, 2), None, 8.0),
    ("if_else(x > 0.3, x, -x)", (-3, 2), None, 3.0),
    ("1/hypot(x, y)", (-2, 2), "hypot(x, y) - 0.5", 2.0),
    ("cos(x - y)", (1, 4), "x - y - 0.5", np.cos(0.5)),
    ("3", (-1, 2), None, 3.0),
]


@pytest.mark.parametrize(("text", "box", "limit", "exact"), CASES)
def test_known_maxima(text, box, limit, exact):
    z = ca.SX.sym("z", 2)
    names = {**vars(ca), "x": z[0], "y": z[1]}
    where = None if limit is None else eval(limit, names)
    lower, upper = np.full(2, float(box[0])), np.full(2, float(box[1]))
    found = supremum(ca.SX(eval(text, names)), z, lower, upper, where=where)
    assert found.value == pytest.approx(exact, abs=1e-6)
    assert exact - 1e-14 * (1 + abs(exact)) <= found.bound <= exact + 1e-3
    value, *rows = _values(ca.vertcat(eval(text, names), *([] if where is None else [where])), z, found.at[None])[:, 0]
    assert value == pytest.approx(found.value, abs=1e-14)
    assert all(row >= 0 for row in rows)
    assert (lower <= found.at).all()
    assert (found.at <= upper).all()


@pytest.mark.parametrize("seed", range(2))
def test_random_expressions_against_dense_samples(seed):
    finite = 0
    rng = np.random.default_rng(seed)
    for expr, x, lower, upper, points, fine in _fuzz(20 + seed, 40):
        where = rng.normal() * (x[0] - lower[0] - rng.random() * (upper[0] - lower[0])) if rng.random() < 0.5 else None
        found = supremum(expr, x, lower, upper, where=where, quick=bool(rng.random() < 0.5))
        feasible = fine if where is None else fine & (_values(where, x, points)[0] >= 0)
        best = _values(expr, x, points)[0, feasible].max(initial=-INF)
        assert best <= found.bound + 1e-12 * abs(best)
        assert found.value <= found.bound
        finite += np.isfinite(found.bound)
        if found.at is not None:
            assert _values(expr, x, found.at[None]).item() == pytest.approx(found.value, rel=1e-12)
    assert finite > 15


def test_a_pole_has_no_bound():
    z = ca.SX.sym("z", 2)
    found = supremum(1 / z[0], z, -np.ones(2), np.ones(2))
    assert found.bound == INF
    assert found.value > 1e6
    assert supremum(z[0] ** 2, z, np.zeros(2), np.full(2, INF)).bound == INF
    outside = supremum(1 / z[0], z, -np.ones(2), np.ones(2), where=z[0] - 0.5)
    assert outside.bound == pytest.approx(2, abs=1e-6)


def test_no_feasible_point():
    z = ca.SX.sym("z", 2)
    found = supremum(z[0], z, -np.ones(2), np.ones(2), where=-1 - ca.sumsqr(z))
    assert found == (-INF, None, -INF, 0)


def test_a_question_ends_the_search():
    z = ca.SX.sym("z", 2)
    expr = ca.sin(10 * z[0]) + ca.sin(7 * z[1] * z[0]) - 0.1 * ca.sumsqr(z)
    lower, upper = np.full(2, -3.0), np.full(2, 3.0)
    full = supremum(expr, z, lower, upper)
    assert full.bound - full.value <= 1e-6
    proved = supremum(expr, z, lower, upper, bound_to=full.value + 1e-3)
    assert full.value <= proved.bound <= full.value + 1e-3
    refuted = supremum(expr, z, lower, upper, bound_to=full.value - 0.5)
    assert refuted.value > full.value - 0.5
    assert refuted.count <= full.count


def test_given_points_count_if_they_lie_in_the_box():
    z = ca.SX.sym("z", 2)
    peak = ca.exp(-1e8 * ca.sumsqr(z - 0.123456)) - 1e-3 * z[0]
    points = np.array([[0.123456, 0.123456], [9, 9]])
    assert supremum(peak, z, -np.ones(2), np.ones(2), points=points, quick=True).value > 0.99
    assert supremum(z[0], z, -np.ones(2), np.ones(2), points=points, quick=True).value == 1


def test_a_search_repeats_itself():
    z = ca.SX.sym("z", 2)
    first, second = (supremum(ca.sin(5 * z[0] * z[1]) - z[0], z, -np.ones(2), np.ones(2)) for _ in range(2))
    assert first.value == second.value
    assert first.bound == second.bound
    np.testing.assert_array_equal(first.at, second.at)


def test_only_differences_count():
    """Four coordinates, two that matter: the distance of two discs."""
    q = ca.SX.sym("q", 4)
    gap = ca.norm_2(q[:2] - q[2:]) - 1
    box = np.full(4, -3.0), np.full(4, 3.0)
    hessian = spectral_norm(ca.hessian(gap, q)[0], q, *box, where=gap + 0.1)
    assert hessian.value == pytest.approx(2 / 0.9, abs=1e-5)
    assert 2 / 0.9 <= hessian.bound <= 2 / 0.9 + 0.02
    gradient = spectral_norm(ca.gradient(gap, q), q, *box, where=gap + 0.1)
    assert np.sqrt(2) <= gradient.bound <= np.sqrt(2) + 0.05
    assert supremum(-gap, q, *box).bound == 1
    scaled = ca.cos(0.1 * (q[0] - q[1])) * (q[1] - q[0] + 2) * (2 * q[0] - 2 * q[1] - 1)
    best = _values(scaled, q, samples(*box, 4096)).max()
    found = supremum(scaled, q, *box)
    assert best <= found.value <= found.bound <= found.value + 1e-6


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("sqrt((a - b)**2 + (c - d)**2)", 2),
        ("sin(0.1*(a - b)) * (b - a + 2)**3 / (5 + 2*a - 2*b)**2", 1),
        ("vertcat(exp(a + b), a + b - 3, (a + b)/4)", 1),
        ("if_else(a - 0.3*b > 1, 1, 2*a - 0.6*b)", 1),
        ("cos(a + b) + c", 2),
        ("a*b", None),
        ("a - b + (b - c)**2 + (c - a)**2", None),
    ],
)
def test_fewer_coordinates_give_the_same_values(text, number):
    z = ca.SX.sym("z", 4)
    expr = ca.SX(eval(text, {**vars(ca), **dict(zip("abcd", ca.vertsplit(z), strict=True))}))
    lower, upper = np.array([-1.0, 0, 2, -3]), np.array([1.0, 0.7, 2, 3])
    less = reduce_coordinates(program(expr, z), z, lower, upper)
    if number is None:
        assert less is None
        return
    assert less.d.numel() == number
    points = samples(lower, upper, 200)
    d = points @ less.matrix.T + less.constant
    assert (less.lower - 1e-12 <= d).all()
    assert (d <= less.upper + 1e-12).all()
    np.testing.assert_allclose(_values(less.expr, less.d, d), _values(expr, z, points), rtol=1e-11, atol=1e-12)


def test_powers_of_one_value_are_bounded_as_powers():
    x = ca.SX.sym("x", 2)
    slope = ca.gradient(x[0] ** 3 + 5 * x[0] - 0.5 * x[0], x[0])
    curvature = ca.hessian((x[0] - x[1]) ** 6, x[0])[0]
    cubes = ca.vertcat(x[0] ** 3, (x[0] * x[0]) * (3 * x[0]) - x[0] ** 3, -((2 * x[0]) ** 3))
    lo, hi = enclose(ca.vertcat(slope, curvature, cubes), x, np.array([-1.0, 0]), np.array([2.0, 1]))
    np.testing.assert_array_equal(lo.ravel(), [4.5, 0, -1, -2, -64])
    np.testing.assert_array_equal(hi.ravel(), [16.5, 30 * 16, 8, 16, 8])


def test_many_coordinates():
    z = ca.SX.sym("z", 60)
    assert supremum(ca.sum1(ca.sin(z)), z, -np.ones(60), np.ones(60)).bound == pytest.approx(60 * np.sin(1))
    assert supremum(z[7] ** 2 - z[0], z, -np.ones(60), np.ones(60)).value == 2


# -- matrices ----------------------------------------------------------------------------------------------------------


def _matrices(z):
    x, y = z[0], z[1]
    yield ca.vertcat(ca.horzcat(x, y), ca.horzcat(y, -x))
    yield ca.vertcat(ca.horzcat(x * y, 1), ca.horzcat(1, ca.sin(3 * x)))
    yield ca.vertcat(ca.horzcat(x, y, 1), ca.horzcat(y, -x, 0.5), ca.horzcat(1, 0.5, ca.sin(x)))
    yield ca.diagcat(x + y, x**2, ca.vertcat(ca.horzcat(2, y), ca.horzcat(y, x)), ca.SX(0))
    yield ca.SX(ca.DM([[2, -1, 0], [-1, 2, -1], [0, -1, 2]]))
    yield ca.cos(x) + ca.SX(ca.DM(np.arange(16.0).reshape(4, 4) + np.arange(16.0).reshape(4, 4).T)) * y


@pytest.mark.parametrize("index", range(6))
def test_norms_and_eigenvalues_against_a_grid(index):
    z = ca.SX.sym("z", 2)
    A = list(_matrices(z))[index]
    lower, upper = np.array([-1.0, -1.0]), np.array([1.0, 2.0])
    grid = np.array(list(itertools.product(np.linspace(-1, 1, 41), np.linspace(-1, 2, 41))))
    full = _values(ca.vec(A), z, grid).T.reshape(-1, A.shape[1], A.shape[0]).swapaxes(1, 2)
    for function, best in (
        (spectral_norm, np.linalg.norm(full, 2, axis=(1, 2)).max()),
        (largest_eigenvalue, np.linalg.eigvalsh(full)[:, -1].max()),
    ):
        found = function(A, z, lower, upper)
        assert found.value >= best - 1e-9
        assert found.value <= found.bound <= found.value + 1e-3
        rough = function(A, z, lower, upper, quick=True)
        assert 0.98 * best <= rough.value <= rough.bound
        assert rough.bound >= best


@pytest.mark.parametrize("n", [1, 2, 5, 20])
def test_distances_to_an_inverse_are_above_those_at_points(n):
    """On boxes of width 0 by Fractions: |E|_2 <= bound means bound^2 I - E E' psd, of which the diagonal is looked at."""
    rng = np.random.default_rng(n)
    z, width = ca.SX.sym("z", 3), 10.0 ** rng.integers(-6, 0)
    parts = [rng.normal(size=(n, n)) for _ in range(4)]
    W = ca.SX(parts[0] + n * np.eye(n)) + parts[1] * z[0] ** 2 + parts[2] * ca.sin(z[1]) + parts[3] * z[2]
    centre, Y = rng.normal(size=3), np.linalg.inv(parts[0] + n * np.eye(n))
    points = centre + width * rng.uniform(-1, 1, (200, 3))
    full = np.array([np.array(ca.Function("W", [z], [W])(point)) for point in points])
    best = np.linalg.norm(Y @ full - np.eye(n), 2, axis=(1, 2)).max()
    bound = distance_to_inverse(Y, W, z, centre - width, centre + width)
    assert best <= bound * (1 + 1e-12)
    assert bound <= best + 40 * n * width
    there = distance_to_inverse(Y, ca.SX(ca.DM(full[0])), z, centre, centre)
    exactly = [[Fraction(float(value)) for value in row] for row in full[0]]
    rows = [[sum(Fraction(float(a)) * b for a, b in zip(row, column, strict=True)) for column in zip(*exactly, strict=True)]
            for row in Y]  # fmt: skip
    size = max(sum((value - (i == j)) ** 2 for j, value in enumerate(row)) for i, row in enumerate(rows))
    assert size <= Fraction(there) ** 2


def test_distances_to_an_inverse_without_bounds_are_infinite():
    z = ca.SX.sym("z")
    assert distance_to_inverse(np.eye(2), ca.diagcat(1 / z, 1), z, -np.ones(1), np.ones(1)) == INF
    assert distance_to_inverse(np.eye(2), ca.diagcat(1 + z, 1), z, np.zeros(1), np.full(1, INF)) == INF
    assert distance_to_inverse(np.eye(1), 1 + z, z, -np.full(1, 0.5), np.full(1, 0.5)) == pytest.approx(0.5, rel=1e-13)


def test_norms_that_are_known():
    z = ca.SX.sym("z", 3)
    lower, upper = -np.ones(3), np.array([1.0, 2.0, 1.0])
    assert spectral_norm(z.T, z, lower, upper).bound == pytest.approx(np.sqrt(6), rel=1e-14)
    assert spectral_norm(z, z, lower, upper).value == pytest.approx(np.sqrt(6), rel=1e-14)
    assert largest_eigenvalue(-(z[0] ** 2), z, lower, upper).bound == 0
    assert largest_eigenvalue(-ca.diag(ca.vertcat(z[0] ** 2, 1 + z[1] ** 2, 3)), z, lower, upper).bound == 0
    assert spectral_norm(ca.SX(2, 3), z, lower, upper).bound == 0
    wide = ca.vertcat(ca.horzcat(z[0], z[1], 0), ca.horzcat(-z[1], z[0], 0))
    assert spectral_norm(wide, z, lower, upper).bound == pytest.approx(np.sqrt(5), abs=1e-6)
    rotated = ca.vertcat(ca.horzcat(1, 2, 2), ca.horzcat(2, 1, -2), ca.horzcat(2, -2, 1)) * z[1] / 3
    assert spectral_norm(rotated, z, lower, upper).bound == pytest.approx(2, abs=1e-8)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_no_matrix_of_an_interval_exceeds_the_bound(n):
    rng = np.random.default_rng(n)
    for width in (0.0, 1e-8, 0.1, 3.0):
        middle = rng.normal(size=(40, n, n))
        radius = width * rng.random((40, n, n))
        norm = _spectral_norm_bound(middle - radius, middle + radius)
        symmetric, size = middle + middle.swapaxes(1, 2), radius + radius.swapaxes(1, 2)
        top = _eigenvalue_bound(symmetric - size, symmetric + size)
        for _ in range(50):
            signs = rng.choice([-1, 1], (40, n, n)) if rng.random() < 0.5 else rng.uniform(-1, 1, (40, n, n))
            assert (np.linalg.norm(middle + signs * radius, 2, axis=(1, 2)) <= norm).all()
            signs = np.triu(signs) + np.triu(signs, 1).swapaxes(1, 2)
            assert (np.linalg.eigvalsh(symmetric + signs * size)[:, -1] <= top).all()
        if width == 0:
            np.testing.assert_allclose(norm, np.linalg.norm(middle, 2, axis=(1, 2)), rtol=1e-10)
            np.testing.assert_allclose(top, np.linalg.eigvalsh(symmetric)[:, -1], rtol=1e-9, atol=1e-9)


# -- samples -----------------------------------------------------------------------------------------------------------


def test_samples_fill_the_box():
    points = samples(np.array([0.0, -1, -INF, -INF, 2]), np.array([1.0, INF, 3, INF, 2]), 1024)
    assert points.shape == (1024, 5)
    assert np.isfinite(points).all()
    assert (np.abs(np.histogram(points[:, 0], 16, (0, 1))[0] - 64) <= 6).all()
    assert points[:, 1].min() >= -1
    assert points[:, 1].max() > 100
    assert points[:, 2].max() <= 3
    assert points[:, 2].min() < -100
    assert points[:, 3].min() < -100
    assert points[:, 3].max() > 100
    assert (points[:, 4] == 2).all()
    pairs = np.histogram2d(*samples(np.zeros(2), np.ones(2), 1024).T, bins=8, range=[[0, 1], [0, 1]])[0]
    assert pairs.min() >= 8


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 2), (9, 9)])
def test_norms_over_many_boxes_are_bounded_as_over_each(shape):
    rng, x = np.random.default_rng(shape[1]), ca.SX.sym("x", 3)
    rows = [ca.sin(a) * b + c**2 if rng.random() < 0.7 else 0 for a, b, c in rng.choice(ca.vertsplit(x), (np.prod(shape), 3))]
    J = ca.sparsify(ca.reshape(ca.vertcat(*rows, ca.tanh(x[0] - x[1]))[: int(np.prod(shape))], *shape))
    lower = rng.uniform(-2, 1, (15, 3)).round(1)
    upper = lower + rng.choice([0.0, 0.3, INF], (15, 3))
    found = spectral_norm_bounds(J, x, lower, upper)
    for alone in (False, True):
        each = [spectral_norm(J, x, *box, quick=True, bound_alone=alone).bound for box in zip(lower, upper, strict=True)]
        assert found == pytest.approx(each, rel=1e-12)
    values = ca.Function("J", [x], [ca.densify(J)])
    for low, high, bound in zip(lower, upper, found, strict=True):
        for point in samples(low, high, 20):
            assert np.linalg.norm(np.array(values(point)), 2) <= bound * (1 + 1e-12)
