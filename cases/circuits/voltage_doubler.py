"""Voltage doubler (Greinacher): two capacitors and two diodes make nearly 20 V of an alternating voltage of 10 V.

    C1 v1' = d2 - d1,    C2 v2' = d2 - v2/R,    a = Vm sin wt - v1 - Rs (d2 - d1)
    0 <= d1 ⟂ a >= 0,    0 <= d2 ⟂ v2 - a >= 0

a is the voltage of the node between the diodes, d1 their current from the ground, d2 that to the load.

What to see: in each negative half wave d1 charges the first capacitor, in each positive one d2 hands its charge on: v2 climbs
to 19.8 V, from the third period on in steps that halve. The diodes never conduct together.

A wrong answer: 20 V at the load, or 10 V. Each period carries the charge I/f of the load's current I through both capacitors:
the mean of v2 is about 2 Vm - I/(f C1) - I/(2 f C2), here 19.70 V, and the resistance takes a little more.

Source: the textbook formula, for Rs = 0; SciPy for the rest.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, complementarity

Vm, f, C1, C2, R, Rs = 10.0, 1e3, 10e-6, 10e-6, 10e3, 1.0  # V, Hz, F, ohm
t, v1, v2, d1, d2 = (ca.SX.sym(name) for name in ("t", "v1", "v2", "d1", "d2"))
source = Vm * ca.sin(2 * ca.pi * f * t)
node = source - v1 - Rs * (d2 - d1)

model = FirstOrderSystem(
    t=t,
    x=[v1, v2],
    lam=[d1, d2],
    f=[0, -v2 / (R * C2)],
    g=[(d2 - d1) / C1, d2 / C2],
    h=[node, v2 - node],
    law=complementarity(2),
    x0=[0, 0],
    outputs={"source": source},
    t_end=15e-3,
    step=2e-6,
    theta=0.5,
    units={"t": "s", "v1": "V", "v2": "V", "d1": "A", "d2": "A", "source": "V"},
    title="Voltage doubler",
)
