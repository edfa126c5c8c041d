"""Measure every order on docs/orders.md, rewrite its tables and draw its pictures. About two minutes.

Run it from anywhere; it rewrites the tables between the marks of docs/orders.md, docs/images/orders.png and
docs/images/orders_wedge.png. References are the closed forms of tests/closed_forms.py.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from page import put
from scipy.optimize import brentq

import nsmodel
from nsmodel import FrictionOscillator, LureSystem, MonotoneInclusion, SweepingProcess, relay, second_order_cone, simulate
from nsmodel.codegen.library import compiler
from nsmodel.modeling.base import Model

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
import closed_forms as exact  # noqa: E402

IMAGES = ROOT / "docs" / "images"
INK, GREY, BLUE, RED, GREEN, ORANGE = "#30363D", "#8F9BAA", "#0072B2", "#C8501E", "#00795A", "#B7791F"
COMPILED = compiler() is not None


@dataclass(frozen=True)
class Measured:
    """Errors (n,) at steps ``h`` (n,), falling, and those of the extrapolated runs 2 x_{h/2} - x_h at h[:-1]."""

    scene: str
    h: np.ndarray
    errors: np.ndarray
    extrapolated: np.ndarray

    @property
    def order(self) -> float:
        """The slope of the least-squares line through (log h, log error)."""
        return slope(self.h, self.errors)

    @property
    def order_extrapolated(self) -> float:
        """The same for the extrapolated runs."""
        return slope(self.h[:-1], self.extrapolated)


def slope(h: np.ndarray, errors: np.ndarray) -> float:
    """The order seen: the slope of log(error) over log(h)."""
    return float(np.polyfit(np.log(h), np.log(errors), 1)[0])


# -- one measurement ---------------------------------------------------------------------------------------------------

Closed = Callable[[np.ndarray], np.ndarray]


def runs(model: Model, steps: Iterable[float], t_end: float, *, large: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """(t, x) for each step; ``large`` runs are stepped in C where there is a compiler."""
    made = (simulate(model, step=h, t_end=t_end, compiled=large and COMPILED) for h in steps)
    return [(run.t, run.x) for run in made]


def errors(made: list, closed: Closed, scale: np.ndarray | float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """The largest errors at grid points, and those of 2 x_{h/2} - x_h."""
    plain = [np.abs((x - closed(t)) / scale)[1:].max() for t, x in made]
    # A run with half the step has each grid point of the coarse one at every second row.
    richer = [np.abs((2 * fine[: 2 * len(t) : 2] - x - closed(t)) / scale)[1:].max() for (t, x), (_, fine) in pairwise(made)]
    return np.array(plain), np.array(richer)


def measure(
    scene: str,
    models: list[tuple[Model, Closed]],
    steps: np.ndarray,
    t_end: float,
    *,
    scale: np.ndarray | float = 1.0,
    large: bool = False,
) -> Measured:
    """The root mean square over the models (one, or several starts) of the largest errors."""
    both = [errors(runs(model, steps, t_end, large=large), closed, scale) for model, closed in models]
    plain, richer = (np.sqrt(np.mean(np.square([pair[i] for pair in both]), axis=0)) for i in (0, 1))
    return Measured(scene, steps, plain, richer)


def case(stem: str, **changes: object) -> Model:
    """A case file's model with some of its settings changed."""
    model = copy(nsmodel.load(stem))
    for name, value in changes.items():
        object.__setattr__(model, name, value)
    return model


def halved(t_end: float, coarsest: int, count: int) -> np.ndarray:
    """t_end/coarsest and its halves."""
    return t_end / (coarsest * 2.0 ** np.arange(count))


# -- sweeping processes ------------------------------------------------------------------------------------------------


