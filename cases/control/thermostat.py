"""Thermostat with hysteresis: heating goes on below 19 degrees and off above 21, and stays as it is between.

    T' = (5 + 30 u - T)/2

What to see: from 15 degrees the room warms up, then swings between 19 and 21: 2 log(8/7) hours up, as many down. Steps see
a threshold at most a step late; with --rtol 1e-8 the heating switches at it.

A wrong answer: a switch without memory holds 20 degrees, or chatters. Where a threshold is seen late the room goes beyond
19 and 21, and a period is longer than 4 log(8/7) = 0.534 h.

Source: closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, hysteresis

low, high, cold, hot, tau = 19.0, 21.0, 5.0, 35.0, 2.0  # degrees C, and h
first, half = tau * np.log((hot - 15) / (hot - high)), tau * np.log((hot - low) / (hot - high))


def exact(t):
    """Return the temperature (N, 1): exponentials to 35 degrees and to 5, of equal length."""
    since = np.asarray(t) - first
    heats, part = since // half % 2 == 1, np.exp(-(since % half) / tau)
    swing = np.where(heats, hot + (low - hot) * part, cold + (high - cold) * part)
    return np.where(since < 0, hot + (15 - hot) * np.exp(-np.asarray(t) / tau), swing).reshape(-1, 1)


T, u = ca.SX.sym("T"), ca.SX.sym("u")
model = FirstOrderSystem(
    x=T,
    f=[(cold + (hot - cold) * u - T) / tau],
    x0=[15],
    blocks=[hysteresis(u, T, low, high, start=1)],
    t_end=3,
    step=2e-3,
    theta=0.5,
    units={"t": "h", "T": "°C"},
    exact=exact,
    title="Thermostat with hysteresis",
)
