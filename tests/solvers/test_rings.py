"""Rings of genes that switch one another off: the diagonal of W is 0, and no multiplier of its own holds a row that switches."""

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, relay, simulate
from nsmodel.solvers import active_set, mlcp
from nsmodel.solvers.residuals import NumericLaw
from nsmodel.solvers.time_stepper import Stepper

GENES = [3, 4, 5, 7, 9]


def ring(n, **options):
    """x_i' = -x_i + 2 (1 - l_(i-1)), l_i = 1 where x_i > 1: a gene is made while the one before it is scarce."""
    x, l = ca.SX.sym("x", n), ca.SX.sym("l", n)
    given = {"t_end": 20.0, "step": 1e-2, "theta": 1.0} | options
    x0 = np.random.default_rng(n).uniform(0.2, 1.8, n).tolist()
    return FirstOrderSystem(
        x=x, lam=l, f=-x, g=[2 * (1 - l[i - 1]) for i in range(n)], h=[1 - x[i] for i in range(n)], law=relay(n, 0, 1), x0=x0,
        **given,
    )  # fmt: skip


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("n", GENES)
def test_rows_of_a_ring_keep_the_formulas_of_their_steps(n, compiled):
    run = simulate(ring(n), compiled=compiled)
    x, l, h = run.x, run.multipliers[1:], 1e-2
    assert np.abs(x[1:] - x[:-1] - h * (2 * (1 - np.roll(l, 1, axis=1)) - x[1:])).max() <= 1e-9
    assert (l == np.where(x[1:] > 1, 1.0, np.where(x[1:] < 1, 0.0, l))).all()
    assert (run.index_set[2:] != run.index_set[1:-1]).any()


@pytest.mark.parametrize("n", GENES)
def test_switches_of_a_ring_need_no_interpreted_step(n, monkeypatch):
    def refuse(*args):
        raise AssertionError("a step was left to the interpreted solvers")

    simulate(ring(n), compiled=True)
    monkeypatch.setattr(Stepper, "_step", refuse)
    assert simulate(ring(n), compiled=True).status == "done"


@pytest.mark.parametrize("n", GENES)
def test_an_index_set_that_the_step_itself_calls_for_is_judged_once(n, monkeypatch):
    def refuse(*args):
        raise AssertionError("W and b were asked as well")

    expected = simulate(ring(n), compiled=False)
    monkeypatch.setattr(mlcp, "affine_law_residual", refuse)
    run = simulate(ring(n), compiled=False)
    assert all(np.array_equal(run.arrays[name], column, equal_nan=True) for name, column in expected.arrays.items())


@pytest.mark.parametrize("seed", range(20))
def test_a_row_that_no_multiplier_holds_goes_to_its_end(seed):
    """The law holds row by row: y = 0 where l is inside, and of the right sign at an end."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    W, law = np.roll(np.diag(rng.uniform(0.5, 2, n)), 1, axis=0) * 1e-2, NumericLaw(np.zeros(n), np.ones(n), ())
    b, last = rng.uniform(-1, 1, n) * 10.0 ** rng.integers(-3, 1, n), rng.choice([-1, 1], n).astype(np.int8)
    found = active_set.primal_dual_active_set(W, b, law, last)
    assert found is not None
    l, index = found
    y = W @ l + b
    assert ((l >= 0) & (l <= 1)).all()
    assert np.abs(np.where(l == 0, np.minimum(y, 0), np.where(l == 1, np.maximum(y, 0), y))).max() <= 1e-16
    assert (np.where(index < 0, l, np.where(index > 0, l - 1, 0)) == 0).all()
