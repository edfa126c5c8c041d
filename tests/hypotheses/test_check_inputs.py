"""Checks of models with inputs: what holds for all signals within bounds, what needs a rate, and what an edge breaks."""

from dataclasses import replace

import casadi as ca
import input_scenes as scenes
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    UsageError,
    Within,
    check,
    complementarity,
    load,
    pwm,
    relay,
    sampled,
    signal,
    simulate,
    steps,
    table,
    within,
)
from nsmodel.cli import main
from nsmodel.hypotheses.certificates.write import write_certificate
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS

u, t, q, x = (ca.SX.sym(name) for name in ("u", "t", "q", "x"))
RAMP = table([0, 1, 2], [0, 1, -1], "linear")
SQUARE = pwm(0.3, 0.37, high=0.2)


def wall(driver, g=q - u, **fields):
    """q >= u(t), pushed against it."""
    given = {"q": q, "f": [-1], "constraints": {"wall": g}, "q0": [0.0], "t_end": 2, "step": 0.01} | fields
    return SweepingProcess(inputs={u: driver}, **given)


def held(driver, h=x - u, **fields):
    """0 <= h ⟂ l >= 0, x' = -x + l."""
    l = ca.SX.sym("l")
    given = {"f": [-x], "g": [l], "h": [h], "x0": [0.2], "t_end": 2, "step": 0.01} | fields
    return FirstOrderSystem(x=x, lam=l, law=complementarity(1), inputs={u: driver}, **given)


def inclusion(driver, lower=-5, push=0, **fields):
    """x' ∈ (x_1 - x_0 + push, -x_1 - x_0) - (Sgn x_0, 0) - N_C(x), C = [lower, 5]^2 in x_0."""
    z = ca.SX.sym("z", 2)
    return MonotoneInclusion(
        x=z, field=[z[1] - z[0] + push, -z[1] - z[0]], operator=[ca.sign(z[0]), 0], lower=[lower, -5], upper=5, x0=[1, 0],
        inputs={u: driver}, t_end=2, step=0.01, **fields,
    )  # fmt: skip


def follows(report):
    """{name: verdict} of what follows."""
    return {item.name: item.verdict for item in report.consequences}


# -- what signals tell ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("driver", "low", "high", "rate"),
    [
        (table([0, 1, 3], [0, 2, -1], "linear"), -1, 2, 2),
        (table([0, 0.5, 3], [3, 1, 1], "linear"), 1, 3, 4),
        (table([0, 1, 1, 3], [0, 2, 3, -1], "linear"), -1, 3, None),
        (table([0, 1, 3], [0, 2, -1]), -1, 2, None),
        (pwm(1e-5, 0.4, low=2, high=-1), -1, 2, None),
        (pwm(1e-5, 0.0), 0, 0, 0),
        (steps([3, 1, 2.0]), 1, 3, None),
        (signal(ca.sin(3 * t)), -1, 1, 3),
        (signal(t**2), 0, 4, 4),
        (signal(ca.floor(2 * t)), 0, 4, None),
    ],
)
def test_bounds_are_read_off_signals(driver, low, high, rate):
    found = driver.within(2.0)
    assert (found.low.item(), found.high.item()) == pytest.approx((low, high), abs=1e-9)
    assert (None if found.rate is None else found.rate.item()) == (rate if rate is None else pytest.approx(rate, rel=1e-9))
    if driver.count is None:
        assert found.start.item() == pytest.approx(driver.after(np.zeros(1)).item())


@pytest.mark.parametrize("seed", range(3))
def test_bounds_of_a_spline_hold_and_are_tight(seed):
    rng = np.random.default_rng(seed)
    driver = table(np.cumsum(rng.uniform(0.2, 1, 7)), rng.normal(size=(7, 2)), "cubic")
    found, at = driver.within(5.0), np.linspace(driver.t[0], driver.t[-1], 200_001)
    values = driver.after(at)
    slopes = np.abs(np.diff(values, axis=0) / np.diff(at)[:, None])
    for bound, seen in ((-found.low, -values), (found.high, values), (found.rate, slopes)):
        assert (bound >= seen.max(axis=0) - 1e-9).all()
        np.testing.assert_allclose(bound, seen.max(axis=0), rtol=1e-4)


