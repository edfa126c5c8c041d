"""Random models, valid and monotone by construction, each with its functions written a second time in NumPy.

A strategy draws a scene in natural units (numbers of order 1) and then puts it into units of 1e-6 to 1e6. Numbers come from a
table in which small multiples of 1/4 are as frequent as any others: ties, zeros, parallel rows and singular matrices are common.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    ball,
    box,
    complementarity,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
)

FULL = 400  # Models of each class: `make test-long`.
COUNT = int(os.environ.get("NSMODEL_FUZZ", FULL // 25))  # Those of this run; other tests take the same part.


def share(number: int, least: int = 1) -> int:
    """So many of the random models of another test are tried in this run."""
    return max(least, number * COUNT // FULL)


def some(values: Iterable[Any], least: int = 2) -> list[Any]:
    """The same part of a list, spread evenly over it, both ends among them."""
    values = list(values)
    return spread(values, share(len(values), least))


def spread(values: list[Any], number: int) -> list[Any]:
    """So many of a list, evenly, both ends among them."""
    return [values[round(place)] for place in np.linspace(0, len(values) - 1, min(number, len(values)))]


def repeatable(count: int) -> settings:
    """So many examples, the same ones every time."""
    return settings(max_examples=count, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck))


COARSE = ((np.arange(128) + 8) % 17 - 8) / 4
NUMBERS = np.concatenate([COARSE, np.random.default_rng(0).uniform(-2, 2, 128)])
NUMBERS[0] = 0.0
SLACKS = (0.5, 0.0, 0.1, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A model as a call of its class, and what a test knows of it: ``twin`` holds NumPy functions and numbers."""

    kind: type
    arguments: dict[str, Any]
    twin: SimpleNamespace

    def declare(self, **other: Any) -> Any:
        return self.kind(**(self.arguments | other))

    def __repr__(self) -> str:
        return f"{self.kind.__name__}({', '.join(f'{name}={value!r}' for name, value in self.arguments.items())})"


class Draw:
    """Numbers, matrices and choices of one example."""

    def __init__(self, draw: Callable[[Any], Any]) -> None:
        self.draw = draw

    def reals(self, *shape: int) -> np.ndarray:
        """An array of numbers in [-2, 2]."""
        count = int(np.prod(shape))
        return NUMBERS[np.frombuffer(self.draw(st.binary(min_size=count, max_size=count)), np.uint8)].reshape(shape)

    def positive(self, *shape: int) -> np.ndarray:
        """An array of numbers in [0.25, 2.25]."""
        return np.abs(self.reals(*shape)) + 0.25

    def count(self, low: int, high: int) -> int:
        return self.draw(st.integers(low, high))

    def one_of(self, *values: Any) -> Any:
        return values[self.count(0, len(values) - 1)]

    def chance(self) -> bool:
        return self.draw(st.booleans())

    def decades(self, *shape: int) -> np.ndarray:
        """Units from 1e-6 to 1e6; half of the time all are 1."""
        count = int(np.prod(shape))
        if self.chance():
            return np.ones(shape)
        raw = np.frombuffer(self.draw(st.binary(min_size=count, max_size=count)), np.uint8)
        return 10.0 ** ((raw.reshape(shape).astype(int) + 6) % 13 - 6)

    def psd(self, n: int) -> np.ndarray:
        """A symmetric positive semidefinite matrix of any rank."""
        R = self.reals(self.count(0, n), n)
        return R.T @ R

    def skew(self, n: int) -> np.ndarray:
        R = self.reals(n, n)
        return (R - R.T) / 2

    def nonzero(self, n: int) -> np.ndarray:
        """A vector of length 1/4 or more."""
        a = self.reals(n)
        if not np.linalg.norm(a) >= 0.25:
            a[0] += 1.0 if a[0] >= 0 else -1.0
        return a

    def grid(self, tau: float, lengths: tuple[float, ...], most: int = 12, growing: bool = False) -> dict[str, Any]:
        """The arguments of a time grid: constant steps, with or without a shorter last one, or steps that differ."""
        h, steps, kind = tau * self.one_of(*lengths), self.count(3, most), self.count(0, 2)
        if kind == 0:
            return {"step": h, "t_end": h * steps}
        if kind == 1:
            return {"step": h, "t_end": h * (steps - 0.75)}
        factors = 1 + np.abs(self.reals(steps)) / 2
        return {"steps": h * (np.sort(factors) if growing else factors)}


