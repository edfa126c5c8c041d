"""False sentences of ``nsmodel.check`` on the random models of ``checked``, looked for by direct formulas at points.

    python -m tests.search.oracle                                  # 100 models of each class
    python -m tests.search.oracle --class inclusion --models 50 --first 200 --json found.json

What holds is tested at points of its scope (of many sizes, on corners and switches) with the numbers printed; a witness of a
violation is put into the model; what follows is tested on runs. A contradiction counts from MARGIN of the sizes compared, and is
computed again in 64 digits, there with
differences in the place of derivatives. Of nsmodel only ``check`` and ``simulate`` are used.
"""

# ruff: noqa: B023 - functions made in loops are called at once, in the same round
from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import LinAlgError, eigh
from scipy.optimize import nnls

from nsmodel import check, simulate

from .checked import draw
from .digits import CONTEXT, Exact, column, decimal

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


# ------------------------------------------------------------------------------------------------ sweeping processes


def sweeping(trial: Trial) -> None:
    m = trial.model
    g, f = Values([m.t, m.q], m.g), Values([m.t, m.q], m.f)
    speed = Values([m.q, m.t], m.g)
    turn = Values([m.t, m.q], ca.jacobian(m.g, m.t))
    rows = m.g.numel()

    def sample(finding: Any) -> Iterator[tuple[float, Array]]:
        return zip(trial.times(finding.scope), trial.points(finding.scope, m.names), strict=True)

    for finding in trial.holding("S-convex"):
        for t, (a, b) in zip(
            trial.times(finding.scope, 2 * POINTS), trial.pairs(trial.points(finding.scope, m.names)), strict=False
        ):

            def chord(exact: bool, t: float = t, a: Array = a, b: Array = b) -> float:
                u, v, w = g(t, a, exact=exact), g(t, (a + b) / 2, exact=exact), g(t, b, exact=exact)
                return float(np.nanmax((v - (u + w) / 2) / (abs(u) + abs(v) + abs(w) + np.abs([a, b]).max() + 1e-300), initial=0))

            trial.need("S-convex", chord, 1e-9, t=t, a=a, b=b)
    for finding in trial.holding("A1"):
        for t, q in sample(finding):
            for i in np.flatnonzero(g(t, q) >= 0):

                def length(exact: bool, t: float = t, q: Array = q, i: int = i) -> float:
                    size = np.linalg.norm(g.jacobian(t, q, exact=exact)[i])
                    return max(above(finding.value["a"], size), above(size, finding.value["b"]))

                trial.need("A1", length, t=t, q=q, row=int(i), value=dict(finding.value))
    for finding in trial.holding("A2"):
        for t, q in sample(finding):
            for i in np.flatnonzero(g(t, q) >= 0):
                trial.need(
                    "A2",
                    lambda exact, t=t, q=q, i=i: above(abs(speed.jacobian(q, t, exact=exact)[i, 0]), finding.value["b"], 1e-9),
                    t=t, q=q, row=int(i), value=dict(finding.value),
                )  # fmt: skip
    for finding in trial.holding("A3"):
        for t, q in sample(finding):
            for i in np.flatnonzero(g(t, q) >= 0):
                trial.need(
                    "A3",
                    lambda exact, t=t, q=q, i=i: above(
                        float(np.linalg.norm(turn.jacobian(t, q, exact=exact)[i])), finding.value["M"], 1e-9
                    ),
                    t=t, q=q, row=int(i), value=dict(finding.value),
                )  # fmt: skip
    hessians = [Values([m.t, m.q], ca.hessian(m.g[i], m.q)[0]) for i in range(rows)]
    n = len(m.names)
    for finding in trial.holding("A4"):
        for t, q in sample(finding):
            for i in np.flatnonzero(g(t, q) >= 0):

                def curvature(exact: bool, t: float = t, q: Array = q, i: int = i) -> float:
                    values, vectors = np.linalg.eigh(hessians[i](t, q).reshape(n, n))
                    k = int(np.argmax(abs(values)))
                    size = abs(g.bend(i, vectors[:, k], t, q)) if exact else abs(values[k])
                    return above(size, finding.value["M"], 1e-9)

                trial.need("A4", curvature, t=t, q=q, row=int(i), value=dict(finding.value))
    for finding in trial.holding("A5", "A5'"):
        _qualified(trial, finding, g)
    for finding in trial.holding("S-f"):
        for t, (a, b) in zip(
            trial.times(finding.scope, 2 * POINTS), trial.pairs(trial.points(finding.scope, m.names)), strict=False
        ):
            if (g(t, a) < 0).any() or (g(t, b) < 0).any():
                continue

            def lipschitz(exact: bool, t: float = t, a: Array = a, b: Array = b) -> float:
                u, v = f(t, a, exact=exact), f(t, b, exact=exact)
                d = np.linalg.norm(a - b)
                rounding = (np.linalg.norm(u) + np.linalg.norm(v)) * (0 if exact else 1e-7)
                steep = above(float(np.linalg.norm(u - v)) - rounding, finding.value["K_f"] * d, 1e-9 * d + 1e-12)
                return max(steep, above(float(np.linalg.norm(u)), finding.value["L_f"] * (1 + float(np.linalg.norm(a))), 1e-9))

            trial.need("S-f", lipschitz, 1e-6, t=t, a=a, b=b, value=dict(finding.value))
    for _ in trial.holding("S-start"):
        trial.need("S-start", lambda exact: -float(g(0.0, trial.x0, exact=exact).min(initial=0)) * 1e300, q0=trial.x0)
    _sweeping_witnesses(trial, g, speed)
    for item in trial.follows("well posed"):
        for t in np.linspace(0, float(m.t_end or 1), 41):
            if not (np.isfinite(f(t, trial.x0)).all() and np.isfinite(g(t, trial.x0)).all()):
                trial.note("well posed", t=t)
        del item
    for item in trial.follows("prox-regular"):
        _prox_regular(trial, item, g)
    for item in trial.follows("K_L"):
        _moves(trial, item, g, speed)


