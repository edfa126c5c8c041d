"""A run judged in NumPy, one step after the other, by the paper's formulas and the model's own expressions.

Nothing here comes from the solvers or their certificate: the expressions of the *model* are evaluated at the rows of the run,
and the scheme is written down once more. Each judge returns {what: largest misfit beside what is allowed}, <= 1 if right.
What is allowed is stated here, before any run:

- an equation: EQUATION times the sizes of the terms that move in the step, and the rounding of the positions;
- a law -y ∈ N_K(l): LAW times the sizes of the terms of y and of l;
- a projection: the distance to the exact one, bounded by the duality gap <l, y>, at most PROJECTION times the step's motion;
- a minimum: no other velocity among the probes may be better by more than rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.model.base import Model
from nsmodel.model.first_order import FirstOrderSystem
from nsmodel.model.inclusion import MonotoneInclusion
from nsmodel.model.laws import Block, Law
from nsmodel.model.lure import LureSystem
from nsmodel.model.oscillator import FrictionOscillator
from nsmodel.model.sweeping import SweepingProcess
from nsmodel.model.units import potential
from nsmodel.trajectory import Trajectory

EQUATION = LAW = 1e-8
PROJECTION = 1e-6
ROUNDING = 64 * np.finfo(float).eps
LOST = 1e-290
PROBES = (1e-6, 1e-3, 1.0)  # lengths of the probes, beside the velocity

Misfits = dict[str, float]


@np.errstate(all="ignore")  # a run that diverges is judged like any other
def by_formulas(model: Model, run: Trajectory) -> Misfits:
    """The misfits of all steps of a run of the bound ``model``; nothing for a run without steps."""
    if len(run.t) < 3:
        return {}
    if isinstance(model, SweepingProcess):
        return _sweeping(model, run)
    if isinstance(model, FrictionOscillator):
        return _oscillator(model, run)
    if isinstance(model, MonotoneInclusion):
        return _inclusion(model, run)
    return _first_order(model, run) if isinstance(model, FirstOrderSystem) else _lure(model, run)


def _evaluated(symbols: Sequence[ca.SX], expressions: Sequence[ca.SX], *columns: np.ndarray) -> list[np.ndarray]:
    """Each expression (r, c) at N rows as an array (N, r, c); columns (N, k) in the order of the symbols."""
    f = ca.Function("f", list(symbols), [ca.densify(ca.SX(e)) for e in expressions])
    out = f.map(len(columns[0])).call([ca.DM(c.reshape(len(columns[0]), -1).T) for c in columns])
    return [
        np.array(v).reshape(e.shape[0], len(columns[0]), e.shape[1]).transpose(1, 0, 2)
        for v, e in zip(out, (ca.SX(e) for e in expressions), strict=True)
    ]


def _apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kj->ki", matrices, vectors)


def _worst(misfit: np.ndarray, allowed: np.ndarray) -> float:
    """Largest misfit/allowed, 0/0 = 0; what is not a number is infinitely wrong."""
    if not misfit.size:
        return 0.0
    ratio = _over(misfit, allowed)
    return float(np.max(np.where(np.isnan(ratio), np.inf, ratio)))


def _over(misfit: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """misfit/allowed; what is lost among the smallest doubles counts as 0."""
    return np.where(misfit <= LOST, 0.0, misfit / allowed)


# -- sweeping processes ------------------------------------------------------------------------------------------------


def _sweeping(model: SweepingProcess, run: Trajectory) -> Misfits:
    """q+ = P_Qt(q + h f): q+ - q - h f = G'm with m >= 0, q+ in Qt; the distance to the projection is sqrt(<m, y>) at most."""
    t, q, new, h, m = run.t[:-1], run.x[:-1], run.x[1:], run.step[1:, None], run.multipliers[1:]
    f = _mean(model, t, q, h) if model.mean_forcing else _evaluated([model.t, model.q], [model.f], t, q)[0][:, :, 0]
    g, G = _evaluated([model.t, model.q], [model.g, ca.jacobian(model.g, model.q)], t + h[:, 0], q)
    g, moved = g[:, :, 0], new - q
    push = np.einsum("kij,ki->kj", G, m)
    size = np.abs(moved) + h * np.abs(f) + np.einsum("kij,ki->kj", np.abs(G), np.abs(m))
    place = ROUNDING * (np.abs(q) + np.abs(new))
    y = g + _apply(G, moved)
    unseen = ROUNDING * (np.abs(g) + _apply(np.abs(G), np.abs(q) + np.abs(new)))
    reach = np.linalg.norm(moved, axis=1) + h[:, 0] * np.linalg.norm(f, axis=1)
    gap = (np.maximum(m, 0) * np.maximum(y, 0)).sum(axis=1)
    return {
        "equation": _worst(np.abs(moved - h * f - push), EQUATION * size + place),
        "no pull": _worst(np.maximum(-m, 0), LAW * np.abs(m).max(axis=1, initial=0.0)[:, None]),
        "no overlap": _worst(np.maximum(-y, 0), LAW * _apply(np.abs(G), np.abs(moved)) + unseen),
        "projection": _worst(gap, (PROJECTION * reach) ** 2 + (np.abs(m) * unseen).sum(axis=1)),
    }


