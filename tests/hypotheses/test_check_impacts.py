"""Impacts: rows whose multiplier acts too late, what a run and a check say where a state jumps, and where none does."""

from __future__ import annotations

import json

import casadi as ca
import numpy as np
import pytest
from fuzz_models import some
from scipy.integrate import solve_ivp

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    StepError,
    check,
    complementarity,
    equality,
    product,
    relay,
    second_order_cone,
    simulate,
    sweep,
    table,
)
from nsmodel.cli import main
from nsmodel.solvers import impacts

X, S = ca.SX.sym("x", 2), ca.SX.sym("s")
L = ca.SX.sym("l")
DOUBLE = {"A": [[0, 1], [0, 0]], "B": [0, 1], "C": [1, 0]}  # q' = v, v' = ... + l, y = q


def ball(**given):
    """A ball that falls from 1 m."""
    return LureSystem(**(DOUBLE | {"f": [0, -9.81], "law": complementarity(1), "x0": [1, 0], "t_end": 1, "step": 1e-3} | given))


def first_order(**given):
    """The same as a first-order system with a mass of 2."""
    basis = {"x": X, "lam": L, "M": [[1, 0], [0, 2]], "f": [X[1], -2 * 9.81], "g": [0, L], "h": X[0], "law": complementarity(1)}
    return FirstOrderSystem(**(basis | {"x0": [1, 0], "t_end": 1, "step": 1e-3} | given))


def oscillator(**given):
    """A mass on a spring with a wall in its way."""
    x = ca.SX.sym("x")
    basis = {"x": x, "potential": x**2 / 2, "friction": 0.05 * S, "s": S, "constraints": {"wall": x + 0.5}}
    return FrictionOscillator(**(basis | {"x0": 1, "t_end": 4, "step": 1e-3} | given))


Q, R3 = ca.SX.sym("x", 4), ca.SX.sym("l", 3)
HIT = np.array([0.3, -np.sqrt(0.91)])  # where what falls from (0.3, 0) meets the unit circle, after
FALL = np.sqrt(2 * 0.91**0.5 / 9.81)  # seconds


def disc(**given):
    """A point that falls in the unit disc: (1, q) in the cone."""
    basis = {"x": Q, "lam": R3, "f": [Q[2], Q[3], 0, -9.81], "g": [0, 0, R3[1], R3[2]], "h": [1, Q[0], Q[1]]}
    return FirstOrderSystem(**(basis | {"law": second_order_cone(3), "x0": [0.3, 0, 0, 0], "t_end": 2, "step": 1e-3} | given))


def disc_of_lure(**given):
    """The same as a Lur'e system, whose fifth state is the radius."""
    A, B, C = np.zeros((5, 5)), np.zeros((5, 3)), np.zeros((3, 5))
    A[0, 2] = A[1, 3] = B[2, 1] = B[3, 2] = C[0, 4] = C[1, 0] = C[2, 1] = 1
    basis = {"A": A, "B": B, "C": C, "f": [0, 0, 0, -9.81, 0], "law": second_order_cone(3)}
    return LureSystem(**(basis | {"x0": [0.3, 0, 0, 0, 1], "t_end": 2, "step": 1e-3} | given))


def disc_with_input(**given):
    """The weight is an input."""
    u = ca.SX.sym("u")
    return disc(f=[Q[2], Q[3], 0, u], inputs={u: table([0, 2], [-9.81, -9.81])}, **given)


def told(model, **options):
    """The warnings of a run that speak of impacts."""
    return [text for text in simulate(model, **options).metadata["warnings"] if "acts on" in text]