def affine(P: np.ndarray, q: ca.SX) -> ca.SX:
    """P q with a column of expressions."""
    return ca.mtimes(ca.DM(np.atleast_2d(P)), q)


def named(start: np.ndarray) -> dict[str, float]:
    """The start as values of the parameters a_0, a_1, ..."""
    return {f"a_{i}" if start.size > 1 else "a": float(value) for i, value in enumerate(start)}


# ---------------------------------------------------------------------------------------------- S: sweeping processes


class Row(NamedTuple):
    """A constraint w (phi(P q/u - c - v t/tau) - r - s t/tau) >= 0 with phi a coordinate, a norm, a square or an exponential."""

    phi: str
    w: float
    u: float
    tau: float
    P: np.ndarray
    c: np.ndarray
    v: np.ndarray
    r: float
    s: float

    def expression(self, t: ca.SX, q: ca.SX) -> ca.SX:
        L = affine(self.P / self.u, q) - ca.DM(self.c) - ca.DM(self.v) * (t / self.tau)
        phi = {
            "plane": lambda: L[0],
            "norm": lambda: ca.norm_2(L),
            "square": lambda: ca.sumsqr(L) / 2,
            "exp": lambda: ca.exp(L[0]),
        }
        return self.w * (phi[self.phi]() - self.r - self.s * (t / self.tau))

    def at(self, t: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values (N,), gradients (N, n) and the sizes (N,) of what the values are made of."""
        time = t[:, None] / self.tau
        L = q @ self.P.T / self.u - self.c - self.v * time
        terms = np.abs(q) @ np.abs(self.P.T) / self.u + np.abs(self.c) + np.abs(self.v) * time
        length = np.linalg.norm(L, axis=1)
        value, slope = {
            "plane": lambda: (L[:, 0], np.ones_like(L)),
            "norm": lambda: (length, L / length[:, None]),
            "square": lambda: (length**2 / 2, L),
            "exp": lambda: (np.exp(L[:, 0]), np.exp(L)),
        }[self.phi]()
        level = self.r + self.s * time[:, 0]
        size = np.linalg.norm(slope, axis=1) * terms.sum(axis=1) + np.abs(value) + abs(self.r) + abs(self.s) * time[:, 0]
        return self.w * (value - level), self.w * (slope @ self.P) / self.u, self.w * size


def _row(d: Draw, n: int, u: float, tau: float, starts: np.ndarray, pushes: bool, plane: bool) -> Row:
    """A constraint that all starts satisfy; it moves towards the state where it ``pushes``, else rests or gives way."""
    phi = "plane" if plane else d.one_of("plane", "norm", "square", "exp")
    size = 1 if phi in ("plane", "exp") else d.count(1, min(3, n))
    P, kind = d.reals(size, n), d.count(0, 2)
    if kind == 1 and n >= 2 * size:  # the distance of two bodies
        P = np.hstack([np.eye(size), -np.eye(size), np.zeros((size, n - 2 * size))])
    elif kind == 2 or not P.any(axis=1).all():
        P = np.roll(np.eye(size, n), d.count(0, n - size), axis=1)
    w, away, at, speed = float(d.decades()), d.nonzero(size), starts @ P.T, float(abs(d.reals(1)[0])) * d.one_of(0, 1)
    v, s = np.zeros(size), 0.0
    if phi == "plane":
        return Row(phi, w, u, tau, P, at.min(axis=0) - d.one_of(*SLACKS), np.array([speed if pushes else -speed]), 0.0, 0.0)
    c = at[0] - away
    if pushes and phi != "exp" and d.chance():
        v = d.reals(size) / 2
    elif phi == "norm":
        s = speed / 2 if pushes else -speed
    level = {"norm": np.linalg.norm(away), "square": away @ away / 2, "exp": np.exp(away[0])}[phi]
    return Row(phi, w, u, tau, P, c, v, float(level * d.one_of(0.5, 0.9, 0.99, 1.0)), s)


@st.composite
def sweeping(draw: Callable[[Any], Any]) -> Scene:
    """Walls, discs, bodies that keep apart, ellipsoids; f = f_0 + f_1 sin(omega t) + F q; at most one constraint pushes."""
    d = Draw(draw)
    n, p, planes = d.count(1, 6), d.count(0, 6), d.chance()
    u, tau = float(d.decades()), float(d.decades())
    starts = d.reals(2, n) if planes else d.reals(1, n)
    pusher = d.count(0, 6)
    rows = [_row(d, n, u, tau, starts, i == pusher, planes) for i in range(p)]
    f0, f1, omega = d.reals(n), d.reals(n), float(d.positive())
    F = d.reals(n, n) / (2 * n) * d.one_of(0, 1)
    mean = d.chance()
    t, q, start = ca.SX.sym("t"), ca.SX.sym("q", n), ca.SX.sym("a", n)
    f = u / tau * (ca.DM(f0) + ca.DM(f1) * ca.sin(omega / tau * t) + affine(F / u, q))
    arguments = {
        "t": t, "q": q, "f": f, "constraints": {f"g{i}": row.expression(t, q) for i, row in enumerate(rows)},
        "q0": start, "parameters": named(u * starts[0]), "mean_forcing": mean,
        **d.grid(tau, (0.1, 1e-3, 0.01, 0.3)),
    }  # fmt: skip

    def forcing(t: np.ndarray, h: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = omega / tau * t, omega / tau * (t + h)
        wave = 2 * np.sin((b - a) / 2) * np.sin((a + b) / 2) / (b - a) if mean else np.sin(a)
        parts = [np.broadcast_to(f0, q.shape), np.outer(wave, f1), q @ F.T / u]
        size = np.abs(f0) + np.outer(np.abs(a) + 1, np.abs(f1)) + np.abs(q) @ np.abs(F.T) / u
        return u / tau * sum(parts), u / tau * size

    twin = SimpleNamespace(rows=rows, forcing=forcing, F=F / tau, starts=u * starts)
    return Scene(SweepingProcess, arguments, twin)


# ---------------------------------------------------------------------------------------------- O: friction oscillators


class Term(NamedTuple):
    """A convex term >= 0 of a potential, w phi(P x/u - c), with phi one of SMOOTH or KINKED."""

    phi: str
    w: float
    u: float
    P: np.ndarray
    c: np.ndarray

    def expression(self, x: ca.SX) -> ca.SX:
        L = affine(self.P / self.u, x) - ca.DM(self.c)
        phi = {
            "square": lambda: ca.sumsqr(L) / 2,
            "quartic": lambda: L[0] ** 4 / 4,
            "cosh": lambda: ca.log(ca.cosh(L[0])),
            "abs": lambda: ca.fabs(L[0]),
            "max": lambda: ca.fmax(L[0], 0),
            "norm": lambda: ca.norm_2(L),
        }
        return self.w * phi[self.phi]()

    def argument(self, x: np.ndarray) -> np.ndarray:
        return x @ self.P.T / self.u - self.c

    def value(self, x: np.ndarray) -> np.ndarray:
        L = self.argument(x)
        phi = {
            "square": lambda: (L**2).sum(axis=1) / 2,
            "quartic": lambda: L[:, 0] ** 4 / 4,
            "cosh": lambda: np.logaddexp(L[:, 0], -L[:, 0]) - np.log(2),
            "abs": lambda: np.abs(L[:, 0]),
            "max": lambda: np.maximum(L[:, 0], 0),
            "norm": lambda: np.linalg.norm(L, axis=1),
        }
        return self.w * phi[self.phi]()

    def rounding(self, x: np.ndarray) -> np.ndarray:
        """How far the value (N,) feels a relative change of the terms of its argument."""
        terms = np.abs(x) @ np.abs(self.P.T) / self.u + np.abs(self.c)
        slope = np.abs(SMOOTH[self.phi][0](self.argument(x))) if self.phi in SMOOTH else 1.0
        return self.value(x) + self.w * (slope * terms).sum(axis=1)

    def force(self, x: np.ndarray) -> np.ndarray:
        """w phi' of a smooth term."""
        return self.w * SMOOTH[self.phi][0](self.argument(x))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Of a smooth term (N, n)."""
        return self.force(x) @ self.P / self.u

    def force_rounding(self, x: np.ndarray) -> np.ndarray:
        """How far the gradient (N, n) of a smooth term feels a relative change of the terms of its argument."""
        terms = np.abs(x) @ np.abs(self.P.T) / self.u + np.abs(self.c)
        felt = SMOOTH[self.phi][1](self.argument(x)) * terms
        return (np.abs(self.force(x)) + self.w * felt) @ np.abs(self.P) / self.u

    def hessian(self, x: np.ndarray) -> np.ndarray:
        """Of a smooth term (N, n, n)."""
        second = SMOOTH[self.phi][1](self.argument(x))
        return self.w / self.u**2 * np.einsum("ki,ij,il->kjl", second, self.P, self.P)


SMOOTH = {  # phi' and the diagonal of phi''
    "square": (lambda L: L, np.ones_like),
    "quartic": (lambda L: L**3, lambda L: 3 * L**2),
    "cosh": (np.tanh, lambda L: 1 - np.tanh(L) ** 2),
}
KINKED = ("abs", "max", "norm")


class Bound(NamedTuple):
    """A concave constraint: w (P x/u - c) >= 0, or w (r^2 - |P x/u - c|^2) >= 0."""

    w: float
    u: float
    P: np.ndarray
    c: np.ndarray
    r: float | None

    def expression(self, x: ca.SX) -> ca.SX:
        L = affine(self.P / self.u, x) - ca.DM(self.c)
        return self.w * (L[0] if self.r is None else self.r**2 - ca.sumsqr(L))

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values (N,), gradients (N, n), and the sizes (N,) of what the values are made of."""
        L, terms = x @ self.P.T / self.u - self.c, np.abs(x) @ np.abs(self.P.T) / self.u + np.abs(self.c)
        if self.r is None:
            gradient = np.broadcast_to(self.w * self.P / self.u, (len(x), x.shape[1]))
            return self.w * L[:, 0], gradient, self.w * terms[:, 0]
        size = self.r**2 + 2 * (np.abs(L) * terms).sum(axis=1)
        return self.w * (self.r**2 - (L**2).sum(axis=1)), -2 * self.w * L @ self.P / self.u, self.w * size


def _bounds(d: Draw, n: int, u: float, starts: np.ndarray, count: int) -> list[Bound]:
    """Planes and ellipsoids around all starts, with room inside."""
    bounds = []
    for _ in range(count):
        w, P, at = float(d.decades()), d.nonzero(n)[None], starts
        if d.chance():
            bounds.append(Bound(w, u, P, (at @ P.T).min(axis=0) - d.one_of(0.5, 0.1, 1.0, 3.0), None))
            continue
        P = d.reals(d.count(1, n), n)
        c = P @ d.reals(n) / 4
        bounds.append(Bound(w, u, P, c, float(np.linalg.norm(at @ P.T - c, axis=1).max() + d.one_of(0.5, 0.1, 1.0))))
    return bounds


class Friction(NamedTuple):
    """theta(s) = (u/tau)^2 (mu s' + b s'^2/2 + c s'^3/3 + e (sqrt(1 + s'^2) - 1)) with s' = s tau/u, on |H v|."""

    H: np.ndarray
    speed: float
    factors: np.ndarray

    def expression(self, s: ca.SX) -> ca.SX:
        (mu, b, c, e), z = self.factors, s / self.speed
        return self.speed**2 * (mu * z + b * z**2 / 2 + c * z**3 / 3 + e * (ca.sqrt(1 + z**2) - 1))

    @property
    def radius(self) -> float:
        return self.speed * self.factors[0]

    def slope(self, s: np.ndarray) -> np.ndarray:
        """theta'(s) - theta'(0)."""
        (_, b, c, e), z = self.factors, s / self.speed
        return self.speed * (b * z + c * z**2 + e * z / np.sqrt(1 + z**2))


@st.composite
def oscillators(draw: Callable[[Any], Any]) -> Scene:
    """Convex potentials with kinks, several friction elements, damping with a skew part, a convex domain."""
    d = Draw(draw)
    n = d.count(1, 4)
    u, tau = float(d.decades()), float(d.decades())
    x0, v0 = d.reals(n), d.reals(n)
    kinds = [kind for kind in KINKED if d.count(0, 3) == 3] + ["square"] * d.count(0, 1)
    kinds += [kind for kind in ("quartic", "cosh") if d.count(0, 3) == 3]
    potential = []
    for kind in kinds:
        size = d.count(2, 3) if kind == "norm" else d.count(1, n) if kind == "square" else 1
        stiff = d.one_of(1.0, 1.0, 1e-3, 1e4) if kind in ("square", "abs") else 1.0
        P = d.nonzero(n)[None] if size == 1 else d.reals(size, n)
        if kind == "norm" and (n == 1 or np.linalg.matrix_rank(P) < 2 or not P.any(axis=1).all()):
            P, kind = d.nonzero(n)[None], "abs" if "abs" not in kinds else "max" if "max" not in kinds else "square"
        potential.append(Term(kind, stiff * float(d.positive()) * (u / tau) ** 2, u, P, P @ d.reals(n)))
    elements = []
    for _ in range(d.count(0, 3)):
        factors = np.abs(d.reals(4)) * [1, *d.one_of((0, 0, 0), (1, 0, 0), (1, 1, 1), (0, 1, 0))]
        H = np.eye(n) if d.chance() else d.reals(d.count(1, n), n)
        elements.append(Friction(H, u / tau, factors if factors.any() else np.array([1.0, 0, 0, 0])))
    M = None if d.chance() else (d.psd(n) + d.skew(n)) / tau
    bounds = _bounds(d, n, u, x0[None], d.one_of(0, 0, 1, 2))
    x, s = ca.SX.sym("x", n), ca.SX.sym("s")
    grid = d.grid(tau, (0.1, 1e-3, 0.01, 1.0), growing=True)
    arguments: dict[str, Any] = {
        "x": x, "potential": sum((term.expression(x) for term in potential), ca.SX(0)),
        "friction": {f"e{i}": (one.H, one.expression(s)) for i, one in enumerate(elements)}, "s": s,
        "damping": M, "constraints": {f"c{i}": bound.expression(x) for i, bound in enumerate(bounds)},
        "x0": u * x0, "v0": u / tau * v0, **grid,
    }  # fmt: skip
    smooth = [term for term in potential if term.phi in SMOOTH]
    twin = SimpleNamespace(
        smooth=smooth, kinked=[term for term in potential if term.phi in KINKED], potential=potential, elements=elements,
        M=np.zeros((n, n)) if M is None else M, bounds=bounds,
    )  # fmt: skip
    return Scene(FrictionOscillator, arguments, twin)


# ---------------------------------------------------------------------------------------------- M: monotone inclusions


class Jump(NamedTuple):
    """A kinked term whose selection s is in -scale dphi(u); it adds push P's to the velocity."""

    term: Term
    scale: float
    push: float


@st.composite
def inclusions(draw: Callable[[Any], Any]) -> Scene:
    """Dissipative fields, signs of any arguments, potentials and laws, boxes, planes and ellipsoids, exact projections or not."""
    d = Draw(draw)
    n = d.count(1, 5)
    u, tau = float(d.decades()), float(d.decades())
    starts = d.reals(2, n)
    K, b, cubic = d.psd(n) / n + d.skew(n), d.reals(n), d.one_of(0.0, 0.0, 0.1)
    box_only = d.chance()
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    for i in range(n if d.chance() else 0):
        kind = d.count(0, 3)
        if kind % 2:
            lower[i] = starts[:, i].min() - d.one_of(*SLACKS)
        if kind > 1:
            upper[i] = starts[:, i].max() + d.one_of(0.5, 0.1, 1.0)
    bounds = [] if box_only else _bounds(d, n, u, starts, d.count(1, 2))
    x, start, terms = ca.SX.sym("x", n), ca.SX.sym("a", n), []
    operator: dict[str, Any] = {}
    kind = d.one_of("none", "signs", "each", "law", "phi")
    if kind == "signs":  # sum of P' w sign(P x - c), one row each
        for P in {tuple(d.nonzero(n)): None for _ in range(d.count(1, 2))}:
            P = np.array([P])
            terms.append(Term("abs", float(d.positive()), u, P, P @ starts[0] * d.one_of(1, 0)))
        S = sum(t.w * ca.DM(t.P.T) @ ca.sign(affine(t.P / u, x) - ca.DM(t.c)) for t in terms)
        operator = {"operator": u / tau * S}
    elif kind in ("each", "law"):
        mu = d.positive(n)
        terms = [Term("abs", float(mu[i]), u, np.eye(n)[i : i + 1], np.zeros(1)) for i in range(n)]
        operator = {"operator": u / tau * mu * ca.sign(x) if kind == "each" else relay(n, -u / tau * mu, u / tau * mu)}
    elif kind == "phi":
        for phi in [kind for kind in KINKED if d.chance()] or ["abs"]:
            P = d.nonzero(n)[None] if phi != "norm" else np.eye(n)
            if phi != "norm" or n > 1:
                terms.append(Term(phi, float(d.positive()), u, P, P @ starts[0] * d.one_of(1, 0)))
        operator = {"phi": u**2 / tau * sum((t.expression(x) for t in terms), ca.SX(0))}
    signs = kind != "phi"
    jumps = [Jump(t, 1.0 if signs else t.w * u**2 / tau, t.w * u / tau if signs else 1 / u) for t in terms]
    eps = d.one_of(None, None, 1e-6, "cubic")
    tolerances = {None: None, 1e-6: 1e-6 * u**2, "cubic": lambda mu: 1e-2 * u**2 * (mu / tau) ** 3}[eps]
    field = u / tau * (ca.DM(b) - affine(K / u, x) - cubic * (x / u) ** 3)
    arguments = {
        "x": x, "field": field, **operator, "lower": u * lower, "upper": u * upper,
        "constraints": {f"c{i}": bound.expression(x) for i, bound in enumerate(bounds)}, "x0": start,
        "parameters": named(u * starts[0]), "tolerances": tolerances, **d.grid(tau, (0.1, 1e-3, 0.01, 0.2)),
    }  # fmt: skip

    def force(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value = b - x @ K.T / u - cubic * (x / u) ** 3
        return u / tau * value, u / tau * (np.abs(b) + np.abs(x) @ np.abs(K.T) / u + cubic * np.abs(x / u) ** 3)

    twin = SimpleNamespace(
        force=force, jumps=jumps, lower=u * lower, upper=u * upper, bounds=bounds, starts=u * starts, eps=tolerances,
        separate=kind in ("each", "law"), L=-np.linalg.eigvalsh((K + K.T) / 2)[0] / tau, u=u, tau=tau,
    )  # fmt: skip
    return Scene(MonotoneInclusion, arguments, twin)


# ---------------------------------------------------------------------------------------------- F, L: laws in a loop


class LawBlock(NamedTuple):
    """A factor of a law, in units of its multipliers: its kind, rows, and what bounds it."""

    kind: str
    rows: slice
    lower: np.ndarray
    upper: np.ndarray
    H: np.ndarray
    K: np.ndarray

    def law(self) -> Any:
        m = self.rows.stop - self.rows.start
        made = {
            "complementarity": lambda: complementarity(m),
            "equality": lambda: equality(m),
            "relay": lambda: relay(m, self.lower, self.upper),
            "box": lambda: box(self.lower, self.upper),
            "ball": lambda: ball(m, float(self.upper[0])),
            "cone": lambda: second_order_cone(m),
            "polyhedron": lambda: polyhedron(self.H, self.K),
        }
        return made[self.kind]()


KINDS = ("relay", "complementarity", "box", "equality", "ball", "cone", "polyhedron")


def _laws(d: Draw, m: int) -> tuple[list[LawBlock], np.ndarray]:
    """Blocks with m rows in all, and the units of their multipliers: one unit in each curved block."""
    blocks, units, at = [], d.decades(m), 0
    while at < m:
        kind = d.one_of(*KINDS)
        size = min(d.count(1, 3), m - at)
        if kind in ("ball", "cone") and size == 1:
            kind = "complementarity"
        rows = slice(at, at + size)
        if kind in ("ball", "cone", "polyhedron"):
            units[rows] = units[at]
        U = units[rows]
        lower, upper, H, K = np.full(size, -np.inf), np.full(size, np.inf), np.zeros((0, size)), np.zeros(0)
        if kind == "complementarity":
            lower = np.zeros(size)
        elif kind == "relay":
            lower = d.reals(size) * U
            upper = lower + np.abs(d.reals(size)) * U
        elif kind == "box":
            lower = np.where(d.reals(size) > 0, -np.inf, -np.abs(d.reals(size)) * U)
            upper = np.where(d.reals(size) > 0, np.inf, np.abs(d.reals(size)) * U)
        elif kind == "ball":
            upper = np.full(size, float(np.abs(d.reals(1)[0])) * U[0])
        elif kind == "polyhedron":
            H = np.array([d.nonzero(size) for _ in range(d.count(1, 3))])
            K = (H @ d.reals(size) - d.one_of(1.0, 0.0, 3.0)) * U[0]
        blocks.append(LawBlock(kind, rows, lower, upper, H, K))
        at += size
    return blocks, units


class Loop(NamedTuple):
    """P x' = (S - K) x - c(x) + e(t) + C'l, y = C x + D l with K, D >= 0 and c monotone: one solution, contraction in |.|_P."""

    n: int
    m: int
    P: np.ndarray
    J: np.ndarray
    cubic: np.ndarray
    bend: np.ndarray
    e0: np.ndarray
    e1: np.ndarray
    C: np.ndarray
    D: np.ndarray
    blocks: list[LawBlock]
    T: np.ndarray
    U: np.ndarray
    tau: float
    start: np.ndarray


def _loop(d: Draw, singular: bool) -> Loop:
    n, m = d.count(1, 5), d.count(1, 4)
    blocks, U = _laws(d, m)
    T, tau = d.decades(n), float(d.decades())
    P, K = d.psd(n) / 2, d.psd(n) * d.one_of(0.5, 1.0, 100.0, 1e6)
    if not (singular and d.chance()):
        P = P + np.diag(d.positive(n))
    else:
        K = K + np.eye(n)
    C = d.reals(m, n)
    if m > 1 and d.count(0, 4) == 4:
        C[-1] = C[0]  # rows that repeat each other
    D = np.zeros((m, m)) if d.chance() else d.psd(m) / m + d.skew(m) * d.one_of(1.0, 0.0)
    if any(block.kind == "cone" for block in blocks):
        D = D + np.eye(m) / 4  # a cone that is not polyhedral needs an interior
    smooth = d.count(0, 2) < 2
    nothing = np.zeros(n)
    cubic, bend = (nothing, nothing) if smooth else (np.abs(d.reals(n)) / 2 * d.one_of(1, 0), np.abs(d.reals(n)))
    return Loop(n, m, P, d.skew(n) - K, cubic, bend, d.reals(n), d.reals(n) * d.one_of(0, 1), C, D, blocks, T, U, tau, d.reals(n))


def _force(loop: Loop, x: ca.SX, t: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(S - K) z - c(z) at z = x/T, and e(t/tau), as expressions."""
    z = x / ca.DM(loop.T)
    rate = ca.mtimes(ca.DM(loop.J), z) - ca.DM(loop.cubic) * z**3 - ca.DM(loop.bend) * ca.atan(z)
    return rate, ca.DM(loop.e0) + ca.DM(loop.e1) * ca.sin(t / loop.tau)


def _numbers_of(loop: Loop, **other: Any) -> SimpleNamespace:
    """The twin in units: M x' = f(t, x) + G l, y = C x + D l."""
    T, U, tau = loop.T, loop.U, loop.tau

    def f(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, wave = x / T, np.sin(t / tau)[:, None] * loop.e1
        value = z @ loop.J.T - loop.cubic * z**3 - loop.bend * np.arctan(z) + loop.e0 + wave
        size = np.abs(z) @ np.abs(loop.J.T) + loop.cubic * np.abs(z) ** 3 + loop.bend * np.abs(z) + np.abs(loop.e0)
        return value / T, (size + np.abs(np.outer(1 + t / tau, loop.e1))) / T

    def f_x(x: np.ndarray) -> np.ndarray:
        z = x / T
        slope = 3 * loop.cubic * z**2 + loop.bend / (1 + z**2)
        return (loop.J - slope[..., None] * np.eye(loop.n)) / np.outer(T, T)

    return SimpleNamespace(
        M=tau * loop.P / np.outer(T, T), f=f, f_x=f_x, C=loop.C / np.outer(U, T), D=loop.D / np.outer(U, U), blocks=loop.blocks,
        U=U, starts=np.array([T * loop.start, np.roll(T * loop.start, 1) / np.roll(T, 1) * T]), **other,
    )  # fmt: skip


LENGTHS = (0.1, 1e-3, 0.01, 1.0, 100.0)


@st.composite
def first_order(draw: Callable[[Any], Any]) -> Scene:
    """The loop as M x' = f + r: M may be singular, the output bent by l^3 and moved in time, the equations in any units."""
    d = Draw(draw)
    loop = _loop(d, singular=True)
    boxes = all(block.kind in ("relay", "complementarity", "box", "equality") for block in loop.blocks)
    kappa = d.one_of(0.0, 0.0, 0.5) if boxes else 0.0
    a = loop.start * d.one_of(0.0, 1.0)
    weight = d.decades(loop.n)
    theta = d.one_of(1.0, 1.0, 0.5, 0.75)
    x, l, start, t = ca.SX.sym("x", loop.n), ca.SX.sym("l", loop.m), ca.SX.sym("a", loop.n), ca.SX.sym("t")
    rate, drive = _force(loop, x, t)
    z, lam = x / ca.DM(loop.T), l / ca.DM(loop.U)
    moved = z - ca.DM(a) * ca.cos(t / loop.tau)
    y = ca.mtimes(ca.DM(loop.C), moved) + ca.mtimes(ca.DM(loop.D), lam) + kappa * lam**3
    row = ca.DM(weight / loop.T)
    twin = _numbers_of(loop, weight=weight, theta=theta, kappa=kappa, a=a * loop.T, tau=loop.tau, phi=None)
    arguments = {
        "t": t, "x": x, "lam": l, "f": row * (rate + drive), "h": y / ca.DM(loop.U),
        "g": row * ca.mtimes(ca.DM(loop.C.T), lam), "M": weight[:, None] * twin.M,
        "law": product(*(block.law() for block in loop.blocks)), "x0": start, "parameters": named(twin.starts[0]),
        "theta": theta, **d.grid(loop.tau, LENGTHS),
    }  # fmt: skip
    return Scene(FirstOrderSystem, arguments, twin)


@st.composite
def lure(draw: Callable[[Any], Any]) -> Scene:
    """The loop as x' = A(x) + B l + f(t), so that P B = C'; with a law, or with a potential of y."""
    d = Draw(draw)
    loop = _loop(d, singular=False)
    theta = d.one_of(1.0, 1.0, 1.0, 0.5)
    phi = d.count(0, 3) if d.count(0, 2) == 2 else None
    if phi is not None:
        loop = loop._replace(U=np.full(loop.m, loop.U[0]), blocks=[])
    x, start, t, y = ca.SX.sym("x", loop.n), ca.SX.sym("a", loop.n), ca.SX.sym("t"), ca.SX.sym("y", loop.m)
    rate, drive = _force(loop, x, t)
    T, inverse = loop.T, np.linalg.inv(loop.P)
    nonlinear = bool(loop.cubic.any() or loop.bend.any())
    push = ca.DM(T[:, None] * inverse / loop.tau)
    twin = _numbers_of(loop, weight=np.ones(loop.n), theta=theta, kappa=0.0, a=np.zeros(loop.n), tau=loop.tau, phi=None)
    u = loop.U[0]
    weights = d.positive(2)
    potential = {
        0: lambda: weights[0] * ca.norm_1(u * y), 1: lambda: weights[0] * ca.norm_2(u * y),
        2: lambda: weights[0] * ca.norm_inf(u * y) + weights[1] * ca.sumsqr(u * y) / 2,
        3: lambda: weights[0] * ca.mmax(ca.vertcat(u * y, 0)),
    }  # fmt: skip
    law = {"law": product(*(block.law() for block in loop.blocks))} if phi is None else {"phi": potential[phi](), "y": y}
    if phi is not None:
        twin.phi = (phi, weights, u)
    arguments = {
        "t": t, "x": x, "A": ca.mtimes(push, rate) if nonlinear else T[:, None] * (inverse @ loop.J) / T / loop.tau,
        "B": T[:, None] * (inverse @ loop.C.T) / loop.U / loop.tau, "C": twin.C,
        "D": twin.D if d.chance() or loop.D.any() else None,
        "f": ca.mtimes(push, drive), **law, "x0": start, "parameters": named(twin.starts[0]), "theta": theta,
        **d.grid(loop.tau, LENGTHS),
    }  # fmt: skip
    return Scene(LureSystem, arguments, twin)
