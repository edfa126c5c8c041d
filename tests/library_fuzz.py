"""Generated libraries behind a harness that calls them with random and hostile numbers, and what judges their steps.

Every accepted step is judged from the model's own mathematics, in extended precision, with nothing of `nsmodel.solvers`.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel import codegen

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZE = ("-O0", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
COUNT = 1500  # Inputs of a model: 10 500 in all.
SECONDS = 60  # All inputs of a model take less than a second: what takes longer hangs.

DONE, NOT_SOLVED, NOT_FINITE, BAD_STEP, BAD_PARAMETER = range(5)
STEP = 5  # The column of its status; the setters' are before it.
SPECIAL = np.array([
    np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, -1e160, 1e90, -1e60, 1e30, 1e-30, 1e-90, -1e-200, 1e-308, 5e-324, 0, -0.0, -1
])  # fmt: skip
EPS = np.finfo(float).eps
UNRESOLVED = 1e-280  # Nothing below this is looked at: doubles lose digits there.
# Twice the tolerance of the library, whose scales are others:
LAW = 2e-9  # Largest residual of a law, by the scales of `box_law` and `ball_law`.
MOTION = 2e-9  # Largest residual of the equations of motion beside what moves in the step,
ROUND_OFF = 64 * EPS  # and beside all that is added up in them.
UNDERFLOW = 1e-322  # Coefficients below 1e-308 are rounded to this.

# ---------------------------------------------------------------------------------------------- the harness


HARNESS = """
#include "scene.h"
#include <stddef.h>
#include <stdio.h>
#include <string.h>

static scene_solver s, before;
static double untouched;

/* What is refused must change nothing but the status. */
static double checked(int status)
{
    if (status != SCENE_OK) {
        before.residual = s.residual; /* what is told of a step that failed is of that step */
        before.spent = s.spent;
        before.status = s.status;
        before.iterations = s.iterations;
        before.solver = s.solver;
        if (memcmp(&s, &before, offsetof(scene_solver, work)) != 0)
            untouched = 0;
    }
    before = s;
    return status;
}

