"""More than a thousand extreme cells, and what must come out of each, computed without the package.

A cell is one run of STEPS steps: a scene at one stiffness, step, unit, friction level, mass ratio, number of constraints or
angle. The truth is the scheme's own recursion in 40 digits (mpmath), or a brute-force search in NumPy where that is said.
The tolerance is fixed here, before any run: with motion = how far the true state has moved so far and size = its largest value,

    |x - x*| <= RELATIVE * motion + ROUNDING * size        (RELATIVE = 1e-9, ROUNDING = 4 (STEPS + 1) eps)

so that a run of tiny steps is judged by what moves. Where a scene allows more, its docstring says why. A cell that may stop
says so beforehand, with the words that its message must hold; every other cell must run to its end.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from mpmath import mp, mpf

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    NsmodelError,
    SweepingProcess,
    ball,
    complementarity,
    relay,
    simulate,
)

mp.dps = 40
STEPS = 24
EPS = np.finfo(float).eps
RELATIVE, ROUNDING = 1e-9, 4 * (STEPS + 1) * EPS
LOST = 1e-2  # Rounding beside motion, in one step, from which on a run is not determined in doubles.
RIGHT, STOPPED, WRONG = "right", "stopped", "wrong"

NATURAL = (1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3)  # steps, in natural times of the scene
STIFF = (1.0, 1e3, 1e6, 1e9, 1e12)
UNITS = (1e-9, 1.0, 1e9)

T, Q, X, LAM, S = (ca.SX.sym(name) for name in ("t", "q", "x", "l", "s"))
Q2, X2, LAM2 = (ca.SX.sym(name, 2) for name in ("q", "x", "l"))
K, U, A, B, M, R, H = (ca.SX.sym(name) for name in ("k", "u", "a", "b", "m", "r", "dt"))


@dataclass(frozen=True)
class Cell:
    """One run: where it stands (``at``), how it is made, and ``judge(run)``: misfit beside what is allowed, <= 1 if right."""

    scene: str
    kind: str
    at: Mapping[str, float]
    model: Any
    step: float
    parameters: Mapping[str, float]
    judge: Callable[[Any], float]
    may_stop: tuple[str, ...] = ()
    steps: int = STEPS


@dataclass(frozen=True)
class Outcome:
    """What became of a cell."""

    cell: Cell
    verdict: str
    misfit: float = np.nan
    message: str = ""
    growth: float = field(default=np.nan)


def outcome(cell: Cell) -> Outcome:
    """Run the cell and judge it; a run that stops is judged up to there."""
    run, message = None, ""
    try:
        run = simulate(cell.model, step=cell.step, t_end=cell.steps * cell.step, parameters=cell.parameters)
    except NsmodelError as error:
        run, message = getattr(error, "trajectory", None), str(error)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        misfit = 0.0 if run is None or len(run.t) < 2 else cell.judge(run)
        growth = np.nan if run is None or "energy" not in run.arrays else float(np.max(run.energy[1:] / run.energy[:-1]))
    verdict = STOPPED if message else RIGHT
    return Outcome(cell, verdict if misfit <= 1 else WRONG, float(misfit), message, growth)


def against(
    truth: Callable[[], Sequence[Sequence[Any]]], more: float = 0.0, of: str = "x", columns: Sequence[int] | None = None
) -> Callable[[Any], float]:
    """Judge some columns of an array of a run by rows of the truth (numbers of mpmath); ``more``: what else is allowed."""

    def judge(run: Any) -> float:
        exact = np.array([[float(value) for value in row] for row in truth()])
        motion = np.maximum.accumulate(np.abs(exact - exact[0]).max(axis=1))
        size = np.maximum.accumulate(np.abs(exact).max(axis=1))
        allowed = RELATIVE * motion + ROUNDING * size + more
        got = getattr(run, of).reshape(len(run.t), -1)
        got = got if columns is None else got[:, columns]
        rows = len(got)
        error = np.abs(got - exact[:rows]).max(axis=1)
        with np.errstate(invalid="ignore", over="ignore"):
            return float(np.max(np.where(error == 0, 0.0, error / allowed[:rows])[1:]))

    return judge


def soft(u, a):
    """The prox of a|.|."""
    return u - a if u > a else u + a if u < -a else mpf(0)


def rows_of(start: Sequence[float], step: Callable[..., Any], **numbers: float) -> Callable[[], list[Any]]:
    """Start, step(0, start, **numbers), ... : STEPS + 1 rows, all numbers of mpmath, once they are asked for."""

    @functools.cache
    def rows() -> list[Any]:
        found, exact = [tuple(map(mpf, start))], {name: mpf(float(number)) for name, number in numbers.items()}
        for k in range(STEPS):
            found.append(step(k, found[-1], **exact))
        return found

    return rows


# ---------------------------------------------------------------------------------------------- sweeping processes

LINE = SweepingProcess(
    t=T, q=Q, f=-K * Q, constraints={"wall": Q - U * (0.3 + 0.05 * K * T)}, q0=U, t_end=1, parameters={K: None, U: None}
)


def line() -> Iterator[Cell]:
    """q' = -k q behind a wall that advances: q+ = max(q - h k q, wall). Explicit: at h k > 2 the free step overshoots."""
    for k, s, u in product(STIFF, NATURAL, UNITS):
        h = s / k

        def step(i, row, k, u, h):
            return (max(row[0] - h * k * row[0], u * (mpf(0.3) + mpf(0.05) * k * (i + 1) * h)),)

        yield Cell(
            "moving wall", "sweeping", {"stiffness": k, "step": s, "unit": u}, LINE, h, {"k": k, "u": u},
            against(rows_of((u,), step, k=k, u=u, h=h)),
        )  # fmt: skip


