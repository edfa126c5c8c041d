"""Random models of small whole numbers: conditions that meet, touch and depend on each other exactly, rests, corners, steps."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, SweepingProcess, complementarity, product, relay
from tests.event_models import Draw, Scene, Sides


def whole(d: Draw, *shape: int, most: int = 2) -> np.ndarray:
    return d.rng.integers(-most, most + 1, shape).astype(float)


def drives(d: Draw, t: ca.SX, n: int, sides: Sides) -> tuple[ca.SX, ca.SX]:
    """Of each state a force that is still, rises, turns, steps or swings, with whole numbers; by its sides, too."""
    real, fixed = [], []
    for _ in range(n):
        a, b, k = (float(v) for v in whole(d, 3))
        kind = d.count(0, 7)
        if kind <= 1:
            one = other = ca.SX(a)
        elif kind == 2:
            one = other = a * t - b
        elif kind == 3:
            one = other = a * t * (2 - t) + b
        elif kind == 4 and a != b:
            one, other = ca.if_else(t < 1, a, b), sides.chosen(1 - t, a, b)
        elif kind == 5:
            one = other = a * ca.sin(t) + b
        elif kind == 6 and a:
            one, other = a * ca.fabs(t - 1) + b, a * sides.chosen(t - 1, t - 1, 1 - t) + b
        else:
            one = other = a * ca.cos(2 * t) + k
        real.append(one)
        fixed.append(other)
    return ca.vertcat(*real), ca.vertcat(*fixed)


def boxes(d: Draw, m: int):
    parts, lower, upper = [], np.zeros(m), np.zeros(m)
    for i in range(m):
        kind = d.count(0, 3)
        if kind == 3:
            upper[i] = np.inf
            parts.append(complementarity(1))
        else:
            lower[i], upper[i] = ((-1, 1), (-1, 1), (-2, 1))[kind]
            parts.append(relay(1, lower[i : i + 1].copy(), upper[i : i + 1].copy()))
    return (parts[0] if m == 1 else product(*parts)), lower, upper


def loops(seed: int) -> Scene:
    """y = C x + D l, pushed by C': rows that are equal, opposite or sums of others, D of any rank."""
    d = Draw(seed)
    n, m = d.count(1, 3), d.count(1, 4)
    t, x, l, sides = ca.SX.sym("t"), ca.SX.sym("x", n), ca.SX.sym("l", m), Sides()
    law, lower, upper = boxes(d, m)
    C = whole(d, m, n, most=d.one_of(1, 2))
    for i in range(m):
        if not C[i].any():
            C[i, d.count(0, n - 1)] = 1
    D = np.zeros((m, m))
    if d.chance():
        R = whole(d, d.count(1, m), m, most=1)
        S = whole(d, m, m, most=1) * d.one_of(0, 1)
        D = R.T @ R + (S - S.T)
    K = whole(d, n, n, most=1)
    A = (K - K.T) - np.diag(d.rng.integers(0, 2, n)) * d.one_of(0, 0.5, 1)
    real, fixed = drives(d, t, n, sides)
    free = ~(D.any(axis=1) | D.any(axis=0))
    x0 = whole(d, n) * d.one_of(0, 1)
    for _ in range(20):
        if all(C[i] @ x0 >= 0 for i in range(m) if free[i] and np.isinf(upper[i])):
            break
        x0 = whole(d, n)
    else:
        x0 = np.zeros(n)
    push, y = ca.DM(C.T) @ l, ca.DM(C) @ x + ca.DM(D) @ l
    rate = ca.DM(A) @ x
    if d.chance():
        model = LureSystem(t=t, A=A, B=C.T, C=C, D=D if D.any() else None, f=real, law=law, x0=x0, t_end=d.one_of(3, 5))
    else:
        model = FirstOrderSystem(t=t, x=x, lam=l, f=rate + real, g=push, h=y, law=law, x0=x0, t_end=d.one_of(3, 5))
    return Scene(model, t, x, l, rate + real + push, y, lower, upper, rate + fixed + push, sides)