def test_the_largest_jump_is_found_with_its_sides():
    for driver, time, sides in (
        (table([0, 1, 1.5, 3], [0, 2, -1, 0]), 1.5, (2, -1)),
        (pwm(1.0, 0.25, low=3), 0.25, (1, 3)),
        (steps([0, 1, 5, 4]), 1.0, (1, 5)),
        (signal(ca.if_else(t < 0.5, 0, 1 + t)), 0.5, (0, 1.5)),
        (signal(lambda s: float(s >= 1), edges=[0.5, 1]), 1.0, (0, 1)),
    ):
        jump = driver.jump(2.0)
        assert (jump.t, jump.before.item(), jump.after.item()) == pytest.approx((time, *sides))
    assert RAMP.jump(2.0) is None
    assert signal(np.sin, edges=[1.0]).jump(2.0) is None


# -- u in f: measurable is enough ----------------------------------------------------------------------------------------


def test_a_chopped_converter_is_well_posed_for_every_duty_cycle():
    report = check(scenes.buck(t_end=20 * scenes.T))
    assert report.inputs == ("u: in f; within [0, 1], any measurable function, 1 at t = 0 (read off its pwm)",)
    assert report["5.2"].verdict == "holds"
    assert report["5.2"].value["omega"] == 0
    assert report["5.x0"].verdict == "violated"  # i = 0 is on the edge, whatever u is
    assert "at u" not in report["5.x0"].how
    assert report["run-contraction"].verdict == report["run-residual"].verdict == "holds"
    assert follows(report)["contraction"] == "holds"
    assert not {"Lyapunov stable", "globally asymptotically stable"} & set(follows(report))


def test_friction_under_any_force_has_one_solution():
    """A relay asks nothing of its start; no rate is needed, and 7.1 (no forcing) fails."""
    report = check(scenes.drive_cycle(None), bounds={"u": within(-3, 3)}, quick=True)
    assert [f.verdict for f in report.findings] == ["holds"] * 8 + ["violated"]
    well = next(item for item in report.consequences if item.name == "well posed")
    assert well.verdict == "holds"
    assert "for each signal" in well.statement
    assert "u in [-3, 3]" in well.scope.text


def test_an_unbounded_force_is_not_integrable():
    model = LureSystem(A=[[-1]], B=[1], C=[1], law=relay(1), x0=[0], f=[1 / (u - 0.123)], t_end=1, step=0.1, inputs={u: None})
    assert follows(check(model, bounds={u: within(-1, 0)}, quick=True))["well posed"] == "holds"
    assert follows(check(model, bounds={u: within(-1, 1)}, quick=True))["well posed"] == "unknown"


def test_a_field_and_an_operator_need_no_rate():
    report = check(inclusion(SQUARE, push=u))
    assert {f.verdict for f in report.findings} == {"holds"}
    assert report["M-H"].value["kappa"] == 0
    assert set(follows(report).values()) <= {"holds", "sampled"}
    assert "bounded" not in follows(report)  # told for the autonomous inclusion alone
    meant = check(inclusion(None, push=u), bounds={u: within(0, 0.2)}, quick=True)
    assert follows(meant)["well posed"] == "holds"
    assert follows(meant)["convergence of the scheme"] == "unknown"  # a step sees a measurable u at its ends alone


def test_a_velocity_needs_no_rate_but_the_order_does():
    def crowd(**bounds):
        model = SweepingProcess(q=q, f=[u - q], constraints={"wall": q + 1}, q0=[0], t_end=2, step=0.01, inputs={u: None})
        return check(model, bounds={u: within(-1, 2, **bounds)}, quick=True)

    loose, slow = crowd(), crowd(rate=3)
    assert {f.verdict for f in loose.findings} == {"holds"}
    assert "L_t" not in loose["S-f"].value
    assert (follows(loose)["well posed"], follows(loose)["order 1/2"]) == ("holds", "unknown")
    assert slow["S-f"].value["L_t"] == pytest.approx(3)
    assert follows(slow)["order 1/2"] == "holds"


# -- u in what must move continuously ------------------------------------------------------------------------------------


def test_a_moving_wall_has_the_rate_of_its_table():
    report = check(wall(RAMP))
    assert {f.verdict for f in report.findings} == {"holds"}
    assert report["A2"].value["b"] == pytest.approx(2)
    K_L = next(item for item in report.consequences if item.name == "K_L")
    assert K_L.value["K_L"] == pytest.approx(2)
    assert report["run-feasible"].value["least value"] >= -1e-12
    time_itself = check(wall(RAMP, g=q + 1 - ca.sin(t) - 2 * u, t=t))
    assert time_itself["A2"].value["b"] == pytest.approx(1 + 2 * 2)


