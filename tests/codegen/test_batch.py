"""Many runs in a call: each cell is the interpreted run at its values, and the same to the bit whatever runs beside it.

Parameters stand in the matrices, in the law's ends, in the start, also of a reaction; defaults are None, or values at which
a law has no width and a matrix vanishes: of them nothing may be read off.
"""

import gc
import os
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
from conftest import QUICK

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    NsmodelError,
    SweepingProcess,
    UsageError,
    ball,
    complementarity,
    pwm,
    relay,
    simulate,
)
from nsmodel.codegen import batch, library
from nsmodel.codegen import library as cache
from nsmodel.codegen.batch import StepBatch
from nsmodel.codegen.rollout import MAX_LOADED
from nsmodel.codegen.step_spec import spec_for_all_values
from nsmodel.codegen.structs import STATUSES
from nsmodel.errors import CodegenError
from nsmodel.modeling.fingerprint import ALL_VALUES_SUFFIX
from nsmodel.modeling.time_grid import make_grid
from nsmodel.simulation.simulate import explain
from nsmodel.simulation.step_backend import STEPS_IN_C, STEPS_IN_C_FOR_ALL
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem, symbolic_initial_rows
from nsmodel.solvers.plan import is_fixed_code_faster
from nsmodel.solvers.structure import read_step_structure

pytestmark = [
    pytest.mark.usefixtures("own_cache"), pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
]  # fmt: skip
OK, NOT_SOLVED, BAD_PARAMETER = ([s.name for s in STATUSES].index(name) for name in ("OK", "NOT_SOLVED", "BAD_PARAMETER"))
SYM = ca.SX.sym


def lure(theta=1.0, gamma=1.0, **fields):
    a, w, start = SYM("a"), SYM("w"), SYM("s", 2)
    given = {"t_end": 1, "step": 0.01, "parameters": {a: 0.0, w: None, start: [0.1, 0.2]}} | fields
    return LureSystem(
        A=[[0, 1], [-w, -0.1]], B=[0, 1], C=[0, 1], law=relay(1, -a, a), x0=start, theta=theta, gamma=gamma, **given
    )  # fmt: skip


def potential(theta, gamma):
    d, mu, x0, y = SYM("d"), SYM("mu"), SYM("x0"), SYM("y")
    return LureSystem(
        A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], D=d, y=y, phi=mu * ca.fabs(y) + 0.1 * y**2, x0=[x0, 0], t_end=1, step=0.02,
        theta=theta, gamma=gamma, parameters={d: 0.0, mu: 0.0, x0: None},
    )  # fmt: skip


def first_order(theta=0.5, gamma=0.5):
    a, b, m, x, lam, t = SYM("a"), SYM("b"), SYM("m"), SYM("x", 2), SYM("lam"), SYM("t")
    return FirstOrderSystem(
        x=x, lam=lam, t=t, M=ca.diag(ca.vertcat(m, 1)), f=[x[1], -ca.sin(x[0]) + 0.3 * ca.cos(t)], g=[0, lam], h=x[1] + b * lam,
        law=relay(1, -a, a), x0=[1, b], t_end=1, step=0.01, theta=theta, gamma=gamma, parameters={a: 0.0, b: 0.0, m: 1.0},
    )  # fmt: skip


def rolling(**_):
    mu, x, lam = SYM("mu"), SYM("x", 2), SYM("lam", 2)
    return FirstOrderSystem(
        x=x, lam=lam, f=[x[1], -x[0]], g=lam, h=x, law=ball(2, mu), x0=[1, mu], t_end=0.5, step=0.01, theta=0.5, gamma=0.5,
        parameters={mu: 0.0},
    )  # fmt: skip


def oscillator(**fields):
    x, s, a, k, v = SYM("x", 2), SYM("s"), SYM("a"), SYM("k"), SYM("v", 2)
    given = {"v0": v, "potential": k * ca.sumsqr(x) / 2, "t_end": 1.005} | fields  # the last step is shorter
    return FrictionOscillator(x=x, friction=a * s, s=s, x0=[1, k], step=0.01, parameters={a: 0.0, k: 1.0, v: None}, **given)


def two_positions():
    return oscillator(v0=None, x1=[1, 0.5], t_end=0.605)


