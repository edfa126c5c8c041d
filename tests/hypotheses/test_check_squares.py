"""Convexity of polynomial constraints and dissipativity of polynomial fields, by sums of squares."""

from __future__ import annotations

import casadi as ca
import numpy as np
from fuzz_models import share

from nsmodel import MonotoneInclusion, SweepingProcess, check


def convex(g, q, q0, t):
    model = SweepingProcess(t=t, q=q, constraints={"wall": g}, f=ca.DM.zeros(2), q0=q0, t_end=1, step=0.1)
    return check(model, [])["S-convex"]


def test_a_coupled_quartic_is_convex_everywhere_and_moves_as_it_likes():
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    x, y = q[0], q[1]
    quartic = x**4 + x**2 * y**2 + y**4 + x * y
    finding = convex(quartic + 3 * x**2 + 3 * y**2 + t**2 * x - 1, q, [2, 1], t)
    assert finding.verdict == "holds"
    assert finding.scope is None or not finding.scope.states


def test_random_quartics_are_convex_only_where_no_hessian_is_indefinite():
    rng = np.random.default_rng(1)
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    x, y = q[0], q[1]
    for _ in range(share(12, 4)):
        a, b, c = rng.uniform(-1, 8), rng.uniform(-2, 2), rng.uniform(0, 1)
        g = x**4 + a * x**2 * y**2 + b * x * y**3 + y**4 + c * (x**2 + y**2) - 1
        finding = convex(g, q, [2, 2], t)
        H = ca.Function("H", [q], [ca.hessian(g, q)[0]])
        least = min(np.linalg.eigvalsh(np.array(H(point)))[0] for point in rng.uniform(-9, 9, (800, 2)))
        if finding.verdict == "holds" and not (finding.scope and finding.scope.states):
            assert least >= -1e-9


def test_a_field_whose_highest_form_falls_draws_back():
    rng = np.random.default_rng(0)
    x = ca.SX.sym("x", 2)
    for _ in range(5):
        A, b = ca.DM(rng.normal(size=(2, 2))), ca.DM(rng.normal(size=2))
        field = A @ x + b - ca.gradient((x[0] ** 2 + x[0] * x[1] + x[1] ** 2) ** 2, x)
        model = MonotoneInclusion(x=x, field=field, x0=[1, 0], t_end=1, step=0.1)
        finding = check(model, [])["M-A3"]
        assert finding.verdict == "holds"
        f = ca.Function("f", [x], [ca.dot(x, field) + finding.value["alpha"] * ca.sumsqr(x)])
        assert max(float(f(point)) for point in rng.normal(size=(300, 2))) <= finding.value["beta"]
