"""Hypotheses of sweeping processes against closed forms, brute force and dense samples."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL

import nsmodel
from nsmodel import SweepingProcess
from nsmodel import check as nsmodel_check
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.hypotheses.region import Region, region_of
from nsmodel.models.sweeping_process.check import HYPOTHESES, check, log_error_constant
from nsmodel.models.sweeping_process.constraint_shapes import read_shapes
from nsmodel.models.sweeping_process.mfcq_constant import disc_row_gamma, gram_bound, mfcq_constant

t = ca.SX.sym("t")
SQRT2 = np.sqrt(2)


def decided(constraints, q, q0, f=None, *, width=2.5, t_end=3.0, quick=False, step=0.01):
    """Findings and consequences by name, over the box |q_i| <= width."""
    model = SweepingProcess(t=t, q=q, f=f, constraints=constraints, q0=q0, t_end=t_end, step=step)
    n = len(model.names)
    region = Region(np.full(n, -width), np.full(n, width), 0.0, t_end, tuple(model.names), "given")
    findings, consequences = check(model, region, [], quick)
    assert [finding.id for finding in findings] == [hypothesis.id for hypothesis in HYPOTHESES]
    return {finding.id: finding for finding in findings} | {item.name: item for item in consequences}


def segment_distance(p, start, end):
    start, along = ca.DM(start), ca.DM(end) - ca.DM(start)
    part = ca.fmin(ca.fmax(ca.dot(p - start, along) / ca.sumsqr(along), 0), 1)
    return ca.norm_2(p - start - part * along)


@pytest.mark.parametrize("n", [2, 3, 5, 6, 7])
def test_the_size_of_a_constant_velocity_is_rounded_up(n):
    """sqrt(n) may be above its double."""
    q = ca.SX.sym("q", n)
    found = decided({"wall": q[0] + 5}, q, np.zeros(n), ca.SX.ones(n), quick=True)["S-f"]
    assert found.verdict == HOLDS
    assert Fraction(found.value["L_f"]) ** 2 >= n > (Fraction(found.value["L_f"]) * (1 - Fraction(1, 10**9))) ** 2


# -- gamma at a point --------------------------------------------------------------------------------------------------


def brute_force_distance(N):
    """Distance from 0 to the hull of unit vectors: the best over all small faces (Caratheodory)."""
    best = np.inf
    for size in range(1, min(len(N), N.shape[1] + 1) + 1):
        for face in combinations(range(len(N)), size):
            S = N[list(face)]
            G = np.block([[S @ S.T, np.ones((size, 1))], [np.ones((1, size)), np.zeros((1, 1))]])
            u = np.linalg.lstsq(G, np.append(np.zeros(size), 1.0), rcond=None)[0][:size]
            if (u >= -1e-12).all() and abs(u.sum() - 1) < 1e-9:
                best = min(best, float(np.linalg.norm(u @ S)))
    return best


def test_mfcq_constant_agrees_with_brute_force():
    rng = np.random.default_rng(0)
    for _ in range(500):
        n, k = rng.integers(1, 4), rng.integers(1, 7)
        N = rng.normal(size=(k, n)) * rng.uniform(0.1, 10, (k, 1))
        if rng.random() < 0.3:
            N = N[rng.integers(0, k, k)]  # duplicates
        unit = N / np.linalg.norm(N, axis=1, keepdims=True)
        distance, (gamma, u) = brute_force_distance(unit), mfcq_constant(N)
        assert u.min() >= 0
        assert u.sum() == pytest.approx(1, abs=1e-12)
        if distance < 1e-10:
            assert gamma == np.inf
        else:
            assert gamma == pytest.approx(1 / distance, rel=1e-9)
            assert np.linalg.norm(u @ unit) == pytest.approx(distance, rel=1e-9)


@pytest.mark.parametrize("psi", [0.0, 0.5, 2.0, np.pi - 1e-2, np.pi - 1e-4, np.pi - 1e-6])
def test_two_gradients_at_an_angle(psi):
    c, s = np.cos((np.pi - psi) / 2), np.sin((np.pi - psi) / 2)  # symmetric about the second axis: no cancellation
    gamma, u = mfcq_constant(np.array([[3 * c, 3 * s], [-c, s]]))
    assert gamma == pytest.approx(1 / s, rel=1e-10)
    assert gamma == pytest.approx(1 / np.cos(psi / 2), rel=1e-9)
    if psi:
        assert u == pytest.approx([0.5, 0.5])


def test_gamma_of_special_sets():
    assert mfcq_constant(np.zeros((0, 3)))[0] == 1.0
    gamma, u = mfcq_constant(np.array([[2.0, 0.0], [-1.0, 1e-17]]))
    assert gamma == np.inf
    assert u == pytest.approx([0.5, 0.5])
    gamma, u = mfcq_constant(np.array([[1.0, 0.0], [0.0, 0.0]]))  # a gradient that vanishes
    assert gamma == np.inf
    assert u.tolist() == [0.0, 1.0]
    assert mfcq_constant(np.vstack([np.eye(7)] * 3))[0] == pytest.approx(np.sqrt(7))


@pytest.mark.parametrize("k", range(2, 9))
def test_discs_in_a_row(k):
    normals = np.zeros((k - 1, 2 * k))
    for i in range(k - 1):
        normals[i, 2 * i], normals[i, 2 * i + 2] = -1, 1
    assert mfcq_constant(normals)[0] == pytest.approx(disc_row_gamma(k), rel=1e-12)


def test_gram_bound_is_above_gamma_and_attained():
    rng = np.random.default_rng(1)
    tight = 0
    for _ in range(200):
        N = rng.normal(size=(rng.integers(2, 6), 5))
        N /= np.linalg.norm(N, axis=1, keepdims=True)
        G = np.minimum(N @ N.T, 0.0)
        np.fill_diagonal(G, 1.0)
        bound, gamma = gram_bound(G), mfcq_constant(N)[0]
        assert gamma <= bound * (1 + 1e-9)
        tight += bound < gamma * (1 + 1e-9)
    assert tight > 5


# -- shapes ------------------------------------------------------------------------------------------------------------


def test_shapes_are_read_and_convexity_is_never_claimed_wrongly():
    q = ca.SX.sym("q", 2)
    a, b = (0.1, 0.2), (1.3, 0.7)
    wrong = ca.norm_2(q - ca.DM(a) - (ca.DM(b) - ca.DM(a)) * ca.fmin(ca.fmax(1.1 * q[0], 0), 1)) - 0.3
    cases = {
        "plane": (q[0] - 2 * q[1] + ca.sin(t), True),
        "distance": (2 * ca.norm_2(q - ca.vertcat(t, 1)) - ca.exp(-t), True),
        "segment": (segment_distance(q, a, b) - 0.3, True),
        "box": (ca.norm_2(q - ca.fmin(ca.fmax(q, -1), ca.vertcat(1, 2))) - 0.5, True),
        "quadratic": (ca.sumsqr(q - t) - 1, True),
        "saddle": (q[0] * q[1] - 1, False),
        "inside a disc": (1 - ca.norm_2(q), False),
        "wrong projection": (wrong, False),
        "folded": (ca.fabs(ca.fabs(q[0]) - 1), False),
        "mixed": (ca.norm_2(q) + ca.exp(q[0]) + ca.fmax(q[1], 0) - 3, True),
        "square of a negative": ((ca.norm_2(q) - 1) ** 2, False),
    }
    kinds = ("plane", "distance", "distance", "distance", "quadratic", "quadratic", "other", "other", "other", "other", "other")
    shapes = read_shapes(ca.vertcat(*(g for g, _ in cases.values())), q)
    rng = np.random.default_rng(0)
    for (name, (g, convex)), kind, shape in zip(cases.items(), kinds, shapes, strict=True):
        assert shape.kind == kind, name
        assert shape.convex == convex, name
        f = ca.Function("g", [t, q], [g])
        times, x, y = rng.uniform(0, 3, (1, 2000)), rng.uniform(-3, 3, (2, 2000)), rng.uniform(-3, 3, (2, 2000))
        rise = np.array(f(times, (x + y) / 2) - (f(times, x) + f(times, y)) / 2)
        assert (rise.max() <= 1e-12) == convex, name


# -- closed forms ------------------------------------------------------------------------------------------------------


def test_two_discs(load_case, run_case):
    model, run = load_case("two_discs"), run_case("two_discs")
    findings, consequences = check(model, region_of(model, [run]), [run], False)
    assert [finding.verdict for finding in findings] == [HOLDS] * len(HYPOTHESES)
    assert all(finding.scope is None for finding in findings)
    value = {finding.id: finding.value for finding in findings}
    r = 0.3
    assert value["A1"]["a"] <= SQRT2 <= value["A1"]["b"] <= value["A1"]["a"] * (1 + 4e-16)
    assert value["A4"]["M_contact"] == pytest.approx(1 / r, rel=1e-12)
    assert value["A4"]["M"] == pytest.approx(2 / r, rel=1e-12)  # |u| >= r on U_i = {g > -r}
    assert value["A0"]["c"] == pytest.approx(r / SQRT2)
    assert value["A2"]["b"] == value["A3"]["M"] == 0
    assert value["A5"]["gamma"] == value["A5'"]["gamma"] == 1
    assert value["S-start"]["min g"] == pytest.approx(1.4)
    eta = {item.name: item.value for item in consequences}["prox-regular"]["eta"]
    assert eta == pytest.approx(SQRT2 * r)  # the radius of the cylinder {|q_1 - q_2| < 2 r} in R^4


def test_moving_half_line(load_case, run_case):
    model, run = load_case("moving_half_line"), run_case("moving_half_line")
    findings, consequences = check(model, region_of(model, [run]), [run], False)
    assert [finding.verdict for finding in findings] == [HOLDS] * len(HYPOTHESES)
    value = {finding.id: finding.value for finding in findings}
    assert value["A1"]["a"] == value["A1"]["b"] == value["A5"]["gamma"] == value["S-f"]["K_f"] == 1
    assert value["A2"]["b"] == pytest.approx(1)
    assert value["A4"]["M"] == value["A3"]["M"] == value["S-start"]["min g"] == value["S-f"]["L_t"] == 0
    assert not {"c", "rho"} & {*value["A0"], *value["A5"]}
    named = {item.name: item for item in consequences}
    assert named["prox-regular"].statement == "Q(t) is convex"
    assert "for every h" in named["step bound"].statement
    assert named["well posed"].scope.time == (0, model.t_end)
    assert named["K_L"].value["K_L"] == pytest.approx(1)
    assert named["metric qualification"].value["kappa"] == 0
    assert {item.verdict for item in consequences} == {HOLDS}
    error = np.abs(run.x - model.exact(run.t)).max()
    assert np.log10(error) < named["order 1/2"].value["log10 C_0"] + 0.5 * np.log10(0.01)


def test_moving_disc_and_point_past_disc(load_case, run_case):
    for stem, speed in (("moving_disc", 1.0), ("point_past_disc", 0.0)):
        model, run = load_case(stem), run_case(stem)
        findings, consequences = check(model, region_of(model, [run]), [run], False)
        value = {finding.id: finding.value for finding in findings}
        assert {finding.verdict for finding in findings} == {HOLDS}
        assert (value["A1"]["a"], value["A1"]["b"], value["A5'"]["gamma"]) == (1, 1, 1)
        assert (value["A4"]["M"], value["A4"]["M_contact"]) == (2, 1)
        assert (value["A2"]["b"], value["A3"]["M"]) == pytest.approx((speed, 2 * speed))
        named = {item.name: item.value for item in consequences}
        assert named["K_L"]["K_L"] == pytest.approx(speed)
        assert named["prox-regular"]["eta"] == 1
        assert named["step bound"].get("h", np.inf) == pytest.approx(0.5 / speed if speed else np.inf)


def test_three_discs_and_a_floor_are_proved_everywhere():
    q = ca.SX.sym("q", 6)
    bodies, r = ca.vertsplit(q, 2), 0.5
    pairs = {f"{i}{j}": ca.norm_2(bodies[j] - bodies[i]) - 2 * r for i, j in combinations(range(3), 2)}
    alone = decided(pairs, q, [-1, 0, 0, 0, 1, 0])
    for id in ("A5", "A5'"):
        assert alone[id].verdict == HOLDS
        assert alone[id].scope is None
    assert alone["A5'"].value["gamma"] == pytest.approx(2)  # three in a row: sqrt((27 - 3) / 6), and the start attains it
    assert alone["A5'"].value["attained"] == pytest.approx(2)
    floor = decided(pairs | {"floor": bodies[0][1] + 1}, q, [-1, 0, 0, 0, 1, 0])
    assert floor["A5"].verdict == HOLDS
    assert floor["A5"].value["attained"] <= floor["A5"].value["gamma"] < np.inf


def test_a_segment_is_a_distance_with_gradient_one():
    q = ca.SX.sym("q", 2)
    found = decided({"wall": segment_distance(q, (0.1, 0.2), (1.3, 0.7)) - 0.3}, q, [-1, -1])
    assert {found[id].verdict for id in ("S-convex", "A0", "A1", "A2", "A3", "A4")} == {HOLDS}
    assert found["A1"].value["a"] == found["A1"].value["b"] == 1
    assert found["A4"].value["M_contact"] == pytest.approx(1 / 0.3)
    assert all(found[id].scope is None for id in ("S-convex", "A1", "A4"))
    assert all("rounded" in found[id].how for id in ("S-convex", "A1", "A4"))  # 1.2^2 + 0.5^2
    exactly = decided({"wall": segment_distance(q, (0, 0.25), (1.5, 2)) - 0.25}, q, [-1, -1])
    assert all("rounded" not in exactly[id].how for id in ("S-convex", "A1", "A4"))


def test_quadratics():
    q = ca.SX.sym("q", 2)
    found = decided({"disc": ca.sumsqr(q) - 1}, q, [2, 1])
    # delta = 1/2, |q| >= sqrt(1/2) on U_i, sqrt(12.5) at the corners of the box.
    assert found["A1"].verdict == HOLDS
    assert found["A1"].value["a"] == pytest.approx(2 * np.sqrt(0.5))
    assert found["A1"].value["b"] == pytest.approx(2 * np.sqrt(12.5))
    assert 2 <= found["A4"].value["M"] <= 2 * (1 + 1e-13)
    assert 2 * (1 - 1e-13) <= found["S-convex"].value["least"] <= 2
    # The strip between Q and the boundary of U is 1 - sqrt(1/2) wide; c is a bound of it.
    assert 0.2 < found["A0"].value["c"] <= 1 - np.sqrt(0.5)
    pole = decided({"bowl": ca.sumsqr(q - ca.vertcat(1, 0)) + 0.5}, q, [2, 1])
    assert pole["A1"].verdict == VIOLATED
    assert [pole["A1"].witness[name] for name in ("q_0", "q_1")] == pytest.approx([1, 0])


def test_not_convex():
    q = ca.SX.sym("q", 2)
    found = decided({"inside": 1 - ca.sumsqr(q)}, q, [0, 0.5])
    assert found["S-convex"].verdict == VIOLATED
    assert found["S-convex"].value["least"] == -2
    assert np.linalg.norm(found["S-convex"].witness["eigenvector"]) == pytest.approx(1)
    assert found["S-convex"].witness["constraint"] == "inside"
    assert found["A1"].verdict == VIOLATED  # at the centre, which is admissible
    assert found["well posed"].verdict == UNKNOWN
    for name, g in {"norm": 1 - ca.norm_2(q), "kink": 2 - ca.fabs(q[0]), "wave": ca.sin(3 * q[0]) + 2}.items():
        item = decided({name: g}, q, [0, 0.5])["S-convex"]
        assert item.verdict == VIOLATED, name
        assert item.value["least"] < 0


def test_kinks_and_jumps_of_constraints():
    q = ca.SX.sym("q", 2)
    found = decided({"corner": ca.fmax(q[0], q[1]) + 1}, q, [0, 0.5])
    assert found["S-convex"].verdict == HOLDS
    assert found["A1"].verdict == found["A4"].verdict == VIOLATED
    assert found["A4"].value["jump"] == pytest.approx(SQRT2)  # from (1, 0) to (0, 1)
    steps = decided({"steps": q[0] + ca.floor(q[1])}, q, [1, 0.5])
    assert steps["S-convex"].verdict == steps["A4"].verdict == VIOLATED
    door = decided({"door": q[0] - 0.3 * ca.sign(t - 1)}, q, [1, 0.5])
    assert door["A2"].verdict == VIOLATED
    assert door["A2"].witness["t"] == pytest.approx(1)
    point = decided({"point": ca.norm_2(q)}, q, [1, 1])
    assert point["A1"].verdict == point["A4"].verdict == point["A0"].verdict == VIOLATED


def test_a_smooth_constraint_of_no_known_shape():
    q = ca.SX.sym("q", 2)
    found = decided({"wave": ca.exp(q[0]) + q[1] ** 2 - 1}, q, [1, 0.5], width=1.0)
    assert {found[id].verdict for id in ("S-convex", "A0", "A1", "A2", "A3", "A4")} == {HOLDS}
    e = np.e
    assert found["A4"].value["M"] == pytest.approx(e, rel=1e-2)  # D2 = diag(exp q_0, 2)
    assert found["A4"].value["M"] >= e * (1 - 1e-12)
    assert found["A1"].value["b"] >= np.hypot(e, 2) * (1 - 1e-12)
    least = 1 - found["A0"].value["c"] * found["A1"].value["b"]  # exp q_0 + q_1^2 > 1 - delta on U_i
    grid = np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 400))
    inside = np.exp(grid[0]) + grid[1] ** 2 >= least
    assert found["A1"].value["a"] <= np.hypot(np.exp(grid[0]), 2 * grid[1])[inside].min()


# -- A5 ----------------------------------------------------------------------------------------------------------------


def test_walls_that_touch_and_walls_that_do_not():
    q = ca.SX.sym("q", 2)
    touching = decided({"left": q[0] + 0.5, "right": -0.5 - q[0]}, q, [-0.5, 0])
    for id in ("A5", "A5'"):
        assert touching[id].verdict == VIOLATED
        assert sorted(touching[id].witness["constraints"]) == ["left", "right"]
        assert touching[id].witness["weights"] == pytest.approx([0.5, 0.5])
        assert touching[id].witness["q_0"] == pytest.approx(-0.5, abs=1e-8)
    assert touching["well posed"].verdict == UNKNOWN
    moving = decided({"left": q[0] - ca.sin(t), "right": ca.sin(t) + 0.01 - q[0]}, q, [0.005, 0])
    assert moving["A5"].verdict == HOLDS
    assert moving["A5"].value["gamma"] == 1
    assert 0 < moving["A5"].value["rho"] < 0.005
    closing = decided({"left": q[0] + 1 - t, "right": 1 - q[0]}, q, [0, 0])  # they meet at t = 2
    assert closing["A5'"].verdict == VIOLATED
    assert closing["A5'"].witness["t"] == pytest.approx(2, abs=1e-6)


def test_discs_that_touch_are_found():
    q = ca.SX.sym("q", 2)
    apart = {"a": ca.norm_2(q + ca.vertcat(1.2, 0)) - 1, "b": ca.norm_2(q - ca.vertcat(1.2, 0)) - 1}
    assert decided(apart, q, [0, 2])["A5'"].value["gamma"] <= SQRT2 * (1 + 1e-12)
    touching = {"a": ca.norm_2(q + ca.vertcat(1, 0)) - 1, "b": ca.norm_2(q - ca.vertcat(1, 0)) - 1}
    found = decided(touching, q, [0, 2])["A5'"]
    assert found.verdict == VIOLATED
    assert [found.witness[name] for name in ("q_0", "q_1")] == pytest.approx([0, 0], abs=1e-4)


@pytest.mark.parametrize("d", [0.3, 0.8])
def test_two_discs_that_overlap(d):
    q = ca.SX.sym("q", 2)
    found = decided({"a": ca.norm_2(q + ca.vertcat(d, 0)) - 1, "b": ca.norm_2(q - ca.vertcat(d, 0)) - 1}, q, [0, 2])
    gamma = 1 / np.sqrt(1 - d**2)  # at (0, h), h^2 = 1 - d^2, |n_1 + n_2| = 2 h
    assert found["A5"].verdict == found["A5'"].verdict == HOLDS
    assert gamma <= found["A5'"].value["gamma"] * (1 + 1e-12)
    assert found["A5"].value["gamma"] <= 1.2 * gamma
    assert found["A5"].value.get("rho", np.inf) > 0


def test_planes_agree_with_brute_force():
    rng, q = np.random.default_rng(3), ca.SX.sym("q", 2)
    several = 0
    for _ in range(20):
        k = rng.integers(2, 6)
        A, b = rng.normal(size=(k, 2)), rng.uniform(0.2, 1.5, k)
        walls = {f"wall {i}": ca.dot(ca.DM(A[i]), q) + b[i] for i in range(k)}
        found = decided(walls, q, [0, 0], quick=True)["A5'"]
        assert found.verdict == HOLDS
        worst = 1.0
        for i, j in combinations(range(k), 2):  # at the vertices of the polygon
            corner = np.linalg.solve(A[[i, j]], -b[[i, j]])
            if (A @ corner + b >= -1e-9).all():
                worst = max(worst, mfcq_constant(A[[i, j]])[0])
        several += worst > 1
        assert found.value["gamma"] == pytest.approx(worst, rel=1e-9)
    assert several > 10


def test_groups_without_common_states_add_their_squares():
    q = ca.SX.sym("q", 4)
    bodies = ca.vertsplit(q, 2)
    discs = {
        f"{k}{s}": ca.norm_2(bodies[k] - ca.vertcat(s * 0.6, 0)) - 1 for k in range(2) for s in (-1, 1)
    }  # fmt: skip
    found = decided(discs, q, [0, 2, 0, 2])["A5'"]
    assert found.verdict == HOLDS
    gamma = 1 / np.sqrt(1 - 0.6**2)
    assert gamma * SQRT2 <= found.value["gamma"] * (1 + 1e-12)
    assert found.value["gamma"] <= 1.2 * gamma * SQRT2


# -- the velocity and the start ----------------------------------------------------------------------------------------


def test_velocity_fields():
    q = ca.SX.sym("q", 2)
    A = np.array([[1.0, 2.0], [0.5, -1.0]])
    wall = {"wall": q[0] + 1}
    affine = decided(wall, q, [0, 0], ca.DM(A) @ q + ca.vertcat(ca.sin(t), 0))["S-f"]
    assert affine.verdict == HOLDS
    assert not affine.scope.states
    assert affine.scope.time is not None
    assert affine.value["K_f"] == pytest.approx(np.linalg.norm(A, 2))
    assert affine.value["L_t"] == pytest.approx(1, rel=1e-2)
    swirl = decided(wall, q, [0, 0], ca.vertcat(ca.sin(2 * q[0]), -q[1]))["S-f"]
    assert swirl.verdict == HOLDS
    assert swirl.value["K_f"] == pytest.approx(2, rel=1e-2)
    timed = decided(wall, q, [0, 0], ca.sign(t - 1) * q)["S-f"]
    assert timed.verdict == HOLDS
    assert timed.value["K_f"] == pytest.approx(1)
    assert "L_t" not in timed.value
    root = decided(wall, q, [0, 0], ca.vertcat(ca.sqrt(ca.fabs(q[0])), 0))["S-f"]
    assert root.verdict == VIOLATED


def test_jumps_of_the_velocity_count_inside_the_set_only():
    q = ca.SX.sym("q", 2)
    f = ca.vertcat(ca.if_else(q[0] < 0.5, 1, 0), 0)
    inside = decided({"wall": q[0] + 1}, q, [0, 0], f)["S-f"]
    assert inside.verdict == VIOLATED
    assert 1 - 1e-12 <= inside.value["jump"] <= 1
    assert inside.value["K_f"] == np.inf
    assert inside.witness["to"][0] == pytest.approx(0.5)
    outside = decided({"wall": q[0] - 1}, q, [1.5, 0], f)["S-f"]
    assert outside.verdict != VIOLATED
    glued = decided({"wall": q[0] + 1}, q, [0, 0], ca.vertcat(ca.if_else(q[0] < 0.5, 2 * q[0], 1), 0))["S-f"]
    assert glued.verdict != VIOLATED
    assert glued.value["K_f"] >= 1.9


def test_the_start():
    q = ca.SX.sym("q", 2)
    exact = decided({"disc": ca.norm_2(q) - 5}, q, [3, 4])["S-start"]
    assert (exact.verdict, exact.value["min g"]) == (HOLDS, 0)
    rounded = decided({"wall": q[0] + q[1] - 0.3}, q, [0.1, 0.2 - 1e-15])["S-start"]
    assert rounded.verdict == SAMPLED
    assert "rounding" in rounded.how
    outside = decided({"wall": q[0] - 0.3, "other": q[1] + 1}, q, [0.1, 0])["S-start"]
    assert outside.verdict == VIOLATED
    assert outside.witness["constraint"] == "wall"
    assert outside.value["min g"] == pytest.approx(-0.2)


# -- consequences ------------------------------------------------------------------------------------------------------


def test_the_error_constant_does_not_overflow():
    small = log_error_constant(K=1, C=1, T=1, K_f=0, L_f=1, L_t=0, K_L=0, kappa=0, r=np.inf)
    assert small == pytest.approx(0.5 * np.log10(4 * 2))  # C_5 = 4 K^2, L = 0: C_0^2 = 2 T C_5
    K_f, T = 0.5, 2.0
    moderate = log_error_constant(K=1, C=1, T=T, K_f=K_f, L_f=1, L_t=0, K_L=0, kappa=0, r=np.inf)
    C_5, L = 4 + 8 * K_f, 2 * K_f
    assert moderate == pytest.approx(0.5 * np.log10(C_5 * np.expm1(2 * L * T) / L))
    huge = log_error_constant(K=1, C=1, T=1, K_f=0, L_f=1, L_t=0, K_L=0, kappa=1e6, r=1)
    assert 1e6 < huge < np.inf
    assert log_error_constant(K=1, C=1, T=1, K_f=np.inf, L_f=1, L_t=0, K_L=0, kappa=0, r=1) == np.inf


def test_no_constraint_and_no_velocity():
    q = ca.SX.sym("q", 2)
    found = decided({}, q, [0, 0])
    assert {found[hypothesis.id].verdict for hypothesis in HYPOTHESES} == {HOLDS}
    assert found["prox-regular"].statement == "Q(t) is convex"


def test_the_step_of_the_model_is_compared_with_the_bound():
    q = ca.SX.sym("q", 2)
    disc = {"disc": ca.norm_2(q - ca.vertcat(t, 0)) - 1}
    assert "the model's own step 0.01 meets it" in decided(disc, q, [3, 0])["step bound"].statement
    assert "the model's own step 0.75 does not meet it" in decided(disc, q, [3, 0], step=0.75)["step bound"].statement


# -- the crowd ---------------------------------------------------------------------------------------------------------


# -- many random models ------------------------------------------------------------------------------------------------


def random_model(rng):
    kind = rng.choice(["point", "agents", "planes", "quadratic"])
    n = {"point": int(rng.integers(1, 4)), "agents": 2 * int(rng.integers(2, 4))}.get(kind, 2)
    q, g = ca.SX.sym("q", n), {}
    if kind == "agents":
        bodies, radii = ca.vertsplit(q, 2), rng.uniform(0.1, 0.5, n // 2)
        for i, body in enumerate(bodies):
            g |= {f"p{i}{j}": ca.norm_2(body - bodies[j]) - radii[i] - radii[j] for j in range(i)}
            if rng.random() < 0.3:
                g[f"s{i}"] = segment_distance(body, rng.uniform(-2, 2, 2), rng.uniform(-2, 2, 2)) - radii[i]
            if rng.random() < 0.4:
                g[f"w{i}"] = body[0] + 2 - radii[i] + 0.1 * ca.sin(t)
    elif kind == "point":
        for k in range(rng.integers(1, 3)):
            A = np.eye(n) if rng.random() < 0.6 else rng.normal(size=(n, n))
            centre = ca.DM(rng.uniform(-2, 2, n)) + ca.DM(rng.normal(size=n)) * ca.sin(2 * t) * (rng.random() < 0.3)
            g[f"d{k}"] = rng.uniform(0.5, 2) * ca.norm_2(ca.DM(A) @ (q - centre)) - rng.uniform(0.2, 1)
        if rng.random() < 0.5:
            g["plane"] = ca.dot(ca.DM(rng.normal(size=n)), q) + rng.uniform(0, 3)
    elif kind == "planes":
        for k in range(rng.integers(1, 5)):
            g[f"w{k}"] = ca.dot(ca.DM(rng.normal(size=n)), q) + rng.uniform(0.1, 2) + 0.3 * ca.sin(t) * (rng.random() < 0.4)
    else:
        B = rng.normal(size=(2, 2))
        H = B @ B.T + 0.1 * np.eye(2)
        g["quadratic"] = ca.bilin(ca.DM(H), q, q) + ca.dot(ca.DM(rng.normal(size=2)), q) - rng.uniform(0.5, 1.5)
        if rng.random() < 0.5:
            g["moving"] = ca.sumsqr(q - ca.vertcat(ca.sin(t), 3)) - 1
    f = {0: ca.DM(rng.normal(size=(n, n))) @ q, 1: ca.sin(3 * q), 2: -q / ca.sqrt(1 + ca.sumsqr(q)), 3: ca.SX.zeros(n)}
    return SweepingProcess(t=t, q=q, f=f[int(rng.integers(4))], constraints=g, q0=rng.uniform(-2, 2, n), t_end=1.5, step=0.01)


def contradictions(model, region, found, rng, count=30):
    """What admissible points of the box say against the numbers of findings that hold."""
    n, p = len(model.names), model.g.numel()
    g, q = model.g, model.q
    J = ca.jacobian(g, q)
    second = ca.jacobian(ca.vec(J.T), q)
    rates = ca.jacobian(g, t), ca.jacobian(ca.vec(J.T), t)
    f = ca.Function("all", [t, q], [g, J, second, *rates, ca.jacobian(model.f, q), model.f])
    on = ca.Function("g", [t, q], [g, J])
    value = {id: item.value if item.verdict == HOLDS else None for id, item in found.items()}
    bad = []

    def above(id, name, number):
        if value[id] is not None and number > value[id][name] * (1 + 1e-7) + 1e-9:
            bad.append((id, name, number, dict(value[id])))

    for k in range(count):
        time, x = rng.uniform(region.t0, region.t1), rng.uniform(region.lower, region.upper)
        if k % 2 and p > 1:  # on, or near, the intersection of a few constraints
            some = rng.choice(p, size=min(int(rng.integers(1, 4)), p, n), replace=False)
            for _ in range(8):
                G, slope = (np.array(item) for item in on(time, x))
                if not (np.isfinite(G).all() and np.isfinite(slope).all()):
                    break
                x = x - np.linalg.lstsq(slope[some], G.ravel()[some], rcond=None)[0]
        if not ((x >= region.lower).all() and (x <= region.upper).all()):
            continue
        G, slope, H, g_t, slope_t, f_q, f_x = (np.array(item) for item in f(time, x))
        G = G.ravel()
        above("A2", "b", np.abs(g_t).max())
        for i in np.flatnonzero(G >= 0):
            size = np.linalg.norm(slope[i])
            above("A1", "b", size)
            if value["A1"] is not None and size < value["A1"]["a"] * (1 - 1e-9):
                bad.append(("A1", "a", size, dict(value["A1"])))
            above("A4", "M_contact", np.linalg.norm(H[i * n : (i + 1) * n], 2))
            above("A3", "M", np.linalg.norm(slope_t[i * n : (i + 1) * n]))
        if G.min() >= -1e-10:
            above("S-f", "K_f", np.linalg.norm(f_q, 2))
            above("S-f", "L_f", np.linalg.norm(f_x) / (1 + np.linalg.norm(x)))
            above("A5'", "gamma", mfcq_constant(slope[G <= 1e-10])[0])
            if value["A5"] is not None:
                above("A5", "gamma", mfcq_constant(slope[value["A5"].get("rho", np.inf) >= G])[0])
    return bad


def test_no_point_contradicts_what_holds():
    rng = np.random.default_rng(11)
    proved = dict.fromkeys((hypothesis.id for hypothesis in HYPOTHESES), 0)
    count = 200 * COUNT // FULL
    for number in range(count):
        model = random_model(rng)
        n = len(model.names)
        region = Region(np.full(n, -2.5), np.full(n, 2.5), 0.0, 1.5, tuple(model.names), "given")
        findings, _ = check(model, region, [], quick=number % 50 > 0)
        found = {finding.id: finding for finding in findings}
        assert contradictions(model, region, found, rng) == [], (number, list(model.constraints))
        for id, item in found.items():
            proved[id] += item.verdict == HOLDS
    assert proved["S-convex"] == proved["A1"] == proved["A4"] == count
    assert proved["A5"] > 0.4 * count


# -- what is easily overlooked -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "g",
    [
        lambda q: q[0] * (2 + ca.sign(t - 1)) + q[1] + 5,
        lambda q: ca.norm_2(q - ca.vertcat(ca.if_else(t < 1, 0, 1), 0)) - 0.1,
        lambda q: ca.sumsqr(q - ca.vertcat(ca.if_else(t < 1, 0, 1), 0)) - 0.1,
        lambda q: q[0] ** 2 + q[1] ** 4 * (2 + ca.sign(t - 1)) - 0.1,
    ],
    ids=["plane", "disc", "quadratic", "quartic"],
)
def test_a_gradient_that_jumps_in_time_breaks_A3(g):
    q = ca.SX.sym("q", 2)
    found = decided({"g": g(q)}, q, [2, 2])["A3"]
    assert found.verdict == VIOLATED
    at = [found.witness[f"q_{i}"] for i in range(2)]
    slope = ca.Function("slope", [t, q], [ca.gradient(g(q), q)])
    before, after = (np.array(slope(found.witness["t"] + step, at)) for step in (-1e-9, 1e-9))
    assert np.linalg.norm(after - before) > 0.01


def test_a_step_in_time_outside_of_the_interval_is_none():
    q = ca.SX.sym("q", 2)
    found = decided({"g": q[0] * (2 + ca.sign(t + 1)) + q[1] + 5}, q, [1, 1])
    assert {found[id].verdict for id in ("A2", "A3")} == {HOLDS}


@pytest.mark.parametrize(("offset", "verdict"), [(0.0, VIOLATED), (1.0, HOLDS)])
def test_a_disc_far_from_the_origin_has_its_own_depth(offset, verdict):
    """(1e8)^2 - 1 is 1e16 in doubles: an expanded minimum would be 0."""
    q = ca.SX.sym("q", 2)
    found = decided({"g": (q[0] - 1e8) ** 2 + (q[1] - 1e8 / 3) ** 2 - offset}, q, [3, 3])
    assert found["A1"].verdict == found["A0"].verdict == verdict
    if offset:
        assert found["A1"].value["a"] == pytest.approx(np.sqrt(2))
    else:
        assert [found["A1"].witness[f"q_{i}"] for i in range(2)] == [1e8, 1e8 / 3]


def test_blocks_of_f_that_differ_in_late_digits_or_in_their_switches_are_apart():
    q = ca.SX.sym("q", 2)
    by_digits = ca.vertcat((q[0] - 1000000) ** 2, (q[1] - 1000004) ** 2)
    assert decided({}, q, [0, 0], by_digits)["S-f"].value["K_f"] == pytest.approx(2 * 1000006.5)
    by_switches = ca.vertcat(ca.floor(1 + 0.1 * t) * q[0], ca.floor(5 * t) * q[1])
    assert decided({}, q, [1, 1], by_switches, t_end=1.0)["S-f"].value["K_f"] == 5


def test_switches_in_time_that_exclude_each_other_make_no_jump():
    q = ca.SX.sym("q")
    for constant, verdict in ((-1, SAMPLED), (1, VIOLATED)):
        assert decided({}, q, [1], ((t < 0.5) + (t >= 0.5) + constant) * ca.sign(q))["S-f"].verdict == verdict


@pytest.mark.parametrize("f", [ca.if_else(t < 1, 1, -1), -ca.sqrt(t)], ids=["jump", "root"])
def test_no_order_is_proved_where_f_is_not_lipschitz_in_time(f):
    q = ca.SX.sym("q")
    found = decided({"wall": q}, q, [1], f)
    assert found["S-f"].verdict == found["well posed"].verdict == HOLDS
    assert "L_t" not in found["S-f"].value
    assert found["order 1/2"].verdict == UNKNOWN
    assert decided({"wall": q}, q, [1], -ca.sin(t))["order 1/2"].verdict == HOLDS


def test_a_quick_check_does_not_look_for_jumps_and_says_so():
    q = ca.SX.sym("q")
    found = decided({"wall": q}, q, [1], ca.if_else(q > 0.5, 1, -1), quick=True)["S-f"]
    assert found.verdict == UNKNOWN
    assert "quick" in found.how
    assert decided({"wall": q}, q, [1], ca.if_else(q > 0.5, 1, -1))["S-f"].verdict == VIOLATED


def test_bodies_of_different_dimensions_with_walls():
    """Three discs and three balls, all in contact in pairs, each kind with a wall."""
    q = ca.SX.sym("q", 15)
    bodies = [q[:2], q[2:4], q[4:6], q[6:9], q[9:12], q[12:15]]
    pairs = {f"{i}{j}": ca.norm_2(bodies[i] - bodies[j]) - 1 for i, j in ((0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5))}
    found = decided(pairs | {"a": q[0] + 5, "b": q[6] + 5}, q, [0, 0, 2, 0, 0, 3, 0, 0, 0, 0, 0, 3, 0, 3, 0], quick=True)
    assert found["A5"].verdict == HOLDS


@pytest.mark.parametrize("width", [1e-12, 5e-10, 1.0])
def test_a_narrow_corridor_is_no_contact_of_both_walls(width):
    q = ca.SX.sym("q")
    found = decided({"left": q, "right": width - q}, q, [width / 2], quick=True)["A5'"]
    assert found.verdict == HOLDS
    assert found.value["gamma"] == found.value["attained"] == 1


def test_a_jump_outside_of_the_box_does_not_matter_to_convexity():
    q = ca.SX.sym("q")
    assert decided({"g": ca.if_else(q > -50, q**2, 0) + q + 3}, q, [0])["S-convex"].verdict == HOLDS


def test_two_half_planes_apart_are_not_convex_together():
    """|q_0 - q_1| >= 1 has two sides sqrt(2) apart: between them eta is 1/sqrt(2) at most, and its linearisation errs."""
    q = ca.SX.sym("q", 2)
    found = decided({"a": ca.fabs(q[0] - q[1]) - 1}, q, [0, 2], quick=True)
    assert found["A4"].verdict == HOLDS
    assert found["prox-regular"].value["eta"] == pytest.approx(1 / SQRT2)
    assert np.isfinite(found["metric qualification"].value["r"])
    here, there = np.array([0.5, -0.5]), np.array([-0.5, 0.5])
    deficit = 2 / SQRT2  # Of the one from the half-plane at the other.
    assert deficit <= found["linearisation error"].value["M/(2a)"] * np.sum((here - there) ** 2)


def test_kinks_are_no_jumps():
    q = ca.SX.sym("q", 1)
    for far in (0.0, 1.0, 1e6):
        for kink in (ca.if_else(q > far, q - far, 0), (q - far) * ca.sign(q - far), 3 + ca.if_else(q < far, far - q, 0)):
            model = SweepingProcess(t=t, q=q, f=kink, constraints={"a": q + 9}, q0=[far], t_end=1, step=0.1)
            region = Region(np.array([far - 2]), np.array([far + 2.5]), 0.0, 1.0, tuple(model.names), "given")
            finding = {item.id: item for item in check(model, region, [], False)[0]}["S-f"]
            assert finding.verdict != "violated"
            assert finding.value["K_f"] == pytest.approx(1)
    jump = ca.if_else(q > 1, q + 1e-3, q)
    assert decided({"a": q + 9}, q, [0], jump)["S-f"].value["jump"] == pytest.approx(1e-3)


def test_a_steep_place_is_asked_at_its_own_time():
    q = ca.SX.sym("q", 1)
    f = ca.sqrt(ca.fabs(q)) * ca.fmax(t - 0.5, 0)
    assert decided({"wall": q - t + 0.25}, q, [0.5], f)["S-f"].verdict != "violated"
    assert decided({"wall": q + 9}, q, [0.5], f)["S-f"].verdict == "violated"


def test_what_is_active_to_rounding_alone_is_not_shown():
    """Walls 1e-8 apart in a box of 2e3 are active together to rounding, never exactly."""
    q = ca.SX.sym("q", 2)
    found = decided({"low": q[1], "high": 1e-8 - q[1]}, q, [0, 5e-9], width=1e3, quick=True)["A5'"]
    assert (found.verdict, found.value["gamma"], found.value["attained"]) == (HOLDS, 1, 1)


# -- an empty set ------------------------------------------------------------------------------------------------------

x1, x2 = ca.SX.sym("x1"), ca.SX.sym("x2")
ABOUT_POINTS = ("A5", "A5'", "well posed", "prox-regular", "K_L", "step bound", "linearisation error", "metric qualification",
                "order 1/2")  # fmt: skip


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        ({"a": x1 - 1, "b": -x1}, "a, b together"),
        ({"a": -1 - x1**2}, "a"),
        (
            {"a": ca.norm_2(ca.vertcat(x1, x2)) - 5, "left": 1 - x1, "right": 1 + x1, "up": 1 - x2, "low": 1 + x2},
            "a, left, right, up, ... together",
        ),
        ({"a": x1 + x2 - 1, "b": x1 - x2 - 1, "c": 0.5 - x1}, "a, b, c together"),
    ],
    ids=str,
)  # fmt: skip
def test_of_points_of_an_empty_set_nothing_holds(rows, names):
    found = decided(rows, ca.vertcat(x1, x2), [0.5, 0.5], quick=True)
    assert {found[name].verdict for name in ABOUT_POINTS} == {UNKNOWN}
    assert found["A5"].how == f"Q(0) is empty: no point satisfies {names}"
    assert found["S-start"].verdict == VIOLATED
    assert f"no point satisfies {names}" in found["S-start"].how
    assert "is empty" in found["step bound"].statement


def test_of_the_points_of_a_set_that_may_be_empty_nothing_holds():
    """|(x1, x2)| >= 2 and x1 + x2 + sqrt(1 + x1^2) + ... <= 0 on the unit square: no proof knows that no point is left."""
    wave = ca.sin(3 * x1) * ca.cos(2 * x2) - 2 + ca.fabs(x1) / 1000
    found = decided({"wave": wave, "wall": x1}, ca.vertcat(x1, x2), [0.5, 0.5], quick=True)
    assert HOLDS not in {found[name].verdict for name in ABOUT_POINTS}


def test_a_start_outside_of_a_set_that_has_points_changes_nothing_of_what_is_said_of_these():
    for rows in ({"a": x1 - 1}, {"a": x1 - 0.5 - 2**-20, "b": 0.5 + 2**-19 - x1}, {"a": ca.norm_2(ca.vertcat(x1, x2)) - 2}):
        inside, outside = (
            decided(rows, ca.vertcat(x1, x2), q0, quick=True) for q0 in ([0.5 + 1.5 * 2**-20 if "b" in rows else 3, 0], [0.4, 0])
        )
        assert (inside["S-start"].verdict, outside["S-start"].verdict) == (HOLDS, VIOLATED)
        for name in ABOUT_POINTS:
            if "S-start" not in getattr(inside[name], "rests_on", ()):
                assert outside[name].verdict == inside[name].verdict, name


@pytest.mark.parametrize("seed", range(COUNT))
def test_what_holds_of_random_planes_and_discs_is_said_of_a_set_with_points(seed):
    """Q(0) on a grid: where no point of it is admissible by far, no sentence about its points holds."""
    rng = np.random.default_rng([32, seed])
    q = ca.vertcat(x1, x2)
    rows = {}
    for k in range(int(rng.integers(1, 5))):
        centre, size = rng.uniform(-1, 1, 2), rng.uniform(0.2, 2)
        normal = rng.normal(size=2)
        kinds = (
            ca.norm_2(q - ca.DM(centre)) - size,
            ca.dot(ca.DM(normal), q) - size,
            size - rng.uniform(0.1, 1) * ca.sumsqr(q),
            ca.fmin(x1, x2) - centre[0],
        )
        rows[f"c{k}"] = kinds[int(rng.integers(4))]
    rows |= {"left": x1 + 1.5, "right": 1.5 - x1, "low": x2 + 1.5, "up": 1.5 - x2}
    points = np.stack(np.meshgrid(np.linspace(-1.6, 1.6, 321), np.linspace(-1.6, 1.6, 321)), -1).reshape(-1, 2)
    least = np.array(ca.Function("g", [q], [ca.vertcat(*rows.values())])(points.T)).min(axis=0)
    found = decided(rows, q, [0.1, 0.2], width=1.6, quick=True)
    verdicts = {found[name].verdict for name in ABOUT_POINTS}
    if least.max() < -0.05:  # |g_i'| <= 5, and the points are 0.01 apart
        assert HOLDS not in verdicts
        assert SAMPLED not in verdicts
    elif least.max() > 0.05:
        assert "may be empty" not in found["step bound"].statement
        assert "is empty" not in found["step bound"].statement


def test_of_parameters_at_which_the_set_is_empty_nothing_holds():
    p = ca.SX.sym("p")
    for rows, x0, verdict in (
        ({"a": x1 - p - 1, "b": -x1 - p}, 0, UNKNOWN),
        ({"a": x1 - p}, 0, HOLDS),
        ({"a": x1 - p}, 2, HOLDS),
    ):
        model = SweepingProcess(q=x1, f=[0], constraints=rows, q0=[x0], t_end=1, step=0.1, parameters={p: 1})
        report = nsmodel_check(model, parameters={p: (0.5, 1)}, quick=True)
        assert {item.verdict for item in report.consequences if item.name in ("prox-regular", "K_L", "step bound")} <= {verdict}
        assert report["A5"].verdict == verdict
        assert report["S-start"].verdict == (HOLDS if x0 == 2 else VIOLATED)


def test_two_points_on_a_line_of_which_another_constraint_asks():
    """|q_1 - q_0| >= 1 alone shares a state with one that reads both: the points that are forbidden have one coordinate."""
    q = ca.SX.sym("q", 2)
    gaps = {"apart": (q[1] - q[0]) ** 2 - 1, "sum": 5 - q[0] - q[1]}
    report = nsmodel.check(SweepingProcess(q=q, f=[1, 0], constraints=gaps, q0=[0, 1.5], t_end=1, step=0.1), quick=True)
    assert {report[id].verdict for id in ("S-convex", "A0", "A1", "A2", "A3", "A4")} == {HOLDS}
