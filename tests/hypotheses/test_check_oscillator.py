"""Hypotheses of oscillators under dry friction: closed forms, and brute force against everything that is said to hold."""

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

import nsmodel
from nsmodel import FrictionOscillator
from nsmodel.hypotheses.region import region_of
from nsmodel.models.friction_oscillator import check as oscillator
from nsmodel.models.friction_oscillator.rest_points import friction_radius
from nsmodel.proof import polynomial
from nsmodel.proof import polynomial as polynomial_signs
from nsmodel.proof.convex import rules

IDS = ["O-theta", "O-g", "O-dry", "O-steps"]
LEAST = "least eigenvalue of D2 g"


def check(model, runs=(), quick=False, **parameters):
    model = model.bind(parameters)
    findings, consequences = oscillator.check(model, region_of(model, runs), runs, quick)
    assert [finding.id for finding in findings] == IDS
    return {finding.id: finding for finding in findings}, {consequence.name: consequence for consequence in consequences}


def made(**arguments):
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    given = {"x": x, "s": s, "friction": s, "x0": [0.5, 0.25], "t_end": 1, "step": 0.1}
    return FrictionOscillator(**{**given, **{key: item(x, s) if callable(item) else item for key, item in arguments.items()}})


def law(theta):
    """The finding O-theta of one element."""
    return check(made(friction=lambda x, s: theta(s)))[0]["O-theta"]


# -- friction laws -----------------------------------------------------------------------------------------------------