@pytest.mark.parametrize(
    ("model", "moved", "t", "rate"),
    [
        (ball(), "'x_1' must jump", np.sqrt(2 / 9.81), -np.sqrt(2 * 9.81)),
        (first_order(), "'x_1' must jump", np.sqrt(2 / 9.81), -np.sqrt(2 * 9.81)),
        (first_order(h=ca.sin(X[0]) * (2 + X[0]), step=5e-3), "'x_1' must jump", np.sqrt(2 / 9.81), -2 * np.sqrt(2 * 9.81)),
        (oscillator(friction=None), "'v of x' must jump", 2 * np.pi / 3, -np.sqrt(0.75)),
        (ball(law=equality(1), x0=[0, 1], f=0), "'x_1' must jump", 1e-3, 1.0),
        (ball(f=[0, 9.81], B=[0, -1], C=[-1, 0], x0=[-1, 0]), "'x_1' must jump", np.sqrt(2 / 9.81), -4.43),
    ],
)  # fmt: skip
def test_an_impact_is_told_with_its_time_and_rate(model, moved, t, rate):
    (text,) = told(model)
    assert moved in text
    assert "an impact. This scheme's answer is the inelastic one" in text
    assert "are impulses / h, and grow as h shrinks" in text
    told_t, told_rate = (float(text.partition(word)[2].split()[0].rstrip(":")) for word in (" at t = ", " with y' = "))
    assert told_t == pytest.approx(t, abs=2 * model.step)
    assert told_rate == pytest.approx(rate, rel=2e-2)


@pytest.mark.parametrize("step", [1e-3, 7e-4, 3.3e-4])
def test_the_answer_is_the_inelastic_one_and_the_impulse_does_not_feel_the_step(step):
    run = simulate(ball(step=step))
    assert np.abs(run.x[run.t > 0.46]).max() < 1e-12
    impact = np.abs(run.t - 0.4515) < 5 * step
    impulse = (run.step * (run.multipliers[:, 0] - 9.81))[impact & (run.multipliers[:, 0] > 20)].sum()
    assert impulse == pytest.approx(np.sqrt(2 * 9.81), rel=1e-2)


def test_other_weights_rebound_by_chance_and_say_so():
    """With theta = 1/2 the ball comes back by what the place of the contact in its step decides."""
    heights = []
    for step in (1e-3, 7e-4, 3.3e-4):
        run = simulate(ball(step=step, theta=0.5))
        heights.append(run.x[run.t > 0.46, 0].max())
        (text,) = run.metadata["warnings"]
        assert "With theta = 0.5, gamma = 1 what comes after it depends on where in a step y closes" in text
    assert max(heights) - min(heights) > 0.3


@pytest.mark.parametrize(
    "model",
    [
        ball(x0=[0, 0]),  # it lies there
        ball(x0=[1, 0], t_end=0.4),  # it does not land
        ball(f=[0, 9.81]),  # it rises
        ball(law=equality(1), x0=[0, 0], f=0),
        ball(D=1e-4),  # the floor gives way
        ball(B=[1e-3, 1]),  # and here it is viscous
        ball(A=[[0, 1, 0], [0, 0, 0], [0, 0, -1e3]], B=[0, 1, 1], C=[1, 0, 1], f=[0, -9.81, 0], x0=[1, 0, 0]),
        ball(law=relay(1)),
        oscillator(x0=0.4),
        ball(A=[[0, 1], [0, -1]], C=[0, 1], f=0, law=relay(1), x0=[0, 1]),
    ],
    ids=["lies", "falls", "rises", "held", "soft", "viscous", "damper", "bounded", "short of the wall", "friction"],
)
def test_nothing_is_said_where_no_state_jumps(model):
    assert told(model) == []
    report = check(model, [simulate(model)], quick=True)
    assert [finding.verdict for finding in report.findings if finding.id == "run-continuous"] in ([], ["holds"])


def test_rounding_in_the_product_of_b_and_c_is_zero():
    """C B = 0.1 * 3 - 0.3 is 5.6e-17 in doubles."""
    model = ball(A=[[0, 1, 0], [0, 0, 0], [0, 0, 0]], B=[3, 1, -0.3], C=[0.1, 0, 1], f=[0, -9.81, 0], x0=[10, 0, 0])
    (watch,) = impacts.impact_rows(model)
    assert watch.degree == 2


