"""Closed forms to test against, in plain NumPy, independent of the package. All are vectorised in t (N,)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

# ---------------------------------------------------------------------------------------------- sweeping processes


def half_plane(t):
    """Return q (N, 2) for x >= sin 2t, f = (0, 1), q(0) = 0, t <= 2: in contact until pi/4."""
    t = np.asarray(t, float)
    return np.column_stack([np.sin(2 * np.minimum(t, np.pi / 4)), t])


def half_plane_multiplier(t):
    """Return the reaction (N,) of ``half_plane``."""
    return np.maximum(2 * np.cos(2 * np.minimum(t, np.pi / 4)), 0)


def half_line(t):
    """Return q (N, 1) for q >= sin t, f = -q, q(0) = 0, t <= 3: in contact until 3 pi/4."""
    leave = 3 * np.pi / 4
    return (np.sin(np.minimum(t, leave)) * np.exp(-np.maximum(np.asarray(t) - leave, 0)))[:, None]


def half_line_multiplier(t):
    """Return the reaction (N,) of ``half_line``: cos t + sin t in contact."""
    return np.where(np.asarray(t) <= 3 * np.pi / 4, np.cos(t) + np.sin(t), 0)


def _past_disc(t, R, U, x0, y0):
    """Return (touch, leave, theta (N,)) for a point carried past a disc; 0 < y0 < R, x0 < 0 outside the disc."""
    start = np.pi - np.arcsin(y0 / R)
    touch = (-np.sqrt(R**2 - y0**2) - x0) / U
    leave = touch + R / U * np.log(np.tan(start / 2))
    theta = 2 * np.arctan(np.tan(start / 2) * np.exp(-U / R * (np.clip(t, touch, leave) - touch)))
    return touch, leave, theta


def point_past_disc(t, R=1.0, U=1.0, x0=-1.5, y0=0.3):
    """Return q (N, 2) of a point carried with velocity (U, 0) past the fixed disc of radius R at 0."""
    t = np.asarray(t, float)
    touch, leave, theta = _past_disc(t, R, U, x0, y0)
    x = np.where(t < touch, x0 + U * t, np.where(t < leave, R * np.cos(theta), U * (t - leave)))
    return np.column_stack([x, np.where(t < touch, y0, np.where(t < leave, R * np.sin(theta), R))])


def point_past_disc_multiplier(t, R=1.0, U=1.0, x0=-1.5, y0=0.3):
    """Return the reaction (N,) of ``point_past_disc``."""
    touch, leave, theta = _past_disc(t, R, U, x0, y0)
    return np.where((t >= touch) & (t <= leave), -U * np.cos(theta), 0)


def moving_disc(t, R=1.0, c=1.0, x0=1.5, y0=0.3):
    """Return q (N, 2) of a resting point pushed by the disc of radius R and centre (c t, 0); 0 < y0 < R < x0."""
    t = np.asarray(t, float)
    mirrored = point_past_disc(t, R, c, -x0, y0)
    return np.column_stack([c * t - mirrored[:, 0], mirrored[:, 1]])


def moving_disc_multiplier(t, R=1.0, c=1.0, x0=1.5, y0=0.3):
    """Return the reaction (N,) of ``moving_disc``."""
    return point_past_disc_multiplier(t, R, c, -x0, y0)


def two_discs(t, u1=1.0, u2=0.4, r=0.3):
    """Return q (N, 4) of two discs of radius r that start at -1 and 1 on a line with velocities u1 and -u2."""
    touch = (2 - 2 * r) / (u1 + u2)
    before, after = np.minimum(t, touch), np.maximum(np.asarray(t) - touch, 0) * (u1 - u2) / 2
    zero = np.zeros_like(before)
    return np.column_stack([-1 + u1 * before + after, zero, 1 - u2 * before + after, zero])


def two_discs_multiplier(t, u1=1.0, u2=0.4, r=0.3):
    """Return the reaction (N,) of ``two_discs``."""
    return np.where(np.asarray(t) >= (2 - 2 * r) / (u1 + u2), (u1 + u2) / 2, 0.0)


@dataclass(frozen=True)
class Wedge:
    """Two planes y >= A(t) + alpha(t) x and y >= C(t) - alpha(t) x whose heights shake in turn, and the point that they lift.

    Block k = 0, 1, ... of ``count`` has N_k whole periods P_k = 2^-(coarsest + k), about ``2^(-beta k)`` long in all, and then a
    pause of a quarter of that, in which the slope alpha_k = sqrt(P_k/T_k)/2 goes linearly to the next one; or alpha is ``slope``
    throughout. In each period A, then C, rises from P_k/4 below the point's height y, lifts it by P_k/4 and sinks back. f = 0.
    """

    beta: float = 0.0
    coarsest: int = 4
    count: int = 10
    slope: float | None = None

    @property
    def period(self):
        """P_k (count,)."""
        return 2.0 ** -(self.coarsest + np.arange(self.count))

    @property
    def periods(self):
        """N_k (count,)."""
        return np.maximum(1, np.round(2 ** (-self.beta * np.arange(self.count)) / self.period))

    @property
    def alpha(self):
        """The slope of each block (count,)."""
        return 0.5 / np.sqrt(self.periods) if self.slope is None else np.full(self.count, self.slope)

    @property
    def pause(self):
        """The length of each pause (count,)."""
        return self.period * np.maximum(1, np.round(self.periods / 4))

    @property
    def start(self):
        """The start of each block, and the end of the last pause (count + 1,)."""
        return np.concatenate([[0], np.cumsum(self.periods * self.period + self.pause)])

    @property
    def height(self):
        """The height of the point at the start of each block (count,): half of P_k is gained in each period."""
        return np.concatenate([[0], np.cumsum(self.periods * self.period / 2)])[:-1]

    def _at(self, t):
        """(block, whole periods in it, part of the next one, part of the pause) at times (N,)."""
        k = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, self.count - 1)
        s = np.minimum((t - self.start[k]) / self.period[k], self.periods[k])
        pause = (t - self.start[k] - self.periods[k] * self.period[k]) / self.pause[k]
        return k, np.floor(s), s - np.floor(s), np.clip(pause, 0, 1)

    def planes(self, t):
        """Return A, C and alpha (N,) at times (N,)."""
        k, n, u, pause = self._at(np.asarray(t, float))
        P, following = self.period[k], np.minimum(k + 1, self.count - 1)
        alpha, top = self.alpha[k], (1 + self.alpha[k] ** 2) * P / 4
        low = -(P + (self.period[following] - P) * pause) / 4
        y = self.height[k] + n * P / 2
        A = y + np.where(u < 0.5, low + (top - low) * 2 * u, top + (P / 4 - top) * (2 * u - 1))
        C = y + P * np.where(u < 0.5, -u / 2, -0.25 + 0.75 * (2 * u - 1))
        return A, C, alpha + (self.alpha[following] - alpha) * pause

    def path(self, t):
        """Return q (N, 2): A pushes along (-alpha, 1), C along (alpha, 1), and at the end of each period x = 0."""
        t = np.asarray(t, float)
        k, n, u, _ = self._at(t)
        A, C, _ = self.planes(t)
        P, alpha, y = self.period[k], self.alpha[k], self.height[k] + n * self.period[k] / 2
        by_A = np.where(u < 0.5, np.maximum(A - y, 0) / (1 + alpha**2), P / 4)
        by_C = np.where(u < 0.5, 0, np.maximum(C + alpha**2 * P / 4 - y - P / 4, 0) / (1 + alpha**2))
        return np.column_stack([alpha * (by_C - by_A), y + by_A + by_C])

    def drift(self, k):
        """Return x at the end of block k of a run with the step P_k, which sees C at its tops and A never at its."""
        return self.alpha[k] * self.periods[k] * self.period[k] / 2 / (1 + self.alpha[k] ** 2)


def lacunary(t, theta, count=40):
    """Return (f, its integral from 0) (N,) of f = sum_j 2^(-theta j) cos(2 pi 2^j t), j = 1..count: Hoelder theta at best."""
    t, f, integral = np.asarray(t, float), 0.0, 0.0
    for j in range(1, count + 1):
        turns = 2.0**j * t % 1.0
        f = f + 2 ** (-theta * j) * np.cos(2 * np.pi * turns)
        integral = integral + 2 ** (-theta * j) * np.sin(2 * np.pi * turns) / (2 * np.pi * 2.0**j)
    return f, integral


# ---------------------------------------------------------------------------------------------- dry friction


def _swing(tau, d0, v0, w, zeta):
    """Return (d, d') at tau after (d0, v0) for d'' + 2 zeta w d' + w^2 d = 0."""
    wd = w * np.sqrt(1 - zeta**2)
    decay, cos, sin = np.exp(-zeta * w * tau), np.cos(wd * tau), np.sin(wd * tau)
    d = decay * (d0 * cos + (v0 + zeta * w * d0) / wd * sin)
    return d, decay * (v0 * cos - (w**2 * d0 + zeta * w * v0) / wd * sin)


def _friction_phases(x0, v0, w, a, zeta, t_end=np.inf):
    """Return the slip phases [(start, x, v, sign)] and the final rest (time, x), (inf, nan) if not reached by t_end."""
    c, wd = a / w**2, w * np.sqrt(1 - zeta**2)
    time, x, v, phases = 0.0, float(x0), float(v0), []
    while time <= t_end:
        if v == 0 and abs(x) <= c:
            return phases, (time, x)
        sign = np.sign(v) if v != 0 else -np.sign(x)
        phases.append((time, x, v, sign))
        d = x + sign * c
        tau = np.pi / wd if v == 0 else np.mod(np.arctan2(wd * v, w**2 * d + zeta * w * v), np.pi) / wd
        x, v, time = _swing(tau, d, v, w, zeta)[0] - sign * c, 0.0, time + tau
    return phases, (np.inf, np.nan)


def friction_free(t, x0, v0=0.0, w=1.0, a=1.0, zeta=0.0):
    """Return (x, x') (N, 2) of x'' + 2 zeta w x' + w^2 x + a Sgn(x') ∋ 0, 0 <= zeta < 1, a > 0."""
    t = np.asarray(t, float)
    phases, (stop, rest) = _friction_phases(x0, v0, w, a, zeta, t.max(initial=0.0))
    out = np.empty((t.size, 2))
    for start, x, v, sign in phases:
        on = t >= start
        d, speed = _swing(t[on] - start, x + sign * a / w**2, v, w, zeta)
        out[on] = np.column_stack([d - sign * a / w**2, speed])
    out[t >= stop] = (rest, 0.0)
    return out


def friction_stop(x0, v0=0.0, w=1.0, a=1.0, zeta=0.0):
    """Return (T_stop, x_stop) of ``friction_free``."""
    return _friction_phases(x0, v0, w, a, zeta)[1]


def friction_stop_formula(x0, w=1.0, a=1.0):
    """Return (T_stop, x_stop) for zeta = 0 and v0 = 0, without following the phases."""
    c = a / w**2
    n = max(0, int(np.ceil((abs(x0) / c - 1) / 2)))
    return n * np.pi / w, (-1) ** n * np.sign(x0) * (abs(x0) - 2 * n * c)


def friction_forced(t, x0, v0=0.0, w=1.0, a=1.0, F=2.0, W=0.7):
    """Return (x, x') (N, 2) of x'' + w^2 x + a Sgn(x') ∋ F cos W t, W != w.

    Slip phases are closed forms; their ends are found as roots.
    """
    t = np.asarray(t, float)
    t_end, k, fine = t.max(initial=0.0), F / (w**2 - W**2), 0.01 * min(1 / w, 1 / W)
    time, x, v, out = 0.0, float(x0), float(v0), np.empty((t.size, 2))

    def first_root(function, start):
        """First sign change after ``start``, or inf; the function may vanish at ``start``."""
        grid = start + fine * np.arange(1, int((t_end - start) / fine) + 3)
        change = np.flatnonzero(np.diff(np.sign(function(grid))))
        return brentq(function, grid[change[0]], grid[change[0] + 1], xtol=1e-14) if change.size else np.inf

    while time <= t_end:
        force = F * np.cos(W * time) - w**2 * x
        if v == 0 and abs(force) <= a * (1 + 1e-12):
            bound = [first_root(lambda u, s=s, x=x: F * np.cos(W * u) - w**2 * x - s * a, time) for s in (1, -1)]
            leave, sign = min(bound), 1 if bound[0] <= bound[1] else -1
            out[t >= time] = (x, 0.0)
            time = leave
            if time > t_end:
                break
        else:
            sign = np.sign(v) if v != 0 else np.sign(force)
        P, Q = x + sign * a / w**2 - k * np.cos(W * time), (v + k * W * np.sin(W * time)) / w
        start = time

        def slip(u, P=P, Q=Q, start=start, sign=sign):
            angle = w * (u - start)
            return np.stack(
                [
                    -sign * a / w**2 + k * np.cos(W * u) + P * np.cos(angle) + Q * np.sin(angle),
                    -k * W * np.sin(W * u) + w * (Q * np.cos(angle) - P * np.sin(angle)),
                ],
                axis=-1,
            )

        on = t >= start
        out[on] = slip(t[on])
        time = first_root(lambda u, slip=slip: slip(u)[..., 1], start)
        if np.isfinite(time):
            x, v = slip(time)[0], 0.0
    return out


# ---------------------------------------------------------------------------------------------- relays


def sliding_relay_reach():
    """Return the time at which x1 + x2 = 0 is reached."""
    return brentq(lambda t: 2 - t - t**2 - np.sin(t) - np.cos(t), 0.1, 1.0, xtol=1e-15)


def sliding_relay(t):
    """Return (x1, x2) (N, 2) of x1' = x2, x2' = 2 l + sin t, l in -Sgn(x1 + x2), x(0) = (1, 0)."""
    t, reach = np.asarray(t, float), sliding_relay_reach()
    at_reach = 1 + reach - reach**2 - np.sin(reach)
    x1 = np.where(t < reach, 1 + t - t**2 - np.sin(t), at_reach * np.exp(-(t - reach)))
    return np.column_stack([x1, np.where(t < reach, 1 - 2 * t - np.cos(t), -x1)])


def sliding_relay_multiplier(t):
    """Return l (N,) of ``sliding_relay``: -1, then strictly inside (-1, 1)."""
    t = np.asarray(t, float)
    return np.where(t < sliding_relay_reach(), -1.0, -(sliding_relay(t)[:, 1] + np.sin(t)) / 2)


def _flow(M, x, t):
    """Return e^{M t} x (N, n) for a matrix with distinct eigenvalues."""
    values, vectors = np.linalg.eig(M)
    return ((np.exp(np.outer(t, values)) * np.linalg.solve(vectors, x)) @ vectors.T).real


def rlc_diode(t, L=1e-2, C=1e-6, R=1e3, start=10.0):
    """Return (v, i) (N, 2) of C v' = -i - max(v, 0)/R, L i' = v, from (start > 0, 0): two linear flows in turn."""
    t, time, x, conducts = np.asarray(t, float), 0.0, np.array([start, 0.0]), True
    fine, out = 0.01 * np.sqrt(L * C), np.empty((np.size(t), 2))
    while time <= t.max(initial=0.0):
        M = np.array([[-conducts / (R * C), -1 / C], [1 / L, 0]])
        on = t >= time
        out[on] = _flow(M, x, t[on] - time)
        grid = fine * np.arange(1, 2000)
        past = np.flatnonzero((_flow(M, x, grid)[:, 0] > 0) != conducts)[0]
        end = brentq(lambda s, M=M, x=x: _flow(M, x, [s])[0, 0], grid[past - 1], grid[past], xtol=1e-18)
        x, time, conducts = np.array([0.0, _flow(M, x, [end])[0, 1]]), time + end, not conducts
    return out


def zener_limited(t, Vm=12.0, f=50.0, tau=2e-3, low=-0.7, high=5.1):
    """Return u (N, 1) of tau u' = Vm sin wt - u kept in [low, high], periodic: held, let go, met again, end by end."""
    w, t = 2 * np.pi * f, np.asarray(t, float)
    swing = Vm / (1 + 1j * w * tau)
    first, second = (np.pi - np.arcsin(high / Vm)) / w, (2 * np.pi - np.arcsin(-low / Vm)) / w

    def arc(s, begin, value):
        return (swing * np.exp(1j * w * s)).imag + np.exp((begin - s) / tau) * (value - (swing * np.exp(1j * w * begin)).imag)

    last = brentq(lambda s: arc(s, first, high) - low, first, second, xtol=1e-18)
    again = brentq(lambda s: arc(s, second, low) - high, second, first + 1 / f, xtol=1e-18)
    s = first + (t - first) % (1 / f)
    parts = [arc(s, first, high), low + 0 * s, arc(s, second, low)]
    return np.select([s < last, s < second, s < again], parts, high)[:, None]


def diode_bridge(t, L=1e-2, C=1e-6, R=1e3, start=10.0):
    """Return (v, i) (N, 2) of the bridge: behind four ideal diodes the resistor takes v/R for either sign of v."""
    return _flow(np.array([[-1 / (R * C), -1 / C], [1 / L, 0]]), [start, 0], np.asarray(t, float))


def cone_start(t, kind, zv=0.3):
    """Return x (N, 3) of x' = l, y = x + D l, l and y in the second-order cone K of R^3, D of rank one; see ``cone_D``.

    In the coordinates (u, v, w) = ((l_1 + l_2), (l_1 - l_2), sqrt(2) l_3)/sqrt(2), K is 2 u v >= w^2, and z = (z_u, z_v, z_w)
    is x. "u": D acts on u, z(0) = (0, zv, 1), u = max(z_w^2/(2 z_v) - z_u, 0), v = u z_w^2/(2 z_v^2), w = -u z_w/z_v.
    "w": D acts on w, z(0) = (zv, 1, 1), -w = max(z_w - sqrt(2 z_u z_v), 0), u = -w sqrt(z_v/(2 z_u)), v = -w sqrt(z_u/(2 z_v)).
    zv = 0 starts on the boundary, where the velocity is infinite: the first instant is its expansion.
    """
    t, first = np.asarray(t, float), 1e-14

    def on_u(_, z):
        u = max(z[2] ** 2 / (2 * z[1]) - z[0], 0)
        return [u, u * z[2] ** 2 / (2 * z[1] ** 2), -u * z[2] / z[1]]

    def on_w(_, z):
        w = max(z[2] - np.sqrt(2 * z[0] * z[1]), 0)
        return [w * np.sqrt(z[1] / (2 * z[0])), w * np.sqrt(z[0] / (2 * z[1])), -w]

    if kind == "u":
        z0 = [0, zv, 1] if zv else [2 / 3 * first**0.75, first**0.25, 1 - first**0.5]
    else:
        z0 = [zv, 1, 1] if zv else [(1.5 * first / np.sqrt(2)) ** (2 / 3), 1, 1]
    begin = 0.0 if zv else first
    rate = on_u if kind == "u" else on_w
    found = solve_ivp(rate, (begin, t.max()), z0, method="LSODA", rtol=1e-11, atol=1e-13, dense_output=True)
    return found.sol(np.maximum(t, begin)).T @ CONE


CONE = np.array([[1, 1, 0], [1, -1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)  # (u, v, w) = CONE l, symmetric and orthogonal


def turning_on_a_cone(t, push, drift):
    """Return x (N, 3) that turns with speed 1 about the axis of the cone |(x_2, x_3)| <= x_1 and is pushed through its surface.

    Along (-1, e), e = (x_2, x_3)/|(x_2, x_3)|, by p = push (cos t + drift), from (1, 1, 0). On the surface l = max(p, 0) (1, -e):
    x_1 = 1 + M - P, |(x_2, x_3)| = 1 + P - M, with P = int p and M its largest value so far (Skorokhod).
    """
    P = lambda s: push * (np.sin(s) + drift * s)  # noqa: E731
    top = np.arccos(-drift)
    last = top + 2 * np.pi * np.floor((t - top) / (2 * np.pi))
    M = np.where(last > 0, np.maximum(P(t), P(last)), P(t))
    return np.column_stack([1 + M - P(t), (1 + P(t) - M) * np.cos(t), (1 + P(t) - M) * np.sin(t)])


def ball_rest(height=1.0, speed=5.0, restitution=1 / 3, G=9.81):
    """Return (time of the first impact, its speed, time from which the ball lies still)."""
    impact = np.sqrt(speed**2 + 2 * G * height)
    first = (speed + impact) / G
    return first, impact, first + 2 * impact / G * restitution / (1 - restitution)


def bouncing_ball(t, height=1.0, speed=5.0, restitution=1 / 3, G=9.81):
    """Return (height, velocity, number of impacts so far) (N, 3) of a ball thrown up; (0, 0, inf) at rest."""
    t = np.asarray(t, float)
    first, impact, rest = ball_rest(height, speed, restitution, G)
    out = np.zeros((t.size, 3))
    start, y, v, k = 0.0, height, speed, 0
    while start < rest:
        flight = first if k == 0 else 2 * v / G
        on = (t >= start) & (t < min(start + flight, rest))
        tau = t[on] - start
        out[on] = np.column_stack([y + v * tau - G * tau**2 / 2, v - G * tau, np.full(tau.size, k)])
        k += 1
        if start + flight == start:
            break
        start, y, v = start + flight, 0.0, impact * restitution**k
    out[t >= rest] = (0, 0, np.inf)
    return out


def zhuravlev_ivanov(t, kappa=0.5, G=9.81, x0=(1.0, 10.0)):
    """Return x (N, 2) of the transformed ball: x_1 = s height, s x_2 (1 - kappa sgn(s x_2)) = velocity, s = +-1.

    s changes sign at each impact. With s = sgn x_1, p = s x_2: |x_1|' = p (1 - kappa sgn p), p' = -G/(1 - kappa sgn p),
    so that |x_1|'' = -G, and at an impact p changes sign with x_2 continuous: the speed is |p| (1 + kappa) before it,
    |p| (1 - kappa) after it.
    """
    y, v, impacts = bouncing_ball(t, x0[0], x0[1] * (1 - kappa), (1 - kappa) / (1 + kappa), G).T
    side = np.where(np.isfinite(impacts), (-1.0) ** np.where(np.isfinite(impacts), impacts, 0), 0)
    return np.column_stack([side * y, side * v / (1 - kappa * np.sign(v))])


# ---------------------------------------------------------------------------------------------- monotone inclusions


def inclusion_8_1(t, a=1.0, b=-1.0, x0=2.0):
    """Return x (N, 1) of x' = b - (1 + a) x kept >= 0, a >= 0, x0 >= 0."""
    rest = b / (1 + a)
    return np.maximum(rest + (x0 - rest) * np.exp(-(1 + a) * np.asarray(t, float)), 0)[:, None]


def inclusion_8_2_diagonal(t, K, b, mu, lower, upper, x0):
    """Return x (N, n) of x_i' in b_i - K_i x_i - mu_i Sgn(x_i) - N_[lower_i, upper_i](x_i), K_i > 0, x0 in the box."""
    t = np.asarray(t, float)
    columns = []
    for k, f, m, lo, up, start in np.broadcast(K, b, mu, lower, upper, x0):
        side = np.sign(start)
        goal = (f - side * m) / k
        zero = np.log1p(-start / goal) / k if goal * side < 0 else 0.0 if side == 0 else np.inf
        rest = np.sign(f) * max(abs(f) - m, 0) / k
        x = np.where(t < zero, goal + (start - goal) * np.exp(-k * t), rest * -np.expm1(-k * np.maximum(t - zero, 0)))
        columns.append(np.clip(x, lo, up))
    return np.column_stack(columns)


def inside_disc(t, x0=-0.5, y0=0.6):
    """Return x (N, 2) carried with velocity (1, 0) inside the unit disc: free, then along the circle towards (1, 0)."""
    t, meets = np.asarray(t, float), np.sqrt(1 - y0**2)
    angle = 2 * np.arctan(np.tan(np.arcsin(y0) / 2) * np.exp(-np.maximum(t - (meets - x0), 0)))
    free = t < meets - x0
    return np.column_stack([np.where(free, x0 + t, np.cos(angle)), np.where(free, y0, np.sin(angle))])


def _slope_interval(x, mu, lower, upper):
    """Return the ends of mu Sgn(x) + N_[lower, upper](x), componentwise."""
    low = np.where(x > 0, mu, -mu)
    high = np.where(x < 0, -mu, mu)
    return np.where(x <= lower, -np.inf, low), np.where(x >= upper, np.inf, high)


def inclusion_8_2_velocity(x, K, b, mu, lower, upper):
    """Return the right derivative (n,) at x: the element of least norm of b - K x - mu Sgn(x) - N(x)."""
    low, high = _slope_interval(np.asarray(x, float), mu, lower, upper)
    drive = b - K @ x
    return np.maximum(drive - high, 0) + np.minimum(drive - low, 0)


def inclusion_8_2_equilibrium(K, b, mu, lower, upper):
    """Return the minimiser (n,) of x'Kx/2 - b'x + sum mu |x| on the box, by trying all 5^n cases."""
    K, n = np.asarray(K, float), len(b)
    mu, lower, upper = (np.broadcast_to(np.asarray(v, float), (n,)) for v in (mu, lower, upper))
    best, residual = None, np.inf
    for case in itertools.product(range(5), repeat=n):
        case = np.array(case)
        free = case < 2
        side = np.where(case == 0, 1.0, -1.0)
        x = np.select([case == 2, case == 3], [lower, upper], 0.0)
        if free.any():
            right = (b - side * mu - K @ x)[free]
            x[free] = np.linalg.solve(K[np.ix_(free, free)], right)
        if np.any(x < lower) or np.any(x > upper) or np.any(free & (side * x < 0)):
            continue
        worst = np.abs(inclusion_8_2_velocity(x, K, b, mu, lower, upper)).max()
        if worst < residual:
            best, residual = x, worst
    if residual > 1e-10:
        raise ArithmeticError(f"no case is an equilibrium: least residual {residual:g}")
    return best


def inclusion_8_2_reference(t, K, b, mu, lower, upper, x0):
    """Return x (N, n) for a symmetric positive definite K, to about 1e-12: exact exponentials between events.

    In each interval the held components (stuck at 0 or at a bound) are constant and the free ones solve a linear
    equation; an interval ends when a free component comes to 0 or to a bound, or when a held one is torn off.
    """
    t, K = np.asarray(t, float), np.asarray(K, float)
    n, t_end = len(b), t.max(initial=0.0)
    mu, lower, upper = (np.broadcast_to(np.asarray(v, float), (n,)) for v in (mu, lower, upper))
    x, time, out, torn = np.array(x0, float), 0.0, np.empty((t.size, n)), {}
    fine = 0.05 / np.linalg.eigvalsh(K).max()
    for _ in range(1000):
        low, high = _slope_interval(x, mu, lower, upper)
        velocity = inclusion_8_2_velocity(x, K, b, mu, lower, upper)
        free = (velocity != 0) | (low == high)
        slope = np.where(velocity > 0, high, low)
        for i, up in torn.items():
            free[i], slope[i] = True, high[i] if up else low[i]
        state = _linear_flow(time, x, free, slope, K, b)
        on = t >= time
        out[on] = state(t[on])
        events = _events(x, free, slope, low, high, lower, upper, state, K, b)
        time, hit = _first_event(events, time, t_end, fine)
        if hit is None:
            return out
        kind, i, value = hit
        x, torn = state(np.array([time]))[0], {}
        if kind == "arrives":
            x[i] = value
        else:
            torn = {i: value}
    raise ArithmeticError(f"more than 1000 events up to t = {time:g}")


def _linear_flow(time, x, free, slope, K, b):
    """Return the state as a function of times (N,) -> (N, n) while the free components keep their slope."""
    lam, V = np.linalg.eigh(K[np.ix_(free, free)])
    goal = V.T @ (b - slope - K[:, ~free] @ x[~free])[free] / lam
    start = V.T @ x[free]

    def state(times):
        out = np.tile(x, (np.size(times), 1))
        if free.any():
            tau = np.reshape(times, (-1, 1)) - time
            out[:, free] = (start * np.exp(-lam * tau) - goal * np.expm1(-lam * tau)) @ V.T
        return out

    return state


def _events(x, free, slope, low, high, lower, upper, state, K, b):
    """Return [(what, function of times)]: each function is >= 0 until its event."""
    events = []
    for i in np.flatnonzero(free):
        side = np.sign(x[i]) or np.sign(slope[i])
        for value, sign in ((lower[i], 1), (upper[i], -1), (0.0, side)):
            if np.isfinite(value) and lower[i] <= value <= upper[i] and sign != 0:
                events.append((("arrives", i, value), lambda s, i=i, v=value, g=sign: g * (state(s)[:, i] - v)))
    for i in np.flatnonzero(~free):
        if np.isfinite(high[i]):
            events.append((("torn", i, True), lambda s, i=i: high[i] - b[i] + state(s) @ K[i]))
        if np.isfinite(low[i]):
            events.append((("torn", i, False), lambda s, i=i: b[i] - state(s) @ K[i] - low[i]))
    return events


def _first_event(events, time, t_end, fine):
    """Return (time, what) of the first event; an event function may vanish at the start of the interval."""
    grid = time + fine * np.arange(1, max(int((t_end - time) / fine), 0) + 3)
    first, hit = np.inf, None
    for what, function in events:
        below = np.flatnonzero(function(grid) < -1e-14)
        if not below.size or grid[below[0]] > first + fine:
            continue
        j = below[0]
        left = grid[j - 1] if j else time
        if function(np.array([left]))[0] > 0:
            root = brentq(lambda s, function=function: function(np.array([s]))[0], left, grid[j], xtol=1e-15)
        else:
            root = left
        if root < first:
            first, hit = root, what
    return (first, hit) if first <= t_end else (np.inf, None)


# ---------------------------------------------------------------------------------------------- driven scenes


def rectified(t, alpha=0.0, Vm=325.0, R=10.0, L=0.05, f=50.0):
    """Return the current (N, 1) of R and L on sin 2 pi f t, behind a thyristor fired at the angle alpha; at 0 it is a diode."""
    steady = Vm / (R + 2j * np.pi * f * L)

    def current(a):
        return (steady * (np.exp(1j * a) - np.exp(1j * alpha - (a - alpha) * R / (2 * np.pi * f * L)))).imag

    end = brentq(current, np.pi, 2 * np.pi - 1e-6, xtol=1e-14)
    a = 2 * np.pi * np.mod(f * np.asarray(t), 1)
    return np.where((a > alpha) & (a < end), current(a), 0)[:, None]


def to_and_fro(t, x, low, high, down, up, tau):
    """Return x (N, 1) of tau x' = goal - x: the goal is ``up`` until x = high, then ``down`` until x = low, and so on."""
    t = np.asarray(t, float)
    found, begin, now, then = np.empty(t.shape), 0.0, (up, high), (down, low)
    while begin <= t[-1]:
        goal, end = now
        later = t >= begin
        found[later] = goal + (x - goal) * np.exp(-(t[later] - begin) / tau)
        begin, x, now, then = begin + tau * np.log((goal - x) / (goal - end)), end, then, now
    return found[:, None]


def bang_bang(t, force=2.0, F=0.5):
    """Return v and p (N, 2) of a unit mass that goes one metre against friction F: straight lines of v, and their areas."""
    up, down = force - F, force + F
    peak = np.sqrt(2 * up * down / (up + down))
    knots, speeds = np.cumsum([0, peak / up, peak / down, 10]), np.array([0, peak, 0, 0])
    v = np.interp(t, knots, speeds)
    p = [np.trapezoid(np.r_[speeds[knots < s], w], np.r_[knots[knots < s], s]) for s, w in zip(t, v, strict=True)]
    return np.column_stack([v, p])


# ---------------------------------------------------------------------------------------------- control, friction, hysteresis


def twisting(t, a=5.0, b=3.0, v=4.0):
    """Return p and v (N, 2) of p'' = -a Sgn(p) - b Sgn(p'), from p = 0: parabolas, one quarter of the plane after the other."""
    t, rows, begin, p = np.asarray(t, float), np.zeros((np.size(t), 2)), 0.0, 0.0
    while abs(v) > 1e-300:
        for force in (-(a + b) * np.sign(v), -(a - b) * np.sign(v)):
            now = np.maximum(t - begin, 0)
            rows[t >= begin] = np.column_stack([p + v * now + force * now**2 / 2, v + force * now])[t >= begin]
            lasts = -v / force if p == 0 else np.sqrt(-2 * p / force)
            p, v, begin = (p + v * lasts / 2, 0.0, begin + lasts) if p == 0 else (0.0, force * lasts, begin + lasts)
    rows[t >= begin] = 0
    return rows


def two_surfaces(t, start=(2.0, 1.0)):
    """Return x (N, 2) of x' = B l + (sin t, cos t)/2, l in -Sgn(x), B = [[2, 1], [1, 2]]; x_2 is 0 first."""
    t = np.asarray(t, float)
    first = brentq(lambda s: start[1] - 3 * s + np.sin(s) / 2, 0, 1, xtol=1e-15)
    falls = lambda s: start[0] - 3 * s + (1 - np.cos(s)) / 2  # noqa: E731
    slides = lambda s: falls(first) - 1.5 * (s - first) - (np.cos(s) - np.cos(first)) / 2 - (np.sin(s) - np.sin(first)) / 4  # noqa: E731
    second = brentq(slides, first, 2, xtol=1e-15)
    x1 = np.where(t < first, falls(t), np.where(t < second, slides(t), 0))
    return np.column_stack([x1, np.where(t < first, start[1] - 3 * t + np.sin(t) / 2, 0)])


def belt(t, F=1.0, d=0.2, V=0.5):
    """Return p and v (N, 2) of p'' + p = d (p' - V) - F Sgn(p' - V), from p = 0 on the belt: ride and slip in turn."""
    t, rows, begin, p = np.asarray(t, float), np.empty((np.size(t), 2)), 0.0, 0.0
    middle = F - d * V
    speed = lambda tau: _swing(tau, F - middle, V, 1.0, -d / 2)[1]  # noqa: E731
    slips = brentq(lambda tau: speed(tau) - V, np.pi, 2 * np.pi, xtol=1e-15)
    while begin <= t.max():
        torn = begin + (F - p) / V
        rows[t >= begin] = np.column_stack([p + V * (t - begin), np.full(t.size, V)])[t >= begin]
        x, v = _swing(t - torn, F - middle, V, 1.0, -d / 2)
        rows[t >= torn] = np.column_stack([x + middle, v])[t >= torn]
        begin, p = torn + slips, _swing(slips, F - middle, V, 1.0, -d / 2)[0] + middle
    return rows


def stop_operators(t, turns, stiffness, limits):
    """Return u and the force of each spring with a slider (N, 1 + n): k (u - play of u), the sliders moved from turn to turn."""
    at = np.concatenate([[0], np.cumsum(np.abs(np.diff(turns)))])
    rows = []
    for now in np.asarray(t, float):
        u, plays = np.interp(now, at, turns), np.zeros(len(limits))
        for place in [*np.array(turns)[at < now], u]:
            plays = np.maximum(np.minimum(plays, place + np.divide(limits, stiffness)), place - np.divide(limits, stiffness))
        rows.append([u, *np.multiply(stiffness, u - plays)])
    return np.array(rows)


def leash(t, corners, start, r=1.0):
    """Return q (N, 2) dragged behind a hand that goes along straight lines at speed 1: tractrices in tanh and sech."""
    t, z, begin = np.asarray(t, float), complex(*start), 0.0
    rows, places = np.empty(t.size, complex), [complex(*place) for place in corners]
    for hand, goal in itertools.pairwise(places):
        length = abs(goal - hand)
        ahead = (goal - hand) / length
        d = (z - hand) / ahead  # seen by who walks
        taut = max(d.real + np.sqrt(max(r**2 - d.imag**2, 0)), 0)
        behind = np.arctanh(min((taut - d.real) / r, 1 - 1e-16))

        def place(s, hand=hand, ahead=ahead, d=d, taut=taut, behind=behind):
            sigma = behind + np.maximum(s - taut, 0) / r
            pulled = s - r * np.tanh(sigma) + 1j * np.sign(d.imag) * r / np.cosh(sigma)
            return hand + ahead * np.where(s <= taut, d, pulled)

        rows[t >= begin] = place(t[t >= begin] - begin)
        z, begin = complex(place(np.array(length))), begin + length
    return np.column_stack([rows.real, rows.imag])


def sandpile(t, n=12, first=3, second=8, change=16.0):
    """Return the heights (N, n) of sand poured on one cell, then on another: cones of the volume t, by bisection."""
    cells, cone = np.arange(n), lambda top, place: np.maximum(top - np.abs(np.arange(n) - place), 0)
    old = cone(brentq(lambda top: cone(top, first).sum() - change, 0, n, xtol=1e-14), first)
    rows = np.empty((np.size(t), cells.size))
    for row, now in zip(rows, t, strict=True):
        under, place = (0 * old, first) if now <= change else (old, second)
        height = lambda top, under=under, place=place: np.maximum(cone(top, place), under)  # noqa: E731
        row[:] = height(brentq(lambda top, height=height, now=now: height(top).sum() - now, 0, 3 * n, xtol=1e-14))
    return rows


def tumbler(t, a=1.0, c=4.0, w=1.0):
    """Return q (N, 2) of what sinks at c in a square drum that turns at w, from the corner at the bottom, seen from the drum."""
    t, rows, begin, wall, turned = np.asarray(t, float), np.empty(np.size(t), complex), 0.0, 0, -3 * np.pi / 4
    force = lambda s, wall: -1j * c * np.exp(-1j * (turned + wall * np.pi / 2 + w * s))  # out of the wall + 1j along it  # noqa: E731
    while begin <= t.max():
        bears = lambda s, wall=wall: (force(s, wall + 1) - 1j * w * (a - 1j * a)).real  # the wall ahead  # noqa: E731
        leaves = brentq(bears, begin, begin + 1, xtol=1e-15)
        rows[t >= begin] = (a * (1 + 1j) * np.exp(1j * (turned + wall * np.pi / 2 + w * t)))[t >= begin]

        def along(s, leaves=leaves, wall=wall):
            return a - w * a * (s - leaves) + ((force(s, wall) - force(leaves, wall)) / (-1j * w)).imag

        arrives = brentq(lambda s, along=along: along(s) + a, leaves + 0.1, leaves + 2, xtol=1e-15)
        rows[t >= leaves] = ((a + 1j * along(t)) * np.exp(1j * (turned + wall * np.pi / 2 + w * t)))[t >= leaves]
        begin, wall = arrives, wall - 1
    return np.column_stack([rows.real, rows.imag])
