"""The step of catching-up in C against its Python reference: whole runs, steps from ties, hard sets, bad numbers."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from functools import cache

import casadi as ca
import numpy as np
import pytest
from conftest import optimised

from nsmodel import MonotoneInclusion, codegen
from nsmodel.errors import StepError
from nsmodel.modeling.time_grid import make_grid
from nsmodel.solvers.catching_up import CatchingUpStepper
from nsmodel.solvers.one_step_problem import one_step_problem

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = [COMPILER, "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", optimised("-O1")]
TOLERANCE = 1e-9

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


# ---------------------------------------------------------------------------------------------- scenes


def inclusion(n=2, **given):
    """An inclusion with n states; what is given as a function is called with them."""
    x = ca.SX.sym("x", n)
    called = {key: value(x) if callable(value) and key != "tolerances" else value for key, value in given.items()}
    return MonotoneInclusion(**({"x": x, "t_end": 1.5, "step": 0.02} | called))


def disc(x):
    return {"disc": 1 - ca.sumsqr(x)}


def corner(x):
    """A disc cut off by a line: driven to the right, the state comes to rest where they meet."""
    return {"disc": 1 - ca.sumsqr(x), "line": 0.8 - x[0]}


def triangle(x):
    return {"a": 1 - x[0] - x[1], "b": 2 + x[0] - 3 * x[1], "c": 0.5 + x[0]}


def bent(x):
    return {"disc": 1 - ca.sumsqr(x), "bent": 2.2 - ca.exp(x[1]) + x[0], "line": 0.5 + x[0]}


def spiral(x):
    return ca.vertcat(2 * x[0] + 4 * x[1] + 0.5, 2 * x[1] - 4 * x[0])


RIGHT = {"field": [1, 0.5], "x0": [0.3, 0.7]}
OUTWARDS = {"field": spiral, "x0": [0.2, 0.3]}
DRY = {"phi": lambda x: 0.5 * ca.fabs(x[0]) + 0.3 * ca.fabs(x[1] - 0.2)}
ISOTROPIC = {"phi": lambda x: 0.5 * ca.norm_2(x[:2]) + 0.3 * ca.fabs(x[2])}


STEPS = 75
EPS_K = {"tolerances": [10.0 ** -(2 + k % 5) * (k % 8 > 0) for k in range(STEPS)]}
SCENES = {
    "half-lines": lambda: inclusion(
        3, field=lambda x: ca.vertcat(-1, 2 - x[0], x[0] * x[1]), x0=[0.2, 0, 0.1], lower=[0, -np.inf, -1],
        upper=[np.inf, 0.7, np.inf], tolerances=lambda h: h**3,
    ),
    "no set": lambda: inclusion(field=lambda x: ca.vertcat(1 - x[1], -x[0]), x0=[0.5, 0.4], **DRY),
    "box, eps_k": lambda: inclusion(field=spiral, x0=[0, 0.3], lower=-0.4, upper=[0.5, 0.3], **EPS_K, **DRY),
    "corner": lambda: inclusion(constraints=corner, **RIGHT),
    "triangle": lambda: inclusion(constraints=triangle, **OUTWARDS),
    "bent, dry": lambda: inclusion(constraints=bent, **OUTWARDS, **DRY),
    "corner, eps_k": lambda: inclusion(constraints=corner, **EPS_K, **RIGHT),
    "bent, eps": lambda: inclusion(constraints=bent, tolerances=lambda h: h**3, **OUTWARDS, **DRY),
    "isotropic, ball": lambda: inclusion(3, field=[2, 0.5, -0.7], x0=[0.1, -0.1, 0.2], constraints=disc, **ISOTROPIC),
}  # fmt: skip


RUN = """
#include "tried.c"
static int put(double *row, int at, int n, const double *values)
{
    for (int i = 0; i < n; i++)
        row[at + i] = values[i];
    return at + n;
}
/* From x, as the steps from number first on: rows as in Python. Return how many were solved. */
int run(const double *x, double *rows, signed char *index, int first, int steps);
int run(const double *x, double *rows, signed char *index, int first, int steps)
{
    static tried_solver s;
    tried_init(&s);
    for (int k = 0; k < first; k++)
        tried_step(&s);
    memcpy(s.x, x, sizeof s.x);
    for (int k = 0; k < steps; k++) {
        if (tried_step(&s) != TRIED_OK)
            return k;
        const double newton = s.work.iterations;
        int at = put(rows, 0, TRIED_NX, s.x);
        MULTIPLIERS
        at = put(rows, at, 1, &s.work.residual);
        at = put(rows, at, 1, &newton);
        at = put(rows, at, TRIED_NX, s.inclusion.v);
        SELECTION
        at = put(rows, at, TRIED_NX, s.inclusion.defect);
        at = put(rows, at, 1, &s.inclusion.predictor_distance);
        at = put(rows, at, 1, &s.inclusion.excess);
        at = put(rows, at, 1, &s.inclusion.tolerance);
        rows += at;
        (void)index;
    }
    return steps;
}
"""
MULTIPLIERS = """
        at = put(rows, at, TRIED_M, s.work.l);
        at = put(rows, at, TRIED_M, s.work.y);
        memcpy(index + k*TRIED_M, s.work.code, TRIED_M);
