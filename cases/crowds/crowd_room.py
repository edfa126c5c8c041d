"""People leave a square room through one door; each is a disc that cannot overlap others or the walls.

Everyone wants to walk to the door at 1 m/s; the velocity that is closest to this and admissible is what happens.

What to see: people close up in front of the door and push each other and the posts; the reactions are the pressure.
Nobody overlaps. The run ends before the first person is half a metre outside.

A wrong answer: after 0.7 s eleven pairs overlap, by up to 0.16 m, as if nobody were in anybody's way; or a reaction is
negative: people push, they never pull.

Source: the model of Maury and Venel, stepped as in Bernicot and Venel, Convergence order of a numerical scheme for
sweeping process (2010).
"""

import casadi as ca
import numpy as np

from nsmodel import SweepingProcess

pitch, door = 0.6, 1.2  # m


def model(n: int = 30, seed: int = 1) -> SweepingProcess:
    """Return the room with ``n`` people, placed in columns from the door's wall inwards, with random radii."""
    rows = int(np.ceil(np.sqrt(n)))
    L = max(pitch * rows, 2.4)
    rng = np.random.default_rng(seed)
    jitter = rng.uniform(-1, 1, (n, 2)) * (pitch - 0.5) / 2
    radii = rng.uniform(0.20, 0.25, n)
    k = np.arange(n)
    places = np.column_stack([L - pitch * (k // rows + 0.5), (L - pitch * rows) / 2 + pitch * (k % rows + 0.5)])
    low, high = (L - door) / 2, (L + door) / 2
    walls = [[(0, 0), (0, L)], [(0, 0), (L, 0)], [(0, L), (L, L)], [(L, 0), (L, low)], [(L, high), (L, L)]]

    q = ca.SX.sym("q", 2 * n)
    people = ca.vertsplit(q, 2)
    pairs = {f"pair {i}-{j}": ca.norm_2(people[i] - people[j]) - radii[i] - radii[j] for i in range(n) for j in range(i + 1, n)}
    contacts = {
        f"person {i} wall {w}": distance(person, *wall) - radii[i]
        for i, person in enumerate(people)
        for w, wall in enumerate(walls)
    }
    return SweepingProcess(
        q=q,
        f=ca.vertcat(*(desire(person, L, low + 0.25, high - 0.25) for person in people)),
        constraints=pairs | contacts,
        q0=(places + jitter).ravel(),
        t_end=0.7,
        step=0.02,
        units={"t": "s", **{f"q_{i}": "m" for i in range(2 * n)}},
        scene={"radii": radii, "walls": walls},
        title=f"{n} people leave a room",
    )


def desire(person, L, low, high):
    """Return the velocity (2,) towards the door, and straight on once outside."""
    target = ca.vertcat(L + 0.3, ca.fmin(ca.fmax(person[1], low), high))
    return ca.if_else(person[0] < L, (target - person) / ca.norm_2(target - person), ca.vertcat(1, 0))


def distance(person, start, end):
    """Return the distance to a wall along an axis, from ``start`` to ``end``."""
    return ca.norm_2(person - ca.fmin(ca.fmax(person, ca.DM(start)), ca.DM(end)))
