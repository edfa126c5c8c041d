"""Four groups cross a street corner at the same green light, each straight on.

The streets are 4 m wide, the corner 4 m by 4 m. Everyone walks at 1.3 m/s and wavers: every half second the direction wanted is
turned by an angle of at most 0.6 rad.

What to see: all 48 meet on the corner and stop each other; one after the other gets free at the edge of the clump. All get to
the other side, the last after 16 s.

A wrong answer: all are out after 11 s, as if nobody were in anybody's way; or someone comes out of another street than the one
wanted.

Source: the Shibuya crossing of cromosim, smaller; the model of Maury and Venel, A discrete contact model for crowd motion
(2011).
"""

from nsmodel import ManyBodies
from nsmodel.crowd import Noise, Room, box, crowd, place

arm, street = 5.0, 4.0  # m
a, b, c = arm, arm + street, 2 * arm + street
room = Room(
    walls=[
        [(0, a), (a, a)], [(a, a), (a, 0)], [(b, 0), (b, a)], [(b, a), (c, a)],
        [(c, b), (b, b)], [(b, b), (b, c)], [(a, c), (a, b)], [(a, b), (0, b)],
    ],
    exits={"west": [(0, a), (0, b)], "south": [(a, 0), (b, 0)], "east": [(c, a), (c, b)], "north": [(a, c), (b, c)]},
)  # fmt: skip
starts = {
    "east": box((1, a), (a, b)), "west": box((b, a), (c - 1, b)), "north": box((a, 1), (b, a)), "south": box((a, b), (b, c - 1)),
}  # fmt: skip


def model(n: int = 12, seed: int = 1, angle: float = 0.6) -> ManyBodies:
    """Return the crossing with ``n`` people in each arm, who waver by ``angle``, rad."""
    groups = [place(room, n, seed=seed + k, inside=start, to=to, speed=1.3) for k, (to, start) in enumerate(starts.items())]
    return crowd(room, *groups, t_end=30, step=0.05, noise=Noise(angle, seed=seed), title=f"{4 * n} people on a crossing")
