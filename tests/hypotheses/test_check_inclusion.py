"""Hypotheses of inclusions: the paper's constants, and brute force on random models against everything that is said to hold."""

from fractions import Fraction
from itertools import product
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL, share
from scipy.optimize import nnls

import nsmodel
from nsmodel import MonotoneInclusion, relay
from nsmodel.hypotheses.region import region_of
from nsmodel.models.monotone_inclusion import autonomous as inclusion
from nsmodel.models.monotone_inclusion.growth import max_constant_part
from nsmodel.models.monotone_inclusion.schemes import set_constraints, velocity_selection
from nsmodel.proof import exact
from nsmodel.solvers.residuals import numeric_law

IDS = ["M-T", "M-C", "M-A1", "M-A2", "M-A3", "M-24"]


def check(model, runs=(), quick=False):
    model = model.bind({})
    findings, consequences = inclusion.check_autonomous(model, region_of(model, runs), runs, quick)
    assert [finding.id for finding in findings] == IDS
    return {finding.id: finding for finding in findings}, {consequence.name: consequence for consequence in consequences}


def made(**arguments):
    return MonotoneInclusion(**{"t_end": 1, "step": 0.01, **arguments})


def verdicts(found):
    return {id: found[id].verdict for id in IDS}


# -- brute force -------------------------------------------------------------------------------------------------------


class Sampler:
    """G, T_C and N_C of a model at points, written down afresh from its fields."""

    def __init__(self, model):
        self.model, self.n = model, model.x.numel()
        chosen = velocity_selection(model)
        law = numeric_law(chosen.law)
        self.lower, self.upper, self.balls = law.lower.copy(), law.upper.copy(), law.curved
        self.f = ca.Function("v", [model.x, chosen.l], [chosen.velocity])
        self.u = ca.Function("u", [model.x], [chosen.u])
        self.m = chosen.l.numel()
        c, _ = set_constraints(model)
        self.c = ca.Function("c", [model.x], [ca.densify(c), ca.densify(ca.jacobian(c, model.x))])
        self.rows = c.numel()

    def velocities(self, x, rng, count=3):
        """Elements of F(x) - S(x): the multipliers where u != 0, any of their set where u = 0."""
        u = np.array(self.u(x)).ravel() if self.m else np.zeros(0)
        for _ in range(count):
            l = np.zeros(self.m)
            balls = set()
            for rows, K in self.balls:
                size = np.linalg.norm(u[rows])
                d = rng.normal(size=rows.stop - rows.start)
                l[rows] = -K.radius * u[rows] / size if size else K.radius * d / np.linalg.norm(d) * rng.uniform()
                balls |= set(range(rows.start, rows.stop))
            for i in set(range(self.m)) - balls:
                l[i] = self.lower[i] if u[i] > 0 else self.upper[i] if u[i] < 0 else rng.uniform(self.lower[i], self.upper[i])
            yield np.array(self.f(x, l)).ravel()

    def projected(self, x, v):
        """P_{T_C(x)} v: v minus its part in the cone of the active rows' outer normals."""
        if not self.rows:
            return v
        c, J = (np.array(part) for part in self.c(x))
        active = J[(np.abs(c.ravel()) <= 1e-9 * (1 + np.linalg.norm(x)))]
        return v if not len(active) else v + active.T @ nnls(-active.T, v)[0]

    def inside(self, x, slack=1e-12):
        return not self.rows or bool((np.array(self.c(x)[0]) >= -slack * (1 + np.linalg.norm(x))).all())

    def points(self, rng, count):
        """Points of C of many sizes, kinks and the boundary among them."""
        lower, upper = (np.array(ca.DM(end)).ravel() for end in (self.model.lower, self.model.upper))
        out = []
        for _ in range(6 * count):
            x = rng.normal(size=self.n) * 10.0 ** rng.uniform(-2, 3)
            x[rng.uniform(size=self.n) < 0.3] = 0.0
            x = np.clip(x, lower, upper)
            if not self.inside(x):
                x = self.pulled(x)
            if x is not None and self.inside(x):
                out.append(x)
            if len(out) == count:
                break
        return out

    def pulled(self, x):
        """The last point of C on the way from the start to x."""
        x0 = np.array(ca.DM(self.model.x0)).ravel()
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self.inside(x0 + middle * (x - x0)) else (low, middle)
        return x0 + low * (x - x0)


