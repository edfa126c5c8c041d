"""Many bodies in C: against optimality conditions written down here, stored solutions, the interpreted step, brute force."""

from __future__ import annotations

import ctypes
import subprocess

import casadi as ca
import numpy as np
import pytest
from conftest import COUNT, FULL, SHARED
from scipy.spatial import cKDTree

import nsmodel
from nsmodel import Bodies, Family, Items, ManyBodies, codegen, neighbours
from nsmodel.codegen.library import compiler
from nsmodel.codegen.structs import NO_ROOM, STATUSES
from nsmodel.crowd import Noise
from nsmodel.errors import CodegenError, StepError
from nsmodel.models.many_bodies.contact_solver import COLD_BODIES_START, BodiesStepper
from nsmodel.models.many_bodies.schemes import BodiesProblem
from nsmodel.models.many_bodies.step_library import CompiledBodiesStep
from tests.models.test_crowd import few, hopper
from tests.models.test_many_bodies import discs, misfit, scattered

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")


def steps(model, count, *, step=None):
    """``count`` compiled steps from the start: (q, the step's answer) each."""
    bound = model.bind()
    step = CompiledBodiesStep(bound, 1e-9) if step is None else step
    q, warm = bound.bodies.q0, COLD_BODIES_START
    for k in range(count):
        found = step(k * model.step, model.step, q, warm, k)
        yield q, found
        q, warm = found.q, found.warm


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_each_step_is_optimal_for_all_constraints(d, seed):
    model = scattered({1: 12, 2: 60, 3: 64}[d], seed, d=d, step=0.05)
    acted = 0
    for k, (q, found) in enumerate(steps(model, 12 if COUNT == FULL else 8)):
        assert misfit(model, k * model.step, q, found) < 1e-11
        acted = max(acted, len(found.contacts.first))
    assert acted > {1: 0, 2: 5, 3: 5}[d]


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.long
def test_bodies_of_all_sizes_meet(d):
    rng = np.random.default_rng(d)
    places, radii = [np.zeros(d)], [2.0]
    while len(places) < {1: 25, 2: 150, 3: 150}[d]:
        r, of, way = 10 ** rng.uniform(-3, -0.3), rng.integers(len(places)), rng.normal(size=d)
        q = places[of] + (radii[of] + r + 1e-4) * way / np.linalg.norm(way)
        if all(np.linalg.norm(q - p) > r + s for p, s in zip(places, radii, strict=True)):
            places.append(q)
            radii.append(r)
    model = discs(np.array(places), np.array(radii), f=lambda t, q: -q, step=1e-4)
    sizes = set()
    for k, (q, found) in enumerate(steps(model, 30)):
        assert misfit(model, k * model.step, q, found) < 1e-11
        sizes |= {
            (min(radii[i], radii[j]) < 0.01, max(radii[i], radii[j]) > 1) for i, j in zip(*found.contacts[1:3], strict=True)
        }
    assert (True, True) in sizes or d == 1
    assert (True, False) in sizes or d == 3


def test_a_step_agrees_with_the_interpreted_one_and_repeats():
    model = scattered(80, 3, step=0.05)
    interpreted = BodiesStepper(BodiesProblem(model.bind()), "auto", 1e-9)
    for k, (q, found) in enumerate(steps(model, 15)):
        other = interpreted(k * model.step, model.step, q, COLD_BODIES_START, k)
        assert found.q == pytest.approx(other.q, abs=1e-11)
        assert found.gap_min == pytest.approx(other.gap_min, abs=1e-11)
        assert found.residual < 1e-11
    one, again = (list(steps(model, 15)) for _ in range(2))
    assert all((a.q == b.q).all() for (_, a), (_, b) in zip(one, again, strict=True))


