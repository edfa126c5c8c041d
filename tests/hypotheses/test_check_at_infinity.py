"""(A2), (A3) and (24) where terms cancel at infinity or saturate, against 50 digits and what was put in."""

import casadi as ca
import mpmath
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import MonotoneInclusion, check
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.proof.expression_graph import fold_graph
from nsmodel.proof.sectors import exact_sector

X, S = ca.SX.sym("x"), ca.SX.sym("s")
Y = ca.SX.sym("y", 2)
TIMES = {"t_end": 1.0, "step": 0.01}
MP = {
    ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b, ca.OP_DIV: lambda a, b: a / b,
    ca.OP_NEG: lambda a: -a, ca.OP_TWICE: lambda a: 2 * a, ca.OP_SQ: lambda a: a * a, ca.OP_SQRT: mpmath.sqrt,
    ca.OP_EXP: mpmath.exp, ca.OP_INV: lambda a: 1 / a, ca.OP_FABS: abs, ca.OP_POW: mpmath.power,
}  # fmt: skip


def value(expr, at):
    return fold_graph(expr, lambda _: at, mpmath.mpf, lambda op, args: MP[op](*args))[0]


def findings(field, x=X, **given):
    rows = field if isinstance(field, list) else [field]
    model = MonotoneInclusion(x=x, field=rows, x0=given.pop("x0", [0.5] * len(rows)), **given, **TIMES)
    return check(model, runs=[], quick=True)


@pytest.mark.parametrize("seed", range(share(14)))
def test_decay_that_cancels_at_infinity(seed):
    """-x + what tends to x: no alpha > 0; with -m x more there is one, and alpha and beta are bounds."""
    rng = np.random.default_rng(seed)
    a, b, m = (float(k) for k in rng.integers(1, 9, 3) / 4)
    almost = [
        X**3 / (a + X**2), X * (a + X**4) / (b + X**4), X**5 / (a + X**2) ** 2, X * ca.sqrt(X**2 + a) / ca.sqrt(X**2 + b),
        X * ca.fabs(X) / (a + ca.fabs(X)), X * ca.sqrt(X**4 + a * X**2) / (b + X**2),
        X / (1 + a * ca.exp(-X)) + X / (1 + a * ca.exp(X)),
    ]  # fmt: skip
    field = almost[seed % len(almost)] - X
    assert findings(field)["M-A3"].verdict == "violated"
    with mpmath.workdps(50):
        assert value(field, mpmath.mpf(10) ** 12) * mpmath.mpf(10) ** -12 > -1e-9
        report = findings(field - m * X)
        assert report["M-A2"].verdict == report["M-A3"].verdict == "holds"
        alpha, beta = (report["M-A3"].value[name] for name in ("alpha", "beta"))
        first, second = (report["M-A2"].value[name] for name in ("a_1", "a_2"))
        assert alpha > 0
        for at in [sign * mpmath.mpf(10) ** k for k in np.linspace(-6, 9, 40) for sign in (1, -1)]:
            v = value(field - m * X, at)
            assert at * v <= -alpha * at**2 + beta
            assert abs(v) <= first + second * abs(at)


def test_a_row_whose_terms_cancel_grows_linearly():
    growth = findings(X**3 - X * ca.sqrt(X**4 + 3 * X**2), lower=0, x0=[1.0])["M-A2"]
    assert growth.verdict == "holds"
    assert 1.5 <= growth.value["a_2"] < 1.6


def test_exact_sectors_hold_the_function():
    for seed in range(share(12)):
        rng = np.random.default_rng(seed)
        a, k, m, b = (float(c) for c in rng.integers(1, 9, 4) / 4)
        parts = [
            a * ca.exp(k * S) / (1 + ca.exp(k * S)), a / (b + ca.exp(-k * S)), ca.sqrt(S**4 + a * S**2 + b) - S**2, m * S,
            ca.sqrt(S**2 + b) - m * S, S**3 / (a + S**2) - ca.fabs(S), ca.sqrt(ca.fabs(S)),
        ]  # fmt: skip
        h = sum(parts[j] for j in rng.choice(len(parts), 2, replace=False))
        low, high = (-np.inf, np.inf) if seed % 2 else (-2.0, np.inf)
        found = exact_sector(h, S, low, high)
        assert found is not None
        assert found.bounded
        with mpmath.workdps(50):
            for s in [sign * mpmath.mpf(10) ** e for e in np.linspace(-6, 6, 50) for sign in (1, -1)]:
                if low <= s:
                    gain = s * value(h, s)
                    assert found.low * s**2 - found.reach * abs(s) <= gain <= found.high * s**2 + found.reach * abs(s)


def test_a_saturating_gradient_is_seen_through_its_guard():
    """The slope of log(1 + e^u) lies in (0, 1): log(u) has no value below 0, and stays guarded."""
    for phi in (3 * ca.log(2 + ca.exp(-2 * X)),):
        report = findings(-2 * X, phi=phi)
        assert [report[name].verdict for name in ("M-A2", "M-A3", "M-24")] == ["holds"] * 3
        assert report["M-24"].value["L"] >= -2
    assert findings(-2 * X, phi=-ca.log(X), x0=[1.0])["M-24"].verdict != "holds"


def test_a_simplex_is_bounded():
    for seed in range(share(12)):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 5))
        x, a, c = ca.SX.sym("x", n), rng.integers(1, 9, n) / 4, float(rng.integers(1, 20))
        low = -rng.integers(0, 9, n) / 4
        signs = rng.choice([-1.0, 1.0], n)
        rows = ca.vertcat(*(signs[i] * x[i] - low[i] for i in range(n)), c - ca.dot(ca.DM(a * signs), x))
        C = ConvexSet(x, rows, [str(i) for i in range(n + 1)])
        top = low + (c - a @ low) / a
        ends = np.sort([signs * low, signs * top], axis=0)
        assert np.allclose(C.bounding_box, ends, rtol=1e-14, atol=0)
        assert (C.bounding_box[0] <= ends[0]).all()
        assert (C.bounding_box[1] >= ends[1]).all()
        assert not ConvexSet(x, rows[1:], C.names[1:]).bounded


def test_derivatives_of_maxima_have_values():
    slope = ca.gradient(ca.fmax(Y[0], Y[1]) ** 2 + ca.fmin(Y[0], 3) * Y[1], Y)
    whole = np.full(2, -np.inf), np.full(2, np.inf)
    assert is_defined_on_box(slope, Y, Y, *whole)
    assert not is_defined_on_box(ca.gradient(ca.fmax(1 / Y[0], Y[1]) ** 2, Y), Y, Y, *whole)
    assert not is_defined_on_box(1 / ((Y[0] <= Y[1]) + (Y[0] <= 1)), Y, Y, *whole)