"""
SELECTION = "at = put(rows, at, TRIED_SELECTION, s.inclusion.selection);"


def compiled(folder, model, rows, selection):
    """The function run of a model's library."""
    codegen.write(model, folder, name="tried")
    text = RUN.replace("MULTIPLIERS", MULTIPLIERS if rows else "").replace("SELECTION", SELECTION if selection else "", 1)
    (folder / "run.c").write_text(text)
    subprocess.run([*STRICT, "-fPIC", "-shared", "-o", "run.so", "run.c", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "run.so")).run


class Both:
    """A model's step in C and in Python."""

    def __init__(self, model, folder):
        self.model = model.bind()
        self.grid = make_grid(self.model, None, None, None)
        self.h = self.grid.h
        problem = one_step_problem(self.model)
        self.start = np.array(ca.DM(self.model.x0)).ravel()
        self.python = CatchingUpStepper(problem, problem.prediction, "auto", TOLERANCE, h=self.h, state=self.start)
        self.layout, self.rows = self.python.layout, problem.l.numel()
        selection = self.layout.slices["selection"]
        self.in_c = compiled(folder, self.model, self.rows, selection.stop - selection.start)

    def run(self, x, steps, k=0):
        """Rows and index sets of ``steps`` steps in C, fewer where one is not solved."""
        rows, index = np.full((steps, self.layout.width), np.nan), np.zeros((steps, self.rows), np.int8)
        x = np.array(x, float)
        done = self.in_c(*(ctypes.c_void_p(array.ctypes.data) for array in (x, rows, index)), k, steps)
        return rows[:done], index[:done]

    def step(self, x, k=0):
        """One step in C by column, from a state and without a warm start; None where it is not solved."""
        rows, index = self.run(x, 1, k)
        return self.columns(rows[0]) | {"index": index[0]} if len(rows) else None

    def step_in_python(self, x, k=0):
        try:
            found = self.python(k * self.h, self.h, np.asarray(x, float), self.python.cold_start(), k)
        except StepError:
            return None
        return self.columns(found.row) | {"index": found.warm.index}

    def columns(self, row):
        return {name: row[part] for name, part in self.layout.slices.items()}


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Return both(name of a scene or of ties, or a model) -> Both."""

    @cache
    def made(scene):
        model = SCENES[scene]() if scene in SCENES else pushed(*TIES[scene]) if scene in TIES else scene
        return Both(model, tmp_path_factory.mktemp("inclusion"))

    return made


# ---------------------------------------------------------------------------------------------- whole runs


def check_run(both, steps):
    """Compare every column of every row; return the largest differences of multipliers and iterations, and C's index sets."""
    rows, index = both.run(both.start, steps)
    assert len(rows) == steps
    x, warm = both.start, both.python.cold_start()
    worst = dict.fromkeys(both.layout.slices, 0.0)
    for k in range(steps):
        found = both.python(k * both.h, both.h, x, warm, k)
        x, warm = found.row[both.layout.state], found.warm
        for name, part in both.layout.slices.items():
            worst[name] = max(worst[name], float(np.abs(rows[k][part] - found.row[part]).max(initial=0)))
    assert worst.pop("residual") <= 1e-12
    multipliers, newton = worst.pop("l"), worst.pop("newton")
    assert max(worst.values()) <= 1e-10, worst
    return multipliers, newton, index


@pytest.mark.parametrize("stem", ["inclusion_8_1", "inclusion_8_2", "inclusion_8_2_full"])
def test_cases_run_as_in_python(stem, both, load_case, run_case):
    scene = both(load_case(stem))
    multipliers, newton, index = check_run(scene, scene.grid.N)
    assert (multipliers, newton) == (pytest.approx(0, abs=1e-12), 0)
    assert (index == run_case(stem).index_set[1:]).all()