LAWS = {
    "dry": (lambda s: 0.3 * s, "holds", 0.3, 0.0),
    "dry and viscous": (lambda s: s + s**2, "holds", 1.0, 2.0),
    "cubic": (lambda s: s**3, "holds", 0.0, 0.0),
    "exponential": (lambda s: ca.exp(s) - 1, "holds", 1.0, 1.0),
    "root of a square": (lambda s: ca.sqrt(1 + s**2), "holds", 0.0, None),
    "wave on a parabola": (lambda s: s + 0.1 * ca.sin(s) + s**2, "holds", 1.1, None),
    "power": (lambda s: 2 * ca.fabs(s) + s**1.5, "holds", 2.0, None),
    "entropy": (lambda s: s * ca.log(1 + s), "holds", 0.0, None),
    "Huber": (lambda s: ca.if_else(s <= 1, s**2 / 2, s - 0.5), "holds", 0.0, 0.0),
    "late": (lambda s: s + ca.fmax(s - 1, 0) ** 2, "holds", 1.0, 0.0),
    "late and steep": (lambda s: s + ca.fmax(ca.exp(s) - 2, 0) ** 2, "holds", 1.0, None),
    "written with fabs": (lambda s: ca.fabs(s) + ca.fmax(s, 0), "holds", 2.0, 0.0),
    "kink at 1": (lambda s: s + ca.fabs(s - 1), "violated", None, None),
    "kink at an irrational": (lambda s: ca.fmax(2 * s, s**2), "violated", None, None),
    "saturated": (lambda s: ca.fmin(s, 1), "violated", None, None),
    "jump": (lambda s: ca.if_else(s < 1, s, 2 * s), "violated", None, None),
    "falls": (lambda s: s - s**2, "violated", -np.inf, -2.0),
    "falls late": (lambda s: s - 1e-3 * s**2, "violated", -np.inf, -2e-3),
    "wave": (lambda s: s**3 - 3 * s**2 + 4 * s, "violated", 1.0, -6.0),
    "logarithm": (lambda s: ca.log1p(s), "violated", None, -1.0),
    "Stribeck": (lambda s: s + 1 - ca.exp(-s), "violated", None, -1.0),
    "root": (lambda s: ca.sqrt(s), "violated", None, None),
    "ends": (lambda s: -ca.log(1 - s), "violated", None, None),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_friction_law_is_decided_for_every_speed(name):
    theta, verdict, slope, curvature = LAWS[name]
    found = law(theta)
    assert found.verdict == verdict
    if slope is not None:
        assert found.value["min theta'"] == pytest.approx(slope, rel=1e-12, abs=1e-12)
    if curvature is not None and "min theta''" in found.value:
        assert found.value["min theta''"] == pytest.approx(curvature, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(("theta", "place"), [(lambda s: s - s**2, 0.5), (lambda s: s**2 - s**3, 2 / 3)])
def test_the_place_from_which_theta_decreases_is_the_root_of_its_slope(theta, place):
    found = law(theta)
    assert found.witness["from"] == pytest.approx(place)
    assert found.witness["s"] >= place


@pytest.mark.parametrize(
    ("theta", "place"),
    [
        (lambda s: s + ca.fabs(s - 0.7), 0.7),
        (lambda s: ca.fmax(s, s**2 - 2), 2.0),
        (lambda s: ca.fmax(s, ca.exp(s) - 2), 1.146193),
    ],
)
def test_a_kink_is_found_where_it_is(theta, place):
    found = law(theta)
    assert found.verdict == "violated"
    assert found.witness["s"] == pytest.approx(place, rel=1e-6)


def test_a_cancellation_that_is_rounding_is_no_violation():
    # theta'' = 6 (s - 0.1)(s - 0.7 / 7) (s - 1)^2 by its coefficients: rounded, it is not >= 0 between the first two.
    assert law(lambda s: s + s**4 / 12 - 0.1 * s**3 / 3 + 0.1**2 * s**2 / 2).verdict in ("holds", "sampled")
    assert law(lambda s: 0.1 * s - 1e-9 * s**2).verdict == "violated"


@pytest.mark.parametrize("unit", [1e-7, 1.0, 1e7])
def test_the_verdict_does_not_depend_on_the_unit_of_speed(unit):
    assert law(lambda s: unit * s - 1e-14 * (unit * s) ** 2).verdict == "violated"
    assert law(lambda s: unit * s + 1e-14 * (unit * s) ** 2).verdict == "holds"


@pytest.mark.parametrize("law_of", [lambda s: s + ca.sign(s - 1) ** 2, lambda s: ca.if_else(s == 1, 5, s)])
def test_a_law_with_an_isolated_value_is_not_proved(law_of):
    assert law(law_of).verdict != "holds"


def test_random_laws_that_hold_are_convex_nondecreasing_and_smooth_at_samples():
    rng, held = np.random.default_rng(3), 0
    s = ca.SX.sym("s")
    fine, coarse = np.linspace(0, 3, 3001), np.linspace(0, 200, 501)
    for _ in range(count := share(100, 30)):
        a, b, c, d = np.round(rng.normal(size=4), 2)
        pieces = [
            a * s, b * s**2, c * s**3, d * ca.fmax(s - abs(b), 0) ** int(rng.integers(1, 4)), a * ca.exp(-abs(b) * s),
            c * ca.log1p(abs(d) * s), b * ca.sqrt(1 + s**2), d * ca.fabs(s - abs(a)), a * s * ca.fabs(s),
            c * ca.fmin(s, abs(d)) ** 2,
        ]  # fmt: skip
        theta = abs(a) * s + sum(pieces[i] for i in rng.choice(len(pieces), 2, replace=False))
        found = law(lambda v, theta=theta: ca.substitute(theta, s, v))
        if found.verdict != "holds":
            continue
        held += 1
        f = ca.Function("theta", [s], [theta])
        for grid in (fine, coarse):
            values = np.array(f(grid[None, :])).ravel()
            slopes, rounding = np.diff(values) / np.diff(grid), 1e-13 * (1 + np.abs(values).max()) / grid[1]
            assert slopes.min() >= -rounding, theta
            assert np.diff(slopes).min() >= -2 * rounding, theta
            if grid is fine:  # a kink would be a jump of the slope between neighbours
                assert np.diff(slopes).max() < 0.05 * (1 + np.abs(slopes).max()), theta
    assert held > 0.14 * count


def test_signs_on_a_half_line_agree_with_a_fine_grid():
    rng, negative = np.random.default_rng(0), 0
    for _ in range(300):
        roots, powers = rng.integers(-3, 5, 3), rng.integers(1, 3, 3)
        p = np.poly1d([float(rng.choice([-1, 1]))])
        for root, power in zip(roots, powers, strict=True):
            p *= np.poly1d([1.0, -float(root)]) ** int(power)
        c = [polynomial.Fraction(round(float(number))) for number in p.coeffs[::-1]]
        point = polynomial_signs.negative_point(c)
        exact = [polynomial_signs.evaluate_at(c, polynomial.Fraction(k, 10)) for k in range(120)]
        assert (point is not None) == (min(exact) < 0)
        if point is not None:
            negative += 1
            assert point >= 0
            assert polynomial_signs.evaluate_at(c, point) < 0
    assert 50 < negative < 250


def test_damping_belongs_to_the_monotone_operator():
    good = check(made(damping=[[0.1, 2.0], [-2.0, 0.0]]))[0]["O-theta"]
    assert good.verdict == "holds"
    assert good.value["least eigenvalue of the damping"] == 0
    M = np.array([[0.1, 1.0], [0.0, 0.1]])
    bad = check(made(damping=M))[0]["O-theta"]
    assert bad.verdict == "violated"
    v = np.array(bad.witness["vector"])
    assert v @ M @ v == pytest.approx(-0.4)


# -- potentials --------------------------------------------------------------------------------------------------------

POTENTIALS = {
    "spring": (lambda x: ca.sumsqr(x) / 2, "holds", 0.0),
    "dead band": (lambda x: ca.fmax(ca.fabs(x[0]) - 1, 0) + x[1] ** 2, "holds", 0.0),
    "wall": (lambda x: 3 * ca.fabs(x[0]) + ca.fmax(x[1], 0), "holds", 0.0),
    "chain": (lambda x: (x[0] - x[1]) ** 2 + ca.fabs(x[0] - x[1]) - (x[0] - x[1]) / 2, "holds", 0.0),
    "tilted kink": (lambda x: ca.fabs(x[0] - x[1]) - (x[0] - x[1]), "holds", 0.0),
    "quartic": (lambda x: x[0] ** 4 + x[1] ** 2 - x[0], "holds", -3 / 4 * 4 ** (-1 / 3)),
    "norm": (lambda x: ca.norm_2(x) + x[0] / 2, "holds", 0.0),
    "log-cosh": (lambda x: ca.log(ca.cosh(x[0])) + x[1] ** 2, "holds", 0.0),
    "soft plus": (lambda x: ca.log1p(ca.exp(x[0])) + ca.exp(-x[1]), "holds", 0.0),
    "wavy bowl": (lambda x: ca.sumsqr(x) + 0.1 * ca.cos(x[0]), "holds", 0.1),
    "three pieces": (lambda x: ca.fmax(ca.fmax(-x[0], 2 * x[0] - 1), 0.5 * x[0]) + x[1] ** 2, "holds", 0.0),
    "ridge": (lambda x: (x[0] + 2 * x[1]) ** 2 + ca.cos(x[0] + 2 * x[1]), "holds", 1.0),
    "quartic and tilt": (lambda x: (x[0] + x[1]) ** 4 + ca.fmax(x[0] + x[1], -x[1]), "holds", -3 / 4 * 4 ** (-1 / 3)),
    "cliff": (lambda x: x[0] ** 3 + x[1] ** 2, "violated", -np.inf),
    "saddle": (lambda x: x[0] ** 2 - x[1] ** 2, "violated", None),
    "weight": (lambda x: x[0] ** 2 + x[1], "violated", -np.inf),
    "kink too weak": (lambda x: ca.fabs(x[0] - x[1]) - 1.5 * (x[0] - x[1]), "violated", -np.inf),
    "double well": (lambda x: x[0] ** 4 - x[0] ** 2 + x[1] ** 2, "violated", None),
}


@pytest.mark.parametrize("name", POTENTIALS)
def test_a_potential_is_decided_with_its_infimum(name):
    g, verdict, least = POTENTIALS[name]
    model = made(potential=lambda x, s: g(x))
    found = check(model)[0]["O-g"]
    assert found.verdict == verdict
    if least is not None:
        assert found.value.get("inf g", found.value.get("least g met")) == pytest.approx(least, abs=1e-7)
        assert found.value.get("lower bound of g", -np.inf) <= least
    if "vector" in found.witness:
        x = ca.SX.sym("x", 2)
        H = np.array(
            ca.Function("H", [x], [ca.hessian(g(x), x)[0]])(np.zeros(2) if found.witness["x"] == "any" else found.witness["x"])
        )
        v = np.array(found.witness["vector"])
        assert v @ H @ v == pytest.approx(found.value[LEAST], rel=1e-6)
        assert found.value[LEAST] < 0
    if "direction" in found.witness:
        x = ca.SX.sym("x", 2)
        f = ca.Function("g", [x], [g(x)])
        assert float(f(1e6 * np.array(found.witness["direction"]))) < -1e5


def test_an_indefinite_quadratic_gives_its_eigenvector():
    K = np.array([[1.0, 2.0], [2.0, 1.0]])
    found = check(made(potential=lambda x, s: ca.bilin(ca.DM(K), x, x) / 2))[0]["O-g"]
    assert found.verdict == "violated"
    assert found.value[LEAST] == pytest.approx(-1)
    assert np.abs(found.witness["vector"]) == pytest.approx(np.full(2, np.sqrt(0.5)))


def test_a_quadratic_that_is_psd_but_for_rounding_is_not_violated():
    K = np.array([[0.1 * 3, 0.3], [0.3, 0.3 - 1e-16]])
    found = check(made(potential=lambda x, s: ca.bilin(ca.DM(K), x, x) / 2))[0]["O-g"]
    assert found.verdict in ("holds", "sampled")
    assert abs(found.value[LEAST]) < 1e-15


def test_a_weight_rests_on_a_floor():
    found, follows = check(made(potential=lambda x, s: x[0] ** 2 + 9.81 * x[1], constraints=lambda x, s: {"floor": x[1] + 2}))
    assert found["O-g"].verdict == "holds"
    assert found["O-g"].value["inf g"] == pytest.approx(-2 * 9.81, abs=1e-6)
    assert follows["convergence"].verdict == "holds"


def test_a_weight_rests_in_a_bowl():
    bowl = made(potential=lambda x, s: 9.81 * x[1], constraints=lambda x, s: {"bowl": x[1] - x[0] ** 2 - x[0]})
    found = check(bowl)[0]["O-g"]
    assert found.verdict == "holds"
    assert found.value["least g met"] == pytest.approx(-9.81 / 4, abs=1e-6)


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        (lambda x: {"left": x[0] - 0.5, "right": 0.5 - x[0]}, ["left", "right"]),
        (lambda x: {"a": x[0] + x[1] - 1, "b": 1 - x[0], "c": -x[1]}, ["a", "b", "c"]),
    ],
)
def test_constraints_without_interior_are_violated_with_weights(rows, names):
    model = made(potential=lambda x, s: ca.sumsqr(x), constraints=lambda x, s: rows(x))
    found = check(model)[0]["O-g"]
    assert found.verdict == "violated"
    assert found.witness["constraints"] == names
    x = ca.SX.sym("x", 2)
    total = sum(w * rows(x)[name] for w, name in zip(found.witness["weights"], names, strict=True))
    values = np.array(ca.Function("total", [x], [total])(np.random.default_rng(0).normal(size=(2, 50)))).ravel()
    assert min(found.witness["weights"]) > 0
    assert values.max() <= 1e-12


