"""Blocks with memory in C: the bits of the stepper, pulses whose duty blocks set, what the caller reads, sets and is refused."""

import math
import re
import shutil
import subprocess
from pathlib import Path

import block_scenes as scenes
import casadi as ca
import numpy as np
import pytest
from block_scenes import T

from nsmodel import (
    FirstOrderSystem,
    codegen,
    pwm,
    sampled,
    simulate,
    stepper,
    table,
)
from nsmodel.errors import CodegenError, StepError

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZE = ("-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CC = next((name for name in ("gcc", "cc", "clang") if shutil.which(name)), "")
pytestmark = pytest.mark.skipif(not CC, reason="no C compiler")
OK, NOT_FINITE, BAD_STEP, NOT_INITIALISED = 0, 2, 3, 6


def mixed():
    """Signals of the caller before and behind a pulse, blocks with and without offset, a duty read late, outputs of memory."""
    x, a, u, b, z, w, q, m = (ca.SX.sym(name) for name in "xaubzwqm")
    slow = sampled("slow", period=0.2, offset=0.07, memory={z: 1}, outputs={w: z + b}, update={z: 0.5 * z + x}, start={w: z - 2})
    fast = sampled("fast", period=0.05, memory={q: 2 * ca.SX.sym("p")}, outputs={m: q + w}, update={q: q + a - z})
    ramp = table([0, 0.31, 0.31, 1], [0, 1, -1, 0], "linear")
    return FirstOrderSystem(
        x=x, f=[a + 3 * u - x + 0.1 * m], x0=[0.5], theta=0.5, step=0.013, t_end=1, parameters={"p": 0.25},
        inputs={a: ramp, u: pwm(0.1, 0.5 + 0.1 * w, phase=0.03, low=-1, high=2, kind="centre"), b: pwm(0.17, 0.4)},
        blocks=[slow, fast],
    )  # fmt: skip


SCENES = {
    "friction": scenes.friction_pi,
    "trailing": scenes.regulated,
    "leading": lambda: scenes.regulated("leading"),
    "centre": lambda: scenes.regulated("centre"),
    "each step": scenes.thermostat,
    "sampled": lambda: scenes.thermostat(period=0.01),
    "over current": scenes.over_current,
    "fired": lambda: scenes.fired(60),
    "carried": lambda: scenes.pushed("trailing", 0.5),
    "begun": scenes.begun,
    "sparse": scenes.chain,
    "mixed": mixed,
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return written(scene) -> its library in Python, in whose folder it is called "thing"."""
    base, kept = tmp_path_factory.mktemp("blocks"), {}

    def write(name):
        if name not in kept:
            model = SCENES[name]()
            codegen.write(model, base / name.replace(" ", "_"), name="thing", parameters=dict(model.parameters))
            kept[name] = codegen.load(base / name.replace(" ", "_"))
        return kept[name]

    return write


def given(model, names, t):
    """The caller's inputs just after a time, and the first time after it at which one has an edge or bends."""
    signals = [model.inputs[name] for name in names]
    edges = np.concatenate([[model.t_end], *(signal.joints(model.t_end) for signal in signals)])
    after = np.array([t * (1 + 4e-15)])
    return signals, [signal.after(after)[0, 0] for signal in signals], edges[edges > after].min()


def parts(solver, model, names):
    """Set the inputs, and yield the lengths of the equal steps up to the next tick or edge, with the inputs at their ends."""
    while solver.t < model.t_end * (1 - 1e-12):
        t = solver.t
        signals, begin, end = given(model, names, t)
        if names:
            assert solver.set_inputs(begin) == OK
        end = min(end, solver.next_tick)
        count = max(math.ceil((end - t) / model.step * (1 - 1e-9)), 1)
        h = (end - t) / count
        h = model.step if abs(h - model.step) <= 1e-9 * model.step else h
        for _ in range(count):
            if names:
                limits = [signal.limits(np.array([solver.t, solver.t + h]), 0) for signal in signals]
                assert solver.set_inputs_between(*([part[side][0, 0] for part in limits] for side in (0, 1))) == OK
            yield h


@pytest.mark.parametrize("name", SCENES)
def test_the_bits_are_those_of_the_stepper(name, written):
    model, library = SCENES[name](), written(name)
    solver, other = library.solver(), stepper(model, compiled=True)
    kept = library.about["blocks"]
    lengths = list[float]()
    for h in parts(solver, model, library.about["inputs"]):
        lengths.append(h)
        assert (solver.set_step(h), solver.step()) == (OK, OK)
        row = other.step(h=h)
        held = [other.held[key] for key in (*kept["memory"], *kept["held"])]
        assert [solver.t, *solver.x, *solver.memory, *solver.held] == [row.t, *row.x, *held]
        assert not row.multipliers.size or (solver.multipliers == row.multipliers).all()
        if len(lengths) == 300:
            break
    assert len(lengths) >= 80


@pytest.mark.parametrize("kind", ["trailing", "leading", "centre"])
def test_the_loop_is_closed_in_c(kind, written):
    solver, model = written(kind).solver(), SCENES[kind]()
    right, seen = scenes.exact_regulated(kind), [solver.x]
    for h in parts(solver, model, []):
        assert (solver.set_step(h), solver.step()) == (OK, OK)
        if abs(solver.t / T - len(seen)) < 1e-9:
            seen.append(solver.x)
    np.testing.assert_allclose(seen, right, atol=2e-3)


@pytest.mark.parametrize("name", ["friction", "centre", "begun", "mixed"])
def test_the_example_runs_the_models_own_case(name, written, tmp_path):
    """Tables and pulses: the states are those of `simulate` to the order of the steps; no finding of the sanitizers."""
    folder, model = written(name).path.parent, SCENES[name]()
    command = [CC, *STRICT, *SANITIZE, "-o", tmp_path / "example", "example_main.c", "thing.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run([tmp_path / "example", "7"], check=True, capture_output=True, text=True, timeout=60)
    rows = np.array([line.split(",")[: 1 + len(model.names)] for line in done.stdout.splitlines()[1:]], float)
    run = simulate(model)
    assert rows[-1, 0] == pytest.approx(model.t_end, rel=1e-12)
    atol = {"centre": 2e-3, "mixed": 1e-3}.get(name, 1e-9)
    np.testing.assert_allclose(rows[-1, 1:], run.x[-1], rtol=0, atol=atol)


def test_what_blocks_keep_is_read_and_set(written):
    solver, other = written("trailing").solver(), written("trailing").solver()
    assert written("trailing").about["blocks"] == {"memory": ["z"], "held": ["d", "u.duty"]}
    assert (solver.inputs.tolist(), solver.memory.tolist()) == ([], [0.3])
    assert solver.held.tolist() == [pytest.approx(0.48)] * 2
    assert (solver.sample(), solver.memory.tolist()) == (OK, [pytest.approx(0.318)])
    assert (solver.sample(), solver.memory.tolist()) == (OK, [pytest.approx(0.318)])  # once at a time
    assert solver.next_tick == other.next_tick == pytest.approx(0.48 * T)  # where the first pulse will end
    assert (solver.step(), other.step()) == (OK, OK)
    np.testing.assert_array_equal([*solver.x, *solver.memory, *solver.held], [*other.x, *other.memory, *other.held])
    assert (solver.set_memory(0.1), solver.set_held([0.2, 0.7])) == (OK, OK)
    assert solver.next_tick == pytest.approx(0.7 * T)
    assert (solver.set_memory(np.nan), solver.set_held([0.2, np.inf])) == (NOT_FINITE, NOT_FINITE)
    assert [*solver.memory, *solver.held] == [0.1, 0.2, 0.7]
    assert (solver.reset(), solver.memory.tolist(), solver.t) == (OK, [0.3], 0)
    with pytest.raises(CodegenError, match="held: 1 numbers given; expected 2"):
        solver.set_held([1])


def test_no_step_goes_over_a_tick_or_an_edge(written):
    solver = written("trailing").solver()
    for end in (solver.next_tick, T):
        before = [solver.t, *solver.x, *solver.memory, *solver.held]
        assert solver.set_step((end - solver.t) * (1 + 1e-9)) == OK
        assert (solver.step(), math.isinf(solver.residual), solver.work) == (BAD_STEP, True, 0)
        assert [solver.t, *solver.x, *solver.memory, *solver.held] == before
        assert (solver.set_step(end - solver.t), solver.step()) == (OK, OK)


def test_a_step_that_fails_has_not_ticked(written):
    solver, other, failed = written("carried").solver(), written("carried").solver(), []
    for k, h in enumerate(parts(solver, scenes.pushed("trailing", 0.5), [])):
        assert solver.set_step(solver.next_tick + 1e-6 - solver.t) == OK
        if k % 3 == 0:  # of what was looked at before the step too
            solver.sample()
        failed.append(solver.step())
        for s in (solver, other):
            assert (s.set_step(h), s.step()) == (OK, OK)
        np.testing.assert_array_equal([*solver.x, *solver.memory, *solver.held], [*other.x, *other.memory, *other.held])
    assert set(failed) == {BAD_STEP}


def test_an_input_without_a_signal(tmp_path):
    """Steps end at ticks and edges all the same: x' = r + u - x, and r is given."""
    x, r, u, d = (ca.SX.sym(name) for name in "xrud")
    hold = sampled("hold", period=0.1, offset=0.03, outputs={d: ca.fmin(r, 0.5)})
    model = FirstOrderSystem(
        x=x, f=[r + u - x], x0=[0], step=0.04, t_end=1, theta=0.5, inputs={r: None, u: pwm(0.2, d)}, blocks=[hold]
    )
    codegen.write(model, tmp_path, name="thing")
    solver, other = codegen.load(tmp_path).solver(), stepper(model, inputs={"r": None}, compiled=True)
    for k in range(60):
        assert solver.set_inputs(0.01 * k) == OK
        h = min(0.04, solver.next_tick - solver.t)
        assert (solver.set_step(h), solver.step()) == (OK, OK)
        row = other.step(0.01 * k, h=h)
        assert (row.t, row.x[0]) == (solver.t, solver.x[0])
    assert solver.held[0] == 0.5


def test_the_start_of_memory_belongs_to_the_parameters(tmp_path):
    codegen.write(mixed(), tmp_path, name="thing")
    solver = codegen.load(tmp_path).solver()
    assert (solver.memory.tolist(), solver.held.tolist()) == ([1, 0.5], [-1, -0.5, 0.4])
    assert (solver.set_parameters(2), solver.reset(), solver.memory.tolist()) == (OK, OK, [1, 4])
    assert solver.held.tolist() == [-1, 3, 0.4]


def test_what_is_no_number_stops_before_the_step(tmp_path):
    x, z = ca.SX.sym("x"), ca.SX.sym("z")
    model = FirstOrderSystem(
        x=x, f=[z], x0=[0], step=0.1, t_end=1, blocks=[sampled("root", period=0.2, memory={z: 1}, update={z: ca.sqrt(0.15 - x)})]
    )
    codegen.write(model, tmp_path, name="thing")
    solver, other = codegen.load(tmp_path).solver(), stepper(model)
    while solver.step() == OK:
        other.step()
    assert (solver.status, solver.sample()) == (NOT_FINITE, NOT_FINITE)
    assert [solver.t, *solver.x, *solver.memory] == [other.t, *other.x, other.held["z"]]
    with pytest.raises(StepError, match=r"block 'root' sets z = "):
        other.step()


OWN = r"""
#include "thing.h"
#include <math.h>
#include <stdio.h>
#define CHECK(what) do { if (!(what)) { printf("line %d\n", __LINE__); return 1; } } while (0)

int main(void)
{
    static thing_solver s;
    double w[THING_NW], x[THING_NX], z = 0.3;
    CHECK(thing_sample(&s) == THING_NOT_INITIALISED && thing_set_held(&s, w) == THING_NOT_INITIALISED);
    CHECK(thing_init(&s) == THING_OK);
    for (int k = 0; k < 60; k++) {
        thing_get_state(&s, x);
        const double e = 9 - x[1];
        w[0] = w[1] = fmin(fmax(0.02*e + z, 0), 0.9);
        z += 0.002*e;
        CHECK(thing_set_held(&s, w) == THING_OK);
        while (thing_get_time(&s) < (k + 1)*PERIOD*(1 - 1e-12)) {
            const double t = thing_get_time(&s), next = thing_next_tick(&s);
            const int steps = (int)ceil((next - t)/THING_STEP*(1 - 1e-9));
            CHECK(thing_set_step(&s, (next - t)/steps) == THING_OK);
            for (int i = 0; i < steps; i++)
                CHECK(thing_step(&s) == THING_OK);
        }
    }
    thing_get_state(&s, x);
    printf("%.17g %.17g\n", x[0], x[1]);
    return 0;
}
"""


def test_ticks_of_the_callers_own(written, tmp_path):
    """The same controller outside: the duty is set, and the library makes the pulses."""
    folder = written("trailing").path.parent
    (tmp_path / "main.c").write_text(OWN)
    command = [CC, *STRICT, *SANITIZE, f"-DPERIOD={T!r}", "-DTHING_OWN_TICKS", "-I", folder, "-o", tmp_path / "main"]
    subprocess.run([*command, tmp_path / "main.c", folder / "thing.c", "-lm"], check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert list(map(float, done.stdout.split())) == pytest.approx(scenes.exact_regulated()[-1], abs=2e-3)


def test_the_example_of_the_docs(tmp_path):
    codegen.write(scenes.regulated(), tmp_path, name="regulated")
    example = Path(__file__).parents[2] / "docs/examples/regulated.c"
    page = (example.parents[1] / "codegen.md").read_text()
    assert example.read_text().split("/* Go on")[1].split("\n}\n")[0] in page
    command = [CC, *STRICT, "-I", tmp_path, "-o", tmp_path / "loop", example, tmp_path / "regulated.c", "-lm"]
    subprocess.run(command, check=True)
    printed = subprocess.run([tmp_path / "loop"], check=True, capture_output=True, text=True).stdout
    t, v = map(float, re.findall(r"= (\S+) [sV]", printed))
    assert (t, v) == (6e-3, pytest.approx(scenes.exact_regulated(periods=600)[-1, 1], abs=2e-3))


def test_what_is_refused(tmp_path):
    with pytest.raises(CodegenError, match=r"event-driven integration in C does not take blocks \(pi, u.duty\)"):
        codegen.write(scenes.regulated(), tmp_path, event_driven=True)
    with pytest.raises(CodegenError, match="and steps of known lengths; a block places edges of a pwm"):
        codegen.write(scenes.regulated(), tmp_path, worst_case=True)
    assert not list(tmp_path.iterdir())


def test_the_worst_case_with_ticks(tmp_path):
    """Blocks cost no work: the inverses of a law are formed beforehand."""
    model = scenes.friction_pi()
    about = codegen.write(model, tmp_path, name="thing", worst_case=True).about
    solver = codegen.load(tmp_path).solver()
    for _ in parts(solver, model, about["inputs"]):
        assert solver.step() == OK
        assert solver.work <= 4
        if solver.t > 1:
            break