FUNNEL = SweepingProcess(
    q=Q2, f=[0.3 * U, -U], q0=[0, 0], t_end=1, parameters={A: None, U: None},
    constraints={"left": A * (Q2[1] + U) + Q2[0], "right": A * (Q2[1] + U) - Q2[0]},
)  # fmt: skip
SHEAF = SweepingProcess(
    q=Q2, f=[-U, -0.5 * U], q0=[0, U], t_end=1, parameters={A: None, U: None},
    constraints={"a": Q2[0] + U + A * Q2[1], "b": Q2[0] + U - A * Q2[1]},
)  # fmt: skip


def nearest_in_corner(p, G, b):
    """The point nearest to p with G q + b >= 0, two rows: p itself, its foot on a row, or the corner."""
    best = None
    for rows in ((), (0,), (1,), (0, 1)):
        if not rows:
            q = p
        elif len(rows) == 1:
            g = G[rows[0]]
            l = (g[0] * p[0] + g[1] * p[1] + b[rows[0]]) / (g[0] ** 2 + g[1] ** 2)
            q = (p[0] - l * g[0], p[1] - l * g[1])
        else:
            det = G[0][0] * G[1][1] - G[0][1] * G[1][0]
            q = ((-b[0] * G[1][1] + b[1] * G[0][1]) / det, (-b[1] * G[0][0] + b[0] * G[1][0]) / det)
        slack = min(G[i][0] * q[0] + G[i][1] * q[1] + b[i] for i in range(2) if i not in rows) if len(rows) < 2 else mpf(0)
        if slack >= 0:
            d = mp.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2)
            if best is None or d < best[0]:
                best = d, q
    return best


def in_corner(name: str, angle: float, s: float, u: float, f: tuple[float, float]) -> Callable[[Any], float]:
    """The judge of `corner`."""
    a, size_u = mpf(angle), mpf(u)
    G, b = ((1, a), (1, -a)), (size_u, size_u)
    if name == "nearly opposite":
        G, b = ((1, a), (-1, a)), (a * size_u, a * size_u)
    push = [mpf(s) * mpf(fi) * size_u for fi in f]
    reach = mp.sqrt(push[0] ** 2 + push[1] ** 2)

    def judge(run):
        worst = 0.0
        for k in range(len(run.t) - 1):
            q, new = ([mpf(float(value)) for value in run.x[i]] for i in (k, k + 1))
            p = [q[i] + push[i] for i in range(2)]
            size = max(abs(value) for value in (*q, *new, *p, size_u))
            far, _ = nearest_in_corner(p, G, b)
            passed = max(-(G[i][0] * new[0] + G[i][1] * new[1] + b[i]) for i in range(2))
            excess = mp.sqrt((new[0] - p[0]) ** 2 + (new[1] - p[1]) ** 2) - far
            worst = max(worst, max(passed, excess) / (RELATIVE * reach + ROUNDING * size))
        return float(worst)

    return judge