def test_the_domain_in_the_potential_counts():
    wall = made(potential=lambda x, s: ca.if_else(x[0] >= 0, 9.81 * x[0] + x[1] ** 2, ca.inf))
    assert check(wall)[0]["O-g"].verdict == "holds"
    flat = made(potential=lambda x, s: ca.if_else(x[0] == 0.5, x[1] ** 2, ca.inf))
    assert check(flat)[0]["O-g"].verdict == "violated"


def random_potential(x, rng):
    """Sums of compositions that may or may not be convex."""
    a, b = (ca.DM(np.round(rng.normal(size=2), 1)) for _ in range(2))
    u, v = ca.dot(a, x) + round(float(rng.normal()), 1), ca.dot(b, x)
    atoms = [
        u**2, ca.fabs(u), ca.fmax(u, v), ca.exp(u / 3), u**4, ca.norm_2(x - a), ca.sqrt(1 + u**2), ca.log(1 + ca.exp(v)), u * v,
        ca.fabs(u) ** 3, ca.fmax(u, 0) ** 2, ca.cosh(v / 4), u**3, ca.fmin(u, v), ca.cos(u), 1 / (1 + v**2), ca.tanh(u),
        ca.fmax(u**2, v),
    ]  # fmt: skip
    return sum(float(rng.choice([1, 1, 2, 0.5, -0.3])) * atoms[i] for i in rng.choice(len(atoms), int(rng.integers(1, 4))))


