"""A model under trial: its report, points of a scope, and expressions at points in doubles and in 64 digits."""

from __future__ import annotations

import decimal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import LinAlgError
from scipy.optimize import nnls

from .digits import CONTEXT, Exact, column

MARGIN = 1e-7
POINTS = 60
HOLDS, VIOLATED = "holds", "violated"
Array = np.ndarray


# ------------------------------------------------------------------------------------------------ expressions at points


class Values:
    """An expression of columns at points: doubles, or decimals rounded at the end; derivatives in its last column."""

    def __init__(self, symbols: Sequence[ca.SX], expression: Any) -> None:
        self.symbols, self.expression = list(symbols), ca.densify(ca.vec(ca.SX(expression)))
        self._f = ca.Function("f", self.symbols, [self.expression])

    @cached_property
    def _exact(self) -> Exact:
        return Exact(self.symbols, [self.expression])

    @cached_property
    def _jacobian(self) -> ca.Function:
        return ca.Function("J", self.symbols, [ca.densify(ca.jacobian(self.expression, self.symbols[-1]))])

    def __call__(self, *at: Any, exact: bool = False) -> Array:
        with suppress(KeyError):  # an operation that is not among those in 64 digits
            if exact:
                return np.array([float(v) for v in self._exact(*map(_columns, at))[0]])
        return np.array(self._f(*at)).ravel()

    def jacobian(self, *at: Any, exact: bool = False) -> Array:
        """(rows, n): by CasADi, or by central differences in 64 digits."""
        if not exact:
            return np.array(self._jacobian(*at)).reshape(self.expression.numel(), self.symbols[-1].numel())
        *before, x = map(_columns, at)
        with decimal.localcontext(CONTEXT):
            s = decimal.Decimal("1e-22") * (1 + max(map(abs, x), default=decimal.Decimal(0)))
            moved = [[self._exact(*before, [*x[:j], x[j] + e, *x[j + 1 :]])[0] for e in (s, -s)] for j in range(len(x))]
            return np.array([[float((a - b) / (2 * s)) for a, b in zip(*pair, strict=True)] for pair in moved]).T

    def bend(self, row: int, d: Array, *at: Any) -> float:
        """The second derivative of a row along d, by differences in 64 digits."""
        *before, x = map(_columns, at)
        along = _columns(d)
        with suppress(KeyError):
            return self._bend(row, along, before, x)
        H = ca.Function("H", self.symbols, [ca.densify(ca.hessian(self.expression[row], self.symbols[-1])[0])])
        return float(d @ np.array(H(*at)) @ d)

    def _bend(self, row: int, along: Any, before: Any, x: Any) -> float:
        with decimal.localcontext(CONTEXT):
            s = decimal.Decimal("1e-16") * (1 + max(map(abs, x), default=decimal.Decimal(0)))
            a, b, c = (self._exact(*before, [v + k * s * w for v, w in zip(x, along, strict=True)])[0][row] for k in (-1, 0, 1))
            return float((a - 2 * b + c) / s**2)


def _columns(values: Any) -> list[decimal.Decimal]:
    return column(np.atleast_1d(np.asarray(values, float)).ravel())


def numbers(matrix: Any) -> Array:
    return np.array(ca.DM(matrix)).reshape(matrix.shape)


def jump(f: Callable[[Array], Array], a: Array, b: Array) -> float:
    """What is left of |f(b) - f(a)| when the interval is halved towards the larger change, down to rounding."""
    u, v = f(a), f(b)
    for _ in range(50):
        middle = (a + b) / 2
        w = f(middle)
        if np.linalg.norm(w - u) > np.linalg.norm(v - w):
            b, v = middle, w
        else:
            a, u = middle, w
    return float(np.linalg.norm(v - u) / (1 + np.linalg.norm(u) + np.linalg.norm(v)))


# ------------------------------------------------------------------------------------------------ one model under test