def corner() -> Iterator[Cell]:
    """A point pushed into the corner of two walls that are nearly opposite (gamma = 1/angle) or nearly parallel.

    Where the corner lies along the walls is known to eps/angle only, by whatever method. So each step is judged by what is
    well conditioned, from the run's own last row: with allowed = RELATIVE * (length of the prediction) + ROUNDING * size, no
    wall is passed by more than that, and no point of the corner is nearer to the prediction by more than that. Opposite walls
    at 1e-9 may stop: the products of their normals round to -1, and what is left of the angle is below rounding.
    """
    for name, model, f in (("nearly opposite", FUNNEL, (0.3, -1.0)), ("nearly parallel", SHEAF, (-1.0, -0.5))):
        for angle, s, u in product((1e-1, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15), (1e-9, 1e-3, 1e-1, 1.0, 1e3), UNITS):
            judge = in_corner(name, angle, s, u, f)
            at = {"angle": angle, "step": s, "unit": u}
            stops = ("'left'", "'right'", "nearly opposite") if name == "nearly opposite" and angle == 1e-9 else ()
            yield Cell(f"corner, {name}", "sweeping", at, model, s, {"a": angle, "u": u}, judge, stops, 14)


def polygon_model(sides: int, copies: int) -> SweepingProcess:
    angles = 2 * np.pi * np.arange(sides) / sides
    G = np.repeat(np.column_stack([np.cos(angles), np.sin(angles)]), copies, axis=0)
    return SweepingProcess(
        q=Q2, f=[U, 0.37 * U], constraints={"side": U - ca.DM(G) @ Q2}, q0=[0, 0], t_end=1, parameters={U: None}
    )


def polygon() -> Iterator[Cell]:
    """A point pushed into the side of a polygon of up to 100 sides, each given up to 8 times; brute force over all edges."""
    for sides, copies in ((3, 1), (3, 8), (12, 1), (12, 4), (30, 1), (100, 1)):
        model = polygon_model(sides, copies)
        angles = 2 * np.pi * np.arange(sides) / sides
        n = np.column_stack([np.cos(angles), np.sin(angles)])
        along = np.column_stack([-n[:, 1], n[:, 0]])
        half = np.tan(np.pi / sides)
        for s, u in product((1e-6, 1e-1, 1.0, 1e3), UNITS if sides < 100 else UNITS[:1]):
            q, truth = np.zeros(2), [np.zeros(2)]
            for _ in range(STEPS):
                p = q + s * np.array([1, 0.37])
                feet = n + np.clip(along @ p, -half, half)[:, None] * along
                q = p if np.all(n @ p <= 1) else feet[np.argmin(np.linalg.norm(feet - p, axis=1))]
                truth.append(q)
            at = {"constraints": float(sides * copies), "step": s, "unit": u}
            judge = against(lambda u=u, truth=truth: u * np.array(truth))
            yield Cell("polygon", "sweeping", at, model, s, {"u": u}, judge, steps=6)


WALLS = SweepingProcess(
    t=T, q=Q, q0=A * U, t_end=1, parameters={A: None, U: None},
    constraints={"left": Q + U * (0.5 - T), "right": U * (0.5 - T) - Q},
)  # fmt: skip


def closing() -> Iterator[Cell]:
    """Two walls that meet at t = 1/2: q = clip(q0, -w, w), w = 1/2 - t; past it no point is left, and the run must stop."""
    for start, h, u in product((0.3, -0.3, 0.0, 0.5), (1 / 16, 3.0), UNITS):
        w = [mpf(0.5) - k * mpf(h) for k in range(STEPS + 1)]
        truth = [(u * max(min(mpf(start), max(wk, 0)), -max(wk, 0)),) for wk in w]
        yield Cell(
            "closing walls", "sweeping", {"start": start, "step": h, "unit": u}, WALLS, h, {"a": start, "u": u},
            against(lambda truth=truth: truth), ("'left'", "'right'", "oppose each other"),
        )  # fmt: skip


DOOR = SweepingProcess(
    q=Q2, f=[0, -U], q0=[0, B], t_end=1, parameters={A: None, B: None, U: None},
    constraints={
        "right": ca.norm_2(Q2 - ca.vertcat(A, 0)) - U, "left": ca.norm_2(Q2 + ca.vertcat(A, 0)) - U,
    },
)  # fmt: skip