@pytest.mark.long
def test_no_pair_of_points_contradicts_a_potential_that_holds():
    rng, held = np.random.default_rng(5), 0
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    for k in range(count := share(90, 24)):
        g = random_potential(x, rng)
        try:
            model = FrictionOscillator(x=x, s=s, friction=s, potential=g, x0=[0.5, 0.25], t_end=1, step=0.1)
        except nsmodel.errors.ModelError:
            continue  # a concave kink is refused when the model is declared
        found = check(model, quick=True)[0]["O-g"]
        if found.verdict != "holds":
            continue
        held += 1
        local = found.scope is not None
        region = region_of(model, ())
        points = rng.uniform(region.lower, region.upper, (400, 2)) if local else rng.normal(size=(400, 2)) * 5
        f = ca.Function("g", [x], [g])
        p, q, middle = (np.array(f(part.T)).ravel() for part in (points[::2], points[1::2], (points[::2] + points[1::2]) / 2))
        assert (middle <= (p + q) / 2 + 1e-9 * (1 + np.abs(p) + np.abs(q))).all(), (k, g, found)
        assert p.min() >= found.value.get("lower bound of g", -np.inf) - 1e-9 * (1 + abs(p.min()))
    assert held > 2 * count / 9


@pytest.mark.parametrize("sign", [1, -1])
def test_the_rules_of_convex_functions_never_call_a_nonconvex_function_convex(sign):
    rng, proved = np.random.default_rng(9 + sign), 0
    x = ca.SX.sym("x", 2)
    for _ in range(count := share(200, 60)):
        g = random_potential(x, rng)
        inner = rng.choice(["", "square", "exp", "root"])
        g = {"": g, "square": g**2, "exp": ca.exp(g / 50), "root": ca.sqrt(1 + g**2)}[str(inner)]
        (shape,) = rules.global_curvatures(g, x)
        if not (shape.convex if sign > 0 else shape.concave):
            continue
        proved += 1
        points = rng.normal(size=(300, 2)) * 3
        f = ca.Function("g", [x], [sign * g])
        p, q, middle = (np.array(f(part.T)).ravel() for part in (points[::2], points[1::2], (points[::2] + points[1::2]) / 2))
        assert (middle <= (p + q) / 2 + 1e-9 * (1 + np.abs(p) + np.abs(q))).all(), g
    assert proved > (0.1 if sign > 0 else 0.01) * count


# -- dry friction ------------------------------------------------------------------------------------------------------


def test_the_radius_of_A0_is_the_least_of_its_support_function():
    H1, H2 = np.array([[1.0, 0.0]]), np.array([[1.0, 2.0], [0.0, 1.0]])
    model = made(friction=lambda x, s: {"a": (H1, 2 * s), "b": (H2, 0.5 * s + s**2)})
    found = check(model)[0]["O-dry"]
    angle = np.linspace(0, np.pi, 200001)
    d = np.stack([np.cos(angle), np.sin(angle)])
    sigma = 2 * np.abs(H1 @ d)[0] + 0.5 * np.linalg.norm(H2 @ d, axis=0)
    assert found.verdict == "holds"
    assert found.value["radius of A(0)"] == pytest.approx(sigma.min(), rel=1e-6)
    assert 0 < found.value["radius of A(0)"] <= found.value.get("sigma attained", np.inf) * (1 + 1e-15)


def test_a_direction_without_friction_is_named():
    H = np.array([[1.0, 2.0]])
    for friction in ({"a": (H, ca.SX.sym("s"))}, None):
        s = ca.symvar(friction["a"][1])[0] if friction else ca.SX.sym("s")
        model = made(friction=friction, s=s)
        found, follows = check(model)
        d = np.array(found["O-dry"].witness["direction"])
        assert found["O-dry"].verdict == "violated"
        assert np.linalg.norm(d) == pytest.approx(1)
        if friction:
            assert H @ d == pytest.approx([0])
        assert follows["convergence"].verdict == "unknown"
        assert follows["energy decay"].verdict == "holds"


def test_viscous_friction_is_not_dry():
    found = check(made(friction=lambda x, s: s**2))[0]
    assert found["O-theta"].verdict == "holds"
    assert found["O-dry"].verdict == "violated"
    assert found["O-dry"].value["theta'(0)"] == 0


# -- steps -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "verdict", "n"),
    [
        ({"step": 0.1, "t_end": 1.05}, "holds", None),
        ({"step": None, "t_end": None, "steps": [0.1, 0.1, 0.2, 0.3]}, "holds", None),
        ({"step": None, "t_end": None, "steps": [0.1, 0.2, 0.15, 0.1]}, "violated", 2),
        ({"step": None}, "unknown", None),
    ],
)
def test_steps_must_not_decrease(arguments, verdict, n):
    found = check(made(**arguments))[0]["O-steps"]
    assert found.verdict == verdict
    assert found.witness.get("n") == n


def test_a_run_s_own_grid_counts_and_a_last_step_cut_by_the_end_does_not():
    model = made(potential=lambda x, s: ca.sumsqr(x))
    cut = nsmodel.simulate(model, step=0.3, t_end=1)
    found = check(model, [cut])[0]["O-steps"]
    assert found.verdict == "holds"
    assert "ends" in found.how
    falling = nsmodel.simulate(model, steps=[0.3, 0.2, 0.2])
    assert check(model, [cut, falling])[0]["O-steps"].witness["n"] == 1


# -- the paper's examples, and what follows ----------------------------------------------------------------------------


@pytest.mark.parametrize("stem", ["cabot_4_1", "cabot_4_2", "cabot_4_3", "friction_oscillator"])
def test_the_hypotheses_of_the_paper_s_examples_hold(load_case, run_case, stem):
    for runs in ((), [run_case(stem)]):
        found, follows = check(load_case(stem), runs)
        assert {finding.verdict for finding in found.values()} == {"holds"}
        assert follows["convergence"].verdict == "holds"
        assert "Corollary 4.2" in follows["convergence"].source


