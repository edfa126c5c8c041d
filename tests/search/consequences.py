"""What a report says follows: tried on runs, on points made for the purpose, beyond the box and after the end of the run.

A trial of a consequence takes it at its word: where its scope has no box, states are taken from everywhere; where it has no
interval of time, times until ten times t_end. A run that is refused at each length of the step with a proof that there is none
contradicts that steps exist; where a solver gave up, nothing is known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import linprog, nnls

from nsmodel import StepError, simulate

from .trial import HOLDS, Array, Inclusion, Trial, Values, above, into, numbers, slope_at_0

ROWS = 100  # of a run
LONGER = 5  # beyond t_end, where the scope has no end
NONE = "leave no point", "has no solution", "can keep"  # A refusal that says these words claims a proof.


def try_consequences(trial: Trial) -> None:
    """Try what follows, by name, and the times until which a run is said to be in the box."""
    for item in trial.report.consequences:
        for attempt in CONSEQUENCES[trial.name].get(item.name, ()) if item.verdict == HOLDS else ():
            trial.held.add(item.name)
            attempt(trial, item)
    _stays(trial)


# ------------------------------------------------------------------------------------------------ runs


def _run(trial: Trial, start: Array, step: float, t_end: float) -> Any:
    other = copy(trial.model)
    for name, value in {"x0": ca.SX(ca.DM(start)), "q0": ca.SX(ca.DM(start)), "exact": None, "step": step, "t_end": t_end,
                        "steps": None}.items():  # fmt: skip
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


def _end(trial: Trial, item: Any, longer: float = LONGER) -> float:
    """A time within the scope; without one, beyond t_end."""
    t_end = float(trial.model.t_end or 1.0)
    return t_end * longer if item.scope is None or item.scope.time is None else min(t_end * longer, item.scope.time[1])


def _inside(trial: Trial, item: Any, *runs: Any) -> Array:
    """The rows until which all runs are in the box of the scope."""
    states, stay = {} if item.scope is None else item.scope.states, np.ones(len(runs[0].t), bool)
    for run in runs:
        for name, (low, high) in states.items():
            x = run.x[:, trial.model.names.index(name)]
            stay &= (x >= low) & (x <= high)
    return np.cumprod(stay).astype(bool)


def _in_scope(item: Any, names: Sequence[str], q: Array) -> bool:
    states = {} if item.scope is None else item.scope.states
    return all(low <= q[names.index(name)] <= high for name, (low, high) in states.items())


def _steps_exist(trial: Trial, item: Any) -> None:
    """Runs from x0 are not refused at each of three lengths of the step, while they are in the box."""
    m, refused = trial.model, []
    if m.step is None:
        return
    for part in (1, 4, 16):
        step = float(m.step) / part
        try:
            _run(trial, trial.x0, step, min(ROWS * step, _end(trial, item)))
            return
        except StepError as error:
            run = error.trajectory
            if run is not None and not _inside(trial, item, run).all():
                return
            refused.append(str(error)[:200])
        except Exception:  # a start that does not satisfy the model is refused with good reason
            return
    _judge_refusals(trial, item, refused)


def _judge_refusals(trial: Trial, item: Any, refused: Sequence[str], **at: Any) -> None:
    if all(any(word in message for word in NONE) for message in refused):
        trial.note(item.name, refused=refused, **at)
    else:
        trial.untested.add(f"{item.name}: refused")


def _contracts(trial: Trial, item: Any, rate: float, P: Array) -> None:
    """|x - y|_P <= e^{rate t} |x_0 - y_0|_P for two runs, as long as both are in the box; again with a quarter of the step."""
    other, t_end = _start(trial, item), min(_end(trial, item), 1.0)
    if -rate * t_end > 40:  # an implicit step of that length falls by 1 / (1 - h rate) only
        return
    worst = []
    for part in (100, 400):
        try:
            runs = [_run(trial, x, t_end / part, t_end) for x in (trial.x0, other)]
        except Exception:  # steps are refused with good reason, and others are looked for elsewhere
            return
        d = runs[0].x - runs[1].x
        d = np.sqrt(np.einsum("ki,ij,kj->k", d, P, d))
        bound = np.exp(np.minimum(rate * runs[0].t, 600.0)) * d[0]
        excess = ((d - bound) / (bound + 1e-3 * d[0] + 1e-300))[_inside(trial, item, *runs)]
        worst.append(float(excess.max(initial=0.0)))
    if min(worst) > 0.03 and worst[1] > 0.5 * worst[0]:  # One of them alone is chatter about a steep place.
        trial.note(item.name, other=other, rate=rate, excess=worst)


def _converges(trial: Trial, item: Any) -> None:
    """Runs with h, h/4, h/16 come nearer to one with h/64: else there is no one solution that they tend to."""
    t_end = min(_end(trial, item), float(trial.model.t_end or 1.0))
    try:
        runs = [_run(trial, trial.x0, t_end / n, t_end) for n in (40, 160, 640, 2560)]
    except Exception:  # looked for elsewhere
        return
    fine = runs[-1].x[::64]
    if not _inside(trial, item, *runs[:1]).all():
        return
    errors = [float(np.abs(run.x[:: n // 40] - fine).max()) for run, n in zip(runs[:-1], (40, 160, 640), strict=True)]
    if errors[2] > 0.02 * (1e-6 + np.abs(fine - fine[0]).max()) and errors[2] > 0.7 * errors[0]:
        trial.note(item.name, errors=errors)


def _stays(trial: Trial) -> None:
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


# ------------------------------------------------------------------------------------------------ sweeping processes


def _set(trial: Trial) -> Values:
    return Values([trial.model.t, trial.model.q], trial.model.g)


def _defined(trial: Trial, item: Any) -> None:
    """f and g have values at admissible points of the scope, at each of its times."""
    m, g, f = trial.model, _set(trial), Values([trial.model.t, trial.model.q], trial.model.f)
    for t, q in zip(trial.times(item.scope), [trial.x0] * 10 + trial.points(item.scope, m.names), strict=False):
        value = g(t, q)
        if np.isnan(value).any() or ((value >= 0).all() and not np.isfinite(f(t, q)).all()):
            trial.note(item.name, t=t, q=q, g=value, f=f(t, q))


def _penalised(trial: Trial, item: Any) -> None:
    """q' = f + sum grad g_i max(0, -g_i)/eps by an ODE solver: its path tends to the solution, whatever made ours."""
    m, g, f = trial.model, _set(trial), Values([trial.model.t, trial.model.q], trial.model.f)
    if len(trial.x0) > 3 or m.g.numel() > 6:
        return
    t_end = min(_end(trial, item), 0.5 * float(m.t_end or 1.0))
    try:
        run = _run(trial, trial.x0, t_end / 400, t_end)
    except Exception:  # looked for elsewhere
        return
    if not _inside(trial, item, run).all():
        return
    size, far = 1e-6 + float(np.abs(run.x - run.x[0]).max()), []
    for eps in (1e-2, 1e-3, 1e-4):

        def field(t: float, q: Array, eps: float = eps) -> Array:
            return f(t, q) + g.jacobian(t, q).T @ np.maximum(0.0, -g(t, q)) / eps

        path = solve_ivp(field, (0, t_end), trial.x0, "LSODA", [t_end], rtol=1e-7, atol=1e-9 * size)
        if not path.success:
            return
        far.append(float(np.abs(path.y[:, -1] - run.x[-1]).max()))
    if far[2] > 0.05 * size and far[2] > 0.5 * far[1] > 0.25 * far[0]:
        trial.note(item.name, eps=(1e-2, 1e-3, 1e-4), far=far, size=size)


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