def door() -> Iterator[Cell]:
    """A point falls between two discs of radius u with centres (+-a, 0); gamma = 1/sqrt(1 - (a/u)^2) up to 7e5.

    On the axis the step is y+ = max(y - h, y - g r/y), r^2 = a^2 + y^2, g = r - u. A row may be missed by RELATIVE * (length
    of the prediction) + ROUNDING * u; near the corner that moves y by dg/dy = y/r times less: allowed in addition.
    """
    for gap, s, u in product((0.5, 1e-1, 1e-4, 1e-8, 1e-12), (1e-9, 1e-3, 1e-1, 1.0, 1e3), UNITS):
        a = u * (1 - gap)
        corner_y = mp.sqrt(mpf(u) ** 2 - mpf(a) ** 2)
        y0, h = float(2 * corner_y), s * float(corner_y) / u

        def step(i, row, a, u, h):
            y = row[1]
            r = mp.sqrt(a**2 + y**2)
            return (mpf(0), max(y - h * u, y - (r - u) * r / y))

        more = (RELATIVE * h * u + ROUNDING * u) * float(u / corner_y)
        at = {"gamma": float(u / corner_y), "step": s, "unit": u}
        judge = against(rows_of((0, y0), step, a=a, u=u, h=h), more)
        yield Cell("narrow door", "sweeping", at, DOOR, h, {"a": a, "b": y0, "u": u}, judge, steps=8)


# ---------------------------------------------------------------------------------------------- oscillators

SPRING = FrictionOscillator(
    x=X, potential=K * X**2 / 2, friction=A * S, s=S, x0=U, v0=B, t_end=1, parameters={K: None, A: None, U: None, B: None}
)
PLANE = FrictionOscillator(
    x=X2, potential=K * ca.sumsqr(X2) / 2, friction=A * S, s=S, x0=[U, -2 * U], v0=[B, 0], t_end=1,
    parameters={K: None, A: None, U: None, B: None},
)  # fmt: skip


def spring() -> Iterator[Cell]:
    """x'' + a Sgn x' + k x ∋ 0: v+ = soft(v - h k x, h a)/(1 + h^2 k), x+ = x + h v+. Steps in periods, a in units of k x0."""
    levels = [(level, 1.0) for level in (0.0, 1e-12, 1e-3, 0.3, 1e12)] + [(0.1, 1e-9), (0.1, 1e9)]
    for k, s, (level, u) in product((1.0, 1e4, 1e8, 1e12), NATURAL, levels):
        w = float(np.sqrt(k))
        h, a, v0 = s * 2 * np.pi / w, level * k * u, -0.3 * w * u

        def step(i, row, k, h, a):
            x, v = row
            v = soft(v - h * k * x, h * a) / (1 + h**2 * k)
            return x + h * v, v

        rows = rows_of((u, v0), step, k=k, h=h, a=a)
        place = against(lambda rows=rows: [row[:1] for row in rows()])
        speed = against(lambda rows=rows: [row[1:] for row in rows()], of="v")

        def judge(run, place=place, speed=speed, k=k):
            x, v = run.x[:, 0], run.v[:, 0]
            E = v**2 / 2 + k * x**2 / 2
            gain = float(np.max((E[1:] - E[:-1]) / (1e-12 * E[:-1])))
            return max(place(run), speed(run), gain)

        at = {"stiffness": k, "step": s, "friction": level, "unit": u}
        yield Cell("spring with friction", "oscillator", at, SPRING, h, {"k": k, "a": a, "u": u, "b": v0}, judge)


def plane() -> Iterator[Cell]:
    """The same in the plane with isotropic friction: the direction is kept, its length is thresholded."""
    for k, s, level in product((1.0, 1e6, 1e12), NATURAL, (1e-6, 0.1, 1e6)):
        w = float(np.sqrt(k))
        h, a, v0 = s * 2 * np.pi / w, level * k, -0.3 * w

        def step(i, row, k, h, a):
            w = [row[2 + j] - h * k * row[j] for j in range(2)]
            size = mp.sqrt(w[0] ** 2 + w[1] ** 2)
            factor = max(1 - h * a / size, 0) / (1 + h**2 * k) if size else mpf(0)
            v = [factor * wj for wj in w]
            return row[0] + h * v[0], row[1] + h * v[1], *v

        rows = rows_of((1, -2, v0, 0), step, k=k, h=h, a=a)
        judge = against(lambda rows=rows: [row[:2] for row in rows()])
        at = {"stiffness": k, "step": s, "friction": level}
        yield Cell("friction in the plane", "oscillator", at, PLANE, h, {"k": k, "a": a, "u": 1.0, "b": v0}, judge)


