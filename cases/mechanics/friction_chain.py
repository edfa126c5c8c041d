"""Chain of n masses between two walls, with springs, Coulomb friction on each mass and a travelling force.

    v_i' in 100 (x_{i-1} - 2 x_i + x_{i+1}) + 3 sin(2 t + 0.3 (i - 1)) - Sgn(v_i),    x_0 = x_{n+1} = 0

What to see: waves of slip run through the chain, masses stick for a while and are torn off again. The matrices are
sparse, and a step costs what they hold: try n = 200, or 10000.

A wrong answer: speeds that are small where they should be 0: a mass that sticks has v_i = 0 exactly, and its friction is
what the springs and the force ask for, strictly between -1 and 1.

Source: made for this package: the two masses of Brogliato and Goeleven (2013), Example 6.2, as a chain of any length.
"""

import casadi as ca
import numpy as np
import scipy.sparse as sp

from nsmodel import LureSystem, relay


def model(n: int = 10) -> LureSystem:
    """Return the chain of ``n`` unit masses; the state is (x_1, ..., x_n, v_1, ..., v_n)."""
    t = ca.SX.sym("t")
    i = np.arange(1, n + 1)
    zero, one = sp.csc_matrix((n, n)), sp.eye(n)
    springs = 100 * (2 * one - sp.eye(n, k=1) - sp.eye(n, k=-1))
    position, speed = [f"x_{j}" for j in i], [f"v_{j}" for j in i]
    return LureSystem(
        t=t,
        A=sp.bmat([[zero, one], [-springs, zero]]),
        B=sp.vstack([zero, one]),
        C=sp.hstack([zero, one]),
        f=ca.vertcat(np.zeros(n), 3 * ca.sin(2 * t + 0.3 * (i - 1))),
        law=relay(n),
        x0=np.concatenate([np.sin(2 * np.pi * i / (n + 1)), np.zeros(n)]),
        t_end=10,
        step=1e-2,
        theta=0.5,
        names=position + speed,
        units={"t": "s", **dict.fromkeys(position, "m"), **dict.fromkeys(speed, "m/s")},
        title=f"Chain of {n} masses with friction",
    )