def test_an_edge_breaks_the_set_with_its_time_and_jump():
    report = check(wall(SQUARE, q0=[0.3]))
    A2 = report["A2"]
    assert A2.verdict == "violated"
    jumps = np.flatnonzero(np.abs(np.diff(SQUARE.after(np.linspace(0, 2, 100_001)).ravel())) > 0)
    assert np.min(np.abs(np.linspace(0, 2, 100_001)[jumps] - A2.witness["t"])) < 1e-4
    assert abs(A2.witness["u+"][0] - A2.witness["u-"][0]) == pytest.approx(A2.value["jump"]) == pytest.approx(0.2)
    assert report["A3"].verdict == "holds"
    assert follows(report)["well posed"] == "unknown"
    assert follows(report)["prox-regular"] == "holds"  # of the set at each time
    even = check(wall(pwm(0.3, 0.5, low=-1, high=1), g=q + 2 - u**2), quick=True)
    assert even["A2"].verdict == "unknown"  # u jumps, and g does not


def test_without_signal_or_rate_nothing_is_known_of_the_motion():
    report = check(wall(None), bounds={u: within(-1, 1)}, quick=True)
    assert report["A2"].verdict == "unknown"
    assert "rate=" in report["A2"].how
    assert report["A3"].value == {"M": 0}  # the gradient does not hold u
    with_rate = check(wall(None), bounds={"u": within(-1, 1, rate=5, start=-0.5)}, quick=True)
    assert {f.verdict for f in with_rate.findings} == {"holds"}
    assert with_rate["A2"].value["b"] == pytest.approx(5)
    anywhere = check(wall(None), bounds={"u": within(-1, 1, rate=5)}, quick=True)
    assert anywhere["S-start"].verdict == "violated"
    assert anywhere["S-start"].witness["u"] > 0  # q0 = 0 is outside where u(0) > 0


def test_steps_of_an_expression_are_no_motion_at_speed_0():
    """The derivative of floor(3 u) is 0, and the wall jumps all the same."""
    for g in (q + 3 - ca.floor(3 * u), ca.if_else(u > 0.1, 2, 1) * q + 3):
        report = check(wall(None, g=g), bounds={u: within(-1, 1, rate=1)}, quick=True)
        assert report["A2"].verdict != "holds"
        assert follows(report).get("well posed", "unknown") == "unknown"
    k = ca.SX.sym("k")
    stepped = SweepingProcess(t=t, q=q, constraints={"w": q + k - ca.floor(t)}, q0=[3], t_end=2.5, step=0.1, parameters={k: 1})
    assert check(stepped, parameters={"k": (0, 1)}, quick=True)["A2"].verdict == "violated"
    jumping = inclusion(None, lower=ca.floor(2 * u) - 3)
    assert check(jumping, bounds={u: within(-1, 1, rate=1)}, quick=True)["M-H"].verdict == "violated"
    assert (
        check(held(None, h=x + 3 - ca.floor(u)), bounds={u: within(-1, 1, rate=1)}, quick=True)["F-inputs"].verdict == "unknown"
    )


def test_a_turning_and_moving_disc_is_bounded_as_differences_say():
    """|d_t g| of a disc about (u, 0) is |u'|; the gradient turns by |u'| over the distance."""
    p = ca.SX.sym("p", 2)
    model = SweepingProcess(
        q=p, f=[0, 1], constraints={"disc": ca.norm_2(p - ca.vertcat(u, 0)) - 1}, q0=[2.0, 1.0], t_end=1, step=0.01,
        inputs={u: signal(ca.sin(t) / 2)},
    )  # fmt: skip
    report = check(model, quick=True)
    assert (report["A2"].value["b"], report["A3"].value["M"]) == pytest.approx((0.5, 1.0), rel=1e-6)


