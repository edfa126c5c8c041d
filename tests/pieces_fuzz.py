"""Event-driven libraries behind a harness that calls them with random and hostile numbers, in a random order.

What must hold whatever comes: each call returns a known status; a setter that refuses leaves time, state, inputs and counts as
they were, to the bit; ``advance`` that succeeds is at its time, with finite numbers, after no more pieces than were allowed; one
that does not stands between where it stood and its end, and says where; and no call takes longer than its pieces can.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from conftest import optimised
from library_fuzz import COMPILER, STRICT

from nsmodel import codegen

SANITIZE = ("-g", optimised("-O1"), "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
SECONDS = 120
INIT, SET_STATE, SET_PARAMETERS, RESET, SET_INPUTS, SET_MOST, ADVANCE, THROUGH = range(8)
COMMANDS = 8
TIMES = 3  # That `advance_through` is given.

HARNESS = r"""
#include "thing_pieces.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define N THING_PIECES_N
#define M (THING_PIECES_M + 1)

static thing_pieces s;
static long number, most = 200, ok[8], refused[8];
static double slowest;

static void broken(const char *what, int command, int status)
{
    printf("command %ld, of kind %d: %s (status %d, t = %.17g, state", number, command, what, status, thing_pieces_get_time(&s));
    double x[N];
    thing_pieces_get_state(&s, x);
    for (int i = 0; i < N; i++)
        printf(" %.17g", x[i]);
    printf(")\n");
    exit(4);
}

typedef struct {
    double t, x[N], u[4 + NU], events;
} standing;

static standing stands(void)
{
    standing was;
    memset(&was, 0, sizeof was);
    was.t = thing_pieces_get_time(&s);
    thing_pieces_get_state(&s, was.x);
#if NU
    thing_pieces_get_inputs(&s, was.u);
#endif
    was.events = (double)thing_pieces_get_events(&s);
    return was;
}