def _in_scope(item: Any, names: Sequence[str], q: Array) -> bool:
    states = {} if item.scope is None else item.scope.states
    return all(low <= q[names.index(name)] <= high for name, (low, high) in states.items())


def _contacts(trial: Trial, item: Any, g: Values) -> Iterator[tuple[float, Array, Array, Array]]:
    """Admissible points with g_i = 0 for one i or more: (t, q, numbers of the rows, their gradients)."""
    m = trial.model
    for t, q in zip(trial.times(item.scope), trial.points(item.scope, m.names), strict=True):
        for i in range(m.g.numel()):
            at = np.array(q, float)
            for _ in range(30):
                value, slope = g(t, at)[i], g.jacobian(t, at)[i]
                if not (np.isfinite(value) and slope @ slope > 0):
                    break
                at = at - value * slope / (slope @ slope)
            value = g(t, at)
            if not (
                np.isfinite(value).all() and abs(value[i]) < 1e-11 and (value > -1e-11).all() and _in_scope(item, m.names, at)
            ):
                continue
            rows = np.flatnonzero(value < 1e-11)
            yield t, at, rows, g.jacobian(t, at)[rows]


def _prox_regular(trial: Trial, item: Any, g: Values) -> None:
    """<n, q' - q> <= |q' - q|^2 / (2 eta) for outward unit normals n at q and admissible q', near and far."""
    m, eta = trial.model, item.value.get("eta", np.inf)
    for t, q, _, slopes in _contacts(trial, item, g):
        n = -slopes.T @ trial.rng.uniform(0, 1, len(slopes))
        if not np.linalg.norm(n) > 0:
            continue
        n /= np.linalg.norm(n)
        for size in (1e-2, 0.3, 1.0, 10.0):
            other = q + size * (n + trial.rng.normal(size=len(q)) * trial.rng.choice([0.1, 1.0]))
            d = other - q
            if (g(t, other) >= 0).all() and _in_scope(item, m.names, other):
                over = float(n @ d) - float(d @ d) / (2 * eta)
                if over > 1e-6 * (np.linalg.norm(d) + 1e-6):
                    trial.note(item.name, t=t, q=q, other=other, eta=eta, over=over)


def _moves(trial: Trial, item: Any, g: Values, speed: Values) -> None:
    """Where one constraint closes alone, its boundary moves no faster than K_L."""
    for t, q, rows, slopes in _contacts(trial, item, g):
        if len(rows) == 1 and np.linalg.norm(slopes[0]) > 0:
            pace = -speed.jacobian(q, t)[rows[0], 0] / np.linalg.norm(slopes[0])
            if pace > item.value.get("K_L", np.inf) * (1 + 1e-7) + 1e-9:
                trial.note(item.name, t=t, q=q, pace=pace, value=dict(item.value))


def _qualified(trial: Trial, finding: Any, g: Values) -> None:
    """gamma at points of Q that some constraints nearly touch, found by Newton's method."""
    m, rng = trial.model, trial.rng
    touching = finding.id == "A5'"
    rho = 0.0 if touching else finding.value.get("rho", np.inf)
    states = {} if finding.scope is None else finding.scope.states
    for t, q in zip(trial.times(finding.scope), trial.points(finding.scope, m.names), strict=True):
        p = m.g.numel()
        some = rng.permutation(p)[: rng.integers(1, min(p, len(q), 3) + 1)] if p else []
        aim = rng.uniform(0, 1, len(some)) * (min(rho, 1.0) if rng.random() < 0.7 else 0.0)
        for _ in range(25):
            G, J = g(t, q)[some], g.jacobian(t, q)[some]
            if not (np.isfinite(G).all() and np.isfinite(J).all()):
                break
            q = q - np.linalg.lstsq(J, G - aim, rcond=None)[0]
        values = g(t, q)
        size = 1e-12 * (1 + np.abs(q).max())
        outside = any(not low <= q[m.names.index(name)] <= high for name, (low, high) in states.items())
        if outside or not np.isfinite(values).all() or (values < -size).any():
            continue
        near = np.flatnonzero(values <= (size if touching else rho))
        if not len(near):
            continue

        def gamma(exact: bool, t: float = t, q: Array = q, near: Array = near) -> float:
            normals = g.jacobian(t, q, exact=exact)[near]
            normals = normals / np.linalg.norm(normals, axis=1)[:, None]
            return above(1.0, finding.value["gamma"] * hull(normals.T))

        trial.need(finding.id, gamma, 1e-5, t=t, q=q, near=near, value=dict(finding.value))


def _row(model: Any, name: str) -> int:
    return list(model.multiplier_names).index(name)


