"""An event-driven run judged by the inclusion itself, at random points of its polynomials."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from event_models import Scene
from scipy.linalg import null_space
from scipy.optimize import lsq_linear

from nsmodel import MonotoneInclusion, Trajectory

TINY = 1e-300


class Missed(NamedTuple):
    """What a run misses, in units of the sizes of its states, rows and multipliers.

    Attributes:
        rate: the integral of |x' - f - g| over the run, by its mean at random points.
        apart: the sum of the jumps of x between pieces, and of x(0) - x0.
        rows: how far rows are from their sign, or held rows from 0.
        multipliers: how far l is from its box, from its end where y is not 0, or from what x' asks of it where no y has it.
    """

    rate: float
    apart: float
    rows: float
    multipliers: float


def polynomial(c: np.ndarray, s: float) -> tuple[np.ndarray, np.ndarray]:
    """Values and slopes of rows of coefficients (n, p + 1)."""
    powers = s ** np.arange(c.shape[1])
    return c @ powers, c[:, 1:] @ (np.arange(1, c.shape[1]) * powers[:-1])


def missed(scene: Scene, run: Trajectory, rng: np.random.Generator, points: int = 3) -> Missed:
    """Judge a run of a scene, as declared in other words."""
    arrays = run.arrays
    of = ca.Function(
        "of",
        [scene.t, scene.x, scene.l],
        [
            ca.densify(scene.rate),
            ca.densify(scene.y),
            ca.jacobian(scene.rate, scene.l),
            ca.jacobian(scene.y, scene.x),
            ca.jacobian(scene.y, scene.l),
        ],
    )
    starts, units, c_x, c_l = (arrays[f"piece_{name}"] for name in ("start", "unit", "x", "multipliers"))
    ends, T = np.append(starts[1:], np.inf), run.t[-1]
    x0 = np.array(ca.DM(scene.model.x0 if hasattr(scene.model, "x0") else scene.model.q0)).ravel()
    if c_x.shape[1] > x0.size:
        x0 = np.r_[x0, np.array(ca.DM(scene.model.v0)).ravel()]
    free = isinstance(scene.model, MonotoneInclusion)  # Its multipliers are not looked at.
    found = []
    for k in range(len(starts)):
        end = min(ends[k], T)
        if end <= starts[k]:
            continue
        for s in np.r_[rng.uniform(0, 1, points), 0.0, 1.0]:
            local = s * (end - starts[k]) / units[k]
            x, slope = polynomial(c_x[k], local)
            l = None if free else polynomial(c_l[k], local)[0]
            found.append((k, s, starts[k] + s * (end - starts[k]), x, slope / units[k], l, end - starts[k]))
    sizes_x = np.max([np.abs(x) for _, _, _, x, *_ in found], axis=0)
    sizes_x = np.maximum(sizes_x, 1e-3 * sizes_x.max()) + TINY  # of states that rest at 0
    rows = [[np.array(v) for v in of(t, x, np.zeros(scene.l.numel()) if l is None else l)] for _, _, t, x, _, l, _ in found]
    if not free:  # a state that rests is rounding of what pushes it
        pushed = [np.abs(G) @ np.abs(l) * length for (*_, l, length), (_, _, G, *_) in zip(found, rows, strict=True)]
        sizes_x = np.maximum(sizes_x, 1e-3 * np.max(pushed, axis=0))
    terms = [
        np.abs(y).ravel() + np.abs(C) @ sizes_x + np.abs(D) @ (np.zeros(D.shape[1]) if free else np.abs(l))
        for (*_, l, _), (_, y, _, C, D) in zip(found, rows, strict=True)
    ]
    sizes_y = np.max(terms, axis=0, initial=TINY)
    sizes_l = np.maximum(1.0, np.max([np.abs(l) for *_, l, _ in found], axis=0)) if not free else np.empty(0)
    rate, off, out = np.zeros(len(starts)), 0.0, 0.0
    for (k, s, _, _, slope, l, length), (f, y, G, _, D) in zip(found, rows, strict=True):
        y, miss = y.ravel() / sizes_y, slope - f.ravel()
        miss, one, two = _law(scene, miss, y, G) if free else (miss, *_signs(scene, y, l, sizes_l))
        if 0 < s < 1:
            if not free:
                lacks = _lacking(scene, miss, l, G, D, sizes_x)
                miss, two = miss - G @ lacks, max(two, np.max(np.abs(lacks) / sizes_l))
            rate[k] += np.max(np.abs(miss) / sizes_x) * length / points
        off, out = max(off, one), max(out, two)
    jumps = [_start(scene, of, x0, c_x[0][:, 0], arrays["piece_impulse"][0])]
    for k in range(1, len(starts)):
        jumps.append(np.abs(c_x[k][:, 0] - polynomial(c_x[k - 1], (starts[k] - starts[k - 1]) / units[k - 1])[0]))
    return Missed(float(rate.sum()), float((np.array(jumps) / sizes_x).max(axis=1).sum()), off, out)


def _start(scene: Scene, of: ca.Function, x0: np.ndarray, x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """How far x is from x0 + g_l p with an impulse p in the recession cone of the box."""
    if not p.any():
        return np.abs(x - x0)
    outside = (np.isfinite(scene.lower) & (p < -1e-12)) | (np.isfinite(scene.upper) & (p > 1e-12))
    return np.abs(x - x0 - np.array(of(0.0, x0, np.zeros(p.size))[2]) @ p) + outside.any()


def _signs(scene: Scene, y: np.ndarray, l: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """-y in N_K(l): the least move of (y, l) that makes it so, in units; each row may move either."""
    off, out = 0.0, 0.0
    for a, b, v, u, size in zip(scene.lower, scene.upper, y, l, sizes, strict=True):
        outside = max(a - u, u - b, 0.0) / size
        inside = max(min(u - a, b - u), 0.0) / size  # y may have any sign at an end, as far as it is allowed
        wrong = abs(v) if a < u < b else max(-v, 0) if u <= a < b else max(v, 0) if u >= b > a else 0.0
        if 0 < inside < 1e-5 and wrong > inside:  # near an end: l may be there
            near = u - a <= b - u
            wrong = min(wrong, max(inside, max(-v, 0) if near else max(v, 0)))
        off, out = max(off, wrong), max(out, outside)
    return off, out


def _lacking(scene: Scene, miss: np.ndarray, l: np.ndarray, G: np.ndarray, D: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """What l within its box lacks, where no y tells of it: x' alone misses it."""
    inside = (scene.lower < l) & (l < scene.upper)
    unseen = np.eye(l.size)[:, inside] @ null_space(D[:, inside])
    return unseen @ np.linalg.lstsq(G @ unseen / sizes[:, None], miss / sizes)[0]


def _law(scene: Scene, rest: np.ndarray, y: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The multipliers that fit x' best among those that the law has for these y."""
    near = np.abs(y) < 1e-6
    low = np.where(near | (y > 0), scene.lower, scene.upper)
    high = np.where(near | (y < 0), scene.upper, scene.lower)
    open_ = np.isfinite(scene.upper) | near | (y > 0)
    off = float(np.abs(y[~open_]).max(initial=0.0))
    low, high = np.where(open_, low, 0.0), np.where(open_, high, 0.0)
    fixed = high <= low
    rest = rest - G @ np.where(fixed, low, 0.0)
    if (~fixed).any():
        found = lsq_linear(G[:, ~fixed], rest, (low[~fixed], high[~fixed]), tol=1e-14, lsmr_tol=1e-14, method="bvls")
        rest = rest - G[:, ~fixed] @ found.x
    return rest, off, 0.0
