"""A bowling ball that slides, then rolls.

    m v' = P_T/h,    I w' = R P_T/h,    |P_T| <= mu P_N,    slip v + R w

What to see: it rolls from t = 2 v0/(7 mu g) = 0.437 s on, with v = 5/7 v0 = 2.142857 m/s exactly, whatever mu is; the slip is 0
from then on. Try friction, and I = k m R^2 with k = 1/2 (a disc) or 1 (a ring).

A wrong answer: a slip that changes its sign once it is 0, or a speed of rolling that depends on mu or on the step.

Source: elementary; a test of Coulomb friction with spin (Acary and Brogliato, Numerical Methods for Nonsmooth Dynamical Systems,
2008).
"""

import casadi as ca

from nsmodel import MechanicalSystem
from nsmodel.mechanics import disc, gravity

R, k = 0.11, 0.4
q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
friction = ca.SX.sym("friction")

model = MechanicalSystem(
    q=q,
    v=v,
    M=[1, 1, k * R**2],
    F=gravity([(1, k * R**2)]),
    contacts={"lane": disc(q, v, R, mu=friction)},
    q0=[0, R, 0],
    v0=[3, 0, 0],
    t_end=1,
    step=2e-3,
    parameters={friction: 0.2},
    names=["px", "py", "angle", "vx", "vy", "spin"],
    units={"t": "s", "px": "m", "py": "m", "vx": "m/s", "vy": "m/s", "spin": "rad/s"},
    title="A bowling ball",
)
