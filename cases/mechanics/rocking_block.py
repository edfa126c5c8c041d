"""A block that rocks from corner to corner, as Housner's.

    two corners (+-b, -a) of a block of half width b = 0.1 and half height a = 0.4, mu = 5: they do not slip

What to see: started at half the angle alpha = atan(b/a) at which it would fall, it lands on the other corner at 0.3123 s; of its
speed 1 - (3/2) sin^2 alpha = 0.9118 is left: angular momentum about the new corner is kept, of which nothing was said; the old
corner opens by itself. Try friction: below 0.3 the corners slip.

A wrong answer: a block that bounces with both corners in the air, or keeps its speed.

Source: Housner, The behavior of inverted pendulum structures during earthquakes (1963).
"""

import casadi as ca
import numpy as np

from nsmodel import MechanicalSystem
from nsmodel.mechanics import corner, gravity

a, b = 0.4, 0.1
inertia = (a**2 + b**2) / 3
tilt = np.arctan(b / a) / 2
q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
friction = ca.SX.sym("friction")

model = MechanicalSystem(
    q=q,
    v=v,
    M=[1, 1, inertia],
    F=gravity([(1, inertia)]),
    contacts={"left": corner(q, v, (-b, -a), mu=friction), "right": corner(q, v, (b, -a), mu=friction)},
    q0=[0, b * np.sin(tilt) + a * np.cos(tilt), tilt],
    t_end=1,
    step=1e-3,
    parameters={friction: 5},
    names=["px", "py", "tilt", "vx", "vy", "rate"],
    units={"t": "s", "px": "m", "py": "m", "tilt": "rad", "vx": "m/s", "vy": "m/s", "rate": "rad/s"},
    title="A rocking block",
)
