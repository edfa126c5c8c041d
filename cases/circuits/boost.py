"""Boost converter: a switch to ground and a diode make 24 V of 12 V. The input multiplies unknowns.

    L i' = Vin - s,    C v' = l - v/R,    u s + (1 - u) (i - l) = 0,    0 <= l ⟂ v - s >= 0

s is the voltage of the node between coil, switch and diode, l the current of the diode.

What to see: closed (u = 1) the switch holds s at 0 and the current of the coil rises; open, it flows through the diode, s = v.
The capacitor is fed in these half periods alone. With --t-end 0.02 v settles at Vin/(1 - D) = 24 V, after an overshoot.

A wrong answer: v rises while the switch is closed. The diode blocks then, and the load alone acts: in each of these half
periods v falls by 0.5 %, to exp(-T/(2 R C)) of what it was.

Source: exact by matrix exponentials, one for each position of the switch and the diode.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, complementarity, equality, product, pwm

Vin, L, C, R, T, D = 12.0, 100e-6, 100e-6, 20.0, 20e-6, 0.5  # V, H, F, ohm, s
i, v, s, l, u = (ca.SX.sym(name) for name in "ivslu")

model = FirstOrderSystem(
    x=[i, v],
    lam=[s, l],
    f=[Vin / L, -v / (R * C)],
    g=[-s / L, l / C],
    h=[u * s + (1 - u) * (i - l), v - s],
    law=product(equality(1), complementarity(1)),
    x0=[1, 20],
    inputs={u: pwm(period=T, duty=D)},
    t_end=12 * T,
    step=T / 20,
    theta=0.5,
    gamma=0.5,
    units={"t": "s", "i": "A", "v": "V", "s": "V", "l": "A"},
    title="Boost converter",
)