def contradictions(model, found, rng, count=25):
    """Every sampled contradiction to a finding that holds for all states."""
    sampler, bad = Sampler(model), []
    points = sampler.points(rng, count)
    values = {id: finding.value for id, finding in found.items()}
    held = {id for id, finding in found.items() if finding.verdict == "holds" and finding.scope is None}
    all_v = [list(sampler.velocities(x, rng)) for x in points]
    for x, vs in zip(points, all_v, strict=True):
        r = np.linalg.norm(x)
        for v in vs:
            w = sampler.projected(x, v)
            if "M-A2" in held and np.linalg.norm(v) > (values["M-A2"]["a_1"] + values["M-A2"]["a_2"] * r) * (1 + 1e-9) + 1e-12:
                bad.append(("M-A2", x, v))
            if "M-A3" in held:
                bound = -values["M-A3"]["alpha"] * r**2 + values["M-A3"]["beta"]
                if x @ w > bound + 1e-7 * (1 + abs(bound) + r * np.linalg.norm(v)):
                    bad.append(("M-A3", x, w))
    S = split_operator(model)
    for i in range(len(points) - 1):
        x, y = points[i], points[i + 1]
        d = x - y
        for v, w in zip(all_v[i], all_v[i + 1], strict=True):
            size = np.linalg.norm(d) * (np.linalg.norm(v) + np.linalg.norm(w)) + 1e-12
            if "M-24" in held and (v - w) @ d > values["M-24"]["L"] * (d @ d) + 1e-9 * (size + d @ d):
                bad.append(("M-24", x, y))
            if "M-T" in held and (S(x) - S(y) - (v - w)) @ d < -1e-9 * (size + np.linalg.norm(S(x) - S(y)) * np.linalg.norm(d)):
                bad.append(("M-T", x, y))
        if "M-C" in held and not sampler.inside((x + y) / 2, 1e-9):
            bad.append(("M-C", x, y))
    return bad


def split_operator(model):
    """F, so that S = F - G."""
    f = ca.Function("F", [model.x], [model.field])
    return lambda x: np.array(f(x)).ravel()


def random_model(rng):
    n = int(rng.integers(1, 4))
    x = ca.SX.sym("x", n)
    A = rng.normal(size=(n, n)) - rng.choice([0, 1, 3]) * np.eye(n)
    if rng.uniform() < 0.2:
        A = np.round(A - A.T)  # skew, exactly
    F = ca.DM(A) @ x + ca.DM(np.round(rng.normal(size=n), 2))
    shape = rng.integers(8)
    a = ca.DM(np.round(rng.normal(size=n), 2))
    if shape == 1:
        F += ca.tanh(x) * rng.normal()
    elif shape == 2:
        F -= x**3 * rng.choice([1.0, -0.5])
    elif shape == 3:
        F += a * ca.sin(ca.dot(a, x))
    elif shape == 4:
        F += a * ca.fabs(x[0] - 0.5)
    elif shape == 5:
        F += a * ca.dot(x, x)
    elif shape == 6:
        F -= x * ca.dot(x, x)
    operator = rng.integers(7)
    arguments = {}
    if operator == 1:
        arguments["phi"] = ca.dot(ca.DM(rng.uniform(0, 2, n)), ca.fabs(x - a)) + ca.fmax(ca.dot(a, x), 0.3)
    elif operator == 2:
        arguments["phi"] = 0.5 * ca.norm_2(x - a) + ca.sumsqr(x)
    elif operator == 3:
        arguments["operator"] = relay(n, -0.5, 1)
    elif operator == 4:
        arguments["operator"] = ca.DM(np.round(rng.normal(size=(n, n)), 1) + np.eye(n)) @ x + a * ca.sign(ca.dot(a, x) - 0.2)
    elif operator == 5:
        arguments["operator"] = x + x**3 - rng.choice([0.0, 0.5]) * ca.sin(x)
    elif operator == 6:
        arguments["operator"] = ca.vertcat(rng.choice([-1, 1]) * ca.sign(x[-1]), *([x[i] for i in range(n - 1)]))
    x0 = np.zeros(n)
    kind = rng.integers(6)
    if kind == 1:
        arguments |= {"lower": -1, "upper": 2}
    elif kind == 2:
        arguments |= {"lower": 0}
        x0 = np.ones(n)
    elif kind == 3:
        arguments |= {"lower": 0.5, "upper": [3.0] + [ca.inf] * (n - 1)}
        x0 = np.ones(n)
    elif kind == 4:
        arguments["constraints"] = {"plane": ca.dot(a, x) + 0.7, "other": x[0] + 1}
    elif kind == 5:
        arguments["constraints"] = {"disc": 4 - ca.sumsqr(x - 0.5)}
    return made(x=x, field=F, x0=x0, **arguments)