# ---------------------------------------------------------------------------------------------- first-order systems


def relay_model(theta: float) -> FirstOrderSystem:
    return FirstOrderSystem(
        x=X,
        lam=LAM,
        M=M,
        f=-K * X,
        h=X,
        g=A * LAM,
        law=relay(1),
        x0=1,
        theta=theta,
        t_end=1,
        parameters={M: None, K: None, A: None},
    )


def relays() -> Iterator[Cell]:
    """m x' = -k x + a l, l in -Sgn x: (m + th h k) x+ = soft((m - (1-th) h k) x, h a)."""
    for theta in (1.0, 0.5):
        model = relay_model(theta)
        for m, k, s in product((1e-6, 1.0, 1e6), (1.0, 1e6, 1e12), NATURAL):
            h, a = s * m / k, 0.02 * k

            def step(i, row, m, k, h, a, th):
                return (soft((m - (1 - th) * h * k) * row[0], h * a) / (m + th * h * k),)

            at = {"theta": theta, "mass": m, "stiffness": k, "step": s}
            judge = against(rows_of((1,), step, m=m, k=k, h=h, a=a, th=theta))
            yield Cell("relay", "first order", at, model, h, {"m": m, "k": k, "a": a}, judge)


PUSH = FirstOrderSystem(
    x=X2, lam=LAM, M=[[1, 0], [0, R]], f=[-U, R * U], h=X2[0] - X2[1], g=[LAM, -LAM], law=complementarity(1), x0=[9 * U, 0],
    t_end=1, parameters={R: None, U: None},
)  # fmt: skip


def pushing() -> Iterator[Cell]:
    """Speeds of two bodies, masses 1 and r, that push each other once the first is slower: then momentum alone decides."""
    for r, h, u in product(10.0 ** np.arange(-12, 13, 3), (1e-9, 1e-3, 1.0, 1e3), UNITS):

        def step(i, row, r, h, u):
            v = (row[0] - h * u, row[1] + h * u)
            together = (v[0] + r * v[1]) / (1 + r)
            return v if v[0] >= v[1] else (together, together)

        at = {"mass ratio": float(r), "step": h, "unit": u}
        judge = against(rows_of((9 * u, 0), step, r=r, h=h, u=u))
        yield Cell("two bodies pushing", "first order", at, PUSH, h, {"r": float(r), "u": u}, judge)


CUBIC = FirstOrderSystem(
    x=X, lam=LAM, f=-K * X**3, h=X, g=A * LAM, law=relay(1), x0=U, t_end=1, parameters={K: None, A: None, U: None}
)


def cubic() -> Iterator[Cell]:
    """x' = -k x^3 - a Sgn x by implicit Euler: x + h k x^3 = soft(x_k, h a), a cubic with one real root."""
    for k, s, u in product((1.0, 1e6, 1e12), NATURAL, UNITS):
        rate = k * u**2
        h, a = s / rate, 0.01 * rate * u

        def step(i, row, k, h, a):
            b = soft(row[0], h * a)
            x = b / (1 + h * k * b**2) ** mpf(1 / 3)
            for _ in range(60):
                x -= (x + h * k * x**3 - b) / (1 + 3 * h * k * x**2)
            return (x,)

        judge = against(rows_of((u,), step, k=k, h=h, a=a))
        at = {"stiffness": k, "step": s, "unit": u}
        yield Cell("cubic damping", "first order", at, CUBIC, h, {"k": k, "a": a, "u": u}, judge)


# ---------------------------------------------------------------------------------------------- Lur'e systems

RECTIFIER = LureSystem(
    t=T, A=[[-K, 0], [0, -0.5]], B=[-K, 1], C=[-1, 1], D=R, f=[K * U * ca.sin(A * T), 0], law=complementarity(1), x0=[0, 0],
    t_end=1, parameters={K: None, U: None, R: None, A: None},
)  # fmt: skip