def wedge_model(scene: exact.Wedge) -> SweepingProcess:
    """The two planes of ``scene`` as expressions of t."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    P, alpha, last = scene.period, scene.alpha, scene.count - 1
    following = np.minimum(np.arange(scene.count) + 1, last)

    def block(values: np.ndarray) -> ca.SX:
        values = np.asarray(values, float).tolist()
        return ca.pw_const(t, scene.start[1:-1].tolist(), values) if last else ca.SX(values[0])

    p, n, top = block(P), block(scene.periods), block((1 + alpha**2) * P / 4)
    pause = ca.fmax(0, (t - block(scene.start[:-1] + scene.periods * P)) / block(scene.pause))
    s = ca.fmin((t - block(scene.start[:-1])) / p, n)
    u, y = s - ca.floor(s), block(scene.height) + ca.floor(s) * p / 2
    low = -(p + block(P[following] - P) * pause) / 4
    A = y + ca.if_else(u < 0.5, low + (top - low) * 2 * u, top + (p / 4 - top) * (2 * u - 1))
    C = y + p * ca.if_else(u < 0.5, -u / 2, -0.25 + 0.75 * (2 * u - 1))
    tilt = (block(alpha) + block(alpha[following] - alpha) * pause) * q[0]
    end = float(scene.start[-1])
    return SweepingProcess(t=t, q=q, constraints={"A": q[1] - A - tilt, "C": q[1] - C + tilt}, q0=[0, 0], t_end=end, step=2**-6)


def wedge(label: str, scene: exact.Wedge, finest: int = 11, coarsest: int = 5, factor: float = 1.0) -> Measured:
    """The errors of a wedge at h = 2^-coarsest .. 2^-finest, times a factor."""
    steps = factor * 2.0 ** -np.arange(coarsest, finest + 1)
    t_end = np.floor(scene.start[-1] / steps[0]) * steps[0]
    return measure(label, [(wedge_model(scene), scene.path)], steps, t_end, large=finest > 9)


def line(label: str, closed: Closed, f: Callable[[ca.SX], ca.SX], wall: Callable[[ca.SX], ca.SX]) -> Measured:
    """One coordinate on (0, 1), driven by f(t) and kept above a wall."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q")
    q0 = closed(np.zeros(1))[0]
    model = SweepingProcess(t=t, q=q, f=f(t), constraints={"wall": q - wall(t)}, q0=q0, t_end=1, step=0.1)
    return measure(label, [(model, closed)], 2.0 ** -np.arange(4, 12), 1)


def lacunary(t: ca.SX, theta: float) -> ca.SX:
    """The sum of ``closed_forms.lacunary``: the part of a turn is taken before the cosine, which is exact on dyadic grids."""
    turns = [2.0**j * t for j in range(1, 41)]
    return sum(2 ** (-theta * j) * ca.cos(2 * np.pi * (s - ca.floor(s))) for j, s in enumerate(turns, 1))


def sweeping() -> dict[str, list[Measured]]:
    """The scenes of the theory, the wedges, and what breaks a hypothesis."""
    smooth = [
        measure(name, [(case(stem), closed)], halved(t_end, 50, 6), t_end)
        for name, stem, closed, t_end in (
            ("P2 half-line that moves, f = -q", "moving_half_line", exact.half_line, 3),
            ("P3 point carried past a disc", "point_past_disc", exact.point_past_disc, 4.5),
            ("P4 disc that pushes a point", "moving_disc", exact.moving_disc, 4),
        )
    ]
    wedges = [
        wedge("wedge, all T_k = 1", exact.Wedge(beta=0)),
        wedge("wedge, all T_k = 1, steps 0.618 2^-k", exact.Wedge(beta=0), factor=0.618),
        wedge("wedge, T_k = 2^(-k/10)", exact.Wedge(beta=0.1)),
        wedge("wedge, T_k = 2^(-k/3)", exact.Wedge(beta=1 / 3)),
        wedge("the same shaking, fixed slope 1/2", exact.Wedge(beta=0, slope=0.5)),
        wedge("the same shaking, fixed slope 1/8", exact.Wedge(beta=0, slope=0.125)),
    ]
    zero, far = (lambda t: 0 * t), (lambda t: 0 * t - 9)
    broken = [
        line("f Hoelder 1/4 in t", lambda t: exact.lacunary(t, 0.25)[1][:, None], lambda t: lacunary(t, 0.25), far),
        line("f Hoelder 1/2 in t", lambda t: exact.lacunary(t, 0.5)[1][:, None], lambda t: lacunary(t, 0.5), far),
        line(
            "wall at -sqrt(abs(t - 1/3))", lambda t: -np.sqrt(np.maximum(1 / 3 - t, 0))[:, None],
            zero, lambda t: -ca.sqrt(ca.fabs(t - 1 / 3)),
        ),
        line(
            "f jumps from 1 to -1 at t = 1/3", lambda t: (1 / 3 - np.abs(t - 1 / 3))[:, None],
            lambda t: ca.if_else(t < 1 / 3, 1, -1), far,
        ),
    ]  # fmt: skip
    return {"smooth": smooth, "wedges": wedges, "broken": broken}


