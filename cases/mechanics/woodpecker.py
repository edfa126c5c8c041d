"""The woodpecker toy: a bird on a spring on a sleeve that slides down a pole by jamming and pecking.

    M v' = F(q, v) + G'P/h,    q = (height, phi_M, phi_S): height and angle of the sleeve, angle of the bird

What to see: the sleeve jams with its upper edge while the bird swings, comes free, falls, is caught by its lower edge and lets
the beak peck the pole: a limit cycle of 0.146 s, in which it sinks by 19.4 mm. For a quarter of the time friction holds it.

A wrong answer: a sleeve that creeps where it is jammed (its rate is 0 there to rounding), or a bird that stops.

Source: Glocker, Dynamik von Starrkörpersystemen mit Reibung und Stößen (1995); Pfeiffer and Glocker, Multibody Dynamics with
Unilateral Contacts (1996), 9.3.
"""

import casadi as ca

from nsmodel import Contact, MechanicalSystem

r_pole, r_sleeve, h_sleeve, l_sleeve = 0.0025, 0.0031, 0.0058, 0.010
l_spring, h_bird, l_bird = 0.015, 0.02, 0.0201
m_M, m_S, J_M, J_S, stiffness, g = 0.0003, 0.0045, 5e-9, 7e-7, 0.0056, 9.81
height, phi_M, phi_S = (ca.SX.sym(name) for name in ("height", "phi_M", "phi_S"))
q, v, friction = ca.vertcat(height, phi_M, phi_S), ca.SX.sym("v", 3), ca.SX.sym("friction")
a, b, d = m_S * l_sleeve, m_S * l_spring, m_S * l_sleeve * l_spring
twist = stiffness * (phi_M - phi_S)
beak, rim = l_sleeve + l_spring - l_bird, v[0] + r_sleeve * v[1]

model = MechanicalSystem(
    q=q,
    v=v,
    M=[[m_S + m_M, a, b], [a, J_M + m_S * l_sleeve**2, d], [b, d, J_S + m_S * l_spring**2]],
    F=ca.vertcat(-g * (m_S + m_M), -g * a - twist, -g * b + twist),
    contacts={
        "beak": Contact(
            beak - r_pole - h_bird * phi_S, slip=v[0] + l_sleeve * v[1] + (l_spring - l_bird) * v[2], mu=friction, e=0.5
        ),
        "upper": Contact(r_sleeve - r_pole + h_sleeve * phi_M, slip=rim, mu=friction),
        "lower": Contact(r_sleeve - r_pole - h_sleeve * phi_M, slip=rim, mu=friction),
    },
    q0=[0, -0.1034, -0.2788],
    v0=[-0.3411, 0, -7.4583],
    t_end=0.15,
    step=1e-4,
    parameters={friction: 0.3},
    names=["height", "phi_M", "phi_S", "rate_height", "rate_M", "rate_S"],
    units={"t": "s", "height": "m", "rate_height": "m/s", "rate_M": "1/s", "rate_S": "1/s"},
    title="The woodpecker toy",
)