def test_the_bounds_of_an_inclusion_move_at_the_rate_of_u():
    report = check(inclusion(RAMP, lower=u))
    assert report["M-H"].value["kappa"] == pytest.approx(2)
    assert {f.verdict for f in report.findings} <= {"holds", "unknown"}
    assert [f.id for f in report.findings if f.verdict == "unknown"] == ["run-bound"]
    broken = check(inclusion(SQUARE, lower=u), quick=True)["M-H"]
    assert (broken.verdict, broken.value["jump"]) == ("violated", pytest.approx(0.2))
    assert broken.witness["bound"] == "lower z_0"
    z = ca.SX.sym("z", 2)
    disc = MonotoneInclusion(
        x=z, field=-z, constraints={"disc": 4 - ca.sumsqr(z - ca.vertcat(u, 0))}, x0=[0, 0], inputs={u: None}, t_end=1, step=0.1
    )
    slow = check(disc, bounds={u: within(-1, 1, rate=3)})["M-H"]
    assert slow.verdict == "holds"
    assert 3 <= slow.value["kappa"] <= 3.3  # a disc moves as its middle does


def test_rows_of_h_move_with_u():
    report = check(held(RAMP))
    assert report["F-inputs"].verdict == "holds"
    assert report["F-inputs"].value["|h'| at most"] == pytest.approx(2)
    assert follows(report)["order"] == "holds"
    broken = check(held(SQUARE), quick=True)
    assert broken["F-inputs"].verdict == "violated"
    assert broken["F-inputs"].value["jump"] == pytest.approx(0.2)
    assert "may have to jump" in broken["F-inputs"].how
    assert follows(broken)["one trajectory"] == "holds"  # of the steps
    assert follows(broken)["order"] == "unknown"
    meant = check(held(None), bounds={u: within(0, 0.2)}, quick=True)
    assert (meant["F-inputs"].verdict, follows(meant)["order"]) == ("unknown", "unknown")
    assert "shorter" in meant["F-unique"].how
    assert "F-inputs" not in [f.id for f in check(held(SQUARE, h=x + 1, f=[u - x]), quick=True).findings]


# -- for all values, against brute force ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_random_affine_systems_are_solvable_as_their_vertices_are(seed):
    """D(u) = D_0 + u D_1: F-unique holds where W_mlcp is definite at both ends, and F-mlcp fails only where it is not."""
    rng = np.random.default_rng(seed)
    n, m, h = 2, 2, 0.1
    A, B, C, D0, D1 = (rng.normal(size=size) for size in ((n, n), (n, m), (m, n), (m, m), (m, m)))
    D0 = D0 @ D0.T + (seed % 3) * np.eye(m)
    z, l = ca.SX.sym("z", n), ca.SX.sym("l", m)
    model = FirstOrderSystem(
        x=z, lam=l, f=ca.DM(A) @ z - 3 * z, g=ca.DM(B) @ l, h=ca.DM(C) @ z + ca.DM(D0) @ l + u * (ca.DM(D1) @ l) + u,
        law=complementarity(m), x0=np.zeros(n), inputs={u: None}, t_end=1, step=h,
    )  # fmt: skip
    report = check(model, bounds={u: within(-0.5, 0.5)}, quick=True)
    least = []
    for value in np.linspace(-0.5, 0.5, 101):
        W = D0 + value * D1 + h * C @ np.linalg.solve(np.eye(n) - h * (A - 3 * np.eye(n)), B)
        least.append(np.linalg.eigvalsh(W + W.T)[0])
    if report["F-mlcp"].verdict == "holds" and "definite" in report["F-mlcp"].how:
        assert min(least) > -1e-9
    assert (min(least[0], least[-1]) > 1e-6) <= (report["F-mlcp"].verdict == report["F-unique"].verdict == "holds")
    if report["F-mlcp"].verdict == "violated":
        assert min(least) < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_constants_that_are_convex_in_u_are_those_at_the_ends(seed):
    """L of x' ∈ (A_0 + u A_1) x - N_C, and K_f of the same velocity, are largest at an end of the box of u."""
    A0, A1 = np.random.default_rng(seed).normal(size=(2, 2, 2))
    z, ends = ca.SX.sym("z", 2), [A0 + value * A1 for value in (-1, 2)]
    field = ca.DM(A0) @ z + u * (ca.DM(A1) @ z)
    given = {"inputs": {u: None}, "t_end": 1, "step": 0.1}
    inside = MonotoneInclusion(x=z, field=field, lower=-1, upper=1, x0=[0, 0], **given)
    report = check(inside, bounds={u: within(-1, 2)}, quick=True)
    assert report["M-24"].verdict == "holds"
    assert report["M-24"].value["L"] == pytest.approx(max(np.linalg.eigvalsh((A + A.T) / 2)[-1] for A in ends), rel=1e-9)
    process = SweepingProcess(q=z, f=field, constraints={"wall": z[0] + 1}, q0=[0, 0], **given)
    velocity = check(process, bounds={u: within(-1, 2)}, quick=True)["S-f"]
    assert velocity.verdict == "holds"
    most = max(np.linalg.norm(A, 2) for A in ends)
    assert most * (1 - 1e-9) <= velocity.value["K_f"] <= 1.5 * most


