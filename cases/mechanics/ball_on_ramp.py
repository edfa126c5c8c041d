"""A ball that rolls down a ramp, off its edge, and along the floor.

    a disc outside of the segment from (-1, 0.5) to (0, 0), and above the floor y = -0.2

What to see: on the ramp it rolls with a = (2/3) g sin phi; it leaves at the edge, around which the gap is that to a point, lands
0.2 m below and rolls on. Try friction: at 0.05 it slides on the ramp, as (1/3) tan phi = 0.167 is needed to roll.

A wrong answer: a ball that catches on the edge, or falls through it between two steps.

Source: elementary.
"""

import casadi as ca
import numpy as np

from nsmodel import MechanicalSystem
from nsmodel.mechanics import disc, gravity, segment

R = 0.05
along = np.array([1, -0.5]) / np.hypot(1, 0.5)
start = np.array([-0.9, 0.45]) + R * np.array([-along[1], along[0]])
q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
friction = ca.SX.sym("friction")

model = MechanicalSystem(
    q=q,
    v=v,
    M=[1, 1, R**2 / 2],
    F=gravity([(1, R**2 / 2)]),
    contacts={
        "ramp": segment(q, v, R, (-1, 0.5), (0, 0), mu=friction),
        "floor": disc(q, v, R, ((0, -0.2), (0, 1)), mu=friction),
    },
    q0=[*start, 0],
    t_end=1.2,
    step=2e-3,
    parameters={friction: 0.4},
    names=["px", "py", "angle", "vx", "vy", "spin"],
    units={"t": "s", "px": "m", "py": "m", "vx": "m/s", "vy": "m/s", "spin": "rad/s"},
    title="A ball on a ramp",
)