def rectifier() -> Iterator[Cell]:
    """A diode between capacitors 1/k and 1: the better of two linear systems at each step, open and conducting."""
    for k, h, r, u in product(STIFF, NATURAL, (1e-3, 1e3), UNITS):
        wave = 2 * np.pi / (12 * h)

        def step(i, row, k, h, r, u, wave):
            b = (row[0] + h * k * u * mp.sin(wave * (i + 1) * h), row[1])
            c = (1 + h * k, 1 + h / 2)
            v = (b[0] / c[0], b[1] / c[1])
            if v[1] - v[0] >= 0:
                return v
            l = (v[0] - v[1]) / (r + h * k / c[0] + h / c[1])
            return v[0] - h * k * l / c[0], v[1] + h * l / c[1]

        at = {"stiffness": k, "step": h, "resistance": r, "unit": u}
        judge = against(rows_of((0, 0), step, k=k, h=h, r=r, u=u, wave=wave))
        yield Cell("rectifier", "Lur'e", at, RECTIFIER, h, {"k": k, "u": u, "r": r, "a": wave}, judge)


MASSES = LureSystem(
    A=[[0, 1, 0, 0], [-K, 0, K, 0], [0, 0, 0, 1], [K / R, 0, -K / R, 0]], B=[[0, 0], [1, 0], [0, 0], [0, 1]],
    C=[[0, 1, 0, 0], [0, 0, 0, 1]], law=relay(2), f=[0, 2, 0, 0], x0=[1, 0, -1, 0], t_end=1, parameters={K: None, R: None},
)  # fmt: skip


def masses() -> Iterator[Cell]:
    """Masses 1 and r on a rough floor, tied by a spring; all nine cases of stick and slip at each step.

    Friction is 1 and r (the same coefficient), so B = (1, 1) in accelerations. With K = k [[1,-1],[-1,1]] and masses
    diag(1, r): (M + h^2 K) v+ = M v + h F - h K x - h M s, s in Sgn v+.

    The two forces of the spring are differences of positions that are known to eps: what does not cancel moves both masses,
    by eps |x| h^2 k/(1 + r) in a step, and is carried on. With conditioning = h^2 k/(1 + r) the tolerance is larger by
    STEPS ROUNDING conditioning |x| (for speeds: over h). Beyond LOST the answer is not determined in doubles: the run must stop.
    """
    for r, k, h in product(10.0 ** np.arange(-9, 10, 3), (1.0, 1e6, 1e12), (1e-9, 1e-3, 1.0, 1e3)):

        def step(i, row, r, k, h):
            x1, v1, x2, v2 = row
            pull = h * k * (x2 - x1)
            b = (v1 + 2 * h + pull, r * v2 - pull)
            c, m = h**2 * k, (mpf(1), r)
            for signs in product((0, 1, -1), repeat=2):
                rhs = [b[j] - h * m[j] * signs[j] for j in range(2)]
                D = (m[0] + c, m[1] + c)
                if signs == (0, 0):
                    v = (mpf(0), mpf(0))
                elif signs[1] == 0:
                    v = (rhs[0] / D[0], mpf(0))
                elif signs[0] == 0:
                    v = (mpf(0), rhs[1] / D[1])
                else:
                    det = m[0] * m[1] + c * (m[0] + m[1])
                    v = ((D[1] * rhs[0] + c * rhs[1]) / det, (D[0] * rhs[1] + c * rhs[0]) / det)
                force = (b[0] - D[0] * v[0] + c * v[1], b[1] - D[1] * v[1] + c * v[0])
                if all(v[j] * signs[j] > 0 if signs[j] else abs(force[j]) <= h * m[j] for j in range(2)):
                    return x1 + h * v[0], v[0], x2 + h * v[1], v[1]
            raise ArithmeticError("no case of stick and slip")

        rows = rows_of((1, 0, -1, 0), step, r=r, k=k, h=h)
        conditioning = h**2 * k / (1 + float(r))

        def judge(run, rows=rows, conditioning=conditioning, h=h):
            more = STEPS * ROUNDING * conditioning * float(max(abs(value) for row in rows() for value in row[::2]))
            place = against(lambda: [row[::2] for row in rows()], more, columns=(0, 2))
            speed = against(lambda: [row[1::2] for row in rows()], more / h, columns=(1, 3))
            return max(place(run), speed(run))

        at = {"mass ratio": float(r), "stiffness": k, "step": h}
        stops = ("matrix is singular at h",) if EPS * conditioning > LOST else ()
        yield Cell("two masses", "Lur'e", at, MASSES, h, {"k": k, "r": float(r)}, judge, stops)


DISC_LAW = LureSystem(
    A=[[-K, 0], [0, -K]], B=[[1, 0], [0, 1]], C=[[1, 0], [0, 1]], law=ball(2, A), x0=[U, -2 * U], t_end=1,
    parameters={K: None, A: None, U: None},
)  # fmt: skip


