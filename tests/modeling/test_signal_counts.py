"""Runs with more periods of a signal or a block than can be kept are refused by name, before they begin."""

import casadi as ca
import pytest

from nsmodel import LureSystem, UsageError, pwm, relay, simulate, table

U = ca.SX.sym("u")
SIGNALS = {"pwm": pwm(duty=0.4, period=1e-6), "table": table([0, 1e-6], [[0.0], [1.0]], after="periodic", period=2e-6)}


@pytest.mark.parametrize("options", [{"rtol": 1e-6}, {"step": 1e3}])
@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("t_end", [1e3, 1e14])
def test_too_many_periods_are_refused(name, t_end, options):
    model = LureSystem(A=[[-1]], B=[1], C=[1], f=[U], law=relay(1), x0=[1], inputs={U: SIGNALS[name]}, t_end=1.0, step=0.1)
    with pytest.raises(UsageError, match=r"periods of .*, whose times are made before the run begins .*; at most 50,000,000"):
        simulate(model, t_end=t_end, **options)
