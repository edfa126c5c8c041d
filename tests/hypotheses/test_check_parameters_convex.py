"""Oscillators and inclusions for all values of parameters in a box: closed forms, and brute force at dense values."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL, share

from nsmodel import FrictionOscillator, MonotoneInclusion, check, relay
from nsmodel.proof.convex import rules
from nsmodel.proof.convex.sets import ConvexSet, MovingSet, has_interior_for_all, is_convex_for_all, outer_set
from nsmodel.proof.parameter_hull import mixture_corners
from tests.hypotheses.test_check_inclusion import contradictions

x, s, p, q = (ca.SX.sym(name) for name in "xspq")
z = ca.SX.sym("z", 2)
RADIUS, LOWER = "radius of A(0)", "lower bound of g"


def oscillator(theta=s, potential=x**2, **parts):
    given = {"x": x, "s": s, "friction": theta, "potential": potential, "x0": [0.25], "t_end": 1, "step": 0.1}
    return FrictionOscillator(**(given | {"parameters": {p: 1.0, q: 1.0}} | parts))


def inclusion(field, operator=None, **parts):
    n = np.size(parts.get("x0", 1))
    given = {"x": x if n == 1 else z, "field": field, "operator": operator, "x0": [0.25], "t_end": 1, "step": 0.1}
    return MonotoneInclusion(**(given | {"parameters": {p: 1.0, q: 1.0}} | parts))


def decided(model, quick=True, **boxes):
    return check(model, parameters=boxes, quick=quick)


# -- functions as convex combinations ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "f",
    [
        p * x**2 + q * ca.fabs(x),
        (x - p) ** 2,
        (p * x / q) ** 2 * ca.exp(x),
        ca.sqrt(p) * x + p**2,
        2 / (p * x) - (1 - p) * x,
        ca.fabs(p * x) + q * (p - x) ** 2,
        ca.if_else(x > 1, q * x, 0) - ca.sin(p) / q,
    ],
    ids=str,
)
def test_each_value_lies_in_the_hull_of_the_corners(f):
    from scipy.optimize import linprog

    low, high = np.array([0.1, 2.0]), np.array([1.5, 3.0])
    at = mixture_corners(f, ca.vertcat(p, q), low, high)
    assert at is not None
    points = np.array([-2.0, -1.1, 0.3, 0.7, 1.3, 2.9])
    corners = np.array([np.array(ca.Function("f", [x], [one])(points[None, :])).ravel() for one in at])
    whole = ca.Function("f", [x, p, q], [f])
    for values in np.random.default_rng(0).uniform(low, high, (20, 2)):
        wanted = np.array([float(whole(point, *values)) for point in points])
        A, b = np.vstack([corners.T, np.ones(len(at))]), np.append(wanted, 1.0)
        size = np.abs(A).max(axis=1)
        assert linprog(np.zeros(len(at)), A_eq=A / size[:, None], b_eq=b / size).status == 0


@pytest.mark.parametrize("f", [ca.exp(p * x), ca.floor(p * x), x / (x + p), ca.fmax(p * x, 1), p * x * (x + ca.exp(p * x))])
def test_other_functions_are_no_such_combinations(f):
    assert mixture_corners(f, p, np.array([0.5]), np.array([1.0])) is None


def test_poles_in_the_box_are_no_corners():
    assert mixture_corners(x / p, p, np.array([-1.0]), np.array([1.0])) is None


@pytest.mark.parametrize(
    ("f", "convex", "concave"),
    [(p * x**2, True, False), (-q * x**2, False, False), (ca.exp(q * x), True, False), (q * x + p, True, True),
     (x**2 + q * ca.fabs(x), False, False), (p - ca.log1p(ca.exp(q * x)), False, True), (x * ca.fabs(x) * p, False, False)],
)  # fmt: skip
def test_shapes_of_functions_of_some_symbols(f, convex, concave):
    """P in [0, 1], q in [-1, 1] are numbers."""
    low, high = np.array([-np.inf, 0, -1]), np.array([np.inf, 1, 1])
    (shape,) = rules.curvatures(f, ca.vertcat(x, p, q), low, high, of=x)
    assert (shape.convex, shape.concave) == (convex, concave)


def test_moving_sets():
    def moving(*rows, low, high):
        return MovingSet(x, p, ca.vertcat(*rows), np.array([low]), np.array([high]))

    channel = moving(x - p, p + 1 - x, 20 - x, low=0.0, high=10.0)
    low, high = outer_set(channel).bounding_box
    assert (low[0], high[0]) == (0.0, 11.0)
    found = has_interior_for_all(channel, np.zeros(1))
    assert found is not None
    assert 0 < found.part.value["interior margin"] <= 0.5
    assert found.reach >= 10  # C(10) = [10, 11]
    assert is_convex_for_all(channel, np.full(1, -1.0), np.full(1, 1.0), quick=True) is not None
    ball = moving(p - x**2, low=0.25, high=4.0)
    assert outer_set(ball).bounding_box[1][0] == pytest.approx(2)
    assert outer_set(ball).bounding_box[1][0] >= 2
    assert has_interior_for_all(moving(p - x**2, low=0.0, high=4.0), np.zeros(1)) is None
    assert has_interior_for_all(moving(x - p, 0.5 - x, low=0.0, high=1.0), np.zeros(1)) is None
    bent = moving(p + x**3, low=0.0, high=1.0)
    assert is_convex_for_all(bent, np.full(1, -1.0), np.full(1, 1.0), quick=True) is None


# -- oscillators -------------------------------------------------------------------------------------------------------

SLIDES = {
    # law, box of p, O-theta, O-dry, the least theta'(0)
    "Coulomb": (p * s, (0.2, 1), "holds", "holds", 0.2),
    "no friction at an end": (p * s, (0, 1), "holds", "violated", None),
    "a negative one": (p * s, (-0.5, 1), "violated", "violated", None),
    "falls at some values": ((p - 1) * s**2 + ca.fabs(s), (0.5, 2), "violated", "holds", 1.0),
    "from the first value on": ((p - 1) * s**2 + ca.fabs(s), (1, 2), "holds", "holds", 1.0),
    "vanishes inside": ((p - 0.3) ** 2 * s + s**2, (0, 1), "holds", "violated", None),
    "a root of p": (ca.sqrt(p) * s + s**3 / p, (0.25, 4), "holds", "holds", 0.5),
    "an exponential": (s + ca.exp(-p * s), (0.1, 0.9), "holds", "holds", 0.1),
    "an exponential too fast": (s + ca.exp(-p * s), (0.1, 1.5), "violated", None, None),
    "Stribeck": (s + p * (1 - ca.exp(-s)), (0.1, 0.9), "violated", "holds", 1.1),
    "kink": (s + p * ca.fmax(s - 1, 0), (0.1, 0.9), "violated", "holds", 1.0),
    "late": (s + p * ca.fmax(s - 1, 0) ** 2, (0.0, 0.9), "holds", "holds", 1.0),
}


@pytest.mark.parametrize("name", SLIDES)
@pytest.mark.parametrize("quick", [True, False])
def test_friction_laws(name, quick):
    theta, box, law, dry, least = SLIDES[name]
    report = decided(oscillator(theta), quick=quick, p=box)
    assert report["O-theta"].verdict == law
    assert dry is None or report["O-dry"].verdict == dry
    if least is not None:
        assert report["O-dry"].value[RADIUS] == pytest.approx(least)
        assert report["O-dry"].value[RADIUS] <= least
        assert dict(report["O-dry"].scope.parameters) == {"p": box} or not ca.depends_on(theta, p)
    for id in ("O-theta", "O-dry"):
        if report[id].verdict == "violated":
            assert box[0] <= report[id].witness["p"] <= box[1]
    assert report["O-g"].scope is None  # g does not depend on p
    assert report["O-steps"].scope is None


WELLS = {
    # potential, constraints, box of p, verdict, inf g over the box, least g''
    "stiffness": (p * x**2 / 2, {}, (0.5, 2), "holds", 0.0, 0.5),
    "stiffness may vanish": (p * x**2 / 2, {}, (0, 2), "holds", 0.0, 0.0),
    "load without stiffness": (p * x**2 / 2 - x, {}, (0, 2), "violated", None, None),
    "load": (p * x**2 / 2 - x, {}, (0.5, 2), "holds", -1.0, 0.5),
    "moved": ((x - p) ** 2, {}, (-1, 2), "holds", 0.0, 2.0),
    "a double well from p = 0 on": (x**4 / 4 - p * x**2 / 2, {}, (-2, 0), "holds", 0.0, 0.0),
    "a double well": (x**4 / 4 - p * x**2 / 2, {}, (-2, 1), "violated", None, None),
    "kink": (p * ca.fabs(x) + x**2, {}, (0.5, 2), "holds", 0.0, 2.0),
    "softplus": (ca.log(1 + ca.exp(p * x)), {}, (-1, 2), "holds", 0.0, 0.0),
    "a wall that moves": (x, {"wall": x + p}, (0.5, 3), "holds", -3.0, 0.0),
    "a channel that closes": (x**2, {"left": x - p, "right": 1.5 - x}, (0, 2), "violated", None, None),
    "a channel that moves far": (x**2, {"left": x + p, "right": 1 - p - x}, (-4, 4), "holds", 0.0, 2.0),
    "a ball that vanishes": (x**2, {"ball": p - x**2}, (-1, 1), "violated", None, None),
    "a ball": (x**2, {"ball": p - x**2}, (0.1, 1), "holds", 0.0, 2.0),
}


@pytest.mark.parametrize("name", WELLS)
def test_potentials(name):
    g, rows, box, verdict, least, curved = WELLS[name]
    found = decided(oscillator(potential=g, constraints=rows), p=box)["O-g"]
    assert found.verdict == verdict
    if verdict == "violated":
        assert box[0] <= found.witness["p"] <= box[1]
        return
    assert not found.scope.states
    assert dict(found.scope.parameters) == {"p": box}
    assert found.value.get(LOWER, -np.inf) <= least + 1e-9
    assert found.value[LOWER] > -10
    assert found.value.get("least eigenvalue of D2 g", 0.0) <= curved


def test_damping_and_directions():
    H = {"one": (ca.horzcat(1, p), 2 * s), "two": (ca.horzcat(-p, 1), s)}
    given = {"x": z, "potential": ca.sumsqr(z), "x0": [0.25, 0.5], "friction": H}
    report = decided(oscillator(**given, damping=ca.vertcat(ca.horzcat(p, 5), ca.horzcat(-5, p**2))), p=(0.5, 2))
    assert report["O-theta"].verdict == "holds"
    assert report["O-theta"].value["least eigenvalue of the damping"] == pytest.approx(0.25)
    grid = [(at, np.array([np.cos(a), np.sin(a)])) for at in np.linspace(0.5, 2, 31) for a in np.linspace(0, np.pi, 200)]
    sigma = min(2 * abs(np.array([1, at]) @ d) + abs(np.array([-at, 1]) @ d) for at, d in grid)
    assert report["O-dry"].verdict == "holds"
    assert 0 < report["O-dry"].value[RADIUS] <= sigma
    broken = decided(oscillator(**given, damping=ca.vertcat(ca.horzcat(p, 0), ca.horzcat(0, 1))), p=(-0.25, 2))
    assert broken["O-theta"].verdict == "violated"
    flat = oscillator(**given | {"friction": {"one": (ca.horzcat(1, p), s), "two": (ca.horzcat(1, -p), s)}})
    assert decided(flat, p=(-0.5, 0.75))["O-dry"].verdict == "violated"  # at p = 0 both act on z_0 alone
    assert decided(flat, p=(0.25, 0.75))["O-dry"].verdict == "holds"


def test_what_follows_for_an_oscillator():
    made = {item.name: item for item in decided(oscillator(p * s, q * x**2), p=(0.5, 1), q=(1, 2)).consequences}
    assert {made[name].verdict for name in ("well posed", "energy decay", "convergence", "finite convergence")} == {"holds"}
    assert dict(made["convergence"].scope.parameters) == {"p": (0.5, 1), "q": (1, 2)}
    made = {item.name: item for item in decided(oscillator(p * s, q * x**2), p=(0, 1), q=(1, 2)).consequences}
    assert made["well posed"].verdict == "holds"
    assert made["convergence"].verdict == "unknown"


@pytest.mark.parametrize(
    ("theta", "g", "rows", "low", "high"),
    [
        (p * s, q * (x - 1) ** 2 / 2, {}, 0.0, 2.0),  # |q (x - 1)| <= p
        (p * s, (x - q) ** 2, {}, 0.5, 2.5),  # 2 |x - q| <= p
        (s + p * s**2, q * x**2 / 2 + ca.fabs(x), {}, 0.0, 0.0),
        (s, x**4 / 4 + p * x, {}, -(2 ** (1 / 3)), 0.5 ** (1 / 3)),  # |x^3 + p| <= 1
        (p * s, q * x**2 / 2, {"wall": 0.5 - x}, -1.0, 0.5),
    ],
    ids=str,
)
def test_where_oscillators_come_to_rest(theta, g, rows, low, high):
    """For p in [0.5, 1], q in [1, 2]."""
    report = decided(oscillator(theta, g, constraints=rows), p=(0.5, 1), q=(1, 2))
    rest = next(item for item in report.consequences if item.name == "rest points")
    assert rest.verdict == "holds"
    least, largest = rest.value["least x_inf"], rest.value["largest x_inf"]
    assert least <= low + 1e-12
    assert largest >= high - 1e-12
    assert (least, largest) == pytest.approx((low, high), abs=0.02)


def test_other_potentials_have_no_common_rest_points():
    report = decided(oscillator(s, ca.log(1 + ca.exp(p * x))), p=(0.5, 1))
    assert report["O-g"].verdict == "holds"
    assert not any(item.name == "rest points" for item in report.consequences)


def test_a_channel_that_is_empty_at_some_values():
    """Its walls pass each other, where a potential that is not a polynomial is not looked at."""
    model = oscillator(potential=ca.sqrt(1 + x**2), constraints={"left": x - p, "right": 1 - x}, x0=[0.9])
    found = decided(model, p=(0.5, 2))["O-g"]
    assert found.verdict == "violated"
    assert found.witness["p"] >= 1


def test_walls_that_move_have_no_common_rest_points():
    """At p = -1 the wall holds x = -1, where g' = -2.5 presses against it."""
    report = decided(oscillator(s, (x - 0.25) ** 2, constraints={"wall": p - x}, x0=[-1.5]), p=(-1, 1))
    assert report["O-g"].verdict == "holds"
    assert not any(item.name == "rest points" for item in report.consequences)


