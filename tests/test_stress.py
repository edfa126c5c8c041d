"""Extreme cells against what was computed without the package, and `nsmodel stress`, which judges any model."""

from __future__ import annotations

import json
import sys
from collections import Counter
from copy import copy

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
from nsmodel.model.units import in_units
from nsmodel.stress import RIGHT, STOPPED, WRONG
from nsmodel.stress.judge import by_formulas

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
    own = by_formulas(model, run)
    assert own
    assert max(own.values()) <= 1, own
    amount = 1e-6 if getattr(model, "tolerances", None) is None else 1e-2  # an approximate projection may be off
    found = by_formulas(model, disturbed(run, amount))
    assert max(found.values()) > 1, found


def test_the_judge_finds_a_multiplier_that_breaks_the_law():
    model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[2, 1], t_end=6, step=0.05)
    run = simulate(model)
    slip = np.flatnonzero(run.index_set[1:, 0] != 0)[0] + 1
    run.arrays["multipliers"][slip] *= 0.9
    assert by_formulas(model.bind(), run)["law"] > 1


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


def test_a_motion_that_doubles_do_not_determine_is_not_called_right():
    """Spring 1e12 and steps of 1e3: the spring's two ends do not cancel, and what is left pushes both masses."""
    found = stress(weak(1e12))
    last = [cell for cell in found.cells if cell.factor == 1e3]
    assert all(cell.verdict != RIGHT for cell in last)


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


def test_a_model_without_a_step_asks_for_one():
    model = LureSystem(A=-1, B=1, C=1, law=relay(1), x0=1, t_end=1)
    with pytest.raises(UsageError, match="no time step"):
        stress(model)
    assert not stress(model, step=0.1).wrong


FILE = """
import casadi as ca
from nsmodel import SweepingProcess
def model(gap=0.5, n=2):
    t, q = ca.SX.sym("t"), ca.SX.sym("q", n)
    walls = {"left": q[0] + gap - t, "right": gap - t - q[0]}
    return SweepingProcess(t=t, q=q, q0=[0] * n, f=[1] * n, constraints=walls, t_end=1, step=1e-3, title="Walls")
"""


def test_the_command_line(tmp_path, capsys, monkeypatch):
    file = tmp_path / "walls.py"
    file.write_text(FILE)
    assert main(["stress", str(file), "--set", "gap=0.5", "--vary", "n=1,2", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "112:" in out
    assert "n = 1, own units" in out
    assert "oppose each other" in out
    assert (tmp_path / "out" / "stress.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "out" / "stress.json").read_text())["wrong"] == 0
    assert main(["stress", str(file), "--vary", "gap"]) == 2
    assert "expected NAME=V1,V2" in capsys.readouterr().err
    for name in ("EQUATION", "ROUNDING"):
        monkeypatch.setattr(sys.modules["nsmodel.stress.judge"], name, 0.0)
    assert main(["stress", str(file), "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["wrong"] > 0
    assert document["right"] + document["stopped"] + document["wrong"] == 56 == len(document["cells"])
