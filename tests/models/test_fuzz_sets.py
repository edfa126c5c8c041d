"""Random sweeping processes, oscillators with friction and monotone inclusions: every step right, every inequality met."""

from __future__ import annotations

from collections import Counter
from typing import Any

import casadi as ca
import fuzz_models as models
import numpy as np
import pytest
from fuzz_judges import (
    EPS,
    ROUND_OFF,
    TOLERANCE,
    UNRESOLVED,
    balance,
    box_misfit,
    carried,
    curved_misfit,
    multiplier_size,
    onto_ball,
)
from fuzz_models import COUNT, FULL, Scene, repeatable
from hypothesis import given
from scipy.optimize import linprog, nnls

from nsmodel import StepError, Trajectory, simulate

stopped: Counter[str] = Counter()


# ---------------------------------------------------------------------------------------------- sweeping processes


def judge_sweeping(scene: Scene, run: Trajectory) -> None:
    twin, h, old, q = scene.twin, run.step[1:, None], run.x[:-1], run.x[1:]
    m = run.multipliers[1:]
    f, size_f = twin.forcing(run.t[:-1], run.step[1:], old)
    at = [row.at(run.t[1:], old) for row in twin.rows]
    N, n = q.shape
    g, G, size_g = (
        (np.array(part).reshape(-1, N, k) for part, k in zip(zip(*at, strict=True), (1, n, 1), strict=True))
        if at
        else (np.zeros((0, N, k)) for k in (1, n, 1))
    )
    g, G, size_g = g[..., 0].T, G.transpose(1, 0, 2), size_g[..., 0].T
    push = np.einsum("kin,ki->kn", G, m)
    effort = h * np.abs(f) + np.einsum("kin,ki->kn", np.abs(G), np.abs(m))
    terms = np.abs(old) + np.abs(q) + h * size_f + effort
    assert balance([q - old, -h * f, -push], np.abs(q - old) + effort, terms) <= 1
    y = g + np.einsum("kin,kn->ki", G, q - old)
    W = G @ G.transpose(0, 2, 1)
    b = g + np.einsum("kin,kn->ki", G, h * f)
    rounding = size_g + np.einsum("kin,kn->ki", np.abs(G), terms)
    size_y = np.abs(b) + np.einsum("kij,kj->ki", np.abs(W), m) + ROUND_OFF / TOLERANCE * rounding
    size_m = multiplier_size(m, np.zeros_like(m), np.abs(W).max(axis=2, initial=0))
    assert box_misfit(m, y, 0, np.inf, size_m, size_y).max(initial=0) <= 1
    assert (m >= 0).all()
    gap = np.array([row.at(run.t[1:], q)[0] for row in twin.rows]).reshape(len(twin.rows), N).T
    assert (gap >= -TOLERANCE * size_y).all()
    np.testing.assert_allclose(run.gap[1:] if m.shape[1] else gap, gap, rtol=0, atol=1e-12 * size_g.max(initial=0))
    np.testing.assert_allclose(run.reactions[1:], m / h, rtol=1e-14)


def no_point_is_left(scene: Scene, error: StepError) -> bool:
    """Whether the linearised set of the step that failed is empty, or a point at most."""
    run, rows = error.trajectory, scene.twin.rows
    g, G, size = zip(*(row.at(np.array([error.time]), run.x[-1:]) for row in rows), strict=True)
    G, g, size = np.concatenate(G), np.concatenate(g), np.concatenate(size)
    length = np.linalg.norm(G, axis=1)
    A = np.hstack([-G / length[:, None], np.ones((len(g), 1))])
    scale = np.abs(g / length).max()
    found = linprog(
        [*np.zeros(G.shape[1]), -1.0], A_ub=A, b_ub=g / length / scale, bounds=[*[(None, None)] * G.shape[1], (None, 1)]
    )
    return found.status == 0 and found.x[-1] <= 1e-7


