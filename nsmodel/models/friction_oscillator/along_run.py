"""What a run of an oscillator shows: it stays in dom g, and friction takes energy away."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.along_run import SUM_ROUNDING, constraint_findings, has_every_row, missing_rows_findings
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.models.friction_oscillator.check import FORCED_TEXT
from nsmodel.models.friction_oscillator.model import FrictionOscillator
from nsmodel.models.friction_oscillator.schemes import energy_function
from nsmodel.simulation.run_data import extrapolated_rows
from nsmodel.simulation.trajectory import Trajectory

RUN_ENERGY = Hypothesis(
    "run-energy", "E_{n+1} - E_n <= -l_n <v, A(v)>: friction takes energy away", "Cabot 2004, Proposition 4.1"
)
RUN_DISSIPATED = Hypothesis("run-dissipated", "sum l_n <v_n, A(v_n)> <= E_0 - inf g", "Cabot 2004, Proposition 4.1")


def class_findings_along_run(
    model: FrictionOscillator, run: Trajectory, numbers: Mapping[str, Finding], twin: Trajectory | None, quick: bool
) -> list[Finding]:  # fmt: skip
    """dom g, and Proposition 4.1."""
    c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())
    if model.is_forced:
        energies = [make_finding(hypothesis, UNKNOWN, FORCED_TEXT) for hypothesis in (RUN_ENERGY, RUN_DISSIPATED)]
    else:
        energies = (
            _energy_findings(model, run, numbers) if has_every_row(run) else missing_rows_findings(RUN_ENERGY, RUN_DISSIPATED)
        )
    return [*constraint_findings(model, run, c, model.constraint_names), *energies]


class _EnergyBalance(NamedTuple):
    """From the first row that has a difference: E, what friction takes, how much more than that E rises in each step.

    ``moved``: the steps beside which something was extrapolated.
    """

    t: np.ndarray
    E: np.ndarray
    taken: np.ndarray
    rise: np.ndarray
    moved: np.ndarray

    @property
    def rounding(self) -> float:
        return SUM_ROUNDING * max(np.nanmax(np.abs(self.E)), np.finfo(float).tiny)


def _energy_findings(model: FrictionOscillator, run: Trajectory, numbers: Mapping[str, Finding]) -> list[Finding]:
    """Proposition 4.1 from x and v alone."""
    balance = _energy_balance(model, run)
    grows = _energy_decay(balance, numbers)
    return [grows] if balance.moved.any() else [grows, _dissipation_finding(balance, numbers["O-g"].value)]


def _energy_balance(model: FrictionOscillator, run: Trajectory) -> _EnergyBalance:
    """E at a row has the last difference over the step that comes next."""
    first = 1 if model.x1 is not None else 0
    l = np.where(np.isfinite(run.step), run.step, run.t - np.roll(run.t, 1))[1:]
    nominal = np.append(l[0], l) / np.append(l, l[-1])
    moved = extrapolated_rows(run)[1:]  # the inequality is about steps of the scheme
    if "correction" in run.arrays or model.keeps_velocity:
        nominal[:] = 1.0
    elif model.steps is None and len(l) > 1 and l[-1] < l[-2]:
        nominal[-2] = 1.0  # a last step that only the end of the run shortens keeps the velocity
    v = run.arrays["v"]
    E = np.array(energy_function(model).map(len(run.t))(run.x.T, (v * nominal[:, None]).T)).ravel()
    taken = l[first:] * _friction_power(model, v)[first + 1 :]
    rise = np.where(moved[first:], -np.inf, np.diff(E[first:]) + taken)
    return _EnergyBalance(run.t[first:], E[first:], taken, rise, moved)


def _energy_decay(balance: _EnergyBalance, numbers: Mapping[str, Finding]) -> Finding:
    t, E, _, rise, moved = balance
    k = int(np.argmax(rise))
    witness = {"t": t[k + 1], "E before": E[k], "E after": E[k + 1]}
    values = {"largest excess": rise[k], "rounding bound": balance.rounding}
    evaluated = f"evaluated at {rise.size - moved[-rise.size :].sum()} steps"
    evaluated += ", where nothing was extrapolated" if moved.any() else ""
    if rise[k] <= balance.rounding:
        return make_finding(RUN_ENERGY, HOLDS, evaluated, values, witness)
    if numbers["O-steps"].verdict == HOLDS and numbers["O-g"].verdict != VIOLATED:
        return make_finding(RUN_ENERGY, VIOLATED, evaluated, values, witness)
    how = "the energy grows, and the proposition does not apply: O-steps or O-g does not hold"
    return make_finding(RUN_ENERGY, VIOLATED, how, values, witness)


def _dissipation_finding(balance: _EnergyBalance, known: Mapping[str, float]) -> Finding:
    """``known``: what is known of inf g."""
    E_0, total = balance.E[0], float(np.sum(balance.taken))
    below, met = known.get("inf g", known.get("lower bound of g", -np.inf)), known.get("inf g", known.get("least g met", np.inf))
    values = {"dissipated": total}
    values |= {"E_0 - inf g is at least": E_0 - met} if np.isfinite(met) and "inf g" not in known else {}
    values |= {"E_0 - inf g is at most": E_0 - below} if np.isfinite(below) and "inf g" not in known else {}
    rest = balance.rise.size * balance.rounding
    if np.isfinite(met) and total <= E_0 - met + rest:
        verdict = HOLDS
    elif np.isfinite(below) and total > E_0 - below + rest:
        verdict = VIOLATED
    else:
        return make_finding(RUN_DISSIPATED, UNKNOWN, "inf g is not known closely enough", values)
    values |= {"E_0 - inf g": E_0 - known["inf g"]} if "inf g" in known else {}
    return make_finding(RUN_DISSIPATED, verdict, f"summed over {balance.rise.size} steps", values, {"t": balance.t[-1]})


def _friction_power(model: FrictionOscillator, v: np.ndarray) -> np.ndarray:
    """<v, A(v)> at each row: sum_j |H_j v| theta_j'(|H_j v|) + <v, M v>."""
    power = np.zeros(len(v))
    for element in model.elements:
        s = np.linalg.norm(v @ np.array(ca.DM(element.H)).T, axis=1)
        slope = np.array(ca.Function("slope", [model.s], [ca.gradient(element.theta, model.s)])(s[None, :])).ravel()
        power += np.where(s > 0, s * slope, 0.0)
    if model.damping is not None:
        power += np.einsum("ki,ij,kj->k", v, np.array(ca.DM(model.damping)), v)
    return power
