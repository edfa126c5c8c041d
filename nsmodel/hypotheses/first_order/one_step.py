"""F-unique: does a step have one and only one solution?

Affine steps with constant matrices are decided for every state: W_mlcp a P-matrix and K a box, or W_mlcp definite, gives one l;
W_mlcp psd with ker(W_mlcp + W_mlcp') inside ker B gives at most one x, as two solutions differ by such a d; a solution exists
where K is bounded, or R(W_mlcp + N_K) is the whole space. Otherwise all index sets are tried at states of the run, and at
states where several switch at once: two verified solutions are a witness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, found
from nsmodel.hypotheses.first_order.affine_step import (
    SAMPLES,
    AffineStep,
    Infeasible,
    Shown,
    affine_step,
    solvable,
    two_or_none,
)
from nsmodel.hypotheses.first_order.linearised import Linearised, numbers
from nsmodel.hypotheses.first_order.monotone_step import unique_on_region
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

MOST_STEPS = 5  # Different step lengths that are decided one by one.
MOST_SETS = 2500  # Index sets that are tried at one state.
MOST_TRIES = 300  # Index sets of nonlinear steps that are tried in all, at no fewer than three states.
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
        return _smooth(hypothesis, at, regular, quick)
    exactly = at.constant and at.affine and regular.verdict == HOLDS
    if exactly and (finding := _constant(hypothesis, at, mlcp_finding, quick)) is not None:
        return finding
    if quick:
        return found(hypothesis, UNKNOWN, "not settled by W_mlcp alone; index sets are not enumerated (quick)")
    most = None if exactly or at.jump is not None else unique_on_region(at, regular.verdict == HOLDS)
    if most is not None and most.exists:
        return found(
            hypothesis, HOLDS, f"{most.how[0].upper()}{most.how[1:]}.", {"solutions": 1}, scope=at.scope(local=most.local)
        )
    finding = _enumerated(hypothesis, at)
    if most is not None and finding.verdict != VIOLATED:
        how = f"At most one in the region: {most.how}. That there is one is not proved."
        return found(hypothesis, UNKNOWN, how, {"solutions": 1}, scope=at.scope(local=most.local))
    if finding.verdict == SAMPLED and at.jump is not None:
        return found(hypothesis, UNKNOWN, JUMPS, finding.value)
    return finding


def _smooth(hypothesis: Hypothesis, at: Linearised, regular: Finding, quick: bool) -> Finding:
    if at.affine and regular.verdict == HOLDS:
        return found(hypothesis, HOLDS, "A linear system with a regular matrix.", {"solutions": 1}, scope=at.scope(local=False))
    if at.jump is not None:
        return found(hypothesis, UNKNOWN, JUMPS)
    one = None if quick else unique_on_region(at, regular.verdict == HOLDS)
    if one is not None and one.exists:
        return found(hypothesis, HOLDS, f"{one.how[0].upper()}{one.how[1:]}.", {"solutions": 1}, scope=at.scope(local=one.local))
    if regular.verdict == HOLDS:
        how = "W is regular over the region: solutions are isolated. That there is just one is seen along the run only."
        return found(hypothesis, SAMPLED, how, {"solutions": 1}, scope=at.scope())
    return found(hypothesis, UNKNOWN, "the step is nonlinear, and W is not proved to be regular")


# -- for every state ------------------------------------------------------------------------------------------------------


def _constant(hypothesis: Hypothesis, at: Linearised, mlcp_finding: Finding, quick: bool) -> Finding | None:
    """Every state and each step length that occurs, where the Jacobians are constant; None where that settles nothing."""
    if len(at.steps) > MOST_STEPS:
        return None
    scope, lengths = at.scope(local=False), [float(h) for h in at.steps]
    try:
        domains.of_law(at.model.law, np.zeros((at.model.law.size,) * 2))
    except domains.Empty:
        return None
    reasons = [_one(at, at.exact_mlcp(h)) for h in lengths]
    if all(reasons):
        return found(hypothesis, HOLDS, f"{reasons[0][0].upper()}{reasons[0][1:]}.", {"solutions": 1}, scope=scope)
    if any(block.kind != "box" for block in at.model.law.blocks):
        return None
    several = [affine_step(at, h) for h in lengths]
    if quick or not several[0].few:
        return None
    reasons = []
    for step in reversed(several):
        most = _at_most_one(at, step)
        shown = None if most else two_or_none(step)
        if shown is not None:
            return _shown(hypothesis, at, step, shown)
        exists = _exists(step) if most else None
        if isinstance(exists, Infeasible):
            return _infeasible(hypothesis, at, step, exists)
        reasons.append(f"{most}; {exists}" if exists else "")
    if all(reasons):
        return found(hypothesis, HOLDS, f"{reasons[0][0].upper()}{reasons[0][1:]}.", {"solutions": 1}, scope=scope)
    if most := _at_most_one(at, several[-1]):
        how = f"{most[0].upper()}{most[1:]}; whether one exists for every state is not decided."
        return found(hypothesis, UNKNOWN, how, {"solutions": 1})
    how = f"All index sets tried at {2 * SAMPLES} states: one solution each, as far as the signs are clear."
    if mlcp_finding.verdict == SAMPLED:
        how += " W_mlcp is psd up to rounding only (F-mlcp)."
    return found(hypothesis, SAMPLED, how, {"solutions": 1}, scope=scope)


def _exists(step: AffineStep) -> str | Infeasible:
    """Why a step exists for every state of a psd W_mlcp, or one that moves no x; a state without one; '' where undecided."""
    if np.isfinite(step.upper - step.lower).all():
        return "K is bounded"
    answer = solvable(step) if exact.psd(step.W).psd else None
    if isinstance(answer, Infeasible):
        return answer
    return "every state is feasible, by Farkas' alternative, and W_mlcp psd: one exists (exact)" if answer else ""


def _witness(at: Linearised, step: AffineStep, x: np.ndarray) -> dict[str, object]:
    """The state of a step."""
    near = exact.doubles(x).ravel()
    witness: dict[str, object] = {"t": step.t, "x_k": near}
    if (exact.rational(near) != x.ravel()).any():
        witness["x_k exactly"] = [str(entry) for entry in x.ravel()]
    if step.r is not None:
        witness["r_k"] = exact.doubles(exact.product(step.r[0], x) + step.r[1]).ravel()
    return {**witness, "h": step.h}


def _shown(hypothesis: Hypothesis, at: Linearised, step: AffineStep, shown: Shown) -> Finding:
    witness = _witness(at, step, shown.x)
    if not shown.pair:
        how = f"No solution of the step from this state: none of the {len(step.sets)} index sets gives one (exact)."
        return found(hypothesis, VIOLATED, how, {"solutions": 0}, witness)
    for name, l in zip(("", "other "), shown.pair, strict=True):
        witness |= {f"{name}x": exact.doubles(step.next(shown.x, l)).ravel(), f"{name}l": exact.doubles(l).ravel()}
    how = "Two solutions of one step from this state, both verified in rational arithmetic."
    return found(hypothesis, VIOLATED, how, {"solutions": shown.count}, witness)


def _infeasible(hypothesis: Hypothesis, at: Linearised, step: AffineStep, answer: Infeasible) -> Finding:
    witness = {**_witness(at, step, answer.x), "v": exact.doubles(answer.v).ravel()}
    how = "No solution of the step from this state: v'y < 0 for all l in K, where v'y >= 0 is needed (exact)."
    return found(hypothesis, VIOLATED, how, {"solutions": 0}, witness)


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


def _at_most_one(at: Linearised, step: AffineStep) -> str:
    """Why there is at most one x for every state; empty where that is not proved."""
    if not step.X_l.any():
        return "l moves no x"
    if exact.psd(step.W).psd and _inside_kernel(step.W, at):
        return "W_mlcp is psd and its kernel moves no x (exact): at most one solution"
    return ""


# -- at some states -------------------------------------------------------------------------------------------------------


class State(NamedTuple):
    """A state from which a step is tried: time, packed state, the multiplier that Newton's method starts from, the box's size."""

    t: float
    packed: np.ndarray
    l: np.ndarray
    row: np.ndarray
    size: float


def _enumerated(hypothesis: Hypothesis, at: Linearised) -> Finding:
    """All index sets at some states."""
    problem = one_step_problem(at.model)
    law = numeric_law(problem.law)
    count = next((k for k, _ in enumerate(_sets(law), 1) if k > MOST_SETS), None)
    if law.curved or count is not None:
        why = "curved laws have no index sets to enumerate" if law.curved else f"more than {MOST_SETS} index sets"
        return found(hypothesis, UNKNOWN, f"W_mlcp does not settle it, and {why}")
    newton, h = Newton(problem, read(problem), law, TOLERANCE), float(at.steps.max())
    numbers, tried = [], 0
    sets = sum(1 for _ in _sets(law))
    for state in islice(_states(at, newton, law, h), None if at.affine else max(3, MOST_TRIES // sets)):
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
    return State(float(row[0]), packed, l, row, float((at.upper - at.lower)[1 : n + 1].max()))


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
    return State(state.t, np.concatenate([x, packed[n:]]), middle, state.row, state.size) if inside.all() else None


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
    return bool(np.abs(a[:n] - b[:n]).max() > max(SAME * moved, TOLERANCE * state.size, LEAST))