def _sweeping_witnesses(trial: Trial, g: Values, speed: Values) -> None:
    m = trial.model

    def place(w: Any) -> tuple[float, Array]:
        return float(w.get("t", 0.0)), np.array([w.get(name, x) for name, x in zip(m.names, trial.x0, strict=True)], float)

    for finding in trial.violated("S-convex"):
        w = finding.witness
        if "eigenvector" not in w:
            trial.witness(finding.id, None)
            continue
        t, q = place(w)
        d = np.zeros(len(m.names))
        for name, part in zip(w.get("states", m.names), w["eigenvector"], strict=True):
            d[m.names.index(name)] = part
        trial.witness(finding.id, g.bend(_row(m, w["constraint"]), d, t, q) < 0, witness=str(dict(w)))
    for finding in trial.violated("A2"):
        w = finding.witness
        t, q = place(w)
        i = _row(m, w["constraint"])
        slopes = [max(abs(speed.jacobian(q, t + s, exact=False)[i, 0]) for s in (e, -e)) for e in (1e-4, 1e-8, 1e-12)]
        with np.errstate(all="ignore"):
            steps = max(abs(g(t + s, q)[i] - g(t, q)[i]) for s in (1e-13, -1e-13))
        trial.witness(finding.id, bool(steps > 1e-6 or np.nanmax(slopes) > 10 * slopes[0]), witness=str(dict(w)), slopes=slopes)
    for finding in [*trial.violated("A5"), *trial.violated("A5'")]:
        w = finding.witness
        if "weights" not in w or not all(name in w for name in m.names):
            trial.witness(finding.id, None)
            continue
        t, q = place(w)
        rows = [_row(m, name) for name in w["constraints"]]
        J = g.jacobian(t, q, exact=True)[rows]
        J = J / np.linalg.norm(J, axis=1)[:, None]
        off = float(np.linalg.norm(np.array(w["weights"]) @ J))
        trial.witness(finding.id, off < 1e-6 and g(t, q).min() > -1e-9 * (1 + np.abs(q).max()), witness=str(dict(w)), off=off)
    for finding in trial.violated("S-start"):
        trial.witness(finding.id, bool(g(0.0, trial.x0, exact=True).min() < 0), witness=str(dict(finding.witness)))
    for id in ("A0", "A1", "A3", "A4", "S-f"):
        for _ in trial.violated(id):
            trial.witness(id, None)


# ------------------------------------------------------------------------------------------------ oscillators


def oscillator(trial: Trial) -> None:
    m, rng = trial.model, trial.rng
    n = len(m.names)
    thetas = {e.name: Values([m.s], e.theta) for e in m.elements}
    g = Values([m.x], m.potential)
    c = Values([m.x], ca.vertcat(ca.SX(0, 1), *m.constraints.values()))
    slopes = [(numbers(e.H), _slope_at_0(thetas[e.name])) for e in m.elements]
    for _ in trial.holding("O-theta"):
        for name, theta in thetas.items():
            for _ in range(POINTS):
                a, b = np.sort(rng.random(2) * 10.0 ** rng.choice([-3, -1, 0, 1, 2], 2))

                def convex(exact: bool, theta: Values = theta, a: float = a, b: float = b) -> float:
                    u, v, w = (float(theta(s, exact=exact)[0]) for s in (a, (a + b) / 2, b))
                    return max(above(v, (u + w) / 2, abs(u)), above(u, w)) if np.isfinite([u, v, w]).all() else 0.0

                trial.need("O-theta", convex, 1e-10, element=name, a=a, b=b)
        if m.damping is not None:
            M = numbers(m.damping)
            trial.need("O-theta", lambda _: -float(np.linalg.eigvalsh(M + M.T)[0]), 1e-12 * (1 + abs(M).max()), M=M)
    for finding in trial.holding("O-g"):
        points = [x for x in trial.points(finding.scope, m.names) if (c(x) >= 0).all()]
        for a, b in trial.pairs(points):

            def chord(exact: bool, a: Array = a, b: Array = b) -> float:
                u, v, w = (float(g(x, exact=exact)[0]) for x in (a, (a + b) / 2, b))
                return above(v, (u + w) / 2, abs(u) + abs(w) + 1e-12) if np.isfinite([u, v, w]).all() else 0.0

            trial.need("O-g", chord, 1e-10, a=a, b=b)
        least = finding.value.get("lower bound of g", finding.value.get("inf g"))
        for x in points if least is not None else []:
            trial.need("O-g", lambda exact, x=x: above(least, float(g(x, exact=exact)[0]), 1e-6), x=x, least=least)
    for finding in trial.holding("O-dry"):
        for d in [*np.eye(n), *rng.normal(size=(10 * POINTS, n))]:
            d = d / np.linalg.norm(d)
            sigma = sum(slope * float(np.linalg.norm(H @ d)) for H, slope in slopes)
            trial.need("O-dry", lambda _, s=sigma: above(finding.value["radius of A(0)"], s), direction=d, sigma=sigma)
    for item in trial.follows("rest points") if n == 1 else []:
        _rest(trial, item, g, c, sum(slope * float(np.linalg.norm(H)) for H, slope in slopes))
    _oscillator_witnesses(trial, g, c, thetas, slopes)


def _slope_at_0(theta: Values) -> float:
    """theta'(0+): at the least speed at which it is no 0/0."""
    slopes = (float(theta.jacobian(s)[0, 0]) for s in (1e-200, 1e-100, 1e-30, 0.0))
    return next(slope for slope in slopes if np.isfinite(slope))


def _rest(trial: Trial, item: Any, g: Values, c: Values, dry: float) -> None:
    """No point beyond the printed ends is at rest: there g' > theta'(0), or < -theta'(0)."""
    low, high = item.value.get("least x_inf", -np.inf), item.value.get("largest x_inf", np.inf)
    for s in (1e-6, 1e-3, 0.1, 1.0, 10.0):
        for x in ([low - s * (1 + abs(low))], [high + s * (1 + abs(high))]):
            if np.isfinite(x).all() and (c(x) > 0).all():
                trial.need(
                    "rest points", lambda exact, x=x: above(dry, abs(float(g.jacobian(np.array(x), exact=exact)[0, 0]))),
                    1e-9, x=x, dry=dry, value=dict(item.value),
                )  # fmt: skip


