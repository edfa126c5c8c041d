"""Many runs in step: against the interpreted steps, the scalar ones in C, closed forms; and bits that depend on nothing else."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from fuzz_models import some
from sweep_models import X0, A, K, T, friction, oscillator, stopped

from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    SweepingProcess,
    box,
    complementarity,
    equality,
    product,
    relay,
    signal,
    simulate,
)
from nsmodel.codegen import batch, library, simd_batch
from nsmodel.codegen.batch import LANES_NOTE, StepBatch
from nsmodel.codegen.library import COMPILER_FLAGS, LANES_FLAGS
from nsmodel.codegen.source import write_source
from nsmodel.codegen.step_spec import spec_for_all_values
from nsmodel.codegen.structs import BAD_PARAMETER, NOT_SOLVED
from nsmodel.modeling.time_grid import make_grid

pytestmark = pytest.mark.usefixtures("own_cache")
U, C, W = ca.SX.sym("u"), ca.SX.sym("c"), ca.SX.sym("w")
KEPT = ["x", "multipliers", "y", "index_set"]
NEAR = 1e-11  # How far runs in lanes may be from runs alone.


def bridge():
    """A rectifier, whose l enters its y."""
    return LureSystem(
        A=[[0, -1 / C], [1 / W, 0]], B=[[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]], C=[[0, 0], [0, 0], [-1, 0], [1, 0]],
        D=[[1 / K, 1 / K, -1, 0], [1 / K, 1 / K, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]], law=complementarity(4), x0=[X0, 0],
        t_end=2e-3, step=1e-5, theta=0.5, parameters={C: 1e-6, W: 1e-2, K: 1e3, X0: 10},
    )  # fmt: skip


def random_scene(seed):
    """A passive linear system under 1 to 4 rows of all kinds of boxes; the last step is shorter, an input drives every other."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), 1 + seed % 4
    S, Q, B, F = (rng.normal(size=shape) for shape in ((n, n), (n, n), (n, m), (m, m)))
    D = {0: np.zeros((m, m)), 1: np.diag(rng.uniform(0.1, 1, m)), 2: 0.2 * F @ F.T + 0.3 * (F - F.T)}[seed % 3]
    kinds = [
        relay(1, -W, W), complementarity(1), equality(1), box([0.0], [W]), box([-W], [np.inf]), box([-np.inf], [0.3]), relay(1),
    ]  # fmt: skip
    law = product(*(kinds[i] for i in rng.integers(0, len(kinds), m)))
    inputs = {U: signal(ca.sin(3 * T))} if seed % 2 else {}
    f = rng.normal(size=n) * C + (rng.normal(size=n) * U if inputs else 0)
    return LureSystem(
        t=T, A=K * ca.SX(ca.DM(Q - Q.T - 0.3 * S @ S.T / n)), B=ca.DM(B), C=ca.DM(B.T), D=ca.DM(D), f=f, law=law,
        x0=[X0 * float(part) for part in rng.normal(size=n)], t_end=1.004, step=1e-2, theta=[0.5, 1.0, 0.7][seed // 2 % 3],
        parameters={K: 1, C: 0.3, W: 0.5, X0: 1}, inputs=inputs,
    )  # fmt: skip


def genes():
    """Two relays whose states decay."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    return FirstOrderSystem(
        x=x, lam=l, f=-K * x, g=ca.vertcat(A * (1 - l[0]), 1 + l[1]), h=ca.vertcat(x[1] - 0.5, x[0] - 0.5), law=relay(2),
        x0=[X0, 0.1], parameters={A: 1, K: 0.7, X0: 0.3}, t_end=2.0, step=1e-2, theta=1,
    )  # fmt: skip


def stuck_or_lost():
    """x' = -1 - c l above a wall: where c > 0 the wall pulls, and no step is left once x = 0."""
    return LureSystem(
        A=[[0]], B=[[-C]], C=[[1]], f=[-1], law=complementarity(1), x0=[X0], parameters={C: -1, X0: 0.5}, t_end=1.0, step=1e-2,
        theta=1,
    )  # fmt: skip


def draw(model, cells, seed=0):
    """Values of its parameters."""
    rng, at = np.random.default_rng(seed), {"c": (-1, 1), "w": (0.2, 1.5), "x0": (-2, 2), "k": (0.5, 2), "a": (0.5, 1.5)}
    if model.step == 1e-5:
        at = {"c": (5e-7, 2e-6), "w": (5e-3, 2e-2), "k": (500, 2000), "x0": (5, 10)}
    ends = [at[name] for name in model.parameters]
    return np.column_stack([rng.uniform(low, high, cells) for low, high in ends])


def made(model, t_end=None, **options):
    """The batch of a model on its own grid."""
    bound = model.bind(dict(zip(model.parameters, draw(model, 1)[0].tolist(), strict=True)))
    return StepBatch(model, make_grid(bound, None, None, t_end, driven=True), 1e-9, **options)


def assert_near(found, other, name):
    finite = np.abs(other, where=np.isfinite(other), out=np.zeros(other.shape))
    np.testing.assert_allclose(found, other, rtol=0, atol=NEAR * max(1, finite.max()), err_msg=name)


def assert_same_bits(one, other, cells: Any = slice(None)):
    for name in one.arrays:
        np.testing.assert_array_equal(one.arrays[name][cells], other.arrays[name], err_msg=name)
    for name in ("status", "steps", "worst_residual", "index_set_changes", "newton", "failed_at"):
        np.testing.assert_array_equal(getattr(one, name)[cells], getattr(other, name), err_msg=name)


SCENES = {"friction": oscillator, "relay": friction, "bridge": bridge, "genes": genes}
SCENES |= {f"random {seed}": lambda seed=seed: random_scene(seed) for seed in some(range(6))}


@pytest.mark.parametrize("name", SCENES)
def test_lanes_are_the_runs_alone(name):
    """Each cell is its interpreted run, and what C finds for it alone."""
    model = SCENES[name]()
    values = draw(model, 21)
    own, alone = made(model), made(model, in_lanes=False)
    assert LANES_NOTE in own.way
    assert LANES_NOTE not in alone.way
    every = 7
    found, other = (b.run(values, KEPT, every) for b in (own, alone))
    assert (found.status == 0).all()
    for kind in ("steps", "index_set_changes"):
        np.testing.assert_array_equal(getattr(found, kind), getattr(other, kind))
    for column in KEPT:
        assert_near(found.arrays[column], other.arrays[column], column)
    assert 0 < found.worst_residual.max() <= 1e-9
    for cell in (0, 13):
        run = simulate(model, parameters=dict(zip(model.parameters, values[cell].tolist(), strict=True)), compiled=False)
        for column in ("x", "multipliers", "y"):
            assert_near(found.arrays[column][cell], getattr(run, column)[own.kept_row_numbers(every)], column)


def test_oscillators_rest_where_the_closed_form_says_and_stick_is_exact():
    model = friction(step=1e-3)
    values = np.column_stack([np.linspace(0.5, 1.5, 40), np.linspace(1.2, 0.8, 40), np.linspace(3, 6, 40)])
    found = made(model).run(values, ["x"], 6000)
    rest, when = stopped(*values.T)
    still = when < 11.9
    np.testing.assert_allclose(found.arrays["x"][still, -1, 0], rest[still], atol=4e-3)
    np.testing.assert_array_equal(found.arrays["x"][still, -1, 1], 0)


def test_bits_of_a_cell_depend_on_nothing_but_its_parameters(monkeypatch):
    """Not on who is beside it, on the order, on rows that are kept, on threads, on where a call ends, on the processor."""
    model = random_scene(3)
    values, own = draw(model, 40), made(model)
    found = own.run(values, KEPT, 9)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(40)[: 40 - 13 * seed]
        assert_same_bits(found, own.run(values[order], KEPT, 9), order)
    assert_same_bits(found, own.run(values[5:6], KEPT, 9), slice(5, 6))
    parts = np.array_split(np.arange(40), 5)
    with ThreadPoolExecutor(4) as pool:
        for part, other in zip(parts, pool.map(lambda part: own.run(values[part], KEPT, 9), parts), strict=True):
            assert_same_bits(found, other, part)
    each = own.run(values, KEPT, 1)
    np.testing.assert_array_equal(each.arrays["x"][:, own.kept_row_numbers(9)], found.arrays["x"])
    np.testing.assert_array_equal(each.worst_residual, found.worst_residual)
    monkeypatch.setattr(batch, "CALL_SECONDS", 0.0)
    monkeypatch.setattr(own, "level", 0)
    assert_same_bits(found, own.run(values, KEPT, 9))
    monkeypatch.setattr(own, "level", 1)
    assert_same_bits(found, own.run(values, KEPT, 9))


@pytest.mark.parametrize("flags", [(*LANES_FLAGS, "-DSTEP_LANES=8", "-O3"), ("-DSTEP_LANES=3", "-fno-tree-vectorize")])
def test_bits_do_not_depend_on_vectors_or_how_many_lanes_there_are(flags, monkeypatch):
    model = oscillator()
    values = draw(model, 50)
    monkeypatch.setattr(library, "LANES_FLAGS", LANES_FLAGS)
    own = made(model)
    found = own.run(values, KEPT, 50)
    for own.level in (0, 1):
        assert_same_bits(found, own.run(values, KEPT, 50))
    monkeypatch.setattr(library, "LANES_FLAGS", (*COMPILER_FLAGS, *flags))
    assert_same_bits(found, made(model).run(values, KEPT, 50))


SPOILED = {
    "z": ("g->of_z[COLUMNS*i + c][j] = D[i][c];", "g->of_z[COLUMNS*i + c][j] = D[i][c]*(1 + 1e-6);"),
    "l": ("l[free[i]] = r[i];", "l[free[i]] = r[i]*(1 + 1e-6);"),  # z follows: E = 0 holds, y = 0 does not
    "lower l": ("l[free[i]] = r[i];", "l[free[i]] = r[i]*(1 - 1e-6);"),
}


@pytest.mark.parametrize("what", SPOILED)
@pytest.mark.parametrize("scene", [bridge, oscillator])
def test_a_map_is_never_believed(scene, what, monkeypatch):
    """Maps that are off by a millionth are seen in each step by the rows themselves, and the steps are taken alone."""
    model, change = scene(), SPOILED[what]

    def spoiled(*given, **options):
        source = write_source(*given, **options)
        assert source.rollout.count(change[0]) == bool(options.get("in_lanes"))
        return replace(source, rollout=source.rollout.replace(*change))

    monkeypatch.setattr(library, "write_source", spoiled)
    monkeypatch.setattr(
        library, "LANES_FLAGS", (*library.LANES_FLAGS, f"-DSPOILED={[*SPOILED].index(what)}")
    )  # a library of its own
    own, alone = made(model, 20 * model.step), made(model, 20 * model.step, in_lanes=False)
    values = draw(model, 9)
    found, other = (b.run(values, KEPT) for b in (own, alone))
    for column in KEPT:
        np.testing.assert_allclose(found.arrays[column], other.arrays[column], rtol=1e-13, atol=1e-14)
    assert found.worst_residual.max() <= 1e-9


def test_cells_that_fail_or_are_refused_leave_the_others_alone():
    model = stuck_or_lost()
    values = draw(model, 45)
    values[:, 1] = np.abs(values[:, 1]) + 0.1
    values[7, 0], values[8, 1], values[44, 0] = np.nan, np.inf, np.nan
    own, alone = made(model), made(model, in_lanes=False)
    found, other = (b.run(values, [*KEPT, "residual"], 3) for b in (own, alone))
    np.testing.assert_array_equal(found.status, other.status)
    assert {0, NOT_SOLVED} < set(found.status.tolist())
    np.testing.assert_array_equal(found.failed_at, other.failed_at)
    np.testing.assert_array_equal(found.steps, other.steps)
    for column in KEPT:
        assert_near(found.arrays[column], other.arrays[column], column)
    good = np.flatnonzero(found.status == 0)
    assert_same_bits(found, own.run(values[good], [*KEPT, "residual"], 3), good)


def test_a_law_without_width_is_refused_cell_by_cell():
    model = oscillator()
    values = draw(model, 6)
    values[2, 0] = -1.0
    own, alone = made(model), made(model, in_lanes=False)
    found, other = own.run(values, KEPT, 10), alone.run(values, KEPT, 10)
    assert found.status.tolist() == other.status.tolist() == [0, 0, BAD_PARAMETER, 0, 0, 0]


def test_what_was_not_done_when_it_is_stopped_is_forgotten(monkeypatch):
    model = random_scene(3)
    own, values, calls = made(model), draw(model, 90), []
    whole = own.run(values, KEPT, 2)
    monkeypatch.setattr(batch, "CALL_SECONDS", 0.0)
    found = own.run(values, KEPT, 2, stop=lambda: calls.append(0) or len(calls) == 9)
    done = found.status == 0
    assert done.any()
    assert not done.all()
    assert set(found.status[~done]) == {batch.TO_DO}
    np.testing.assert_array_equal(found.arrays["x"][done], whole.arrays["x"][done])
    assert np.isnan(found.arrays["x"][~done]).all()
    assert not found.steps[~done].any()


@pytest.mark.usefixtures("system_compiler")
def test_a_compiler_that_has_no_lanes_takes_cells_one_by_one(monkeypatch):
    model = oscillator()
    monkeypatch.setattr(library, "LANES_FLAGS", (*COMPILER_FLAGS, "-fno-such-option-at-all"))
    own = made(model)
    assert LANES_NOTE not in own.way
    assert (own.run(draw(model, 3), KEPT, 50).status == 0).all()


def refusal(model):
    return simd_batch.lanes_obstacle(spec_for_all_values(model, make_grid(model, None, None, None), 1e-9))


def test_what_does_not_go_in_lanes_says_why():
    x, q = ca.SX.sym("x"), ca.SX.sym("q")
    given = {"law": relay(1), "x0": [X0], "parameters": {K: 1, X0: 1}, "t_end": 1.0, "step": 0.1, "theta": 1}
    many = given | {"law": relay(3), "x0": [X0] * 14}
    assert "time" in refusal(LureSystem(t=T, A=[[-K]], B=[[1]], C=[[1]], f=ca.sin(T), **given))
    assert "more than parameters" in refusal(LureSystem(x=[x], A=[-K * x**3], B=[[1]], C=[[1]], **given))
    assert "a few" in refusal(LureSystem(A=-K * ca.DM.eye(14), B=ca.DM.ones(14, 3), C=ca.DM.ones(3, 14), D=ca.DM.eye(3), **many))
    wall = SweepingProcess(q=q, f=-K, constraints={"wall": q}, q0=[X0], parameters={K: 1, X0: 1}, t_end=1.0, step=0.1)
    assert "gap" in refusal(wall)
    assert refusal(friction()) == ""