def leads_too_far(scene: Scene, error: StepError) -> bool:
    """Whether the row named is above its linearisation, where the step that failed leads, by a third of the way there."""
    run, rows, h = error.trajectory, scene.twin.rows, scene.arguments["step"]
    t, q = run.t[-1:], run.x[-1:]
    at = [row.at(t + h, q) for row in rows]
    g, G = np.array([g[0] for g, _, _ in at]), np.array([G[0] for _, G, _ in at])
    length = np.linalg.norm(G, axis=1)
    free = (h * scene.twin.forcing(t, np.array([h]), q)[0]).ravel()
    # The point nearest to q + h f (Lawson and Hanson, chapter 23): |x| least, N x >= c
    N, c = G / length[:, None], -(g + G @ free) / length
    scale = np.abs(c).max()
    E, f = np.vstack([N.T, c / scale]), np.append(np.zeros(len(free)), 1.0)
    r = E @ nnls(E, f)[0] - f
    d = free - scale * r[:-1] / r[-1]
    i = next(i for i in range(len(rows)) if f"'g{i}'" in str(error))
    above = rows[i].at(t + h, q + d)[0][0] - g[i] - G[i] @ d
    return above > 0.33 * length[i] * np.linalg.norm(d[rows[i].P.any(axis=0)])


@repeatable(COUNT)
@given(scene=models.sweeping())
def sweeping(scene: Scene) -> None:
    model = scene.declare()
    failure, run = None, None
    try:
        run = simulate(model)
    except StepError as error:
        failure, run = error, error.trajectory
    if len(run):
        judge_sweeping(scene, run)
    if failure is not None:
        stopped["sweeping"] += 1
        if "linearisation of" in str(failure):
            assert leads_too_far(scene, failure)
        else:
            assert "oppose each other" in str(failure) or "no multiplier can keep" in str(failure)
            assert no_point_is_left(scene, failure)
    if len(scene.twin.starts) == 2 and run.status == "done":
        other = simulate(model, parameters=models.named(scene.twin.starts[1]))
        distance = np.linalg.norm(run.x - other.x, axis=1)
        stretch = [np.linalg.norm(np.eye(run.x.shape[1]) + h * scene.twin.F, 2) for h in run.step[1:]]
        size = np.abs(run.x).max(axis=1) + np.abs(other.x).max(axis=1) + np.abs(np.diff(run.x, axis=0, prepend=run.x[:1])).max()
        assert (distance[1:] <= stretch * distance[:-1] + 1e-9 * size[1:]).all()


def test_sweeping_processes():
    sweeping()
    assert stopped["sweeping"] <= FULL / 100


# ---------------------------------------------------------------------------------------------- friction oscillators


def as_read(term: models.Term, u: ca.SX, x: ca.SX) -> models.Term:
    """The term with the sign of its argument as CasADi keeps it: fabs(1 - x) is stored as fabs(x - 1)."""
    at = np.linspace(0.3, 1.7, x.numel()) * term.u
    kept = float(ca.Function("u", [x], [ca.densify(u)])(at)[0])
    return term._replace(P=-term.P, c=-term.c) if kept * term.argument(at[None])[0, 0] < 0 else term


