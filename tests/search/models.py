"""Random models of each class, by seed: the arguments of the class, and the small models a large one is stacked of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.linalg import block_diag

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    box,
    complementarity,
    product,
    relay,
)

Arguments = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One model of the search; ``parts`` are the arguments of the small models it is stacked of, if it is."""

    name: str
    seed: int
    kind: str
    scene: str
    arguments: Arguments
    parts: Sequence[Arguments] = field(default=())

    @property
    def id(self) -> str:
        return f"{self.name}:{self.seed}"

    def model(self, part: int | None = None) -> Any:
        return KINDS[self.name](**(self.arguments if part is None else self.parts[part]))


class Draw:
    """Random numbers of one model."""

    def __init__(self, *seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rng, name)

    def chance(self, p: float = 0.5) -> bool:
        return bool(self.rng.random() < p)

    def one_of(self, *values: Any) -> Any:
        return values[self.rng.integers(len(values))]

    def count(self, least: int = 1, most: int = 60) -> int:
        """Small numbers as often as large ones."""
        return int(np.clip(np.floor(least * (most / least + 0.99) ** self.rng.random()), least, most))

    def size(self, low: float, high: float) -> float:
        return float(10.0 ** self.rng.uniform(low, high))

    def units(self, n: int, decades: float = 8) -> np.ndarray:
        """A unit for each row: all 1, one for all, or one each; powers of 2 (which keep sums exact) or of 10."""
        kind = self.one_of(0, 0, 1, 2, 2)
        if kind == 0:
            return np.ones(n)
        e = np.full(n, self.rng.uniform(-decades, decades)) if kind == 1 else self.rng.uniform(-decades, decades, n)
        return 2.0 ** np.round(e * np.log2(10)) if self.chance() else 10.0 ** np.round(e)

    def masses(self, n: int) -> np.ndarray:
        """1, or from 1 to a ratio of up to 1e12."""
        if self.chance(0.6):
            return np.ones(n)
        return 10.0 ** (self.one_of(2, 6, 8, 10, 12) * self.one_of(self.rng.random(n), self.rng.integers(0, 2, n)))

    def at_rest(self, values: np.ndarray) -> np.ndarray:
        """The values, half of the time most of them 0."""
        return values if self.chance() else np.where(self.rng.random(values.shape) < 0.9, 0.0, values)

    def psd(self, n: int) -> np.ndarray:
        R = self.rng.normal(size=(self.rng.integers(0, n + 1), n))
        return R.T @ R / n

    def start(self) -> float:
        """The size of a start: 1, or as small as a state that has decayed for long."""
        return 1.0 if self.chance(0.7) else self.size(-80, 0)

    def grid(self, h: float, steps: int | None = None) -> Arguments:
        n = steps or self.count(6, 40)
        return {"step": h, "t_end": h * n}


# ---------------------------------------------------------------------------------------------- Lur'e


def _lure_bounds(d: Draw, m: int) -> tuple[np.ndarray, np.ndarray]:
    kind = d.one_of("complementarity", "relay", "mixed")
    lower, upper = np.zeros(m), np.full(m, np.inf)
    two = np.ones(m, bool) if kind == "relay" else np.zeros(m, bool) if kind == "complementarity" else d.random(m) < 0.5
    mu = d.one_of(1.0, d.uniform(0.5, 1.5, m), d.uniform(0.5, 1.5, m) * 10.0 ** d.uniform(-4, 4, m))
    lower[two], upper[two] = np.broadcast_to(-mu, m)[two], np.broadcast_to(mu, m)[two]
    return lower, upper


def _lure(d: Draw, parts: Arguments) -> Arguments:
    """The parts (numbers A B C D lower upper x0 f0 f1, omega) in units x = S x', y = V y', l = U l', as the class wants them."""
    n, m = parts["B"].shape
    S, V = d.units(n), d.units(m)
    U = V if d.chance() else d.units(m)
    t = ca.SX.sym("t")
    wave = ca.sin(parts["omega"] * t) if parts["omega"] else t
    f = ca.DM(S * parts["f0"]) + ca.DM(S * parts["f1"]) * wave
    A, B = S[:, None] * parts["A"] / S, S[:, None] * parts["B"] / U
    C, D = V[:, None] * parts["C"] / S, V[:, None] * parts["D"] / U
    sparse = n + m > 30 and d.chance()
    kind = sp.csc_matrix if sparse else (lambda M: M)
    return {
        "t": t, "A": kind(A), "B": kind(B), "C": kind(C), **({"D": kind(D)} if D.any() else {}), "f": f,
        "law": box(list(U * parts["lower"]), list(U * parts["upper"])), "x0": S * parts["x0"],
        "theta": parts["theta"], **parts["grid"],
    }  # fmt: skip