def _oscillator_witnesses(trial: Trial, g: Values, c: Values, thetas: dict[str, Values], slopes: Any) -> None:
    m = trial.model
    for finding in trial.violated("O-theta"):
        w = finding.witness
        if w.get("element") == "damping":
            v, M = np.array(w["vector"]), numbers(m.damping)
            trial.witness(finding.id, bool(v @ M @ v < 0), witness=str(dict(w)))
        elif "s" in w and w.get("element") in thetas:
            s, theta = float(w["s"]), thetas[w["element"]]
            e = 1e-9 * (1 + s)
            before, after = (float(theta.jacobian(max(s + k, 0.0))[0, 0]) for k in (-e, e))
            bend = theta.bend(0, np.ones(1), s) if s > 0 else -1.0
            trial.witness(finding.id, bool(min(before, after, bend) < 0 or abs(after - before) > 1e-5), witness=str(dict(w)))
        else:
            trial.witness(finding.id, None)
    for finding in trial.violated("O-g"):
        w = finding.witness
        if "vector" in w and "x" in w:
            x = trial.x0 if w["x"] == "any" else np.array(w["x"])
            trial.witness(finding.id, g.bend(0, np.array(w["vector"]), x) < 0, witness=str(dict(w)))
        elif "direction" in w:
            d, start = np.array(w["direction"]), np.array(w.get("from", trial.x0))
            fall = [float(g(start + s * d, exact=True)[0]) for s in (1e2, 1e4, 1e6)]
            trial.witness(finding.id, bool(fall[0] > fall[1] > fall[2]) and bool((c(start + 1e6 * d) >= -1e-6).all()),
                          witness=str(dict(w)), fall=fall)  # fmt: skip
        else:
            trial.witness(finding.id, None)
    for finding in trial.violated("O-dry"):
        d = finding.witness.get("direction")
        sigma = None if d is None else sum(slope * float(np.linalg.norm(H @ np.array(d))) for H, slope in slopes)
        trial.witness(finding.id, None if sigma is None else sigma < 1e-9, witness=str(dict(finding.witness)), sigma=sigma)


# ------------------------------------------------------------------------------------------------ first-order systems


def first_order(trial: Trial) -> None:
    m = trial.model
    lam, h = m.lam, float(m.step)
    n, size = len(m.names), lam.numel()
    z = [m.t, m.x, lam]
    parts = {
        "A": ca.jacobian(m.f, m.x), "K": ca.jacobian(m.g, m.x), "C": ca.jacobian(m.h, m.x),
        "B": ca.jacobian(m.g, lam), "D": ca.jacobian(m.h, lam),
    }  # fmt: skip
    read = {name: ca.Function(name, z, [ca.densify(part)]) for name, part in parts.items()}
    M = numbers(m.M)
    names = [*m.names, *m.multiplier_names]

    def at(t: float, x: Array, l: Array) -> dict[str, Array]:
        return {name: np.array(f(t, x, l)).reshape(parts[name].shape) for name, f in read.items()}

    def matrix(t: float, x: Array, l: Array, s: float = h) -> Array:
        own = at(t, x, l)
        return M - s * (m.theta * own["A"] + m.gamma * own["K"])

    def sample(scope: Any) -> Iterator[tuple[float, Array, Array]]:
        for t, both in zip(trial.times(scope), trial.points(scope, names), strict=True):
            yield t, both[:n], _into(trial, both[n:])

    for finding in trial.holding("F-W"):
        signs = {float(np.linalg.slogdet(matrix(*p))[0]): p for p in sample(finding.scope)}
        if len(signs) > 1 and all(np.isfinite(s) for s in signs):
            trial.note("F-W", signs={str(k): str(p) for k, p in signs.items()})
    for finding in trial.holding("F-step"):
        for t, x, l in sample(finding.scope):
            steps = h * np.r_[1.0, trial.rng.random(4)]
            signs = {float(np.linalg.slogdet(matrix(t, x, l, s))[0]) for s in steps}
            if len(signs) > 1:
                trial.note("F-step", t=t, x=x, l=l)
    for finding in trial.holding("F-mlcp"):
        for p in sample(finding.scope) if size else []:
            own = at(*p)
            W = h * m.gamma * own["C"] @ np.linalg.solve(matrix(*p), own["B"]) + own["D"]
            scale = abs(W).max() + 1e-300
            psd = np.linalg.eigvalsh(W + W.T)[0] >= -MARGIN * scale
            minors = size > 8 or all(
                np.linalg.det(W[np.ix_(s, s)] / scale) > -1e-12 for k in range(1, size + 1) for s in combinations(range(size), k)
            )
            if np.isfinite(W).all() and not (psd or minors):
                trial.note("F-mlcp", at=str(p), W=W)
    affine = not any(ca.depends_on(part, ca.vertcat(m.x, lam)) for part in parts.values())
    boxes = m.law is not None and all(block.kind == "box" for block in m.law.blocks)
    for finding in trial.holding("F-unique") if affine and boxes and 1 <= size <= 4 else []:
        for t, x, l in list(sample(finding.scope))[:10]:
            found = _solutions(m, t, x, l, at(t + h, x, l), matrix(t + h, x, l))
            size_of = 1e-9 * (1 + np.abs(l).max()) + np.linalg.norm(x)
            far = max((np.linalg.norm(a - b) / (np.linalg.norm(a) + np.linalg.norm(b) + size_of)
                       for a, b in combinations(found, 2)), default=0.0)  # fmt: skip
            if far > 1e-6:
                trial.note("F-unique", t=t, x_k=x, l_k=l, solutions=found)
    for finding in trial.violated("F-mlcp"):
        w = finding.witness
        p = float(w.get("t", 0.0)), np.array(w.get("x", trial.x0)), np.array(w.get("l", np.zeros(size)))
        own = at(*p)
        W = h * m.gamma * own["C"] @ np.linalg.solve(matrix(*p), own["B"]) + own["D"]
        rows = [list(m.multiplier_names).index(name) for name in w.get("rows", [])]
        minor = np.linalg.det(W[np.ix_(rows, rows)]) if rows else -1.0
        trial.witness("F-mlcp", bool(np.linalg.eigvalsh(W + W.T)[0] < 0 and minor < 1e-12 * abs(W).max() ** len(rows)),
                      witness=str(dict(w)), W=W)  # fmt: skip
    for finding in trial.violated("F-W"):
        w = finding.witness
        if "det > 0" not in w or len(w["names"]) != 1 + n + size:
            trial.witness("F-W", None)
            continue
        plus, minus = (np.linalg.det(matrix(v[0], np.array(v[1 : 1 + n]), np.array(v[1 + n :]))) for v in
                       (w["det > 0"], w["det < 0"]))  # fmt: skip
        trial.witness("F-W", bool(plus > 0 > minus), witness=str(dict(w)))
    for finding in trial.violated("F-step"):
        w, s = finding.witness, finding.value.get("h* at the points", finding.value.get("h*"))
        v = w.get("null vector at h*")
        if v is None or s is None:
            trial.witness("F-step", None)
            continue
        W = matrix(float(w.get("t", 0)), np.array(w.get("x", trial.x0)), np.array(w.get("l", np.zeros(size))), s)
        off = np.linalg.norm(W @ np.array(v)) / (np.linalg.norm(W) + np.linalg.norm(M))
        trial.witness("F-step", bool(off < 1e-6 and s <= h * (1 + 1e-9)), witness=str(dict(w)), off=off)
    for finding in trial.violated("F-unique"):
        w = finding.witness
        trial.witness("F-unique", None if "other x" not in w else _both(trial, w), witness=str(dict(w)))


