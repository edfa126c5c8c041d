"""Random models with parameters, by seed, and what their runs are differentiated by; differences of runs to compare with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    Sensitivity,
    SweepingProcess,
    ball,
    box,
    complementarity,
    hysteresis,
    pwm,
    relay,
    sampled,
    sensitivity,
    table,
)

A, W, B = ca.SX.sym("a"), ca.SX.sym("w"), ca.SX.sym("b")
T, U = ca.SX.sym("t"), ca.SX.sym("u")
Made = tuple[Any, list[str]]


def _values(rng: np.random.Generator) -> dict[ca.SX, float]:
    return {A: float(rng.uniform(0.5, 2)), W: float(rng.uniform(0.1, 0.6)), B: float(rng.uniform(-0.5, 0.5))}


def lure(rng: np.random.Generator) -> Made:
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    K = rng.normal(size=(n, n))
    M = A * ca.DM(K - K.T) - ca.DM(np.diag(rng.uniform(0, 0.5, n)))
    C = rng.normal(size=(m, n))
    D = np.diag(rng.choice([0.0, 0.3], m))
    laws = [relay(m, -W, W), complementarity(m), box(-W * ca.DM.ones(m), 2 * W * ca.DM.ones(m))]
    start = rng.normal(size=n)
    law = laws[rng.integers(3)]
    if law is laws[1]:
        start = np.linalg.lstsq(C, np.abs(C @ start) + 0.1, rcond=None)[0]
    push = ca.DM(rng.normal(size=n)) * ca.sin(1.3 * T + B)
    model = LureSystem(
        A=M, B=C.T, C=C, D=D, law=law, f=ca.vertsplit(push), t=T, x0=start.tolist(), parameters=_values(rng), t_end=4.0, step=0.01
    )
    return model, ["a", "w", "b", "x_0(0)"] if law is not laws[1] else ["a", "b", "x_0(0)", "x_1(0)"]


def oscillator(rng: np.random.Generator) -> Made:
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = FrictionOscillator(
        x=x, potential=A * x**2 + 0.1 * x**4, s=s, friction=W * ca.fabs(s), force=ca.sin(float(rng.uniform(0.5, 2)) * T + B), t=T,
        x0=[float(rng.normal())], v0=[float(rng.normal())], parameters=_values(rng), t_end=6.0, step=0.01,
    )  # fmt: skip
    return model, ["a", "w", "b", "x(0)", "v(0)"]


def first(rng: np.random.Generator) -> Made:
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    f = ca.vertcat(x[1] + ca.fabs(x[0] - B), -A * x[0] - 0.2 * x[1] + ca.fmax(x[1] - 0.3, 0) + ca.sin(2 * T))
    start = rng.normal(size=2).tolist()
    model = FirstOrderSystem(x=x, lam=l, f=f, g=ca.vertcat(0, l), h=x[1] - 0.2 * B, law=relay(1, -W, W), t=T, x0=start,
                             parameters=_values(rng), t_end=4.0, step=0.01)  # fmt: skip
    return model, ["a", "w", "b", "x_0(0)", "x_1(0)"]


def sweeping(rng: np.random.Generator) -> Made:
    q = ca.SX.sym("q", 2)
    angle = float(rng.uniform(0, 6))
    walls = {"disc": ca.sumsqr(q - ca.vertcat(0.3 * ca.sin(T), 0)) - 0.5 * A, "wall": q[1] + 2 + B - 0.2 * ca.sin(2 * T)}
    f = [W * ca.cos(T + angle) * 4 - 0.1 * q[0], -1.5 + ca.sin(T + B)]
    model = SweepingProcess(q=q, f=f, constraints=walls, t=T, q0=[float(rng.uniform(-1, 1)), 2.0], parameters=_values(rng),
                            t_end=6.0, step=0.01)  # fmt: skip
    return model, ["a", "w", "b", "q_0(0)"]


def inclusion(rng: np.random.Generator) -> Made:
    x = ca.SX.sym("x", 2)
    S = ca.DM([[0.3, float(rng.uniform(0.5, 2))], [-1.0, 0.1]])
    field = ca.vertcat(ca.sin(T + B), ca.cos(A * T)) - S @ x
    phi = W * ca.fabs(x[0] - 0.1) + 0.4 * ca.fabs(x[1])
    model = MonotoneInclusion(x=x, field=field, phi=phi, lower=[-1.2, -np.inf], t=T, x0=rng.uniform(-1, 1, 2).tolist(),
                              parameters=_values(rng), t_end=5.0, step=0.01)  # fmt: skip
    return model, ["a", "w", "b", "x_0(0)", "x_1(0)"]


def balls(rng: np.random.Generator) -> Made:
    x, l = ca.SX.sym("x", 4), ca.SX.sym("l", 2)
    pull = [-A * x[0] + 1.5 * ca.sin(T + B), -2 * x[1] + W]
    law = ball(2, float(rng.uniform(0.4, 1.6)))
    model = FirstOrderSystem(x=x, lam=l, f=[x[2], x[3], *pull], g=ca.vertcat(0, 0, l), h=x[2:], law=law, t=T,
                             x0=rng.normal(size=4).tolist(), parameters=_values(rng), t_end=6.0, step=0.01)  # fmt: skip
    return model, ["a", "w", "b", "x_0(0)", "x_2(0)"]


def growing(rng: np.random.Generator) -> Made:
    q, s = ca.SX.sym("q"), ca.SX.sym("s")
    model = FrictionOscillator(
        x=q, potential=A * q**2, s=s, friction=W * (ca.fabs(s) + 0.3 * s**2), force=ca.sin(1.3 * T + B), t=T,
        x0=[float(rng.normal())], v0=[float(rng.normal())], parameters=_values(rng), t_end=6.0, step=0.01,
    )  # fmt: skip
    return model, ["a", "w", "b", "q(0)", "v(0)"]


def driven(rng: np.random.Generator) -> Made:
    signals = [
        (pwm(0.9, float(rng.uniform(0.2, 0.8)), phase=0.13, low=-1.0, kind=str(rng.choice(["trailing", "leading", "centre"]))),
         ["u.duty", "u.period", "u.phase", "u.high"]),
        (table([0, 0.7, 1.9, 3.1], rng.normal(size=4), "linear"), ["u[0]", "u[2]", "u.t[1]", "u.t[2]"]),
        (table([0, 0.7, 1.9, 3.1], rng.normal(size=4)), ["u[0]", "u[2]", "u.t[1]", "u.t[2]"]),
    ]  # fmt: skip
    drive, by = signals[rng.integers(3)]
    start, values = rng.normal(size=2).tolist(), {name: v for name, v in _values(rng).items() if name is not B}
    model = LureSystem(A=[[0, 1], [-A, -0.2]], B=[0, 1], C=[0, 1], f=[0, 2 * U], law=relay(1, -W, W), x0=start, inputs={U: drive},
                       parameters=values, t_end=4.0, step=0.01)  # fmt: skip
    return model, [*by, "a", "w"]


def blocks(rng: np.random.Generator) -> Made:
    x, held = ca.SX.sym("x", 2), ca.SX.sym("held")
    if rng.random() < 0.5:
        block = sampled("control", period=0.31, memory={held: 0.0}, update={held: 0.5 * held - A * x[0]})
    else:
        block = hysteresis(held, x[0], -W, W, start=1, below=1, above=-1)
    model = FirstOrderSystem(x=x, f=[x[1], -x[0] - 0.3 * x[1] + held + ca.sin(A * T + B)], t=T, x0=rng.normal(size=2).tolist(),
                             blocks=[block], parameters=_values(rng), t_end=4.0, step=0.01)  # fmt: skip
    return model, ["a", "w", "b", "x_0(0)"]


KINDS: dict[str, Callable[[np.random.Generator], Made]] = {
    make.__name__: make for make in (lure, oscillator, first, sweeping, inclusion, balls, growing, driven, blocks)
}


def made(kind: str, seed: int) -> Made:
    return KINDS[kind](np.random.default_rng([list(KINDS).index(kind), seed]))


def extrapolated(model: Any, by: list[str], width: float = 2e-4, *, compiled: bool = False, **options: Any) -> np.ndarray:
    """Central differences of runs at rtol 1e-13 over two widths, extrapolated."""
    one, two = (
        sensitivity(model, by=by, method="differences", rtol=1e-13, width=w, compiled=compiled, **options).jacobian
        for w in (width, 2 * width)
    )
    return (4 * one - two) / 3


NEGLIGIBLE = 1e-4  # A column below it beside states of size 1 is compared with that.


def largest_error(found: Sensitivity, reference: np.ndarray) -> float:
    """Beside the largest entry of each column."""
    size = np.abs(reference).max(axis=(0, 1), initial=0.0)
    return float((np.abs(found.jacobian - reference).max(axis=(0, 1)) / (size + NEGLIGIBLE)).max())
