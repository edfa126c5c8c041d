"""A5 and A5' against corners found by brute force, and witnesses that have to be proved."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL
from scipy.optimize import fsolve

import nsmodel
from nsmodel import SweepingProcess
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED
from nsmodel.hypotheses.region import Region
from nsmodel.models.sweeping_process.check import check
from nsmodel.proof.jumps import jump_lower_bound, prove_jump
from nsmodel.proof.krawczyk import enclose_zero
from nsmodel.proof.ray_expansion import growth_exponent

t = ca.SX.sym("t")


def decided(constraints, q, q0, f=None, *, centre=0.0, width=2.5, t_end=3.0, quick=False):
    """Findings over the box |q_i - centre_i| <= width."""
    model = SweepingProcess(t=t, q=q, f=f, constraints=constraints, q0=q0, t_end=t_end, step=0.01)
    n = len(model.names)
    middle = np.broadcast_to(centre, n)
    region = Region(middle - width, middle + width, 0.0, t_end, tuple(model.names), "given")
    return {finding.id: finding for finding in check(model, region, [], quick)[0]}


@pytest.mark.parametrize("e", [1e-7, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 100.0])
def test_discs_that_nearly_touch_have_a_finite_gamma(e, unit):
    q = ca.SX.sym("q", 2)
    discs = {"a": ca.norm_2(q) - unit, "b": ca.norm_2(q - ca.vertcat((2 - e) * unit, 0)) - unit}
    found = decided(discs, q, [0, 2 * unit], width=2.5 * unit)
    d, r = Fraction((2 - e) * unit), Fraction(unit)
    gamma = float(4 * r**2 / (4 * r**2 - d**2)) ** 0.5
    for id in ("A5", "A5'"):
        assert found[id].verdict == HOLDS
        assert gamma * (1 - 1e-9) <= found[id].value["gamma"] <= gamma * 1.01
        assert found[id].value["attained"] <= gamma * (1 + 1e-9)


def test_contact_is_decided_exactly_at_rest_and_by_newton_in_motion():
    q = ca.SX.sym("q", 2)
    touching = decided({"a": ca.norm_2(q) - 1, "b": ca.norm_2(q - ca.vertcat(2, 0)) - 1}, q, [0, 2])
    assert touching["A5"].verdict == touching["A5'"].verdict == VIOLATED
    apart = decided({"a": ca.norm_2(q) - 1, "b": ca.norm_2(q - ca.vertcat(2 + 1e-9, 0)) - 1}, q, [0, 2])
    assert apart["A5'"].verdict == HOLDS
    assert apart["A5"].verdict == HOLDS
    assert apart["A5"].value["rho"] < 5e-10
    closing = decided({"a": ca.norm_2(q) - 1, "b": ca.norm_2(q - ca.vertcat(4.1 - 1.3 * t, 0)) - 1}, q, [0, 2])
    assert closing["A5'"].verdict == VIOLATED
    assert closing["A5'"].witness["t"] == pytest.approx(2.1 / 1.3)


def scene(rng, q, unit, away):
    """Three random discs, half-planes or ellipses: expressions, functions and gradients in NumPy."""
    rows = []
    for kind in rng.choice(["disc", "disc", "plane", "ellipse"], rng.integers(2, 4)):
        c, r = away + unit * rng.uniform(-1.5, 1.5, 2), unit * rng.uniform(0.3, 1.5)
        if kind == "disc":
            rows.append(
                (
                    ca.norm_2(q - ca.DM(c)) - r,
                    lambda x, c=c, r=r: np.hypot(*(x - c)) - r,
                    lambda x, c=c: (x - c) / np.hypot(*(x - c)),
                )
            )
        elif kind == "plane":
            a = rng.normal(size=2)
            b = float(a @ c)
            rows.append((ca.dot(ca.DM(a), q) - b, lambda x, a=a, b=b: a @ x - b, lambda x, a=a: a))
        else:
            w = rng.uniform(0.3, 3, 2)
            expr = (w[0] * (q[0] - c[0]) ** 2 + w[1] * (q[1] - c[1]) ** 2) / unit - r
            rows.append((expr, lambda x, c=c, r=r, w=w: w @ (x - c) ** 2 / unit - r, lambda x, c=c, w=w: 2 * w * (x - c) / unit))
    return rows


def corners(rng, rows, unit, away):
    """The largest gamma(0) at corners of two constraints that are admissible."""
    worst = 1.0
    for (_, g, dg), (_, h, dh) in combinations(rows, 2):
        for _ in range(30):
            x, _, ok, _ = fsolve(
                lambda x, g=g, h=h: [g(x) / unit, h(x) / unit], away + unit * rng.uniform(-2.5, 2.5, 2), full_output=True
            )
            inside = np.abs(x - away).max() <= 2.5 * unit
            if ok != 1 or not inside or max(abs(g(x)), abs(h(x))) > 1e-12 * (unit + np.abs(away).max()):
                continue
            if min(row[1](x) for row in rows) < -1e-12 * (unit + np.abs(away).max()):
                continue
            n, m = dg(x) / np.linalg.norm(dg(x)), dh(x) / np.linalg.norm(dh(x))
            worst = max(worst, 2 / max(np.linalg.norm(n + m), 1e-12))
    return worst


def test_gamma_is_above_every_corner():
    rng = np.random.default_rng(5)
    proved = 0
    for _ in range(150 * COUNT // FULL):
        q, unit, away = ca.SX.sym("q", 2), 10.0 ** rng.integers(-3, 4), rng.choice([0.0, 0.0, 1.0, 1e6]) * rng.normal(size=2)
        if np.abs(away).max() > 1e3 * unit:
            unit = np.abs(away).max() / 1e3
        rows = scene(rng, q, unit, away)
        start = next((x for x in away + unit * rng.uniform(-2.5, 2.5, (400, 2)) if min(g(x) for _, g, _ in rows) > 0), None)
        if start is None:
            continue
        found = decided({f"g{k}": row[0] for k, row in enumerate(rows)}, q, start, centre=away, width=2.5 * unit, t_end=1.0)
        worst = corners(rng, rows, unit, away)
        for id in ("A5", "A5'"):
            if found[id].verdict == HOLDS:
                proved += 1
                assert found[id].value["gamma"] >= worst * (1 - 1e-5)
            assert found[id].verdict != VIOLATED or worst > 1e5
    assert proved > 10


def test_a_pillar_and_a_crowd_around_it():
    q = ca.SX.sym("q", 6)
    bodies = ca.vertsplit(q, 2)
    rows = {f"pair{i}{j}": ca.norm_2(bodies[i] - bodies[j]) - 0.8 for i, j in combinations(range(3), 2)}
    rows |= {f"pillar{i}": ca.norm_2(bodies[i] - ca.DM([0.6, 1.5])) - 0.4 for i in range(3)}
    found = decided(rows, q, [-1, 0, 0, 0, 1, 0])["A5"]
    assert found.verdict == HOLDS
    rng, worst = np.random.default_rng(0), 1.0
    f = ca.Function("g", [q], [ca.vertcat(*rows.values()), ca.jacobian(ca.vertcat(*rows.values()), q)])
    from nsmodel.models.sweeping_process.mfcq_constant import mfcq_constant

    for _ in range(300):  # a row that leans on the pillar, at random angles
        x = np.array([0.6, 1.5]) + 0.4 * direction(rng)
        points = [x]
        for _ in range(2):
            points.append(points[-1] + 0.8 * direction(rng))
        g, G = (np.array(part) for part in f(np.concatenate(points)))
        if g.min() > -1e-9:
            worst = max(worst, mfcq_constant(G[g.ravel() < 1e-9])[0])
    assert 1 < worst <= found.value["gamma"]


def direction(rng):
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def test_zeros_are_proved_where_they_are():
    x = ca.SX.sym("x", 2)
    zero = enclose_zero(ca.vertcat(ca.sumsqr(x) - 2, x[0] - x[1]), x, np.array([1.1, 0.8]), np.ones(2))
    assert (zero.lower <= 1).all()
    assert (zero.upper >= 1).all()
    assert (zero.upper - zero.lower).max() < 1e-12
    assert enclose_zero(ca.vertcat(ca.sumsqr(x) + 1e-9, x[0] - x[1]), x, np.zeros(2), np.ones(2)) is None
    assert enclose_zero(x[0] ** 2, x[0], np.array([1e-5]), np.ones(1)) is None  # a double zero is no regular one


@pytest.mark.long
def test_jumps_and_kinks_are_told_apart():
    x = ca.SX.sym("x")
    box = np.array([-1.0]), np.array([1.0])
    for expr, size in (
        (ca.sign(x - 0.3), 2),
        (ca.if_else(x < 0.1, x, x + 1e-6), 1e-6),
        (ca.fmod(x + 2, 1), 1),
        (ca.floor(3 * x), 1),
    ):
        assert prove_jump(expr, x, *box).size == pytest.approx(size, rel=1e-6)
    for expr in (ca.fabs(x), ca.sign(x) * x, ca.if_else(x < 0.1, x, 2 * x - 0.1), ca.fmax(x, 0) ** 2):
        assert prove_jump(expr, x, *box) is None
    assert jump_lower_bound(ca.sign(x), x, np.array([0.5]), np.array([0.5 + 1e-9])) == 0


def test_growth_along_a_ray():
    x, p = ca.SX.sym("x", 2), np.array([0.7, -0.51])
    to = x - ca.DM(p)
    across = ca.jacobian(to[1] / ca.norm_2(to), x[1])
    assert growth_exponent(across, x, p, np.array([1.0, 0.0]), 1e-6) == -1
    assert growth_exponent(ca.jacobian(ca.sqrt(ca.fabs(to[0])), x[0]), x, p, np.array([-1.0, 0.0]), 1e-6) * 2 == -1
    for smooth in (ca.sin(to[0]), ca.norm_2(to) ** 2, ca.sqrt(1 + ca.sumsqr(to)), to[0] * ca.fabs(to[0])):
        assert growth_exponent(ca.jacobian(smooth, x[0]), x, p, np.array([1.0, 0.0]), 1e-6) is None


def test_rates_and_velocities_without_bound():
    q = ca.SX.sym("q", 2)
    assert decided({"a": ca.norm_2(q) - 1 - ca.sqrt(t) / 4}, q, [0, 2])["A2"].verdict == VIOLATED
    assert decided({"a": ca.norm_2(q) - 1 - ca.sqrt(t + 1e-6) / 4}, q, [0, 2])["A2"].verdict == HOLDS
    start = decided({"a": q[1]}, q, [0, 0], ca.vertcat(0, ca.sqrt(q[1])))["S-f"]
    assert start.verdict == VIOLATED
    kept = decided({"a": ca.norm_2(q) - 1}, q, [0, 2], -q / ca.norm_2(q))["S-f"]
    assert kept.verdict == HOLDS
    assert kept.value["K_f"] >= 1
    free = decided({"a": ca.norm_2(q) - 1}, q, [0, 2], -(q - ca.DM([2, 0])) / ca.norm_2(q - ca.DM([2, 0])))["S-f"]
    assert free.verdict == VIOLATED


@pytest.mark.long
def test_what_is_not_proved_is_not_violated():
    """A tangency that closes and opens again touches at one time only: no interval Newton step sees it."""
    q = ca.SX.sym("q", 2)
    kissing = {"a": ca.norm_2(q) - 1, "b": ca.norm_2(q - ca.vertcat(2 + 0.1 * (t - 1.1) ** 2, 0)) - 1}
    assert decided(kissing, q, [0, 2])["A5'"].verdict in (UNKNOWN, VIOLATED)


@pytest.mark.parametrize(("x", "y", "d"), [(3, -4, 5), (-20, 21, 29)])
def test_fixed_discs_that_touch_far_from_the_start(x, y, d):
    """Their normals oppose each other where they touch, wherever that is; not where another disc covers it, or a gap is left."""
    q = ca.SX.sym("q", 2)
    r = d / 4

    def verdicts(s, *more):
        discs = [(40.0, 0.0, r), (40.0 + x, float(y), s), *more]
        g = {f"disc_{k}": ca.norm_2(q - ca.DM([a, b])) - radius for k, (a, b, radius) in enumerate(discs)}
        model = SweepingProcess(q=q, f=[0, 0], constraints=g, q0=[0, 0], t_end=1, step=0.1)
        report = nsmodel.check(model, quick=True)
        return report["A5"], report["A5'"]

    near, active = verdicts(d - r)
    assert (near.verdict, active.verdict, near.scope) == ("violated", "violated", None)
    touch = np.array([near.witness["q_0"], near.witness["q_1"]])
    assert np.allclose(touch, [40 + x / 4, y / 4], rtol=1e-15)
    assert verdicts(d - r - 2.0**-20)[0].verdict != "violated"
    assert verdicts(d - r, (40.0 + x / 4, y / 4, 0.25))[0].verdict != "violated"
