"""Random models of the five classes that switch often, each with x' and y written a second time, in the test's own words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    box,
    complementarity,
    equality,
    product,
    relay,
)

INF = np.inf


@dataclass
class Sides:
    """Operations that are not analytic: as they are in the model, and beside that with their sides as numbers.

    ``watched``: what a side is the sign of; ``sides``: its symbols, +1 or -1.
    """

    watched: list[ca.SX] = field(default_factory=list)
    sides: list[ca.SX] = field(default_factory=list)

    def chosen(self, argument: ca.SX, one: ca.SX | float, other: ca.SX | float) -> ca.SX:
        """``one`` where the argument is positive, else ``other``."""
        s = ca.SX.sym(f"side{len(self.sides)}")
        self.watched.append(argument)
        self.sides.append(s)
        return (1 + s) / 2 * one + (1 - s) / 2 * other


@dataclass
class Scene:
    """A model; x' = ``rate``, y = ``y`` with l in [lower, upper] in other words; ``fixed``: the rate with sides as symbols."""

    model: Any
    t: ca.SX
    x: ca.SX
    l: ca.SX
    rate: ca.SX
    y: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    fixed: ca.SX
    sides: Sides


class Draw:
    """Numbers of one seed."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def chance(self, p: float = 0.5) -> bool:
        return bool(self.rng.random() < p)

    def count(self, low: int, high: int) -> int:
        return int(self.rng.integers(low, high + 1))

    def one_of(self, *values: Any) -> Any:
        return values[self.rng.integers(len(values))]

    def normal(self, *shape: int) -> np.ndarray:
        return self.rng.normal(size=shape)

    def quarters(self, *shape: int) -> np.ndarray:
        """Multiples of 1/4, whose products are exact."""
        return self.rng.integers(-6, 7, shape) / 4

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def wave(self, t: ca.SX, size: float) -> ca.SX:
        return size * self.uniform(0.3, 1) * ca.sin(self.uniform(0.5, 6) * t + self.uniform(0, 6))

    def waves(self, t: ca.SX, n: int, size: float) -> ca.SX:
        return ca.vertcat(*(self.wave(t, size) + self.wave(t, size / 2) for _ in range(n)))


def smooth(d: Draw, t: ca.SX, x: ca.SX) -> ca.SX:
    """Nonlinear terms with bounded slopes."""
    n = x.numel()
    total = ca.SX.zeros(n)
    for _ in range(d.count(0, 3)):
        i, j, k = (d.count(0, n - 1) for _ in range(3))
        z, w, a = x[i], x[j], d.uniform(-1, 1)
        total[k] += a * d.one_of(
            lambda: ca.sin(2 * z), lambda: z / (1 + w**2), lambda: ca.tanh(z + w), lambda: ca.atan(z) * ca.cos(t),
            lambda: ca.exp(-(z**2)), lambda: ca.sqrt(1 + z**2), lambda: ca.log(2 + w**2), lambda: z * ca.sin(t),
        )()  # fmt: skip
    return total


def kinked(d: Draw, t: ca.SX, x: ca.SX, sides: Sides, most: int = 2) -> tuple[ca.SX, ca.SX]:
    """Terms with kinks in x and jumps in t, as operations of CasADi and by their sides."""
    n = x.numel()
    real, fixed = ca.SX.zeros(n), ca.SX.zeros(n)
    for _ in range(d.count(0, most)):
        i, j, k = (d.count(0, n - 1) for _ in range(3))
        z, w, a, c = x[i], x[j], d.uniform(-1.5, 1.5), d.uniform(-0.4, 0.4)
        kind = d.count(0, 6)
        z = z - c
        if kind == 0:
            one, other = ca.fabs(z), sides.chosen(z, z, -z)
        elif kind == 1:
            one, other = ca.fmax(z, ca.sin(t)), sides.chosen(z - ca.sin(t), z, ca.sin(t))
        elif kind == 2:
            one, other = ca.fmin(z, 2 * w), sides.chosen(2 * w - z, z, 2 * w)
        elif kind == 3:
            one, other = ca.if_else(z > 0, z * ca.cos(w), 0), sides.chosen(z, z * ca.cos(w), 0)
        elif kind == 4:
            at = d.uniform(0.3, 2)
            one, other = ca.if_else(t < at, 1, ca.cos(t)), sides.chosen(at - t, 1, ca.cos(t))
        elif kind == 5:
            one, other = ca.sign(ca.sin(3 * t)), sides.chosen(ca.sin(3 * t), 1, -1)
        else:
            period = d.uniform(0.3, 1)
            one = ca.fmod(t, period)
            other = t
            for m in range(1, int(12 / period)):
                other = other - sides.chosen(t - m * period, period, 0)
        real[k] += a * one
        fixed[k] += a * other
    return real, fixed


def laws(d: Draw, m: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Boxes of every kind, in blocks."""
    parts, lower, upper, at = [], np.zeros(m), np.zeros(m), 0
    while at < m:
        size, kind = d.count(1, m - at), d.count(0, 5)
        rows = slice(at, at + size)
        if kind <= 1:
            a = d.rng.uniform(0.3, 1.5, size)
            lower[rows], upper[rows] = -a * d.one_of(1, 0.5), a
            parts.append(relay(size, lower[rows].copy(), upper[rows].copy()))
        elif kind <= 3:
            upper[rows] = INF
            parts.append(complementarity(size))
        elif kind == 4:
            lower[rows], upper[rows] = d.one_of((-INF, 0.3), (-0.2, INF), (0.1, 0.9), (-INF, 0))
            parts.append(box(lower[rows].copy(), upper[rows].copy()))
        else:
            rows = slice(at, at + 1)
            size = 1
            lower[rows], upper[rows] = -INF, INF
            parts.append(equality(1))
        at += size
    return (parts[0] if len(parts) == 1 else product(*parts)), lower, upper