def sweeping():
    q, t, c, r = SYM("q", 2), SYM("t"), SYM("c"), SYM("r", 2)
    return SweepingProcess(
        q=q, t=t, f=[c, 0.2 * ca.cos(3 * t)], constraints={"disc": r[0] ** 2 - ca.sumsqr(q), "wall": r[1] - q[1] - c * ca.sin(t)},
        q0=[0.1 * c, -0.1], t_end=1.003, step=0.01, parameters={c: 0.0, r: [1, 1]},
    )  # fmt: skip


def inclusion(scheme, **fields):
    x, b, w = SYM("x", 2), SYM("b"), SYM("w")
    given = {"operator": b * x, "constraints": {"disc": 4 - ca.sumsqr(x)}, "x0": [w, 0.5]} | fields
    return MonotoneInclusion(x=x, field=[w, 1], t_end=1, step=0.01, scheme=scheme, parameters={b: 0.0, w: 0.0}, **given)


def driven(theta=0.5, gamma=0.5):
    a, x0, u = SYM("a"), SYM("x0"), SYM("u")
    return LureSystem(
        A=[[0, 1], [-1, -0.1]], B=[0, 1], C=[0, 1], f=[0, u * a], law=relay(1, -a, a), x0=[x0, 0], t_end=1, step=0.01,
        theta=theta, gamma=gamma, inputs={u: pwm(0.5, 0.3)}, parameters={a: 0.0, x0: None},
    )  # fmt: skip


SCENES = {
    "lure": lure,
    "lure gamma < 1": lambda: lure(0.5, 0.5),
    "steps of several lengths": lambda: lure(0.5, 1.0, step=None, t_end=None, steps=[0.01, 0.02, 0.01, 0.03] * 8),
    "phi": lambda: potential(1.0, 1.0),
    "phi gamma < 1": lambda: potential(0.5, 0.5),
    "first order": first_order,
    "ball": rolling,
    "oscillator": oscillator,
    "two positions": two_positions,
    "sweeping": sweeping,
    "implicit": lambda: inclusion("implicit"),
    "catching-up": lambda: inclusion("catching-up"),
    "inputs": driven,
    "inputs gamma = 1": lambda: driven(1.0, 1.0),
}


def grid_of(model, **options):
    return make_grid(model, options.get("step"), None, options.get("t_end"), driven=bool(model.inputs))


def made(model, **options):
    return StepBatch(model, grid_of(model, **options), 1e-9, in_lanes=False)


def values_for(found, count=8):
    values = np.random.default_rng(1).uniform(0.3, 1.5, (count, len(found.names)))
    values[1, 0], values[2, 0], values[3, -1] = 0, -0.2, -0.4
    return values


def interpreted(model, found, cell, every):
    try:
        return simulate(model, parameters=dict(zip(found.names, cell, strict=True)), compiled=False, save_every=every)
    except NsmodelError as error:
        return error


def array_of(run, name):
    names = run.metadata["multiplier_names"]
    return run.multipliers[:, names.index(name)] if name in names and name not in run.arrays else getattr(run, name)


@pytest.mark.parametrize("name", SCENES)
def test_a_cell_is_the_interpreted_run(name):
    model = SCENES[name]()
    found, every = made(model), 7
    values = values_for(found)
    kept = [name for name in found.columns() if name not in ("residual", "newton")]
    cells = found.run(values, kept, every)
    for i, cell in enumerate(values):
        run = interpreted(model, found, cell, every)
        if isinstance(run, UsageError):
            assert cells.status[i] == BAD_PARAMETER, run
            assert np.isnan(cells.arrays["x"][i]).all() or cells.steps[i] == 0
            continue
        assert cells.status[i] == OK, run
        np.testing.assert_array_equal(found.kept_times(every), run.t)
        assert cells.steps[i] == run.metadata["totals"]["steps"] - model.tied_to_step
        assert 0 <= cells.worst_residual[i] <= 1e-9
        assert np.isnan(cells.failed_at[i])
        for column in kept:
            got, want = cells.arrays[column][i], array_of(run, column)
            assert got.shape == want.shape, column
            np.testing.assert_array_equal(np.isnan(got), np.isnan(want), err_msg=column)
            exact = column == "index_set" or column.startswith("residual_")
            if not exact:
                np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-11 * max(1, np.nanmax(np.abs(want), initial=0)))
        if cell[0]:  # at 0 laws have no width, and any code is right
            np.testing.assert_array_equal(cells.arrays["index_set"][i], run.index_set)
            assert cells.index_set_changes[i] == run.metadata["totals"]["index_set_changes"]


