"""F-unique: does a step have one and only one solution?

Affine steps with constant matrices are decided for every state: W_mlcp a P-matrix and K a box, or W_mlcp definite, gives one l;
W_mlcp psd with ker(W_mlcp + W_mlcp') inside ker B gives at most one x, as two solutions differ by such a d; a solution exists
where K is bounded, or R(W_mlcp + N_K) is the whole space. Otherwise all index sets are tried at states of the run, and at
states where several switch at once: two verified solutions are a witness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, found
from nsmodel.hypotheses.first_order.linearised import Linearised, numbers
from nsmodel.hypotheses.first_order.step_matrix import p_matrix
from nsmodel.hypotheses.lure import domains
from nsmodel.hypotheses.lure.range_condition import covers_everything
from nsmodel.proof import exact
from nsmodel.scheme.theta_gamma import one_step_problem
from nsmodel.solve import active_set, mlcp
from nsmodel.solve.certificate import NumericLaw, numeric_law
from nsmodel.solve.newton import Newton
from nsmodel.solve.structure import read
from nsmodel.trajectory import Trajectory

MOST_SETS = 2500  # Index sets that are tried at one state.
STATES = 8  # States of the run at which they are tried.
SAME = 1e-6  # Two solutions are one if they differ by less than this part of what l moves in a step.
LEAST = np.finfo(float).tiny / np.finfo(float).eps  # Below it products with h underflow: what is verified there says nothing.
TOLERANCE = 1e-9  # Residual of a solution that counts.
JUMPS = "f, h or g jumps (F-jacobians): a step across the jump may have no solution, or several, whatever W is"


def unique(
    hypothesis: Hypothesis, at: Linearised, regular: Finding, mlcp_finding: Finding, runs: Sequence[Trajectory], quick: bool
) -> Finding:
    """Decide F-unique from F-W, F-mlcp and, where they do not settle it, by enumeration."""
    if regular.verdict == VIOLATED and at.constant_W:
        return found(hypothesis, UNKNOWN, "W is singular (F-W): x_{k+1} is not determined by l")
    if at.defined.verdict != HOLDS:
        return found(hypothesis, UNKNOWN, f"a step needs finite f, h and g: {at.defined.how}")
    if not at.model.law.size:
        return _smooth(hypothesis, at, regular)
    exactly = at.constant and at.affine and regular.verdict == HOLDS
    reason = _everywhere(at) if exactly and mlcp_finding.verdict == HOLDS else ""
    if reason:
        return found(hypothesis, HOLDS, f"{reason[0].upper()}{reason[1:]}.", {"solutions": 1}, scope=at.scope(local=False))
    if quick:
        return found(hypothesis, UNKNOWN, "not settled by W_mlcp alone; index sets are not enumerated (quick)")
    finding = _enumerated(hypothesis, at, reason=_at_most_one(at) if exactly else "")
    if finding.verdict == SAMPLED and at.jump is not None:
        return found(hypothesis, UNKNOWN, JUMPS, finding.value)
    return finding


def _smooth(hypothesis: Hypothesis, at: Linearised, regular: Finding) -> Finding:
    if at.affine and regular.verdict == HOLDS:
        return found(hypothesis, HOLDS, "A linear system with a regular matrix.", {"solutions": 1}, scope=at.scope(local=False))
    if at.jump is not None:
        return found(hypothesis, UNKNOWN, JUMPS)
    if regular.verdict == HOLDS:
        how = "W is regular over the region: solutions are isolated. That there is just one is seen along the run only."
        return found(hypothesis, SAMPLED, how, {"solutions": 1}, scope=at.scope())
    return found(hypothesis, UNKNOWN, "the step is nonlinear, and W is not proved to be regular")


# -- for every state ------------------------------------------------------------------------------------------------------


def _everywhere(at: Linearised) -> str:
    """Why every step, of each length that occurs, has exactly one solution; empty where that is not proved."""
    try:
        domains.of_law(at.model.law, np.zeros((at.model.law.size,) * 2))
    except domains.Empty:
        return ""
    reasons = [_one(at, at.exact_mlcp(float(h))) for h in at.steps] if len(at.steps) <= 5 else [""]
    return reasons[0] if all(reasons) else ""


def _one(at: Linearised, W: np.ndarray | None) -> str:
    if W is None:
        return ""
    law, definite = at.model.law, exact.psd(W)
    if definite.definite:
        return "W_mlcp is positive definite (exact)"
    if not definite.psd:
        boxes = all(block.kind == "box" for block in law.blocks)
        return "W_mlcp is a P-matrix (exact), and K a box" if boxes and p_matrix(W)[0] else ""
    if not _inside_kernel(W, at):
        return ""
    if covers_everything(law, W):
        return "W_mlcp is psd, its kernel moves no x, and R(W_mlcp + N_K) is the whole space (exact); l may not be unique"
    return ""


def _inside_kernel(W: np.ndarray, at: Linearised) -> bool:
    """Whether ker(W + W') lies in ker B: two solutions l have the same B l."""
    S = W + W.T
    return exact.rank(np.vstack([S, exact.rational(numbers(at.jacobians.B))])) == exact.rank(S)


def _at_most_one(at: Linearised) -> str:
    """Why there is at most one x for every state; empty where that is not proved."""
    matrices = [at.exact_mlcp(float(h)) for h in at.steps] if len(at.steps) <= 5 else [None]
    good = all(W is not None and exact.psd(W).psd and _inside_kernel(W, at) for W in matrices)
    return "W_mlcp is psd and its kernel moves no x (exact): at most one solution for every state" if good else ""


# -- at some states -------------------------------------------------------------------------------------------------------


class State(NamedTuple):
    """A state from which a step is tried: time, packed state, and the multiplier that Newton's method starts from."""

    t: float
    packed: np.ndarray
    l: np.ndarray
    row: np.ndarray


def _enumerated(hypothesis: Hypothesis, at: Linearised, reason: str) -> Finding:
    """All index sets at some states; ``reason`` says why there is at most one solution, where that is known."""
    problem = one_step_problem(at.model)
    law = numeric_law(problem.law)
    if reason:
        how = f"{reason[0].upper()}{reason[1:]}; that one exists is seen along the run only (it does not for every state)."
        return found(hypothesis, SAMPLED if "run" in at.along else UNKNOWN, how, {"solutions": 1})
    count = next((k for k, _ in enumerate(_sets(law), 1) if k > MOST_SETS), None)
    if law.curved or count is not None:
        why = "curved laws have no index sets to enumerate" if law.curved else f"more than {MOST_SETS} index sets"
        return found(hypothesis, UNKNOWN, f"W_mlcp does not settle it, and {why}")
    newton, h = Newton(problem, read(problem), law, TOLERANCE), float(at.steps.max())
    numbers, tried = [], 0
    for state in _states(at, newton, law, h):
        solutions = _solutions(newton, law, state, h, at.affine)
        tried += 1
        if not solutions:
            continue
        numbers.append(len(solutions))
        if len(solutions) > 1:
            n = len(at.model.names)
            (z1, l1), (z2, l2) = solutions[:2]
            how = "Two solutions of one step, both verified, from this state."
            witness = {"t": state.t, "x_k": state.packed[:n], "h": h, "x": z1[:n], "l": l1, "other x": z2[:n], "other l": l2}
            return found(hypothesis, VIOLATED, how, {"solutions": len(solutions)}, witness)
    if not numbers:
        return found(hypothesis, UNKNOWN, f"no index set gave a solution at {tried} states")
    how = f"All index sets tried at {tried} states of {at.along} and on switching surfaces: never two solutions."
    return found(hypothesis, SAMPLED, how, {"solutions": max(numbers)}, scope=at.scope())


def _sets(law: NumericLaw) -> Iterator[np.ndarray]:
    return active_set.index_sets(law, np.zeros(law.size, np.int8), MOST_SETS + 1)


def _states(at: Linearised, newton: Newton, law: NumericLaw, h: float) -> Iterator[State]:
    """The start, rows of the run, then states where every l is between its bounds with y = 0."""
    middle = np.clip(np.zeros(at.model.law.size), at.lower[-at.model.law.size :], at.upper[-at.model.law.size :])
    yield _state(at, np.concatenate([[0.0], numbers(at.model.x0).ravel(), middle]), law)
    chosen = at.points[np.unique(np.linspace(0, len(at.points) - 1, STATES).astype(int))]
    for row in chosen:
        yield _state(at, row, law)
    for row in chosen[:2]:
        moved = _switching(at, newton, law, _state(at, row, law), h)
        if moved is not None:
            yield moved


def _state(at: Linearised, row: np.ndarray, law: NumericLaw) -> State:
    """The packed state at a row (t, x, l): r_k = g(t, x, l) joins it where gamma < 1."""
    n = len(at.model.names)
    packed = row[1 : n + 1]
    if at.model.gamma < 1:
        packed = np.concatenate([packed, np.array(ca.Function("g", [at.z], [at.model.g])(row)).ravel()])
    l = row[n + 1 :] if law.size == len(row) - n - 1 else np.clip(np.zeros(law.size), law.lower, law.upper)
    return State(float(row[0]), packed, l, row)


def _switching(at: Linearised, newton: Newton, law: NumericLaw, state: State, h: float) -> State | None:
    """A state of the region from which y = 0 with every l between its bounds, by Gauss and Newton in x_k."""
    low, up = law.lower, law.upper
    width = np.where(np.isfinite(low) & np.isfinite(up), np.minimum(up, 1e300) - np.maximum(low, -1e300), 2.0)
    middle = np.where(np.isfinite(low), low + width / 2, np.where(np.isfinite(up), up - width / 2, 0.0))
    n, packed = len(at.model.names), state.packed.copy()
    size = np.where(np.abs(packed[:n]) > 0, np.abs(packed[:n]), at.upper[1 : n + 1] - at.lower[1 : n + 1])

    def gap(x: np.ndarray) -> np.ndarray | None:
        W, b = newton.affine_problem(state.t, h, np.concatenate([x, packed[n:]]), middle)
        return None if W is None or b is None else W @ middle + b

    x = packed[:n].copy()
    for _ in range(3):
        y = gap(x)
        columns = [gap(x + 1e-4 * size * unit) for unit in np.eye(n)]
        if y is None or any(column is None for column in columns):
            return None
        slope = np.column_stack([column - y for column in columns if column is not None]) / 1e-4
        x = x - size * np.linalg.lstsq(slope, y, rcond=1e-8)[0]
    inside = (x >= at.lower[1 : n + 1]) & (x <= at.upper[1 : n + 1])
    return State(state.t, np.concatenate([x, packed[n:]]), middle, state.row) if inside.all() else None


def _solutions(newton: Newton, law: NumericLaw, state: State, h: float, affine: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """Different solutions (z, l) of the step, each verified."""
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    for z, l in _affine(newton, law, state, h) if affine else _nonlinear(newton, law, state, h):
        if all(_apart(z, other, state) for other, _ in kept):
            kept.append((z, l))
    return kept


def _affine(newton: Newton, law: NumericLaw, state: State, h: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    W, b = newton.affine_problem(state.t, h, state.packed, state.l)
    if W is None or b is None:
        return
    z = newton.guess(state.t, h, state.packed, state.l)
    for index in _sets(law):
        l = active_set.polish(W, b, law, index)
        if l is not None and mlcp.residual(W, b, law, l).max(initial=0.0) <= TOLERANCE:
            found_ = _state_of(newton, state, h, z, l)
            if found_ is not None:
                yield found_, l


def _nonlinear(newton: Newton, law: NumericLaw, state: State, h: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    z = newton.guess(state.t, h, state.packed, state.l)
    for index in _sets(law):
        with np.errstate(all="ignore"):  # iterates on a wrong index set may run away
            found_ = newton.on_index_set(state.t, h, state.packed, z, state.l, index)
        if found_ is not None and found_.residual <= TOLERANCE:
            yield found_.z, found_.l


def _state_of(newton: Newton, state: State, h: float, z: np.ndarray, l: np.ndarray) -> np.ndarray | None:
    """The z that E gives for this l."""
    at = newton.linearise(state.t, h, state.packed, z, l)
    try:
        return z - np.linalg.solve(at.E_z, at.E)
    except np.linalg.LinAlgError:
        return None


def _apart(a: np.ndarray, b: np.ndarray, state: State) -> bool:
    """Whether two x_{k+1} differ by more than rounding and tolerance leave open."""
    n = min(len(a), len(state.packed))
    moved = max(np.abs(a[:n] - state.packed[:n]).max(), np.abs(b[:n] - state.packed[:n]).max())
    return bool(np.abs(a[:n] - b[:n]).max() > max(SAME * moved, LEAST))
