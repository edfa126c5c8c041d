"""A slider-crank whose slider has clearance in its guide: impacts of four corners with friction.

    M(q) v' = F(q, v) + G'P/h,    q: angles of the crank, of the rod and of the slider

What to see: the slider, free to turn on the end of the rod, hits the top of its guide with its right corner at 2.0 ms and with
its left one at 2.6 ms; the corners strike in turn, weaker and weaker, until it slides along the top. The turning that is left is
of the size of a step, and goes as steps get shorter. No corner penetrates: positions are put back to rounding.

A wrong answer: corners that penetrate by more than rounding, or a slider that turns over in its guide.

Source: Flores, Leine and Glocker, Modeling and analysis of planar rigid multibody systems with translational clearance joints
based on the non-smooth dynamics approach, Multibody System Dynamics 23 (2010) 165-190.
"""

import casadi as ca

from nsmodel import Contact, MechanicalSystem

crank, rod, half_length, half_height, clearance, g = 0.1530, 0.3060, 0.05, 0.025, 0.001, 9.81
m_1, m_2, m_3, J_1, J_2, J_3 = 0.038, 0.038, 0.076, 7.4e-5, 5.9e-4, 2.7e-6
q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
k, moved, half_width = (m_2 / 2 + m_3) * crank * rod, m_2 + m_3, half_height + clearance


def corner(side: int, up: int) -> Contact:
    """A corner of the slider, left (-1) or right (1), up (1) or down (-1), with its side of the guide."""
    s, c = ca.sin(q), ca.cos(q)
    height = crank * s[0] + rod * s[1] + side * half_length * s[2] + up * half_height * c[2]
    along = crank * c[0] + rod * c[1] + side * half_length * c[2] - up * half_height * s[2]
    return Contact(half_width - up * height, slip=ca.jtimes(along, q, v), mu=0.01, e=0.4)


model = MechanicalSystem(
    q=q,
    v=v,
    M=[
        [J_1 + (m_1 / 4 + moved) * crank**2, k * ca.cos(q[1] - q[0]), 0],
        [k * ca.cos(q[1] - q[0]), J_2 + (m_2 / 4 + m_3) * rod**2, 0],
        [0, 0, J_3],
    ],
    potential=g * ((m_1 / 2 + moved) * crank * ca.sin(q[0]) + (m_2 / 2 + m_3) * rod * ca.sin(q[1])),
    contacts={
        f"{where} {end}": corner(s, u) for where, u in (("top", 1), ("bottom", -1)) for end, s in (("left", -1), ("right", 1))
    },
    q0=[0, 0, 0.01],
    v0=[150, -75, 0],
    t_end=0.01,
    step=2e-5,
    names=["crank", "rod", "slider", "rate_crank", "rate_rod", "rate_slider"],
    units={"t": "s", "rate_crank": "1/s", "rate_rod": "1/s", "rate_slider": "1/s"},
    title="A slider-crank with clearance",
)
