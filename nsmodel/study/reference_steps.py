"""A run judged in NumPy, one step after the other, by the paper's formulas and the model's own expressions.

Nothing here comes from the solvers or their certificate: the expressions of the *model* are evaluated at the rows of the run,
and the scheme is written down once more. Each judge returns {what: largest misfit beside what is allowed}, <= 1 if right.
What is allowed is stated here, before any run: a tolerance times what moves or acts in the step, source terms and single
multipliers included, and EVALUATION_ROUNDING times the running error bound of what is evaluated here (`majorant`), its inputs
known to the last digit:

- an equation: EQUATION_TOLERANCE times its terms, and the rounding of the positions;
- a law -y ∈ N_K(l): LAW_TOLERANCE times what moves y, what acts on it through the states, and l;
- a projection: the distance to the exact one, bounded by the duality gap <l, y>, at most PROJECTION_TOLERANCE times the
  step's motion;
- a minimum: no other velocity among the probes may be better by more than rounding.

What the judges share: expressions at rows, running error bounds, what is allowed, laws and potentials by their definition.

Laws that move, as an independent judge sees them: a set for each of N rows, by its definition.

The theta-gamma scheme written down once more, for the judges of the classes that use it.

What a step saw is read off `run.inputs_begin` and `run.inputs`. A reaction that was found anew after a jump is in no row
(`simulation.step_inputs.reinitialised_step_mask`), and that step's equation is not judged where gamma < 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law, LawFactor, complementarity
from nsmodel.modeling.laws.coulomb import excess_at_rows, rivals_at_rows, shifted_at_rows
from nsmodel.modeling.parts import Part
from nsmodel.proof.expression_graph import apply_operation, fold_graph, stack_column
from nsmodel.simulation.step_inputs import reinitialised_step_mask
from nsmodel.simulation.trajectory import Trajectory


def as_it_is(y: np.ndarray) -> np.ndarray:
    """The output of a law that is a normal cone."""
    return y


@dataclass(frozen=True)
class BoxAtRows:
    """{lower <= l <= upper}, (N, m) each."""

    lower: np.ndarray
    upper: np.ndarray
    strict = False
    shifted = staticmethod(as_it_is)

    @property
    def extent(self) -> np.ndarray:
        """The largest finite end of each row (N,)."""
        both = np.abs(np.hstack([self.lower, self.upper]))
        return both.max(axis=1, where=np.isfinite(both), initial=0.0)

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond an end; a set without points is infinitely far."""
        return np.where(self.lower <= self.upper, np.maximum(np.maximum(self.lower - l, l - self.upper), 0), np.inf)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One component after the other at that of its ends where <l', y> is least; far out where there is none."""
        inside, far = np.minimum(np.maximum(l, self.lower), self.upper), 1 + np.abs(l)
        low = np.where(np.isfinite(self.lower), self.lower, inside - far)
        high = np.where(np.isfinite(self.upper), self.upper, inside + far)
        found = np.repeat(inside[None], l.shape[1], axis=0)
        for i in range(l.shape[1]):
            found[i, :, i] = np.where(y > 0, low, high)[:, i]
        return found


@dataclass(frozen=True)
class BallAtRows:
    """{|l| <= radius}, (N, 1)."""

    radius: np.ndarray
    strict = True
    shifted = staticmethod(as_it_is)

    @property
    def extent(self) -> np.ndarray:
        """The radii (N,)."""
        return self.radius[:, 0]

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond the sphere; a set without points is infinitely far."""
        return np.where(self.radius >= 0, np.maximum(np.linalg.norm(l, axis=1, keepdims=True) - self.radius, 0), np.inf)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The points -r y/|y| with the least product with y."""
        size = np.linalg.norm(y, axis=1, keepdims=True)
        return (-self.radius * y / np.where(size > 0, size, 1))[None]


