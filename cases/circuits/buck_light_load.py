"""Buck converter with a light load: the current ends in each period, and the duty alone does not tell the voltage.

    L i' = u Vin - v + l,    C v' = i - v/R,    0 <= l ⟂ i >= 0

What to see: three intervals a period: the switch conducts, the diode conducts, neither does (i = 0 exactly). Above 33.3 ohm
the mean of v is 2 Vin/(1 + sqrt(1 + 8 L/(R T D^2))), here 13.9 V, not D Vin = 9.6 V. The run starts there.

A wrong answer: 9.6 V. That is the mean if the current may fall below 0, as with a second switch in the diode's place.

Source: the textbook formula, whose ripple is neglected; exact by matrix exponentials.
"""

import casadi as ca

from nsmodel import LureSystem, complementarity, pwm

Vin, L, C, R, T, D = 24.0, 100e-6, 47e-6, 100.0, 10e-6, 0.4  # V, H, F, ohm, s
u = ca.SX.sym("u")

model = LureSystem(
    A=[[0, -1 / L], [1 / C, -1 / (R * C)]],
    B=[1 / L, 0],
    C=[1, 0],
    f=[u * Vin / L, 0],
    law={"diode": complementarity(1)},
    x0=[0, 13.913],
    inputs={u: pwm(period=T, duty=D)},
    t_end=8 * T,
    step=T / 50,
    theta=0.5,
    names=["i", "v"],
    units={"t": "s", "i": "A", "v": "V", "diode": "V"},
    title="Buck converter with a light load",
)
