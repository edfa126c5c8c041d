"""What became of a model: its steps judged by their truths, its copies by the run of each alone.

A step is right where each entry of the state and of the multipliers is within

    RIGHT size + SLACK rounding

of the truth: ``size`` is the entry's own motion (for a multiplier: itself), or what makes it up over the condition number;
``rounding`` is what the rounding of data and terms alone may move it by.
"""

from __future__ import annotations

import decimal
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import NsmodelError, StepError, simulate
from nsmodel.solvers.one_step_problem import one_step_problem

from .digits import CONTEXT, Exact, Rounding, column, exact, floats
from .models import Case
from .truth import Teller, Truth

EPS = np.finfo(float).eps
RIGHT, SLACK = 1e-7, 64.0
RESOLVED = 1e-14  # Part of the motion that the solution of a linear system leaves of a row.
NOT_UNIQUE = ("bilinear", "decay")
WELL = 1e8  # Condition up to which nothing is excused.
REFUSED, WRONG_X, WRONG_L, VIOLATED, THREW, COPY = "refused", "wrong x", "wrong l", "violated", "thrown", "copy"
UNFOUNDED, ERROR = "unfounded", "error"


@dataclass
class Finding:
    """One thing that went wrong: which model, how it was run, at which step, how far off, at which condition."""

    id: str
    scene: str
    what: str
    step: int
    excess: float
    condition: float
    text: str
    compiled: bool = False


@dataclass
class Verdict:
    """What a model gave: steps taken, steps judged with their conditions, findings, refusals that have no truth."""

    case: Case
    steps: int = 0
    judged: list[float] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    unsolvable: list[str] = field(default_factory=list)
    beyond: list[str] = field(default_factory=list)  # refused where the solution is far beyond the linearisation it solves
    unknown: int = 0
    seconds: float = 0.0


class Run:
    """A run of a model, whole or up to where it stopped."""

    def __init__(self, model: Any, compiled: bool) -> None:
        self.error: StepError | None = None
        try:
            self.trajectory = simulate(model, compiled=compiled)
        except StepError as error:
            self.error, self.trajectory = error, error.trajectory
        self.arrays = self.trajectory.arrays
        self.x, self.l, self.index = self.arrays["x"], self.arrays["multipliers"], self.arrays["index_set"]
        self.N = len(self.x) - 1
        self.warnings = " ".join(self.trajectory.metadata["warnings"])


def judge(case: Case, *, compiled: bool = False, checks: int = 6) -> Verdict:
    """Run the model, tell the truth of up to ``checks`` of its steps (switches first) and of the one that was refused."""
    start, verdict = time.process_time(), Verdict(case)
    try:
        _judge(case, compiled, checks, verdict)
    except NsmodelError as error:
        verdict.findings.append(
            Finding(case.id, case.scene, ERROR, 0, np.inf, np.nan, f"{type(error).__name__}: {error}", compiled)
        )
    verdict.seconds = time.process_time() - start
    return verdict


def _judge(case: Case, compiled: bool, checks: int, verdict: Verdict) -> None:
    model = case.model()
    judge_run(case, model, Run(model, compiled), checks, verdict, compiled)


def judge_run(case: Case, model: Any, run: Run, checks: int, verdict: Verdict, compiled: bool = False) -> None:
    """Add to the verdict what the run shows."""
    verdict.steps = run.N
    teller = Teller(one_step_problem(model))
    rng = np.random.default_rng(case.seed)
    for k in _chosen(run, checks, rng):
        _judge_step(case, model, run, teller, k, verdict, compiled)
    if run.error is not None:
        _judge_refusal(case, model, run, teller, verdict, compiled)
    if case.name == "sweeping":
        _judge_constraints(case, model, run, verdict, compiled)
    if case.parts:
        _judge_copies(case, run, verdict, compiled)


