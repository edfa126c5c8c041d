"""A mass with dry friction on a drive cycle: the force is a polyline, read from a table.

    m v' = u(t) - F Sgn(v),    s' = v

What to see: the mass starts when |u| exceeds F, coasts, reverses and sticks. Between switches v is a parabola; it stops
at t = 6.31 s (and turns), 9.29 s and 15.33 s, and starts at 0.67, 10.5 and 16.45 s.

A wrong answer: a mass that moves before 0.67 s or between 9.29 s and 10.5 s, where |u| < F: friction that is smoothed
lets it creep. Where a stop is stepped over friction has the wrong sign, and s at the end is not 8.4467 m.

Source: exact, quadratic pieces of v.
"""

import casadi as ca

from nsmodel import LureSystem, relay, table

m, F = 1.2, 1.0  # kg, N
times = [0, 2, 4, 5, 7, 8, 10, 11, 13, 14, 16, 17, 20]
forces = [0, 3, 3, -2.5, -2.5, 0, 0, -2, -2, 0.5, 0.5, 1.6, 1.6]
u = ca.SX.sym("u")

model = LureSystem(
    A=[[0, 0], [1, 0]],
    B=[1 / m, 0],
    C=[1, 0],
    f=[u / m, 0],
    law={"friction": relay(1, -F, F)},
    x0=[0, 0],
    inputs={u: table(times, forces, "linear")},
    t_end=20,
    step=0.01,
    theta=0.5,
    names=["v", "s"],
    units={"t": "s", "v": "m/s", "s": "m", "friction": "N", "u": "N"},
    title="Drive cycle with dry friction",
)