@pytest.mark.parametrize("name", SCENES)
def test_scenes_run_as_in_python(name, both):
    multipliers, newton, index = check_run(both(name), STEPS)
    assert multipliers <= 1e-10
    assert newton == 0
    assert (index == 0).any() or not both(name).rows  # something acts, somewhere


def test_what_the_tolerance_allows_is_used_and_kept(both):
    """Of eps_k an approximate step uses up some, an exact one (eps_k = 0) nothing; d is a lower bound of d_C(y)."""
    for name in ("box, eps_k", "corner, eps_k", "half-lines", "bent, eps"):
        scene = both(name)
        rows, _ = scene.run(scene.start, STEPS)
        steps = [scene.columns(row) for row in rows]
        eps, excess = (np.array([float(step[key][0]) for step in steps]) for key in ("tolerance", "excess"))
        assert (excess <= eps).all()
        assert excess.max() > 1e-12, name
        assert (excess[eps == 0] == 0).all()
        if "eps_k" in name:
            assert (eps == EPS_K["tolerances"]).all()
    exact, approximate = both("corner"), both("corner, eps_k")
    for x in np.random.default_rng(0).uniform(-0.5, 0.8, (60, 2)):
        a, b = exact.step(x), approximate.step(x, 3)
        d, bound = a["predictor_distance"][0], b["predictor_distance"][0]
        assert bound <= d + 1e-13
        assert (b["defect"] ** 2).sum() <= d**2 + b["tolerance"][0]
        assert (b["y"] >= 0).all()


def test_multipliers_of_an_approximate_projection_sum_over_cuts(both):
    """x - y = J(z)' l: where the state rests in a corner both constraints carry it, however many cuts there were."""
    scene = both("corner, eps_k")
    rows, index = scene.run(scene.start, STEPS)
    for k in (70, 72, 74):
        step = scene.columns(rows[k])
        x = step["state"]
        assert x == pytest.approx([0.8, 0.6], abs=1e-2)
        J = np.array([-2 * x, [-1, 0]])
        assert J.T @ step["l"] == pytest.approx(step["defect"], abs=3 * np.sqrt(step["tolerance"][0]) + 1e-4)
        if step["tolerance"][0] < 1e-4:
            assert (index[k] == 0).all()


# ---------------------------------------------------------------------------------------------- ties


def pushed(n, phi, wall):
    """n states pushed by a force that stands still, which is n more states: one library for all forces; x_1 >= ``wall``."""
    x = ca.SX.sym("x", 2 * n)
    return MonotoneInclusion(
        x=x, field=ca.vertcat(x[n:], ca.SX.zeros(n)), phi=phi(x), lower=[wall] + [-np.inf] * (2 * n - 1), x0=np.zeros(2 * n),
        t_end=1, step=0.05,
    )  # fmt: skip


TIES = {
    "relays": (2, lambda x: 0.5 * ca.fabs(x[0]) + 0.3 * ca.fabs(x[1]), -np.inf),
    "relay and side at a wall": (2, lambda x: 0.5 * ca.fabs(x[0] - x[1]) + 0.4 * ca.fmax(x[0] + 2 * x[1], 0), 0),
    "ball": (3, lambda x: 0.6 * ca.norm_2(x[:3]), -np.inf),
    "ball and relay at a wall": (3, lambda x: 0.3 * ca.fabs(x[2]) + 0.5 * ca.norm_2(ca.DM([[1, 2, 0], [0, 1, -1]]) @ x[:3]), 0),
    "two balls": (4, lambda x: 0.5 * ca.norm_2(x[:2]) + 0.4 * ca.norm_2(x[2:4] - x[:2]), -np.inf),
}


@pytest.mark.parametrize("name", TIES)
def test_selection_at_ties(name, both):
    """From where the operator is discontinuous: the velocity of least norm, which is 0 where the state can stay."""
    n, _, wall = TIES[name]
    scene = both(name)
    rng = np.random.default_rng(1)
    rests = 0
    for _ in range(60):
        x = rng.choice([0.0, 0.0, 0.3, -0.3 if wall < 0 else 0.6], n)
        force = rng.normal(size=n) * rng.choice([0.1, 0.6, 2])
        found, expected = scene.step([*x, *force]), scene.step_in_python([*x, *force])
        assert found["residual"] <= TOLERANCE
        assert found["state"] == pytest.approx(expected["state"], abs=1e-10)
        if wall < 0 or x[0] > 0:  # else a part of v that points into the wall is free
            assert found["v"] == pytest.approx(expected["v"], abs=1e-9)
        rests += not x.any() and np.abs(found["v"][:n]).max() <= 1e-12
    assert rests >= 2


