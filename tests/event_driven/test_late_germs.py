"""Rows that begin alike and part at a high order: decided where the orders of germs see it, left to time steps beyond."""

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, StepError, complementarity, simulate


def parting(k):
    """x_0' = t^k + l_0 + l_1/2, x_1' = -t^k + l_0/2 + l_1 from rest: x_0 leaves at order k + 1, x_1 stays at 0."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    given = {"f": [t**k, -(t**k)], "g": [l[0] + l[1] / 2, l[1] + l[0] / 2], "h": [x[0], x[1]]}
    return FirstOrderSystem(t=t, x=x, lam=l, law=complementarity(2), x0=[0, 0], t_end=1.0, step=0.01, **given)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("k", range(2, 13))
def test_rows_that_part_late_are_right(k, compiled):
    run = simulate(parting(k), rtol=1e-8, compiled=compiled)
    np.testing.assert_allclose(run.x[-1], [1.5 / (k + 1), 0], rtol=1e-8, atol=1e-12)
    assert run.t[-1] == 1.0
    assert run.stepped.any() == (k > 5)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("k", [6, 9, 12])
def test_modes_that_part_beyond_the_germs_are_told(k, compiled):
    """Nothing accumulates there: no time goes by. So it is with one row, whose mode is known to be the only one."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("l")
    leaving = FirstOrderSystem(t=t, x=x, lam=l, f=[t**k], g=[l], h=[x], law=complementarity(1), x0=[0], t_end=1.0)
    for model in (parting(k), leaving):
        with pytest.raises(StepError, match=r"mode of l.* part beyond orders 0 to 6 .* method='auto'"):
            simulate(model, rtol=1e-8, method="event-driven", compiled=compiled)
