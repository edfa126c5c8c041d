"""Sets {f >= 0} of functions that are not concave, against roots that were put in and pairs of points."""

import casadi as ca
import numpy as np
from fuzz_models import share

from nsmodel import MonotoneInclusion, check
from nsmodel.proof.convex.quasiconcave import has_convex_superlevel_set
from nsmodel.proof.convex.sets import ConvexSet, is_convex_set

X, Y = ca.SX.sym("x"), ca.SX.sym("y", 3)
LINE, ABOVE_0 = (np.full(1, -np.inf), np.full(1, np.inf)), (np.zeros(1), np.full(1, np.inf))
OCTANT = np.zeros(3), np.full(3, np.inf)


def test_polynomials_with_known_roots():
    """{p >= 0} between whole roots, simple and double, on the line, on a half line or on an interval."""
    for seed in range(share(60)):
        rng = np.random.default_rng(seed)
        roots = rng.integers(-3, 4, rng.integers(1, 5))
        sign = float(rng.choice([-1, 1]))
        low, high = sorted(rng.choice(np.arange(-5, 6), 2, replace=False).astype(float))
        low, high = [(low, high), (low, np.inf), (-np.inf, high), (-np.inf, np.inf)][seed % 4]
        p = sign * ca.SX(1)
        for root in roots:
            p *= X - float(root)
        grid = np.arange(-24, 25) / 4  # All roots and ends, and points between.
        inside = grid[(grid >= low) & (grid <= high)]
        kept = sign * np.prod(inside[:, None] - roots[None, :], axis=1) >= 0
        blocks = np.count_nonzero(np.diff(np.concatenate([[False], kept]).astype(int)) == 1)
        found = has_convex_superlevel_set(p, X, np.array([low]), np.array([high]))
        if blocks > 1:
            assert not found
        elif len(set(roots)) == len(roots):  # What only touches 0 may be left open.
            assert found


def test_functions_of_one_direction():
    for f, box, convex in [
        (1 - X**3, LINE, True), (ca.exp(X) - 2, LINE, True), (X * ca.exp(-X) - 0.1, LINE, True),
        (0.3 - X * ca.exp(-X), LINE, False),
        (0.3 - X * ca.exp(-X), ABOVE_0, False),
        (ca.sqrt(X) - X, ABOVE_0, True), (1 / X - 1, LINE, False), (ca.sin(X), LINE, False),
        (X**3 - X, ABOVE_0, False), (ca.sqrt(1 + X**2) - X - 0.5, LINE, True), (ca.tanh(X) + 0.5, LINE, True),
    ]:  # fmt: skip
        assert has_convex_superlevel_set(f, X, *box) == convex, f
    assert has_convex_superlevel_set((Y[0] - 2 * Y[1]) ** 3 - 1, Y, *(np.full(3, end) for end in (-np.inf, np.inf)))


def test_rules_agree_with_pairs_of_points():
    for seed in range(share(40)):
        rng = np.random.default_rng(seed)
        a, b = (ca.DM(rng.integers(0, 5, 3) / 2) for _ in range(2))
        c, level = float(rng.integers(1, 5)) / 2, float(rng.integers(1, 9)) / 4
        u, v = ca.dot(a, Y) + c, ca.dot(b, Y) + 1
        forms = [
            (ca.sqrt(u * v), True), (u * v * Y[2], True), (u**2 * v, True), (u / v, True), (u / (1 + v**2), True),
            (ca.exp(-u * v), False),
            (-(u**2) / v, True), (ca.sqrt(u) * v**0.5, True), (ca.fmin(u * v, Y[0] + 1), True), (-ca.exp(-Y[0]) * u, False),
            (ca.tanh(u * v), True), (1 / (u + v**2), True), (-u * v, False), (ca.log(1 + u * v), True), (u - v**3, True),
        ]  # fmt: skip
        f, proved = forms[seed % len(forms)]
        f = f - level if seed % len(forms) not in (5, 6, 9, 12, 14) else f + level
        found = has_convex_superlevel_set(f, Y, *OCTANT)
        assert found or not proved
        if found:
            points = rng.exponential(2.0, (4000, 3))
            rows = ca.Function("f", [Y], [f])
            inside = points[np.array(rows(points.T)).ravel() >= 0]
            half = len(inside) // 2
            middle = (inside[:half] + inside[half : 2 * half]) / 2
            assert (np.array(rows(middle.T)).ravel() >= -1e-12).all()


def test_what_has_no_value_in_the_middle_is_not_convex():
    y = Y[:2]
    part = is_convex_set(ConvexSet(y, ca.sqrt(y[0] * y[1]) - 1, ["c"]), np.full(2, -3.0), np.full(2, 3.0), quick=True)
    assert part.verdict == "violated"
    a, b, middle = (np.asarray(part.witness[name]) for name in ("x", "y", "middle"))
    assert np.array_equal((a + b) / 2, middle)
    assert a[0] * a[1] >= 1 <= b[0] * b[1]
    assert middle[0] * middle[1] < 0


def test_in_a_report():
    x = ca.SX.sym("x", 2)
    given = {"x": x, "field": [-x[0], -x[1]], "x0": [2, 2], "t_end": 1, "step": 0.1}
    verdicts = [
        check(MonotoneInclusion(**given, **more), quick=True)["M-C"].verdict
        for more in ({"constraints": {"c": ca.sqrt(x[0] * x[1]) - 1}, "lower": 0}, {"constraints": {"c": 9 - x[0] ** 3}})
    ]
    assert verdicts == ["holds", "holds"]