def test_no_sample_contradicts_what_holds_on_random_models():
    rng = np.random.default_rng(7)
    counts = dict.fromkeys(("holds", "violated", "sampled", "unknown"), 0)
    count = share(80)
    for k in range(count):
        model = random_model(rng)
        found, _ = check(model, quick=True)
        assert not (bad := contradictions(model, found, rng)), (k, model.field, model.operator, model.phi, bad[0])
        for id in IDS:
            counts[found[id].verdict] += 1
    assert counts["holds"] > 4 * count
    assert COUNT < FULL or counts["violated"] > 30
    assert counts["unknown"] + counts["sampled"] < max(5, 0.19 * count)


def test_the_sampler_sees_a_wrong_constant():
    x = ca.SX.sym("x", 2)
    model = made(x=x, field=ca.vertcat(1, 2) - x, phi=ca.norm_1(x), lower=-1, x0=[0, 0])
    found, _ = check(model)
    rng = np.random.default_rng(0)
    assert not contradictions(model, found, rng)
    for id, name, factor in (("M-A2", "a_2", 0.5), ("M-A3", "alpha", 3.0), ("M-24", "L", 2.0)):
        wrong = nsmodel.hypotheses.findings.make_finding(
            getattr(inclusion, {"M-A2": "M_A2", "M-A3": "M_A3", "M-24": "M_24"}[id]), "holds", "everywhere",
            {**found[id].value, name: factor * found[id].value[name]},
        )  # fmt: skip
        assert {bad[0] for bad in contradictions(model, {**found, id: wrong}, rng, 200)} == {id}


# -- the paper's examples ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("a", "b"), [(1.0, -1.0), (0.5, 2.0), (0.0, 1.0), (3.0, 0.0), (0.3, -0.7)])
def test_example_8_1_has_the_paper_s_constants(load_case, a, b):
    found, follows = check(load_case("inclusion_8_1", a=a, b=b))
    assert set(verdicts(found).values()) == {"holds"}
    assert found["M-A2"].value == {"a_1": abs(b), "a_2": 1 + a}
    assert found["M-24"].value["L"] == pytest.approx(-(1 + a), rel=3e-16)
    assert found["M-A3"].value["alpha"] == pytest.approx((1 + a) / 2, rel=3e-16)
    assert found["M-A3"].value["beta"] == pytest.approx(b**2 / (2 * (1 + a)), rel=1e-15)
    assert follows["contraction"].verdict == follows["well posed"].verdict == "holds"
    radius = max(2.0, abs(b) / (1 + a))  # Rounded up.
    assert radius <= follows["bounded"].value["radius"] <= radius * (1 + 2e-12)


