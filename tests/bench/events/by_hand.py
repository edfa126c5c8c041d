"""The scenes as one writes them with SciPy: solve_ivp to the next event, another right-hand side, and on.

A mode is a right-hand side, a function that is positive until the mode ends, and what comes next.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sin, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

ROWS, MOST_EVENTS = 241, 5000


class Mode(NamedTuple):
    """x' = rate(t, x) as long as stays(t, x) > 0, and then the mode that after(t, x) gives; ``jacobian`` for implicit methods.

    Of several ``stays`` the number of the one that ends is given to ``after`` too.
    """

    rate: Callable[[float, Any], Any]
    stays: Callable[[float, Any], float] | list[Callable[[float, Any], float]] | None = None
    after: Callable[..., Mode] | None = None
    jacobian: np.ndarray | None = None


def friction(t: float, x: np.ndarray) -> Mode:
    """x'' = -x - Sgn(x') from rest or a turning point."""
    if x[1] == 0 and abs(x[0]) <= 1:
        return Mode(lambda t, x: (0.0, 0.0))
    s = float(np.sign(x[1] or -x[0]))
    return Mode(lambda t, x: (x[1], -x[0] - s), lambda t, x: s * x[1], lambda t, x: friction(t, _with(x, 1)))


def sliding_relay(t: float, x: np.ndarray) -> Mode:
    """x1' = x2, x2' = sin t - 2 Sgn(x1 + x2)."""
    s = x[0] + x[1]
    if abs(s) < 1e-9 and abs(x[1] + sin(t)) < 2:
        return Mode(
            lambda t, x: (x[1], -x[1]), lambda t, x: 2 - abs(x[1] + sin(t)),
            lambda t, x: _relay(1.0 if x[1] + sin(t) > 0 else -1.0),
        )  # fmt: skip
    return _relay(1.0 if s > 0 else -1.0)


def _relay(s: float) -> Mode:
    return Mode(lambda t, x: (x[1], sin(t) - 2 * s), lambda t, x: s * (x[0] + x[1]), sliding_relay)


def diode_bridge(t: float, x: np.ndarray, sign: float = 1.0) -> Mode:
    """A pair of diodes conducts until v_C changes its sign; both give x the same rate."""
    L, C, R = 1e-2, 1e-6, 1e3
    return Mode(
        lambda t, x: (-(x[1] + x[0] / R) / C, x[0] / L), lambda t, x: sign * x[0], lambda t, x: diode_bridge(t, x, -sign),
    )  # fmt: skip


def relay_oscillator(t: float, x: np.ndarray, sign: float = 0.0) -> Mode:
    """x''' + 2 x'' + 3 x' = -Sgn(x)."""
    s = sign or (1.0 if x[0] > 0 or (x[0] == 0 and x[1] > 0) else -1.0)
    return Mode(
        lambda t, x: (x[1], x[2], -3 * x[1] - 2 * x[2] - s), lambda t, x: s * x[0], lambda t, x: relay_oscillator(t, x, -s)
    )


def gene_network(t: float, x: np.ndarray, held: tuple[bool, bool] = (False, False)) -> Mode:
    """xa' = -4.5 xa + 40 [xb > 4] (1 - [xa > 8]), xb' = -1.5 xb + 40 [xa > 4] (1 - [xb > 8]); at 8 they are held."""
    up = [float(v > 4 - 1e-9) for v in x]
    a, b = ((0.0, 0.0) if hold else rate for hold, rate in zip(held, ((-4.5, 40 * up[1]), (-1.5, 40 * up[0])), strict=True))
    sides = [1.0 if v > 4 - 1e-9 else -1.0 for v in x]

    def stays(t: float, x: np.ndarray) -> float:
        near = [side * (v - 4) for side, v in zip(sides, x, strict=True)]
        return min(*near, *(8 - v for v, hold in zip(x, held, strict=True) if not hold), 4.0)

    def after(t: float, x: np.ndarray) -> Mode:
        now = tuple(hold or abs(v - 8) < 1e-6 for v, hold in zip(x, held, strict=True))
        return gene_network(t, np.where(now, 8.0, x), (now[0], now[1]))

    return Mode(lambda t, x: (a[0] * x[0] + a[1], b[0] * x[1] + b[1]), stays, after)


def point_past_disc(t: float, q: np.ndarray) -> Mode:
    """q' = (1, 0) until |q| = 1, along the disc until the stream leads away."""

    def along(t: float, q: np.ndarray) -> tuple[float, float]:
        part = q[0] / (q[0] * q[0] + q[1] * q[1])
        return 1 - part * q[0], -part * q[1]

    def free(t: float, q: np.ndarray) -> tuple[float, float]:
        return 1.0, 0.0

    held = Mode(along, lambda t, q: -q[0], lambda t, q: Mode(free))
    return Mode(free, lambda t, q: sqrt(q[0] * q[0] + q[1] * q[1]) - 1, lambda t, q: held)


def friction_chain(n: int) -> Callable[[float, np.ndarray], Mode]:
    """v' = K x + 3 sin(2 t + phase) - l: l_i = Sgn(v_i), and a mass sticks as long as what pulls at it is at most 1."""
    K = 100 * (np.eye(n, k=1) + np.eye(n, k=-1) - 2 * np.eye(n))
    phase = 0.3 * np.arange(n)

    def pull(t: float, x: np.ndarray) -> np.ndarray:
        return K @ x[:n] + 3 * np.sin(2 * t + phase)

    def stuck(i: int) -> Callable:
        row, lag = np.concatenate([K[i], np.zeros(n)]), phase[i]
        return lambda t, x: 1 - abs(float(row @ x) + 3 * sin(2 * t + lag))

    def slipping(i: int, sign: float) -> Callable:
        return lambda t, x: sign * x[n + i]

    def mode(t: float, x: np.ndarray, s: np.ndarray) -> Mode:
        sticks, slips = s == 0, abs(s)

        def rate(t: float, x: np.ndarray) -> np.ndarray:
            return np.concatenate([x[n:], slips * (pull(t, x) - s)])

        def after(t: float, x: np.ndarray, i: int = 0) -> Mode:
            force, new = pull(t, x)[i], s.copy()
            new[i] = np.sign(force) if sticks[i] or abs(force) > 1 else 0.0
            return mode(t, x if sticks[i] else _with(x, n + i), new)

        return Mode(rate, [stuck(i) if sticks[i] else slipping(i, s[i]) for i in range(n)], after)

    def start(t: float, x: np.ndarray) -> Mode:
        force = pull(t, x)
        return mode(t, x, np.where(abs(force) > 1, np.sign(force), 0.0))

    return start


def stiff_relay(mu: float) -> Callable[..., Mode]:
    """A relay through an actuator of the rate mu."""
    jacobian = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, -3, -2, 1], [0, 0, 0, -mu]])

    def mode(t: float, x: np.ndarray, s: float = 1.0) -> Mode:
        return Mode(
            lambda t, x: (x[1], x[2], -3 * x[1] - 2 * x[2] + x[3], -mu * (x[3] + s)), lambda t, x: s * x[0],
            lambda t, x: mode(t, x, -s), jacobian,
        )  # fmt: skip

    return mode


