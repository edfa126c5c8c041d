"""Stiff scenes, other units, tiny and huge steps: the same answer, whatever the numbers' size."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    UsageError,
    check,
    complementarity,
    relay,
    simulate,
)
from nsmodel.modeling.laws import Law
from nsmodel.study.units import in_units as units_of_package
from tests.solvers.test_agreement import MONOTONE, NOT_MONOTONE, Stretch

T, Q, X, LAM, S = (ca.SX.sym(name) for name in ("t", "q", "x", "l", "s"))
Q2 = ca.SX.sym("q", 2)


def soft(u, a):
    """The prox of a|.|."""
    return np.sign(u) * np.maximum(np.abs(u) - a, 0)


# ---------------------------------------------------------------------------------------------- 2. stiff rectifier


C1, C2, R1, R2, r = 1e-9, 1.0, 1.0, 2.0, 1e-3
RECTIFIER = {
    "A": [[-1 / (R1 * C1), 0], [0, -1 / (R2 * C2)]], "B": [-1 / C1, 1 / C2], "C": [[-1, 1]], "D": r, "law": complementarity(1),
}  # fmt: skip


@pytest.mark.parametrize("h", [1e-10, 1e-6, 1e-3, 1e-1])
def test_stiff_rectifier_under_a_sine(h):
    """Time constants 1e-9 and 1: each step is the better of two linear systems, one for each state of the diode."""
    A, B, C = (np.array(ca.DM(part)) for part in (RECTIFIER["A"], RECTIFIER["B"], RECTIFIER["C"]))
    period = 40 * h
    source = ca.sin(2 * np.pi * T / period) / (R1 * C1)
    run = simulate(LureSystem(t=T, f=[source, 0], x0=[0, 0], t_end=80 * h, step=h, **RECTIFIER))
    assert run.metadata["warnings"] == []
    x, blocked = np.zeros(2), 0
    for k in range(80):
        f = np.array([np.sin(2 * np.pi * (k + 1) * h / period) / (R1 * C1), 0])
        scale = np.diag([C1 / (h + C1), 1.0])  # rows of size 1
        M = np.block([[scale @ (np.eye(2) - h * A), -h * scale @ B], [C, np.array([[r]])]])
        right = np.concatenate([scale @ (x + h * f), [0]])
        open_x = np.linalg.solve(M[:2, :2], right[:2])
        conducting = np.linalg.solve(M, right)
        is_open = (C @ open_x)[0] >= 0
        assert is_open or conducting[2] >= 0
        x, l = (open_x, 0.0) if is_open else (conducting[:2], conducting[2])
        blocked += is_open
        np.testing.assert_allclose(run.x[k + 1], x, rtol=1e-9, atol=1e-14)
        assert run.multipliers[k + 1, 0] == pytest.approx(l, rel=1e-8, abs=1e-14)
        if is_open:
            assert run.x[k + 1, 1] == pytest.approx(run.x[k, 1] / (1 + h / (R2 * C2)), rel=1e-12)
    assert 10 < blocked < 70


@pytest.mark.parametrize("h", [1e-10, 1e-8, 1e-5, 1e-2, 1.0])
def test_a_blocked_rectifier_discharges_at_its_slow_rate_alone(h):
    """v2 = exp(-t/(R2 C2)): the error is that of the slow rate, up to steps of 1e9 times the fast constant."""
    run = simulate(LureSystem(x0=[-1, 1], t_end=80 * h, step=h, **RECTIFIER))
    tau = R2 * C2
    np.testing.assert_array_equal(run.multipliers[1:], 0)
    np.testing.assert_allclose(run.x[:, 1], (1 + h / tau) ** -np.arange(81.0), rtol=1e-13)
    np.testing.assert_allclose(run.x[:, 1], np.exp(-run.t / tau), atol=0.3 * h / tau + 1e-14)
    np.testing.assert_allclose(run.x[:, 0], -((1 + h / (R1 * C1)) ** -np.arange(81.0)), rtol=1e-10, atol=1e-300)


def test_the_check_of_a_stiff_rectifier_is_relative():
    """P = diag(C1, C2), of condition 1e9, has P B = C' and P A + A'P = -2 diag(1/R1, 1/R2); what is found obeys the same."""
    report = check(LureSystem(x0=[-1, 1], t_end=1e-2, step=1e-3, **RECTIFIER))
    A, B, C = (np.array(ca.DM(RECTIFIER[name])) for name in "ABC")
    assert report["4.1"].verdict == "holds"
    for id in ("5.1", "5.2"):
        assert report[id].verdict == "holds"
        P = np.array(report[id].witness["P" if id == "5.1" else "P_omega"])
        np.testing.assert_allclose(P @ B, C.T, rtol=1e-8)
        unit = np.diag(P) ** -0.5
        assert np.linalg.eigvalsh(unit[:, None] * P * unit).min() > 0
    omega = report["5.2"].value["omega"]
    excess = P @ A + A.T @ P - 2 * omega * P  # P of 5.2
    assert np.linalg.eigvalsh(unit[:, None] * excess * unit).max() <= 1e-6
    assert report["5.2"].value["cond P"] == pytest.approx(1e9, rel=1e-3)
    assert omega == pytest.approx(-1 / (R2 * C2), rel=1e-4)
    assert next(item for item in report.consequences if item.name == "globally asymptotically stable").verdict == "holds"


# ---------------------------------------------------------------------------------------------- 8. stiff oscillator


@pytest.mark.parametrize("friction", [0, 1e-12, 1.0, 1e12])
@pytest.mark.parametrize("periods", [1e-3, 1.0, 1000.0])
def test_stiff_oscillator_never_gains_energy(periods, friction):
    """w^2 = 1e8: E_{n+1} - E_n <= -h Phi(v); each step is a soft threshold."""
    h = periods * 2 * np.pi / 1e4
    options = {"friction": friction * S, "s": S} if friction else {}
    model = FrictionOscillator(x=X, potential=1e8 * X**2 / 2, **options, x0=1.0, v0=-3.0, t_end=200 * h, step=h)
    run = simulate(model)
    x, v, loss = 1.0, -3.0, np.diff(run.energy)
    for k in range(200):
        v = soft(v - h * 1e8 * x, h * friction) / (1 + h**2 * 1e8)
        x = x + h * v
        scale = max(abs(run.v[k, 0]), 1e-300)
        assert run.v[k + 1, 0] == pytest.approx(v, rel=1e-6, abs=1e-9 * scale)
        x, v = run.x[k + 1, 0], run.v[k + 1, 0]
    assert np.all(loss <= -h * friction * np.abs(run.v[1:, 0]) + 1e-12 * run.energy[:-1])
    if friction == 1e12:
        np.testing.assert_array_equal(run.v[1:], 0)
        np.testing.assert_array_equal(run.x, 1)


def decaying():
    """States that halve at each step, down to 0: through the smallest numbers that there are."""
    yield FirstOrderSystem(x=X, f=-X, x0=1, t_end=1200, step=1)
    yield LureSystem(A=-1, B=1, C=1, law=complementarity(1), x0=1, t_end=1200, step=1)
    yield FrictionOscillator(x=X, potential=X**2 / 2, friction=S**2, s=S, x0=1, v0=0, t_end=48000, step=10)
    yield MonotoneInclusion(x=X, field=-X / 2, lower=-1, x0=1, t_end=1200, step=1)
    yield SweepingProcess(q=Q, f=-Q / 2, constraints={"wall": Q}, q0=1, t_end=1200, step=1)


@pytest.mark.parametrize("at", range(5), ids=["first order", "Lur'e", "oscillator", "inclusion", "sweeping"])
def test_a_state_that_dies_out_ends_at_zero(at):
    """Below 1e-308 doubles lose their relative accuracy: no reason to stop."""
    run = simulate(list(decaying())[at])
    assert run.status == "done"
    assert abs(run.x[-1, 0]) < 1e-300
    assert run.x[0, 0] == 1


# ---------------------------------------------------------------------------------------------- 9. scales


def scaled_law(law, unit):
    return Law(tuple(b.with_numbers(**{name: value * unit for name, value in b.numbers.items()}) for b in law.blocks))


def in_units(model, u, tau):
    """The same model with states u times and times tau times as large; multipliers and outputs of laws u times.

    How signals and blocks move is tested in test_study_inputs.py.
    """
    model = model.bind()
    if model.inputs:
        return units_of_package(model, u, tau)

    def at(expression, *pairs):
        old, new = zip(*pairs, strict=True)
        return ca.substitute([ca.SX(expression)], list(old), list(new))[0]

    common = {"t": model.t, "t_end": model.t_end * tau, "step": model.step * tau, "names": model.names}
    kind, t = type(model), (model.t, model.t / tau)
    if kind is SweepingProcess:
        q = (model.q, model.q / u)
        constraints = {name: u * at(g, t, q) for name, g in model.constraints.items()}
        return kind(q=model.q, f=u / tau * at(model.f, t, q), constraints=constraints, q0=u * ca.DM(model.q0), **common)
    x = (model.x, model.x / u)
    start = {"x": model.x, "x0": u * ca.DM(model.x0)}
    if kind is FrictionOscillator:
        friction = {e.name: (e.H, u**2 / tau**3 * at(e.theta, (model.s, model.s * tau / u))) for e in model.elements}
        second = {"v0": u / tau * ca.DM(model.v0)} if model.x1 is None else {"x1": u * ca.DM(model.x1)}
        return kind(potential=(u / tau) ** 2 * at(model.potential, x), friction=friction, s=model.s, **start, **second, **common)
    if kind is FirstOrderSystem:
        l = (model.lam, model.lam / u)
        return kind(
            lam=model.lam, f=u / tau * at(model.f, t, x), h=u * at(model.h, t, x, l), g=u / tau * at(model.g, t, x, l), M=model.M,
            law=scaled_law(model.law, u), theta=model.theta, gamma=model.gamma, **start, **common,
        )  # fmt: skip
    if kind is LureSystem:
        return kind(
            A=u / tau * at(model.A, x), B=model.B / tau, C=model.C, D=model.D, f=u / tau * at(model.f, t),
            law=scaled_law(model.law, u), theta=model.theta, gamma=model.gamma, **start, **common,
        )  # fmt: skip
    potential = {"operator": u / tau * at(model.operator, x)}
    if model.phi is not None:
        potential = {"phi": u**2 / tau * at(model.phi, x)}
    bounds = {"lower": u * model.lower, "upper": u * model.upper}
    return kind(field=u / tau * at(model.field, x), **bounds, **potential, **start, **common)


@pytest.fixture(name="stretch_of", scope="module")
def make_stretch_of(load_case):
    """Return stretch_of(stem) -> (model, step, steps, run) of the first steps of a case."""

    @cache
    def stretch_of(stem):
        stretch: Stretch = (MONOTONE | NOT_MONOTONE)[stem]
        steps = min(stretch.steps, 60)
        model = load_case(stem, **(stretch.arguments if stem != "crowd_room" else {"n": 6}))
        return model, stretch.step, steps, simulate(model, step=stretch.step, t_end=stretch.step * steps)

    return stretch_of


UNITS = [(1e-9, 1.0), (1e9, 1.0), (1.0, 1e-9), (1.0, 1e9), (1e-9, 1e-9), (1e-9, 1e9), (1e9, 1e-9), (1e9, 1e9)]


@pytest.mark.parametrize("units", UNITS, ids=str)
@pytest.mark.parametrize("stem", MONOTONE | NOT_MONOTONE)
def test_units_do_not_matter(stem, units, stretch_of):
    """Every case in other units of state and time gives the scaled run, with the same index sets."""
    u, tau = units
    model, step, steps, reference = stretch_of(stem)
    run = simulate(in_units(model, u, tau), step=step * tau, t_end=step * steps * tau)
    size = np.abs(reference.x).max()
    np.testing.assert_allclose(run.x / u, reference.x, rtol=0, atol=1e-9 * size)
    np.testing.assert_allclose(run.t / tau, reference.t, rtol=1e-12)
    changed = (run.index_set != reference.index_set).any(axis=1)
    assert changed.sum() <= 0.05 * len(changed)  # a tie at a switch may fall to the other side
    assert run.metadata["warnings"] == reference.metadata["warnings"] or stem in NOT_MONOTONE


# ---------------------------------------------------------------------------------------------- 10. steps


def one_dimensional():
    """{class: (model with step 1, its exact step (x, v, h, t) -> (x, v))}."""
    yield (
        "sweeping",
        SweepingProcess(t=T, q=Q, f=-1, constraints={"wall": Q + 1}, q0=0.5, t_end=20, step=1),
        lambda x, v, h: (max(x - h, -1), 0),
    )

    def oscillate(x, v, h):
        v = soft(v - h * x, 0.3 * h) / (1 + h * h)
        return x + h * v, v

    yield (
        "oscillator",
        FrictionOscillator(x=X, potential=X**2 / 2, friction=0.3 * S, s=S, x0=2, v0=1, t_end=20, step=1),
        oscillate,
    )
    yield (
        "first order",
        FirstOrderSystem(x=X, lam=LAM, f=-1, h=X, g=LAM, law=complementarity(1), x0=0.5, t_end=20, step=1),
        lambda x, v, h: (max(x - h, 0), 0),
    )
    yield "Lur'e", LureSystem(A=-1, B=1, C=1, law=relay(1), x0=3, t_end=20, step=1), lambda x, v, h: (soft(x, h) / (1 + h), 0)
    yield (
        "inclusion",
        MonotoneInclusion(x=X, field=1 - X / 7, lower=-1, upper=2, x0=0.5, t_end=20, step=1),
        lambda x, v, h: (float(np.clip(x + h * (1 - x / 7), -1, 2)), 0),
    )


CLASSES = {name: (model, step) for name, model, step in one_dimensional()}


@pytest.mark.parametrize("h", [1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", CLASSES)
def test_steps_from_1e_minus_12_to_1e3_natural_times(name, h):
    model, step = CLASSES[name]
    run = simulate(model, step=h, t_end=20 * h)
    x, v = float(run.x[0, 0]), 1.0
    for k in range(20):
        x, v = step(x, v, h)
        assert run.x[k + 1, 0] == pytest.approx(x, rel=1e-12, abs=1e-14)
    assert run.residual[1:].max() <= 1e-9


@pytest.mark.parametrize("name", CLASSES)
def test_the_step_changes_by_a_factor_of_1e15_within_a_run(name):
    model, step = CLASSES[name]
    steps = np.tile([1e-12, 1e3, 1e-6, 1.0], 5) if name != "oscillator" else np.geomspace(1e-12, 1e3, 20)
    run = simulate(model, steps=steps)
    x, v, last = float(run.x[0, 0]), 1.0, None
    for k, h in enumerate(steps):
        if name == "oscillator":  # the older difference is divided by the new step
            v = v if last is None else v * last / h
            last = h
        x, v = step(x, v, h)
        assert run.x[k + 1, 0] == pytest.approx(x, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("bad", [0, -0.1, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", CLASSES)
def test_impossible_steps_are_refused_at_once(name, bad):
    model = CLASSES[name][0]
    for options, word in (({"step": bad}, "step"), ({"t_end": bad}, "t_end"), ({"steps": [0.1, bad]}, r"steps\[1\]")):
        with pytest.raises(UsageError, match=word):
            simulate(model, **options)