@pytest.mark.parametrize("seed", range(4))
def test_random_moving_sets_keep_to_their_speeds(seed):
    """A2 and A3 beside difference quotients along random signals within the bounds."""
    rng = np.random.default_rng(seed)
    p, w = ca.SX.sym("p", 2), ca.SX.sym("w", 2)
    a, c = rng.normal(size=(2, 2)), rng.normal(size=2)
    g = ca.norm_2(p - ca.DM(a) @ w) - 0.5 if seed % 2 else ca.dot(ca.DM(c), p) + 30 + w[0] * w[1] + ca.sin(t)
    model = SweepingProcess(t=t, q=p, f=[0, 0], constraints={"g": g}, q0=[9.0, 9.0], t_end=2, step=0.1, inputs={w: None})
    report = check(model, bounds={w: within([-1, 0], [1, 2], rate=[2, 0.5], start=0)}, quick=True)
    f = ca.Function("g", [t, w, p], [g, ca.jacobian(g, p)])
    fastest, turning, step = 0.0, 0.0, 1e-6
    for _ in range(400):
        time, at = rng.uniform(0, 2), rng.uniform([-1, 0], [1, 2])
        rate = rng.uniform(-1, 1, 2) * [2, 0.5] if rng.uniform() < 0.5 else rng.choice([-1, 1], 2) * [2, 0.5]
        place = rng.uniform(-6, 6, 2)
        (before, slope), (after, turned) = (map(np.array, f(time + s, at + s * rate, place)) for s in (0, step))
        fastest = max(fastest, np.abs(after - before).max() / step)
        turning = max([turning, *np.linalg.norm((turned - slope) / step, axis=1)[before.ravel() >= 0]])
    assert report["A2"].verdict == report["A3"].verdict == "holds"
    assert fastest * (1 - 1e-4) <= report["A2"].value["b"] <= 1.5 * fastest + 1
    assert turning * (1 - 1e-4) <= report["A3"].value["M"]


def test_constant_inputs_are_numbers():
    """A held input, and bounds without width, are checked as the number in its place."""
    plain = check(wall(0.0, g=q + 2, f=[-1.5]), quick=True)
    for report in (check(wall(0.5, g=q + 1.5 + u, f=[-1 - u]), quick=True),
                   check(wall(None, g=q + 1.5 + u, f=[-1 - u]), bounds={u: within(0.5, 0.5)}, quick=True)):  # fmt: skip
        assert [(f.id, f.verdict, dict(f.value), f.scope) for f in report.findings] == [
            (f.id, f.verdict, dict(f.value), f.scope) for f in plain.findings
        ]
        assert "constant, 0.5" in report.inputs[0]


def test_inputs_and_parameters_in_boxes_together():
    k = ca.SX.sym("k")
    model = wall(RAMP, f=[-k - u], g=q - u + 1, parameters={k: 1.0})
    report = check(model, parameters={"k": (0.5, 2)}, quick=True)
    assert {f.verdict for f in report.findings} == {"holds"}
    assert report["S-f"].value["L_f"] == pytest.approx(3)
    assert set(report["S-f"].scope.parameters) == {"k", "u"}
    assert report.parameters == {"k": (0.5, 2.0)}
    jumping = check(held(SQUARE, h=x - u + k, x0=[k], parameters={k: 1.0}), parameters={"k": (0.5, 1)}, quick=True)["F-inputs"]
    assert (jumping.verdict, jumping.value["jump"]) == ("violated", pytest.approx(0.2))


def test_a_class_that_proves_nothing_for_all_values(monkeypatch):
    """Without checks of its own a class has what is seen at constant values, and nothing that follows from it."""
    own = HYPOTHESIS_CHECKS.of(wall(RAMP))
    monkeypatch.setattr(type(HYPOTHESIS_CHECKS), "of", lambda part, model: replace(own, uniform=None, driven=None))
    report = check(wall(RAMP), quick=True)
    assert report["A1"].verdict == "sampled"
    assert "between them it is not proved" in report["A1"].how
    assert report.inputs[0].startswith("u: in constraints; within [-1, 1]")
    assert set(follows(report).values()) <= {"unknown"}