def test_example_8_2_has_minus_the_least_eigenvalue_of_K(load_case):
    K = np.array([[2.0, -1.0, -0.5], [-1.0, 2.0, -1.0], [-0.5, -1.0, 2.0]])
    b = np.array([4.0, -0.3, 0.5])
    for stem, least, force in (("inclusion_8_2", 1.0, [3.0, 0.5, -4.0]), ("inclusion_8_2_full", np.linalg.eigvalsh(K)[0], b)):
        found, follows = check(load_case(stem))
        assert set(verdicts(found).values()) == {"holds"}
        assert found["M-24"].value["L"] == pytest.approx(-least, rel=1e-12)
        assert found["M-A3"].value["alpha"] == pytest.approx(least / 2, rel=1e-9)
        assert found["M-A3"].value["beta"] == pytest.approx(np.dot(force, force) / (2 * least), rel=1e-9)
        assert follows["contraction"].verdict == "holds"


def test_the_largest_speed_at_zero_is_that_of_the_corner_of_the_friction():
    x = ca.SX.sym("x", 2)
    found, _ = check(made(x=x, field=ca.vertcat(3, -4) - x, phi=ca.fabs(x[0]) + 2 * ca.fabs(x[1]), x0=[0, 0]))
    assert found["M-A2"].value["a_1"] == pytest.approx(np.hypot(4, 6), rel=1e-9)


# -- escapes and dissipativity -----------------------------------------------------------------------------------------


def quotient(model, direction, size):
    """<x, w>/|x|^2 far out along a direction from the start."""
    sampler = Sampler(model)
    x = np.array(ca.DM(model.x0)).ravel() + size * np.asarray(direction)
    assert sampler.inside(x)
    v = next(sampler.velocities(x, np.random.default_rng(0)))
    return x @ sampler.projected(x, v) / (x @ x)


def test_the_size_of_a_constant_field_is_rounded_up():
    """sqrt(3) is above its double."""
    model = MonotoneInclusion(x=ca.SX.sym("x", 3), field=ca.SX.ones(3), x0=[0, 0, 0], t_end=1.0, step=0.1)
    found = {finding.id: finding for finding in nsmodel.check(model, runs=[], quick=True).findings}["M-A2"]
    assert found.verdict == "holds"
    assert Fraction(found.value["a_1"]) ** 2 >= 3 > (Fraction(found.value["a_1"]) * (1 - Fraction(1, 10**9))) ** 2


def test_the_largest_constant_part_is_rounded_up_where_multipliers_cancel():
    rng = np.random.default_rng(0)
    for _ in range(200):
        n, k = rng.integers(1, 4), rng.integers(1, 4)
        columns, width = rng.normal(size=(n, k)), 10.0 ** rng.uniform(-16, 0, k)
        b = -columns.sum(axis=1)
        jumps = [SimpleNamespace(lower=1 - one, upper=1 + one) for one in width]
        found = max_constant_part(SimpleNamespace(aligned=[], jumps=jumps), b, columns)
        corners = [exact.rational(np.array(corner)) for corner in product(*((one.lower, one.upper) for one in jumps))]
        most = max(((exact.rational(b) + exact.rational(columns) @ corner) ** 2).sum() for corner in corners)
        assert Fraction(found) ** 2 >= most


@pytest.mark.parametrize(
    ("matrix", "lower", "least"),
    [
        ([[1, 0], [0, -1]], None, 1.0),
        ([[-1, 3], [3, -1]], 0, 2.0),
        ([[0, 1], [-1, 0]], None, 0.0),
        ([[0, 0], [0, -1]], [0, -ca.inf], 0.0),
        ([[-1, 0], [0, 0]], -1, 0.0),
    ],
)
def test_an_escape_is_a_direction_of_C_along_which_the_state_is_not_drawn_back(matrix, lower, least):
    x = ca.SX.sym("x", 2)
    model = made(x=x, field=ca.DM(matrix) @ x + ca.vertcat(1, -2), lower=lower, x0=[1, 1])
    found, follows = check(model)
    assert found["M-A3"].verdict == "violated"
    d = found["M-A3"].witness["direction"]
    assert quotient(model, d, 1e9) == pytest.approx(least, abs=1e-6)
    assert "bounded" not in follows
    assert follows["well posed"].verdict == "unknown"


