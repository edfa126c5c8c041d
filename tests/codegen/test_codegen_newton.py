"""The step by Newton's method in C against its Python reference, step by step from random states and warm starts."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from conftest import optimised
from fuzz_models import share

import nsmodel
from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, SweepingProcess, codegen
from nsmodel.errors import StepError
from nsmodel.modeling.laws import complementarity, equality, polyhedron, product, relay, second_order_cone
from nsmodel.solvers import rounding_errors
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem
from nsmodel.solvers.residuals import numeric_law
from nsmodel.solvers.step import WarmStart
from nsmodel.solvers.time_stepper import Stepper

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", optimised("-O1"), "-Wall", "-Wextra", "-Werror", "-pedantic")
TOLERANCE = 1e-9
GRID = {"t_end": 1, "step": 0.05}
NOT_SOLVED = (1, 2)  # No answer passed, or something is not finite.
BAD_STEP = 3  # Time that does not go on.
NEARBY = 6  # Id of a solver, from solvers.c.

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


# ---------------------------------------------------------------------------------------------- scenes


def bilinear(**changes):
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    given = {"f": -x, "g": [2 * l[0] * (1 - l[1] / 2), l[1]], "law": relay(2, 0, 1), **GRID} | changes
    return FirstOrderSystem(x=x, lam=l, h=[0.2 - x[0], 0.3 - x[1]], x0=[0.5, 0.1], **given)


def discs(n):
    """n discs and two walls: n (n - 1) / 2 + 2 n rows."""
    q = ca.SX.sym("q", 2 * n)
    at = ca.vertsplit(q, 2)
    pairs = {f"{i}-{j}": ca.norm_2(at[i] - at[j]) - 1 for i in range(n) for j in range(i + 1, n)}
    walls = {f"wall {i} {k}": at[i][k] + 0.2 for i in range(n) for k in range(2)}
    places = np.column_stack([np.arange(n) % 3, np.arange(n) // 3]).astype(float)
    return SweepingProcess(q=q, f=-q, constraints=pairs | walls, q0=1.2 * places.ravel(), **GRID)


def polygon():
    """A point in a polygon of 26 sides, in a potential that is not quadratic: few of many rows act, E_z is not the identity."""
    x = ca.SX.sym("x", 2)
    angles = 2 * np.pi * np.arange(26) / 26
    sides = {f"side {i}": 1 - np.cos(a) * x[0] - np.sin(a) * x[1] for i, a in enumerate(angles)}
    potential = -2 * x[0] + x[0] ** 2 * x[1] ** 2 + ca.cosh(x[1])
    damping = [[1, 0.2], [0.2, 2]]
    return FrictionOscillator(x=x, potential=potential, damping=damping, constraints=sides, x0=[0, 0], v0=[1, 2], **GRID)


def oscillator():
    """Friction along two directions, in a potential that is neither smooth nor quadratic."""
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    potential = x[0] ** 4 + x[0] * x[1] + x[1] ** 2 + ca.fabs(x[0])
    friction = {"a": ([1, 0], 0.3 * s), "b": ([0, 1], s + s**3)}
    return FrictionOscillator(x=x, potential=potential, s=s, friction=friction, x0=[1, 0.4], v0=[0, 1], **GRID)


def isotropic():
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=x[0] ** 4 + x[1] ** 2 / 2, friction=s + s**3, s=s, x0=[1, 0.4], v0=[0, 1], **GRID)


def cone():
    t, x, one = ca.SX.sym("t"), ca.SX.sym("x", 3), np.eye(3)
    f = ca.vertcat(ca.cos(3 * t), 2 * ca.sin(2 * t), 0.5)
    return LureSystem(t=t, x=x, A=-x - x**3, B=one, C=one, f=f, law=second_order_cone(3), x0=[1, 0, 0], **GRID)


def lure(**changes):
    t, k = ca.SX.sym("t"), ca.SX.sym("k")  # with a parameter matrices are factored when a step is set
    given = {
        "A": [[-k, 2], [0, -3]], "parameters": {k: 1}, "B": np.eye(2), "C": np.eye(2), "D": [[1, 0.5], [-0.5, 0]],
        "f": [3 * ca.sin(5 * t), ca.cos(4 * t)], "law": product(relay(1), complementarity(1)), "x0": [0.3, -0.2],
    }  # fmt: skip
    return LureSystem(t=t, **GRID, **(given | changes))


def lure_phi():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 2)
    A = ca.vertcat(x[1] - x[0] ** 3, -ca.sin(x[0]) - x[1])
    phi = ca.fabs(y[0]) + ca.fmax(y[1], 0) + ca.cosh(y[1]) + ca.fabs(y[0] - y[1])
    return lure(x=x, A=A, parameters={}, y=y, phi=phi, law=None, D=[[1, 0.3], [-0.3, 0.5]])


def nonlinear(law, **changes):
    """A pendulum held by a law on both components."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    given = {"h": [x[0] + x[1] ** 2, x[1] + l[1] / 2], "g": l * (1 + x**2)} | changes
    return FirstOrderSystem(x=x, lam=l, f=[x[1], -ca.sin(x[0])], law=law, x0=[0.0, 0.0], **given, **GRID)