static int all_finite(int count, const double *x)
{
    for (int i = 0; i < count; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

static void look(void)
{
#if THING_PIECES_M
    double l[M], y[M];
    signed char codes[M];
    thing_pieces_get_multipliers(&s, l);
    thing_pieces_get_outputs(&s, y);
    thing_pieces_get_index_set(&s, codes);
    for (int i = 0; i < THING_PIECES_M; i++)
        if (codes[i] < -1 || codes[i] > 1)
            broken("an index that is none", -1, codes[i]);
#endif
}

int main(int count, char **names)
{
    double in[1 + 3 + N + NOWN + NU + 1];
    FILE *from = count == 2 ? fopen(names[1], "rb") : NULL;
    if (from == NULL)
        return 2;
    const int first = thing_pieces_init(&s, 1e-6);
    thing_pieces_set_most(&s, most);
    if (first != THING_OK)
        printf("no start: %d\n", first);
    for (; fread(in, sizeof in, 1, from) == 1; number++) {
        const int command = (int)in[0];
        const double *t = in + 1, *x = in + 4, *p = x + N, *u = p + NOWN;
        const standing was = stands();
        const clock_t began = clock();
        int status = THING_OK, sets = 0;
        if (command == 0)
            status = thing_pieces_init(&s, t[0]);
        else if (command == 1)
            status = thing_pieces_set_state(&s, t[0], x), sets = 1;
#if NOWN
        else if (command == 2)
            status = thing_pieces_set_parameters(&s, p), sets = 1;
        else if (command == 3)
            status = thing_pieces_reset(&s);
#endif
#if NU
        else if (command == 4)
            status = thing_pieces_set_inputs(&s, u), sets = 1;
#endif
        else if (command == 5)
            thing_pieces_set_most(&s, most = (long)(1 + fmod(fabs(t[0]), 40)));
        else if (command == 6) {
            status = thing_advance(&s, t[0]);
            if (status == THING_OK && thing_pieces_get_time(&s) != t[0])
                broken("done, and not at its time", command, status);
            if ((status == THING_OK || status == THING_NOT_SOLVED) && s.pieces > most)
                broken("more pieces than were allowed", command, status);
        } else if (command == 7) {
            double rows[3*N];
            status = thing_advance_through(&s, 3, t, rows);
            if (status == THING_OK && !all_finite(3*N, rows))
                broken("done, with a row that is not finite", command, status);
        }
        const double seconds = (double)(clock() - began)/CLOCKS_PER_SEC;
        slowest = seconds > slowest ? seconds : slowest;
        (void)x, (void)p, (void)u;
        if (status < 0 || status > 16)
            broken("a status that is none", command, status);
        (status == THING_OK ? ok : refused)[command] += 1;
        const standing is = stands();
        if (sets && status != THING_OK && memcmp(&was, &is, sizeof is) != 0)
            broken("refused, and changed", command, status);
        if (command >= 6 && status != THING_OK && !(is.t >= was.t || is.t != is.t))
            broken("went back in time", command, status);
        if (status == THING_OK && !(isfinite(is.t) && all_finite(N, is.x)))
            broken("done, with numbers that are not finite", command, status);
        look();
        if (command == 0 && status != THING_OK)
            thing_pieces_init(&s, 1e-6);
        if (command == 0)
            thing_pieces_set_most(&s, most);
    }
    fclose(from);
    for (int k = 0; k < 8; k++)
        printf("%ld/%ld ", ok[k], ok[k] + refused[k]);
    printf("slowest call %.3f s\n", slowest);
    return 0;
}
"""


def build(model: Any, folder: Path) -> tuple[Path, tuple[int, int, int]]:
    """The harness around the library of a model, and how many states, parameters and inputs that has."""
    codegen.write(model, folder, name="thing", event_driven=True, step=model.step or 1e-3 * model.t_end)
    header = (folder / "thing_pieces.h").read_text()
    inputs = model.u.numel() if "thing_pieces_set_inputs" in header else 0
    own = _constant(header, "NP") - inputs if "thing_pieces_set_parameters" in header else 0
    (folder / "use.c").write_text(HARNESS)
    program = folder / "use"
    sizes = (f"-DNU={inputs}", f"-DNOWN={own}")
    sources = [str(folder / file) for file in ("use.c", "thing_pieces.c")]
    flags = [*STRICT, "-Wno-unused-function", *SANITIZE, *sizes]  # Some functions here are for some sizes alone.
    subprocess.run([str(COMPILER), *flags, "-o", str(program), *sources, "-lm"], check=True)
    return program, (_constant(header, "N"), own, inputs)


def _constant(header: str, name: str) -> int:
    start = header.index(f"#define THING_PIECES_{name} ") + len(f"#define THING_PIECES_{name} ")
    return int(header[start:].split()[0])


def commands(model: Any, sizes: tuple[int, int, int], rng: np.random.Generator, count: int) -> np.ndarray:
    """Random commands (count, numbers): plausible numbers mostly, of all sizes now and then, and what is not a number."""
    n, own, inputs = sizes
    rows = np.zeros((count, 1 + TIMES + n + own + inputs + 1))
    values = np.resize([v for v in model.parameters.values() if v is not None] or [1.0], own)
    t, end = 0.0, float(model.t_end)
    kinds = [INIT, SET_STATE, SET_PARAMETERS, RESET, SET_INPUTS, SET_MOST, *[ADVANCE] * 6, *[THROUGH] * 2]
    for row in rows:
        row[0] = kind = rng.choice(kinds)
        wild = rng.random() < 0.3
        row[4:] = rng.normal(size=row.size - 4) * 10 ** rng.uniform(-2, 1)
        row[4 + n : 4 + n + own] = values * (1 + 0.2 * rng.normal(size=own))
        if wild:
            hit = rng.random(row.size - 4) < 0.4
            row[4:][hit] = _hostile(rng, int(hit.sum()))
        if kind == INIT:
            row[1] = rng.choice([1e-3, 1e-6, 1e-10, 1e-14, 0.0, 2.0, np.nan]) if wild else 1e-6
            t = 0.0
        elif kind == SET_STATE:
            row[1] = t = float(_hostile(rng, 1)[0]) if wild else rng.uniform(0, end)
        elif kind == SET_MOST:
            row[1] = rng.uniform(1, 40)
        else:
            ahead = end * rng.uniform(0, 0.1, TIMES) if not wild else np.abs(_hostile(rng, TIMES))
            with np.errstate(over="ignore", invalid="ignore"):
                row[1 : 1 + TIMES] = t + np.cumsum(ahead)
            t = row[1] if kind == ADVANCE else row[3]
        t = t if np.isfinite(t) else 0.0
    return rows


def _hostile(rng: np.random.Generator, count: int) -> np.ndarray:
    special = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e-308, 1e308, -1e300, 1e18, -1e18, 1e16, 1.0, -1.0])
    sizes = rng.choice([-1.0, 1.0], count) * 10 ** rng.uniform(-300, 300, count)
    return np.where(rng.random(count) < 0.5, rng.choice(special, count), sizes)


def run(program: Path, rows: np.ndarray, folder: Path) -> str:
    """What the harness says in the end; AssertionError with what it found, or that it hangs."""
    given = folder / "commands"
    rows.tofile(given)
    try:
        done = subprocess.run([str(program), str(given)], capture_output=True, text=True, timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise AssertionError(f"no end within {SECONDS} s") from None
    assert done.returncode == 0, done.stdout + done.stderr[:2000]
    return done.stdout
