"""Growth on unbounded sets, monotone functions of one direction, empty and thin sets: verdicts, bounds by brute force."""

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import MonotoneInclusion, check
from nsmodel.proof.asymptotics import asymptotic_orders, polynomial_order
from nsmodel.proof.growth import growth_bound
from nsmodel.proof.monotone import decide_monotonicity
from nsmodel.proof.sectors import sector

z, x = ca.SX.sym("z"), ca.SX.sym("x", 2)
SQUARE = ca.sumsqr(x)
CALM = [
    2 * z**2 / (1 + z**2), z / (1 + ca.fabs(z)), z * ca.tanh(z), z * ca.cos(z) ** 2, ca.floor(z + 0.5), z * ca.exp(-(z**2)),
    ca.sign(z) * ca.sqrt(ca.fabs(z)), ca.log(1 + ca.exp(z)), ca.log(1 + z**2), z**3 / (1 + z**2), z / (1 + ca.exp(-z)),
]  # fmt: skip
STEEP = [
    z * ca.fabs(z), ca.sinh(z), ca.exp(z) - 1, ca.cosh(z), z * ca.sqrt(1 + z**2), ca.fmax(z, 0) ** 3, z * ca.log(1 + z**2),
]  # fmt: skip
NAMES = ["M-T", "M-C", "M-A1", "M-A2", "M-A3", "M-24"]


def report(field, x=z, x0=None, **more):
    start = [0.3] * x.numel() if x0 is None else x0
    return check(MonotoneInclusion(x=x, field=field, x0=start, t_end=1, step=0.1, **more), runs=[])


@pytest.mark.parametrize("h", CALM, ids=str)
def test_what_grows_at_most_linearly(h):
    found = report(-h)["M-A2"]
    assert found.verdict == "holds"
    assert found.scope is None
    points = np.concatenate([-np.geomspace(1e-6, 500, 400), np.geomspace(1e-6, 500, 400)])
    values = np.abs(np.array(ca.Function("h", [z], [h])(points)).ravel())
    assert (values <= found.value["a_1"] + found.value["a_2"] * np.abs(points) + 1e-9).all()


@pytest.mark.parametrize("h", STEEP, ids=str)
def test_what_grows_faster(h):
    assert report(-h)["M-A2"].verdict == "violated"


def test_along_a_curve_in_a_curved_set():
    C = {"bowl": x[1] + 3.5 - x[0] ** 4 / 4}
    assert report(ca.vertcat(-(x[0] ** 3), -x[1]), x, constraints=C)["M-A2"].verdict != "violated"  # |x_0|^3 <= c |x| there
    assert report(ca.vertcat(-(x[0] ** 5), -x[1]), x, constraints=C)["M-A2"].verdict == "violated"


@pytest.mark.parametrize("h", [ca.sign(z) * ca.fabs(z) ** (1 / 3), z / (1 + z**2), z * ca.exp(-(z**2)), ca.atan(z)], ids=str)
def test_no_alpha_exists(h):
    assert report(-h)["M-A3"].verdict == "violated"


@pytest.mark.parametrize(
    "h", [-0.5 * z / (1 + ca.fabs(z)), -0.14 * ca.floor(z + 0.5), -ca.cos(z), z * ca.sqrt(1 + z**2)], ids=str
)
def test_drawn_back(h):
    found = report(-z - h)["M-A3"]
    points = np.linspace(-1e3, 1e3, 4001)
    values = points * np.array(ca.Function("v", [z], [-z - h])(points)).ravel()
    assert found.verdict == "holds"
    assert (values <= -found.value["alpha"] * points**2 + found.value["beta"] + 1e-9).all()


MONOTONE = [ca.sign(z) * (1 + z**2), ca.sign(z) * ca.sqrt(ca.fabs(z)), ca.sign(z) * z**2, ca.sign(z) + ca.sign(z - 1)]