def _mean(model: SweepingProcess, t: np.ndarray, q: np.ndarray, h: np.ndarray) -> np.ndarray:
    nodes, weights = np.polynomial.legendre.leggauss(8)
    times = (t + h[:, 0] * (1 + x) / 2 for x in nodes)
    values = [_evaluated([model.t, model.q], [model.f], s, q)[0][:, :, 0] for s in times]
    return sum(w / 2 * value for w, value in zip(weights, values, strict=True))


# -- oscillators -------------------------------------------------------------------------------------------------------


def _oscillator(model: FrictionOscillator, run: Trajectory) -> Misfits:
    """v+ minimises J(v) = |v - w|^2/2 + h (Phi(v) + <v, M v>/2) + g(x + h v), M symmetric, w the last velocity.

    Of a matrix M the skew part enters as the constant force M v+ that it is at the answer.
    """
    first = 1 if model.x1 is not None else 0
    x, w, v, h = run.x[first:-1], run.v[first:-1], run.v[first + 1 :], run.step[first + 1 :]
    if first and len(h):
        w = np.concatenate([(run.x[1:2] - run.x[:1]) / h[0], run.v[2:-1]])
    V = ca.SX.sym("V", x.shape[1])
    phi = sum((ca.substitute(e.theta, model.s, ca.norm_2(e.H @ V)) for e in model.elements), ca.SX(0))
    M = np.zeros((x.shape[1],) * 2) if model.damping is None else np.array(ca.DM(model.damping))
    even, odd = (M + M.T) / 2, (M - M.T) / 2
    c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())

    def terms(V_: np.ndarray) -> np.ndarray:
        place = x + h[:, None] * V_
        friction, g, rows = _evaluated([V, model.x], [phi, model.potential, c], V_, place)
        friction = np.where((V_ == 0).all(axis=1), 0.0, friction[:, 0, 0]) - at_rest
        linear = h * (0.5 * np.einsum("ki,ij,kj->k", V_, even, V_) + np.einsum("ki,ij,kj->k", V_, odd, v))
        seen = np.where((rows[:, :, 0] < 0).any(axis=1), np.inf, g[:, 0, 0])
        return np.stack([0.5 * ((V_ - w) ** 2).sum(axis=1), h * friction, linear, seen])

    at_rest = sum((float(ca.substitute(e.theta, model.s, 0)) for e in model.elements), 0.0)
    J = terms(v)
    J[3] = _evaluated([model.x], [model.potential], x + h[:, None] * v)[0][:, 0, 0]  # constraints may be met up to rounding
    speed = np.maximum(np.linalg.norm(v, axis=1), np.linalg.norm(w, axis=1))[:, None]
    probes = [np.zeros_like(v), w, *(v + s * size * speed * e for e in np.eye(v.shape[1]) for size in PROBES for s in (1, -1))]
    worst = 0.0
    for probe in probes:
        other = terms(probe)
        # J is strongly convex: another velocity costs |probe - v|^2/2 more.
        better = J.sum(axis=0) - other.sum(axis=0) + 0.5 * (1 - 1e-6) * ((probe - v) ** 2).sum(axis=1)
        size = np.abs(J).sum(axis=0) + np.where(np.isfinite(other), np.abs(other), 0).sum(axis=0)
        worst = max(worst, _worst(np.maximum(better, 0), ROUNDING * size))
    moved = np.abs(run.x[first + 1 :] - x - h[:, None] * v)
    place = EQUATION * h[:, None] * np.abs(v) + ROUNDING * (np.abs(x) + np.abs(run.x[first + 1 :]))
    return {"equation": _worst(moved, place), "minimum": worst}


# -- first-order systems -----------------------------------------------------------------------------------------------


def _first_order(model: FirstOrderSystem, run: Trajectory) -> Misfits:
    """M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), r = g(t, x, l), y = h(t, x, l)."""
    l = run.multipliers if model.law.size else np.zeros((len(run.t), 0))
    f, r = _evaluated([model.t, model.x, model.lam], [model.f, model.g], run.t, run.x, np.nan_to_num(l))
    equation, known = _theta(model, run, np.array(ca.DM(model.M)), f[:, :, 0], r[:, :, 0])
    return {"equation": equation, **({} if not model.law.size else _outputs(model, run, model.h, model.lam, model.law, known))}