@pytest.mark.long
def test_random_oscillators_are_judged_as_at_dense_values():
    """theta = a s + b s^2 + c s^3 is a law iff a, b, c >= 0; g = k x^2/2 + l x is convex and bounded iff k > 0 or k = l = 0."""
    rng, seen = np.random.default_rng(5), set()
    dense = np.linspace(-1, 2, 601)
    for _ in range(share(30, 10)):
        a, b, c, k = (rng.integers(0, 6) + rng.integers(-2, 3) * p + rng.integers(0, 2) * p**2 for _ in range(4))
        l = float(rng.integers(-2, 3))
        report = decided(oscillator(a * s + b * s**2 + c * s**3, k * x**2 / 2 + l * p * x), p=(-1, 2))
        numbers = np.array(ca.Function("f", [p], [ca.vertcat(a, b, c, k)])(dense[None, :]))
        law, dry = (numbers[:3] >= 0).all(), (numbers[0] > 0).all()
        convex = ((numbers[3] > 0) | ((numbers[3] == 0) & (l * dense == 0))).all()
        for id, truth in (("O-theta", law), ("O-dry", dry), ("O-g", convex)):
            verdict = report[id].verdict
            seen.add((id, verdict))
            assert truth if verdict == "holds" else not truth if verdict == "violated" else verdict != "unknown", (id, a, b, c, k)
            if verdict == "violated":
                at = report[id].witness["p"]
                own = np.array(ca.Function("f", [p], [ca.vertcat(a, b, c, k)])(at)).ravel()
                fails = {"O-theta": (own[:3] < 0).any(), "O-dry": own[0] <= 0, "O-g": own[3] <= 0}
                assert fails[id]
        if report["O-dry"].verdict == "holds":
            assert report["O-dry"].value[RADIUS] <= numbers[0].min()
        if report["O-g"].verdict == "holds" and LOWER in report["O-g"].value:
            assert report["O-g"].value[LOWER] <= np.min(-((l * dense) ** 2) / (2 * np.maximum(numbers[3], 1e-300))) + 1e-12
    assert COUNT < FULL or {(id, verdict) for id in ("O-theta", "O-dry", "O-g") for verdict in ("holds", "violated")} <= seen


