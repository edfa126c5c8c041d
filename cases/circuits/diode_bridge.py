"""Diode bridge rectifier: four ideal diodes feed a resistor from a charged LC source.

What to see: the current through the resistor is the full-wave rectified current of the source, and the oscillation dies
out in a few milliseconds. Two diodes conduct at a time; D is positive semidefinite but not symmetric.

A wrong answer: half waves that are not damped. Behind one diode (rlc_diode) negative ones are not, and the last period
swings to 3.1 V; behind the bridge it swings to 1.1 V. Energy never rises.

Source: the electronics example DiodeBridge of Siconos.
"""

from nsmodel import LureSystem, complementarity

L, C, R = 1e-2, 1e-6, 1e3  # H, F, ohm

model = LureSystem(
    A=[[0, -1 / C], [1 / L, 0]],
    B=[[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]],
    C=[[0, 0], [0, 0], [-1, 0], [1, 0]],
    D=[[1 / R, 1 / R, -1, 0], [1 / R, 1 / R, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
    law=complementarity(4),
    x0=[10, 0],
    t_end=5e-3,
    step=1e-6,
    theta=0.5,
    names=["v_C", "i_L"],
    units={"t": "s", "v_C": "V", "i_L": "A", "l_0": "V", "l_1": "V", "l_2": "A", "l_3": "A"},
    title="Diode bridge rectifier",
)
