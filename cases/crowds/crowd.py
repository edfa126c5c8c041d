"""Many people leave a square room through one door: two constraints, written once, for all pairs and all walls.

Everyone wants to walk to the door at 1 m/s; the velocity that is closest to this and admissible is what happens. Who is half a
metre outside is gone.

What to see: people close up in front of the door, the pressure grows from the back to the front, one after the other gets
through. Nobody overlaps. Only pairs that can meet in a step are looked at, so thousands of people can be run.

A wrong answer: discs that overlap. As if nobody were in anybody's way 56 people would be gone after 4 s; 18 are. Speeds of more
than 1 m/s at the door are right: people are pushed through it.

Source: the model of Maury and Venel, stepped as in Bernicot and Venel, Convergence order of a numerical scheme for
sweeping process (2010).
"""

import casadi as ca
import numpy as np

from nsmodel import Bodies, Family, Items, ManyBodies

pitch, door = 0.6, 1.2  # m


def model(n: int = 100, seed: int = 1) -> ManyBodies:
    """Return the room with ``n`` people, placed in columns from the door's wall inwards, with random radii."""
    rows = int(np.ceil(np.sqrt(n)))
    L = max(pitch * rows, 2.4)
    rng = np.random.default_rng(seed)
    jitter = rng.uniform(-1, 1, (n, 2)) * (pitch - 0.5) / 2
    radii = rng.uniform(0.20, 0.25, n)
    k = np.arange(n)
    places = np.column_stack([L - pitch * (k // rows + 0.5), (L - pitch * rows) / 2 + pitch * (k % rows + 0.5)])
    low, high = (L - door) / 2, (L + door) / 2
    ends = np.array([[(0, 0), (0, L)], [(0, 0), (L, 0)], [(0, L), (L, L)], [(L, 0), (L, low)], [(L, high), (L, L)]])

    people, walls = Bodies(places + jitter, r=radii), Items(a=ends[:, 0], b=ends[:, 1])
    i, j, w = people.member("i"), people.member("j"), walls.member("w")
    target = ca.vertcat(L + 0.3, ca.fmin(ca.fmax(i.q[1], low + 0.25), high - 0.25))
    along = w.b - w.a
    part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
    return ManyBodies(
        bodies=people,
        f=ca.if_else(i.q[0] < L, (target - i.q) / ca.norm_2(target - i.q), ca.vertcat(1, 0)),
        constraints={
            "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
            "wall": Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w),
        },
        leave=i.q[0] - L - 0.5,
        t_end=4,
        step=0.02,
        units={"t": "s", "q": "m"},
        scene={"radii": radii, "walls": ends, "exits": [[(L, low), (L, high)]]},
        title=f"{n} people leave a room",
    )
