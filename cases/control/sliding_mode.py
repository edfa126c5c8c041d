"""Sampled sliding-mode control of x' = w + 0.5 sin t, explicit or implicit: w held over samples of h.

What to see: implicitly, w = -sat(x/h), the control reaches 0 in a second and then follows -0.5 sin t smoothly, a sample late;
|x| stays below h/2. Explicitly (--set implicit=0), w = -sgn(x), it chatters between -1 and 1 for ever, and |x| comes near 3h/2.

A wrong answer: chattering of the implicit control, which the model does not have, or |x| above h/2. Explicitly it is the
model that chatters: a smooth w is wrong there.

Source: exact, as the plant between two samples is an integral.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, sampled

t, x, w = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("w")


def model(h: float = 0.1, implicit: bool = True) -> FirstOrderSystem:
    """Return the loop with samples of h; implicit: the control of backward Euler, x + h w = 0 where |w| <= 1."""
    control = ca.fmin(ca.fmax(-x / h, -1), 1) if implicit else -ca.sign(x)
    return FirstOrderSystem(
        t=t,
        x=x,
        f=[w + 0.5 * ca.sin(t)],
        x0=[1],
        blocks=[sampled("control", period=h, outputs={w: control})],
        t_end=10,
        step=h / 10,
        theta=0.5,
        units={"t": "s"},
        title=f"{'Implicit' if implicit else 'Explicit'} sliding mode, sampled",
    )
