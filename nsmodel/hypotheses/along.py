"""The inequalities that must hold along a run, evaluated on its rows from the model's own expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.hypotheses import along as bodies
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem
from nsmodel.classes.inclusion import set_valued
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import energy
from nsmodel.classes.sweeping.hypotheses.geometry import mfcq_constant
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses import impacts
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, found
from nsmodel.model.base import Model
from nsmodel.solve.certificate import EPS
from nsmodel.trajectory import Trajectory, extrapolated

MOST_ROWS = 2000  # of a run, where gamma is evaluated
SLACK = 64 * EPS  # relative rounding of a sum of a few terms

RESIDUAL = Hypothesis("run-residual", "every step solves its one-step problem: residual <= tolerance", "definition")
FEASIBLE = Hypothesis("run-feasible", "every constraint is >= 0 at every row", "definition of Q(t), of C, of dom g")
QUALIFIED = Hypothesis(
    "run-mfcq", "the constraints that one step can close leave a common escape direction: gamma(rho) < inf at every row",
    "Bernicot and Venel 2010, (A5)",
)  # fmt: skip
ENERGY = Hypothesis("run-energy", "E_{n+1} - E_n <= -l_n <v, A(v)>: friction takes energy away", "Cabot 2004, Proposition 4.1")
DISSIPATED = Hypothesis("run-dissipated", "sum l_n <v_n, A(v_n)> <= E_0 - inf g", "Cabot 2004, Proposition 4.1")
BOUND = Hypothesis(
    "run-bound",
    "|x_{k+1}|^2 <= |x_k|^2 - 2 mu (alpha |x_k|^2 - beta) + mu^2 |v_k|^2 + projection error",
    "catching-up 2026, Lemma 4.4",
)
CESARO = Hypothesis(
    "run-cesaro", "d_C(y_k) <= mu_k |v_k|: the predictor leaves C by O(mu), so that its mean distance vanishes",
    "catching-up 2026, Corollary 6.4",
)  # fmt: skip
DEFECTS = Hypothesis(
    "run-defects", "|e_k|^2 <= mu_k^2 |v_k|^2 + eps_k: projection errors are square-summable", "catching-up 2026, Lemma 6.1"
)
CONTRACTION = Hypothesis(
    "run-contraction", "|x(t) - x~(t)| <= e^{L t} |x_0 - x~_0| for two runs", "catching-up 2026, one-sided Lipschitz bound"
)
MOTION = Hypothesis(
    "run-motion", "|q_{k+1} - q_k| <= h |f(t_k, q_k)|, over all bodies together: constraints only slow down",
    "projection on a convex set that holds q_k",
)  # fmt: skip
CONTINUOUS = Hypothesis(
    "run-continuous", "no state jumps: where a multiplier that enters neither y nor y' sets in, y' = 0",
    "definition of a solution: x is absolutely continuous",
)  # fmt: skip
HYPOTHESES = (RESIDUAL, FEASIBLE, QUALIFIED, MOTION, ENERGY, DISSIPATED, BOUND, DEFECTS, CESARO, CONTRACTION, CONTINUOUS)


@np.errstate(over="ignore", invalid="ignore")  # a run that diverges is judged like any other
def along(
    model: Model, run: Trajectory, findings: Sequence[Finding], twin: Trajectory | None = None, quick: bool = False
) -> list[Finding]:
    """Return one finding for each inequality that this class promises.

    Args:
        model: bound.
        run: a run of it.
        findings: of the hypotheses; their numbers enter the bounds.
        twin: a run of the same model on the same grid from another start.
        quick: of many bodies look at fewer rows.
    """
    numbers = {finding.id: finding for finding in findings}
    checked, every_row = [_residual(run)], run.metadata["save_every"] == 1 and len(run.t) > 1
    if isinstance(model, ManyBodies):
        checked += _bodies(model, run, numbers, quick)
    elif isinstance(model, SweepingProcess):
        checked += _feasible(run, model.g, model.multiplier_names, model.t, model.q)
        checked += _qualified(model, run)
    elif isinstance(model, FrictionOscillator):
        c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())
        checked += _feasible(run, c, model.constraint_names, model.t, model.x)
        checked += _oscillator(model, run, numbers) if every_row else _rows_missing(ENERGY, DISSIPATED)
    elif isinstance(model, MonotoneInclusion):
        checked += _feasible(run, *set_valued.constraints(model), model.t, model.x)
        if model.scheme == "catching-up":
            checked += _inclusion(model, run, numbers) if every_row else _rows_missing(BOUND, DEFECTS, CESARO)
        if twin is not None and model.scheme == "catching-up":
            checked.append(_contraction(run, twin, numbers["M-24"]))
    return [*checked, *_continuous(model, run)]


def _continuous(model: Model, run: Trajectory) -> list[Finding]:
    """Impacts of the rows that may call for an impulse; nothing where there is no such row."""
    watches = impacts.watched(model)
    if not watches:
        return []  # nearly always
    known = impacts.met(watches, run.arrays, {})
    words = impacts.told(watches, known, model)
    jumps = [(watch, known[watch.name]) for watch in watches if not watch.relay and known[watch.name]["count"]]
    value = {"jumps": sum(found["count"] for _, found in jumps)}
    if jumps:
        watch, worst = max(jumps, key=lambda jump: jump[1]["largest"])
        witness = {"multiplier": watch.name, "t": worst["t"], "y'": worst["rate"], "states": list(watch.moved)}
        return [found(CONTINUOUS, VIOLATED, "; ".join(words), value | {"largest |y'|": worst["largest"]}, witness)]
    if words:
        return [found(CONTINUOUS, UNKNOWN, "; ".join(words), value)]
    names = ", ".join(watch.acts for watch in watches if not watch.relay)
    return [] if not names else [found(CONTINUOUS, HOLDS, f"{names}: none set in with y' != 0 at {len(run.t)} rows", value)]


def _bodies(model: ManyBodies, run: Trajectory, numbers: Mapping[str, Finding], quick: bool) -> list[Finding]:
    problem, slope = BodiesProblem(model), numbers["A1"].value.get("b", 1.0)
    answers = {
        FEASIBLE: bodies.feasible(problem, run, quick),
        QUALIFIED: bodies.qualified(problem, run, slope, quick),
        MOTION: bodies.shorter(problem, run),
    }
    return [found(id, item.verdict, item.how, item.value, item.witness) for id, item in answers.items() if item is not None]


def _rows_missing(*hypotheses: Hypothesis) -> list[Finding]:
    return [found(hypothesis, UNKNOWN, "the run does not hold every row (save_every)") for hypothesis in hypotheses]


def _residual(run: Trajectory) -> Finding:
    totals = run.metadata["totals"]
    worst, tolerance = float(totals["worst_residual"]), float(run.metadata["tolerance"])
    verdict = HOLDS if worst <= tolerance else VIOLATED
    time = totals["worst_residual_t"]
    how = f"recomputed from the definition of the law at each of {totals['steps']} steps"
    return found(
        RESIDUAL, verdict, how, {"worst residual": worst, "tolerance": tolerance}, {"t": "no row" if time is None else time}
    )


def _feasible(run: Trajectory, c: ca.SX, names: Sequence[str], t: ca.SX, x: ca.SX) -> list[Finding]:
    """The least value of every constraint; what evaluating it in doubles cannot see is no violation."""
    if not c.numel():
        return []
    f = ca.Function("c", [t, x], [ca.densify(c), ca.densify(ca.jacobian(c, x))])
    k = len(run.t)
    values, gradients = (np.array(v) for v in f.map(k)(run.t[None, :], run.x.T))
    values = values.T
    size = np.linalg.norm(gradients.reshape(c.numel(), k, x.numel()), axis=2).T
    values = np.where(np.isfinite(values), values, -np.inf)
    row, i = np.unravel_index(np.argmin(values), values.shape)
    unseen = 1e-10 * np.where(np.isfinite(size), size, 0) * (1 + np.linalg.norm(run.x, axis=1)[:, None])
    broken = values < -unseen
    if broken.any():
        row, i = np.unravel_index(np.argmin(np.where(broken, values, np.inf)), values.shape)
    witness = {"constraint": names[i], "t": run.t[row], "state": run.x[row]}
    how = f"evaluated at {k} rows; a deficit below 1e-10 of the state's size counts as rounding"
    return [found(FEASIBLE, VIOLATED if broken.any() else HOLDS, how, {"least value": values[row, i]}, witness)]


def _qualified(model: SweepingProcess, run: Trajectory) -> list[Finding]:
    """gamma(rho) of (A5) along the run, rho the most that a constraint closed from one row to the next."""
    gap = run.arrays.get("gap", np.zeros((1, 0)))
    if gap.shape[1] < 2 or len(gap) < 2:
        return []
    rho = max(float(np.max(gap[:-1] - gap[1:])), 0.0)
    near = gap <= rho
    crowded = np.flatnonzero(near.sum(axis=1) > 1)
    rows = crowded[np.unique(np.linspace(0, crowded.size - 1, min(crowded.size, MOST_ROWS), dtype=int))]
    slopes = ca.Function("slopes", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q))])
    worst, witness = 1.0, {}
    for k in rows:
        at = np.flatnonzero(near[k])
        gamma, weights = mfcq_constant(np.array(slopes(run.t[k], run.x[k]))[at])
        if gamma > worst:
            worst = gamma
            opposed = {model.multiplier_names[at[i]]: float(weights[i]) for i in np.argsort(-weights) if weights[i] > 0}
            witness = {"constraints": list(opposed), "weights": list(opposed.values()), "t": run.t[k], "state": run.x[k]}
            if np.isinf(gamma):
                break
    verdict = VIOLATED if np.isinf(worst) else HOLDS if rows.size == crowded.size else SAMPLED
    how = f"evaluated at {rows.size} of {crowded.size} rows with several constraints within rho, the most that one closes"
    return [found(QUALIFIED, verdict, how, {"gamma": worst, "rho": rho}, witness)]


def _oscillator(model: FrictionOscillator, run: Trajectory, numbers: Mapping[str, Finding]) -> list[Finding]:
    """Proposition 4.1 from x and v alone: E at a row has the last difference over the step that comes next."""
    first = 1 if model.x1 is not None else 0
    l = np.where(np.isfinite(run.step), run.step, run.t - np.roll(run.t, 1))[1:]
    nominal = np.append(l[0], l) / np.append(l, l[-1])
    moved = extrapolated(run)[1:]  # the inequality is about steps of the scheme
    if "correction" in run.arrays:
        nominal[:] = 1.0
    elif model.steps is None and len(l) > 1 and l[-1] < l[-2]:
        nominal[-2] = 1.0  # a last step that only the end of the run shortens keeps the velocity
    v = run.arrays["v"]
    E = np.array(energy(model).map(len(run.t))(run.x.T, (v * nominal[:, None]).T)).ravel()
    power = _friction_power(model, v)[first + 1 :]
    rise = np.where(moved[first:], -np.inf, np.diff(E[first:]) + l[first:] * power)
    rounding = SLACK * max(np.nanmax(np.abs(E[first:])), np.finfo(float).tiny)
    k = int(np.argmax(rise))
    witness = {"t": run.t[first + k + 1], "E before": E[first + k], "E after": E[first + k + 1]}
    values = {"largest excess": rise[k], "rounding bound": rounding}
    evaluated = f"evaluated at {rise.size - moved[first:].sum()} steps" + (
        ", where nothing was extrapolated" if moved.any() else ""
    )
    steps_ok = numbers["O-steps"].verdict == HOLDS and numbers["O-g"].verdict != VIOLATED
    if rise[k] <= rounding:
        energy_finding = found(ENERGY, HOLDS, evaluated, values, witness)
    elif steps_ok:
        energy_finding = found(ENERGY, VIOLATED, evaluated, values, witness)
    else:
        how = "the energy grows, and the proposition does not apply: O-steps or O-g does not hold"
        energy_finding = found(ENERGY, VIOLATED, how, values, witness)
    if moved.any():
        return [energy_finding]
    total = float(np.sum(l[first:] * power))
    known = numbers["O-g"].value
    below, met = known.get("inf g", known.get("lower bound of g", -np.inf)), known.get("inf g", known.get("least g met", np.inf))
    values = {"dissipated": total}
    values |= {"E_0 - inf g is at least": E[first] - met} if np.isfinite(met) and "inf g" not in known else {}
    values |= {"E_0 - inf g is at most": E[first] - below} if np.isfinite(below) and "inf g" not in known else {}
    rest = rise.size * rounding
    if np.isfinite(met) and total <= E[first] - met + rest:
        verdict = HOLDS
    elif np.isfinite(below) and total > E[first] - below + rest:
        verdict = VIOLATED
    else:
        return [energy_finding, found(DISSIPATED, UNKNOWN, "inf g is not known closely enough", values)]
    values |= {"E_0 - inf g": E[first] - known["inf g"]} if "inf g" in known else {}
    return [energy_finding, found(DISSIPATED, verdict, f"summed over {rise.size} steps", values, {"t": run.t[-1]})]


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


def _inclusion(model: MonotoneInclusion, run: Trajectory, numbers: Mapping[str, Finding]) -> list[Finding]:
    """Lemma 4.4, Lemma 6.1 and Corollary 6.4 step by step: with 0 in C, |P_C(y)| <= |y| and |x_{k+1} - P_C(y)|^2 <= eps_k.

    Where C moves, at kappa at most (M-H), it moves away from a predictor by mu kappa more.
    """
    kappa = _speed_of_set(run, numbers["M-H"]) if model.moves else 0.0
    if kappa is None:
        return [found(which, UNKNOWN, "M-H gives no speed of C along the run") for which in (BOUND, DEFECTS, CESARO)]
    of_defects, of_mean = (_of_moving(which) if kappa else which for which in (DEFECTS, CESARO))
    x, mu = run.x[:-1], run.step[1:]
    v, e = run.arrays["v"][1:], run.arrays["defect"][1:]
    eps, distance = (run.arrays[name][1:].ravel() for name in ("tolerance", "predictor_distance"))
    speed = np.linalg.norm(v, axis=1) + kappa
    scale = SLACK * (1 + np.linalg.norm(run.x, axis=1)).max() ** 2
    mean = float(np.sum(mu * distance) / np.sum(mu))
    k = int(np.argmax(distance))
    over = distance - mu * speed
    cesaro = found(
        of_mean, HOLDS if over.max() <= scale else VIOLATED, f"evaluated at {mu.size} steps",
        {"mean of d_C(y)": mean, "largest d_C(y)": distance[k]}, {"t": run.t[k + 1], "mu |v|": mu[k] * speed[k]},
    )  # fmt: skip
    squares = (e**2).sum(axis=1)
    over = squares - (mu * speed) ** 2 - eps
    k = int(np.argmax(over))
    defects = found(
        of_defects, HOLDS if over[k] <= scale else VIOLATED, f"evaluated at {mu.size} steps",
        {"sum |e_k|^2": squares.sum(), "sum of the bounds": ((mu * speed) ** 2 + eps).sum()}, {"t": run.t[k + 1]},
    )  # fmt: skip
    if kappa:
        return [found(BOUND, UNKNOWN, "C moves: it may carry the state outwards"), defects, cesaro]
    return [_growth(model, run, numbers["M-A3"], x, mu, speed, eps, scale), defects, cesaro]


def _of_moving(hypothesis: Hypothesis) -> Hypothesis:
    return hypothesis._replace(statement=hypothesis.statement.replace("|v_k|", "(|v_k| + kappa)"))


def _speed_of_set(run: Trajectory, moves: Finding) -> float | None:
    """kappa of M-H, where it is known for all rows."""
    box = np.array(list(moves.scope.states.values()) if moves.scope is not None else []).reshape(-1, 2)
    inside = not len(box) or bool(((run.x >= box[:, 0]) & (run.x <= box[:, 1])).all())
    return moves.value.get("kappa") if inside and moves.verdict == HOLDS else None


def _growth(
    model: MonotoneInclusion, run: Trajectory, dissipative: Finding, x: np.ndarray, mu: np.ndarray, speed: np.ndarray,
    eps: np.ndarray, scale: float,
) -> Finding:  # fmt: skip
    alpha, beta = dissipative.value.get("alpha", np.nan), dissipative.value.get("beta", np.nan)
    if not np.isfinite(alpha + beta):
        return found(BOUND, UNKNOWN, f"M-A3 gives no alpha and beta: it is {dissipative.verdict}")
    square = (run.x**2).sum(axis=1)
    reach = np.sqrt(square[:-1]) + mu * speed
    allowed = square[:-1] - 2 * mu * (alpha * square[:-1] - beta) + (mu * speed) ** 2 + 2 * reach * np.sqrt(eps) + eps
    over = np.nan_to_num(square[1:] - allowed, nan=-np.inf)  # inf - inf: a square beyond the doubles
    over[extrapolated(run)[1:]] = -np.inf
    k = int(np.argmax(over))
    values = {"largest excess": over[k], "alpha": alpha, "beta": beta, "largest |x|": np.sqrt(square.max())}
    witness = {"t": run.t[k + 1], "|x|^2": square[k + 1], "bound": allowed[k]}
    if over[k] <= scale:
        return found(BOUND, HOLDS, f"evaluated at {mu.size} steps", values, witness)
    c, _ = set_valued.constraints(model)
    at_zero = np.array(ca.Function("c", [model.x], [ca.densify(c)])(np.zeros(model.x.numel()))) if c.numel() else np.zeros(1)
    if (at_zero < 0).any():
        return found(BOUND, UNKNOWN, "0 is not in C: the step may move outwards by O(mu^2) more than the bound", values, witness)
    return found(BOUND, VIOLATED, f"evaluated at {mu.size} steps", values, witness)


def _contraction(run: Trajectory, twin: Trajectory, lipschitz: Finding) -> Finding:
    """The distance d of two runs: projections do not stretch, so that a step obeys |d'|^2 <= (1 + 2 mu L) |d|^2 + mu^2 |dv|^2."""
    L = lipschitz.value.get("L", np.nan)
    rows = min(len(run.t), len(twin.t))
    gap = np.linalg.norm(run.x[:rows] - twin.x[:rows], axis=1)
    if not (np.isfinite(L) and gap[0] > 0):
        why = "M-24 gives no L" if gap[0] > 0 else "both runs have the same start"
        return found(CONTRACTION, UNKNOWN, why)
    mu, eps = run.step[1:rows], np.maximum(*(r.arrays["tolerance"][1:rows].ravel() for r in (run, twin)))
    apart = np.linalg.norm(run.arrays["v"][1:rows] - twin.arrays["v"][1:rows], axis=1)
    square = (1 + 2 * mu * L) * gap[:-1] ** 2 + (mu * apart) ** 2
    allowed = np.sqrt(np.maximum(square, 0.0)) + 2 * np.sqrt(eps)
    over = gap[1:] - allowed
    scale = SLACK * np.linalg.norm(run.x[:rows], axis=1).max() + SLACK * (mu * apart).max()
    bound = np.exp(np.minimum(L * run.t[:rows], 700.0)) * gap[0]
    k = int(np.argmax(np.where(np.isnan(over), np.inf, over)))
    values = {"L": L, "distance at the start": gap[0], "distance at the end": gap[-1], "e^{Lt} |x_0 - x~_0|": bound[-1]}
    witness = {"t": run.t[k + 1], "distance": gap[k + 1], "bound of the step": allowed[k]}
    how = f"two runs, the other from {_short(twin.x[0])}: {mu.size} steps, each against its own bound (the predictor is explicit)"
    return found(CONTRACTION, HOLDS if over[k] <= scale else VIOLATED, how, values, witness)


def _short(x: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in x[:4]) + (", ...)" if x.size > 4 else ")")
