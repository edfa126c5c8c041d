"""Diodes and relays that are ideal but for a tiny resistance: as right, and about as quick, as without one, whatever D is."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from nsmodel import LureSystem, complementarity, simulate

t = ca.SX.sym("t")
SMALL_D = [1e-16, 1e-15, 1e-14, 1e-13, 1e-12, 1e-10, 1e-8, 1e-6]


def pieces(model: LureSystem, rtol: float, **given: Any) -> Any:
    return simulate(model, rtol=rtol, method="event-driven", **{"compiled": False} | given)


@pytest.fixture(params=[False, True], ids=["interpreted", "compiled"])
def compiled(request) -> bool:
    return request.param


@pytest.mark.parametrize("D", SMALL_D)
@pytest.mark.parametrize("rtol", [1e-6, 1e-10])
def test_one_diode_is_its_closed_form(D, rtol, compiled):
    """While it conducts x = -D l is the slow motion of x' = 2 cos t - x/D; afterwards x = 2 sin t + 2 + O(D)."""
    model = LureSystem(
        t=t, A=[[0]], B=[[1]], C=[[1]], D=[[D]], f=[2 * ca.cos(t)], law=complementarity(1), x0=[0], t_end=10, step=1e-2
    )
    run = pieces(model, rtol, compiled=compiled)
    at, later = np.linspace(3.5, 4.5, 201), np.linspace(5, 10, 201)
    l = 2 * (np.cos(at) + D * np.sin(at)) / (1 + D**2)
    assert np.abs(run.at(at).multipliers[:, 0] + l).max() <= 100 * rtol
    assert np.abs(run.at(later).x[:, 0] - (2 * np.sin(later) + 2)).max() <= 10 * rtol + 20 * D
    assert len(run.arrays["piece_start"]) <= 100
