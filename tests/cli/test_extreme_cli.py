"""The command line on scenes that must stop or warn: the exit status, the cause in words, and what was computed is kept."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nsmodel import StepError, Trajectory, load, simulate
from nsmodel.cli import main

NOT_UNIQUE = "uniqueness of the solution is not guaranteed"

HEAD = """
import casadi as ca
import numpy as np
from nsmodel import *
t, q, z, x, l, s, k = (ca.SX.sym(*args) for args in (["t"], ["q", 2], ["z", 2], ["x"], ["l"], ["s"], ["k"]))
b = 1 + 3 * ca.cos(z[1]) ** 2 - 6 * ca.sin(z[1]) * ca.cos(z[1])
rod = {"x": z, "lam": l, "h": z[0], "g": [b * l, 0], "law": complementarity(1), "x0": [0, 0.2], "t_end": 0.45, "step": 0.01}
a = 1.05 - t
door = {"right": ca.norm_2(q - ca.vertcat(a, 0)) - 1, "left": ca.norm_2(q + ca.vertcat(a, 0)) - 1}
grid = {"t_end": 1, "step": 0.0625}
"""
MODELS = {
    "rod": "FirstOrderSystem(f=[-9.81, 2], **rod)",
    "lifted rod": "FirstOrderSystem(f=[9.81, 2], **rod)",
    "walls": "SweepingProcess(t=t, q=q, constraints={'west': q[0] + 0.5 - t, 'east': 0.5 - t - q[0]}, q0=[0.3, 0], **grid)",
    "door": "SweepingProcess(t=t, q=q, constraints=door, q0=[0, 0], t_end=1, step=0.01)",
    "root": "SweepingProcess(t=t, q=x, f=1, constraints={'root': ca.sqrt(0.35 - t) + 1 - x}, q0=0, **grid)",
    "outside": "SweepingProcess(q=q, constraints={'disc': ca.norm_2(q) - 1}, q0=[0.5, 0], **grid)",
    "reversed": "LureSystem(A=-1, B=1, C=1, law=box(2, 1), x0=1, **grid)",
    "shapes": "LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1, 2], C=[0, 1], law=relay(1), x0=[3, 0], **grid)",
    "undeclared": "SweepingProcess(q=q, f=[-k, 0], constraints={'wall': q[0] + 1}, q0=[0, 0], **grid)",
    "parameter": "SweepingProcess(q=q, f=[-k, 0], constraints={'wall': q[0] + 1}, q0=[0, 0], parameters={k: 1}, **grid)",
    "anti-relay": "LureSystem(A=0, B=-1, C=1, law=relay(1), x0=0.5, **grid)",
    "falling friction": "FrictionOscillator(x=x, potential=x**2, friction=s - s**2, s=s, x0=0.1, t_end=0.2, step=0.1)",
    "flat": "SweepingProcess(q=q, f=[1, 0], constraints={'flat': ca.dot(q, q)}, q0=[0, 0], **grid)",
}


@pytest.fixture(name="scene")
def make_scene(tmp_path, monkeypatch, capfd):
    """Return scene(name, command, *options) -> (status, stdout, stderr) of a model above, in an empty working directory."""
    monkeypatch.chdir(tmp_path)

    def run(name, command, *options):
        Path("scene.py").write_text(f"{HEAD}model = {MODELS[name]}\n")
        return main([command, "scene.py", *options]), *capfd.readouterr()

    return run


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rod", ["to have no solution", "W is not psd", "from t = 0.22 to 0.23"]),
        ("walls", ["'west' (weight 0.5)", "'east' (weight 0.5)", "oppose each other", "from t = 0.5 to 0.5625"]),
        ("door", ["'left' (weight 0.5)", "'right' (weight 0.5)", "oppose each other", "from t = 0.05 to 0.06"]),
        ("root", ["'root'", "not a finite number", "from t = 0.3125 to 0.375"]),
    ],
)
def test_a_scene_that_must_stop_exits_with_3_and_keeps_its_rows(scene, name, words):
    status, out, err = scene(name, "run", "--out", "kept")
    assert status == 3
    for word in words:
        assert word in err
    assert "failed" in out
    with pytest.raises(StepError) as caught:
        simulate(load("scene.py"))
    kept, expected = Trajectory.load("kept/trajectory.npz"), caught.value.trajectory
    assert kept.status == "failed"
    assert f"{len(kept)} verified steps are saved in kept/trajectory.npz" in err
    for key, array in expected.arrays.items():
        np.testing.assert_array_equal(kept.arrays[key], array)
    document = json.loads(Path("kept/summary.json").read_text())
    assert document["message"] in err
    assert document["steps"] == len(kept) > 0


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("outside", [], ["'disc' = -0.5 < 0 at the start q0 = (0.5, 0)", "move it"]),
        ("reversed", [], ["2", "1", "lower"]),
        ("shapes", [], ["B", "(3, 1)"]),
        ("undeclared", [], ["k", "parameters"]),
        ("parameter", ["--set", "k=nan"], ["k", "nan"]),
        ("parameter", ["--set", "wall=1"], ["wall", "k"]),
        *(("walls", [f"{option}={value}"], [option.strip("-").replace("-", "_"), value])
          for option in ("--step", "--t-end") for value in ("0", "-0.1", "nan", "inf")),
    ],
)  # fmt: skip
def test_a_wrong_model_or_step_exits_with_2_and_leaves_nothing(scene, name, options, words):
    status, out, err = scene(name, "run", "--out", "kept", *options)
    assert (status, out) == (2, "")
    for word in words:
        assert word in err
    assert len(err.splitlines()) == 1
    assert not Path("kept/trajectory.npz").exists()


@pytest.mark.parametrize(
    ("name", "words", "violated"),
    [
        ("lifted rod", [NOT_UNIQUE], "F-mlcp"),
        ("anti-relay", [NOT_UNIQUE], "5.1"),
        ("falling friction", ["theta of 'friction' decreases"], "O-theta"),
        ("flat", ["'flat' has a zero gradient at q0"], "A1"),
    ],
)
def test_a_scene_whose_hypotheses_fail_runs_with_a_warning_and_the_strict_check_exits_with_1(scene, name, words, violated):
    status, out, err = scene(name, "run", "--quiet")
    assert (status, out) == (0, "")
    for word in words:
        assert word in err
    status, out, _ = scene(name, "check", "--strict")
    assert status == 1
    assert any(line.split()[:2] == [violated, "violated"] for line in out.splitlines())


def test_the_check_of_a_start_outside_the_set_reports_it(scene):
    status, out, _ = scene("outside", "check", "--strict")
    assert status == 1
    assert any(line.split()[:2] == ["S-start", "violated"] for line in out.splitlines())