def feedthrough(d: Draw, m: int) -> np.ndarray:
    """D >= 0 of any rank, with a skew part."""
    kind = d.count(0, 4)
    D = np.zeros((m, m))
    if kind == 0:
        return D
    R = d.quarters(d.count(1, m), m) if kind < 3 else d.quarters(m, m)
    D = R.T @ R
    if kind >= 3:
        S = d.quarters(m, m)
        D = D + np.eye(m) / 4 + (S - S.T) * d.one_of(0, 1)
    elif kind == 2:  # some rows have no l of their own
        gone = d.rng.random(m) < 0.5
        D[gone], D[:, gone] = 0, 0
    return D


def held_offsets(d: Draw, t: ca.SX, lower: np.ndarray, upper: np.ndarray, D: np.ndarray) -> ca.SX:
    """e(t) so that x = 0 has y within every law that bounds it."""
    rows = []
    for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
        wave = d.wave(t, 0.6)
        if np.isinf(a) and np.isinf(b):
            rows.append(wave if D[i, i] > 0 and D.any(axis=1).all() else ca.SX(0))
        elif np.isinf(b):
            rows.append(d.uniform(0.6, 0.9) + wave)
        elif np.isinf(a):
            rows.append(-d.uniform(0.6, 0.9) + wave)
        else:
            rows.append(wave * d.one_of(0, 1))
    return ca.vertcat(*rows)