@pytest.mark.parametrize("n", [10, 200, 1000])
def test_quadratic_programmes_of_a_crowd(n):
    path = SHARED / "data" / "crowd" / f"crowd_qp_N{n}.npz"
    if not path.is_file():
        pytest.skip(f"no reference data: {path}")
    data = np.load(path)
    q, side, wish = data["q_k"].reshape(-1, 2), max(0.6 * np.ceil(np.sqrt(n)), 2.4), data["V"].reshape(-1, 2)
    low, high = side / 2 - 0.6, side / 2 + 0.6
    ends = np.array([[(0, 0), (0, side)], [(0, 0), (side, 0)], [(0, side), (side, side)],
                     [(side, 0), (side, low)], [(side, high), (side, side)]])  # fmt: skip
    bodies, walls = Bodies(q, r=data["r"]), Items(a=ends[:, 0], b=ends[:, 1])
    i, j, w = bodies.member("i"), bodies.member("j"), walls.member("w")
    part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, w.b - w.a) / ca.sumsqr(w.b - w.a), 0), 1)
    model = ManyBodies(
        bodies=bodies, f=lambda t, q: wish, t_end=1, step=float(data["h"]),
        constraints={
            "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
            "wall": Family(ca.norm_2(i.q - w.a - part * (w.b - w.a)) - i.r, i, w),
        },
    )  # fmt: skip
    ((_, found),) = steps(model, 1)
    assert found.q.ravel() == pytest.approx(data["q_star"], abs=1e-8)


def test_an_arch_ends_a_run_and_noise_turns_wishes_as_in_interpreted_steps():
    interpreted, compiled = (nsmodel.simulate(hopper(), compiled=way) for way in (False, True))
    ends = [run.metadata["bodies"]["standstill"] for run in (interpreted, compiled)]
    assert compiled.metadata["used"][-1].startswith("steps in C")
    assert ends[0]["for_good"] == ends[1]["for_good"] == "held"
    assert abs(ends[0]["since"] - ends[1]["since"]) < 0.11  # rounding differs
    assert [(arch["bodies"], arch["ends"]) for arch in ends[0]["arches"]] == [
        (arch["bodies"], arch["ends"]) for arch in ends[1]["arches"]
    ]
    noisy = [nsmodel.simulate(few(noise=Noise(1.0)), compiled=way).x for way in (False, True)]
    assert np.allclose(*noisy, rtol=0, atol=1e-9, equal_nan=True)


@pytest.mark.long
def test_nobody_overlaps_in_five_hundred_steps_of_a_thousand(load_case):
    run = nsmodel.simulate(load_case("crowd", n=1000), t_end=10, compiled=True)
    r, worst = run.metadata["scene"]["radii"], np.inf
    r = np.array(r)
    for row in range(0, 501, 20):
        there = np.isfinite(run.q[row]).reshape(-1, 2).all(axis=1)
        q, radii = run.q[row].reshape(-1, 2)[there], r[there]
        pairs = cKDTree(q).query_pairs(0.5, output_type="ndarray")
        gaps = np.linalg.norm(q[pairs[:, 0]] - q[pairs[:, 1]], axis=1) - radii[pairs].sum(axis=1)
        worst = min(worst, gaps.min(initial=np.inf))
    assert run.status == "done"
    assert worst > -1e-10
    assert run.gap_min.min() > -1e-10
    assert np.nanmax(run.residual) < 1e-9
    assert max(run.metadata["solver_counts"], key=run.metadata["solver_counts"].get) != "none needed"


def test_nobody_overlaps_in_fifty_steps_of_twenty_thousand(load_case):
    model = load_case("crowd", n=20_000)
    run = nsmodel.simulate(model, t_end=1, compiled=True, save_every=50)
    assert run.metadata["totals"]["least_gap"] > -1e-10
    assert run.metadata["totals"]["worst_residual"] < 1e-9
    assert run.metadata["totals"]["most_contacts"] > 20