@dataclass
class Trial:
    """A model, its report, and what was tested of it."""

    name: str
    seed: int
    report: Any
    rng: np.random.Generator
    held: set[str] = field(default_factory=set)
    refuted: set[str] = field(default_factory=set)
    untested: set[str] = field(default_factory=set)
    bad: list[dict[str, Any]] = field(default_factory=list)

    @property
    def model(self) -> Any:
        return self.report.model

    @cached_property
    def x0(self) -> Array:
        return numbers(getattr(self.model, "x0" if hasattr(self.model, "x0") else "q0")).ravel()

    def holding(self, *ids: str) -> Iterator[Any]:
        """The findings among these that hold."""
        for finding in self.report.findings:
            if finding.id in ids and finding.verdict == HOLDS:
                self.held.add(finding.id)
                yield finding

    def violated(self, id: str) -> Iterator[Any]:
        for finding in self.report.findings:
            if finding.id == id and finding.verdict == VIOLATED:
                yield finding

    def follows(self, name: str) -> Iterator[Any]:
        for item in self.report.consequences:
            if item.name == name and item.verdict == HOLDS:
                self.held.add(name)
                yield item

    def need(self, id: str, excess: Callable[[bool], float], margin: float = MARGIN, **at: Any) -> None:
        """Note a contradiction where the relative excess is above the margin in doubles and in 64 digits."""
        if any(item["id"] == id for item in self.bad):
            return
        with suppress(FloatingPointError, ZeroDivisionError, LinAlgError, np.linalg.LinAlgError):
            value = excess(False)
            if value > margin:
                with suppress(KeyError, decimal.DecimalException, ArithmeticError):
                    value = excess(True)
                if value > margin:
                    self.note(id, excess=value, **at)

    def note(self, id: str, **at: Any) -> None:
        self.bad.append({"id": id, **{key: _plain(item) for key, item in at.items()}})

    def witness(self, id: str, true: bool | None, **at: Any) -> None:
        """What putting a witness into the model showed; None: this kind of witness is not known here."""
        if true is None:
            self.untested.add(id)
            return
        self.refuted.add(id)
        if not true:
            self.note(id, claimed=VIOLATED, **at)

    def times(self, scope: Any, count: int = POINTS) -> Array:
        end = float(self.model.t_end or 1.0)
        low, high = scope.time if scope is not None and scope.time is not None else (0.0, 10 * end)
        return np.concatenate([[low, high], self.rng.uniform(low, high, count)])[:count]

    def points(self, scope: Any, names: Sequence[str], count: int = POINTS) -> list[Array]:
        """States of the scope: corners of a box, what is near the start, what is small, large, whole or on an axis."""
        n, rng = len(names), self.rng
        states = {} if scope is None else scope.states
        low = np.array([states.get(name, (-np.inf, 0))[0] for name in names])
        high = np.array([states.get(name, (0, np.inf))[1] for name in names])
        boxed, out = np.isfinite(low) & np.isfinite(high), []
        start = self.x0 if len(self.x0) == n else np.zeros(n)
        for _ in range(count):
            size = 10.0 ** rng.choice([-4, -1, 0, 0, 1, 3])
            x = rng.normal(size=n) * size + start * rng.integers(2)
            x = np.round(x) if rng.random() < 0.15 else x
            x[rng.random(n) < 0.15] = 0.0
            inside = low + (high - low) * np.clip(rng.random(n) * 1.3 - 0.15, 0, 1) if boxed.any() else x
            out.append(np.where(boxed, np.clip(inside, low, high), x) if boxed.any() else x)
        return out

    def pairs(self, points: Sequence[Array]) -> Iterator[tuple[Array, Array]]:
        """Neighbours of the list: far ones, and near ones on the way between."""
        for a, b in pairwise(points):
            yield a, b
            yield a, a + 10.0 ** self.rng.choice([-1, -3, -5]) * (b - a)


def _plain(item: Any) -> Any:
    if isinstance(item, np.ndarray | np.generic):
        return item.tolist()
    return [_plain(part) for part in item] if isinstance(item, list | tuple) else item


