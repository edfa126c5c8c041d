"""Full-wave rectifier with a capacitor: a bridge feeds a load of 50 ohm through 0.5 ohm.

    C v' = l - v/R,    0 <= l ⟂ Rs l + v - |Vm sin wt| >= 0

What to see: the bridge conducts in short pulses near the peaks of the mains, 45 of 180 degrees, of many times the current
of the load; between them the capacitor feeds it, and v swings between 14.3 and 16.6 V.

A wrong answer: v reaches 17 V, the peak of the mains, or conduction lasts as long as the mains rise. At its largest v is 16.65
V: what the load takes flows through 0.5 ohm.

Source: exact, switch by switch.
"""

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, complementarity

Vm, Rs, C, R, f = 17.0, 0.5, 1e-3, 50.0, 50.0  # V, ohm, F, ohm, Hz
t, v, l = (ca.SX.sym(name) for name in "tvl")
mains = ca.fabs(Vm * ca.sin(2 * np.pi * f * t))

model = FirstOrderSystem(
    t=t,
    x=v,
    lam=l,
    f=[-v / (R * C)],
    g=[l / C],
    h=[Rs * l + v - mains],
    law=complementarity(1),
    x0=[0],
    outputs={"mains": mains},
    t_end=0.04,
    step=2e-5,
    theta=0.5,
    units={"t": "s", "v": "V", "l": "A", "mains": "V"},
    title="Full-wave rectifier with a capacitor",
)