def test_a_row_beyond_the_first_cut_off_is_not_missed():
    model = discs([(0, 0), (1, 0), (4, 0)], [0.5, 0.5, 0.5], step=0.1)
    moving = ManyBodies(
        bodies=model.bodies, t=(t := ca.SX.sym("t")), f=0, t_end=1, step=0.1,
        constraints=dict(model.constraints) | {"piston": Family(model.constraints["pair"].first.q[0] - 26 * t,
                                                                model.constraints["pair"].first)},
    )  # fmt: skip
    step = CompiledBodiesStep(moving.bind(), 1e-9)
    found = step(0.0, 0.1, moving.bodies.q0)
    assert step.report.repeats > 0  # nothing wants to move: the first look sees the piston alone
    assert found.q == pytest.approx(np.array([[2.6, 0], [3.6, 0], [4.6, 0]]), abs=1e-12)


def test_a_step_that_has_no_answer_is_refused():
    squeezed = discs([(0.5, 0)], [0.4], t_end=1, step=0.1, walls=[((1, 0), 0.0), ((-1, 0), -0.9)])
    t = ca.SX.sym("t")
    i = squeezed.constraints["wall"].first
    closing = ManyBodies(
        bodies=squeezed.bodies, t=t, t_end=1, step=0.1,
        constraints={"left": Family(i.q[0] - t - i.r, i), "right": Family(0.9 - i.q[0] - i.r, i)},
    )  # fmt: skip
    step = CompiledBodiesStep(closing.bind(), 1e-9)
    q = closing.bodies.q0
    assert step(0.0, 0.1, q).q == pytest.approx(np.array([[0.5, 0]]))
    with pytest.raises(StepError):
        step(0.1, 0.1, q)
    assert np.isnan(step(0.0, 0.1, q * np.nan).q).all()  # nobody is there
    points = discs([(0.0, 0), (1, 0), (1, 0)], [1.0, 1.0, 1.0], step=0.1)  # two in one place: no gradient
    with pytest.raises(StepError):
        CompiledBodiesStep(points.bind(), 1e-9)(0.0, 0.1, points.bodies.q0)