def corners(seed: int) -> Scene:
    """Walls with whole normals that rest or move evenly, a disc: corners, edges that are reached together, starts on them."""
    d = Draw(seed)
    n = d.count(1, 3)
    t, q, sides = ca.SX.sym("t"), ca.SX.sym("q", n), Sides()
    real, fixed = drives(d, t, n, sides)
    K = whole(d, n, n, most=1)
    rate = ca.DM((K - K.T) * d.one_of(0, 1)) @ q
    q0, rows = whole(d, n, most=1), []
    for _ in range(d.count(1, 4)):
        a = whole(d, n, most=1)
        a[d.count(0, n - 1)] = d.one_of(-1.0, 1.0)
        gap, away = d.one_of(0, 0, 1, 2), d.one_of(0, 0, 0.5, -0.5)
        rows.append(ca.dot(ca.DM(a), q - ca.DM(q0)) + gap + away * t)
    if d.chance(0.3):
        rows.append(4 - ca.sumsqr(q - ca.DM(q0)))
    g = ca.vertcat(*rows)
    m = len(rows)
    l = ca.SX.sym("l", m)
    model = SweepingProcess(
        t=t, q=q, f=rate + real, constraints={f"c{i}": row for i, row in enumerate(rows)}, q0=q0, t_end=d.one_of(3, 5)
    )
    push = ca.jtimes(g, q, l, True)
    return Scene(model, t, q, l, rate + real + push, g, np.zeros(m), np.full(m, np.inf), rate + fixed + push, sides)


def masses(seed: int) -> Scene:
    """Springs and friction of whole numbers: rests on the edge of sliding, elements that stop together."""
    d = Draw(seed)
    n, m = d.count(1, 3), d.count(1, 3)
    x, v, s, t, l = ca.SX.sym("x", n), ca.SX.sym("v", n), ca.SX.sym("s"), ca.SX.sym("t"), ca.SX.sym("l", m)
    K = np.eye(n) * d.one_of(1, 1, 4)
    if d.chance():
        R = whole(d, n, n, most=1)
        K = R.T @ R + np.eye(n)
    potential = ca.bilin(ca.DM(K), x, x) / 2
    H, mu = whole(d, m, n, most=1), d.rng.integers(1, 3, m).astype(float) * d.one_of(1, 0.5)
    for i in range(m):
        if not H[i].any():
            H[i, i % n] = 1
    damping = np.eye(n) if d.chance(0.2) else None
    model = FrictionOscillator(
        x=x, potential=potential, friction={f"e{i}": (H[i : i + 1], mu[i] * s) for i in range(m)}, s=s, damping=damping,
        x0=whole(d, n, most=4), v0=whole(d, n) * d.one_of(0, 0, 1), t_end=d.one_of(5, 8),
    )  # fmt: skip
    rate = ca.vertcat(v, -ca.DM(K) @ x - (0 if damping is None else v) + ca.DM(H.T) @ l)
    return Scene(model, t, ca.vertcat(x, v), l, rate, ca.DM(H) @ v, -mu, mu, rate, Sides())


def cascades(seed: int) -> Scene:
    """Rows that drive those after them alone: one solution, though not monotone; an l that jumps makes y of others jump."""
    d = Draw(seed)
    n = d.count(2, 4)
    t, x, l, sides = ca.SX.sym("t"), ca.SX.sym("x", n), ca.SX.sym("l", n), Sides()
    law, lower, upper = boxes(d, n)
    direct = d.rng.integers(0, 3, n).astype(float)
    D = (np.tril(whole(d, n, n), -1)) * (direct > 0)[:, None] + np.diag(direct)
    B = np.tril(whole(d, n, n, most=1), -1) + np.eye(n)
    A, e = whole(d, n, n, most=1), whole(d, n, most=1) / 2 * (direct > 0)
    real, fixed = drives(d, t, n, sides)
    x0 = np.abs(whole(d, n))
    push, y, rate = ca.DM(B) @ l, x + ca.DM(e) + ca.DM(D) @ l, ca.DM(A) @ x
    model = FirstOrderSystem(t=t, x=x, lam=l, f=rate + real, g=push, h=y, law=law, x0=x0, t_end=2)
    return Scene(model, t, x, l, rate + real + push, y, lower, upper, rate + fixed + push, sides)


CLASSES = {"loops": loops, "corners": corners, "masses": masses, "cascades": cascades}