def test_a_row_that_another_multiplier_may_hold_is_not_watched_and_a_bounded_one_holds_nothing():
    held = ball(B=[[0, 1], [1, 0]], C=[[1, 0], [0, 1]], law=complementarity(2))
    assert impacts.impact_rows(held) == ()
    rubbed = ball(B=[[0, 1], [1, 0]], C=[[1, 0], [0, 1]], law=product(complementarity(1), relay(1, -0.1, 0.1)))
    assert [watch.name for watch in impacts.impact_rows(rubbed)] == ["l_0"]


def test_a_relay_that_acts_late_and_slides_is_told():
    """x'' = -x' - Sgn x: each swing is a little smaller than the last, and it never rests; implicit Euler does."""
    late = {"A": [[0, 1], [0, -1]], "B": [0, 1], "C": [1, 0], "law": relay(1), "x0": [1, 0], "t_end": 12, "step": 1e-2}
    rests = []
    for step in (2e-2, 1e-2, 5e-3):
        (text,) = told(LureSystem(**late | {"step": step}))
        assert "slides from t" in text
        assert "the damping of the scheme" in text
        rests.append(float(text.partition("t = ")[2].split()[0]))
    assert rests[0] < rests[1] < rests[2]
    assert check(LureSystem(**late), [simulate(LureSystem(**late))], quick=True)["run-continuous"].verdict == "unknown"
    assert told(LureSystem(**late | {"x0": [0, 0]})) == []  # it rests from the start
    with_friction = LureSystem(**late | {"B": [[0, 0], [1, 0.5]], "C": [[1, 0], [0, 1]], "law": relay(2)})
    assert told(with_friction) == []  # and this comes to rest, in finite time


def test_check_names_the_jump_and_without_runs_that_there_may_be_one():
    model = ball()
    finding = check(model)["run-continuous"]
    assert finding.verdict == "violated"
    assert finding.witness["states"] == ["x_1"]
    assert finding.witness["multiplier"] == "l_0"
    assert finding.witness["t"] == pytest.approx(0.452)
    assert finding.value["jumps"] == 1
    assert "inelastic" in finding.how
    assert any("where y closes with y' != 0 a state jumps" in note for note in check(model, quick=True).notes)
    assert "run-continuous" not in [f.id for f in check(ball(D=1.0), quick=True).findings]


@pytest.mark.parametrize("law", [complementarity(1), relay(1), equality(1)])
def test_the_rows_of_a_run_may_come_in_parts(law):
    rng, watches = np.random.default_rng(1), impacts.impact_rows(ball(A=[[0, 1], [0, -1]], law=law))
    l = np.where(rng.uniform(size=60) < 0.5, float(ca.DM(law.lower)), rng.uniform(0, 0.9, 60))
    rows = {"t": np.arange(60.0), "x": rng.normal(size=(60, 2)), "multipliers": np.append(np.nan, l[1:])[:, None]}
    whole = impacts.update_impacts(watches, rows, {})
    assert whole["l_0"]["count"] > 1 or law.labels == ["equality"]
    for size in (1, 2, 3, 7):
        known = {}
        for start in range(0, 60, size):
            known = impacts.update_impacts(watches, {name: part[start : start + size] for name, part in rows.items()}, known)
        assert known == whole


def test_a_run_that_fails_tells_of_its_impacts():
    t = ca.SX.sym("t")
    model = ball(f=[0, -9.81 + ca.if_else(t > 0.8, ca.inf, 0)], t=t)
    with pytest.raises(StepError) as stop:
        simulate(model)
    assert any("an impact" in text for text in stop.value.trajectory.metadata["warnings"])


