"""Piecewise-linear model of two genes that switch each other on and off at thresholds.

    xa' = -4.5 xa + 40 l2 (1 - l3),    xb' = -1.5 xb + 40 l1 (1 - l4)

where l1 and l2 switch from 0 to 1 as xa and xb rise above 4, and l3 and l4 as they rise above 8. The product makes the
relation bilinear in l: Newton's method solves each step.

What to see: the concentrations slide along thresholds and reach the equilibrium (8, 8) in finite time, with the
switches l3 = 0.1 and l4 = 0.7 strictly inside (0, 1).

A wrong answer: xa and xb go on to 8.9 and 26.7, where decay alone balances production, or they swing about 8. The thresholds
hold them: l3 and l4 are found, not switched.

Source: the biology example StepSystem of Siconos.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, relay

xa, xb = ca.SX.sym("xa"), ca.SX.sym("xb")
l1, l2, l3, l4 = (ca.SX.sym(f"l{i}") for i in range(1, 5))

model = FirstOrderSystem(
    x=[xa, xb],
    lam=[l1, l2, l3, l4],
    f=[-4.5 * xa, -1.5 * xb],
    h=[4 - xa, 4 - xb, 8 - xa, 8 - xb],
    g=[40 * l2 * (1 - l3), 40 * l1 * (1 - l4)],
    law=relay(4, 0, 1),
    x0=[1, 6],
    t_end=3,
    step=1e-3,
    theta=0.5,
    title="Two genes with threshold switches",
)