def test_chains_of_given_pairs_and_hyperstatic_lattices():
    n = 60
    bodies = Bodies(np.column_stack([np.arange(n) * 0.9, np.zeros(n)]))
    i, j = bodies.member("i"), bodies.member("j")
    chain = ManyBodies(
        bodies=bodies, f=lambda t, q: np.column_stack([np.linspace(-1, 1, n), np.sin(np.arange(n))]), t_end=1, step=0.1,
        constraints={"bead": Family(ca.norm_2(i.q - j.q) - 0.8, i, j, over=neighbours(n))},
    )  # fmt: skip
    interpreted = BodiesStepper(BodiesProblem(chain.bind()), "auto", 1e-9)
    for k, (q, found) in enumerate(steps(chain, 10)):
        assert found.q == pytest.approx(interpreted(0.1 * k, 0.1, q, COLD_BODIES_START, k).q, abs=1e-10)
    k = np.arange(100)
    places = np.column_stack([k % 10 + 0.5 * (k // 10 % 2), k // 10 * np.sqrt(3) / 2])  # touching, more contacts than unknowns
    packed = discs(places, np.full(100, 0.5 - 1e-12), lambda t, q: [5, 4] - q, step=0.01)
    for q, found in steps(packed, 5):
        assert misfit(packed, 0.0, q, found) < 1e-10


def test_memory_grows_as_needed():
    model = scattered(60, 0, step=0.05)
    step = CompiledBodiesStep(model.bind(), 1e-9)
    step._memory = np.empty(64, np.uint8)
    small = [found.q for _, found in steps(model, 8, step=step)]
    assert all((a == b.q).all() for a, (_, b) in zip(small, steps(model, 8), strict=True))
    assert step._memory.size > 10_000


# ------------------------------------------------------------------------------------------------------- the library written


@pytest.fixture(scope="module")
def written(tmp_path_factory, load_case):
    """The library of 30 people, its folder."""
    folder = tmp_path_factory.mktemp("crowd")
    codegen.write(load_case("crowd", n=30), folder, name="crowd")
    return folder


@pytest.mark.usefixtures("system_compiler")
def test_the_library_compiles_strictly_and_runs_the_case(written, load_case):
    name = compiler().split()
    flags = "-std=c99 -g -Wall -Wextra -pedantic -Werror -Wconversion -Wsign-conversion".split()
    flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover"]
    subprocess.run([*name, *flags, "-o", "example", "crowd.c", "example_main.c", "-lm"], cwd=written, check=True)
    done = subprocess.run(["./example"], cwd=written, check=True, capture_output=True, text=True)
    rows = np.genfromtxt(done.stdout.splitlines(), delimiter=",", skip_header=1)
    run = nsmodel.simulate(load_case("crowd", n=30), compiled=False)
    there = np.isfinite(rows[:, 2:]) & np.isfinite(run.q)
    assert rows[:, 0] == pytest.approx(run.t)
    assert rows[:, 2:][there] == pytest.approx(run.q[there], abs=1e-9)
    assert there.mean() > 0.8
    assert rows[-1, 1] < 30


def test_a_library_refuses_what_it_has_no_room_for_and_changes_nothing(written):
    name = compiler().split()
    subprocess.run([*name, "-std=c99", "-O1", "-fPIC", "-shared", "-DCROWD_MEMORY=30000", "-o", "small.so", "crowd.c", "-lm"],
                   cwd=written, check=True)  # fmt: skip
    library = ctypes.CDLL(str(written / "small.so"))
    library.crowd_create.restype = library.crowd_status_text.restype = ctypes.c_void_p
    solver = ctypes.c_void_p(library.crowd_create())
    state, after = np.zeros(60), np.zeros(60)
    statuses = []
    for _ in range(60):
        library.crowd_get_state(solver, state.ctypes.data_as(ctypes.c_void_p))
        statuses.append(library.crowd_step(solver))
        if statuses[-1]:
            break
    library.crowd_get_state(solver, after.ctypes.data_as(ctypes.c_void_p))
    assert statuses[-1] == NO_ROOM
    assert len(statuses) > 2
    assert (state == after).all()
    assert "MEMORY" in ctypes.string_at(library.crowd_status_text(NO_ROOM)).decode()
    library.crowd_free(solver)


def test_the_library_loads_in_python(written, load_case):
    solver = codegen.load(written).solver()
    run = nsmodel.simulate(load_case("crowd", n=30), t_end=0.4, compiled=False)
    for _ in range(20):
        assert solver.step() == 0
    assert solver.t == pytest.approx(0.4)
    assert solver.x == pytest.approx(run.q[-1], abs=1e-10)
    assert solver.residual < 1e-9


@pytest.fixture(scope="module")
def marbles(tmp_path_factory):
    """The library of 30 marbles above a floor."""
    k = np.arange(30)
    spread = 0.02 * np.random.default_rng(0).uniform(-1, 1, 30)
    bodies = Bodies(np.column_stack([0.25 * (k % 6) + spread, 0.3 + 0.25 * (k // 6)]), r=np.full(30, 0.1))
    i, j = bodies.member("i"), bodies.member("j")
    model = ManyBodies(
        bodies=bodies, f=ca.vertcat(0, -9.81), t_end=1, step=0.02,
        constraints={"pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j), "floor": Family(i.q[1] - i.r, i)},
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("marbles")
    codegen.write(model, folder, name="marbles")
    return codegen.load(folder)


STATUS = {status.name: i for i, status in enumerate(STATUSES)}


def test_nan_is_not_forgotten(marbles):
    solver = marbles.solver()
    start = solver.x
    assert solver.set_step(1e307) == 0
    assert solver.step() == STATUS["NOT_SOLVED"]
    assert solver.residual == np.inf
    assert (solver.x == start).all()
    assert (solver.set_state(start - np.tile([0, 0.15], 30)), solver.set_step(0.02), solver.step()) == (0, 0, 0)
    assert np.isfinite(solver.x).all()
    for h in 10.0 ** np.arange(10, 309, 13):
        for x in (start, start - np.tile([0, 0.15], 30), 1e200 * start):
            solver.reset()
            assert (solver.set_state(x), solver.set_step(h)) == (0, 0)
            for _ in range(3):
                before = solver.x
                assert np.isfinite(solver.x).all() if solver.step() == 0 else (solver.x == before).all()
            assert np.isfinite(solver.residual) == (solver.status == 0)


def test_the_library_refuses_what_is_wrong(marbles):
    solver = marbles.solver()
    start = solver.x
    for body in (-1, 30, 2**31 - 1, -(2**31)):
        assert solver.set_present(body, False) == STATUS["BAD_INDEX"]
    assert (solver.set_present(29, False), solver.set_present(0, False)) == (0, 0)
    gone = np.r_[[np.nan, np.nan], start[2:]]
    assert solver.set_state(gone) == 0  # nobody is there
    assert solver.set_present(0, True) == STATUS["NOT_FINITE"]
    assert solver.step() == 0
    for value, name in ((1e17, "BAD_STEP"), (-1e17, "BAD_STEP"), (1.7e308, "BAD_STEP")):
        assert solver.set_time(value) == 0
        assert solver.step() == STATUS[name]
    for value in (np.nan, np.inf):
        assert solver.set_time(value) == solver.set_state(start * value) == STATUS["NOT_FINITE"]
        assert solver.set_step(value) == STATUS["BAD_STEP"]
    zeros = ctypes.create_string_buffer(8_000_000)
    for name, arguments in (("step", ()), ("reset", ()), ("set_time", (ctypes.c_double(0),)), ("set_step", (ctypes.c_double(1),)),
                            ("set_state", (start.ctypes.data_as(ctypes.c_void_p),)), ("set_present", (0, 0))):  # fmt: skip
        function = marbles.mapped[f"marbles_{name}"]
        function.argtypes = None
        assert function(zeros, *arguments) == STATUS["NOT_INITIALISED"]
    texts = [marbles.status_text(i) for i in range(len(STATUSES) + 1)]
    assert len(set(texts)) == len(texts)


def test_pressure_is_that_of_the_step_taken(marbles):
    solver, out = marbles.solver(), np.zeros(30)
    for _ in range(8):
        assert solver.step() == 0
    get = marbles.function("get_pressure", None, ctypes.c_void_p, ctypes.c_void_p)
    get(solver._address, out.ctypes.data)
    before = out.copy()
    assert before.max() > 5
    assert solver.set_step(0.005) == 0
    get(solver._address, out.ctypes.data)
    assert (out == before).all()


def test_work_is_counted_and_capped(written, load_case, tmp_path):
    solver = codegen.load(written).solver()
    work = []
    while max(work, default=0) < 4:
        assert solver.step() == 0
        work.append(solver.work)
        assert work[-1] >= solver.iterations
        assert len(work) < 200
    codegen.write(load_case("crowd", n=30), tmp_path, name="crowd", max_work=max(work) - 1)
    capped = codegen.load(tmp_path).solver()
    for _ in work[:-1]:
        before = capped.x
        assert capped.step() == 0
    before = capped.x
    assert capped.step() == STATUS["NOT_SOLVED"]
    assert capped.work <= max(work) - 1
    assert (capped.x == before).all()


def test_what_has_no_counterpart_is_refused(tmp_path):
    model = discs([(0, 0)], [1.0], lambda t, q: 0 * q)
    with pytest.raises(CodegenError, match="f is a Python function"):
        codegen.write(model, tmp_path / "no")
    assert not (tmp_path / "no").exists()
