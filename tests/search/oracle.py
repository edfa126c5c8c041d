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
import decimal
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import eigh

from nsmodel import check

from .checked import draw
from .consequences import try_consequences
from .trial import MARGIN, POINTS, Array, Inclusion, Trial, Values, above, hull, into, jump, numbers, slope_at_0

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
    slopes = [(numbers(e.H), slope_at_0(thetas[e.name])) for e in m.elements]
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
    _oscillator_witnesses(trial, g, c, thetas, slopes)


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
            yield t, both[:n], into(trial, both[n:])

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
            if not np.isfinite(parts).all():  # exp has overflown: nothing is said.
                return None
            return bool(parts[2] > -1e-3 * (1 + abs(parts[0])) or parts[2] > 0.5 * parts[0])
    return None


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
            try_consequences(trial)
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