def above(left: float, right: float, size: float = 0.0) -> float:
    """How far left > right, beside their sizes."""
    return (left - right) / (abs(left) + abs(right) + size + 1e-300)


def hull(normals: Array) -> float:
    """The distance from 0 to the convex hull of the columns."""
    l, _ = nnls(np.vstack([normals, np.ones(normals.shape[1])]), np.r_[np.zeros(len(normals)), 1.0])
    return float(np.linalg.norm(normals @ l) / l.sum())


def slope_at_0(theta: Values) -> float:
    """theta'(0+): at the least speed at which it is no 0/0."""
    slopes = (float(theta.jacobian(s)[0, 0]) for s in (1e-200, 1e-100, 1e-30, 0.0))
    return next(slope for slope in slopes if np.isfinite(slope))


class Inclusion:
    """Elements of G = F - S, and C with its tangent cones, written down from the fields."""

    def __init__(self, m: Any) -> None:
        self.m, self.n = m, len(m.names)
        self.signs = m.sign_symbols
        phi = getattr(m, "phi", None)
        S = m.operator if phi is None else ca.gradient(ca.SX(phi), m.x)
        self.f = Values([m.x], m.field)
        self.s = Values([self.signs, m.x], S)
        self.u = Values([m.x], m.sign_arguments)
        self.lower, self.upper = numbers(m.lower).ravel(), numbers(m.upper).ravel()
        self.c = Values([m.x], ca.vertcat(ca.SX(0, 1), *m.constraints.values()))

    def operator(self, x: Array, rng: np.random.Generator, exact: bool = False) -> Array:
        u = self.u(x) if self.signs.numel() else np.zeros(0)
        sigma = np.where(u == 0, rng.uniform(-1, 1, len(u)), np.sign(u))
        return self.s(sigma, x, exact=exact)

    def velocity(self, x: Array, rng: np.random.Generator, exact: bool = False) -> Array:
        return self.f(x, exact=exact) - self.operator(x, rng, exact)

    def inside(self, x: Array, slack: float = 1e-12) -> bool:
        e = slack * (1 + np.abs(x).max())
        return bool((x >= self.lower - e).all() and (x <= self.upper + e).all() and (self.c(x) >= -e).all())

    def projected(self, x: Array, v: Array) -> Array:
        """The part of v that the tangent cone of C at x leaves."""
        e = 1e-9 * (1 + np.abs(x).max())
        eye = np.eye(self.n)
        out = np.vstack([-eye[x <= self.lower + e], eye[x >= self.upper - e], -self.c.jacobian(x)[self.c(x) <= e]])
        return v if not len(out) else v - out.T @ nnls(out.T, v)[0]

    def pulled(self, x: Array, x0: Array) -> Array:
        x = np.clip(x, self.lower, self.upper)
        low, high = (1.0, 1.0) if self.inside(x) else (0.0, 1.0)
        for _ in range(0 if low else 60):
            middle = (low + high) / 2
            low, high = (middle, high) if self.inside(x0 + middle * (x - x0)) else (low, middle)
        return x0 + low * (x - x0)


def into(trial: Trial, l: Array) -> Array:
    """Multipliers moved into K."""
    out = l.copy()
    if trial.model.law is None:
        return out
    start = 0
    for block in trial.model.law.blocks:
        rows = slice(start, start + block.size)
        part = out[rows]
        if block.kind == "box":
            out[rows] = np.clip(part, numbers(block.lower).ravel(), numbers(block.upper).ravel())
        elif block.kind == "ball":
            out[rows] = part * min(1.0, float(block.radius) / (np.linalg.norm(part) + 1e-300))
        elif block.kind == "cone":
            part[0] = np.linalg.norm(part[1:]) * (1 + trial.rng.random())
        else:
            out[rows] = 0.0 if (block.K <= 0).all() else part
        start = rows.stop
    return out
