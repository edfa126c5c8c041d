"""A whole step of cromosim in a square room with one door: desired velocity, contacts, projection with cvxopt.

CPU time of each part, the median over repeats, on people who stand where a file says; building the domain is not timed.

    in_cromosim.py FILE...    npz with q (N, 2), r (N,), side, door, cutoff, step: a line each, JSON: N; velocity, contacts,
                              projection (ms); overlap (m) after the step
"""

import json
import os
import sys
import tempfile
import time

import numpy as np
from cromosim.domain import Destination, Domain
from cromosim.micro import compute_contacts, projection
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from scipy.spatial import cKDTree

REPEATS = 5
PIXEL, MARGIN, WALL = 0.05, 1.0, 0.2  # m


def room(side, door):
    """The square room as cromosim's domain: walls on the outside, the destination a line behind the door."""
    size = round((side + 2 * MARGIN) / PIXEL)
    domain = Domain(name="room", pixel_size=PIXEL, width=size, height=size)
    jamb = (side - door) / 2
    for x, y, width, height in (
        (-WALL, -WALL, WALL, side + 2 * WALL), (-WALL, -WALL, side + 2 * WALL, WALL), (-WALL, side, side + 2 * WALL, WALL),
        (side, -WALL, WALL, jamb + WALL), (side, side - jamb, WALL, jamb + WALL),
    ):  # fmt: skip
        wall = Rectangle((x + MARGIN, y + MARGIN), width, height)
        domain.add_shape(wall, outline_color=[0, 0, 0], fill_color=[0, 0, 0])
    behind = Line2D([side + 0.6 + MARGIN] * 2, [side / 2 - 0.5 + MARGIN, side / 2 + 0.5 + MARGIN], linewidth=2)
    domain.add_shape(behind, outline_color=[255, 0, 0], fill_color=[255, 0, 0])
    domain.build_domain()
    domain.add_destination(Destination(name="door", colors=[[255, 0, 0]], excluded_colors=[[0, 0, 0]]))
    return domain


def overlap(q, r):
    """The largest overlap of two discs."""
    pairs = cKDTree(q).query_pairs(2 * r.max(), output_type="ndarray")
    gaps = np.linalg.norm(q[pairs[:, 0]] - q[pairs[:, 1]], axis=1) - r[pairs].sum(axis=1)
    return float(max(0.0, -gaps.min(initial=0.0)))


def main(path):
    """Time the steps from the state in a file."""
    scene = np.load(path)
    side, step = float(scene["side"]), float(scene["step"])
    domain = room(side, float(scene["door"]))
    inside = scene["q"][:, 0] < side - 0.1
    q, r = scene["q"][inside], scene["r"][inside]
    people = np.column_stack([q + MARGIN, r, np.ones(len(r))])
    times = []
    for _ in range(REPEATS):
        clock = [time.process_time()]
        _, _, wish = domain.people_desired_velocity(people, ["door"] * len(people))
        clock.append(time.process_time())
        contacts = compute_contacts(domain, people, float(scene["cutoff"]))
        clock.append(time.process_time())
        _, _, velocity, _, _ = projection(step, people, contacts, wish)
        clock.append(time.process_time())
        times.append(np.diff(clock))
    after = q + step * np.asarray(velocity).reshape(-1, 2)
    parts = dict(zip(("velocity", "contacts", "projection"), 1e3 * np.median(times, axis=0), strict=True))
    print(json.dumps({"N": len(scene["r"]), **parts, "overlap": overlap(after, r)}))


if __name__ == "__main__":
    os.chdir(tempfile.mkdtemp())
    for given in sys.argv[1:]:
        main(given)