# -- runs ----------------------------------------------------------------------------------------------------------------


def test_a_run_beyond_its_bounds_is_no_evidence():
    for bounds, why in ((within(0, 1), "goes from -1 to 1"), (within(-1, 1, rate=1.5), "changes faster at t = ")):
        report = check(wall(RAMP, step=0.05), bounds={u: bounds})
        assert any(why in note for note in report.notes)
        assert not [f for f in report.findings if f.id.startswith("run-")]
    assert [f for f in check(wall(RAMP, step=0.05), bounds={u: within(-1, 1, rate=2)}).findings if f.id.startswith("run-")]
    run = simulate(wall(RAMP), inputs={"u": 0.0})
    assert check(wall(None), [run], bounds={u: within(-1, 1)})["run-feasible"].verdict == "holds"


def test_without_a_signal_there_is_no_run():
    report = check(wall(None), bounds={u: within(-1, 0, rate=1)})
    assert any("was not run" in note and "'u' has no signal" in note for note in report.notes)
    assert not [f for f in report.findings if f.id.startswith("run-")]


def test_the_order_is_told_at_times_that_runs_share():
    """Of steps that do not fit the period: rows of the three runs are compared at the same times."""
    report = check(scenes.buck(R=100.0, step=scenes.T / 41, t_end=8 * scenes.T))
    order = next(item for item in report.consequences if item.name == "observed order")
    assert order.value["difference h, 2h"] < order.value["difference 2h, 4h"] < 0.05


# -- wrong use -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((2, 1), "low = 2 > high = 1; expected low <= high"),
        ((0, np.inf), "high = inf; expected finite numbers"),
        ((None, 1), "low = None"),
        (("a", 1), "low = 'a'; expected a number"),
        ((0, 1, 0), "rate = 0; expected a number > 0, or None"),
        ((0, 1, -2), "rate = -2"),
        (([0, 1], [1, 2], [1, 2, 3]), "give as many of each, or one number for all"),
        (([[0]], 1), "shape (1, 1)"),
    ],
)
def test_bounds_that_are_none_are_refused(arguments, words):
    with pytest.raises(UsageError, match=r"^within: ") as error:
        within(*arguments)
    assert words in str(error.value)
    with pytest.raises(UsageError, match="start = 2"):
        within(0, 1, start=2)


@pytest.mark.parametrize(
    ("model", "bounds", "words"),
    [
        (wall(None), None, "input 'u' has neither a signal nor bounds; give bounds={'u': within(low, high)} or --bound u=LOW"),
        (wall(signal(np.sin)), None, "input 'u': the bounds of its signal are not known; give bounds="),
        (wall(signal(1 / (t - 1))), None, "is not known"),
        (wall(RAMP), {"v": within(0, 1)}, "input 'v' is not declared; the model has u"),
        (wall(RAMP), {u: (0, 1)}, "bounds of 'u': (0, 1); expected within(low, high)"),
        (wall(RAMP), {u: within([0, 1], 2)}, "bounds of 'u': within(...) has 2 values, and the input one value; give as many"),
        (wall(RAMP), [1], "bounds: expected a dictionary {input: within(low, high)}, not a list"),
        (wall(RAMP), {u: within(0, 1), "u": within(0, 1)}, "input 'u' is given twice"),
    ],
)
def test_wrong_bounds_of_a_model_are_refused(model, bounds, words):
    with pytest.raises(UsageError) as error:
        check(model, bounds=bounds, quick=True)
    assert words in str(error.value)


def test_other_uses_of_a_model_with_inputs_are_refused(tmp_path):
    plain = SweepingProcess(q=q, constraints={"wall": q}, q0=[1], t_end=1, step=0.1)
    with pytest.raises(UsageError, match="the model has none"):
        check(plain, bounds={"u": within(0, 1)}, quick=True)
    with pytest.raises(UsageError, match="certificate: 'SweepingProcess' has inputs"):
        write_certificate(check(wall(RAMP), quick=True), tmp_path)
    k = ca.SX.sym("k")
    with pytest.raises(UsageError, match="parameter 'k' has no value; beside inputs"):
        check(wall(RAMP, f=[-k], parameters={k: None}), quick=True)