def _into(trial: Trial, l: Array) -> Array:
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
            out[rows] = part * min(1.0, float(block.upper[0]) / (np.linalg.norm(part) + 1e-300))
        elif block.kind == "cone":
            part[0] = np.linalg.norm(part[1:]) * (1 + trial.rng.random())
        else:
            out[rows] = 0.0 if (block.K <= 0).all() else part
        start = rows.stop
    return out


def _solutions(m: Any, t: float, x: Array, l: Array, own: dict[str, Array], W: Array) -> list[Array]:
    """All next states of one affine step, index set by index set."""
    h, n, size = float(m.step), len(x), m.lam.numel()
    f = ca.Function("f", [m.t, m.x], [m.f])
    g, y = (ca.Function("e", [m.t, m.x, m.lam], [e]) for e in (m.g, m.h))
    zero, none, M = np.zeros(n), np.zeros(size), numbers(m.M)
    old = np.array(f(t, x)).ravel() * (1 - m.theta) + np.array(g(t, x, l)).ravel() * (1 - m.gamma)
    new = np.array(f(t + h, zero)).ravel() * m.theta + np.array(g(t + h, zero, none)).ravel() * m.gamma
    r, y0 = M @ x + h * (old + new), np.array(y(t + h, zero, none)).ravel()
    lower, upper = numbers(m.law.lower).ravel(), numbers(m.law.upper).ravel()
    out: list[Array] = []
    for sides in product("lfu", repeat=size):
        if any((s == "l" and lower[i] == -np.inf) or (s == "u" and upper[i] == np.inf) for i, s in enumerate(sides)):
            continue
        S = np.zeros((n + size, n + size))
        S[:n, :n], S[:n, n:] = W, -h * m.gamma * own["B"]
        right = np.r_[r, np.zeros(size)]
        for i, s in enumerate(sides):
            if s == "f":
                S[n + i, :n], S[n + i, n:], right[n + i] = own["C"][i], own["D"][i], -y0[i]
            else:
                S[n + i, n + i], right[n + i] = 1.0, (lower if s == "l" else upper)[i]
        if not np.linalg.cond(S) < 1e9:
            continue
        z = np.linalg.solve(S, right)
        Y, L = own["C"] @ z[:n] + own["D"] @ z[n:] + y0, z[n:]
        e = 1e-10 * (np.abs(Y).max() + abs(own["C"]) @ abs(z[:n]) + abs(own["D"]) @ abs(L))
        d = 1e-10 * (1 + np.abs(L))
        fits = {"l": Y >= -e, "u": Y <= e, "f": (L >= lower - d) & (L <= upper + d)}
        if all(fits[s][i] for i, s in enumerate(sides)):
            out.append(z[:n])
    return out


def _both(trial: Trial, w: Any) -> bool | None:
    """Whether both solutions of a witness solve the step (box laws)."""
    m = trial.model
    if m.gamma != 1 or any(block.kind != "box" for block in m.law.blocks):
        return None
    h, x_k, t = float(w.get("h", m.step)), np.array(w["x_k"]), float(w["t"])
    f = Values([m.t, m.x], m.f)
    g, y = (Values([m.t, m.x, m.lam], e) for e in (m.g, m.h))
    lower, upper, M = numbers(m.law.lower).ravel(), numbers(m.law.upper).ravel(), numbers(m.M)
    good = float(np.linalg.norm(np.array(w["x"]) - np.array(w["other x"]))) > 0
    for t0 in (t,):
        for x, l in ((w["x"], w["l"]), (w["other x"], w["other l"])):
            x, l = np.array(x), np.array(l)
            terms = [M @ x, -M @ x_k, -h * m.theta * f(t0 + h, x), -h * (1 - m.theta) * f(t0, x_k), -h * g(t0 + h, x, l)]
            size = sum(map(abs, terms)) + 1e-12 * abs(x_k).max() + 1e-300
            good &= bool((abs(sum(terms)) <= 1e-8 * size).all())
            Y = y(t0 + h, x, l)
            e = 1e-8 * (1 + abs(Y).max())
            good &= bool((((Y >= -e) | (abs(l - upper) <= 1e-9)) & ((Y <= e) | (abs(l - lower) <= 1e-9))).all())
            good &= bool(((l >= lower - 1e-9) & (l <= upper + 1e-9)).all())
    return good


# ------------------------------------------------------------------------------------------------ Lur'e systems


