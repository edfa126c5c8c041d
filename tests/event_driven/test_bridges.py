"""Bridges, multipliers and ladders of ideal diodes go by pieces: against closed forms, and against time steps of two sizes.

Several phases are equal at the start, all is at rest, currents freewheel through all diodes, lines have no coils, nodes no way to
ground, diodes in loops share a current. l is one of several there, x is unique.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest

from nsmodel import LureSystem, complementarity, simulate
from nsmodel.errors import StepError
from tests.circuit_models import Element, T, bridge, circuit, multiplier

ROUNDING = 1e-12  # Of the largest state: a smaller one that is 0 is that of what the largest pushes it by.


def pieces(model: LureSystem, rtol: float = 1e-8, **given: Any) -> Any:
    return simulate(model, rtol=rtol, method="event-driven", **{"compiled": False} | given)


def stepped_end(elements: list[Element], t_end: float, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The end by time steps extrapolated, by what that differs, and the largest of each state."""
    ends, sizes = [], []
    for number in (steps, 2 * steps):
        run = simulate(circuit(elements, t_end=t_end, step=t_end / number), method="time-stepping", compiled=True)
        ends.append(run.x[-1])
        sizes.append(np.abs(run.x).max(axis=0))
    return 2 * ends[1] - ends[0], np.abs(ends[1] - ends[0]), np.maximum(sizes[1], 1e-9 * sizes[1].max() + 1e-9)


def agrees_with_steps(elements: list[Element], t_end: float, steps: int = 4000) -> Any:
    end, estimate, size = stepped_end(elements, t_end, steps)
    run = pieces(circuit(elements, t_end=t_end, step=t_end / steps))
    assert run.status == "done"
    assert not [text for text in run.metadata["warnings"] if "the law is missed" in text]
    off = np.maximum(np.abs(run.x[-1] - end) - ROUNDING * size.max(), 0.0)
    assert (off / size).max() <= 2 * (estimate / size).max() + 1e-6
    assert not run.metadata["totals"].get("stretches")
    return run


@pytest.mark.parametrize("pulses", [2, 3, 6])
@pytest.mark.parametrize("coil", [0.0, 3e-3])
@pytest.mark.parametrize("start", [0.0, 5.0])
def test_bridges_from_equal_phases(pulses, coil, start):
    agrees_with_steps(bridge(pulses, coil=coil, start=start), 0.02)


@pytest.mark.parametrize("current", [5.0, 50.0])
def test_commutation_takes_the_time_of_its_formula(current):
    """cos mu = 1 - 2 w L I/(sqrt(3) V): a load that draws a constant current, six pulses; the overlap of each is that angle."""
    elements = [*bridge(3)[:-2], ("L", "p", "m", 1e9, current)]
    run = pieces(circuit(elements, t_end=0.03, step=1e-5))
    times = np.array([event.t for event in run.events if event.t > 0.01])
    overlap = math.acos(1 - 2 * 100 * math.pi * 3e-3 * current / (math.sqrt(3) * 325)) / (100 * math.pi)
    gaps = np.diff(times)
    assert len(times) >= 10
    assert np.minimum(np.abs(gaps - overlap), np.abs(gaps - (0.02 / 6 - overlap))).max() <= 1e-9
    assert (np.abs(gaps - overlap) <= 1e-9).sum() >= 5


@pytest.mark.parametrize("stages", [1, 3, 4])
@pytest.mark.parametrize("phase", [0.0, 0.05])
def test_multipliers_at_rest(stages, phase):
    agrees_with_steps(multiplier(stages, phase), 0.002)