def radial() -> Iterator[Cell]:
    """x' = -k x + l with l in a ball: (1 + h k) x+ is x shortened by h a, exactly 0 once it is shorter than that."""
    for k, s, level, u in product((1.0, 1e6, 1e12), NATURAL, (1e-6, 0.1), UNITS):
        h, a = s / k, level * k * u

        def step(i, row, k, h, a):
            size = mp.sqrt(row[0] ** 2 + row[1] ** 2)
            factor = max(1 - h * a / size, 0) / (1 + h * k) if size else mpf(0)
            return factor * row[0], factor * row[1]

        judge = against(rows_of((u, -2 * u), step, k=k, h=h, a=a))
        at = {"stiffness": k, "step": s, "friction": level, "unit": u}
        yield Cell("ball law", "Lur'e", at, DISC_LAW, h, {"k": k, "a": a, "u": u}, judge)


# ---------------------------------------------------------------------------------------------- inclusions

DECAY = MonotoneInclusion(x=X, field=B - K * X, lower=0, x0=U, t_end=1, parameters={K: None, B: None, U: None})


def decay() -> Iterator[Cell]:
    """x' = b - k x kept >= 0 (Example 8.1): x+ = max(x + h (b - k x), 0). Explicit: for h k > 2 it does not settle."""
    for k, s, side, u in product(STIFF, NATURAL, (0.3, -0.3), UNITS):
        h, b = s / k, side * k * u

        def step(i, row, k, h, b):
            return (max(row[0] + h * (b - k * row[0]), mpf(0)),)

        at = {"stiffness": k, "step": s, "drive": side, "unit": u}
        yield Cell(
            "decay, kept >= 0", "inclusion", at, DECAY, h, {"k": k, "b": b, "u": u}, against(rows_of((u,), step, k=k, h=h, b=b))
        )


DISC = MonotoneInclusion(
    x=X2, field=[U * K - K * X2[1], K * X2[0]], constraints={"disc": U**2 - ca.sumsqr(X2)}, x0=[U / 2, 0], t_end=1,
    parameters={K: None, U: None},
)  # fmt: skip


def disc() -> Iterator[Cell]:
    """A rotation and a push inside a disc: predict, then pull back along the radius."""
    for k, s, u in product((1.0, 1e6, 1e12), (1e-9, 1e-6, 1e-3, 1.0, 1e3), UNITS):
        h = s / k

        def step(i, row, k, h, u):
            x, y = row[0] + h * k * (u - row[1]), row[1] + h * k * row[0]
            size = mp.sqrt(x**2 + y**2)
            return (x, y) if size <= u else (u * x / size, u * y / size)

        at = {"stiffness": k, "step": s, "unit": u}
        judge = against(rows_of((u / 2, 0), step, k=k, h=h, u=u))
        yield Cell("rotation in a disc", "inclusion", at, DISC, h, {"k": k, "u": u}, judge)


STICKING = MonotoneInclusion(
    x=X, field=B - K * X, phi=A * ca.fabs(X), lower=-2 * U, upper=2 * U, x0=U, t_end=1,
    parameters={K: None, A: None, B: None, U: None},
)  # fmt: skip


def sticking() -> Iterator[Cell]:
    """x' in b - k x - a Sgn x on [-2u, 2u], explicit in the friction: the sign is that of the last state."""
    for k, s, u in product((1.0, 1e6, 1e12), NATURAL, UNITS):
        h, a, b = s / k, 0.7 * k * u, 0.1 * k * u

        def step(i, row, k, h, a, b, u):
            x = row[0]
            v = b - k * x - a * mp.sign(x) if x else mpf(0)
            return (min(max(x + h * v, -2 * u), 2 * u),)

        judge = against(rows_of((u,), step, k=k, h=h, a=a, b=b, u=u))
        at = {"stiffness": k, "step": s, "unit": u}
        yield Cell("dry friction, explicit", "inclusion", at, STICKING, h, {"k": k, "a": a, "b": b, "u": u}, judge)


SCENES = (
    line, corner, polygon, closing, door, spring, plane, relays, pushing, cubic, rectifier, masses, radial, decay, disc, sticking,
)  # fmt: skip


def cells() -> Iterator[Cell]:
    """All cells."""
    for scene in SCENES:
        yield from scene()