@pytest.mark.parametrize(("a", "b"), [(0.02, 0.1), (1.0, 4.0), (0.3, 0.7)])
def test_example_4_1_stops_in_a_over_b(load_case, a, b):
    _, follows = check(load_case("cabot_4_1"), alpha=a, beta=b)
    value = follows["rest points"].value
    assert value["largest x_inf"] == pytest.approx(a / b, rel=1e-15)
    assert value["least x_inf"] == -value["largest x_inf"]
    assert "finite from every start" not in follows


@pytest.mark.parametrize(("b", "end", "finite"), [(0.1, 0.0, True), (0.02, np.inf, True), (0.03, np.inf, False)])
def test_example_4_2_stops_at_zero_or_anywhere(load_case, b, end, finite):
    _, follows = check(load_case("cabot_4_2"), beta=b)
    assert ("rest points" in follows) == bool(np.isfinite(end))  # of the whole line nothing is said
    if np.isfinite(end):
        value = follows["rest points"].value
        assert value["largest x_inf"] == -value["least x_inf"] == pytest.approx(end, abs=1e-9)
    assert ("finite from every start" in follows) == finite


@pytest.mark.parametrize("steep", [0.5, 5.0, 500.0])
def test_zero_is_on_the_boundary_where_a_slope_comes_up_to_the_radius(steep):
    """Of smooth potentials at the ends of the rest points; beyond a kink, and where no slope is as large, it is interior."""
    q, s = ca.SX.sym("q"), ca.SX.sym("s")
    smooth = [steep * ca.cosh(q), 2 * steep * q**2 + q**4, steep * (ca.exp(q) - q), (1 + steep) * ca.sqrt(1 + q**2)]
    kinked = [g + 2 * ca.fabs(q) for g in smooth[:2]] + [ca.sqrt(1 + (steep * q) ** 2) / (2 * steep)]
    for finite, potentials in ((False, smooth), (True, kinked)):
        for g in potentials:
            model = FrictionOscillator(x=q, s=s, friction=[s], potential=g, x0=[0.3], v0=[0], t_end=1.0, step=0.01)
            follows = {item.name for item in nsmodel.check(model, runs=[], quick=True).consequences}
            assert ("finite from every start" in follows) == finite, g


def test_a_slope_jumps_at_walls_and_not_where_it_is_steep():
    """At a table 0 is interior to A(0) + dg, unless bodies rest above it, too; a smooth slope does not jump, however steep."""
    q, s = ca.SX.sym("q"), ca.SX.sym("s")
    tables = [(True, 0.5, 0.0), (True, 2.0, 0.0), (True, 2.0, 0.1), (False, 0.5, 0.1)]
    scenes = [(finite, weight * q + bend * ca.exp(q), 0.3, {"table": q}) for finite, weight, bend in tables]
    scenes += [(False, -ca.log(q) - ca.log(width - q), width / 2, {}) for width in (2e-3, 2e-6, 2e-7)]
    scenes += [(False, 2 * ca.sqrt(q**2 + width**2), 0.3, {}) for width in (1e-6, 1e-9, 1e-12)]
    for finite, g, x0, walls in scenes:
        model = FrictionOscillator(x=q, s=s, friction=[s], potential=g, constraints=walls, x0=[x0], v0=[0], t_end=1.0, step=0.01)
        follows = {item.name for item in nsmodel.check(model, runs=[], quick=True).consequences}
        assert ("finite from every start" in follows) == finite, g


def test_rest_points_of_a_quartic_and_of_a_wall():
    s, q = ca.SX.sym("s"), ca.SX.sym("q")
    model = FrictionOscillator(x=q, s=s, friction=4 * s, potential=q**4, x0=2, t_end=1, step=0.1)
    value = check(model)[1]["rest points"].value
    assert value["largest q_inf"] == pytest.approx(1, rel=1e-9)
    assert value["least q_inf"] == pytest.approx(-1, rel=1e-9)
    # 2 q in [-1, 1] and q >= 0.3: the wall holds the left end.
    walled = FrictionOscillator(x=q, s=s, friction=s, potential=q**2, constraints={"wall": q - 0.3}, x0=2, t_end=1, step=0.1)
    value = check(walled)[1]["rest points"].value
    assert value["least q_inf"] == pytest.approx(0.3)
    assert value["largest q_inf"] == pytest.approx(0.5)


@pytest.mark.parametrize(("wall", "x0", "at"), [(lambda q: q - 0.5, 1.0, 0.5), (lambda q: -0.25 - q / 2, -1.0, -0.5)])
def test_a_wall_that_pushes_more_than_friction_holds(wall, x0, at):
    """|g'| = 0.5 > 0.1 at the wall, whose normal cone has what is missing; the run rests there."""
    s, q = ca.SX.sym("s"), ca.SX.sym("q")
    model = FrictionOscillator(
        x=q, s=s, friction=0.1 * s, potential=q**2 / 2, constraints={"wall": wall(q)}, x0=x0, t_end=8, step=0.02
    )
    run = nsmodel.simulate(model)
    rest = check(model, [run])[1]["rest points"]
    assert rest.verdict == "holds"
    assert rest.value["least q_inf"] == rest.value["largest q_inf"] == at
    assert run.x[-1, 0] == pytest.approx(at, abs=1e-12)