def start(d: Draw, C: np.ndarray, e0: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """A start that satisfies what D = 0 would ask of it."""
    n = C.shape[1]
    x = 1.5 * d.normal(n)
    equal = np.isinf(lower) & np.isinf(upper)
    if equal.any():
        x = x - np.linalg.pinv(C[equal]) @ (C[equal] @ x)
    for _ in range(60):
        y = C @ x + e0
        if (y[np.isinf(upper) & ~equal] > 0).all() and (y[np.isinf(lower) & ~equal] < 0).all():
            break
        x = x * 0.8
    return x


def rotation(d: Draw, n: int) -> np.ndarray:
    K, R = d.normal(n, n), d.normal(n, n)
    return 1.5 * (K - K.T) - 0.1 * R @ R.T - 0.1 * np.eye(n)


def loop(d: Draw, m_most: int = 4) -> dict[str, Any]:
    """What first-order and Lur'e systems have in common."""
    n, m = d.count(1, 4), d.count(1, m_most)
    law, lower, upper = laws(d, m)
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", n), ca.SX.sym("l", m)
    while True:
        C = d.normal(m, n)
        equal = np.isinf(lower) & np.isinf(upper)
        if m > 1 and d.chance(0.2) and not equal[-2:].any() and (lower[-1], upper[-1]) == (lower[-2], upper[-2]):
            C[-1] = C[-2] * d.one_of(1, 2, 0.5)
        D = feedthrough(d, m)
        if equal.sum() <= n or D.any():
            break
        lower, upper, law = np.full(m, -1.0), np.full(m, 1.0), relay(m)
    e = held_offsets(d, t, lower, upper, D)
    if m > 1 and np.linalg.matrix_rank(C[-2:]) == 1:
        e[m - 1] = e[m - 2] * float(C[-1, 0] / C[-2, 0])
    P = np.diag(d.rng.uniform(0.5, 2, n)) if d.chance() else np.eye(n)
    x0 = start(d, C, np.array(ca.DM(ca.substitute(e, t, 0))).ravel(), lower, upper)
    return locals()


def first_order(seed: int) -> Scene:
    d = Draw(seed)
    v = loop(d)
    n, m, t, x, l, C, D = (v[name] for name in "n m t x l C D".split())
    sides = Sides()
    real, fixed = kinked(d, t, x, sides)
    common = rotation(d, n) @ x + d.waves(t, n, 3.0) + smooth(d, t, x)
    z = C @ x + v["e"]
    bend, slope = ca.SX.zeros(m), ca.SX.ones(m)
    curved = d.chance(0.25)
    if curved:  # y_i = z + atan(z), pushed along its gradient
        bend, slope = ca.atan(z) / 2, 1 + 1 / (2 * (1 + z**2))
    if d.chance(0.2):
        D = np.eye(m) / 2
    cubic = ca.SX.zeros(m)
    if D.any() and d.chance(0.2) and np.linalg.matrix_rank(D) == m:
        cubic = d.uniform(0, 1) * l**3
    y = z + bend + D @ l + cubic
    push = np.linalg.inv(v["P"]) @ C.T @ (slope * l)
    M = np.eye(n)
    if d.chance(0.6):
        M = d.quarters(n, n) / 2 + 2 * np.eye(n)
    model = FirstOrderSystem(
        t=t, x=x, lam=l, f=M @ (common + real), g=M @ push, h=y, M=None if (np.eye(n) == M).all() else M, law=v["law"],
        x0=v["x0"], t_end=d.uniform(3, 6),
    )  # fmt: skip
    return Scene(model, t, x, l, common + real + push, y, v["lower"], v["upper"], common + fixed + push, sides)


def lure(seed: int) -> Scene:
    d = Draw(seed)
    v = loop(d)
    n, t, l, C, D = (v[name] for name in "n t l C D".split())
    x = ca.SX.sym("z", n)
    sides, zero = Sides(), ca.SX.sym("never")
    drive = d.waves(t, n, 3.0)
    jump, jump_fixed = kinked(d, t, ca.SX.zeros(n), Sides(), 0)
    A = rotation(d, n)
    nonlinear = d.chance()
    bend = ca.substitute(smooth(d, zero, x), zero, 1.0) if nonlinear else ca.SX.zeros(n)
    real, fixed = ca.SX.zeros(n), ca.SX.zeros(n)
    if nonlinear:
        c = d.uniform(-0.4, 0.4)
        real[0], fixed[0] = ca.fabs(x[0] - c), sides.chosen(x[0] - c, x[0] - c, c - x[0])
    if d.chance(0.3):
        at = d.uniform(0.3, 2)
        jump[0] += ca.if_else(t < at, 1.5, -0.5)
        jump_fixed[0] += sides.chosen(at - t, 1.5, -0.5)
    offset = v["e"]
    constant = np.array(ca.DM(ca.substitute(offset, t, 0))).ravel()
    B = np.linalg.inv(v["P"]) @ C.T
    # y = C x + D l has no e(t): the offset is put into a state that rests at 1
    states = ca.vertcat(x, ca.SX.sym("one"))
    full_A = np.zeros((n + 1, n + 1))
    full_A[:n, :n] = A
    field_ = ca.vertcat(A @ x + bend + real, 0)
    whole_B, whole_C = np.vstack([B, np.zeros((1, v["m"]))]), np.hstack([C, constant[:, None]])
    law = v["law"]
    x0 = np.append(start(d, C, constant, v["lower"], v["upper"]), 1.0)
    if d.chance(0.2) and not D.any():
        x0[:n] = 2 * d.normal(n)  # a start outside the law: a jump
    model = LureSystem(
        t=t, x=states, A=field_ if nonlinear else full_A, B=whole_B, C=whole_C, D=D if D.any() or d.chance() else None,
        f=ca.vertcat(drive + jump, 0), law=law, x0=x0, t_end=d.uniform(3, 6),
    )  # fmt: skip
    y = C @ x + constant * states[n] + D @ l
    rate = ca.vertcat(A @ x + bend + real + drive + jump + B @ l, 0)
    other = ca.vertcat(A @ x + bend + fixed + drive + jump_fixed + B @ l, 0)
    return Scene(model, t, states, l, rate, y, v["lower"], v["upper"], other, sides)


def sweeping(seed: int) -> Scene:
    d = Draw(seed)
    n = d.count(1, 4)
    t, q = ca.SX.sym("t"), ca.SX.sym("q", n)
    sides = Sides()
    real, fixed = kinked(d, t, q, sides, 1)
    common = rotation(d, n) @ q / 2 + d.waves(t, n, 3.0) + smooth(d, t, q)
    rows: list[ca.SX] = []
    for _ in range(d.count(1, 3)):
        a = d.normal(n)
        a /= np.linalg.norm(a)
        rows.append(d.uniform(1.0, 1.5) + d.wave(t, 0.4) + ca.dot(ca.DM(a), q))
    if d.chance():
        c = d.waves(t, n, 0.15)
        rows.append(d.uniform(1.2, 1.6) ** 2 - ca.sumsqr(q - c))
    x0 = np.zeros(n)
    if n > 1 and d.chance():  # a small disc that wanders, to be kept outside of
        rows.append(ca.sumsqr(q - d.waves(t, n, 0.2)) - 0.2**2)
        x0[:] = 0.55 / np.sqrt(n)
    if d.chance(0.3):
        rows.append(rows[0] * d.one_of(1, 1e-5, 3e3))
    if d.chance(0.2):
        rows = [row * 10.0 ** d.count(-4, 4) for row in rows]
    if d.chance(0.2):
        rows[0] = 1 - ca.exp(-rows[0])
    g = ca.vertcat(*rows)
    values = ca.Function("g", [t, q], [g])
    for _ in range(200):
        if (np.array(values(0, x0)) > 0).all():
            break
        x0 = d.rng.uniform(-0.7, 0.7, n)
    l = ca.SX.sym("l", len(rows))
    model = SweepingProcess(
        t=t, q=q, f=common + real, constraints={f"c{i}": row for i, row in enumerate(rows)}, q0=x0, t_end=d.uniform(3, 6)
    )
    push = ca.jtimes(g, q, l, True)
    zero, inf = np.zeros(len(rows)), np.full(len(rows), INF)
    return Scene(model, t, q, l, common + real + push, g, zero, inf, common + fixed + push, sides)


def oscillator(seed: int) -> Scene:
    d = Draw(seed)
    n = d.count(1, 3)
    x, v, s, t = ca.SX.sym("x", n), ca.SX.sym("v", n), ca.SX.sym("s"), ca.SX.sym("t")
    sides = Sides()
    R = d.normal(n, n)
    potential = 4 * ca.sumsqr(x) + 3 * ca.sumsqr(ca.DM(R) @ x)
    if d.chance():
        potential += ca.sumsqr(x) ** 2 / 2
    if d.chance(0.3):
        potential += ca.sqrt(1 + x[0] ** 2)
    force = -ca.gradient(potential, x)
    fixed = ca.SX.zeros(n)
    real = ca.SX.zeros(n)
    m = d.count(1, 3)
    rows, mu, rest, y = {}, [], ca.SX.zeros(n), []
    for i in range(m):
        H = d.normal(1, n) if n > 1 else np.array([[d.uniform(0.5, 1.5)]])
        if i and d.chance(0.2):
            H = np.array(rows[f"e{i - 1}"][0]) * d.one_of(1, -0.5)
        radius, b, c = d.uniform(0.05, 0.6), d.one_of(0, d.uniform(0, 0.3)), d.one_of(0, d.uniform(0, 0.2))
        rows[f"e{i}"] = (H, radius * s + b * s**2 / 2 + c * s**3 / 3)
        w = (ca.DM(H) @ v)[0]
        mu.append(radius)
        y.append(w)
        own = b * w + c * w * ca.fabs(w)
        own_fixed = b * w + c * w * sides.chosen(w, w, -w) if c else b * w
        real -= H.T @ own
        fixed -= H.T @ own_fixed
        rest += H.T @ ca.SX.zeros(1)
    damping = None
    if d.chance(0.3):
        S = d.normal(n, n)
        damping = 0.05 * np.eye(n) + (S - S.T) / 2
        force -= damping @ v
    l = ca.SX.sym("l", m)
    push = sum((row.T @ l[i] for i, (row, _) in enumerate(rows.values())), ca.SX.zeros(n))
    model = FrictionOscillator(
        x=x, potential=potential, friction=rows, s=s, damping=damping, x0=2 * d.normal(n), v0=3 * d.normal(n) * d.one_of(0, 1),
        t_end=d.uniform(3, 8),
    )  # fmt: skip
    radius = np.array(mu)
    return Scene(
        model, t, ca.vertcat(x, v), l, ca.vertcat(v, force + real + push), ca.vertcat(*y), -radius, radius,
        ca.vertcat(v, force + fixed + push), sides,
    )  # fmt: skip


def inclusion(seed: int) -> Scene:
    """Rows: signs of S in order of their arguments, then the box and the constraints; judged by definition, not by l."""
    d = Draw(seed)
    n = d.count(1, 4)
    t, x = ca.SX.sym("t"), ca.SX.sym("x", n)
    sides = Sides()
    real, fixed = kinked(d, t, x, sides, 1)
    common = rotation(d, n) @ x + d.waves(t, n, 3.0) + smooth(d, t, x)
    S, weights, arguments, pushes = ca.SX.zeros(n), [], [], []
    for i in range(d.count(0, 3)):
        P = d.normal(n)
        if i and d.chance(0.2):
            P = P * 0 + np.eye(n)[d.count(0, n - 1)]
        u = ca.dot(ca.DM(P), x) - (d.wave(t, 0.3) if d.chance() else d.uniform(-0.2, 0.2))
        w = d.uniform(0.2, 1.5)
        S += w * ca.DM(P) * ca.sign(u)
        weights.append(w)
        arguments.append(u)
        pushes.append(w * ca.DM(P))
    linear = d.one_of(0, d.uniform(0.1, 1))
    S += linear * x
    walls: dict[str, Any] = {}
    bounds: list[ca.SX] = []
    if d.chance() or not arguments:
        low, high = (ca.vertcat(*(d.uniform(0.7, 1.2) + d.wave(t, 0.4) for _ in range(n))) for _ in range(2))
        walls |= {"lower": -low, "upper": high}
        bounds += [*ca.vertsplit(x + low), *ca.vertsplit(high - x)]
    if d.chance(0.4):
        extra = (
            [1.3**2 - ca.sumsqr(x - d.waves(t, n, 0.2))] if d.chance() else [0.8 + d.wave(t, 0.3) + ca.dot(ca.DM(d.normal(n)), x)]
        )
        walls["constraints"] = {"wall": extra[0]}
        bounds += extra
    model = MonotoneInclusion(
        t=t, x=x, field=common + real, operator=S, x0=np.zeros(n), t_end=d.uniform(3, 6), scheme=d.one_of("catching-up", "implicit"),
        **walls,
    )  # fmt: skip
    k, b = len(arguments), len(bounds)
    l, c = ca.SX.sym("l", k + b), ca.vertcat(ca.SX(0, 1), *bounds)
    push = sum((pushes[i] * l[i] for i in range(k)), ca.SX.zeros(n)) + (ca.jtimes(c, x, l[k:], True) if b else 0)
    lower, upper = np.r_[-np.ones(k), np.zeros(b)], np.r_[np.ones(k), np.full(b, INF)]
    y = ca.vertcat(ca.SX(0, 1), *arguments, *bounds)
    return Scene(model, t, x, l, common + real - linear * x + push, y, lower, upper, common + fixed - linear * x + push, sides)


CLASSES: dict[str, Callable[[int], Scene]] = {
    "sweeping": sweeping, "oscillator": oscillator, "first order": first_order, "lure": lure, "inclusion": inclusion,
}  # fmt: skip
