"""After an event 30 people leave a square through the streets of a town, whose blocks stand askew, for the one way out.

The town is 20 m by 13 m. Everyone walks at 1.4 m/s the shortest way to the gate in the upper right corner.

What to see: the crowd parts, for each street is the shortest way for some. People close up at the corners of the blocks, where
all cut the same corner; the streams merge again at the gate, and the last one is out after 17 s.

A wrong answer: someone walks through a block. Who starts farthest has 23.3 m to go around the corners; as the crow flies it
would be 21.9 m.

Source: the event of cromosim, smaller; the model of Maury and Venel, A discrete contact model for crowd motion (2011).
"""

import numpy as np

from nsmodel import ManyBodies
from nsmodel.crowd import Room, box, crowd, place

width, height, gate = 20.0, 13.0, 2.0  # m; the gate is in the upper right corner
askew = np.deg2rad(-14)
turn = np.array([[np.cos(askew), np.sin(askew)], [-np.sin(askew), np.cos(askew)]])
columns = [(3.4, 3.0), (7.9, 4.4), (13.8, 2.6)]  # left, width
rows = [(3.5, 2.4), (7.3, 2.6), (11.4, 2.8)]  # bottom, height
blocks = [box((x, y), (x + w, y + h)) @ turn for x, w in columns for y, h in rows]
room = Room(
    walls=[
        [(0, 0), (width, 0)], [(width, 0), (width, height - gate)], [(width, height), (0, height)], [(0, height), (0, 0)],
    ],
    exits={"gate": [(width, height - gate), (width, height)]},
    obstacles=[block for block in blocks if (block > 0.7).all() and (block < (width - 0.7, height - 0.7)).all()],
)  # fmt: skip


def model(n: int = 30, seed: int = 1) -> ManyBodies:
    """Return the town with ``n`` people on its square."""
    people = place(room, n, inside=box((0, 1), (5, 11)), seed=seed, speed=1.4)
    return crowd(room, people, t_end=40, step=0.05, title=f"{n} people leave a town")
