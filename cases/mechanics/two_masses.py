"""Two masses on a rough floor, tied by a spring; the first is shaken by a periodic force.

    m1 x1'' in k (x2 - x1) + 2 sin t - mu1 Sgn(x1'),    m2 x2'' in -k (x2 - x1) - mu2 Sgn(x2')

What to see: stick and slip of each mass, together and apart. P = diag(p1, m1/mu1, p3, m2/mu2) solves P B = C'. Try
other masses and friction forces: every symbol below is a parameter of the command line.

A wrong answer: speeds that jump to and fro about 0 where a mass sticks: both are 0 from 9.42 s to the end, exactly.
Forces taken for coefficients of friction: mu is in newton.

Source: Brogliato and Goeleven, Existence, uniqueness of solutions and stability of nonsmooth multivalued Lur'e
dynamical systems (2013), Example 6.2; here mu is the friction force in newton (the paper's m g mu).
"""

import casadi as ca

from nsmodel import LureSystem, relay

t = ca.SX.sym("t")
m1, m2, mu1, mu2, k = (ca.SX.sym(name) for name in ("m1", "m2", "mu1", "mu2", "k"))

model = LureSystem(
    t=t,
    A=[[0, 1, 0, 0], [-k / m1, 0, k / m1, 0], [0, 0, 0, 1], [k / m2, 0, -k / m2, 0]],
    B=[[0, 0], [mu1 / m1, 0], [0, 0], [0, mu2 / m2]],
    C=[[0, 1, 0, 0], [0, 0, 0, 1]],
    f=[0, 2 * ca.sin(t) / m1, 0, 0],
    law=relay(2),
    x0=[1, 0, -1, 0],
    t_end=10,
    step=1e-3,
    theta=0.5,
    parameters={m1: 1, m2: 1, mu1: 1, mu2: 1, k: 10},  # kg, kg, N, N, N/m
    names=["x1", "v1", "x2", "v2"],
    units={"t": "s", "x1": "m", "v1": "m/s", "x2": "m", "v2": "m/s"},
    title="Two masses with Coulomb friction",
)
