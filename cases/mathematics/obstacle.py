"""A string in honey over a floor, with a weight that changes: the heat equation with an obstacle.

    u_t = u_xx - p(t) + l,    0 <= u ⟂ l >= 0,    u = a at both ends

What to see: the middle lands first. The contact spreads as the weight grows from 8/9 to 8, and draws back when it is 2.
At rest it is the nodes with |x - 1/2| <= 1/2 - s, s = sqrt(2 a/p) = 3/8, 1/8, 1/4; what hangs on each side is a parabola,
p (s - x)^2/2, which meets the floor without a kink. On the floor l = p, and half of it at the edge of the contact.

A wrong answer: the string without a floor, cut off at 0, has a kink there, and under p = 2 it lies on the floor from x =
0.067 to 0.933, not from 1/4 to 3/4. A floor that is a stiff spring lets the string sink in, by the weight over the
stiffness.

Source: Duvaut and Lions, Inequalities in mechanics and physics (1976); the states of rest in closed form, exact on the
grid.
"""

import casadi as ca
import numpy as np
import scipy.sparse as sp

from nsmodel import LureSystem, complementarity, table

a = 1 / 16  # the height of both ends


def model(n: int = 15) -> LureSystem:
    """Return the string of ``n`` nodes between its ends, level at first; where (n + 1)/8 is whole, each s is a node."""
    h, weight, ends = 1 / (n + 1), ca.SX.sym("weight"), np.zeros(n)
    ends[[0, -1]] += a / h**2
    return LureSystem(
        A=(sp.eye(n, k=1) + sp.eye(n, k=-1) - 2 * sp.eye(n)) / h**2,
        B=sp.eye(n),
        C=sp.eye(n),
        f=ends - weight,
        law={"floor": complementarity(n)},
        x0=np.full(n, a),
        inputs={weight: table([0, 0.4, 0.8], [8 / 9, 8, 2])},
        t_end=1.2,
        step=2e-3,
        names=[f"u_{i}" for i in range(1, n + 1)],
        title="A string on a floor",
    )