def differences(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """d_n = x_{n+1} - x_n before and after each step; a last step that only the end of the run shortens keeps the velocity."""
    h, v = run.step[1:, None], run.arrays["v"]
    before = np.vstack([h[:1], h[:-1]])
    if len(h) > 1 and run.step[-1] < run.step[-2]:
        before[-1] = h[-1]
    return before * v[:-1], h * v[1:]


def judge_oscillator(scene: Scene, run: Trajectory) -> None:
    twin, h, x0, x, l = scene.twin, run.step[1:, None], run.x[:-1], run.x[1:], run.multipliers[1:]
    old, d = differences(run)
    v, n = d / h, x.shape[1]
    np.testing.assert_allclose(x0 + d, x, rtol=0, atol=4 * EPS * np.abs(run.x).max())
    parts, J = [d, -old, h**2 * (v @ twin.M.T)], np.eye(n) + h[..., None] * twin.M
    moved = np.abs(d) + np.abs(old) + h**2 * (np.abs(v) @ np.abs(twin.M.T))
    rows = []  # (kind, gradient (N, i, n), y, bound, multiplier, size of what y is made of)
    at = 0

    def take(count: int) -> np.ndarray:
        nonlocal at
        at += count
        return l[:, at - count : at]

    for e in twin.elements:
        y = d @ e.H.T
        speed = np.linalg.norm(y / h, axis=1)
        slope = e.slope(speed) / np.where(speed > 0, speed, 1)
        xi = take(len(e.H))
        parts += [h**2 * slope[:, None] * (y / h @ e.H), -(h**2) * xi @ e.H]
        moved += h**2 * (slope[:, None] * np.abs(y / h) + np.abs(xi)) @ np.abs(e.H)
        J = J + (h * slope[:, None])[..., None] * (e.H.T @ e.H)
        rows.append(("ball", np.broadcast_to(e.H, (len(h), *e.H.shape)), y, e.radius, xi, np.abs(d) @ np.abs(e.H.T)))
    for term in twin.smooth:
        parts.append(h**2 * term.gradient(x))
        met = np.abs(term.force(x)) + np.abs(term.force(x0 + old))  # at the end, and where the free motion would lead
        moved += h**2 * met @ np.abs(term.P / term.u)
        J = J + h[..., None] ** 2 * term.hessian(x)
    for term in twin.kinked:
        G, xi = term.P / term.u, take(len(term.P))
        parts.append(-(h**2) * xi @ G)
        moved += h**2 * np.abs(xi) @ np.abs(G)
        kind = {"abs": "box", "max": "half", "norm": "ball"}[term.phi]
        terms = np.abs(x) @ np.abs(G.T) + np.abs(term.c)
        rows.append((kind, np.broadcast_to(G, (len(h), *G.shape)), term.argument(x), term.w, xi, terms))
    for bound in twin.bounds:
        c, G, size = bound.at(x)
        xi = take(1)
        parts.append(-(h**2) * xi * G)
        moved += np.abs(parts[-1])
        rows.append(("reaction", G[:, None], c[:, None], np.inf, xi, size[:, None]))
        assert (c >= -(TOLERANCE * np.linalg.norm(G, axis=1) * moved.max(axis=1) + ROUND_OFF * size)).all()
    assert at == l.shape[1]
    terms = carried(J, moved + h**2 * sum((term.force_rounding(x) for term in twin.smooth), 0.0))
    assert balance(parts, moved, terms) <= 1
    felt = np.linalg.solve(J, np.broadcast_to(np.eye(n), J.shape)) if len(J) else J
    w = [np.abs(np.einsum("kin,knp,kip->ki", G, h[..., None] ** 2 * felt, G)) for _, G, *_ in rows]
    force = max((np.abs(r[4] * np.sqrt(one)).max(axis=1) for r, one in zip(rows, w, strict=True)), default=0.0, key=np.max)
    for (kind, G, y, bound, xi, terms), one in zip(rows, w, strict=True):
        size_y = np.einsum("kin,kn->ki", np.abs(G), np.abs(felt) @ moved[..., None] @ [1.0]) + ROUND_OFF / TOLERANCE * terms
        size_l = np.maximum(np.abs(xi), bound if np.isfinite(bound) else 0.0)
        unit = np.sqrt(np.where(one > 0, one, 1.0))
        size_l = np.maximum(size_l, np.where(one > 0, 1e-6 * np.reshape(force, (-1, 1)) / unit, 0.0))
        if kind == "ball":
            assert curved_misfit(lambda u, r=bound: onto_ball(u, r), xi, y, size_l, size_y).max() <= 1
        else:
            ends = {"box": (-bound, bound), "half": (-bound, 0.0), "reaction": (0.0, np.inf)}[kind]
            assert box_misfit(xi, y, *ends, size_l, size_y).max() <= 1
    judge_energy(scene, run, old, d)
    judge_stick(scene, run, old, d)


def judge_energy(scene: Scene, run: Trajectory, old: np.ndarray, d: np.ndarray) -> None:
    """Proposition 4.1: E_{n+1} - E_n <= -l_n <v, A(v)>, and what friction takes is at most E_0 - inf g <= E_0."""
    twin, h = scene.twin, run.step[1:]
    v = d / h[:, None]
    g = sum((term.value(run.x) for term in twin.potential), np.zeros(len(run.t)))
    before, after = (old**2).sum(axis=1) / (2 * h**2) + g[:-1], (d**2).sum(axis=1) / (2 * h**2) + g[1:]
    power = np.einsum("ki,ij,kj->k", v, twin.M, v)
    for e in twin.elements:
        s = np.linalg.norm(v @ e.H.T, axis=1)
        power = power + s * (e.radius + e.slope(s))
    unseen = ROUND_OFF * np.abs(run.x).max() / h  # velocities below this are round-off of positions
    scale = before + sum((term.rounding(run.x[1:]) for term in twin.potential), 0.0)
    slack = TOLERANCE * before + ROUND_OFF * scale + unseen * np.sqrt(before) + unseen**2
    if twin.bounds:  # one that rounding violates is mended at such a velocity, against friction
        slack = slack + h * unseen * sum(e.radius * np.linalg.norm(e.H) for e in twin.elements)
    assert (after - before + h * power <= slack).all()
    assert (h * power).sum() <= before[0] + slack.sum()


def judge_stick(scene: Scene, run: Trajectory, old: np.ndarray, d: np.ndarray) -> None:
    """With one isotropic element and smooth forces: v = 0, exactly, where |w/h - grad g(x)| < theta'(0), and nowhere else."""
    twin, h = scene.twin, run.step[1:, None]
    if len(twin.elements) != 1 or twin.kinked or twin.bounds or not np.array_equal(twin.elements[0].H, np.eye(d.shape[1])):
        return
    gradients = [term.gradient(run.x[:-1]) for term in twin.smooth]
    pull = np.linalg.norm(old / h**2 - sum(gradients, 0.0), axis=1)
    size = np.linalg.norm(old / h**2, axis=1) + sum((np.linalg.norm(one, axis=1) for one in gradients), 0.0)
    radius, still = twin.elements[0].radius, (d == 0).all(axis=1)
    assert still[pull < radius - 1e-8 * (radius + size)].all()
    assert not still[pull > radius + 1e-8 * (radius + size)].any()


@repeatable(COUNT)
@given(scene=models.oscillators())
def oscillators(scene: Scene) -> None:
    model = scene.declare()
    of_kind = {term.phi: term for term in scene.twin.kinked}
    scene.twin.kinked = [as_read(of_kind[read.kind], read.u, model.x) for read in model.potential_split.terms]
    try:
        run = simulate(model)
    except StepError as error:
        stopped["oscillators"] += 1
        run = error.trajectory
    if len(run):
        judge_oscillator(scene, run)


def test_oscillators():
    oscillators()
    assert stopped["oscillators"] <= FULL / 50  # several balls of friction at once: drawn again where one is


# ---------------------------------------------------------------------------------------------- monotone inclusions


def reaction_rows(scene: Scene, x: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Values, gradients and sizes of the rows of C: the finite bounds of each state, then the constraints."""
    twin, n, rows = scene.twin, x.shape[1], []
    for i in range(n):
        for end, sign in ((twin.lower[i], 1.0), (twin.upper[i], -1.0)):
            if np.isfinite(end):
                gradient = np.broadcast_to(sign * np.eye(n)[i], x.shape)
                rows.append((sign * (x[:, i] - end), gradient, np.abs(x[:, i]) + abs(end)))
    return rows + [bound.at(x) for bound in twin.bounds]


def in_order(scene: Scene, model: Any) -> list[models.Jump]:
    """The jumps in the order of the model's signs or terms, which is that of CasADi's graph."""
    jumps = scene.twin.jumps
    if model.potential_split is not None:
        of_kind = {jump.term.phi: jump for jump in jumps}
        reads = model.potential_split.terms
        return [of_kind[one.kind]._replace(term=as_read(of_kind[one.kind].term, one.u, model.x)) for one in reads]
    if not jumps or scene.twin.separate:
        return jumps
    at = np.linspace(-1, 1, model.x.numel()) * jumps[0].term.u
    found = np.array(ca.Function("u", [model.x], [ca.densify(model.sign_arguments)])(at)).ravel()
    arguments = [jump.term.argument(at[None])[0, 0] for jump in jumps]
    return [jumps[int(np.abs(arguments - value).argmin())] for value in found]


def judge_inclusion(scene: Scene, run: Trajectory) -> None:
    twin, h, old, x = scene.twin, run.step[1:, None], run.x[:-1], run.x[1:]
    v, e, l = run.arrays["v"][1:], run.arrays["defect"][1:], run.multipliers[1:]
    F, size = twin.force(old)
    chosen = judge_selection(scene, run)
    assert balance([v, -F, -chosen], 0 * v, size + np.abs(chosen)) <= 1
    y = old + h * v
    place = np.abs(old) + np.abs(x) + h * np.abs(v)
    assert balance([x, -y, -e], 0 * x, place) <= 1
    rows = reaction_rows(scene, x)
    for c, G, unseen in rows:
        slack = 0.0 if twin.eps else TOLERANCE * np.linalg.norm(G, axis=1) * np.linalg.norm(e, axis=1)
        assert (c >= -ROUND_OFF * unseen - slack).all()
    distance, eps = run.arrays["predictor_distance"][1:], run.arrays["tolerance"][1:]
    step = run.step[1:]
    np.testing.assert_allclose(eps, twin.eps(step) if callable(twin.eps) else twin.eps or 0.0, rtol=1e-14)
    rounding = ROUND_OFF * place.sum(axis=1)
    far = np.linalg.norm(e, axis=1)
    assert (distance <= far * (1 + TOLERANCE) + rounding).all()
    assert (far**2 <= distance**2 * (1 + TOLERANCE) + eps + rounding * (far + rounding)).all()
    if not twin.bounds:
        nearest = np.clip(y, twin.lower, twin.upper)
        np.testing.assert_array_less(np.abs(distance - np.linalg.norm(nearest - y, axis=1)), rounding + UNRESOLVED)
    if twin.eps is None and rows:
        c, G, unseen = (np.stack(part, axis=1) for part in zip(*rows, strict=True))
        push = np.einsum("kin,ki->kn", G, l)
        moved = np.abs(e) + np.einsum("kin,ki->kn", np.abs(G), np.abs(l))
        assert balance([e, -push], moved, place) <= 1
        W = np.abs(G @ G.transpose(0, 2, 1))
        size_y = np.einsum("kin,kn->ki", np.abs(G), h * np.abs(v) + moved) + ROUND_OFF / TOLERANCE * unseen
        size_l = multiplier_size(l, np.zeros_like(l), W.max(axis=2, initial=0))
        assert box_misfit(l, c, 0, np.inf, size_l, size_y).max() <= 1
    if twin.separate:  # a state at 0, inside of C, rests where the field is weaker than its sign
        for i, jump in enumerate(twin.jumps):
            weight = jump.scale * jump.push
            inside = (old[:, i] == 0) & (twin.lower[i] < 0 < twin.upper[i]) & (not twin.bounds)
            rest = F[inside, i] - np.clip(F[inside, i], -weight, weight)
            assert balance([v[inside, i], -rest], 0 * rest, size[inside, i] + weight) <= 1


def judge_selection(scene: Scene, run: Trajectory) -> np.ndarray:
    """Each s is in -w dphi(u); returned is what they add to the velocity."""
    old, chosen, at = run.x[:-1], np.zeros_like(run.x[1:]), 0
    for jump in scene.twin.jumps:
        s = run.arrays["selection"][1:, at : at + len(jump.term.P)]
        at += s.shape[1]
        u, scale, P = jump.term.argument(old), jump.scale, jump.term.P
        unseen = ROUND_OFF * (np.abs(old) @ np.abs(P.T) / jump.term.u + np.abs(jump.term.c))
        if jump.term.phi == "norm":
            far = np.linalg.norm(u, axis=1)
            seen = far > 1e8 * unseen.max(axis=1)
            np.testing.assert_allclose(s[seen], -scale * u[seen] / far[seen, None], rtol=0, atol=1e-7 * scale)
            assert (np.linalg.norm(s, axis=1) <= scale * (1 + TOLERANCE)).all()
        else:
            low, high = -scale, 0.0 if jump.term.phi == "max" else scale
            assert ((s >= low - TOLERANCE * scale) & (s <= high + TOLERANCE * scale)).all()
            np.testing.assert_allclose(s[u > unseen], low, rtol=TOLERANCE)
            np.testing.assert_allclose(s[u < -unseen], high, rtol=TOLERANCE)
        chosen += jump.push * s @ P
    assert at == run.arrays["selection"].shape[1]
    return chosen


def judge_contraction(scene: Scene, run: Trajectory, other: Trajectory) -> None:
    """<x - x~, G(x) - G(x~)> <= L |x - x~|^2, and projections bring two states no further apart."""
    h, apart = run.step[1:], run.x - other.x
    speed = run.arrays["v"][1:] - other.arrays["v"][1:]
    size = np.abs(run.arrays["v"][1:]).sum(axis=1) + np.abs(other.arrays["v"][1:]).sum(axis=1)
    distance = np.linalg.norm(apart, axis=1)
    product = (apart[:-1] * speed).sum(axis=1)
    place = np.abs(run.x).sum(axis=1) + np.abs(other.x).sum(axis=1)
    unseen = 1e-12 * distance[:-1] * (size + abs(scene.twin.L) * distance[:-1] + place[:-1] / scene.twin.tau) + UNRESOLVED
    assert (product <= scene.twin.L * distance[:-1] ** 2 + unseen).all()
    eps = run.arrays["tolerance"][1:]
    allowed = np.linalg.norm(apart[:-1] + h[:, None] * speed, axis=1) + 2 * np.sqrt(eps)
    assert (distance[1:] <= allowed + TOLERANCE * (h * size) + ROUND_OFF * (place[1:] + place[:-1])).all()


@repeatable(COUNT)
@given(scene=models.inclusions())
def inclusions(scene: Scene) -> None:
    model = scene.declare()
    scene.twin.jumps = in_order(scene, model)
    try:
        run = simulate(model)
        other = simulate(model, parameters=models.named(scene.twin.starts[1]))
    except StepError:
        stopped["inclusions"] += 1
        return
    judge_inclusion(scene, run)
    judge_contraction(scene, run, other)


def test_inclusions():
    inclusions()
    assert stopped["inclusions"] <= FULL / 100


# ---------------------------------------------------------------------------------------------- what a wrong step looks like


def spoiled(run: Trajectory, names: tuple[str, ...], part: float) -> bool:
    """Change the last row of each array by a part of the largest change of the array; whether there is any."""
    change = {name: part * np.nan_to_num(np.ptp(np.nan_to_num(run.arrays[name]), axis=0)) for name in names}
    for name, by in change.items():
        run.arrays[name][-1] += by
    return any((by > 1e-9 * part * np.abs(run.arrays[name][-1])).any() for name, by in change.items())


WRONG = {
    "sweeping": (models.sweeping, judge_sweeping, [("x",), ("multipliers",)]),
    "oscillators": (models.oscillators, judge_oscillator, [("x",), ("v",), ("multipliers",)]),
    "inclusions": (models.inclusions, judge_inclusion, [("x",), ("v",), ("defect",)]),
}


@pytest.mark.long
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_step_is_seen(name):
    scenes, judge, arrays = WRONG[name]
    seen: list[bool] = []

    @repeatable(30)
    @given(scene=scenes())
    def spoil(scene: Scene) -> None:
        model = scene.declare()
        scene.twin.jumps = in_order(scene, model) if name == "inclusions" else []
        for names in arrays:
            try:
                run = simulate(model)
            except StepError:
                return
            if spoiled(run, names, 1e-5):
                try:
                    judge(scene, run)
                    seen.append(False)
                except AssertionError:
                    seen.append(True)

    spoil()
    assert len(seen) > 30
    assert np.mean(seen) > 0.95
