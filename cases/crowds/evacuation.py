"""A hundred and twenty people leave a floor with two exits, around a partition and a pillar.

Everyone walks at 1.2 m/s the shortest way to the nearer exit, and nobody overlaps anybody or a wall: the velocity that is
closest to the desired ones and admissible is what happens (Maury and Venel).

What to see: the floor parts along the line from which both exits are equally far. Arches form at both doors and carry the
pressure, which is largest at the jambs; the narrower door is not the slower one per metre of width. The pillar in front of the
east door shares the pressure of the arch.

A wrong answer: the floor is empty after 8.3 s, as if nobody were in anybody's way. The last one leaves after 13 s.

Source: the model of Maury and Venel, stepped as in Bernicot and Venel, Convergence order of a numerical scheme for
sweeping process (2010); shortest ways as in cromosim, on the polygon instead of on pixels.
"""

from nsmodel import ManyBodies
from nsmodel.crowd import Room, box, crowd, disc, place

room = Room(
    walls=[
        [(0, 0), (5, 0)], [(6.1, 0), (14, 0)], [(14, 0), (14, 4)], [(14, 5.3), (14, 9)], [(14, 9), (0, 9)], [(0, 9), (0, 0)],
        [(7, 9), (7, 4)],
    ],
    exits={"south": [(5, 0), (6.1, 0)], "east": [(14, 4), (14, 5.3)]},
    obstacles=[disc((12.4, 4.65), 0.3), box((2, 2.5), (3.4, 3.3))],
)  # fmt: skip


def model(n: int = 120, seed: int = 1) -> ManyBodies:
    """Return the floor with ``n`` people, scattered over it."""
    return crowd(room, place(room, n, seed=seed, speed=1.2), t_end=20, title=f"{n} people leave by two exits")