def equal(one, two, rows=slice(None)):
    for part in ("status", "steps", "worst_residual", "index_set_changes", "newton", "failed_at"):
        np.testing.assert_array_equal(getattr(one, part), getattr(two, part)[rows], err_msg=part)
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, two.arrays[name][rows], err_msg=name)


@pytest.mark.parametrize("name", ["lure gamma < 1", "first order", "ball", "sweeping", "catching-up", "inputs"])
def test_a_cell_is_the_same_to_the_bit_whatever_runs_beside_it(name, monkeypatch):
    found = made(SCENES[name]())
    values, kept = values_for(found, 12), list(found.columns())
    whole = found.run(values, kept)
    order = np.random.default_rng(2).permutation(12)
    equal(found.run(values[order], kept), whole, order)
    equal(found.run(values[5:6], kept), whole, slice(5, 6))
    with ThreadPoolExecutor(4) as pool:
        for i, cells in enumerate(pool.map(lambda i: found.run(values[i : i + 3], kept), [0, 3, 6, 9] * 5)):
            equal(cells, whole, slice(3 * (i % 4), 3 * (i % 4) + 3))
    monkeypatch.setattr(batch, "CALL_SECONDS", 0.0)  # each call into C is as short as it may be: cells are left and gone on with
    calls = []
    equal(found.run(values, kept, stop=lambda: calls.append(1)), whole)
    assert len(calls) > 12


@pytest.mark.parametrize("name", ["lure", "lure gamma < 1", "oscillator", "sweeping", "implicit"])
def test_a_compiled_run_is_a_cell(name):
    """`simulate` takes the same library: rows, worst residual, changes are the same to the bit, but for a shorter last step."""
    model = SCENES[name]()
    found = made(model, t_end=0.5)
    cell = values_for(found)[5]
    run = simulate(model, t_end=0.5, parameters=dict(zip(found.names, cell, strict=True)), compiled=True)
    cells = found.run(cell[None], ["x", "multipliers", "y", "index_set", "residual"])
    assert STEPS_IN_C_FOR_ALL in run.metadata["used"]
    assert run.metadata["solver_counts"].keys().isdisjoint({"qpoases", "ipopt"})
    for column, array in cells.arrays.items():
        np.testing.assert_array_equal(array[0], run.arrays[column], err_msg=column)
    totals = run.metadata["totals"]
    assert (totals["worst_residual"], totals["index_set_changes"]) == (cells.worst_residual[0], cells.index_set_changes[0])


@pytest.mark.parametrize("name", SCENES)
def test_the_rows_before_a_step_are_those_of_a_bound_model(name):
    model = SCENES[name]()
    values = np.random.default_rng(0).uniform(0.3, 1.5, model.p.numel())
    h, bound = SYM("h"), model.bind(dict(zip(model.parameters, values, strict=True)))
    for (own, more), (state, records) in zip(symbolic_initial_rows(model, h), initial_rows(bound, 0.02), strict=True):
        assert more.keys() == records.keys()
        found = ca.Function("rows", [model.p, h], [own, *more.values()]).call([values, 0.02])
        for got, want in zip(found, [state[: own.numel()], *records.values()], strict=True):
            np.testing.assert_allclose(np.array(got).ravel(), want, rtol=1e-15)


def closed_form(a, k, x0, t):
    """x of x'' + a Sgn(x') + k x = 0, x' = 0 at first: half periods about +-a/k, until |x| <= a/k."""
    w, x, half = np.sqrt(k), x0, 0
    n = int(t * w / np.pi)
    while half < n and abs(x) > a / k:
        x, half = -x + np.sign(x) * 2 * a / k, half + 1
    if abs(x) <= a / k:
        return x
    centre = np.sign(x) * a / k
    return centre + (x - centre) * np.cos(w * t - np.pi * half)


