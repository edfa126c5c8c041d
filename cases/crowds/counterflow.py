"""Two groups meet in a corridor: those from the west go east, those from the east go west.

The corridor is 16 m long and 3.2 m wide and open at both ends. Everyone walks at 1.2 m/s and wavers: every half second the
direction wanted is turned by an angle of at most 0.6 rad. Nobody overlaps anybody or a wall.

What to see: the groups meet after 3 s and stop each other; after 5 s people get on at 0.4 m/s. Then files of one direction slip
past each other, and the last one is out after 21 s.

A wrong answer: all are out after 14 s, as if nobody were in anybody's way; or one group pushes the other back. What two people
do to each other is equal and opposite, and walls push across: the sum of all velocities along the corridor is that of the
wishes.

Source: counter-flow as in the rooms of cromosim; the model of Maury and Venel, A discrete contact model for crowd motion
(2011).
"""

from nsmodel import ManyBodies
from nsmodel.crowd import Noise, Room, box, crowd, place

length, width = 16.0, 3.2  # m
room = Room(
    walls=[[(0, 0), (length, 0)], [(0, width), (length, width)]],
    exits={"west": [(0, 0), (0, width)], "east": [(length, 0), (length, width)]},
)


def model(n: int = 20, seed: int = 1, angle: float = 0.6) -> ManyBodies:
    """Return the corridor with ``n`` people on each side, who waver by ``angle``, rad."""
    from_west = place(room, n, seed=seed, inside=box((0, 0), (5, width)), to="east", speed=1.2)
    from_east = place(room, n, seed=seed + 1, inside=box((length - 5, 0), (length, width)), to="west", speed=1.2)
    return crowd(
        room,
        from_west,
        from_east,
        t_end=30,
        step=0.05,
        noise=Noise(angle, seed=seed),
        title=f"{2 * n} people meet in a corridor",
    )
