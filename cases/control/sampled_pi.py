"""Speed control of a mass with dry friction: a PI controller that reads the speed every 50 ms.

    m v' = w - b v - F Sgn(v),    w = kp (r - v) + z,    z + ki Ts (r - v) follows z

What to see: the speed follows r = 1, then 0, then -0.5. At r = 0 the mass sticks, v = 0 exactly, and the controller is
content; at the next change it must first work its way through the friction.

A wrong answer: a speed that hunts about 0 between 4.5 s and 6 s instead of being 0; an overshoot other than 1.031; a
controller that is computed in every step of the solver, not every 50 ms.

Source: exact by a recursion, in which the mass stops within a sample at most once.
"""

import casadi as ca

from nsmodel import LureSystem, relay, sampled, table

m, b, F, kp, ki, Ts = 1.0, 0.5, 1.0, 4.0, 6.0, 0.05  # kg, N s/m, N, N s/m, N/m, s
v, w, z, r = (ca.SX.sym(name) for name in "vwzr")
e = r - v

model = LureSystem(
    x=v,
    A=[[-b / m]],
    B=[1 / m],
    C=[1],
    f=[w / m],
    law={"friction": relay(1, -F, F)},
    x0=[0],
    inputs={r: table([0, 4, 6], [1, 0, -0.5])},
    blocks=[sampled("PI", period=Ts, memory={z: 0}, outputs={w: kp * e + z}, update={z: z + ki * Ts * e})],
    t_end=10,
    step=Ts / 10,
    theta=0.5,
    units={"t": "s", "v": "m/s", "friction": "N", "r": "m/s"},
    title="Sampled PI and dry friction",
)
