"""Third-order plant under relay feedback, u = -Sgn(x_0).

What to see: the loop settles on an oscillation of amplitude 0.215 and period 3.66 s; the describing function predicts
0.212, 2/(3 pi), and 3.63, 2 pi/sqrt 3. C B = 0, so that no P > 0 has P B = C': the theorem on well-posedness does not
apply.

A wrong answer: an oscillation that dies out, or whose amplitude is that of the step: long steps damp it, to 0.14 at a
step of 0.2. Rest at 0 with the relay between its ends: a solution, but an unstable one.

Source: the control example RelayOscillator of Siconos.
"""

import math

from nsmodel import LureSystem, relay

model = LureSystem(
    A=[[0, 1, 0], [0, 0, 1], [0, -3, -2]],
    B=[0, 0, 1],
    C=[1, 0, 0],
    law=relay(1),
    x0=[0, 3 * math.sqrt(2) / (2 * math.pi), 0],
    t_end=100,
    step=1e-2,
    theta=0.5,
    units={"t": "s"},
    title="Relay oscillator",
)