# -- the search --------------------------------------------------------------------------------------------------------


def rough(s: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """sum_j 2^-j (j+1)^-3/2 tri(2^j s + phase): Lipschitz, with a speed of unbounded variation as the sum goes on."""
    j = np.arange(14)
    part = (s[..., None] * 2.0**j + phase[..., None] * (j + 1) ** 2) % 1.0
    return ((4 * np.abs(part - 0.5) - 1) * (0.25 * 2.0**-j / (j + 1) ** 1.5)).sum(axis=-1)


class RandomScenes:
    """Points in the plane, each among two moving walls (discs or planes), f Lipschitz with kinks; all stepped at once."""

    def __init__(self, count: int, discs: bool, shakes: bool, seed: int = 1) -> None:
        u = np.random.default_rng(seed).uniform
        self.discs, shape = discs, (count, 2, 2)  # scene, wall, coordinate of the motion
        self.radius = u(0.5, 2, (count, 2))
        if discs:
            angle, away = u(-2.6, -0.5, (count, 2)), self.radius + u(0, 0.3, (count, 2))
            self.base = np.stack([away * np.cos(angle), away * np.sin(angle)], axis=-1)
        else:
            self.base = np.stack([np.pi / 2 + u(-0.8, 0.8, (count, 2)), u(-0.3, 0, (count, 2))], axis=-1)
        self.speed, self.swing, self.rate, self.phase = (
            u(-0.5, 0.5, shape),
            u(-0.2, 0.2, shape),
            u(1, 12, shape),
            u(0, 6.3, shape),
        )
        self.shake, self.beat, self.offset = float(shakes) * u(-2, 2, shape), u(0.5, 3, shape), u(0, 1, shape)
        self.force = u(-1, 1, (7, count, 2))
        self.force[0, :, 1] -= 1

    def only(self, chosen: np.ndarray) -> RandomScenes:
        """Some of the scenes."""
        part = copy(self)
        for name in ("radius", "base", "speed", "swing", "rate", "phase", "shake", "beat", "offset"):
            setattr(part, name, getattr(self, name)[chosen])
        part.force = self.force[:, chosen]
        return part

    def f(self, t: float, q: np.ndarray) -> np.ndarray:
        """The velocity (count, 2) without walls."""
        a, b, c, d, e, g, k = self.force
        return a + b * np.abs(q - c / 2) + d * np.sin(15 * e * t) + g * np.abs(np.sin(15 * k * t)) + c * q[:, ::-1]

    def run(self, n: int, keep: int, t_end: float = 2.0) -> np.ndarray:
        """The positions (keep + 1, count, 2) on every (n/keep)-th point of the grid; NaN where no point is admissible."""
        h, q = t_end / n, np.tile([0.0, 0.35], (len(self.radius), 1))
        kept = [q]
        for k in range(n):
            t = (k + 1) * h
            m = self.base + self.speed * t + self.swing * np.sin(self.rate * t + self.phase)
            m = m + self.shake * rough(self.beat * t, self.offset) / self.beat if self.shake.any() else m
            if self.discs:
                away = q[:, None] - m
                size = np.linalg.norm(away, axis=-1)
                G, gap = away / size[..., None], size - self.radius
            else:
                G = np.stack([np.cos(m[..., 0]), np.sin(m[..., 0])], axis=-1)
                gap = np.einsum("sij,sj->si", G, q) - m[..., 1]
            q = self._project(q + h * self.f(t - h, q), G, np.einsum("sij,sj->si", G, q) - gap)
            if (k + 1) % (n // keep) == 0:
                kept.append(q)
        return np.array(kept)

    @staticmethod
    def _project(p: np.ndarray, G: np.ndarray, b: np.ndarray) -> np.ndarray:
        """The nearest points with G q >= b, two unit rows each: p, on one row, or on both."""
        lack = b - np.einsum("sij,sj->si", G, p)
        cosine = np.einsum("si,si->s", G[:, 0], G[:, 1])[:, None]
        both = (lack - cosine * lack[:, ::-1]) / np.maximum(1 - cosine**2, 1e-300)
        alone = (lack > 0) & (cosine * lack >= lack[:, ::-1])  # its push is enough for the other row
        m = np.where(alone.any(axis=1, keepdims=True), np.where(alone, lack, 0), both)
        m = np.where((lack <= 0).all(axis=1, keepdims=True), 0, m)
        m[(m < 0).any(axis=1)] = np.nan
        return p + np.einsum("si,sij->sj", m, G)


@dataclass(frozen=True)
class Searched:
    """Orders of random scenes with 2^6 .. 2^9 steps against 2^12, and of the five lowest with 2^7 .. 2^10 against 2^14."""

    label: str
    orders: np.ndarray
    lowest: np.ndarray


def search(label: str, discs: bool, shakes: bool, count: int = 200) -> Searched:
    """Scenes that stay admissible and are not stepped exactly."""
    scenes = RandomScenes(count, discs, shakes)
    orders = fitted(scenes, range(6, 10), 12)
    lowest = np.argsort(orders)[:5]
    return Searched(label, orders[np.isfinite(orders)], fitted(scenes.only(lowest), range(7, 11), 14))


def fitted(scenes: RandomScenes, powers: range, finest: int) -> np.ndarray:
    """The order seen (scenes,) at 64 times; inf where a scene fails or has no error."""
    reference = scenes.run(2**finest, 64)
    worst = np.array([np.abs(scenes.run(2**k, 64) - reference).max(axis=(0, 2)) for k in powers])
    good = np.isfinite(worst).all(axis=0) & (worst.min(axis=0) > 1e-8)
    found = np.full(good.size, np.inf)
    found[good] = -np.polyfit(powers, np.log2(worst[:, good]), 1)[0]
    return found


# -- the other classes -------------------------------------------------------------------------------------------------

SPEEDS = -np.linspace(0.3, 3, 8)  # at the start of the friction oscillators: for each a turn falls on another part of its step


def oscillator(v0: float) -> FrictionOscillator:
    """Class O: x'' + x + Sgn(x') from (12, v0), which turns first after t = 2.87."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=x**2 / 2, friction=s, s=s, x0=12, v0=v0, t_end=9, step=0.01)


def relay_oscillator(v0: float, theta: float, gamma: float) -> LureSystem:
    """The same as a relay."""
    law, A = relay(1), [[0, 1], [-1, 0]]
    return LureSystem(A=A, B=[0, 1], C=[0, 1], law=law, x0=[12, v0], t_end=9, step=0.01, theta=theta, gamma=gamma)


def friction() -> list[Measured]:
    """Class O: the position up to the first turn, and across all."""
    models = [(oscillator(v0), lambda t, v0=v0: exact.friction_free(t, 12, v0)[:, :1]) for v0 in SPEEDS]
    return [
        measure("friction oscillator, before its first turn", models[:1], halved(2.8, 140, 5), 2.8),
        measure("friction oscillator, across its turns", models, halved(9, 450, 5), 9),
    ]


def first_order() -> list[Measured]:
    """Classes F and L: what theta and gamma do in a smooth phase and across each kind of switch."""
    diodes, bridges, slides, jumps, circuit = [], [], [], [], {"scale": np.array([10.0, 0.1])}
    for theta, gamma in ((1.0, 1.0), (0.5, 0.5), (0.5, 1.0)):
        both, name = {"theta": theta, "gamma": gamma}, f"theta = {theta:g}, gamma = {gamma:g}"
        diode, bridge = [(case("rlc_diode", **both), exact.rlc_diode)], [(case("diode_bridge", **both), exact.diode_bridge)]
        diodes += [
            measure(f"one diode, conducts: {name}", diode, halved(1.5e-4, 30, 5), 1.5e-4, **circuit),
            measure(f"one diode, across its switches: {name}", diode, halved(2e-3, 400, 5), 2e-3, **circuit),
        ]
        bridges.append(measure(f"diode bridge: {name}", bridge, halved(2e-3, 400, 5), 2e-3, **circuit))
        slide = [(sliding(a, theta, gamma), lambda t, a=a: sliding_exact(t, a)) for a in np.linspace(1, 1.4, 8)]
        slides.append(measure(f"relay starts to slide: {name}", slide, halved(3, 50, 6), 3))
        relays = [(relay_oscillator(v0, theta, gamma), lambda t, v0=v0: exact.friction_free(t, 12, v0)) for v0 in SPEEDS]
        jumps.append(measure(f"relay jumps at each turn: {name}", relays, halved(9, 450, 5), 9))
    return [*diodes, *bridges, *slides, *jumps]


def sliding(a: float, theta: float, gamma: float) -> LureSystem:
    """x' = (1 + sin(2t)/2, -1 - x_2) + (2, 2) l, l in -Sgn(x_1), x(0) = (a, 0): x_1 = 0 is reached and then kept."""
    t, B, A = ca.SX.sym("t"), [2, 2], [[0, 0], [0, -1]]
    f = [1 + ca.sin(2 * t) / 2, -1]
    return LureSystem(t=t, A=A, B=B, C=[1, 0], f=f, law=relay(1), x0=[a, 0], t_end=3, step=0.01, theta=theta, gamma=gamma)


def sliding_exact(t: np.ndarray, a: float) -> np.ndarray:
    """l = -1 until x_1 = 0, then l = -(1 + sin(2t)/2)/2, so that x_2' = -x_2 - 2 - sin(2t)/2."""
    free = lambda t: a - t + (1 - np.cos(2 * t)) / 4  # noqa: E731
    reach = brentq(free, 0, 3, xtol=1e-15)
    forced = lambda t: -2 - (np.sin(2 * t) - 2 * np.cos(2 * t)) / 10  # noqa: E731
    after = forced(t) + (3 * np.expm1(-reach) - forced(reach)) * np.exp(-np.maximum(t - reach, 0))
    return np.column_stack([np.where(t < reach, free(t), 0), np.where(t < reach, 3 * np.expm1(-t), after)])


def lure() -> list[Measured]:
    """Implicit Euler: a rough f, and starts where the velocity is infinite."""
    t, made = ca.SX.sym("t"), []
    steps = 2.0 ** -np.arange(4, 12)
    for theta in (0.5, 0.25):
        model = LureSystem(t=t, A=[[0]], B=[1], C=[1], f=[lacunary(t, theta)], law=relay(1), x0=[9], t_end=1, step=0.1)
        closed = lambda t, theta=theta: (9 - t + exact.lacunary(t, theta)[1])[:, None]  # noqa: E731
        made.append(measure(f"f Hoelder 1/{1 / theta:g} in t", [(model, closed)], steps, 1))
    jump = LureSystem(A=[[-1]], B=[1], C=[1], f=[0.5], law=nsmodel.complementarity(1), x0=[-1], t_end=1, step=0.1)
    made.append(measure("start outside the domain: a jump at t = 0", [(jump, lambda t: -np.expm1(-t)[:, None] / 2)], steps, 1))
    for name, kind, zv in (
        ("cone, D on w, from the interior", "w", 0.3), ("cone, D on w, from the boundary", "w", 0.0),
        ("cone, D on u, from the interior", "u", 0.3), ("cone, D on u, from the boundary", "u", 0.0),
    ):  # fmt: skip
        closed = lambda t, kind=kind, zv=zv: exact.cone_start(t, kind, zv)  # noqa: E731
        made.append(measure(name, [(cone(kind, zv), closed)], halved(0.2, 25, 6), 0.2))
    return made


def cone(kind: str, start: float) -> LureSystem:
    """x' = l, K in l, y = x + D l in K, the second-order cone of R^3; see ``closed_forms.cone_start``."""
    d = exact.CONE["uvw".index(kind)]
    x0 = exact.CONE @ ([0, start, 1] if kind == "u" else [start, 1, 1])
    return LureSystem(
        A=np.zeros((3, 3)), B=np.eye(3), C=np.eye(3), D=np.outer(d, d), law=second_order_cone(3), x0=x0, t_end=0.2, step=0.1
    )


DIAGONAL = {"K": np.array([1.0, 2.0, 4.0]), "b": np.array([3.0, 0.5, -4.0]), "mu": np.ones(3), "lower": -2.0, "upper": 1.5}


def disc(eps: Callable[[float], float] | None) -> MonotoneInclusion:
    """x' in (1, 0) - N_C(x), C the unit disc."""
    x = ca.SX.sym("x", 2)
    inside = 1 - x[0] ** 2 - x[1] ** 2
    return MonotoneInclusion(x=x, field=[1, 0], constraints={"disc": inside}, x0=[-0.5, 0.6], t_end=3, step=0.1, tolerances=eps)


def inclusions() -> list[Measured]:
    """Catching-up with an exact projection and with eps = mu^2, mu^3, mu^4."""
    made = []
    for name, power in (("exact projection", None), *((f"eps = mu^{p}", p) for p in (2, 3, 4))):
        eps = None if power is None else (lambda mu, power=power: mu**power)
        models = []
        for x0 in (2.0, 1.9):  # starts that let the state meet 0 on other parts of a step
            models.append((case("inclusion_8_1", tolerances=eps, x0=ca.DM(x0)), lambda t, x0=x0: exact.inclusion_8_1(t, x0=x0)))
        made.append(measure(f"8.1: {name}", models, halved(2, 400, 4), 2))
        models = []
        for i in range(4):
            x0 = np.array([-1, 1.5 - 0.021 * i, 1])
            closed = lambda t, x0=x0: exact.inclusion_8_2_diagonal(t, **DIAGONAL, x0=x0)  # noqa: E731
            models.append((case("inclusion_8_2", tolerances=eps, x0=ca.DM(x0)), closed))
        made.append(measure(f"8.2: {name}", models, halved(4, 200, 4), 4))
        made.append(measure(f"disc: {name}", [(disc(eps), exact.inside_disc)], halved(3, 40, 3), 3))
    return made


# -- the page ----------------------------------------------------------------------------------------------------------


def digits(order: float) -> str:
    """Two digits, without -0.00."""
    return f"{round(order, 2) + 0.0:.2f}"


def table(measured: Iterable[Measured], extrapolated: bool = False) -> str:
    """Markdown: a row for each measurement."""
    head = ["scene", "coarsest h", "finest h", "error there", "order"] + ["of 2 x_{h/2} - x_h"] * extrapolated
    rows = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for m in measured:
        cells = [m.scene, f"{m.h[0]:.1e}", f"{m.h[-1]:.1e}", f"{m.errors[-1]:.1e}", digits(m.order)]
        rows.append("| " + " | ".join(cells + [digits(m.order_extrapolated)] * extrapolated) + " |")
    return "\n".join(rows)


def searched(found: Iterable[Searched]) -> str:
    """Markdown: quantiles of the orders of random scenes."""
    rows = ["| scenes | how many | least | 1 % | 5 % | 25 % | median | the five lowest, finer |", "| --- |" + " ---: |" * 7]
    for one in found:
        shares = " | ".join(f"{v:.2f}" for v in np.quantile(one.orders, (0, 0.01, 0.05, 0.25, 0.5)))
        finer = ", ".join(f"{v:.2f}" for v in one.lowest)
        rows.append(f"| {one.label} | {len(one.orders)} | {shares} | {finer} |")
    return "\n".join(rows)


def artefacts() -> str:
    """Markdown: slopes that are not the order."""
    early = wedge("", exact.Wedge(count=1, coarsest=11), finest=10)
    t, q, steps = ca.SX.sym("t"), ca.SX.sym("q"), 2.0 ** -np.arange(4, 12)
    rough_f = SweepingProcess(t=t, q=q, f=lacunary(t, 0.5), q0=0, t_end=1, step=0.1)
    made = [x for _, x in runs(rough_f, steps, 1)]
    against = [np.abs(x - made[-1][:: (len(made[-1]) - 1) // (len(x) - 1)]).max() for x in made[:-1]]
    swing = measure("", [(relay_oscillator(-3, 0.5, 0.5), lambda t: exact.friction_free(t, 12, -3))], halved(9, 450, 6), 9)
    rows = [
        ("wedge with one period, P = 2^-11, at h = 2^-5 .. 2^-10", digits(early.order), "no error for h = P/2, P/4, ..."),
        (
            "f Hoelder 1/2 of section 2.3, h = 2^-4 .. 2^-10, against the run with h = 2^-11",
            f"{slope(steps[:-1], np.array(against)):.2f}",
            "0.50",
        ),
        (
            "relay that jumps, theta = gamma = 0.5, one start, halving by halving",
            " ".join(f"{v:.1f}" for v in np.log2(swing.errors[:-1] / swing.errors[1:])),
            "1, seen over many starts",
        ),
    ]
    lines = ("| " + " | ".join(row) + " |" for row in rows)
    return "\n".join(["| what is measured | slope | the truth |", "| --- | ---: | --- |", *lines])


# -- the pictures ------------------------------------------------------------------------------------------------------


def dress(ax: Axes, title: str, xlabel: str, ylabel: str) -> None:
    """Give the axes their words."""
    ax.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK)
    ax.set_xlabel(xlabel, fontsize=9)
    ax.set_ylabel(ylabel, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)


def loglog(ax: Axes, title: str, lines: list[tuple[Measured, str, str]], slopes: dict[str, float]) -> None:
    """Errors over h with the fitted orders in the legend, and grey lines of given slopes through the top right corner."""
    for measured, colour, label in lines:
        ax.loglog(measured.h, measured.errors, "o-", color=colour, ms=3.5, lw=1.4, label=f"{label}: {digits(measured.order)}")
    h = np.array([min(m.h[-1] for m, *_ in lines), max(m.h[0] for m, *_ in lines)])
    low, high = min(m.errors.min() for m, *_ in lines), 2 * max(m.errors.max() for m, *_ in lines)
    for name, p in slopes.items():
        ax.plot(h, high * (h / h[1]) ** p, color=GREY, lw=0.8, ls=(0, (4, 3)), zorder=0)
        at = max(h[0], h[1] * (1.5 * low / high) ** (1 / p))
        style = {"textcoords": "offset points", "fontsize": 7.5, "color": GREY, "ha": "left", "va": "bottom"}
        ax.annotate(f"slope {name}", (at, high * (at / h[1]) ** p), (-8, 7), **style)
    ax.set_ylim(low / 6, 4 * high)
    ax.xaxis.set_minor_formatter(NullFormatter())
    dress(ax, title, "step h", "largest error")
    ax.legend(fontsize=7.5, frameon=False, loc="lower right", title="orders", title_fontsize=7.5, borderaxespad=0.1)


def overview(found: dict[str, list[Measured]]) -> Figure:
    """Four panels: sweeping, theta and gamma, Lur'e, catching-up."""
    figure = Figure(figsize=(9.6, 7.8), layout="constrained")
    axes = figure.subplots(2, 2)
    smooth, wedges = found["smooth"], found["wedges"]
    lines = [
        (wedges[0], RED, "wedge, $T_k$ = 1"),
        (wedges[3], ORANGE, "wedge, $T_k$ = $2^{-k/3}$"),
        (wedges[4], GREEN, "its slope kept at 1/2"),
        (smooth[1], BLUE, "point past a disc"),
    ]
    loglog(axes[0, 0], "Sweeping processes", lines, {"1/2": 0.5, "1": 1})
    by = {m.scene: m for measured in found.values() for m in measured}
    weights = (("1", "1", BLUE), ("0.5", "1", ORANGE), ("0.5", "0.5", GREEN))
    lines = [
        (by[f"one diode, across its switches: theta = {a}, gamma = {b}"], colour, rf"diode, $\theta$ = {a}, $\gamma$ = {b}")
        for a, b, colour in weights
    ]
    circuit = [(Measured(m.scene, m.h / 2e-3, m.errors, m.extrapolated), *rest) for m, *rest in lines]
    jumps = by["relay jumps at each turn: theta = 0.5, gamma = 0.5"]
    relays = (Measured(jumps.scene, jumps.h / 9, jumps.errors, jumps.extrapolated), RED, r"relay, $\theta$ = $\gamma$ = 0.5")
    loglog(axes[0, 1], "Theta-gamma across switches", [*circuit, relays], {"1": 1, "2": 2})
    axes[0, 1].set_xlabel("step h, over the length of the run", fontsize=9)
    names = (
        ("cone, D on u, from the interior", BLUE, "cone, from inside"),
        ("cone, D on w, from the boundary", ORANGE, r"cone, edge, $\Phi$ finite"),
        ("cone, D on u, from the boundary", RED, r"cone, edge, $\Phi$ infinite"),
    )
    loglog(axes[1, 0], "Lur'e, implicit Euler", [(by[n], c, label) for n, c, label in names], {"1/4": 0.25, "2/3": 2 / 3, "1": 1})
    names = (
        ("8.1: exact projection", BLUE, "exact projection"),
        ("8.1: eps = mu^4", GREEN, r"$\epsilon$ = $\mu^4$"),
        ("8.1: eps = mu^3", ORANGE, r"$\epsilon$ = $\mu^3$"),
        ("8.1: eps = mu^2", RED, r"$\epsilon$ = $\mu^2$"),
    )
    loglog(axes[1, 1], "Catching-up, Example 8.1", [(by[n], c, label) for n, c, label in names], {"1/2": 0.5, "1": 1})
    return figure


def valley() -> Figure:
    """The heights of the planes beside what a grid sees of them, and how far the computed point drifts."""
    figure = Figure(figsize=(9.6, 3.7), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.1, 1])
    scene = exact.Wedge(count=1, coarsest=3)
    P, t = scene.period[0], np.linspace(0, 3 * scene.period[0], 1201)
    A, C, _ = scene.planes(t)
    left.plot(t / P, scene.path(t)[:, 1] / P, color=INK, lw=5, alpha=0.18, solid_capstyle="butt")
    left.plot(t / P, A / P, color=RED, lw=1.5)
    left.plot(t / P, C / P, color=BLUE, lw=1.5)
    grid = np.arange(4)
    on_grid = scene.planes(grid * P)
    left.plot(grid, on_grid[1] / P, "o", color=BLUE, ms=6, zorder=5)
    left.plot(grid, on_grid[0] / P, "o", color=RED, ms=6, zorder=5, mfc="white")
    for k in grid:
        left.axvline(k, color=GREY, lw=0.7, ls=(0, (4, 3)), zorder=0)
    left.text(0.28, 0.16, "A", color=RED, fontsize=12, ha="right")
    left.text(0.84, 0.28, "C", color=BLUE, fontsize=12, ha="right")
    left.text(2.2, 1.08, "point", color=INK, alpha=0.7, fontsize=10, ha="center")
    dress(left, "A grid with h = P: all tops of C, none of A", "t / P", "height at x = 0, over P")
    scene = exact.Wedge(count=3, coarsest=4)
    end = scene.start[-1]
    for k, colour in ((4, RED), (5, ORANGE), (6, GREEN)):
        run = simulate(wedge_model(scene), step=2.0**-k, t_end=end)
        right.plot(run.t, run.q[:, 0], color=colour, lw=1.6)
        place = (scene.start[k - 4] + 0.5, scene.drift(k - 4) / 2)
        right.annotate(f"h = $2^{{-{k}}}$", place, (6, -4), textcoords="offset points", fontsize=9, color=colour, va="top")
    fine = np.linspace(0, end, 6001)
    right.plot(fine, scene.path(fine)[:, 0], color=INK, lw=0.8)
    right.text(end + 0.06, 0, "exact", color=INK, fontsize=9, va="center")
    for k, start in enumerate(scene.start[:-1]):
        right.axvline(start, color=GREY, lw=0.7, ls=(0, (4, 3)), zorder=0)
        right.text(start + 0.04, 0.0725, f"P = $2^{{-{4 + k}}}$", fontsize=8.5, color=GREY, va="top")
    right.set_xlim(-0.02, end + 0.55)
    right.set_ylim(-0.01, 0.074)
    dress(right, "Lifted by C alone, the computed point drifts", "t", "x")
    return figure


def main() -> None:
    """Measure, rewrite the tables, draw."""
    found = sweeping() | {"friction": friction(), "first order": first_order(), "lure": lure(), "inclusions": inclusions()}
    shaken = [
        search(f"{shape}, {how} motion", discs, how == "rough")
        for shape, discs in (("two discs", True), ("two planes", False))
        for how in ("smooth", "rough")
    ]
    tables = {name: table(measured, extrapolated=name != "broken") for name, measured in found.items()}
    tables |= {"search": searched(shaken), "artefacts": artefacts()}
    for name, text in tables.items():
        put("orders.md", name, text)
    overview(found).savefig(IMAGES / "orders.png", dpi=85)
    valley().savefig(IMAGES / "orders_wedge.png", dpi=110)


if __name__ == "__main__":
    main()
