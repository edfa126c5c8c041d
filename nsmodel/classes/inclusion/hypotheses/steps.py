"""What the hypotheses of an inclusion promise of a scheme's steps: convergence, and what tolerances may be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, Consequence, Finding, make_consequence
from nsmodel.simulation.trajectory import Trajectory

CATCHING_UP_PAPER = "catching-up 2026"
CLOSED_GRAPH = "the steps' velocities are bounded, and the graph of T is closed (Brezis 1973, Chapter II)"
TOLERANCE_HALVINGS = 6


def scheme_convergence(
    model: MonotoneInclusion, findings: Sequence[Finding], ids: Sequence[str], span: str, runs: Sequence[Trajectory]
) -> list[Consequence]:
    """The limit of the model's scheme, where the findings ``ids`` hold; ``span``: where it is uniform."""
    statement = f"the iterates converge to the solution{span}; the order is measured, not claimed"
    source = {"catching-up": f"{CATCHING_UP_PAPER}, Theorem 5.3, Corollary 5.4", "implicit": CLOSED_GRAPH}[model.scheme]
    scheme = make_consequence("convergence of the scheme", statement, findings, ids, source)
    if model.scheme != "catching-up":
        return [scheme]
    tolerances = _tolerance_consequence(model, runs)
    order = (UNKNOWN, SAMPLED, HOLDS)
    return [replace(scheme, verdict=min(scheme.verdict, tolerances.verdict, key=order.index)), tolerances]


def _tolerance_consequence(model: MonotoneInclusion, runs: Sequence[Trajectory]) -> Consequence:
    """eps_k/mu_k^2 -> 0 as the mesh is refined."""
    name, source = "tolerances", f"{CATCHING_UP_PAPER}, Definition 4.3"
    given = model.tolerances
    zero = given is None or (not callable(given) and not np.any(np.asarray(given, float)))
    if zero:
        return Consequence(name, "projections are exact: eps_k = 0", (), HOLDS, {"max eps_k/mu_k^2": 0.0}, source)
    steps = np.concatenate([run.step[np.isfinite(run.step)] for run in runs]) if runs else _model_steps(model)
    if callable(given):
        h = float(steps.max()) if steps.size else 1e-2
        ratios = np.array([_tolerance_ratio(given, h / 2**k) for k in range(TOLERANCE_HALVINGS)])
        values = {"max eps_k/mu_k^2": max((_tolerance_ratio(given, float(step)) for step in steps), default=float(ratios[0]))}
        powers = np.diff(np.log2(np.maximum(ratios, 1e-300))) / -1.0
        power = float(powers[-1])
        falls = bool((np.diff(ratios) < 0).all()) and power > 0.05
        values["power p of eps/mu^2 ~ mu^p"] = power
        text = f"eps(mu)/mu^2 behaves like mu^{power:.3g} as mu is halved {TOLERANCE_HALVINGS - 1} times: it " + (
            "vanishes" if falls else "does not vanish"
        )
        return Consequence(name, text, (), SAMPLED if falls else UNKNOWN, values, source)
    eps = np.atleast_1d(np.asarray(given, float))
    largest = float(np.max(eps) / np.min(steps) ** 2) if steps.size else np.nan
    text = "eps_k does not depend on the step: eps_k/mu_k^2 grows as the mesh is refined; give a function of the step, as mu**3"
    return Consequence(name, text, (), UNKNOWN, {"max eps_k/mu_k^2": largest} if np.isfinite(largest) else {}, source)


def _model_steps(model: MonotoneInclusion) -> np.ndarray:
    if model.steps is not None:
        return np.asarray(model.steps, float)
    return np.array([model.step]) if model.step is not None else np.zeros(0)


def _tolerance_ratio(tolerance: Callable[[float], float], mu: float) -> float:
    return tolerance(mu) / mu**2