def smooth(**changes):
    x, rate = ca.SX.sym("x", 3), ca.SX.sym("rate")
    f = ca.vertcat(rate * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2])
    return FirstOrderSystem(x=x, f=f, x0=[1, 1, 1], t_end=1, step=0.01, parameters={rate: 10}, **changes)


def super_twisting():
    """A relay on s times sqrt|s|, whose slope is infinite where the relay switches."""
    s, v, l, t = (ca.SX.sym(name) for name in "svlt")
    return FirstOrderSystem(
        t=t, x=[s, v], lam=l, f=[v, 0.5 * ca.cos(t)], g=[1.5 * ca.sqrt(ca.fabs(s)) * l, 1.1 * l], h=s, law=relay(1), x0=[1, 0],
        t_end=2, step=1e-2, theta=1.0,
    )  # fmt: skip


SCENES = {
    "bilinear": bilinear,
    "bilinear, theta and gamma": lambda: bilinear(theta=0.5, gamma=0.5, M=[[2, 0.3], [0.1, 1]]),
    "three discs": lambda: discs(3),
    "many rows": lambda: discs(6),
    "many rows, a matrix": polygon,
    "oscillator": oscillator,
    "isotropic friction": isotropic,
    "cone": cone,
    "Lur'e": lure,
    "Lur'e, phi": lure_phi,
    "equality and complementarity": lambda: nonlinear(product(equality(1), complementarity(1))),
    "polyhedron": lambda: nonlinear(polyhedron([[1, 0], [0, 1], [-1, -1]], [-1, -1, -1])),
    "smooth": smooth,
    "smooth, explicit": lambda: smooth(theta=0),
    "not monotone": lambda: nsmodel.load("zhuravlev_ivanov"),
    "switches": lambda: nsmodel.load("gene_network"),
    "super-twisting": lambda: super_twisting(),
}


# ---------------------------------------------------------------------------------------------- the harness


SHIM = """
#include "scene.c"
/* A step from any state, multiplier and index set: [state, z, residual, iterations, solver, l, y, index set]. */
int probe(scene_solver *s, double t, double h, const double *x, const double *l, const signed char *index, double *out)
{
    s->t = s->t_0 = t;
    s->steps = 0;
    if (h != s->h)
        s->newton.prepared = 0;
    s->h = h;
    memcpy(s->x, x, sizeof s->x);
#if SCENE_M > 0
    memcpy(s->l, l, sizeof s->l);
    memcpy(s->index, index, sizeof s->index);
#else
    (void)l;
    (void)index;
#endif
    const int status = scene_step(s);
    memcpy(out, s->x, sizeof s->x);
    out += SCENE_NSTATE;
    memcpy(out, s->work.z, sizeof s->work.z);
    out += SCENE_N;
    *out++ = s->residual;
    *out++ = s->iterations;
    *out++ = s->solver;
#if SCENE_M > 0
    for (int i = 0; i < SCENE_M; i++) {
        out[i] = s->l[i];
        out[SCENE_M + i] = s->y[i];
        out[2*SCENE_M + i] = s->index[i];
    }
#endif
    return status;
}
"""

