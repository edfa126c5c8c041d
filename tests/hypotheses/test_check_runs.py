"""Inequalities along runs: they hold on the runs of the cases, and a run that was tampered with is caught."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import FrictionOscillator, LureSystem, MonotoneInclusion, SweepingProcess, UsageError, check, relay, simulate

x, s = ca.SX.sym("x"), ca.SX.sym("s")


def tampered(run, **arrays):
    return replace(run, arrays={**run.arrays, **arrays})


def oscillator(**changes):
    given = {"potential": x**2 / 2, "friction": 0.3 * s, "s": s, "x0": 2, "v0": 0, "t_end": 8, "step": 0.05}
    return FrictionOscillator(x=x, **(given | changes))


def inclusion(**changes):
    given = {"field": 1 - x, "operator": x, "lower": 0, "x0": 2, "t_end": 2, "step": 0.02}
    return MonotoneInclusion(x=x, **(given | changes))


def disc():
    q = ca.SX.sym("q", 2)
    return SweepingProcess(q=q, f=[1, 0], constraints={"disc": ca.norm_2(q) - 1}, q0=[-1.5, 0.3], t_end=3, step=0.02)


# ---------------------------------------------------------------------------------------------- oscillators


def test_energy_of_a_run_and_of_one_that_gains_some():
    model = oscillator()
    run = simulate(model)
    report = check(model, [run])
    assert report["run-energy"].verdict == report["run-dissipated"].verdict == "holds"
    v = run.v.copy()
    v[40] *= 1.5
    broken = check(model, [tampered(run, v=v)])["run-energy"]
    assert broken.verdict == "violated"
    assert broken.witness["t"] == pytest.approx(40 * 0.05)
    assert broken.value["largest excess"] == pytest.approx((1.5**2 - 1) * run.v[40, 0] ** 2 / 2, rel=0.2)


def test_dissipated_energy_is_what_is_lost():
    """E_0 = 2, and at rest x^2/2 is left: the friction has taken the difference, up to what the scheme damps by itself."""
    run = simulate(model := oscillator(step=1e-3, t_end=12))
    finding = check(model, [run])["run-dissipated"]
    lost = 2 - run.x[-1, 0] ** 2 / 2
    assert finding.value["E_0 - inf g"] == pytest.approx(2, rel=1e-2)
    assert finding.value["dissipated"] == pytest.approx(lost, rel=1e-2)
    assert finding.value["dissipated"] <= lost


def test_decreasing_steps_may_gain_energy_and_the_finding_says_why():
    model = oscillator(friction=1e-3 * s, step=None, steps=[0.1, 0.1, 0.05, 0.05], t_end=None, v0=-3)
    report = check(model, [simulate(model)])
    assert report["O-steps"].verdict == "violated"
    assert report["run-energy"].verdict == "violated"
    assert "does not apply" in report["run-energy"].how


def test_a_last_step_that_the_end_shortens_is_no_kick():
    model = oscillator(t_end=7.98)
    report = check(model, [simulate(model)])
    assert report["run-energy"].verdict == "holds"


@pytest.mark.parametrize("save_every", [1, 3])
def test_rows_left_out_are_not_guessed(save_every):
    model = oscillator()
    finding = check(model, [simulate(model, save_every=save_every)])["run-energy"]
    assert finding.verdict == ("holds" if save_every == 1 else "unknown")


# ---------------------------------------------------------------------------------------------- sweeping processes


def test_feasibility_of_a_run_and_of_one_pushed_into_the_disc():
    model = disc()
    run = simulate(model)
    good = check(model, [run], quick=True)["run-feasible"]
    assert good.verdict == "holds"
    assert good.value["least value"] == pytest.approx(np.linalg.norm(run.q, axis=1).min() - 1, abs=1e-14)
    q = run.x.copy()
    q[60] *= 0.999
    bad = check(model, [tampered(run, x=q)], quick=True)["run-feasible"]
    assert bad.verdict == "violated"
    assert bad.witness["constraint"] == "disc"
    assert bad.witness["t"] == pytest.approx(1.2)
    assert bad.value["least value"] == pytest.approx(np.linalg.norm(q[60]) - 1, rel=1e-12)


def test_a_residual_above_the_tolerance_is_a_violation():
    run = simulate(model := disc())
    metadata = {**run.metadata, "totals": {**run.metadata["totals"], "worst_residual": 1e-3, "worst_residual_t": 0.5}}
    finding = check(model, [replace(run, metadata=metadata)], quick=True)["run-residual"]
    assert finding.verdict == "violated"
    assert finding.witness["t"] == 0.5


# ---------------------------------------------------------------------------------------------- inclusions


def test_bounds_of_an_inclusion_and_of_a_run_that_jumps():
    model = inclusion()
    run = simulate(model)
    report = check(model, [run])
    assert [report[id].verdict for id in ("run-bound", "run-defects", "run-cesaro", "run-feasible")] == ["holds"] * 4
    moved = run.x.copy()
    moved[50:] += 1
    assert check(model, [tampered(run, x=moved)])["run-bound"].verdict == "violated"
    far = run.predictor_distance.copy()
    far[50] = 1
    assert check(model, [tampered(run, predictor_distance=far)])["run-cesaro"].verdict == "violated"


def test_contraction_of_two_runs_beside_the_one_sided_bound():
    """x' = 1 - 2x: the distance of two solutions is e^{-2t} times the first; explicit Euler stays below it."""
    model = inclusion()
    twin = simulate(inclusion(x0=1))
    finding = check(model, [simulate(model), twin])["run-contraction"]
    assert finding.verdict == "holds"
    assert finding.value["L"] == -2
    assert finding.value["distance at the end"] == pytest.approx((1 - 0.04) ** 100, rel=1e-9)
    slow = tampered(twin, x=simulate(model).x - 1)
    assert check(model, [simulate(model), slow])["run-contraction"].verdict == "violated"


