"""Toggle switch: two genes that switch each other off remember which one is on; a pulse flips them if it is long enough.

    a' = 2 (1 - s_b) - a,    b' = 2 (1 - s_a) + 2 u - b,    s_a, s_b rise from 0 to 1 as a, b rise above 1

u is a signal that makes b: it is 1 for 1.05 from t = 1 on, and for 1.15 from t = 6 on. The unit of time is the lifetime of a
protein. What has two rests is not monotone, and the check says so: F-mlcp is violated.

What to see: the first pulse lifts b above the threshold, so that a falls, but b is below again before a is: a comes back. The
second pulse, a tenth longer, is remembered for ever. From rest a pulse must be longer than log 3 = 1.0986.

A wrong answer: both pulses flip the switch, or none does; or both genes come to rest at 1, on the edge between their two rests.
Steps that are too long for the tenth do that: with --step 0.2 both pulses flip it, with --step 0.05 it stands on the edge until
t = 6.

Source: Gardner, Cantor and Collins, Construction of a genetic toggle switch in Escherichia coli (2000), with switches;
times by hand.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, relay, table

a, b, s_a, s_b, u = (ca.SX.sym(name) for name in ("a", "b", "s_a", "s_b", "u"))

model = FirstOrderSystem(
    x=[a, b],
    lam=[s_a, s_b],
    f=[2 - a, 2 + 2 * u - b],
    g=[-2 * s_b, -2 * s_a],
    h=[1 - a, 1 - b],
    law=relay(2, 0, 1),
    x0=[2, 0],
    inputs={u: table([0, 1, 2.05, 6, 7.15], [0, 1, 0, 1, 0])},
    t_end=12,
    step=5e-3,
    theta=0.5,
    title="Toggle switch",
)
