"""Buck converter: a switch that a PWM closes for 40 % of each period, and a diode, make 9.6 V of 24 V.

    L i' = u Vin - v + l,    C v' = i - v/R,    0 <= l ⟂ i >= 0

What to see: the current rises while the switch is closed and falls while the diode conducts. After the first surge the diode
blocks at the end of some periods (i = 0 exactly, l > 0). With --t-end 2e-3 the current never ends any more, and the mean of v
is then D Vin = 9.6 V.

A wrong answer: a current below 0 after the first surge. With a second switch in the diode's place it falls to -1.6 A there; the
mean of v would still be 9.6 V in the end.

Source: exact by matrix exponentials, one for each position of the switch.
"""

import casadi as ca

from nsmodel import LureSystem, complementarity, pwm

Vin, L, C, R, T, D = 24.0, 100e-6, 47e-6, 5.0, 10e-6, 0.4  # V, H, F, ohm, s
u = ca.SX.sym("u")

model = LureSystem(
    A=[[0, -1 / L], [1 / C, -1 / (R * C)]],
    B=[1 / L, 0],
    C=[1, 0],
    f=[u * Vin / L, 0],
    law={"diode": complementarity(1)},
    x0=[0, 0],
    inputs={u: pwm(period=T, duty=D)},
    t_end=40 * T,
    step=T / 20,
    theta=0.5,
    names=["i", "v"],
    units={"t": "s", "i": "A", "v": "V", "diode": "V"},
    title="Buck converter",
)
