"""Repressilator: three genes in a ring, each of which switches the next one off while it is above a threshold.

    x_k' = 2 (1 - s_{k-1}) - x_k,    s_k rises from 0 to 1 as x_k rises above 1

The unit of time is the lifetime of a protein. The ring is not monotone, and the check says so: F-mlcp is violated.

What to see: the three come one after the other. The cycle is all but reached after three turns (1.615 of 1.618): each
swings between 1 - 1/phi and 1 + 1/phi, phi = (1 + sqrt 5)/2 the golden ratio, and the period is 6 log phi = 2.887. Steps
switch up to a step early, six times a turn; with --rtol 1e-8 the switches are exact.

A wrong answer: all three come to rest at 1, where they balance. So they do if the switches are softened to Hill functions
1/(1 + x^n) with n < 4.

Source: Elowitz and Leibler, A synthetic oscillatory network of transcriptional regulators (2000), proteins alone, with switches;
the cycle by hand.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, relay

x, s = ca.SX.sym("x", 3), ca.SX.sym("s", 3)

model = FirstOrderSystem(
    x=x,
    lam=s,
    f=2 - x,
    g=[-2 * s[k - 1] for k in range(3)],
    h=1 - x,
    law=relay(3, 0, 1),
    x0=[0.2, 0.3, 0.1],
    t_end=12,
    step=2e-3,
    theta=0.5,
    title="Repressilator",
)