WALLS = {
    "none": (lambda q, a: [], lambda a: (-np.inf, np.inf)),
    "left": (lambda q, a: [q - a], lambda a: (a, np.inf)),
    "right, scaled": (lambda q, a: [0.1 * a - 0.1 * q], lambda a: (-np.inf, a)),
    "channel": (lambda q, a: [q - a, a + 0.5 - q], lambda a: (a, a + 0.5)),
    "interval, curved": (lambda q, a: [0.25 - (q - a) ** 2], lambda a: (a - 0.5, a + 0.5)),
    "left, curved": (lambda q, a: [1 - ca.exp(a - q)], lambda a: (a, np.inf)),
}
SLOPES = {  # g, and the closed set of its slopes at q: the least and the largest one
    "quadratic": (lambda q, c: (q - c) ** 2 / 2, lambda q, c: (q - c, q - c)),
    "quartic": (lambda q, c: (q - c) ** 4 / 4 + q**2, lambda q, c: ((q - c) ** 3 + 2 * q,) * 2),
    "linear": (
        lambda q, c: ca.fmax(q, -2 - q / 512),
        lambda q, c: (np.where(513 * q <= -1024, -1 / 512, 1), np.where(513 * q < -1024, -1 / 512, 1)),
    ),
    "kink": (
        lambda q, c: ca.fabs(q - c) + q**2 / 8,
        lambda q, c: (q / 4 - np.where(q <= c, 1, -1), q / 4 + np.where(q >= c, 1, -1)),
    ),
    "exponential": (lambda q, c: ca.exp(q) - c * q / 8, lambda q, c: (np.exp(q) - c / 8,) * 2),
}  # fmt: skip


@pytest.mark.parametrize("shape", SLOPES)
@pytest.mark.parametrize("wall", WALLS)
def test_every_point_that_can_be_at_rest_is_in_the_interval(wall, shape):
    """{q : 0 in [-r, r] + dg(q) + N(q)} on a grid with the ends of the walls: never empty, all of it in what is printed."""
    rng = np.random.default_rng(7)
    s, q = ca.SX.sym("s"), ca.SX.sym("q")
    for _ in range(4):
        a, c, r = np.round(rng.uniform([-2, 0, 0.05], [2, 3, 2]), 3)
        low, high = WALLS[wall][1](a)
        model = FrictionOscillator(
            x=q, s=s, friction=r * s, potential=SLOPES[shape][0](q, c), x0=np.clip(0.1, low + 0.1, high - 0.1), t_end=1, step=0.1,
            constraints={f"w{i}": row for i, row in enumerate(WALLS[wall][0](q, a))},
        )  # fmt: skip
        found, follows = check(model, quick=True)
        if "rest points" not in follows or follows["rest points"].clause:
            continue
        value = follows["rest points"].value
        least, largest = value.get("least q_inf", -np.inf), value.get("largest q_inf", np.inf)
        points = np.unique(np.concatenate([np.linspace(max(low, -9), min(high, 9), 2001), [low, high, c]]))
        points = points[np.isfinite(points) & (points >= low) & (points <= high)]
        down, up = SLOPES[shape][1](points, c)
        rests = ((down <= r) | (points <= low)) & ((up >= -r) | (points >= high))
        assert least <= largest
        if found["O-g"].verdict == "holds" and rests.any():
            assert least <= points[rests].min() + 1e-12
            assert largest >= points[rests].max() - 1e-12
        inside = rests.any() and np.isfinite([least, largest]).all()
        assert not inside or largest - least <= np.ptp(points[rests]) + 0.02


def test_rest_points_are_looked_for_in_the_box_where_the_potential_is_convex():
    """x^4 - x^2 is convex on [0.9, 2], and increases there by more than friction holds: no limit lies in this box."""
    x = ca.SX.sym("x")
    well = made(x=x, potential=x**4 - x**2, friction=lambda _, s: 0.3 * s, x0=[1.0])
    for box, ends in (((0.5, 2.0), (0.61483, 0.7727)), ((0.65, 0.75), (0.65, 0.75))):  # |4 x^3 - 2 x| <= 0.3
        _, consequences = oscillator.check(well, region_of(well, [], {"x": box}), [], False)
        (rest,) = (item for item in consequences if item.name == "rest points" and item.verdict == "holds")
        assert (rest.value["least x_inf"], rest.value["largest x_inf"]) == pytest.approx(ends, abs=1e-5)
    _, consequences = oscillator.check(well, region_of(well, [], {"x": (0.9, 2)}), [], False)
    assert not any(item.name == "rest points" for item in consequences)


def test_rest_points_of_a_plane_oscillator_are_an_ellipse():
    model = made(friction=lambda x, s: 3 * s, potential=lambda x, s: x[0] ** 2 + 4 * x[1] ** 2)
    value = check(model)[1]["rest points"].value
    assert value == pytest.approx({"semi-axis 1": 3 / 8, "semi-axis 2": 3 / 2})


def test_the_run_of_example_4_1_is_finite_and_that_of_4_3_is_not(load_case, run_case):
    _, follows = check(load_case("cabot_4_1"), [run_case("cabot_4_1")])
    finite = follows["finite convergence"]
    run = run_case("cabot_4_1")
    assert finite.verdict == "holds"
    assert (run.x[int(finite.value["n_0"]) :] == run.x[-1]).all()
    assert finite.value["margin"] == pytest.approx(0.02 - 0.1 * abs(run.x[-1, 0]))
    _, follows = check(load_case("cabot_4_3"), [run_case("cabot_4_3")])
    assert follows["finite convergence"].verdict == "unknown"
    assert "boundary" in follows["finite convergence"].statement
    assert abs(follows["finite convergence"].value["margin"]) < 1e-9
    longer = nsmodel.simulate(load_case("cabot_4_3"), t_end=80)
    _, follows = check(load_case("cabot_4_3"), [longer])
    assert follows["finite convergence"].verdict == "unknown"


