"""The C of models with inputs: the bits of `simulate`, lengths of steps, jumps, what is refused, the example of a library."""

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import input_scenes as scenes
import numpy as np
import pytest
from conftest import optimised

from nsmodel import FirstOrderSystem, LureSystem, codegen, load, pwm, relay, simulate, stepper, table
from nsmodel.cli import main
from nsmodel.errors import CodegenError, UsageError

T = scenes.T
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZE = (optimised("-O1"), "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CC = next((name for name in ("gcc", "cc", "clang") if shutil.which(name)), "")
pytestmark = pytest.mark.skipif(not CC, reason="no C compiler")
OK, NOT_SOLVED, NOT_FINITE, BAD_STEP = 0, 1, 2, 3


def kept_by_l(gamma, signal, **fields):
    """x' = u - x - l with l = 2 u: a reaction that jumps where u does."""
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    given = {"step": 0.05, "t_end": 2} | fields
    return FirstOrderSystem(
        x=x, lam=l, f=[u - x], g=[-l], h=[l - 2 * u], law=relay(1, -1e9, 1e9), x0=[0.5], theta=0.5, gamma=gamma,
        inputs={u: signal}, **given,
    )  # fmt: skip


def two_inputs():
    """A mass on a spring and a rough floor, with a force and a pull as a vector, and a brake."""
    w, brake = ca.SX.sym("w", 2), ca.SX.sym("brake")
    profile = table([0, 0.31, 0.31, 1], [[0, 0], [1, 8], [-1, 3], [0, 0]], "linear")
    return LureSystem(
        A=[[0, 1], [-4, 0]], B=[0, 1], C=[0, 1], f=[0 * w[0], w[1] - w[0] * (1 - brake)], law=relay(1), x0=[1, 0], theta=0.5,
        t_end=1, step=0.01, inputs={w: profile, brake: pwm(0.17, 0.4)},
    )  # fmt: skip


RISING: Any = table(T * np.arange(40), np.linspace(0.1, 0.9, 40))
JUMPS = table([0, 0.33, 1.1], [1, -2, 4])
SCENES = {
    "one length": scenes.buck,
    "discontinuous": lambda: scenes.buck(100.0),
    "two lengths": lambda: scenes.buck(step=T / 7.3),
    "changing duty": lambda: scenes.buck(duty=RISING, t_end=40 * T),
    "drive cycle": lambda: scenes.drive_cycle(step=5e-3),
    "boost": lambda: scenes.boost(t_end=3e-4),
    "two inputs": two_inputs,
    "carried": lambda: kept_by_l(0.5, JUMPS),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return written(scene) -> its library in Python, in whose folder it is called "thing"."""
    base, kept = tmp_path_factory.mktemp("inputs"), {}

    def write(name):
        if name not in kept:
            codegen.write(SCENES[name](), base / name.replace(" ", "_"), name="thing")
            kept[name] = codegen.load(base / name.replace(" ", "_"))
        return kept[name]

    return write


def walked(solver, run):
    """The states of a solver that is given the times, lengths and inputs of a run's steps."""
    rows = []
    for k in range(len(run.t) - 1):
        done = solver.set_time(run.t[k]), solver.set_step(run.step[k + 1])
        assert (*done, solver.set_inputs_between(run.inputs_begin[k + 1], run.inputs[k + 1]), solver.step()) == (OK,) * 4
        rows.append([*solver.x, *solver.multipliers, solver.residual])
    return np.array(rows)


@pytest.mark.parametrize("name", SCENES)
def test_the_bits_are_those_of_simulate(name, written):
    library, run = written(name), simulate(SCENES[name](), compiled=True)
    assert not run.metadata["warnings"] or name == "boost"
    rows, model = walked(library.solver(), run), SCENES[name]()
    np.testing.assert_array_equal(rows, np.column_stack([run.x, run.multipliers, run.residual])[1:])
    if name in ("changing duty", "two inputs", "carried"):  # of the others the truth is known
        np.testing.assert_allclose(rows[:, : run.x.shape[1]], simulate(model, compiled=False).x[1:], rtol=1e-9, atol=1e-12)


def test_against_the_exact_map(written):
    for name, R in (("one length", 5.0), ("discontinuous", 100.0), ("two lengths", 5.0)):
        run, right = simulate(SCENES[name](), compiled=True), scenes.exact_buck(200, R)
        at = [np.abs(run.t - k * T).argmin() for k in range(1, 201)]
        off = np.abs(walked(written(name).solver(), run)[np.array(at) - 1, :2] - right[1:]).max(axis=0)
        assert (off <= 1e-3 * np.abs(right).max(axis=0) * (2 if name == "two lengths" else 1)).all()


def test_a_few_lengths_are_formed_once(written):
    """Twice in two hundred periods, when the solver is made: then no step solves more systems than its index sets."""
    library = written("two lengths")
    assert library.about["lengths"] == pytest.approx([0.4 * T / 3, 0.6 * T / 5], rel=1e-12)
    assert "matrices written down as numbers for one time step" in written("one length").about["used"]
    solver, run = library.solver(), simulate(SCENES["two lengths"](), compiled=True)
    work = []
    for k in range(len(run.t) - 1):
        solver.set_step(run.step[k + 1] * (1 + 1e-13 * (-1) ** k))  # the same length, to 1e-12
        solver.set_inputs(run.inputs[k + 1])
        assert solver.step() == OK
        work.append(solver.work)
    assert max(work) <= 4
    assert np.bincount(work)[1] > 0.95 * len(work)
    assert solver.t == pytest.approx(200 * T, rel=1e-11)
    assert solver.set_step(T / 9) == OK
    assert (solver.step(), solver.work) == (OK, 2)  # and its matrices
    assert (solver.set_step(0.4 * T / 3), solver.step(), solver.work) == (OK, OK, 1)


def test_the_lengths_used_last_are_kept(tmp_path):
    codegen.write(scenes.buck(), tmp_path, name="thing", step=[T / 20, T / 10])
    solver = codegen.load(tmp_path).solver()
    lengths = T / np.arange(10, 18)  # T/10 is known, and T/20 is now the length used least lately
    formed = []
    for h in [*lengths, *lengths, T / 20, T / 10, T / 11, *lengths[2:]]:
        solver.set_inputs(1.0)
        assert (solver.set_step(h), solver.step()) == (OK, OK)
        formed.append(solver.work > 1)
    assert formed[:16] == [False, *[True] * 7, *[False] * 8]
    assert formed[16:18] == [True, True]  # T/20 took the place of T/10, that one of T/11, ...
    fresh = codegen.load(tmp_path).solver()
    x, t = solver.x, solver.t
    for s in (solver, fresh):
        assert (s.set_state(x), s.set_time(t), s.set_step(T / 13), s.set_inputs(0.0)) == (OK,) * 4
        assert s.step() == OK
    np.testing.assert_array_equal(fresh.x, solver.x)  # whatever was kept before


@pytest.mark.parametrize("case", ["friction_chain", "diode_bridge"])
def test_steps_of_many_lengths(case, request):
    """More than are kept, of laws with few index sets and with many."""
    model = load(case)
    parts = [1, 1, 0.5, 0.25, 2, 2, 0.5, 1.5, 1, 3, 0.7, 0.8, 0.9, 1.1, 1.2, 1.3, 1]
    lengths = [part * model.step for part in 3 * parts]
    run, right = (simulate(model, steps=lengths, compiled=compiled) for compiled in (True, False))
    assert any(line.startswith("steps in C") for line in run.metadata["used"])
    assert {"enumeration", "last index set", "index set"} >= run.metadata["solver_counts"].keys()
    np.testing.assert_allclose(run.x, right.x, rtol=0, atol=1e-12 * np.abs(right.x).max())


def test_limits_of_inputs(written):
    solver = written("drive cycle").solver()
    assert solver.inputs.tolist() == [0]
    assert (solver.set_inputs_between([1.5], [2.5]), solver.inputs.tolist()) == (OK, [1.5])
    assert (solver.step(), solver.inputs.tolist()) == (OK, [2.5])
    held = written("drive cycle").solver()
    held.set_state(solver.x)
    held.set_time(solver.t)
    held.set_inputs(2.5)
    for _ in range(3):  # those after it have the inputs of its end
        assert solver.step() == held.step() == OK
        np.testing.assert_array_equal(solver.x, held.x)
    assert (solver.reset(), solver.inputs.tolist()) == (OK, [0])
    with pytest.raises(CodegenError, match="inputs: 2 numbers given; expected 1"):
        solver.set_inputs([1, 2])
    with pytest.raises(CodegenError, match="inputs: 3 numbers given; expected 1"):
        solver.set_inputs_between([1], [1, 2, 3])


@pytest.mark.parametrize("name", ["one length", "two inputs", "boost", "carried"])
def test_what_is_no_number_changes_nothing(name, written):
    solver = written(name).solver()
    nu = solver.inputs.size
    assert (solver.set_inputs(np.linspace(0.2, 0.5, nu)), solver.step()) == (OK, OK)
    before = solver.x, solver.inputs, solver.t
    for bad in (np.nan, np.inf, -np.inf):
        for i in range(nu):
            u = np.ones(nu)
            u[i] = bad
            assert solver.set_inputs(u) == solver.set_inputs_between(u, np.ones(nu)) == NOT_FINITE
            assert solver.set_inputs_between(np.ones(nu), u) == NOT_FINITE
    for now, then in zip((solver.x, solver.inputs, solver.t), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_a_reaction_is_found_anew_after_a_jump(written):
    """x' = -u - x by the trapezoidal rule, whatever u was before; a reaction that is given is taken as it is."""
    solver, h, right = written("carried").solver(), 0.05, 0.5
    solver.set_step(h)
    for u in np.random.default_rng(4).normal(size=50):
        assert (solver.set_inputs(u), solver.step()) == (OK, OK)
        right = ((1 - h / 2) * right - h * u) / (1 + h / 2)
        assert solver.x[0] == pytest.approx(right, rel=1e-12)
        assert solver.force[0] == pytest.approx(-2 * u, rel=1e-12)
    assert (solver.set_inputs(3.0), solver.set_force([-5.0]), solver.step()) == (OK, OK, OK)
    assert solver.x[0] == pytest.approx(((1 - h / 2) * right + h * (3 - 5.5)) / (1 + h / 2), rel=1e-12)


def test_a_jump_that_fails_leaves_the_reaction(tmp_path):
    """l = 2 u is beyond the bounds of a relay at u = 9, where l stays at its end; with u/(u - 1) there is none at u = 1."""
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    model = FirstOrderSystem(
        x=x, lam=l, f=[-x], g=[-l], h=[l - u / (u - 1)], law=relay(1, -9, 9), x0=[1], theta=0.5, gamma=0.5, step=0.1, t_end=1,
        inputs={u: 0.5},
    )  # fmt: skip
    codegen.write(model, tmp_path, name="thing")
    solver = codegen.load(tmp_path).solver()
    assert solver.step() == OK
    before = solver.x, solver.force, solver.t
    solver.set_inputs(1.0)
    assert solver.step() != OK
    for now, then in zip((solver.x, solver.force, solver.t), before, strict=True):
        np.testing.assert_array_equal(now, then)
    assert (solver.set_inputs(0.5), solver.step()) == (OK, OK)
    other = codegen.load(tmp_path).solver()
    assert [other.step(), other.step()] == [OK, OK]
    np.testing.assert_array_equal(solver.x, other.x)


def test_a_reaction_that_a_step_of_no_length_does_not_tell_is_refused(tmp_path):
    x, l, u = ca.SX.sym("x", 2), ca.SX.sym("l"), ca.SX.sym("u")
    model = FirstOrderSystem(
        x=x, lam=l, f=[-x[0], x[1] - u], g=[l, 0], h=[x[0] + l], law=relay(1), M=[[1, 0], [0, 0]], x0=[0, 0], theta=0.5,
        gamma=0.5, step=0.1, t_end=1, inputs={u: 0},
    )  # fmt: skip
    with pytest.raises(CodegenError, match=r"found by a step of length 0, whose matrix is singular: take gamma=1"):
        codegen.write(model, tmp_path)


def test_a_budget_while_it_runs(written):
    solver, other = written("discontinuous").solver(), written("discontinuous").solver()
    refused = 0
    for k in range(1200):
        u = 1.0 if k % 20 < 8 else 0.0
        for s in (solver, other):
            s.set_inputs(u)
        assert other.step() == OK
        assert solver.set_budget(1) == OK
        before = solver.x
        status = solver.step()
        if status == NOT_SOLVED:
            assert other.work > 1
            np.testing.assert_array_equal(solver.x, before)
            refused += 1
            solver.set_budget(solver.library.about["max_work"])
            assert solver.step() == OK
        np.testing.assert_array_equal(solver.x, other.x)
    assert refused > 0


@pytest.mark.parametrize("name", ["two lengths", "drive cycle", "carried"])
def test_the_example_runs_the_models_own_case(name, written, tmp_path):
    """Edges and tables stand in the caller's loop: the states are those of `simulate`; no finding of the sanitizers."""
    folder = written(name).path.parent
    command = [CC, *STRICT, *SANITIZE, "-o", tmp_path / "example", "example_main.c", "thing.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    printed = subprocess.run([tmp_path / "example", "40"], check=True, capture_output=True, text=True, timeout=60).stdout
    rows = np.array([line.split(",") for line in printed.splitlines()[2:]], float)
    run = simulate(SCENES[name](), compiled=True)
    kept = [*range(40, len(run) + 1, 40), *([len(run)] if len(run) % 40 else [])]
    np.testing.assert_allclose(rows[:, 0], run.t[kept], rtol=1e-12)
    n = run.x.shape[1]
    np.testing.assert_allclose(rows[:, 1 : 1 + n], run.x[kept], rtol=1e-9, atol=1e-9 * np.abs(run.x).max())


def test_the_example_of_the_docs(tmp_path):
    """A sampled PI chooses the duty: the same loop in Python."""
    codegen.write(scenes.buck(), tmp_path, name="buck", any_step=True)
    example = Path(__file__).parents[2] / "docs/examples/buck.c"
    assert example.read_text().split("/* Hold")[1].split("\n}\n")[0] in (example.parents[1] / "codegen.md").read_text()
    command = [CC, "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-I", tmp_path, "-o", tmp_path / "buck", example]
    subprocess.run([*command, tmp_path / "buck.c", "-lm"], check=True)
    printed = subprocess.run([tmp_path / "buck"], check=True, capture_output=True, text=True).stdout
    s, z = stepper(scenes.buck(), inputs={"u": None}), 0.0
    for _ in range(200):
        e = 9 - s.x[1]
        duty, z = min(max(0.02 * e + z, 0), 0.9), z + 0.002 * e
        for u, time in ((1.0, duty * T), (0.0, (1 - duty) * T)):
            steps = int(np.ceil(time / (T / 20) * (1 - 1e-9)))
            for _ in range(steps):
                s.step(u, h=time / steps)
    found = [float(number) for number in re.findall(r"= (\S+) [AV]", printed)]
    assert found == pytest.approx(s.x.tolist(), rel=1e-8)


def test_inputs_without_a_signal(tmp_path):
    """They are 0 until they are set; x = -u at the end, where the relay is in between."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = LureSystem(x=[x], A=[[-1]], B=[1], C=[1], f=[-u], law=relay(1), x0=[0], inputs={u: None}, t_end=1, step=0.1)
    codegen.write(model, tmp_path, name="thing")
    solver = codegen.load(tmp_path).solver()
    assert (solver.inputs.tolist(), solver.step(), solver.x.tolist()) == ([0], OK, [0])
    for u_k, rest in ((0.9, 0.0), (-3.0, 2.0)):
        solver.set_inputs(u_k)
        assert [solver.step() for _ in range(400)] == [OK] * 400
        assert solver.x[0] == pytest.approx(rest, abs=1e-12)
    subprocess.run([CC, *STRICT, "-o", "example", "example_main.c", "thing.c", "-lm"], cwd=tmp_path, check=True)
    subprocess.run([tmp_path / "example"], check=True, capture_output=True)


def test_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "buck.py").write_text(
        "from input_scenes import T, buck\nfrom nsmodel import pwm\nmodel = buck(step=T/7.3, title='A converter')\n"
    )
    monkeypatch.syspath_prepend(os.path.dirname(scenes.__file__))
    assert main(["codegen", "buck.py"]) == 0
    printed = capsys.readouterr().out
    assert "inputs          u" in printed
    assert "step            1.33333e-06, 1.2e-06, or any other" in printed
    assert main(["codegen", "buck.py", "--step", "1e-6,2e-6", "--out", "two"]) == 0
    assert codegen.load("two").about["lengths"] == [1e-6, 2e-6]
    assert main(["codegen", "buck.py", "--step", "5e-7", "--out", "one"]) == 0
    solver = codegen.load("one").solver()
    assert (solver.set_step(5e-7 * (1 + 1e-13)), solver.set_step(6e-7)) == (OK, BAD_STEP)
    for given in ([], [1e-6] * 9, [-1.0], [np.nan]):
        with pytest.raises(UsageError, match="step"):
            codegen.write(load("buck.py"), tmp_path / "no", step=given)


# -- what a step may take ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["discontinuous", "two lengths", "drive cycle"])
def test_a_step_that_solves_no_linear_system(name, written, tmp_path):
    """All inverses are formed when a solver is made: the same steps, and work that the number of index sets bounds."""
    about = codegen.write(SCENES[name](), tmp_path, name="thing", worst_case=True).about
    usual, sets = written(name).about["max_work"], 3 if name == "drive cycle" else 2
    assert about["max_work"] < usual / 2
    solver, other = codegen.load(tmp_path).solver(), written(name).solver()
    run = simulate(SCENES[name](), compiled=True)
    most = 0
    for k in range(min(len(run.t) - 1, 1600)):
        for s in (solver, other):
            assert (s.set_step(run.step[k + 1]), s.set_inputs_between(run.inputs_begin[k + 1], run.inputs[k + 1])) == (OK, OK)
            assert s.step() == OK
        most = max(most, solver.work)
        np.testing.assert_array_equal(solver.x, other.x)
    assert most <= 1 + sets
    assert solver.set_step(run.step[1] / 3) == BAD_STEP  # its matrices are not there


def test_what_has_too_many_index_sets_is_refused(tmp_path):
    needs = (
        r"worst_case \(--worst-case\) needs matrices that are numbers .* and a law of at most 4 rows, none of them of a curved"
    )
    five = LureSystem(A=-np.eye(5), B=np.eye(5), C=np.eye(5), f=[2] * 5, law=relay(5), x0=[0] * 5, t_end=1, step=0.1)
    for model in (scenes.boost(), five):
        with pytest.raises(CodegenError, match=needs):
            codegen.write(model, tmp_path, name="thing", worst_case=True)
    assert not list(tmp_path.iterdir())


# -- from switch to switch ---------------------------------------------------------------------------------------------

PIECES = r"""
#include "thing_pieces.h"
#include <math.h>
#include <stdio.h>
#define CHECK(done) do { if ((done) != THING_OK) { printf("line %d\n", __LINE__); return 1; } } while (0)

int main(void)
{
    static thing_pieces s, before;
    double x[THING_PIECES_N], u[THING_PIECES_NU], high[] = {1}, low[] = {0}, bad[] = {NAN};
    if (thing_pieces_set_inputs(&s, high) != THING_NOT_INITIALISED)
        return 1;
    CHECK(thing_pieces_init(&s, 1e-10));
    for (int k = 0; k < 100; k++) {
        CHECK(thing_pieces_set_inputs(&s, high));
        CHECK(thing_advance(&s, (k + DUTY)*PERIOD));
        CHECK(thing_pieces_set_inputs(&s, low));
        CHECK(thing_advance(&s, (k + 1)*PERIOD));
    }
    before = s;
    thing_pieces_get_state(&s, x);
    thing_pieces_get_inputs(&s, u);
    printf("%.17g %.17g %g %d %d %ld\n", x[0], x[1], u[0], thing_pieces_set_inputs(&s, bad) == THING_NOT_FINITE,
           s.t == before.t && s.p[0] == before.p[0], thing_pieces_get_events(&s));
    return 0;
}
"""


@pytest.mark.parametrize(
    ("model", "period", "duty", "right"),
    [
        (scenes.buck(100.0), T, 0.4, scenes.exact_buck(100, 100.0)[100]),
        (scenes.boost(), 2e-5, 0.5, [2.925686972, 22.974239189]),
    ],
)
def test_inputs_are_held_between_calls_that_go_from_switch_to_switch(model, period, duty, right, tmp_path):
    codegen.write(model, tmp_path, name="thing", event_driven=True)
    (tmp_path / "main.c").write_text(PIECES)
    command = [CC, *STRICT, "-Wno-unused-function", f"-DPERIOD={period!r}", f"-DDUTY={duty}", "-o", "main"]
    subprocess.run([*command, "main.c", "thing.c", "thing_pieces.c", "-lm"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    i, v, *told = map(float, done.stdout.split())
    assert [i, v] == pytest.approx(right, rel=1e-8, abs=1e-12)
    assert told[:3] == [0, 1, 1]
    assert told[3] > 20  # events, counted across what was set