def _lure(model: LureSystem, run: Trajectory) -> Misfits:
    """The same with M = I, f = A(x) + f(t), r = B l, y = C x + D l."""
    B = np.array(ca.DM(model.B))
    f = _evaluated([model.t, model.x], [model.A + model.f], run.t, run.x)[0][:, :, 0]
    l = ca.SX.sym("l", B.shape[1])
    r = np.nan_to_num(run.multipliers) @ B.T
    y = model.C @ model.x + model.D @ l
    equation, known = _theta(model, run, np.eye(B.shape[0]), f, r)
    law = _outputs(model, run, y, l, model.law, known) if model.law is not None else _potential(model, run, y, l)
    return {"equation": equation, **law}


def _theta(
    model: FirstOrderSystem | LureSystem, run: Trajectory, M: np.ndarray, f: np.ndarray, r: np.ndarray
) -> tuple[float, np.ndarray]:
    """The misfit of the equation, and how well each state is known (N, n): to the rounding of the terms that make it."""
    th, ga = model.theta, model.gamma
    first = 1 if ga < 1 else 0  # r_0 is not a row of the run
    h, x, new = run.step[1:, None], run.x[:-1], run.x[1:]
    terms = (h * th * f[1:], h * (1 - th) * f[:-1], h * ga * r[1:], h * (1 - ga) * r[:-1])
    misfit = np.abs((new - x) @ M.T - sum(terms))
    size = np.abs(new - x) @ np.abs(M).T + sum(np.abs(term) for term in terms)
    slope = _evaluated([model.t, model.x], [_rate_slope(model)], run.t, run.x)[0]
    place = np.abs(x) + np.abs(new) + size @ np.abs(np.linalg.pinv(M)).T
    seen = place @ np.abs(M).T + h * (_apply(np.abs(slope[1:]), place) + _apply(np.abs(slope[:-1]), place))
    return _worst(misfit[first:], (EQUATION * size + ROUNDING * seen)[first:]), ROUNDING * place


def _rate_slope(model: FirstOrderSystem | LureSystem) -> ca.SX:
    return ca.jacobian(model.f if isinstance(model, FirstOrderSystem) else model.A, model.x)


def _outputs(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, law: Law, known: np.ndarray) -> Misfits:
    """-y ∈ N_K(l) with y computed afresh; y's scale is what changes in it during the step, and what is not known of x."""
    given = run.multipliers[1:]
    J = [output, ca.jacobian(output, model.x), ca.jacobian(output, l)]
    y, C, D = _evaluated([model.t, model.x, l], J, run.t[1:], run.x[1:], given)
    y, at = y[:, :, 0], 0
    moves = np.abs(run.x[1:] - run.x[:-1])
    s_y = LAW * (_apply(np.abs(C), moves) + _apply(np.abs(D), np.abs(given))) + _apply(np.abs(C), known)
    worst = 0.0
    for block in law.blocks:
        rows = slice(at, at := at + block.size)
        worst = max(worst, _block(block, given[:, rows], y[:, rows], s_y[:, rows]))
    return {"law": worst}


def _block(block: Block, l: np.ndarray, y: np.ndarray, s_y: np.ndarray) -> float:
    """Least over the points of the law's graph near (l, y) of max(|l - l^|/s_l, |y - y^|/s_y)."""
    lower, upper = (np.array(ca.DM(end)).ravel() for end in (block.lower, block.upper))
    finite = np.concatenate([lower, upper])
    finite = np.abs(finite[np.isfinite(finite)]).max(initial=0.0)
    s_l = LAW * np.maximum(np.abs(l).max(axis=1, keepdims=True), finite)
    if block.kind == "box":
        inside = np.maximum(np.maximum(lower - l, l - upper), 0)
        free = np.maximum(_over(inside, s_l), _over(np.abs(y), s_y))
        low = np.maximum(_over(np.abs(l - lower), s_l), _over(np.maximum(-y, 0), s_y))
        high = np.maximum(_over(np.abs(l - upper), s_l), _over(np.maximum(y, 0), s_y))
        return float(np.max(np.fmin(free, np.fmin(low, high)), initial=0.0))
    size_y, size_l = np.linalg.norm(y, axis=1), np.linalg.norm(l, axis=1)
    allowed_y = s_y.max(axis=1)
    if block.kind == "ball":
        radius = upper[0]
        outside = _over(np.maximum(size_l - radius, 0), s_l[:, 0])
        against = np.linalg.norm(l + radius * y / np.where(size_y > 0, size_y, 1)[:, None], axis=1)
        return float(np.max(np.maximum(outside, np.fmin(_over(size_y, allowed_y), _over(against, s_l[:, 0]))), initial=0.0))
    if block.kind == "cone":
        out_l = _over(np.maximum(np.linalg.norm(l[:, 1:], axis=1) - l[:, 0], 0), s_l[:, 0])
        out_y = _over(np.maximum(np.linalg.norm(y[:, 1:], axis=1) - y[:, 0], 0), allowed_y)
        work = _over(np.abs((l * y).sum(axis=1)), np.maximum(size_l * allowed_y, size_y * s_l[:, 0]))
        return float(np.max(np.maximum(np.maximum(out_l, out_y), work), initial=0.0))
    reach = np.abs(block.K).max(initial=0.0)
    outside = _over(np.maximum(block.K - l @ block.H.T, 0), np.maximum(s_l, LAW * reach))
    # -y ∈ N(l): l minimises <y, .> on the polyhedron, so that <y, l> is its support there.
    from scipy.optimize import linprog

    unit = y / np.where(size_y > 0, size_y, 1)[:, None]
    programmes = (linprog(row, A_ub=-block.H, b_ub=-block.K, bounds=(None, None)) for row in unit)
    best = np.array([found.fun if found.success else -np.inf for found in programmes]) * size_y
    work = _over(np.maximum((l * y).sum(axis=1) - best, 0), (size_l + reach) * allowed_y + size_y * s_l[:, 0])
    return float(np.max(np.maximum(outside.max(axis=1), work), initial=0.0))