def _chosen(run: Run, checks: int, rng: np.random.Generator) -> Sequence[int]:
    """Steps k -> k + 1 to judge: the first, the last, some switches, some others."""
    if run.N < 1:
        return []
    switches = (
        1 + np.flatnonzero((run.index[2:] != run.index[1:-1]).any(axis=1))
        if run.index.shape[1] and run.N > 1
        else np.zeros(0, int)
    )
    order = [0, run.N - 1, *rng.permutation(switches)[: checks // 2], *rng.permutation(run.N)]
    return sorted(list(dict.fromkeys(int(k) for k in order))[:checks])


def _known(case: Case, model: Any, run: Run, k: int) -> tuple[float, float, np.ndarray]:
    """(t, h, state) of the step from row k."""
    h = float(model.step)
    t = float(run.arrays["t"][k])
    if case.name == "oscillator":
        state = np.concatenate([run.x[k], h * run.arrays["v"][k]])
    elif case.name == "inclusion" and k < run.N:
        state = run.x[k] + h * run.arrays["v"][k + 1]
    else:
        state = run.x[k]
    return t, h, state


def _index_of(run: Run, teller: Teller, row: int) -> np.ndarray:
    index = run.index[row]
    if index.size != teller.m or row < 0 or (index == -2).any():
        return np.where(teller.lower == 0, -1, 0)
    return index


def _judge_step(case: Case, model: Any, run: Run, teller: Teller, k: int, verdict: Verdict, compiled: bool) -> None:
    t, h, state = _known(case, model, run, k)
    direct = teller.problem.multipliers is None and run.l.shape[1] == teller.m
    l = run.l[k + 1] if direct else np.clip(np.zeros(teller.m), teller.lower, teller.upper)
    z = teller.guess(t, h, state, l)
    n = run.x.shape[1]
    if case.name in ("lure", "sweeping", "inclusion", "first"):
        z[:n] = run.x[k + 1]
    else:
        z[:n] = h * run.arrays["v"][k + 1]
    truth = teller.tell(t, h, state, z, l, _index_of(run, teller, k + 1))
    if truth is None:
        truth = teller.tell(t, h, state, z, l, np.zeros(teller.m, int), teller.starts(t, h, state))
    if truth is None or ("bilinear" in case.scene and not np.array_equal(truth.index, _index_of(run, teller, k + 1))):
        verdict.unknown += 1  # where solutions are not unique, that of another index set says nothing
        if direct and case.name != "first":
            misfit, row = teller.misfit(t, h, state, z, l, _index_of(run, teller, k + 1))
            if misfit > 1:
                verdict.findings.append(Finding(
                    case.id, case.scene, UNFOUNDED, k, misfit, np.nan, f"row {row}, no solution known, at t = {t:g}", compiled,
                ))  # fmt: skip
        return
    verdict.judged.append(truth.condition)
    (x_true, x_size, x_round), (l_true, l_size, l_round) = teller.answer(t, h, state, truth)
    excess, worst = _excess(run.x[k + 1], x_true[:n], x_size[:n], x_round[:n])
    if excess > 1:
        verdict.findings.append(Finding(
            case.id, case.scene, WRONG_X, k, excess, truth.condition,
            f"x[{worst}] = {run.x[k + 1][worst]!r}, true {float(x_true[worst])!r}, at t = {t:g}", compiled,
        ))  # fmt: skip
    if np.isfinite(truth.condition) and run.l.shape[1] == len(l_true):
        excess, worst = _excess(run.l[k + 1], l_true, l_size, l_round)
        if excess > 1:
            verdict.findings.append(Finding(
                case.id, case.scene, WRONG_L, k, excess, truth.condition,
                f"l[{worst}] = {run.l[k + 1][worst]!r}, true {float(l_true[worst])!r}, size {l_size[worst]:.3g}, at t = {t:g}",
                compiled,
            ))  # fmt: skip


def _excess(got: np.ndarray, true: Sequence[Decimal], size: np.ndarray, rounding: np.ndarray) -> tuple[float, int]:
    """The largest error beside what is allowed, and where."""
    if not len(true):
        return 0.0, -1
    with decimal.localcontext(CONTEXT):
        error = np.array([float(abs(exact(a) - b)) if np.isfinite(a) else np.inf for a, b in zip(got, true, strict=True)])
    ratio = error / np.maximum(RIGHT * size + SLACK * rounding, 1e-290)
    ratio = np.where(np.isnan(ratio), np.inf, ratio)
    worst = int(np.argmax(ratio))
    return float(ratio[worst]), worst


def _judge_refusal(case: Case, model: Any, run: Run, teller: Teller, verdict: Verdict, compiled: bool) -> None:
    """A step that was refused: has it a solution?"""
    k, message = run.N, str(run.error)
    t, h, state = _known(case, model, run, k)
    if case.name == "inclusion":
        found = _last_predictor(model, run, t, h)
        if found is None:
            verdict.unsolvable.append(message)
            return
        state = found
    l = np.clip(np.zeros(teller.m), teller.lower, teller.upper)
    if k > 0 and run.l.shape[1] == teller.m:
        l = np.clip(run.l[k], teller.lower, teller.upper)
    z, index = teller.guess(t, h, state, l), _index_of(run, teller, k)
    truth = teller.tell(t, h, state, z, l, index, teller.starts(t, h, state))
    if truth is None and case.parts:
        truth = _from_parts(case, teller, (t, h, state), k, z)
    if truth is None:
        verdict.unsolvable.append(message)
    elif "linearisation" in message and _leads_too_far(model, t, h, state, floats(truth.z), floats(truth.l)):
        verdict.beyond.append(message)
    else:
        verdict.findings.append(Finding(case.id, case.scene, REFUSED, k, np.inf, truth.condition, message, compiled))


def _leads_too_far(model: Any, t: float, h: float, q: np.ndarray, z: np.ndarray, l: np.ndarray) -> bool:
    """Whether a constraint that acts is above its linearisation at z by a third of |grad g| |z - q|, over its own coordinates."""
    G = ca.jacobian(model.g, model.q)
    here = ca.Function("here", [model.t, model.q], [ca.densify(model.g), ca.densify(G)])
    (g, J), (there, _) = ([np.array(part) for part in here(t + h, at)] for at in (q, z))
    for i in np.flatnonzero(l):
        own = np.array(sorted(set(G[int(i), :].sparsity().get_col())), int)
        d = (z - q)[own]
        if there[i, 0] - g[i, 0] - J[i, own] @ d > np.linalg.norm(J[i, own]) * np.linalg.norm(d) / 3:
            return True
    return False


def _from_parts(case: Case, teller: Teller, known: tuple[float, float, np.ndarray], k: int, z: np.ndarray) -> Truth | None:
    """The truth looked for where the runs of the parts alone are."""
    alone = [Run(case.model(i), False) for i in range(len(case.parts))]
    if any(part.N <= k for part in alone) or sum(part.index.shape[1] for part in alone) != teller.m:
        return None
    x = np.concatenate([part.x[k + 1] for part in alone])
    if case.name == "oscillator":
        x = x - known[2][: x.size]
    l, index = (np.concatenate([getattr(part, name)[k + 1] for part in alone]) for name in ("l", "index"))
    return teller.tell(*known, np.concatenate([x, z[x.size :]]), l, index) if l.size == teller.m else None


def _last_predictor(model: Any, run: Run, t: float, h: float) -> np.ndarray | None:
    """x + h v with v as the selection gives it."""
    from nsmodel.simulation.fixed_grid import make_stepper

    stepper = make_stepper(model, "auto", 1e-9, h=h, state=run.x[-1])
    try:
        return run.x[-1] + h * stepper._select_velocity(t, run.x[-1], np.zeros(stepper._nu))[0]
    except StepError:
        return None


def _judge_constraints(case: Case, model: Any, run: Run, verdict: Verdict, compiled: bool) -> None:
    """Constraints at all rows in digits, and no step may be thrown.

    What g lacks of 0 must be rounding, or, where g is not convex, what its linearisation (>= 0) leaves out.
    """
    t, q, g = model.t, model.q, model.g
    if not g.numel():
        return
    G = ca.jacobian(g, q)
    q_next = ca.SX.sym("q_next", q.numel())
    tell = Exact([t, q, q_next], [ca.substitute(g, q, q_next), g + G @ (q_next - q)])
    sizes = ca.Function("sizes", [t, q], [ca.densify(G), ca.densify(model.f)])
    magnitude, own = Rounding([t, q], [g]), np.array(ca.DM(G.sparsity(), 1))
    for k in range(run.N):
        end, x = float(run.arrays["t"][k] + model.step), run.x[k + 1]
        end = float(run.arrays["t"][k + 1]) if abs(end - run.arrays["t"][k + 1]) < 1e-12 else end
        true, linear = (np.array(part) for part in tell([exact(end)], column(run.x[k]), column(x)))
        with decimal.localcontext(CONTEXT):
            value, left_out = floats(true), floats(true - linear)
        Gk, f = (np.array(part) for part in sizes(end, run.x[k]))
        added = np.abs(x) + np.abs(run.x[k]) + np.abs(float(model.step) * f.ravel()) + np.abs(Gk).T @ run.l[k + 1]
        rounding = EPS * (magnitude([end], x)[0] + np.abs(Gk) @ added)
        rounding += RESOLVED * np.abs(Gk) @ np.abs(x - run.x[k])
        ratio = np.minimum(left_out, 0.0) - value
        ratio = ratio / np.maximum(SLACK * rounding, 1e-290)
        worst = int(np.argmax(ratio))
        if ratio[worst] > 1:
            verdict.findings.append(Finding(
                case.id, case.scene, VIOLATED, k, float(ratio[worst]), np.nan,
                f"{model.multiplier_names[worst]} = {value[worst]:.3g}, "
                f"rounding {rounding[worst]:.1e}, m = {run.l[k + 1][worst]:.3g}",
                compiled,
            ))  # fmt: skip
        moved = np.linalg.norm(Gk, axis=1) * np.sqrt(own @ (x - run.x[k]) ** 2)
        thrown = np.where(run.l[k + 1] > 0, left_out, 0) / np.maximum(moved / 3 * (1 + RIGHT) + SLACK * rounding, 1e-290)
        worst = int(np.argmax(thrown))
        name = model.multiplier_names[worst]
        if thrown[worst] > 1 and name not in run.warnings:
            verdict.findings.append(Finding(
                case.id, case.scene, THREW, k, float(thrown[worst]), np.nan,
                f"'{name}' acts and ends {left_out[worst]:.3g} off its linearisation; its bodies moved by {moved[worst]:.3g}",
                compiled,
            ))  # fmt: skip


def _judge_copies(case: Case, run: Run, verdict: Verdict, compiled: bool) -> None:
    """Each part of the stacked model beside the run of that part alone; a part that stops alone may stop the whole."""
    at_x = at_l = 0
    stops = []
    for i in range(len(case.parts)):
        alone = Run(case.model(i), False)
        n, m = alone.x.shape[1], alone.l.shape[1]
        rows = min(run.N, alone.N) + 1
        if case.scene.endswith(NOT_UNIQUE):  # another solution is one as well
            same = (run.index[:rows, at_l : at_l + m] == alone.index[:rows]).all(axis=1) & (
                run.index[:rows, at_l : at_l + m] > -2
            ).all(axis=1)
            rows = 1 + int(np.argmin(same[1:])) if not same[1:].all() else rows
        here = run.x[:rows, at_x : at_x + n]
        size = np.maximum.accumulate(np.abs(alone.x[:rows] - alone.x[0]).max(axis=1, keepdims=True))
        offset = np.abs(alone.x).max()
        ratio = np.abs(here - alone.x[:rows]) / np.maximum(RIGHT * size * 10 + 1e4 * EPS * offset, 1e-290)
        ratio = np.where(np.isnan(ratio), np.inf, ratio)
        if ratio.max(initial=0.0) > 1:
            k, j = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
            verdict.findings.append(Finding(
                case.id, case.scene, COPY, int(k) - 1, float(ratio.max()), max(verdict.judged, default=np.nan),
                f"copy {i}: x[{j}] = {here[k, j]!r}, alone {alone.x[k, j]!r}", compiled,
            ))  # fmt: skip
        if alone.error is not None:
            stops.append((alone.N, str(alone.error)))
        at_x, at_l = at_x + n, at_l + m
    if run.error is not None and not any(k <= run.N for k, _ in stops):
        verdict.findings.append(
            Finding(case.id, case.scene, COPY, run.N, np.inf, np.nan, f"stops, none of its copies does: {run.error}", compiled)
        )