def _prox_regular(trial: Trial, item: Any) -> None:
    """<n, q' - q> <= |q' - q|^2 / (2 eta) for outward unit normals n at q and admissible q', near and far."""
    m, eta, g = trial.model, item.value.get("eta", np.inf), _set(trial)
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


def _moves(trial: Trial, item: Any) -> None:
    """Where one constraint closes alone, its boundary moves no faster than K_L."""
    g, speed = _set(trial), Values([trial.model.q, trial.model.t], trial.model.g)
    for t, q, rows, slopes in _contacts(trial, item, g):
        if len(rows) == 1 and np.linalg.norm(slopes[0]) > 0:
            pace = -speed.jacobian(q, t)[rows[0], 0] / np.linalg.norm(slopes[0])
            if pace > item.value.get("K_L", np.inf) * (1 + 1e-7) + 1e-9:
                trial.note(item.name, t=t, q=q, pace=pace, value=dict(item.value))


def _room(trial: Trial, item: Any, q: Array) -> float:
    """The distance to the sides of the box."""
    states = {} if item.scope is None else item.scope.states
    at = trial.model.names.index
    return min((min(q[at(name)] - low, high - q[at(name)]) for name, (low, high) in states.items()), default=np.inf)


def _step_bound(trial: Trial, item: Any) -> None:
    """At q in Q(t) and for h < c/K_L the set linearised at (t + h, q) has a point."""
    g, bound = _set(trial), item.value.get("h", np.inf)
    last = np.inf if item.scope is None or item.scope.time is None else item.scope.time[1]
    speed = next((other.value.get("K_L", np.inf) for other in trial.report.consequences if other.name == "K_L"), 0.0)
    for t, q, _, _ in _contacts(trial, item, g):
        h = min(bound * (1 - 1e-6), 10.0 ** trial.rng.integers(-3, 3)) * trial.rng.choice([1.0, 0.5])
        if not (h > 0 and t + h <= last and speed * h < _room(trial, item, q)):
            continue
        value, slope = g(t + h, q), g.jacobian(t + h, q)
        if not (np.isfinite(value).all() and np.isfinite(slope).all()):
            trial.note(item.name, t=t, h=h, q=q, g=value)
            return
        size = np.linalg.norm(slope, axis=1) + 1e-300
        n, p = len(q), len(value)
        best = linprog(np.r_[np.zeros(n), 1.0], -np.c_[slope / size[:, None], np.ones(p)], value / size,
                       bounds=[(None, None)] * n + [(0, None)])  # fmt: skip
        if best.status == 0 and best.fun > 1e-7 * (1 + np.abs(value / size).max()):
            trial.note(item.name, t=t, h=h, q=q, bound=bound, empty_by=best.fun)


