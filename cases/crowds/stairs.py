"""Two floors, drawn side by side, and the stairs between them, on which everybody walks at half speed.

The floors are 8 m wide, the stairs 4 m long and 1.6 m wide. Everyone walks at 1.2 m/s the shortest way to the street, and at
0.6 m/s on the stairs.

What to see: people queue before the stairs. Who is pushed from behind is down sooner than the 6.7 s that the stairs take alone.
Downstairs everyone walks freely, twice as far from the next one as before: as many a second leave the stairs, at twice the
speed.

A wrong answer: everybody takes 6.7 s for the stairs: the push of the queue ends at the first step. Or all are out after 15 s, as
if the stairs were level; it takes 21 s.

Source: the stairs of cromosim, both floors in one plane; the model of Maury and Venel, A discrete contact model for crowd
motion (2011).
"""

from dataclasses import dataclass, replace

import numpy as np

from nsmodel import ManyBodies
from nsmodel.crowd import DesiredVelocity, Room, box, crowd, place

top, foot, end = 7.0, 11.0, 17.0  # m: where the stairs begin and end, and the way out
low, high, floor = 3.2, 4.8, 8.0  # m: the sides of the stairs, and of the floors
room = Room(
    walls=[
        [(top, low), (top, 0)], [(top, 0), (0, 0)], [(0, 0), (0, floor)], [(0, floor), (top, floor)], [(top, floor), (top, high)],
        [(top, low), (foot, low)], [(top, high), (foot, high)],
        [(foot, low), (foot, 0)], [(foot, 0), (end, 0)], [(end, floor), (foot, floor)], [(foot, floor), (foot, high)],
    ],
    exits={"street": [(end, 0), (end, floor)]},
)  # fmt: skip


@dataclass(frozen=True)
class OnFoot:
    """The velocity wanted on the level, and ``pace`` times that on the stairs."""

    level: DesiredVelocity
    pace: float
    autonomous = True

    def __call__(self, t: float, q: np.ndarray) -> np.ndarray:
        """Return the velocity (N, 2) of people at q (N, 2)."""
        on_stairs = (q[:, 0] > top) & (q[:, 0] < foot)
        return self.level(t, q) * np.where(on_stairs, self.pace, 1.0)[:, None]


def model(n: int = 40, seed: int = 1, pace: float = 0.5) -> ManyBodies:
    """Return the floors with ``n`` people upstairs, who walk at ``pace`` times their speed on the stairs."""
    people = place(room, n, seed=seed, inside=box((0, 0), (top, floor)), speed=1.2)
    level = crowd(room, people, t_end=40, step=0.05, title=f"{n} people take the stairs")
    return replace(level, f=OnFoot(level.f, pace))