def test_copositive_on_the_orthant_is_dissipative_though_indefinite():
    x = ca.SX.sym("x", 2)
    A = np.array([[-1.0, -3.0], [-3.0, -1.0]])
    assert np.linalg.eigvalsh(A)[-1] > 0
    model = made(x=x, field=ca.DM(A) @ x + 1, lower=0, x0=[1, 1])
    found, _ = check(model)
    assert found["M-A3"].verdict == "holds"
    assert not contradictions(model, found, np.random.default_rng(0), 400)


def test_a_bounded_set_makes_any_continuous_field_dissipative():
    x = ca.SX.sym("x", 2)
    model = made(x=x, field=ca.vertcat(x[0] * x[1] + 1, ca.exp(x[0]) - x[1]), lower=[0.5, -1], upper=[2, 1], x0=[1, 0])
    found, _ = check(model)
    assert set(verdicts(found).values()) == {"holds"}
    assert not contradictions(model, found, np.random.default_rng(0), 400)
    # |G|^2 is largest at (2, -1): (-1, e^2 + 1), or (2, 1), by hand: (3, e^2 - 1).
    assert found["M-A2"].value["a_1"] == pytest.approx(np.hypot(-1, np.e**2 + 1), rel=1e-6)


def test_a_set_away_from_zero_pushes_outwards():
    x = ca.SX.sym("x")
    model = made(x=x, field=-x, lower=1, x0=2)
    found, _ = check(model)
    value = found["M-A3"].value
    # At x = 1 the state is held: <x, w> = 0 <= beta - alpha.
    assert found["M-A3"].verdict == "holds"
    assert value["beta"] >= value["alpha"]


@pytest.mark.parametrize("field", ["cubic", "radial", "sine", "kinks"])
def test_fields_that_are_not_affine_are_dissipative_on_unbounded_sets(field):
    x = ca.SX.sym("x", 2)
    F = {
        "cubic": ca.vertcat(x[0] - x[0] ** 3 + x[1], -2 * x[1] - x[0]),
        "radial": x - x * ca.sumsqr(x) + ca.vertcat(3, 0),
        "sine": -x + 2 * ca.sin(ca.vertcat(x[1], x[0])),
        "kinks": -2 * x + 0.5 * ca.fabs(x[0] - x[1]) + ca.fmax(x[1], 0.3) / 2,
    }[field]
    model = made(x=x, field=F, x0=[1, 1])
    found, _ = check(model)
    assert found["M-A3"].verdict == "holds"
    assert found["M-A2"].verdict == ("violated" if field in ("cubic", "radial") else "holds")
    assert not contradictions(model, found, np.random.default_rng(1), 400)


def test_lorenz_is_not_dissipative_about_zero():
    x = ca.SX.sym("x", 3)
    F = ca.vertcat(10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2])
    model = made(x=x, field=F, x0=[0, 0, 0])
    found, _ = check(model)
    assert found["M-A3"].verdict == found["M-A2"].verdict == "violated"
    Q = np.array([[-10, 19, 0], [19, -1, 0], [0, 0, -8 / 3]])
    assert quotient(model, found["M-A3"].witness["direction"], 1.0) == pytest.approx(np.linalg.eigvalsh(Q)[-1], rel=1e-9)


# -- monotonicity, sets, continuity ------------------------------------------------------------------------------------


def test_an_operator_that_is_not_monotone_is_violated_along_its_witness():
    x = ca.SX.sym("x", 2)
    S = np.array([[1.0, 3.0], [0.0, 1.0]])
    found, follows = check(made(x=x, field=-5 * x, operator=ca.DM(S) @ x, x0=[1, 1]))
    d = np.array(found["M-T"].witness["direction"])
    assert found["M-T"].verdict == "violated"
    assert d @ S @ d == pytest.approx(-0.5)
    assert follows["well posed"].verdict == "unknown"
    assert found["M-24"].value["L"] == pytest.approx(-4.5)