def lure(trial: Trial) -> None:
    m = trial.model
    B, C, D = numbers(m.B), numbers(m.C), numbers(m.D)
    A, f = Values([m.x], m.A), Values([m.t], m.f)
    for _ in trial.holding("4.1"):
        trial.need("4.1", lambda _: -float(np.linalg.eigvalsh(D + D.T)[0]) / (1e-300 + abs(D).max()), 1e-12, D=D)
    for finding in trial.holding("5.1"):
        if "P" in finding.witness:
            P = np.array(finding.witness["P"], float)
            off = abs(P @ B - C.T).max() / (abs(P) @ abs(B) + abs(C.T)).max()
            if off > MARGIN or np.linalg.eigvalsh(P)[0] <= 0 or abs(P - P.T).max() > 1e-12 * abs(P).max():
                trial.note("5.1", P=P, off=off)
    for finding in trial.holding("5.2"):
        P = np.array(finding.witness.get("P_omega", finding.witness.get("P", np.eye(len(m.names)))), float)
        omega = finding.value["omega"]
        points = trial.points(finding.scope, m.names)
        for x in points:

            def rate(exact: bool, x: Array = x) -> float:
                J = A.jacobian(x, exact=exact)
                if not np.isfinite(J).all():
                    return 0.0
                return (eigh(P @ J + J.T @ P, 2 * P, eigvals_only=True)[-1] - omega) / (1 + abs(omega) + np.linalg.norm(J))

            trial.need("5.2", rate, 1e-6, x=x, omega=omega, P=P)
        for a, b in trial.pairs(points):

            def parting(exact: bool, a: Array = a, b: Array = b) -> float:
                d, u, v = a - b, A(a, exact=exact), A(b, exact=exact)
                size = np.linalg.norm(P) * np.linalg.norm(d) * (np.linalg.norm(u) + np.linalg.norm(v)) * (0 if exact else 1e-12)
                return above(float((u - v) @ P @ d) - float(size), omega * float(d @ P @ d), 1e-9 * float(d @ P @ d) + 1e-300)

            trial.need("5.2", parting, 1e-6, a=a, b=b, omega=omega, P=P)
        for a, b in pairwise(points):
            if (size := jump(A, a, b)) > 1e-2:
                trial.note("5.2", jump=size, a=a, b=b)
    for _ in trial.holding("7.1"):
        rest = [np.abs(A(np.zeros(len(m.names)), exact=False)).max(), *(np.abs(f(t)).max() for t in trial.times(None, 20))]
        if max(rest) > 1e-12:
            trial.note("7.1", rest=max(rest))
        if m.law is not None and not all(_has_0(block) for block in m.law.blocks):
            trial.note("7.1", law="0 is not in K")
    for name, finding in ((id, item) for id in ("4.1", "5.1", "5.2", "5.4a", "7.1") for item in trial.violated(id)):
        trial.witness(name, _lure_witness(trial, name, finding, A, f), witness=str(dict(finding.witness)))
    for item in trial.follows("contraction"):
        P = np.array(trial.report["5.2"].witness.get("P_omega", np.eye(len(m.names))), float)
        _contracts(trial, item, "omega", P)


def _has_0(block: Any) -> bool:
    if block.kind == "box":
        return bool((numbers(block.lower) <= 0).all() and (numbers(block.upper) >= 0).all())
    return block.kind != "polyhedron" or bool((block.K <= 0).all())


def _lure_witness(trial: Trial, id: str, finding: Any, A: Values, f: Values) -> bool | None:
    m, w = trial.model, finding.witness
    B, C, D = numbers(m.B), numbers(m.C), numbers(m.D)
    CB, tiny = C @ B, 1e-9
    if id == "4.1":
        v = np.array(w["v"])
        return bool(v @ D @ v < 0)
    if id == "5.1":
        tests = []
        if "v with C B v = 0" in w:
            v = np.array(w["v with C B v = 0"])
            tests.append(np.abs(CB @ v).max() <= tiny * (abs(C) @ abs(B) @ abs(v)).max() and np.abs(B @ v).max() > 0)
        if "v" in w:
            tests.append(np.array(w["v"]) @ CB @ np.array(w["v"]) < 0)
        if "skew part" in w:
            tests.append(abs(CB - CB.T).max() > 0)
        if "v with B v = 0" in w:
            v = np.array(w["v with B v = 0"])
            tests.append(np.abs(B @ v).max() <= tiny * (abs(B) @ abs(v)).max() and np.abs(C.T @ v).max() > 0)
        return all(map(bool, tests)) if tests else None
    if id == "5.2" and "A on one side" in w:
        x = np.array(w["x"])
        s = 1e-6 * (1 + np.abs(x).max())
        seen = [A(x + s * d) for d in trial.rng.normal(size=(200, len(x)))]
        return all(min(np.abs(u - np.array(w[k])).max() for u in seen) < 1e-2 * (1 + np.abs(np.array(w[k])).max())
                   for k in ("A on one side", "A on the other"))  # fmt: skip
    if id == "5.4a" and "w" in w:
        v = np.array(w["w"])
        return bool(np.abs(C.T @ v).max() <= tiny * abs(C).max() and np.abs((D + D.T) @ v).max() <= tiny * (1 + abs(D).max()))
    if id == "7.1" and w.get("part") == "f = 0" and "t" in w:
        return bool(np.abs(f(float(w["t"]))).max() > 0)
    return None


# ------------------------------------------------------------------------------------------------ inclusions


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


