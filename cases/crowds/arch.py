"""Thirty people, a door of 1 m and a pillar 1 m in front of it: an arch forms that holds for ever.

The room is 6 m by 6 m, the pillar has a radius of 0.3 m. Everyone wants to walk to the door at 1 m/s.

What to see: eight get out. From 6 s on 22 people stand still, behind arches from the jambs to the pillar: what all want is
balanced by what all push, and the run ends, for nothing will ever change. With --set angle=1 all waver, and get out.

A wrong answer: the room empties. So it does for discs that may overlap a little: were the 22 to shrink by 2 cm once the arch
stands, all would be out within 6 s.

Source: the room with a pillar of cromosim; the model of Maury and Venel, A discrete contact model for crowd motion (2011).
"""

from nsmodel import ManyBodies
from nsmodel.crowd import Noise, Room, crowd, disc, place

side, door = 6.0, 1.0
low, high = (side - door) / 2, (side + door) / 2
room = Room(
    walls=[
        [(0, 0), (side, 0)],
        [(side, 0), (side, low)],
        [(side, high), (side, side)],
        [(side, side), (0, side)],
        [(0, side), (0, 0)],
    ],
    exits={"door": [(side, low), (side, high)]},
    obstacles=[disc((side - 1, side / 2), 0.3)],
)


def model(n: int = 30, seed: int = 7, angle: float = 0.0) -> ManyBodies:
    """Return the room with ``n`` people, who waver by ``angle``, rad."""
    noise = Noise(angle, seed=seed) if angle else None
    return crowd(
        room,
        place(room, n, seed=seed),
        t_end=40,
        step=0.05,
        noise=noise,
        title=f"{n} people and a pillar before the door",
    )
