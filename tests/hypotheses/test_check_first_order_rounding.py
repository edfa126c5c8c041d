"""Steps at which W is singular but for rounding."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, check, relay


def growing(h: float, a: float) -> FirstOrderSystem:
    """z' = a z + l: W = 1 - h a."""
    z, l = ca.SX.sym("z"), ca.SX.sym("l")
    return FirstOrderSystem(x=z, lam=l, f=a * z, h=z, g=l, law=relay(1), x0=[1], t_end=1, step=h, theta=1.0, gamma=1.0)


@pytest.mark.parametrize(("h", "a"), [(0.05, 20), (0.1, 10), (0.3, 10 / 3), (0.7, 1 / 0.7)])
def test_a_step_at_the_critical_one_up_to_rounding_is_no_proof(h, a):
    report = check(growing(h, a), [])
    exactly = 1 - Fraction(h) * Fraction(a)
    for id in ("F-W", "F-step"):
        assert report[id].verdict == ("sampled" if exactly else "violated")
        assert "rounding" in report[id].how or not exactly
    assert report["F-mlcp"].verdict == ("sampled" if exactly else "unknown")


def test_a_step_where_w_is_exactly_singular_is_one():
    report = check(growing(0.0625, 16), [])
    assert report["F-W"].verdict == report["F-step"].verdict == "violated"


def test_steps_apart_from_the_critical_one_are_decided():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, away = rng.uniform(1, 30), rng.choice([-1, 1]) * 10.0 ** rng.uniform(-8, -1)
        report = check(growing((1 - away) / a, a), [])
        assert report["F-W"].verdict == "holds"
        assert report["F-step"].verdict == ("holds" if away > 0 else "violated")