@pytest.mark.parametrize("S", MONOTONE, ids=str)
def test_monotone_functions_of_one_direction(S):
    a = ca.DM([1, -2])
    assert report(-z, operator=S)["M-T"].verdict == "holds"
    assert report(-x, x, operator=a * ca.substitute(S, z, a.T @ x))["M-T"].verdict == "holds"
    assert report(-z, operator=-S)["M-T"].verdict == "violated"
    assert report(-x, x, operator=ca.DM([1, 1]) * ca.substitute(S, z, a.T @ x))["M-T"].verdict == "violated"


@pytest.mark.parametrize("S", [ca.if_else(z > 0, -1, 1), ca.if_else(z > 0, 1, -1), ca.floor(z), 2 * ca.sign(z) - ca.sign(2 * z)])
def test_steps_that_are_no_sets_or_go_down(S):
    assert report(-z, operator=S)["M-T"].verdict == "violated"


EMPTY = [{"a": x[0] - 1, "b": -1 - x[0]}, {"a": -1 - SQUARE}, {"a": 1 - SQUARE, "b": 1 - ca.sumsqr(x - 3)}]
THIN = [
    {"a": -ca.fabs(x[0])},
    {"a": 1 - SQUARE, "b": x[0] - 1},
    {"a": x[0] - 1, "b": 1 - x[0]},
    {"a": -ca.exp(x[0])},
    {"a": -SQUARE},
]


@pytest.mark.parametrize("rows", [*EMPTY, *THIN], ids=str)
def test_empty_and_thin_sets(rows):
    found = report(ca.vertcat(ca.sin(x[1]), -x[0]), x, constraints=rows)
    assert found["M-C"].verdict == "violated"
    if any(rows is other for other in EMPTY):
        assert "empty" in found["M-C"].how
        assert all(found[id].verdict == "unknown" for id in NAMES if id != "M-C")


def test_one_branch_of_a_hyperbola():
    for rows, verdict in (({"h": x[0] * x[1] - 1, "p": x[0]}, "holds"), ({"h": x[0] * x[1] - 1}, "violated")):
        assert report(-x, x, constraints=rows)["M-C"].verdict == verdict
    assert report(-x, x, constraints={"h": x[0] * x[1], "p": x[0]})["M-C"].verdict != "holds"


def test_a_jump_is_told_from_a_steep_slope():
    found = report(1e-9 * ca.sign(z), x0=[0.0])["M-A1"]
    assert found.verdict == "violated"
    assert found.witness["below"] != found.witness["above"]
    assert report(ca.tanh(1e9 * z), x0=[0.0])["M-A1"].verdict == "holds"


def test_bounds_are_bounds():
    """Orders, lines, monotony and growth of random compositions against their values."""
    rng = np.random.default_rng(0)
    for _ in range(share(60, 15)):
        h, other = (CALM + STEEP)[rng.integers(18)], (CALM + STEEP)[rng.integers(18)]
        h = rng.normal() * ca.substitute(h, z, round(rng.normal(), 2) * z + 0.5) + rng.choice([0, 1]) * other
        f = ca.Function("h", [z], [h])
        points = np.concatenate([-np.geomspace(1e-3, 300, 300)[::-1], np.geomspace(1e-3, 300, 300)])
        values = np.array(f(points)).ravel()
        size = 1e-9 * (1 + np.abs(values))
        (order,) = asymptotic_orders(h, z, [polynomial_order([0, 1], 4)], 4)
        far = points >= 16
        if order is not None:
            scale = points[far] ** float(order.p) * np.log(points[far]) ** float(order.l)
            assert (values[far] >= order.low * scale - size[far]).all()
            assert (values[far] <= order.high * scale + size[far]).all()
        lines = sector(h, z, -np.inf, np.inf, 4)
        if lines is not None and np.isfinite(lines.high):
            assert (points * values <= lines.high * points**2 + lines.reach * np.abs(points) + size * np.abs(points)).all()
        if decide_monotonicity(h, z, -np.inf, np.inf).nondecreasing:
            assert (np.diff(values) >= -size[1:]).all()
        powers = growth_bound(h, z, np.array([-np.inf]), np.array([np.inf]))
        if powers is not None:
            bound = sum(p.size * (p.alpha * np.abs(points) + p.gamma) ** float(p.p) for p in powers)
            assert (np.abs(values) <= bound + size).all()