int main(int count, char **names)
{
    double in[3 + 2*SCENE_NX + SCENE_NP];
    double out[10 + 2*SCENE_NSTATE + SCENE_NP + SCENE_NL]; /* statuses, untouched, t, h, residual, before, p, after, l */
    FILE *from = count == 3 ? fopen(names[1], "rb") : NULL, *to = count == 3 ? fopen(names[2], "wb") : NULL;
    if (from == NULL || to == NULL || scene_init(&s) != SCENE_OK)
        return 2;
    before = s;
    while (fread(in, sizeof in, 1, from) == 1) {
        const double *x = in + 3, *second = x + SCENE_NX;
        double *at = out + 10;
        memset(out, 0, sizeof out);
        untouched = 1;
        if (in[0] != 0)
            checked(scene_reset(&s));
        out[0] = checked(scene_set_time(&s, in[1]));
#if SCENE_NP > 0
        out[1] = checked(scene_set_parameters(&s, second + SCENE_NX));
#endif
        out[2] = checked(scene_set_step(&s, in[2]));
        out[3] = checked(scene_set_state(&s, x));
#if VELOCITY
        out[4] = checked(scene_set_velocity(&s, second));
#elif FORCE
        out[4] = checked(scene_set_force(&s, second));
#else
        (void)second;
#endif
        out[7] = s.t;
        out[8] = s.h;
        memcpy(at, s.x, sizeof s.x);
        at += SCENE_NSTATE;
#if SCENE_NP > 0
        memcpy(at, s.p, sizeof s.p);
        at += SCENE_NP;
#endif
        out[5] = checked(scene_step(&s));
        if (out[5] != scene_get_status(&s) || scene_status_text(scene_get_status(&s)) == NULL)
            return 3;
        out[6] = untouched;
        out[9] = scene_get_residual(&s);
        memcpy(at, s.x, sizeof s.x);
        at += SCENE_NSTATE;
#if SCENE_NL > 0
        scene_get_multipliers(&s, at);
#endif
        fwrite(out, sizeof out, 1, to);
    }
    return fclose(from) | fclose(to);
}
"""


@dataclass
class Input:
    """What the harness is given; ``second`` is a velocity or a force, where the model has one."""

    t: float
    h: float
    x: np.ndarray
    second: np.ndarray
    p: np.ndarray
    reset: bool = False

    def packed(self) -> np.ndarray:
        return np.concatenate([[self.reset, self.t, self.h], self.x, self.second, self.p])


@dataclass
class Step:
    """What was in effect when a step was accepted, and what it gave; all in extended precision."""

    t: Any
    h: Any
    state: np.ndarray
    p: np.ndarray
    after: np.ndarray
    l: np.ndarray


class Binary:
    """The library of a model behind the harness."""

    def __init__(self, model: Any, folder: Path, flags: tuple[str, ...], lie: tuple[str, str] = ("", ""), **options: Any):
        folder.mkdir(parents=True, exist_ok=True)
        self.about = about = codegen.write(model, folder, name="scene", **options).about
        sizes = about["sizes"]
        self.nx, self.np, self.width = sizes["NX"], sizes["NP"], 10 + 2 * sizes["NSTATE"] + sizes["NP"] + sizes["NL"]
        self.ends = np.cumsum([10, sizes["NSTATE"], sizes["NP"], sizes["NSTATE"]])
        code = (folder / "scene.c").read_text()
        assert lie[0] in code
        (folder / "scene.c").write_text(code.replace(*lie))
        (folder / "harness.c").write_text(HARNESS)
        self.folder, self.program = folder, folder / "harness"
        defined = (f"-DVELOCITY={int(about['velocity'])}", f"-DFORCE={int(about['force'])}")
        command = [COMPILER, *STRICT, *flags, *defined, "-o", self.program, folder / "harness.c", folder / "scene.c", "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[:3000]

    def run(self, inputs: list[Input]) -> np.ndarray:
        """One row for each input; a crash, a finding of a sanitizer or a hang is a failure."""
        np.array([given.packed() for given in inputs]).tofile(self.folder / "in")
        command = [self.program, self.folder / "in", self.folder / "out"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=SECONDS)
        assert done.returncode == 0, done.stderr[-3000:]
        assert not done.stderr
        rows = np.fromfile(self.folder / "out").reshape(-1, self.width)
        assert len(rows) == len(inputs)
        return rows

    def step(self, row: np.ndarray) -> Step:
        head, state, p, after, l = np.split(row.astype(np.longdouble), self.ends)
        return Step(head[7], head[8], state, p, after, l)


# ---------------------------------------------------------------------------------------------- independent residuals


def ratios(part: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """|part| / scale, infinite where it is not a number."""
    r = np.abs(part) / np.maximum(scale, UNRESOLVED)
    return np.where(np.isnan(r), np.inf, r)


def motion(E: np.ndarray, moved: np.ndarray, terms: np.ndarray, lost: Any = 0.0) -> float:
    """|E| beside what moves in the step, in units of MOTION; round-off of the terms is no motion."""
    return float(ratios(E, MOTION * moved + ROUND_OFF * terms + lost).max()) * MOTION


def box_law(l: np.ndarray, y: np.ndarray, lower: Any, upper: Any, size_y: np.ndarray, unit: Any = 1.0, other: Any = 0.0) -> float:
    """-y in N_[lower, upper](l): the distance to the nearest branch of each row, y beside the terms that it consists of, l beside
    itself and its bounds, or 1e-6 of the largest multiplier (or of another force) in its unit, which may hide it.
    """
    size_l = np.maximum(np.abs(l), 1e-6 * unit * np.maximum((np.abs(l) / unit).max(initial=0), other))
    for end in (lower, upper):
        size_l = np.maximum(size_l, np.abs(end) if np.isfinite(end) else 0)
    best = np.maximum(ratios(np.maximum(np.maximum(lower - l, l - upper), 0), size_l), ratios(y, size_y))
    for end, wrong in ((lower, np.maximum(-y, 0)), (upper, np.maximum(y, 0))):
        if np.isfinite(end):
            best = np.minimum(best, np.maximum(ratios(l - end, size_l), ratios(wrong, size_y)))
    return float(best.max(initial=0))


def ball_law(l: np.ndarray, y: np.ndarray, radius: Any, size_y: Any, other: Any) -> float:
    """l = -radius y/|y|, or y = 0 and |l| <= radius; l beside the radius, or 1e-6 of another force, which may hide it."""
    size_l, far, scale = np.sqrt(l @ l), np.sqrt(y @ y), max(radius, 1e-6 * other)
    sticks = max(ratios(max(size_l - radius, 0), scale), ratios(far, size_y))
    return float(sticks if far == 0 else min(sticks, ratios(l + radius * y / far, scale).max()))


def magnitude(rng: np.random.Generator, size: int, low: float = -6, high: float = 6) -> np.ndarray:
    """Numbers of either sign whose sizes are spread over the decades from ``low`` to ``high``."""
    return rng.choice([-1, 1], size) * 10 ** rng.uniform(low, high, size)


# ---------------------------------------------------------------------------------------------- the models


@dataclass(frozen=True)
class Subject:
    """A model under test.

    Attributes:
        model: load_case -> Model.
        ordinary: rng -> Input that is finite and feasible.
        judge: Step -> (residual of the law, residual of the motion).
        impossible: Step-like row in effect -> whether the step surely has no solution.
        bad_parameters: whether parameters, all finite, are refused.
        length: the one step that the library takes; None where it takes any.
        lie: by what an accepted state is multiplied for the judge to see it as wrong.
        options: of `codegen.write`.
    """

    model: Callable[[Callable[..., Any]], Any]
    ordinary: Callable[[np.random.Generator], Input]
    judge: Callable[[Step], tuple[float, float]]
    impossible: Callable[[Step], bool] | None = None
    bad_parameters: Callable[[np.ndarray], bool] = lambda p: False
    length: float | None = None
    lie: float = 1.000001
    options: tuple[tuple[str, Any], ...] = ()


NONE = np.zeros(0)


def linear_step(step: Step, A: np.ndarray, B: np.ndarray, f: Any, theta: float) -> float:
    """x+ - x = h theta (A x+ + f(t+h)) + h (1 - theta) (A x + f(t)) + h B l."""
    x, z, l, h = step.state, step.after, step.l, step.h
    ahead, behind = f(np.longdouble(float(step.t) + float(h))), f(step.t)
    rest = h * (theta * (A @ x + ahead) + (1 - theta) * (A @ x + behind))
    E = z - x - h * theta * (A @ (z - x)) - rest - h * (B @ l)
    moved = np.abs(z - x) + h * theta * (np.abs(A) @ np.abs(z - x)) + np.abs(rest) + h * (np.abs(B) @ np.abs(l))
    terms = (
        np.abs(z) + np.abs(x) + h * (np.abs(A) @ (np.abs(x) + np.abs(z)) + np.abs(ahead) + np.abs(behind) + np.abs(B) @ np.abs(l))
    )
    lost = UNDERFLOW * (1 + h) * (1 + np.abs(A).max()) * (np.abs(x).sum() + np.abs(z).sum() + np.abs(l).sum())
    return motion(E, moved, carried(np.eye(x.size) - h * theta * A, terms), lost)


def carried(M: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Round-off of the terms of a linear system with matrix M, as its solution carries it from row to row."""
    try:
        seen = np.abs(M) @ np.abs(np.linalg.inv(M.astype(float))) @ terms
    except np.linalg.LinAlgError:
        return terms
    return np.where(np.isfinite(seen), np.maximum(seen, terms), terms)