# -- what is easily overlooked -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "g",
    [
        lambda x: 10 * ca.fmax(x, 0) ** 2 + 10 * ca.fmax(-x, 0) ** 2 - x**2,
        lambda x: 10 * ca.fabs(x) ** 1.5 - 0.1 * x**2,
    ],
    ids=["two halves", "power"],
)
def test_terms_with_kinks_may_make_up_for_a_part_that_is_not_convex(g):
    x = ca.SX.sym("x")
    assert check(made(x=x, potential=g(x), x0=[0.5]))[0]["O-g"].verdict == "sampled"


def test_the_vector_of_a_potential_with_kinks_is_one_of_its_own_hessian():
    x = ca.SX.sym("x", 2)
    g = 2 * ca.norm_2(x) + 1e-3 * x[0] ** 3
    found = check(made(x=x, potential=g, x0=[-0.5, 0.5]))[0]["O-g"]
    assert found.verdict == "violated"
    H, v = np.array(ca.Function("H", [x], [ca.hessian(g, x)[0]])(found.witness["x"])), np.array(found.witness["vector"])
    assert v @ H @ v < 0


def test_convex_on_the_box_says_nothing_of_a_lower_bound():
    """x^2 - 1e-6 exp(x) is convex near 0 and falls without end."""
    x = ca.SX.sym("x")
    found = check(made(x=x, potential=x**2 - 1e-6 * ca.exp(x), x0=[0.5]))[0]["O-g"]
    assert found.verdict != "holds"


def test_rest_points_of_a_potential_convex_on_the_box_hold_as_long_as_it_is_not_left():
    x = ca.SX.sym("x")
    well = made(x=x, potential=x**4 - x**2, friction=lambda _, s: 0.3 * s, x0=[1.0])
    findings, consequences = oscillator.check(well, region_of(well, [], {"x": (0.5, 2)}), [], False)
    found = {finding.id: finding for finding in findings}
    assert found["O-g"].verdict == "holds"
    assert found["O-g"].value["lower bound of g"] == pytest.approx(-0.25)
    (rest,) = (item for item in consequences if item.name == "rest points")
    assert rest.scope.states == {"x": (0.5, 2)}
    assert "stay inside the box" in rest.clause


def test_theta_with_steps_is_not_C1():
    assert law(lambda s: s + ca.floor(s)).verdict == "violated"
    assert law(lambda s: s + ca.sign(s)).witness["s"] == 0
    assert law(lambda s: s * ca.sign(s)).verdict == "holds"


def test_the_radius_of_A0_with_elements_of_very_different_size():
    """sigma(d) = 1e-6 |d_1 - d_0| + sqrt(2) 1e-3 |d_1| is least at d = (1, 1e-3) or so, not above its value at (1, 0)."""
    friction = {"a": ([[-1, 1]], 1e-6), "b": ([[0, 1e-9], [0, 1e-9]], 1e6)}
    found = check(made(friction=lambda x, s: {name: (H, r * s) for name, (H, r) in friction.items()}))[0]["O-dry"]
    assert found.value["radius of A(0)"] <= 1e-6
    pair = {"a": ([[1, 0]], 3), "b": ([[1, 1]], 1), "c": ([[0, 1]], 0.1)}
    found = check(made(friction=lambda x, s: {name: (H, r * s) for name, (H, r) in pair.items()}))[0]["O-dry"]
    assert found.value["sigma attained"] == pytest.approx(1.1, rel=1e-14)
    assert found.value["radius of A(0)"] == pytest.approx(1.1, rel=1e-9)
    assert found.value["radius of A(0)"] < found.value["sigma attained"]


def test_the_least_value_behind_constraints_with_kinks():
    """On the plane 2 x_0 + 7 x_1 + 2 x_2 = 2, which the domain meets, g is 0."""
    x = ca.SX.sym("x", 3)
    g = 2 * ca.fabs(2 * x[0] + 7 * x[1] + 2 * x[2] - 2)
    wedge = 3 - ca.fabs(2 * x[0] - 2 * x[1] + x[2] - 0.262) - ca.fabs(x[0] - 0.05)
    found = check(made(x=x, potential=g, constraints={"wedge": wedge}, x0=[0.05, 0.1, 0.1]))[0]["O-g"]
    assert found.value["inf g"] == pytest.approx(0, abs=1e-8)


# -- what was once said wrongly ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "theta",
    [
        lambda s: s + ca.fmax(0, s - 1) ** 1.5, lambda s: 2.5 * s + ca.fabs(s - 1) ** 1.5,
        lambda s: s + 1e3 * ca.fmax(0, s - 1) ** 2 + ca.exp(-s),
        lambda s: s + ca.fmax(0, s - 1.53) * ca.log(1 + ca.fmax(0, s - 1.53)),
        lambda s: s + ca.if_else(s <= 0.7, 0, 0.3 * (s - 0.7) ** 1.5), lambda s: s * ca.sqrt(1 + s**2),
        lambda s: s * ca.log(1 + s),
        lambda s: ca.sqrt(s**3 + s**4), lambda s: s * ca.tanh(s) + s**2 / 2, lambda s: s + ca.fmax(0, s**2 - 2) ** 2 + ca.exp(s),
    ],
)  # fmt: skip
def test_smooth_convex_laws_are_proved(theta):
    assert law(theta).verdict == "holds"


@pytest.mark.parametrize(
    ("theta", "place"),
    [
        (lambda s: 0.82 * ca.fmin(s, 1.29) + ca.fmax(0, s - 1.29) ** 2, 1.29),
        (lambda s: s + 1e-6 * ca.fmax(0, s - 1) + ca.exp(s), 1.0),
        (lambda s: s + ca.fmax(0, ca.exp(s) - 2) + s**1.5, np.log(2)),
    ],
)  # fmt: skip
def test_true_kinks_are_found(theta, place):
    found = law(theta)
    assert found.verdict == "violated"
    assert found.witness["s"] == pytest.approx(place, rel=1e-12)


