"""Errors and orders of scenes of mechanics with contact, by fits over steps that are no multiples of each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from scipy.special import ellipj

from nsmodel import Contact, MechanicalSystem, load, simulate

G = 9.81
S = ca.SX.sym
PLAIN = {"activation": 0.5, "project": False}


@dataclass(frozen=True)
class Scene:
    """A model for a step, its exact positions at times (N,), the end, and the longest step.

    ``order`` is between which numbers a fit lies, ``least`` the largest error allowed at the shortest step.
    """

    model: Callable[..., MechanicalSystem]
    exact: Callable[[np.ndarray], np.ndarray]
    T: float
    first: float
    order: tuple[float, float]
    least: float
    part: float | None = None
    end_only: bool = False

    def steps(self, count):
        """Steps that divide T, or a part of it, none a multiple of another one."""
        part = self.part or self.T
        return [part / round(part / (self.first / 1.29**k)) for k in range(count)]

    def error(self, step, **options):
        """The largest error of positions, at all times or at the end."""
        run = simulate(self.model(step, self.T, **options))
        found = np.abs(run.q.reshape(len(run.t), -1) - self.exact(run.t))
        return (found[-1] if self.end_only else found).max()


def on_a_line(force=0, wall=None, e=0.0, q0=1.0, v0=0.0, M=1):
    def made(step, T, **options):
        q, v = S("height"), S("speed")
        F, gap = (part(q) if callable(part) else part for part in (force, wall or (lambda q: q)))
        start = {"q0": q0, "v0": v0, "t_end": T, "step": step}
        return MechanicalSystem(q=q, v=v, M=M, F=F, contacts={"wall": Contact(gap, e=e)}, **start, **options)

    return made


def column(f):
    return lambda t: f(t)[:, None]


def bouncing(e):
    """The height of a ball that falls from 1; 0 after the last impact."""

    def exact(t):
        first = np.sqrt(2 / G)
        height = np.where(t <= first, 1 - G * t**2 / 2, 0.0)
        begin, speed = first, e * np.sqrt(2 * G)
        while speed > 1e-12 and begin <= t[-1]:
            s = t - begin
            height = np.where((s > 0) & (s <= 2 * speed / G), speed * s - G * s**2 / 2, height)
            begin, speed = begin + 2 * speed / G, e * speed
        return height

    return column(exact)


def billiard(step, T, **options):
    q, v = S("p", 2), S("w", 2)
    gaps = {"left": q[0], "right": 1 - q[0], "bottom": q[1], "top": 0.7 - q[1]}
    walls = {name: Contact(gap, e=1) for name, gap in gaps.items()}
    return MechanicalSystem(q=q, v=v, M=1, contacts=walls, q0=[0.3, 0.2], v0=[1.3, 0.9], t_end=T, step=step, **options)


def unfolded(t):
    x, L = np.array([0.3, 0.2]) + t[:, None] * [1.3, 0.9], np.array([1.0, 0.7])
    return L - np.abs(np.mod(x, 2 * L) - L)


def grazing(a, e=0.5):
    def exact(t):
        x = -a * np.cos(t)
        if a > 1:
            s = t - (np.pi - np.arccos(1 / a))
            x = np.where(s > 0, np.cos(s) - e * np.sqrt(a**2 - 1) * np.sin(s), x)
        return x

    return on_a_line(lambda q: -q, lambda q: 1 - q, e, -a), column(exact)


def on_a_floor(force, slip, mu, v0=0.0, q0=(0.0, 0.0)):
    def made(step, T, **options):
        q, v = S("p", 2), S("w", 2)
        floor = Contact(q[1], slip=slip(v), mu=mu)
        start = {"q0": list(q0), "v0": [v0, 0], "t_end": T, "step": step}
        return MechanicalSystem(q=q, v=v, M=1, F=force(q), contacts={"floor": floor}, **start, **options)

    return made


def bowling(step, T, **options):
    R = 0.11
    q, v = S("p", 3), S("w", 3)
    lane = Contact(q[1] - R, slip=v[0] + R * v[2], mu=0.2)
    start = {"q0": [0, R, 0], "v0": [3, 0, 0], "t_end": T, "step": step}
    return MechanicalSystem(q=q, v=v, M=[1, 1, 0.4 * R**2], F=[0, -G, 0], contacts={"lane": lane}, **start, **options)


def rolled(t):
    """Rolls from 2 v0/(7 mu g) on; x alone is compared, the turning follows."""
    mu, v0 = 0.2, 3.0
    roll = 2 * v0 / (7 * mu * G)
    x = np.where(t < roll, v0 * t - mu * G * t**2 / 2, v0 * roll - mu * G * roll**2 / 2 + 5 / 7 * v0 * (t - roll))
    turned = np.where(t < roll, -mu * G * t**2 / (0.8 * 0.11), -mu * G * roll**2 / 0.088 - 5 / 7 * v0 / 0.11 * (t - roll))
    return np.stack([x, 0 * t + 0.11, turned], axis=1)


def across(step, T, **options):
    a = np.deg2rad(20)
    q, v = S("p", 3), S("w", 3)
    floor = Contact(q[2], slip=v[:2], mu=np.tan(a))
    start = {"q0": [0, 0, 0], "v0": [0, 2, 0], "t_end": T, "step": step}
    return MechanicalSystem(q=q, v=v, M=1, F=[G * np.sin(a), 0, -G * np.cos(a)], contacts={"floor": floor}, **start, **options)


def stopping(t):
    x = np.where(t < np.pi, 1 + 4.3 * np.cos(t), np.where(t < 2 * np.pi, -1 + 2.3 * np.cos(t), 1 + 0.3 * np.cos(t)))
    return np.stack([np.where(t >= 3 * np.pi, 0.7, x), 0 * t], axis=1)


def double_pendulum(step, T, **options):
    q, v = S("p", 2), S("w", 2)
    c = ca.cos(q[0] - q[1])
    M, weight = ca.vertcat(ca.horzcat(2, c), ca.horzcat(c, 1)), ca.vertcat(-20 * ca.sin(q[0]), -10 * ca.sin(q[1]))
    wall = Contact(ca.sin(q[0]) + ca.sin(q[1]) + 0.2, e=0.8)
    return MechanicalSystem(q=q, v=v, M=M, F=weight, contacts={"wall": wall}, q0=[0.6, 0.9], t_end=T, step=step, **options)


def rod(step, T, **options):
    q, v = S("p", 2), S("w", 2)
    joints = {"rod": (ca.sumsqr(q) - 1) / 2}
    return MechanicalSystem(q=q, v=v, M=1, F=[0, -1], joints=joints, q0=[1, 0], t_end=T, step=step, **options)


def swinging(t):
    """sin(angle/2) = k cd(t), k = sin(45 degrees)."""
    _, c, d, _ = ellipj(t, 0.5)
    angle = 2 * np.arcsin(np.sqrt(0.5) * c / d)
    return np.stack([np.sin(angle), -np.cos(angle)], axis=1)


w, phi = 2 * np.pi, np.deg2rad(25)
IMPACT, SMOOTH = (0.8, 1.25), (1.85, 2.6)
SCENES = {
    "ball, e = 1/2": Scene(on_a_line(-G, e=0.5), bouncing(0.5), 3.0, 2e-2, IMPACT, 1.1e-2),
    "ball, e = 0": Scene(on_a_line(-G, e=0.0), bouncing(0.0), 3.0, 2e-2, IMPACT, 6e-3),
    "ball, e = 1": Scene(on_a_line(-G, e=1.0), bouncing(1.0), 3.0, 2e-2, IMPACT, 6e-2),
    "billiard": Scene(billiard, unfolded, 10.0, 2e-2, IMPACT, 6e-2),
    "block that stops": Scene(
        on_a_floor(lambda q: [G * np.sin(phi), -G * np.cos(phi)], lambda v: v[0], 0.5, -2.0),
        lambda t: np.array([[-2 / (G * (np.sin(phi) + 0.5 * np.cos(phi))), 0.0]]), 1.5, 2e-2, (0.9, 2.2), 1e-4, end_only=True,
    ),
    "block on a belt": Scene(
        on_a_floor(lambda q: [0, -G], lambda v: v[0] - 1.2, 0.3),
        lambda t: np.stack([1.2 * t - 1.2**2 / (0.6 * G), 0 * t], axis=1), 1.0, 2e-2, (0.9, 2.2), 1e-3, end_only=True,
    ),
    "bowling ball": Scene(bowling, rolled, 1.0, 1e-2, SMOOTH, 3e-3, end_only=True),
    "slip that turns": Scene(
        across, lambda t: np.array([[0.405290527, 0.673975163, 0.0]]), 0.622742891, 2e-2, (0.9, 1.1), 1.1e-3, end_only=True,
    ),
    "oscillator, e = 1": Scene(
        on_a_line(lambda q: -(w**2) * q, e=1.0, q0=0.0, v0=1.0),
        column(lambda t: np.abs(np.sin(w * t)) / w), 3.3, 5e-3, IMPACT, 3e-3,
    ),
    "oscillator, e = 0.8": Scene(
        on_a_line(lambda q: -(w**2) * q, e=0.8, q0=0.0, v0=1.0),
        column(lambda t: 0.8 ** np.floor(w * t / np.pi + 1e-12) * np.abs(np.sin(w * t)) / w), 3.3, 5e-3, IMPACT, 1e-3,
    ),
    "no impact": Scene(*grazing(0.9), 6.0, 2e-2, (1.9, 2.1), 2e-6),
    "nearly grazing": Scene(*grazing(1.01), 6.0, 1e-2, (0.6, 1.25), 1.8e-3),
    "deep impact": Scene(*grazing(1.5), 6.0, 1e-2, (0.6, 1.6), 3e-3),
    "block on a spring": Scene(on_a_floor(lambda q: [-q[0], -1], lambda v: v[0], 1.0, q0=(5.3, 0.0)), stopping,
                               4 * np.pi, np.pi / 30, (1.9, 2.1), 8e-5, part=np.pi),
    "double pendulum": Scene(double_pendulum, lambda t: np.array([[0.083533180, 0.150613940]]), 2.0, 7e-3, (0.7, 1.6), 1e-3,
                             end_only=True),
    "point on a rod": Scene(rod, swinging, 7.416298709205487, 4e-2, (1.9, 2.1), 1e-4),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_orders_by_twelve_steps(name):
    scene = SCENES[name]
    steps = scene.steps(12)
    errors = [scene.error(step, **PLAIN) for step in steps]
    low, high = scene.order
    assert low <= np.polyfit(np.log(steps), np.log(errors), 1)[0] <= high
    assert errors[-1] <= scene.least


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_the_defaults_err_no_more(name):
    """Contacts of steps free of them, positions put back. A ball with e = 0 is put back to where a free step would be: O(h)."""
    scene = SCENES[name]
    for step in scene.steps(12)[2::4]:
        assert scene.error(step) <= (2.0 if name == "ball, e = 0" else 1.5) * scene.error(step, **PLAIN)


def crank(step, T, q0=(0.0, 0.0, 0.0), **options):
    return replace(load("slider_crank"), step=step, t_end=T, q0=list(q0), **options)


def test_a_crank_without_impacts_has_order_two():
    """Until its first impact at 2.8 ms, against steps of 1 us."""
    exact = simulate(crank(1e-6, 2.5e-3), compiled=True).q[-1]
    steps = [2.5e-3 / count for count in (20, 31, 47, 73, 110)]
    errors = [np.abs(simulate(crank(step, 2.5e-3, **PLAIN)).q[-1] - exact).max() for step in steps]
    assert 1.95 <= np.polyfit(np.log(steps), np.log(errors), 1)[0] <= 2.05


@pytest.mark.parametrize("tilt", [0.0, 0.01])
def test_corners_of_a_crank_penetrate_nowhere(tilt):
    """For 0.2 s, eight corners' rows of rank 2 or 3."""
    run = simulate(crank(1e-4, 0.2, (0.0, 0.0, tilt)), compiled=True)
    assert run.status == "done"
    assert run.penetration.max() <= 1e-14 * 0.459  # of the length of crank and rod
    first = run.t[(np.nan_to_num(run.acting) > 0).any(axis=1)][0]
    assert 2.65e-3 <= first <= 2.85e-3 or tilt


def test_a_ball_that_hooks_rolls_with_what_coriolis_says():
    run = simulate(load("hook_ball"))
    np.testing.assert_allclose(run.v[-1, :3], [8 - 12 / 7, -4.4 / 7, 0], atol=1e-12)
    slip = run.v[:, :2] + 0.108 * np.column_stack([-run.v[:, 4], run.v[:, 3]])
    sliding = run.t < 0.93
    np.testing.assert_allclose(np.arctan2(*slip[sliding].T), np.arctan2(6.0, 2.2), atol=1e-12)
    assert np.abs(slip[run.t > 0.934]).max() <= 1e-12
