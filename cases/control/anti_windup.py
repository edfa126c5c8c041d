"""A PI controller on a motor that gives no more than 1: the integral is led back while the motor is at its limit.

    T n' = l - n - drag(t),    w = kp (r - n) + z,    l = sat(w),    z' = ki (r - n) + kb (l - w),    r = 0.5

The saturation is a box law: l in [-1, 1] with y = l - w is at its end where w is beyond it, and is w where y = 0.

What to see: the drag from 6 s to 10 s is more than the motor can do: l = 1, and n falls to 0.234. When it is gone n comes
back to 0.5 and is never above 0.541.

A wrong answer: a limit that the integral does not know of, as with --set kb=0: it winds up all the while, and n swings
over to 0.833 and is back late. Without any limit l starts at 2 and rises to 1.36 under the drag,
and n is nearly back at 0.5 before the drag ends.

Source: Astrom and Hagglund, Advanced PID control (2006), back-calculation; exact by matrix exponentials, one for each
mode.
"""

import casadi as ca

from nsmodel import LureSystem, box, table

T, r, kp, ki = 2.0, 0.5, 4.0, 4.0  # s, -, -, 1/s
n, z, drag = (ca.SX.sym(name) for name in ("n", "z", "drag"))


def model(kb: float = 1.5) -> LureSystem:
    """Return the loop; kb leads the integral back, 0 lets it wind up."""
    return LureSystem(
        x=ca.vertcat(n, z),
        A=[[-1 / T, 0], [-ki + kb * kp, -kb]],
        B=[1 / T, kb],
        C=[kp, -1],
        D=1,
        f=[-drag / T, (ki - kb * kp) * r],
        e=[-kp * r],
        law={"motor": box(-1, 1)},
        x0=[0, 0],
        inputs={drag: table([0, 6, 10], [0, 0.8, 0])},
        outputs={"wanted": kp * (r - n) + z},
        t_end=16,
        step=1e-2,
        theta=0.5,
        gamma=0.5,
        units={"t": "s"},
        title="PI control with anti-windup",
    )