def test_vectors_have_bounds_for_each_entry():
    w = ca.SX.sym("w", 2)
    model = SweepingProcess(q=q, f=[w[1]], constraints={"wall": q - w[0]}, q0=[2.0], t_end=1, step=0.1, inputs={w: None})
    report = check(model, bounds={"w": within([-1, 3], [1, 3], rate=[2, 1])}, quick=True)
    assert report.inputs == ("w: in f and constraints; w_0 within [-1, 1], |w_0'| <= 2; w_1 constant, 3 (given)",)
    assert (report["A2"].value["b"], report["S-f"].value["L_f"]) == pytest.approx((2, 3))
    assert check(model, bounds={w: within(-1, 1)}, quick=True)["A2"].verdict == "unknown"
    assert isinstance(within(0, 1), Within)


def test_bounds_on_the_command_line(tmp_path, capsys):
    (tmp_path / "m.py").write_text(
        "import casadi as ca\nfrom nsmodel import SweepingProcess\nq, u = ca.SX.sym('q'), ca.SX.sym('u')\n"
        "model = SweepingProcess(q=q, f=[-1], constraints={'wall': q - u}, q0=[0], t_end=1, step=0.1, inputs={u: None})\n"
    )
    file = str(tmp_path / "m.py")
    assert main(["check", file, "--quick", "--bound", "u=-1:1,rate=5,start=0"]) == 0
    out = capsys.readouterr().out
    assert "inputs      u: in constraints; within [-1, 1], |u'| <= 5, 0 at t = 0 (given)" in out
    assert "10 proved" in out
    assert main(["check", file, "--quick", "--bound", "u=-1:1", "--json"]) == 0
    assert '"inputs": [' in capsys.readouterr().out
    assert main(["check", file, "--quick", "--bound", "u=-1:1", "--markdown", str(tmp_path / "m.md")]) == 0
    assert "- Input u: in constraints" in (tmp_path / "m.md").read_text()
    for given, words in (
        ([], "--bound u=LOW:HIGH"),
        (["--bound", "u=1"], "expected NAME=LOW:HIGH"),
        (["--bound", "u=2:1"], "expected low <= high"),
        (["--bound", "u=0:1,slope=2"], "expected rate=... and start=..."),
        (["--bound", "u=0:1,rate=fast"], "rate = 'fast' is not a number"),
        (["--bound", "u=0:1,rate=-1"], "expected a number > 0"),
        (["--bound", "u=0:1", "--bound", "u=0:2"], "gives 'u' twice"),
        (["--bound", "u=0:1", "--certificate", str(tmp_path / "c")], "--certificate: 'm' has inputs"),
    ):
        capsys.readouterr()
        assert main(["check", file, "--quick", *given]) == 2
        assert words in capsys.readouterr().err


# -- blocks


def test_what_a_block_sets_needs_bounds_where_the_model_reads_it_and_nothing_is_claimed_across_ticks():
    v, w, z = (ca.SX.sym(name) for name in "vwz")
    pi = sampled("pi", period=0.05, memory={z: 0}, outputs={w: z - v}, update={z: z - v})
    model = LureSystem(A=[[-1]], B=[[1]], C=[[1]], f=[w], law=relay(1), x=v, x0=[1], blocks=[pi], t_end=1, step=0.01)
    with pytest.raises(UsageError, match="input 'w': the bounds of its signal are not known"):
        check(model)
    report = check(model, bounds={"w": within(-2, 2)}, quick=True)
    assert report["5.1"].verdict == report["5.2"].verdict == "holds"
    made = [item for item in report.consequences if item.name in ("well posed", "contraction")]
    assert [item.verdict for item in made] == ["unknown"] * 2
    assert all("what holds between the ticks of 'pi' is not known across them" in item.statement for item in made)


@pytest.mark.parametrize("case", ["thermostat", "schmitt_trigger", "thyristor"])
def test_what_a_block_holds_is_bounded_by_the_values_that_it_names(case):
    model = load(case)
    report = check(model, quick=True)
    (line,) = [line for line in report.inputs if "block" in line]
    low, high = {"schmitt_trigger": (-1, 1)}.get(case, (0, 1))
    assert f"within [{low}, {high}], any measurable function (read off its block)" in line
    name = line.split(":")[0]
    wide = check(model, bounds={name: within(low, high)}, quick=True)
    assert [(f.id, f.verdict) for f in report.findings] == [(f.id, f.verdict) for f in wide.findings]