# -- inclusions --------------------------------------------------------------------------------------------------------

DRAWN = {
    # model, box of p, verdicts of M-T, M-C, M-A1, M-A2, M-A3, M-24, L
    "x' = p x": (inclusion(p * x), (-1, 1), "holds holds holds holds violated holds", 1.0),
    "x' = -p x": (inclusion(-p * x), (0.5, 1), "holds holds holds holds holds holds", -0.5),
    "friction": (inclusion(-x, p * ca.sign(x)), (0, 1), "holds holds holds holds holds holds", -1.0),
    "negative friction": (inclusion(-x, p * ca.sign(x)), (-0.1, 1), "violated holds holds holds holds violated", None),
    "relay": (inclusion(-x, relay(1, -p, p)), (0.2, 1), "holds holds holds holds holds holds", -1.0),
    "cubic": (inclusion(-x, p * x**3), (0.2, 1), "holds holds holds violated holds holds", -1.0),
    "not affine": (inclusion(-x, ca.tanh(p * x)), (0.2, 1), "holds holds holds holds holds holds", -1.0),
    "a wave": (inclusion(ca.cos(p * x) - 2 * x), (0.5, 1), "holds holds holds holds holds holds", -1.0),
    "potential": (inclusion(-x, phi=p * ca.fabs(x) + x**2), (0.2, 1), "holds holds holds holds holds holds", -3.0),
    "not convex": (inclusion(-x, phi=(p - 0.5) * x**2), (0.2, 1), "violated holds holds holds holds holds", -0.4),
    "a ball": (inclusion(1 - x, constraints={"c": p - x**2}), (0.25, 1), "holds holds holds holds holds holds", -1.0),
    "no ball": (inclusion(-x, constraints={"c": p - x**2}), (-1, 1), "unknown violated unknown unknown unknown unknown", None),
    "a point": (inclusion(-x, constraints={"c": p - x**2}), (0, 1), None, None),
    "a channel": (inclusion(1 - x, lower=p - 1, upper=p + 1), (-0.5, 3), "holds holds holds holds holds holds", -1.0),
    "it closes": (inclusion(1 - x, lower=p, upper=1), (0, 2), "unknown violated unknown unknown unknown unknown", None),
    "grows": (inclusion(p * x**2), (0.5, 1), "holds holds holds violated violated holds", None),
}