def lure_passive(d: Draw, m: int) -> Arguments:
    """A dissipative, C = B': states relax under diodes, relays and saturations."""
    n = max(1, int(m * d.one_of(0.5, 1, 1, 2)))
    skew = d.normal(size=(n, n)) / np.sqrt(n)
    rate = d.size(-1, 2)
    A = -rate * (d.psd(n) + d.one_of(0, 1) * (skew - skew.T) + d.one_of(0, 0.1) * np.eye(n))
    B = d.normal(size=(n, m)) * d.one_of(1.0, (d.random((n, m)) < 0.3))
    if m <= n and d.chance(0.3):
        B = np.eye(n, m)
    D = d.one_of(
        np.zeros((m, m)),
        d.psd(m),
        np.diag(d.random(m)) * d.size(-6, 0),
        d.psd(m) + np.triu(np.ones((m, m)), 1) - np.tril(np.ones((m, m)), -1),
    )
    lower, upper = _lure_bounds(d, m)
    x0 = d.start() * d.at_rest(d.normal(size=n))
    if (lower == 0).any() and not D.any():  # consistent start: B' x0 >= 0 on the diodes
        x0 = np.zeros(n) if d.chance() else B @ np.abs(d.normal(size=m)) if d.chance() else x0
    return {
        "A": A, "B": B, "C": B.T, "D": D, "lower": lower, "upper": upper, "x0": x0,
        "f0": d.at_rest(d.normal(size=n)), "f1": d.at_rest(d.normal(size=n)), "omega": d.one_of(0.0, 1.0),
        "theta": d.one_of(1.0, 1.0, 0.5), "grid": d.grid(d.one_of(1e-3, 1e-2, 0.1, 1.0) / max(rate, 1.0)),
    }  # fmt: skip


def lure_chain(d: Draw, n: int) -> Arguments:
    """Blocks and springs, all or most at rest, dry friction of random size, a pull that grows; positions far from 0."""
    k = d.size(0, 4)
    K = k * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) if n > 1 else np.array([[k]])
    away = d.one_of(0.0, 0.0, 1e3, 1e6, 1e9)
    if away:
        K[0, 0] = K[-1, -1] = k if n > 1 else 0.0
    K = K + (0.0 if away else d.one_of(0.0, 5.0)) * np.eye(n)
    m, mu = d.masses(n), d.one_of(np.ones(n), d.uniform(0.5, 1.5, n), 10.0 ** d.uniform(-3, 1, n))
    pull = d.one_of(np.ones(n), np.eye(n)[0], d.random(n), d.normal(size=n))
    speed = d.at_rest(d.normal(size=n)) if d.chance(0.3) else np.zeros(n)
    slow = d.chance(0.6)
    Z, i = np.zeros((n, n)), np.eye(n)
    zero = np.zeros(n)
    h = d.one_of(1e-4, 1e-3, 5e-3, 0.05) / np.sqrt(max(1.0, k / 40))
    return {
        "A": np.block([[Z, i], [-K / m[:, None], -d.one_of(0.0, 0.05) * i]]), "B": np.vstack([Z, i / m[:, None]]),
        "C": np.hstack([Z, i]), "D": Z, "lower": -mu, "upper": mu,
        "x0": np.concatenate([np.full(n, away), speed]), "f0": np.zeros(2 * n),
        "f1": np.concatenate([zero, pull * (d.one_of(0.5, 0.1) if slow else d.one_of(10.0, 1 / h / 20))]), "omega": 0.0,
        "theta": d.one_of(0.5, 0.5, 1.0), "grid": d.grid(h, d.count(20, 60)),
    }  # fmt: skip