def test_the_command_line_tells_it_in_the_warning_and_in_json(tmp_path, capsys):
    file = tmp_path / "ball.py"
    file.write_text(
        "from nsmodel import LureSystem, complementarity\n"
        "model = LureSystem(A=[[0, 1], [0, 0]], B=[0, 1], C=[1, 0], f=[0, -9.81], law=complementarity(1), x0=[1, 0],\n"
        "                   t_end=1, step=1e-3, names=['q', 'v'])\n"
    )
    assert main(["run", str(file)]) == 0
    out, err = capsys.readouterr()
    assert "warning: 'l_0' acts on y'' only, not on y' (C B = 0): where y closes 'v' must jump, here once" in err
    assert "run-continuous" in out
    assert main(["run", str(file), "--json"]) == 0
    assert any("an impact" in text for text in json.loads(capsys.readouterr().out)["warnings"])
    assert main(["check", str(file), "--strict"]) == 1
    assert "an impact" in " ".join(capsys.readouterr().out.split())


# -- second-order cones --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [disc, disc_of_lure])
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.c)])
def test_an_impact_at_a_cone_is_told_at_constant_steps(make, compiled):
    (text,) = told(make(t_end=0.6), compiled=compiled)
    assert "where y closes 'x_2' and 'x_3' must jump, here once" in text
    assert "This scheme's answer is the inelastic one" in text
    t, rate = (float(text.partition(word)[2].split()[0].rstrip(":")) for word in (" at t = ", " with (y_1 - |(y_2, ...)|)' = "))
    assert t == pytest.approx(FALL, abs=2e-3)
    assert rate == pytest.approx(9.81 * FALL * HIT[1], rel=1e-2)
    assert check(make(), [simulate(make(t_end=0.6))], quick=True)["run-continuous"].verdict == "violated"


@pytest.mark.parametrize("step", [1e-3, 1e-4, 1e-5])
def test_the_answer_at_a_cone_is_inelastic_and_keeps_what_moves_along_it(step):
    v = np.array([0, -9.81 * FALL])
    close = {"x0": [*(HIT - 20.3 * step * v), *v], "f": [Q[2], Q[3], 0, 0], "t_end": 40 * step, "step": step}
    run = simulate(disc(**close))
    assert run.index_set[20, 0] == -1
    assert (run.index_set[22:, 0] == 1).all()
    assert np.abs(run.x[23, 2:] - (v - HIT * (HIT @ v))).max() <= 50 * step
    speed = np.linalg.norm(run.x[:, 2:], axis=1)
    assert (np.diff(speed) <= 1e-6).all()


@pytest.mark.parametrize("make", [disc, disc_of_lure, disc_with_input])
@pytest.mark.parametrize(
    ("rtol", "compiled", "method"),
    [
        (1e-3, False, "auto"),
        pytest.param(1e-2, True, "auto", marks=pytest.mark.c),
        pytest.param(1e-5, True, "time-stepping", marks=pytest.mark.c),
    ],
)
@pytest.mark.long
def test_steps_under_error_control_stop_at_an_impact_of_a_cone_by_name(make, rtol, compiled, method):
    """They halved to the least, and what y was off the cone by became a speed of 100 m/s."""
    with pytest.raises(StepError, match=r"where y closes 'x_2' and 'x_3' must jump, an impact; at t = 0\.44") as stop:
        simulate(make(), rtol=rtol, compiled=compiled, method=method)
    run = stop.value.trajectory
    assert run.t[-1] == pytest.approx(FALL, abs=rtol)
    fall = np.column_stack([0.3 + 0 * run.t, -9.81 * run.t**2 / 2, 0 * run.t, -9.81 * run.t])
    assert np.abs(run.x[:, :4] - fall).max() <= 2 * rtol * 9.81 * FALL