def ladder(rng: np.random.Generator) -> list[Element]:
    """Sections of resistors, coils and diodes in a row, each with capacitors, resistors or diodes to ground."""
    source = 100 * ca.sin(2000 * math.pi * T + rng.choice([0.0, math.pi / 2, math.pi / 6]))
    elements: list[Element] = [("V", "n0", 0, source)]
    for k in range(int(rng.integers(2, 6))):
        a, b, middle = f"n{k}", f"n{k + 1}", f"m{k}"
        along, down = ((a, b), (b, 0)) if rng.random() < 0.5 else ((b, a), (0, b))
        elements += [
            [("R", a, b, 10.0)], [("L", a, b, 1e-3)], [("R", a, middle, 1.0), ("L", middle, b, 1e-3)], [("D", *along)],
            [("R", a, b, 1.0), ("C", b, 0, 1e-7)],
        ][int(rng.integers(5))]  # fmt: skip
        elements += [
            [("C", b, 0, 1e-6)], [("R", b, 0, 10.0)], [("D", *down)], [("C", b, 0, 1e-5), ("R", b, 0, 100.0)],
            [("D", *down), ("R", b, 0, 100.0)],
        ][int(rng.integers(5))]  # fmt: skip
    return elements


def drawn(seed: int) -> tuple[list[Element], float]:
    """A random circuit and how long it runs."""
    rng = np.random.default_rng([seed, 55])
    kind = rng.choice(["bridge", "multiplier", "ladder", "ladder"])
    if kind == "bridge":
        pulses = int(rng.integers(2, 8))
        phase, coil = rng.choice([0.0, math.pi / 6, math.pi / pulses, 0.3]), rng.choice([0.0, 3e-3, 1e-4])
        return bridge(pulses, phase, coil, (rng.choice([2.0, 0.02]), 10.0), rng.choice([0.0, 5.0])), 0.02
    if kind == "multiplier":
        load, source = rng.choice([1e6, 1e4, 1e3]), rng.choice([1.0, 10.0, 0.1])
        return multiplier(int(rng.integers(1, 4)), rng.choice([0.0, 0.05]), source, load), 0.002
    return ladder(rng), 0.002


@pytest.mark.parametrize("seed", range(60))
def test_random_circuits(seed):
    elements, t_end = drawn(seed)
    if not any(kind in "LC" for kind, *_ in elements) or not any(kind == "D" for kind, *_ in elements):
        pytest.skip("no state, or no diode")
    try:
        stepped_end(elements, t_end, 400)
    except StepError:
        pytest.skip("a diode that shorts the source: no solution")
    agrees_with_steps(elements, t_end)


@pytest.mark.parametrize("D", [0.0, 1e-12, 1e-9, 1e-6])
def test_a_nearly_ideal_diode_is_the_ideal_one(D):
    t = ca.SX.sym("t")
    model = LureSystem(
        t=t, A=[[0]], B=[[1]], C=[[1]], D=[[D]], f=[2 * ca.cos(t)], law=complementarity(1), x0=[0], t_end=20, step=1e-2
    )
    assert pieces(model, 1e-6).x[-1, 0] == pytest.approx(3.8258905, abs=1e-5)


@pytest.mark.parametrize("scales", [(1.0, 1.0), (1e6, 1e-9), (1e9, 1e-9), (1e-9, 1e9)])
@pytest.mark.parametrize(("D", "compiled"), [(0.0, False), (0.1, False), (0.1, True)])
def test_rows_that_do_not_touch_do_not_hide_each_other(scales, D, compiled):
    """Two circuits in one model: each goes as the one alone, whatever the other's units are."""
    t, at = ca.SX.sym("t"), np.linspace(0.1, 20, 200)
    pushes, decays = [ca.cos(t), ca.cos(3 * t + 0.4)], [-0.3, -0.7]

    def model(own: list[int]) -> LureSystem:
        n, size = len(own), [scales[k] if len(own) > 1 else 1.0 for k in own]
        return LureSystem(
            t=t, A=np.diag([decays[k] for k in own]), B=np.eye(n), C=np.eye(n), D=D * np.eye(n),
            f=[a * pushes[k] for a, k in zip(size, own, strict=True)], law=complementarity(n), x0=np.zeros(n),
            t_end=20, step=1e-2,
        )  # fmt: skip

    both = pieces(model([0, 1]), 1e-6, compiled=compiled).at(at).x / np.array(scales)
    for k in (0, 1):
        assert np.abs(both[:, k] - pieces(model([k]), 1e-10).at(at).x[:, 0]).max() <= 1e-5
