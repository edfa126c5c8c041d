"""Scenes of ``cases/`` in heyoka (Taylor series, compiled just in time), run by a Python that has it.

heyoka knows no laws: the modes are written by hand, a parameter for each, and a terminal event whose callback sets the next.
CPU time of ``propagate_until``, one warm-up, the minimum over repeats; making the integrator (compilation) is not timed, nor is
the run by ``propagate_grid`` that gives the rows.

    in_heyoka.py SCENE    a line a run, JSON: method, label, seconds, t, x, message
"""

import json
import sys
import time

import heyoka as hy
import numpy as np

REPEATS, ENOUGH = 50, 0.3  # s
ROWS = 241
SHORT = 1e-12  # s: a cooldown below all times between two switches; its own guess grows with the tolerance and hides edges.
TOLERANCES = tuple(10.0**-k for k in range(2, 16))
x, v, i, a, b = hy.make_vars("x", "v", "i", "a", "b")
p = hy.par


def friction_oscillator():
    """x' = v, v' = -x - s, s the sign of v, or both at rest: parameters (moves, s)."""

    def turns(run, sign):
        if sign != run.pars[1]:  # The start is an event too; there it begins to move.
            run.state[1] = 0.0
            run.pars[:] = (0.0, 0.0) if abs(run.state[0]) <= 1 else (1.0, -run.pars[1])
        return True

    rates = [(x, p[0] * v), (v, p[0] * (-x - p[1]))]
    return rates, [5.3, 0.0], [1.0, -1.0], [hy.t_event(v, callback=turns)], 12.0, [0]


def sliding_relay():
    """x1' = x2, x2' = sin t - 2 s with the sign s of x1 + x2, or x2' = -x2: parameters (s, slides)."""

    def meets(run, sign):
        pull = run.state[1] + np.sin(run.time)
        if run.pars[1]:
            run.pars[:] = np.sign(pull), 0.0
        elif abs(pull) < 2:
            run.pars[1] = 1.0
        else:
            run.pars[0] = -run.pars[0]
        return True

    rates = [(a, b), (b, (1 - p[1]) * (hy.sin(hy.time) - 2 * p[0]) - p[1] * b)]
    meeting = (1 - p[1]) * (a + b) + p[1] * (4 - (b + hy.sin(hy.time)) ** 2)
    return rates, [1.0, 0.0], [1.0, 0.0], [hy.t_event(meeting, callback=meets)], 5.0, [0, 1]


def diode_bridge():
    """A pair of diodes conducts |v|/R until v = 0, then the other: parameter (sign of v)."""

    def changes(run, sign):
        run.pars[0] = -run.pars[0]
        return True

    L, C, R = 1e-2, 1e-6, 1e3
    rates = [(v, -(i + p[0] * (p[0] * v / R)) / C), (i, v / L)]
    return rates, [10.0, 0.0], [1.0], [hy.t_event(v, callback=changes)], 5e-3, [0, 1]


def point_past_disc():
    """q' = (1, 0) until |q| = 1, along the disc until q_0 = 0, and on: parameters, one of the three 1."""

    def next_mode(run, sign):
        run.pars[:] = (0.0, *run.pars[:-1])
        return True

    along = a / (a * a + b * b)
    rates = [(a, 1 - p[1] * along * a), (b, -p[1] * along * b)]
    ends = p[0] * (a * a + b * b - 1) + p[1] * a + p[2]
    return rates, [-1.5, 0.3], [1.0, 0.0, 0.0], [hy.t_event(ends, callback=next_mode)], 4.5, [0, 1]


def buck():
    """L i' = u V - v, C v' = i - v/R, and i = 0 while the diode blocks: parameters (u, conducts, next edge of u)."""
    V, L, C, R, T, D = 24.0, 100e-6, 47e-6, 5.0, 10e-6, 0.4

    def blocks(run, sign):
        if sign < 0:
            run.pars[1] = run.state[0] = 0.0
        return True

    def edge(run, sign):
        run.pars[:] = (0.0, 1.0, run.pars[2] + (1 - D) * T) if run.pars[0] else (1.0, 1.0, run.pars[2] + D * T)
        return True

    rates = [(i, p[1] * (p[0] * V - v) / L), (v, (i - v / R) / C)]
    off = p[1] * (1 - p[0])
    events = [
        hy.t_event(off * i + (1 - off), callback=blocks, cooldown=SHORT),
        hy.t_event(hy.time - p[2], callback=edge, cooldown=SHORT),
    ]
    return rates, [0.0, 0.0], [1.0, 1.0, D * T], events, 40 * T, [0, 1]


SCENES = {scene.__name__: scene for scene in (friction_oscillator, sliding_relay, diode_bridge, point_past_disc, buck)}


def measured(scene, tolerance):
    """Seconds, times, states."""
    rates, x0, pars, events, end, columns = scene
    run = hy.taylor_adaptive(rates, x0, tol=tolerance, pars=pars, t_events=events)
    seconds, spent, grid = [], 0.0, np.linspace(0, end, ROWS)

    def begin():
        run.time, run.state[:], run.pars[:] = 0.0, x0, pars
        run.reset_cooldowns()

    while len(seconds) < 2 or (len(seconds) <= REPEATS and spent < ENOUGH):
        begin()
        start = time.process_time()
        run.propagate_until(end)
        seconds.append(time.process_time() - start)
        spent += seconds[-1]
    begin()
    states = run.propagate_grid(grid)[-1]
    return min(seconds[1:]), grid.tolist(), states[:, columns].tolist()


def main(name):
    """Print a line a run."""
    for tolerance in TOLERANCES:
        line = {"method": "heyoka, events by hand", "label": f"tol = {tolerance:.0e}"}
        try:
            line["seconds"], line["t"], line["x"] = measured(SCENES[name](), tolerance)
        except Exception as error:
            line["message"] = f"{type(error).__name__}: {error}"
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