@pytest.mark.parametrize("name", DRAWN)
def test_inclusions(name):
    model, box, verdicts, L = DRAWN[name]
    report = decided(model, p=box)
    if verdicts is None:
        assert report["M-C"].verdict == "violated"
        assert report["M-C"].witness["p"] == 0
        return
    assert [finding.verdict for finding in report.findings if finding.id.startswith("M-")] == verdicts.split()
    for finding in report.findings:
        assert finding.verdict != "violated" or box[0] <= finding.witness["p"] <= box[1]
    if L is not None:
        assert not report["M-24"].scope.states
        assert report["M-24"].value["L"] == pytest.approx(L)
        assert report["M-24"].value["L"] >= L - 1e-15
    brute(model, report, p=np.linspace(*box, 21))


def brute(model, report, seed=0, **values):
    """No sampled contradiction at any of the values to what holds for all of them."""
    held = {f.id: replace(f, scope=None) for f in report.findings if f.verdict == "holds" and not (f.scope and f.scope.states)}
    rng = np.random.default_rng(seed)
    for at in np.array(list(values.values())).T:
        bound = model.bind(dict(zip(values, at.tolist(), strict=True)))
        assert contradictions(bound, held, rng, 12) == []


@pytest.mark.long
def test_random_inclusions_are_judged_as_at_dense_values():
    rng, seen, dense = np.random.default_rng(7), [], np.linspace(0, 1, 21)
    for seed in range(share(30, 3)):
        A, M = (rng.integers(-4, 5, (2, 2)) + p * rng.integers(-2, 3, (2, 2)) for _ in range(2))
        M = ca.SX(M) + 5 * ca.SX.eye(2)
        mu, r = rng.integers(0, 3) + rng.integers(-1, 2) * p, rng.integers(0, 3) + rng.integers(-1, 3) * p
        rows = [{}, {"ball": r + 0.5 - ca.sumsqr(z)}, {"wall": 1 + r - z[0] - z[1]}][seed % 3]
        drift = ca.vertcat(rng.integers(-1, 2) * p, rng.integers(-1, 2))
        S = M @ z + ca.vertcat(mu * ca.sign(z[0]), 0)
        model = inclusion(ca.SX(A) @ z + drift, S, x0=[0.0, 0.0], constraints=rows)
        report = decided(model, p=(0, 1))
        parts = ca.Function("f", [p], [ca.SX(A), M, mu, r])
        at = [[np.array(part).squeeze() for part in parts(value)] for value in dense]
        least = min(np.linalg.eigvalsh(m + m.T)[0] for _, m, _, _ in at)
        top = max(np.linalg.eigvalsh(a - m + (a - m).T)[-1] / 2 for a, m, _, _ in at)
        filled = seed % 3 != 1 or min(float(size) for *_, size in at) > -0.5
        monotone = least >= -1e-12 and min(float(size) for *_, size, _ in at) >= 0
        verdicts = {id: report[id].verdict for id in ("M-T", "M-C", "M-A2", "M-A3", "M-24")}
        seen += verdicts.items()
        assert verdicts["M-C"] == ("holds" if filled else "violated")
        assert monotone if verdicts["M-T"] == "holds" else not monotone or not filled
        if verdicts["M-24"] == "holds":
            assert top <= report["M-24"].value["L"] <= top + 1e-9
        if filled:
            brute(model, report, seed, p=dense)
    both = {("M-T", "holds"), ("M-T", "violated"), ("M-C", "violated"), ("M-A3", "holds"), ("M-A3", "violated")}
    assert COUNT < FULL or both <= set(seen)


