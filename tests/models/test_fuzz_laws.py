"""Random first-order and Lur'e systems with laws of every kind: every step right, and two runs never further apart."""

from __future__ import annotations

from collections import Counter
from typing import Any

import fuzz_models as models
import numpy as np
import pytest
from fuzz_judges import (
    ROUND_OFF,
    TOLERANCE,
    balance,
    box_misfit,
    carried,
    curved_misfit,
    multiplier_size,
    onto_ball,
    onto_cone,
    polyhedron_misfit,
    ratio,
)
from fuzz_models import COUNT, FULL, Scene, repeatable
from hypothesis import given

from nsmodel import StepError, Trajectory, simulate

stopped: Counter[str] = Counter()


def judge(scene: Scene, run: Trajectory) -> None:
    """M (x+ - x) = h theta f+ + h (1 - theta) f + h G l, y = C (x+ - a) + D l + kappa l^3, and the law on (l, y)."""
    twin, h, t, old, x, l = scene.twin, run.step[1:, None], run.t[1:], run.x[:-1], run.x[1:], run.multipliers[1:]
    (f_0, size_0), (f, size) = twin.f(run.t[:-1], old), twin.f(t, x)
    pressed, bound = np.abs(l), bounds_of(twin)
    if twin.phi is not None and twin.phi[0] == 2:  # the sum of a smooth part and another
        pressed = pressed + twin.phi[1][1] * twin.phi[2] ** 2 * np.abs(run.y[1:])
    dx, ahead, behind = x - old, h * twin.theta * f, h * (1 - twin.theta) * f_0
    parts = [dx @ twin.M.T, -ahead, -behind, -h * (l @ twin.C)]
    moved = np.abs(dx) @ np.abs(twin.M.T) + np.abs(ahead) + np.abs(behind) + h * (pressed @ np.abs(twin.C))
    J = twin.M - h[..., None] * twin.theta * twin.f_x(x)
    terms = (np.abs(x) + np.abs(old)) @ np.abs(twin.M.T) + h * (size + size_0) + moved
    moved += np.abs(h[..., None] * twin.theta * twin.f_x(x)) @ np.abs(dx)[..., None] @ [1.0]
    terms = carried(J, terms)
    assert balance(parts, moved, terms) <= 1
    place = twin.a * np.cos(t / twin.tau)[:, None]
    bend = twin.kappa * (l / twin.U) ** 3 / twin.U
    y = (x - place) @ twin.C.T + l @ twin.D.T + bend
    with np.errstate(all="ignore"):
        felt = np.linalg.inv(J)
    slope = np.eye(len(twin.U)) * (3 * twin.kappa * (l / twin.U) ** 2 / twin.U**2)[:, None, :]
    W = h[..., None] * twin.C @ felt @ twin.C.T + twin.D + slope
    drive = np.einsum("kij,kj->ki", np.abs(W), np.abs(l))
    seen = np.abs(felt) @ terms[..., None] @ [1.0] + np.abs(x) + np.abs(place)
    rounding = seen @ np.abs(twin.C.T) + np.einsum("kij,kj->ki", np.abs(W), pressed + bound) + np.abs(bend)
    size_y = np.abs(y - np.einsum("kij,kj->ki", W, l)) + drive + ROUND_OFF / TOLERANCE * rounding
    if twin.blocks:
        judge_law(twin.blocks, l, y, multiplier_size(l, bound, np.abs(W).max(axis=2)), size_y)
    else:
        judge_potential(twin.phi, l, y, size_y)


def bounds_of(twin: Any) -> np.ndarray:
    """The largest finite bound of each multiplier."""
    if twin.phi is not None:
        return np.full(len(twin.U), twin.phi[1][0] * twin.phi[2])
    ends = [(np.where(np.isfinite(end), np.abs(end), 0.0) for end in (block.lower, block.upper)) for block in twin.blocks]
    return np.concatenate([np.maximum(*pair) for pair in ends])


def judge_law(blocks: list[models.LawBlock], l: np.ndarray, y: np.ndarray, size_l: np.ndarray, size_y: np.ndarray) -> None:
    for block in blocks:
        l_b, y_b, size_l_b, size_y_b = (part[:, block.rows] for part in (l, y, size_l, size_y))
        if block.kind == "ball":
            misfit = curved_misfit(lambda u, r=block.upper[0]: onto_ball(u, r), l_b, y_b, size_l_b, size_y_b)
        elif block.kind == "cone":
            misfit = curved_misfit(onto_cone, l_b, y_b, size_l_b, size_y_b)
        elif block.kind == "polyhedron":
            misfit = polyhedron_misfit(l_b, y_b, block.H, block.K, size_l_b, size_y_b)
        else:
            misfit = box_misfit(l_b, y_b, block.lower, block.upper, size_l_b, size_y_b)
        assert misfit.max(initial=0) <= 1, block.kind


