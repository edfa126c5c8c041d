"""The C library as its users meet it: every function of the header, in C, C++ and Python; the files; the command line."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, MonotoneInclusion, codegen
from nsmodel.cli import main
from nsmodel.errors import CodegenError, NsmodelError, StepError, StorageError, UsageError
from nsmodel.files.cache_folder import LIBRARY_SUFFIX
from nsmodel.modeling.laws import complementarity, product, relay
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem
from nsmodel.solvers.time_stepper import completed_start_state

REPOSITORY = Path(__file__).resolve().parents[2]
FRAGMENTS = Path(codegen.__file__).parent / "c"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
CC = next((name for name in ("gcc", "cc", "clang") if shutil.which(name)), None)

needs_cc = pytest.mark.skipif(CC is None, reason="no C compiler")
needs_cxx = pytest.mark.skipif(CC is None or shutil.which("g++") is None, reason="no C++ compiler")
needs_make = pytest.mark.skipif(shutil.which("make") is None or shutil.which("cc") is None, reason="no make, no cc")


# ---------------------------------------------------------------------------------------------- scenes


def case(stem):
    return lambda: nsmodel.load(stem)


def rough_plane():
    """A mass on a rough plane: a ball whose radius is a parameter, a potential that is not quadratic, a start that depends on
    another parameter.
    """
    x, s, mu, a = ca.SX.sym("x", 2), ca.SX.sym("s"), ca.SX.sym("mu"), ca.SX.sym("a")
    return FrictionOscillator(
        x=x, s=s, potential=ca.sumsqr(x) + x[0] ** 4, friction=mu * s + s**2, x0=[a, 1], v0=[0, 1], t_end=1, step=0.01,
        parameters={mu: 0.5, a: 1},
    )  # fmt: skip


def reactions():
    """A relay whose ends are parameters beside a unilateral constraint; with gamma < 1 a step starts from the last reaction."""
    x, l, low, up = ca.SX.sym("x", 2), ca.SX.sym("l", 2), ca.SX.sym("low"), ca.SX.sym("up")
    return FirstOrderSystem(
        x=x, lam=l, f=[x[1], 1 - ca.sin(x[0])], h=[x[1], x[0] + 2], g=[0.1 * l[1], l[0]], x0=[0.5, 1], t_end=1, step=0.01,
        law=product(relay(1, low, up), complementarity(1)), gamma=0.5, theta=0.5, parameters={low: -1, up: 0.5},
    )  # fmt: skip


def drop():
    """A point driven out of a disc cut by a line, projected as well as a tolerance of each step asks."""
    x, speed = ca.SX.sym("x", 2), ca.SX.sym("speed")
    return MonotoneInclusion(
        x=x, field=[speed, -1], phi=0.1 * ca.fabs(x[0]), x0=[0, 0], t_end=1, step=0.05, parameters={speed: 2},
        constraints={"disc": 1 - ca.sumsqr(x), "line": 0.8 - x[0]}, tolerances=[1e-3 / (k + 1) for k in range(20)],
    )  # fmt: skip


def rewritten():
    """A potential with corners: its forces are sums of multipliers that the model does not declare."""
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 2)
    phi = ca.fabs(y[0]) + ca.fmax(y[1], 0) + ca.cosh(y[1]) + ca.fabs(y[0] - y[1])
    return LureSystem(
        x=x, A=[x[1] - x[0] ** 3, -ca.sin(x[0]) - x[1]], B=np.eye(2), C=np.eye(2), y=y, phi=phi, f=[3, -1], x0=[0.3, -0.2],
        t_end=1, step=0.01,
    )  # fmt: skip


def driven():
    """Two inputs, one of which moves the law, and a reaction that is carried over their jumps."""
    x, l, u, v = ca.SX.sym("x", 2), ca.SX.sym("l"), ca.SX.sym("u"), ca.SX.sym("v", 2)
    return FirstOrderSystem(
        x=x, lam=l, f=[x[1] + v[0], u - x[0]], h=[x[1] + 0.5 * l - v[1]], g=[0, l], x0=[0.5, 1], t_end=1, step=0.03, law=relay(1),
        gamma=0.5, theta=0.5,
        inputs={u: nsmodel.pwm(0.2, 0.3), v: nsmodel.table([0, 0.5, 1], [[0, 0], [1, 0.2], [0, 1]], "linear")},
    )  # fmt: skip


def smooth():
    x = ca.SX.sym("x", 2)
    return FirstOrderSystem(x=x, f=[x[1], -ca.sin(x[0])], x0=[1, 0], t_end=1, step=0.01, theta=0.5)


KINDS = {
    "matrices": (case("diode_bridge"), {}),
    "any step": (case("diode_bridge"), {"any_step": True}),
    "worst case": (case("diode_bridge"), {"worst_case": True}),
    "parameters": (case("two_masses"), {}),
    "bounds of parameters": (rough_plane, {}),
    "reactions": (reactions, {}),
    "newton": (case("gene_network"), {}),
    "oscillator": (case("friction_oscillator"), {"any_step": True}),
    "two positions": (case("cabot_4_1"), {}),
    "rows": (case("two_discs"), {}),
    "clip": (case("inclusion_8_2_full"), {}),
    "cuts": (drop, {}),
    "rewritten": (rewritten, {}),
    "smooth": (smooth, {}),
    "inputs": (driven, {}),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return written(kind) -> the folder of that library, which is called "thing", and its description."""
    base = tmp_path_factory.mktemp("api")

    @cache
    def write(kind):
        make, options = KINDS[kind]
        done = codegen.write(make(), base / kind.replace(" ", "_"), name="thing", **options)
        return done.folder, done.about

    return write


