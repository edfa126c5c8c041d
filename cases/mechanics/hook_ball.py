"""A bowling ball with side spin that hooks: a sphere on a lane.

    m v' = P/h,    I w' = r x P/h,    |P_T| <= mu P_N,    slip v + w x (0, 0, -R)

What to see: while it slides, friction acts against the slip, whose direction never changes, so that the path of the centre is a
parabola. From t = 2 |s_0|/(7 mu g) = 0.9306 s on, s_0 the slip at the start, it rolls straight ahead with v = v_0 - (2/7) s_0 =
(6.2857, -0.6286, 0) m/s, whatever mu is.

A wrong answer: a path that is straight from the start, or bends after it rolls; a direction of slip that turns.

Source: Coriolis, Théorie mathématique des effets du jeu de billard (1835): a ball that slides runs along a parabola.
"""

import casadi as ca

from nsmodel import MechanicalSystem
from nsmodel.mechanics import gravity, sphere

R, m, friction = 0.108, 6.8, ca.SX.sym("friction")
I = 0.4 * m * R**2
q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 6)  # The spin of a sphere moves no position.

model = MechanicalSystem(
    q=q,
    v=v,
    kinematics=ca.horzcat(ca.SX.eye(3), ca.SX(3, 3)),
    M=[m, m, m, I, I, I],
    F=gravity([(m, I, I, I)], size=3),
    contacts={"lane": sphere(q, v, R, mu=friction)},
    q0=[0, 0.2, R],
    v0=[8, 0, 0, 2.2 / R, 2 / R, 0],
    t_end=1.5,
    step=2e-3,
    parameters={friction: 0.2},
    names=["px", "py", "pz", "vx", "vy", "vz", "spin_x", "spin_y", "spin_z"],
    units={"t": "s", "px": "m", "py": "m", "pz": "m", "vx": "m/s", "vy": "m/s", "vz": "m/s"},
    title="A bowling ball that hooks",
)
