"""Three-phase rectifier: three diodes feed a load; coils in the phases make the current change over slowly.

    Ls i_k' + Ld I' = Vm cos(wt - 2 pi k/3) - R I + l_k,    I = i_0 + i_1 + i_2,    0 <= l_k ⟂ i_k >= 0

l_k is the voltage that the diode of phase k blocks.

What to see: every 120 degrees the current of the load passes to the next phase. For 23 degrees both diodes conduct, and the
load sees the mean of their voltages; then the last one blocks.

A wrong answer: 268.8 V at the load, the mean 3 sqrt(3)/(2 pi) Vm of the largest of three voltages. The overlap costs
3 w Ls I/(2 pi), 11.6 V, and a little for the ripple: the mean is 257.1 V.

Source: the textbook formulae, for a current I without ripple; exact, phase by phase.
"""

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, complementarity

Vm, f, Ls, Ld, R = 325.0, 50.0, 3e-3, 100e-3, 10.0  # V, Hz, H, H, ohm
t, i, l = ca.SX.sym("t"), ca.SX.sym("i", 3), ca.SX.sym("l", 3)
phases = [Vm * ca.cos(2 * np.pi * (f * t - k / 3)) for k in range(3)]
load = R * ca.sum1(i)

model = FirstOrderSystem(
    t=t,
    x=i,
    lam=l,
    M=Ls * np.eye(3) + Ld * np.ones((3, 3)),
    f=[phase - load for phase in phases],
    g=l,
    h=i,
    law=complementarity(3),
    x0=[0, 0, 0],
    outputs={"u_d": load},
    t_end=0.1,
    step=5e-5,
    theta=0.5,
    units={"t": "s", "i_0": "A", "i_1": "A", "i_2": "A", "l_0": "V", "l_1": "V", "l_2": "V", "u_d": "V"},
    title="Three-phase rectifier",
)
