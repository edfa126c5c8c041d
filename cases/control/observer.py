"""An observer of a mass with dry friction: it sees the position alone, has a friction of its own, and finds the speed.

    p' = v,                v' = -4 p - 0.2 v + 3 sin t + l,                  l in -1.5 Sgn(v)
    z' = u + 6 (p - z),    u' = -4 z - 0.2 u + 3 sin t + 8 (p - z) + k,      k in -1.5 Sgn(u)

What to see: the observer (z, u) starts at 0, the mass at p = 2 with v = -3. At first it switches and turns by itself;
from t = 4.57 on both turn, stick and slip within 3 us of each other. The error 12 (p - z)^2 + (v - u)^2 never rises: with
P = diag(12, 1) the observer's field is dissipative, and P B = C' for both frictions.

A wrong answer: without its own friction (--set friction=0) the observer does not find the speed: u is off by up to 0.69
m/s at each swing. A friction that is smoothed moves where it should stick, from 7.93 s to 8.83 s.

Source: Brogliato and Heemels, Observer design for Lur'e systems with multivalued mappings: a passivity approach (2009).
"""

import casadi as ca

from nsmodel import LureSystem, relay

w2, c, F, gain = 4.0, 0.2, 1.5, (6.0, 8.0)  # 1/s^2, 1/s, N/kg, (1/s, 1/s^2)
t, p, v, z, u = (ca.SX.sym(name) for name in "tpvzu")


def model(friction: float = F) -> LureSystem:
    """Return the mass and its observer, which believes in that much friction."""
    push = 3 * ca.sin(t)
    return LureSystem(
        t=t,
        x=ca.vertcat(p, v, z, u),
        A=[[0, 1, 0, 0], [-w2, -c, 0, 0], [gain[0], 0, -gain[0], 1], [gain[1], 0, -w2 - gain[1], -c]],
        B=[[0, 0], [F, 0], [0, 0], [0, friction]],
        C=[[0, 1, 0, 0], [0, 0, 0, 1]],
        f=[0, push, 0, push],
        law={"friction": relay(1), "its own": relay(1)},
        x0=[2, -3, 0, 0],
        outputs={"error": ca.sqrt((w2 + gain[1]) * (p - z) ** 2 + (v - u) ** 2)},
        t_end=12,
        step=5e-3,
        theta=0.5,
        units={"t": "s", "p": "m", "v": "m/s", "z": "m", "u": "m/s", "error": "m/s"},
        title="Observer of a mass with dry friction",
    )