def _linearised(trial: Trial, item: Any) -> None:
    """d(q', linearised Q_i at q) <= M/(2a) |q' - q|^2 for q, q' in Q(t)."""
    m, g, factor = trial.model, _set(trial), item.value.get("M/(2a)", np.inf)
    for t, q, _, _ in _contacts(trial, item, g):
        for size in (1e-2, 0.3, 3.0):
            other = q + size * trial.rng.normal(size=len(q))
            if (g(t, other) < 0).any() or not _in_scope(item, m.names, other):
                continue
            slope = g.jacobian(t, q)
            off = -(g(t, q) + slope @ (other - q)) / (np.linalg.norm(slope, axis=1) + 1e-300)
            if float(off.max(initial=0.0)) > factor * float((other - q) @ (other - q)) * (1 + 1e-6) + 1e-9 * (1 + size):
                trial.note(item.name, t=t, q=q, other=other, off=off.max(), factor=factor)


def _metric(trial: Trial, item: Any) -> None:
    """d(q', linearised Q at q) <= Theta sum d(q', linearised Q_i at q) within r/4, both by least squares."""
    g, Theta, r = _set(trial), item.value.get("Theta", np.inf), item.value.get("r", np.inf)
    for t, q, _, _ in _contacts(trial, item, g):
        d = trial.rng.normal(size=len(q))
        other = q + d / np.linalg.norm(d) * min(r / 4, 10.0) * trial.rng.uniform(0.01, 0.99)
        value, slope = g(t, q), g.jacobian(t, q)
        size = np.linalg.norm(slope, axis=1) + 1e-300
        off = (value + slope @ (other - q)) / size  # >= 0: inside
        apart = float(np.maximum(0.0, -off).sum())
        distance = _distance(slope / size[:, None], off)
        if np.isfinite(distance) and distance > Theta * apart * (1 + 1e-6) + 1e-9 * (1 + np.linalg.norm(q)):
            trial.note(item.name, t=t, q=q, other=other, distance=distance, apart=apart, Theta=Theta)