def test_rest_is_where_friction_holds(both):
    """By hand: a relay holds |F_i| <= mu_i and takes mu_i of more, a ball |F| <= r; both in any direction."""
    relays, ball = both("relays"), both("ball")
    rng = np.random.default_rng(2)
    mu = np.array([0.5, 0.3])
    for _ in range(60):
        F = rng.normal(size=2) * rng.choice([0.2, 0.6, 2])
        assert relays.step([0, 0, *F])["v"][:2] == pytest.approx(np.sign(F) * np.maximum(abs(F) - mu, 0), abs=1e-14)
        F = rng.normal(size=3) * rng.choice([0.2, 0.6, 2])
        size = np.linalg.norm(F)
        step = ball.step([0, 0, 0, *F])
        assert step["v"][:3] == pytest.approx(F * max(1 - 0.6 / size, 0), abs=1e-13)
        assert np.linalg.norm(step["selection"]) <= 0.6 * (1 + 1e-12)


# ---------------------------------------------------------------------------------------------- hard sets, bad numbers


def random_set(seed):
    """A convex set around 0 with half-spaces, balls and exponentials, and a field that drives the state about in it."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    x = ca.SX.sym("x", n)
    c = {}
    for i in range(rng.integers(2, 5)):
        a = rng.normal(size=n)
        c[f"c{i}"] = [
            rng.uniform(0.2, 1) - ca.dot(a, x),
            rng.uniform(0.3, 1) - ca.sumsqr(x - 0.1 * a),
            1.3 - ca.exp(ca.dot(a, x)) + ca.dot(rng.normal(size=n), x) * 0.3,
        ][rng.integers(3)]
    K, eps = rng.normal(size=(n, n)), 10.0 ** rng.uniform(-12, -3)
    return MonotoneInclusion(
        x=x, field=3 * rng.normal(size=n) + K @ x, constraints=c, x0=np.zeros(n), t_end=1, step=0.04, tolerances=eps
    )


@pytest.mark.parametrize("seed", [4, 18])
def test_approximate_projections_on_random_sets(seed, both):
    """A step's motion from C: as in Python. Far from C, where cuts nearly coincide: solved as often, and right."""
    model = random_set(seed)
    scene = both(model)
    J = ca.Function("J", [model.x], [ca.jacobian(ca.vertcat(*model.constraints.values()), model.x)])
    rng = np.random.default_rng(seed)
    n = scene.start.size
    for _ in range(100):
        x = rng.normal(size=n) * 0.2
        found, expected = scene.step(x), scene.step_in_python(x)
        assert found["state"] == pytest.approx(expected["state"], abs=1e-10)
        assert found["newton"] == expected["newton"]
    solved = in_python = 0
    for _ in range(8):
        x = rng.normal(size=n) * 2
        found, expected = scene.step(x), scene.step_in_python(x)
        solved, in_python = solved + (found is not None), in_python + (expected is not None)
        if found is None:
            continue
        assert (found["y"] >= 0).all()
        assert found["excess"] <= found["tolerance"]
        defect = np.linalg.norm(found["defect"])  # J(x)' l, with l summed over the cuts of each constraint
        assert np.linalg.norm(np.array(J(found["state"])).T @ found["l"] - found["defect"]) <= 1e-3 * defect
        if expected is not None:
            far = float(expected["predictor_distance"][0])
            slack = float(expected["tolerance"][0]) + 1e-12 * far**2
            assert abs(found["predictor_distance"][0] ** 2 - far**2) <= slack
            assert (found["defect"] ** 2).sum() <= far**2 + 2 * slack
    assert solved >= in_python


HUGE = [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e160, 5e-324]


@pytest.mark.parametrize("name", ["half-lines", "box, eps_k", "corner", "bent, dry", "bent, eps", "isotropic, ball"])
def test_bad_numbers_end(name, both):
    """NaN, infinite and huge states: not solved, or a finite step."""
    scene = both(name)
    rng = np.random.default_rng(0)
    for _ in range(60):
        x = scene.start.copy()
        x[rng.integers(x.size)] = rng.choice(HUGE)
        step = scene.step(x)
        if not np.isfinite(x).all():
            assert step is None
        elif step is not None:
            assert np.isfinite(step["state"]).all()
            assert step["residual"] <= TOLERANCE