def _potential(model: LureSystem, run: Trajectory, output: ca.SX, l: ca.SX) -> Misfits:
    """l ∈ -dPhi(y): Phi(z) >= Phi(y) - <l, z - y> at probes z."""
    given = run.multipliers[1:]
    y = _evaluated([model.t, model.x, l], [output], run.t[1:], run.x[1:], given)[0][:, :, 0]
    size = np.abs(y).max(axis=1, keepdims=True) + np.abs(run.x[1:] - run.x[:-1]).max(axis=1, keepdims=True)
    return {"law": _subgradient(model.phi, model.y, y, -given, size)}


def _subgradient(phi: ca.SX, symbol: ca.SX, y: np.ndarray, slope: np.ndarray, size: np.ndarray) -> float:
    here, worst = _evaluated([symbol], [phi], y)[0][:, 0, 0], 0.0
    probes = [np.zeros_like(y), *(y + s * p * size * e for e in np.eye(y.shape[1]) for p in PROBES for s in (1, -1))]
    for probe in probes:
        there, along = _evaluated([symbol], [phi], probe)[0][:, 0, 0], (slope * (probe - y)).sum(axis=1)
        allowed = ROUNDING * (np.abs(here) + np.where(np.isfinite(there), np.abs(there), 0)) + LAW * np.abs(along)
        worst = max(worst, _worst(np.maximum(here + along - there, 0), allowed))
    return worst


# -- inclusions --------------------------------------------------------------------------------------------------------


def _inclusion(model: MonotoneInclusion, run: Trajectory) -> Misfits:
    """y = x + mu v with v in F(x) - S(x); x+ in C, not farther from y than any other row of the run (by eps at most)."""
    x, new, h, v = run.x[:-1], run.x[1:], run.step[1:, None], run.v[1:]
    size = np.abs(x).max(axis=1, keepdims=True) + h * np.abs(v).max(axis=1, keepdims=True)
    field, S = _evaluated([model.x], [model.field, _signed(model)], x)
    field, S = field[:, :, 0], S[:, :, 0]
    kinks = _evaluated([model.x], [model.sign_arguments], x)[0][:, :, 0] if model.sign_symbols.numel() else np.ones((len(x), 1))
    smooth = (kinks != 0).all(axis=1)[:, None]
    if model.potential_split is not None:
        found = {"selection": _subgradient(potential(model.potential_split), model.x, x, field - v, size)}
    else:
        misfit = np.where(smooth, np.abs(field - S - v), 0.0)
        found = {"selection": _worst(misfit, EQUATION * (np.abs(field) + np.abs(S)))}
    lower, upper = (np.array(ca.DM(b)).ravel() for b in (model.lower, model.upper))
    y, eps = x + h * v, run.tolerance[1:]
    unseen = ROUNDING * (np.abs(x) + h * np.abs(v))
    if not model.constraints and model.tolerances is None:
        return found | {"clip": _worst(np.abs(new - np.clip(y, lower, upper)), EQUATION * np.abs(new - x) + unseen)}
    others = [run.x[k] for k in range(len(run.t))]
    distance = ((new - y) ** 2).sum(axis=1)
    nearest = np.min([((other - y) ** 2).sum(axis=1) for other in others], axis=0)
    allowed = (PROJECTION * np.linalg.norm(new - x, axis=1)) ** 2 + eps.ravel() + ROUNDING * (distance + (unseen**2).sum(axis=1))
    return found | {"nearest": _worst(np.maximum(distance - nearest, 0), allowed)}


def _signed(model: MonotoneInclusion) -> ca.SX:
    """S with sign(u) in place of its elements."""
    if not model.sign_symbols.numel():
        return model.operator
    return ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
