"""A leg with dead time whose command is an expression of t: it crosses 0, or jumps, at times that are found."""

import math

import casadi as ca
import numpy as np
import pytest

from nsmodel import LureSystem, box, dead_time, simulate

t = ca.SX.sym("t")
T = 0.83e-4
SHARE = t / T - ca.floor(t / T)


@pytest.mark.parametrize(
    ("command", "begin", "end"),
    [
        (0.6 - ca.fmod(t, T) / T, 0, 0.6),
        (ca.fmod(t, T) / T - 0.4, 0.4, 1),
        (0.6 - SHARE, 0, 0.6),
        (0.6 - ca.fabs(2 * SHARE - 1), 0.2, 0.8),
        (0.1 - ca.remainder(t, T) / T, 0.5, 1.1),
        (ca.sin(2 * ca.pi * t / T) - 0.5, 1 / 12, 5 / 12),
        (ca.sign(ca.sin(2 * ca.pi * t / T)), 0, 0.5),
        (ca.if_else(ca.cos(2 * ca.pi * t / T) < 0, 2, -3), 0.25, 0.75),
    ],
)
def test_dead_time_follows_a_command_that_crosses_0_or_jumps(command, begin, end):
    """Per period the command is > 0 from one share of it to another: each edge, and one ``delay`` after it, is an event."""
    on, off, delay, x0 = ca.SX.sym("on"), ca.SX.sym("off"), 2e-6, 12.0
    leg = LureSystem(
        t=t, A=[[-2500]], B=[500], C=[1], law={"leg": box(100 * on, 100 * (1 - off))}, x0=[x0], t_end=4.05 * T, step=T / 100,
        blocks=[dead_time(on, off, command, t, delay=delay)],
    )  # fmt: skip
    run = simulate(leg, rtol=1e-9, method="event-driven")
    times = [(max(k + begin, 0) * T, (k + end) * T) for k in range(-1, 5) if k + end > 0]
    expected = sorted(edge + late for both in times for edge in both for late in (0, delay) if 0 < edge + late < run.t[-1])
    np.testing.assert_allclose([event.t for event in run.events], expected, rtol=0, atol=1e-9 * T)
    i, now, level = x0, 0.0, 0.0  # L i' = -R i + V while the upper switch is on, else the lower diode conducts.
    edges = sorted(edge for rise, fall in times for edge in ((rise + delay, 100.0), (fall, 0.0)) if edge[0] < run.t[-1])
    for edge, v in [*edges, (run.t[-1], 0.0)]:
        i, now, level = level / 5 + (i - level / 5) * math.exp(-2500 * (edge - now)), edge, v
    np.testing.assert_allclose(run.x[-1, 0], i, rtol=1e-8)