def test_a_field_without_value_is_not_stepped(both):
    """A root of a negative number: C stops at the step at which Python does; and where field, operator or set are no numbers."""
    x = ca.SX.sym("x")
    scene = both(MonotoneInclusion(x=x, field=1 + ca.sqrt(0.25 - x), operator=-x, lower=-1, upper=2, x0=0, t_end=9, step=0.1))
    rows, _ = scene.run(scene.start, 20)
    assert 0 < len(rows) < 20
    assert rows[-1][0] > 0.25
    assert scene.step_in_python(rows[-1][:1]) is None
    z = ca.SX.sym("z", 2)
    ill = both(MonotoneInclusion(
        x=z, field=ca.vertcat(1 / z[1], 1), operator=ca.vertcat(ca.sign(ca.sqrt(z[0]) - 1), 0), x0=[1, 0.5], t_end=1, step=0.1,
        constraints={"c": 2 - ca.sumsqr(z), "d": ca.log(2 - z[1])}, tolerances=1e-6,
    ))  # fmt: skip
    assert ill.step([1, 0.5]) is not None
    assert ill.step([1, 0]) is None
    assert ill.step([-1, 0.5]) is None
    assert ill.step([0.5, 1.95]) is None


def test_a_tolerance_far_beyond_the_set(both):
    """Of a bounded side the middle, of a half-line 1 + |x| inwards, and no further."""
    generous = both(inclusion(field=[1, 0], x0=[0, 0], lower=-1, upper=[1, np.inf], tolerances=1e3))
    step = generous.step([0.999, 3])
    assert step["state"] == pytest.approx([0, 7])
    assert step["excess"] == pytest.approx(1.019**2 + 4**2 - 0.019**2)
    assert generous.step([-30, -40])["state"] == pytest.approx(generous.step_in_python([-30, -40])["state"], abs=1e-12)


def test_what_fails_changes_nothing(tmp_path):
    """A step that is not solved leaves the state, its time and the multipliers; the next one from a good state is as ever."""
    codegen.write(SCENES["half-lines"](), tmp_path, name="kept")
    library = codegen.load(tmp_path)
    solver, other = library.solver(), library.solver()
    for s in (solver, other):
        assert s.set_state([0.001, 0.69, 0.1]) == 0
        assert s.step() == 0
    before, t, multipliers = solver.x.copy(), solver.t, solver.multipliers.copy()
    assert multipliers.any()
    assert solver.set_state([1e200, 1e200, 0]) == 0
    assert solver.step() != 0
    assert (solver.x == [1e200, 1e200, 0]).all()
    assert (solver.multipliers == multipliers).all()
    assert solver.t == t
    assert solver.set_state(before) == 0
    assert (solver.step(), other.step()) == (0, 0)
    assert (solver.x == other.x).all()


def test_parameters_may_move_the_set_off_the_interior_point(tmp_path):
    """The way back into C leads to a point known beforehand: where parameters have made it useless no step leaves C."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    given = {"field": [0, 1], "x0": [0, 0], "t_end": 1, "step": 0.1, "tolerances": 1e-4}
    moved = {"disc": 1 - (x[0] - p) ** 2 - x[1] ** 2}
    codegen.write(MonotoneInclusion(x=x, constraints=moved, parameters={p: 0.0}, **given), tmp_path, name="moved")
    solver = codegen.load(tmp_path).solver()
    for centre in (0, 0.3, 5):
        assert solver.set_parameters([centre]) == 0
        assert solver.set_state([centre, 0.95]) == 0
        status = solver.step()
        assert (solver.x[0] - centre) ** 2 + solver.x[1] ** 2 <= 1 + 1e-15
        assert centre == 5 or (status == 0 and solver.x[1] > 0.98)


MAIN = """
#include "hard.h"
#include <math.h>
int main(void)
{
    static hard_solver s;
    const double values[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e160, 5e-324, 0, 0, 0.3, -0.3, 1, -1, 2, 0.8, 1e3, 1e-9};
    unsigned seed = 1;
    int solved = hard_init(&s);
    for (int k = 0; k < 200; k++) {
        for (int i = 0; i < HARD_NX; i++) {
            seed = seed*1664525u + 1013904223u;
            s.x[i] = values[(seed >> 16)%11 + (k%2 ? 0 : 6)];
        }
        solved += hard_step(&s) == HARD_OK;
        for (int i = 0; i < HARD_NX && s.status == HARD_OK; i++)
            if (!(s.x[i] - s.x[i] == 0))
                return 1;
    }
    return solved > 60 ? 0 : 2;
}
"""


def test_no_finding_of_the_sanitizers(tmp_path):
    codegen.write(random_set(17), tmp_path, name="hard")  # a set of which so many cuts act that some have to go
    (tmp_path / "example_main.c").write_text(MAIN)
    flags = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run([*STRICT, *flags, "-o", "hard", "hard.c", "example_main.c", "-lm"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "hard"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr[-2000:]) == (0, "")