def _with(x: np.ndarray, i: int) -> np.ndarray:
    """The state at rest in i."""
    x = np.array(x)
    x[i] = 0.0
    return x


def run(start: Callable[..., Mode], x0: np.ndarray, t_end: float, method: str, tol: float, h_max: float) -> np.ndarray | None:
    """x (241, n) at equidistant times; None where SciPy gives up."""
    grid, t, x, row = np.linspace(0, t_end, ROWS), 0.0, np.array(x0, float), 1
    out, mode, scale = np.full((ROWS, len(x0)), np.nan), start(0.0, x), np.abs(x0).max()
    out[0] = x
    for _ in range(MOST_EVENTS):
        given: dict[str, Any] = {} if mode.jacobian is None or method != "Radau" else {"jac": mode.jacobian}
        several = isinstance(mode.stays, list)
        if mode.stays is not None:
            given["events"] = [_downwards(one) for one in (mode.stays if isinstance(mode.stays, list) else [mode.stays])]
        done = solve_ivp(
            mode.rate, (t, t_end), x, method, t_eval=grid[row:], rtol=tol, atol=tol * scale, max_step=h_max or np.inf, **given
        )
        if done.status < 0:
            return None
        if len(done.t):
            out[row : row + len(done.t)] = done.y.T
            row += len(done.t)
        if done.status == 0:
            return out if row == ROWS else None
        hit = next(i for i, times in enumerate(done.t_events) if len(times))
        t, x = float(done.t_events[hit][0]), done.y_events[hit][0]
        mode = mode.after(t, x, hit) if several else mode.after(t, x)
    return None


def _downwards(stays: Callable) -> Callable:
    def event(t: float, x: np.ndarray) -> float:
        return stays(t, x)

    event.terminal, event.direction = True, -1
    return event
