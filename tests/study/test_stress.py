"""Extreme cells against what was computed without the package, and `nsmodel stress`, which judges any model."""

from __future__ import annotations

import json
import sys
from collections import Counter
from copy import copy
from itertools import count
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import stress_scenes as scenes
from fuzz_models import COUNT, FULL

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    UsageError,
    ball,
    complementarity,
    polyhedron,
    product,
    relay,
    second_order_cone,
    simulate,
    stress,
)
from nsmodel.cli import main
from nsmodel.study.reference_steps import formula_residuals, majorant, state_term_sizes
from nsmodel.study.stress import LEFT_OUT, RIGHT, STOPPED, WRONG, stress_variants
from nsmodel.study.units import in_units

EPS = np.finfo(float).eps
T, X, LAM, S = (ca.SX.sym(name) for name in ("t", "x", "l", "s"))
X2, V2 = ca.SX.sym("x", 2), ca.SX.sym("y", 2)


# ---------------------------------------------------------------------------------------------- a thousand cells


@pytest.fixture(scope="module")
def outcomes():
    """Every cell of `stress_scenes`, run and judged."""
    return [scenes.outcome(cell) for cell in list(scenes.cells())[:: FULL // COUNT]]


def told(found):
    """Where cells stand, for a message."""
    return [(o.cell.scene, dict(o.cell.at), o.misfit, o.message) for o in found]


@pytest.mark.long
def test_a_thousand_cells_of_all_five_classes(outcomes):
    assert len(outcomes) >= 1000 * COUNT / FULL
    counts = Counter(o.cell.kind for o in outcomes)
    assert set(counts) == {"sweeping", "oscillator", "first order", "Lur'e", "inclusion"}
    assert min(counts.values()) >= 200 * COUNT / FULL
    assert sum(o.verdict == RIGHT for o in outcomes) >= 0.9 * len(outcomes)


def test_no_cell_is_wrong(outcomes):
    assert not told(o for o in outcomes if o.verdict == WRONG)


def test_only_cells_that_may_stop_do_and_say_why(outcomes):
    stopped = [o for o in outcomes if o.verdict == STOPPED]
    assert len(stopped) <= 0.1 * len(outcomes)
    assert not told(o for o in stopped if not o.cell.may_stop)
    assert not told(o for o in stopped if not all(words in o.message for words in o.cell.may_stop))


def test_walls_that_meet_stop_every_run(outcomes):
    assert all(o.verdict == STOPPED for o in outcomes if o.cell.scene == "closing walls")


def test_a_cell_that_is_off_by_a_little_is_found():
    """The judge of each scene sees an error of 1e-6 of the motion: the tolerances are no blank cheque."""
    for scene in scenes.SCENES:
        cell = max(
            (c for c in scene() if c.at["step"] == 1.0 and not c.may_stop), key=lambda c: c.at.get("unit", 1.0), default=None
        )
        if cell is None or "corner" in cell.scene:
            continue
        run = simulate(cell.model, step=cell.step, t_end=cell.steps * cell.step, parameters=cell.parameters)
        assert cell.judge(run) <= 1
        run.x[-1] += 1e-6 * np.abs(run.x - run.x[0]).max() or 1e-6 * np.abs(run.x[0]).max()
        assert cell.judge(run) > 1, cell.scene


def test_the_energy_of_a_stiff_oscillator_never_grows_at_steps_of_1000_periods():
    """w^2 = 1e8: with friction and without, the energy of each step is at most that of the one before."""
    cells = [c for c in scenes.spring() if c.at["stiffness"] == 1e8 and c.at["step"] == 1e3]
    assert len(cells) == 7
    for cell in cells:
        run = simulate(cell.model, step=cell.step, t_end=200 * cell.step, parameters=cell.parameters)
        x, v = run.x[:, 0], run.v[:, 0]
        E = v**2 / 2 + 1e8 * x**2 / 2
        assert np.all(E[1:] <= E[:-1] * (1 + 1e-13))


def test_a_blocked_rectifier_of_ratio_1e9_does_not_feel_the_step():
    """Blocked, v2 = v2(0) exp(-t/(R2 C2)), whatever the other capacitor does within 1e-9.

    The implicit step divides v2 by 1 + h/2: the same doubles with C1 = 1e-9 as with C1 = 1, for steps from 1e-12 to 1e2.
    """
    for h in 10.0 ** np.arange(-12, 4, 2.0):
        ends = []
        for C1 in (1e-9, 1.0):
            model = LureSystem(
                A=[[-1 / C1, 0], [0, -0.5]], B=[-1 / C1, 1], C=[-1, 1], D=1e-3, f=[-1 / C1, 0], law=complementarity(1),
                x0=[-1, 1], t_end=24 * h, step=h,
            )  # fmt: skip
            run = simulate(model)
            np.testing.assert_array_equal(run.multipliers[1:], 0)
            np.testing.assert_allclose(run.x[1:, 1], (1 + h / 2) ** -np.arange(1.0, 25), rtol=1e-13)
            np.testing.assert_allclose(run.x[1:, 0], -1, rtol=1e-12)
            ends.append(run.x[:, 1])
        np.testing.assert_array_equal(*ends)
        if h <= 1e-4:
            np.testing.assert_allclose(ends[0], np.exp(-h * np.arange(25) / 2), rtol=24 * h**2 + 1e-14)


# ---------------------------------------------------------------------------------------------- other units


def models():
    """One model for each thing that must be rewritten in other units."""
    disc = 1 - ca.sumsqr(X2)
    q = X2
    yield (
        "mean forcing",
        SweepingProcess(
            t=T,
            q=q,
            f=[ca.sin(5 * T), -1],
            constraints={"floor": q[1] + 0.1 * T},
            q0=[0, 0.3],
            mean_forcing=True,
            t_end=2,
            step=0.1,
        ),
    )
    yield "damping, constraints, two elements", FrictionOscillator(
        x=X2, potential=ca.sumsqr(X2) + ca.fabs(X2[0] - 0.2), friction={"a": ([[1, 1]], S + S**2), "b": ([[1, 0]], 0.1 * S)}, s=S,
        damping=[[0.3, 0.2], [-0.2, 0.1]], constraints={"wall": X2[1] + 0.4}, x0=[1, 0.5], v0=[0, -2], t_end=2, step=0.1,
    )  # fmt: skip
    yield "two positions", FrictionOscillator(x=X, potential=X**2, friction=S / 9, s=S, x0=2, x1=1.9, t_end=2, step=0.1)
    yield "no law", FirstOrderSystem(x=X, f=-X + ca.cos(X), x0=2, t_end=2, step=0.1, theta=0.5)
    yield "gamma, mass", FirstOrderSystem(
        x=X2, lam=LAM, f=[X2[1], -X2[0]], g=[0, 2 * LAM], h=X2[1] + 0.1 * LAM, M=[[1, 0], [0, 2]], law=relay(1), lam0=0.5,
        x0=[1, 1], gamma=0.5, theta=0.5, t_end=2, step=0.1,
    )  # fmt: skip
    eye = np.eye(5)
    two = eye[:2, :2]
    yield "no rate", LureSystem(A=0 * two, B=two, C=two, law=relay(2), x0=[1, -2], t_end=2, step=0.1)
    triangle = polyhedron([[1, 0], [0, 1], [-1, -1]], [-1, -1, -1])
    yield "ball, cone", LureSystem(
        A=-eye, B=eye, C=eye, law=product(ball(2, 0.3), second_order_cone(3)), x0=[1, -2, -1, 1, 0.5], f=[ca.sin(T), 0, -1, 0, 0],
        t=T, t_end=2, step=0.1,
    )  # fmt: skip
    yield "polyhedron", LureSystem(A=-two, B=two, C=two, law=triangle, x0=[1, -2], t_end=2, step=0.1)
    phi = ca.norm_2(V2) / 2 + ca.fmax(V2[0], 0)
    yield "phi", LureSystem(A=-two, B=two, C=two, y=V2, phi=phi, x0=[1, -2], t_end=2, step=0.1)
    yield "signs, disc", MonotoneInclusion(
        x=X2, field=[1 - X2[1], X2[0]], operator=[0.3 * ca.sign(X2[0] + 0.2), X2[1]], constraints={"disc": disc}, x0=[0.1, 0],
        t_end=2, step=0.1,
    )  # fmt: skip
    yield "phi of an inclusion", MonotoneInclusion(
        x=X2, field=[0.7, -X2[0]], phi=ca.if_else(X2[0] <= 1, ca.norm_1(X2) / 3 + ca.sumsqr(X2), ca.inf), x0=[0.5, 0.4], lower=-2,
        tolerances=1e-6, t_end=2, step=0.1,
    )  # fmt: skip


MODELS = dict(models())


@pytest.mark.parametrize("name", MODELS)
def test_other_units_give_the_same_motion(name):
    model = MODELS[name].bind()
    own = simulate(model)
    for u, tau in ((1e-9, 1.0), (1e9, 1.0), (1.0, 1e-9), (1e9, 1e9)):
        run = simulate(in_units(model, u, tau))
        size = np.abs(own.x).max()
        np.testing.assert_allclose(run.x / u, own.x, rtol=0, atol=1e-7 * size)
        np.testing.assert_allclose(run.t / tau, own.t, rtol=1e-12)


# ---------------------------------------------------------------------------------------------- the judge


def disturbed(run, amount, rows=slice(5, 6)):
    """The same run with some states off by a part of the motion, and what hangs on them left as it is."""
    other = copy(run)
    object.__setattr__(other, "arrays", {name: array.copy() for name, array in run.arrays.items()})
    motion = np.abs(run.x - run.x[0]).max()
    other.arrays["x"][rows] += amount * motion
    if "v" in other.arrays and run.metadata["model_class"] == "FrictionOscillator":
        other.arrays["v"][rows] += amount * np.abs(run.v[1:]).max()
    return other


@pytest.mark.parametrize("name", MODELS)
def test_the_judge_accepts_a_run_and_finds_an_error_of_a_millionth(name):
    model = MODELS[name].bind()
    run = simulate(model)
    own = formula_residuals(model, run)
    assert own
    assert max(own.values()) <= 1, own
    amount = 1e-6 if getattr(model, "tolerances", None) is None else 1e-2  # an approximate projection may be off
    found = formula_residuals(model, disturbed(run, amount))
    assert max(found.values()) > 1, found


def test_the_judge_finds_a_multiplier_that_breaks_the_law():
    model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[2, 1], t_end=6, step=0.05)
    run = simulate(model)
    slip = np.flatnonzero(run.index_set[1:, 0] != 0)[0] + 1
    run.arrays["multipliers"][slip] *= 0.9
    assert formula_residuals(model.bind(), run)["law"] > 1


# ---------------------------------------------------------------------------------------------- nsmodel.stress


def weak(k=1.0):
    """Two masses tied by a spring, in absolute positions."""
    return LureSystem(
        A=[[0, 1, 0, 0], [-k, 0, k, 0], [0, 0, 0, 1], [k, 0, -k, 0]], B=[[0, 0], [1, 0], [0, 0], [0, 1]],
        C=[[0, 1, 0, 0], [0, 0, 0, 1]], law=relay(2), f=[0, 2, 0, 0], x0=[1, 0, -1, 0], t_end=1, step=1, title="Two masses",
    )  # fmt: skip


def test_a_sound_model_is_right_in_every_cell():
    found = stress(weak())
    assert len(found.cells) == 56
    assert found.count(RIGHT) == 56
    assert not found.wrong
    checks = set().union(*(cell.checks for cell in found.cells))
    assert {"formula: equation", "formula: law", "other units", "solver daqp alone", "along: contraction"} <= checks
    text = found.text()
    assert "56: 56 right, 0 stopped, 0 wrong" in text
    assert "state x 1e-09, time x 1e+09" in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_motion_that_doubles_do_not_determine_is_not_called_right(monkeypatch):
    """Spring 1e12 and steps of 1e3: the spring's two ends do not cancel, and what is left pushes both masses."""
    monkeypatch.setattr(sys.modules["nsmodel.study.stress"], "STEP_FACTORS", (1e3,))
    found = stress(weak(1e12))
    assert {cell.factor for cell in found.cells} == {1e3}
    assert all(cell.verdict != RIGHT for cell in found.cells)


@pytest.mark.long
def test_a_run_that_must_stop_is_stopped_and_says_why():
    walls = SweepingProcess(
        t=T, q=X, q0=0.1, constraints={"left": X + 0.5 - T, "right": 0.5 - T - X}, t_end=1, step=0.01, title="Walls"
    )
    found = stress(walls)
    stopped = [cell for cell in found.cells if cell.verdict == STOPPED]
    assert not found.wrong
    assert {cell.factor for cell in stopped} == {10.0, 1e3}
    assert all("'left'" in cell.message and "oppose" in cell.message for cell in stopped)
    assert "Stopped" in found.text()


@pytest.mark.long
def test_parameters_are_varied_in_all_combinations():
    k, a = ca.SX.sym("k"), ca.SX.sym("a")
    model = FrictionOscillator(
        x=X, potential=k * X**2 / 2, friction=a * S, s=S, x0=1, v0=-3, t_end=1, step=0.1, parameters={k: None, a: 1}
    )
    found = stress(model, vary={"k": [1e8], "a": [0.1, 1e12]})
    assert len(found.cells) == 2 * 56
    assert not found.wrong
    assert found.rows[0] == "k = 1e+08, a = 0.1, own units"
    assert {tuple(cell.values.values()) for cell in found.cells} == {(1e8, 0.1), (1e8, 1e12)}
    with pytest.raises(UsageError, match=r"parameter 'k' has no value"):
        stress(model)
    with pytest.raises(UsageError, match=r"vary: k = 'x'"):
        stress(model, vary={"k": "x"})
    with pytest.raises(UsageError, match=r"parameter 'm' is not declared"):
        stress(model, vary={"m": [1]})


@pytest.mark.parametrize(
    ("options", "words"), [({"step": -1}, "step = -1"), ({"steps": 2}, "steps = 2"), ({"step": "1"}, "step = '1'")]
)
def test_wrong_arguments_are_refused(options, words):
    with pytest.raises(UsageError, match=words):
        stress(weak(), **options)
    with pytest.raises(UsageError, match="expected a model"):
        stress("model.py")


def test_a_model_without_a_step_asks_for_one(monkeypatch):
    monkeypatch.setattr(sys.modules["nsmodel.study.stress"], "STEP_FACTORS", (1.0, 10.0))
    model = LureSystem(A=-1, B=1, C=1, law=relay(1), x0=1, t_end=1)
    with pytest.raises(UsageError, match="no time step"):
        stress(model)
    assert not stress(model, step=0.1).wrong


def test_a_budget_leaves_out_the_cells_that_it_has_no_time_for(monkeypatch):
    """On a clock that ticks when it is read, a cell takes one tick: five begin before the tenth."""
    clock = SimpleNamespace(perf_counter=count().__next__)
    monkeypatch.setattr(sys.modules["nsmodel.study.stress"], "time", clock)
    found = stress(weak(), steps=3, budget=10)
    run = [cell for cell in found.cells if cell.verdict != LEFT_OUT]
    assert [(cell.verdict, cell.factor) for cell in run] == [(RIGHT, 1.0)] * 5
    assert found.count(LEFT_OUT) == 51
    assert not found.wrong
    text = found.text()
    assert "56: 5 right, 0 stopped, 0 wrong, 51 left out" in text
    assert "51 cells were left out for the time budget" in text
    assert found.document()["left out"] == 51
    assert found.plot() is not None
    for budget in (0, -1, float("nan"), "a"):
        with pytest.raises(UsageError, match=r"budget = .*; expected a finite number > 0"):
            stress(weak(), budget=budget)


FILE = """
import casadi as ca
from nsmodel import SweepingProcess
def model(gap=0.5, n=2):
    t, q = ca.SX.sym("t"), ca.SX.sym("q", n)
    walls = {"left": q[0] + gap - t, "right": gap - t - q[0]}
    return SweepingProcess(t=t, q=q, q0=[0] * n, f=[1] * n, constraints=walls, t_end=1, step=1e-3, title="Walls")
"""


@pytest.mark.long
def test_the_command_line(tmp_path, capsys, monkeypatch):
    file = tmp_path / "walls.py"
    file.write_text(FILE)
    monkeypatch.setitem(stress_variants.__kwdefaults__, "steps", 3)
    assert main(["stress", str(file), "--set", "gap=0.5", "--vary", "n=1,2", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "112:" in out
    assert "n = 1, own units" in out
    assert "oppose each other" in out
    assert (tmp_path / "out" / "stress.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "out" / "stress.json").read_text())["wrong"] == 0
    assert main(["stress", str(file), "--budget", "0"]) == 2
    assert "budget = 0; expected a finite number > 0" in capsys.readouterr().err
    assert main(["stress", str(file), "--budget", "1e-9"]) == 0
    assert "56: 0 right, 0 stopped, 0 wrong, 56 left out" in capsys.readouterr().out
    assert main(["stress", str(file), "--vary", "gap"]) == 2
    assert "expected NAME=V1,V2" in capsys.readouterr().err
    for module in ("nsmodel.study.reference_steps", "nsmodel.models.sweeping_process.reference_steps"):
        for name in ("EQUATION", "ROUNDING"):
            monkeypatch.setattr(sys.modules[module], name, 0.0)
    assert main(["stress", str(file), "--set", "n=1", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["wrong"] > 0
    assert document["right"] + document["stopped"] + document["wrong"] == 56 == len(document["cells"])


# ---------------------------------------------------------------------------------------------- at rest, ill-balanced, random


def blocks(ratio, kind="speeds"):
    """Two blocks at rest, one on the other, the upper one ``ratio`` times as heavy."""
    g = 9.81
    law = {"law": complementarity(2), "t_end": 1, "step": 1e-2}
    if kind == "forces":
        x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
        weights, pushes = [-g, -ratio * g], [l[0] - l[1], l[1]]
        return FirstOrderSystem(x=x, lam=l, M=[[1, 0], [0, ratio]], f=weights, g=pushes, h=[x[0], x[1] - x[0]], x0=[0, 0], **law)
    if kind == "positions":
        return LureSystem(
            A=[[0, 1, 0, 0], [0] * 4, [0, 0, 0, 1], [0] * 4], B=[[0, 0], [1, -1], [0, 0], [0, 1 / ratio]],
            C=[[0, 1, 0, 0], [0, -1, 0, 1]], f=[0, -g, 0, -g], x0=[0, 0, 1, 0], **law,
        )  # fmt: skip
    return LureSystem(A=np.zeros((2, 2)), B=[[1, -1], [0, 1 / ratio]], C=[[1, 0], [-1, 1]], f=[-g, -g], x0=[0, 0], **law)


def walls():
    """A point between discs that close: they nearly oppose each other where they meet it, and it gets out of their way."""
    q, a = ca.SX.sym("q", 2), 1.1 - T
    discs = {"left": ca.norm_2(q - ca.vertcat(-a, 0)) - 1, "right": ca.norm_2(q - ca.vertcat(a, 0)) - 1}
    return SweepingProcess(t=T, q=q, f=[0, 0], constraints=discs, q0=[0, -3e-2], t_end=0.6, step=1e-3)


BALANCED = {
    **{f"{kind}, {ratio:g}": blocks(ratio, kind) for kind in ("speeds", "forces", "positions") for ratio in (1.0, 1e6, 1e-6)},
    "walls": walls(),
}


def found_in(model, run, part):
    """The worst misfit after an error of a part of what moves or acts in the run."""
    size = max(np.abs(run.x - run.x[0]).max(), state_term_sizes(model, run).max())
    other = copy(run)
    object.__setattr__(other, "arrays", {name: array.copy() for name, array in run.arrays.items()})
    other.arrays["x"][5] += part * size
    if isinstance(model, FrictionOscillator):
        other.arrays["v"][5] += part * size / run.step[5]
    return max(formula_residuals(model, other).values())


@pytest.mark.parametrize("name", BALANCED)
def test_what_balances_is_judged_by_what_acts(name):
    """At rest nothing moves, and the scale is what acts; an error of 1e-7 of that is seen, in any unit."""
    model = BALANCED[name].bind()
    h = 10 * model.step if name == "walls" else model.step
    for u, tau in ((1.0, 1.0), (1e9, 1.0), (1e-9, 1e9)):
        there = in_units(model, u, tau)
        run = simulate(there, step=h * tau, t_end=24 * h * tau, compiled=False)
        assert max(formula_residuals(there, run).values()) <= 1
        assert found_in(there, run, 1e-7) > 1


@pytest.mark.parametrize("name", ["forces, 1", *(["forces, 1e+06", "positions, 1e+06"] if COUNT == FULL else [])])
@pytest.mark.long
def test_every_cell_of_what_rests_is_right(name):
    found = stress(BALANCED[name])
    assert found.count(RIGHT) == 56, found.text()


def test_the_majorant_is_the_sum_of_the_sizes_of_all_terms():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    at = {x: 3.0, y: -2.0}
    for expression, size in (
        (x, 3.0), (x - 5, 8 + 2), (2 * x, 6 + 6), (x * y, 6 + 6 + 6), (x + y, 5 + 1), (ca.fabs(y), 2 + 2),
        (ca.fmax(x, y), 3 + 3), (ca.if_else(x > 0, x, y), None), (ca.SX(4), 4),
    ):  # fmt: skip
        value = float(ca.substitute(majorant(expression), ca.vertcat(*at), ca.vertcat(*at.values())))
        assert value == pytest.approx(size) if size else value >= abs(at[x])
    assert majorant(ca.SX.zeros(2, 3)).shape == (2, 3)


def random_model(kind, rng):
    """A model of a class with sizes of all kinds: units, masses, weights, starts at rest or not."""
    n = int(rng.integers(1, 5))
    m, u, ratio, h = int(rng.integers(1, n + 1)), 10 ** rng.uniform(-6, 6), 10 ** rng.uniform(-3, 3, n), 10 ** rng.uniform(-4, -1)
    x, l, t = ca.SX.sym("x", n), ca.SX.sym("l", m), ca.SX.sym("t")
    A, B = rng.normal(size=(n, n)) * ratio[:, None], rng.normal(size=(n, m))
    f, x0 = u * 10 ** rng.uniform(-2, 2) * rng.normal(size=n), u * rng.normal(size=n) * (rng.uniform() < 0.7)
    law = (relay(m, -u, u), complementarity(m), ball(m, u))[rng.integers(3)]
    grid = {"t_end": 24 * h, "step": h}
    if kind is LureSystem:
        forced = ca.DM(f) * (1 + ca.sin(t / h / 9))
        return LureSystem(t=t, A=A, B=B, C=B.T, f=forced, law=law, x0=x0, theta=rng.choice([0.5, 1]), **grid)
    if kind is FirstOrderSystem:
        rate, M = A @ x + ca.DM(ratio * f), np.diag(ratio)
        return FirstOrderSystem(x=x, lam=l, M=M, f=rate, g=ca.DM(B) @ l, h=ca.DM(B.T) @ x, law=law, x0=x0, **grid)
    if kind is SweepingProcess:
        rows = {f"g{i}": ca.dot(ca.DM(rng.normal(size=n)), x) + u * rng.uniform() * (rng.uniform() < 0.7) for i in range(m)}
        return SweepingProcess(q=x, f=f, constraints=rows, q0=np.zeros(n), **grid)
    if kind is FrictionOscillator:
        R, y = rng.normal(size=(n, n)), x - ca.DM(u * rng.normal(size=n))
        g, theta = 10 ** rng.uniform(-3, 3) * ca.sumsqr(ca.DM(R) @ y) / 2, S * u * 10 ** rng.uniform(-2, 2)
        return FrictionOscillator(
            x=x, potential=g, friction=theta, s=S, x0=x0, v0=u * rng.normal(size=n) * (rng.uniform() < 0.5), **grid
        )
    reach = abs(x0) + 0.5 * u
    return MonotoneInclusion(x=x, field=ca.DM(f) - x, lower=-reach, upper=reach, x0=x0, **grid)


@pytest.mark.parametrize("kind", [SweepingProcess, FrictionOscillator, FirstOrderSystem, LureSystem, MonotoneInclusion])
def test_random_models_are_right_and_their_errors_are_seen(kind):
    count, unsolvable, seen = max(4, 200 * COUNT // FULL), [], 0
    for seed in range(count):
        model = random_model(kind, np.random.default_rng(seed)).bind()
        try:
            run = simulate(model, compiled=False)
        except StepError as error:  # a rate that grows within a step, and a law that does not allow it
            unsolvable.append(str(error))
            continue
        own = formula_residuals(model, run)
        assert max(own.values()) <= 1, (seed, own)
        size = max(np.abs(run.x - run.x[0]).max(), state_term_sizes(model, run).max())
        if (1e-7 * size > 64 * EPS * np.abs(run.x[5])).all():  # else rounding hides the error
            assert found_in(model, run, 1e-7) > 1, seed
            seen += 1
    assert seen >= 0.9 * count
    assert len(unsolvable) <= count / 50
    assert all("the step has no solution: W is not psd" in message for message in unsolvable)
