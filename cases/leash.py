"""A stone on a leash is dragged by a hand that goes right, up, back down and left.

    q' in -N_C(t)(q),    C(t) the disc of radius 1 about the hand

What to see: while the leash is taut the stone is drawn towards the hand, on a tractrix; while it is slack the stone
rests. When the hand comes back down it waits from 5 s to 6.92 s, until the leash is taut on the other side.

A wrong answer: a rod in place of the leash, |q - hand| = 1 at all times, pushes the stone ahead where it should wait.
Steps that put the stone on the circle instead of into the disc do that too.

Source: Perrault's problem, a watch that is drawn over a table by its chain; as the play in a disc in Krejci, Hysteresis,
convexity and dissipation in hyperbolic equations (1996); closed form.

Topic: mathematics.
"""

import casadi as ca
import numpy as np

from nsmodel import MonotoneInclusion, table

r, start = 1.0, np.array([-0.3, 0.6])  # m
corners = np.array([(0, 0), (3, 0), (3, 2), (3, -1), (0, -1)], float)  # of the hand's way, at 1 m/s
times = np.concatenate([[0], np.cumsum(np.abs(np.diff(corners, axis=0)).sum(axis=1))])


def dragged(q, hand, ahead, s):
    """Return the stone (..., 2), at q when the hand left ``hand``, once the hand has gone s (...) in the direction ``ahead``."""
    aside = np.array([-ahead[1], ahead[0]])
    along, across = (q - hand) @ ahead, (q - hand) @ aside
    slack = max(along + np.sqrt(max(r**2 - across**2, 0)), 0)
    half = np.tan(np.arcsin(np.clip(across / r, -1, 1)) / 2) * np.exp(-np.maximum(s - slack, 0) / r)
    angle = 2 * np.arctan(half)[..., None]
    taut = hand + s[..., None] * ahead + r * (np.sin(angle) * aside - np.cos(angle) * ahead)
    return np.where(s[..., None] <= slack, q, taut)


def exact(t):
    """Return the position (N, 2): rest, then a tractrix, on each straight part of the hand's way."""
    rows, q, t = np.empty((np.size(t), 2)), start, np.asarray(t, float)
    for begin, end, hand, goal in zip(times[:-1], times[1:], corners[:-1], corners[1:], strict=True):
        ahead, now = (goal - hand) / (end - begin), t >= begin
        rows[now] = dragged(q, hand, ahead, t[now] - begin)
        q = dragged(q, hand, ahead, np.array(end - begin))
    return rows


q, hand = ca.SX.sym("q", 2), ca.SX.sym("hand", 2)
model = MonotoneInclusion(
    x=q,
    field=[0, 0],
    constraints={"leash": r**2 - ca.sumsqr(q - hand)},
    x0=start,
    inputs={hand: table(times, corners, "linear")},
    outputs={"length": ca.norm_2(q - hand)},
    t_end=times[-1],
    step=1e-2,
    units={"t": "s", "length": "m", **{f"{name}_{i}": "m" for name in ("q", "hand") for i in range(2)}},
    exact=exact,
    title="A stone on a leash",
)