# ---------------------------------------------------------------------------------------------- the wrapper


def test_observed_order_of_a_smooth_run():
    """x' = -x by the implicit Euler method: order 1; by the trapezoidal rule: order 2."""
    for theta, order in ((1, 1), (0.5, 2)):
        model = LureSystem(
            A=[[-1]], B=[[0]], C=[[0]], D=[[1]], law=relay(1), x0=[1], t_end=2, step=0.01, theta=theta, gamma=theta
        )
        found = next(c for c in check(model).consequences if c.name == "observed order")
        assert found.value["order"] == pytest.approx(order, abs=0.05)


def test_a_run_that_stops_is_a_note_and_what_it_computed_is_used():
    q = ca.SX.sym("q")
    t = ca.SX.sym("t")
    model = SweepingProcess(t=t, q=q, constraints={"left": q - t, "right": 1 - q - t}, q0=0.5, t_end=1, step=0.01)
    report = check(model)
    assert any("the run stopped" in note for note in report.notes)
    assert report["run-residual"].verdict == "holds"


def test_wrong_arguments_name_what_is_wrong():
    with pytest.raises(UsageError, match=r"check: expected a model, such as LureSystem\(\.\.\.\), not 3"):
        check(3)
    with pytest.raises(UsageError, match="region: 'z' is not a state; the model has x"):
        check(oscillator(), region={"z": (0, 1)}, quick=True)
    with pytest.raises(UsageError, match=r"region: x = \(1, 0\); expected a pair \(low, high\)"):
        check(oscillator(), region={"x": (1, 0)}, quick=True)
    with pytest.raises(UsageError, match="parameter 'a' has no value"):
        check(oscillator(potential=ca.SX.sym("a") * 0 + x**2, parameters={"a": None}))


def test_public_names():
    assert nsmodel.check is check
    report = check(oscillator(), quick=True)
    assert isinstance(report, nsmodel.Report)
    assert all(isinstance(finding, nsmodel.Finding) for finding in report.findings)
    with pytest.raises(KeyError, match="no finding 'A5'; the report has O-theta"):
        report["A5"]
