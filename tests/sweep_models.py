"""Models that are swept, with exact answers."""

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, MonotoneInclusion, SweepingProcess, pwm, relay

K, A, X0, T = ca.SX.sym("k"), ca.SX.sym("a"), ca.SX.sym("x0"), ca.SX.sym("t")


def friction(**options):
    """x'' + a Sgn(x') + k x = 0 from x0 at rest, as a Lur'e system; `stopped` knows its end."""
    given = {"x0": [X0, 0], "parameters": {A: 1, K: 1, X0: 5.3}, "t_end": 12.0, "step": 1e-2} | options
    return LureSystem(
        names=["x_1", "v_1"], A=ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-K, 0)), B=ca.vertcat(0, A), C=[[0, 1]], D=0,
        law=relay(1), theta=0.5, gamma=0.5, title="oscillator with friction",
        units={"x_1": "m", "v_1": "m/s", "t": "s"}, **given,
    )  # fmt: skip


def stopped(a, k, x0):
    """Where the oscillator rests, and when."""
    n = np.ceil((x0 * k / a - 1) / 2)
    return (-1) ** n * (x0 - 2 * n * a / k), n * np.pi / np.sqrt(k)


def crossing(**options):
    """x' in 2 - Sgn(x) from x0 < 0: x(T) = T + x0/3 for T > -x0/3."""
    return LureSystem(
        names=["x_1"], A=[[0]], B=[[1]], C=[[1]], D=0, f=[2], law=relay(1), x0=[X0], parameters={X0: -1}, t_end=2.0,
        step=1e-2, title="crossing", **options,
    )  # fmt: skip


def play(**options):
    """q' + N(q >= a sin t) contains 1 - k."""
    q = ca.SX.sym("q")
    return SweepingProcess(
        t=T, q=q, f=-(K - 1), constraints={"wall": q - A * ca.sin(T)}, q0=[X0], parameters={A: 1, K: 1, X0: 0}, t_end=2.0,
        step=1e-3, title="play", **options,
    )  # fmt: skip


def with_stop():
    """Play between a wall that moves up to a and a stop at 0.7."""
    q = ca.SX.sym("q")
    return SweepingProcess(
        t=T, q=q, constraints={"wall": q - A * ca.sin(T), "stop": 0.7 - q}, q0=0, parameters={A: 1}, t_end=2.0, step=1e-3,
        title="play with a stop",
    )  # fmt: skip


def first_order():
    """Two relays in a ring of two genes."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    return FirstOrderSystem(
        x=x, lam=l, f=-K * x, g=ca.vertcat(A * (1 - l[0]), 1 + l[1]), h=ca.vertcat(x[1] - 0.5, x[0] - 0.5), law=relay(2),
        x0=[X0, 0.1], parameters={A: 1, K: 0.7, X0: 0.3}, t_end=2.0, step=1e-2, theta=1, title="two genes",
    )  # fmt: skip


def oscillator():
    """The friction oscillator of its own class."""
    x, s = ca.SX.sym("q"), ca.SX.sym("s")
    return FrictionOscillator(
        x=x, potential=K * x**2 / 2, friction=A * s, s=s, x0=X0, parameters={A: 1, K: 1, X0: 5.3}, t_end=3.0, step=1e-2,
        title="dry friction",
    )  # fmt: skip


def inclusion():
    """x' in -k x - a Sgn(x) + sin t."""
    x = ca.SX.sym("z")
    return MonotoneInclusion(
        t=T, x=x, field=-K * x + ca.sin(T), phi=A * ca.fabs(x), x0=X0, parameters={A: 0.3, K: 1, X0: 1}, t_end=2.0, step=1e-2,
        scheme="implicit", title="inclusion",
    )  # fmt: skip


def driven(**options):
    """A current that an input drives through friction."""
    u = ca.SX.sym("u")
    return LureSystem(
        names=["i_1"], A=-K, B=[[A]], C=[[1]], D=0, f=u, law=relay(1), x0=[X0], parameters={A: 0.2, K: 1, X0: 0}, t_end=2.0,
        step=1e-2, inputs={u: pwm(0.5, 0.3)}, **options,
    )  # fmt: skip


CLASSES = {
    "LureSystem": (friction, ["x_1", "v_1"]),
    "SweepingProcess": (play, ["q"]),
    "FirstOrderSystem": (first_order, ["x_0", "x"]),
    "FrictionOscillator": (oscillator, ["q", "v"]),
    "MonotoneInclusion": (inclusion, ["z"]),
    "driven": (driven, ["i_1", "u"]),
}
