"""What a run of catching-up shows: it stays in C, and keeps to the bounds of the paper step by step.

What runs of catching-up with the steps h, 2h, 4h show together: how fast the predictors reach C.

What the hypotheses of an inclusion promise of a scheme's steps: convergence, and what tolerances may be.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.hypotheses.along_run import SUM_ROUNDING, constraint_findings, has_every_row, missing_rows_findings
from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    make_consequence,
    make_finding,
    measured_consequence,
)
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.models.monotone_inclusion.schemes import set_constraints
from nsmodel.simulation.run_data import extrapolated_rows
from nsmodel.simulation.trajectory import Trajectory

NORM_BOUND = Hypothesis(
    "run-bound",
    "|x_{k+1}|^2 <= |x_k|^2 - 2 mu (alpha |x_k|^2 - beta) + mu^2 |v_k|^2 + projection error",
    "catching-up 2026, Lemma 4.4",
)
DEFECTS = Hypothesis(
    "run-defects", "|e_k|^2 <= mu_k^2 |v_k|^2 + eps_k: projection errors are square-summable", "catching-up 2026, Lemma 6.1"
)
CESARO = Hypothesis(
    "run-cesaro", "d_C(y_k) <= mu_k |v_k|: the predictor leaves C by O(mu), so that its mean distance vanishes",
    "catching-up 2026, Corollary 6.4",
)  # fmt: skip
RUN_CONTRACTION = Hypothesis(
    "run-contraction", "|x(t) - x~(t)| <= e^{L t} |x_0 - x~_0| for two runs", "catching-up 2026, one-sided Lipschitz bound"
)


def class_findings_along_run(
    model: MonotoneInclusion, run: Trajectory, numbers: Mapping[str, Finding], twin: Trajectory | None, quick: bool
) -> list[Finding]:  # fmt: skip
    """C, the bounds of a step, and two runs."""
    if model.scheme != "catching-up":
        return constraint_findings(model, run, *set_constraints(model))
    steps = (
        _step_bound_findings(model, run, numbers)
        if has_every_row(run) and not run.is_event_driven
        else missing_rows_findings(NORM_BOUND, DEFECTS, CESARO)
    )
    two = [] if twin is None else [_contraction_finding(run, twin, numbers["M-24"])]
    return [*constraint_findings(model, run, *set_constraints(model)), *steps, *two]


def _step_bound_findings(model: MonotoneInclusion, run: Trajectory, numbers: Mapping[str, Finding]) -> list[Finding]:
    """Lemma 4.4, Lemma 6.1 and Corollary 6.4 step by step: with 0 in C, |P_C(y)| <= |y| and |x_{k+1} - P_C(y)|^2 <= eps_k.

    Where C moves, at kappa at most (M-H), it moves away from a predictor by mu kappa more.
    """
    kappa = _speed_of_set(run, numbers["M-H"]) if model.moves else 0.0
    if kappa is None:
        return [make_finding(which, UNKNOWN, "M-H gives no speed of C along the run") for which in (NORM_BOUND, DEFECTS, CESARO)]
    of_defects, of_mean = (_moving_set_hypothesis(which) if kappa else which for which in (DEFECTS, CESARO))
    x, mu = run.x[:-1], run.step[1:]
    v, e = run.arrays["v"][1:], run.arrays["defect"][1:]
    eps, distance = (run.arrays[name][1:].ravel() for name in ("tolerance", "predictor_distance"))
    speed = np.linalg.norm(v, axis=1) + kappa
    scale = SUM_ROUNDING * (1 + np.linalg.norm(run.x, axis=1)).max() ** 2
    mean = float(np.sum(mu * distance) / np.sum(mu))
    k = int(np.argmax(distance))
    over = distance - mu * speed
    cesaro = make_finding(
        of_mean, HOLDS if over.max() <= scale else VIOLATED, f"evaluated at {mu.size} steps",
        {"mean of d_C(y)": mean, "largest d_C(y)": distance[k]}, {"t": run.t[k + 1], "mu |v|": mu[k] * speed[k]},
    )  # fmt: skip
    squares = (e**2).sum(axis=1)
    over = squares - (mu * speed) ** 2 - eps
    k = int(np.argmax(over))
    defects = make_finding(
        of_defects, HOLDS if over[k] <= scale else VIOLATED, f"evaluated at {mu.size} steps",
        {"sum |e_k|^2": squares.sum(), "sum of the bounds": ((mu * speed) ** 2 + eps).sum()}, {"t": run.t[k + 1]},
    )  # fmt: skip
    if kappa:
        return [make_finding(NORM_BOUND, UNKNOWN, "C moves: it may carry the state outwards"), defects, cesaro]
    return [_norm_bound_finding(model, run, numbers["M-A3"], x, mu, speed, eps, scale), defects, cesaro]


def _moving_set_hypothesis(hypothesis: Hypothesis) -> Hypothesis:
    return hypothesis._replace(statement=hypothesis.statement.replace("|v_k|", "(|v_k| + kappa)"))


def _speed_of_set(run: Trajectory, moves: Finding) -> float | None:
    """kappa of M-H, where it is known for all rows."""
    box = np.array(list(moves.scope.states.values()) if moves.scope is not None else []).reshape(-1, 2)
    inside = not len(box) or bool(((run.x >= box[:, 0]) & (run.x <= box[:, 1])).all())
    return moves.value.get("kappa") if inside and moves.verdict == HOLDS else None


def _norm_bound_finding(
    model: MonotoneInclusion, run: Trajectory, dissipative: Finding, x: np.ndarray, mu: np.ndarray, speed: np.ndarray,
    eps: np.ndarray, scale: float,
) -> Finding:  # fmt: skip
    alpha, beta = dissipative.value.get("alpha", np.nan), dissipative.value.get("beta", np.nan)
    if not np.isfinite(alpha + beta):
        return make_finding(NORM_BOUND, UNKNOWN, f"M-A3 gives no alpha and beta: it is {dissipative.verdict}")
    square = (run.x**2).sum(axis=1)
    reach = np.sqrt(square[:-1]) + mu * speed
    allowed = square[:-1] - 2 * mu * (alpha * square[:-1] - beta) + (mu * speed) ** 2 + 2 * reach * np.sqrt(eps) + eps
    over = np.nan_to_num(square[1:] - allowed, nan=-np.inf)  # inf - inf: a square beyond the doubles
    over[extrapolated_rows(run)[1:]] = -np.inf
    k = int(np.argmax(over))
    values = {"largest excess": over[k], "alpha": alpha, "beta": beta, "largest |x|": np.sqrt(square.max())}
    witness = {"t": run.t[k + 1], "|x|^2": square[k + 1], "bound": allowed[k]}
    if over[k] <= scale:
        return make_finding(NORM_BOUND, HOLDS, f"evaluated at {mu.size} steps", values, witness)
    c, _ = set_constraints(model)
    at_zero = np.array(ca.Function("c", [model.x], [ca.densify(c)])(np.zeros(model.x.numel()))) if c.numel() else np.zeros(1)
    if (at_zero < 0).any():
        return make_finding(
            NORM_BOUND, UNKNOWN, "0 is not in C: the step may move outwards by O(mu^2) more than the bound", values, witness
        )
    return make_finding(NORM_BOUND, VIOLATED, f"evaluated at {mu.size} steps", values, witness)


def _contraction_finding(run: Trajectory, twin: Trajectory, lipschitz: Finding) -> Finding:
    """The distance d of two runs: projections do not stretch, so that a step obeys |d'|^2 <= (1 + 2 mu L) |d|^2 + mu^2 |dv|^2."""
    L = lipschitz.value.get("L", np.nan)
    rows = min(len(run.t), len(twin.t))
    gap = np.linalg.norm(run.x[:rows] - twin.x[:rows], axis=1)
    if not (np.isfinite(L) and gap[0] > 0):
        why = "M-24 gives no L" if gap[0] > 0 else "both runs have the same start"
        return make_finding(RUN_CONTRACTION, UNKNOWN, why)
    mu, eps = run.step[1:rows], np.maximum(*(r.arrays["tolerance"][1:rows].ravel() for r in (run, twin)))
    velocity_distance = np.linalg.norm(run.arrays["v"][1:rows] - twin.arrays["v"][1:rows], axis=1)
    square = (1 + 2 * mu * L) * gap[:-1] ** 2 + (mu * velocity_distance) ** 2
    allowed = np.sqrt(np.maximum(square, 0.0)) + 2 * np.sqrt(eps)
    over = gap[1:] - allowed
    scale = SUM_ROUNDING * np.linalg.norm(run.x[:rows], axis=1).max() + SUM_ROUNDING * (mu * velocity_distance).max()
    bound = np.exp(np.minimum(L * run.t[:rows], 700.0)) * gap[0]
    k = int(np.argmax(np.where(np.isnan(over), np.inf, over)))
    values = {"L": L, "distance at the start": gap[0], "distance at the end": gap[-1], "e^{Lt} |x_0 - x~_0|": bound[-1]}
    witness = {"t": run.t[k + 1], "distance": gap[k + 1], "bound of the step": allowed[k]}
    how = (
        f"two runs, the other from {_state_text(twin.x[0])}: {mu.size} steps, each against its own bound "
        "(the predictor is explicit)"
    )
    return make_finding(RUN_CONTRACTION, HOLDS if over[k] <= scale else VIOLATED, how, values, witness)


