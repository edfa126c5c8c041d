"""A ball that falls on a floor and bounces: infinitely many impacts in finite time.

    m v' = -m g between impacts,    v+ = -e v- where it lands

What to see: after t0 (1 + e)/(1 - e) = 1.3546 s, t0 = sqrt(2 H/g), it is at rest: v is 0.0 from the first rows after that time
on. With e = 1 the energy is m g H for ever, to rounding. Try restitution and the step: the path is of order 1 in it, as each
impact is found up to a step early.

A wrong answer: a ball that trembles on the floor, that sinks into it, or whose last bounces grow.

Source: Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988); the times are elementary.
"""

import casadi as ca

from nsmodel import MechanicalSystem
from nsmodel.mechanics import gravity, point

q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
restitution = ca.SX.sym("restitution")

model = MechanicalSystem(
    q=q,
    v=v,
    M=1,
    F=gravity([1]),
    contacts={"floor": point(q, v, e=restitution)},
    q0=[0, 1],
    v0=[0.5, 0],
    t_end=2,
    step=2e-3,
    parameters={restitution: 0.5},
    names=["px", "height", "vx", "speed"],
    units={"t": "s", "px": "m", "height": "m", "vx": "m/s", "speed": "m/s"},
    title="A bouncing ball",
)
