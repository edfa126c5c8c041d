"""Diodes and relays that are ideal but for a tiny resistance: as right, and about as quick, as without one, whatever D is."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from nsmodel import LureSystem, complementarity, simulate
from nsmodel.codegen import library
from tests.circuit_models import Element, circuit, multiplier

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


def resistive(elements: list[Element], resistance: float) -> list[Element]:
    """The circuit whose diodes have a resistance."""
    return [(*e[:3], resistance) if e[0] == "D" else e for e in elements]


@pytest.mark.parametrize("resistance", [1e-15, 1e-12, 1e-9, 1e-7])
@pytest.mark.parametrize("phase", [0.0, 0.05])
def test_diodes_of_a_multiplier_with_a_tiny_resistance(resistance, phase):
    """Its capacitors are charged within 1e-15 s: after each switch l = -y/D is rounding, and pieces by collocation know l.

    The charge that a resistance R holds back decays within R C: the end is that of ideal diodes, to R beside the source's.
    """
    elements, given = multiplier(2, phase, source=10.0, load=1e4), {"t_end": 1e-3, "step": 1e-6}
    ideal = pieces(circuit(elements, **given), 1e-9)
    run = pieces(circuit(resistive(elements, resistance), **given), 1e-6)
    size = np.abs(ideal.x).max()
    assert np.abs(run.x[-1] - ideal.x[-1]).max() <= (2e-6 + 10 * resistance) * size
    assert len(run.arrays["piece_start"]) <= 1000
    # No row is on the wrong side: what is hidden of an event by rounding would be.
    assert np.nanmin(run.y[:, :4]) >= -1e-7 * size


@pytest.mark.skipif(not library.compiler(), reason="no C compiler")
def test_tiny_resistances_in_c():
    """C leaves modes whose l rounding hides to the integrator."""
    elements, given = multiplier(2, 0.05, source=10.0, load=1e4), {"t_end": 5e-4, "step": 1e-6}
    run, other = (pieces(circuit(resistive(elements, 1e-9), **given), 1e-6, compiled=way) for way in (True, False))
    assert np.abs(run.x[-1] - other.x[-1]).max() <= 2e-6 * np.abs(other.x).max()


@pytest.mark.skipif(not library.compiler(), reason="no C compiler")
def test_a_run_that_c_leaves_to_the_integrator_goes_on_byte_for_byte(tmp_path):
    """Its collocated pieces are counted by both: a count is a whole number in the files."""
    model = circuit(resistive(multiplier(2, 0.05, source=10.0, load=1e4), 1e-7), t_end=4e-4, step=1e-6)
    pieces(model, 1e-6, compiled=True, out=tmp_path / "one")
    for i, end in enumerate([0.1, 0.21, 0.5, 1.0]):
        pieces(model, 1e-6, compiled=True, out=tmp_path / "parts", t_end=end * model.t_end, resume=i > 0)
    one, parts = (
        {path.name: path.read_bytes() for path in (tmp_path / name).rglob("*") if path.is_file()} for name in ("one", "parts")
    )
    assert one == parts