def compiled(folder: Path, source: str, *flags: str, files=("thing.c",), compiler=CC, name="program") -> Path:
    """Compile a program beside the library; ``source`` is its text."""
    path = folder / f"{name}.{'cpp' if compiler == 'g++' else 'c'}"
    path.write_text(source)
    command = [compiler, *(flags or STRICT), "-I", ".", "-o", name, path.name, *files, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    return folder / name


def output(program: Path, *arguments: str) -> str:
    done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def known(about) -> list[str]:
    """What the harness must know of a library."""
    approximate = ["-DSMALL=0.05"] if "approximate" in " ".join(about["used"]) else []
    bounded = ["-DBOUNDED"] if {"alpha", "mu", "up"} & about["parameters"].keys() else []
    return [*(f"-D{flag.upper()}" for flag in ("velocity", "force", "any_step") if about[flag]), *approximate, *bounded]


# ---------------------------------------------------------------------------------------------- every function, in C


HARNESS = r"""
#include "thing.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(holds) do { if (!(holds)) { printf("line %d: %s\n", __LINE__, #holds); exit(1); } } while (0)
#define STEPS 60
#ifndef SMALL
#define SMALL 0
#endif

static unsigned long seed = 1;

static double uniform(double low, double high)
{
    seed = (1103515245UL*seed + 12345UL) & 0x7fffffffUL;
    return low + (high - low)*(double)seed/2147483648.0;
}

/* Everything but the work arrays, and what is told of the last step. */
static int same(const thing_solver *a, const thing_solver *b)
{
    const size_t told = offsetof(thing_solver, residual), after = offsetof(thing_solver, t_0);
    const char *p = (const char *)a, *q = (const char *)b;
    return memcmp(p, q, told) == 0 && memcmp(p + after, q + after, offsetof(thing_solver, work) - after) == 0;
}

static int untouched(const thing_solver *a, const thing_solver *b)
{
    return memcmp(a, b, offsetof(thing_solver, work)) == 0;
}

/* A start of its own: everything that the header lets a user set. */
static void scatter(thing_solver *s)
{
    double x[THING_NX];
    thing_get_state(s, x);
    for (int i = 0; i < THING_NX; i++)
        x[i] += uniform(-0.2, 0.2);
    CHECK(thing_set_state(s, x) == THING_OK);
    CHECK(thing_set_time(s, uniform(0, 3)) == THING_OK);
#ifdef VELOCITY
    for (int i = 0; i < THING_NX; i++)
        x[i] = uniform(-1, 1);
    CHECK(thing_set_velocity(s, x) == THING_OK);
#endif
#ifdef FORCE
    for (int i = 0; i < THING_NX; i++)
        x[i] = uniform(-1, 1);
    CHECK(thing_set_force(s, x) == THING_OK);
#endif
}

static void refused(void)
{
    static thing_solver s, before;
    const double bad[] = {NAN, INFINITY, -INFINITY};
    double x[THING_NX + THING_NP];
    CHECK(thing_init(&s) == THING_OK);
    scatter(&s);
    CHECK(thing_step(&s) == THING_OK);
    before = s;
    for (int k = 0; k < 3; k++) {
        CHECK(thing_set_time(&s, bad[k]) == THING_NOT_FINITE);
        CHECK(thing_set_step(&s, bad[k]) == THING_BAD_STEP);
        for (int i = 0; i < THING_NX; i++) {
            for (int j = 0; j < THING_NX; j++)
                x[j] = j == i ? bad[k] : 0.25;
            CHECK(thing_set_state(&s, x) == THING_NOT_FINITE);
#ifdef VELOCITY
            CHECK(thing_set_velocity(&s, x) == THING_NOT_FINITE);
#endif
#ifdef FORCE
            CHECK(thing_set_force(&s, x) == THING_NOT_FINITE);
#endif
        }
#if THING_NP > 0
        for (int i = 0; i < THING_NP; i++) {
            for (int j = 0; j < THING_NP; j++)
                x[j] = j == i ? bad[k] : s.p[j] + 0.125;
            CHECK(thing_set_parameters(&s, x) == THING_NOT_FINITE);
        }
#endif
        CHECK(untouched(&s, &before));
    }
    CHECK(thing_set_step(&s, 0) == THING_BAD_STEP && thing_set_step(&s, -THING_STEP) == THING_BAD_STEP);
#ifndef ANY_STEP
    CHECK(thing_set_step(&s, 2*THING_STEP) == THING_BAD_STEP && thing_set_step(&s, THING_STEP) == THING_OK);
#endif
    CHECK(untouched(&s, &before));
#if THING_NP > 0
    int empty = 0; /* parameters that leave no room between the ends of the law */
    for (int i = 0; i < THING_NP; i++) {
        memcpy(x, s.p, sizeof s.p);
        x[i] = -10 - fabs(x[i]);
        const int status = thing_set_parameters(&s, x);
        CHECK(status == THING_OK || (status == THING_BAD_PARAMETER && untouched(&s, &before)));
        empty += status == THING_BAD_PARAMETER;
        s = before;
    }
#ifdef BOUNDED
    CHECK(empty > 0);
#else
    CHECK(empty == 0);
#endif
#endif
}

/* Steps from where nothing is solved: the state stays, and what comes after is as if they had not been tried. */
static int failed(void)
{
    static thing_solver s, before, other;
    const double huge[] = {1.7e308, -1.7e308, 1e300, 1e200, -1e160};
    double kept[THING_NX], x[THING_NX];
    int failures = 0;
    thing_init(&s);
    scatter(&s);
    for (int k = 0; k < 5; k++)
        CHECK(thing_step(&s) == THING_OK);
    other = s;
    thing_get_state(&s, kept);
    for (int k = 0; k < 5; k++) {
        for (int i = 0; i < THING_NX; i++)
            x[i] = huge[k]*(i % 2 ? 0.5 : 1);
        CHECK(thing_set_state(&s, x) == THING_OK);
        before = s;
        const int status = thing_step(&s);
        CHECK(thing_get_status(&s) == status);
        CHECK(thing_get_work(&s) <= THING_MAX_WORK);
        if (status != THING_OK) {
            CHECK(same(&s, &before));
            CHECK(status != THING_NOT_SOLVED || !(thing_get_residual(&s) <= THING_TOLERANCE));
            failures++;
        } else
            s = before;
    }
    for (int i = 0; i < THING_NSTATE; i++) { /* nothing that a setter lets through */
        s.x[i] = NAN;
        before = s;
        CHECK(thing_step(&s) == THING_NOT_FINITE && thing_get_status(&s) == THING_NOT_FINITE && same(&s, &before));
        s.x[i] = other.x[i];
    }
    CHECK(thing_set_state(&s, kept) == THING_OK && same(&s, &other));
    for (int k = 0; k < STEPS; k++) {
        const int status = thing_step(&s);
        CHECK(status == thing_step(&other) && same(&s, &other));
    }
    CHECK(thing_set_time(&s, -0.0) == THING_OK); /* A step that fails leaves the sign of 0. */
    s.x[0] = NAN;
    before = s;
    CHECK(thing_step(&s) == THING_NOT_FINITE && same(&s, &before) && signbit(thing_get_time(&s)));
    s.x[0] = other.x[0];
    /* A time that the step would leave double precision with. */
#ifdef ANY_STEP
    CHECK(thing_set_step(&s, 1e308) == THING_OK && thing_set_time(&s, 1.7e308) == THING_OK);
    before = s;
#ifdef VELOCITY
    for (int i = 0; i < THING_NX; i++)
        x[i] = 100;
    CHECK(thing_set_velocity(&s, x) == THING_NOT_FINITE && untouched(&s, &before)); /* h v overflows */
#endif
    CHECK(thing_step(&s) == THING_NOT_FINITE && same(&s, &before));
    CHECK(thing_get_residual(&s) == INFINITY && thing_get_work(&s) == 0);
#endif
    return failures;
}

/* A time beside which the step is nothing. */
static void stands_still(void)
{
    static thing_solver s, before;
    CHECK(thing_init(&s) == THING_OK && thing_set_time(&s, 1e17*THING_STEP) == THING_OK);
    before = s;
    CHECK(thing_step(&s) == THING_BAD_STEP && same(&s, &before) && thing_get_status(&s) == THING_BAD_STEP);
    CHECK(thing_set_time(&s, -1e17*THING_STEP) == THING_OK && thing_step(&s) == THING_BAD_STEP);
#ifdef ANY_STEP
    CHECK(thing_set_time(&s, 1) == THING_OK && thing_set_step(&s, 1e-17) == THING_OK && thing_step(&s) == THING_BAD_STEP);
#endif
    CHECK(thing_set_time(&s, 1) == THING_OK);
#ifdef ANY_STEP
    CHECK(thing_set_step(&s, THING_STEP) == THING_OK);
#endif
    CHECK(thing_step(&s) == THING_OK);
}

/* Memory of zeros, or of anything else, is no solver. */
static void not_initialised(void)
{
    static thing_solver s, zeros;
    double x[THING_NX + THING_NP] = {0};
    for (int k = 0; k < 2; k++) {
        CHECK(thing_set_time(&s, 0) == THING_NOT_INITIALISED && thing_set_step(&s, THING_STEP) == THING_NOT_INITIALISED);
        CHECK(thing_set_state(&s, x) == THING_NOT_INITIALISED && thing_reset(&s) == THING_NOT_INITIALISED);
#ifdef VELOCITY
        CHECK(thing_set_velocity(&s, x) == THING_NOT_INITIALISED);
#endif
#ifdef FORCE
        CHECK(thing_set_force(&s, x) == THING_NOT_INITIALISED);
#endif
#if THING_NP > 0
        CHECK(thing_set_parameters(&s, x) == THING_NOT_INITIALISED);
#endif
        CHECK(k == 1 || memcmp(&s, &zeros, sizeof s) == 0);
        CHECK(thing_step(&s) == THING_NOT_INITIALISED && thing_get_status(&s) == THING_NOT_INITIALISED);
        CHECK(k == 1 || (thing_get_time(&s) == 0 && s.steps == 0));
        memset(&s, 0x5a, sizeof s);
    }
    CHECK(thing_init(&s) == THING_OK && thing_step(&s) == THING_OK);
}

/* A step with less than the work that it takes is refused, or ends with another answer that is certified. */
static long capped(void)
{
    static thing_solver s, before, after;
    long most = 0, refused = 0;
    CHECK(thing_init(&s) == THING_OK && s.budget == THING_MAX_WORK);
    for (int k = 0; k < STEPS; k++) {
        if (k % 10 == 5)
            scatter(&s);
        before = s;
        const int status = thing_step(&s);
        const long needed = thing_get_work(&s);
        after = s;
        most = needed > most ? needed : most;
        for (long budget = 0; budget <= needed && budget < 40; budget++) {
            s = before;
            s.budget = budget;
            const int capped = thing_step(&s);
            CHECK(thing_get_work(&s) <= budget);
            CHECK(status != THING_OK || capped == THING_OK || capped == THING_NOT_SOLVED);
            CHECK(budget < needed || (capped == status && memcmp(s.x, after.x, sizeof s.x) == 0));
            s.budget = before.budget;
            refused += capped == THING_NOT_SOLVED && status == THING_OK;
            CHECK(capped == THING_OK ? s.residual <= THING_TOLERANCE : same(&s, &before));
        }
        s = after;
    }
    CHECK(most == 0 || refused > 0);
    return most;
}

/* Solvers side by side, and after others in the same memory, give what each gives alone. */
static void independent(void)
{
    static thing_solver s[3], start[3], alone[3][STEPS];
    static int status[3][STEPS];
    for (int i = 0; i < 3; i++) {
        thing_init(&start[i]);
        scatter(&start[i]);
        s[0] = start[i];
        for (int k = 0; k < STEPS; k++) {
            status[i][k] = thing_step(&s[0]);
            alone[i][k] = s[0];
            CHECK(thing_get_work(&s[0]) <= THING_MAX_WORK);
        }
    }
    for (int i = 0; i < 3; i++)
        s[i] = start[i];
    for (int k = 0; k < STEPS; k++)
        for (int i = 2; i >= 0; i--)
            CHECK(thing_step(&s[i]) == status[i][k] && same(&s[i], &alone[i][k]));
}

/* After reset() a solver is as after init(), whatever it has done, but for step and parameters. */
static void forgets(void)
{
    static thing_solver used, fresh;
    thing_init(&fresh);
    thing_init(&used);
#ifdef ANY_STEP
    CHECK(thing_set_step(&used, THING_STEP/3) == THING_OK && used.h == THING_STEP/3);
#endif
#if THING_NP > 0
    double p[THING_NP];
    for (int i = 0; i < THING_NP; i++)
        p[i] = 1.25*fresh.p[i];
    CHECK(thing_set_parameters(&used, p) == THING_OK);
#endif
    for (int k = 0; k < STEPS; k++) {
        if (k % 20 == 10)
            scatter(&used);
        thing_step(&used);
    }
#ifdef ANY_STEP
    CHECK(thing_set_step(&used, THING_STEP) == THING_OK);
#endif
#if THING_NP > 0
    CHECK(thing_reset(&used) == THING_OK && memcmp(used.p, p, sizeof p) == 0);
    CHECK(thing_set_parameters(&used, fresh.p) == THING_OK);
#endif
    CHECK(thing_reset(&used) == THING_OK && untouched(&used, &fresh));
    for (int k = 0; k < STEPS; k++)
        CHECK(thing_step(&used) == thing_step(&fresh) && untouched(&used, &fresh));
}

static void read(void)
{
    thing_solver *s = thing_create();
    double x[THING_NX];
    CHECK(s != NULL && thing_get_time(s) == s->t && thing_get_status(s) == THING_OK && thing_get_residual(s) == 0);
    CHECK(thing_set_time(s, 2.5) == THING_OK && thing_get_time(s) == 2.5);
    for (int k = 1; k <= STEPS; k++) {
        CHECK(thing_step(s) == THING_OK && thing_get_status(s) == THING_OK && thing_get_time(s) == 2.5 + k*THING_STEP);
        CHECK(0 <= thing_get_residual(s) && thing_get_residual(s) <= THING_TOLERANCE);
        CHECK(0 <= thing_get_iterations(s) && thing_get_work(s) <= THING_MAX_WORK);
        thing_get_state(s, x);
        CHECK(memcmp(x, s->x, sizeof x) == 0);
#ifdef FORCE
        double r[THING_NX];
        thing_get_force(s, r);
        CHECK(memcmp(r, s->x + THING_NX, sizeof r) == 0);
#endif
#ifdef VELOCITY
        double v[THING_NX], last[THING_NX];
        thing_get_velocity(s, v);
        for (int i = 0; i < THING_NX; i++)
            CHECK(v[i] == s->x[THING_NX + i]/s->h);
        CHECK(thing_set_velocity(s, v) == THING_OK);
        thing_get_velocity(s, last);
        for (int i = 0; i < THING_NX; i++)
            CHECK(fabs(v[i] - last[i]) <= 1e-15*fabs(v[i]));
#endif
#if THING_M > 0
        double l[THING_NL], y[THING_NL];
        signed char index[THING_M];
        thing_get_multipliers(s, l);
        thing_get_outputs(s, y);
        thing_get_index_set(s, index);
        for (int i = 0; i < THING_M; i++)
            CHECK(-1 <= index[i] && index[i] <= 1 && index[i] == s->index[i] && (index[i] != 0 || fabs(s->y[i]) <= SMALL));
        for (int i = 0; i < THING_NL; i++)
            CHECK(isfinite(l[i]) && isfinite(y[i]));
#endif
    }
    for (int status = THING_OK; status <= THING_BAD_PARAMETER; status++)
        CHECK(strlen(thing_status_text(status)) > 3 && strcmp(thing_status_text(status), thing_status_text(99)) != 0);
    CHECK(strcmp(thing_status_text(-1), thing_status_text(99)) == 0);
    thing_free(s);
    thing_free(NULL);
}

int main(void)
{
    not_initialised();
    refused();
    stands_still();
    const long work = capped();
    independent();
    forgets();
    read();
    printf("%d failures, %ld work\n", failed(), work);
    return 0;
}
"""


@needs_cc
@pytest.mark.parametrize("kind", KINDS)
def test_every_function_of_the_header(kind, written):
    """Refused settings and failed steps change nothing; solvers do not know of each other; reset forgets; getters agree."""
    folder, about = written(kind)
    program = compiled(folder, HARNESS, *STRICT, *known(about))
    failures, work = map(int, re.fullmatch(r"(\d) failures, (\d+) work\n", output(program)).groups())
    assert work > 0 or kind == "clip"
    assert failures > 0 or kind in (
        "matrices",
        "oscillator",
        "smooth",
        "inputs",
    )  # linear, or bounded: these have a solution from anywhere


COUNTING = r"""
static long systems;
#include "thing.c"
#include <stdio.h>

static unsigned long seed = 7;

static double uniform(double low, double high)
{
    seed = (1103515245UL*seed + 12345UL) & 0x7fffffffUL;
    return low + (high - low)*(double)seed/2147483648.0;
}

int main(void)
{
    static thing_solver s;
    long most = 0, iterations = 0, solved = 0;
    thing_init(&s);
    for (int k = 0; k < 400; k++) {
        double x[THING_NX];
        if (k % 40 == 0)
            thing_reset(&s);
        thing_get_state(&s, x);
        for (int i = 0; i < THING_NX; i++)
            x[i] = k % 3 == 0 ? pow(10, uniform(-300, 300)) : k % 7 == 0 ? 0 : x[i] + uniform(-1, 1)*pow(10, uniform(-6, 2));
        if (k % 2)
            thing_set_state(&s, x);
        if (k % 5 == 0)
            thing_set_step(&s, THING_STEP*pow(10, uniform(-3, 3)));
#if THING_M > 0
        for (int i = 0; i < THING_M && k % 4 == 0; i++) { /* a warm start that is of no use */
            s.l[i] = uniform(-1, 1)*pow(10, uniform(-3, 3));
            s.index[i] = (signed char)uniform(-1, 1.99);
        }
#endif
        systems = 0;
        solved += thing_step(&s) == THING_OK;
        if (systems > most)
            most = systems;
        if (s.work.iterations > iterations)
            iterations = s.work.iterations;
    }
    printf("%ld %ld %ld\n", most, iterations, solved);
    return 0;
}
"""


@needs_cc
@pytest.mark.parametrize("kind", KINDS)
def test_no_step_takes_longer_than_the_header_says(kind, written, tmp_path):
    """The linear systems that steps solve, counted: from random and hostile states, steps and warm starts."""
    folder, about = written(kind)
    for end in "hc":
        shutil.copy(folder / f"thing.{end}", tmp_path)
    code = (tmp_path / "thing.c").read_text()
    head = "static int lu_factor(int n, double *A, int *pivot)\n{\n"
    (tmp_path / "thing.c").write_text(code.replace(head, head + "    systems++;\n"))
    program = compiled(tmp_path, COUNTING, *STRICT, "-Wno-unused-variable", files=())
    most, iterations, solved = map(int, output(program).split())
    assert solved >= 40
    assert (most > 0 or head not in code) != (kind == "worst case")  # that forms all of them when a solver is initialised
    assert max(most, iterations) <= about["max_work"]


NOT_AS_WRITTEN = ("-ffast-math", "-ffinite-math-only", "-funsafe-math-optimizations")


@needs_cc
@pytest.mark.parametrize("flag", NOT_AS_WRITTEN)
def test_options_that_change_arithmetic_are_refused(flag, written, monkeypatch):
    """By the compiler's macros; where it has none, by what it makes of NaN and of sums."""
    folder, _ = written("smooth")
    for compiler in filter(shutil.which, ("gcc", "clang")):
        command = [compiler, "-std=c99", "-O2", flag, "-c", "-o", "fast.o", "thing.c"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert "compile without" in done.stderr or compiler == "clang"
    silent = (folder / "thing.c").read_text().replace("#error", "#define SILENT")
    (folder / "silent.c").write_text(re.sub("#define SILENT .*", "", silent))
    program = """
    #include "thing.h"
    int main(void)
    {
        static thing_solver s;
        return thing_init(&s) == THING_BAD_ARITHMETIC && thing_step(&s) == THING_NOT_INITIALISED ? 0 : 1;
    }
    """
    flags = ("-std=c99", "-O2", flag)
    for compiler in filter(shutil.which, ("gcc", "clang")):
        output(compiled(folder, program, *flags, files=("silent.c",), compiler=compiler))
    monkeypatch.setenv("CC", f"{CC} {flag}")
    run = nsmodel.simulate(smooth(), t_end=0.05, compiled=True)
    assert any("not compiled" in warning and "compile without" in warning for warning in run.metadata["warnings"])


# ---------------------------------------------------------------------------------------------- in programs


THREADS = r"""
#include "thing.h"
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#define COUNT 4

static void *run(void *solver)
{
    for (int k = 0; k < 2000; k++)
        thing_step(solver);
    return NULL;
}

int main(void)
{
    static thing_solver alone[COUNT], threaded[COUNT];
    pthread_t threads[COUNT];
    for (int i = 0; i < COUNT; i++) {
        double x[THING_NX];
        thing_init(&alone[i]);
        thing_get_state(&alone[i], x);
        x[0] += 0.1*i;
        thing_set_state(&alone[i], x);
        threaded[i] = alone[i];
        run(&alone[i]);
    }
    for (int i = 0; i < COUNT; i++)
        pthread_create(&threads[i], NULL, run, &threaded[i]);
    for (int i = 0; i < COUNT; i++)
        pthread_join(threads[i], NULL);
    for (int i = 0; i < COUNT; i++)
        printf("%d %d %.17g\n", memcmp(&alone[i], &threaded[i], sizeof alone[i]), alone[i].status, alone[i].x[0]);
    return 0;
}
"""


@needs_cc
def test_threads_with_a_solver_each(written):
    folder, _ = written("parameters")
    rows = [line.split() for line in output(compiled(folder, THREADS, *STRICT, "-pthread", name="threads")).splitlines()]
    assert [row[:2] for row in rows] == [["0", "0"]] * 4
    assert len({row[2] for row in rows}) == 4


@needs_cc
def test_two_libraries_in_one_program(tmp_path):
    """Nothing but prefixed names goes out of a library: two of them, of the same kind, live together."""
    for name, stem in (("first", "diode_bridge"), ("second", "rlc_diode")):
        codegen.write(case(stem)(), tmp_path / name, name=name)
    source = r"""
    #include "first/first.h"
    #include "second/second.h"
    #include "first/first.h"
    #include <stdio.h>
    int main(void)
    {
        static first_solver a;
        static second_solver b;
        int failed = first_init(&a) + second_init(&b);
        for (int k = 0; k < 100; k++)
            failed += first_step(&a) + second_step(&b);
        printf("%d %.17g %.17g\n", failed, a.x[0], b.x[0]);
        return FIRST_NX == SECOND_NX ? FIRST_OK : SECOND_OK;
    }
    """
    program = compiled(tmp_path, source, *STRICT, files=("first/first.c", "second/second.c"))
    failed, *states = output(program).split()
    assert failed == "0"
    for name, state in zip(("first", "second"), states, strict=True):
        solver = codegen.load(tmp_path / name).solver()
        assert [solver.step() for _ in range(100)] == [0] * 100
        assert solver.x[0] == pytest.approx(float(state), rel=1e-12)


@needs_cxx
@pytest.mark.parametrize("kind", KINDS)
def test_the_header_in_cpp(kind, written):
    folder, _ = written(kind)
    source = r"""
    #include "thing.h"
    int main()
    {
        thing_solver solver, *other = thing_create();
        const bool same = thing_init(&solver) == thing_step(other) && thing_get_time(&solver) == 0;
        thing_free(other);
        return same ? thing_step(&solver) : 1;
    }
    """
    subprocess.run([CC, *STRICT, "-c", "thing.c"], cwd=folder, check=True)
    flags = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-pedantic")
    if kind == "two positions":
        source = source.replace("== 0;", "== 1;")  # a start with two positions begins a step later
    output(compiled(folder, source, *flags, files=("thing.o",), compiler="g++", name="host"))


@needs_cxx
@needs_make
@pytest.mark.usefixtures("system_compiler")
def test_the_cpp_example(tmp_path):
    """What its head says to type, typed; and what it prints, beside Python."""
    text = (REPOSITORY / "docs/examples/host.cpp").read_text()
    lines = re.findall(r"^//     (.+)$", text, re.MULTILINE)
    assert lines[-1] == "./host"
    for line in lines[:-1]:
        line = re.sub("^nsmodel", f"{sys.executable} -m nsmodel", line).replace("-std=c++17", "-std=c++17 -Wall -Wextra -Werror")
        line = line.replace("cases/", f"{REPOSITORY}/cases/").replace("docs/", f"{REPOSITORY}/docs/")
        subprocess.run(line, shell=True, cwd=tmp_path, check=True, capture_output=True)
    done = subprocess.run(lines[-1], shell=True, cwd=tmp_path, check=True, capture_output=True, text=True)
    *events, last = done.stdout.splitlines()
    solver, stuck, expected = codegen.load(tmp_path / "two_masses-c").solver(), np.zeros(2, bool), []
    for k in range(10000):
        if k == 5000:
            assert solver.set_parameters([1, 1, 1, 1, 5]) == 0
        assert solver.step() == 0
        for i in np.flatnonzero((solver.index_set == 0) != stuck):
            stuck[i] = not stuck[i]
            expected.append(f"t = {solver.t:.3f} s: mass {i + 1} {'sticks' if stuck[i] else 'slips'}")
    assert len(events) > 5
    assert events == expected
    assert np.array(re.findall(r"= (\S+) [ms]", last), float) == pytest.approx([10, solver.x[0], solver.x[2]], rel=1e-12)


@needs_cc
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_converted_silently(kind, written):
    folder, _ = written(kind)
    flags = (*STRICT, "-Wconversion", "-Wsign-conversion", "-fsyntax-only")
    subprocess.run([CC, *flags, "thing.c", "example_main.c"], cwd=folder, check=True)


@needs_cc
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
def test_without_malloc(written):
    """-DNAME_NO_MALLOC, as the header and the README spell it."""
    folder, _ = written("newton")
    assert "THING_NO_MALLOC," in (folder / "thing.h").read_text()
    assert "`-DTHING_NO_MALLOC`" in (folder / "README.md").read_text()
    symbols = {}
    for flags in ([], ["-DTHING_NO_MALLOC"]):
        subprocess.run([CC, *STRICT, *flags, "-c", "-o", "bare.o", "thing.c"], cwd=folder, check=True)
        listed = subprocess.run(["nm", "bare.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
        symbols[bool(flags)] = {line.split()[-1] for line in listed.splitlines()}
    assert {"malloc", "free", "thing_create", "thing_free"} <= symbols[False]
    assert not {"malloc", "calloc", "realloc", "free", "thing_create", "thing_free"} & symbols[True]
    assert "thing_step" in symbols[True]


# ---------------------------------------------------------------------------------------------- the files


@pytest.mark.parametrize("kind", KINDS)
def test_header_readme_and_description_agree(kind, written):
    folder, about = written(kind)
    header, readme = (folder / "thing.h").read_text(), (folder / "README.md").read_text()
    assert json.loads((folder / "thing.json").read_text()) == about
    defined = dict(re.findall(r"^#define THING_(\w+) (\S+)", header, re.MULTILINE))
    for key, size in about["sizes"].items():
        assert int(defined[key]) == size
    assert about["sizes"]["NX"] == len(about["states"])
    assert about["sizes"]["NP"] == len(about["parameters"])
    assert about["sizes"]["NL"] == len(about["multipliers"])
    assert about["sizes"]["M"] == len(about["rows"])
    assert float(defined["STEP"]) == about["step"]
    assert float(defined["TOLERANCE"]) == about["tolerance"]
    assert int(defined["MAX_WORK"]) == about["max_work"] > 0
    assert defined["MODEL_HASH"] == f'"{about["model_hash"]}"'
    assert f"time step: {about['step']:g}" in readme
    assert ("thing_set_step" in readme) == about["any_step"]
    assert f"is at most {about['tolerance']:g} " in readme
    assert f"at most {about['max_work']} linear systems" in " ".join(readme.split())
    for lines in (about["used"], about["left_out"]):
        assert all(f"- {line[0].upper()}{line[1:]}." in readme for line in lines)
    assert ("Left out" in readme) == bool(about["left_out"])
    for declared, has in (("set_velocity", "velocity"), ("set_force", "force")):
        assert (f"thing_{declared}(" in header) == about[has]
    assert ("thing_set_parameters(" in header) == ("thing_set_parameters(" in readme) == bool(about["parameters"])
    assert ("thing_get_multipliers(" in header) == bool(about["rows"])
    for text in (header, readme, (folder / "example_main.c").read_text(), (folder / "Makefile").read_text()):
        assert "@" not in re.sub(r"\$@", "", text)
        assert not re.search(r"\b(model|MODEL)_\w", text.replace("MODEL_HASH", ""))


@pytest.mark.parametrize("kind", KINDS)
def test_no_size_is_defined_for_nothing(kind, written):
    folder, _ = written(kind)
    header = (folder / "thing.h").read_text()
    text = header + (folder / "thing.c").read_text()
    inner = header[header.index("THING_MODEL_HASH") : header.index("/* What the functions return")]
    names = re.findall(r"^#define (\w+)", inner, re.MULTILINE)
    assert all(len(re.findall(rf"\b{name}\b", text)) > 1 for name in names)


@needs_cc
@pytest.mark.parametrize("kind", ["matrices", "bounds of parameters", "smooth", "inputs"])
def test_the_code_in_the_readme_compiles(kind, written):
    folder, _ = written(kind)
    include, body = re.search(r"```c\n(#include \S+)\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL).groups()
    source = (
        f"{include}\nint fail(const char *text);\nint use(const double *p, const double *u);\n"
        f"int use(const double *p, const double *u)\n{{\n(void)p;\n(void)u;\n{body}}}\n"
    )
    (folder / "use.c").write_text(source)
    subprocess.run([CC, *STRICT, "-fsyntax-only", "use.c"], cwd=folder, check=True)


@needs_make
@pytest.mark.usefixtures("system_compiler")
def test_make(tmp_path, capfd):
    codegen.write(case("relay_oscillator")(), tmp_path, name="relay")
    for target in ([], ["run"], ["lib"], *([["size"]] if shutil.which("size") else [])):
        subprocess.run(["make", "-C", str(tmp_path), *target], check=True)
    printed = capfd.readouterr()
    assert "warning" not in printed.err
    assert re.search(r"[\d\s]+relay\.o", printed.out) or shutil.which("size") is None
    assert (tmp_path / "relay.csv").read_text().startswith("t,")
    built = {"relay_example", "relay.csv", "relay.o", "librelay.a", "librelay.so", "example_main.o"}
    assert built <= set(os.listdir(tmp_path))
    subprocess.run(["make", "-C", str(tmp_path), "clean"], check=True)
    written = {"relay.c", "relay.h", "relay.json", "example_main.c", "Makefile", "README.md"}
    assert set(os.listdir(tmp_path)) == written


@needs_cc
def test_the_example_refuses_what_is_no_number(written):
    folder, _ = written("matrices")
    program = compiled(folder, (folder / "example_main.c").read_text(), name="example")
    assert output(program, "1000").count("\n") == 7  # the head, the start, every thousandth of 5000 steps
    for wrong in ("0", "-3", "x"):
        done = subprocess.run([program, wrong], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert "usage" in done.stderr
        assert done.stdout == ""


# ---------------------------------------------------------------------------------------------- in Python


@pytest.fixture(scope="module")
def solver(written):
    """Return solver(kind) -> a new Solver of that library."""
    if CC is None:
        pytest.skip("no C compiler")
    return lambda kind: codegen.load(written(kind)[0]).solver()


def run_of(solver, steps, lengths=None) -> np.ndarray:
    """The states (steps + 1, n) of a solver."""
    rows = [solver.x]
    for k in range(steps):
        assert lengths is None or solver.set_step(lengths[k]) == 0
        assert solver.step() == 0
        rows.append(solver.x)
    return np.array(rows)


def agree(rows, run, first=0) -> None:
    expected = run.x[first : first + len(rows)]
    assert len(expected) == len(rows)
    assert (np.abs(rows - expected) <= 1e-10 * np.abs(expected).max(axis=0)).all()


def short(kind, steps, **changes):
    """The interpreted run of a kind's first steps."""
    model = KINDS[kind][0]()
    held = {"u": 1, "v": [0, 0]} if kind == "inputs" else None
    return nsmodel.simulate(model, t_end=steps * model.step, compiled=False, inputs=held, **changes)


@pytest.mark.parametrize("kind", KINDS)
def test_python_steps_the_library(kind, solver):
    steps = 20 if kind == "cuts" else 50
    s, run = solver(kind), short(kind, steps)
    first = 1 if kind == "two positions" else 0
    agree(run_of(s, steps - first), run, first)
    assert s.t == pytest.approx(run.t[-1], rel=1e-14)
    assert s.status == 0
    assert 0 <= s.residual <= 1e-9
    assert 0 <= s.iterations
    assert 0 <= s.work <= s.library.about["max_work"]
    assert s.multipliers.shape == s.y.shape == (s.library.about["sizes"]["NL"],)
    assert s.index_set.dtype == np.int8
    if kind not in ("smooth", "cuts"):  # the multipliers of an approximate projection are those of its last cuts
        assert s.index_set.tolist() == run.index_set[-1].tolist()
        np.testing.assert_allclose(s.multipliers, run.multipliers[-1], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(s.y, run.y[-1], rtol=1e-7, atol=1e-9)
    if s.library.about["velocity"]:
        np.testing.assert_allclose(s.v, run.v[-1], rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("kind", ["parameters", "bounds of parameters", "reactions", "two positions", "cuts"])
def test_other_parameters(kind, solver):
    s = solver(kind)
    values = {name: 0.75 * value for name, value in s.library.about["parameters"].items()}
    assert [s.step(), s.step()] == [0, 0]
    assert s.set_parameters(list(values.values())) == 0
    assert s.reset() == 0
    if kind == "reactions":
        model = KINDS[kind][0]().bind(values)
        start = completed_start_state(one_step_problem(model), initial_rows(model, model.step)[-1][0], model.step, 1e-9)
        assert s.set_force(start[2:]) == 0
    first = 1 if kind == "two positions" else 0
    run = short(kind, 20, parameters=values)
    agree(run_of(s, 20 - first), run, first)
    assert np.abs(run.x - short(kind, 20).x).max() > 1e-4


@pytest.mark.parametrize("kind", ["any step", "parameters", "bounds of parameters", "reactions", "newton", "oscillator", "rows"])
def test_a_step_changed_on_the_way(kind, solver):
    s, model = solver(kind), KINDS[kind][0]()
    lengths = model.step * np.array([1, 1, 0.5, 0.25, 2, 2, 2, 1, 3, 1])
    agree(run_of(s, 10, lengths), nsmodel.simulate(model, steps=lengths, compiled=False))
    assert s.t == pytest.approx(lengths.sum(), rel=1e-14)


def test_a_state_and_a_time_of_ones_own(solver):
    s, model = solver("parameters"), KINDS["parameters"][0]()
    run_of(s, 200)
    x = np.array([0.3, -1, 0.2, 0.4])
    assert (s.set_state(x), s.set_time(0)) == (0, 0)
    assert (s.x == x).all()
    assert s.t == 0
    agree(run_of(s, 50), nsmodel.simulate(replace(model, x0=x), t_end=0.05, compiled=False))


def test_a_velocity_that_overflows_is_not_finite(tmp_path):
    """Where the state holds the difference of two positions, which is finite itself."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = FrictionOscillator(x=x, s=s, potential=-1.7e308 * x, friction=1e-3 * s, x0=0, v0=0, step=0.5, t_end=10)
    thing = codegen.load(codegen.write(model, tmp_path, name="thing").folder).solver()
    assert [thing.step() for _ in range(3)] == [0, 0, 2]
    assert np.isfinite(thing.v).all()
    for compiled in (True, False):
        with pytest.raises(StepError, match=r"step 2: .*the velocity overflows; take a longer step") as stop:
            nsmodel.simulate(model, compiled=compiled)
        assert np.isfinite(stop.value.trajectory.v).all()
    fast = nsmodel.load("cabot_4_1")
    with pytest.raises(UsageError, match=r"the velocity \(x1 - x0\)/h overflows at h = 2e-16"):
        nsmodel.simulate(replace(fast, x1=2e303), step=2e-16, t_end=2e-15)


def test_a_reaction_of_ones_own(solver):
    """What set_force puts is what a step starts from: the run goes on as if it had not been interrupted."""
    s, other = solver("reactions"), solver("reactions")
    run_of(s, 30)
    assert (other.set_state(s.x), other.set_time(s.t)) == (0, 0)
    assert other.set_force(s.force) == 0
    np.testing.assert_allclose(run_of(other, 20), run_of(s, 20), rtol=0, atol=1e-9)


def test_refusals_in_python(solver):
    s = solver("bounds of parameters")
    texts = {}
    for name, value, status in [
        ("set_time", np.nan, 2), ("set_step", 0, 3), ("set_state", [1, np.nan], 2), ("set_velocity", [np.inf, 0], 2),
        ("set_parameters", [np.nan, 1], 2), ("set_parameters", [-0.5, 1], 4),
    ]:  # fmt: skip
        assert getattr(s, name)(value) == status
        texts[status] = s.library.status_text(status)
    assert re.search("NaN", texts[2])
    assert re.search("step", texts[3])
    assert re.search("empty", texts[4])
    agree(run_of(s, 20), short("bounds of parameters", 20))


def test_what_a_library_does_not_have(solver):
    s = solver("matrices")
    for name, value in (("set_velocity", [0, 0]), ("set_force", [0, 0]), ("set_parameters", [])):
        with pytest.raises(CodegenError, match=f"thing has no function {name}"):
            getattr(s, name)(value)
    for name, function in (("v", "get_velocity"), ("force", "get_force")):
        with pytest.raises(CodegenError, match=f"no function {function}"):
            getattr(s, name)
    empty = solver("smooth")
    assert empty.multipliers.size == empty.y.size == empty.index_set.size == 0


@pytest.mark.parametrize(("name", "count"), [("state", 4), ("parameters", 5)])
def test_arrays_of_a_wrong_size(name, count, solver):
    s = solver("parameters")
    for given in (np.zeros(count - 1), np.zeros(count + 1), 1.0, []):
        with pytest.raises(CodegenError, match=f"{name}: {np.size(given)} numbers given; expected {count}"):
            getattr(s, f"set_{name}")(given)
    assert getattr(s, f"set_{name}")(np.ones((count, 1), int)[::-1]) == 0


def test_threads_in_python(solver):
    """ctypes lets go of the interpreter's lock: solvers step at the same time, and each as alone."""
    solvers = [solver("newton") for _ in range(4)]
    for i, s in enumerate(solvers):
        assert s.set_state(s.x + 0.1 * i) == 0
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda s: run_of(s, 100), solvers))
    for i, run in enumerate(runs):
        alone = solver("newton")
        assert alone.set_state(alone.x + 0.1 * i) == 0
        assert (run_of(alone, 100) == run).all()


# ---------------------------------------------------------------------------------------------- building and loading


@needs_cc
def test_written_again_is_built_again(tmp_path):
    """In one process: the library is not the one that was loaded from the same path before."""
    model, times = case("relay_oscillator")(), []
    for step in (1e-3, 2e-3):
        codegen.write(model, tmp_path, name="again", step=step)
        solver = codegen.load(tmp_path).solver()
        assert solver.step() == 0
        times.append(solver.t)
    assert times == [1e-3, 2e-3]


@needs_cc
def test_built_once(tmp_path, monkeypatch):
    codegen.write(smooth(), tmp_path, name="once")
    solver = codegen.load(tmp_path).solver()
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    other = codegen.load(tmp_path).solver()
    assert solver.library.path == other.library.path == next(tmp_path.glob(f"libonce-*{LIBRARY_SUFFIX}"))
    assert (solver.step(), other.step()) == (0, 0)
    (tmp_path / "once.h").write_text((tmp_path / "once.h").read_text() + "/* another header */\n")
    with pytest.raises(CodegenError, match=r"no C compiler was found .*install one"):
        codegen.load(tmp_path)


@pytest.mark.parametrize(
    ("about", "message"),
    [(None, "has no libraries"), ("", "has no libraries"), ("[]", "has no libraries"), ('{"name": "x"}', "has no libraries")],
)
def test_damaged_descriptions(about, message, tmp_path):
    codegen.write(smooth(), tmp_path, name="x")
    (tmp_path / "x.json").unlink()
    if about is not None:
        (tmp_path / "x.json").write_text(about)
    with pytest.raises(CodegenError, match=message):
        codegen.load(tmp_path)
    with pytest.raises(CodegenError, match=message):
        codegen.load(tmp_path / "nowhere")


def test_two_libraries_in_a_folder(tmp_path):
    for name in ("a", "b"):
        codegen.write(smooth(), tmp_path / name, name=name)
    shutil.copytree(tmp_path / "b", tmp_path / "a", dirs_exist_ok=True)
    with pytest.raises(CodegenError, match="has 2 libraries; expected one"):
        codegen.load(tmp_path / "a")


@needs_cc
def test_damaged_code(tmp_path, monkeypatch):
    codegen.write(smooth(), tmp_path, name="x")
    good = (tmp_path / "x.c").read_text()
    (tmp_path / "x.c").write_text(good.replace("return", "retrun"))
    with pytest.raises(CodegenError, match=r"could not compile x\.c: .*x\.c:\d+.*error") as caught:
        codegen.load(tmp_path)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob(f"*{LIBRARY_SUFFIX}"))
    monkeypatch.setenv("CC", "false")
    with pytest.raises(CodegenError, match=r"false could not compile x\.c: exit status 1"):
        codegen.load(tmp_path)
    monkeypatch.delenv("CC")
    (tmp_path / "x.c").write_text(good)
    assert codegen.load(tmp_path).solver().step() == 0
    gc.collect()
    (built,) = tmp_path.glob(f"libx-*{LIBRARY_SUFFIX}")
    built.unlink()
    built.write_text("no library")
    with pytest.raises(CodegenError, match=r"libx-\w+\.\w+ could not be loaded .*remove it"):
        codegen.load(tmp_path)
    built.unlink()
    assert codegen.load(tmp_path).solver().step() == 0


@needs_cc
def test_code_that_was_changed_is_built_beside_what_is_loaded(tmp_path):
    """A file that is loaded is neither replaced nor removed: what was built from older code goes with the next build."""
    codegen.write(smooth(), tmp_path, name="x")
    good, held, names = (tmp_path / "x.c").read_text(), [], []
    for k in range(3):
        (tmp_path / "x.c").write_text(f"{good}int x_number(void) {{ return {k}; }}\n")
        held.append(codegen.load(tmp_path))
        names.append(held[-1].path)
        assert [library.function("number", ctypes.c_int)() for library in held] == [*range(k + 1)]
    assert len(set(names)) == 3
    assert set(tmp_path.glob(f"libx-*{LIBRARY_SUFFIX}")) == set(names)
    held.clear()
    gc.collect()
    (tmp_path / "x.c").write_text(good)
    last = codegen.load(tmp_path).path
    assert set(tmp_path.glob(f"libx-*{LIBRARY_SUFFIX}")) == {last}


@needs_cc
def test_a_library_without_its_functions(tmp_path):
    codegen.write(smooth(), tmp_path, name="x")
    (tmp_path / "x.c").write_text("int nothing(void) { return 0; }\n".replace("nothing", "x_nothing"))
    library = codegen.load(tmp_path)
    with pytest.raises(CodegenError, match="the library x has no function create"):
        library.solver()


# ---------------------------------------------------------------------------------------------- refusals


FILE = """
import casadi as ca
from nsmodel import FirstOrderSystem, MonotoneInclusion
x, k = ca.SX.sym("x", 2), ca.SX.sym("k")
y = ca.SX.sym("y")
hidden = ca.Function("hidden", [y], [ca.sin(y)], {"never_inline": True})
"""
GRID = "x0=[1, 0], t_end=1, step=0.5"
NO_COUNTERPART = {
    f"model = FirstOrderSystem(x=x, f=[x[1], -hidden(x[0])], {GRID})": r"not inlined; build it with never_inline=False",
    f"model = FirstOrderSystem(x=x, f=[4 * x[0], 4 * x[1]], theta=0.5, {GRID})": r"singular at h = 0\.5: change the step",
    f"model = MonotoneInclusion(x=x, field=[1, 0], upper=[k, 3], parameters={{k: 2}}, {GRID})": r"'k' bounds .*"
    r"--set k=VALUE",
}  # fmt: skip


@pytest.mark.parametrize("model", NO_COUNTERPART)
def test_no_counterpart_in_c(model, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("refused.py").write_text(FILE + model)
    assert main(["codegen", "refused.py"]) == 4
    printed = capsys.readouterr()
    assert re.search(f"^nsmodel: no C code: .*{NO_COUNTERPART[model]}", printed.err)
    assert printed.out == ""
    assert os.listdir() == ["refused.py"]


def test_the_fix_of_a_parameter_of_the_set(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("refused.py").write_text(FILE + list(NO_COUNTERPART)[2])
    assert main(["codegen", "refused.py", "--set", "k=1.5"]) == 0
    assert "none to set" in capsys.readouterr().out


GOOD = f"model = FirstOrderSystem(x=x, f=[x[1], -k * x[0]], parameters={{k: 2}}, {GRID})"
WRONG = {
    "--name int": r"name = 'int'; expected up to 63 letters, digits and _",
    f"--name {'a' * 64}": r"expected up to 63 letters",
    "--name a-b": r"name = 'a-b'",
    "--name 1a": r"name = '1a'",
    "--name _a": r"name = '_a'",
    "--name math": r"name = 'math'; .*header",
    "--name example_main": r"name = 'example_main'",
    "--name é": r"name = 'é'",
    "--step 0": r"step = 0; expected a finite number > 0",
    "--step nan": r"step = nan",
    "--tolerance 1": r"tolerance = 1; expected a number between 1e-14 and 1",
    "--tolerance nan": r"tolerance = nan",
    "--set m=1": r"takes no 'm': .*parameters of the model k",
    "--set k": r"--set k: expected NAME=VALUE",
    "--set k=a": r"'a' is not a number",
    "--set k=nan": r"k",
    "--out good.py": r"good\.py is a file; expected a folder",
    "--out taken": r"taken has README\.md already, which is not of a library 'good'; name another folder",
}


@pytest.mark.parametrize("arguments", WRONG)
def test_wrong_arguments(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("good.py").write_text(FILE + GOOD)
    Path("taken").mkdir()
    Path("taken/README.md").write_text("mine")
    assert main(["codegen", "good.py", *arguments.split()]) == 2
    assert re.search(f"^nsmodel: .*{WRONG[arguments]}", capsys.readouterr().err)
    assert sorted(str(path) for path in Path().rglob("*")) == ["good.py", "taken", "taken/README.md"]


@pytest.mark.parametrize(("model", "message"), [
    ("model = FirstOrderSystem(x=x, f=[x[1], 0], x0=[1, 0], t_end=1)", "no time step: .*--step H"),
    (f"model = FirstOrderSystem(x=x, f=[x[1], k], {GRID})", "k"),
    ("", "defines no 'model'"),
])  # fmt: skip
def test_wrong_models(model, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("wrong.py").write_text(FILE + model)
    assert main(["codegen", "wrong.py"]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert os.listdir() == ["wrong.py"]
    assert main(["codegen", "nowhere.py"]) == 2


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write .*file/below"):
        codegen.write(smooth(), tmp_path / "file" / "below")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="nothing is unwritable here")
def test_an_unwritable_folder(tmp_path):
    (tmp_path / "closed").mkdir(mode=0o500)
    with pytest.raises(StorageError, match="take a folder that is writable"):
        codegen.write(smooth(), tmp_path / "closed")
    assert not list((tmp_path / "closed").iterdir())


def test_a_library_is_replaced_by_its_own_name_only(tmp_path):
    codegen.write(smooth(), tmp_path, name="a")
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UsageError, match=r"has example_main\.c, Makefile, README\.md already, which are not of a library 'b'"):
        codegen.write(smooth(), tmp_path, name="b")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files
    again = codegen.write(smooth(), tmp_path, name="a", step=0.02)
    assert sorted(again.files) == sorted(files)
    assert {path.name for path in tmp_path.iterdir()} == files.keys()
    assert "A_STEP 0.02 " in (tmp_path / "a.h").read_text()


@pytest.mark.parametrize("name", ["", "a b", "a\n", 3, "while"])
def test_wrong_names(name, tmp_path):
    with pytest.raises(UsageError, match=r"name = .*expected up to 63 letters"):
        codegen.write(smooth(), tmp_path / "none", name=name)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(("text", "name"), [
    ("Two masses!", "two_masses"), ("3 bodies", "model_3_bodies"), ("int", "model_int"), ("math", "model_math"), ("", "model"),
    ("é", "model"), ("example main", "model_example_main"), ("x" * 60, "x" * 40),
])  # fmt: skip
def test_prefixes_made_of_titles(text, name):
    assert codegen.identifier(text) == name


@needs_cc
@pytest.mark.parametrize("stem", ["3body", "math", "model_x", "newton", "fixed", "start", "smooth"])
def test_files_with_difficult_names(stem, tmp_path, monkeypatch):
    """Digits, headers of libc, and the words of the generator itself."""
    monkeypatch.chdir(tmp_path)
    model = "f=[x[1], -k * ca.sin(x[0])], lam=y, h=x[1], g=[0, y], law=relay(1), parameters={k: 2}"
    Path(f"{stem}.py").write_text(f"{FILE}from nsmodel import relay\nmodel = FirstOrderSystem(x=x, {model}, {GRID})")
    assert main(["codegen", f"{stem}.py"]) == 0
    name, folder = codegen.identifier(stem), Path(f"{stem}-c")
    assert sorted(path.name for path in folder.glob("*.c")) == sorted([f"{name}.c", "example_main.c"])
    subprocess.run([CC, *STRICT, "-o", "example", f"{name}.c", "example_main.c", "-lm"], cwd=folder, check=True)
    assert output(folder.resolve() / "example").splitlines()[0] == "t,x_0,x_1,y"


# ---------------------------------------------------------------------------------------------- the command line


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Return command(*arguments) -> (what ``nsmodel codegen good.py ...`` prints, the description that it writes)."""
    monkeypatch.chdir(tmp_path)
    Path("good.py").write_text(FILE + GOOD)

    def run(*arguments, folder="good-c", name="good"):
        assert main(["codegen", "good.py", *arguments]) == 0
        printed = capsys.readouterr()
        assert printed.err == ""
        return printed.out, json.loads(Path(folder, f"{name}.json").read_text())

    return run


def test_codegen(command):
    printed, about = command()
    assert printed.splitlines()[0] == "good: good.h and good.c, " + re.search(r"\d+\.\d kB of C99, in good-c", printed)[0]
    assert "parameters      k = 2" in printed
    assert "step            0.5, or any other" in printed
    assert "build and run   make -C good-c run" in printed
    assert f"work            {about['max_work']} linear systems, index sets and sweeps in a step at most" in printed
    assert sorted(os.listdir("good-c")) == ["Makefile", "README.md", "example_main.c", "good.c", "good.h", "good.json"]
    assert about["parameters"] == {"k": 2}
    assert about["tolerance"] == 1e-9


def test_codegen_options(command):
    options = "--set k=3 --step 0.25 --tolerance 1e-7 --name Other --out a/b"
    printed, about = command(*options.split(), folder="a/b", name="Other")
    assert "0.25 only (--any-step for others)" in printed
    assert "none to set" in printed
    assert "make -C a/b run" in printed
    assert (about["name"], about["step"], about["tolerance"], about["any_step"]) == ("Other", 0.25, 1e-7, False)
    assert about["parameters"] == {}
    assert "OTHER_TOLERANCE 1e-07 " in Path("a/b/Other.h").read_text()


def test_codegen_any_step(command):
    printed, about = command("--set", "k=3", "--any-step")
    assert "0.5, or any other" in printed
    assert about["any_step"]


@needs_cc
def test_a_set_parameter_is_its_number(command):
    """--set k=3 and set_parameters([3]) are the same step; --step is the step."""
    command("--set", "k=3", "--step", "0.25")
    frozen = codegen.load("good-c").solver()
    command("--out", "free", folder="free")
    free = codegen.load("free").solver()
    assert (free.set_parameters([3]), free.set_step(0.25)) == (0, 0)
    np.testing.assert_allclose(run_of(free, 10), run_of(frozen, 10), rtol=0, atol=1e-12)


def test_codegen_is_deterministic(command):
    command()
    first = {path.name: path.read_bytes() for path in Path("good-c").iterdir()}
    command()
    assert {path.name: path.read_bytes() for path in Path("good-c").iterdir()} == first


def test_codegen_help(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["codegen", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(option in text for option in ("--out", "--name", "--step", "--any-step", "--tolerance", "--set"))
    with pytest.raises(SystemExit) as stop:
        main(["codegen"])
    assert stop.value.code == 2


def test_the_wrapper_says_what_it_does():
    for kind in (codegen.Library, codegen.Solver):
        public = {name: value for name, value in vars(kind).items() if not name.startswith("_")}
        assert all((value.fget if isinstance(value, property) else value).__doc__ for value in public.values())
    header = (FRAGMENTS / "header.h").read_text(encoding="utf-8")
    wrapped = (Path(codegen.__file__).parent / "library.py").read_text()
    for name in set(re.findall(r"\bmodel_(?:set|get)_(\w+)\(", header)):
        assert f'"{name}"' in wrapped or f'_{name}"' in wrapped, name
    assert issubclass(CodegenError, NsmodelError)


ARM, QEMU = shutil.which("arm-none-eabi-gcc"), shutil.which("qemu-system-arm")


@pytest.mark.skipif(not (ARM and QEMU), reason="no compiler for ARM, or no emulator")
def test_a_library_has_the_same_bits_on_a_cortex_m4(tmp_path):
    """The example of the page, in doubles that its processor has no unit for; where newlib is missing too, it is skipped."""
    board = REPOSITORY / "docs/examples/cortex_m4"
    model = nsmodel.load("bouncing_ball")
    codegen.write(model, tmp_path, name="ball")
    flags = "-std=c99 -O2 -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -nostartfiles --specs=nosys.specs".split()
    given = ["-DNAME=ball", "-DSTEPS=300", "-DSTATES=4", "-DBALL_NO_MALLOC", "-include", "ball.h", "-T", board / "board.ld"]
    sources = [board / "board.c", board / "main.c", "ball.c", "-lm", "-o", "board.elf"]
    built = subprocess.run([ARM, *flags, *given, *sources], cwd=tmp_path, capture_output=True, text=True)
    if "nosys.specs" in built.stderr or "math.h: No such" in built.stderr:
        pytest.skip("no newlib for ARM")
    assert built.returncode == 0, built.stderr
    emulated = "-M mps2-an386 -nographic -semihosting -icount shift=0 -kernel board.elf".split()
    said = subprocess.run([QEMU, *emulated], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True).stderr.split()
    assert said[:2] == ["0", "300"]
    here = codegen.load(tmp_path).solver()
    for _ in range(300):
        assert here.step() == 0
    assert [int(bits, 16) for bits in said[4:]] == np.array(here.x).view(np.uint64).tolist()