def hostile(rng: np.random.Generator, given: Input) -> Input:
    """Some of the numbers replaced by special ones, or all by numbers of any size."""
    packed = given.packed()[1:]
    if rng.random() < 0.7:
        places = rng.integers(0, packed.size, rng.integers(1, 4))
        packed[places] = rng.choice(SPECIAL, places.size)
    else:
        packed = magnitude(rng, packed.size, -320, 308)
    packed[0] += 0.0  # -0 becomes 0 in the sum t_0 + k h
    packed[1] = abs(packed[1]) if rng.random() < 0.5 else packed[1]
    n = given.x.size
    return Input(packed[0], packed[1], packed[2 : 2 + n], packed[2 + n : 2 + 2 * n], packed[2 + 2 * n :], rng.random() < 0.2)


def inputs_of(subject: Subject, count: int, seed: int) -> tuple[list[Input], np.ndarray]:
    """(inputs, whether each is finite and feasible): 60 % are; what follows a hostile one starts from what that left."""
    rng = np.random.default_rng(seed)
    ordinary = rng.random(count) < 0.6
    given = [subject.ordinary(rng) for _ in range(count)]
    return [one if good else hostile(rng, one) for one, good in zip(given, ordinary, strict=True)], ordinary


def judged(binary: Binary, subject: Subject, row: np.ndarray) -> tuple[float, float]:
    with np.errstate(all="ignore"):  # hostile numbers; what is not a number is no pass
        return subject.judge(binary.step(row))