def _distance(N: Array, off: Array) -> float:
    """min |d| over off + N d >= 0 (least distance programming; Lawson and Hanson, chapter 23)."""
    l, _ = nnls(np.vstack([N.T, -off]), np.r_[np.zeros(N.shape[1]), 1.0], maxiter=100 * len(off) + 100)
    residual = np.r_[N.T @ l, -off @ l - 1.0]
    return float(np.linalg.norm(residual[:-1] / residual[-1])) if abs(residual[-1]) > 1e-12 else np.inf


def _half(trial: Trial, item: Any) -> None:
    """|q_h - q| <= C_0 sqrt(h), q by 64 times shorter steps."""
    if "log10 C_0" not in item.value or trial.model.step is None:
        return
    step, t_end = float(trial.model.step), min(_end(trial, item), float(trial.model.t_end or 1.0))
    with suppress(Exception):
        coarse, fine = (_run(trial, trial.x0, h, t_end) for h in (step, step / 64))
        worst = float(np.abs(coarse.x[-1] - fine.x[-1]).max())
        if np.log10(worst + 1e-300) > item.value["log10 C_0"] + 0.5 * np.log10(step):
            trial.note(item.name, worst=worst, value=dict(item.value))


# ------------------------------------------------------------------------------------------------ oscillators


def _domain(trial: Trial) -> tuple[Values, Values]:
    m = trial.model
    return Values([m.x], m.potential), Values([m.x], ca.vertcat(ca.SX(0, 1), *m.constraints.values()))


def _frictions(trial: Trial) -> list[tuple[Array, float]]:
    """(H, theta'(0)) of each element."""
    return [(numbers(e.H), slope_at_0(Values([trial.model.s], e.theta))) for e in trial.model.elements]


def _energy(trial: Trial, item: Any) -> None:
    """E_n = |x_{n+1} - x_n|^2 / (2 l^2) + g(x_{n+1}) falls by l <v, A(v)> at least (smooth theta at |H v| > 0)."""
    g, _ = _domain(trial)
    m = trial.model
    thetas = [Values([m.s], e.theta) for e in m.elements]
    with suppress(StepError):
        step = float(m.step)
        run = _run(trial, trial.x0, step, min(2 * ROWS * step, _end(trial, item)))
        step = float(run.step[np.isfinite(run.step)][0])
        v = np.diff(run.x, axis=0) / np.diff(run.t)[:, None]
        keep = np.abs(np.diff(run.t) - step) < 1e-9 * step
        E = np.array([w @ w / 2 + float(g(x)[0]) for w, x in zip(v, run.x[1:], strict=True)])
        for k in range(len(E) - 1):
            lost = sum(_power(theta, numbers(e.H) @ v[k + 1]) for theta, e in zip(thetas, m.elements, strict=True))
            lost += v[k + 1] @ numbers(m.damping) @ v[k + 1] if m.damping is not None else 0.0
            size = abs(E[k]) + abs(E[k + 1]) + abs(float(g(run.x[0])[0])) + v[k] @ v[k]
            if keep[k] and keep[k + 1] and E[k + 1] - E[k] > -step * lost * (1 - 1e-6) + 1e-7 * size:
                trial.note(item.name, row=k, rise=E[k + 1] - E[k], lost=step * lost, size=size)
                return


def _power(theta: Values, w: Array) -> float:
    """theta'(|w|) |w|."""
    s = float(np.linalg.norm(w))
    return s * float(theta.jacobian(s)[0, 0]) if s > 1e-12 else 0.0