@pytest.mark.parametrize("S", [lambda x: -ca.sign(x[0]), lambda x: ca.sign(x[1])])
def test_a_switch_of_the_wrong_sign_or_direction_has_no_L(S):
    x = ca.SX.sym("x", 2)
    model = made(x=x, field=-x, operator=ca.vertcat(S(x), x[1]), x0=[1, 1])
    found, _ = check(model)
    assert found["M-T"].verdict == found["M-24"].verdict == "violated"
    sampler, p, d = Sampler(model), np.array(found["M-24"].witness["x"]), np.array(found["M-24"].witness["direction"])
    rng = np.random.default_rng(0)
    for h in (1e-3, 1e-6):
        v, w = (next(sampler.velocities(p + s * h * d, rng)) for s in (1, -1))
        assert (v - w) @ (2 * h * d) / (2 * h) ** 2 > 0.4 / h


def test_a_rounded_operator_is_neither_proved_nor_violated():
    x = ca.SX.sym("x", 2)
    S = np.array([[0.1 + 0.2, 0.3], [0.3, 0.3 - 1e-16]])  # psd but for rounding
    found, _ = check(made(x=x, field=-x, operator=ca.DM(S) @ x, x0=[1, 1]))
    assert found["M-T"].verdict == ("holds" if S[0, 0] * S[1, 1] >= 0.3**2 else "sampled")


def test_a_monotone_cubic_operator_holds_everywhere():
    x = ca.SX.sym("x", 2)
    found, _ = check(made(x=x, field=-x, operator=x**3 + x, x0=[1, 1]))
    assert found["M-T"].verdict == "holds"
    assert found["M-T"].scope is None
    assert found["M-24"].value["L"] == pytest.approx(-2)


def test_L_of_the_field_serves_where_S_is_monotone():
    x = ca.SX.sym("x", 2)
    model = made(x=x, field=ca.vertcat(x[1], -x[0]), phi=ca.sumsqr(x) ** 2 + ca.fmax(x[0], 0), x0=[1, 1])
    found, _ = check(model)
    assert found["M-24"].scope is None
    assert found["M-24"].value["L"] == pytest.approx(0, abs=1e-12)
    assert not contradictions(model, found, np.random.default_rng(0), 300)


def test_a_concave_potential_is_violated():
    x = ca.SX.sym("x", 2)
    found, _ = check(made(x=x, field=-x, phi=x[0] ** 2 - x[1] ** 2, x0=[1, 1]))
    assert found["M-T"].verdict == "violated"
    assert np.abs(found["M-T"].witness["vector"]) == pytest.approx([0, 1])


@pytest.mark.parametrize(
    ("rows", "verdict"),
    [
        ({"disc": lambda x: 4 - ca.sumsqr(x)}, "holds"),
        ({"parabola": lambda x: x[1] - x[0] ** 2 + 1}, "holds"),
        ({"outside": lambda x: ca.sumsqr(x) - 0.25}, "violated"),
        ({"low": lambda x: x[0] - x[1], "high": lambda x: x[1] - x[0]}, "violated"),
        ({"low": lambda x: x[0] + x[1] - 2, "high": lambda x: 2 - x[0] - x[1]}, "violated"),
    ],
)
def test_the_set_is_convex_with_interior(rows, verdict):
    x = ca.SX.sym("x", 2)
    model = made(x=x, field=-x, constraints={name: row(x) for name, row in rows.items()}, x0=[1, 1])
    found, _ = check(model)
    witness = found["M-C"].witness
    assert found["M-C"].verdict == verdict
    if verdict == "holds":
        least = np.array(Sampler(model).c(witness["interior point"])[0]).min()
        assert least >= found["M-C"].value["interior margin"] - 1e-9 > 0
    elif "weights" in witness:
        total = sum(w * rows[name](x) for w, name in zip(witness["weights"], witness["constraints"], strict=True))
        assert float(ca.Function("f", [x], [total])([0.3, -5])) <= 0
    else:
        sampler = Sampler(model)
        assert sampler.inside(np.array(witness["x"]))
        assert sampler.inside(np.array(witness["y"]))
        assert not sampler.inside(np.array(witness["middle"]))


