"""An elastoplastic bar: four springs with sliders, side by side, and a hysteresis that remembers where it turned.

    u' = rate(t),    s_i' in k_i rate(t) - N_[-r_i, r_i](s_i),    force = s_1 + ... + s_4

What to see: force over u has corners, where one slider after the other yields. The small loop, u from 1 to 0.2 and back,
is closed: the force is 5 N before and after it, and what follows does not know of it. The large one, between -2.5 and
2.5, is closed too, with the virgin curve twice as large in each half of it (Masing).

A wrong answer: sliders that creep or are smoothed leave the loops open: the force at u = 1 is not 5 N again. Without
memory, a function of u alone, there is no loop. A yield limit that is overshot shows as more than 6 N at u = 2.5.

Source: Iwan, On a class of models for the yielding behavior of continuous and composite systems (1967); closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import MonotoneInclusion, table

k, limits = np.array([4.0, 2.0, 2.0, 1.0]), np.array([1.0, 1.0, 2.0, 2.0])  # N/m, N
turns = np.array([0.0, 1.0, 0.2, 1.0, 2.5, -2.5, 2.5])  # m: where u turns; its speed is 1 m/s
times = np.concatenate([[0], np.cumsum(abs(np.diff(turns)))])


def exact(t):
    """Return u and the forces of the springs (N, 5): each follows u from the last turn, within its limits."""
    rows, forces = np.empty((np.size(t), 5)), np.zeros(4)
    rows[:, 0] = np.interp(t, times, turns)
    for begin, end, u in zip(times[:-1], times[1:], turns, strict=False):
        now = np.asarray(t) >= begin
        rows[now, 1:] = np.clip(forces + k * (rows[now, :1] - u), -limits, limits)
        forces = np.clip(forces + k * (np.interp(end, times, turns) - u), -limits, limits)
    return rows


u, s, rate = ca.SX.sym("u"), ca.SX.sym("s", 4), ca.SX.sym("rate")
model = MonotoneInclusion(
    x=ca.vertcat(u, s),
    field=ca.vertcat(rate, k * rate),
    lower=[-3, *-limits],
    upper=[3, *limits],
    x0=np.zeros(5),
    inputs={rate: table(times[:-1], np.sign(np.diff(turns)))},
    outputs={"force": ca.sum1(s)},
    t_end=times[-1],
    step=1e-2,
    units={"t": "s", "u": "m", "rate": "m/s", "force": "N", **{f"s_{i}": "N" for i in range(4)}},
    exact=exact,
    scheme="implicit",
    title="Elastoplastic bar",
)