def _out_of_balance(trial: Trial, x: Array) -> float:
    """The distance from 0 to grad g(x) + A(0), by projected gradients; an upper bound of it, sharp to 1e-6 of |grad g|."""
    g, _ = _domain(trial)
    slopes, force = _frictions(trial), g.jacobian(x)[0]
    u = [np.zeros(len(H)) for H, _ in slopes]
    size = sum(np.linalg.norm(H, 2) ** 2 for H, _ in slopes) + 1e-300
    for _ in range(3000):
        rest = force + sum(H.T @ w for (H, _), w in zip(slopes, u, strict=True))
        for k, (H, radius) in enumerate(slopes):
            u[k] = u[k] - H @ rest / size
            u[k] *= min(1.0, radius / (np.linalg.norm(u[k]) + 1e-300))
    return float(np.linalg.norm(force + sum(H.T @ w for (H, _), w in zip(slopes, u, strict=True))))


def _limit(trial: Trial, item: Any) -> None:
    """Where a long run has come to rest, friction can hold it."""
    g, c = _domain(trial)
    with suppress(StepError):
        step = float(trial.model.step)
        run = _run(trial, trial.x0, step, 2000 * step)
        x, moved = run.x[-1], np.abs(np.diff(run.x[-20:], axis=0)).max()
        if moved > 1e-13 * (1 + np.abs(x).max()) or (c(x) <= 1e-9).any() or g.jacobian(x).size == 0:
            return
        force = float(np.linalg.norm(g.jacobian(x))) + sum(radius for _, radius in _frictions(trial))
        kink = np.abs(g.jacobian(x + 1e-9) - g.jacobian(x - 1e-9)).max() > 1e-4 * force
        if not kink and _out_of_balance(trial, x) > 1e-3 * force + moved / step**2:
            trial.note(item.name, x_inf=x, out_of_balance=_out_of_balance(trial, x), force=force)


def _rest(trial: Trial, item: Any) -> None:
    """No point beyond the printed ends is at rest: there |g'| > theta'(0)."""
    if len(trial.x0) > 1:
        return
    g, c = _domain(trial)
    dry = sum(slope * float(np.linalg.norm(H)) for H, slope in _frictions(trial))
    low, high = (next((v for k, v in item.value.items() if k.startswith(word)), edge)
                 for word, edge in (("least", -np.inf), ("largest", np.inf)))  # fmt: skip
    for s in (1e-6, 1e-3, 0.1, 1.0, 10.0):
        for x in ([low - s * (1 + abs(low))], [high + s * (1 + abs(high))]):
            if np.isfinite(x).all() and (c(x) > 0).all():
                trial.need(
                    "rest points", lambda exact, x=x: above(dry, abs(float(g.jacobian(np.array(x), exact=exact)[0, 0]))),
                    1e-9, x=x, dry=dry, value=dict(item.value),
                )  # fmt: skip


def _limits_inside(trial: Trial, item: Any) -> None:
    """Runs from several starts that come to rest do so within the printed interval, or at |grad g| <= theta'(0)."""
    g, c = _domain(trial)
    dry = sum(slope * float(np.linalg.norm(H, 2)) for H, slope in _frictions(trial))
    for _ in range(3):
        start = trial.x0 + trial.rng.normal(size=len(trial.x0)) * trial.rng.choice([0.1, 1.0, 3.0])
        if (c(start) <= 0).any():
            continue
        with suppress(Exception):
            step = float(trial.model.step)
            x = _run(trial, start, step, 1500 * step).x
            if np.abs(np.diff(x[-20:], axis=0)).max() > 1e-13 * (1 + np.abs(x[-1]).max()) or (c(x[-1]) <= 1e-9).any():
                continue
            if len(start) == 1:
                low, high = (v for v in item.value.values())
                off = max(low - x[-1, 0], x[-1, 0] - high)
            else:
                off = float(np.linalg.norm(g.jacobian(x[-1]))) - dry
            if off > 1e-6 * (1 + abs(dry) + np.abs(x[-1]).max()):
                trial.note(item.name, x_inf=x[-1], off=off, value=dict(item.value))


# ------------------------------------------------------------------------------------------------ first-order systems