def inclusion(trial: Trial) -> None:
    m, rng, own = trial.model, trial.rng, Inclusion(trial.model)

    def points(finding: Any) -> list[Array]:
        inside = [own.pulled(x, trial.x0) for x in trial.points(finding.scope, m.names)]
        return [x for x in inside if own.inside(x) and np.isfinite(own.velocity(x, rng)).all()]

    for finding in trial.holding("M-A2"):
        for x in points(finding):
            bound = finding.value["a_1"] + finding.value["a_2"] * float(np.linalg.norm(x))
            trial.need("M-A2", lambda exact, x=x, b=bound: above(float(np.linalg.norm(own.velocity(x, rng, exact))), b, 1e-9),
                       x=x, value=dict(finding.value))  # fmt: skip
    for finding in trial.holding("M-A3"):
        for x in points(finding):
            bound = -finding.value["alpha"] * float(x @ x) + finding.value["beta"]

            def inward(exact: bool, x: Array = x, bound: float = bound) -> float:
                v = own.velocity(x, rng, exact)
                size = float(np.linalg.norm(x) * np.linalg.norm(v)) + float(x @ x)  # x is in C to rounding
                return above(float(x @ own.projected(x, v)), bound, 1e-2 * size)

            trial.need("M-A3", inward, x=x, value=dict(finding.value))
    for id, sign in (("M-24", 1.0), ("M-T", -1.0)):
        for finding in trial.holding(id):
            L = finding.value["L"] if id == "M-24" else 0.0
            of = own.velocity if id == "M-24" else own.operator
            for a, b in trial.pairs(points(finding)):

                def parting(exact: bool, a: Array = a, b: Array = b, of: Any = of, L: float = L, sign: float = sign) -> float:
                    d, u, v = a - b, of(a, rng, exact), of(b, rng, exact)
                    size = float(np.linalg.norm(d) * (np.linalg.norm(u) + np.linalg.norm(v))) * (0 if exact else 1e-12)
                    return above(sign * float((u - v) @ d) - size, L * float(d @ d), 1e-9 * float(d @ d) + 1e-300)

                trial.need(id, parting, 1e-6, a=a, b=b, value=dict(finding.value))
    for finding in trial.holding("M-C"):
        for a, b in trial.pairs(points(finding)):
            if not own.inside((a + b) / 2, 1e-8):
                trial.note("M-C", a=a, b=b)
    for finding in trial.holding("M-A1"):
        some = points(finding)
        for a, b in pairwise(some):
            if np.isfinite(own.f(a)).all() and np.isfinite(own.f(b)).all() and (size := jump(own.f, a, b)) > 1e-2:
                trial.note("M-A1", jump=size, a=a, b=b)
    for id in ("M-T", "M-A1", "M-A2", "M-A3"):
        for finding in trial.violated(id):
            trial.witness(id, _inclusion_witness(trial, own, id, finding), witness=str(dict(finding.witness)), how=finding.how)
    for item in (*trial.follows("contraction"), *trial.follows("stability")):
        _contracts(trial, item, "L", np.eye(own.n))
    for item in trial.follows("bounded"):
        _bounded(trial, item)


def _inclusion_witness(trial: Trial, own: Inclusion, id: str, finding: Any) -> bool | None:
    w, rng = finding.witness, trial.rng
    if id == "M-T" and "vector" in w and "x" in w and not isinstance(w["x"], str):
        x, v = np.array(w["x"]), np.array(w["vector"])
        s = 1e-5 * (1 + np.abs(x).max())
        return bool((own.operator(x + s * v, rng, True) - own.operator(x - s * v, rng, True)) @ v < 0)
    if id == "M-A1" and "below" in w:
        x = np.array(w["x"])
        s = 1e-6 * (1 + np.abs(x).max())
        seen = [own.f(x + s * d) for d in rng.normal(size=(200, len(x)))]
        return all(min(np.abs(u - np.array(w[k])).max() for u in seen) < 1e-2 * (1 + np.abs(np.array(w[k])).max())
                   for k in ("below", "above"))  # fmt: skip
    if "direction" in w:
        d = np.array(w["direction"])
        starts = [np.array(w["from"])] if "from" in w else [trial.x0, np.zeros(own.n)]
        seen = [_along(id, own, [start + s * d for s in (1e2, 1e3, 1e4)], rng) for start in starts]
        return True if True in seen else False if "from" in w or False in seen else None
    return None


def _along(id: str, own: Inclusion, way: Sequence[Array], rng: Any) -> bool | None:
    """Whether the hypothesis is seen to fail along a ray; None where the ray leaves C."""
    if not all(own.inside(x, 1e-9) for x in way):
        return None
    with suppress(KeyError, decimal.DecimalException):
        if id == "M-A2":
            parts = [float(np.linalg.norm(own.velocity(x, rng, True)) / np.linalg.norm(x)) for x in way]
            return bool(parts[2] > 1.05 * parts[0]) or not np.isfinite(parts).all()
        if id == "M-A3":
            parts = [float(x @ own.velocity(x, rng, True) / (x @ x)) for x in way]
            return bool(parts[2] > -1e-3 * (1 + abs(parts[0])) or parts[2] > 0.5 * parts[0])
    return None


# ------------------------------------------------------------------------------------------------ runs


def _run(trial: Trial, start: Array, step: float, t_end: float) -> Any:
    other = copy(trial.model)
    for name, value in {"x0": ca.SX(ca.DM(start)), "exact": None, "step": step, "t_end": t_end, "steps": None}.items():
        if hasattr(other, name):
            object.__setattr__(other, name, value)
    return simulate(other)


def _start(trial: Trial, item: Any) -> Array:
    """A start inside the scope, near or far."""
    states = {} if item.scope is None else item.scope.states
    other = trial.x0 + trial.rng.normal(size=len(trial.x0)) * trial.rng.choice([0.01, 1.0])
    for i, name in enumerate(trial.model.names):
        if name in states:
            other[i] = np.clip(other[i], *states[name])
    return Inclusion(trial.model).pulled(other, trial.x0) if trial.name == "inclusion" else other