def test_cells_converge_to_the_closed_form():
    x, s, (a, k, x0) = SYM("x"), SYM("s"), (SYM(name) for name in ("a", "k", "x0"))
    model = FrictionOscillator(
        x=x, potential=k * x**2 / 2, friction=a * s, s=s, x0=x0, v0=0, t_end=4, step=1e-3, parameters=dict.fromkeys((a, k, x0))
    )  # fmt: skip
    values = np.random.default_rng(0).uniform([0.5, 0.8, 3], [1.5, 1.2, 6], (20, 3))
    exact = np.array([closed_form(*cell, 4.0) for cell in values])
    errors = [
        np.abs(made(model, step=h).run(values, ["x"], 10**6).arrays["x"][:, -1, 0] - exact).max() for h in (1e-3, 2.5e-4)
    ]  # fmt: skip
    assert errors[0] < 0.03
    assert errors[1] < 0.4 * errors[0]


def test_what_the_law_or_the_start_refuses():
    found = made(sweeping())
    values = np.array([[0.1, 1, 1], [0.1, 0.05, 1], [0.1, 1, -0.3], [np.nan, 1, 1], [0.1, 1, 1]])
    cells = found.run(values, ["x", "index_set"], 10)
    assert [STATUSES[status].name for status in cells.status] == ["OK", "BAD_PARAMETER", "BAD_PARAMETER", "NOT_FINITE", "OK"]
    assert cells.steps.tolist() == [101, 0, 0, 0, 101]
    assert np.isnan(cells.arrays["x"][1:4, 1:]).all()
    assert (cells.arrays["index_set"][1:4] == -2).all()
    np.testing.assert_array_equal(cells.arrays["x"][0], cells.arrays["x"][4])
    made_of_law = made(lure())
    assert made_of_law.run([[-0.1, 1, 0, 0], [0.0, 1, 0, 0]], ["x"]).status.tolist() == [BAD_PARAMETER, OK]


def test_a_step_without_an_answer_fails_its_cell_alone():
    """Walls that close at t = 1/c leave no point: rows behind are NaN, and the time is told."""
    q, t, c = SYM("q"), SYM("t"), SYM("c")
    model = SweepingProcess(
        q=q, t=t, f=[0.0], constraints={"left": q + 1 - c * t, "right": 1 - c * t - q}, q0=[0.5], t_end=1, step=0.01,
        parameters={c: 0.5},
    )  # fmt: skip
    cells = made(model).run(np.array([[0.5], [2.0], [0.9]]), ["q", "residual"], 5)
    assert cells.status.tolist() == [OK, NOT_SOLVED, OK]
    assert cells.failed_at[1] == pytest.approx(0.5)
    assert cells.steps.tolist() == [100, 50, 100]
    assert np.isfinite(cells.arrays["q"][1, :11]).all()
    assert np.isnan(cells.arrays["q"][1, 11:]).all()
    assert np.isfinite(cells.arrays["q"][[0, 2]]).all()


def test_what_was_not_reached_says_so(monkeypatch):
    monkeypatch.setattr(batch, "CALL_SECONDS", 0.0)
    found, left = made(lure()), iter([False] * 1000 + [True] * 10**6)
    values = values_for(found, 200)
    cells = found.run(values, ["x"], stop=lambda: next(left))
    reached = int((cells.status != -1).sum())
    assert 0 < reached < 200
    assert (cells.status[reached:] == -1).all()
    assert np.isnan(cells.arrays["x"][reached:]).all()
    assert not cells.steps[reached:].any()
    equal(found.run(values[:reached], ["x"]), cells, slice(reached))


def test_nothing_is_kept_but_what_is_asked_for():
    found = made(lure())
    cells = found.run(values_for(found), ["x_0"], 60)
    assert cells.arrays["x_0"].shape == (8, 3)
    assert cells.arrays["x_0"].base.size == 24
    assert found.run(values_for(found), [], 3).arrays == {}
    assert found.run(np.zeros((0, 4)), ["x", "index_set"]).status.shape == (0,)
    np.testing.assert_allclose(found.kept_times(60), [0, 0.6, 1])
    np.testing.assert_allclose(found.kept_times(1000), [0, 1])
    for wrong in ({"keep": ["z"]}, {"keep": ["x"], "every": 0}):
        with pytest.raises(UsageError, match=r"'z' is not a column|every = 0"):
            found.run(values_for(found), **wrong)
    with pytest.raises(UsageError, match=r"values: shape \(8, 3\); expected \(cells, 4\)"):
        found.run(np.zeros((8, 3)), ["x"])