def _regular(trial: Trial, item: Any) -> None:
    """det (M - s (theta A + gamma K)) keeps its sign for 0 < s <= h."""
    m = trial.model
    parts = ca.Function("W", [m.t, m.x, m.lam], [ca.densify(m.theta * ca.jacobian(m.f, m.x) + m.gamma * ca.jacobian(m.g, m.x))])
    M, h, n = numbers(m.M), float(m.step), len(m.names)
    names = [*m.names, *m.multiplier_names]
    for t, z in zip(trial.times(item.scope), trial.points(item.scope, names), strict=True):
        G = np.array(parts(t, z[:n], into(trial, z[n:]))).reshape(n, n)
        steps = h * np.r_[1.0, trial.rng.random(6), 10.0 ** -trial.rng.integers(1, 6, 3)]
        signs = {float(np.linalg.slogdet(M - s * G)[0]) for s in steps}
        if len(signs) > 1:
            trial.note(item.name, t=t, z=z, signs=sorted(signs))


def _affine(trial: Trial, item: Any) -> None:
    """f, h and g at a middle are the means of those at the ends."""
    m = trial.model
    parts, names = Values([m.t, ca.vertcat(m.x, m.lam)], ca.vertcat(m.f, m.h, m.g)), [*m.names, *m.multiplier_names]
    for t, (a, b) in zip(trial.times(item.scope), trial.pairs(trial.points(item.scope, names)), strict=False):
        u, v, w = parts(t, a), parts(t, (a + b) / 2), parts(t, b)
        if (
            np.isfinite([u, v, w]).all()
            and (abs(v - (u + w) / 2) > 1e-9 * (abs(u) + abs(v) + abs(w) + np.abs([a, b]).max())).any()
        ):
            trial.note(item.name, t=t, a=a, b=b, off=v - (u + w) / 2)


def _one_trajectory(trial: Trial, item: Any) -> None:
    """Steps exist from other starts too, and one run twice is one run."""
    _steps_exist(trial, item)
    m = trial.model
    for _ in range(3):
        start, refused = _start(trial, item), []
        for part in (1, 4):
            step = float(m.step) / part
            try:
                a, b = (_run(trial, start, step, min(20 * step, _end(trial, item))) for _ in range(2))
            except StepError as error:
                run = error.trajectory
                if run is None or _inside(trial, item, run).all():
                    refused.append(f"{part}: {str(error)[:200]}")
                continue
            except Exception:
                break
            if not np.array_equal(a.x, b.x):
                trial.note(item.name, start=start, other=float(np.abs(a.x - b.x).max()))
            break
        if len(refused) == 2:
            _judge_refusals(trial, item, refused, start=start)


def _order(trial: Trial, item: Any) -> None:
    """Where no index changes, halving the step divides the error by 2^order."""
    m, order = trial.model, int(item.value["order"])
    step = float(m.step)
    with suppress(StepError):
        runs = [_run(trial, trial.x0, step / k, 16 * step) for k in (4, 8, 16)]
        if any(len({tuple(row) for row in np.atleast_2d(run.index_set)[1:]}) > 1 for run in runs) or not all(
            _inside(trial, item, run).all() for run in runs
        ):
            return
        a, b, c = (run.x[-1] for run in runs)
        size = float(np.abs(runs[2].x - runs[2].x[0]).max())
        coarse, fine = float(np.abs(a - b).max()), float(np.abs(b - c).max())
        if 1e-9 * size < fine and fine > coarse / 2 ** (order - 0.5) and coarse < 1e-2 * size:
            trial.note(item.name, order=order, coarse=coarse, fine=fine, size=size)


# ------------------------------------------------------------------------------------------------ Lur'e systems


def _norm(trial: Trial) -> Array:
    return np.array(trial.report["5.2"].witness.get("P_omega", np.eye(len(trial.model.names))), float)