MAIN = (
    SHIM
    + """
#include <stdio.h>
int main(int count, char **names)
{
    static scene_solver s;
    FILE *file = fopen(names[count - 1], "rb");
    double in[2 + SCENE_NSTATE + 2*SCENE_M], out[SCENE_NSTATE + SCENE_N + 3 + 3*SCENE_M];
    signed char index[SCENE_M + 1];
    scene_init(&s);
    while (fread(in, sizeof in, 1, file) == 1) {
        for (int i = 0; i < SCENE_M; i++)
            index[i] = (signed char)in[2 + SCENE_NSTATE + SCENE_M + i];
        printf("%d\\n", probe(&s, in[0], in[1], in + 2, in + 2 + SCENE_NSTATE, index, out));
    }
    return fclose(file);
}
"""
)


def compiled(model, folder, text, name, flags, lie=("", "")):
    """Write the model's library into the folder and compile it, strictly, behind ``text``; ``lie`` is (right, wrong) in its C."""
    codegen.write(model, folder, name="scene", any_step=True)
    code = (folder / "scene.c").read_text()
    assert lie[0] in code
    (folder / "scene.c").write_text(code.replace(*lie, 1))
    (folder / "shim.c").write_text(text)
    command = [COMPILER, *STRICT, *flags, "-o", str(folder / name), str(folder / "shim.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / name


class Scene:
    """A model's step twice: in C, and in Python with the same chain of solvers."""

    def __init__(self, model, folder, lie=("", "")):
        self.model, self.problem = model, one_step_problem(model.bind(None))
        self.n, self.z, self.m = (e.numel() for e in (self.problem.state, self.problem.z, self.problem.l))
        self.law = numeric_law(self.problem.law)
        flags = ("-fPIC", "-shared", *(["-O0"] if lie[0] else []))
        library = ctypes.CDLL(str(compiled(model, folder, SHIM, "libscene.so", flags, lie)))
        address = ctypes.c_void_p
        self._probe = library.probe
        self._probe.argtypes = [address, ctypes.c_double, ctypes.c_double, address, address, address, address]
        library.scene_create.restype = address
        self._solver, self._library = address(library.scene_create()), library
        self.start = initial_rows(model, model.step)[-1][0]
        self.start = np.concatenate([self.start, np.zeros(self.n - self.start.size)])
        self.python = Stepper(self.problem, "auto", TOLERANCE, h=model.step, state=self.start, few_steps=False)
        chain = tuple(name for name in self.python.plan.chain if name != "qpoases")
        self.python.plan = replace(self.python.plan, chain=chain, ipopt="never")

    def step(self, t, h, state, warm):
        """(status, state, z, residual, solver, Warm) of the step in C."""
        out = np.full(self.n + self.z + 3 + 3 * self.m, np.nan)
        given = [np.array(state, float), np.array(warm.l, float), np.array(warm.index, np.int8), out]
        status = self._probe(self._solver, t, h, *(array.ctypes.data for array in given))
        state, z, (residual, _, solver), l, _, index = np.split(out, np.cumsum([self.n, self.z, 3, self.m, self.m]))
        return status, state, z, residual, int(solver), WarmStart(l, index.astype(np.int8))

    def judged(self, t, h, state, z, warm):
        """The residual by the certificate in Python."""
        newton = self.python._newton
        at = newton.linearise(t, h, state, z, warm.l)
        return newton.evaluate_residual(newton.known(t, h, state), at, warm.l, warm.index, "test", 1).residual

    def random(self, rng, last):
        """A random (t, h, state, warm start); ``last`` is the warm start that the step before left."""
        h = self.model.step * 10 ** rng.uniform(-1, 0.3)
        state = self.start * rng.integers(2) + rng.normal(size=self.n) * 10.0 ** rng.uniform(-3, 0.3)
        choice = rng.integers(3)
        if choice < 2 or not self.m:
            return rng.uniform(0, 3), h, state, last if choice else self.python.cold_start()
        l = np.clip(rng.normal(size=self.m), self.law.lower, self.law.upper)
        codes = np.where(np.isfinite(self.law.lower), -1, 0), np.where(np.isfinite(self.law.upper), 1, 0)
        index = np.choose(rng.integers(0, 3, self.m), [np.zeros(self.m, int), *codes]).astype(np.int8)
        return rng.uniform(0, 3), h, state, WarmStart(l, index)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return scene(name) -> Scene, compiled once."""
    return cache(lambda name: Scene(SCENES[name](), tmp_path_factory.mktemp("scene")))


# ---------------------------------------------------------------------------------------------- agreement


@pytest.mark.parametrize("name", SCENES)
def test_a_step_is_the_interpreted_one(scene, name):
    """Both are certified and the same, or none is; from states near the start, and all kinds of warm starts."""
    agree(scene(name))


@pytest.mark.parametrize("name", ["many rows", "many rows, a matrix", "bilinear", "Lur'e, phi", "smooth"])
def test_the_rounding_of_a_large_graph_is_told_by_its_terms(monkeypatch, tmp_path, name):
    monkeypatch.setattr(rounding_errors, "MAX_BOUND_NODES", 0)
    agree(Scene(SCENES[name](), tmp_path))
    assert "round_off_by_terms(s);" in (tmp_path / "scene.c").read_text()
    assert "void round_off(" not in (tmp_path / "scene.c").read_text()


def agree(both):
    rng, done = np.random.default_rng(0), 0
    last = both.python.cold_start()
    steps = share(100, 40)
    for _ in range(steps):
        t, h, state, warm = both.random(rng, last)
        status, found, z, residual, _, found_warm = both.step(t, h, state, warm)
        try:
            row = both.python(t, h, state, warm).row
        except StepError:
            assert status in NOT_SOLVED
            continue
        assert status == 0
        assert 0 <= residual <= TOLERANCE
        assert both.judged(t, h, state, z, found_warm) <= residual * (1 + 1e-6) + 1e-12
        expected = row[both.python.layout.state]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        last, done = found_warm, done + 1
    assert done >= 0.6 * steps


def test_index_sets_nearby_are_tried_where_newtons_alternates(scene):
    """Near s = 0, where the slope of sqrt|s| makes them alternate: the interpreted step has the same end."""
    both, rng, solvers = scene("super-twisting"), np.random.default_rng(5), set()
    warm = both.python.cold_start()
    for _ in range(share(60, 25)):
        state = rng.normal(size=2) * 10.0 ** rng.uniform((-7, -4), (-3, -1))
        status, row, *_, solver, _ = both.step(0.3, 1e-2, state, warm)
        found = both.python(0.3, 1e-2, state, warm).row[:2]
        assert status == 0
        np.testing.assert_allclose(np.atleast_1d(row)[:2], found, rtol=0, atol=1e-9 * np.abs(state).max())
        solvers.add(solver)
    assert NEARBY in solvers


def test_many_rows_need_no_square_matrix(scene, tmp_path):
    codegen.write(SCENES["many rows"](), tmp_path, name="scene", any_step=True)
    header = (tmp_path / "scene.h").read_text()
    assert "double W[SCENE_ROWS*SCENE_ROWS]" in header
    assert "SCENE_M*" not in header
    assert "*SCENE_M" not in header


def test_rows_beyond_the_room_wait_for_others_to_leave(scene):
    """More rows are violated, or were active, than may enter at once: only those that act count in the end."""
    both, rng, crowded = scene("many rows, a matrix"), np.random.default_rng(3), 0
    room = 4 * both.z
    for _ in range(60):
        t, h, state, _ = both.random(rng, both.python.cold_start())
        state = state * rng.uniform(1, 30)  # far outside of the polygon, beyond many sides at once
        warm = WarmStart(np.zeros(both.m), np.where(rng.random(both.m) < 0.5, 0, -1).astype(np.int8))
        status, found, _, _, _, _ = both.step(t, h, state, warm)
        expected = both.python(t, h, state, warm).row[both.python.layout.state]
        assert status == 0
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        crowded += (warm.index == 0).sum() > room
    assert crowded >= 40


# ---------------------------------------------------------------------------------------------- refusals


LIES = {
    "z": ("z[i] += dz[i] - v[i];", "z[i] = 1.000001*(z[i] + dz[i] - v[i]);"),
    "l": ("const double next = l_next[j];", "const double next = 1.000001*l_next[j];"),
    "W": ("read_W(s);\n", "read_W(s);\n        s->newton.W[0] *= 1.000001;\n"),
}


@pytest.mark.parametrize(
    ("name", "lie"),
    # A wrong W does not mislead Newton's method for long: it takes more iterations.
    [(name, lie) for name in ("Lur'e", "isotropic friction", "bilinear") for lie in LIES if (name, lie) != ("bilinear", "W")],
)
def test_a_wrong_answer_is_refused(tmp_path, name, lie):
    """Wrong by 1e-6 it does not pass; where index sets nearby are tried, they give the right one."""
    both, rng, caught = Scene(SCENES[name](), tmp_path, LIES[lie]), np.random.default_rng(1), 0
    for _ in range(share(60, 25)):
        t, h, state, warm = both.random(rng, both.python.cold_start())
        expected = both.python(t, h, state, warm).row[both.python.layout.state]
        status, found, *_, solver, _ = both.step(t, h, state, warm)
        if status == 0:
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        else:
            assert status == NOT_SOLVED[0]
            assert name != "bilinear"
            np.testing.assert_array_equal(found, state)
        caught += status != 0 or solver == NEARBY
    assert caught >= 10


def hostile(rng, both, bad):
    """A step with ``bad`` somewhere: in t, h, the state or the warm start."""
    t, h, state, warm = both.random(rng, both.python.cold_start())
    l = warm.l.copy()
    places = ["t", "h", "state"] + ["l"] * (both.m > 0)
    where = places[rng.integers(len(places))]
    if where == "state":
        state[rng.integers(both.n)] = bad
    if where == "l":
        l[rng.integers(both.m)] = bad
    return bad if where == "t" else t, bad if where == "h" else h, state, WarmStart(l, warm.index), where


@pytest.mark.parametrize("name", SCENES)
def test_what_is_not_finite_or_huge_is_refused_or_certified(scene, name):
    both, rng = scene(name), np.random.default_rng(2)
    for bad in [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e-308, 1e90, -1e60, 1e-90] * 6:
        t, h, state, warm, where = hostile(rng, both, bad)
        status, found, z, _, _, found_warm = both.step(t, h, state, warm)
        if status == 0:
            assert np.isfinite(found).all()
            assert np.isfinite(bad) or where == "l"
            if 1e-100 < abs(bad) < 1e100:  # beyond, numpy's scales overflow
                assert both.judged(t, h, state, z, found_warm) <= TOLERANCE
        else:
            assert status in NOT_SOLVED or (status == BAD_STEP and not t + h > t)
            np.testing.assert_array_equal(found, state)


@pytest.mark.parametrize("name", ["many rows, a matrix", "isotropic friction", "switches", "Lur'e, phi"])
def test_sanitizers_find_nothing(scene, tmp_path, name):
    """Random and hostile steps under -fsanitize: no access out of bounds, no undefined behaviour."""
    both, rng, rows, statuses = scene(name), np.random.default_rng(4), [], []
    for bad in [np.nan, np.inf, 1e308, -1e200, 1e-308, 0.1, 0.01, -0.5] * 10:
        t, h, state, warm, _ = hostile(rng, both, bad)
        rows.append(np.concatenate([[t, h], state, warm.l, warm.index.astype(float)]))
        statuses.append(both.step(t, h, state, warm)[0])
    np.array(rows).tofile(tmp_path / "steps")
    checks = ("-O0", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
    program = compiled(both.model, tmp_path, MAIN, "steps_c", checks)
    done = subprocess.run([program, tmp_path / "steps"], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    assert [int(line) for line in done.stdout.split()] == statuses
    assert 0 in statuses