@dataclass(frozen=True)
class CoulombAtRows:
    """Coulomb friction, mu (N, 1)."""

    mu: np.ndarray
    strict = False
    extent = np.zeros(1)

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond the cone; a negative mu makes no set."""
        return np.where(self.mu >= 0, excess_at_rows(l, self.mu), np.inf)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Those of each row's cone."""
        return rivals_at_rows(l, y, self.mu)

    def shifted(self, y: np.ndarray) -> np.ndarray:
        """(y_N + mu |y_T|, y_T)."""
        return shifted_at_rows(y, self.mu)


HALF_LINE = complementarity(1).blocks[0]
# Relative: what a formula, and a law, may be violated by: ten times what a step is solved to by default.
EQUATION_TOLERANCE = LAW_TOLERANCE = 1e-8
# Of the way moved: what a projection may be off by: its distance is the root of a duality gap, which keeps half of the digits.
PROJECTION_TOLERANCE = 1e-6
EVALUATION_ROUNDING = 64 * EPS  # Relative: of a number that takes a few dozen operations.
UNDERFLOW_SIZE = 1e-290  # Smaller misfits may have lost digits near the least normal double, 2e-308, and count as 0.
PROBE_LENGTHS = (1e-6, 1e-3, 1.0)  # Lengths of the probes, beside the velocity: a minimum that is missed shows at one of them.

StepResiduals = dict[str, float]
RowSets = BoxAtRows | BallAtRows | CoulombAtRows


def evaluate_at_rows(symbols: Sequence[ca.SX], expressions: Sequence[ca.SX], *columns: np.ndarray) -> list[np.ndarray]:
    """Each expression (r, c) at N rows as an array (N, r, c); columns (N, k) in the order of the symbols."""
    f = ca.Function("f", list(symbols), [ca.densify(ca.SX(e)) for e in expressions])
    out = f.map(len(columns[0])).call([ca.DM(c.reshape(len(columns[0]), -1).T) for c in columns])
    return [
        np.array(v).reshape(e.shape[0], len(columns[0]), e.shape[1]).transpose(1, 0, 2)
        for v, e in zip(out, (ca.SX(e) for e in expressions), strict=True)
    ]


