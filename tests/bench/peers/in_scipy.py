"""Scenes by SciPy's stiff integrators, on laws made smooth with a width eps. Which eps and tolerance are good is not known.

A relay l in -Sgn(y) becomes l = -tanh(y/eps); an ideal diode becomes u = eps log(1 + R i/eps); a rigid body becomes a spring that
gives way by eps for a unit force. CPU time of the integration, one warm-up, the minimum over repeats.
"""

from __future__ import annotations

import itertools
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from math import hypot, log, sin, tanh

import numpy as np
from scipy.integrate import odeint, solve_ivp
from scipy.special import wrightomega

from peers.programs import Run

REPEATS = 5
ENOUGH = 0.05  # s: what took longer is not repeated.
ROWS = 241
MOST_STEPS, MOST_EVALUATIONS = 2000, 6000  # of LSODA between two rows, of Radau in a run
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10)


def friction_oscillator(eps: float) -> Callable:
    """x'' + x + tanh(x'/eps) = 0."""
    return lambda t, x: (x[1], -x[0] - tanh(x[1] / eps))


def sliding_relay(eps: float) -> Callable:
    """x1' = x2, x2' = sin t - 2 tanh((x1 + x2)/eps)."""
    return lambda t, x: (x[1], sin(t) - 2 * tanh((x[0] + x[1]) / eps))


def diode_bridge(eps: float) -> Callable:
    """A bridge whose current i solves |v| = R i + 2 eps log(1 + R i/eps).

    With 1 + R i/eps = 2 w: w + log w = |v|/(2 eps) + 1/2 - log 2, whose solution is Wright's omega function.
    """
    L, C, R = 1e-2, 1e-6, 1e3

    def rate(t: float, x: np.ndarray) -> tuple[float, float]:
        v, i = x
        load = eps / R * (2 * float(wrightomega(abs(v) / (2 * eps) + 0.5 - log(2))) - 1)
        return -(i + (load if v > 0 else -load)) / C, v / L

    return rate


def point_past_disc(eps: float) -> Callable:
    """q' = (1, 0) + max(0, 1 - |q|)/eps q/|q|."""

    def rate(t: float, q: np.ndarray) -> tuple[float, float]:
        r = hypot(q[0], q[1])
        push = max(1 - r, 0.0) / (eps * r)
        return 1 + push * q[0], push * q[1]

    return rate


# scene: (right-hand side, x0, sizes of the states, columns of the state, end, largest step, widths eps)
SCENES = {
    "friction_oscillator": (friction_oscillator, (5.3, 0.0), (5.3, 5.3), [0], 12.0, 0.0, 10.0 ** -np.arange(1, 10)),
    "sliding_relay": (sliding_relay, (1.0, 0.0), (1.0, 1.0), [0, 1], 5.0, 0.0, 10.0 ** -np.arange(1, 10)),
    "diode_bridge": (diode_bridge, (10.0, 0.0), (10.0, 0.1), [0, 1], 5e-3, 0.0, 10.0 ** -np.arange(0, 9)),
    "point_past_disc": (point_past_disc, (-1.5, 0.3), (1.0, 1.0), [0, 1], 4.5, 0.1, 10.0 ** -np.arange(1, 8)),
}


class TooMuch(Exception):
    """More evaluations than a run is worth."""


def lsoda(rate: Callable, x0: tuple, t: np.ndarray, rtol: float, atol: np.ndarray, largest: float) -> np.ndarray:
    """States (N, n) at the times t."""
    x, info = odeint(rate, x0, t, tfirst=True, rtol=rtol, atol=atol, hmax=largest, mxstep=MOST_STEPS, full_output=True)
    if info["message"] != "Integration successful.":
        raise TooMuch(info["message"])
    return x


def radau(rate: Callable, x0: tuple, t: np.ndarray, rtol: float, atol: np.ndarray, largest: float) -> np.ndarray:
    """States (N, n) at the times t."""
    count = itertools.count()

    def counted(s: float, x: np.ndarray) -> tuple[float, float]:
        if next(count) > MOST_EVALUATIONS:
            raise TooMuch(f"more than {MOST_EVALUATIONS} evaluations")
        return rate(s, x)

    done = solve_ivp(counted, (0.0, t[-1]), x0, method="Radau", rtol=rtol, atol=atol, max_step=largest or np.inf, t_eval=t)
    if not done.success:
        raise TooMuch(done.message)
    return done.y.T


def measure(job: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    """CPU seconds of the quickest of several runs after a warm-up, and the states."""
    seconds = np.inf
    for count in range(REPEATS + 1):
        start = time.process_time()
        x = job()
        spent = time.process_time() - start
        if count:
            seconds = min(seconds, spent)
        if spent > ENOUGH and (count or spent > 5 * ENOUGH):
            return min(seconds, spent), x
    return seconds, x


def runs(scene: str) -> Iterator[Run]:
    """All settings of both integrators, good and bad."""
    law, x0, sizes, columns, end, largest, widths = SCENES[scene]
    t = np.linspace(0, end, ROWS)
    for method, integrate, settings in (
        ("SciPy LSODA", lsoda, itertools.product(widths, TOLERANCES)),
        ("SciPy Radau", radau, itertools.product(widths[1::2], TOLERANCES[:-1])),
    ):
        for eps, rtol in settings:
            label = f"eps = {eps:.0e}, rtol = {rtol:.0e}".replace("e-0", "e-").replace("1e+00", "1")
            job = partial(integrate, law(eps), x0, t, rtol, rtol * np.array(sizes), largest)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    seconds, x = measure(job)
            except (TooMuch, ValueError, OverflowError, ZeroDivisionError, FloatingPointError) as error:
                yield Run(method, label, message=str(error))
            else:
                yield Run(method, label, seconds, t, x[:, columns])