def test_what_is_printed_of_theta_is_a_bound():
    assert "min theta''" not in law(lambda s: s + s**1.5).value
    found = law(lambda s: 0.1 * s**3 - 0.3 * s**2 + 0.31 * s + s)
    assert found.verdict == "violated"
    found = law(lambda s: s**4 / 12 - s**3 / 6 + s**2 / 8 + s)  # theta'' = (s - 1/2)^2
    assert (found.verdict, found.value["min theta''"]) == ("holds", 0)


@pytest.mark.parametrize(
    ("elements", "attained"),
    [
        (
            [
                (0.66, [[1, 0, -2]]), (1.43, [[-1, -2, -3], [2, -1, 1]]), (1.13, [[-2, -3, 3], [0, 2, 1], [2, 1, -2]]),
                (1.91, [[-2, 2, -1]]),
            ],
            7.8126,
        ),
        ([(1.0, [[1, 0]]), (1.0, [[0, 1]])], 1.0), ([(2.0, [[1, 0], [0, 1]])], 2.0),
    ],
)  # fmt: skip
def test_the_radius_is_below_every_value_of_the_support_function(elements, attained):
    made_ = [(r, np.array(H, float)) for r, H in elements]
    n = made_[0][1].shape[1]
    found = friction_radius(made_, n)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(n, 200_000))
    d /= np.linalg.norm(d, axis=0)
    sigma = sum(r * np.linalg.norm(H @ d, axis=0) for r, H in made_)
    assert found.low <= min(sigma.min() * (1 + 1e-15), attained)
    assert found.low <= found.value == pytest.approx(found.low, rel=1e-9)
    assert sum(r * np.linalg.norm(H @ found.at) for r, H in made_) == pytest.approx(found.value, rel=1e-14)


def test_random_radii_are_bounds():
    rng = np.random.default_rng(4)
    for _ in range(share(30, 8)):
        n = int(rng.integers(2, 5))
        elements = [
            (float(rng.uniform(0.1, 3)), rng.integers(-3, 4, (int(rng.integers(1, n + 1)), n)).astype(float)) for _ in range(3)
        ]
        if np.linalg.matrix_rank(np.vstack([H for _, H in elements])) < n:
            continue
        found = friction_radius(elements, n)
        d = rng.normal(size=(n, 50_000))
        sigma = sum(r * np.linalg.norm(H @ d, axis=0) for r, H in elements) / np.linalg.norm(d, axis=0)
        assert 0 < found.low <= sigma.min()
        assert found.value - found.low <= 1e-6 * found.value


def in_one_state(g, theta=1.0):
    s, q = ca.SX.sym("s"), ca.SX.sym("q")
    return check(FrictionOscillator(x=q, s=s, friction=theta * s, potential=g(q), x0=0.5, t_end=1, step=0.1))


def test_every_rest_point_lies_within_what_is_printed():
    _, follows = in_one_state(lambda q: ca.log(1 + ca.exp(q)))  # its slopes are below 1: every q rests
    assert "rest points" not in follows
    _, follows = in_one_state(lambda q: ca.log(1 + ca.exp(q)), 0.5)  # slope 1/2 at 0
    assert 0 <= follows["rest points"].value["largest q_inf"] < 1e-12
    for g, end in (
        (lambda q: ca.cosh(q), np.arcsinh(1.0)),
        (lambda q: ca.fabs(q) / 2 + q**4, 0.5),
        (lambda q: ca.exp(q) - q, np.log(2)),
    ):
        _, follows = in_one_state(g)
        assert end <= follows["rest points"].value["largest q_inf"] * (1 + 1e-15) <= end * (1 + 1e-9)


@pytest.mark.parametrize("g", [lambda q: -ca.sqrt(q + 2), lambda q: -ca.log(q + 2), lambda q: ca.log(1 + ca.exp(q)) - 1.1 * q])
def test_potentials_that_fall_slowly_are_unbounded(g):
    found = in_one_state(g)[0]["O-g"]
    assert found.verdict == "violated"
    assert found.witness["direction"] == [1.0]


@pytest.mark.parametrize(
    ("g", "least"),
    [
        (lambda x: x[0] ** 4 + 4 * x[0] ** 3 * x[1] + 6 * x[0] ** 2 * x[1] ** 2 + 4 * x[0] * x[1] ** 3 + x[1] ** 4, 0),
        (lambda x: x[0] ** 4 + x[1] ** 4 + 6 * x[0] ** 2 * x[1] ** 2, 0), (lambda x: ca.sumsqr(x) * ca.log(1 + ca.sumsqr(x)), 0),
        (lambda x: ca.log(1 + ca.exp(x[0]) + ca.exp(x[1])) - (x[0] + x[1]) / 3, np.log(3)),
    ],
)  # fmt: skip
def test_potentials_that_need_squares_or_shares(g, least):
    found = check(made(potential=lambda x, s: g(x)))[0]["O-g"]
    assert (found.verdict, found.scope) == ("holds", None)
    assert found.value.get("inf g", found.value.get("least g met")) == pytest.approx(least, abs=1e-7)


def test_a_witness_against_convexity_is_not_on_a_kink():
    """|x| + x^4/4 - x^2/2: its second derivative is looked at beside 0, where there is one."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = FrictionOscillator(x=x, potential=ca.fabs(x) + x**4 / 4 - x**2 / 2, friction={"f": (np.eye(1), s)}, s=s, x0=[0.1],
                               v0=[0], t_end=1, step=0.1)  # fmt: skip
    finding = check(model)[0]["O-g"]
    assert finding.verdict == "violated"
    at = abs(finding.witness["x"][0])
    assert 0 < at < 3**-0.5