def judge_potential(phi: tuple[int, np.ndarray, float], l: np.ndarray, y: np.ndarray, size_y: np.ndarray) -> None:
    """l in -dPhi(y) by Fenchel and Young: Phi(y) + Phi*(-l) + <l, y> = 0, in natural units; Phi* is an indicator."""
    kind, (a, b), u = phi
    s, z, size = -l / u, u * y, u * size_y
    if kind == 2:
        s = s - b * z  # the smooth part of Phi
    value, dual = {
        0: lambda: (np.abs(z).sum(axis=1), np.abs(s).max(axis=1)),
        1: lambda: (np.linalg.norm(z, axis=1), np.linalg.norm(s, axis=1)),
        2: lambda: (np.abs(z).max(axis=1), np.abs(s).sum(axis=1)),
        3: lambda: (np.maximum(z.max(axis=1), 0), np.maximum(s.sum(axis=1), a - s.min(axis=1))),
    }[kind]()
    total = size.sum(axis=1)
    assert (dual <= a + TOLERANCE * (a + b * total)).all()
    assert ratio(a * value - (s * z).sum(axis=1), a * total).max(initial=0) <= TOLERANCE


def judge_contraction(scene: Scene, run: Trajectory, other: Trajectory) -> None:
    """Two runs in the norm of P = M (implicit Euler): |x - x~|_P does not grow, and -h <f - f~, x - x~> is paid by it."""
    twin, apart, h = scene.twin, run.x - other.x, run.step[1:]
    square = np.einsum("ki,ij,kj->k", apart, twin.M, apart)
    f, f_other = twin.f(run.t, run.x)[0], twin.f(run.t, other.x)[0]
    lost = -2 * h * ((f - f_other) * apart).sum(axis=1)[1:]
    l = np.abs(run.multipliers[1:]) + np.abs(other.multipliers[1:])
    place = np.abs(run.x) + np.abs(other.x)
    power = np.abs(apart[1:]) * (
        (place[1:] + place[:-1]) @ np.abs(twin.M.T)
        + h[:, None] * (l @ np.abs(twin.C) + twin.f(run.t[1:], run.x[1:])[1] + twin.f(run.t[1:], other.x[1:])[1])
    )
    assert (square[1:] + lost <= square[:-1] + 10 * TOLERANCE * power.sum(axis=1) + ROUND_OFF * square[:-1]).all()


def verify(name: str, scene: Scene) -> None:
    model = scene.declare()
    try:
        run = simulate(model)
        other: Any = simulate(model, parameters=models.named(scene.twin.starts[1])) if scene.twin.theta == 1 else None
    except StepError as error:
        stopped[name] += 1
        run, other = error.trajectory, None
    assert run.metadata["warnings"] == []
    if len(run):
        judge(scene, run)
    if other is not None:
        judge_contraction(scene, run, other)


@repeatable(COUNT)
@given(scene=models.first_order())
def first_order(scene: Scene) -> None:
    verify("first_order", scene)


@repeatable(COUNT)
@given(scene=models.lure())
def lure(scene: Scene) -> None:
    verify("lure", scene)


def test_first_order_systems():
    first_order()
    assert stopped["first_order"] <= FULL / 100


def test_lure_systems():
    lure()
    assert stopped["lure"] <= FULL / 100


@pytest.mark.long
@pytest.mark.parametrize("scenes", [models.first_order, models.lure])
def test_a_wrong_step_is_seen(scenes):
    seen: list[bool] = []

    @repeatable(30)
    @given(scene=scenes())
    def spoil(scene: Scene) -> None:
        for name in ("x", "multipliers"):
            try:
                run = simulate(scene.declare())
            except StepError:
                return
            change = 1e-5 * np.ptp(np.nan_to_num(run.arrays[name]), axis=0)
            run.arrays[name][-1] += change
            if (change > 1e-14 * np.abs(run.arrays[name][-1])).any():
                try:
                    judge(scene, run)
                    seen.append(False)
                except AssertionError:
                    seen.append(True)

    spoil()
    assert len(seen) > 30
    assert np.mean(seen) > 0.95