def test_a_field_that_jumps_inside_C_is_violated_where_it_does():
    x = ca.SX.sym("x", 2)
    found, _ = check(made(x=x, field=ca.vertcat(ca.sign(x[0] - 1), 0) - x, x0=[1, 1]))
    assert found["M-A1"].verdict == "violated"
    assert found["M-A1"].witness["x"][0] == pytest.approx(1, abs=1e-9)
    assert found["M-A1"].value["jump"] == pytest.approx(2, rel=1e-6)


def test_kinks_are_reported_and_continuous():
    x = ca.SX.sym("x", 2)
    found, _ = check(made(x=x, field=ca.vertcat(ca.fabs(x[0]), ca.fmax(x[0], x[1])) - 3 * x, x0=[1, 1]))
    assert found["M-A1"].verdict == "holds"
    assert found["M-A1"].value["kinks"] == 2


# -- tolerances --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tolerances", "verdict", "power"),
    [(None, "holds", None), (0.0, "holds", None), (1e-6, "unknown", None), (lambda h: h**3, "sampled", 1.0),
     (lambda h: 2 * h**2, "unknown", 0.0), (lambda h: h**1.5, "unknown", -0.5)],
)  # fmt: skip
def test_tolerances_must_vanish_faster_than_the_square_of_the_step(tolerances, verdict, power):
    x = ca.SX.sym("x")
    _, follows = check(made(x=x, field=1 - x, lower=0, x0=1, tolerances=tolerances))
    found = follows["tolerances"]
    assert found.verdict == verdict
    assert follows["convergence of the scheme"].verdict == verdict
    assert found.value.get("power p of eps/mu^2 ~ mu^p") == (None if power is None else pytest.approx(power, abs=1e-9))
    if callable(tolerances):
        assert found.value["max eps_k/mu_k^2"] == pytest.approx(tolerances(0.01) / 1e-4)


@pytest.mark.parametrize(
    ("u", "verdict"), [(lambda x: x**3, "unknown"), (lambda x: x**2 - 1, "violated"), (lambda x: -x, "violated")]
)
def test_a_switch_is_violated_only_where_its_argument_changes_sign_the_wrong_way(u, verdict):
    """sign(x^3) is sign(x); sign(x^2 - 1) jumps downwards at -1."""
    x = ca.SX.sym("x")
    found, _ = check(made(x=x, field=-x, operator=ca.sign(u(x)), x0=[0.5]))
    assert {found["M-T"].verdict, found["M-24"].verdict} == {verdict}
    if verdict == "violated":
        at, d = found["M-T"].witness["x"][0], 1e-6 * found["M-T"].witness["direction"][0]
        assert (np.sign(float(u(at + d))) - np.sign(float(u(at - d)))) * d < 0


@pytest.mark.parametrize(
    ("row", "convex"),
    [
        (lambda x: ca.fabs(x) - 1, False),
        (lambda x: ca.fmax(x, -x / 2) - 0.5, False),
        (lambda x: 1 - 2 * ca.sign(x), True),
        (lambda x: 2 - ca.floor(x), True),
        (lambda x: 3 + x * (1 / x + 1), False),  # 4 + x off 0, no value at 0
    ],
)
def test_kinks_and_steps_of_a_constraint_are_no_concave_ones(row, convex):
    """Their second derivatives are 0 off the kink, and say nothing of it."""
    x = ca.SX.sym("q")
    model = MonotoneInclusion(x=x, field=[-x], constraints={"row": row(x), "low": x + 3, "up": 3 - x}, x0=[-2], t_end=1, step=0.1)
    for quick in (True, False):
        found = nsmodel.check(model, region={"q": (-3, 3)}, quick=quick)["M-C"]
        assert found.verdict != "holds"
        points = np.linspace(-3, 3, 601)
        inside = np.array(ca.Function("c", [x], [row(x)])(points[None, :])).ravel() >= 0
        assert found.verdict != "violated" or not convex
        assert convex == bool(inside[np.flatnonzero(inside)[0] : np.flatnonzero(inside)[-1] + 1].all())