def test_inputs_are_those_of_the_grid_or_given():
    model = driven()
    found, grid = made(model), grid_of(model)
    cell = np.array([[0.5, 1.0]])
    given = grid.drive.limits(grid.between(0, grid.N))
    equal(found.run(cell, ["x"], inputs=given), found.run(cell, ["x"]))
    assert not np.array_equal(found.run(cell, ["x"], inputs=0 * given).arrays["x"], found.run(cell, ["x"]).arrays["x"])
    with pytest.raises(UsageError, match="inputs: shape"):
        found.run(cell, ["x"], inputs=given[1:])


# ---------------------------------------------------------------------------------------------- what is read off


def test_nothing_is_read_off_the_defaults():
    """The code of a model is the same text whatever its parameters' defaults are, also none."""

    def text(value):
        model = potential(0.5, 0.5)
        declared = dict.fromkeys(model.parameters, value)
        other = LureSystem(
            A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], D=model.p[0], y=SYM("y"), phi=0, x0=[0, 0], t_end=1, step=0.02,
            parameters=dict(zip(ca.vertsplit(model.p), declared.values(), strict=True)),
        )  # fmt: skip
        return cache.step_source_texts(spec_for_all_values(other, grid_of(other), 1e-9)), cache.steps_key_for_all(
            other, grid_of(other), 1e-9, "cc"
        )

    texts, keys = zip(*(text(value) for value in (None, 0.0, 1.0, -3.0)), strict=True)
    assert len(set(keys)) == 1
    assert all(one == texts[0] for one in texts)


def test_the_order_of_parameters_is_part_of_the_key():
    a, b = SYM("a"), SYM("b")
    keys = set()
    for order in ({a: 1.0, b: 2.0}, {b: 2.0, a: 1.0}):
        model = LureSystem(A=-a, B=b, C=1, law=relay(1), x0=[1], t_end=1, step=0.01, parameters=order)
        keys.add(cache.steps_key_for_all(model, grid_of(model), 1e-9, "cc"))
    assert len(keys) == 2


def test_values_far_from_one_are_found_for_sizes():
    low, high = SYM("low", 3), SYM("high", 3)
    model = LureSystem(
        A=-np.eye(3), B=np.eye(3), C=np.eye(3), law=relay(3, low - 5, high - 200), x0=[1, 2, 3], t_end=1, step=0.1,
        parameters={low: None, high: None},
    )  # fmt: skip
    cells = made(model).run(np.array([[4, 4, 4, 201, 201, 201]], float), ["x"])
    direct = simulate(model, parameters={"low": [4] * 3, "high": [201] * 3}, compiled=False)
    np.testing.assert_allclose(cells.arrays["x"][0], direct.x, rtol=1e-12)


