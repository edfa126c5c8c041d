"""Half-wave rectifier: an LC oscillator discharges through a resistor behind one ideal diode.

What to see: the diode conducts (l_0 > 0) only while the capacitor's voltage is positive; the negative half waves are
not damped at all, the positive ones lose energy in the resistor.

A wrong answer: both half waves are damped alike, as behind a bridge (diode_bridge): after 5 ms v_C would be 0.79 V,
not 2.74 V.

Source: the electronics example CircuitRLCD of Siconos.
"""

from nsmodel import LureSystem, complementarity

L, C, R = 1e-2, 1e-6, 1e3  # H, F, ohm

model = LureSystem(
    A=[[0, -1 / C], [1 / L, 0]],
    B=[-1 / C, 0],
    C=[-1, 0],
    D=R,
    law=complementarity(1),
    x0=[10, 0],
    t_end=5e-3,
    step=1e-5,
    theta=0.5,
    names=["v_C", "i_L"],
    units={"t": "s", "v_C": "V", "i_L": "A", "l_0": "A"},
    title="RLC circuit with one diode",
)
