"""A run judged in NumPy, one step after the other, by the paper's formulas and the model's own expressions.

Nothing here comes from the solvers or their certificate: the expressions of the *model* are evaluated at the rows of the run,
and the scheme is written down once more. Each judge returns {what: largest misfit beside what is allowed}, <= 1 if right.
What is allowed is stated here, before any run: a tolerance times what moves or acts in the step, source terms and single
multipliers included, and ROUNDING times the running error bound of what is evaluated here (`majorant`), its inputs
known to the last digit:

- an equation: EQUATION times its terms, and the rounding of the positions;
- a law -y ∈ N_K(l): LAW times what moves y, what acts on it through the states, and l;
- a projection: the distance to the exact one, bounded by the duality gap <l, y>, at most PROJECTION times the step's motion;
- a minimum: no other velocity among the probes may be better by more than rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.laws import Block, Law
from nsmodel.model.base import Model
from nsmodel.model.units import potential
from nsmodel.proof.graph import applied, column, fold
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


@np.errstate(all="ignore")
def acting(model: Model, run: Trajectory) -> np.ndarray:
    """What acts on each state in each step, whether it moves or not (N, n): the terms that make the state, in its own unit."""
    h, moved = run.step[1:, None], np.abs(run.x[1:] - run.x[:-1])
    if not len(moved):
        return moved
    if isinstance(model, FirstOrderSystem | LureSystem):
        return _theta(model, run)[1].acting
    if isinstance(model, SweepingProcess):
        f, G = _evaluated([model.t, model.q], [model.f, ca.jacobian(model.g, model.q)], run.t[:-1], run.x[:-1])
        return moved + h * np.abs(f[:, :, 0]) + np.einsum("kij,ki->kj", np.abs(G), np.abs(run.multipliers[1:]))
    if isinstance(model, FrictionOscillator):
        (force,) = _evaluated([model.x], [ca.gradient(model.potential, model.x)], run.x[1:])
        return moved + h**2 * np.nan_to_num(np.abs(force[:, :, 0]), posinf=0.0)
    return moved + h * np.abs(run.v[1:])


def _evaluated(symbols: Sequence[ca.SX], expressions: Sequence[ca.SX], *columns: np.ndarray) -> list[np.ndarray]:
    """Each expression (r, c) at N rows as an array (N, r, c); columns (N, k) in the order of the symbols."""
    f = ca.Function("f", list(symbols), [ca.densify(ca.SX(e)) for e in expressions])
    out = f.map(len(columns[0])).call([ca.DM(c.reshape(len(columns[0]), -1).T) for c in columns])
    return [
        np.array(v).reshape(e.shape[0], len(columns[0]), e.shape[1]).transpose(1, 0, 2)
        for v, e in zip(out, (ca.SX(e) for e in expressions), strict=True)
    ]


def majorant(expression: ca.SX) -> ca.SX:
    """The running error bound of evaluating ``expression``, in units of the rounding: the sizes of all its terms.

    Symbols and numbers are known to their last digit; an operation passes on what its arguments are not known to, times its
    slopes, and rounds its result. What cannot be looked into counts as its value alone.
    """

    def passed(op: int, terms: list[tuple[ca.SX, ca.SX]]) -> tuple[ca.SX, ca.SX]:
        fresh = [ca.SX.sym("a") for _ in terms]
        here, old = applied(op, fresh), column(fresh)
        value, *slopes = ca.substitute([here, *(ca.gradient(here, a) for a in fresh)], [old], [column(v for v, _ in terms)])
        return value, ca.fabs(value) + sum((ca.fabs(d) * size for d, (_, size) in zip(slopes, terms, strict=True)), ca.SX(0))

    expression = ca.SX(expression)
    try:
        found = fold(expression, lambda symbol: (symbol, ca.fabs(symbol)), lambda c: (ca.SX(c), ca.SX(abs(c))), passed)
    except ValueError:
        return ca.fabs(expression)
    return ca.reshape(column(size for _, size in found), *expression.shape)


def _apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kj->ki", matrices, vectors)


def _worst(misfit: np.ndarray, allowed: np.ndarray) -> float:
    """Largest misfit/allowed, 0/0 = 0; what is not a number is infinitely wrong."""
    if not misfit.size:
        return 0.0
    ratio = _over(misfit, allowed)
    return float(np.max(np.where(np.isnan(ratio), np.inf, ratio)))


def _known_to(*sizes: np.ndarray) -> np.ndarray:
    """ROUNDING times sizes (N, k, 1); where a slope is infinite (a norm at 0) nothing is allowed."""
    return ROUNDING * sum(np.where(np.isfinite(size), size, 0.0) for size in sizes)[:, :, 0]


def _over(misfit: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """misfit/allowed; what is lost among the smallest doubles counts as 0."""
    return np.where(misfit <= LOST, 0.0, misfit / allowed)


# -- sweeping processes ------------------------------------------------------------------------------------------------


def _sweeping(model: SweepingProcess, run: Trajectory) -> Misfits:
    """q+ = P_Qt(q + h f): q+ - q - h f = G'm with m >= 0, q+ in Qt; the distance to the projection is sqrt(<m, y>) at most."""
    t, q, new, h, m = run.t[:-1], run.x[:-1], run.x[1:], run.step[1:, None], run.multipliers[1:]
    f = _mean(model, t, q, h) if model.mean_forcing else _evaluated([model.t, model.q], [model.f], t, q)[0][:, :, 0]
    here = [model.g, ca.jacobian(model.g, model.q), majorant(model.g)]
    g, G, size_g = _evaluated([model.t, model.q], here, t + h[:, 0], q)
    g, moved = g[:, :, 0], new - q
    push = np.einsum("kij,ki->kj", G, m)
    size = np.abs(moved) + h * np.abs(f) + np.einsum("kij,ki->kj", np.abs(G), np.abs(m))
    place = ROUNDING * (np.abs(q) + np.abs(new)) + h * _known_to(*_evaluated([model.t, model.q], [majorant(model.f)], t, q))
    y = g + _apply(G, moved)
    unseen = _known_to(size_g) + ROUNDING * _apply(np.abs(G), np.abs(q) + np.abs(new) + size)
    reach = np.linalg.norm(moved, axis=1) + h[:, 0] * np.linalg.norm(f, axis=1)
    gap = (np.maximum(m, 0) * np.maximum(y, 0)).sum(axis=1)
    return {
        "equation": _worst(np.abs(moved - h * f - push), EQUATION * size + place),
        "no pull": _worst(np.maximum(-m, 0), LAW * np.abs(m).max(axis=1, initial=0.0)[:, None]),
        "no overlap": _worst(np.maximum(-y, 0), LAW * _apply(np.abs(G), size) + unseen),
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

    sizes = majorant(model.potential)

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
        inside = _known_to(*(_evaluated([model.x], [sizes], x + h[:, None] * V_)[0] for V_ in (v, probe)))[:, 0]
        worst = max(worst, _worst(np.maximum(better, 0), ROUNDING * size + inside))
    moved = np.abs(run.x[first + 1 :] - x - h[:, None] * v)
    place = EQUATION * h[:, None] * np.abs(v) + ROUNDING * (np.abs(x) + np.abs(run.x[first + 1 :]))
    return {"equation": _worst(moved, place), "minimum": worst}


# -- first-order systems -----------------------------------------------------------------------------------------------


class _Sizes(NamedTuple):
    """Of each step (N, n): what acts on the states in it, and what they are known to."""

    acting: np.ndarray
    known: np.ndarray


def _first_order(model: FirstOrderSystem, run: Trajectory) -> Misfits:
    """M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), r = g(t, x, l), y = h(t, x, l)."""
    equation, sizes = _theta(model, run)
    return {"equation": equation, **({} if not model.law.size else _outputs(model, run, model.h, model.lam, model.law, sizes))}


def _lure(model: LureSystem, run: Trajectory) -> Misfits:
    """The same with M = I, f = A(x) + f(t), r = B l, y = C x + D l."""
    l = ca.SX.sym("l", model.B.shape[1])
    y = model.C @ model.x + model.D @ l
    equation, sizes = _theta(model, run)
    law = _outputs(model, run, y, l, model.law, sizes) if model.law is not None else _potential(model, run, y, l, sizes)
    return {"equation": equation, **law}


def _theta(model: FirstOrderSystem | LureSystem, run: Trajectory) -> tuple[float, _Sizes]:
    """The misfit of the equation, and the sizes of what made the states."""
    if isinstance(model, FirstOrderSystem):
        symbol, rate, input, M = model.lam, model.f, model.g, np.array(ca.DM(model.M))
        l = run.multipliers if model.law.size else np.zeros((len(run.t), 0))
    else:
        symbol, l = ca.SX.sym("l", model.B.shape[1]), run.multipliers
        rate, input, M = model.A + model.f, ca.densify(model.B @ symbol), np.eye(model.x.numel())
    l, h, x, new = np.nan_to_num(l), run.step[1:, None], run.x[:-1], run.x[1:]
    asked = [rate, input, ca.jacobian(rate, model.x), ca.jacobian(input, symbol), majorant(rate), majorant(input)]
    f, r, slope, push, size_f, size_r = _evaluated([model.t, model.x, symbol], asked, run.t, run.x, l)
    f, r, pushes = f[:, :, 0], r[:, :, 0], np.abs(r[:, :, 0]) + _apply(np.abs(push), np.abs(l))

    def weighed(rates: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        th, ga = model.theta, model.gamma
        return h * (th * rates[1:] + (1 - th) * rates[:-1] + ga * inputs[1:] + (1 - ga) * inputs[:-1])

    first = 1 if model.gamma < 1 else 0  # r_0 is not a row of the run
    misfit = np.abs((new - x) @ M.T - weighed(f, r))
    size = np.abs(new - x) @ np.abs(M).T + weighed(np.abs(f), pushes)
    response = np.abs(np.linalg.pinv(np.nan_to_num(M - h[:, :, None] * model.theta * slope[1:])))
    place = np.abs(x) + np.abs(new) + size @ np.abs(np.linalg.pinv(M)).T
    seen = place @ np.abs(M).T + h * (_apply(np.abs(slope[1:]), place) + _apply(np.abs(slope[:-1]), place))
    allowed = EQUATION * size + ROUNDING * seen + weighed(_known_to(size_f), _known_to(size_r))
    return _worst(misfit[first:], allowed[first:]), _Sizes(_apply(response, size), ROUNDING * place)


def _outputs(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, law: Law, sizes: _Sizes) -> Misfits:
    """-y ∈ N_K(l) with y computed afresh; y's scale is what moves it or acts on it in the step, and what is not known of it."""
    y, s_y = _output(model, run, output, l, sizes)
    given, at = run.multipliers[1:], 0
    worst = 0.0
    for block in law.blocks:
        rows = slice(at, at := at + block.size)
        worst = max(worst, _block(block, given[:, rows], y[:, rows], s_y[:, rows]))
    return {"law": worst}


def _output(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, sizes: _Sizes) -> tuple[np.ndarray, np.ndarray]:
    """y (N, m), and what it may be off by."""
    given, h = run.multipliers[1:], run.step[1:, None]
    asked = [output, ca.jacobian(output, model.x), ca.jacobian(output, l), ca.jacobian(output, model.t), majorant(output)]
    y, C, D, drift, size_y = _evaluated([model.t, model.x, l], asked, run.t[1:], run.x[1:], given)
    moves = np.abs(run.x[1:] - run.x[:-1]) + sizes.acting
    s_y = LAW * (_apply(np.abs(C), moves) + _apply(np.abs(D), np.abs(given)) + h * np.abs(drift[:, :, 0]))
    return y[:, :, 0], s_y + _apply(np.abs(C), sizes.known) + _known_to(size_y)


def _block(block: Block, l: np.ndarray, y: np.ndarray, s_y: np.ndarray) -> float:
    """How far rows are from l ∈ K with <l' - l, y> >= 0 for the l' ∈ K that the block samples, beside what both may be off by.

    Where K is strictly convex one l' has the least <l', y>: l is measured by its distance from that, unless y is 0.
    """
    s_l = LAW * np.maximum(np.abs(l).max(axis=1), block.extent)
    worst = _over(block.excess(l).max(axis=1, initial=0.0), s_l)
    size_y, rivals = np.linalg.norm(y, axis=1), block.rivals(l, y)
    if block.strict:
        away = _over(np.linalg.norm(l - rivals[0], axis=1), s_l)
        return float(np.max(np.maximum(worst, np.fmin(_over(size_y, s_y.max(axis=1)), away)), initial=0.0))
    for other in rivals:
        gap = np.maximum(((l - other) * y).sum(axis=1), 0)
        worst = np.maximum(worst, _over(gap, (np.abs(l - other) * s_y).sum(axis=1) + size_y * s_l))
    return float(np.max(worst, initial=0.0))


def _potential(model: LureSystem, run: Trajectory, output: ca.SX, l: ca.SX, sizes: _Sizes) -> Misfits:
    """l ∈ -dPhi(y): Phi(z) >= Phi(y) - <l, z - y> at probes z."""
    y, s_y = _output(model, run, output, l, sizes)
    size = np.abs(y).max(axis=1, keepdims=True) + np.abs(run.x[1:] - run.x[:-1]).max(axis=1, keepdims=True)
    return {"law": _subgradient(model.phi, model.y, y, -run.multipliers[1:], size, s_y)}


def _subgradient(
    phi: ca.SX, symbol: ca.SX, y: np.ndarray, slope: np.ndarray, size: np.ndarray, unknown: np.ndarray | float = 0.0
) -> float:
    """Largest Phi(y) + <slope, z - y> - Phi(z) beside what is allowed; y is known to ``unknown``."""
    here, worst, sizes = _evaluated([symbol], [phi], y)[0][:, 0, 0], 0.0, majorant(phi)
    inside = _known_to(*_evaluated([symbol], [sizes], y))[:, 0] + (np.abs(slope) * unknown).sum(axis=1)
    probes = [np.zeros_like(y), *(y + s * p * size * e for e in np.eye(y.shape[1]) for p in PROBES for s in (1, -1))]
    for probe in probes:
        there, along = _evaluated([symbol], [phi], probe)[0][:, 0, 0], (slope * (probe - y)).sum(axis=1)
        allowed = ROUNDING * (np.abs(here) + np.where(np.isfinite(there), np.abs(there), 0)) + LAW * np.abs(along) + inside
        worst = max(worst, _worst(np.maximum(here + along - there, 0), allowed))
    return worst


# -- inclusions --------------------------------------------------------------------------------------------------------


def _inclusion(model: MonotoneInclusion, run: Trajectory) -> Misfits:
    """y = x + mu v with v in F(x) - S(x); x+ in C, not farther from y than any other row of the run (by eps at most)."""
    x, new, h, v = run.x[:-1], run.x[1:], run.step[1:, None], run.v[1:]
    size = np.abs(x).max(axis=1, keepdims=True) + h * np.abs(v).max(axis=1, keepdims=True)
    asked = [model.field, _signed(model), majorant(model.field), majorant(_signed(model))]
    field, S, *sizes = _evaluated([model.x], asked, x)
    field, S = field[:, :, 0], S[:, :, 0]
    kinks = _evaluated([model.x], [model.sign_arguments], x)[0][:, :, 0] if model.sign_symbols.numel() else np.ones((len(x), 1))
    smooth = (kinks != 0).all(axis=1)[:, None]
    if model.potential_split is not None:
        found = {"selection": _subgradient(potential(model.potential_split), model.x, x, field - v, size)}
    else:
        misfit = np.where(smooth, np.abs(field - S - v), 0.0)
        found = {"selection": _worst(misfit, EQUATION * (np.abs(field) + np.abs(S)) + _known_to(*sizes))}
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