def _state_text(x: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in x[:4]) + (", ...)" if x.size > 4 else ")")


def refinement_consequences(h: float, runs: Sequence[Trajectory]) -> list[Consequence]:
    """The time mean of d_C(y_k) at the steps h, 2h, 4h (Corollary 6.4: it tends to 0); nothing of a scheme without predictor."""
    return [_predictor_feasibility(runs)] if "predictor_distance" in runs[0].arrays else []


def _predictor_feasibility(runs: Sequence[Trajectory]) -> Consequence:
    means = [float(np.average(run.arrays["predictor_distance"][1:].ravel(), weights=run.step[1:])) for run in runs]
    value = {f"mean d_C at {name}": mean for name, mean in zip(("h", "2h", "4h"), means, strict=True)}
    if not means[0]:
        return measured_consequence("predictor feasibility", "the predictor never leaves C", value)
    rate = np.log2(means[2] / means[0]) / 2
    return measured_consequence(
        "predictor feasibility", "the mean distance of the predictor from C shrinks like h^rate", {"rate": rate, **value}
    )


CATCHING_UP_PAPER = "catching-up 2026"
CLOSED_GRAPH = "the steps' velocities are bounded, and the graph of T is closed (Brezis 1973, Chapter II)"
# Values of mu, each half of the last, at which eps(mu) is looked at: a power of mu shows after some; it is measured, not proved.
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