@pytest.mark.c
@pytest.mark.parametrize("seed", some(range(24), 3))
def test_random_positions_in_cones_are_right_to_their_first_impact(seed):
    """Until DOP853 has y on the surface: cones with more rows than there are positions, curved ones; some are never met."""
    r = np.random.default_rng(seed)
    n, m = int(r.integers(1, 4)), int(r.integers(2, 5))
    C, K = r.normal(size=(m, n)), r.normal(size=(n, n))
    start, push, w = np.r_[np.zeros(n), r.normal(size=n) * r.integers(0, 2)], 3 * r.normal(size=n), r.uniform(0.5, 4)
    K, offset, bend = K @ K.T, np.r_[1, r.normal(size=m - 1) / 5], 0.3 * r.integers(0, 2)
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 2 * n), ca.SX.sym("l", m)
    q, v = x[:n], x[n:]
    y = ca.DM(offset) + ca.DM(C) @ q + ca.vertcat(bend * ca.sin(q[0]) ** 2, ca.SX(m - 1, 1))
    model = FirstOrderSystem(
        t=t, x=x, lam=l, f=ca.vertcat(v, ca.DM(push) * ca.sin(w * t) - ca.DM(K) @ q), h=y, law=second_order_cone(m), x0=start,
        g=ca.vertcat(ca.SX(n, 1), ca.jtimes(y, q, l, True)), t_end=3,
    )  # fmt: skip

    def gap(_, s):
        z = offset + C @ s[:n] + np.r_[bend * np.sin(s[0]) ** 2, np.zeros(m - 1)]
        return z[0] - np.linalg.norm(z[1:])

    gap.terminal, gap.direction = True, -1
    free = solve_ivp(
        lambda t, s: np.r_[s[n:], push * np.sin(w * t) - K @ s[:n]], (0, 3), start, method="DOP853", rtol=1e-11, atol=1e-12,
        events=gap, max_step=0.02, dense_output=True,
    )  # fmt: skip
    try:
        run, stop = simulate(model, rtol=1e-4, compiled=True), ""
    except StepError as error:
        run, stop = error.trajectory, str(error)
    assert ("an impact" in stop) == (free.status == 1)
    assert run.t[-1] == pytest.approx(free.t[-1], abs=1e-3)
    before = run.t <= free.t[-1]
    assert np.abs(run.x[before] - free.sol(run.t[before]).T).max() <= 3e-4 * np.abs(free.y).max()


@pytest.mark.c
def test_what_stays_on_a_cone_is_not_refused():
    """A pendulum of length 1, let go at 0.5 rad: no state jumps."""
    run = simulate(disc(x0=[np.sin(0.5), -np.cos(0.5), 0, 0]), rtol=1e-4, compiled=True)
    angle = solve_ivp(lambda _, a: [a[1], -9.81 * np.sin(a[0])], (0, 2), [0.5, 0], rtol=1e-10, atol=1e-12, t_eval=run.t).y[0]
    assert np.abs(run.x[:, :2] - np.column_stack([np.sin(angle), -np.cos(angle)])).max() <= 2e-3


@pytest.mark.parametrize(
    "model",
    [
        disc(f=[0, -1, 0, 0], g=[R3[1], R3[2], 0, 0]),  # l moves what it holds
        disc(h=[1 + 0.1 * R3[0], Q[0], Q[1]]),  # the rim gives way
        disc(g=[0.1 * R3[1], 0.1 * R3[2], R3[1], R3[2]]),  # and here it is viscous
    ],
)
def test_cones_of_relative_degree_1_are_not_watched(model):
    assert impacts.impact_rows(model) == ()


def test_a_wall_beside_a_cone_that_is_open_is_passed():
    l = ca.SX.sym("l", 4)
    room = {"lam": l, "g": [0, 0, l[1], l[2] + l[3]], "h": [1, Q[0], Q[1], Q[1] + 0.5]}
    run = simulate(disc(law=product(second_order_cone(3), complementarity(1)), **room), rtol=1e-3)
    np.testing.assert_allclose(run.x[-1], [0.3, -0.5, 0, 0], atol=1e-9)
    assert any("'l_3' acts on y'' only" in text for text in run.metadata["warnings"])


# ---------------------------------------------------------------------------------------------- anti-friction


