"""A stone on a leash is dragged by a hand that walks to and fro on a line.

    q' in -N_C(t)(q),    C(t) the disc of radius 1 about (hand(t), 0)

What to see: while the leash is taut the stone is drawn towards the hand, on a tractrix; while it is slack the stone
rests. Each time the hand turns round it waits, from 1.5 s to 3.411 s and from 5 s to 6.996 s, until the leash is taut on
the other side.

A wrong answer: a rod in place of the leash, |q - (hand, 0)| = 1 at all times, pushes the stone ahead where it should
wait. Steps that put the stone on the circle instead of into the disc do that too.

Source: Perrault's problem, a watch that is drawn over a table by its chain; as the play in a disc in Krejci, Hysteresis,
convexity and dissipation in hyperbolic equations (1996); closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import MonotoneInclusion, table

r, start = 1.0, (-0.3, 0.8)  # m
turns = np.array([0, 1.5, -2, 1])  # m: where the hand turns round; it walks at 1 m/s
times = np.concatenate([[0], np.cumsum(abs(np.diff(turns)))])


def exact(t):
    """Return the position (N, 2): on each way of the hand rest, then a tractrix: tan(angle/2) falls like exp(-s/r)."""
    rows, q = np.empty((np.size(t), 2)), np.array(start)
    for begin, end, hand, goal in zip(times[:-1], times[1:], turns[:-1], turns[1:], strict=True):
        now, way, (x, y) = np.asarray(t) >= begin, np.sign(goal - hand), q
        s = np.append(np.asarray(t)[now], end) - begin
        taut = max(way * (x - hand) + np.sqrt(r**2 - y**2), 0)
        angle = 2 * np.arctan(np.tan(np.arcsin(y / r) / 2) * np.exp(-np.maximum(s - taut, 0) / r))
        drawn = np.column_stack([hand + way * (s - r * np.cos(angle)), r * np.sin(angle)])
        places = np.where(s[:, None] <= taut, q, drawn)
        rows[now], q = places[:-1], places[-1]
    return rows


q, hand = ca.SX.sym("q", 2), ca.SX.sym("hand")
model = MonotoneInclusion(
    x=q,
    field=[0, 0],
    constraints={"leash": r**2 - ca.sumsqr(q - ca.vertcat(hand, 0))},
    x0=start,
    inputs={hand: table(times, turns, "linear")},
    t_end=times[-1],
    step=1e-2,
    units={"t": "s", "q_0": "m", "q_1": "m", "hand": "m"},
    exact=exact,
    scheme="implicit",
    title="A stone on a leash",
)
