"""Twelve runners on the inner edge of a track, one behind the other: who is faster pushes who is in front.

Each wants to run at his own speed, 2.5 to 4 m/s, along the track and a little to the inside, where the field is in the way.

What to see: trains form. A train runs at the mean speed of its runners, times cos of the lean, for who is pushed is faster than
he wants, and who pushes is slower. The track is all that bends: along it, places are to a centimetre the isotonic regression of
where all would be alone, a diameter apart.

A wrong answer: a train at the speed of its slowest, as cars would drive; or a runner who passes another. Without the
others each would be up to 13 m from where he is here after 24 s.

Source: the stadium of cromosim, in single file; sticky particles as in Natile and Savare, A Wasserstein approach to the
one-dimensional sticky particle system (2009).
"""

import casadi as ca
import numpy as np

from nsmodel import Bodies, Family, ManyBodies

straight, inner, r = 16.0, 6.0, 0.3  # m: the straights, the radius of the bends, that of a runner
lean = 0.2  # rad


def oval(radius: float, pieces: int = 24) -> np.ndarray:
    """Return the line around the field at ``radius`` from its middle line, as segments (2 pieces + 2, 2, 2)."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, pieces + 1)
    bend = np.column_stack([straight / 2 + radius * np.cos(angle), radius * np.sin(angle)])
    corners = np.concatenate([bend, -bend])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def model(n: int = 12, seed: int = 2) -> ManyBodies:
    """Return the track with ``n`` runners, a metre apart at the start."""
    places = np.column_stack([6.0 - np.arange(n), np.full(n, -inner - r - 0.01)])
    runners = Bodies(places, speed=np.random.default_rng(seed).uniform(2.5, 4.0, n))
    i, j = runners.member("i"), runners.member("j")
    away = i.q - ca.vertcat(ca.fmin(ca.fmax(i.q[0], -straight / 2), straight / 2), 0)
    distance = ca.norm_2(away)
    out = away / distance
    return ManyBodies(
        bodies=runners,
        f=i.speed * (np.cos(lean) * ca.vertcat(-out[1], out[0]) - np.sin(lean) * out),
        constraints={"pair": Family(ca.norm_2(i.q - j.q) - 2 * r, i, j), "field": Family(distance - inner - r, i)},
        t_end=24,
        step=0.05,
        units={"t": "s", "q": "m"},
        scene={"radii": np.full(n, r), "walls": oval(inner)},
        title=f"{n} runners on a track",
    )