OUTSIDE = {"z_0 + z_1 >= 1": z[0] + z[1] - 1, "a disc that moves": 1 - (z[0] - 2 - p) ** 2 - z[1] ** 2}


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("S", [None, "signs", "tanh and signs"])
@pytest.mark.parametrize("F", [-z, ca.vertcat(-z[0] + ca.sin(p * z[1]), -2 * z[1])], ids=str)
def test_sets_that_do_not_hold_0(name, S, F):
    """The distance of C enters beta."""
    signs, bent = ca.vertcat(p * ca.sign(z[0] - 1), 0), ca.vertcat(0, ca.tanh(p * z[1]))
    operator = {None: None, "signs": signs, "tanh and signs": signs + bent}[S]
    model = inclusion(F, operator, x0=[2.5, 0.0], constraints={"c": OUTSIDE[name]})
    report = decided(model, p=(0.25, 1))
    assert [report[id].verdict for id in ("M-T", "M-C", "M-A1", "M-A2", "M-A3", "M-24")] == ["holds"] * 6
    brute(model, report, p=np.linspace(0.25, 1, 7))


def test_what_follows_for_an_inclusion():
    model = inclusion(-p * x + q, x0=[0.25])
    made = {item.name: item for item in decided(model, p=(0.5, 2), q=(-1, 1)).consequences}
    assert made["contraction"].verdict == "holds"
    assert made["contraction"].value["L"] == -0.5
    assert made["well posed"].verdict == made["bounded"].verdict == "holds"
    assert made["bounded"].value["absorbing radius"] >= 2  # x = q/p
    assert dict(made["bounded"].scope.parameters) == {"p": (0.5, 2), "q": (-1, 1)}


def test_a_start_that_depends_on_the_parameters():
    report = decided(inclusion(-x, x0=[p]), p=(-3, 2))
    bounded = next(item for item in report.consequences if item.name == "bounded")
    assert bounded.value["radius"] == pytest.approx(3)
    assert bounded.value["radius"] >= 3


def test_the_whole_space_is_no_moving_set():
    C = MovingSet(x, p, ca.SX(0, 1), np.zeros(1), np.ones(1))
    found = has_interior_for_all(C, np.zeros(1))
    assert found is not None
    assert found.reach == 0
    assert isinstance(outer_set(C), ConvexSet)