def turned(law, **given):
    """x' = -1 - l, y = x: the multiplier pushes y where the law does not want it."""
    of = {"x": S, "lam": L, "f": -1, "g": -L, "h": S, "x0": [1.0], "t_end": 2, "step": 0.1}
    return FirstOrderSystem(law=law, **of | given)


@pytest.mark.parametrize("options", [{}, {"rtol": 1e-6}], ids=str)
def test_anti_friction_is_said_behind_the_status(options):
    run = simulate(turned(relay(1)), **options)
    assert run.status == "done"
    lines = run.summary_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("  status"))
    assert lines[at + 1].startswith("  anti-friction   hypothesis 5.1 is violated: C B = -1 for 'l', below 0.")
    assert run.summary()["anti_friction"] == {"l": -1.0}


@pytest.mark.parametrize("options", [{}, {"rtol": 1e-6, "method": "event-driven"}], ids=str)
@pytest.mark.parametrize("x0", [1.0, 0.0])
def test_anti_friction_is_said_where_a_step_fails(x0, options, tmp_path):
    with pytest.raises(StepError, match=r"hypothesis 5\.1 is violated: C B = -1 for 'l'") as failed:
        simulate(turned(complementarity(1), x0=[x0]), **options, out=tmp_path / "run")
    if (run := failed.value.trajectory) is not None:
        text = run.summary_text(messages=False)
        assert "status          failed\n  anti-friction   hypothesis 5.1 is violated: C B = -1 for 'l'" in text


def test_anti_friction_is_the_diagonal_of_c_b():
    """Beside NumPy, of random systems with a mass; what is said of Lur'e systems is what the check proves."""
    rng = np.random.default_rng(3)
    x, l = ca.SX.sym("x", 4), ca.SX.sym("l", 3)
    seen = set()
    for _ in range(20):
        A, B, C, M = (np.round(rng.normal(size=shape), 1) for shape in ((4, 4), (4, 3), (3, 4), (4, 4)))
        M = np.eye(4) + M @ M.T
        system = FirstOrderSystem(x=x, lam=l, M=M, f=A @ x, g=B @ l, h=C @ x, law=relay(3), x0=np.zeros(4), t_end=1, step=0.1)
        lure = LureSystem(A=A, B=B, C=C, law=relay(3), x0=np.zeros(4), t_end=1, step=0.1)
        for model, slope in ((system, C @ np.linalg.solve(M, B)), (lure, C @ B)):
            expected = {name: s for name, s in zip(model.multiplier_names, np.diag(slope), strict=True) if s < 0}
            assert impacts.anti_friction(model) == pytest.approx(expected, rel=1e-9)
        if expected:
            assert check(lure, quick=True)["5.1"].verdict == "violated"
        seen.add(len(expected))
    assert seen >= {0, 1, 2}


@pytest.mark.parametrize(
    "model",
    [
        turned(relay(1), g=L),  # friction
        turned(equality(1)),  # held by either sign
        turned(relay(1), h=S + L),  # y has a part of l at once
        turned(relay(1), g=-(L - L)),
        ball(),
    ],
)
def test_nothing_is_called_anti_friction_that_is_none(model):
    assert impacts.anti_friction(model) == {}
    assert "anti-friction" not in simulate(model, t_end=0.1).summary_text()


def test_anti_friction_is_taken_at_the_start_with_its_input():
    u = ca.SX.sym("u")
    model = turned(relay(1), g=(0.5 - u) * L * (1 + S**2), inputs={u: table([0, 1], [2, 0])})
    assert impacts.anti_friction(model) == {"l": -3.0}


def test_anti_friction_of_parameters_is_that_of_their_values():
    k = ca.SX.sym("k")
    model = turned(relay(1), g=-k * L, parameters={k: 2.0})
    assert impacts.anti_friction(model) == {}
    assert simulate(model).summary()["anti_friction"] == {"l": -2.0}
    assert simulate(model, parameters={k: -2.0}).summary()["anti_friction"] == {}
    assert not sweep(model, grid={k: [1.0, 2.0]}, keep="x", workers=1).failures