def step_begins(run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u(t+) where each step begins: (N,), (N, n), (N, nu)."""
    return run.t[:-1], run.x[:-1], run_inputs(run, "inputs_begin")[1:]


def step_ends(run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u(t-) where each step ends."""
    return run.t[1:], run.x[1:], run_inputs(run)[1:]


def run_inputs(run: Trajectory, side: str = "inputs") -> np.ndarray:
    """The inputs of all rows (N + 1, nu): u(t-), or "inputs_begin"."""
    return run.arrays.get(side, np.zeros((len(run.t), 0)))


def majorant(expression: ca.SX) -> ca.SX:
    """The running error bound of evaluating ``expression``, in units of the rounding: the sizes of all its terms.

    Symbols and numbers are known to their last digit; an operation passes on what its arguments are not known to, times its
    slopes, and rounds its result. What cannot be looked into counts as its value alone.
    """

    def propagate_error(op: int, terms: list[tuple[ca.SX, ca.SX]]) -> tuple[ca.SX, ca.SX]:
        fresh = [ca.SX.sym("a") for _ in terms]
        here, old = apply_operation(op, fresh), stack_column(fresh)
        value, *slopes = ca.substitute([here, *(ca.gradient(here, a) for a in fresh)], [old], [stack_column(v for v, _ in terms)])
        return value, ca.fabs(value) + sum((ca.fabs(d) * size for d, (_, size) in zip(slopes, terms, strict=True)), ca.SX(0))

    expression = ca.SX(expression)
    try:
        found = fold_graph(
            expression, lambda symbol: (symbol, ca.fabs(symbol)), lambda c: (ca.SX(c), ca.SX(abs(c))), propagate_error
        )
    except ValueError:
        return ca.fabs(expression)
    return ca.reshape(stack_column(size for _, size in found), *expression.shape)


def apply_matrices(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each matrix (N, r, n) times its vector (N, n)."""
    return np.einsum("kij,kj->ki", matrices, vectors)


def worst_ratio(misfit: np.ndarray, allowed: np.ndarray) -> float:
    """Largest misfit/allowed, 0/0 = 0; what is not a number is infinitely wrong."""
    if not misfit.size:
        return 0.0
    ratio = ratio_to_allowed(misfit, allowed)
    return float(np.max(np.where(np.isnan(ratio), np.inf, ratio)))


def rounding_allowance(*sizes: np.ndarray) -> np.ndarray:
    """EVALUATION_ROUNDING times sizes (N, k, 1); where a slope is infinite (a norm at 0) nothing is allowed."""
    return EVALUATION_ROUNDING * np.sum([np.where(np.isfinite(size), size, 0.0)[:, :, 0] for size in sizes], axis=0)


def ratio_to_allowed(misfit: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """misfit/allowed; what is lost among the smallest doubles counts as 0."""
    return np.where(misfit <= UNDERFLOW_SIZE, 0.0, misfit / allowed)


class StepMagnitudes(NamedTuple):
    """Of each step (N, n): what acts on the states in it, and what they are known to."""

    acting: np.ndarray
    known: np.ndarray


def output_law_residual(model: Any, run: Trajectory, output: ca.SX, l: ca.SX, law: Law, sizes: StepMagnitudes) -> StepResiduals:
    """-y ∈ N_K(l) with y computed afresh; y's scale is what moves it or acts on it in the step, and what is not known of it."""
    y, s_y = output_with_error(model, run, output, l, sizes)
    given, worst = run.multipliers[1:], 0.0
    for rows, block in law.parts():
        own = block_at_rows(block, model, run) if any(block.moves(ca.vertcat(model.t, model.u))) else block
        worst = max(worst, block_residual(own, given[:, rows], y[:, rows], s_y[:, rows]))
    return {"law": worst}


def moving_bound_sizes(model: Any, run: Trajectory) -> np.ndarray:
    """The largest end of each row of the law that moves, where each step ends (N + 1, m), the start first; 0 of the others."""
    law, own = getattr(model, "law", None), np.zeros((len(run.t), run.multipliers.shape[1] if "multipliers" in run.arrays else 0))
    if law is not None:
        for rows, block in law.parts():
            if any(moves := block.moves(ca.vertcat(model.t, model.u))):
                own[1:, rows] = block_at_rows(block, model, run).extent[:, None] * np.array(moves)
    return own


def block_at_rows(block: LawFactor, model: Any, run: Trajectory) -> RowSets:
    """The set of each step's end, of a block whose numbers move."""
    t, _, u = step_ends(run)
    numbers = evaluate_at_rows([model.t, model.u], list(block.numbers.values()), t, u)
    if block.separable:
        return BoxAtRows(*(rows[:, :, 0] for rows in numbers))
    return BallAtRows(numbers[0][:, 0]) if block.is_normal_cone else CoulombAtRows(numbers[0][:, 0])


def output_with_error(
    model: Any, run: Trajectory, output: ca.SX, l: ca.SX, sizes: StepMagnitudes
) -> tuple[np.ndarray, np.ndarray]:
    """y (N, m), and what it may be off by."""
    given, h = run.multipliers[1:], run.step[1:, None]
    slopes = [ca.jacobian(output, symbol) for symbol in (model.x, l, model.t, model.u)]
    expressions = [output, *slopes, majorant(output)]
    y, C, D, drift, driven, size_y = evaluate_at_rows([model.t, model.x, model.u, l], expressions, *step_ends(run), given)
    moves = np.abs(run.x[1:] - run.x[:-1]) + sizes.acting
    begin, end = run_inputs(run, "inputs_begin")[1:], run_inputs(run)
    input_changes = np.abs(end[1:] - begin) + np.abs(begin - end[:-1])
    s_y = LAW_TOLERANCE * (
        apply_matrices(np.abs(C), moves) + apply_matrices(np.abs(D), np.abs(given)) + h * np.abs(drift[:, :, 0])
    )
    s_y += LAW_TOLERANCE * apply_matrices(np.abs(driven), input_changes)
    return y[:, :, 0], s_y + apply_matrices(np.abs(C), sizes.known) + rounding_allowance(size_y)


def block_residual(block: LawFactor | RowSets, l: np.ndarray, y: np.ndarray, s_y: np.ndarray) -> float:
    """How far rows are from l ∈ K with <l' - l, y> >= 0 for the l' ∈ K that the block samples, beside what both may be off by.

    Where K is strictly convex one l' has the least <l', y>: l is measured by its distance from that, unless y is 0. Contacts are
    judged by 0 <= l_N ⟂ y_N >= 0 too: in ŷ_N = y_N + mu |y_T| a large mu hides y_N.
    """
    s_l = LAW_TOLERANCE * np.maximum(np.abs(l).max(axis=1), block.extent)
    worst = ratio_to_allowed(block.excess(l).max(axis=1, initial=0.0), s_l)
    contact, y = y, block.shifted(y)
    if (contact != y).any():
        worst = np.maximum(worst, block_residual(HALF_LINE, l[:, :1], contact[:, :1], s_y[:, :1]))
    size_y, rivals = np.linalg.norm(y, axis=1), block.rivals(l, y)
    if block.strict:
        away = ratio_to_allowed(np.linalg.norm(l - rivals[0], axis=1), s_l)
        return float(np.max(np.maximum(worst, np.fmin(ratio_to_allowed(size_y, s_y.max(axis=1)), away)), initial=0.0))
    for other in rivals:
        gap = np.maximum(((l - other) * y).sum(axis=1), 0)
        worst = np.maximum(worst, ratio_to_allowed(gap, (np.abs(l - other) * s_y).sum(axis=1) + size_y * s_l))
    return float(np.max(worst, initial=0.0))


def subgradient_residual(
    phi: ca.SX, symbol: ca.SX, y: np.ndarray, slope: np.ndarray, size: np.ndarray, unknown: np.ndarray | float = 0.0
) -> float:
    """Largest Phi(y) + <slope, z - y> - Phi(z) beside what is allowed; y is known to ``unknown``."""
    here, worst, sizes = evaluate_at_rows([symbol], [phi], y)[0][:, 0, 0], 0.0, majorant(phi)
    inside = rounding_allowance(*evaluate_at_rows([symbol], [sizes], y))[:, 0] + (np.abs(slope) * unknown).sum(axis=1)
    probes = [np.zeros_like(y), *(y + s * p * size * e for e in np.eye(y.shape[1]) for p in PROBE_LENGTHS for s in (1, -1))]
    for probe in probes:
        at_probe, along = evaluate_at_rows([symbol], [phi], probe)[0][:, 0, 0], (slope * (probe - y)).sum(axis=1)
        allowed = (
            EVALUATION_ROUNDING * (np.abs(here) + np.where(np.isfinite(at_probe), np.abs(at_probe), 0))
            + LAW_TOLERANCE * np.abs(along)
            + inside
        )
        worst = max(worst, worst_ratio(np.maximum(here + along - at_probe, 0), allowed))
    return worst


@dataclass(frozen=True, kw_only=True)
class ReferenceStep:
    """The scheme of a class of models written a second time, in NumPy, and the class in other units.

    Attributes:
        residuals: (model, run), how far each equation of the scheme is missed in the steps of a run.
        acting: (model, run), the terms that make the state in each step (N, n), in its own unit.
        in_units: (model, u, tau, fields of all classes), the model with states u and times tau times as large.
        states_before_step: (model, run, start), (row, h) -> what a step of h from a row starts from; left out: the row's state.
    """

    residuals: Callable[[Any, Trajectory], StepResiduals]
    acting: Callable[[Any, Trajectory], np.ndarray]
    in_units: Callable[[Any, float, float, dict[str, Any]], Model]
    states_before_step: Callable[[Any, Trajectory, np.ndarray], Callable[[int, float], np.ndarray]] | None = None


REFERENCE_STEP = Part[ReferenceStep]("reference_steps.REFERENCE_STEP")


@np.errstate(all="ignore")  # a run that diverges is judged like any other
def formula_residuals(model: Model, run: Trajectory) -> StepResiduals:
    """The misfits of all steps of a run of the bound ``model``; nothing for a run without steps."""
    return REFERENCE_STEP.of(model).residuals(model, run) if len(run.t) > 2 else {}


@np.errstate(all="ignore")
def state_term_sizes(model: Model, run: Trajectory) -> np.ndarray:
    """What acts on each state in each step, whether it moves or not (N, n): the terms that make the state, in its own unit."""
    return REFERENCE_STEP.of(model).acting(model, run) if len(run.t) > 1 else run.x[1:]


def theta_gamma_residual(
    model: Any, run: Trajectory, symbol: ca.SX, rate: ca.SX, input: ca.SX, M: np.ndarray, l: np.ndarray
) -> tuple[float, StepMagnitudes]:
    """The misfit of M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), and the sizes of what made the states.

    f is ``rate`` and r is ``input``, with the multipliers l in place of ``symbol``.
    """
    l, h, x, new = np.nan_to_num(l), run.step[1:, None], run.x[:-1], run.x[1:]
    symbols, rates = [model.t, model.x, model.u], [rate, ca.jacobian(rate, model.x), majorant(rate)]
    (f, slope, size_f), (f_end, slope_end, size_end) = (
        evaluate_at_rows(symbols, rates, *rows) for rows in (step_begins(run), step_ends(run))
    )
    input_expressions, rows = [input, ca.jacobian(input, symbol), majorant(input)], (run.t, run.x, run_inputs(run), l)
    r, push, size_r = evaluate_at_rows([*symbols, symbol], input_expressions, *rows)
    f, f_end, r = f[:, :, 0], f_end[:, :, 0], r[:, :, 0]

    def weighed(begin: np.ndarray, end: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        th, ga = model.theta, model.gamma
        return h * (th * end + (1 - th) * begin + ga * inputs[1:] + (1 - ga) * inputs[:-1])

    misfit = np.abs((new - x) @ M.T - weighed(f, f_end, r))
    size = np.abs(new - x) @ np.abs(M).T + weighed(np.abs(f), np.abs(f_end), np.abs(r) + apply_matrices(np.abs(push), np.abs(l)))
    response = np.abs(np.linalg.pinv(np.nan_to_num(M - h[:, :, None] * model.theta * slope_end)))
    size_r = (
        size_r + np.abs(push) @ moving_bound_sizes(model, run)[:, :, None]
    )  # An l between ends that move is known beside these.
    place = np.abs(x) + np.abs(new) + size @ np.abs(np.linalg.pinv(M)).T
    seen = place @ np.abs(M).T + h * (apply_matrices(np.abs(slope_end), place) + apply_matrices(np.abs(slope), place))
    allowed = (
        EQUATION_TOLERANCE * size
        + EVALUATION_ROUNDING * seen
        + weighed(rounding_allowance(size_f), rounding_allowance(size_end), rounding_allowance(size_r))
    )
    known = ~_reinitialised_steps(model, run) if model.gamma < 1 else np.ones(len(h), bool)
    return worst_ratio(misfit[known], allowed[known]), StepMagnitudes(apply_matrices(response, size), EVALUATION_ROUNDING * place)


def _reinitialised_steps(model: Any, run: Trajectory) -> np.ndarray:
    """The steps (N,) whose r_k is not a row of the run: the first, and those that begin with a jump of an input."""
    found = reinitialised_step_mask(model, run) if model.u.numel() else np.zeros(len(run.t) - 1, bool)
    found[0] = True
    return found