def test_what_has_no_c_for_all_values_says_why():
    a, n = SYM("a"), 150
    chain = np.diag(-2.0 * np.ones(n)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    cases = {
        "no parameters": LureSystem(A=-1, B=1, C=1, law=relay(1), x0=[1], t_end=1, step=0.1),
        "sparse, constant": LureSystem(
            A=a * chain, B=np.eye(n), C=np.eye(n), law=complementarity(n), x0=np.ones(n), t_end=1, step=0.1, parameters={a: 1.0}
        ),
        "bounds the set": inclusion("catching-up", constraints=None, upper=[2 + SYM("w"), 5]),
        "rest on a point inside": inclusion("catching-up", tolerances=1e-6),
    }  # fmt: skip
    for words, model in cases.items():
        with pytest.raises(CodegenError, match=words):
            made(model)


def test_a_problem_of_another_form_is_left_to_others():
    """Signs of weight b <= 0 have another problem than those of b > 0, which the code is of: such a cell is not solved in C."""
    x, b, w = SYM("x", 2), SYM("b"), SYM("w")
    model = MonotoneInclusion(
        x=x, operator=[b * ca.sign(x[0]), x[1]], field=[w, 1], x0=[w, 0.5], t_end=0.2, step=0.01, scheme="implicit",
        parameters={b: 0.0, w: 1.0},
    )  # fmt: skip
    values = np.array([[0.5, 1], [0, 1], [-0.2, 1]])
    cells = made(model).run(values, ["x", "selection"])
    assert cells.status.tolist() == [OK, NOT_SOLVED, NOT_SOLVED]
    for cell, used in zip(values, (STEPS_IN_C_FOR_ALL, STEPS_IN_C, STEPS_IN_C), strict=True):
        run = simulate(model, parameters={"b": cell[0], "w": cell[1]}, compiled=True)
        assert used in run.metadata["used"]
        np.testing.assert_allclose(
            run.x, simulate(model, parameters={"b": cell[0], "w": cell[1]}, compiled=False).x, atol=1e-12
        )  # fmt: skip


# ---------------------------------------------------------------------------------------------- runs


def test_other_values_build_nothing(monkeypatch):
    model, built = lure(), []
    compile_library = cache.compile_library
    monkeypatch.setattr(cache, "compile_library", lambda *given: (built.append(given), compile_library(*given)))
    for a in (0.1, 0.2, 0.0):
        simulate(model, step=0.0078125, parameters={"a": a, "w": 1.0}, compiled=True)
    assert len(built) == 1


def test_long_runs_have_code_of_their_numbers():
    """Which library is taken follows from the model and the number of steps, and is a setting that a resumed run keeps."""
    model, given = lure(0.5, 1.0), {"a": 0.5, "w": 1.0}
    bound = model.bind(given)
    problem = one_step_problem(bound)
    most = next(
        n for n in 2 ** np.arange(10, 40) if is_fixed_code_faster("kernel", read_step_structure(problem), problem, int(n))
    )
    assert 10**5 < most < 10**8
    text = explain(model, parameters=given, compiled=True)
    assert STEPS_IN_C_FOR_ALL in text
    text = explain(model, parameters=given, t_end=float(most) * model.step, compiled=True)
    assert STEPS_IN_C in text
    assert STEPS_IN_C_FOR_ALL not in text


def test_a_run_is_resumed_as_it_began(tmp_path, monkeypatch):
    model, given = lure(), {"a": 0.4, "w": 1.0}
    whole = simulate(model, parameters=given, compiled=True, t_end=2)
    simulate(model, parameters=given, compiled=True, t_end=1, out=tmp_path / "run")
    monkeypatch.setattr("nsmodel.simulation.fixed_grid.is_fixed_code_faster", lambda *_: True)  # as if it were long now
    resumed = simulate(model, parameters=given, compiled=True, t_end=2, out=tmp_path / "run", resume=True)
    assert STEPS_IN_C_FOR_ALL in resumed.metadata["used"]
    np.testing.assert_array_equal(resumed.x, whole.x)
    assert ALL_VALUES_SUFFIX in made(model).way


@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="no /proc")
def test_libraries_do_not_pile_up(tmp_path, monkeypatch):
    """Of models that are all kept no more than some have their libraries loaded, and no more than some files stay."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("nsmodel.codegen.rollout.MAX_LOADED", 3)
    monkeypatch.setattr(cache, "MAX_LIBRARIES", 4)
    models = [LureSystem(A=-1 - k, B=1, C=1, law=relay(1), x0=[1], t_end=0.1, step=0.01) for k in range(6)]
    runs = [simulate(model, compiled=True) for model in models]
    gc.collect()
    with open("/proc/self/maps", encoding="utf-8") as lines:
        loaded = {line.split()[-1] for line in lines if str(tmp_path) in line}
    assert 0 < len(loaded) <= 3 < MAX_LOADED
    assert len(list((tmp_path / "nsmodel").glob("*.so"))) <= 4 + 3
    np.testing.assert_array_equal(simulate(models[0], compiled=True).x, runs[0].x)


def test_runs_do_not_contract_sums():
    """A fused product and sum has other bits, and processors differ in whether they have it."""
    assert "-ffp-contract=off" in library.COMPILER_FLAGS
    assert "-ffp-contract=off" in QUICK