def _contracts(trial: Trial, item: Any, key: str, P: Array) -> None:
    """|x - y|_P <= e^{rate t} |x_0 - y_0|_P for two runs, as long as both are in the box; again with a quarter of the step."""
    rate, m = item.value[key], trial.model
    other, t_end = _start(trial, item), min(float(m.t_end), 1.0)
    if -rate * t_end > 40:  # an implicit step of that length falls by 1 / (1 - h rate) only
        return
    states = {} if item.scope is None else item.scope.states
    worst = []
    for part in (100, 400):
        try:
            runs = [_run(trial, x, t_end / part, t_end) for x in (trial.x0, other)]
        except Exception:  # steps are refused with good reason, and others are looked for elsewhere
            return
        a, b = (run.x for run in runs)
        d = np.sqrt(np.einsum("ki,ij,kj->k", a - b, P, a - b))
        stay = np.ones(len(a), bool)
        for name, (low, high) in states.items():
            i = m.names.index(name)
            stay &= (a[:, i] >= low) & (a[:, i] <= high) & (b[:, i] >= low) & (b[:, i] <= high)
        stay = np.cumprod(stay).astype(bool)
        bound = np.exp(np.minimum(rate * runs[0].t, 600.0)) * d[0]
        excess = ((d - bound) / (bound + 1e-3 * d[0] + 1e-300))[stay]
        worst.append(float(excess.max(initial=0.0)))
    if min(worst) > 0.03 and worst[1] > 0.5 * worst[0]:  # One of them alone is chatter about a steep place.
        trial.note(item.name, other=other, rate=rate, excess=worst)


def _bounded(trial: Trial, item: Any) -> None:
    m, radius = trial.model, item.value["radius"]
    with suppress(Exception):
        run = _run(trial, trial.x0, float(m.step), float(m.t_end) * 5)
        far = float(np.linalg.norm(run.x, axis=1).max())
        if far > radius * 1.02:
            fine = _run(trial, trial.x0, float(m.step) / 10, float(m.t_end) * 5)
            far = float(np.linalg.norm(fine.x, axis=1).max())
            if far > radius * 1.01:
                trial.note(item.name, radius=radius, reached=far)


def stays(trial: Trial) -> None:
    """A run is in the box until the printed time."""
    for item in trial.report.consequences:
        if item.until is None or item.scope is None or trial.model.step is None or not item.until > 0:
            continue
        trial.held.add("until")
        t_end = min(float(item.until), float(trial.model.t_end or 1.0))
        with suppress(Exception):
            run = simulate(trial.model, t_end=t_end, step=t_end / 200)
            for name, (low, high) in item.scope.states.items():
                x = run.x[:, trial.model.names.index(name)]
                slack = 1e-6 * (high - low)
                if x.min() < low - slack or x.max() > high + slack:
                    trial.note("until", until=item.until, state=name, box=(low, high), seen=(x.min(), x.max()))
        return


# ------------------------------------------------------------------------------------------------ all

ORACLES: dict[str, Callable[[Trial], None]] = {
    "sweeping": sweeping, "oscillator": oscillator, "first_order": first_order, "lure": lure, "inclusion": inclusion,
}  # fmt: skip


def judged(name: str, seed: int) -> dict[str, Any]:
    """What was tested on one model, the contradictions, or the crash (of the checker, or of this file)."""
    row: dict[str, Any] = {"class": name, "seed": seed, "held": [], "refuted": [], "untested": [], "contradictions": []}
    started = time.perf_counter()
    try:
        report = check(draw(name, seed), runs=[])
    except Exception as error:  # whatever it is, the others are looked at
        return {**row, "seconds": time.perf_counter() - started, "crash": f"{type(error).__name__}: {error}"}
    row["seconds"] = round(time.perf_counter() - started, 3)
    trial = Trial(name, seed, report, np.random.default_rng([seed, 77]))
    try:
        with np.errstate(all="ignore"):
            ORACLES[name](trial)
            stays(trial)
    except Exception as error:
        row["fault"] = f"{type(error).__name__}: {error} (line {_line(error)})"
    kept = {"held": sorted(trial.held), "refuted": sorted(trial.refuted), "untested": sorted(trial.untested)}
    return {**row, **kept, "contradictions": trial.bad}


def _line(error: BaseException) -> int:
    lines, trace = [], error.__traceback__
    while trace is not None:
        lines += [trace.tb_lineno] if trace.tb_frame.f_code.co_filename == __file__ else []
        trace = trace.tb_next
    return lines[-1]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Counts class by class, then each contradiction, crash and fault of the oracle."""
    titles = ("models", "holds", "violated", "not tested", "contradictions", "crashes")
    lines = [f"{'class':12}" + "".join(f"{title:>16}" for title in titles)]
    for name in dict.fromkeys(row["class"] for row in rows):
        own = [row for row in rows if row["class"] == name]
        counts = [len(own), *(sum(len(row[key]) for row in own) for key in ("held", "refuted", "untested", "contradictions"))]
        lines.append(f"{name:12}" + "".join(f"{count:16d}" for count in [*counts, sum("crash" in row for row in own)]))
    for row in rows:
        where = f"{row['class']}:{row['seed']}"
        lines += [f"{where} {item['id']}: { ({k: v for k, v in item.items() if k != 'id'}) }" for item in row["contradictions"]]
        lines += [f"{where} {key}: {row[key]}" for key in ("crash", "fault") if key in row]
    slowest = max(rows, key=lambda row: row["seconds"])
    lines.append(f"the slowest check: {slowest['class']}:{slowest['seed']}, {slowest['seconds']:.1f} s")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Test the models asked for, print the table; 1 where something contradicts."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.oracle", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--class", dest="classes", action="append", choices=list(ORACLES), help="one class; may be repeated")
    parser.add_argument("--models", type=int, default=100, help="models of each class")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--json", type=Path, help="where everything goes")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    seeds = range(given.first, given.first + given.models)
    rows = []
    for name, seed in product(given.classes or ORACLES, seeds):
        rows.append(judged(name, seed))
        if rows[-1]["contradictions"] or "crash" in rows[-1]:
            print(f"{name}:{seed}", file=sys.stderr, flush=True)
    print(table(rows))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1, default=str))
    return int(any(row["contradictions"] or "crash" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
