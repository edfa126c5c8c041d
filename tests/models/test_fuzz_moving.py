"""Random monotone inclusions that depend on time, by both schemes: the judge's definitions, C beside Python, order one."""

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import MonotoneInclusion, StepError, simulate
from nsmodel.errors import CodegenError
from nsmodel.study.reference_steps import formula_residuals

COUNT = share(160)


def waving(rng, t, size):
    """A number that moves: constant, linear or a wave."""
    a, w = size * rng.normal(), rng.uniform(0.3, 3)
    return [a, a * t / 2, a * ca.sin(w * t + rng.uniform(0, 6))][rng.integers(3)]


def random_model(seed, scheme, *, riding=True):
    """A field and an operator that are monotone; a box, a half-plane or both that move and hold 0 with room.

    ``riding``: whether the switching surface moves too.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    x, t = ca.SX.sym("x", n), ca.SX.sym("t")
    skew, root = rng.normal(size=(2, n, n))
    K = root @ root.T / n + skew - skew.T
    b = ca.vertcat(*(waving(rng, t, 2.0) for _ in range(n)))
    kind = rng.integers(4)
    operator = None
    if kind in (1, 3):
        P = rng.integers(-1, 2, (1, n)) + np.eye(n)[:1]
        operator = rng.uniform(0.2, 2) * ca.DM(P.T) @ ca.sign(ca.DM(P) @ x - waving(rng, t, 0.2) * riding)
    if kind in (2, 3):
        operator = (0 if operator is None else operator) + (2 + waving(rng, t, 0.5)) * x
    walls = {}
    if rng.random() < 0.6:
        walls["lower"] = ca.vertcat(*(-rng.uniform(0.5, 1.5) + 0.4 * ca.sin(waving(rng, t, 1.0)) for _ in range(n)))
        walls["upper"] = ca.vertcat(*(rng.uniform(0.5, 1.5) + 0.4 * ca.sin(waving(rng, t, 1.0)) for _ in range(n)))
    if not walls or rng.random() < 0.4:
        angle = rng.uniform(0, 6) + waving(rng, t, 1.0)
        normal = ca.vertcat(ca.cos(angle), ca.sin(angle), 0)[:n] if n > 1 else ca.SX(1)
        walls["constraints"] = {"plane": 0.6 + 0.3 * ca.sin(waving(rng, t, 1.0)) + ca.dot(normal, x)}
    return MonotoneInclusion(
        x=x, t=t, field=b - ca.DM(K) @ x, operator=operator, x0=np.zeros(n), t_end=2.0, step=0.02, scheme=scheme, **walls
    )


@pytest.mark.parametrize("scheme", MonotoneInclusion.schemes)
@pytest.mark.parametrize("seed", range(COUNT))
def test_every_step_is_right_by_its_definition(seed, scheme):
    model = random_model(seed, scheme).bind()
    run = simulate(model, compiled=False)
    found = formula_residuals(model, run)
    assert run.status == "done"
    assert max(found.values()) <= 1, found
    if seed % 8 == 0:
        try:
            in_c = simulate(model, compiled=True)
        except CodegenError as error:
            assert "has no counterpart in C" in str(error)  # noqa: PT017
        else:
            assert max(formula_residuals(model, in_c).values()) <= 1
            if scheme == "implicit":  # an explicit sign at 0 is decided by the last bit
                assert np.abs(in_c.x - run.x).max() <= 1e-10 * (1 + np.abs(run.x).max())


@pytest.mark.parametrize("scheme", MonotoneInclusion.schemes)
@pytest.mark.parametrize("seed", range(1000, 1000 + max(COUNT // 8, 1)))
def test_shorter_steps_lead_to_one_limit(seed, scheme):
    """The schemes differ by O(h), and each from itself at half the step by half of that, or by less."""
    ends, others = [], dict(zip(MonotoneInclusion.schemes, reversed(MonotoneInclusion.schemes), strict=True))
    for step in (4e-3, 2e-3, 1e-3):
        run = simulate(random_model(seed, scheme, riding=False), step=step, compiled=False)
        ends.append(run.x[-1])
    other = simulate(random_model(seed, others[scheme], riding=False), step=1e-3, compiled=False)
    size = 1 + np.abs(ends).max()
    assert np.abs(ends[2] - ends[1]).max() <= max(0.8 * np.abs(ends[1] - ends[0]).max(), 0.02 * size)
    assert np.abs(other.x[-1] - ends[2]).max() <= 0.05 * size


@pytest.mark.parametrize("scheme", MonotoneInclusion.schemes)
def test_a_set_that_shrinks_to_nothing_stops_the_run(scheme):
    x, t = ca.SX.sym("x", 2), ca.SX.sym("t")
    model = MonotoneInclusion(
        x=x, t=t, field=[0.1, 0], x0=[0, 0], constraints={"below": 1 - t - x[0], "above": x[0] + 1 - t}, t_end=2, step=0.01,
        scheme=scheme,
    )  # fmt: skip
    with pytest.raises(StepError) as stopped:
        simulate(model, compiled=False)
    assert 0.9 <= stopped.value.trajectory.t[-1] <= 1.02