def lure_masses(d: Draw, m: int) -> Arguments:
    """Speeds of light and heavy bodies that may not approach (or that rub on one another)."""
    n = m + 1
    M = 10.0 ** (d.one_of(2, 6, 8, 10, 12) * d.one_of(d.random(n), d.integers(0, 2, n)))
    G = np.eye(m, n, 1) - np.eye(m, n) if d.chance() else d.normal(size=(m, n)) * (d.random((m, n)) < 3 / n)
    if m > 1 and d.chance(0.4):  # rows that nearly repeat others
        G[m // 2 :] = G[: m - m // 2] + d.size(-9, 0) * d.normal(size=(m - m // 2, n))
    lower, upper = _lure_bounds(d, m)
    v = d.at_rest(d.normal(size=n))
    if d.chance():
        v = np.sort(v)
    h = d.one_of(1e-3, 1e-2, 0.1)
    B = G.T / M[:, None]
    return {
        "A": -d.one_of(0.0, 1.0) * np.diag(d.random(n)), "B": B, "C": G, "D": np.zeros((m, m)), "lower": lower, "upper": upper,
        "x0": v, "f0": d.at_rest(d.normal(size=n)),
        "f1": d.at_rest(d.normal(size=n) / np.where(d.chance(), M, 1.0)), "omega": d.one_of(0.0, 3.0),
        "theta": d.one_of(1.0, 0.5), "grid": d.grid(h),
    }  # fmt: skip


def lure_bridge(d: Draw, _: int) -> Arguments:
    """A diode bridge with a capacitor filter."""
    L, C, R, F = 1e-2, 1e-6, 1e3, 3e-7
    h = d.one_of(1e-5, 4e-6, 1e-6, 2e-5)
    return {
        "A": np.array([[0, -1 / C, 0], [1 / L, 0, 0], [0, 0, -1 / (R * F)]]),
        "B": np.array([[0, 0, -1 / C, 1 / C], [0, 0, 0, 0], [1 / F, 0, 1 / F, 0]]),
        "C": np.array([[0.0, 0, 1], [0, 0, 0], [-1, 0, 1], [1, 0, 0]]),
        "D": np.array([[0.0, -1, 0, 0], [1, 0, 1, -1], [0, -1, 0, 0], [0, 1, 0, 0]]),
        "lower": np.zeros(4), "upper": np.full(4, np.inf),
        "x0": np.array([10 * (1 + d.random()), 1e-2 * d.random() * d.integers(0, 2), 0.0]),
        "f0": np.zeros(3), "f1": np.zeros(3), "omega": 0.0, "theta": d.one_of(1.0, 0.5), "grid": d.grid(h, 40),
    }  # fmt: skip


def lure(d: Draw) -> tuple[str, Arguments, list[Arguments]]:
    scene = d.choice(["chain", "passive", "masses", "bridge", "copies"], p=[0.3, 0.3, 0.15, 0.05, 0.2])
    single = {"chain": lure_chain, "passive": lure_passive, "masses": lure_masses, "bridge": lure_bridge}
    if scene != "copies":
        return scene, _lure(d, single[scene](d, d.count())), []
    of = d.choice(["bridge", "bridge", "passive", "chain", "masses"])
    small = single[of](d, d.count(1, 5))
    m = small["B"].shape[1]
    copies = [_other_start(d, of, small, k) for k in range(d.count(2, max(2, 60 // m)))]
    whole = {key: block_diag(*(c[key] for c in copies)) for key in "ABCD"}
    whole |= {key: np.concatenate([c[key] for c in copies]) for key in ("lower", "upper", "x0", "f0", "f1")}
    whole |= {key: small[key] for key in ("omega", "theta", "grid")}
    plain = Draw(0)
    plain.units = lambda n, decades=0: np.ones(n)  # type: ignore[method-assign]
    plain.chance = lambda p=0.5: False  # type: ignore[method-assign]
    return f"copies of {of}", _lure(plain, whole), [_lure(plain, c) for c in copies]


def _other_start(d: Draw, of: str, small: Arguments, k: int) -> Arguments:
    if of == "bridge":
        return small | {"x0": np.array([10 * (1 + 0.1 * k), 1e-3 * k, 0.0])}
    return small | {"x0": small["x0"] * (1 + 0.1 * k) * d.one_of(1.0, 1.0, 1e-3, 1e3)}


# ---------------------------------------------------------------------------------------------- first order


def first_bilinear(d: Draw, tag: str) -> Arguments:
    """A gene-like switch: g bilinear in l, states that decay to nothing; two relays."""
    x, l = ca.SX.sym(f"x{tag}", 2), ca.SX.sym(f"l{tag}", 2)
    a, b, c = d.one_of((1.0, 0.5, 0.5), tuple(d.uniform(0.2, 0.8, 3)))
    s = d.start()
    h = d.one_of(1e-3, 1e-2, 0.1)
    return {
        "x": x, "lam": l, "f": ca.vertcat(a * x[1], 0), "h": x,
        "g": ca.vertcat(-b * l[0] * l[1] * x[1], (2 * l[0] + l[1]) / (1 - c * l[0] * l[1])),
        "law": relay(2), "x0": s * d.one_of(np.array([1.0, 10.0]), d.normal(size=2)), "theta": d.one_of(0.5, 1.0), **d.grid(h),
    }  # fmt: skip


def first_cubic(d: Draw, tag: str, n: int | None = None) -> Arguments:
    """x' = -K x - c x^3 - relays, in units."""
    n = n or d.count(1, 4)
    x, l = ca.SX.sym(f"x{tag}", n), ca.SX.sym(f"l{tag}", n)
    u, v = d.units(n), d.units(n)
    xn, ln = x / ca.DM(u), l / ca.DM(v)
    K = d.psd(n) * d.size(-1, 2)
    mu = d.uniform(0.5, 1.5, n) * d.size(-3, 1)
    return {
        "x": x, "lam": l, "f": ca.DM(u) * (-ca.DM(K) @ xn - d.one_of(0, 1.0) * xn**3), "h": ca.DM(v) * xn,
        "g": ca.DM(u * mu) * ln,
        "law": relay(n, list(-v), list(v)), "x0": u * d.start() * d.at_rest(d.normal(size=n)),
        "theta": d.one_of(0.5, 1.0), **d.grid(d.one_of(1e-3, 0.02, 0.3)),
    }  # fmt: skip


def first_linear(d: Draw, tag: str, m: int | None = None) -> Arguments:
    """M x' = -K x + f + G' l, y = G x + D l: masses of 1 to 1e12, rows in units."""
    m = m or d.count(1, 4)
    n = m + d.integers(0, 3)
    x, l = ca.SX.sym(f"x{tag}", n), ca.SX.sym(f"l{tag}", m)
    M = d.masses(n)
    G = np.eye(m, n) - d.one_of(0, 1) * np.eye(m, n, 1) if d.chance() else d.normal(size=(m, n)) * (d.random((m, n)) < 3 / n)
    D = d.one_of(np.zeros((m, m)), np.diag(d.random(m)) * d.size(-6, 0))
    if m > 1 and d.chance(0.3):  # rows that nearly repeat others
        G[m // 2 :] = G[: m - m // 2] + d.size(-9, 0) * d.normal(size=(m - m // 2, n))
    lower, upper = _lure_bounds(d, m)
    e, v = d.units(n), d.units(m)
    f = d.at_rest(d.normal(size=n))
    K = d.psd(n) * d.one_of(0.0, 1.0)
    x0 = d.at_rest(d.normal(size=n))
    return {
        "x": x, "lam": l, "M": np.diag(M * e), "f": ca.DM(e) * (ca.DM(f) - ca.DM(K) @ x),
        "h": ca.DM(v) * (ca.DM(G) @ x) + ca.DM(v[:, None] * D / v) @ l,
        "g": ca.DM(e[:, None] * G.T / v) @ l, "law": box(list(v * lower), list(v * upper)), "x0": x0,
        "theta": d.one_of(0.5, 1.0), **d.grid(d.one_of(1e-3, 1e-2, 0.1)),
    }  # fmt: skip


def first_decay(d: Draw, tag: str) -> Arguments:
    """States that fall by a factor at each step, to 1e-71 and below, next to relays and diodes that they drive."""
    x, l = ca.SX.sym(f"x{tag}", 2), ca.SX.sym(f"l{tag}", 2)
    rate = d.one_of(1.8, 1.9, 1.99, 2.05)
    return {
        "x": x, "lam": l, "f": ca.vertcat(-rate * x[0], -rate * x[1] + d.one_of(0.0, 1.0) * x[0]),
        "h": ca.vertcat(x[0] - x[1], x[1]),
        "g": ca.vertcat(d.one_of(0.0, 1.0, x[0]) * l[0], d.one_of(-1.0, 1.0, x[1]) * l[0] + d.one_of(1.0, x[0]) * l[1]),
        "law": d.one_of(relay(2), complementarity(2)), "x0": d.normal(size=2), "theta": 0.5, **d.grid(1.0, 40),
    }  # fmt: skip


def stacked(kind: str, parts: Sequence[Arguments]) -> Arguments:
    """Models side by side that know nothing of one another."""
    whole = {key: parts[0][key] for key in ("step", "t_end", "theta", "mean_forcing", "t", "s") if key in parts[0]}
    for key in ("x", "q", "lam", "f", "h", "g", "field"):
        if key in parts[0]:
            whole[key] = ca.vertcat(*(p[key] for p in parts))
    for key in ("x0", "v0", "q0", "lower", "upper"):
        if key in parts[0]:
            whole[key] = np.concatenate([p[key] for p in parts])
    if "M" in parts[0]:
        whole["M"] = block_diag(*(p["M"] for p in parts))
    if "law" in parts[0]:
        whole["law"] = product(*(p["law"] for p in parts))
    for key in ("potential", "phi"):
        if key in parts[0]:
            whole[key] = sum(p[key] for p in parts)
    if "constraints" in parts[0]:
        whole["constraints"] = {f"{name}_{i}": g for i, p in enumerate(parts) for name, g in p["constraints"].items()}
    if "friction" in parts[0]:
        at, n, whole["friction"] = 0, sum(p["x"].numel() for p in parts), {}
        for i, p in enumerate(parts):
            size = p["x"].numel()
            for name, (H, theta) in p["friction"].items():
                wide = np.zeros((H.shape[0], n))
                wide[:, at : at + size] = H
                whole["friction"][f"{name}_{i}"] = (wide, theta)
            at += size
    return whole


def _stack(d: Draw, kind: str, make: Callable[[Draw, str], Arguments], rows: int) -> list[Arguments]:
    """Copies of one random small model that differ in their starts."""
    seed = int(d.integers(1 << 30))
    parts = [make(Draw(seed), f"_{k}_") for k in range(d.count(2, max(2, min(40, 60 // rows))))]
    starts = [key for key in ("x0", "v0", "q0") if key in parts[0]]
    for part in parts:
        factor = d.one_of(1.0, 1.0, 1.5, 1e-3)
        for key in starts:
            if kind == "first" or key == "v0":
                part[key] = np.asarray(part[key]) * factor
    if "t" in parts[0]:
        one = parts[0]["t"]
        for part in parts[1:]:
            for key in ("f", "h", "g"):
                if key in part:
                    part[key] = ca.substitute(part[key], part["t"], one)
            if "constraints" in part:
                part["constraints"] = {k: ca.substitute(g, part["t"], one) for k, g in part["constraints"].items()}
            part["t"] = one
    if "s" in parts[0]:
        one = parts[0]["s"]
        for part in parts[1:]:
            part["friction"] = {k: (H, ca.substitute(th, part["s"], one)) for k, (H, th) in part["friction"].items()}
            part["s"] = one
    return parts


def first(d: Draw) -> tuple[str, Arguments, list[Arguments]]:
    scene = d.choice(["bilinear", "cubic", "linear", "decay", "copies"], p=[0.15, 0.25, 0.3, 0.1, 0.2])
    if scene == "copies":
        of = d.choice(["bilinear", "cubic", "linear", "decay"])
        small = {"bilinear": first_bilinear, "cubic": first_cubic, "linear": first_linear, "decay": first_decay}[of]
        parts = _stack(d, "first", small, 3)
        return f"copies of {of}", stacked("first", parts), parts
    if scene in ("cubic", "linear"):
        return scene, {"cubic": first_cubic, "linear": first_linear}[scene](d, "", d.count()), []
    return scene, {"bilinear": first_bilinear, "decay": first_decay}[scene](d, ""), []


# ---------------------------------------------------------------------------------------------- oscillators


def oscillator_chain(d: Draw, tag: str, n: int | None = None) -> Arguments:
    """A chain of masses with dry friction (each its own, or between neighbours), springs, kinks and stops; most at rest."""
    n = n or d.count(1, 4)
    x, s = ca.SX.sym(f"x{tag}", n), ca.SX.sym("s")
    u, root = float(d.units(1)[0]), np.sqrt(d.masses(n))
    away = d.one_of(0.0, 0.0, 1e3, 1e6, 1e9)
    k = d.size(0, 3)
    xi = (x / u - away * ca.DM.ones(n) * ca.DM(root)) / ca.DM(root)  # displacement of each mass from its place, in natural units
    springs = ca.vertcat(*(xi[i + 1] - xi[i] for i in range(n - 1)), d.one_of(0.0, 1.0) * xi[0])
    kink = d.chance(0.3)
    potential = k * ca.sumsqr(springs) / 2 - ca.dot(ca.DM(d.at_rest(d.normal(size=n))), xi)
    if kink:
        j = d.integers(n)
        potential = potential + d.size(-1, 1) * ca.fabs(xi[j] - d.one_of(0.0, 0.25))
    friction = {}
    for i in range(n):
        mu, b = d.size(-2, 1) * d.one_of(1.0, d.random()), d.one_of(0.0, 0.1)
        H = np.zeros((1, n))
        H[0, i] = 1 / root[i]
        if n > 1 and d.chance(0.2):
            j = (i + 1) % n
            H[0, j] = -1 / root[j]
        friction[f"f{i}"] = (H, u * mu * s + b * s**2 / 2)
    constraints = {}
    for i in range(n):
        if d.chance(0.15):
            constraints[f"stop{i}"] = d.size(-8, 8) * (xi[i] + d.one_of(0.0, 0.01, 1.0))
    place = d.at_rest(np.abs(d.normal(size=n))) * d.start()
    arguments = {
        "x": x, "s": s, "potential": u**2 * potential, "friction": friction, "constraints": constraints,
        "x0": u * root * (away + place), "v0": u * root * d.at_rest(np.abs(d.normal(size=n))),
        **d.grid(d.one_of(1e-4, 1e-3, 1e-2, 0.1) / np.sqrt(k)),
    }  # fmt: skip
    return arguments


def oscillator_plane(d: Draw, tag: str, n: int | None = None) -> Arguments:
    """Bodies in the plane, isotropic friction, springs between them."""
    n = n or d.count(1, 3)
    x, s = ca.SX.sym(f"x{tag}", 2 * n), ca.SX.sym("s")
    u, k = float(d.units(1)[0]), d.size(0, 3)
    xi = x / u
    springs = [xi[:2], *(xi[2 * i : 2 * i + 2] - xi[2 * i - 2 : 2 * i] for i in range(1, n))]
    friction = {f"f{i}": (np.eye(2 * n)[2 * i : 2 * i + 2], u * d.size(-2, 1) * s) for i in range(n)}
    return {
        "x": x, "s": s, "potential": u**2 * k * sum(ca.sumsqr(e) for e in springs) / 2, "friction": friction, "constraints": {},
        "x0": u * d.start() * d.at_rest(d.normal(size=2 * n)), "v0": u * d.at_rest(d.normal(size=2 * n)),
        **d.grid(d.one_of(1e-3, 1e-2, 0.1) / np.sqrt(k)),
    }  # fmt: skip


def oscillator(d: Draw) -> tuple[str, Arguments, list[Arguments]]:
    scene = d.choice(["chain", "plane", "copies"], p=[0.65, 0.1, 0.25])
    if scene == "copies":
        of = d.choice(["chain", "plane"], p=[0.8, 0.2])
        parts = _stack(d, "oscillator", {"chain": oscillator_chain, "plane": oscillator_plane}[of], 4)
        return f"copies of {of}", stacked("oscillator", parts), parts
    if scene == "plane":
        return scene, oscillator_plane(d, "", d.count(1, 12)), []
    return scene, oscillator_chain(d, "", d.count(1, 50)), []


# ---------------------------------------------------------------------------------------------- sweeping


def sweeping_crowd(d: Draw, tag: str, bodies: int | None = None) -> Arguments:
    """Discs that want to a point and keep apart; light and heavy ones; far from the origin; gaps in units of their own."""
    b = bodies or d.count(2, 3)
    q, t = ca.SX.sym(f"q{tag}", 2 * b), ca.SX.sym("t")
    u, away = float(d.units(1)[0]), d.one_of(0.0, 0.0, 1e3, 1e6, 1e9)
    root = np.repeat(np.sqrt(d.masses(b)), 2)
    side = int(np.ceil(np.sqrt(b)))
    grid = np.array([(i % side, i // side) for i in range(b)], float) * d.one_of(2.0, 2.05, 3.0) + d.one_of(0.0, 0.02) * d.random(
        (b, 2)
    )
    xi = (q / u) / ca.DM(root) - away
    pairs = [(i, j) for i in range(b) for j in range(i) if np.linalg.norm(grid[i] - grid[j]) < 2.9] or [(1, 0)]
    w = d.units(len(pairs))
    constraints = {
        f"d{i}_{j}": w[k]
        * (ca.norm_2(xi[2 * i : 2 * i + 2] - xi[2 * j : 2 * j + 2]) - min(2.0, float(np.linalg.norm(grid[i] - grid[j]))))
        for k, (i, j) in enumerate(pairs[:60])
    }
    goal = d.one_of(np.zeros(2), np.array([side, side]) * 1.0, np.array([100.0, 3.0]))
    wish = ca.vertcat(*(ca.DM(goal) - xi[2 * i : 2 * i + 2] for i in range(b)))
    return {
        "t": t, "q": q, "f": u * ca.DM(root) * wish * d.one_of(0.1, 1.0), "constraints": constraints,
        "q0": u * root * (away + grid.ravel()), **d.grid(d.one_of(1e-3, 1e-2, 0.1)),
    }  # fmt: skip


def _convex(kind: str, L: Any) -> Any:
    """A coordinate, a norm, a square or an exponential of L, symbols or numbers."""
    if kind in ("plane", "exp"):
        return L[0] if kind == "plane" else np.exp(L[0]) if isinstance(L, np.ndarray) else ca.exp(L[0])
    square = L @ L if isinstance(L, np.ndarray) else ca.sumsqr(L)
    return square / 2 if kind == "square" else np.sqrt(square) if isinstance(L, np.ndarray) else ca.norm_2(L)


def sweeping_rows(d: Draw, tag: str, p: int | None = None) -> Arguments:
    """Random convex constraints that the start keeps, near and far; one may move."""
    p = p or d.count(1, 4)
    n = d.count(1, max(1, min(p + 2, 30)))
    q, t = ca.SX.sym(f"q{tag}", n), ca.SX.sym("t")
    u, away = d.units(n, 6), d.one_of(0.0, 0.0, 1e3, 1e6, 1e9)
    start = d.normal(size=n)
    xi, w = q / ca.DM(u) - away, d.units(p)
    constraints = {}
    for i in range(p):
        size = d.integers(1, min(n, 3) + 1)
        P, slack = d.normal(size=(size, n)) * (d.random((size, n)) < 4 / n), d.one_of(0.0, 0.0, 1e-6, 0.1, 1.0)
        P[0, d.integers(n)] += 1.0
        c = P @ start - d.normal(size=size)
        L = ca.DM(P) @ xi - ca.DM(c)
        Ls = P @ start - c
        kind = d.one_of("plane", "norm", "square", "exp")
        move = d.one_of(0.0, 0.0, 0.0, d.random()) * t
        shape = "plane" if kind == "norm" and size == 1 else kind
        value = _convex(shape, L), _convex(shape, Ls)
        level = value[1] - slack if kind in ("plane", "exp") or size == 1 else value[1] * (1 - min(slack, 0.5))
        constraints[f"g{i}"] = w[i] * (value[0] - level + (1e-9 if away else 1e-15) * d.one_of(0, 1) - (move if p < 3 else 0))
    f0, f1 = d.at_rest(d.normal(size=n)), d.at_rest(d.normal(size=n))
    return {
        "t": t, "q": q, "f": ca.DM(u) * (ca.DM(f0) + ca.DM(f1) * ca.sin(t)), "constraints": constraints, "q0": u * (away + start),
        **d.grid(d.one_of(1e-3, 1e-2, 0.1)),
    }  # fmt: skip


def sweeping_door(d: Draw, tag: str) -> Arguments:
    """A point between two discs that nearly oppose each other, at rest or closing; it starts on the line, near it, or off it."""
    q, t = ca.SX.sym(f"q{tag}", 2), ca.SX.sym("t")
    u, away = float(d.units(1)[0]), d.one_of(0.0, 0.0, 1e3)
    gap, speed = d.one_of(0.1, 1e-3, 1e-6), d.one_of(0.0, 1.0, 1.0)
    y = d.one_of(-1.0, 1.0) * d.one_of(1e-12, 1e-9, 1e-6, 1e-3, 0.3)
    xi, a = q / u - away, 1 + gap - speed * t
    c = ca.vertcat(a, 0)
    h = d.one_of(1e-3, 1e-2)
    return {
        "t": t, "q": q, "f": u * ca.vertcat(0, d.one_of(0.0, -1.0, 1.0)), "q0": u * (away + np.array([0.0, y])),
        "constraints": {"right": ca.norm_2(xi - c) - 1, "left": ca.norm_2(xi + c) - 1},
        **d.grid(h, int(min(60, max(10, 3 * gap / h))) if speed else 20),
    }  # fmt: skip


def sweeping_walls(d: Draw, tag: str) -> Arguments:
    """Planes that nearly oppose each other (angles of 1e-8 to 1), closing or not."""
    n = d.count(2, 4)
    q, t = ca.SX.sym(f"q{tag}", n), ca.SX.sym("t")
    xi = q
    constraints, a = {}, d.normal(size=n)
    a /= np.linalg.norm(a)
    for i in range(d.integers(1, 4)):
        b = -a + d.size(-8, 0) * d.normal(size=n)
        w = d.units(2)
        constraints |= {
            f"a{i}": w[0] * (ca.dot(ca.DM(a), xi) + d.one_of(0.0, 1e-9, 0.01) - d.one_of(0.0, 0.0, 1e-3) * t),
            f"b{i}": w[1] * (ca.dot(ca.DM(b), xi) + d.one_of(0.0, 1e-9, 0.01) - d.one_of(0.0, 0.0, 1e-3) * t),
        }
    return {
        "t": t,
        "q": q,
        "f": ca.DM(d.normal(size=n)),
        "q0": np.zeros(n),
        "constraints": constraints,
        **d.grid(d.one_of(1e-3, 1e-2)),
    }


def sweeping(d: Draw) -> tuple[str, Arguments, list[Arguments]]:
    scene = d.choice(["crowd", "rows", "door", "walls", "copies"], p=[0.25, 0.3, 0.12, 0.13, 0.2])
    small = {"crowd": sweeping_crowd, "rows": sweeping_rows, "door": sweeping_door, "walls": sweeping_walls}
    if scene == "copies":
        of = d.choice(["crowd", "rows", "door", "walls"])
        parts = _stack(d, "sweeping", small[of], 3)
        return f"copies of {of}", stacked("sweeping", parts), parts
    if scene in ("door", "walls"):
        return scene, small[scene](d, ""), []
    return scene, small[scene](d, "", d.count(2, 25) if scene == "crowd" else d.count()), []


# ---------------------------------------------------------------------------------------------- inclusions


def inclusion_rows(d: Draw, tag: str, p: int | None = None) -> Arguments:
    """A linear field kept within planes and ellipsoids around the origin, in units; with or without kinks."""
    p = p or d.count(1, 4)
    n = d.count(1, max(1, min(p + 2, 30)))
    x = ca.SX.sym(f"x{tag}", n)
    u, w, away = d.units(n, 6), d.units(p), d.one_of(0.0, 0.0, 1e3, 1e6)
    xi = x / ca.DM(u) - away
    constraints = {}
    for i in range(p):
        P = d.normal(size=(d.integers(1, min(n, 3) + 1), n)) * (d.random(n) < 4 / n)
        P[0, d.integers(n)] += 1.0
        L = ca.DM(P) @ xi
        r = d.size(-1, 0)
        constraints[f"c{i}"] = w[i] * (r - L[0] if d.chance(0.6) else r**2 - ca.sumsqr(L))
    K = d.psd(n) + d.normal(size=(n, n)) * d.one_of(0.0, 0.3)
    arguments = {
        "x": x, "field": ca.DM(u) * (ca.DM(d.at_rest(d.normal(size=n)) * d.one_of(1.0, 30.0)) - ca.DM(K) @ xi),
        "constraints": constraints, "x0": u * (away + np.zeros(n)), **d.grid(d.one_of(1e-3, 1e-2, 0.1)),
    }  # fmt: skip
    if d.chance(0.4):
        arguments["phi"] = d.size(-2, 1) * sum(ca.fabs(xi[j]) * float(u[j]) for j in range(n) if j % 2 == 0)
    return arguments


def inclusion_box(d: Draw, tag: str, n: int | None = None) -> Arguments:
    """A field kept in a box: a clip."""
    n = n or d.count(1, 4)
    x, u = ca.SX.sym(f"x{tag}", n), d.units(n)
    low, high = d.one_of(0.0, -1.0, -1e-6), d.one_of(1.0, 2.0, np.inf)
    K = d.psd(n) * d.one_of(1.0, 10.0)
    return {
        "x": x, "field": ca.DM(u) * (ca.DM(d.at_rest(d.normal(size=n))) - ca.DM(K) @ (x / ca.DM(u))),
        "lower": u * np.full(n, low), "upper": u * np.full(n, high), "x0": u * d.at_rest(d.random(n)),
        **d.grid(d.one_of(1e-3, 1e-2, 0.1)),
    }  # fmt: skip


def inclusion(d: Draw) -> tuple[str, Arguments, list[Arguments]]:
    scene = d.choice(["rows", "box", "copies"], p=[0.6, 0.15, 0.25])
    if scene == "copies":
        of = d.choice(["rows", "box"], p=[0.8, 0.2])
        parts = _stack(d, "inclusion", {"rows": inclusion_rows, "box": inclusion_box}[of], 3)
        return f"copies of {of}", stacked("inclusion", parts), parts
    return scene, {"rows": inclusion_rows, "box": inclusion_box}[scene](d, "", d.count()), []


KINDS: Mapping[str, type] = {
    "sweeping": SweepingProcess, "oscillator": FrictionOscillator, "first": FirstOrderSystem, "lure": LureSystem,
    "inclusion": MonotoneInclusion,
}  # fmt: skip
MAKERS: Mapping[str, Callable[[Draw], tuple[str, Arguments, list[Arguments]]]] = {
    "sweeping": sweeping, "oscillator": oscillator, "first": first, "lure": lure, "inclusion": inclusion,
}  # fmt: skip


def case(name: str, seed: int) -> Case:
    """The model of a class with this seed."""
    scene, arguments, parts = MAKERS[name](Draw(list(KINDS).index(name), seed))
    return Case(name, seed, KINDS[name].__name__, str(scene), arguments, parts)