def _to_rest(trial: Trial, item: Any) -> None:
    """From starts within the radius |x|_P <= e^{omega t} |x_0|_P, also long after t_end."""
    P, omega, radius = _norm(trial), item.value["omega"], item.value.get("radius", np.inf)
    step = float(trial.model.step)
    for size in (0.01, 0.5, 0.99):
        x = trial.rng.normal(size=len(trial.x0))
        x *= size * min(radius, 100.0) / np.sqrt(x @ P @ x)
        for part in (1, 8):
            try:
                run = _run(trial, x, step / part, min(10 * ROWS * step, _end(trial, item, 20)))
            except Exception:  # starts that the law cannot take
                break
            length = np.sqrt(np.einsum("ki,ij,kj->k", run.x, P, run.x))
            bound = length[0] * np.exp(min(omega, 0.0) * run.t)
            over = float(((length - bound) / (bound + 1e-3 * length[0])).max())
            if over < 0.03:
                break
            if part == 8:
                trial.note(item.name, start=x, over=over, omega=omega)


def _finite(trial: Trial, item: Any) -> None:
    """A(x) and f(t) have values in the scope and at its times."""
    m = trial.model
    A, f = Values([m.x], m.A), Values([m.t], m.f)
    for t, x in zip(trial.times(item.scope), trial.points(item.scope, m.names), strict=True):
        if not (np.isfinite(f(t)).all() and np.isfinite(A(x)).all()):
            trial.note(item.name, t=t, x=x)


# ------------------------------------------------------------------------------------------------ inclusions


def _field(trial: Trial, item: Any) -> None:
    """F, and S or its potential, have values in C."""
    own, phi = Inclusion(trial.model), getattr(trial.model, "phi", None)
    potential = None if phi is None else Values([trial.model.x], phi)
    for x in trial.points(item.scope, trial.model.names):
        x = own.pulled(x, trial.x0)
        value = own.f(x) if potential is not None else own.velocity(x, trial.rng)
        if own.inside(x, 0.0) and not np.isfinite(np.r_[value, potential(x) if potential is not None else 0.0]).all():
            trial.note(item.name, x=x)


def _bounded(trial: Trial, item: Any) -> None:
    """|x| is within the radius, from x0; the ball of the absorbing radius is entered at the rate alpha."""
    m, radius = trial.model, item.value["radius"]
    alpha, absorbing = item.value["alpha"], item.value["absorbing radius"]
    for part in (1, 10):
        try:
            run = _run(trial, trial.x0, float(m.step) / part, _end(trial, item))
        except Exception:  # looked for elsewhere
            return
        length = np.linalg.norm(run.x, axis=1)
        decay = np.exp(-2 * alpha * run.t)
        bound = np.sqrt(decay * length[0] ** 2 + absorbing**2 * (1 - decay))
        over = float((np.minimum(length / (radius + 1e-300), length / (bound + 1e-9 * radius + 1e-300)) - 1).max())
        if over < 0.02:
            return
    trial.note(item.name, radius=radius, over=over)


def _L(trial: Trial, item: Any) -> None:
    _contracts(trial, item, item.value["L"], np.eye(len(trial.x0)))


def _omega(trial: Trial, item: Any) -> None:
    _contracts(trial, item, item.value["omega"], _norm(trial))


Attempt = Callable[[Trial, Any], None]
CONSEQUENCES: dict[str, dict[str, Sequence[Attempt]]] = {
    "sweeping": {
        "well posed": (_defined, _penalised, _converges), "prox-regular": (_prox_regular,), "K_L": (_moves,),
        "step bound": (_step_bound,), "linearisation error": (_linearised,), "metric qualification": (_metric,),
        "order 1/2": (_half,),
    },
    "oscillator": {
        "well posed": (_steps_exist,), "energy decay": (_energy,), "convergence": (_limit,),
        "rest points": (_rest, _limits_inside),
    },
    "first_order": {
        "one trajectory": (_one_trajectory,), "W for smaller steps": (_regular,), "one Newton iteration": (_affine,),
        "order": (_order,),
    },
    "lure": {
        "well posed": (_finite, _steps_exist, _converges), "contraction": (_omega,), "Lyapunov stable": (_to_rest,),
        "globally asymptotically stable": (_to_rest,),
    },
    "inclusion": {
        "well posed": (_field, _steps_exist), "contraction": (_L,), "stability": (_L,), "bounded": (_bounded,),
        "convergence of the scheme": (_converges,),
    },
}  # fmt: skip
